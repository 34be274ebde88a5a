//! Linearisation: state-space matrices of a model at a point.
//!
//! In: a model or an experiment, and the names of inputs and outputs. Out: a [`Linear`], which computes A, B, C and D
//! at any point of its block by automatic differentiation. An input that has a value inside the model is perturbed by
//! an added quantity. Sampled states, regimes and branches are held fixed. If parameters are named, P and Q are the
//! derivatives with respect to them. A loop can be broken at a quantity; then its sampled code is differentiated too.

use crate::frontend::names::nearest;
use crate::frontend::system::*;
use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::ir::hash::HashMap;
use crate::ir::interpret::run_once;
use crate::ir::program::Program;
use crate::numerics::autodiff;
use abi::Slot;
use abi::description::{Kind, Quantity};
use abi::plan::Experiment;
use abi::{Description, Instance};
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use std::sync::Arc;

/// Inputs and outputs of a linearisation, by path. Empty lists stand for those of the root instance.
#[derive(Clone, Debug, Default)]
pub struct Ports {
    /// Inputs.
    pub inputs: Vec<String>,
    /// Outputs, or any other quantities.
    pub outputs: Vec<String>,
    /// Parameters for P and Q; none by default.
    pub params: Vec<String>,
    /// A quantity at which a loop is broken. It is then the only input and the only output.
    pub broken: Option<String>,
}

/// Inputs and outputs by path, with the slots of their values.
pub type PortSlots = (Vec<(String, Slot)>, Vec<(String, Slot)>);

/// Inputs and outputs found in a system.
#[derive(Default)]
pub struct OpenPorts {
    /// Path of each input, and of the quantity that perturbs it: the input itself, or a quantity added to it.
    pub inputs: Vec<(String, String)>,
    /// Path of each output, and its value.
    pub outputs: Vec<(String, ExprId)>,
}

/// Finds inputs and outputs. Adds a perturbation to each input that has a value of its own.
pub fn open(system: &mut System, ports: &Ports, diagnostics: &mut Vec<Diagnostic>) -> OpenPorts {
    if let Some(path) = &ports.broken {
        return break_loop(system, path, diagnostics).unwrap_or_default();
    }
    let mut opened = OpenPorts::default();
    for id in chosen(system, &ports.inputs, &[VarKind::Input], "input", diagnostics) {
        let var = system.var(id).clone();
        match var.definition {
            Definition::Value(value, origin) => {
                let (sum, moved) = perturbed(system, &var, value);
                system.vars[id.0 as usize].definition = Definition::Value(sum, origin);
                opened.inputs.push((var.path, moved));
            }
            Definition::Held { .. } => {
                let message = format!("`{}` is given at ticks only: it cannot be moved", var.path);
                diagnostics.push(Diagnostic::error("E0901", message).label(var.span, "this input"));
            }
            _ => opened.inputs.push((var.path.clone(), var.path)),
        }
    }
    let outputs = if ports.outputs.is_empty() { &[VarKind::Output][..] } else { &[] };
    for id in chosen(system, &ports.outputs, outputs, "output", diagnostics) {
        let (path, span) = (system.var(id).path.clone(), system.var(id).span);
        let value = system.push(Node::Var(id), span);
        opened.outputs.push((path, value));
    }
    opened
}

/// Adds a free quantity of the kind of `var` to a value. Returns the sum and the path of the quantity.
fn perturbed(system: &mut System, var: &Var, value: ExprId) -> (ExprId, String) {
    let moved = format!("{} moved", var.path);
    let added = VarId(system.vars.len() as u32);
    let span = system.span(value);
    system.vars.push(Var {
        path: moved.clone(),
        name: moved.clone(),
        instance: InstanceId(0),
        kind: VarKind::Input,
        // Its unit is that of the value, which may be inferred: it matches every unit.
        unreadable: var.unit.is_none(),
        definition: Definition::Free,
        range: VarRange::default(),
        range_span: None,
        ..var.clone()
    });
    let amount = system.push(Node::Var(added), span);
    (system.push(Node::Binary(BinaryOp::Add, value, amount), span), moved)
}

