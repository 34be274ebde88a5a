//! The intermediate representation (IR): a straight-line program in static single assignment form.
//!
//! A function is a list of typed operations, and each operation defines one value. There are no loops, basic blocks or
//! calls, so the interpreter, automatic differentiation and every back end walk the list once and match on the
//! operation. After `lower` the IR has no units; names are only used for printing.

pub mod hash;
pub mod scc;
pub mod print;
pub mod parse;
pub mod verify;
pub mod eval;
pub mod build;
pub mod partial_eval;
pub mod value_map;
pub mod variance;
pub mod cfg;
pub mod cfg_text;
pub mod cfg_verify;
pub mod expr;
pub mod interpret;
pub mod program;
pub mod random;

pub use crate::functions::{Binary, Unary};
use abi::Slot;

/// The result of the operation with this number.
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
    /// A 64-bit float.
    Real,
    /// A 64-bit integer that wraps. Only expanded functions, tables and counters use it.
    Int,
    /// A Boolean.
    Bool,
}

/// An operation. Its operands are values of earlier operations.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Op {
    /// A real constant, stored as bits so that operations can be compared and hashed.
    Real(u64),
    /// An integer constant.
    Int(i64),
    /// A Boolean constant.
    Bool(bool),
    /// The value of a slot at the start of the function.
    Load(Slot),
    /// A table in the pool: `pool[base + min(index as unsigned, len − 1)]`. `index` is an integer.
    Pool {
        /// First entry.
        base: u32,
        /// Number of entries, at least 1.
        len: u32,
        /// Entry to read, from 0.
        index: Value,
    },
    /// A ring buffer of samples: slot `base + min(index as unsigned, len − 1)` at the start of the function. `index` is
    /// an integer. Only [`Write`]s may change the slots of a ring; no load and no store of the function accesses them.
    Ring {
        /// First slot.
        base: Slot,
        /// Number of slots, at least 1.
        len: u32,
        /// Slot to read, from 0.
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
    /// −a: flips the sign, also of zeros and NaN.
    Neg(Value),
    /// |a|
    Abs(Value),
    /// √a, correctly rounded.
    Sqrt(Value),
    /// a · b + c, rounded once.
    Fma(Value, Value, Value),
    /// ⌊a⌋: the largest integer that is at most a, as a real.
    Floor(Value),
    /// a rounded to the nearest integer, ties to even, as a real.
    Nearest(Value),

    /// An elementary function of one argument, until it is expanded.
    Unary(Unary, Value),
    /// An elementary function of two arguments, until it is expanded.
    Binary(Binary, Value, Value),

    /// a < b; false if either is NaN.
    Less(Value, Value),
    /// a ≤ b; false if either is NaN.
    LessEqual(Value, Value),
    /// a = b, where −0 = 0; false if either is NaN.
    Equal(Value, Value),

    /// Logical and.
    And(Value, Value),
    /// Logical or.
    Or(Value, Value),
    /// Logical negation.
    Not(Value),
    /// If the first operand (a Boolean) is true then the second, else the third. Both have the same type.
    Select(Value, Value, Value),

    /// Wrapping sum of integers.
    IntAdd(Value, Value),
    /// Wrapping difference of integers.
    IntSub(Value, Value),
    /// Wrapping product of integers.
    IntMul(Value, Value),
    /// Bitwise and.
    IntAnd(Value, Value),
    /// Bitwise or.
    IntOr(Value, Value),
    /// Bitwise exclusive or.
    IntXor(Value, Value),
    /// Shift left by a constant 0..=63.
    ShiftLeft(Value, u8),
    /// Logical shift right by a constant 0..=63.
    ShiftRight(Value, u8),
    /// Arithmetic shift right by a constant 0..=63.
    ShiftRightSigned(Value, u8),
    /// Signed comparison of integers.
    IntLess(Value, Value),
    /// Equality of integers.
    IntEqual(Value, Value),
    /// The bits of a real as an integer.
    ToBits(Value),
    /// The real with these bits.
    FromBits(Value),
    /// A real truncated towards zero. NaN becomes 0; a real out of range becomes the nearest integer.
    ToInt(Value),
    /// An integer rounded to the nearest real.
    ToReal(Value),
}

