//! Dense linear least squares with few columns and many rows: reduction to a triangle, and singular values.
//!
//! In: columns. Out: R and Qᵀf of a QR factorisation, and singular value decompositions of small matrices. All sums are
//! in the order of the rows, so the bits do not depend on the processor.

/// R and Qᵀf of a matrix of n columns and a right-hand side f.
#[derive(Clone, PartialEq, Debug)]
pub struct Triangle {
    /// Number of columns.
    pub n: usize,
    /// R, row by row: n rows of n numbers, 0 below the diagonal.
    pub r: Vec<f64>,
    /// The first n numbers of Qᵀf.
    pub qf: Vec<f64>,
    /// Sum of squares of the rest of Qᵀf: what no solution can reduce.
    pub rest: f64,
    /// Number of rows.
    pub rows: usize,
}

impl Triangle {
    /// Without rows yet.
    pub fn new(n: usize) -> Triangle {
        Triangle { n, r: vec![0.0; n * n], qf: vec![0.0; n], rest: 0.0, rows: 0 }
    }

    /// Adds a row by Givens rotations (Golub, Van Loan, Matrix Computations, sec. 5.2.5). `row` is used up.
    pub fn add(&mut self, row: &mut [f64], mut f: f64) {
        let n = self.n;
        assert_eq!(row.len(), n, "a row of another matrix");
        for k in 0..n {
            let b = row[k];
            if b == 0.0 {
                continue;
            }
            let a = self.r[k * n + k];
            // Scaled, so that squares neither overflow nor vanish.
            let scale = a.abs().max(b.abs());
            let length = scale * ((a / scale) * (a / scale) + (b / scale) * (b / scale)).sqrt();
            let (c, s) = (a / length, b / length);
            self.r[k * n + k] = length;
            for (upper, lower) in self.r[k * n + k + 1..(k + 1) * n].iter_mut().zip(&mut row[k + 1..]) {
                (*upper, *lower) = (c * *upper + s * *lower, c * *lower - s * *upper);
            }
            let upper = self.qf[k];
            self.qf[k] = c * upper + s * f;
            f = c * f - s * upper;
        }
        self.rest += f * f;
        self.rows += 1;
    }

    /// ‖f‖².
    pub fn square(&self) -> f64 {
        self.qf.iter().map(|f| f * f).sum::<f64>() + self.rest
    }

    /// The gradient Jᵀf.
    pub fn gradient(&self) -> Vec<f64> {
        let n = self.n;
        (0..n).map(|j| (0..=j).map(|k| self.r[k * n + j] * self.qf[k]).sum()).collect()
    }

    /// Lengths of the columns.
    pub fn lengths(&self) -> Vec<f64> {
        let n = self.n;
        let square = |j: usize| (0..=j).map(|k| self.r[k * n + j] * self.r[k * n + j]).sum::<f64>();
        (0..n).map(|j| square(j).sqrt()).collect()
    }

    /// ‖R s‖².
    pub fn form(&self, s: &[f64]) -> f64 {
        let n = self.n;
        let row = |k: usize| (k..n).map(|j| self.r[k * n + j] * s[j]).sum::<f64>();
        (0..n).map(|k| row(k) * row(k)).sum()
    }

    /// sᵀ Rᵀ R t.
    pub fn product(&self, s: &[f64], t: &[f64]) -> f64 {
        let n = self.n;
        let row = |k: usize, s: &[f64]| (k..n).map(|j| self.r[k * n + j] * s[j]).sum::<f64>();
        (0..n).map(|k| row(k, s) * row(k, t)).sum()
    }
}

/// Singular values of a matrix, descending, with their right vectors and Uᵀf.
#[derive(Clone, PartialEq, Debug)]
pub struct Singular {
    /// Singular values, descending.
    pub values: Vec<f64>,
    /// The right vector of each value.
    pub vectors: Vec<Vec<f64>>,
    /// Uᵀf, one number for each value; 0 where the value is 0.
    pub uf: Vec<f64>,
}

