//! Resumable tables: exclusive write access, the request, and which rows are intact.
//!
//! In: the path of a table, the request of a sweep, and its rows as they are appended. Out: exclusive write access
//! across processes, and where to resume after an interruption. The writing process locks a file beside the table,
//! `.NAME.unfinished`, with the request, an empty line, and checkpoints: rows, bytes and a hash of all bytes so far.
//! The operating system releases the lock however the process ends. Knows nothing of the meaning of rows.

use crate::compile::Loaded;
use runtime::record::claim::open_alone;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// An FNV-1a hash.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Hash(u64);

impl Hash {
    /// The hash of no bytes.
    pub const EMPTY: Hash = Hash(0xcbf2_9ce4_8422_2325);

    /// The hash after these further bytes.
    pub fn and(self, bytes: &[u8]) -> Hash {
        Hash(bytes.iter().fold(self.0, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)))
    }

    /// The hash of these numbers, by their bits.
    pub fn of_numbers<'a>(numbers: impl IntoIterator<Item = &'a f64>) -> Hash {
        numbers.into_iter().fold(Hash::EMPTY, |hash, number| hash.and(&number.to_bits().to_le_bytes()))
    }

    /// The hash of all texts of files, library included; options are none.
    pub fn of_texts(loaded: &Loaded) -> Hash {
        let texts = loaded.files.0.iter().filter(|file| !file.name.starts_with("--"));
        texts.fold(Hash::EMPTY, |hash, file| hash.and(file.text.as_bytes()))
    }
}

impl std::fmt::LowerHex for Hash {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        std::fmt::LowerHex::fmt(&self.0, f)
    }
}

/// A checkpoint of a table: number of rows, number of bytes including the header, and their hash.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Mark {
    /// Rows without the header.
    pub rows: u64,
    /// Bytes with the header.
    pub bytes: u64,
    /// Hash of these bytes.
    pub hash: Hash,
}

impl Mark {
    /// After the header.
    pub fn after(header: &[u8]) -> Mark {
        Mark { rows: 0, bytes: header.len() as u64, hash: Hash::EMPTY.and(header) }
    }

    /// After one more row, with its end of line.
    pub fn and(self, row: &[u8]) -> Mark {
        Mark { rows: self.rows + 1, bytes: self.bytes + row.len() as u64, hash: self.hash.and(row) }
    }
}

/// Says that a table was begun with another request: `earlier`, and now `asked`. `other` names what differs, `remedy` what
/// to do instead of giving the same.
pub fn begun_otherwise(table: &Path, other: &str, (earlier, asked): (&str, &str), remedy: &str) -> String {
    let indented = |text: &str| text.lines().map(|line| format!("  {line}\n")).collect::<String>();
    let (table, earlier, asked) = (table.display(), indented(earlier), indented(asked));
    format!("{table} was begun with {other}:\n{earlier}now:\n{asked}give the same, or {remedy}")
}

/// Exclusive write access to a table.
pub struct Unfinished {
    path: PathBuf,
    file: File,
    /// The request of an earlier writer; empty if there was none.
    asked: String,
    marks: Vec<Mark>,
    /// Whether the lock file stays when this is dropped, so that the table can be resumed.
    begun: bool,
}

/// Where a table can be resumed.
#[derive(Debug)]
pub struct Sound {
    /// The end of the intact part; the rest has been cut off.
    pub mark: Mark,
    /// A description of damage found after it, if it is more than a row that was being written.
    pub fault: Option<String>,
}

impl Unfinished {
    /// Acquires exclusive write access to a table.
    ///
    /// # Errors
    /// If another process has it, or why the lock file cannot be used.
    pub fn claim(table: &Path) -> Result<Unfinished, String> {
        let name = table.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let path = table.with_file_name(format!(".{name}.unfinished"));
        let about = |error: io::Error| format!("cannot write {}: {error}", path.display());
        let Some(file) = open_alone(&path).map_err(about)? else {
            return Err(format!(
                "another process writes {}: wait until it has ended, or give this one another --out",
                table.display()
            ));
        };
        let mut text = String::new();
        // A file that is not text was not written here, and cannot be resumed.
        let _ = (&file).read_to_string(&mut text);
        let (asked, marks) = text.split_once("\n\n").unwrap_or((&text, ""));
        let marks = marks.lines().map_while(mark).collect();
        let asked = asked.trim_end().to_string();
        Ok(Unfinished { path, file, begun: !asked.is_empty(), asked, marks })
    }

