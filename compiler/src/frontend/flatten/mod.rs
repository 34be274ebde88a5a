//! Flattening: turns an instance with all its parts into one [`System`].
//!
//! In: a [`Request`] and the resolved texts. Out: a [`Flattened`]. Declares every name of the whole tree before it
//! reads any expression, so the order of the text is irrelevant. Checks names: unknown ones, arguments, slots, and that
//! each quantity is defined exactly once. Knows nothing of units or of evaluation order.

mod equations;
mod expressions;
mod frame;
mod instances;
mod slopes;

use crate::frontend::names::nearest;
use crate::frontend::resolve::{ItemRef, Loaded, Lookup, RESERVED, Space, declared_twice, reserved};
use crate::frontend::source::Sources;
use crate::frontend::system::*;
use crate::ir::hash::HashMap;
use abi::unit::{Angle, Dimension, Unit};
use grammar::ast::{self, BinaryOp, DeclarationKind, Expr, ExprKind, Item, Name, Statement, Target, UnaryOp};
use grammar::diagnostic::{Diagnostic, Recurring};
use grammar::span::{FileId, Span};
use std::rc::Rc;

pub use frame::{BusNode, Frame, RigFrame, Scope};

/// Limit on the quantities of one instance with all its parts.
pub const MOST_VARS: usize = 200_000;
/// Limit on the operations of one instance with all its parts.
pub const MOST_NODES: usize = 2_000_000;
/// Limit on the operations of a function on its own.
const MOST_NODES_OF_ITEM: usize = 100_000;
/// Number of unknown names for which suggestions are computed; users hardly read more.
const MOST_SUGGESTIONS: usize = 50;
/// Number of errors after which flattening stops.
const MOST_MISTAKES: usize = 1000;
/// Limit on the nesting of parts and of function calls.
const DEEPEST: usize = 64;

/// Why a model has no rotary twin.
#[derive(Clone, Copy)]
enum NotRotary {
    /// A unit has an angle already.
    Angle,
    /// An equation has a constant with a straight unit.
    StraightConstant,
}

/// Input of flattening: a model with arguments, as an experiment or a check requires it.
pub struct Request<'a> {
    /// The model and how its inputs are supplied.
    pub instance: Instance<'a>,
    /// Changes from outside, by path. They override the text.
    pub overrides: Vec<Override<'a>>,
    /// Expressions over the names of the instance that become quantities: plots and expectations.
    pub observed: Vec<&'a Expr>,
    /// Recordings readable as `data.NAME`.
    pub data: Vec<(String, Table, Unit)>,
    /// The rig around the instance.
    pub frame: Option<Frame<'a>>,
    /// Parameters beside those of the instance, which its arguments may name.
    pub unknowns: Vec<Declared>,
}

/// A parameter that a fit declares.
#[derive(Clone, Debug)]
pub struct Declared {
    /// Its name, as arguments read it.
    pub name: Name,
    /// Its path in the system.
    pub path: String,
    /// Its unit, if it is known.
    pub unit: Option<Unit>,
    /// Its value in SI.
    pub value: f64,
}

