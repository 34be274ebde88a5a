//! The maximum of a signal sampled at fixed steps, and how far the signal may exceed it between the samples.
//!
//! In: points in order of time. Out: the greatest point, and an estimate of its distance to the maximum of the signal:
//! from the parabola through the neighbouring points where the signal looks smooth, else from straight lines
//! extrapolated from both sides. A run with half the step has a point at the same time, so its agreement there gives no
//! information about the signal in between.

use crate::stretch::{Bounds, first};

/// A point: time in s, value in SI.
pub(crate) type Point = (f64, f64);

/// The running maximum or minimum.
pub(crate) struct Peak {
    /// 1 for the maximum, −1 for the minimum.
    sign: f64,
    /// The greatest point so far, times `sign`; −∞ before the first.
    at: Point,
    /// The two points before the greatest, nearer one first; then those after it.
    before: [Option<Point>; 2],
    after: [Option<Point>; 2],
    /// The last two points, later one first.
    last: [Option<Point>; 2],
}

impl Peak {
    pub(crate) fn greatest() -> Peak {
        Peak { sign: 1.0, at: (0.0, f64::NEG_INFINITY), before: [None; 2], after: [None; 2], last: [None; 2] }
    }

    pub(crate) fn least() -> Peak {
        Peak { sign: -1.0, ..Peak::greatest() }
    }

    /// Adds a point; returns whether it is the new extreme.
    pub(crate) fn see(&mut self, t: f64, v: f64) -> bool {
        let point = (t, self.sign * v);
        let higher = point.1 > self.at.1;
        if higher {
            (self.at, self.before, self.after) = (point, self.last, [None; 2]);
        } else if self.after[1].is_none() {
            let free = usize::from(self.after[0].is_some());
            self.after[free] = Some(point);
        }
        self.last = [Some(point), self.last[0]];
        higher
    }

    /// Adds points with these bounds one after the other, as [`see`](Peak::see) does. Values must be finite.
    pub(crate) fn see_all(&mut self, times: &[f64], values: &[f64], bounds: Bounds) {
        let at = |k: usize| (times[k], self.sign * values[k]);
        let len = values.len();
        let highest = if self.sign > 0.0 { bounds.greatest } else { -bounds.least };
        if highest > self.at.1 {
            let k = first(values, self.sign * highest);
            // The points before one of these, later one first.
            let before = |k: usize| match k {
                0 => self.last,
                1 => [Some(at(0)), self.last[0]],
                _ => [Some(at(k - 1)), Some(at(k - 2))],
            };
            let after = [k + 1, k + 2].map(|k| (k < len).then(|| at(k)));
            (self.at, self.before, self.after) = (at(k), before(k), after);
        } else {
            let mut next = (0..len).map(at);
            for free in self.after.iter_mut().filter(|place| place.is_none()) {
                *free = next.next();
            }
        }
        self.last = match len {
            0 => self.last,
            1 => [Some(at(0)), self.last[0]],
            _ => [Some(at(len - 1)), Some(at(len - 2))],
        };
    }

    /// The extreme among the points: time in s, value in SI.
    pub(crate) fn found(&self) -> Point {
        (self.at.0, self.sign * self.at.1)
    }

    /// How far the signal may exceed the extreme between the points, SI. `corners`: instants in s, ascending, at which
    /// the signal may jump and the run has a point.
    pub(crate) fn unseen(&self, corners: &[f64]) -> f64 {
        // Two points at one time are the two sides of a jump. Extrapolation stops there, and at each corner.
        let one_side = |points: [Option<Point>; 2]| {
            let near = points[0].filter(|point| point.0 != self.at.0);
            [near, points[1].filter(|point| near.is_some_and(|near| near.0 != point.0))]
        };
        let [b1, b2] = if is_at(corners, self.at.0) { [None; 2] } else { one_side(self.before) };
        let [a1, a2] = one_side(self.after);
        let peak = self.at;
        let unseen = match (b2, b1, a1, a2) {
            (Some(b2), Some(b1), Some(a1), Some(a2)) if !is_smooth([b2, b1, peak, a1, a2]) => {
                let right = by_lines([b1, peak, a1, a2]);
                let turned = |point: Point| (-point.0, point.1);
                right.max(by_lines([a1, peak, b1, b2].map(turned)))
            }
            (_, Some(b1), Some(a1), _) => above([b1, peak, a1], peak, (b1.0, a1.0)),
            (Some(b2), Some(b1), None, _) => above([b2, b1, peak], peak, (b1.0, peak.0)),
            (_, None, Some(a1), Some(a2)) => above([peak, a1, a2], peak, (peak.0, a1.0)),
            _ => 0.0,
        };
        if unseen.is_finite() { unseen } else { 0.0 }
    }

    /// The longer of the times in s between the extreme and its neighbours.
    pub(crate) fn gap(&self) -> f64 {
        let far = |point: Option<Point>| point.map_or(0.0, |point| (point.0 - self.at.0).abs());
        far(self.before[0]).max(far(self.after[0]))
    }
}

/// Whether one of these instants is `t`, up to rounding.
fn is_at(instants: &[f64], t: f64) -> bool {
    let slack = 1e-9 * t.abs();
    instants.get(instants.partition_point(|instant| *instant < t - slack)).is_some_and(|instant| *instant <= t + slack)
}

fn slope(a: Point, b: Point) -> f64 {
    (b.1 - a.1) / (b.0 - a.0)
}

