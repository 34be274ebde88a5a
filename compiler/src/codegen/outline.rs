//! Outlining: divides a long function into pieces, because the time of register allocation grows faster than the length
//! of a function.
//!
//! In: a function in one block. Out: a loop that calls pieces. Pieces pass values through scratch slots, and each slot of
//! the block is stored by the first piece after which nothing reads it. Operations that can be
//! [rerolled](crate::codegen::reroll) form a piece of their own, a loop. It knows nothing of processors.
//!
//! ```text
//! invariant   loop invariants; once per call
//! iteration   all other operations; each slot is stored as soon as nothing reads it any more
//! failure     operations that only the status needs; when its test reports a failed guard
//! ```
//! The order of operations keeps the values that cross a cut few: the operations that one result needs are adjacent, and
//! each cut is placed, within the allowed lengths, where the fewest values cross.
//!
//! Compare Zhao, Amaral, *Function Outlining and Partial Inlining*, SBAC-PAD 2005.

use crate::codegen::form_loop::is_idempotent;
use crate::codegen::reroll::{Repeats, Row, Source, arithmetic_progression, repeats};
use crate::codegen::side_exit::{cold, tested};
use crate::ir::cfg::{Area, Block, BlockId, Cfg, Count, Entry, Inst, Part, Place, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::variance::{Variance, variance};
use crate::ir::{Func, Op, Value, Write};
use abi::Slot;
use std::collections::BTreeMap;
use std::ops::Range;

/// Limits for outlining; lengths in operations.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Lengths {
    /// Longer functions are outlined.
    pub max_function: usize,
    /// Minimum length of a piece, the last excepted.
    pub min_piece: usize,
    /// Maximum length of a piece.
    pub max_piece: usize,
    /// Maximum size of the scratch area, in doubles.
    pub max_scratch: u32,
    /// Minimum number of repetitions that become a loop.
    pub min_repetitions: usize,
}

impl Lengths {
    /// Pieces of a length for which register allocation is fast, and a scratch area of at most 256 KiB, part of the
    /// stack that a real-time thread touches before it starts.
    pub const USUAL: Lengths =
        Lengths { max_function: 2000, min_piece: 600, max_piece: 1200, max_scratch: 32_768, min_repetitions: 8 };
}

impl Default for Lengths {
    fn default() -> Lengths {
        Lengths::USUAL
    }
}

/// Outlines a function; unchanged if the values that cross the cuts do not fit into the scratch area.
pub fn outline(cfg: &mut Cfg, lengths: Lengths) {
    let Some(func) = cfg.straight_line(BlockId(0)) else { return };
    let variance = variance(&func, None);
    // Loop invariants occupy their scratch slots through the whole call. If there are too many, each iteration computes
    // them.
    let divided = |once| OrderedOps::new(&func, &variance, once).outline(lengths);
    if let Some(outlined) = [true, false].into_iter().map(divided).find(|cut| cut.scratch_len <= lengths.max_scratch) {
        *cfg = Writer::new(&func, &outlined).write();
    }
}

/// Writes the loop and its pieces.
struct Writer<'a> {
    func: &'a Func,
    outlined: &'a Outlined,
    cfg: Cfg,
    /// The values that are available in the piece that is being written.
    known: HashSet<Value>,
    insts: Vec<Inst>,
}

