//! Baseline code: a function for a single instance, by the code generator of lanes.
//!
//! It is made in a thirtieth of the time that Cranelift takes, because there are no optimisations: one pass selects
//! instructions, one orders them, one allocates registers and emits. An adaptive step takes 1.1 times as long as optimised
//! code; a fixed step takes 1.3 to 1.9 times as long, since no invariants are hoisted. So runs that end before Cranelift
//! is done have machine code too.
//!
//! In: a function, expanded or not. Out: code with the bits of [`ir::interpret`](crate::ir::interpret).
//!
//! ```text
//! scratch space: status | values of the slots that are stored and loaded, before the call | spilled values
//! ```
//!
//! Source of the idea: Arnold, Fink, Grove, Hind, Sweeney, *Adaptive Optimization in the Jalapeño JVM*, OOPSLA, 2000.

use super::assembler::{Assembler, Base, Vectors};
use super::isel::{MachineOp, NodeId, select};
use super::regalloc::{Home, RegisterAllocator, place_in};
use super::{by_node, expanded, schedule};
use crate::codegen::executable_memory::Executable;
use crate::codegen::target::here;
use crate::codegen::unsupported::Unsupported;
use crate::ir::Func;
use crate::ir::hash::HashSet;
use crate::ir::interpret::{run_once, until_status};
use crate::math;
use abi::lanes::BaselineEntry;
use abi::table::{Code, Interpret};
use abi::{Function, Layout, Slot};
use std::cell::{Cell, OnceCell};
use std::sync::Arc;

thread_local! {
    /// Scratch space, kept from call to call.
    static SCRATCH: Cell<Vec<u64>> = const { Cell::new(Vec::new()) };
}

/// Number of runs after which baseline code pays: interpreting takes 2 to 4 ns for an operation, and compiling 0.3 µs for an
/// operation and 10 µs for the function.
pub const PAYS_AFTER: u64 = 128;

/// A function as machine code for one instance.
pub struct Baseline {
    entry: BaselineEntry,
    size: usize,
    pool_len: usize,
    scratch: usize,
    _memory: Executable,
}

impl Baseline {
    /// Compiles a function, expanded or not, for this processor. `layout`: the block it works on; `pool_len`: the number of
    /// constants that it may read.
    ///
    /// # Errors
    /// If the processor lacks AVX or FMA, or they have no instruction for an operation.
    ///
    /// # Panics
    /// If the function does not verify: a mistake of an earlier pass.
    pub fn new(func: &Func, layout: &Layout, pool_len: usize) -> Result<Baseline, Unsupported> {
        if !Baseline::is_here() {
            return Err(Unsupported("this processor lacks AVX and FMA".into()));
        }
        let (func, pooled) = expanded(func, layout, pool_len, math::expand);
        let (code, scratch) = generate(&func, pooled)?;
        // Code adds displacements of 32 bits to the block, the pool and the scratch space.
        if 8 * layout.size().max(pool_len).max(scratch) > i32::MAX as usize {
            return Err(Unsupported(format!("`{}` needs a block that is too large", func.name)));
        }
        let memory = Executable::new(&code, 64)?;
        // SAFETY: the address is the start of code with this signature.
        let entry = unsafe { std::mem::transmute::<*const u8, BaselineEntry>(memory.address()) };
        Ok(Baseline { entry, size: layout.size(), pool_len, scratch, _memory: memory })
    }

    /// Whether this processor has such code.
    pub fn is_here() -> bool {
        Vectors::Scalar.are_here() && here().is_ok()
    }

    /// Runs the function up to `count` times, until a status that is not 0, which it returns, or 0.
    ///
    /// # Panics
    /// If the block or the pool is too short.
    pub fn call(&self, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        assert!(block.len() >= self.size, "block of {} slots, {} needed", block.len(), self.size);
        assert!(pool.len() >= self.pool_len, "pool of {} numbers, {} needed", pool.len(), self.pool_len);
        let mut scratch = SCRATCH.take();
        scratch.resize(scratch.len().max(self.scratch), 0);
        let status = until_status(count, || {
            // SAFETY: `verify` has checked that each slot lies in the layout and each table in the pool; indices are clamped,
            // and `self.scratch` counts what the code needs.
            unsafe { (self.entry)(block.as_mut_ptr(), pool.as_ptr(), scratch.as_mut_ptr()) }
        });
        SCRATCH.set(scratch);
        status
    }
}

/// The functions of a model as baseline code.
///
/// # Errors
/// As [`Baseline::new`].
pub fn code(functions: &[(Function, Func)], layout: &Layout, pool_len: usize) -> Result<Code, Unsupported> {
    struct All([Option<Baseline>; Function::ALL.len()]);
    impl Interpret for All {
        fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
            let code = self.0[function as usize].as_ref();
            code.unwrap_or_else(|| panic!("the code has no function `{}`", function.name())).call(block, pool, count)
        }

        fn has(&self, function: Function) -> bool {
            self.0[function as usize].is_some()
        }
    }
    let mut all = All([const { None }; Function::ALL.len()]);
    for (function, func) in functions {
        all.0[*function as usize] = Some(Baseline::new(func, layout, pool_len)?);
    }
    Ok(Code::Interpreted(Arc::new(all)))
}

/// A function that is interpreted until it has run so often that baseline code pays.
pub struct Repeated {
    func: Func,
    runs: Cell<u64>,
    code: OnceCell<Option<Baseline>>,
}

impl Repeated {
    /// The function, expanded.
    pub fn new(func: Func) -> Repeated {
        Repeated { func, runs: Cell::default(), code: OnceCell::new() }
    }

    /// The function.
    pub fn func(&self) -> &Func {
        &self.func
    }

