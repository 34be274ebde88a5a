//! Numerical errors of a sample of the runs of a sweep.
//!
//! In: a sweep whose table is complete. Out: for each measure the largest error in the sample and its run, and how many
//! verdicts of the sample are undecided. The sample depends only on the size of the table; each of its runs is repeated
//! with its companions, so the table itself is not changed.

use super::{SweepTable, extremes};
use crate::compile::PreparedRun;
use crate::quantity::{count, significant};
use crate::results;
use crate::vary::Dice;
use abi::plan::{Expect, Experiment, Formula, Method, Solver};
use abi::unit::Unit;
use runtime::engine::estimate;
use runtime::engine::sweep;
use runtime::engine::{self, Continue};
use runtime::run::verdict::Verdict;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// Number of runs whose errors are estimated.
const SAMPLE: u64 = 10;

/// Numbers of the sampled runs of a table of `total` rows: evenly from the first to the last.
fn sample(total: u64) -> Vec<u64> {
    let number = |k: u64| (u128::from(total - 1) * u128::from(k) / u128::from(SAMPLE - 1)) as u64;
    let mut numbers: Vec<u64> = if total == 0 { Vec::new() } else { (0..SAMPLE).map(number).collect() };
    numbers.dedup();
    numbers
}

/// An error and its run.
type Worst = (f64, u64);

/// Errors of a sample.
pub(super) struct Errors {
    /// Runs sampled in this table or shard, those of them that reached their end, and all rows.
    sampled: u64,
    ended: u64,
    total: u64,
    /// The experiment of the first case.
    experiment: Experiment,
    /// Solvers of the companions.
    companions: Vec<Solver>,
    /// For each measure its text, its unit, and the largest error; none if no run has a value of it.
    measures: Vec<(String, Unit, Option<Worst>)>,
    /// Verdicts of the sample, and the undecided ones: text and run.
    verdicts: u64,
    open: Vec<(String, u64)>,
}

impl SweepTable {
    /// Estimates the errors of the sampled runs in `range`; none if the experiment has no measures or if `stopped` was
    /// set before the end. The result does not depend on the number of threads.
    pub(super) fn errors(
        &self,
        range: &Range<u64>,
        threads: usize,
        dice: &Dice,
        stopped: &AtomicBool,
    ) -> Option<Errors> {
        let numbers: Vec<u64> = sample(self.total()).into_iter().filter(|number| range.contains(number)).collect();
        let own = |at: usize| &self.cases[at].experiment.expects[..self.cases[at].expects()];
        let mut measures: Vec<(String, Unit, Option<Worst>)> = Vec::new();
        for measure in (0..self.cases.len()).flat_map(own).flat_map(|expect| &expect.measures) {
            if measures.iter().all(|(text, ..)| *text != measure.text) {
                measures.push((measure.text.clone(), measure.unit.clone(), None));
            }
        }
        let mut errors = Errors {
            sampled: numbers.len() as u64,
            ended: 0,
            total: range.end - range.start,
            experiment: self.cases[0].experiment.clone(),
            companions: Vec::new(),
            measures,
            verdicts: 0,
            open: Vec::new(),
        };
        if errors.measures.is_empty() {
            return None;
        }
        let job = |k: u64| self.judged(numbers[k as usize], dice, stopped);
        sweep::ordered(0..errors.sampled, threads, &|desk| sweep::one_by_one(desk, &job), &mut |k, judged| {
            let number = numbers[k as usize];
            if let Some((verdicts, companions)) = judged {
                errors.take(own(self.case_of(number)), number, &verdicts, companions);
            }
            Continue::Continue(())
        });
        (!stopped.load(Ordering::Relaxed)).then_some(errors)
    }

    /// The verdicts of a run with their errors, and its companions; `Some(None)` if the run does not reach its end, and
    /// `None` if `stopped` was set.
    fn judged(&self, number: u64, dice: &Dice, stopped: &AtomicBool) -> Option<Option<Judged>> {
        let watch = &|_: f64| match stopped.load(Ordering::Relaxed) {
            true => Continue::Break(()),
            false => Continue::Continue(()),
        };
        let Ok((run, PreparedRun { instance, experiment })) = self.fitted(number, dice) else { return Some(None) };
        // With guards on ranges, as for the row: a run that left a range has no error either.
        let (case, description) = (&self.cases[run.at], run.description);
        let ended = engine::run(instance.clone(), &experiment, &mut { watch }).ok().filter(|outcome| {
            let watched = &outcome.verdicts[case.expects()..];
            case.left(&description, &watched.iter().map(extremes).collect::<Vec<_>>()).is_none()
        });
        if stopped.load(Ordering::Relaxed) {
            return None;
        }
        let Some(mut outcome) = ended else { return Some(None) };
        let mut own = experiment;
        own.expects.truncate(case.expects());
        outcome.verdicts.truncate(case.expects());
        estimate::errors(&instance, &own, &mut outcome, watch);
        let estimate = outcome.estimate?;
        Some(Some((outcome.verdicts, estimate.companions)))
    }
}

