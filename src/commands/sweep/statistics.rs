//! Statistics of a sweep in place of its rows, or beside them: what becomes of each measure at each point of the grids.
//!
//! In: rows in the order of the runs. Out: blocks of some thousand runs, each a line that another process can make; and
//! from all blocks, or all rows, a file of JSON, in memory that does not grow with the number of runs. The bytes of the
//! file depend neither on who made which block nor on how runs are cut into blocks.

use super::sketch::{LEAF, Sketch};
use super::summary::{aligned, kind};
use super::{ColumnKind, SweepTable, line};
use crate::parquet::Holds;
use crate::quantity::{count, significant};
use crate::vary::Dice;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::ops::Range;

/// Most runs of a block.
const LARGEST_BLOCK: u64 = 1 << 14;
/// Most points of the grids times measures.
const MOST_SKETCHES: u64 = 100_000;
/// Most points of the grids that are printed.
const MOST_LINES: usize = 40;
/// Quantiles in the file, in percent.
const QUANTILES: [u8; 9] = [1, 5, 10, 25, 50, 75, 90, 95, 99];

/// How the runs of a sweep are cut into groups, one for each point of the grids, and these into blocks.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Cut {
    total: u64,
    /// Runs of a group.
    group: u64,
    /// Runs of a block: a power of two of leaves, so that sums are formed in the same tree in one block or in several.
    block: u64,
}

impl Cut {
    fn new(total: u64, group: u64) -> Cut {
        let block = total.div_ceil(4096).next_power_of_two().clamp(LEAF, LARGEST_BLOCK);
        Cut { total, group, block }
    }

    fn blocks_a_group(self) -> u64 {
        self.group.div_ceil(self.block)
    }

    /// Number of blocks.
    pub fn blocks(self) -> u64 {
        self.total / self.group * self.blocks_a_group()
    }

    fn runs_of_one(self, block: u64) -> Range<u64> {
        let (group, within) = (block / self.blocks_a_group(), block % self.blocks_a_group());
        let begin = group * self.group;
        begin + within * self.block..begin + ((within + 1) * self.block).min(self.group)
    }

    /// The runs of these blocks.
    pub fn runs(self, blocks: Range<u64>) -> Range<u64> {
        match blocks.is_empty() {
            true => 0..0,
            false => self.runs_of_one(blocks.start).start..self.runs_of_one(blocks.end - 1).end,
        }
    }

    /// Whether a group ends with this block.
    fn ends_group(self, block: u64) -> bool {
        (block + 1).is_multiple_of(self.blocks_a_group())
    }
}

/// Passes the rows of some runs, each with how many were passed before it; returns how many.
type Rows<'a> = dyn FnMut(Range<u64>, &mut dyn FnMut(u64, &[u8]) -> io::Result<()>) -> io::Result<u64> + 'a;

/// Runs that ended in one way.
struct Ended {
    runs: u64,
    /// The first of these runs, and its status in full.
    first: u64,
    status: String,
}

/// What becomes of the runs of a block, or of a group.
struct Tally {
    runs: u64,
    measures: Vec<Sketch>,
    /// For each verdict how often it holds, and how often it was judged.
    verdicts: Vec<(u64, u64)>,
    /// By the status without its numbers.
    ended: BTreeMap<String, Ended>,
    /// Rows with an outermost value, and for some time those that no longer have one.
    rows: BTreeMap<u64, String>,
}

impl Tally {
    fn new(table: &SweepTable) -> Tally {
        let of = |wanted: &dyn Fn(ColumnKind) -> bool| table.columns.iter().filter(|one| wanted(one.kind)).count();
        Tally {
            runs: 0,
            measures: vec![Sketch::default(); of(&ColumnKind::is_measured)],
            verdicts: vec![(0, 0); of(&|kind| kind == ColumnKind::Verdict)],
            ended: BTreeMap::new(),
            rows: BTreeMap::new(),
        }
    }

