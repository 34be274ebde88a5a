//! Stiff steps as one compiled function of the model: the same method as [`rosenbrock`](super::rosenbrock), unrolled
//! around the model's equations.
//!
//! In: a model with this function, and the state of the run. Out: steps that the function has completed by itself, and
//! one that needs attention: a [`Step`], its error, and surfaces that it meets. The end of an accepted step stays in
//! the block as the start of the next.

use super::step::{Step, System, copy};
use abi::description::Segment;
use abi::rosenbrock::layout::{PIVOT, Trial};
use abi::{Function, Instance, Slot};
use std::ops::Range;

pub(crate) struct Fused {
    pub(crate) trial: Trial,
    /// Ranges of the block that the function reads, those that completed steps write, and all that it writes.
    read: [Range<usize>; 2],
    settled: [Range<usize>; 2],
    written: Range<usize>,
    /// Whether the start in the block is the present point.
    pub(crate) ready: bool,
}

/// The progress of a run, and the data for the choice of its next step.
#[derive(Clone, Copy)]
pub(crate) struct Pace {
    pub(crate) t: f64,
    /// Requested length of the next step, in s.
    pub(crate) next: f64,
    /// Length of the last accepted step, and the fifth root of its error; none after a restart.
    pub(crate) last: Option<(f64, f64)>,
    /// Attempts rejected since the last accepted one.
    pub(crate) rejected: u64,
    /// Steps accepted so far.
    pub(crate) accepted: u64,
}

/// Errors of a step, relative to the allowed ones.
pub(crate) struct Judged {
    /// The estimated error. NaN if the step is not finite.
    pub(crate) error: f64,
    /// The residual of the equations at its end.
    pub(crate) defect: f64,
    /// Whether it crosses a surface or comes close to one.
    pub(crate) met: bool,
    /// Whether a quantity is out of range at its end.
    pub(crate) outside: bool,
}

/// The trials of some calls, as far as observers need them: column by column, after each call.
pub(crate) struct Settled {
    /// The slots of the columns.
    pub(crate) slots: Vec<Slot>,
    /// Number of calls.
    pub(crate) calls: usize,
    columns: Vec<f64>,
}

impl Settled {
    pub(crate) fn new(trial: Trial) -> Settled {
        let [k1, k2, k3] = trial.course();
        let course = [trial.to().states, k1, k2, k3].into_iter().flat_map(|segment| segment.range());
        let single = [trial.accepted(), trial.time(), trial.step(), trial.end()];
        let slots = single.into_iter().chain(course.map(|slot| Slot(slot as u32))).collect();
        Settled { slots, calls: 0, columns: Vec::new() }
    }

    /// Replaces the trials by those of so many calls. `column` writes the values of the slot with a given number.
    pub(crate) fn read(&mut self, calls: usize, column: &dyn Fn(usize, &mut [f64])) {
        self.calls = calls;
        self.columns.resize(calls * self.slots.len(), 0.0);
        self.columns.chunks_exact_mut(calls).enumerate().for_each(|(slot, values)| column(slot, values));
    }

    /// Number of steps that had been accepted after a call.
    pub(crate) fn accepted(&self, call: usize) -> u64 {
        self.columns[call] as u64
    }

    /// Writes the step that a call has accepted, apart from its start, and returns the time of its end in s.
    pub(crate) fn step(&self, call: usize, step: &mut Step) -> f64 {
        let mut values = self.columns[call..].iter().step_by(self.calls).skip(1);
        let mut next = || *values.next().expect("a column for each slot");
        let reached = next();
        (step.h, step.end) = (next(), next());
        for part in [&mut step.x1, &mut step.k1, &mut step.k2, &mut step.k3] {
            part.iter_mut().for_each(|value| *value = next());
        }
        reached
    }
}

impl Fused {
    /// None for a model without that function. `fine`: for each guard the least and the greatest value.
    pub(crate) fn new(instance: &mut Instance, tol: f64, fine: &[(f64, f64)]) -> Option<Fused> {
        let trial = Trial::of(&instance.description().layout).filter(|_| instance.has(Function::Rosenbrock))?;
        instance.set(trial.tol(), tol);
        let block = instance.block_mut();
        for ((low, high), (least, greatest)) in trial.lows().range().zip(trial.highs().range()).zip(fine) {
            (block[low], block[high]) = (*least, *greatest);
        }
        let (from, last) = (trial.from().whole().range(), trial.defect().index() + 1);
        // Includes the scales, which grow with the states.
        let single = trial.single().range().start..trial.scales().range().end;
        Some(Fused {
            trial,
            read: [single.clone(), trial.sides().range().start..from.end],
            settled: [single.clone(), trial.here().range().start..from.end],
            written: single.start..last,
            ready: false,
        })
    }

