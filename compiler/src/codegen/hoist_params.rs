//! Takes out of a step what hangs on parameters and the length of the step alone.
//!
//! In: a sound, expanded function. Out: [`Hoisted`]: the rest of it, which finds these numbers behind the block, and a
//! function that puts them there. A loop computes them once, before its first iteration; who makes one step at a time
//! computes them when a parameter changes. They are the same operations either way: the same bits.

use crate::ir::build::{Build, prune};
use crate::ir::verify::types;
use crate::ir::{Func, Op, Type, Value};
use abi::{Layout, Slot};
use std::collections::HashMap;

/// A function in two parts.
pub struct Hoisted {
    /// Writes the numbers, each to a slot behind the block.
    pub prepare: Func,
    /// All else.
    pub step: Func,
}

impl Hoisted {
    /// Takes a function on blocks of this layout apart.
    pub fn of(func: &Func, layout: &Layout) -> Hoisted {
        let types = types(func).expect("the function is sound");
        let mut fixed: Vec<bool> = Vec::with_capacity(func.ops.len());
        for op in &func.ops {
            fixed.push(match op {
                Op::Load(slot) => layout.params.contains(*slot) || *slot == Slot::STEP,
                Op::Ring { .. } => false,
                op => {
                    let mut all = true;
                    op.each_operand(|operand| all &= fixed[operand.index()]);
                    all
                }
            });
        }
        // A sign costs less than to read another number, and bits cost what reading those would.
        let is_free = |op: &Op| op.effort() == 0 || matches!(op, Op::Neg(_) | Op::Abs(_) | Op::ToBits(_));
        let is_prepared = |at: usize| fixed[at] && types[at] != Type::Bool && !is_free(&func.ops[at]);
        let all: Vec<usize> = (0..func.ops.len()).filter(|at| is_prepared(*at)).collect();
        let first = Slot(layout.size() as u32);
        let mut rest = func.clone();
        all.iter().for_each(|at| rest.ops[*at] = Op::Load(first));
        // What only other prepared numbers need is not kept.
        let live = rest.live();
        let kept: Vec<usize> = all.into_iter().filter(|at| live[*at]).collect();
        let slots: HashMap<usize, Slot> =
            kept.iter().enumerate().map(|(k, at)| (*at, Slot(first.0 + k as u32))).collect();
        let (mut prepare, mut stores, mut step) = (Build::of(func), Vec::new(), Build::new(&func.name));
        for at in kept {
            let value = Value(at as u32);
            // An integer lies there as the real of the same bits.
            let number = if types[at] == Type::Int { prepare.from_bits(value) } else { value };
            stores.push((slots[&at], number));
        }
        let mut moved: Vec<Value> = Vec::with_capacity(func.ops.len());
        for (at, op) in func.ops.iter().enumerate() {
            let found = slots.get(&at).map(|slot| step.load(*slot));
            moved.push(match found {
                Some(number) if types[at] == Type::Int => step.to_bits(number),
                Some(number) => number,
                None => step.op(op.map(|operand| moved[operand.index()])),
            });
        }
        let name = format!("{}, prepared", func.name);
        let prepare = Func { name, ops: prepare.into_ops(), stores, writes: Vec::new(), status: None };
        Hoisted { prepare: prune(&prepare), step: step.finish_as(func, &moved) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::run_once;

    #[test]
    fn what_hangs_on_parameters_alone_is_prepared_and_nothing_else() {
        // A parameter and an input, a state; at 3, 4 and 5.
        let layout = Layout::new([1, 1, 1, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let [p, u, x] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let h = build.load(Slot::STEP);
        let rate = build.div(h, p);
        let gain = build.sqrt(rate);
        let limit = build.less(p, gain);
        let plain = build.mul(p, u);
        let moved = build.fma(gain, u, x);
        let next = build.select(limit, moved, plain);
        build.store(Slot(5), next);
        let func = build.finish();

        let Hoisted { prepare, step } = Hoisted::of(&func, &layout);
        assert_eq!(prepare.stores.iter().map(|(slot, _)| slot.0).collect::<Vec<_>>(), [6], "{prepare}");
        assert_eq!(prepare.loads(), [Slot::STEP, Slot(3)], "{prepare}");
        // The truth that hangs on it is no number: it is found out in the step, from what is prepared.
        assert_eq!(step.loads(), [3, 4, 5, 6].map(Slot), "{step}");
        assert!(!step.ops.iter().any(|op| matches!(op, Op::Div(..) | Op::Sqrt(_))), "{step}");
    }

    #[test]
    fn an_integer_is_prepared_as_the_real_of_its_bits() {
        // A parameter and an input, at 3 and 4; a state.
        let layout = Layout::new([1, 1, 1, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let [p, u] = [3, 4].map(|slot| build.load(Slot(slot)));
        let [seed, drawn] = [p, u].map(|number| build.op(Op::ToInt(number)));
        let odd = build.int(0x9E37_79B9);
        let mixed = build.op(Op::IntMul(seed, odd));
        let both = build.op(Op::IntXor(mixed, drawn));
        let next = build.op(Op::ToReal(both));
        build.store(Slot(5), next);

        let Hoisted { prepare, step } = Hoisted::of(&build.finish(), &layout);
        assert_eq!(prepare.stores.iter().map(|(slot, _)| slot.0).collect::<Vec<_>>(), [6], "{prepare}");
        assert_eq!(step.loads(), [4, 6].map(Slot), "{step}");
        assert!(!step.ops.iter().any(|op| matches!(op, Op::IntMul(..))), "{step}");
        let mut block = [0.0, 0.0, 0.0, 5.0, 3.0, 0.0, f64::NAN];
        run_once(&prepare, &mut block, &[]);
        run_once(&step, &mut block, &[]);
        assert_eq!(block[5], ((5 * 0x9E37_79B9_i64) ^ 3) as f64);
    }
}
