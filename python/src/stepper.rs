//! Running instances: fixed steps of a model on its own, with its inputs from outside.

use crate::native::Native;
use crate::text::{Text, method};
use crate::watched::{guarded, in_parts};
use crate::{arrays, raise};
use abi::description::{Guard, Kind, Quantity};
use abi::follow::{Follow, Rows, RowsMut};
use abi::plan::Method;
use abi::{Code, Description, Function, Instance, Slot};
use compiler::Changes;
use compiler::codegen::tiering::{self, Policy};
use compiler::ir::program::Program;
use numpy::PyArrayMethods;
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyFloat, PyTuple};
use runtime::engine;
use std::collections::BTreeMap;
use std::sync::Arc;

/// An argument.
pub type Given<'a, 'py> = Borrowed<'a, 'py, PyAny>;

/// What does not change while it runs.
pub struct Plan {
    text: Py<Text>,
    /// The name of the model.
    pub model: String,
    /// How it is stepped.
    pub method: Method,
    step: f64,
    interpret: bool,
    /// Names and slots, in the order of arguments and results.
    pub inputs: Vec<(String, Slot)>,
    /// Those of the results.
    pub outputs: Vec<(String, Slot)>,
}

impl Plan {
    /// Its text and the files that it names, for pickling.
    pub fn source<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let (name, source) = self.text.get().source_text();
        (name, source, self.text.get().named_files()).into_pyobject(py)
    }

    /// Its method, length of a step in s, and whether it is interpreted.
    pub fn how(&self) -> (&'static str, f64, bool) {
        (self.method.name(), self.step, self.interpret)
    }
}

/// Numbers that were stored as bytes.
pub fn doubles_of(bytes: &[u8]) -> Vec<f64> {
    bytes.chunks_exact(8).map(|bytes| f64::from_le_bytes(bytes.try_into().expect("eight bytes"))).collect()
}

/// A started instance.
pub struct Started {
    /// What does not change.
    pub plan: Arc<Plan>,
    /// Its program.
    pub program: Arc<Program>,
    /// The instance at time 0.
    pub instance: Instance,
    status: u64,
}

/// A running instance of a model.
#[pyclass(module = "fric._fric")]
pub struct Stepper {
    plan: Arc<Plan>,
    /// Values of parameters and parts that differ from the text, as `path=value`.
    set: BTreeMap<String, String>,
    program: Arc<Program>,
    instance: Instance,
    follow: Option<Follow>,
    /// The status of the last step.
    status: u64,
}

/// A program whose delays have room for steps of this length.
fn sized(mut program: Program, step: f64) -> Program {
    if !program.description.delays.is_empty() {
        program.size_rings(step);
    }
    program
}

/// Code of steps that are called one by one: interpreted until compiling pays, and then compiled at once, so that a loop of
/// calls runs on machine code after a known number of steps. Long programs are compiled by another thread meanwhile.
fn stepping(program: &Program, method: Method, interpret: bool) -> Code {
    let len = program.derivatives.ops.len() + program.outputs.ops.len();
    match interpret || compiler::codegen::target::here().is_err() || len > MOST_AT_ONCE {
        true => tiering::on_demand(program, method, interpret),
        false => tiering::tiered(program, method, Policy { in_background: false, ..Policy::usual() }),
    }
}

/// Operations of a program that is compiled within some 10 ms.
const MOST_AT_ONCE: usize = 1000;

/// Whether programs differ in values of parameters alone, so that the code of one serves the other.
fn is_same_code(a: &Program, b: &Program) -> bool {
    let bits = |of: &Program| of.description.pool.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let funcs = |of: &Program| {
        let optional = [&of.tick, &of.transitions, &of.roots].map(Clone::clone);
        (of.start.clone(), of.outputs.clone(), of.derivatives.clone(), optional)
    };
    let (one, other) = (&a.description, &b.description);
    same_slots(a, b)
        && one.quantities == other.quantities
        && one.guards == other.guards
        && one.ticks == other.ticks
        && one.delays == other.delays
        && bits(a) == bits(b)
        && funcs(a) == funcs(b)
}

/// A program with the code of its steps, started.
fn started(program: Program, method: Method, step: f64, interpret: bool) -> (Arc<Program>, Instance, u64) {
    let code = stepping(&program, method, interpret);
    let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    let status = instance.start(step);
    (Arc::new(program), instance, status)
}

