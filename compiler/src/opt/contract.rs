//! FMA contraction: a · b + c becomes one fused multiply-add, which is rounded once.
//!
//! In: a step function after reassociation, before elementary functions are expanded. Out: the same algebra with fewer
//! operations and a shorter critical path. A fused result is rounded once instead of twice. The pass therefore runs
//! before every back end, so that all of them compute the same bits. These products are not fused:
//!
//! - A product that has a second use. It would be computed twice, and the rounded product that the other use sees would
//!   differ from the exact product in the sum.
//! - A product in a sum or difference of two products. The forces k·a and −k·a must cancel exactly; if one of them were
//!   fused, the rounding error of k·a would remain. There are two exceptions: sums of two values that are never
//!   negative (such as squares) cannot cancel, and a product with a sign (−1, 0 or 1) is exact, so fusing it changes no
//!   bit.
//! - A product that does not depend on the previous step, if the other addend does and the next step depends on the
//!   sum. An integrator that adds its input is such a sum. The product is ready early, and an addition has a shorter
//!   latency than a fused multiply-add.
//!
//! Each decision depends only on one sum and its operands, so both sides of a symmetric contact are fused alike.
//!
//! Source: Muller et al., *Handbook of Floating-Point Arithmetic*, 2018.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value, is_not_negative, sign_of};
use crate::opt::reassociate::carried;
use abi::{Layout, Slot};

