//! The verdict on an expectation, from the readings of its measures.
//!
//! In: an [`Expect`] and the readings of one run, or of a run and of more accurate runs of the same experiment. Out: a
//! [`Verdict`] with the deciding comparison, and with more than one run the numerical error of each number and whether
//! the verdict holds within that error. Knows neither points nor solvers.

use abi::plan::{Expect, Formula};
use abi::unit::Unit;

/// Differences below this fraction of the greatest magnitude of a measured quantity are rounding errors and never make
/// a verdict undecided: a power that is −1e-25 W at rest still counts as not negative.
const ROUNDING: f64 = 1e-11;

/// A quantity that never exceeds this in SI consists of rounding errors.
const NOTHING: f64 = 1e-15;

/// The result of one expectation.
#[derive(Clone, PartialEq, Debug)]
pub struct Verdict {
    /// The expectation as written.
    pub text: String,
    /// Whether it holds. False where there is a `problem`.
    pub holds: bool,
    /// Whether the numerical error is too small to reverse the result; true where no error was estimated.
    pub decided: bool,
    /// The readings of its measures, in the order of the text.
    pub readings: Vec<Reading>,
    /// The deciding comparison; none where the condition has no comparison or could not be evaluated.
    pub margin: Option<Margin>,
    /// Why the condition could not be evaluated, in words: `the window … is empty`.
    pub problem: Option<String>,
    /// For a value that is only shown: the value with its error. It is not judged: `holds` and `decided` are true.
    pub shown: Option<Reading>,
}

impl Verdict {
    /// Whether it holds and is decided.
    pub fn passed(&self) -> bool {
        self.holds && self.decided
    }
}

/// The value of one measure.
#[derive(Clone, PartialEq, Debug)]
pub struct Reading {
    /// The measure as written.
    pub text: String,
    /// In SI.
    pub value: f64,
    /// The unit it is shown in.
    pub unit: Unit,
    /// Time in s, for a measure with an instant: for `max`, when the maximum was reached.
    pub time: Option<f64>,
    /// Error due to the spacing of the points, SI: half of what denser points could change.
    pub resolution: f64,
    /// For an extreme at fixed steps: how far the extreme between the points may be from it, SI.
    pub unseen: f64,
    /// The greatest magnitude that the measured quantity reached, SI.
    pub scale: f64,
    /// Estimated distance to the exact solution of the model, SI; infinite if it could not be estimated, none if no
    /// estimate was requested.
    pub error: Option<f64>,
}

/// The distance of a comparison from its opposite result.
#[derive(Clone, PartialEq, Debug)]
pub struct Margin {
    /// Distance to the limit in SI: positive where the comparison holds.
    pub amount: f64,
    /// The value compared, in SI.
    pub value: f64,
    /// What it was compared with, in SI.
    pub limit: f64,
    /// The unit of all three.
    pub unit: Unit,
    /// The relevant instant in s, if one of the compared measures has one.
    pub time: Option<f64>,
    /// Estimated numerical error of value − limit, SI, as in [`Reading::error`].
    pub error: Option<f64>,
}

/// A run of an experiment with more accurate runs of the same, and the error estimator for the first.
pub struct Runs<'a> {
    /// The readings of one expectation: those of the run itself, then those of the more accurate runs.
    pub readings: &'a [&'a [Reading]],
    /// The error of the first of several values of the same number; none where no estimate was requested.
    pub error: &'a dyn Fn(&[f64]) -> Option<f64>,
}

/// The verdict from the readings of a run alone.
pub fn verdict(expect: &Expect, readings: Vec<Reading>) -> Verdict {
    judged(expect, &Runs { readings: &[&readings], error: &|_| None })
}

