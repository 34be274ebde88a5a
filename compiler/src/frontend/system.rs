//! One whole instance as a flat set of quantities and equations.
//!
//! Expressions form one arena in which operands stand before their users, so most passes are one walk over it.
//! A function call is expanded in place: its arguments are shared nodes, so nothing is computed twice.

use abi::unit::{Angle, Dimension, Unit};
use grammar::ast::BinaryOp;
use grammar::span::Span;

/// A node of the arena.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct ExprId(pub u32);

/// A quantity.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct VarId(pub u32);

/// An instance of a model: the whole, or a part.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct InstanceId(pub u32);

/// An automaton; a model with regimes has one per instance.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct AutomatonId(pub u32);

/// A block of sampled code.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct BlockId(pub u32);

/// Everything about one instance.
#[derive(Clone, Debug, Default)]
pub struct System {
    /// Arena; `spans` runs along with it.
    pub nodes: Vec<Node>,
    /// Where each node was written.
    pub spans: Vec<Span>,
    /// Quantities in the order of the text, a part's behind its owner's.
    pub vars: Vec<Var>,
    /// Instances; the first is the whole.
    pub instances: Vec<InstanceInfo>,
    /// Automata.
    pub automata: Vec<Automaton>,
    /// `when` statements.
    pub events: Vec<Event>,
    /// `every` blocks.
    pub blocks: Vec<Block>,
    /// `crosses`, `rises`, `falls`: each has memory of its own.
    pub crossings: Vec<Crossing>,
    /// `require` statements.
    pub requires: Vec<Require>,
    /// `storage` statements.
    pub storages: Vec<(InstanceId, ExprId)>,
    /// Bounds of repetitions: how many parts there are.
    pub counts: Vec<ExprId>,
    /// Tables and recordings.
    pub tables: Vec<Table>,
    /// Instants at which a signal has a corner.
    pub corners: Vec<ExprId>,
    /// Calls of `delay`: each has memory of its own.
    pub delays: Vec<ExprId>,
    /// Where the state of a reset is named, by the value it is given.
    pub reset_places: Vec<(ExprId, Span)>,
    /// States whose start value is given from outside of their model, and by whom.
    pub starts: Vec<(VarId, Origin)>,
    /// Instances that cannot be made rotary or do not fit their slot: reported, and their units fit everything.
    pub strangers: Vec<InstanceId>,
    /// Paths of parameters that were read while parts were made: how many there are follows from them.
    pub structural: Vec<String>,
}

/// An instance of a model.
#[derive(Clone, Debug)]
pub struct InstanceInfo {
    /// Dotted path; empty for the whole.
    pub path: String,
    /// Name of the model.
    pub model: String,
    /// The rotary twin.
    pub rotary: bool,
    /// Where it is made: the model's name in `part fr = LuGre(…)`.
    pub span: Span,
    /// Names of its own lints that are silenced.
    pub allows: Vec<String>,
}

/// A quantity.
#[derive(Clone, Debug)]
pub struct Var {
    /// Dotted path: `fr.z`.
    pub path: String,
    /// Its own name: `z`.
    pub name: String,
    /// Where the name is declared.
    pub span: Span,
    /// Owner.
    pub instance: InstanceId,
    /// What it was declared as.
    pub kind: VarKind,
    /// Declared unit and its place.
    pub unit: Option<(Unit, Span)>,
    /// Whether a unit is declared that could not be read: it fits everything.
    pub unreadable: bool,
    /// Unit of the number it is given where it is declared: for display, if no unit is declared.
    pub shown: Option<Unit>,
    /// Declared range.
    pub range: VarRange,
    /// Where the range stands.
    pub range_span: Option<Span>,
    /// How its value is found.
    pub definition: Definition,
    /// Doc comment.
    pub doc: Option<String>,
}

/// What a quantity was declared as.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum VarKind {
    Param,
    Input,
    Output,
    State,
    Let,
    /// Asked for by an experiment.
    Observed,
}

