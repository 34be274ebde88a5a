//! The reference interpreter: runs expanded functions operation by operation and checks every access.
//!
//! In: functions, a block and a pool of constants. Out: the changed block and the status. Every back end must agree
//! with it to the bit.

use crate::ir::cfg::{Area, BlockId, Cfg, Count, Inst, Place, Terminator};
use crate::ir::eval::{evaluate, evaluate_each};
use crate::ir::hash::HashMap;
use crate::ir::variance::{Slots, Variance, of_ops};
use crate::ir::verify::{Stage, verify};
use crate::ir::{Func, Op, Value};
use abi::table::Interpret;
use abi::{Function, Layout, Slot};
use std::array::from_fn;
use std::cell::Cell;
use std::ops::Deref;

thread_local! {
    /// Scratch space for the values of a function, kept from call to call.
    static VALUES: Cell<Vec<u64>> = const { Cell::new(Vec::new()) };
}

/// The functions of a model, ready to be interpreted.
#[derive(Clone, Default)]
pub struct Interpreter {
    funcs: [Option<Func>; Function::ALL.len()],
    size: usize,
    pool_len: usize,
}

impl Interpreter {
    /// Takes the functions of a model. `layout`: the block they work on. `pool_len`: the number of constants they may
    /// read.
    ///
    /// # Panics
    /// If a function does not verify or has unexpanded elementary functions: a bug in an earlier pass.
    pub fn new(funcs: &[(Function, Func)], layout: &Layout, pool_len: usize) -> Interpreter {
        let mut interpreter = Interpreter { size: layout.size(), pool_len, ..Interpreter::default() };
        for (function, func) in funcs {
            verify(func, layout, pool_len, Stage::Expanded).unwrap_or_else(|fault| panic!("{fault}"));
            interpreter.funcs[*function as usize] = Some(func.clone());
        }
        interpreter
    }
}

impl Interpret for Interpreter {
    fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        assert!(block.len() >= self.size, "block of {} slots, {} needed", block.len(), self.size);
        assert!(pool.len() >= self.pool_len, "pool of {} numbers, {} needed", pool.len(), self.pool_len);
        let func = self.funcs[function as usize]
            .as_ref()
            .unwrap_or_else(|| panic!("the code has no function `{}`", function.name()));
        let mut values = VALUES.take();
        values.resize(func.ops.len(), 0);
        let status = repeat(func, block, pool, &mut values, count);
        VALUES.set(values);
        status
    }

    fn has(&self, function: Function) -> bool {
        self.funcs[function as usize].is_some()
    }
}

/// Runs an expanded function once and returns its status. The block may have any size that holds all slots in use.
pub fn run_once(func: &Func, block: &mut [f64], pool: &[f64]) -> u64 {
    repeat(func, block, pool, &mut vec![0; func.ops.len()], 1)
}

/// Runs an expanded function `times` times on each of some blocks. They end as [`run_once`] would leave them. Operations
/// whose slots are equal in all blocks are evaluated once.
pub fn run_each<B: AsMut<[f64]> + AsRef<[f64]>>(func: &Func, blocks: &mut [B], pool: &[f64], times: usize) {
    let Some((first, others)) = blocks.split_first() else { return };
    let differs = |slot: Slot| {
        let bits = |block: &B| block.as_ref()[slot.index()].to_bits();
        others.iter().any(|other| bits(other) != bits(first))
    };
    // What is evaluated once anyway need not be found.
    let is_single = times == 1 && others.len() < AT_ONCE;
    let mut residual =
        if is_single { Residual::whole(func) } else { Residual::new(func, first.as_ref(), pool, differs) };
    for some in blocks.chunks_mut(AT_ONCE) {
        let mut some: Vec<&mut [f64]> = some.iter_mut().map(AsMut::as_mut).collect();
        for _ in 0..times {
            residual.run(&mut some, pool);
        }
    }
}

/// Number of blocks that [`run_each`] advances at once: the processor decodes an operation once for all of them, and
/// their numbers fill vectors.
const AT_ONCE: usize = 8;

/// A function whose invariant operations have been evaluated, for runs on several blocks at once.
struct Residual<'f> {
    func: &'f Func,
    /// Indices of the other operations.
    rest: Vec<usize>,
    values: Vec<[u64; AT_ONCE]>,
}