/// Verdicts with their errors, and the solvers of the companions.
type Judged = (Vec<Verdict>, Vec<Solver>);

impl Errors {
    /// Adds the errors of run `number` of the table, in the order of its expectations.
    fn take(&mut self, expects: &[Expect], number: u64, verdicts: &[Verdict], companions: Vec<Solver>) {
        self.ended += 1;
        if self.companions.is_empty() {
            self.companions = companions;
        }
        for (expect, verdict) in expects.iter().zip(verdicts) {
            for measure in &expect.measures {
                let known = self.measures.iter_mut().find(|(text, ..)| *text == measure.text);
                let (_, _, worst) = known.expect("all measures are listed");
                let read = verdict.readings.iter().find(|reading| reading.text == measure.text);
                let Some(error) = read.and_then(|reading| reading.error) else { continue };
                // If several are equally large, keep the first.
                if worst.is_none_or(|(most, _)| error > most) {
                    *worst = Some((error, number));
                }
            }
            if !matches!(expect.condition, Formula::Shown(..)) && verdict.problem.is_none() {
                self.verdicts += 1;
                if !verdict.decided {
                    self.open.push((verdict.text.clone(), number));
                }
            }
        }
    }

    /// A heading, a line for each measure, and a line on verdicts.
    pub(super) fn words(&self) -> String {
        let runs =
            |n: u64| format!("{} of {} run{}", count(n), count(self.total), if self.total == 1 { "" } else { "s" });
        if self.sampled == 0 {
            return "  errors: none of the runs sampled of the whole table lies in this shard\n".into();
        }
        let adaptive = self.experiment.solver.method == Method::Adaptive;
        let by = match self.companions.as_slice() {
            [] => String::new(),
            all => {
                let kind = if adaptive { "" } else { "discretisation " };
                format!(", {kind}by {}", results::finer(&self.experiment, all))
            }
        };
        let lost = match self.sampled - self.ended {
            0 => String::new(),
            lost => format!("; {} more did not come to {} end", count(lost), if lost == 1 { "its" } else { "their" }),
        };
        let mut out = format!("  errors of {}{by}{lost}\n", runs(self.ended));
        let width = self.measures.iter().map(|(text, ..)| text.chars().count()).max().unwrap_or(0);
        for (text, unit, worst) in &self.measures {
            let most = match worst {
                None => "not measured in any of them".into(),
                Some((error, number)) if error.is_infinite() => format!("not known (run {number})"),
                Some((error, number)) => {
                    // An error is a difference: for a temperature in °C, in kelvin.
                    let error = significant(unit.from_si(*error) - unit.from_si(0.0), 2);
                    let unit = if unit.text.is_empty() { String::new() } else { format!(" {unit}") };
                    format!("at most {error}{unit} (run {number})")
                }
            };
            out += &format!("    {text:width$}  {most}\n");
        }
        if let Some((text, number)) = self.open.first() {
            let (open, all) = (count(self.open.len() as u64), count(self.verdicts));
            let remedy = if adaptive { "--tol" } else { "--step" };
            out += &format!(
                "    {open} of {all} verdicts undecided, first {text} (run {number}): give a smaller {remedy}\n"
            );
        }
        out
    }
}

#[test]
fn a_sample_is_even_and_has_both_ends() {
    assert_eq!(sample(1000), [0, 111, 222, 333, 444, 555, 666, 777, 888, 999]);
    assert_eq!((sample(0), sample(1), sample(3)), (vec![], vec![0], vec![0, 1, 2]));
    assert_eq!(sample(10), (0..10).collect::<Vec<_>>());
    let large = sample(u64::MAX);
    assert_eq!((large.len(), large[0], large[9]), (10, 0, u64::MAX - 1));
}
