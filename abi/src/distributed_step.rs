//! Loop distribution: a step in two parts. One computes, for several instants at once, everything that depends on time
//! alone; the other runs the rest step by step.
//!
//! Values that depend on no state are computed ahead of the states, in lanes that are instants here. Operations and
//! operands are the same as in the undivided step, so the bits are too.
//!
//! Source: Kennedy, Allen, *Optimizing Compilers for Modern Architectures*, 2001, ch. 5.

use crate::description::{Layout, Slot};
use crate::lanes::{Aligned, Lanes};
use crate::rows::{Rows, RowsMut};
use std::any::Any;
use std::mem::MaybeUninit;
use std::sync::Arc;

compiled! {
    /// Machine code of the remaining part: as an entry of a table, for `count` steps. `ahead` holds the values
    /// computed ahead: value `k` of step `i` is `ahead[k · lanes + i]`.
    pub type RemainingEntry = fn(block: *mut f64, pool: *const f64, count: u64, ahead: *const f64);
}

compiled! {
    /// Machine code of the remaining part of a loop over rows: as the undivided loop, with the
    /// values computed ahead.
    pub type RemainingFollowEntry = fn(
        block: *mut f64,
        pool: *const f64,
        count: u64,
        inputs: *const f64,
        outputs: *mut f64,
        strides: *const i64,
        ahead: *const f64
    );
}

/// Capacity of the stack buffer, in numbers: 32 KiB.
const ROOM: usize = 4096;

/// Maximum number of instants at once.
const INSTANTS: usize = 64;

/// The loop that computes ahead, for successive steps in lanes, what depends on time and on inputs from rows alone.
///
/// It works on a block of its own with the layout `layout`. That has time and count; its parameters are the numbers of the
/// model's block that `loads` names; its inputs are the columns `columns` of the rows; its states are computed by `once` and
/// are the same in every step; its outputs are the values for the remaining part.
#[derive(Clone)]
pub struct LeadingLoop {
    /// Computes the states.
    pub once: Option<Lanes>,
    /// Computes the outputs.
    pub instants: Lanes,
    /// The layout of both.
    pub layout: Layout,
    /// For each parameter, the slot of the model that it copies.
    pub loads: Vec<Slot>,
    /// For each input, its column.
    pub columns: Vec<usize>,
    /// Whether `instants` reads time or count.
    pub is_timed: bool,
}

impl LeadingLoop {
    /// Whether the parts fit together, the stack buffer, and the maximum number of instants.
    ///
    /// # Panics
    /// If the layout is not that of its parts: a bug in the caller.
    fn fits(&self) -> bool {
        let both = || self.once.iter().chain([&self.instants]);
        assert_eq!(self.loads.len(), self.layout.params.len as usize, "a parameter for each number that is loaded");
        assert_eq!(self.columns.len(), self.layout.inputs.len as usize, "an input for each column");
        assert!(
            both().all(|lanes| lanes.size() == self.layout.size() && lanes.width() == self.instants.width()),
            "parts that fit"
        );
        both().all(|lanes| lanes.room() <= ROOM && lanes.width() <= INSTANTS)
    }

    /// Smallest number of steps for which computing ahead pays off.
    fn pays(&self) -> u64 {
        self.instants.width() as u64 / 2
    }

    /// Advances by up to `count` steps, as many as are worth computing ahead. `rest(block, done, some, ahead)` is the
    /// remaining part: it makes `some` steps after the first `done`, and returns the status. Returns the number of steps done
    /// and the first status that is not 0. No step is done if the step count so far is not an integer, because time cannot
    /// then be computed ahead.
    ///
    /// # Safety
    /// The block must have all slots of the model, the pool all numbers of its code, and `rows` as many rows as there are
    /// steps, and all columns.
    #[inline(always)]
    unsafe fn advance(
        &self,
        block: &mut [f64],
        pool: &[f64],
        count: u64,
        rows: &Rows,
        mut rest: impl FnMut(&mut [f64], u64, u64, *const f64) -> u64,
    ) -> (u64, u64) {
        let begin = block[Slot::COUNT.index()];
        // Up to 2^53 every integer is a double, so adding 1 to a smaller one is exact.
        let exact = 9007199254740992.0 - self.instants.width() as f64;
        if !(begin >= 0.0 && begin.floor() == begin && begin + count as f64 <= exact) {
            return (0, 0);
        }
        let step = block[Slot::STEP.index()];
        let width = self.instants.width();
        let mut room = MaybeUninit::<[Aligned; ROOM / 8]>::uninit();
        let mut statuses = [0; INSTANTS];
        let (numbers, statuses) = (room.as_mut_ptr().cast::<f64>(), statuses.as_mut_ptr());
        let set = |slot: Slot, lane: usize, value: f64| {
            debug_assert!(slot.index() < self.layout.size() && lane < width);
            // SAFETY: `fits` has checked that the buffer has room for all slots.
            unsafe { numbers.add(slot.index() * width + lane).write(value) };
        };
        for (k, from) in self.loads.iter().enumerate() {
            (0..width).for_each(|lane| set(self.layout.params.slot(k), lane, block[from.index()]));
        }
        if let Some(once) = &self.once {
            // SAFETY: by the contract of `Lanes::new`, the entry accesses only its numbers, for which there is room,
            // the pool, and one status per lane.
            unsafe { once.run(numbers, pool.as_ptr(), 1, statuses) };
        }
        // SAFETY: the outputs are within the numbers.
        let ahead = unsafe { numbers.add(self.layout.outputs.start as usize * width) };
        let mut done = 0;
        while count - done >= self.pays() {
            let some = (count - done).min(width as u64);
            if self.is_timed {
                for lane in 0..width {
                    let number = begin + (done + lane as u64) as f64;
                    set(Slot::COUNT, lane, number);
                    set(Slot::TIME, lane, number * step);
                }
                // The caller may have set another time.
                set(Slot::TIME, 0, block[Slot::TIME.index()]);
            }
            for (k, column) in self.columns.iter().enumerate() {
                let slot = self.layout.inputs.slot(k);
                // Lanes after the last row repeat it.
                let last = some as usize - 1;
                let from = &rows.numbers[done as usize * rows.stride + column..][..last * rows.stride + 1];
                if rows.stride == 1 && last + 1 == width {
                    from.iter().enumerate().for_each(|(lane, value)| set(slot, lane, *value));
                } else {
                    (0..width).for_each(|lane| set(slot, lane, from[lane.min(last) * rows.stride]));
                }
            }
            // SAFETY: as above.
            unsafe { self.instants.run(numbers, pool.as_ptr(), 1, statuses) };
            let status = rest(block, done, some, ahead);
            done += some;
            if status != 0 {
                return (done, status);
            }
        }
        (done, 0)
    }
}

