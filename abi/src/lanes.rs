//! Many instances of one model, advanced together: lane by lane to the bit as each would be alone.

use crate::description::Slot;
use std::any::Any;
use std::ops::Range;
use std::sync::Arc;

/// Machine code that advances all lanes by up to `count` fixed steps, at least by one if `count` is not 0, and stops at the
/// latest after a step at which the status of a lane is not 0. Returns the number of steps done; `statuses` gets one number
/// a lane, those of the last step.
///
/// A slot's values lie side by side, `block[slot · width + lane]`; behind the slots the code has room of its own. Block
/// and statuses begin at multiples of 64 bytes.
pub type LanesEntry = unsafe extern "C" fn(block: *mut f64, pool: *const f64, count: u64, statuses: *mut u64) -> u64;

/// The step of a model for many instances at once.
#[derive(Clone)]
pub struct Lanes {
    entry: LanesEntry,
    width: usize,
    size: usize,
    scratch: usize,
    pool_len: usize,
    name: String,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Lanes {
    /// Code for `width` instances with blocks of `size` slots, that needs `scratch` more numbers and a pool of `pool_len`.
    /// `name`: what does it, for reports.
    ///
    /// # Safety
    /// The entry must be valid as long as `memory` lives, must access only `block[..size * width + scratch]`,
    /// `pool[..pool_len]` and `statuses[..width]`, and must not unwind.
    pub unsafe fn new(
        entry: LanesEntry,
        width: usize,
        size: usize,
        scratch: usize,
        pool_len: usize,
        name: String,
        memory: Arc<dyn Any + Send + Sync>,
    ) -> Lanes {
        Lanes { entry, width, size, scratch, pool_len, name, _memory: memory }
    }

    /// Number of instances.
    pub fn width(&self) -> usize {
        self.width
    }

    /// What does it: `AVX-512 × 4`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Slots of a block.
    pub(crate) fn size(&self) -> usize {
        self.size
    }

    /// Numbers that all blocks and what the code needs behind them take.
    pub(crate) fn room(&self) -> usize {
        self.size * self.width + self.scratch
    }

    /// Runs the code.
    ///
    /// # Safety
    /// `numbers` must begin at a multiple of 64 bytes and have as many as there is [`room`](Lanes::room) for, the pool as
    /// many as the code needs, and `statuses` one a lane.
    pub(crate) unsafe fn run(&self, numbers: *mut f64, pool: *const f64, count: u64, statuses: *mut u64) -> u64 {
        // SAFETY: `Lanes::new` was promised that the entry accesses only these.
        unsafe { (self.entry)(numbers, pool, count, statuses) }
    }
}

/// Eight numbers that lie where vectors want them.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Line([u64; 8]);

/// As many instances as the code has lanes, with their numbers.
#[derive(Clone)]
pub struct Batch {
    lanes: Lanes,
    numbers: Vec<Line>,
    statuses: Vec<Line>,
}

impl Batch {
    /// All numbers 0.
    pub fn new(lanes: Lanes) -> Batch {
        let lines = |numbers: usize| vec![Line([0; 8]); numbers.div_ceil(8)];
        let numbers = lines(lanes.room());
        let statuses = lines(lanes.width);
        Batch { lanes, numbers, statuses }
    }

    /// Number of instances.
    pub fn width(&self) -> usize {
        self.lanes.width
    }

    fn at(&self, slot: Slot, lane: usize) -> (usize, usize) {
        let Lanes { width, size, .. } = self.lanes;
        assert!(slot.index() < size && lane < width, "slot {} of {size}, lane {lane} of {width}", slot.0);
        let at = slot.index() * width + lane;
        (at / 8, at % 8)
    }

    /// The value of a slot in a lane, SI.
    pub fn get(&self, slot: Slot, lane: usize) -> f64 {
        let (line, at) = self.at(slot, lane);
        f64::from_bits(self.numbers[line].0[at])
    }

    /// Writes a slot of a lane, SI.
    pub fn set(&mut self, slot: Slot, lane: usize, value: f64) {
        let (line, at) = self.at(slot, lane);
        self.numbers[line].0[at] = value.to_bits();
    }

    /// Gives a lane the numbers of an instance: its block, all slots.
    pub fn load(&mut self, lane: usize, block: &[f64]) {
        assert_eq!(block.len(), self.lanes.size, "a block of another model");
        for (slot, value) in block.iter().enumerate() {
            self.set(Slot(slot as u32), lane, *value);
        }
    }

    /// Gives an instance the numbers of a lane.
    pub fn save(&self, lane: usize, block: &mut [f64]) {
        assert_eq!(block.len(), self.lanes.size, "a block of another model");
        for (slot, value) in block.iter_mut().enumerate() {
            *value = self.get(Slot(slot as u32), lane);
        }
    }

    /// Where the first of these slots lies; the others follow at a distance of the width.
    fn begin(&self, lane: usize, slots: &Range<usize>) -> usize {
        let Lanes { width, size, .. } = self.lanes;
        assert!(slots.end <= size && lane < width, "slots {slots:?} of {size}, lane {lane} of {width}");
        slots.start * width + lane
    }

    /// As [`Batch::load`], of these slots alone.
    pub fn load_part(&mut self, lane: usize, slots: Range<usize>, block: &[f64]) {
        let (width, mut at) = (self.lanes.width, self.begin(lane, &slots));
        for value in &block[slots] {
            self.numbers[at / 8].0[at % 8] = value.to_bits();
            at += width;
        }
    }

    /// As [`Batch::save`], of these slots alone.
    pub fn save_part(&self, lane: usize, slots: Range<usize>, block: &mut [f64]) {
        let (width, mut at) = (self.lanes.width, self.begin(lane, &slots));
        for value in &mut block[slots] {
            *value = f64::from_bits(self.numbers[at / 8].0[at % 8]);
            at += width;
        }
    }

    /// Gives a lane the numbers of another one.
    pub fn copy_lane(&mut self, from: usize, to: usize) {
        for slot in 0..self.lanes.size {
            let value = self.get(Slot(slot as u32), from);
            self.set(Slot(slot as u32), to, value);
        }
    }

    /// The status of a lane after its last step, 0 for none.
    pub fn status(&self, lane: usize) -> u64 {
        assert!(lane < self.lanes.width, "lane {lane} of {}", self.lanes.width);
        self.statuses[lane / 8].0[lane % 8]
    }

    /// Advances all lanes by up to `n` fixed steps and returns how many were done: it stops after a step at which the
    /// status of a lane is not 0. Time is what the code keeps of it: see [`keep_time`](crate::table::keep_time).
    ///
    /// # Panics
    /// If the pool is shorter than the code needs: a mistake of the caller.
    pub fn advance(&mut self, pool: &[f64], n: u64) -> u64 {
        let needed = self.lanes.pool_len;
        assert!(pool.len() >= needed, "pool of {} numbers, {needed} needed", pool.len());
        let mut done = 0;
        self.statuses.fill(Line([0; 8]));
        while done < n && (0..self.lanes.width).all(|lane| self.status(lane) == 0) {
            let (numbers, statuses) = (self.numbers.as_mut_ptr().cast(), self.statuses.as_mut_ptr().cast());
            // SAFETY: `Batch::new` has made room, and the pool is as long as needed.
            done += unsafe { self.lanes.run(numbers, pool.as_ptr(), n - done, statuses) };
        }
        done
    }
}
