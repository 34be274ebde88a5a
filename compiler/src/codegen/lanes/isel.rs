//! Operations of a function as vector instructions.
//!
//! In: an expanded function. Out: nodes that are each one instruction or a fixed few, in the order of the function. A
//! comparison whose result a selection takes from becomes a minimum or maximum, what is negated enters the fused
//! product, bits and numbers are one.

use crate::codegen::lanes::assembler::{Instruction, Vectors, instructions as i};
use crate::codegen::unsupported::Unsupported;
use crate::ir::{Func, Op, Type, Unary, Value, is_not_positive, sign_of, verify};
use crate::math::{self, exponential, tables};
use abi::Slot;
use std::collections::HashMap;

/// The node of this number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Node(pub u32);

impl Node {
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Signs of a fused product, by what they add to the opcode.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Signs {
    /// a b + c
    Plain = 0,
    /// a b − c
    Less = 2,
    /// −a b + c
    Negated = 4,
    /// −a b − c
    NegatedLess = 6,
}

/// Of a comparison of reals, by its number in the manual.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Predicate {
    Equal = 0,
    NotEqual = 4,
    LessOrGreater = 0x0c,
    NotLessOrGreater = 0x08,
    Less = 0x11,
    LessEqual = 0x12,
    NotLess = 0x15,
    NotLessEqual = 0x16,
    NotGreaterEqual = 0x19,
    NotGreater = 0x1a,
    GreaterEqual = 0x1d,
    Greater = 0x1e,
}

impl Predicate {
    /// What holds where it does not, of NaN too.
    pub fn not(self) -> Predicate {
        match self {
            Predicate::Equal => Predicate::NotEqual,
            Predicate::NotEqual => Predicate::Equal,
            Predicate::LessOrGreater => Predicate::NotLessOrGreater,
            Predicate::NotLessOrGreater => Predicate::LessOrGreater,
            Predicate::Less => Predicate::NotLess,
            Predicate::LessEqual => Predicate::NotLessEqual,
            Predicate::NotLess => Predicate::Less,
            Predicate::NotLessEqual => Predicate::LessEqual,
            Predicate::NotGreaterEqual => Predicate::GreaterEqual,
            Predicate::NotGreater => Predicate::Greater,
            Predicate::GreaterEqual => Predicate::NotGreaterEqual,
            Predicate::Greater => Predicate::NotGreater,
        }
    }

    /// The same with its operands exchanged.
    pub fn turned(self) -> Predicate {
        match self {
            Predicate::Equal => Predicate::Equal,
            Predicate::NotEqual => Predicate::NotEqual,
            Predicate::LessOrGreater | Predicate::NotLessOrGreater => self,
            Predicate::Less => Predicate::Greater,
            Predicate::LessEqual => Predicate::GreaterEqual,
            Predicate::NotLess => Predicate::NotGreater,
            Predicate::NotLessEqual => Predicate::NotGreaterEqual,
            Predicate::NotGreaterEqual => Predicate::NotLessEqual,
            Predicate::NotGreater => Predicate::NotLess,
            Predicate::GreaterEqual => Predicate::LessEqual,
            Predicate::Greater => Predicate::Less,
        }
    }
}

/// What a node computes. A mask is a mask register, or without those a vector of all ones or zeros a lane.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum MachineOp {
    /// The value of a slot when an iteration begins.
    Load(Slot),
    /// The same number in every lane, by its bits.
    Constant(u64),
    /// An instruction of two operands; whether they can be exchanged.
    Two(Instruction, bool, Node, Node),
    /// An instruction of one operand, with an immediate.
    One(Instruction, Option<u8>, Node),
    /// ±a · b ± c
    Fma {
        signs: Signs,
        a: Node,
        b: Node,
        c: Node,
    },
    /// Left, right, or right with the sign, by a constant.
    Shift(Direction, Node, u8),
    /// Comparison of reals, quiet.
    Compare(Predicate, Node, Node),
    /// Comparison of integers: equal (0) or less (1).
    CompareInt(u8, Node, Node),
    /// A mask: whether two integers have a bit in common. AVX-512 only.
    TestBits(Node, Node),
    /// A mask that is the same in every lane.
    Mask(bool),
    MaskAnd(Node, Node),
    MaskOr(Node, Node),
    MaskNot(Node),
    /// Lanes of the second where the first is true, else of the third.
    Select(Node, Node, Node),
    /// The same of masks.
    MaskSelect(Node, Node, Node),
    /// Where the first, a mask, holds: the second times 2 to the power of the third, down to a whole number; else 0. AVX-512 only.
    Scale(Node, Node, Node),
    /// Entries of the table at `base`, at indices that lie inside.
    Gather {
        base: u32,
        len: u32,
        index: Node,
    },
    /// Half a table: the same in every vector. AVX-512 only.
    Row(TableQuarter, bool),
    /// Entries of sixteen, in two rows, by the low four bits of an integer. AVX-512 only.
    Permute(Node, Node, Node),
}

