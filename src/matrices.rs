//! Writes and reads matrices as files of other tools: NumPy's .npz and MATLAB's .mat, version 5.
//!
//! In: names and matrices, row-major. Out: bytes. And back: arrays of numbers, and lists of texts. Both formats are
//! small and have not changed for decades: numpy.lib.format 1.0 in a ZIP archive; "MAT-File Format", MathWorks,
//! chapter 1. Files are written without compression, and read with or without it.

/// A matrix and its name.
pub struct Matrix<'a> {
    /// Variable name in the other tool.
    pub name: &'a str,
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
    /// Row-major.
    pub values: &'a [f64],
}

/// An archive for `numpy.load`.
pub fn npz(matrices: &[Matrix]) -> Vec<u8> {
    let one = |matrix: &Matrix| (format!("{}.npy", matrix.name), npy(matrix));
    zip(matrices.iter().map(one).collect())
}

/// An archive of columns for `numpy.load`, and `columns`, the list of their headings.
pub fn npz_of_columns(names: &[String], headings: &[String], columns: &[Vec<f64>]) -> Vec<u8> {
    let column = |(name, column): (&String, &Vec<f64>)| {
        let data = column.iter().flat_map(|value| value.to_le_bytes()).collect();
        (format!("{name}.npy"), array("<f8", &format!("({},)", column.len()), data))
    };
    let width = headings.iter().map(|heading| heading.chars().count()).max().unwrap_or(0).max(1);
    let padded = |heading: &String| {
        let letters: Vec<u32> = heading.chars().map(u32::from).chain(std::iter::repeat(0)).take(width).collect();
        letters.into_iter().flat_map(u32::to_le_bytes)
    };
    let texts = headings.iter().flat_map(padded).collect();
    let list = ("columns.npy".to_string(), array(&format!("<U{width}"), &format!("({},)", headings.len()), texts));
    zip(names.iter().zip(columns).map(column).chain([list]).collect())
}

/// A ZIP archive without compression.
fn zip(files: Vec<(String, Vec<u8>)>) -> Vec<u8> {
    let mut out = Vec::new();
    let mut directory = Vec::new();
    let count = files.len() as u16;
    for (name, bytes) in files {
        let offset = out.len() as u32;
        // The fields common to the local header and the directory: version, flags, method, date of 1 January 1980,
        // checksum and sizes.
        let mut shared = Vec::new();
        for half in [20u16, 0, 0, 0, 0x21] {
            shared.extend(half.to_le_bytes());
        }
        for word in [crc32(&bytes), bytes.len() as u32, bytes.len() as u32] {
            shared.extend(word.to_le_bytes());
        }
        shared.extend((name.len() as u16).to_le_bytes());
        shared.extend(0u16.to_le_bytes());
        out.extend(b"PK\x03\x04");
        out.extend(&shared);
        out.extend(name.as_bytes());
        out.extend(&bytes);
        directory.extend(b"PK\x01\x02");
        directory.extend(20u16.to_le_bytes());
        directory.extend(&shared);
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let start = out.len() as u32;
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend(count.to_le_bytes());
    out.extend(count.to_le_bytes());
    out.extend((directory.len() as u32).to_le_bytes());
    out.extend(start.to_le_bytes());
    out.extend([0; 2]);
    out
}

fn npy(matrix: &Matrix) -> Vec<u8> {
    let data = matrix.values.iter().flat_map(|value| value.to_le_bytes()).collect();
    array("<f8", &format!("({}, {})", matrix.rows, matrix.columns), data)
}

/// An array file of NumPy: type of its elements, shape, data.
fn array(kind: &str, shape: &str, data: Vec<u8>) -> Vec<u8> {
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    // The data begins at a multiple of 64 bytes.
    while !(10 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    out.extend(data);
    out
}

/// The checksum of ZIP: CRC-32 with polynomial 0xEDB88320, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 })
    };
    !bytes.iter().fold(u32::MAX, step)
}

/// Types of elements of a .mat file.
mod mat5 {
    pub const INT8: u32 = 1;
    pub const UINT16: u32 = 4;
    pub const INT32: u32 = 5;
    pub const UINT32: u32 = 6;
    pub const DOUBLE: u32 = 9;
    pub const MATRIX: u32 = 14;
    pub const COMPRESSED: u32 = 15;
    /// Classes of arrays.
    pub const CHAR_CLASS: u32 = 4;
    pub const DOUBLE_CLASS: u32 = 6;
}