    /// Ranges of the block that the preparation of an attempt may have changed.
    pub(crate) fn given(&self) -> &[Range<usize>] {
        &self.read
    }

    /// Copies the results of attempts with this status from the block on which they were made.
    pub(crate) fn fetch(&self, status: u64, block: &mut [f64], from: &dyn Fn(Range<usize>, &mut [f64])) {
        match status {
            0 => self.settled.iter().for_each(|range| from(range.clone(), block)),
            _ => from(self.written.clone(), block),
        }
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

    /// Writes the progress of the run and its limits: it goes to `stop`, in steps no longer than `longest`. Steps that
    /// reach `watched`, and all steps if `attend`, are left open for attention. `scales`: the scale of each state, SI.
    pub(crate) fn prepare(
        &self,
        system: &mut System,
        pace: Pace,
        (stop, longest): (f64, f64),
        watched: f64,
        attend: bool,
        scales: &[f64],
    ) {
        let trial = self.trial;
        let (last_step, last_root) = pace.last.unwrap_or((0.0, 0.0));
        let numbers = [
            (trial.time(), pace.t),
            (trial.next(), pace.next),
            (trial.last_step(), last_step),
            (trial.last_root(), last_root),
            (trial.rejected(), pace.rejected as f64),
            (trial.accepted(), pace.accepted as f64),
            (trial.refused(), 0.0),
            (trial.overruns(), 0.0),
            (trial.stop(), stop),
            (trial.before_stop(), stop.next_down()),
            (trial.longest(), longest),
            (trial.watched(), watched),
            (trial.attend(), f64::from(u8::from(attend))),
        ];
        numbers.into_iter().for_each(|(slot, value)| system.instance.set(slot, value));
        copy(scales, &mut system.instance.block_mut()[trial.scales().range()]);
    }

    /// Writes the side of each surface and the values at the start.
    pub(crate) fn prepare_surfaces(&self, system: &mut System, sides: &[f64], here: &[f64]) {
        let block = system.instance.block_mut();
        for (segment, values) in [(self.trial.sides(), sides), (self.trial.here(), here)] {
            copy(values, &mut block[segment.range()]);
        }
    }

    /// The progress of the run after the attempts, how many were rejected, and how many of these ended beyond a
    /// surface.
    pub(crate) fn settled(&self, system: &System) -> (Pace, u64, u64) {
        let (trial, get) = (self.trial, |slot| system.instance.get(slot));
        let last_step = get(trial.last_step());
        let pace = Pace {
            t: get(trial.time()),
            next: get(trial.next()),
            last: (last_step > 0.0).then(|| (last_step, get(trial.last_root()))),
            rejected: get(trial.rejected()) as u64,
            accepted: get(trial.accepted()) as u64,
        };
        (pace, get(trial.refused()) as u64, get(trial.overruns()) as u64)
    }

    /// The scale of each state after the attempts, SI.
    pub(crate) fn scales<'a>(&self, system: &'a System) -> &'a [f64] {
        &system.instance.block()[self.trial.scales().range()]
    }

    /// States at the start, and their derivatives.
    pub(crate) fn start<'a>(&self, system: &'a System) -> (&'a [f64], &'a [f64]) {
        let (from, block) = (self.trial.from(), system.instance.block());
        (&block[from.states.range()], &block[from.derivatives.range()])
    }

    /// Surfaces at the start.
    pub(crate) fn here<'a>(&self, system: &'a System) -> &'a [f64] {
        &system.instance.block()[self.trial.here().range()]
    }

    /// Reads the step that was left open, from its length on, and the slope at its end. None if a pivot was too small.
    pub(crate) fn left(&self, system: &System, step: &mut Step, end_slope: &mut [f64], status: u64) -> Option<Judged> {
        let (trial, block) = (self.trial, system.instance.block());
        (step.h, step.end) = (block[trial.step().index()], block[trial.end().index()]);
        if status == PIVOT {
            return None;
        }
        let [k1, k2, k3] = trial.course();
        let take = |to: &mut [f64], from: Segment| copy(&block[from.range()], to);
        take(&mut step.x1, trial.to().states);
        take(&mut step.error, trial.error());
        take(&mut step.k1, k1);
        take(&mut step.k2, k2);
        take(&mut step.k3, k3);
        take(end_slope, trial.to().derivatives);
        let number = |slot: Slot| block[slot.index()];
        Some(Judged {
            error: number(trial.worst()),
            defect: number(trial.defect()),
            met: number(trial.met()) > 0.0,
            outside: number(trial.outside()) > 0.0,
        })
    }

    /// Makes the end the start of the next step.
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