/// A quarter of a table for exponentials: i begins with 16 times the number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum TableQuarter {
    /// 2^(i/64)
    Power(u8),
    /// What that is more than its rounded value, relative.
    Tail(u8),
}

impl TableQuarter {
    /// Its first or second half, by the bits of the entries.
    pub fn row(self, second: bool) -> [u64; 8] {
        let (TableQuarter::Power(quarter) | TableQuarter::Tail(quarter)) = self;
        let entry = |place: usize| {
            let i = 16 * usize::from(quarter) + place;
            match self {
                TableQuarter::Power(_) => math::POOL[tables::EXP_SCALE as usize + i].to_bits() + ((i as u64) << 46),
                TableQuarter::Tail(_) => math::POOL[tables::EXP_TAIL as usize + i].to_bits(),
            }
        };
        std::array::from_fn(|place| entry(8 * usize::from(second) + place))
    }
}

/// Of a shift.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Direction {
    Left,
    Right,
    RightSigned,
}

impl MachineOp {
    /// Operands from left to right.
    pub fn operands(self) -> impl Iterator<Item = Node> {
        let all = match self {
            MachineOp::Load(_) | MachineOp::Constant(_) | MachineOp::Row(..) | MachineOp::Mask(_) => [None; 3],
            MachineOp::One(_, _, a)
            | MachineOp::Shift(_, a, _)
            | MachineOp::MaskNot(a)
            | MachineOp::Gather { index: a, .. } => [Some(a), None, None],
            MachineOp::Two(_, _, a, b)
            | MachineOp::Compare(_, a, b)
            | MachineOp::CompareInt(_, a, b)
            | MachineOp::TestBits(a, b)
            | MachineOp::MaskAnd(a, b)
            | MachineOp::MaskOr(a, b) => [Some(a), Some(b), None],
            MachineOp::Fma { a, b, c, .. }
            | MachineOp::Select(a, b, c)
            | MachineOp::MaskSelect(a, b, c)
            | MachineOp::Scale(a, b, c)
            | MachineOp::Permute(a, b, c) => [Some(a), Some(b), Some(c)],
        };
        all.into_iter().flatten()
    }

    /// Whether it lies in memory from the beginning.
    pub fn is_leaf(self) -> bool {
        matches!(self, MachineOp::Load(_)) || self.is_shared()
    }

    /// Whether it is the same in every vector, and lies in memory from the beginning.
    pub fn is_shared(self) -> bool {
        matches!(self, MachineOp::Constant(_) | MachineOp::Row(..))
    }

    /// Whether it lies in a mask register.
    pub fn is_mask(self, width: Vectors) -> bool {
        match self {
            MachineOp::Compare(..) | MachineOp::CompareInt(..) => width == Vectors::Avx512,
            MachineOp::Mask(_)
            | MachineOp::TestBits(..)
            | MachineOp::MaskAnd(..)
            | MachineOp::MaskOr(..)
            | MachineOp::MaskNot(_)
            | MachineOp::MaskSelect(..) => true,
            MachineOp::Load(_)
            | MachineOp::Constant(_)
            | MachineOp::Two(..)
            | MachineOp::One(..)
            | MachineOp::Fma { .. }
            | MachineOp::Shift(..)
            | MachineOp::Select(..)
            | MachineOp::Scale(..)
            | MachineOp::Gather { .. }
            | MachineOp::Row(..)
            | MachineOp::Permute(..) => false,
        }
    }
}

