//! Finds the equilibrium of a model under constant inputs by simulation.
//!
//! In: an instance that has started, with the functions of an adaptive run. Out: the instance at rest, or the state
//! that does not come to rest. Time is advanced until nothing changes. No equation is solved, so regimes and branches
//! behave as in a run.

use crate::engine::{self, Cause, Continue, Failure};
use crate::record::Recording;
use abi::description::Kind;
use abi::plan::{Experiment, Method, PARTS, Solver};
use abi::{Function, Instance, Slot};
use std::fmt;

/// Durations in s of successive runs; the search ends after the first one after which nothing moves.
const WAITS: [f64; 4] = [1.0, 1e2, 1e4, 1e6];
/// The same for models with sampled code, where every tick costs time.
const SAMPLED_WAITS: [f64; 2] = [1.0, 10.0];
/// Largest change of a state at rest over as long a time as has just passed, as a fraction of its size or scale.
const REST: f64 = 1e-6;

/// Why a model did not reach equilibrium.
#[derive(Clone, PartialEq, Debug)]
pub enum Restless {
    /// This state still moves after the longest wait.
    Moves {
        /// Dotted path.
        path: String,
        /// Its rate, SI units per second.
        rate: f64,
        /// Seconds simulated.
        after: f64,
    },
    /// A run stopped with a failure.
    Failed(Failure),
}

impl fmt::Display for Restless {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Restless::Moves { path, after, .. } => {
                write!(f, "does not come to rest: `{path}` still moves after {after} s")
            }
            Restless::Failed(failure) => failure.fmt(f),
        }
    }
}

impl std::error::Error for Restless {}

/// Advances an instance to equilibrium. `tol`: relative tolerance of the runs, between 0 and 1.
///
/// # Errors
/// The state that moves most if there is no equilibrium, or why a run stopped.
pub fn settle(instance: Instance, tol: f64, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Instance, Restless> {
    settle_of(instance, &[], tol, watch)
}

/// As [`settle`], but until these quantities rest, if there are any: other states, such as a path travelled, may move on.
///
/// # Errors
/// As [`settle`].
pub fn settle_of(
    instance: Instance,
    of: &[Slot],
    tol: f64,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<Instance, Restless> {
    let mut now = instance;
    let mut seen: Option<Vec<f64>> = None;
    if moving(&mut now, 1.0).is_none() {
        return Ok(now);
    }
    let waits = if now.description().ticks.is_empty() { &WAITS[..] } else { &SAMPLED_WAITS[..] };
    let mut moved = None;
    for wait in waits {
        if watch(0.0).is_break() {
            let stopped = Failure { cause: Cause::Stopped, time: 0.0, recording: Recording::default() };
            return Err(Restless::Failed(stopped));
        }
        let solver = Solver { method: Method::Adaptive, step: 0.0, tol, parts: PARTS };
        let (plots, expects, corners) = (Vec::new(), Vec::new(), Vec::new());
        let experiment = Experiment {
            name: String::new(),
            duration: *wait,
            solver,
            bench: None,
            plots,
            records: Vec::new(),
            every: None,
            expects,
            corners,
            stepped: false,
        };
        let before = now.clone();
        let mut begin = |instance: &mut Instance| {
            instance.carry(&before);
        };
        let (after, result) = engine::run_on(now.clone(), &experiment, &mut begin, watch);
        result.map_err(Restless::Failed)?;
        now = after;
        moved = moving(&mut now, *wait).map(|(path, rate)| Restless::Moves { path, rate, after: *wait });
        if moved.is_none() {
            return Ok(now);
        }
        now.call(Function::Outputs);
        let values: Vec<f64> = of.iter().map(|slot| now.get(*slot)).collect();
        let rests = |(a, b): (&f64, &f64)| (a - b).abs() <= REST * a.abs().max(b.abs());
        if !of.is_empty() && seen.as_ref().is_some_and(|seen| seen.iter().zip(&values).all(rests)) {
            return Ok(now);
        }
        seen = Some(values);
    }
    Err(moved.expect("there is at least one wait"))
}

/// The state that moves most relative to its size, with its rate, if any would move noticeably within `wait` seconds.
fn moving(instance: &mut Instance, wait: f64) -> Option<(String, f64)> {
    let description = instance.description().clone();
    let layout = &description.layout;
    if layout.states.len == 0 {
        return None;
    }
    instance.call(Function::Derivatives);
    let mut worst: Option<(f64, String, f64)> = None;
    for i in 0..layout.states.len as usize {
        let slot: Slot = layout.states.slot(i);
        let rate = instance.get(layout.derivatives.slot(i));
        let quantity = description.quantities.iter().find(|q| q.kind == Kind::State && q.slot == slot);
        let scale = quantity.map_or(1.0, |q| {
            let half = 0.5 * (q.range.1 - q.range.0);
            if half > 0.0 && half.is_finite() { half } else { q.unit.scale }
        });
        let part = rate.abs() * wait / (instance.get(slot).abs() + scale);
        if part > REST && worst.as_ref().is_none_or(|(most, ..)| part > *most) {
            let path = quantity.map_or_else(|| format!("state {i}"), |q| q.path.clone());
            worst = Some((part, path, rate));
        }
    }
    worst.map(|(_, path, rate)| (path, rate))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::models;

    fn settled(instance: Instance) -> Result<Instance, Restless> {
        let mut instance = instance;
        instance.start(0.0);
        settle(instance, 1e-8, &mut |_| Continue::Continue(()))
    }

    #[test]
    fn a_decay_rests_at_zero() {
        let rested = settled(models::decay()).unwrap();
        let x = rested.description().quantity("x").unwrap().slot;
        assert!(rested.get(x).abs() < 1e-6, "{}", rested.get(x));
    }

    #[test]
    fn an_undamped_oscillation_is_reported() {
        let why = settled(models::oscillator()).err().expect("an oscillator does not rest");
        assert!(matches!(&why, Restless::Moves { .. } | Restless::Failed(_)), "{why}");
        assert!(why.to_string().contains("rest") || why.to_string().contains("steps"), "{why}");
    }
}
