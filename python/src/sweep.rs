//! Sweeps: plans, their units, and the tables to which rows are appended.

use crate::raise;
use crate::text::{Text, method};
use crate::watched::{guarded, watched};
use compiler::Changes;
use fric::embed;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Sweeps that a worker keeps compiled.
const KEPT: usize = 4;

/// A sweep, compiled, and how it was made.
type Known = (Vec<u8>, bool, Arc<embed::Sweep>);

/// The sweep of a plan: compiled once in a process.
fn known(plan: &[u8], interpret: bool) -> Result<Arc<embed::Sweep>, embed::SweepFault> {
    static ALL: Mutex<Vec<Known>> = Mutex::new(Vec::new());
    let mut all = ALL.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(at) = all.iter().position(|known| known.0 == plan && known.1 == interpret) {
        let found = all.remove(at);
        all.insert(0, found);
    } else {
        let sweep = embed::Sweep::read(plan, interpret)?;
        all.insert(0, (plan.to_vec(), interpret, Arc::new(sweep)));
        all.truncate(KEPT);
    }
    Ok(all[0].2.clone())
}

/// The plan of a sweep as bytes.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "the Python files name each of them")]
pub fn sweep_plan<'py>(
    py: Python<'py>,
    text: &Text,
    experiment: &str,
    vary: Vec<String>,
    design: Option<String>,
    set: Vec<String>,
    solver: Option<&str>,
    step: Option<f64>,
    tol: Option<f64>,
    duration: Option<f64>,
    runs: Option<u64>,
    seed: Option<u64>,
    keep: &str,
) -> PyResult<Bound<'py, PyBytes>> {
    let method = solver.map(|name| method(py, name)).transpose()?;
    let keep = embed::Keep::ALL.into_iter().find(|known| known.name() == keep).ok_or_else(|| {
        PyValueError::new_err(format!("keep: {keep:?} is none of \"rows\", \"summary\" and \"both\""))
    })?;
    let changes = Changes { set, method, step, tol, duration, ..Changes::default() };
    let plan =
        guarded(py, || py.detach(|| text.inner().plan(experiment, &vary, design, &changes, (runs, seed), keep)))?;
    plan.map(|plan| PyBytes::new(py, &plan)).map_err(|found| raise::problems(py, &found))
}

/// Runs a part of a plan on this thread: the bytes of a unit.
#[pyfunction]
#[pyo3(signature = (plan, first, last, interpret=false))]
pub fn sweep_unit<'py>(
    py: Python<'py>,
    plan: &[u8],
    first: u64,
    last: u64,
    interpret: bool,
) -> PyResult<Bound<'py, PyBytes>> {
    let sweep =
        guarded(py, || py.detach(|| known(plan, interpret)))?.map_err(|fault| raise::sweep_fault(py, &fault))?;
    let made = watched(py, None, |progress| {
        if first > last || last > sweep.items() {
            return Err(format!("the plan has {} rows, and {first}..{last} are not among them", sweep.items()));
        }
        sweep.unit(first..last, progress.stop()).ok_or_else(|| "stopped".into())
    })?;
    made.map(|unit| PyBytes::new(py, &unit)).map_err(PyRuntimeError::new_err)
}

/// Makes a file of the dataset of a plan on this thread, in a folder that the client sees too: its hash.
#[pyfunction]
pub fn sweep_file(py: Python, plan: &[u8], folder: PathBuf, first: u64) -> PyResult<String> {
    let sweep = guarded(py, || py.detach(|| known(plan, false)))?.map_err(|fault| raise::sweep_fault(py, &fault))?;
    let made = watched(py, None, |progress| {
        sweep.file(&folder, first, progress.stop())?.ok_or_else(|| "stopped".to_string())
    })?;
    made.map_err(PyRuntimeError::new_err)
}

