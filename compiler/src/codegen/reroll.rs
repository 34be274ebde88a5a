//! Finds what a long line repeats: the same operations on other numbers, as those of a thousand parts of one model.
//!
//! In: a sound, expanded function, and which of its operations are computed together. Out: [`Repeats`]: rows of operations
//! that differ only in what they take, and where it lies: numbers in equal distances, so that a loop finds them. What has
//! one shape is found from the results down; constants that differ are put into tables; what else does not lie in equal
//! distances is left out. It knows nothing of processors.

use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::HashMap;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

/// One operation as often as it is repeated.
#[derive(Clone, PartialEq, Debug)]
pub struct Row {
    /// The values, by repetition; none: it could not be repeated.
    pub members: Vec<Value>,
    /// What it takes, operand by operand; of a load, where it takes it from.
    pub sources: Vec<Source>,
    /// Odd; even are operations that are not repeated. What it needs of what is computed together with it is of lower
    /// levels, or of its own: then that of the same repetition.
    pub level: usize,
}

/// Where repetitions take an operand from.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Source {
    /// The same value for all.
    Same(Value),
    /// Slots in equal distances: the first, and the distance.
    Slots(Slot, i64),
    /// Values whose words lie in equal distances: those of the first and of the second repetition.
    Words(Value, Value),
    /// Constants, of the table of this number.
    Table(usize),
}

/// What is repeated.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Repeats {
    /// All rows.
    pub rows: Vec<Row>,
    /// Values that are not repeated, whose words must lie side by side.
    pub arrays: Vec<Vec<Value>>,
    /// Constants that repetitions take, each its own.
    pub tables: Vec<Vec<Value>>,
    /// By value: its row and its place there.
    places: Vec<Option<(usize, usize)>>,
    /// By value: the level of what is not repeated.
    levels: Vec<usize>,
}

impl Repeats {
    /// The row of a value that is repeated.
    pub fn row(&self, value: Value) -> Option<usize> {
        self.places[value.index()].map(|(row, _)| row)
    }

    /// On which level a value is computed.
    pub fn level(&self, value: Value) -> usize {
        match self.row(value) {
            Some(row) => self.rows[row].level,
            None => self.levels[value.index()],
        }
    }
}

/// What is repeated at least so many times among the operations of `lists`, of which each is computed before the next;
/// `results` are read by something else than operations.
pub fn repeats(func: &Func, lists: [&[Value]; 3], results: impl Iterator<Item = Value>, fewest: usize) -> Repeats {
    let mut search = Search::new(func, lists);
    search.families(results, fewest);
    search.sources();
    search.levels();
    search.repeats
}

