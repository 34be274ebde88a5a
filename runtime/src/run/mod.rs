//! One run: steps of a model, what observers see of them, and what is found of what they saw.
//!
//! In: an instance, the plan of an experiment. Out: a run that stands still between calls of its model's code, measures with their
//! verdicts, recordings, or the reason why it stopped.

pub mod verdict;
pub(crate) mod peak;
pub(crate) mod hills;
pub(crate) mod quadrature;
pub(crate) mod crossing;
pub mod measure;
pub(crate) mod outcome;
pub(crate) mod observe;
pub(crate) mod stepper;
pub(crate) mod fixed;
