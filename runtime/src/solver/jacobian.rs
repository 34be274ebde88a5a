//! Spectral estimates from the Jacobian of a model as it is stored in the block: dense, or only the structurally
//! nonzero entries.

use super::linear;

/// Largest number of states for which the matrix is squared to estimate its spectral radius; above, power iteration on
/// a vector is used.
const MOST_SQUARED: usize = 64;

/// Number of power iterations: before the growth of the vector is averaged, and while it is.
const MULTIPLIED: (usize, usize) = (8, 16);

/// Positions of the entries of a Jacobian.
pub(crate) struct Entries {
    n: usize,
    /// (row, column) of each; empty if all n × n are stored.
    coupled: Vec<(u32, u32)>,
    /// For each entry in the lower triangle, its index and that of its transposed entry.
    pairs: Vec<(u32, u32)>,
    room: Vec<f64>,
}

impl Entries {
    /// For n states; `coupled`: (row, column) of each entry by rows, or empty for all.
    pub(crate) fn new(n: usize, coupled: &[(u32, u32)]) -> Entries {
        let mirror = |(k, &(row, column)): (usize, &(u32, u32))| {
            let mirror = coupled.binary_search(&(column, row)).ok().filter(|_| column <= row)?;
            Some((k as u32, mirror as u32))
        };
        let pairs = coupled.iter().enumerate().filter_map(mirror).collect();
        let squared = coupled.is_empty() && n <= MOST_SQUARED;
        let room = vec![0.0; if squared { 2 * n * n } else { 3 * n }];
        Entries { n, coupled: coupled.to_vec(), pairs, room }
    }

    /// Number of entries of ∂f/∂x.
    pub(crate) fn len(&self) -> usize {
        if self.coupled.is_empty() { self.n * self.n } else { self.coupled.len() }
    }

    /// (row, column) of each entry, if not all are stored.
    pub(crate) fn coupled(&self) -> Option<&[(u32, u32)]> {
        (!self.coupled.is_empty()).then_some(&self.coupled)
    }

    /// The largest squared frequency of a pair of states, or of a single state, at least `least`: exact for a mass on a
    /// spring, and for a decay.
    pub(crate) fn fastest(&self, jacobian: &[f64], least: f64) -> f64 {
        let mut fastest = least;
        if self.coupled.is_empty() {
            for row in 0..self.n {
                for column in 0..=row {
                    fastest =
                        f64::max(fastest, (jacobian[row * self.n + column] * jacobian[column * self.n + row]).abs());
                }
            }
        }
        for (entry, mirror) in &self.pairs {
            fastest = f64::max(fastest, (jacobian[*entry as usize] * jacobian[*mirror as usize]).abs());
        }
        fastest
    }

    /// The sum of the eigenvalues.
    pub(crate) fn trace(&self, jacobian: &[f64]) -> f64 {
        if self.coupled.is_empty() {
            return (0..self.n).map(|i| jacobian[i * self.n + i]).sum();
        }
        let diagonal = self.coupled.iter().zip(jacobian).filter(|((row, column), _)| row == column);
        diagonal.map(|(_, entry)| entry).sum()
    }

    /// The sum of the squared eigenvalues; 0 where it would be expensive.
    pub(crate) fn trace_of_square(&self, jacobian: &[f64]) -> f64 {
        let n = self.n;
        if !self.coupled.is_empty() || n > MOST_SQUARED {
            return 0.0;
        }
        let product = |row: usize, column: usize| jacobian[row * n + column] * jacobian[column * n + row];
        (0..n).flat_map(|row| (0..n).map(move |column| (row, column))).map(|(row, column)| product(row, column)).sum()
    }

    /// Largest magnitude of an eigenvalue, to within a factor of about two; `scales`: one for each state, by which the
    /// Jacobian is scaled to make it as close to normal as possible.
    pub(crate) fn spectral_radius(&mut self, jacobian: &[f64], scales: &[f64]) -> f64 {
        let n = self.n;
        if self.coupled.is_empty() && n <= MOST_SQUARED {
            let (matrix, room) = self.room.split_at_mut(n * n);
            for row in 0..n {
                for column in 0..n {
                    matrix[row * n + column] = jacobian[row * n + column] * scales[column] / scales[row];
                }
            }
            return linear::spectral_radius(n, matrix, room);
        }
        // A pseudorandom vector has a component along every eigenvector.
        let (x, y) = self.room.split_at_mut(n);
        let mut chance = 0x9e37_79b9_7f4a_7c15_u64;
        for x in x.iter_mut() {
            chance = chance.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            *x = (chance >> 11) as f64 / (1u64 << 52) as f64 - 1.0;
        }
        let mut radius = 1.0;
        for k in 0..MULTIPLIED.0 + MULTIPLIED.1 {
            let y = &mut y[..n];
            y.fill(0.0);
            if self.coupled.is_empty() {
                for (row, y) in y.iter_mut().enumerate() {
                    let entries = &jacobian[row * n..(row + 1) * n];
                    let sum: f64 = entries.iter().zip(&*x).zip(scales).map(|((entry, x), s)| entry * s * x).sum();
                    *y = sum / scales[row];
                }
            } else {
                for ((row, column), entry) in self.coupled.iter().zip(jacobian) {
                    let (row, column) = (*row as usize, *column as usize);
                    y[row] += entry * scales[column] / scales[row] * x[column];
                }
            }
            let largest = y.iter().fold(0.0f64, |largest, y| largest.max(y.abs()));
            if largest == 0.0 || !largest.is_finite() {
                return largest;
            }
            for (x, y) in x.iter_mut().zip(&*y) {
                *x = y / largest;
            }
            if k >= MULTIPLIED.0 {
                // The sixteenth root.
                radius *= largest.sqrt().sqrt().sqrt().sqrt();
            }
        }
        radius
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 100 masses on springs, at ±316 i, and 100 states that decay at 20 1/s: dense, or with nonzero entries only.
    #[test]
    fn sparse_and_dense_estimates_agree() {
        let n = 300;
        let (mut coupled, mut values, mut all) = (Vec::new(), Vec::new(), vec![0.0; n * n]);
        for k in 0..100u32 {
            for (row, column, value) in
                [(3 * k, 3 * k + 1, 1.0), (3 * k + 1, 3 * k, -1e5), (3 * k + 2, 3 * k + 2, -20.0)]
            {
                coupled.push((row, column));
                values.push(value);
                all[row as usize * n + column as usize] = value;
            }
        }
        let (mut few, mut dense) = (Entries::new(n, &coupled), Entries::new(n, &[]));
        assert_eq!((few.len(), dense.len()), (300, n * n));
        for (entries, jacobian) in [(&mut few, &values), (&mut dense, &all)] {
            assert_eq!(entries.trace(jacobian), -2000.0);
            assert_eq!(entries.fastest(jacobian, 1.0), 1e5);
            let radius = entries.spectral_radius(jacobian, &vec![1.0; n]);
            assert!((158.0..632.0).contains(&radius), "{radius}");
            assert_eq!(entries.spectral_radius(&vec![0.0; jacobian.len()], &vec![1.0; n]), 0.0);
        }
    }
}
