//! Instruction selection for vectors of x86-64.
//!
//! In: an expanded function. Out: [`Nodes`], each of them one instruction or a fixed few, in the order of the function,
//! without duplicates. A select on a comparison of its own arms becomes a minimum or maximum; negations are absorbed by
//! fused multiply-adds; reals and integers share registers, so bit casts disappear. It does not know how many registers
//! there are.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, sec. 8.9.

use crate::codegen::lanes::assembler::{Instruction, Vectors, instructions as i};
use crate::codegen::unsupported::Unsupported;
use crate::ir::hash::HashMap;
use crate::ir::{Func, Op, Type, Unary, Value, Write, is_not_positive, sign_of, verify};
use crate::math::{self, exponential, tables};
use abi::Slot;

/// Index of a node.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct NodeId(pub u32);

impl NodeId {
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Signs of a fused multiply-add; the number is added to the opcode.
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

/// Predicate of a comparison of reals; the number is the immediate of VCMPPD.
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
    /// The complement, also for NaN.
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

    /// The same predicate with its operands exchanged.
    pub fn with_operands_exchanged(self) -> Predicate {
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

/// The operation of a node. A mask is a mask register or, where there are none, a vector with all bits set or cleared
/// in each lane.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum MachineOp {
    /// The value of a slot at the start of the iteration.
    Load(Slot),
    /// A constant in every lane, by its bits.
    Constant(u64),
    /// An instruction with two operands, and whether these commute.
    Binary(Instruction, bool, NodeId, NodeId),
    /// An instruction with one operand and perhaps an immediate.
    Unary(Instruction, Option<u8>, NodeId),
    /// ±a · b ± c
    Fma {
        signs: Signs,
        a: NodeId,
        b: NodeId,
        c: NodeId,
    },
    /// Shift by a constant.
    Shift(Direction, NodeId, u8),
    /// Comparison of reals; quiet: without an exception for NaN.
    Compare(Predicate, NodeId, NodeId),
    /// Comparison of integers: equal (0) or less (1).
    CompareInt(u8, NodeId, NodeId),
    /// A mask: whether two integers have a set bit in common. AVX-512 only.
    TestBits(NodeId, NodeId),
    /// A constant mask, the same in every lane.
    Mask(bool),
    MaskAnd(NodeId, NodeId),
    MaskOr(NodeId, NodeId),
    MaskNot(NodeId),
    /// The second operand in lanes where the first is true, else the third.
    Select(NodeId, NodeId, NodeId),
    /// As `Select`, of masks.
    MaskSelect(NodeId, NodeId, NodeId),
    /// b · 2^⌊c⌋ in lanes where the mask a is set, else 0, for operands a, b, c. AVX-512 only.
    Scale(NodeId, NodeId, NodeId),
    /// Entries of the table at `base` of the pool; indices are in range.
    Gather {
        base: u32,
        len: u32,
        index: NodeId,
    },
    /// The entry of the ring at a slot of the block; the index is in range. Scalar only.
    Ring(Slot, NodeId),
    /// A write of the second operand to the ring at a slot, at the index of the first, which is in range. It has no value.
    /// Scalar only.
    Write(Slot, NodeId, NodeId),
    /// Eight entries of a table: the first half of a quarter, or the second. The same in every vector. AVX-512 only.
    TableRow(TableQuarter, bool),
    /// Entries of a table of sixteen, which two rows hold, by the low four bits of an integer. AVX-512 only.
    Permute(NodeId, NodeId, NodeId),
}

/// A quarter of a table of 64 entries for e^x: the entries from i = 16 · number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum TableQuarter {
    /// 2^(i/64)
    Power(u8),
    /// 2^(i/64) minus its rounded value, relative to that.
    Tail(u8),
}

impl TableQuarter {
    /// The bits of its first or second eight entries.
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

/// Kind of shift.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Direction {
    Left,
    Right,
    RightSigned,
}

impl MachineOp {
    /// Operands from left to right.
    pub fn operands(self) -> impl Iterator<Item = NodeId> {
        let all = match self {
            MachineOp::Load(_) | MachineOp::Constant(_) | MachineOp::TableRow(..) | MachineOp::Mask(_) => [None; 3],
            MachineOp::Unary(_, _, a)
            | MachineOp::Shift(_, a, _)
            | MachineOp::MaskNot(a)
            | MachineOp::Ring(_, a)
            | MachineOp::Gather { index: a, .. } => [Some(a), None, None],
            MachineOp::Binary(_, _, a, b)
            | MachineOp::Compare(_, a, b)
            | MachineOp::CompareInt(_, a, b)
            | MachineOp::TestBits(a, b)
            | MachineOp::MaskAnd(a, b)
            | MachineOp::MaskOr(a, b)
            | MachineOp::Write(_, a, b) => [Some(a), Some(b), None],
            MachineOp::Fma { a, b, c, .. }
            | MachineOp::Select(a, b, c)
            | MachineOp::MaskSelect(a, b, c)
            | MachineOp::Scale(a, b, c)
            | MachineOp::Permute(a, b, c) => [Some(a), Some(b), Some(c)],
        };
        all.into_iter().flatten()
    }

