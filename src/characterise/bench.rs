//! Compiles and runs the experiments of a text, in parallel.
//!
//! In: a text. Out: for each experiment the recordings of its cases, or why there are none. A model that chatters at
//! rest is run again with a fixed step, and the text then contains that step.

use crate::compile::{self, Changes, Loaded, Options};
use crate::report;
use runtime::engine::{self, Cause, Continue, Failure, Outcome};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

/// An adaptive run of a small model is abandoned after 64 times this many step attempts: twenty times what any test
/// should need. For a model with more than eight states a step costs more, and the limit is lower.
const MOST_LOOKS: usize = 1000;

/// The result of one case of an experiment.
pub struct Ran {
    /// `speed = 1 mm/s`; empty without a sweep.
    pub label: String,
    /// How it ended.
    pub result: Result<Outcome, Failure>,
}

impl Ran {
    /// Rows of time and columns, SI; the reason if the run failed.
    pub fn rows(&self) -> Result<Vec<Vec<f64>>, String> {
        match &self.result {
            Ok(outcome) => Ok(outcome.recording.rows().map(<[f64]>::to_vec).collect()),
            Err(failure) if failure.cause == Cause::Stopped => {
                Err(format!("takes too many steps: given up at {}", abi::format::time(failure.time)))
            }
            Err(failure) => Err(failure.to_string()),
        }
    }

    /// The first reading of the expectation of this number, SI.
    pub fn reading(&self, expectation: usize) -> Option<f64> {
        let verdict = self.result.as_ref().ok()?.verdicts.get(expectation)?;
        verdict.readings.first().map(|reading| reading.value)
    }
}

/// Results by the name of the experiment; a message if it could not be compiled.
pub type Results = BTreeMap<String, Result<Vec<Ran>, String>>;

/// Loads a generated text.
///
/// # Errors
/// What is wrong with it, as a report.
pub fn load(name: &str, text: &str, sources: &(dyn compile::Sources + Sync)) -> Result<Loaded, String> {
    let loaded = compile::load(name, text, sources);
    match loaded.has_errors() {
        true => Err(report::full(&loaded.files.0, &loaded.diagnostics, false)),
        false => Ok(loaded),
    }
}

/// Compiles and runs experiments of a loaded text. If the first case of a sweep does not finish, the others are
/// skipped, because the experiment will be repeated with another solver.
pub fn run(loaded: &Loaded, names: &[String], sources: &(dyn compile::Sources + Sync)) -> Results {
    let compiled = compiled(loaded, names, sources);
    let mut cases: Vec<(usize, &compile::Case)> = Vec::new();
    for (i, (_, compiled)) in compiled.iter().enumerate() {
        cases.extend(compiled.iter().flatten().map(|case| (i, case)));
    }
    let is_first = |k: &usize| *k == 0 || cases[k - 1].0 != cases[*k].0;
    let (first, others): (Vec<usize>, Vec<usize>) = (0..cases.len()).partition(is_first);
    let mut results: Vec<Option<Result<Outcome, Failure>>> = cases.iter().map(|_| None).collect();
    let mut given_up = BTreeSet::new();
    for mut wanted in [first, others] {
        wanted.retain(|k| !given_up.contains(&cases[*k].0));
        let picked: Vec<&compile::Case> = wanted.iter().map(|k| cases[*k].1).collect();
        for (k, result) in wanted.into_iter().zip(outcomes(&picked)) {
            if why(&result).is_some() {
                given_up.insert(cases[k].0);
            }
            results[k] = Some(result);
        }
    }
    let mut results = results.into_iter();
    let mut ran = |case: compile::Case| {
        let result = results.next().expect("a place for each case")?;
        Some(Ran { label: case.label, result })
    };
    compiled
        .into_iter()
        .map(|(name, cases)| (name, cases.map(|cases| cases.into_iter().filter_map(&mut ran).collect())))
        .collect()
}

/// Runs cases on all cores; the results are in order, and the same for any number of threads.
fn outcomes(cases: &[&compile::Case]) -> Vec<Result<Outcome, Failure>> {
    let next = AtomicUsize::new(0);
    let work = || {
        let mut done = Vec::new();
        while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)).copied() {
            // Counted, not timed, so that the limit does not depend on the machine.
            let states = case.instance.description().layout.states.len as usize;
            let most = (MOST_LOOKS * 8 / states.max(8)).max(50);
            let mut looks = 0;
            let mut watch = |_| {
                looks += 1;
                if looks > most { Continue::Break(()) } else { Continue::Continue(()) }
            };
            let index = cases.iter().position(|other| std::ptr::eq(*other, case)).expect("it is one of them");
            done.push((index, engine::run(case.instance.clone(), &case.experiment, &mut watch)));
        }
        done
    };
    let workers = thread::available_parallelism().map_or(1, usize::from).min(cases.len().max(1));
    let mut done: Vec<(usize, Result<Outcome, Failure>)> = thread::scope(|scope| {
        let work: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        work.into_iter().flat_map(|work| work.join().expect("a worker does not panic")).collect()
    });
    done.sort_by_key(|(index, _)| *index);
    done.into_iter().map(|(_, result)| result).collect()
}

/// Why an adaptive run did not finish where a fixed-step run would.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Endless {
    /// The model switches back and forth.
    Chatters,
    /// It needs too many steps.
    Slow,
}

/// Why a case did not finish, if any did not.
pub fn endless(results: &Result<Vec<Ran>, String>) -> Option<Endless> {
    results.as_ref().ok()?.iter().find_map(|ran| why(&ran.result))
}

fn why(result: &Result<Outcome, Failure>) -> Option<Endless> {
    match result.as_ref().err()?.cause {
        Cause::Chatter(_) => Some(Endless::Chatters),
        Cause::TooManySteps { .. } | Cause::StepTooShort { .. } | Cause::Stopped => Some(Endless::Slow),
        Cause::Guard { .. } | Cause::NotFinite { .. } | Cause::NoDerivatives | Cause::Rig { .. } => None,
    }
}

type Compiled = (String, Result<Vec<compile::Case>, String>);

/// Compiles experiments on all cores; the results are in order.
fn compiled(loaded: &Loaded, names: &[String], sources: &(dyn compile::Sources + Sync)) -> Vec<Compiled> {
    let one = |loaded: &mut Loaded, name: &String| {
        // The step-size sweep shows what too long a step does.
        let options = Options { changes: Changes { any_step: true, ..Changes::default() }, interpret: false };
        let mut warnings = Vec::new();
        let cases = compile::compile(loaded, sources, name, &options, &mut warnings, &mut |_| ());
        (name.clone(), cases.map_err(|found| report::full(&loaded.files.0, &found, false)))
    };
    let workers = thread::available_parallelism().map_or(1, usize::from).min(8);
    let share = names.len().div_ceil(workers).max(1);
    thread::scope(|scope| {
        let work: Vec<_> = names
            .chunks(share)
            .map(|names| {
                let mut loaded = loaded.clone();
                scope.spawn(move || names.iter().map(|name| one(&mut loaded, name)).collect::<Vec<_>>())
            })
            .collect();
        work.into_iter().flat_map(|work| work.join().expect("a worker does not panic")).collect()
    })
}