/// A step in two parts.
#[derive(Clone)]
pub struct DistributedStep {
    leading: LeadingLoop,
    rest: RemainingEntry,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl DistributedStep {
    /// Combines the parts. `None` if they exceed the stack buffer or the maximum number of instants.
    ///
    /// # Safety
    /// `rest` must be valid as long as `memory` lives, must not unwind, and must access only what the undivided step
    /// may access in block and pool, and as many values computed ahead as the leading loop has outputs.
    pub unsafe fn new(
        leading: LeadingLoop,
        rest: RemainingEntry,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Option<DistributedStep> {
        assert!(leading.columns.is_empty(), "a step has no rows");
        leading.fits().then_some(DistributedStep { leading, rest, _memory: memory })
    }

    /// Smallest number of steps for which computing ahead pays off.
    pub(crate) fn pays(&self) -> u64 {
        self.leading.pays()
    }

    /// Advances by up to `count` steps: see [`LeadingLoop`].
    ///
    /// # Safety
    /// The block must have all slots of the model, and the pool all numbers of its code.
    #[inline(never)]
    pub(crate) unsafe fn advance(&self, block: &mut [f64], pool: &[f64], count: u64) -> (u64, u64) {
        let none = Rows { numbers: &[], stride: 0 };
        // SAFETY: by the contract of `new`, the entry accesses only the block, the pool and the values just computed.
        let rest = |block: &mut [f64], _: u64, some: u64, ahead: *const f64| unsafe {
            (self.rest)(block.as_mut_ptr(), pool.as_ptr(), some, ahead)
        };
        // SAFETY: as the caller promises.
        unsafe { self.leading.advance(block, pool, count, &none, rest) }
    }
}

/// A loop over rows in two parts.
#[derive(Clone)]
pub struct DistributedFollow {
    leading: LeadingLoop,
    rest: RemainingFollowEntry,
}

impl DistributedFollow {
    /// Combines the parts. `None` if they exceed the stack buffer or the maximum number of instants.
    ///
    /// # Safety
    /// `rest` must access only what the undivided loop may access, and as many values computed ahead as the leading loop has
    /// outputs, and must not unwind.
    pub unsafe fn new(leading: LeadingLoop, rest: RemainingFollowEntry) -> Option<DistributedFollow> {
        leading.fits().then_some(DistributedFollow { leading, rest })
    }

    /// The columns of inputs that are read ahead.
    pub(crate) fn columns(&self) -> &[usize] {
        &self.leading.columns
    }

    /// Advances by up to `count` steps: see [`LeadingLoop`].
    ///
    /// # Safety
    /// The block must have all slots of the model, the pool all numbers of its code, and the arrays `count` rows.
    #[inline(never)]
    pub(crate) unsafe fn advance(
        &self,
        block: &mut [f64],
        pool: &[f64],
        count: u64,
        inputs: &Rows,
        outputs: &mut RowsMut,
    ) -> (u64, u64) {
        let strides = [inputs.stride, outputs.stride].map(|stride| 8 * stride as i64);
        let (from, to) = (inputs.numbers.as_ptr(), outputs.numbers.as_mut_ptr());
        let at = |done: u64| [inputs.stride, outputs.stride].map(|stride| done as usize * stride);
        let rest = |block: &mut [f64], done: u64, some: u64, ahead: *const f64| {
            let [read, written] = at(done);
            // SAFETY: by the contract of `new`, the entry accesses only the block, the pool, the values just computed, and
            // `some` rows, which the arrays have after the first `done`.
            unsafe {
                let (from, to) = (from.add(read), to.add(written));
                (self.rest)(block.as_mut_ptr(), pool.as_ptr(), some, from, to, strides.as_ptr(), ahead)
            }
        };
        // SAFETY: as the caller promises.
        unsafe { self.leading.advance(block, pool, count, inputs, rest) }
    }
}