impl VarKind {
    /// In messages.
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

/// Bounds of a range; strict ones are not reached.
#[derive(Clone, Copy, Debug, Default)]
pub struct VarRange {
    /// Lower bound and whether it is strict.
    pub low: Option<(ExprId, bool)>,
    /// Upper bound and whether it is strict.
    pub high: Option<(ExprId, bool)>,
}

/// How the value of a quantity is found.
#[derive(Clone, Debug)]
pub enum Definition {
    /// It is not; reported.
    Missing,
    /// Comes from outside.
    Free,
    /// An expression of other quantities at the same instant.
    Value(ExprId, Origin),
    /// A continuous state.
    Continuous {
        /// At the start.
        initial: ExprId,
        /// dx/dt; of a path equation already the product with ds/dt.
        rate: ExprId,
        /// The equation as written along a path: dx/ds, and s.
        path: Option<(ExprId, VarId)>,
        /// Where the left side stands.
        span: Span,
    },
    /// A sampled state.
    Sampled {
        /// At the start.
        initial: ExprId,
        /// After a tick.
        next: ExprId,
        /// Its block.
        block: BlockId,
    },
    /// Assigned at ticks and held between them.
    Held {
        /// At a tick.
        value: ExprId,
        /// Its block.
        block: BlockId,
        /// Where the left side stands.
        origin: Origin,
    },
}

/// Who wrote a definition: for messages.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Origin {
    /// `F = …`, in the model or in its declaration; the place of the name.
    Equation(Span),
    /// A default.
    Default,
    /// `Model(v = …)`: the place of the model's name, and of the whole argument.
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
    /// A number in SI. Without a dimension it fits any: 0 and inf.
    Number {
        /// In SI.
        value: f64,
        /// None: fits any.
        dimension: Option<Dimension>,
        /// As written.
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
    /// `a + b`, …; not the crossings.
    Binary(BinaryOp, ExprId, ExprId),
    /// `if c then a else b`
    If(ExprId, ExprId, ExprId),
    /// A built-in function.
    Call(Builtin, Box<[ExprId]>),
    /// A table at an argument.
    Table(u32, ExprId),
    /// Whether this regime is active.
    InRegime(AutomatonId, u32),
    /// A crossing of this number.
    Crossing(u32),
    /// A value that must have this dimension: an argument or result of a function.
    Fits {
        /// The value, handed on.
        value: ExprId,
        /// What it must have.
        dimension: Dimension,
        /// Why.
        role: Role,
    },
    /// A measure over the course of a value; only in expectations.
    Measure(MeasureName, ExprId, Option<ExprId>, Window),
    /// `?`
    Hole,
    /// Reported already.
    Error,
}

/// Over which part of a run a measure is taken: from a time or from the first instant of a condition, and so on.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Window {
    /// Its begin.
    pub after: Option<ExprId>,
    /// Its end.
    pub before: Option<ExprId>,
}

/// Why a value must have a dimension.
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

/// Built-in functions and signals.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum Builtin {
    Abs,
    Sign,
    Min,
    Max,
    Clamp,
    Floor,
    Sqrt,
    Exp,
    Expm1,
    Log,
    Log1p,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Atan2,
    Sinh,
    Cosh,
    Tanh,
    Hypot,
    Random,
    Step,
    Ramp,
    Pulse,
    Sine,
    Square,
    Chirp,
    Noise,
    Delay,
}

/// Name, function, least and greatest number of arguments.
const BUILTINS: &[(&str, Builtin, usize)] = &[
    ("abs", Builtin::Abs, 1),
    ("sign", Builtin::Sign, 1),
    ("min", Builtin::Min, 2),
    ("max", Builtin::Max, 2),
    ("clamp", Builtin::Clamp, 3),
    ("floor", Builtin::Floor, 1),
    ("sqrt", Builtin::Sqrt, 1),
    ("exp", Builtin::Exp, 1),
    ("expm1", Builtin::Expm1, 1),
    ("log", Builtin::Log, 1),
    ("log1p", Builtin::Log1p, 1),
    ("sin", Builtin::Sin, 1),
    ("cos", Builtin::Cos, 1),
    ("tan", Builtin::Tan, 1),
    ("asin", Builtin::Asin, 1),
    ("acos", Builtin::Acos, 1),
    ("atan", Builtin::Atan, 1),
    ("atan2", Builtin::Atan2, 2),
    ("sinh", Builtin::Sinh, 1),
    ("cosh", Builtin::Cosh, 1),
    ("tanh", Builtin::Tanh, 1),
    ("hypot", Builtin::Hypot, 2),
    ("random", Builtin::Random, 2),
    ("step", Builtin::Step, 2),
    ("ramp", Builtin::Ramp, 3),
    ("pulse", Builtin::Pulse, 3),
    ("sine", Builtin::Sine, 2),
    ("square", Builtin::Square, 2),
    ("chirp", Builtin::Chirp, 4),
    ("noise", Builtin::Noise, 3),
    ("delay", Builtin::Delay, 2),
];

impl Builtin {
    /// The function of this name and its number of arguments.
    pub fn named(name: &str) -> Option<(Builtin, usize)> {
        BUILTINS.iter().find(|(known, ..)| *known == name).map(|(_, builtin, args)| (*builtin, *args))
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        BUILTINS.iter().find(|(_, builtin, _)| *builtin == self).expect("every built-in is listed").0
    }

    /// All names, for suggestions.
    pub fn names() -> impl Iterator<Item = &'static str> {
        BUILTINS.iter().map(|(name, ..)| *name)
    }
}