/// Whether the form of a value shows that it is at most 0, or NaN: −|a|, −(a · a), −|a|^b, min(a, 0), and so on. `op`:
/// the operation that defines a value.
pub fn is_not_positive(value: Value, op: impl Fn(Value) -> Op) -> bool {
    match op(value) {
        Op::Neg(size) => is_not_negative(size, op),
        Op::Select(below, a, zero) => op(zero) == Op::Real(0) && op(below) == Op::Less(a, zero),
        _ => false,
    }
}

/// Whether the form of a value shows that it is +0, positive or NaN. `op`: the operation that defines a value.
pub fn is_not_negative(value: Value, op: impl Fn(Value) -> Op) -> bool {
    match op(value) {
        Op::Abs(_) | Op::Unary(Unary::Exp | Unary::Cosh, _) => true,
        Op::Mul(a, b) if a == b => true,
        Op::Real(bits) => bits >> 63 == 0,
        // A power has no negative sign if its base has none.
        Op::Binary(Binary::Pow, a, _) => is_not_negative(a, op),
        _ => false,
    }
}

/// If an operation computes the sign of a value x, returns x. The form is that of [`Build::sign`](build::Build::sign):
/// 1, −1, and 0 · x for x = ±0 and NaN, which equals x. `op`: the operation that defines a value.
pub fn sign_of(sign: Op, op: impl Fn(Value) -> Op) -> Option<Value> {
    let is = |value: Value, number: f64| op(value) == Op::Real(number.to_bits());
    let Op::Select(positive, one, rest) = sign else { return None };
    let (Op::Less(zero, x), Op::Select(negative, minus_one, rest)) = (op(positive), op(rest)) else { return None };
    let (Op::Less(y, other), Op::Mul(a, b)) = (op(negative), op(rest)) else { return None };
    let alike = is(zero, 0.0) && other == zero && y == x && [(zero, x), (x, zero)].contains(&(a, b));
    (alike && is(one, 1.0) && is(minus_one, -1.0)).then_some(x)
}

/// If an operation tests whether a slot equals a constant, returns the load, its slot and the bits of the constant.
/// `op`: the operation that defines a value.
pub fn number_asked(asked: Op, op: impl Fn(Value) -> Op) -> Option<(Value, Slot, u64)> {
    let Op::Equal(a, b) = asked else { return None };
    [(a, b), (b, a)].into_iter().find_map(|(load, number)| match (op(load), op(number)) {
        (Op::Load(slot), Op::Real(bits)) => Some((load, slot, bits)),
        _ => None,
    })
}

/// The values that must be available to compute an operation. The bits of a table entry are loaded directly, so they only
/// need the index.
pub fn reads(ops: &[Op], op: Op) -> impl Iterator<Item = Value> + use<> {
    let mut operands = [None; 3];
    let mut n = 0;
    let op = match op {
        Op::ToBits(table) if let entry @ Op::Pool { .. } = ops[table.index()] => entry,
        op => op,
    };
    op.each_operand(|operand| {
        operands[n] = Some(operand);
        n += 1;
    });
    operands.into_iter().flatten()
}

/// For each operation, whether one of these values needs it.
pub fn live(ops: &[Op], values: impl Iterator<Item = Value>) -> Vec<bool> {
    let mut live = vec![false; ops.len()];
    values.for_each(|value| live[value.index()] = true);
    for i in (0..ops.len()).rev() {
        if live[i] {
            ops[i].each_operand(|operand| live[operand.index()] = true);
        }
    }
    live
}

/// A write to slot `base + min(index as unsigned, len − 1)` of a ring buffer, after all stores.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Write {
    /// First slot of the ring.
    pub base: Slot,
    /// Number of its slots, at least 1.
    pub len: u32,
    /// The slot to write, from 0: an integer.
    pub index: Value,
    /// The real to write.
    pub value: Value,
}

