//! Where the rows of a sweep go: a table, or a dataset, a folder of Parquet files.
//!
//! In: rows in the order of the runs, or blocks of runs for statistics. Out: files that are whole or marked as unfinished,
//! with where to go on after an interruption. A table grows row by row. The files of a dataset are cut by the number of runs
//! alone, so the bytes of each depend on its runs and not on who made it or when; each is written whole or not at all.

use super::SweepTable;
use super::statistics::Statistics;
use super::summary::Summary;
use crate::parquet;
use crate::project;
use crate::unfinished::{Mark, Unfinished, begun_otherwise};
use runtime::package::hash;
use serde_json::json;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// What may be there already.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Before {
    /// Nothing unfinished.
    Nothing,
    /// The begin of the same sweep, which is continued.
    Continue,
    /// The begin of the same sweep, which is written anew.
    Replace,
}

/// The file to which rows, or blocks, are appended: the table itself, or one beside it if the format cannot grow row by
/// row.
pub fn rows_of(out: &Path) -> PathBuf {
    match out.extension().and_then(|extension| extension.to_str()) {
        Some("parquet") => out.with_file_name(format!(".{}.csv", name_of(out))),
        Some("json") => out.with_file_name(format!(".{}.blocks", name_of(out))),
        _ => out.to_path_buf(),
    }
}

/// The file with the statistics beside a table.
pub fn statistics_of(out: &Path) -> PathBuf {
    out.with_extension("json")
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Whether a name is that of a dataset: it has no ending, or ends with `/`.
pub fn is_dataset(out: &Path) -> bool {
    out.extension().is_none()
}

/// Rows of a file of a dataset: 65,536, or for fewer than 2^28 runs the power of two nearest above a 4096th of them, at
/// least 256.
pub fn rows_a_file(total: u64) -> u64 {
    total.div_ceil(4096).next_power_of_two().clamp(256, 1 << 16)
}

/// The file of a dataset whose first run is this one.
fn part(folder: &Path, first: u64) -> PathBuf {
    folder.join(format!("part-{first:08}.parquet"))
}

/// Writes these rows as the file of a dataset, whole or not at all. Returns the SHA-256 of its bytes, in hexadecimal.
pub fn write_part(table: &SweepTable, folder: &Path, first: u64, rows: &[u8]) -> io::Result<String> {
    let mut bytes = Vec::new();
    parquet::from_csv(rows, false, &table.kinds(), &mut bytes)?;
    project::write(&part(folder, first), &bytes)?;
    Ok(hash(&bytes))
}

/// The file that tells what a dataset is.
const ABOUT: &str = "_fric.json";

enum Form {
    Table { writer: BufWriter<File>, mark: Mark },
    Dataset { each: u64, rows: Vec<u8> },
}

/// What is known after the last row.
pub enum Finished {
    /// Of a table or a dataset.
    Rows(Summary),
    /// Of statistics alone, in words.
    Statistics(String),
}

impl Finished {
    /// For people.
    pub fn words(&self, table: &SweepTable) -> String {
        match self {
            Finished::Rows(summary) => summary.words(table),
            Finished::Statistics(words) => words.clone(),
        }
    }
}

/// A file that gets its name when it is whole.
struct Part<'a> {
    path: PathBuf,
    out: &'a Path,
}

impl Part<'_> {
    fn begin(out: &Path) -> io::Result<(Part<'_>, BufWriter<File>)> {
        let path = out.with_file_name(format!(".{}.part", name_of(out)));
        let file = File::create(&path)?;
        Ok((Part { path, out }, BufWriter::new(file)))
    }

    fn end(self, file: BufWriter<File>) -> io::Result<()> {
        file.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        fs::rename(&self.path, self.out)
    }
}

impl Drop for Part<'_> {
    fn drop(&mut self) {
        // It is gone after it was renamed.
        let _ = fs::remove_file(&self.path);
    }
}

/// A table or a dataset that is being written.
pub struct Sink {
    out: PathBuf,
    /// Its runs, and the next one.
    runs: Range<u64>,
    next: u64,
    has_header: bool,
    asked: String,
    unfinished: Unfinished,
    form: Form,
    noted: Instant,
}