/// Breaks a loop at a quantity: outside of the model that computes it, the quantity is replaced by a sum of itself and
/// a free quantity. The model itself, such as the anti-wind-up of a controller, goes on reading what it has computed.
pub fn break_loop(system: &mut System, path: &str, diagnostics: &mut Vec<Diagnostic>) -> Option<OpenPorts> {
    let id = *chosen(system, &[path.to_string()], &[], "quantity", diagnostics).first()?;
    let var = system.var(id).clone();
    let (block, origin) = match var.definition {
        Definition::Value(_, origin) if var.kind != VarKind::Param => (None, origin),
        Definition::Held { block, origin, .. } => (Some(block), origin),
        _ => {
            let what = match var.definition {
                Definition::Free | Definition::Missing => "has no value inside the model: no loop passes through it",
                _ => "is no computed quantity: no loop can be broken there",
            };
            let error = Diagnostic::error("E0901", format!("`{path}` {what}"));
            let word = var.kind.word();
            let held = system.vars.iter().find(|var| matches!(var.definition, Definition::Held { .. }));
            let such = held.map_or(String::new(), |held| format!(", such as `{}`", held.path));
            diagnostics.push(
                error
                    .label(var.span, format!("a {word}"))
                    .help(format!("break the loop at the output of the controller{such}")),
            );
            return None;
        }
    };
    let computed = VarId(system.vars.len() as u32);
    for node in own_nodes(system, &var, block) {
        if system.nodes[node] == Node::Var(id) {
            system.nodes[node] = Node::Var(computed);
        }
    }
    let name = format!("{path} computed");
    system.vars.push(Var { path: name.clone(), name, ..var.clone() });
    let value = system.push(Node::Var(computed), var.span);
    let (sum, moved) = perturbed(system, &var, value);
    system.vars[id.0 as usize].definition = Definition::Value(sum, origin);
    Some(OpenPorts { inputs: vec![(path.into(), moved)], outputs: vec![(path.into(), value)] })
}

