//! Emits lanes in vectors of two doubles as Cranelift IR, for any processor that there is machine code for.
//!
//! In: an expanded function. Out: a Cranelift function with the signature of [`LanesEntry`](abi::lanes::LanesEntry),
//! with the same structure as the code for the other widths, see `lanes`. Cranelift must keep the order of the
//! instructions, which interleaves the vectors. Loads and constants are memory operands of the instructions that read
//! them, because there are only 16 registers.

use crate::codegen::emit::signature;
use crate::codegen::loop_plan::{LoopPlan, StraightLine, plan};
use crate::codegen::unsupported::Unsupported;
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::scc::topological_order;
use crate::ir::{Func, Op, Type, Value, verify};
use abi::{Layout, Slot};
use cranelift_codegen::ir::condcodes::{FloatCC, IntCC};
use cranelift_codegen::ir::{self as clif, AbiParam, BlockArg, InstBuilder, MemFlagsData, types};
use cranelift_codegen::isa::TargetIsa;
use cranelift_frontend::{FunctionBuilder, FunctionBuilderContext};

/// Doubles of a vector.
pub const LANES: usize = 2;
/// Bytes of a vector.
const BYTES: usize = 8 * LANES;
const SIGN: u64 = 1 << 63;

/// Emits the step for `vectors` interleaved vectors into the empty `target`; returns the number of doubles it needs
/// after the blocks.
///
/// # Errors
/// If the function has a ring, or is too large.
pub fn emit(
    func: &Func,
    layout: &Layout,
    vectors: usize,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) -> Result<usize, Unsupported> {
    if !func.writes.is_empty() || func.ops.iter().any(|op| matches!(op, Op::Ring { .. })) {
        return Err(Unsupported("a ring of samples (delay) has no lanes".into()));
    }
    let types = verify::types(func).expect("the function is sound");
    let step = VectorStep { func, types, vectors, plan: plan(func, layout.size(), vectors * BYTES, None) };
    let plan = &step.plan;
    target.signature = signature(isa);
    target.signature.params.push(AbiParam::new(types::I64));
    let mut b = FunctionBuilder::new(target, context);
    let [entry, constants, prepare, top, fast, next, last, nothing] = [(); 8].map(|()| b.create_block());
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count, statuses] = b.block_params(entry) else { unreachable!("four parameters") };
    b.ins().brif(count, constants, &[], nothing, &[]);
    b.switch_to_block(nothing);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);

    let blend = isa.name() == "x64";
    let values = HashMap::default();
    let mut line = Emitter {
        step: &step,
        plan,
        b,
        block,
        pool,
        before: block,
        after: block,
        statuses,
        blend,
        values,
        constants: Vec::new(),
    };
    line.b.switch_to_block(prepare);
    line.write(&plan.prologue, &[], |value| step.hoisted_place(value).into_iter().collect());
    for index in 0..plan.carried.len() {
        for k in 0..vectors {
            let number = line.load(types::F64X2, VectorPlace::Block(plan.carried[index].0), k);
            line.store(number, VectorPlace::Area(0, index), k);
        }
    }
    let areas = [0, 1].map(|area| line.b.ins().iadd_imm_s(block, plan.areas[area] as i64));
    let last_one = line.b.ins().iadd_imm_s(count, -1);
    let none = line.b.ins().iconst(types::I64, 0);
    let [first, second] = areas;
    match plan.carried.is_empty() {
        true => line.b.ins().jump(last, &[first, last_one].map(BlockArg::Value)),
        false => line.b.ins().jump(top, &[first, second, none].map(BlockArg::Value)),
    };

    let [before, after, done] = [(); 3].map(|()| line.b.append_block_param(top, types::I64));
    line.b.switch_to_block(top);
    let is_last = line.b.ins().icmp(IntCC::UnsignedGreaterThanOrEqual, done, last_one);
    let to_last = [BlockArg::Value(before), BlockArg::Value(done)];
    line.b.ins().brif(is_last, last, &to_last, fast, &[]);
    line.b.switch_to_block(fast);
    line.values.clear();
    (line.before, line.after) = (before, after);
    let carried: Vec<Value> = plan.carried.iter().map(|(_, value)| *value).collect();
    line.write(&plan.body, &carried, |value| {
        let of = plan.carried.iter().enumerate().filter(|(_, (_, next))| *next == value);
        of.map(|(index, _)| VectorPlace::After(index)).collect()
    });
    match func.failed() {
        None => line.b.ins().jump(next, &[]),
        Some(failed) => {
            let mut any = line.get(failed, 0);
            for k in 1..vectors {
                let more = line.get(failed, k);
                any = line.b.ins().bor(any, more);
            }
            let any = line.b.ins().vany_true(any);
            line.b.ins().brif(any, last, &to_last, next, &[])
        }
    };
    line.b.switch_to_block(next);
    let more = line.b.ins().iadd_imm_s(done, 1);
    line.b.ins().jump(top, &[after, before, more].map(BlockArg::Value));

    let [before, done] = [(); 2].map(|()| line.b.append_block_param(last, types::I64));
    line.b.switch_to_block(last);
    line.before = before;
    line.values.clear();
    let results: Vec<Value> = func.stores.iter().map(|(_, value)| *value).chain(func.status).collect();
    line.write(&plan.last, &results, |value| {
        let stores = func.stores.iter().filter(|(_, stored)| *stored == value);
        let mut places: Vec<VectorPlace> = stores.map(|(slot, _)| VectorPlace::Block(*slot)).collect();
        places.extend((func.status == Some(value)).then_some(VectorPlace::Statuses));
        places
    });
    let done = line.b.ins().iadd_imm_s(done, 1);
    line.b.ins().return_(&[done]);

    // Only now are all constants known.
    line.b.switch_to_block(constants);
    for (number, bits) in line.constants.clone().into_iter().enumerate() {
        let constant = line.constant(types::I64X2, bits);
        line.store(constant, VectorPlace::Constant(number), 0);
    }
    line.b.ins().jump(prepare, &[]);
    let size = plan.end + line.constants.len() * BYTES;
    line.b.seal_all_blocks();
    line.b.finalize(isa.frontend_config());
    if size > i32::MAX as usize {
        return Err(Unsupported(format!("`{}` is too large for lanes: {} operations", func.name, func.ops.len())));
    }
    Ok(size / 8 - layout.size() * vectors * LANES)
}

