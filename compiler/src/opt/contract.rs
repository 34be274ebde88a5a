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
use crate::ir::variance::{self, Variance};
use crate::ir::{Func, Op, Value, is_not_negative, sign_of};
use crate::opt::reassociate::carried;
use crate::opt::twins::Twins;
use abi::Layout;

/// Fuses every product that may be fused. `layout`: the block that the function works on.
pub fn contract(func: &Func, layout: &Layout) -> Func {
    let (uses, chain) = (uses(func), Dependence::of(func, layout));
    let mut build = Build::roomy(&func.name, func.ops.len());
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
    let mut twins = Twins::of(func);
    for (sum, op) in func.ops.iter().enumerate() {
        if let Some(twin) = twins.copy(&values, &mut build) {
            values.push(twin);
            continue;
        }
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

/// How values depend on the previous step, and the next step on them. The condition of a select does not count: the
/// analysis assumes that a branch predictor hides its latency.
struct Dependence {
    /// The variance of each value.
    variance: Vec<Variance>,
    /// For each value, whether the next step depends on it.
    is_on_chain: Vec<bool>,
}

impl Dependence {
    fn of(func: &Func, layout: &Layout) -> Dependence {
        let carried = carried(func);
        let mut is_on_chain = vec![false; func.ops.len()];
        let stored = func.stores.iter().filter(|(slot, _)| carried.contains(slot));
        stored.for_each(|(_, value)| is_on_chain[value.index()] = true);
        for (value, op) in func.ops.iter().enumerate().rev() {
            if is_on_chain[value] {
                op.each_data_operand(|part| is_on_chain[part.index()] = true);
            }
        }
        Dependence { variance: variance::of_data(func, layout), is_on_chain }
    }

    /// Whether the sum is on the loop-carried chain, and only `other` depends on the previous step: `part` is ready
    /// early.
    fn is_early_addend(&self, part: Value, other: Value, sum: usize) -> bool {
        let is_late = |value: Value| self.variance[value.index()] == Variance::State;
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
        factors.sort_by_key(|value| match self.variance[value.index()] {
            Variance::Parameters => 0,
            Variance::Inputs | Variance::Time | Variance::Samples => 1,
            Variance::State => 2,
        });
        factors
    }
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
