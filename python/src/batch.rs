//! Many instances of one model, stepped together in lanes and by several threads, with the bits of single ones.

use crate::arrays;
use crate::raise;
use crate::stepper::{Plan, Started, names_of};
use crate::transpose;
use crate::watched::{self, guarded, in_place};
use abi::description::{Guard, Kind};
use abi::lanes::Lanes;
use abi::{Description, Instance, Slot};
use compiler::codegen::tiering;
use compiler::numerics::fixed_step::widened;
use numpy::PyArrayMethods;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple};
use runtime::engine;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Rows of a tile: what is transposed at once. Longer ones leave the nearest cache, and of shorter ones the rows of an
/// instance are read in pieces that are too short for the processor to read ahead.
const TILE: usize = 128;

/// Instances that are stepped together.
#[derive(Clone)]
enum Group {
    /// In the lanes of vectors; those beyond the number of instances repeat the last one.
    Lanes(Box<abi::lanes::Batch>),
    /// One by one, where there is no such code.
    Alone(Vec<Instance>),
}

/// Why an instance stopped: its status, and its block then.
type Stopped = Option<(u64, Vec<f64>)>;

/// Many running instances of a model.
#[pyclass(module = "fric._fric")]
#[derive(Clone)]
pub struct Batch {
    plan: Arc<Plan>,
    template: Instance,
    width: usize,
    len: usize,
    threads: usize,
    groups: Vec<Group>,
    stopped: Vec<Stopped>,
    /// Started blocks and ranges, one for each set of parameters, the sets, and that of each instance.
    sets: Vec<BTreeMap<String, String>>,
    blocks: Vec<Vec<f64>>,
    guards: Vec<Vec<Guard>>,
    starts: Vec<u32>,
    /// Guards whose range depends on the set: the code watches a range that holds for all.
    varied: Vec<usize>,
    /// What each step records: the outputs, and the slots of these guards.
    columns: Vec<Slot>,
}

/// What a worker needs besides its groups.
#[derive(Clone, Copy)]
struct Job<'a> {
    inputs: &'a [Slot],
    outputs: &'a [Slot],
    /// The columns of a tile: the outputs, then what is watched.
    columns: &'a [Slot],
    pool: &'a [f64],
    /// Of the rows of inputs: numbers from one instance to the next, and from one row to the next; 0: held.
    per_instance: usize,
    per_row: usize,
    rows: usize,
    /// A row of outputs after so many steps.
    every: usize,
    template: &'a Instance,
    watched: &'a [Watched],
}

/// A guard whose range the code does not watch.
struct Watched {
    /// Its number, from 0.
    number: usize,
    slot: Slot,
    /// Its range in each set of parameters.
    ranges: Vec<(f64, f64)>,
}

/// The arrays of a group: its own part of inputs, outputs and reasons to stop.
struct Part<'a> {
    group: &'a mut Group,
    stopped: &'a mut [Stopped],
    /// The set of parameters of each instance.
    starts: &'a [u32],
    given: &'a [f64],
    taken: &'a mut [f64],
}

