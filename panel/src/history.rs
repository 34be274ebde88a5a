//! Signals on a grid of cycles, with their extremes at every scale.
//!
//! In: values of all signals, a cycle at a time. Out: for any window the extremes of each column, in the order of time.
//! Memory is bounded: the oldest chunks go first. A chunk of 8⁴ cycles holds its values and four levels of extremes,
//! each over 8 of those below, so a column of any width costs a few dozen look-ups.

use std::collections::VecDeque;
use std::ops::Range;

/// Cycles, or extremes of the level below, under one extreme.
const FAN: usize = 8;
/// Levels of a chunk.
const LEVELS: u32 = 4;
/// Cycles of a chunk: 8⁴.
pub const CHUNK: usize = FAN.pow(LEVELS);

/// Least and greatest value of some cycles.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Extremes {
    least: f64,
    greatest: f64,
    /// The least value came first.
    rises: bool,
}

impl Extremes {
    /// Of no cycle, or only of gaps.
    const NONE: Extremes = Extremes { least: f64::INFINITY, greatest: f64::NEG_INFINITY, rises: true };

    fn of(value: f64) -> Extremes {
        if value.is_nan() { Extremes::NONE } else { Extremes { least: value, greatest: value, rises: true } }
    }

    /// Of these cycles and of later ones.
    fn then(self, later: Extremes) -> Extremes {
        let (lower, higher) = (later.least < self.least, later.greatest > self.greatest);
        Extremes {
            least: if lower { later.least } else { self.least },
            greatest: if higher { later.greatest } else { self.greatest },
            rises: match (lower, higher) {
                (false, false) => self.rises,
                (true, true) => later.rises,
                (lower, _) => !lower,
            },
        }
    }

    /// In the order of time; NaN if there is none.
    fn pair(self) -> (f64, f64) {
        match (self.least > self.greatest, self.rises) {
            (true, _) => (f64::NAN, f64::NAN),
            (false, true) => (self.least, self.greatest),
            (false, false) => (self.greatest, self.least),
        }
    }
}

/// One signal in a chunk.
struct Course {
    values: Vec<f64>,
    /// Level 0 over 8 values, level 1 over 64 …; one entry for each that has begun.
    levels: [Vec<Extremes>; LEVELS as usize],
}

/// Consecutive cycles.
struct Chunk {
    /// Its first cycle divided by [`CHUNK`].
    index: u64,
    courses: Vec<Course>,
}

/// The recent past of some signals.
pub struct History {
    signals: usize,
    chunks: VecDeque<Chunk>,
    most: usize,
    newest: Option<u64>,
}

impl History {
    /// An empty history of this many signals in about this many bytes; never less than two chunks.
    pub fn new(signals: usize, bytes: u64) -> History {
        let course = 8.0 * CHUNK as f64 + size_of::<Extremes>() as f64 * CHUNK as f64 / (FAN as f64 - 1.0);
        let most = (bytes as f64 / (course * signals.max(1) as f64)) as usize;
        History { signals, chunks: VecDeque::new(), most: most.max(2), newest: None }
    }

    /// Adds a cycle. Cycles left out are gaps, and a cycle that is not later than the newest is ignored.
    ///
    /// # Panics
    /// If there is not one value for each signal.
    pub fn push(&mut self, cycle: u64, values: &[f64]) {
        assert_eq!(values.len(), self.signals, "a value for each signal");
        if self.newest.is_some_and(|newest| cycle <= newest) {
            return;
        }
        self.newest = Some(cycle);
        let (index, at) = (cycle / CHUNK as u64, (cycle % CHUNK as u64) as usize);
        if self.chunks.back().is_none_or(|chunk| chunk.index != index) {
            if self.chunks.len() == self.most {
                self.chunks.pop_front();
            }
            let course = |_| Course {
                values: Vec::with_capacity(CHUNK),
                levels: std::array::from_fn(|level| Vec::with_capacity(CHUNK / FAN.pow(level as u32 + 1))),
            };
            self.chunks.push_back(Chunk { index, courses: (0..self.signals).map(course).collect() });
        }
        let chunk = self.chunks.back_mut().expect("it was just made");
        for (course, value) in chunk.courses.iter_mut().zip(values) {
            while course.values.len() < at {
                course.push(f64::NAN);
            }
            course.push(*value);
        }
    }

