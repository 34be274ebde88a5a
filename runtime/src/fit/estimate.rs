//! The procedure of a fit: from a start to values with intervals.
//!
//! In: a [`Question`]. Out: an [`Answer`], or a [`Trouble`]. Several starts are judged, and searches follow the best
//! of them until two end alike. Where a model may have many local minima, they follow a path: runs that are held to
//! the data, less and less (an observer whose gain falls to zero), or over a growing part of the rows. Output error,
//! weighted by a noise model: first white noise, then twice an autoregressive model of the residuals, with which
//! residuals and derivatives are whitened and the search continues. Where whitening moves the values further than
//! noise could, the residuals are no noise, and the estimate remains that of least squares. Derivatives are
//! differences of a size that the noise determines: central ones, or one-sided ones in the stages of a path. A robust
//! fit minimises Huber's loss of the whitened residuals once the minimum has been found; its bounds follow from the
//! residuals before each search, and are constant while it lasts, so that the loss only falls.

use crate::fit::journal::{Journal, Numbers, Stage, of_list, of_noise};
use crate::fit::least_squares::{Triangle, singular};
use crate::fit::loss;
use crate::fit::noise::{Noise, Whitening};
use crate::fit::quantiles;
use crate::fit::sandwich::{Correlation, Stretch, Windows};
use crate::fit::trust_region::{Ended, Limits, Objective, minimise};
use crate::fit::unknowns::{Elementary, Scale, Unknown};
use crate::rng::Chance;
use std::collections::BTreeMap;
use std::ops::Range;
use std::rc::Rc;

/// Differences between model and measurement: for each item, a number for each row.
pub type Residuals = Vec<Vec<f64>>;

/// Runs the model.
pub trait Runs {
    /// Runs it in this way with each of these sets of values, in SI, in the order of the unknowns. An error says why a run
    /// failed.
    fn run(&mut self, way: Way, points: &[Vec<f64>]) -> Vec<Result<Residuals, String>>;

    /// The same for more runs than fit into memory: passes their residuals some rows after the other.
    fn pass(&mut self, way: Way, points: &[Vec<f64>], each: &mut dyn FnMut(&Tile)) -> Vec<Result<(), String>> {
        let all = self.run(way, points);
        let items = all.iter().flatten().map(Vec::len).next().unwrap_or(0);
        let rows = all.iter().map(|one| one.as_deref().ok()).collect();
        each(&Tile { items: 0..items, rows, is_all: true });
        all.into_iter().map(|one| one.map(|_| ())).collect()
    }
}

impl<F: FnMut(Way, &[Vec<f64>]) -> Vec<Result<Residuals, String>>> Runs for F {
    fn run(&mut self, way: Way, points: &[Vec<f64>]) -> Vec<Result<Residuals, String>> {
        self(way, points)
    }
}

/// The next rows of some compared quantities.
pub struct Tile<'t> {
    /// The quantities.
    pub items: Range<usize>,
    /// For each run the rows of each of them; none if it has failed.
    pub rows: Vec<Option<&'t [Vec<f64>]>>,
    /// Whether these are all their rows.
    pub is_all: bool,
}

/// Runs the model with these values, in SI, and shorter steps: for one recording after the other, its items, and what
/// they leave then. An error says why a run failed.
pub type Finer<'a> = dyn FnMut(&[f64]) -> Vec<(Range<usize>, Result<Residuals, String>)> + 'a;

/// How the model is run.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Way {
    /// Over all rows.
    Whole,
    /// Over the first rows only: this part of them.
    First(f64),
    /// Over all rows, and held to the data by an observer with this pole, in intervals of the rows.
    Held(f64),
}

/// What is known of the minima of a question, which decides on paths.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Minima {
    /// Runs can be held to the data.
    pub held: bool,
    /// The recording drives the motion of every run, so that other minima are rare.
    pub driven: bool,
    /// The model has regimes, so that other minima are frequent.
    pub regimes: bool,
}

/// A compared quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Item {
    /// Standard deviation of its measurement, if known.
    pub sd: Option<f64>,
    /// How its rows follow each other.
    pub rows: Rows,
}

/// How rows follow each other, which decides on a model of their noise.
#[derive(Clone, PartialEq, Debug)]
pub enum Rows {
    /// They are independent measurements, so that their noise is white.
    Independent,
    /// In equal intervals, but for gaps before these rows.
    Even(Vec<usize>),
    /// In different intervals: no filter makes their noise white.
    Uneven,
}

/// How values are estimated.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Estimator {
    /// From whitened residuals, unless these are no noise.
    Chosen,
    /// From whitened residuals.
    Whitened,
    /// By least squares of the residuals as they are, with a sandwich for their covariance.
    LeastSquares,
}

/// What to fit.
pub struct Question<'a> {
    /// The unknowns; at least one.
    pub unknowns: &'a [Unknown],
    /// The compared quantities; at least one.
    pub items: &'a [Item],
    /// What is known of other minima.
    pub minima: Minima,
    /// Runs the model.
    pub run: &'a mut (dyn Runs + 'a),
    /// Runs it with shorter steps, where their effect on the values is of interest.
    pub finer: Option<&'a mut Finer<'a>>,
    /// Elementary functions.
    pub with: Elementary<'a>,
    /// Probability of the intervals.
    pub level: f64,
    /// When a search ends.
    pub limits: Limits,
    /// Number of starts that are judged, the written one among them.
    pub starts: usize,
    /// Seed of the other starts.
    pub seed: u64,
    /// How the values are estimated.
    pub estimator: Estimator,
    /// Whether large residuals count by their size and not by its square.
    pub robust: bool,
    /// Keeps the stages of the search, and gives those of an earlier one.
    pub journal: Option<&'a mut (dyn Journal + 'a)>,
}

/// Why a fit gives no answer.
#[derive(Clone, PartialEq, Debug)]
pub enum Trouble {
    /// The model cannot be run at the start, and why.
    NoStart(String),
    /// These unknowns change nothing that is compared.
    NoInfluence(Vec<usize>),
    /// There are fewer rows than unknowns: rows, unknowns.
    TooFewRows(usize, usize),
}

/// A direction in the space of coordinates that the data determine badly.
#[derive(Clone, PartialEq, Debug)]
pub struct Combination {
    /// How many standard deviations of noise the outputs move for a step of 1 in this direction.
    pub sensitivity: f64,
    /// Components for each unknown, of length 1.
    pub direction: Vec<f64>,
}

/// What the data say.
#[derive(Clone, PartialEq, Debug)]
pub struct Answer {
    /// Values in SI.
    pub values: Vec<f64>,
    /// Standard deviations in SI.
    pub sd: Vec<f64>,
    /// Intervals in SI. In the scale of the unknown, so that a positive parameter has positive bounds.
    pub intervals: Vec<(f64, f64)>,
    /// Correlations, row by row.
    pub correlation: Vec<f64>,
    /// Unknowns that ended at a bound: whether it is the upper one.
    pub at_bound: Vec<Option<bool>>,
    /// Combinations known to worse than 25 % of their scale.
    pub undetermined: Vec<Combination>,
    /// Unknowns whose differences of two sizes disagree.
    pub rough: Vec<usize>,
    /// Noise of each item.
    pub noise: Vec<Noise>,
    /// The noise by which the residuals are weighted: white, where they are no noise or have no filter.
    pub weights: Vec<Noise>,
    /// The residuals are no noise: whitening would move the values further than noise could.
    pub misfits: bool,
    /// How often the variance of each value is that of white residuals, where a sandwich gives it; else 1.
    pub inflation: Vec<f64>,
    /// Root mean square of the residuals of each item.
    pub rms: Vec<f64>,
    /// χ² of the whitened residuals for each degree of freedom. For known standard deviations: 1 if they are right.
    pub chi_square: f64,
    /// Degrees of freedom.
    pub degrees: f64,
    /// Residuals.
    pub residuals: Residuals,
    /// How the search ended.
    pub why: Ended,
    /// Starts that were judged.
    pub starts: usize,
    /// Searches that were followed to their ends.
    pub followed: usize,
    /// Searches that ended where the best did.
    pub agreed: usize,
    /// Where each search ended: −2 log-likelihood with white noise, up to a constant.
    pub ends: Vec<f64>,
    /// For each recording of [`Question::finer`]: by how much the shorter steps move each value, in its standard
    /// deviations, or why they cannot be run.
    pub shifts: Vec<Result<Vec<f64>, String>>,
    /// Number of runs, and how many of them failed for each cause.
    pub runs: u64,
    /// Causes of failed runs, with their numbers.
    pub failures: BTreeMap<String, u64>,
}

/// Sizes of differences, in coordinates: the first one, and limits.
const FIRST_DIFFERENCE: f64 = 1e-3;
const DIFFERENCES: (f64, f64) = (1e-5, 1e-2);
/// A difference moves the outputs by this fraction of what the noise could hide.
const PART_OF_NOISE: f64 = 0.3;
/// Below this sensitivity, a combination is known to worse than 25 %.
const LEAST_SENSITIVITY: f64 = 4.0;
/// Relative difference of two columns above which they disagree.
const ROUGH: f64 = 0.05;
/// Searches of a robust fit before the noise is modelled, each with bounds from what the one before left.
const ROBUST_ROUNDS: u32 = 3;
/// Rounds of weights for several items of unknown noise.
const MOST_ROUNDS: u32 = 6;
/// Starts that are run at once: their residuals are in memory together.
const JUDGED_AT_ONCE: usize = 16;
/// Fewest and most searches that are followed to their ends, where there are as many starts.
const LEAST_FOLLOWED: usize = 3;
const MOST_FOLLOWED: usize = 6;
/// The same for models with regimes.
const MOST_FOLLOWED_WITH_REGIMES: usize = 8;
/// Poles of the observer in the stages of a path.
const POLES: [f64; 3] = [0.3, 0.03, 0.003];
/// Parts of the rows in the stages of a path.
const PARTS: [f64; 4] = [0.25, 0.35, 0.5, 0.7];
/// Most trials of a stage of a path, and its tolerance. One of 1e-4 takes a third more time and leads to no other ends.
const OF_STAGE: Limits = Limits { trials: 15, tolerance: 1e-3 };
/// Searches whose −2 log-likelihoods differ by less ended in the same minimum.
const SAME_END: f64 = 0.5;
/// Those whose −2 log-likelihoods differ by less are equal.
const EQUAL_END: f64 = 1e-3;
/// A coordinate this near to a bound is at it, as a fraction of the range.
const AT_BOUND: f64 = 1e-6;
/// The part of the range in which a coordinate at a bound stays.
const HELD_AT_BOUND: f64 = 1e-7;
/// Probability with which noise would move the values as far as whitening did, below which residuals are no noise.
const NO_NOISE: f64 = 1e-3;