impl<'a> Writer<'a> {
    fn new(func: &'a Func, outlined: &'a Outlined) -> Writer<'a> {
        let mut cfg = Cfg::new(&func.name, Entry::Several);
        cfg.ops.clone_from(&func.ops);
        cfg.scratch_len = outlined.scratch_len;
        Writer { func, outlined, cfg, known: HashSet::default(), insts: Vec::new() }
    }

    /// Makes a value of another piece available: reads it back from its scratch slot, or loads it again.
    fn fetch(&mut self, value: Value) {
        match (self.outlined.scratch_slots.get(&value), self.func.op(value)) {
            _ if !self.known.insert(value) => {}
            (Some(slot), _) => self.insts.push(Inst::Reload(value, Place::scratch(*slot))),
            (None, Op::Load(_)) => self.insts.push(Inst::Compute(value)),
            // Each use rematerialises a constant.
            (None, _) => {}
        }
    }

    /// Ends the block that is being written.
    fn block(&mut self, part: Part, params: Vec<Value>, end: Terminator) -> BlockId {
        let insts = std::mem::take(&mut self.insts);
        self.cfg.block(Block { part, params, insts, end })
    }

    fn write(mut self) -> Cfg {
        let iteration = self.outlined.iteration.clone();
        let number = self.outlined.pieces.len();
        let calls = |pieces: Range<usize>| pieces.map(Inst::Call);
        let [head, latch, failed, exit] = [1, 2, 3, 4].map(BlockId);
        self.insts.extend(calls(0..iteration.start));
        self.block(Part::Prologue, Vec::new(), Terminator::Jump(head.into()));

        let zero = self.func.status.map(|_| {
            self.cfg.ops.push(Op::Int(0));
            Value(self.cfg.ops.len() as u32 - 1)
        });
        let fine = Target { block: exit, args: zero.into_iter().collect() };
        let (test, detail) = tested(self.func);
        self.insts.extend(calls(iteration.clone()));
        test.into_iter().for_each(|test| self.fetch(test));
        let end = match (test, self.func.failure()) {
            (None, _) => Terminator::Jump(latch.into()),
            (Some(when), None) => {
                Terminator::Branch { when, yes: Target { block: exit, args: vec![when] }, no: latch.into() }
            }
            (Some(when), Some((_, true, _))) => Terminator::Branch { when, yes: failed.into(), no: latch.into() },
            (Some(when), Some((_, false, _))) => Terminator::Branch { when, yes: latch.into(), no: failed.into() },
        };
        self.block(Part::Body, Vec::new(), end);
        // If no iteration reads what an iteration writes, one is enough.
        let end = match is_idempotent(self.func) {
            true => Terminator::Jump(fine),
            false => Terminator::Repeat { count: Count::Call, again: head.into(), done: fine },
        };
        self.block(Part::Body, Vec::new(), end);
        self.insts.extend(calls(iteration.end..number));
        detail.into_iter().for_each(|detail| self.fetch(detail));
        let end = match detail {
            Some(when) => Terminator::Branch { when, yes: Target { block: exit, args: vec![when] }, no: latch.into() },
            None => Terminator::Jump(latch.into()),
        };
        self.block(Part::Cold, Vec::new(), end);
        let status = self.func.status;
        self.block(Part::Prologue, status.into_iter().collect(), Terminator::Return(status));
        for number in 0..number {
            let entry = self.piece(number);
            self.cfg.pieces.push(entry);
        }
        self.cfg
    }

    /// Writes a piece; returns its entry.
    fn piece(&mut self, number: usize) -> BlockId {
        let piece = &self.outlined.pieces[number];
        self.known.clear();
        let part = match number {
            number if number < self.outlined.iteration.start => Part::Prologue,
            number if number < self.outlined.iteration.end => Part::Body,
            _ => Part::Cold,
        };
        for (table, slot) in self.outlined.repeats.tables.iter().zip(&self.outlined.tables).filter(|_| number == 0) {
            let store = |(value, slot): (&Value, u32)| Inst::Store(Place::scratch(slot), *value);
            self.insts.extend(table.iter().zip(*slot..).map(store));
        }
        for value in &piece.ops {
            self.func.reads(self.func.op(*value)).for_each(|read| self.fetch(read));
            self.insts.push(Inst::Compute(*value));
            self.known.insert(*value);
            // Other pieces load the bits of a table entry by themselves.
            if let Some(slot) = self.outlined.scratch_slots.get(value).filter(|_| self.outlined.as_real[value.index()])
            {
                self.insts.push(Inst::Store(Place::scratch(*slot), *value));
            }
        }
        let written = piece.writes.iter().flat_map(|write| [write.index, write.value]);
        piece.stores.iter().map(|(_, value)| *value).chain(written).for_each(|value| self.fetch(value));
        self.insts.extend(piece.stores.iter().map(|(slot, value)| Inst::Store(Place::slot(*slot), *value)));
        self.insts.extend(piece.writes.iter().map(|write| Inst::Write(*write)));
        if piece.rows.is_empty() {
            return self.block(part, Vec::new(), Terminator::Return(None));
        }
        self.rerolled(piece, part)
    }

    /// Writes the loop of a rerolled piece. Its body has the values of the first repetition.
    fn rerolled(&mut self, piece: &Piece, part: Part) -> BlockId {
        let rows: Vec<&Row> = piece.rows.iter().map(|row| &self.outlined.repeats.rows[*row]).collect();
        let firsts: HashSet<Value> = rows.iter().map(|row| row.members[0]).collect();
        let slot = |value: Value| self.outlined.scratch_slots[&value];
        let at = |area: Area, index: u32, stride: i64| Place { area, index, stride };
        let (mut same, mut inputs): (Vec<Value>, Vec<(Value, Place)>) = (Vec::new(), Vec::new());
        // Constants that differ among the repetitions: the operation, the index of the operand, and the place.
        let mut constants: HashMap<(Value, usize), Place> = HashMap::default();
        for row in &rows {
            let first = row.members[0];
            let mut operands: Vec<Value> = self.func.reads(self.func.op(first)).collect();
            if let Op::Load(_) = self.func.op(first) {
                operands.push(first);
            }
            for (n, (operand, source)) in operands.into_iter().zip(&row.sources).enumerate() {
                match *source {
                    Source::Same(value) => same.push(value),
                    Source::Slots(first, stride) => inputs.push((operand, at(Area::Block, first.0, stride))),
                    Source::Table(table) => {
                        let place = at(Area::Scratch, self.outlined.tables[table], 1);
                        constants.insert((first, n), place);
                    }
                    Source::Scratch(first, _) if firsts.contains(&first) => {}
                    Source::Scratch(first, second) => {
                        let stride = i64::from(slot(second)) - i64::from(slot(first));
                        inputs.push((operand, at(Area::Scratch, slot(first), stride)));
                    }
                }
            }
        }
        inputs.sort_unstable_by_key(|(value, _)| *value);
        inputs.dedup();
        let mut outputs: Vec<(Place, Value)> = Vec::new();
        for first in rows.iter().map(|row| row.members[0]) {
            if let Some(slot) = self.outlined.scratch_slots.get(&first) {
                outputs.push((at(Area::Scratch, *slot, 1), first));
            }
        }
        for (slot, stride, row) in &piece.row_stores {
            outputs.push((at(Area::Block, slot.0, *stride), self.outlined.repeats.rows[*row].members[0]));
        }
        same.into_iter().for_each(|value| self.fetch(value));
        let head = BlockId(self.cfg.blocks.len() as u32 + 1);
        let after = BlockId(head.0 + 1);
        let entry = self.block(part, Vec::new(), Terminator::Jump(head.into()));

        let read: HashSet<Value> = inputs.iter().map(|(value, _)| *value).collect();
        self.insts.extend(inputs.into_iter().map(|(value, place)| Inst::Reload(value, place)));
        // The operations of the body, where an operand that is a constant of a table gives the operation a new value.
        let mut renamed: HashMap<Value, Value> = HashMap::default();
        for first in rows.iter().map(|row| row.members[0]).filter(|value| !read.contains(value)) {
            let (op, mut n) = (self.func.op(first), 0);
            let op = op.map(|operand| {
                let place = constants.get(&(first, n));
                n += 1;
                match place {
                    Some(place) => {
                        let value = self.cfg.in_memory();
                        self.insts.push(Inst::Reload(value, *place));
                        value
                    }
                    None => match (renamed.get(&operand), self.func.op(operand)) {
                        (Some(value), _) => *value,
                        // An entry of which only the bits are read belongs to no row: its index may.
                        (None, Op::Pool { base, len, index }) if let Some(index) = renamed.get(&index) => {
                            self.cfg.ops.push(Op::Pool { base, len, index: *index });
                            Value(self.cfg.ops.len() as u32 - 1)
                        }
                        (None, _) => operand,
                    },
                }
            });
            let value = if op == self.func.op(first) {
                first
            } else {
                self.cfg.ops.push(op);
                Value(self.cfg.ops.len() as u32 - 1)
            };
            renamed.insert(first, value);
            self.insts.push(Inst::Compute(value));
        }
        let value = |first: Value| renamed.get(&first).copied().unwrap_or(first);
        self.insts.extend(outputs.into_iter().map(|(place, first)| Inst::Store(place, value(first))));
        let count = Count::Fixed(rows[0].members.len() as u64);
        let end = Terminator::Repeat { count, again: head.into(), done: after.into() };
        self.block(part, Vec::new(), end);
        self.block(part, Vec::new(), Terminator::Return(None));
        entry
    }
}

