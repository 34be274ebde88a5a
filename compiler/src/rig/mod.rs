//! Rigs: partitions a system into a control program and a plant, puts drives in the place of the part that hardware
//! replaces, and performs all checks before anything moves.
//!
//! In: a rig's syntax tree. Out: a [`PartitionedRig`]: the plan of the rig and two flat systems. *Control* lacks the
//! part; measurements of drives are its inputs, and their commands its outputs. *Plant* is the part alone, with the wires
//! inverted. [`PartitionedRig::finish`] inserts the slots of both programs into the plan. Knows no files and no buses.

mod advice;
mod partition;
mod dbc;
mod nodes;
mod frames;
mod live;
mod margins;
mod plan;
mod statements;
mod step_derivative;
mod wires;

use crate::analysis::parameter_checks;
use crate::analysis::tuning::{self, Tuned};
use crate::frontend::flatten::{self, BusNode, Frame, Instance, Override, RigFrame, Scope, flatten};
use crate::frontend::resolve::{ItemRef, Loaded, Lookup, Space};
use crate::frontend::source::{Files, Sources, Tree};
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::program::Program;
use crate::lower::{Observed, evaluate};
use crate::pipeline::{Depth, analyse};
use crate::rig::partition::{affine, lives, mentioned, nothing, one, pruned, solved};
use abi::Slot;
use abi::description::Kind as QuantityKind;
use abi::live::{self as words, Live};
use abi::rig::{self, Mode, Overrun, Rig, Signal, SignalKind};
use abi::series::{Method, Series};
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, Expr, Item, Name};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use nodes::{Description, Protocol, SignalRef};
use statements::{Expressions, Statements};
use std::sync::Arc;

pub use crate::rig::step_derivative::{Discrete, StepDerivative};
pub use advice::{Emulated, linear};
pub use frames::{load as bus_load, of_dbc as dbc_messages};

/// Default number of steps of the plant in one period of a SIL run.
pub const PLANT_STEPS: u32 = 50;

/// A rig with the descriptions of its drives and devices, which come from texts of their own.
pub struct LoadedRig {
    ast: Arc<Tree>,
    item: ItemRef,
    model: ast::Model,
    descriptions: Vec<Description>,
    diagnostics: Vec<Diagnostic>,
}

impl LoadedRig {
    /// The syntax tree of the rig.
    pub fn rig(&self) -> &ast::Rig {
        match self.ast.item(self.item.index) {
            Item::Rig(rig) => rig,
            _ => unreachable!("a rig was found here"),
        }
    }
}

/// Finds the rig of this name.
pub fn find(loaded: &Loaded, file: FileId, name: &Name) -> Result<ItemRef, Diagnostic> {
    match loaded.find(file, Space::Rig, &name.text) {
        Lookup::Found(item, _) => Ok(item),
        Lookup::Ambiguous(..) => {
            let error = Diagnostic::error("E0202", format!("two imports define `{}`", name.text));
            Err(error.label(name.span, "which one?").help("import only one of them"))
        }
        Lookup::Missing => {
            let error = Diagnostic::error("E0201", format!("there is no rig `{}`", name.text))
                .label(name.span, "not declared and not imported");
            let known = loaded.visible(file, Space::Rig);
            Err(match crate::frontend::names::nearest(&name.text, known) {
                Some(near) => error.help(format!("did you mean `{near}`?")),
                None => error.help("models begin with a capital, rigs with a small letter"),
            })
        }
    }
}

