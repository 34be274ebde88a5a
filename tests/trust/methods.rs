//! No method loses to Euler's at the same step, and linear systems that are no chain are exact with `expo`.
//!
//! Contacts, observers and controllers of the library, moved by a sine or held, against rk4 with a hundredth of the step.

use crate::chance::{Chance, seeds};
use crate::support::{Texts, checked};
use abi::Instance;
use compiler::{Changes, Options};

/// What is run, and the quantity that is compared. `SPEED` is a sine of the speed, `FORCE` of the force, `PLACE` of a place.
struct Bench {
    run: &'static str,
    quantity: &'static str,
    /// Linear and in one circle, or of single states; moved by constants only: `expo` is exact.
    exact: bool,
}

const fn bench(run: &'static str, quantity: &'static str) -> Bench {
    Bench { run, quantity, exact: false }
}

const fn exact(run: &'static str, quantity: &'static str) -> Bench {
    Bench { run, quantity, exact: true }
}

const BENCHES: &[Bench] = &[
    exact("ExtendedStateObserver(y = 0 m, u = 2 N, w = RATE)", "F_hat"),
    exact("DisturbanceObserver(v = 0 m/s, u = 1 N, T = 1 / RATE)", "F_hat"),
    // A chain: its states do not need each other, are taken one after the other, and are of order 2.
    bench("DisturbanceObserver2(v = 0 m/s, u = 1 N, T = 1 / RATE)", "F_hat"),
    exact("SpringBench(vp = 0 m/s, x_start = 1 m, k = 400 N/m, fr = Viscous())", "x"),
    // Its play is a choice of the twist, so its states are iterated, of order 2.
    bench("TwoMass(d = 0 N·s/m, x_start = 1 mm)", "x1"),
    exact("Axis(F_motor = 2 N, F_load = 1 N)", "x"),
    exact("Cascade(r = 10 mm, y = 0 m)", "u"),
    bench("ExtendedStateObserver(y = 0 m, u = FORCE, w = RATE)", "F_hat"),
    bench("ExtendedStateObserver(y = PLACE, u = 0 N, w = RATE)", "F_hat"),
    bench("SpeedObserver(y = PLACE, w = RATE)", "v"),
    bench("DisturbanceObserver(v = 0 m/s, u = FORCE, T = 1 / RATE)", "F_hat"),
    bench("DisturbanceObserver2(v = 0 m/s, u = FORCE, T = 1 / RATE)", "F_hat"),
    bench("FriedlandPark(v = 1 m/s, u = FORCE)", "F_hat"),
    bench("LuGreObserver(v = SPEED, e = 0 m)", "F_hat"),
    bench("AdaptiveLuGreObserver(v = SPEED, e = 0 m, de = 0 m/s)", "F_hat"),
    bench("PID(r = PLACE, y = 0 m)", "u"),
    bench("PIDSpeed(r = PLACE, y = 0 m)", "u"),
    bench("Cascade(r = PLACE, y = 0 m)", "u"),
    bench("Lag(u = FORCE)", "y"),
    bench("DriveTorque(u = 100 N)", "F"),
    bench("TwoMass(F_motor = FORCE)", "x1"),
    bench("Axis(F_motor = FORCE)", "x"),
    bench("SpringBench(fr = LuGre())", "x"),
    bench("SpringBench(fr = KFMSmooth(v0 = 10 mm/s, vs = 30 mm/s))", "x"),
    bench("SpeedBench(v = SPEED, fr = LuGre())", "F"),
    bench("SpeedBench(v = SPEED, fr = LoadedLuGre())", "F"),
    bench("SpeedBench(v = SPEED, fr = LuGreAsymmetric())", "F"),
    bench("SpeedBench(v = SPEED, fr = LuGreCurve())", "F"),
    bench("SpeedBench(v = SPEED, fr = Dahl())", "F"),
    bench("SpeedBench(v = SPEED, fr = DahlPower())", "F"),
    bench("SpeedBench(v = SPEED, fr = ElastoPlastic())", "F"),
    bench("SpeedBench(v = SPEED, fr = BoucWen())", "F"),
    bench("SpeedBench(v = SPEED, fr = BlimanSorine())", "F"),
    bench("SpeedBench(v = SPEED, fr = BlimanSorine1())", "F"),
    bench("SpeedBench(v = SPEED, fr = BristleMass())", "F"),
    bench("SpeedBench(v = SPEED, fr = Gonthier())", "F"),
    bench("SpeedBench(v = SPEED, fr = GMS())", "F"),
    bench("SpeedBench(v = SPEED, fr = MaxwellSlip())", "F"),
    bench("SpeedBench(v = SPEED, fr = LeuvenModified())", "F"),
    bench("SpeedBench(v = SPEED, fr = ResetIntegrator())", "F"),
    bench("SpeedBench(v = SPEED, fr = RateState())", "F"),
    bench("SpeedBench(v = SPEED, fr = PositionDependent())", "F"),
];
const METHODS: [&str; 3] = ["expo", "implicit", "rk4"];
const STEPS: [f64; 4] = [1e-4, 5e-4, 1e-3, 2e-3];

