//! An interpreter for functions that run often: their operations in groups of one kind, none of which needs another of
//! its group.
//!
//! An interpreter jumps for each operation to the code for its kind. A processor predicts such a jump badly, and each
//! one that it predicts wrongly takes longer than the operation. Here there is a jump for each group: an adaptive step
//! with LuGre friction has 1,050 operations in 350 groups. Grouping takes as long as some 50 runs in order, and a
//! hundredth of what compiling takes.
//!
//! In: a function before its elementary functions are expanded. Exponentials stay single operations, which compute them
//! faster than some 30 operations of their expansion would. Out: a form that runs with the bits of [`ir::interpret`](crate::ir::interpret).
//!
//! Source: list scheduling by the longest path (Cooper, Torczon, *Engineering a Compiler*, 2012, sec. 12.3).

use crate::ir::eval::{Operands, apply};
use crate::ir::hash::HashMap;
use crate::ir::interpret::{results, until_status};
use crate::ir::variance::variance;
use crate::ir::verify::{Stage, verify};
use crate::ir::{Func, Op, Unary, Value};
use crate::math::{self, exponential::exp_of};
use abi::{Layout, Slot};
use std::cell::Cell;
use std::ops::ControlFlow;

thread_local! {
    /// Space for the values of a function, kept from call to call.
    static VALUES: Cell<Vec<u64>> = const { Cell::new(Vec::new()) };
}

/// A function in groups. Its values have places of their own: first the constants, then the invariants, then the others.
pub struct Grouped {
    constants: Vec<u64>,
    once: Groups,
    each: Groups,
    /// Stores, writes and status, with places for values, and no operations.
    ends: Func,
    size: usize,
    pool_len: usize,
}

/// Operations in groups.
struct Groups {
    /// An operation for its kind, and the number of operations in the group.
    kinds: Vec<(Op, usize)>,
    /// For each operation the places of its operands; for those that read the block or the pool also what they read.
    operands: Vec<[u32; 3]>,
    /// The place of the first result. The others follow.
    first: usize,
}

/// The place of a value that has none yet.
const NOWHERE: u32 = u32::MAX;

impl Grouped {
    /// Groups a function before its elementary functions are expanded. `layout`: the block it works on; `pool_len`: the
    /// number of constants that it may read.
    ///
    /// # Panics
    /// If the function does not verify: a bug in an earlier pass.
    pub fn new(func: &Func, layout: &Layout, pool_len: usize) -> Grouped {
        let expanded = func.has_elementary_functions().then(|| math::expand_short(func, &[Unary::Exp]));
        let func = expanded.as_ref().unwrap_or(func);
        verify(func, layout, pool_len, Stage::Lowered).unwrap_or_else(|fault| panic!("{fault}"));
        Grouped { size: layout.size(), pool_len, ..Grouped::of(func, |_| false) }
    }

    /// `is_invariant`: whether the operation with this index is evaluated only in [`begin`](Grouped::begin). Its operands
    /// must be too.
    fn of(func: &Func, is_invariant: impl Fn(usize) -> bool) -> Grouped {
        let (mut places, constants) = Places::of_constants(func);
        let once = places.group(func, &is_invariant);
        let each = places.group(func, |_| true);
        let place = |value: Value| Value(places.of(value));
        let ends = Func {
            name: func.name.clone(),
            ops: Vec::new(),
            stores: func.stores.iter().map(|(slot, value)| (*slot, place(*value))).collect(),
            writes: func.writes.iter().map(|write| write.map(place)).collect(),
            status: func.status.map(place),
        };
        Grouped { constants, once, each, ends, size: 0, pool_len: 0 }
    }

    /// Runs the function up to `count` times, until a status that is not 0, which it returns, or 0.
    ///
    /// # Panics
    /// If the block or the pool is too short.
    pub fn call(&self, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        assert!(block.len() >= self.size, "block of {} slots, {} needed", block.len(), self.size);
        assert!(pool.len() >= self.pool_len, "pool of {} numbers, {} needed", pool.len(), self.pool_len);
        let mut values = VALUES.take();
        values.resize(values.len().max(self.places()), 0);
        self.begin(block, pool, &mut values);
        let status = self.repeat(block, pool, &mut values, count);
        VALUES.set(values);
        status
    }

    /// Number of places.
    fn places(&self) -> usize {
        self.each.first + self.each.operands.len()
    }

    /// Evaluates constants and invariants.
    fn begin(&self, block: &[f64], pool: &[f64], values: &mut [u64]) {
        values[..self.constants.len()].copy_from_slice(&self.constants);
        self.once.run(block, pool, values);
    }

