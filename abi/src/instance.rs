//! A running model: its block of numbers and its code, with every access checked.

use crate::description::{Automaton, Delay, Description, Kind, Quantity, Slot};
use crate::follow::{Follow, Rows, RowsMut};
use crate::table::{Code, Function, Machine, keep_clock, keep_time};
use std::sync::Arc;

/// One running instance of a compiled model.
#[derive(Clone)]
pub struct Instance {
    description: Arc<Description>,
    code: Code,
    /// The block of `size` slots, followed by the values that are hoisted out of the step.
    numbers: Vec<f64>,
    size: usize,
    /// Whether the hoisted values are current: no parameter and no step length has changed since they were computed.
    is_prepared: bool,
    /// The same program for adaptive runs, where this one has fixed steps and there is such.
    adaptive: Option<Arc<Instance>>,
    /// The code of `Step`: `code`, or that of the slice.
    step: Code,
    /// A step that leaves outputs out, if there is one, and whether it is the one in use.
    slice: Option<Slice>,
    is_sliced: bool,
}

/// A fixed step without those outputs that a run does not read (program slicing: Weiser, ICSE 1981). It advances the
/// model with the same bits and watches the same ranges, but does not store these outputs, nor test that they are finite.
#[derive(Clone)]
pub struct Slice {
    /// The code; only its `Step` is used.
    pub code: Code,
    /// The outputs that it does not store.
    pub left_out: Arc<[Slot]>,
}

impl Instance {
    /// An instance with the default parameters `params`, in SI, as many as the layout has.
    pub fn new(description: Arc<Description>, code: Code, params: &[f64]) -> Instance {
        // Allocates the room for hoisted values now, so that real-time code need not.
        let prepared = code.made(Function::Step).and_then(Machine::prepared).map_or(0, |prepared| prepared.len);
        let size = description.layout.size();
        let mut numbers = vec![0.0; size + prepared];
        numbers[description.layout.params.range()].copy_from_slice(params);
        let (step, slice) = (code.clone(), None);
        Instance { description, code, numbers, size, is_prepared: false, adaptive: None, step, slice, is_sliced: false }
    }

    /// The same with a step that leaves outputs out, for [`Instance::read_only`].
    pub fn with_slice(self, slice: Slice) -> Instance {
        Instance { slice: Some(slice), ..self }
    }

    /// From now on, outputs other than these need not be stored after a step.
    pub fn read_only(&mut self, slots: impl IntoIterator<Item = Slot>) {
        let Some(slice) = &self.slice else { return };
        if slots.into_iter().any(|slot| slice.left_out.contains(&slot)) {
            self.read_all();
        } else {
            (self.step, self.is_sliced, self.is_prepared) = (slice.code.clone(), true, false);
        }
    }

    /// From now on, each step stores all outputs again.
    pub fn read_all(&mut self) {
        if self.is_sliced {
            (self.step, self.is_sliced, self.is_prepared) = (self.code.clone(), false, false);
        }
    }

    /// One step that stores all outputs, and its status.
    pub fn advance_in_full(&mut self) -> u64 {
        let step = std::mem::replace(&mut self.step, self.code.clone());
        self.is_prepared = false;
        let status = self.advance(1);
        (self.step, self.is_prepared) = (step, false);
        status
    }

    /// Computes the outputs that the last step has left out, if it has. They may differ from those of a step by its
    /// rounding.
    pub fn complete(&mut self) {
        if self.is_sliced {
            self.call(Function::Outputs);
        }
    }

    /// The outputs that a step does not store now.
    pub fn left_out(&self) -> &[Slot] {
        self.slice.as_ref().filter(|_| self.is_sliced).map_or(&[], |slice| &slice.left_out)
    }

    /// The same with its program as an adaptive run needs it: what fixed steps are judged by.
    ///
    /// # Panics
    /// If that has other parameters or inputs.
    pub fn with_adaptive(self, adaptive: Arc<Instance>) -> Instance {
        let segments = |one: &Instance| (one.description.layout.params, one.description.layout.inputs);
        assert!(segments(&self) == segments(&adaptive), "{} is another program", adaptive.description.name);
        Instance { adaptive: Some(adaptive), ..self }
    }

