//! Operations of a function as vector instructions.
//!
//! In: an expanded function. Out: nodes that are each one instruction or a fixed few, in the order of the function. A
//! comparison whose result a selection takes from becomes a minimum or maximum, a negated factor enters the fused
//! product, bits and numbers are one.

use super::encode::{Instruction, Width, instructions as i};
use crate::backend::target::Unsupported;
use crate::ir::{Func, Op, Type, Value, verify};
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

/// What a node computes. A mask is a mask register, or without those a vector of all ones or zeros a lane.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum What {
    /// The value of a slot when an iteration begins.
    Load(Slot),
    /// The same number in every lane, by its bits.
    Constant(u64),
    /// An instruction of two operands; whether they can be exchanged.
    Two(Instruction, bool, Node, Node),
    /// An instruction of one operand, with an immediate.
    One(Instruction, Option<u8>, Node),
    /// ±a · b + c
    Fma {
        negated: bool,
        a: Node,
        b: Node,
        c: Node,
    },
    /// Left, right, or right with the sign, by a constant.
    Shift(Direction, Node, u8),
    /// Comparison of reals: LT, LE or EQ of the manual, quiet.
    Compare(u8, Node, Node),
    /// Comparison of integers: equal (0) or less (1).
    CompareInt(u8, Node, Node),
    /// A mask that is the same in every lane.
    Mask(bool),
    MaskAnd(Node, Node),
    MaskOr(Node, Node),
    MaskNot(Node),
    /// Lanes of the second where the first is true, else of the third.
    Select(Node, Node, Node),
    /// The same of masks.
    MaskSelect(Node, Node, Node),
    /// Entries of the table at `base`, at indices that lie inside.
    Gather {
        base: u32,
        index: Node,
    },
}

/// Of a shift.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Direction {
    Left,
    Right,
    RightSigned,
}

impl What {
    /// Operands from left to right.
    pub fn operands(self) -> impl Iterator<Item = Node> {
        let all = match self {
            What::Load(_) | What::Constant(_) | What::Mask(_) => [None; 3],
            What::One(_, _, a) | What::Shift(_, a, _) | What::MaskNot(a) | What::Gather { index: a, .. } => {
                [Some(a), None, None]
            }
            What::Two(_, _, a, b)
            | What::Compare(_, a, b)
            | What::CompareInt(_, a, b)
            | What::MaskAnd(a, b)
            | What::MaskOr(a, b) => [Some(a), Some(b), None],
            What::Fma { a, b, c, .. } | What::Select(a, b, c) | What::MaskSelect(a, b, c) => {
                [Some(a), Some(b), Some(c)]
            }
        };
        all.into_iter().flatten()
    }

    /// Whether it lies in a mask register.
    pub fn is_mask(self, width: Width) -> bool {
        match self {
            What::Compare(..) | What::CompareInt(..) => width == Width::Avx512,
            What::Mask(_) | What::MaskAnd(..) | What::MaskOr(..) | What::MaskNot(_) | What::MaskSelect(..) => true,
            What::Load(_)
            | What::Constant(_)
            | What::Two(..)
            | What::One(..)
            | What::Fma { .. }
            | What::Shift(..)
            | What::Select(..)
            | What::Gather { .. } => false,
        }
    }
}

/// A function as nodes.
pub struct Nodes {
    pub nodes: Vec<What>,
    /// What is stored.
    pub stores: Vec<(Slot, Node)>,
    /// The status, an integer a lane.
    pub status: Option<Node>,
    /// A mask without which the status is 0.
    pub failed: Option<Node>,
}

const SIGN: u64 = 1 << 63;