/// The verdict on the first of several runs, with its numerical error.
pub fn judged(expect: &Expect, runs: &Runs) -> Verdict {
    let mut readings = runs.readings[0].to_vec();
    let finest = runs.readings[runs.readings.len() - 1];
    for (k, reading) in readings.iter_mut().enumerate() {
        let values: Vec<f64> = runs.readings.iter().map(|readings| readings[k].value).collect();
        // Points that several runs share give no information about the signal in between: that is as uncertain as in
        // the finest run.
        let moved = distance(reading.value, finest[k].value);
        let beyond = if finest[k].unseen > 0.0 { finest[k].unseen + moved } else { 0.0 };
        // If the finest run has located the event, the error of this instant is the distance between the two.
        let resolution = reading.resolution.min(finest[k].resolution + moved);
        let rounding = if reading.scale <= NOTHING { reading.value.abs() } else { 0.0 };
        reading.error = (runs.error)(&values).map(|error| error.max(resolution).max(beyond).max(rounding));
    }
    if let Formula::Shown(unit, value) = &expect.condition {
        return shown(expect, runs, readings, unit, value);
    }
    match (Evaluation { runs }).of(&expect.condition) {
        Ok(Evaluated { value, margin, known, .. }) => {
            let decided = known || (runs.error)(&[0.0]).is_none();
            Verdict {
                text: expect.text.clone(),
                holds: value != 0.0,
                decided,
                readings,
                margin,
                problem: None,
                shown: None,
            }
        }
        Err(problem) => unable(expect, readings, problem),
    }
}

/// The verdict where the condition cannot be evaluated, and why.
pub fn unable(expect: &Expect, readings: Vec<Reading>, problem: String) -> Verdict {
    let text = expect.text.clone();
    Verdict { text, holds: false, decided: true, readings, margin: None, problem: Some(problem), shown: None }
}

/// The value of an expectation that is only shown, not judged.
fn shown(expect: &Expect, runs: &Runs, readings: Vec<Reading>, unit: &Unit, formula: &Formula) -> Verdict {
    let value = match number(formula, runs.readings[0]) {
        Ok(value) => value,
        Err(problem) => return unable(expect, readings, problem),
    };
    let error = Evaluation { runs }.error(formula);
    let time = match formula {
        Formula::Measure(index) => readings[*index].time,
        _ => None,
    };
    let text = expect.text.clone();
    let shown = Reading {
        text: text.clone(),
        value,
        unit: unit.clone(),
        time,
        resolution: 0.0,
        unseen: 0.0,
        scale: value.abs(),
        error,
    };
    Verdict { text, holds: true, decided: true, readings, margin: None, problem: None, shown: Some(shown) }
}

struct Evaluated {
    value: f64,
    margin: Option<Margin>,
    /// For a condition: whether no error within the estimate can reverse it (Kleene's three-valued logic).
    known: bool,
}

struct Evaluation<'a> {
    runs: &'a Runs<'a>,
}

