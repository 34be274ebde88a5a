//! What the residuals of a fit say of the model and of the recording.
//!
//! In: residuals as they are and whitened, and other columns of the same rows. Out: on which column they depend, rows
//! that hold most of the error, a beginning that fits badly, gaps between rows. Knows nothing of models.

use crate::fit::quantiles::chi_square_tail;
use crate::fit::unknowns::Elementary;
use std::borrow::Cow;
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
/// `white`: the whitened residuals by row; NaN in rows that the filter uses up. `columns`: their number, and one of them;
/// they need not be in memory together. Source: Davidson, MacKinnon, Econometric Theory and Methods, sec. 5.4 (the Wald
/// test of dummies).
pub fn dependence<'c>(
    (residuals, white): (&[f64], &[f64]),
    (count, column): (usize, &dyn Fn(usize) -> Cow<'c, [f64]>),
    with: &Elementary,
) -> Option<Dependence> {
    let one = |k: usize| {
        let column = column(k);
        let classes = Classes::of(&column);
        if classes.len() < 2 {
            return None;
        }
        let (between, all, n) = between(white, &classes);
        let degrees = classes.len() as f64 - 1.0;
        let probability = chi_square_tail(n * between / all, degrees, with);
        let share = {
            let (between, all, _) = self::between(residuals, &classes);
            between / all
        };
        let is_significant = probability < SIGNIFICANT / count as f64;
        if !(is_significant && share > LEAST_SHARE || share > MOST) {
            return None;
        }
        let weight = |class: &[u32]| {
            let sum: f64 = class.iter().map(|row| residuals[*row as usize]).sum();
            sum * sum / class.len() as f64
        };
        let worst = (0..classes.len()).max_by(|a, b| weight(classes.get(*a)).total_cmp(&weight(classes.get(*b))))?;
        let class = classes.get(worst);
        let (low, high) = (column[class[0] as usize], column[*class.last()? as usize]);
        Some(Dependence { column: k, share, class: (low, high), edge: (worst == 0, worst + 1 == classes.len()) })
    };
    let found = (0..count).filter_map(one);
    found.max_by(|a, b| a.share.total_cmp(&b.share))
}

/// Rows of a class whose residuals are this many times as large as those of all others, by their medians.
const LARGER: f64 = 3.0;

/// The column and the class of its values in which more than half of the squared error lies, where the rows of the class
/// are no few outliers: the model lacks something there that has no sign. Its `share` is that of the squared error.
pub fn concentration<'c>(
    residuals: &[f64],
    (count, column): (usize, &dyn Fn(usize) -> Cow<'c, [f64]>),
) -> Option<Dependence> {
    let all: f64 = residuals.iter().map(|r| r * r).sum();
    let median = |rows: &mut dyn Iterator<Item = &u32>| {
        let mut sizes: Vec<f64> = rows.map(|row| residuals[*row as usize].abs()).collect();
        let middle = sizes.len() / 2;
        if sizes.is_empty() { 0.0 } else { *sizes.select_nth_unstable_by(middle, f64::total_cmp).1 }
    };
    let of = |k: usize| {
        let column = column(k);
        let classes = Classes::of(&column);
        let value = |row: u32| column[row as usize];
        let one = |at: usize| {
            let class = classes.get(at);
            let square = |row: &u32| residuals[*row as usize] * residuals[*row as usize];
            let share = class.iter().map(square).sum::<f64>() / all;
            let mut others = (0..classes.len()).filter(|other| *other != at).flat_map(|other| classes.get(other));
            let is_larger = |others| median(&mut class.iter()) > LARGER * median(others);
            let found = share > MOST && 2 * class.len() < residuals.len() && is_larger(&mut others);
            // Rows with the value that most of the class have are meant.
            let middle = value(class[class.len() / 2]);
            let equal = class.iter().filter(|row| value(**row) == middle).count();
            let (class, edge) = match 2 * equal > class.len() {
                true => ((middle, middle), (false, false)),
                false => ((value(class[0]), value(*class.last()?)), (at == 0, at + 1 == classes.len())),
            };
            found.then_some(Dependence { column: k, share, class, edge })
        };
        (0..classes.len()).filter_map(one).next()
    };
    (0..count).filter_map(of).max_by(|a, b| a.share.total_cmp(&b.share))
}

/// P(χ² > x) with this number of degrees of freedom.
pub fn tail(x: f64, degrees: f64, with: &Elementary) -> f64 {
    chi_square_tail(x, degrees, with)
}

