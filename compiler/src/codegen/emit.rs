//! A function of ours as two of Cranelift: one iteration, and a loop around the straight line.
//!
//! ```text
//! single: for a count of 1: all of it in a straight line, by regime where there are regimes, and store; return the status
//!
//! entry:  load every slot that is read; compute what no iteration changes
//! loop:   the rest, on the slots that are both read and written, which stay in registers; if they are many, in the block
//!         again while there are iterations left and the status is 0
//! exit:   store; return the status
//! ```
//! Of a choice that takes many operations on one side, only the side that is chosen is computed: see [`BranchRegions`].
//! A status `if failed then detail else 0` tests `failed` in the loop; what only the detail needs is computed on the way
//! out.
//! Each operation becomes one instruction or a fixed few. There are no symbols, no traps, and no calls but that of the loop
//! behind what makes a single iteration.

use crate::codegen::select_to_branch::BranchRegions;
use crate::codegen::sink::sunk;
use crate::codegen::specialise_modes::{Automaton, Case, Numbers, Specialised, Then, numbers, specialise};
use crate::codegen::unswitch::{assuming, unswitched};
use crate::ir::{Func, Op, Type, Value, Write, sign_of, verify};
use abi::Slot;
use cranelift_codegen::ir::condcodes::{FloatCC, IntCC};
use cranelift_codegen::ir::{
    self as clif, AbiParam, BlockArg, ExtFuncData, InstBuilder, MemFlagsData, Signature, UserExternalName, types,
};
use cranelift_codegen::isa::TargetIsa;
use cranelift_frontend::{FunctionBuilder, FunctionBuilderContext};
use std::cell::RefCell;
use std::collections::{HashMap, HashSet};

/// Numbers that a loop is given for each of its iterations: loads from `first` on read these. One slot's lie side by side,
/// those of the next slot `lanes` numbers on.
#[derive(Clone, Copy)]
pub struct Distributed {
    /// Stands for the first of them; no slot of the block lies behind it.
    pub first: Slot,
    /// Most iterations.
    pub lanes: usize,
}

/// The signature of [`abi::table::Entry`].
pub fn signature(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(isa.default_call_conv());
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature.returns.push(AbiParam::new(types::I64));
    signature
}

/// Writes `func`, which is sound and expanded, into the empty `target`: as a loop, or, if nothing changes from one iteration
/// to the next, as one. With numbers that have gone ahead it gets the signature of [`abi::ahead::RestEntry`].
pub fn emit(
    func: &Func,
    ahead: Option<Distributed>,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature(isa);
    if ahead.is_some() {
        target.signature.params.push(AbiParam::new(types::I64));
    }
    let mut b = FunctionBuilder::new(target, context);
    let [entry, prepare, nothing] = [(); 3].map(|()| b.create_block());
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count, ref gone_ahead @ ..] = b.block_params(entry) else { unreachable!("three parameters") };
    let gone_ahead = gone_ahead.first().copied();
    let (watch, late) = Watch::of(func);
    let facts = Facts::of_rest(func, ahead);
    b.ins().brif(count, prepare, &[], nothing, &[]);
    b.switch_to_block(prepare);
    let same = ahead.is_none() && stays_the_same(func);
    if same && func.ops.len() <= STRAIGHT {
        once(
            &specialise(func, &Numbers::new(), &late, watch.asked().0),
            watch,
            &late,
            (block, pool),
            near(isa),
            &mut b,
        );
    } else {
        let count = if same { b.ins().iconst(types::I64, 1) } else { count };
        let emitter = Emitter { ahead, near: near(isa), ..Emitter::new(func, &facts, block, pool) };
        again(emitter, (watch, &late), count, gone_ahead, &mut b);
    }
    b.switch_to_block(nothing);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Whether a single iteration has a function of its own, so that the loop's registers are none of its business.
pub fn has_single(func: &Func) -> bool {
    func.ops.len() <= STRAIGHT && !stays_the_same(func)
}

/// Whether nothing changes from one iteration to the next: then one is enough.
pub fn stays_the_same(func: &Func) -> bool {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    func.writes.is_empty() && func.loads().iter().all(|slot| !stored.contains(slot))
}

/// Writes a function that makes a single iteration itself and, if it `asks`, leaves every other count to the function behind
/// it.
pub fn emit_single(
    func: &Func,
    asks: bool,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature(isa);
    let mut b = FunctionBuilder::new(target, context);
    let entry = b.create_block();
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count] = b.block_params(entry) else { unreachable!("three parameters") };
    if asks {
        let [single, others] = [(); 2].map(|()| b.create_block());
        let other = b.ins().icmp_imm_s(IntCC::NotEqual, count, 1);
        b.ins().brif(other, others, &[], single, &[]);
        b.set_cold_block(others);
        b.switch_to_block(others);
        let name = UserExternalName { namespace: 0, index: 0 };
        let name = clif::ExternalName::user(b.func.declare_imported_user_function(name));
        let signature = b.import_signature(signature(isa));
        let many = b.import_function(ExtFuncData { name, signature, colocated: true, patchable: false });
        let call = b.ins().call(many, &[block, pool, count]);
        let status = b.inst_results(call)[0];
        b.ins().return_(&[status]);
        b.switch_to_block(single);
    }
    in_copies(func, &numbers(func), (block, pool), (near(isa), 0), &mut b);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Most questions behind each other, for each answer to which there is a copy.