/// A straight-line function over a block of slots. It behaves as if it performed all loads first and all stores last.
#[derive(Clone, PartialEq, Hash, Debug, Default)]
pub struct Func {
    /// The name in listings.
    pub name: String,
    /// The operations; operands precede their users.
    pub ops: Vec<Op>,
    /// The stores at the end of the function, at most one per slot.
    pub stores: Vec<(Slot, Value)>,
    /// The writes to ring buffers, after the stores.
    pub writes: Vec<Write>,
    /// The status, an integer: 0, or the number of the guard that failed. `None`: always 0.
    pub status: Option<Value>,
}

impl Write {
    /// The same write with its values mapped by `f`.
    pub fn map(self, f: impl Fn(Value) -> Value) -> Write {
        Write { index: f(self.index), value: f(self.value), ..self }
    }
}

impl Op {
    /// Approximate cost, in instructions that take one cycle. Only the order of magnitude matters.
    pub fn effort(self) -> u32 {
        match self {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => 0,
            Op::Div(..) | Op::Sqrt(_) => 5,
            Op::Pool { .. } | Op::Ring { .. } => 2,
            _ => 1,
        }
    }

    /// The operation with the operands of a commutative one sorted, so that equal operations compare equal.
    pub fn ordered(self) -> Op {
        let sort = |a: Value, b: Value| if a <= b { (a, b) } else { (b, a) };
        macro_rules! sorted {
            ($($name:ident)*) => {
                match self {
                    $(Op::$name(a, b) => { let (a, b) = sort(a, b); Op::$name(a, b) })*
                    Op::Fma(a, b, c) => { let (a, b) = sort(a, b); Op::Fma(a, b, c) }
                    other => other,
                }
            };
        }
        sorted!(Add Mul Equal And Or IntAdd IntMul IntAnd IntOr IntXor IntEqual)
    }

    /// Whether it is a constant.
    pub fn is_constant(self) -> bool {
        matches!(self, Op::Real(_) | Op::Int(_) | Op::Bool(_))
    }

    /// The same operation with its operands mapped by `f`, from left to right.
    pub fn map(self, mut f: impl FnMut(Value) -> Value) -> Op {
        match self {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => self,
            Op::Pool { base, len, index } => Op::Pool { base, len, index: f(index) },
            Op::Ring { base, len, index } => Op::Ring { base, len, index: f(index) },
            Op::Add(a, b) => Op::Add(f(a), f(b)),
            Op::Sub(a, b) => Op::Sub(f(a), f(b)),
            Op::Mul(a, b) => Op::Mul(f(a), f(b)),
            Op::Div(a, b) => Op::Div(f(a), f(b)),
            Op::Neg(a) => Op::Neg(f(a)),
            Op::Abs(a) => Op::Abs(f(a)),
            Op::Sqrt(a) => Op::Sqrt(f(a)),
            Op::Fma(a, b, c) => Op::Fma(f(a), f(b), f(c)),
            Op::Floor(a) => Op::Floor(f(a)),
            Op::Nearest(a) => Op::Nearest(f(a)),
            Op::Unary(function, a) => Op::Unary(function, f(a)),
            Op::Binary(function, a, b) => Op::Binary(function, f(a), f(b)),
            Op::Less(a, b) => Op::Less(f(a), f(b)),
            Op::LessEqual(a, b) => Op::LessEqual(f(a), f(b)),
            Op::Equal(a, b) => Op::Equal(f(a), f(b)),
            Op::And(a, b) => Op::And(f(a), f(b)),
            Op::Or(a, b) => Op::Or(f(a), f(b)),
            Op::Not(a) => Op::Not(f(a)),
            Op::Select(a, b, c) => Op::Select(f(a), f(b), f(c)),
            Op::IntAdd(a, b) => Op::IntAdd(f(a), f(b)),
            Op::IntSub(a, b) => Op::IntSub(f(a), f(b)),
            Op::IntMul(a, b) => Op::IntMul(f(a), f(b)),
            Op::IntAnd(a, b) => Op::IntAnd(f(a), f(b)),
            Op::IntOr(a, b) => Op::IntOr(f(a), f(b)),
            Op::IntXor(a, b) => Op::IntXor(f(a), f(b)),
            Op::ShiftLeft(a, n) => Op::ShiftLeft(f(a), n),
            Op::ShiftRight(a, n) => Op::ShiftRight(f(a), n),
            Op::ShiftRightSigned(a, n) => Op::ShiftRightSigned(f(a), n),
            Op::IntLess(a, b) => Op::IntLess(f(a), f(b)),
            Op::IntEqual(a, b) => Op::IntEqual(f(a), f(b)),
            Op::ToBits(a) => Op::ToBits(f(a)),
            Op::FromBits(a) => Op::FromBits(f(a)),
            Op::ToInt(a) => Op::ToInt(f(a)),
            Op::ToReal(a) => Op::ToReal(f(a)),
        }
    }