impl<'f> Residual<'f> {
    /// `block`: any of the blocks; `differs`: whether they differ in a slot before the first run.
    fn new(func: &'f Func, block: &[f64], pool: &[f64], differs: impl Fn(Slot) -> bool) -> Residual<'f> {
        let slots = Slots::new(func.stores.iter().map(|(slot, _)| *slot), None);
        let at_least = |i: usize| match func.ops[i] {
            Op::Load(slot) if differs(slot) => Variance::State,
            _ => Variance::Parameters,
        };
        let variance = of_ops(&func.ops, &slots, at_least);
        let (once, rest): (Vec<usize>, Vec<usize>) = (0..func.ops.len()).partition(|i| variance[*i].is_invariant());
        let mut values = vec![[0; AT_ONCE]; func.ops.len()];
        operations(func, once.into_iter(), &[block], pool, &mut values);
        Residual { func, rest, values }
    }

    /// Without invariants.
    fn whole(func: &'f Func) -> Residual<'f> {
        Residual { func, rest: (0..func.ops.len()).collect(), values: vec![[0; AT_ONCE]; func.ops.len()] }
    }

    /// Runs the function once on each block: at most [`AT_ONCE`].
    fn run(&mut self, blocks: &mut [&mut [f64]], pool: &[f64]) {
        /// The same with instructions for fused products, for rounding to integers and for vectors.
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "fma,avx2")]
        fn with_vectors(of: &mut Residual, blocks: &mut [&mut [f64]], pool: &[f64]) {
            of.all(blocks, pool);
        }
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("fma") && is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has just been asked for both.
            return unsafe { with_vectors(self, blocks, pool) };
        }
        self.all(blocks, pool);
    }

    #[inline(always)]
    fn all(&mut self, blocks: &mut [&mut [f64]], pool: &[f64]) {
        operations(self.func, self.rest.iter().copied(), blocks, pool, &mut self.values);
        results(self.func, blocks, &self.values);
    }
}

/// Runs a function up to `count` times, until a status that is not 0. `values` is scratch space for the bits of every
/// value.
fn repeat(func: &Func, block: &mut [f64], pool: &[f64], values: &mut [u64], count: u64) -> u64 {
    /// The same with the instructions for fused products and for rounding to integers, which are calls otherwise and
    /// then take most of the time.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "fma,sse4.1")]
    fn with_fma(func: &Func, block: &mut [f64], pool: &[f64], values: &mut [u64], count: u64) -> u64 {
        until_status(count, || run(func, block, pool, values))
    }
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("fma") && is_x86_feature_detected!("sse4.1") {
        // SAFETY: the processor has just been asked for both.
        return unsafe { with_fma(func, block, pool, values, count) };
    }
    until_status(count, || run(func, block, pool, values))
}

/// Runs up to `count` times; returns the first status that is not 0, or 0.
#[inline(always)]
pub(crate) fn until_status(count: u64, mut run: impl FnMut() -> u64) -> u64 {
    for _ in 0..count {
        let status = run();
        if status != 0 {
            return status;
        }
    }
    0
}

/// Runs a function once.
#[inline(always)]
fn run(func: &Func, block: &mut [f64], pool: &[f64], values: &mut [u64]) -> u64 {
    let (values, _) = values.as_chunks_mut::<1>();
    operations(func, 0..func.ops.len(), &[&*block], pool, values);
    results(func, &mut [block], values);
    func.status.map_or(0, |status| values[status.index()][0])
}

/// Evaluates some operations, in order, for as many blocks as there are, at most `N`; the last one stands for those that
/// are missing.
#[inline(always)]
fn operations<const N: usize>(
    func: &Func,
    which: impl Iterator<Item = usize>,
    blocks: &[impl Deref<Target = [f64]>],
    pool: &[f64],
    values: &mut [[u64; N]],
) {
    let block = |lane: usize| &*blocks[lane.min(blocks.len() - 1)];
    for i in which {
        let entry = |lane: usize, base: u32, len: u32, index: Value| {
            base as usize + values[index.index()][lane].min(u64::from(len) - 1) as usize
        };
        values[i] = match func.ops[i] {
            Op::Load(slot) => from_fn(|lane| block(lane)[slot.index()].to_bits()),
            Op::Pool { base, len, index } => from_fn(|lane| pool[entry(lane, base, len, index)].to_bits()),
            Op::Ring { base, len, index } => from_fn(|lane| block(lane)[entry(lane, base.0, len, index)].to_bits()),
            op => evaluate_each(op, |operand| values[operand.index()]).expect("elementary functions are expanded"),
        };
    }
}

