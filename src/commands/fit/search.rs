//! Runs of a compiled fit, and the search for its values.
//!
//! In: a compiled fit. Out: what its runs leave of the recording, and an answer with the step that it needs. Knows nothing
//! of files.

use super::kept::Kept;
use crate::args::{self, STARTS, STARTS_WITH_REGIMES};
use crate::compile::{self, ElementaryFunction, HELD, Varying};
use abi::plan::{Experiment, Method, Solver};
use abi::{Instance, Slot};
use grammar::span::Span;
use runtime::engine::tiles::{Missing, Tiles};
use runtime::engine::{self, Cause, Continue, Failure};
use runtime::fit::statistics::intervals;
use runtime::fit::{
    Answer, Elementary, Estimator, Finer, Item, Journal, Limits, Minima, Question, Rows, Tile, Trouble, Unknown, Way,
};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Rows of all runs that are in memory at once.
const TILE: usize = 65_536;
/// When a search ends.
const LIMITS: Limits = Limits { trials: 100, tolerance: 1e-8 };
/// A step is short enough if a quarter of it moves no value by more than this part of its standard deviation. At the kinks
/// of a law the error may be in proportion to the step; then all shorter ones move a value by a third more, 0.1.
const PART_OF_DEVIATION: f64 = 0.075;
/// How often a step is halved at most, and a tolerance divided by ten.
const MOST_HALVINGS: u32 = 8;
const MOST_DECADES: u32 = 3;
/// A steady point has settled if a compared quantity moves by less than this part of its residuals.
const PART_OF_RESIDUALS: f64 = 0.1;
/// Relative tolerance of runs that an observer holds to their recording. They follow its noise, so a smaller one gains nothing.
const HELD_TOL: f64 = 1e-5;

/// The compiled fit and its rows.
pub struct Runs {
    /// The alternative, of a fit with a sweep: `fr = LuGre()`.
    pub label: String,
    /// Runs against recordings that are judged and not fitted.
    pub judged: Vec<Runs>,
    /// Each recording of each case.
    pub parts: Vec<Part>,
    /// The unknown parameters.
    pub unknowns: Vec<compile::FitUnknown>,
    /// The name of the fit.
    pub name: Span,
    /// Lints that the fit allows.
    pub allowed: Vec<String>,
    /// The file that keeps the stages of the searches, for `--resume`.
    pub kept: Option<Kept>,
}

/// The runs against one recording.
pub struct Part {
    /// Threads that share the runs.
    threads: usize,
    /// Set when nobody waits for the answer any more: all runs fail then, and a search ends soon.
    stop: Option<Arc<AtomicBool>>,
    /// Runs under other values.
    pub varying: Varying,
    /// What is asked.
    pub asks: compile::Asks,
    /// The compared rows, in s.
    pub instants: Arc<[f64]>,
    /// The compared quantities.
    pub slots: Vec<Slot>,
    held: Option<Held>,
}

/// Runs that an observer holds to the recording.
struct Held {
    varying: Varying,
    /// The slot of its pole.
    pole: Slot,
    /// The compared quantities.
    slots: Vec<Slot>,
}

/// Values of a run at its rows, or why it failed.
pub type Residuals = Result<Vec<Vec<f64>>, String>;

/// Receives some instants and the values there, row-major.
type Sampled<'s> = dyn FnMut(&[f64], &[f64]) -> Result<(), String> + 's;

/// Receives for each run some rows of the compared quantities, none if it has failed; and whether these are all rows.
type Passed<'p> = dyn FnMut(Vec<Option<&[Vec<f64>]>>, bool) + 'p;

impl Part {
    fn new(part: compile::FitPart, threads: usize) -> Part {
        let compile::FitPart { mut varying, held, asks } = part;
        // The last plot holds the compared quantities, each followed by its two sides.
        varying.plots.pop();
        let mut at = 0;
        let places = asks.items.iter().map(|item| {
            let place = at;
            at += if item.sides.is_some() { 3 } else { 1 };
            place
        });
        let places: Vec<usize> = places.collect();
        let held = held.and_then(|(varying, pole)| {
            let series = &varying.plots.last()?.series;
            let slots = places.iter().map(|place| series[*place].slot).collect();
            Some(Held { varying, pole, slots })
        });
        let (after, before) = asks.window;
        let is_within = |t: &f64| (after..=before).contains(t);
        let instants = match asks.rows.iter().all(is_within) {
            true => asks.rows.clone(),
            false => asks.rows.iter().copied().filter(is_within).collect(),
        };
        let slots = asks.items.iter().map(|item| item.slot).collect();
        Part { threads, stop: None, varying, asks, instants, slots, held }
    }

