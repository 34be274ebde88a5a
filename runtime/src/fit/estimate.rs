//! The procedure of a fit: from a start to values with intervals.
//!
//! In: a [`Question`]. Out: an [`Answer`], or a [`Trouble`]. Several starts are judged, and searches follow the best of
//! them until two end alike. Output error, weighted by a noise model: first white noise,
//! then twice an autoregressive model of the residuals, with which residuals and derivatives are whitened and the search
//! continues. Derivatives are central differences, of a size that the noise determines.

use crate::fit::least_squares::{Triangle, singular};
use crate::fit::noise::Noise;
use crate::fit::quantiles;
use crate::fit::trust_region::{End, Ended, Limits, Objective, minimise};
use crate::fit::unknowns::{Elementary, Unknown};
use crate::rng::Chance;
use std::collections::BTreeMap;

/// Differences between model and measurement: for each item, a number for each row.
pub type Residuals = Vec<Vec<f64>>;

/// Runs the model with each of these sets of values, in SI, in the order of the unknowns. An error says why a run
/// failed.
pub type Runs<'a> = dyn FnMut(&[Vec<f64>]) -> Vec<Result<Residuals, String>> + 'a;

/// A compared quantity.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Item {
    /// Standard deviation of its measurement, if known.
    pub sd: Option<f64>,
}

/// What to fit.
pub struct Question<'a> {
    /// The unknowns; at least one.
    pub unknowns: &'a [Unknown],
    /// The compared quantities; at least one.
    pub items: &'a [Item],
    /// The rows are independent measurements, so that their noise is white.
    pub independent: bool,
    /// Runs the model.
    pub run: &'a mut Runs<'a>,
    /// Elementary functions.
    pub with: Elementary<'a>,
    /// Probability of the intervals.
    pub level: f64,
    /// Most trial points of each stage.
    pub trials: u32,
    /// Number of starts that are judged, the written one among them.
    pub starts: usize,
    /// Seed of the other starts.
    pub seed: u64,
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
/// Rounds of weights for several items of unknown noise.
const MOST_ROUNDS: u32 = 6;
/// Starts that are run at once: their residuals are in memory together.
const JUDGED_AT_ONCE: usize = 16;
/// Fewest and most searches that are followed to their ends, where there are as many starts.
const LEAST_FOLLOWED: usize = 3;
const MOST_FOLLOWED: usize = 6;
/// Searches whose −2 log-likelihoods differ by less ended in the same minimum.
const SAME_END: f64 = 0.5;
/// A coordinate this near to a bound is at it, as a fraction of the range.
const AT_BOUND: f64 = 1e-6;
/// The part of the range in which a coordinate at a bound stays.
const HELD_AT_BOUND: f64 = 1e-7;

