//! Columns of doubles for libraries that read the Arrow C stream interface, such as pyarrow, polars and DuckDB, without a
//! copy.
//!
//! In: names and arrays of NumPy. Out: a capsule `arrow_array_stream` with one batch. Source: the Arrow C data interface
//! and the Arrow PyCapsule interface (arrow.apache.org/docs/format).

use numpy::{PyArray1, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyCapsule;
use std::ffi::{CString, c_char, c_int, c_void};
use std::ptr::{null, null_mut};
use std::sync::Arc;

/// What a consumer calls to free a structure.
type Release<T> = Option<unsafe extern "C" fn(*mut T)>;

/// `struct ArrowSchema`.
#[repr(C)]
struct Schema {
    format: *const c_char,
    name: *const c_char,
    metadata: *const c_char,
    flags: i64,
    n_children: i64,
    children: *mut *mut Schema,
    dictionary: *mut Schema,
    release: Release<Schema>,
    private_data: *mut c_void,
}

/// `struct ArrowArray`.
#[repr(C)]
struct Array {
    length: i64,
    null_count: i64,
    offset: i64,
    n_buffers: i64,
    n_children: i64,
    buffers: *mut *const c_void,
    children: *mut *mut Array,
    dictionary: *mut Array,
    release: Release<Array>,
    private_data: *mut c_void,
}

/// `struct ArrowArrayStream`.
#[repr(C)]
struct Stream {
    get_schema: unsafe extern "C" fn(*mut Stream, *mut Schema) -> c_int,
    get_next: unsafe extern "C" fn(*mut Stream, *mut Array) -> c_int,
    get_last_error: unsafe extern "C" fn(*mut Stream) -> *const c_char,
    release: Release<Stream>,
    private_data: *mut c_void,
}

// SAFETY: a capsule may be freed by any thread; its data are owned, and a Python object may be dropped by any thread.
unsafe impl Send for Stream {}

/// A column; the array is kept alive as long as a consumer reads it.
struct Column {
    name: CString,
    numbers: *const f64,
    _array: Py<PyAny>,
}

// SAFETY: the numbers are only read, and a Python object may be dropped by any thread.
unsafe impl Send for Column {}
// SAFETY: as above.
unsafe impl Sync for Column {}

/// What a stream owns.
struct Table {
    columns: Vec<Arc<Column>>,
    rows: usize,
    is_read: bool,
}

/// What a schema owns besides its children.
struct OwnedSchema {
    _column: Option<Arc<Column>>,
    children: Vec<*mut Schema>,
}

/// What an array owns besides its children.
struct OwnedArray {
    _column: Option<Arc<Column>>,
    buffers: Vec<*const c_void>,
    children: Vec<*mut Array>,
}

fn schema(format: &'static std::ffi::CStr, column: Option<Arc<Column>>, children: Vec<*mut Schema>) -> Schema {
    let name = column.as_ref().map_or(c"".as_ptr(), |column| column.name.as_ptr());
    let mut owned = Box::new(OwnedSchema { _column: column, children });
    Schema {
        format: format.as_ptr(),
        name,
        metadata: null(),
        flags: 0,
        n_children: owned.children.len() as i64,
        children: owned.children.as_mut_ptr(),
        dictionary: null_mut(),
        release: Some(release_schema),
        private_data: Box::into_raw(owned).cast(),
    }
}

fn array(rows: usize, column: Option<Arc<Column>>, children: Vec<*mut Array>) -> Array {
    // No number is missing, so there is no bitmap.
    let numbers = column.as_ref().map(|column| column.numbers.cast::<c_void>());
    let buffers = [null()].into_iter().chain(numbers).collect();
    let mut owned = Box::new(OwnedArray { _column: column, buffers, children });
    Array {
        length: rows as i64,
        null_count: 0,
        offset: 0,
        n_buffers: owned.buffers.len() as i64,
        n_children: owned.children.len() as i64,
        buffers: owned.buffers.as_mut_ptr(),
        children: owned.children.as_mut_ptr(),
        dictionary: null_mut(),
        release: Some(release_array),
        private_data: Box::into_raw(owned).cast(),
    }
}

unsafe extern "C" fn release_schema(schema: *mut Schema) {
    // SAFETY: `schema` has made it, and a consumer calls this once. Children that were moved away have no release.
    unsafe {
        let owned = Box::from_raw((*schema).private_data.cast::<OwnedSchema>());
        for child in &owned.children {
            if let Some(release) = (**child).release {
                release(*child);
            }
            drop(Box::from_raw(*child));
        }
        (*schema).release = None;
    }
}

unsafe extern "C" fn release_array(array: *mut Array) {
    // SAFETY: as above.
    unsafe {
        let owned = Box::from_raw((*array).private_data.cast::<OwnedArray>());
        for child in &owned.children {
            if let Some(release) = (**child).release {
                release(*child);
            }
            drop(Box::from_raw(*child));
        }
        (*array).release = None;
    }
}

unsafe extern "C" fn get_schema(stream: *mut Stream, out: *mut Schema) -> c_int {
    // SAFETY: the stream has its table until it is released; `out` is room for a schema.
    unsafe {
        let table = &*(*stream).private_data.cast::<Table>();
        let child = |column: &Arc<Column>| Box::into_raw(Box::new(schema(c"g", Some(column.clone()), Vec::new())));
        out.write(schema(c"+s", None, table.columns.iter().map(child).collect()));
    }
    0
}

unsafe extern "C" fn get_next(stream: *mut Stream, out: *mut Array) -> c_int {
    // SAFETY: as above; nobody else uses the stream meanwhile.
    unsafe {
        let table = &mut *(*stream).private_data.cast::<Table>();
        let rows = table.rows;
        let child = |column: &Arc<Column>| Box::into_raw(Box::new(array(rows, Some(column.clone()), Vec::new())));
        let batch = match std::mem::replace(&mut table.is_read, true) {
            false => array(rows, None, table.columns.iter().map(child).collect()),
            // The end of the stream is an array without release.
            true => {
                let mut end = array(0, None, Vec::new());
                release_array(&raw mut end);
                end
            }
        };
        out.write(batch);
    }
    0
}

unsafe extern "C" fn get_last_error(_: *mut Stream) -> *const c_char {
    null()
}

unsafe extern "C" fn release_stream(stream: *mut Stream) {
    // SAFETY: `stream` has made it, and a consumer calls this once.
    unsafe {
        drop(Box::from_raw((*stream).private_data.cast::<Table>()));
        (*stream).release = None;
    }
}

/// A capsule with a stream of one batch of these columns.
pub fn stream<'py>(py: Python<'py>, columns: Vec<(String, Bound<'py, PyAny>)>) -> PyResult<Bound<'py, PyCapsule>> {
    let mut rows = None;
    let mut all = Vec::new();
    for (name, numbers) in columns {
        let array = numbers.cast::<PyArray1<f64>>().map_err(PyErr::from)?;
        if !array.is_contiguous() || *rows.get_or_insert(array.len()) != array.len() {
            return Err(PyValueError::new_err(format!("`{name}` is no column of this table")));
        }
        let numbers = array.data().cast_const();
        let name = CString::new(name.replace('\0', "")).expect("no zeros are left");
        all.push(Arc::new(Column { name, numbers, _array: array.clone().into_any().unbind() }));
    }
    let table = Box::new(Table { columns: all, rows: rows.unwrap_or(0), is_read: false });
    let stream = Stream {
        get_schema,
        get_next,
        get_last_error,
        release: Some(release_stream),
        private_data: Box::into_raw(table).cast(),
    };
    PyCapsule::new_with_value_and_destructor(py, stream, c"arrow_array_stream", |mut stream: Stream, _| {
        // A consumer that took the stream has released it, or moved it away.
        if let Some(release) = stream.release {
            // SAFETY: it was not released before.
            unsafe { release(&raw mut stream) };
        }
    })
}
