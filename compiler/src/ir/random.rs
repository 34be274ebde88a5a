//! Random valid functions from a seed, for differential tests of the back ends, here and in `tests/`.

use super::verify::result;
use super::{Func, Op, Type, Value, Write};
use abi::{Layout, Slot};

/// A SplitMix64 generator; the field is its state.
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        abi::random::next(&mut self.0)
    }

    /// Uniform in 0..n (with a negligible bias).
    pub fn below(&mut self, n: usize) -> usize {
        abi::random::below(&mut self.0, n)
    }

    /// Uniform in [lo, hi).
    pub fn within(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A real: often an edge case, sometimes arbitrary bits, mostly of moderate size.
    pub fn real(&mut self) -> f64 {
        match self.below(8) {
            0 | 1 => REALS[self.below(REALS.len())],
            2 => f64::from_bits(self.bits()),
            _ => {
                let scale = [1e-6, 1.0, 1.0, 1e3, 1e9][self.below(5)];
                self.within(-scale, scale)
            }
        }
    }

    /// An integer: often an edge case or small.
    pub fn int(&mut self) -> i64 {
        match self.below(4) {
            0 => INTS[self.below(INTS.len())],
            1 => self.bits() as i64,
            _ => self.below(200) as i64 - 100,
        }
    }
}

/// Edge cases of reals, at which wrong implementations differ.
pub const REALS: &[f64] = &[
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    -0.5,
    1.5,
    2.5,
    -2.5,
    0.1,
    f64::MIN_POSITIVE,
    -f64::MIN_POSITIVE,
    5e-324,
    -5e-324,
    2.2e-308,
    f64::EPSILON,
    f64::MAX,
    f64::MIN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
    4503599627370496.5,
    9007199254740993.0,
    9223372036854775807.0,
    -9223372036854775808.0,
    1e19,
    -1e300,
    709.78,
    -745.13,
];

/// Edge cases of integers, at which wrong implementations differ.
pub const INTS: &[i64] =
    &[0, 1, -1, 2, 63, 64, -64, i64::MAX, i64::MIN, 0x3ff0_0000_0000_0000, 1 << 52, 1 << 53, (1 << 53) + 1];

/// The layout of the generated functions: slots in every segment that a function may read or write.
pub fn layout() -> Layout {
    Layout::new([4, 2, 4, 2, 1, 3, 0, 0, 0, 1]).with_rings(8)
}

/// The length of the pool of the generated functions.
pub const POOL_LEN: usize = 24;

