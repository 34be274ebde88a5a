//! The meaning of every operation, on bits: constant folding, the interpreter and every back end agree with it.

use super::{Op, Value};

/// Evaluates `op` on the bits of its operands, and returns the bits of the result. A real is IEEE 754 binary64, an
/// integer is two's complement, true is 1 and false is 0. `None` for operations that read the block or the pool, and
/// for elementary functions.
///
/// A NaN result may have any payload and sign, because all NaN count as one value.
#[inline(always)]
pub fn evaluate(op: Op, bits: impl Fn(Value) -> u64) -> Option<u64> {
    let real = |value| f64::from_bits(bits(value));
    let int = |value| bits(value) as i64;
    let truth = |value| bits(value) != 0;
    Some(match op {
        Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } | Op::Unary(..) | Op::Binary(..) => return None,
        Op::Real(constant) => constant,
        Op::Int(constant) => constant as u64,
        Op::Bool(constant) => constant.into(),
        Op::Add(a, b) => (real(a) + real(b)).to_bits(),
        Op::Sub(a, b) => (real(a) - real(b)).to_bits(),
        Op::Mul(a, b) => (real(a) * real(b)).to_bits(),
        Op::Div(a, b) => (real(a) / real(b)).to_bits(),
        Op::Neg(a) => (-real(a)).to_bits(),
        Op::Abs(a) => real(a).abs().to_bits(),
        Op::Sqrt(a) => real(a).sqrt().to_bits(),
        Op::Fma(a, b, c) => real(a).mul_add(real(b), real(c)).to_bits(),
        Op::Floor(a) => real(a).floor().to_bits(),
        Op::Nearest(a) => real(a).round_ties_even().to_bits(),
        Op::Less(a, b) => (real(a) < real(b)).into(),
        Op::LessEqual(a, b) => (real(a) <= real(b)).into(),
        Op::Equal(a, b) => (real(a) == real(b)).into(),
        Op::And(a, b) => (truth(a) & truth(b)).into(),
        Op::Or(a, b) => (truth(a) | truth(b)).into(),
        Op::Not(a) => (!truth(a)).into(),
        Op::Select(a, b, c) => bits(if truth(a) { b } else { c }),
        Op::IntAdd(a, b) => bits(a).wrapping_add(bits(b)),
        Op::IntSub(a, b) => bits(a).wrapping_sub(bits(b)),
        Op::IntMul(a, b) => bits(a).wrapping_mul(bits(b)),
        Op::IntAnd(a, b) => bits(a) & bits(b),
        Op::IntOr(a, b) => bits(a) | bits(b),
        Op::IntXor(a, b) => bits(a) ^ bits(b),
        Op::ShiftLeft(a, n) => bits(a) << n,
        Op::ShiftRight(a, n) => bits(a) >> n,
        Op::ShiftRightSigned(a, n) => (int(a) >> n) as u64,
        Op::IntLess(a, b) => (int(a) < int(b)).into(),
        Op::IntEqual(a, b) => (bits(a) == bits(b)).into(),
        Op::ToBits(a) | Op::FromBits(a) => bits(a),
        Op::ToInt(a) => real(a) as i64 as u64,
        Op::ToReal(a) => (int(a) as f64).to_bits(),
    })
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
