//! Columns for libraries that read the Arrow C stream interface, such as pyarrow, polars and DuckDB; numbers without a copy.
//!
//! In: names, and arrays of NumPy or lists of words and truth values. Out: a capsule `arrow_array_stream` with one batch.
//! Source: the Arrow C data interface and the Arrow PyCapsule interface (arrow.apache.org/docs/format).

use numpy::{PyArray1, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyCapsule;
use std::ffi::{CStr, CString, c_char, c_int, c_void};
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

/// `ARROW_FLAG_NULLABLE`.
const NULLABLE: i64 = 2;

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

/// A column; what its buffers lie in is kept alive as long as a consumer reads it.
struct Column {
    name: CString,
    format: &'static CStr,
    rows: usize,
    nulls: i64,
    buffers: Vec<*const c_void>,
    _array: Option<Py<PyAny>>,
    _bytes: [Vec<u8>; 2],
    _offsets: Vec<i64>,
}

// SAFETY: the buffers are only read, and a Python object may be dropped by any thread.
unsafe impl Send for Column {}
// SAFETY: as above.
unsafe impl Sync for Column {}

impl Column {
    /// Numbers of an array, where they lie.
    fn array<T: numpy::Element>(name: CString, format: &'static CStr, array: &Bound<PyArray1<T>>) -> Option<Column> {
        array.is_contiguous().then(|| Column {
            name,
            format,
            rows: array.len(),
            nulls: 0,
            // No number is missing, so there is no bitmap.
            buffers: vec![null(), array.data().cast_const().cast()],
            _array: Some(array.clone().into_any().unbind()),
            _bytes: Default::default(),
            _offsets: Vec::new(),
        })
    }

    /// Truth values, of which some may be missing.
    fn booleans(name: CString, values: &[Option<bool>]) -> Column {
        let bits = |bit: &dyn Fn(&Option<bool>) -> bool| -> Vec<u8> {
            let byte = |eight: &[Option<bool>]| (0..eight.len()).fold(0, |all, k| all | u8::from(bit(&eight[k])) << k);
            values.chunks(8).map(byte).collect()
        };
        let bytes = [bits(&Option::is_some), bits(&|value| *value == Some(true))];
        Column {
            name,
            format: c"b",
            rows: values.len(),
            nulls: values.iter().filter(|value| value.is_none()).count() as i64,
            buffers: bytes.iter().map(|bytes| bytes.as_ptr().cast()).collect(),
            _array: None,
            _bytes: bytes,
            _offsets: Vec::new(),
        }
    }

    /// Words, with offsets of 64 bits.
    fn words(name: CString, values: &[String]) -> Column {
        let ends = values.iter().scan(0, |end, word| {
            *end += word.len() as i64;
            Some(*end)
        });
        let (offsets, bytes) = ([0].into_iter().chain(ends).collect::<Vec<i64>>(), values.concat().into_bytes());
        Column {
            name,
            format: c"U",
            rows: values.len(),
            nulls: 0,
            buffers: vec![null(), offsets.as_ptr().cast(), bytes.as_ptr().cast()],
            _array: None,
            _bytes: [bytes, Vec::new()],
            _offsets: offsets,
        }
    }

    /// Any of them; none for other values, and for arrays with gaps.
    fn of(name: CString, values: &Bound<PyAny>) -> Option<Column> {
        if let Ok(array) = values.cast::<PyArray1<f64>>() {
            Column::array(name, c"g", array)
        } else if let Ok(array) = values.cast::<PyArray1<i64>>() {
            Column::array(name, c"l", array)
        } else if let Ok(values) = values.extract::<Vec<Option<bool>>>() {
            Some(Column::booleans(name, &values))
        } else {
            values.extract::<Vec<String>>().ok().map(|values| Column::words(name, &values))
        }
    }
}

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

fn schema(format: &'static CStr, column: Option<Arc<Column>>, children: Vec<*mut Schema>) -> Schema {
    let name = column.as_ref().map_or(c"".as_ptr(), |column| column.name.as_ptr());
    let flags = column.as_ref().map_or(0, |column| if column.nulls > 0 { NULLABLE } else { 0 });
    let mut owned = Box::new(OwnedSchema { _column: column, children });
    Schema {
        format: format.as_ptr(),
        name,
        metadata: null(),
        flags,
        n_children: owned.children.len() as i64,
        children: owned.children.as_mut_ptr(),
        dictionary: null_mut(),
        release: Some(release_schema),
        private_data: Box::into_raw(owned).cast(),
    }
}

fn array(rows: usize, column: Option<Arc<Column>>, children: Vec<*mut Array>) -> Array {
    let buffers = column.as_ref().map_or(vec![null()], |column| column.buffers.clone());
    let null_count = column.as_ref().map_or(0, |column| column.nulls);
    let mut owned = Box::new(OwnedArray { _column: column, buffers, children });
    Array {
        length: rows as i64,
        null_count,
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
        let child =
            |column: &Arc<Column>| Box::into_raw(Box::new(schema(column.format, Some(column.clone()), Vec::new())));
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
    for (name, values) in columns {
        let known = CString::new(name.replace('\0', "")).expect("no zeros are left");
        match Column::of(known, &values) {
            Some(column) if *rows.get_or_insert(column.rows) == column.rows => all.push(Arc::new(column)),
            _ => return Err(PyValueError::new_err(format!("`{name}` is no column of this table"))),
        }
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