impl Evaluation<'_> {
    /// Evaluates a formula over the readings of the first run. A result that is not a number (0/0) is an error, because
    /// comparisons with NaN have no meaning.
    fn of(&self, formula: &Formula) -> Result<Evaluated, String> {
        match formula {
            Formula::Less(a, b) => self.compared(formula, a, b, 1.0, true),
            Formula::LessEqual(a, b) => self.compared(formula, a, b, 1.0, false),
            Formula::Greater(a, b) => self.compared(formula, a, b, -1.0, true),
            Formula::GreaterEqual(a, b) => self.compared(formula, a, b, -1.0, false),
            Formula::Near { value, target, tolerance, relative } => {
                let readings = self.runs.readings[0];
                let (measured, target) = (number(value, readings)?, number(target, readings)?);
                let tolerance = number(tolerance, readings)?;
                let amount = width(tolerance, target, *relative) - distance(measured, target);
                Ok(self.margin(amount >= 0.0, amount, (measured, target), formula))
            }
            Formula::And(a, b) => {
                let (a, b) = (self.of(a)?, self.of(b)?);
                let value = f64::from(a.value != 0.0 && b.value != 0.0);
                let settles = |one: &Evaluated| one.known && one.value == 0.0;
                let known = a.known && b.known || settles(&a) || settles(&b);
                Ok(Evaluated { value, margin: deciding(a, b, known, f64::lt), known })
            }
            Formula::Or(a, b) => {
                let (a, b) = (self.of(a)?, self.of(b)?);
                let value = f64::from(a.value != 0.0 || b.value != 0.0);
                let settles = |one: &Evaluated| one.known && one.value != 0.0;
                let known = a.known && b.known || settles(&a) || settles(&b);
                Ok(Evaluated { value, margin: deciding(a, b, known, f64::gt), known })
            }
            Formula::Not(a) => {
                let a = self.of(a)?;
                let turned = a.margin.map(|margin| Margin { amount: -margin.amount, ..margin });
                Ok(Evaluated { value: f64::from(a.value == 0.0), margin: turned, known: a.known })
            }
            Formula::Shown(_, a) => self.of(a),
            Formula::In(unit, a) => {
                let a = self.of(a)?;
                Ok(Evaluated { margin: a.margin.map(|margin| Margin { unit: unit.clone(), ..margin }), ..a })
            }
            Formula::Number(_)
            | Formula::Measure(_)
            | Formula::Function(..)
            | Formula::Negate(_)
            | Formula::Abs(_)
            | Formula::Sqrt(_)
            | Formula::Add(..)
            | Formula::Subtract(..)
            | Formula::Multiply(..)
            | Formula::Divide(..)
            | Formula::Min(..)
            | Formula::Max(..) => {
                let value = number(formula, self.runs.readings[0])?;
                // A measured truth value is decided if the more accurate runs agree.
                let same =
                    |readings: &&[Reading]| number(formula, readings).is_ok_and(|v| (v != 0.0) == (value != 0.0));
                let known = self.runs.readings.iter().all(same) && self.error(formula).is_none_or(f64::is_finite);
                Ok(Evaluated { value, margin: None, known })
            }
        }
    }

    fn compared(
        &self,
        formula: &Formula,
        left: &Formula,
        right: &Formula,
        sign: f64,
        strict: bool,
    ) -> Result<Evaluated, String> {
        let readings = self.runs.readings[0];
        let (value, limit) = (number(left, readings)?, number(right, readings)?);
        // Equal infinities: the margin is 0.
        let amount = if value == limit { 0.0 } else { sign * (limit - value) };
        let holds = if strict { amount > 0.0 } else { amount >= 0.0 };
        Ok(self.margin(holds, amount, (value, limit), formula))
    }

    fn margin(&self, holds: bool, amount: f64, (value, limit): (f64, f64), formula: &Formula) -> Evaluated {
        let mut indices = Vec::new();
        measures(formula, &mut indices);
        let used = || indices.iter().map(|&i| &self.runs.readings[0][i]);
        let unit = used().next().map_or_else(Unit::none, |reading| reading.unit.clone());
        let time = used().find_map(|reading| reading.time);
        let error = self.error(formula);
        // If a whole side is one measure, rounding is relative to the magnitude of its quantity; for arithmetic, to the
        // value.
        let scale = match formula {
            Formula::Less(a, b)
            | Formula::LessEqual(a, b)
            | Formula::Greater(a, b)
            | Formula::GreaterEqual(a, b)
            | Formula::Near { value: a, target: b, .. } => [a, b]
                .iter()
                .map(|side| if let Formula::Measure(k) = &***side { self.runs.readings[0][*k].scale } else { 0.0 })
                .fold(value.abs().max(limit.abs()), f64::max),
            _ => 0.0,
        };
        let rounding = if scale.is_finite() { ROUNDING * scale } else { 0.0 };
        let known = error.is_none_or(|error| error <= amount.abs().max(rounding));
        let margin = Margin { amount, value, limit, unit, time, error };
        Evaluated { value: f64::from(holds), margin: Some(margin), known }
    }

    /// The error of a comparison's difference, or of a number.
    fn error(&self, formula: &Formula) -> Option<f64> {
        let all: Vec<(f64, f64)> = self.runs.readings.iter().map(|readings| sides(formula, readings)).collect();
        let of = |part: fn(&(f64, f64)) -> f64| (self.runs.error)(&all.iter().map(part).collect::<Vec<f64>>());
        let error = of(|side| side.0)?.max(of(|side| side.1)?);
        // The error due to the spacing of points in each measure, propagated through the formula.
        let readings = self.runs.readings;
        let finest = readings[readings.len() - 1];
        let ((own, own_width), (fine, fine_width)) = (all[0], all[all.len() - 1]);
        let moved = distance(own, fine).max(distance(own_width, fine_width));
        let resolution = |readings| opened(formula, readings, |reading| reading.resolution);
        let coarse = resolution(readings[0]).min(resolution(finest) + moved);
        let unseen = opened(formula, finest, |reading| reading.unseen);
        let unseen = if unseen > 0.0 { unseen + moved } else { 0.0 };
        Some(error.max(coarse).max(unseen))
    }
}

/// The sum of the formula's changes when each reading in turn grows by `by`.
fn opened(formula: &Formula, readings: &[Reading], by: fn(&Reading) -> f64) -> f64 {
    let (mut moved, mut sum) = (readings.to_vec(), 0.0);
    for (k, reading) in readings.iter().enumerate().filter(|(_, reading)| by(reading) > 0.0) {
        moved[k].value = reading.value + by(reading);
        let (there, here) = (sides(formula, &moved), sides(formula, readings));
        sum += (there.0 - here.0).abs().max((there.1 - here.1).abs());
        moved[k].value = reading.value;
    }
    sum
}

