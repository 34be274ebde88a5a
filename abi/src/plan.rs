//! The plan of an experiment, as plain data. All expressions are quantities of the program, so a plan only refers to
//! slots.

use crate::description::Slot;
use crate::rig::Bench;
pub use crate::series::{Method, PARTS, Series, Solver, Steps};
use crate::unit::Unit;
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

/// One experiment on one instance.
#[derive(Clone, PartialEq, Debug)]
pub struct Experiment {
    /// Its name.
    pub name: String,
    /// Simulated time in s.
    pub duration: f64,
    /// The method. In a software-in-the-loop run: that of the plant, while the rig has its own for the control program.
    pub solver: Solver,
    /// A software-in-the-loop run: the instance is the control program of a rig, and this is its surroundings.
    pub bench: Option<Box<Bench>>,
    /// The plots to draw and write.
    pub plots: Vec<Plot>,
    /// Further quantities of the data, which no plot draws.
    pub records: Vec<Series>,
    /// The distance of the rows of the data in s; `None`: each step is a row.
    pub every: Option<f64>,
    /// The conditions that must hold.
    pub expects: Vec<Expect>,
    /// Instants in s, ascending, at which a signal or a recording has a corner.
    pub corners: Vec<f64>,
    /// The system is judged as it is stepped: the discretisation error leaves no verdict undecided.
    pub stepped: bool,
}

impl Experiment {
    /// The quantities of its data: what is recorded, and what the plots draw.
    pub fn recorded(&self) -> impl Iterator<Item = &Series> {
        let drawn = self.plots.iter().flat_map(|plot| plot.series.iter().chain(&plot.against));
        self.records.iter().chain(drawn)
    }

    /// The experiment without plots and data.
    pub fn unrecorded(&self) -> Experiment {
        Experiment { plots: Vec::new(), records: Vec::new(), every: None, ..self.clone() }
    }

    /// The slots that its measures, plots and data read during a run.
    pub fn reads(&self) -> BTreeSet<Slot> {
        let series = self.recorded().map(|series| series.slot);
        let measures = self.expects.iter().flat_map(|expect| &expect.measures);
        series.chain(measures.flat_map(Measure::reads)).collect()
    }
}

/// One plot.
#[derive(Clone, PartialEq, Debug)]
pub struct Plot {
    /// Quantities on the vertical axis.
    pub series: Vec<Series>,
    /// Quantity on the horizontal axis; `None`: time.
    pub against: Option<Series>,
    /// How it is drawn.
    pub view: View,
}

/// How a plot is drawn. Nothing of it changes the run.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct View {
    /// Above the axes.
    pub title: Option<String>,
    /// Points from this time on, in s.
    pub after: Option<f64>,
    /// Points up to this time, in s.
    pub before: Option<f64>,
    /// How each quantity on the vertical axis looks: as many as it has curves.
    pub looks: Vec<Look>,
    /// How the horizontal axis looks.
    pub x: Look,
    /// For measures over a parameter: then the plot has no series.
    pub across: Option<Across>,
}

/// How a quantity of a plot looks.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Look {
    /// In place of the expression.
    pub label: Option<String>,
    /// Ends of its axis in SI.
    pub range: Option<(f64, f64)>,
    /// Whether its axis is logarithmic.
    pub logarithmic: bool,
    /// Whether it was measured: it depends on columns of a recording alone.
    pub recorded: bool,
}

/// Measures of a run over a parameter: one point of a curve for each case of a sweep.
#[derive(Clone, PartialEq, Debug)]
pub struct Across {
    /// The shown measures among [`Experiment::expects`], one for each curve.
    pub measures: Vec<usize>,
    /// The parameter as written: `vp`.
    pub label: String,
    /// Its value in this case, in SI.
    pub value: f64,
    /// The unit it is shown in.
    pub unit: Unit,
}

