//! The control-flow graph of a function: the form between the straight line and machine code.
//!
//! In: a straight-line [`Func`]. Out: a [`Cfg`]: the same operations, placed in blocks. Each value keeps the operation
//! that defines it; the blocks only say where it is computed, and where an equal value stands for it: as a parameter of a
//! block, or read back from memory. So a value may be computed in several blocks of which none dominates another, and any
//! block may be checked against the straight line. The passes of `codegen` go from one `Cfg` to the next.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, ch. 8.4 and 9.6; block parameters instead of φ-functions as in
//! Cranelift and MLIR.

use super::{Func, Op, Type, Value, Write, build, live, reads, verify};
use crate::ir::hash::HashMap;
use crate::ir::value_map::{Bits, ValueMap, ValueSet};
use abi::{Layout, Slot};

/// The block with this number; prints as `b3`.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct BlockId(pub u32);

impl BlockId {
    /// As an index of [`Cfg::blocks`].
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// How often a block runs.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Part {
    /// Once, before all iterations.
    Prologue,
    /// In each iteration.
    Body,
    /// Rarely. A branch to a cold block is a side exit.
    Cold,
}

/// A region of memory.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub enum Area {
    /// The block of the instance.
    Block,
    /// Scratch slots on the stack, through which the pieces of an outlined function pass values.
    Scratch,
    /// Values of the leading loop of a distributed step, by value and step.
    Leading,
    /// Rows of inputs, a row for each step; the stride counts rows, whose distance is an argument of the call.
    Inputs,
    /// Rows of outputs, alike.
    Outputs,
}

/// A number in memory.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Place {
    /// Its region.
    pub area: Area,
    /// Its number in the first repetition of the loop around it.
    pub index: u32,
    /// The distance to that of the next repetition, in numbers.
    pub stride: i64,
}

impl Place {
    /// A slot of the instance.
    pub fn slot(slot: Slot) -> Place {
        Place { area: Area::Block, index: slot.0, stride: 0 }
    }

    /// A scratch slot.
    pub fn scratch(index: u32) -> Place {
        Place { area: Area::Scratch, index, stride: 0 }
    }
}

/// An instruction of a block.
#[derive(Clone, PartialEq, Debug)]
pub enum Inst {
    /// Computes the operation of a value.
    Compute(Value),
    /// Reads a value back from a place that holds it.
    Reload(Value, Place),
    /// Stores a value.
    Store(Place, Value),
    /// Writes to a ring.
    Write(Write),
    /// Calls a piece, which has access to the same memory.
    Call(usize),
}

/// A block to go to, with a value for each of its parameters.
#[derive(Clone, PartialEq, Debug)]
pub struct Target {
    /// The block.
    pub block: BlockId,
    /// Values of its parameters.
    pub args: Vec<Value>,
}

impl From<BlockId> for Target {
    fn from(block: BlockId) -> Target {
        Target { block, args: Vec::new() }
    }
}

/// Number of iterations of a loop.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Count {
    /// As many as the call asks for.
    Call,
    /// A constant.
    Fixed(u64),
}

/// The end of a block.
#[derive(Clone, PartialEq, Debug)]
pub enum Terminator {
    /// Goes to a block.
    Jump(Target),
    /// Goes to `yes` if a Boolean is true or an integer is not 0, else to `no`.
    Branch {
        /// The condition.
        when: Value,
        /// Where to go if it holds.
        yes: Target,
        /// Where to go if not.
        no: Target,
    },
    /// Goes to the block for the number in a slot, compared by its bits.
    Switch {
        /// The slot.
        slot: Slot,
        /// Bits of numbers, and their blocks.
        cases: Vec<(u64, BlockId)>,
        /// The block for any other number.
        default: BlockId,
    },
    /// Goes to `again`, the head of the loop, if iterations remain, else to `done`.
    Repeat {
        /// Number of iterations.
        count: Count,
        /// The head of the loop.
        again: Target,
        /// The exit.
        done: Target,
    },
    /// Ends the function with a status; none: 0.
    Return(Option<Value>),
}

