//! The covariance of estimates whose residuals are not white: the sandwich of two inverse Hessians and the scatter of the
//! gradient.
//!
//! In: the Jacobian and the residuals, row by row. Out: how the gradient scatters, and what its correlation from row to
//! row costs. Assumes nothing of the residuals but that they are correlated over fewer rows than there are.
//!
//! Sources: Newey, West, Econometrica 55 (1987); the number of rows by Andrews, Econometrica 59 (1991), eq. 6.2 and 6.4.

use crate::fit::least_squares::Singular;
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
///
/// The weights of pairs of rows fall linearly with their distance (Bartlett). So the sum over pairs is one over windows:
/// each row enters and leaves the running sum of a window once, and the time does not depend on its width.
pub fn scatter(columns: &[Vec<f64>], residuals: &[f64], stretches: &[Stretch]) -> Scatter {
    let n = columns.len();
    let (mut matrix, mut window) = (vec![0.0; n * n], 0.0_f64);
    let mut add = |sum: &[f64], weight: f64| {
        for (row, a) in matrix.chunks_mut(n).zip(sum) {
            row.iter_mut().zip(sum).for_each(|(cell, b)| *cell += weight * a * b);
        }
    };
    let mut free = vec![true; residuals.len()];
    let row = |at: usize| columns.iter().map(move |column| column[at] * residuals[at]);
    for Stretch { rows, independent } in stretches {
        free[rows.clone()].fill(false);
        let width = if *independent { 1 } else { width(columns, residuals, rows) };
        window = window.max(width as f64 / rows.len().max(1) as f64);
        let mut sum = vec![0.0; n];
        for at in rows.start..rows.end + width - 1 {
            if at < rows.end {
                sum.iter_mut().zip(row(at)).for_each(|(sum, u)| *sum += u);
            }
            if let Some(old) = at.checked_sub(width).filter(|old| *old >= rows.start) {
                sum.iter_mut().zip(row(old)).for_each(|(sum, u)| *sum -= u);
            }
            add(&sum, 1.0 / width as f64);
        }
    }
    for at in (0..residuals.len()).filter(|at| free[*at]) {
        add(&columns.iter().map(|column| column[at]).collect::<Vec<f64>>(), 1.0);
    }
    Scatter { matrix, window }
}

/// Rows of a window, from the correlation of each component of the gradient from row to row.
fn width(columns: &[Vec<f64>], residuals: &[f64], rows: &Range<usize>) -> usize {
    let (mut above, mut below) = (0.0, 0.0);
    for column in columns {
        let (mut product, mut square) = (0.0, 0.0);
        for at in rows.start + 1..rows.end {
            let (last, now) = (column[at - 1] * residuals[at - 1], column[at] * residuals[at]);
            product += last * now;
            square += last * last;
        }
        if square > 0.0 {
            let rho = (product / square).clamp(-MOST_CORRELATION, MOST_CORRELATION);
            let fourth = (1.0 - rho) * (1.0 - rho) * (1.0 - rho) * (1.0 - rho);
            above += 4.0 * rho * rho / (fourth * (1.0 - rho) * (1.0 - rho) * (1.0 + rho) * (1.0 + rho));
            below += 1.0 / fourth;
        }
    }
    let wanted = 1.1447 * cube_root(if below > 0.0 { above / below } else { 0.0 } * rows.len() as f64);
    (wanted.ceil().min(WIDEST * rows.len() as f64) as usize).max(1)
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
            let width = width(&columns, &residuals, &stretch.rows) as f64;
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
