//! The meaning of every operation, on bits: constant folding, the interpreter and every back end agree with it.

use super::{Op, Value};

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
    /// Evaluates an expression of the bits of operands in each block.
    macro_rules! each {
        ($($operand:ident),* => $result:expr) => {{
            $(let $operand = bits($operand);)*
            let mut results = [0; N];
            for (block, result) in results.iter_mut().enumerate() {
                $(let $operand = $operand[block];)*
                *result = $result;
            }
            results
        }};
    }
    let real = f64::from_bits;
    let int = |bits: u64| bits as i64;
    Some(match op {
        Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } | Op::Unary(..) | Op::Binary(..) => return None,
        Op::Real(constant) => [constant; N],
        Op::Int(constant) => [constant as u64; N],
        Op::Bool(constant) => [constant.into(); N],
        Op::Add(a, b) => each!(a, b => (real(a) + real(b)).to_bits()),
        Op::Sub(a, b) => each!(a, b => (real(a) - real(b)).to_bits()),
        Op::Mul(a, b) => each!(a, b => (real(a) * real(b)).to_bits()),
        Op::Div(a, b) => each!(a, b => (real(a) / real(b)).to_bits()),
        Op::Neg(a) => each!(a => (-real(a)).to_bits()),
        Op::Abs(a) => each!(a => real(a).abs().to_bits()),
        Op::Sqrt(a) => each!(a => real(a).sqrt().to_bits()),
        Op::Fma(a, b, c) => each!(a, b, c => real(a).mul_add(real(b), real(c)).to_bits()),
        Op::Floor(a) => each!(a => real(a).floor().to_bits()),
        Op::Nearest(a) => each!(a => real(a).round_ties_even().to_bits()),
        Op::Less(a, b) => each!(a, b => (real(a) < real(b)).into()),
        Op::LessEqual(a, b) => each!(a, b => (real(a) <= real(b)).into()),
        Op::Equal(a, b) => each!(a, b => (real(a) == real(b)).into()),
        Op::And(a, b) => each!(a, b => a & b),
        Op::Or(a, b) => each!(a, b => a | b),
        Op::Not(a) => each!(a => a ^ 1),
        Op::Select(a, b, c) => each!(a, b, c => if a != 0 { b } else { c }),
        Op::IntAdd(a, b) => each!(a, b => a.wrapping_add(b)),
        Op::IntSub(a, b) => each!(a, b => a.wrapping_sub(b)),
        Op::IntMul(a, b) => each!(a, b => a.wrapping_mul(b)),
        Op::IntAnd(a, b) => each!(a, b => a & b),
        Op::IntOr(a, b) => each!(a, b => a | b),
        Op::IntXor(a, b) => each!(a, b => a ^ b),
        Op::ShiftLeft(a, n) => each!(a => a << n),
        Op::ShiftRight(a, n) => each!(a => a >> n),
        Op::ShiftRightSigned(a, n) => each!(a => (int(a) >> n) as u64),
        Op::IntLess(a, b) => each!(a, b => (int(a) < int(b)).into()),
        Op::IntEqual(a, b) => each!(a, b => (a == b).into()),
        Op::ToBits(a) | Op::FromBits(a) => bits(a),
        Op::ToInt(a) => each!(a => real(a) as i64 as u64),
        Op::ToReal(a) => each!(a => (int(a) as f64).to_bits()),
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