/// A valid, expanded function of about `len` operations over [`layout`].
pub fn func(random: &mut Random, len: usize) -> Func {
    let layout = layout();
    let mut made = Made::default();
    for _ in 0..8 {
        let op = Op::Load(Slot(random.below(layout.rings.start as usize) as u32));
        made.push(op);
    }
    made.push(Op::Int(random.int()));
    made.push(Op::Bool(random.below(2) == 0));
    while made.ops.len() < len {
        let mut any = |of: Type, made: &Made| {
            let fit: Vec<Value> = made.of(of);
            // Mostly recent values, so that dependency chains become long.
            let from = if random.below(3) > 0 { fit.len().saturating_sub(6) } else { 0 };
            fit[from + random.below(fit.len() - from)]
        };
        let real = |any: &mut dyn FnMut(Type, &Made) -> Value, made: &Made| any(Type::Real, made);
        let (x, y, z) = (real(&mut any, &made), real(&mut any, &made), real(&mut any, &made));
        let (i, j) = (any(Type::Int, &made), any(Type::Int, &made));
        let (p, q) = (any(Type::Bool, &made), any(Type::Bool, &made));
        let n = random.below(64) as u8;
        match random.below(41) {
            0 => made.push(Op::Real(random.real().to_bits())),
            1 => made.push(Op::Int(random.int())),
            2 | 3 => made.push(Op::Add(x, y)),
            4 => made.push(Op::Sub(x, y)),
            5 | 6 => made.push(Op::Mul(x, y)),
            7 => made.push(Op::Div(x, y)),
            8 => made.push(Op::Neg(x)),
            9 => made.push(Op::Abs(x)),
            10 => made.push(Op::Sqrt(x)),
            11 | 12 => made.push(Op::Fma(x, y, z)),
            13 => made.push(Op::Floor(x)),
            14 => made.push(Op::Nearest(x)),
            15 => made.push(Op::Less(x, y)),
            16 => made.push(Op::LessEqual(x, y)),
            17 => made.push(Op::Equal(x, y)),
            18 => made.push(Op::And(p, q)),
            19 => made.push(Op::Or(p, q)),
            20 => made.push(Op::Not(p)),
            21 => made.push(Op::Select(p, x, y)),
            22 => made.push(Op::Select(p, i, j)),
            23 => made.push(Op::Select(p, q, p)),
            24 => made.push(Op::IntAdd(i, j)),
            25 => made.push(Op::IntSub(i, j)),
            26 => made.push(Op::IntMul(i, j)),
            27 => made.push(Op::IntAnd(i, j)),
            28 => made.push(Op::IntOr(i, j)),
            29 => made.push(Op::IntXor(i, j)),
            30 => made.push(Op::ShiftLeft(i, n)),
            31 => made.push(Op::ShiftRight(i, n)),
            32 => made.push(Op::ShiftRightSigned(i, n)),
            33 => made.push(Op::IntLess(i, j)),
            34 => made.push(Op::IntEqual(i, j)),
            35 => {
                // The bits of a NaN are unspecified, so a NaN is replaced before its bits are used.
                made.push(Op::Equal(x, x));
                made.push(Op::Real(1f64.to_bits()));
                let (number, one) = (made.last(1), made.last(0));
                made.push(Op::Select(number, x, one));
                made.push(Op::ToBits(made.last(0)));
            }
            36 => made.push(Op::FromBits(i)),
            37 => made.push(Op::ToInt(x)),
            38 => made.push(Op::ToReal(i)),
            39 => {
                let (base, len) = ring(random, &layout);
                made.push(Op::Ring { base, len, index: i });
            }
            _ => {
                let base = random.below(POOL_LEN) as u32;
                let len = 1 + random.below(POOL_LEN - base as usize) as u32;
                made.push(Op::Pool { base, len, index: i });
            }
        }
        // The pattern of a minimum or maximum, which back ends recognise.
        if random.below(12) == 0 {
            let (a, b) = (x, made.of(Type::Real)[0]);
            made.push(Op::Less(a, b));
            let less = made.last(0);
            made.push(if random.below(2) == 0 { Op::Select(less, a, b) } else { Op::Select(less, b, a) });
        }
    }
    let mut stores = Vec::new();
    for segment in [layout.states, layout.memory, layout.regimes, layout.outputs] {
        for slot in segment.range() {
            if random.below(4) > 0 {
                let fit = made.of(Type::Real);
                stores.push((Slot(slot as u32), fit[fit.len() - 1 - random.below(fit.len().min(20))]));
            }
        }
    }
    let mut writes = Vec::new();
    for _ in 0..random.below(3) {
        let (base, len) = ring(random, &layout);
        let (reals, ints) = (made.of(Type::Real), made.of(Type::Int));
        let (value, index) = (reals[random.below(reals.len())], ints[random.below(ints.len())]);
        writes.push(Write { base, len, index, value });
    }
    let status = (random.below(2) == 0).then(|| {
        let fit = made.of(Type::Bool);
        let failed = fit[random.below(fit.len())];
        let other = fit[random.below(fit.len())];
        // The form of guards: a first test decides whether a chain of selects is evaluated. The chain may still yield
        // 0.
        made.push(Op::Int(0));
        let zero = made.last(0);
        made.push(Op::Int(3));
        made.push(Op::Select(other, made.last(0), zero));
        made.push(Op::Int(5));
        let slot = Op::Load(layout.states.slot(random.below(4)));
        made.push(slot);
        let x = made.of(Type::Real)[0];
        made.push(Op::Less(made.last(0), x));
        made.push(Op::Select(made.last(0), made.last(2), made.last(3)));
        made.push(Op::Select(failed, made.last(0), zero));
        made.last(0)
    });
    Func { name: "random".into(), ops: made.ops, stores, writes, status }
}

/// A random part of the ring slots.
fn ring(random: &mut Random, layout: &Layout) -> (Slot, u32) {
    let from = random.below(layout.rings.len as usize);
    (layout.rings.slot(from), 1 + random.below(layout.rings.len as usize - from) as u32)
}

#[derive(Default)]
struct Made {
    ops: Vec<Op>,
    types: Vec<Type>,
}

impl Made {
    fn push(&mut self, op: Op) {
        self.types.push(result(op, |operand| self.types[operand.index()]).expect("a sound operation"));
        self.ops.push(op);
    }

    /// The value `back` places before the last one.
    fn last(&self, back: usize) -> Value {
        Value((self.ops.len() - 1 - back) as u32)
    }

    fn of(&self, of: Type) -> Vec<Value> {
        (0..self.ops.len()).filter(|i| self.types[*i] == of).map(|i| Value(i as u32)).collect()
    }
}
