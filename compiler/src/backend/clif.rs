//! A function of ours as a function of Cranelift: a loop around the straight line.
//!
//! ```text
//! entry:  load every slot that is read; compute what no iteration changes
//! loop:   the rest, on the slots that are both read and written, which stay in registers; if they are many, in the block
//!         again while there are iterations left and the status is 0
//! exit:   store; return the status
//! ```
//! A status `if failed then detail else 0` tests `failed` in the loop; what only the detail needs is computed on the way
//! out.
//! Each operation becomes one instruction or a fixed few. There are no calls, no symbols and no traps.

use crate::ir::{Func, Op, Type, Value, verify};
use cranelift_codegen::ir::condcodes::{FloatCC, IntCC};
use cranelift_codegen::ir::{self as clif, AbiParam, BlockArg, InstBuilder, MemFlagsData, Signature, types};
use cranelift_codegen::isa::TargetIsa;
use cranelift_frontend::{FunctionBuilder, FunctionBuilderContext};
use std::collections::HashMap;

/// The signature of [`abi::table::Entry`].
pub fn signature(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(isa.default_call_conv());
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature.returns.push(AbiParam::new(types::I64));
    signature
}

/// Writes `func`, which is sound and expanded, into the empty `target`.
pub fn emit(func: &Func, target: &mut clif::Function, context: &mut FunctionBuilderContext, isa: &dyn TargetIsa) {
    target.signature = signature(isa);
    let mut b = FunctionBuilder::new(target, context);
    let [entry, prepare, body, more, failed, exit, nothing] = [(); 7].map(|()| b.create_block());
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count] = b.block_params(entry) else { unreachable!("three parameters") };
    b.ins().brif(count, prepare, &[], nothing, &[]);

    b.switch_to_block(prepare);
    let mut emitter = Emitter::new(func, block, pool);
    let ops = || (0..func.ops.len()).map(|i| Value(i as u32));
    let (watch, late) = Watch::of(func);
    // The slots that an iteration hands to the next: in registers, or, if they are many, where the next one loads them.
    let handed: Vec<(Value, Value)> = emitter.carried();
    let (carried, in_block) =
        if handed.len() > IN_REGISTERS { (&handed[..0], &handed[..]) } else { (&handed[..], &handed[..0]) };
    let in_loop = |emitter: &Emitter, value: Value| {
        emitter.varies[value.index()] && (!in_block.is_empty() || !matches!(func.op(value), Op::Load(_)))
    };
    for value in ops().filter(|value| !late[value.index()]) {
        if !in_loop(&emitter, value) {
            emitter.operation(value, &mut b);
        }
    }
    let first: Vec<BlockArg> = carried.iter().map(|(load, _)| BlockArg::Value(emitter.get(*load, &mut b))).collect();
    // Nothing changes from one iteration to the next: one is enough.
    let count = if handed.is_empty() && func.writes.is_empty() { b.ins().iconst(types::I64, 1) } else { count };
    let first: Vec<BlockArg> = first.into_iter().chain([BlockArg::Value(count)]).collect();
    b.ins().jump(body, &first);

    for (load, _) in carried {
        emitter.values[load.index()] = Some(b.append_block_param(body, types::F64));
    }
    let left = b.append_block_param(body, types::I64);
    b.switch_to_block(body);
    for value in ops().filter(|value| !late[value.index()]) {
        if in_loop(&emitter, value) {
            emitter.operation(value, &mut b);
        }
    }
    for write in &func.writes {
        let (address, offset) = emitter.entry(block, write.base.0, write.len, write.index, &mut b);
        let value = emitter.get(write.value, &mut b);
        b.ins().store(MemFlagsData::trusted(), value, address, offset);
    }
    let left = b.ins().iadd_imm_s(left, -1);
    match watch {
        Watch::Nothing => {
            b.ins().jump(more, &[]);
        }
        Watch::Status(status) => {
            let status = emitter.get(status, &mut b);
            b.ins().brif(status, failed, &[], more, &[]);
        }
        Watch::Failed { when, .. } => {
            let when = emitter.get(when, &mut b);
            b.ins().brif(when, failed, &[], more, &[]);
        }
    }
    b.switch_to_block(more);
    for (load, store) in in_block {
        let Op::Load(slot) = func.op(*load) else { unreachable!("it is a load") };
        let value = emitter.get(*store, &mut b);
        b.ins().store(MemFlagsData::trusted(), value, block, offset(slot.0));
    }
    let next: Vec<BlockArg> = carried.iter().map(|(_, store)| BlockArg::Value(emitter.get(*store, &mut b))).collect();
    let next: Vec<BlockArg> = next.into_iter().chain([BlockArg::Value(left)]).collect();
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().brif(left, body, &next, exit, &[BlockArg::Value(zero)]);

    b.set_cold_block(failed);
    b.switch_to_block(failed);
    for value in ops().filter(|value| late[value.index()]) {
        emitter.operation(value, &mut b);
    }
    let status = match watch {
        Watch::Nothing => zero,
        Watch::Status(status) => emitter.get(status, &mut b),
        Watch::Failed { detail, .. } => emitter.get(detail, &mut b),
    };
    b.ins().brif(status, exit, &[BlockArg::Value(status)], more, &[]);

    let status = b.append_block_param(exit, types::I64);
    b.switch_to_block(exit);
    for (slot, value) in &func.stores {
        let value = emitter.get(*value, &mut b);
        b.ins().store(MemFlagsData::trusted(), value, block, offset(slot.0));
    }
    b.ins().return_(&[status]);

    b.switch_to_block(nothing);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Most slots that are handed from one iteration to the next in registers, as far as these reach. More only travel through
