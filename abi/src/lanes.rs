//! Many instances of one model, advanced together in the lanes of vectors. Each lane has the same bits as the instance
//! alone.

use crate::description::Slot;
use std::any::Any;
use std::ops::Range;
use std::sync::Arc;

compiled! {
    /// Machine code that advances all lanes by up to `count` fixed steps, and by at least one if `count` is not 0. It stops
    /// no later than after a step at which the status of a lane is not 0. Returns the number of steps done; `statuses`
    /// receives the status of each lane after the last step.
    ///
    /// The values of a slot are adjacent: `block[slot · width + lane]`. The code has scratch space after the slots. Block
    /// and statuses are aligned to 64 bytes.
    pub type LanesEntry = fn(block: *mut f64, pool: *const f64, count: u64, statuses: *mut u64);
}

compiled! {
    /// The same in a loop over rows: step `i` has inputs from row `i` instead of their slots, and writes row `i` of outputs,
    /// also if the status of a lane is not 0. A row has the numbers of all lanes for each column:
    /// `inputs[(i · columns + k) · width + lane]`. The slots of these inputs keep their values.
    pub type FollowLanesEntry = fn(
        block: *mut f64,
        pool: *const f64,
        count: u64,
        statuses: *mut u64,
        inputs: *const f64,
        outputs: *mut f64
    );
}

compiled! {
    /// Machine code that runs a function once, for a single instance, and returns its status. `scratch`: space for as many
    /// numbers as the code needs.
    pub type BaselineEntry = fn(block: *mut f64, pool: *const f64, scratch: *mut u64);
}

/// Code of a step in a loop over rows, for many instances at once.
#[derive(Clone)]
pub struct FollowLanes {
    /// The code.
    pub entry: FollowLanesEntry,
    /// The columns of inputs.
    pub inputs: Vec<Slot>,
    /// The columns of outputs.
    pub outputs: Vec<Slot>,
    /// Which of these the code writes: those that a step stores.
    pub stored: Vec<bool>,
    /// Numbers of scratch space after the blocks.
    pub scratch: usize,
    /// The owner of the code.
    pub memory: Arc<dyn Any + Send + Sync>,
}

/// The step of a model, for many instances at once.
#[derive(Clone)]
pub struct Lanes {
    entry: LanesEntry,
    width: usize,
    size: usize,
    scratch: usize,
    pool_len: usize,
    name: String,
    /// Outputs that the step does not store.
    left_out: Arc<[Slot]>,
    on_rows: Option<Arc<FollowLanes>>,
    _memory: Arc<dyn Any + Send + Sync>,
}

impl Lanes {
    /// Code for `width` instances with blocks of `size` slots, `scratch` numbers of scratch space and a pool of
    /// `pool_len` numbers. `name`: the instruction set, for reports.
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
        Lanes { entry, width, size, scratch, pool_len, name, left_out: Arc::default(), on_rows: None, _memory: memory }
    }

    /// The same code, whose step does not store these outputs: see [`Slice`](crate::Slice).
    pub fn leaving_out(self, left_out: Arc<[Slot]>) -> Lanes {
        Lanes { left_out, ..self }
    }

    /// The same, with code for a loop over rows of the same step.
    ///
    /// # Safety
    /// The entry must be valid as long as its memory lives, must access only `block[..size * width + scratch]`,
    /// `pool[..pool_len]`, `statuses[..width]`, and in each row as many numbers as there are columns and lanes, and must not
    /// unwind.
    pub unsafe fn with_rows(self, code: FollowLanes) -> Lanes {
        assert_eq!(code.stored.len(), code.outputs.len(), "one for each column");
        Lanes { on_rows: Some(Arc::new(code)), ..self }
    }

    /// Whether it has code for a loop over rows.
    pub fn is_on_rows(&self) -> bool {
        self.on_rows.is_some()
    }

    /// The outputs that its step does not store.
    pub fn left_out(&self) -> &[Slot] {
        &self.left_out
    }

    /// Number of instances.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The instruction set and the number of vectors: `AVX-512 × 4`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of slots of a block.
    pub(crate) fn size(&self) -> usize {
        self.size
    }

    /// Number of doubles for all blocks and the scratch space.
    pub(crate) fn room(&self) -> usize {
        let scratch = self.on_rows.as_ref().map_or(0, |code| code.scratch);
        self.size * self.width + self.scratch.max(scratch)
    }

    /// Runs the code.
    ///
    /// # Safety
    /// `numbers` must be aligned to 64 bytes and have [`room`](Lanes::room) doubles, the pool must be as long as the
    /// code needs, and `statuses` must have one entry per lane.
    pub(crate) unsafe fn run(&self, numbers: *mut f64, pool: *const f64, count: u64, statuses: *mut u64) -> u64 {
        // SAFETY: by the contract of `Lanes::new`, the entry accesses only these.
        unsafe { (self.entry)(numbers, pool, count, statuses) }
    }
}

/// Eight numbers, aligned for vectors.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Aligned([u64; 8]);

/// The blocks of as many instances as the code has lanes.
#[derive(Clone)]
pub struct Batch {
    lanes: Lanes,
    numbers: Vec<Aligned>,
    statuses: Vec<Aligned>,
}

