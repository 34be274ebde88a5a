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
fn known(plan: &[u8], interpret: bool) -> Result<Arc<embed::Sweep>, String> {
    static ALL: Mutex<Vec<Known>> = Mutex::new(Vec::new());
    let mut all = ALL.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(at) = all.iter().position(|known| known.0 == plan && known.1 == interpret) {
        let found = all.remove(at);
        all.insert(0, found);
    } else {
        let sweep = embed::Sweep::read(plan, interpret).map_err(|fault| fault.words())?;
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
    set: Vec<String>,
    solver: Option<&str>,
    step: Option<f64>,
    tol: Option<f64>,
    duration: Option<f64>,
    runs: Option<u64>,
    seed: Option<u64>,
) -> PyResult<Bound<'py, PyBytes>> {
    let method = solver.map(|name| method(py, name)).transpose()?;
    let changes = Changes { set, method, step, tol, duration, ..Changes::default() };
    let plan =
        guarded(py, || py.detach(|| text.inner().plan(experiment, &vary, &changes, (runs, seed), embed::Keep::Rows)))?;
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
    let made = watched(py, None, |progress| {
        let sweep = known(plan, interpret)?;
        if first > last || last > sweep.total() {
            return Err(format!("the plan has {} runs, and {first}..{last} are not among them", sweep.total()));
        }
        sweep.unit(first..last, progress.stop()).ok_or_else(|| "stopped".into())
    })?;
    made.map(|unit| PyBytes::new(py, &unit)).map_err(PyRuntimeError::new_err)
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
        let begun = guarded(py, || {
            py.detach(|| {
                let sweep = known(plan, false)?;
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

    /// Titles of the columns, and what they hold.
    #[getter]
    fn columns(&self) -> Vec<(String, &'static str)> {
        self.sweep.columns()
    }

    /// The run whose row comes next.
    #[getter]
    fn next(&self, py: Python) -> PyResult<u64> {
        self.with(py, |rows| Ok(rows.next()))
    }

    /// Appends a unit; returns the run whose row comes next.
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
