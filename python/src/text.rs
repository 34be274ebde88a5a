//! Texts and their runs.

use crate::watched::{guarded, watched};
use crate::{arrays, raise};
use abi::description::{Kind, Quantity, Segment};
use abi::plan::Method;
use abi::unit::Unit;
use abi::{Function, Instance, Slot};
use compiler::{Built, Changes, Options};
use fric::embed::{self, Dialect};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use runtime::record::Recording;
use std::path::PathBuf;
use std::sync::Arc;

/// A text with its experiments and models.
#[pyclass(frozen, module = "fric._fric")]
pub struct Text {
    text: embed::Text,
}

/// What `Text.describe` returns for a quantity: kind, path, unit, SI unit, range in SI, value in SI, whether it is a truth
/// value, documentation.
type Described = (&'static str, String, String, String, (f64, f64), Option<f64>, bool, Option<String>);

#[pymethods]
impl Text {
    /// A text under a name, and the files that it names as they were read elsewhere.
    #[new]
    fn new(py: Python, name: &str, text: &str, files: Vec<embed::NamedFile>) -> PyResult<Text> {
        let loaded = guarded(py, || py.detach(|| embed::Text::new(name, text, files)))?;
        Ok(Text { text: loaded.map_err(|found| raise::problems(py, &found))? })
    }

    /// The text of a file.
    #[staticmethod]
    fn read(path: PathBuf) -> PyResult<String> {
        let about = |why| PyOSError::new_err(format!("cannot read {}: {why}", path.display()));
        embed::Text::read(&path).map_err(about)
    }

    fn source(&self) -> (String, String) {
        self.text.source()
    }

    fn files(&self) -> Vec<embed::NamedFile> {
        self.text.files()
    }

    fn fits(&self) -> Vec<String> {
        self.text.fits()
    }

    fn models(&self) -> Vec<String> {
        self.text.models()
    }

    fn experiments(&self) -> Vec<String> {
        self.text.experiments()
    }

    /// Path and SI unit of each quantity of an experiment.
    fn units(&self, py: Python, experiment: &str) -> PyResult<Vec<(String, String)>> {
        let found = guarded(py, || py.detach(|| self.text.units(experiment)))?;
        found.map_err(|found| raise::problems(py, &found))
    }

    /// The text with further lines at the end of a model.
    fn extended(&self, model: &str, lines: &str) -> Option<String> {
        self.text.extended(model, lines)
    }

    fn equations(&self, model: &str) -> String {
        self.text.equations(model)
    }

    /// Errors and warnings as the JSON of `fric check`.
    fn check(&self, py: Python) -> PyResult<String> {
        Ok(guarded(py, || py.detach(|| self.text.check()))?.json)
    }

    /// Runs an experiment; a run for each case.
    #[allow(clippy::too_many_arguments, reason = "the Python files name each of them")]
    fn run(
        &self,
        py: Python,
        experiment: &str,
        set: Vec<String>,
        solver: Option<&str>,
        step: Option<f64>,
        tol: Option<f64>,
        duration: Option<f64>,
        corners: Vec<f64>,
        errors: bool,
        interpret: bool,
        progress: Option<Bound<PyAny>>,
    ) -> PyResult<Vec<Run>> {
        let method = solver.map(|name| method(py, name)).transpose()?;
        let changes = Changes { set, method, step, tol, duration, ..Changes::default() };
        let options = Options { changes, interpret };
        let runs = watched(py, progress.as_ref(), |progress| {
            self.text.run(experiment, &options, &corners, errors, &|fraction| progress.report(fraction))
        })?;
        let runs = runs.map_err(|found| raise::problems(py, &found))?;
        Ok(runs.into_iter().map(|run| Run { run }).collect())
    }

    /// What `fric explain` says of a model: in words, and as JSON.
    fn explain(&self, py: Python, model: &str, set: Vec<String>) -> PyResult<(String, String)> {
        let changes = Changes { set, ..Changes::default() };
        let found = guarded(py, || py.detach(|| self.text.explain(model, &changes)))?;
        found.map_err(|found| raise::problems(py, &found))
    }

    /// The JSON of `fric linearise`.
    #[allow(clippy::too_many_arguments, reason = "the Python files name each of them")]
    fn linearise(
        &self,
        py: Python,
        name: &str,
        set: Vec<String>,
        inputs: Vec<String>,
        outputs: Vec<String>,
        params: Vec<String>,
        at: Vec<(String, String)>,
        time: Option<f64>,
        rest: bool,
    ) -> PyResult<String> {
        let changes = Changes { set, ..Changes::default() };
        let ports = embed::Ports { inputs, outputs, params, broken: None };
        let found = guarded(py, || py.detach(|| self.text.linearise(name, changes, ports, &at, time, rest)))?;
        found.map_err(|found| raise::problems(py, &found))
    }

    /// Where a quantity comes to rest while inputs are held: see `embed::Text::steady`.
    fn steady<'py>(
        &self,
        py: Python<'py>,
        model: &str,
        set: Vec<String>,
        quantity: &str,
        inputs: Vec<(String, Vec<f64>)>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let changes = Changes { set, ..Changes::default() };
        let work = |progress: &crate::watched::Progress| {
            self.text.steady(model, &changes, quantity, &inputs, &|fraction| progress.report(fraction))
        };
        let found = watched(py, None, work)?.map_err(|found| raise::problems(py, &found))?;
        arrays::array(py, found, None)
    }

    /// Runs a friction model through the standard battery: the JSON of `fric characterise`, and the page.
    fn characterise(&self, py: Python, model: &str, set: Vec<(String, String)>) -> PyResult<(String, String)> {
        let found = watched(py, None, |_| self.text.characterise(model, &set))?;
        found.map_err(PyValueError::new_err)
    }

    /// A model as Python source for a library.
    fn emit(&self, py: Python, model: &str, set: Vec<String>, dialect: &str) -> PyResult<String> {
        let all: Vec<String> = Dialect::ALL.iter().map(|one| one.name().to_string()).collect();
        let found = Dialect::ALL.into_iter().find(|one| one.name() == dialect);
        let dialect = found.ok_or_else(|| raise::unknown(py, "dialect", dialect, &all))?;
        let changes = Changes { set, ..Changes::default() };
        let text = guarded(py, || py.detach(|| self.text.python(model, &changes, dialect)))?;
        text.map_err(|found| raise::problems(py, &found))
    }

    /// What the functions of [`emit`](Text::emit) compute, by the interpreter. `points`: time, states, inputs, parameters
    /// and regimes. Returns for each rates, outputs, states at the start, and regimes after a transition.
    fn evaluate(
        &self,
        py: Python,
        model: &str,
        set: Vec<String>,
        points: Vec<(f64, [Vec<f64>; 4])>,
    ) -> PyResult<Vec<[Vec<f64>; 4]>> {
        let program = self.built(py, model, Changes { set, ..Changes::default() })?.program;
        let description = &program.description;
        let layout = &description.layout;
        let code = compiler::codegen::tiering::on_demand(&program, Method::Adaptive, true);
        let mut instance = Instance::new(Arc::new(description.clone()), code, &program.params);
        let outputs = description.quantities.iter().filter(|quantity| quantity.kind == Kind::Output);
        let outputs: Vec<Slot> = outputs.map(|quantity| quantity.slot).collect();
        let segments = [layout.states, layout.inputs, layout.params, layout.regimes];
        let at = |(time, rows): (f64, [Vec<f64>; 4])| {
            if rows.iter().zip(segments).any(|(row, segment)| row.len() != segment.len as usize) {
                let lens = segments.map(|segment| segment.len);
                return Err(PyValueError::new_err(format!(
                    "{lens:?} states, inputs, parameters and regimes are needed"
                )));
            }
            let read = |instance: &Instance, segment: Segment| instance.block()[segment.range()].to_vec();
            let write = |instance: &mut Instance, which: &[usize]| {
                instance.set(Slot::TIME, time);
                for k in which {
                    instance.block_mut()[segments[*k].range()].copy_from_slice(&rows[*k]);
                }
            };
            write(&mut instance, &[1, 2]);
            instance.call(Function::Start);
            let start = read(&instance, layout.states);
            write(&mut instance, &[0, 1, 2, 3]);
            instance.call(Function::Derivatives);
            instance.call(Function::Outputs);
            let rates = read(&instance, layout.derivatives);
            let seen = outputs.iter().map(|slot| instance.get(*slot)).collect();
            if layout.regimes.len > 0 {
                instance.call(Function::Transitions);
            }
            Ok([rates, seen, start, read(&instance, layout.regimes)])
        };
        points.into_iter().map(at).collect()
    }

    /// All named quantities of a model on its own.
    fn describe(&self, py: Python, model: &str, set: Vec<String>) -> PyResult<Vec<Described>> {
        let built = self.built(py, model, Changes { set, ..Changes::default() })?;
        let description = &built.program.description;
        let value = |slot: Slot| {
            let params = description.layout.params;
            params.contains(slot).then(|| built.program.params[(slot.0 - params.start) as usize])
        };
        let of = |quantity: &Quantity| {
            let kind = match quantity.kind {
                Kind::Param => "param",
                Kind::Input => "input",
                Kind::State | Kind::SampledState => "state",
                Kind::Output => "output",
                Kind::Let | Kind::Regime | Kind::Observed => return None,
            };
            let Quantity { path, unit, range, boolean, doc, slot, .. } = quantity;
            let si = Unit::si(unit.dimension).text;
            Some((kind, path.clone(), unit.text.clone(), si, *range, value(*slot), *boolean, doc.clone()))
        };
        Ok(description.quantities.iter().filter_map(of).collect())
    }
}