/// Finds the values that fit best, from the start.
///
/// # Errors
/// Why there is no answer.
pub fn fit(question: Question) -> Result<Answer, Trouble> {
    let Question { unknowns, items, minima, run, finer, with, level, limits, starts, seed, estimator, robust, journal } =
        question;
    let n = unknowns.len();
    assert!(n > 0 && !items.is_empty(), "{n} unknowns, {} items", items.len());
    let scale = Scale { unknowns, with };
    let mut search = Search::new(scale, items, run);
    search.journal = journal;
    let (low, high) = (search.low.clone(), search.high.clone());
    let written = scale.coordinates(&unknowns.iter().map(|unknown| unknown.start).collect::<Vec<f64>>());
    let (judged, rows) = search.judge(items, &spread(&written, &low, &high, starts, seed)).map_err(Trouble::NoStart)?;
    if rows <= n {
        return Err(Trouble::TooFewRows(rows, n));
    }
    let mut ends: Vec<Followed> = Vec::new();
    let most = if minima.regimes { MOST_FOLLOWED_WITH_REGIMES } else { MOST_FOLLOWED };
    for (order, start) in judged.into_iter().take(most).enumerate() {
        for path in paths(minima, order) {
            let stage = search.staged(|search| {
                let Some(begin) = search.along(items, &start, path) else { return Ok(Vec::new()) };
                let followed = search.follow(items, begin, limits)?;
                Ok(followed.map_or(Vec::new(), |followed| followed.numbers()))
            })?;
            ends.extend(Followed::read(&stage));
        }
        if agreed(&ends) >= 2 && ends.len() >= LEAST_FOLLOWED {
            break;
        }
    }
    // At one start a model may rest, and depend on nothing.
    let idle: Vec<usize> = (0..n).filter(|k| !search.influence[*k]).collect();
    if !ends.is_empty() && !idle.is_empty() {
        return Err(Trouble::NoInfluence(idle));
    }
    let followed = (ends.iter().map(|end| end.misfit).collect(), agreed(&ends));
    // Of equal ends the first one: in a flat valley, that of the written start.
    let least = ends.iter().map(|end| end.misfit).fold(f64::INFINITY, f64::min);
    let best = ends.into_iter().find(|end| end.misfit - least <= EQUAL_END);
    let Some(Followed { mut x, mut why, noise, .. }) = best else { return Err(Trouble::NoStart(search.commonest())) };
    search.noise = noise;
    search.robust = robust;
    for _ in 0..if robust { ROBUST_ROUNDS } else { 0 } {
        let Some(found) = search.again(items, &x, (&low, &high), false, limits)? else { break };
        (x, why) = (found.x, found.why);
    }
    // A model error that a bound causes looks like correlated noise, in which the parameter would leave the bound.
    let (mut from, mut to) = (low.clone(), high.clone());
    for k in 0..n {
        match search.at_bound(&x, k) {
            Some(Edge::Low) => to[k] = low[k] + HELD_AT_BOUND * (high[k] - low[k]),
            Some(Edge::High) => from[k] = high[k] - HELD_AT_BOUND * (high[k] - low[k]),
            None => {}
        }
    }
    let mut outcome = Outcome { why, starts, followed, misfits: false, finer };
    let even = |item: &Item| matches!(item.rows, Rows::Even(_));
    if estimator == Estimator::LeastSquares || !items.iter().any(even) {
        outcome.misfits = estimator == Estimator::LeastSquares;
        return search.conclude(items, &x, level, outcome);
    }
    let plain = (x.clone(), search.noise.clone());
    // Twice: a noise model of the residuals, and on from there.
    for _ in 0..2 {
        let Some(found) = search.again(items, &x, (&from, &to), true, limits)? else { break };
        x = found.x;
        outcome.why = found.why;
    }
    if estimator == Estimator::Chosen && search.misfits(items, (&plain.0, &plain.1), &x) {
        x = plain.0;
        search.noise = plain.1;
        (outcome.why, outcome.misfits) = (why, true);
    }
    search.conclude(items, &x, level, outcome)
}

/// How a search ended, and where those followed did.
struct Outcome<'a> {
    why: Ended,
    starts: usize,
    followed: (Vec<f64>, usize),
    /// The residuals are no noise.
    misfits: bool,
    /// Runs the model with shorter steps.
    finer: Option<&'a mut Finer<'a>>,
}

/// The paths from the start of this order, each followed to its end. Where a minimum is easily missed, a plain search
/// ends in the right one from few starts only.
fn paths(minima: Minima, order: usize) -> Vec<Vec<Way>> {
    let growing = || PARTS.map(Way::First).to_vec();
    match minima {
        _ if order == 0 => vec![Vec::new()],
        Minima { regimes: true, .. } => vec![Vec::new(), growing()],
        Minima { held: true, .. } => vec![POLES.map(Way::Held).to_vec()],
        Minima { driven: true, .. } if order < LEAST_FOLLOWED => vec![Vec::new()],
        Minima { .. } => vec![growing()],
    }
}

/// Where a search from one start ended, with white noise.
struct Followed {
    x: Vec<f64>,
    why: Ended,
    noise: Vec<Noise>,
    /// −2 log-likelihood, up to a constant.
    misfit: f64,
}

/// How searches end, by their numbers in a stage.
const ENDS: [Ended; 5] = [Ended::Gradient, Ended::Small, Ended::Trials, Ended::Stuck, Ended::NoStart];

impl Followed {
    /// The numbers of a stage.
    fn numbers(&self) -> Vec<f64> {
        let why = ENDS.iter().position(|end| *end == self.why).expect("it is one of them") as f64;
        let noise = self.noise.iter().flat_map(of_noise);
        [self.misfit, why].into_iter().chain(of_list(&self.x)).chain([self.noise.len() as f64]).chain(noise).collect()
    }

    /// What the numbers of a stage say; none if there are none.
    fn read(numbers: &[f64]) -> Option<Followed> {
        let mut numbers = Numbers(numbers);
        let (misfit, why, x) = (numbers.one()?, *ENDS.get(numbers.one()? as usize)?, numbers.list()?);
        let items = numbers.one()? as usize;
        let noise = (0..items).map(|_| numbers.noise()).collect::<Option<_>>()?;
        Some(Followed { x, why, noise, misfit })
    }
}

/// The number of searches that ended where the best did.
fn agreed(ends: &[Followed]) -> usize {
    let least = ends.iter().map(|end| end.misfit).fold(f64::INFINITY, f64::min);
    ends.iter().filter(|end| end.misfit - least <= SAME_END).count()
}

/// The written start, then a Latin hypercube (McKay, Beckman, Conover 1979) between the bounds.
fn spread(written: &[f64], low: &[f64], high: &[f64], starts: usize, seed: u64) -> Vec<Vec<f64>> {
    let more = starts.saturating_sub(1);
    let mut chance = Chance(seed);
    let mut all = vec![written.to_vec(); more + 1];
    for k in 0..written.len() {
        let mut cells: Vec<usize> = (0..more).collect();
        for last in (1..more).rev() {
            cells.swap(last, chance.below(last as u64 + 1) as usize);
        }
        for (start, cell) in all[1..].iter_mut().zip(cells) {
            start[k] = low[k] + (high[k] - low[k]) * (cell as f64 + chance.fraction()) / more as f64;
        }
    }
    all
}

/// A bound of a coordinate.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Edge {
    Low,
    High,
}

/// The state of a search.
struct Search<'a> {
    scale: Scale<'a>,
    run: &'a mut (dyn Runs + 'a),
    /// How the model is run at present.
    way: Way,
    /// In a stage of a path: each coordinate is expected within one unit of this point.
    prior: Option<Vec<f64>>,
    /// Large residuals count by their size.
    robust: bool,
    low: Vec<f64>,
    high: Vec<f64>,
    noise: Vec<Noise>,
    /// Sizes of the differences.
    sizes: Vec<f64>,
    /// The last point that was run, with its residuals.
    last: Option<(Vec<f64>, Rc<Residuals>)>,
    /// Unknowns that have changed something.
    influence: Vec<bool>,
    runs: u64,
    failures: BTreeMap<String, u64>,
    journal: Option<&'a mut (dyn Journal + 'a)>,
}

