//! Instances and time to results: experiments, their measures and recordings, sweeps.
//!
//! In: an [`abi::Instance`] and the plan of an experiment. Out: verdicts, recordings, final values, or the reason
//! why the run stopped. Knows neither the language nor the compiler: a model is whatever fills the contract of `abi`.

#![cfg_attr(rtsan, feature(sanitize))]
#![cfg_attr(test, allow(clippy::disallowed_methods, reason = "tests compare with the platform's functions"))]

pub mod chance;
pub mod show;
pub mod queue;

pub mod verdict;
mod peak;
mod hills;
mod quadrature;
mod crossing;
pub mod measure;
pub mod record;

mod outcome;

mod observe;

mod course;
mod fixed;

mod solver;

pub mod lag;
pub mod lookahead;
mod dry;

pub mod engine;
pub mod even;
pub mod estimate;
pub mod steady;
pub mod lanes;
pub mod sweep;

pub mod blob;
pub mod package;

pub mod modes;

pub mod energy;
pub mod predict;

pub mod clock;
pub mod histogram;
pub mod realtime;

pub mod host;

pub mod can;

pub mod bench_rt;

pub mod safety;

pub mod canopen;

pub mod drive;

pub mod hil;

#[cfg(test)]
mod models;