    /// Runs the function that has begun.
    fn repeat(&self, block: &mut [f64], pool: &[f64], values: &mut [u64], count: u64) -> u64 {
        /// Compiled with the processor's instructions for fused products and for rounding to integers. Without them each is
        /// a call of a library, and these calls take most of the time.
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "fma,sse4.1")]
        fn with_fma(of: &Grouped, block: &mut [f64], pool: &[f64], values: &mut [u64], count: u64) -> u64 {
            until_status(count, || of.run(block, pool, values))
        }
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("fma") && is_x86_feature_detected!("sse4.1") {
            // SAFETY: the processor has just been asked for both.
            return unsafe { with_fma(self, block, pool, values, count) };
        }
        until_status(count, || self.run(block, pool, values))
    }

    /// Runs it once and returns its status.
    #[inline(always)]
    fn run(&self, block: &mut [f64], pool: &[f64], values: &mut [u64]) -> u64 {
        self.each.run(block, pool, values);
        results(&self.ends, &mut [block], values.as_chunks::<1>().0);
        self.ends.status.map_or(0, |place| values[place.index()])
    }
}

/// Runs an expanded function up to `count` times, whatever its status, until `look` breaks, which sees the block after
/// each time.
pub fn run_while(
    func: &Func,
    block: &mut [f64],
    pool: &[f64],
    count: usize,
    mut look: impl FnMut(&[f64]) -> ControlFlow<()>,
) {
    let variance = variance(func, None);
    let grouped = Grouped::of(func, |i| variance[i].is_invariant());
    let mut values = vec![0; grouped.places()];
    grouped.begin(block, pool, &mut values);
    for _ in 0..count {
        grouped.repeat(block, pool, &mut values, 1);
        if look(block).is_break() {
            return;
        }
    }
}

impl Groups {
    #[inline(always)]
    fn run(&self, block: &[f64], pool: &[f64], values: &mut [u64]) {
        let values = &mut values[..self.first + self.operands.len()];
        let (mut first, mut rest) = (self.first, &self.operands[..]);
        for (kind, len) in &self.kinds {
            let (operands, later) = rest.split_at(*len);
            let mut group = Group { operands, first, values };
            let entry = |base: u32, len: u32, index: u64| base as usize + index.min(u64::from(len) - 1) as usize;
            match kind {
                Op::Load(_) => group.each(|[slot, ..], _| block[slot as usize].to_bits()),
                Op::Pool { .. } => {
                    group.each(|[index, base, len], known| pool[entry(base, len, known.of(index))].to_bits())
                }
                Op::Ring { .. } => {
                    group.each(|[index, base, len], known| block[entry(base, len, known.of(index))].to_bits())
                }
                Op::Unary(Unary::Exp, a) => group.one(*a, |a| exp_of(f64::from_bits(a)).to_bits()),
                kind => apply(*kind, &mut group).expect("other functions are expanded, constants have their places"),
            }
            (first, rest) = (first + len, later);
        }
    }
}

/// A group that is to be evaluated: its operands and the place of its first result.
struct Group<'a> {
    operands: &'a [[u32; 3]],
    first: usize,
    values: &'a mut [u64],
}

impl Group<'_> {
    /// Computes the group. `result` gets what an operation reads, as in [`Groups::operands`], and the values known so far.
    #[inline(always)]
    fn each(&mut self, result: impl Fn([u32; 3], Known) -> u64) {
        for (k, operands) in self.operands.iter().enumerate() {
            self.values[self.first + k] = result(*operands, Known(self.values));
        }
    }
}

/// The values of a function, by their places.
#[derive(Clone, Copy)]
struct Known<'a>(&'a [u64]);

impl Known<'_> {
    #[inline(always)]
    fn of(self, place: u32) -> u64 {
        self.0[place as usize]
    }
}

impl Operands for &mut Group<'_> {
    type Results = ();

    #[inline(always)]
    fn one(self, _: Value, meaning: impl Fn(u64) -> u64) {
        self.each(|[a, ..], known| meaning(known.of(a)));
    }

    #[inline(always)]
    fn two(self, _: [Value; 2], meaning: impl Fn(u64, u64) -> u64) {
        self.each(|[a, b, _], known| meaning(known.of(a), known.of(b)));
    }

    #[inline(always)]
    fn three(self, _: [Value; 3], meaning: impl Fn(u64, u64, u64) -> u64) {
        self.each(|[a, b, c], known| meaning(known.of(a), known.of(b), known.of(c)));
    }
}

