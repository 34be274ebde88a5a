//! What is asked of a fit that has an answer: whether its values hold in every piece of the recordings, how far a
//! parameter may go, and what the residuals depend on.
//!
//! In: runs and their answer. Out: values of pieces, profiles, and what stands out in the residuals. Knows nothing of
//! words.

use super::search::{Found, Part, Runs, Settings, Stepped, estimate};
use crate::compile::ElementaryFunction;
use abi::unit::Unit;
use runtime::fit::loss::loss;
use runtime::fit::ranking;
use runtime::fit::statistics::{self, Dependence, Outliers};
use runtime::fit::{Answer, Elementary, Item, Limits, Noise, Residuals, Tile, Trouble, Unknown, Way};
use std::borrow::Cow;

/// Components of a combination that count, as a fraction of the largest.
pub const NAMED: f64 = 0.2;
/// χ² of one degree of freedom that 5 % exceed: a profile ends where the misfit has grown by it.
const RISE: f64 = 3.84;
/// Most points of a profile on each side.
const MOST_POINTS: usize = 14;
/// Most points between the last one below that growth and the first above it.
const MOST_REFINEMENTS: usize = 8;
/// A misfit that is smaller by this is a better minimum.
const BETTER: f64 = 0.5;
/// Fewest rows for each unknown of a piece.
const LEAST_ROWS: usize = 10;

/// When the search in a piece ends: whether it drifts needs few digits, and what a piece does not determine wanders on.
const OF_PIECE: Limits = Limits { trials: 15, tolerance: 1e-4 };
/// A piece determines a value whose standard deviation is below this, in the scale of the search.
const CLEAR: f64 = 0.05;
/// Probability of a false drift, over all unknowns together.
const FALSE_DRIFT: f64 = 1e-3;

/// Values and standard deviations in one piece of the recordings; none where the piece does not determine them.
pub type Piece = Vec<Option<(f64, f64)>>;

/// Runs with some of the unknowns, the others as in `base`.
struct Restricted<'r> {
    model: Stepped<'r>,
    base: &'r [f64],
    free: &'r [usize],
}

impl Restricted<'_> {
    fn expanded(&self, points: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let one = |point: &Vec<f64>| {
            let mut values = self.base.to_vec();
            self.free.iter().zip(point).for_each(|(k, value)| values[*k] = *value);
            values
        };
        points.iter().map(one).collect()
    }
}

impl runtime::fit::Runs for Restricted<'_> {
    fn run(&mut self, _: Way, points: &[Vec<f64>]) -> Vec<Result<Residuals, String>> {
        let points = self.expanded(points);
        self.model.run(Way::Whole, &points)
    }

    fn pass(&mut self, _: Way, points: &[Vec<f64>], each: &mut dyn FnMut(&Tile)) -> Vec<Result<(), String>> {
        let points = self.expanded(points);
        self.model.pass(Way::Whole, &points, each)
    }
}

/// Runs with some of the unknowns, the others as in `base`, which bound those that they must not cross.
fn restricted(
    runs: &Runs,
    base: &[f64],
    free: &[usize],
    settings: Settings,
    (items, model): (&[Item], Stepped),
) -> Result<Answer, Trouble> {
    let all = runs.asked(base);
    let place = |k: usize| free.iter().position(|other| *other == k);
    let one = |k: &usize| {
        let mut unknown = all[*k];
        if let Some(below) = unknown.above.filter(|below| place(*below).is_none()) {
            unknown.low = unknown.low.max(base[below]);
        }
        let fixed = (0..all.len()).filter(|other| all[*other].above == Some(*k) && place(*other).is_none());
        unknown.high = fixed.fold(unknown.high, |high, other| high.min(base[other]));
        unknown.above = unknown.above.and_then(place);
        let has_room = unknown.low < unknown.high;
        unknown.start = unknown.start.min(unknown.high).max(unknown.low);
        has_room.then_some(unknown)
    };
    let unknowns: Option<Vec<Unknown>> = free.iter().map(one).collect();
    let unknowns = unknowns.ok_or_else(|| Trouble::NoStart("the others leave no room".into()))?;
    let mut run = Restricted { model, base, free };
    estimate(runs, &unknowns, items, Settings { starts: Some(1), ..settings }, (&mut run, None))
}

