//! The covariance of estimates whose residuals are not white: the sandwich of two inverse Hessians and the scatter of the
//! gradient.
//!
//! In: the Jacobian and the residuals, row by row. Out: how the gradient scatters, and what its correlation from row to
//! row costs. Assumes nothing of the residuals but that they are correlated over fewer rows than there are.
//!
//! Sources: Newey, West, Econometrica 55 (1987); the number of rows by Andrews, Econometrica 59 (1991), eq. 6.2 and 6.4.

use crate::fit::least_squares::Singular;
use std::collections::VecDeque;
use std::ops::Range;

/// Most rows of a window, as a fraction of all.
const WIDEST: f64 = 0.2;
/// Correlation from row to row is taken to be at most this.
const MOST_CORRELATION: f64 = 0.99;

/// Rows of one compared quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Stretch {
    /// Its rows.
    pub rows: Range<usize>,
    /// They are independent of each other.
    pub independent: bool,
}

/// The scatter of the gradient.
#[derive(Clone, PartialEq, Debug)]
pub struct Scatter {
    /// Σ E[u(i) u(j)ᵀ] of the rows u of the gradient, n × n.
    pub matrix: Vec<f64>,
    /// Rows of a window, as a fraction of all rows.
    pub window: f64,
}

/// The scatter of the gradient of a sum of squares. Rows in none of the stretches are independent, with variance 1.
pub fn scatter(columns: &[Vec<f64>], residuals: &[f64], stretches: &[Stretch]) -> Scatter {
    let mut correlations: Vec<Correlation> = stretches.iter().map(Correlation::new).collect();
    for (correlation, Stretch { rows, .. }) in correlations.iter_mut().zip(stretches) {
        let part: Vec<&[f64]> = columns.iter().map(|column| &column[rows.clone()]).collect();
        correlation.add(&part, &residuals[rows.clone()]);
    }
    let mut windows = Windows::new(columns.len(), &correlations);
    let mut free = vec![true; residuals.len()];
    for (k, Stretch { rows, .. }) in stretches.iter().enumerate() {
        free[rows.clone()].fill(false);
        let part: Vec<&[f64]> = columns.iter().map(|column| &column[rows.clone()]).collect();
        windows.add(Some(k), &part, &residuals[rows.clone()]);
    }
    for at in (0..residuals.len()).filter(|at| free[*at]) {
        let part: Vec<&[f64]> = columns.iter().map(|column| &column[at..at + 1]).collect();
        windows.add(None, &part, &residuals[at..at + 1]);
    }
    windows.finish()
}

/// The correlation of each component of the gradient from row to row, in one stretch.
pub struct Correlation {
    rows: usize,
    independent: bool,
    /// The last row of the gradient.
    last: Option<Vec<f64>>,
    /// For each component, the sums of its products with the last row and of the squares of that.
    sums: Vec<(f64, f64)>,
}

impl Correlation {
    /// Without rows yet.
    pub fn new(stretch: &Stretch) -> Correlation {
        let Stretch { rows, independent } = stretch;
        Correlation { rows: rows.len(), independent: *independent, last: None, sums: Vec::new() }
    }

    /// Adds the next rows of the stretch.
    pub fn add(&mut self, columns: &[&[f64]], residuals: &[f64]) {
        self.sums.resize(columns.len(), (0.0, 0.0));
        let Some(end) = residuals.len().checked_sub(1) else { return };
        for (k, (column, (product, square))) in columns.iter().zip(&mut self.sums).enumerate() {
            let mut last = self.last.as_ref().map(|last| last[k]);
            for (slope, residual) in column.iter().zip(residuals) {
                let now = slope * residual;
                if let Some(last) = last {
                    *product += last * now;
                    *square += last * last;
                }
                last = Some(now);
            }
        }
        self.last = Some(columns.iter().map(|column| column[end] * residuals[end]).collect());
    }