/// The instance of a [`Request`].
pub enum Instance<'a> {
    /// As in a `run`; arguments are read in the scope of the file.
    Written(&'a ast::Instance, FileId),
    /// A model on its own: inputs are given from outside, parameters without a default stay open.
    Alone(&'a ast::Model, FileId),
    /// A model on its own, whose inputs take their defaults.
    WithDefaults(&'a ast::Model, FileId),
    /// A variant on its own, as a model is.
    Variant(&'a ast::Instance, FileId),
}

/// A change from outside: `fr.Fs = 2 N`, `fr = LuGre()`.
#[derive(Clone)]
pub struct Override<'a> {
    /// Path of what is changed.
    pub path: &'a ast::Path,
    /// New value, read in the scope of the file.
    pub value: OverrideValue<'a>,
    /// File in whose scope the value is read.
    pub file: FileId,
}

/// The value of an [`Override`].
#[derive(Clone, Copy)]
pub enum OverrideValue<'a> {
    /// An expression.
    Expr(&'a Expr),
    /// A model for a slot.
    Instance(&'a ast::Instance),
}

impl<'a> From<&'a ast::BindValue> for OverrideValue<'a> {
    fn from(value: &'a ast::BindValue) -> OverrideValue<'a> {
        match value {
            ast::BindValue::Expr(expr) => OverrideValue::Expr(expr),
            ast::BindValue::Instance(instance) => OverrideValue::Instance(instance),
        }
    }
}

/// Result of flattening.
pub struct Flattened {
    /// The system; complete only if there are no errors.
    pub system: System,
    /// One node for each observed expression.
    pub observed: Vec<ExprId>,
    /// Location of the rig's frame.
    pub framed: Option<RigFrame>,
    /// Errors and warnings.
    pub diagnostics: Vec<Diagnostic>,
}

/// Flattens an instance.
pub fn flatten(loaded: &Loaded, sources: &dyn Sources, request: &Request) -> Flattened {
    let mut f = Flattener::new(loaded, sources);
    for (name, table, unit) in &request.data {
        let number = f.system.tables.len() as u32;
        f.system.tables.push(table.clone());
        f.data.insert(name.clone(), (number, unit.clone()));
    }
    let overrides: Vec<Change> = request
        .overrides
        .iter()
        .map(|o| Change { path: &o.path.segments, span: o.path.span, value: o.value, env: Env::file(o.file) })
        .collect();
    // Changes of a drive or of a part of the rig do not concern the instance.
    let of_frame = |change: &Change| {
        let head = &change.path[0].name.text;
        request.frame.as_ref().is_some_and(|frame| {
            frame.nodes.iter().any(|node| node.name.text == *head)
                || frame.parts.iter().any(|part| part.name.text == *head)
        })
    };
    let (around, overrides): (Vec<Change>, Vec<Change>) = overrides.into_iter().partition(of_frame);
    let locals: Locals = Rc::new(request.unknowns.iter().map(|unknown| f.declare_unknown(unknown)).collect());
    match &request.instance {
        Instance::Written(instance, file) => {
            let env = Env { locals, ..Env::file(*file) };
            f.written(instance, &env, overrides, false);
        }
        Instance::Variant(instance, file) => {
            let env = Env::file(*file);
            f.written(instance, &env, overrides, true);
        }
        Instance::Alone(model, file) | Instance::WithDefaults(model, file) => {
            let made = Instantiation {
                path: String::new(),
                rotary: false,
                span: model.name.span,
                args: Vec::new(),
                overrides,
            };
            f.instantiate(model, *file, made, true);
            if let (Instance::WithDefaults(..), Some(top)) = (&request.instance, f.instances.first_mut()) {
                top.defaults = true;
            }
        }
    }
    let mut framed = match (&request.frame, f.instances.is_empty()) {
        (Some(frame), false) => Some(f.surround(frame, &around)),
        _ => None,
    };
    for index in 0..f.instances.len() {
        if !f.instances[index].scope {
            f.define(InstanceId(index as u32));
        }
    }
    if let (Some(frame), Some(framed)) = (&request.frame, &mut framed) {
        f.framed(frame, framed);
    }
    for arg in std::mem::take(&mut f.dropped) {
        if let ArgValue::Expr(expr) = arg.value {
            f.expr(expr, &arg.env);
        }
    }
    let observed = match f.instances.first().map(|top| top.file) {
        Some(_) => {
            let file = match &request.instance {
                Instance::Written(_, file)
                | Instance::Alone(_, file)
                | Instance::WithDefaults(_, file)
                | Instance::Variant(_, file) => *file,
            };
            let instance = framed.as_ref().map_or(InstanceId(0), |framed| framed.rig);
            let env = Env { instance: Some(instance), outside: true, ..Env::file(file) };
            request.observed.iter().map(|expr| f.expr(expr, &env)).collect()
        }
        None => Vec::new(),
    };
    if f.too_large {
        // The system of a refused program is not used.
        f.system = System::default();
    }
    Flattened { system: f.system, observed, framed, diagnostics: f.diagnostics }
}

/// Flattens a function, constant or table on its own; a function's arguments are given from outside.
pub fn flatten_item(loaded: &Loaded, sources: &dyn Sources, file: FileId, item: &Item) -> Flattened {
    let mut f = Flattener { most_nodes: MOST_NODES_OF_ITEM, ..Flattener::new(loaded, sources) };
    let env = Env::file(file);
    let observed = match item {
        Item::Function(function) => {
            let mut locals = Vec::new();
            let mut first: HashMap<&str, Span> = HashMap::default();
            for arg in &function.args {
                if !f.new_name(&arg.name, &mut first) {
                    continue;
                }
                let unit = match &arg.unit {
                    None => Some(Unit::none()),
                    Some(unit) => f.unit(unit, false, None),
                };
                let Some(unit) = unit else { continue };
                let argument = Node::Number { value: f64::NAN, dimension: Some(unit.dimension), angle: unit.angle };
                locals.push((arg.name.text.clone(), f.system.push(argument, arg.name.span)));
            }
            if let Lookup::Found(item, _) = loaded.find(file, Space::Function, &function.name.text) {
                f.functions.push(item);
            }
            let value = f.expr(&function.body, &Env { locals: Rc::new(locals), ..env });
            match function.unit.as_ref().and_then(|unit| f.unit(unit, false, None)) {
                Some(unit) => {
                    let role = Role::Result { function: function.name.text.clone() };
                    vec![f.system.push(Node::Fits { value, unit: Box::new(unit), role }, function.body.span)]
                }
                None => vec![value],
            }
        }
        Item::Const(constant) => f.constant(&constant.name, &env).into_iter().collect(),
        Item::Table(table) => {
            crate::frontend::tables::read(loaded, sources, file, table, &mut f.diagnostics);
            Vec::new()
        }
        _ => Vec::new(),
    };
    if f.too_large {
        f.system = System::default();
    }
    Flattened { system: f.system, observed, framed: None, diagnostics: f.diagnostics }
}

struct Flattener<'a> {
    loaded: &'a Loaded,
    sources: &'a dyn Sources,
    system: System,
    diagnostics: Vec<Diagnostic>,
    /// Parallel to `system.instances`.
    instances: Vec<Tree<'a>>,
    /// Expanded calls by function, arguments, rotary twin, and whether within an equation; equal calls share nodes.
    expansions: HashMap<(ItemRef, Vec<ExprId>, bool, bool), ExprId>,
    /// Functions being expanded, to detect recursion.
    functions: Vec<ItemRef>,
    /// Tables by item and whether it is the rotary twin.
    tables: HashMap<(ItemRef, bool), Option<u32>>,
    consts: HashMap<(ItemRef, bool), ExprId>,
    open_consts: Vec<ItemRef>,
    /// Models being instantiated, to detect recursion.
    models: Vec<ItemRef>,
    /// Number of unknown names reported so far; only the first have suggestions.
    unknowns: usize,
    /// Spans of the denominators of nonexistent derivatives, which have been reported.
    derivatives_read: Vec<Span>,
    /// Arguments of slots for ports that the present model lacks; another model may read them.
    dropped: Vec<Arg<'a>>,
    /// Limit on operations. `too_large`: whether exceeding it has been reported.
    most_nodes: usize,
    too_large: bool,
    /// Parts with names already in use, which have been reported.
    refused_parts: Vec<Span>,
    /// Quantities with refused definitions, which have been reported.
    refused: Vec<VarId>,
    /// Names that are defined but not declared, which have been reported.
    undeclared: Vec<(InstanceId, String)>,
    data: HashMap<String, (u32, Unit)>,
}

/// Properties of an instance in addition to [`InstanceInfo`].
struct Tree<'a> {
    model: &'a ast::Model,
    file: FileId,
    names: HashMap<&'a str, Binding>,
    args: Vec<Arg<'a>>,
    alone: bool,
    /// As `alone`, but inputs take their defaults.
    defaults: bool,
    /// A drive or device, whose inputs come from the bus.
    on_bus: bool,
    /// A rig, which only provides names.
    scope: bool,
    locals: Locals,
}

/// Meaning of a name in an instance.
#[derive(Clone)]
enum Binding {
    Var(VarId),
    Part(InstanceId),
    Parts(Rc<Vec<InstanceId>>, i64),
    Regime(AutomatonId, u32),
    /// Declared but not usable; has been reported.
    Broken,
}

type Locals = Rc<Vec<(String, ExprId)>>;

/// Context in which an expression is read.
#[derive(Clone)]
struct Env {
    file: FileId,
    instance: Option<InstanceId>,
    rotary: bool,
    locals: Locals,
    /// Read by an experiment from outside the model: `let`s are visible and measures are allowed.
    outside: bool,
    /// Within an equation rather than a declaration, where E0109 applies.
    equation: bool,
    /// Within the condition of a transition or event, where crossings are allowed.
    instants: bool,
}

impl Env {
    fn file(file: FileId) -> Env {
        Env {
            file,
            instance: None,
            rotary: false,
            locals: Rc::default(),
            outside: false,
            equation: false,
            instants: false,
        }
    }
}

/// An argument of an instance.
#[derive(Clone)]
struct Arg<'a> {
    name: &'a str,
    span: Span,
    value: ArgValue<'a>,
    env: Env,
    overriding: bool,
}

