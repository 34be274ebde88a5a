//! Where the numbers of one adaptive step lie, as `Function::Rosenbrock` reads and writes them.
//!
//! The step goes from (t, x0) over h; between its ends its states are
//!
//!   x(t + θh) = x0 + θ (x1 − x0) + θ (1 − θ) (k1 + θ (k2 + θ k3))
//!
//! Everything but the first five entries is written by the function. A step that is accepted becomes the start of the
//! next: [`Trial::to`] is copied to [`Trial::from`], which has the same order.

use crate::description::{Layout, Segment, Slot};

/// The segment `trial` of a layout, by its parts.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Trial {
    start: u32,
    states: u32,
    roots: u32,
}

/// States, their derivatives and the Jacobian at one point: n, n and n² + n numbers, one behind the other.
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
    /// All of it.
    pub fn whole(self) -> Segment {
        let len = self.states.len + self.derivatives.len + self.jacobian.len;
        Segment { start: self.states.start, len }
    }
}

impl Layout {
    /// The same with room for a trial step behind all else.
    pub fn with_trial(mut self) -> Layout {
        let trial = Trial { start: self.size() as u32, states: self.states.len, roots: self.roots.len };
        self.trial = Segment { start: trial.start, len: trial.len() };
        self
    }
}

impl Trial {
    /// None of a layout without room for it.
    pub fn of(layout: &Layout) -> Option<Trial> {
        let trial = Trial { start: layout.trial.start, states: layout.states.len, roots: layout.roots.len };
        (layout.trial.len > 0).then_some(trial)
    }

    /// Number of slots.
    fn len(self) -> u32 {
        self.defect().0 + 1 - self.start
    }

    /// t in s, read.
    pub fn time(self) -> Slot {
        Slot(self.start)
    }

    /// h in s, read.
    pub fn step(self) -> Slot {
        Slot(self.start + 1)
    }

    /// Where the last stages are evaluated: t + h, or just before it if a signal has a corner there; read.
    pub fn end(self) -> Slot {
        Slot(self.start + 2)
    }

    /// Relative tolerance, read.
    pub fn tol(self) -> Slot {
        Slot(self.start + 3)
    }

    /// For each state, what its size is measured with: tol · (|x| + s) is allowed. SI, read.
    pub fn scales(self) -> Segment {
        Segment { start: self.start + 4, len: self.states }
    }

    /// The start, read.
    pub fn from(self) -> Point {
        self.point(end(self.scales()))
    }

    /// The end.
    pub fn to(self) -> Point {
        self.point(end(self.from().whole()))
    }

    /// k1, k2, k3 of the course between.
    pub fn course(self) -> [Segment; 3] {
        let start = end(self.to().whole());
        [0, 1, 2].map(|k| Segment { start: start + k * self.states, len: self.states })
    }

    /// Estimated error of each state, SI.
    pub fn error(self) -> Segment {
        Segment { start: end(self.course()[2]), len: self.states }
    }

    /// Switching surfaces at θ = 1/2.
    pub fn middle(self) -> Segment {
        Segment { start: end(self.error()), len: self.roots }
    }

    /// Switching surfaces at the end.
    pub fn last(self) -> Segment {
        Segment { start: end(self.middle()), len: self.roots }
    }

    /// Largest error as a part of what is allowed; NaN if anything at the end is not finite.
    pub fn worst(self) -> Slot {
        Slot(end(self.last()))
    }

    /// By how much the course fails the equations at its end, gathered over the fastest time the Jacobian knows, as a
    /// part of what is allowed.
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
        let layout = Layout::new([2, 0, 3, 1, 1, 4, 3, 2, 12, 1]).with_trial();
        let trial = Trial::of(&layout).unwrap();
        let one = |slot: Slot| Segment { start: slot.0, len: 1 };
        let mut parts = vec![one(trial.time()), one(trial.step()), one(trial.end()), one(trial.tol()), trial.scales()];
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
