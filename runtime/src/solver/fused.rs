//! The stiff step as one function of the model: the same method as [`rosenbrock`](super::rosenbrock), unrolled around it.
//!
//! In: a model that has it. Out: a [`Step`], its error, and surfaces on its way, from one call. The end of an accepted
//! step stays in the block as the start of the next.

use super::step::{Step, System};
use abi::trial::Trial;
use abi::{Function, Instance};

pub(crate) struct Fused {
    pub(crate) trial: Trial,
    /// Whether the start in the block is the present point.
    pub(crate) ready: bool,
}

/// How far a step is off, as parts of what is allowed.
pub(crate) struct Judged {
    /// By its estimated error. Not a number where the step is not.
    pub(crate) error: f64,
    /// By how it fails the equations at its end.
    pub(crate) defect: f64,
}

impl Fused {
    /// None of a model without that function.
    pub(crate) fn new(instance: &mut Instance, tol: f64, scales: &[f64]) -> Option<Fused> {
        let trial = Trial::of(&instance.description().layout).filter(|_| instance.has(Function::Rosenbrock))?;
        instance.set(trial.tol(), tol);
        instance.block_mut()[trial.scales().range()].copy_from_slice(scales);
        Some(Fused { trial, ready: false })
    }

    /// Makes (t, x) with these derivatives the start.
    pub(crate) fn begin(&mut self, system: &mut System, x: &[f64], f: &[f64], jacobian: &[f64]) {
        let from = self.trial.from();
        let block = system.instance.block_mut();
        block[from.states.range()].copy_from_slice(x);
        block[from.derivatives.range()].copy_from_slice(f);
        block[from.jacobian.range()].copy_from_slice(jacobian);
        self.ready = true;
    }

    /// Fills in the step from its `t`, `h` and `end`, and the slope at its end. None where a pivot is too small.
    pub(crate) fn attempt(&self, system: &mut System, step: &mut Step, end_slope: &mut [f64]) -> Option<Judged> {
        let trial = self.trial;
        let instance = &mut *system.instance;
        instance.set(trial.time(), step.t);
        instance.set(trial.step(), step.h);
        instance.set(trial.end(), step.end);
        let status = instance.call(Function::Rosenbrock);
        system.evaluations += 8;
        if status != 0 {
            return None;
        }
        let block = system.instance.block();
        let [k1, k2, k3] = trial.course();
        step.x1.copy_from_slice(&block[trial.to().states.range()]);
        step.error.copy_from_slice(&block[trial.error().range()]);
        step.k1.copy_from_slice(&block[k1.range()]);
        step.k2.copy_from_slice(&block[k2.range()]);
        step.k3.copy_from_slice(&block[k3.range()]);
        end_slope.copy_from_slice(&block[trial.to().derivatives.range()]);
        Some(Judged { error: block[trial.worst().index()], defect: block[trial.defect().index()] })
    }

    /// The end becomes the start.
    pub(crate) fn go_on(&mut self, system: &mut System) {
        let (from, to) = (self.trial.from().whole(), self.trial.to().whole());
        system.instance.block_mut().copy_within(to.range(), from.start as usize);
        self.ready = true;
    }

    /// The Jacobian at the start: ∂f/∂x, then ∂f/∂t.
    pub(crate) fn jacobian<'a>(&self, system: &'a System) -> &'a [f64] {
        &system.instance.block()[self.trial.from().jacobian.range()]
    }

    /// Values of the surfaces in the middle of the last attempt and at its end.
    pub(crate) fn surfaces<'a>(&self, system: &'a System) -> [&'a [f64]; 2] {
        [self.trial.middle(), self.trial.last()].map(|segment| &system.instance.block()[segment.range()])
    }
}