/// The place of a group of vectors in memory.
#[derive(Clone, Copy)]
enum VectorPlace {
    /// A slot of the block.
    Block(Slot),
    /// A carried slot in the first or second area: area, index.
    Area(usize, usize),
    /// A carried slot in the area that the step reads.
    Before(usize),
    /// A carried slot in the area that the step writes.
    After(usize),
    /// A hoisted value.
    Hoisted(usize),
    /// A constant: one vector.
    Constant(usize),
    Statuses,
}

/// A step with the plan of its loop.
struct VectorStep<'a> {
    func: &'a Func,
    types: Vec<Type>,
    vectors: usize,
    plan: LoopPlan<Value>,
}

impl VectorStep<'_> {
    fn hoisted_place(&self, value: Value) -> Option<VectorPlace> {
        self.plan.hoisted.iter().position(|known| *known == value).map(VectorPlace::Hoisted)
    }
}

/// Whether the value is read from memory at each use.
fn is_leaf(op: Op) -> bool {
    matches!(op, Op::Load(_) | Op::Real(_) | Op::Int(_) | Op::Bool(_))
}

/// Whether a select is the minimum or maximum of two reals.
fn is_min_or_max(func: &Func, op: Op) -> bool {
    let Op::Select(when, a, b) = op else { return false };
    matches!(func.op(when), Op::Less(x, y) if (x, y) == (a, b) || (x, y) == (b, a))
}

/// The operands of the instruction for an operation: a fused multiply-add absorbs negations, a minimum or maximum its
/// comparison.
fn operands(func: &Func, value: Value) -> Vec<Value> {
    if let op @ Op::Select(_, a, b) = func.op(value)
        && is_min_or_max(func, op)
    {
        return vec![a, b];
    }
    let mut operands = Vec::with_capacity(3);
    let fused = matches!(func.op(value), Op::Fma(..));
    func.op(value).each_operand(|operand| {
        operands.push(match func.op(operand) {
            Op::Neg(plain) if fused => plain,
            _ => operand,
        });
    });
    operands
}

