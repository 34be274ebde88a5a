//! The outcome of a run: its results, or why it stopped.

use crate::record::Recording;
use crate::run::verdict::Verdict;
use abi::description::Guard;
use abi::format;
use abi::plan::Solver;
use abi::unit::Unit;
use std::fmt;
use std::ops::ControlFlow;

/// Whether a callback wants the run to continue.
pub type Continue = ControlFlow<()>;

/// The results of an experiment that ran to its end.
#[derive(Clone, PartialEq, Debug)]
pub struct Outcome {
    /// One for each expectation, in order.
    pub verdicts: Vec<Verdict>,
    /// The signals to plot and to write.
    pub recording: Recording,
    /// Outputs at the end, in the order of the description.
    pub finals: Vec<Final>,
    /// Time at the end in s.
    pub time: f64,
    /// The number of steps and evaluations.
    pub work: Work,
    /// Notes for the user, a sentence each.
    pub notes: Vec<String>,
    /// How the errors of the readings were estimated; none if that was not requested.
    pub estimate: Option<Estimate>,
}

/// How the errors of an outcome were estimated.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Estimate {
    /// More accurate solvers whose runs of the same experiment reached the end.
    pub companions: Vec<Solver>,
    /// One that failed, and why, in words: the errors are then unknown.
    pub failed: Option<(Solver, String)>,
    /// Where verdicts are undecided: a solver that decides all of them, as tried.
    pub decides: Option<Solver>,
}

impl Outcome {
    /// Whether every expectation held, and is decided where errors were estimated.
    pub fn passed(&self) -> bool {
        self.verdicts.iter().all(Verdict::passed)
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
    /// Whether the value is a truth value, 1 or 0, rather than a quantity.
    pub boolean: bool,
}

/// The number of operations of a run.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Work {
    /// Accepted steps of any kind.
    pub steps: u64,
    /// Of these, in an adaptive run, steps of the stiff method; the others are explicit.
    pub stiff_steps: u64,
    /// Rejected steps of an adaptive run.
    pub rejected: u64,
    /// Evaluations of the derivatives in an adaptive run.
    pub evaluations: u64,
    /// Jacobian evaluations in an adaptive run.
    pub jacobians: u64,
    /// Events at which a step of an adaptive run ended.
    pub events: u64,
    /// Instants at which sampled blocks executed in an adaptive run.
    pub ticks: u64,
}

impl fmt::Display for Work {
    /// `1685 steps (1621 stiff, 64 explicit), 248 tried again, 3 events`; of a fixed step `2000 steps`.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} steps", self.steps)?;
        if self.evaluations == 0 {
            return Ok(());
        }
        match (self.stiff_steps, self.steps - self.stiff_steps) {
            (_, 0) => write!(f, " (stiff)")?,
            (0, _) => write!(f, " (explicit)")?,
            (stiff, explicit) => write!(f, " ({stiff} stiff, {explicit} explicit)")?,
        }
        write!(f, ", {} tried again", self.rejected)?;
        match self.events {
            0 => Ok(()),
            1 => write!(f, ", 1 event"),
            events => write!(f, ", {events} events"),
        }
    }
}

/// A run that stopped before its end.
#[derive(Clone, PartialEq, Debug)]
pub struct Failure {
    /// The reason.
    pub cause: Cause,
    /// Time of the stop, in s.
    pub time: f64,
    /// The recording up to then.
    pub recording: Recording,
}

/// The reason of a [`Failure`].
#[derive(Clone, PartialEq, Debug)]
pub enum Cause {
    /// A guarded quantity left its range.
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
    /// The model changes regime or branch without end, so time does not advance (Zeno behaviour or chattering).
    Chatter(Box<Chatter>),
    /// Even the shortest step missed the tolerance.
    StepTooShort {
        /// Length of the last step in s.
        step: f64,
        /// The state with the largest error.
        path: String,
        /// Its magnitude over that at which its error is controlled; large where it grows without bound.
        grown: f64,
    },
    /// The run exceeds the limit of steps.
    TooManySteps {
        /// Steps tried.
        steps: u64,
        /// The state with the largest error in the last one.
        path: String,
    },
    /// The model has no derivatives, so it cannot be integrated adaptively.
    NoDerivatives,
    /// A `stop` condition of the rig.
    Rig {
        /// As written.
        condition: String,
        /// The message to the operator.
        why: String,
    },
    /// The caller stopped the run.
    Stopped,
}