    /// Rows of a window.
    fn width(&self) -> usize {
        if self.independent {
            return 1;
        }
        let (mut above, mut below) = (0.0, 0.0);
        for (product, square) in self.sums.iter().filter(|(_, square)| *square > 0.0) {
            let rho = (product / square).clamp(-MOST_CORRELATION, MOST_CORRELATION);
            let fourth = (1.0 - rho) * (1.0 - rho) * (1.0 - rho) * (1.0 - rho);
            above += 4.0 * rho * rho / (fourth * (1.0 - rho) * (1.0 - rho) * (1.0 + rho) * (1.0 + rho));
            below += 1.0 / fourth;
        }
        let wanted = 1.1447 * cube_root(if below > 0.0 { above / below } else { 0.0 } * self.rows as f64);
        (wanted.ceil().min(WIDEST * self.rows as f64) as usize).max(1)
    }
}

/// Sums over windows of rows.
///
/// The weights of pairs of rows fall linearly with their distance (Bartlett). So the sum over pairs is one over windows:
/// each row enters and leaves the running sum of a window once, and the time does not depend on its width.
pub struct Windows {
    n: usize,
    matrix: Vec<f64>,
    window: f64,
    stretches: Vec<Window>,
}

/// A window that moves over a stretch.
struct Window {
    /// Rows of the stretch that are still to come.
    left: usize,
    width: usize,
    sum: Vec<f64>,
    /// The rows in the window.
    inside: VecDeque<f64>,
}

impl Windows {
    /// Without rows yet, for a gradient of n components, in stretches of these correlations.
    pub fn new(n: usize, correlations: &[Correlation]) -> Windows {
        let one = |correlation: &Correlation| {
            let width = correlation.width();
            Window { left: correlation.rows, width, sum: vec![0.0; n], inside: VecDeque::new() }
        };
        let stretches: Vec<Window> = correlations.iter().map(one).collect();
        let part = |window: &Window| window.width as f64 / window.left.max(1) as f64;
        let window = stretches.iter().map(part).fold(0.0, f64::max);
        Windows { n, matrix: vec![0.0; n * n], window, stretches }
    }

    /// Adds the next rows of a stretch, or rows of none.
    pub fn add(&mut self, stretch: Option<usize>, columns: &[&[f64]], residuals: &[f64]) {
        let (n, matrix) = (self.n, &mut self.matrix);
        let mut add = |sum: &[f64], weight: f64| {
            for (row, a) in matrix.chunks_mut(n).zip(sum) {
                row.iter_mut().zip(sum).for_each(|(cell, b)| *cell += weight * a * b);
            }
        };
        let Some(Window { left, width, sum, inside }) = stretch.map(|stretch| &mut self.stretches[stretch]) else {
            for at in 0..residuals.len() {
                add(&columns.iter().map(|column| column[at]).collect::<Vec<f64>>(), 1.0);
            }
            return;
        };
        let (weight, full) = (1.0 / *width as f64, n * *width);
        for (at, residual) in residuals.iter().enumerate() {
            let row = columns.iter().map(|column| column[at] * residual);
            sum.iter_mut().zip(row.clone()).for_each(|(sum, u)| *sum += u);
            if inside.len() == full {
                sum.iter_mut().zip(inside.drain(..n)).for_each(|(sum, u)| *sum -= u);
            }
            inside.extend(row);
            add(sum, weight);
        }
        *left -= residuals.len();
        // At the end the window moves out of the stretch.
        if *left == 0 {
            while inside.len() > n {
                sum.iter_mut().zip(inside.drain(..n)).for_each(|(sum, u)| *sum -= u);
                add(sum, weight);
            }
        }
    }

    /// The scatter of all rows.
    pub fn finish(self) -> Scatter {
        Scatter { matrix: self.matrix, window: self.window }
    }
}

/// The cube root by Newton's method: elementary functions of the platform differ between machines.
fn cube_root(x: f64) -> f64 {
    let mut root = x.max(1.0);
    for _ in 0..200 {
        let next = (2.0 * root + x / (root * root)) / 3.0;
        if (next - root).abs() <= 1e-12 * root {
            break;
        }
        root = next;
    }
    root
}

