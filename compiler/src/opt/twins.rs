//! Twins: values at the end of a step that are the same expression of the new states as a value at its begin is of the
//! old ones, such as an output that also enters the derivatives.
//!
//! In: a step function. Out: for each value its twin at the begin, and the way to compute it as that twin was rewritten.
//! A pass that decides by readiness or by the number of uses would group the two differently. They would then be
//! different numbers by rounding, and predictive commoning could not carry the one to the next step in place of the other.

use crate::ir::build::Build;
use crate::ir::hash::HashMap;
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// The twins of a function, for a pass that rebuilds it value by value.
#[derive(Clone)]
pub(super) struct Twins {
    /// For each value its twin at the begin of the step.
    at_begin: Vec<Option<Value>>,
    /// What the step stores.
    stored: HashMap<Slot, Value>,
    /// For values of the new function the same expression at the end of the step.
    at_end: HashMap<Value, Value>,
}

impl Twins {
    /// Finds them.
    pub(super) fn of(func: &Func) -> Twins {
        let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
        let mut at_begin = vec![None; func.ops.len()];
        let known: HashMap<Op, Value> =
            (0..).map(Value).zip(&func.ops).map(|(value, op)| (op.ordered(), value)).collect();
        let mut next: Vec<Option<Value>> = Vec::with_capacity(func.ops.len());
        for (value, op) in (0..).map(Value).zip(&func.ops) {
            let becomes = match op {
                Op::Load(slot) => Some(stored.get(slot).copied().unwrap_or(value)),
                // What it reads next depends on what is written.
                Op::Ring { .. } => None,
                op => {
                    let mut is_known = true;
                    let moved = op.map(|operand| {
                        is_known &= next[operand.index()].is_some();
                        next[operand.index()].unwrap_or(operand)
                    });
                    known.get(&moved.ordered()).copied().filter(|_| is_known)
                }
            };
            next.push(becomes);
            if let Some(end) = becomes.filter(|end| *end > value && !matches!(op, Op::Load(_))) {
                at_begin[end.index()].get_or_insert(value);
            }
        }
        Twins { at_begin, stored, at_end: HashMap::default() }
    }

    /// The next value of the function as its twin was rewritten; none if it has no twin. `values`: for each value of the
    /// function so far, its value in the builder.
    pub(super) fn copy(&mut self, values: &[Value], build: &mut Build) -> Option<Value> {
        let twin = values[self.at_begin[values.len()]?.index()];
        let mut open = vec![twin];
        while let Some(value) = open.last().copied() {
            let op = build.get(value);
            let mut waits = false;
            op.each_operand(|operand| {
                if !self.at_end.contains_key(&operand) {
                    (waits, _) = (true, open.push(operand));
                }
            });
            if waits {
                continue;
            }
            let end = match op {
                Op::Ring { .. } => return None,
                Op::Load(slot) => match self.stored.get(&slot) {
                    Some(stored) => *values.get(stored.index())?,
                    None => value,
                },
                op => build.op(op.map(|operand| self.at_end[&operand])),
            };
            self.at_end.insert(value, end);
            open.pop();
        }
        self.at_end.get(&twin).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Unary;
    use crate::opt::{contract::contract, reassociate::reassociate};
    use abi::Layout;

    /// A product at the end of a step with the same operations on the new states as at the begin on the old ones: it has
    /// a twin, and is computed as that.
    ///
    /// Mutants tried by hand, each fails: reassociation, or contraction, takes no twins.
    #[test]
    fn the_end_of_a_step_is_grouped_as_its_begin() {
        let layout = Layout::new([3, 0, 2, 0, 0, 1, 0, 0, 0, 0]);
        let [p, q, m] = [0, 1, 2].map(|k| layout.params.slot(k));
        let [x, y] = [0, 1].map(|k| layout.states.slot(k));
        let output = layout.outputs.slot(0);
        let mut build = Build::new("step");
        let [p, q, m] = [p, q, m].map(|slot| build.load(slot));
        let old = [x, y].map(|slot| build.load(slot));
        // exp(p x + q) (x / m) y. The quotient is by an invariant; at the begin p x is read twice, at the end once.
        let force = |build: &mut Build, [x, y]: [Value; 2]| {
            let early = build.mul(p, x);
            let exponent = build.add(early, q);
            let exponential = build.op(Op::Unary(Unary::Exp, exponent));
            let ratio = build.op(Op::Div(x, m));
            let product = build.mul(exponential, ratio);
            (build.mul(product, y), early)
        };
        let (at_begin, early) = force(&mut build, old);
        let bounded = build.op(Op::Unary(Unary::Tanh, at_begin));
        let step = build.real(1e-3);
        let (change, half) = (build.mul(step, bounded), build.mul(step, early));
        let new = [build.add(old[0], change), build.sub(old[1], half)];
        let (at_end, _) = force(&mut build, new);
        [x, y].into_iter().zip(new).for_each(|(slot, value)| build.store(slot, value));
        build.store(output, at_end);
        let func = contract(&reassociate(&build.finish(), false), &layout);
        let stored = |slot| func.stores.iter().find(|(there, _)| *there == slot).expect("it is stored").1;
        let mut twins = Twins::of(&func);
        assert!(twins.at_begin[stored(output).index()].is_some(), "{func}");
        let identity: Vec<Value> = (0..func.ops.len() as u32).map(Value).collect();
        let mut again = Build::of(&func);
        let before = again.len();
        let found = twins.copy(&identity[..stored(output).index()], &mut again);
        assert_eq!((found, again.len()), (Some(stored(output)), before), "{func}");
    }
}
