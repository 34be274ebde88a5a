//! Numbers taken from the course of a run, and the expectations that are made of them.
//!
//! In: the points of a run in order of time, as blocks. Out: a [`Verdict`] for each expectation. Most measures look
//! at each point once and forget it; `period` and `settling` keep theirs, up to [`KEPT_POINTS`]. Knows neither
//! solver nor clock: between two points a quantity is a straight line, and an event is two points at one time.

use crate::show;
use abi::Slot;
use abi::plan::{Expect, Formula, Measure, MeasureKind};
use abi::unit::Unit;

/// Most points that one `period` or `settling` keeps: 2²⁵, half a gigabyte. Beyond, the measure fails and says so.
pub const KEPT_POINTS: usize = 1 << 25;

/// What became of one expectation.
#[derive(Clone, PartialEq, Debug)]
pub struct Verdict {
    /// As written.
    pub text: String,
    /// Whether it held. Never where there is a `problem`.
    pub holds: bool,
    /// The measures that could be taken, in the order of the text.
    pub readings: Vec<Reading>,
    /// The comparison that decided; none where the condition compares nothing or could not be evaluated.
    pub margin: Option<Margin>,
    /// Why it could not be evaluated, in words: `the window … is empty`.
    pub problem: Option<String>,
}

/// The value of one measure.
#[derive(Clone, PartialEq, Debug)]
pub struct Reading {
    /// As written.
    pub text: String,
    /// In SI.
    pub value: f64,
    /// The unit it is shown in.
    pub unit: Unit,
    /// When it happened, in s, where it happened at an instant: of `max`, when the maximum was reached.
    pub time: Option<f64>,
}

/// How far a comparison was from turning over.
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
    /// The instant that matters, in s, if one of the measures compared has one.
    pub time: Option<f64>,
}

/// All expectations of an experiment, filled point by point.
pub struct Expectations {
    expects: Vec<Expect>,
    meters: Vec<Vec<Meter>>,
}

impl Expectations {
    /// Nothing seen yet.
    pub fn new(expects: &[Expect]) -> Expectations {
        let meters = expects.iter().map(|expect| {
            expect.measures.iter().map(|measure| Meter::new(measure, expect.after, expect.before)).collect()
        });
        Expectations { expects: expects.to_vec(), meters: meters.collect() }
    }

    /// Whether only the last point of the run counts, so that the others need not be shown.
    pub fn only_last(&self) -> bool {
        let last = |meter: &Meter| matches!(meter.tally, Tally::Final) && meter.before == f64::INFINITY;
        self.meters.iter().flatten().all(last)
    }

    /// The slots that are read.
    pub fn slots(&self) -> impl Iterator<Item = Slot> {
        self.meters.iter().flatten().map(|meter| meter.slot)
    }

    /// Shows the state of the model at time `t` in s. Times must not decrease.
    pub fn see(&mut self, t: f64, block: &[f64]) {
        for meter in self.meters.iter_mut().flatten() {
            meter.see(t, block[meter.slot.index()]);
        }
    }

    /// The verdicts, in the order of the experiment.
    pub fn verdicts(&self) -> Vec<Verdict> {
        self.expects.iter().zip(&self.meters).map(|(expect, meters)| verdict(expect, meters)).collect()
    }
}

fn verdict(expect: &Expect, meters: &[Meter]) -> Verdict {
    let mut readings = Vec::new();
    let mut problem = None;
    for (measure, meter) in expect.measures.iter().zip(meters) {
        match meter.reading() {
            Ok((value, time)) => {
                let unit = measure.unit.clone();
                readings.push(Reading { text: measure.text.clone(), value, unit, time });
            }
            Err(reason) => {
                problem.get_or_insert(format!("{}: {reason}", measure.text));
            }
        }
    }
    let failed = |readings, problem| Verdict {
        text: expect.text.clone(),
        holds: false,
        readings,
        margin: None,
        problem: Some(problem),
    };
    if let Some(problem) = problem {
        return failed(readings, problem);
    }
    match evaluate(&expect.condition, &readings) {
        Ok(Evaluated { value, margin }) => {
            Verdict { text: expect.text.clone(), holds: value != 0.0, readings, margin, problem: None }
        }
        Err(problem) => failed(readings, problem),
    }
}

