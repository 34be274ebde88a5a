//! What the residuals of a fit say of the model and of the recording.
//!
//! In: residuals as they are and whitened, and other columns of the same rows. Out: on which column they depend, rows
//! that hold most of the error, a beginning that fits badly, gaps between rows. Knows nothing of models.

use crate::fit::quantiles::chi_square_tail;
use crate::fit::unknowns::Elementary;
use std::ops::Range;

/// Most classes into which the values of a column are divided, and fewest rows of a class.
const CLASSES: usize = 10;
const LEAST_OF_CLASS: usize = 20;
/// A dependence is significant below this probability, divided by the number of columns.
const SIGNIFICANT: f64 = 1e-4;
/// A dependence that explains less of the variance is no matter.
const LEAST_SHARE: f64 = 0.05;
/// One that explains more than this is always reported: a slow dependence looks like correlated noise, and whitening
/// removes it.
const MOST: f64 = 0.5;

/// A dependence of residuals on a column.
#[derive(Clone, PartialEq, Debug)]
pub struct Dependence {
    /// Index of the column.
    pub column: usize,
    /// The part of the variance of the residuals that it explains.
    pub share: f64,
    /// Values of the column where the residuals are most different from 0.
    pub class: (f64, f64),
    /// Whether these are the least, or the greatest, values of the column.
    pub edge: (bool, bool),
}

/// The column that explains most of the variance of residuals, if it is significant: the rows are divided into classes by
/// the value of the column, and under independence the sum of squares between the classes is distributed as χ².
///
/// `white`: the whitened residuals, of the last rows. Source: Davidson, MacKinnon, Econometric Theory and Methods,
/// sec. 5.4 (the Wald test of dummies).
pub fn dependence(residuals: &[f64], white: &[f64], columns: &[&[f64]], with: &Elementary) -> Option<Dependence> {
    let first = residuals.len() - white.len();
    let one = |(k, column): (usize, &&[f64])| {
        let classes = classes(column);
        if classes.len() < 2 {
            return None;
        }
        let of_white: Vec<Vec<usize>> = classes
            .iter()
            .map(|class| class.iter().filter(|row| **row >= first).map(|row| row - first).collect())
            .collect();
        let (between, all) = between(white, &of_white);
        let n = white.len() as f64;
        let degrees = classes.len() as f64 - 1.0;
        let probability = chi_square_tail(n * between / all, degrees, with);
        let share = {
            let (between, all) = self::between(residuals, &classes);
            between / all
        };
        let is_significant = probability < SIGNIFICANT / columns.len() as f64;
        if !(is_significant && share > LEAST_SHARE || share > MOST) {
            return None;
        }
        let weight = |class: &Vec<usize>| {
            let sum: f64 = class.iter().map(|row| residuals[*row]).sum();
            sum * sum / class.len() as f64
        };
        let worst = (0..classes.len()).max_by(|a, b| weight(&classes[*a]).total_cmp(&weight(&classes[*b])))?;
        let (low, high) = (column[classes[worst][0]], column[*classes[worst].last()?]);
        Some(Dependence { column: k, share, class: (low, high), edge: (worst == 0, worst + 1 == classes.len()) })
    };
    let found = columns.iter().enumerate().filter_map(one);
    found.max_by(|a, b| a.share.total_cmp(&b.share))
}

/// P(χ² > x) with this number of degrees of freedom.
pub fn tail(x: f64, degrees: f64, with: &Elementary) -> f64 {
    chi_square_tail(x, degrees, with)
}

/// The rows in classes of rising values of a column. Equal values are in one class.
fn classes(column: &[f64]) -> Vec<Vec<usize>> {
    let n = column.len();
    let count = (n / LEAST_OF_CLASS).min(CLASSES);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| column[*a].total_cmp(&column[*b]));
    let mut all: Vec<Vec<usize>> = Vec::new();
    let mut begin = 0;
    for k in 1..=count {
        let mut end = k * n / count;
        while end < n && end > 0 && column[order[end]] == column[order[end - 1]] {
            end += 1;
        }
        if end > begin {
            all.push(order[begin..end].to_vec());
            begin = end;
        }
    }
    all
}