/// # Errors
/// If a width has no instructions for an operation.
pub fn select(func: &Func, width: Width) -> Result<Nodes, Unsupported> {
    if !func.writes.is_empty() {
        return Err(Unsupported("a ring of samples (delay) has no lanes".into()));
    }
    let mut selection = Selection { width, nodes: Vec::new(), known: HashMap::new() };
    let types = verify::types(func).expect("the function is sound");
    let live = func.live();
    let mut of: Vec<Node> = Vec::with_capacity(func.ops.len());
    for (k, op) in func.ops.iter().enumerate() {
        let node = if live[k] { selection.node(func, *op, types[k], &of)? } else { Node(u32::MAX) };
        of.push(node);
    }
    let at = |value: Value| of[value.index()];
    let failed = func.status.map(|status| match func.op(status) {
        Op::Select(when, _, zero) if func.op(zero) == Op::Int(0) => at(when),
        _ => {
            let zero = selection.add(What::Constant(0));
            let fine = selection.add(What::CompareInt(0, at(status), zero));
            let not = selection.not(fine);
            selection.add(not)
        }
    });
    let stores = func.stores.iter().map(|(slot, value)| (*slot, at(*value))).collect();
    Ok(Nodes { stores, status: func.status.map(at), failed, nodes: selection.nodes })
}

struct Selection {
    width: Width,
    nodes: Vec<What>,
    known: HashMap<What, Node>,
}

impl Selection {
    fn add(&mut self, what: What) -> Node {
        if let Some(known) = self.known.get(&what) {
            return *known;
        }
        self.nodes.push(what);
        let node = Node(self.nodes.len() as u32 - 1);
        self.known.insert(what, node);
        node
    }

    fn constant(&mut self, bits: u64) -> Node {
        self.add(What::Constant(bits))
    }

    fn not(&mut self, mask: Node) -> What {
        match self.width {
            Width::Avx512 => What::MaskNot(mask),
            Width::Avx2 => What::Two(i::XOR, true, mask, self.constant(u64::MAX)),
        }
    }

    fn missing(&self, what: &str) -> Unsupported {
        Unsupported(format!("{:?} has no {what}", self.width))
    }

