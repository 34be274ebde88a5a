//! Holds a run to its recording: an observer, whose gain is a parameter, corrects the states that are compared.
//!
//! In: a flat system and the compared differences. Out: the system with the corrections, if a difference is that of a
//! state and a column of the recording. With a gain of 0 it is the system as written. A fit follows its answer from a
//! large gain to none: Abarbanel et al., "Dynamical State and Parameter Estimation", SIAM J. Appl. Dyn. Syst. 8 (2009).

use crate::frontend::system::*;
use abi::unit::{Angle, Unit};
use grammar::ast::BinaryOp;

/// The path of the pole of the observer, in 1/s. No declared parameter can have such a name.
pub const POLE: &str = "pole(fit)";

/// Whether a state is compared, so that a run can be held.
pub fn is_possible(system: &System, compared: &[ExprId]) -> bool {
    !states(system, compared).is_empty()
}

/// The compared states, each with what the recording has of it.
fn states(system: &System, compared: &[ExprId]) -> Vec<(VarId, ExprId)> {
    let mut all: Vec<(VarId, ExprId)> = Vec::new();
    for difference in compared {
        let Node::Binary(BinaryOp::Subtract, a, b) = *system.node(*difference) else { continue };
        for (of, recorded) in [(a, b), (b, a)] {
            if let (Some(state), Node::Table(..)) = (state(system, of), system.node(recorded))
                && all.iter().all(|(other, _)| *other != state)
            {
                all.push((state, recorded));
            }
        }
    }
    all
}

/// For each compared state x, with the recorded value d and the pole p:
///
///   dx/dt += 2 p (d − x)
///   dv/dt += p² (d − x)      where dx/dt = v is a state
///
/// Both poles of the error are then at −p, where v is otherwise free. Returns whether a state is compared.
pub fn hold(system: &mut System, compared: &[ExprId]) -> bool {
    let all = states(system, compared);
    let Some((first, _)) = all.first() else { return false };
    let place = system.span(compared[0]);
    let number = |value, dimension| Node::Number { value, dimension, angle: Angle::Silent };
    let zero = system.push(number(0.0, None), place);
    let mut pole = system.var(*first).clone();
    (pole.path, pole.name, pole.kind) = (POLE.into(), POLE.into(), VarKind::Param);
    let unit = Unit::parse("1/s").expect("it is known");
    (pole.unit, pole.shown, pole.unreadable) = (Some((unit, place)), None, false);
    (pole.range, pole.range_span, pole.doc) = (VarRange::default(), None, None);
    pole.definition = Definition::Value(zero, Origin::Default);
    let id = VarId(system.vars.len() as u32);
    system.vars.push(pole);
    for (x, recorded) in all {
        let of_rate = match system.var(x).definition {
            Definition::Continuous { rate, .. } => state(system, rate),
            _ => unreachable!("it is a continuous state"),
        };
        let read = system.push(Node::Var(x), place);
        let error = system.push(Node::Binary(BinaryOp::Subtract, recorded, read), place);
        let p = system.push(Node::Var(id), place);
        let once = system.push(Node::Binary(BinaryOp::Multiply, p, error), place);
        let twice = system.push(Node::Binary(BinaryOp::Add, once, once), place);
        add(system, x, twice);
        if let Some(v) = of_rate.filter(|v| *v != x) {
            let square = system.push(Node::Binary(BinaryOp::Multiply, p, once), place);
            add(system, v, square);
        }
    }
    true
}

/// The continuous state that an expression is, also by another name.
fn state(system: &System, mut expr: ExprId) -> Option<VarId> {
    loop {
        let Node::Var(var) = system.node(expr) else { return None };
        match system.var(*var).definition {
            Definition::Continuous { path: None, .. } => return Some(*var),
            Definition::Value(value, _) if system.var(*var).kind != VarKind::Param => expr = value,
            _ => return None,
        }
    }
}

fn add(system: &mut System, state: VarId, correction: ExprId) {
    let Definition::Continuous { rate, .. } = system.var(state).definition else { unreachable!("it is a state") };
    let place = system.span(rate);
    let sum = system.push(Node::Binary(BinaryOp::Add, rate, correction), place);
    if let Definition::Continuous { rate, .. } = &mut system.vars[state.0 as usize].definition {
        *rate = sum;
    }
}
