//! Tiered code: a run has the bits of the interpreter whenever its functions are compiled, by the run itself or by
//! another thread beside it: experiments of the library by every method, and random texts, each with functions that are
//! compiled after a random number of calls, or never.
//!
//! Mutants tried by hand, each fails with seed 2: a call that the interpreter began starts over once there is code; its
//! rest is dropped.
//!
//! `FRIC_SEED`, `FRIC_RUNS` (default 120 runs).

#[allow(dead_code, reason = "the agreement of back ends uses all of it")]
#[path = "agreement/generate.rs"]
mod generate;
mod support;

use abi::plan::Method;
use abi::{Function, Instance};
use compiler::Changes;
use compiler::codegen::tiering::{Policy, tiered};
use compiler::experiment::Variant;
use compiler::ir::random::Random;
use runtime::engine::Continue;
use std::sync::Arc;
use support::Texts;

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name} is a whole number")))
}

/// The first combination of an experiment; none if it cannot be stepped by this method.
fn variant(name: &str, text: &str, experiment: &str, changes: Changes) -> Option<Variant> {
    let sources = Texts::default();
    let mut loaded = compiler::load(name, text, &sources);
    let read = compiler::experiment::read(&mut loaded, &sources, experiment, &changes, &mut Vec::new(), &mut |_| ());
    read.ok()?.into_iter().next().filter(|variant| variant.rig.is_none())
}

/// The final block, what was measured, and how the run ended.
fn run(variant: &Variant, policy: Policy) -> (Vec<u64>, String) {
    let (program, method) = (&variant.program, variant.experiment.solver.method);
    let code = tiered(program, method, policy);
    let instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    let mut watch = |_| Continue::Continue(());
    let (instance, ended) = runtime::engine::run_on(instance, &variant.experiment, &mut |_| (), &mut watch);
    let ended = ended.map(|outcome| (outcome.verdicts, outcome.work.steps)).map_err(|failure| failure.to_string());
    (instance.block().iter().map(bits).collect(), format!("{ended:?}"))
}

/// The status of each of several calls for so many steps, and the block after it.
fn advanced(variant: &Variant, policy: Policy, calls: &[u64]) -> Vec<(u64, Vec<u64>)> {
    let (program, solver) = (&variant.program, variant.experiment.solver);
    let code = tiered(program, solver.method, policy);
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
    let compiled_after = Function::ALL.map(|_| match random.below(4) {
        0 => None,
        1 => Some(random.below(4) as u64),
        2 => Some(random.below(100) as u64),
        _ => Some(random.below(1000) as u64),
    });
    let runs_between_looks = 1 + random.below(8) as u64;
    Policy { compiled_after, runs_between_looks, in_background: random.below(2) == 0 }
}

#[test]
fn the_bits_of_a_run_do_not_depend_on_when_its_functions_are_compiled() {
    let folders = ["stdlib-models", "tests/stdlib"];
    let library: Vec<_> =
        folders.iter().flat_map(|folder| support::texts_below(&support::root().join(folder))).collect();
    let seeds = number("FRIC_SEED").map_or(0..number("FRIC_RUNS").unwrap_or(120), |seed| seed..seed + 1);
    let (mut runs, mut compiled) = (0, 0);
    for seed in seeds.clone() {
        let mut random = Random(seed);
        let (name, text, experiment) = match seed % 3 {
            0 => (format!("random text {seed}"), generate::text(seed).text, "e".to_string()),
            _ => {
                let (path, text) = &library[random.below(library.len())];
                let loaded = compiler::load("library.fric", text, &Texts::default());
                let all = loaded.experiments();
                if all.is_empty() {
                    continue;
                }
                (path.display().to_string(), text.clone(), all[random.below(all.len())].name.clone())
            }
        };
        let method = Method::ALL[random.below(Method::ALL.len())];
        let step = (method != Method::Adaptive).then_some(1e-3);
        let changes = Changes { method: Some(method), step, duration: Some(0.5), ..Changes::default() };
        let Some(mut variant) = variant(&name, &text, &experiment, changes) else { continue };
        if random.below(2) == 0 {
            // Then many steps are one call.
            variant.experiment.plots.clear();
            variant.experiment.expects.clear();
        }
        let expected = run(&variant, Policy::NEVER);
        let policy = policy(&mut random);
        compiled += u64::from(policy.compiled_after.iter().flatten().any(|after| *after < 100));
        let found = run(&variant, policy.clone());
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
        let (found, expected) = (advanced(&variant, policy.clone(), &calls), advanced(&variant, Policy::NEVER, &calls));
        assert_eq!(found, expected, "FRIC_SEED={seed} repeats it: {name}, {experiment}, {calls:?}, {policy:?}");
    }
    let all = seeds.end - seeds.start;
    assert!(all == 1 || 2 * runs >= all && 2 * compiled >= all, "{runs} runs of {all} seeds, {compiled} with code");
}