/// The mean square between classes, and that of all rows, about their mean.
fn between(rows: &[f64], classes: &[Vec<usize>]) -> (f64, f64) {
    let n = rows.len() as f64;
    let mean = rows.iter().sum::<f64>() / n;
    let all = rows.iter().map(|r| (r - mean) * (r - mean)).sum::<f64>() / n;
    let of = |class: &Vec<usize>| {
        let count = class.len().max(1) as f64;
        let off = class.iter().map(|row| rows[*row]).sum::<f64>() / count - mean;
        if class.is_empty() { 0.0 } else { count * off * off }
    };
    (classes.iter().map(of).sum::<f64>() / n, all.max(f64::MIN_POSITIVE))
}

/// Whitened residuals beyond this many standard deviations are outliers.
const FAR: f64 = 6.0;
/// Parts of a recording, of which one that holds more than half of the squared error is named.
const TENTHS: usize = 10;

/// Rows that hold much of the error.
#[derive(Clone, PartialEq, Debug)]
pub struct Outliers {
    /// Rows beyond six standard deviations.
    pub rows: Vec<usize>,
    /// A tenth of the rows with more than half of the squared error.
    pub tenth: Option<Range<usize>>,
}

/// Rows that hold much of the error; none if there are no such. The standard deviation is that of the median, which
/// outliers do not move. `white`: the whitened residuals, of the last rows.
pub fn outliers(residuals: &[f64], white: &[f64]) -> Option<Outliers> {
    let first = residuals.len() - white.len();
    let robust = |rows: &[f64]| {
        let mut sizes: Vec<f64> = rows.iter().map(|r| r.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        // Half of a normal variable lies within 0.6745 standard deviations.
        sizes.get(sizes.len() / 2).copied().unwrap_or(0.0) / 0.674_489_75
    };
    let (sd, unfiltered) = (robust(white), robust(residuals));
    // Whitening spreads an outlier over the rows after it.
    let is_far = |k: &usize| white[*k].abs() > FAR * sd && residuals[k + first].abs() > 0.5 * FAR * unfiltered;
    let rows: Vec<usize> = (0..white.len()).filter(|k| sd > 0.0 && is_far(k)).map(|k| k + first).collect();
    let n = residuals.len();
    let all: f64 = residuals.iter().map(|r| r * r).sum();
    let tenths = (0..TENTHS).map(|k| k * n / TENTHS..(k + 1) * n / TENTHS);
    let is_heavy = |rows: &Range<usize>| {
        n >= TENTHS * TENTHS && residuals[rows.clone()].iter().map(|r| r * r).sum::<f64>() > 0.5 * all
    };
    let tenth = tenths.into_iter().find(is_heavy);
    (!rows.is_empty() || tenth.is_some()).then_some(Outliers { rows, tenth })
}

/// Whether the beginning of a recording, a fiftieth of it, fits far worse than the rest: a state may have begun elsewhere.
pub fn begins_badly(residuals: &[f64]) -> bool {
    let n = residuals.len();
    let count = (n / 50).max(5);
    if n < 20 * 5 {
        return false;
    }
    let mean = |rows: &[f64]| rows.iter().map(|r| r * r).sum::<f64>() / rows.len() as f64;
    let (head, rest) = residuals.split_at(count);
    mean(head) > 9.0 * mean(rest)
}

/// Intervals between rows that are longer than one and a half of the median: the index of the row after each.
pub fn gaps(times: &[f64]) -> Vec<usize> {
    let intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut sorted = intervals.clone();
    sorted.sort_by(f64::total_cmp);
    let Some(median) = sorted.get(sorted.len() / 2) else { return Vec::new() };
    (0..intervals.len()).filter(|k| intervals[*k] > 1.5 * median).map(|k| k + 1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;
    use crate::rng::Chance;

    fn normal(chance: &mut Chance) -> f64 {
        (0..12).map(|_| chance.fraction()).sum::<f64>() - 6.0
    }

    /// A residual that depends on one of three columns names it, with the share that it explains; one that depends on
    /// none names none.
    #[test]
    fn a_dependence_is_found_and_chance_is_not() {
        let mut false_alarms = 0;
        for seed in 0..300 {
            let mut chance = Chance(seed);
            let n = 400 + chance.below(2000) as usize;
            let columns: Vec<Vec<f64>> = (0..3).map(|_| (0..n).map(|_| chance.between(-1.0, 1.0)).collect()).collect();
            let noise: Vec<f64> = (0..n).map(|_| normal(&mut chance)).collect();
            let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            false_alarms += usize::from(dependence(&noise, &noise, &slices, &PLATFORM).is_some());
            let which = seed as usize % 3;
            let strong: Vec<f64> =
                (0..n).map(|k| noise[k] + if columns[which][k] < -0.8 { 3.0 } else { 0.0 }).collect();
            let found = dependence(&strong, &strong, &slices, &PLATFORM).unwrap_or_else(|| panic!("seed {seed}: none"));
            assert_eq!((found.column, found.edge), (which, (true, false)), "seed {seed}: {found:?}");
            // Variance of the step: 9 · 0.1 · 0.9 = 0.81, of 1.81. A class with rows of both sides explains less.
            assert!((0.2..0.57).contains(&found.share) && found.class.1 < -0.7, "seed {seed}: {found:?}");
        }
        assert!(false_alarms <= 2, "{false_alarms} of 300");
    }

    #[test]
    fn columns_that_do_not_vary_divide_nothing() {
        let rows: Vec<f64> = (0..200).map(f64::from).collect();
        assert_eq!(dependence(&rows, &rows, &[&[1.0; 200]], &PLATFORM), None);
        let steps: Vec<f64> = (0..200).map(|k| f64::from(k / 150)).collect();
        let all = classes(&steps);
        assert_eq!(all.iter().map(Vec::len).collect::<Vec<_>>(), [150, 50]);
    }

    /// A burst is found where it is; a normal recording has none.
    #[test]
    fn bursts_are_found_where_they_are() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let mut rows: Vec<f64> = (0..2000).map(|_| normal(&mut chance)).collect();
            assert_eq!(outliers(&rows, &rows[3..]), None, "seed {seed}");
            let at = 10 + chance.below(1900) as usize;
            let length = 1 + chance.below(60) as usize;
            rows[at..at + length].iter_mut().for_each(|r| *r = 40.0 * if chance.fraction() < 0.5 { -1.0 } else { 1.0 });
            let found = outliers(&rows, &rows[3..]).unwrap_or_else(|| panic!("seed {seed}: none"));
            assert_eq!(found.rows, (at..at + length).collect::<Vec<_>>(), "seed {seed}");
        }
    }

    #[test]
    fn a_bad_beginning_and_gaps_are_found() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let mut rows: Vec<f64> = (0..1000).map(|_| normal(&mut chance)).collect();
            assert!(!begins_badly(&rows), "seed {seed}");
            (0..20).for_each(|k| rows[k] += 10.0 * f64::exp(-0.1 * k as f64));
            assert!(begins_badly(&rows), "seed {seed}");
            let gap = 1 + chance.below(998) as usize;
            let times: Vec<f64> = (0..1000).map(|k| 0.1 * k as f64 + if k >= gap { 0.06 } else { 0.0 }).collect();
            assert_eq!(gaps(&times), [gap], "seed {seed}");
            let even: Vec<f64> = (0..1000).map(|k| 0.1 * k as f64).collect();
            assert!(gaps(&even).is_empty());
        }
    }
}