    /// Whether its steps follow from a tolerance.
    pub fn is_adaptive(&self) -> bool {
        self.varying.experiment.solver.method == Method::Adaptive
    }

    /// The step as the text has it, in s; of an adaptive run its tolerance.
    pub fn step(&self) -> f64 {
        let solver = &self.varying.experiment.solver;
        if self.is_adaptive() { solver.tol } else { solver.step }
    }

    /// The solver with steps of this length; an adaptive one with this tolerance.
    pub fn solver(&self, step: f64) -> Solver {
        let solver = self.varying.experiment.solver;
        if self.is_adaptive() { Solver { tol: step, ..solver } } else { Solver { step, ..solver } }
    }

    /// A shorter step, with which a run is compared. Where the instants of kinks lie in a step is chance, and half a step
    /// may have the same error.
    fn finer(&self, step: f64) -> f64 {
        if self.is_adaptive() { 0.1 * step } else { 0.25 * step }
    }

    /// The next shorter step, as a factor, and that of its error: fixed steps have methods of order 2.
    fn shorter(&self) -> (f64, f64) {
        if self.is_adaptive() { (0.1, 0.1) } else { (0.5, 0.25) }
    }

    /// How often a step may be shortened: not at all where the text gives it.
    fn most_shortenings(&self) -> u32 {
        match (self.asks.solver_given, self.is_adaptive()) {
            (true, _) => 0,
            (false, true) => MOST_DECADES,
            (false, false) => MOST_HALVINGS,
        }
    }

    /// Whether the error of the steps can be known: a memory has a length that fits one step alone.
    fn is_checked(&self) -> bool {
        self.is_adaptive() || !self.varying.keeps_past()
    }

    /// The values on which a run against this recording depends.
    fn own(&self, values: &[f64]) -> Vec<(Slot, f64)> {
        self.asks.slots.iter().zip(values).filter_map(|(slot, value)| Some(((*slot)?, *value))).collect()
    }

    /// An instance and a plan for these values of all unknowns, with steps of this length.
    pub fn with(&self, values: &[f64], step: f64) -> Result<(Instance, Experiment), String> {
        self.made(Way::Whole, &self.own(values), step, &[])
    }

    fn made(
        &self,
        way: Way,
        given: &[(Slot, f64)],
        step: f64,
        instants: &[f64],
    ) -> Result<(Instance, Experiment), String> {
        let held = |pole: f64| {
            let held = self.held.as_ref()?;
            let rows = &self.asks.rows;
            let interval = (rows[rows.len() - 1] - rows[0]) / (rows.len() - 1).max(1) as f64;
            Some((held, [given, &[(held.pole, pole / interval)]].concat()))
        };
        let made = match way {
            Way::Held(pole) => {
                let (held, given) = held(pole).ok_or("no state is compared")?;
                held.varying.at(&given)?
            }
            Way::Whole | Way::First(_) => self.varying.at(given)?,
        };
        let mut experiment = made.experiment;
        match experiment.solver.method {
            Method::Adaptive if matches!(way, Way::Held(_)) => experiment.solver.tol = step.max(HELD_TOL),
            Method::Adaptive if self.asks.driven => {
                experiment.solver.tol = step;
                let end = experiment.duration;
                experiment.corners.extend(self.asks.corners.iter().filter(|t| **t > 0.0 && **t < end));
                experiment.corners.sort_by(f64::total_cmp);
                experiment.corners.dedup();
            }
            Method::Adaptive => experiment.solver.tol = step,
            _ => experiment.solver.step = step,
        }
        if let Some(last) = instants.last().filter(|last| **last < experiment.duration) {
            experiment.duration = *last;
            experiment.corners.retain(|t| t < last);
        }
        Ok((made.instance, experiment))
    }

