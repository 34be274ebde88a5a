//! Measures: numbers computed from the points of a run.
//!
//! In: the points of a run in order of time, as blocks. Out: a [`Verdict`] for each expectation. Most measures are
//! streaming; `period` and `settling` keep their points, up to [`KEPT_POINTS`]. Knows neither solver nor clock. An
//! event is two points at one time; at the edge of a window the value is interpolated linearly between two points. An
//! adaptive run adds a point at each edge and integrates its own dense output. For other runs, integrals use the
//! trapezoidal rule with Gregory's end corrections, of order four where the steps are even.

use crate::run::crossing::{Lobes, period, settling};
use crate::run::hills::{Hills, Turn};
use crate::run::peak::{Peak, Point};
use crate::run::quadrature::{Even, Sum, Sums, trapezoid};
use crate::run::verdict::{self, Reading, Verdict};
use crate::stretch::{Bounds, Stretch};
use abi::Slot;
use abi::format;
use abi::plan::{Edge, Expect, Measure, MeasureKind, Moment};

/// Most points that one `period` or `settling` keeps: 2²⁵, half a gigabyte. With more points the measure fails with a
/// message.
pub const KEPT_POINTS: usize = 1 << 25;

/// All expectations of an experiment, updated point by point.
pub struct Expectations {
    expects: Vec<Expect>,
    meters: Vec<Vec<Meter>>,
    /// Instants in s, ascending, at which quantities may jump. The run shows a point at each.
    corners: Vec<f64>,
}

/// The points and areas that a measure needs from an adaptive run.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Demand {
    pub(crate) slot: Slot,
    pub(crate) what: Wants,
}

/// What a measure needs of the signal between two points.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Wants {
    /// The integral of the quantity.
    Area,
    /// The integral of its square.
    Square,
    /// Its turning points.
    Turns,
    /// Those that exceed all points before.
    Extremes,
    /// Points dense enough for linear or cubic interpolation.
    Points,
    /// Only the points at the edges of the window.
    Edges,
}

impl Expectations {
    /// Expectations before the first point.
    pub fn new(expects: &[Expect]) -> Expectations {
        let meters = expects.iter().map(|expect| {
            expect.measures.iter().map(|measure| Meter::new(measure, expect.after, expect.before)).collect()
        });
        Expectations { expects: expects.to_vec(), meters: meters.collect(), corners: Vec::new() }
    }

    /// Sets the instants in s, ascending, at which quantities may jump. The run shows a point at each.
    pub(crate) fn jumps_at(&mut self, corners: &[f64]) {
        self.corners = corners.to_vec();
    }

    /// Whether all measures need only the last point of the run.
    pub fn only_last(&self) -> bool {
        let last = |meter: &Meter| {
            matches!(meter.tally, Tally::Final) && meter.before == f64::INFINITY && meter.ends.is_none()
        };
        self.meters.iter().flatten().all(last)
    }

    /// The slots that the measures read.
    pub fn slots(&self) -> impl Iterator<Item = Slot> {
        self.meters
            .iter()
            .flatten()
            .flat_map(|meter| [Some(meter.slot), meter.begins, meter.ends, meter.moment].into_iter().flatten())
    }

    /// Whether an event opens or closes a window.
    pub(crate) fn are_opened_by_events(&self) -> bool {
        self.meters.iter().flatten().any(|meter| meter.begins.or(meter.ends).is_some())
    }

    /// What each measure needs, in the order of [`Expectations::give_area`].
    pub(crate) fn demands(&self) -> Vec<Demand> {
        self.meters.iter().flatten().map(Meter::demand).collect()
    }

    /// The window of measure number `k` in s, as far as it is known: an edge set by an event that has not happened yet
    /// is at infinity.
    pub(crate) fn window(&self, k: usize) -> (f64, f64) {
        let meter = self.meters.iter().flatten().nth(k).expect("it was one of the demands");
        (meter.after, meter.before)
    }