/// Finds the values that fit best, from the start.
///
/// # Errors Why there is no answer.
pub fn fit(question: Question) -> Result<Answer, Trouble> {
    let Question { unknowns, items, independent, run, with, level, trials, starts, seed } = question;
    let n = unknowns.len();
    assert!(n > 0 && !items.is_empty(), "{n} unknowns, {} items", items.len());
    let (low, high): (Vec<f64>, Vec<f64>) = unknowns.iter().map(|unknown| unknown.bounds(&with)).unzip();
    let mut search = Search {
        unknowns,
        run,
        with,
        low: low.clone(),
        high: high.clone(),
        noise: items.iter().map(|item| Noise::white(item.sd.map_or(1.0, |sd| sd * sd))).collect(),
        sizes: vec![FIRST_DIFFERENCE; n],
        last: None,
        influence: vec![false; n],
        runs: 0,
        failures: BTreeMap::new(),
    };
    let limits = Limits { trials, tolerance: 1e-8 };
    let written: Vec<f64> = unknowns.iter().map(|unknown| unknown.coordinate(unknown.start, &with)).collect();
    let (judged, rows) = search.judge(items, &spread(&written, &low, &high, starts, seed)).map_err(Trouble::NoStart)?;
    if rows <= n {
        return Err(Trouble::TooFewRows(rows, n));
    }
    let mut ends: Vec<Followed> = Vec::new();
    for start in judged.into_iter().take(MOST_FOLLOWED) {
        match search.follow(items, start, limits)? {
            Some(followed) => ends.push(followed),
            None => continue,
        }
        if ends.len() == 1 {
            let idle: Vec<usize> = (0..n).filter(|k| !search.influence[*k]).collect();
            if !idle.is_empty() {
                return Err(Trouble::NoInfluence(idle));
            }
        }
        if agreed(&ends) >= 2 && ends.len() >= LEAST_FOLLOWED {
            break;
        }
    }
    let followed = (ends.len(), agreed(&ends));
    let best = ends.into_iter().min_by(|a, b| a.misfit.total_cmp(&b.misfit));
    let Some(Followed { end, noise, .. }) = best else { return Err(Trouble::NoStart(search.commonest())) };
    let mut x = end.x.clone();
    search.noise = noise;
    let mut end = Some(end);
    // A model error that a bound causes looks like correlated noise, in which the parameter would leave the bound.
    let (mut from, mut to) = (low.clone(), high.clone());
    for k in 0..n {
        match search.at_bound(&x, k) {
            Some(Edge::Low) => to[k] = low[k] + HELD_AT_BOUND * (high[k] - low[k]),
            Some(Edge::High) => from[k] = high[k] - HELD_AT_BOUND * (high[k] - low[k]),
            None => {}
        }
    }
    // Twice: a noise model of the residuals, and on from there.
    for _ in 0..if independent { 0 } else { 2 } {
        let residuals = search.residuals(&x).map_err(Trouble::NoStart)?;
        search.weigh(items, &residuals, true);
        let found = minimise(&x, &from, &to, &mut search, limits);
        if found.why == Ended::NoStart {
            break;
        }
        x.clone_from(&found.x);
        end = Some(found);
    }
    let why = end.expect("there is a first stage").why;
    search.conclude(items, &x, level, (why, starts, followed))
}

/// Where a search from one start ended, with white noise.
struct Followed {
    end: End,
    noise: Vec<Noise>,
    /// −2 log-likelihood, but for a constant.
    misfit: f64,
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
    unknowns: &'a [Unknown],
    run: &'a mut Runs<'a>,
    with: Elementary<'a>,
    low: Vec<f64>,
    high: Vec<f64>,
    noise: Vec<Noise>,
    /// Sizes of the differences.
    sizes: Vec<f64>,
    /// The last point that was run, with its residuals.
    last: Option<(Vec<f64>, Residuals)>,
    /// Unknowns that have changed something.
    influence: Vec<bool>,
    runs: u64,
    failures: BTreeMap<String, u64>,
}

