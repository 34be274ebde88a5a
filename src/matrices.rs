//! Writes matrices as files for other tools: NumPy's .npz and MATLAB's .mat, version 5.
//!
//! In: names and matrices, row-major. Out: bytes. Both formats are small and have not changed for decades:
//! numpy.lib.format 1.0 in a ZIP archive without compression; "MAT-File Format", MathWorks, chapter 1.

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
    let mut out = Vec::new();
    let mut directory = Vec::new();
    for matrix in matrices {
        let bytes = npy(matrix);
        let name = format!("{}.npy", matrix.name);
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
    let (start, count) = (out.len() as u32, matrices.len() as u16);
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
    let mut header =
        format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, {}), }}", matrix.rows, matrix.columns);
    // The data begins at a multiple of 64 bytes.
    while !(10 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    out.extend(matrix.values.iter().flat_map(|value| value.to_le_bytes()));
    out
}

/// The checksum of ZIP: CRC-32 with polynomial 0xEDB88320, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 })
    };
    !bytes.iter().fold(u32::MAX, step)
}

/// A file for MATLAB, Octave and `scipy.io.loadmat`.
pub fn mat(matrices: &[Matrix]) -> Vec<u8> {
    const INT8: u32 = 1;
    const INT32: u32 = 5;
    const UINT32: u32 = 6;
    const DOUBLE: u32 = 9;
    const MATRIX: u32 = 14;
    const DOUBLE_CLASS: u32 = 6;
    let mut out = format!("{:<116}", "MATLAB 5.0 MAT-file, written by fric").into_bytes();
    out.extend([0; 8]);
    out.extend(0x0100u16.to_le_bytes());
    out.extend(b"IM");
    let element = |kind: u32, bytes: &[u8]| {
        let mut out = kind.to_le_bytes().to_vec();
        out.extend((bytes.len() as u32).to_le_bytes());
        out.extend(bytes);
        out.resize(out.len().next_multiple_of(8), 0);
        out
    };
    for matrix in matrices {
        let mut inside = element(UINT32, &[DOUBLE_CLASS.to_le_bytes(), [0; 4]].concat());
        let shape = [matrix.rows as u32, matrix.columns as u32].map(u32::to_le_bytes);
        inside.extend(element(INT32, &shape.concat()));
        inside.extend(element(INT8, matrix.name.as_bytes()));
        let by_columns = (0..matrix.columns).flat_map(|j| (0..matrix.rows).map(move |i| i * matrix.columns + j));
        let values: Vec<u8> = by_columns.flat_map(|at| matrix.values[at].to_le_bytes()).collect();
        inside.extend(element(DOUBLE, &values));
        out.extend(element(MATRIX, &inside));
    }
    out
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
