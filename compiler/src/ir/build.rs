//! Function builder: value numbering, constant folding, and algebraic identities that preserve every bit.
//!
//! In: operations, each after its operands. Out: a [`Func`] without dead code. Folding uses [`evaluate`], which also
//! defines the meaning of the operations, so it cannot change a result.
//!
//! Source: Aho et al., *Compilers*, 2007, 6.1.2 (value numbering) and 8.5 (algebraic identities, dead code).

use super::eval::evaluate;
use super::verify::{result, types};
use super::{Binary, Func, Op, Type, Unary, Value, Write};
use crate::ir::hash::HashMap;
use abi::Slot;
use std::collections::BTreeMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

/// The current value of each slot while functions are composed. A slot without an entry still has its initial value.
pub type Env = HashMap<Slot, Value>;

/// A function under construction.
#[derive(Clone, Default)]
pub struct Build {
    name: String,
    ops: Vec<Op>,
    types: Vec<Type>,
    known: HashMap<Op, Value>,
    stores: BTreeMap<Slot, Value>,
    writes: Vec<Write>,
    status: Option<Value>,
    pool: Arc<[f64]>,
}

impl Build {
    /// An empty function with this name.
    pub fn new(name: &str) -> Build {
        Build { name: name.into(), ..Build::default() }
    }

    /// As [`new`](Build::new), with capacity for this number of operations: below it, nothing is allocated or hashed again.
    pub fn roomy(name: &str, operations: usize) -> Build {
        let mut build = Build::new(name);
        build.ops.reserve(operations);
        build.types.reserve(operations);
        build.known.reserve(operations);
        build
    }

    /// A builder that contains the operations of `func` under their old numbers, but not its stores, writes and status.
    pub fn of(func: &Func) -> Build {
        let mut build = Build::roomy(&func.name, func.ops.len());
        build.ops.extend(&func.ops);
        build.types = types(func).expect("the function is sound");
        for (i, op) in func.ops.iter().enumerate() {
            build.known.entry(*op).or_insert(Value(i as u32));
        }
        build
    }

    /// All operations, including unused ones.
    pub fn into_ops(self) -> Vec<Op> {
        self.ops
    }

    /// The operations so far, including unused ones.
    pub fn ops(&self) -> &[Op] {
        &self.ops
    }

    /// Enables folding of pool reads with a constant index. `pool`: a prefix of the pool that the function will run
    /// with.
    pub fn with_pool(mut self, pool: Arc<[f64]>) -> Build {
        self.pool = pool;
        self
    }

