//! Fuses products into the sums they are for: a · b + c with one rounding, in one instruction.
//!
//! In: a step, regrouped, before elementary functions are expanded. Out: the same with fewer operations and a shorter
//! chain. This rounds differently (once instead of twice), so it is part of what a step *is*: it stands before every
//! back end. Left alone is
//!
//! - a product that something else uses too: it would be computed twice, and what is compared with it would differ from
//!   what it enters;
//! - a sum or difference of two products: forces k·a and −k·a cancel, and fused they would leave what k·a was rounded by.
//!   Squares never do; and a product with a sign is not rounded, so that the same comes out;
//! - a product that does not wait for the step before, in a sum that does and that the next step waits for, as of an
//!   integrator and what enters it: the sum alone is sooner there than both.
//!
//! All look at one sum alone and on what it hangs, so mirror images of a contact are fused alike.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value, is_not_negative, sign_of};
use crate::opt::reassociate::carried;
use abi::{Layout, Slot};

/// Fuses what may be, in a function on blocks of this layout.
pub fn contract(func: &Func, layout: &Layout) -> Func {
    let (uses, chain) = (uses(func), Chain::of(func, layout));
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    // The factors of a product that only one operation uses.
    let product = |value: Value| match func.op(value) {
        Op::Mul(a, b) if uses[value.index()] == 1 => Some((a, b)),
        _ => None,
    };
    // A product or one with its sign turned, as in the mirror image.
    let cancels = |other: Value| match func.op(other) {
        Op::Neg(plain) => matches!(func.op(plain), Op::Mul(..)),
        op => matches!(op, Op::Mul(..)),
    };
    let grows = |x: Value, y: Value| [x, y].iter().all(|part| is_not_negative(*part, |value| func.op(value)));
    let is_sign = |value: Value| sign_of(func.op(value), |value| func.op(value)).is_some();
    let is_exact = |value: Value| matches!(func.op(value), Op::Mul(a, b) if is_sign(a) || is_sign(b));
    for (sum, op) in func.ops.iter().enumerate() {
        let at = |value: Value| values[value.index()];
        let enters = |x: Value, y: Value| product(x).is_some() && !cancels(y) && chain.enters(x, y, sum);
        let made = match *op {
            Op::Add(x, y) | Op::Sub(x, y) if enters(x, y) || enters(y, x) => {
                let part = if enters(x, y) { x } else { y };
                let factors = chain.factors(part, &product).into_iter().map(at);
                let whole = factors.reduce(|a, b| build.mul(a, b)).expect("it has two");
                build.op(op.map(|operand| if operand == part { whole } else { at(operand) }))
            }
            Op::Add(x, y) | Op::Sub(x, y) => {
                let adds = matches!(op, Op::Add(..));
                let fits = |x: Value, y: Value| is_exact(x) || !cancels(y) || adds && grows(x, y);
                match (product(x).filter(|_| fits(x, y)), product(y).filter(|_| fits(y, x))) {
                    (Some((a, b)), other) if is_exact(x) || other.is_none() || !is_exact(y) => {
                        let rest = if adds { at(y) } else { build.neg(at(y)) };
                        build.fma(at(a), at(b), rest)
                    }
                    (_, Some((a, b))) => {
                        let a = if adds { at(a) } else { build.neg(at(a)) };
                        build.fma(a, at(b), at(x))
                    }
                    _ => build.op(op.map(at)),
                }
            }
            op => build.op(op.map(at)),
        };
        values.push(made);
    }
    build.finish_as(func, &values)
}

/// What a value hangs on.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum On {
    /// These and constants.
    Parameters,
    /// What is given from outside, and time.
    Inputs,
    /// What that leaves.
    StepBefore,
}

/// How values hang on the step before, and the step behind on them. A choice is foreseen: nothing waits for what decides it.
struct Chain {
    /// Of each value.
    on: Vec<On>,
    /// Whether the step behind waits for it.
    leads: Vec<bool>,
}

