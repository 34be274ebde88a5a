//! Methods, solver settings and recorded series, which experiments and rigs share.

use crate::description::Slot;
use crate::unit::Unit;

/// A method of time integration.
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
    /// All methods.
    pub const ALL: [Method; 5] = [Method::Adaptive, Method::Expo, Method::Implicit, Method::Rk4, Method::Euler];

    /// The name after the keyword `solver`.
    pub fn name(self) -> &'static str {
        match self {
            Method::Euler => "euler",
            Method::Rk4 => "rk4",
            Method::Expo => "expo",
            Method::Implicit => "implicit",
            Method::Adaptive => "adaptive",
        }
    }

    /// The method with this name.
    pub fn named(name: &str) -> Option<Method> {
        Method::ALL.into_iter().find(|method| method.name() == name)
    }
}

/// The solver of an experiment.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Solver {
    /// The method.
    pub method: Method,
    /// Fixed step in s; 0 for an adaptive run.
    pub step: f64,
    /// Relative tolerance of an adaptive run.
    pub tol: f64,
    /// Minimum number of parts of an adaptive run: no step is longer than the duration divided by it.
    pub parts: f64,
}

/// Default for [`Solver::parts`].
pub const PARTS: f64 = 50.0;

/// A plotted or recorded quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Series {
    /// As written: `body.v`.
    pub label: String,
    /// Slot of its value after a step, in SI.
    pub slot: Slot,
    /// The unit in which it is displayed.
    pub unit: Unit,
    /// Whether it is a Boolean.
    pub boolean: bool,
}