/// Whether an unknown is part of a combination that the data do not determine.
pub fn is_open(answer: &Answer, k: usize) -> bool {
    answer.undetermined.iter().any(|open| {
        let largest = open.direction.iter().map(|c| c.abs()).fold(0.0, f64::max);
        open.direction[k].abs() >= NAMED * largest
    })
}

/// Fits each of some equal pieces of the recordings, from the answer. Initial values stay as they are.
pub fn pieces(runs: &Runs, (answer, steps, _): &Found, settings: Settings, count: usize) -> Vec<Piece> {
    let n = runs.unknowns.len();
    let rows: usize = runs.parts.iter().map(|part| part.instants.len()).sum();
    let steady = runs.parts.iter().any(|part| part.asks.steady);
    if count < 2 || rows < LEAST_ROWS * n * count || steady {
        return Vec::new();
    }
    let all = runs.asked(&answer.values);
    let settings = Settings { limits: OF_PIECE, ..settings.like(answer) };
    let one = |piece: usize| {
        let mut free: Vec<usize> = (0..n).filter(|k| !runs.unknowns[*k].initial).collect();
        let rows = |part: &Part| {
            let rows = part.instants.len();
            (piece * rows / count..(piece + 1) * rows / count).collect()
        };
        let items = runs.compared(&|part| Some(rows(part)));
        let run = runs.with(steps).at(&rows);
        while !free.is_empty() {
            match restricted(runs, &answer.values, &free, settings, (&items, run.clone())) {
                Ok(found) => {
                    let mut values: Piece = vec![None; n];
                    for (at, k) in free.iter().enumerate() {
                        // Where the misfit is not quadratic, a standard deviation means little. Without a distance
                        // from the one above it, a value is that of both.
                        let own = found.sd[at] / all[*k].slope(found.values[at]).abs();
                        let is_vague = |at: usize| found.at_bound[at].is_some() || is_open(&found, at);
                        let above = free.iter().enumerate().filter(|(_, other)| all[**other].above == Some(*k));
                        let alone = above.into_iter().all(|(other, _)| !is_vague(other));
                        let known = own < CLEAR && !is_vague(at) && alone;
                        values[*k] = known.then_some((found.values[at], found.sd[at]));
                    }
                    return values;
                }
                Err(Trouble::NoInfluence(idle)) => {
                    free = free.iter().enumerate().filter(|(at, _)| !idle.contains(at)).map(|(_, k)| *k).collect();
                }
                Err(Trouble::NoStart(_) | Trouble::TooFewRows(..)) => break,
            }
        }
        vec![None; n]
    };
    (0..count).map(one).collect()
}

/// How a value scatters over pieces, beside what its standard deviations explain.
pub struct Scatter {
    /// Least and greatest value.
    pub ends: (f64, f64),
    /// Standard deviation of the values over the pieces.
    pub sd: f64,
    /// Number of pieces that determine it.
    pub pieces: usize,
    /// Whether the pieces differ by more than their standard deviations allow.
    pub drifts: bool,
}

/// The scatter of an unknown over pieces; none if fewer than three determine it.
pub fn scatter(pieces: &[Piece], k: usize) -> Option<Scatter> {
    let found: Vec<(f64, f64)> = pieces.iter().filter_map(|piece| piece[k]).collect();
    let n = found.len();
    if n < 3 {
        return None;
    }
    let weight: f64 = found.iter().map(|(_, sd)| 1.0 / (sd * sd)).sum();
    let mean = found.iter().map(|(value, sd)| value / (sd * sd)).sum::<f64>() / weight;
    let chi_square: f64 = found.iter().map(|(value, sd)| (value - mean) * (value - mean) / (sd * sd)).sum();
    let middle = found.iter().map(|(value, _)| value).sum::<f64>() / n as f64;
    let variance = found.iter().map(|(value, _)| (value - middle) * (value - middle)).sum::<f64>() / (n - 1) as f64;
    let ends =
        found.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (value, _)| (a.min(*value), b.max(*value)));
    let all = pieces[0].len() as f64;
    let drifts = with(|with| statistics::tail(chi_square, (n - 1) as f64, with)) < FALSE_DRIFT / all;
    Some(Scatter { ends, sd: variance.sqrt(), pieces: n, drifts })
}

