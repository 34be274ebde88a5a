//! The syntax tree: the text as written, with the span of every part.
//!
//! Nothing is checked beyond the concrete syntax, with one exception: within a model, the declared names decide whether
//! `dz/dt` is a derivative or a division (docs/language.md), so the tree holds that decision. Knows nothing of meaning.

use crate::span::Span;

/// A whole text.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct File {
    /// Items in the order of the text, without unreadable ones, which have been reported.
    pub items: Vec<Item>,
    /// Names declared outside of all items or by an unreadable item, which has been reported. Uses of these names are
    /// not further errors.
    pub lost: Vec<String>,
}

/// An identifier.
#[derive(Clone, PartialEq, Debug)]
pub struct Name {
    /// The characters.
    pub text: String,
    /// Span of the identifier.
    pub span: Span,
}

/// A unit as written, without the brackets of a declaration: `N·s/m`, `1`, `%`.
#[derive(Clone, PartialEq, Debug)]
pub struct UnitText {
    /// The characters.
    pub text: String,
    /// Span of the characters.
    pub span: Span,
}

/// A string between double quotes, without them.
#[derive(Clone, PartialEq, Debug)]
pub struct Text {
    /// The characters.
    pub text: String,
    /// Span including the quotes.
    pub span: Span,
}

/// One top-level item of a file.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum Item {
    Import(Import),
    Const(Const),
    Function(Function),
    Table(Table),
    Interface(Interface),
    Model(Model),
    Variant(Variant),
    Experiment(Experiment),
    Fit(Fit),
    Device(Device),
    Rig(Rig),
}

/// `import std.friction` or `import "file.fric"`.
#[derive(Clone, PartialEq, Debug)]
pub struct Import {
    /// What is imported.
    pub source: ImportSource,
    /// Span of the whole item.
    pub span: Span,
}

/// Where an import comes from.
#[derive(Clone, PartialEq, Debug)]
pub enum ImportSource {
    /// A module of the library, dotted: `std.friction`.
    Library(Name),
    /// A file, relative to the importing one.
    File(Text),
}

/// `const g_n [m/s^2] = 9.81 m/s^2`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Const {
    pub name: Name,
    pub unit: Option<UnitText>,
    pub value: Expr,
    pub doc: Option<String>,
    pub span: Span,
}

/// `fn slip(v [m/s], vt [m/s]) = tanh(v / vt)`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Function {
    pub name: Name,
    pub args: Vec<Argument>,
    pub unit: Option<UnitText>,
    pub body: Expr,
    pub doc: Option<String>,
    pub span: Span,
}

/// An argument of a function or table. Without a unit it is dimensionless.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Argument {
    pub name: Name,
    pub unit: Option<UnitText>,
}

/// `table F(v [m/s]) [N] = linear { 0 mm/s: 1.5 N, 1 mm/s: 1.2 N }`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Table {
    pub name: Name,
    pub arg: Argument,
    pub unit: Option<UnitText>,
    pub shape: TableShape,
    pub points: TablePoints,
    pub doc: Option<String>,
    pub span: Span,
}

/// Interpolation of a table.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum TableShape {
    /// Linear interpolation.
    Linear,
    /// Monotone cubic interpolation.
    Smooth,
}

/// The points of a table.
#[derive(Clone, PartialEq, Debug)]
pub enum TablePoints {
    /// Listed as (argument, value).
    Listed(Vec<(Expr, Expr)>),
    /// Two columns of a file.
    File(Text),
}

/// `interface Friction { input v [m/s]  output F [N] }`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Interface {
    pub name: Name,
    /// Declarations of kind `Input` or `Output`; one with a value is optional.
    pub ports: Vec<Declaration>,
    pub doc: Option<String>,
    pub span: Span,
}

/// `model LuGre { … }`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Model {
    pub name: Name,
    pub body: Vec<Statement>,
    pub doc: Option<String>,
    pub span: Span,
}

/// `model TableLuGre = LuGre(Fc = 60 N)`: a model with other values, under a name of its own.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Variant {
    pub name: Name,
    pub instance: Instance,
    pub doc: Option<String>,
    pub span: Span,
}

/// One statement of a model.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum Statement {
    Declaration(Declaration),
    Equation(Equation),
    Part(Part),
    Every(Every),
    Mode(Mode),
    When(When),
    Require(Require),
    Storage(Storage),
    Allow(Allow),
}

