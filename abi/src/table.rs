//! The functions of a compiled model, behind one interface for machine code and interpreters.

use crate::description::Slot;
use crate::distributed_step::DistributedStep;
use crate::follow::Follow;
use std::any::Any;
use std::sync::Arc;

/// The functions of a model. Each reads and writes only the block, and neither allocates nor calls anything.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub enum Function {
    /// Parameters and inputs → states, memory and regimes at t = 0, including the sampled blocks that are due at 0.
    Start,
    /// → outputs.
    Outputs,
    /// → derivatives.
    Derivatives,
    /// → jacobian.
    Jacobian,
    /// → roots.
    Roots,
    /// Runs the sampled blocks that are `due`.
    Tick,
    /// At most one transition per automaton, then events and their resets; also stores the memory of crossings.
    Transitions,
    /// One complete fixed step: states, count, time (if the model reads it), ticks, transitions, outputs, guards.
    Step,
    /// Up to `count` trials of adaptive steps, accepted or rejected as far as possible: see
    /// [`trial`](crate::rosenbrock::layout).
    Rosenbrock,
}

impl Function {
    /// All functions, in order.
    pub const ALL: [Function; 9] = [
        Function::Start,
        Function::Outputs,
        Function::Derivatives,
        Function::Jacobian,
        Function::Roots,
        Function::Tick,
        Function::Transitions,
        Function::Step,
        Function::Rosenbrock,
    ];

    /// The name in listings.
    pub fn name(self) -> &'static str {
        match self {
            Function::Start => "start",
            Function::Outputs => "outputs",
            Function::Derivatives => "derivatives",
            Function::Jacobian => "jacobian",
            Function::Roots => "roots",
            Function::Tick => "tick",
            Function::Transitions => "transitions",
            Function::Step => "step",
            Function::Rosenbrock => "rosenbrock",
        }
    }
}

compiled! {
    /// Machine code of one function: runs it up to `count` times on the block, stops at the first non-zero status and
    /// returns it (0: none). `pool`: the description's pool of constants. A call for one fixed step need not store the step
    /// count if nothing else depends on it, and no call need store time if no equation reads it. The caller stores these
    /// with [`keep_clock`].
    pub type Entry = fn(block: *mut f64, pool: *const f64, count: u64);
}

/// Stores the step count and time after a call for `count` fixed steps, at least one. The code itself has stored the
/// count if it was called for more than one step. `before`: the count before the call.
pub fn keep_clock(block: &mut [f64], before: f64, count: u64) {
    if count == 1 {
        block[Slot::COUNT.index()] = before + 1.0;
    }
    keep_time(block);
}

/// Stores time after fixed steps: count times step length.
pub fn keep_time(block: &mut [f64]) {
    block[Slot::TIME.index()] = block[Slot::COUNT.index()] * block[Slot::STEP.index()];
}

/// Machine code of one fixed step from which the expressions of parameters and step length are hoisted. Their values
/// are stored after the block.
#[derive(Clone, Copy)]
pub struct Prepared {
    /// Computes the hoisted values, whatever the count; `None` if there are none.
    pub prepare: Option<Entry>,
    /// One step, and its status; the count must be 1. The hoisted values must have been computed since a parameter or
    /// the step length last changed.
    pub step: Entry,
    /// Number of hoisted values.
    pub len: usize,
}

/// Code that is interpreted, compiled lazily, or written by hand in tests.
pub trait Interpret: Send + Sync {
    /// As [`Entry`], on a block of the description's size.
    fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64;
    /// Whether the function exists.
    fn has(&self, function: Function) -> bool;
    /// Machine code of the function, if it has been compiled by now.
    fn made(&self, _: Function) -> Option<&Machine> {
        None
    }
    /// The fixed step in a loop that writes these slots to a row after each step, without inputs from rows, if that has been
    /// compiled by now. It is compiled because it is asked for.
    fn recording(&self, _outputs: &[Slot]) -> Option<Arc<Follow>> {
        None
    }
}

/// The code of a model.
#[derive(Clone)]
pub enum Code {
    /// Machine code.
    Machine(Machine),
    /// Anything else.
    Interpreted(Arc<dyn Interpret>),
}

