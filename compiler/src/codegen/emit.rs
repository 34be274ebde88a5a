//! Emits the functions of a control-flow graph as Cranelift IR.
//!
//! In: a [`Cfg`], as the passes leave it. Out: Cranelift IR, block by block, with the signature of
//! [`abi::table::Entry`]. It knows nothing of modes, loops over steps or pieces beyond what the graph says, and of the
//! target only whether constants are best read relative to the instruction pointer. Each operation becomes one
//! instruction or a fixed few. The code contains no symbols, no traps, and no calls except those of its own pieces.
//!
//! What the graph leaves open: a loop counts down the number of iterations, with one induction pointer for each stride; a
//! branch on a compound condition of few tests becomes short-circuit branches; constants are rematerialised at each use.

use crate::ir::cfg::{Area, BlockId, Cfg, Count, Entry, Inst, Part, Place, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Op, Type, Value, sign_of};
use cranelift_codegen::ir::condcodes::{FloatCC, IntCC};
use cranelift_codegen::ir::{
    self as clif, AbiParam, BlockArg, ExtFuncData, InstBuilder, MemFlagsData, Signature, StackSlotData, StackSlotKind,
    UserExternalName, types,
};
use cranelift_codegen::isa::{CallConv, TargetIsa};
use cranelift_frontend::{FunctionBuilder, FunctionBuilderContext};

/// The calling convention of [`abi::table::Entry`]: on x86-64 that of the System V ABI, on Windows too.
fn calling_convention(isa: &dyn TargetIsa) -> CallConv {
    if isa.name() == "x64" { CallConv::SystemV } else { isa.default_call_conv() }
}

/// The signature of [`abi::table::Entry`].
pub fn signature(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(calling_convention(isa));
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature.returns.push(AbiParam::new(types::I64));
    signature
}

/// The signature of a piece: addresses of block, pool and scratch area.
fn signature_of_piece(isa: &dyn TargetIsa) -> Signature {
    let mut signature = Signature::new(calling_convention(isa));
    signature.params.extend([types::I64; 3].map(AbiParam::new));
    signature
}

/// Emits the functions of one graph.
pub struct Emitter<'a> {
    cfg: &'a Cfg,
    facts: Facts,
    isa: &'a dyn TargetIsa,
    /// Number of steps for which the leading loop has computed values.
    leading_len: u32,
    /// The values available in the current block, constants excepted.
    values: Vec<Option<clif::Value>>,
    /// The earlier entries of `values`, to restore at the end of a subtree of the dominator tree.
    undo: Vec<(Value, Option<clif::Value>)>,
    /// Clamped indices of tables and rings that are available: an index, a length, and the clamped index.
    clamped: Vec<(clif::Value, u32, clif::Value)>,
    /// The function that is being emitted.
    now: Function,
}

/// The state of one function.
#[derive(Default)]
struct Function {
    /// Addresses of block, pool and scratch area.
    block: Option<clif::Value>,
    pool: Option<clif::Value>,
    scratch: Option<clif::Value>,
    /// Address of the values of the leading loop for the first step.
    leading: Option<clif::Value>,
    /// The rows of a loop that follows an array: addresses and distances in bytes of inputs and of outputs.
    rows: Option<[(clif::Value, clif::Value); 2]>,
    /// Number of iterations that the call asks for.
    count: Option<clif::Value>,
    /// Whether it is a piece, which returns no status.
    is_piece: bool,
    /// Whether real constants are loaded relative to the instruction pointer.
    rip_relative: bool,
    /// Whether the function is a short single step. Successive calls of a short function overlap in the processor, so the
    /// number of instructions counts. In a longer one a limit by a constant becomes a conditional jump: where its
    /// prediction is right, the comparison is not on the critical path.
    short: bool,
    blocks: HashMap<BlockId, clif::Block>,
    /// The loop, if there is one.
    repeats: Option<Loop>,
    pieces: Vec<clif::FuncRef>,
}

/// A loop that is being emitted.
struct Loop {
    head: BlockId,
    count: Count,
    /// Iterations that remain, and the address of the number that each pointer has in this iteration.
    remaining: Option<clif::Value>,
    pointers: Vec<Pointer>,
}