impl Sink {
    /// Begins or continues with the runs of a table. `is_first`: these begin the whole. `asked`: the request, which is
    /// compared with that of an earlier begin. `warn` is called with damage that was found.
    ///
    /// # Errors
    /// Why nothing is written, in words.
    pub fn begin(
        table: &SweepTable,
        out: &Path,
        (runs, is_first): (Range<u64>, bool),
        asked: String,
        before: Before,
        warn: &mut dyn FnMut(&str),
    ) -> Result<Sink, String> {
        let told = |what: &str, error: io::Error| format!("cannot {what} {}: {error}", out.display());
        let dataset = is_dataset(out);
        if dataset && out.exists() && !out.is_dir() {
            return Err(format!("{} is a file, and a name without ending is that of a folder of files", out.display()));
        }
        // The lock of a dataset lies inside.
        let locked = if dataset { out.join(ABOUT) } else { out.to_path_buf() };
        project::make_folder_of(&locked).map_err(|error| told("write", error))?;
        let unfinished = Unfinished::claim(&locked)?;
        let rows = if dataset { out.to_path_buf() } else { rows_of(out) };
        let earlier = unfinished.before().map(str::to_string);
        let is_same = earlier.as_deref().is_some_and(|earlier| earlier == asked.trim_end());
        match (before, &earlier) {
            (Before::Continue, Some(earlier)) if !is_same => {
                let both = (earlier.as_str(), asked.as_str());
                return Err(begun_otherwise(out, "other settings or another text", both, "remove it"));
            }
            (Before::Continue, None) if locked.exists() => {
                return Err(format!("{} is complete or was not made by a sweep: nothing to resume", out.display()));
            }
            (Before::Nothing | Before::Replace, Some(_))
                if rows.exists() && !(before == Before::Replace && is_same) =>
            {
                return Err(format!(
                    "{} holds a sweep that is not finished; go on with --resume, or remove it",
                    out.display()
                ));
            }
            _ => {}
        }
        let resumed = before == Before::Continue && is_same;
        let header = table.header(is_first);
        let empty = Form::Dataset { each: rows_a_file(table.total()), rows: Vec::new() };
        let next = runs.start;
        let mut sink = Sink {
            out: out.into(),
            runs,
            next,
            has_header: is_first,
            asked,
            unfinished,
            form: empty,
            noted: Instant::now(),
        };
        if dataset {
            sink.begin_dataset(resumed).map_err(|error| told("write", error))?;
            return Ok(sink);
        }
        if resumed {
            let (first, dice) = (sink.runs.start, table.dice());
            let fits = |k: u64, row: &str| table.is_row(first + k, row, &dice);
            let sound = sink.unfinished.sound(&rows, &header, &fits).map_err(|error| told("read", error))?;
            sink.next = first + sound.mark.rows;
            if let Some(fault) = sound.fault {
                warn(&format!(
                    "{fault} of {} is missing or not as it was written: rows from {} on are computed again\n",
                    rows.display(),
                    sink.next
                ));
            }
            if sound.mark.rows > 0 {
                let file = OpenOptions::new().append(true).open(&rows).map_err(|error| told("write", error))?;
                sink.form = Form::Table { writer: BufWriter::new(file), mark: sound.mark };
                return Ok(sink);
            }
        }
        let mut begin = || {
            sink.unfinished.begin(&sink.asked)?;
            let mut writer = BufWriter::new(File::create(&rows)?);
            writer.write_all(&header)?;
            let mark = Mark::after(&header);
            sink.form = Form::Table { writer, mark };
            Ok(())
        };
        begin().map_err(|error| told("write", error))?;
        Ok(sink)
    }

    /// Finds the first file that is missing, or removes those of an older dataset.
    fn begin_dataset(&mut self, resumed: bool) -> io::Result<()> {
        let Form::Dataset { each, .. } = self.form else { return Ok(()) };
        if resumed {
            // A file has its name once it is whole.
            while self.next < self.runs.end && part(&self.out, self.next).exists() {
                self.next = (self.next + each).min(self.runs.end);
            }
            return Ok(());
        }
        for found in fs::read_dir(&self.out)? {
            let path = found?.path();
            let name = name_of(&path);
            if (name.starts_with("part-") && name.ends_with(".parquet")) || name == ABOUT {
                fs::remove_file(path)?;
            }
        }
        let asked = self.asked.clone();
        self.unfinished.begin(&asked)
    }

    /// The run whose row comes next.
    pub fn next(&self) -> u64 {
        self.next
    }

    /// The file with the rows so far.
    pub fn rows(&self) -> PathBuf {
        if is_dataset(&self.out) { self.out.clone() } else { rows_of(&self.out) }
    }

    /// Appends the row of the next run. Returns whether some time has passed since it last returned so.
    pub fn row(&mut self, table: &SweepTable, row: &[u8]) -> io::Result<bool> {
        self.next += 1;
        let is_late = self.noted.elapsed() > Duration::from_millis(200);
        match &mut self.form {
            Form::Table { writer, mark } => {
                writer.write_all(row)?;
                *mark = mark.and(row);
                if is_late {
                    writer.flush()?;
                    self.unfinished.note(*mark)?;
                }
            }
            Form::Dataset { each, rows } => {
                rows.extend_from_slice(row);
                if self.next.is_multiple_of(*each) || self.next == self.runs.end {
                    let first = (self.next - 1) / *each * *each;
                    write_part(table, &self.out, first, rows)?;
                    rows.clear();
                }
            }
        }
        if is_late {
            self.noted = Instant::now();
        }
        Ok(is_late)
    }

