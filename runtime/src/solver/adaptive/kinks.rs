//! Handles steps that cross a surface where derivatives jump or have a kink: decides whether the step is repeated, and
//! up to where.

use super::{Adaptive, MOST_AIMS, SOON, Step, copy};
use crate::solver::surfaces::Crossing;

/// A deviation that does not matter, in allowed errors.
const NEGLIGIBLE: f64 = 0.1;

impl Adaptive {
    /// Whether the step is repeated because of a surface that it crosses; and whether it crosses any.
    pub(super) fn is_made_again(&mut self) -> (bool, bool) {
        let (mut from, mut again, mut met, mut inside) = (0.0, false, false, false);
        while let Some(crossing) = self.surfaces.first(&mut self.system, &self.step, from) {
            (met, inside) = (true, inside || crossing.near > 0.0);
            let jump = self.jump(crossing);
            let decided = self.surfaces.decided();
            // Passing through a surface at which nothing jumps is not chattering.
            if jump > 0.0 || decided {
                self.meet(1)
            } else {
                self.crossings = 0
            }
            // A surface left at the very start needs no other step, unless the Jacobian there still belongs to the old
            // side.
            if crossing.near > 0.0 && self.shorten(crossing, jump) {
                again = true;
                break;
            }
            if jump > 0.0 || decided {
                break;
            }
            self.surfaces.pass(true);
            from = crossing.far;
        }
        self.surfaces.again();
        if !again && !inside && self.hides() {
            self.suspect = self.step.t + self.step.h;
            self.h = 0.5 * self.step.h;
            self.retake();
            again = true;
        }
        (again, met)
    }

    /// Whether a stiff step ends on the old side of a surface although a stage was on the new side, where possibly
    /// nothing holds the states any longer.
    ///
    /// The stages are damped by the Jacobian at the start, and so is the estimated error: a contact that holds with 1e6
    /// N·s/m up to its stiction would hold a mass for ever within the tolerance of its speed. Where that is possible,
    /// the step is too long. It is shortened until it resolves the time constants of the Jacobian, because its error is
    /// then no longer damped.
    fn hides(&mut self) -> bool {
        if !self.was_stiff || !self.surfaces.any() || (self.was_fused && !self.met) {
            return false;
        }
        let (n, h) = (self.system.n, self.step.h);
        self.know_jacobian();
        let resolved = 1.0 / (h * h);
        if self.entries.fastest(&self.jacobian, 0.0) <= resolved || h <= 64.0 * f64::EPSILON * self.t {
            return false;
        }
        if self.was_fused {
            let mut same = Step::new(n);
            (same.t, same.h, same.end) = (self.step.t, h, self.step.end);
            copy(&self.step.x0, &mut same.x0);
            copy(&self.step.f0, &mut same.f0);
            if !self.rosenbrock.attempt(&mut self.system, &mut same, &self.jacobian) {
                return false;
            }
        }
        let arguments: Vec<(f64, Vec<f64>)> =
            self.rosenbrock.arguments(&self.step).map(|(t, x)| (t, x.to_vec())).collect();
        arguments.iter().any(|(t, x)| self.surfaces.turned(&mut self.system, *t, x) && self.lets_go(*t, x))
    }