impl Job<'_> {
    /// `goes_on`: asked after every some steps; if it is false, the rest is left out.
    fn go(&self, part: Part, goes_on: &dyn Fn() -> bool) {
        match part.group {
            Group::Lanes(batch) => self.in_lanes(batch, part.stopped, part.starts, (part.given, part.taken), goes_on),
            Group::Alone(instances) => {
                self.alone(instances, part.stopped, part.starts, (part.given, part.taken), goes_on)
            }
        }
    }

    /// Numbers of outputs of an instance.
    fn size(&self) -> usize {
        self.rows / self.every * self.outputs.len()
    }

    /// The first guard beside those of the code that does not hold: its number. `value`: the value of the k-th of them.
    fn violated(&self, set: u32, value: impl Fn(usize) -> f64) -> Option<usize> {
        let mut watched = self.watched.iter().enumerate();
        let outside = |(k, guard): (usize, &Watched)| {
            let (low, high) = guard.ranges[set as usize];
            (!(low..=high).contains(&value(k))).then_some(guard.number)
        };
        watched.find_map(outside)
    }

    fn in_lanes(
        &self,
        batch: &mut abi::lanes::Batch,
        stopped: &mut [Stopped],
        starts: &[u32],
        (given, taken): (&[f64], &mut [f64]),
        goes_on: &dyn Fn() -> bool,
    ) {
        let (width, n, m) = (batch.width(), self.inputs.len(), self.outputs.len());
        let wide = self.columns.len();
        // Lanes beyond the instances, and those that have stopped, move with numbers that are sound.
        let used = stopped.len();
        let most = TILE.min(self.rows);
        let mut into = vec![0.0; most * n * width];
        let mut out = vec![0.0; most * wide * width];
        // The row in a tile from which on an instance has no results, and whether it ran at the begin of the tile.
        let mut ends = vec![0; used];
        let mut runs = vec![true; used];
        let mut again = vec![false; width];
        for begin in (0..self.rows).step_by(TILE).take_while(|_| goes_on()) {
            let rows = TILE.min(self.rows - begin);
            if begin == 0 || self.per_row > 0 {
                let of = |lane: usize| &given[lane.min(used - 1) * self.per_instance + begin * self.per_row..];
                let tile = &mut into[..rows * n * width];
                match (n, self.per_row) {
                    (1, 1) => transpose::to_lanes(|lane| &of(lane)[..rows], tile, width),
                    _ => (0..width).for_each(|lane| self.give_lane(of(lane), tile, (lane, width))),
                }
            }
            let into = &into[..rows * n * width];
            let (from, to) = ((self.inputs, into), (self.columns, &mut out[..rows * wide * width]));
            for (lane, stop) in stopped.iter().enumerate() {
                (ends[lane], runs[lane]) = (if stop.is_some() { 0 } else { rows }, stop.is_none());
            }
            again.fill(false);
            batch.follow(self.pool, from, to, rows, &mut |row, batch| {
                for lane in (0..width).filter(|lane| batch.status(*lane) != 0) {
                    again[lane] = true;
                    if let Some(stop) = stopped.get_mut(lane).filter(|stop| stop.is_none()) {
                        let mut block = self.template.block().to_vec();
                        batch.save(lane, &mut block);
                        *stop = Some((batch.status(lane), block));
                        ends[lane] = row;
                    }
                }
            });
            for lane in (0..used).filter(|lane| runs[*lane] && !self.watched.is_empty()) {
                let value = |row: usize, k: usize| out[(row * wide + k) * width + lane];
                let first = |row: usize| Some((row, self.violated(starts[lane], |k| value(row, m + k))?));
                if let Some((row, guard)) = (0..ends[lane]).find_map(first) {
                    let mut block = self.template.block().to_vec();
                    batch.save(lane, &mut block);
                    // As it was after that step, as far as it is known.
                    block[Slot::COUNT.index()] -= (rows - row - 1) as f64;
                    self.columns.iter().enumerate().for_each(|(k, slot)| block[slot.index()] = value(row, k));
                    (stopped[lane], ends[lane], again[lane]) = (Some((guard as u64 + 1, block)), row, true);
                }
            }
            for lane in (0..width).filter(|lane| again[*lane]) {
                batch.load(lane, self.template.block());
            }
            let tile = &out[..rows * wide * width];
            if self.every == 1 && wide == 1 {
                transpose::from_lanes(tile, width, &mut taken[begin..], self.size(), used);
                for (lane, end) in ends.iter().enumerate() {
                    taken[lane * self.size() + begin..][..rows][*end..].fill(f64::NAN);
                }
            } else {
                for (lane, end) in ends.iter().enumerate() {
                    let to = &mut taken[lane * self.size() + begin / self.every * m..];
                    self.take_lane(tile, to, (lane, width), begin, *end);
                }
            }
        }
    }

    /// Copies rows of inputs of an instance to its lane of a tile. `of`: from the first row on.
    fn give_lane(&self, of: &[f64], tile: &mut [f64], (lane, width): (usize, usize)) {
        let n = self.inputs.len();
        match (n, self.per_row) {
            (0, _) => {}
            (_, 0) => {
                for row in tile.chunks_exact_mut(n * width) {
                    row.chunks_exact_mut(width).zip(of).for_each(|(column, x)| column[lane] = *x);
                }
            }
            _ => {
                for (row, of) in tile.chunks_exact_mut(n * width).zip(of.chunks(self.per_row)) {
                    row.chunks_exact_mut(width).zip(of).for_each(|(column, x)| column[lane] = *x);
                }
            }
        }
    }

    /// Copies the rows of outputs that are due from a lane of a tile to the results of its instance; NaN from row `end` on.
    /// `begin`: the number of the first row of the tile.
    fn take_lane(&self, tile: &[f64], to: &mut [f64], (lane, width): (usize, usize), begin: usize, end: usize) {
        let (m, wide) = (self.outputs.len(), self.columns.len());
        let first = self.every - 1 - begin % self.every;
        let due = tile.chunks_exact(wide * width).enumerate().skip(first).step_by(self.every);
        for ((row, of), to) in due.zip(to.chunks_exact_mut(m)) {
            for (x, column) in to.iter_mut().zip(of.chunks_exact(width)) {
                *x = if row < end { column[lane] } else { f64::NAN };
            }
        }
    }

    fn alone(
        &self,
        instances: &mut [Instance],
        stopped: &mut [Stopped],
        starts: &[u32],
        (given, taken): (&[f64], &mut [f64]),
        goes_on: &dyn Fn() -> bool,
    ) {
        let m = self.outputs.len();
        for (i, (instance, stop)) in instances.iter_mut().zip(stopped).enumerate() {
            for row in 0..self.rows {
                if row % TILE == 0 && !goes_on() {
                    return;
                }
                if stop.is_none() {
                    let from = &given[i * self.per_instance + row * self.per_row..];
                    self.inputs.iter().zip(from).for_each(|(slot, x)| instance.set(*slot, *x));
                    let mut status = instance.advance(1);
                    if status == 0 {
                        let violated = self.violated(starts[i], |k| instance.get(self.watched[k].slot));
                        status = violated.map_or(0, |guard| guard as u64 + 1);
                    }
                    if status != 0 {
                        *stop = Some((status, instance.block().to_vec()));
                    }
                }
                if (row + 1).is_multiple_of(self.every) {
                    let to = &mut taken[i * self.size() + row / self.every * m..][..m];
                    to.iter_mut().zip(self.outputs).for_each(|(x, slot)| {
                        *x = if stop.is_none() { instance.get(*slot) } else { f64::NAN };
                    });
                }
            }
        }
    }
}

