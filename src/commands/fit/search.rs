//! Runs of a compiled fit, and the search for its values.
//!
//! In: a compiled fit. Out: what its runs leave of the recording, and an answer with the step that it needs. Knows nothing
//! of files.

use crate::args;
use crate::compile::{self, ElementaryFunction, HELD};
use crate::quantity::{duration, significant};
use abi::plan::{Experiment, Method};
use abi::{Instance, Slot};
use runtime::engine::{self, Cause, Continue, Failure, lanes};
use runtime::fit::{Answer, Elementary, Item, Question, Trouble, Unknown, ranking};

/// Most trial points of a stage of the search.
const TRIALS: u32 = 100;
/// A step is short enough if half of it changes no residual by more than this part of the noise.
const PART_OF_NOISE: f64 = 0.1;
/// How often a step is halved at most.
const MOST_HALVINGS: u32 = 8;

/// The compiled fit and its rows.
pub struct Runs {
    /// The fit.
    pub fit: compile::Fit,
    /// The compared rows, in s.
    pub instants: Vec<f64>,
    /// The compared quantities.
    pub slots: Vec<Slot>,
}

/// Values of a run at its rows, or why it failed.
pub type Residuals = Result<Vec<Vec<f64>>, String>;

impl Runs {
    /// The runs of a fit.
    pub fn new(mut fit: compile::Fit) -> Runs {
        // The last plot holds the compared quantities.
        fit.varying.plots.pop();
        let (after, before) = fit.asks.window;
        let instants = fit.asks.rows.iter().copied().filter(|t| (after..=before).contains(t)).collect();
        let slots = fit.asks.items.iter().map(|item| item.slot).collect();
        Runs { fit, instants, slots }
    }

    /// The step as the text has it, in s; 0 for an adaptive run.
    pub fn step(&self) -> f64 {
        self.fit.varying.experiment.solver.step
    }

    /// An instance and a plan for these values, with steps of this length.
    pub fn with(&self, values: &[f64], step: f64) -> Result<(Instance, Experiment), String> {
        let given: Vec<(Slot, f64)> =
            self.fit.asks.unknowns.iter().zip(values).map(|(unknown, value)| (unknown.slot, *value)).collect();
        let made = self.fit.varying.at(&given)?;
        let mut experiment = made.experiment;
        match experiment.solver.method {
            Method::Adaptive if self.fit.asks.driven => {
                let end = experiment.duration;
                experiment.corners.extend(self.fit.asks.corners.iter().filter(|t| **t > 0.0 && **t < end));
                experiment.corners.sort_by(f64::total_cmp);
                experiment.corners.dedup();
            }
            Method::Adaptive => {}
            _ => experiment.solver.step = step,
        }
        Ok((made.instance, experiment))
    }

    /// Values of the slots at these instants for each of these sets of values: in lanes if there are enough to fill them.
    pub fn sampled(
        &self,
        points: &[Vec<f64>],
        step: f64,
        instants: &[f64],
        slots: &[Slot],
    ) -> Vec<Result<Vec<f64>, String>> {
        let mut out: Vec<Option<Result<Vec<f64>, String>>> = points.iter().map(|_| None).collect();
        let (mut places, mut all) = (Vec::new(), Vec::new());
        for (place, values) in points.iter().enumerate() {
            match self.with(values, step) {
                Ok(made) => {
                    places.push(place);
                    all.push(made);
                }
                Err(why) => out[place] = Some(Err(why)),
            }
        }
        let watch = &mut |_| Continue::Continue(());
        let results = match self.fit.varying.lanes().filter(|lanes| all.len() >= lanes.width() / 2) {
            Some(code) => lanes::sample(code, all, instants, slots, watch),
            None => {
                let mut one = |(instance, experiment): (Instance, Experiment)| {
                    engine::sample(instance, &experiment, instants, slots, watch)
                };
                all.into_iter().map(&mut one).collect()
            }
        };
        for (place, (values, ended)) in places.into_iter().zip(results) {
            out[place] = Some(match ended {
                Err(failure) => Err(cause(&failure)),
                Ok(()) if values.len() < instants.len() * slots.len() => {
                    Err("the run ends before the recording".into())
                }
                Ok(()) => Ok(values),
            });
        }
        out.into_iter().map(|one| one.expect("each was run or refused")).collect()
    }

