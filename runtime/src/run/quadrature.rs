//! Integrals of a sampled signal.
//!
//! In: points in order of time. Out: the trapezoidal sum with compensated summation, and its end corrections where
//! points are equidistant. Knows no windows.

use crate::run::peak::Point;
use crate::stretch::in_vectors;

/// A sequence of equidistant points: its first and last values, for Gregory's end corrections, which raise the
/// trapezoidal rule to order four,
///
///   h/12 (Δf_0 − ∇f_n) − h/24 (Δ²f_0 + ∇²f_n).
#[derive(Default)]
pub(crate) struct Even {
    step: f64,
    last: f64,
    points: u64,
    head: [f64; 3],
    tail: [f64; 3],
}

impl Even {
    /// Adds a point. If it ends a sequence, returns the correction of that sequence.
    pub(crate) fn push(&mut self, t: f64, v: f64) -> Option<f64> {
        let step = t - self.last;
        let goes_on = match self.points {
            0 => true,
            1 => step > 0.0,
            _ => is_even(step, self.step, t),
        };
        let correction = if goes_on { None } else { Some(self.correction()) };
        if !goes_on {
            // The last point begins the next sequence, unless the signal jumps there.
            let from = self.tail[2];
            self.points = u64::from(step > 0.0);
            self.head[0] = from;
            self.tail = [from; 3];
        }
        if self.points == 1 {
            self.step = step;
        }
        if self.points < 3 {
            self.head[self.points as usize] = v;
        }
        self.tail = [self.tail[1], self.tail[2], v];
        self.points += 1;
        self.last = t;
        correction
    }

    /// Whether these times in s continue the sequence, so that adding their points gives no correction.
    pub(crate) fn goes_on(&self, times: &[f64]) -> bool {
        match times {
            [] => true,
            [first, ..] => {
                self.points >= 3 && is_even(first - self.last, self.step, *first) && are_even(times, self.step)
            }
        }
    }

    /// Adds points that [continue](Even::goes_on) the sequence: the time of the last one in s, and how many there are;
    /// `last` are the values of the last ones, at least of three or of all.
    pub(crate) fn push_all(&mut self, t: f64, points: usize, last: impl Iterator<Item = f64>) {
        last.for_each(|v| self.tail = [self.tail[1], self.tail[2], v]);
        self.points += points as u64;
        self.last = t;
    }

    /// The end correction of the sequence so far; 0 for fewer than five points.
    pub(crate) fn correction(&self) -> f64 {
        if self.points < 5 {
            return 0.0;
        }
        let ([a, b, c], [x, y, z]) = (self.head, self.tail);
        self.step / 12.0 * ((b - a) - (z - y)) - self.step / 24.0 * ((a - 2.0 * b + c) + (x - 2.0 * y + z))
    }
}

/// Whether the distance of two points is that of the others. Times are multiples of the step, rounded independently.
fn is_even(step: f64, others: f64, t: f64) -> bool {
    (step - others).abs() <= 1e-9 * others + 8.0 * f64::EPSILON * t.abs()
}

in_vectors! {
    /// Whether all these times in s have this distance. A loop without branches.
    fn are_even(times: &[f64], step: f64) -> bool {
        times.iter().zip(&times[1..]).fold(true, |all, (last, t)| all & is_even(t - last, step, *t))
    }
}

/// A compensated sum (Neumaier, 1974): rounding errors stay negligible over ten million steps.
#[derive(Default, Clone, Copy)]
pub(crate) struct Sum {
    sum: f64,
    lost: f64,
}

impl Sum {
    pub(crate) fn add(&mut self, term: f64) {
        let sum = self.sum + term;
        self.lost += if self.sum.abs() >= term.abs() { (self.sum - sum) + term } else { (term - sum) + self.sum };
        self.sum = sum;
    }

    pub(crate) fn total(&self) -> f64 {
        self.sum + self.lost
    }
}

/// The area between two points below the straight line through their values, or through the squares of these.
// Else it would not be part of the functions that are compiled for vectors.
#[inline(always)]
pub(crate) fn trapezoid(from: Point, to: Point, square: bool) -> f64 {
    let of = |v: f64| if square { v * v } else { v };
    0.5 * (of(from.1) + of(to.1)) * (to.0 - from.0)
}

/// A compensated sum of many terms, in partial sums that take turns: vectors add to several at once.
#[derive(Default, Clone, Copy)]
pub(crate) struct Sums {
    parts: [Sum; PARTS],
    /// Whose turn it is.
    next: usize,
}

const PARTS: usize = 8;

impl Sums {
    pub(crate) fn add(&mut self, term: f64) {
        self.parts[self.next].add(term);
        self.next = (self.next + 1) % PARTS;
    }

    /// Adds the [areas](trapezoid) between consecutive points, the first of which is `from`, as [`add`](Sums::add) does one
    /// after the other.
    pub(crate) fn add_trapezoids(&mut self, from: Point, times: &[f64], values: &[f64], square: bool) {
        let len = times.len();
        let at = |k: usize| (times[k], values[k]);
        let term = |k: usize| trapezoid(if k == 0 { from } else { at(k - 1) }, at(k), square);
        // Up to the first point and to the turn of the first part; then eight at a time, and the others.
        let head = len.min(1 + (2 * PARTS - 1 - self.next) % PARTS);
        (0..head).for_each(|k| self.add(term(k)));
        if head > 0 {
            let eights = (len - head) / PARTS * PARTS;
            add_in_turn(&mut self.parts, &times[head - 1..][..=eights], &values[head - 1..][..=eights], square);
            (head + eights..len).for_each(|k| self.add(term(k)));
        }
    }

    pub(crate) fn total(&self) -> f64 {
        let mut all = Sum::default();
        self.parts.iter().for_each(|part| all.add(part.total()));
        all.total()
    }
}

in_vectors! {
    /// Adds the trapezoids between consecutive points to the parts in turn; their number is a multiple of that of the parts.
    fn add_in_turn(parts: &mut [Sum; PARTS], times: &[f64], values: &[f64], square: bool) {
        let before = times.as_chunks::<PARTS>().0.iter().zip(values.as_chunks::<PARTS>().0);
        let here = times[1..].as_chunks::<PARTS>().0.iter().zip(values[1..].as_chunks::<PARTS>().0);
        for ((t0, v0), (t, v)) in before.zip(here) {
            for k in 0..PARTS {
                parts[k].add(trapezoid((t0[k], v0[k]), (t[k], v[k]), square));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_million_points_sum_without_rounding_error() {
        let mut sum = Sum::default();
        (0..10_000_000).for_each(|_| sum.add(0.1));
        assert_eq!(sum.total(), 1_000_000.0);
        let mut sums = Sums::default();
        (0..10_000_000).for_each(|_| sums.add(0.1));
        assert_eq!(sums.total(), 1_000_000.0);
    }
}
