//! Summary of a complete table, as text and as a figure.
//!
//! In: a file of rows and its columns. Out: mean, standard deviation and quantiles of each numeric column, how often
//! each verdict holds, why runs failed, and curves of measures over a parameter. The file is read once, in bounded
//! memory.

use super::{Column, ColumnKind, Table};
use crate::args::Sweep;
use crate::plot::{Curve, Figure, Panel};
use crate::quantity::{count, significant};
use crate::results;
use std::io;
use std::path::Path;

/// Most values of a column that are kept for its quantiles and figures.
const SAMPLE: usize = 1 << 16;

impl Table {
    /// Reads the file once.
    pub(super) fn summary(&self, path: &Path, header: bool) -> io::Result<Summary> {
        let mut reader = csv::ReaderBuilder::new().has_headers(header).from_path(path).map_err(io::Error::other)?;
        let tallies = self.columns.iter().map(|column| Tally::new(&column.title, column.kind)).collect();
        let mut summary = Summary { tallies, kept: Vec::new(), every: 1, rows: 0, ended: Vec::new() };
        let mut record = csv::StringRecord::new();
        while reader.read_record(&mut record).map_err(io::Error::other)? {
            summary.see(&record);
        }
        Ok(summary)
    }

    /// A measure over a parameter: the named ones, else the first parameter and every measure.
    pub(super) fn figure(&self, args: &Sweep, summary: &Summary) -> Result<Figure, String> {
        let (show, against) = (args.show.as_deref(), args.against.as_deref());
        let is_measure = |column: &&Column| matches!(column.kind, ColumnKind::Measure(..));
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
            title: args.experiment.clone(),
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
fn kind(status: &str) -> String {
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
    /// Number of verdicts that hold.
    held: u64,
}

impl Tally {
    fn new(title: &str, kind: ColumnKind) -> Tally {
        let (least, most) = (f64::INFINITY, f64::NEG_INFINITY);
        Tally { title: title.into(), kind, number: 0, mean: 0.0, square: 0.0, least, most, held: 0 }
    }

    fn see(&mut self, cell: &str) -> f64 {
        let value = match (self.kind, cell) {
            (ColumnKind::Verdict(_), "true" | "false") => {
                self.number += 1;
                self.held += u64::from(cell == "true");
                return f64::NAN;
            }
            (ColumnKind::Varied | ColumnKind::Measure(..), cell) => cell.parse().unwrap_or(f64::NAN),
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
    fn see(&mut self, record: &csv::StringRecord) {
        let row: Vec<f64> = self.tallies.iter_mut().zip(record).map(|(tally, cell)| tally.see(cell)).collect();
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

    pub(super) fn words(&self) -> String {
        let mut table =
            vec![["", "mean", "deviation", "least", "5 %", "median", "95 %", "greatest"].map(str::to_string).to_vec()];
        for (k, tally) in self.tallies.iter().enumerate() {
            if !matches!(tally.kind, ColumnKind::Varied | ColumnKind::Measure(..)) || tally.number == 0 {
                continue;
            }
            let mut values: Vec<f64> = self.kept.iter().map(|row| row[k]).filter(|value| value.is_finite()).collect();
            values.sort_by(f64::total_cmp);
            let at = |part: f64| values.get((part * (values.len().max(1) - 1) as f64).round() as usize).copied();
            let deviation = (tally.square / (tally.number.max(2) - 1) as f64).sqrt();
            let mut cells = vec![tally.title.clone()];
            let quantiles = [0.05, 0.5, 0.95].map(|part| at(part).unwrap_or(f64::NAN));
            let numbers = [tally.mean, deviation, tally.least, quantiles[0], quantiles[1], quantiles[2], tally.most];
            cells.extend(numbers.map(|number| significant(number, 5)));
            table.push(cells);
        }
        let mut out = String::new();
        if table.len() > 1 {
            let widths: Vec<usize> =
                (0..8).map(|k| table.iter().map(|row| row[k].chars().count()).max().unwrap_or(0)).collect();
            for row in &table {
                let cells: Vec<String> =
                    row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
                out += &format!("  {}\n", cells.join("  ").trim_end());
            }
        }
        for tally in self.tallies.iter().filter(|tally| matches!(tally.kind, ColumnKind::Verdict(_))) {
            let share = 100.0 * tally.held as f64 / self.rows.max(1) as f64;
            out += &format!(
                "  {} held in {} of {} runs ({} %)\n",
                tally.title,
                count(tally.held),
                count(self.rows),
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
