//! Cuts a long line into pieces, since the time to find registers grows faster than a function does.
//!
//! In: a sound, expanded function. Out: a [`Outlined`]: which operations each piece computes, which values it leaves for later
//! pieces and where, and when each slot may be stored. What [repeats](crate::codegen::reroll) itself is one piece, a loop. It knows
//! nothing of processors.
//!
//! ```text
//! before  what no iteration changes, once a call
//! each    everything else, once an iteration; stores as soon as nothing reads the slot any more
//! failed  what only the status needs, where the test for it says so
//! ```
//! Values that cross a cut lie in words of a scratch area. Few do: what a result needs stands in one place, operands
//! first, and of the places to cut that come into question it is the one that the fewest values cross.

use crate::codegen::emit::{Facts, Watch};
use crate::codegen::reroll::{Repeats, equal_distances, repeats};
use crate::ir::{Func, Op, Value, Write};
use abi::Slot;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;

/// How long functions and their pieces are, in operations.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Lengths {
    /// Functions that are longer are cut.
    pub whole: usize,
    /// The least of a piece but the last.
    pub least: usize,
    /// The most of a piece.
    pub most: usize,
    /// Words of the scratch area at most.
    pub words: u32,
    /// Repetitions from which on they are a loop.
    pub fewest: usize,
}

impl Lengths {
    /// Pieces for which registers are found quickly, and an area that is part of what a thread in real time touches ahead.
    pub const USUAL: Lengths = Lengths { whole: 2000, least: 600, most: 1200, words: 32_768, fewest: 8 };
}

/// Consecutive operations, compiled together.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Piece {
    /// What it computes, in this order; loads and constants are not among it: each piece makes its own.
    pub ops: Vec<Value>,
    /// What it stores at its end, all values taken before the first store.
    pub stores: Vec<(Slot, Value)>,
    /// What it writes to rings after that.
    pub writes: Vec<Write>,
    /// It is a loop over rows of operations; then it has nothing of the above.
    pub rows: Vec<usize>,
    /// Rows whose values each repetition stores at its end: the slot of the first, the distance to the next, the row.
    pub row_stores: Vec<(Slot, i64, usize)>,
}

impl Piece {
    /// What it computes, of a loop in all its repetitions.
    fn values<'a>(&'a self, repeats: &'a Repeats) -> impl Iterator<Item = Value> + 'a {
        let rows = self.rows.iter().flat_map(|row| &repeats.rows[*row].members);
        self.ops.iter().chain(rows).copied()
    }
}

/// A function in pieces.
#[derive(Clone, PartialEq, Debug)]
pub struct Outlined {
    /// Rows of operations that are repeated.
    pub repeats: Repeats,
    /// In the order in which they run.
    pub pieces: Vec<Piece>,
    /// Of the pieces: those that run in each iteration. What stands before runs once, what stands behind if a guard failed.
    pub each: Range<usize>,
    /// Where a value lies between pieces, as words from the beginning of the scratch area.
    pub homes: HashMap<Value, u32>,
    /// Where the tables of what is repeated lie, likewise; the first piece writes them.
    pub tables: Vec<u32>,
    /// Words of the scratch area.
    pub words: u32,
}

/// The function in pieces; none if the scratch area has no room for what crosses them.
pub fn cut(func: &Func, facts: &Facts, lengths: Lengths) -> Option<Outlined> {
    // What is computed once a call lies in the area through all of it: where that is too much, it is computed each time.
    [true, false]
        .into_iter()
        .map(|once| Line::new(func, facts, once).cut(lengths))
        .find(|cut| cut.words <= lengths.words)
}

/// Whether each piece makes the value itself where it needs it.
fn made_anew(func: &Func, value: Value) -> bool {
    match func.op(value) {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => true,
        Op::Pool { index, .. } => matches!(func.op(index), Op::Int(_)),
        _ => false,
    }
}

/// The operations of a function in the order in which pieces compute them.
struct Line<'a> {
    func: &'a Func,
    watch: Watch,
    before: Vec<Value>,
    each: Vec<Value>,
    failed: Vec<Value>,
}