impl StraightLine for Func {
    type Node = Value;

    fn count(&self) -> usize {
        self.ops.len()
    }

    fn index(value: Value) -> usize {
        value.index()
    }

    fn operands(&self, index: usize) -> Vec<Value> {
        operands(self, Value(index as u32))
    }

    fn is_leaf(&self, value: Value) -> bool {
        is_leaf(self.op(value))
    }

    fn load(&self, index: usize) -> Option<Slot> {
        if let Op::Load(slot) = self.ops[index] { Some(slot) } else { None }
    }

    fn stores(&self) -> &[(Slot, Value)] {
        &self.stores
    }

    fn status(&self) -> Option<Value> {
        self.status
    }

    fn failed(&self) -> Option<Value> {
        self.status.map(|status| match self.failure() {
            Some((when, true, _)) => when,
            _ => status,
        })
    }

    /// The operations of each root are adjacent, operands first, to keep live ranges short.
    fn schedule(&self, roots: &[Value], wanted: &[bool]) -> Vec<Value> {
        let is_read = |value: Value| !wanted[value.index()] || is_leaf(self.op(value));
        topological_order(roots, self.ops.len(), Value::index, is_read, |value| operands(self, value))
    }
}

/// A straight line that is being emitted.
struct Emitter<'a> {
    step: &'a VectorStep<'a>,
    plan: &'a LoopPlan<Value>,
    b: FunctionBuilder<'a>,
    block: clif::Value,
    pool: clif::Value,
    before: clif::Value,
    after: clif::Value,
    statuses: clif::Value,
    /// Whether the target has an instruction that selects lanes by the top bit of a mask.
    blend: bool,
    /// The values computed so far, by vector.
    values: HashMap<Value, Vec<clif::Value>>,
    /// Constants that the loop reads from memory, as bits, in the order of their first use.
    constants: Vec<u64>,
}

fn vector_of(of: Type) -> clif::Type {
    match of {
        Type::Real => types::F64X2,
        // A boolean is a mask with all bits of a lane set or cleared.
        Type::Int | Type::Bool => types::I64X2,
    }
}