    /// The request of an earlier writer that did not finish.
    pub fn before(&self) -> Option<&str> {
        (!self.asked.is_empty()).then_some(self.asked.as_str())
    }

    /// Starts over, with an empty table.
    ///
    /// # Errors
    /// Those of the file.
    pub fn begin(&mut self, asked: &str) -> io::Result<()> {
        (self.begun, self.asked) = (true, asked.trim_end().into());
        self.marks.clear();
        self.file.set_len(0)?;
        self.file.seek(SeekFrom::Start(0))?;
        write!(self.file, "{}\n\n", self.asked)
    }

    /// Appends a checkpoint.
    ///
    /// # Errors
    /// Those of the file.
    pub fn note(&mut self, mark: Mark) -> io::Result<()> {
        let Mark { rows, bytes, hash } = mark;
        // One write call per line: a killed process leaves complete lines, or a last one without a line end.
        self.file.seek(SeekFrom::End(0))?;
        self.file.write_all(format!("{rows} {bytes} {hash:016x}\n").as_bytes())
    }

    /// Finds the intact part of a table, and cuts off the rest. `fits` returns whether a line can be that row.
    ///
    /// # Errors
    /// Those of the table.
    pub fn sound(&mut self, table: &Path, header: &[u8], fits: &dyn Fn(u64, &str) -> bool) -> io::Result<Sound> {
        let nothing = Mark { rows: 0, bytes: 0, hash: Hash::EMPTY };
        let open = OpenOptions::new().read(true).write(true).open(table);
        let Ok(file) = open else { return Ok(Sound { mark: nothing, fault: None }) };
        let mut reader = BufReader::with_capacity(1 << 20, file);
        let mut begin = vec![0; header.len()];
        if reader.read_exact(&mut begin).is_err() || begin != header {
            let fault = (reader.get_ref().metadata()?.len() >= header.len() as u64).then(|| "its header".to_string());
            return Ok(Sound { mark: nothing, fault });
        }
        let start = Mark::after(header);
        let (mut at, mut good, mut fault, mut line) = (start, start, None, Vec::new());
        let mut marks = self.marks.iter().filter(|mark| mark.bytes > start.bytes).peekable();
        loop {
            line.clear();
            reader.read_until(b'\n', &mut line)?;
            // The row that was being written has no line end.
            let Some((b'\n', row)) = line.split_last() else { break };
            if !std::str::from_utf8(row).is_ok_and(|row| fits(at.rows, row)) {
                fault = Some(format!("row {}", at.rows));
                break;
            }
            at = at.and(&line);
            match marks.peek() {
                Some(mark) if **mark == at => good = *marks.next().expect("it was looked at"),
                Some(mark) if mark.bytes <= at.bytes => {
                    fault = Some(format!("one of the rows {} to {}", good.rows, at.rows.saturating_sub(1)));
                    break;
                }
                _ => {}
            }
        }
        // Rows after the last checkpoint are accepted by their form alone, unless one of them is damaged.
        let mark = if fault.is_some() { good } else { at };
        let file = reader.into_inner();
        file.set_len(mark.bytes)?;
        self.marks.retain(|known| known.bytes <= mark.bytes);
        // Checkpoints of the part that was cut off are invalid.
        let (asked, marks) = (self.asked.clone(), std::mem::take(&mut self.marks));
        self.begin(&asked)?;
        marks.iter().try_for_each(|mark| self.note(*mark))?;
        self.marks = marks;
        Ok(Sound { mark, fault })
    }

    /// The table is complete.
    pub fn finish(mut self) {
        self.begun = false;
    }
}

/// If the table was never begun or is finished, removes the lock file before the lock is released.
impl Drop for Unfinished {
    fn drop(&mut self) {
        if !self.begun {
            let _ = fs::remove_file(&self.path);
        }
        // A process that was forked meanwhile, such as one of a pool, has the same open file: closing ours would leave it
        // locked.
        let _ = self.file.unlock();
    }
}

