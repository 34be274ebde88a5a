//! Partial evaluation: the residual operations when some values are known, and backward slices.
//!
//! In: operations of a builder, and values that are known to be equal to others. Out: the residual values, added to the
//! same builder. The operations are a straight line, so one walk in order suffices.
//!
//! Sources: Jones, Gomard, Sestoft, *Partial Evaluation and Automatic Program Generation*, 1993; Weiser, *Program
//! Slicing*, 1984.

use super::build::Build;
use super::{Op, Value};
use crate::ir::hash::{HashMap, HashSet};

/// The values that are known if a condition is known to be `truth`, each with its constant: the condition, its parts,
/// and comparisons that follow from it.
pub fn known(build: &mut Build, condition: Value, truth: bool) -> Vec<(Value, Value)> {
    let is = [false, true].map(|truth| build.truth(truth));
    let mut known = Vec::new();
    let mut open = vec![(condition, truth)];
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

/// The comparisons of the same two reals whose results follow if `comparison` has the result `truth`. A false
/// comparison may have a NaN operand, so fewer results follow.
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

/// Returns the residual values of `outputs`. `list`: the operations to evaluate, in order. `known`: values and their
/// replacements.
pub fn partial_eval(build: &mut Build, list: &[Value], known: &[(Value, Value)], outputs: &[Value]) -> Vec<Value> {
    let mut residual: HashMap<Value, Value> = known.iter().copied().collect();
    for value in list {
        let op = build.get(*value);
        let now = op.map(|operand| residual.get(&operand).copied().unwrap_or(operand));
        if now != op && !residual.contains_key(value) {
            residual.insert(*value, build.op(now));
        }
    }
    outputs.iter().map(|output| residual.get(output).copied().unwrap_or(*output)).collect()
}

/// The backward slice of `roots`: the operations that these values need, in order, without constants and without the
/// values in `available` and what only those need.
pub fn slice(build: &Build, available: &HashSet<Value>, roots: &[Value]) -> Vec<Value> {
    let mut list = HashSet::default();
    let mut open = roots.to_vec();
    while let Some(value) = open.pop() {
        let op = build.get(value);
        if !available.contains(&value) && !op.is_constant() && list.insert(value) {
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
    fn implied_comparisons_hold() {
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
    fn known_conditions_are_not_evaluated_again() {
        let mut build = Build::new("f");
        let [x, y] = [3, 4].map(|slot| build.load(Slot(slot)));
        let (less, more) = (build.less(x, y), build.less(y, x));
        let other = build.select(more, y, x);
        let chosen = build.select(less, x, other);
        let list = slice(&build, &HashSet::default(), &[chosen]);
        assert_eq!(list.len(), 6);
        let true_side = known(&mut build, less, true);
        assert_eq!(partial_eval(&mut build, &list, &true_side, &[chosen, other]), [x, x]);
        let false_side = known(&mut build, less, false);
        assert_eq!(partial_eval(&mut build, &list, &false_side, &[chosen]), [other]);
    }
}