struct Evaluated {
    value: f64,
    margin: Option<Margin>,
}

/// A formula over readings; a result that is not a number (0/0) is an error, since no comparison with it means anything.
fn evaluate(formula: &Formula, readings: &[Reading]) -> Result<Evaluated, String> {
    let plain = |value: f64| {
        if value.is_nan() {
            return Err("the condition is not a number: a division of zero by zero, or a root of a negative".into());
        }
        Ok(Evaluated { value, margin: None })
    };
    let value = |formula: &Formula| evaluate(formula, readings).map(|e| e.value);
    let compare = |left: &Formula, right: &Formula, sign: f64, strict: bool| {
        let (value, limit) = (value(left)?, value(right)?);
        // Equal infinities leave no room.
        let amount = if value == limit { 0.0 } else { sign * (limit - value) };
        let holds = if strict { amount > 0.0 } else { amount >= 0.0 };
        Ok(compared(holds, amount, value, limit, formula, readings))
    };
    match formula {
        Formula::Number(number) => plain(*number),
        Formula::Measure(index) => plain(readings[*index].value),
        Formula::Negate(a) => plain(-value(a)?),
        Formula::Abs(a) => plain(value(a)?.abs()),
        Formula::Sqrt(a) => plain(value(a)?.sqrt()),
        Formula::Add(a, b) => plain(value(a)? + value(b)?),
        Formula::Subtract(a, b) => plain(value(a)? - value(b)?),
        Formula::Multiply(a, b) => plain(value(a)? * value(b)?),
        Formula::Divide(a, b) => plain(value(a)? / value(b)?),
        Formula::Min(a, b) => plain(value(a)?.min(value(b)?)),
        Formula::Max(a, b) => plain(value(a)?.max(value(b)?)),
        Formula::Less(a, b) => compare(a, b, 1.0, true),
        Formula::LessEqual(a, b) => compare(a, b, 1.0, false),
        Formula::Greater(a, b) => compare(a, b, -1.0, true),
        Formula::GreaterEqual(a, b) => compare(a, b, -1.0, false),
        Formula::Near { value: measured, target, tolerance, relative } => {
            let (measured, target, tolerance) = (value(measured)?, value(target)?, value(tolerance)?);
            let width = if *relative { tolerance * target.abs() } else { tolerance };
            let distance = if measured == target { 0.0 } else { (measured - target).abs() };
            let amount = width - distance;
            Ok(compared(amount >= 0.0, amount, measured, target, formula, readings))
        }
        Formula::And(a, b) => {
            let (a, b) = (evaluate(a, readings)?, evaluate(b, readings)?);
            let value = f64::from(a.value != 0.0 && b.value != 0.0);
            Ok(Evaluated { value, margin: deciding(a, b, f64::lt) })
        }
        Formula::Or(a, b) => {
            let (a, b) = (evaluate(a, readings)?, evaluate(b, readings)?);
            let value = f64::from(a.value != 0.0 || b.value != 0.0);
            Ok(Evaluated { value, margin: deciding(a, b, f64::gt) })
        }
        Formula::Not(a) => {
            let a = evaluate(a, readings)?;
            let turned = a.margin.map(|margin| Margin { amount: -margin.amount, ..margin });
            Ok(Evaluated { value: f64::from(a.value == 0.0), margin: turned })
        }
    }
}

