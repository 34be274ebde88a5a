//! Eigenvalues of a linear system, as natural frequencies and damping ratios (real Schur form, by nalgebra).
//!
//! In: a square matrix, row by row. Out: its modes, the slowest first.

use nalgebra::linalg::Schur;
use nalgebra::{Complex, DMatrix};

/// One eigenvalue; of a conjugate pair the one above the real axis.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Mode {
    /// Real part, 1/s.
    pub real: f64,
    /// Imaginary part, rad/s, not negative.
    pub imaginary: f64,
}

impl Mode {
    /// Natural frequency: the absolute value, rad/s.
    pub fn frequency(self) -> f64 {
        // Scaled to avoid overflow.
        let (large, small) = (self.real.abs().max(self.imaginary), self.real.abs().min(self.imaginary));
        if large > 0.0 { large * (1.0 + (small / large) * (small / large)).sqrt() } else { 0.0 }
    }

    /// Damping ratio: 1 for a decay without oscillation, below 0 for a growing mode; none for an integrator.
    pub fn damping(self) -> Option<f64> {
        let frequency = self.frequency();
        (frequency > 0.0).then(|| -self.real / frequency)
    }
}

/// The modes of dx/dt = A x; none if the eigenvalues cannot be computed, for example because an entry is not finite.
pub fn modes(n: usize, a: &[f64]) -> Option<Vec<Mode>> {
    assert_eq!(a.len(), n * n, "a matrix of {n} rows");
    if !a.iter().all(|entry| entry.is_finite()) {
        return None;
    }
    if n == 0 {
        return Some(Vec::new());
    }
    let mut scaled = a.to_vec();
    balance(n, &mut scaled);
    let size = scaled.iter().fold(0.0f64, |size, entry| size.max(entry.abs()));
    let matrix = DMatrix::from_row_slice(n, n, &scaled);
    // Values below the rounding error of the largest entries are noise of the reduction.
    let found = |matrix: DMatrix<f64>| {
        let schur = Schur::try_new(matrix, f64::EPSILON, 10_000)?;
        Some(schur.complex_eigenvalues().iter().copied().collect::<Vec<Complex<f64>>>())
    };
    // Of a nilpotent part, such as a shift register, no entry is small against the diagonal, which is 0: shift it.
    let shifted = || {
        let shift = if size > 0.0 { size } else { 1.0 };
        let all = found(&matrix + DMatrix::identity(n, n) * shift)?;
        Some(all.into_iter().map(|value| value - shift).collect())
    };
    let eigenvalues: Vec<Complex<f64>> = found(matrix.clone()).or_else(shifted)?;
    let noise = 1e-15 * size;
    let clean = |x: f64| if x.abs() <= noise { 0.0 } else { x };
    let mut modes: Vec<Mode> = eigenvalues
        .into_iter()
        .map(|value| Mode { real: clean(value.re), imaginary: clean(value.im) })
        .filter(|mode| mode.imaginary >= 0.0)
        .collect();
    modes.sort_by(|a, b| a.frequency().total_cmp(&b.frequency()));
    Some(modes)
}

/// Balances the matrix: scales rows and columns by powers of two until their norms are similar. This is an exact
/// similarity transformation. Source: Parlett, Reinsch, Numer. Math. 13 (1969).
fn balance(n: usize, a: &mut [f64]) {
    for _ in 0..100 {
        let mut done = true;
        for i in 0..n {
            let others = || (0..n).filter(|j| *j != i);
            let mut column: f64 = others().map(|j| a[j * n + i].abs()).sum();
            let row: f64 = others().map(|j| a[i * n + j].abs()).sum();
            if column == 0.0 || row == 0.0 {
                continue;
            }
            let (before, mut factor) = (column + row, 1.0);
            while column < 0.5 * row {
                (column, factor) = (4.0 * column, 2.0 * factor);
            }
            while column > 2.0 * row {
                (column, factor) = (0.25 * column, 0.5 * factor);
            }
            if (column + row) / factor < 0.95 * before {
                done = false;
                (0..n).for_each(|j| a[i * n + j] /= factor);
                (0..n).for_each(|j| a[j * n + i] *= factor);
            }
        }
        if done {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mass_on_a_spring_has_its_frequency_and_damping() {
        // d²x/dt² = −ω² x − 2 ζ ω dx/dt with ω = 100 rad/s, ζ = 0.2
        let found = modes(2, &[0.0, 1.0, -1e4, -40.0]).unwrap();
        assert_eq!(found.len(), 1);
        assert!((found[0].frequency() - 100.0).abs() < 1e-10, "{found:?}");
        assert!((found[0].damping().unwrap() - 0.2).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn integrators_and_fast_modes_are_resolved_together() {
        // x' = v, v' = −1e8 v: eigenvalues of very different magnitude.
        let found = modes(2, &[0.0, 1.0, 0.0, -1e8]).unwrap();
        assert_eq!(found[0], Mode { real: 0.0, imaginary: 0.0 });
        assert_eq!(found[0].damping(), None);
        assert!((found[1].real / -1e8 - 1.0).abs() < 1e-12 && found[1].damping() == Some(1.0));
    }

    /// A shift register of growing length, alone and in a loop that is read at its end.
    #[test]
    fn a_shift_register_has_eigenvalues() {
        for n in 1..14 {
            let mut register = vec![0.0; n * n];
            (1..n).for_each(|k| register[k * n + k - 1] = 1.0);
            let found = modes(n, &register).unwrap();
            assert!(found.iter().all(|mode| mode.frequency() < 1e-1), "{n}: {found:?}");
            // zⁿ = 1/2
            register[n - 1] += 0.5;
            let found = modes(n, &register).unwrap();
            let size = 0.5f64.powf(1.0 / n as f64);
            assert!(found.iter().all(|mode| (mode.frequency() - size).abs() < 1e-9), "{n}: {found:?}");
        }
    }

    #[test]
    fn bad_scales_do_not_blur_small_eigenvalues() {
        // Similar to diag(−1, −2, −3), with scales of 1e6: the superdiagonal entries are the ratios of the scales.
        let found = modes(3, &[-1.0, 1e6, 1e12, 0.0, -2.0, 1e6, 0.0, 0.0, -3.0]).unwrap();
        let real: Vec<f64> = found.iter().map(|mode| mode.real).collect();
        assert!(real.iter().zip([-1.0, -2.0, -3.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{real:?}");
    }

    #[test]
    fn a_matrix_that_is_not_finite_has_no_modes() {
        assert_eq!(modes(1, &[f64::NAN]), None);
        assert_eq!(modes(0, &[]), Some(Vec::new()));
    }
}