/// `param Fs [N] = 1.5 N in > 0  /// stiction`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Declaration {
    pub kind: DeclarationKind,
    pub name: Name,
    pub unit: Option<UnitText>,
    pub value: Option<Expr>,
    pub range: Option<Range>,
    pub doc: Option<String>,
    pub span: Span,
}

/// Kind of a declaration.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum DeclarationKind {
    Param,
    Input,
    Output,
    State,
    Let,
}

impl DeclarationKind {
    /// The keyword.
    pub fn word(self) -> &'static str {
        match self {
            DeclarationKind::Param => "param",
            DeclarationKind::Input => "input",
            DeclarationKind::Output => "output",
            DeclarationKind::State => "state",
            DeclarationKind::Let => "let",
        }
    }
}

/// A range, written after `in`.
#[derive(Clone, PartialEq, Debug)]
pub enum Range {
    /// `a .. b`, both ends included.
    Between(Expr, Expr),
    /// `> a`, `>= a`, `< a`, `<= a`: the operator is one of those four.
    Bound(BinaryOp, Expr),
}

/// `F = …`, `dz/dt = …`, `dx/ds = …` or `next(x) = …`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Equation {
    pub target: Target,
    pub value: Expr,
    pub span: Span,
}

/// The left side of an equation.
#[derive(Clone, PartialEq, Debug)]
pub enum Target {
    /// `F`
    Name(Name),
    /// `dz/dt`, `dx/ds`; `span` covers both words. The names are without the `d`.
    Derivative {
        /// The differentiated state.
        of: Name,
        /// The variable of differentiation: `t` or a state.
        along: Name,
        /// Span of both words.
        span: Span,
    },
    /// `next(x)`; `span` covers all of it.
    Next {
        /// The sampled state.
        name: Name,
        /// Span of all of `next(x)`.
        span: Span,
    },
}

impl Target {
    /// The quantity that the equation defines.
    pub fn name(&self) -> &Name {
        match self {
            Target::Name(name) | Target::Derivative { of: name, .. } | Target::Next { name, .. } => name,
        }
    }

    /// The span of the whole left side.
    pub fn span(&self) -> Span {
        match self {
            Target::Name(name) => name.span,
            Target::Derivative { span, .. } | Target::Next { span, .. } => *span,
        }
    }
}

/// `part fr : Friction = LuGre(v = body.v)`, `part el[i in 1 .. 4] = Maxwell(v = v)`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Part {
    pub name: Name,
    pub repeat: Option<Repeat>,
    pub slot: Option<SlotType>,
    pub instance: Instance,
    pub doc: Option<String>,
    pub span: Span,
}

/// `[i in 1 .. 4]`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Repeat {
    pub index: Name,
    pub first: Expr,
    pub last: Expr,
    pub span: Span,
}

/// `: Friction` or `: rotary Friction`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct SlotType {
    pub rotary: bool,
    pub interface: Name,
}

/// `LuGre(v = body.v, Fc = 2 N)`, optionally preceded by `rotary`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Instance {
    pub rotary: bool,
    pub model: Name,
    pub args: Vec<Bind>,
    pub span: Span,
}

impl Instance {
    /// The paths in the values of its arguments and of those of instances in it, in the order of the text.
    pub fn paths(&self) -> Vec<&Path> {
        let mut all = Vec::new();
        for bind in &self.args {
            all.extend(match &bind.value {
                BindValue::Expr(expr) => expr.paths(),
                BindValue::Instance(instance) => instance.paths(),
            });
        }
        all
    }
}

/// One argument of an instance: `v = body.v`, `fr = LuGre()`, `ctl.Kx = 10 1/s`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Bind {
    /// The first name.
    pub name: Name,
    /// The whole path, if it goes into a part: `ctl.Kx = 10 1/s`.
    pub inner: Option<Path>,
    pub value: BindValue,
    pub span: Span,
}

impl Bind {
    /// The path of what it sets.
    pub fn path(&self) -> Path {
        let one = || Path { segments: vec![Segment { name: self.name.clone(), index: None }], span: self.name.span };
        self.inner.clone().unwrap_or_else(one)
    }
}

