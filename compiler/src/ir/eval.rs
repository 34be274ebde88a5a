//! The meaning of every operation, on bits: constant folding, the interpreter and every back end agree with it.

use super::{Op, Value};
use std::array::from_fn;

/// Evaluates `op` on the bits of its operands, and returns the bits of the result. A real is IEEE 754 binary64, an
/// integer is two's complement, true is 1 and false is 0. `None` for operations that read the block or the pool, and
/// for elementary functions.
///
/// A NaN result may have any payload and sign, because all NaN count as one value.
#[inline(always)]
pub fn evaluate(op: Op, bits: impl Fn(Value) -> u64) -> Option<u64> {
    evaluate_each(op, |value| [bits(value)]).map(|[result]| result)
}

/// The same for `N` blocks at once: an operand has its bits in each of them.
#[inline(always)]
pub fn evaluate_each<const N: usize>(op: Op, bits: impl Fn(Value) -> [u64; N]) -> Option<[u64; N]> {
    match op {
        Op::Real(constant) => Some([constant; N]),
        Op::Int(constant) => Some([constant as u64; N]),
        Op::Bool(constant) => Some([constant.into(); N]),
        op => apply(op, InEachBlock(bits)),
    }
}

/// Where the operands of operations are read, and what becomes of their results.
pub(crate) trait Operands {
    /// What an application returns.
    type Results;
    /// Applies the meaning of an operation with one operand.
    fn one(self, operand: Value, meaning: impl Fn(u64) -> u64) -> Self::Results;
    /// With two.
    fn two(self, operands: [Value; 2], meaning: impl Fn(u64, u64) -> u64) -> Self::Results;
    /// With three.
    fn three(self, operands: [Value; 3], meaning: impl Fn(u64, u64, u64) -> u64) -> Self::Results;
}

/// Applies the meaning of `op` to operands. `None` for constants, for operations that read the block or the pool, and for
/// elementary functions.
#[inline(always)]
pub(crate) fn apply<T>(op: Op, to: impl Operands<Results = T>) -> Option<T> {
    let real = f64::from_bits;
    let int = |bits: u64| bits as i64;
    Some(match op {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) => return None,
        Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } | Op::Unary(..) | Op::Binary(..) => return None,
        Op::Add(a, b) => to.two([a, b], |a, b| (real(a) + real(b)).to_bits()),
        Op::Sub(a, b) => to.two([a, b], |a, b| (real(a) - real(b)).to_bits()),
        Op::Mul(a, b) => to.two([a, b], |a, b| (real(a) * real(b)).to_bits()),
        Op::Div(a, b) => to.two([a, b], |a, b| (real(a) / real(b)).to_bits()),
        Op::Neg(a) => to.one(a, |a| (-real(a)).to_bits()),
        Op::Abs(a) => to.one(a, |a| real(a).abs().to_bits()),
        Op::Sqrt(a) => to.one(a, |a| real(a).sqrt().to_bits()),
        Op::Fma(a, b, c) => to.three([a, b, c], |a, b, c| real(a).mul_add(real(b), real(c)).to_bits()),
        Op::Floor(a) => to.one(a, |a| real(a).floor().to_bits()),
        Op::Nearest(a) => to.one(a, |a| real(a).round_ties_even().to_bits()),
        Op::Less(a, b) => to.two([a, b], |a, b| (real(a) < real(b)).into()),
        Op::LessEqual(a, b) => to.two([a, b], |a, b| (real(a) <= real(b)).into()),
        Op::Equal(a, b) => to.two([a, b], |a, b| (real(a) == real(b)).into()),
        Op::And(a, b) => to.two([a, b], |a, b| a & b),
        Op::Or(a, b) => to.two([a, b], |a, b| a | b),
        Op::Not(a) => to.one(a, |a| a ^ 1),
        Op::Select(a, b, c) => to.three([a, b, c], |a, b, c| if a != 0 { b } else { c }),
        Op::IntAdd(a, b) => to.two([a, b], u64::wrapping_add),
        Op::IntSub(a, b) => to.two([a, b], u64::wrapping_sub),
        Op::IntMul(a, b) => to.two([a, b], u64::wrapping_mul),
        Op::IntAnd(a, b) => to.two([a, b], |a, b| a & b),
        Op::IntOr(a, b) => to.two([a, b], |a, b| a | b),
        Op::IntXor(a, b) => to.two([a, b], |a, b| a ^ b),
        Op::ShiftLeft(a, n) => to.one(a, |a| a << n),
        Op::ShiftRight(a, n) => to.one(a, |a| a >> n),
        Op::ShiftRightSigned(a, n) => to.one(a, |a| (int(a) >> n) as u64),
        Op::IntLess(a, b) => to.two([a, b], |a, b| (int(a) < int(b)).into()),
        Op::IntEqual(a, b) => to.two([a, b], |a, b| (a == b).into()),
        Op::ToBits(a) | Op::FromBits(a) => to.one(a, |a| a),
        Op::ToInt(a) => to.one(a, |a| real(a) as i64 as u64),
        Op::ToReal(a) => to.one(a, |a| (int(a) as f64).to_bits()),
    })
}

/// The operands of one operation, with their bits in each of `N` blocks.
struct InEachBlock<F>(F);

impl<const N: usize, F: Fn(Value) -> [u64; N]> Operands for InEachBlock<F> {
    type Results = [u64; N];

    #[inline(always)]
    fn one(self, a: Value, meaning: impl Fn(u64) -> u64) -> [u64; N] {
        let a = self.0(a);
        from_fn(|block| meaning(a[block]))
    }

    #[inline(always)]
    fn two(self, [a, b]: [Value; 2], meaning: impl Fn(u64, u64) -> u64) -> [u64; N] {
        let (a, b) = (self.0(a), self.0(b));
        from_fn(|block| meaning(a[block], b[block]))
    }

    #[inline(always)]
    fn three(self, [a, b, c]: [Value; 3], meaning: impl Fn(u64, u64, u64) -> u64) -> [u64; N] {
        let (a, b, c) = (self.0(a), self.0(b), self.0(c));
        from_fn(|block| meaning(a[block], b[block], c[block]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conversions_saturate_and_nan_is_zero() {
        let to_int = |x: f64| evaluate(Op::ToInt(Value(0)), |_| x.to_bits()).unwrap() as i64;
        assert_eq!(to_int(-1.9), -1);
        assert_eq!(to_int(f64::NAN), 0);
        assert_eq!(to_int(1e300), i64::MAX);
        assert_eq!(to_int(-1e300), i64::MIN);
    }

    #[test]
    fn whole_numbers_round_to_even() {
        let nearest = |x: f64| f64::from_bits(evaluate(Op::Nearest(Value(0)), |_| x.to_bits()).unwrap());
        assert_eq!([0.5, 1.5, 2.5, -0.5].map(nearest).map(f64::to_bits), [0.0, 2.0, 2.0, -0.0].map(f64::to_bits));
    }
}
