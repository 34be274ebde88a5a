//! Switching conditions: the comparisons by which a rate selects a branch that depends on its own state.
//!
//! In: the function of some rates, and their states. Out: the same rates, and the conditions they depend on. For fixed
//! results of these conditions, the rates have no jump and no kink. It computes no step.
//!
//! Source: Hairer, Nørsett, Wanner, *Solving ODEs I*, II.6 (discontinuities and switching functions).

use crate::ir::build::{Build, Env, prune};
use crate::ir::hash::HashMap;
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// Whether the result of an operation is piecewise constant in its operands: comparisons and roundings.
pub fn asks(op: Op) -> bool {
    let truth = matches!(op, Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) | Op::IntLess(..) | Op::IntEqual(..));
    truth || matches!(op, Op::Floor(_) | Op::Nearest(_) | Op::ToInt(_))
}

/// Rates and the conditions on their states.
pub struct SwitchingConditions {
    /// The rates. Each |x| that causes a kink is written as a select.
    pub rates: Func,
    /// The comparisons and roundings that depend on the states.
    conditions: Vec<Value>,
}

impl SwitchingConditions {
    /// Finds the conditions of these rates on these states.
    pub fn of(rates: &Func, states: &[Slot]) -> SwitchingConditions {
        let depends = dependent(rates, states);
        // Values that enter a rate directly, and not only through a condition.
        let mut is_direct = vec![false; rates.ops.len()];
        rates.stores.iter().for_each(|(_, value)| is_direct[value.index()] = true);
        for (i, op) in rates.ops.iter().enumerate().rev() {
            if is_direct[i] && !asks(*op) {
                op.each_operand(|operand| is_direct[operand.index()] = true);
            }
        }
        let mut build = Build::new(&rates.name);
        let mut values: Vec<Value> = Vec::with_capacity(rates.ops.len());
        for (i, op) in rates.ops.iter().enumerate() {
            values.push(match op.map(|operand| values[operand.index()]) {
                Op::Abs(x) if is_direct[i] && depends[i] => {
                    let zero = build.real(0.0);
                    let (negative, minus) = (build.less(x, zero), build.neg(x));
                    build.select(negative, minus, x)
                }
                op => build.op(op),
            });
        }
        rates.stores.iter().for_each(|(slot, value)| build.store(*slot, values[value.index()]));
        let rates = prune(&build.finish());
        let depends = dependent(&rates, states);
        let all = rates.ops.iter().enumerate();
        let conditions = all.filter(|(i, op)| depends[*i] && asks(**op)).map(|(i, _)| Value(i as u32)).collect();
        SwitchingConditions { rates, conditions }
    }

    /// Evaluates the conditions with the slot values of `env`: each condition with its result.
    pub fn answers(&self, build: &mut Build, env: &Env) -> HashMap<Value, Value> {
        let mut values: Vec<Value> = Vec::with_capacity(self.rates.ops.len());
        for op in &self.rates.ops {
            values.push(match op {
                Op::Load(slot) => build.read(*slot, env),
                op => build.op(op.map(|operand| values[operand.index()])),
            });
        }
        self.conditions.iter().map(|condition| (*condition, values[condition.index()])).collect()
    }
}

/// For each operation, whether it depends on any of these slots.
fn dependent(func: &Func, slots: &[Slot]) -> Vec<bool> {
    let mut depends = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut any = matches!(op, Op::Load(slot) if slots.contains(slot));
        op.each_operand(|operand: Value| any |= depends[operand.index()]);
        depends.push(any);
    }
    depends
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::expr::{Real, Shared};

    /// The listing of the rate of one state (slot 3) and the number of its conditions.
    fn asking(f: impl for<'a> Fn(Real<'a>, Real<'a>) -> Real<'a>) -> (String, usize) {
        let build = Shared::new(Build::new("rates"));
        let [x, v] = [Slot(3), Slot(4)].map(|slot| Real::new(&build, build.borrow_mut().load(slot)));
        let rate = f(x, v).value;
        let mut build = build.into_inner();
        build.store(Slot(5), rate);
        let asking = SwitchingConditions::of(&build.finish(), &[Slot(3)]);
        (asking.rates.to_string(), asking.conditions.len())
    }

    #[test]
    fn a_kink_is_a_condition_but_an_absolute_value_in_a_comparison_is_not() {
        let (listing, conditions) = asking(|x, v| x.abs() - v.abs());
        assert_eq!(conditions, 1);
        assert!(listing.contains("select") && listing.matches("abs").count() == 1, "{listing}");
        let (listing, conditions) = asking(|x, v| (x.abs() * v).above(1.0).choose(v, -x));
        assert_eq!(conditions, 1);
        assert!(listing.contains("abs"), "{listing}");
        assert_eq!(asking(|x, v| v.above(0.0).choose(v.floor(), -x)).1, 0);
    }

    /// With the conditions of another point, a rate continues its branch of that point smoothly.
    #[test]
    fn rates_are_smooth_for_fixed_conditions() {
        let build = Shared::new(Build::new("rates"));
        let x = Real::new(&build, build.borrow_mut().load(Slot(3)));
        let rate = (x.above(1.0).choose(x * 10.0, -x) + x.abs()).value;
        let mut rates = build.into_inner();
        rates.store(Slot(5), rate);
        let asking = SwitchingConditions::of(&rates.finish(), &[Slot(3)]);
        let build = Shared::new(Build::new("at 3, asked at 0.5 or −2"));
        let number = |x: f64| build.borrow_mut().real(x);
        for (place, expected) in [(0.5, 0.0), (-2.0, -6.0), (2.0, 33.0)] {
            let at = |x: f64| Env::from_iter([(Slot(3), number(x))]);
            let (there, mut env) = (at(place), at(3.0));
            let answers = asking.answers(&mut build.borrow_mut(), &there);
            let gradients =
                crate::numerics::autodiff::inline_given(&build, &asking.rates, &mut env, &[Slot(3)], &answers);
            let constant = |value: Value| build.borrow().constant(value);
            assert_eq!(constant(env[&Slot(5)]), Some(expected));
            let slope = crate::numerics::autodiff::entry(&gradients[&Slot(5)], 0).and_then(constant);
            assert_eq!(slope.unwrap_or(0.0), expected / 3.0);
        }
    }
}
