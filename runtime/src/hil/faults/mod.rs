//! The fault space: generated rigs with generated faults (property-based fault injection), and properties that hold at
//! every tick of each run.
//!
//! One seed is one run, deterministic in simulated time. A failure is shrunk to a script that is printed as a test.
//!
//! `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number, from `FRIC_FIRST=n` on; `FRIC_PAIRS=all` runs all
//! combinations of two faults; with `FRIC_COUNT=1` failures are counted by property and the runs continue.

mod rigs;
mod space;
mod heap;
mod broken;
mod wire;
mod invariants;
mod run;
mod shrink;
mod scripts;
mod loops;

use crate::testing::generated::{number, seeds};
use invariants::Violation;
use rigs::Sort;
use space::{EVER, Fault, Ill, MS, Phase, Script, What};
use std::collections::BTreeMap;

/// Seeds in `cargo test`.
const RUNS: u64 = 200;
/// `cargo test` runs every 40th combination of two faults.
const STRIDE: usize = 40;

/// Runs a script of faults; panics with the script as a test if a property is violated.
fn holds(script: &Script) {
    if let Err(violation) = run::run(script) {
        panic!("{}", told(script, violation));
    }
}

/// Shrinks a failure and formats it as text that can be pasted.
fn told(script: &Script, violation: Violation) -> String {
    let (least, how) = shrink::shrink(script, violation, |script| run::run(script).map(drop));
    let Violation { broken, at_ns, text } = how;
    format!("{broken:?} after {:.3} ms: {text}\n{least}", at_ns as f64 / 1e6)
}

/// Runs scripts; stops at the first failure, or counts failures.
fn all(scripts: impl Iterator<Item = Script>) {
    let counts_only = number("FRIC_COUNT").is_some();
    let mut failed: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    let (mut runs, mut cycles, mut phases) = (0u64, 0u64, [0u64; Phase::ALL.len()]);
    for script in scripts {
        runs += 1;
        match run::run(&script) {
            Ok(passed) => {
                cycles += passed.cycles;
                phases.iter_mut().zip(passed.phases).for_each(|(all, one)| *all += u64::from(one));
            }
            Err(violation) if counts_only => {
                let name = format!("{:?}", violation.broken);
                let seeds = failed.entry(name).or_default();
                if seeds.len() < 3 {
                    println!("seed {}: {}\n", script.seed, told(&script, violation));
                }
                seeds.push(script.seed);
            }
            Err(violation) if std::env::var_os("FRIC_MUTANT").is_some() => {
                println!("mutant caught with seed {}: {violation:?}", script.seed);
                panic!("seed {}", script.seed);
            }
            Err(violation) => panic!("FRIC_SEED={} repeats it: {}", script.seed, told(&script, violation)),
        }
    }
    println!("{runs} runs, {cycles} cycles; phases {phases:?}");
    for (name, seeds) in &failed {
        println!("{name}: {} of {runs}, seeds {:?}", seeds.len(), &seeds[..seeds.len().min(20)]);
    }
    assert!(failed.is_empty(), "{} properties are broken", failed.len());
}

#[test]
fn random_faults_break_no_property() {
    all(seeds(RUNS).map(Script::of));
}

/// All pairs of faults in a small rig's frames, in one phase and for ever.
fn pairs(phase: Phase) -> Vec<[Fault; 2]> {
    let (frames, often) = space::frames(Sort::One);
    let whole = matches!(phase, Phase::StartUp | Phase::Enabling);
    let frames = if whole { &frames[..] } else { &frames[..often] };
    let fault = |what| Fault { what, phase, after: 3 * MS, lasts: EVER };
    let single: Vec<Fault> =
        (frames.iter()).flat_map(|(bus, id)| Ill::ALL.map(|ill| fault(What::Frame(*bus, *id, ill)))).collect();
    let pair = |at: usize| single[at + 1..].iter().map(|other| [single[at], *other]).collect::<Vec<_>>();
    (0..single.len()).flat_map(pair).collect()
}

#[test]
fn two_faults_of_a_small_rig_break_no_property() {
    let stride = if std::env::var_os("FRIC_PAIRS").is_some() { 1 } else { STRIDE };
    let scripts = Phase::ALL.iter().flat_map(|phase| pairs(*phase)).step_by(stride);
    all(scripts.enumerate().map(|(at, pair)| {
        let again = pair[0].phase == Phase::Again;
        Script { seed: at as u64, again, faults: pair.to_vec(), ..Script::plain(Sort::One) }
    }));
}

#[test]
fn every_sort_of_rig_runs_through_without_a_fault() {
    for sort in Sort::ALL {
        for tested in [false, true] {
            let script = Script { tested, again: true, ..Script::plain(sort) };
            let passed = run::run(&script).unwrap_or_else(|violation| panic!("{sort:?}: {}", told(&script, violation)));
            let once = Phase::ALL.map(|phase| passed.phases[Phase::ALL.iter().position(|p| *p == phase).unwrap()]);
            assert_eq!(once, [1; Phase::ALL.len()], "{sort:?} goes through all phases");
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    for seed in 0..6 {
        let script = Script::of(seed);
        let [one, two] = [0, 1].map(|_| run::run(&script).map_err(|violation| violation.broken));
        assert_eq!(one, two, "seed {seed}");
    }
}

/// Protections that other generators cover: processes that end or stall, failing disks, reactions that take longer than
/// a run of the fault space, and shafts and contacts that deviate from their model.
#[cfg(feature = "mutants")]
const OUTSIDE: [(&str, &str); 10] = [
    ("table", "hil::endings"),
    ("own-stack", "hil::endings"),
    ("unhurried", "hil::disks"),
    ("counted", "hil::disks"),
    ("plain", "hil::contacts"),
    ("energy", "hil::contacts"),
    ("loop", "hil::faults::loops"),
    ("bites", "hil::stalls"),
    ("hushed", "hil::stalls"),
    ("life", "hil::kills"),
];

/// Mutation test: without any one protection its generator must fail. `FRIC_ONLY=name` tests a single protection.
#[cfg(feature = "mutants")]
#[test]
fn mutants_are_caught_by_the_fault_space() {
    let only = std::env::var("FRIC_ONLY").ok();
    let all = crate::safety::Protection::ALL.iter().map(|(name, _)| *name);
    let mut missed = Vec::new();
    for name in all.filter(|name| only.as_deref().is_none_or(|only| only == *name)) {
        let mut test = std::process::Command::new(std::env::current_exe().unwrap());
        let (generator, runs) = match OUTSIDE.iter().find(|(outside, _)| *outside == name) {
            Some((_, generator)) => (*generator, "100"),
            None => ("hil::faults::random_faults", "4000"),
        };
        test.args([generator, "--nocapture"]).env("FRIC_MUTANT", name).env("FRIC_RUNS", runs);
        let out = test.output().unwrap();
        let text = [out.stdout, out.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
        let why = text.lines().find(|line| line.starts_with("mutant")).unwrap_or_default();
        println!("{name}: {why}");
        if out.status.success() {
            missed.push(name);
        }
    }
    assert!(missed.is_empty(), "nothing notices that these are missing: {missed:?}");
}
