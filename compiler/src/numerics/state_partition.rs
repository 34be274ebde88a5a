//! Block-triangular partition of the states for a step by `expo`: which states must be iterated, and in which order.
//!
//! In: the function of the rates dx/dt. Out: groups of states, each after the groups that its rates depend on. It
//! computes no step.
//!
//! Source: Duff, Erisman, Reid, *Direct Methods for Sparse Matrices*, 1986, ch. 6 (block triangular form).

use crate::ir::hash::HashMap;
use crate::ir::scc::components;
use crate::ir::{Func, Op, Value};
use crate::numerics::switching_conditions::asks;
use abi::Slot;
use std::collections::BTreeMap;

/// States that are stepped together.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Group {
    /// Indices of the states, ascending.
    pub states: Vec<usize>,
    /// How the rates depend on these states.
    pub shape: Shape,
}

/// How a rate depends on its own state.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Shape {
    /// Affine, and independent of the other states of the group: one evaluation is exact.
    Affine,
    /// Affine for fixed switching conditions on the state: one evaluation is exact once these are known.
    PiecewiseAffine,
    /// Anything else: the step is iterated.
    Nonlinear,
    /// For several states that depend on each other: affine in all of them jointly, with coefficients that no state
    /// changes. The matrix exponential is exact.
    Linear,
}

/// Largest group for which the matrix exponential is used.
const MOST_LINEAR: usize = 8;

/// How a value depends on a state, while the other states and all switching conditions are fixed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Depend {
    /// Index of the state.
    state: u32,
    /// 0: only through switching conditions; 1: affine; 2: anything else.
    degree: u8,
    /// Whether a switching condition depends on the state.
    asks: bool,
}

/// The dependences of a value, ascending by state.
type Depends = Vec<Depend>;

/// The dependences between states.
pub struct Coupling {
    /// The groups, each after those that its rates depend on.
    pub groups: Vec<Group>,
    /// For each state, whether it can decay: its rate depends on it, and not only through switching conditions.
    pub fades: Vec<bool>,
}

/// Partitions the states. `func` stores the rates to the slots of `rates`.
pub fn coupling(func: &Func, rates: &[Slot], states: &[Slot]) -> Coupling {
    let rows = depends(func, rates, states);
    let edge = |v: usize, k: usize| rows[v].get(k).map(|on: &Depend| on.state as usize);
    let mut level = vec![0usize; states.len()];
    let mut groups: BTreeMap<(usize, Shape), Vec<usize>> = BTreeMap::new();
    let mut fades = vec![true; states.len()];
    for component in components(states.len(), edge) {
        let needed = component.iter().flat_map(|v| &rows[*v]).map(|on| on.state as usize);
        let own = needed.filter(|w| component.binary_search(w).is_err()).map(|w| level[w] + 1).max().unwrap_or(0);
        component.iter().for_each(|v| level[*v] = own);
        let shape = if let [v] = component[..] {
            let on_itself = rows[v].iter().find(|on| on.state as usize == v);
            fades[v] = on_itself.is_some_and(|on| on.degree > 0);
            match on_itself {
                Some(Depend { degree: 2.., .. }) => Shape::Nonlinear,
                Some(on) if on.asks => Shape::PiecewiseAffine,
                _ => Shape::Affine,
            }
        } else if component.len() <= MOST_LINEAR && is_linear(func, rates, states, &component) {
            Shape::Linear
        } else {
            Shape::Nonlinear
        };
        groups.entry((own, shape)).or_default().extend(component);
    }
    let group = |((_, shape), mut states): ((usize, Shape), Vec<usize>)| {
        states.sort_unstable();
        Group { states, shape }
    };
    Coupling { groups: groups.into_iter().map(group).collect(), fades }
}

/// How a value depends on the states of a component jointly.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum StateDependence {
    /// Depends on no state.
    Given,
    /// Depends on states outside the component only.
    Moving,
    /// Affine in the states of the component, with coefficients that no state changes.
    Affine,
    /// Anything else.
    Nonlinear,
}

