//! The layout of adaptive steps in the block, as `Function::Rosenbrock` reads and writes them.
//!
//! A step goes from (t, x0) over h. Between its ends, the states are
//!
//!   x(t + θh) = x0 + θ (x1 − x0) + θ (1 − θ) (k1 + θ (k2 + θ k3))
//!
//! A call makes up to `count` trials. The function settles a trial without events by itself: it accepts it, so that its
//! end becomes the next start, or rejects it for its error; in both cases it chooses the next step length. At the first
//! other trial, or at every trial if the caller attends, the call ends with the status [`LOOK`] or [`PIVOT`]. That
//! trial is not settled, and its data remain available. A caller that accepts it copies [`Trial::to`] to
//! [`Trial::from`], which has the same order.

use crate::description::{Layout, Segment, Slot};

/// Status: the elimination met a pivot that is too small; the trial is invalid.
pub const PIVOT: u64 = 1;

/// Status: the caller must look at the trial. It is accurate and crosses a switching surface or comes close to one,
/// reaches a stop or a watched instant, or leaves a range; or it repeatedly crosses a surface, is not finite, or the
/// caller attends.
pub const LOOK: u64 = 2;

/// The parts of the segment `trial` of a layout.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Trial {
    start: u32,
    states: u32,
    roots: u32,
    guards: u32,
}

/// Number of entries before the first segment.
const SINGLE: u32 = 18;

/// States, their derivatives and the Jacobian at one point: n, n and n² + n consecutive numbers.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Point {
    /// x
    pub states: Segment,
    /// dx/dt
    pub derivatives: Segment,
    /// ∂f/∂x, row-major, then ∂f/∂t.
    pub jacobian: Segment,
}

impl Point {
    /// The three segments as one.
    pub fn whole(self) -> Segment {
        let len = self.states.len + self.derivatives.len + self.jacobian.len;
        Segment { start: self.states.start, len }
    }
}

impl Layout {
    /// The same layout with room for a trial step at the end. `guards`: number of guards of the model.
    pub fn with_trial(mut self, guards: u32) -> Layout {
        let trial = Trial { start: self.size() as u32, states: self.states.len, roots: self.roots.len, guards };
        self.trial = Segment { start: trial.start, len: trial.len() };
        self
    }
}

impl Trial {
    /// `None` if the layout has no room for it.
    pub fn of(layout: &Layout) -> Option<Trial> {
        let trial = Trial { start: layout.trial.start, states: layout.states.len, roots: layout.roots.len, guards: 0 };
        let bounds = layout.trial.len.checked_sub(trial.len())?;
        (bounds % 2 == 0).then_some(Trial { guards: bounds / 2, ..trial })
    }

    /// Number of slots.
    fn len(self) -> u32 {
        self.defect().0 + 1 - self.start
    }

    /// The entries before the first segment: the state of the run and the results of the trial.
    pub fn single(self) -> Segment {
        Segment { start: self.start, len: SINGLE }
    }

    /// t in s, read and written.
    pub fn time(self) -> Slot {
        Slot(self.start)
    }

    /// Length of the next step in s, as far as the error permits it; read and written.
    pub fn next(self) -> Slot {
        Slot(self.start + 1)
    }

    /// Length of the last accepted step in s, 0 if there was none since a restart; read and written.
    pub fn last_step(self) -> Slot {
        Slot(self.start + 2)
    }

    /// The fifth root of the error of the last accepted step; read and written.
    pub fn last_root(self) -> Slot {
        Slot(self.start + 3)
    }

    /// Number of trials rejected since the last accepted one; read and written.
    pub fn rejected(self) -> Slot {
        Slot(self.start + 4)
    }

    /// Number of steps accepted so far; read and written.
    pub fn accepted(self) -> Slot {
        Slot(self.start + 5)
    }

    /// Number of trials that the function itself rejected; read and written.
    pub fn refused(self) -> Slot {
        Slot(self.start + 6)
    }

    /// The next stop: an instant that a step must reach exactly, in s; read.
    pub fn stop(self) -> Slot {
        Slot(self.start + 7)
    }

    /// The instant just before the stop, in s, at which the last stages of a step that ends there are evaluated:
    /// signals that jump at the stop have not jumped yet. Read.
    pub fn before_stop(self) -> Slot {
        Slot(self.start + 8)
    }

    /// The longest permitted step, in s; read.
    pub fn longest(self) -> Slot {
        Slot(self.start + 9)
    }

    /// The caller must look at a step that ends at or after this instant; in s, infinite if there is none; read.
    pub fn watched(self) -> Slot {
        Slot(self.start + 10)
    }

    /// 1 if the caller must look at every trial, otherwise 0; read.
    pub fn attend(self) -> Slot {
        Slot(self.start + 11)
    }