/// Of two comparisons, the one whose margin as a fraction of its limit is the smaller (or larger): units differ.
fn deciding(a: Evaluated, b: Evaluated, better: fn(&f64, &f64) -> bool) -> Option<Margin> {
    let fraction = |margin: &Margin| match margin.limit.abs().max(margin.value.abs()) {
        scale if scale > 0.0 && scale.is_finite() => margin.amount / scale,
        _ => margin.amount,
    };
    match (a.margin, b.margin) {
        (Some(a), Some(b)) => Some(if better(&fraction(&b), &fraction(&a)) { b } else { a }),
        (a, b) => a.or(b),
    }
}

fn compared(holds: bool, amount: f64, value: f64, limit: f64, formula: &Formula, readings: &[Reading]) -> Evaluated {
    let mut indices = Vec::new();
    measures(formula, &mut indices);
    let used = || indices.iter().map(|&i| &readings[i]);
    let unit = used().next().map_or_else(Unit::none, |reading| reading.unit.clone());
    let time = used().find_map(|reading| reading.time);
    Evaluated { value: f64::from(holds), margin: Some(Margin { amount, value, limit, unit, time }) }
}

/// The measures of a formula, in the order of the text.
fn measures(formula: &Formula, into: &mut Vec<usize>) {
    match formula {
        Formula::Number(_) => {}
        Formula::Measure(index) => into.push(*index),
        Formula::Negate(a) | Formula::Abs(a) | Formula::Sqrt(a) | Formula::Not(a) => measures(a, into),
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

/// A point of a run: time in s, value in SI.
type Point = (f64, f64);

/// One measure at work: cuts its window exactly and tallies what lies inside.
struct Meter {
    slot: Slot,
    after: f64,
    before: f64,
    /// The last point seen, inside the window or not; in the beginning none, at an infinite time.
    last: Point,
    /// First and last point counted, inside the window; valid once there is one.
    first: Point,
    end: Point,
    counted: bool,
    tally: Tally,
}

enum Tally {
    Extremes { min: Point, max: Point, kind: Extreme },
    Sum { square: bool, kind: Average, sum: Sum },
    Final,
    At { instant: f64, value: Option<f64> },
    Crossings { sign: f64, count: u64, time: Option<f64> },
    First { time: f64 },
    Period { kept: Kept },
    Settling { band: f64, kept: Kept },
}

enum Extreme {
    Min,
    Max,
    Between,
}

enum Average {
    Mean,
    Root,
    Integral,
}

impl Meter {
    fn new(measure: &Measure, after: f64, before: f64) -> Meter {
        let extremes = |kind| Tally::Extremes { min: (0.0, f64::INFINITY), max: (0.0, f64::NEG_INFINITY), kind };
        let sum = |kind, square| Tally::Sum { square, kind, sum: Sum::default() };
        let tally = match measure.kind {
            MeasureKind::Min => extremes(Extreme::Min),
            MeasureKind::Max => extremes(Extreme::Max),
            MeasureKind::PeakToPeak => extremes(Extreme::Between),
            MeasureKind::Mean => sum(Average::Mean, false),
            MeasureKind::Rms => sum(Average::Root, true),
            MeasureKind::Integral => sum(Average::Integral, false),
            MeasureKind::Final => Tally::Final,
            MeasureKind::At(instant) => Tally::At { instant, value: None },
            MeasureKind::Crossings => Tally::Crossings { sign: 0.0, count: 0, time: None },
            MeasureKind::First => Tally::First { time: f64::INFINITY },
            MeasureKind::Period => Tally::Period { kept: Kept::default() },
            MeasureKind::Settling(band) => Tally::Settling { band, kept: Kept::default() },
        };
        let none = (f64::INFINITY, 0.0);
        Meter { slot: measure.slot, after, before, last: none, first: none, end: none, counted: false, tally }
    }

    /// One more point; at the edges of the window, the point on the line to the one before.
    fn see(&mut self, t: f64, v: f64) {
        let last = self.last;
        if last.0 < self.after && t > self.after && self.after <= self.before {
            self.count(self.after, self.between(last, (t, v), self.after));
        }
        if last.0 < self.before && t > self.before && self.after <= self.before {
            self.count(self.before, self.between(last, (t, v), self.before));
        }
        if self.after <= t && t <= self.before {
            self.count(t, v);
        }
        self.last = (t, v);
    }

    /// The value at an edge between two points. A condition keeps its value until the next point.
    fn between(&self, from: Point, to: Point, t: f64) -> f64 {
        if matches!(self.tally, Tally::First { .. }) { from.1 } else { line(from, to, t) }
    }

    fn count(&mut self, t: f64, v: f64) {
        let previous = self.end;
        if !self.counted {
            self.first = (t, v);
        }
        match &mut self.tally {
            Tally::Extremes { min, max, .. } => {
                if v < min.1 {
                    *min = (t, v);
                }
                if v > max.1 {
                    *max = (t, v);
                }
            }
            Tally::Sum { square, sum, .. } => {
                if self.counted {
                    let (t0, v0) = previous;
                    let (a, b) = if *square { (v0 * v0, v * v) } else { (v0, v) };
                    sum.add(0.5 * (a + b) * (t - t0));
                }
            }
            Tally::Final => {}
            Tally::At { instant, value } => {
                if t == *instant {
                    *value = Some(v);
                } else if previous.0 < *instant && *instant < t {
                    *value = Some(line(previous, (t, v), *instant));
                }
            }
            Tally::Crossings { sign, count, time } => {
                if v != 0.0 && v.signum() != *sign {
                    if *sign != 0.0 {
                        *count += 1;
                        *time = Some(t);
                    }
                    *sign = v.signum();
                }
            }
            Tally::First { time } => {
                if v != 0.0 && *time == f64::INFINITY {
                    *time = t;
                }
            }
            Tally::Period { kept } | Tally::Settling { kept, .. } => kept.push((t, v)),
        }
        self.end = (t, v);
        self.counted = true;
    }

    /// Value in SI, and the time in s where it happened; or the reason why there is none.
    fn reading(&self) -> Result<(f64, Option<f64>), String> {
        if !self.counted {
            let end = match self.last.0 {
                f64::INFINITY => "the run has no point".into(),
                end => format!("the run ends at {}", show::time(end)),
            };
            let (after, before) = (show::time(self.after), show::time(self.before));
            return Err(format!("the window from {after} to {before} is empty; {end}"));
        }
        let (first, last) = (self.first, self.end);
        let width = last.0 - first.0;
        match &self.tally {
            Tally::Extremes { min, max, kind } => Ok(match kind {
                Extreme::Min => (min.1, Some(min.0)),
                Extreme::Max => (max.1, Some(max.0)),
                Extreme::Between => (max.1 - min.1, Some(min.0.max(max.0))),
            }),
            Tally::Sum { kind, sum, .. } => {
                let total = sum.total();
                let value = match kind {
                    Average::Integral => total,
                    // A window of one instant: the limit of ever narrower ones.
                    Average::Mean if width == 0.0 => last.1,
                    Average::Root if width == 0.0 => last.1.abs(),
                    Average::Mean => total / width,
                    Average::Root => (total / width).sqrt(),
                };
                Ok((value, None))
            }
            Tally::Final => Ok((last.1, Some(last.0))),
            Tally::At { instant, value } => {
                // The last step may end a rounding error before the instant asked for.
                let near_end = *instant > last.0 && *instant - last.0 <= 1e-9 * last.0.abs();
                let value = value.or(near_end.then_some(last.1)).ok_or_else(|| {
                    format!(
                        "{} lies outside the window from {} to {}",
                        show::time(*instant),
                        show::time(first.0),
                        show::time(last.0)
                    )
                })?;
                Ok((value, Some(*instant)))
            }
            Tally::Crossings { count, time, .. } => Ok((*count as f64, *time)),
            Tally::First { time } => Ok((*time, time.is_finite().then_some(*time))),
            Tally::Period { kept } => Ok((period(kept.whole()?)?, None)),
            Tally::Settling { band, kept } => {
                let time = settling(kept.whole()?, last.1, *band).unwrap_or(first.0);
                Ok((time, Some(time)))
            }
        }
    }
}

/// The value at `t` on the line through two points at different times.
fn line(from: Point, to: Point, t: f64) -> f64 {
    let part = (t - from.0) / (to.0 - from.0);
    from.1 + part * (to.1 - from.1)
}

/// Mean distance of upward crossings through the mean over time.
fn period(points: &[Point]) -> Result<f64, String> {
    let mut area = Sum::default();
    for pair in points.windows(2) {
        area.add(0.5 * (pair[0].1 + pair[1].1) * (pair[1].0 - pair[0].0));
    }
    let width = points[points.len() - 1].0 - points[0].0;
    let mean = if width > 0.0 { area.total() / width } else { points[0].1 };
    // Upward means from below to at or above; a value that only touches the mean from above does not cross.
    let upward = (1..points.len()).filter(|&i| points[i - 1].1 < mean && mean <= points[i].1);
    let mut crossings = upward.map(|i| crossing(&points[i.saturating_sub(2)..points.len().min(i + 2)], mean));
    let (mut first, mut last, mut count) = (0.0, 0.0, 0);
    for time in &mut crossings {
        if count == 0 {
            first = time;
        }
        last = time;
        count += 1;
    }
    if count < 3 {
        return Err(format!("three upward crossings through the mean are needed, there are {count}"));
    }
    Ok((last - first) / f64::from(count - 1))
}

/// When the cubic through four points passes `level` between the middle two; a line where there are not four, or two
/// of them lie at one time. A line alone would be as coarse as the points.
fn crossing(points: &[Point], level: f64) -> f64 {
    let middle = points.windows(2).position(|pair| pair[0].1 < level && level <= pair[1].1).expect("one pair crosses");
    let (from, to) = (points[middle], points[middle + 1]);
    let part = (level - from.1) / (to.1 - from.1);
    let straight = from.0 + part * (to.0 - from.0);
    let &[p0, p1, p2, p3] = points else { return straight };
    if !points.is_sorted_by(|a, b| a.0 < b.0) || middle != 1 {
        return straight;
    }
    let over = |a: Point, b: Point, high: f64, low: f64| (high - low) / (b.0 - a.0);
    let (d01, d12, d23) = (over(p0, p1, p1.1, p0.1), over(p1, p2, p2.1, p1.1), over(p2, p3, p3.1, p2.1));
    let (d02, d13) = (over(p0, p2, d12, d01), over(p1, p3, d23, d12));
    let d03 = over(p0, p3, d13, d02);
    let height = |t: f64| p0.1 - level + (t - p0.0) * (d01 + (t - p1.0) * (d02 + (t - p2.0) * d03));
    let (mut low, mut high, mut t) = (p1.0, p2.0, straight);
    for _ in 0..60 {
        let value = height(t);
        if value == 0.0 {
            break;
        }
        if value < 0.0 {
            low = t
        } else {
            high = t
        }
        let slope =
            d01 + (t - p1.0) * d02 + (t - p0.0) * (d02 + (2.0 * t - p1.0 - p2.0) * d03) + (t - p1.0) * (t - p2.0) * d03;
        let newton = t - value / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if next == t || high - low <= 4.0 * f64::EPSILON * high.abs() {
            break;
        }
        t = next;
    }
    t
}

/// The last time the value leaves the band around `end`, or none if it never is outside.
fn settling(points: &[Point], end: f64, band: f64) -> Option<f64> {
    let outside = points.iter().rposition(|(_, v)| (v - end).abs() > band)?;
    let (from, to) = (points[outside], *points.get(outside + 1)?);
    if from.0 == to.0 {
        return Some(from.0);
    }
    let edge = end + band.copysign(from.1 - end);
    let part = (edge - from.1) / (to.1 - from.1);
    Some(from.0 + part * (to.0 - from.0))
}

/// Points kept whole, up to the limit.
#[derive(Default)]
struct Kept {
    points: Vec<Point>,
    overflowed: bool,
}

impl Kept {
    fn push(&mut self, point: Point) {
        if self.points.len() < KEPT_POINTS {
            self.points.push(point);
        } else {
            self.overflowed = true;
        }
    }

    fn whole(&self) -> Result<&[Point], String> {
        if self.overflowed {
            return Err(format!(
                "more than {KEPT_POINTS} points lie in the window; narrow it with `after` and `before`, or take a larger step"
            ));
        }
        Ok(&self.points)
    }
}

/// A compensated sum (Neumaier): ten million steps lose nothing that matters.
#[derive(Default, Clone, Copy)]
struct Sum {
    sum: f64,
    lost: f64,
}

impl Sum {
    fn add(&mut self, term: f64) {
        let sum = self.sum + term;
        self.lost += if self.sum.abs() >= term.abs() { (self.sum - sum) + term } else { (term - sum) + self.sum };
        self.sum = sum;
    }

    fn total(&self) -> f64 {
        self.sum + self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: (f64, f64) = (0.0, f64::INFINITY);

    fn measure(kind: MeasureKind) -> Measure {
        Measure { text: "m".into(), kind, slot: Slot(3), unit: Unit::parse("m").unwrap() }
    }

    /// One measure over these points, and its time.
    fn taken(kind: MeasureKind, (after, before): (f64, f64), points: &[Point]) -> Result<(f64, Option<f64>), String> {
        let mut meter = Meter::new(&measure(kind), after, before);
        points.iter().for_each(|(t, v)| meter.see(*t, *v));
        meter.reading()
    }

    fn value(kind: MeasureKind, window: (f64, f64), points: &[Point]) -> f64 {
        taken(kind, window, points).unwrap().0
    }

    /// sin(2πt/T) at many points.
    fn sine(period: f64, duration: f64, step: f64) -> Vec<Point> {
        let steps = (duration / step).round() as usize;
        let point = |n: usize| {
            let t = n as f64 * step;
            (t, (std::f64::consts::TAU * t / period).sin())
        };
        (0..=steps).map(point).collect()
    }

    #[test]
    fn measures_of_a_triangle() {
        let points = [(0.0, 0.0), (1.0, 2.0), (3.0, -2.0), (4.0, 0.0)];
        assert_eq!(taken(MeasureKind::Max, WHOLE, &points), Ok((2.0, Some(1.0))));
        assert_eq!(taken(MeasureKind::Min, WHOLE, &points), Ok((-2.0, Some(3.0))));
        assert_eq!(value(MeasureKind::PeakToPeak, WHOLE, &points), 4.0);
        assert_eq!(value(MeasureKind::Mean, WHOLE, &points), 0.0);
        assert_eq!(value(MeasureKind::Integral, (0.0, 1.0), &points), 1.0);
        assert_eq!(value(MeasureKind::Rms, WHOLE, &points), 3f64.sqrt());
        assert_eq!(value(MeasureKind::Final, WHOLE, &points), 0.0);
        assert_eq!(taken(MeasureKind::At(2.0), WHOLE, &points), Ok((0.0, Some(2.0))));
        assert_eq!(value(MeasureKind::Crossings, WHOLE, &points), 1.0);
        assert_eq!(value(MeasureKind::Settling(1.0), WHOLE, &points), 3.5);
    }

    #[test]
    fn windows_are_cut_on_the_line_between_points() {
        let points = [(0.0, 0.0), (2.0, 4.0), (3.0, 4.0)];
        assert_eq!(taken(MeasureKind::Min, (0.5, 1.5), &points), Ok((1.0, Some(0.5))));
        assert_eq!(taken(MeasureKind::Max, (0.5, 1.5), &points), Ok((3.0, Some(1.5))));
        assert_eq!(value(MeasureKind::Mean, (0.5, 1.5), &points), 2.0);
        assert_eq!(value(MeasureKind::Final, (0.5, 1.5), &points), 3.0);
        assert_eq!(value(MeasureKind::Integral, (1.0, 3.0), &points), 7.0);
        assert_eq!(value(MeasureKind::Mean, (1.0, 1.0), &points), 2.0);
    }

    #[test]
    fn an_event_is_two_points_at_one_time() {
        let points = [(0.0, 1.0), (1.0, 1.0), (1.0, -3.0), (2.0, -3.0)];
        assert_eq!(value(MeasureKind::Integral, WHOLE, &points), -2.0);
        assert_eq!(value(MeasureKind::PeakToPeak, (1.0, 1.0), &points), 4.0);
        assert_eq!(value(MeasureKind::At(1.0), WHOLE, &points), -3.0);
        assert_eq!(taken(MeasureKind::Crossings, WHOLE, &points), Ok((1.0, Some(1.0))));
        assert_eq!(value(MeasureKind::Settling(0.5), WHOLE, &points), 1.0);
    }

    #[test]
    fn a_touch_of_zero_is_no_crossing() {
        let points = [(0.0, 1.0), (1.0, 0.0), (2.0, 1.0), (3.0, 0.0), (4.0, -1.0)];
        assert_eq!(value(MeasureKind::Crossings, WHOLE, &points), 1.0);
    }

    #[test]
    fn a_condition_holds_from_its_first_point_on() {
        let points = [(0.0, 0.0), (1.0, 0.0), (2.0, 1.0), (3.0, 1.0)];
        assert_eq!(taken(MeasureKind::First, WHOLE, &points), Ok((2.0, Some(2.0))));
        // Between two points a condition is what it was: 1.5 is not yet true.
        assert_eq!(value(MeasureKind::First, (1.5, 3.0), &points), 2.0);
        assert_eq!(value(MeasureKind::First, (2.5, 3.0), &points), 2.5);
        assert_eq!(taken(MeasureKind::First, (0.0, 1.0), &points), Ok((f64::INFINITY, None)));
    }

    #[test]
    fn averages_of_a_sine() {
        let points = sine(1.0, 3.0, 1e-4);
        assert!((value(MeasureKind::Rms, WHOLE, &points) - 0.5f64.sqrt()).abs() < 1e-12);
        assert!(value(MeasureKind::Mean, WHOLE, &points).abs() < 1e-12);
        assert_eq!(value(MeasureKind::Crossings, (0.1, 2.9), &points), 5.0);
    }

    #[test]
    fn the_period_is_the_mean_distance_of_upward_crossings() {
        let points = sine(0.37, 3.0, 1e-3);
        assert!((value(MeasureKind::Period, (0.1, 3.0), &points) - 0.37).abs() < 1e-9);
        let rough = sine(0.37, 3.0, 0.02);
        assert!((value(MeasureKind::Period, WHOLE, &rough) - 0.37).abs() < 1e-4);
        // Jumps have no cubic.
        let square: Vec<Point> = (0..20)
            .flat_map(|n| [(n as f64, 0.0), (n as f64, 1.0), (n as f64 + 0.5, 1.0), (n as f64 + 0.5, 0.0)])
            .collect();
        assert!((value(MeasureKind::Period, WHOLE, &square) - 1.0).abs() < 1e-12);
        let short = taken(MeasureKind::Period, (0.0, 0.7), &points).unwrap_err();
        assert_eq!(short, "three upward crossings through the mean are needed, there are 2");
    }

    #[test]
    fn settling_of_a_decay() {
        let points: Vec<Point> = (0..=20_000).map(|n| (n as f64 * 1e-3, (-(n as f64) * 1e-3).exp())).collect();
        let settled = value(MeasureKind::Settling(0.05), WHOLE, &points);
        assert!((settled - 20f64.ln()).abs() < 1e-6, "{settled}");
        assert_eq!(value(MeasureKind::Settling(2.0), (1.0, 3.0), &points), 1.0);
    }

    #[test]
    fn an_empty_window_is_an_error() {
        let points = [(0.0, 0.0), (3.0, 1.0)];
        let reason = taken(MeasureKind::Max, (5.0, 6.0), &points).unwrap_err();
        assert_eq!(reason, "the window from 5 s to 6 s is empty; the run ends at 3 s");
        assert!(taken(MeasureKind::Mean, (2.0, 1.0), &points).is_err());
        let outside = taken(MeasureKind::At(4.0), WHOLE, &points).unwrap_err();
        assert_eq!(outside, "4 s lies outside the window from 0 s to 3 s");
    }

    #[test]
    fn ten_million_points_lose_nothing() {
        let mut sum = Sum::default();
        (0..10_000_000).for_each(|_| sum.add(0.1));
        assert_eq!(sum.total(), 1_000_000.0);
    }

    /// The verdict on `condition` when max(x) is 2 m at 1 s and min(x) is −2 m at 3 s.
    fn judged(condition: Formula) -> Verdict {
        let measures = vec![measure(MeasureKind::Max), measure(MeasureKind::Min)];
        let expect = Expect { text: "e".into(), measures, condition, after: 0.0, before: f64::INFINITY };
        let mut expectations = Expectations::new(&[expect]);
        for (t, v) in [(0.0, 0.0), (1.0, 2.0), (3.0, -2.0)] {
            expectations.see(t, &[t, 0.0, 0.0, v]);
        }
        expectations.verdicts().remove(0)
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
        let verdict = judged(Formula::Less(max(), number(1.5)));
        let margin = verdict.margin.unwrap();
        assert!(!verdict.holds);
        assert_eq!((margin.amount, margin.value, margin.limit, margin.time), (-0.5, 2.0, 1.5, Some(1.0)));
        assert_eq!(margin.unit.text, "m");
        assert_eq!(verdict.readings.len(), 2);
        assert!(judged(Formula::LessEqual(max(), number(2.0))).holds);
        assert!(!judged(Formula::Less(max(), number(2.0))).holds);
        assert!(judged(Formula::Greater(number(3.0), max())).holds);
    }

    #[test]
    fn near_takes_an_absolute_or_a_relative_tolerance() {
        let near = |target, tolerance, relative| {
            let (value, target, tolerance) = (min(), number(target), number(tolerance));
            judged(Formula::Near { value, target, tolerance, relative })
        };
        assert!(near(-2.5, 0.5, false).holds);
        assert!(!near(-2.5, 0.4, false).holds);
        assert!(near(-2.5, 0.2, true).holds);
        assert!(!near(-2.5, 0.19, true).holds);
        assert_eq!(near(-2.5, 0.5, false).margin.unwrap().time, Some(3.0));
    }

    #[test]
    fn the_comparison_that_decides_gives_the_margin() {
        let loose = || Box::new(Formula::Less(max(), number(10.0)));
        let tight = || Box::new(Formula::Greater(min(), number(-2.1)));
        let both = judged(Formula::And(loose(), tight()));
        assert!(both.holds && (both.margin.unwrap().amount - 0.1).abs() < 1e-15);
        let either = judged(Formula::Or(loose(), tight()));
        assert!(either.holds && either.margin.unwrap().amount == 8.0);
        let neither = judged(Formula::Not(loose()));
        assert!(!neither.holds && neither.margin.unwrap().amount == -8.0);
    }

    #[test]
    fn what_is_not_a_number_holds_nothing() {
        let zero = || Box::new(Formula::Add(max(), min()));
        let verdict = judged(Formula::Not(Box::new(Formula::Less(Box::new(Formula::Divide(zero(), zero())), max()))));
        assert!(!verdict.holds && verdict.problem.unwrap().contains("not a number"));
    }
}