impl Started {
    /// Starts a model at time 0. `how`: method, length of a step in s, whether it is interpreted.
    pub fn new(
        py: Python,
        text: Py<Text>,
        model: &str,
        set: &BTreeMap<String, String>,
        (solver, step, interpret): (&str, f64, bool),
        inputs: Option<Vec<String>>,
        outputs: Option<Vec<String>>,
    ) -> PyResult<Started> {
        let method = method(py, solver)?;
        if method == Method::Adaptive {
            return Err(PyValueError::new_err(
                "method: `adaptive` chooses its own steps; take euler, rk4, expo or implicit, or `simulate`",
            ));
        }
        if !(step > 0.0 && step.is_finite()) {
            return Err(raise::range(py, &format!("step: {step} s is no length of a step; it must be above 0")));
        }
        let built = text.get().built(py, model, changes(set, method, step))?;
        let (program, instance, status) = guarded(py, || started(sized(built.program, step), method, step, interpret))?;
        let all = &program.description.quantities;
        let of = |kind: Kind| all.iter().filter(move |q| q.kind == kind).map(|q| q.path.clone()).collect();
        let inputs = inputs.unwrap_or_else(|| of(Kind::Input));
        let inputs = slots(py, "input", inputs, all, |quantity| quantity.kind == Kind::Input)?;
        if let Some((_, (name, _))) = inputs.iter().enumerate().find(|(k, one)| inputs[..*k].contains(one)) {
            return Err(PyValueError::new_err(format!("inputs: `{name}` is there twice")));
        }
        let is_seen = |quantity: &Quantity| quantity.kind != Kind::Regime;
        let outputs = slots(py, "output", outputs.unwrap_or_else(|| of(Kind::Output)), all, is_seen)?;
        if outputs.is_empty() {
            return Err(PyValueError::new_err(format!("`{model}` has no output: name some, such as outputs=[\"x\"]")));
        }
        let plan = Plan { text, model: model.into(), method, step, interpret, inputs, outputs };
        Ok(Started { plan: Arc::new(plan), program, instance, status })
    }

    /// Starts the same model with other parameters.
    pub fn again(py: Python, plan: &Arc<Plan>, set: &BTreeMap<String, String>) -> PyResult<Started> {
        let Plan { method, step, interpret, ref model, ref text, .. } = **plan;
        let built = text.get().built(py, model, changes(set, method, step))?;
        let (program, instance, status) = guarded(py, || started(sized(built.program, step), method, step, interpret))?;
        Ok(Started { plan: plan.clone(), program, instance, status })
    }

    /// Starts the same model with other parameters, by the code of a running instance if that is the same.
    fn like(
        py: Python,
        plan: &Arc<Plan>,
        set: &BTreeMap<String, String>,
        program: &Program,
        instance: &Instance,
    ) -> PyResult<Started> {
        let Plan { method, step, interpret, ref model, ref text, .. } = **plan;
        let built = text.get().built(py, model, changes(set, method, step))?;
        let begin = || {
            let made = sized(built.program, step);
            if !is_same_code(&made, program) {
                return started(made, method, step, interpret);
            }
            let mut instance = instance.clone();
            instance.block_mut()[made.description.layout.params.range()].copy_from_slice(&made.params);
            let status = instance.start(step);
            (Arc::new(made), instance, status)
        };
        let (program, instance, status) = guarded(py, begin)?;
        Ok(Started { plan: plan.clone(), program, instance, status })
    }

    /// Why the steps of the other do not differ in values of parameters alone. Ranges are not compared.
    pub fn difference(&self, other: &Started) -> Option<&'static str> {
        // Tables may have NaN, which equals nothing.
        let bits = |of: &Program| of.description.pool.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        let step = |of: &Program| tiering::step(&with_guards(of, &self.program.description.guards), self.plan.method);
        let (a, b) = (&*self.program, &*other.program);
        let guarded = |of: &Program| of.description.guards.iter().map(|guard| guard.slot).collect::<Vec<_>>();
        if !same_slots(a, b) || guarded(a) != guarded(b) {
            Some("the parts of the model")
        } else if bits(a) != bits(b) {
            Some("tables")
        } else if step(a) != step(b) {
            Some("equations")
        } else {
            None
        }
    }

    /// An instance at time 0 whose steps watch these ranges, and its program.
    pub fn guarded_by(&self, guards: &[Guard]) -> (Program, Instance) {
        let program = with_guards(&self.program, guards);
        let code = tiering::on_demand(&program, self.plan.method, self.plan.interpret);
        let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
        instance.block_mut().copy_from_slice(self.instance.block());
        (program, instance)
    }

    /// The exception of a start that failed.
    pub fn checked(&self, py: Python) -> PyResult<()> {
        checked(py, &self.instance, self.status, None)
    }
}

