//! Rerolling: finds isomorphic operations in a straight line, such as those of a thousand equal components of a model,
//! that can become a loop.
//!
//! In: a verified, expanded function, and which of its operations are computed together. Out: [`Repeats`]: rows of
//! isomorphic operations, with the place of each operand. The search goes from results to operands. Operands must be
//! the same for all repetitions, or lie in memory at a constant stride; constants that differ are put into tables. Rows
//! with any other operand are dissolved. It knows nothing of processors.
//!
//! Compare Rocha et al., *Loop Rolling for Code Size Reduction*, CGO 2022, and LLVM's `LoopReroll`.

use crate::ir::hash::{HashMap, Hasher};
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::hash::BuildHasher;

/// Isomorphic operations, one for each repetition.
#[derive(Clone, PartialEq, Debug)]
pub struct Row {
    /// The values, by repetition; empty if the row has turned out not to be repeatable.
    pub members: Vec<Value>,
    /// The source of each operand; of a load, the source of the loaded value.
    pub sources: Vec<Source>,
    /// Order of computation within a list. Rows have odd levels, operations that are not repeated even ones. Operands
    /// from the same list have lower levels, or the same level: then the loop computes them in the same repetition.
    pub level: usize,
}

/// Where the repetitions find an operand.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Source {
    /// The same value for all.
    Same(Value),
    /// Slots of the block at a constant stride: the first slot, and the stride.
    Slots(Slot, i64),
    /// Values in scratch slots at a constant stride: the values of the first and of the second repetition.
    Scratch(Value, Value),
    /// Constants in the table with this index.
    Table(usize),
}

/// The rows of a function.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Repeats {
    /// All rows.
    pub rows: Vec<Row>,
    /// Groups of values that are not repeated and must occupy consecutive scratch slots.
    pub arrays: Vec<Vec<Value>>,
    /// Tables of constants, an entry for each repetition.
    pub tables: Vec<Vec<Value>>,
    /// For each value, its row and its repetition.
    places: Vec<Option<(usize, usize)>>,
    /// For each value that is not repeated, its level.
    levels: Vec<usize>,
}

impl Repeats {
    /// The row of a value that is repeated.
    pub fn row(&self, value: Value) -> Option<usize> {
        self.places[value.index()].map(|(row, _)| row)
    }

    /// The level on which a value is computed.
    pub fn level(&self, value: Value) -> usize {
        match self.row(value) {
            Some(row) => self.rows[row].level,
            None => self.levels[value.index()],
        }
    }
}

/// Finds rows of at least `min_repetitions` operations in `lists`, which are computed one after the other. `results`:
/// values that are read by anything except operations.
pub fn repeats(
    func: &Func,
    lists: [&[Value]; 3],
    results: impl Iterator<Item = Value>,
    min_repetitions: usize,
) -> Repeats {
    let mut search = Search::new(func, lists);
    search.families(results, min_repetitions);
    search.sources();
    search.levels();
    search.repeats
}

struct Search<'a> {
    func: &'a Func,
    /// For each value, the index of the list that computes it.
    list: Vec<Option<usize>>,
    /// All listed values, operands first.
    values: Vec<Value>,
    /// Hashes of the expression tree of each value. `exact` ignores the slots of loads; `shape` also ignores the values
    /// of real constants.
    exact: Vec<u64>,
    shape: Vec<u64>,
    /// Height of the expression tree of each value.
    depth: Vec<u32>,
    /// By row and operand, the operands of all members.
    operands: Vec<Vec<Vec<Value>>>,
    repeats: Repeats,
}