    /// Number of operations so far, including unused ones.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.ops.len()
    }

    /// The operation that defines a value.
    pub fn get(&self, value: Value) -> Op {
        self.ops[value.index()]
    }

    /// The type of a value.
    pub fn type_of(&self, value: Value) -> Type {
        self.types[value.index()]
    }

    /// The number, if the value is a real constant.
    pub fn constant(&self, value: Value) -> Option<f64> {
        if let Op::Real(bits) = self.get(value) { Some(f64::from_bits(bits)) } else { None }
    }

    /// The bits, if the value is a constant of any type.
    fn bits(&self, value: Value) -> Option<u64> {
        match self.get(value) {
            Op::Real(bits) => Some(bits),
            Op::Int(n) => Some(n as u64),
            Op::Bool(b) => Some(b.into()),
            _ => None,
        }
    }

    /// Adds an operation and returns its value, or returns an equal value that exists.
    ///
    /// # Panics
    /// If an operand has the wrong type: a bug in the calling pass.
    pub fn op(&mut self, op: Op) -> Value {
        match self.rewrite(op) {
            Rewrite::Value(value) => return value,
            Rewrite::Op(simpler) => return self.op(simpler),
            Rewrite::Product(a, factor) => {
                let factor = self.real(factor);
                return self.op(Op::Mul(a, factor));
            }
            Rewrite::None => {}
        }
        if let Some(value) = self.equality_of_select(op).or_else(|| self.negated_quotient(op)) {
            return value;
        }
        let op = op.ordered();
        if let Some(constant) = self.fold(op) {
            return self.share(constant);
        }
        self.share(op)
    }

    /// (if c then 1 else x) = 2 → not c and x = 2, and so on. A test for a mode thus becomes the condition that selects
    /// the mode.
    fn equality_of_select(&mut self, op: Op) -> Option<Value> {
        let Op::Equal(a, b) = op else { return None };
        let (choice, number) = if self.constant(b).is_some() { (a, b) } else { (b, a) };
        self.constant(number)?;
        let Op::Select(condition, yes, no) = self.get(choice) else { return None };
        if self.constant(yes).is_none() && self.constant(no).is_none() {
            return None;
        }
        let [yes, no] = [yes, no].map(|side| self.op(Op::Equal(side, number)));
        match (self.get(yes), self.get(no)) {
            (Op::Bool(false), _) => {
                let not = self.op(Op::Not(condition));
                Some(self.op(Op::And(not, no)))
            }
            (_, Op::Bool(true)) => {
                let not = self.op(Op::Not(condition));
                Some(self.op(Op::Or(not, yes)))
            }
            _ => Some(self.op(Op::Select(condition, yes, no))),
        }
    }

    /// (−c) / x → −(c / x), if c / x exists already.
    fn negated_quotient(&mut self, op: Op) -> Option<Value> {
        let Op::Div(a, b) = op else { return None };
        let negated = self.known.get(&Op::Real((-self.constant(a)?).to_bits()))?;
        let divided = *self.known.get(&Op::Div(*negated, b))?;
        Some(self.op(Op::Neg(divided)))
    }

    fn share(&mut self, op: Op) -> Value {
        let entry = match self.known.entry(op) {
            Entry::Occupied(entry) => return *entry.get(),
            Entry::Vacant(entry) => entry,
        };
        let of = |value: Value| self.types[value.index()];
        let of_type = result(op, of).unwrap_or_else(|what| panic!("{}: v{} = {op} {what}", self.name, self.ops.len()));
        let value = Value(u32::try_from(self.ops.len()).expect("fewer than 2^32 operations"));
        self.ops.push(op);
        self.types.push(of_type);
        *entry.insert(value)
    }

    /// The constant result of an operation on constants.
    fn fold(&self, op: Op) -> Option<Op> {
        if let Op::Pool { base, len, index } = op {
            let index = self.bits(index)?.min(u64::from(len) - 1);
            return self.pool.get(base as usize + index as usize).map(|entry| Op::Real(entry.to_bits()));
        }
        let (mut constant, mut operands) = (true, 0);
        op.each_operand(|operand| {
            constant &= self.bits(operand).is_some();
            operands += 1;
        });
        if !constant || operands == 0 {
            return None;
        }
        let bits = evaluate(op, |operand| self.bits(operand).expect("operands are constants"))?;
        Some(match result(op, |operand| self.type_of(operand)).ok()? {
            // All NaN count as one value, so they become one constant.
            Type::Real if f64::from_bits(bits).is_nan() => Op::Real(f64::NAN.to_bits()),
            Type::Real => Op::Real(bits),
            Type::Int => Op::Int(bits as i64),
            Type::Bool => Op::Bool(bits != 0),
        })
    }

    /// Identities that hold to the bit in IEEE 754 with round to nearest, if all NaN count as one value. Some are
    /// missing on purpose: x + 0 is not x for x = −0, x − x is not 0 for x = ∞, x · 0 is not 0 for x = −1, and sums and
    /// products are not associative.
    fn rewrite(&self, op: Op) -> Rewrite {
        use Rewrite::{None, Value as Is};
        const MINUS_ZERO: f64 = -0.0;
        let real = |value| self.constant(value);
        let is = |value, constant: f64| self.bits(value) == Some(constant.to_bits()) && real(value).is_some();
        let int = |value| if let Op::Int(n) = self.get(value) { Some(n) } else { Option::None };
        let truth = |value| if let Op::Bool(b) = self.get(value) { Some(b) } else { Option::None };
        let neg = |value| if let Op::Neg(a) = self.get(value) { Some(a) } else { Option::None };
        match op {
            // x + (−0) → x, also for x = ±0.
            Op::Add(a, b) if is(b, MINUS_ZERO) => Is(a),
            Op::Add(a, b) if is(a, MINUS_ZERO) => Is(b),
            // a + (−b) → a − b: the same real number, rounded once. If both are zero, both forms give +0 or both give
            // −0.
            Op::Add(a, b) => match (neg(a), neg(b)) {
                (_, Some(b)) => Rewrite::Op(Op::Sub(a, b)),
                (Some(a), Option::None) => Rewrite::Op(Op::Sub(b, a)),
                (Option::None, Option::None) => None,
            },
            // x − (+0) → x, also for x = ±0.
            Op::Sub(a, b) if is(b, 0.0) => Is(a),
            // (−0) − x → −x, also for x = ±0. 0 − x is not −x for x = 0.
            Op::Sub(a, b) if is(a, MINUS_ZERO) => Rewrite::Op(Op::Neg(b)),
            // a − (−b) → a + b
            Op::Sub(a, b) => neg(b).map_or(None, |b| Rewrite::Op(Op::Add(a, b))),
            // x · 1 → x;  x · (−1) → −x
            Op::Mul(a, b) if is(b, 1.0) => Is(a),
            Op::Mul(a, b) if is(a, 1.0) => Is(b),
            Op::Mul(a, b) if is(b, -1.0) => Rewrite::Op(Op::Neg(a)),
            Op::Mul(a, b) if is(a, -1.0) => Rewrite::Op(Op::Neg(b)),
            // (−a)(−b) → a b
            Op::Mul(a, b) => match (neg(a), neg(b)) {
                (Some(a), Some(b)) => Rewrite::Op(Op::Mul(a, b)),
                _ => None,
            },
            // x / 1 → x;  x / (−1) → −x
            Op::Div(a, b) if is(b, 1.0) => Is(a),
            Op::Div(a, b) if is(b, -1.0) => Rewrite::Op(Op::Neg(a)),
            // (−a)/(−b) → a/b;  x / 2ⁿ → x · 2⁻ⁿ: the same real number, rounded once.
            Op::Div(a, b) => match (neg(a), neg(b)) {
                (Some(a), Some(b)) => Rewrite::Op(Op::Div(a, b)),
                _ => real(b).and_then(exact_inverse).map_or(None, |inverse| Rewrite::Product(a, inverse)),
            },
            // −(−x) → x
            Op::Neg(a) => neg(a).map_or(None, Is),
            // |−x| → |x|;  ||x|| → |x|;  |x · x| → x · x, because a square is at least +0, or NaN.
            Op::Abs(a) => match self.get(a) {
                Op::Neg(a) => Rewrite::Op(Op::Abs(a)),
                Op::Abs(_) => Is(a),
                Op::Mul(x, y) if x == y => Is(a),
                _ => None,
            },
            // fma(x, 1, c) → x + c: one rounding in both. fma(x, −1, c) → c − x.
            Op::Fma(a, b, c) if is(b, 1.0) => Rewrite::Op(Op::Add(a, c)),
            Op::Fma(a, b, c) if is(a, 1.0) => Rewrite::Op(Op::Add(b, c)),
            Op::Fma(a, b, c) if is(b, -1.0) => Rewrite::Op(Op::Sub(c, a)),
            Op::Fma(a, b, c) if is(a, -1.0) => Rewrite::Op(Op::Sub(c, b)),
            // fma(a, b, −0) → a · b, also for a · b = ±0.
            Op::Fma(a, b, c) if is(c, MINUS_ZERO) => Rewrite::Op(Op::Mul(a, b)),
            Op::Fma(a, b, c) => match (neg(a), neg(b)) {
                (Some(a), Some(b)) => Rewrite::Op(Op::Fma(a, b, c)),
                _ => None,
            },
            // ⌊⌊x⌋⌋ → ⌊x⌋, and so on: the inner result is an integer.
            Op::Floor(a) | Op::Nearest(a) => match self.get(a) {
                Op::Floor(_) | Op::Nearest(_) => Is(a),
                _ => None,
            },
            // x < x is false, also for NaN. x ≤ x and x = x are not constant: they are false for NaN.
            Op::Less(a, b) if a == b => Rewrite::Op(Op::Bool(false)),
            Op::And(a, b) => match (truth(a), truth(b)) {
                (Some(true), _) => Is(b),
                (_, Some(true)) => Is(a),
                (Some(false), _) | (_, Some(false)) => Rewrite::Op(Op::Bool(false)),
                _ if a == b => Is(a),
                _ => None,
            },
            Op::Or(a, b) => match (truth(a), truth(b)) {
                (Some(false), _) => Is(b),
                (_, Some(false)) => Is(a),
                (Some(true), _) | (_, Some(true)) => Rewrite::Op(Op::Bool(true)),
                _ if a == b => Is(a),
                _ => None,
            },
            Op::Not(a) => {
                if let Op::Not(a) = self.get(a) {
                    Is(a)
                } else {
                    None
                }
            }
            Op::Select(c, a, b) => match (truth(c), self.get(c)) {
                (Some(true), _) => Is(a),
                (Some(false), _) => Is(b),
                _ if a == b => Is(a),
                (_, Op::Not(c)) => Rewrite::Op(Op::Select(c, b, a)),
                _ => match (truth(a), truth(b)) {
                    // if c then true else b → c or b, and so on.
                    (Some(true), _) => Rewrite::Op(Op::Or(c, b)),
                    (_, Some(false)) => Rewrite::Op(Op::And(c, a)),
                    (Some(false), Some(true)) => Rewrite::Op(Op::Not(c)),
                    _ => None,
                },
            },
            // Integer arithmetic wraps (a ring in the algebraic sense), so these hold without conditions.
            Op::IntAdd(a, b) | Op::IntOr(a, b) | Op::IntXor(a, b) if int(a) == Some(0) => Is(b),
            Op::IntAdd(a, b) | Op::IntOr(a, b) | Op::IntXor(a, b) if int(b) == Some(0) => Is(a),
            Op::IntSub(a, b) if int(b) == Some(0) => Is(a),
            Op::IntMul(a, b) if int(a) == Some(1) => Is(b),
            Op::IntMul(a, b) if int(b) == Some(1) => Is(a),
            Op::IntAnd(a, b) if int(a) == Some(-1) || a == b => Is(b),
            Op::IntAnd(a, b) if int(b) == Some(-1) => Is(a),
            Op::IntOr(a, b) if a == b => Is(a),
            Op::ShiftLeft(a, 0) | Op::ShiftRight(a, 0) | Op::ShiftRightSigned(a, 0) => Is(a),
            Op::IntLess(a, b) if a == b => Rewrite::Op(Op::Bool(false)),
            Op::IntEqual(a, b) if a == b => Rewrite::Op(Op::Bool(true)),
            Op::FromBits(a) => {
                if let Op::ToBits(a) = self.get(a) {
                    Is(a)
                } else {
                    None
                }
            }
            Op::ToBits(a) => {
                if let Op::FromBits(a) = self.get(a) {
                    Is(a)
                } else {
                    None
                }
            }
            Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } => None,
            Op::Sqrt(_) | Op::Unary(..) | Op::Binary(..) => None,
            Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => None,
            Op::IntAdd(..) | Op::IntSub(..) | Op::IntMul(..) | Op::IntAnd(..) | Op::IntOr(..) => None,
            Op::IntXor(..) | Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => None,
            Op::IntLess(..) | Op::IntEqual(..) | Op::ToInt(_) | Op::ToReal(_) => None,
        }
    }

    /// Writes `value` to `slot` at the end of the function. A later store to the same slot replaces this one.
    pub fn store(&mut self, slot: Slot, value: Value) {
        assert_eq!(self.type_of(value), Type::Real, "slot {} of {} holds a real", slot.0, self.name);
        self.stores.insert(slot, value);
    }

    /// Writes to a ring buffer at the end of the function.
    pub fn write(&mut self, write: Write) {
        assert_eq!(self.type_of(write.index), Type::Int, "{} writes at an integer", self.name);
        assert_eq!(self.type_of(write.value), Type::Real, "a ring of {} holds reals", self.name);
        self.writes.push(write);
    }

    /// Stores every slot of `env` that `keep` accepts.
    pub fn store_env(&mut self, env: &Env, keep: impl Fn(Slot) -> bool) {
        for (&slot, &value) in env.iter().filter(|(slot, _)| keep(**slot)) {
            self.store(slot, value);
        }
    }

    /// Sets the status of the function to an integer value.
    pub fn status(&mut self, status: Value) {
        assert_eq!(self.type_of(status), Type::Int, "the status of {}", self.name);
        self.status = Some(status);
    }

    /// The value of a slot in `env`; the initial value if `env` has no entry.
    pub fn read(&mut self, slot: Slot, env: &Env) -> Value {
        env.get(&slot).copied().unwrap_or_else(|| self.load(slot))
    }

    /// Inlines `func`: appends its operations and returns its status. Its loads read `env` and its stores change `env`;
    /// nothing is stored to the block.
    pub fn inline(&mut self, func: &Func, env: &mut Env) -> Option<Value> {
        let live = func.live();
        let mut values = Vec::with_capacity(func.ops.len());
        for (op, live) in func.ops.iter().zip(live) {
            values.push(match op {
                _ if !live => Value(u32::MAX),
                Op::Load(slot) => self.read(*slot, env),
                op => self.op(op.map(|operand| values[operand.index()])),
            });
        }
        for (slot, value) in &func.stores {
            env.insert(*slot, values[value.index()]);
        }
        func.status.map(|status| values[status.index()])
    }

    /// Finishes with the stores, writes and status of `func`. `values`: for each value of `func`, its value in this
    /// builder.
    pub fn finish_as(mut self, func: &Func, values: &[Value]) -> Func {
        let at = |value: Value| values[value.index()];
        func.stores.iter().for_each(|(slot, value)| self.store(*slot, at(*value)));
        func.writes.iter().for_each(|write| self.write(write.map(at)));
        if let Some(status) = func.status {
            self.status(at(status));
        }
        self.finish()
    }

    /// Finishes the function: stores sorted by slot, without dead code and without stores of a slot's own initial
    /// value.
    pub fn finish(self) -> Func {
        let kept = |(slot, value): &(Slot, Value)| self.ops[value.index()] != Op::Load(*slot);
        let stores = self.stores.into_iter().filter(kept).collect();
        let func = Func { name: self.name, ops: self.ops, stores, writes: self.writes, status: self.status };
        prune(&func)
    }
}

