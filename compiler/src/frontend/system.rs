//! The flat system: one instance with all its parts as quantities and equations.
//!
//! Result of `flatten`, input of unit check, causality, analyses and `lower`. Expressions form one arena in which
//! operands precede their users, so most passes are a single walk over it. Function calls are expanded in place with
//! shared nodes for their arguments, so nothing is computed twice. Knows nothing of text or of programs.

use crate::frontend::names::nearest;
pub use crate::functions::Builtin;
use abi::unit::{Angle, Dimension, Unit};
use grammar::ast::{BinaryOp, Name};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::sync::Arc;

/// Index of a node in the arena.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct ExprId(pub u32);

/// Index of a quantity.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct VarId(pub u32);

/// Index of an instance of a model: the root instance or a part.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct InstanceId(pub u32);

/// Index of an automaton; each instance of a model with regimes has one.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct AutomatonId(pub u32);

/// Index of an `every` block.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct BlockId(pub u32);

/// One instance with all its parts.
#[derive(Clone, Debug, Default)]
pub struct System {
    /// Arena of expressions, parallel to `spans`.
    pub nodes: Vec<Node>,
    /// Span of each node.
    pub spans: Vec<Span>,
    /// Quantities in the order of the text; those of a part follow those of its owner.
    pub vars: Vec<Var>,
    /// Instances; the first is the root.
    pub instances: Vec<InstanceInfo>,
    /// Automata.
    pub automata: Vec<Automaton>,
    /// `when` statements.
    pub events: Vec<Event>,
    /// `every` blocks.
    pub blocks: Vec<Block>,
    /// `crosses`, `rises` and `falls`; each has memory of its own.
    pub crossings: Vec<Crossing>,
    /// `require` statements.
    pub requires: Vec<Require>,
    /// `storage` statements.
    pub storages: Vec<(InstanceId, ExprId)>,
    /// Bounds of repetitions, which determine the number of parts.
    pub counts: Vec<ExprId>,
    /// Tables and recordings.
    pub tables: Vec<Table>,
    /// Instants at which a signal is not smooth.
    pub corners: Vec<ExprId>,
    /// Calls of `delay`; each has memory of its own.
    pub delays: Vec<ExprId>,
    /// For the value of each reset, the span of the state's name.
    pub reset_places: Vec<(ExprId, Span)>,
    /// States whose start value is given from outside their model, and the origin of the value.
    pub starts: Vec<(VarId, Origin)>,
    /// Instances that have no rotary twin or do not match their slot. They have been reported, and their units match
    /// every unit.
    pub strangers: Vec<InstanceId>,
    /// Paths of parameters read while parts were instantiated: the number of parts depends on them.
    pub structural: Vec<String>,
}

/// An instance of a model.
#[derive(Clone, Debug)]
pub struct InstanceInfo {
    /// Dotted path; empty for the root.
    pub path: String,
    /// Name of the model.
    pub model: String,
    /// Whether it is the rotary twin.
    pub rotary: bool,
    /// Span of the model's name in `part fr = LuGre(…)`.
    pub span: Span,
    /// Names of the lints that the model itself silences.
    pub allows: Vec<String>,
}

/// A quantity.
#[derive(Clone, Debug)]
pub struct Var {
    /// Dotted path: `fr.z`.
    pub path: String,
    /// Name without path: `z`.
    pub name: String,
    /// Span of the declared name.
    pub span: Span,
    /// Owning instance.
    pub instance: InstanceId,
    /// Kind of its declaration.
    pub kind: VarKind,
    /// Declared unit and its span.
    pub unit: Option<(Unit, Span)>,
    /// Whether the declared unit could not be read; it then matches every unit.
    pub unreadable: bool,
    /// Unit of the number in its declaration, for display if no unit is declared.
    pub shown: Option<Unit>,
    /// Declared range.
    pub range: VarRange,
    /// Span of the range.
    pub range_span: Option<Span>,
    /// How its value is determined.
    pub definition: Definition,
    /// Doc comment.
    pub doc: Option<String>,
}

/// Kind of a declaration.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum VarKind {
    Param,
    Input,
    Output,
    State,
    Let,
    /// Observed by an experiment.
    Observed,
}

impl VarKind {
    /// The kind as a word for messages.
    pub fn word(self) -> &'static str {
        match self {
            VarKind::Param => "param",
            VarKind::Input => "input",
            VarKind::Output => "output",
            VarKind::State => "state",
            VarKind::Let => "let",
            VarKind::Observed => "expression",
        }
    }
}

/// Bounds of a range; a strict bound itself is excluded.
#[derive(Clone, Copy, Debug, Default)]
pub struct VarRange {
    /// Lower bound and whether it is strict.
    pub low: Option<(ExprId, bool)>,
    /// Upper bound and whether it is strict.
    pub high: Option<(ExprId, bool)>,
}