/// A basic block.
#[derive(Clone, PartialEq, Debug)]
pub struct Block {
    /// How often it runs.
    pub part: Part,
    /// Values that each predecessor passes.
    pub params: Vec<Value>,
    /// The instructions.
    pub insts: Vec<Inst>,
    /// The end.
    pub end: Terminator,
}

/// How the code of a function is called.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Entry {
    /// For one iteration only.
    Single,
    /// For one iteration; for any other number it calls the code for several, which follows it.
    SingleOrSeveral,
    /// For any number of iterations; 0 changes nothing.
    Several,
    /// By the function of which it is a piece.
    Piece,
}

/// The leading loop of a distributed step: it computes what depends on time and rows of inputs alone, for several instants at
/// once, and is vectorised, so it keeps the straight-line form that lanes read.
#[derive(Clone, PartialEq, Debug)]
pub struct Leading {
    /// On blocks of `layout`: parameters → states. None if there are no invariants.
    pub invariants: Option<Func>,
    /// On blocks of `layout`: time, count, parameters, inputs, states → outputs.
    pub instants: Func,
    /// The layout of the two.
    pub layout: Layout,
    /// For each parameter of `layout`, the slot of the model that it copies.
    pub loads: Vec<Slot>,
    /// For each input of `layout`, its column in the rows.
    pub columns: Vec<usize>,
    /// Slots of the model's block: the step loads the outputs from the slots after it.
    pub size: usize,
}

/// The columns of the rows that a loop reads and writes: see [`abi::follow`].
#[derive(Clone, PartialEq, Debug)]
pub struct Rows {
    /// Slots of inputs that are read from a row.
    pub inputs: Vec<Slot>,
    /// Slots that are also written to a row.
    pub outputs: Vec<Slot>,
}

/// A function in blocks.
#[derive(Clone, PartialEq, Debug)]
pub struct Cfg {
    /// The name in listings.
    pub name: String,
    /// How it is called.
    pub called: Entry,
    /// The operations of all values; operands precede their users.
    pub ops: Vec<Op>,
    /// The blocks; the first is the entry.
    pub blocks: Vec<Block>,
    /// An entry of its own: it computes values that later calls read from slots after the block, and returns.
    pub prepare: Option<BlockId>,
    /// The entries of the pieces that it calls.
    pub pieces: Vec<BlockId>,
    /// Number of scratch slots.
    pub scratch_len: u32,
    /// The leading loop.
    pub leading: Option<Box<Leading>>,
    /// The rows of a loop that follows an array.
    pub rows: Option<Rows>,
}

impl Cfg {
    /// A function without blocks.
    pub fn new(name: &str, called: Entry) -> Cfg {
        Cfg {
            name: name.into(),
            called,
            ops: Vec::new(),
            blocks: Vec::new(),
            prepare: None,
            pieces: Vec::new(),
            scratch_len: 0,
            leading: None,
            rows: None,
        }
    }

    /// A function of one block.
    pub fn straight(func: &Func, called: Entry) -> Cfg {
        let mut cfg = Cfg::new(&func.name, called);
        cfg.import(func, Part::Body);
        cfg
    }

    /// Appends a straight line as a block that returns its status; its operations follow those that are there.
    pub fn import(&mut self, func: &Func, part: Part) -> BlockId {
        let to = self.append(&func.ops);
        let computed = (0..func.ops.len() as u32).map(|i| to(Value(i)));
        let mut insts: Vec<Inst> = computed.filter(|value| !self.is_free(*value)).map(Inst::Compute).collect();
        insts.extend(func.stores.iter().map(|(slot, value)| Inst::Store(Place::slot(*slot), to(*value))));
        insts.extend(func.writes.iter().map(|write| Inst::Write(write.map(to))));
        self.block(Block { part, params: Vec::new(), insts, end: Terminator::Return(func.status.map(to)) })
    }

    /// Appends operations; returns the map from their values to those here.
    pub fn append(&mut self, ops: &[Op]) -> impl Fn(Value) -> Value + Copy + use<> {
        let offset = self.ops.len() as u32;
        let to = move |value: Value| Value(value.0 + offset);
        self.ops.extend(ops.iter().map(|op| op.map(to)));
        to
    }

