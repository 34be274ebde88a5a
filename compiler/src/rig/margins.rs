//! Guards for ranges that depend on parameters, by means of margins.
//!
//! In: the control system of a rig. Out: for each bound that depends on a parameter, an expression that is non-negative
//! within the range, and a guard on it that replaces the guard with the bound of the start. A range thus follows a
//! parameter that is set while the rig runs, without a change to the code of a step.

use super::live::reached;
use crate::frontend::system::*;
use crate::ir::program::Program;
use crate::lower::Observed;
use abi::Slot;
use abi::description::Guard;
use abi::unit::{Angle, Dimension};
use grammar::ast::BinaryOp;

/// The margin of a quantity to one end of its range.
#[derive(Clone)]
pub struct Margin {
    /// Path of the quantity: `fr.z`.
    path: String,
    /// Whether it is the upper end.
    high: bool,
    /// Distance from that end, plus the tolerance of guards.
    pub room: ExprId,
}

impl Margin {
    /// The expression to lower, with its name for messages.
    pub fn wanted(&self) -> Observed {
        let end = if self.high { "upper" } else { "lower" };
        let text = format!("distance of {} from its {end} bound", self.path);
        Observed { expr: self.room, text, unit: None }
    }
}

/// Margins of those quantities of a control system for which `watched` is true.
pub fn of(system: &mut System, watched: impl Fn(VarId) -> bool) -> Vec<Margin> {
    let moves = |system: &System, bound: ExprId| {
        let reached = reached(system, &[bound]);
        system.var_ids().any(|id| reached[id.0 as usize] && system.var(id).kind == VarKind::Param)
    };
    let mut margins = Vec::new();
    for id in system.var_ids().filter(|id| watched(*id)).collect::<Vec<_>>() {
        let var = system.var(id);
        let (path, low, high) = (var.path.clone(), var.range.low, var.range.high);
        if var.kind == VarKind::Param {
            continue;
        }
        for (bound, other, high) in [(low, high, false), (high, low, true)] {
            let Some((bound, _)) = bound.filter(|(bound, _)| moves(system, *bound)) else { continue };
            let span = system.span(bound);
            let mut push = |node: Node| system.push(node, span);
            // The tolerance of guards: 1e-6 of the width, or of the bound if the range is open on the other side.
            let size = match other {
                Some((other, _)) => push(Node::Binary(BinaryOp::Subtract, bound, other)),
                None => bound,
            };
            let size = push(Node::Call(Builtin::Abs, [size].into()));
            let share = push(Node::Number { value: 1e-6, dimension: Some(Dimension::NONE), angle: Angle::Silent });
            let slack = push(Node::Binary(BinaryOp::Multiply, share, size));
            let x = push(Node::Var(id));
            let (above, below) = if high { (bound, x) } else { (x, bound) };
            let room = push(Node::Binary(BinaryOp::Subtract, above, below));
            let room = push(Node::Binary(BinaryOp::Add, room, slack));
            margins.push(Margin { path: path.clone(), high, room });
        }
    }
    margins
}

/// Replaces guards on bounds by guards on the margins in these slots. Has no effect on quantities without a guard.
pub fn watch(margins: &[Margin], slots: &[Slot], program: &mut Program) {
    let description = &mut program.description;
    for (margin, slot) in margins.iter().zip(slots) {
        let Some(guard) = description.guards.iter_mut().find(|guard| guard.path == margin.path) else { continue };
        *(if margin.high { &mut guard.range.1 } else { &mut guard.range.0 }) =
            if margin.high { f64::INFINITY } else { f64::NEG_INFINITY };
        let unit = guard.unit.clone();
        description.guards.push(Guard { path: margin.wanted().text, slot: *slot, range: (0.0, f64::INFINITY), unit });
    }
}
