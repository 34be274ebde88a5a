//! The sign of friction: a contact whose force drives the motion that it rubs on.
//!
//! In: a flat system. Out: W0706 for a part with the ports `v` and `F` of a contact, if its own speed rises faster the
//! greater its force: Σ ∂v/∂x · ∂(dx/dt)/∂F > 0 over the states x, at the start. Both derivatives are exact, from the
//! linearisation between the force, as an input at all its users, and the speed. So it does not matter whether the sign
//! is wrong in `+ fr.F`, in `v = -body.v` or in the argument of the mass.

use crate::analysis::linearise::{Linear, break_loop};
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::interpret::Interpreter;
use crate::lower::{Lowered, Observed, lower};
use abi::plan::Method;
use abi::table::Code;
use abi::unit::Dimension;
use abi::{Instance, Slot};
use grammar::diagnostic::Diagnostic;
use std::sync::Arc;

const FORCE: Dimension = Dimension::of([1, 1, -2, 0, 0]);
const TORQUE: Dimension = Dimension::of([1, 2, -2, 0, 0]);
const SPEED: Dimension = Dimension::of([0, 1, -1, 0, 0]);
const TURN: Dimension = Dimension::of([0, 0, -1, 0, 0]);
/// Inputs that a contact may have beside its speed. A model with others, such as a motor with a voltage, may push.
const OTHERS: [&str; 5] = ["F_ext", "N", "T", "x", "h"];

/// A contact whose force has been opened.
pub struct Opened {
    contact: InstanceId,
    /// Path of the force, and of what is added to it.
    force: (String, String),
    speed: VarId,
}

/// The system with the force of each contact open to an addition, and these contacts; `None` without a contact.
pub fn open(system: &System, types: &Types) -> Option<(System, Vec<Opened>)> {
    let mut ports: Vec<[Option<VarId>; 2]> = vec![[None; 2]; system.instances.len()];
    let mut others = vec![false; system.instances.len()];
    for id in system.var_ids() {
        let var = system.var(id);
        let (at, dimension) = (var.instance.0 as usize, types.units[id.0 as usize].dimension);
        match (var.kind, var.name.as_str()) {
            (VarKind::Input, "v") if [SPEED, TURN].contains(&dimension) => ports[at][0] = Some(id),
            (VarKind::Output, "F") if [FORCE, TORQUE].contains(&dimension) => ports[at][1] = Some(id),
            (VarKind::Input, name) => others[at] |= !OTHERS.contains(&name),
            _ => {}
        }
    }
    let mut moved = system.clone();
    let mut contacts = Vec::new();
    // The contact at the root rubs on what is outside.
    for (k, ports) in ports.iter().enumerate().skip(1) {
        let (&[Some(speed), Some(force)], false) = (ports, others[k]) else { continue };
        let computed = matches!(system.var(force).definition, Definition::Value(..) | Definition::Held { .. });
        let given = matches!(system.var(speed).definition, Definition::Value(..));
        if !computed || !given {
            continue;
        }
        let opened = break_loop(&mut moved, &system.var(force).path, &mut Vec::new());
        let Some(input) = opened.and_then(|opened| opened.inputs.into_iter().next()) else { continue };
        contacts.push(Opened { contact: InstanceId(k as u32), force: input, speed });
    }
    (!contacts.is_empty()).then_some((moved, contacts))
}

/// The warnings. `system` and `types`: those that [`open`] made, checked.
pub fn check(system: &System, types: &Types, contacts: &[Opened]) -> Vec<Diagnostic> {
    let mut moved = system.clone();
    let wanted: Vec<Observed> = contacts
        .iter()
        .map(|one| {
            let text = system.var(one.speed).path.clone();
            Observed { expr: moved.push(Node::Var(one.speed), system.var(one.speed).span), text, unit: None }
        })
        .collect();
    let mut types = types.clone();
    for one in contacts {
        types.nodes.push(Some(types.units[one.speed.0 as usize].dimension));
        types.boolean.push(false);
    }
    let Lowered { program, observed } = lower(&moved, &types, &wanted);
    let description = Arc::new(program.description.clone());
    if description.layout.states.len == 0 || !description.delays.is_empty() {
        return Vec::new();
    }
    let slot = |path: &str| description.quantity(path).map(|quantity| quantity.slot);
    let inputs: Option<Vec<(String, Slot)>> =
        contacts.iter().map(|one| Some((one.force.0.clone(), slot(&one.force.1)?))).collect();
    let Some(inputs) = inputs else { return Vec::new() };
    let outputs = contacts.iter().zip(observed).map(|(one, slot)| (system.var(one.speed).path.clone(), slot));
    let functions = crate::codegen::tiering::functions(&program, Method::Adaptive);
    let interpreter = Interpreter::new(&functions, &description.layout, description.pool.len());
    let mut instance = Instance::new(description.clone(), Code::Interpreted(Arc::new(interpreter)), &program.params);
    instance.start(0.0);
    let ports = (inputs, outputs.collect());
    let mut linear = Linear::new(&program, instance, None, &ports, &[]);
    let (n, m) = (linear.states.len(), linear.inputs.len());
    if m != contacts.len() || linear.outputs.len() != m {
        return Vec::new();
    }
    let found = linear.at();
    let gain = |k: usize| -> f64 { (0..n).map(|i| found.c[k * n + i] * found.b[i * m + k]).sum() };
    let pushes = (0..m).filter(|k| gain(*k) > 0.0).map(|k| (&contacts[k], gain(k)));
    pushes.filter_map(|(one, gain)| said(system, one, gain)).collect()
}

fn said(system: &System, one: &Opened, gain: f64) -> Option<Diagnostic> {
    let part = system.instance(one.contact);
    if part.allows.iter().any(|allow| allow == "pushes") {
        return None;
    }
    let (path, mass) = (&part.path, abi::format::three_digits(1.0 / gain));
    let warning = Diagnostic::warning("W0706", format!("the friction `{path}` drives what it rubs on"))
        .label(part.span, format!("a greater `{path}.F` makes `{path}.v` rise: it acts as on a mass of -{mass}"));
    Some(warning.help(format!(
        "a contact takes force from the motion: write `- {path}.F` where its force enters, or turn the sign of its `v`"
    )))
}