    /// Adds the next row.
    fn see(&mut self, table: &SweepTable, run: u64, cells: &csv::StringRecord) {
        self.runs += 1;
        let (mut measures, mut verdicts, mut is_kept) = (self.measures.iter_mut(), self.verdicts.iter_mut(), false);
        for (column, cell) in table.columns.iter().zip(cells) {
            match column.kind {
                ColumnKind::Run | ColumnKind::Case | ColumnKind::Varied => {}
                ColumnKind::Measure | ColumnKind::Value => {
                    is_kept |= measures.next().expect("one for each column").see(run, cell.parse().ok());
                }
                ColumnKind::Verdict => {
                    let (held, judged) = verdicts.next().expect("one for each column");
                    (*held, *judged) = (*held + u64::from(cell == "true"), *judged + u64::from(!cell.is_empty()));
                }
                ColumnKind::Status => {
                    let first = || Ended { runs: 0, first: run, status: cell.into() };
                    self.ended.entry(kind(cell)).or_insert_with(first).runs += 1;
                }
            }
        }
        if is_kept {
            let row = line(cells.iter().map(str::to_string));
            self.rows.insert(run, String::from_utf8_lossy(&row).trim_end().into());
            if self.rows.len() as u64 > LEAF {
                self.drop_rows();
            }
        }
    }

    /// Drops rows that others have displaced.
    fn drop_rows(&mut self) {
        let kept: BTreeSet<u64> = self.measures.iter().flat_map(Sketch::kept).collect();
        self.rows.retain(|run, _| kept.contains(run));
    }

    /// Adds the runs that follow; see [`Sketch::append`].
    fn append(&mut self, next: Tally) {
        self.runs += next.runs;
        self.measures.iter_mut().zip(&next.measures).for_each(|(own, next)| own.append(next));
        for (own, next) in self.verdicts.iter_mut().zip(next.verdicts) {
            *own = (own.0 + next.0, own.1 + next.1);
        }
        for (kind, Ended { runs, first, status }) in next.ended {
            self.ended.entry(kind).or_insert(Ended { runs: 0, first, status }).runs += runs;
        }
        self.rows.extend(next.rows);
        self.drop_rows();
    }

    /// For another process.
    fn written(&mut self) -> Value {
        self.drop_rows();
        let ended = self.ended.iter().map(|(kind, one)| json!([kind, one.runs, one.first, one.status]));
        json!([
            self.runs,
            self.measures.iter().map(Sketch::written).collect::<Vec<_>>(),
            self.verdicts,
            ended.collect::<Vec<_>>(),
            self.rows.iter().map(|row| json!(row)).collect::<Vec<_>>(),
        ])
    }

    /// Reads what [`Tally::written`] has made; none if it is damaged, or not of this number of runs.
    fn read(table: &SweepTable, number: u64, value: &Value) -> Option<Tally> {
        let [runs, measures, verdicts, ended, rows] = value.as_array()?.as_slice() else { return None };
        let mut tally = Tally::new(table);
        let (measures, verdicts) = (measures.as_array()?, verdicts.as_array()?);
        if (runs.as_u64()?, measures.len(), verdicts.len()) != (number, tally.measures.len(), tally.verdicts.len()) {
            return None;
        }
        tally.runs = number;
        tally.measures = measures.iter().map(|one| Sketch::read(one, number)).collect::<Option<_>>()?;
        tally.verdicts =
            verdicts.iter().map(|one| Some((one[0].as_u64()?, one[1].as_u64()?))).collect::<Option<_>>()?;
        for one in ended.as_array()? {
            let (runs, first, status) = (one[1].as_u64()?, one[2].as_u64()?, one[3].as_str()?.into());
            tally.ended.insert(one[0].as_str()?.into(), Ended { runs, first, status });
        }
        for row in rows.as_array()? {
            tally.rows.insert(row[0].as_u64()?, row[1].as_str()?.into());
        }
        Some(tally)
    }
}