impl Batch {
    /// A batch in which all numbers are 0.
    pub fn new(lanes: Lanes) -> Batch {
        let lines = |numbers: usize| vec![Aligned([0; 8]); numbers.div_ceil(8)];
        let numbers = lines(lanes.room());
        let statuses = lines(lanes.width);
        Batch { lanes, numbers, statuses }
    }

    /// Number of instances.
    pub fn width(&self) -> usize {
        self.lanes.width
    }

    /// The outputs that a step does not store.
    pub fn left_out(&self) -> &[Slot] {
        &self.lanes.left_out
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

    /// Copies the block of an instance, all slots, to a lane.
    pub fn load(&mut self, lane: usize, block: &[f64]) {
        assert_eq!(block.len(), self.lanes.size, "a block of another model");
        for (slot, value) in block.iter().enumerate() {
            self.set(Slot(slot as u32), lane, *value);
        }
    }

    /// Copies a lane to the block of an instance.
    pub fn save(&self, lane: usize, block: &mut [f64]) {
        assert_eq!(block.len(), self.lanes.size, "a block of another model");
        for (slot, value) in block.iter_mut().enumerate() {
            *value = self.get(Slot(slot as u32), lane);
        }
    }

    /// Index of the first of these slots in a lane; the others follow at a stride of the width.
    fn begin(&self, lane: usize, slots: &Range<usize>) -> usize {
        let Lanes { width, size, .. } = self.lanes;
        assert!(slots.end <= size && lane < width, "slots {slots:?} of {size}, lane {lane} of {width}");
        slots.start * width + lane
    }

    /// As [`Batch::load`], for these slots alone.
    pub fn load_part(&mut self, lane: usize, slots: Range<usize>, block: &[f64]) {
        let (width, mut at) = (self.lanes.width, self.begin(lane, &slots));
        for value in &block[slots] {
            self.numbers[at / 8].0[at % 8] = value.to_bits();
            at += width;
        }
    }

    /// As [`Batch::save`], for these slots alone.
    pub fn save_part(&self, lane: usize, slots: Range<usize>, block: &mut [f64]) {
        let (width, mut at) = (self.lanes.width, self.begin(lane, &slots));
        for value in &mut block[slots] {
            *value = f64::from_bits(self.numbers[at / 8].0[at % 8]);
            at += width;
        }
    }

    /// Copies all numbers of one lane to another.
    pub fn copy_lane(&mut self, from: usize, to: usize) {
        for slot in 0..self.lanes.size {
            let value = self.get(Slot(slot as u32), from);
            self.set(Slot(slot as u32), to, value);
        }
    }

    /// The status of a lane after its last step; 0: no guard failed.
    pub fn status(&self, lane: usize) -> u64 {
        assert!(lane < self.lanes.width, "lane {lane} of {}", self.lanes.width);
        self.statuses[lane / 8].0[lane % 8]
    }

    /// As [`advance`](Batch::advance), and writes to `rows` the values of these slots after each step: slot by slot, all
    /// lanes of one after the other. Time and count are none of them.
    pub fn advance_and_read(&mut self, pool: &[f64], n: u64, slots: &[Slot], rows: &mut Vec<f64>) -> u64 {
        rows.resize(n as usize * slots.len() * self.lanes.width, 0.0);
        self.some_rows(pool, (&[], &[]), (slots, rows), n as usize) as u64
    }

    /// A fixed step of all lanes for each row of inputs, and a row of outputs after each. A row has a column for each slot, a
    /// column a number for each lane: `given[(row · inputs + column) · width + lane]`, and `taken` alike. Does not stop at a
    /// status that is not 0: `failed` receives the number of such a row, and may look at the statuses and the blocks of its
    /// lanes. Each lane has the bits of an instance alone; the others are not changed by what has failed in one.
    ///
    /// # Panics
    /// If the arrays do not have the same number of rows, or the pool is too short: a bug in the caller.
    pub fn follow(
        &mut self,
        pool: &[f64],
        (inputs, given): (&[Slot], &[f64]),
        (outputs, taken): (&[Slot], &mut [f64]),
        rows: usize,
        failed: &mut dyn FnMut(usize, &Batch),
    ) {
        let width = self.lanes.width;
        assert_eq!(given.len(), rows * inputs.len() * width, "{rows} rows of inputs");
        assert_eq!(taken.len(), rows * outputs.len() * width, "{rows} rows of outputs");
        let (n, m) = (inputs.len() * width, outputs.len() * width);
        let mut done = 0;
        while done < rows {
            let (from, to) = (&given[done * n..], &mut taken[done * m..]);
            done += self.some_rows(pool, (inputs, from), (outputs, to), rows - done);
            if self.has_failed() {
                failed(done - 1, self);
            }
        }
    }

    /// Up to so many rows, at least one if there are any, to the first at which the status of a lane is not 0; returns their
    /// number.
    fn some_rows(
        &mut self,
        pool: &[f64],
        (inputs, given): (&[Slot], &[f64]),
        (outputs, taken): (&[Slot], &mut [f64]),
        rows: usize,
    ) -> usize {
        let is_for_these = |code: &Arc<FollowLanes>| code.inputs == inputs && code.outputs == outputs;
        if let Some(code) = self.lanes.on_rows.clone().filter(is_for_these) {
            return self.rows_by_code(&code, pool, given, taken, rows);
        }
        for row in 0..rows {
            self.give(inputs, &given[row * inputs.len() * self.lanes.width..]);
            self.advance(pool, 1);
            self.take(outputs, &mut taken[row * outputs.len() * self.lanes.width..]);
            if self.has_failed() {
                return row + 1;
            }
        }
        rows
    }

    /// The same by the code for these rows.
    fn rows_by_code(
        &mut self,
        code: &FollowLanes,
        pool: &[f64],
        given: &[f64],
        taken: &mut [f64],
        rows: usize,
    ) -> usize {
        let (width, needed) = (self.lanes.width, self.lanes.pool_len);
        let (n, m) = (code.inputs.len() * width, code.outputs.len() * width);
        assert!(pool.len() >= needed, "pool of {} numbers, {needed} needed", pool.len());
        assert!(rows > 0 && given.len() >= rows * n && taken.len() >= rows * m, "{rows} rows");
        self.statuses.fill(Aligned([0; 8]));
        let (numbers, statuses) = (self.numbers.as_mut_ptr().cast(), self.statuses.as_mut_ptr().cast());
        let (from, to) = (given.as_ptr(), taken.as_mut_ptr());
        // SAFETY: `Batch::new` has allocated the numbers and statuses, and the lengths of pool and rows were checked.
        let done = unsafe { (code.entry)(numbers, pool.as_ptr(), rows as u64, statuses, from, to) } as usize;
        if let Some(last) = given.get((done - 1) * n..) {
            self.give(&code.inputs, last);
        }
        // No step stores these columns: they are inputs, or the same in each row.
        for k in (0..code.outputs.len()).filter(|k| !code.stored[*k]) {
            let at = self.begin_of(code.outputs[k]);
            let column = code.inputs.iter().position(|input| *input == code.outputs[k]);
            for row in 0..done {
                let from = match column {
                    Some(column) => &given[row * n + column * width..][..width],
                    None => &self.flat()[at..at + width],
                };
                taken[row * m + k * width..][..width].copy_from_slice(from);
            }
        }
        done
    }

    /// Reads the slots of a row of outputs.
    fn take(&self, outputs: &[Slot], row: &mut [f64]) {
        let width = self.lanes.width;
        for (slot, column) in outputs.iter().zip(row.chunks_exact_mut(width)) {
            let at = self.begin_of(*slot);
            column.copy_from_slice(&self.flat()[at..at + width]);
        }
    }

    /// Writes the slots of a row of inputs.
    fn give(&mut self, inputs: &[Slot], row: &[f64]) {
        let width = self.lanes.width;
        for (slot, column) in inputs.iter().zip(row.chunks_exact(width)) {
            let at = self.begin_of(*slot);
            self.flat_mut()[at..at + width].copy_from_slice(column);
        }
    }

    /// Whether the status of a lane is not 0.
    fn has_failed(&self) -> bool {
        (0..self.lanes.width).any(|lane| self.status(lane) != 0)
    }

    /// Index of the number of a slot in the first lane.
    fn begin_of(&self, slot: Slot) -> usize {
        assert!(slot.index() < self.lanes.size, "slot {} of {}", slot.0, self.lanes.size);
        slot.index() * self.lanes.width
    }

    fn flat(&self) -> &[f64] {
        // SAFETY: a line is eight adjacent words without padding, and any word is a double.
        unsafe { std::slice::from_raw_parts(self.numbers.as_ptr().cast(), 8 * self.numbers.len()) }
    }

    fn flat_mut(&mut self) -> &mut [f64] {
        // SAFETY: as in `flat`, and the borrow is exclusive.
        unsafe { std::slice::from_raw_parts_mut(self.numbers.as_mut_ptr().cast(), 8 * self.numbers.len()) }
    }

    /// Advances all lanes by up to `n` fixed steps and returns the number of steps done. Stops after a step at which
    /// the status of a lane is not 0. Time is only stored as far as the code does so: see
    /// [`keep_time`](crate::table::keep_time).
    ///
    /// # Panics
    /// If the pool is shorter than the code needs: a bug in the caller.
    pub fn advance(&mut self, pool: &[f64], n: u64) -> u64 {
        let needed = self.lanes.pool_len;
        assert!(pool.len() >= needed, "pool of {} numbers, {needed} needed", pool.len());
        let mut done = 0;
        self.statuses.fill(Aligned([0; 8]));
        while done < n && (0..self.lanes.width).all(|lane| self.status(lane) == 0) {
            let (numbers, statuses) = (self.numbers.as_mut_ptr().cast(), self.statuses.as_mut_ptr().cast());
            // SAFETY: `Batch::new` has allocated the numbers and statuses, and the length of the pool was checked.
            done += unsafe { self.lanes.run(numbers, pool.as_ptr(), n - done, statuses) };
        }
        done
    }
}