/// A file for MATLAB, Octave and `scipy.io.loadmat`.
pub fn mat(matrices: &[Matrix]) -> Vec<u8> {
    let mut out = mat_head();
    for matrix in matrices {
        let by_columns = (0..matrix.columns).flat_map(|j| (0..matrix.rows).map(move |i| i * matrix.columns + j));
        let values: Vec<u8> = by_columns.flat_map(|at| matrix.values[at].to_le_bytes()).collect();
        let values = element(mat5::DOUBLE, &values);
        out.extend(variable(mat5::DOUBLE_CLASS, matrix.name, matrix.rows, matrix.columns, values));
    }
    out
}

/// A file of column vectors for MATLAB, and `columns`, a matrix of characters with a heading in each row.
pub fn mat_of_columns(names: &[String], headings: &[String], columns: &[Vec<f64>]) -> Vec<u8> {
    let mut out = mat_head();
    for (name, column) in names.iter().zip(columns) {
        let values: Vec<u8> = column.iter().flat_map(|value| value.to_le_bytes()).collect();
        out.extend(variable(mat5::DOUBLE_CLASS, name, column.len(), 1, element(mat5::DOUBLE, &values)));
    }
    let rows: Vec<Vec<u16>> = headings.iter().map(|heading| heading.encode_utf16().collect()).collect();
    let width = rows.iter().map(Vec::len).max().unwrap_or(0);
    let letter = |column: usize| rows.iter().map(move |row| row.get(column).copied().unwrap_or(u16::from(b' ')));
    let letters: Vec<u8> = (0..width).flat_map(letter).flat_map(u16::to_le_bytes).collect();
    let letters = element(mat5::UINT16, &letters);
    out.extend(variable(mat5::CHAR_CLASS, "columns", rows.len(), width, letters));
    out
}

fn mat_head() -> Vec<u8> {
    let mut out = format!("{:<116}", "MATLAB 5.0 MAT-file, written by fric").into_bytes();
    out.extend([0; 8]);
    out.extend(0x0100u16.to_le_bytes());
    out.extend(b"IM");
    out
}

fn element(kind: u32, bytes: &[u8]) -> Vec<u8> {
    let mut out = kind.to_le_bytes().to_vec();
    out.extend((bytes.len() as u32).to_le_bytes());
    out.extend(bytes);
    out.resize(out.len().next_multiple_of(8), 0);
    out
}

/// An array of a class; `data`: its elements by columns.
fn variable(class: u32, name: &str, rows: usize, columns: usize, data: Vec<u8>) -> Vec<u8> {
    let mut inside = element(mat5::UINT32, &[class.to_le_bytes(), [0; 4]].concat());
    let shape = [rows as u32, columns as u32].map(u32::to_le_bytes);
    inside.extend(element(mat5::INT32, &shape.concat()));
    inside.extend(element(mat5::INT8, name.as_bytes()));
    inside.extend(data);
    element(mat5::MATRIX, &inside)
}

/// A variable of a file that was read.
#[derive(Clone, PartialEq, Debug)]
pub struct Variable {
    /// Its name in the other tool.
    pub name: String,
    /// Its value.
    pub value: Held,
}

