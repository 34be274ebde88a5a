//! The extension module of the Python package `fric`: texts, runs and running instances.
//!
//! In: calls of the Python files in `fric/`, which know units, pandas and notebooks. Out: arrays, numbers, and
//! exceptions of `fric.errors`. The only home of PyO3 and NumPy. Work longer than some microseconds lets other threads
//! run, and a run ends soon after Ctrl-C.

mod raise;
mod arrays;
mod arrow;
mod watched;
mod text;
mod fit;
mod native;
mod stepper;
mod calls;
mod transpose;
mod batch;
mod sweep;

use abi::unit::Unit;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// A unit by its text.
fn unit(text: &str) -> PyResult<Unit> {
    fric::embed::unit(text).map_err(PyValueError::new_err)
}

/// The module.
#[pymodule(gil_used = false)]
mod _fric {
    use crate::arrays;
    #[pymodule_export]
    use crate::batch::Batch;
    #[pymodule_export]
    use crate::fit::{Fit, Found, fit, residuals};
    #[pymodule_export]
    use crate::native::Native;
    #[pymodule_export]
    use crate::stepper::Stepper;
    #[pymodule_export]
    use crate::sweep::{SweepRows, sweep_about, sweep_file, sweep_plan, sweep_unit};
    #[pymodule_export]
    use crate::text::{Run, Text, arrow_stream};
    use abi::unit::Unit;
    use numpy::PyArrayMethods;
    use pyo3::exceptions::{PyOSError, PyValueError};
    use pyo3::prelude::*;

    /// A recording on disk as CSV.
    #[pyfunction]
    fn table(py: Python, path: &str) -> PyResult<String> {
        let read = crate::watched::guarded(py, || py.detach(|| fric::embed::table(path)))?;
        read.map_err(|why| PyOSError::new_err(format!("cannot read {path}: {why}")))
    }

    /// A text with a fit of each standard law to a recording, which it names by this path. `recording`: its content as CSV.
    #[pyfunction]
    fn laws(py: Python, recording: &str, file: &str) -> PyResult<String> {
        let made = crate::watched::guarded(py, || py.detach(|| fric::embed::laws(recording, file)))?;
        made.map_err(PyValueError::new_err)
    }

    /// Runs the command with these arguments, the name of the program first; returns the exit code.
    #[pyfunction]
    fn command(py: Python, arguments: Vec<std::ffi::OsString>) -> u8 {
        py.detach(|| fric::main_with(arguments))
    }

    /// The text of the library file that declares a model.
    #[pyfunction]
    fn library_model(name: &str) -> Option<(String, String)> {
        fric::embed::library_model(name)
    }

    /// Names of all models of the library.
    #[pyfunction]
    fn library_models() -> Vec<String> {
        fric::embed::library_models()
    }

    /// The name nearest to another.
    #[pyfunction]
    fn nearest(name: &str, all: Vec<String>) -> Option<String> {
        fric::embed::Text::nearest(name, &all).map(str::to_string)
    }

    /// Value in SI and unit of a text such as `2 N`; raises ValueError.
    #[pyfunction]
    fn quantity(text: &str) -> PyResult<(f64, String)> {
        fric::embed::quantity(text).map_err(PyValueError::new_err)
    }

    /// The SI unit of a unit; raises ValueError.
    #[pyfunction]
    fn si_unit(unit: &str) -> PyResult<String> {
        Ok(Unit::si(crate::unit(unit)?.dimension).text)
    }

    /// A curve as SVG. `x`, `y`: name and unit of the axes.
    #[pyfunction]
    fn curve_svg(
        title: &str,
        x: (String, String),
        y: (String, String),
        points: Vec<(f64, f64)>,
        wide: f64,
        id: &str,
    ) -> String {
        fric::embed::curve_svg(title, ([&x.0, &x.1], [&y.0, &y.1]), points, wide, id)
    }

    /// Values in SI as numbers in a unit.
    #[pyfunction]
    fn in_unit<'py>(values: Bound<'py, PyAny>, unit: &str) -> PyResult<Bound<'py, PyAny>> {
        let (array, unit) = (arrays::doubles(&values, "values")?.0, crate::unit(unit)?);
        let numbers = array.to_vec().map_err(|error| PyValueError::new_err(error.to_string()))?;
        arrays::array(values.py(), numbers.into_iter().map(|x| unit.from_si(x)).collect(), None)
    }

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        fric::limit_lanes().map_err(PyValueError::new_err)?;
        crate::calls::add(module.py())?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
