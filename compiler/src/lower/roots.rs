//! Root functions: expressions whose change of sign is an event that the solver locates.

use super::Plan;
use super::emit::Emit;
use crate::frontend::causality::{Phase, rate_of, value_of};
use crate::frontend::system::*;
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Func, Unary, Value};
use abi::description::{Root, Slot};
use grammar::ast::BinaryOp;

impl Plan<'_> {
    /// Switching surfaces: functions of the state that change their sign where a branch in the rates or in the observed
    /// expressions changes, or where a transition or event occurs.
    pub(super) fn roots(&self, mut emit: Emit) -> (Func, Vec<Root>) {
        // Conditions first: a surface that a branch shares with a condition counts as the condition's.
        let mut from: Vec<ExprId> = Vec::new();
        for automaton in &self.system.automata {
            from.extend(automaton.regimes.iter().flat_map(|regime| &regime.transitions).map(|t| t.condition));
        }
        from.extend(self.system.events.iter().map(|event| event.condition));
        let deciding = self.comparisons(&from);
        for id in &self.states {
            if let Definition::Continuous { rate, .. } = self.system.var(*id).definition {
                from.push(rate);
            }
        }
        let mut seen = vec![false; self.system.nodes.len()];
        let mut stack = from;
        stack.reverse();
        // The flag says that derivatives are continuous there and only have a kink.
        let mut surfaces: Vec<(Value, ExprId, bool)> = Vec::new();
        let mut known: HashMap<Value, usize> = HashMap::default();
        let mut moving: HashMap<Value, bool> = HashMap::default();
        // Observed quantities come last, because their surfaces must not affect the course of a run.
        let mut own = None;
        loop {
            let Some(id) = stack.pop() else {
                if own.is_some() {
                    break;
                }
                own = Some(surfaces.len());
                stack.extend(self.wanted.iter().rev());
                continue;
            };
            if std::mem::replace(&mut seen[id.0 as usize], true) {
                continue;
            }
            let node = self.system.node(id);
            let mut operands: Vec<ExprId> = node.operands().collect();
            operands.extend(rate_of(self.system, node));
            match node {
                Node::Var(var) => operands.extend(value_of(self.system.var(*var), Phase::Now)),
                Node::Crossing(crossing) => operands.push(self.system.crossings[*crossing as usize].difference),
                _ => {}
            }
            stack.extend(operands.into_iter().rev());
            let bends = matches!(node, Node::Call(Builtin::Abs | Builtin::Min | Builtin::Max | Builtin::Clamp, _));
            let mut add = |emit: &mut Emit, value: Value| {
                if !emit.moves(value, &mut moving) {
                    return;
                }
                let place = *known.entry(value).or_insert(surfaces.len());
                match surfaces.get_mut(place) {
                    // A branch in an observed quantity does not affect the derivatives.
                    Some(surface) => surface.2 &= bends || own.is_some_and(|own| place < own),
                    None => surfaces.push((value, id, bends)),
                }
            };
            match node {
                Node::Binary(
                    BinaryOp::Less | BinaryOp::LessEqual | BinaryOp::Greater | BinaryOp::GreaterEqual,
                    a,
                    b,
                ) => {
                    let (a, b) = (emit.value(*a), emit.value(*b));
                    let surface = emit.build.sub(a, b);
                    add(&mut emit, surface);
                }
                Node::Crossing(crossing) => {
                    let surface = emit.value(self.system.crossings[*crossing as usize].difference);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Abs | Builtin::Sign, args) => {
                    let surface = emit.value(args[0]);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Min | Builtin::Max, args) => {
                    let (a, b) = (emit.value(args[0]), emit.value(args[1]));
                    let surface = emit.build.sub(a, b);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Clamp, args) => {
                    let x = emit.value(args[0]);
                    for bound in &args[1..] {
                        let bound = emit.value(*bound);
                        let surface = emit.build.sub(x, bound);
                        add(&mut emit, surface);
                    }
                }
                Node::Call(Builtin::Square, args) => {
                    // The sign changes with that of the sine of its phase.
                    let frequency = emit.value(args[1]);
                    let (time, turn) = (emit.build.load(Slot::TIME), emit.build.real(2.0 * std::f64::consts::PI));
                    let phase = emit.build.mul(turn, frequency);
                    let phase = emit.build.mul(phase, time);
                    let surface = emit.build.unary(Unary::Sin, phase);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Noise, args) => {
                    let period = emit.value(args[1]);
                    let (time, half) = (emit.build.load(Slot::TIME), emit.build.real(std::f64::consts::PI));
                    let phase = emit.build.mul(half, time);
                    let phase = emit.build.div(phase, period);
                    let surface = emit.build.unary(Unary::Sin, phase);
                    add(&mut emit, surface);
                }
                _ => {}
            }
        }
        let segment =
            abi::description::Segment { start: self.description.layout.roots.start, len: surfaces.len() as u32 };
        let mut roots = Vec::new();
        for (k, (value, id, bends)) in surfaces.iter().enumerate() {
            emit.build.store(segment.slot(k), *value);
            let observed = own.is_some_and(|own| k >= own);
            let (text, decides) = (self.root_text(*id), deciding.contains(id));
            roots.push(Root { text, decides, bends: *bends, observed });
        }
        (emit.build.finish(), roots)
    }

    /// The comparisons and crossings of which conditions consist.
    fn comparisons(&self, conditions: &[ExprId]) -> HashSet<ExprId> {
        let mut out = HashSet::default();
        let mut stack = conditions.to_vec();
        while let Some(id) = stack.pop() {
            match self.system.node(id) {
                Node::Binary(BinaryOp::And | BinaryOp::Or, a, b) => stack.extend([*a, *b]),
                Node::Not(a) => stack.push(*a),
                _ => {
                    out.insert(id);
                }
            }
        }
        out
    }

    /// A short name of a surface, from which the caller can find the text.
    fn root_text(&self, id: ExprId) -> String {
        let span = self.system.span(id);
        format!("{}:{}..{}", span.file.0, span.start, span.end)
    }
}
