//! Checks that a sampled contact is given the mass on which it acts.
//!
//! In: a system with its program. Out: W0705 for a contact that computes its force at ticks from a mass `m` (such as
//! KFMClip), if `m` is far from the mass that the force accelerates. At each tick the contact stops the mass by F = m
//! v/h, after which 1 − m/M of the speed remains on a mass M. With m > 2 M the contact chatters; with m ≪ M it takes
//! many ticks to stop. M is 1/|a|, where a is the change of the speed's rate per unit of force.

use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::interpret::Interpreter;
use crate::ir::program::Program;
use abi::format::quantity;
use abi::plan::Method;
use abi::table::Code;
use abi::unit::Dimension;
use abi::{Function, Instance};
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::sync::Arc;

const MASS: Dimension = Dimension::of([1, 0, 0, 0, 0]);
const INERTIA: Dimension = Dimension::of([1, 2, 0, 0, 0]);
/// Ratios m/M that are accepted: within these the contact stops in a few ticks.
const FITS: std::ops::RangeInclusive<f64> = 0.5..=1.5;

/// The quantities of a sampled contact.
struct SampledContact {
    speed: VarId,
    force: VarId,
    mass: VarId,
}

fn contacts(system: &System, types: &Types) -> Vec<SampledContact> {
    let mut ports: Vec<[Option<VarId>; 3]> = vec![[None; 3]; system.instances.len()];
    for id in system.var_ids() {
        let var = system.var(id);
        let port = match (var.kind, var.name.as_str()) {
            (VarKind::Output, "F") => 0,
            (VarKind::Param, "m") => 1,
            (VarKind::Input, "v") => 2,
            _ => continue,
        };
        ports[var.instance.0 as usize][port].get_or_insert(id);
    }
    let contact = |ports: [Option<VarId>; 3]| {
        let [Some(force), Some(mass), Some(speed)] = ports else { return None };
        let held = matches!(system.var(force).definition, Definition::Held { .. });
        let fits = [MASS, INERTIA].contains(&types.units[mass.0 as usize].dimension);
        (held && fits).then_some(SampledContact { speed, force, mass })
    };
    ports.into_iter().filter_map(contact).collect()
}

/// Checks the contacts of a system. `elsewhere`: the accelerated mass in SI units, for systems that do not contain it,
/// such as the control program of a rig. `place`: span of the run.
pub fn check(
    system: &System,
    types: &Types,
    program: &Program,
    elsewhere: Option<f64>,
    place: Span,
) -> Vec<Diagnostic> {
    let contacts = contacts(system, types);
    if contacts.is_empty() {
        return Vec::new();
    }
    let description = Arc::new(program.description.clone());
    let functions = crate::codegen::tiering::functions(program, Method::Adaptive);
    let interpreter = Interpreter::new(&functions, &description.layout, description.pool.len());
    let mut at = Instance::new(description, Code::Interpreted(Arc::new(interpreter)), &program.params);
    at.start(0.0);
    contacts.iter().filter_map(|contact| said(contact, system, types, &at, elsewhere, place)).collect()
}

fn said(
    contact: &SampledContact,
    system: &System,
    types: &Types,
    at: &Instance,
    elsewhere: Option<f64>,
    place: Span,
) -> Option<Diagnostic> {
    let slot = |id: VarId| at.description().quantity(&system.var(id).path).map(|quantity| quantity.slot);
    let force = slot(contact.force)?;
    let Definition::Value(mass, _) = system.var(contact.mass).definition else { return None };
    let told = crate::lower::evaluate(system, types, &[mass])[0];
    // The rates with a force of 0 and of 1, whose difference is the gain.
    let layout = &at.description().layout;
    let rates = |force_is: f64| {
        let mut moved = at.clone();
        moved.set(force, force_is);
        moved.call(Function::Derivatives);
        moved
    };
    let (still, pushed) = (rates(0.0), rates(1.0));
    let gain: f64 = parts_of(system, contact.speed)
        .into_iter()
        .filter_map(|(state, share)| {
            let number = slot(state)?.index() - layout.states.start as usize;
            let rate = layout.derivatives.slot(number);
            Some(share * (pushed.get(rate) - still.get(rate)))
        })
        .sum();
    let acts_on = if gain != 0.0 && gain.is_finite() { Some(1.0 / gain.abs()) } else { elsewhere }?;
    if FITS.contains(&(told / acts_on)) || !acts_on.is_finite() {
        return None;
    }
    let (var, unit) = (system.var(contact.mass), &types.units[contact.mass.0 as usize]);
    let shown = |value: f64| quantity(value, unit, 3);
    let effect = if told > acts_on { "the contact throws the speed to and fro" } else { "the contact stops late" };
    let path = &var.path;
    Some(
        Diagnostic::warning("W0705", format!("`{path}` is not the mass on which the contact acts"))
            .label(place, format!("it acts on {}, and `{path}` is {}", shown(acts_on), shown(told)))
            .label(var.span, "the mass that each tick stops")
            .help(format!("{effect}; write `m = {}`. To keep it: `allow chatter \"...\"`", shown(acts_on))),
    )
}

/// The states whose signed sum a quantity is, with their signs; empty for any other form.
fn parts_of(system: &System, id: VarId) -> Vec<(VarId, f64)> {
    let (mut found, mut open) = (Vec::new(), vec![(Node::Var(id), 1.0)]);
    while let Some((node, sign)) = open.pop() {
        match node {
            Node::Var(id) => match system.var(id).definition {
                Definition::Continuous { .. } => found.push((id, sign)),
                Definition::Value(value, _) => open.push((system.node(value).clone(), sign)),
                _ => return Vec::new(),
            },
            Node::Fits { value, .. } => open.push((system.node(value).clone(), sign)),
            Node::Negate(a) => open.push((system.node(a).clone(), -sign)),
            Node::Binary(BinaryOp::Add, a, b) => {
                open.extend([(system.node(a).clone(), sign), (system.node(b).clone(), sign)])
            }
            Node::Binary(BinaryOp::Subtract, a, b) => {
                open.extend([(system.node(a).clone(), sign), (system.node(b).clone(), -sign)])
            }
            _ => return Vec::new(),
        }
    }
    found
}
