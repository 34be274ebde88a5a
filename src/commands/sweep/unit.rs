//! Units of a sweep: files with the rows of some of its runs, made anywhere and joined to the table of the whole.
//!
//! In: rows in their order. Out: a file that names its plan and its runs in the first line, and their hash in the last,
//! so that a file that was cut off or changed, or belongs to another sweep, is recognised. Knows nothing of the meaning
//! of rows but that each begins with the number of its run.

use crate::unfinished::Hash;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

const MAGIC: &str = "fric unit 1";

/// The first line of a unit.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Head {
    /// Hash of the plan.
    pub plan: String,
    /// Its runs.
    pub runs: Range<u64>,
}

impl Head {
    fn line(&self) -> String {
        format!("{MAGIC}, runs {}..{} of plan {}\n", self.runs.start, self.runs.end, self.plan)
    }

    /// Parses the first line.
    fn read(line: &str) -> Option<Head> {
        let (runs, plan) = line.strip_prefix(MAGIC)?.strip_prefix(", runs ")?.split_once(" of plan ")?;
        let head = Head { plan: plan.strip_suffix('\n')?.into(), runs: range(runs)? };
        (head.line() == line).then_some(head)
    }
}

/// Parses `10..20`.
fn range(text: &str) -> Option<Range<u64>> {
    let (first, last) = text.split_once("..")?;
    let range = first.trim().parse().ok()?..last.trim().parse().ok()?;
    (range.start <= range.end).then_some(range)
}

/// Writes a unit.
pub struct Writer<W: Write> {
    to: W,
    rows: u64,
    hash: Hash,
}

impl<W: Write> Writer<W> {
    pub fn begin(mut to: W, head: &Head) -> io::Result<Writer<W>> {
        let line = head.line();
        to.write_all(line.as_bytes())?;
        Ok(Writer { to, rows: 0, hash: Hash::EMPTY.and(line.as_bytes()) })
    }

    pub fn row(&mut self, row: &[u8]) -> io::Result<()> {
        (self.rows, self.hash) = (self.rows + 1, self.hash.and(row));
        self.to.write_all(row)
    }

    pub fn end(mut self) -> io::Result<W> {
        let line = last_line(self.rows, self.hash);
        self.to.write_all(line.as_bytes())?;
        self.to.flush()?;
        Ok(self.to)
    }
}

fn last_line(rows: u64, hash: Hash) -> String {
    format!("end, rows {rows}, hash {hash:016x}\n")
}

/// Writes a unit as a file, by renaming: under its name it is whole. None if `rows` stopped before the end.
pub fn write(
    path: &Path,
    head: &Head,
    rows: impl FnOnce(&mut dyn FnMut(&[u8]) -> io::Result<()>) -> io::Result<bool>,
) -> io::Result<Option<()>> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    // Another process may make the same unit, also on another machine that writes into this folder.
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |time| time.as_nanos());
    let neighbour = path.with_file_name(format!(".{name}.{}.{now}", std::process::id()));
    let written = || {
        let file = File::options().write(true).create_new(true).open(&neighbour)?;
        let mut writer = Writer::begin(BufWriter::with_capacity(1 << 18, file), head)?;
        if !rows(&mut |row| writer.row(row))? {
            return Ok(None);
        }
        writer.end()?.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        std::fs::rename(&neighbour, path).map(Some)
    };
    let written = written();
    if !matches!(written, Ok(Some(()))) {
        let _ = std::fs::remove_file(&neighbour);
    }
    written
}

/// What is wrong with a unit.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Fault {
    /// It has no first line of a unit.
    NoUnit,
    /// It belongs to another plan.
    Foreign(Head),
    /// It ends too early, after so many rows.
    Cut(Head, u64),
    /// Its rows are not those that were written.
    Changed(Head),
    /// It cannot be read.
    Unreadable(String),
}