    /// Appends a block.
    pub fn block(&mut self, block: Block) -> BlockId {
        self.blocks.push(block);
        BlockId(self.blocks.len() as u32 - 1)
    }

    /// Appends an empty block that returns 0 until it gets another end.
    pub fn empty(&mut self, part: Part) -> BlockId {
        self.block(Block { part, params: Vec::new(), insts: Vec::new(), end: Terminator::Return(None) })
    }

    /// The straight line of a block, if it is one: it computes, stores, writes and returns, and reads nothing from other
    /// blocks.
    pub fn straight_line(&self, block: BlockId) -> Option<Func> {
        let block = &self.blocks[block.index()];
        let Terminator::Return(status) = block.end else { return None };
        let mut func = Func { name: self.name.clone(), status, ..Func::default() };
        let mut computed = ValueSet::new(self.ops.len());
        for inst in &block.insts {
            match inst {
                Inst::Compute(value) => _ = computed.insert(*value, ()),
                Inst::Store(Place { area: Area::Block, index, stride: 0 }, value) => {
                    func.stores.push((Slot(*index), *value));
                }
                Inst::Write(write) => func.writes.push(*write),
                Inst::Store(..) | Inst::Reload(..) | Inst::Call(_) => return None,
            }
        }
        let live = live(&self.ops, func.results());
        let complete =
            |(i, live): (usize, &bool)| !live || computed.contains(Value(i as u32)) || self.is_free(Value(i as u32));
        let whole = block.params.is_empty() && live.iter().enumerate().all(complete);
        whole.then(|| build::prune_to(&func, &self.ops, &live))
    }

    /// The operation that defines a value.
    pub fn op(&self, value: Value) -> Op {
        self.ops[value.index()]
    }

    /// Whether a value is available everywhere, because each use rematerialises it: a constant, or a constant entry of a
    /// table.
    pub fn is_free(&self, value: Value) -> bool {
        match self.op(value) {
            Op::Pool { index, .. } => matches!(self.op(index), Op::Int(_)),
            op => op.is_constant(),
        }
    }