    /// Values of the slots at these instants for a set of values of all unknowns: row-major, some rows after the other. An
    /// error of `each` ends the run.
    pub fn sampled(
        &self,
        values: &[f64],
        step: f64,
        (instants, slots): (&Arc<[f64]>, &[Slot]),
        each: &mut Sampled,
    ) -> Result<(), String> {
        let made = self.made(Way::Whole, &self.own(values), step, instants)?;
        let mut tiles = Tiles::new(None, vec![made], (instants, slots), 1);
        for times in instants.chunks(TILE) {
            let values = tiles.next(TILE).remove(0).map_err(|missing| why(&missing))?;
            each(times, &values)?;
        }
        Ok(())
    }

    /// The same for many sets of values, in memory.
    pub fn sampled_all(&self, points: &[Vec<f64>], step: f64, slots: &[Slot]) -> Vec<Result<Vec<f64>, String>> {
        let instants = &self.asks.rows;
        let mut all = Vec::new();
        let made: Vec<Result<(), String>> = points
            .iter()
            .map(|values| self.made(Way::Whole, &self.own(values), step, instants).map(|made| all.push(made)))
            .collect();
        let mut tiles = Tiles::new(self.varying.lanes(), all, (instants, slots), self.threads);
        let mut values = tiles.next(instants.len()).into_iter();
        let mut next = || values.next().expect("one for each run").map_err(|missing| why(&missing));
        made.into_iter().map(|made| made.and_then(|()| next())).collect()
    }

    /// Compared minus recorded at these rows, for each of these sets of values of all unknowns, in lanes if there are enough
    /// to fill them: passes some rows of all after the other, with whether these are all. Values on which this recording
    /// does not depend cost no run.
    fn pass(
        &self,
        way: Way,
        points: &[Vec<f64>],
        step: f64,
        instants: &Arc<[f64]>,
        each: &mut Passed,
    ) -> Vec<Result<(), String>> {
        let held = self.held.as_ref().filter(|_| matches!(way, Way::Held(_)));
        let slots = held.map_or(&self.slots, |held| &held.slots);
        let mut different: Vec<Vec<(Slot, f64)>> = Vec::new();
        let place = |values: &Vec<f64>| {
            let own = self.own(values);
            let found = different.iter().position(|other| *other == own);
            found.unwrap_or_else(|| {
                different.push(own);
                different.len() - 1
            })
        };
        let places: Vec<usize> = points.iter().map(place).collect();
        let mut ended: Vec<Result<(), String>> = Vec::new();
        let (mut numbers, mut all) = (Vec::new(), Vec::new());
        for (number, given) in different.iter().enumerate() {
            ended.push(self.made(way, given, step, instants).map(|made| {
                numbers.push(number);
                all.push(made);
            }));
        }
        let varying = held.map_or(&self.varying, |held| &held.varying);
        let tiles = Tiles::new(varying.lanes(), all, (instants, slots), self.threads);
        let mut tiles = tiles.stop_by(self.stop.clone());
        // The filter of `thin` goes forward and backward over all rows.
        let is_filtered = self.asks.items.iter().any(|item| item.thin.is_some());
        let rows = if is_filtered { instants.len() } else { TILE };
        for _ in instants.chunks(rows.max(1)) {
            if self.stop.as_ref().is_some_and(|stop| stop.load(Ordering::Relaxed)) {
                return points.iter().map(|_| Err("it was stopped".into())).collect();
            }
            let mut found: Vec<Option<Vec<Vec<f64>>>> = different.iter().map(|_| None).collect();
            for (number, values) in numbers.iter().zip(tiles.next(rows)) {
                if ended[*number].is_ok() {
                    let residuals = values.map_err(|missing| why(&missing));
                    let residuals = residuals.and_then(|values| self.split(values, instants));
                    match residuals {
                        Ok(residuals) => found[*number] = Some(residuals),
                        Err(why) => ended[*number] = Err(why),
                    }
                }
            }
            each(places.iter().map(|place| found[*place].as_deref()).collect(), instants.len() <= rows);
        }
        places.into_iter().map(|place| ended[place].clone()).collect()
    }

