//! `step` and `hold` of an instance, by CPython's own calling convention.
//!
//! In: the arguments as CPython passes them. Out: floats. A step takes some 20 ns, and reading its arguments by position and
//! name, as PyO3 does for methods, longer than that. Here they are an array of pointers (`METH_FASTCALL`), by position alone.

use crate::stepper::{Given, Stepper};
use crate::watched::guarded;
use pyo3::prelude::*;
use pyo3::{Borrowed, ffi};
use std::ffi::CStr;

/// Name and documentation of a method, whose first line is its signature, and its function.
type Method = (&'static CStr, &'static CStr, ffi::PyCFunctionFast);

const METHODS: [Method; 2] = [
    (c"step", c"step($self, /, *inputs)\n--\n\nOne step with these inputs; returns the outputs.", step),
    (c"hold", c"hold($self, count, /, *inputs)\n--\n\nSteps under held inputs; returns the last outputs.", hold),
];

/// Adds the methods to the type.
pub fn add(py: Python) -> PyResult<()> {
    let stepper = py.get_type::<Stepper>();
    for (name, doc, function) in METHODS {
        // The type refers to it as long as the interpreter runs.
        let method = Box::leak(Box::new(ffi::PyMethodDef {
            ml_name: name.as_ptr(),
            ml_meth: ffi::PyMethodDefPointer { PyCFunctionFast: function },
            ml_flags: ffi::METH_FASTCALL,
            ml_doc: doc.as_ptr(),
        }));
        // SAFETY: the definition is complete and never freed; the function returns a new reference or null.
        let method =
            unsafe { Bound::from_owned_ptr_or_err(py, ffi::PyDescr_NewMethod(stepper.as_type_ptr(), method))? };
        stepper.setattr(name.to_str().expect("a name of this file"), method)?;
    }
    Ok(())
}

unsafe extern "C" fn step(
    this: *mut ffi::PyObject,
    given: *mut *mut ffi::PyObject,
    count: isize,
) -> *mut ffi::PyObject {
    // SAFETY: as CPython calls a method.
    unsafe { entered(this, given, count, |py, stepper, given| stepper.step(py, given)) }
}

unsafe extern "C" fn hold(
    this: *mut ffi::PyObject,
    given: *mut *mut ffi::PyObject,
    count: isize,
) -> *mut ffi::PyObject {
    // SAFETY: as CPython calls a method.
    unsafe { entered(this, given, count, |py, stepper, given| stepper.hold(py, given)) }
}

/// Calls a method of the instance. An error or a panic becomes an exception.
///
/// # Safety
/// The caller must be attached to the interpreter; `this` must be a [`Stepper`], and `given` have `count` objects, all of
/// them alive during the call. CPython checks the type of `this` when it calls a method of a type.
#[inline(always)]
unsafe fn entered(
    this: *mut ffi::PyObject,
    given: *mut *mut ffi::PyObject,
    count: isize,
    call: impl for<'py> FnOnce(Python<'py>, &mut Stepper, &[Given<'_, 'py>]) -> PyResult<Bound<'py, PyAny>>,
) -> *mut ffi::PyObject {
    // SAFETY: the caller is attached, and no reference leaves this function.
    let py = unsafe { Python::assume_attached() };
    let done = guarded(py, || {
        // Without arguments the pointer may be null.
        let given: &[Given] = match count {
            0 => &[],
            // SAFETY: there are so many, and a `Borrowed` is a pointer to an object that is alive.
            _ => unsafe { std::slice::from_raw_parts(given.cast(), count as usize) },
        };
        // SAFETY: it is a `Stepper`.
        let this = unsafe { Borrowed::from_ptr(py, this).cast_unchecked::<Stepper>() };
        call(py, &mut *this.try_borrow_mut()?, given)
    });
    match done.flatten() {
        Ok(result) => result.into_ptr(),
        Err(error) => {
            // Attached as PyO3 counts it, which then also frees what was dropped meanwhile.
            Python::attach(|py| error.restore(py));
            std::ptr::null_mut()
        }
    }
}
