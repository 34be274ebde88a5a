//! What is left of operations where the values of some are known.

use super::build::Build;
use super::{Op, Value};
use std::collections::{HashMap, HashSet};

/// What is known of other truths where one is true or false.
pub fn known(build: &mut Build, asked: Value, truth: bool) -> Vec<(Value, Value)> {
    let is = [false, true].map(|truth| build.truth(truth));
    let mut known = Vec::new();
    let mut open = vec![(asked, truth)];
    while let Some((value, truth)) = open.pop() {
        known.push((value, is[usize::from(truth)]));
        match (build.get(value), truth) {
            (Op::And(a, b), true) | (Op::Or(a, b), false) => open.extend([(a, truth), (b, truth)]),
            (Op::Not(a), truth) => open.push((a, !truth)),
            (comparison, truth) => {
                for (op, truth) in implied(comparison, truth) {
                    let value = build.op(op);
                    if !is.contains(&value) {
                        known.push((value, is[usize::from(truth)]));
                    }
                }
            }
        }
    }
    known
}

/// What a comparison of two reals tells of others of the same two; where it is false, one of them may be no number.
fn implied(comparison: Op, truth: bool) -> Vec<(Op, bool)> {
    match (comparison, truth) {
        (Op::Less(a, b), true) => vec![
            (Op::LessEqual(a, b), true),
            (Op::Less(b, a), false),
            (Op::LessEqual(b, a), false),
            (Op::Equal(a, b), false),
            (Op::Equal(b, a), false),
        ],
        (Op::LessEqual(a, b), true) => vec![(Op::Less(b, a), false)],
        (Op::LessEqual(a, b), false) => {
            vec![(Op::Less(a, b), false), (Op::Equal(a, b), false), (Op::Equal(b, a), false)]
        }
        (Op::Equal(a, b), true) => vec![
            (Op::LessEqual(a, b), true),
            (Op::LessEqual(b, a), true),
            (Op::Less(a, b), false),
            (Op::Less(b, a), false),
        ],
        _ => Vec::new(),
    }
}

/// What is left of outputs of a list, of which some values are others.
pub fn partial_eval(build: &mut Build, list: &[Value], known: &[(Value, Value)], outputs: &[Value]) -> Vec<Value> {
    let mut left: HashMap<Value, Value> = known.iter().copied().collect();
    for value in list {
        let op = build.get(*value);
        let now = op.map(|operand| left.get(&operand).copied().unwrap_or(operand));
        if now != op && !left.contains_key(value) {
            left.insert(*value, build.op(now));
        }
    }
    outputs.iter().map(|output| left.get(output).copied().unwrap_or(*output)).collect()
}

/// What some values need that is not there, in order.
pub fn slice(build: &Build, there: &HashSet<Value>, of: &[Value]) -> Vec<Value> {
    let mut list = HashSet::new();
    let mut open = of.to_vec();
    while let Some(value) = open.pop() {
        let op = build.get(value);
        if !there.contains(&value) && !op.is_constant() && list.insert(value) {
            op.each_operand(|operand| open.push(operand));
        }
    }
    let mut list: Vec<Value> = list.into_iter().collect();
    list.sort_unstable();
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::eval::evaluate;
    use abi::Slot;

    #[test]
    fn what_a_comparison_tells_of_others_is_so() {
        let numbers = [f64::NEG_INFINITY, -1.0, -0.0, 0.0, 1.0, f64::INFINITY, f64::NAN];
        let comparisons = [Op::Less, Op::LessEqual, Op::Equal].map(|of| of(Value(0), Value(1)));
        for (a, b) in numbers.into_iter().flat_map(|a| numbers.map(|b| (a, b))) {
            let holds = |op: Op| evaluate(op, |value| [a, b][value.index()].to_bits()) == Some(1);
            for asked in comparisons {
                for (op, truth) in implied(asked, holds(asked)) {
                    assert_eq!(holds(op), truth, "{a}, {b}: {op:?} where {asked:?} is {}", holds(asked));
                }
            }
        }
    }

    #[test]
    fn what_is_known_is_not_asked_again() {
        let mut build = Build::new("f");
        let [x, y] = [3, 4].map(|slot| build.load(Slot(slot)));
        let (less, more) = (build.less(x, y), build.less(y, x));
        let other = build.select(more, y, x);
        let chosen = build.select(less, x, other);
        let list = slice(&build, &HashSet::new(), &[chosen]);
        assert_eq!(list.len(), 6);
        let true_side = known(&mut build, less, true);
        assert_eq!(partial_eval(&mut build, &list, &true_side, &[chosen, other]), [x, x]);
        let false_side = known(&mut build, less, false);
        assert_eq!(partial_eval(&mut build, &list, &false_side, &[chosen]), [other]);
    }
}