/// Calls a function with the elementary functions of the language.
fn with<T>(of: impl FnOnce(&Elementary) -> T) -> T {
    let (exp, log) = (ElementaryFunction::exp(), ElementaryFunction::log());
    of(&Elementary { exp: &|x| exp.at(x), log: &|x| log.at(x) })
}

/// How the misfit grows when a parameter is held and the others are fitted again.
#[derive(Clone, PartialEq, Debug)]
pub struct Profile {
    /// Values in SI, ascending, with the growth of −2 log-likelihood.
    pub points: Vec<(f64, f64)>,
    /// Where it has grown by 3.84, within the range.
    pub ends: (Option<f64>, Option<f64>),
}

/// −2 log-likelihood under a model of the noise, up to a constant.
pub fn misfit(runs: &Runs, (noise, residuals): (&[Noise], &Residuals), values: &[f64]) -> f64 {
    let items = runs.parts.iter().flat_map(|part| &part.asks.items);
    let of = |(k, item): (usize, &crate::compile::FitItem)| {
        let (noise, residuals) = (&noise[k], &residuals[k]);
        let n = residuals.len() as f64;
        let square = || noise.whitened(residuals).iter().map(|r| loss(*r, noise.bound)).sum::<f64>();
        with(|with| match item.sd {
            Some(_) => square() + n * (with.log)(noise.innovation),
            // Of least squares the sum is the number of rows.
            None => {
                let square = if noise.is_robust() { square() } else { 0.0 };
                square + n * (with.log)((noise.variance * noise.innovation).max(f64::MIN_POSITIVE))
            }
        })
    };
    let known = runs.unknowns.iter().zip(values).filter_map(|(unknown, value)| {
        let (expected, sd) = unknown.known?;
        Some((value - expected) / sd * ((value - expected) / sd))
    });
    items.enumerate().map(of).sum::<f64>() + known.sum::<f64>()
}

/// The profile of an unknown. An error is a point with a smaller misfit than the answer has.
pub fn profile(runs: &Runs, (answer, steps, _): &Found, settings: Settings, k: usize) -> Result<Profile, Vec<f64>> {
    let n = runs.unknowns.len();
    let (settings, unknown) = (settings.like(answer), &runs.asked(&answer.values)[k]);
    let least = misfit(runs, (&answer.weights, &answer.residuals), &answer.values);
    let free: Vec<usize> = (0..n).filter(|other| *other != k).collect();
    let (low, high) = with(|with| unknown.bounds(with));
    let middle = with(|with| unknown.coordinate(answer.values[k], with));
    let own = answer.sd[k] / unknown.slope(answer.values[k]).abs();
    let first = if own.is_finite() { own } else { f64::INFINITY }.clamp(1e-4 * (high - low), 0.1 * (high - low));
    let mut points = vec![(answer.values[k], 0.0)];
    let mut ends = (None, None);
    for up in [false, true] {
        let edge = if up { high } else { low };
        let mut base = answer.values.clone();
        let mut at = |x: f64, base: &mut Vec<f64>| {
            base[k] = with(|with| unknown.value(x, with));
            // Where the residuals are no noise, their likelihood says as much less as the variance is larger.
            let rise = (rise(runs, answer, steps, settings, (&free, base)) - least) / answer.inflation[k];
            if rise.is_finite() {
                points.push((base[k], rise.max(0.0)));
            }
            rise
        };
        let (mut step, mut inner) = (first, (middle, 0.0_f64));
        let mut outer = None;
        for _ in 0..MOST_POINTS {
            let wanted = inner.0 + if up { step } else { -step };
            let is_last = if up { wanted >= high } else { wanted <= low };
            let x = if is_last { edge } else { wanted };
            let rise = at(x, &mut base);
            if rise < -BETTER {
                return Err(base);
            }
            if rise >= RISE {
                outer = Some((x, rise));
                break;
            }
            inner = (x, rise.max(0.0));
            if is_last {
                break;
            }
            step *= 2.0;
        }
        let Some(mut outer) = outer else { continue };
        // The root of the growth is linear in the coordinate near a minimum; where it is not, the middle is as good.
        let guess = |inner: (f64, f64), outer: (f64, f64)| {
            let (a, b) = (inner.1.sqrt(), outer.1.min(1e6).sqrt());
            (RISE.sqrt() - a) / (b - a)
        };
        for turn in 0..MOST_REFINEMENTS {
            if (outer.0 - inner.0).abs() <= 0.02 * (outer.0 - middle).abs() {
                break;
            }
            let part = if turn % 2 == 0 { guess(inner, outer).clamp(0.1, 0.9) } else { 0.5 };
            let x = inner.0 + part * (outer.0 - inner.0);
            let rise = at(x, &mut base);
            if rise >= RISE || rise.is_nan() {
                outer = (x, rise);
            } else {
                inner = (x, rise.max(0.0));
            }
        }
        let x = inner.0 + guess(inner, outer) * (outer.0 - inner.0);
        let end = Some(with(|with| unknown.value(x, with)));
        if up { ends.1 = end } else { ends.0 = end }
    }
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(Profile { points, ends })
}

