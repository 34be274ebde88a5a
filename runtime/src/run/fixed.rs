//! A run with fixed steps, each a call of the model's compiled step function.

use crate::run::observe::{Observer, Probe, check_finite, check_status};
use crate::run::outcome::{Cause, Continue, Stop};
use crate::run::stepper::{Rest, Stepper};
use crate::stretch::{Stretch, multiples};
use abi::format;
use abi::plan::Experiment;
use abi::table::keep_time;
use abi::{Function, Instance, Slot};
use std::ops::Range;

/// Steps between two calls of the progress callback and two checks of the whole block.
const BATCH: u64 = 4096;
/// Most steps in one call if an observer needs every step: their values fit into the nearest cache.
const SERIES: u64 = 128;

/// A fixed-step run in progress.
pub(crate) struct Fixed {
    rest: Rest,
    /// In s.
    step: f64,
    /// Number of steps.
    total: u64,
    /// Whether an observer needs every step.
    each: bool,
    /// The block at the beginning of the batch, the number of steps in the batch, and how many are done.
    saved: Vec<f64>,
    batch: u64,
    done: u64,
    /// Slots that the observer reads.
    seen: Vec<Range<usize>>,
    /// Steps at the end of a batch that store all outputs: one if the others leave some out, else none.
    full: u64,
    /// The slots of a series of calls, and their values after the calls since the last look: what the observer reads apart
    /// from time, or what its probe reads.
    series: Vec<Slot>,
    /// Whether the observer reads nothing but by its probe.
    probes: bool,
    stretch: Stretch,
}

impl Fixed {
    pub(crate) fn start(
        instance: Instance,
        experiment: &Experiment,
        observer: Observer,
        begin: &mut dyn FnMut(&mut Instance),
    ) -> Result<Fixed, Box<(Rest, Stop)>> {
        let step = experiment.solver.step;
        assert!(step > 0.0 && step.is_finite(), "a step of {step} s");
        let total = (experiment.duration / step).round() as u64;
        let end = total as f64 * step;
        let mut rest = Rest::of(instance, observer);
        if (end - experiment.duration).abs() > 1e-9 * experiment.duration {
            rest.notes.push(format!("The run ends at {}, after a whole number of steps.", format::time(end)));
        }
        let one = |slot: &Slot| slot.index()..slot.index() + 1;
        let slots = rest.observer.slots().iter().chain(rest.observer.probe.slots());
        rest.instance.read_only(slots.clone().copied());
        let full = u64::from(!rest.instance.left_out().is_empty());
        let probed = rest.observer.probe.slots();
        let is_kept = |slot: &Slot| [Slot::TIME, Slot::COUNT].contains(slot);
        let probes = rest.observer.slots().is_empty() && !probed.is_empty() && !probed.iter().any(is_kept);
        let read = if probes { probed } else { rest.observer.slots() };
        let mut series: Vec<Slot> = Vec::new();
        for slot in read.iter().filter(|slot| **slot != Slot::TIME) {
            if !series.contains(slot) {
                series.push(*slot);
            }
        }
        let mut run = Fixed {
            step,
            total,
            each: !rest.observer.only_last() || rest.observer.probe.next().is_some(),
            saved: rest.instance.block().to_vec(),
            batch: 0,
            done: 0,
            seen: [Slot::COUNT].iter().chain(slots).map(one).collect(),
            full,
            series,
            probes,
            stretch: Stretch::default(),
            rest,
        };
        match run.begin(begin) {
            Ok(()) => Ok(run),
            Err(stop) => Err(Box::new((run.rest, stop))),
        }
    }

    fn begin(&mut self, begin: &mut dyn FnMut(&mut Instance)) -> Result<(), Stop> {
        let Rest { instance, observer, .. } = &mut self.rest;
        let status = instance.start(self.step);
        begin(instance);
        check_status(instance, status)?;
        check_finite(instance)?;
        observer.see(instance)?;
        self.probe();
        self.open();
        Ok(())
    }

    /// Begins a batch.
    fn open(&mut self) {
        self.saved.copy_from_slice(self.rest.instance.block());
        (self.batch, self.done) = (BATCH.min(self.total - self.rest.work.steps), 0);
    }

    /// Records the requested values if this step is the nearest to the next requested instant.
    fn probe(&mut self) {
        let Rest { instance, observer, .. } = &mut self.rest;
        let time = instance.get(Slot::TIME);
        while observer.probe.next().is_some_and(|instant| instant < time + 0.5 * self.step) {
            observer.probe.take(instance.block());
        }
    }

