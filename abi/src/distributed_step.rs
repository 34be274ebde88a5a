//! Loop distribution: a step in two parts. One computes, for several instants at once, everything that depends on time
//! alone; the other runs the rest step by step.
//!
//! Values that depend on no state are computed ahead of the states, in lanes that are instants here. Operations and
//! operands are the same as in the undivided step, so the bits are too.
//!
//! Source: Kennedy, Allen, *Optimizing Compilers for Modern Architectures*, 2001, ch. 5.

use crate::description::{Layout, Slot};
use crate::lanes::{Aligned, Lanes};
use std::any::Any;
use std::mem::MaybeUninit;
use std::sync::Arc;

compiled! {
    /// Machine code of the remaining part: as an entry of a table, for `count` steps. `ahead` holds the values
    /// computed ahead: value `k` of step `i` is `ahead[k · lanes + i]`.
    pub type RemainingEntry = fn(block: *mut f64, pool: *const f64, count: u64, ahead: *const f64);
}

/// Capacity of the stack buffer, in numbers: 32 KiB.
const ROOM: usize = 4096;

/// Maximum number of instants at once.
const INSTANTS: usize = 64;

/// A step in two parts.
#[derive(Clone)]
pub struct DistributedStep {
    once: Option<Lanes>,
    instants: Lanes,
    layout: Layout,
    loads: Vec<Slot>,
    rest: RemainingEntry,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl DistributedStep {
    /// Combines the parts. `None` if they exceed the stack buffer or the maximum number of instants.
    ///
    /// `instants` and `once` work on a block of their own with the layout `layout`. It has time and count; its
    /// parameters are the numbers of the model's block that `loads` names; its states are computed by `once` and are
    /// the same in every step; its outputs are the values for the remaining part.
    ///
    /// # Safety
    /// `rest` must be valid as long as `memory` lives, must not unwind, and must access only what the undivided step
    /// may access in block and pool, and as many values computed ahead as `layout` has outputs.
    pub unsafe fn new(
        once: Option<Lanes>,
        instants: Lanes,
        layout: Layout,
        loads: Vec<Slot>,
        rest: RemainingEntry,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Option<DistributedStep> {
        let both = || once.iter().chain([&instants]);
        assert_eq!(loads.len(), layout.params.len as usize, "a parameter for each number that is loaded");
        assert!(
            both().all(|lanes| lanes.size() == layout.size() && lanes.width() == instants.width()),
            "parts that fit"
        );
        let fits = both().all(|lanes| lanes.room() <= ROOM && lanes.width() <= INSTANTS);
        fits.then_some(DistributedStep { once, instants, layout, loads, rest, _memory: memory })
    }

    /// Smallest number of steps for which computing ahead pays off.
    pub(crate) fn pays(&self) -> u64 {
        self.instants.width() as u64 / 2
    }

    /// Advances by up to `count` steps, as many as are worth computing ahead. Returns the number of steps done and the
    /// first status that is not 0. No step is done if the step count so far is not an integer, because time cannot then
    /// be computed ahead.
    ///
    /// # Safety
    /// The block must have all slots of the model, and the pool all numbers of its code.
    #[inline(never)]
    pub(crate) unsafe fn advance(&self, block: &mut [f64], pool: &[f64], count: u64) -> (u64, u64) {
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
            // SAFETY: `new` has checked that the buffer has room for all slots.
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
            for lane in 0..width {
                let number = begin + (done + lane as u64) as f64;
                set(Slot::COUNT, lane, number);
                set(Slot::TIME, lane, number * step);
            }
            // The caller may have set another time.
            set(Slot::TIME, 0, block[Slot::TIME.index()]);
            // SAFETY: as above.
            unsafe { self.instants.run(numbers, pool.as_ptr(), 1, statuses) };
            let some = (count - done).min(width as u64);
            // SAFETY: by the contract of `new`, the entry accesses only the block, the pool and the values just
            // computed.
            let status = unsafe { (self.rest)(block.as_mut_ptr(), pool.as_ptr(), some, ahead) };
            done += some;
            if status != 0 {
                return (done, status);
            }
        }
        (done, 0)
    }
}