/// Guards with ranges that hold for all sets, and the numbers of those that differ.
fn common(guards: &[Vec<Guard>]) -> (Vec<Guard>, Vec<usize>) {
    let mut common = guards[0].clone();
    let mut varied = Vec::new();
    for (k, guard) in common.iter_mut().enumerate() {
        if guards.iter().any(|own| own[k].range != guard.range) {
            let all = guards.iter().map(|own| own[k].range);
            guard.range =
                all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), own| (low.min(own.0), high.max(own.1)));
            varied.push(k);
        }
    }
    (common, varied)
}

#[pymethods]
impl Batch {
    /// Starts instances at time 0. `sets`: different sets of parameters; `which`: that of each instance.
    #[new]
    #[allow(clippy::too_many_arguments, reason = "the Python files name each of them")]
    fn new(
        py: Python,
        text: Py<crate::text::Text>,
        model: &str,
        sets: Vec<BTreeMap<String, String>>,
        which: Vec<usize>,
        solver: &str,
        step: f64,
        inputs: Option<Vec<String>>,
        outputs: Option<Vec<String>>,
        threads: usize,
        interpret: bool,
    ) -> PyResult<Batch> {
        let len = which.len();
        if len == 0 || which.iter().any(|set| *set >= sets.len()) || threads == 0 {
            return Err(PyValueError::new_err("a batch has at least one instance and one thread"));
        }
        let how = (solver, step, interpret);
        let first = Started::new(py, text, model, &sets[0], how, inputs, outputs)?;
        first.checked(py)?;
        let mut blocks = vec![first.instance.block().to_vec()];
        let mut guards = vec![first.program.description.guards.clone()];
        for set in &sets[1..] {
            let other = Started::again(py, &first.plan, set)?;
            if let Some(what) = first.difference(&other) {
                let message = format!("these parameters change {what}, not only numbers: make a batch for each value");
                return Err(raise::range(py, &message));
            }
            other.checked(py)?;
            blocks.push(other.instance.block().to_vec());
            guards.push(other.program.description.guards.clone());
        }
        let (common, varied) = common(&guards);
        let (program, template) = first.guarded_by(&common);
        let slots = |all: &[(String, Slot)]| all.iter().map(|(_, slot)| *slot).collect::<Vec<Slot>>();
        let inputs = slots(&first.plan.inputs);
        let mut columns = slots(&first.plan.outputs);
        columns.extend(varied.iter().map(|guard| common[*guard].slot));
        let lanes: Option<Lanes> = match interpret {
            true => None,
            false => {
                let made = || tiering::lanes_on_rows(&program, first.plan.method, &inputs, &columns);
                guarded(py, || py.detach(made))?
            }
        };
        let width = lanes.as_ref().map_or(8, Lanes::width);
        let group = |which: &[usize]| match &lanes {
            Some(lanes) => {
                let mut batch = abi::lanes::Batch::new(lanes.clone());
                for lane in 0..width {
                    batch.load(lane, &blocks[which[lane.min(which.len() - 1)]]);
                }
                Group::Lanes(Box::new(batch))
            }
            None => Group::Alone(
                which
                    .iter()
                    .map(|set| {
                        let mut instance = template.clone();
                        instance.block_mut().copy_from_slice(&blocks[*set]);
                        instance
                    })
                    .collect(),
            ),
        };
        let groups = which.chunks(width).map(group).collect();
        let starts = which.iter().map(|set| *set as u32).collect();
        let stopped = (0..len).map(|_| None).collect();
        let plan = first.plan;
        Ok(Batch {
            plan,
            template,
            width,
            len,
            threads,
            groups,
            stopped,
            sets,
            blocks,
            guards,
            starts,
            varied,
            columns,
        })
    }

