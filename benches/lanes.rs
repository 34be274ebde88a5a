//! Lanes as `fric sweep` uses them: the PID servo with LuGre friction of the library at 10 µs, each instance with its own
//! mass, with its guards and with the measures of an experiment, on one core. Against C that runs the instances one after
//! the other (`gcc -O3 -march=native`), and against AVX-512 or AVX2 intrinsics written by hand (`servo_lanes.c`), which have
//! no guards and measure nothing. All are interleaved in one run; ratios are of medians over rounds.
//! `cargo bench --bench lanes`.

mod gcc;

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::lanes::{Batch, Lanes};
use abi::plan::Method;
use abi::{Instance, Slot};
use compiler::codegen::lanes::Width;
use compiler::codegen::tiering;
use compiler::experiment::vary::Varying;
use compiler::ir::program::Program;
use libloading::Library;
use runtime::engine::Continue;
use runtime::engine::lanes::{Next, run};
use std::sync::Arc;
use std::time::Instant;

/// r, m, σ0, σ1, σ2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max
const PARAMS: [f64; 14] = [1.0, 1.0, 1e5, 316.0, 0.4, 1.0, 1.5, 1e-3, 3.0, 0.75, 2.0, 200.0, 0.5, 20.0];
/// Where the mass is among them.
const MASS: usize = 1;
/// Step in s.
const H: f64 = 1e-5;
/// Steps of a run.
const STEPS: u64 = 65_536;
const ROUNDS: usize = 21;

/// What a sweep measures: the name of the row, and its statements.
const MEASURED: [(&str, &str); 4] = [
    ("at the end", "expect final(s.body.x) > -1 m"),
    ("max", "expect max(s.body.x) > -1 m"),
    ("max, rms", "expect max(s.body.x) > -1 m  expect rms(s.body.v) >= 0 m/s"),
    ("max, rms, force", "expect max(s.body.x) > -1 m  expect rms(s.body.v) >= 0 m/s  expect max(s.fr.F) > -100 N"),
];

type Hand = unsafe extern "C" fn(state: *mut f64, params: *const f64, h: f64, count: u64);

/// The mass of an instance in kg.
fn mass(k: usize) -> f64 {
    0.9 + 0.2 * (k % 101) as f64 / 100.0
}

fn params(k: usize) -> [f64; 14] {
    let mut params = PARAMS;
    params[MASS] = mass(k);
    params
}

fn varying(statements: &str, method: Method) -> Varying {
    let text = format!(
        "import std.plant\nmodel Top {{\n  part s = Servo(r = 1 m)\n}}\nexperiment e {{\n  run Top() for {} s\n  \
         solver {} step 10 us\n  {}\n}}\n",
        STEPS as f64 * H,
        method.name(),
        statements.replace("  expect", "\n  expect"),
    );
    let mut loaded = compiler::load("lanes.fric", &text, &project::Disk);
    let changes = compiler::Changes { vary: vec!["s.m".into()], ..compiler::Changes::default() };
    let options = compiler::Options { changes, interpret: false };
    let cases = compiler::varying(&mut loaded, &project::Disk, "e", &options, &mut Vec::new());
    cases.unwrap_or_else(|found| panic!("{found:?}\n{text}")).remove(0)
}

/// Seconds of an iteration, given the seconds of all.
fn timed(times: &mut Vec<f64>, iterations: u64, work: impl FnOnce()) {
    let begun = Instant::now();
    work();
    times.push(begun.elapsed().as_secs_f64() * 1e9 / iterations as f64);
}

fn main() {
    let scalar = gcc::built("servo.c");
    for method in [Method::Euler, Method::Rk4] {
        one(method, &scalar);
    }
}

/// Instances by hand: their states and parameters, one after the other or in lanes.
struct ByHand<'l> {
    name: String,
    function: libloading::Symbol<'l, Hand>,
    width: usize,
    states: Vec<f64>,
    params: Vec<f64>,
}

