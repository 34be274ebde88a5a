//! What a recording would tell of unknowns: the Fisher information of its derivatives.
//!
//! In: derivatives of the compared rows with respect to each unknown, in units of the noise. Out: the logarithm of the
//! determinant of the information, and standard deviations. Knows nothing of models.

use crate::fit::Elementary;

/// The Fisher information of some unknowns, as its Cholesky factor L, row by row.
#[derive(Clone, PartialEq, Debug)]
pub struct Information {
    n: usize,
    factor: Vec<f64>,
}

impl Information {
    /// Of derivatives: a column for each unknown. None if they do not determine the unknowns.
    pub fn of(columns: &[Vec<f64>]) -> Option<Information> {
        let n = columns.len();
        let mut factor = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..=i {
                let product: f64 = columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum();
                let known: f64 = (0..j).map(|k| factor[i * n + k] * factor[j * n + k]).sum();
                let left = product - known;
                factor[i * n + j] = match i == j {
                    // What rounding leaves of a column that others determine is no information.
                    true if left.is_nan() || left <= 1e-13 * product => return None,
                    true => left.sqrt(),
                    false => left / factor[j * n + j],
                };
            }
        }
        Some(Information { n, factor })
    }

    /// The logarithm of its determinant.
    pub fn log_determinant(&self, with: &Elementary) -> f64 {
        (0..self.n).map(|k| 2.0 * (with.log)(self.factor[k * self.n + k])).sum()
    }

    /// The least standard deviation of each unknown (Cramér, Rao).
    pub fn deviations(&self) -> Vec<f64> {
        let one = |unknown: usize| {
            // L y = e, and the variance is |y|².
            let mut y = vec![0.0; self.n];
            for i in unknown..self.n {
                let known: f64 = (unknown..i).map(|k| self.factor[i * self.n + k] * y[k]).sum();
                y[i] = (f64::from(u8::from(i == unknown)) - known) / self.factor[i * self.n + i];
            }
            y.iter().map(|y| y * y).sum::<f64>().sqrt()
        };
        (0..self.n).map(one).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;
    use crate::rng::Chance;

    /// For orthogonal columns that are mixed by a matrix of determinant 1 the determinant is known, and each deviation is
    /// the length that is left of a column without its part along the others.
    ///
    /// Mutants, each fails: half of the logarithm; deviations from L in place of its inverse.
    #[test]
    fn the_information_of_mixed_columns_is_known() {
        for seed in 0..50 {
            let mut chance = Chance(seed);
            let n = 1 + chance.below(6) as usize;
            let lengths: Vec<f64> = (0..n).map(|_| chance.between(0.1, 30.0)).collect();
            let mut columns: Vec<Vec<f64>> =
                (0..n).map(|k| (0..20).map(|row| if row == 2 * k { lengths[k] } else { 0.0 }).collect()).collect();
            let alone = Information::of(&columns).unwrap().deviations();
            for (sd, length) in alone.iter().zip(&lengths) {
                assert!((sd * length - 1.0).abs() < 1e-12, "seed {seed}");
            }
            for k in 1..n {
                let share = chance.between(-1.0, 1.0);
                let other = columns[k - 1].clone();
                columns[k].iter_mut().zip(other).for_each(|(a, b)| *a += share * b);
            }
            let information = Information::of(&columns).unwrap();
            let expected: f64 = lengths.iter().map(|length| 2.0 * length.ln()).sum();
            let found = information.log_determinant(&PLATFORM);
            assert!((found - expected).abs() < 1e-9, "seed {seed}: {found}, not {expected}");
            let last = information.deviations()[n - 1];
            assert!(
                (last * lengths[n - 1] - 1.0).abs() < 1e-9,
                "seed {seed}: what the others explain is no information"
            );
            columns.push(columns[0].clone());
            assert_eq!(Information::of(&columns), None, "seed {seed}: two equal columns");
        }
    }
}