impl Text {
    /// What the command embeds.
    pub fn inner(&self) -> &embed::Text {
        &self.text
    }

    /// Its name and the text.
    pub fn source_text(&self) -> (String, String) {
        self.text.source()
    }

    /// The files that it names.
    pub fn named_files(&self) -> Vec<embed::NamedFile> {
        self.text.files()
    }

    /// A model on its own.
    pub fn built(&self, py: Python, model: &str, changes: Changes) -> PyResult<Built> {
        let all = self.text.models();
        if self.text.experiments().iter().any(|name| name == model) && !all.iter().any(|name| name == model) {
            return Err(raise::unknown(py, "model", model, &all));
        }
        let built = guarded(py, || py.detach(|| self.text.built(model, &changes)))?;
        built.map_err(|found| raise::problems(py, &found))
    }
}

/// A method by its name.
pub fn method(py: Python, name: &str) -> PyResult<Method> {
    let all: Vec<String> = Method::ALL.iter().map(|method| method.name().to_string()).collect();
    Method::ALL.into_iter().find(|method| method.name() == name).ok_or_else(|| raise::unknown(py, "solver", name, &all))
}

/// A case of an experiment, after its run.
#[pyclass(frozen, module = "fric._fric")]
pub struct Run {
    run: embed::EndedRun,
}