/// The value of a variable.
#[derive(Clone, PartialEq, Debug)]
pub enum Held {
    /// Columns of numbers.
    Columns(Vec<Vec<f64>>),
    /// A list of texts.
    Texts(Vec<String>),
    /// Something else, in words: `a structure`.
    Other(&'static str),
}

/// Largest size of a variable after decompression.
const MOST_INFLATED: usize = 1 << 30;

/// The variables of a .npz archive, in their order.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn read_npz(bytes: &[u8]) -> Result<Vec<Variable>, String> {
    let cut = || "it is no .npz archive, or a part of one".to_string();
    let half = |at: usize| Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?) as usize);
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize);
    // The end of the directory is the last record; a comment may follow it.
    let from = bytes.len().saturating_sub(22 + 0xFFFF);
    let end = (from..bytes.len().saturating_sub(21)).rev().find(|at| bytes[*at..].starts_with(b"PK\x05\x06"));
    let end = end.ok_or_else(cut)?;
    let (count, mut at) = half(end + 10).zip(word(end + 16)).ok_or_else(cut)?;
    let mut out = Vec::new();
    for _ in 0..count {
        let entry = || {
            let (method, packed, size) = (half(at + 10)?, word(at + 20)?, word(at + 24)?);
            let (name_len, more, local) = (half(at + 28)?, half(at + 30)? + half(at + 32)?, word(at + 42)?);
            let name = std::str::from_utf8(bytes.get(at + 46..at + 46 + name_len)?).ok()?;
            let data = local + 30 + half(local + 26)? + half(local + 28)?;
            Some((name, method, size, bytes.get(data..data.checked_add(packed)?)?, at + 46 + name_len + more))
        };
        let (name, method, size, data, next) = entry().ok_or_else(cut)?;
        at = next;
        let name = name.strip_suffix(".npy").unwrap_or(name);
        let inflated;
        let data = match method {
            0 => data,
            8 => {
                let limit = size.min(MOST_INFLATED);
                inflated = miniz_oxide::inflate::decompress_to_vec_with_limit(data, limit);
                inflated.as_deref().map_err(|_| format!("`{name}` is damaged"))?
            }
            _ => return Err(format!("`{name}` is compressed in a way that is not known: use `numpy.savez`")),
        };
        out.push(Variable { name: name.into(), value: npy_value(data).ok_or_else(|| format!("`{name}` is damaged"))? });
    }
    Ok(out)
}

/// The value of an array file; none if it is damaged.
fn npy_value(bytes: &[u8]) -> Option<Held> {
    let rest = bytes.strip_prefix(b"\x93NUMPY")?;
    let (from, len): (usize, usize) = match rest.first()? {
        1 => (10, usize::from(u16::from_le_bytes(rest.get(2..4)?.try_into().ok()?))),
        _ => (12, u32::from_le_bytes(rest.get(2..6)?.try_into().ok()?) as usize),
    };
    let header = std::str::from_utf8(bytes.get(from..from.checked_add(len)?)?).ok()?;
    let data = bytes.get(from + len..)?;
    let after = |key: &str| Some(header[header.find(key)? + key.len()..].trim_start_matches([':', ' ', '\'']));
    let Some(kind) = after("'descr'").filter(|kind| !kind.starts_with('[')) else {
        return Some(Held::Other("an array of records"));
    };
    let kind = &kind[..kind.find('\'')?];
    let by_columns = after("'fortran_order'")?.starts_with("True");
    let shape = after("'shape'")?.trim_start_matches('(');
    let shape = shape[..shape.find(')')?].split(',').map(str::trim).filter(|size| !size.is_empty());
    let shape: Vec<usize> = shape.map(|size| size.parse().ok()).collect::<Option<_>>()?;
    let (rows, columns) = match shape[..] {
        [] => (1, 1),
        [rows] => (rows, 1),
        [rows, columns] => (rows, columns),
        _ => return Some(Held::Other("an array of more than two dimensions")),
    };
    let (big, kind) = (kind.starts_with('>'), kind.trim_start_matches(['<', '>', '|', '=']));
    let count = rows.checked_mul(columns)?;
    if let Some(width) = kind.strip_prefix('U') {
        let width: usize = width.parse().ok()?;
        let size = width.checked_mul(4)?.max(1);
        let letter = |b: &[u8]| {
            let b: [u8; 4] = b.try_into().expect("chunks of four");
            let code = if big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) };
            char::from_u32(code).filter(|c| *c != '\0')
        };
        let text = |chunk: &[u8]| chunk.chunks_exact(4).filter_map(letter).collect();
        return Some(Held::Texts(data.get(..count.checked_mul(size)?)?.chunks_exact(size).map(text).collect()));
    }
    let (class, size) = kind.split_at_checked(1)?;
    let kind = match (class, size) {
        ("f", "8") => Number::F64,
        ("f", "4") => Number::F32,
        ("b", "1") | ("u", "1") => Number::U8,
        ("i", "1") => Number::I8,
        ("u", "2") => Number::U16,
        ("i", "2") => Number::I16,
        ("u", "4") => Number::U32,
        ("i", "4") => Number::I32,
        ("u", "8") => Number::U64,
        ("i", "8") => Number::I64,
        _ => return Some(Held::Other("no array of real numbers")),
    };
    let numbers = kind.all(data, count, big)?;
    let row_major = !by_columns && rows > 0 && columns > 1;
    Some(Held::Columns(apart(numbers, rows, columns, row_major)))
}