    /// The residuals of each compared quantity, from their values row by row. `instants`: of all rows.
    fn split(&self, values: Vec<f64>, instants: &[f64]) -> Residuals {
        let width = self.slots.len();
        if let Some(bad) = values.iter().position(|value| !value.is_finite()) {
            let item = &self.asks.items[bad % width];
            return Err(format!("`{}` is not a finite number", item.text));
        }
        let columns = match width {
            1 => vec![values],
            _ => (0..width).map(|k| values.iter().skip(k).step_by(width).copied().collect()).collect(),
        };
        let thinned = |(rows, item): (Vec<f64>, &compile::FitItem)| match &item.thin {
            Some(thin) => thin.of(instants, &rows),
            None => rows,
        };
        Ok(columns.into_iter().zip(&self.asks.items).map(thinned).collect())
    }

    /// The same in memory, all rows together.
    fn residuals_at(&self, way: Way, points: &[Vec<f64>], step: f64, instants: &Arc<[f64]>) -> Vec<Residuals> {
        let mut all: Vec<Vec<Vec<f64>>> = vec![vec![Vec::new(); self.slots.len()]; points.len()];
        let ended = self.pass(way, points, step, instants, &mut |rows, is_all| {
            for (all, rows) in all.iter_mut().zip(rows) {
                for (column, rows) in all.iter_mut().zip(rows.unwrap_or_default()) {
                    column.reserve_exact(if is_all { rows.len() } else { instants.len() - column.len() });
                    column.extend_from_slice(rows);
                }
            }
        });
        ended.into_iter().zip(all).map(|(ended, all)| ended.map(|()| all)).collect()
    }

    /// The compared measures of a run with steps of this length, in SI: integrals over time, unlike sums over rows.
    pub fn measures(&self, values: &[f64], step: f64) -> Vec<f64> {
        let Ok((instance, experiment)) = self.with(values, step) else { return Vec::new() };
        let Ok(outcome) = engine::run(instance, &experiment, &mut |_| Continue::Continue(())) else {
            return Vec::new();
        };
        let end = self.varying.expects();
        let shown = outcome.verdicts[end - self.slots.len()..end].iter();
        shown.filter_map(|verdict| verdict.shown.as_ref().map(|shown| shown.value)).collect()
    }

    /// The number of steady points at which a compared quantity still moved by a noticeable part of its residuals in
    /// the second half of the hold. `rms`: the residuals of its compared quantities.
    pub fn unsettled(&self, values: &[f64], rms: &[f64]) -> usize {
        let pairs: Arc<[f64]> = self.instants.iter().flat_map(|t| [t - 0.5 * HELD, *t]).collect();
        let width = self.slots.len();
        let moves = |pair: &&[f64]| (0..width).any(|k| (pair[k] - pair[width + k]).abs() > PART_OF_RESIDUALS * rms[k]);
        let mut count = 0;
        let sampled = self.sampled(values, self.step(), (&pairs, &self.slots), &mut |_, values| {
            count += values.chunks(2 * width).filter(moves).count();
            Ok(())
        });
        sampled.map_or(0, |()| count)
    }
}

impl Runs {
    /// The runs of a fit.
    pub fn new(fit: compile::Fit, threads: Option<usize>) -> Runs {
        let compile::Fit { label, judged, parts, unknowns, name, allowed } = fit;
        let judged = judged.into_iter().map(|fit| Runs::new(fit, threads)).collect();
        let threads = threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
        let parts = parts.into_iter().map(|part| Part::new(part, threads)).collect();
        Runs { label, judged, parts, unknowns, name, allowed, kept: None }
    }

    /// Keeps the stages of all searches.
    pub fn keep(&mut self, kept: Option<Kept>) {
        self.judged.iter_mut().for_each(|judged| judged.keep(kept.clone()));
        self.kept = kept;
    }

    /// Lets all runs fail as soon as this is set.
    pub fn stop_by(&mut self, stop: &Arc<AtomicBool>) {
        self.judged.iter_mut().for_each(|judged| judged.stop_by(stop));
        self.parts.iter_mut().for_each(|part| part.stop = Some(stop.clone()));
    }

    /// The steps as the text has them; of adaptive runs their tolerances.
    pub fn steps(&self) -> Vec<f64> {
        self.parts.iter().map(Part::step).collect()
    }