    /// The same program for adaptive runs, with the parameters and inputs of this one; none where there is no such.
    pub fn adaptive(&self) -> Option<Instance> {
        let mut adaptive = Instance::clone(self.adaptive.as_deref()?);
        let layout = &self.description.layout;
        for range in [layout.params.range(), layout.inputs.range()] {
            adaptive.block_mut()[range.clone()].copy_from_slice(&self.block()[range]);
        }
        Some(adaptive)
    }

    /// The description of its model.
    pub fn description(&self) -> &Arc<Description> {
        &self.description
    }

    /// Whether its code has this function.
    pub fn has(&self, function: Function) -> bool {
        self.code.has(function)
    }

    /// The value of a slot, SI.
    #[inline]
    pub fn get(&self, slot: Slot) -> f64 {
        self.block()[slot.index()]
    }

    /// Writes a slot, SI.
    #[inline]
    pub fn set(&mut self, slot: Slot, value: f64) {
        self.is_prepared &= slot != Slot::STEP && !self.description.layout.params.contains(slot);
        self.numbers[..self.size][slot.index()] = value;
    }

    /// The block.
    #[inline]
    pub fn block(&self) -> &[f64] {
        &self.numbers[..self.size]
    }

    /// The block, for writing.
    pub fn block_mut(&mut self) -> &mut [f64] {
        self.is_prepared = false;
        &mut self.numbers[..self.size]
    }

    /// Runs one function once and returns its status; 0: no guard failed.
    pub fn call(&mut self, function: Function) -> u64 {
        self.call_up_to(function, 1)
    }

    /// Runs one function up to `n` times, stops at the first non-zero status and returns it. After fixed steps, the
    /// block contains their count and the time.
    #[inline]
    pub fn call_up_to(&mut self, function: Function, n: u64) -> u64 {
        let before = self.get(Slot::COUNT);
        let single = if (function, n) == (Function::Step, 1) { self.step_prepared() } else { None };
        let code = if function == Function::Step { &self.step } else { &self.code };
        let call = || code.call(function, &mut self.numbers, &self.description.pool, n);
        let status = single.unwrap_or_else(call);
        if function == Function::Step && n > 0 {
            keep_clock(&mut self.numbers, before, n);
        }
        status
    }

    /// One fixed step with hoisted values, if the code has such a step.
    #[inline]
    fn step_prepared(&mut self) -> Option<u64> {
        let machine = self.step.made(Function::Step)?;
        let size = self.size + machine.prepared()?.len;
        if self.numbers.len() < size {
            // The code was compiled since this instance was created.
            self.numbers.resize(size, 0.0);
            self.is_prepared = false;
        }
        let is_current = std::mem::replace(&mut self.is_prepared, true);
        machine.step_prepared(&mut self.numbers, &self.description.pool, is_current)
    }

    /// Starts the model at t = 0 for steps of `h` seconds: initial values and the sampled blocks due at 0, then
    /// transitions until none applies (at most as often as an automaton has regimes), then outputs.
    pub fn start(&mut self, h: f64) -> u64 {
        let mut regimes = vec![0.0; self.description.layout.regimes.len as usize];
        self.start_in(h, &mut regimes)
    }

    /// The same without an allocation. `regimes`: room for all regimes.
    pub fn start_in(&mut self, h: f64, regimes: &mut [f64]) -> u64 {
        self.set(Slot::TIME, 0.0);
        self.set(Slot::COUNT, 0.0);
        self.set(Slot::STEP, h);
        let mut status = self.call(Function::Start);
        if self.has(Function::Transitions) {
            let range = self.description.layout.regimes.range();
            let most = self.description.automata.iter().map(|automaton| automaton.regimes.len()).max().unwrap_or(0);
            for _ in 0..=most {
                regimes.copy_from_slice(&self.block()[range.clone()]);
                status = status.max(self.call(Function::Transitions));
                if self.block()[range.clone()] == *regimes {
                    break;
                }
            }
        }
        status.max(self.call(Function::Outputs))
    }