/// Dead code elimination: the same function without operations that no result needs.
pub fn prune(func: &Func) -> Func {
    prune_to(func, &func.ops, &func.live())
}

/// As [`prune`]: the function whose stores, writes and status are those of `func` and whose operations are those of `all`
/// that are live.
pub fn prune_to(func: &Func, all: &[Op], live: &[bool]) -> Func {
    let mut moved = vec![Value(u32::MAX); all.len()];
    let mut ops = Vec::with_capacity(live.iter().filter(|live| **live).count());
    for (i, op) in all.iter().enumerate().filter(|(i, _)| live[*i]) {
        moved[i] = Value(ops.len() as u32);
        ops.push(op.map(|operand| moved[operand.index()]));
    }
    Func {
        name: func.name.clone(),
        ops,
        stores: func.stores.iter().map(|(slot, value)| (*slot, moved[value.index()])).collect(),
        writes: func.writes.iter().map(|write| write.map(|value| moved[value.index()])).collect(),
        status: func.status.map(|status| moved[status.index()]),
    }
}

enum Rewrite {
    None,
    Value(Value),
    Op(Op),
    Product(Value, f64),
}

/// 1/x if it is exact, which holds for powers of two.
fn exact_inverse(x: f64) -> Option<f64> {
    let inverse = 1.0 / x;
    (x.to_bits() << 12 == 0 && x.is_normal() && inverse.is_normal()).then_some(inverse)
}

