//! The numerical errors that are printed beside measures, judged: how often the true error lies within three of them.
//!
//! Every experiment of the library and its tests is run by each method, at several tolerances or steps; the truth is an adaptive
//! run at tol 1e-13. A measure counts as covered if its distance to the truth is at most three times its estimate and what is
//! not known of the truth: twice its distance to a run at tol 1e-12, and rounding. The tests take a part of the space, chosen
//! by a seed that is printed; `cargo test --test trust -- --ignored --nocapture survey` takes all and prints the table of
//! docs/numerics.md.

use crate::support::{Texts, root, texts_below};
use abi::plan::{Experiment, Method, Solver};
use compiler::{Case, Changes, Loaded, Options};
use runtime::engine::{self, Continue, Outcome};
use runtime::estimate;
use runtime::verdict::Reading;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What part of the true error an estimate must cover: three times itself, in so many measures of all.
const TIMES: f64 = 3.0;
const SHARE: f64 = 0.99;

/// Tolerances of adaptive runs, and steps in s of fixed ones.
const TOLERANCES: [f64; 4] = [1e-4, 1e-6, 1e-8, 1e-10];
const STEPS: [f64; 2] = [1e-3, 1e-4];
/// Most fixed steps of a run of the survey.
const MOST_STEPS: f64 = 4e5;

/// Measures of one method at one tolerance or step.
#[derive(Default, Clone)]
struct Count {
    measures: u64,
    covered: u64,
    /// Number of measures without an estimate, since a companion run failed.
    unknown: u64,
    /// Estimates of more than ten times the true error, of those whose error is more than rounding.
    generous: u64,
    tallied: u64,
}

/// An experiment of a text on disk.
struct Subject {
    path: PathBuf,
    name: String,
}

fn subjects() -> Vec<Subject> {
    let mut out = Vec::new();
    for folder in ["stdlib-models", "tests/stdlib"] {
        for (path, text) in texts_below(&root().join(folder)) {
            let loaded = compiler::load(&path.display().to_string(), &text, &Texts::default());
            let named = loaded.experiments().into_iter().filter(|experiment| experiment.has_expect);
            out.extend(named.map(|experiment| Subject { path: path.clone(), name: experiment.name }));
        }
    }
    out
}

fn compiled(loaded: &mut Loaded, name: &str, changes: Changes) -> Option<Vec<Case>> {
    let options = Options { changes, interpret: false };
    compiler::compile(loaded, &Texts::default(), name, &options, &mut Vec::new(), &mut |_| ()).ok()
}

fn go(case: &Case, solver: Solver) -> Option<Outcome> {
    let experiment = Experiment { solver, plots: Vec::new(), ..case.experiment.clone() };
    engine::run(case.instance.clone(), &experiment, &mut |_| Continue::Continue(())).ok()
}

fn readings(outcome: &Outcome) -> Vec<&Reading> {
    outcome.verdicts.iter().flat_map(|verdict| &verdict.readings).collect()
}

/// Judges the estimates of one experiment; `tell` gets every measure that is not covered.
fn survey(subject: &Subject, table: &mut BTreeMap<String, Count>, tell: &mut dyn FnMut(String)) {
    let text = std::fs::read_to_string(&subject.path).unwrap();
    let mut loaded = compiler::load(&subject.path.display().to_string(), &text, &Texts::default());
    let adaptive = Changes { method: Some(Method::Adaptive), tol: Some(1e-6), ..Changes::default() };
    let Some(cases) = compiled(&mut loaded, &subject.name, adaptive) else { return };
    if cases.iter().any(|case| case.experiment.bench.is_some()) {
        return; // A dry run has no exact solution: its rig is stepped.
    }
    // Of a sweep the first and the last.
    let chosen: Vec<usize> = [0, cases.len() - 1].into_iter().take(cases.len()).collect();
    let truths: Vec<Option<Vec<(f64, f64)>>> = chosen.iter().map(|k| truth(&cases[*k])).collect();
    for (k, truth) in chosen.iter().zip(&truths) {
        let Some(truth) = truth else { continue };
        for tol in TOLERANCES {
            let solver = Solver { tol, ..cases[*k].experiment.solver };
            judge(subject, &cases[*k], solver, truth, &format!("adaptive tol {tol:e}"), table, tell);
        }
    }
    for method in Method::ALL.into_iter().filter(|method| *method != Method::Adaptive) {
        for step in STEPS {
            let changes = Changes { method: Some(method), step: Some(step), ..Changes::default() };
            let Some(cases) = compiled(&mut loaded, &subject.name, changes) else { continue };
            for (k, truth) in chosen.iter().zip(&truths) {
                let (Some(truth), case) = (truth, &cases[*k]) else { continue };
                if case.experiment.duration / step > MOST_STEPS {
                    continue;
                }
                let label = format!("{} step {step:e} s", method.name());
                judge(subject, case, case.experiment.solver, truth, &label, table, tell);
            }
        }
    }
}

