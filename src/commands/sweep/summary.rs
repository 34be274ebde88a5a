//! Summary of a complete table, as text and as a figure.
//!
//! In: a file of rows and its columns. Out: the answer to the question of the sweep. Of a small grid, its rows; of a large
//! one, where each measure is least and greatest; of distributions, mean, standard deviation and quantiles, for each point
//! of a grid; with a ranking, the best rows. Also how often each verdict holds, why runs failed, and curves of measures
//! over a parameter. The file is read once, in bounded memory.

use super::best::{Best, Statistic};
use super::{Column, ColumnKind, SweepTable};
use crate::args::Sweep;
use crate::plot::{Curve, Figure, Panel};
use crate::quantity::{count, significant};
use crate::results;
use std::collections::BTreeMap;
use std::io;
use std::path::Path;

/// Most values of a column that are kept for its quantiles and figures.
const SAMPLE: usize = 1 << 16;

/// Most rows, or points of a grid, that are printed one by one.
const MOST_LINES: usize = 40;

/// Most values that are kept for statistics of the points of a grid.
const MOST_KEPT: u64 = 4_000_000;

impl SweepTable {
    /// Reads the file once.
    ///
    /// # Errors
    /// Those of the file and of `also`, which is called with each row.
    pub(super) fn summary(
        &self,
        path: &Path,
        header: bool,
        also: &mut dyn FnMut(&csv::StringRecord) -> io::Result<()>,
    ) -> io::Result<Summary> {
        let mut reader = csv::ReaderBuilder::new().has_headers(header).from_path(path).map_err(io::Error::other)?;
        let mut summary = self.no_summary();
        let mut record = csv::StringRecord::new();
        while reader.read_record(&mut record).map_err(io::Error::other)? {
            summary.see(&record);
            also(&record)?;
        }
        Ok(summary)
    }

    /// The summary of no rows yet.
    pub(super) fn no_summary(&self) -> Summary {
        let tallies = self.columns.iter().map(|column| Tally::new(&column.title, column.kind)).collect();
        let measured = self.columns.iter().filter(|column| column.kind.is_measured()).count() as u64;
        let points = self.grid * self.cases.len() as u64;
        let pointwise = self.draws > 1 && points > 1 && self.total().saturating_mul(measured) <= MOST_KEPT;
        let ranked = self.best.as_ref().filter(|_| !pointwise).map(|(best, column)| (best.clone(), *column));
        Summary {
            tallies,
            kept: Vec::new(),
            every: 1,
            rows: 0,
            ended: Vec::new(),
            ranked,
            best: Vec::new(),
            draws: if pointwise { self.draws } else { 0 },
            points: BTreeMap::new(),
        }
    }

    /// A measure over a parameter: the named ones, else the first parameter and every measure.
    pub(super) fn figure(&self, args: &Sweep, summary: &Summary) -> Result<Figure, String> {
        let (show, against) = (args.show.as_deref(), args.against.as_deref());
        let is_measure = |column: &&Column| column.kind.is_measured();
        let named = |column: &&Column, name: &str| column.axis.name == name || column.title == name;
        let x = match against {
            None => self.columns.iter().position(|column| column.kind == ColumnKind::Varied),
            Some(name) => {
                self.columns.iter().position(|column| column.kind == ColumnKind::Varied && named(&column, name))
            }
        };
        let Some(x) = x else {
            let varied: Vec<&str> = self.vary.iter().map(|vary| vary.path.as_str()).collect();
            return Err(format!("--against names none of what is varied: {}", varied.join(", ")));
        };
        let wanted = |column: &&Column| is_measure(column) && show.is_none_or(|name| named(column, name));
        let shown: Vec<usize> = (0..self.columns.len()).filter(|k| wanted(&&self.columns[*k])).collect();
        if shown.is_empty() {
            let all: Vec<&str> =
                self.columns.iter().filter(is_measure).map(|column| column.axis.name.as_str()).collect();
            return Err(match all.is_empty() {
                true => "there is nothing to plot: the experiment expects nothing, so nothing is measured".into(),
                false => format!("--show names no measure of the experiment; it has {}", all.join(", ")),
            });
        }
        let panel = |y: usize| {
            // Isolated points: a gap before each.
            let points = summary.kept.iter().flat_map(|row| [(row[x], row[y]), (f64::NAN, f64::NAN)]).collect();
            Panel {
                x: self.columns[x].axis.clone(),
                y: self.columns[y].axis.clone(),
                curves: vec![Curve { points, marks: true, ..Curve::default() }],
                ..Panel::default()
            }
        };
        Ok(Figure {
            title: self.request.experiment.clone(),
            subtitle: format!("{} runs, {}", count(summary.rows), results::solver(&self.cases[0].experiment.solver)),
            panels: shown.into_iter().map(panel).collect(),
        })
    }
}

