//! Adaptive runs at equal error, against hand-written C with the same method: `cargo bench --bench adaptive`.
//!
//! Stick-slip to 20 s and hunting to 100 s. For each program the loosest tolerance is used for which the largest error
//! of position at 201 instants stays below 1e-6 or 1e-8 m. Times are the least of many, in processor time and not
//! wall-clock time, interleaved in one run; only their ratios are meaningful. Needs gcc, and CVODE of SUNDIALS for that
//! comparison; missing programs are reported. Then sweeps of hundreds of the same runs, each with another static
//! friction force: in lanes on one core, against the C program that makes one run after the other and reports its last
//! position. Ours are measured with that position alone, and with an extreme and an integral, for which they locate turning
//! points and evaluate the dense output.

#[path = "../clock.rs"]
mod clock;

use abi::Slot;
use abi::lanes::Lanes;
use abi::plan::{Experiment, Method};
use clock::processor_time;
use compiler::codegen::lanes::Width;
use compiler::{Case, Changes, NoSources, Options};
use runtime::engine::lanes::{self, Next};
use runtime::engine::{self, Continue, Failure, Outcome};
use std::path::{Path, PathBuf};
use std::process::Command;

const TEXT: &str = include_str!("bristle.fric");

const INSTANTS: usize = 200;
const ROUNDS: usize = 15;
/// Number of runs of the sweep.
const RUNS: usize = 512;
/// What a sweep measures besides the last position.
const MEASURED: [(&str, &str); 5] = [
    ("the last position", ""),
    ("and max(v)", "  expect max(v) > -1 m/s"),
    ("and rms(v)", "  expect rms(v) > 0 m/s"),
    ("and max(fr.F)", "  expect max(fr.F) > -1 N"),
    ("and max(v), rms(fr.F)", "  expect max(v) > -1 m/s  expect rms(fr.F) > 0 N"),
];

/// Seconds of a run, and positions.
type Timed = (f64, Vec<f64>);