impl Fault {
    /// In words, with the remedy. `path`: of the unit; `plan`: of the plan, which a shell would need to make it again.
    pub fn words(&self, path: &Path, plan: &Path) -> String {
        let (path, plan) = (path.display(), plan.display());
        let again = |head: &Head| {
            let Range { start, end } = head.runs;
            format!("remove it and make it again: fric sweep --unit {start}..{end} {plan} --out {path}")
        };
        match self {
            Fault::NoUnit => format!("{path} is no unit of a sweep: leave it out, or make it again with --unit"),
            Fault::Foreign(head) => format!(
                "{path} is a unit of another plan, {}…, and {plan} is not that: leave it out",
                head.plan.get(..12).unwrap_or(&head.plan)
            ),
            Fault::Cut(head, rows) => {
                let all = head.runs.end - head.runs.start;
                format!("{path} ends after {rows} of its {all} rows; {}", again(head))
            }
            Fault::Changed(head) => {
                format!("{path} is not as it was written: its rows do not have its hash; {}", again(head))
            }
            Fault::Unreadable(why) => format!("cannot read {path}: {why}"),
        }
    }
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Fault {
        Fault::Unreadable(error.to_string())
    }
}

/// Reads a unit of this plan to its end and passes each run and its row, with the line end. Only a unit that returns
/// without a fault is whole. Returns its runs and its hash.
///
/// # Errors
/// What is wrong with it; an error of `take`.
pub fn read(
    from: impl BufRead,
    plan: &str,
    take: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>,
) -> Result<(Range<u64>, Hash), Fault> {
    let mut from = from;
    let mut line = Vec::new();
    // A file of another kind may have no line ends: a first line is short.
    io::Read::take(&mut from, 512).read_until(b'\n', &mut line)?;
    let head = std::str::from_utf8(&line).ok().and_then(Head::read).ok_or(Fault::NoUnit)?;
    if head.plan != plan {
        return Err(Fault::Foreign(head));
    }
    let mut hash = Hash::EMPTY.and(&line);
    for run in head.runs.clone() {
        line.clear();
        from.read_until(b'\n', &mut line)?;
        if line.last() != Some(&b'\n') {
            return Err(Fault::Cut(head.clone(), run - head.runs.start));
        }
        if line.split(|byte| *byte == b',').next() != Some(run.to_string().as_bytes()) {
            return Err(Fault::Changed(head));
        }
        hash = hash.and(&line);
        take(run, &line)?;
    }
    line.clear();
    let rows = head.runs.end - head.runs.start;
    from.read_until(b'\n', &mut line)?;
    match line == last_line(rows, hash).as_bytes() {
        true if from.fill_buf()?.is_empty() => Ok((head.runs, hash)),
        false if line.last() != Some(&b'\n') => Err(Fault::Cut(head, rows)),
        _ => Err(Fault::Changed(head)),
    }
}

/// Reads a unit from a file.
///
/// # Errors
/// Those of [`read`].
pub fn read_file(
    path: &Path,
    plan: &str,
    take: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>,
) -> Result<(Range<u64>, Hash), Fault> {
    read(BufReader::with_capacity(1 << 18, File::open(path)?), plan, take)
}

/// A unit among others.
pub struct Found {
    pub path: PathBuf,
    pub runs: Range<u64>,
    pub hash: Hash,
}

/// What of a table its units cover.
#[derive(PartialEq, Eq, Debug)]
pub struct Cover {
    /// The units that give rows, in order: their number, and the runs that are taken from them.
    pub taken: Vec<(usize, Range<u64>)>,
    /// Runs that are in none.
    pub missing: Vec<Range<u64>>,
    /// Numbers of two units that contain the same runs with different rows, if there are such: one of them is wrong.
    pub at_odds: Option<(usize, usize)>,
}

/// Chooses for each run one of the units that hold it.
pub fn cover(units: &[Found], total: u64) -> Cover {
    let mut order: Vec<usize> = (0..units.len()).filter(|k| !units[*k].runs.is_empty()).collect();
    order.sort_by_key(|k| (units[*k].runs.start, std::cmp::Reverse(units[*k].runs.end)));
    let at_odds = order.windows(2).map(|pair| (pair[0], pair[1]));
    let at_odds =
        at_odds.into_iter().find(|(a, b)| units[*a].runs == units[*b].runs && units[*a].hash != units[*b].hash);
    let (mut taken, mut missing, mut reached) = (Vec::new(), Vec::new(), 0);
    for k in order {
        let Range { start, end } = units[k].runs;
        if start > reached {
            missing.push(reached..start);
        }
        if end > reached {
            taken.push((k, reached.max(start)..end));
            reached = end;
        }
    }
    if reached < total {
        missing.push(reached..total);
    }
    Cover { taken, missing, at_odds }
}