/// The places that values have got so far.
struct Places {
    of_ops: Vec<u32>,
    /// For each operation the one whose bits it has: conversions between a real and its bits change nothing.
    same_as: Vec<u32>,
    next: usize,
}

impl Places {
    /// Gives places to the constants; returns their bits too.
    fn of_constants(func: &Func) -> (Places, Vec<u64>) {
        let (mut of_ops, mut same_as) = (vec![NOWHERE; func.ops.len()], Vec::with_capacity(func.ops.len()));
        let mut constants = Vec::new();
        for (i, op) in func.ops.iter().enumerate() {
            let constant = match *op {
                Op::Real(bits) => Some(bits),
                Op::Int(number) => Some(number as u64),
                Op::Bool(truth) => Some(truth.into()),
                _ => None,
            };
            if let Some(bits) = constant {
                of_ops[i] = constants.len() as u32;
                constants.push(bits);
            }
            same_as.push(match op {
                Op::ToBits(a) | Op::FromBits(a) => same_as[a.index()],
                _ => i as u32,
            });
        }
        let next = constants.len();
        (Places { of_ops, same_as, next }, constants)
    }

    /// The operation that computes the bits of a value.
    fn source(&self, value: Value) -> usize {
        self.same_as[value.index()] as usize
    }

    fn of(&self, value: Value) -> u32 {
        self.of_ops[self.source(value)]
    }

    /// Puts those operations into groups that are in none yet, if `is_wanted`: time after time all of one kind whose operands
    /// are known, preferably one with an operation that begins a long path of operations that need it.
    fn group(&mut self, func: &Func, is_wanted: impl Fn(usize) -> bool) -> Groups {
        let count = func.ops.len();
        let wanted: Vec<usize> = (0..count)
            .filter(|i| self.of_ops[*i] == NOWHERE && self.same_as[*i] as usize == *i && is_wanted(*i))
            .collect();
        let mut ready = Ready::default();
        // For each operation the number of operands that are not known, the longest path, and the last of its users; each
        // user with the number of the next one.
        let (mut missing, mut path, mut last) = (vec![0_u32; count], vec![0_u32; count], vec![NOWHERE; count]);
        let mut users: Vec<(u32, u32)> = Vec::with_capacity(2 * wanted.len());
        for i in wanted.iter().rev() {
            func.ops[*i].each_operand(|operand| {
                let source = self.source(operand);
                path[source] = path[source].max(path[*i] + 1);
                if self.of_ops[source] == NOWHERE {
                    missing[*i] += 1;
                    users.push((*i as u32, last[source]));
                    last[source] = users.len() as u32 - 1;
                }
            });
        }
        for i in &wanted {
            if missing[*i] == 0 {
                ready.add(*i, func.ops[*i], path[*i]);
            }
        }
        let mut groups = Groups { kinds: Vec::new(), operands: Vec::with_capacity(wanted.len()), first: self.next };
        while let Some((kind, group)) = ready.take() {
            groups.kinds.push((kind, group.len()));
            for i in group {
                groups.operands.push(self.operands(func.ops[i]));
                self.of_ops[i] = self.next as u32;
                self.next += 1;
                let user_at = |number: u32| users.get(number as usize).copied();
                for (user, _) in std::iter::successors(user_at(last[i]), |(_, next)| user_at(*next)) {
                    let user = user as usize;
                    missing[user] -= 1;
                    if missing[user] == 0 {
                        ready.add(user, func.ops[user], path[user]);
                    }
                }
            }
        }
        groups
    }

    /// What an operation reads, as in [`Groups::operands`].
    fn operands(&self, op: Op) -> [u32; 3] {
        match op {
            Op::Load(slot) => [slot.0, 0, 0],
            Op::Pool { base, len, index } => [self.of(index), base, len],
            Op::Ring { base, len, index } => [self.of(index), base.0, len],
            op => {
                let (mut places, mut n) = ([0; 3], 0);
                op.each_operand(|operand| {
                    places[n] = self.of(operand);
                    n += 1;
                });
                places
            }
        }
    }
}

/// Operations whose operands are known, by kind.
#[derive(Default)]
struct Ready {
    kinds: Vec<ReadyKind>,
    /// The number of each kind.
    numbers: HashMap<Op, usize>,
}

struct ReadyKind {
    kind: Op,
    ops: Vec<usize>,
    /// The longest path that begins at one of them.
    path: u32,
}

