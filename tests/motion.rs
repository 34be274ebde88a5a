//! Planned motions of `std.signal` over random limits: within all of them, from the start to the goal, without slack.
//! `FRIC_SEED`, `FRIC_RUNS` (default 150).

mod support;

use compiler::ir::random::Random;
use compiler::{Changes, Options};
use runtime::engine::{Continue, every_step};
use support::{Texts, number};

/// Steps of a run.
const STEPS: usize = 4000;
/// Relative error that is allowed: rounding of some operations, and of differences over a step.
const ALLOWED: f64 = 1e-6;

/// Limits of a motion. `j_max` is infinite for a trapezoid.
#[derive(Debug)]
struct Limits {
    x0: f64,
    x1: f64,
    v_max: f64,
    a_max: f64,
    j_max: f64,
    t0: f64,
}

fn rows(model: &str, limits: &Limits, duration: f64) -> Vec<Vec<f64>> {
    let Limits { x0, x1, v_max, a_max, j_max, t0 } = limits;
    let jerk = if j_max.is_finite() { format!(", j_max = {j_max} m/s^3") } else { String::new() };
    let text = format!(
        "import std.signal
experiment e {{
  run    {model}(x0 = {x0} m, x1 = {x1} m, v_max = {v_max} m/s, a_max = {a_max} m/s^2{jerk}, t0 = {t0} s) for {duration} s
  solver euler step {} s
  record x [m], v [m/s], a [m/s^2]
}}
",
        duration / STEPS as f64
    );
    let mut loaded = compiler::load("a.fric", &text, &Texts::default());
    let options = Options { changes: Changes::default(), interpret: true };
    let cases = compiler::compile(&mut loaded, &Texts::default(), "e", &options, &mut Vec::new(), &mut |_| ());
    let case = cases.unwrap_or_else(|found| panic!("{found:#?}\n{text}")).remove(0);
    let (recording, result) = every_step(case.instance, &case.experiment, &mut |_| Continue::Continue(()));
    result.unwrap_or_else(|failure| panic!("{failure}\n{text}"));
    recording.expect("it is small").rows().map(<[f64]>::to_vec).collect()
}

/// Limits over four decades, as decimals: both directions, short and long motions, and none.
fn limits(random: &mut Random, jerk: bool) -> Limits {
    let mut size = |low: f64, doubled: usize| low * (1u64 << random.below(doubled)) as f64 * random.within(1.0, 2.0);
    let (v_max, a_max, distance) = (size(1e-3, 13), size(0.01, 13), size(1e-6, 23));
    let j_max = if jerk { size(0.1, 17) } else { f64::INFINITY };
    let x0 = random.within(-1.0, 1.0);
    let distance = [distance, -distance, 0.0][[0, 0, 0, 1, 1, 1, 2][random.below(7)]];
    Limits { x0, x1: x0 + distance, v_max, a_max, j_max, t0: random.within(0.0, 0.5) }
}

/// By Newton's method.
fn cube_root(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { (0..100).fold(x.max(1.0), |y, _| (2.0 * y + x / (y * y)) / 3.0) }
}