/// Value of an argument.
#[derive(Clone, PartialEq, Debug)]
pub enum BindValue {
    /// A value.
    Expr(Expr),
    /// A model for a slot.
    Instance(Instance),
}

/// `every Ts { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Every {
    pub period: Expr,
    pub body: Vec<EveryStatement>,
    pub span: Span,
}

/// A statement inside `every`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum EveryStatement {
    Declaration(Declaration),
    Equation(Equation),
}

/// `mode stick initial { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Mode {
    pub name: Name,
    /// Span of the word `initial`, if it is present.
    pub initial: Option<Span>,
    pub equations: Vec<Equation>,
    pub transitions: Vec<Go>,
    /// Span from the keyword to the closing brace.
    pub span: Span,
    /// Span of `mode NAME`, for labels.
    pub head: Span,
}

/// `go slip when abs(F) > Fs { reset(z) = 0 }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Go {
    pub target: Name,
    pub condition: Expr,
    pub resets: Vec<Reset>,
    pub span: Span,
}

/// `when x rises x_max { reset(v) = -e * v }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct When {
    pub condition: Expr,
    pub resets: Vec<Reset>,
    pub span: Span,
}

/// `reset(v) = -e * v`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Reset {
    pub name: Name,
    pub value: Expr,
    pub span: Span,
}

/// `require Fs >= Fc, "message"`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Require {
    pub condition: Expr,
    pub message: Option<Text>,
    pub span: Span,
}

/// `storage 0.5 * sigma0 * z^2`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Storage {
    pub energy: Expr,
    pub span: Span,
}

/// `allow not-dissipative "as published"`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Allow {
    pub lint: Name,
    pub reason: Text,
    pub span: Span,
}

/// `experiment stick_slip { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Experiment {
    pub name: Name,
    pub body: Vec<ExperimentStatement>,
    pub doc: Option<String>,
    pub span: Span,
}

/// One statement of an experiment.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs, clippy::large_enum_variant)] // there are few
pub enum ExperimentStatement {
    Run(Run),
    Solver(Solver),
    Sweep(Sweep),
    Data(Data),
    Derived(Derived),
    Plot(Plot),
    /// `tune fr.Fs in 1 N .. 2 N, fr.vs`
    Tune(Vec<Tuned>, Span),
    Expect(Expect),
    Record(Record),
    Allow(Allow),
}

/// `fr.Fs in 1 N .. 2 N`: a parameter that may be turned, and how far.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Tuned {
    pub path: Path,
    pub range: Option<(Expr, Expr)>,
    pub span: Span,
}

/// `plot body.x [deg], r [deg] against t [s]` of a rig.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Curves {
    pub shows: Vec<Show>,
    pub against: Option<Show>,
    pub span: Span,
}

/// `run Servo(r = 1 m) for 100 s`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Run {
    /// A model, or a rig if the name begins with a lower-case letter.
    pub instance: Instance,
    pub duration: Option<Expr>,
    pub span: Span,
}

/// `solver expo step 1 ms`, `solver adaptive tol 1e-8`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Solver {
    pub method: Name,
    pub step: Option<Expr>,
    pub tol: Option<Expr>,
    pub span: Span,
}

/// `record F [N], body.v every 1 ms`: quantities of the data that a run writes.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Record {
    pub shows: Vec<Show>,
    /// The distance of its rows in time; without it each step is a row.
    pub every: Option<Expr>,
    pub span: Span,
}

/// `sweep fr = LuGre(), KFM()`, `sweep fr.Fs = 1 N .. 2 N by 0.25 N`, `sweep rate = 1 N/s .. 50 N/s log 10`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Sweep {
    pub path: Path,
    /// Further paths that take the same values: `sweep x.fr, y.fr = LuGre(), KFM()`.
    pub also: Vec<Path>,
    pub over: SweepOver,
    pub span: Span,
}

/// Values of a sweep.
#[derive(Clone, PartialEq, Debug)]
#[allow(clippy::large_enum_variant)] // there are few
pub enum SweepOver {
    /// Models for a slot.
    Instances(Vec<Instance>),
    /// Values, listed.
    Values(Vec<Expr>),
    /// Values `first .. last by step`, `first .. last log 10`.
    Grid {
        /// First value.
        first: Expr,
        /// Last value; by a step it is included if it is a whole number of steps from the first.
        last: Expr,
        /// The values between.
        spacing: Spacing,
    },
}