/// the stack, and the time to place them grows with the square of their number.
const IN_REGISTERS: usize = 24;

/// What ends the loop before its count.
#[derive(Clone, Copy)]
enum Watch {
    Nothing,
    /// A status that is not 0.
    Status(Value),
    /// A truth; the status then is `detail`.
    Failed {
        when: Value,
        detail: Value,
    },
}

impl Watch {
    /// How to watch the status of `func`, and which operations only its detail needs.
    fn of(func: &Func) -> (Watch, Vec<bool>) {
        let mut late = vec![false; func.ops.len()];
        let Some(status) = func.status else { return (Watch::Nothing, late) };
        let (when, detail) = match func.op(status) {
            Op::Select(when, detail, zero) if func.op(zero) == Op::Int(0) => (when, detail),
            _ => return (Watch::Status(status), late),
        };
        let mut needed = vec![false; func.ops.len()];
        needed[when.index()] = true;
        for value in func.results().filter(|value| Some(*value) != func.status) {
            needed[value.index()] = true;
        }
        for i in (0..func.ops.len()).rev() {
            // What the block holds is read before the iteration writes to it, and so is what says where.
            needed[i] |= matches!(func.ops[i], Op::Load(_) | Op::Ring { .. });
            if needed[i] {
                func.ops[i].each_operand(|operand| needed[operand.index()] = true);
            }
            late[i] = !needed[i];
        }
        (Watch::Failed { when, detail }, late)
    }
}

/// Bytes from the beginning of a block or pool to its `index`-th number.
fn offset(index: u32) -> i32 {
    i32::try_from(index * 8).expect("blocks and pools are smaller than 2 GiB")
}

struct Emitter<'a> {
    func: &'a Func,
    types: Vec<Type>,
    /// Whether an iteration can change the value.
    varies: Vec<bool>,
    /// For tables: whether the number is needed as such and not only its bits.
    as_real: Vec<bool>,
    values: Vec<Option<clif::Value>>,
    block: clif::Value,
    pool: clif::Value,
}

