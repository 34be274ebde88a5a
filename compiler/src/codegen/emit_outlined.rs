//! Emits an [outlined](crate::codegen::outline) function as Cranelift IR: one function with the loop over iterations,
//! and one for each piece, which the loop calls.
//!
//! In: a function and its pieces. Out: Cranelift functions. The scratch area is on the stack of the loop. Pieces are
//! called by index; the linker of the code fills in the distances.
//!
//! ```text
//! entry:  call the invariant pieces
//! loop:   call the pieces of an iteration; repeat while iterations remain and the status is 0
//! failed: call the pieces that compute the status
//! ```
//! A rerolled piece is a loop of its own. Its operands and results lie at constant strides, with one induction pointer
//! for each stride.

use crate::codegen::emit::{Emitter, ExitCondition, Facts, is_idempotent, offset, signature};
use crate::codegen::outline::{Outlined, Piece};
use crate::codegen::reroll::{Row, Source};
use crate::ir::{Func, Op, Value};
use cranelift_codegen::ir::{
    self as clif, AbiParam, BlockArg, ExtFuncData, InstBuilder, MemFlagsData, Signature, StackSlotData, StackSlotKind,
    UserExternalName, types,
};
use cranelift_codegen::isa::TargetIsa;
use cranelift_frontend::{FunctionBuilder, FunctionBuilderContext};
use std::collections::HashSet;
use std::ops::Range;

/// The signature of a piece: addresses of block, pool and scratch area.
fn signature_of_piece(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(isa.default_call_conv());
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature
}

