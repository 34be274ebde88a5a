//! Tiered code: a run has the bits of the interpreter whenever its functions are compiled, by the run itself or by
//! another thread beside it: experiments of the library by every method, and random texts, each with functions that are
//! compiled after a random number of calls, or never. A step that leaves out outputs which nothing reads keeps all other
//! bits too.
//!
//! Mutants tried by hand. Each fails with seed 2: a call that the interpreter began starts over once there is code; its
//! rest is dropped. Each fails within the default seeds: a step that leaves out outputs drops its guards of ranges; the
//! last step of a run leaves them out too; a run that reads an output which its slice leaves out takes the slice; the times
//! of a series are those after it.
//!
//! `FRIC_SEED`, `FRIC_RUNS` (default 120 runs).

#[allow(dead_code, reason = "the agreement of back ends uses all of it")]
#[path = "agreement/generate.rs"]
mod generate;
mod support;

use abi::description::Guard;
use abi::plan::Method;
use abi::table::Code;
use abi::{Function, Instance, Slice, Slot};
use compiler::Changes;
use compiler::codegen::tiering::{Policy, tiered};
use compiler::experiment::Variant;
use compiler::ir::program::Program;
use compiler::ir::random::Random;
use runtime::engine::{Cause, Continue, Failure};
use runtime::record::Recording;
use std::path::PathBuf;
use std::sync::Arc;
use support::{Texts, number};

/// The first combination of an experiment; none if it cannot be stepped by this method.
fn variant(name: &str, text: &str, experiment: &str, changes: Changes) -> Option<Variant> {
    let sources = Texts::default();
    let mut loaded = compiler::load(name, text, &sources);
    let read = compiler::experiment::read(&mut loaded, &sources, experiment, &changes, &mut Vec::new(), &mut |_| ());
    read.ok()?.into_iter().next().filter(|variant| variant.rig.is_none())
}

/// The reference, or tiered code.
fn code(variant: &Variant, policy: Option<Policy>) -> Code {
    let (program, method) = (&variant.program, variant.experiment.solver.method);
    match policy {
        Some(policy) => tiered(program, method, policy),
        None => compiler::code(&compiler::functions(program, method), &program.description, true).0,
    }
}

/// Runs an experiment. Returns the bits of the final block, the verdicts or why it failed, and the recording.
fn run(variant: &Variant, policy: Option<Policy>) -> (Vec<u64>, String, Recording) {
    let (program, code) = (&variant.program, code(variant, policy));
    let instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    let mut watch = |_| Continue::Continue(());
    let (instance, ended) = runtime::engine::run_on(instance, &variant.experiment, &mut |_| (), &mut watch);
    let (ended, recording) = match ended {
        Ok(outcome) => (format!("{:?}", (outcome.verdicts, outcome.work.steps)), outcome.recording),
        Err(failure) => (failure.to_string(), failure.recording),
    };
    (instance.block().iter().map(bits).collect(), ended, recording)
}

/// The status of each of several calls for so many steps, and the block after it.
fn advanced(variant: &Variant, policy: Option<Policy>, calls: &[u64]) -> Vec<(u64, Vec<u64>)> {
    let (program, solver) = (&variant.program, variant.experiment.solver);
    let code = code(variant, policy);
    let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    instance.start(solver.step);
    let mut call = |count: &u64| (instance.advance(*count), instance.block().iter().map(bits).collect());
    calls.iter().map(&mut call).collect()
}

/// All NaN count as one value.
fn bits(x: &f64) -> u64 {
    if x.is_nan() { f64::NAN.to_bits() } else { x.to_bits() }
}

/// Functions that are compiled after a random number of runs, most often within the run.
fn policy(random: &mut Random) -> Policy {
    let mut thresholds = || {
        Function::ALL.map(|_| match random.below(4) {
            0 => None,
            1 => Some(random.below(4) as u64),
            2 => Some(random.below(100) as u64),
            _ => Some(random.below(1000) as u64),
        })
    };
    let (baseline_after, compiled_after) = (thresholds(), thresholds());
    let runs_between_looks = 1 + random.below(8) as u64;
    Policy { baseline_after, compiled_after, runs_between_looks, in_background: random.below(2) == 0 }
}

/// A seed's experiment of the library, or a random text: name, text, experiment.
fn subject(seed: u64, library: &[(PathBuf, String)], random: &mut Random) -> Option<(String, String, String)> {
    if seed.is_multiple_of(3) {
        return Some((format!("random text {seed}"), generate::text(seed).text, "e".to_string()));
    }
    let (path, text) = &library[random.below(library.len())];
    let loaded = compiler::load("library.fric", text, &Texts::default());
    let all = loaded.experiments();
    let one = (!all.is_empty()).then(|| all[random.below(all.len())].name.clone())?;
    Some((path.display().to_string(), text.clone(), one))
}

