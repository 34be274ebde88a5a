//! Recordings as files: .csv, and .parquet, .mat, .npz of other tools.
//!
//! In: a [`Recording`]. Out: the bytes of a file, by the ending of its name. And back: the bytes of a file as CSV text,
//! because the compiler reads text only. In .mat and .npz each column is an array under its own name, and the array
//! `columns` lists all headings with their units, in the order of the arrays. Knows nothing of paths on disk.

use crate::matrices::{self, Held, Variable};
use crate::parquet::{self, Holds};
use runtime::record::{Recording, csv};
use std::collections::HashSet;
use std::io;
use std::path::Path;

/// Kinds of files.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Format {
    Csv,
    Parquet,
    Mat,
    Npz,
}

impl Format {
    /// The format that the ending of a name states.
    pub fn of(path: &Path) -> Option<Format> {
        match path.extension().and_then(|ending| ending.to_str())?.to_ascii_lowercase().as_str() {
            "csv" => Some(Format::Csv),
            "parquet" => Some(Format::Parquet),
            "mat" => Some(Format::Mat),
            "npz" => Some(Format::Npz),
            _ => None,
        }
    }
}

/// How a file of a format that is not read becomes one that is; none for other endings.
pub fn conversion(path: &Path) -> Option<String> {
    let ending = path.extension().and_then(|ending| ending.to_str())?.to_ascii_lowercase();
    let (format, line) = match ending.as_str() {
        "h5" | "hdf5" => ("HDF5", "pandas.read_hdf('FILE').to_parquet('recording.parquet', compression='snappy')"),
        "mf4" | "mdf" => (
            "MDF",
            "asammdf.MDF('FILE').to_dataframe(raster=0.001).reset_index().to_parquet('recording.parquet', compression='snappy')",
        ),
        "mcap" | "bag" | "db3" => (
            "a ROS bag",
            "rosbags.dataframe.get_dataframe(AnyReader([Path('FILE')]), topic, fields).to_parquet('recording.parquet', compression='snappy')",
        ),
        "xlsx" | "xls" | "ods" => (
            "a spreadsheet",
            "pandas.read_excel('FILE').to_parquet('recording.parquet', compression='snappy'), or save it as CSV",
        ),
        _ => return None,
    };
    let file = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    Some(format!("{format} is not read; convert it: {}", line.replace("FILE", &file)))
}

/// A recording as the bytes of a file.
///
/// # Errors
/// Those of the writer of Parquet files.
pub fn bytes(recording: &Recording, format: Format) -> io::Result<Vec<u8>> {
    let mut out = Vec::new();
    let headings = csv::headings(recording);
    match format {
        Format::Csv => csv::write(recording, &mut out)?,
        Format::Parquet => {
            let booleans = std::iter::once(false).chain(recording.columns().iter().map(|column| column.boolean));
            let holds = |boolean| if boolean { Holds::Booleans } else { Holds::Numbers };
            let typed: Vec<_> = headings.into_iter().zip(booleans.map(holds)).collect();
            parquet::of_columns(&typed, &shown(recording), &mut out)?;
        }
        Format::Mat => {
            let names = names(recording, variable_name, 63);
            out = matrices::mat_of_columns(&names, &headings, &shown(recording));
        }
        Format::Npz => {
            let names = names(recording, str::to_string, usize::MAX);
            out = matrices::npz_of_columns(&names, &headings, &shown(recording));
        }
    }
    Ok(out)
}

/// Columns in the units of the headings.
fn shown(recording: &Recording) -> Vec<Vec<f64>> {
    let mut out = vec![Vec::with_capacity(recording.rows().len()); recording.columns().len() + 1];
    for row in csv::shown(recording) {
        out.iter_mut().zip(row).for_each(|(column, value)| column.push(value));
    }
    out
}