/// Emits the loop that calls the pieces of `func` into the empty `target`. External name `n` stands for piece `n`.
pub fn emit_loop(
    func: &Func,
    facts: &Facts,
    outlined: &Outlined,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature(isa);
    let mut b = FunctionBuilder::new(target, context);
    let of_piece = b.import_signature(signature_of_piece(isa));
    let pieces: Vec<clif::FuncRef> = (0..outlined.pieces.len())
        .map(|number| {
            let name = UserExternalName { namespace: 0, index: number as u32 };
            let name = clif::ExternalName::user(b.func.declare_imported_user_function(name));
            b.import_function(ExtFuncData { name, signature: of_piece, colocated: true, patchable: false })
        })
        .collect();
    let area = StackSlotData::new(StackSlotKind::ExplicitSlot, 8 * outlined.scratch_len.max(1), 3);
    let area = b.create_sized_stack_slot(area);
    let [entry, prepare, body, more, failed, exit] = [(); 6].map(|()| b.create_block());
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count] = b.block_params(entry) else { unreachable!("three parameters") };
    let zero = b.ins().iconst(types::I64, 0);
    let status = b.append_block_param(exit, types::I64);
    b.ins().brif(count, prepare, &[], exit, &[BlockArg::Value(zero)]);

    b.switch_to_block(prepare);
    let scratch = b.ins().stack_addr(types::I64, area, 0);
    let call = |numbers: Range<usize>, b: &mut FunctionBuilder| {
        for piece in &pieces[numbers] {
            b.ins().call(*piece, &[block, pool, scratch]);
        }
    };
    call(0..outlined.iteration.start, &mut b);
    // If no iteration reads what an iteration writes, one is enough.
    let mut emitter = Emitter::new(func, facts, block, pool);
    let count = if is_idempotent(func) { b.ins().iconst(types::I64, 1) } else { count };
    b.ins().jump(body, &[BlockArg::Value(count)]);

    let remaining = b.append_block_param(body, types::I64);
    b.switch_to_block(body);
    call(outlined.iteration.clone(), &mut b);
    let (exit_condition, _) = ExitCondition::of(func);
    let detail = match exit_condition {
        ExitCondition::Never => {
            b.ins().jump(more, &[]);
            None
        }
        ExitCondition::Status(status) => {
            fetch(&mut emitter, status, outlined, scratch, &mut b);
            let status = emitter.get(status, &mut b);
            b.ins().brif(status, exit, &[BlockArg::Value(status)], more, &[]);
            None
        }
        ExitCondition::Failed { when, is, detail } => {
            fetch(&mut emitter, when, outlined, scratch, &mut b);
            let when = emitter.get(when, &mut b);
            let (yes, no) = if is { (failed, more) } else { (more, failed) };
            b.ins().brif(when, yes, &[], no, &[]);
            Some(detail)
        }
    };
    b.switch_to_block(more);
    let remaining = b.ins().iadd_imm_s(remaining, -1);
    b.ins().brif(remaining, body, &[BlockArg::Value(remaining)], exit, &[BlockArg::Value(zero)]);

    b.set_cold_block(failed);
    b.switch_to_block(failed);
    call(outlined.iteration.end..outlined.pieces.len(), &mut b);
    let found = detail.map_or(zero, |detail| {
        fetch(&mut emitter, detail, outlined, scratch, &mut b);
        emitter.get(detail, &mut b)
    });
    b.ins().brif(found, exit, &[BlockArg::Value(found)], more, &[]);

    b.switch_to_block(exit);
    b.ins().return_(&[status]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Emits piece `number` of `func` into the empty `target`. `values` is a buffer that is all `None` before and after.
pub fn emit_piece(
    func: &Func,
    facts: &Facts,
    (outlined, number): (&Outlined, usize),
    values: &mut Vec<Option<clif::Value>>,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature_of_piece(isa);
    let piece = &outlined.pieces[number];
    let mut b = FunctionBuilder::new(target, context);
    let entry = b.create_block();
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, scratch] = b.block_params(entry) else { unreachable!("three parameters") };
    // The buffer is reused from piece to piece, so that the cost of a piece depends on its own length only.
    values.resize(func.ops.len(), None);
    let mut emitter = Emitter::with(func, facts, std::mem::take(values), block, pool);
    let mut touched: Vec<Value> = Vec::new();
    for (table, slot) in outlined.repeats.tables.iter().zip(&outlined.tables).filter(|_| number == 0) {
        for (value, word) in table.iter().zip(*slot..) {
            let value = emitter.get(*value, &mut b);
            b.ins().store(MemFlagsData::trusted(), value, scratch, offset(word));
        }
    }
    for value in &piece.ops {
        for read in func.reads(func.op(*value)) {
            touched.extend(fetch(&mut emitter, read, outlined, scratch, &mut b));
        }
        emitter.operation(*value, &mut b);
        touched.push(*value);
        if let (Some(slot), Some(known)) = (outlined.scratch_slots.get(value), emitter.values[value.index()]) {
            b.ins().store(MemFlagsData::trusted(), known, scratch, offset(*slot));
        }
    }
    let written = piece.writes.iter().flat_map(|write| [write.index, write.value]);
    for value in piece.stores.iter().map(|(_, value)| *value).chain(written) {
        touched.extend(fetch(&mut emitter, value, outlined, scratch, &mut b));
    }
    emitter.stores(&piece.stores, &mut b);
    emitter.writes(&piece.writes, &mut b);
    if !piece.rows.is_empty() {
        touched.extend(reroll(&mut emitter, piece, outlined, scratch, &mut b));
    }
    b.ins().return_(&[]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
    *values = emitter.values;
    touched.into_iter().for_each(|value| values[value.index()] = None);
}

/// An induction pointer: an address that advances by a constant stride in each repetition.
struct Pointer {
    /// The address that it starts at: that of the block or the scratch area.
    base: clif::Value,
    /// In doubles.
    stride: i64,
    /// Its value in the current repetition; the offset of the first repetition is added to it.
    current: Option<clif::Value>,
}

/// The index of the pointer with this stride, which is added if there is none.
fn pointer(pointers: &mut Vec<Pointer>, base: clif::Value, stride: i64) -> usize {
    let known = pointers.iter().position(|pointer| pointer.base == base && pointer.stride == stride);
    known.unwrap_or_else(|| {
        pointers.push(Pointer { base, stride, current: None });
        pointers.len() - 1
    })
}

/// Emits the loop of a rerolled piece. The body has the values of the first repetition. Returns the values it has set
/// in `emitter.values`.
fn reroll(
    emitter: &mut Emitter,
    piece: &Piece,
    outlined: &Outlined,
    scratch: clif::Value,
    b: &mut FunctionBuilder,
) -> Vec<Value> {
    let flags = MemFlagsData::trusted();
    let (func, block) = (emitter.func, emitter.block);
    let rows: Vec<&Row> = piece.rows.iter().map(|row| &outlined.repeats.rows[*row]).collect();
    let firsts: HashSet<Value> = rows.iter().map(|row| row.members[0]).collect();
    let slot = |value: Value| outlined.scratch_slots[&value];
    let mut pointers: Vec<Pointer> = Vec::new();
    // Inputs: the pointer, the offset, and the value in the first repetition. Constants: the operation and operand they
    // replace instead of the value.
    let mut inputs: Vec<(usize, u32, Value)> = Vec::new();
    let mut constants: Vec<(usize, u32, (Value, usize))> = Vec::new();
    let mut touched: Vec<Value> = Vec::new();
    for row in &rows {
        let mut operands: Vec<Value> = func.reads(func.op(row.members[0])).collect();
        if let Op::Load(_) = func.op(row.members[0]) {
            operands.push(row.members[0]);
        }
        for (n, (operand, source)) in operands.into_iter().zip(&row.sources).enumerate() {
            match *source {
                Source::Same(value) => touched.extend(fetch(emitter, value, outlined, scratch, b)),
                Source::Slots(first, stride) => inputs.push((pointer(&mut pointers, block, stride), first.0, operand)),
                Source::Table(table) => {
                    constants.push((pointer(&mut pointers, scratch, 1), outlined.tables[table], (row.members[0], n)));
                }
                Source::Scratch(first, _) if firsts.contains(&first) => {}
                Source::Scratch(first, second) => {
                    let stride = i64::from(slot(second)) - i64::from(slot(first));
                    inputs.push((pointer(&mut pointers, scratch, stride), slot(first), operand));
                }
            }
        }
    }
    inputs.sort_unstable_by_key(|(_, _, value)| *value);
    inputs.dedup();
    let scratch_outputs: Vec<Value> =
        rows.iter().map(|row| row.members[0]).filter(|value| outlined.scratch_slots.contains_key(value)).collect();
    let scratch_outputs: Vec<_> =
        scratch_outputs.into_iter().map(|value| (pointer(&mut pointers, scratch, 1), slot(value), value)).collect();
    let stores = piece.row_stores.iter().map(|(first, stride, row)| {
        (pointer(&mut pointers, block, *stride), first.0, outlined.repeats.rows[*row].members[0])
    });
    let outputs: Vec<(usize, u32, Value)> = scratch_outputs.into_iter().chain(stores).collect();

    let [body, after] = [(); 2].map(|()| b.create_block());
    let count = b.ins().iconst(types::I64, rows[0].members.len() as i64);
    let first: Vec<BlockArg> =
        pointers.iter().map(|pointer| pointer.base).chain([count]).map(BlockArg::Value).collect();
    b.ins().jump(body, &first);
    for pointer in &mut pointers {
        pointer.current = Some(b.append_block_param(body, types::I64));
    }
    let remaining = b.append_block_param(body, types::I64);
    b.switch_to_block(body);
    let current = |of: usize| pointers[of].current.expect("the loop has begun");
    for (pointer, first, value) in &inputs {
        let loaded = b.ins().load(emitter.facts.type_of(*value), flags, current(*pointer), offset(*first));
        emitter.values[value.index()] = Some(loaded);
    }
    for (pointer, first, operand) in constants {
        let loaded = b.ins().load(types::F64, flags, current(pointer), offset(first));
        emitter.substitutes.insert(operand, loaded);
    }
    let read: HashSet<Value> = inputs.iter().map(|(_, _, value)| *value).collect();
    let list: Vec<Value> = rows.iter().map(|row| row.members[0]).filter(|value| !read.contains(value)).collect();
    let stored: Vec<Value> = outputs.iter().map(|(_, _, value)| *value).collect();
    emitter.list_with_outputs(&list, &stored, b);
    for (pointer, first, value) in &outputs {
        let value = emitter.get(*value, b);
        b.ins().store(flags, value, current(*pointer), offset(*first));
    }
    let remaining = b.ins().iadd_imm_s(remaining, -1);
    let next: Vec<clif::Value> =
        (0..pointers.len()).map(|k| b.ins().iadd_imm_s(current(k), 8 * pointers[k].stride)).collect();
    let next: Vec<BlockArg> = next.into_iter().chain([remaining]).map(BlockArg::Value).collect();
    b.ins().brif(remaining, body, &next, after, &[]);
    b.switch_to_block(after);
    touched.into_iter().chain(read).chain(list).collect()
}

/// Makes a value of another piece available: loads it from its scratch slot, or emits its load again. Returns the value
/// if this has set it.
fn fetch(
    emitter: &mut Emitter,
    value: Value,
    outlined: &Outlined,
    scratch: clif::Value,
    b: &mut FunctionBuilder,
) -> Option<Value> {
    if emitter.values[value.index()].is_some() {
        return None;
    }
    match (outlined.scratch_slots.get(&value), emitter.func.op(value)) {
        (Some(slot), _) => {
            let of = emitter.facts.type_of(value);
            let loaded = b.ins().load(of, MemFlagsData::trusted(), scratch, offset(*slot));
            emitter.values[value.index()] = Some(loaded);
        }
        (None, Op::Load(_)) => emitter.operation(value, b),
        // A constant is rematerialised at each use.
        (None, _) => return None,
    }
    Some(value)
}
