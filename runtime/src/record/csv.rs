//! Writes a recording as comma-separated values: `t [s],body.v [mm/s]`, one row for each point kept.
//!
//! Values are in the units shown, as the shortest decimals that parse to the same bits.

use super::Recording;
use abi::format;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Writes the file atomically: into a temporary file beside it, which is then renamed.
///
/// # Errors
/// Those of the file system; an existing file of that name is then unchanged.
pub fn save(recording: &Recording, path: &Path) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?;
    let mut part = name.to_os_string();
    part.push(format!(".{}.part", std::process::id()));
    let part = path.with_file_name(part);
    let written = File::create(&part).and_then(|file| {
        let mut file = BufWriter::new(file);
        write(recording, &mut file)?;
        file.flush()?;
        file.get_ref().sync_all()?;
        fs::rename(&part, path)
    });
    if written.is_err() {
        // Report the first error, not that of the cleanup.
        let _ = fs::remove_file(&part);
    }
    written
}

/// Writes header and rows.
///
/// # Errors
/// Those of the writer.
pub fn write(recording: &Recording, to: impl Write) -> io::Result<()> {
    let mut csv = ::csv::Writer::from_writer(to);
    csv.write_record(headings(recording))?;
    for row in shown(recording) {
        csv.write_record(row.map(format::plain))?;
    }
    csv.flush()
}

/// The heading of each column, beginning with time: `t [s]`, `body.v [mm/s]`, `fr.stick`.
pub fn headings(recording: &Recording) -> Vec<String> {
    let heading = |column: &super::Column| match column.boolean {
        true => column.label.clone(),
        false => format!("{} [{}]", column.label, column.unit),
    };
    std::iter::once("t [s]".to_string()).chain(recording.columns().iter().map(heading)).collect()
}

/// The rows in the units of the headings.
pub fn shown(recording: &Recording) -> impl Iterator<Item = impl Iterator<Item = f64>> {
    recording.rows().map(|row| {
        let values = recording.columns().iter().zip(&row[1..]).map(|(column, value)| column.unit.from_si(*value));
        std::iter::once(row[0]).chain(values)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Recorder;
    use abi::Slot;
    use abi::plan::{Plot, Series, View};
    use abi::unit::Unit;

    fn recording() -> Recording {
        let series = |label: &str, slot, unit: &str, boolean| Series {
            label: label.into(),
            slot: Slot(slot),
            unit: Unit::parse(unit).unwrap(),
            boolean,
        };
        let plot = Plot {
            series: vec![series("body.v", 3, "mm/s", false), series("max(a, b)", 4, "1", false)],
            against: Some(series("fr.stick", 5, "1", true)),
            view: View::default(),
        };
        let mut recorder = Recorder::new(&[plot], &[]);
        recorder.see(0.0, &[0.0, 0.0, 0.0, 0.25, 1.0 / 3.0, 1.0]);
        recorder.see(1e-5, &[0.0, 0.0, 0.0, -0.001, 1e-20, 0.0]);
        recorder.recording()
    }

    #[test]
    fn headers_carry_units_and_numbers_read_back() {
        let mut text = Vec::new();
        write(&recording(), &mut text).unwrap();
        let expected = "t [s],body.v [mm/s],\"max(a, b) [1]\",fr.stick\n0,250,0.3333333333333333,1\n1e-5,-1,1e-20,0\n";
        assert_eq!(String::from_utf8(text).unwrap(), expected);
    }

    #[test]
    fn files_are_written_atomically() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.csv");
        fs::write(&path, "before").unwrap();
        save(&recording(), &path).unwrap();
        assert!(fs::read_to_string(&path).unwrap().starts_with("t [s],"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

        // A folder of that name cannot be replaced; no temporary file remains.
        let taken = folder.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(save(&recording(), &taken).is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