    /// Instants in s at which a window begins or ends or a value is sampled, ascending.
    pub(crate) fn instants(&self) -> Vec<f64> {
        let of = |meter: &Meter| {
            let at = if let Tally::At { instant, .. } = meter.tally { instant } else { meter.after };
            [meter.after, meter.before, at]
        };
        let mut instants: Vec<f64> = self.meters.iter().flatten().flat_map(of).filter(|t| t.is_finite()).collect();
        instants.sort_by(f64::total_cmp);
        instants.dedup();
        instants
    }

    /// The caller promises to pass the integrals between points by [`Expectations::give_area`], and to show a point at
    /// each turning point of a quantity whose extreme is measured. `tol` is its relative error: a sign change counts
    /// only if the values exceed this fraction of the largest one.
    pub(crate) fn expect_areas(&mut self, tol: f64) {
        for meter in self.meters.iter_mut().flatten() {
            match &mut meter.tally {
                Tally::Sum { given, .. } => *given = true,
                Tally::Extremes { .. } | Tally::TimeOf { .. } | Tally::AtPeak { .. } => meter.located = true,
                Tally::Crossings { lobes } => lobes.band = tol,
                Tally::Peaks { hills, .. } => {
                    hills.band = tol;
                    meter.located = true;
                }
                _ => {}
            }
        }
    }

    /// Adds the integral of the quantity of measure number `k`, or of its square, over the next part of its window.
    pub(crate) fn give_area(&mut self, k: usize, area: f64) {
        let meter = self.meters.iter_mut().flatten().nth(k).expect("it was one of the demands");
        match &mut meter.tally {
            Tally::Sum { sum, .. } => sum.add(area),
            _ => unreachable!("no area was asked for"),
        }
    }

    /// Shows the state of the model at time `t` in s. Times must not decrease.
    pub fn see(&mut self, t: f64, block: &[f64]) {
        for meter in self.meters.iter_mut().flatten() {
            meter.see_with(t, |slot| block[slot.index()]);
        }
    }

    /// Shows consecutive points, with the bits of [`see`](Expectations::see) for one after the other. Their values are
    /// finite.
    pub(crate) fn see_stretch(&mut self, stretch: &Stretch) {
        for meter in self.meters.iter_mut().flatten() {
            meter.see_stretch(stretch);
        }
    }

    /// The verdicts, in the order of the experiment.
    pub fn verdicts(&self) -> Vec<Verdict> {
        self.expects.iter().zip(&self.meters).map(|(expect, meters)| verdict(expect, meters, &self.corners)).collect()
    }
}

fn verdict(expect: &Expect, meters: &[Meter], corners: &[f64]) -> Verdict {
    let mut readings = Vec::new();
    let mut problem = None;
    for (measure, meter) in expect.measures.iter().zip(meters) {
        match meter.reading() {
            Ok((value, time)) => {
                let (text, unit) = (measure.text.clone(), measure.unit.clone());
                let (resolution, unseen, scale) = (meter.resolution(), meter.unseen(corners), meter.scale);
                readings.push(Reading { text, value, unit, time, resolution, unseen, scale, error: None });
            }
            Err(reason) => {
                problem.get_or_insert(format!("{}: {reason}", measure.text));
            }
        }
    }
    match problem {
        Some(problem) => verdict::unable(expect, readings, problem),
        None => verdict::verdict(expect, readings),
    }
}

/// The state of one measure: clips points to its window and accumulates those inside.
struct Meter {
    slot: Slot,
    /// Conditions that open and close the window, until they first hold.
    begins: Option<Slot>,
    ends: Option<Slot>,
    /// The slot that defines the moment at which the value is taken, and its present value.
    moment: Option<Slot>,
    telling: f64,
    after: f64,
    before: f64,
    /// The last point, inside the window or outside it; at an infinite time before the first.
    last: Point,
    /// First and last point inside the window; valid once there is one.
    first: Point,
    end: Point,
    counted: bool,
    /// The greatest magnitude inside the window.
    scale: f64,
    /// Whether the run shows a point at each turning point.
    located: bool,
    tally: Tally,
}