/// How the value of a quantity is determined.
#[derive(Clone, Debug)]
pub enum Definition {
    /// Missing or refused; has been reported.
    Missing,
    /// Given from outside.
    Free,
    /// An expression of other quantities at the same instant.
    Value(ExprId, Origin),
    /// A continuous state.
    Continuous {
        /// Value at the start.
        initial: ExprId,
        /// dx/dt; for a path equation already multiplied by ds/dt.
        rate: ExprId,
        /// The path equation as written: dx/ds, and s.
        path: Option<(ExprId, VarId)>,
        /// Span of the left side.
        span: Span,
    },
    /// A sampled state.
    Sampled {
        /// Value at the start.
        initial: ExprId,
        /// Value after a tick.
        next: ExprId,
        /// Its `every` block.
        block: BlockId,
    },
    /// Assigned at ticks and held between them.
    Held {
        /// Value at a tick.
        value: ExprId,
        /// Its `every` block.
        block: BlockId,
        /// Span of the left side.
        origin: Origin,
    },
}

/// Origin of a definition, for messages.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Origin {
    /// `F = …`, in the model or in its declaration; with the span of the name.
    Equation(Span),
    /// A default.
    Default,
    /// `Model(v = …)`: with the spans of the model's name and of the whole argument.
    Argument {
        /// `LuGre`
        model: Span,
        /// `v = body.v`
        bind: Span,
    },
    /// Given on the command line or by a sweep.
    Override,
}

/// One operation of the arena.
#[derive(Clone, PartialEq, Debug)]
pub enum Node {
    /// A number in SI units.
    Number {
        /// Value in SI units.
        value: f64,
        /// Dimension; `None` matches every dimension (0 and inf).
        dimension: Option<Dimension>,
        /// Angle annotation of the unit as written.
        angle: Angle,
    },
    /// `true`, `false`
    Bool(bool),
    /// `t`
    Time,
    /// A quantity at this instant.
    Var(VarId),
    /// `dz/dt` as a value.
    Rate(VarId),
    /// `dx/ds` as a value.
    PathRate(VarId),
    /// `-a`
    Negate(ExprId),
    /// `not a`
    Not(ExprId),
    /// `a + b`, …; crossings have a node of their own.
    Binary(BinaryOp, ExprId, ExprId),
    /// `if c then a else b`
    If(ExprId, ExprId, ExprId),
    /// A built-in function.
    Call(Builtin, Box<[ExprId]>),
    /// Value of a table at an argument.
    Table(u32, ExprId),
    /// Whether this regime is active.
    InRegime(AutomatonId, u32),
    /// A crossing, by its index.
    Crossing(u32),
    /// A value that must have the dimension of this unit: an argument or result of a function.
    Fits {
        /// The value, which the node returns unchanged.
        value: ExprId,
        /// The unit that is stated, whose dimension is required.
        unit: Box<Unit>,
        /// Reason for the requirement.
        role: Role,
    },
    /// A measure over a run; occurs only in expectations.
    Measure(MeasureName, ExprId, Option<ExprId>, Window),
    /// `?`
    Hole,
    /// An error, which has been reported.
    Error,
}

/// The part of a run over which a measure is taken; bounded by times, or by the first instants of conditions.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Window {
    /// Its start.
    pub after: Option<ExprId>,
    /// Its end.
    pub before: Option<ExprId>,
}

/// Reason why a value must have a dimension.
#[derive(Clone, PartialEq, Debug)]
pub enum Role {
    /// Argument `name` of `function`.
    Argument {
        /// The function.
        function: String,
        /// The argument.
        name: String,
    },
    /// Result of `function`.
    Result {
        /// The function or constant.
        function: String,
    },
}

/// Measures in expectations.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum MeasureName {
    Min,
    Max,
    Mean,
    Rms,
    Integral,
    Final,
    At,
    PeakToPeak,
    Crossings,
    Period,
    Settling,
    First,
    /// `first(a rises b)`
    Rises,
    /// `first(a crosses b)`
    Turns,
    /// `time(max(x))`
    Time,
    Count,
    /// `count(a rises b)`
    CountRises,
    /// `count(a crosses b)`
    CountTurns,
    Duration,
    Peaks,
    Peak,
}