/// A function as nodes.
pub struct Nodes {
    pub nodes: Vec<MachineOp>,
    /// What is stored.
    pub stores: Vec<(Slot, Node)>,
    /// The status, an integer a lane.
    pub status: Option<Node>,
    /// A mask without which the status is 0.
    pub failed: Option<Node>,
    /// Whether the pool begins with the tables of the elementary functions.
    pub pooled: bool,
}

/// The bit of a real's sign.
pub const SIGN: u64 = 1 << 63;

/// `pooled`: the pool begins with the tables of the elementary functions.
///
/// # Errors
/// If a width has no instructions for an operation.
pub fn select(func: &Func, width: Vectors, pooled: bool) -> Result<Nodes, Unsupported> {
    if !func.writes.is_empty() {
        return Err(Unsupported("a ring of samples (delay) has no lanes".into()));
    }
    let mut selection = Selection::new(width);
    let of = selection.operations(func, &func.live())?;
    let at = |value: Value| of[value.index()];
    let failed = func.status.map(|status| match func.failure() {
        Some((when, true, _)) => at(when),
        Some((fine, false, _)) => {
            let not = selection.not(at(fine));
            selection.add(not)
        }
        None => {
            let zero = selection.add(MachineOp::Constant(0));
            let fine = selection.add(MachineOp::CompareInt(0, at(status), zero));
            let not = selection.not(fine);
            selection.add(not)
        }
    });
    let stores = func.stores.iter().map(|(slot, value)| (*slot, at(*value))).collect();
    Ok(Nodes { stores, status: func.status.map(at), failed, nodes: selection.nodes, pooled })
}

struct Selection {
    width: Vectors,
    nodes: Vec<MachineOp>,
    known: HashMap<MachineOp, Node>,
}

/// For each kind of number, of quiet NaN first, what becomes of it: a quiet NaN (2), itself (1), −1 (9) or 1 (10). The kinds are
/// quiet and signalling NaN, ±0, 1, −∞, ∞, below 0, above 0.
const SIGN_BY_KIND: u64 = 0xa9a9_a122;

impl Selection {
    fn new(width: Vectors) -> Selection {
        Selection { width, nodes: Vec::new(), known: HashMap::new() }
    }

    fn operations(&mut self, func: &Func, wanted: &[bool]) -> Result<Vec<Node>, Unsupported> {
        let types = verify::types(func).expect("the function is sound");
        let mut of: Vec<Node> = Vec::with_capacity(func.ops.len());
        for (k, op) in func.ops.iter().enumerate() {
            let node = if wanted[k] { self.node(func, *op, types[k], &of)? } else { Node(u32::MAX) };
            of.push(node);
        }
        Ok(of)
    }

    fn add(&mut self, what: MachineOp) -> Node {
        if let Some(known) = self.known.get(&what) {
            return *known;
        }
        self.nodes.push(what);
        let node = Node(self.nodes.len() as u32 - 1);
        self.known.insert(what, node);
        node
    }

    fn constant(&mut self, bits: u64) -> Node {
        self.add(MachineOp::Constant(bits))
    }

    fn not(&mut self, mask: Node) -> MachineOp {
        match (self.nodes[mask.index()], self.width) {
            (MachineOp::Compare(predicate, a, b), _) => MachineOp::Compare(predicate.not(), a, b),
            (_, Vectors::Avx512) => MachineOp::MaskNot(mask),
            _ => MachineOp::Two(i::XOR, true, mask, self.constant(u64::MAX)),
        }
    }

    /// `a` where a mask is set, `b` elsewhere. Without mask registers a mask has all bits or none.
    fn choose(&mut self, when: Node, a: Node, b: Node) -> MachineOp {
        let zero = MachineOp::Constant(0);
        match (self.width, self.nodes[a.index()], self.nodes[b.index()]) {
            (Vectors::Avx | Vectors::Avx2, a, _) if a == zero => MachineOp::Two(i::AND_NOT, false, when, b),
            (Vectors::Avx | Vectors::Avx2, _, b) if b == zero => MachineOp::Two(i::AND, true, when, a),
            _ => MachineOp::Select(when, a, b),
        }
    }

