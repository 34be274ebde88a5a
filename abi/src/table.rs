//! The functions of a compiled model, behind one door, whatever made them.

use crate::ahead::Ahead;
use crate::description::Slot;
use std::any::Any;
use std::sync::Arc;

/// The functions of a model. Each reads and writes the block only, and neither allocates nor calls anything.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub enum Function {
    /// Parameters and inputs → states, memory, regimes at t = 0, sampled blocks that are due at 0 included.
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
    /// One transition per automaton, events and their resets; remembers for crossings.
    Transitions,
    /// One fixed step with all that belongs to it: states, count, time where the model reads it, ticks, transitions, outputs,
    /// guards.
    Step,
    /// Up to `count` adaptive steps, tried and as far as possible settled: see [`trial`](crate::rosenbrock::layout).
    Rosenbrock,
}

impl Function {
    /// All of them, in order.
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

    /// Its name in listings.
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

/// Machine code of one function: runs it up to `count` times on the block and stops early at the first non-zero
/// status, which it returns (0: none). `pool` is the description's pool of constants. A call for one fixed step may leave the
/// count of steps where nothing that it computes hangs on it, and any leaves time where no equation reads it: whoever calls
/// keeps these, with [`keep_clock`].
pub type Entry = unsafe extern "C" fn(block: *mut f64, pool: *const f64, count: u64) -> u64;

/// The count and time behind a call for `count` fixed steps, at least one, into the block: how many were done, code tells if
/// it was asked for more than one. `before` is the count before the call.
pub fn keep_clock(block: &mut [f64], before: f64, count: u64) {
    if count == 1 {
        block[Slot::COUNT.index()] = before + 1.0;
    }
    keep_time(block);
}

/// Time behind fixed steps, into the block: the count times the step.
pub fn keep_time(block: &mut [f64]) {
    block[Slot::TIME.index()] = block[Slot::COUNT.index()] * block[Slot::STEP.index()];
}

/// Machine code of one fixed step of which what hangs on parameters and the length of the step alone is computed beforehand:
/// so many numbers behind the block.
#[derive(Clone, Copy)]
pub struct Prepared {
    /// Writes these numbers, whatever the count; none if there are none.
    pub prepare: Option<Entry>,
    /// One step, on a block whose numbers were written since a parameter or the length of the step changed; the count is 1. It
    /// returns the status.
    pub step: Entry,
    /// How many they are.
    pub len: usize,
}

/// Code that is interpreted, made late, or written by hand in tests.
pub trait Interpret: Send + Sync {
    /// As [`Entry`], on a block of the description's size.
    fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64;
    /// Whether the function is there.
    fn has(&self, function: Function) -> bool;
    /// Machine code of the function, if by now there is such.
    fn made(&self, _: Function) -> Option<&Machine> {
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

/// Entries of machine code, and whatever keeps their memory alive.
#[derive(Clone)]
pub struct Machine {
    entries: [Option<Entry>; Function::ALL.len()],
    size: usize,
    pool_len: usize,
    /// The step again, in two parts.
    ahead: Option<Arc<Ahead>>,
    /// The step again, one at a time.
    prepared: Option<Prepared>,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Machine {
    /// Entries in the order of [`Function::ALL`] that work on blocks of `size` slots with a pool of `pool_len` numbers.
    ///
    /// # Safety
    /// Each entry must be valid as long as `memory` lives, must access only `block[..size]` and `pool[..pool_len]`
    /// and must not unwind.
    pub unsafe fn new(
        entries: [Option<Entry>; Function::ALL.len()],
        size: usize,
        pool_len: usize,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Machine {
        Machine { entries, size, pool_len, ahead: None, prepared: None, _memory: memory }
    }

    /// The same, which takes many steps in two parts.
    ///
    /// # Safety
    /// The parts must give the bits of the step that is there, and work on the same block and pool.
    pub unsafe fn with_ahead(self, ahead: Ahead) -> Machine {
        Machine { ahead: Some(Arc::new(ahead)), ..self }
    }

    /// The same, which takes a single step where that is prepared.
    ///
    /// # Safety
    /// It must give the bits of the step that is there, access only the block, so many numbers behind it and the pool,
    /// be valid as long as the memory of this lives, and not unwind.
    pub unsafe fn with_prepared(self, prepared: Prepared) -> Machine {
        Machine { prepared: Some(prepared), ..self }
    }

    /// Whether many steps are taken in two parts.
    pub fn goes_ahead(&self) -> bool {
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
        // SAFETY: `Machine::new` was promised that entries access only the lengths just checked.
        unsafe { entry(block.as_mut_ptr(), pool.as_ptr(), left) }
    }

    /// Its single step that is prepared, if it has one.
    pub fn prepared(&self) -> Option<Prepared> {
        self.prepared
    }

    /// One fixed step on a block with the numbers of [`Prepared`] behind it, which are written before unless they are `there`;
    /// none if the code has no such step.
    pub fn step_prepared(&self, block: &mut [f64], pool: &[f64], there: bool) -> Option<u64> {
        let Prepared { prepare, step, len } = self.prepared?;
        self.check(block, pool, len);
        if let Some(prepare) = prepare.filter(|_| !there) {
            // SAFETY: `with_prepared` was promised that it accesses only the lengths just checked.
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
    /// Whether the function is there.
    pub fn has(&self, function: Function) -> bool {
        match self {
            Code::Machine(machine) => machine.entries[function as usize].is_some(),
            Code::Interpreted(code) => code.has(function),
        }
    }

    /// The entry of a function, for whoever calls it himself; none if there is no machine code of it.
    pub fn entry(&self, function: Function) -> Option<Entry> {
        match self {
            Code::Machine(machine) => machine.entries[function as usize],
            Code::Interpreted(_) => None,
        }
    }

    /// Machine code of a function, if by now there is such.
    pub fn made(&self, function: Function) -> Option<&Machine> {
        match self {
            Code::Machine(machine) => Some(machine),
            Code::Interpreted(code) => code.made(function),
        }
    }

    /// Runs a function up to `count` times; see [`Entry`].
    ///
    /// # Panics
    /// If the function is not there, or block or pool are shorter than the code needs: mistakes of the caller.
    pub fn call(&self, function: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        match self {
            Code::Machine(machine) => machine.call(function, block, pool, count),
            Code::Interpreted(code) => code.call(function, block, pool, count),
        }
    }
}