/// Entry points of machine code, and the owner of their memory.
#[derive(Clone)]
pub struct Machine {
    entries: [Option<Entry>; Function::ALL.len()],
    size: usize,
    pool_len: usize,
    /// The step again, as two distributed loops.
    ahead: Option<Arc<DistributedStep>>,
    /// The step again, as a single step with hoisted values.
    prepared: Option<Prepared>,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Machine {
    /// Entry points in the order of [`Function::ALL`], for blocks of `size` slots and a pool of `pool_len` numbers.
    ///
    /// # Safety
    /// Each entry must be valid as long as `memory` lives, must access only `block[..size]` and `pool[..pool_len]`, and
    /// must not unwind.
    pub unsafe fn new(
        entries: [Option<Entry>; Function::ALL.len()],
        size: usize,
        pool_len: usize,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Machine {
        Machine { entries, size, pool_len, ahead: None, prepared: None, _memory: memory }
    }

    /// The same code, which makes many steps with the distributed loops.
    ///
    /// # Safety
    /// They must compute the same bits as the existing step, and work on the same block and pool.
    pub unsafe fn with_distributed(self, ahead: DistributedStep) -> Machine {
        Machine { ahead: Some(Arc::new(ahead)), ..self }
    }

    /// The same code, which makes a single step with hoisted values.
    ///
    /// # Safety
    /// It must compute the same bits as the existing step, access only the block, the hoisted values after it and the
    /// pool, be valid as long as the memory of this code lives, and not unwind.
    pub unsafe fn with_prepared(self, prepared: Prepared) -> Machine {
        Machine { prepared: Some(prepared), ..self }
    }

    /// Whether many steps use distributed loops.
    pub fn is_distributed(&self) -> bool {
        self.ahead.is_some()
    }

    /// As [`Code::call`].
    pub fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        self.check(block, pool, 0);
        let entry =
            self.entries[function as usize].unwrap_or_else(|| panic!("the code has no function `{}`", function.name()));
        let mut left = count;
        if let Some(ahead) = &self.ahead
            && function == Function::Step
            && count >= ahead.pays()
        {
            // SAFETY: the lengths were just checked.
            let (done, status) = unsafe { ahead.advance(block, pool, count) };
            left -= done;
            if status != 0 {
                return status;
            }
        }
        // SAFETY: by the contract of `Machine::new`, entries access only the lengths just checked.
        unsafe { entry(block.as_mut_ptr(), pool.as_ptr(), left) }
    }

    /// The single step with hoisted values, if there is one.
    #[inline]
    pub fn prepared(&self) -> Option<Prepared> {
        self.prepared
    }

    /// One fixed step on a block followed by the values of [`Prepared`], and its status. `is_current`: the values need not
    /// be computed again. `None` if the code has no such step.
    #[inline]
    pub fn step_prepared(&self, block: &mut [f64], pool: &[f64], is_current: bool) -> Option<u64> {
        let Prepared { prepare, step, len } = self.prepared?;
        self.check(block, pool, len);
        if let Some(prepare) = prepare.filter(|_| !is_current) {
            // SAFETY: by the contract of `with_prepared`, it accesses only the lengths just checked.
            unsafe { prepare(block.as_mut_ptr(), pool.as_ptr(), 1) };
        }
        // SAFETY: as above.
        Some(unsafe { step(block.as_mut_ptr(), pool.as_ptr(), 1) })
    }

    fn check(&self, block: &[f64], pool: &[f64], more: usize) {
        let size = self.size + more;
        assert!(block.len() >= size, "block of {} slots, {size} needed", block.len());
        assert!(pool.len() >= self.pool_len, "pool of {} numbers, {} needed", pool.len(), self.pool_len);
    }
}

impl Code {
    /// Whether the function exists.
    pub fn has(&self, function: Function) -> bool {
        match self {
            Code::Machine(machine) => machine.entries[function as usize].is_some(),
            Code::Interpreted(code) => code.has(function),
        }
    }

    /// The entry point of a function, for direct calls; `None` if it is not machine code.
    pub fn entry(&self, function: Function) -> Option<Entry> {
        match self {
            Code::Machine(machine) => machine.entries[function as usize],
            Code::Interpreted(_) => None,
        }
    }

    /// Machine code of a function, if it has been compiled by now.
    #[inline]
    pub fn made(&self, function: Function) -> Option<&Machine> {
        match self {
            Code::Machine(machine) => Some(machine),
            Code::Interpreted(code) => code.made(function),
        }
    }

    /// Runs a function up to `count` times; see [`Entry`].
    ///
    /// # Panics
    /// If the function does not exist, or if block or pool are shorter than the code needs: a bug in the caller.
    pub fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        match self {
            Code::Machine(machine) => machine.call(function, block, pool, count),
            Code::Interpreted(code) => code.call(function, block, pool, count),
        }
    }
}
