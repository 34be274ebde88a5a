//! The straight-line program: a list of typed operations, each a value; no loops, no blocks, no calls.
//!
//! So the interpreter, the derivative pass and every back end are one `match` in one pass over the list.
//! After `lower` there are no units here, and names serve only printing.

pub mod build;
pub mod print;
pub mod verify;

use abi::Slot;

/// The result of the operation of this number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Value(pub u32);

impl Value {
    /// As an index of [`Func::ops`].
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// The type of a value.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Type {
    /// 64-bit float.
    Real,
    /// 64-bit integer, wrapping; only inside expanded functions, tables and counters.
    Int,
    /// True or false.
    Bool,
}

/// Elementary functions of one argument. [`expand`](crate::math) turns them into arithmetic before any back end.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum Unary {
    Exp,
    Expm1,
    Log,
    Log1p,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Sinh,
    Cosh,
    Tanh,
}

/// Elementary functions of two arguments.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum Binary {
    /// `atan2(y, x)`
    Atan2,
    /// `a ^ b`
    Pow,
    Hypot,
}

/// One operation. Operands are values of earlier operations.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Op {
    /// A real constant, by its bits, so that operations can be compared and hashed.
    Real(u64),
    /// An integer constant.
    Int(i64),
    /// A Boolean constant.
    Bool(bool),
    /// The value of a slot when the function begins.
    Load(Slot),
    /// `pool[base + min(index as unsigned, len − 1)]`: a table. `index` is an integer.
    Pool {
        /// First entry.
        base: u32,
        /// Number of entries, at least 1.
        len: u32,
        /// Which.
        index: Value,
    },

    /// a + b, rounded once.
    Add(Value, Value),
    /// a − b
    Sub(Value, Value),
    /// a · b
    Mul(Value, Value),
    /// a / b
    Div(Value, Value),
    /// −a: flips the sign, of zeros and NaN too.
    Neg(Value),
    /// |a|
    Abs(Value),
    /// √a, correctly rounded.
    Sqrt(Value),
    /// a · b + c, rounded once.
    Fma(Value, Value, Value),
    /// Largest whole number not above a.
    Floor(Value),
    /// Nearest whole number, ties to even.
    Nearest(Value),

    /// An elementary function, before expansion.
    Unary(Unary, Value),
    /// An elementary function, before expansion.
    Binary(Binary, Value, Value),

    /// a < b; false if either is NaN.
    Less(Value, Value),
    /// a ≤ b; false if either is NaN.
    LessEqual(Value, Value),
    /// a = b; −0 = 0; false if either is NaN.
    Equal(Value, Value),

    /// Both.
    And(Value, Value),
    /// Either.
    Or(Value, Value),
    /// Not.
    Not(Value),
    /// If the first (a Boolean) then the second else the third, of any one type.
    Select(Value, Value, Value),

    /// Wrapping sum of integers.
    IntAdd(Value, Value),
    /// Wrapping difference.
    IntSub(Value, Value),
    /// Wrapping product.
    IntMul(Value, Value),
    /// Bitwise and.
    IntAnd(Value, Value),
    /// Bitwise or.
    IntOr(Value, Value),
    /// Bitwise exclusive or.
    IntXor(Value, Value),
    /// Shift left by a constant 0..=63.
    ShiftLeft(Value, u8),
    /// Shift right by a constant 0..=63, zeros come in.
    ShiftRight(Value, u8),
    /// Shift right by a constant 0..=63, the sign comes in.
    ShiftRightSigned(Value, u8),
    /// Signed comparison of integers.
    IntLess(Value, Value),
    /// Equality of integers.
    IntEqual(Value, Value),
    /// The bits of a real as an integer.
    ToBits(Value),
    /// The real of these bits.
    FromBits(Value),
    /// A real, truncated towards zero; NaN gives 0, what is too large the nearest integer.
    ToInt(Value),
    /// An integer, rounded to the nearest real.
    ToReal(Value),
}

/// A straight-line function over a block of slots: first all loads, then the operations, then all stores.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Func {
    /// For listings.
    pub name: String,
    /// In order; operands stand before their users.
    pub ops: Vec<Op>,
    /// What is written, each slot at most once, all at the end.
    pub stores: Vec<(Slot, Value)>,
    /// An integer: 0, or the number of the guard that failed. None: always 0.
    pub status: Option<Value>,
}