/// The misfit where all unknowns but the free ones are as in `base`; enters what is found into it. Infinite if there is no
/// answer.
fn rise(
    runs: &Runs,
    answer: &Answer,
    steps: &[f64],
    settings: Settings,
    (free, base): (&[usize], &mut Vec<f64>),
) -> f64 {
    if free.is_empty() {
        return alone(runs, answer, base, steps).unwrap_or(f64::INFINITY);
    }
    let items = runs.compared_whole();
    let found = restricted(runs, base, free, settings, (&items, runs.with(steps)));
    let Ok(found) = found else { return f64::INFINITY };
    for (at, other) in free.iter().enumerate() {
        base[*other] = found.values[at];
    }
    // A deviation from the median is no minimum of the loss: that of the answer counts.
    let weights = if settings.robust { &answer.weights } else { &found.weights };
    misfit(runs, (weights, &found.residuals), base)
}

/// The misfit with these values, under the noise model of the answer.
fn alone(runs: &Runs, answer: &Answer, values: &[f64], steps: &[f64]) -> Option<f64> {
    let residuals = runs.residuals(Way::Whole, values, steps).ok()?;
    let scaled = |(noise, rows): (&Noise, &Vec<f64>)| {
        let whitened = noise.whitened(rows);
        let part = whitened.iter().map(|r| r * r).sum::<f64>() / whitened.len().max(1) as f64;
        Noise { variance: noise.variance * part, ..noise.clone() }
    };
    let noise: Vec<Noise> = answer.weights.iter().zip(&residuals).map(scaled).collect();
    let known: Vec<bool> = runs.parts.iter().flat_map(|part| &part.asks.items).map(|item| item.sd.is_some()).collect();
    let noise = noise.into_iter().zip(&answer.weights).zip(known);
    let keeps = |old: &Noise, known: bool| known || old.is_robust();
    let noise: Vec<Noise> =
        noise.map(|((new, old), known)| if keeps(old, known) { old.clone() } else { new }).collect();
    Some(misfit(runs, (&noise, &residuals), values))
}

/// A recording that was judged and not fitted.
pub struct Judged {
    /// What it is called.
    pub label: String,
    /// Values of the unknowns that are its own, by their labels.
    pub own: Vec<(String, f64, Unit)>,
    /// What the fit leaves of it, for each compared quantity.
    pub residuals: Residuals,
}

