//! Level crossings of a sampled signal.
//!
//! In: points in order of time. Out: the number of sign changes that exceed numerical errors, the period, the settling
//! time. Knows no windows.

use crate::run::peak::Point;
use crate::run::quadrature::Sum;

/// Values below this, in SI, are rounding errors.
const NOTHING: f64 = 1e-15;

/// Segments of a signal between two sign changes. A segment counts if its peak exceeds rounding errors and the errors
/// of the run.
#[derive(Default)]
pub(crate) struct Lobes {
    /// A value smaller than this fraction of the largest one counts as zero.
    pub(crate) band: f64,
    /// Largest magnitude of the run so far, inside the window or outside it.
    pub(crate) largest: f64,
    /// For each segment its first instant in s and the value farthest from zero. Segments that cannot count any more
    /// are dropped.
    kept: Vec<Point>,
}

impl Lobes {
    pub(crate) fn push(&mut self, t: f64, v: f64) {
        if v == 0.0 {
            return;
        }
        match self.kept.last_mut().filter(|(_, peak)| (*peak > 0.0) == (v > 0.0)) {
            Some((_, peak)) => *peak = if v.abs() > peak.abs() { v } else { *peak },
            None => {
                let least = self.least();
                self.kept.pop_if(|(_, peak)| peak.abs() <= least);
                // Same sign as the previous segment, because the one between was dropped: merge the two.
                match self.kept.last_mut().filter(|(_, peak)| (*peak > 0.0) == (v > 0.0)) {
                    Some((_, peak)) => *peak = if v.abs() > peak.abs() { v } else { *peak },
                    None => self.kept.push((t, v)),
                }
            }
        }
    }

    /// Magnitudes up to this count as zero.
    fn least(&self) -> f64 {
        (self.band.max(1e-12) * self.largest).max(NOTHING)
    }

    /// The number of sign changes, and the time of the last one.
    pub(crate) fn crossings(&self) -> (u64, Option<f64>) {
        let least = self.least();
        let (mut sign, mut count, mut time) = (0.0, 0, None);
        for (t, peak) in self.kept.iter().filter(|(_, peak)| peak.abs() > least) {
            if peak.signum() != sign {
                if sign != 0.0 {
                    (count, time) = (count + 1, Some(*t));
                }
                sign = peak.signum();
            }
        }
        (count, time)
    }
}

/// Mean time between upward crossings of the signal's time average.
pub(crate) fn period(points: &[Point]) -> Result<f64, String> {
    let mut area = Sum::default();
    for pair in points.windows(2) {
        area.add(0.5 * (pair[0].1 + pair[1].1) * (pair[1].0 - pair[0].0));
    }
    let width = points[points.len() - 1].0 - points[0].0;
    let mean = if width > 0.0 { area.total() / width } else { points[0].1 };
    // An upward crossing goes from below the mean to the mean or above; a value that only touches the mean from above
    // does not cross.
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

/// The time when the cubic through four points passes `level` between the middle two; a straight line where there are
/// fewer than four points, or two of them have the same time. A line everywhere would be only as accurate as the
/// spacing of the points.
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

/// The last time when the value leaves the band around `end`; none if it is never outside.
pub(crate) fn settling(points: &[Point], end: f64, band: f64) -> Option<f64> {
    let outside = points.iter().rposition(|(_, v)| (v - end).abs() > band)?;
    let (from, to) = (points[outside], *points.get(outside + 1)?);
    if from.0 == to.0 {
        return Some(from.0);
    }
    let edge = end + band.copysign(from.1 - end);
    let part = (edge - from.1) / (to.1 - from.1);
    Some(from.0 + part * (to.0 - from.0))
}