/// Name, measure, number of arguments.
const MEASURES: &[(&str, MeasureName, usize)] = &[
    ("min", MeasureName::Min, 1),
    ("max", MeasureName::Max, 1),
    ("mean", MeasureName::Mean, 1),
    ("rms", MeasureName::Rms, 1),
    ("integral", MeasureName::Integral, 1),
    ("final", MeasureName::Final, 1),
    ("at", MeasureName::At, 2),
    ("peak_to_peak", MeasureName::PeakToPeak, 1),
    ("crossings", MeasureName::Crossings, 1),
    ("period", MeasureName::Period, 1),
    ("settling", MeasureName::Settling, 2),
    ("first", MeasureName::First, 1),
    ("time", MeasureName::Time, 1),
    ("count", MeasureName::Count, 1),
    ("duration", MeasureName::Duration, 1),
    ("peaks", MeasureName::Peaks, 1),
    ("peak", MeasureName::Peak, 2),
];

impl MeasureName {
    /// The measure of this name and its number of arguments. The caller compares the number: `min(a, b)` is a function.
    pub fn named(name: &str) -> Option<(MeasureName, usize)> {
        MEASURES.iter().find(|(known, ..)| *known == name).map(|(_, measure, args)| (*measure, *args))
    }
}

/// The automaton of one instance.
#[derive(Clone, Debug)]
pub struct Automaton {
    /// Owning instance.
    pub instance: InstanceId,
    /// Regimes in the order of the text.
    pub regimes: Vec<Regime>,
    /// Index of the initial regime.
    pub initial: u32,
}

/// One regime.
#[derive(Clone, Debug)]
pub struct Regime {
    /// Name of the regime.
    pub name: String,
    /// `mode NAME`
    pub span: Span,
    /// Transitions in the order of evaluation.
    pub transitions: Vec<Transition>,
}

/// `go OTHER when COND { … }`
#[derive(Clone, Debug)]
pub struct Transition {
    /// Index of the target regime.
    pub target: u32,
    /// Condition.
    pub condition: ExprId,
    /// States that are reset, and their new values.
    pub resets: Vec<(VarId, ExprId)>,
    /// Span of the statement.
    pub span: Span,
}

/// `when COND { … }`
#[derive(Clone, Debug)]
pub struct Event {
    /// Owning instance.
    pub instance: InstanceId,
    /// Condition; the event fires when it becomes true.
    pub condition: ExprId,
    /// States that are reset, and their new values.
    pub resets: Vec<(VarId, ExprId)>,
    /// Span of the statement.
    pub span: Span,
}

/// `every PERIOD { … }`
#[derive(Clone, Debug)]
pub struct Block {
    /// Owning instance.
    pub instance: InstanceId,
    /// Period in s.
    pub period: ExprId,
    /// Span of the statement.
    pub span: Span,
}

/// `a rises b`, `a falls b`, `a crosses b`
#[derive(Clone, Debug)]
pub struct Crossing {
    /// `Crosses`, `Rises` or `Falls`.
    pub kind: BinaryOp,
    /// The difference a − b, whose sign is observed.
    pub difference: ExprId,
}

/// `require COND, "message"`
#[derive(Clone, Debug)]
pub struct Require {
    /// Owning instance.
    pub instance: InstanceId,
    /// Condition that must hold.
    pub condition: ExprId,
    /// Message of the model's author.
    pub message: Option<String>,
    /// Span of the condition.
    pub span: Span,
}

/// A table: strictly increasing arguments and their values, in SI units.
#[derive(Clone, Debug)]
pub struct Table {
    /// Name as written.
    pub name: String,
    /// Dimension of the argument.
    pub x_unit: Unit,
    /// Dimension of the value.
    pub y_unit: Unit,
    /// Whether it interpolates by monotone cubics rather than linearly.
    pub smooth: bool,
    /// Whether each value holds up to the next argument, rather than changing linearly.
    pub held: bool,
    /// Arguments, in SI units. The columns of a recording share them.
    pub x: Arc<[f64]>,
    /// Values, in SI units.
    pub y: Arc<[f64]>,
}

impl Table {
    /// Whether it is a column of a recording, which is read at times alone. A name in a text has no point.
    pub fn is_recorded(&self) -> bool {
        self.name.starts_with("data.")
    }
}

/// E0204 for `allow` with a name that is no lint.
pub fn unknown_lint(lint: &Name) -> Option<Diagnostic> {
    let names = || LINTS.iter().map(|(name, _)| *name);
    if names().any(|name| name == lint.text) {
        return None;
    }
    let error = Diagnostic::error("E0204", format!("there is no lint `{}`", lint.text)).label(lint.span, "not known");
    Some(match nearest(&lint.text, names()) {
        Some(near) => error.help(format!("did you mean `{near}`?")),
        None => error.help(format!("lints are {}", names().collect::<Vec<_>>().join(", "))),
    })
}