/// A number for JSON, which has no infinity.
fn number(value: f64) -> Value {
    match value {
        value if value.is_nan() => Value::Null,
        value if value.is_infinite() => json!(value.to_string()),
        value => json!(value),
    }
}

/// A cell for JSON.
fn typed(holds: Holds, cell: &str) -> Value {
    match holds {
        Holds::Words => json!(cell),
        Holds::Integers => cell.parse::<u64>().map_or(Value::Null, Value::from),
        Holds::Booleans => cell.parse::<bool>().map_or(Value::Null, Value::from),
        Holds::Numbers => cell.parse().map_or(Value::Null, number),
    }
}

/// The block with this number from its line; none if it is not as it was written.
fn block(table: &SweepTable, cut: Cut, number: u64, line: &str) -> Option<Tally> {
    let value: Value = serde_json::from_str(line.strip_prefix(&format!("{number},"))?).ok()?;
    let runs = cut.runs_of_one(number);
    Tally::read(table, runs.end - runs.start, &value)
}

/// Whether a line can be the block with this number.
pub fn is_block(table: &SweepTable, cut: Cut, number: u64, line: &str) -> bool {
    number < cut.blocks() && block(table, cut, number, line).is_some()
}

/// The file that is being written, group by group.
pub struct Statistics<'t, W> {
    table: &'t SweepTable,
    cut: Cut,
    dice: Dice,
    to: W,
    /// The next block or run, and its group so far.
    next: u64,
    tally: Tally,
    groups: u64,
    words: Vec<Vec<String>>,
    /// Verdicts and ends of all groups.
    verdicts: Vec<(u64, u64)>,
    ended: BTreeMap<String, Ended>,
}

