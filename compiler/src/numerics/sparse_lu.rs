//! Gauss elimination of small sparse systems, unrolled into formulas.
//!
//! In: the rows of a matrix as values of a builder. Out: its factors, and solutions of right sides. The order of
//! elimination is fixed here, by where entries can be at all, not by their size; whether a pivot came out too small is
//! told as a truth value.

use crate::ir::expr::{Real, Truth};
use crate::numerics::autodiff::Gradient;
use std::collections::{BTreeMap, HashMap};

/// A sparse square matrix, row by row.
pub struct Matrix<'a> {
    rows: Vec<BTreeMap<usize, Real<'a>>>,
}

/// A = L U, with the order in which rows and columns are eliminated.
pub struct Factors<'a> {
    order: Vec<usize>,
    /// Below the pivots, in the columns eliminated before: the multipliers; the rest: U.
    rows: Vec<BTreeMap<usize, Real<'a>>>,
    /// 1/pivot of each row.
    inverse: HashMap<usize, Real<'a>>,
    /// Whether a pivot is too small.
    pub singular: Option<Truth<'a>>,
}

impl<'a> Matrix<'a> {
    /// I − c · J
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

    /// Gauss elimination, unrolled. The order is fixed: at each turn the diagonal entry whose elimination can fill in
    /// least (Markowitz), the first among equals.
    ///
    /// A pivot smaller than `least` of the rest of its row is too small.
    pub fn factorise(self, least: f64) -> Factors<'a> {
        let mut rows = self.rows;
        let n = rows.len();
        let mut left: Vec<usize> = (0..n).collect();
        let mut factors = Factors { order: Vec::new(), rows: Vec::new(), inverse: HashMap::new(), singular: None };
        while !left.is_empty() {
            let in_row = |p: usize, left: &[usize]| left.iter().filter(|j| rows[p].contains_key(j)).count() - 1;
            let in_column = |p: usize, left: &[usize]| left.iter().filter(|i| rows[**i].contains_key(&p)).count() - 1;
            let cost = |p: &usize| (in_row(*p, &left) * in_column(*p, &left), *p);
            let pivot = left.iter().copied().min_by_key(cost).expect("one is left");
            left.retain(|i| *i != pivot);
            let diagonal = rows[pivot][&pivot];
            let others: Vec<Real> = left.iter().filter_map(|j| rows[pivot].get(j).copied()).collect();
            // A row of its own pivot only is as good as its pivot is not 0.
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
                left.iter().filter_map(|j| rows[pivot].get(j).map(|entry| (*j, *entry))).collect();
            for &i in &left {
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
    /// x of A x = `right`.
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