const COPIED: usize = 2;

/// Writes one iteration without a loop, from where `b` stands to its returns: a copy for each answer to what several automata
/// ask alike.
fn in_copies(
    func: &Func,
    numbers: &Numbers,
    ports: (clif::Value, clif::Value),
    (near, asked): (bool, usize),
    b: &mut FunctionBuilder,
) {
    let Some(question) = unswitched(func).filter(|_| asked < COPIED) else {
        let (watch, late) = Watch::of(func);
        return once(&specialise(func, numbers, &late, watch.asked().0), watch, &late, ports, near, b);
    };
    let facts = Facts::of(func);
    let mut emitter = Emitter { near, ..Emitter::new(func, &facts, ports.0, ports.1) };
    let live = func.live_for([question].into_iter());
    let list = (0..func.ops.len()).filter(|i| live[*i]).map(|i| Value(i as u32));
    emitter.list(&list.collect::<Vec<_>>(), b);
    let sides = [true, false].map(|truth| (b.create_block(), assuming(func, question, truth)));
    emitter.ask(question, sides[0].0, sides[1].0, b);
    for (side, func) in sides {
        b.switch_to_block(side);
        in_copies(&func, numbers, ports, (near, asked + 1), b);
    }
}

/// Whether constants are best read from behind the code: x86-64 would make each in a general register first.
fn near(isa: &dyn TargetIsa) -> bool {
    isa.name() == "x64"
}

/// Writes the loop, from where `b` stands to its return.
fn again(
    mut emitter: Emitter,
    (watch, late): (Watch, &[bool]),
    count: clif::Value,
    gone_ahead: Option<clif::Value>,
    b: &mut FunctionBuilder,
) {
    let (func, facts, block) = (emitter.func, emitter.facts, emitter.block);
    let [body, more, failed, exit] = [(); 4].map(|()| b.create_block());
    let ops = || (0..func.ops.len()).map(|i| Value(i as u32));
    // The slots that an iteration hands to the next: in registers, or, if they are many, where the next one loads them.
    let handed: Vec<(Value, Value)> = emitter.carried();
    let (carried, in_block) =
        if handed.len() > IN_REGISTERS { (&handed[..0], &handed[..]) } else { (&handed[..], &handed[..0]) };
    let in_loop = |emitter: &Emitter, value: Value| {
        let in_register = match func.op(value) {
            Op::Load(slot) => in_block.is_empty() && emitter.gone_ahead(slot).is_none(),
            _ => false,
        };
        facts.varies[value.index()] && !in_register
    };
    let list: Vec<Value> = ops().filter(|value| !late[value.index()] && !in_loop(&emitter, *value)).collect();
    emitter.list(&list, b);
    let first: Vec<BlockArg> = carried.iter().map(|(load, _)| BlockArg::Value(emitter.get(*load, b))).collect();
    let first: Vec<BlockArg> =
        first.into_iter().chain([count].into_iter().chain(gone_ahead).map(BlockArg::Value)).collect();
    b.ins().jump(body, &first);

    for (load, _) in carried {
        emitter.values[load.index()] = Some(b.append_block_param(body, types::F64));
    }
    let left = b.append_block_param(body, types::I64);
    if gone_ahead.is_some() {
        emitter.instant = Some(b.append_block_param(body, types::I64));
    }
    b.switch_to_block(body);
    let list: Vec<Value> = ops().filter(|value| !late[value.index()] && in_loop(&emitter, *value)).collect();
    emitter.list(&list, b);
    emitter.writes(&func.writes, b);
    let left = b.ins().iadd_imm_s(left, -1);
    match watch {
        Watch::Nothing => {
            b.ins().jump(more, &[]);
        }
        Watch::Status(status) => {
            let status = emitter.get(status, b);
            b.ins().brif(status, failed, &[], more, &[]);
        }
        Watch::Failed { when, is, .. } => {
            let when = emitter.get(when, b);
            let (yes, no) = if is { (failed, more) } else { (more, failed) };
            b.ins().brif(when, yes, &[], no, &[]);
        }
    }
    b.switch_to_block(more);
    for (load, store) in in_block {
        let Op::Load(slot) = func.op(*load) else { unreachable!("it is a load") };
        let value = emitter.get(*store, b);
        b.ins().store(MemFlagsData::trusted(), value, block, offset(slot.0));
    }
    let next: Vec<BlockArg> = carried.iter().map(|(_, store)| BlockArg::Value(emitter.get(*store, b))).collect();
    let instant = emitter.instant.map(|instant| b.ins().iadd_imm_s(instant, 8));
    let next: Vec<BlockArg> = next.into_iter().chain([left].into_iter().chain(instant).map(BlockArg::Value)).collect();
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().brif(left, body, &next, exit, &[BlockArg::Value(zero)]);

    b.set_cold_block(failed);
    b.switch_to_block(failed);
    for value in ops().filter(|value| late[value.index()]) {
        emitter.operation(value, b);
    }
    let status = match watch {
        Watch::Nothing => zero,
        Watch::Status(status) => emitter.get(status, b),
        Watch::Failed { detail, .. } => emitter.get(detail, b),
    };
    b.ins().brif(status, exit, &[BlockArg::Value(status)], more, &[]);

    let status = b.append_block_param(exit, types::I64);
    b.switch_to_block(exit);
    emitter.stores(&func.stores, b);
    b.ins().return_(&[status]);
}