    /// Whether the value is in memory before the code runs.
    pub fn is_leaf(self) -> bool {
        matches!(self, MachineOp::Load(_)) || self.is_shared()
    }

    /// Whether the value is a constant in memory, which all vectors share.
    pub fn is_shared(self) -> bool {
        matches!(self, MachineOp::Constant(_) | MachineOp::TableRow(..))
    }

    /// Whether the value is in a mask register.
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
            | MachineOp::Binary(..)
            | MachineOp::Unary(..)
            | MachineOp::Fma { .. }
            | MachineOp::Shift(..)
            | MachineOp::Select(..)
            | MachineOp::Scale(..)
            | MachineOp::Gather { .. }
            | MachineOp::Ring(..)
            | MachineOp::Write(..)
            | MachineOp::TableRow(..)
            | MachineOp::Permute(..) => false,
        }
    }
}

/// A function after instruction selection.
pub struct Nodes {
    pub nodes: Vec<MachineOp>,
    /// Stores to slots of the block.
    pub stores: Vec<(Slot, NodeId)>,
    /// Writes to rings, after the stores. Scalar only.
    pub writes: Vec<NodeId>,
    /// The status, an integer per lane.
    pub status: Option<NodeId>,
    /// A mask; in lanes where it is not set the status is 0.
    pub failed: Option<NodeId>,
    /// Whether the pool begins with the tables of the elementary functions.
    pub pooled: bool,
}

impl Nodes {
    /// The nodes that are stored, and the status.
    pub fn results(&self) -> impl Iterator<Item = NodeId> {
        self.stores.iter().map(|(_, node)| *node).chain(self.status)
    }
}

/// The sign bit of a real.
pub const SIGN: u64 = 1 << 63;