#[derive(Clone, Copy)]
enum ArgValue<'a> {
    Expr(&'a Expr),
    Instance(&'a ast::Instance),
}

/// A change from outside, passed down the instance tree.
#[derive(Clone)]
struct Change<'a> {
    path: &'a [ast::Segment],
    span: Span,
    value: OverrideValue<'a>,
    env: Env,
}

/// Parameters of an instantiation.
struct Instantiation<'a> {
    path: String,
    rotary: bool,
    span: Span,
    args: Vec<Arg<'a>>,
    overrides: Vec<Change<'a>>,
}

impl<'a> Flattener<'a> {
    fn new(loaded: &'a Loaded, sources: &'a dyn Sources) -> Flattener<'a> {
        Flattener {
            loaded,
            sources,
            system: System::default(),
            diagnostics: Vec::new(),
            instances: Vec::new(),
            expansions: HashMap::default(),
            functions: Vec::new(),
            tables: HashMap::default(),
            consts: HashMap::default(),
            open_consts: Vec::new(),
            models: Vec::new(),
            refused: Vec::new(),
            undeclared: Vec::new(),
            unknowns: 0,
            derivatives_read: Vec::new(),
            most_nodes: MOST_NODES,
            too_large: false,
            refused_parts: Vec::new(),
            dropped: Vec::new(),
            data: HashMap::default(),
        }
    }

    fn report(&mut self, diagnostic: Diagnostic) {
        self.diagnostics.push(diagnostic);
    }

    /// Whether the program exceeds a limit. Reports that once, at the place where it grows.
    fn full(&mut self, span: Span) -> bool {
        if self.diagnostics.len() >= MOST_MISTAKES {
            return true; // Further reports of the same error would not help.
        }
        let made = self.system.vars.len() + self.system.instances.len();
        let (most, what, recurring) = match () {
            () if made > MOST_VARS => (MOST_VARS, "quantities and parts", Recurring::Quantities),
            () if self.system.nodes.len() > self.most_nodes => (self.most_nodes, "operations", Recurring::Operations),
            () => return false,
        };
        if !std::mem::replace(&mut self.too_large, true) {
            let error = Diagnostic::error("E0502", format!("more than {most} {what}"))
                .recurring(recurring)
                .label(span, "it is still growing here")
                .help("a program of this size is refused: use fewer parts, or let each do more");
            self.report(error);
        }
        true
    }
}