impl Ready {
    fn add(&mut self, i: usize, op: Op, path: u32) {
        // Without what is different for each operation of the kind.
        let kind = match op {
            Op::Load(_) => Op::Load(Slot(0)),
            Op::Pool { .. } => Op::Pool { base: 0, len: 1, index: Value(0) },
            Op::Ring { .. } => Op::Ring { base: Slot(0), len: 1, index: Value(0) },
            op => op.map(|_| Value(0)),
        };
        let number = *self.numbers.entry(kind).or_insert(self.kinds.len());
        if number == self.kinds.len() {
            self.kinds.push(ReadyKind { kind, ops: Vec::new(), path: 0 });
        }
        let of_kind = &mut self.kinds[number];
        of_kind.ops.push(i);
        of_kind.path = of_kind.path.max(path);
    }

    /// Takes the operations of a kind, one that many others wait for or of which many are known; none if there are no
    /// operations.
    fn take(&mut self) -> Option<(Op, Vec<usize>)> {
        let kinds = self.kinds.iter_mut().filter(|kind| !kind.ops.is_empty());
        let most = kinds.max_by_key(|kind| kind.path as usize + kind.ops.len())?;
        most.path = 0;
        Some((most.kind, std::mem::take(&mut most.ops)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codegen::elementary::ElementaryFunction;
    use crate::ir::interpret::{Interpreter, run_once};
    use crate::ir::random::{self, Random};
    use abi::Function;
    use abi::table::Interpret;

    fn bits(block: &[f64]) -> Vec<u64> {
        block.iter().map(|x| if x.is_nan() { 1 } else { x.to_bits() }).collect()
    }

    /// Random functions end with the block and the status of the reference, in one call or step by step with a look at each.
    /// Mutants that fail: a group of operations that is not closed before the first user; operands of a subtraction swapped;
    /// an invariant that is loaded from a stored slot; the status of the last run in place of the first that is not 0.
    #[test]
    fn groups_have_the_bits_of_the_reference() {
        let (mut stopped, mut invariant, mut groups, mut operations) = (0, 0, 0, 0);
        for seed in 0..600 {
            let mut random = Random(seed);
            let len = 20 + random.below(200);
            let func = random::func(&mut random, len);
            let pool: Vec<f64> = (0..random::POOL_LEN).map(|_| random.real()).collect();
            let start: Vec<f64> = (0..random::layout().size()).map(|_| random.real()).collect();
            let count = 1 + random.below(5) as u64;
            let (mut expected, mut found) = (start.clone(), start.clone());
            let reference = Interpreter::new(&[(Function::Step, func.clone())], &random::layout(), pool.len());
            let status = reference.call(Function::Step, &mut expected, &pool, count);
            let grouped = Grouped::new(&func, &random::layout(), pool.len());
            assert_eq!(grouped.call(&mut found, &pool, count), status, "seed {seed}\n{func}");
            assert_eq!(bits(&found), bits(&expected), "seed {seed}\n{func}");
            let (mut expected, mut found, mut looks) = (start.clone(), start, 0);
            run_while(&func, &mut found, &pool, 8, |block| {
                run_once(&func, &mut expected, &pool);
                assert_eq!(bits(block), bits(&expected), "seed {seed}, look {looks}\n{func}");
                looks += 1;
                if looks > count { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            });
            assert_eq!((looks, bits(&found)), (count + 1, bits(&expected)), "seed {seed}");
            let variance = variance(&func, None);
            stopped += u64::from(status != 0);
            invariant += Grouped::of(&func, |i| variance[i].is_invariant()).once.operands.len();
            groups += grouped.each.kinds.len();
            operations += grouped.each.operands.len();
        }
        println!("{operations} operations in {groups} groups, {invariant} invariant, {stopped} runs with a status");
        assert!(4 * groups < 3 * operations && invariant > 5000 && stopped > 50);
    }

    /// A mutant without the other scales near overflow and underflow fails at the first number beyond 707.
    #[test]
    fn an_exponential_has_the_bits_of_its_expansion() {
        let (expansion, mut random) = (ElementaryFunction::unary(Unary::Exp), Random(1));
        let near = |random: &mut Random, x: f64| x + random.within(-1e-9, 1e-9);
        for case in 0..300_000 {
            let x = match case % 4 {
                0 => f64::from_bits(random.bits()),
                1 => random.real(),
                2 => random.within(-760.0, 760.0),
                _ => {
                    let edges = [707.0, -707.0, 709.78, 745.0, -745.13, -746.0, 0.0];
                    let edge = edges[random.below(edges.len())];
                    near(&mut random, edge)
                }
            };
            assert_eq!(bits(&[exp_of(x)]), bits(&[expansion.at(x)]), "case {case}: exp({x:e})");
        }
    }
}