impl<'a> Line<'a> {
    fn new(func: &'a Func, facts: &Facts, once: bool) -> Line<'a> {
        let (watch, late) = Watch::of(func);
        let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
        // Loads that are not made anew, since something reads them after their slot may have been stored.
        let mut kept = vec![false; func.ops.len()];
        for value in values(func).filter(|value| late[value.index()]) {
            for read in func.reads(func.op(value)) {
                kept[read.index()] |= matches!(func.op(read), Op::Load(slot) if stored.contains_key(&slot));
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
        // What a failed guard tells of the block is read before the block changes.
        let read = values(func).filter(|value| kept[value.index()] || matches!(func.op(*value), Op::Ring { .. }));
        let (tested, detail) = watch.asked();
        for root in rest.into_iter().map(|(_, value)| value).chain(written).chain(tested).chain(read) {
            order.visit(root, None);
        }
        let own = |value: &Value| kept[value.index()] || !made_anew(func, *value);
        let (mut each, mut before) = (Vec::new(), Vec::new());
        for value in order.take().filter(own) {
            if once && !facts.varies[value.index()] { &mut before } else { &mut each }.push(value);
        }
        detail.into_iter().for_each(|detail| order.visit(detail, None));
        let failed = order.take().filter(own).collect();
        Line { func, watch, before, each, failed }
    }

    fn cut(&self, lengths: Lengths) -> Outlined {
        let lists = [&self.before[..], &self.each, &self.failed];
        let results = self.func.results().chain(self.outcomes());
        let repeats = repeats(self.func, lists, results, lengths.fewest);
        let [mut pieces, mut each, mut failed] = lists.map(|ops| self.pieces(ops, &repeats, lengths));
        // There is a last piece of each iteration, which stores what is left.
        if each.last().is_none_or(|piece| !piece.rows.is_empty()) {
            each.push(Piece::default());
        }
        if !repeats.tables.is_empty() && pieces.first().is_none_or(|piece| !piece.rows.is_empty()) {
            pieces.insert(0, Piece::default());
        }
        let range = pieces.len()..pieces.len() + each.len();
        pieces.append(&mut each);
        pieces.append(&mut failed);
        self.store(&mut pieces, &range, &repeats);
        let (homes, mut words) = self.homes(&pieces, &range, &repeats);
        let lie = |table: &Vec<Value>| {
            words += table.len() as u32;
            words - table.len() as u32
        };
        let tables = repeats.tables.iter().map(lie).collect();
        Outlined { repeats, pieces, each: range, homes, tables, words }
    }

    /// The operations in pieces: what is not repeated in parts, what is in loops, in turn.
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
                // Operands stand first.
                rows.sort_unstable_by_key(|row| repeats.rows[*row].members[0]);
                rows.dedup();
                Piece { rows, ..Piece::default() }
            }));
        }
        pieces
    }

    /// The operations in parts, cut where the fewest values cross.
    fn parts(&self, ops: &[Value], lengths: Lengths) -> Vec<Vec<Value>> {
        let place: HashMap<Value, usize> = ops.iter().enumerate().map(|(place, value)| (*value, place)).collect();
        let mut last: Vec<usize> = (0..ops.len()).collect();
        for (user, value) in ops.iter().enumerate() {
            for read in self.func.reads(self.func.op(*value)) {
                if let Some(place) = place.get(&read) {
                    last[*place] = user;
                }
            }
        }
        // Values that cross a cut before each operation.
        let mut crossing = vec![0i64; ops.len() + 1];
        for (place, last) in last.into_iter().enumerate() {
            crossing[place + 1] += 1;
            crossing[last + 1] -= 1;
        }
        for place in 1..crossing.len() {
            crossing[place] += crossing[place - 1];
        }
        let mut parts = Vec::new();
        let mut begin = 0;
        while ops.len() - begin > lengths.most {
            let cuts = begin + lengths.least..=begin + lengths.most;
            // The longest of equals.
            let end = cuts.rev().min_by_key(|place| crossing[*place]).expect("a range that is not empty");
            parts.push(ops[begin..end].to_vec());
            begin = end;
        }
        if begin < ops.len() {
            parts.push(ops[begin..].to_vec());
        }
        parts
    }

    /// Puts each store into the first piece of an iteration at whose end its value is there and its slot is read no more.
    fn store(&self, pieces: &mut [Piece], each: &Range<usize>, repeats: &Repeats) {
        let last = each.end - 1;
        let mut made: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        let mut read: HashMap<Slot, usize> = HashMap::new();
        for (number, piece) in pieces.iter().enumerate().take(each.end) {
            for value in piece.values(repeats) {
                made[value.index()] = Some(number);
                read.extend(self.slots_read(value).map(|slot| (slot, number)));
            }
        }
        // What is only moved, and what is written to rings, is taken at the very end.
        let moved = self.func.stores.iter().map(|(_, value)| *value);
        let written = self.func.writes.iter().flat_map(|write| [write.index, write.value]);
        for slot in moved.chain(written).chain(self.outcomes()).filter_map(|value| self.slot(value)) {
            read.insert(slot, last);
        }
        let mut slots: HashMap<Value, Vec<Slot>> = HashMap::new();
        for (slot, value) in &self.func.stores {
            slots.entry(*value).or_default().push(*slot);
        }
        for number in each.clone() {
            let row_stores: Vec<(Slot, i64, usize)> = (pieces[number].rows.iter())
                .filter_map(|row| self.row_store(&pieces[number], number, *row, &slots, &read, repeats))
                .collect();
            for (_, _, row) in &row_stores {
                repeats.rows[*row].members.iter().for_each(|member| drop(slots.remove(member)));
            }
            pieces[number].row_stores = row_stores;
        }
        for (slot, value) in self.func.stores.iter().filter(|(_, value)| slots.contains_key(value)) {
            let ready = if self.slot(*value).is_some() { last } else { made[value.index()].unwrap_or(0) };
            let number = ready.max(read.get(slot).copied().unwrap_or(0)).max(each.start);
            // A loop stores only rows.
            let number = (number..each.end).find(|number| pieces[*number].rows.is_empty()).expect("the last is none");
            pieces[number].stores.push((*slot, *value));
        }
        pieces[last].writes.clone_from(&self.func.writes);
    }

    /// The store of a row by its own loop, if each of its values goes to one slot, these lie in equal distances, and what a
    /// repetition stores is read by no other and not later.
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
        let (first, distance) = equal_distances(repeats.rows[row].members.iter().map(slot))?;
        let repetition = |slot: Slot| {
            let on = (i64::from(slot.0) - first) / distance;
            let hit = first + on * distance == i64::from(slot.0) && on >= 0;
            usize::try_from(on).ok().filter(|on| hit && *on < repeats.rows[row].members.len())
        };
        let later = read.iter().any(|(slot, last)| *last > number && repetition(*slot).is_some());
        let by_another = piece.rows.iter().any(|row| {
            let members = repeats.rows[*row].members.iter().enumerate();
            members
                .into_iter()
                .any(|(k, member)| self.slots_read(*member).filter_map(repetition).any(|repetition| repetition != k))
        });
        (!later && !by_another).then_some((Slot(first as u32), distance, row))
    }

    /// The slots that an operation reads, or that a value is loaded from.
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

    /// What is asked after an iteration.
    fn outcomes(&self) -> impl Iterator<Item = Value> {
        let (first, second) = self.watch.asked();
        first.into_iter().chain(second)
    }

    /// A word for each value that something reads outside its piece, and how many these are; those of rows lie side by side.
    /// A word is used again when nothing reads it any more.
    fn homes(&self, pieces: &[Piece], each: &Range<usize>, repeats: &Repeats) -> (HashMap<Value, u32>, u32) {
        let mut made: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        let mut last: Vec<Option<usize>> = vec![None; self.func.ops.len()];
        for (number, piece) in pieces.iter().enumerate() {
            piece.values(repeats).for_each(|value| made[value.index()] = Some(number));
            let stored = piece.stores.iter().map(|(_, value)| *value);
            let written = piece.writes.iter().flat_map(|write| [write.index, write.value]);
            let read = piece.values(repeats).flat_map(|value| self.func.reads(self.func.op(value)));
            for value in read.chain(stored).chain(written) {
                let ends = match made[value.index()] {
                    // What was made before the loop is read again in the next iteration.
                    Some(made) if made < each.start && number >= each.start => pieces.len(),
                    Some(made) if made < number => number,
                    _ => continue,
                };
                last[value.index()] = last[value.index()].max(Some(ends));
            }
        }
        for value in self.outcomes().filter(|value| made[value.index()].is_some()) {
            last[value.index()] = Some(pieces.len());
        }
        // By the piece with which they begin: values whose words lie side by side, and the last piece that reads one.
        let mut arrays: Vec<Vec<(&[Value], usize)>> = vec![Vec::new(); pieces.len()];
        for array in repeats.rows.iter().map(|row| &row.members).chain(&repeats.arrays) {
            let begins = array.iter().filter_map(|value| made[value.index()]).min();
            let ends = array.iter().filter_map(|value| last[value.index()]).max();
            if let (Some(begins), Some(ends)) = (begins, ends) {
                arrays[begins].push((array, ends));
            }
        }
        let single: HashSet<Value> = repeats.arrays.iter().flatten().copied().collect();
        let single = |value: &Value| !single.contains(value);
        let mut homes = HashMap::new();
        // Words that are free again, by how many of them lie side by side.
        let mut free: HashMap<usize, Vec<u32>> = HashMap::new();
        let mut words = 0;
        let mut ending: Vec<Vec<(usize, u32)>> = vec![Vec::new(); pieces.len() + 1];
        for (number, piece) in pieces.iter().enumerate() {
            let alone = piece.ops.iter().filter(|value| single(value));
            let alone = alone.filter_map(|value| Some((std::slice::from_ref(value), last[value.index()]?)));
            for (values, last) in std::mem::take(&mut arrays[number]).into_iter().chain(alone) {
                let home = free.get_mut(&values.len()).and_then(Vec::pop).unwrap_or_else(|| {
                    words += values.len() as u32;
                    words - values.len() as u32
                });
                homes.extend(values.iter().copied().zip(home..));
                ending[last].push((values.len(), home));
            }
            for (len, home) in std::mem::take(&mut ending[number]) {
                free.entry(len).or_default().push(home);
            }
        }
        (homes, words)
    }
}