impl Scatter {
    /// How often the variances of white residuals the variances are, in the directions that the data determine: the
    /// matrix of the sensitivities, direction by direction. `parts`: of the Jacobian.
    pub fn ratios(&self, parts: &Singular) -> Vec<f64> {
        let of =
            |i: usize, j: usize| self.form(&parts.vectors[i], &parts.vectors[j]) / (parts.values[i] * parts.values[j]);
        let known = parts.values.iter().filter(|s| **s > 1e-9 * parts.values[0]).count();
        (0..known * known).map(|at| of(at / known, at % known)).collect()
    }

    /// vᵀ M w
    pub fn form(&self, v: &[f64], w: &[f64]) -> f64 {
        let n = v.len();
        (0..n).map(|i| v[i] * (0..n).map(|j| self.matrix[i * n + j] * w[j]).sum::<f64>()).sum()
    }

    /// How much longer an interval is than one of the normal distribution, because the scatter is estimated from few
    /// independent windows. Source: Kiefer, Vogelsang, Econometric Theory 21 (2005), table 1, 97.5 % of Bartlett's.
    pub fn stretch(&self) -> f64 {
        let b = self.window;
        1.0 + b * (2.9694 + b * (0.4160 - 0.5324 * b)) / 1.96
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    fn columns(chance: &mut Chance, n: usize, rows: usize) -> Vec<Vec<f64>> {
        (0..n).map(|_| (0..rows).map(|_| chance.between(-1.0, 1.0)).collect()).collect()
    }

    /// The sum over windows is that over pairs of rows with weights that fall linearly.
    #[test]
    fn windows_weigh_pairs_of_rows() {
        for seed in 0..50 {
            let mut chance = Chance(seed);
            let rows = 30 + chance.below(100) as usize;
            let columns = columns(&mut chance, 3, rows + 5);
            let mut past = 0.0;
            let residuals: Vec<f64> = (0..rows + 5)
                .map(|_| {
                    past = 0.8 * past + chance.between(-1.0, 1.0);
                    past
                })
                .collect();
            let stretch = Stretch { rows: 2..rows, independent: false };
            let found = scatter(&columns, &residuals, std::slice::from_ref(&stretch));
            let mut correlation = Correlation::new(&stretch);
            let part: Vec<&[f64]> = columns.iter().map(|column| &column[stretch.rows.clone()]).collect();
            correlation.add(&part, &residuals[stretch.rows.clone()]);
            let width = correlation.width() as f64;
            for i in 0..3 {
                for j in 0..3 {
                    let mut expected = 0.0;
                    for s in stretch.rows.clone() {
                        for t in stretch.rows.clone() {
                            let weight = (1.0 - s.abs_diff(t) as f64 / width).max(0.0);
                            expected += weight * columns[i][s] * residuals[s] * columns[j][t] * residuals[t];
                        }
                    }
                    let outside = (0..rows + 5).filter(|at| !stretch.rows.contains(at));
                    expected += outside.map(|at| columns[i][at] * columns[j][at]).sum::<f64>();
                    let at = found.matrix[i * 3 + j];
                    assert!((at - expected).abs() < 1e-9 * (1.0 + expected.abs()), "seed {seed}: {at}, not {expected}");
                }
            }
        }
    }

    /// The mean of correlated rows scatters as its window says: AR(1) with 0.9 has 19 times the variance.
    #[test]
    fn correlation_from_row_to_row_widens() {
        let mut ratio = 0.0;
        for seed in 0..50 {
            let (mut chance, mut past) = (Chance(seed), 0.0);
            let residuals: Vec<f64> = (0..5000)
                .map(|_| {
                    past = 0.9 * past + chance.between(-1.0, 1.0);
                    past
                })
                .collect();
            let ones = vec![vec![1.0; 5000]];
            let found = scatter(&ones, &residuals, &[Stretch { rows: 0..5000, independent: false }]);
            ratio += found.matrix[0] / residuals.iter().map(|r| r * r).sum::<f64>() / 50.0;
        }
        assert!((14.0..20.0).contains(&ratio), "{ratio}");
    }

    #[test]
    fn cube_roots() {
        for x in [0.0, 1e-3, 1.0, 8.0, 1e9] {
            assert!((cube_root(x) * cube_root(x) * cube_root(x) - x).abs() <= 1e-9 * x.max(1e-9), "{x}");
        }
    }
}
