//! The stiff method: Rodas5P, a Rosenbrock method of order 5(4) with eight stages, L-stable and stiffly accurate, with
//! a continuous extension of order four. One Jacobian, one factorisation, eight solves; no iteration.
//!
//!   (I/(γh) − J) u_i = f(t + c_i h, x0 + Σ_j A_ij u_j) + Σ_j (C_ij/h) u_j + h d_i ∂f/∂t       j < i
//!   x1 = x0 + Σ_j A_8j u_j + u_8,   error ≈ u_8
//!
//! Source: Steinebach, Construction of Rosenbrock–Wanner method Rodas5P and numerical benchmarks within the Julia
//! Differential Equations package, BIT Numer. Math. 63:27 (2023); form of the stages: Hairer & Wanner, Solving ODEs II,
//! eq. IV.7.25. The tests check the order conditions of the coefficients as they stand here.

use super::linear;
use super::sparse::Sparse;
use super::step::{Step, System};
use abi::rosenbrock::coefficients::{A, C, D, GAMMA, H, STAGES, W};

/// Buffers for the stages and the matrix.
pub(crate) struct Rosenbrock {
    /// u_1 … u_8, one after the other.
    u: Vec<f64>,
    /// Factors of I/(γh) − J, dense.
    matrix: Vec<f64>,
    rows: Vec<usize>,
    /// Used instead for a model with a known sparsity pattern.
    sparse: Option<Sparse>,
    x: Vec<f64>,
    f: Vec<f64>,
    /// The arguments at which the stages after the first evaluate f, one after the other.
    arguments: Vec<f64>,
    attempt: fn(&mut Rosenbrock, &mut System, &mut Step, &[f64]) -> bool,
}

impl Rosenbrock {
    /// For n states; `coupled`: the sparsity pattern of the Jacobian, if it is not dense.
    pub(crate) fn new(n: usize, coupled: Option<&[(u32, u32)]>) -> Rosenbrock {
        let attempt = match n {
            1 => Rosenbrock::stages::<1>,
            2 => Rosenbrock::stages::<2>,
            3 => Rosenbrock::stages::<3>,
            4 => Rosenbrock::stages::<4>,
            5 => Rosenbrock::stages::<5>,
            6 => Rosenbrock::stages::<6>,
            7 => Rosenbrock::stages::<7>,
            8 => Rosenbrock::stages::<8>,
            _ => Rosenbrock::stages::<0>,
        };
        let zeros = || vec![0.0; n];
        Rosenbrock {
            u: vec![0.0; STAGES * n],
            matrix: vec![0.0; if coupled.is_some() { 0 } else { n * n }],
            rows: vec![0; n],
            sparse: coupled.map(|coupled| Sparse::new(n, coupled)),
            x: zeros(),
            f: zeros(),
            arguments: vec![0.0; (STAGES - 1) * n],
            attempt,
        }
    }

    /// Computes the step from its `t`, `h`, `end`, `x0` and `f0`, given the Jacobian at its start: ∂f/∂x, then ∂f/∂t.
    ///
    /// Returns false if the matrix is singular; a shorter step then helps.
    pub(crate) fn attempt(&mut self, system: &mut System, step: &mut Step, jacobian: &[f64]) -> bool {
        (self.attempt)(self, system, step, jacobian)
    }

    /// Times in s and states at which the last attempt evaluated f, without the start.
    pub(crate) fn arguments(&self, step: &Step) -> impl Iterator<Item = (f64, &[f64])> {
        let n = self.f.len();
        let (t, h, end) = (step.t, step.h, step.end);
        let times = (1..STAGES).map(move |stage| if stage < 5 { t + C[stage] * h } else { end });
        times.zip(self.arguments.chunks_exact(n.max(1)))
    }