/// The beginning of an equation, long enough to identify it: `F = clamp` of `F = clamp(F_ext, -Fs, Fs)`.
fn head(equation: &ast::Equation) -> Span {
    let mut first = &equation.value;
    while let ExprKind::Binary(_, _, left, _) = &first.kind {
        first = left;
    }
    let end = match &first.kind {
        ExprKind::Call { function, .. } => function.span,
        _ => first.span,
    };
    equation.target.span().to(end)
}

/// Kind of definition that an equation gives its quantity.
enum DefinitionKind {
    Value,
    Rate { along: PathVariable },
    Next,
}

/// Variable of differentiation: time, or a state with the span of its name.
type PathVariable = Option<(VarId, Span)>;

/// The right side of a derivative equation.
struct Rate {
    value: ExprId,
    along: PathVariable,
    span: Span,
}

fn zero() -> Node {
    Node::Number { value: 0.0, dimension: None, angle: Angle::Silent }
}

fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_string() } else { format!("{path}.{name}") }
}

fn article(word: &str) -> &'static str {
    if word.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" }
}

fn unknown_unit(unit: &ast::UnitText, part: &str) -> Diagnostic {
    let known = [
        "m", "mm", "um", "kg", "g", "s", "ms", "N", "J", "W", "rad", "deg", "rev", "rpm", "Hz", "min", "h", "K", "A",
        "V",
    ];
    let error =
        Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(unit.span, "not a unit that fric knows");
    // Common units outside SI, and their values.
    const OTHERS: [(&[&str], &str); 13] = [
        (&["degC", "°C", "celsius", "Celsius", "C"], "temperatures are in K: 20 degC is `293.15 K`"),
        (&["bar"], "1 bar is `1e5 Pa`"),
        (&["psi"], "1 psi is `6894.76 Pa`"),
        (&["atm"], "1 atm is `101325 Pa`"),
        (&["in", "inch"], "1 inch is `25.4 mm`"),
        (&["ft", "foot", "feet"], "1 foot is `304.8 mm`"),
        (&["lb", "lbs"], "1 pound is `0.453592 kg`"),
        (&["lbf"], "1 pound of force is `4.44822 N`"),
        (&["kgf", "kp"], "1 kgf is `9.80665 N`"),
        (&["hp", "PS"], "1 hp is `745.7 W`"),
        (&["sec", "secs", "seconds"], "seconds are `s`"),
        (&["meter", "meters", "metre", "metres"], "metres are `m`"),
        (&["newton", "newtons", "Newton"], "newtons are `N`"),
    ];
    if let Some((_, what)) = OTHERS.iter().find(|(names, _)| names.contains(&part)) {
        return error.help(*what);
    }
    if let Some(apart) = apart(part) {
        return error.help(format!("between units write `·`: `{}`", unit.text.replacen(part, &apart, 1)));
    }
    // For short words only a difference of case counts as near.
    let near = |known: &&str| known.eq_ignore_ascii_case(part) || part.len() > 2 && known.len() > 1;
    match nearest(part, known.into_iter().filter(near)).filter(|near| near.len() + 1 >= part.len()) {
        Some(near) => error.help(format!("did you mean `{near}`?")),
        None => error
            .help("units are m g s min h A K N J W Pa V Ohm Hz rad deg rev rpm bit %, with G M k m u n before them"),
    }
}

