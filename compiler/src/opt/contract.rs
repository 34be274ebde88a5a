//! Fuses products into the sums they are for: a · b + c with one rounding, in one instruction.
//!
//! In: a step, regrouped, before elementary functions are expanded. Out: the same with fewer operations and a shorter
//! chain. This rounds differently (once instead of twice), so it is part of what a step *is*: it stands before every
//! back end. Left alone is
//!
//! - a product that something else uses too: it would be computed twice, and what is compared with it would differ from
//!   what it enters;
//! - a sum or difference of two products: forces k·a and −k·a cancel, and fused they would leave what k·a was rounded by.
//!   Squares never do; and a product with a sign is not rounded, so that the same comes out.
//!
//! Both rules look at one sum alone, so mirror images of a contact are fused alike.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value, is_not_negative, sign_of};

/// Fuses what may be.
pub fn contract(func: &Func) -> Func {
    let uses = uses(func);
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let at = |value: Value| values[value.index()];
        // The factors of a product that only this operation uses.
        let product = |value: Value| match func.op(value) {
            Op::Mul(a, b) if uses[value.index()] == 1 => Some((at(a), at(b))),
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
        let fused = match *op {
            Op::Add(x, y) | Op::Sub(x, y) => {
                let adds = matches!(op, Op::Add(..));
                let fits = |x: Value, y: Value| is_exact(x) || !cancels(y) || adds && grows(x, y);
                match (product(x).filter(|_| fits(x, y)), product(y).filter(|_| fits(y, x))) {
                    (Some((a, b)), other) if is_exact(x) || other.is_none() || !is_exact(y) => {
                        let rest = if adds { at(y) } else { build.neg(at(y)) };
                        Some(build.fma(a, b, rest))
                    }
                    (_, Some((a, b))) => {
                        let a = if adds { a } else { build.neg(a) };
                        Some(build.fma(a, b, at(x)))
                    }
                    _ => None,
                }
            }
            _ => None,
        };
        let op = op.map(at);
        values.push(fused.unwrap_or_else(|| build.op(op)));
    }
    build.finish_as(func, &values)
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
    use abi::Layout;

    /// The operations of a function of four states whose first it changes to `f` of them.
    fn contracted(f: impl Fn(&mut Build, [Value; 4]) -> Value) -> String {
        let layout = Layout::new([0, 0, 4, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("step");
        let x: [Value; 4] = std::array::from_fn(|k| build.load(layout.states.slot(k)));
        let y = f(&mut build, x);
        build.store(layout.states.slot(0), y);
        contract(&build.finish()).to_string()
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