impl<'a> Search<'a> {
    /// Of all rows, with white noise, by the first sizes of differences.
    fn new(scale: Scale<'a>, items: &[Item], run: &'a mut (dyn Runs + 'a)) -> Search<'a> {
        let (low, high) = scale.bounds();
        let n = low.len();
        Search {
            scale,
            run,
            way: Way::Whole,
            prior: None,
            robust: false,
            low,
            high,
            noise: items.iter().map(|item| Noise::white(item.sd.map_or(1.0, |sd| sd * sd))).collect(),
            sizes: vec![FIRST_DIFFERENCE; n],
            last: None,
            influence: vec![false; n],
            runs: 0,
            failures: BTreeMap::new(),
            journal: None,
        }
    }

    /// A stage of the search, or what an earlier search has kept of it: the numbers that follow from it. The rest of the
    /// search depends on these, and on what [`Search::state`] holds, alone.
    fn staged(&mut self, stage: impl FnOnce(&mut Self) -> Result<Vec<f64>, Trouble>) -> Result<Vec<f64>, Trouble> {
        self.last = None;
        let earlier = self.journal.as_mut().and_then(|journal| journal.next());
        if let Some(numbers) = earlier.and_then(|stage| self.restore(&stage)) {
            return Ok(numbers);
        }
        let numbers = stage(self)?;
        self.last = None;
        let stage = self.state(&numbers);
        if let Some(journal) = &mut self.journal {
            journal.note(&stage);
        }
        Ok(numbers)
    }

    /// What a stage leaves, with its numbers.
    fn state(&self, numbers: &[f64]) -> Stage {
        let influence: Vec<f64> = self.influence.iter().map(|has| f64::from(u8::from(*has))).collect();
        Stage {
            numbers: [vec![self.runs as f64], influence, self.sizes.clone(), numbers.to_vec()].concat(),
            words: self.failures.iter().map(|(why, times)| format!("{times} {why}")).collect(),
        }
    }

    /// Enters what a stage has left; returns its numbers. None for a stage of another question.
    fn restore(&mut self, stage: &Stage) -> Option<Vec<f64>> {
        let n = self.sizes.len();
        let mut numbers = Numbers(&stage.numbers);
        let (runs, influence, sizes) = (numbers.one()?, numbers.some(n)?, numbers.some(n)?);
        let failure = |word: &String| {
            let (times, why) = word.split_once(' ')?;
            Some((why.to_string(), times.parse().ok()?))
        };
        self.failures = stage.words.iter().map(failure).collect::<Option<_>>()?;
        self.influence = influence.iter().map(|has| *has != 0.0).collect();
        (self.runs, self.sizes) = (runs as u64, sizes);
        Some(numbers.0.to_vec())
    }

    fn values(&self, x: &[f64]) -> Vec<f64> {
        self.scale.values(x)
    }

    /// Counts runs and those that failed. `again`: the points have been run before.
    fn count<T>(&mut self, all: &[Result<T, String>], again: bool) {
        self.runs += if again { 0 } else { all.len() as u64 };
        for why in all.iter().filter_map(|one| one.as_ref().err()) {
            *self.failures.entry(why.clone()).or_default() += 1;
        }
    }

    fn residuals(&mut self, x: &[f64]) -> Result<Rc<Residuals>, String> {
        if let Some((_, residuals)) = self.last.as_ref().filter(|(at, _)| at == x) {
            return Ok(residuals.clone());
        }
        let mut all = self.run.run(self.way, &[self.scale.values(x)]);
        self.count(&all, false);
        let residuals = Rc::new(all.remove(0)?);
        self.last = Some((x.to_vec(), residuals.clone()));
        Ok(residuals)
    }

    /// Runs the model in this way from now on.
    fn enter(&mut self, way: Way, prior: Option<Vec<f64>>) {
        self.last = None;
        (self.way, self.prior) = (way, prior);
    }

    /// Where a path leads to from a start; none if one of its stages cannot be run. A weak prior keeps what a stage does
    /// not determine where it was.
    fn along(&mut self, items: &[Item], start: &[f64], path: Vec<Way>) -> Option<Vec<f64>> {
        let (low, high) = (self.low.clone(), self.high.clone());
        let mut x = start.to_vec();
        let mut possible = true;
        for way in path {
            self.sizes = vec![FIRST_DIFFERENCE; x.len()];
            self.enter(way, Some(x.clone()));
            let Ok(residuals) = self.residuals(&x) else {
                possible = false;
                break;
            };
            self.weigh(items, &residuals, false);
            let end = minimise(&x, &low, &high, self, OF_STAGE);
            if end.why == Ended::NoStart {
                possible = false;
                break;
            }
            x = end.x;
        }
        self.enter(Way::Whole, None);
        (possible && self.residuals(&x).is_ok()).then_some(x)
    }

    fn commonest(&self) -> String {
        let most = self.failures.iter().max_by_key(|(_, count)| **count);
        most.map_or_else(|| "the run gives no finite numbers".into(), |(why, _)| why.clone())
    }

    /// The bound at which a coordinate is.
    fn at_bound(&self, x: &[f64], k: usize) -> Option<Edge> {
        let margin = AT_BOUND * (self.high[k] - self.low[k]);
        if x[k] - self.low[k] < margin {
            Some(Edge::Low)
        } else if self.high[k] - x[k] < margin {
            Some(Edge::High)
        } else {
            None
        }
    }

    /// The starts that can be run: the written one, then the others by their misfit; and the number of their residuals.
    ///
    /// # Errors
    /// The commonest cause, if none can be run.
    fn judge(&mut self, items: &[Item], starts: &[Vec<f64>]) -> Result<(Vec<Vec<f64>>, usize), String> {
        let (mut misfits, mut rows) = (Vec::new(), 0);
        for first in (0..starts.len()).step_by(JUDGED_AT_ONCE) {
            let some = &starts[first..starts.len().min(first + JUDGED_AT_ONCE)];
            let stage = self.staged(|search| {
                let (misfits, rows) = search.misfits_at(items, some);
                let all = misfits.into_iter().enumerate().filter_map(|(k, misfit)| Some([(first + k) as f64, misfit?]));
                Ok([vec![rows as f64], all.flatten().collect()].concat())
            });
            let stage = stage.unwrap_or_default();
            let Some((count, all)) = stage.split_first() else { continue };
            rows = rows.max(*count as usize);
            misfits.extend(all.chunks_exact(2).map(|pair| (pair[0] as usize, pair[1])));
        }
        if misfits.is_empty() {
            return Err(self.commonest());
        }
        // Failures are those of the search.
        self.failures.clear();
        misfits.sort_by(|a, b| (a.0 != 0).cmp(&(b.0 != 0)).then(a.1.total_cmp(&b.1)));
        Ok((misfits.into_iter().map(|(k, _)| starts[k].clone()).collect(), rows))
    }

    /// How badly some starts fit, and the number of residuals of each; none for those that cannot be run.
    fn misfits_at(&mut self, items: &[Item], starts: &[Vec<f64>]) -> (Vec<Option<f64>>, usize) {
        let (with, way) = (&self.scale.with, self.way);
        let values: Vec<Vec<f64>> = starts.iter().map(|x| self.values(x)).collect();
        let zeros = vec![vec![0.0; items.len()]; starts.len()];
        // Of each start and item: the sum of squares, and the misfit.
        let (mut squares, mut misfits, mut rows, mut is_known) = (zeros.clone(), zeros, vec![0; items.len()], true);
        let ended = self.run.pass(way, &values, &mut |tile| {
            let count =
                |item: usize| tile.rows.iter().flatten().map(|rows: &&[Vec<f64>]| rows[item].len()).next().unwrap_or(0);
            for (item, k) in tile.items.clone().enumerate() {
                rows[k] += count(item);
                for (start, residuals) in tile.rows.iter().enumerate() {
                    let Some(residuals) = residuals.map(|residuals| &residuals[item]) else { continue };
                    squares[start][k] = residuals.iter().fold(squares[start][k], |sum, r| sum + r * r);
                    match (tile.is_all, items[k].sd) {
                        (true, _) => misfits[start][k] = misfit(&items[k], mean_square(residuals), residuals, with),
                        (false, Some(_)) => misfits[start][k] += misfit(&items[k], 1.0, residuals, with),
                        (false, None) => is_known = false,
                    }
                }
            }
        });
        // The scale of a misfit is known once all rows are.
        if !is_known {
            self.run.pass(way, &values, &mut |tile| {
                for (item, k) in tile.items.clone().enumerate().filter(|(_, k)| !tile.is_all && items[*k].sd.is_none())
                {
                    for (start, residuals) in tile.rows.iter().enumerate() {
                        let Some(residuals) = residuals.map(|residuals| &residuals[item]) else { continue };
                        let mean = squares[start][k] / rows[k].max(1) as f64;
                        misfits[start][k] += misfit(&items[k], mean, residuals, with);
                    }
                }
            });
        }
        self.count(&ended, false);
        let misfits = ended.iter().zip(misfits).map(|(ended, all)| ended.is_ok().then(|| all.iter().sum()));
        (misfits.collect(), rows.iter().sum())
    }

    /// Searches from a start with white noise, weighted by its size in each item, until the weights settle. None if the
    /// model cannot be run around it.
    fn follow(&mut self, items: &[Item], start: Vec<f64>, limits: Limits) -> Result<Option<Followed>, Trouble> {
        let (low, high) = (self.low.clone(), self.high.clone());
        self.sizes = vec![FIRST_DIFFERENCE; start.len()];
        let residuals = self.residuals(&start).map_err(Trouble::NoStart)?;
        self.weigh(items, &residuals, false);
        let mut x = start;
        for round in 1.. {
            let end = minimise(&x, &low, &high, self, limits);
            if end.why == Ended::NoStart {
                return Ok(None);
            }
            x.clone_from(&end.x);
            let residuals = self.residuals(&x).map_err(Trouble::NoStart)?;
            let settled = !self.weigh(items, &residuals, false);
            if settled || items.len() == 1 || round >= MOST_ROUNDS {
                let of = |(item, rows): (&Item, &Vec<f64>)| match item.sd {
                    Some(sd) => rows.len() as f64 * mean_square(rows) / (sd * sd),
                    None => rows.len() as f64 * (self.scale.with.log)(mean_square(rows).max(f64::MIN_POSITIVE)),
                };
                let misfit = items.iter().zip(&*residuals).map(of).sum();
                return Ok(Some(Followed { x: end.x, why: end.why, noise: self.noise.clone(), misfit }));
            }
        }
        unreachable!("the rounds end")
    }

    /// Searches on from `x`, within these bounds, under a model of the noise there. None if it cannot be run around it.
    fn again(
        &mut self,
        items: &[Item],
        x: &[f64],
        (low, high): (&[f64], &[f64]),
        correlated: bool,
        limits: Limits,
    ) -> Result<Option<Followed>, Trouble> {
        let stage = self.staged(|search| {
            let residuals = search.residuals(x).map_err(Trouble::NoStart)?;
            search.weigh(items, &residuals, correlated);
            let found = minimise(x, low, high, search, limits);
            Ok(Followed { x: found.x, why: found.why, noise: search.noise.clone(), misfit: found.cost }.numbers())
        })?;
        let Some(found) = Followed::read(&stage) else { return Ok(None) };
        self.noise.clone_from(&found.noise);
        Ok(Some(found).filter(|found| found.why != Ended::NoStart))
    }

    /// A model of the noise of each item from its residuals.
    fn noise_of(&self, items: &[Item], residuals: &Residuals, correlated: bool) -> Vec<Noise> {
        let one = |(item, residuals): (&Item, &Vec<f64>)| {
            // Where most residuals are 0 none is an outlier.
            let robust = Some(loss::deviation(residuals)).filter(|sd| self.robust && *sd > 0.0);
            let mean = robust.map_or_else(|| mean_square(residuals), |sd| sd * sd);
            let most = robust.map_or(f64::INFINITY, |sd| loss::SOUND * sd);
            let noise = match &item.rows {
                Rows::Even(gaps) if correlated => Noise::of(residuals, gaps, most, &self.scale.with),
                Rows::Even(_) | Rows::Independent | Rows::Uneven => Noise::white(mean),
            };
            // Data that a model fits exactly have no noise to weigh by.
            let variance = item.sd.map_or(mean.max(f64::MIN_POSITIVE), |sd| sd * sd);
            let noise = Noise { variance, ..noise };
            let bound = robust.map_or(f64::INFINITY, |_| loss::BOUND * loss::deviation(&noise.whitened(residuals)));
            Noise { bound: if bound > 0.0 { bound } else { f64::INFINITY }, ..noise }
        };
        items.iter().zip(residuals).map(one).collect()
    }

    /// Weighs by a model of the noise. Returns whether a weight has changed by more than 2 %.
    fn weigh(&mut self, items: &[Item], residuals: &Residuals, correlated: bool) -> bool {
        let now = self.noise_of(items, residuals, correlated);
        let before = std::mem::replace(&mut self.noise, now);
        let changes = |(now, before): (&Noise, &Noise)| (now.variance / before.variance - 1.0).abs() > 0.02;
        self.noise.iter().zip(&before).any(changes)
    }

    /// What is known beforehand, as residuals.
    fn known(&self, x: &[f64]) -> Vec<f64> {
        let values = self.values(x);
        let known = self.scale.unknowns.iter().zip(values).filter_map(|(unknown, value)| {
            let (expected, sd) = unknown.known?;
            Some((value - expected) / sd)
        });
        let prior = self.prior.iter().flat_map(|prior| x.iter().zip(prior).map(|(x, prior)| x - prior));
        known.chain(prior).collect()
    }

    /// The bounds of the whitened residuals of each item, beyond which they count by their size.
    fn bounds(&self) -> Vec<f64> {
        self.noise.iter().map(|noise| if self.robust { noise.bound } else { f64::INFINITY }).collect()
    }

    /// The loss of the whitened residuals of all items and of what is known beforehand: their sum of squares, in least
    /// squares. Then the sum of squares of the rows as they are weighted, and their number.
    fn sums(&self, x: &[f64], residuals: &Residuals) -> (f64, f64, usize) {
        let white = self.noise.iter().zip(residuals).zip(self.bounds());
        let white = white.flat_map(|((noise, residuals), bound)| noise.whitening(residuals).map(move |r| (r, bound)));
        let known = self.known(x).into_iter().map(|r| (r, f64::INFINITY));
        white.chain(known).fold((0.0, 0.0, 0), |(loss, square, count), (r, bound)| {
            let weighted = loss::root_weight(r, bound) * r;
            (loss + loss::loss(r, bound), square + weighted * weighted, count + 1)
        })
    }

    /// Columns of the Jacobian of the whitened residuals, by differences, some rows after the other; none if the model
    /// cannot be run around this point. `parts`: sizes of the differences as fractions, each with columns of its own.
    /// `again`: the same has been asked before. The rows are added to what `new` makes, in their order.
    fn jacobian<A>(
        &mut self,
        x: &[f64],
        (parts, again): (&[f64], bool),
        new: &dyn Fn() -> A,
        add: &mut dyn FnMut(&mut A, &Piece),
    ) -> Option<A> {
        let (n, pairs) = (x.len(), parts.len() * x.len());
        let middle = self.residuals(x).ok()?;
        // The point above or below for a column; none where a bound is too near to it.
        let moved = |search: &Self, at: usize| {
            let (k, by) = (at / 2 % n, parts[at / 2 / n] * search.sizes[at / 2 % n]);
            let (low, high) = (search.low[k], search.high[k]);
            let mut moved = x.to_vec();
            moved[k] = (x[k] + if at.is_multiple_of(2) { by } else { -by }).clamp(low, high);
            ((moved[k] - x[k]).abs() >= 0.1 * by.min(high - low)).then_some(moved)
        };
        // A stage of a path only has to lead on, and one side is enough for that: half the runs.
        let mut may_turn = self.prior.is_some();
        let both = |pair: usize| match (moved(self, 2 * pair), moved(self, 2 * pair + 1)) {
            (Some(above), _) if may_turn => [Some(above), None],
            (above, below) => [above, below],
        };
        // None stands for the point in the middle.
        let mut points: Vec<Option<Vec<f64>>> = (0..pairs).flat_map(both).collect();
        let mut again = again;
        loop {
            let at: Vec<usize> = (0..points.len()).filter(|at| points[*at].is_some()).collect();
            let values: Vec<Vec<f64>> = points.iter().flatten().map(|x| self.values(x)).collect();
            let coordinate = |at: usize| points[at].as_deref().unwrap_or(x)[at / 2 % n];
            let inverse = |pair: usize| 1.0 / (coordinate(2 * pair) - coordinate(2 * pair + 1));
            let inverses: Vec<f64> = (0..pairs).map(inverse).collect();
            let mut sum = new();
            let Search { run, noise, influence, .. } = self;
            let filters = || noise.iter().map(Whitening::new).collect::<Vec<_>>();
            let (mut own, mut of_runs): (Vec<_>, Vec<_>) = (filters(), at.iter().map(|_| filters()).collect());
            let mut begins = vec![0; noise.len()];
            let mut changed = vec![false; n];
            let ended = run.pass(self.way, &values, &mut |tile| {
                // What is added would be in vain once a run has failed.
                let Some(rows) = tile.rows.iter().copied().collect::<Option<Vec<&[Vec<f64>]>>>() else { return };
                for (item, k) in tile.items.clone().enumerate() {
                    let range = begins[k]..begins[k] + rows[0][item].len();
                    begins[k] = range.end;
                    let unmoved = &middle[k][range.clone()];
                    let white = own[k].of(unmoved);
                    let mut runs = rows.iter().zip(&mut of_runs).zip(&at).map(|((rows, filters), at)| {
                        changed[at / 2 % n] |= rows[item] != unmoved;
                        filters[k].of(&rows[item])
                    });
                    let mut side = |at: usize| points[at].as_ref().and_then(|_| runs.next());
                    let column = |pair: usize| {
                        let (above, below) = (side(2 * pair), side(2 * pair + 1));
                        let (above, below) = (above.as_deref().unwrap_or(&white), below.as_deref().unwrap_or(&white));
                        above.iter().zip(below).map(|(a, b)| inverses[pair] * (a - b)).collect::<Vec<f64>>()
                    };
                    let columns: Vec<Vec<f64>> = (0..pairs).map(column).collect();
                    add(&mut sum, &Piece { item: Some(k), range, white, columns });
                }
            });
            let failed: Vec<usize> =
                at.iter().zip(&ended).filter(|(_, ended)| ended.is_err()).map(|(at, _)| *at).collect();
            if failed.is_empty() {
                influence.iter_mut().zip(changed).for_each(|(has, changed)| *has |= changed);
            }
            self.count(&ended, again);
            if failed.is_empty() {
                let known: Vec<Vec<f64>> =
                    points.iter().map(|point| self.known(point.as_deref().unwrap_or(x))).collect();
                let column = |pair: usize| {
                    let sides = known[2 * pair].iter().zip(&known[2 * pair + 1]);
                    sides.map(|(a, b)| inverses[pair] * (a - b)).collect::<Vec<f64>>()
                };
                let columns = (0..pairs).map(column).collect();
                add(&mut sum, &Piece { item: None, range: 0..0, white: self.known(x), columns });
                return Some(sum);
            }
            // Where one side cannot be run, the difference of the other one to the middle takes its place.
            for at in failed {
                points[at] = None;
                if may_turn {
                    points[at ^ 1] = moved(self, at ^ 1);
                }
                points[at ^ 1].as_ref()?;
            }
            may_turn = false;
            again = true;
        }
    }

    /// The Jacobian and what follows from it. `parts`: as in [`Search::jacobian`]; the first one counts.
    fn linear(&mut self, items: &[Item], x: &[f64], parts: &[f64]) -> Option<Linear> {
        let stretches = {
            let residuals = self.residuals(x).ok()?;
            self.stretches(items, &residuals)
        };
        let n = x.len();
        let sizes = self.sizes.clone();
        let new = || Linear::new(n, &stretches, &sizes);
        self.jacobian(x, (parts, false), &new, &mut Linear::add)
    }

    /// Passes the columns of a Jacobian once more: from memory, where they are there, else from new runs.
    fn once_more<A>(
        &mut self,
        x: &[f64],
        linear: &Linear,
        new: &dyn Fn() -> A,
        add: &mut dyn FnMut(&mut A, &Piece),
    ) -> Option<A> {
        let Some(kept) = &linear.kept else {
            let sizes = std::mem::replace(&mut self.sizes, linear.sizes.clone());
            let sum = self.jacobian(x, (&[1.0], true), new, add);
            self.sizes = sizes;
            return sum;
        };
        let mut sum = new();
        kept.iter().for_each(|piece| add(&mut sum, piece));
        Some(sum)
    }

    /// Chooses the sizes of the next differences from the sums of squares of the columns.
    fn size(&mut self, squares: &[f64]) {
        for (size, square) in self.sizes.iter_mut().zip(squares) {
            *size = (PART_OF_NOISE / square.sqrt()).clamp(DIFFERENCES.0, DIFFERENCES.1);
        }
    }

    /// Whether the residuals of least squares, at `plain` with these weights, are no noise: whitening has moved the values
    /// to `x`, where the sum of squares is larger by more than noise explains. If the model is right, both estimate the
    /// same values, and the rise is at most a sum of squares of normal variables whose variances are those of least
    /// squares (Hausman, Econometrica 46 (1978)); its distribution is taken as that of a multiple of χ² with the same
    /// mean and variance (Satterthwaite 1946).
    fn misfits(&mut self, items: &[Item], (plain, weights): (&[f64], &[Noise]), x: &[f64]) -> bool {
        let n = plain.len();
        let whitened = std::mem::replace(&mut self.noise, weights.to_vec());
        let mut at = |x: &[f64]| {
            let residuals = self.residuals(x).ok()?;
            self.weigh(items, &residuals, false);
            Some(residuals)
        };
        let found = at(x).and_then(|moved| Some((moved, at(plain)?)));
        let is_larger = found.is_some_and(|(found, residuals)| {
            let ((here, square, count), (there, ..)) = (self.sums(plain, &residuals), self.sums(x, &found));
            let stretches = self.stretches(items, &residuals);
            drop((found, residuals));
            let degrees = (count as f64 - n as f64).max(1.0);
            let rise = there - here;
            // What is at a bound does not scatter.
            let free: Vec<usize> = (0..n).filter(|k| self.at_bound(plain, *k).is_none()).collect();
            let Some(linear) = self.linear(items, plain, &[1.0]).filter(|_| rise > 0.0) else { return false };
            if free.is_empty() {
                return false;
            }
            // In units of the variance of the rows.
            let rise = rise / (square / degrees);
            let bounds = self.bounds();
            let of_free = |piece: &Piece| {
                let (columns, white) =
                    piece.weighted(&bounds).unwrap_or_else(|| (piece.columns.clone(), piece.white.clone()));
                (free.iter().map(|k| columns[*k].clone()).collect::<Vec<_>>(), white)
            };
            let new = || (Triangle::new(free.len()), stretches.iter().map(Correlation::new).collect::<Vec<_>>());
            let sums = self.once_more(plain, &linear, &new, &mut |(triangle, correlations), piece| {
                let (columns, white) = of_free(piece);
                reduce(triangle, &columns, &white);
                if let Some(k) = piece.item {
                    correlations[k].add(&slices(&columns), &white);
                }
            });
            let Some((triangle, correlations)) = sums else { return false };
            let of_r = |k: usize| (0..free.len()).map(|row| triangle.r[row * free.len() + k]).collect();
            let parts = singular((0..free.len()).map(of_r).collect(), &triangle.qf);
            let new = || Windows::new(free.len(), &correlations);
            let windows = self.once_more(plain, &linear, &new, &mut |windows, piece| {
                let (columns, white) = of_free(piece);
                windows.add(piece.item, &slices(&columns), &white);
            });
            let Some(scattered) = windows.map(Windows::finish) else { return false };
            let (ratios, stretch) = (scattered.ratios(&parts), scattered.stretch());
            let known = (1..).find(|known| known * known >= ratios.len()).unwrap_or(1);
            let trace: f64 = (0..known).map(|k| ratios[k * known + k]).sum::<f64>() * degrees / square;
            let squared = ratios.iter().map(|r| r * r).sum::<f64>() * (degrees / square) * (degrees / square);
            let (scale, degrees) = (squared / trace, trace * trace / squared);
            quantiles::chi_square_tail(rise / (scale * stretch * stretch), degrees, &self.scale.with) < NO_NOISE
        });
        self.noise = whitened;
        is_larger
    }

    /// The rows of each item among the whitened residuals of all.
    fn stretches(&self, items: &[Item], residuals: &Residuals) -> Vec<Stretch> {
        let mut begin = 0;
        let one = |((item, noise), rows): ((&Item, &Noise), &Vec<f64>)| {
            let end = begin + noise.kept(rows.len()).count();
            Stretch { rows: std::mem::replace(&mut begin, end)..end, independent: item.rows == Rows::Independent }
        };
        items.iter().zip(&self.noise).zip(residuals).map(one).collect()
    }

    fn conclude(mut self, items: &[Item], x: &[f64], level: f64, outcome: Outcome) -> Result<Answer, Trouble> {
        let Outcome { why, starts, followed: (ends, agreed), misfits, finer: shorter } = outcome;
        let n = x.len();
        let residuals = self.residuals(x).map_err(Trouble::NoStart)?;
        let failed = |this: &Self| Trouble::NoStart(this.commonest());
        let Some(first) = self.linear(items, x, &[1.0]) else { return Err(failed(&self)) };
        self.size(&first.squares);
        drop(first);
        let Some(mut linear) = self.linear(items, x, &[1.0, 1.0 / 3.0]) else { return Err(failed(&self)) };
        let differ = |k: &usize| linear.gaps[*k].sqrt() > ROUGH * linear.squares[*k].sqrt();
        let rough: Vec<usize> = (0..n).filter(differ).collect();
        // Where small differences see steps of the model rather than its course, larger ones do not.
        if !rough.is_empty() {
            rough.iter().for_each(|k| self.sizes[*k] = self.sizes[*k].max(FIRST_DIFFERENCE));
            linear = self.linear(items, x, &[1.0]).unwrap_or(linear);
        }
        let uneven = items.iter().any(|item| item.rows == Rows::Uneven);
        let scatters = misfits || uneven;
        let moments: Vec<loss::Moments> = match self.robust {
            true => {
                let of = |(noise, rows): (&Noise, &Vec<f64>)| {
                    let white = noise.whitened(rows);
                    loss::moments(&white, 0..white.len(), noise.bound, n)
                };
                self.noise.iter().zip(&*residuals).map(of).collect()
            }
            false => Vec::new(),
        };
        // Rows within their bound alone curve the loss: on average this part of each. Huber's loss has a sandwich in any
        // case (Robust Statistics, sec. 7.6): the rows of the gradient are those of half the loss's slope, of which
        // independent ones count by their mean square.
        let bounds: Vec<f64> = self.noise.iter().map(|noise| noise.bound).collect();
        let sloped = |piece: &Piece| -> (Vec<Vec<f64>>, Vec<f64>) {
            let (mut columns, mut white) = (piece.columns[..n].to_vec(), piece.white.clone());
            if let Some((k, one)) = piece.item.and_then(|k| Some((k, moments.get(k)?))) {
                let root = one.within.sqrt();
                let mean = one.square.sqrt() / root;
                let slope = |r: f64| if scatters { r.clamp(-bounds[k], bounds[k]) / root } else { mean };
                columns.iter_mut().flatten().for_each(|cell| *cell *= root);
                white.iter_mut().for_each(|r| *r = slope(*r));
            }
            (columns, white)
        };
        let (triangle, correlations) = match self.robust {
            true => {
                let mut stretches = self.stretches(items, &residuals);
                stretches.iter_mut().for_each(|stretch| stretch.independent |= !scatters);
                let new = || (Triangle::new(n), stretches.iter().map(Correlation::new).collect::<Vec<_>>());
                let sums = self.once_more(x, &linear, &new, &mut |(triangle, correlations), piece| {
                    let (columns, white) = sloped(piece);
                    reduce(triangle, &columns, &piece.white);
                    if let Some(k) = piece.item {
                        correlations[k].add(&slices(&columns), &white);
                    }
                });
                let Some(sums) = sums else { return Err(failed(&self)) };
                sums
            }
            false => (linear.triangle.clone(), std::mem::take(&mut linear.correlations)),
        };
        let rows = triangle.rows as f64;
        let degrees = (rows - n as f64).max(1.0);
        let chi_square = triangle.square() / degrees;
        // Where a standard deviation is given, it is not estimated again.
        let given = self.robust || items.iter().any(|item| item.sd.is_some());
        let variance = if given { 1.0 } else { chi_square };
        let of_r = |k: usize| (0..n).map(|row| triangle.r[row * n + k]).collect::<Vec<f64>>();
        let parts = singular((0..n).map(of_r).collect(), &triangle.qf);
        let model = |i: usize, j: usize| -> f64 {
            let each = parts.values.iter().zip(&parts.vectors);
            each.map(|(s, v)| variance * (v[i] / s) * (v[j] / s)).sum()
        };
        // Where no model makes the noise white, the scatter of the gradient takes its place.
        let windows = || Windows::new(n, &correlations);
        let scattered = match scatters || self.robust {
            true => self.once_more(x, &linear, &windows, &mut |windows, piece| {
                let (columns, white) = sloped(piece);
                windows.add(piece.item, &slices(&columns), &white);
            }),
            false => None,
        };
        let scattered = scattered.map(Windows::finish);
        let small_sample = rows / degrees;
        // Of the combinations of singular vectors i and j.
        let ratios: Option<Vec<f64>> = scattered.as_ref().map(|scattered| {
            let of = |at: usize| scattered.form(&parts.vectors[at / n], &parts.vectors[at % n]) * small_sample;
            (0..n * n).map(of).collect()
        });
        let covariance = |i: usize, j: usize| -> f64 {
            let Some(ratios) = &ratios else { return model(i, j) };
            let part = |a: usize, k: usize| parts.vectors[a][k] / (parts.values[a] * parts.values[a]);
            (0..n * n).map(|at| part(at / n, i) * ratios[at] * part(at % n, j)).sum()
        };
        let along = |a: usize| match &ratios {
            Some(ratios) => ratios[a * n + a].sqrt() / (parts.values[a] * parts.values[a]),
            None => variance.sqrt() / parts.values[a],
        };
        let least = if self.robust { 0.0 } else { 1.0 };
        let inflation = |k: usize| if ratios.is_some() { (covariance(k, k) / model(k, k)).max(least) } else { 1.0 };
        let inflation = (0..n).map(inflation).collect();
        let values = self.values(x);
        let unknowns = self.scale.unknowns;
        // From coordinates to values, of which each depends on few coordinates.
        let slopes: Vec<Vec<(usize, f64)>> = (0..n).map(|k| self.scale.slopes(&values, k)).collect();
        let covariance = |i: usize, j: usize| -> f64 {
            let of = |(a, slope): &(usize, f64)| {
                slopes[j].iter().map(|(b, other)| slope * covariance(*a, *b) * other).sum::<f64>()
            };
            slopes[i].iter().map(of).sum()
        };
        let sd: Vec<f64> = (0..n).map(|k| covariance(k, k).sqrt()).collect();
        // Other residuals move the minimum by −(JᵀJ)⁻¹Jᵀ of their change (Gauss and Newton).
        let moved = |qf: &[f64]| -> Vec<f64> {
            let parts = singular((0..n).map(of_r).collect(), qf);
            let weights: Vec<f64> =
                parts.values.iter().zip(&parts.uf).map(|(s, uf)| if *s > 0.0 { uf / s } else { 0.0 }).collect();
            let along = |k: usize| -> f64 { parts.vectors.iter().zip(&weights).map(|(v, w)| -v[k] * w).sum() };
            (0..n).map(|k| slopes[k].iter().map(|(a, slope)| slope * along(*a)).sum::<f64>() / sd[k]).collect()
        };
        let mut shifts: Vec<Result<Vec<f64>, String>> = Vec::new();
        for (items, found) in shorter.map_or(Vec::new(), |shorter| shorter(&values)) {
            let noise = self.noise.clone();
            let shift = found.and_then(|found| {
                let new = || (Triangle::new(n), noise.iter().map(Whitening::new).collect::<Vec<_>>());
                let changed = self.once_more(x, &linear, &new, &mut |(triangle, filters), piece| {
                    let change: Vec<f64> = match piece.item.filter(|k| items.contains(k)) {
                        Some(k) => {
                            let other = filters[k].of(&found[k - items.start][piece.range.clone()]);
                            let counts = |white: f64| match moments.get(k) {
                                Some(one) if white.abs() <= bounds[k] => 1.0 / one.within.sqrt(),
                                Some(_) => 0.0,
                                None => 1.0,
                            };
                            other.iter().zip(&piece.white).map(|(a, b)| (a - b) * counts(*b)).collect()
                        }
                        None => vec![0.0; piece.white.len()],
                    };
                    reduce(triangle, &sloped(piece).0, &change);
                });
                changed.map(|(triangle, _)| moved(&triangle.qf)).ok_or_else(|| self.commonest())
            });
            shifts.push(shift);
        }
        let stretch = scattered.as_ref().map_or(1.0, |scattered| scattered.stretch());
        let t = quantiles::student(level, degrees, &self.scale.with) * stretch;
        // In the scale of each unknown on its own.
        let interval = |k: usize| {
            let unknown = &unknowns[k];
            let (middle, reach) =
                (unknown.coordinate(values[k], &self.scale.with), t * sd[k] / unknown.slope(values[k]).abs());
            let ends = [middle - reach, middle + reach].map(|x| unscaled(unknown, x, &self.scale.with));
            (ends[0].min(ends[1]), ends[0].max(ends[1]))
        };
        let correlation = |i: usize, j: usize| if i == j { 1.0 } else { covariance(i, j) / (sd[i] * sd[j]) };
        // A scale by logarithms of negative values reverses their order.
        let is_rising = |k: usize| unknowns[k].above.is_some() || unknowns[k].slope(values[k]) > 0.0;
        let at_bound = |k: usize| self.at_bound(x, k).map(|edge| (edge == Edge::High) == is_rising(k));
        let undetermined = parts.vectors.iter().enumerate().filter_map(|(a, v)| {
            let sensitivity = 1.0 / along(a);
            // In the scale of each unknown on its own, too.
            let moved = |k: usize| slopes[k].iter().map(|(a, slope)| slope * v[*a]).sum::<f64>();
            let own: Vec<f64> = (0..n).map(|k| moved(k) / unknowns[k].slope(values[k])).collect();
            let length = own.iter().map(|c| c * c).sum::<f64>().sqrt();
            let direction = own.iter().map(|c| c / length).collect();
            (sensitivity < LEAST_SENSITIVITY).then_some(Combination { sensitivity, direction })
        });
        // What is left is described by a model of its correlation, also where the values do not come from it.
        let noise = if misfits { self.noise_of(items, &residuals, true) } else { self.noise.clone() };
        let at_bound = (0..n).map(at_bound).collect();
        self.last = None;
        let residuals = Rc::unwrap_or_clone(residuals);
        Ok(Answer {
            misfits,
            inflation,
            intervals: (0..n).map(interval).collect(),
            correlation: (0..n * n).map(|at| correlation(at / n, at % n)).collect(),
            at_bound,
            undetermined: undetermined.collect(),
            rough,
            sd,
            rms: residuals.iter().map(|rows| mean_square(rows).sqrt()).collect(),
            chi_square,
            degrees,
            values,
            residuals,
            why,
            starts,
            followed: ends.len(),
            agreed,
            ends,
            noise,
            weights: self.noise,
            runs: self.runs + shifts.len() as u64,
            shifts,
            failures: self.failures,
        })
    }
}

fn mean_square(rows: &[f64]) -> f64 {
    rows.iter().map(|r| r * r).sum::<f64>() / rows.len().max(1) as f64
}

/// The value of a coordinate that may lie outside of the range.
fn unscaled(unknown: &Unknown, x: f64, with: &Elementary) -> f64 {
    let free = match unknown.is_logarithmic() {
        true if unknown.low < 0.0 => Unknown { low: -f64::MAX, high: -f64::MIN_POSITIVE, ..*unknown },
        true => Unknown { low: f64::MIN_POSITIVE, high: f64::MAX, ..*unknown },
        false => return unknown.low + x * (unknown.high - unknown.low),
    };
    free.value(x, with)
}

/// Adds rows to a triangle.
fn reduce(triangle: &mut Triangle, columns: &[Vec<f64>], f: &[f64]) {
    let mut row = vec![0.0; columns.len()];
    for (at, f) in f.iter().enumerate() {
        row.iter_mut().zip(columns).for_each(|(cell, column)| *cell = column[at]);
        triangle.add(&mut row, *f);
    }
}

fn slices(columns: &[Vec<f64>]) -> Vec<&[f64]> {
    columns.iter().map(Vec::as_slice).collect()
}

/// How badly some rows fit, if the mean square of all rows of their item is this. Large residuals count little, so that a
/// run that goes astray is bad and not infinitely bad.
fn misfit(item: &Item, mean: f64, rows: &[f64], with: &Elementary) -> f64 {
    let (floor, scale) = match item.sd {
        Some(sd) => (1.0, 1.0 / (sd * sd)),
        None => ((1e-6 * mean).max(f64::MIN_POSITIVE), 1.0),
    };
    rows.iter().map(|r| (with.log)(floor + scale * r * r)).sum()
}

/// Some rows of the Jacobian.
struct Piece {
    /// The item to which they belong; none of what is known beforehand.
    item: Option<usize>,
    /// Which rows of its residuals they come from.
    range: Range<usize>,
    /// Whitened residuals.
    white: Vec<f64>,
    /// Columns, for each size of the differences.
    columns: Vec<Vec<f64>>,
}

impl Piece {
    /// Its rows weighted, so that they have the gradient of the loss; none if all weights are 1.
    fn weighted(&self, bounds: &[f64]) -> Option<(Vec<Vec<f64>>, Vec<f64>)> {
        let bound = self.item.map(|k| bounds[k]).filter(|bound| bound.is_finite())?;
        let weights: Vec<f64> = self.white.iter().map(|r| loss::root_weight(*r, bound)).collect();
        let times = |rows: &Vec<f64>| rows.iter().zip(&weights).map(|(r, weight)| r * weight).collect::<Vec<f64>>();
        Some((self.columns.iter().map(times).collect(), times(&self.white)))
    }
}

/// Most numbers of a Jacobian that is kept in memory: 64 MB. A longer one is computed again where it is needed twice.
const KEPT: usize = 8_000_000;

/// What follows from a Jacobian.
struct Linear {
    triangle: Triangle,
    /// Of each column the sum of squares, and that of the differences to those of the second size.
    squares: Vec<f64>,
    gaps: Vec<f64>,
    /// Of each item.
    correlations: Vec<Correlation>,
    /// Sizes of the differences.
    sizes: Vec<f64>,
    /// The rows with the columns of the first size, unless they are too many; and how many numbers they are.
    kept: Option<Vec<Piece>>,
    numbers: usize,
}

impl Linear {
    fn new(n: usize, stretches: &[Stretch], sizes: &[f64]) -> Linear {
        Linear {
            triangle: Triangle::new(n),
            squares: vec![0.0; n],
            gaps: vec![0.0; n],
            correlations: stretches.iter().map(Correlation::new).collect(),
            sizes: sizes.to_vec(),
            kept: Some(Vec::new()),
            numbers: 0,
        }
    }

    fn add(&mut self, piece: &Piece) {
        let n = self.squares.len();
        let (columns, others) = piece.columns.split_at(n);
        for (square, column) in self.squares.iter_mut().zip(columns) {
            *square = column.iter().fold(*square, |sum, c| sum + c * c);
        }
        for (gap, (column, other)) in self.gaps.iter_mut().zip(columns.iter().zip(others)) {
            *gap = column.iter().zip(other).fold(*gap, |sum, (a, b)| sum + (a - b) * (a - b));
        }
        reduce(&mut self.triangle, columns, &piece.white);
        if let Some(k) = piece.item {
            self.correlations[k].add(&slices(columns), &piece.white);
        }
        self.numbers += (n + 1) * piece.white.len();
        if self.numbers > KEPT {
            self.kept = None;
        }
        if let Some(kept) = &mut self.kept {
            let Piece { item, range, white, .. } = piece;
            kept.push(Piece { item: *item, range: range.clone(), white: white.clone(), columns: columns.to_vec() });
        }
    }
}

impl Objective for Search<'_> {
    fn cost(&mut self, x: &[f64]) -> Option<f64> {
        let residuals = self.residuals(x).ok()?;
        let cost = 0.5 * self.sums(x, &residuals).0;
        cost.is_finite().then_some(cost)
    }

    fn linearise(&mut self, x: &[f64]) -> Option<Triangle> {
        let n = x.len();
        let new = || (Triangle::new(n), vec![0.0; n]);
        let bounds = self.bounds();
        let (triangle, squares) = self.jacobian(x, (&[1.0], false), &new, &mut |(triangle, squares), piece| {
            for (square, column) in squares.iter_mut().zip(&piece.columns) {
                *square = column.iter().fold(*square, |sum, c| sum + c * c);
            }
            match piece.weighted(&bounds) {
                Some((columns, white)) => reduce(triangle, &columns, &white),
                None => reduce(triangle, &piece.columns, &piece.white),
            }
        })?;
        self.size(&squares);
        Some(triangle)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;

    fn normal(chance: &mut Chance) -> f64 {
        (0..12).map(|_| chance.fraction()).sum::<f64>() - 6.0
    }

    const TRUE: [f64; 3] = [2.0, 0.05, -0.3];
    const LIMITS: Limits = Limits { trials: 100, tolerance: 1e-8 };
    const DRIVEN: Minima = Minima { held: false, driven: true, regimes: false };

    fn decay(p: &[f64], t: f64) -> f64 {
        p[0] * (-t * p[1]).exp() + p[2]
    }

    fn unknowns() -> [Unknown; 3] {
        [
            Unknown { low: 0.2, high: 20.0, start: 1.0, known: None, above: None },
            Unknown { low: 0.005, high: 0.5, start: 0.1, known: None, above: None },
            Unknown { low: -1.0, high: 1.0, start: 0.2, known: None, above: None },
        ]
    }

    fn fitted(data: &[f64], unknowns: &[Unknown], items: &[Item]) -> Result<Answer, Trouble> {
        answered(unknowns, items, &|p| (0..data.len()).map(|t| decay(p, t as f64) - data[t]).collect())
    }

    /// The answer for one compared quantity with these residuals.
    fn answered(
        unknowns: &[Unknown],
        items: &[Item],
        residuals: &dyn Fn(&[f64]) -> Vec<f64>,
    ) -> Result<Answer, Trouble> {
        let mut run = |_: Way, points: &[Vec<f64>]| {
            points.iter().map(|p| Ok(vec![residuals(p)])).collect::<Vec<Result<Residuals, String>>>()
        };
        fit(Question {
            unknowns,
            items,
            minima: DRIVEN,
            run: &mut run,
            finer: None,
            with: PLATFORM,
            level: 0.95,
            limits: LIMITS,
            starts: 1,
            seed: 0,
            estimator: Estimator::Chosen,
            robust: false,
            journal: None,
        })
    }

    /// With the whitening left out, the intervals of correlated noise hold in 33 to 55 of 100.
    #[test]
    fn intervals_hold_the_truth_as_often_as_they_say() {
        for (colour, rho) in [("white", 0.0), ("correlated", 0.9)] {
            let mut held = [0; 3];
            for seed in 0..100 {
                let (mut chance, mut past) = (Chance(seed), 0.0);
                let data: Vec<f64> = (0..200)
                    .map(|t| {
                        past = rho * past + normal(&mut chance) * f64::sqrt(1.0 - rho * rho);
                        decay(&TRUE, f64::from(t)) + 0.01 * past
                    })
                    .collect();
                let answer = fitted(&data, &unknowns(), &[Item { sd: None, rows: Rows::Even(Vec::new()) }])
                    .expect("it has an answer");
                for k in 0..3 {
                    let (low, high) = answer.intervals[k];
                    held[k] += i32::from((low..=high).contains(&TRUE[k]));
                }
            }
            // Binomial: 95 ± 2.2 in a hundred. A short recording of correlated noise has few independent rows.
            let least = if rho == 0.0 { 88 } else { 82 };
            assert!(held.iter().all(|held| (least..=100).contains(held)), "{colour}: {held:?}");
        }
    }

    #[test]
    fn a_known_standard_deviation_counts_and_knowledge_beforehand_narrows() {
        let mut chance = Chance(7);
        let data: Vec<f64> = (0..200).map(|t| decay(&TRUE, f64::from(t)) + 0.01 * normal(&mut chance)).collect();
        let free = fitted(&data, &unknowns(), &[Item { sd: None, rows: Rows::Even(Vec::new()) }]).unwrap();
        let doubled = fitted(&data, &unknowns(), &[Item { sd: Some(0.02), rows: Rows::Even(Vec::new()) }]).unwrap();
        let estimated = free.chi_square.sqrt() * free.rms[0];
        assert!((doubled.sd[1] / free.sd[1] - 0.02 / estimated).abs() < 0.1, "{doubled:?} {free:?}");
        assert!((doubled.chi_square - 0.25).abs() < 0.08, "{doubled:?}");
        let mut known = unknowns();
        known[1].known = Some((TRUE[1], 1e-6));
        let narrowed = fitted(&data, &known, &[Item { sd: Some(0.01), rows: Rows::Even(Vec::new()) }]).unwrap();
        assert!((narrowed.sd[1] - 1e-6).abs() < 1e-8 && narrowed.sd[0] < free.sd[0], "{narrowed:?} {free:?}");
    }

    /// A phase has many minima: from one start the search ends in the next one, from many in the true one. With starts
    /// that are judged but not followed, some seeds end elsewhere.
    #[test]
    fn of_many_starts_the_best_minimum_is_found() {
        let mut alone = 0;
        for seed in 0..20 {
            let mut chance = Chance(seed);
            let (omega, phase) = (chance.between(2.0, 9.0), chance.between(0.5, 2.5));
            let wave = |omega: f64, phase: f64, t: u32| (omega * 0.05 * f64::from(t) + phase).sin();
            let data: Vec<f64> = (0..200).map(|t| wave(omega, phase, t) + 0.05 * normal(&mut chance)).collect();
            let unknowns = [
                Unknown { low: 1.0, high: 10.0, start: chance.between(1.0, 10.0), known: None, above: None },
                Unknown { low: 0.0, high: 3.0, start: chance.between(0.0, 3.0), known: None, above: None },
            ];
            for starts in [1, 64] {
                let mut run = |_: Way, points: &[Vec<f64>]| {
                    let one =
                        |p: &Vec<f64>| Ok(vec![(0..200).map(|t| wave(p[0], p[1], t) - data[t as usize]).collect()]);
                    points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
                };
                let items = &[Item { sd: None, rows: Rows::Even(Vec::new()) }];
                let (unknowns, run) = (&unknowns, &mut run);
                let question = Question {
                    unknowns,
                    items,
                    minima: DRIVEN,
                    run,
                    finer: None,
                    with: PLATFORM,
                    level: 0.95,
                    limits: LIMITS,
                    starts,
                    seed,
                    estimator: Estimator::Chosen,
                    robust: false,
                    journal: None,
                };
                let answer = fit(question).unwrap();
                let found = (answer.values[0] - omega).abs() < 0.02;
                alone += usize::from(starts == 1 && found);
                assert!(starts == 1 || found, "seed {seed}: {omega}, {answer:?}");
                assert_eq!(answer.starts, starts);
                assert!(answer.agreed <= answer.followed && answer.followed <= MOST_FOLLOWED);
            }
        }
        assert!(alone <= 10, "{alone} of 20 need one start only");
    }

    /// From one start, and along one path, the frequency of a long wave is found where a plain search ends in the next
    /// minimum: the beginning of the rows has few minima, and so has a run that an observer holds to the data. With the
    /// stages left out fewer than half are found.
    #[test]
    fn paths_lead_past_other_minima() {
        let mut found = [0; 3];
        for seed in 0..40 {
            let mut chance = Chance(seed);
            let omega = chance.between(2.0, 9.0);
            let rows = 300;
            let data: Vec<f64> =
                (0..rows).map(|t| (omega * 0.05 * f64::from(t)).sin() + 0.05 * normal(&mut chance)).collect();
            let start = omega * chance.between(0.8, 1.25);
            let unknowns = [Unknown { low: 1.0, high: 12.0, start, known: None, above: None }];
            // An oscillator that starts from rest, with 50 exact turns from row to row.
            let mut run = |way: Way, points: &[Vec<f64>]| {
                let one = |p: &Vec<f64>| {
                    let (mut x, mut v) = (0.0, omega);
                    let (pole, count) = match way {
                        Way::Whole => (0.0, rows),
                        Way::First(part) => (0.0, (part * f64::from(rows)) as u32),
                        Way::Held(pole) => (pole, rows),
                    };
                    let theta = f64::exp(-pole);
                    let step = |t: u32| {
                        let e = data[t as usize] - x;
                        let left = -e;
                        x += (1.0 - theta * theta) * e;
                        v += (1.0 - theta) * (1.0 - theta) * e / 0.05;
                        let (sin, cos) = (p[0] * 0.05).sin_cos();
                        (x, v) = (x * cos + v / p[0] * sin, v * cos - p[0] * x * sin);
                        left
                    };
                    Ok(vec![(0..count).map(step).collect()])
                };
                points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
            };
            let items = &[Item { sd: None, rows: Rows::Even(Vec::new()) }];
            for (k, path) in
                [vec![], PARTS.map(Way::First).to_vec(), POLES.map(Way::Held).to_vec()].into_iter().enumerate()
            {
                let scale = Scale { unknowns: &unknowns, with: PLATFORM };
                let mut search = Search::new(scale, items, &mut run);
                let begin = search.along(items, &scale.coordinates(&[start]), path).expect("it runs");
                let end = search.follow(items, begin, LIMITS).unwrap().expect("it runs");
                found[k] += u32::from((scale.values(&end.x)[0] / omega - 1.0).abs() < 0.01);
            }
        }
        assert!(found[0] < 20 && found[1] >= 32 && found[2] >= 36, "of 40: {found:?}");
    }

    /// Each cell of each coordinate holds one start, so that few starts reach every part of a range.
    #[test]
    fn starts_are_spread_over_each_range() {
        for seed in 0..50 {
            let (low, high) = ([0.0, -3.0], [1.0, 5.0]);
            let all = spread(&[0.5, 0.5], &low, &high, 17, seed);
            assert_eq!((all.len(), &all[0][..]), (17, &[0.5, 0.5][..]));
            for k in 0..2 {
                let cell = |start: &Vec<f64>| (16.0 * (start[k] - low[k]) / (high[k] - low[k])) as usize;
                let mut cells: Vec<usize> = all[1..].iter().map(cell).collect();
                cells.sort_unstable();
                assert_eq!(cells, (0..16).collect::<Vec<_>>(), "seed {seed}");
            }
        }
    }

    /// A true value beyond the bound leaves a model error that looks like noise; the parameter stays at its bound.
    #[test]
    fn a_parameter_at_its_bound_stays_there() {
        for seed in 0..20 {
            let mut chance = Chance(seed);
            let data: Vec<f64> = (0..100).map(|t| decay(&TRUE, f64::from(t)) + 0.01 * normal(&mut chance)).collect();
            let mut bounded = unknowns();
            bounded[2] = Unknown { low: -1.0, high: TRUE[2] - 0.1, start: -0.8, known: None, above: None };
            let answer = fitted(&data, &bounded, &[Item { sd: None, rows: Rows::Even(Vec::new()) }]).unwrap();
            assert_eq!(answer.at_bound[2], Some(true), "seed {seed}: {answer:?}");
        }
    }

    #[test]
    fn trouble_is_named() {
        let data = vec![1.0; 3];
        assert_eq!(
            fitted(&data, &unknowns(), &[Item { sd: None, rows: Rows::Even(Vec::new()) }]),
            Err(Trouble::TooFewRows(3, 3))
        );
        let mut run = |_: Way, points: &[Vec<f64>]| {
            let one = |p: &Vec<f64>| Ok(vec![(0..20).map(|t| p[0] - f64::from(t)).collect()]);
            points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
        };
        let with = PLATFORM;
        let item = [Item { sd: None, rows: Rows::Even(Vec::new()) }];
        let unknowns = unknowns();
        let question = Question {
            unknowns: &unknowns[..2],
            items: &item,
            minima: DRIVEN,
            run: &mut run,
            finer: None,
            with,
            level: 0.95,
            limits: LIMITS,
            starts: 1,
            seed: 0,
            estimator: Estimator::Chosen,
            robust: false,
            journal: None,
        };
        assert_eq!(fit(question), Err(Trouble::NoInfluence(vec![1])));
        let mut never =
            |_: Way, points: &[Vec<f64>]| points.iter().map(|_| Err("too many steps".to_string())).collect();
        let question = Question {
            unknowns: &unknowns[..2],
            items: &item,
            minima: DRIVEN,
            run: &mut never,
            finer: None,
            with,
            level: 0.95,
            limits: LIMITS,
            starts: 1,
            seed: 0,
            estimator: Estimator::Chosen,
            robust: false,
            journal: None,
        };
        assert_eq!(fit(question), Err(Trouble::NoStart("too many steps".into())));
    }

    /// A contact that sticks at the written start moves at others: what depends on nothing at first is found. With the
    /// check after the first search it is refused.
    #[test]
    fn a_start_at_rest_hides_no_unknown() {
        for seed in 0..20 {
            let mut chance = Chance(seed);
            let truth = chance.between(0.5, 2.0);
            let unknown = Unknown { low: 0.1, high: 10.0, start: 9.0, known: None, above: None };
            let moves = |p: f64, t: usize| (0.05 * t as f64 - p).max(0.0);
            let data: Vec<f64> = (0..100).map(|t| moves(truth, t) + 0.01 * normal(&mut chance)).collect();
            let mut run = |_: Way, points: &[Vec<f64>]| {
                let one = |p: &Vec<f64>| Ok(vec![(0..100).map(|t| moves(p[0], t) - data[t]).collect()]);
                points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
            };
            let answer = fit(Question {
                unknowns: &[unknown],
                items: &[Item { sd: None, rows: Rows::Even(Vec::new()) }],
                minima: Minima { regimes: true, ..Minima::default() },
                run: &mut run,
                finer: None,
                with: PLATFORM,
                level: 0.95,
                limits: LIMITS,
                starts: 16,
                seed,
                estimator: Estimator::Chosen,
                robust: false,
                journal: None,
            });
            let answer = answer.unwrap_or_else(|trouble| panic!("seed {seed}: {trouble:?}"));
            assert!(
                (answer.values[0] - truth).abs() < 5.0 * answer.sd[0].max(1e-3),
                "seed {seed}: {truth}, {answer:?}"
            );
        }
    }

    /// Two unknowns of which only the product matters: one combination stays open, and it is their ratio.
    #[test]
    fn a_combination_without_data_is_found() {
        let mut chance = Chance(3);
        let noise: Vec<f64> = (0..100).map(|_| 0.01 * normal(&mut chance)).collect();
        let unknown = Unknown { low: 0.1, high: 10.0, start: 0.7, known: None, above: None };
        let residuals = |p: &[f64]| noise.iter().map(|e| p[0] * p[1] - 1.0 - e).collect();
        let answer = answered(&[unknown; 2], &[Item { sd: None, rows: Rows::Even(Vec::new()) }], &residuals).unwrap();
        assert!((answer.values[0] * answer.values[1] - 1.0).abs() < 0.01, "{answer:?}");
        let [open] = &answer.undetermined[..] else { panic!("{answer:?}") };
        assert!((open.direction[0] + open.direction[1]).abs() < 1e-3, "{open:?}");
    }

    /// A parameter of each of some functions of the row; residuals are what is left of the data.
    fn linear(functions: &[Vec<f64>], data: &[f64], p: &[f64]) -> Vec<f64> {
        (0..data.len()).map(|row| functions.iter().zip(p).map(|(f, p)| f[row] * p).sum::<f64>() - data[row]).collect()
    }

    /// A question about one compared quantity.
    fn asked(unknowns: &[Unknown], rows: Rows, starts: usize, residuals: &dyn Fn(&[f64]) -> Vec<f64>) -> Answer {
        asked_so(unknowns, rows, starts, false, residuals)
    }

    fn asked_so(
        unknowns: &[Unknown],
        rows: Rows,
        starts: usize,
        robust: bool,
        residuals: &dyn Fn(&[f64]) -> Vec<f64>,
    ) -> Answer {
        let mut run = |_: Way, points: &[Vec<f64>]| {
            points.iter().map(|p| Ok(vec![residuals(p)])).collect::<Vec<Result<Residuals, String>>>()
        };
        fit(Question {
            unknowns,
            items: &[Item { sd: None, rows }],
            minima: DRIVEN,
            run: &mut run,
            finer: None,
            with: PLATFORM,
            level: 0.95,
            limits: LIMITS,
            starts,
            seed: 0,
            estimator: Estimator::Chosen,
            robust,
            journal: None,
        })
        .expect("it has an answer")
    }

    const PLAIN: Unknown = Unknown { low: -10.0, high: 10.0, start: 1.0, known: None, above: None };

    /// The model lacks a slow course, and has a fast one that the data lack. Whitening removes what is slow, so that the
    /// fast one would decide, and the sum of squares would be far from its least. Least squares keeps the gain of the slow
    /// one. Where only correlated noise is lacking, whitening is kept. With the test of the rise left out, no seed of the
    /// first kind has the gain of least squares.
    #[test]
    fn residuals_that_are_no_noise_are_not_whitened() {
        let mut kept = 0;
        for seed in 0..100 {
            let (mut chance, mut past) = (Chance(seed), 0.0);
            let phase = chance.between(0.0, 6.0);
            let slow: Vec<f64> = (0..1000).map(|t| (0.05 * f64::from(t)).sin()).collect();
            let other: Vec<f64> = (0..1000).map(|t| (0.083 * f64::from(t) + phase).sin()).collect();
            let both: Vec<f64> = slow.iter().map(|slow| slow + 0.1 * normal(&mut chance)).collect();
            let noise: Vec<f64> = (0..1000)
                .map(|_| {
                    past = 0.9 * past + 0.01 * normal(&mut chance);
                    past
                })
                .collect();
            let wrong: Vec<f64> = (0..1000).map(|t| slow[t] + other[t] + noise[t]).collect();
            let right: Vec<f64> = both.iter().zip(&noise).map(|(both, noise)| both + noise).collect();
            let functions = [both.clone()];
            let answer = asked(&[PLAIN], Rows::Even(vec![]), 1, &|p| linear(&functions, &wrong, p));
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let expected = dot(&both, &wrong) / dot(&both, &both);
            let found = answer.values[0];
            assert!(answer.misfits && (found - expected).abs() < 1e-5, "seed {seed}: {found}, not {expected}");
            let answer = asked(&[PLAIN], Rows::Even(vec![]), 1, &|p| linear(&functions, &right, p));
            kept += u32::from(!answer.misfits && answer.weights[0].order() > 0);
        }
        assert!(kept >= 97, "{kept} of 100");
    }

    /// Rows in uneven intervals have no filter, and their intervals hold the truth by the scatter of the gradient. With the
    /// covariance of white noise they hold it in half of the cases.
    #[test]
    fn intervals_of_uneven_rows_hold_the_truth() {
        let mut held = [0; 2];
        for seed in 0..200 {
            let (mut chance, mut past) = (Chance(seed), 0.0);
            let slow: Vec<f64> = (0..800).map(|t| (0.02 * f64::from(t)).sin()).collect();
            let data: Vec<f64> = (0..800)
                .map(|t| {
                    past = 0.8 * past + 0.1 * normal(&mut chance);
                    2.0 * slow[t] - 0.5 + past
                })
                .collect();
            let functions = [slow, vec![1.0; 800]];
            let answer = asked(&[PLAIN; 2], Rows::Uneven, 1, &|p| linear(&functions, &data, p));
            assert!(answer.noise[0].order() == 0 && !answer.misfits);
            for (held, ((low, high), truth)) in held.iter_mut().zip(answer.intervals.iter().zip([2.0, -0.5])) {
                *held += u32::from((*low..=*high).contains(&truth));
            }
        }
        // Binomial: 190 ± 3 of 200, less what the few windows cost.
        assert!(held.iter().all(|held| (176..=200).contains(held)), "of 200: {held:?}");
    }

    /// Intervals of robust fits hold the truth as often as they say, of normal noise and with a tenth of outliers, also where
    /// the noise is correlated.
    ///
    /// Mutants, each fails: the mean square of the slope is 1; the part within the bound is 1.
    #[test]
    fn intervals_of_robust_fits_hold_the_truth() {
        for (kind, rho, share) in [("normal", 0.0, 0.0), ("outliers", 0.0, 0.1), ("correlated", 0.8, 0.03)] {
            let (mut held, mut wide) = ([0; 2], 0.0);
            for seed in 0..200 {
                let (mut chance, mut past) = (Chance(seed), 0.0);
                let slow: Vec<f64> = (0..600).map(|t| (0.02 * f64::from(t)).sin()).collect();
                let data: Vec<f64> = (0..600)
                    .map(|t| {
                        past = rho * past + f64::sqrt(1.0 - rho * rho) * normal(&mut chance);
                        let outlier = if chance.fraction() < share { 40.0 * (chance.fraction() - 0.5) } else { 0.0 };
                        2.0 * slow[t] - 0.5 + 0.1 * (past + outlier)
                    })
                    .collect();
                let functions = [slow, vec![1.0; 600]];
                let left = |p: &[f64]| linear(&functions, &data, p);
                let [answer, plain] =
                    [true, false].map(|robust| asked_so(&[PLAIN; 2], Rows::Even(vec![]), 1, robust, &left));
                wide += plain.sd[0] / answer.sd[0] / 200.0;
                for (held, ((low, high), truth)) in held.iter_mut().zip(answer.intervals.iter().zip([2.0, -0.5])) {
                    *held += u32::from((*low..=*high).contains(&truth));
                }
            }
            // Binomial: 190 ± 3 of 200.
            assert!(held.iter().all(|held| (178..=199).contains(held)), "{kind}: {held:?} of 200");
            assert!(if share > 0.05 { wide > 2.0 } else { wide > 0.9 }, "{kind}: {wide}");
        }
    }

    /// Of a linear model the shift is that of a fit with the other residuals, in standard deviations.
    #[test]
    fn shifts_are_those_of_a_fit_with_the_other_residuals() {
        for seed in 0..50 {
            let mut chance = Chance(seed);
            let functions: Vec<Vec<f64>> =
                (0..3).map(|_| (0..60).map(|_| chance.between(-1.0, 1.0)).collect()).collect();
            let data = linear(&functions, &[0.0; 60], &[1.0, -2.0, 0.5]);
            let data: Vec<f64> = data.iter().map(|y| y + 0.1 * normal(&mut chance)).collect();
            let bias: Vec<f64> = (0..60).map(|row| chance.between(-0.1, 0.2) * f64::from(row % 7)).collect();
            let left = |p: &[f64]| linear(&functions, &data, p);
            let other = |p: &[f64]| left(p).iter().zip(&bias).map(|(r, bias)| r + bias).collect::<Vec<f64>>();
            let mut run = |_: Way, points: &[Vec<f64>]| {
                points.iter().map(|p| Ok(vec![left(p)])).collect::<Vec<Result<Residuals, String>>>()
            };
            let mut finer = |p: &[f64]| vec![(0..1, Ok(vec![other(p)])), (0..1, Err("too long".to_string()))];
            let answer = fit(Question {
                unknowns: &[PLAIN; 3],
                items: &[Item { sd: None, rows: Rows::Independent }],
                minima: DRIVEN,
                run: &mut run,
                finer: Some(&mut finer),
                with: PLATFORM,
                level: 0.95,
                limits: LIMITS,
                starts: 1,
                seed,
                estimator: Estimator::Chosen,
                robust: false,
                journal: None,
            });
            let answer = answer.expect("it has an answer");
            let moved = asked(&[PLAIN; 3], Rows::Independent, 1, &other);
            let shift = answer.shifts[0].as_ref().expect("it can be run");
            for k in 0..3 {
                let expected = (moved.values[k] - answer.values[k]) / answer.sd[k];
                assert!(
                    (shift[k] - expected).abs() < 1e-3 * (1.0 + expected.abs()),
                    "seed {seed}: {shift:?}, {expected}"
                );
            }
            assert_eq!(answer.shifts[1], Err("too long".into()));
        }
    }

    /// Two unknowns, one of which never lies below the other, with ranges of any kind: from every start the search ends
    /// where a fine grid has its least, also where this is at a bound, or where both are the same. With the distance
    /// itself as the coordinate, some searches stop where the upper one meets the end of its range.
    #[test]
    fn searches_beside_a_bound_of_another_end_in_the_minimum() {
        for seed in 0..40 {
            let mut chance = Chance(seed);
            let functions: Vec<Vec<f64>> =
                (0..2).map(|_| (0..30).map(|_| chance.between(-1.0, 1.0)).collect()).collect();
            let truth = [chance.between(0.5, 4.0), chance.between(0.5, 6.0)];
            let data: Vec<f64> = linear(&functions, &[0.0; 30], &truth);
            let data: Vec<f64> = data.iter().map(|y| y + 0.1 * normal(&mut chance)).collect();
            let of = |low: f64, above| Unknown { low, above, ..PLAIN };
            let mut unknowns = [of(chance.between(0.05, 0.3), None), of(chance.between(0.05, 1.0), Some(0))];
            unknowns.iter_mut().for_each(|one| one.high = chance.between(1.5, 8.0));
            let square = |p: &[f64]| linear(&functions, &data, p).iter().map(|r| r * r).sum::<f64>();
            let scale = Scale { unknowns: &unknowns, with: PLATFORM };
            let (low, high) = scale.bounds();
            let at = |i: usize, j: usize| {
                let x = |k: usize, part: usize| low[k] + (high[k] - low[k]) * part as f64 / 400.0;
                square(&scale.values(&[x(0, i), x(1, j)]))
            };
            let least = (0..=400).flat_map(|i| (0..=400).map(move |j| (i, j)));
            let least = least.map(|(i, j)| at(i, j)).fold(f64::INFINITY, f64::min);
            for start in 0..10 {
                let x: Vec<f64> = (0..2).map(|k| chance.between(low[k], high[k])).collect();
                let values = Scale { unknowns: &unknowns, with: PLATFORM }.values(&x);
                unknowns.iter_mut().zip(values).for_each(|(one, value)| one.start = value);
                let rows = Rows::Independent;
                let answer = asked(&unknowns, rows, 1, &|p| linear(&functions, &data, p));
                let found = square(&answer.values);
                assert!(
                    found <= 1.001 * least + 1e-9,
                    "seed {seed}, start {start}: {found}, not {least}: {unknowns:?}"
                );
            }
        }
    }

    /// Columns of a model that is linear in its coordinates are exact beside bounds and beside points that cannot be run,
    /// from both sides or from one; none only where neither side can be run. A stage of a path takes one run for each.
    #[test]
    fn a_column_takes_the_sides_that_can_be_run() {
        for seed in 0..400 {
            let mut chance = Chance(seed);
            let n = 1 + chance.below(4) as usize;
            let unknowns = vec![Unknown { low: -1.0, high: 1.0, start: 0.0, known: None, above: None }; n];
            let slopes: Vec<f64> = (0..n).map(|_| chance.between(-5.0, 5.0)).collect();
            // Values from here on, up or down, cannot be run.
            let fences: Vec<(f64, f64)> =
                (0..n).map(|_| [0.0, 0.0].map(|_| if chance.below(4) == 0 { 4e-4 } else { 9.0 }).into()).collect();
            let x: Vec<f64> = (0..n).map(|_| [1e-12, 0.5, 0.3, 1.0 - 1e-12][chance.below(4) as usize]).collect();
            let middle = Scale { unknowns: &unknowns, with: PLATFORM }.values(&x);
            let mut count = 0;
            let mut run = |_: Way, points: &[Vec<f64>]| {
                count += points.len();
                let one = |values: &Vec<f64>| {
                    let by = || values.iter().zip(&middle).map(|(value, middle)| value - middle);
                    let fails = by().zip(&fences).any(|(by, (below, above))| by > *above || -by > *below);
                    let sum = by().zip(&slopes).map(|(by, slope)| slope * by).sum();
                    if fails { Err("a fence".into()) } else { Ok(vec![vec![sum, -2.0 * sum]]) }
                };
                points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
            };
            let items = [Item { sd: Some(1.0), rows: Rows::Independent }];
            let is_stage = chance.below(2) == 0;
            let mut search = Search::new(Scale { unknowns: &unknowns, with: PLATFORM }, &items, &mut run);
            search.prior = is_stage.then(|| x.clone());
            let columns = search.jacobian(&x, (&[1.0], false), &Vec::new, &mut |all: &mut Vec<_>, piece| {
                if piece.item.is_some() {
                    all.extend(piece.columns.clone());
                }
            });
            // A bound leaves no room above 1 or below 0.
            let is_open = |k: usize, fence: f64, bound: f64| fence > 1.0 && (x[k] - bound).abs() > 1e-9;
            let open: Vec<(bool, bool)> =
                (0..n).map(|k| (is_open(k, fences[k].0, 0.0), is_open(k, fences[k].1, 1.0))).collect();
            let possible = open.iter().all(|(below, above)| *below || *above);
            assert_eq!(columns.is_some(), possible, "seed {seed}: {open:?}");
            for (k, column) in columns.iter().flatten().enumerate() {
                // A value moves by 2 over its range.
                for (found, factor) in column.iter().zip([2.0, -4.0]) {
                    let exact = factor * slopes[k];
                    assert!((found / exact - 1.0).abs() < 1e-9, "seed {seed}: {found}, not {exact}");
                }
            }
            if is_stage && open.iter().all(|(below, above)| *below && *above) {
                assert_eq!(count, 1 + n, "seed {seed}");
            }
        }
    }
}
