//! A fixed step in a loop over the rows of an array: each step reads its inputs from one row and writes its outputs to
//! a row of another array.
//!
//! In: an instance, rows of inputs. Out: rows of outputs, with the bits that a call for each step would leave. Chosen
//! inputs and outputs are compiled into the loop; without machine code each row is a call of the step.

use crate::description::{Layout, Slot};
use crate::distributed_step::DistributedFollow;
pub use crate::rows::{Rows, RowsMut};
use std::any::Any;
use std::sync::Arc;

compiled! {
    /// Machine code of the loop: up to `count` fixed steps, as the code of the step makes them. Step `i` has
    /// input `k` from `inputs[i · strides[0] + k]` instead of its slot, and writes output `k` to
    /// `outputs[i · strides[1] + k]`, also if its status is not 0. `strides` are in bytes. The slots of these inputs keep
    /// their values.
    pub type FollowEntry = fn(
        block: *mut f64,
        pool: *const f64,
        count: u64,
        inputs: *const f64,
        outputs: *mut f64,
        strides: *const i64
    );
}

/// Which inputs and outputs a loop reads and writes, and its code.
#[derive(Clone)]
pub struct Follow {
    inputs: Arc<[Slot]>,
    outputs: Arc<[Slot]>,
    code: Option<Code>,
}

/// Machine code of the loop.
#[derive(Clone)]
struct Code {
    entry: FollowEntry,
    size: usize,
    pool_len: usize,
    /// The loop again, in two parts.
    ahead: Option<Arc<DistributedFollow>>,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Follow {
    /// A loop that calls the step for each row. `outputs`: any slots that a step leaves, but not time and count, which the
    /// caller of a step stores.
    ///
    /// # Panics
    /// If an input is no input of this layout or is there twice, or an output is not in the block: a bug in the caller.
    pub fn new(layout: &Layout, inputs: &[Slot], outputs: &[Slot]) -> Follow {
        for (k, slot) in inputs.iter().enumerate() {
            assert!(layout.inputs.contains(*slot) && !inputs[..k].contains(slot), "slot {} as input {k}", slot.0);
        }
        for slot in outputs {
            assert!((Slot::FIXED as usize..layout.size()).contains(&slot.index()), "slot {} as an output", slot.0);
        }
        Follow { inputs: inputs.into(), outputs: outputs.into(), code: None }
    }

    /// The same with machine code, for blocks of `size` slots and a pool of `pool_len` numbers.
    ///
    /// # Safety
    /// The entry must make the steps of the instance, must be valid as long as `memory` lives, must access only
    /// `block[..size]`, `pool[..pool_len]`, and in each row as many numbers as this has inputs and outputs, and must not
    /// unwind.
    pub unsafe fn with_code(
        self,
        entry: FollowEntry,
        size: usize,
        pool_len: usize,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Follow {
        Follow { code: Some(Code { entry, size, pool_len, ahead: None, _memory: memory }), ..self }
    }

    /// The same with a loop in two parts besides, which computes ahead what depends on inputs and time alone.
    ///
    /// # Safety
    /// It must be the same loop, and valid as long as `memory` lives.
    ///
    /// # Panics
    /// If there is no other code, or there is no such column: a bug in the caller.
    pub unsafe fn with_distributed(self, ahead: DistributedFollow, memory: Arc<dyn Any + Send + Sync>) -> Follow {
        assert!(ahead.columns().iter().all(|column| *column < self.inputs.len()), "columns that there are");
        let code = self.code.expect("the code of the undivided loop");
        let memory = Arc::new((code._memory, memory));
        Follow { code: Some(Code { ahead: Some(Arc::new(ahead)), _memory: memory, ..code }), ..self }
    }

    /// The inputs, a column each.
    pub fn inputs(&self) -> &[Slot] {
        &self.inputs
    }

    /// The outputs, a column each.
    pub fn outputs(&self) -> &[Slot] {
        &self.outputs
    }

    /// Whether it has machine code.
    pub fn is_compiled(&self) -> bool {
        self.code.is_some()
    }

    /// Whether its code has two parts.
    pub fn is_distributed(&self) -> bool {
        self.code.as_ref().is_some_and(|code| code.ahead.is_some())
    }

    /// Checks that arrays have `count` rows.
    ///
    /// # Panics
    /// If they do not: a bug in the caller.
    pub(crate) fn check(&self, count: u64, inputs: &Rows, outputs: &RowsMut) {
        let count = usize::try_from(count).expect("a number of rows that fits into memory");
        let needed = |stride: usize, columns: usize| match (count, columns) {
            (0, _) | (_, 0) => Some(0),
            _ => (count - 1).checked_mul(stride).and_then(|last| last.checked_add(columns)),
        };
        let fits = |len: usize, stride: usize, columns: usize| needed(stride, columns).is_some_and(|all| all <= len);
        let (n, m) = (self.inputs.len(), self.outputs.len());
        assert!(
            fits(inputs.numbers.len(), inputs.stride, n),
            "{} inputs for {count} rows of {n}, stride {}",
            inputs.numbers.len(),
            inputs.stride
        );
        assert!(
            fits(outputs.numbers.len(), outputs.stride, m) && (count < 2 || outputs.stride >= m),
            "{} outputs for {count} rows of {m}, stride {}",
            outputs.numbers.len(),
            outputs.stride
        );
    }

    /// Runs the machine code, if there is any; returns the status.
    ///
    /// # Panics
    /// If block or pool are shorter than the code needs: a bug in the caller.
    pub(crate) fn run(
        &self,
        block: &mut [f64],
        pool: &[f64],
        count: u64,
        inputs: &Rows,
        outputs: &mut RowsMut,
    ) -> Option<u64> {
        let Code { entry, size, pool_len, ahead, .. } = self.code.as_ref()?;
        self.check(count, inputs, outputs);
        assert!(block.len() >= *size, "block of {} slots, {size} needed", block.len());
        assert!(pool.len() >= *pool_len, "pool of {} numbers, {pool_len} needed", pool.len());
        let mut done = 0;
        if let Some(ahead) = ahead {
            // SAFETY: the lengths were just checked.
            let (made, status) = unsafe { ahead.advance(block, pool, count, inputs, outputs) };
            if status != 0 || made == count {
                return Some(status);
            }
            done = made as usize;
        }
        let strides = [inputs.stride, outputs.stride].map(|stride| 8 * stride as i64);
        let (from, to) = (inputs.numbers.get(done * inputs.stride..), outputs.numbers.get_mut(done * outputs.stride..));
        // Rows without columns take no room.
        let (from, to) = (from.unwrap_or_default().as_ptr(), to.unwrap_or_default().as_mut_ptr());
        let left = count - done as u64;
        // SAFETY: by the contract of `with_code`, the entry accesses only the lengths that were just checked.
        Some(unsafe { entry(block.as_mut_ptr(), pool.as_ptr(), left, from, to, strides.as_ptr()) })
    }
}