enum Tally {
    Extremes {
        min: Peak,
        max: Peak,
        kind: Extreme,
    },
    Sum {
        square: bool,
        kind: Average,
        sum: Sums,
        given: bool,
        even: Even,
    },
    Final,
    At {
        instant: f64,
        value: Option<f64>,
    },
    Crossings {
        lobes: Lobes,
    },
    First {
        after: Before,
        time: f64,
        gap: f64,
    },
    /// `rises`: only where the condition was false at the previous point.
    AtMoment {
        rises: bool,
        was: bool,
        found: Option<Point>,
        gap: f64,
    },
    /// The value at the time when another quantity has its extreme. `near`: differences to the values before and after
    /// it; the second is set by the next point.
    AtPeak {
        peak: Peak,
        found: f64,
        near: (f64, Option<f64>),
    },
    TimeOf {
        peak: Peak,
    },
    Period {
        kept: Kept,
    },
    Settling {
        band: f64,
        kept: Kept,
    },
    Count {
        of: Counted,
        count: u64,
        time: Option<f64>,
    },
    Duration {
        sum: Sum,
        gap: f64,
    },
    Peaks {
        what: Hill,
        hills: Hills,
    },
}

/// What is counted of a condition.
#[derive(Clone, Copy)]
enum Counted {
    /// Intervals in which it holds.
    Phases,
    /// Changes from false to true.
    Rises,
    /// All changes.
    Turns,
}

/// What is read of the peaks.
#[derive(Clone, Copy)]
enum Hill {
    Number,
    /// The height of the peak with this number, from 1.
    Height(f64),
    Time(f64),
}

