//! Exceptions of `fric.errors`.

use fric::embed::{Problems, SweepFault};
use pyo3::call::PyCallArgs;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;

/// An exception that the class or function with this name makes of these arguments.
fn of<'py>(py: Python<'py>, class: &str, arguments: impl PyCallArgs<'py>) -> PyErr {
    let made = || errors(py)?.getattr(class)?.call1(arguments);
    made().map_or_else(|error| error, PyErr::from_value)
}

fn errors<'py>(py: Python<'py>) -> PyResult<&'py Bound<'py, PyModule>> {
    static MODULE: PyOnceLock<Py<PyModule>> = PyOnceLock::new();
    let module = MODULE.get_or_try_init(py, || py.import("fric.errors").map(Bound::unbind))?;
    Ok(module.bind(py))
}

/// Mistakes in a text or in what was asked of it: `fric.errors.of_problems` chooses the class.
pub fn problems(py: Python, found: &Problems) -> PyErr {
    let codes: Vec<&str> = found.codes.clone();
    of(py, "of_problems", (&found.report, &found.json, codes))
}

/// A plan that cannot be used.
pub fn sweep_fault(py: Python, fault: &SweepFault) -> PyErr {
    match fault {
        SweepFault::Version(why) => {
            of(py, "VersionMismatch", (fault.words(), why.written_by(), env!("CARGO_PKG_VERSION")))
        }
        SweepFault::Misused(_) | SweepFault::Failed(_) | SweepFault::Text(..) => PyValueError::new_err(fault.words()),
    }
}

/// A run or a step that stopped. `rows`: what was computed before.
pub fn run_error(py: Python, message: &str, time: f64, rows: Option<Bound<PyAny>>) -> PyErr {
    let error = of(py, "RunError", (message, time));
    if let Some(rows) = rows {
        let _ = error.value(py).setattr("rows", rows);
    }
    error
}

/// No such name.
pub fn unknown(py: Python, what: &str, name: &str, all: &[String]) -> PyErr {
    of(py, "unknown", (what, name, all.to_vec()))
}

/// A value outside its range.
pub fn range(py: Python, message: &str) -> PyErr {
    of(py, "RangeError", (message,))
}

/// We are wrong.
pub fn internal(py: Python, message: &str) -> PyErr {
    of(py, "InternalError", (message,))
}

/// The function that makes an object again, for pickling.
pub fn function<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("fric._restore")?.getattr(name)
}

/// A value as `fric._values` reads it: `written` for the language, `number` in SI.
pub fn value<'py>(
    py: Python<'py>,
    form: &str,
    path: &str,
    value: &Bound<'py, PyAny>,
    si: &str,
    boolean: bool,
) -> PyResult<Bound<'py, PyAny>> {
    py.import("fric._values")?.call_method1(form, (path, value, si, boolean))
}