/// Operations that are compiled as one function.
#[derive(Clone, Default)]
struct Piece {
    /// The operations, in order. Constants are not among them, nor most loads: each piece rematerialises those it
    /// reads.
    ops: Vec<Value>,
    /// Stores at the end of the piece; all values are read before the first store.
    stores: Vec<(Slot, Value)>,
    /// Writes to rings after the stores.
    writes: Vec<Write>,
    /// If not empty, the piece is a loop over these rows and the fields above are empty.
    rows: Vec<usize>,
    /// Rows that the loop stores to slots of the block, a member in each repetition: first slot, stride, row.
    row_stores: Vec<(Slot, i64, usize)>,
}

impl Piece {
    /// The operations of the piece; of a loop those of all repetitions.
    fn values<'a>(&'a self, repeats: &'a Repeats) -> impl Iterator<Item = Value> + 'a {
        let rows = self.rows.iter().flat_map(|row| &repeats.rows[*row].members);
        self.ops.iter().chain(rows).copied()
    }
}

/// A function in pieces.
struct Outlined {
    /// The rows of the loops.
    repeats: Repeats,
    /// The pieces in execution order.
    pieces: Vec<Piece>,
    /// The pieces that run in each iteration. Those before them run once per call, those after them when a guard has
    /// failed.
    iteration: Range<usize>,
    /// The scratch slot of each value that crosses a cut.
    scratch_slots: HashMap<Value, u32>,
    /// First scratch slot of each constant table of the loops; the first piece fills them.
    tables: Vec<u32>,
    /// Size of the scratch area, in doubles.
    scratch_len: u32,
    /// For each table entry, whether anything reads it as a real; other operations read only its bits.
    as_real: Vec<bool>,
}

