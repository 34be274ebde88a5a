//! Observes the points of a run: measures, recordings, and the check that every number is finite.
//!
//! In: instances after a step, or on one side of an event. Out: the results of [`measure`](crate::run::measure) and
//! [`record`](crate::record), or the reason to stop. Knows no solver.

use crate::record::Recorder;
use crate::run::measure::Expectations;
use crate::run::outcome::{Cause, Stop};
use crate::stretch::Stretch;
use abi::description::Kind;
use abi::plan::Experiment;
use abi::{Instance, Slot};
use std::sync::Arc;

/// All observers of a run.
pub(crate) struct Observer {
    pub(crate) expectations: Expectations,
    pub(crate) recorder: Recorder,
    /// Slots that are read; each must be finite.
    slots: Vec<Slot>,
    /// Values to record at given instants.
    pub(crate) probe: Probe,
}

/// Rows for which a probe makes room at once.
const ROOM: usize = 4096;

/// Records the values of some slots at given instants, in ascending order.
pub(crate) struct Probe {
    instants: Arc<[f64]>,
    slots: Vec<Slot>,
    /// Number of instants passed.
    passed: usize,
    /// Row-major, a row for each of these that has not been [drawn](Probe::draw).
    values: Vec<f64>,
}

impl Default for Probe {
    fn default() -> Probe {
        Probe::new(&Arc::from([]), &[])
    }
}

impl Probe {
    fn new(instants: &Arc<[f64]>, slots: &[Slot]) -> Probe {
        Probe { instants: instants.clone(), slots: slots.to_vec(), passed: 0, values: Vec::new() }
    }

    /// The slots to record.
    pub(crate) fn slots(&self) -> &[Slot] {
        &self.slots
    }

    /// The next instant, in s.
    pub(crate) fn next(&self) -> Option<f64> {
        self.instants.get(self.passed).copied().filter(|_| !self.slots.is_empty())
    }

    /// Records the values at that instant.
    pub(crate) fn take(&mut self, block: &[f64]) {
        self.values.extend(self.slots.iter().map(|slot| block[slot.index()]));
        self.passed += 1;
    }

    /// Records the values at the instants to which a point of a stretch is the nearest. `half`: of a step, in s.
    pub(crate) fn take_stretch(&mut self, stretch: &Stretch, half: f64) {
        let instants = &self.instants[self.passed..];
        let mut points: Vec<usize> = Vec::with_capacity(stretch.len());
        for (point, time) in stretch.times().iter().enumerate() {
            let end = time + half;
            while instants.get(points.len()).is_some_and(|instant| *instant < end) {
                points.push(point);
            }
        }
        if points.is_empty() {
            return;
        }
        let (begin, width) = (self.values.len(), self.slots.len());
        if self.values.capacity() - begin < width * points.len() {
            self.values.reserve(width * instants.len().min(ROOM).max(points.len()));
        }
        self.values.resize(begin + width * points.len(), 0.0);
        for (k, slot) in self.slots.iter().enumerate() {
            let column = stretch.column(*slot);
            for (to, point) in self.values[begin + k..].iter_mut().step_by(width).zip(&points) {
                *to = column[*point];
            }
        }
        self.passed += points.len();
    }

    /// Number of rows that have not been drawn.
    pub(crate) fn rows(&self) -> usize {
        self.values.len() / self.slots.len().max(1)
    }

    /// Takes out the first rows, at most so many.
    pub(crate) fn draw(&mut self, rows: usize) -> Vec<f64> {
        let rest = self.values.split_off((rows * self.slots.len()).min(self.values.len()));
        std::mem::replace(&mut self.values, rest)
    }

    pub(crate) fn values(self) -> Vec<f64> {
        self.values
    }
}

impl Observer {
    pub(crate) fn new(experiment: &Experiment) -> Observer {
        let mut expects = experiment.expects.clone();
        // A window that ends with the run has an open end: the last step may end one rounding error off the duration.
        for expect in expects.iter_mut().filter(|expect| expect.before >= experiment.duration) {
            expect.before = f64::INFINITY;
        }
        let mut expectations = Expectations::new(&expects);
        expectations.jumps_at(&experiment.corners);
        let recorder = Recorder::new(&experiment.plots, &experiment.records);
        let mut slots: Vec<Slot> = expectations.slots().chain(recorder.slots()).collect();
        slots.sort();
        slots.dedup();
        Observer { expectations, recorder, slots, probe: Probe::default() }
    }

    /// The same, which also records these slots at these instants.
    pub(crate) fn probing(experiment: &Experiment, instants: &Arc<[f64]>, slots: &[Slot]) -> Observer {
        Observer { probe: Probe::new(instants, slots), ..Observer::new(experiment) }
    }

    /// Whether all observers need only the last point of a run.
    pub(crate) fn only_last(&self) -> bool {
        self.recorder.is_empty() && self.expectations.only_last()
    }

    /// The slots that are read, ascending.
    pub(crate) fn slots(&self) -> &[Slot] {
        &self.slots
    }

    /// Adds a point of the run: the block after a step, or on one side of an event.
    pub(crate) fn see(&mut self, instance: &Instance) -> Result<(), Stop> {
        let block = instance.block();
        // Zero times a value is zero unless the value is infinite or not a number: one sum checks all slots without a
        // branch.
        let doubt: f64 = self.slots.iter().map(|slot| 0.0 * block[slot.index()]).sum();
        if doubt != 0.0 {
            self.check(instance)?;
        }
        self.show(block[Slot::TIME.index()], block, true);
        Ok(())
    }

