//! Converts CSV tables and columns of numbers to Parquet files, for pandas, Polars or DuckDB, and reads columns back.
//!
//! In: rows of comma-separated values and the type of each column, or columns. Out: a file. An empty cell becomes a
//! null. The only file that uses the crate `parquet`.

use ::parquet::basic::{self, LogicalType, Repetition};
use ::parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use ::parquet::errors::ParquetError;
use ::parquet::file::properties::WriterProperties;
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use ::parquet::record::Field;
use ::parquet::schema::types::Type;
use std::io::{self, Read, Write};
use std::sync::Arc;

/// The type of the cells of a column.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Holds {
    Numbers,
    Integers,
    Booleans,
    Words,
}

/// Rows buffered before they are written as one row group.
const GROUP: usize = 1 << 16;

/// Writes the rows of `csv` as a table with these columns. With `header`, the first row is skipped.
///
/// # Errors
/// A row that is too short or a cell that does not match the type of its column, with the number of its row; errors of
/// the writer.
pub fn from_csv(csv: impl Read, header: bool, columns: &[(String, Holds)], to: impl Write + Send) -> io::Result<()> {
    let mut file = SerializedFileWriter::new(to, Arc::new(schema(columns)?), Arc::new(WriterProperties::default()))?;
    let mut reader = ::csv::ReaderBuilder::new().has_headers(header).from_reader(csv);
    let mut cells: Vec<Vec<String>> = vec![Vec::new(); columns.len()];
    let (mut record, mut before) = (::csv::StringRecord::new(), 0);
    loop {
        let more = reader.read_record(&mut record)?;
        if more {
            // The reader reports rows of another length as errors.
            cells.iter_mut().zip(&record).for_each(|(column, cell)| column.push(cell.to_string()));
        }
        let rows = cells.first().map_or(0, Vec::len);
        if rows == GROUP || !more {
            let mut group = file.next_row_group()?;
            for ((name, holds), cells) in columns.iter().zip(&mut cells) {
                column(&mut group, *holds, cells).map_err(|(row, cell)| {
                    let row = before + row + 1;
                    io::Error::new(io::ErrorKind::InvalidData, format!("row {row}: {name} cannot be `{cell}`"))
                })??;
                cells.clear();
            }
            group.close()?;
            before += rows;
        }
        if !more {
            file.close()?;
            return Ok(());
        }
    }
}

/// Writes columns of one length: numbers, or 0 and 1 as booleans.
///
/// # Errors
/// Those of the writer.
pub fn of_columns(headings: &[(String, Holds)], columns: &[Vec<f64>], to: impl Write + Send) -> io::Result<()> {
    let mut file = SerializedFileWriter::new(to, Arc::new(schema(headings)?), Arc::new(WriterProperties::default()))?;
    let rows = columns.first().map_or(0, Vec::len);
    for from in (0..rows).step_by(GROUP) {
        let part = from..rows.min(from + GROUP);
        let present = vec![1i16; part.len()];
        let mut group = file.next_row_group()?;
        for ((_, holds), numbers) in headings.iter().zip(columns) {
            let numbers = &numbers[part.clone()];
            let mut column = group.next_column()?.expect("one column of the schema is left");
            if *holds == Holds::Booleans {
                let values: Vec<bool> = numbers.iter().map(|number| *number > 0.5).collect();
                column.typed::<BoolType>().write_batch(&values, Some(&present), None)?;
            } else {
                column.typed::<DoubleType>().write_batch(numbers, Some(&present), None)?;
            }
            column.close()?;
        }
        group.close()?;
    }
    file.close()?;
    Ok(())
}

/// The columns of numbers and truth values of a file, with their headings; times of day and dates in s. An empty cell
/// is NaN. Columns of other types are left out.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn columns(bytes: Vec<u8>) -> Result<Vec<(String, Vec<f64>)>, String> {
    let told = |error: ParquetError| match error {
        ParquetError::General(what) if what.contains("Disabled feature") => {
            let codec = what.rsplit(": ").next().unwrap_or_default();
            format!("its columns are compressed by {codec}: write them with `compression='snappy'`, 'gzip' or none")
        }
        error => error.to_string(),
    };
    let file = SerializedFileReader::new(::bytes::Bytes::from(bytes)).map_err(told)?;
    let names: Vec<String> =
        file.metadata().file_metadata().schema().get_fields().iter().map(|field| field.name().to_string()).collect();
    let mut columns: Vec<(String, Option<Vec<f64>>)> = names.into_iter().map(|name| (name, Some(Vec::new()))).collect();
    for row in file.get_row_iter(None).map_err(told)? {
        let row = row.map_err(told)?;
        for ((_, column), (_, field)) in columns.iter_mut().zip(row.get_column_iter()) {
            match (number(field), column.as_mut()) {
                (Some(number), Some(numbers)) => numbers.push(number),
                _ => *column = None,
            }
        }
    }
    Ok(columns.into_iter().filter_map(|(name, numbers)| Some((name, numbers?))).collect())
}

/// Passes the rows of a file that [`from_csv`] has written, with cells as text from which the same values are read.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn rows(bytes: Vec<u8>, see: &mut dyn FnMut(&::csv::StringRecord)) -> Result<(), String> {
    let told = |error: ParquetError| error.to_string();
    let file = SerializedFileReader::new(::bytes::Bytes::from(bytes)).map_err(told)?;
    let mut cells = ::csv::StringRecord::new();
    for row in file.get_row_iter(None).map_err(told)? {
        cells.clear();
        for (_, field) in row.map_err(told)?.get_column_iter() {
            match field {
                Field::Null => cells.push_field(""),
                Field::Bool(holds) => cells.push_field(&holds.to_string()),
                Field::Long(x) => cells.push_field(&x.to_string()),
                Field::Double(x) => cells.push_field(&format!("{x:?}")),
                Field::Str(text) => cells.push_field(text),
                other => return Err(format!("`{other}` is no cell of a sweep")),
            }
        }
        see(&cells);
    }
    Ok(())
}