/// Most operations of a function of which a single iteration has code of its own.
const STRAIGHT: usize = 2500;
/// Most operations of a function that is short.
const SHORT: usize = 80;

/// Writes one iteration without a loop, from where `b` stands to its return.
fn once(
    apart: &Specialised,
    watch: Watch,
    late: &[bool],
    (block, pool): (clif::Value, clif::Value),
    near: bool,
    b: &mut FunctionBuilder,
) {
    let func = &apart.func;
    let ordered = |list: &[Value]| sunk(&func.ops, list);
    let before: HashSet<Value> = apart.before.iter().copied().collect();
    let later = || func.ops.iter().enumerate().filter(|(i, _)| !before.contains(&Value(*i as u32))).map(|(_, op)| *op);
    // What is read behind: by operations, or by regimes, in which an output may be what is there already.
    let mut read: Vec<Value> = func.results().collect();
    later().for_each(|op| op.each_operand(|operand| read.push(operand)));
    let mut facts = Facts::of(func);
    for (_, case) in apart.automata.iter().flat_map(|automaton| &automaton.cases) {
        case.each(&mut |case| match &case.then {
            Then::Outputs(outputs) => {
                outputs.iter().for_each(|output| facts.as_real[output.index()] = true);
                read.extend(outputs);
            }
            Then::Ask(when, _) => read.push(*when),
        });
    }
    let short = func.ops.len() <= SHORT;
    let mut emitter = Emitter { near, short, ..Emitter::new(func, &facts, block, pool) };
    emitter.only(&ordered(&apart.before), &read, b);
    // What is there by now is stored, so that nothing holds it, unless its slot is still to be read.
    let loads = later().filter_map(|op| if let Op::Load(slot) = op { Some(slot) } else { None });
    let read_later: HashSet<Slot> = loads.chain(apart.automata.iter().map(|automaton| automaton.slot)).collect();
    let (early, mut last): (Vec<_>, Vec<_>) =
        func.stores.iter().partition(|(slot, value)| before.contains(value) && !read_later.contains(slot));
    emitter.stores(&early, b);
    // So is what is there behind each automaton, and what several of them lead to is computed behind the last of these.
    let stages = apart.stages();
    let stored: HashSet<Value> = func.stores.iter().map(|(_, value)| *value).collect();
    let mut looked_at: Vec<Value> = Vec::new();
    for (op, _) in func.ops.iter().zip(late).filter(|(_, late)| **late) {
        op.each_operand(|operand| looked_at.extend(Some(operand).filter(|operand| !stored.contains(operand))));
    }
    let of_stage = |stage: Option<&usize>| -> Vec<Value> {
        apart.behind.iter().copied().filter(|value| stages.get(value) == stage).collect()
    };
    emitter.list(&ordered(&of_stage(None)), b);
    let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
    let not_only_watched = func.live_for(stored.iter().copied().chain(written));
    for (k, automaton) in apart.automata.iter().enumerate() {
        let read = apart.read_behind(k, |value| not_only_watched[value.index()]);
        let mut values = read.values;
        // What becomes of its own states each regime stores itself, if they change; what watches reads them from there.
        let (own, others): (Vec<_>, Vec<_>) =
            last.iter().partition(|(slot, value)| automaton.outputs.contains(value) && !read.slots.contains(slot));
        let places = own.iter().filter(|(_, value)| !values.contains(value)).map(|(slot, value)| (*value, *slot));
        emitter.stored.extend(places);
        let watches = apart.behind.iter().filter(|value| !not_only_watched[value.index()]);
        let watched = watches.flat_map(|value| func.reads(func.op(*value)));
        values.extend(watched.filter(|value| !emitter.stored.contains_key(value)));
        values.extend(others.iter().map(|(_, value)| *value).chain(watch.asked().0));
        values.extend(&looked_at);
        emitter.automaton(automaton, &own, &values, b);
        emitter.list(&ordered(&of_stage(Some(&k))), b);
        let is_there = |value: &Value| stages.get(value).is_none_or(|stage| *stage <= k);
        let (now, later): (Vec<_>, Vec<_>) =
            others.iter().partition(|(slot, value)| is_there(value) && !read.slots.contains(slot));
        emitter.stores(&now, b);
        last = later;
    }
    emitter.writes(&func.writes, b);
    emitter.stores(&last, b);
    let [fine, failed] = [(); 2].map(|()| b.create_block());
    match watch {
        Watch::Nothing => {
            b.ins().jump(fine, &[]);
        }
        Watch::Status(status) => {
            let status = emitter.get(status, b);
            b.ins().brif(status, failed, &[], fine, &[]);
        }
        Watch::Failed { when, is, .. } => {
            let (yes, no) = if is { (failed, fine) } else { (fine, failed) };
            emitter.branch(when, yes, no, b);
        }
    }
    b.switch_to_block(fine);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);
    b.set_cold_block(failed);
    b.switch_to_block(failed);
    // What is stored is read from there, so that nothing holds it until here.
    for (slot, value) in &func.stores {
        if !matches!(func.op(*value), Op::Load(_)) {
            let stored = b.ins().load(types::F64, MemFlagsData::trusted(), block, offset(slot.0));
            emitter.values[value.index()] = Some(stored);
        }
    }
    for (i, _) in late.iter().enumerate().filter(|(_, late)| **late) {
        emitter.operation(Value(i as u32), b);
    }
    let status = match watch {
        Watch::Nothing => b.ins().iconst(types::I64, 0),
        Watch::Status(status) => emitter.get(status, b),
        Watch::Failed { detail, .. } => emitter.get(detail, b),
    };
    b.ins().return_(&[status]);
}