fn with_guards(program: &Program, guards: &[Guard]) -> Program {
    let description = Description { guards: guards.to_vec(), ..program.description.clone() };
    Program { description, ..program.clone() }
}

fn same_slots(a: &Program, b: &Program) -> bool {
    let paths = |of: &Program| of.description.quantities.iter().map(|q| (q.path.clone(), q.slot)).collect::<Vec<_>>();
    a.description.layout == b.description.layout && paths(a) == paths(b)
}

/// The exception of a status that is not 0. `rows`: what was computed before.
fn checked(py: Python, instance: &Instance, status: u64, rows: Option<&Bound<PyAny>>) -> PyResult<()> {
    match engine::failure(instance, status) {
        None => Ok(()),
        Some(failure) => Err(raise::run_error(py, &failure.to_string(), failure.time, rows.cloned())),
    }
}

/// The names.
pub fn names_of(all: &[(String, Slot)]) -> Vec<&str> {
    all.iter().map(|(name, _)| name.as_str()).collect()
}

/// The slots of these names.
pub fn slots(
    py: Python,
    what: &str,
    names: Vec<String>,
    all: &[Quantity],
    fits: impl Fn(&Quantity) -> bool,
) -> PyResult<Vec<(String, Slot)>> {
    let known = || all.iter().filter(|quantity| fits(quantity)).map(|quantity| quantity.path.clone());
    let slot = |name: String| match all.iter().find(|quantity| quantity.path == name && fits(quantity)) {
        Some(quantity) => Ok((name, quantity.slot)),
        None => Err(raise::unknown(py, what, &name, &known().collect::<Vec<_>>())),
    };
    names.into_iter().map(slot).collect()
}

#[pymethods]
impl Stepper {
    /// Starts a model at time 0.
    #[new]
    #[allow(clippy::too_many_arguments, reason = "the Python files name each of them")]
    fn new(
        py: Python,
        text: Py<Text>,
        model: &str,
        set: BTreeMap<String, String>,
        solver: &str,
        step: f64,
        inputs: Option<Vec<String>>,
        outputs: Option<Vec<String>>,
        interpret: bool,
    ) -> PyResult<Stepper> {
        let started = Started::new(py, text, model, &set, (solver, step, interpret), inputs, outputs)?;
        started.checked(py)?;
        let Started { plan, program, instance, status } = started;
        Ok(Stepper { plan, set, program, instance, follow: None, status })
    }