    fn missing(&self, what: &str) -> Unsupported {
        Unsupported(format!("{:?} has no {what}", self.width))
    }

    fn node(&mut self, func: &Func, op: Op, of_type: Type, of: &[Node]) -> Result<Node, Unsupported> {
        let at = |value: Value| of[value.index()];
        let wide = self.width == Vectors::Avx512;
        if let Some(x) = sign_of(op, |value| func.op(value)) {
            return Ok(self.sign(at(x)));
        }
        let what = match op {
            Op::Real(bits) => MachineOp::Constant(bits),
            Op::Int(n) => MachineOp::Constant(n as u64),
            Op::Bool(truth) if wide => MachineOp::Mask(truth),
            // Without mask registers a mask is a vector of all ones or zeros a lane.
            Op::Bool(truth) => MachineOp::Constant(if truth { u64::MAX } else { 0 }),
            Op::Load(slot) => MachineOp::Load(slot),
            Op::Pool { base, len, index } => {
                let index = self.inside(func, index, len, of);
                MachineOp::Gather { base, len, index }
            }
            Op::Ring { .. } => return Err(Unsupported("a ring of samples (delay) has no lanes".into())),
            Op::Add(a, b) => MachineOp::Two(i::ADD, true, at(a), at(b)),
            Op::Sub(a, b) => MachineOp::Two(i::SUB, false, at(a), at(b)),
            Op::Mul(a, b) => MachineOp::Two(i::MUL, true, at(a), at(b)),
            Op::Div(a, b) => MachineOp::Two(i::DIV, false, at(a), at(b)),
            Op::Neg(a) => MachineOp::Two(i::XOR, true, at(a), self.constant(SIGN)),
            Op::Abs(a) => MachineOp::Two(i::AND, true, at(a), self.constant(!SIGN)),
            Op::Sqrt(a) => MachineOp::One(i::SQRT, None, at(a)),
            Op::Fma(a, b, c) => {
                // (−a) b + c, a b − c and (−a) b − c are one instruction each, of the same rounding.
                let plain = |value: Value| match func.op(value) {
                    Op::Neg(inner) => (true, at(inner)),
                    _ => (false, at(value)),
                };
                let ((first, a), (second, b), (less, c)) = (plain(a), plain(b), plain(c));
                let signs = match (first != second, less) {
                    (false, false) => Signs::Plain,
                    (false, true) => Signs::Less,
                    (true, false) => Signs::Negated,
                    (true, true) => Signs::NegatedLess,
                };
                MachineOp::Fma { signs, a, b, c }
            }
            // Without an exception for what is not exact.
            Op::Floor(a) => MachineOp::One(i::ROUND, Some(9), at(a)),
            Op::Nearest(a) => MachineOp::One(i::ROUND, Some(8), at(a)),
            Op::Unary(Unary::Exp, x) => {
                return Ok(self.exp(at(x), is_not_positive(x, |value| func.op(value))));
            }
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Less(a, b) => MachineOp::Compare(Predicate::Less, at(a), at(b)),
            Op::LessEqual(a, b) => MachineOp::Compare(Predicate::LessEqual, at(a), at(b)),
            Op::Equal(a, b) => MachineOp::Compare(Predicate::Equal, at(a), at(b)),
            Op::And(a, b) if wide => MachineOp::MaskAnd(at(a), at(b)),
            Op::Or(a, b) if wide => MachineOp::MaskOr(at(a), at(b)),
            Op::And(a, b) => MachineOp::Two(i::AND, true, at(a), at(b)),
            Op::Or(a, b) => MachineOp::Two(i::OR, true, at(a), at(b)),
            Op::Not(a) => self.not(at(a)),
            Op::Select(when, a, b) => match (func.op(when), of_type) {
                (_, Type::Bool) if wide => MachineOp::MaskSelect(at(when), at(a), at(b)),
                // a < b ? a : b and a > b ? a : b, of NaN and zeros too.
                (Op::Less(x, y), Type::Real) if (x, y) == (a, b) => MachineOp::Two(i::MIN, false, at(a), at(b)),
                (Op::Less(x, y), Type::Real) if (x, y) == (b, a) => MachineOp::Two(i::MAX, false, at(a), at(b)),
                (Op::Not(not), _) => self.choose(at(not), at(b), at(a)),
                _ => self.choose(at(when), at(a), at(b)),
            },
            Op::IntAdd(a, b) => MachineOp::Two(i::INT_ADD, true, at(a), at(b)),
            Op::IntSub(a, b) => MachineOp::Two(i::INT_SUB, false, at(a), at(b)),
            Op::IntMul(a, b) if wide => MachineOp::Two(i::INT_MUL, true, at(a), at(b)),
            Op::IntMul(..) => return Err(self.missing("product of integers")),
            Op::IntAnd(a, b) => MachineOp::Two(i::AND, true, at(a), at(b)),
            Op::IntOr(a, b) => MachineOp::Two(i::OR, true, at(a), at(b)),
            Op::IntXor(a, b) => MachineOp::Two(i::XOR, true, at(a), at(b)),
            Op::ShiftLeft(a, n) => MachineOp::Shift(Direction::Left, at(a), n),
            Op::ShiftRight(a, n) => MachineOp::Shift(Direction::Right, at(a), n),
            Op::ShiftRightSigned(a, n) if wide => MachineOp::Shift(Direction::RightSigned, at(a), n),
            Op::ShiftRightSigned(a, n) => {
                // The sign bit after the shift, taken up to the top: ((x >> n) ^ s) − s.
                let shifted = self.add(MachineOp::Shift(Direction::Right, at(a), n));
                let sign = self.constant(SIGN >> n);
                let flipped = self.add(MachineOp::Two(i::XOR, true, shifted, sign));
                MachineOp::Two(i::INT_SUB, false, flipped, sign)
            }
            Op::IntLess(a, b) => MachineOp::CompareInt(1, at(a), at(b)),
            Op::IntEqual(a, b) => MachineOp::CompareInt(0, at(a), at(b)),
            Op::ToBits(a) | Op::FromBits(a) => return Ok(at(a)),
            Op::ToInt(a) if wide => {
                // What is too large or NaN becomes the least integer: right for what is too small only.
                let raw = self.add(MachineOp::One(i::TO_INT, None, at(a)));
                let limit = self.constant(9223372036854775808f64.to_bits());
                let large = self.add(MachineOp::Compare(Predicate::LessEqual, limit, at(a)));
                let most = self.constant(i64::MAX as u64);
                let held = self.add(MachineOp::Select(large, most, raw));
                let number = self.add(MachineOp::Compare(Predicate::Equal, at(a), at(a)));
                MachineOp::Select(number, held, self.constant(0))
            }
            Op::ToInt(_) => return Err(self.missing("conversion to integers")),
            Op::ToReal(a) if wide => MachineOp::One(i::TO_REAL, None, at(a)),
            Op::ToReal(_) => return Err(self.missing("conversion from integers")),
        };
        Ok(self.add(what))
    }

