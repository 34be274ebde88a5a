//! Guard reduction: removes redundant addends from the sum with which a step tests its guarded values for finiteness.
//!
//! In: a step function whose status is selected by one condition. Out: the same function, in which that condition needs
//! fewer additions. Guards fail, among other reasons, if their value is infinite or NaN. One test covers all of them: the
//! sum of the values is then infinite or NaN too. A value leaves the sum if its finiteness follows from that of another
//! addend.
//!
//! The condition may also hold if no guard has failed, because a sum of finite values may overflow. That is harmless:
//! the status itself comes from exact tests of each value, and they are evaluated when the condition holds.
//!
//! The method is ours; it is a case of redundant check elimination (Gupta, *Optimizing Array Bound Checks Using Flow
//! Analysis*, 1993).

use crate::ir::build::{Build, prune};
use crate::ir::hash::HashSet;
use crate::ir::partial_eval::{partial_eval, slice};
use crate::ir::{Func, Op, Value};

/// Rebuilds a step function so that its finiteness test has as few addends as possible.
pub fn reduce_guards(func: &Func) -> Func {
    let (Some(status), Some((when, ..))) = (func.status, func.failure()) else { return func.clone() };
    let Op::Select(_, yes, no) = func.op(status) else {
        unreachable!("`failure` returned the condition of this select")
    };
    let stored: Vec<Value> = func.stores.iter().map(|(_, value)| *value).collect();
    let mut build = Build::of(func);
    let fewer = with_fewer_addends(&mut build, when, &stored);
    let status = build.select(fewer, yes, no);
    prune(&Func { ops: build.into_ops(), status: Some(status), ..func.clone() })
}

/// Returns the condition `failed` with a smaller sum in its finiteness test: without the addends whose finiteness
/// follows from another addend. `stored`: values that the step stores; such a value is not split into its own addends.
pub fn with_fewer_addends(build: &mut Build, failed: Value, stored: &[Value]) -> Value {
    let list = slice(build, &HashSet::default(), &[failed]);
    let finiteness_test = |value: &Value| match build.get(*value) {
        Op::LessEqual(a, b) if a == b => match build.get(a) {
            Op::Sub(a, b) if a == b => Some((*value, a)),
            _ => None,
        },
        _ => None,
    };
    // The test is d ≤ d with d = sum − sum: d is 0 for a finite sum, and NaN otherwise.
    let Some((test, sum)) = list.iter().find_map(finiteness_test) else { return failed };
    let (mut addends, mut open) = (Vec::new(), vec![sum]);
    let (mut seen, stored) = (HashSet::default(), HashSet::<Value>::from_iter(stored.iter().copied()));
    while let Some(value) = open.pop() {
        match build.get(value) {
            Op::Add(a, b) if !stored.contains(&value) => open.extend([b, a]),
            _ if seen.insert(value) => addends.push(value),
            _ => {}
        }
    }
    let implied = implied_finite(build, &addends);
    addends.retain(|value| !implied.contains(value));
    let sum = addends
        .into_iter()
        .reduce(|sum, value| build.add(sum, value))
        .expect("an addend that implies the others remains");
    let difference = build.sub(sum, sum);
    let finite = build.less_equal(difference, difference);
    partial_eval(build, &list, &[(test, finite)], &[failed])[0]
}

/// The values that must be finite if all of `by` are: every operand of a sum or product, and the dividend of a
/// quotient.
fn implied_finite(build: &Build, by: &[Value]) -> HashSet<Value> {
    let (mut implied, mut open) = (HashSet::default(), by.to_vec());
    while let Some(value) = open.pop() {
        let op = build.get(value);
        let mut imply = |operand: Value| {
            if implied.insert(operand) {
                open.push(operand);
            }
        };
        match op {
            Op::Add(..) | Op::Sub(..) | Op::Mul(..) | Op::Fma(..) | Op::Neg(_) | Op::Abs(_) | Op::Sqrt(_) => {
                op.each_operand(imply);
            }
            Op::Div(dividend, _) => imply(dividend),
            _ => {}
        }
    }
    implied
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::Interpreter;
    use crate::ir::parse::parse;
    use abi::table::Interpret;
    use abi::{Function, Layout, Slot};

    #[test]
    fn every_failure_is_still_found() {
        let layout = Layout::new([1, 1, 2, 0, 0, 1, 0, 0, 0, 0]);
        let file = include_str!("../../../tests/ir/guard_reduction_implied.ir");
        let func = parse(file.split("\n---\n").next().expect("the input")).expect("a listing");
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