/// Measures of an expectation.
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
    /// The measure of this name with so many arguments; `min(a, b)` is a function, not a measure.
    pub fn named(name: &str) -> Option<(MeasureName, usize)> {
        MEASURES.iter().find(|(known, ..)| *known == name).map(|(_, measure, args)| (*measure, *args))
    }
}

/// One automaton.
#[derive(Clone, Debug)]
pub struct Automaton {
    /// Owner.
    pub instance: InstanceId,
    /// Regimes in the order of the text.
    pub regimes: Vec<Regime>,
    /// Number of the one it starts in.
    pub initial: u32,
}

/// One regime.
#[derive(Clone, Debug)]
pub struct Regime {
    /// Its name.
    pub name: String,
    /// `mode NAME`
    pub span: Span,
    /// Transitions in the order in which they are tried.
    pub transitions: Vec<Transition>,
}

/// `go OTHER when COND { … }`
#[derive(Clone, Debug)]
pub struct Transition {
    /// Number of the regime it leads to.
    pub target: u32,
    /// When.
    pub condition: ExprId,
    /// What is reset.
    pub resets: Vec<(VarId, ExprId)>,
    /// The statement.
    pub span: Span,
}

/// `when COND { … }`
#[derive(Clone, Debug)]
pub struct Event {
    /// Owner.
    pub instance: InstanceId,
    /// Acts when this becomes true.
    pub condition: ExprId,
    /// What is reset.
    pub resets: Vec<(VarId, ExprId)>,
    /// The statement.
    pub span: Span,
}

/// `every PERIOD { … }`
#[derive(Clone, Debug)]
pub struct Block {
    /// Owner.
    pub instance: InstanceId,
    /// In s.
    pub period: ExprId,
    /// The statement.
    pub span: Span,
}

/// `a rises b`, `a falls b`, `a crosses b`
#[derive(Clone, Debug)]
pub struct Crossing {
    /// `Crosses`, `Rises` or `Falls`.
    pub kind: BinaryOp,
    /// a − b
    pub difference: ExprId,
}

/// `require COND, "message"`
#[derive(Clone, Debug)]
pub struct Require {
    /// Owner.
    pub instance: InstanceId,
    /// What must hold.
    pub condition: ExprId,
    /// In the user's words.
    pub message: Option<String>,
    /// The condition.
    pub span: Span,
}

/// A table: strictly increasing arguments and their values, SI.
#[derive(Clone, Debug)]
pub struct Table {
    /// Name as written.
    pub name: String,
    /// Dimension of the argument.
    pub x_dimension: Dimension,
    /// Dimension of the value.
    pub y_dimension: Dimension,
    /// Monotone cubics rather than straight lines.
    pub smooth: bool,
    /// Arguments.
    pub x: Vec<f64>,
    /// Values.
    pub y: Vec<f64>,
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
    ("emulation-limit", "W0801"),
    ("coarse-encoder", "W0802"),
    ("coarse-speed", "W0803"),
    ("coarse-torque", "W0804"),
    ("bus-load", "W0805"),
    ("dbc-unit", "W0806"),
    ("no-drive-timeout", "W0807"),
];

impl System {
    /// The quantity that an expression is, and nothing more.
    pub fn alias(&self, id: ExprId) -> Option<VarId> {
        match self.node(id) {
            Node::Var(var) => Some(*var),
            Node::Fits { value, .. } => self.alias(*value),
            _ => None,
        }
    }

    /// The value of a number as written, with its sign, or of a sum, product or quotient of such numbers.
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

    /// Who wrote the start value of a state: its own declaration, or the user of the model.
    pub fn start_origin(&self, state: VarId) -> Origin {
        self.starts.iter().find(|(of, _)| *of == state).map_or(Origin::Default, |(_, origin)| *origin)
    }

    /// Puts a node into the arena.
    pub fn push(&mut self, node: Node, span: Span) -> ExprId {
        self.nodes.push(node);
        self.spans.push(span);
        ExprId(self.nodes.len() as u32 - 1)
    }

    /// The node.
    pub fn node(&self, id: ExprId) -> &Node {
        &self.nodes[id.0 as usize]
    }

    /// Where it was written.
    pub fn span(&self, id: ExprId) -> Span {
        self.spans[id.0 as usize]
    }

    /// Where the state that a reset gives this value is named.
    pub fn reset_place(&self, value: ExprId) -> Span {
        self.reset_places.iter().find(|(of, _)| *of == value).map_or(self.span(value), |(_, place)| *place)
    }

    /// The quantity.
    pub fn var(&self, id: VarId) -> &Var {
        &self.vars[id.0 as usize]
    }

    /// All quantities with their numbers.
    pub fn var_ids(&self) -> impl Iterator<Item = VarId> + use<> {
        (0..self.vars.len() as u32).map(VarId)
    }

    /// The instance.
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