impl Chain {
    fn of(func: &Func, layout: &Layout) -> Chain {
        let carried = carried(func);
        let mut on: Vec<On> = Vec::with_capacity(func.ops.len());
        for op in &func.ops {
            on.push(match *op {
                Op::Load(slot) if carried.contains(&slot) => On::StepBefore,
                Op::Load(Slot::TIME | Slot::COUNT) | Op::Ring { .. } => On::Inputs,
                Op::Load(slot) if layout.inputs.contains(slot) => On::Inputs,
                op => parts(op).into_iter().map(|part| on[part.index()]).fold(On::Parameters, On::max),
            });
        }
        let mut leads = vec![false; func.ops.len()];
        let handed = func.stores.iter().filter(|(slot, _)| carried.contains(slot));
        handed.for_each(|(_, value)| leads[value.index()] = true);
        for (value, op) in func.ops.iter().enumerate().rev() {
            if leads[value] {
                parts(*op).into_iter().for_each(|part| leads[part.index()] = true);
            }
        }
        Chain { on, leads }
    }

    /// Whether one part of a sum is there before the other, which waits for the step before, as the step behind does for the sum.
    fn enters(&self, part: Value, other: Value, sum: usize) -> bool {
        let waits = |value: Value| self.on[value.index()] == On::StepBefore;
        self.leads[sum] && !waits(part) && waits(other)
    }

    /// The factors of a product: those that wait for nothing first, for their product is computed once.
    fn factors(&self, value: Value, product: &impl Fn(Value) -> Option<(Value, Value)>) -> Vec<Value> {
        let (mut open, mut factors) = (vec![value], Vec::new());
        while let Some(value) = open.pop() {
            match product(value) {
                Some((a, b)) => open.extend([b, a]),
                None => factors.push(value),
            }
        }
        factors.sort_by_key(|value| self.on[value.index()]);
        factors
    }
}

/// Operands of an operation, but for what decides a choice.
fn parts(op: Op) -> Vec<Value> {
    let mut parts = Vec::new();
    match op {
        Op::Select(_, yes, no) => parts.extend([yes, no]),
        op => op.each_operand(|operand| parts.push(operand)),
    }
    parts
}

