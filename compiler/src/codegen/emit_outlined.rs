//! A function that is [cut](crate::codegen::outline) as functions of Cranelift: one that holds the loop, and the pieces that it calls.
//!
//! ```text
//! entry:  pieces before the loop
//! loop:   pieces of an iteration; again while there are iterations left and the status is 0
//! failed: pieces that say which guard it was
//! ```
//! A piece that repeats its operations is a loop of its own: what its repetitions take and leave lies in equal distances, so
//! that one address for each distance walks along. The scratch area lies on the stack. A piece is called by its number;
//! whoever lays out the code puts in the distance.

use crate::codegen::emit::{Emitter, Facts, Watch, offset, signature, stays_the_same};
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

/// The signature of a piece: block, pool, scratch area.
fn signature_of_piece(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(isa.default_call_conv());
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature
}

/// Writes the loop around the pieces of `func` into the empty `target`. It calls the piece of each number by that number.
pub fn emit_loop(
    func: &Func,
    facts: &Facts,
    cut: &Outlined,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature(isa);
    let mut b = FunctionBuilder::new(target, context);
    let of_piece = b.import_signature(signature_of_piece(isa));
    let pieces: Vec<clif::FuncRef> = (0..cut.pieces.len())
        .map(|number| {
            let name = UserExternalName { namespace: 0, index: number as u32 };
            let name = clif::ExternalName::user(b.func.declare_imported_user_function(name));
            b.import_function(ExtFuncData { name, signature: of_piece, colocated: true, patchable: false })
        })
        .collect();
    let area = StackSlotData::new(StackSlotKind::ExplicitSlot, 8 * cut.words.max(1), 3);
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
    call(0..cut.each.start, &mut b);
    // Nothing changes from one iteration to the next: one is enough.
    let mut emitter = Emitter::new(func, facts, block, pool);
    let count = if stays_the_same(func) { b.ins().iconst(types::I64, 1) } else { count };
    b.ins().jump(body, &[BlockArg::Value(count)]);

    let left = b.append_block_param(body, types::I64);
    b.switch_to_block(body);
    call(cut.each.clone(), &mut b);
    let (watch, _) = Watch::of(func);
    let detail = match watch {
        Watch::Nothing => {
            b.ins().jump(more, &[]);
            None
        }
        Watch::Status(status) => {
            fetch(&mut emitter, status, cut, scratch, &mut b);
            let status = emitter.get(status, &mut b);
            b.ins().brif(status, exit, &[BlockArg::Value(status)], more, &[]);
            None
        }
        Watch::Failed { when, is, detail } => {
            fetch(&mut emitter, when, cut, scratch, &mut b);
            let when = emitter.get(when, &mut b);
            let (yes, no) = if is { (failed, more) } else { (more, failed) };
            b.ins().brif(when, yes, &[], no, &[]);
            Some(detail)
        }
    };
    b.switch_to_block(more);
    let left = b.ins().iadd_imm_s(left, -1);
    b.ins().brif(left, body, &[BlockArg::Value(left)], exit, &[BlockArg::Value(zero)]);

    b.set_cold_block(failed);
    b.switch_to_block(failed);
    call(cut.each.end..cut.pieces.len(), &mut b);
    let found = detail.map_or(zero, |detail| {
        fetch(&mut emitter, detail, cut, scratch, &mut b);
        emitter.get(detail, &mut b)
    });
    b.ins().brif(found, exit, &[BlockArg::Value(found)], more, &[]);

    b.switch_to_block(exit);
    b.ins().return_(&[status]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Writes one piece of `func` into the empty `target`.
pub fn emit_piece(
    func: &Func,
    facts: &Facts,
    (cut, number): (&Outlined, usize),
    values: &mut Vec<Option<clif::Value>>,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature_of_piece(isa);
    let piece = &cut.pieces[number];
    let mut b = FunctionBuilder::new(target, context);
    let entry = b.create_block();
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, scratch] = b.block_params(entry) else { unreachable!("three parameters") };
    // The table of all values is kept from piece to piece, so that a piece costs what it holds.
    values.resize(func.ops.len(), None);
    let mut emitter = Emitter::with(func, facts, std::mem::take(values), block, pool);
    let mut touched: Vec<Value> = Vec::new();
    for (table, home) in cut.repeats.tables.iter().zip(&cut.tables).filter(|_| number == 0) {
        for (value, word) in table.iter().zip(*home..) {
            let value = emitter.get(*value, &mut b);
            b.ins().store(MemFlagsData::trusted(), value, scratch, offset(word));
        }
    }
    for value in &piece.ops {
        for read in func.reads(func.op(*value)) {
            touched.extend(fetch(&mut emitter, read, cut, scratch, &mut b));
        }
        emitter.operation(*value, &mut b);
        touched.push(*value);
        if let (Some(home), Some(known)) = (cut.homes.get(value), emitter.values[value.index()]) {
            b.ins().store(MemFlagsData::trusted(), known, scratch, offset(*home));
        }
    }
    let written = piece.writes.iter().flat_map(|write| [write.index, write.value]);
    for value in piece.stores.iter().map(|(_, value)| *value).chain(written) {
        touched.extend(fetch(&mut emitter, value, cut, scratch, &mut b));
    }
    emitter.stores(&piece.stores, &mut b);
    emitter.writes(&piece.writes, &mut b);
    if !piece.rows.is_empty() {
        touched.extend(repeat(&mut emitter, piece, cut, scratch, &mut b));
    }
    b.ins().return_(&[]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
    *values = emitter.values;
    touched.into_iter().for_each(|value| values[value.index()] = None);
}

/// Addresses in equal distances, one for each repetition.
struct Walk {
    /// The block or the scratch area.
    whole: clif::Value,
    /// In numbers.
    distance: i64,
    /// That of the current repetition, to which the place of the first is added.
    now: Option<clif::Value>,
}

/// The walk in such distances, if need be a new one.
fn walk(walks: &mut Vec<Walk>, whole: clif::Value, distance: i64) -> usize {
    let known = walks.iter().position(|walk| walk.whole == whole && walk.distance == distance);
    known.unwrap_or_else(|| {
        walks.push(Walk { whole, distance, now: None });
        walks.len() - 1
    })
}

/// Writes the loop of a piece; gives the values that it holds. Each repetition is written as the first.
fn repeat(
    emitter: &mut Emitter,
    piece: &Piece,
    cut: &Outlined,
    scratch: clif::Value,
    b: &mut FunctionBuilder,
) -> Vec<Value> {
    let flags = MemFlagsData::trusted();
    let (func, block) = (emitter.func, emitter.block);
    let rows: Vec<&Row> = piece.rows.iter().map(|row| &cut.repeats.rows[*row]).collect();
    let firsts: HashSet<Value> = rows.iter().map(|row| row.members[0]).collect();
    let home = |value: Value| cut.homes[&value];
    let mut walks: Vec<Walk> = Vec::new();
    // What is read: where, and what it is in the first repetition; constants, which operand of what they are.
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
                Source::Same(value) => touched.extend(fetch(emitter, value, cut, scratch, b)),
                Source::Slots(first, distance) => inputs.push((walk(&mut walks, block, distance), first.0, operand)),
                Source::Table(table) => {
                    constants.push((walk(&mut walks, scratch, 1), cut.tables[table], (row.members[0], n)));
                }
                Source::Words(first, _) if firsts.contains(&first) => {}
                Source::Words(first, second) => {
                    let distance = i64::from(home(second)) - i64::from(home(first));
                    inputs.push((walk(&mut walks, scratch, distance), home(first), operand));
                }
            }
        }
    }
    inputs.sort_unstable_by_key(|(_, _, value)| *value);
    inputs.dedup();
    let kept: Vec<Value> =
        rows.iter().map(|row| row.members[0]).filter(|value| cut.homes.contains_key(value)).collect();
    let kept: Vec<_> = kept.into_iter().map(|value| (walk(&mut walks, scratch, 1), home(value), value)).collect();
    let stores = piece
        .row_stores
        .iter()
        .map(|(first, distance, row)| (walk(&mut walks, block, *distance), first.0, cut.repeats.rows[*row].members[0]));
    let outputs: Vec<(usize, u32, Value)> = kept.into_iter().chain(stores).collect();

    let [body, behind] = [(); 2].map(|()| b.create_block());
    let count = b.ins().iconst(types::I64, rows[0].members.len() as i64);
    let first: Vec<BlockArg> = walks.iter().map(|walk| walk.whole).chain([count]).map(BlockArg::Value).collect();
    b.ins().jump(body, &first);
    for walk in &mut walks {
        walk.now = Some(b.append_block_param(body, types::I64));
    }
    let left = b.append_block_param(body, types::I64);
    b.switch_to_block(body);
    let now = |of: usize| walks[of].now.expect("the loop has begun");
    for (walk, first, value) in &inputs {
        let loaded = b.ins().load(emitter.facts.type_of(*value), flags, now(*walk), offset(*first));
        emitter.values[value.index()] = Some(loaded);
    }
    for (walk, first, operand) in constants {
        let loaded = b.ins().load(types::F64, flags, now(walk), offset(first));
        emitter.instead.insert(operand, loaded);
    }
    let read: HashSet<Value> = inputs.iter().map(|(_, _, value)| *value).collect();
    let list: Vec<Value> = rows.iter().map(|row| row.members[0]).filter(|value| !read.contains(value)).collect();
    let left_behind: Vec<Value> = outputs.iter().map(|(_, _, value)| *value).collect();
    emitter.only(&list, &left_behind, b);
    for (walk, first, value) in &outputs {
        let value = emitter.get(*value, b);
        b.ins().store(flags, value, now(*walk), offset(*first));
    }
    let left = b.ins().iadd_imm_s(left, -1);
    let next: Vec<clif::Value> = (0..walks.len()).map(|k| b.ins().iadd_imm_s(now(k), 8 * walks[k].distance)).collect();
    let next: Vec<BlockArg> = next.into_iter().chain([left]).map(BlockArg::Value).collect();
    b.ins().brif(left, body, &next, behind, &[]);
    b.switch_to_block(behind);
    touched.into_iter().chain(read).chain(list).collect()
}

/// Takes a value of another piece from where it lies, or loads what each piece loads itself; gives it if it did.
fn fetch(
    emitter: &mut Emitter,
    value: Value,
    cut: &Outlined,
    scratch: clif::Value,
    b: &mut FunctionBuilder,
) -> Option<Value> {
    if emitter.values[value.index()].is_some() {
        return None;
    }
    match (cut.homes.get(&value), emitter.func.op(value)) {
        (Some(home), _) => {
            let of = emitter.facts.type_of(value);
            let loaded = b.ins().load(of, MemFlagsData::trusted(), scratch, offset(*home));
            emitter.values[value.index()] = Some(loaded);
        }
        (None, Op::Load(_)) => emitter.operation(value, b),
        // A constant is made at each use.
        (None, _) => return None,
    }
    Some(value)
}