    /// Takes the next file of a dataset, which another process has written with this hash.
    ///
    /// # Errors
    /// If it is not there as it was written, in words.
    pub fn adopt(&mut self, expected: &str) -> Result<(), String> {
        let Form::Dataset { each, .. } = self.form else {
            return Err(format!("{} is no dataset, whose files others may write", self.out.display()));
        };
        let path = part(&self.out, self.next);
        let bytes = fs::read(&path).map_err(|error| {
            format!(
                "a worker has written {}, which is not here ({error}): it needs a folder that all machines see under one name",
                path.display()
            )
        })?;
        if hash(&bytes) != expected {
            return Err(format!("{} is not as a worker has written it", path.display()));
        }
        self.next = (self.next + each).min(self.runs.end);
        Ok(())
    }

    /// Keeps what has come, for a later begin.
    pub fn leave(mut self) -> io::Result<()> {
        match &mut self.form {
            Form::Table { writer, mark } => {
                writer.flush()?;
                self.unfinished.note(*mark)
            }
            Form::Dataset { .. } => Ok(()),
        }
    }

    /// After the last row: gives the table its name, and reads it once.
    ///
    /// # Errors
    /// What cannot be read or written, in words.
    pub fn finish(mut self, table: &SweepTable) -> Result<Finished, String> {
        assert_eq!(self.next, self.runs.end, "not all rows have come");
        let told = |what: &str, error: io::Error| format!("cannot {what} {}: {error}", self.out.display());
        let beside = statistics_of(&self.out);
        let about = |error: io::Error| format!("cannot write {}: {error}", beside.display());
        let mut statistics = match table.request.keep.statistics() {
            true => {
                let (part, file) = Part::begin(&beside).map_err(about)?;
                Some((part, Statistics::begin(table, &self.asked, file).map_err(about)?))
            }
            false => None,
        };
        if let Form::Table { writer, .. } = &mut self.form {
            writer.flush().map_err(|error| told("write", error))?;
            writer.get_ref().sync_all().map_err(|error| told("write", error))?;
        }
        let rows = rows_of(&self.out);
        if let (false, Some((_, statistics))) = (table.request.keep.rows(), &mut statistics) {
            let blocks = File::open(&rows).map_err(|error| told("read", error))?;
            for line in BufReader::with_capacity(1 << 18, blocks).lines() {
                line.and_then(|line| statistics.block(&line)).map_err(|error| told("read", error))?;
            }
        }
        let mut also = |cells: &csv::StringRecord| match &mut statistics {
            Some((_, statistics)) => statistics.row(cells),
            None => Ok(()),
        };
        let summary = match &mut self.form {
            Form::Table { .. } if !table.request.keep.rows() => None,
            Form::Table { .. } => {
                let summary = table.summary(&rows, self.has_header, &mut also).map_err(|error| told("read", error))?;
                if rows != self.out {
                    convert(table, &rows, self.has_header, &self.out).map_err(|error| told("write", error))?;
                }
                Some(summary)
            }
            Form::Dataset { each, .. } => {
                let each = *each;
                let mut summary = table.no_summary();
                for first in (0..self.runs.end).step_by(each as usize) {
                    let path = part(&self.out, first);
                    let bytes = fs::read(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
                    let mut failed = Ok(());
                    parquet::rows(bytes, &mut |cells| {
                        summary.see(cells);
                        if failed.is_ok() {
                            failed = also(cells);
                        }
                    })
                    .map_err(|error| format!("cannot read {}: {error}", path.display()))?;
                    failed.map_err(about)?;
                }
                let object = json!({
                    "asked": self.asked.lines().collect::<Vec<_>>(),
                    "runs": self.runs.end,
                    "rows a file": each,
                    "columns": table.kinds().into_iter().map(|(title, _)| title).collect::<Vec<_>>(),
                });
                let object = format!("{object:#}\n");
                project::write(&self.out.join(ABOUT), object.as_bytes()).map_err(|error| told("write", error))?;
                Some(summary)
            }
        };
        let mut words = String::new();
        if let Some((part, statistics)) = statistics {
            let file;
            (file, words) = statistics.end().map_err(about)?;
            part.end(file).map_err(about)?;
        }
        if summary.is_none() {
            // The blocks have done their work.
            fs::remove_file(&rows).map_err(|error| told("write", error))?;
        }
        self.unfinished.finish();
        Ok(summary.map_or(Finished::Statistics(words), Finished::Rows))
    }
}

/// Converts the rows to a Parquet file, after which they are no longer needed.
fn convert(table: &SweepTable, rows: &Path, has_header: bool, out: &Path) -> io::Result<()> {
    let (part, mut file) = Part::begin(out)?;
    parquet::from_csv(File::open(rows)?, has_header, &table.kinds(), &mut file)?;
    part.end(file)?;
    fs::remove_file(rows)
}

#[test]
fn files_of_a_dataset_are_cut_by_the_number_of_runs() {
    assert_eq!(
        [1, 256, 1 << 20, (1 << 20) + 1, 10_000_000, 1 << 28, 1 << 40].map(rows_a_file),
        [256, 256, 256, 512, 4096, 65_536, 65_536]
    );
}