/// What a seed decides.
struct Case {
    bench: &'static Bench,
    run: String,
    step: f64,
}

impl Case {
    fn of(seed: u64, benches: &[&'static Bench]) -> Case {
        let mut chance = Chance::new(seed);
        let bench = benches[seed as usize % benches.len()];
        let (frequency, size) = (chance.decades(1.0, 20.0), chance.decades(0.1, 10.0));
        let rate = chance.decades(5.0, 400.0);
        let run = bench
            .run
            .replace("SPEED", &format!("sine({size:.3} mm/s, {frequency:.3} Hz)"))
            .replace("FORCE", &format!("sine({size:.3} N, {frequency:.3} Hz)"))
            .replace("PLACE", &format!("sine({size:.3} mm, {frequency:.3} Hz)"))
            .replace("RATE", &format!("{rate:.3} 1/s"));
        Case { bench, run, step: chance.of(&STEPS) }
    }
}

/// The quantity after each step of 0.1 s of simulated time, with `parts` steps of the method in one; NaN from where a
/// guard has stopped the run.
fn course(case: &Case, method: &str, parts: u32) -> Result<Vec<f64>, String> {
    let step = case.step / f64::from(parts);
    let text = format!(
        "import std.interfaces import std.friction import std.control import std.plant import std.observer import std.bench
experiment it {{ run {} for 1 s  solver {method} step {} us }}",
        case.run,
        step * 1e6
    )
    .replace(" import", "\nimport");
    let sources = Texts::default();
    let (mut loaded, _) = checked("methods.fric", &text, &sources);
    let options = Options { changes: Changes::default(), interpret: false };
    let cases = compiler::compile(&mut loaded, &sources, "it", &options, &mut Vec::new(), &mut |_| ());
    let mut run: Instance = cases.map_err(|found| format!("{}: {found:?}", case.run))?.remove(0).instance;
    let quantity = case.bench.quantity;
    let slot = run.description().quantity(quantity).ok_or_else(|| format!("{}: no `{quantity}`", case.run))?.slot;
    let steps = (0.1 / case.step).round() as usize;
    let mut stopped = run.start(step) != 0;
    let mut values = Vec::with_capacity(steps);
    for _ in 0..steps {
        stopped = stopped || run.advance(u64::from(parts)) != 0;
        values.push(if stopped { f64::NAN } else { run.get(slot) });
    }
    Ok(values)
}

/// Largest distance of two courses; infinite where one is no number.
fn distance(a: &[f64], b: &[f64]) -> f64 {
    let largest =
        |most: f64, (a, b): (&f64, &f64)| if (a - b).is_finite() { most.max((a - b).abs()) } else { f64::INFINITY };
    a.iter().zip(b).fold(0.0, largest)
}

fn size(a: &[f64]) -> f64 {
    a.iter().fold(0.0, |most, a| a.abs().max(most))
}

/// What is wrong with the methods of a case.
fn judge(case: &Case, reference: &[f64]) -> Result<Vec<String>, String> {
    let range = size(reference);
    let euler = distance(&course(case, "euler", 1)?, reference);
    let mut wrong = Vec::new();
    for method in METHODS {
        let error = distance(&course(case, method, 1)?, reference);
        // Where Euler's is beyond the stability of explicit methods, rk4 may be too.
        let beyond = method == "rk4" && euler > range;
        if !beyond && error > 1.02 * euler + 1e-7 * range {
            wrong.push(format!("{method} {error:.3e}, euler {euler:.3e} of {range:.3e}"));
        }
    }
    Ok(wrong)
}

#[test]
fn no_method_loses_to_euler() {
    let benches: Vec<&Bench> = BENCHES.iter().collect();
    let seeds = seeds(2 * benches.len() as u64);
    println!("seeds {seeds:?}");
    let mut failed = Vec::new();
    for seed in seeds {
        let case = Case::of(seed, &benches);
        let words = match course(&case, "rk4", 100).and_then(|reference| judge(&case, &reference)) {
            Ok(wrong) => wrong,
            Err(words) => vec![words],
        };
        failed.extend(words.iter().map(|words| format!("seed {seed}, step {:e} s, {}: {words}", case.step, case.run)));
    }
    assert!(failed.is_empty(), "{} fail:\n{}", failed.len(), failed.join("\n"));
}

#[test]
fn linear_circles_are_exact_with_expo() {
    let benches: Vec<&Bench> = BENCHES.iter().filter(|bench| bench.exact).collect();
    let seeds = seeds(6 * benches.len() as u64);
    println!("seeds {seeds:?}");
    for seed in seeds {
        let case = Case::of(seed, &benches);
        let [found, reference] =
            [("expo", 1), ("rk4", 200)].map(|(method, parts)| course(&case, method, parts).unwrap());
        let error = distance(&found, &reference);
        assert!(
            error <= 1e-8 * size(&reference),
            "seed {seed}, step {:e} s, {}: off by {error:e}",
            case.step,
            case.run
        );
    }
}