/// Statistics of a file, column by column.
pub(super) struct Summary {
    tallies: Vec<Tally>,
    /// Every k-th row as numbers: for quantiles and figures, in bounded memory.
    kept: Vec<Vec<f64>>,
    every: u64,
    rows: u64,
    /// Runs that failed, by reason.
    ended: Vec<Ended>,
    /// The ranking of rows and its column, and the best rows so far.
    ranked: Option<(Best, usize)>,
    best: Vec<Vec<f64>>,
    /// Draws at each point of a grid, or 0 if points are not summed up; and the rows of each point.
    draws: u64,
    points: BTreeMap<u64, Vec<Vec<f64>>>,
}

/// Runs that failed for the same reason.
struct Ended {
    /// The reason without its numbers.
    kind: String,
    runs: u64,
    /// Number of the first of them, and its reason in full.
    run: String,
    first: String,
}

/// A reason without numbers and their units, because these differ from run to run. Names in backticks stay.
pub(super) fn kind(status: &str) -> String {
    let mut kept = Vec::new();
    for (k, part) in status.split('`').enumerate() {
        let mut words = part.split_whitespace();
        if k % 2 == 1 {
            kept.push(part);
            continue;
        }
        while let Some(word) = words.next() {
            let bare = word.trim_start_matches(['-', '+', '.']);
            if bare == "inf" || bare.starts_with(|c: char| c.is_ascii_digit()) {
                // Its unit, or the dots of a range.
                words.next();
            } else {
                kept.push(word);
            }
        }
    }
    kept.join(" ")
}

/// One column.
struct Tally {
    title: String,
    kind: ColumnKind,
    number: u64,
    mean: f64,
    /// Sum of squared distances to the mean.
    square: f64,
    least: f64,
    most: f64,
    /// The rows with the least and the greatest value.
    least_at: Vec<f64>,
    most_at: Vec<f64>,
    /// Number of verdicts that hold.
    held: u64,
}

impl Tally {
    fn new(title: &str, kind: ColumnKind) -> Tally {
        let (least, most) = (f64::INFINITY, f64::NEG_INFINITY);
        let title = title.into();
        let (least_at, most_at) = (Vec::new(), Vec::new());
        Tally { title, kind, number: 0, mean: 0.0, square: 0.0, least, most, least_at, most_at, held: 0 }
    }

    fn see(&mut self, cell: &str) -> f64 {
        let value = match (self.kind, cell) {
            (ColumnKind::Verdict, "true" | "false") => {
                self.number += 1;
                self.held += u64::from(cell == "true");
                return f64::from(cell == "true");
            }
            (ColumnKind::Run, cell) => return cell.parse().unwrap_or(f64::NAN),
            (ColumnKind::Varied | ColumnKind::Measure | ColumnKind::Value, cell) => cell.parse().unwrap_or(f64::NAN),
            _ => return f64::NAN,
        };
        if f64::is_finite(value) {
            self.number += 1;
            // Welford's algorithm.
            let distance = value - self.mean;
            self.mean += distance / self.number as f64;
            self.square += distance * (value - self.mean);
            self.least = self.least.min(value);
            self.most = self.most.max(value);
        }
        value
    }
}