/// For a comparison, the difference of its sides and the allowed width; for a number, the number and 0.
fn sides(formula: &Formula, readings: &[Reading]) -> (f64, f64) {
    let value = |formula: &Formula| number(formula, readings).unwrap_or(f64::NAN);
    let apart = |a: &Formula, b: &Formula| {
        let (a, b) = (value(a), value(b));
        (if a == b { 0.0 } else { a - b }, 0.0)
    };
    match formula {
        Formula::Less(a, b) | Formula::LessEqual(a, b) | Formula::Greater(a, b) | Formula::GreaterEqual(a, b) => {
            apart(a, b)
        }
        Formula::Near { value: measured, target, tolerance, relative } => {
            (apart(measured, target).0, width(value(tolerance), value(target), *relative))
        }
        _ => (value(formula), 0.0),
    }
}

fn width(tolerance: f64, target: f64, relative: bool) -> f64 {
    if relative { tolerance * target.abs() } else { tolerance }
}

fn distance(measured: f64, target: f64) -> f64 {
    if measured == target { 0.0 } else { (measured - target).abs() }
}

/// The value of a formula over these readings.
fn number(formula: &Formula, readings: &[Reading]) -> Result<f64, String> {
    let of = |formula: &Formula| number(formula, readings);
    let truth = |holds: bool| f64::from(holds);
    let value = match formula {
        Formula::Number(number) => *number,
        Formula::Measure(index) => readings[*index].value,
        Formula::Negate(a) => -of(a)?,
        Formula::Abs(a) => of(a)?.abs(),
        Formula::Sqrt(a) => of(a)?.sqrt(),
        Formula::Add(a, b) => of(a)? + of(b)?,
        Formula::Subtract(a, b) => of(a)? - of(b)?,
        Formula::Multiply(a, b) => of(a)? * of(b)?,
        Formula::Divide(a, b) => of(a)? / of(b)?,
        Formula::Min(a, b) => of(a)?.min(of(b)?),
        Formula::Max(a, b) => of(a)?.max(of(b)?),
        Formula::Less(a, b) => truth(of(a)? < of(b)?),
        Formula::LessEqual(a, b) => truth(of(a)? <= of(b)?),
        Formula::Greater(a, b) => truth(of(a)? > of(b)?),
        Formula::GreaterEqual(a, b) => truth(of(a)? >= of(b)?),
        Formula::And(a, b) => truth(of(a)? != 0.0 && of(b)? != 0.0),
        Formula::Or(a, b) => truth(of(a)? != 0.0 || of(b)? != 0.0),
        Formula::Not(a) => truth(of(a)? == 0.0),
        Formula::In(_, a) | Formula::Shown(_, a) => of(a)?,
        Formula::Function(function, args) => {
            let arg = |k: usize| args.get(k).map_or(Ok(0.0), of);
            (function.at)(arg(0)?, arg(1)?)
        }
        Formula::Near { value, target, tolerance, relative } => {
            let target = of(target)?;
            truth(distance(of(value)?, target) <= width(of(tolerance)?, target, *relative))
        }
    };
    match value.is_nan() {
        true => Err("the condition is not a number: a division of zero by zero, or a root of a negative".into()),
        false => Ok(value),
    }
}

/// The deciding one of two comparisons: an undecided one if the whole is undecided; otherwise the one with the smaller
/// (or larger) margin relative to its limit, because units may differ.
fn deciding(a: Evaluated, b: Evaluated, known: bool, better: fn(&f64, &f64) -> bool) -> Option<Margin> {
    let fraction = |margin: &Margin| match margin.limit.abs().max(margin.value.abs()) {
        scale if scale > 0.0 && scale.is_finite() => margin.amount / scale,
        _ => margin.amount,
    };
    match (a.margin, b.margin) {
        (Some(first), Some(_)) if !known && !a.known && b.known => Some(first),
        (Some(_), Some(second)) if !known && a.known && !b.known => Some(second),
        (Some(a), Some(b)) => Some(if better(&fraction(&b), &fraction(&a)) { b } else { a }),
        (a, b) => a.or(b),
    }
}