/// How often each value is used, as an operand or a result.
fn uses(func: &Func) -> Vec<u32> {
    let mut uses = vec![0; func.ops.len()];
    for op in &func.ops {
        op.each_operand(|operand| uses[operand.index()] += 1);
    }
    for value in func.results() {
        uses[value.index()] += 1;
    }
    uses
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The operations of a function of four states that all become `f` of them.
    fn contracted(f: impl Fn(&mut Build, [Value; 4]) -> Value) -> String {
        let layout = Layout::new([0, 0, 4, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let x: [Value; 4] = std::array::from_fn(|k| build.load(layout.states.slot(k)));
        let y = f(&mut build, x);
        (0..4).for_each(|k| build.store(layout.states.slot(k), y));
        contract(&build.finish(), &layout).to_string()
    }

    fn count(listing: &str, operation: &str) -> usize {
        listing.lines().filter(|line| line.contains(&format!(" {operation} "))).count()
    }

    #[test]
    fn a_product_enters_its_sum_in_one_operation() {
        let sum = contracted(|b, [x, y, z, _]| {
            let product = b.mul(x, y);
            b.add(z, product)
        });
        assert_eq!((count(&sum, "fma"), count(&sum, "mul"), count(&sum, "add")), (1, 0, 0), "{sum}");
        let less = contracted(|b, [x, y, z, _]| {
            let product = b.mul(x, y);
            b.sub(z, product)
        });
        assert_eq!((count(&less, "fma"), count(&less, "mul"), count(&less, "sub")), (1, 0, 0), "{less}");
    }

    #[test]
    fn what_is_there_before_the_state_it_enters_is_no_part_of_the_chain() {
        // A parameter, an input, two states and an output.
        let layout = Layout::new([1, 1, 2, 0, 0, 1, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let [k, v, x, y] = [layout.params.slot(0), layout.inputs.slot(0), layout.states.slot(0), layout.states.slot(1)]
            .map(|slot| build.load(slot));
        let h = build.load(Slot::STEP);
        let mut moved = |state: Value, by: Value| {
            let rate = build.mul(k, by);
            let change = build.mul(h, rate);
            build.add(state, change)
        };
        let (driven, waiting) = (moved(x, v), moved(x, y));
        let other = moved(y, x);
        let choice = build.less(v, x);
        let driven = build.select(choice, driven, x);
        [(layout.states.slot(0), driven), (layout.states.slot(1), other), (layout.outputs.slot(0), waiting)]
            .into_iter()
            .for_each(|(slot, value)| build.store(slot, value));
        let func = contract(&build.finish(), &layout);
        let listing = func.to_string();
        assert_eq!((count(&listing, "fma"), count(&listing, "add")), (2, 1), "{listing}");
        // What is the same in every step is one factor: h k.
        let is_given = |value: Value| matches!(func.op(value), Op::Load(slot) if layout.inputs.contains(slot));
        let fixed = func.ops.iter().find_map(|op| match *op {
            Op::Mul(a, b) if is_given(a) || is_given(b) => Some(func.op(if is_given(a) { b } else { a })),
            _ => None,
        });
        assert!(matches!(fixed, Some(Op::Mul(..))), "{listing}");
    }

    #[test]
    fn mirror_images_are_fused_alike() {
        // v − x z is not fused for v = w y; nor is −v − x z.
        for turned in [false, true] {
            let listing = contracted(|b, [x, y, z, w]| {
                let (speed, product) = (b.mul(w, y), b.mul(x, z));
                let minus = b.neg(speed);
                let difference = b.sub(if turned { minus } else { speed }, product);
                let ratio = b.div(difference, speed);
                b.div(ratio, minus)
            });
            assert_eq!(count(&listing, "fma"), 0, "{listing}");
        }
    }

    #[test]
    fn squares_and_signs_never_cancel() {
        let norm = contracted(|b, [x, y, ..]| {
            let squares = [b.mul(x, x), b.mul(y, y)];
            b.add(squares[0], squares[1])
        });
        assert_eq!((count(&norm, "fma"), count(&norm, "mul")), (1, 1), "{norm}");
        // The product with a sign is the one that is fused, wherever it stands.
        for turned in [false, true] {
            for of_two in [Build::add, Build::sub] {
                let force = contracted(|b, [v, y, z, _]| {
                    let [zero, one, minus_one] = [0.0, 1.0, -1.0].map(|number| b.real(number));
                    let (above, below) = (b.less(zero, v), b.less(v, zero));
                    let rest = b.mul(zero, v);
                    let other = b.select(below, minus_one, rest);
                    let sign = b.select(above, one, other);
                    let (dry, viscous) = (b.mul(y, sign), b.mul(z, v));
                    if turned { of_two(b, viscous, dry) } else { of_two(b, dry, viscous) }
                });
                assert_eq!((count(&force, "fma"), count(&force, "mul")), (1, 2), "{force}");
            }
        }
    }

    #[test]
    fn what_cancels_still_does() {
        for of_two in [Build::add, Build::sub] {
            let forces = contracted(|b, [x, y, z, w]| {
                let (one, other) = (b.mul(x, y), b.mul(z, w));
                // One of them is wanted for itself, too.
                let total = of_two(b, one, other);
                let ratio = b.div(one, total);
                b.add(ratio, total)
            });
            assert_eq!(count(&forces, "fma"), 0, "{forces}");
        }
        // A force that is both compared and applied.
        let shared = contracted(|b, [x, y, z, w]| {
            let force = b.mul(x, y);
            let sticks = b.less(force, z);
            let rest = b.sub(force, w);
            let zero = b.real(0.0);
            b.select(sticks, zero, rest)
        });
        assert_eq!(count(&shared, "fma"), 0, "{shared}");
    }
}
