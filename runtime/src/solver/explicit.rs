//! The explicit method for non-stiff models: Dormand & Prince 5(4), seven stages, with the last one reused as the first
//! of the next step (FSAL).
//!
//! Source: Dormand & Prince, J. Comput. Appl. Math. 6 (1980); continuous extension of order four: Hairer, Nørsett &
//! Wanner, Solving ODEs I, sec. II.6.

use super::step::{Step, System};

/// Nodes, as fractions of the step.
const C: [f64; 7] = [0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0, 1.0];

/// Stage i is evaluated at x0 + h Σ A[i][j] k_j; the last row is the solution.
const A: [[f64; 6]; 7] = [
    [0.0; 6],
    [1.0 / 5.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [3.0 / 40.0, 9.0 / 40.0, 0.0, 0.0, 0.0, 0.0],
    [44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0, 0.0, 0.0, 0.0],
    [19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0, 0.0, 0.0],
    [9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0, 0.0],
    [35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
];

/// Weights of the error estimate: fifth minus fourth order.
const E: [f64; 7] =
    [71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0];

/// Weights of the continuous extension.
const D: [f64; 7] = [
    -12715105075.0 / 11282082432.0,
    0.0,
    87487479700.0 / 32700410799.0,
    -10690763975.0 / 1880347072.0,
    701980252875.0 / 199316789632.0,
    -1453857185.0 / 822651844.0,
    69997945.0 / 29380423.0,
];

/// Buffers for the stages.
pub(crate) struct Explicit {
    /// Slopes of the stages, one after the other.
    k: Vec<f64>,
    /// States at the last stage.
    x: Vec<f64>,
}

impl Explicit {
    pub(crate) fn new(n: usize) -> Explicit {
        Explicit { k: vec![0.0; 7 * n], x: vec![0.0; n] }
    }

    /// Computes the step from its `t`, `h`, `end`, `x0` and `f0`.
    pub(crate) fn attempt(&mut self, system: &mut System, step: &mut Step) {
        let (n, h) = (system.n, step.h);
        self.k[..n].copy_from_slice(&step.f0);
        for stage in 1..7 {
            let (done, rest) = self.k.split_at_mut(stage * n);
            for i in 0..n {
                let mut sum = 0.0;
                for (j, k) in done.chunks_exact(n).enumerate() {
                    sum += A[stage][j] * k[i];
                }
                self.x[i] = step.x0[i] + h * sum;
            }
            let t = if C[stage] == 1.0 { step.end } else { step.t + C[stage] * h };
            system.slope(t, &self.x, &mut rest[..n]);
        }
        let k = |stage: usize, i: usize| self.k[stage * n + i];
        step.x1.copy_from_slice(&self.x);
        for i in 0..n {
            let sum = |weights: &[f64; 7]| (0..7).map(|stage| weights[stage] * k(stage, i)).sum::<f64>();
            step.error[i] = h * sum(&E);
            let change = step.x1[i] - step.x0[i];
            let bend = h * k(0, i) - change;
            let late = h * sum(&D);
            step.k1[i] = bend;
            step.k2[i] = change - h * k(6, i) - bend + late;
            step.k3[i] = -late;
        }
    }

    /// dx/dt at the end of the last attempt.
    pub(crate) fn last_slope(&self) -> &[f64] {
        let n = self.k.len() / 7;
        &self.k[6 * n..]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::order::violation;

    #[test]
    fn the_coefficients_satisfy_the_order_conditions() {
        let padded = |row: &[f64]| -> Vec<f64> { row.iter().copied().chain([0.0]).take(7).collect() };
        let alpha: Vec<Vec<f64>> = A.iter().map(|row| padded(row)).collect();
        let solution = alpha[6].clone();
        let embedded: Vec<f64> = solution.iter().zip(E).map(|(b, e)| b - e).collect();
        for size in 1..=5 {
            assert!(violation(size, 1.0, &solution, &alpha, &alpha) < 1e-14, "order {size}");
        }
        for size in 1..=4 {
            assert!(violation(size, 1.0, &embedded, &alpha, &alpha) < 1e-14, "embedded order {size}");
        }
        for theta in [0.1, 0.5, 0.77] {
            let first = |i: usize| f64::from(i == 0);
            let last = |i: usize| f64::from(i == 6);
            let weight = |i: usize| {
                let (k1, k3) = (first(i) - solution[i], -D[i]);
                let k2 = solution[i] - last(i) - k1 + D[i];
                theta * (solution[i] + (1.0 - theta) * (k1 + theta * (k2 + theta * k3)))
            };
            let dense: Vec<f64> = (0..7).map(weight).collect();
            for size in 1..=4 {
                assert!(violation(size, theta, &dense, &alpha, &alpha) < 1e-14, "dense order {size} at {theta}");
            }
        }
        for (c, row) in C.iter().zip(&alpha) {
            assert!((c - row.iter().sum::<f64>()).abs() < 1e-15);
        }
    }
}
