//! Linearisation: state-space matrices of a model at a point.
//!
//! In: a model or an experiment, and the names of inputs and outputs. Out: a [`Linear`], which computes A, B, C and D
//! at any point of its block by automatic differentiation. An input that has a value inside the model is perturbed by
//! an added quantity. Sampled states, regimes and branches are held fixed. If parameters are named, P and Q are the
//! derivatives with respect to them.

use crate::frontend::names::nearest;
use crate::frontend::system::*;
use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
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
    let mut opened = OpenPorts::default();
    for id in chosen(system, &ports.inputs, &[VarKind::Input], "input", diagnostics) {
        let var = system.var(id).clone();
        match var.definition {
            Definition::Value(value, origin) => {
                let moved = format!("{} moved", var.path);
                let added = VarId(system.vars.len() as u32);
                let span = system.span(value);
                system.vars.push(Var {
                    path: moved.clone(),
                    name: moved.clone(),
                    instance: InstanceId(0),
                    definition: Definition::Free,
                    range: VarRange::default(),
                    range_span: None,
                    ..var.clone()
                });
                let amount = system.push(Node::Var(added), span);
                let sum = system.push(Node::Binary(BinaryOp::Add, value, amount), span);
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
        Linear { instance, experiment, states, inputs, outputs, params, func }
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
