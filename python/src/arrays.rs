//! Arrays from and to NumPy.

use numpy::{IntoPyArray, PyArray1, PyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// An array of doubles in C order, and its shape. One that is in this form already is used as it is; other numbers are
/// copied. `name`: the argument, for messages.
pub fn doubles<'py>(value: &Bound<'py, PyAny>, name: &str) -> PyResult<(Bound<'py, PyArrayDyn<f64>>, Vec<usize>)> {
    let py = value.py();
    let numpy = py.import("numpy")?;
    if value.is_none() {
        return Err(PyTypeError::new_err(format!("{name}: an array of numbers is needed, not None")));
    }
    let array = match value.cast::<PyArrayDyn<f64>>() {
        Ok(array) if array.is_c_contiguous() && is_aligned(array)? => array.clone(),
        _ => {
            let found = numpy.call_method1("asarray", (value,))?;
            let dtype = found.getattr("dtype")?;
            let kind: String = dtype.getattr("kind")?.extract()?;
            let size: usize = dtype.getattr("itemsize")?.extract()?;
            let is_exact = matches!(kind.as_str(), "i" | "u" | "b") || kind == "f" && size == 8;
            if !is_exact {
                let dtype = dtype.str()?.to_string();
                return Err(PyTypeError::new_err(format!(
                    "{name}: an array of {dtype} is not converted silently; pass `.astype(float)`"
                )));
            }
            let required = numpy.call_method1("require", (found, "float64", ["C", "A"]))?;
            required.cast_into::<PyArrayDyn<f64>>().map_err(PyErr::from)?
        }
    };
    let shape = array.shape().to_vec();
    Ok((array, shape))
}

fn is_aligned(array: &Bound<PyArrayDyn<f64>>) -> PyResult<bool> {
    array.getattr("flags")?.getattr("aligned")?.extract()
}

/// Rows of `columns` numbers, from an array of shape (rows, columns), or (rows,) for one column. Returns the array and the
/// number of rows.
pub fn rows<'py>(
    value: &Bound<'py, PyAny>,
    columns: usize,
    name: &str,
) -> PyResult<(Bound<'py, PyArrayDyn<f64>>, usize)> {
    let (array, shape) = doubles(value, name)?;
    match shape[..] {
        [rows] if columns == 1 => Ok((array, rows)),
        [rows, width] if width == columns => Ok((array, rows)),
        _ => Err(PyValueError::new_err(format!(
            "{name}: an array of shape {shape:?} was given, and (rows, {columns}){} is needed",
            if columns == 1 { " or (rows,)" } else { "" }
        ))),
    }
}

/// An array that owns these numbers. `shape`: none for one dimension.
pub fn array<'py>(py: Python<'py>, numbers: Vec<f64>, shape: Option<&[usize]>) -> PyResult<Bound<'py, PyAny>> {
    let flat = numbers.into_pyarray(py);
    match shape {
        None | Some([_]) => Ok(flat.into_any()),
        Some(shape) => flat.call_method1("reshape", (PyTuple::new(py, shape)?,)),
    }
}

/// The array `out` to write results of this shape to. A last dimension of 1 may be there or not.
pub fn target<'py>(out: &Bound<'py, PyAny>, shape: &[usize]) -> PyResult<Bound<'py, PyArrayDyn<f64>>> {
    let array = out.cast::<PyArrayDyn<f64>>();
    let array =
        array.map_err(|_| PyTypeError::new_err(format!("out: an array of float64 of shape {shape:?} is needed")))?;
    let given = array.shape();
    let fits = given == shape || given.split_last() == Some((&1, shape));
    if !fits || !array.is_c_contiguous() || !is_aligned(array)? {
        let message = format!("out: shape {given:?} was given; {shape:?} in C order is needed");
        return Err(PyValueError::new_err(message));
    }
    Ok(array.clone())
}

/// The same, read-only.
pub fn fixed(py: Python, numbers: Vec<f64>) -> PyResult<Bound<PyArray1<f64>>> {
    let array = numbers.into_pyarray(py);
    array.getattr("flags")?.setattr("writeable", false)?;
    Ok(array)
}