/// Most slots that are handed from one iteration to the next in registers, as far as these reach. More only travel through
/// the stack, and the time to place them grows with the square of their number.
const IN_REGISTERS: usize = 24;

/// What ends the loop before its count.
#[derive(Clone, Copy)]
pub enum Watch {
    /// It runs to its end.
    Nothing,
    /// A status that is not 0.
    Status(Value),
    /// A truth; the status then is a detail.
    Failed {
        /// The truth,
        when: Value,
        /// as it is then.
        is: bool,
        /// The status.
        detail: Value,
    },
}

impl Watch {
    /// What is asked after each iteration, and what only then, if that says so.
    pub fn asked(self) -> (Option<Value>, Option<Value>) {
        match self {
            Watch::Nothing => (None, None),
            Watch::Status(status) => (Some(status), None),
            Watch::Failed { when, detail, .. } => (Some(when), Some(detail)),
        }
    }

    /// How to watch the status of `func`, and which operations only its detail needs.
    pub fn of(func: &Func) -> (Watch, Vec<bool>) {
        let mut late = vec![false; func.ops.len()];
        let Some(status) = func.status else { return (Watch::Nothing, late) };
        let Some((when, is, detail)) = func.failure() else { return (Watch::Status(status), late) };
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
        (Watch::Failed { when, is, detail }, late)
    }
}

/// The bit of a real's sign.
const SIGN: u64 = 1 << 63;

/// A real of these bits, read from behind the code.
fn behind(bits: u64, b: &mut FunctionBuilder) -> clif::Value {
    let constant = b.func.dfg.constants.insert(u128::from(bits).to_le_bytes().to_vec().into());
    let both = b.ins().vconst(types::F64X2, constant);
    b.ins().extractlane(both, 0)
}

/// Questions of one choice that are asked one after the other, at most.
const MOST_QUESTIONS: usize = 32;

/// Bytes from the beginning of a block or pool to its `index`-th number.
pub fn offset(index: u32) -> i32 {
    i32::try_from(index * 8).expect("blocks and pools are smaller than 2 GiB")
}

/// What is known of the values of a function.
pub struct Facts {
    /// Their types.
    types: Vec<Type>,
    /// Whether an iteration can change the value.
    pub varies: Vec<bool>,
    /// For tables: whether the number is needed as such and not only its bits.
    as_real: Vec<bool>,
    /// Whether a fused product takes the value.
    fused: Vec<bool>,
    /// Of integers that are known to lie between 0 and some number: that number.
    most: Vec<Option<i64>>,
}

impl Facts {
    /// Of a function that is sound.
    pub fn of(func: &Func) -> Facts {
        Facts::of_rest(func, None)
    }

    /// Of one some of whose numbers have gone ahead.
    fn of_rest(func: &Func, ahead: Option<Distributed>) -> Facts {
        let stored: HashMap<_, _> = func.stores.iter().copied().collect();
        let mut varies = vec![false; func.ops.len()];
        let mut as_real = vec![false; func.ops.len()];
        let mut fused = vec![false; func.ops.len()];
        for (i, op) in func.ops.iter().enumerate() {
            let mut changes = match op {
                Op::Load(slot) => stored.contains_key(slot) || ahead.is_some_and(|ahead| ahead.first <= *slot),
                Op::Ring { .. } => !func.writes.is_empty(),
                _ => false,
            };
            op.each_operand(|operand| {
                changes |= varies[operand.index()];
                as_real[operand.index()] |= !matches!(op, Op::ToBits(_));
                fused[operand.index()] |= matches!(op, Op::Fma(..));
            });
            varies[i] = changes;
        }
        for value in func.results() {
            as_real[value.index()] = true;
        }
        Facts { types: verify::types(func).expect("the function is sound"), varies, as_real, fused, most: most(func) }
    }

    /// As Cranelift names it.
    pub fn type_of(&self, value: Value) -> clif::Type {
        match self.types[value.index()] {
            Type::Real => types::F64,
            Type::Int => types::I64,
            Type::Bool => types::I8,
        }
    }
}

