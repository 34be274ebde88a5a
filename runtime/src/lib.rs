//! Instances and simulated time to results: experiments, their measures and recordings, sweeps, and rigs.
//!
//! In: an [`abi::Instance`] and the plan of an experiment. Out: verdicts, recordings, final values, or the reason why
//! the run stopped. Knows neither the language nor the compiler: any code that fulfils the contract of `abi` is a
//! model.

#![cfg_attr(rtsan, feature(sanitize))]
#![cfg_attr(test, allow(clippy::disallowed_methods, reason = "tests compare with the platform's functions"))]

pub mod rng;
pub mod format;
pub mod spsc;
mod stretch;

pub mod record;

pub mod run;

pub mod coupling;

mod solver;

pub mod engine;

pub mod fit;

pub mod image;
pub mod package;

pub mod realtime;

pub mod can;

#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod latency_test;

pub mod safety;

pub mod canopen;

pub mod drive;

pub mod hil;

#[cfg(test)]
mod testing;