/// The nodes of the equations that belong to the model of a quantity with its parts; in the root instance, to its block
/// of sampled code, `block`. The value of an input comes from outside.
fn own_nodes(system: &System, var: &Var, block: Option<BlockId>) -> Vec<usize> {
    let mut own = vec![false; system.vars.len()];
    let mut from: Vec<ExprId> = Vec::new();
    if var.kind == VarKind::Input {
        return Vec::new();
    }
    if var.instance != InstanceId(0) {
        let path = &system.instance(var.instance).path;
        let inside = |instance: InstanceId| {
            let rest = system.instance(instance).path.strip_prefix(path.as_str());
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        for (k, other) in system.vars.iter().enumerate() {
            own[k] = inside(other.instance) && !(other.kind == VarKind::Input && other.instance == var.instance);
        }
        for automaton in system.automata.iter().filter(|automaton| inside(automaton.instance)) {
            for transition in automaton.regimes.iter().flat_map(|regime| &regime.transitions) {
                from.push(transition.condition);
                from.extend(transition.resets.iter().map(|(_, value)| *value));
            }
        }
        for event in system.events.iter().filter(|event| inside(event.instance)) {
            from.push(event.condition);
            from.extend(event.resets.iter().map(|(_, value)| *value));
        }
    } else if block.is_some() {
        let in_block = |other: &Var| match other.definition {
            Definition::Held { block: of, .. } | Definition::Sampled { block: of, .. } => Some(of) == block,
            _ => false,
        };
        for (k, other) in system.vars.iter().enumerate() {
            own[k] = in_block(other);
        }
        // A `let` that only this block reads belongs to it.
        let mut readers: Vec<Vec<usize>> = vec![Vec::new(); system.vars.len()];
        for (k, other) in system.vars.iter().enumerate() {
            for node in below(system, values(&other.definition)) {
                if let Node::Var(read) = system.nodes[node] {
                    readers[read.0 as usize].push(k);
                }
            }
        }
        let lets = || (0..system.vars.len()).filter(|k| system.vars[*k].kind == VarKind::Let);
        while let Some(k) = lets().find(|k| !own[*k] && !readers[*k].is_empty() && readers[*k].iter().all(|r| own[*r]))
        {
            own[k] = true;
        }
    }
    from.extend(system.vars.iter().zip(&own).filter(|(_, own)| **own).flat_map(|(var, _)| values(&var.definition)));
    below(system, from)
}

/// The expressions that determine a quantity after the start.
fn values(definition: &Definition) -> Vec<ExprId> {
    match definition {
        Definition::Missing | Definition::Free => Vec::new(),
        Definition::Value(value, _) | Definition::Held { value, .. } => vec![*value],
        Definition::Sampled { next, .. } => vec![*next],
        Definition::Continuous { rate, path, .. } => {
            [*rate].into_iter().chain(path.as_ref().map(|(rate, _)| *rate)).collect()
        }
    }
}

/// These nodes and all their operands.
fn below(system: &System, from: Vec<ExprId>) -> Vec<usize> {
    let (mut seen, mut stack) = (vec![false; system.nodes.len()], from);
    while let Some(id) = stack.pop() {
        if !std::mem::replace(&mut seen[id.0 as usize], true) {
            stack.extend(system.node(id).operands());
        }
    }
    (0..seen.len()).filter(|k| seen[*k]).collect()
}

/// The quantities of these names; those of the root instance if there are no names. `kinds`: allowed kinds, empty for
/// any.
fn chosen(
    system: &System,
    names: &[String],
    kinds: &[VarKind],
    what: &str,
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<VarId> {
    let fits = |var: &Var| kinds.is_empty() || kinds.contains(&var.kind);
    if names.is_empty() {
        return system
            .var_ids()
            .filter(|id| fits(system.var(*id)) && system.var(*id).instance == InstanceId(0))
            .collect();
    }
    let mut found = Vec::new();
    for name in names {
        match system.var_ids().find(|id| system.var(*id).path == *name) {
            Some(id) if fits(system.var(id)) => found.push(id),
            Some(id) => {
                let word = system.var(id).kind.word();
                let error = Diagnostic::error("E0201", format!("`{name}` is no {what}"));
                diagnostics.push(error.label(system.var(id).span, format!("a {word}")));
            }
            None => {
                let known = system.vars.iter().filter(|var| fits(var)).map(|var| var.path.as_str());
                let error = Diagnostic::error("E0201", format!("there is no {what} `{name}`"));
                let error = error.label(Span::new(FileId(0), 0, 0), "in this file");
                diagnostics.push(match nearest(name, known) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error,
                });
            }
        }
    }
    found
}

/// A model that can be linearised.
pub struct Linear {
    /// Set it to the operating point: parameters, inputs, then start it, then states.
    pub instance: Instance,
    /// The experiment, if one was linearised.
    pub experiment: Option<Experiment>,
    /// States x, in order.
    pub states: Vec<Quantity>,
    /// Inputs u: path, and the quantity that perturbs it.
    pub inputs: Vec<(String, Quantity)>,
    /// Outputs y: path and quantity.
    pub outputs: Vec<(String, Quantity)>,
    /// Parameters p: those of the requested that exist.
    pub params: Vec<Quantity>,
    func: Func,
    broken: Option<BrokenLoop>,
}

/// The derivatives of a system with a broken loop, as functions of the block.
struct BrokenLoop {
    /// Sampled states and held outputs.
    memory: Vec<Slot>,
    /// Rows of dx/dt, then that of the quantity at which the loop is broken, by x, memory and w.
    flow: Func,
    /// Rows of the memory after a tick, by x, memory and w.
    tick: Option<Func>,
    /// Whether a staircase counts as the line through it.
    smoothed: bool,
}

/// A system whose loop is broken at a quantity y, whose users read y + w. Small changes of the states x (n of them), of
/// the memory s (m: sampled states and held outputs) and of w, row-major and in SI: between ticks
/// dx/dt = flow · (x, s, w), and y = output · (x, s).
#[derive(Clone, PartialEq, Debug)]
pub struct LoopMatrices {
    /// Number of states.
    pub states: usize,
    /// Number of sampled states and held outputs.
    pub memory: usize,
    /// n × (n + m + 1), by x, s and w.
    pub flow: Vec<f64>,
    /// n + m, by x and s.
    pub output: Vec<f64>,
    /// Period of each sampled block, s.
    pub periods: Vec<f64>,
    /// Whether a staircase, such as that of an encoder, counts as the line through it.
    pub smoothed: bool,
}

/// dx/dt = A x + B u + P p and y = C x + D u + Q p around a point, in SI units; row-major.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Matrices {
    pub a: Vec<f64>,
    pub b: Vec<f64>,
    pub c: Vec<f64>,
    pub d: Vec<f64>,
    pub p: Vec<f64>,
    pub q: Vec<f64>,
    /// dx/dt at the point itself; 0 at an equilibrium.
    pub rates: Vec<f64>,
}