    /// Whether a surface on the straight line to a stage's point has a jump or kink in the derivatives that is large
    /// enough to move a state by more than the allowed error within the response time of the states there.
    fn lets_go(&mut self, t: f64, x: &[f64]) -> bool {
        // Short relative to curvature, long relative to rounding errors.
        const WIDTH: f64 = 1e-4;
        let n = self.system.n;
        let (t0, x0) = (self.step.t, self.step.x0.clone());
        let point = |part: f64| {
            let x: Vec<f64> = x0.iter().zip(x).map(|(from, to)| from + part * (to - from)).collect();
            (t0 + part * (t - t0), x)
        };
        let (mut near, mut far) = (0.0, 1.0);
        for _ in 0..24 {
            let (t, x) = point(0.5 * (near + far));
            let turned = self.surfaces.turned(&mut self.system, t, &x);
            *(if turned { &mut far } else { &mut near }) = 0.5 * (near + far);
        }
        let mut slope = |part: f64| {
            let ((t, x), mut f) = (point(part), vec![0.0; n]);
            self.system.slope(t, &x, &mut f);
            f
        };
        let (width, back) = (WIDTH.min(1.0 - far), WIDTH.min(near));
        let [after, soon, beyond] = [0.0, 0.5, 1.0].map(|part| slope(far + part * width));
        let [before, lately, earlier] = [0.0, 0.5, 1.0].map(|part| slope(near - part * back));
        let f = slope(1.0);
        let mut jacobian = vec![0.0; self.jacobian.len()];
        self.system.jacobian(t, x, &f, &self.units, &mut jacobian);
        let answer = (1.0 / self.entries.fastest(&jacobian, 0.0).sqrt()).min(self.duration);
        let moves = |i: usize| {
            let rise = |a: f64, b: f64, width: f64| if width > 0.0 { (b - a) / width } else { 0.0 };
            // If the step starts on the surface, there is no interval before it: use the Jacobian there.
            let known = || {
                let row = (0..n).map(|j| self.jacobian[i * n + j] * (x[j] - x0[j]));
                row.sum::<f64>() + self.jacobian[n * n + i] * (t - t0)
            };
            let old = |earlier: f64, part: f64| match back > 0.0 || self.entries.coupled().is_some() {
                true => rise(earlier, before[i], part * back),
                false => known(),
            };
            let wide = rise(after[i], beyond[i], width) - old(earlier[i], 1.0);
            let narrow = rise(after[i], soon[i], 0.5 * width) - old(lately[i], 0.5);
            // With curvature, the change of slope halves over half the distance; at a kink it does not.
            let bend = if narrow.abs() > 4.0 * (wide - narrow).abs() { narrow } else { 0.0 };
            let drift = (far - near) * old(lately[i], 0.5);
            let jump = after[i] - before[i] - drift;
            let jump = if jump.abs() > 4.0 * drift.abs() { jump } else { 0.0 };
            (jump + bend * (1.0 - far)).abs() * answer > self.allowed(i)
        };
        (0..n).any(moves)
    }

    /// A condition is decided by the last bit of the states. Where one may change, the step is repeated so that it ends
    /// just before, and the next one is as short as the bracket. So no stage evaluated beyond the condition moves a
    /// state by more than a rounding error: a body at rest is exactly at rest when it breaks away.
    pub(super) fn ends_before_condition(&mut self) -> bool {
        if !self.surfaces.has_conditions() {
            return false;
        }
        let mut from = 0.0;
        let mut ends = false;
        self.surfaces.only_conditions = true;
        while let Some(crossing) = self.surfaces.first(&mut self.system, &self.step, from) {
            let (h, width) = (self.step.h, (crossing.far - crossing.near) * self.step.h);
            let shorter = crossing.near * h - 2.0 * width;
            let aimed = self.surfaces.changed().map(|surface| self.aimed[surface]).min().unwrap_or(0);
            if aimed < MOST_AIMS && shorter + 12.0 * width < h && shorter > 64.0 * f64::EPSILON * self.t {
                (self.h, self.creep) = (shorter, 6.0 * width);
                self.surfaces.changed().for_each(|surface| self.aimed[surface] += 1);
                self.usual.get_or_insert(h);
                self.retake();
                ends = true;
                break;
            }
            // A condition that is left at the very start, or crossed at the very end, needs no other step.
            self.surfaces.pass(true);
            from = crossing.far;
        }
        self.surfaces.only_conditions = false;
        self.surfaces.again();
        ends
    }

    /// Undoes a step that is to be repeated.
    pub(super) fn retake(&mut self) {
        self.last = None;
        self.work.steps -= 1;
        self.work.stiff_steps -= u64::from(self.was_stiff);
        self.work.rejected += 1;
    }