    /// A step for each row of inputs; returns the rows of outputs.
    #[pyo3(signature = (rows, out=None))]
    fn follow<'py>(
        &mut self,
        py: Python<'py>,
        rows: &Bound<'py, PyAny>,
        out: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (n, m) = (self.plan.inputs.len(), self.plan.outputs.len());
        if n == 0 {
            return Err(PyTypeError::new_err(format!("`{}` has no input to follow: use hold(count)", self.plan.model)));
        }
        let (given, count) = arrays::rows(rows, n, "rows")?;
        let given = given.readonly();
        let follow = self.following(py)?;
        let (instance, status) = (&mut self.instance, &mut self.status);
        let given = given.as_slice().map_err(|error| PyValueError::new_err(error.to_string()))?;
        let mut go = |numbers: &mut [f64]| {
            let part = |done: u64, some: u64| {
                let done = done as usize;
                let (from, to) = (&given[done * n..], &mut numbers[done * m..]);
                let (rows, to) = (Rows { numbers: from, stride: n }, RowsMut { numbers: to, stride: m });
                instance.follow(&follow, rows, to, some)
            };
            let done = in_parts(py, count as u64, part)?;
            *status = done.1;
            PyResult::Ok(done)
        };
        let shape = |rows: usize| if m > 1 { vec![rows, m] } else { vec![rows] };
        if let Some(out) = out {
            let array = arrays::target(&out, &shape(count))?;
            let mut write = array.try_readwrite().map_err(|error| PyValueError::new_err(format!("out: {error}")))?;
            let numbers = write.as_slice_mut().map_err(|error| PyValueError::new_err(format!("out: {error}")))?;
            let (_, status) = go(numbers)?;
            drop(write);
            checked(py, &self.instance, status, None)?;
            return Ok(out);
        }
        let mut numbers = vec![0.0; count * m];
        let (done, status) = go(&mut numbers)?;
        numbers.truncate(done as usize * m);
        let array = arrays::array(py, numbers, Some(&shape(done as usize)))?;
        checked(py, &self.instance, status, Some(&array))?;
        Ok(array)
    }

    /// Names of the arguments of `step`.
    #[getter]
    fn inputs(&self) -> Vec<&str> {
        names_of(&self.plan.inputs)
    }

    /// Names of its results.
    #[getter]
    fn outputs(&self) -> Vec<&str> {
        names_of(&self.plan.outputs)
    }

    /// Time in s.
    #[getter]
    fn time(&self) -> f64 {
        self.instance.get(Slot::TIME)
    }

    /// The length of a step in s.
    #[getter]
    fn h(&self) -> f64 {
        self.plan.step
    }

    /// Names of the states, in the order of `state`.
    #[getter]
    fn states(&self) -> Vec<&str> {
        self.state_quantities().map(|quantity| quantity.path.as_str()).collect()
    }

    /// The states, a copy.
    #[getter]
    fn get_state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::array(py, self.state_quantities().map(|state| self.instance.get(state.slot)).collect(), None)
    }

    #[setter]
    fn set_state(&mut self, value: &Bound<PyAny>) -> PyResult<()> {
        let slots: Vec<Slot> = self.state_quantities().map(|state| state.slot).collect();
        let (array, shape) = arrays::doubles(value, "state")?;
        if shape != [slots.len()] {
            let message = format!("state: an array of shape {shape:?} was given, and ({},) is needed", slots.len());
            return Err(PyValueError::new_err(message));
        }
        let read = array.readonly();
        let numbers = read.as_slice().map_err(|error| PyValueError::new_err(error.to_string()))?;
        slots.into_iter().zip(numbers).for_each(|(slot, value)| self.instance.set(slot, *value));
        self.instance.call(Function::Outputs);
        Ok(())
    }

    /// The regime of each automaton, by the path of its part.
    #[getter]
    fn regime(&self) -> BTreeMap<&str, &str> {
        let automata = self.program.description.automata.iter();
        let name = |automaton: &'_ abi::description::Automaton| self.instance.get(automaton.slot) as usize;
        automata
            .filter_map(|automaton| Some((automaton.path.as_str(), automaton.regimes.get(name(automaton))?.as_str())))
            .collect()
    }

    fn __getitem__(&self, py: Python, path: &str) -> PyResult<f64> {
        let all = &self.program.description.quantities;
        let found = slots(py, "quantity", vec![path.into()], all, |quantity| quantity.kind != Kind::Regime)?;
        Ok(self.instance.get(found[0].1))
    }

    /// Sets parameters together: a number is in SI, a text is read by the language. The states, inputs and time stay.
    /// Nothing changes if one of them does not fit.
    #[pyo3(signature = (values=None, /, **named))]
    fn set(&mut self, py: Python, values: Option<Bound<PyDict>>, named: Option<Bound<PyDict>>) -> PyResult<()> {
        let mut changed = BTreeMap::new();
        for (path, value) in values.iter().chain(&named).flat_map(|given| given.iter()) {
            let path: String = path.extract()?;
            let value = self.written(py, &path, &value)?;
            changed.insert(path, value);
        }
        self.change(py, changed)
    }

    /// Sets a parameter, an input or a state.
    fn __setitem__(&mut self, py: Python, path: &str, value: Bound<PyAny>) -> PyResult<()> {
        let all = &self.program.description.quantities;
        let found = slots(py, "quantity", vec![path.into()], all, |quantity| quantity.kind != Kind::Regime)?;
        let quantity = all.iter().find(|quantity| quantity.path == path).expect("it was just found");
        match quantity.kind {
            Kind::Param => {
                let value = self.written(py, path, &value)?;
                self.change(py, BTreeMap::from([(path.to_string(), value)]))
            }
            Kind::Input | Kind::State | Kind::SampledState => {
                let si = abi::unit::Unit::si(quantity.unit.dimension).text;
                let number = raise::value(py, "number", path, &value, &si, quantity.boolean)?.extract()?;
                self.instance.set(found[0].1, number);
                Ok(())
            }
            Kind::Output | Kind::Let | Kind::Regime | Kind::Observed => {
                let message = format!("`{path}` is computed; parameters, inputs and states can be set");
                Err(PyTypeError::new_err(message))
            }
        }
    }

    /// Starts anew at time 0.
    fn reset(&mut self, py: Python) -> PyResult<()> {
        self.status = self.instance.start(self.plan.step);
        checked(py, &self.instance, self.status, None)
    }

    /// The step as machine code, for callers such as numba: its address, a copy of the block, and where quantities are.
    #[getter]
    fn ctypes(&self, py: Python) -> PyResult<Native> {
        let (program, method) = (self.program.clone(), self.plan.method);
        let made = || {
            let mut functions = tiering::functions(&program, method);
            functions.retain(|(function, _)| *function == Function::Step);
            let description = &program.description;
            compiler::codegen::jit::compile(&functions, &description.layout, description.pool.len())
        };
        let (machine, _) = guarded(py, || py.detach(made))?.map_err(|why| PyRuntimeError::new_err(why.to_string()))?;
        Native::new(py, machine, self.instance.block(), &self.program.description)
    }

    /// A second instance that continues from the same state.
    fn copy(&self) -> Stepper {
        Stepper {
            plan: self.plan.clone(),
            set: self.set.clone(),
            program: self.program.clone(),
            instance: self.instance.clone(),
            follow: self.follow.clone(),
            status: self.status,
        }
    }

    fn __copy__(&self) -> Stepper {
        self.copy()
    }

    fn __deepcopy__(&self, _memo: &Bound<PyDict>) -> Stepper {
        self.copy()
    }

    /// What `fric._restore.stepper` needs to make the same instance elsewhere.
    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let block: Vec<u8> = self.instance.block().iter().flat_map(|x| x.to_le_bytes()).collect();
        let rest = (
            self.plan.source(py)?,
            &self.plan.model,
            &self.set,
            self.plan.how(),
            names_of(&self.plan.inputs),
            names_of(&self.plan.outputs),
            PyBytes::new(py, &block),
        );
        Ok((raise::function(py, "stepper")?, rest.into_pyobject(py)?))
    }

    /// Continues from the block of another instance of the same model.
    fn restore(&mut self, block: &[u8]) -> PyResult<()> {
        let numbers = doubles_of(block);
        if numbers.len() != self.instance.block().len() {
            return Err(PyValueError::new_err(
                "this instance was stored by another version of fric, whose models have another layout",
            ));
        }
        self.instance.block_mut().copy_from_slice(&numbers);
        Ok(())
    }

    fn __repr__(&self) -> String {
        let names = |all: &[(String, Slot)]| names_of(all).join(", ");
        format!(
            "<fric.Stepper {}: ({}) -> ({}) by {}, step {} s, at {} s>",
            self.plan.model,
            names(&self.plan.inputs),
            names(&self.plan.outputs),
            self.plan.method.name(),
            self.plan.step,
            self.time()
        )
    }
}

