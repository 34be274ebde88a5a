//! What of a rate its own state decides in jumps: the questions that its choices ask.
//!
//! In: the function of some rates, and their states. Out: the same rates, and the questions on whose answers they depend;
//! with these given, nothing jumps or has a kink. It computes no step.

use crate::ir::build::{Build, Env, prune};
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::HashMap;

/// Whether an operation answers a question: what it gives stays the same while its operands move a little.
pub fn asks(op: Op) -> bool {
    let truth = matches!(op, Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) | Op::IntLess(..) | Op::IntEqual(..));
    truth || matches!(op, Op::Floor(_) | Op::Nearest(_) | Op::ToInt(_))
}

/// Rates and what they ask of their states.
pub struct SwitchingConditions {
    /// The rates; each |x| that has a kink is written as a choice.
    pub rates: Func,
    /// Operations whose answers depend on the states.
    questions: Vec<Value>,
}

impl SwitchingConditions {
    /// What these rates ask of these states.
    pub fn of(rates: &Func, states: &[Slot]) -> SwitchingConditions {
        let depends = dependent(rates, states);
        // What is needed for itself and not only for an answer.
        let mut plain = vec![false; rates.ops.len()];
        rates.stores.iter().for_each(|(_, value)| plain[value.index()] = true);
        for (i, op) in rates.ops.iter().enumerate().rev() {
            if plain[i] && !asks(*op) {
                op.each_operand(|operand| plain[operand.index()] = true);
            }
        }
        let mut build = Build::new(&rates.name);
        let mut values: Vec<Value> = Vec::with_capacity(rates.ops.len());
        for (i, op) in rates.ops.iter().enumerate() {
            values.push(match op.map(|operand| values[operand.index()]) {
                Op::Abs(x) if plain[i] && depends[i] => {
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
        let questions = all.filter(|(i, op)| depends[*i] && asks(**op)).map(|(i, _)| Value(i as u32)).collect();
        SwitchingConditions { rates, questions }
    }

    /// The answers where the slots hold what `env` says.
    pub fn answers(&self, build: &mut Build, env: &Env) -> HashMap<Value, Value> {
        let mut values: Vec<Value> = Vec::with_capacity(self.rates.ops.len());
        for op in &self.rates.ops {
            values.push(match op {
                Op::Load(slot) => build.read(*slot, env),
                op => build.op(op.map(|operand| values[operand.index()])),
            });
        }
        self.questions.iter().map(|question| (*question, values[question.index()])).collect()
    }
}

/// Which operations depend on any of these slots.
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

    /// The rates of one state, in slot 3, and how many questions they ask.
    fn asking(f: impl for<'a> Fn(Real<'a>, Real<'a>) -> Real<'a>) -> (String, usize) {
        let build = Shared::new(Build::new("rates"));
        let [x, v] = [Slot(3), Slot(4)].map(|slot| Real::new(&build, build.borrow_mut().load(slot)));
        let rate = f(x, v).value;
        let mut build = build.into_inner();
        build.store(Slot(5), rate);
        let asking = SwitchingConditions::of(&build.finish(), &[Slot(3)]);
        (asking.rates.to_string(), asking.questions.len())
    }

    #[test]
    fn a_kink_is_a_question_and_a_size_that_only_answers_one_is_not() {
        let (listing, questions) = asking(|x, v| x.abs() - v.abs());
        assert_eq!(questions, 1);
        assert!(listing.contains("select") && listing.matches("abs").count() == 1, "{listing}");
        let (listing, questions) = asking(|x, v| (x.abs() * v).above(1.0).choose(v, -x));
        assert_eq!(questions, 1);
        assert!(listing.contains("abs"), "{listing}");
        assert_eq!(asking(|x, v| v.above(0.0).choose(v.floor(), -x)).1, 0);
    }

    /// With the answers of another place a rate goes on as if the state had not left the branch of that place.
    #[test]
    fn with_answers_given_nothing_jumps() {
        let build = Shared::new(Build::new("rates"));
        let x = Real::new(&build, build.borrow_mut().load(Slot(3)));
        let rate = (x.above(1.0).choose(x * 10.0, -x) + x.abs()).value;
        let mut rates = build.into_inner();
        rates.store(Slot(5), rate);
        let asking = SwitchingConditions::of(&rates.finish(), &[Slot(3)]);
        let build = Shared::new(Build::new("at 3, asked at 0.5 or −2"));
        let number = |x: f64| build.borrow_mut().real(x);
        for (place, expected) in [(0.5, 0.0), (-2.0, -6.0), (2.0, 33.0)] {
            let at = |x: f64| Env::from([(Slot(3), number(x))]);
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