/// Name and code of every lint.
pub const LINTS: &[(&str, &str)] = &[
    ("unused", "W0201"),
    ("angle", "W0107"),
    ("dead-regime", "W0311"),
    ("dead-transition", "W0312"),
    ("jumps", "W0701"),
    ("creep", "W0702"),
    ("not-dissipative", "W0703"),
    ("large-step", "W0704"),
    ("chatter", "W0705"),
    ("pushes", "W0706"),
    ("slow-sensor", "W0707"),
    ("emulation-limit", "W0801"),
    ("coarse-encoder", "W0802"),
    ("coarse-speed", "W0803"),
    ("coarse-torque", "W0804"),
    ("bus-load", "W0805"),
    ("dbc-unit", "W0806"),
    ("no-drive-timeout", "W0807"),
    ("recording-ends", "W0901"),
    ("unidentified", "W0910"),
    ("at-bound", "W0902"),
    ("rough", "W0906"),
    ("model-error", "W0903"),
    ("drift", "W0904"),
    ("gap", "W0905"),
    ("outliers", "W0907"),
    ("start", "W0908"),
    ("lone", "W0909"),
    ("unsettled", "W0911"),
    ("coarse", "W0912"),
];

impl System {
    /// The quantity that an expression merely names, if it is no more than that.
    pub fn alias(&self, id: ExprId) -> Option<VarId> {
        match self.node(id) {
            Node::Var(var) => Some(*var),
            Node::Fits { value, .. } => self.alias(*value),
            _ => None,
        }
    }

    /// The value of a literal with its sign, or of a sum, product or quotient of literals.
    pub fn literal(&self, id: ExprId) -> Option<f64> {
        match self.node(id) {
            Node::Number { value, .. } => Some(*value),
            Node::Negate(a) => Some(-self.literal(*a)?),
            Node::Fits { value, .. } => self.literal(*value),
            Node::Binary(op, a, b) => {
                let (a, b) = (self.literal(*a)?, self.literal(*b)?);
                match op {
                    BinaryOp::Add => Some(a + b),
                    BinaryOp::Subtract => Some(a - b),
                    BinaryOp::Multiply => Some(a * b),
                    BinaryOp::Divide => Some(a / b),
                    _ => None,
                }
            }
            _ => None,
        }
    }

    /// Origin of a state's start value: its own declaration, or the user of the model.
    pub fn start_origin(&self, state: VarId) -> Origin {
        self.starts.iter().find(|(of, _)| *of == state).map_or(Origin::Default, |(_, origin)| *origin)
    }

    /// Appends a node to the arena.
    pub fn push(&mut self, node: Node, span: Span) -> ExprId {
        self.nodes.push(node);
        self.spans.push(span);
        ExprId(self.nodes.len() as u32 - 1)
    }

    /// The node with this index.
    pub fn node(&self, id: ExprId) -> &Node {
        &self.nodes[id.0 as usize]
    }

    /// The span of a node.
    pub fn span(&self, id: ExprId) -> Span {
        self.spans[id.0 as usize]
    }

    /// The span of the state's name in the reset with this value.
    pub fn reset_place(&self, value: ExprId) -> Span {
        self.reset_places.iter().find(|(of, _)| *of == value).map_or(self.span(value), |(_, place)| *place)
    }

    /// The quantity with this index.
    pub fn var(&self, id: VarId) -> &Var {
        &self.vars[id.0 as usize]
    }

    /// The indices of all quantities.
    pub fn var_ids(&self) -> impl Iterator<Item = VarId> + use<> {
        (0..self.vars.len() as u32).map(VarId)
    }

    /// The instance with this index.
    pub fn instance(&self, id: InstanceId) -> &InstanceInfo {
        &self.instances[id.0 as usize]
    }
}

impl Node {
    /// The operands, in order.
    pub fn operands(&self) -> impl Iterator<Item = ExprId> + '_ {
        let (fixed, list): ([Option<ExprId>; 4], &[ExprId]) = match self {
            Node::Number { .. } | Node::Bool(_) | Node::Time | Node::Var(_) | Node::Rate(_) | Node::PathRate(_) => {
                ([None; 4], &[])
            }
            Node::InRegime(..) | Node::Crossing(_) | Node::Hole | Node::Error => ([None; 4], &[]),
            Node::Negate(a) | Node::Not(a) | Node::Table(_, a) | Node::Fits { value: a, .. } => {
                ([Some(*a), None, None, None], &[])
            }
            Node::Binary(_, a, b) => ([Some(*a), Some(*b), None, None], &[]),
            Node::If(a, b, c) => ([Some(*a), Some(*b), Some(*c), None], &[]),
            Node::Measure(_, a, b, window) => ([Some(*a), *b, window.after, window.before], &[]),
            Node::Call(_, args) => ([None; 4], args),
        };
        fixed.into_iter().flatten().chain(list.iter().copied())
    }
}
