//! Text listing of a function, one operation per line.
//!
//! ```text
//! step:
//!   v0 = load 4
//!   v1 = 0.5
//!   v2 = mul v0 v1
//!   store 4 = v2
//! ```
//!
//! The listing is exact: [`parse`](super::parse::parse) reads it back. Reals have as many digits as identify them; a NaN
//! other than `f64::NAN` shows its bits.

use super::{Func, Op, Value, Write};
use std::fmt;

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "v{}", self.0)
    }
}

impl fmt::Display for Op {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match *self {
            Op::Real(bits) => match f64::from_bits(bits) {
                number if number.is_nan() && bits != f64::NAN.to_bits() => write!(f, "NaN {bits:#x}"),
                number => write!(f, "{number:?}"),
            },
            Op::Int(n) => write!(f, "int {n}"),
            Op::Bool(b) => write!(f, "{b}"),
            Op::Load(slot) => write!(f, "load {}", slot.0),
            Op::Pool { base, len, index } => write!(f, "pool {base}[{index} < {len}]"),
            Op::Ring { base, len, index } => write!(f, "ring {}[{index} < {len}]", base.0),
            Op::Add(a, b) => write!(f, "add {a} {b}"),
            Op::Sub(a, b) => write!(f, "sub {a} {b}"),
            Op::Mul(a, b) => write!(f, "mul {a} {b}"),
            Op::Div(a, b) => write!(f, "div {a} {b}"),
            Op::Neg(a) => write!(f, "neg {a}"),
            Op::Abs(a) => write!(f, "abs {a}"),
            Op::Sqrt(a) => write!(f, "sqrt {a}"),
            Op::Fma(a, b, c) => write!(f, "fma {a} {b} {c}"),
            Op::Floor(a) => write!(f, "floor {a}"),
            Op::Nearest(a) => write!(f, "nearest {a}"),
            Op::Unary(function, a) => write!(f, "{} {a}", function.name()),
            Op::Binary(function, a, b) => write!(f, "{} {a} {b}", function.name()),
            Op::Less(a, b) => write!(f, "less {a} {b}"),
            Op::LessEqual(a, b) => write!(f, "less_equal {a} {b}"),
            Op::Equal(a, b) => write!(f, "equal {a} {b}"),
            Op::And(a, b) => write!(f, "and {a} {b}"),
            Op::Or(a, b) => write!(f, "or {a} {b}"),
            Op::Not(a) => write!(f, "not {a}"),
            Op::Select(a, b, c) => write!(f, "select {a} {b} {c}"),
            Op::IntAdd(a, b) => write!(f, "int_add {a} {b}"),
            Op::IntSub(a, b) => write!(f, "int_sub {a} {b}"),
            Op::IntMul(a, b) => write!(f, "int_mul {a} {b}"),
            Op::IntAnd(a, b) => write!(f, "int_and {a} {b}"),
            Op::IntOr(a, b) => write!(f, "int_or {a} {b}"),
            Op::IntXor(a, b) => write!(f, "int_xor {a} {b}"),
            Op::ShiftLeft(a, n) => write!(f, "shift_left {a} {n}"),
            Op::ShiftRight(a, n) => write!(f, "shift_right {a} {n}"),
            Op::ShiftRightSigned(a, n) => write!(f, "shift_right_signed {a} {n}"),
            Op::IntLess(a, b) => write!(f, "int_less {a} {b}"),
            Op::IntEqual(a, b) => write!(f, "int_equal {a} {b}"),
            Op::ToBits(a) => write!(f, "to_bits {a}"),
            Op::FromBits(a) => write!(f, "from_bits {a}"),
            Op::ToInt(a) => write!(f, "to_int {a}"),
            Op::ToReal(a) => write!(f, "to_real {a}"),
        }
    }
}

impl fmt::Display for Func {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}:", self.name)?;
        for (i, op) in self.ops.iter().enumerate() {
            writeln!(f, "  v{i} = {op}")?;
        }
        for (slot, value) in &self.stores {
            writeln!(f, "  store {} = {value}", slot.0)?;
        }
        for Write { base, len, index, value } in &self.writes {
            writeln!(f, "  write {}[{index} < {len}] = {value}", base.0)?;
        }
        match self.status {
            Some(status) => writeln!(f, "  status {status}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Unary;
    use abi::Slot;

    #[test]
    fn a_listing_reads_as_the_program() {
        let func = Func {
            name: "step".into(),
            ops: vec![
                Op::Load(Slot(4)),
                Op::Real(0.5f64.to_bits()),
                Op::Mul(Value(0), Value(1)),
                Op::Unary(Unary::Exp, Value(2)),
                Op::Int(0),
                Op::Pool { base: 8, len: 3, index: Value(4) },
            ],
            writes: Vec::new(),
            stores: vec![(Slot(4), Value(3)), (Slot(5), Value(5))],
            status: Some(Value(4)),
        };
        let listing = "\
step:
  v0 = load 4
  v1 = 0.5
  v2 = mul v0 v1
  v3 = exp v2
  v4 = int 0
  v5 = pool 8[v4 < 3]
  store 4 = v3
  store 5 = v5
  status v4
";
        assert_eq!(func.to_string(), listing);
    }
}