    /// Stages beyond a surface at which derivatives jump or have a kink spoil a step even if its estimated error is
    /// small. Where that could matter, the step is repeated: for a jump it ends just before, and the next one is short
    /// enough not to matter; for a kink it ends so little after it that the kink cannot matter.
    pub(super) fn shorten(&mut self, crossing: Crossing, jump: f64) -> bool {
        let h = self.step.h;
        let (to, behind) = (crossing.near * h, (1.0 - crossing.near) * h);
        let (shorter, creep) = if jump > 0.0 {
            if jump * behind <= NEGLIGIBLE {
                return false;
            }
            // Not within the bracket, where the location is unknown.
            let margin = (0.05 / jump).max(4.0 * (crossing.far - crossing.near) * h);
            if to > 2.0 * margin { (to - margin, 2.0 * margin) } else { (to + margin, f64::INFINITY) }
        } else {
            if self.bent.take() == Some(self.attempts()) {
                return false;
            }
            let bend = self.bend(crossing);
            if 0.5 * bend * behind * behind <= NEGLIGIBLE {
                return false;
            }
            (to + (NEGLIGIBLE / bend).sqrt(), f64::INFINITY)
        };
        if shorter > 0.99 * h || shorter < 64.0 * f64::EPSILON * self.t {
            return false;
        }
        (self.h, self.creep) = (shorter, creep);
        self.retake();
        self.bent = (jump == 0.0).then_some(self.attempts() + 1);
        true
    }

    /// The jump of the derivatives at a crossing, in error tolerances of their states per second; 0 if it is less than
    /// their own tolerance, or comparable to their change beside the crossing in the same time.
    pub(super) fn jump(&mut self, crossing: Crossing) -> f64 {
        if self.surfaces.bend() {
            return 0.0;
        }
        let n = self.system.n;
        let width = crossing.far - crossing.near;
        let beside = [crossing.near - width, crossing.near, crossing.far, crossing.far + width];
        for (theta, f) in beside.into_iter().zip(self.slopes.chunks_exact_mut(n.max(1))) {
            self.step.at(theta, &mut self.beside);
            self.system.slope(self.step.time(theta), &self.beside, f);
        }
        let mut rate = 0.0f64;
        for (i, s) in self.scales.iter().enumerate() {
            let [before, near, far, after] = [0, 1, 2, 3].map(|row| self.slopes[row * n + i]);
            let jump = (far - near).abs();
            // The polynomial is not valid outside its step.
            let earlier = if beside[0] >= 0.0 { (near - before).abs() } else { 0.0 };
            let later = if beside[3] <= 1.0 { (after - far).abs() } else { 0.0 };
            let drift = earlier.max(later);
            if jump > self.tol * (near.abs() + s) && jump > 4.0 * drift {
                rate = rate.max(jump / (self.tol * (self.step.x0[i].abs() + s)));
            }
        }
        rate
    }

    /// Whether each surface of a crossing had an event just before, and the jump cannot move a state by more than a tenth
    /// of the allowed error within the rest of the step. It then needs no event.
    ///
    /// A state that rests on a surface, such as a slider on its yield surface, is beside it by a rounding error. A step
    /// that reaches beyond another surface, at which the slider is released, bends its polynomial by less than the
    /// allowed error, and yet across the first surface. Events there would repeat until the release.
    pub(super) fn repeats_without_effect(&self, crossing: Crossing, jump: f64) -> bool {
        let recent = self.step.time(crossing.far) - SOON * self.duration;
        self.surfaces.changed().all(|surface| self.last_events[surface] > recent)
            && jump * (1.0 - crossing.near) * self.step.h <= NEGLIGIBLE
    }

    /// The jump in the rates of the derivatives (a kink) at a crossing, in error tolerances of their states per
    /// second².
    pub(super) fn bend(&mut self, crossing: Crossing) -> f64 {
        // Long relative to rounding errors, short relative to the curvature beside the surface.
        const WIDTH: f64 = 1e-6;
        let n = self.system.n;
        let ahead = [crossing.far, crossing.far + WIDTH, crossing.near, crossing.near - WIDTH];
        for (theta, f) in ahead.into_iter().zip(self.slopes.chunks_exact_mut(n.max(1))) {
            self.step.at(theta, &mut self.beside);
            self.system.slope(self.step.time(theta), &self.beside, f);
        }
        let rate = |i: usize| {
            let [far, after, near, before] = [0, 1, 2, 3].map(|row| self.slopes[row * n + i]);
            let change = ((after - far) - (near - before)).abs();
            change / (WIDTH * self.step.h * self.tol * (self.step.x0[i].abs() + self.scales[i]))
        };
        (0..n).map(rate).fold(0.0, f64::max)
    }
}