    /// A step of each instance with its row of inputs; returns a row of outputs for each.
    #[pyo3(signature = (inputs=None, out=None))]
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        inputs: Option<Bound<'py, PyAny>>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.hold(py, 1, inputs, out)
    }

    /// Steps of each instance under held inputs; returns the last outputs.
    #[pyo3(signature = (count, inputs=None, out=None))]
    fn hold<'py>(
        &mut self,
        py: Python<'py>,
        count: usize,
        inputs: Option<Bound<'py, PyAny>>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        if count == 0 {
            return Err(PyValueError::new_err("count: at least one step is made"));
        }
        let n = self.plan.inputs.len();
        let given = self.given(inputs, &[self.len, n])?;
        let columns = self.columns(&[self.len]);
        self.go(py, given, (n, 0), (count, count), columns, out)
    }

    /// A step of each instance for each of its rows of inputs, of shape (instances, rows, inputs); returns outputs after
    /// every so many of them.
    #[pyo3(signature = (rows, every=1, out=None))]
    fn follow<'py>(
        &mut self,
        py: Python<'py>,
        rows: &Bound<'py, PyAny>,
        every: usize,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let n = self.plan.inputs.len();
        if n == 0 {
            return Err(PyTypeError::new_err(format!("`{}` has no input to follow: use hold(count)", self.plan.model)));
        }
        let (array, shape) = arrays::doubles(rows, "rows")?;
        let count = match shape[..] {
            [len, count] if n == 1 && len == self.len => count,
            [len, count, columns] if len == self.len && columns == n => count,
            _ => {
                return Err(PyValueError::new_err(format!(
                    "rows: an array of shape {shape:?} was given, and ({}, rows, {n}) is needed",
                    self.len
                )));
            }
        };
        if every == 0 || count % every != 0 {
            return Err(PyValueError::new_err(format!("every: {every} does not divide {count} rows")));
        }
        let columns = self.columns(&[self.len, count / every]);
        self.go(py, Some(array), (count * n, n), (count, every), columns, out)
    }

    fn __len__(&self) -> usize {
        self.len
    }

    /// Which instances have stopped.
    #[getter]
    fn failed<'py>(&self, py: Python<'py>) -> Bound<'py, numpy::PyArray1<bool>> {
        numpy::PyArray1::from_iter(py, self.stopped.iter().map(Option::is_some))
    }

    /// Why an instance has stopped; none if it has not.
    fn why(&self, index: usize) -> PyResult<Option<String>> {
        let stopped = self.stopped.get(index);
        let stopped =
            stopped.ok_or_else(|| pyo3::exceptions::PyIndexError::new_err(format!("{index} of {}", self.len)))?;
        let Some((status, block)) = stopped else { return Ok(None) };
        let guards = self.guards[self.starts[index] as usize].clone();
        let description = Description { guards, ..Description::clone(self.template.description()) };
        let code = abi::Code::Interpreted(Arc::new(compiler::ir::interpret::Interpreter::default()));
        let params = description.layout.params.range();
        let mut instance = Instance::new(Arc::new(description), code, &block[params]);
        instance.block_mut().copy_from_slice(block);
        instance.set(Slot::TIME, instance.get(Slot::COUNT) * instance.get(Slot::STEP));
        Ok(engine::failure(&instance, *status).map(|failure| failure.to_string()))
    }

    /// Names of the states, in the order of the columns of `state`.
    #[getter]
    fn states(&self) -> Vec<String> {
        self.state_slots().into_iter().map(|(path, _)| path).collect()
    }

    /// The states, a copy of shape (instances, states).
    #[getter]
    fn get_state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let states = self.state_slots();
        let mut numbers = Vec::with_capacity(self.len * states.len());
        for index in 0..self.len {
            numbers.extend(states.iter().map(|(_, slot)| self.get(index, *slot)));
        }
        arrays::array(py, numbers, Some(&[self.len, states.len()]))
    }

    #[setter]
    fn set_state(&mut self, value: &Bound<PyAny>) -> PyResult<()> {
        let states = self.state_slots();
        let (array, shape) = arrays::doubles(value, "state")?;
        if shape != [self.len, states.len()] {
            let needed = (self.len, states.len());
            return Err(PyValueError::new_err(format!("state: shape {shape:?} was given, and {needed:?} is needed")));
        }
        let numbers = array.to_vec().map_err(|error| PyValueError::new_err(error.to_string()))?;
        for (index, row) in numbers.chunks_exact(states.len().max(1)).enumerate() {
            states.iter().zip(row).for_each(|((_, slot), x)| self.set(index, *slot, *x));
        }
        Ok(())
    }

    /// A quantity of all instances.
    fn __getitem__<'py>(&self, py: Python<'py>, path: &str) -> PyResult<Bound<'py, PyAny>> {
        let all = &self.template.description().quantities;
        let slot = crate::stepper::slots(py, "quantity", vec![path.into()], all, |q| q.kind != Kind::Regime)?[0].1;
        arrays::array(py, (0..self.len).map(|index| self.get(index, slot)).collect(), None)
    }

    /// Starts instances anew at time 0: all, or those where the mask is true.
    #[pyo3(signature = (mask=None))]
    fn reset(&mut self, mask: Option<Bound<PyAny>>) -> PyResult<()> {
        let mask: Vec<bool> = match mask {
            None => vec![true; self.len],
            Some(mask) => mask.call_method0("tolist").unwrap_or(mask).extract()?,
        };
        if mask.len() != self.len {
            return Err(PyValueError::new_err(format!("mask: {} values for {} instances", mask.len(), self.len)));
        }
        for index in (0..self.len).filter(|index| mask[*index]) {
            let block = &self.blocks[self.starts[index] as usize];
            match &mut self.groups[index / self.width] {
                Group::Lanes(batch) => batch.load(index % self.width, block),
                Group::Alone(instances) => instances[index % self.width].block_mut().copy_from_slice(block),
            }
            self.stopped[index] = None;
        }
        Ok(())
    }

    /// A second batch that continues from the same states.
    fn copy(&self) -> Batch {
        self.clone()
    }

    fn __copy__(&self) -> Batch {
        self.clone()
    }

    fn __deepcopy__(&self, _memo: &Bound<PyDict>) -> Batch {
        self.clone()
    }

    /// What `fric._restore.batch` needs to make the same batch elsewhere.
    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let mut blocks = Vec::new();
        let mut block = self.template.block().to_vec();
        for index in 0..self.len {
            match &self.groups[index / self.width] {
                Group::Lanes(batch) => batch.save(index % self.width, &mut block),
                Group::Alone(instances) => block.copy_from_slice(instances[index % self.width].block()),
            }
            blocks.extend(block.iter().flat_map(|x| x.to_le_bytes()));
        }
        let bytes = |block: &[f64]| block.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let mut stopped = Vec::new();
        for (index, stop) in self.stopped.iter().enumerate() {
            if let Some((status, block)) = stop {
                stopped.push((index, *status, PyBytes::new(py, &bytes(block))));
            }
        }
        let which: Vec<u32> = self.starts.clone();
        let state = (PyBytes::new(py, &blocks), stopped);
        let rest = (
            self.plan.source(py)?,
            &self.plan.model,
            self.sets.clone(),
            which,
            self.plan.how(),
            names_of(&self.plan.inputs),
            names_of(&self.plan.outputs),
            self.threads,
            state,
        );
        Ok((raise::function(py, "batch")?, rest.into_pyobject(py)?))
    }

    /// Continues from the blocks of another batch of the same model.
    fn restore(&mut self, blocks: &[u8], stopped: Vec<(usize, u64, Vec<u8>)>) -> PyResult<()> {
        let size = self.template.block().len();
        let numbers = crate::stepper::doubles_of(blocks);
        let ends: Vec<(usize, u64, Vec<f64>)> =
            stopped.iter().map(|(index, status, block)| (*index, *status, crate::stepper::doubles_of(block))).collect();
        let fits = ends.iter().all(|(index, _, block)| *index < self.len && block.len() == size);
        if numbers.len() != self.len * size || !fits {
            return Err(PyValueError::new_err(
                "this batch was stored by another version of fric, whose models have another layout",
            ));
        }
        for (index, block) in numbers.chunks_exact(size).enumerate() {
            match &mut self.groups[index / self.width] {
                Group::Lanes(batch) => batch.load(index % self.width, block),
                Group::Alone(instances) => instances[index % self.width].block_mut().copy_from_slice(block),
            }
        }
        for (index, status, block) in ends {
            self.stopped[index] = Some((status, block));
        }
        Ok(())
    }

    /// Names of the columns of inputs.
    #[getter]
    fn inputs(&self) -> Vec<&str> {
        names_of(&self.plan.inputs)
    }

    /// Names of the columns of outputs.
    #[getter]
    fn outputs(&self) -> Vec<&str> {
        names_of(&self.plan.outputs)
    }

    fn __repr__(&self) -> String {
        let (n, m) = (names_of(&self.plan.inputs).join(", "), names_of(&self.plan.outputs).join(", "));
        let threads = if self.threads > 1 { format!(", {} threads", self.threads) } else { String::new() };
        format!("<fric.Batch of {} {}: ({n}) -> ({m}){threads}>", self.len, self.plan.model)
    }
}