/// Parses `rows bytes hash`.
fn mark(line: &str) -> Option<Mark> {
    let mut words = line.split(' ');
    let (rows, bytes, hash) = (words.next()?, words.next()?, words.next()?);
    let hash = Hash(u64::from_str_radix(hash, 16).ok().filter(|_| hash.len() == 16)?);
    Some(Mark { rows: rows.parse().ok()?, bytes: bytes.parse().ok()?, hash })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &[u8] = b"run,x\n";

    fn row(k: u64) -> String {
        format!("{k},{}\n", k * k)
    }

    fn fits(k: u64, row: &str) -> bool {
        row.split_once(',').is_some_and(|(run, x)| run == k.to_string() && x.parse::<u64>().is_ok())
    }

    /// A table of 100 rows that was interrupted, with checkpoints at 40 and 80.
    fn interrupted(table: &Path) -> Vec<u8> {
        let mut unfinished = Unfinished::claim(table).unwrap();
        unfinished.begin("so many\nof that\n").unwrap();
        let mut bytes = HEADER.to_vec();
        for k in 0..100 {
            bytes.extend(row(k).as_bytes());
            if k == 39 || k == 79 {
                let hash = Hash::EMPTY.and(&bytes);
                unfinished.note(Mark { rows: k + 1, bytes: bytes.len() as u64, hash }).unwrap();
            }
        }
        fs::write(table, &bytes).unwrap();
        bytes
    }

    #[test]
    fn one_process_writes_a_table_and_a_finished_one_leaves_no_lock_file() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("a.csv");
        let marker = folder.path().join(".a.csv.unfinished");
        let first = Unfinished::claim(&table).unwrap();
        assert_eq!(first.before(), None);
        let why = Unfinished::claim(&table).err().unwrap();
        assert!(why.starts_with("another process writes ") && why.contains("a.csv: wait"), "{why}");
        drop(first);
        assert!(!marker.exists(), "it had not begun");
        interrupted(&table);
        let again = Unfinished::claim(&table).unwrap();
        assert_eq!(again.before(), Some("so many\nof that"));
        again.finish();
        assert!(!marker.exists());
        assert_eq!(Unfinished::claim(&table).unwrap().before(), None);
    }

    /// Any byte changed, removed or added, any row removed or doubled, any truncation: the part that is resumed is a
    /// prefix of what was written, unless the change lies after the last checkpoint and leaves a row of valid form.
    #[test]
    fn the_resumed_part_is_a_prefix_of_what_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("a.csv");
        let whole = interrupted(&table);
        let rows: Vec<String> = (0..100).map(row).collect();
        let last_mark = HEADER.len() + rows[..80].concat().len();
        let mut changes: Vec<Vec<u8>> = Vec::new();
        for at in (0..whole.len()).step_by(3) {
            let mut other = whole.clone();
            other[at] = if other[at] == b'1' { b'2' } else { b'1' };
            changes.push(other);
            changes.push([&whole[..at], &whole[at + 1..]].concat());
            changes.push([&whole[..at], b"7", &whole[at..]].concat());
            changes.push(whole[..at].to_vec());
        }
        for k in 0..100 {
            let without = [&rows[..k], &rows[k + 1..]].concat();
            let doubled = [&rows[..=k], &rows[k..]].concat();
            for rows in [without, doubled] {
                changes.push([HEADER, rows.concat().as_bytes()].concat());
            }
        }
        let mut noticed = 0;
        for change in &changes {
            interrupted(&table);
            fs::write(&table, change).unwrap();
            let sound = Unfinished::claim(&table).unwrap().sound(&table, HEADER, &fits).unwrap();
            noticed += usize::from(sound.fault.is_some());
            let kept = fs::read(&table).unwrap();
            if sound.mark.bytes == 0 {
                continue;
            }
            assert_eq!(kept.len() as u64, sound.mark.bytes);
            assert_eq!(kept.iter().filter(|byte| **byte == b'\n').count() as u64, sound.mark.rows + 1);
            let until = kept.len().min(last_mark);
            assert_eq!(kept[..until], whole[..until], "{:?}", sound.fault);
            // Resuming twice gives the same result.
            let again = Unfinished::claim(&table).unwrap().sound(&table, HEADER, &fits).unwrap();
            assert_eq!((again.mark, again.fault), (sound.mark, None));
        }
        assert!(noticed * 2 > changes.len(), "{noticed} of {} were noticed", changes.len());
    }
}