    /// Accepts the block after `done` steps, the last of which returned `status`.
    fn accept(&mut self, done: u64, status: u64) -> Result<(), Stop> {
        if self.each {
            self.rest.observer.see(&self.rest.instance)?;
            self.probe();
        }
        self.done += done;
        if self.done < self.batch && status == 0 {
            return Ok(());
        }
        // Within a batch, a value may have become non-finite many steps ago, and that may be why a guard fired.
        if let Err(stop) = check_finite(&self.rest.instance) {
            return Err(self.first_not_finite().unwrap_or(stop));
        }
        if status != 0 && !self.each {
            // Show the step that violated the guard, too.
            self.rest.observer.see(&self.rest.instance)?;
        }
        check_status(&self.rest.instance, status)
    }

    /// Repeats the batch step by step up to the first state or output that is not finite. None if all are finite this
    /// time: a slice and the whole step may round an output differently, so that only one of them overflows.
    fn first_not_finite(&mut self) -> Option<Stop> {
        let instance = &mut self.rest.instance;
        instance.block_mut().copy_from_slice(&self.saved);
        for _ in 0..self.batch {
            instance.advance_in_full();
            if let Err(stop) = check_finite(instance) {
                return Some(stop);
            }
        }
        None
    }
}

impl Stepper for Fixed {
    fn function(&self) -> Function {
        Function::Step
    }

    fn next(&mut self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Option<u64>, Stop> {
        if self.done + self.full < self.batch {
            return Ok(Some(if self.each { 1 } else { self.batch - self.full - self.done }));
        }
        if self.done < self.batch {
            let status = self.rest.instance.advance_in_full();
            self.accept(1, status)?;
        }
        let Rest { instance, observer, work, .. } = &mut self.rest;
        work.steps += self.done;
        if work.steps > 0 && watch(work.steps as f64 / self.total as f64).is_break() {
            return Err(Stop { cause: Cause::Stopped, time: instance.get(Slot::TIME) });
        }
        if work.steps < self.total {
            self.open();
            return self.next(watch);
        }
        if !self.each {
            observer.see(instance)?;
        }
        Ok(None)
    }

    fn series(&self) -> Option<(&[Slot], u64)> {
        let is_plain = self.each && (self.probes || self.rest.observer.probe.next().is_none());
        is_plain.then(|| (&*self.series, (self.batch - self.full - self.done).min(SERIES)))
    }

    fn show(&mut self, calls: u64, column: &dyn Fn(usize, &mut [f64])) -> Result<(), Stop> {
        let Rest { instance, observer, work, .. } = &mut self.rest;
        // The block may be that before the calls or after them.
        let (first, step) = ((work.steps + self.done + 1) as f64, self.step);
        let times = |times: &mut [f64]| multiples(first, step, times);
        // The last one is read from the block, once that holds the other slots of the step too.
        self.stretch.fill(calls as usize - 1, &times, &self.series, column);
        if self.probes {
            observer.probe.take_stretch(&self.stretch, 0.5 * step);
            return Ok(());
        }
        if self.stretch.is_finite() {
            observer.see_stretch(&self.stretch);
            return Ok(());
        }
        for point in 0..self.stretch.len() {
            let block = instance.block_mut();
            self.stretch.write(point, block);
            block[Slot::COUNT.index()] = first + point as f64;
            keep_time(block);
            observer.see(instance)?;
        }
        Ok(())
    }

    fn take(&mut self, done: u64, status: u64) -> Result<(), Stop> {
        if status != 0 {
            self.rest.instance.complete();
        }
        self.accept(done, status)
    }

    fn instance(&mut self) -> &mut Instance {
        &mut self.rest.instance
    }

    fn probe(&mut self) -> &mut Probe {
        &mut self.rest.observer.probe
    }

    fn fetch(&mut self, done: u64, status: u64, from: &dyn Fn(Range<usize>, &mut [f64])) {
        let block = self.rest.instance.block_mut();
        let mut whole = status != 0 || self.done + done + self.full == self.batch;
        if !whole {
            for range in &self.seen {
                from(range.clone(), block);
                // Other slots may show why this one is not finite, so fetch the whole block.
                whole |= !block[range.start].is_finite();
            }
        }
        if whole {
            from(0..block.len(), block);
        }
        keep_time(block);
    }

    fn bring(&self, to: &mut dyn FnMut(Range<usize>, &[f64])) {
        // After the last step of a batch, which was made here.
        if self.full > 0 && self.done == 0 {
            let block = self.rest.instance.block();
            to(0..block.len(), block);
        }
    }

    fn rest(self: Box<Self>) -> Rest {
        let Fixed { mut rest, done, batch, .. } = *self;
        if done < batch {
            rest.instance.complete();
        }
        rest.instance.read_all();
        rest
    }
}
