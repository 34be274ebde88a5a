//! Recordings of a run for plots and files, in bounded memory.
//!
//! In: the points of a run in order of time. Out: a [`Recording`]: a row of time and values for each of 16,384 points;
//! of more points, rows that include every minimum and maximum of every column, at least 1,000. Measures do not read it.

pub mod blocks;
pub mod claim;
pub mod csv;
mod packed;
pub mod parts;
pub mod log;

use crate::stretch::Stretch;
use abi::Slot;
use abi::plan::{Plot, Series};
use abi::unit::Unit;

/// So many points are kept as they are; more of them in buckets.
const WHOLE: usize = 16_384;

/// Largest number of buckets. When they are full, neighbours are merged, so at least half of them hold a row or more.
const BUCKETS: usize = 4096;

/// A column of a recording.
#[derive(Clone, PartialEq, Debug)]
pub struct Column {
    /// As written in the plot: `body.v`.
    pub label: String,
    /// The unit it is shown in; rows hold SI.
    pub unit: Unit,
    /// Whether the values are truth values, 1 or 0, rather than a quantity.
    pub boolean: bool,
}

/// A decimated record of a run: one row for each point kept, in order of time. An event has two rows at one time.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Recording {
    columns: Vec<Column>,
    /// Time in s, then the columns in SI; row-major.
    numbers: Vec<f64>,
    seen: u64,
}

impl Recording {
    /// The columns, without time.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// The rows: time in s, then the columns in SI.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.numbers.chunks_exact(self.columns.len() + 1)
    }

    /// Number of points of the run, kept or not.
    pub fn seen(&self) -> u64 {
        self.seen
    }

    /// Which column holds this series.
    pub fn column(&self, series: &Series) -> Option<usize> {
        self.columns.iter().position(|column| column == &Column::of(series))
    }

    /// Time in s and value in SI of one column, for plotting.
    pub fn points(&self, column: usize) -> impl Iterator<Item = (f64, f64)> {
        self.rows().map(move |row| (row[0], row[column + 1]))
    }
}

impl Column {
    fn of(series: &Series) -> Column {
        Column { label: series.label.clone(), unit: series.unit.clone(), boolean: series.boolean }
    }
}

/// Builds a recording.
///
/// A long run's points are gathered in buckets of 1, 2, 4, … consecutive points. A bucket keeps whole rows: its first, and
/// for each column those with the least and the greatest value. The rows are whole so that a plot of one quantity against
/// another shows points that occurred. When all buckets are full, neighbours are merged in pairs: the extremes of both
/// are among their rows.
pub struct Recorder {
    columns: Vec<Column>,
    slots: Vec<Slot>,
    /// The rows of all points, as in a [`Recording`]; empty once there are buckets.
    whole: Vec<f64>,
    /// Buckets one after the other, each of 2 · columns + 1 rows, some of which may be equal. A row is the number of
    /// its point, its time, and the columns.
    buckets: Vec<f64>,
    /// Points per full bucket.
    capacity: u64,
    /// Points in the last bucket.
    filled: u64,
    seen: u64,
    /// The last row, which ends the recording.
    last: Vec<f64>,
    /// For a recording of every point: the most numbers that it may hold.
    most: Option<usize>,
    /// Points outside are not kept, in s: no plot shows them.
    window: (f64, f64),
}

impl Recorder {
    /// Records every series of the data and of these plots once.
    pub fn new(plots: &[Plot], records: &[Series]) -> Recorder {
        let mut columns: Vec<Column> = Vec::new();
        let mut slots = Vec::new();
        let drawn = plots.iter().flat_map(|plot| plot.series.iter().chain(&plot.against));
        for series in records.iter().chain(drawn) {
            let column = Column::of(series);
            if !columns.contains(&column) {
                columns.push(column);
                slots.push(series.slot);
            }
        }
        let last = vec![0.0; slots.len() + 2];
        let after = plots.iter().map(|plot| plot.view.after.unwrap_or(f64::NEG_INFINITY));
        let before = plots.iter().map(|plot| plot.view.before.unwrap_or(f64::INFINITY));
        let window = match records {
            [] => (after.fold(f64::INFINITY, f64::min), before.fold(f64::NEG_INFINITY, f64::max)),
            _ => (f64::NEG_INFINITY, f64::INFINITY),
        };
        let (whole, buckets) = (Vec::new(), Vec::new());
        Recorder { columns, slots, whole, buckets, capacity: 1, filled: 1, seen: 0, last, most: None, window }
    }

