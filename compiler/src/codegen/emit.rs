//! Emits one function of the IR as Cranelift IR: as a single iteration, and as a loop around the straight line.
//!
//! In: a verified, expanded function. Out: Cranelift IR with the signature of [`abi::table::Entry`]. It knows of the
//! target only whether constants are best read relative to the instruction pointer.
//!
//! ```text
//! single: for a count of 1: the straight line, specialised by mode where there are modes; store; return the status
//!
//! entry:  load every slot that is read; compute the loop invariants
//! loop:   the variant operations. Slots that are both read and written are carried in registers, or in the block if
//!         they are many; repeat while iterations remain and the status is 0
//! exit:   store; return the status
//! ```
//! A `select` with an expensive arm becomes a branch around that arm: see [`BranchRegions`]. For a status of the form
//! `if failed then detail else 0` the loop tests only `failed`; operations that only `detail` needs are cold and run on
//! the exit path. Each operation becomes one instruction or a fixed few. The code contains no symbols, no traps, and no
//! calls except one from the single iteration to the loop.

use crate::codegen::select_to_branch::BranchRegions;
use crate::codegen::sink::sink;
use crate::codegen::specialise_modes::{Automaton, Case, Modes, Specialised, Terminator, modes, specialise};
use crate::codegen::unswitch::{assuming, unswitchable};
use crate::ir::variance::{self, Slots};
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

/// Values that a vectorised loop has computed for each iteration, see `loop_distribution`: loads from slot `first` on
/// read these. The values of one slot lie side by side, one for each iteration; those of the next slot begin `lanes`
/// doubles later.
#[derive(Clone, Copy)]
pub struct Distributed {
    /// The slot of the first value; all slots of the block are lower.
    pub first: Slot,
    /// The largest number of iterations.
    pub lanes: usize,
}

/// The signature of [`abi::table::Entry`].
pub fn signature(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(isa.default_call_conv());
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature.returns.push(AbiParam::new(types::I64));
    signature
}

