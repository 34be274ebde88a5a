//! How a run ends: what it gives, or why it stopped.

use crate::measure::Verdict;
use crate::record::Recording;
use crate::show;
use abi::description::Guard;
use abi::unit::Unit;
use std::fmt;
use std::ops::ControlFlow;

/// Whether to go on.
pub type Continue = ControlFlow<()>;

/// How an experiment ended that ran to its end.
#[derive(Clone, PartialEq, Debug)]
pub struct Outcome {
    /// One for each expectation, in order.
    pub verdicts: Vec<Verdict>,
    /// What is drawn and written.
    pub recording: Recording,
    /// Outputs at the end, in the order of the description.
    pub finals: Vec<Final>,
    /// Time at the end in s.
    pub time: f64,
    /// What it took.
    pub work: Work,
    /// What the reader should know besides: in words, a sentence each.
    pub notes: Vec<String>,
}

impl Outcome {
    /// Whether every expectation held.
    pub fn passed(&self) -> bool {
        self.verdicts.iter().all(|verdict| verdict.holds)
    }
}

/// The value of an output at the end.
#[derive(Clone, PartialEq, Debug)]
pub struct Final {
    /// Dotted path.
    pub path: String,
    /// In SI.
    pub value: f64,
    /// The unit it is shown in.
    pub unit: Unit,
    /// True (1) or false (0) rather than a quantity.
    pub boolean: bool,
}

/// What a run took.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Work {
    /// Steps that count, of any kind.
    pub steps: u64,
}

/// Why a run stopped before its end.
#[derive(Clone, PartialEq, Debug)]
pub struct Failure {
    /// The reason.
    pub cause: Cause,
    /// When, in s.
    pub time: f64,
    /// The run up to there.
    pub recording: Recording,
}

/// The reason of a [`Failure`].
#[derive(Clone, PartialEq, Debug)]
pub enum Cause {
    /// A watched quantity left its range.
    Guard {
        /// The quantity and its range.
        guard: Box<Guard>,
        /// Its value in SI.
        value: f64,
    },
    /// A quantity became infinite or not a number.
    NotFinite {
        /// Dotted path, or the expression as written.
        path: String,
        /// Its value.
        value: f64,
    },
    /// The solver is not there yet.
    Unavailable,
    /// The caller said to stop.
    Stopped,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let time = show::time(self.time);
        match &self.cause {
            Cause::Guard { guard, value } => {
                let Guard { path, range, unit, .. } = &**guard;
                let value = show::quantity(*value, unit);
                let (low, high) = (show::plain(unit.from_si(range.0)), show::quantity(range.1, unit));
                write!(f, "`{path}` left its range {low} .. {high}: it is {value} at {time}")
            }
            Cause::NotFinite { path, value } if value.is_nan() => {
                write!(f, "`{path}` is not a number at {time}")
            }
            Cause::NotFinite { path, .. } => write!(f, "`{path}` is infinite at {time}"),
            Cause::Unavailable => write!(f, "adaptive runs are not available yet: give a `solver` with a step"),
            Cause::Stopped => write!(f, "stopped at {time}"),
        }
    }
}

impl std::error::Error for Failure {}

/// A reason to stop, and when.
pub(crate) struct Stop {
    pub(crate) cause: Cause,
    pub(crate) time: f64,
}