impl<'l> ByHand<'l> {
    fn in_lanes(library: &'l Library, name: &str, method: Method) -> ByHand<'l> {
        // SAFETY: the library was just built from a source with functions of these names and types.
        let (function, width) = unsafe {
            let width = library.get::<unsafe extern "C" fn() -> u64>(b"lanes_width").expect("it is in the source");
            (library.get::<Hand>(format!("{}_lanes", method.name()).as_bytes()), width() as usize)
        };
        let params = (0..14 * width).map(|at| params(at % width)[at / width]).collect();
        let function = function.expect("it is in the source");
        ByHand { name: name.into(), function, width, states: vec![0.0; 5 * width], params }
    }

    fn steps(&mut self) {
        // SAFETY: five states and fourteen parameters for each instance, as the source declares.
        unsafe { (self.function)(self.states.as_mut_ptr(), self.params.as_ptr(), H, STEPS) };
    }
}

fn one(method: Method, scalar: &Library) {
    // SAFETY: the library was just built from a source with a function of this name and type.
    let alone = unsafe { scalar.get::<Hand>(method.name().as_bytes()) }.expect("it is in the source");
    let (wide, narrow) = (gcc::built("servo_lanes.c"), gcc::built_for("servo_lanes.c", &["-mavx2", "-mfma"]));
    let mut hands = Vec::new();
    if Width::Avx512.is_here() {
        hands.push(ByHand::in_lanes(&wide, "AVX-512 intrinsics", method));
    }
    if Width::Avx2.is_here() {
        hands.push(ByHand::in_lanes(&narrow, "AVX2 intrinsics", method));
    }
    let cases: Vec<(&str, Varying)> = MEASURED.iter().map(|(name, text)| (*name, varying(text, method))).collect();
    let mass_at: Slot = cases[0].1.param("s.m").expect("it is a parameter").slot;

    // The code itself, with guards, in all widths.
    let program = program(method);
    let widths = [Width::Avx512, Width::Avx2].into_iter().filter(|width| width.is_here());
    let mut batches: Vec<(String, Batch)> = widths
        .filter_map(|width| tiering::lanes_of(&program, method, width, width.vectors()))
        .map(|lanes| (format!("{}, with guards", lanes.name()), batch(&lanes, &program)))
        .collect();
    let pool = program.description.pool.clone();

    let count = 16;
    let mut states = vec![[0.0; 5]; count];
    let all: Vec<[f64; 14]> = (0..count).map(params).collect();
    let mut times = vec![Vec::new(); 1 + hands.len() + batches.len() + cases.len()];
    for _ in 0..ROUNDS {
        let mut times = times.iter_mut();
        timed(times.next().expect("C"), count as u64 * STEPS, || {
            for (state, params) in states.iter_mut().zip(&all) {
                // SAFETY: five states and fourteen parameters, as the source declares.
                unsafe { alone(state.as_mut_ptr(), params.as_ptr(), H, STEPS) };
            }
        });
        for hand in &mut hands {
            timed(times.next().expect("intrinsics"), hand.width as u64 * STEPS, || hand.steps());
        }
        for (_, batch) in &mut batches {
            let iterations = batch.width() as u64 * STEPS;
            timed(times.next().expect("lanes"), iterations, || assert_eq!(batch.advance(&pool, STEPS), STEPS));
        }
        for (_, case) in &cases {
            let runs = 2 * case.lanes().expect("this processor has lanes").width();
            timed(times.next().expect("a sweep"), runs as u64 * STEPS, || sweep(case, runs, mass_at));
        }
    }
    for hand in &hands {
        let (ours, theirs) = (hand.states[hand.width + 3], states[3][1]);
        assert!((ours - theirs).abs() < 1e-6 * theirs.abs().max(1e-3), "{}: {ours}, and C has {theirs}", hand.name);
    }
    let medians: Vec<f64> = times.into_iter().map(median).collect();
    let gcc = medians[0];
    println!("{}: C one after the other {gcc:.2} ns a step and instance; ratios to it", method.name());
    let names = hands.iter().map(|hand| hand.name.clone()).chain(batches.iter().map(|(name, _)| name.clone()));
    let swept = cases
        .iter()
        .map(|(name, case)| format!("a sweep in {}: {name}", case.lanes().expect("this processor has lanes").name()));
    for (name, ns) in names.chain(swept).zip(&medians[1..]) {
        println!("  {name:<44} {ns:6.2} ns, {:.4}; to intrinsics {:.2}", ns / gcc, ns / medians[1]);
    }
    let swept = &medians[medians.len() - cases.len()..];
    #[allow(clippy::disallowed_methods, reason = "for people only")]
    let mean = (swept.iter().map(|ns| (ns / gcc).ln()).sum::<f64>() / swept.len() as f64).exp();
    println!("  {:<44} {:9} {:.4} (geometric mean)", "all sweeps", "", mean);
}

/// The model alone, with all its guards.
fn program(method: Method) -> Program {
    let text = "import std.plant\nmodel Top {\n  part s = Servo(r = 1 m)\n}\n";
    let mut loaded = compiler::load("lanes.fric", text, &project::Disk);
    let changes = compiler::Changes { method: Some(method), ..compiler::Changes::default() };
    let built = compiler::build(&mut loaded, &project::Disk, "Top", &changes, &mut Vec::new());
    built.map_err(|found| format!("{found:?}")).expect("it compiles").program
}

/// A batch of instances at their start.
fn batch(lanes: &Lanes, program: &Program) -> Batch {
    let (code, _) = compiler::code(&compiler::functions(program, Method::Euler), &program.description, true);
    let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    let mass_at = program.description.quantity("s.m").expect("it is a parameter").slot;
    let mut batch = Batch::new(lanes.clone());
    for lane in 0..batch.width() {
        instance.set(mass_at, mass(lane));
        instance.start(H);
        batch.load(lane, instance.block());
    }
    batch
}

/// Runs of the experiment, as the command makes them.
fn sweep(case: &Varying, runs: usize, mass_at: Slot) {
    let mut left = 0..runs;
    let mut next = |_| match left.next() {
        Some(k) => {
            let fitted = case.at(&[(mass_at, mass(k))]).expect("the mass fits");
            Next::Run((), Box::new((fitted.instance, fitted.experiment)))
        }
        None => Next::Nothing,
    };
    let mut give = |(), result: Result<_, _>| _ = result.expect("it runs");
    run(case.lanes().expect("this processor has lanes"), &mut next, &mut give, &mut |_| Continue::Continue(()));
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
