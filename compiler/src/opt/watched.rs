//! Takes numbers out of the sum by which a step tells whether what it watches is finite.
//!
//! In: a step whose status hangs on one truth. Out: the same with fewer additions for that truth. It may then hold where nothing
//! has failed, as a sum may overflow: the status tells.

use crate::ir::build::{Build, prune};
use crate::ir::left::{left, needed};
use crate::ir::{Func, Op, Value};
use std::collections::HashSet;

/// The same step, which asks of a sum of the fewest numbers whether it is finite.
pub fn watched(func: &Func) -> Func {
    let (Some(status), Some((when, ..))) = (func.status, func.failure()) else { return func.clone() };
    let Op::Select(_, yes, no) = func.op(status) else { unreachable!("it hangs on a truth") };
    let stored: Vec<Value> = func.stores.iter().map(|(_, value)| *value).collect();
    let mut build = Build::of(func);
    let fewer = with_fewer(&mut build, when, &stored);
    let status = build.select(fewer, yes, no);
    prune(&Func { ops: build.into_ops(), status: Some(status), ..func.clone() })
}

/// A truth that a step has failed with, with fewer numbers in the sum that is asked whether it is finite: none that shows in
/// another one. What is stored is a number of its own in it.
pub fn with_fewer(build: &mut Build, failed: Value, stored: &[Value]) -> Value {
    let list = needed(build, &HashSet::new(), &[failed]);
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
    let shown = shown(build, &watched);
    watched.retain(|value| !shown.contains(value));
    let sum = watched.into_iter().reduce(|sum, value| build.add(sum, value)).expect("what shows the others is left");
    let rest = build.sub(sum, sum);
    let finite = build.less_equal(rest, rest);
    left(build, &list, &[(asked, finite)], &[failed])[0]
}

/// A number and a bound.
struct Bound {
    x: Value,
    limit: Value,
    /// On which side.
    below: bool,
    /// Whether it is found out here if the number is NaN; else the sum tells.
    tells_nan: bool,
}

/// A truth that a step has failed with, which asks less: of what is not to be below the same bound the least, or above it the
/// greatest, and with one of these whether the sum is finite. Less itself that is 0, or else NaN, which is in no order.
pub fn with_less_asked(build: &mut Build, failed: Value) -> Value {
    let (mut bounds, mut rest, mut others, mut open): (Vec<Bound>, _, _, _) =
        (Vec::new(), None, Vec::new(), vec![failed]);
    while let Some(value) = open.pop() {
        let constant = |value: Value| build.get(value).is_constant();
        let (x, limit, below, tells_nan) = match build.get(value) {
            Op::Or(a, b) => {
                open.extend([b, a]);
                continue;
            }
            Op::Less(x, limit) if constant(limit) => (x, limit, true, false),
            Op::Less(limit, x) if constant(limit) => (x, limit, false, false),
            Op::Not(within) => match build.get(within) {
                Op::LessEqual(a, b) if a == b && rest.is_none() => {
                    rest = Some(a);
                    continue;
                }
                Op::LessEqual(limit, x) if constant(limit) => (x, limit, true, true),
                Op::LessEqual(x, limit) if constant(limit) => (x, limit, false, true),
                _ => {
                    others.push(value);
                    continue;
                }
            },
            _ => {
                others.push(value);
                continue;
            }
        };
        let same = |bound: &&mut Bound| (bound.limit, bound.below) == (limit, below) && !bound.tells_nan && !tells_nan;
        match bounds.iter_mut().find(same) {
            Some(bound) if below => bound.x = build.min(bound.x, x),
            Some(bound) => bound.x = build.max(bound.x, x),
            None => bounds.push(Bound { x, limit, below, tells_nan }),
        }
    }
    match (bounds.first_mut(), rest) {
        (Some(bound), Some(rest)) => bound.x = build.add(bound.x, rest),
        (None, Some(rest)) => {
            let finite = build.less_equal(rest, rest);
            others.push(build.not(finite));
        }
        _ => {}
    }
    for Bound { x, limit, below, .. } in bounds {
        let within = if below { build.less_equal(limit, x) } else { build.less_equal(x, limit) };
        others.push(build.not(within));
    }
    others.into_iter().reduce(|any, other| build.or(any, other)).unwrap_or(failed)
}

/// What is finite wherever these are: of a sum and a product all that enters.
fn shown(build: &Build, by: &[Value]) -> HashSet<Value> {
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
    use crate::backend::interp::Interpreter;
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
        let fewer = watched(&func);
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
        let fewer = watched(&func);
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

    #[test]
    fn what_is_asked_together_fails_where_each_did() {
        // x and y not below 0, |z| at most 2, y not above 3, and the sum of x and y finite.
        let mut build = Build::new("step");
        let [x, y, z] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let [zero, two, three] = [0.0, 2.0, 3.0].map(|number| build.real(number));
        let (size, sum) = (build.abs(z), build.add(x, y));
        let rest = build.sub(sum, sum);
        let within = [build.less_equal(size, two), build.less_equal(rest, rest)].map(|within| build.not(within));
        let outside = [build.less(x, zero), build.less(y, zero), build.less(three, y)];
        let any = outside.into_iter().chain(within).reduce(|any, one| build.or(any, one)).expect("five");
        let less = with_less_asked(&mut build, any);
        let list = needed(&build, &HashSet::new(), &[less]);
        let asked = list.iter().filter(|value| matches!(build.get(**value), Op::LessEqual(..))).count();
        assert_eq!(asked, 3, "of five");
        let [one, none] = [1.0, 0.0].map(|number| build.real(number));
        for (slot, truth) in [(6, any), (7, less)] {
            let told = build.select(truth, one, none);
            build.store(Slot(slot), told);
        }
        let func = build.finish();
        let numbers = [0.0, -0.0, 1.0, -1.0, 2.0, 3.5, 1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
        let mut failed = 0;
        for case in 0..numbers.len().pow(3) {
            let [x, y, z] = [1, 10, 100].map(|place| numbers[case / place % numbers.len()]);
            let mut block = [0.0, 0.0, 0.0, x, y, z, 0.0, 0.0];
            crate::backend::interp::run_once(&func, &mut block, &[]);
            assert_eq!(block[6], block[7], "{x}, {y}, {z}");
            failed += usize::from(block[7] != 0.0);
        }
        assert!(failed > 700 && failed < 990, "{failed}");
    }
}