    /// The search's view of what is asked, from these starts.
    fn asked(&self, starts: &[f64]) -> (Vec<Unknown>, Vec<Item>) {
        let unknown = |(one, start): (&compile::FitUnknown, &f64)| Unknown {
            low: one.range.0,
            high: one.range.1,
            start: *start,
            known: one.known,
        };
        let asks = &self.fit.asks;
        let items = asks.items.iter().map(|item| Item { sd: item.sd });
        (asks.unknowns.iter().zip(starts).map(unknown).collect(), items.collect())
    }

    /// Compared minus recorded, at the compared rows, for each of these sets of values.
    pub fn residuals(&self, points: &[Vec<f64>], step: f64) -> Vec<Residuals> {
        self.residuals_at(points, step, &self.instants)
    }

    fn residuals_at(&self, points: &[Vec<f64>], step: f64, instants: &[f64]) -> Vec<Residuals> {
        let width = self.slots.len();
        let split = |values: Vec<f64>| -> Residuals {
            if let Some(bad) = values.iter().position(|value| !value.is_finite()) {
                let item = &self.fit.asks.items[bad % width];
                return Err(format!("`{}` is not a finite number", item.text));
            }
            Ok((0..width).map(|k| values.iter().skip(k).step_by(width).copied().collect()).collect())
        };
        self.sampled(points, step, instants, &self.slots).into_iter().map(|one| one.and_then(split)).collect()
    }

    /// The compared measures of a run with steps of this length, in SI: integrals over time, unlike sums over rows.
    pub fn measures(&self, values: &[f64], step: f64) -> Vec<f64> {
        let Ok((instance, experiment)) = self.with(values, step) else { return Vec::new() };
        let Ok(outcome) = engine::run(instance, &experiment, &mut |_| Continue::Continue(())) else {
            return Vec::new();
        };
        let end = self.fit.varying.expects();
        let shown = outcome.verdicts[end - self.slots.len()..end].iter();
        shown.filter_map(|verdict| verdict.shown.as_ref().map(|shown| shown.value)).collect()
    }

    /// The number of steady points at which a compared quantity still moved by a noticeable part of its residuals in
    /// the second half of the hold.
    pub fn unsettled(&self, answer: &Answer) -> usize {
        let pairs: Vec<f64> = self.instants.iter().flat_map(|t| [t - 0.5 * HELD, *t]).collect();
        let point = std::slice::from_ref(&answer.values);
        let Ok(values) = self.sampled(point, self.step(), &pairs, &self.slots).remove(0) else { return 0 };
        let width = self.slots.len();
        let moves =
            |pair: &&[f64]| (0..width).any(|k| (pair[k] - pair[width + k]).abs() > PART_OF_NOISE * answer.rms[k]);
        values.chunks(2 * width).filter(moves).count()
    }
}

/// The cause of a failure without its numbers, so that equal causes count together.
fn cause(failure: &Failure) -> String {
    match &failure.cause {
        Cause::Guard { guard, .. } => format!("`{}` leaves its range", guard.path),
        Cause::NotFinite { path, .. } => format!("`{path}` is not a finite number"),
        Cause::Chatter(_) => "the run chatters".into(),
        Cause::StepTooShort { path, .. } => format!("`{path}` needs steps that are too short"),
        Cause::TooManySteps { .. } => "the run needs too many steps".into(),
        Cause::NoDerivatives | Cause::Rig { .. } | Cause::Stopped => failure.to_string(),
    }
}

/// How to search.
#[derive(Clone, Copy)]
pub struct Settings {
    /// Probability of the intervals.
    pub level: f64,
    /// Number of starts that are judged.
    pub starts: usize,
    /// Seed of those that are not written.
    pub seed: u64,
}

impl Settings {
    /// As the command line states it.
    pub fn of(args: &args::Fit) -> Settings {
        Settings { level: args.level, starts: args.starts, seed: args.seed }
    }
}

/// An answer, the step of its runs, and what is to be said of it.
pub type Found = (Answer, f64, Option<String>);