    /// The values that an instruction reads, except those that are available everywhere.
    pub fn uses(&self, inst: &Inst) -> impl Iterator<Item = Value> + use<'_> {
        let (operation, given) = match inst {
            Inst::Compute(value) => (Some(self.op(*value)), [None; 2]),
            Inst::Store(_, value) => (None, [Some(*value), None]),
            Inst::Write(write) => (None, [Some(write.index), Some(write.value)]),
            Inst::Reload(..) | Inst::Call(_) => (None, [None; 2]),
        };
        let operands = operation.into_iter().flat_map(|op| reads(&self.ops, op));
        operands.chain(given.into_iter().flatten()).filter(|value| !self.is_free(*value))
    }

    /// The values that the end of a block reads, except those that are available everywhere.
    pub fn end_uses(&self, end: &Terminator) -> Vec<Value> {
        let mut uses: Vec<Value> = Vec::new();
        end.each_value(&mut |value| uses.push(value));
        uses.retain(|value| !self.is_free(*value));
        uses
    }

    /// The entries of all its functions, and how each is called.
    pub fn entries(&self) -> impl Iterator<Item = (BlockId, Entry)> {
        let prepare = self.prepare.map(|block| (block, Entry::Several));
        let pieces = self.pieces.iter().map(|block| (*block, Entry::Piece));
        [(BlockId(0), self.called)].into_iter().chain(prepare).chain(pieces)
    }

    /// The head of the loop among some blocks: the one that a repetition goes to.
    pub fn head(&self, blocks: &[BlockId]) -> Option<BlockId> {
        blocks.iter().find_map(|block| match &self.blocks[block.index()].end {
            Terminator::Repeat { again, .. } => Some(again.block),
            _ => None,
        })
    }

    /// The preheader of a loop among some blocks: the one that goes nowhere but to its head.
    pub fn preheader(&self, head: BlockId, blocks: &[BlockId]) -> Option<BlockId> {
        let enters = |block: &&BlockId| match &self.blocks[block.index()].end {
            Terminator::Jump(target) => target.block == head,
            _ => false,
        };
        blocks.iter().find(enters).copied()
    }

    /// Appends a value that is only read back from memory and that no operation of the function computes.
    pub fn in_memory(&mut self) -> Value {
        self.ops.push(Op::Load(Slot(u32::MAX)));
        Value(self.ops.len() as u32 - 1)
    }

    /// Drops unreachable blocks, and operations that nothing needs.
    pub fn compact(&mut self) {
        let mut blocks: Vec<BlockId> = self.entries().flat_map(|(entry, _)| self.order(entry)).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let mut numbers = vec![BlockId(u32::MAX); self.blocks.len()];
        blocks.iter().enumerate().for_each(|(k, old)| numbers[old.index()] = BlockId(k as u32));
        let number = |old: BlockId| numbers[old.index()];
        let mut live = vec![false; self.ops.len()];
        for block in &blocks {
            let block = &self.blocks[block.index()];
            for inst in &block.insts {
                inst.each_value(&mut |value| live[value.index()] = true);
            }
            block.params.iter().for_each(|value| live[value.index()] = true);
            block.end.each_value(&mut |value| live[value.index()] = true);
        }
        for i in (0..live.len()).rev() {
            if live[i] {
                self.ops[i].each_operand(|operand| live[operand.index()] = true);
            }
        }
        let mut moved = vec![Value(u32::MAX); self.ops.len()];
        let mut ops = Vec::new();
        for (i, op) in self.ops.iter().enumerate().filter(|(i, _)| live[*i]) {
            moved[i] = Value(ops.len() as u32);
            ops.push(op.map(|operand| moved[operand.index()]));
        }
        let to = |value: Value| moved[value.index()];
        let of_block = |block: &BlockId| self.blocks[block.index()].map(&to, &number);
        self.blocks = blocks.iter().map(of_block).collect();
        self.prepare = self.prepare.map(number);
        self.pieces.iter_mut().for_each(|piece| *piece = number(*piece));
        self.ops = ops;
    }

    /// The blocks that an entry reaches, in reverse postorder.
    pub fn order(&self, entry: BlockId) -> Vec<BlockId> {
        let mut seen = vec![false; self.blocks.len()];
        let mut order = Vec::new();
        let mut open = vec![(entry, false)];
        while let Some((block, ready)) = open.pop() {
            if ready {
                order.push(block);
            } else if !std::mem::replace(&mut seen[block.index()], true) {
                open.push((block, true));
                self.blocks[block.index()].end.each_target(&mut |target, _| open.push((target, false)));
            }
        }
        order.reverse();
        order
    }

    /// The immediate dominator of each block that an entry reaches. Cooper, Harvey, Kennedy, *A Simple, Fast Dominance
    /// Algorithm*, 2001.
    pub fn dominators(&self, entry: BlockId) -> Vec<Option<BlockId>> {
        let order = self.order(entry);
        let mut number = vec![usize::MAX; self.blocks.len()];
        order.iter().enumerate().for_each(|(k, block)| number[block.index()] = k);
        let mut above: Vec<Option<usize>> = vec![None; order.len()];
        above[0] = Some(0);
        let mut changed = true;
        while std::mem::take(&mut changed) {
            for (k, block) in order.iter().enumerate() {
                let Some(_) = above[k] else { continue };
                self.blocks[block.index()].end.each_target(&mut |target, _| {
                    let to = number[target.index()];
                    let (mut a, mut b) = (k, above[to].unwrap_or(k));
                    while a != b {
                        let up = |k: usize| above[k].expect("it has been reached");
                        if a > b { a = up(a) } else { b = up(b) }
                    }
                    if to != 0 && above[to] != Some(a) {
                        above[to] = Some(a);
                        changed = true;
                    }
                });
            }
        }
        let mut dominators = vec![None; self.blocks.len()];
        for (k, block) in order.iter().enumerate().skip(1) {
            dominators[block.index()] = above[k].map(|above| order[above]);
        }
        dominators
    }

    /// For each block the values that it hands to blocks after it, arguments not included, ascending: backward liveness
    /// of the values that some block reads and does not compute before. Most values are read only in the block that
    /// computes them. Briggs, Cooper, Harvey, Simpson, *Practical Improvements to the Construction and Destruction of
    /// Static Single Assignment Form*, 1998, call the others global names.
    pub fn live_out(&self) -> Vec<Vec<Value>> {
        let order: Vec<BlockId> = self.entries().flat_map(|(entry, _)| self.order(entry)).collect();
        if order.len() < 2 {
            return vec![Vec::new(); self.blocks.len()];
        }
        // What a block reads from others, what it computes itself.
        let mut read: Vec<Vec<Value>> = vec![Vec::new(); self.blocks.len()];
        let mut own = ValueSet::new(self.ops.len());
        for id in &order {
            let block = &self.blocks[id.index()];
            own.clear();
            own.add(block.params.iter().copied());
            let read = &mut read[id.index()];
            for inst in &block.insts {
                read.extend(self.uses(inst).filter(|value| !own.contains(*value)));
                own.add(inst.defines());
            }
            read.extend(self.end_uses(&block.end).into_iter().filter(|value| !own.contains(*value)));
        }
        let mut global: Vec<Value> = read.iter().flatten().copied().collect();
        global.sort_unstable();
        global.dedup();
        let mut number = ValueMap::new(self.ops.len());
        global.iter().enumerate().for_each(|(k, value)| _ = number.insert(*value, k));
        let bits = |values: &mut dyn Iterator<Item = Value>| {
            let mut bits = Bits::new(global.len());
            values.filter_map(|value| number.get(value)).for_each(|k| bits.insert(k));
            bits
        };
        let own =
            |block: &Block| bits(&mut block.params.iter().copied().chain(block.insts.iter().filter_map(Inst::defines)));
        let own: Vec<Bits> = self.blocks.iter().map(own).collect();
        // Both sets of a block only grow, from what it reads itself.
        let mut live_in: Vec<Bits> = read.into_iter().map(|values| bits(&mut values.into_iter())).collect();
        let mut live_out = vec![Bits::new(global.len()); self.blocks.len()];
        let mut changed = !global.is_empty();
        while std::mem::take(&mut changed) {
            for id in order.iter().rev().map(|id| id.index()) {
                self.blocks[id].end.each_target(&mut |target, _| _ = live_out[id].unite(&live_in[target.index()]));
                let mut through = live_out[id].clone();
                through.subtract(&own[id]);
                changed |= live_in[id].unite(&through);
            }
        }
        let values = |bits: Bits| {
            global.iter().enumerate().filter(|(k, _)| bits.contains(*k)).map(|(_, value)| *value).collect()
        };
        live_out.into_iter().map(values).collect()
    }

    /// Number of operations that its blocks compute.
    pub fn len(&self) -> usize {
        let computes = |block: &Block| block.insts.iter().filter(|inst| matches!(inst, Inst::Compute(_))).count();
        self.blocks.iter().map(computes).sum()
    }

    /// Whether it computes nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The type of each value.
    ///
    /// # Panics
    /// If an operation has operands of the wrong type: a mistake of a pass.
    pub fn types(&self) -> Vec<Type> {
        verify::types_of(&self.ops).unwrap_or_else(|fault| panic!("{}: {fault}", self.name))
    }
}

