//! Symbolic sparse LU factorisation: Gauss elimination of small sparse systems, unrolled into operations.
//!
//! In: the rows of a matrix, as values of a builder. Out: its factors, and solutions for right-hand sides. The order of
//! elimination is chosen at compile time from the sparsity pattern, not from the size of the entries. A Boolean value
//! reports at run time whether a pivot is too small.
//!
//! Source: Duff, Erisman, Reid, *Direct Methods for Sparse Matrices*, 1986; order of elimination: Markowitz, 1957.

use crate::ir::expr::{Real, Truth};
use crate::ir::hash::HashMap;
use crate::numerics::autodiff::Gradient;
use std::collections::BTreeMap;

/// A sparse square matrix, row by row.
pub struct Matrix<'a> {
    rows: Vec<BTreeMap<usize, Real<'a>>>,
}

/// A = L U, with the order in which rows and columns are eliminated.
pub struct Factors<'a> {
    order: Vec<usize>,
    /// The multipliers of L in the columns eliminated before the row's pivot, and U in the other columns.
    rows: Vec<BTreeMap<usize, Real<'a>>>,
    /// 1/pivot of each row.
    inverse: HashMap<usize, Real<'a>>,
    /// Whether a pivot is too small. `None` for the empty matrix.
    pub singular: Option<Truth<'a>>,
}

impl<'a> Matrix<'a> {
    /// I − c · J. `jacobian`: the rows of J.
    pub fn identity_less(c: Real<'a>, jacobian: &[Gradient]) -> Matrix<'a> {
        let row = |(i, gradient): (usize, &Gradient)| {
            let mut row: BTreeMap<usize, Real> = BTreeMap::from([(i, c.constant(1.0))]);
            for (j, d) in gradient {
                let product = c * c.same(*d);
                let entry = if i == *j as usize { 1.0 - product } else { -product };
                row.insert(*j as usize, entry);
            }
            row
        };
        Matrix { rows: jacobian.iter().enumerate().map(row).collect() }
    }

    /// Factorises the matrix. Each step eliminates the diagonal entry that can cause the least fill-in (Markowitz), the
    /// first among equals.
    ///
    /// `least`: a pivot is too small if it is at most this fraction of the largest other entry of its row.
    pub fn factorise(self, least: f64) -> Factors<'a> {
        let mut rows = self.rows;
        let n = rows.len();
        let mut remaining: Vec<usize> = (0..n).collect();
        let mut factors = Factors { order: Vec::new(), rows: Vec::new(), inverse: HashMap::default(), singular: None };
        while !remaining.is_empty() {
            let in_row =
                |p: usize, remaining: &[usize]| remaining.iter().filter(|j| rows[p].contains_key(j)).count() - 1;
            let in_column =
                |p: usize, remaining: &[usize]| remaining.iter().filter(|i| rows[**i].contains_key(&p)).count() - 1;
            let cost = |p: &usize| (in_row(*p, &remaining) * in_column(*p, &remaining), *p);
            let pivot = remaining.iter().copied().min_by_key(cost).expect("one remains");
            remaining.retain(|i| *i != pivot);
            let diagonal = rows[pivot][&pivot];
            let others: Vec<Real> = remaining.iter().filter_map(|j| rows[pivot].get(j).copied()).collect();
            // A row without other entries only needs a pivot that is not 0.
            let size = others.into_iter().map(Real::abs).reduce(|a, b| a.below(b).choose(b, a));
            let small = match size {
                Some(size) => !diagonal.abs().above(least * size),
                None => !diagonal.abs().above(0.0),
            };
            factors.singular = Some(factors.singular.map_or(small, |any| any | small));
            let inverse = 1.0 / diagonal;
            factors.inverse.insert(pivot, inverse);
            factors.order.push(pivot);
            let of_pivot: Vec<(usize, Real)> =
                remaining.iter().filter_map(|j| rows[pivot].get(j).map(|entry| (*j, *entry))).collect();
            for &i in &remaining {
                let Some(entry) = rows[i].get(&pivot).copied() else { continue };
                let multiplier = entry * inverse;
                rows[i].insert(pivot, multiplier);
                for &(j, above) in &of_pivot {
                    let reduced = match rows[i].get(&j) {
                        Some(entry) => (-multiplier).fma(above, *entry),
                        None => -(multiplier * above),
                    };
                    rows[i].insert(j, reduced);
                }
            }
        }
        factors.rows = rows;
        factors
    }
}

impl<'a> Factors<'a> {
    /// The solution x of A x = `right`.
    pub fn solve(&self, right: &[Real<'a>]) -> Vec<Real<'a>> {
        let mut x = right.to_vec();
        for (k, &i) in self.order.iter().enumerate() {
            for &j in &self.order[..k] {
                if let Some(multiplier) = self.rows[i].get(&j) {
                    x[i] = (-*multiplier).fma(x[j], x[i]);
                }
            }
        }
        for (k, &i) in self.order.iter().enumerate().rev() {
            for &j in &self.order[k + 1..] {
                if let Some(entry) = self.rows[i].get(&j) {
                    x[i] = (-*entry).fma(x[j], x[i]);
                }
            }
            x[i] = x[i] * self.inverse[&i];
        }
        x
    }
}