/// Estimates the unknowns from some rows.
fn estimate(
    runs: &Runs,
    unknowns: &[Unknown],
    items: &[Item],
    settings: Settings,
    run: &mut dyn FnMut(&[Vec<f64>]) -> Vec<Residuals>,
) -> Result<Answer, Trouble> {
    let (exp, log) = (ElementaryFunction::exp(), ElementaryFunction::log());
    runtime::fit::fit(Question {
        unknowns,
        items,
        independent: runs.fit.asks.steady,
        run,
        with: Elementary { exp: &|x| exp.at(x), log: &|x| log.at(x) },
        level: settings.level,
        trials: TRIALS,
        starts: settings.starts,
        seed: settings.seed,
    })
}

/// Searches with the step of the text, and again with half of it until that changes nothing that matters.
pub fn search(runs: &Runs, settings: Settings) -> Result<Found, Trouble> {
    let asks = &runs.fit.asks;
    let written: Vec<f64> = asks.unknowns.iter().map(|one| one.start).collect();
    let (mut unknowns, items) = runs.asked(&written);
    let mut step = runs.step();
    let mut spent = 0;
    let mut judged = None;
    for halvings in 0.. {
        let mut run = |points: &[Vec<f64>]| runs.residuals(points, step);
        let starts = if judged.is_none() { settings.starts } else { 1 };
        let settings = Settings { starts, ..settings };
        let mut answer = estimate(runs, &unknowns, &items, settings, &mut run)?;
        // Later searches continue from where the first one ended.
        let (starts, followed, agreed) = *judged.get_or_insert((answer.starts, answer.followed, answer.agreed));
        (answer.starts, answer.followed, answer.agreed) = (starts, followed, agreed);
        answer.runs += spent;
        let solver = runs.fit.varying.experiment.solver.method;
        let fixed = asks.solver_given || solver == Method::Adaptive || runs.fit.varying.keeps_past();
        if fixed {
            return Ok((answer, step, None));
        }
        let finer = runs.residuals(&[answer.values.clone()], 0.5 * step).remove(0);
        let moved = finer.as_ref().map(|finer| {
            let one = |(k, (a, b)): (usize, (&Vec<f64>, &Vec<f64>))| {
                let noise = answer.noise[k].variance.sqrt();
                a.iter().zip(b).map(|(a, b)| (a - b).abs() / noise).fold(0.0, f64::max)
            };
            finer.iter().zip(&answer.residuals).enumerate().map(one).fold(0.0, f64::max)
        });
        match moved {
            Ok(moved) if moved <= PART_OF_NOISE => return Ok((answer, step, None)),
            Ok(_) if halvings < MOST_HALVINGS => {
                step *= 0.5;
                spent = answer.runs + 1;
                for (unknown, value) in unknowns.iter_mut().zip(&answer.values) {
                    unknown.start = *value;
                }
            }
            moved => {
                let by = moved.map_or_else(
                    |why| why.clone(),
                    |moved| format!("half of it moves a residual by {} of the noise", significant(moved, 2)),
                );
                let note = format!("steps of {} may be too long: {by}", duration(step, 3));
                return Ok((answer, step, Some(note)));
            }
        }
    }
    unreachable!("the loop returns")
}

/// What a law leaves of each row when it is fitted to the rows of the other half.
pub fn held_out(runs: &Runs, (answer, step, _): &Found, settings: Settings) -> Option<Vec<f64>> {
    let asks = &runs.fit.asks;
    let rows = runs.instants.len();
    let half = |row: usize| ranking::piece(row, rows, asks.steady) % 2;
    let mut out = vec![0.0; rows];
    for seen in [0, 1] {
        let instants: Vec<f64> = (0..rows).filter(|row| half(*row) == seen).map(|row| runs.instants[row]).collect();
        let of_half = |points: &[Vec<f64>]| runs.residuals_at(points, *step, &instants);
        let (unknowns, items) = runs.asked(&answer.values);
        let values =
            estimate(runs, &unknowns, &items, Settings { starts: 1, ..settings }, &mut { of_half }).ok()?.values;
        let all = runs.residuals(&[values], *step).remove(0).ok()?;
        (0..rows).filter(|row| half(*row) != seen).for_each(|row| out[row] = all[0][row]);
    }
    Some(out)
}