/// `N·s` for `Ns`: known units without a sign between them; the fewest, of those the ones without a prefix.
fn apart(part: &str) -> Option<String> {
    let known = |text: &str| Unit::parse(text).is_ok_and(|unit| !unit.text.is_empty() && !text.contains('%'));
    let cuts: Vec<usize> = part.char_indices().map(|(at, _)| at).skip(1).collect();
    let pairs = cuts.iter().map(|&at| vec![&part[..at], &part[at..]]);
    let triples = cuts
        .iter()
        .enumerate()
        .flat_map(|(k, &at)| cuts[k + 1..].iter().map(move |&next| vec![&part[..at], &part[at..next], &part[next..]]));
    let found = pairs.chain(triples).find(|words| words.iter().all(|word| known(word)))?;
    Some(found.join("·"))
}

/// E0111 for `300 N*s/m*v`, where `v` is a name of the model: without a blank a factor is read as part of the unit.
fn read_on(unit: &ast::UnitText, part: &str) -> Option<Diagnostic> {
    let before = unit.text.strip_suffix(part)?;
    let (own, sign) = (before.strip_suffix(['*', '·', '/'])?, before.chars().last()?);
    Unit::parse(own).ok()?;
    let sign = if sign == '/' { '/' } else { '*' };
    Some(
        Diagnostic::error("E0111", format!("`{part}` is read as a unit here"))
            .label(unit.span, "one unit: a unit has no blanks")
            .help(format!("put a blank before the `{sign}`: `{own} {sign} {part}`")),
    )
}

fn args_of<'a>(args: &'a [ast::Bind], env: &Env) -> Vec<Arg<'a>> {
    let arg = |bind: &'a ast::Bind| Arg {
        name: &bind.name.text,
        span: bind.span,
        value: match &bind.value {
            ast::BindValue::Expr(expr) => ArgValue::Expr(expr),
            ast::BindValue::Instance(instance) => ArgValue::Instance(instance),
        },
        env: env.clone(),
        overriding: false,
    };
    args.iter().filter(|bind| bind.inner.is_none()).map(arg).collect()
}

/// The arguments of an instance that go into its parts, `ctl.Kx = 10 1/s`, as changes.
fn changes_of<'a>(args: &'a [ast::Bind], env: &Env) -> Vec<Change<'a>> {
    let change = |bind: &'a ast::Bind| {
        Some(Change {
            path: &bind.inner.as_ref()?.segments,
            span: bind.span,
            value: (&bind.value).into(),
            env: env.clone(),
        })
    };
    args.iter().filter_map(change).collect()
}

/// All declarations of a model, including those inside `every`.
fn declarations(model: &ast::Model) -> impl Iterator<Item = &ast::Declaration> {
    model.body.iter().flat_map(|statement| {
        let (one, many): (Option<&ast::Declaration>, &[ast::EveryStatement]) = match statement {
            Statement::Declaration(declaration) => (Some(declaration), &[]),
            Statement::Every(every) => (None, &every.body),
            _ => (None, &[]),
        };
        one.into_iter().chain(many.iter().filter_map(|statement| match statement {
            ast::EveryStatement::Declaration(declaration) => Some(declaration),
            ast::EveryStatement::Equation(_) => None,
        }))
    })
}

fn modes(model: &ast::Model) -> impl Iterator<Item = &ast::Mode> {
    model.body.iter().filter_map(|statement| match statement {
        Statement::Mode(mode) => Some(mode),
        _ => None,
    })
}