    /// Runs it once, whatever its status. `layout`: that of the block; the same in each call.
    ///
    /// # Panics
    /// As [`Baseline::new`] and [`Baseline::call`].
    pub fn run(&self, layout: &Layout, block: &mut [f64], pool: &[f64]) {
        self.runs.update(|runs| runs + 1);
        let code = (self.runs.get() > PAYS_AFTER)
            .then(|| self.code.get_or_init(|| Baseline::new(&self.func, layout, pool.len()).ok()).as_ref());
        match code.flatten() {
            Some(code) => code.call(block, pool, 1),
            None => run_once(&self.func, block, pool),
        };
    }
}

/// Generates the code, which must lie at a multiple of 64 bytes; also returns the length of its scratch space. `pooled`: the
/// pool begins with the tables of the elementary functions.
fn generate(func: &Func, pooled: bool) -> Result<(Vec<u8>, usize), Unsupported> {
    let nodes = select(func, Vectors::Scalar, pooled)?;
    let stored: HashSet<Slot> = nodes.stores.iter().map(|(slot, _)| *slot).collect();
    let mut homes: Vec<Option<Home>> = vec![None; nodes.nodes.len()];
    let mut code = Assembler::new(Vectors::Scalar);
    let mut scratch = 1;
    for (index, node) in nodes.nodes.iter().enumerate() {
        let MachineOp::Load(slot) = node else { continue };
        let in_block = Home { base: Base::Block, begin: 0, index: slot.index() };
        homes[index] = Some(in_block);
        // A result may be stored before its slot is loaded for the last time.
        if stored.contains(slot) {
            let kept = Home { base: Base::Scratch, begin: 0, index: scratch };
            let place = |home: Home| place_in(home.base, home.begin, home.index, 1, 0, Vectors::Scalar);
            code.copy(place(in_block), place(kept));
            homes[index] = Some(kept);
            scratch += 1;
        }
    }
    // All that is written is known before the first write.
    let written = nodes.writes.iter().flat_map(|write| nodes.nodes[write.index()].operands());
    let results: Vec<NodeId> = nodes.results().chain(written).chain(nodes.writes.iter().copied()).collect();
    let order = schedule::schedule(&nodes, &results, &vec![true; nodes.nodes.len()]);
    let spills_at = (Base::Scratch, 8 * scratch);
    let mut line = RegisterAllocator::new(&mut code, &nodes, &order, &homes, Vectors::Scalar, 1, spills_at);
    let home = |base, index| Home { base, begin: 0, index };
    let stores = nodes.stores.iter().map(|(slot, node)| (*node, home(Base::Block, slot.index())));
    let status = nodes.status.map(|node| (node, home(Base::Scratch, 0)));
    line.write(&by_node(stores.chain(status)), &results);
    scratch += line.spilled();
    match nodes.status {
        Some(_) => code.raw(&[0x48, 0x8b, 0x02]), // mov rax, [rdx]
        None => code.raw(&[0x31, 0xc0]),          // xor eax, eax
    }
    code.raw(&[0xc3]); // ret
    Ok((code.finish(), scratch))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Op;
    use crate::ir::interpret::Interpreter;
    use crate::ir::random::{self, Random};

    fn bits(block: &[f64]) -> Vec<u64> {
        block.iter().map(|x| if x.is_nan() { 1 } else { x.to_bits() }).collect()
    }

    /// Random functions end with the block and the status of the reference, in one call and one by one, compiled on the way.
    /// Mutants that fail: slots that are stored and loaded are not kept; a write before the last result is computed; spilled
    /// values without space; a register whose next use is not looked up again; the status of the last run in place of the
    /// first that is not 0; no status, so that the register has what was there before.
    #[test]
    fn baseline_code_has_the_bits_of_the_reference() {
        let (mut stopped, mut wrote, mut spilled) = (0, 0, 0);
        for seed in 0..if Baseline::is_here() { 600 } else { 0 } {
            let mut random = Random(seed);
            let len = 20 + random.below(200);
            let func = random::func(&mut random, len);
            let pool: Vec<f64> = (0..random::POOL_LEN).map(|_| random.real()).collect();
            let start: Vec<f64> = (0..random::layout().size()).map(|_| random.real()).collect();
            let count = 1 + random.below(5) as u64;
            let (mut expected, mut found) = (start.clone(), start.clone());
            let reference = Interpreter::new(&[(Function::Step, func.clone())], &random::layout(), pool.len());
            let status = reference.call(Function::Step, &mut expected, &pool, count);
            let code = Baseline::new(&func, &random::layout(), pool.len()).expect("each operation has code");
            assert_eq!(code.call(&mut found, &pool, count), status, "seed {seed}\n{func}");
            assert_eq!(bits(&found), bits(&expected), "seed {seed}\n{func}");
            let (mut expected, mut found) = (start.clone(), start);
            let repeated = Repeated::new(func.clone());
            repeated.runs.set(PAYS_AFTER - random.below(3) as u64);
            for k in 0..3 {
                repeated.run(&random::layout(), &mut found, &pool);
                run_once(&func, &mut expected, &pool);
                assert_eq!(bits(&found), bits(&expected), "seed {seed}, run {k}\n{func}");
            }
            stopped += u64::from(status != 0);
            wrote += func.writes.len();
            let loaded = func.stores.iter().filter(|(slot, _)| func.ops.contains(&Op::Load(*slot))).count();
            spilled += usize::from(code.scratch > 1 + loaded);
        }
        println!("{stopped} runs with a status, {wrote} writes, {spilled} functions with spilled values");
        assert!(!Baseline::is_here() || stopped > 50 && wrote > 50 && spilled > 50);
    }
}
