//! Table lookup: places tables in the pool, and generates the operations that interpolate them.
//!
//! In: the points of a table. Out: its numbers in the pool, and operations that find the interval by binary search and
//! evaluate its line or cubic. Beyond the ends the table is constant. All numbers of an interval are adjacent in
//! memory. A recording with even rows has its values alone in the pool, and the interval follows from the time by a
//! division: a tenth of the memory, and the same bits. Rows are rarely multiples of one interval to the last bit: 0.009 is
//! not nine times 0.001. The times of those that are nearly even are in the pool too, once for all columns.

use crate::frontend::system::Table;
use crate::ir::Value;
use crate::ir::build::Build;
use std::sync::Arc;

/// A table in the pool.
pub struct Lookup {
    /// x of the first point, x of the last point, and y of the last point.
    first: f64,
    last: f64,
    end: f64,
    /// Index of the table in the pool.
    start: u32,
    find: Find,
}

/// How the interval of an argument is found.
enum Find {
    /// By binary search with so many comparisons. The pool has the starts of the intervals, then their rows.
    Search { comparisons: u32, smooth: bool },
    /// Point k lies at k · `width` or, with `times`, less than a third of that from x₀ + k · `width`. The pool has the values.
    Divide { width: f64, points: u32, held: bool, times: Option<u32> },
    /// The pool does not have it.
    Absent,
}

/// Times of recordings that are in the pool, and where.
type Times = Vec<(Arc<[f64]>, u32)>;

/// Length of a row as a power of two. A line has start, width, value and rise; a cubic has start, width, value and the
/// coefficients of s, s² and s³.
const LINE: u8 = 2;
const CUBIC: u8 = 3;

impl Lookup {
    /// Appends tables to the pool, in their order.
    pub fn place_all(tables: &[Table], pool: &mut Vec<f64>) -> Vec<Lookup> {
        let mut times = Times::new();
        tables.iter().map(|table| Lookup::place(table, pool, &mut times)).collect()
    }

    /// The same for expressions that depend on parameters alone. Recordings are read at times, so they are left out: at any
    /// argument they are NaN.
    pub fn place_all_but_recordings(tables: &[Table], pool: &mut Vec<f64>) -> Vec<Lookup> {
        let place = |table: &Table| match table.is_recorded() {
            true => Lookup { find: Find::Absent, ..Lookup::of(table, pool.len()) },
            false => Lookup::place(table, pool, &mut Times::new()),
        };
        tables.iter().map(place).collect()
    }

    /// A table with at least one point, at this place of the pool.
    fn of(table: &Table, start: usize) -> Lookup {
        let Table { x, y, smooth, held, .. } = table;
        let n = x.len();
        // Arguments of other tables may be states, whose sums later passes regroup.
        let is_divided = table.is_recorded() && !smooth && n > 1;
        let deviation = |width: f64, begin: f64| {
            let off = |(k, x): (usize, &f64)| (x - (begin + k as f64 * width)).abs();
            x.iter().enumerate().map(off).fold(0.0, f64::max)
        };
        let even = || (x[n - 1] - x[0]) / (n - 1) as f64;
        let divide = |width, times| Find::Divide { width, points: n as u32, held: *held, times };
        let find = match is_divided {
            true if deviation(x[1], 0.0) == 0.0 => divide(x[1], None),
            true if deviation(even(), x[0]) < even() / 3.0 => divide(even(), Some(0)),
            _ => Find::Search { comparisons: (n - 1).next_power_of_two().trailing_zeros(), smooth: *smooth },
        };
        Lookup { first: x[0], last: x[n - 1], end: y[n - 1], start: start as u32, find }
    }

