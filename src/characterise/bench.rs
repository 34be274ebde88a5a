//! Compiles and runs the experiments of a text, all at once.
//!
//! In: a text. Out: for each experiment what its cases recorded, or why not. A model that chatters at rest is run again
//! with a fixed step, and the text then says so.

use crate::compile::{self, Changes, Loaded, Options};
use crate::report;
use runtime::engine::{Cause, Continue, Failure, Outcome};
use runtime::sweep;
use std::collections::BTreeMap;
use std::thread;

/// What became of one case of an experiment.
pub struct Ran {
    /// `speed = 1 mm/s`; empty without a sweep.
    pub label: String,
    /// How it ended.
    pub result: Result<Outcome, Failure>,
}

impl Ran {
    /// Rows of time and columns, SI; why there are none if the run failed.
    pub fn rows(&self) -> Result<Vec<Vec<f64>>, String> {
        match &self.result {
            Ok(outcome) => Ok(outcome.recording.rows().map(<[f64]>::to_vec).collect()),
            Err(failure) => Err(failure.to_string()),
        }
    }

    /// The first reading of the expectation of this number, SI.
    pub fn reading(&self, expectation: usize) -> Option<f64> {
        let verdict = self.result.as_ref().ok()?.verdicts.get(expectation)?;
        verdict.readings.first().map(|reading| reading.value)
    }
}

/// Results by the name of the experiment; a message where it could not be compiled.
pub type Results = BTreeMap<String, Result<Vec<Ran>, String>>;

/// Loads a text that this program made.
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

/// Compiles and runs experiments of a loaded text.
pub fn run(loaded: &Loaded, names: &[String], sources: &(dyn compile::Sources + Sync)) -> Results {
    let compiled = compiled(loaded, names, sources);
    let cases: Vec<sweep::Case> = compiled
        .iter()
        .filter_map(|(_, cases)| cases.as_ref().ok())
        .flatten()
        .map(|case| sweep::Case {
            label: case.label.clone(),
            instance: case.instance.clone(),
            experiment: case.experiment.clone(),
        })
        .collect();
    let mut results = sweep::run(&cases, &|_| Continue::Continue(())).into_iter();
    compiled
        .into_iter()
        .map(|(name, cases)| {
            let ran = cases.map(|cases| {
                let ran = |case: compile::Case| Ran {
                    label: case.label,
                    result: results.next().expect("a result for each case"),
                };
                cases.into_iter().map(ran).collect()
            });
            (name, ran)
        })
        .collect()
}

/// Whether the reason is that a model turns to and fro without end.
pub fn chatters(results: &Result<Vec<Ran>, String>) -> bool {
    let chatter = |ran: &Ran| matches!(&ran.result, Err(failure) if matches!(failure.cause, Cause::Chatter(_)));
    results.as_ref().is_ok_and(|cases| cases.iter().any(chatter))
}

type Compiled = (String, Result<Vec<compile::Case>, String>);

/// Compiles experiments on all cores; the order is theirs.
fn compiled(loaded: &Loaded, names: &[String], sources: &(dyn compile::Sources + Sync)) -> Vec<Compiled> {
    let one = |loaded: &mut Loaded, name: &String| {
        let options = Options { changes: Changes::default(), interpret: false };
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