/// An induction pointer: an address that advances by a constant stride in each repetition.
struct Pointer {
    area: Area,
    /// In doubles.
    stride: i64,
    now: Option<clif::Value>,
}

/// Maximum number of operations of a short function, see [`Function::short`].
const MAX_SHORT_OPS: usize = 80;

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
fn offset(index: u32) -> i32 {
    i32::try_from(index * 8).expect("blocks and pools are smaller than 2 GiB")
}

/// Results of the analyses of a graph, by value.
struct Facts {
    /// Types.
    types: Vec<Type>,
    /// For table entries: whether the real itself is used, or only its bits.
    as_real: Vec<bool>,
    /// Whether a fused multiply-add reads the value.
    fused: Vec<bool>,
    /// Upper bound, inclusive, of integers that are known not to be negative.
    upper_bound: Vec<Option<i64>>,
}

impl Facts {
    fn of(cfg: &Cfg) -> Facts {
        let mut as_real = vec![false; cfg.ops.len()];
        let mut fused = vec![false; cfg.ops.len()];
        for op in &cfg.ops {
            op.each_operand(|operand| {
                as_real[operand.index()] |= !matches!(op, Op::ToBits(_));
                fused[operand.index()] |= matches!(op, Op::Fma(..));
            });
        }
        for block in &cfg.blocks {
            for inst in block.insts.iter().filter(|inst| !matches!(inst, Inst::Compute(_))) {
                inst.each_value(&mut |value| as_real[value.index()] = true);
            }
            block.end.each_value(&mut |value| as_real[value.index()] = true);
        }
        Facts { types: cfg.types(), as_real, fused, upper_bound: upper_bound(&cfg.ops) }
    }

    /// The Cranelift type of a value.
    fn type_of(&self, value: Value) -> clif::Type {
        match self.types[value.index()] {
            Type::Real => types::F64,
            Type::Int => types::I64,
            Type::Bool => types::I8,
        }
    }
}

