//! Which states a step by `expo` must iterate, and in which order it comes to them.
//!
//! In: the function of the rates dx/dt. Out: groups of states, each behind the groups that its rates depend on. It computes
//! no step.

use crate::components::components;
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::{BTreeMap, HashMap};

/// States that are stepped together.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Group {
    /// Their numbers, ascending.
    pub states: Vec<usize>,
    /// Each rate is affine in its own state, whichever branch is taken, and free of the others here: one evaluation is exact.
    pub once: bool,
}

/// What a value depends on: numbers of states, ascending, and whether it is affine in that state, the others given.
type Depends = Vec<(u32, bool)>;

/// The groups of the states, whose rates `func` stores to the slots of `rates`.
pub fn groups(func: &Func, rates: &[Slot], states: &[Slot]) -> Vec<Group> {
    let rows = depends(func, rates, states);
    let edge = |v: usize, k: usize| rows[v].get(k).map(|(w, _): &(u32, bool)| *w as usize);
    let mut level = vec![0usize; states.len()];
    let mut groups: BTreeMap<(usize, bool), Vec<usize>> = BTreeMap::new();
    for component in components(states.len(), edge) {
        let needed = component.iter().flat_map(|v| &rows[*v]).map(|(w, _)| *w as usize);
        let own = needed.filter(|w| component.binary_search(w).is_err()).map(|w| level[w] + 1).max().unwrap_or(0);
        component.iter().for_each(|v| level[*v] = own);
        let once = match component[..] {
            [v] => rows[v].iter().all(|(w, affine)| *w as usize != v || *affine),
            _ => false,
        };
        groups.entry((own, once)).or_default().extend(component);
    }
    let group = |((_, once), mut states): ((usize, bool), Vec<usize>)| {
        states.sort_unstable();
        Group { states, once }
    };
    groups.into_iter().map(group).collect()
}

/// For each rate, what it depends on.
fn depends(func: &Func, rates: &[Slot], states: &[Slot]) -> Vec<Depends> {
    let number: HashMap<Slot, u32> = states.iter().enumerate().map(|(k, slot)| (*slot, k as u32)).collect();
    let mut last = vec![0; func.ops.len()];
    for (i, op) in func.ops.iter().enumerate() {
        op.each_operand(|operand| last[operand.index()] = i);
    }
    for (_, value) in &func.stores {
        last[value.index()] = func.ops.len();
    }
    let mut of: Vec<Depends> = vec![Depends::new(); func.ops.len()];
    for (i, op) in func.ops.iter().enumerate() {
        let at = |value: Value| &of[value.index()];
        let mine = match *op {
            Op::Load(slot) => number.get(&slot).map(|k| (*k, true)).into_iter().collect(),
            Op::Add(a, b) | Op::Sub(a, b) => either(at(a), at(b)),
            Op::Neg(a) => at(a).clone(),
            Op::Mul(a, b) => product(at(a), at(b)),
            Op::Fma(a, b, c) => either(&product(at(a), at(b)), at(c)),
            Op::Div(a, b) => either(at(a), &bent(at(b))),
            // Which branch is taken is free of the state, or the whole is not affine in it.
            Op::Select(condition, a, b) => either(&bent(at(condition)), &either(at(a), at(b))),
            op => {
                let mut all = Depends::new();
                op.each_operand(|operand| all = either(&all, &bent(at(operand))));
                all
            }
        };
        of[i] = mine;
        // A sum over a thousand parts has half a million entries on its way.
        op.each_operand(|operand| {
            if last[operand.index()] == i {
                of[operand.index()] = Depends::new();
            }
        });
    }
    let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
    rates.iter().map(|slot| stored.get(slot).map_or_else(Depends::new, |value| of[value.index()].clone())).collect()
}

/// Not affine in anything.
fn bent(of: &Depends) -> Depends {
    of.iter().map(|(k, _)| (*k, false)).collect()
}

/// Of a sum: affine where each is.
fn either(a: &Depends, b: &Depends) -> Depends {
    joined(a, b, |a, b| a && b)
}

/// Of a product: not affine in what both depend on.
fn product(a: &Depends, b: &Depends) -> Depends {
    joined(a, b, |_, _| false)
}

/// What is in either of the two; what is in both as `both` says.
fn joined(a: &Depends, b: &Depends, both: impl Fn(bool, bool) -> bool) -> Depends {
    let (mut i, mut j) = (0, 0);
    let mut out = Depends::with_capacity(a.len().max(b.len()));
    while i < a.len() && j < b.len() {
        let ((x, of_a), (y, of_b)) = (a[i], b[j]);
        out.push(match x.cmp(&y) {
            std::cmp::Ordering::Less => (x, of_a),
            std::cmp::Ordering::Equal => (x, both(of_a, of_b)),
            std::cmp::Ordering::Greater => (y, of_b),
        });
        i += usize::from(x <= y);
        j += usize::from(y <= x);
    }
    out.extend_from_slice(&a[i..]);
    out.extend_from_slice(&b[j..]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use crate::ir::expr::{Real, Shared};
    use abi::Layout;

    #[track_caller]
    fn check<const N: usize>(f: impl for<'a> Fn([Real<'a>; N]) -> [Real<'a>; N], expected: &[(&[usize], bool)]) {
        let layout = Layout::new([0, 0, N as u32, 0, 0, 0, N as u32, 0, 0, 0]);
        let slots = |segment: abi::description::Segment| -> Vec<Slot> { (0..N).map(|k| segment.slot(k)).collect() };
        let (states, rates) = (slots(layout.states), slots(layout.derivatives));
        let build = Shared::new(Build::new("derivatives"));
        let x: [Real; N] = std::array::from_fn(|k| Real::new(&build, build.borrow_mut().load(states[k])));
        let found = f(x).map(|rate| rate.value);
        let mut build = build.into_inner();
        found.into_iter().zip(&rates).for_each(|(rate, slot)| build.store(*slot, rate));
        let groups = groups(&build.finish(), &rates, &states);
        let found: Vec<(&[usize], bool)> = groups.iter().map(|group| (&group.states[..], group.once)).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn what_relaxes_toward_others_comes_behind_them() {
        // A filter of a filter of 1.
        check(|[x, y]| [(y - x) * 3.0, (1.0 - y) / 2.0], &[(&[1], true), (&[0], true)]);
        // Two that do not know of each other.
        check(|[x, y]| [1.0 - x, 2.0 - y], &[(&[0, 1], true)]);
    }

    #[test]
    fn what_goes_in_a_circle_is_iterated() {
        check(|[x, v, z]| [v, -x, v.abs() * (1.0 - z)], &[(&[0, 1], false), (&[2], true)]);
    }

    #[test]
    fn a_rate_that_bends_is_iterated() {
        check(|[x]| [-(x * x)], &[(&[0], false)]);
        check(|[x]| [1.0 / x], &[(&[0], false)]);
        // Each branch is free of x, but not which one it is.
        check(|[x]| [x.above(0.0).choose(-1.0, 1.0)], &[(&[0], false)]);
        check(|[x, y]| [y.above(0.0).choose(-x, 1.0), y.constant(1.0)], &[(&[1], true), (&[0], true)]);
    }
}
