//! Curves as the rows of a table, for other programs.
//!
//! In: curves and a window. Out: lines of comma-separated values, one for each time at which any of them has a point; a
//! cell is empty where a curve has none there.

use crate::subject::Subject;
use std::collections::BTreeMap;
use std::fmt::Write;

/// Most rows of a table.
pub const MOST: usize = 100_000;

/// The rows from one instant to another, s: time, then the values of the curves.
///
/// # Errors
/// If there are too many.
pub fn rows(subject: &dyn Subject, from: f64, to: f64, curves: &[u32]) -> Result<String, String> {
    let mut all: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for (at, curve) in curves.iter().enumerate() {
        subject.points(*curve, from, &mut |t, y| {
            if (from..=to).contains(&t) && all.len() <= MOST {
                // Times in the order of their numbers; minus 0 is 0.
                let bits = (t + 0.0).to_bits();
                let place = if t < 0.0 { !bits } else { bits | 1 << 63 };
                all.entry(place).or_insert_with(|| vec![f64::NAN; curves.len()])[at] = y;
            }
            t <= to && all.len() <= MOST
        });
    }
    if all.len() > MOST {
        return Err(format!("more than {MOST} rows lie between the cursors: move them, or use `fric replay --csv`"));
    }
    let mut out = String::new();
    for (place, values) in all {
        let t = f64::from_bits(if place >> 63 == 1 { place & !(1 << 63) } else { !place });
        let _ = write!(out, "{t:?}");
        for value in values {
            out.push(',');
            if !value.is_nan() {
                let _ = write!(out, "{value:?}");
            }
        }
        out.push('\n');
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;
    use crate::line::View;
    use crate::subject::Page;
    use serde_json::Value;

    /// Curves of random points.
    struct Curves(Vec<Vec<(f64, f64)>>);

    impl Subject for Curves {
        fn hello(&self) -> (u64, Value) {
            (1, Value::Null)
        }
        fn state(&self) -> (u64, Value) {
            (1, Value::Null)
        }
        fn numbers(&self) -> (u64, u64) {
            (self.hello().0, self.state().0)
        }
        fn version(&self) -> u64 {
            0
        }
        fn newest(&self) -> f64 {
            0.0
        }
        fn blocks(&self, _: &View, _: Option<u64>, _: &mut Frame) {}
        fn points(&self, curve: u32, _: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
            self.0[curve as usize].iter().all(|(t, y)| each(*t, *y));
        }
        fn say(&self, _: Page, _: &str) -> Result<String, String> {
            Err("no".into())
        }
    }

    /// Every point inside is in its row, to the bit, and nothing else is; times rise.
    ///
    /// Mutants tried: a row at either end left out; negative times in the order of their bits.
    #[test]
    fn the_rows_are_the_points_between_the_cursors() {
        for seed in 1..=500_u64 {
            let mut state = seed;
            let mut chance = || (abi::random::next(&mut state) >> 11) as f64 / (1_u64 << 53) as f64;
            let curves: Vec<Vec<(f64, f64)>> = (0..3)
                .map(|_| {
                    let mut t = -2.0 + 0.25 * (8.0 * chance()).floor();
                    let points = (0..40).map(|_| {
                        t += 0.25 * (1.0 + (3.0 * chance()).floor());
                        (t, if chance() < 0.1 { f64::NAN } else { chance() - 0.5 })
                    });
                    points.collect()
                })
                .collect();
            let (from, to) = (-1.0 + 0.25 * (4.0 * chance()).floor(), 3.0 + chance());
            let text = rows(&Curves(curves.clone()), from, to, &[2, 0, 1]).unwrap();
            let mut left: usize =
                curves.iter().flatten().filter(|(t, y)| (from..=to).contains(t) && !y.is_nan()).count();
            let mut before = f64::NEG_INFINITY;
            for line in text.lines() {
                let cells: Vec<&str> = line.split(',').collect();
                let t: f64 = cells[0].parse().unwrap();
                assert!(t > before && cells.len() == 4, "seed {seed}: {line}");
                before = t;
                for (cell, curve) in cells[1..].iter().zip([2, 0, 1]) {
                    let wanted = curves[curve].iter().find(|point| point.0 == t).map(|point| point.1);
                    let wanted = wanted.filter(|y| !y.is_nan());
                    assert_eq!(
                        cell.parse::<f64>().ok().map(f64::to_bits),
                        wanted.map(f64::to_bits),
                        "seed {seed}: {line}"
                    );
                    left -= usize::from(wanted.is_some());
                }
            }
            assert_eq!(left, 0, "seed {seed}");
        }
        let long: Vec<(f64, f64)> = (0..MOST + 5).map(|i| (i as f64, 0.0)).collect();
        assert!(rows(&Curves(vec![long]), 0.0, 1e9, &[0]).is_err_and(|why| why.contains("100000 rows")));
    }
}