/// The regimes and conditions involved in chattering.
#[derive(Clone, PartialEq, Debug)]
pub struct Chatter {
    /// The regime of each automaton, with its part: `fr.stick`.
    pub regimes: Vec<String>,
    /// The conditions that changed, as written: `fr: v < 0`.
    pub conditions: Vec<String>,
    /// The least number of changes.
    pub times: usize,
    /// The time span of these changes in s; 0 if at one instant.
    pub within: f64,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let time = format::time(self.time);
        match &self.cause {
            Cause::Guard { guard, value } => {
                let Guard { path, unit, .. } = &**guard;
                let value = format::quantity(*value, unit, 3);
                let (low, _) = guard.bounds(|bound| format::plain(unit.from_si(bound)));
                let (_, high) = guard.bounds(|bound| format::quantity(bound, unit, 3));
                write!(f, "`{path}` left its range {low} .. {high}: it is {value} at {time}")
            }
            Cause::NotFinite { path, value } if value.is_nan() => {
                write!(f, "`{path}` is not a number at {time}")
            }
            Cause::NotFinite { path, .. } => write!(f, "`{path}` is infinite at {time}"),
            Cause::Chatter(chatter) => write!(f, "chatters at {time}: {chatter}"),
            Cause::StepTooShort { path, grown, .. } if *grown > 1e9 => write!(
                f,
                "`{path}` grows without bound up to {time}: check the signs in its equation, where it may drive itself"
            ),
            Cause::StepTooShort { step, path, .. } => {
                let step = format::time(*step);
                write!(
                    f,
                    "steps of {step} at {time} are still too long for the tolerance: `{path}` jumps, or the tolerance is too tight"
                )
            }
            Cause::TooManySteps { steps, path } => write!(
                f,
                "{steps} steps were tried and the run is only at {time}: `{path}` keeps them short; another `tol` may suit it better, or a fixed step"
            ),
            Cause::NoDerivatives => write!(f, "the model offers no derivatives: give a `solver` with a step"),
            Cause::Rig { condition, why } => write!(f, "the rig stops at {time}: {why} (`{condition}`)"),
            Cause::Stopped => write!(f, "stopped at {time}"),
        }
    }
}

impl fmt::Display for Chatter {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let conditions: Vec<String> = self.conditions.iter().map(|text| format!("`{text}`")).collect();
        let what = if conditions.is_empty() { "its regimes".into() } else { conditions.join(" and ") };
        let within = format::time(self.within);
        if self.within > 0.0 && self.times > 1 {
            write!(f, "{what} turned more than {} times within {within}", self.times)?;
        } else if self.within > 0.0 {
            write!(f, "{what} turns again and again, in steps of {within}")?;
        } else {
            write!(f, "{what} turned more often than there are regimes, at one instant")?;
        }
        if !self.regimes.is_empty() {
            write!(f, ", last in {}", self.regimes.join(", "))?;
        }
        write!(f, "; let the model hold (a stick regime, a bristle, a smooth sign), or take a fixed step")
    }
}

impl std::error::Error for Failure {}

/// A reason to stop, and the time.
pub(crate) struct Stop {
    pub(crate) cause: Cause,
    pub(crate) time: f64,
}

#[test]
fn work_is_told_in_a_line() {
    let fixed = Work { steps: 2000, ..Work::default() };
    assert_eq!(fixed.to_string(), "2000 steps");
    let adaptive = Work { steps: 100, stiff_steps: 60, rejected: 7, evaluations: 1000, events: 1, ..fixed };
    assert_eq!(adaptive.to_string(), "100 steps (60 stiff, 40 explicit), 7 tried again, 1 event");
}