/// Reads the descriptions of a rig's drives and devices.
pub fn prepare(loaded: &mut Loaded, sources: &dyn Sources, item: ItemRef) -> LoadedRig {
    let ast = loaded.files.get(item.file).ast.clone();
    let Item::Rig(rig) = ast.item(item.index) else { unreachable!("a rig was found here") };
    let mut diagnostics = Vec::new();
    let descriptions = nodes::describe(loaded, sources, item.file, rig, &mut diagnostics);
    // The parts and instance of the rig, from which suggestions for misspelt names are made.
    let mut body: Vec<ast::Statement> = Vec::new();
    for statement in &rig.body {
        match statement {
            ast::RigStatement::Part(part) => body.push(ast::Statement::Part(part.clone())),
            ast::RigStatement::Run(run) => {
                if let Lookup::Found(_, Item::Model(model)) =
                    loaded.find(item.file, Space::Type, &run.instance.model.text)
                {
                    let names = model.body.iter().filter(|statement| {
                        matches!(statement, ast::Statement::Declaration(_) | ast::Statement::Part(_))
                    });
                    body.extend(names.cloned());
                }
            }
            ast::RigStatement::Drive(drive) => {
                let instance =
                    ast::Instance { rotary: false, model: drive.kind.clone(), args: Vec::new(), span: drive.span };
                let name = drive.name.clone();
                let part = ast::Part { name, repeat: None, slot: None, instance, doc: None, span: drive.span };
                body.push(ast::Statement::Part(part));
            }
            _ => {}
        }
    }
    let model = ast::Model { name: rig.name.clone(), body, doc: rig.doc.clone(), span: rig.span };
    LoadedRig { ast: ast.clone(), item, model, descriptions, diagnostics }
}

/// A rig as two flat systems and a plan without slots.
pub struct PartitionedRig {
    /// The system without the part that hardware replaces.
    pub control: System,
    /// Types of `control`.
    pub control_types: Types,
    /// The part that hardware replaces, alone.
    pub plant: System,
    /// Types of `plant`.
    pub plant_types: Types,
    /// The requested expressions, in the control system.
    pub observed: Vec<ExprId>,
    /// The plan; its slots are not yet set.
    rig: Rig,
    inputs: Vec<VarId>,
    outputs: Vec<VarId>,
    commands_read: Vec<ExprId>,
    stops: Vec<ExprId>,
    records: Vec<ExprId>,
    /// Margins of ranges that depend on parameters.
    margins: Vec<margins::Margin>,
    applied: Vec<VarId>,
    seen: Vec<VarId>,
    seen_read: Vec<ExprId>,
    judged: live::LiveChecks,
    tuned: Vec<Tuned>,
    /// Spans for messages about the rig.
    pub places: RigSpans,
}

/// A rig as two programs and a plan.
pub struct Lowered {
    /// The plan.
    pub rig: Rig,
    /// The control program.
    pub control: Program,
    /// The plant program.
    pub plant: Program,
    /// Which parameters may change during the run, and the conditions on them.
    pub live: Live,
    /// The judge, whose `Outputs` computes the numbers of those conditions from parameters.
    pub judge: Program,
}

/// Spans of a rig for messages.
#[derive(Clone, Default)]
pub struct RigSpans {
    /// The name of the rig.
    pub name: Span,
    /// The period.
    pub rate: Span,
    /// The instance that it runs.
    pub run: Span,
    /// The name of its method, or else the period.
    pub solver: Span,
    /// For each node the span of its kind.
    pub nodes: Vec<Span>,
    /// For each output the span of its wire.
    pub wires: Vec<Span>,
    /// Lints that the rig allows.
    pub allows: Vec<String>,
}

/// Reads a rig around the instance it runs. `overrides` take precedence over the text; `observed` are read in the scope
/// of the rig and of the instance. Returns `None` after errors, which are reported.
pub fn read<'a>(
    loaded: &'a Loaded,
    sources: &'a dyn Sources,
    prepared: &'a LoadedRig,
    overrides: Vec<Override<'a>>,
    observed: Vec<&'a Expr>,
    data: Vec<(String, Table, Unit)>,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<PartitionedRig> {
    diagnostics.extend(prepared.diagnostics.iter().cloned());
    let rig = prepared.rig();
    let misread = loaded.misread(rig.span);
    let statements = Statements::of(rig, misread, diagnostics)?;
    let mut reader = RigReader {
        loaded,
        files: &loaded.files,
        rig,
        descriptions: &prepared.descriptions,
        statements: &statements,
        diagnostics,
        expressions: Expressions::default(),
    };
    reader.names();
    let lists = reader.lists();
    let expressions = std::mem::take(&mut reader.expressions);
    let file = prepared.item.file;
    let run = statements.run?;
    let request = flatten::Request {
        instance: Instance::Written(&run.instance, file),
        overrides,
        observed,
        data,
        unknowns: Vec::new(),
        frame: Some(Frame {
            model: &prepared.model,
            file,
            nodes: prepared
                .descriptions
                .iter()
                .map(|d| BusNode { name: &d.name, model: &d.model, file: d.file, instance: &d.instance })
                .collect(),
            broken: reader.broken(),
            parts: statements.parts.clone(),
            hardware: statements.hardware.map(|hardware| &hardware.part),
            expressions: expressions.all.clone(),
        }),
    };
    let mut flat = flatten(loaded, sources, &request);
    // If the part does not exist, the errors about its inputs are consequences.
    if let Some(hardware) = statements.hardware
        && flat.diagnostics.iter().any(|d| d.span() == hardware.part.span)
    {
        flat.diagnostics.retain(|d| d.span() == hardware.part.span || !d.span().is_within(hardware.span));
    }
    reader.diagnostics.extend(flat.diagnostics);
    let framed = flat.framed?;
    let cut = reader.cut(flat.system, flat.observed, framed, expressions, lists);
    diagnostics.extend(statements.allows.iter().filter_map(|allow| unknown_lint(&allow.lint)));
    let allowed = |lint: &str| statements.allows.iter().any(|allow| allow.lint.text == lint);
    diagnostics.retain(|said| {
        let lint = LINTS.iter().find(|(_, code)| *code == said.code);
        said.is_error() || !said.code.starts_with("W08") || !lint.is_some_and(|(name, _)| allowed(name))
    });
    cut
}