fn main() {
    println!("processor seconds a run at equal error; ratios below 1: faster than C (gcc -O3 -march=native)");
    let diffsol = diffsol();
    if let Err(why) = &diffsol {
        println!("SKIPPED: diffsol: {why}");
    }
    let sundials = sundials();
    if let Err(why) = &sundials {
        println!("SKIPPED: CVODE: {why}");
    }
    for (name, define) in [("stick_slip", "-DHUNTING=0"), ("hunting", "-DHUNTING=1")] {
        let rosenbrock = match built("rosenbrock", define, &[], &["-lm"]) {
            Ok(program) => program,
            Err(why) => return println!("SKIPPED: {why}"),
        };
        let cvode = sundials.as_ref().ok().and_then(|(flags, libraries)| {
            let built = built("cvode", define, flags, libraries);
            built.map_err(|why| println!("SKIPPED: {why}")).ok()
        });
        let case = compiled(name);
        let run = |program: &Path, tol: f64, rounds: usize| -> Timed {
            timed(Command::new(program).args([tol.to_string(), rounds.to_string()]))
        };
        let c = |tol: f64, rounds: usize| run(&rosenbrock, tol, rounds);
        let ours = |tol: f64, rounds: usize| -> Timed {
            let instance = &case.instance;
            let mut experiment = Experiment { ..case.experiment.clone() };
            experiment.solver.tol = tol;
            let slot = instance.description().quantity("x").expect("there is a position").slot;
            let at = |k: usize| experiment.duration * k as f64 / INSTANTS as f64;
            let instants: Vec<f64> = (0..=INSTANTS).map(at).collect();
            let mut times = Vec::new();
            let mut positions = Vec::new();
            for _ in 0..rounds {
                let begin = processor_time();
                let slots: [Slot; 1] = [slot];
                let go_on = &mut |_| Continue::Continue(());
                let (values, ended) = engine::sample(instance.clone(), &experiment, &instants, &slots, go_on);
                times.push(processor_time() - begin);
                ended.expect("it runs to its end");
                positions = values;
            }
            (times.into_iter().fold(f64::INFINITY, f64::min), positions)
        };
        let (reference, other) = (c(1e-13, 1).1, ours(1e-13, 1).1);
        println!("{name}: both at tol 1e-13 differ by {:.1e} m", distance(&reference, &other));
        let mut tolerances = Vec::new();
        for error in [1e-6, 1e-8] {
            let (tol_ours, tol_c) = (loosest(&ours, &other, error), loosest(&c, &other, error));
            tolerances.push((tol_ours, tol_c));
            let tol_cvode =
                cvode.as_ref().map(|program| loosest(&|tol, rounds| run(program, tol, rounds), &other, error));
            let [mut best_ours, mut best_c, mut best_cvode] = [f64::INFINITY; 3];
            for _ in 0..9 {
                best_ours = best_ours.min(ours(tol_ours, ROUNDS).0);
                best_c = best_c.min(c(tol_c, ROUNDS).0);
                if let Some((program, tol)) = cvode.as_ref().zip(tol_cvode) {
                    best_cvode = best_cvode.min(run(program, tol, 1).0);
                }
            }
            println!(
                "  error {error:.0e} m: ours {:.3} ms (tol {tol_ours:.1e}); C with the same method {:.3} ms (tol {tol_c:.1e}), \
                 ratio {:.2}",
                1e3 * best_ours,
                1e3 * best_c,
                best_ours / best_c
            );
            if let Some(tol) = tol_cvode {
                println!("    CVODE {:.2} ms (tol {tol:.1e}), ratio {:.3}", 1e3 * best_cvode, best_ours / best_cvode);
            }
            if let Ok(program) = &diffsol {
                against_diffsol(name, program, &other, error, best_ours);
            }
        }
        for measured in MEASURED {
            sweep(name, measured, &rosenbrock, [tolerances[0], tolerances[1]]);
        }
    }
}

/// Runs of diffsol at equal error; reports its best method.
fn against_diffsol(name: &str, program: &Path, reference: &[f64], error: f64, ours: f64) {
    let mut best: Option<(f64, &str, f64)> = None;
    for method in ["bdf", "tr_bdf2", "esdirk34"] {
        let run = |tol: f64, rounds: usize| {
            let rounds = rounds.to_string();
            timed(Command::new(program).args([name, method, &tol.to_string(), &rounds]))
        };
        let Some(tol) = loosest_of(&run, reference, error) else {
            println!("    diffsol, {method}: no tolerance keeps the error");
            continue;
        };
        let seconds = (0..3).map(|_| run(tol, 1).0).fold(f64::INFINITY, f64::min);
        if best.is_none_or(|(least, ..)| seconds < least) {
            best = Some((seconds, method, tol));
        }
    }
    if let Some((seconds, method, tol)) = best {
        println!("    diffsol, {method}: {:.2} ms (tol {tol:.1e}), ratio {:.3}", 1e3 * seconds, ours / seconds);
    }
}

/// Runs another program and parses its output: seconds of a run, then positions.
fn timed(program: &mut Command) -> Timed {
    let text = String::from_utf8(program.output().expect("it was just built").stdout).expect("it prints numbers");
    let numbers: Vec<f64> = text.lines().map(|line| line.parse().expect("it prints numbers")).collect();
    (numbers[0], numbers[1..].to_vec())
}

/// Builds the diffsol program: a separate crate with a hundred dependencies, so only on request.
fn diffsol() -> Result<PathBuf, String> {
    if std::env::var_os("FRIC_DIFFSOL").is_none() {
        return Err("set FRIC_DIFFSOL=1 to build it and the hundred crates that it needs".into());
    }
    let manifest = format!("{}/benches/adaptive/diffsol/Cargo.toml", env!("CARGO_MANIFEST_DIR"));
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("diffsol");
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--release", "--quiet", "--manifest-path", &manifest, "--target-dir"]).arg(&target);
    cargo.env("RUSTFLAGS", "-C target-cpu=native");
    match cargo.status() {
        Ok(status) if status.success() => Ok(target.join("release/fric-bench-diffsol")),
        _ => Err(format!("{manifest} is not built")),
    }
}