/// The texts of the library and of its tests.
fn library() -> Vec<(PathBuf, String)> {
    let folders = ["stdlib-models", "tests/stdlib"];
    folders.iter().flat_map(|folder| support::texts_below(&support::root().join(folder))).collect()
}

/// An instance whose fixed step leaves out these outputs, and one whose step has all.
fn with_slice(variant: &Variant, left_out: Vec<Slot>, is_compiled: bool) -> [Instance; 2] {
    let (program, method) = (&variant.program, variant.experiment.solver.method);
    let code =
        |program: &Program| compiler::code(&compiler::functions(program, method), &program.description, !is_compiled).0;
    let all = Instance::new(Arc::new(program.description.clone()), code(program), &program.params);
    let sliced = Program { left_out: left_out.clone(), ..program.clone() };
    [all.clone().with_slice(Slice { code: code(&sliced), left_out: left_out.into() }), all]
}

#[test]
fn a_step_without_outputs_that_nothing_reads_keeps_all_other_bits() {
    let library = library();
    let seeds = number("FRIC_SEED").map_or(0..number("FRIC_RUNS").unwrap_or(120), |seed| seed..seed + 1);
    let (mut compared, mut stopped, mut excused) = (0, 0, 0);
    for seed in seeds.clone() {
        let mut random = Random(seed);
        let Some((name, text, experiment)) = subject(seed, &library, &mut random) else { continue };
        let fixed: Vec<Method> = Method::fixed().collect();
        let method = fixed[random.below(fixed.len())];
        let changes = Changes { method: Some(method), step: Some(1e-3), duration: Some(0.5), ..Changes::default() };
        let Some(variant) = variant(&name, &text, &experiment, changes) else { continue };
        // All that can be left out, or some.
        let some = random.below(2) == 0;
        let left_out: Vec<Slot> =
            variant.program.outputs_for_readers().filter(|_| !some || random.below(2) == 0).collect();
        if left_out.is_empty() {
            continue;
        }
        let is_open = |guard: &Guard| guard.range == (f64::NEG_INFINITY, f64::INFINITY);
        let guards = &variant.program.description.guards;
        assert!(
            guards.iter().all(|guard| is_open(guard) || !left_out.contains(&guard.slot)),
            "{name} keeps its ranges"
        );
        let is_compiled = random.below(4) > 0;
        let [mut sliced, mut all] = with_slice(&variant, left_out.clone(), is_compiled);
        let at =
            || format!("FRIC_SEED={seed} repeats it: {name}, {experiment}, {}, without {left_out:?}", method.name());
        assert_eq!(sliced.start(1e-3), all.start(1e-3), "{}", at());
        sliced.read_only(None);
        assert_eq!(sliced.left_out(), left_out);
        compared += 1;
        for _ in 0..20 {
            let count = 1 + random.below(30) as u64;
            let [found, expected] = [&mut sliced, &mut all].map(|instance| instance.advance(count));
            let guard = expected.checked_sub(1).map(|k| &all.description().guards[k as usize]);
            if guard.is_some_and(|guard| left_out.contains(&guard.slot)) {
                excused += 1;
                break;
            }
            assert_eq!(found, expected, "{}", at());
            let differs = |(slot, (a, b)): (usize, (&f64, &f64))| {
                let is_left_out = left_out.contains(&Slot(slot as u32));
                (!is_left_out && bits(a) != bits(b)).then(|| format!("slot {slot}: {a}, not {b}"))
            };
            let differences: Vec<String> =
                sliced.block().iter().zip(all.block()).enumerate().filter_map(differs).collect();
            assert!(differences.is_empty(), "{}: {}", at(), differences.join(", "));
            if expected != 0 {
                stopped += 1;
                break;
            }
            let [found, expected] = [sliced.advance_in_full(), all.advance(1)];
            let blocks = [&sliced, &all].map(|instance| instance.block().iter().map(bits).collect::<Vec<_>>());
            assert_eq!((found, &blocks[0]), (expected, &blocks[1]), "in full; {}", at());
            if found != 0 {
                break;
            }
        }
    }
    println!("{compared} programs, {stopped} stopped by a guard, {excused} by that of an output that was left out");
    assert!(seeds.end - seeds.start == 1 || compared >= 30, "{compared} programs have such outputs");
}