impl Linear {
    /// From a program and its ports. `params`: paths of parameters; unknown ones are ignored.
    pub fn new(
        program: &Program,
        instance: Instance,
        experiment: Option<Experiment>,
        ports: &PortSlots,
        params: &[String],
    ) -> Linear {
        let description: &Arc<Description> = instance.description();
        let layout = &description.layout;
        let at = |slot: Slot| description.quantities.iter().find(|quantity| quantity.slot == slot).cloned();
        let states: Vec<Quantity> = layout.states.range().filter_map(|slot| at(Slot(slot as u32))).collect();
        let with = |ports: &[(String, Slot)]| -> Vec<(String, Quantity)> {
            ports.iter().filter_map(|(path, slot)| Some((path.clone(), at(*slot)?))).collect()
        };
        let (inputs, outputs) = (with(&ports.0), with(&ports.1));
        let param = |path: &String| description.quantity(path).filter(|quantity| quantity.kind == Kind::Param).cloned();
        let params: Vec<Quantity> = params.iter().filter_map(param).collect();
        let of_ports = inputs.iter().map(|(_, quantity)| quantity).chain(&params).map(|quantity| quantity.slot);
        let directions: Vec<Slot> = layout.states.range().map(|slot| Slot(slot as u32)).chain(of_ports).collect();
        let build = Shared::new(Build::new("linearised").with_pool(description.pool.clone()));
        let of_rates = autodiff::inline(&build, &program.derivatives, &mut Env::default(), &directions);
        let of_outputs = autodiff::inline(&build, &program.outputs, &mut Env::default(), &directions);
        let mut build = build.into_inner();
        let mut next = layout.size();
        let rows = (0..states.len()).map(|i| layout.derivatives.slot(i));
        for row in rows.chain(outputs.iter().map(|(_, quantity)| quantity.slot)) {
            // The derivative of an output that is a state is a row of the identity.
            let itself = directions.iter().position(|direction| *direction == row);
            let gradient = of_rates.get(&row).or_else(|| of_outputs.get(&row));
            for k in 0..directions.len() {
                let entry = gradient.and_then(|gradient| autodiff::entry(gradient, k as u32));
                let entry = entry.unwrap_or_else(|| build.real(f64::from(itself == Some(k))));
                build.store(Slot(next as u32), entry);
                next += 1;
            }
        }
        let func = crate::math::expand(&build.finish());
        Linear { instance, experiment, states, inputs, outputs, params, func, broken: None }
    }

    /// The same with the derivatives of its sampled code, for a loop broken at its only output.
    pub fn breaking(self, program: &Program) -> Linear {
        let description = self.instance.description().clone();
        let layout = &description.layout;
        let kept = |quantity: &&Quantity| layout.memory.contains(quantity.slot);
        let mut memory: Vec<Slot> = description.quantities.iter().filter(kept).map(|quantity| quantity.slot).collect();
        memory.sort();
        memory.dedup();
        let (Some((_, input)), Some((_, output))) = (self.inputs.first(), self.outputs.first()) else { return self };
        let states = layout.states.range().map(|slot| Slot(slot as u32));
        let directions: Vec<Slot> = states.chain(memory.iter().copied()).chain([input.slot]).collect();
        let mut smoothed = false;
        let mut rows = |funcs: &[&Func], rows: &[Slot]| {
            let build = Shared::new(Build::new("loop").with_pool(description.pool.clone()));
            let mut gradients = HashMap::default();
            for func in funcs {
                gradients.extend(autodiff::inline_smoothed(
                    &build,
                    func,
                    &mut Env::default(),
                    &directions,
                    &mut smoothed,
                ));
            }
            let mut build = build.into_inner();
            let mut next = layout.size();
            for row in rows {
                let itself = directions.iter().position(|direction| direction == row);
                for k in 0..directions.len() {
                    let entry = gradients.get(row).map(|gradient| autodiff::entry(gradient, k as u32));
                    let entry = match entry {
                        Some(entry) => entry.unwrap_or_else(|| build.real(0.0)),
                        None => build.real(f64::from(itself == Some(k))),
                    };
                    build.store(Slot(next as u32), entry);
                    next += 1;
                }
            }
            crate::math::expand(&build.finish())
        };
        let of_flow: Vec<Slot> =
            (0..self.states.len()).map(|i| layout.derivatives.slot(i)).chain([output.slot]).collect();
        let flow = rows(&[&program.derivatives, &program.outputs], &of_flow);
        let tick = program.tick.as_ref().map(|tick| rows(&[tick], &memory));
        Linear { broken: Some(BrokenLoop { memory, flow, tick, smoothed }), ..self }
    }