/// Indices of the rig's expressions among all expressions of the frame.
#[derive(Default)]
struct ExprIndices<'a> {
    rate: usize,
    step: Option<usize>,
    watchdog: Option<usize>,
    overrun: Option<usize>,
    /// For each bus its bit rate.
    bit_rates: Vec<Option<usize>>,
    /// Commands.
    sends: Vec<OutputCommand>,
    /// Outputs of the part: the wire in `hardware`, and its value.
    gives: Vec<(usize, usize)>,
    stops: Vec<usize>,
    /// What is recorded, then what is plotted.
    records: Vec<(&'a ast::Show, usize)>,
}

/// `drive.signal = expr limit a .. b slew r`
struct OutputCommand {
    node: usize,
    read: SignalRef,
    unit: Unit,
    /// Whether it is written inside `hardware`.
    inside: bool,
    value: usize,
    limit: Option<(usize, usize)>,
    slew: Option<usize>,
    safe: Option<usize>,
    path: Span,
    span: Span,
}

struct RigReader<'a, 'd> {
    loaded: &'a Loaded,
    files: &'a Files,
    rig: &'a ast::Rig,
    descriptions: &'a [Description],
    statements: &'a Statements<'a>,
    diagnostics: &'d mut Vec<Diagnostic>,
    expressions: Expressions<'a>,
}

fn unit(text: &str) -> Unit {
    Unit::parse(text).expect("a unit that is known")
}