/// Selects instructions for a function. `pooled`: the pool begins with the tables of the elementary functions.
///
/// # Errors
/// If the width has no instruction for an operation.
pub fn select(func: &Func, width: Vectors, pooled: bool) -> Result<Nodes, Unsupported> {
    if !func.writes.is_empty() && width != Vectors::Scalar {
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
    let write = |write: &Write| {
        let index = selection.clamped_index(func, write.index, write.len, &of);
        selection.add(MachineOp::Write(write.base, index, at(write.value)))
    };
    let writes = func.writes.iter().map(write).collect();
    Ok(Nodes { stores, writes, status: func.status.map(at), failed, nodes: selection.nodes, pooled })
}

struct Selection {
    width: Vectors,
    nodes: Vec<MachineOp>,
    known: HashMap<MachineOp, NodeId>,
}

/// Response table of VFIXUPIMMPD for the sign of a real, four bits per kind of source: 2 is a quiet NaN, 1 the source
/// itself, 9 is −1, 10 is 1. The kinds from the lowest bits up: quiet NaN, signalling NaN, ±0, 1, −∞, ∞, negative,
/// positive.
const SIGN_RESPONSES: u64 = 0xa9a9_a122;

impl Selection {
    fn new(width: Vectors) -> Selection {
        Selection { width, nodes: Vec::new(), known: HashMap::default() }
    }

    fn operations(&mut self, func: &Func, live: &[bool]) -> Result<Vec<NodeId>, Unsupported> {
        let types = verify::types(func).expect("the function is sound");
        let mut of: Vec<NodeId> = Vec::with_capacity(func.ops.len());
        for (k, op) in func.ops.iter().enumerate() {
            let node = if live[k] { self.node(func, *op, types[k], &of)? } else { NodeId(u32::MAX) };
            of.push(node);
        }
        Ok(of)
    }

    fn add(&mut self, op: MachineOp) -> NodeId {
        if let Some(known) = self.known.get(&op) {
            return *known;
        }
        self.nodes.push(op);
        let node = NodeId(self.nodes.len() as u32 - 1);
        self.known.insert(op, node);
        node
    }

    fn constant(&mut self, bits: u64) -> NodeId {
        self.add(MachineOp::Constant(bits))
    }

    fn not(&mut self, mask: NodeId) -> MachineOp {
        match (self.nodes[mask.index()], self.width) {
            (MachineOp::Compare(predicate, a, b), _) => MachineOp::Compare(predicate.not(), a, b),
            (_, Vectors::Avx512) => MachineOp::MaskNot(mask),
            _ => MachineOp::Binary(i::VXORPD, true, mask, self.constant(u64::MAX)),
        }
    }

    /// `a` in lanes where a mask is set, `b` elsewhere. Without mask registers, if one of them is 0, a bitwise
    /// operation with the mask is enough.
    fn select_lanes(&mut self, when: NodeId, a: NodeId, b: NodeId) -> MachineOp {
        let zero = MachineOp::Constant(0);
        match (self.width, self.nodes[a.index()], self.nodes[b.index()]) {
            (Vectors::Scalar | Vectors::Avx | Vectors::Avx2, a, _) if a == zero => {
                MachineOp::Binary(i::VANDNPD, false, when, b)
            }
            (Vectors::Scalar | Vectors::Avx | Vectors::Avx2, _, b) if b == zero => {
                MachineOp::Binary(i::VANDPD, true, when, a)
            }
            _ => MachineOp::Select(when, a, b),
        }
    }

    fn missing(&self, name: &str) -> Unsupported {
        Unsupported(format!("{:?} has no {name}", self.width))
    }

    fn node(&mut self, func: &Func, op: Op, of_type: Type, of: &[NodeId]) -> Result<NodeId, Unsupported> {
        let at = |value: Value| of[value.index()];
        let has_masks = self.width == Vectors::Avx512;
        // AVX and AVX2 neither multiply 64-bit integers nor convert them. Code for a single lane does so in general registers.
        let has_integers = has_masks || self.width == Vectors::Scalar;
        if let Some(x) = sign_of(op, |value| func.op(value)) {
            return Ok(self.sign(at(x)));
        }
        let machine_op = match op {
            Op::Real(bits) => MachineOp::Constant(bits),
            Op::Int(n) => MachineOp::Constant(n as u64),
            Op::Bool(truth) if has_masks => MachineOp::Mask(truth),
            // Without mask registers a mask is a vector with all bits set or cleared in each lane.
            Op::Bool(truth) => MachineOp::Constant(if truth { u64::MAX } else { 0 }),
            Op::Load(slot) => MachineOp::Load(slot),
            Op::Pool { base, len, index } => {
                let index = self.clamped_index(func, index, len, of);
                MachineOp::Gather { base, len, index }
            }
            Op::Ring { base, len, index } if self.width == Vectors::Scalar => {
                MachineOp::Ring(base, self.clamped_index(func, index, len, of))
            }
            Op::Ring { .. } => return Err(Unsupported("a ring of samples (delay) has no lanes".into())),
            Op::Add(a, b) => MachineOp::Binary(i::VADDPD, true, at(a), at(b)),
            Op::Sub(a, b) => MachineOp::Binary(i::VSUBPD, false, at(a), at(b)),
            Op::Mul(a, b) => MachineOp::Binary(i::VMULPD, true, at(a), at(b)),
            Op::Div(a, b) => MachineOp::Binary(i::VDIVPD, false, at(a), at(b)),
            Op::Neg(a) => MachineOp::Binary(i::VXORPD, true, at(a), self.constant(SIGN)),
            Op::Abs(a) => MachineOp::Binary(i::VANDPD, true, at(a), self.constant(!SIGN)),
            Op::Sqrt(a) => MachineOp::Unary(i::VSQRTPD, None, at(a)),
            Op::Fma(a, b, c) => {
                // (−a) b + c, a b − c and (−a) b − c are single instructions with the same rounding.
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
            // Bit 3 of the immediate suppresses the exception for inexact results.
            Op::Floor(a) => MachineOp::Unary(i::VROUNDPD, Some(9), at(a)),
            Op::Nearest(a) => MachineOp::Unary(i::VROUNDPD, Some(8), at(a)),
            Op::Unary(Unary::Exp, x) => {
                return Ok(self.exp(at(x), is_not_positive(x, |value| func.op(value))));
            }
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Less(a, b) => MachineOp::Compare(Predicate::Less, at(a), at(b)),
            Op::LessEqual(a, b) => MachineOp::Compare(Predicate::LessEqual, at(a), at(b)),
            Op::Equal(a, b) => MachineOp::Compare(Predicate::Equal, at(a), at(b)),
            Op::And(a, b) if has_masks => MachineOp::MaskAnd(at(a), at(b)),
            Op::Or(a, b) if has_masks => MachineOp::MaskOr(at(a), at(b)),
            Op::And(a, b) => MachineOp::Binary(i::VANDPD, true, at(a), at(b)),
            Op::Or(a, b) => MachineOp::Binary(i::VORPD, true, at(a), at(b)),
            Op::Not(a) => self.not(at(a)),
            Op::Select(when, a, b) => match (func.op(when), of_type) {
                (_, Type::Bool) if has_masks => MachineOp::MaskSelect(at(when), at(a), at(b)),
                // a < b ? a : b and a > b ? a : b are exactly MIN and MAX, also for NaN and zeros.
                (Op::Less(x, y), Type::Real) if (x, y) == (a, b) => MachineOp::Binary(i::VMINPD, false, at(a), at(b)),
                (Op::Less(x, y), Type::Real) if (x, y) == (b, a) => MachineOp::Binary(i::VMAXPD, false, at(a), at(b)),
                (Op::Not(not), _) => self.select_lanes(at(not), at(b), at(a)),
                _ => self.select_lanes(at(when), at(a), at(b)),
            },
            Op::IntAdd(a, b) => MachineOp::Binary(i::VPADDQ, true, at(a), at(b)),
            Op::IntSub(a, b) => MachineOp::Binary(i::VPSUBQ, false, at(a), at(b)),
            Op::IntMul(a, b) if has_integers => MachineOp::Binary(i::VPMULLQ, true, at(a), at(b)),
            Op::IntMul(..) => return Err(self.missing("product of integers")),
            Op::IntAnd(a, b) => MachineOp::Binary(i::VANDPD, true, at(a), at(b)),
            Op::IntOr(a, b) => MachineOp::Binary(i::VORPD, true, at(a), at(b)),
            Op::IntXor(a, b) => MachineOp::Binary(i::VXORPD, true, at(a), at(b)),
            Op::ShiftLeft(a, n) => MachineOp::Shift(Direction::Left, at(a), n),
            Op::ShiftRight(a, n) => MachineOp::Shift(Direction::Right, at(a), n),
            Op::ShiftRightSigned(a, n) if has_masks => MachineOp::Shift(Direction::RightSigned, at(a), n),
            Op::ShiftRightSigned(a, n) => {
                // Arithmetic shift from a logical one: ((x >> n) ^ s) − s extends the sign bit s of the shifted value.
                let shifted = self.add(MachineOp::Shift(Direction::Right, at(a), n));
                let sign = self.constant(SIGN >> n);
                let flipped = self.add(MachineOp::Binary(i::VXORPD, true, shifted, sign));
                MachineOp::Binary(i::VPSUBQ, false, flipped, sign)
            }
            Op::IntLess(a, b) => MachineOp::CompareInt(1, at(a), at(b)),
            Op::IntEqual(a, b) => MachineOp::CompareInt(0, at(a), at(b)),
            Op::ToBits(a) | Op::FromBits(a) => return Ok(at(a)),
            Op::ToInt(a) if has_integers => {
                // The instruction returns the smallest integer for NaN and all values out of range; right only for
                // those that are too small.
                let raw = self.add(MachineOp::Unary(i::VCVTTPD2QQ, None, at(a)));
                let limit = self.constant(9223372036854775808f64.to_bits());
                let large = self.add(MachineOp::Compare(Predicate::LessEqual, limit, at(a)));
                let most = self.constant(i64::MAX as u64);
                let held = self.add(MachineOp::Select(large, most, raw));
                let number = self.add(MachineOp::Compare(Predicate::Equal, at(a), at(a)));
                MachineOp::Select(number, held, self.constant(0))
            }
            Op::ToInt(_) => return Err(self.missing("conversion to integers")),
            Op::ToReal(a) if has_integers => MachineOp::Unary(i::VCVTQQ2PD, None, at(a)),
            Op::ToReal(_) => return Err(self.missing("conversion from integers")),
        };
        Ok(self.add(machine_op))
    }

    /// ±1 with the sign of x; x itself if it is ±0 or NaN.
    fn sign(&mut self, x: NodeId) -> NodeId {
        if self.width == Vectors::Avx512 {
            let kinds = self.constant(SIGN_RESPONSES);
            return self.add(MachineOp::Binary(i::VFIXUPIMMPD, false, x, kinds));
        }
        let [sign, one, zero] = [SIGN, 1f64.to_bits(), 0].map(|bits| self.constant(bits));
        let negative = self.add(MachineOp::Binary(i::VANDPD, true, x, sign));
        let unit = self.add(MachineOp::Binary(i::VORPD, true, negative, one));
        let moves = self.add(MachineOp::Compare(Predicate::LessOrGreater, x, zero));
        let machine_op = self.select_lanes(moves, unit, x);
        self.add(machine_op)
    }

    /// e^x with the bits of [`exponential::exp`], in fewer instructions. The power of two is applied last, by
    /// VSCALEFPD: it rounds a second time where the result is subnormal, as the algorithm does, and handles overflow.
    /// `not_positive`: x is known to be ≤ 0 or NaN. AVX-512 only.
    fn exp(&mut self, x: NodeId, not_positive: bool) -> NodeId {
        let number = |own: &mut Self, x: f64| own.constant(x.to_bits());
        // Below this bound the result is 0, and a mask excludes the lane from VSCALEFPD, which may take two hundred
        // cycles for an underflow. NaN is not excluded.
        let least = number(self, -746.0);
        let is_not_zero = self.add(MachineOp::Compare(Predicate::NotLess, x, least));
        // Above this bound the result is infinite; the minimum keeps intermediate values finite. VMINPD returns its
        // second operand if one is NaN.
        let mut x = x;
        if !not_positive {
            let most = number(self, 746.0);
            x = self.add(MachineOp::Binary(i::VMINPD, false, most, x));
        }
        let fused =
            |own: &mut Self, signs: Signs, a: NodeId, b: NodeId, c: NodeId| own.add(MachineOp::Fma { signs, a, b, c });
        // Here k counts multiples of ln 2 in steps of 1/64, where the algorithm counts multiples of ln 2 / 64. So the
        // floor of k is the exponent. The low six bits of `rounded` are the table index in both.
        let parts = f64::from(tables::EXP_LEN);
        let [steps, round] = [exponential::STEPS, exponential::ROUND].map(|x| number(self, x / parts));
        let rounded = fused(self, Signs::Plain, x, steps, round);
        let k = self.add(MachineOp::Binary(i::VSUBPD, false, rounded, round));
        let [first, rest] = [exponential::STEP.0, exponential::STEP.1].map(|part| number(self, parts * part));
        let high = fused(self, Signs::Negated, k, first, x);
        let r = fused(self, Signs::Negated, k, rest, high);
        let scale = self.table_of_64(TableQuarter::Power, rounded);
        let tail = self.table_of_64(TableQuarter::Tail, rounded);
        let [c0, c1, c2, c3] = exponential::EXP.map(|c| number(self, c));
        let (low, top) = (fused(self, Signs::Plain, r, c1, c0), fused(self, Signs::Plain, r, c3, c2));
        let square = self.add(MachineOp::Binary(i::VMULPD, true, r, r));
        let q = fused(self, Signs::Plain, square, top, low);
        let sum = self.add(MachineOp::Binary(i::VADDPD, true, r, tail));
        let p = fused(self, Signs::Plain, square, q, sum);
        let mantissa = fused(self, Signs::Plain, scale, p, scale);
        self.add(MachineOp::Scale(is_not_zero, mantissa, k))
    }

    /// Entries of a table of 64 by the low six bits of an integer.
    fn table_of_64(&mut self, quarter: fn(u8) -> TableQuarter, index: NodeId) -> NodeId {
        let [mut a, b, mut c, d] = [0, 1, 2, 3].map(|number| {
            let [first, second] = [false, true].map(|second| self.add(MachineOp::TableRow(quarter(number), second)));
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

    /// A table index that is clamped to the last entry, unless it is known to be in range.
    fn clamped_index(&mut self, func: &Func, index: Value, len: u32, of: &[NodeId]) -> NodeId {
        let is_masked = |value: Value| match func.op(value) {
            Op::Int(mask) => (0..i64::from(len)).contains(&mask),
            _ => false,
        };
        let node = of[index.index()];
        let safe = match func.op(index) {
            Op::IntAnd(a, b) => is_masked(a) || is_masked(b),
            _ => is_masked(index),
        };
        if safe {
            return node;
        }
        let last = self.constant(u64::from(len) - 1);
        if self.width == Vectors::Avx512 {
            return self.add(MachineOp::Binary(i::VPMINUQ, true, node, last));
        }
        // With the top bits flipped, a signed comparison compares unsigned numbers.
        let sign = self.constant(SIGN);
        let flipped = self.add(MachineOp::Binary(i::VXORPD, true, node, sign));
        let limit = self.constant((u64::from(len) - 1) ^ SIGN);
        let less = self.add(MachineOp::CompareInt(1, flipped, limit));
        self.add(MachineOp::Select(less, node, last))
    }
}