/// The values of a grid between its ends.
#[derive(Clone, PartialEq, Debug)]
pub enum Spacing {
    /// `by step`: in steps.
    By(Expr),
    /// `lin 5`: this number of values at equal distances.
    Lin(Expr),
    /// `log 10`: this number of values in equal ratios.
    Log(Expr),
}

/// `data "pull.csv" (t [s], x [mm])`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Data {
    pub file: Text,
    /// Further recordings of a fit, with the same columns.
    pub more: Vec<Text>,
    /// A column called `_` is skipped.
    pub columns: Vec<Column>,
    pub span: Span,
}

/// `let data.v = slope(data.x)`: a column that is computed from others, row by row.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Derived {
    pub name: Name,
    pub value: Expr,
    pub span: Span,
}

/// `x [mm] = "Position"`: a column of a recording. Without a unit it has that of the heading.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Column {
    pub name: Name,
    pub unit: Option<UnitText>,
    /// Its value stays until the next row, rather than changing linearly.
    pub hold: bool,
    /// Its heading in the file; without one it is found by its name or by its place.
    pub heading: Option<Text>,
}

/// `plot x [m], r [m] against t [s] after 1 s before 2 s title "(a)"`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Plot {
    pub curves: Vec<Curve>,
    pub against: Option<Curve>,
    pub after: Option<Expr>,
    pub before: Option<Expr>,
    pub title: Option<Text>,
    pub span: Span,
}

/// `x [mm] as "position" in 0 mm .. 5 mm log`: a quantity of a plot with its axis.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Curve {
    pub show: Show,
    pub label: Option<Text>,
    /// The ends of its axis.
    pub range: Option<(Expr, Expr)>,
    pub log: bool,
}

/// An expression with its display unit.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Show {
    pub value: Expr,
    pub unit: Option<UnitText>,
    pub span: Span,
}

/// `expect final(x) ~= 3.3 m +- 1 % after 5 s before 10 s`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Expect {
    /// The condition, or the left side of `~=`.
    pub value: Expr,
    /// `~= target +- tolerance`
    pub near: Option<(Expr, Expr)>,
    /// `Some` for `show`, which expects nothing: the display unit, if one is given.
    pub shows: Option<Option<UnitText>>,
    pub after: Option<Expr>,
    pub before: Option<Expr>,
    /// `for v = 0.3 m/s`: the cases of the sweeps to which it applies; all if empty.
    pub cases: Vec<Case>,
    pub span: Span,
}

/// One value of a sweep, `v = 0.3 m/s` or `fr = LuGre()`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Case {
    pub path: Path,
    pub value: BindValue,
    pub span: Span,
}

/// `fit tustin { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Fit {
    pub name: Name,
    pub body: Vec<FitStatement>,
    pub doc: Option<String>,
    pub span: Span,
}

/// One statement of a fit.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs, clippy::large_enum_variant)] // there are few
pub enum FitStatement {
    Experiment(ExperimentStatement),
    /// `vary Fs in 1 N .. 2 N, vs`
    Vary(Vec<Vary>, Span),
    Minimise(Minimise),
    Case(FitCase),
    /// `validate "third.csv"`: recordings that are judged and not fitted.
    Validate(Vec<Text>, Span),
}

/// `case slow { run … data … minimise … }`: one of several kinds of experiment with common unknowns.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct FitCase {
    pub name: Name,
    pub body: Vec<FitStatement>,
    pub span: Span,
}

/// `Fc = 0.8 N in 0.1 N .. 10 N`, `m = 1 kg +- 0.1 kg`, `initial(z) in -1 um .. 1 um each`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Vary {
    pub path: Path,
    /// The initial value of a state.
    pub initial: bool,
    /// Where the search starts; with `known`, also the value that is known.
    pub start: Option<Expr>,
    /// The standard deviation with which `start` is known.
    pub known: Option<Expr>,
    pub range: Option<Range>,
    /// Each recording has a value of its own.
    pub each: bool,
    pub span: Span,
}

/// `minimise rms(F - data.F) / 5 mN, rms(x - data.x) after 0.1 s`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Minimise {
    pub items: Vec<Expr>,
    pub after: Option<Expr>,
    pub before: Option<Expr>,
    pub span: Span,
}