/// The rows in classes of rising values of a column. Equal values are in one class.
struct Classes {
    /// The rows in the order of their values.
    order: Vec<u32>,
    /// Where each class ends in it.
    ends: Vec<usize>,
}

impl Classes {
    fn of(column: &[f64]) -> Classes {
        let n = column.len();
        let count = (n / LEAST_OF_CLASS).min(CLASSES);
        let mut order: Vec<u32> = (0..u32::try_from(n).expect("fewer rows than 2^32")).collect();
        order.sort_by(|a, b| column[*a as usize].total_cmp(&column[*b as usize]));
        let value = |at: usize| column[order[at] as usize];
        let (mut ends, mut begin) = (Vec::new(), 0);
        for k in 1..=count {
            let mut end = k * n / count;
            while end < n && end > 0 && value(end) == value(end - 1) {
                end += 1;
            }
            if end > begin {
                ends.push(end);
                begin = end;
            }
        }
        Classes { order, ends }
    }

    fn len(&self) -> usize {
        self.ends.len()
    }

    fn get(&self, class: usize) -> &[u32] {
        let begin = if class == 0 { 0 } else { self.ends[class - 1] };
        &self.order[begin..self.ends[class]]
    }
}

/// The mean square between classes, and that of all rows, about their mean; and the number of rows that are not NaN, which
/// alone count.
fn between(rows: &[f64], classes: &Classes) -> (f64, f64, f64) {
    let known = || rows.iter().filter(|r| !r.is_nan());
    let n = known().count() as f64;
    let mean = known().sum::<f64>() / n;
    let all = known().map(|r| (r - mean) * (r - mean)).sum::<f64>() / n;
    let of = |class: usize| {
        let known = || classes.get(class).iter().map(|row| rows[*row as usize]).filter(|r| !r.is_nan());
        let count = known().count();
        let off = known().sum::<f64>() / count.max(1) as f64 - mean;
        if count == 0 { 0.0 } else { count as f64 * off * off }
    };
    ((0..classes.len()).map(of).sum::<f64>() / n, all.max(f64::MIN_POSITIVE), n)
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
/// outliers do not move. `white`: the whitened residuals by row; NaN in rows that the filter uses up.
pub fn outliers(residuals: &[f64], white: &[f64]) -> Option<Outliers> {
    let robust = |rows: &[f64]| {
        let mut sizes: Vec<f64> = rows.iter().map(|r| r.abs()).filter(|r| !r.is_nan()).collect();
        let middle = sizes.len() / 2;
        let median = if sizes.is_empty() { 0.0 } else { *sizes.select_nth_unstable_by(middle, f64::total_cmp).1 };
        // Half of a normal variable lies within 0.6745 standard deviations.
        median / 0.674_489_75
    };
    let (sd, unfiltered) = (robust(white), robust(residuals));
    // Whitening spreads an outlier over the rows after it.
    let is_far = |k: &usize| white[*k].abs() > FAR * sd && residuals[*k].abs() > 0.5 * FAR * unfiltered;
    let rows: Vec<usize> = (0..white.len()).filter(|k| sd > 0.0 && is_far(k)).collect();
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

/// Intervals that scatter by more than this part of their median are uneven, as are rows of which more than this part
/// follow a gap.
const EVEN: f64 = 0.1;

/// The gaps between rows of a recording; none if its rows are not in equal intervals otherwise. Rows that are left out
/// between two others make a gap.
pub fn intervals(times: &[f64]) -> Option<Vec<usize>> {
    let gaps = gaps(times);
    let all: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut is_gap = vec![false; times.len()];
    gaps.iter().for_each(|row| is_gap[*row] = true);
    let between: Vec<f64> = (0..all.len()).filter(|k| !is_gap[k + 1]).map(|k| all[k]).collect();
    let n = between.len().max(1) as f64;
    let mean = between.iter().sum::<f64>() / n;
    let square = between.iter().map(|interval| (interval - mean) * (interval - mean)).sum::<f64>() / n;
    (square <= EVEN * EVEN * mean * mean && gaps.len() as f64 <= EVEN * times.len() as f64).then_some(gaps)
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
            let column = |k: usize| Cow::from(&columns[k]);
            let found = dependence((&noise, &noise), (columns.len(), &column), &PLATFORM);
            false_alarms += usize::from(found.is_some());
            let which = seed as usize % 3;
            let strong: Vec<f64> =
                (0..n).map(|k| noise[k] + if columns[which][k] < -0.8 { 3.0 } else { 0.0 }).collect();
            let found = dependence((&strong, &strong), (columns.len(), &column), &PLATFORM);
            let found = found.unwrap_or_else(|| panic!("seed {seed}: none"));
            assert_eq!((found.column, found.edge), (which, (true, false)), "seed {seed}: {found:?}");
            // Variance of the step: 9 · 0.1 · 0.9 = 0.81, of 1.81. A class with rows of both sides explains less.
            assert!((0.2..0.57).contains(&found.share) && found.class.1 < -0.7, "seed {seed}: {found:?}");
        }
        assert!(false_alarms <= 2, "{false_alarms} of 300");
    }

    /// Rows at rest, a quarter of them, in which the error is large and of either sign: they are named. A few wild rows
    /// and plain noise are not.
    #[test]
    fn rows_that_hold_the_error_are_found_by_a_column() {
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let column: Vec<f64> =
                (0..1000).map(|k| if k % 4 == 0 { 0.0 } else { chance.between(-1.0, 1.0) }).collect();
            let noise: Vec<f64> = (0..1000).map(|_| normal(&mut chance)).collect();
            let rest: Vec<f64> = (0..1000).map(|k| if k % 4 == 0 { 20.0 } else { 1.0 } * noise[k]).collect();
            let found =
                concentration(&rest, (1, &|_| Cow::from(&column))).unwrap_or_else(|| panic!("seed {seed}: none"));
            let (low, high) = found.class;
            assert!(low > -0.03 && high < 0.03 && found.share > 0.9, "seed {seed}: {found:?}");
            assert_eq!(concentration(&noise, (1, &|_| Cow::from(&column))), None, "seed {seed}");
            let wild: Vec<f64> = (0..1000).map(|k| if k < 3 { 100.0 } else { noise[k] }).collect();
            let rising: Vec<f64> = (0..1000).map(f64::from).collect();
            assert_eq!(concentration(&wild, (1, &|_| Cow::from(&rising))), None, "seed {seed}");
        }
    }

    #[test]
    fn columns_that_do_not_vary_divide_nothing() {
        let rows: Vec<f64> = (0..200).map(f64::from).collect();
        assert_eq!(dependence((&rows, &rows), (1, &|_| Cow::from(&[1.0; 200])), &PLATFORM), None);
        let steps: Vec<f64> = (0..200).map(|k| f64::from(k / 150)).collect();
        let classes = Classes::of(&steps);
        assert_eq!((0..classes.len()).map(|k| classes.get(k).len()).collect::<Vec<_>>(), [150, 50]);
    }

    /// A burst is found where it is; a normal recording has none.
    #[test]
    fn bursts_are_found_where_they_are() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let mut rows: Vec<f64> = (0..2000).map(|_| normal(&mut chance)).collect();
            let white = |rows: &[f64]| [&[f64::NAN; 3], &rows[3..]].concat();
            assert_eq!(outliers(&rows, &white(&rows)), None, "seed {seed}");
            let at = 10 + chance.below(1900) as usize;
            let length = 1 + chance.below(60) as usize;
            rows[at..at + length].iter_mut().for_each(|r| *r = 40.0 * if chance.fraction() < 0.5 { -1.0 } else { 1.0 });
            let found = outliers(&rows, &white(&rows)).unwrap_or_else(|| panic!("seed {seed}: none"));
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

    /// A clock with little jitter and a few gaps is even; one whose intervals differ by a half, or with many gaps, is not.
    #[test]
    fn even_rows_are_told_from_uneven_ones() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let mut clock = |jitter: f64, gap: u64| {
                let (mut t, mut times, mut gaps) = (0.0, Vec::new(), Vec::new());
                for row in 0..500 {
                    let is_gap = row > 0 && chance.below(gap) == 0;
                    t += 1e-3 * (1.0 + chance.between(-jitter, jitter)) * if is_gap { 20.0 } else { 1.0 };
                    gaps.extend(is_gap.then_some(row));
                    times.push(t);
                }
                (times, gaps)
            };
            let (times, gaps) = clock(0.1, 100);
            assert_eq!(intervals(&times), Some(gaps), "seed {seed}");
            assert_eq!(intervals(&clock(0.4, 100).0), None, "seed {seed}");
            assert_eq!(intervals(&clock(0.0, 5).0), None, "seed {seed}");
        }
        assert_eq!(
            (intervals(&[]), intervals(&[1.0]), intervals(&[1.0, 2.0])),
            (Some(vec![]), Some(vec![]), Some(vec![]))
        );
    }
}