/// Whether each piece that reads the value rematerialises it.
fn is_rematerialised(func: &Func, value: Value) -> bool {
    match func.op(value) {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => true,
        Op::Pool { index, .. } => matches!(func.op(index), Op::Int(_)),
        _ => false,
    }
}

/// The operations of a function in the order in which the pieces compute them.
struct OrderedOps<'a> {
    func: &'a Func,
    invariant: Vec<Value>,
    iteration: Vec<Value>,
    failure: Vec<Value>,
}

impl<'a> OrderedOps<'a> {
    fn new(func: &'a Func, variance: &[Variance], once: bool) -> OrderedOps<'a> {
        let cold = cold(func);
        let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
        // Loads that cannot be rematerialised, because the failure pieces read them after their slot may have been
        // stored.
        let mut needed_on_failure = vec![false; func.ops.len()];
        for value in values(func).filter(|value| cold[value.index()]) {
            for read in func.reads(func.op(value)) {
                needed_on_failure[read.index()] |=
                    matches!(func.op(read), Op::Load(slot) if stored.contains_key(&slot));
            }
        }
        let loads = func.loads();
        let (next, rest): (Vec<_>, Vec<_>) =
            func.stores.iter().copied().partition(|(slot, _)| loads.binary_search(slot).is_ok());
        let mut order = Order { func, groups: vec![None; func.ops.len()], values: Vec::new() };
        for (group, (_, value)) in next.into_iter().enumerate() {
            order.visit(value, Some(group));
        }
        let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
        // The failure pieces need these values from before the stores, so the iteration reads them.
        let read =
            values(func).filter(|value| needed_on_failure[value.index()] || matches!(func.op(*value), Op::Ring { .. }));
        let (tested, detail) = tested(func);
        for root in rest.into_iter().map(|(_, value)| value).chain(written).chain(tested).chain(read) {
            order.visit(root, None);
        }
        let own = |value: &Value| needed_on_failure[value.index()] || !is_rematerialised(func, *value);
        let (mut iteration, mut invariant) = (Vec::new(), Vec::new());
        for value in order.take().filter(own) {
            if once && variance[value.index()].is_invariant() { &mut invariant } else { &mut iteration }.push(value);
        }
        detail.into_iter().for_each(|detail| order.visit(detail, None));
        let failure = order.take().filter(own).collect();
        OrderedOps { func, invariant, iteration, failure }
    }

    fn outline(&self, lengths: Lengths) -> Outlined {
        let lists = [&self.invariant[..], &self.iteration, &self.failure];
        let results = self.func.results().chain(self.tested());
        let repeats = repeats(self.func, lists, results, lengths.min_repetitions);
        let [mut pieces, mut iteration, mut failure] = lists.map(|ops| self.pieces(ops, &repeats, lengths));
        // The iteration ends with a piece that is no loop; it takes the remaining stores.
        if iteration.last().is_none_or(|piece| !piece.rows.is_empty()) {
            iteration.push(Piece::default());
        }
        if !repeats.tables.is_empty() && pieces.first().is_none_or(|piece| !piece.rows.is_empty()) {
            pieces.insert(0, Piece::default());
        }
        let range = pieces.len()..pieces.len() + iteration.len();
        pieces.append(&mut iteration);
        pieces.append(&mut failure);
        self.store(&mut pieces, &range, &repeats);
        let (scratch_slots, mut len) = self.assign_scratch(&pieces, &range, &repeats);
        let place = |table: &Vec<Value>| {
            len += table.len() as u32;
            len - table.len() as u32
        };
        let tables = repeats.tables.iter().map(place).collect();
        let mut as_real: Vec<bool> = self.func.ops.iter().map(|op| !matches!(op, Op::Pool { .. })).collect();
        for op in self.func.ops.iter().filter(|op| !matches!(op, Op::ToBits(_))) {
            op.each_operand(|operand| as_real[operand.index()] = true);
        }
        self.func.results().for_each(|value| as_real[value.index()] = true);
        Outlined { repeats, pieces, iteration: range, scratch_slots, tables, scratch_len: len, as_real }
    }

    /// Divides operations into pieces: alternately straight pieces and loops, level by level.
    fn pieces(&self, ops: &[Value], repeats: &Repeats, lengths: Lengths) -> Vec<Piece> {
        let mut order = ops.to_vec();
        order.sort_by_key(|value| repeats.level(*value));
        let mut pieces = Vec::new();
        for level in order.chunk_by(|a, b| repeats.level(*a) == repeats.level(*b)) {
            if repeats.row(level[0]).is_none() {
                pieces.extend(self.parts(level, lengths).into_iter().map(|ops| Piece { ops, ..Piece::default() }));
                continue;
            }
            let mut loops: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
            for row in level.iter().filter_map(|value| repeats.row(*value)) {
                loops.entry(repeats.rows[row].members.len()).or_default().push(row);
            }
            pieces.extend(loops.into_values().map(|mut rows| {
                // Operands come first.
                rows.sort_unstable_by_key(|row| repeats.rows[*row].members[0]);
                rows.dedup();
                Piece { rows, ..Piece::default() }
            }));
        }
        pieces
    }

    /// Divides operations into parts of the allowed lengths, cut where the fewest values cross.
    fn parts(&self, ops: &[Value], lengths: Lengths) -> Vec<Vec<Value>> {
        let position: HashMap<Value, usize> =
            ops.iter().enumerate().map(|(position, value)| (*value, position)).collect();
        let mut last: Vec<usize> = (0..ops.len()).collect();
        for (user, value) in ops.iter().enumerate() {
            for read in self.func.reads(self.func.op(*value)) {
                if let Some(position) = position.get(&read) {
                    last[*position] = user;
                }
            }
        }
        // Number of values that cross a cut before each operation.
        let mut crossing = vec![0i64; ops.len() + 1];
        for (position, last) in last.into_iter().enumerate() {
            crossing[position + 1] += 1;
            crossing[last + 1] -= 1;
        }
        for position in 1..crossing.len() {
            crossing[position] += crossing[position - 1];
        }
        let mut parts = Vec::new();
        let mut begin = 0;
        while ops.len() - begin > lengths.max_piece {
            let cuts = begin + lengths.min_piece..=begin + lengths.max_piece;
            // Of equally good cuts the one that makes the longest part.
            let end = cuts.rev().min_by_key(|position| crossing[*position]).expect("a range that is not empty");
            parts.push(ops[begin..end].to_vec());
            begin = end;
        }
        if begin < ops.len() {
            parts.push(ops[begin..].to_vec());
        }
        parts
    }

    /// Assigns each store to the first piece of the iteration at whose end its value is computed and its slot is read
    /// no more.
    fn store(&self, pieces: &mut [Piece], iteration: &Range<usize>, repeats: &Repeats) {
        let last = iteration.end - 1;
        let mut computed_in: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        let mut read: HashMap<Slot, usize> = HashMap::default();
        for (number, piece) in pieces.iter().enumerate().take(iteration.end) {
            for value in piece.values(repeats) {
                computed_in[value.index()] = Some(number);
                read.extend(self.slots_read(value).map(|slot| (slot, number)));
            }
        }
        // The last piece loads values that are only moved between slots, written to rings or tested.
        let moved = self.func.stores.iter().map(|(_, value)| *value);
        let written = self.func.writes.iter().flat_map(|write| [write.index, write.value]);
        for slot in moved.chain(written).chain(self.tested()).filter_map(|value| self.slot(value)) {
            read.insert(slot, last);
        }
        let mut slots: HashMap<Value, Vec<Slot>> = HashMap::default();
        for (slot, value) in &self.func.stores {
            slots.entry(*value).or_default().push(*slot);
        }
        for number in iteration.clone() {
            let row_stores: Vec<(Slot, i64, usize)> = (pieces[number].rows.iter())
                .filter_map(|row| self.row_store(&pieces[number], number, *row, &slots, &read, repeats))
                .collect();
            for (_, _, row) in &row_stores {
                repeats.rows[*row].members.iter().for_each(|member| drop(slots.remove(member)));
            }
            pieces[number].row_stores = row_stores;
        }
        for (slot, value) in self.func.stores.iter().filter(|(_, value)| slots.contains_key(value)) {
            let ready = if self.slot(*value).is_some() { last } else { computed_in[value.index()].unwrap_or(0) };
            let number = ready.max(read.get(slot).copied().unwrap_or(0)).max(iteration.start);
            // A loop stores rows only.
            let number =
                (number..iteration.end).find(|number| pieces[*number].rows.is_empty()).expect("the last is none");
            pieces[number].stores.push((*slot, *value));
        }
        pieces[last].writes.clone_from(&self.func.writes);
    }

    /// The store of a row by its own loop: slots at a constant stride, one for each member. None if the slots are
    /// irregular, or if another repetition or a later piece reads one of them.
    fn row_store(
        &self,
        piece: &Piece,
        number: usize,
        row: usize,
        slots: &HashMap<Value, Vec<Slot>>,
        read: &HashMap<Slot, usize>,
        repeats: &Repeats,
    ) -> Option<(Slot, i64, usize)> {
        let slot = |member: &Value| match slots.get(member).map(Vec::as_slice) {
            Some([slot]) => Some(i64::from(slot.0)),
            _ => None,
        };
        let (first, stride) = arithmetic_progression(repeats.rows[row].members.iter().map(slot))?;
        let repetition = |slot: Slot| {
            let on = (i64::from(slot.0) - first) / stride;
            let hit = first + on * stride == i64::from(slot.0) && on >= 0;
            usize::try_from(on).ok().filter(|on| hit && *on < repeats.rows[row].members.len())
        };
        let later = read.iter().any(|(slot, last)| *last > number && repetition(*slot).is_some());
        let by_another = piece.rows.iter().any(|row| {
            let members = repeats.rows[*row].members.iter().enumerate();
            members
                .into_iter()
                .any(|(k, member)| self.slots_read(*member).filter_map(repetition).any(|repetition| repetition != k))
        });
        (!later && !by_another).then_some((Slot(first as u32), stride, row))
    }

    /// The slots whose loads are operands of a value, and its own slot if it is a load.
    fn slots_read(&self, value: Value) -> impl Iterator<Item = Slot> {
        self.func.reads(self.func.op(value)).chain([value]).filter_map(|read| self.slot(read))
    }

    /// The slot that a value is loaded from.
    fn slot(&self, value: Value) -> Option<Slot> {
        match self.func.op(value) {
            Op::Load(slot) => Some(slot),
            _ => None,
        }
    }

    /// The values that are tested after an iteration.
    fn tested(&self) -> impl Iterator<Item = Value> {
        let (first, second) = tested(self.func);
        first.into_iter().chain(second)
    }

    /// Assigns a scratch slot to each value that another piece reads; also returns the number of slots. The members of
    /// a row get consecutive slots. A slot is reused after the last read of its value.
    fn assign_scratch(
        &self,
        pieces: &[Piece],
        iteration: &Range<usize>,
        repeats: &Repeats,
    ) -> (HashMap<Value, u32>, u32) {
        let mut computed_in: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        let mut last: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        for (number, piece) in pieces.iter().enumerate() {
            piece.values(repeats).for_each(|value| computed_in[value.index()] = Some(number));
            let stored = piece.stores.iter().map(|(_, value)| *value);
            let written = piece.writes.iter().flat_map(|write| [write.index, write.value]);
            let read = piece.values(repeats).flat_map(|value| self.func.reads(self.func.op(value)));
            for value in read.chain(stored).chain(written) {
                let ends = match computed_in[value.index()] {
                    // An invariant is read again in the next iteration, so its slot stays in use.
                    Some(made) if made < iteration.start && number >= iteration.start => pieces.len(),
                    Some(made) if made < number => number,
                    _ => continue,
                };
                last[value.index()] = last[value.index()].max(Some(ends));
            }
        }
        for value in self.tested().filter(|value| computed_in[value.index()].is_some()) {
            last[value.index()] = Some(pieces.len());
        }
        // Values that need consecutive slots, with the last piece that reads one of them; by the piece that computes
        // the first.
        let mut arrays: Vec<Vec<(&[Value], usize)>> = vec![Vec::new(); pieces.len()];
        for array in repeats.rows.iter().map(|row| &row.members).chain(&repeats.arrays) {
            let begins = array.iter().filter_map(|value| computed_in[value.index()]).min();
            let ends = array.iter().filter_map(|value| last[value.index()]).max();
            if let (Some(begins), Some(ends)) = (begins, ends) {
                arrays[begins].push((array, ends));
            }
        }
        let single: HashSet<Value> = repeats.arrays.iter().flatten().copied().collect();
        let single = |value: &Value| !single.contains(value);
        let mut scratch_slots = HashMap::default();
        // Free slots, by the number of consecutive ones.
        let mut free: HashMap<usize, Vec<u32>> = HashMap::default();
        let mut len = 0;
        let mut ending: Vec<Vec<(usize, u32)>> = vec![Vec::new(); pieces.len() + 1];
        for (number, piece) in pieces.iter().enumerate() {
            let single_values = piece.ops.iter().filter(|value| single(value));
            let single_values =
                single_values.filter_map(|value| Some((std::slice::from_ref(value), last[value.index()]?)));
            for (values, last) in std::mem::take(&mut arrays[number]).into_iter().chain(single_values) {
                let home = free.get_mut(&values.len()).and_then(Vec::pop).unwrap_or_else(|| {
                    len += values.len() as u32;
                    len - values.len() as u32
                });
                scratch_slots.extend(values.iter().copied().zip(home..));
                ending[last].push((values.len(), home));
            }
            for (len, home) in std::mem::take(&mut ending[number]) {
                free.entry(len).or_default().push(home);
            }
        }
        (scratch_slots, len)
    }
}

/// Orders operations such that those which one result needs are adjacent, operands first.
struct Order<'a> {
    func: &'a Func,
    /// The group of each value that has been visited.
    groups: Vec<Option<usize>>,
    values: Vec<(usize, Value)>,
}