/// Changes with these settings.
fn changes(set: &BTreeMap<String, String>, method: Method, step: f64) -> Changes {
    let set = set.iter().map(|(path, value)| format!("{path}={value}")).collect();
    Changes { set, method: Some(method), step: Some(step), ..Changes::default() }
}

impl Stepper {
    /// A value as the language reads it.
    fn written(&self, py: Python, path: &str, value: &Bound<PyAny>) -> PyResult<String> {
        let found = self.program.description.quantities.iter().find(|quantity| quantity.path == path);
        let si = found.map_or(String::new(), |quantity| abi::unit::Unit::si(quantity.unit.dimension).text);
        let boolean = found.is_some_and(|quantity| quantity.boolean);
        raise::value(py, "written", path, value, &si, boolean)?.extract()
    }

    /// Makes the program anew with these parameters, and continues in it.
    fn change(&mut self, py: Python, changed: BTreeMap<String, String>) -> PyResult<()> {
        let mut set = self.set.clone();
        set.extend(changed);
        let Started { program, mut instance, .. } = Started::like(py, &self.plan, &set, &self.program, &self.instance)?;
        if !same_slots(&program, &self.program) {
            return Err(raise::range(
                py,
                "this changes the parts of the model, not only its parameters: start it anew with these values",
            ));
        }
        instance.carry(&self.instance);
        let inputs = program.description.layout.inputs.range();
        instance.block_mut()[inputs.clone()].copy_from_slice(&self.instance.block()[inputs]);
        for slot in [Slot::TIME, Slot::COUNT] {
            instance.set(slot, self.instance.get(slot));
        }
        let status = instance.call(Function::Outputs);
        checked(py, &instance, status, None)?;
        if !is_same_code(&program, &self.program) {
            self.follow = None;
        }
        (self.set, self.program, self.instance) = (set, program, instance);
        Ok(())
    }