    /// Appends a table with at least one point to the pool. Columns of one recording share their times.
    fn place(table: &Table, pool: &mut Vec<f64>, shared: &mut Times) -> Lookup {
        let Table { x, y, smooth, held, .. } = table;
        let intervals = x.len() - 1;
        let rows = intervals.next_power_of_two();
        let mut lookup = Lookup::of(table, pool.len());
        if intervals == 0 {
            return lookup;
        }
        if let Find::Divide { times, .. } = &mut lookup.find {
            pool.reserve_exact(y.len());
            pool.extend_from_slice(y);
            if let Some(times) = times {
                *times = match shared.iter().find(|(known, _)| Arc::ptr_eq(known, x)) {
                    Some((_, at)) => *at,
                    None => {
                        let at = pool.len() as u32;
                        shared.push((x.clone(), at));
                        pool.reserve_exact(x.len());
                        pool.extend_from_slice(x);
                        at
                    }
                };
            }
            return lookup;
        }
        // Padding intervals start at ∞, so that no finite number falls into them. ∞ itself does; the last row handles
        // it.
        pool.extend((0..rows).map(|k| if k < intervals { x[k] } else { f64::INFINITY }));
        let slopes = if *smooth { monotone_slopes(x, y) } else { Vec::new() };
        for k in (0..rows).map(|k| k.min(intervals - 1)) {
            let (width, rise) = (x[k + 1] - x[k], y[k + 1] - y[k]);
            pool.extend([x[k], width, y[k]]);
            if *smooth {
                // Hermite: y0 + s (m0 + s (3 Δ − 2 m0 − m1 + s (m0 + m1 − 2 Δ))), slopes m scaled by the width.
                let (m0, m1) = (slopes[k] * width, slopes[k + 1] * width);
                pool.extend([m0, 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise, 0.0, 0.0]);
            } else {
                pool.push(if *held { 0.0 } else { rise });
            }
        }
        lookup
    }

    /// The table at x. For NaN it is NaN (unless the table has one point).
    pub fn at(&self, x: Value, build: &mut Build) -> Value {
        let [first, last, end] = [self.first, self.last, self.end].map(|number| build.real(number));
        let clamped = |build: &mut Build| build.clamp(x, first, last);
        let value = match self.find {
            Find::Absent => return build.real(f64::NAN),
            Find::Search { .. } | Find::Divide { .. } if self.first == self.last => return end,
            Find::Search { comparisons, smooth } => self.searched(x, &clamped, (comparisons, smooth), build),
            Find::Divide { width, points, held, times } => self.divided(&clamped, (width, points, held), times, build),
        };
        let clamped = clamped(build);
        // The last point belongs to no interval.
        let ends = build.less_equal(last, clamped);
        build.select(ends, end, value)
    }

    /// The value in the interval that a binary search finds.
    fn searched(
        &self,
        x: Value,
        clamped: &dyn Fn(&mut Build) -> Value,
        (comparisons, smooth): (u32, bool),
        build: &mut Build,
    ) -> Value {
        let rows = 1 << comparisons;
        let mut row = build.int(0);
        for comparison in (0..comparisons).rev() {
            let stride = build.int(1 << comparison);
            let probe = build.int_add(row, stride);
            let begins = build.pool(self.start, rows, probe);
            let is_beyond = build.less_equal(begins, x);
            row = build.select(is_beyond, probe, row);
        }
        let numbers = if smooth { CUBIC } else { LINE };
        let at = build.shift_left(row, numbers);
        let number = |k: u32, build: &mut Build| build.pool(self.start + rows + k, ((rows - 1) << numbers) + 1, at);
        let clamped = clamped(build);
        let [begin, width, value] = [0, 1, 2].map(|k| number(k, build));
        let offset = build.sub(clamped, begin);
        let s = build.div(offset, width);
        let coefficients = if smooth { 3..6 } else { 3..4 };
        let mut sum = None;
        for k in coefficients.rev() {
            let coefficient = number(k, build);
            let inner = sum.map_or(coefficient, |sum| build.add(coefficient, sum));
            sum = Some(build.mul(s, inner));
        }
        build.add(value, sum.expect("there is a coefficient"))
    }

    /// The value in interval ⌊(x − x₀) / width⌋. Rounding, and times that are not quite even, may miss the interval by one, so
    /// the ends of three are compared; they are the numbers that a search would find in the pool, and so all bits are the same.
    fn divided(
        &self,
        clamped: &dyn Fn(&mut Build) -> Value,
        (width, points, held): (f64, u32, bool),
        times: Option<u32>,
        build: &mut Build,
    ) -> Value {
        /// A whole number below 2^52 added to this has its binary digits in the last 52 bits.
        const WHOLE: f64 = 4_503_599_627_370_496.0;
        let x = clamped(build);
        let [first, one, scale, inverse] = [self.first, 1.0, width, 1.0 / width].map(|number| build.real(number));
        let (whole, digits) = (build.real(WHOLE), build.int((1 << 52) - 1));
        let row = |k: Value, build: &mut Build| {
            let sum = build.add(k, whole);
            let bits = build.to_bits(sum);
            build.int_and(bits, digits)
        };
        let passed = if times.is_some() { build.sub(x, first) } else { x };
        let quotient = build.mul(passed, inverse);
        let guess = build.floor(quotient);
        // Where point k lies, from its number or its row.
        let end = |k: Value, build: &mut Build| match times {
            None => build.mul(k, scale),
            Some(at) => {
                let row = row(k, build);
                build.pool(at, points, row)
            }
        };
        let [before, after] = [build.sub(guess, one), build.add(guess, one)];
        let [begin, next] = [guess, after].map(|k| end(k, build));
        let (is_before, is_after) = (build.less(x, begin), build.less_equal(next, x));
        let rest = build.select(is_after, after, guess);
        let k = build.select(is_before, before, rest);
        let second = build.add(k, one);
        let [begin, end] = [k, second].map(|k| end(k, build));
        let row = row(k, build);
        let value = build.pool(self.start, points, row);
        let rise = if held {
            build.real(0.0)
        } else {
            let next = build.pool(self.start + 1, points - 1, row);
            build.sub(next, value)
        };
        let (offset, width) = (build.sub(x, begin), build.sub(end, begin));
        let s = build.div(offset, width);
        let part = build.mul(s, rise);
        build.add(value, part)
    }
}