macro_rules! operations {
    ($($(#[$doc:meta])* $name:ident($($operand:ident),*) = $op:expr;)*) => {
        /// One method for each operation.
        impl Build {
            $($(#[$doc])* pub fn $name(&mut self, $($operand: Value),*) -> Value { self.op($op) })*
        }
    };
}

operations! {
    /// a + b
    add(a, b) = Op::Add(a, b);
    /// a − b
    sub(a, b) = Op::Sub(a, b);
    /// a · b
    mul(a, b) = Op::Mul(a, b);
    /// a / b
    div(a, b) = Op::Div(a, b);
    /// −a
    neg(a) = Op::Neg(a);
    /// |a|
    abs(a) = Op::Abs(a);
    /// √a
    sqrt(a) = Op::Sqrt(a);
    /// a · b + c, rounded once
    fma(a, b, c) = Op::Fma(a, b, c);
    /// Largest whole number not above a
    floor(a) = Op::Floor(a);
    /// Nearest whole number, ties to even
    nearest(a) = Op::Nearest(a);
    /// a < b
    less(a, b) = Op::Less(a, b);
    /// a ≤ b
    less_equal(a, b) = Op::LessEqual(a, b);
    /// a = b
    equal(a, b) = Op::Equal(a, b);
    /// Logical and
    and(a, b) = Op::And(a, b);
    /// Logical or
    or(a, b) = Op::Or(a, b);
    /// Logical negation
    not(a) = Op::Not(a);
    /// If c then a else b
    select(c, a, b) = Op::Select(c, a, b);
    /// Wrapping sum
    int_add(a, b) = Op::IntAdd(a, b);
    /// Wrapping difference
    int_sub(a, b) = Op::IntSub(a, b);
    /// Wrapping product
    int_mul(a, b) = Op::IntMul(a, b);
    /// Bitwise and
    int_and(a, b) = Op::IntAnd(a, b);
    /// Bitwise or
    int_or(a, b) = Op::IntOr(a, b);
    /// Bitwise exclusive or
    int_xor(a, b) = Op::IntXor(a, b);
    /// Signed comparison
    int_less(a, b) = Op::IntLess(a, b);
    /// Equality of integers
    int_equal(a, b) = Op::IntEqual(a, b);
    /// The bits of a real
    to_bits(a) = Op::ToBits(a);
    /// The real of these bits
    from_bits(a) = Op::FromBits(a);
    /// Truncated towards zero
    to_int(a) = Op::ToInt(a);
    /// The nearest real
    to_real(a) = Op::ToReal(a);
}

impl Build {
    /// A real constant.
    pub fn real(&mut self, x: f64) -> Value {
        self.op(Op::Real(x.to_bits()))
    }

    /// An integer constant.
    pub fn int(&mut self, n: i64) -> Value {
        self.op(Op::Int(n))
    }

    /// A Boolean constant.
    pub fn truth(&mut self, b: bool) -> Value {
        self.op(Op::Bool(b))
    }

    /// The value of a slot at the start of the function.
    pub fn load(&mut self, slot: Slot) -> Value {
        self.op(Op::Load(slot))
    }

    /// Entry `index` of the table of `len` numbers at `base` in the pool. An index out of range reads the last entry.
    pub fn pool(&mut self, base: u32, len: u32, index: Value) -> Value {
        self.op(Op::Pool { base, len, index })
    }

    /// The value of slot `index` of a ring at the start of the function. An index out of range reads the last slot.
    pub fn ring(&mut self, base: Slot, len: u32, index: Value) -> Value {
        self.op(Op::Ring { base, len, index })
    }

    /// An elementary function of one argument.
    pub fn unary(&mut self, function: Unary, a: Value) -> Value {
        self.op(Op::Unary(function, a))
    }

    /// An elementary function of two arguments.
    pub fn binary(&mut self, function: Binary, a: Value, b: Value) -> Value {
        self.op(Op::Binary(function, a, b))
    }

    /// Shifted left by a constant.
    pub fn shift_left(&mut self, a: Value, n: u8) -> Value {
        self.op(Op::ShiftLeft(a, n))
    }

    /// Logical shift right by a constant.
    pub fn shift_right(&mut self, a: Value, n: u8) -> Value {
        self.op(Op::ShiftRight(a, n))
    }

    /// Arithmetic shift right by a constant.
    pub fn shift_right_signed(&mut self, a: Value, n: u8) -> Value {
        self.op(Op::ShiftRightSigned(a, n))
    }

    /// `if a < b then a else b`. If either is NaN, the result is b.
    pub fn min(&mut self, a: Value, b: Value) -> Value {
        let less = self.less(a, b);
        self.select(less, a, b)
    }

    /// `if b < a then a else b`. If either is NaN, the result is b.
    pub fn max(&mut self, a: Value, b: Value) -> Value {
        let less = self.less(b, a);
        self.select(less, a, b)
    }

    /// `if x < lo then lo else if hi < x then hi else x`. NaN stays NaN.
    pub fn clamp(&mut self, x: Value, lo: Value, hi: Value) -> Value {
        let raised = self.max(lo, x);
        self.min(hi, raised)
    }

    /// The sign of x: 1, −1, or ±0 for ±0. NaN stays NaN.
    pub fn sign(&mut self, x: Value) -> Value {
        let (zero, one, minus_one) = (self.real(0.0), self.real(1.0), self.real(-1.0));
        let (positive, negative) = (self.less(zero, x), self.less(x, zero));
        // 0 · x instead of 0, so that NaN is not mistaken for a standstill. Its derivative is also 0.
        let rest = self.mul(zero, x);
        let not_positive = self.select(negative, minus_one, rest);
        self.select(positive, one, not_positive)
    }

    /// Whether x is neither infinite nor NaN.
    pub fn finite(&mut self, x: Value) -> Value {
        let (size, largest) = (self.abs(x), self.real(f64::MAX));
        self.less_equal(size, largest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Builds one value from two loads, stores it in slot 9 and returns the listing without its first line.
    fn built(make: impl Fn(&mut Build, Value, Value) -> Value) -> String {
        let mut build = Build::new("f");
        let (x, y) = (build.load(Slot(3)), build.load(Slot(4)));
        let value = make(&mut build, x, y);
        let value = if build.type_of(value) == Type::Bool {
            let (one, zero) = (build.real(1.0), build.real(0.0));
            build.select(value, one, zero)
        } else {
            value
        };
        build.store(Slot(9), value);
        let listing = build.finish().to_string();
        listing.lines().skip(1).map(str::trim).collect::<Vec<_>>().join("; ")
    }

    #[test]
    fn equal_operations_are_shared() {
        let expected = "v0 = load 3; v1 = load 4; v2 = add v0 v1; v3 = mul v2 v2; store 9 = v3";
        let both = |b: &mut Build, x, y| {
            let (one, other) = (b.add(x, y), b.add(y, x));
            b.mul(one, other)
        };
        assert_eq!(built(both), expected);
    }

    #[test]
    fn constants_fold_as_they_are_evaluated() {
        let sum = |b: &mut Build, _, _| {
            let (a, c) = (b.real(0.1), b.real(0.2));
            b.add(a, c)
        };
        assert_eq!(built(sum), "v0 = 0.30000000000000004; store 9 = v0");
        let root = |b: &mut Build, _, _| {
            let a = b.real(-1.0);
            b.sqrt(a)
        };
        assert_eq!(built(root), "v0 = NaN; store 9 = v0");
    }

    #[test]
    fn identities_hold_to_the_bit() {
        let x = "v0 = load 3; store 9 = v0";
        let plus = |c: f64| {
            built(move |b, x, _| {
                let c = b.real(c);
                b.add(x, c)
            })
        };
        assert_eq!(plus(-0.0), x);
        assert_eq!(plus(0.0), "v0 = load 3; v1 = 0.0; v2 = add v0 v1; store 9 = v2");
        let minus = |c: f64| {
            built(move |b, x, _| {
                let c = b.real(c);
                b.sub(x, c)
            })
        };
        assert_eq!(minus(0.0), x);
        assert_eq!(minus(-0.0), "v0 = load 3; v1 = -0.0; v2 = sub v0 v1; store 9 = v2");
        let times = |c: f64| {
            built(move |b, x, _| {
                let c = b.real(c);
                b.mul(c, x)
            })
        };
        assert_eq!(times(1.0), x);
        assert_eq!(times(0.0), "v0 = load 3; v1 = 0.0; v2 = mul v0 v1; store 9 = v2");
        assert_eq!(times(-1.0), "v0 = load 3; v1 = neg v0; store 9 = v1");
        let twice = |b: &mut Build, x, _| {
            let minus = b.neg(x);
            b.neg(minus)
        };
        assert_eq!(built(twice), x);
    }

    /// On edge values, each rewritten operation has the same bits as the operation as written.
    #[test]
    fn rewrites_change_no_result() {
        let edges = [0.0, -0.0, 1.0, -1.0, 0.5, 3.0, -7.25, f64::INFINITY, f64::NEG_INFINITY, f64::NAN, 5e-324, 1e308];
        let constants = [0.0, -0.0, 1.0, -1.0, 2.0];
        let reals: [fn(Value, Value) -> Op; 12] = [
            Op::Add,
            Op::Sub,
            Op::Mul,
            Op::Div,
            |a, _| Op::Neg(a),
            |a, _| Op::Abs(a),
            |a, b| Op::Fma(a, b, a),
            |a, b| Op::Fma(a, a, b),
            |a, b| Op::Fma(a, b, b),
            |a, _| Op::Floor(a),
            |a, _| Op::Nearest(a),
            |a, b| Op::Add(b, a),
        ];
        for outer in reals {
            for (i, c) in constants.iter().enumerate() {
                for inner in reals {
                    let mut build = Build::new("f");
                    let (x, c) = (build.load(Slot(3)), build.real(*c));
                    let operand = build.op(inner(x, c));
                    let mut other = build.neg(x);
                    if i % 2 == 0 {
                        other = c;
                    }
                    let value = build.op(outer(operand, other));
                    for edge in edges {
                        let plain = |op: Op, a: f64, b: f64| {
                            f64::from_bits(evaluate(op, |v| if v.0 == 0 { a } else { b }.to_bits()).unwrap())
                        };
                        let c = constants[i];
                        let second = if i % 2 == 0 { c } else { -edge };
                        let expected =
                            plain(outer(Value(0), Value(1)), plain(inner(Value(0), Value(1)), edge, c), second);
                        let mut values: Vec<u64> = Vec::new();
                        for op in &build.ops {
                            let bits = match op {
                                Op::Load(_) => edge.to_bits(),
                                op => evaluate(*op, |v| values[v.index()]).unwrap(),
                            };
                            values.push(bits);
                        }
                        let found = f64::from_bits(values[value.index()]);
                        assert!(
                            found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan(),
                            "{:?} of {:?} at {edge}, {c}: {found} and not {expected}",
                            outer(Value(0), Value(1)),
                            inner(Value(0), Value(1))
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn a_quotient_and_its_negative_are_one_division() {
        let listing = built(|b, x, y| {
            let [one, minus] = [1.0, -1.0].map(|number| b.real(number));
            let (inverse, negative) = (b.div(one, x), b.div(minus, x));
            let product = b.mul(inverse, y);
            b.mul(product, negative)
        });
        assert_eq!(listing.matches("div").count(), 1, "{listing}");
    }

    #[test]
    fn functions_compose_through_their_slots() {
        let mut first = Build::new("first");
        let (x, two) = (first.load(Slot(3)), first.real(2.0));
        let doubled = first.mul(x, two);
        first.store(Slot(3), doubled);
        let first = first.finish();
        let mut both = Build::new("both");
        let mut env = Env::default();
        both.inline(&first, &mut env);
        both.inline(&first, &mut env);
        both.store_env(&env, |_| true);
        assert_eq!(
            both.finish().to_string(),
            "both:\n  v0 = load 3\n  v1 = 2.0\n  v2 = mul v0 v1\n  v3 = mul v1 v2\n  store 3 = v3\n"
        );
    }

    #[test]
    fn equality_with_a_selected_constant_becomes_the_condition() {
        let listing = built(|b, x, y| {
            let [one, two] = [1.0, 2.0].map(|number| b.real(number));
            let less = b.less(x, y);
            let chosen = b.select(less, one, x);
            b.equal(chosen, two)
        });
        let expected = "v0 = load 3; v1 = load 4; v2 = 1.0; v3 = 2.0; v4 = less v0 v1; v5 = equal v0 v3; v6 = not v4; \
                        v7 = and v5 v6; v8 = 0.0; v9 = select v7 v2 v8; store 9 = v9";
        assert_eq!(listing, expected);
    }

    #[test]
    fn dead_code_is_removed() {
        assert_eq!(built(|_, x, _| x), "v0 = load 3; store 9 = v0");
        let mut build = Build::new("f");
        let x = build.load(Slot(9));
        build.store(Slot(9), x);
        assert_eq!(build.finish().to_string(), "f:\n");
    }

    #[test]
    fn a_million_operations_can_be_built() {
        let mut build = Build::new("long");
        let mut x = build.load(Slot(3));
        for i in 0..1_000_000 {
            let c = build.real(f64::from(i));
            x = build.add(x, c);
        }
        build.store(Slot(3), x);
        assert_eq!(build.finish().ops.len(), 2_000_001);
    }
}