/// What a condition must have been before its first occurrence counts.
#[derive(Clone, Copy)]
enum Before {
    Anything,
    False,
    /// The opposite of its value at the occurrence.
    Other,
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
        let extremes = |kind| Tally::Extremes { min: Peak::least(), max: Peak::greatest(), kind };
        let at_peak = |peak| Tally::AtPeak { peak, found: 0.0, near: (0.0, None) };
        let sum = |kind, square| {
            let (sum, even) = (Sums::default(), Even::default());
            Tally::Sum { square, kind, sum, given: false, even }
        };
        let count = |of| Tally::Count { of, count: 0, time: None };
        let peaks = |what| Tally::Peaks { what, hills: Hills::default() };
        let tally = match measure.kind {
            MeasureKind::Min => extremes(Extreme::Min),
            MeasureKind::Max => extremes(Extreme::Max),
            MeasureKind::PeakToPeak => extremes(Extreme::Between),
            MeasureKind::Mean => sum(Average::Mean, false),
            MeasureKind::Rms => sum(Average::Root, true),
            MeasureKind::Integral => sum(Average::Integral, false),
            MeasureKind::Final => Tally::Final,
            MeasureKind::At(instant) => Tally::At { instant, value: None },
            MeasureKind::Crossings => Tally::Crossings { lobes: Lobes::default() },
            MeasureKind::First => Tally::First { after: Before::Anything, time: f64::INFINITY, gap: 0.0 },
            MeasureKind::Rises => Tally::First { after: Before::False, time: f64::INFINITY, gap: 0.0 },
            MeasureKind::Turns => Tally::First { after: Before::Other, time: f64::INFINITY, gap: 0.0 },
            MeasureKind::AtMoment(Moment::Least(_)) => at_peak(Peak::least()),
            MeasureKind::AtMoment(Moment::Greatest(_)) => at_peak(Peak::greatest()),
            MeasureKind::AtMoment(Moment::First(_)) => {
                Tally::AtMoment { rises: false, was: true, found: None, gap: 0.0 }
            }
            MeasureKind::AtMoment(Moment::Rises(_)) => {
                Tally::AtMoment { rises: true, was: true, found: None, gap: 0.0 }
            }
            MeasureKind::TimeOfLeast => Tally::TimeOf { peak: Peak::least() },
            MeasureKind::TimeOfGreatest => Tally::TimeOf { peak: Peak::greatest() },
            MeasureKind::Period => Tally::Period { kept: Kept::default() },
            MeasureKind::Settling(band) => Tally::Settling { band, kept: Kept::default() },
            MeasureKind::Count => count(Counted::Phases),
            MeasureKind::CountRises => count(Counted::Rises),
            MeasureKind::CountTurns => count(Counted::Turns),
            MeasureKind::Duration => Tally::Duration { sum: Sum::default(), gap: 0.0 },
            MeasureKind::Peaks => peaks(Hill::Number),
            MeasureKind::Peak(number) => peaks(Hill::Height(number)),
            MeasureKind::TimeOfPeak(number) => peaks(Hill::Time(number)),
        };
        let none = (f64::INFINITY, 0.0);
        // An edge set by an event is at infinity until the event happens.
        let (mut after, mut before, mut begins, mut ends) = (after, before, None, None);
        match measure.window.after {
            Edge::Open => {}
            Edge::At(time) => after = after.max(time),
            Edge::First(slot) => (after, begins) = (f64::INFINITY, Some(slot)),
        }
        match measure.window.before {
            Edge::Open => {}
            Edge::At(time) => before = before.min(time),
            Edge::First(slot) => ends = Some(slot),
        }
        let moment = match measure.kind {
            MeasureKind::AtMoment(
                Moment::First(slot) | Moment::Rises(slot) | Moment::Least(slot) | Moment::Greatest(slot),
            ) => Some(slot),
            _ => None,
        };
        let (slot, telling, scale, counted) = (measure.slot, 0.0, 0.0, false);
        Meter {
            slot,
            begins,
            ends,
            moment,
            telling,
            after,
            before,
            last: none,
            first: none,
            end: none,
            counted,
            scale,
            located: false,
            tally,
        }
    }

    /// Adds a point, whose values `read` gives; events may open or close the window there.
    fn see_with(&mut self, t: f64, read: impl Fn(Slot) -> f64) {
        let holds = |slot: Option<Slot>| slot.is_some_and(|slot| read(slot) != 0.0);
        if holds(self.begins) {
            (self.begins, self.after) = (None, t);
        }
        if holds(self.ends) {
            (self.ends, self.before) = (None, self.before.min(t));
        }
        if let Some(moment) = self.moment {
            self.telling = read(moment);
        }
        self.see(t, read(self.slot));
    }

    /// Adds consecutive points.
    fn see_stretch(&mut self, stretch: &Stretch) {
        let (times, values) = (stretch.times(), stretch.column(self.slot));
        let Some(end) = times.last() else { return };
        let is_watched = self.begins.or(self.ends).or(self.moment).is_some();
        if is_watched || !self.counted || self.last.0 < self.after || *end > self.before {
            let others = [self.begins, self.ends, self.moment].map(|slot| Some((slot?, stretch.column(slot?))));
            for (k, (t, v)) in times.iter().zip(values).enumerate() {
                let other = |slot| others.iter().flatten().find(|(known, _)| *known == slot).map(|(_, all)| all[k]);
                self.see_with(*t, |slot| other(slot).unwrap_or(*v));
            }
        } else if !self.count_all(times, values, stretch.bounds(self.slot)) {
            times.iter().zip(values).for_each(|(t, v)| self.see(*t, *v));
        }
    }

    /// Adds points inside the window, of which it has counted some, in a closed form or a loop of its own; returns whether
    /// there is one for this measure.
    fn count_all(&mut self, times: &[f64], values: &[f64], bounds: Bounds) -> bool {
        let (Some(t), Some(v)) = (times.last(), values.last()) else { return true };
        match &mut self.tally {
            Tally::Extremes { min, max, kind } => {
                if !matches!(kind, Extreme::Max) {
                    min.see_all(times, values, bounds);
                }
                if !matches!(kind, Extreme::Min) {
                    max.see_all(times, values, bounds);
                }
            }
            Tally::Sum { given: false, square, sum, even, .. } => {
                if !even.goes_on(times) {
                    return false;
                }
                let of = |v: f64| if *square { v * v } else { v };
                sum.add_trapezoids(self.end, times, values, *square);
                even.push_all(*t, values.len(), values[values.len().saturating_sub(3)..].iter().map(|v| of(*v)));
            }
            Tally::Sum { given: true, .. } | Tally::Final => {}
            Tally::At { instant, .. } if *t < *instant || *instant < self.end.0 => {}
            Tally::TimeOf { peak } => peak.see_all(times, values, bounds),
            _ => return false,
        }
        self.end = (*t, *v);
        self.last = self.end;
        self.scale = self.scale.max(bounds.magnitude());
        true
    }

    fn demand(&self) -> Demand {
        let what = match &self.tally {
            // A window that begins with the run has seen all points before.
            Tally::Extremes { .. } | Tally::TimeOf { .. } if self.after <= 0.0 => Wants::Extremes,
            Tally::Extremes { .. } | Tally::TimeOf { .. } | Tally::Peaks { .. } => Wants::Turns,
            Tally::AtPeak { .. } => {
                return Demand { slot: self.moment.unwrap_or(self.slot), what: Wants::Turns };
            }
            Tally::Sum { square: false, .. } => Wants::Area,
            Tally::Sum { square: true, .. } => Wants::Square,
            Tally::Crossings { .. } | Tally::Period { .. } | Tally::Settling { .. } => Wants::Points,
            Tally::Final
            | Tally::At { .. }
            | Tally::First { .. }
            | Tally::AtMoment { .. }
            | Tally::Count { .. }
            | Tally::Duration { .. } => Wants::Edges,
        };
        Demand { slot: self.slot, what }
    }

    /// Adds a point; at the edges of the window, adds the interpolated point.
    fn see(&mut self, t: f64, v: f64) {
        let last = self.last;
        if let Tally::Crossings { lobes } = &mut self.tally {
            lobes.largest = lobes.largest.max(v.abs());
        }
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

    /// The value at a window edge between two points. A condition keeps its value until the next point.
    fn between(&self, from: Point, to: Point, t: f64) -> f64 {
        match self.tally {
            Tally::First { .. } | Tally::Count { .. } | Tally::Duration { .. } => from.1,
            _ => line(from, to, t),
        }
    }

    fn count(&mut self, t: f64, v: f64) {
        let previous = self.end;
        if !self.counted {
            self.first = (t, v);
        }
        match &mut self.tally {
            Tally::Extremes { min, max, kind } => {
                if !matches!(kind, Extreme::Max) {
                    min.see(t, v);
                }
                if !matches!(kind, Extreme::Min) {
                    max.see(t, v);
                }
            }
            Tally::Sum { given: true, .. } => {}
            Tally::Sum { square, sum, even, given: false, .. } => {
                if self.counted {
                    sum.add(trapezoid(previous, (t, v), *square));
                }
                let value = if *square { v * v } else { v };
                if let Some(correction) = even.push(t, value) {
                    sum.add(correction);
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
            Tally::Crossings { lobes } => lobes.push(t, v),
            Tally::AtMoment { rises, was, found, gap } => {
                let holds = self.telling != 0.0;
                if found.is_none() && holds && !(*rises && *was) {
                    *found = Some((t, v));
                    if self.counted && t > previous.0 {
                        // The event lies somewhere after the previous point.
                        *gap = (v - previous.1).abs();
                    }
                }
                *was = holds;
            }
            Tally::AtPeak { peak, found, near } => {
                if peak.see(t, self.telling) {
                    (*found, *near) = (v, (if self.counted { (v - previous.1).abs() } else { 0.0 }, None));
                } else {
                    near.1.get_or_insert((v - *found).abs());
                }
            }
            Tally::TimeOf { peak } => {
                peak.see(t, v);
            }
            Tally::First { after, time, gap } => {
                let was = if self.counted { Some(previous.1 != 0.0) } else { None };
                let now = match after {
                    Before::Anything => v != 0.0,
                    Before::False => v != 0.0 && was == Some(false),
                    Before::Other => was.is_some_and(|was| was != (v != 0.0)),
                };
                if now && *time == f64::INFINITY {
                    *time = t;
                    // The condition became true somewhere after the previous point.
                    *gap = if self.counted { t - previous.0 } else { 0.0 };
                }
            }
            Tally::Count { of, count, time } => {
                let was = if self.counted { Some(previous.1 != 0.0) } else { None };
                let one = match of {
                    Counted::Phases => v != 0.0 && was != Some(true),
                    Counted::Rises => v != 0.0 && was == Some(false),
                    Counted::Turns => was.is_some_and(|was| was != (v != 0.0)),
                };
                if one {
                    (*count, *time) = (*count + 1, Some(t));
                }
            }
            Tally::Duration { sum, gap } => {
                if self.counted && previous.1 != 0.0 {
                    sum.add(t - previous.0);
                }
                if self.counted && (previous.1 != 0.0) != (v != 0.0) {
                    // The condition changed somewhere after the previous point.
                    *gap += t - previous.0;
                }
            }
            Tally::Peaks { hills, .. } => hills.push((t, v), KEPT_POINTS),
            Tally::Period { kept } | Tally::Settling { kept, .. } => kept.push((t, v)),
        }
        self.end = (t, v);
        self.scale = self.scale.max(v.abs());
        self.counted = true;
    }

    /// The error of the reading due to the spacing of the points, SI.
    fn resolution(&self) -> f64 {
        match &self.tally {
            Tally::First { gap, .. } | Tally::AtMoment { gap, .. } | Tally::Duration { gap, .. } => *gap,
            Tally::Extremes { .. }
            | Tally::Sum { .. }
            | Tally::Final
            | Tally::At { .. }
            | Tally::Crossings { .. }
            | Tally::AtPeak { .. }
            | Tally::TimeOf { .. }
            | Tally::Period { .. }
            | Tally::Count { .. }
            | Tally::Peaks { .. }
            | Tally::Settling { .. } => 0.0,
        }
    }

    /// How far an extreme between the points may be from the largest point, SI: in its value, its time, or the value of
    /// another quantity then.
    fn unseen(&self, corners: &[f64]) -> f64 {
        match &self.tally {
            _ if self.located => 0.0,
            Tally::Extremes { min, max, kind } => match kind {
                Extreme::Min => min.unseen(corners),
                Extreme::Max => max.unseen(corners),
                Extreme::Between => min.unseen(corners) + max.unseen(corners),
            },
            Tally::AtPeak { near: (before, after), .. } => before.max(after.unwrap_or(0.0)),
            Tally::TimeOf { peak } => peak.gap(),
            Tally::Peaks { what, hills } => {
                let of = |number: f64| hills.peaks()?.get(number as usize - 1).map(Turn::seen);
                match what {
                    Hill::Number => 0.0,
                    Hill::Height(number) => of(*number).map_or(0.0, |peak| peak.unseen(corners)),
                    Hill::Time(number) => of(*number).map_or(0.0, |peak| peak.gap()),
                }
            }
            Tally::Count { .. }
            | Tally::Duration { .. }
            | Tally::Sum { .. }
            | Tally::Final
            | Tally::At { .. }
            | Tally::Crossings { .. }
            | Tally::First { .. }
            | Tally::AtMoment { .. }
            | Tally::Period { .. }
            | Tally::Settling { .. } => 0.0,
        }
    }

    /// Value in SI, and the time in s where it occurred; or the reason why there is no value.
    fn reading(&self) -> Result<(f64, Option<f64>), String> {
        if !self.counted {
            let end = match self.last.0 {
                f64::INFINITY => "the run has no point".into(),
                end => format!("the run ends at {}", format::time(end)),
            };
            if self.begins.is_some() {
                return Err("the window never begins: its event does not happen".into());
            }
            let (after, before) = (format::time(self.after), format::time(self.before));
            return Err(format!("the window from {after} to {before} is empty; {end}"));
        }
        let (first, last) = (self.first, self.end);
        let width = last.0 - first.0;
        match &self.tally {
            Tally::Extremes { min, max, kind } => {
                let (min, max) = (min.found(), max.found());
                Ok(match kind {
                    Extreme::Min => (min.1, Some(min.0)),
                    Extreme::Max => (max.1, Some(max.0)),
                    Extreme::Between => (max.1 - min.1, Some(min.0.max(max.0))),
                })
            }
            Tally::Sum { kind, sum, even, .. } => {
                let total = sum.total() + even.correction();
                let value = match kind {
                    Average::Integral => total,
                    // A window of zero width: the limit for ever narrower windows.
                    Average::Mean if width == 0.0 => last.1,
                    Average::Root if width == 0.0 => last.1.abs(),
                    Average::Mean => total / width,
                    Average::Root => (total / width).sqrt(),
                };
                Ok((value, None))
            }
            Tally::Final => Ok((last.1, Some(last.0))),
            Tally::At { instant, value } => {
                // The last step may end one rounding error before the requested instant.
                let near_end = *instant > last.0 && *instant - last.0 <= 1e-9 * last.0.abs();
                let value = value.or(near_end.then_some(last.1)).ok_or_else(|| {
                    format!(
                        "{} lies outside the window from {} to {}",
                        format::time(*instant),
                        format::time(first.0),
                        format::time(last.0)
                    )
                })?;
                Ok((value, Some(*instant)))
            }
            Tally::Crossings { lobes } => {
                let (count, time) = lobes.crossings();
                Ok((count as f64, time))
            }
            Tally::AtMoment { found, .. } => {
                let (time, value) = found.ok_or("its event does not happen in the window")?;
                Ok((value, Some(time)))
            }
            Tally::AtPeak { peak, found, .. } => Ok((*found, Some(peak.found().0))),
            Tally::TimeOf { peak } => Ok((peak.found().0, Some(peak.found().0))),
            Tally::First { time, .. } => Ok((*time, time.is_finite().then_some(*time))),
            Tally::Count { count, time, .. } => Ok((*count as f64, *time)),
            Tally::Duration { sum, .. } => Ok((sum.total(), None)),
            Tally::Peaks { what, hills } => {
                let peaks = hills.peaks().ok_or_else(too_many)?;
                let of = |number: f64| {
                    // The plan guarantees a whole number from 1.
                    let words = match peaks.len() {
                        0 => "there is no peak in the window".to_string(),
                        1 => "there is one peak in the window".into(),
                        n => format!("there are {n} peaks in the window"),
                    };
                    peaks.get(number as usize - 1).map(|turn| turn.at).ok_or(words)
                };
                match what {
                    Hill::Number => Ok((peaks.len() as f64, peaks.last().map(|turn| turn.at.0))),
                    Hill::Height(number) => of(*number).map(|(time, value)| (value, Some(time))),
                    Hill::Time(number) => of(*number).map(|(time, _)| (time, Some(time))),
                }
            }
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

/// All points, up to the limit.
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
            return Err(too_many());
        }
        Ok(&self.points)
    }
}

fn too_many() -> String {
    format!(
        "more than {KEPT_POINTS} points lie in the window; narrow it with `after` and `before`, or take a larger step"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::plan::Window;
    use abi::unit::Unit;

    const WHOLE: (f64, f64) = (0.0, f64::INFINITY);

    fn measure(kind: MeasureKind) -> Measure {
        Measure { text: "m".into(), kind, slot: Slot(3), unit: Unit::parse("m").unwrap(), window: Window::default() }
    }

    /// Value and time of one measure over these points.
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
    fn window_edges_are_interpolated_linearly() {
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
        // Between two points a condition keeps its earlier value: at 1.5 it is not yet true.
        assert_eq!(value(MeasureKind::First, (1.5, 3.0), &points), 2.0);
        assert_eq!(value(MeasureKind::First, (2.5, 3.0), &points), 2.5);
        assert_eq!(taken(MeasureKind::First, (0.0, 1.0), &points), Ok((f64::INFINITY, None)));
    }

    #[test]
    fn phases_of_a_condition() {
        // True from the start to 1, from 2 to 3 (through an event), and from 4 on.
        let points = [(0.0, 1.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (3.0, 1.0), (3.0, 0.0), (4.0, 1.0), (5.0, 1.0)];
        assert_eq!(taken(MeasureKind::Count, WHOLE, &points), Ok((3.0, Some(4.0))));
        assert_eq!(taken(MeasureKind::CountRises, WHOLE, &points), Ok((2.0, Some(4.0))));
        assert_eq!(taken(MeasureKind::CountTurns, WHOLE, &points), Ok((4.0, Some(4.0))));
        assert_eq!(value(MeasureKind::Duration, WHOLE, &points), 3.0);
        // A window clips intervals: one that is true at the window's begin counts, with its duration from there on.
        assert_eq!(value(MeasureKind::Count, (2.5, 4.5), &points), 2.0);
        assert_eq!(value(MeasureKind::CountRises, (2.5, 4.5), &points), 1.0);
        assert_eq!(value(MeasureKind::Duration, (2.5, 4.5), &points), 1.0);
        assert_eq!(value(MeasureKind::Count, (1.2, 1.8), &points), 0.0);
        assert_eq!(value(MeasureKind::Duration, (1.2, 1.8), &points), 0.0);
        // The time of a change between two points is uncertain; the time of a change at an event is exact.
        let mut meter = Meter::new(&measure(MeasureKind::Duration), 0.0, f64::INFINITY);
        points.iter().for_each(|(t, v)| meter.see(*t, *v));
        assert_eq!(meter.resolution(), 2.0);
    }

    #[test]
    fn peaks_of_a_decay() {
        let points: Vec<Point> = (0..=3500)
            .map(|n| {
                let t = f64::from(n) * 1e-3;
                (t, (-0.5 * t).exp() * (std::f64::consts::TAU * t).cos())
            })
            .collect();
        assert_eq!(value(MeasureKind::Peaks, WHOLE, &points), 3.0);
        let height = |n| value(MeasureKind::Peak(n), WHOLE, &points);
        assert!((height(1.0) / height(3.0) - 1f64.exp()).abs() < 1e-5);
        assert!((value(MeasureKind::TimeOfPeak(2.0), WHOLE, &points) - 1.987).abs() < 2e-3);
        let reason = taken(MeasureKind::Peak(4.0), WHOLE, &points).unwrap_err();
        assert_eq!(reason, "there are 3 peaks in the window");
    }

    /// One measure over points of time, the quantity, and the condition or quantity that defines the moment.
    fn told(kind: MeasureKind, window: Window, points: &[(f64, f64, f64)]) -> Result<(f64, Option<f64>), String> {
        let mut meter = Meter::new(&Measure { window, ..measure(kind) }, 0.0, f64::INFINITY);
        points.iter().for_each(|(t, v, w)| meter.see_with(*t, |slot| [*t, 0.0, *w, *v][slot.index()]));
        meter.reading()
    }

    #[test]
    fn events_set_moments_and_windows() {
        let (slot, open) = (Slot(2), Window::default());
        let points = [(0.0, 0.0, 1.0), (1.0, 5.0, 0.0), (2.0, 3.0, 0.0), (2.0, 3.0, 1.0), (3.0, 4.0, 1.0)];
        let at = |moment| told(MeasureKind::AtMoment(moment), open, &points);
        assert_eq!(at(Moment::First(slot)), Ok((0.0, Some(0.0))));
        assert_eq!(at(Moment::Rises(slot)), Ok((3.0, Some(2.0))));
        assert_eq!(at(Moment::Least(slot)), Ok((5.0, Some(1.0))));
        assert_eq!(at(Moment::Greatest(slot)), Ok((0.0, Some(0.0))));
        assert_eq!(told(MeasureKind::TimeOfGreatest, open, &points), Ok((1.0, Some(1.0))));
        assert_eq!(told(MeasureKind::TimeOfLeast, open, &points), Ok((0.0, Some(0.0))));
        let late = [(0.0, 9.0, 0.0), (1.0, 5.0, 0.0), (2.0, 3.0, 1.0), (3.0, 4.0, 0.0)];
        let after = Window { after: Edge::First(slot), before: Edge::Open };
        let before = Window { after: Edge::At(0.5), before: Edge::First(slot) };
        assert_eq!(told(MeasureKind::Max, after, &late), Ok((4.0, Some(3.0))));
        assert_eq!(told(MeasureKind::Max, before, &late), Ok((7.0, Some(0.5))));
        assert_eq!(told(MeasureKind::Final, before, &late), Ok((3.0, Some(2.0))));
        let never = told(MeasureKind::Max, after, &late[..2]).unwrap_err();
        assert_eq!(never, "the window never begins: its event does not happen");
        let turns = [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (2.0, 0.0, 0.0), (3.0, 1.0, 0.0)];
        assert_eq!(told(MeasureKind::Turns, open, &turns), Ok((2.0, Some(2.0))));
        assert_eq!(told(MeasureKind::Rises, open, &turns), Ok((3.0, Some(3.0))));
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
        // A cubic does not fit across jumps.
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
}