    fn node(&mut self, func: &Func, op: Op, of_type: Type, of: &[Node]) -> Result<Node, Unsupported> {
        let at = |value: Value| of[value.index()];
        let wide = self.width == Width::Avx512;
        let what = match op {
            Op::Real(bits) => What::Constant(bits),
            Op::Int(n) => What::Constant(n as u64),
            Op::Bool(truth) if wide => What::Mask(truth),
            // Without mask registers a mask is a vector of all ones or zeros a lane.
            Op::Bool(truth) => What::Constant(if truth { u64::MAX } else { 0 }),
            Op::Load(slot) => What::Load(slot),
            Op::Pool { base, len, index } => {
                let index = self.inside(func, index, len, of);
                What::Gather { base, index }
            }
            Op::Ring { .. } => return Err(Unsupported("a ring of samples (delay) has no lanes".into())),
            Op::Add(a, b) => What::Two(i::ADD, true, at(a), at(b)),
            Op::Sub(a, b) => What::Two(i::SUB, false, at(a), at(b)),
            Op::Mul(a, b) => What::Two(i::MUL, true, at(a), at(b)),
            Op::Div(a, b) => What::Two(i::DIV, false, at(a), at(b)),
            Op::Neg(a) => What::Two(i::XOR, true, at(a), self.constant(SIGN)),
            Op::Abs(a) => What::Two(i::AND, true, at(a), self.constant(!SIGN)),
            Op::Sqrt(a) => What::One(i::SQRT, None, at(a)),
            Op::Fma(a, b, c) => {
                // (−a) b + c is one instruction, of the same rounding.
                let plain = |value: Value| match func.op(value) {
                    Op::Neg(inner) => (true, at(inner)),
                    _ => (false, at(value)),
                };
                let ((first, a), (second, b)) = (plain(a), plain(b));
                What::Fma { negated: first != second, a, b, c: at(c) }
            }
            // Without an exception for what is not exact.
            Op::Floor(a) => What::One(i::ROUND, Some(9), at(a)),
            Op::Nearest(a) => What::One(i::ROUND, Some(8), at(a)),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Less(a, b) => What::Compare(0x11, at(a), at(b)),
            Op::LessEqual(a, b) => What::Compare(0x12, at(a), at(b)),
            Op::Equal(a, b) => What::Compare(0, at(a), at(b)),
            Op::And(a, b) if wide => What::MaskAnd(at(a), at(b)),
            Op::Or(a, b) if wide => What::MaskOr(at(a), at(b)),
            Op::And(a, b) => What::Two(i::AND, true, at(a), at(b)),
            Op::Or(a, b) => What::Two(i::OR, true, at(a), at(b)),
            Op::Not(a) => self.not(at(a)),
            Op::Select(when, a, b) => match (func.op(when), of_type) {
                (_, Type::Bool) if wide => What::MaskSelect(at(when), at(a), at(b)),
                // a < b ? a : b and a > b ? a : b, of NaN and zeros too.
                (Op::Less(x, y), Type::Real) if (x, y) == (a, b) => What::Two(i::MIN, false, at(a), at(b)),
                (Op::Less(x, y), Type::Real) if (x, y) == (b, a) => What::Two(i::MAX, false, at(a), at(b)),
                _ => What::Select(at(when), at(a), at(b)),
            },
            Op::IntAdd(a, b) => What::Two(i::INT_ADD, true, at(a), at(b)),
            Op::IntSub(a, b) => What::Two(i::INT_SUB, false, at(a), at(b)),
            Op::IntMul(a, b) if wide => What::Two(i::INT_MUL, true, at(a), at(b)),
            Op::IntMul(..) => return Err(self.missing("product of integers")),
            Op::IntAnd(a, b) => What::Two(i::AND, true, at(a), at(b)),
            Op::IntOr(a, b) => What::Two(i::OR, true, at(a), at(b)),
            Op::IntXor(a, b) => What::Two(i::XOR, true, at(a), at(b)),
            Op::ShiftLeft(a, n) => What::Shift(Direction::Left, at(a), n),
            Op::ShiftRight(a, n) => What::Shift(Direction::Right, at(a), n),
            Op::ShiftRightSigned(a, n) if wide => What::Shift(Direction::RightSigned, at(a), n),
            Op::ShiftRightSigned(a, n) => {
                // The sign bit after the shift, taken up to the top: ((x >> n) ^ s) − s.
                let shifted = self.add(What::Shift(Direction::Right, at(a), n));
                let sign = self.constant(SIGN >> n);
                let flipped = self.add(What::Two(i::XOR, true, shifted, sign));
                What::Two(i::INT_SUB, false, flipped, sign)
            }
            Op::IntLess(a, b) => What::CompareInt(1, at(a), at(b)),
            Op::IntEqual(a, b) => What::CompareInt(0, at(a), at(b)),
            Op::ToBits(a) | Op::FromBits(a) => return Ok(at(a)),
            Op::ToInt(a) if wide => {
                // What is too large or NaN becomes the least integer: right for what is too small only.
                let raw = self.add(What::One(i::TO_INT, None, at(a)));
                let limit = self.constant(9223372036854775808f64.to_bits());
                let large = self.add(What::Compare(0x12, limit, at(a)));
                let most = self.constant(i64::MAX as u64);
                let held = self.add(What::Select(large, most, raw));
                let number = self.add(What::Compare(0, at(a), at(a)));
                What::Select(number, held, self.constant(0))
            }
            Op::ToInt(_) => return Err(self.missing("conversion to integers")),
            Op::ToReal(a) if wide => What::One(i::TO_REAL, None, at(a)),
            Op::ToReal(_) => return Err(self.missing("conversion from integers")),
        };
        Ok(self.add(what))
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
        if self.width == Width::Avx512 {
            return self.add(What::Two(i::INT_MIN_UNSIGNED, true, node, last));
        }
        // Without a sign: with the top bit flipped, signed comparison is unsigned comparison.
        let sign = self.constant(SIGN);
        let flipped = self.add(What::Two(i::XOR, true, node, sign));
        let limit = self.constant((u64::from(len) - 1) ^ SIGN);
        let less = self.add(What::CompareInt(1, flipped, limit));
        self.add(What::Select(less, node, last))
    }
}