impl Summary {
    /// Adds the next row.
    pub(super) fn see(&mut self, record: &csv::StringRecord) {
        let before: Vec<(f64, f64)> = self.tallies.iter().map(|tally| (tally.least, tally.most)).collect();
        let row: Vec<f64> = self.tallies.iter_mut().zip(record).map(|(tally, cell)| tally.see(cell)).collect();
        for (tally, before) in self.tallies.iter_mut().zip(before).filter(|(tally, _)| tally.kind.is_measured()) {
            if tally.least < before.0 {
                tally.least_at.clone_from(&row);
            }
            if tally.most > before.1 {
                tally.most_at.clone_from(&row);
            }
        }
        if let Some((best, column)) = &self.ranked {
            let at = self.best.partition_point(|other| best.order(other[*column], row[*column]).is_le());
            if at < best.count && !row[*column].is_nan() {
                self.best.insert(at, row.clone());
                self.best.truncate(best.count);
            }
        }
        if let Some(point) = (row[0] as u64).checked_div(self.draws) {
            self.points.entry(point).or_default().push(row.clone());
        }
        if self.rows.is_multiple_of(self.every) {
            self.kept.push(row);
            if self.kept.len() == SAMPLE {
                let mut even = false;
                self.kept.retain(|_| {
                    even = !even;
                    even
                });
                self.every *= 2;
            }
        }
        self.rows += 1;
        let status = record.get(record.len() - 1).unwrap_or_default();
        if status != "ok" {
            let kind = kind(status);
            match self.ended.iter().position(|ended| ended.kind == kind) {
                Some(at) => self.ended[at].runs += 1,
                None if self.ended.len() < 20 => {
                    let (run, first) = (record.get(0).unwrap_or_default().into(), status.into());
                    self.ended.push(Ended { kind, runs: 1, run, first });
                }
                None => {}
            }
        }
    }

    pub(super) fn words(&self, table: &SweepTable) -> String {
        let mut out = match (&table.best, self.draws > 0) {
            (Some((best, column)), true) => self.best_points(table, best, *column),
            (Some((best, _)), false) => {
                let rows: Vec<&Vec<f64>> = self.best.iter().collect();
                let shown = rows.len().min(best.count);
                aligned(&self.lines(table, &rows[..shown]))
            }
            (None, true) if self.points.len() <= MOST_LINES => self.of_points(table),
            (None, false) if table.draws == 1 && self.rows as usize <= MOST_LINES => {
                aligned(&self.lines(table, &self.kept.iter().collect::<Vec<_>>()))
            }
            (None, false) if table.draws == 1 => self.extremes(table),
            (None, _) => self.quantiles(),
        };
        for tally in self.tallies.iter().filter(|tally| tally.kind == ColumnKind::Verdict) {
            // Rows of other cases have no verdict on it.
            let share = 100.0 * tally.held as f64 / tally.number.max(1) as f64;
            out += &format!(
                "  {} held in {} of {} runs ({} %)\n",
                tally.title,
                count(tally.held),
                count(tally.number),
                significant(share, 4)
            );
        }
        for Ended { kind: _, runs, run, first } in &self.ended {
            out += &match runs {
                1 => format!("  run {run}: {first}\n"),
                _ => format!("  {} runs such as {run}: {first}\n", count(*runs)),
            };
        }
        out
    }
}

impl Summary {
    /// The columns that tell the rows of a table apart, and those of measures.
    fn told_and_measured(&self) -> (Vec<usize>, Vec<usize>) {
        let of = |wanted: &dyn Fn(ColumnKind) -> bool| {
            (0..self.tallies.len()).filter(|k| wanted(self.tallies[*k].kind)).collect()
        };
        (of(&|kind| matches!(kind, ColumnKind::Case | ColumnKind::Varied)), of(&ColumnKind::is_measured))
    }

    /// The cell of a column that tells rows apart.
    fn told(&self, table: &SweepTable, row: &[f64], column: usize) -> String {
        match self.tallies[column].kind {
            ColumnKind::Case => table.cases[table.case_of(row[0] as u64)].label.clone(),
            _ => significant(row[column], 5),
        }
    }