impl Emitter<'_> {
    fn new(func: &Func, block: clif::Value, pool: clif::Value) -> Emitter<'_> {
        let stored: HashMap<_, _> = func.stores.iter().copied().collect();
        let mut varies = vec![false; func.ops.len()];
        let mut as_real = vec![false; func.ops.len()];
        for (i, op) in func.ops.iter().enumerate() {
            let mut changes = match op {
                Op::Load(slot) => stored.contains_key(slot),
                Op::Ring { .. } => !func.writes.is_empty(),
                _ => false,
            };
            op.each_operand(|operand| {
                changes |= varies[operand.index()];
                as_real[operand.index()] |= !matches!(op, Op::ToBits(_));
            });
            varies[i] = changes;
        }
        for value in func.results() {
            as_real[value.index()] = true;
        }
        let types = verify::types(func).expect("the function is sound");
        Emitter { func, types, varies, as_real, values: vec![None; func.ops.len()], block, pool }
    }

    /// Loads of slots that are stored too, with what is stored.
    fn carried(&self) -> Vec<(Value, Value)> {
        let stored: HashMap<_, _> = self.func.stores.iter().copied().collect();
        let of_load = |(i, op): (usize, &Op)| match op {
            Op::Load(slot) => stored.get(slot).map(|value| (Value(i as u32), *value)),
            _ => None,
        };
        self.func.ops.iter().enumerate().filter_map(of_load).collect()
    }

    /// The instruction's value. Constants are made anew at each use: kept, they would fill the registers.
    fn get(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.func.op(value) {
            Op::Pool { base, len, index } if let Op::Int(index) = self.func.op(index) => {
                let entry = (index as u64).min(u64::from(len) - 1) as u32;
                b.ins().load(types::F64, MemFlagsData::trusted(), self.pool, offset(base + entry))
            }
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            Op::Int(n) => b.ins().iconst(types::I64, n),
            Op::Bool(truth) => b.ins().iconst(types::I8, i64::from(truth)),
            _ => self.values[value.index()].expect("operands come first"),
        }
    }

    fn operation(&mut self, value: Value, b: &mut FunctionBuilder) {
        let flags = MemFlagsData::trusted();
        let op = self.func.op(value);
        let mut operands = [None; 3];
        let mut n = 0;
        // Of a table only the bits may be needed: then the number is never loaded.
        if let Op::Pool { base, len, index } = op {
            let constant = matches!(self.func.op(index), Op::Int(_));
            if !constant && self.as_real[value.index()] {
                let (address, offset) = self.entry(self.pool, base, len, index, b);
                self.values[value.index()] = Some(b.ins().load(types::F64, flags, address, offset));
            }
            return;
        }
        if let Op::Ring { base, len, index } = op {
            let (address, offset) = self.entry(self.block, base.0, len, index, b);
            self.values[value.index()] = Some(b.ins().load(types::F64, flags, address, offset));
            return;
        }
        if let Op::ToBits(table) = op
            && let Op::Pool { base, len, index } = self.func.op(table)
        {
            let (address, offset) = self.entry(self.pool, base, len, index, b);
            self.values[value.index()] = Some(b.ins().load(types::I64, flags, address, offset));
            return;
        }
        op.each_operand(|operand| {
            operands[n] = Some(self.get(operand, b));
            n += 1;
        });
        // What stands last can be taken from memory.
        if let Op::Add(first, _) | Op::Mul(first, _) = op
            && let Op::Real(_) = self.func.op(first)
        {
            operands.swap(0, 1);
        }
        let x = |i: usize| operands[i].expect("an operand");
        let result = match op {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) => return,
            Op::Pool { .. } | Op::Ring { .. } => unreachable!("done above"),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Load(slot) => b.ins().load(types::F64, flags, self.block, offset(slot.0)),
            Op::Add(..) => b.ins().fadd(x(0), x(1)),
            Op::Sub(..) => b.ins().fsub(x(0), x(1)),
            Op::Mul(..) => b.ins().fmul(x(0), x(1)),
            Op::Div(..) => b.ins().fdiv(x(0), x(1)),
            Op::Neg(_) => b.ins().fneg(x(0)),
            Op::Abs(_) => b.ins().fabs(x(0)),
            Op::Sqrt(_) => b.ins().sqrt(x(0)),
            Op::Fma(..) => b.ins().fma(x(0), x(1), x(2)),
            Op::Floor(_) => b.ins().floor(x(0)),
            Op::Nearest(_) => b.ins().nearest(x(0)),
            Op::Less(..) => b.ins().fcmp(FloatCC::LessThan, x(0), x(1)),
            Op::LessEqual(..) => b.ins().fcmp(FloatCC::LessThanOrEqual, x(0), x(1)),
            Op::Equal(..) => b.ins().fcmp(FloatCC::Equal, x(0), x(1)),
            Op::And(..) | Op::IntAnd(..) => b.ins().band(x(0), x(1)),
            Op::Or(..) | Op::IntOr(..) => b.ins().bor(x(0), x(1)),
            Op::Not(_) => b.ins().bxor_imm_u(x(0), 1),
            // With a comparison of the same two reals this is one minimum or maximum instruction.
            Op::Select(..) => b.ins().select(x(0), x(1), x(2)),
            Op::IntAdd(..) => b.ins().iadd(x(0), x(1)),
            Op::IntSub(..) => b.ins().isub(x(0), x(1)),
            Op::IntMul(..) => b.ins().imul(x(0), x(1)),
            Op::IntXor(..) => b.ins().bxor(x(0), x(1)),
            Op::ShiftLeft(_, n) => b.ins().ishl_imm_u(x(0), i64::from(n)),
            Op::ShiftRight(_, n) => b.ins().ushr_imm_u(x(0), i64::from(n)),
            Op::ShiftRightSigned(_, n) => b.ins().sshr_imm_u(x(0), i64::from(n)),
            Op::IntLess(..) => b.ins().icmp(IntCC::SignedLessThan, x(0), x(1)),
            Op::IntEqual(..) => b.ins().icmp(IntCC::Equal, x(0), x(1)),
            Op::ToBits(_) => b.ins().bitcast(types::I64, MemFlagsData::new(), x(0)),
            Op::FromBits(_) => b.ins().bitcast(types::F64, MemFlagsData::new(), x(0)),
            Op::ToInt(_) => b.ins().fcvt_to_sint_sat(types::I64, x(0)),
            Op::ToReal(_) => b.ins().fcvt_from_sint(types::F64, x(0)),
        };
        debug_assert_eq!(
            b.func.dfg.value_type(result),
            match self.types[value.index()] {
                Type::Real => types::F64,
                Type::Int => types::I64,
                Type::Bool => types::I8,
            }
        );
        self.values[value.index()] = Some(result);
    }

    /// Address and offset of an entry of a table in the pool or a ring in the block (`whole`), the index held inside
    /// unless it cannot leave.
    fn entry(
        &self,
        whole: clif::Value,
        base: u32,
        len: u32,
        index: Value,
        b: &mut FunctionBuilder,
    ) -> (clif::Value, i32) {
        let masked = |value: Value| match self.func.op(value) {
            Op::Int(mask) => (0..i64::from(len)).contains(&mask),
            _ => false,
        };
        let inside = match self.func.op(index) {
            Op::IntAnd(a, c) => masked(a) || masked(c),
            _ => masked(index),
        };
        let mut place = self.get(index, b);
        if !inside {
            let last = b.ins().iconst(types::I64, i64::from(len) - 1);
            place = b.ins().umin(place, last);
        }
        let bytes = b.ins().ishl_imm_u(place, 3);
        (b.ins().iadd(whole, bytes), offset(base))
    }
}