impl<'t, W: Write> Statistics<'t, W> {
    /// Writes the head. `asked`: the request of the sweep.
    pub fn begin(table: &'t SweepTable, asked: &str, mut to: W) -> io::Result<Statistics<'t, W>> {
        // The same file beside rows.
        let asked: Vec<&str> = asked.lines().filter(|line| !line.starts_with("--keep")).collect();
        let columns: Vec<String> = table.kinds().into_iter().map(|(title, _)| title).collect();
        let head = json!({ "asked": asked, "runs": table.total(), "columns": columns });
        write!(to, "{},\n\"groups\":[", head.to_string().trim_end_matches('}'))?;
        let (cut, dice, tally) = (table.groups(), table.dice(), Tally::new(table));
        let mut words = vec![table.point(0, &dice).into_iter().map(|(title, _)| title).collect::<Vec<_>>()];
        words[0]
            .extend(["measure", "mean", "deviation", "least", "5 %", "median", "95 %", "greatest"].map(String::from));
        let verdicts = tally.verdicts.clone();
        Ok(Statistics { table, cut, dice, to, next: 0, tally, groups: 0, words, verdicts, ended: BTreeMap::new() })
    }

    /// Adds the row of the next run.
    pub fn row(&mut self, cells: &csv::StringRecord) -> io::Result<()> {
        self.tally.see(self.table, self.next, cells);
        self.next += 1;
        if self.tally.runs == self.cut.group { self.group() } else { Ok(()) }
    }

    /// Adds the next block, as it was passed to `put` of [`SweepTable::blocks`].
    pub fn block(&mut self, line: &str) -> io::Result<()> {
        let block = block(self.table, self.cut, self.next, line);
        let wrong =
            || io::Error::new(io::ErrorKind::InvalidData, format!("block {} is not as it was written", self.next));
        self.tally.append(block.ok_or_else(wrong)?);
        self.next += 1;
        if self.cut.ends_group(self.next - 1) { self.group() } else { Ok(()) }
    }

    /// Writes a group that is complete.
    fn group(&mut self) -> io::Result<()> {
        let mut tally = std::mem::replace(&mut self.tally, Tally::new(self.table));
        tally.drop_rows();
        let point = self.table.point(self.groups * self.cut.group, &self.dice);
        let kinds = self.table.kinds();
        let row = |run: &u64| -> Value {
            let text = tally.rows.get(run).map_or("", String::as_str);
            let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(text.as_bytes());
            let record = reader.records().next().and_then(Result::ok).unwrap_or_default();
            kinds.iter().zip(&record).map(|((_, holds), cell)| typed(*holds, cell)).collect()
        };
        let mut measures = Map::new();
        let measured = self.table.columns.iter().filter(|column| column.kind.is_measured());
        for (column, sketch) in measured.zip(&tally.measures) {
            let (mean, deviation) = sketch.moments();
            let end = |(value, run): (f64, u64)| json!({ "value": number(value), "run": run });
            let [least, greatest] = sketch.extremes().map_or([Value::Null, Value::Null], |ends| ends.map(end));
            let quantiles: Map<String, Value> = QUANTILES
                .iter()
                .map(|percent| (format!("{percent} %"), number(sketch.quantile(f64::from(*percent) / 100.0))))
                .collect();
            let histogram: Vec<Value> =
                sketch.histogram().map(|(low, high, count)| json!([number(low), number(high), count])).collect();
            let [lowest, highest] = sketch.outermost().map(|runs| runs.iter().map(row).collect::<Vec<_>>());
            let [missing, not_a_number] = sketch.without();
            let object = json!({
                "number": sketch.number(),
                "missing": missing,
                "not a number": not_a_number,
                "infinite": sketch.infinite(),
                "mean": number(mean),
                "deviation": number(deviation),
                "least": least,
                "greatest": greatest,
                "quantiles": quantiles,
                "histogram": histogram,
                "lowest": lowest,
                "highest": highest,
            });
            measures.insert(column.title.clone(), object);
            if sketch.number() > 0 && self.groups < MOST_LINES as u64 {
                let mut cells: Vec<String> = point.iter().map(|(_, value)| shown(value)).collect();
                let extreme = |k: usize| sketch.extremes().map_or(f64::NAN, |ends| ends[k].0);
                let [low, median, high] = [0.05, 0.5, 0.95].map(|part| sketch.quantile(part));
                cells.push(column.title.clone());
                let numbers = [mean, deviation, extreme(0), low, median, high, extreme(1)];
                cells.extend(numbers.map(|value| if value.is_nan() { "-".into() } else { significant(value, 5) }));
                self.words.push(cells);
            }
        }
        let verdicts = self.table.columns.iter().filter(|column| column.kind == ColumnKind::Verdict);
        let verdicts: Map<String, Value> = verdicts
            .zip(&tally.verdicts)
            .map(|(column, (held, judged))| (column.title.clone(), json!({ "held": held, "judged": judged })))
            .collect();
        let ended = tally.ended.values();
        let ended = ended.map(|one| json!({ "status": one.status, "runs": one.runs, "first": one.first }));
        let object = json!({
            "point": point.into_iter().collect::<Map<_, _>>(),
            "runs": tally.runs,
            "ended": ended.collect::<Vec<_>>(),
            "verdicts": verdicts,
            "measures": measures,
        });
        let comma = if self.groups == 0 { "" } else { "," };
        self.groups += 1;
        for (own, more) in self.verdicts.iter_mut().zip(&tally.verdicts) {
            *own = (own.0 + more.0, own.1 + more.1);
        }
        for (kind, Ended { runs, first, status }) in tally.ended {
            self.ended.entry(kind).or_insert(Ended { runs: 0, first, status }).runs += runs;
        }
        write!(self.to, "{comma}\n{object}")
    }

    /// After the last run: the statistics in words.
    pub fn end(mut self) -> io::Result<(W, String)> {
        self.to.write_all(b"\n]}\n")?;
        self.to.flush()?;
        let mut words = if self.words.len() > 1 { aligned(&self.words) } else { String::new() };
        if let more @ 1.. = self.groups.saturating_sub(MOST_LINES as u64) {
            words += &format!("  … and {} more points of the grids\n", count(more));
        }
        let verdicts = self.table.columns.iter().filter(|column| column.kind == ColumnKind::Verdict);
        for (column, (held, judged)) in verdicts.zip(&self.verdicts) {
            let share = significant(100.0 * *held as f64 / (*judged).max(1) as f64, 4);
            words += &format!("  {} held in {} of {} runs ({share} %)\n", column.title, count(*held), count(*judged));
        }
        let mut ended: Vec<&Ended> = self.ended.values().filter(|ended| ended.status != "ok").collect();
        ended.sort_by_key(|ended| ended.first);
        for Ended { runs, first, status } in ended {
            words += &match runs {
                1 => format!("  run {first}: {status}\n"),
                _ => format!("  {} runs such as {first}: {status}\n", count(*runs)),
            };
        }
        Ok((self.to, words))
    }
}

/// A value of a grid, or the label of a case, in words.
fn shown(value: &Value) -> String {
    value.as_f64().map_or_else(|| value.as_str().unwrap_or_default().into(), |value| significant(value, 5))
}

impl SweepTable {
    /// How runs are cut: a group for each point of the grids at which distributions are drawn; without distributions all
    /// runs of a case.
    fn groups(&self) -> Cut {
        Cut::new(self.total(), if self.draws > 1 { self.draws } else { self.grid })
    }

