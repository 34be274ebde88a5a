//! Runs that stand still between calls of their model's code, so that whoever makes the calls may make those of many
//! together.
//!
//! In: an instance, a plan and an observer. Out: a [`Stepper`], and when it has ended its [`Rest`]. What a run does between
//! two calls depends on what the calls left in its block alone: with whom they were made cannot be told.

use crate::run::observe::Observer;
use crate::run::outcome::{Continue, Stop, Work};
use abi::{Function, Instance};
use std::ops::Range;

/// A run under way.
pub(crate) trait Stepper {
    /// The function that makes its steps.
    fn function(&self) -> Function;

    /// Goes on up to where the function is to be called, at most so often as said. None at the end of the run. `watch` sees
    /// the fraction done and may end it.
    fn next(&mut self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Option<u64>, Stop>;

    /// Takes over what `done` calls have left in the block, the last of them with this status, all others with 0.
    fn take(&mut self, done: u64, status: u64) -> Result<(), Stop>;

    /// The instance on whose block the calls are made.
    fn instance(&mut self) -> &mut Instance;

    /// Where the calls were made on another block: brings those slots from there that `take` will read.
    fn fetch(&mut self, done: u64, status: u64, from: &dyn Fn(Range<usize>, &mut [f64]));

    /// And brings those slots there that have changed since the last call.
    fn bring(&self, to: &mut dyn FnMut(Range<usize>, &[f64]));

    /// What is left of it.
    fn rest(self: Box<Self>) -> Rest;
}

/// What is left of a run.
pub(crate) struct Rest {
    /// Where it ended.
    pub(crate) instance: Instance,
    /// What was seen.
    pub(crate) observer: Observer,
    /// What it cost.
    pub(crate) work: Work,
    /// What the user should know.
    pub(crate) notes: Vec<String>,
}

impl Rest {
    /// Of a run that did not begin.
    pub(crate) fn of(instance: Instance, observer: Observer) -> Rest {
        Rest { instance, observer, work: Work::default(), notes: Vec::new() }
    }
}

/// Runs it to its end or to the reason why not.
pub(crate) fn alone(course: &mut dyn Stepper, watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
    let function = course.function();
    while let Some(count) = course.next(watch)? {
        let status = course.instance().call_up_to(function, count);
        course.take(count, status)?;
    }
    Ok(())
}