/// The columns of a matrix. A matrix of one row is a single column.
fn apart(numbers: Vec<f64>, rows: usize, columns: usize, row_major: bool) -> Vec<Vec<f64>> {
    if rows <= 1 || columns <= 1 {
        return vec![numbers];
    }
    let at = |i: usize, j: usize| if row_major { i * columns + j } else { j * rows + i };
    (0..columns).map(|j| (0..rows).map(|i| numbers[at(i, j)]).collect()).collect()
}

/// How numbers are stored.
#[derive(Clone, Copy)]
enum Number {
    F64,
    F32,
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
}

impl Number {
    /// The first `count` numbers; none if there are fewer.
    fn all(self, bytes: &[u8], count: usize, big: bool) -> Option<Vec<f64>> {
        fn each<const N: usize>(bytes: &[u8], count: usize, big: bool, read: fn([u8; N]) -> f64) -> Option<Vec<f64>> {
            let bytes = bytes.get(..count.checked_mul(N)?)?;
            let one = |chunk: &[u8]| {
                let mut chunk: [u8; N] = chunk.try_into().expect("chunks of this size");
                if big {
                    chunk.reverse();
                }
                read(chunk)
            };
            Some(bytes.chunks_exact(N).map(one).collect())
        }
        match self {
            Number::F64 => each(bytes, count, big, f64::from_le_bytes),
            Number::F32 => each(bytes, count, big, |b| f64::from(f32::from_le_bytes(b))),
            Number::U8 => each(bytes, count, big, |b| f64::from(u8::from_le_bytes(b))),
            Number::I8 => each(bytes, count, big, |b| f64::from(i8::from_le_bytes(b))),
            Number::U16 => each(bytes, count, big, |b| f64::from(u16::from_le_bytes(b))),
            Number::I16 => each(bytes, count, big, |b| f64::from(i16::from_le_bytes(b))),
            Number::U32 => each(bytes, count, big, |b| f64::from(u32::from_le_bytes(b))),
            Number::I32 => each(bytes, count, big, |b| f64::from(i32::from_le_bytes(b))),
            Number::U64 => each(bytes, count, big, |b| u64::from_le_bytes(b) as f64),
            Number::I64 => each(bytes, count, big, |b| i64::from_le_bytes(b) as f64),
        }
    }
}

/// The variables of a .mat file, version 5 to 7, in their order.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn read_mat(bytes: &[u8]) -> Result<Vec<Variable>, String> {
    if bytes.starts_with(b"MATLAB 7.3") || bytes.starts_with(b"\x89HDF") {
        return Err("it is of version 7.3 (HDF5): save it with `save('name.mat', '-v7')`".into());
    }
    let big = match bytes.get(126..128) {
        Some(b"IM") => false,
        Some(b"MI") => true,
        _ => return Err("it is no .mat file of version 5 to 7".into()),
    };
    let mut out = Vec::new();
    let mut rest = &bytes[128..];
    while !rest.is_empty() {
        let cut = || "it is cut off".to_string();
        let (kind, data, after) = next_element(rest, big).ok_or_else(cut)?;
        rest = after;
        let inflated;
        let matrix = match kind {
            mat5::MATRIX => Some(data),
            mat5::COMPRESSED => {
                inflated = miniz_oxide::inflate::decompress_to_vec_zlib_with_limit(data, MOST_INFLATED)
                    .map_err(|_| "one of its variables is damaged".to_string())?;
                next_element(&inflated, big).filter(|(kind, ..)| *kind == mat5::MATRIX).map(|(_, data, _)| data)
            }
            _ => None,
        };
        if let Some(matrix) = matrix {
            out.push(mat_variable(matrix, big).ok_or("one of its variables is damaged")?);
        }
    }
    Ok(out)
}