/// Many runs in lanes, each with another static friction force; in C one after the other.
fn sweep(name: &str, (measured, expects): (&str, &str), rosenbrock: &Path, tolerances: [(f64, f64); 2]) {
    let last = "expect final(x) > 0 m";
    let text = TEXT.replace(last, &format!("{last}{expects}")).replace("  expect", "\n  expect");
    let mut loaded = compiler::load("bench", &text, &NoSources);
    let changes = Changes { vary: vec!["fr.rise".into()], ..Changes::default() };
    let options = Options { changes, ..Options::default() };
    let varying = compiler::varying(&mut loaded, &NoSources, name, &options, &mut Vec::new());
    let varying = varying.unwrap_or_else(|found| panic!("{found:?}")).remove(0);
    let slot = varying.param("fr.rise").expect("it is a parameter").slot;
    let changes = Changes { vary: vec!["fr.rise".into()], ..Changes::default() };
    let built = compiler::build(&mut loaded, &NoSources, name, &changes, &mut Vec::new());
    let program = built.unwrap_or_else(|found| panic!("{found:?}")).program;
    let widths = Width::ALL.into_iter().filter(|width| width.is_here());
    let kinds = widths.flat_map(|width| [1, 2, 3].map(|vectors| (width, vectors)));
    let codes: Vec<Lanes> = kinds
        .filter_map(|(width, vectors)| compiler::codegen::tiering::lanes_of(&program, Method::Adaptive, width, vectors))
        .collect();
    for (tol_ours, tol_c) in tolerances {
        let run = |k: usize| {
            let rise = 0.5 * (0.9 + 0.2 * k as f64 / RUNS as f64);
            let fitted = varying.at(&[(slot, rise)]).expect("any rise will do");
            let mut experiment = fitted.experiment;
            experiment.solver.tol = tol_ours;
            (fitted.instance, experiment)
        };
        let in_lanes = |code: &Lanes| {
            let mut last = vec![f64::NAN; RUNS];
            let mut runs = 0..RUNS;
            let begin = processor_time();
            let mut next = |_| runs.next().map_or(Next::Nothing, |k| Next::Run(k, Box::new(run(k))));
            let mut give = |k: usize, outcome: Result<Outcome, Failure>| {
                last[k] = outcome.expect("it runs to its end").verdicts[0].readings[0].value;
            };
            lanes::run(code, &mut next, &mut give, &mut |_| Continue::Continue(()));
            ((processor_time() - begin) / RUNS as f64, last)
        };
        let in_c = || timed(Command::new(rosenbrock).args([&tol_c.to_string(), &RUNS.to_string(), "sweep"]));
        let alone = {
            let (instance, experiment) = run(7);
            let outcome = engine::run(instance, &experiment, &mut |_| Continue::Continue(())).expect("it runs");
            outcome.verdicts[0].readings[0].value
        };
        let (mut best, mut best_c) = (vec![f64::INFINITY; codes.len()], f64::INFINITY);
        let mut off = 0.0;
        for _ in 0..5 {
            let c = in_c();
            best_c = best_c.min(c.0);
            for (code, best) in codes.iter().zip(&mut best) {
                let ours = in_lanes(code);
                assert_eq!(ours.1[7].to_bits(), alone.to_bits(), "a run in a lane is that alone");
                *best = best.min(ours.0);
                off = distance(&ours.1, &c.1);
            }
        }
        println!(
            "{name}, {RUNS} runs on one core, {measured}, tol {tol_ours:.1e}, in C {tol_c:.1e}: last positions differ by {off:.1e} m; C \
             {:.4} ms a run",
            1e3 * best_c
        );
        for (code, best) in codes.iter().zip(&best) {
            println!("    in lanes, {}: {:.4} ms a run, ratio {:.3}", code.name(), 1e3 * best, best / best_c);
        }
    }
}