/// Whether the rates of a component are jointly affine in its states, with coefficients that no state changes.
fn is_linear(func: &Func, rates: &[Slot], states: &[Slot], component: &[usize]) -> bool {
    use StateDependence::{Affine, Given, Moving, Nonlinear};
    let times = |a: StateDependence, b: StateDependence| match (a.min(b), a.max(b)) {
        (Given, Affine) => Affine,
        (_, Affine | Nonlinear) => Nonlinear,
        (_, most) => most,
    };
    let mut of: Vec<StateDependence> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let at = |value: Value| of[value.index()];
        of.push(match *op {
            Op::Load(slot) => match states.iter().position(|state| *state == slot) {
                Some(k) if component.binary_search(&k).is_ok() => Affine,
                Some(_) => Moving,
                None => Given,
            },
            Op::Add(a, b) | Op::Sub(a, b) => at(a).max(at(b)),
            Op::Neg(a) => at(a),
            Op::Mul(a, b) => times(at(a), at(b)),
            Op::Fma(a, b, c) => times(at(a), at(b)).max(at(c)),
            Op::Div(a, b) if at(b) <= Moving => times(at(a), at(b)),
            Op::Select(c, a, b) => match (at(c), at(a).max(at(b))) {
                (Given, most) => most,
                (Moving, most) if most <= Moving => Moving,
                _ => Nonlinear,
            },
            op => {
                let mut most = Given;
                op.each_operand(|operand| most = most.max(at(operand)));
                if most == Affine { Nonlinear } else { most }
            }
        });
    }
    let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
    let rate = |k: &usize| stored.get(&rates[*k]).map_or(Given, |value| of[value.index()]);
    component.iter().all(|k| rate(k) <= Affine)
}

/// For each rate, its dependences.
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
        let own = match *op {
            Op::Load(slot) => {
                number.get(&slot).map(|k| Depend { state: *k, degree: 1, asks: false }).into_iter().collect()
            }
            Op::Add(a, b) | Op::Sub(a, b) => sum(at(a), at(b)),
            Op::Neg(a) => at(a).clone(),
            // |x| has a kink, which is a switching condition, unless x is piecewise constant.
            Op::Abs(a) => at(a).iter().map(|on| Depend { asks: on.asks || on.degree > 0, ..*on }).collect(),
            Op::Mul(a, b) => product(at(a), at(b)),
            Op::Fma(a, b, c) => sum(&product(at(a), at(b)), at(c)),
            Op::Div(a, b) => product(at(a), &nonlinear(at(b))),
            // The condition is a Boolean, so its degree is 0.
            Op::Select(condition, a, b) => sum(at(condition), &sum(at(a), at(b))),
            op => {
                let mut all = Depends::new();
                let answer = asks(op);
                op.each_operand(|operand| {
                    let operand = if answer { condition_on(at(operand)) } else { nonlinear(at(operand)) };
                    all = sum(&all, &operand);
                });
                all
            }
        };
        of[i] = own;
        // Frees lists that have no further use: on a sum over a thousand parts, they would have half a million entries.
        op.each_operand(|operand| {
            if last[operand.index()] == i {
                of[operand.index()] = Depends::new();
            }
        });
    }
    let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
    rates.iter().map(|slot| stored.get(slot).map_or_else(Depends::new, |value| of[value.index()].clone())).collect()
}

/// Dependences of a nonlinear function of a value.
fn nonlinear(of: &Depends) -> Depends {
    of.iter().map(|on| Depend { degree: if on.degree == 0 { 0 } else { 2 }, ..*on }).collect()
}

/// Dependences of a switching condition on a value.
fn condition_on(of: &Depends) -> Depends {
    of.iter().map(|on| Depend { degree: 0, asks: true, ..*on }).collect()
}

/// Dependences of a sum.
fn sum(a: &Depends, b: &Depends) -> Depends {
    joined(a, b, u8::max)
}

/// Dependences of a product. It is not affine in a state on which both factors depend.
fn product(a: &Depends, b: &Depends) -> Depends {
    joined(a, b, |a, b| (a + b).min(2))
}

/// Union of two dependence lists. `both`: the degree for a state that is in both.
fn joined(a: &Depends, b: &Depends, both: impl Fn(u8, u8) -> u8) -> Depends {
    let (mut i, mut j) = (0, 0);
    let mut out = Depends::with_capacity(a.len().max(b.len()));
    while i < a.len() && j < b.len() {
        let (x, y) = (a[i], b[j]);
        out.push(match x.state.cmp(&y.state) {
            std::cmp::Ordering::Less => x,
            std::cmp::Ordering::Equal => {
                Depend { state: x.state, degree: both(x.degree, y.degree), asks: x.asks || y.asks }
            }
            std::cmp::Ordering::Greater => y,
        });
        i += usize::from(x.state <= y.state);
        j += usize::from(y.state <= x.state);
    }
    out.extend_from_slice(&a[i..]);
    out.extend_from_slice(&b[j..]);
    out
}