/// Instructions without effects, followed by one with an effect.
#[derive(Default)]
pub struct Run {
    /// The values that are computed or read back, in order; each once.
    pub list: Vec<Value>,
    /// The places of those that are read back.
    pub places: HashMap<Value, Place>,
    /// The instruction after them; none at the end of the block.
    pub effect: Option<Inst>,
}

impl Run {
    /// Divides the instructions of a block.
    pub fn all(insts: Vec<Inst>) -> Vec<Run> {
        let mut runs = vec![Run::default()];
        for inst in insts {
            let run = runs.last_mut().expect("there is one");
            match inst {
                Inst::Compute(value) => run.list.push(value),
                Inst::Reload(value, place) => {
                    if run.places.insert(value, place).is_none() {
                        run.list.push(value);
                    }
                }
                Inst::Store(..) | Inst::Write(_) | Inst::Call(_) => {
                    run.effect = Some(inst);
                    runs.push(Run::default());
                }
            }
        }
        runs
    }

    /// The instruction that makes a value of the list available.
    pub fn inst(&self, value: Value) -> Inst {
        match self.places.get(&value) {
            Some(place) => Inst::Reload(value, *place),
            None => Inst::Compute(value),
        }
    }

    /// The operation of a value of the list; a load if it is read back.
    pub fn op(&self, ops: &[Op], value: Value) -> Op {
        match self.places.get(&value) {
            Some(place) => Op::Load(Slot(place.index)),
            None => ops[value.index()],
        }
    }
}