    /// Rows as lines: their run, what varies, the measures, and whether the expectations hold.
    fn lines(&self, table: &SweepTable, rows: &[&Vec<f64>]) -> Vec<Vec<String>> {
        let (told, measured) = self.told_and_measured();
        let verdicts: Vec<usize> =
            (0..self.tallies.len()).filter(|k| self.tallies[*k].kind == ColumnKind::Verdict).collect();
        let title = |k: &usize| self.tallies[*k].title.clone();
        let mut head = vec!["run".to_string()];
        head.extend(told.iter().chain(&measured).map(title));
        head.extend((!verdicts.is_empty()).then(|| "expected".to_string()));
        let line = |row: &&Vec<f64>| {
            let mut cells = vec![format!("{}", row[0])];
            cells.extend(told.iter().map(|k| self.told(table, row, *k)));
            cells.extend(measured.iter().map(|k| if row[*k].is_nan() { "-".into() } else { significant(row[*k], 5) }));
            if !verdicts.is_empty() {
                let judged = verdicts.iter().filter(|k| !row[**k].is_nan()).count();
                let held = verdicts.iter().filter(|k| row[**k] == 1.0).count();
                cells.push(match (judged, held) {
                    (0, _) => "-".into(),
                    (judged, held) if judged == held => "✓".into(),
                    (judged, held) => format!("✗ {} of {judged}", judged - held),
                });
            }
            cells
        };
        std::iter::once(head).chain(rows.iter().map(line)).collect()
    }

    /// Where each measure is least and greatest.
    fn extremes(&self, table: &SweepTable) -> String {
        let (told, measured) = self.told_and_measured();
        let at = |row: &[f64]| {
            let one = |k: &usize| match self.tallies[*k].kind {
                ColumnKind::Case => self.told(table, row, *k),
                _ => {
                    let axis = &table.columns[*k].axis;
                    format!("{} = {} {}", axis.name, significant(row[*k], 5), axis.unit).trim_end().to_string()
                }
            };
            told.iter().map(one).collect::<Vec<_>>().join(", ")
        };
        let mut out = String::new();
        for tally in measured.iter().map(|k| &self.tallies[*k]).filter(|tally| tally.number > 0) {
            for (word, value, row) in
                [("least", tally.least, &tally.least_at), ("greatest", tally.most, &tally.most_at)]
            {
                out +=
                    &format!("  {}: {word} {} at {} (run {})\n", tally.title, significant(value, 5), at(row), row[0]);
            }
        }
        out
    }

    /// For each point of a grid the mean, the deviation and two quantiles of each measure.
    fn of_points(&self, table: &SweepTable) -> String {
        let (told, measured) = self.grid_columns(table);
        let mut head: Vec<String> = told.iter().map(|k| self.tallies[*k].title.clone()).collect();
        for k in &measured {
            let title = &self.tallies[*k].title;
            head.extend([format!("{title} mean"), "deviation".into(), "5 %".into(), "95 %".into()]);
        }
        let line = |rows: &Vec<Vec<f64>>| {
            let mut cells: Vec<String> = told.iter().map(|k| self.told(table, &rows[0], *k)).collect();
            for k in &measured {
                let values: Vec<f64> = rows.iter().map(|row| row[*k]).filter(|value| value.is_finite()).collect();
                let mean = Statistic::Mean.of(&values);
                let square: f64 = values.iter().map(|value| (value - mean) * (value - mean)).sum();
                let deviation = (square / (values.len().max(2) - 1) as f64).sqrt();
                let quantiles = [5, 95].map(|percent| Statistic::Percent(percent).of(&values));
                cells.extend([mean, deviation, quantiles[0], quantiles[1]].map(|number| significant(number, 5)));
            }
            cells
        };
        aligned(&std::iter::once(head).chain(self.points.values().map(line)).collect::<Vec<_>>())
    }