    /// Adds a point whose values are known to be finite. `for_all`: not only for the measures.
    pub(crate) fn show(&mut self, time: f64, block: &[f64], for_all: bool) {
        self.expectations.see(time, block);
        if for_all {
            self.recorder.see(time, block);
        }
    }

    /// Adds consecutive points, whose values are finite, with the bits of [`see`](Observer::see) for one after the other.
    pub(crate) fn see_stretch(&mut self, stretch: &Stretch) {
        self.expectations.see_stretch(stretch);
        self.recorder.see_stretch(stretch);
    }

    /// Names the observed value that is not finite. States come first, because a bad state explains a bad expression.
    pub(crate) fn check(&self, instance: &Instance) -> Result<(), Stop> {
        check_finite(instance)?;
        match self.slots.iter().find(|slot| !instance.get(**slot).is_finite()) {
            Some(bad) => Err(not_finite(instance, *bad)),
            None => Ok(()),
        }
    }
}

/// Checks that states and outputs are finite. Private quantities may be infinite in a branch that is not taken.
pub(crate) fn check_finite(instance: &Instance) -> Result<(), Stop> {
    let layout = &instance.description().layout;
    let finite = |slot: &usize| instance.block()[*slot].is_finite();
    if let Some(bad) = layout.states.range().find(|slot| !finite(slot)) {
        return Err(not_finite(instance, Slot(bad as u32)));
    }
    let watched = |kind| matches!(kind, Kind::SampledState | Kind::Output);
    let outputs = instance.description().quantities.iter().filter(|quantity| watched(quantity.kind));
    match outputs.map(|quantity| quantity.slot).find(|slot| !finite(&slot.index())) {
        Some(bad) => Err(not_finite(instance, bad)),
        None => Ok(()),
    }
}

/// Reports the value that is not finite, or the quantity that left its range at the same instant: results are valid
/// only within ranges, so that is the cause.
fn not_finite(instance: &Instance, slot: Slot) -> Stop {
    let time = instance.get(Slot::TIME);
    let left = instance.description().guards.iter().find_map(|guard| {
        let (value, (low, high)) = (instance.get(guard.slot), guard.range);
        (value.is_finite() && !(low..=high).contains(&value)).then_some((guard, value))
    });
    if let Some((guard, value)) = left {
        return Stop { cause: Cause::Guard { guard: Box::new(guard.clone()), value }, time };
    }
    let named = instance.description().quantities.iter().find(|quantity| quantity.slot == slot);
    let path = named.map_or_else(|| format!("slot {}", slot.0), |quantity| quantity.path.clone());
    Stop { cause: Cause::NotFinite { path, value: instance.get(slot) }, time }
}

/// Converts a status other than 0 to the reason to stop.
pub(crate) fn check_status(instance: &Instance, status: u64) -> Result<(), Stop> {
    if status == 0 {
        return Ok(());
    }
    let guards = &instance.description().guards;
    let guard = guards
        .get(status as usize - 1)
        .unwrap_or_else(|| panic!("status {status} of a model with {} guards", guards.len()));
    let value = instance.get(guard.slot);
    let cause = if value.is_finite() {
        Cause::Guard { guard: Box::new(guard.clone()), value }
    } else {
        Cause::NotFinite { path: guard.path.clone(), value }
    };
    Err(Stop { cause, time: instance.get(Slot::TIME) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    /// A stretch gives a probe the rows that its points give one after the other, whatever instants lie in it.
    #[test]
    fn a_stretch_is_probed_as_its_points_are() {
        for seed in 1..200u64 {
            let mut chance = Chance(seed);
            let mut below = |n: u64| chance.below(n);
            let slots: Vec<Slot> = (0..below(4)).map(|k| Slot(3 + k as u32)).collect();
            let mut instants: Vec<f64> = (0..below(12)).map(|_| below(4000) as f64 / 100.0).collect();
            instants.sort_by(f64::total_cmp);
            let instants: Arc<[f64]> = instants.into();
            let [mut alone, mut together] = [0, 1].map(|_| Probe::new(&instants, &slots));
            let mut begin = 0;
            while begin < 40 && !slots.is_empty() {
                let len = 1 + below(7) as usize;
                let value = |k: usize, point: usize| (10 * (begin + point) + k) as f64;
                for point in 0..len {
                    let mut block = vec![0.0; 3 + slots.len()];
                    (0..slots.len()).for_each(|k| block[3 + k] = value(k, point));
                    while alone.next().is_some_and(|instant| instant < (begin + point) as f64 + 0.5) {
                        alone.take(&block);
                    }
                }
                let mut stretch = Stretch::default();
                let times = |times: &mut [f64]| times.iter_mut().enumerate().for_each(|(k, t)| *t = (begin + k) as f64);
                let column = |k: usize, to: &mut [f64]| to.iter_mut().enumerate().for_each(|(at, x)| *x = value(k, at));
                stretch.fill(len, &times, &slots, &column);
                together.take_stretch(&stretch, 0.5);
                begin += len;
            }
            assert_eq!(alone.passed, together.passed, "seed {seed}");
            assert_eq!(alone.values(), together.values(), "seed {seed}");
        }
    }
}
