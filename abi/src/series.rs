//! How time is stepped and what is watched of it: what experiments and rigs share.

use crate::description::Slot;
use crate::unit::Unit;

/// How time is stepped.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum Method {
    Euler,
    Rk4,
    Expo,
    Implicit,
    Adaptive,
}

impl Method {
    /// All of them.
    pub const ALL: [Method; 5] = [Method::Adaptive, Method::Expo, Method::Implicit, Method::Rk4, Method::Euler];

    /// As written behind `solver`.
    pub fn name(self) -> &'static str {
        match self {
            Method::Euler => "euler",
            Method::Rk4 => "rk4",
            Method::Expo => "expo",
            Method::Implicit => "implicit",
            Method::Adaptive => "adaptive",
        }
    }

    /// The method of this name.
    pub fn named(name: &str) -> Option<Method> {
        Method::ALL.into_iter().find(|method| method.name() == name)
    }
}

/// The solver of an experiment.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Solver {
    /// The method.
    pub method: Method,
    /// Fixed step in s; of an adaptive run 0.
    pub step: f64,
    /// Relative tolerance of an adaptive run.
    pub tol: f64,
    /// In how many parts an adaptive run is made at least: no step is longer than the duration divided by it.
    pub parts: f64,
}

/// The parts of an adaptive run, at least, unless somebody wants it finer.
pub const PARTS: f64 = 50.0;

/// A drawn quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Series {
    /// As written: `body.v`.
    pub label: String,
    /// Where its value lies after a step, in SI.
    pub slot: Slot,
    /// The unit it is shown in.
    pub unit: Unit,
    /// True or false rather than a quantity.
    pub boolean: bool,
}