    /// The best points of a grid with distributions.
    fn best_points(&self, table: &SweepTable, best: &Best, column: usize) -> String {
        let (told, _) = self.grid_columns(table);
        let statistic =
            |rows: &Vec<Vec<f64>>| best.statistic.of(&rows.iter().map(|row| row[column]).collect::<Vec<_>>());
        let mut points: Vec<(f64, &Vec<Vec<f64>>)> = self.points.values().map(|rows| (statistic(rows), rows)).collect();
        points.sort_by(|a, b| best.order(a.0, b.0));
        let mut head: Vec<String> = told.iter().map(|k| self.tallies[*k].title.clone()).collect();
        head.push(format!("{} {}", best.statistic.name(), self.tallies[column].title));
        let line = |(value, rows): &(f64, &Vec<Vec<f64>>)| {
            let cells = told.iter().map(|k| self.told(table, &rows[0], *k));
            cells.chain([significant(*value, 5)]).collect()
        };
        let lines = points.iter().filter(|(value, _)| !value.is_nan()).take(best.count).map(line);
        aligned(&std::iter::once(head).chain(lines).collect::<Vec<_>>())
    }

    /// The columns that tell the points of a grid apart, without distributions; and those of measures.
    fn grid_columns(&self, table: &SweepTable) -> (Vec<usize>, Vec<usize>) {
        let (mut told, measured) = self.told_and_measured();
        told.retain(|k| match self.tallies[*k].kind {
            ColumnKind::Varied => {
                table.vary.iter().any(|vary| vary.path == table.columns[*k].axis.name && vary.len().is_some())
            }
            _ => true,
        });
        (told, measured)
    }

    /// Mean, deviation and quantiles of each column.
    fn quantiles(&self) -> String {
        let mut table =
            vec![["", "mean", "deviation", "least", "5 %", "median", "95 %", "greatest"].map(str::to_string).to_vec()];
        for (k, tally) in self.tallies.iter().enumerate() {
            if !(tally.kind == ColumnKind::Varied || tally.kind.is_measured()) || tally.number == 0 {
                continue;
            }
            let values: Vec<f64> = self.kept.iter().map(|row| row[k]).collect();
            let deviation = (tally.square / (tally.number.max(2) - 1) as f64).sqrt();
            let mut cells = vec![tally.title.clone()];
            let quantiles = [5, 50, 95].map(|percent| Statistic::Percent(percent).of(&values));
            let numbers = [tally.mean, deviation, tally.least, quantiles[0], quantiles[1], quantiles[2], tally.most];
            cells.extend(numbers.map(|number| significant(number, 5)));
            table.push(cells);
        }
        if table.len() > 1 { aligned(&table) } else { String::new() }
    }
}

/// Lines of cells, in columns.
pub(super) fn aligned(lines: &[Vec<String>]) -> String {
    let count = lines.iter().map(Vec::len).max().unwrap_or(0);
    let width = |k: usize| lines.iter().filter_map(|line| line.get(k)).map(|cell| cell.chars().count()).max();
    let widths: Vec<usize> = (0..count).map(|k| width(k).unwrap_or(0)).collect();
    let one = |line: &Vec<String>| {
        let cells: Vec<String> = line.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        format!("  {}\n", cells.join("  ").trim_end())
    };
    lines.iter().map(one).collect()
}

#[test]
fn reasons_that_differ_in_numbers_are_of_one_kind() {
    let same = [
        "`F2` left its range 0 .. 10 m: it is 10.1 m at 901 ms",
        "`F2` left its range -2.5 .. 10 m: it is 1e3 m at 1.5 s",
        "`F2` left its range -inf .. 7 mm: it is -0.5 mm at 0 s",
    ];
    assert!(same.iter().all(|status| kind(status) == "F2 left its range it is at"), "{:?}", same.map(kind));
    assert_eq!(kind("`2x` is infinite at 0.9 s"), "2x is infinite at");
    assert_ne!(kind("`F2` is infinite at 1 s"), kind("`F3` is infinite at 1 s"));
    assert_ne!(kind("`F2` is infinite at 1 s"), kind("`F2` is not a number at 1 s"));
}