/// For each integer that is provably not negative, an inclusive upper bound, from the operations that compute it.
fn upper_bound(ops: &[Op]) -> Vec<Option<i64>> {
    let mut bounds: Vec<Option<i64>> = Vec::with_capacity(ops.len());
    for op in ops {
        let at = |value: Value| bounds[value.index()];
        let number = |value: Value| if let Op::Int(n) = ops[value.index()] { Some(n) } else { None };
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

impl<'a> Emitter<'a> {
    /// An emitter for the functions of a graph. `leading_len`: number of steps for which the leading loop has computed
    /// values, if there is one.
    pub fn new(cfg: &'a Cfg, isa: &'a dyn TargetIsa, leading_len: usize) -> Emitter<'a> {
        Emitter {
            cfg,
            facts: Facts::of(cfg),
            isa,
            leading_len: leading_len as u32,
            values: vec![None; cfg.ops.len()],
            undo: Vec::new(),
            clamped: Vec::new(),
            now: Function::default(),
        }
    }

    /// Emits the function that begins at an entry into the empty `target`.
    pub fn emit(
        &mut self,
        (entry, called): (BlockId, Entry),
        target: &mut clif::Function,
        context: &mut FunctionBuilderContext,
    ) {
        let is_piece = called == Entry::Piece;
        target.signature = if is_piece { signature_of_piece(self.isa) } else { signature(self.isa) };
        let more = 3 * usize::from(self.cfg.rows.is_some()) + usize::from(self.cfg.leading.is_some());
        target.signature.params.extend(vec![AbiParam::new(types::I64); more]);
        let mut b = FunctionBuilder::new(target, context);
        let order = self.cfg.order(entry);
        let first = b.create_block();
        b.append_block_params_for_function_params(first);
        b.switch_to_block(first);
        let &[block, pool, third, ref more @ ..] = b.block_params(first) else { unreachable!("three parameters") };
        let more = more.to_vec();
        let rows = if let [inputs, outputs, strides, ..] = more[..] {
            let mut stride = |at| b.ins().load(types::I64, MemFlagsData::trusted(), strides, at);
            Some([(inputs, stride(0)), (outputs, stride(8))])
        } else {
            None
        };
        let leading = more.last().copied().filter(|_| self.cfg.leading.is_some());
        self.now = Function {
            block: Some(block),
            pool: Some(pool),
            scratch: is_piece.then_some(third),
            leading,
            rows,
            count: (!is_piece).then_some(third),
            is_piece,
            // x86-64 would build a constant in a general register first.
            rip_relative: self.isa.name() == "x64" && self.cfg.pieces.is_empty(),
            short: matches!(called, Entry::Single | Entry::SingleOrSeveral) && self.is_short(&order),
            blocks: order.iter().map(|id| (*id, b.create_block())).collect(),
            repeats: self.repeats(&order),
            pieces: Vec::new(),
        };
        let start = self.now.blocks[&entry];
        match called {
            Entry::Single | Entry::Piece => _ = b.ins().jump(start, &[]),
            Entry::SingleOrSeveral => self.several(start, (block, pool, third), &mut b),
            Entry::Several => {
                let nothing = b.create_block();
                b.ins().brif(third, start, &[], nothing, &[]);
                b.switch_to_block(nothing);
                let zero = b.ins().iconst(types::I64, 0);
                b.ins().return_(&[zero]);
            }
        }
        if !is_piece && !self.cfg.pieces.is_empty() {
            self.declare_pieces(&mut b);
        }
        self.subtrees(entry, &order, &mut b);
        b.seal_all_blocks();
        b.finalize(self.isa.frontend_config());
    }

    /// The entry of a single iteration: if the count is not 1, the code for several, which follows it, is called.
    fn several(
        &self,
        single: clif::Block,
        (block, pool, count): (clif::Value, clif::Value, clif::Value),
        b: &mut FunctionBuilder,
    ) {
        let others = b.create_block();
        let other = b.ins().icmp_imm_s(IntCC::NotEqual, count, 1);
        b.ins().brif(other, others, &[], single, &[]);
        b.set_cold_block(others);
        b.switch_to_block(others);
        let name = UserExternalName { namespace: 0, index: 0 };
        let name = clif::ExternalName::user(b.func.declare_imported_user_function(name));
        let signature = b.import_signature(signature(self.isa));
        let many = b.import_function(ExtFuncData { name, signature, colocated: true, patchable: false });
        let call = b.ins().call(many, &[block, pool, count]);
        let status = b.inst_results(call)[0];
        b.ins().return_(&[status]);
    }

    /// Declares the pieces: external name `n` stands for piece `n`.
    fn declare_pieces(&mut self, b: &mut FunctionBuilder) {
        let signature = b.import_signature(signature_of_piece(self.isa));
        for number in 0..self.cfg.pieces.len() {
            let name = UserExternalName { namespace: 0, index: number as u32 };
            let name = clif::ExternalName::user(b.func.declare_imported_user_function(name));
            let piece = b.import_function(ExtFuncData { name, signature, colocated: true, patchable: false });
            self.now.pieces.push(piece);
        }
    }

    /// Whether the blocks have few operations, constants included.
    fn is_short(&self, order: &[BlockId]) -> bool {
        let mut named: HashSet<Value> = HashSet::default();
        for block in order.iter().map(|id| &self.cfg.blocks[id.index()]) {
            block.end.each_value(&mut |value| _ = named.insert(value));
            for inst in &block.insts {
                inst.each_value(&mut |value| {
                    named.insert(value);
                    self.cfg.op(value).each_operand(|operand| _ = named.insert(operand));
                });
            }
        }
        named.len() <= MAX_SHORT_OPS
    }

    /// The loop among some blocks, not yet begun.
    fn repeats(&self, order: &[BlockId]) -> Option<Loop> {
        let head = self.cfg.head(order)?;
        let blocks = || order.iter().map(|id| &self.cfg.blocks[id.index()]);
        let count = blocks().find_map(|block| match block.end {
            Terminator::Repeat { count, .. } => Some(count),
            _ => None,
        })?;
        let mut pointers: Vec<Pointer> = Vec::new();
        for inst in blocks().flat_map(|block| &block.insts) {
            if let Inst::Reload(_, Place { area, stride, .. }) | Inst::Store(Place { area, stride, .. }, _) = inst
                && *stride != 0
                && !pointers.iter().any(|known| (known.area, known.stride) == (*area, *stride))
            {
                pointers.push(Pointer { area: *area, stride: *stride, now: None });
            }
        }
        Some(Loop { head, count, remaining: None, pointers })
    }

    /// Emits all blocks, in preorder of the dominator tree: a value is available in the blocks that its own dominates.
    fn subtrees(&mut self, entry: BlockId, order: &[BlockId], b: &mut FunctionBuilder) {
        let mut children: HashMap<BlockId, Vec<BlockId>> = HashMap::default();
        for (above, id) in self.cfg.dominators(entry).into_iter().zip(0..) {
            if let Some(above) = above {
                children.entry(above).or_default().push(BlockId(id));
            }
        }
        let mut position = vec![0; self.cfg.blocks.len()];
        order.iter().enumerate().for_each(|(k, id)| position[id.index()] = k);
        enum Visit {
            Enter(BlockId),
            Leave(usize, usize),
        }
        let mut open = vec![Visit::Enter(entry)];
        while let Some(visit) = open.pop() {
            match visit {
                Visit::Enter(id) => {
                    open.push(Visit::Leave(self.undo.len(), self.clamped.len()));
                    self.block(id, id == entry, b);
                    let mut below = children.remove(&id).unwrap_or_default();
                    below.sort_unstable_by_key(|id| std::cmp::Reverse(position[id.index()]));
                    open.extend(below.into_iter().map(Visit::Enter));
                }
                Visit::Leave(undo, clamped) => {
                    while self.undo.len() > undo {
                        let (value, before) = self.undo.pop().expect("it is longer");
                        self.values[value.index()] = before;
                    }
                    self.clamped.truncate(clamped);
                }
            }
        }
    }

    /// Emits one block.
    fn block(&mut self, id: BlockId, is_entry: bool, b: &mut FunctionBuilder) {
        let block = &self.cfg.blocks[id.index()];
        let here = self.now.blocks[&id];
        b.switch_to_block(here);
        if block.part == Part::Cold && !is_entry {
            b.set_cold_block(here);
        }
        for param in &block.params {
            let known = b.append_block_param(here, self.facts.type_of(*param));
            self.set(*param, known);
        }
        if let Some(repeats) = self.now.repeats.as_mut().filter(|repeats| repeats.head == id) {
            repeats.remaining = Some(b.append_block_param(here, types::I64));
            for pointer in &mut repeats.pointers {
                pointer.now = Some(b.append_block_param(here, types::I64));
            }
        }
        if is_entry && !self.now.is_piece && self.cfg.scratch_len > 0 {
            let area = StackSlotData::new(StackSlotKind::ExplicitSlot, 8 * self.cfg.scratch_len, 3);
            let area = b.create_sized_stack_slot(area);
            self.now.scratch = Some(b.ins().stack_addr(types::I64, area, 0));
        }
        for inst in &block.insts {
            self.inst(inst, b);
        }
        self.end(&block.end, b);
    }

    fn inst(&mut self, inst: &Inst, b: &mut FunctionBuilder) {
        let flags = MemFlagsData::trusted();
        match inst {
            Inst::Compute(value) => self.operation(*value, b),
            Inst::Reload(value, place) => {
                let (base, offset) = self.address(*place);
                let known = b.ins().load(self.facts.type_of(*value), flags, base, offset);
                self.set(*value, known);
            }
            Inst::Store(place, value) => {
                let (base, offset) = self.address(*place);
                let value = self.get(*value, b);
                b.ins().store(flags, value, base, offset);
            }
            Inst::Write(write) => {
                let (address, offset) = self.entry(self.base(Area::Block), write.base.0, write.len, write.index, b);
                let value = self.get(write.value, b);
                b.ins().store(flags, value, address, offset);
            }
            Inst::Call(piece) => {
                let args = [self.now.block, self.now.pool, self.now.scratch.or(self.now.block)];
                b.ins().call(self.now.pieces[*piece], &args.map(|arg| arg.expect("a function has it")));
            }
        }
    }

    fn end(&mut self, end: &Terminator, b: &mut FunctionBuilder) {
        match end {
            Terminator::Jump(target) => {
                let (block, args) = self.target(target, b);
                b.ins().jump(block, &args);
            }
            Terminator::Branch { when, yes, no } => {
                let is_cold = |target: &Target| self.cfg.blocks[target.block.index()].part == Part::Cold;
                // In a loop the tests of a side exit are combined, because none of them is expected to hold.
                let combined = self.now.repeats.is_some() && (is_cold(yes) || is_cold(no));
                let (yes, no) = (self.target(yes, b), self.target(no, b));
                if yes.1.is_empty() && no.1.is_empty() && !combined {
                    self.branch(*when, yes.0, no.0, b);
                } else {
                    let when = self.get(*when, b);
                    b.ins().brif(when, yes.0, &yes.1, no.0, &no.1);
                }
            }
            Terminator::Switch { slot, cases, default } => {
                let (base, offset) = self.address(Place::slot(*slot));
                let held = b.ins().load(types::I64, MemFlagsData::trusted(), base, offset);
                for (k, (bits, case)) in cases.iter().enumerate() {
                    let is_last = k + 1 == cases.len();
                    let others = if is_last { self.now.blocks[default] } else { b.create_block() };
                    let number = b.ins().iconst(types::I64, *bits as i64);
                    // The second target of `brif` is the fall-through.
                    let is_not = b.ins().icmp(IntCC::NotEqual, held, number);
                    b.ins().brif(is_not, others, &[], self.now.blocks[case], &[]);
                    if !is_last {
                        b.switch_to_block(others);
                    }
                }
                if cases.is_empty() {
                    b.ins().jump(self.now.blocks[default], &[]);
                }
            }
            Terminator::Repeat { again, done, .. } => {
                let repeats = self.now.repeats.as_ref().expect("the function has a loop");
                let begun = "the loop has begun";
                let remaining = b.ins().iadd_imm_s(repeats.remaining.expect(begun), -1);
                let mut next = self.args(&again.args, b);
                next.push(BlockArg::Value(remaining));
                for pointer in &repeats.pointers {
                    let now = pointer.now.expect(begun);
                    next.push(BlockArg::Value(match self.rows(pointer.area) {
                        Some((_, stride)) => b.ins().iadd(now, stride),
                        None => b.ins().iadd_imm_s(now, 8 * pointer.stride),
                    }));
                }
                let head = self.now.blocks[&again.block];
                let (exit, args) = self.target(done, b);
                b.ins().brif(remaining, head, &next, exit, &args);
            }
            Terminator::Return(_) if self.now.is_piece => _ = b.ins().return_(&[]),
            Terminator::Return(status) => {
                let status = match status {
                    Some(status) => self.get(*status, b),
                    None => b.ins().iconst(types::I64, 0),
                };
                b.ins().return_(&[status]);
            }
        }
    }

    fn args(&self, args: &[Value], b: &mut FunctionBuilder) -> Vec<BlockArg> {
        args.iter().map(|arg| BlockArg::Value(self.get(*arg, b))).collect()
    }

    /// A target and its arguments; the head of the loop, where the loop begins, also takes count and pointers.
    fn target(&self, target: &Target, b: &mut FunctionBuilder) -> (clif::Block, Vec<BlockArg>) {
        let mut args = self.args(&target.args, b);
        if let Some(repeats) = self.now.repeats.as_ref().filter(|repeats| repeats.head == target.block) {
            let count = match repeats.count {
                Count::Call => self.now.count.expect("it is no piece"),
                Count::Fixed(count) => b.ins().iconst(types::I64, count as i64),
            };
            let bases = repeats.pointers.iter().map(|pointer| self.base(pointer.area));
            args.extend([count].into_iter().chain(bases).map(BlockArg::Value));
        }
        (self.now.blocks[&target.block], args)
    }

    /// The address of an area.
    fn base(&self, area: Area) -> clif::Value {
        match area {
            Area::Block => self.now.block,
            Area::Scratch => self.now.scratch,
            Area::Leading => self.now.leading,
            Area::Inputs | Area::Outputs => self.rows(area).map(|(address, _)| address),
        }
        .expect("the function has this area")
    }

    /// Address and distance in bytes of the rows of an area.
    fn rows(&self, area: Area) -> Option<(clif::Value, clif::Value)> {
        let [inputs, outputs] = self.now.rows?;
        match area {
            Area::Inputs => Some(inputs),
            Area::Outputs => Some(outputs),
            Area::Block | Area::Scratch | Area::Leading => None,
        }
    }

    fn base_of_pool(&self) -> clif::Value {
        self.now.pool.expect("every function has it")
    }

    /// Base address and offset of a place.
    fn address(&self, place: Place) -> (clif::Value, i32) {
        let repeats = self.now.repeats.as_ref().filter(|_| place.stride != 0);
        let pointer = repeats.and_then(|repeats| {
            let alike = |pointer: &&Pointer| (pointer.area, pointer.stride) == (place.area, place.stride);
            repeats.pointers.iter().find(alike)?.now
        });
        let index = if place.area == Area::Leading { place.index * self.leading_len } else { place.index };
        (pointer.unwrap_or_else(|| self.base(place.area)), offset(index))
    }

    /// Makes a value available in the current block and those that it dominates.
    fn set(&mut self, value: Value, known: clif::Value) {
        let before = self.values[value.index()].replace(known);
        self.undo.push((value, before));
    }

    /// The Cranelift value. Constants are rematerialised at each use: kept, they would fill the registers.
    fn get(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.cfg.op(value) {
            Op::Pool { base, len, index } if let Op::Int(index) = self.cfg.op(index) => {
                let entry = (index as u64).min(u64::from(len) - 1) as u32;
                b.ins().load(types::F64, MemFlagsData::trusted(), self.base_of_pool(), offset(base + entry))
            }
            Op::Real(bits) if self.now.rip_relative && bits != 0 => rip_relative_real(bits, b),
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            Op::Int(n) => b.ins().iconst(types::I64, n),
            Op::Bool(truth) => b.ins().iconst(types::I8, i64::from(truth)),
            _ => self.values[value.index()].unwrap_or_else(|| panic!("{value} is not available")),
        }
    }

    /// As `get`, for an operand that the instruction can take from memory: Cranelift folds an `f64const` into the
    /// instruction.
    fn folded(&self, value: Value, b: &mut FunctionBuilder) -> clif::Value {
        match self.cfg.op(value) {
            Op::Real(bits) => b.ins().f64const(f64::from_bits(bits)),
            _ => self.get(value, b),
        }
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
            |value: Value| matches!(self.cfg.op(value), Op::Bool(_)) || self.values[value.index()].is_some();
        match self.cfg.op(value) {
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
        if let Op::Not(_) = self.cfg.op(when) {
            return self.short_circuit(first, no, yes, b);
        }
        let next = b.create_block();
        match self.cfg.op(when) {
            Op::And(..) => self.short_circuit(first, next, no, b),
            _ => self.short_circuit(first, yes, next, b),
        }
        b.switch_to_block(next);
        self.short_circuit(second, yes, no, b);
    }

    /// Emits one operation, whose operands must be available.
    fn operation(&mut self, value: Value, b: &mut FunctionBuilder) {
        let flags = MemFlagsData::trusted();
        let op = self.cfg.op(value);
        let mut operands = [None; 3];
        let mut n = 0;
        // If only the bits of a table entry are used, `ToBits` loads them as an integer and the real is never loaded.
        if let Op::Pool { base, len, index } = op {
            let constant = matches!(self.cfg.op(index), Op::Int(_));
            if !constant && self.facts.as_real[value.index()] {
                let (address, offset) = self.entry(self.base_of_pool(), base, len, index, b);
                {
                    let known = b.ins().load(types::F64, flags, address, offset);
                    self.set(value, known);
                }
            }
            return;
        }
        if let Op::Ring { base, len, index } = op {
            let (address, offset) = self.entry(self.base(Area::Block), base.0, len, index, b);
            {
                let known = b.ins().load(types::F64, flags, address, offset);
                self.set(value, known);
            }
            return;
        }
        if let Op::ToBits(table) = op
            && let Op::Pool { base, len, index } = self.cfg.op(table)
        {
            let (address, offset) = self.entry(self.base_of_pool(), base, len, index, b);
            {
                let known = b.ins().load(types::I64, flags, address, offset);
                self.set(value, known);
            }
            return;
        }
        if self.now.rip_relative
            && let Some(x) = sign_of(op, |value| self.cfg.op(value))
        {
            // ±1 with the sign of x; x itself if it is ±0 or NaN.
            let x = self.get(x, b);
            let [sign, one, zero] =
                [rip_relative_real(SIGN, b), rip_relative_real(1f64.to_bits(), b), b.ins().f64const(0.0)];
            let negative = b.ins().band(x, sign);
            let unit = b.ins().bor(negative, one);
            let moves = b.ins().fcmp(FloatCC::OrderedNotEqual, x, zero);
            {
                let known = b.ins().select(moves, unit, x);
                self.set(value, known);
            }
            return;
        }
        // Minimum or maximum with a constant: comparison and select must read the same Cranelift value, otherwise
        // Cranelift does not find the single instruction.
        if let Op::Select(when, yes, no) = op
            && self.now.short
            && let Op::Less(first, second) = self.cfg.op(when)
            && [(first, second), (second, first)].contains(&(yes, no))
        {
            let chosen = [self.get(yes, b), self.folded(no, b)];
            let [first, second] = if first == yes { chosen } else { [chosen[1], chosen[0]] };
            let less = b.ins().fcmp(FloatCC::LessThan, first, second);
            {
                let known = b.ins().select(less, chosen[0], chosen[1]);
                self.set(value, known);
            }
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
                matches!(self.cfg.op(first), Op::Real(_))
            }
            _ => false,
        };
        op.each_operand(|operand| {
            let folded = commuted || n == from_memory;
            operands[n] = Some(if folded { self.folded(operand, b) } else { self.get(operand, b) });
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
            Op::Load(slot) => b.ins().load(types::F64, flags, self.base(Area::Block), offset(slot.0)),
            Op::Add(..) => b.ins().fadd(x(0), x(1)),
            Op::Sub(..) => b.ins().fsub(x(0), x(1)),
            Op::Mul(..) => b.ins().fmul(x(0), x(1)),
            Op::Div(..) => b.ins().fdiv(x(0), x(1)),
            // A fused multiply-add absorbs the negation.
            Op::Neg(_) if self.now.rip_relative && !self.facts.fused[value.index()] => {
                let sign = rip_relative_real(SIGN, b);
                b.ins().bxor(x(0), sign)
            }
            Op::Neg(_) => b.ins().fneg(x(0)),
            Op::Abs(_) if self.now.rip_relative => {
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
            Op::LessEqual(d, e) if d == e && matches!(self.cfg.op(d), Op::Sub(x, y) if x == y) => {
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
        {
            let known = result;
            self.set(value, known);
        }
    }

    /// Address and offset of an entry of a table in the pool, or of a ring in the block. `base_address`: that of pool or
    /// block. The index is clamped unless it is known to be in range.
    fn entry(
        &mut self,
        base_address: clif::Value,
        base: u32,
        len: u32,
        index: Value,
        b: &mut FunctionBuilder,
    ) -> (clif::Value, i32) {
        let unclamped = self.get(index, b);
        let in_range = self.facts.upper_bound[index.index()].is_some_and(|most| most < i64::from(len));
        let known = self.clamped.iter().rev().find(|(of, to, _)| (*of, *to) == (unclamped, len));
        let index = match known {
            _ if in_range => unclamped,
            Some((_, _, clamped)) => *clamped,
            None => {
                let last = b.ins().iconst(types::I64, i64::from(len) - 1);
                let clamped = b.ins().umin(unclamped, last);
                self.clamped.push((unclamped, len, clamped));
                clamped
            }
        };
        let bytes = b.ins().ishl_imm_u(index, 3);
        (b.ins().iadd(base_address, bytes), offset(base))
    }
}