    /// Advances by up to `n` fixed steps, stops at the first non-zero status and returns it.
    #[inline]
    pub fn advance(&mut self, n: u64) -> u64 {
        self.call_up_to(Function::Step, n)
    }

    /// As [`advance`](Instance::advance), and writes the values of these slots to a row after each step, if there is machine
    /// code for that by now. Returns the number of steps and the last status; else nothing has happened.
    ///
    /// # Panics
    /// If there is less room than for `n` rows, or as [`Follow::new`](crate::follow::Follow::new): a bug in the caller.
    pub fn advance_recording(&mut self, slots: &[Slot], rows: &mut [f64], n: u64) -> Option<(u64, u64)> {
        let Code::Interpreted(code) = &self.step else { return None };
        let follow = code.recording(slots)?;
        let none = Rows { numbers: &[], stride: 0 };
        Some(self.follow(&follow, none, RowsMut { numbers: rows, stride: slots.len() }, n))
    }

    /// Makes a fixed step for each of `count` rows: with the inputs of this row, and then writes the outputs to a row. Stops
    /// at the first status that is not 0, after writing its row. Returns the number of steps and the status. The bits are
    /// those of [`set`](Instance::set), [`advance`](Instance::advance) and [`get`](Instance::get) for each row.
    ///
    /// # Panics
    /// If the arrays have fewer rows, or `follow` belongs to another program: a bug in the caller.
    pub fn follow(&mut self, follow: &Follow, inputs: Rows, mut outputs: RowsMut, count: u64) -> (u64, u64) {
        follow.check(count, &inputs, &outputs);
        let before = self.get(Slot::COUNT);
        // The code's count tells how many steps it made, as long as adding 1 is exact.
        let is_exact = before >= 0.0 && before.floor() == before && before + count as f64 <= 9007199254740992.0;
        let (numbers, pool) = (&mut self.numbers[..self.size], &self.description.pool);
        let status = match is_exact && count > 0 {
            true => follow.run(numbers, pool, count, &inputs, &mut outputs),
            false => None,
        };
        let Some(status) = status else { return self.follow_by_calls(follow, inputs, outputs, count) };
        let done = (self.get(Slot::COUNT) - before) as u64;
        let last = (done as usize - 1) * inputs.stride;
        for (k, slot) in follow.inputs().iter().enumerate() {
            self.numbers[slot.index()] = inputs.numbers[last + k];
        }
        keep_time(&mut self.numbers);
        (done, status)
    }

    /// The same by a call of the step for each row.
    fn follow_by_calls(&mut self, follow: &Follow, inputs: Rows, outputs: RowsMut, count: u64) -> (u64, u64) {
        let sliced = std::mem::replace(&mut self.is_sliced, false);
        let step = std::mem::replace(&mut self.step, self.code.clone());
        self.is_prepared &= !sliced;
        let (mut done, mut status) = (0, 0);
        while done < count && status == 0 {
            let row = done as usize;
            for (k, slot) in follow.inputs().iter().enumerate() {
                self.set(*slot, inputs.numbers[row * inputs.stride + k]);
            }
            status = self.advance(1);
            for (k, slot) in follow.outputs().iter().enumerate() {
                outputs.numbers[row * outputs.stride + k] = self.get(*slot);
            }
            done += 1;
        }
        (self.is_sliced, self.step) = (sliced, step);
        self.is_prepared &= !sliced;
        (done, status)
    }
}

/// What happened to the states when one instance replaced another.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Carried {
    /// Paths of states and automata that continue.
    pub kept: Vec<String>,
    /// Those that start anew, because they are new or have another unit or other regimes.
    pub fresh: Vec<String>,
    /// Those that no longer exist.
    pub lost: Vec<String>,
}