/// Label, unit, whether it is a truth value, and the values in SI.
type Column<'py> = (String, String, bool, Bound<'py, PyAny>);

#[pymethods]
impl Run {
    /// The object of `fric run --json`.
    #[getter]
    fn json(&self) -> &str {
        &self.run.json
    }

    #[getter]
    fn label(&self) -> &str {
        &self.run.label
    }

    /// Message and time of a failure.
    #[getter]
    fn failure(&self) -> Option<(String, f64)> {
        self.run.failure.clone()
    }

    #[getter]
    fn finals(&self) -> Vec<(String, f64, String, bool)> {
        self.run.finals()
    }

    /// The plots as SVG.
    fn svg(&self, wide: f64, id: &str) -> String {
        self.run.svg(wide, id)
    }

    /// Time and columns: every step, or rows at equal distances, or at these instants, or as many as a plot needs.
    #[pyo3(signature = (every=None, instants=None, thin=false))]
    fn rows<'py>(
        &self,
        py: Python<'py>,
        every: Option<f64>,
        instants: Option<Vec<f64>>,
        thin: bool,
    ) -> PyResult<(Bound<'py, PyAny>, Vec<Column<'py>>)> {
        if let Some(instants) = &instants {
            let is_grid = instants.is_sorted() && instants.iter().all(|t| t.is_finite() && *t >= 0.0);
            if !is_grid {
                return Err(PyValueError::new_err("at: instants must be finite, at least 0, and in rising order"));
            }
        }
        let made;
        let recording = match (every, &instants) {
            (None, None) if thin || self.run.is_whole() => self.run.thin(),
            _ => {
                made = watched(py, None, |progress| {
                    let mut watch = |fraction| progress.report(fraction);
                    match (every, &instants) {
                        (_, Some(instants)) => Ok(self.run.at(instants, &mut watch)),
                        (Some(every), None) => self.run.even(every, &mut watch),
                        (None, None) => self.run.every_step(&mut watch),
                    }
                })?
                .map_err(PyValueError::new_err)?;
                &made
            }
        };
        columns(py, recording)
    }

    /// The distance of rows that the experiment asks for.
    #[getter]
    fn every(&self) -> Option<f64> {
        self.run.every()
    }
}

/// A capsule with columns for readers of the Arrow C stream interface. `columns`: names with arrays of numbers, or with
/// lists of truth values or words.
#[pyfunction]
pub fn arrow_stream<'py>(
    py: Python<'py>,
    columns: Vec<(String, Bound<'py, PyAny>)>,
) -> PyResult<Bound<'py, pyo3::types::PyCapsule>> {
    crate::arrow::stream(py, columns)
}

/// A recording as read-only arrays, a column each.
fn columns<'py>(py: Python<'py>, recording: &Recording) -> PyResult<(Bound<'py, PyAny>, Vec<Column<'py>>)> {
    let column = |k: usize| -> PyResult<Bound<'py, PyAny>> {
        Ok(arrays::fixed(py, recording.rows().map(|row| row[k]).collect())?.into_any())
    };
    let of = |(k, of): (usize, &runtime::record::Column)| {
        Ok((of.label.clone(), of.unit.text.clone(), of.boolean, column(k + 1)?))
    };
    let all = recording.columns().iter().enumerate().map(of).collect::<PyResult<Vec<Column>>>()?;
    Ok((column(0)?, all))
}
