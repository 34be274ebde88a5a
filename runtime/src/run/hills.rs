//! Peaks of a signal: local maxima that exceed the errors of the run.
//!
//! In: points in order of time. Out: the peaks. A maximum counts if the signal rose to it and fell from it by more than
//! a threshold, so that rounding errors make no peaks. The first and last values of a window are not peaks. A plateau
//! is one peak, at its first instant.

use crate::run::peak::{Peak, Point};

/// A turning point, with the points just before and after it.
#[derive(Clone, Copy)]
pub(crate) struct Turn {
    /// Time in s and value in SI.
    pub(crate) at: Point,
    before: Option<Point>,
    after: Option<Point>,
}

impl Turn {
    /// The maximum with its neighbours, to estimate how far the signal may exceed it between the points.
    pub(crate) fn seen(&self) -> Peak {
        let mut peak = Peak::greatest();
        for (t, v) in self.before.into_iter().chain([self.at]).chain(self.after) {
            peak.see(t, v);
        }
        peak
    }
}

/// Turning points found so far.
#[derive(Default)]
pub(crate) struct Hills {
    /// A rise or fall of up to this fraction of the largest magnitude does not count.
    pub(crate) band: f64,
    largest: f64,
    last: Option<Point>,
    /// Least and greatest value so far, until they differ by more than the threshold.
    begin: Option<(Turn, Turn)>,
    /// Alternating minima and maxima; the last one may still move.
    turns: Vec<Turn>,
    overflowed: bool,
}

impl Hills {
    /// Adds a point; keeps at most `most` turning points.
    pub(crate) fn push(&mut self, point: Point, most: usize) {
        self.largest = self.largest.max(point.1.abs());
        let least = self.least();
        if let Some(turn) = self.turns.last_mut().filter(|turn| Some(turn.at) == self.last) {
            turn.after = Some(point);
        }
        if self.turns.len() >= most {
            self.overflowed = true;
        } else {
            add(&mut self.begin, &mut self.turns, Turn { at: point, before: self.last, after: None }, least);
        }
        self.last = Some(point);
    }

    fn least(&self) -> f64 {
        (self.band.max(1e-12) * self.largest).max(1e-15)
    }

    /// The peaks in order of time; none if there were too many turning points.
    pub(crate) fn peaks(&self) -> Option<Vec<Turn>> {
        if self.overflowed {
            return None;
        }
        // Each point was compared with a threshold from the largest magnitude known at that time: repeat with the final
        // one.
        let (mut begin, mut turns) = (None, Vec::new());
        self.turns.iter().for_each(|turn| add(&mut begin, &mut turns, *turn, self.least()));
        let high = |three: &&[Turn]| three[0].at.1 < three[1].at.1;
        Some(turns.windows(3).filter(high).map(|three| three[1]).collect())
    }
}

fn add(begin: &mut Option<(Turn, Turn)>, turns: &mut Vec<Turn>, one: Turn, least: f64) {
    let &[.., before, last] = turns.as_slice() else {
        let (low, high) = begin.get_or_insert((one, one));
        if one.at.1 < low.at.1 {
            *low = one;
        }
        if one.at.1 > high.at.1 {
            *high = one;
        }
        if high.at.1 - low.at.1 > least {
            turns.extend(if low.at.0 <= high.at.0 { [*low, *high] } else { [*high, *low] });
        }
        return;
    };
    let sign = if last.at.1 > before.at.1 { 1.0 } else { -1.0 };
    let end = turns.len() - 1;
    if sign * one.at.1 > sign * last.at.1 {
        turns[end] = one;
    } else if sign * (last.at.1 - one.at.1) > least {
        turns.push(one);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peaks(band: f64, points: &[Point]) -> Vec<Point> {
        let mut hills = Hills { band, ..Hills::default() };
        points.iter().for_each(|point| hills.push(*point, usize::MAX));
        hills.peaks().expect("there is room").iter().map(|turn| turn.at).collect()
    }

    #[test]
    fn maxima_inside_count_and_ends_do_not() {
        let points = [(0.0, 3.0), (1.0, 0.0), (2.0, 2.0), (3.0, 2.0), (4.0, 1.0), (5.0, 4.0), (6.0, -1.0), (7.0, 9.0)];
        assert_eq!(peaks(0.0, &points), [(2.0, 2.0), (5.0, 4.0)]);
        assert_eq!(peaks(0.0, &points[..4]), []);
        assert_eq!(peaks(0.0, &[]), []);
        // An event is two points at one time.
        assert_eq!(peaks(0.0, &[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (2.0, 0.0)]), [(1.0, 1.0)]);
    }

    #[test]
    fn wiggles_below_the_threshold_are_no_peaks_even_if_the_largest_value_comes_late() {
        let wiggle = |k: i32| (f64::from(k), f64::from(k) + 1e-3 * f64::from(k % 2));
        let mut points: Vec<Point> = (0..100).map(wiggle).collect();
        assert_eq!(peaks(1e-6, &points), []);
        points = (0..50).map(|k| (f64::from(k), 1e-3 * f64::from(k % 2))).collect();
        assert_eq!(peaks(1e-6, &points).len(), 24);
        points.extend([(50.0, 5e4), (51.0, 0.0)]);
        assert_eq!(peaks(1e-6, &points), [(50.0, 5e4)]);
    }

    #[test]
    fn a_peak_between_points_is_estimated() {
        // The vertex lies at 1.3, between points.
        let mut hills = Hills::default();
        (0..4).for_each(|k| hills.push((f64::from(k), -(f64::from(k) - 1.3) * (f64::from(k) - 1.3)), usize::MAX));
        let peak = hills.peaks().expect("there is room")[0].seen();
        assert!((peak.unseen(&[]) - 0.09).abs() < 1e-12 && peak.gap() == 1.0);
    }
}
