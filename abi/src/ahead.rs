//! A step in two parts: what depends on nothing but time, for several instants at once, and the rest step by step.
//!
//! What neither the states nor anything they lead to can change goes ahead of them: lanes are instants here. The same
//! operations are done on the same numbers, so the bits are those of the step in one piece.

use crate::description::{Layout, Slot};
use crate::lanes::{Lanes, Line};
use std::any::Any;
use std::mem::MaybeUninit;
use std::sync::Arc;

/// Machine code of the rest: as [`Entry`](crate::table::Entry), for `count` steps of which `ahead` has what went ahead:
/// number `k` of step `i` at `ahead[k · lanes + i]`.
pub type RestEntry = unsafe extern "C" fn(block: *mut f64, pool: *const f64, count: u64, ahead: *const f64) -> u64;

/// Numbers that an advance has room for on the stack: 32 KiB.
const ROOM: usize = 4096;

/// Most instants at once.
const INSTANTS: usize = 64;

/// A step in two parts.
#[derive(Clone)]
pub struct Ahead {
    once: Option<Lanes>,
    instants: Lanes,
    layout: Layout,
    loads: Vec<Slot>,
    rest: RestEntry,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Ahead {
    /// The parts, if there is room for them.
    ///
    /// `instants` and `once` work on numbers of their own, laid out as `layout` says: time and count, in the parameters the
    /// numbers of the block that `loads` names, in the states what `once` computes and no step changes, in the outputs
    /// what the rest is given.
    ///
    /// # Safety
    /// `rest` must be valid as long as `memory` lives, must access only the block and the pool that the step in one piece
    /// may, and of what went ahead as many numbers as `layout` has outputs, and must not unwind.
    pub unsafe fn new(
        once: Option<Lanes>,
        instants: Lanes,
        layout: Layout,
        loads: Vec<Slot>,
        rest: RestEntry,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Option<Ahead> {
        let both = || once.iter().chain([&instants]);
        assert_eq!(loads.len(), layout.params.len as usize, "a parameter for each number that is loaded");
        assert!(
            both().all(|lanes| lanes.size() == layout.size() && lanes.width() == instants.width()),
            "parts that fit"
        );
        let fits = both().all(|lanes| lanes.room() <= ROOM && lanes.width() <= INSTANTS);
        fits.then_some(Ahead { once, instants, layout, loads, rest, _memory: memory })
    }

    /// Steps from which on going ahead costs less than it spares.
    pub(crate) fn pays(&self) -> u64 {
        self.instants.width() as u64 / 2
    }

    /// Advances by steps, as many as are worth going ahead, up to `count`; gives how many those are and the first status
    /// that is not 0. None are if the count of steps so far is no whole number, of which nothing can be told ahead.
    ///
    /// # Safety
    /// The block must have all slots of the model, the pool all numbers of its code.
    #[inline(never)]
    pub(crate) unsafe fn advance(&self, block: &mut [f64], pool: &[f64], count: u64) -> (u64, u64) {
        let begin = block[Slot::COUNT.index()];
        // Up to 2^53 every whole number is a number, and one more than it is exact.
        let exact = 9007199254740992.0 - self.instants.width() as f64;
        if !(begin >= 0.0 && begin.floor() == begin && begin + count as f64 <= exact) {
            return (0, 0);
        }
        let step = block[Slot::STEP.index()];
        let width = self.instants.width();
        let mut room = MaybeUninit::<[Line; ROOM / 8]>::uninit();
        let mut statuses = [0; INSTANTS];
        let (numbers, statuses) = (room.as_mut_ptr().cast::<f64>(), statuses.as_mut_ptr());
        let set = |slot: Slot, lane: usize, value: f64| {
            debug_assert!(slot.index() < self.layout.size() && lane < width);
            // SAFETY: `new` has seen that the numbers of all slots have room.
            unsafe { numbers.add(slot.index() * width + lane).write(value) };
        };
        for (k, from) in self.loads.iter().enumerate() {
            (0..width).for_each(|lane| set(self.layout.params.slot(k), lane, block[from.index()]));
        }
        if let Some(once) = &self.once {
            // SAFETY: `Lanes::new` was promised that the entry accesses only its numbers, for which there is room, the pool
            // and a status a lane.
            unsafe { once.run(numbers, pool.as_ptr(), 1, statuses) };
        }
        // SAFETY: the outputs lie among the numbers.
        let ahead = unsafe { numbers.add(self.layout.outputs.start as usize * width) };
        let mut done = 0;
        while count - done >= self.pays() {
            for lane in 0..width {
                let number = begin + (done + lane as u64) as f64;
                set(Slot::COUNT, lane, number);
                set(Slot::TIME, lane, number * step);
            }
            // Whoever called may have set another time.
            set(Slot::TIME, 0, block[Slot::TIME.index()]);
            // SAFETY: as above.
            unsafe { self.instants.run(numbers, pool.as_ptr(), 1, statuses) };
            let some = (count - done).min(width as u64);
            // SAFETY: `new` was promised that the entry accesses only the block, the pool and what has just gone ahead.
            let status = unsafe { (self.rest)(block.as_mut_ptr(), pool.as_ptr(), some, ahead) };
            done += some;
            if status != 0 {
                return (done, status);
            }
        }
        (done, 0)
    }
}