impl<'a> Search<'a> {
    fn new(func: &'a Func, lists: [&[Value]; 3]) -> Search<'a> {
        let mut list = vec![None; func.ops.len()];
        for (number, values) in lists.into_iter().enumerate() {
            values.iter().for_each(|value| list[value.index()] = Some(number));
        }
        let mut values: Vec<Value> = lists.into_iter().flatten().copied().collect();
        values.sort_unstable();
        let hasher = Hasher::default();
        let [mut exact, mut shape] = [(); 2].map(|()| Vec::with_capacity(list.len()));
        let mut depth = Vec::with_capacity(list.len());
        for (op, list) in func.ops.iter().zip(&list) {
            let hash = |kind: Op, known: &[u64]| {
                let (mut operands, mut count) = ([0; 3], 0);
                op.each_operand(|operand| {
                    operands[count] = known[operand.index()];
                    count += 1;
                });
                if let Some(commutative) = commutative(*op) {
                    operands[..commutative].sort_unstable();
                }
                hasher.hash_one((kind, &operands[..count], list))
            };
            exact.push(hash(kind(*op), &exact));
            shape.push(match op {
                Op::Real(_) => hash(Op::Real(0), &shape),
                op => hash(kind(*op), &shape),
            });
            let mut deepest = 0;
            op.each_operand(|operand| deepest = deepest.max(depth[operand.index()] + 1));
            depth.push(deepest);
        }
        let (places, levels) = (vec![None; list.len()], vec![0; list.len()]);
        let repeats = Repeats { places, levels, ..Repeats::default() };
        Search { func, list, values, exact, shape, depth, operands: Vec::new(), repeats }
    }

    fn of_list(&self, value: Value) -> Option<usize> {
        self.list[value.index()]
    }

    /// Whether the expression trees of two values have the same shape.
    fn alike(&self, a: Value, b: Value) -> bool {
        let of = |value: Value| (self.shape[value.index()], self.depth[value.index()], kind(self.func.op(value)));
        of(a) == of(b)
    }

    /// Finds rows: first values of equal shape that results or operations without repetition read, then their operands.
    fn families(&mut self, results: impl Iterator<Item = Value>, min_repetitions: usize) {
        let mut alike: HashMap<u64, usize> = HashMap::default();
        for value in &self.values {
            *alike.entry(self.shape[value.index()]).or_default() += 1;
        }
        let mut top = vec![false; self.func.ops.len()];
        results.for_each(|value| top[value.index()] = true);
        for value in self.values.iter().filter(|value| alike[&self.shape[value.index()]] < min_repetitions) {
            self.func.reads(self.func.op(*value)).for_each(|operand| top[operand.index()] = true);
        }
        // Values that are also equal in their constants form a family of their own if they are numerous enough.
        let top: Vec<Value> = self.values.iter().copied().filter(|value| top[value.index()]).collect();
        let mut equal: HashMap<u64, usize> = HashMap::default();
        for value in &top {
            *equal.entry(self.exact[value.index()]).or_default() += 1;
        }
        let mut families: HashMap<(u64, Option<u64>), Vec<Value>> = HashMap::default();
        for value in top {
            let (shape, exact) = (self.shape[value.index()], self.exact[value.index()]);
            let own = (equal[&exact] >= min_repetitions).then_some(exact);
            families.entry((shape, own)).or_default().push(value);
        }
        let mut families: Vec<Vec<Value>> =
            families.into_values().filter(|family| family.len() >= min_repetitions).collect();
        let depth = |family: &Vec<Value>| self.depth[family[0].index()];
        families.sort_unstable_by(|a, b| (b.len(), depth(b), a[0]).cmp(&(a.len(), depth(a), b[0])));
        for mut family in families {
            let first = family[0];
            family.retain(|value| self.repeats.row(*value).is_none() && self.alike(first, *value));
            if family.len() >= min_repetitions {
                self.descend(family);
            }
        }
    }

    /// Makes a row of these values, and rows of their operands as far as these are isomorphic.
    fn descend(&mut self, family: Vec<Value>) {
        let mut open = vec![family];
        while let Some(members) = open.pop() {
            if members.iter().any(|member| self.repeats.row(*member).is_some()) {
                continue;
            }
            let row = self.operands.len();
            for (k, member) in members.iter().enumerate() {
                self.repeats.places[member.index()] = Some((row, k));
            }
            let operands = self.aligned(&members);
            for operand_row in &operands {
                let alike = |value: &Value| self.of_list(*value).is_some() && self.alike(operand_row[0], *value);
                if operand_row.iter().all(alike) && distinct(operand_row) {
                    open.push(operand_row.clone());
                }
            }
            self.operands.push(operands);
            self.repeats.rows.push(Row { members, sources: Vec::new(), level: 0 });
        }
    }

    /// The operands of isomorphic operations, operand by operand. Commutative operands are exchanged to match the first
    /// member.
    fn aligned(&self, members: &[Value]) -> Vec<Vec<Value>> {
        let of = |member: Value| self.func.reads(self.func.op(member));
        let row = |first: Value| {
            let mut row = Vec::with_capacity(members.len());
            row.push(first);
            row
        };
        let mut all: Vec<Vec<Value>> = of(members[0]).map(row).collect();
        let commutative = commutative(self.func.op(members[0])).is_some();
        for member in &members[1..] {
            let mut operands = [Value(0); 3];
            operands.iter_mut().zip(of(*member)).for_each(|(to, operand)| *to = operand);
            if commutative && self.exchanged([&all[0], &all[1]], [operands[0], operands[1]]) {
                operands.swap(0, 1);
            }
            all.iter_mut().zip(operands).for_each(|(operand_row, operand)| operand_row.push(operand));
        }
        all
    }

    /// Whether the two operands of the next member match those of the earlier members better when exchanged.
    fn exchanged(&self, [first, second]: [&[Value]; 2], [a, b]: [Value; 2]) -> bool {
        let equal = |before: &[Value], value: Value| self.exact[before[0].index()] == self.exact[value.index()];
        let fits = |before: &[Value], value: Value| self.alike(before[0], value);
        let equal = [equal(first, a) && equal(second, b), equal(first, b) && equal(second, a)];
        if equal[0] != equal[1] {
            return equal[1];
        }
        let [straight, crossed] = [fits(first, a) && fits(second, b), fits(first, b) && fits(second, a)];
        if straight != crossed {
            return crossed;
        }
        let same = [first[0] == a || second[0] == b, first[0] == b || second[0] == a];
        if same[0] != same[1] {
            return same[1];
        }
        // Compare positions: best is the continuation of the stride between the last two members; for the second
        // member, the position nearest to the first.
        let irregularity = |before: &[Value], value: Value| {
            let at = |value: Value| match (self.repeats.places[value.index()], self.func.op(value)) {
                (Some((_, place)), _) => place as i64,
                (None, Op::Load(slot)) => i64::from(slot.0),
                (None, _) => i64::from(value.0),
            };
            match before {
                [.., last, newest] => (at(value) - 2 * at(*newest) + at(*last)).abs(),
                _ => (at(value) - at(before[0])).abs(),
            }
        };
        irregularity(first, b) + irregularity(second, a) < irregularity(first, a) + irregularity(second, b)
    }

    /// Finds the source of each operand, rows of the lowest expression trees first. A row with an operand at irregular
    /// positions is dissolved.
    fn sources(&mut self) {
        let mut order: Vec<usize> = (0..self.repeats.rows.len()).collect();
        order.sort_by_key(|row| self.depth[self.repeats.rows[*row].members[0].index()]);
        let mut of_array = vec![None; self.list.len()];
        // The loop body is emitted with the values of the first repetition, so each of these must have a single source
        // per loop.
        let mut known: HashMap<(usize, Value), Source> = HashMap::default();
        for row in order {
            let members = &self.repeats.rows[row].members;
            let count = members.len();
            let mut known = |operand: Value, source: Source| {
                let constant = matches!(self.func.op(operand), Op::Real(_));
                constant || *known.entry((count, operand)).or_insert(source) == source
            };
            // A row of loads has the loaded values as its operands.
            let loads = matches!(self.func.op(members[0]), Op::Load(_)).then(|| members.clone());
            let operands = std::mem::take(&mut self.operands[row]);
            let sources: Option<Vec<Source>> = loads
                .iter()
                .chain(&operands)
                .map(|operand_row| {
                    let source =
                        if loads.is_some() { self.slots(operand_row) } else { self.source(operand_row, &mut of_array) };
                    source.filter(|source| known(operand_row[0], *source))
                })
                .collect();
            self.operands[row] = operands;
            if let Some(sources) = sources {
                self.repeats.rows[row].sources = sources;
            } else {
                for member in std::mem::take(&mut self.repeats.rows[row].members) {
                    self.repeats.places[member.index()] = None;
                }
            }
        }
    }

    /// Slots at a constant stride.
    fn slots(&self, loads: &[Value]) -> Option<Source> {
        let slot = |load: &Value| match self.func.op(*load) {
            Op::Load(slot) => Some(i64::from(slot.0)),
            _ => None,
        };
        let (first, stride) = arithmetic_progression(loads.iter().map(slot))?;
        Some(Source::Slots(Slot(u32::try_from(first).ok()?), stride))
    }

    fn source(&mut self, operand_row: &[Value], of_array: &mut [Option<(usize, usize)>]) -> Option<Source> {
        let [first, second] = [operand_row[0], operand_row[1]];
        if operand_row.iter().all(|value| *value == first) {
            return Some(Source::Same(first));
        }
        if operand_row.iter().all(|value| matches!(self.func.op(*value), Op::Real(_))) {
            let known = self.repeats.tables.iter().position(|table| table == operand_row);
            return Some(Source::Table(known.unwrap_or_else(|| {
                self.repeats.tables.push(operand_row.to_vec());
                self.repeats.tables.len() - 1
            })));
        }
        if operand_row.iter().all(|value| self.of_list(*value).is_none()) {
            return self.slots(operand_row);
        }
        let scratch = Source::Scratch(first, second);
        let within = |places: &[Option<(usize, usize)>]| {
            let (group, _) = places[first.index()]?;
            let place = |value: &Value| places[value.index()].filter(|(of, _)| *of == group).map(|(_, k)| k as i64);
            arithmetic_progression(operand_row.iter().map(place)).map(|_| scratch)
        };
        if let Some(scratch) = within(&self.repeats.places).or_else(|| within(of_array)) {
            return Some(scratch);
        }
        let free = |value: &Value| {
            self.of_list(*value).is_some() && self.repeats.row(*value).is_none() && of_array[value.index()].is_none()
        };
        if !operand_row.iter().all(free) || !distinct(operand_row) {
            return None;
        }
        for (k, value) in operand_row.iter().enumerate() {
            of_array[value.index()] = Some((self.repeats.arrays.len(), k));
        }
        self.repeats.arrays.push(operand_row.to_vec());
        Some(scratch)
    }

    /// Assigns levels, so that rows and operations without repetition alternate.
    fn levels(&mut self) {
        let mut order = self.values.clone();
        order.sort_by_key(|value| self.depth[value.index()]);
        for value in order {
            let list = self.of_list(value);
            let below = |operand: Value| {
                (self.of_list(operand) == list).then(|| (self.repeats.level(operand), self.repeats.row(operand)))
            };
            let Some(row) = self.repeats.row(value) else {
                let operands = self.func.reads(self.func.op(value)).filter_map(below);
                let level = operands.map(|(level, row)| level + usize::from(row.is_some())).max().unwrap_or(0);
                self.repeats.levels[value.index()] = level;
                continue;
            };
            if self.repeats.rows[row].members[0] != value {
                continue;
            }
            let mut level = 1;
            for operand_row in &self.operands[row] {
                let together = self
                    .repeats
                    .row(operand_row[0])
                    .is_some_and(|other| self.repeats.rows[other].members == *operand_row);
                for (below, row) in operand_row.iter().filter_map(|operand| below(*operand)) {
                    level = level.max(match row {
                        None => below + 1,
                        Some(_) if together => below,
                        Some(_) => below + 2,
                    });
                }
            }
            self.repeats.rows[row].level = level;
        }
    }
}

/// An operation without its operands, or a load without its slot.
fn kind(op: Op) -> Op {
    match op {
        Op::Load(_) => Op::Load(Slot(0)),
        op => op.map(|_| Value(0)),
    }
}

/// The number of leading operands that commute.
fn commutative(op: Op) -> Option<usize> {
    let commutative = matches!(
        op,
        Op::Add(..)
            | Op::Mul(..)
            | Op::Fma(..)
            | Op::Equal(..)
            | Op::And(..)
            | Op::Or(..)
            | Op::IntAdd(..)
            | Op::IntMul(..)
            | Op::IntAnd(..)
            | Op::IntOr(..)
            | Op::IntXor(..)
            | Op::IntEqual(..)
    );
    commutative.then_some(2)
}

fn distinct(values: &[Value]) -> bool {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    sorted.windows(2).all(|pair| pair[0] != pair[1])
}

/// The first number and the stride of an arithmetic progression; none if a number is missing, the distances differ, or
/// the stride is 0.
pub fn arithmetic_progression(numbers: impl Iterator<Item = Option<i64>>) -> Option<(i64, i64)> {
    let mut numbers = numbers;
    let first = numbers.next()??;
    let mut last = numbers.next()??;
    let stride = last - first;
    for number in numbers {
        let number = number?;
        if number - last != stride {
            return None;
        }
        last = number;
    }
    (stride != 0).then_some((first, stride))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;

    /// Four components, each with a stiffness, a state and an output, that pull at one mass.
    #[test]
    fn components_of_one_shape_are_rows() {
        let mut build = Build::new("step");
        let (v, mut sum) = (build.load(Slot(3)), build.real(0.0));
        let mut forces = Vec::new();
        for k in 0..4 {
            let [stiffness, z] = [10 + 2 * k, 20 + k].map(|slot| build.load(Slot(slot)));
            // The product is built with exchanged operands.
            let force = if k == 2 { build.mul(z, stiffness) } else { build.mul(stiffness, z) };
            let moved = build.fma(force, v, z);
            build.store(Slot(20 + k), moved);
            sum = build.add(sum, force);
            forces.push(force);
        }
        build.store(Slot(30), sum);
        let func = build.finish();
        let all: Vec<Value> = (0..func.ops.len()).map(|i| Value(i as u32)).collect();
        let each: Vec<Value> =
            all.into_iter().filter(|value| !matches!(func.op(*value), Op::Load(_) | Op::Real(_))).collect();
        let found = repeats(&func, [&[], &each, &[]], func.results(), 4);
        let [moved, force] = &found.rows[..] else { panic!("{:?}", found.rows) };
        let (first, second) = (force.members[0], force.members[1]);
        assert_eq!(force.sources, [Source::Slots(Slot(10), 2), Source::Slots(Slot(20), 1)]);
        let of_moved = [Source::Same(v), Source::Scratch(first, second), Source::Slots(Slot(20), 1)];
        assert_eq!((&moved.sources[..], moved.level, force.level), (&of_moved[..], 1, 1));
        let (_, sum) = *func.stores.last().unwrap();
        assert_eq!((found.row(sum), found.level(sum)), (None, 2));
        assert_eq!(repeats(&func, [&[], &each, &[]], func.results(), 5).rows, []);
    }
}