/// `device Panel { … }` or `device Transducer from "shaft.dbc" message ShaftTorque`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Device {
    pub name: Name,
    pub body: DeviceBody,
    pub doc: Option<String>,
    pub span: Span,
}

/// Description of a device.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum DeviceBody {
    Dbc { file: Text, messages: Vec<Name> },
    Frames { params: Vec<Declaration>, frames: Vec<FrameSignal> },
}

/// `send torque [N·m] = 0 at 0x200 + node byte 0 as i16 scale T_rated / 1000`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct FrameSignal {
    /// Whether it is `send` rather than `read`.
    pub send: bool,
    pub name: Name,
    pub unit: Option<UnitText>,
    pub start: Option<Expr>,
    pub identifier: Expr,
    pub byte: Expr,
    pub format: Name,
    pub scale: Option<Expr>,
    pub doc: Option<String>,
    pub span: Span,
}

/// `rig rtfs { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Rig {
    pub name: Name,
    pub body: Vec<RigStatement>,
    pub doc: Option<String>,
    pub span: Span,
}

/// One statement of a rig.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum RigStatement {
    Run(Run),
    Rate(Expr, Span),
    Solver(Solver),
    Bus(BusDecl),
    Drive(DriveDecl),
    Part(Part),
    Hardware(Hardware),
    Wire(Wire),
    Watchdog(Expr, Span),
    /// `overrun stop` is `None`, `overrun hold N` is `Some(N)`.
    Overrun(Option<Expr>, Span),
    Predict(Name, Span),
    Safe(Vec<(Path, Expr)>, Span),
    Stop {
        condition: Expr,
        why: Text,
        span: Span,
    },
    Record(Vec<Show>, Span),
    Plot(Curves),
    Tune(Vec<Tuned>, Span),
    Allow(Allow),
}

/// `bus can0 = can("can0", 1 Mbit/s)`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct BusDecl {
    pub name: Name,
    pub kind: Name,
    pub args: Vec<BusArg>,
    pub span: Span,
}

/// An argument of a bus.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum BusArg {
    Text(Text),
    Expr(Expr),
}

/// `drive load = cia402(can0, node = 3)` or `device shaft = Transducer(can0)`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct DriveDecl {
    /// Whether it is a `drive` rather than a `device`.
    pub moves: bool,
    pub name: Name,
    pub kind: Name,
    pub bus: Name,
    pub args: Vec<(Name, DriveArg)>,
    pub span: Span,
}

/// An argument of a drive: a value, or a range as in `travel = -1 rad .. 1 rad`.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub enum DriveArg {
    Expr(Expr),
    Range(Expr, Expr),
}

/// `hardware body { … }`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Hardware {
    pub part: Name,
    pub wires: Vec<Wire>,
    pub span: Span,
}

/// `load.torque = -F_load limit -1 N·m .. 1 N·m slew 200 N·m/s`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Wire {
    pub path: Path,
    pub value: Expr,
    pub limit: Option<(Expr, Expr)>,
    pub slew: Option<Expr>,
    pub span: Span,
}

/// `body.x`, `el[2].f`, `Fs`: one or more names.
#[derive(Clone, PartialEq, Debug)]
pub struct Path {
    /// At least one segment.
    pub segments: Vec<Segment>,
    /// Span from the first to the last segment.
    pub span: Span,
}

/// One name of a path and its optional index.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Segment {
    pub name: Name,
    pub index: Option<u32>,
}

impl Path {
    /// The name, if the path is a single name without index.
    pub fn single(&self) -> Option<&Name> {
        match self.segments.as_slice() {
            [Segment { name, index: None }] => Some(name),
            _ => None,
        }
    }

    /// The column of a recording that it names: `x` of `data.x`.
    pub fn column(&self) -> Option<&Name> {
        match self.segments.as_slice() {
            [data, column, ..] if data.name.text == "data" => Some(&column.name),
            _ => None,
        }
    }
}

/// An expression and its span.
#[derive(Clone, PartialEq, Debug)]
pub struct Expr {
    /// Kind and operands.
    pub kind: ExprKind,
    /// Span without surrounding parentheses.
    pub span: Span,
}