/// Of each integer between 0 and some number that number, where that is seen from how it is computed.
fn most(func: &Func) -> Vec<Option<i64>> {
    let mut most: Vec<Option<i64>> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let at = |value: Value| most[value.index()];
        let number = |value: Value| if let Op::Int(n) = func.op(value) { Some(n) } else { None };
        most.push(match *op {
            Op::Int(n) => (n >= 0).then_some(n),
            Op::IntAnd(a, c) => number(a).or(number(c)).filter(|mask| *mask >= 0),
            Op::IntAdd(a, c) => at(a).zip(at(c)).and_then(|(a, c)| a.checked_add(c)),
            Op::ShiftLeft(a, n) => at(a).filter(|a| a.leading_zeros() > u32::from(n) + 1).map(|a| a << n),
            Op::Select(_, yes, no) => at(yes).zip(at(no)).map(|(yes, no)| yes.max(no)),
            _ => None,
        });
    }
    most
}

/// Where all cases of an automaton end.
struct End {
    /// It goes on there,
    behind: clif::Block,
    /// where these outputs are read.
    outputs: Vec<bool>,
    /// The slots that get an output, by its number.
    stores: Vec<(Slot, usize)>,
    /// The automaton's slot and the bits that it holds, where these are known.
    held: Option<(Slot, u64)>,
}

/// Writes operations of a function.
pub struct Emitter<'a> {
    /// The function.
    pub func: &'a Func,
    /// What is known of its values.
    pub facts: &'a Facts,
    /// The values that are there, constants apart.
    pub values: Vec<Option<clif::Value>>,
    /// Values that are read from where they have been stored, each time anew.
    stored: HashMap<Value, Slot>,
    /// Operands that are another value than their operation says: by operation, and by their number there.
    pub instead: HashMap<(Value, usize), clif::Value>,
    /// Where the block is.
    pub block: clif::Value,
    /// Where the pool is.
    pub pool: clif::Value,
    /// What has gone ahead, and where this iteration's number of its first slot lies.
    ahead: Option<Distributed>,
    instant: Option<clif::Value>,
    /// Whether constants are read from behind the code.
    near: bool,
    /// Whether the function is short: calls of it overlap, and what counts is the number of instructions. In a longer one
    /// what is limited by a constant is chosen by a jump: most often the processor has gone on with the right one before it
    /// knows the other.
    short: bool,
    /// Places of tables and rings that are held inside: of an index and a length, and in which block.
    places: RefCell<HashMap<(Value, u32), (clif::Block, clif::Value)>>,
    /// Blocks that have run before what is being written, those of choices that lie behind it.
    passed: Vec<clif::Block>,
}