#[test]
fn a_run_that_reads_no_outputs_has_the_results_of_one_that_computes_them_all() {
    let library = library();
    let seeds = number("FRIC_SEED").map_or(0..number("FRIC_RUNS").unwrap_or(120), |seed| seed..seed + 1);
    let (mut compared, mut excused) = (0, 0);
    for seed in seeds.clone() {
        let mut random = Random(seed);
        let Some((name, text, experiment)) = subject(seed, &library, &mut random) else { continue };
        let fixed: Vec<Method> = Method::fixed().collect();
        let method = fixed[random.below(fixed.len())];
        let changes = Changes { method: Some(method), step: Some(1e-3), duration: Some(6.0), ..Changes::default() };
        let Some(mut variant) = variant(&name, &text, &experiment, changes) else { continue };
        // Fewer readers than the text has.
        let whole = variant.experiment.clone();
        variant.experiment.plots.retain(|_| random.below(2) == 0);
        variant.experiment.expects.retain(|_| random.below(2) == 0);
        let read = variant.experiment.reads();
        let left_out: Vec<Slot> = variant.program.outputs_for_readers().filter(|slot| !read.contains(slot)).collect();
        if left_out.is_empty() {
            continue;
        }
        // A run may read more than its slice stores, as when its data are written.
        if random.below(3) == 0 {
            variant.experiment = whole;
        }
        let ended = with_slice(&variant, left_out.clone(), true).map(|instance| {
            let mut watch = |_| Continue::Continue(());
            let (instance, ended) = runtime::engine::run_on(instance, &variant.experiment, &mut |_| (), &mut watch);
            let bits: Vec<u64> = instance.block().iter().map(bits).collect();
            (ended.map(|outcome| (outcome.verdicts, outcome.finals, outcome.recording)), bits)
        });
        compared += 1;
        let [sliced, all] = ended;
        // An output that nothing reads need not be finite for the length of a batch.
        if let Err(Failure { cause: Cause::NotFinite { path, .. }, .. }) = &all.0
            && variant.program.description.quantity(path).is_some_and(|quantity| left_out.contains(&quantity.slot))
        {
            excused += 1;
            continue;
        }
        let shown = |ended: &(Result<_, Failure>, Vec<u64>)| format!("{ended:?}");
        assert!(shown(&sliced) == shown(&all), "FRIC_SEED={seed} repeats it: {name}, {experiment}, {}", method.name());
    }
    println!("{compared} experiments with outputs that nothing reads, {excused} with one that was not finite");
    assert!(seeds.end - seeds.start == 1 || compared >= 30, "{compared} experiments have such outputs");
}

#[test]
fn the_bits_of_a_run_do_not_depend_on_when_its_functions_are_compiled() {
    let library = library();
    let seeds = number("FRIC_SEED").map_or(0..number("FRIC_RUNS").unwrap_or(120), |seed| seed..seed + 1);
    let (mut runs, mut compiled) = (0, 0);
    for seed in seeds.clone() {
        let mut random = Random(seed);
        let Some((name, text, experiment)) = subject(seed, &library, &mut random) else { continue };
        let method = Method::ALL[random.below(Method::ALL.len())];
        let step = (method != Method::Adaptive).then_some(1e-3);
        let changes = Changes { method: Some(method), step, duration: Some(0.5), ..Changes::default() };
        let Some(mut variant) = variant(&name, &text, &experiment, changes) else { continue };
        if random.below(2) == 0 {
            // Then many steps are one call.
            variant.experiment.plots.clear();
            variant.experiment.expects.clear();
        }
        let expected = run(&variant, None);
        let policy = policy(&mut random);
        compiled += u64::from(policy.compiled_after.iter().flatten().any(|after| *after < 100));
        let found = run(&variant, Some(policy.clone()));
        assert_eq!(found, expected, "FRIC_SEED={seed} repeats it: {name}, {experiment}, {}, {policy:?}", method.name());
        runs += 1;
        if method == Method::Adaptive {
            continue;
        }
        // Many short calls, in one of which the step is compiled.
        let calls: Vec<u64> = (0..20).map(|_| 1 + random.below(6) as u64).collect();
        let after = Some(random.below(60) as u64);
        let mut policy = Policy { runs_between_looks: 1 + random.below(3) as u64, in_background: false, ..policy };
        policy.compiled_after[Function::Step as usize] = after;
        let found = advanced(&variant, Some(policy.clone()), &calls);
        let expected = advanced(&variant, None, &calls);
        assert_eq!(found, expected, "FRIC_SEED={seed} repeats it: {name}, {experiment}, {calls:?}, {policy:?}");
    }
    let all = seeds.end - seeds.start;
    assert!(all == 1 || 2 * runs >= all && 2 * compiled >= all, "{runs} runs of {all} seeds, {compiled} with code");
}