    /// One step with these inputs; returns the outputs.
    #[inline]
    pub fn step<'py>(&mut self, py: Python<'py>, given: &[Given<'_, 'py>]) -> PyResult<Bound<'py, PyAny>> {
        self.give(given)?;
        self.status = self.instance.advance(1);
        self.results(py)
    }

    /// Steps under held inputs, their number before the inputs; returns the last outputs.
    #[inline]
    pub fn hold<'py>(&mut self, py: Python<'py>, given: &[Given<'_, 'py>]) -> PyResult<Bound<'py, PyAny>> {
        let Some((count, given)) = given.split_first() else {
            return Err(PyTypeError::new_err("hold: the number of steps is needed, before the inputs"));
        };
        let count: u64 = count.extract()?;
        self.give(given)?;
        let instance = &mut self.instance;
        self.status = in_parts(py, count, |_, some| (some, instance.advance(some)))?.1;
        self.results(py)
    }

    /// Writes the inputs.
    #[inline]
    fn give(&mut self, given: &[Given]) -> PyResult<()> {
        let needed = self.plan.inputs.len();
        if given.len() != needed {
            let (names, given) = (self.inputs().join(", "), given.len());
            return Err(PyTypeError::new_err(format!("{needed} inputs are needed, ({names}), and {given} were given")));
        }
        // All are read before one is written, so that a wrong one changes nothing.
        let (mut few, mut many) = ([0.0; 4], Vec::new());
        let numbers = match needed <= few.len() {
            true => &mut few[..needed],
            false => {
                many.resize(needed, 0.0);
                &mut many[..]
            }
        };
        for (k, (number, given)) in numbers.iter_mut().zip(given).enumerate() {
            *number = self.number(k, *given)?;
        }
        self.plan.inputs.iter().zip(numbers).for_each(|((_, slot), number)| self.instance.set(*slot, *number));
        Ok(())
    }

    /// An input as a number.
    #[inline]
    fn number(&self, k: usize, given: Given) -> PyResult<f64> {
        given.extract().map_err(|_: PyErr| {
            let kind = given.get_type().name().map_or_else(|_| "?".into(), |name| name.to_string());
            PyTypeError::new_err(format!("`{}` is a number in SI, not {kind}", self.plan.inputs[k].0))
        })
    }

    /// The outputs: a float, or a tuple of several.
    fn results<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        if self.status != 0 {
            checked(py, &self.instance, self.status, None)?;
        }
        match &self.plan.outputs[..] {
            [(_, slot)] => Ok(PyFloat::new(py, self.instance.get(*slot)).into_any()),
            all => Ok(PyTuple::new(py, all.iter().map(|(_, slot)| self.instance.get(*slot)))?.into_any()),
        }
    }

    fn state_quantities(&self) -> impl Iterator<Item = &Quantity> {
        let all = self.program.description.quantities.iter();
        all.filter(|quantity| matches!(quantity.kind, Kind::State | Kind::SampledState))
    }

    /// The loop over rows, compiled at the first call.
    fn following(&mut self, py: Python) -> PyResult<Follow> {
        if self.follow.is_none() {
            let slots = |all: &[(String, Slot)]| all.iter().map(|(_, slot)| *slot).collect::<Vec<Slot>>();
            let (inputs, outputs) = (slots(&self.plan.inputs), slots(&self.plan.outputs));
            let Plan { method, interpret, .. } = *self.plan;
            let program = self.program.clone();
            let made = || tiering::follow(&program, method, &inputs, &outputs, interpret);
            self.follow = Some(guarded(py, || py.detach(made))?);
        }
        Ok(self.follow.clone().expect("it was just made"))
    }
}