/// One name for each array, no two alike.
fn names(recording: &Recording, plain: impl Fn(&str) -> String, longest: usize) -> Vec<String> {
    let mut taken: HashSet<String> = HashSet::from(["columns".to_string()]);
    let labels = std::iter::once("t").chain(recording.columns().iter().map(|column| column.label.as_str()));
    let unique = |label| {
        let name: String = plain(label).chars().take(longest).collect();
        let numbered = |n: u32| {
            let ending = format!("_{n}");
            name.chars().take(longest - ending.len()).collect::<String>() + &ending
        };
        let name = if taken.contains(&name) {
            (2..).map(numbered).find(|name| !taken.contains(name)).expect("numbers do not end")
        } else {
            name
        };
        taken.insert(name.clone());
        name
    };
    labels.map(unique).collect()
}

/// A label as a name of MATLAB: `body.v` as `body_v`.
fn variable_name(label: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let name: String = label.chars().map(plain).collect();
    let name = name.trim_matches('_');
    if name.starts_with(|c: char| c.is_ascii_alphabetic()) { name.into() } else { format!("q_{name}") }
}

/// The columns of a file of another tool as CSV text. Not for [`Format::Csv`], which is text.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn text(bytes: Vec<u8>, format: Format) -> Result<String, String> {
    let columns = match format {
        Format::Csv => return String::from_utf8(bytes).map_err(|error| error.to_string()),
        Format::Parquet => parquet::columns(bytes)?,
        Format::Mat => of_variables(matrices::read_mat(&bytes)?)?,
        Format::Npz => of_variables(matrices::read_npz(&bytes)?)?,
    };
    let Some((_, first)) = columns.first() else { return Err("it has no column of numbers".into()) };
    let rows = first.len();
    if let Some((name, column)) = columns.iter().find(|(_, column)| column.len() != rows) {
        let first = &columns[0].0;
        return Err(format!(
            "`{name}` has {} numbers and `{first}` {rows}: columns of one file are as long",
            column.len()
        ));
    }
    let mut out = ::csv::Writer::from_writer(Vec::new());
    let wrote = out.write_record(columns.iter().map(|(name, _)| name.as_str()));
    wrote.expect("writing to memory does not fail");
    for row in 0..rows {
        let wrote = out.write_record(columns.iter().map(|(_, column)| column[row].to_string()));
        wrote.expect("writing to memory does not fail");
    }
    let bytes = out.into_inner().expect("writing to memory does not fail");
    Ok(String::from_utf8(bytes).expect("names and numbers are text"))
}