impl Inst {
    /// The value that is available after the instruction.
    pub fn defines(&self) -> Option<Value> {
        match self {
            Inst::Compute(value) | Inst::Reload(value, _) => Some(*value),
            Inst::Store(..) | Inst::Write(_) | Inst::Call(_) => None,
        }
    }

    /// Calls `f` with each value that the instruction names.
    pub fn each_value(&self, f: &mut dyn FnMut(Value)) {
        match self {
            Inst::Compute(value) | Inst::Reload(value, _) | Inst::Store(_, value) => f(*value),
            Inst::Write(write) => [write.index, write.value].into_iter().for_each(f),
            Inst::Call(_) => {}
        }
    }

    fn map(&self, to: &impl Fn(Value) -> Value) -> Inst {
        match self {
            Inst::Compute(value) => Inst::Compute(to(*value)),
            Inst::Reload(value, place) => Inst::Reload(to(*value), *place),
            Inst::Store(place, value) => Inst::Store(*place, to(*value)),
            Inst::Write(write) => Inst::Write(write.map(to)),
            Inst::Call(piece) => Inst::Call(*piece),
        }
    }
}

impl Block {
    fn map(&self, to: &impl Fn(Value) -> Value, number: &impl Fn(BlockId) -> BlockId) -> Block {
        let all = |values: &[Value]| values.iter().copied().map(to).collect::<Vec<_>>();
        let target = |target: &Target| Target { block: number(target.block), args: all(&target.args) };
        let end = match &self.end {
            Terminator::Jump(next) => Terminator::Jump(target(next)),
            Terminator::Branch { when, yes, no } => {
                Terminator::Branch { when: to(*when), yes: target(yes), no: target(no) }
            }
            Terminator::Switch { slot, cases, default } => Terminator::Switch {
                slot: *slot,
                cases: cases.iter().map(|(bits, block)| (*bits, number(*block))).collect(),
                default: number(*default),
            },
            Terminator::Repeat { count, again, done } => {
                Terminator::Repeat { count: *count, again: target(again), done: target(done) }
            }
            Terminator::Return(status) => Terminator::Return(status.map(to)),
        };
        let insts = self.insts.iter().map(|inst| inst.map(to)).collect();
        Block { part: self.part, params: all(&self.params), insts, end }
    }
}

impl Terminator {
    /// Calls `f` with each value that the end names.
    pub fn each_value(&self, f: &mut dyn FnMut(Value)) {
        match self {
            Terminator::Branch { when, .. } => f(*when),
            Terminator::Return(status) => status.iter().for_each(|status| f(*status)),
            Terminator::Jump(_) | Terminator::Switch { .. } | Terminator::Repeat { .. } => {}
        }
        self.each_target(&mut |_, args| args.iter().for_each(|arg| f(*arg)));
    }

    /// Calls `f` with each target and its arguments. The last one is the one to fall through to.
    pub fn each_target(&self, f: &mut dyn FnMut(BlockId, &[Value])) {
        match self {
            Terminator::Jump(target) => f(target.block, &target.args),
            Terminator::Branch { yes, no, .. } => [yes, no].iter().for_each(|target| f(target.block, &target.args)),
            Terminator::Switch { cases, default, .. } => {
                cases.iter().for_each(|(_, block)| f(*block, &[]));
                f(*default, &[]);
            }
            Terminator::Repeat { again, done, .. } => {
                [again, done].iter().for_each(|target| f(target.block, &target.args));
            }
            Terminator::Return(_) => {}
        }
    }
}