/// The number of a cell; none if it holds none.
fn number(field: &Field) -> Option<f64> {
    Some(match *field {
        Field::Null => f64::NAN,
        Field::Bool(holds) => f64::from(u8::from(holds)),
        Field::Byte(x) => f64::from(x),
        Field::Short(x) => f64::from(x),
        Field::Int(x) => f64::from(x),
        Field::Long(x) => x as f64,
        Field::UByte(x) => f64::from(x),
        Field::UShort(x) => f64::from(x),
        Field::UInt(x) => f64::from(x),
        Field::ULong(x) => x as f64,
        Field::Float16(x) => f64::from(f32::from(x)),
        Field::Float(x) => f64::from(x),
        Field::Double(x) => x,
        Field::TimestampMillis(x) => x as f64 / 1e3,
        Field::TimestampMicros(x) => x as f64 / 1e6,
        _ => return None,
    })
}

/// The columns as a Parquet schema.
fn schema(columns: &[(String, Holds)]) -> Result<Type, ParquetError> {
    let column = |(name, holds): &(String, Holds)| {
        let (kind, logical) = match holds {
            Holds::Numbers => (basic::Type::DOUBLE, None),
            Holds::Integers => (basic::Type::INT64, None),
            Holds::Booleans => (basic::Type::BOOLEAN, None),
            Holds::Words => (basic::Type::BYTE_ARRAY, Some(LogicalType::String)),
        };
        let builder = Type::primitive_type_builder(name, kind);
        builder.with_repetition(Repetition::OPTIONAL).with_logical_type(logical).build().map(Arc::new)
    };
    let fields = columns.iter().map(column).collect::<Result<Vec<_>, _>>()?;
    Type::group_type_builder("table").with_fields(fields).build()
}

/// Writes the cells of one column as one chunk. The outer error: a row, from 0, and its cell.
fn column<W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    holds: Holds,
    cells: &[String],
) -> Result<Result<(), ParquetError>, (usize, String)> {
    match holds {
        Holds::Numbers => chunk::<DoubleType, W>(group, cells, |cell| cell.parse().ok()),
        Holds::Integers => chunk::<Int64Type, W>(group, cells, |cell| cell.parse().ok()),
        Holds::Booleans => chunk::<BoolType, W>(group, cells, |cell| cell.parse().ok()),
        Holds::Words => chunk::<ByteArrayType, W>(group, cells, |cell| Some(ByteArray::from(cell))),
    }
}

fn chunk<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    cells: &[String],
    read: impl Fn(&str) -> Option<T::T>,
) -> Result<Result<(), ParquetError>, (usize, String)> {
    let mut values = Vec::with_capacity(cells.len());
    let mut present = Vec::with_capacity(cells.len());
    for (row, cell) in cells.iter().enumerate() {
        present.push(i16::from(!cell.is_empty()));
        if !cell.is_empty() {
            values.push(read(cell).ok_or_else(|| (row, cell.clone()))?);
        }
    }
    let mut write = || {
        let mut column = group.next_column()?.expect("one column of the schema is left");
        column.typed::<T>().write_batch(&values, Some(&present), None)?;
        column.close()
    };
    Ok(write())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    fn columns() -> Vec<(String, Holds)> {
        let named = |name: &str, holds| (name.to_string(), holds);
        vec![
            named("run", Holds::Integers),
            named("fr.Fs [N]", Holds::Numbers),
            named("holds", Holds::Booleans),
            named("status", Holds::Words),
        ]
    }

    /// Writes these rows and reads the table back.
    fn again(name: &str, csv: &str, header: bool) -> SerializedFileReader<File> {
        let path = std::env::temp_dir().join(format!("fric-parquet-{name}-{}", std::process::id()));
        from_csv(csv.as_bytes(), header, &columns(), File::create(&path).unwrap()).unwrap();
        let file = File::open(&path).unwrap();
        std::fs::remove_file(path).unwrap();
        SerializedFileReader::new(file).unwrap()
    }

    #[test]
    fn a_table_survives_the_round_trip_with_types_and_nulls() {
        let csv = "run,Fs,holds,status\n7,1e-5,true,ok\n8,,false,\"stopped: a, b\"\n9,NaN,,ok\n";
        let file = again("kinds", csv, true);
        let rows: Vec<String> = file.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(
            rows,
            [
                "{run: 7, fr.Fs [N]: 0.00001, holds: true, status: \"ok\"}",
                "{run: 8, fr.Fs [N]: null, holds: false, status: \"stopped: a, b\"}",
                "{run: 9, fr.Fs [N]: NaN, holds: null, status: \"ok\"}",
            ]
        );
    }

    #[test]
    fn an_invalid_cell_is_reported_with_its_row() {
        let refused = |csv: &str| from_csv(csv.as_bytes(), false, &columns(), Vec::new()).unwrap_err().to_string();
        assert_eq!(refused("7,1,true,ok\n8,x,true,ok\n"), "row 2: fr.Fs [N] cannot be `x`");
        assert!(refused("7,1,true,ok\n8\n").contains("found record with 1 fields"));
    }

    #[test]
    fn many_rows_are_many_groups() {
        let csv: String = (0..GROUP + 3).map(|k| format!("{k},0.5,true,ok\n")).collect();
        let file = again("groups", &csv, false);
        let metadata = file.metadata();
        assert_eq!((metadata.num_row_groups(), metadata.file_metadata().num_rows()), (2, GROUP as i64 + 3));
    }
}