/// Fuses every product that may be fused. `layout`: the block that the function works on.
pub fn contract(func: &Func, layout: &Layout) -> Func {
    let (uses, chain) = (uses(func), Dependence::of(func, layout));
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    // The factors of a product that has one use.
    let product = |value: Value| match func.op(value) {
        Op::Mul(a, b) if uses[value.index()] == 1 => Some((a, b)),
        _ => None,
    };
    // A product or a negated product: the other side of a symmetric contact has the opposite sign.
    let cancels = |other: Value| match func.op(other) {
        Op::Neg(plain) => matches!(func.op(plain), Op::Mul(..)),
        op => matches!(op, Op::Mul(..)),
    };
    let cannot_cancel = |x: Value, y: Value| [x, y].iter().all(|part| is_not_negative(*part, |value| func.op(value)));
    let is_sign = |value: Value| sign_of(func.op(value), |value| func.op(value)).is_some();
    let is_exact = |value: Value| matches!(func.op(value), Op::Mul(a, b) if is_sign(a) || is_sign(b));
    for (sum, op) in func.ops.iter().enumerate() {
        let at = |value: Value| values[value.index()];
        let is_early = |x: Value, y: Value| product(x).is_some() && !cancels(y) && chain.is_early_addend(x, y, sum);
        let value = match *op {
            Op::Add(x, y) | Op::Sub(x, y) if is_early(x, y) || is_early(y, x) => {
                let part = if is_early(x, y) { x } else { y };
                let factors = chain.factors(part, &product).into_iter().map(at);
                let whole = factors.reduce(|a, b| build.mul(a, b)).expect("it has two");
                build.op(op.map(|operand| if operand == part { whole } else { at(operand) }))
            }
            Op::Add(x, y) | Op::Sub(x, y) => {
                let adds = matches!(op, Op::Add(..));
                let may_fuse = |x: Value, y: Value| is_exact(x) || !cancels(y) || adds && cannot_cancel(x, y);
                match (product(x).filter(|_| may_fuse(x, y)), product(y).filter(|_| may_fuse(y, x))) {
                    (Some((a, b)), other) if is_exact(x) || other.is_none() || !is_exact(y) => {
                        let addend = if adds { at(y) } else { build.neg(at(y)) };
                        build.fma(at(a), at(b), addend)
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
        values.push(value);
    }
    build.finish_as(func, &values)
}

/// The most variable quantity that a value depends on.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum DependsOn {
    /// Only parameters, the step length and constants.
    Parameters,
    /// Inputs, time or delayed samples, but no result of the previous step.
    Inputs,
    /// Results of the previous step: the loop-carried slots.
    PreviousStep,
}

/// How values depend on the previous step, and the next step on them. The condition of a select does not count: the
/// analysis assumes that a branch predictor hides its latency.
struct Dependence {
    /// For each value, what it depends on.
    depends_on: Vec<DependsOn>,
    /// For each value, whether the next step depends on it.
    is_on_chain: Vec<bool>,
}

impl Dependence {
    fn of(func: &Func, layout: &Layout) -> Dependence {
        let carried = carried(func);
        let mut depends_on: Vec<DependsOn> = Vec::with_capacity(func.ops.len());
        for op in &func.ops {
            depends_on.push(match *op {
                Op::Load(slot) if carried.contains(&slot) => DependsOn::PreviousStep,
                Op::Load(Slot::TIME | Slot::COUNT) | Op::Ring { .. } => DependsOn::Inputs,
                Op::Load(slot) if layout.inputs.contains(slot) => DependsOn::Inputs,
                op => data_operands(op)
                    .into_iter()
                    .map(|part| depends_on[part.index()])
                    .fold(DependsOn::Parameters, DependsOn::max),
            });
        }
        let mut is_on_chain = vec![false; func.ops.len()];
        let stored = func.stores.iter().filter(|(slot, _)| carried.contains(slot));
        stored.for_each(|(_, value)| is_on_chain[value.index()] = true);
        for (value, op) in func.ops.iter().enumerate().rev() {
            if is_on_chain[value] {
                data_operands(*op).into_iter().for_each(|part| is_on_chain[part.index()] = true);
            }
        }
        Dependence { depends_on, is_on_chain }
    }

    /// Whether the sum is on the loop-carried chain, and only `other` depends on the previous step: `part` is ready
    /// early.
    fn is_early_addend(&self, part: Value, other: Value, sum: usize) -> bool {
        let is_late = |value: Value| self.depends_on[value.index()] == DependsOn::PreviousStep;
        self.is_on_chain[sum] && !is_late(part) && is_late(other)
    }

    /// The factors of a product. Those that are the same in every step come first, because their product is hoisted.
    fn factors(&self, value: Value, product: &impl Fn(Value) -> Option<(Value, Value)>) -> Vec<Value> {
        let (mut open, mut factors) = (vec![value], Vec::new());
        while let Some(value) = open.pop() {
            match product(value) {
                Some((a, b)) => open.extend([b, a]),
                None => factors.push(value),
            }
        }
        factors.sort_by_key(|value| self.depends_on[value.index()]);
        factors
    }
}

/// The operands of an operation, without the condition of a select.
fn data_operands(op: Op) -> Vec<Value> {
    let mut operands = Vec::new();
    match op {
        Op::Select(_, yes, no) => operands.extend([yes, no]),
        op => op.each_operand(|operand| operands.push(operand)),
    }
    operands
}

/// The number of uses of each value, as an operand or as a result.
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

    /// Listing of the contracted function of four states, each of which becomes `f` of all four.
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
    fn a_product_and_its_sum_become_one_operation() {
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
    fn an_early_product_stays_out_of_the_loop_carried_chain() {
        // One parameter, one input, two states and one output.
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
        // The invariant factors are multiplied first: h k.
        let is_given = |value: Value| matches!(func.op(value), Op::Load(slot) if layout.inputs.contains(slot));
        let fixed = func.ops.iter().find_map(|op| match *op {
            Op::Mul(a, b) if is_given(a) || is_given(b) => Some(func.op(if is_given(a) { b } else { a })),
            _ => None,
        });
        assert!(matches!(fixed, Some(Op::Mul(..))), "{listing}");
    }

    #[test]
    fn mirror_images_are_fused_alike() {
        // With v = w y, neither v − x z nor −v − x z is fused.
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
        // The product with the sign is fused, whether it is the first or the second operand.
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
    fn products_that_may_cancel_are_not_fused() {
        for of_two in [Build::add, Build::sub] {
            let forces = contracted(|b, [x, y, z, w]| {
                let (one, other) = (b.mul(x, y), b.mul(z, w));
                // One of the two products has a second use.
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