/// Columns of the variables of a file. A matrix `A` of several columns has the columns `A(:,1)`, `A(:,2)`, ….
fn of_variables(variables: Vec<Variable>) -> Result<Vec<(String, Vec<f64>)>, String> {
    let headings = variables.iter().find_map(|variable| match &variable.value {
        Held::Texts(texts) if variable.name == "columns" => Some(texts.clone()),
        Held::Texts(_) | Held::Columns(_) | Held::Other(_) => None,
    });
    let (mut columns, mut others) = (Vec::new(), Vec::new());
    for Variable { name, value } in variables {
        match value {
            Held::Columns(all) if all.len() == 1 => {
                columns.extend(all.into_iter().map(|column| (name.clone(), column)))
            }
            Held::Columns(all) => {
                columns.extend(all.into_iter().enumerate().map(|(k, column)| (format!("{name}(:,{})", k + 1), column)));
            }
            Held::Texts(_) => {}
            Held::Other(what) => others.push(format!("`{name}` is {what}")),
        }
    }
    if let Some(headings) = headings.filter(|headings| headings.len() == columns.len()) {
        columns.iter_mut().zip(headings).for_each(|((name, _), heading)| *name = heading);
    }
    // Settings beside the columns, such as a sampling time, are no columns.
    let longest = columns.iter().map(|(_, column)| column.len()).max().unwrap_or(0);
    if longest > 1 {
        columns.retain(|(_, column)| column.len() > 1);
    }
    match (columns.is_empty(), others.is_empty()) {
        (true, false) => {
            Err(format!("it has no column of numbers; {}: save its columns as vectors", others.join(", ")))
        }
        (_, _) => Ok(columns),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;
    use abi::plan::{Plot, Series, View};
    use abi::unit::Unit;
    use compiler::frontend::columns::{Selector, read};
    use compiler::ir::random::Random;
    use runtime::record::Recorder;

    const FORMATS: [Format; 4] = [Format::Csv, Format::Parquet, Format::Mat, Format::Npz];

    fn random_recording(random: &mut Random) -> Recording {
        const LABELS: [&str; 8] = ["x", "body.v", "fr.F - data.F", "max(a, b)", "x'", "1 / x", "columns", "t"];
        const UNITS: [&str; 6] = ["m", "mm/s", "N", "1", "um", "deg"];
        let series = |k: usize, random: &mut Random| {
            let boolean = random.below(4) == 0;
            let label = LABELS[random.below(LABELS.len())];
            // A condition has no unit.
            let unit = if boolean { "1" } else { UNITS[random.below(UNITS.len())] };
            Series {
                label: format!("{label}{}", if random.below(3) == 0 { "" } else { "2" }),
                slot: Slot(k as u32),
                unit: Unit::parse(unit).unwrap(),
                boolean,
            }
        };
        let series: Vec<Series> = (0..1 + random.below(6)).map(|k| series(k, random)).collect();
        let width = series.len();
        let booleans: Vec<bool> = series.iter().map(|series| series.boolean).collect();
        let plot = Plot { series, against: None, view: View::default() };
        let mut recorder = Recorder::whole(&[plot], &[], 1_000_000);
        for k in 0..random.below(40) + 1 {
            let mut value = |boolean| match boolean {
                true => f64::from(u8::from(random.below(2) == 0)),
                false => [0.0, 1e-300, random.within(-1.0, 1.0), 1e9 * random.within(-1.0, 1.0)][random.below(4)],
            };
            let row: Vec<f64> = (0..width).map(|k| value(booleans[k])).collect();
            recorder.see(k as f64 * 0.1, &row);
        }
        recorder.all().unwrap()
    }

    /// What a format holds, read as the compiler reads it, is the recording to the bit, with its headings and units.
    #[test]
    fn recordings_survive_every_format() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(11);
        let mut random = Random(seed);
        for case in 0..150 {
            let recording = random_recording(&mut random);
            let (headings, expected) = (csv::headings(&recording), shown(&recording));
            for format in FORMATS {
                let said = || format!("seed {seed}, case {case}, {format:?}");
                let bytes = bytes(&recording, format).unwrap();
                let text = text(bytes, format).unwrap_or_else(|why| panic!("{}: {why}", said()));
                // Columns of one row are settings beside longer ones, and the only columns otherwise.
                let wanted = vec![Selector::Place; headings.len()];
                let found = read(&text, &wanted).unwrap_or_else(|why| panic!("{}: {why:?}\n{text}", said()));
                assert_eq!(found.numbers, expected, "{}", said());
                for (heading, unit) in headings.iter().zip(&found.units) {
                    let stated = heading.rsplit_once(" [").map(|(_, unit)| unit.trim_end_matches(']').to_string());
                    assert_eq!(unit.as_ref().map(ToString::to_string), stated, "{}: {heading}", said());
                }
            }
        }
    }

    /// A damaged or foreign file is refused in words, at every length and with every byte changed: never a panic.
    #[test]
    fn damaged_files_are_refused() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(3);
        let mut random = Random(seed);
        let recording = random_recording(&mut random);
        for format in [Format::Mat, Format::Npz, Format::Parquet] {
            let whole = bytes(&recording, format).unwrap();
            for _ in 0..400 {
                let mut damaged = whole.clone();
                damaged.truncate(1 + random.below(whole.len()));
                if random.below(2) == 0 {
                    damaged = whole.clone();
                    let at = random.below(whole.len());
                    damaged[at] ^= 1 << random.below(8);
                }
                // The crate `parquet` asserts in places; its panics are not ours.
                if format != Format::Parquet {
                    let _ = text(damaged, format);
                }
            }
            assert!(text(b"no such file".to_vec(), format).is_err());
        }
    }

    #[test]
    fn names_of_arrays_are_unique_and_fit_their_tool() {
        assert_eq!(variable_name("body.v"), "body_v");
        assert_eq!(variable_name("1 / x"), "q_1___x");
        assert_eq!(variable_name("(a)"), "a");
        assert_eq!(Format::of(Path::new("a.MAT")), Some(Format::Mat));
        assert_eq!(Format::of(Path::new("a.xls")), None);
    }
}