/// Second difference of three points, per s².
fn bend([a, b, c]: [Point; 3]) -> f64 {
    2.0 * (slope(b, c) - slope(a, b)) / (c.0 - a.0)
}

/// Whether the second difference at the middle of five points agrees within half with those at its neighbours.
fn is_smooth([a, b, c, d, e]: [Point; 5]) -> bool {
    let middle = bend([b, c, d]);
    let alike = |other: f64| (other - middle).abs() <= 0.5 * middle.abs();
    alike(bend([a, b, c])) && alike(bend([c, d, e]))
}

/// How far the parabola through three points rises above `peak` between two times.
fn above(points: [Point; 3], peak: Point, (from, to): (f64, f64)) -> f64 {
    let [a, b, _] = points;
    let bend = bend(points);
    if bend >= 0.0 {
        return 0.0;
    }
    let vertex = 0.5 * (a.0 + b.0) - slope(a, b) / bend;
    if vertex <= from || vertex >= to {
        return 0.0;
    }
    let height = a.1 + (vertex - a.0) * (slope(a, b) + 0.5 * bend * (vertex - b.0));
    (height - peak.1).max(0.0)
}

/// How far the signal may rise above `peak` before the next point `down`, extrapolated linearly from both sides. If the
/// two lines meet above, the signal has at most a kink: a concave signal stays below the lines. If the right line lies
/// below the peak, the signal jumps, and may have risen until the jump.
fn by_lines([before, peak, down, after]: [Point; 4]) -> f64 {
    let h = down.0 - peak.0;
    let (rise, back) = ((slope(before, peak) * h).max(0.0), -slope(down, after) * h);
    let drop = peak.1 - down.1;
    if back >= drop { rise * (back - drop) / (rise + back).max(f64::MIN_POSITIVE) } else { rise.min(drop - back) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Maximum of the samples and `unseen` for a signal sampled at 1 s, shifted by a fraction of a step.
    fn seen(course: impl Fn(f64) -> f64, shift: f64) -> (f64, f64) {
        let mut peak = Peak::greatest();
        (-10..=10).for_each(|k| {
            peak.see(f64::from(k), course(f64::from(k) + shift));
        });
        (peak.found().1, peak.unseen(&[]))
    }

    const SHIFTS: [f64; 9] = [-0.5, -0.4, -0.2, -0.1, 0.0, 0.13, 0.27, 0.4, 0.5];

    #[test]
    fn a_smooth_peak_is_estimated_closely() {
        for shift in SHIFTS {
            for (course, most) in [(&(|t: f64| -t * t) as &dyn Fn(f64) -> f64, 0.0), (&|t: f64| (0.4 * t).cos(), 1.0)] {
                let (found, unseen) = seen(course, shift);
                let lacks = most - found;
                assert!(lacks <= 1.3 * unseen + 1e-12 && unseen <= 1.3 * lacks + 1e-12, "{shift}: {lacks} {unseen}");
            }
        }
    }

    #[test]
    fn kinks_and_jumps_are_bounded() {
        let roof = |t: f64| if t < 0.0 { 2.0 * t } else { -3.0 * t };
        let ramp = |t: f64| if t <= 0.0 { 2.0 * t } else { -30.0 };
        let fall = |t: f64| if t < 0.0 { -30.0 } else { -0.7 * t };
        for shift in SHIFTS {
            for (name, course) in [("roof", &roof as &dyn Fn(f64) -> f64), ("ramp", &ramp), ("fall", &fall)] {
                let (found, unseen) = seen(course, shift);
                assert!(-found <= unseen + 1e-12 && unseen <= 3.0, "{name} {shift}: {found} {unseen}");
            }
        }
    }

    #[test]
    fn a_jump_at_a_known_instant_adds_no_error_before_it() {
        let mut peak = Peak::greatest();
        for (t, v) in [(1.0, 0.0), (2.0, 0.0), (3.0, 5.0), (4.0, 4.0), (5.0, 3.1)] {
            peak.see(t, v);
        }
        assert_eq!((peak.unseen(&[]), peak.unseen(&[2.0, 4.0]), peak.unseen(&[2.0, 3.0, 4.0])), (1.0, 1.0, 0.0));
    }

    #[test]
    fn a_held_value_has_no_unseen_extreme() {
        let held = |t: f64| (0.5 * (t / 4.0).floor()).sin();
        let level = |t: f64| t.clamp(-3.0, 3.0);
        assert_eq!([seen(held, 0.5).1, seen(level, 0.0).1, seen(|_| 7.0, 0.0).1], [0.0; 3]);
    }

    #[test]
    fn at_the_ends_the_parabola_of_three_points_decides() {
        // The vertex lies at 9.7, inside of the last step; at 10.2, outside of it.
        let (found, unseen) = seen(|t| -(t - 9.7) * (t - 9.7), 0.0);
        assert!((unseen + found).abs() < 1e-9 && unseen > 0.0, "{found} {unseen}");
        assert_eq!(seen(|t| -(t - 10.2) * (t - 10.2), 0.0).1, 0.0);
        assert_eq!((seen(|t| t, 0.0).1, seen(|t| -t, 0.0).1), (0.0, 0.0));
        let mut one = Peak::least();
        one.see(0.0, 5.0);
        assert_eq!((one.found(), one.unseen(&[]), one.gap()), ((0.0, 5.0), 0.0, 0.0));
    }
}