impl Instance {
    /// Continues where another instance is. A state takes the value of the state with the same path and dimension, and
    /// an automaton takes the regime of the same name. Unnamed memory (held outputs, crossings, delayed values) is
    /// copied if both models have the same; otherwise it keeps its start values. Time, periods and dead times remain
    /// those of this instance, and outputs are computed again. Samples from before the start of this instance are lost.
    pub fn carry(&mut self, from: &Instance) -> Carried {
        let mut carried = Carried::default();
        let (new, old) = (self.description.clone(), from.description.clone());
        let is_state = |quantity: &&Quantity| matches!(quantity.kind, Kind::State | Kind::SampledState);
        let same_memory = new.layout.memory.len == old.layout.memory.len
            && new.ticks.len() == old.ticks.len()
            && new.quantities.iter().filter(is_state).map(|q| &q.path).eq(old
                .quantities
                .iter()
                .filter(is_state)
                .map(|q| &q.path));
        if same_memory {
            let periods = new.ticks.iter().map(|tick| tick.period);
            let delays = new.delays.iter().flat_map(|delay| [delay.time, delay.back].into_iter().chain(delay.weight));
            let own: Vec<(Slot, f64)> = periods.chain(delays).map(|slot| (slot, self.get(slot))).collect();
            let memory = &from.block()[old.layout.memory.range()];
            self.numbers[new.layout.memory.range()].copy_from_slice(memory);
            own.into_iter().for_each(|(slot, value)| self.set(slot, value));
        }
        let mut begins = false;
        for (k, delay) in new.delays.iter().enumerate() {
            let before = old.delays.get(k).filter(|_| same_memory && new.delays.len() == old.delays.len());
            begins |= !before.is_some_and(|before| self.carry_past(delay, from, before));
        }
        if begins {
            carried.fresh.push("what is delayed".into());
        }
        for state in new.quantities.iter().filter(is_state) {
            let fits = |before: &&Quantity| {
                before.path == state.path && before.kind == state.kind && before.unit.dimension == state.unit.dimension
            };
            match old.quantities.iter().find(fits) {
                Some(before) => {
                    self.set(state.slot, from.get(before.slot));
                    carried.kept.push(state.path.clone());
                }
                None => carried.fresh.push(state.path.clone()),
            }
        }
        let named = |automaton: &Automaton| match automaton.path.as_str() {
            "" => "its regime".to_string(),
            path => format!("{path}'s regime"),
        };
        for automaton in &new.automata {
            let regime = old.automata.iter().find(|before| before.path == automaton.path).and_then(|before| {
                let name = before.regimes.get(from.get(before.slot) as usize)?;
                automaton.regimes.iter().position(|regime| regime == name)
            });
            match regime {
                Some(regime) => {
                    self.set(automaton.slot, regime as f64);
                    carried.kept.push(named(automaton));
                }
                None => carried.fresh.push(named(automaton)),
            }
        }
        let gone = |path: &str| !new.quantities.iter().filter(is_state).any(|state| state.path == path);
        carried.lost =
            old.quantities.iter().filter(is_state).map(|q| q.path.clone()).filter(|path| gone(path)).collect();
        self.call(Function::Outputs);
        carried
    }