/// Checks one motion; returns which limits it reaches: speed, acceleration.
fn check(model: &str, limits: &Limits, place: &str) -> [bool; 2] {
    let Limits { x0, x1, v_max, a_max, j_max, t0 } = *limits;
    let distance = (x1 - x0).abs();
    // No motion within these limits takes longer.
    let (ramp, jerk) =
        ((v_max / a_max).min((distance / a_max).sqrt()), (a_max / j_max).min(cube_root(distance / j_max)));
    let longest = distance / v_max + 2.0 * ramp + 4.0 * jerk;
    let rows = rows(model, limits, (t0 + longest) * 1.05 + 1e-3);
    let step = rows[1][0] - rows[0][0];
    let scale = 1.0 + distance + x0.abs();
    let (first, last) = (&rows[0], rows.last().expect("there are rows"));
    assert!((first[1] - x0).abs() < 1e-12 * scale, "starts at {}: {place}", first[1]);
    assert!((last[1] - x1).abs() < 1e-9 * scale, "ends at {}, not {x1}: {place}", last[1]);
    assert!(last[2].abs() <= ALLOWED * v_max && last[3].abs() <= ALLOWED * a_max, "does not rest: {place}");
    let (mut slack, mut reached, mut moving) = (0, [false; 2], 0);
    for (k, row) in rows.iter().enumerate() {
        let [t, x, v, a] = row[..] else { unreachable!("four columns") };
        assert!(row.iter().all(|value| value.is_finite()), "{row:?}: {place}");
        let (low, high) = (x0.min(x1) - 1e-9 * scale, x0.max(x1) + 1e-9 * scale);
        assert!((low..=high).contains(&x), "at {t} s x is {x}: {place}");
        assert!(v.abs() <= v_max * (1.0 + ALLOWED), "at {t} s the speed is {v}: {place}");
        assert!(a.abs() <= a_max * (1.0 + ALLOWED), "at {t} s the acceleration is {a}: {place}");
        assert!(v * (x1 - x0) >= -ALLOWED * v_max * distance, "at {t} s it goes back: {place}");
        reached[0] |= v.abs() >= v_max * (1.0 - ALLOWED);
        reached[1] |= a.abs() >= a_max * (1.0 - ALLOWED);
        let Some(next) = rows.get(k + 1) else { continue };
        let jerk = (next[3] - a) / step;
        assert!(jerk.abs() <= j_max * (1.0 + ALLOWED) + 1e-9 * a_max / step, "at {t} s the jerk is {jerk}: {place}");
        // The speed is the rate of x, the acceleration that of v. Within a step the rates change by at most j h and a h.
        let drift = (next[1] - x) / step - 0.5 * (v + next[2]);
        assert!(
            drift.abs() <= (0.5 * a_max * step).min(2.0 * v_max) + 1e-9 * scale / step,
            "at {t} s v is not dx/dt: {place}"
        );
        let drift = (next[2] - v) / step - 0.5 * (a + next[3]);
        assert!(
            drift.abs() <= (0.5 * j_max * step).min(2.0 * a_max) + 1e-9 * v_max / step,
            "at {t} s a is not dv/dt: {place}"
        );
        // Fastest: at each instant of the motion one of the limits is reached, except in steps in which it changes.
        if v != 0.0 && next[2] != 0.0 {
            moving += 1;
            let full = v.abs() >= v_max * (1.0 - ALLOWED)
                || a.abs() >= a_max * (1.0 - ALLOWED)
                || jerk.abs() >= j_max * (1.0 - 1e-4);
            slack += i32::from(!full);
        }
    }
    assert!(slack <= 8, "{slack} of {moving} steps use no limit: {place}");
    assert!(moving > 0 || distance == 0.0 || distance < 1e-3 * longest * v_max, "does not move: {place}");
    reached
}

/// Mutants tried by hand in `SCurve`: `T_a` without `T_j` where v_max is reached (case 4 of seed 1); `ramps` compares with
/// one `a_max * T_ja^2` (case 16); `sign(x1 - x0)` left out of `v` (case 0); time runs faster by 1 % (case 0); `T_v` longer
/// by a tenth (case 2). In `Trapezoid`: `D > D_a` reversed (case 2). The speed as a difference of squares, as it was,
/// exceeds v_max by its rounding in a long motion (case 10).
#[test]
fn motions_stay_within_their_limits_and_use_them() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(150));
    let mut random = Random(seed);
    let mut kinds = [0; 4];
    for number in 0..runs {
        let model = ["SCurve", "Trapezoid"][usize::from(number % 3 == 2)];
        let limits = limits(&mut random, model == "SCurve");
        let reached = check(model, &limits, &format!("seed {seed}, case {number}: {model}, {limits:?}"));
        kinds[usize::from(reached[0]) * 2 + usize::from(reached[1])] += 1;
    }
    // Neither limit, the acceleration alone, the speed alone, both.
    assert!(runs < 100 || kinds.iter().all(|count| *count > 0), "{kinds:?}");
}