/// Each measure of the exact solution, and how far it may be off.
fn truth(case: &Case) -> Option<Vec<(f64, f64)>> {
    let at = |tol| go(case, Solver { tol, parts: 200.0, ..case.experiment.solver });
    let (best, second) = (at(1e-13)?, at(1e-12)?);
    let (best, second) = (readings(&best), readings(&second));
    if best.len() != second.len() {
        return None;
    }
    let one = |(best, second): (&&Reading, &&Reading)| {
        let apart = if best.value == second.value { 0.0 } else { (best.value - second.value).abs() };
        (best.value, 2.0 * apart + 1e-11 * best.value.abs())
    };
    Some(best.iter().zip(&second).map(one).collect())
}

fn judge(
    subject: &Subject,
    case: &Case,
    solver: Solver,
    truth: &[(f64, f64)],
    label: &str,
    table: &mut BTreeMap<String, Count>,
    tell: &mut dyn FnMut(String),
) {
    let Some(mut outcome) = go(case, solver) else { return };
    let experiment = Experiment { solver, plots: Vec::new(), ..case.experiment.clone() };
    let before = outcome.clone();
    estimate::judge(&case.instance, &experiment, &mut outcome, &mut |_| Continue::Continue(()));
    let found = readings(&outcome);
    if found.len() != truth.len() {
        return;
    }
    let count = table.entry(label.into()).or_default();
    for ((reading, (true_value, unsure)), own) in found.iter().zip(truth).zip(readings(&before)) {
        assert_eq!(reading.value.to_bits(), own.value.to_bits(), "an estimate changed {}", reading.text);
        let estimate = reading.error.expect("it was asked for");
        if estimate == f64::INFINITY && reading.value.is_finite() && true_value.is_finite() {
            count.unknown += 1;
            continue;
        }
        let error = if reading.value == *true_value { 0.0 } else { (reading.value - true_value).abs() };
        count.measures += 1;
        // Rounding, of the quantity and of what is as good as nothing in any unit of the library.
        let unsure = &(unsure + 1e-11 * reading.scale + 1e-18);
        let covered = error <= TIMES * estimate + unsure;
        count.covered += u64::from(covered);
        if error > *unsure {
            count.tallied += 1;
            count.generous += u64::from(estimate > 10.0 * error);
        }
        if !covered {
            let Subject { path, name } = subject;
            let file = path.strip_prefix(root()).unwrap_or(path).display();
            let case = if case.label.is_empty() { String::new() } else { format!(" ({})", case.label) };
            let (text, value) = (&reading.text, reading.value);
            tell(format!(
                "{label}: {file} {name}{case}: {text} = {value:?}, true {true_value:?}: off by {error:.2e}, estimated {estimate:.2e}, the truth is known to {unsure:.1e}"
            ));
        }
    }
}

fn shown(table: &BTreeMap<String, Count>) -> String {
    let mut out = String::from(
        "| run | measures | within 3 × the estimate | not known | estimate > 10 × the error |\n|---|---|---|---|---|\n",
    );
    let mut all = Count::default();
    let row = |label: &str, count: &Count| {
        let percent = |part: u64, whole: u64| 100.0 * part as f64 / whole.max(1) as f64;
        format!(
            "| {label} | {} | {:.2} % | {} | {:.0} % |\n",
            count.measures,
            percent(count.covered, count.measures),
            count.unknown,
            percent(count.generous, count.tallied)
        )
    };
    for (label, count) in table {
        out += &row(label, count);
        all.measures += count.measures;
        all.covered += count.covered;
        all.unknown += count.unknown;
        all.generous += count.generous;
        all.tallied += count.tallied;
    }
    out + &row("all", &all)
}

fn share(table: &BTreeMap<String, Count>) -> (u64, f64) {
    let (measures, covered) = table.values().fold((0, 0), |(m, c), count| (m + count.measures, c + count.covered));
    (measures, covered as f64 / measures.max(1) as f64)
}

#[test]
#[ignore = "takes minutes; prints the table of docs/numerics.md"]
fn survey_of_the_whole_library() {
    let mut table = BTreeMap::new();
    let every: usize = std::env::var("EVERY").ok().and_then(|n| n.parse().ok()).unwrap_or(1);
    for subject in subjects().iter().step_by(every) {
        survey(subject, &mut table, &mut |missed| println!("{missed}"));
    }
    println!("{}", shown(&table));
    let (measures, share) = share(&table);
    println!("{measures} measures, {:.2} % covered", 100.0 * share);
    assert!(share >= SHARE);
}