    /// Relative tolerance; read.
    pub fn tol(self) -> Slot {
        Slot(self.start + 12)
    }

    /// Length of the trial in s.
    pub fn step(self) -> Slot {
        Slot(self.start + 13)
    }

    /// The time of its last stages: t + h, or `before_stop`.
    pub fn end(self) -> Slot {
        Slot(self.start + 14)
    }

    /// 1 if the trial crosses a switching surface or comes close to one, otherwise 0.
    pub fn met(self) -> Slot {
        Slot(self.start + 15)
    }

    /// 1 if a guard fails at the end, otherwise 0.
    pub fn outside(self) -> Slot {
        Slot(self.start + 16)
    }

    /// Number of trials that ended beyond a switching surface and that the function itself rejected; read and written.
    pub fn overruns(self) -> Slot {
        Slot(self.start + 17)
    }

    /// For each state, the scale s of its error: tol · (|x| + s) is permitted. s is half the width of its declared
    /// range, or the largest |x| so far. SI, read and written.
    pub fn scales(self) -> Segment {
        Segment { start: self.start + SINGLE, len: self.states }
    }

    /// For each guard the smallest value that passes; SI, read.
    pub fn lows(self) -> Segment {
        Segment { start: end(self.scales()), len: self.guards }
    }

    /// For each guard the largest value that passes; SI, read.
    pub fn highs(self) -> Segment {
        Segment { start: end(self.lows()), len: self.guards }
    }

    /// The side of each switching surface: −1 or 1, or 0 on it; read.
    pub fn sides(self) -> Segment {
        Segment { start: end(self.highs()), len: self.roots }
    }

    /// Switching functions at the start; read and written.
    pub fn here(self) -> Segment {
        Segment { start: end(self.sides()), len: self.roots }
    }

    /// The start point; read and written.
    pub fn from(self) -> Point {
        self.point(end(self.here()))
    }

    /// The end point.
    pub fn to(self) -> Point {
        self.point(end(self.from().whole()))
    }

    /// k1, k2, k3 of the continuous extension.
    pub fn course(self) -> [Segment; 3] {
        let start = end(self.to().whole());
        [0, 1, 2].map(|k| Segment { start: start + k * self.states, len: self.states })
    }

    /// Estimated error of each state, SI.
    pub fn error(self) -> Segment {
        Segment { start: end(self.course()[2]), len: self.states }
    }

    /// Switching functions at θ = 1/2.
    pub fn middle(self) -> Segment {
        Segment { start: end(self.error()), len: self.roots }
    }

    /// Switching functions at the end.
    pub fn last(self) -> Segment {
        Segment { start: end(self.middle()), len: self.roots }
    }

    /// Largest ratio of error to permitted error; NaN if a value at the end is not finite.
    pub fn worst(self) -> Slot {
        Slot(end(self.last()))
    }

    /// The defect of the continuous extension at the end, accumulated over the shortest time constant of the Jacobian,
    /// as a ratio to the permitted error.
    pub fn defect(self) -> Slot {
        Slot(end(self.last()) + 1)
    }

    fn point(self, start: u32) -> Point {
        let n = self.states;
        Point {
            states: Segment { start, len: n },
            derivatives: Segment { start: start + n, len: n },
            jacobian: Segment { start: start + 2 * n, len: n * n + n },
        }
    }
}

fn end(segment: Segment) -> u32 {
    segment.start + segment.len
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_fill_the_segment_without_overlap() {
        let layout = Layout::new([2, 0, 3, 1, 1, 4, 3, 2, 12, 1]).with_trial(3);
        let trial = Trial::of(&layout).unwrap();
        let one = |slot: Slot| Segment { start: slot.0, len: 1 };
        let mut parts: Vec<Segment> = [
            trial.time(),
            trial.next(),
            trial.last_step(),
            trial.last_root(),
            trial.rejected(),
            trial.accepted(),
            trial.refused(),
            trial.stop(),
            trial.before_stop(),
            trial.longest(),
            trial.watched(),
            trial.attend(),
            trial.tol(),
            trial.step(),
            trial.end(),
            trial.met(),
            trial.outside(),
            trial.overruns(),
        ]
        .map(one)
        .into();
        parts.extend([trial.scales(), trial.lows(), trial.highs(), trial.sides(), trial.here()]);
        for point in [trial.from(), trial.to()] {
            parts.extend([point.states, point.derivatives, point.jacobian]);
        }
        parts.extend(trial.course());
        parts.extend([trial.error(), trial.middle(), trial.last(), one(trial.worst()), one(trial.defect())]);
        let mut next = layout.due.start + layout.due.len;
        for part in parts {
            assert_eq!(part.start, next);
            next = end(part);
        }
        assert_eq!(next as usize, layout.size());
        assert_eq!(Trial::of(&Layout::new([0; 10])), None);
    }
}