    fn stages<const N: usize>(&mut self, system: &mut System, step: &mut Step, jacobian: &[f64]) -> bool {
        let n = if N == 0 { system.n } else { N };
        let h = step.h;
        let (df_dx, df_dt) =
            if N == 0 { jacobian.split_at(jacobian.len() - n) } else { jacobian[..n * n + n].split_at(n * n) };
        let regular = match &mut self.sparse {
            Some(sparse) if N == 0 => sparse.factor(1.0 / (GAMMA * h), df_dx),
            _ => {
                let (matrix, rows) = (&mut self.matrix[..n * n], &mut self.rows[..n]);
                for (entry, j) in matrix.iter_mut().zip(df_dx) {
                    *entry = -j;
                }
                for i in 0..n {
                    matrix[i * n + i] += 1.0 / (GAMMA * h);
                }
                linear::factor::<N>(n, matrix, rows)
            }
        };
        if !regular {
            return false;
        }
        self.stage::<N, 0>(system, step, df_dt);
        self.stage::<N, 1>(system, step, df_dt);
        self.stage::<N, 2>(system, step, df_dt);
        self.stage::<N, 3>(system, step, df_dt);
        self.stage::<N, 4>(system, step, df_dt);
        self.stage::<N, 5>(system, step, df_dt);
        self.stage::<N, 6>(system, step, df_dt);
        self.stage::<N, 7>(system, step, df_dt);
        let x = &self.x[..n];
        let u = &self.u[..STAGES * n];
        for i in 0..n {
            let last = u[7 * n + i];
            step.x1[i] = x[i] + last;
            step.error[i] = last;
            step.k1[i] = combine::<STAGES>(&H[0], u, n, i);
            step.k2[i] = combine::<STAGES>(&H[1], u, n, i);
            step.k3[i] = combine::<STAGES>(&H[2], u, n, i);
        }
        true
    }

    /// Stage `S`, counted from 0. A separate instance for each stage, so that all weights are constants of the code.
    #[inline(always)]
    fn stage<const N: usize, const S: usize>(&mut self, system: &mut System, step: &Step, df_dt: &[f64]) {
        let n = if N == 0 { system.n } else { N };
        let (x, f) = (&mut self.x[..n], &mut self.f[..n]);
        let (done, rest) = self.u.split_at_mut(S * n);
        let u = &mut rest[..n];
        if S == 0 {
            f.copy_from_slice(&step.f0[..n]);
        } else {
            for i in 0..n {
                x[i] =
                    if S < 6 { step.x0[i] + combine::<S>(&A[S % 6], done, n, i) } else { x[i] + done[(S - 1) * n + i] };
            }
            self.arguments[(S - 1) * n..S * n].copy_from_slice(x);
            let t = if S < 5 { step.t + C[S] * step.h } else { step.end };
            system.sized_slope::<N>(t, x, f);
        }
        let per_step = 1.0 / step.h;
        for i in 0..n {
            u[i] = f[i] + per_step * combine::<S>(&W[S], done, n, i) + step.h * D[S] * df_dt[i];
        }
        match &mut self.sparse {
            Some(sparse) if N == 0 => sparse.solve(u),
            _ => linear::solve::<N>(n, &self.matrix, &self.rows, u),
        }
    }
}