    /// The cycles that it holds; gaps among them.
    pub fn cycles(&self) -> Range<u64> {
        match (self.chunks.front(), self.newest) {
            (Some(first), Some(newest)) => first.index * CHUNK as u64..newest + 1,
            _ => 0..0,
        }
    }

    /// The value of a signal at a cycle; NaN in a gap.
    pub fn value(&self, signal: usize, cycle: u64) -> f64 {
        self.extremes(signal, cycle..cycle + 1).least_or_nan()
    }

    /// The extremes of a signal in columns of `width` cycles, in the order of time: the pair of column `first`, and of
    /// those after it. Columns count from cycle 0, so that they are the same at every offset of a window.
    pub fn columns(&self, signal: usize, first: u64, count: usize, width: u64) -> Vec<(f64, f64)> {
        // Columns rise, and so do the chunks in which they begin.
        let mut place = self.chunk_of(first * width);
        let column = |i: usize| {
            let begin = (first + i as u64) * width;
            while self.chunks.get(place).is_some_and(|chunk| (chunk.index + 1) * CHUNK as u64 <= begin) {
                place += 1;
            }
            self.extremes_from(place, signal, begin..begin + width).pair()
        };
        (0..count).map(column).collect()
    }

    /// The place of the first chunk that ends after a cycle.
    fn chunk_of(&self, cycle: u64) -> usize {
        self.chunks.partition_point(|chunk| (chunk.index + 1) * CHUNK as u64 <= cycle)
    }

    fn extremes(&self, signal: usize, window: Range<u64>) -> Extremes {
        self.extremes_from(self.chunk_of(window.start), signal, window)
    }

    /// Of a window whose first chunk is at this place.
    fn extremes_from(&self, begin: usize, signal: usize, window: Range<u64>) -> Extremes {
        let mut found = Extremes::NONE;
        for chunk in self.chunks.range(begin.min(self.chunks.len())..) {
            let start = chunk.index * CHUNK as u64;
            if start >= window.end {
                break;
            }
            let (from, to) = (window.start.max(start) - start, (window.end - start).min(CHUNK as u64));
            found = found.then(chunk.courses[signal].extremes(from as usize, to as usize));
        }
        found
    }
}

impl Extremes {
    fn least_or_nan(self) -> f64 {
        if self.least > self.greatest { f64::NAN } else { self.least }
    }
}

impl Course {
    fn push(&mut self, value: f64) {
        let at = self.values.len();
        self.values.push(value);
        let own = Extremes::of(value);
        let mut span = FAN;
        for level in &mut self.levels {
            if at.is_multiple_of(span) {
                level.push(own);
            } else {
                let last = level.last_mut().expect("it began with its first cycle");
                *last = last.then(own);
            }
            span *= FAN;
        }
    }

