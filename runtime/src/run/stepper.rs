//! Resumable runs: a run pauses at each call of its model's code, so that a scheduler can batch the calls of many runs.
//!
//! In: an instance, a plan and an observer. Out: a [`Stepper`], and at its end a [`Rest`]. A run depends only on what
//! the calls leave in its own block, so results do not depend on how calls were batched.

use crate::run::observe::{Observer, Probe};
use crate::run::outcome::{Continue, Stop, Work};
use crate::stretch::copy_column;
use abi::{Function, Instance, Slot};
use std::ops::Range;

/// A run in progress.
pub(crate) trait Stepper: Send {
    /// The function that advances it.
    fn function(&self) -> Function;

    /// Continues to the next call of the function, and returns how often it is to be called at most. None at the end of
    /// the run. `watch` receives the fraction done and may stop the run.
    fn next(&mut self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Option<u64>, Stop>;

    /// If this run reads its block after every call: the slots that it reads, apart from time, and how many calls may be made
    /// before [`take`](Stepper::take) if [`show`](Stepper::show) receives those slots after each call.
    fn series(&self) -> Option<(&[Slot], u64)> {
        None
    }

    /// Receives such values: those after the `calls` calls since the last `take`. All but the last of these have returned
    /// 0. `column` writes the values of the slot with a given number after each of the first calls.
    fn show(&mut self, _calls: u64, _column: &dyn Fn(usize, &mut [f64])) -> Result<(), Stop> {
        unreachable!("it has no series")
    }

    /// Accepts the block after `done` calls, the last of which returned `status`; all others returned 0.
    fn take(&mut self, done: u64, status: u64) -> Result<(), Stop>;

    /// The instance whose block the calls work on.
    fn instance(&mut self) -> &mut Instance;

    /// What it records at given instants.
    fn probe(&mut self) -> &mut Probe;

    /// If the calls were made on another block: copies from there the slots that `take` reads.
    fn fetch(&mut self, done: u64, status: u64, from: &dyn Fn(Range<usize>, &mut [f64]));

    /// Copies to that other block the slots that have changed since the last call.
    fn bring(&self, to: &mut dyn FnMut(Range<usize>, &[f64]));

    /// Consumes the run and returns its instance and results.
    fn rest(self: Box<Self>) -> Rest;
}

/// The parts of a run after its end.
pub(crate) struct Rest {
    /// The instance in its final state.
    pub(crate) instance: Instance,
    /// The observer with its results.
    pub(crate) observer: Observer,
    /// The number of operations.
    pub(crate) work: Work,
    /// Notes for the user.
    pub(crate) notes: Vec<String>,
}

impl Rest {
    /// The parts of a run that did not begin.
    pub(crate) fn of(instance: Instance, observer: Observer) -> Rest {
        Rest { instance, observer, work: Work::default(), notes: Vec::new() }
    }
}

/// Runs it alone to its end, or to the reason to stop.
pub(crate) fn alone(course: &mut dyn Stepper, watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
    until(course, &mut |_| false, watch).map(|_| ())
}

/// Runs it alone until it has recorded enough, to its end, or to the reason to stop. Returns whether it has ended.
pub(crate) fn until(
    course: &mut dyn Stepper,
    has_enough: &mut dyn FnMut(&mut Probe) -> bool,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<bool, Stop> {
    let function = course.function();
    let mut rows = Vec::new();
    while !has_enough(course.probe()) {
        let Some(count) = course.next(watch)? else { return Ok(true) };
        let (done, status) = match in_series(course, &mut rows)? {
            Some(made) => made,
            None => (count, course.instance().call_up_to(function, count)),
        };
        course.take(done, status)?;
    }
    Ok(false)
}

/// Makes the calls of a series and shows them: in one call, if there is code that records the slots. Returns their number and
/// the last status. None where a single call is as good: a fixed step without such code.
fn in_series(course: &mut dyn Stepper, rows: &mut Vec<f64>) -> Result<Option<(u64, u64)>, Stop> {
    let function = course.function();
    let Some((slots, most)) = course.series() else { return Ok(None) };
    let slots = slots.to_vec();
    rows.resize(most as usize * slots.len(), 0.0);
    let instance = course.instance();
    let made = match function {
        Function::Step => instance.advance_recording(&slots, rows, most),
        _ => Some(by_calls(instance, function, &slots, rows)),
    };
    let Some((done, status)) = made else { return Ok(None) };
    course.show(done, &|slot, column| copy_column(&rows[slot..], slots.len(), column))?;
    Ok(Some((done, status)))
}

/// Calls a function for each row, up to the first status that is not 0, and writes the values of the slots to the row.
/// Returns the number of calls and the last status.
fn by_calls(instance: &mut Instance, function: Function, slots: &[Slot], rows: &mut [f64]) -> (u64, u64) {
    let (mut done, mut status) = (0, 0);
    for row in rows.chunks_exact_mut(slots.len()) {
        status = instance.call(function);
        row.iter_mut().zip(slots).for_each(|(value, slot)| *value = instance.get(*slot));
        done += 1;
        if status != 0 {
            break;
        }
    }
    (done, status)
}