impl Batch {
    /// Inputs of this shape; without its last dimension if there is one input.
    fn given<'py>(
        &self,
        inputs: Option<Bound<'py, PyAny>>,
        shape: &[usize],
    ) -> PyResult<Option<Bound<'py, numpy::PyArrayDyn<f64>>>> {
        let n = self.plan.inputs.len();
        let Some(inputs) = inputs else {
            return match n {
                0 => Ok(None),
                _ => Err(PyTypeError::new_err(format!("inputs: an array of shape {shape:?} is needed"))),
            };
        };
        let (array, given) = arrays::doubles(&inputs, "inputs")?;
        let fits = given == shape || n == 1 && given == shape[..shape.len() - 1];
        if !fits {
            return Err(PyValueError::new_err(format!("inputs: shape {given:?} was given, and {shape:?} is needed")));
        }
        Ok(Some(array))
    }

    /// The shape of results.
    fn columns(&self, before: &[usize]) -> Vec<usize> {
        let m = self.plan.outputs.len();
        before.iter().copied().chain((m > 1).then_some(m)).collect()
    }

    /// Makes steps. `per`: numbers of inputs from one instance to the next, and from one row to the next.
    fn go<'py>(
        &mut self,
        py: Python<'py>,
        given: Option<Bound<'py, numpy::PyArrayDyn<f64>>>,
        per: (usize, usize),
        (rows, every): (usize, usize),
        shape: Vec<usize>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let inputs: Vec<Slot> = self.plan.inputs.iter().map(|(_, slot)| *slot).collect();
        let outputs: Vec<Slot> = self.plan.outputs.iter().map(|(_, slot)| *slot).collect();
        let read = given.as_ref().map(|given| given.readonly());
        let given = match &read {
            Some(read) => read.as_slice().map_err(|error| PyValueError::new_err(error.to_string()))?,
            None => &[],
        };
        let target = out.as_ref().map(|out| arrays::target(out, &shape)).transpose()?;
        let mut write = match &target {
            Some(target) => {
                Some(target.try_readwrite().map_err(|error| PyValueError::new_err(format!("out: {error}")))?)
            }
            None => None,
        };
        let mut own = if write.is_none() { vec![0.0; shape.iter().product()] } else { Vec::new() };
        let taken = match &mut write {
            Some(write) => write.as_slice_mut().map_err(|error| PyValueError::new_err(format!("out: {error}")))?,
            None => &mut own[..],
        };
        let description = self.template.description().clone();
        let watched: Vec<Watched> = self
            .varied
            .iter()
            .map(|k| Watched {
                number: *k,
                slot: self.guards[0][*k].slot,
                ranges: self.guards.iter().map(|own| widened(own[*k].range)).collect(),
            })
            .collect();
        let job = Job {
            inputs: &inputs,
            outputs: &outputs,
            columns: &self.columns,
            pool: &description.pool,
            per_instance: per.0,
            per_row: per.1,
            rows,
            every,
            template: &self.template,
            watched: &watched,
        };
        let starts = &self.starts;
        let (width, size, threads) = (self.width, job.size(), self.threads.min(self.groups.len()));
        let groups = self.groups.iter_mut().zip(self.stopped.chunks_mut(width));
        let parts = groups.zip(taken.chunks_mut((width * size).max(1))).enumerate();
        let parts: Vec<Part> = parts
            .map(|(k, ((group, stopped), taken))| {
                let end = ((k * width + stopped.len()) * per.0).min(given.len());
                let starts = &starts[k * width..][..stopped.len()];
                Part { group, stopped, starts, given: &given[(k * width * per.0).min(end)..end], taken }
            })
            .collect();
        match threads {
            0 | 1 => in_place(py, |goes_on| parts.into_iter().for_each(|part| job.go(part, goes_on)))?,
            _ => {
                let queue = std::sync::Mutex::new(parts.into_iter());
                let next = || queue.lock().unwrap_or_else(std::sync::PoisonError::into_inner).next();
                watched::watched(py, None, |progress| {
                    let goes_on = || !progress.stop().load(Ordering::Relaxed);
                    std::thread::scope(|scope| {
                        for _ in 0..threads {
                            scope.spawn(|| {
                                while let Some(part) = next() {
                                    job.go(part, &goes_on);
                                }
                            });
                        }
                    });
                })?;
            }
        }
        drop(write);
        match out {
            Some(out) => Ok(out),
            None => arrays::array(py, own, Some(&shape)),
        }
    }

    fn state_slots(&self) -> Vec<(String, Slot)> {
        let all = self.template.description().quantities.iter();
        let states = all.filter(|quantity| matches!(quantity.kind, Kind::State | Kind::SampledState));
        states.map(|quantity| (quantity.path.clone(), quantity.slot)).collect()
    }

    /// A slot of an instance; of one that has stopped, as it was then.
    fn get(&self, index: usize, slot: Slot) -> f64 {
        if let Some((_, block)) = &self.stopped[index] {
            return block[slot.index()];
        }
        match &self.groups[index / self.width] {
            Group::Lanes(batch) => batch.get(slot, index % self.width),
            Group::Alone(instances) => instances[index % self.width].get(slot),
        }
    }

    fn set(&mut self, index: usize, slot: Slot, value: f64) {
        match &mut self.groups[index / self.width] {
            Group::Lanes(batch) => batch.set(slot, index % self.width, value),
            Group::Alone(instances) => instances[index % self.width].set(slot, value),
        }
    }
}