/// Singular value decomposition by one-sided Jacobi rotations (Golub, Van Loan, sec. 8.6.3). `columns`: n columns of
/// equal length; `f`: as long.
pub fn singular(mut columns: Vec<Vec<f64>>, f: &[f64]) -> Singular {
    let n = columns.len();
    let mut vectors: Vec<Vec<f64>> = (0..n).map(|k| (0..n).map(|j| f64::from(u8::from(j == k))).collect()).collect();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    for _ in 0..60 {
        let mut rotated = false;
        for i in 0..n {
            for j in i + 1..n {
                let (a, b) = (dot(&columns[i], &columns[i]), dot(&columns[j], &columns[j]));
                let c = dot(&columns[i], &columns[j]);
                if c.abs() <= 1e-16 * (a * b).sqrt() || c == 0.0 {
                    continue;
                }
                rotated = true;
                let zeta = (b - a) / (2.0 * c);
                let t = f64::copysign(1.0, zeta) / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
                let cos = 1.0 / (1.0 + t * t).sqrt();
                let sin = cos * t;
                for pair in [&mut columns, &mut vectors] {
                    let (head, tail) = pair.split_at_mut(j);
                    for (x, y) in head[i].iter_mut().zip(&mut tail[0]) {
                        (*x, *y) = (cos * *x - sin * *y, sin * *x + cos * *y);
                    }
                }
            }
        }
        if !rotated {
            break;
        }
    }
    let lengths: Vec<f64> = columns.iter().map(|column| dot(column, column).sqrt()).collect();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| lengths[*b].total_cmp(&lengths[*a]));
    let uf = |k: usize| if lengths[k] > 0.0 { dot(&columns[k], f) / lengths[k] } else { 0.0 };
    Singular {
        uf: order.iter().map(|k| uf(*k)).collect(),
        values: order.iter().map(|k| lengths[*k]).collect(),
        vectors: order.iter().map(|k| vectors[*k].clone()).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    fn columns(seed: u64) -> (Vec<Vec<f64>>, Vec<f64>) {
        let mut chance = Chance(seed);
        let (n, rows) = (1 + chance.below(7) as usize, 8 + chance.below(40) as usize);
        let mut column = |scale: f64| (0..rows).map(|_| scale * chance.between(-1.0, 1.0)).collect::<Vec<f64>>();
        let all = (0..n).map(|k| column(10f64.powi(k as i32 - 3))).collect();
        (all, column(1.0))
    }

    /// JᵀJ and Jᵀf are those of the triangle.
    #[test]
    fn a_triangle_has_the_products_of_its_rows() {
        for seed in 0..100 {
            let (columns, f) = columns(seed);
            let n = columns.len();
            let mut triangle = Triangle::new(n);
            for row in 0..f.len() {
                triangle.add(&mut columns.iter().map(|column| column[row]).collect::<Vec<_>>(), f[row]);
            }
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let near = |a: f64, b: f64, scale: f64| (a - b).abs() <= 1e-12 * scale;
            let gradient = triangle.gradient();
            let unit = |k: usize| (0..n).map(|j| f64::from(u8::from(j == k))).collect::<Vec<f64>>();
            for i in 0..n {
                let length = dot(&columns[i], &columns[i]).sqrt();
                assert!(near(gradient[i], dot(&columns[i], &f), length * dot(&f, &f).sqrt()), "seed {seed}");
                for j in 0..n {
                    let other = dot(&columns[j], &columns[j]).sqrt();
                    let found = triangle.product(&unit(i), &unit(j));
                    assert!(near(found, dot(&columns[i], &columns[j]), length * other), "seed {seed}: {i} {j}");
                }
            }
            assert!(near(triangle.square(), dot(&f, &f), dot(&f, &f)), "seed {seed}");
        }
    }

    #[test]
    fn singular_vectors_are_orthogonal_and_reproduce_the_matrix() {
        for seed in 0..100 {
            let (columns, f) = columns(seed);
            let n = columns.len();
            let found = singular(columns.clone(), &f);
            assert!(found.values.windows(2).all(|pair| pair[0] >= pair[1]), "seed {seed}");
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            for i in 0..n {
                for j in 0..n {
                    let expected = f64::from(u8::from(i == j));
                    assert!((dot(&found.vectors[i], &found.vectors[j]) - expected).abs() < 1e-12, "seed {seed}");
                    // AᵀA = V s² Vᵀ
                    let product: f64 = (0..n)
                        .map(|k| found.values[k] * found.values[k] * found.vectors[k][i] * found.vectors[k][j])
                        .sum();
                    let scale = found.values[0] * found.values[0];
                    assert!((product - dot(&columns[i], &columns[j])).abs() < 1e-12 * scale, "seed {seed}");
                }
            }
        }
    }
}