    /// The same, and keeps every point of the run, as long as these are at most `most` numbers.
    pub fn whole(plots: &[Plot], records: &[Series], most: usize) -> Recorder {
        Recorder { most: Some(most), ..Recorder::new(plots, records) }
    }

    /// The recording of every point; `None` if it would have been too large.
    pub fn all(self) -> Option<Recording> {
        let (numbers, most) = (self.whole, self.most?);
        (numbers.len() <= most).then_some(Recording { columns: self.columns, numbers, seen: self.seen })
    }

    /// A recording of given rows instead of observed points: times in s, ascending, and as many rows of values in SI,
    /// in the order of [`Recorder::slots`].
    pub fn rows(self, times: &[f64], values: &[f64]) -> Recording {
        let rows = times.iter().zip(values.chunks_exact(self.slots.len().max(1)));
        let numbers: Vec<f64> = rows.flat_map(|(t, row)| std::iter::once(*t).chain(row.iter().copied())).collect();
        let seen = (numbers.len() / (self.columns.len() + 1)) as u64;
        Recording { columns: self.columns, numbers, seen }
    }

    /// Whether there is nothing to record.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// The slots that are read.
    pub fn slots(&self) -> impl Iterator<Item = Slot> {
        self.slots.iter().copied()
    }

    /// Adds the state of the model at time `t` in s. Times must not decrease.
    pub fn see(&mut self, t: f64, block: &[f64]) {
        if self.slots.is_empty() {
            return;
        }
        for (value, slot) in self.last[2..].iter_mut().zip(&self.slots) {
            *value = block[slot.index()];
        }
        self.add(t);
    }

    /// Adds consecutive points.
    pub(crate) fn see_stretch(&mut self, stretch: &Stretch) {
        let columns: Vec<&[f64]> = self.slots.iter().map(|slot| stretch.column(*slot)).collect();
        if columns.is_empty() {
            return;
        }
        for (k, t) in stretch.times().iter().enumerate() {
            for (value, column) in self.last[2..].iter_mut().zip(&columns) {
                *value = column[k];
            }
            self.add(*t);
        }
    }

    /// Adds the values in the last row, at time `t` in s.
    fn add(&mut self, t: f64) {
        self.last[0] = self.seen as f64;
        self.last[1] = t;
        self.seen += 1;
        if let Some(most) = self.most {
            if self.whole.len() <= most {
                self.whole.extend(&self.last[1..]);
            }
            return;
        }
        if !(t >= self.window.0 && t <= self.window.1) {
            return;
        }
        if self.buckets.is_empty() {
            if self.whole.len() < WHOLE * (self.slots.len() + 1) {
                self.whole.extend(&self.last[1..]);
                return;
            }
            let whole = std::mem::take(&mut self.whole);
            for (number, row) in whole.chunks_exact(self.slots.len() + 1).enumerate() {
                let row: Vec<f64> = std::iter::once(number as f64).chain(row.iter().copied()).collect();
                self.gather(&row);
            }
        }
        let last = std::mem::take(&mut self.last);
        self.gather(&last);
        self.last = last;
    }

    /// Adds a point to the last bucket, or to a new one.
    fn gather(&mut self, row: &[f64]) {
        let len = (2 * self.slots.len() + 1) * row.len();
        if self.filled < self.capacity {
            self.filled += 1;
            let bucket = self.buckets.len() - len;
            take(&mut self.buckets[bucket..], row);
            return;
        }
        if self.buckets.len() == BUCKETS * len {
            self.join(len, row.len());
        }
        self.filled = 1;
        for _ in 0..2 * self.slots.len() + 1 {
            self.buckets.extend_from_slice(row);
        }
    }

    /// Merges neighbouring buckets in pairs. `len`: that of a bucket; `width`: that of one of its rows.
    fn join(&mut self, len: usize, width: usize) {
        for pair in 0..BUCKETS / 2 {
            self.buckets.copy_within(2 * pair * len..(2 * pair + 1) * len, pair * len);
            let (joined, rest) = self.buckets.split_at_mut((2 * pair + 1) * len);
            for row in rest[..len].chunks_exact(width) {
                take(&mut joined[pair * len..][..len], row);
            }
        }
        self.buckets.truncate(BUCKETS / 2 * len);
        self.capacity *= 2;
    }