    /// The compared quantities of each part, among all.
    pub fn items(&self) -> Vec<Range<usize>> {
        let mut begin = 0;
        let one = |part: &Part| {
            begin += part.slots.len();
            begin - part.slots.len()..begin
        };
        self.parts.iter().map(one).collect()
    }

    /// What stands before the lines of a recording: its label and a colon, where there are several.
    pub fn before(&self, part: &Part) -> String {
        if self.parts.len() > 1 { format!("{}: ", part.asks.label) } else { String::new() }
    }

    /// Number of compared rows.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(|part| part.asks.rows.len()).sum()
    }

    /// The search's view of the unknowns, from these starts.
    pub fn asked(&self, starts: &[f64]) -> Vec<Unknown> {
        let unknown = |(one, start): (&compile::FitUnknown, &f64)| Unknown {
            low: one.range.0,
            high: one.range.1,
            start: *start,
            known: one.known,
            above: one.above,
        };
        self.unknowns.iter().zip(starts).map(unknown).collect()
    }

    /// The search's view of what is compared at some of the compared rows of each recording.
    pub(super) fn compared(&self, rows: &dyn Fn(&Part) -> Option<Vec<usize>>) -> Vec<Item> {
        let of = |part: &Part| {
            let one = |item: &compile::FitItem| {
                let thinned = |times: &[f64]| item.kept(times).into_iter().map(|row| times[row]).collect();
                let times: Arc<[f64]> = match (rows(part), &item.thin) {
                    (None, None) => part.instants.clone(),
                    (None, Some(_)) => thinned(&part.instants),
                    (Some(rows), _) => thinned(&rows.into_iter().map(|row| part.instants[row]).collect::<Vec<f64>>()),
                };
                let rows = match intervals(&times) {
                    _ if part.asks.steady => Rows::Independent,
                    Some(gaps) => Rows::Even(gaps),
                    None => Rows::Uneven,
                };
                Item { sd: item.sd, rows }
            };
            part.asks.items.iter().map(one).collect::<Vec<_>>()
        };
        self.parts.iter().flat_map(of).collect()
    }

    /// The same at all of them.
    pub fn compared_whole(&self) -> Vec<Item> {
        self.compared(&|_| None)
    }

    /// What is known of other minima.
    fn minima(&self) -> Minima {
        Minima {
            held: self.parts.iter().any(|part| part.held.is_some()),
            driven: self.parts.iter().all(|part| part.asks.driven),
            regimes: self.parts.iter().any(|part| part.asks.regimes && !part.asks.driven),
        }
    }

    /// The model as the search runs it, with these steps.
    pub fn with<'r>(&'r self, steps: &'r [f64]) -> Stepped<'r> {
        Stepped { runs: self, steps, rows: None }
    }

    /// Compared minus recorded, at the compared rows, for one set of values.
    pub fn residuals(&self, way: Way, values: &[f64], steps: &[f64]) -> Residuals {
        runtime::fit::Runs::run(&mut self.with(steps), way, &[values.to_vec()]).remove(0)
    }
}

/// The runs of a fit with steps of given lengths.
#[derive(Clone)]
pub struct Stepped<'r> {
    runs: &'r Runs,
    steps: &'r [f64],
    /// The instants of each part, if not all of its rows are compared.
    rows: Option<Vec<Arc<[f64]>>>,
}

impl Stepped<'_> {
    /// The same at some of the compared rows of each recording.
    pub fn at(self, rows: &dyn Fn(&Part) -> Vec<usize>) -> Self {
        let of = |part: &Part| rows(part).into_iter().map(|row| part.instants[row]).collect();
        Stepped { rows: Some(self.runs.parts.iter().map(of).collect()), ..self }
    }

    /// For each part its number, the way in which it is run, and the instants at which it is compared.
    fn parts(&self, way: Way) -> impl Iterator<Item = (usize, Way, Arc<[f64]>)> {
        self.runs.parts.iter().enumerate().map(move |(k, part)| {
            let rows = self.rows.as_ref().map_or(&part.instants, |rows| &rows[k]);
            match (way, &part.held) {
                // A recording to which no run can be held counts as it is.
                (Way::Held(_), None) => (k, Way::Whole, rows.clone()),
                (Way::Whole | Way::Held(_), _) => (k, way, rows.clone()),
                (Way::First(share), _) => {
                    let count = ((share * rows.len() as f64).ceil() as usize).clamp(1, rows.len());
                    (k, way, Arc::from(&rows[..count]))
                }
            }
        })
    }
}