    /// ±1 with the sign of x, unless x is neither above nor below 0.
    fn sign(&mut self, x: Node) -> Node {
        if self.width == Vectors::Avx512 {
            let kinds = self.constant(SIGN_BY_KIND);
            return self.add(MachineOp::Two(i::BY_KIND, false, x, kinds));
        }
        let [sign, one, zero] = [SIGN, 1f64.to_bits(), 0].map(|bits| self.constant(bits));
        let negative = self.add(MachineOp::Two(i::AND, true, x, sign));
        let unit = self.add(MachineOp::Two(i::OR, true, negative, one));
        let moves = self.add(MachineOp::Compare(Predicate::LessOrGreater, x, zero));
        let what = self.choose(moves, unit, x);
        self.add(what)
    }

    /// e^x by the algorithm of [`exponential::exp`], to the bit, in fewer instructions: the power of two enters last, by one
    /// that rounds once more where the result is too small for all digits, as the algorithm does, and knows overflow.
    /// `falls`: x is not above 0. AVX-512 only.
    fn exp(&mut self, x: Node, falls: bool) -> Node {
        let number = |own: &mut Self, x: f64| own.constant(x.to_bits());
        // Below this the result is 0, and whatever is on the way is not looked at: to find out that a result is too small for any digit
        // may take a processor two hundred cycles. NaN is not below.
        let least = number(self, -746.0);
        let counts = self.add(MachineOp::Compare(Predicate::NotLess, x, least));
        // Beyond this it is infinite, and nothing on the way may be. Of NaN the second is taken.
        let mut x = x;
        if !falls {
            let most = number(self, 746.0);
            x = self.add(MachineOp::Two(i::MIN, false, most, x));
        }
        let fused =
            |own: &mut Self, signs: Signs, a: Node, b: Node, c: Node| own.add(MachineOp::Fma { signs, a, b, c });
        // Of ln 2, not of its 64th parts: k is the exponent at once. Its last digits, which tell the part, are the same.
        let parts = f64::from(tables::EXP_LEN);
        let [steps, round] = [exponential::STEPS, exponential::ROUND].map(|x| number(self, x / parts));
        let rounded = fused(self, Signs::Plain, x, steps, round);
        let k = self.add(MachineOp::Two(i::SUB, false, rounded, round));
        let [first, rest] = [exponential::STEP.0, exponential::STEP.1].map(|part| number(self, parts * part));
        let high = fused(self, Signs::Negated, k, first, x);
        let r = fused(self, Signs::Negated, k, rest, high);
        let scale = self.sixty_four(TableQuarter::Power, rounded);
        let tail = self.sixty_four(TableQuarter::Tail, rounded);
        let [c0, c1, c2, c3] = exponential::EXP.map(|c| number(self, c));
        let (low, top) = (fused(self, Signs::Plain, r, c1, c0), fused(self, Signs::Plain, r, c3, c2));
        let square = self.add(MachineOp::Two(i::MUL, true, r, r));
        let q = fused(self, Signs::Plain, square, top, low);
        let sum = self.add(MachineOp::Two(i::ADD, true, r, tail));
        let p = fused(self, Signs::Plain, square, q, sum);
        let mantissa = fused(self, Signs::Plain, scale, p, scale);
        self.add(MachineOp::Scale(counts, mantissa, k))
    }