/// An order in which what a result needs stands in one place, operands first.
struct Order<'a> {
    func: &'a Func,
    /// For each value that has been visited, where it belongs.
    groups: Vec<Option<usize>>,
    values: Vec<(usize, Value)>,
}

impl Order<'_> {
    /// Puts what a result needs and nothing needed before into a group of its own, or, if there is `none`, right behind
    /// what it needs of others: so an output of a part stands beside the states of that part.
    fn visit(&mut self, root: Value, group: Option<usize>) {
        let mut open = vec![(root, false)];
        while let Some((value, ready)) = open.pop() {
            if self.groups[value.index()].is_some() {
                continue;
            }
            let operands = self.func.reads(self.func.op(value));
            if ready {
                let behind = operands.filter_map(|operand| self.groups[operand.index()]).max().unwrap_or(0);
                let group = group.unwrap_or(behind);
                self.groups[value.index()] = Some(group);
                self.values.push((group, value));
                continue;
            }
            open.push((value, true));
            // The last pushed is done first.
            let operands: Vec<Value> = operands.collect();
            open.extend(operands.into_iter().rev().map(|operand| (operand, false)));
        }
    }

    /// What was visited since it was last asked.
    fn take(&mut self) -> impl Iterator<Item = Value> + use<> {
        let mut values = std::mem::take(&mut self.values);
        values.sort_by_key(|(group, _)| *group);
        values.into_iter().map(|(_, value)| value)
    }
}

fn values(func: &Func) -> impl Iterator<Item = Value> + use<> {
    (0..func.ops.len()).map(|i| Value(i as u32))
}