/// Stores the results of a function.
#[inline(always)]
fn results<const N: usize>(func: &Func, blocks: &mut [&mut [f64]], values: &[[u64; N]]) {
    for (lane, block) in blocks.iter_mut().enumerate() {
        for (slot, value) in &func.stores {
            block[slot.index()] = f64::from_bits(values[value.index()][lane]);
        }
        for write in &func.writes {
            let index = values[write.index.index()][lane].min(u64::from(write.len) - 1);
            block[write.base.index() + index as usize] = f64::from_bits(values[write.value.index()][lane]);
        }
    }
}

/// Runs a graph for a number of iterations and returns its status: the reference for the passes over graphs. It has no
/// values of a leading loop.
///
/// # Panics
/// If a value is used before it is available: a mistake of a pass.
pub fn run_cfg(cfg: &Cfg, count: u64, block: &mut [f64], pool: &[f64]) -> u64 {
    let mut scratch = vec![0; cfg.scratch_len as usize];
    let mut graph = Graph { cfg, count, block, pool, scratch: &mut scratch };
    if count == 0 { 0 } else { graph.run(BlockId(0)) }
}

/// Runs the entry that computes values after the block, if the graph has one.
pub fn prepare_cfg(cfg: &Cfg, block: &mut [f64], pool: &[f64]) {
    if let Some(entry) = cfg.prepare {
        Graph { cfg, count: 1, block, pool, scratch: &mut [] }.run(entry);
    }
}

/// A graph that is being interpreted.
struct Graph<'a> {
    cfg: &'a Cfg,
    count: u64,
    block: &'a mut [f64],
    pool: &'a [f64],
    scratch: &'a mut [u64],
}

