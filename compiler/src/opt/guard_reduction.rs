//! Takes numbers out of the sum by which a step tells whether what it watches is finite.
//!
//! In: a step whose status hangs on one truth. Out: the same with fewer additions for that truth. It may then hold where nothing
//! has failed, as a sum may overflow: the status tells.

use crate::ir::build::{Build, prune};
use crate::ir::partial_eval::{partial_eval, slice};
use crate::ir::{Func, Op, Value};
use std::collections::HashSet;

/// The same step, which asks of a sum of the fewest numbers whether it is finite.
pub fn reduce_guards(func: &Func) -> Func {
    let (Some(status), Some((when, ..))) = (func.status, func.failure()) else { return func.clone() };
    let Op::Select(_, yes, no) = func.op(status) else { unreachable!("it hangs on a truth") };
    let stored: Vec<Value> = func.stores.iter().map(|(_, value)| *value).collect();
    let mut build = Build::of(func);
    let fewer = with_fewer_addends(&mut build, when, &stored);
    let status = build.select(fewer, yes, no);
    prune(&Func { ops: build.into_ops(), status: Some(status), ..func.clone() })
}

/// A truth that a step has failed with, with fewer numbers in the sum that is asked whether it is finite: none that shows in
/// another one. What is stored is a number of its own in it.
pub fn with_fewer_addends(build: &mut Build, failed: Value, stored: &[Value]) -> Value {
    let list = slice(build, &HashSet::new(), &[failed]);
    let sum_asked = |value: &Value| match build.get(*value) {
        Op::LessEqual(a, b) if a == b => match build.get(a) {
            Op::Sub(a, b) if a == b => Some((*value, a)),
            _ => None,
        },
        _ => None,
    };
    let Some((asked, sum)) = list.iter().find_map(sum_asked) else { return failed };
    let (mut watched, mut open) = (Vec::new(), vec![sum]);
    while let Some(value) = open.pop() {
        match build.get(value) {
            Op::Add(a, b) if !stored.contains(&value) => open.extend([b, a]),
            _ if !watched.contains(&value) => watched.push(value),
            _ => {}
        }
    }
    let shown = implied_finite(build, &watched);
    watched.retain(|value| !shown.contains(value));
    let sum = watched.into_iter().reduce(|sum, value| build.add(sum, value)).expect("what shows the others is left");
    let rest = build.sub(sum, sum);
    let finite = build.less_equal(rest, rest);
    partial_eval(build, &list, &[(asked, finite)], &[failed])[0]
}

/// What is finite wherever these are: of a sum and a product all that enters.
fn implied_finite(build: &Build, by: &[Value]) -> HashSet<Value> {
    let (mut shown, mut open) = (HashSet::new(), by.to_vec());
    while let Some(value) = open.pop() {
        let op = build.get(value);
        let mut enters = |operand: Value| {
            if shown.insert(operand) {
                open.push(operand);
            }
        };
        match op {
            Op::Add(..) | Op::Sub(..) | Op::Mul(..) | Op::Fma(..) | Op::Neg(_) | Op::Abs(_) | Op::Sqrt(_) => {
                op.each_operand(enters);
            }
            Op::Div(over, _) => enters(over),
            _ => {}
        }
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::Interpreter;
    use abi::table::Interpret;
    use abi::{Function, Layout, Slot};

    /// A step with two states, the first of which enters the output, all of them watched, and the layout.
    fn step() -> (Func, Layout) {
        let layout = Layout::new([1, 1, 2, 0, 0, 1, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let [k, u, x, z] = [layout.params, layout.inputs, layout.states, layout.states];
        let [k, u, x, z] = [k.slot(0), u.slot(0), x.slot(0), z.slot(1)].map(|slot| build.load(slot));
        let next = build.fma(k, u, x);
        let negative = build.neg(next);
        let scaled = build.div(negative, k);
        let force = build.sub(scaled, u);
        let sums = build.add(next, z);
        let sum = build.add(force, sums);
        let rest = build.sub(sum, sum);
        let fine = build.less_equal(rest, rest);
        let failed = build.not(fine);
        let [zero, one] = [0, 1].map(|n| build.int(n));
        let status = build.select(failed, one, zero);
        build.store(layout.states.slot(0), next);
        build.store(layout.outputs.slot(0), force);
        build.status(status);
        (build.finish(), layout)
    }

    #[test]
    fn what_shows_in_another_number_does_not_enter_the_sum() {
        let (func, _) = step();
        let sums = |func: &Func| func.ops.iter().filter(|op| matches!(op, Op::Add(..))).count();
        let fewer = reduce_guards(&func);
        assert_eq!((sums(&func), sums(&fewer)), (2, 1), "{fewer}");
    }

    #[test]
    fn what_failed_fails_still() {
        let (func, layout) = step();
        let numbers = [0.0, -0.0, 1.0, -3.5, 1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
        let status = |func: &Func, block: &[f64]| {
            let interpreter = Interpreter::new(&[(Function::Step, func.clone())], &layout, 0);
            let mut block = block.to_vec();
            (interpreter.call(Function::Step, &mut block, &[], 1), block)
        };
        let fewer = reduce_guards(&func);
        let mut failed = 0;
        for case in 0..numbers.len().pow(4) {
            let mut block = vec![0.0; layout.size()];
            let slots = [layout.params.slot(0), layout.inputs.slot(0), layout.states.slot(0), layout.states.slot(1)];
            for (k, slot) in slots.into_iter().enumerate() {
                block[slot.index()] = numbers[case / numbers.len().pow(k as u32) % numbers.len()];
            }
            let (found, after) = status(&fewer, &block);
            let finite = |slot: Slot| after[slot.index()].is_finite();
            let all = [layout.states.slot(0), layout.states.slot(1), layout.outputs.slot(0)].into_iter().all(finite);
            assert!(found == 1 || all, "{block:?} leads to {after:?}");
            failed += found;
        }
        assert!(failed > 1000 && failed < 4096, "{failed}");
    }
}