impl Expr {
    /// The paths in it, in the order of the text; without those in the windows of measures.
    pub fn paths(&self) -> Vec<&Path> {
        match &self.kind {
            ExprKind::Path(path) => vec![path],
            ExprKind::Call { args, .. } => args.iter().flat_map(Expr::paths).collect(),
            ExprKind::Unary(_, a) => a.paths(),
            ExprKind::Binary(_, _, a, b) => [a, b].into_iter().flat_map(|one| one.paths()).collect(),
            ExprKind::If(a, b, c) => [a, b, c].into_iter().flat_map(|one| one.paths()).collect(),
            ExprKind::Number { .. } | ExprKind::Derivative { .. } | ExprKind::Hole | ExprKind::Error => Vec::new(),
        }
    }
}

/// The kinds of expression.
#[derive(Clone, PartialEq, Debug)]
pub enum ExprKind {
    /// `10 mm`: the number as written times the unit as written.
    Number {
        /// Value before the unit is applied.
        value: f64,
        /// Unit that directly follows the number.
        unit: Option<UnitText>,
    },
    /// A name or path; also `t`, `pi`, `inf`, `true`, `false`.
    Path(Path),
    /// `dz/dt`, `dx/ds`, names without the `d`.
    Derivative {
        /// The differentiated state.
        of: Name,
        /// The variable of differentiation: `t` or a state.
        along: Name,
    },
    /// `max(a, b)`
    Call {
        /// The function, table, signal, operator (`delay`) or measure.
        function: Name,
        /// At least one.
        args: Vec<Expr>,
        /// For a measure: the part of the run over which it is taken.
        window: Option<Box<Window>>,
    },
    /// `-a`, `not a`
    Unary(UnaryOp, Box<Expr>),
    /// `a + b`; the span is that of the operator.
    Binary(BinaryOp, Span, Box<Expr>, Box<Expr>),
    /// `if c then a else b`
    If(Box<Expr>, Box<Expr>, Box<Expr>),
    /// `?`
    Hole,
    /// An unreadable expression, which has been reported.
    Error,
}

/// `after 1 s before first(v > 0)`
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Window {
    pub after: Option<Expr>,
    pub before: Option<Expr>,
}

/// Unary operators.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum UnaryOp {
    Negate,
    Not,
}

/// Binary operators.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum BinaryOp {
    Add,
    Subtract,
    Multiply,
    Divide,
    Power,
    Less,
    LessEqual,
    Greater,
    GreaterEqual,
    Equal,
    NotEqual,
    And,
    Or,
    Crosses,
    Rises,
    Falls,
}

impl UnaryOp {
    /// Precedence, on the scale of [`BinaryOp::binds`].
    pub fn binds(self) -> u8 {
        match self {
            UnaryOp::Not => 3,
            UnaryOp::Negate => 7,
        }
    }
}

impl BinaryOp {
    /// Precedence: 1 is the lowest.
    pub fn binds(self) -> u8 {
        match self {
            BinaryOp::Or => 1,
            BinaryOp::And => 2,
            BinaryOp::Less
            | BinaryOp::LessEqual
            | BinaryOp::Greater
            | BinaryOp::GreaterEqual
            | BinaryOp::Equal
            | BinaryOp::NotEqual
            | BinaryOp::Crosses
            | BinaryOp::Rises
            | BinaryOp::Falls => 4,
            BinaryOp::Add | BinaryOp::Subtract => 5,
            BinaryOp::Multiply | BinaryOp::Divide => 6,
            BinaryOp::Power => 8,
        }
    }

    /// The operator as written.
    pub fn text(self) -> &'static str {
        match self {
            BinaryOp::Add => "+",
            BinaryOp::Subtract => "-",
            BinaryOp::Multiply => "*",
            BinaryOp::Divide => "/",
            BinaryOp::Power => "^",
            BinaryOp::Less => "<",
            BinaryOp::LessEqual => "<=",
            BinaryOp::Greater => ">",
            BinaryOp::GreaterEqual => ">=",
            BinaryOp::Equal => "==",
            BinaryOp::NotEqual => "!=",
            BinaryOp::And => "and",
            BinaryOp::Or => "or",
            BinaryOp::Crosses => "crosses",
            BinaryOp::Rises => "rises",
            BinaryOp::Falls => "falls",
        }
    }
}