#[cfg(test)]
mod tests {
    use super::Shape::{Affine, Linear, Nonlinear, PiecewiseAffine};
    use super::*;
    use crate::ir::build::Build;
    use crate::ir::expr::{Real, Shared};
    use abi::Layout;

    fn of<const N: usize>(f: impl for<'a> Fn([Real<'a>; N]) -> [Real<'a>; N]) -> Coupling {
        let layout = Layout::new([0, 0, N as u32, 0, 0, 0, N as u32, 0, 0, 0]);
        let slots = |segment: abi::description::Segment| -> Vec<Slot> { (0..N).map(|k| segment.slot(k)).collect() };
        let (states, rates) = (slots(layout.states), slots(layout.derivatives));
        let build = Shared::new(Build::new("derivatives"));
        let x: [Real; N] = std::array::from_fn(|k| Real::new(&build, build.borrow_mut().load(states[k])));
        let found = f(x).map(|rate| rate.value);
        let mut build = build.into_inner();
        found.into_iter().zip(&rates).for_each(|(rate, slot)| build.store(*slot, rate));
        coupling(&build.finish(), &rates, &states)
    }

    #[track_caller]
    fn check<const N: usize>(f: impl for<'a> Fn([Real<'a>; N]) -> [Real<'a>; N], expected: &[(&[usize], Shape)]) {
        let groups = of(f).groups;
        let found: Vec<(&[usize], Shape)> = groups.iter().map(|group| (&group.states[..], group.shape)).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn dependent_states_come_after_those_they_depend_on() {
        // A second-order filter of the constant 1.
        check(|[x, y]| [(y - x) * 3.0, (1.0 - y) / 2.0], &[(&[1], Affine), (&[0], Affine)]);
        // Two independent states.
        check(|[x, y]| [1.0 - x, 2.0 - y], &[(&[0, 1], Affine)]);
    }

    #[test]
    fn cyclic_dependences_are_iterated_unless_linear() {
        check(|[x, v, z]| [v, -x, v.abs() * (1.0 - z)], &[(&[0, 1], Linear), (&[2], Affine)]);
        check(|[x, v, z]| [v, z.abs() - x, 1.0 - z], &[(&[2], Affine), (&[0, 1], Linear)]);
        check(|[x, v, z]| [v, -(z * x), 1.0 - z], &[(&[2], Affine), (&[0, 1], Nonlinear)]);
        check(|[x, v]| [v, -x.abs()], &[(&[0, 1], Nonlinear)]);
    }

    #[test]
    fn a_nonlinear_rate_is_iterated() {
        check(|[x]| [-(x * x)], &[(&[0], Nonlinear)]);
        check(|[x]| [1.0 / x], &[(&[0], Nonlinear)]);
        check(|[x]| [x.above(0.0).choose(-(x * x), 1.0)], &[(&[0], Nonlinear)]);
        check(|[x]| [x.bits().real_of_bits()], &[(&[0], Affine)]);
        check(|[x]| [(x.bits() | 1).real_of_bits()], &[(&[0], Nonlinear)]);
    }

    #[test]
    fn a_piecewise_affine_rate_is_affine_in_each_branch() {
        // Each branch is independent of x, but the selection of the branch is not.
        check(|[x]| [x.above(0.0).choose(-1.0, 1.0)], &[(&[0], PiecewiseAffine)]);
        check(|[x]| [(x * x).above(2.0).choose(-1.0, x)], &[(&[0], PiecewiseAffine)]);
        check(|[x]| [-x.abs()], &[(&[0], PiecewiseAffine)]);
        check(|[x]| [x * x.above(0.0).choose(-1.0, 1.0)], &[(&[0], PiecewiseAffine)]);
        check(|[x]| [x.floor().of(crate::ir::Unary::Exp) - x], &[(&[0], PiecewiseAffine)]);
        check(|[x, y]| [y.above(0.0).choose(-x, 1.0), y.constant(1.0)], &[(&[1], Affine), (&[0], Affine)]);
    }

    #[test]
    fn a_state_that_its_rate_ignores_cannot_decay() {
        let all = of(|[x, v, w, z]| [v, -x, x.above(0.0).choose(1.0, w.abs()), w - z]);
        assert_eq!(all.fades, [true; 4]);
        let none = of(|[x, v, w, z]| [v, v.above(0.0).choose(-1.0, 1.0), w.constant(0.0), x.above(z).choose(x, w)]);
        assert_eq!(none.fades, [false; 4]);
    }
}