/// The sum over the first `COUNT` stages of their weights times entry `i`.
#[inline(always)]
fn combine<const COUNT: usize>(weights: &[f64], u: &[f64], n: usize, i: usize) -> f64 {
    let mut sum = 0.0;
    for stage in 0..COUNT.min(weights.len()) {
        sum += weights[stage] * u[stage * n + i];
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::order::violation;
    use crate::testing::models;

    type Matrix = Vec<Vec<f64>>;

    /// α, β = α + Γ and Γ of the classical form; weights w of the u are weights wΓ of the k.
    fn classical() -> (Matrix, Matrix, Matrix) {
        // Γ⁻¹ = I/γ − W is lower triangular: by rows from Γ = γ (I + W Γ).
        let mut gamma: Matrix = Vec::new();
        for (row, weights) in W.iter().enumerate() {
            let entry = |column: usize| {
                let sum: f64 = gamma.iter().zip(weights).map(|(above, w)| w * above[column]).sum();
                GAMMA * (sum + f64::from(row == column))
            };
            gamma.push((0..STAGES).map(entry).collect());
        }
        let alpha: Matrix = (0..STAGES).map(|stage| turn(&arguments(stage), &gamma)).collect();
        let beta = alpha.iter().zip(&gamma).map(|(a, g)| a.iter().zip(g).map(|(a, g)| a + g).collect()).collect();
        (alpha, beta, gamma)
    }

    /// Weights of the k from weights of the u.
    fn turn(weights: &[f64], gamma: &Matrix) -> Vec<f64> {
        (0..STAGES).map(|j| weights.iter().zip(gamma).map(|(w, row)| w * row[j]).sum()).collect()
    }

    /// Weights of all stages in the argument of one, or for stage 8 in the solution.
    fn arguments(stage: usize) -> Vec<f64> {
        let mut weights = vec![0.0; STAGES];
        weights[..5].copy_from_slice(&A[stage.min(5)]);
        weights[5..].iter_mut().take(stage.saturating_sub(5)).for_each(|weight| *weight = 1.0);
        weights
    }

    #[test]
    fn the_coefficients_satisfy_the_order_conditions() {
        let (alpha, beta, gamma) = classical();
        let solution = turn(&arguments(8), &gamma);
        let embedded = turn(&arguments(7), &gamma);
        for size in 1..=5 {
            assert!(violation(size, 1.0, &solution, &alpha, &beta) < 1e-12, "order {size}");
        }
        assert!(violation(6, 1.0, &solution, &alpha, &beta) > 1e-5);
        for size in 1..=4 {
            assert!(violation(size, 1.0, &embedded, &alpha, &beta) < 1e-12, "embedded order {size}");
        }
        assert!(violation(5, 1.0, &embedded, &alpha, &beta) > 1e-4);
        for theta in [0.1, 0.5, 0.77] {
            let weight = |i: usize| {
                let bend = H[0][i] + theta * (H[1][i] + theta * H[2][i]);
                theta * (arguments(8)[i] + (1.0 - theta) * bend)
            };
            let dense = turn(&std::array::from_fn::<f64, STAGES, _>(weight), &gamma);
            for size in 1..=4 {
                assert!(violation(size, theta, &dense, &alpha, &beta) < 1e-12, "dense order {size} at {theta}");
            }
        }
    }

    #[test]
    fn nodes_are_the_sums_of_their_rows() {
        let (alpha, beta, _) = classical();
        for stage in 0..STAGES {
            let sum = |row: &[f64]| row.iter().sum::<f64>();
            assert!((sum(&alpha[stage]) - C[stage]).abs() < 1e-12, "node {stage}");
            assert!((sum(&beta[stage]) - sum(&alpha[stage]) - D[stage]).abs() < 1e-12, "weight of df/dt {stage}");
        }
    }

    /// x' = −x² cos t, x = 1/(1 + sin t), to t = 2 s: nonlinear and not autonomous.
    fn error(steps: u32) -> (f64, f64) {
        let instance = models::Model::new("Wave")
            .state("x", "m")
            .body(abi::Function::Derivatives, |m| m.set_dx(0, -m.x(0) * m.x(0) * m.t().cos()))
            .body(abi::Function::Jacobian, |m| {
                m.set_jacobian(&[-2.0 * m.x(0) * m.t().cos(), m.x(0) * m.x(0) * m.t().sin()]);
            })
            .build();
        let mut system = System::new(instance);
        let (mut method, mut step) = (Rosenbrock::new(1, None), Step::new(1));
        let exact = |t: f64| 1.0 / (1.0 + t.sin());
        let h = 2.0 / f64::from(steps);
        let (mut x, mut dense, mut j) = (1.0, 0.0f64, [0.0; 2]);
        for k in 0..steps {
            (step.t, step.h, step.end) = (f64::from(k) * h, h, f64::from(k + 1) * h);
            step.x0[0] = x;
            system.slope(step.t, &[x], &mut step.f0);
            system.jacobian(step.t, &[x], &step.f0, &[1.0], &mut j);
            assert!(method.attempt(&mut system, &mut step, &j));
            let mut middle = [0.0];
            step.at(0.5, &mut middle);
            dense = dense.max((middle[0] - exact(step.time(0.5))).abs());
            x = step.x1[0];
        }
        ((x - exact(2.0)).abs(), dense)
    }

    #[test]
    fn halving_the_step_shows_order_five_and_four_between() {
        let errors: Vec<(f64, f64)> = [20, 40, 80].map(error).into();
        for pair in errors.windows(2) {
            let order = |a: f64, b: f64| (a / b).log2();
            let (end, between) = (order(pair[0].0, pair[1].0), order(pair[0].1, pair[1].1));
            println!("order {end:.2} at the end, {between:.2} between");
            assert!((4.7..5.6).contains(&end), "order {end}");
            assert!((3.7..5.6).contains(&between), "order {between} between");
        }
    }
}