impl runtime::fit::Runs for Stepped<'_> {
    fn run(&mut self, way: Way, points: &[Vec<f64>]) -> Vec<Residuals> {
        let of = |(k, way, instants): (usize, Way, Arc<[f64]>)| {
            self.runs.parts[k].residuals_at(way, points, self.steps[k], &instants)
        };
        let mut out: Vec<Residuals> = vec![Ok(Vec::new()); points.len()];
        for part in self.parts(way).map(of) {
            for (all, one) in out.iter_mut().zip(part) {
                match (&mut *all, one) {
                    (Ok(all), Ok(one)) => all.extend(one),
                    (Ok(_), Err(why)) => *all = Err(why),
                    (Err(_), _) => {}
                }
            }
        }
        out
    }

    fn pass(&mut self, way: Way, points: &[Vec<f64>], each: &mut dyn FnMut(&Tile)) -> Vec<Result<(), String>> {
        let mut ended: Vec<Result<(), String>> = vec![Ok(()); points.len()];
        for ((k, way, instants), items) in self.parts(way).zip(self.runs.items()) {
            let found = self.runs.parts[k].pass(way, points, self.steps[k], &instants, &mut |rows, is_all| {
                each(&Tile { items: items.clone(), rows, is_all });
            });
            for (ended, found) in ended.iter_mut().zip(found) {
                if ended.is_ok() {
                    *ended = found;
                }
            }
        }
        ended
    }
}