    /// Calls `f` for each operand, from left to right.
    pub fn each_operand(self, mut f: impl FnMut(Value)) {
        self.map(|value| {
            f(value);
            value
        });
    }
}

impl Op {
    /// Calls `f` for each operand except the condition of a select.
    pub fn each_data_operand(self, mut f: impl FnMut(Value)) {
        match self {
            Op::Select(_, yes, no) => [yes, no].into_iter().for_each(f),
            op => op.each_operand(&mut f),
        }
    }
}

impl Func {
    /// The operation that defines a value.
    pub fn op(&self, value: Value) -> Op {
        self.ops[value.index()]
    }

    /// Whether elementary functions are still to be expanded.
    pub fn has_elementary_functions(&self) -> bool {
        self.ops.iter().any(|op| matches!(op, Op::Unary(..) | Op::Binary(..)))
    }

    /// The values that must be available to compute an operation, see [`reads`].
    pub fn reads(&self, op: Op) -> impl Iterator<Item = Value> + use<> {
        reads(&self.ops, op)
    }

    /// The condition that selects the status, its truth value in case of a failure, and the status in that case; the
    /// status is 0 otherwise. `None` if there is no status or if it has another form.
    pub fn failure(&self) -> Option<(Value, bool, Value)> {
        Func::failure_of(&self.ops, self.status?)
    }

    /// As [`failure`](Func::failure), of operations and their status.
    pub fn failure_of(ops: &[Op], status: Value) -> Option<(Value, bool, Value)> {
        let Op::Select(when, yes, no) = ops[status.index()] else { return None };
        let is_zero = |value: Value| ops[value.index()] == Op::Int(0);
        match (is_zero(yes), is_zero(no)) {
            (_, true) => Some((when, true, yes)),
            (true, false) => Some((when, false, no)),
            (false, false) => None,
        }
    }

    /// The values that leave the function: stored, written, or its status.
    pub fn results(&self) -> impl Iterator<Item = Value> + '_ {
        let written = self.writes.iter().flat_map(|write| [write.index, write.value]);
        self.stores.iter().map(|(_, value)| *value).chain(written).chain(self.status)
    }

    /// Liveness: for each operation, whether a store, a write or the status needs it.
    pub fn live(&self) -> Vec<bool> {
        self.live_for(self.results())
    }

    /// Liveness with respect to these values alone.
    pub fn live_for(&self, values: impl Iterator<Item = Value>) -> Vec<bool> {
        live(&self.ops, values)
    }

    /// The slots that the function loads, ascending and without duplicates. Ring reads are not included.
    pub fn loads(&self) -> Vec<Slot> {
        let mut slots: Vec<Slot> =
            self.ops.iter().filter_map(|op| if let Op::Load(slot) = op { Some(*slot) } else { None }).collect();
        slots.sort_unstable();
        slots.dedup();
        slots
    }
}