    /// Evaluates derivatives at the present point: `rows` rows.
    fn evaluated(&self, func: &Func, rows: usize, width: usize) -> Vec<f64> {
        let description = self.instance.description();
        let size = description.layout.size();
        let mut block = self.instance.block().to_vec();
        block.resize(size + rows * width, 0.0);
        run_once(func, &mut block, &description.pool);
        block.split_off(size)
    }

    /// The broken loop between ticks, at the present point; `None` if none was broken.
    pub fn loop_at(&mut self) -> Option<LoopMatrices> {
        if !self.states.is_empty() {
            self.instance.call(abi::Function::Derivatives);
        }
        self.instance.call(abi::Function::Outputs);
        let broken = self.broken.as_ref()?;
        let (n, m) = (self.states.len(), broken.memory.len());
        let width = n + m + 1;
        let mut flow = self.evaluated(&broken.flow, n + 1, width);
        let output = flow.split_off(n * width)[..n + m].to_vec();
        let ticks = &self.instance.description().ticks;
        let periods = ticks.iter().map(|tick| self.instance.get(tick.period)).collect();
        Some(LoopMatrices { states: n, memory: m, flow, output, periods, smoothed: broken.smoothed })
    }

    /// The memory after a tick of the sampled blocks that are due, by x, s and w: m × (n + m + 1).
    pub fn tick_at(&mut self, due: &[bool]) -> Option<Vec<f64>> {
        let ticks = self.instance.description().ticks.clone();
        for (tick, due) in ticks.iter().zip(due) {
            self.instance.set(tick.due, f64::from(*due));
        }
        let broken = self.broken.as_ref()?;
        let m = broken.memory.len();
        Some(self.evaluated(broken.tick.as_ref()?, m, self.states.len() + m + 1))
    }

    /// The matrices at the present point of the instance.
    pub fn at(&mut self) -> Matrices {
        let (n, m, p) = (self.states.len(), self.inputs.len(), self.outputs.len());
        let width = n + m + self.params.len();
        if n > 0 {
            self.instance.call(abi::Function::Derivatives);
        }
        self.instance.call(abi::Function::Outputs);
        let description = self.instance.description().clone();
        let size = description.layout.size();
        let mut block = self.instance.block().to_vec();
        block.resize(size + (n + p) * width, 0.0);
        run_once(&self.func, &mut block, &description.pool);
        let rows: Vec<&[f64]> = block[size..].chunks_exact(width.max(1)).collect();
        let part =
            |rows: &[&[f64]], from: usize, to: usize| rows.iter().flat_map(|row| &row[from..to]).copied().collect();
        let (above, below) = rows.split_at(n.min(rows.len()));
        Matrices {
            a: part(above, 0, n),
            b: part(above, n, n + m),
            c: part(below, 0, n),
            d: part(below, n, n + m),
            p: part(above, n + m, width),
            q: part(below, n + m, width),
            rates: block[description.layout.derivatives.range()].to_vec(),
        }
    }

    /// Quantities that can be set at the operating point: states, free inputs, parameters.
    pub fn movable(&self) -> impl Iterator<Item = &Quantity> {
        let kinds = [Kind::State, Kind::SampledState, Kind::Input, Kind::Param];
        let description = self.instance.description();
        description
            .quantities
            .iter()
            .filter(move |quantity| kinds.contains(&quantity.kind) && !quantity.path.ends_with(" moved"))
    }
}