/// Slopes at the points, such that the cubics between them are monotone where the points are.
///
/// Source: Fritsch, Butland, SIAM J. Sci. Stat. Comput. 5 (1984), eq. 6, with one-sided slopes at the ends.
fn monotone_slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let n = x.len();
    let secant = |k: usize| (y[k + 1] - y[k]) / (x[k + 1] - x[k]);
    (0..n)
        .map(|k| {
            if n == 1 {
                0.0
            } else if k == 0 {
                secant(0)
            } else if k == n - 1 {
                secant(n - 2)
            } else {
                let (a, b) = (secant(k - 1), secant(k));
                if a * b <= 0.0 {
                    return 0.0;
                }
                let (h, g) = (x[k] - x[k - 1], x[k + 1] - x[k]);
                let alpha = (h + 2.0 * g) / (3.0 * (h + g));
                a * b / (alpha * b + (1.0 - alpha) * a)
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret;
    use abi::Slot;
    use abi::unit::{Dimension, Unit};

    /// A table of n points (k², (k − 2)³), read at x.
    fn read(n: usize, smooth: bool, x: f64) -> f64 {
        read_of(n, (smooth, false), x)
    }

    fn read_of(n: usize, (smooth, held): (bool, bool), x: f64) -> f64 {
        let points = || (0..n).map(|k| k as f64);
        let dimension = Dimension::NONE;
        let table = Table {
            name: "table".into(),
            x_unit: Unit::si(dimension),
            y_unit: Unit::si(dimension),
            smooth,
            held,
            x: points().map(|k| k * k).collect(),
            y: points().map(|k| (k - 2.0) * (k - 2.0) * (k - 2.0)).collect(),
        };
        let mut pool = vec![7.0; 3];
        let lookup = Lookup::place(&table, &mut pool, &mut Times::new());
        let mut build = Build::new("read");
        let at = build.load(Slot(3));
        let value = lookup.at(at, &mut build);
        build.store(Slot(4), value);
        let mut block = vec![0.0, 0.0, 0.0, x, 0.0];
        interpret::run_once(&build.finish(), &mut block, &pool);
        block[4]
    }

    #[test]
    fn tables_interpolate_their_points_and_are_constant_beyond_the_ends() {
        for (n, smooth) in (1..20).flat_map(|n| [(n, false), (n, true)]) {
            let y = |k: usize| (k as f64 - 2.0).powi(3);
            for k in 0..n {
                assert_eq!(read(n, smooth, (k * k) as f64), y(k), "point {k} of {n}, smooth: {smooth}");
            }
            for (x, held) in [(-1.0, 0), (f64::NEG_INFINITY, 0), (1e9, n - 1), (f64::INFINITY, n - 1)] {
                assert_eq!(read(n, smooth, x), y(held), "at {x} of {n}, smooth: {smooth}");
            }
            assert_eq!(read(n, smooth, f64::NAN).is_nan(), n > 1);
            for k in 1..n {
                let x = 0.25 * ((k - 1) * (k - 1)) as f64 + 0.75 * (k * k) as f64;
                let (value, line) = (read(n, smooth, x), 0.25 * y(k - 1) + 0.75 * y(k));
                if smooth {
                    assert!((y(k - 1)..=y(k)).contains(&value), "it rises where the points do: {value} at {x} of {n}");
                } else {
                    assert!((value - line).abs() < 1e-12, "a line between two points: {value} at {x} of {n}");
                }
            }
        }
    }

    /// A recording with even or nearly even rows, read at its rows, beside them and between them, has the bits of one that is
    /// searched. Mutants, each fails: without `is_before`; without `is_after`; the width as written in place of the
    /// difference; rows up to 0.6 intervals off.
    #[test]
    fn even_recordings_have_the_bits_of_those_that_are_searched() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(5);
        let mut random = crate::ir::random::Random(seed);
        let dimension = Dimension::NONE;
        for case in 0..120 {
            let (n, width) = (2 + random.below(3000), random.within(1e-5, 1e-1));
            let table = |name: &str, x: Vec<f64>, y: &[f64], held| Table {
                name: name.into(),
                x_unit: Unit::si(dimension),
                y_unit: Unit::si(dimension),
                smooth: false,
                held,
                x: x.into(),
                y: y.into(),
            };
            let begin = random.within(-10.0, 10.0);
            let x: Vec<f64> = match case % 4 {
                0 => (0..n).map(|k| k as f64 * width).collect(),
                // Decimals, as in a file, and from another instant on.
                1 => (0..n).map(|k| k as f64 / 1000.0).collect(),
                2 => (0..n).map(|k| begin + k as f64 / 1000.0).collect(),
                _ => (0..n).map(|k| begin + (k as f64 + random.within(-0.16, 0.16)) * width).collect(),
            };
            let y: Vec<f64> = (0..n).map(|_| random.within(-1.0, 1.0)).collect();
            let held = random.below(2) == 0;
            let function = |name: &str| {
                let mut pool = vec![7.0; 3];
                let lookup = Lookup::place(&table(name, x.clone(), &y, held), &mut pool, &mut Times::new());
                let is_even = matches!(lookup.find, Find::Divide { .. });
                let mut build = Build::new("read");
                let at = build.load(Slot(3));
                let value = lookup.at(at, &mut build);
                build.store(Slot(4), value);
                (build.finish(), pool, is_even)
            };
            let (even, searched) = (function("data.v"), function("v"));
            assert!(even.2 && !searched.2, "seed {seed}, case {case}");
            let is_multiple = x.iter().enumerate().all(|(k, x_k)| *x_k == k as f64 * x[1]);
            assert_eq!(even.1.len(), 3 + if is_multiple { n } else { 2 * n }, "seed {seed}, case {case}");
            let width = x[1] - x[0];
            let beside = |x: f64| [x, x.next_up(), x.next_down(), x + 0.37 * width, x + 0.5 * width];
            let some = (0..40).map(|_| x[random.below(n)]).flat_map(beside).collect::<Vec<f64>>();
            let ends = [0.0, -1.0, f64::INFINITY, f64::NEG_INFINITY, f64::NAN, x[n - 1], x[n - 1] + 1.0];
            for x in some.into_iter().chain(ends.into_iter().flat_map(beside)) {
                let read = |(func, pool, _): &(crate::ir::Func, Vec<f64>, bool)| {
                    let mut block = vec![0.0, 0.0, 0.0, x, 0.0];
                    interpret::run_once(func, &mut block, pool);
                    block[4]
                };
                let (a, b) = (read(&even), read(&searched));
                let alike = a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
                assert!(alike, "seed {seed}, case {case}: {a} and {b} at {x} of {n} rows every {width}, held: {held}");
            }
        }
    }

    /// Columns of one recording share their times; rows that are far from even are searched.
    #[test]
    fn times_are_in_the_pool_once() {
        let x: Arc<[f64]> = (0..10).map(|k| f64::from(k) / 1000.0).collect();
        let column = |x: &Arc<[f64]>| {
            let (unit, y) = (Unit::si(Dimension::NONE), x.clone());
            let name = "data.v".into();
            Table { name, x_unit: unit.clone(), y_unit: unit, smooth: false, held: false, x: x.clone(), y }
        };
        let mut pool = Vec::new();
        Lookup::place_all(&[column(&x), column(&x)], &mut pool);
        assert_eq!(pool.len(), 30);
        let uneven: Arc<[f64]> = [0.0, 1.0, 2.0, 5.0].into();
        let lookup = Lookup::place(&column(&uneven), &mut pool, &mut Times::new());
        assert!(matches!(lookup.find, Find::Search { .. }));
    }

    /// Mutants, each fails: a held table rises; it takes its next value.
    #[test]
    fn held_tables_keep_a_value_up_to_the_next_point() {
        for n in 1..20 {
            let y = |k: usize| (k as f64 - 2.0).powi(3);
            for k in 0..n {
                let (begin, end) = ((k * k) as f64, ((k + 1) * (k + 1)) as f64);
                for x in [begin, 0.5 * (begin + end), end - 1e-9] {
                    assert_eq!(read_of(n, (false, true), x), y(k), "at {x} of {n}");
                }
            }
        }
    }
}