/// Number of runs of a plan, and the titles of its columns with what they hold.
#[pyfunction]
pub fn sweep_about(py: Python, plan: &[u8]) -> PyResult<(u64, Vec<(String, &'static str)>)> {
    let sweep = guarded(py, || py.detach(|| known(plan, false)))?.map_err(|fault| raise::sweep_fault(py, &fault))?;
    Ok((sweep.total(), sweep.columns()))
}

/// A table or a dataset to which the rows of units are appended.
#[pyclass(frozen, module = "fric._fric")]
pub struct SweepRows {
    sweep: Arc<embed::Sweep>,
    rows: Mutex<Option<embed::SweepRows>>,
    /// What was found damaged when it was begun.
    #[pyo3(get)]
    warnings: Vec<String>,
}

#[pymethods]
impl SweepRows {
    #[new]
    fn new(py: Python, plan: &[u8], out: PathBuf, resume: bool) -> PyResult<SweepRows> {
        let sweep =
            guarded(py, || py.detach(|| known(plan, false)))?.map_err(|fault| raise::sweep_fault(py, &fault))?;
        let begun = guarded(py, || {
            py.detach(|| {
                let mut warnings = Vec::new();
                let rows = sweep.begin(&out, resume, &mut |words| warnings.push(words.trim_end().to_string()))?;
                Ok::<_, String>(SweepRows { sweep, rows: Mutex::new(Some(rows)), warnings })
            })
        })?;
        begun.map_err(PyValueError::new_err)
    }

    /// Number of runs.
    #[getter]
    fn total(&self) -> u64 {
        self.sweep.total()
    }

    /// Number of what units count: runs, or blocks of runs if only statistics are kept.
    #[getter]
    fn items(&self) -> u64 {
        self.sweep.items()
    }

    /// How many runs the first of them have.
    fn runs(&self, items: u64) -> u64 {
        self.sweep.runs(items)
    }

    /// Rows of a file of a dataset.
    #[getter]
    fn rows_a_file(&self) -> u64 {
        self.sweep.rows_a_file()
    }

    /// Takes a file of a dataset with this hash, which a worker has written.
    fn adopt(&self, py: Python, hash: &str) -> PyResult<()> {
        self.with(py, |rows| rows.adopt(hash))
    }

    /// Titles of the columns, and what they hold.
    #[getter]
    fn columns(&self) -> Vec<(String, &'static str)> {
        self.sweep.columns()
    }

    /// The run whose row comes next, or the number of the next block.
    #[getter]
    fn next(&self, py: Python) -> PyResult<u64> {
        self.with(py, |rows| Ok(rows.next()))
    }

    /// Appends a unit; returns what comes next.
    fn take(&self, py: Python, unit: &[u8]) -> PyResult<u64> {
        self.with(py, |rows| {
            rows.take(&self.sweep, unit)?;
            Ok(rows.next())
        })
    }

    /// Keeps what has come.
    fn leave(&self, py: Python) -> PyResult<()> {
        let Some(rows) = self.ended() else { return Ok(()) };
        py.detach(|| rows.leave()).map_err(PyValueError::new_err)
    }

    /// After the last row: the summary in words.
    fn finish(&self, py: Python) -> PyResult<String> {
        let rows = self.ended().ok_or_else(|| PyValueError::new_err("the table is finished"))?;
        guarded(py, || py.detach(|| rows.finish(&self.sweep)))?.map_err(PyValueError::new_err)
    }
}

impl SweepRows {
    fn ended(&self) -> Option<embed::SweepRows> {
        self.rows.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn with<T: Send>(
        &self,
        py: Python,
        work: impl FnOnce(&mut embed::SweepRows) -> Result<T, String> + Send,
    ) -> PyResult<T> {
        let done = guarded(py, || {
            py.detach(|| {
                let mut rows = self.rows.lock().unwrap_or_else(PoisonError::into_inner);
                work(rows.as_mut().ok_or("the table is finished")?)
            })
        })?;
        done.map_err(PyValueError::new_err)
    }
}