/// The runs of `--unit`: `10..20`, or unit `J/N` of N, from 0/N to N-1/N. `%j` and `%n` stand for the number of this
/// task and for the number of tasks, as a scheduler tells them in `variable`.
///
/// # Errors
/// How to write it.
pub fn runs(text: &str, total: u64, variable: &dyn Fn(&str) -> Option<String>) -> Result<Range<u64>, String> {
    const HOW: &str = "write --unit 0..1000 for these runs, --unit 2/8 for the third of eight units, which are numbered from \
        0, or --unit %j/8 for the number of this task of a Slurm array or an Indexed Job of Kubernetes";
    if let Some(range) = range(text) {
        return match range.end <= total {
            true => Ok(range),
            false => Err(format!(
                "--unit {text}: the plan has {total} runs, from 0 on, and the second number is not in the unit"
            )),
        };
    }
    let (j, n) = text.split_once('/').map(|(j, n)| (j.trim(), n.trim())).ok_or(HOW)?;
    let number = |name: &str| variable(name).and_then(|value| value.trim().parse::<u64>().ok());
    let j = match j {
        "%j" => number("SLURM_ARRAY_TASK_ID").or_else(|| number("JOB_COMPLETION_INDEX")).ok_or(
            "--unit %j/…: neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is a number here: write the number of the unit, \
             from 0 on",
        )?,
        j => j.parse().map_err(|_| HOW)?,
    };
    let n = match n {
        // Part of an array that runs again has another count than the whole.
        "%n" => number("SLURM_ARRAY_TASK_COUNT")
            .filter(|n| number("SLURM_ARRAY_TASK_MIN") == Some(0) && number("SLURM_ARRAY_TASK_MAX") == n.checked_sub(1))
            .ok_or(
                "--unit …/%n: this is no Slurm array from 0 on without gaps: write the number of units, as in %j/64",
            )?,
        n => n.parse().map_err(|_| HOW)?,
    };
    if j >= n {
        return Err(format!("--unit {j}/{n}: the units are numbered from 0/{n} to {}/{n}", n.saturating_sub(1)));
    }
    let part = |i: u64| (u128::from(total) * u128::from(i) / u128::from(n)) as u64;
    Ok(part(j)..part(j + 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit(plan: &str, runs: Range<u64>) -> Vec<u8> {
        let head = Head { plan: plan.into(), runs: runs.clone() };
        let mut writer = Writer::begin(Vec::new(), &head).unwrap();
        runs.for_each(|run| writer.row(format!("{run},{},ok\n", run * run).as_bytes()).unwrap());
        writer.end().unwrap()
    }

    /// Any truncation, any byte changed, removed or added is found. Mutants tried: without the hash of rows, the look after
    /// the last line, the hash of the plan, the number of the row.
    #[test]
    fn only_a_unit_as_it_was_written_is_read() {
        let whole = unit("abc", 7..40);
        let again = |bytes: &[u8]| {
            let mut rows = Vec::new();
            let found = read(bytes, "abc", &mut |run, row| {
                rows.push((run, row.to_vec()));
                Ok(())
            });
            found.map(|(runs, _)| (runs, rows))
        };
        let (runs, rows) = again(&whole).unwrap();
        assert_eq!((runs, rows.len(), rows[3].1.as_slice()), (7..40, 33, b"10,100,ok\n".as_slice()));
        assert_eq!(again(&unit("abc", 7..7)).unwrap().1, []);
        assert!(matches!(again(&unit("abd", 7..40)), Err(Fault::Foreign(_))));
        for at in 0..whole.len() {
            let cut = again(&whole[..at]);
            assert!(matches!(cut, Err(Fault::NoUnit | Fault::Cut(..))), "{at}: {cut:?}");
            let mut changed = whole.clone();
            changed[at] = if changed[at] == b'1' { b'2' } else { b'1' };
            assert!(again(&changed).is_err(), "byte {at} changed");
            assert!(again(&[&whole[..at], &whole[at + 1..]].concat()).is_err(), "byte {at} removed");
            assert!(again(&[&whole[..at], b"7", &whole[at..]].concat()).is_err(), "byte {at} added");
        }
        // Rows of other runs under a hash of their own.
        let mut writer = Writer::begin(Vec::new(), &Head { plan: "abc".into(), runs: 7..8 }).unwrap();
        writer.row(b"8,64,ok\n").unwrap();
        assert!(matches!(again(&writer.end().unwrap()), Err(Fault::Changed(_))));
        assert!(again(&[&whole[..], b"\n"].concat()).is_err() && again(&[&whole[..], &whole[..]].concat()).is_err());
    }

    /// Against the runs one by one, on random units. Mutants tried: `>=` for `>` at a gap, no gap after the last unit, a
    /// unit taken from its own begin.
    #[test]
    fn a_cover_has_each_run_once_or_misses_it() {
        let mut dice = runtime::rng::Chance(1);
        for _ in 0..2000 {
            let total = 1 + dice.below(12);
            let units: Vec<Found> = (0..dice.below(6))
                .map(|_| {
                    let ends = [dice.below(total + 1), dice.below(total + 1)];
                    let runs = ends[0].min(ends[1])..ends[0].max(ends[1]);
                    Found { path: PathBuf::new(), runs, hash: Hash::EMPTY }
                })
                .collect();
            let Cover { taken, missing, at_odds } = cover(&units, total);
            let mut times = vec![0; total as usize];
            for (k, runs) in taken {
                assert!(runs.start >= units[k].runs.start && runs.end == units[k].runs.end && !runs.is_empty());
                runs.for_each(|run| times[run as usize] += 1);
            }
            for run in 0..total {
                let is_held = units.iter().any(|unit| unit.runs.contains(&run));
                let is_missing = missing.iter().filter(|runs| runs.contains(&run)).count();
                assert_eq!((times[run as usize], is_missing), (usize::from(is_held), usize::from(!is_held)));
            }
            assert!(missing.iter().all(|runs| !runs.is_empty()) && at_odds.is_none());
        }
        let unit = |hash| Found { path: PathBuf::new(), runs: 0..3, hash };
        assert_eq!(cover(&[unit(Hash::EMPTY), unit(Hash::EMPTY.and(b"x"))], 3).at_odds, Some((0, 1)));
    }

    #[test]
    fn units_are_named_by_their_runs_or_by_a_task() {
        let slurm = |name: &str| match name {
            "SLURM_ARRAY_TASK_ID" => Some("3".to_string()),
            "SLURM_ARRAY_TASK_COUNT" => Some("4".into()),
            "SLURM_ARRAY_TASK_MIN" => Some("0".into()),
            "SLURM_ARRAY_TASK_MAX" => Some("3".into()),
            _ => None,
        };
        let part = |name: &str| if name.ends_with("MIN") { Some("3".into()) } else { slurm(name) };
        let indexed = |name: &str| (name == "JOB_COMPLETION_INDEX").then(|| "0".to_string());
        assert_eq!(runs("10..20", 100, &|_| None), Ok(10..20));
        assert_eq!(runs("2/8", 100, &|_| None), Ok(25..37));
        assert_eq!(runs("%j/%n", 10, &slurm), Ok(7..10));
        assert_eq!(runs("%j/64", u64::MAX, &indexed).unwrap().start, 0);
        assert!(runs("%j/%n", 10, &part).unwrap_err().contains("%j/64"));
        assert!(runs("%j/%n", 10, &indexed).is_err() && runs("%j/4", 10, &|_| None).unwrap_err().contains("SLURM"));
        for wrong in ["", "3", "8/8", "1/0", "20..10", "0..101", "x/3", "1/x", "-1/3"] {
            assert!(runs(wrong, 100, &|_| None).is_err(), "{wrong}");
        }
        // All units of a plan are its runs, each once.
        for (total, n) in [(1, 1), (10, 3), (3, 10), (1_000_003, 64)] {
            let all: Vec<Range<u64>> = (0..n).map(|j| runs(&format!("{j}/{n}"), total, &|_| None).unwrap()).collect();
            assert!(all.windows(2).all(|pair| pair[0].end == pair[1].start));
            assert_eq!((all[0].start, all[n - 1].end), (0, total));
        }
    }
}