impl Graph<'_> {
    fn run(&mut self, entry: BlockId) -> u64 {
        let cfg = self.cfg;
        let (mut values, mut id): (HashMap<Value, u64>, BlockId) = (HashMap::default(), entry);
        // The repetition of the loop, from 0.
        let mut repetition = 0;
        loop {
            let block = &cfg.blocks[id.index()];
            for inst in &block.insts {
                match inst {
                    Inst::Compute(value) => _ = values.insert(*value, self.operation(cfg.op(*value), &values)),
                    Inst::Reload(value, place) => {
                        let at = Self::index(place, repetition);
                        let bits = match place.area {
                            Area::Block => self.block[at].to_bits(),
                            Area::Scratch => self.scratch[at],
                            Area::Leading => unreachable!("there is no leading loop"),
                            Area::Inputs | Area::Outputs => unreachable!("there are no rows"),
                        };
                        values.insert(*value, bits);
                    }
                    Inst::Store(place, value) => {
                        let (at, bits) = (Self::index(place, repetition), self.value(*value, &values));
                        match place.area {
                            Area::Block => self.block[at] = f64::from_bits(bits),
                            Area::Scratch => self.scratch[at] = bits,
                            Area::Leading => unreachable!("only the leading loop writes there"),
                            Area::Inputs | Area::Outputs => unreachable!("there are no rows"),
                        }
                    }
                    Inst::Write(write) => {
                        let index = self.value(write.index, &values).min(u64::from(write.len) - 1);
                        let bits = self.value(write.value, &values);
                        self.block[write.base.index() + index as usize] = f64::from_bits(bits);
                    }
                    Inst::Call(piece) => _ = self.run(cfg.pieces[*piece]),
                }
            }
            let next = match &block.end {
                Terminator::Jump(target) => target.clone(),
                Terminator::Branch { when, yes, no } => {
                    if self.value(*when, &values) == 0 {
                        no.clone()
                    } else {
                        yes.clone()
                    }
                }
                Terminator::Switch { slot, cases, default } => {
                    let held = self.block[slot.index()].to_bits();
                    cases.iter().find(|(bits, _)| *bits == held).map_or(*default, |(_, block)| *block).into()
                }
                Terminator::Repeat { count, again, done } => {
                    repetition += 1;
                    let all = if let Count::Fixed(all) = count { *all } else { self.count };
                    if repetition < all { again.clone() } else { done.clone() }
                }
                Terminator::Return(status) => return status.map_or(0, |status| self.value(status, &values)),
            };
            let args: Vec<u64> = next.args.iter().map(|arg| self.value(*arg, &values)).collect();
            values.extend(cfg.blocks[next.block.index()].params.iter().copied().zip(args));
            id = next.block;
        }
    }

    fn index(place: &Place, repetition: u64) -> usize {
        (i64::from(place.index) + place.stride * repetition as i64) as usize
    }

    fn value(&self, value: Value, values: &HashMap<Value, u64>) -> u64 {
        match values.get(&value) {
            Some(bits) => *bits,
            None if self.cfg.is_free(value) => self.operation(self.cfg.op(value), values),
            None => panic!("{value} is not available\n{}", self.cfg),
        }
    }

    fn operation(&self, op: Op, values: &HashMap<Value, u64>) -> u64 {
        let entry = |base: u32, len: u32, index: Value| {
            let index = self.value(index, values).min(u64::from(len) - 1);
            base as usize + index as usize
        };
        match op {
            Op::Load(slot) => self.block[slot.index()].to_bits(),
            Op::Pool { base, len, index } => self.pool[entry(base, len, index)].to_bits(),
            Op::Ring { base, len, index } => self.block[entry(base.0, len, index)].to_bits(),
            // The bits of a table entry are read directly.
            Op::ToBits(table) if let entry @ Op::Pool { .. } = self.cfg.op(table) => self.operation(entry, values),
            op => evaluate(op, |operand| self.value(operand, values)).expect("elementary functions are expanded"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use crate::ir::random::{self, Random};

    /// Random functions, on blocks that differ in every third slot, leave what running them once after the other leaves.
    #[test]
    fn blocks_at_once_end_as_each_alone() {
        let mut invariant = 0;
        for seed in 0..400 {
            let mut random = Random(seed);
            let len = 20 + random.below(80);
            let func = random::func(&mut random, len);
            let pool: Vec<f64> = (0..random::POOL_LEN).map(|_| random.real()).collect();
            let start: Vec<f64> = (0..random::layout().size()).map(|_| random.real()).collect();
            let (count, times) = (1 + random.below(2 * AT_ONCE), random.below(4));
            let mut blocks = vec![start.clone(); count];
            for block in &mut blocks {
                block.iter_mut().skip(seed as usize % 3).step_by(3).for_each(|x| *x = random.real());
            }
            let mut expected = blocks.clone();
            for block in &mut expected {
                (0..times).for_each(|_| _ = run_once(&func, block, &pool));
            }
            run_each(&func, &mut blocks, &pool, times);
            let bits = |block: &Vec<f64>| block.iter().map(|x| if x.is_nan() { 1 } else { x.to_bits() }).collect();
            let [blocks, expected]: [Vec<Vec<u64>>; 2] = [blocks, expected].map(|all| all.iter().map(bits).collect());
            assert_eq!(blocks, expected, "seed {seed}\n{func}");
            let residual = Residual::new(&func, &start, &pool, |slot| slot.0 % 3 == 0);
            invariant += func.ops.len() - residual.rest.len();
        }
        assert!(invariant > 2000, "{invariant}");
    }

    #[test]
    fn loads_come_first_stores_last_and_a_status_stops() {
        let layout = Layout::new([0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
        let (a, b) = (layout.states.slot(0), layout.states.slot(1));
        let mut build = Build::new("swap");
        let (x, y) = (build.load(a), build.load(b));
        let one = build.real(1.0);
        let next = build.add(x, one);
        build.store(b, next);
        build.store(a, y);
        let limit = build.real(3.0);
        let over = build.less(limit, y);
        let (zero, code) = (build.int(0), build.int(7));
        let status = build.select(over, code, zero);
        build.status(status);
        let code = Interpreter::new(&[(Function::Step, build.finish())], &layout, 0);
        let mut block = vec![0.0, 0.0, 0.0, 1.0, 2.0];
        assert_eq!(code.call(Function::Step, &mut block, &[], 3), 0);
        assert_eq!(block[3..], [3.0, 3.0]);
        assert_eq!(code.call(Function::Step, &mut block, &[], 100), 7);
        assert_eq!(block[a.index()..=b.index()], [4.0, 4.0]);
    }
}