impl Search<'_> {
    fn values(&self, x: &[f64]) -> Vec<f64> {
        self.unknowns.iter().zip(x).map(|(unknown, x)| unknown.value(*x, &self.with)).collect()
    }

    fn run_all(&mut self, points: &[Vec<f64>]) -> Vec<Result<Residuals, String>> {
        let values: Vec<Vec<f64>> = points.iter().map(|x| self.values(x)).collect();
        self.runs += points.len() as u64;
        let all = (self.run)(&values);
        assert_eq!(all.len(), points.len(), "a result for each run");
        for why in all.iter().filter_map(|one| one.as_ref().err()) {
            *self.failures.entry(why.clone()).or_default() += 1;
        }
        all
    }

    fn residuals(&mut self, x: &[f64]) -> Result<Residuals, String> {
        if let Some((_, residuals)) = self.last.as_ref().filter(|(at, _)| at == x) {
            return Ok(residuals.clone());
        }
        let residuals = self.run_all(&[x.to_vec()]).remove(0)?;
        self.last = Some((x.to_vec(), residuals.clone()));
        Ok(residuals)
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
    /// # Errors The commonest cause, if none can be run.
    fn judge(&mut self, items: &[Item], starts: &[Vec<f64>]) -> Result<(Vec<Vec<f64>>, usize), String> {
        let (mut misfits, mut rows) = (Vec::new(), 0);
        for first in (0..starts.len()).step_by(JUDGED_AT_ONCE) {
            let some = &starts[first..starts.len().min(first + JUDGED_AT_ONCE)];
            for (k, residuals) in self.run_all(some).into_iter().enumerate() {
                let Ok(residuals) = residuals else { continue };
                rows = residuals.iter().map(Vec::len).sum();
                misfits.push((first + k, self.misfit(items, &residuals)));
            }
        }
        if misfits.is_empty() {
            return Err(self.commonest());
        }
        // Failures are those of the search.
        self.failures.clear();
        misfits.sort_by(|a, b| (a.0 != 0).cmp(&(b.0 != 0)).then(a.1.total_cmp(&b.1)));
        Ok((misfits.into_iter().map(|(k, _)| starts[k].clone()).collect(), rows))
    }

    /// How badly a start fits. Large residuals count little, so that a run that goes astray is bad and not infinitely bad.
    fn misfit(&self, items: &[Item], residuals: &Residuals) -> f64 {
        let of = |(item, rows): (&Item, &Vec<f64>)| -> f64 {
            let (floor, scale) = match item.sd {
                Some(sd) => (1.0, 1.0 / (sd * sd)),
                None => ((1e-6 * mean_square(rows)).max(f64::MIN_POSITIVE), 1.0),
            };
            rows.iter().map(|r| (self.with.log)(floor + scale * r * r)).sum()
        };
        items.iter().zip(residuals).map(of).sum()
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
                    None => rows.len() as f64 * (self.with.log)(mean_square(rows).max(f64::MIN_POSITIVE)),
                };
                let misfit = items.iter().zip(&residuals).map(of).sum();
                return Ok(Some(Followed { end, noise: self.noise.clone(), misfit }));
            }
        }
        unreachable!("the rounds end")
    }

    /// Models the noise of each item from its residuals. Returns whether a weight has changed by more than 1 %.
    fn weigh(&mut self, items: &[Item], residuals: &Residuals, correlated: bool) -> bool {
        let mut changed = false;
        for (k, (item, residuals)) in items.iter().zip(residuals).enumerate() {
            let mean = mean_square(residuals);
            let mut noise = if correlated { Noise::of(residuals, &self.with) } else { Noise::white(mean) };
            // Data that a model fits exactly have no noise to weigh by.
            noise.variance = item.sd.map_or(mean.max(f64::MIN_POSITIVE), |sd| sd * sd);
            changed |= (noise.variance / self.noise[k].variance - 1.0).abs() > 0.02;
            self.noise[k] = noise;
        }
        changed
    }

    /// Whitened residuals of all items, one after the other, then what is known beforehand.
    fn white(&self, x: &[f64], residuals: &Residuals) -> Vec<f64> {
        let mut all: Vec<f64> = Vec::new();
        for (noise, residuals) in self.noise.iter().zip(residuals) {
            all.extend(noise.whitened(residuals));
        }
        let values = self.values(x);
        let known = self.unknowns.iter().zip(values).filter_map(|(unknown, value)| {
            let (expected, sd) = unknown.known?;
            Some((value - expected) / sd)
        });
        all.extend(known);
        all
    }

    /// Columns of the Jacobian of the whitened residuals, by differences of these sizes; none if the model cannot be run
    /// around this point. `part`: their size as a fraction.
    fn columns(&mut self, x: &[f64], part: f64) -> Option<Vec<Vec<f64>>> {
        let n = x.len();
        let moved = |k: usize, by: f64| {
            let mut moved = x.to_vec();
            moved[k] = (x[k] + by).clamp(self.low[k], self.high[k]);
            moved
        };
        let points: Vec<Vec<f64>> =
            (0..n).flat_map(|k| [moved(k, part * self.sizes[k]), moved(k, -part * self.sizes[k])]).collect();
        let results = self.run_all(&points);
        let middle = self.residuals(x).ok()?;
        let at = |k: usize, this: &Self| results[k].as_ref().ok().map(|residuals| this.white(&points[k], residuals));
        let mut columns = Vec::new();
        for k in 0..n {
            let (above, below) = (at(2 * k, self), at(2 * k + 1, self));
            let (from, to) = match (&above, &below) {
                (Some(_), Some(_)) => (points[2 * k + 1][k], points[2 * k][k]),
                (Some(_), None) => (x[k], points[2 * k][k]),
                (None, Some(_)) => (points[2 * k + 1][k], x[k]),
                (None, None) => return None,
            };
            let centre = self.white(x, &middle);
            let (above, below) = (above.unwrap_or_else(|| centre.clone()), below.unwrap_or(centre));
            let inverse = 1.0 / (to - from);
            columns.push(above.iter().zip(&below).map(|(a, b)| inverse * (a - b)).collect());
            let raw = |k: usize| results[k].as_ref().unwrap_or(&middle);
            self.influence[k] |= raw(2 * k) != raw(2 * k + 1);
        }
        Some(columns)
    }

    /// Chooses the sizes of the next differences from the lengths of the columns.
    fn size(&mut self, columns: &[Vec<f64>]) {
        for (size, column) in self.sizes.iter_mut().zip(columns) {
            let length = column.iter().map(|c| c * c).sum::<f64>().sqrt();
            *size = (PART_OF_NOISE / length).clamp(DIFFERENCES.0, DIFFERENCES.1);
        }
    }

    fn conclude(
        mut self,
        items: &[Item],
        x: &[f64],
        level: f64,
        (why, starts, (followed, agreed)): (Ended, usize, (usize, usize)),
    ) -> Result<Answer, Trouble> {
        let n = x.len();
        let residuals = self.residuals(x).map_err(Trouble::NoStart)?;
        let failed = |this: &Self| Trouble::NoStart(this.commonest());
        let Some(first) = self.columns(x, 1.0) else { return Err(failed(&self)) };
        self.size(&first);
        let Some(columns) = self.columns(x, 1.0) else { return Err(failed(&self)) };
        let Some(finer) = self.columns(x, 1.0 / 3.0) else { return Err(failed(&self)) };
        let length = |column: &[f64]| column.iter().map(|c| c * c).sum::<f64>().sqrt();
        let differ = |k: &usize| {
            let gap: Vec<f64> = columns[*k].iter().zip(&finer[*k]).map(|(a, b)| a - b).collect();
            length(&gap) > ROUGH * length(&columns[*k])
        };
        let rough: Vec<usize> = (0..n).filter(differ).collect();
        let white = self.white(x, &residuals);
        let triangle = reduced(&columns, &white);
        let degrees = (white.len() as f64 - n as f64).max(1.0);
        let chi_square = triangle.square() / degrees;
        // Where a standard deviation is given, it is not estimated again.
        let variance = if items.iter().any(|item| item.sd.is_some()) { 1.0 } else { chi_square };
        let of_r = |k: usize| (0..n).map(|row| triangle.r[row * n + k]).collect::<Vec<f64>>();
        let parts = singular((0..n).map(of_r).collect(), &triangle.qf);
        let covariance = |i: usize, j: usize| -> f64 {
            let each = parts.values.iter().zip(&parts.vectors);
            each.map(|(s, v)| variance * (v[i] / s) * (v[j] / s)).sum()
        };
        let sd_of: Vec<f64> = (0..n).map(|k| covariance(k, k).sqrt()).collect();
        let values = self.values(x);
        let t = quantiles::student(level, degrees, &self.with);
        let interval = |k: usize| {
            let unknown = &self.unknowns[k];
            let reach = t * sd_of[k];
            let ends = [x[k] - reach, x[k] + reach].map(|x| unscaled(unknown, x, &self.with));
            (ends[0].min(ends[1]), ends[0].max(ends[1]))
        };
        let correlation = |i: usize, j: usize| if i == j { 1.0 } else { covariance(i, j) / (sd_of[i] * sd_of[j]) };
        // In SI a scale by logarithms of negative values reverses signs; of values and coordinates alike here.
        let sign = |k: usize| f64::copysign(1.0, self.unknowns[k].slope(values[k]));
        // A scale by logarithms of negative values reverses their order.
        let at_bound = |k: usize| self.at_bound(x, k).map(|edge| (edge == Edge::High) == (sign(k) > 0.0));
        let undetermined = parts.values.iter().zip(&parts.vectors).filter_map(|(s, v)| {
            let sensitivity = s / variance.sqrt();
            (sensitivity < LEAST_SENSITIVITY).then(|| Combination { sensitivity, direction: v.clone() })
        });
        Ok(Answer {
            sd: (0..n).map(|k| sd_of[k] * self.unknowns[k].slope(values[k]).abs()).collect(),
            intervals: (0..n).map(interval).collect(),
            correlation: (0..n * n).map(|at| correlation(at / n, at % n) * sign(at / n) * sign(at % n)).collect(),
            at_bound: (0..n).map(at_bound).collect(),
            undetermined: undetermined.collect(),
            rough,
            rms: residuals.iter().map(|rows| mean_square(rows).sqrt()).collect(),
            chi_square,
            degrees,
            values,
            residuals,
            why,
            starts,
            followed,
            agreed,
            noise: self.noise,
            runs: self.runs,
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

fn reduced(columns: &[Vec<f64>], f: &[f64]) -> Triangle {
    let mut triangle = Triangle::new(columns.len());
    let mut row = vec![0.0; columns.len()];
    for (at, f) in f.iter().enumerate() {
        row.iter_mut().zip(columns).for_each(|(cell, column)| *cell = column[at]);
        triangle.add(&mut row, *f);
    }
    triangle
}

impl Objective for Search<'_> {
    fn cost(&mut self, x: &[f64]) -> Option<f64> {
        let residuals = self.residuals(x).ok()?;
        let cost = 0.5 * self.white(x, &residuals).iter().map(|r| r * r).sum::<f64>();
        cost.is_finite().then_some(cost)
    }

    fn linearise(&mut self, x: &[f64]) -> Option<Triangle> {
        let residuals = self.residuals(x).ok()?;
        let columns = self.columns(x, 1.0)?;
        self.size(&columns);
        // Runs around `x` have replaced the last point.
        self.last = Some((x.to_vec(), residuals.clone()));
        Some(reduced(&columns, &self.white(x, &residuals)))
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

    fn decay(p: &[f64], t: f64) -> f64 {
        p[0] * (-t * p[1]).exp() + p[2]
    }

    fn unknowns() -> [Unknown; 3] {
        [
            Unknown { low: 0.2, high: 20.0, start: 1.0, known: None },
            Unknown { low: 0.005, high: 0.5, start: 0.1, known: None },
            Unknown { low: -1.0, high: 1.0, start: 0.2, known: None },
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
        let mut run = |points: &[Vec<f64>]| {
            points.iter().map(|p| Ok(vec![residuals(p)])).collect::<Vec<Result<Residuals, String>>>()
        };
        fit(Question {
            unknowns,
            items,
            independent: false,
            run: &mut run,
            with: PLATFORM,
            level: 0.95,
            trials: 100,
            starts: 1,
            seed: 0,
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
                let answer = fitted(&data, &unknowns(), &[Item { sd: None }]).expect("it has an answer");
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
        let free = fitted(&data, &unknowns(), &[Item { sd: None }]).unwrap();
        let doubled = fitted(&data, &unknowns(), &[Item { sd: Some(0.02) }]).unwrap();
        let estimated = free.chi_square.sqrt() * free.rms[0];
        assert!((doubled.sd[1] / free.sd[1] - 0.02 / estimated).abs() < 0.1, "{doubled:?} {free:?}");
        assert!((doubled.chi_square - 0.25).abs() < 0.08, "{doubled:?}");
        let mut known = unknowns();
        known[1].known = Some((TRUE[1], 1e-6));
        let narrowed = fitted(&data, &known, &[Item { sd: Some(0.01) }]).unwrap();
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
                Unknown { low: 1.0, high: 10.0, start: chance.between(1.0, 10.0), known: None },
                Unknown { low: 0.0, high: 3.0, start: chance.between(0.0, 3.0), known: None },
            ];
            for starts in [1, 64] {
                let mut run = |points: &[Vec<f64>]| {
                    let one =
                        |p: &Vec<f64>| Ok(vec![(0..200).map(|t| wave(p[0], p[1], t) - data[t as usize]).collect()]);
                    points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
                };
                let items = &[Item { sd: None }];
                let (unknowns, run) = (&unknowns, &mut run);
                let question = Question {
                    unknowns,
                    items,
                    independent: false,
                    run,
                    with: PLATFORM,
                    level: 0.95,
                    trials: 100,
                    starts,
                    seed,
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
            bounded[2] = Unknown { low: -1.0, high: TRUE[2] - 0.1, start: -0.8, known: None };
            let answer = fitted(&data, &bounded, &[Item { sd: None }]).unwrap();
            assert_eq!(answer.at_bound[2], Some(true), "seed {seed}: {answer:?}");
        }
    }

    #[test]
    fn trouble_is_named() {
        let data = vec![1.0; 3];
        assert_eq!(fitted(&data, &unknowns(), &[Item { sd: None }]), Err(Trouble::TooFewRows(3, 3)));
        let mut run = |points: &[Vec<f64>]| {
            let one = |p: &Vec<f64>| Ok(vec![(0..20).map(|t| p[0] - f64::from(t)).collect()]);
            points.iter().map(one).collect::<Vec<Result<Residuals, String>>>()
        };
        let with = PLATFORM;
        let item = [Item { sd: None }];
        let unknowns = unknowns();
        let question = Question {
            unknowns: &unknowns[..2],
            items: &item,
            independent: false,
            run: &mut run,
            with,
            level: 0.95,
            trials: 100,
            starts: 1,
            seed: 0,
        };
        assert_eq!(fit(question), Err(Trouble::NoInfluence(vec![1])));
        let mut never = |points: &[Vec<f64>]| points.iter().map(|_| Err("too many steps".to_string())).collect();
        let question = Question {
            unknowns: &unknowns[..2],
            items: &item,
            independent: false,
            run: &mut never,
            with,
            level: 0.95,
            trials: 100,
            starts: 1,
            seed: 0,
        };
        assert_eq!(fit(question), Err(Trouble::NoStart("too many steps".into())));
    }

    /// Two unknowns of which only the product matters: one combination stays open, and it is their ratio.
    #[test]
    fn a_combination_without_data_is_found() {
        let mut chance = Chance(3);
        let noise: Vec<f64> = (0..100).map(|_| 0.01 * normal(&mut chance)).collect();
        let unknown = Unknown { low: 0.1, high: 10.0, start: 0.7, known: None };
        let residuals = |p: &[f64]| noise.iter().map(|e| p[0] * p[1] - 1.0 - e).collect();
        let answer = answered(&[unknown; 2], &[Item { sd: None }], &residuals).unwrap();
        assert!((answer.values[0] * answer.values[1] - 1.0).abs() < 0.01, "{answer:?}");
        let [open] = &answer.undetermined[..] else { panic!("{answer:?}") };
        assert!((open.direction[0] + open.direction[1]).abs() < 1e-3, "{open:?}");
    }
}