/// Builds one of the C programs; returns its path.
fn built(name: &str, define: &str, flags: &[String], libraries: &[impl AsRef<str>]) -> Result<PathBuf, String> {
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}{define}"));
    let source = format!("{}/benches/adaptive/{name}.c", env!("CARGO_MANIFEST_DIR"));
    let mut gcc = Command::new("gcc");
    gcc.args(["-O3", "-march=native", "-std=gnu11", define]).args(flags).arg(&source);
    gcc.args(libraries.iter().map(AsRef::as_ref)).arg("-o").arg(&program);
    match gcc.status() {
        Ok(status) if status.success() => Ok(program),
        _ => Err(format!("gcc is needed to build {source}")),
    }
}

/// Options with which gcc finds SUNDIALS: installed, or unpacked from Debian's package into the build folder.
fn sundials() -> Result<(Vec<String>, Vec<String>), String> {
    const LIBRARIES: [&str; 5] = ["cvode", "nvecserial", "sunlinsoldense", "sunmatrixdense", "generic"];
    let mut prefix = PathBuf::from("/usr");
    if !prefix.join("include/cvode/cvode.h").exists() {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("sundials");
        prefix = folder.join("usr");
        if !prefix.join("include/cvode/cvode.h").exists() {
            std::fs::create_dir_all(&folder).map_err(|error| error.to_string())?;
            let got = "apt-get -qq download libsundials-dev && dpkg -x libsundials-dev_*.deb .";
            let done = Command::new("sh").args(["-c", got]).current_dir(&folder).status();
            if !done.is_ok_and(|status| status.success()) {
                return Err("install libsundials-dev (Debian)".into());
            }
        }
    }
    let libraries = format!("-L{}/lib/{}-linux-gnu", prefix.display(), std::env::consts::ARCH);
    let named = LIBRARIES.iter().map(|name| format!("-l:libsundials_{name}.a"));
    let libraries = [libraries].into_iter().chain(named).chain(["-lm".into()]).collect();
    Ok((vec![format!("-I{}/include", prefix.display())], libraries))
}

fn compiled(name: &str) -> Case {
    let mut loaded = compiler::load("bench", TEXT, &NoSources);
    let options = Options { changes: Changes::default(), ..Options::default() };
    let cases = compiler::compile(&mut loaded, &NoSources, name, &options, &mut Vec::new(), &mut |_| ());
    let cases = cases.unwrap_or_else(|found| panic!("{found:?}"));
    cases.into_iter().next().expect("one case")
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    // NaN counts as an infinite error.
    let off = |(a, b): (&f64, &f64)| Some((a - b).abs()).filter(|off| !off.is_nan()).unwrap_or(f64::INFINITY);
    a.iter().zip(b).map(off).fold(0.0, f64::max)
}

/// The loosest tolerance of 1e-3, 1e-3.1, … that keeps the error, as does the next one.
fn loosest(run: &dyn Fn(f64, usize) -> Timed, reference: &[f64], error: f64) -> f64 {
    loosest_of(run, reference, error).unwrap_or_else(|| panic!("no tolerance keeps an error of {error}"))
}

/// As `loosest`, if there is one.
fn loosest_of(run: &dyn Fn(f64, usize) -> Timed, reference: &[f64], error: f64) -> Option<f64> {
    let mut tol = 1e-3;
    let mut before = false;
    while tol > 1e-13 {
        let good = distance(&run(tol, 1).1, reference) <= error;
        if good && before {
            return Some(tol / 0.794_328_234_724_281_5);
        }
        before = good;
        tol *= 0.794_328_234_724_281_5;
    }
    None
}