    /// The recording so far.
    pub fn recording(&self) -> Recording {
        let mut numbers = self.whole.clone();
        let (mut rows, width): (Vec<&[f64]>, usize) = (Vec::new(), self.last.len());
        for bucket in self.buckets.chunks_exact((2 * self.slots.len() + 1) * width) {
            rows.clear();
            rows.extend(bucket.chunks_exact(width));
            rows.sort_by(|a, b| a[0].total_cmp(&b[0]));
            rows.dedup_by_key(|row| row[0]);
            numbers.extend(rows.iter().flat_map(|row| &row[1..]));
        }
        let last_is_kept = self.last[1] >= self.window.0 && self.last[1] <= self.window.1;
        if self.seen > 0 && last_is_kept && !numbers.ends_with(&self.last[1..]) {
            numbers.extend(&self.last[1..]);
        }
        Recording { columns: self.columns.clone(), numbers, seen: self.seen }
    }
}

/// Replaces the rows of a bucket for which a later row is a new extreme.
fn take(bucket: &mut [f64], row: &[f64]) {
    let width = row.len();
    let (_, pairs) = bucket.split_at_mut(width);
    for (column, pair) in (2..).zip(pairs.chunks_exact_mut(2 * width)) {
        let (min, max) = pair.split_at_mut(width);
        if row[column] < min[column] {
            min.copy_from_slice(row);
        }
        if row[column] > max[column] {
            max.copy_from_slice(row);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::plan::View;

    /// A recorder of two quantities, in slots 3 and 4.
    fn recorder() -> Recorder {
        let series =
            |label: &str, slot| Series { label: label.into(), slot: Slot(slot), unit: Unit::none(), boolean: false };
        Recorder::new(
            &[
                Plot { series: vec![series("a", 3), series("b", 4)], against: None, view: View::default() },
                Plot { series: vec![series("a", 3)], against: Some(series("b", 4)), view: View::default() },
            ],
            &[],
        )
    }

    fn record(points: u64, quantities: impl Fn(f64) -> (f64, f64)) -> Recording {
        let mut recorder = recorder();
        for n in 0..points {
            let (a, b) = quantities(n as f64);
            recorder.see(n as f64, &[0.0, 0.0, 0.0, a, b]);
        }
        recorder.recording()
    }

    #[test]
    fn few_points_are_kept_whole() {
        let recording = record(WHOLE as u64, |n| (n.sin(), n.cos()));
        assert_eq!(recording.rows().len(), WHOLE);
        assert_eq!(recording.columns().len(), 2);
        assert_eq!(recording.points(1).nth(7), Some((7.0, 7f64.cos())));
    }

    #[test]
    fn decimation_keeps_spikes_ends_and_a_thousand_rows() {
        let spikes = |n: f64| (if n == 777_777.0 { 5.0 } else { n / 1e6 }, if n == 123_456.0 { -9.0 } else { 0.0 });
        let recording = record(1_000_000, spikes);
        let times: Vec<f64> = recording.rows().map(|row| row[0]).collect();
        assert!(times.is_sorted_by(|a, b| a < b));
        assert!((1000..=5 * BUCKETS).contains(&times.len()), "{} rows", times.len());
        assert_eq!((times[0], *times.last().unwrap()), (0.0, 999_999.0));
        assert!(recording.points(0).any(|point| point == (777_777.0, 5.0)));
        assert!(recording.points(1).any(|point| point == (123_456.0, -9.0)));
        assert_eq!(recording.seen(), 1_000_000);
    }

    #[test]
    fn the_least_number_of_rows_is_kept_at_every_length() {
        // A constant keeps only the first row of each bucket: the worst case.
        let mut recorder = recorder();
        for n in 0..40_000u64 {
            recorder.see(n as f64, &[0.0; 5]);
            if n % 997 == 0 {
                assert!(recorder.recording().rows().len() as u64 >= 1000.min(n + 1));
            }
        }
    }

    #[test]
    fn both_sides_of_an_event_are_rows() {
        let mut recorder = recorder();
        for (t, a) in [(0.0, 1.0), (1.0, 2.0), (1.0, -2.0), (2.0, -2.0)] {
            recorder.see(t, &[0.0, 0.0, 0.0, a, 0.0]);
        }
        let recording = recorder.recording();
        assert_eq!(recording.points(0).collect::<Vec<_>>(), [(0.0, 1.0), (1.0, 2.0), (1.0, -2.0), (2.0, -2.0)]);
    }
}