    /// Entries of a table of 64 by the low six bits of an integer.
    fn sixty_four(&mut self, quarter: fn(u8) -> TableQuarter, index: Node) -> Node {
        let [mut a, b, mut c, d] = [0, 1, 2, 3].map(|number| {
            let [first, second] = [false, true].map(|second| self.add(MachineOp::Row(quarter(number), second)));
            self.add(MachineOp::Permute(first, second, index))
        });
        let [sixteen, thirty_two] = [16, 32].map(|bit| {
            let bit = self.constant(bit);
            self.add(MachineOp::TestBits(index, bit))
        });
        a = self.add(MachineOp::Select(sixteen, b, a));
        c = self.add(MachineOp::Select(sixteen, d, c));
        self.add(MachineOp::Select(thirty_two, c, a))
    }

    /// An index that lies inside a table: as it is, or the last where it is beyond.
    fn inside(&mut self, func: &Func, index: Value, len: u32, of: &[Node]) -> Node {
        let masked = |value: Value| match func.op(value) {
            Op::Int(mask) => (0..i64::from(len)).contains(&mask),
            _ => false,
        };
        let node = of[index.index()];
        let safe = match func.op(index) {
            Op::IntAnd(a, b) => masked(a) || masked(b),
            _ => masked(index),
        };
        if safe {
            return node;
        }
        let last = self.constant(u64::from(len) - 1);
        if self.width == Vectors::Avx512 {
            return self.add(MachineOp::Two(i::INT_MIN_UNSIGNED, true, node, last));
        }
        // Without a sign: with the top bit flipped, signed comparison is unsigned comparison.
        let sign = self.constant(SIGN);
        let flipped = self.add(MachineOp::Two(i::XOR, true, node, sign));
        let limit = self.constant((u64::from(len) - 1) ^ SIGN);
        let less = self.add(MachineOp::CompareInt(1, flipped, limit));
        self.add(MachineOp::Select(less, node, last))
    }
}