/// An expectation.
#[derive(Clone, PartialEq, Debug)]
pub struct Expect {
    /// As written, without the word `expect`.
    pub text: String,
    /// The measures that the condition uses.
    pub measures: Vec<Measure>,
    /// The condition that must hold at the end.
    pub condition: Formula,
    /// Start of the window in s: points with `after <= t <= before` count.
    pub after: f64,
    /// End of the window in s.
    pub before: f64,
}

/// A number that is computed from the time series of a quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Measure {
    /// As written: `peak_to_peak(x)`.
    pub text: String,
    /// How it is computed.
    pub kind: MeasureKind,
    /// The quantity, after each step, in SI.
    pub slot: Slot,
    /// The unit in which the result is shown.
    pub unit: Unit,
    /// The part of the expectation's window that it covers.
    pub window: Window,
}

impl Measure {
    /// The slots that it reads: of the quantity, of the edges of its window, and of an instant of the run.
    fn reads(&self) -> impl Iterator<Item = Slot> {
        let edge = |edge: Edge| match edge {
            Edge::First(slot) => Some(slot),
            Edge::Open | Edge::At(_) => None,
        };
        let moment = if let MeasureKind::AtMoment(moment) = self.kind {
            let (Moment::First(slot) | Moment::Rises(slot) | Moment::Least(slot) | Moment::Greatest(slot)) = moment;
            Some(slot)
        } else {
            None
        };
        let edges = [edge(self.window.after), edge(self.window.before)];
        [Some(self.slot), moment].into_iter().chain(edges).flatten()
    }
}

/// The part of a run that a measure covers.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Window {
    /// Start.
    pub after: Edge,
    /// End.
    pub before: Edge,
}

/// An end of a window.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub enum Edge {
    /// The start or end of the expectation's window.
    #[default]
    Open,
    /// This time in s.
    At(f64),
    /// The first instant of the run at which the condition in this slot holds.
    First(Slot),
}

/// An instant that is only known from the run.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Moment {
    /// When the condition in this slot first holds.
    First(Slot),
    /// When the condition in this slot first becomes true, having been false.
    Rises(Slot),
    /// When the quantity in this slot has its minimum.
    Least(Slot),
    /// When the quantity in this slot has its maximum.
    Greatest(Slot),
}

/// How a measure is computed. Booleans count as 0 and 1.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum MeasureKind {
    /// Smallest value.
    Min,
    /// Largest value.
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
    /// Largest minus smallest value.
    PeakToPeak,
    /// Number of changes of sign.
    Crossings,
    /// Mean interval between upward crossings of the mean; needs three.
    Period,
    /// Earliest time after which the value stays within this band of its final value.
    Settling(f64),
    /// First time at which the condition holds; inf if never.
    First,
    /// First time at which the condition becomes true, having been false; inf if never.
    Rises,
    /// First time at which the condition changes; inf if never.
    Turns,
    /// Value at an instant of the run.
    AtMoment(Moment),
    /// Time of the minimum.
    TimeOfLeast,
    /// Time of the maximum.
    TimeOfGreatest,
    /// Number of phases in which the condition holds, including one that already holds at the start of the window.
    Count,
    /// How often the condition becomes true, having been false.
    CountRises,
    /// How often the condition changes.
    CountTurns,
    /// Total time for which the condition holds.
    Duration,
    /// Number of local maxima.
    Peaks,
    /// The local maximum with this number, from 1.
    Peak(f64),
    /// Time of the local maximum with this number.
    TimeOfPeak(f64),
}

/// An elementary function that the compiler provides, so that every machine computes the same bits.
#[derive(Clone)]
pub struct Elementary {
    /// Its name in the language.
    pub name: &'static str,
    /// The function; a missing second argument counts as 0.
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
    /// Comparisons and connectives yield 1 or 0.
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
    /// An elementary function of one or two arguments.
    Function(Elementary, Vec<Formula>),
    /// A number that is displayed in this unit and not judged.
    Shown(Unit, Box<Formula>),
    /// A comparison whose sides are displayed in this unit.
    In(Unit, Box<Formula>),
}