    /// How runs are cut into blocks, if no rows are kept.
    pub(super) fn cut(&self) -> Option<Cut> {
        (!self.request.keep.rows()).then(|| self.groups())
    }

    /// Why there are no statistics of this sweep.
    pub(super) fn too_many_groups(&self) -> Option<String> {
        let Cut { total, group, .. } = self.groups();
        let measured = self.columns.iter().filter(|column| column.kind.is_measured()).count() as u64;
        let points = total.checked_div(group).unwrap_or(0);
        (points.saturating_mul(measured) > MOST_SKETCHES).then(|| {
            format!(
                "statistics of {measured} measures at {} points of the grids are too many, {} together are possible: keep the rows \
                 alone, or give the grids fewer values",
                count(points),
                count(MOST_SKETCHES)
            )
        })
    }

    /// What the runs of a group share, from its first run: titles and values.
    fn point(&self, first: u64, dice: &Dice) -> Vec<(String, Value)> {
        let (at, values) = self.values(first, dice);
        let mut point = Vec::new();
        let mut varied = self.vary.iter().zip(values);
        for column in &self.columns {
            match column.kind {
                ColumnKind::Case => point.push((column.title.clone(), json!(self.cases[at].label))),
                ColumnKind::Varied => {
                    let (vary, value) = varied.next().expect("one for each column");
                    if self.draws > 1 && vary.len().is_some() {
                        point.push((column.title.clone(), number(vary.unit.from_si(value))));
                    }
                }
                _ => {}
            }
        }
        point
    }

    /// Makes blocks from the rows of their runs and passes each as a line, with how many were passed before it, in order;
    /// returns how many.
    pub(super) fn blocks(
        &self,
        cut: Cut,
        blocks: Range<u64>,
        rows: &mut Rows,
        put: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>,
    ) -> io::Result<u64> {
        let runs = cut.runs(blocks.clone());
        let (mut number, mut tally, mut cells) = (blocks.start, Tally::new(self), csv::StringRecord::new());
        rows(runs.clone(), &mut |before, row| {
            let run = runs.start + before;
            let mut reader = csv::ReaderBuilder::new().has_headers(false).buffer_capacity(512).from_reader(row);
            assert!(reader.read_record(&mut cells)?, "a row of our own is a record");
            tally.see(self, run, &cells);
            if run + 1 == cut.runs_of_one(number).end {
                put(number - blocks.start, format!("{number},{}\n", tally.written()).as_bytes())?;
                (number, tally) = (number + 1, Tally::new(self));
            }
            Ok(())
        })?;
        Ok(number - blocks.start)
    }
}