/// Type and data of the first element, and what follows it.
fn next_element(bytes: &[u8], big: bool) -> Option<(u32, &[u8], &[u8])> {
    let word = |at: usize| {
        let b: [u8; 4] = bytes.get(at..at + 4)?.try_into().ok()?;
        Some(if big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    };
    let kind = word(0)?;
    // A small element has its size and up to four bytes of data in the same eight bytes.
    if kind >> 16 != 0 {
        let size = (kind >> 16) as usize;
        return Some((kind & 0xFFFF, bytes.get(4..4 + size.min(4))?, bytes.get(8..)?));
    }
    let size = word(4)? as usize;
    let data = bytes.get(8..8usize.checked_add(size)?)?;
    // Compressed elements are not padded.
    let padded = if kind == mat5::COMPRESSED { size } else { size.next_multiple_of(8) };
    Some((kind, data, bytes.get(8 + padded..).unwrap_or(&[])))
}

/// A variable; none if it is damaged.
fn mat_variable(bytes: &[u8], big: bool) -> Option<Variable> {
    let (_, flags, rest) = next_element(bytes, big)?;
    let flags: [u8; 4] = flags.get(..4)?.try_into().ok()?;
    let flags = if big { u32::from_be_bytes(flags) } else { u32::from_le_bytes(flags) };
    let (kind, shape, rest) = next_element(rest, big)?;
    if kind != mat5::INT32 {
        return None;
    }
    let shape = Number::I32.all(shape, shape.len() / 4, big)?;
    let (_, name, rest) = next_element(rest, big)?;
    let name = String::from_utf8_lossy(name).into_owned();
    let complex = flags & 0x0800 != 0;
    let value = match (flags & 0xFF, &shape[..]) {
        (1, _) => Held::Other("a cell array"),
        (2, _) => Held::Other("a structure"),
        (3 | 16.., _) => Held::Other("an object"),
        (5, _) => Held::Other("a sparse matrix"),
        _ if complex => Held::Other("complex"),
        (class, &[rows, columns]) => {
            let (rows, columns) = (rows as usize, columns as usize);
            let (kind, data, _) = next_element(rest, big)?;
            let numbers = match kind {
                1 => Number::I8,
                2 | 16 => Number::U8,
                3 => Number::I16,
                mat5::UINT16 | 17 => Number::U16,
                mat5::INT32 => Number::I32,
                mat5::UINT32 => Number::U32,
                7 => Number::F32,
                mat5::DOUBLE => Number::F64,
                12 => Number::I64,
                13 => Number::U64,
                _ => return None,
            };
            let numbers = numbers.all(data, rows.checked_mul(columns)?, big)?;
            if class == mat5::CHAR_CLASS {
                let text = |i: usize| {
                    let letters: Vec<u16> = (0..columns).map(|j| numbers[j * rows + i] as u16).collect();
                    String::from_utf16_lossy(&letters).trim_end().to_string()
                };
                Held::Texts((0..rows).map(text).collect())
            } else {
                Held::Columns(apart(numbers, rows, columns, false))
            }
        }
        _ => Held::Other("an array of more than two dimensions"),
    };
    Some(Variable { name, value })
}

#[cfg(test)]
mod tests {
    use super::*;

    const VALUES: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.5];

    fn matrix() -> Matrix<'static> {
        Matrix { name: "A", rows: 2, columns: 3, values: &VALUES }
    }

    #[test]
    fn the_check_sum_is_that_of_zip() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn an_array_of_numpy_begins_where_it_should() {
        let bytes = npy(&matrix());
        assert!(
            bytes.starts_with(b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3)")
        );
        assert_eq!((bytes.len(), bytes[127]), (128 + 48, b'\n'));
        assert_eq!(bytes[128 + 40..], 6.5f64.to_le_bytes());
    }

    #[test]
    fn the_directory_of_an_archive_leads_to_its_files() {
        let bytes = npz(&[matrix(), Matrix { name: "D", rows: 0, columns: 0, values: &[] }]);
        let end = bytes.len() - 22;
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(bytes[end..end + 4], *b"PK\x05\x06");
        let directory = word(end + 16);
        assert_eq!(directory + word(end + 12), end);
        assert_eq!(bytes[directory..directory + 4], *b"PK\x01\x02");
        let second = directory + 46 + "A.npy".len();
        let at = word(second + 42);
        assert_eq!(bytes[at..at + 4], *b"PK\x03\x04");
        assert_eq!(bytes[at + 30..at + 35], *b"D.npy");
    }

    #[test]
    fn a_mat_file_holds_columns_and_is_aligned() {
        let bytes = mat(&[matrix()]);
        assert_eq!(bytes[124..128], [0, 1, b'I', b'M']);
        assert_eq!(bytes.len() % 8, 0);
        assert_eq!(bytes[bytes.len() - 40..bytes.len() - 32], 4.0f64.to_le_bytes());
        assert_eq!(bytes[128..136], [14, 0, 0, 0, 16 + 16 + 16 + 8 + 48, 0, 0, 0]);
    }
}