/// Why a run has no values.
fn why(missing: &Missing) -> String {
    match missing {
        Missing::Failed(failure) => cause(failure),
        Missing::Ended => "the run ends before the recording".into(),
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
    /// Number of starts that are judged, if it is given.
    pub starts: Option<usize>,
    /// Seed of those that are not written.
    pub seed: u64,
    /// How the values are estimated.
    pub estimator: Estimator,
    /// Whether large residuals count by their size.
    pub robust: bool,
    /// When a search ends.
    pub limits: Limits,
}

impl Settings {
    /// Those that nothing changes.
    pub fn new(level: f64) -> Settings {
        Settings { level, starts: None, seed: 0, estimator: Estimator::Chosen, robust: false, limits: LIMITS }
    }

    /// As the command line states it.
    pub fn of(args: &args::Fit) -> Settings {
        Settings { starts: args.starts, seed: args.seed, robust: args.robust, ..Settings::new(args.level) }
    }

    /// The same, with estimates like those of an answer.
    pub(super) fn like(self, answer: &Answer) -> Settings {
        let estimator = if answer.misfits { Estimator::LeastSquares } else { Estimator::Whitened };
        Settings { estimator, ..self }
    }
}

/// An answer, the steps of its runs, and steps that are too long.
pub type Found = (Answer, Vec<f64>, Option<Coarse>);

/// Steps of a run that are too long for the intervals of the values.
#[derive(Clone, Debug)]
pub struct Coarse {
    /// Which run has them.
    pub part: usize,
    /// The value that shorter ones move most, in its standard deviations; or why these cannot be run.
    pub by: Result<(usize, f64), String>,
}

/// Estimates the unknowns from some rows.
pub(super) fn estimate(
    runs: &Runs,
    unknowns: &[Unknown],
    items: &[Item],
    settings: Settings,
    (run, finer): (&mut dyn runtime::fit::Runs, Option<&mut Finer>),
) -> Result<Answer, Trouble> {
    let (exp, log) = (ElementaryFunction::exp(), ElementaryFunction::log());
    let mut kept = runs.kept.clone();
    runtime::fit::fit(Question {
        journal: kept.as_mut().map(|kept| kept as &mut dyn Journal),
        unknowns,
        items,
        minima: runs.minima(),
        run,
        finer: finer.map(|finer| finer as &mut Finer),
        with: Elementary { exp: &|x| exp.at(x), log: &|x| log.at(x) },
        level: settings.level,
        limits: settings.limits,
        starts: settings.starts.unwrap_or(if runs.minima().regimes { STARTS_WITH_REGIMES } else { STARTS }),
        seed: settings.seed,
        estimator: settings.estimator,
        robust: settings.robust,
    })
}

/// Searches with the steps of the text, and again with shorter ones while these move a value noticeably.
pub fn search(runs: &Runs, settings: Settings) -> Result<Found, Trouble> {
    let written: Vec<f64> = runs.unknowns.iter().map(|one| one.start).collect();
    searched(runs, &written, settings)
}

/// Searches from these values alone.
pub fn search_from(runs: &Runs, values: &[f64], settings: Settings) -> Result<Found, Trouble> {
    searched(runs, values, Settings { starts: Some(1), ..settings })
}

fn searched(runs: &Runs, written: &[f64], settings: Settings) -> Result<Found, Trouble> {
    let (mut unknowns, items) = (runs.asked(written), runs.compared_whole());
    let mut steps = runs.steps();
    let checked: Vec<usize> = (0..runs.parts.len()).filter(|k| runs.parts[*k].is_checked()).collect();
    let mut left: Vec<u32> = runs.parts.iter().map(Part::most_shortenings).collect();
    let mut spent = 0;
    let mut judged = None;
    loop {
        let mut run = runs.with(&steps);
        let mut finer = |values: &[f64]| {
            let one = |k: &usize| {
                let part = &runs.parts[*k];
                let step = part.finer(steps[*k]);
                let found = part.residuals_at(Way::Whole, &[values.to_vec()], step, &part.instants).remove(0);
                (runs.items()[*k].clone(), found)
            };
            checked.iter().map(one).collect::<Vec<_>>()
        };
        let starts = if judged.is_none() { settings.starts } else { Some(1) };
        let settings = Settings { starts, ..settings };
        let mut answer = estimate(runs, &unknowns, &items, settings, (&mut run, Some(&mut finer)))?;
        // Later searches continue from where the first one ended.
        let first = judged.get_or_insert((answer.starts, answer.followed, answer.agreed, answer.ends.clone()));
        (answer.starts, answer.followed, answer.agreed, answer.ends) = first.clone();
        answer.runs += spent;
        spent = answer.runs;
        let Some(coarse) = coarse(&checked, &answer.shifts) else { return Ok((answer, steps, None)) };
        // Each recording has its share of what is allowed.
        let share = PART_OF_DEVIATION / checked.len() as f64;
        let mut is_shorter = false;
        for (k, shift) in checked.iter().zip(&answer.shifts) {
            let Ok(shift) = shift else { continue };
            let mut moved = shift.iter().map(|part| part.abs()).fold(0.0, f64::max);
            let (shorter, less) = runs.parts[*k].shorter();
            while moved > share && left[*k] > 0 {
                (moved, steps[*k]) = (less * moved, shorter * steps[*k]);
                (left[*k], is_shorter) = (left[*k] - 1, true);
            }
        }
        if !is_shorter || coarse.by.is_err() {
            return Ok((answer, steps, Some(coarse)));
        }
        for (unknown, value) in unknowns.iter_mut().zip(&answer.values) {
            unknown.start = *value;
        }
    }
}

/// Whether shorter steps of all recordings together move a value noticeably, or cannot be run. `parts`: the recordings.
fn coarse(parts: &[usize], shifts: &[Result<Vec<f64>, String>]) -> Option<Coarse> {
    let failed = parts.iter().zip(shifts).find_map(|(part, shift)| Some((*part, shift.as_ref().err()?)));
    if let Some((part, why)) = failed {
        return Some(Coarse { part, by: Err(why.clone()) });
    }
    let known: Vec<&Vec<f64>> = shifts.iter().flatten().collect();
    let sum = |k: usize| known.iter().map(|shift| shift[k]).sum::<f64>().abs();
    let unknowns = known.first().map_or(0, |shift| shift.len());
    let worst = (0..unknowns).filter(|k| sum(*k) > PART_OF_DEVIATION).max_by(|a, b| sum(*a).total_cmp(&sum(*b)))?;
    let largest = (0..known.len()).max_by(|a, b| known[*a][worst].abs().total_cmp(&known[*b][worst].abs()))?;
    Some(Coarse { part: parts[largest], by: Ok((worst, sum(worst))) })
}