/// Judges the recordings that are not fitted: with the values found, and those that are their own fitted.
pub fn judge(runs: &Runs, (answer, steps, _): &Found, settings: Settings) -> Vec<Result<Judged, String>> {
    let one = |judged: &Runs| {
        let part = &judged.parts[0];
        // The steps are those of a fitted run of the same case.
        let same = runs.parts.iter().position(|other| other.asks.place.case == part.asks.place.case);
        let ratio = same.map_or(1.0, |k| steps[k] / runs.parts[k].step());
        let steps = vec![part.step() * ratio];
        let value = |unknown: &crate::compile::FitUnknown| {
            let shared = |(other, _): &(&crate::compile::FitUnknown, &f64)| other.span == unknown.span;
            let found = runs.unknowns.iter().zip(&answer.values).find(shared).map(|(_, value)| *value);
            found.filter(|_| unknown.of.is_none()).unwrap_or(unknown.start)
        };
        let mut values: Vec<f64> = judged.unknowns.iter().map(value).collect();
        let own: Vec<usize> = (0..values.len()).filter(|k| judged.unknowns[*k].of.is_some()).collect();
        if !own.is_empty() {
            let whole = (&judged.compared_whole()[..], judged.with(&steps));
            let found = restricted(judged, &values, &own, settings, whole);
            for (at, k) in own.iter().enumerate() {
                if let Ok(found) = &found {
                    values[*k] = found.values[at];
                }
            }
        }
        let residuals = judged.residuals(Way::Whole, &values, &steps)?;
        let own = own.iter().map(|k| (judged.unknowns[*k].label.clone(), values[*k], judged.unknowns[*k].unit.clone()));
        Ok(Judged { label: part.asks.label.clone(), own: own.collect(), residuals })
    };
    runs.judged.iter().map(one).collect()
}

/// What a fit leaves of rows that it has not seen, for each compared quantity: of the recordings that are judged, else of
/// each half of the rows when it is fitted to the other half.
pub fn held_out(runs: &Runs, found: &Found, settings: Settings) -> Option<Residuals> {
    if !runs.judged.is_empty() {
        let all: Result<Vec<Judged>, String> = judge(runs, found, settings).into_iter().collect();
        return Some(all.ok()?.into_iter().flat_map(|one| one.residuals).collect());
    }
    let (answer, steps, _) = found;
    let seen = |part: &Part, half: usize| -> Vec<usize> {
        let rows = part.instants.len();
        (0..rows).filter(|row| ranking::piece(*row, rows, part.asks.steady) % 2 == half).collect()
    };
    let mut out: Residuals = answer.residuals.iter().map(|rows| vec![0.0; rows.len()]).collect();
    let free: Vec<usize> = (0..runs.unknowns.len()).collect();
    for half in [0, 1] {
        let items = runs.compared(&|part| Some(seen(part, half)));
        let run = runs.with(steps).at(&|part| seen(part, half));
        let values = restricted(runs, &answer.values, &free, settings.like(answer), (&items, run)).ok()?.values;
        let all = runs.residuals(Way::Whole, &values, steps).ok()?;
        for (part, items) in runs.parts.iter().zip(runs.items()) {
            let is_unseen = seen(part, 1 - half);
            for (k, item) in items.zip(&part.asks.items) {
                for (at, row) in item.kept(&part.instants).into_iter().enumerate() {
                    if is_unseen.binary_search(&row).is_ok() {
                        out[k][at] = all[k][at];
                    }
                }
            }
        }
    }
    Some(out)
}

/// What stands out in the residuals of one compared quantity.
#[derive(Default)]
pub struct Remarks {
    /// The quantity on which they depend: its name, and how.
    pub depends: Option<(String, Unit, Dependence)>,
    /// The quantity in a class of whose values most of the error lies.
    pub lies: Option<(String, Unit, Dependence)>,
    /// Rows that hold most of the error.
    pub outliers: Option<Outliers>,
    /// The beginning fits badly.
    pub begins_badly: bool,
}

/// A column on which residuals may depend, by the rows of the recording.
enum Column<'c> {
    Values(&'c [f64]),
    /// The slope over these times.
    Slope(&'c [f64], &'c [f64]),
}

impl Column<'_> {
    /// At some of the rows, or at all.
    fn at(&self, rows: Option<&[usize]>) -> Cow<'_, [f64]> {
        let slope = |times: &[f64], values: &[f64], row: usize| {
            let (a, b) = (row.saturating_sub(1), (row + 1).min(times.len() - 1));
            (values[b] - values[a]) / (times[b] - times[a])
        };
        match (self, rows) {
            (Column::Values(values), None) => Cow::from(*values),
            (Column::Values(values), Some(rows)) => rows.iter().map(|row| values[*row]).collect(),
            (Column::Slope(times, values), None) => (0..times.len()).map(|row| slope(times, values, row)).collect(),
            (Column::Slope(times, values), Some(rows)) => rows.iter().map(|row| slope(times, values, *row)).collect(),
        }
    }
}