impl<'a> RigReader<'a, '_> {
    fn report(&mut self, diagnostic: Diagnostic) {
        self.diagnostics.push(diagnostic);
    }

    /// Checks that names of buses, drives, devices and parts are unique.
    fn names(&mut self) {
        let mut first: Vec<&Name> = Vec::new();
        let buses = self.statements.buses.iter().map(|bus| &bus.name);
        let nodes = self.descriptions.iter().map(|node| &node.statement.name);
        let parts = self.statements.parts.iter().map(|part| &part.name);
        let mut found = Vec::new();
        for name in buses.chain(nodes).chain(parts) {
            match first.iter().find(|known| known.text == name.text) {
                Some(before) => found.push(crate::frontend::resolve::declared_twice(name, before.span)),
                None => first.push(name),
            }
        }
        self.diagnostics.extend(found);
    }

    /// Names of drives and devices with invalid descriptions.
    fn broken(&self) -> Vec<&'a Name> {
        let drives = self.rig.body.iter().filter_map(|statement| match statement {
            ast::RigStatement::Drive(drive) => Some(&drive.name),
            _ => None,
        });
        drives.filter(|name| self.node(&name.text).is_none()).collect()
    }

    fn node(&self, name: &str) -> Option<usize> {
        self.descriptions.iter().position(|node| node.name.text == name)
    }

    /// E0204: an unknown drive or device.
    fn no_node(&mut self, name: &Name, what: &str) {
        let names = self.descriptions.iter().map(|node| node.name.text.as_str());
        let near = crate::frontend::names::nearest(&name.text, names).map(str::to_string);
        // A drive with an invalid description has been reported.
        let declared = self
            .rig
            .body
            .iter()
            .any(|one| matches!(one, ast::RigStatement::Drive(drive) if drive.name.text == name.text));
        if declared {
            return;
        }
        let error = Diagnostic::error("E0204", format!("there is no {what} `{}`", name.text))
            .label(name.span, "not declared in this rig");
        self.report(match near {
            Some(near) => error.help(format!("did you mean `{near}`?")),
            None => error.help(format!("add `drive {} = cia402(…)` or `device {} = …`", name.text, name.text)),
        });
    }

    /// Collects all expressions that are read in the scope of the rig.
    fn lists(&mut self) -> ExprIndices<'a> {
        let mut lists = ExprIndices::default();
        let seconds = unit("s");
        if let Some((expr, span)) = self.statements.rate {
            lists.rate = self.expressions.constant(Scope::Rig, expr, "rate", seconds.clone(), span);
        }
        if let Some(solver) = self.statements.solver {
            let step = solver.step.as_ref();
            lists.step =
                step.map(|step| self.expressions.constant(Scope::Rig, step, "the step", seconds.clone(), solver.span));
        }
        if let Some((expr, span)) = self.statements.watchdog {
            lists.watchdog = Some(self.expressions.constant(Scope::Rig, expr, "watchdog", seconds, span));
        }
        if let Some((Some(count), span)) = self.statements.overrun {
            lists.overrun = Some(self.expressions.constant(Scope::Rig, count, "hold", Unit::none(), span));
        }
        for bus in &self.statements.buses {
            let rate = bus.args.iter().find_map(|arg| match arg {
                ast::BusArg::Expr(expr) => Some(expr),
                ast::BusArg::Text(_) => None,
            });
            let rate =
                rate.map(|rate| self.expressions.constant(Scope::Rig, rate, "bit rate", unit("bit/s"), bus.span));
            lists.bit_rates.push(rate);
        }
        if let Some(hardware) = self.statements.hardware {
            for (k, wire) in hardware.wires.iter().enumerate() {
                match wire.path.segments.as_slice() {
                    [only] => {
                        let value = self.expressions.read(Scope::Rig, &wire.value);
                        lists.gives.push((k, value));
                        if let Some(extra) = wire.limit.as_ref().map(|(low, high)| low.span.to(high.span)) {
                            let message = format!("`{}` is measured: it has no limit", only.name.text);
                            let error = Diagnostic::error("E0801", message).label(extra, "limits belong to commands");
                            self.report(error.help("a range that must hold is a `stop when …`"));
                        }
                    }
                    _ => self.send(wire, true, &mut lists),
                }
            }
        }
        for wire in &self.statements.wires {
            self.send(wire, false, &mut lists);
        }
        self.safe(&mut lists);
        for (condition, ..) in &self.statements.stops {
            lists.stops.push(self.expressions.read(Scope::Condition, condition));
        }
        let plotted = self.statements.plots.iter().flat_map(|plot| plot.shows.iter().chain(&plot.against));
        for show in self.statements.records.iter().copied().chain(plotted) {
            lists.records.push((show, self.expressions.read(Scope::Rig, &show.value)));
        }
        lists
    }

    fn send(&mut self, wire: &'a ast::Wire, inside: bool, lists: &mut ExprIndices<'a>) {
        let scope = if inside { Scope::Part } else { Scope::Rig };
        let [node, signal] = wire.path.segments.as_slice() else {
            let error = Diagnostic::error("E0204", "a command goes to a signal of a drive or device")
                .label(wire.path.span, "not `drive.signal`");
            self.report(error.help("write `drive.torque = …`"));
            return;
        };
        let Some(at) = self.node(&node.name.text) else {
            self.no_node(&node.name, "drive or device");
            return;
        };
        let description = &self.descriptions[at];
        let (unit, read, declared) = match description.sends(&signal.name.text) {
            Ok((unit, read, declared)) => (unit.unwrap_or_default(), read, declared),
            Err(known) => {
                let name = &signal.name.text;
                let message = format!("`{name}` of `{}` cannot be commanded", node.name.text);
                let mut error = Diagnostic::error("E0204", message).label(signal.name.span, "no such command");
                let near = crate::frontend::names::nearest(name, known.iter().map(String::as_str));
                error = match (near, &description.protocol) {
                    (Some(near), _) => error.help(format!("did you mean `{near}`?")),
                    (None, Protocol::Cia402 { .. }) => {
                        error.help(format!("its `mode` says that it follows `{}`", known.join("")))
                    }
                    (None, _) if known.is_empty() => error.help("it only talks: nothing can be sent to it"),
                    (None, _) => error.help(format!("what it takes is {}", known.join(", "))),
                };
                self.report(error);
                return;
            }
        };
        if let Some(first) = lists.sends.iter().find(|send| send.node == at && send.read == read) {
            let path = self.files.slice(wire.path.span);
            let error = Diagnostic::error("E0801", format!("`{path}` is commanded twice"))
                .label(wire.path.span, "again here")
                .label(first.path, "first here");
            self.report(error.help("one drive follows one command: remove one, or add them up"));
            return;
        }
        let value = self.expressions.read(scope, &wire.value);
        let limit = wire.limit.as_ref().map(|(low, high)| {
            let mut one = |expr| self.expressions.constant(scope, expr, "limit", unit.clone(), declared);
            (one(low), one(high))
        });
        let per_second = Unit::si(unit.dimension.times(Dimension::of([0, 0, -1, 0, 0])));
        let slew = wire.slew.as_ref();
        let slew = slew.map(|slew| self.expressions.constant(scope, slew, "slew", per_second, declared));
        let (path, span) = (wire.path.span, wire.span);
        lists.sends.push(OutputCommand { node: at, read, unit, inside, value, limit, slew, safe: None, path, span });
    }

    fn safe(&mut self, lists: &mut ExprIndices<'a>) {
        for (path, value) in &self.statements.safe {
            let text = self.files.slice(path.span);
            let found = match path.segments.as_slice() {
                [node, signal] => match self.node(&node.name.text) {
                    None => {
                        self.no_node(&node.name, "drive or device");
                        continue;
                    }
                    Some(at) => {
                        let read = self.descriptions[at].sends(&signal.name.text).ok().map(|(_, read, _)| read);
                        lists.sends.iter().position(|send| send.node == at && Some(send.read) == read)
                    }
                },
                _ => None,
            };
            let Some(found) = found else {
                // The misplaced command has been reported.
                if self.hardware_is_wrong() {
                    continue;
                }
                let error = Diagnostic::error("E0803", format!("nothing commands `{text}`"))
                    .label(path.span, "a safe value of no command");
                self.report(
                    error.help("safe values are those of what the rig sends, as in `safe load.torque = 0 N·m`"),
                );
                continue;
            };
            if lists.sends[found].safe.is_some() {
                let error =
                    Diagnostic::error("E0301", format!("`{text}` has two safe values")).label(path.span, "again here");
                self.report(error.help("remove one"));
                continue;
            }
            let (unit, span) = (lists.sends[found].unit.clone(), lists.sends[found].path);
            lists.sends[found].safe = Some(self.expressions.constant(Scope::Rig, value, "safe value", unit, span));
        }
    }

    /// Partitions the system: replaces the part in both directions, and performs all checks.
    fn cut(
        &mut self,
        mut system: System,
        observed: Vec<ExprId>,
        framed: RigFrame,
        expressions: Expressions,
        lists: ExprIndices,
    ) -> Option<PartitionedRig> {
        let top_span = self.rig.span;
        let part = framed.hardware;
        let at = |number: usize| framed.expressions[number];
        // Numbers that must be known become parameters, so that their units and constancy are checked in the same way.
        let mut constants = Vec::new();
        for constant in &expressions.constants {
            let value = at(constant.at);
            let span = system.span(value);
            let definition = Definition::Value(value, Origin::Equation(span));
            let id = self.quantity(&mut system, framed.rig, VarKind::Let, &constant.name, span, definition);
            system.vars[id.0 as usize].unit = Some((constant.unit.clone(), constant.span));
            constants.push(id);
        }
        // Commands.
        let mut commands = Vec::new();
        for send in &lists.sends {
            let node = framed.nodes[send.node];
            let definition = Definition::Value(at(send.value), Origin::Equation(send.path));
            let name = format!("{} command", self.files.slice(send.path).rsplit('.').next().unwrap_or_default());
            let id = self.quantity(&mut system, node, VarKind::Output, &name, send.path, definition);
            system.vars[id.0 as usize].unit = Some((send.unit.clone(), send.path));
            commands.push(id);
        }
        let stops = self.latched(&mut system, &framed, &lists);
        // Nodes that read the requested quantities.
        let commands_read: Vec<ExprId> = commands.iter().map(|id| system.push(Node::Var(*id), top_span)).collect();
        let values: Vec<ExprId> = constants.iter().map(|id| system.push(Node::Var(*id), top_span)).collect();
        let of_nodes = |id: &VarId| {
            let var = system.var(*id);
            framed.nodes.contains(&var.instance) && var.kind == VarKind::Param
        };
        let params: Vec<VarId> = system.var_ids().filter(of_nodes).collect();
        let params: Vec<(VarId, ExprId)> =
            params.into_iter().map(|id| (id, system.push(Node::Var(id), top_span))).collect();
        let part = match part {
            Some(part) => part,
            None => {
                self.check_whole(&system);
                return None;
            }
        };
        let path = system.instance(part).path.clone();
        let inside: Vec<bool> = system
            .instances
            .iter()
            .enumerate()
            .map(|(k, info)| k == part.0 as usize || info.path.starts_with(&format!("{path}.")))
            .collect();
        let of_part = |system: &System, id: VarId| inside[system.var(id).instance.0 as usize];
        let types = self.check_whole(&system)?;
        let exprs: Vec<ExprId> = values.iter().chain(params.iter().map(|(_, node)| node)).copied().collect();
        let numbers = evaluate(&system, &types, &exprs);
        let (constants_values, param_values) = numbers.split_at(values.len());
        for id in system.var_ids() {
            if !types.boolean_vars[id.0 as usize] && system.var(id).unit.is_none() {
                let span = system.var(id).span;
                system.vars[id.0 as usize].unit = Some((types.units[id.0 as usize].clone(), span));
            }
        }
        let before = self.errors();
        let gives = self.gives(&mut system, &framed, &lists, part);
        self.unsent(&system, &framed, &lists, part);
        let plant = self.plant(&system, &framed, &lists, &commands, &gives, &of_part);

        // The control system: outputs of the part come from signals, and the rest of the part is removed.
        let mut control = system.clone();
        for id in system.var_ids().filter(|id| of_part(&system, *id)) {
            let var = &mut control.vars[id.0 as usize];
            match (var.kind, gives.iter().find(|give| give.var == id)) {
                (_, Some(give)) => {
                    var.definition = Definition::Value(at(give.value), Origin::Equation(give.span));
                    var.kind = VarKind::Output;
                }
                (VarKind::Param | VarKind::Input, None) => {}
                (VarKind::Output | VarKind::State | VarKind::Let | VarKind::Observed, None) => {
                    var.definition = Definition::Missing;
                }
            }
        }
        for automaton in control.automata.iter_mut().filter(|a| inside[a.instance.0 as usize]) {
            automaton.regimes.iter_mut().for_each(|regime| regime.transitions.clear());
        }
        control.events.retain(|event| !inside[event.instance.0 as usize]);
        control.storages.retain(|(instance, _)| !inside[instance.0 as usize]);
        let records: Vec<ExprId> = lists.records.iter().map(|(_, record)| at(*record)).collect();
        let own = |id: &VarId| {
            let var = system.var(*id);
            let framing = var.instance == framed.rig || framed.nodes.contains(&var.instance);
            !framing && !of_part(&system, *id)
        };
        let margins = margins::of(&mut control, |id| own(&id));
        let rooms = margins.iter().map(|margin| margin.room);
        let wanted: Vec<ExprId> =
            observed.iter().chain(&stops).chain(&records).chain(&commands_read).copied().chain(rooms).collect();
        let roots: Vec<VarId> = system.var_ids().filter(own).chain(commands.iter().copied()).collect();
        let control = pruned(&control, roots.into_iter(), &wanted);
        self.not_given(&control, &system, part, &of_part);
        if let Some(automaton) = control.automata.iter().find(|a| inside[a.instance.0 as usize]) {
            let regime = &automaton.regimes[0];
            let error = Diagnostic::error("E0801", format!("a regime of the hardware part is used: `{}`", regime.name))
                .label(self.statements.hardware.map_or(top_span, |hardware| hardware.part.span), "nothing measures it")
                .label(regime.span, "inside of what is replaced");
            self.report(error.help("use what is wired"));
        }
        if self.errors() > before {
            return None;
        }
        let plant = plant?;
        let mut found = Vec::new();
        let control_types = analyse(&control, self.files, Depth::Causality, &Diagnostic::is_error, &mut found);
        let plant_types = analyse(&plant.system, self.files, Depth::Units, &Diagnostic::is_error, &mut found);
        self.diagnostics.extend(found);
        for stop in &stops {
            if !control_types.boolean[stop.0 as usize] && control_types.nodes[stop.0 as usize].is_some() {
                let error = Diagnostic::error("E0101", "`stop when` needs a condition")
                    .label(control.span(*stop), "neither true nor false");
                self.report(error.help("compare it: `stop when abs(body.v) > 150 rad/s, \"overspeed\"`"));
            }
        }
        if self.errors() > before {
            return None;
        }
        for (constant, value) in expressions.constants.iter().zip(constants_values) {
            if value.is_nan() {
                let span = system.span(at(constant.at));
                let error = Diagnostic::error("E0502", format!("{} must be known before the rig runs", constant.name))
                    .label(span, "not constant");
                self.report(error.help("numbers, constants and params can be used here"));
            }
        }
        let param = |node: usize, name: &str| -> f64 {
            let instance = framed.nodes[node];
            let found = params.iter().position(|(id, _)| {
                let var = system.var(*id);
                var.instance == instance && var.name == name
            });
            found.map_or(f64::NAN, |k| param_values[k])
        };
        let number = |at: usize| constants_values[at];
        let plan = self.plan(&system, &framed, &lists, &number, &param)?;
        let mut fielded = Vec::new();
        for (send, output) in lists.sends.iter().zip(&plan.outputs) {
            let (rig::Kind::Frames(messages), SignalKind::Field(m, f)) =
                (&plan.nodes[send.node].kind, output.signal.what)
            else {
                continue;
            };
            let (range, path) = (frames::carries(&messages[m].fields[f]), self.files.slice(send.path).to_string());
            fielded.push(live::FieldCommand { path, unit: send.unit.clone(), value: at(send.value), range });
        }
        for live::FieldCommand { path, unit, value: expr, range } in &fielded {
            // NaN for values that are not known before the run.
            let value = evaluate(&system, &types, &[*expr])[0];
            if value < range.0 || value > range.1 {
                let [low, high] = [range.0, range.1].map(|end| abi::format::three_digits(unit.from_si(end)));
                let error = Diagnostic::error("E0802", words::cannot_be(path, unit, value))
                    .label(system.span(*expr), format!("its field carries {low} .. {high}"));
                self.report(error.help("send what fits, or describe the field with more bits or a coarser `scale`"));
            }
        }
        let period = plan.period_ns as f64 * 1e-9;
        let [control_step, plant_step] = [plan.steps, PLANT_STEPS].map(|steps| period / f64::from(steps));
        let rate = self.statements.rate.map(|(_, span)| span);
        parameter_checks::whole_periods(&control, &control_types, control_step, rate, self.diagnostics);
        parameter_checks::whole_periods(&plant.system, &plant_types, plant_step, rate, self.diagnostics);
        let periods = |system: &System, step| system.blocks.iter().map(move |block| (block.period, step)).collect();
        let periods: Vec<(ExprId, f64)> = periods(&control, control_step);
        let judged = live::judged(
            &system,
            &types,
            self.files,
            &live::Fixed {
                part: (&path, &inside),
                nodes: &framed.nodes,
                plan: &exprs,
                periods: &periods,
                commands: &fielded,
            },
        );
        let tunes = &self.statements.tunes;
        for item in tunes.iter().filter(|item| !tuning::has(&system, &tuning::path(item, self.files))) {
            self.diagnostics.push(tuning::unknown(item, &system, self.files));
        }
        let tuned = tuning::read(tunes, &system, &types, self.files, self.diagnostics);
        let places = RigSpans {
            name: self.rig.name.span,
            rate: self.statements.rate.map_or(self.rig.name.span, |(expr, _)| expr.span),
            run: self.statements.run.map_or(self.rig.name.span, |run| run.instance.span),
            solver: match (self.statements.solver, self.statements.rate) {
                (Some(solver), _) => solver.method.span,
                (None, Some((rate, _))) => rate.span,
                (None, None) => self.rig.name.span,
            },
            nodes: self.descriptions.iter().map(|node| node.statement.kind.span).collect(),
            wires: lists.sends.iter().map(|send| send.span).collect(),
            allows: self.statements.allows.iter().map(|allow| allow.lint.text.clone()).collect(),
        };
        let mut cut = PartitionedRig {
            control,
            control_types,
            plant: plant.system,
            plant_types,
            observed,
            rig: plan,
            inputs: Vec::new(),
            outputs: commands,
            commands_read,
            stops,
            records,
            margins,
            applied: plant.applied,
            seen: plant.seen,
            seen_read: plant.seen_read,
            judged,
            tuned,
            places,
        };
        self.signals(&mut cut, &system, &framed, &gives, &at);
        self.shows(&mut cut, &lists);
        if self.errors() > before {
            return None;
        }
        Some(cut)
    }

    /// Whether a wire of the part has an error. Missing wires are then not reported.
    fn hardware_is_wrong(&self) -> bool {
        let Some(hardware) = self.statements.hardware else { return false };
        self.diagnostics.iter().any(|said| said.is_error() && said.span().is_within(hardware.span))
    }

    fn errors(&self) -> usize {
        self.diagnostics.iter().filter(|diagnostic| diagnostic.is_error()).count()
    }

    fn quantity(
        &mut self,
        system: &mut System,
        instance: InstanceId,
        kind: VarKind,
        name: &str,
        span: Span,
        definition: Definition,
    ) -> VarId {
        let path = match system.instance(instance).path.as_str() {
            "" => format!("{} {name}", self.rig.name.text),
            path => format!("{path}.{name}"),
        };
        system.vars.push(Var {
            path,
            name: name.into(),
            span,
            instance,
            kind,
            unit: None,
            unreadable: false,
            shown: None,
            range: VarRange::default(),
            range_span: None,
            definition,
            doc: None,
        });
        VarId(system.vars.len() as u32 - 1)
    }

    /// The observed condition of each `stop`. A condition with a crossing, which holds for an instant only, sets a
    /// state that keeps it.
    fn latched(&mut self, system: &mut System, framed: &RigFrame, lists: &ExprIndices) -> Vec<ExprId> {
        let mut out = Vec::new();
        for stop in &lists.stops {
            let condition = framed.expressions[*stop];
            if !has_crossing(system, condition) {
                out.push(condition);
                continue;
            }
            let span = system.span(condition);
            let (initial, rate) = (system.push(nothing(), span), system.push(nothing(), span));
            let definition = Definition::Continuous { initial, rate, path: None, span };
            let name = format!("stop {}", out.len() + 1);
            let state = self.quantity(system, framed.rig, VarKind::State, &name, span, definition);
            system.vars[state.0 as usize].unit = Some((Unit::none(), span));
            let set = system.push(one(), span);
            system.events.push(Event { instance: framed.rig, condition, resets: vec![(state, set)], span });
            let (value, reached) = (system.push(Node::Var(state), span), system.push(one(), span));
            out.push(system.push(Node::Binary(ast::BinaryOp::GreaterEqual, value, reached), span));
        }
        out
    }

    /// Checks the system before the partition, like any other system.
    fn check_whole(&mut self, system: &System) -> Option<Types> {
        let mut found = Vec::new();
        let types = analyse(system, self.files, Depth::Values, &Diagnostic::is_error, &mut found);
        let failed = |found: &[Diagnostic]| found.iter().any(Diagnostic::is_error);
        let stop = failed(&found) || self.errors() > 0 || self.loaded.has_errors();
        self.diagnostics.extend(found);
        (!stop).then_some(types)
    }
}

/// Whether an expression contains a crossing.
fn has_crossing(system: &System, id: ExprId) -> bool {
    matches!(system.node(id), Node::Crossing(_)) || system.node(id).operands().any(|a| has_crossing(system, a))
}

/// `name = expr` of `hardware`.
struct PartOutput {
    var: VarId,
    value: usize,
    span: Span,
}

/// The part that hardware replaces, as a system.
struct PlantSystem {
    system: System,
    applied: Vec<VarId>,
    seen: Vec<VarId>,
    seen_read: Vec<ExprId>,
}
