//! Generated tests: seeds and counts from the environment, the loop over seeds, and the simplification of failing cases.
//!
//! `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number, from `FRIC_FIRST=n` on. With `FRIC_COUNT=1` failures are
//! counted and the runs continue. `FRIC_MUTANT` is set where a planted mistake must be found: its failure is not simplified.

use std::fmt::Debug;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Most cases that are tried to simplify one.
const MOST: usize = 400;

/// The number in an environment variable; none if it is not set or no number.
pub fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().and_then(|text| text.parse().ok())
}

/// The seeds of a test; `runs`: their number if the environment sets none.
pub fn seeds(runs: u64) -> Range<u64> {
    match number("FRIC_SEED") {
        Some(seed) => seed..seed + 1,
        None => {
            let first = number("FRIC_FIRST").unwrap_or(0);
            first..first + number("FRIC_RUNS").unwrap_or(runs)
        }
    }
}

/// Runs the case of each seed; `passed` receives the result of each that holds. The first failure ends the test, simplified by
/// `shrunk`. If failures are only counted, returns their seeds.
pub fn hold<C: Debug, T>(
    seeds: Range<u64>,
    of: impl Fn(u64) -> C,
    run: impl Fn(&C) -> Result<T, String>,
    shrunk: impl Fn(&C, String) -> (C, String),
    mut passed: impl FnMut(T),
) -> Vec<u64> {
    let counts_only = number("FRIC_COUNT").is_some();
    let mut failed = Vec::new();
    for seed in seeds {
        let case = of(seed);
        match run(&case) {
            Ok(result) => passed(result),
            Err(why) if counts_only => {
                println!("seed {seed}: {why}\n  {case:?}");
                failed.push(seed);
            }
            Err(why) if std::env::var_os("FRIC_MUTANT").is_some() => {
                println!("mutant caught with seed {seed}: {why}");
                panic!("seed {seed}");
            }
            Err(why) => {
                let (case, why) = shrunk(&case, why);
                panic!("FRIC_SEED={seed} repeats it: {why}\n{case:?}");
            }
        }
    }
    failed
}

/// Runs the case of each seed on so many threads; the results come in no fixed order.
pub fn on_threads<T: Send>(seeds: Range<u64>, threads: usize, run: impl Fn(u64) -> T + Sync) -> Vec<(u64, T)> {
    let (next, found) = (AtomicU64::new(seeds.start), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= seeds.end {
                        return;
                    }
                    let result = run(seed);
                    found.lock().unwrap().push((seed, result));
                }
            });
        }
    });
    found.into_inner().unwrap()
}

/// The failures among the results of seeds, in words, each with its case.
pub fn failures<C: Debug, T>(found: &[(u64, Result<T, String>)], of: impl Fn(u64) -> C) -> Vec<String> {
    let failed = found.iter().filter_map(|(seed, result)| Some((seed, result.as_ref().err()?)));
    let failed: Vec<String> =
        failed.map(|(seed, why)| format!("FRIC_SEED={seed} repeats it: {why}\n{:?}", of(*seed))).collect();
    if let Some(first) = failed.first() {
        println!("mutant caught: {first}");
    }
    failed
}

/// Simplifies a failing case while it still fails (delta debugging: Zeller, Hildebrandt, "Simplifying and isolating
/// failure-inducing input", 2002). `simpler`: cases that are simpler in one respect, the largest simplification first.
pub fn shrunk<C: Clone + PartialEq, T, E>(
    case: &C,
    why: E,
    simpler: impl Fn(&C) -> Vec<C>,
    run: impl Fn(&C) -> Result<T, E>,
) -> (C, E) {
    let (mut best, mut how, mut left) = (case.clone(), why, MOST);
    'again: loop {
        for smaller in simpler(&best).into_iter().filter(|smaller| *smaller != best).take(left) {
            left -= 1;
            if let Err(why) = run(&smaller) {
                (best, how) = (smaller, why);
                continue 'again;
            }
        }
        return (best, how);
    }
}

/// A case after each of these changes by itself.
pub fn changed<C: Clone>(case: &C, changes: &[fn(&mut C)]) -> Vec<C> {
    let one = |change: &fn(&mut C)| {
        let mut other = case.clone();
        change(&mut other);
        other
    };
    changes.iter().map(one).collect()
}
