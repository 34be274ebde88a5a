//! Small dense linear systems: LU factors with partial pivoting.
//!
//! Matrices are row-major n × n slices. `N` is n where it is known at compile time, so that loops unroll, and 0
//! otherwise. One routine serves all sizes: the same operations in the same order, so the same bits.

/// Replaces `a` by its factors L and U with partial pivoting by row exchanges; the diagonal of U is stored inverted.
///
/// `rows[k]`: the row exchanged with row k. Returns whether every pivot is a number other than 0.
pub(crate) fn factor<const N: usize>(n: usize, a: &mut [f64], rows: &mut [usize]) -> bool {
    let n = if N == 0 { n } else { N };
    let (a, rows) = (&mut a[..n * n], &mut rows[..n]);
    for k in 0..n {
        let mut largest = k;
        for row in k + 1..n {
            if a[row * n + k].abs() > a[largest * n + k].abs() {
                largest = row;
            }
        }
        rows[k] = largest;
        if largest != k {
            for column in 0..n {
                a.swap(k * n + column, largest * n + column);
            }
        }
        let inverse = 1.0 / a[k * n + k];
        if !inverse.is_finite() {
            return false;
        }
        a[k * n + k] = inverse;
        for row in k + 1..n {
            let part = a[row * n + k] * inverse;
            a[row * n + k] = part;
            for column in k + 1..n {
                a[row * n + column] -= part * a[k * n + column];
            }
        }
    }
    true
}

/// Replaces the right-hand side `b` by the solution, given the factors from [`factor`].
pub(crate) fn solve<const N: usize>(n: usize, a: &[f64], rows: &[usize], b: &mut [f64]) {
    let n = if N == 0 { n } else { N };
    let (a, rows, b) = (&a[..n * n], &rows[..n], &mut b[..n]);
    for (k, row) in rows.iter().enumerate() {
        b.swap(k, *row);
    }
    for row in 1..n {
        let mut sum = b[row];
        for column in 0..row {
            sum -= a[row * n + column] * b[column];
        }
        b[row] = sum;
    }
    for row in (0..n).rev() {
        let mut sum = b[row];
        for column in row + 1..n {
            sum -= a[row * n + column] * b[column];
        }
        b[row] = sum * a[row * n + row];
    }
}

/// Largest magnitude of an eigenvalue of `a`, to within a factor of about two: |a¹⁶|^(1/16), by squaring four times.
///
/// Overwrites `a`; `room` is a buffer of the same length.
pub(crate) fn spectral_radius(n: usize, a: &mut [f64], room: &mut [f64]) -> f64 {
    let mut scale = 1.0;
    let mut root = 1.0;
    for _ in 0..4 {
        let largest = a.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs()));
        if largest == 0.0 || !largest.is_finite() {
            return largest;
        }
        scale *= exact_root(largest, root);
        root *= 2.0;
        a.iter_mut().for_each(|entry| *entry /= largest);
        for row in 0..n {
            for column in 0..n {
                room[row * n + column] = (0..n).map(|k| a[row * n + k] * a[k * n + column]).sum();
            }
        }
        a.copy_from_slice(room);
    }
    let largest = a.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs()));
    scale * exact_root(largest, root)
}

/// The 1, 2, 4, 8 or 16th root.
fn exact_root(mut value: f64, mut root: f64) -> f64 {
    while root > 1.0 {
        value = value.sqrt();
        root *= 0.5;
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in −1..1 from a seed, by a linear congruential generator.
    fn numbers(seed: u64, count: usize) -> Vec<f64> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    fn residual<const N: usize>(n: usize, seed: u64) -> f64 {
        let matrix = numbers(seed, n * n);
        let solution = numbers(seed + 1, n);
        let mut b: Vec<f64> = matrix.chunks(n).map(|row| row.iter().zip(&solution).map(|(a, x)| a * x).sum()).collect();
        let (mut factors, mut rows) = (matrix, vec![0; n]);
        assert!(factor::<N>(n, &mut factors, &mut rows));
        solve::<N>(n, &factors, &rows, &mut b);
        b.iter().zip(&solution).fold(0.0, |worst: f64, (got, wanted)| worst.max((got - wanted).abs()))
    }

    #[test]
    fn systems_of_every_size_are_solved() {
        for seed in 0..50 {
            assert!(residual::<1>(1, seed) < 1e-13);
            assert!(residual::<2>(2, seed) < 1e-10, "seed {seed}");
            assert!(residual::<5>(5, seed) < 1e-10, "seed {seed}");
            assert!(residual::<8>(8, seed) < 1e-10, "seed {seed}");
            assert!(residual::<0>(30, seed) < 1e-10, "seed {seed}");
            assert_eq!(residual::<5>(5, seed), residual::<0>(5, seed));
        }
    }

    #[test]
    fn a_singular_system_is_reported() {
        assert!(!factor::<2>(2, &mut [1.0, 2.0, 2.0, 4.0], &mut [0, 0]));
        assert!(factor::<0>(0, &mut [], &mut []));
    }

    #[test]
    fn the_spectral_radius_is_right_within_a_factor_of_two() {
        let radius = |entries: &[f64]| {
            let n = entries.len().isqrt();
            spectral_radius(n, &mut entries.to_vec(), &mut vec![0.0; entries.len()])
        };
        assert_eq!(radius(&[-3.0]), 3.0);
        assert!((0.5..2.0).contains(&radius(&[0.0, 1.0, -1.0, 0.0])));
        // A bristle and a mass: eigenvalues ±316 i, although the matrix contains 1e5.
        assert!((158.0..632.0).contains(&radius(&[0.0, -1e5, 1.0, 0.0])));
        assert_eq!(radius(&[0.0, 0.0, 0.0, 0.0]), 0.0);
        assert_eq!(radius(&[0.0, 1.0, 0.0, 0.0]), 0.0);
    }
}