impl Order<'_> {
    /// Appends the operations that `root` needs and that have not been visited, in postorder. They belong to `group`;
    /// if that is `None`, each belongs to the last group among its operands, so that an output of a component is
    /// adjacent to the states of that component.
    fn visit(&mut self, root: Value, group: Option<usize>) {
        let mut open = vec![(root, false)];
        while let Some((value, ready)) = open.pop() {
            if self.groups[value.index()].is_some() {
                continue;
            }
            let operands = self.func.reads(self.func.op(value));
            if ready {
                let last_group = operands.filter_map(|operand| self.groups[operand.index()]).max().unwrap_or(0);
                let group = group.unwrap_or(last_group);
                self.groups[value.index()] = Some(group);
                self.values.push((group, value));
                continue;
            }
            open.push((value, true));
            // The operand that is pushed last is visited first.
            let operands: Vec<Value> = operands.collect();
            open.extend(operands.into_iter().rev().map(|operand| (operand, false)));
        }
    }

    /// The values visited since the last call, by group.
    fn take(&mut self) -> impl Iterator<Item = Value> + use<> {
        let mut values = std::mem::take(&mut self.values);
        values.sort_by_key(|(group, _)| *group);
        values.into_iter().map(|(_, value)| value)
    }
}

fn values(func: &Func) -> impl Iterator<Item = Value> + use<> {
    (0..func.ops.len()).map(|i| Value(i as u32))
}
