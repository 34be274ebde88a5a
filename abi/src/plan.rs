//! What to run, as plain data. Every expression in it is a quantity of the program already: a plan holds slots.

use crate::description::Slot;
use crate::rig::Bench;
pub use crate::series::{Method, PARTS, Series, Solver};
use crate::unit::Unit;
use std::fmt;
use std::sync::Arc;

/// One experiment on one instance.
#[derive(Clone, PartialEq, Debug)]
pub struct Experiment {
    /// Its name.
    pub name: String,
    /// Simulated time in s.
    pub duration: f64,
    /// How. In a dry run: how the crossed-out part is stepped, while the rig says how the rest is.
    pub solver: Solver,
    /// A dry run: the instance is the control program of a rig, and this what stands around it.
    pub bench: Option<Box<Bench>>,
    /// What is drawn and written.
    pub plots: Vec<Plot>,
    /// What must hold.
    pub expects: Vec<Expect>,
    /// Instants in s, ascending, at which a signal or a recording has a corner.
    pub corners: Vec<f64>,
    /// The system as it is stepped is what is judged: discretisation leaves no verdict open.
    pub stepped: bool,
}

/// One plot.
#[derive(Clone, PartialEq, Debug)]
pub struct Plot {
    /// Drawn upwards.
    pub series: Vec<Series>,
    /// Drawn to the right; time where none.
    pub against: Option<Series>,
}

/// One expectation.
#[derive(Clone, PartialEq, Debug)]
pub struct Expect {
    /// As written, without the word `expect`.
    pub text: String,
    /// What the condition needs.
    pub measures: Vec<Measure>,
    /// What must hold at the end.
    pub condition: Formula,
    /// The window in s: points with `after <= t <= before` count.
    pub after: f64,
    /// End of the window.
    pub before: f64,
}

/// A number taken from the course of a quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Measure {
    /// As written: `peak_to_peak(x)`.
    pub text: String,
    /// Which number.
    pub kind: MeasureKind,
    /// The quantity, after each step, in SI.
    pub slot: Slot,
    /// The unit in which the result is shown.
    pub unit: Unit,
    /// The part of the expectation's window in which it is taken.
    pub window: Window,
}

/// Begin and end of the part of a run in which a measure is taken.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Window {
    /// Its begin.
    pub after: Edge,
    /// Its end.
    pub before: Edge,
}

/// An end of a window.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub enum Edge {
    /// That of the expectation.
    #[default]
    Open,
    /// This time in s.
    At(f64),
    /// The first instant of the run at which the condition in this slot holds.
    First(Slot),
}

/// An instant that only the run shows.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Moment {
    /// When the condition in this slot first holds.
    First(Slot),
    /// When the condition in this slot first turns true, having been false.
    Rises(Slot),
    /// When the quantity in this slot is least.
    Least(Slot),
    /// When it is greatest.
    Greatest(Slot),
}

/// What a measure measures. Booleans count as 0 and 1.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum MeasureKind {
    /// Least value.
    Min,
    /// Greatest value.
    Max,
    /// Mean over time, trapezoidal.
    Mean,
    /// Root of the mean square over time.
    Rms,
    /// Integral over time.
    Integral,
    /// Value at the end of the window.
    Final,
    /// Value at this time in s, linear between points.
    At(f64),
    /// Greatest minus least.
    PeakToPeak,
    /// Number of changes of sign.
    Crossings,
    /// Mean distance of upward crossings through the mean; needs three.
    Period,
    /// Earliest time after which the value stays within this band of its final value.
    Settling(f64),
    /// First time the condition holds; inf if never.
    First,
    /// First time the condition turns true, having been false; inf if never.
    Rises,
    /// First time the condition turns; inf if never.
    Turns,
    /// Value at a moment of the run.
    AtMoment(Moment),
    /// When the quantity is least.
    TimeOfLeast,
    /// When it is greatest.
    TimeOfGreatest,
    /// Number of phases in which the condition holds; one that holds at the begin of the window counts.
    Count,
    /// How often the condition turns true, having been false.
    CountRises,
    /// How often the condition turns.
    CountTurns,
    /// For how long the condition holds, in all.
    Duration,
    /// Number of local maxima.
    Peaks,
    /// The local maximum of this number, from 1.
    Peak(f64),
    /// When it is.
    TimeOfPeak(f64),
}

/// A function that the compiler hands over, so that every machine computes it alike: numbers in their order → number.
#[derive(Clone)]
pub struct Elementary {
    /// Its name in the language.
    pub name: &'static str,
    /// Its value; a number that is missing counts as 0.
    pub at: Arc<dyn Fn(f64, f64) -> f64 + Send + Sync>,
}

impl PartialEq for Elementary {
    fn eq(&self, other: &Elementary) -> bool {
        self.name == other.name
    }
}

impl fmt::Debug for Elementary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name)
    }
}

/// Arithmetic over measures.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum Formula {
    Number(f64),
    /// Index into [`Expect::measures`].
    Measure(usize),
    Negate(Box<Formula>),
    Abs(Box<Formula>),
    Sqrt(Box<Formula>),
    Add(Box<Formula>, Box<Formula>),
    Subtract(Box<Formula>, Box<Formula>),
    Multiply(Box<Formula>, Box<Formula>),
    Divide(Box<Formula>, Box<Formula>),
    Min(Box<Formula>, Box<Formula>),
    Max(Box<Formula>, Box<Formula>),
    /// Comparisons and connectives give 1 or 0.
    Less(Box<Formula>, Box<Formula>),
    LessEqual(Box<Formula>, Box<Formula>),
    Greater(Box<Formula>, Box<Formula>),
    GreaterEqual(Box<Formula>, Box<Formula>),
    And(Box<Formula>, Box<Formula>),
    Or(Box<Formula>, Box<Formula>),
    Not(Box<Formula>),
    /// `value ~= target +- tolerance`; a relative tolerance is a fraction of the target.
    Near {
        value: Box<Formula>,
        target: Box<Formula>,
        tolerance: Box<Formula>,
        relative: bool,
    },
    /// An elementary function of one or two numbers.
    Function(Elementary, Vec<Formula>),
    /// A number that is shown in this unit and not judged.
    Shown(Unit, Box<Formula>),
    /// A comparison whose sides are shown in this unit.
    In(Unit, Box<Formula>),
}