impl<'a> Emitter<'a> {
    /// Without any value yet.
    pub fn new(func: &'a Func, facts: &'a Facts, block: clif::Value, pool: clif::Value) -> Emitter<'a> {
        Emitter::with(func, facts, vec![None; func.ops.len()], block, pool)
    }

    /// With values that are there already: as many places as the function has operations.
    pub fn with(
        func: &'a Func,
        facts: &'a Facts,
        values: Vec<Option<clif::Value>>,
        block: clif::Value,
        pool: clif::Value,
    ) -> Emitter<'a> {
        let places = RefCell::default();
        Emitter {
            func,
            facts,
            values,
            block,
            pool,
            ahead: None,
            instant: None,
            stored: HashMap::new(),
            instead: HashMap::new(),
            near: false,
            short: false,
            places,
            passed: Vec::new(),
        }
    }

    /// Numbers from the iteration's first that went ahead to that of the slot, if it is one of these.
    fn gone_ahead(&self, slot: Slot) -> Option<u32> {
        let ahead = self.ahead?;
        (ahead.first <= slot).then(|| (slot.0 - ahead.first.0) * ahead.lanes as u32)
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

    /// Stores to slots.
    pub fn stores(&self, stores: &[(Slot, Value)], b: &mut FunctionBuilder) {
        for (slot, value) in stores {
            let value = self.get(*value, b);
            b.ins().store(MemFlagsData::trusted(), value, self.block, offset(slot.0));
        }
    }

    /// Writes to rings.
    pub fn writes(&self, writes: &[Write], b: &mut FunctionBuilder) {
        for write in writes {
            let (address, offset) = self.entry(self.block, write.base.0, write.len, write.index, b);
            let value = self.get(write.value, b);
            b.ins().store(MemFlagsData::trusted(), value, address, offset);
        }
    }

    /// The instruction's value. Constants are made anew at each use: kept, they would fill the registers.
    pub fn get(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.func.op(value) {
            Op::Pool { base, len, index } if let Op::Int(index) = self.func.op(index) => {
                let entry = (index as u64).min(u64::from(len) - 1) as u32;
                b.ins().load(types::F64, MemFlagsData::trusted(), self.pool, offset(base + entry))
            }
            Op::Real(bits) if self.near && bits != 0 => behind(bits, b),
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            Op::Int(n) => b.ins().iconst(types::I64, n),
            Op::Bool(truth) => b.ins().iconst(types::I8, i64::from(truth)),
            _ => self.values[value.index()].unwrap_or_else(|| {
                let slot = self.stored.get(&value).expect("operands come first");
                b.ins().load(types::F64, MemFlagsData::trusted(), self.block, offset(slot.0))
            }),
        }
    }

    /// The same of an operand that the instruction itself can take from memory.
    fn folded(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.func.op(value) {
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            _ => self.get(value, b),
        }
    }

    /// The `n`-th operand of an operation, which says that it is `operand`.
    fn operand(&self, of: Value, n: usize, operand: Value, b: &mut FunctionBuilder) -> clif::Value {
        self.instead.get(&(of, n)).copied().unwrap_or_else(|| self.get(operand, b))
    }

    /// Writes operations of which each stands behind its operands.
    fn list(&mut self, list: &[Value], b: &mut FunctionBuilder) {
        let listed: HashSet<Value> = list.iter().copied().collect();
        let mut read: Vec<Value> = self.func.results().collect();
        for (i, op) in self.func.ops.iter().enumerate() {
            if !listed.contains(&Value(i as u32)) {
                op.each_operand(|operand| read.push(operand));
            }
        }
        let sides = BranchRegions::of(&self.func.ops, list, &read);
        self.side(0, &sides, b);
    }

    /// Writes operations of which each stands behind its operands, and of which only the outputs are read elsewhere.
    pub fn only(&mut self, list: &[Value], outputs: &[Value], b: &mut FunctionBuilder) {
        let sides = BranchRegions::of(&self.func.ops, list, outputs);
        self.side(0, &sides, b);
    }

    /// Writes what depends on one regime: of the numbers its slot may hold only what is left for that number. It stores these
    /// of its outputs, and those among `read` are there behind it.
    fn automaton(
        &mut self,
        automaton: &Automaton,
        stores: &[(Slot, Value)],
        read: &HashSet<Value>,
        b: &mut FunctionBuilder,
    ) {
        let behind = b.create_block();
        let end = |held: Option<u64>| End {
            behind,
            outputs: automaton.outputs.iter().map(|output| read.contains(output)).collect(),
            stores: stores
                .iter()
                .map(|(slot, value)| {
                    (*slot, automaton.outputs.iter().position(|output| output == value).expect("its own"))
                })
                .collect(),
            held: held.map(|bits| (automaton.slot, bits)),
        };
        let held = b.ins().load(types::I64, MemFlagsData::trusted(), self.block, offset(automaton.slot.0));
        // Regimes that are left at once are seldom held.
        let mut cases: Vec<(u64, &Case)> = automaton.cases.iter().map(|(bits, case)| (*bits, case)).collect();
        cases.sort_by_key(|(bits, case)| self.changes(case, &end(Some(*bits))));
        let mut general = None;
        for (bits, case) in cases {
            let [this, others] = [(); 2].map(|()| b.create_block());
            if self.changes(case, &end(Some(bits))) {
                b.set_cold_block(this);
            }
            let number = b.ins().iconst(types::I64, bits as i64);
            // What is named last follows at once.
            let is_not = b.ins().icmp(IntCC::NotEqual, held, number);
            b.ins().brif(is_not, others, &[], this, &[]);
            b.switch_to_block(this);
            self.case(case, &end(Some(bits)), b);
            b.switch_to_block(others);
            general = Some(others);
        }
        general.into_iter().for_each(|block| b.set_cold_block(block));
        self.case(&automaton.general, &end(None), b);
        b.switch_to_block(behind);
        for output in automaton.outputs.iter().filter(|output| read.contains(output)) {
            self.values[output.index()] = Some(b.append_block_param(behind, self.facts.type_of(*output)));
        }
    }

    /// Whether a case, without a question, ends with another number in the slot than it held.
    fn changes(&self, case: &Case, end: &End) -> bool {
        let Then::Outputs(outputs) = &case.then else { return false };
        end.stores.iter().any(|(slot, number)| {
            let held = end.held.filter(|(held, _)| held == slot);
            matches!((held, self.func.op(outputs[*number])), (Some((_, bits)), Op::Real(next)) if next != bits)
        })
    }

    /// Writes one case and goes on behind it; nothing of it is there then.
    fn case(&mut self, case: &Case, end: &End, b: &mut FunctionBuilder) {
        match &case.then {
            Then::Outputs(outputs) => {
                let is_there = |(slot, value): &(Slot, Value)| match self.func.op(*value) {
                    Op::Load(from) => from == *slot,
                    Op::Real(bits) => end.held == Some((*slot, bits)),
                    _ => false,
                };
                let stores = end.stores.iter().map(|(slot, number)| (*slot, outputs[*number]));
                let stores: Vec<(Slot, Value)> = stores.filter(|store| !is_there(store)).collect();
                let read: Vec<Value> =
                    outputs.iter().zip(&end.outputs).filter(|(_, read)| **read).map(|(output, _)| *output).collect();
                let wanted: Vec<Value> = stores.iter().map(|(_, value)| *value).chain(read.iter().copied()).collect();
                let live = self.func.live_for(wanted.iter().copied());
                let list: Vec<Value> = case.list.iter().copied().filter(|value| live[value.index()]).collect();
                self.only(&sunk(&self.func.ops, &list), &wanted, b);
                self.stores(&stores, b);
                let read: Vec<BlockArg> = read.iter().map(|value| BlockArg::Value(self.get(*value, b))).collect();
                b.ins().jump(end.behind, &read);
            }
            Then::Ask(when, sides) => {
                // What is read by the cases within, or behind.
                let mut read = vec![*when];
                for side in sides.iter() {
                    side.each(&mut |inner| {
                        inner
                            .list
                            .iter()
                            .for_each(|value| self.func.op(*value).each_operand(|operand| read.push(operand)));
                        match &inner.then {
                            Then::Outputs(outputs) => read.extend(outputs),
                            Then::Ask(when, _) => read.push(*when),
                        }
                    });
                }
                self.only(&sunk(&self.func.ops, &case.list), &read, b);
                let blocks = [(); 2].map(|()| b.create_block());
                for (block, side) in blocks.iter().zip(sides.iter()) {
                    if self.changes(side, end) {
                        b.set_cold_block(*block);
                    }
                }
                self.branch(*when, blocks[0], blocks[1], b);
                for (side, block) in sides.iter().zip(blocks) {
                    b.switch_to_block(block);
                    self.case(side, end, b);
                }
            }
        }
        case.list.iter().for_each(|value| self.values[value.index()] = None);
    }

    /// Goes on at `yes` or at `no`: for what is put together from a few questions, one after the other.
    fn branch(&self, when: Value, yes: clif::Block, no: clif::Block, b: &mut FunctionBuilder) {
        let mut questions = 0;
        let mut open = vec![when];
        while let Some(value) = open.pop().filter(|_| questions <= MOST_QUESTIONS) {
            questions += 1;
            open.extend(self.parts(value).into_iter().flatten());
        }
        if questions <= MOST_QUESTIONS {
            self.ask(when, yes, no, b);
        } else {
            let when = self.get(when, b);
            b.ins().brif(when, yes, &[], no, &[]);
        }
    }

    /// What a truth is put together from, if that is at hand.
    fn parts(&self, value: Value) -> Option<[Value; 2]> {
        let there = |value: Value| matches!(self.func.op(value), Op::Bool(_)) || self.values[value.index()].is_some();
        match self.func.op(value) {
            Op::And(a, b) | Op::Or(a, b) => Some([a, b]),
            Op::Not(a) => Some([a, a]),
            _ => None,
        }
        .filter(|parts| parts.iter().all(|part| there(*part)))
    }

    fn ask(&self, when: Value, yes: clif::Block, no: clif::Block, b: &mut FunctionBuilder) {
        let Some([first, second]) = self.parts(when) else {
            let when = self.get(when, b);
            b.ins().brif(when, yes, &[], no, &[]);
            return;
        };
        if let Op::Not(_) = self.func.op(when) {
            return self.ask(first, no, yes, b);
        }
        let next = b.create_block();
        match self.func.op(when) {
            Op::And(..) => self.ask(first, next, no, b),
            _ => self.ask(first, yes, next, b),
        }
        b.switch_to_block(next);
        self.ask(second, yes, no, b);
    }

    /// Writes the operations of one side of a choice, or of none (0).
    fn side(&mut self, number: usize, sides: &BranchRegions, b: &mut FunctionBuilder) {
        let mut done = 0;
        let passed = self.passed.len();
        for value in &sides.members[number] {
            // Choices that were written together with the one before.
            if done > 0 {
                done -= 1;
                continue;
            }
            let Some([first, second]) = sides.of_choice.get(value) else {
                self.operation(*value, b);
                continue;
            };
            let choices = sides.together.get(value).map_or(std::slice::from_ref(value), |choices| choices);
            done = choices.len() - 1;
            let select = |choice: &Value| match self.func.op(*choice) {
                Op::Select(when, yes, no) => (when, [yes, no]),
                _ => unreachable!("it is a choice"),
            };
            let [chosen, other, behind] = [(); 3].map(|()| b.create_block());
            self.passed.extend(b.current_block());
            self.branch(select(value).0, chosen, other, b);
            for (block, side, which) in [(chosen, first, 0), (other, second, 1)] {
                b.switch_to_block(block);
                self.side(*side, sides, b);
                let result = |choice: &Value| self.operand(*choice, 1 + which, select(choice).1[which], b);
                let results: Vec<BlockArg> = choices.iter().map(result).map(BlockArg::Value).collect();
                b.ins().jump(behind, &results);
            }
            for choice in choices {
                self.values[choice.index()] = Some(b.append_block_param(behind, self.facts.type_of(*choice)));
            }
            b.switch_to_block(behind);
        }
        self.passed.truncate(passed);
    }

    /// Writes one operation whose operands are there.
    pub fn operation(&mut self, value: Value, b: &mut FunctionBuilder) {
        let flags = MemFlagsData::trusted();
        let op = self.func.op(value);
        let mut operands = [None; 3];
        let mut n = 0;
        // Of a table only the bits may be needed: then the number is never loaded.
        if let Op::Pool { base, len, index } = op {
            let constant = matches!(self.func.op(index), Op::Int(_));
            if !constant && self.facts.as_real[value.index()] {
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
        if self.near
            && let Some(x) = sign_of(op, |value| self.func.op(value))
        {
            // ±1 with the sign of x, unless x is neither above nor below 0.
            let x = self.get(x, b);
            let [sign, one, zero] = [behind(SIGN, b), behind(1f64.to_bits(), b), b.ins().f64const(0.0)];
            let negative = b.ins().band(x, sign);
            let unit = b.ins().bor(negative, one);
            let moves = b.ins().fcmp(FloatCC::OrderedNotEqual, x, zero);
            self.values[value.index()] = Some(b.ins().select(moves, unit, x));
            return;
        }
        // The same where one of them is a constant, of which the comparison would get one of its own.
        if let Op::Select(when, yes, no) = op
            && self.short
            && let Op::Less(first, second) = self.func.op(when)
            && [(first, second), (second, first)].contains(&(yes, no))
        {
            let chosen = [self.get(yes, b), self.folded(no, b)];
            let [first, second] = if first == yes { chosen } else { [chosen[1], chosen[0]] };
            let less = b.ins().fcmp(FloatCC::LessThan, first, second);
            self.values[value.index()] = Some(b.ins().select(less, chosen[0], chosen[1]));
            return;
        }
        // What stands last can be taken from memory; of what is to be less, what stands first.
        let from_memory = match op {
            Op::Add(..) | Op::Mul(..) | Op::Sub(..) | Op::Div(..) | Op::Equal(..) => 1,
            Op::Less(..) | Op::LessEqual(..) => 0,
            Op::Fma(..) => 2,
            _ => operands.len(),
        };
        let turned = match op {
            Op::Add(first, _) | Op::Mul(first, _) | Op::Equal(first, _) => {
                matches!(self.func.op(first), Op::Real(_))
            }
            _ => false,
        };
        op.each_operand(|operand| {
            let folded = turned || n == from_memory;
            let instead = self.instead.get(&(value, n)).copied();
            let known = || if folded { self.folded(operand, b) } else { self.get(operand, b) };
            operands[n] = Some(instead.unwrap_or_else(known));
            n += 1;
        });
        if turned {
            operands.swap(0, 1);
        }
        let x = |i: usize| operands[i].expect("an operand");
        let result = match op {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) => return,
            Op::Pool { .. } | Op::Ring { .. } => unreachable!("done above"),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Load(slot) => match self.gone_ahead(slot).zip(self.instant) {
                Some((distance, instant)) => b.ins().load(types::F64, flags, instant, offset(distance)),
                None => b.ins().load(types::F64, flags, self.block, offset(slot.0)),
            },
            Op::Add(..) => b.ins().fadd(x(0), x(1)),
            Op::Sub(..) => b.ins().fsub(x(0), x(1)),
            Op::Mul(..) => b.ins().fmul(x(0), x(1)),
            Op::Div(..) => b.ins().fdiv(x(0), x(1)),
            // A fused product takes the sign along.
            Op::Neg(_) if self.near && !self.facts.fused[value.index()] => {
                let sign = behind(SIGN, b);
                b.ins().bxor(x(0), sign)
            }
            Op::Neg(_) => b.ins().fneg(x(0)),
            Op::Abs(_) if self.near => {
                let size = behind(!SIGN, b);
                b.ins().band(x(0), size)
            }
            Op::Abs(_) => b.ins().fabs(x(0)),
            Op::Sqrt(_) => b.ins().sqrt(x(0)),
            Op::Fma(..) => b.ins().fma(x(0), x(1), x(2)),
            Op::Floor(_) => b.ins().floor(x(0)),
            Op::Nearest(_) => b.ins().nearest(x(0)),
            Op::Less(..) => b.ins().fcmp(FloatCC::LessThan, x(0), x(1)),
            // x − x is +0 or NaN: integers tell which.
            Op::LessEqual(d, e) if d == e && matches!(self.func.op(d), Op::Sub(x, y) if x == y) => {
                let bits = b.ins().bitcast(types::I64, MemFlagsData::new(), x(0));
                b.ins().icmp_imm_s(IntCC::Equal, bits, 0)
            }
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
        debug_assert_eq!(b.func.dfg.value_type(result), self.facts.type_of(value));
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
        let here = b.current_block().expect("a block is being written");
        let known = self.places.borrow().get(&(index, len)).copied();
        let known = known.filter(|(block, _)| *block == here || self.passed.contains(block));
        let place = known.map(|(_, place)| place).unwrap_or_else(|| {
            let place = self.get(index, b);
            if self.facts.most[index.index()].is_some_and(|most| most < i64::from(len)) {
                return place;
            }
            let last = b.ins().iconst(types::I64, i64::from(len) - 1);
            let place = b.ins().umin(place, last);
            self.places.borrow_mut().insert((index, len), (here, place));
            place
        });
        let bytes = b.ins().ishl_imm_u(place, 3);
        (b.ins().iadd(whole, bytes), offset(base))
    }
}
