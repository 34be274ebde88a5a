//! Machine code of a step, for callers outside of Python: numba, Cython, C.
//!
//! In: an instance. Out: the address of its step, a copy of its block, and where quantities are in it. Who calls it is
//! outside of all checks.

use abi::table::Machine;
use abi::{Code, Description, Function};
use numpy::{IntoPyArray, PyArray1};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::collections::BTreeMap;

/// The step of an instance as machine code.
#[pyclass(frozen, module = "fric._fric")]
pub struct Native {
    code: Code,
    block: Py<PyArray1<f64>>,
    pool: Py<PyArray1<f64>>,
    slots: BTreeMap<String, usize>,
}

impl Native {
    /// From the code of a step, a block and its description.
    pub fn new(py: Python, machine: Machine, block: &[f64], description: &Description) -> PyResult<Native> {
        let slots = description.quantities.iter().map(|quantity| (quantity.path.clone(), quantity.slot.index()));
        let pool = crate::arrays::fixed(py, description.pool.to_vec())?;
        let block = block.to_vec().into_pyarray(py);
        Ok(Native { code: Code::Machine(machine), block: block.unbind(), pool: pool.unbind(), slots: slots.collect() })
    }
}

#[pymethods]
impl Native {
    /// Address of `uint64_t step(double *block, const double *pool, uint64_t count)`.
    #[getter]
    fn address(&self) -> PyResult<usize> {
        let entry = self.code.entry(Function::Step);
        entry
            .map(|entry| entry as usize)
            .ok_or_else(|| PyRuntimeError::new_err("there is no machine code for the step"))
    }

    /// The block: a copy of that of the instance, which steps change.
    #[getter]
    fn block(&self, py: Python) -> Py<PyArray1<f64>> {
        self.block.clone_ref(py)
    }

    /// The constants of the code, read-only.
    #[getter]
    fn pool(&self, py: Python) -> Py<PyArray1<f64>> {
        self.pool.clone_ref(py)
    }

    /// The index in the block of each quantity.
    #[getter]
    fn slots(&self) -> BTreeMap<String, usize> {
        self.slots.clone()
    }

    fn __repr__(&self) -> String {
        format!("<fric.Native: a step on {} slots>", self.slots.len())
    }
}