impl Emitter<'_> {
    /// Emits operations; `places` says where a value is to be stored as soon as it is computed. Values of `stored_last`
    /// that are not among the operations are stored at the end.
    fn write(&mut self, order: &[Value], stored_last: &[Value], places: impl Fn(Value) -> Vec<VectorPlace>) {
        for value in order {
            for k in 0..self.step.vectors {
                let result = self.operation(*value, k);
                self.values.entry(*value).or_default().push(result);
                for place in places(*value) {
                    self.store(result, place, k);
                }
            }
        }
        let mut seen: HashSet<Value> = order.iter().copied().collect();
        for value in stored_last {
            if seen.insert(*value) {
                for k in 0..self.step.vectors {
                    let result = self.get(*value, k);
                    places(*value).into_iter().for_each(|place| self.store(result, place, k));
                }
            }
        }
    }

    /// Base address and offset of a vector.
    fn address(&self, place: VectorPlace, k: usize) -> (clif::Value, i32) {
        let group = |index: usize| (index * self.step.vectors + k) * BYTES;
        let (base, offset) = match place {
            VectorPlace::Block(slot) => (self.block, group(slot.index())),
            VectorPlace::Area(area, index) => (self.block, self.plan.areas[area] + group(index)),
            VectorPlace::Before(index) => (self.before, group(index)),
            VectorPlace::After(index) => (self.after, group(index)),
            VectorPlace::Hoisted(index) => (self.block, self.plan.hoisted_at + group(index)),
            VectorPlace::Constant(number) => (self.block, self.plan.end + number * BYTES),
            VectorPlace::Statuses => (self.statuses, group(0)),
        };
        // Larger code is refused at the end of `emit`.
        (base, offset as i32)
    }

    fn load(&mut self, of: clif::Type, place: VectorPlace, k: usize) -> clif::Value {
        let (base, offset) = self.address(place, k);
        self.b.ins().load(of, MemFlagsData::trusted(), base, offset)
    }

    fn store(&mut self, value: clif::Value, place: VectorPlace, k: usize) {
        let (base, offset) = self.address(place, k);
        self.b.ins().store(MemFlagsData::trusted(), value, base, offset);
    }

    /// A constant in both lanes, built here.
    fn constant(&mut self, of: clif::Type, bits: u64) -> clif::Value {
        let bytes: Vec<u8> = [bits; LANES].into_iter().flat_map(u64::to_le_bytes).collect();
        let constant = self.b.func.dfg.constants.insert(bytes.into());
        self.b.ins().vconst(of, constant)
    }

    /// A constant in both lanes. In a loop it is in memory, where an instruction can read it directly.
    fn constant_operand(&mut self, of: clif::Type, bits: u64) -> clif::Value {
        if self.plan.carried.is_empty() {
            return self.constant(of, bits);
        }
        let known = self.constants.iter().position(|known| *known == bits);
        let number = known.unwrap_or_else(|| {
            self.constants.push(bits);
            self.constants.len() - 1
        });
        self.load(of, VectorPlace::Constant(number), 0)
    }

    fn get(&mut self, value: Value, k: usize) -> clif::Value {
        let of = vector_of(self.step.types[value.index()]);
        if let Some(known) = self.values.get(&value).and_then(|vectors| vectors.get(k)) {
            return *known;
        }
        match self.step.func.op(value) {
            Op::Real(bits) => self.constant_operand(of, bits),
            Op::Int(n) => self.constant_operand(of, n as u64),
            Op::Bool(truth) => self.constant_operand(of, if truth { u64::MAX } else { 0 }),
            Op::Load(slot) => {
                let carried = self.plan.carried.iter().position(|(known, _)| *known == slot);
                self.load(of, carried.map_or(VectorPlace::Block(slot), VectorPlace::Before), k)
            }
            op => {
                let place = self.step.hoisted_place(value).unwrap_or_else(|| panic!("{op:?} has not been computed"));
                self.load(of, place, k)
            }
        }
    }

    fn as_bits(&mut self, x: clif::Value) -> clif::Value {
        self.cast(types::I64X2, x)
    }

    fn cast(&mut self, to: clif::Type, x: clif::Value) -> clif::Value {
        if self.b.func.dfg.value_type(x) == to { x } else { self.b.ins().bitcast(to, MemFlagsData::new(), x) }
    }

    /// Applies a scalar operation to each lane.
    fn by_lane(&mut self, to: clif::Type, mut lane: impl FnMut(&mut Self, u8) -> clif::Value) -> clif::Value {
        let [first, second] = [0, 1].map(|number| lane(self, number));
        let vector = self.b.ins().scalar_to_vector(to, first);
        self.b.ins().insertlane(vector, second, 1)
    }

    fn operation(&mut self, value: Value, k: usize) -> clif::Value {
        let op = self.step.func.op(value);
        let mut x = operands(self.step.func, value).into_iter().map(|operand| self.get(operand, k)).collect::<Vec<_>>();
        let of = vector_of(self.step.types[value.index()]);
        match op {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => unreachable!("they lie in memory"),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Ring { .. } => unreachable!("refused"),
            Op::Pool { base, len, index } => {
                let in_range = self.is_in_range(index, len);
                self.by_lane(of, |line, lane| {
                    let mut index = line.b.ins().extractlane(x[0], lane);
                    if !in_range {
                        let last = line.b.ins().iconst(types::I64, i64::from(len) - 1);
                        index = line.b.ins().umin(index, last);
                    }
                    let bytes = line.b.ins().ishl_imm_u(index, 3);
                    let address = line.b.ins().iadd(line.pool, bytes);
                    let offset = i32::try_from(8 * base).expect("pools are smaller than 2 GiB");
                    line.b.ins().load(types::F64, MemFlagsData::trusted(), address, offset)
                })
            }
            Op::Add(..) => self.b.ins().fadd(x[0], x[1]),
            Op::Sub(..) => self.b.ins().fsub(x[0], x[1]),
            Op::Mul(..) => self.b.ins().fmul(x[0], x[1]),
            Op::Div(..) => self.b.ins().fdiv(x[0], x[1]),
            Op::Sqrt(_) => self.b.ins().sqrt(x[0]),
            Op::Floor(_) => self.b.ins().floor(x[0]),
            Op::Nearest(_) => self.b.ins().nearest(x[0]),
            Op::Neg(_) => {
                let sign = self.constant_operand(types::F64X2, SIGN);
                self.b.ins().bxor(x[0], sign)
            }
            Op::Abs(_) => {
                let magnitude = self.constant_operand(types::F64X2, !SIGN);
                self.b.ins().band(x[0], magnitude)
            }
            Op::Fma(a, b, c) => {
                for (x, operand) in x.iter_mut().zip([a, b, c]) {
                    if let Op::Neg(_) = self.step.func.op(operand) {
                        *x = self.b.ins().fneg(*x);
                    }
                }
                self.b.ins().fma(x[0], x[1], x[2])
            }
            Op::Less(..) => self.b.ins().fcmp(FloatCC::LessThan, x[0], x[1]),
            Op::LessEqual(..) => self.b.ins().fcmp(FloatCC::LessThanOrEqual, x[0], x[1]),
            Op::Equal(..) => self.b.ins().fcmp(FloatCC::Equal, x[0], x[1]),
            Op::And(..) | Op::IntAnd(..) => self.b.ins().band(x[0], x[1]),
            Op::Or(..) | Op::IntOr(..) => self.b.ins().bor(x[0], x[1]),
            Op::Not(_) => {
                let ones = self.constant_operand(of, u64::MAX);
                self.b.ins().bxor(x[0], ones)
            }
            // On x86-64 a single MINPD or MAXPD, exact also for NaN and zeros.
            Op::Select(when, a, _) if is_min_or_max(self.step.func, op) => {
                let Op::Less(first, _) = self.step.func.op(when) else { unreachable!("it compares") };
                let (low, high) = if first == a { (x[0], x[1]) } else { (x[1], x[0]) };
                let mask = self.b.ins().fcmp(FloatCC::LessThan, low, high);
                let mask = self.cast(of, mask);
                self.b.ins().bitselect(mask, x[0], x[1])
            }
            Op::Select(..) if self.blend => {
                let [a, b] = [x[1], x[2]].map(|x| self.as_bits(x));
                let chosen = self.b.ins().blendv(x[0], a, b);
                self.cast(of, chosen)
            }
            Op::Select(..) => {
                let mask = self.cast(of, x[0]);
                self.b.ins().bitselect(mask, x[1], x[2])
            }
            Op::IntAdd(..) => self.b.ins().iadd(x[0], x[1]),
            Op::IntSub(..) => self.b.ins().isub(x[0], x[1]),
            Op::IntMul(..) => self.b.ins().imul(x[0], x[1]),
            Op::IntXor(..) => self.b.ins().bxor(x[0], x[1]),
            Op::ShiftLeft(_, n) => self.b.ins().ishl_imm_u(x[0], i64::from(n)),
            Op::ShiftRight(_, n) => self.b.ins().ushr_imm_u(x[0], i64::from(n)),
            Op::ShiftRightSigned(_, n) => self.b.ins().sshr_imm_u(x[0], i64::from(n)),
            Op::IntLess(..) => self.b.ins().icmp(IntCC::SignedLessThan, x[0], x[1]),
            Op::IntEqual(..) => self.b.ins().icmp(IntCC::Equal, x[0], x[1]),
            Op::ToBits(_) | Op::FromBits(_) => self.cast(of, x[0]),
            Op::ToInt(_) => self.by_lane(of, |line, lane| {
                let number = line.b.ins().extractlane(x[0], lane);
                line.b.ins().fcvt_to_sint_sat(types::I64, number)
            }),
            Op::ToReal(_) => self.b.ins().fcvt_from_sint(of, x[0]),
        }
    }

    /// Whether an index is known to be within a table.
    fn is_in_range(&self, index: Value, len: u32) -> bool {
        let masked = |value: Value| match self.step.func.op(value) {
            Op::Int(mask) => (0..i64::from(len)).contains(&mask),
            _ => false,
        };
        match self.step.func.op(index) {
            Op::IntAnd(a, b) => masked(a) || masked(b),
            _ => masked(index),
        }
    }
}
