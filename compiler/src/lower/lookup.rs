//! Table lookup: places tables in the pool, and generates the operations that interpolate them.
//!
//! In: the points of a table. Out: its numbers in the pool, and operations that find the interval by binary search and
//! evaluate its line or cubic. Beyond the ends the table is constant. All numbers of an interval are adjacent in
//! memory.

use crate::frontend::system::Table;
use crate::ir::Value;
use crate::ir::build::Build;

/// A table in the pool.
pub struct Lookup {
    /// x of the first point, x of the last point, and y of the last point.
    first: f64,
    last: f64,
    end: f64,
    smooth: bool,
    /// Number of comparisons of the binary search.
    comparisons: u32,
    /// Index of the table in the pool: the starts of the intervals, then their rows.
    start: u32,
}

/// Length of a row as a power of two. A line has start, width, value and rise; a cubic has start, width, value and the
/// coefficients of s, s² and s³.
const LINE: u8 = 2;
const CUBIC: u8 = 3;

impl Lookup {
    /// Appends tables to the pool, in their order.
    pub fn place_all(tables: &[Table], pool: &mut Vec<f64>) -> Vec<Lookup> {
        tables.iter().map(|table| Lookup::place(table, pool)).collect()
    }

    /// Appends a table with at least one point to the pool.
    fn place(table: &Table, pool: &mut Vec<f64>) -> Lookup {
        let Table { x, y, smooth, held, .. } = table;
        let n = x.len();
        let intervals = n - 1;
        let rows = intervals.next_power_of_two();
        let lookup = Lookup {
            first: x[0],
            last: x[n - 1],
            end: y[n - 1],
            smooth: *smooth,
            comparisons: rows.trailing_zeros(),
            start: pool.len() as u32,
        };
        if intervals == 0 {
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
        if self.first == self.last {
            return end;
        }
        let rows = 1 << self.comparisons;
        let mut row = build.int(0);
        for comparison in (0..self.comparisons).rev() {
            let stride = build.int(1 << comparison);
            let probe = build.int_add(row, stride);
            let begins = build.pool(self.start, rows, probe);
            let is_beyond = build.less_equal(begins, x);
            row = build.select(is_beyond, probe, row);
        }
        let numbers = if self.smooth { CUBIC } else { LINE };
        let at = build.shift_left(row, numbers);
        let number = |k: u32, build: &mut Build| build.pool(self.start + rows + k, ((rows - 1) << numbers) + 1, at);
        let clamped = build.clamp(x, first, last);
        let [begin, width, value] = [0, 1, 2].map(|k| number(k, build));
        let offset = build.sub(clamped, begin);
        let s = build.div(offset, width);
        let coefficients = if self.smooth { 3..6 } else { 3..4 };
        let mut sum = None;
        for k in coefficients.rev() {
            let coefficient = number(k, build);
            let inner = sum.map_or(coefficient, |sum| build.add(coefficient, sum));
            sum = Some(build.mul(s, inner));
        }
        let value = build.add(value, sum.expect("there is a coefficient"));
        // The last point belongs to no interval.
        let ends = build.less_equal(last, clamped);
        build.select(ends, end, value)
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
        let lookup = Lookup::place(&table, &mut pool);
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