/// Emits `func`, which is verified and expanded, into the empty `target`: as a loop or, if an iteration changes nothing
/// that it reads, as a single iteration. With `distributed` values the signature is that of [`abi::ahead::RestEntry`].
pub fn emit(
    func: &Func,
    distributed: Option<Distributed>,
    target: &mut clif::Function,
    context: &mut FunctionBuilderContext,
    isa: &dyn TargetIsa,
) {
    target.signature = signature(isa);
    if distributed.is_some() {
        target.signature.params.push(AbiParam::new(types::I64));
    }
    let mut b = FunctionBuilder::new(target, context);
    let [entry, prepare, nothing] = [(); 3].map(|()| b.create_block());
    b.append_block_params_for_function_params(entry);
    b.switch_to_block(entry);
    let &[block, pool, count, ref distributed_base @ ..] = b.block_params(entry) else {
        unreachable!("three parameters")
    };
    let distributed_base = distributed_base.first().copied();
    let (exit_condition, cold) = ExitCondition::of(func);
    let facts = Facts::with_distributed(func, distributed);
    b.ins().brif(count, prepare, &[], nothing, &[]);
    b.switch_to_block(prepare);
    let same = distributed.is_none() && is_idempotent(func);
    if same && func.ops.len() <= MAX_SINGLE_OPS {
        single_body(
            &specialise(func, &Modes::new(), &cold, exit_condition.values().0),
            exit_condition,
            &cold,
            (block, pool),
            rip_relative(isa),
            &mut b,
        );
    } else {
        let count = if same { b.ins().iconst(types::I64, 1) } else { count };
        let emitter =
            Emitter { distributed, rip_relative: rip_relative(isa), ..Emitter::new(func, &facts, block, pool) };
        loop_body(emitter, (exit_condition, &cold), count, distributed_base, &mut b);
    }
    b.switch_to_block(nothing);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Whether a single iteration gets a function of its own, so that the loop does not constrain its registers.
pub fn has_single(func: &Func) -> bool {
    func.ops.len() <= MAX_SINGLE_OPS && !is_idempotent(func)
}

/// Whether no iteration reads anything that an iteration writes: then one iteration is enough.
pub fn is_idempotent(func: &Func) -> bool {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    func.writes.is_empty() && func.loads().iter().all(|slot| !stored.contains(slot))
}

/// Emits a function that runs a single iteration. `checks_count`: it calls the loop, which follows it in the code, when
/// the count is not 1.
pub fn emit_single(
    func: &Func,
    checks_count: bool,
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
    if checks_count {
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
    unswitched_body(func, &modes(func), (block, pool), (rip_relative(isa), 0), &mut b);
    b.seal_all_blocks();
    b.finalize(isa.frontend_config());
}

/// Maximum depth of nested unswitching; each level doubles the code.
const MAX_UNSWITCHES: usize = 2;

/// Emits one iteration without a loop at the current position of `b`, up to and including its returns. Conditions that
/// several automata test are unswitched: one copy of the code for each answer.
fn unswitched_body(
    func: &Func,
    modes: &Modes,
    ports: (clif::Value, clif::Value),
    (rip_relative, depth): (bool, usize),
    b: &mut FunctionBuilder,
) {
    let Some(condition) = unswitchable(func).filter(|_| depth < MAX_UNSWITCHES) else {
        let (exit_condition, cold) = ExitCondition::of(func);
        return single_body(
            &specialise(func, modes, &cold, exit_condition.values().0),
            exit_condition,
            &cold,
            ports,
            rip_relative,
            b,
        );
    };
    let facts = Facts::of(func);
    let mut emitter = Emitter { rip_relative, ..Emitter::new(func, &facts, ports.0, ports.1) };
    let live = func.live_for([condition].into_iter());
    let list = (0..func.ops.len()).filter(|i| live[*i]).map(|i| Value(i as u32));
    emitter.list(&list.collect::<Vec<_>>(), b);
    let sides = [true, false].map(|truth| (b.create_block(), assuming(func, condition, truth)));
    emitter.short_circuit(condition, sides[0].0, sides[1].0, b);
    for (side, func) in sides {
        b.switch_to_block(side);
        unswitched_body(&func, modes, ports, (rip_relative, depth + 1), b);
    }
}

/// Whether real constants are best loaded from memory after the code: x86-64 would otherwise build each in a general
/// register first.
fn rip_relative(isa: &dyn TargetIsa) -> bool {
    isa.name() == "x64"
}

/// Emits the loop at the current position of `b`, up to and including its return.
fn loop_body(
    mut emitter: Emitter,
    (exit_condition, cold): (ExitCondition, &[bool]),
    count: clif::Value,
    distributed_base: Option<clif::Value>,
    b: &mut FunctionBuilder,
) {
    let (func, facts, block) = (emitter.func, emitter.facts, emitter.block);
    let [body, more, failed, exit] = [(); 4].map(|()| b.create_block());
    let ops = || (0..func.ops.len()).map(|i| Value(i as u32));
    // The slots that one iteration passes to the next: in registers or, if they are many, in the block.
    let all_carried: Vec<(Value, Value)> = emitter.carried();
    let (carried, in_block) = if all_carried.len() > MAX_IN_REGISTERS {
        (&all_carried[..0], &all_carried[..])
    } else {
        (&all_carried[..], &all_carried[..0])
    };
    let is_in_loop = |emitter: &Emitter, value: Value| {
        let in_register = match func.op(value) {
            Op::Load(slot) => in_block.is_empty() && emitter.distributed_offset(slot).is_none(),
            _ => false,
        };
        facts.is_variant[value.index()] && !in_register
    };
    let list: Vec<Value> = ops().filter(|value| !cold[value.index()] && !is_in_loop(&emitter, *value)).collect();
    emitter.list(&list, b);
    let first: Vec<BlockArg> = carried.iter().map(|(load, _)| BlockArg::Value(emitter.get(*load, b))).collect();
    let first: Vec<BlockArg> =
        first.into_iter().chain([count].into_iter().chain(distributed_base).map(BlockArg::Value)).collect();
    b.ins().jump(body, &first);

    for (load, _) in carried {
        emitter.values[load.index()] = Some(b.append_block_param(body, types::F64));
    }
    let remaining = b.append_block_param(body, types::I64);
    if distributed_base.is_some() {
        emitter.iteration_base = Some(b.append_block_param(body, types::I64));
    }
    b.switch_to_block(body);
    let list: Vec<Value> = ops().filter(|value| !cold[value.index()] && is_in_loop(&emitter, *value)).collect();
    emitter.list(&list, b);
    emitter.writes(&func.writes, b);
    let remaining = b.ins().iadd_imm_s(remaining, -1);
    match exit_condition {
        ExitCondition::Never => {
            b.ins().jump(more, &[]);
        }
        ExitCondition::Status(status) => {
            let status = emitter.get(status, b);
            b.ins().brif(status, failed, &[], more, &[]);
        }
        ExitCondition::Failed { when, is, .. } => {
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
    let iteration_base = emitter.iteration_base.map(|iteration_base| b.ins().iadd_imm_s(iteration_base, 8));
    let next: Vec<BlockArg> =
        next.into_iter().chain([remaining].into_iter().chain(iteration_base).map(BlockArg::Value)).collect();
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().brif(remaining, body, &next, exit, &[BlockArg::Value(zero)]);

    b.set_cold_block(failed);
    b.switch_to_block(failed);
    for value in ops().filter(|value| cold[value.index()]) {
        emitter.operation(value, b);
    }
    let status = match exit_condition {
        ExitCondition::Never => zero,
        ExitCondition::Status(status) => emitter.get(status, b),
        ExitCondition::Failed { detail, .. } => emitter.get(detail, b),
    };
    b.ins().brif(status, exit, &[BlockArg::Value(status)], more, &[]);

    let status = b.append_block_param(exit, types::I64);
    b.switch_to_block(exit);
    emitter.stores(&func.stores, b);
    b.ins().return_(&[status]);
}

/// Maximum number of operations of a function whose single iteration gets code of its own.
const MAX_SINGLE_OPS: usize = 2500;
/// Maximum number of operations of a short function, see [`Emitter::short`].
const MAX_SHORT_OPS: usize = 80;

/// Emits one iteration, specialised by mode, at the current position of `b`, up to and including its returns.
fn single_body(
    specialised: &Specialised,
    exit_condition: ExitCondition,
    cold: &[bool],
    (block, pool): (clif::Value, clif::Value),
    rip_relative: bool,
    b: &mut FunctionBuilder,
) {
    let func = &specialised.func;
    let ordered = |list: &[Value]| sink(&func.ops, list);
    let common: HashSet<Value> = specialised.common.iter().copied().collect();
    let later = || func.ops.iter().enumerate().filter(|(i, _)| !common.contains(&Value(*i as u32))).map(|(_, op)| *op);
    // Values read after the common operations: by later operations, and by modes. The output of a mode may be a value
    // that is already computed.
    let mut read: Vec<Value> = func.results().collect();
    later().for_each(|op| op.each_operand(|operand| read.push(operand)));
    let mut facts = Facts::of(func);
    for (_, case) in specialised.automata.iter().flat_map(|automaton| &automaton.cases) {
        case.each(&mut |case| match &case.terminator {
            Terminator::Outputs(outputs) => {
                outputs.iter().for_each(|output| facts.as_real[output.index()] = true);
                read.extend(outputs);
            }
            Terminator::Branch(when, _) => read.push(*when),
        });
    }
    let short = func.ops.len() <= MAX_SHORT_OPS;
    let mut emitter = Emitter { rip_relative, short, ..Emitter::new(func, &facts, block, pool) };
    emitter.list_with_outputs(&ordered(&specialised.common), &read, b);
    // Values that are already computed are stored here, so that they occupy no register, unless their slot is still to
    // be read.
    let loads = later().filter_map(|op| if let Op::Load(slot) = op { Some(slot) } else { None });
    let read_later: HashSet<Slot> = loads.chain(specialised.automata.iter().map(|automaton| automaton.slot)).collect();
    let (early, mut last): (Vec<_>, Vec<_>) =
        func.stores.iter().partition(|(slot, value)| common.contains(value) && !read_later.contains(slot));
    emitter.stores(&early, b);
    // The same after each automaton. Operations that depend on several automata follow the last of these.
    let stages = specialised.stages();
    let stored: HashSet<Value> = func.stores.iter().map(|(_, value)| *value).collect();
    let mut cold_operands: Vec<Value> = Vec::new();
    for (op, _) in func.ops.iter().zip(cold).filter(|(_, cold)| **cold) {
        op.each_operand(|operand| cold_operands.extend(Some(operand).filter(|operand| !stored.contains(operand))));
    }
    let of_stage = |stage: Option<&usize>| -> Vec<Value> {
        specialised.joint.iter().copied().filter(|value| stages.get(value) == stage).collect()
    };
    emitter.list(&ordered(&of_stage(None)), b);
    let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
    let not_only_guard = func.live_for(stored.iter().copied().chain(written));
    for (k, automaton) in specialised.automata.iter().enumerate() {
        let read = specialised.read_after(k, |value| not_only_guard[value.index()]);
        let mut values = read.values;
        // Each mode itself stores the states that only its automaton changes; guards reload them from the block.
        let (own, others): (Vec<_>, Vec<_>) =
            last.iter().partition(|(slot, value)| automaton.outputs.contains(value) && !read.slots.contains(slot));
        let reloaded = own.iter().filter(|(_, value)| !values.contains(value)).map(|(slot, value)| (*value, *slot));
        emitter.stored.extend(reloaded);
        let guards = specialised.joint.iter().filter(|value| !not_only_guard[value.index()]);
        let guard_operands = guards.flat_map(|value| func.reads(func.op(*value)));
        values.extend(guard_operands.filter(|value| !emitter.stored.contains_key(value)));
        values.extend(others.iter().map(|(_, value)| *value).chain(exit_condition.values().0));
        values.extend(&cold_operands);
        emitter.automaton(automaton, &own, &values, b);
        emitter.list(&ordered(&of_stage(Some(&k))), b);
        let is_available = |value: &Value| stages.get(value).is_none_or(|stage| *stage <= k);
        let (now, later): (Vec<_>, Vec<_>) =
            others.iter().partition(|(slot, value)| is_available(value) && !read.slots.contains(slot));
        emitter.stores(&now, b);
        last = later;
    }
    emitter.writes(&func.writes, b);
    emitter.stores(&last, b);
    let [fine, failed] = [(); 2].map(|()| b.create_block());
    match exit_condition {
        ExitCondition::Never => {
            b.ins().jump(fine, &[]);
        }
        ExitCondition::Status(status) => {
            let status = emitter.get(status, b);
            b.ins().brif(status, failed, &[], fine, &[]);
        }
        ExitCondition::Failed { when, is, .. } => {
            let (yes, no) = if is { (failed, fine) } else { (fine, failed) };
            emitter.branch(when, yes, no, b);
        }
    }
    b.switch_to_block(fine);
    let zero = b.ins().iconst(types::I64, 0);
    b.ins().return_(&[zero]);
    b.set_cold_block(failed);
    b.switch_to_block(failed);
    // Stored values are reloaded here, so that they occupy no register until this cold path.
    for (slot, value) in &func.stores {
        if !matches!(func.op(*value), Op::Load(_)) {
            let stored = b.ins().load(types::F64, MemFlagsData::trusted(), block, offset(slot.0));
            emitter.values[value.index()] = Some(stored);
        }
    }
    for (i, _) in cold.iter().enumerate().filter(|(_, cold)| **cold) {
        emitter.operation(Value(i as u32), b);
    }
    let status = match exit_condition {
        ExitCondition::Never => b.ins().iconst(types::I64, 0),
        ExitCondition::Status(status) => emitter.get(status, b),
        ExitCondition::Failed { detail, .. } => emitter.get(detail, b),
    };
    b.ins().return_(&[status]);
}

/// Maximum number of slots that a loop carries in registers. More would be spilled anyway, and the time of register
/// allocation grows with the square of their number.
const MAX_IN_REGISTERS: usize = 24;

/// The condition that ends the loop before its count.
#[derive(Clone, Copy)]
pub enum ExitCondition {
    /// None: the loop runs to its count.
    Never,
    /// An integer: the loop ends when it is not 0.
    Status(Value),
    /// A boolean: the loop ends when it has the given value and the status is not 0.
    Failed {
        /// The boolean.
        when: Value,
        /// Its value when a guard has failed.
        is: bool,
        /// The status if a guard has failed.
        detail: Value,
    },
}

impl ExitCondition {
    /// The value that is tested after each iteration, and the value that is computed only when that test fails.
    pub fn values(self) -> (Option<Value>, Option<Value>) {
        match self {
            ExitCondition::Never => (None, None),
            ExitCondition::Status(status) => (Some(status), None),
            ExitCondition::Failed { when, detail, .. } => (Some(when), Some(detail)),
        }
    }

    /// The exit condition of `func`, and for each operation whether it is cold: only the detail of the status needs it.
    pub fn of(func: &Func) -> (ExitCondition, Vec<bool>) {
        let mut cold = vec![false; func.ops.len()];
        let Some(status) = func.status else { return (ExitCondition::Never, cold) };
        let Some((when, is, detail)) = func.failure() else { return (ExitCondition::Status(status), cold) };
        let mut needed = vec![false; func.ops.len()];
        needed[when.index()] = true;
        for value in func.results().filter(|value| Some(*value) != func.status) {
            needed[value.index()] = true;
        }
        for i in (0..func.ops.len()).rev() {
            // Loads and ring reads must precede the stores of the iteration, and so must the indices of ring reads.
            needed[i] |= matches!(func.ops[i], Op::Load(_) | Op::Ring { .. });
            if needed[i] {
                func.ops[i].each_operand(|operand| needed[operand.index()] = true);
            }
            cold[i] = !needed[i];
        }
        (ExitCondition::Failed { when, is, detail }, cold)
    }
}

/// The sign bit of a real.
const SIGN: u64 = 1 << 63;

/// The real with these bits, loaded relative to the instruction pointer from the constants after the code.
fn rip_relative_real(bits: u64, b: &mut FunctionBuilder) -> clif::Value {
    let constant = b.func.dfg.constants.insert(u128::from(bits).to_le_bytes().to_vec().into());
    let both = b.ins().vconst(types::F64X2, constant);
    b.ins().extractlane(both, 0)
}

/// Maximum number of tests of one condition that become short-circuit branches.
const MAX_TESTS: usize = 32;

/// Offset in bytes of the double at `index` in a block or pool.
pub fn offset(index: u32) -> i32 {
    i32::try_from(index * 8).expect("blocks and pools are smaller than 2 GiB")
}

/// Results of the analyses of a function, by value.
pub struct Facts {
    /// Types.
    types: Vec<Type>,
    /// Whether an iteration can change the value; if not, it is loop-invariant.
    pub is_variant: Vec<bool>,
    /// For table entries: whether the real itself is used, or only its bits.
    as_real: Vec<bool>,
    /// Whether a fused multiply-add reads the value.
    fused: Vec<bool>,
    /// Upper bound, inclusive, of integers that are known not to be negative.
    upper_bound: Vec<Option<i64>>,
}

impl Facts {
    /// Analyses a verified function.
    pub fn of(func: &Func) -> Facts {
        Facts::with_distributed(func, None)
    }

    /// Analyses a function, some of whose loads read distributed values.
    fn with_distributed(func: &Func, distributed: Option<Distributed>) -> Facts {
        let slots = Slots::new(func.stores.iter().map(|(slot, _)| *slot), None)
            .with_values_of_time(distributed.map(|distributed| distributed.first));
        let variance = variance::of_slots(func, &slots);
        let mut as_real = vec![false; func.ops.len()];
        let mut fused = vec![false; func.ops.len()];
        for op in &func.ops {
            op.each_operand(|operand| {
                as_real[operand.index()] |= !matches!(op, Op::ToBits(_));
                fused[operand.index()] |= matches!(op, Op::Fma(..));
            });
        }
        for value in func.results() {
            as_real[value.index()] = true;
        }
        Facts {
            types: verify::types(func).expect("the function is sound"),
            is_variant: variance.iter().map(|variance| !variance.is_invariant()).collect(),
            as_real,
            fused,
            upper_bound: upper_bound(func),
        }
    }

    /// Its Cranelift type.
    pub fn type_of(&self, value: Value) -> clif::Type {
        match self.types[value.index()] {
            Type::Real => types::F64,
            Type::Int => types::I64,
            Type::Bool => types::I8,
        }
    }
}

/// For each integer that is provably not negative, an inclusive upper bound, from the operations that compute it.
fn upper_bound(func: &Func) -> Vec<Option<i64>> {
    let mut bounds: Vec<Option<i64>> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let at = |value: Value| bounds[value.index()];
        let number = |value: Value| if let Op::Int(n) = func.op(value) { Some(n) } else { None };
        bounds.push(match *op {
            Op::Int(n) => (n >= 0).then_some(n),
            Op::IntAnd(a, c) => number(a).or(number(c)).filter(|mask| *mask >= 0),
            Op::IntAdd(a, c) => at(a).zip(at(c)).and_then(|(a, c)| a.checked_add(c)),
            Op::ShiftLeft(a, n) => at(a).filter(|a| a.leading_zeros() > u32::from(n) + 1).map(|a| a << n),
            Op::Select(_, yes, no) => at(yes).zip(at(no)).map(|(yes, no)| yes.max(no)),
            _ => None,
        });
    }
    bounds
}

/// The join point of all cases of an automaton.
struct JoinPoint {
    /// The Cranelift block.
    block: clif::Block,
    /// For each output of the automaton, whether the code after the join point reads it.
    outputs: Vec<bool>,
    /// Slots that each case stores, with the index of the stored output.
    stores: Vec<(Slot, usize)>,
    /// The slot of the automaton and the bits it holds in this case, where they are known.
    held: Option<(Slot, u64)>,
}

/// Emits operations of a function.
pub struct Emitter<'a> {
    /// The function.
    pub func: &'a Func,
    /// Its analyses.
    pub facts: &'a Facts,
    /// Values computed so far, constants excepted.
    pub values: Vec<Option<clif::Value>>,
    /// Values that have been stored and are reloaded at each use.
    stored: HashMap<Value, Slot>,
    /// Operands that are replaced by another value: by operation and index of the operand.
    pub substitutes: HashMap<(Value, usize), clif::Value>,
    /// Address of the block.
    pub block: clif::Value,
    /// Address of the pool.
    pub pool: clif::Value,
    /// The distributed values, and the address of those of this iteration.
    distributed: Option<Distributed>,
    iteration_base: Option<clif::Value>,
    /// Whether real constants are loaded relative to the instruction pointer.
    rip_relative: bool,
    /// Whether the function is short. Successive calls of a short function overlap in the processor, so the number of
    /// instructions counts. In a longer one a limit by a constant becomes a conditional jump: where its prediction is
    /// right, the comparison is not on the critical path.
    short: bool,
    /// Clamped indices of tables and rings: for an index and a length, the Cranelift block with the clamp, and its value.
    clamped: RefCell<HashMap<(Value, u32), (clif::Block, clif::Value)>>,
    /// Blocks that dominate the current one: those that end in a branch of this or an enclosing region.
    dominators: Vec<clif::Block>,
}

impl<'a> Emitter<'a> {
    /// An emitter without any computed values.
    pub fn new(func: &'a Func, facts: &'a Facts, block: clif::Value, pool: clif::Value) -> Emitter<'a> {
        Emitter::with(func, facts, vec![None; func.ops.len()], block, pool)
    }

    /// An emitter with some values already computed: one entry for each operation of the function.
    pub fn with(
        func: &'a Func,
        facts: &'a Facts,
        values: Vec<Option<clif::Value>>,
        block: clif::Value,
        pool: clif::Value,
    ) -> Emitter<'a> {
        let clamped = RefCell::default();
        Emitter {
            func,
            facts,
            values,
            block,
            pool,
            distributed: None,
            iteration_base: None,
            stored: HashMap::new(),
            substitutes: HashMap::new(),
            rip_relative: false,
            short: false,
            clamped,
            dominators: Vec::new(),
        }
    }

    /// Offset in doubles from the first distributed value of an iteration to that of the slot, if the slot is
    /// distributed.
    fn distributed_offset(&self, slot: Slot) -> Option<u32> {
        let distributed = self.distributed?;
        (distributed.first <= slot).then(|| (slot.0 - distributed.first.0) * distributed.lanes as u32)
    }

    /// Loads of slots that are also stored, with the stored value.
    fn carried(&self) -> Vec<(Value, Value)> {
        let stored: HashMap<_, _> = self.func.stores.iter().copied().collect();
        let of_load = |(i, op): (usize, &Op)| match op {
            Op::Load(slot) => stored.get(slot).map(|value| (Value(i as u32), *value)),
            _ => None,
        };
        self.func.ops.iter().enumerate().filter_map(of_load).collect()
    }

    /// Emits stores to slots.
    pub fn stores(&self, stores: &[(Slot, Value)], b: &mut FunctionBuilder) {
        for (slot, value) in stores {
            let value = self.get(*value, b);
            b.ins().store(MemFlagsData::trusted(), value, self.block, offset(slot.0));
        }
    }

    /// Emits writes to rings.
    pub fn writes(&self, writes: &[Write], b: &mut FunctionBuilder) {
        for write in writes {
            let (address, offset) = self.entry(self.block, write.base.0, write.len, write.index, b);
            let value = self.get(write.value, b);
            b.ins().store(MemFlagsData::trusted(), value, address, offset);
        }
    }

    /// The Cranelift value. Constants are rematerialised at each use: kept, they would fill the registers.
    pub fn get(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.func.op(value) {
            Op::Pool { base, len, index } if let Op::Int(index) = self.func.op(index) => {
                let entry = (index as u64).min(u64::from(len) - 1) as u32;
                b.ins().load(types::F64, MemFlagsData::trusted(), self.pool, offset(base + entry))
            }
            Op::Real(bits) if self.rip_relative && bits != 0 => rip_relative_real(bits, b),
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            Op::Int(n) => b.ins().iconst(types::I64, n),
            Op::Bool(truth) => b.ins().iconst(types::I8, i64::from(truth)),
            _ => self.values[value.index()].unwrap_or_else(|| {
                let slot = self.stored.get(&value).expect("operands come first");
                b.ins().load(types::F64, MemFlagsData::trusted(), self.block, offset(slot.0))
            }),
        }
    }

    /// As `get`, for an operand that the instruction can take from memory: Cranelift folds an `f64const` into the
    /// instruction.
    fn folded(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.func.op(value) {
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            _ => self.get(value, b),
        }
    }

    /// Operand `n` of operation `of`: its substitute, or else `operand`.
    fn operand(&self, of: Value, n: usize, operand: Value, b: &mut FunctionBuilder) -> clif::Value {
        self.substitutes.get(&(of, n)).copied().unwrap_or_else(|| self.get(operand, b))
    }

    /// Emits operations, which must be in topological order.
    fn list(&mut self, list: &[Value], b: &mut FunctionBuilder) {
        let listed: HashSet<Value> = list.iter().copied().collect();
        let mut read: Vec<Value> = self.func.results().collect();
        for (i, op) in self.func.ops.iter().enumerate() {
            if !listed.contains(&Value(i as u32)) {
                op.each_operand(|operand| read.push(operand));
            }
        }
        let regions = BranchRegions::of(&self.func.ops, list, &read);
        self.region(0, &regions, b);
    }

    /// Emits operations, which must be in topological order, and of which only `outputs` are read elsewhere.
    pub fn list_with_outputs(&mut self, list: &[Value], outputs: &[Value], b: &mut FunctionBuilder) {
        let regions = BranchRegions::of(&self.func.ops, list, outputs);
        self.region(0, &regions, b);
    }

    /// Emits the operations of one automaton: a multi-way branch on its slot, with the residual operations for each
    /// mode. The automaton's own `stores` are emitted in each case; outputs among `read` become parameters of the join
    /// block.
    fn automaton(
        &mut self,
        automaton: &Automaton,
        stores: &[(Slot, Value)],
        read: &HashSet<Value>,
        b: &mut FunctionBuilder,
    ) {
        let after = b.create_block();
        let join = |held: Option<u64>| JoinPoint {
            block: after,
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
        // A mode that is left in the same step is rarely active, so it is tested last.
        let mut cases: Vec<(u64, &Case)> = automaton.cases.iter().map(|(bits, case)| (*bits, case)).collect();
        cases.sort_by_key(|(bits, case)| self.changes(case, &join(Some(*bits))));
        let mut general = None;
        for (bits, case) in cases {
            let [this, others] = [(); 2].map(|()| b.create_block());
            if self.changes(case, &join(Some(bits))) {
                b.set_cold_block(this);
            }
            let number = b.ins().iconst(types::I64, bits as i64);
            // The second target of `brif` is the fall-through.
            let is_not = b.ins().icmp(IntCC::NotEqual, held, number);
            b.ins().brif(is_not, others, &[], this, &[]);
            b.switch_to_block(this);
            self.case(case, &join(Some(bits)), b);
            b.switch_to_block(others);
            general = Some(others);
        }
        general.into_iter().for_each(|block| b.set_cold_block(block));
        self.case(&automaton.general, &join(None), b);
        b.switch_to_block(after);
        for output in automaton.outputs.iter().filter(|output| read.contains(output)) {
            self.values[output.index()] = Some(b.append_block_param(after, self.facts.type_of(*output)));
        }
    }

    /// Whether a case without further branches ends with another mode than the one it began with.
    fn changes(&self, case: &Case, join: &JoinPoint) -> bool {
        let Terminator::Outputs(outputs) = &case.terminator else { return false };
        join.stores.iter().any(|(slot, number)| {
            let held = join.held.filter(|(held, _)| held == slot);
            matches!((held, self.func.op(outputs[*number])), (Some((_, bits)), Op::Real(next)) if next != bits)
        })
    }

    /// Emits one case and the jump to the join point. Its values are then cleared, because they do not dominate the
    /// code that follows.
    fn case(&mut self, case: &Case, join: &JoinPoint, b: &mut FunctionBuilder) {
        match &case.terminator {
            Terminator::Outputs(outputs) => {
                let is_available = |(slot, value): &(Slot, Value)| match self.func.op(*value) {
                    Op::Load(from) => from == *slot,
                    Op::Real(bits) => join.held == Some((*slot, bits)),
                    _ => false,
                };
                let stores = join.stores.iter().map(|(slot, number)| (*slot, outputs[*number]));
                let stores: Vec<(Slot, Value)> = stores.filter(|store| !is_available(store)).collect();
                let read: Vec<Value> =
                    outputs.iter().zip(&join.outputs).filter(|(_, read)| **read).map(|(output, _)| *output).collect();
                let wanted: Vec<Value> = stores.iter().map(|(_, value)| *value).chain(read.iter().copied()).collect();
                let live = self.func.live_for(wanted.iter().copied());
                let list: Vec<Value> = case.list.iter().copied().filter(|value| live[value.index()]).collect();
                self.list_with_outputs(&sink(&self.func.ops, &list), &wanted, b);
                self.stores(&stores, b);
                let read: Vec<BlockArg> = read.iter().map(|value| BlockArg::Value(self.get(*value, b))).collect();
                b.ins().jump(join.block, &read);
            }
            Terminator::Branch(when, sides) => {
                // Values that nested cases read, as operands or as outputs.
                let mut read = vec![*when];
                for side in sides.iter() {
                    side.each(&mut |inner| {
                        inner
                            .list
                            .iter()
                            .for_each(|value| self.func.op(*value).each_operand(|operand| read.push(operand)));
                        match &inner.terminator {
                            Terminator::Outputs(outputs) => read.extend(outputs),
                            Terminator::Branch(when, _) => read.push(*when),
                        }
                    });
                }
                self.list_with_outputs(&sink(&self.func.ops, &case.list), &read, b);
                let blocks = [(); 2].map(|()| b.create_block());
                for (block, side) in blocks.iter().zip(sides.iter()) {
                    if self.changes(side, join) {
                        b.set_cold_block(*block);
                    }
                }
                self.branch(*when, blocks[0], blocks[1], b);
                for (side, block) in sides.iter().zip(blocks) {
                    b.switch_to_block(block);
                    self.case(side, join, b);
                }
            }
        }
        case.list.iter().for_each(|value| self.values[value.index()] = None);
    }

    /// Branches to `yes` or `no`. A condition composed of few tests becomes short-circuit branches.
    fn branch(&self, when: Value, yes: clif::Block, no: clif::Block, b: &mut FunctionBuilder) {
        let mut tests = 0;
        let mut open = vec![when];
        while let Some(value) = open.pop().filter(|_| tests <= MAX_TESTS) {
            tests += 1;
            open.extend(self.tests_of(value).into_iter().flatten());
        }
        if tests <= MAX_TESTS {
            self.short_circuit(when, yes, no, b);
        } else {
            let when = self.get(when, b);
            b.ins().brif(when, yes, &[], no, &[]);
        }
    }

    /// The operands of a compound condition, if they are available here.
    fn tests_of(&self, value: Value) -> Option<[Value; 2]> {
        let is_available =
            |value: Value| matches!(self.func.op(value), Op::Bool(_)) || self.values[value.index()].is_some();
        match self.func.op(value) {
            Op::And(a, b) | Op::Or(a, b) => Some([a, b]),
            Op::Not(a) => Some([a, a]),
            _ => None,
        }
        .filter(|operands| operands.iter().all(|operand| is_available(*operand)))
    }

    fn short_circuit(&self, when: Value, yes: clif::Block, no: clif::Block, b: &mut FunctionBuilder) {
        let Some([first, second]) = self.tests_of(when) else {
            let when = self.get(when, b);
            b.ins().brif(when, yes, &[], no, &[]);
            return;
        };
        if let Op::Not(_) = self.func.op(when) {
            return self.short_circuit(first, no, yes, b);
        }
        let next = b.create_block();
        match self.func.op(when) {
            Op::And(..) => self.short_circuit(first, next, no, b),
            _ => self.short_circuit(first, yes, next, b),
        }
        b.switch_to_block(next);
        self.short_circuit(second, yes, no, b);
    }

    /// Emits the operations of one branch region; region 0 holds those that run unconditionally.
    fn region(&mut self, number: usize, regions: &BranchRegions, b: &mut FunctionBuilder) {
        let mut done = 0;
        let dominators = self.dominators.len();
        for value in &regions.members[number] {
            // Selects that were emitted together with an earlier one.
            if done > 0 {
                done -= 1;
                continue;
            }
            let Some([first, second]) = regions.arms.get(value) else {
                self.operation(*value, b);
                continue;
            };
            let choices = regions.merged.get(value).map_or(std::slice::from_ref(value), |choices| choices);
            done = choices.len() - 1;
            let select = |choice: &Value| match self.func.op(*choice) {
                Op::Select(when, yes, no) => (when, [yes, no]),
                _ => unreachable!("it is a choice"),
            };
            let [chosen, other, after] = [(); 3].map(|()| b.create_block());
            self.dominators.extend(b.current_block());
            self.branch(select(value).0, chosen, other, b);
            for (block, side, which) in [(chosen, first, 0), (other, second, 1)] {
                b.switch_to_block(block);
                self.region(*side, regions, b);
                let result = |choice: &Value| self.operand(*choice, 1 + which, select(choice).1[which], b);
                let results: Vec<BlockArg> = choices.iter().map(result).map(BlockArg::Value).collect();
                b.ins().jump(after, &results);
            }
            for choice in choices {
                self.values[choice.index()] = Some(b.append_block_param(after, self.facts.type_of(*choice)));
            }
            b.switch_to_block(after);
        }
        self.dominators.truncate(dominators);
    }

    /// Emits one operation, whose operands must be available.
    pub fn operation(&mut self, value: Value, b: &mut FunctionBuilder) {
        let flags = MemFlagsData::trusted();
        let op = self.func.op(value);
        let mut operands = [None; 3];
        let mut n = 0;
        // If only the bits of a table entry are used, `ToBits` loads them as an integer and the real is never loaded.
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
        if self.rip_relative
            && let Some(x) = sign_of(op, |value| self.func.op(value))
        {
            // ±1 with the sign of x; x itself if it is ±0 or NaN.
            let x = self.get(x, b);
            let [sign, one, zero] =
                [rip_relative_real(SIGN, b), rip_relative_real(1f64.to_bits(), b), b.ins().f64const(0.0)];
            let negative = b.ins().band(x, sign);
            let unit = b.ins().bor(negative, one);
            let moves = b.ins().fcmp(FloatCC::OrderedNotEqual, x, zero);
            self.values[value.index()] = Some(b.ins().select(moves, unit, x));
            return;
        }
        // Minimum or maximum with a constant: comparison and select must read the same Cranelift value, otherwise
        // Cranelift does not find the single instruction.
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
        // The operand that x86-64 can take from memory: the last or, in a comparison for less, the first.
        let from_memory = match op {
            Op::Add(..) | Op::Mul(..) | Op::Sub(..) | Op::Div(..) | Op::Equal(..) => 1,
            Op::Less(..) | Op::LessEqual(..) => 0,
            Op::Fma(..) => 2,
            _ => operands.len(),
        };
        let commuted = match op {
            Op::Add(first, _) | Op::Mul(first, _) | Op::Equal(first, _) => {
                matches!(self.func.op(first), Op::Real(_))
            }
            _ => false,
        };
        op.each_operand(|operand| {
            let folded = commuted || n == from_memory;
            let substitute = self.substitutes.get(&(value, n)).copied();
            let known = || if folded { self.folded(operand, b) } else { self.get(operand, b) };
            operands[n] = Some(substitute.unwrap_or_else(known));
            n += 1;
        });
        if commuted {
            operands.swap(0, 1);
        }
        let x = |i: usize| operands[i].expect("an operand");
        let result = match op {
            Op::Real(_) | Op::Int(_) | Op::Bool(_) => return,
            Op::Pool { .. } | Op::Ring { .. } => unreachable!("done above"),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Load(slot) => match self.distributed_offset(slot).zip(self.iteration_base) {
                Some((distance, iteration_base)) => b.ins().load(types::F64, flags, iteration_base, offset(distance)),
                None => b.ins().load(types::F64, flags, self.block, offset(slot.0)),
            },
            Op::Add(..) => b.ins().fadd(x(0), x(1)),
            Op::Sub(..) => b.ins().fsub(x(0), x(1)),
            Op::Mul(..) => b.ins().fmul(x(0), x(1)),
            Op::Div(..) => b.ins().fdiv(x(0), x(1)),
            // A fused multiply-add absorbs the negation.
            Op::Neg(_) if self.rip_relative && !self.facts.fused[value.index()] => {
                let sign = rip_relative_real(SIGN, b);
                b.ins().bxor(x(0), sign)
            }
            Op::Neg(_) => b.ins().fneg(x(0)),
            Op::Abs(_) if self.rip_relative => {
                let size = rip_relative_real(!SIGN, b);
                b.ins().band(x(0), size)
            }
            Op::Abs(_) => b.ins().fabs(x(0)),
            Op::Sqrt(_) => b.ins().sqrt(x(0)),
            Op::Fma(..) => b.ins().fma(x(0), x(1), x(2)),
            Op::Floor(_) => b.ins().floor(x(0)),
            Op::Nearest(_) => b.ins().nearest(x(0)),
            Op::Less(..) => b.ins().fcmp(FloatCC::LessThan, x(0), x(1)),
            // x − x is +0 or NaN: comparing its bits as an integer is enough.
            Op::LessEqual(d, e) if d == e && matches!(self.func.op(d), Op::Sub(x, y) if x == y) => {
                let bits = b.ins().bitcast(types::I64, MemFlagsData::new(), x(0));
                b.ins().icmp_imm_s(IntCC::Equal, bits, 0)
            }
            Op::LessEqual(..) => b.ins().fcmp(FloatCC::LessThanOrEqual, x(0), x(1)),
            Op::Equal(..) => b.ins().fcmp(FloatCC::Equal, x(0), x(1)),
            Op::And(..) | Op::IntAnd(..) => b.ins().band(x(0), x(1)),
            Op::Or(..) | Op::IntOr(..) => b.ins().bor(x(0), x(1)),
            Op::Not(_) => b.ins().bxor_imm_u(x(0), 1),
            // After a comparison of the same two reals Cranelift makes this one minimum or maximum instruction.
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

    /// Address and offset of an entry of a table in the pool, or of a ring in the block. `base_address`: that of pool or
    /// block. The index is clamped unless it is known to be in range.
    fn entry(
        &self,
        base_address: clif::Value,
        base: u32,
        len: u32,
        index: Value,
        b: &mut FunctionBuilder,
    ) -> (clif::Value, i32) {
        let here = b.current_block().expect("a block is being written");
        let known = self.clamped.borrow().get(&(index, len)).copied();
        let known = known.filter(|(block, _)| *block == here || self.dominators.contains(block));
        let clamped_index = known.map(|(_, clamped_index)| clamped_index).unwrap_or_else(|| {
            let clamped_index = self.get(index, b);
            if self.facts.upper_bound[index.index()].is_some_and(|most| most < i64::from(len)) {
                return clamped_index;
            }
            let last = b.ins().iconst(types::I64, i64::from(len) - 1);
            let clamped_index = b.ins().umin(clamped_index, last);
            self.clamped.borrow_mut().insert((index, len), (here, clamped_index));
            clamped_index
        });
        let bytes = b.ins().ishl_imm_u(clamped_index, 3);
        (b.ins().iadd(base_address, bytes), offset(base))
    }
}
