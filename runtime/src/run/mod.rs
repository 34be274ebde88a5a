//! A single run: steps of a model, its observers, and the results of what they observe.
//!
//! In: an instance and the plan of an experiment. Out: a resumable run that pauses at each call of its model's code;
//! measures with their verdicts; recordings; or the reason why it stopped.

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