/// Remarks on each compared quantity of a run.
pub fn remarks(part: &Part, answer: &Answer, items: std::ops::Range<usize>) -> Vec<Remarks> {
    // Without a window and a filter, each row of the recording has a residual.
    let (after, before) = part.asks.window;
    let is_within = |row: &usize| (after..=before).contains(&part.asks.rows[*row]);
    let is_whole = part.instants.len() == part.asks.rows.len();
    let mut names: Vec<(String, Unit)> = Vec::new();
    let mut columns: Vec<Column> = Vec::new();
    if !part.asks.steady {
        names.push(("t".into(), Unit::parse("s").expect("it is known")));
        columns.push(Column::Values(&part.asks.rows));
    }
    // Residuals depend on what they were computed from.
    let is_compared =
        |name: &str| part.asks.items.iter().any(|item| item.sides.iter().flatten().any(|(side, _)| side == name));
    for (name, unit, values) in part.asks.columns.iter().filter(|(name, ..)| !is_compared(name)) {
        names.push((name.clone(), unit.clone()));
        columns.push(Column::Values(values));
        // A sensor that is late or has inertia leaves what the rate of the motion explains.
        if !part.asks.steady && part.asks.rows.len() > 2 {
            let text = if unit.text.is_empty() { "1/s".into() } else { format!("{}/s", unit.text) };
            names.push((format!("slope({name})"), Unit { text, ..unit.clone() }));
            columns.push(Column::Slope(&part.asks.rows, values));
        }
    }
    let states: Vec<usize> = (0..names.len()).filter(|k| names[*k].0.starts_with("data.")).collect();
    let one = |(k, item): (usize, &crate::compile::FitItem)| {
        let (residuals, noise) = (&answer.residuals[k], &answer.noise[k]);
        // The rows that have a residual; None where every row has one.
        let rows: Option<Vec<usize>> = (!is_whole || item.thin.is_some()).then(|| {
            let within: Vec<usize> = (0..part.asks.rows.len()).filter(is_within).collect();
            item.kept(&part.instants).into_iter().map(|row| within[row]).collect()
        });
        let column = |k: usize| columns[k].at(rows.as_deref());
        let mut white = vec![f64::NAN; residuals.len()];
        noise.kept(residuals.len()).zip(noise.whitening(residuals)).for_each(|(row, r)| white[row] = r);
        let found = with(|with| statistics::dependence((residuals, &white), (columns.len(), &column), with));
        let depends = found.map(|found| {
            let (name, unit) = names[found.column].clone();
            (name, unit, found)
        });
        let of_states = |k: usize| column(states[k]);
        let found = statistics::concentration(residuals, (states.len(), &of_states)).filter(|_| depends.is_none());
        let lies = found.map(|found| {
            let (name, unit) = names[states[found.column]].clone();
            (name, unit, found)
        });
        let begins_badly = !part.asks.steady && statistics::begins_badly(residuals);
        // A bad beginning is no outlier.
        let is_beginning = |found: &Outliers| {
            let head = residuals.len() / 10;
            found.rows.iter().all(|row| *row < head) && found.tenth.as_ref().is_none_or(|tenth| tenth.start == 0)
        };
        let outliers = statistics::outliers(residuals, &white).filter(|found| !(begins_badly && is_beginning(found)));
        let left = item.thin.as_ref().map(|_| item.kept(&part.instants));
        let instant = |row: usize| left.as_ref().map_or(row, |left| left[row]);
        let of_rows = |found: Outliers| Outliers {
            rows: found.rows.into_iter().map(instant).collect(),
            tenth: found.tenth.map(|tenth| instant(tenth.start)..instant(tenth.end - 1) + 1),
        };
        // Where the error lies in values of a column, its largest rows are no outliers.
        let outliers = outliers.map(of_rows).filter(|_| lies.is_none());
        Remarks { depends, lies, outliers, begins_badly }
    };
    items.zip(&part.asks.items).map(one).collect()
}