    /// Fills a ring by linear interpolation between the samples of another ring. Returns whether these reach back far
    /// enough. Rings have fixed steps, so the result is false if either instance has no step length.
    fn carry_past(&mut self, delay: &Delay, from: &Instance, before: &Delay) -> bool {
        let (len, count, h) = (delay.ring.len as usize, self.get(Slot::COUNT) as usize, self.get(Slot::STEP));
        let (old_len, old_count, old_h) =
            (before.ring.len as usize, from.get(Slot::COUNT) as usize, from.get(Slot::STEP));
        if len == 0 || old_len == 0 || h <= 0.0 || old_h <= 0.0 {
            return false;
        }
        // The sample so many steps ago in the other instance, clamped to the start of its ring and its time.
        let sample = |ago: usize| {
            let number = old_count - ago.min(old_count).min(old_len - 1);
            from.get(before.ring.slot(number % old_len))
        };
        for k in 0..len.min(count + 1) {
            let ago = k as f64 * (h / old_h);
            let (newer, older) = (sample(ago as usize), sample(ago as usize + 1));
            let value = newer + ago.fract() * (older - newer);
            self.set(delay.ring.slot((count - k) % len), value);
        }
        old_count == 0 || count as f64 * h >= self.get(delay.time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Layout;
    use crate::table::{Interpret, Prepared};

    /// Counts steps only in calls for several steps, and does not store time.
    struct Counts;

    impl Interpret for Counts {
        fn call(&self, function: Function, block: &mut [f64], _: &[f64], count: u64) -> u64 {
            if function == Function::Step && count != 1 {
                block[Slot::COUNT.index()] += count as f64;
            }
            0
        }
        fn has(&self, function: Function) -> bool {
            function != Function::Transitions
        }
    }

    #[test]
    fn count_and_time_are_stored_after_steps_whose_code_does_not() {
        let layout = Layout::new([0; 10]);
        let description = Arc::new(Description { layout, ..Description::default() });
        let mut instance = Instance::new(description, Code::Interpreted(Arc::new(Counts)), &[]);
        instance.start(0.25);
        assert_eq!((instance.advance(3), instance.get(Slot::TIME)), (0, 0.75));
        assert_eq!((instance.advance(1), instance.get(Slot::COUNT), instance.get(Slot::TIME)), (0, 4.0, 1.0));
        instance.set(Slot::TIME, 9.0);
        instance.call(Function::Outputs);
        instance.advance(0);
        assert_eq!(instance.get(Slot::TIME), 9.0, "what makes no step leaves it");
    }

    /// Computes the hoisted value in slot 6, after the block: twice the parameter in slot 3. Slot 5 counts the calls.
    unsafe extern "C" fn prepare(block: *mut f64, _: *const f64, _: u64) -> u64 {
        // SAFETY: the block has six slots and a number behind them.
        unsafe {
            *block.add(6) = 2.0 * *block.add(3);
            *block.add(5) += 1.0;
        }
        0
    }

    /// Adds the hoisted value to the state in slot 4.
    unsafe extern "C" fn step(block: *mut f64, _: *const f64, _: u64) -> u64 {
        // SAFETY: as above.
        unsafe { *block.add(4) += *block.add(6) };
        0
    }

    #[test]
    fn hoisted_values_are_computed_again_when_a_parameter_changes() {
        let layout = Layout::new([1, 0, 1, 1, 0, 0, 0, 0, 0, 0]);
        let (param, state, prepared) = (layout.params.slot(0), layout.states.slot(0), layout.memory.slot(0));
        let description = Arc::new(Description { layout, ..Description::default() });
        // SAFETY: they access the block and one number behind it.
        let machine = unsafe {
            Machine::new([None; Function::ALL.len()], 6, 0, Arc::new(())).with_prepared(Prepared {
                prepare: Some(prepare),
                step,
                len: 1,
            })
        };
        let mut instance = Instance::new(description, Code::Machine(machine), &[1.0]);
        let mut after = |change: &dyn Fn(&mut Instance)| {
            change(&mut instance);
            instance.advance(1);
            (instance.get(state), instance.get(prepared), instance.block().len())
        };
        assert_eq!(after(&|_| ()), (2.0, 1.0, 6));
        assert_eq!(after(&|instance| instance.set(state, 10.0)), (12.0, 1.0, 6), "a state prepares nothing");
        assert_eq!(after(&|instance| instance.set(param, 3.0)), (18.0, 2.0, 6));
        assert_eq!(after(&|instance| instance.set(Slot::STEP, 0.5)), (24.0, 3.0, 6));
        assert_eq!(after(&|instance| instance.block_mut()[param.index()] = 4.0), (32.0, 4.0, 6));
        assert_eq!(after(&|instance| *instance = instance.clone()), (40.0, 4.0, 6), "a copy has it too");
    }
}