/// The measures of a formula, in the order of the text.
fn measures(formula: &Formula, into: &mut Vec<usize>) {
    match formula {
        Formula::Number(_) => {}
        Formula::Measure(index) => into.push(*index),
        Formula::Function(_, args) => args.iter().for_each(|arg| measures(arg, into)),
        Formula::Negate(a)
        | Formula::Abs(a)
        | Formula::Sqrt(a)
        | Formula::Not(a)
        | Formula::In(_, a)
        | Formula::Shown(_, a) => measures(a, into),
        Formula::Add(a, b)
        | Formula::Subtract(a, b)
        | Formula::Multiply(a, b)
        | Formula::Divide(a, b)
        | Formula::Min(a, b)
        | Formula::Max(a, b)
        | Formula::Less(a, b)
        | Formula::LessEqual(a, b)
        | Formula::Greater(a, b)
        | Formula::GreaterEqual(a, b)
        | Formula::And(a, b)
        | Formula::Or(a, b) => {
            measures(a, into);
            measures(b, into);
        }
        Formula::Near { value, target, tolerance, relative: _ } => {
            measures(value, into);
            measures(target, into);
            measures(tolerance, into);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expect(condition: Formula) -> Expect {
        Expect { text: "e".into(), measures: Vec::new(), condition, after: 0.0, before: f64::INFINITY }
    }

    fn readings(max: f64, min: f64) -> Vec<Reading> {
        let reading = |text: &str, value, time| {
            let (text, unit) = (text.into(), Unit::parse("m").unwrap());
            Reading { text, value, unit, time: Some(time), resolution: 0.0, unseen: 0.0, scale: 2.0, error: None }
        };
        vec![reading("max(x)", max, 1.0), reading("min(x)", min, 3.0)]
    }

    /// The verdict on `condition` when max(x) is 2 m at 1 s and min(x) is −2 m at 3 s.
    fn alone(condition: Formula) -> Verdict {
        verdict(&expect(condition), readings(2.0, -2.0))
    }

    fn max() -> Box<Formula> {
        Box::new(Formula::Measure(0))
    }
    fn min() -> Box<Formula> {
        Box::new(Formula::Measure(1))
    }
    fn number(value: f64) -> Box<Formula> {
        Box::new(Formula::Number(value))
    }

    #[test]
    fn a_margin_names_distance_and_instant() {
        let verdict = alone(Formula::Less(max(), number(1.5)));
        let margin = verdict.margin.unwrap();
        assert!(!verdict.holds);
        assert_eq!((margin.amount, margin.value, margin.limit, margin.time), (-0.5, 2.0, 1.5, Some(1.0)));
        assert_eq!(margin.unit.text, "m");
        assert_eq!(verdict.readings.len(), 2);
        assert!(alone(Formula::LessEqual(max(), number(2.0))).holds);
        assert!(!alone(Formula::Less(max(), number(2.0))).holds);
        assert!(alone(Formula::Greater(number(3.0), max())).holds);
    }

    #[test]
    fn near_takes_an_absolute_or_a_relative_tolerance() {
        let near = |target, tolerance, relative| {
            let (value, target, tolerance) = (min(), number(target), number(tolerance));
            alone(Formula::Near { value, target, tolerance, relative })
        };
        assert!(near(-2.5, 0.5, false).holds);
        assert!(!near(-2.5, 0.4, false).holds);
        assert!(near(-2.5, 0.2, true).holds);
        assert!(!near(-2.5, 0.19, true).holds);
        assert_eq!(near(-2.5, 0.5, false).margin.unwrap().time, Some(3.0));
    }

    #[test]
    fn the_margin_is_that_of_the_deciding_comparison() {
        let loose = || Box::new(Formula::Less(max(), number(10.0)));
        let tight = || Box::new(Formula::Greater(min(), number(-2.1)));
        let both = alone(Formula::And(loose(), tight()));
        assert!(both.holds && (both.margin.unwrap().amount - 0.1).abs() < 1e-15);
        let either = alone(Formula::Or(loose(), tight()));
        assert!(either.holds && either.margin.unwrap().amount == 8.0);
        let neither = alone(Formula::Not(loose()));
        assert!(!neither.holds && neither.margin.unwrap().amount == -8.0);
    }

    #[test]
    fn nan_fails_every_comparison() {
        let zero = || Box::new(Formula::Add(max(), min()));
        let verdict = alone(Formula::Not(Box::new(Formula::Less(Box::new(Formula::Divide(zero(), zero())), max()))));
        assert!(!verdict.holds && verdict.problem.unwrap().contains("not a number"));
    }

    /// The same with two finer runs; the error is the range that the three values span.
    fn with_error(condition: Formula, finer: [(f64, f64); 2]) -> Verdict {
        let all = [readings(2.0, -2.0), readings(finer[0].0, finer[0].1), readings(finer[1].0, finer[1].1)];
        let slices: Vec<&[Reading]> = all.iter().map(Vec::as_slice).collect();
        let span = |values: &[f64]| {
            let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            Some(most - values.iter().copied().fold(f64::INFINITY, f64::min))
        };
        judged(&expect(condition), &Runs { readings: &slices, error: &span })
    }

    #[test]
    fn an_error_larger_than_the_margin_makes_the_verdict_undecided() {
        let below = |limit: f64| Formula::Less(max(), number(limit));
        let finer = [(2.01, -2.0), (2.012, -2.0)];
        let clear = with_error(below(2.5), finer);
        assert!(clear.passed() && (clear.readings[0].error.unwrap() - 0.012).abs() < 1e-12);
        assert!((clear.margin.unwrap().error.unwrap() - 0.012).abs() < 1e-12);
        let open = with_error(below(2.005), finer);
        assert!(open.holds && !open.decided && !open.passed());
        // One decided side can decide the whole.
        let both = |a: f64, b: f64| Formula::And(Box::new(below(a)), Box::new(below(b)));
        assert!(with_error(both(2.005, 1.0), finer).decided);
        let doubtful = with_error(both(2.005, 2.1), finer);
        assert!(!doubtful.decided && doubtful.margin.unwrap().limit == 2.005);
        let either = |a: f64, b: f64| Formula::Or(Box::new(below(a)), Box::new(below(b)));
        assert!(with_error(either(2.005, 2.1), finer).decided && !with_error(either(2.005, 1.0), finer).decided);
        // Errors common to both measures cancel in their difference.
        let shifted = [(2.01, -1.99), (2.011, -1.989)];
        let width = Formula::Subtract(max(), min());
        let near =
            Formula::Near { value: Box::new(width), target: number(4.0), tolerance: number(1e-9), relative: false };
        assert!(with_error(near, shifted).passed());
    }

    #[test]
    fn a_truth_value_on_which_finer_runs_disagree_is_undecided() {
        let same = [(1.0, -2.0), (1.0, -2.0)];
        assert!(with_error(*max(), same).decided && !with_error(*max(), [(1.0, 0.0), (0.0, 0.0)]).decided);
    }

    #[test]
    fn agreement_on_an_extreme_does_not_decide_what_happens_between_points() {
        let [mut own, mut fine] = [readings(2.0, -2.0), readings(2.01, -2.0)];
        (own[0].unseen, fine[0].unseen) = (0.5, 0.02);
        let condition = Formula::Less(Box::new(Formula::Multiply(number(3.0), max())), number(6.08));
        let judged = judged(&expect(condition), &Runs { readings: &[&own, &fine], error: &|_| Some(0.0) });
        assert!(judged.holds && !judged.decided);
        assert!((judged.readings[0].error.unwrap() - 0.03).abs() < 1e-12 && judged.readings[1].error == Some(0.0));
        assert!((judged.margin.unwrap().error.unwrap() - 0.09).abs() < 1e-12);
    }

    #[test]
    fn a_quantity_of_rounding_errors_has_an_error_of_its_own_size() {
        let mut noise = readings(4e-16, 0.0);
        noise.iter_mut().for_each(|reading| reading.scale = 4e-16);
        let below = |limit: f64| Formula::Less(max(), number(limit));
        let judged = judged(&expect(below(1e-12)), &Runs { readings: &[&noise, &noise], error: &|_| Some(0.0) });
        assert!(judged.passed() && judged.readings[0].error == Some(4e-16) && judged.readings[1].error == Some(0.0));
    }

    #[test]
    fn the_spacing_of_points_limits_the_accuracy() {
        let mut coarse = readings(2.0, -2.0);
        coarse[0].resolution = 0.1;
        let condition = Formula::Less(Box::new(Formula::Multiply(number(3.0), max())), number(6.2));
        let judged = judged(&expect(condition), &Runs { readings: &[&coarse, &coarse], error: &|_| Some(0.0) });
        assert!(judged.holds && !judged.decided);
        assert!((judged.margin.unwrap().error.unwrap() - 0.3).abs() < 1e-12);
        assert_eq!(judged.readings[0].error, Some(0.1));
    }
}
