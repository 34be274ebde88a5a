//! A sweep that was read from the bytes of its plan, for programs that embed the command: its units, and the table to
//! which their rows are appended.
//!
//! In: bytes of plans and units, as other processes have made them. Out: bytes of units; tables and datasets, in the order
//! of the runs, which the command resumes and which resume its own.

use super::request::{self, Fault};
use super::sink::{self, Before, Sink};
use super::version::Unusable;
use super::{SweepTable, plan, unit};
use crate::compile::Loaded;
use crate::parquet::Holds;
use grammar::diagnostic::Diagnostic;
use std::io;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// A sweep, compiled.
pub struct Sent {
    hash: String,
    loaded: Loaded,
    table: SweepTable,
}

impl Sent {
    /// Compiles a plan.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn read(bytes: &[u8], interpret: bool) -> Result<Sent, Fault> {
        let about = |why| match why {
            Unusable::NotWhole => Fault::Failed(format!("the plan {why}")),
            Unusable::Version(..) | Unusable::Library => Fault::Version(why),
        };
        let plan::Plan { mut request, text, hash } = plan::read(bytes).map_err(about)?;
        request.interpret = interpret;
        let (mut loaded, sources) = text.load();
        let errors: Vec<Diagnostic> = loaded.diagnostics.iter().filter(|found| found.is_error()).cloned().collect();
        if !errors.is_empty() {
            return Err(Fault::Text(crate::report::full(&loaded.files.0, &errors, false), errors));
        }
        let table = request::table(request, &mut loaded, &sources, false)?;
        Ok(Sent { hash, loaded, table })
    }

    /// Number of its runs.
    pub fn total(&self) -> u64 {
        self.table.total()
    }

    /// Number of what units count: runs, or blocks of runs if only statistics are kept.
    pub fn items(&self) -> u64 {
        self.table.items()
    }

    /// How many runs the first of them have.
    pub fn runs(&self, items: u64) -> u64 {
        self.table.cut().map_or(items, |cut| cut.runs(0..items).end)
    }

    /// The title of each column and the type of its values: `numbers`, `integers`, `booleans` or `words`.
    pub fn columns(&self) -> Vec<(String, &'static str)> {
        let word = |holds| match holds {
            Holds::Numbers => "numbers",
            Holds::Integers => "integers",
            Holds::Booleans => "booleans",
            Holds::Words => "words",
        };
        self.table.kinds().into_iter().map(|(title, holds)| (title, word(holds))).collect()
    }

    /// Makes these rows, or blocks, on this thread: the bytes of a unit. None if `stopped` was set meanwhile.
    pub fn unit(&self, runs: Range<u64>, stopped: &AtomicBool) -> Option<Vec<u8>> {
        let head = unit::Head { plan: self.hash.clone(), runs: runs.clone() };
        let write = || -> io::Result<Option<Vec<u8>>> {
            let mut writer = unit::Writer::begin(Vec::new(), &head)?;
            let size = runs.end - runs.start;
            let put = &mut |_, row: &[u8]| writer.row(row);
            let made = self.table.computed(runs, 1, &self.table.dice(), stopped, put)?;
            if made == size { writer.end().map(Some) } else { Ok(None) }
        };
        write().expect("writing to memory does not fail")
    }

    /// Rows of a file of a dataset.
    pub fn rows_a_file(&self) -> u64 {
        sink::rows_a_file(self.total())
    }

    /// Makes the file of a dataset that begins with this run, on this thread: the hash of its bytes. None if `stopped` was
    /// set meanwhile.
    ///
    /// # Errors
    /// Why it cannot be written, in words.
    pub fn file(&self, folder: &Path, first: u64, stopped: &AtomicBool) -> Result<Option<String>, String> {
        let runs = first..(first + self.rows_a_file()).min(self.total());
        let (size, mut rows) = (runs.end - runs.start, Vec::new());
        let put = &mut |_, row: &[u8]| {
            rows.extend_from_slice(row);
            Ok(())
        };
        let made = self.table.rows(runs, 1, &self.table.dice(), stopped, put).expect("memory does not fail");
        if made < size {
            return Ok(None);
        }
        let told = |error| format!("cannot write into {}: {error}", folder.display());
        sink::write_part(&self.table, folder, first, &rows).map(Some).map_err(told)
    }

    /// Begins a table or a dataset, or goes on with it. `warn` is called with damage that was found.
    ///
    /// # Errors
    /// Why nothing is written, in words.
    pub fn begin(&self, out: &Path, resume: bool, warn: &mut dyn FnMut(&str)) -> Result<Rows, String> {
        let before = if resume { Before::Continue } else { Before::Nothing };
        let runs = 0..self.items();
        let asked = self.table.asked(&self.loaded, &runs);
        // An interrupted call may have left nothing yet.
        let sink = Sink::begin(&self.table, out, (runs, true), asked, before, warn)?;
        Ok(Rows { sink })
    }
}

/// Rows, or blocks, that are being appended.
pub struct Rows {
    sink: Sink,
}

impl Rows {
    /// The run whose row comes next, or the number of the next block.
    pub fn next(&self) -> u64 {
        self.sink.next()
    }

    /// Appends the rows of a unit that begins at the next run or before it: those that are there already are left out.
    ///
    /// # Errors
    /// If it is damaged, or why it cannot be written. Nothing of a damaged unit is written.
    pub fn take(&mut self, sweep: &Sent, bytes: &[u8]) -> Result<(), String> {
        let fault = |fault: unit::Fault| format!("a unit is not as it was made: {fault:?}");
        let (runs, _) = unit::read(bytes, &sweep.hash, &mut |_, _| Ok(())).map_err(fault)?;
        if runs.start > self.next() {
            return Err(format!("a unit begins at run {}, and run {} comes next", runs.start, self.next()));
        }
        let put = &mut |run, row: &[u8]| match run == self.sink.next() {
            true => self.sink.row(&sweep.table, row).map(|_| ()),
            false => Ok(()),
        };
        unit::read(bytes, &sweep.hash, put).map(|_| ()).map_err(fault)
    }

    /// Takes a file of a dataset that [`Sent::file`] has written elsewhere.
    ///
    /// # Errors
    /// If it is not there as it was written, in words.
    pub fn adopt(&mut self, hash: &str) -> Result<(), String> {
        self.sink.adopt(hash)
    }

    /// Keeps what has come; the table can be resumed.
    ///
    /// # Errors
    /// Why it cannot be written, in words.
    pub fn leave(self) -> Result<(), String> {
        self.sink.leave().map_err(|error| error.to_string())
    }

    /// After the last row: gives the table its name. Returns its summary in words.
    ///
    /// # Errors
    /// What cannot be read or written, in words.
    pub fn finish(self, sweep: &Sent) -> Result<String, String> {
        Ok(self.sink.finish(&sweep.table)?.words(&sweep.table))
    }
}