struct Search<'a> {
    func: &'a Func,
    /// Number of the list that computes a value.
    list: Vec<Option<usize>>,
    /// All listed values, operands first.
    values: Vec<Value>,
    /// A number that values of one shape have in common, whatever slots they are made of, and one for which their real
    /// constants may differ too.
    exact: Vec<u64>,
    shape: Vec<u64>,
    /// Operations from a value down to a leaf, at most.
    depth: Vec<u32>,
    /// By row, what its members take: operand by operand.
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
        let hasher = BuildHasherDefault::<DefaultHasher>::default();
        let [mut exact, mut shape] = [(); 2].map(|()| Vec::with_capacity(list.len()));
        let mut depth = Vec::with_capacity(list.len());
        for (op, list) in func.ops.iter().zip(&list) {
            let hash = |kind: Op, known: &[u64]| {
                let mut operands = Vec::new();
                op.each_operand(|operand| operands.push(known[operand.index()]));
                if let Some(exchangeable) = exchangeable(*op) {
                    operands[..exchangeable].sort_unstable();
                }
                hasher.hash_one((kind, operands, list))
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

    /// Whether two values are of one shape.
    fn alike(&self, a: Value, b: Value) -> bool {
        let of = |value: Value| (self.shape[value.index()], self.depth[value.index()], kind(self.func.op(value)));
        of(a) == of(b)
    }

    /// Makes rows, from those values of one shape that are read by what is not repeated down to what they need.
    fn families(&mut self, results: impl Iterator<Item = Value>, fewest: usize) {
        let mut alike: HashMap<u64, usize> = HashMap::new();
        for value in &self.values {
            *alike.entry(self.shape[value.index()]).or_default() += 1;
        }
        let mut top = vec![false; self.func.ops.len()];
        results.for_each(|value| top[value.index()] = true);
        for value in self.values.iter().filter(|value| alike[&self.shape[value.index()]] < fewest) {
            self.func.reads(self.func.op(*value)).for_each(|operand| top[operand.index()] = true);
        }
        // Those of equal constants are a family of their own if they are enough.
        let top: Vec<Value> = self.values.iter().copied().filter(|value| top[value.index()]).collect();
        let mut equal: HashMap<u64, usize> = HashMap::new();
        for value in &top {
            *equal.entry(self.exact[value.index()]).or_default() += 1;
        }
        let mut families: HashMap<(u64, Option<u64>), Vec<Value>> = HashMap::new();
        for value in top {
            let (shape, exact) = (self.shape[value.index()], self.exact[value.index()]);
            let own = (equal[&exact] >= fewest).then_some(exact);
            families.entry((shape, own)).or_default().push(value);
        }
        let mut families: Vec<Vec<Value>> = families.into_values().filter(|family| family.len() >= fewest).collect();
        let depth = |family: &Vec<Value>| self.depth[family[0].index()];
        families.sort_unstable_by(|a, b| (b.len(), depth(b), a[0]).cmp(&(a.len(), depth(a), b[0])));
        for mut family in families {
            let first = family[0];
            family.retain(|value| self.repeats.row(*value).is_none() && self.alike(first, *value));
            if family.len() >= fewest {
                self.descend(family);
            }
        }
    }

    /// A row of these values, and of what they need in turn.
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
            for of_all in &operands {
                let alike = |value: &Value| self.of_list(*value).is_some() && self.alike(of_all[0], *value);
                if of_all.iter().all(alike) && distinct(of_all) {
                    open.push(of_all.clone());
                }
            }
            self.operands.push(operands);
            self.repeats.rows.push(Row { members, sources: Vec::new(), level: 0 });
        }
    }

    /// What operations of one kind take, operand by operand; operands that may be exchanged so that they fit the first's.
    fn aligned(&self, members: &[Value]) -> Vec<Vec<Value>> {
        let of = |member: Value| -> Vec<Value> { self.func.reads(self.func.op(member)).collect() };
        let first = of(members[0]);
        let mut all: Vec<Vec<Value>> = first.iter().map(|operand| vec![*operand]).collect();
        let exchangeable = exchangeable(self.func.op(members[0])).is_some();
        for member in &members[1..] {
            let mut operands = of(*member);
            if exchangeable && self.exchanged([&all[0], &all[1]], [operands[0], operands[1]]) {
                operands.swap(0, 1);
            }
            all.iter_mut().zip(operands).for_each(|(of_all, operand)| of_all.push(operand));
        }
        all
    }

    /// Whether the two operands of the next member fit those of the members before better the other way round.
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
        // By where they lie: as far on as between the two members before, or, of the second member, as near as can be.
        let strain = |before: &[Value], value: Value| {
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
        strain(first, b) + strain(second, a) < strain(first, a) + strain(second, b)
    }

    /// Finds where rows take their operands from, lowest first; what does not lie in equal distances is not repeated.
    fn sources(&mut self) {
        let mut order: Vec<usize> = (0..self.repeats.rows.len()).collect();
        order.sort_by_key(|row| self.depth[self.repeats.rows[*row].members[0].index()]);
        let mut of_array = vec![None; self.list.len()];
        // A loop knows an operand by what it is in the first repetition.
        let mut known: HashMap<(usize, Value), Source> = HashMap::new();
        for row in order {
            let members = &self.repeats.rows[row].members;
            let count = members.len();
            let mut known = |operand: Value, source: Source| {
                let constant = matches!(self.func.op(operand), Op::Real(_));
                constant || *known.entry((count, operand)).or_insert(source) == source
            };
            // A load is its own operand.
            let loads = matches!(self.func.op(members[0]), Op::Load(_)).then(|| members.clone());
            let operands = std::mem::take(&mut self.operands[row]);
            let sources: Option<Vec<Source>> = loads
                .iter()
                .chain(&operands)
                .map(|of_all| {
                    let source = if loads.is_some() { self.slots(of_all) } else { self.source(of_all, &mut of_array) };
                    source.filter(|source| known(of_all[0], *source))
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

    /// Slots in equal distances.
    fn slots(&self, loads: &[Value]) -> Option<Source> {
        let slot = |load: &Value| match self.func.op(*load) {
            Op::Load(slot) => Some(i64::from(slot.0)),
            _ => None,
        };
        let (first, distance) = equal_distances(loads.iter().map(slot))?;
        Some(Source::Slots(Slot(u32::try_from(first).ok()?), distance))
    }

    fn source(&mut self, of_all: &[Value], of_array: &mut [Option<(usize, usize)>]) -> Option<Source> {
        let [first, second] = [of_all[0], of_all[1]];
        if of_all.iter().all(|value| *value == first) {
            return Some(Source::Same(first));
        }
        if of_all.iter().all(|value| matches!(self.func.op(*value), Op::Real(_))) {
            let known = self.repeats.tables.iter().position(|table| table == of_all);
            return Some(Source::Table(known.unwrap_or_else(|| {
                self.repeats.tables.push(of_all.to_vec());
                self.repeats.tables.len() - 1
            })));
        }
        if of_all.iter().all(|value| self.of_list(*value).is_none()) {
            return self.slots(of_all);
        }
        let words = Source::Words(first, second);
        let within = |places: &[Option<(usize, usize)>]| {
            let (whole, _) = places[first.index()]?;
            let place = |value: &Value| places[value.index()].filter(|(of, _)| *of == whole).map(|(_, k)| k as i64);
            equal_distances(of_all.iter().map(place)).map(|_| words)
        };
        if let Some(words) = within(&self.repeats.places).or_else(|| within(of_array)) {
            return Some(words);
        }
        let free = |value: &Value| {
            self.of_list(*value).is_some() && self.repeats.row(*value).is_none() && of_array[value.index()].is_none()
        };
        if !of_all.iter().all(free) || !distinct(of_all) {
            return None;
        }
        for (k, value) in of_all.iter().enumerate() {
            of_array[value.index()] = Some((self.repeats.arrays.len(), k));
        }
        self.repeats.arrays.push(of_all.to_vec());
        Some(words)
    }

    /// Says when everything is computed: rows and what is not repeated in turn.
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
            for of_all in &self.operands[row] {
                let together =
                    self.repeats.row(of_all[0]).is_some_and(|other| self.repeats.rows[other].members == *of_all);
                for (below, row) in of_all.iter().filter_map(|operand| below(*operand)) {
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

/// An operation apart from what it takes: of a load, from where.
fn kind(op: Op) -> Op {
    match op {
        Op::Load(_) => Op::Load(Slot(0)),
        op => op.map(|_| Value(0)),
    }
}

/// How many of its first operands an operation takes in any order.
fn exchangeable(op: Op) -> Option<usize> {
    let exchangeable = matches!(
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
    exchangeable.then_some(2)
}

fn distinct(values: &[Value]) -> bool {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    sorted.windows(2).all(|pair| pair[0] != pair[1])
}

/// The first number and the distance, if all are there and in equal distances other than 0.
pub fn equal_distances(numbers: impl Iterator<Item = Option<i64>>) -> Option<(i64, i64)> {
    let mut numbers = numbers;
    let first = numbers.next()??;
    let mut last = numbers.next()??;
    let distance = last - first;
    for number in numbers {
        let number = number?;
        if number - last != distance {
            return None;
        }
        last = number;
    }
    (distance != 0).then_some((first, distance))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;

    /// Four parts, each with a stiffness, a state and an output, that pull at one mass.
    #[test]
    fn parts_of_one_shape_are_rows() {
        let mut build = Build::new("step");
        let (v, mut sum) = (build.load(Slot(3)), build.real(0.0));
        let mut forces = Vec::new();
        for k in 0..4 {
            let [stiffness, z] = [10 + 2 * k, 20 + k].map(|slot| build.load(Slot(slot)));
            // Built later, the product would take them the other way round.
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
        let of_moved = [Source::Same(v), Source::Words(first, second), Source::Slots(Slot(20), 1)];
        assert_eq!((&moved.sources[..], moved.level, force.level), (&of_moved[..], 1, 1));
        let (_, sum) = *func.stores.last().unwrap();
        assert_eq!((found.row(sum), found.level(sum)), (None, 2));
        assert_eq!(repeats(&func, [&[], &each, &[]], func.results(), 5).rows, []);
    }
}