    /// Of cycles `from` to before `to`: the largest aligned pieces first to last.
    fn extremes(&self, from: usize, to: usize) -> Extremes {
        let to = to.min(self.values.len());
        let (mut at, mut found) = (from, Extremes::NONE);
        while at < to {
            // The highest level whose entry begins here and ends within the window.
            let (mut span, mut piece) = (1, Extremes::of(self.values[at]));
            for (level, entries) in self.levels.iter().enumerate() {
                let wider = FAN.pow(level as u32 + 1);
                if !at.is_multiple_of(wider) || at + wider > to {
                    break;
                }
                (span, piece) = (wider, entries[at / wider]);
            }
            found = found.then(piece);
            at += span;
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A generator of the tests: xorshift.
    struct Chance(u64);

    impl Chance {
        fn next(&mut self) -> u64 {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            self.0
        }
        fn below(&mut self, n: u64) -> u64 {
            self.next() % n
        }
    }

    /// The pair of a window by going through its cycles.
    fn by_hand(values: &[(u64, f64)], window: Range<u64>) -> (f64, f64) {
        let mut inside = values.iter().filter(|(cycle, value)| window.contains(cycle) && !value.is_nan());
        let Some(first) = inside.next() else { return (f64::NAN, f64::NAN) };
        let (mut least, mut greatest) = (*first, *first);
        for one in inside {
            least = if one.1 < least.1 { *one } else { least };
            greatest = if one.1 > greatest.1 { *one } else { greatest };
        }
        if least.0 <= greatest.0 { (least.1, greatest.1) } else { (greatest.1, least.1) }
    }

    fn same(a: (f64, f64), b: (f64, f64)) -> bool {
        [(a.0, b.0), (a.1, b.1)].iter().all(|(a, b)| a == b || a.is_nan() && b.is_nan())
    }

    #[test]
    fn columns_are_those_of_brute_force_in_random_windows() {
        for seed in 1..=30 {
            let mut chance = Chance(seed * 0x9e37_79b9);
            let mut history = History::new(1, u64::MAX / 4);
            let (mut cycle, mut all) = (chance.below(3 * CHUNK as u64), Vec::new());
            for _ in 0..chance.below(12_000) + 1 {
                let value = match chance.below(20) {
                    0 => f64::NAN,
                    _ => chance.below(50) as f64 - 25.0,
                };
                history.push(cycle, &[value]);
                all.push((cycle, value));
                cycle += if chance.below(300) == 0 { chance.below(6000) } else { 1 }.max(1);
            }
            for _ in 0..60 {
                let width = [1, 2, 3, 7, 8, 50, 64, 777, 4096, 9999][chance.below(10) as usize];
                let first = chance.below(cycle / width + 2);
                let columns = history.columns(0, first, 3, width);
                for (i, found) in columns.iter().enumerate() {
                    let begin = (first + i as u64) * width;
                    let wanted = by_hand(&all, begin..begin + width);
                    assert!(
                        same(*found, wanted),
                        "seed {seed}: {width} cycles from {begin}: {found:?}, not {wanted:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn columns_do_not_depend_on_the_offset_of_the_window() {
        let mut history = History::new(2, u64::MAX / 4);
        let mut chance = Chance(5);
        (0..30_000).for_each(|cycle| history.push(cycle, &[chance.below(1000) as f64, cycle as f64]));
        let whole = history.columns(0, 0, 600, 50);
        for offset in 0..200 {
            assert_eq!(history.columns(0, offset, 400, 50), whole[offset as usize..offset as usize + 400]);
        }
        // Pairs of a rising signal rise, so one polyline through all of them has no steps back.
        assert!(history.columns(1, 0, 600, 50).iter().all(|(a, b)| a < b));
    }

    #[test]
    fn memory_is_bounded_and_the_newest_cycles_are_kept() {
        let mut history = History::new(3, 1);
        for cycle in 0..20 * CHUNK as u64 {
            history.push(cycle, &[cycle as f64, 0.0, 1.0]);
            assert!(history.chunks.len() <= 2);
        }
        assert_eq!(history.cycles(), 18 * CHUNK as u64..20 * CHUNK as u64);
        assert_eq!(history.value(0, 19 * CHUNK as u64), 19.0 * CHUNK as f64);
        assert!(history.value(0, 0).is_nan() && history.value(0, 21 * CHUNK as u64).is_nan());
        // A cycle of the past does not change it.
        history.push(3, &[0.0; 3]);
        assert_eq!(history.cycles().end, 20 * CHUNK as u64);
    }
}
