//! Sparse LU factorisation for large linear systems.
//!
//! In: a sparsity pattern, then values. Out: factors and solutions. Columns are eliminated in a minimum-degree order,
//! computed once; rows are chosen by partial pivoting that prefers the diagonal unless it is much smaller. Sources:
//! George & Liu, Computer Solution of Large Sparse Positive Definite Systems, ch. 5 (order); Gilbert & Peierls, Sparse
//! partial pivoting in time proportional to arithmetic operations, SIAM J. Sci. Stat. Comput. 9 (1988).

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};

/// Smallest accepted diagonal pivot relative to the largest candidate: fill-in costs more than the lost digits.
const LEAST_DIAGONAL: f64 = 0.1;

/// The remaining columns are eliminated in their given order once each has more neighbours than this.
const MOST_NEIGHBOURS: usize = 100;

const NONE: u32 = u32::MAX;

/// The sparsity pattern of a matrix, and its factors.
pub(crate) struct Sparse {
    n: usize,
    /// Column j has the rows and entries `begin[j]..begin[j + 1]`.
    begin: Vec<usize>,
    rows: Vec<u32>,
    entries: Vec<u32>,
    /// The column that is eliminated in step k, and its pivot row.
    order: Vec<u32>,
    pivot_rows: Vec<u32>,
    /// The step in which a row became a pivot row.
    taken: Vec<u32>,
    /// Factors by step: L below its unit diagonal, with rows of the matrix; U above its diagonal, with steps; and the
    /// inverse of U's diagonal.
    lower: Columns,
    upper: Columns,
    inverse: Vec<f64>,
    /// The column being eliminated, the rows where it has entries, and a flag for each row.
    x: Vec<f64>,
    touched: Vec<u32>,
    marked: Vec<bool>,
    /// Steps whose column is to be subtracted, as a min-heap.
    due: BinaryHeap<Reverse<u32>>,
    y: Vec<f64>,
}

/// Columns of a triangular factor, one after the other.
#[derive(Default)]
struct Columns {
    /// End of each column.
    ends: Vec<usize>,
    entries: Vec<(u32, f64)>,
}

impl Columns {
    fn clear(&mut self) {
        self.ends.clear();
        self.entries.clear();
    }

    fn end(&mut self) {
        self.ends.push(self.entries.len());
    }

    fn of(&self, k: usize) -> &[(u32, f64)] {
        let start = if k == 0 { 0 } else { self.ends[k - 1] };
        &self.entries[start..self.ends[k]]
    }
}

impl Sparse {
    /// For an n × n matrix with these entries (row, column), sorted by rows and then columns.
    pub(crate) fn new(n: usize, entries: &[(u32, u32)]) -> Sparse {
        let mut begin = vec![0; n + 1];
        entries.iter().for_each(|(_, column)| begin[*column as usize + 1] += 1);
        for j in 0..n {
            begin[j + 1] += begin[j];
        }
        let mut next = begin.clone();
        let (mut rows, mut of) = (vec![0; entries.len()], vec![0; entries.len()]);
        for (k, (row, column)) in entries.iter().enumerate() {
            let at = &mut next[*column as usize];
            (rows[*at], of[*at]) = (*row, k as u32);
            *at += 1;
        }
        Sparse {
            n,
            begin,
            rows,
            entries: of,
            order: order(n, entries),
            pivot_rows: vec![NONE; n],
            taken: vec![NONE; n],
            lower: Columns::default(),
            upper: Columns::default(),
            inverse: vec![0.0; n],
            x: vec![0.0; n],
            touched: Vec::with_capacity(n),
            marked: vec![false; n],
            due: BinaryHeap::new(),
            y: vec![0.0; n],
        }
    }

    /// Factors d·I − J, where `values` are the entries of J. Returns whether every pivot is a number other than 0.
    pub(crate) fn factor(&mut self, d: f64, values: &[f64]) -> bool {
        self.lower.clear();
        self.upper.clear();
        self.taken.fill(NONE);
        for k in 0..self.n {
            let column = self.order[k];
            self.touch(column);
            self.x[column as usize] = d;
            for at in self.begin[column as usize]..self.begin[column as usize + 1] {
                let row = self.rows[at];
                self.touch(row);
                self.x[row as usize] -= values[self.entries[at] as usize];
            }
            // Subtract the earlier columns that affect this one, in order. Each affects only later ones.
            while let Some(Reverse(step)) = self.due.pop() {
                let row = self.pivot_rows[step as usize];
                let part = self.x[row as usize];
                self.upper.entries.push((step, part));
                if part == 0.0 {
                    continue;
                }
                for at in 0..self.lower.of(step as usize).len() {
                    let (row, factor) = self.lower.of(step as usize)[at];
                    self.touch(row);
                    self.x[row as usize] -= part * factor;
                }
            }
            self.upper.end();
            let pivot = self.pivot(column);
            let found = pivot.map_or(f64::INFINITY, |row| 1.0 / self.x[row as usize]);
            let fine = found.is_finite();
            if let Some(row) = pivot.filter(|_| fine) {
                (self.pivot_rows[k], self.taken[row as usize], self.inverse[k]) = (row, k as u32, found);
            }
            for row in self.touched.drain(..) {
                let x = std::mem::take(&mut self.x[row as usize]);
                self.marked[row as usize] = false;
                if self.taken[row as usize] == NONE && x != 0.0 {
                    self.lower.entries.push((row, x * found));
                }
            }
            self.lower.end();
            if !fine {
                return false;
            }
        }
        true
    }

    /// Marks a row of the current column as used; if it is a pivot row, schedules its step.
    fn touch(&mut self, row: u32) {
        if !std::mem::replace(&mut self.marked[row as usize], true) {
            self.touched.push(row);
            if self.taken[row as usize] != NONE {
                self.due.push(Reverse(self.taken[row as usize]));
            }
        }
    }

    /// The pivot row: the diagonal one if it is large enough, else the largest.
    fn pivot(&self, column: u32) -> Option<u32> {
        let size = |row: u32| self.x[row as usize].abs();
        let free = || self.touched.iter().copied().filter(|row| self.taken[*row as usize] == NONE);
        let largest = free().reduce(|largest, row| if size(row) > size(largest) { row } else { largest })?;
        let diagonal = self.taken[column as usize] == NONE && size(column) >= LEAST_DIAGONAL * size(largest);
        Some(if diagonal { column } else { largest })
    }

    /// Replaces the right-hand side `b` by the solution.
    pub(crate) fn solve(&mut self, b: &mut [f64]) {
        for k in 0..self.n {
            let part = b[self.pivot_rows[k] as usize];
            self.y[k] = part;
            if part != 0.0 {
                for (row, factor) in self.lower.of(k) {
                    b[*row as usize] -= part * factor;
                }
            }
        }
        for k in (0..self.n).rev() {
            let part = self.y[k] * self.inverse[k];
            b[self.order[k] as usize] = part;
            if part != 0.0 {
                for (step, factor) in self.upper.of(k) {
                    self.y[*step as usize] -= part * factor;
                }
            }
        }
    }
}

/// Minimum-degree order of the columns in the graph of the matrix plus its transpose. Eliminating a column connects its
/// neighbours; ties go to the lower index.
fn order(n: usize, entries: &[(u32, u32)]) -> Vec<u32> {
    let mut neighbours: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); n];
    for &(row, column) in entries.iter().filter(|(row, column)| row != column) {
        neighbours[row as usize].insert(column);
        neighbours[column as usize].insert(row);
    }
    let mut queue: BTreeSet<(usize, u32)> = (0..n).map(|k| (neighbours[k].len(), k as u32)).collect();
    let mut order = Vec::with_capacity(n);
    while let Some((degree, column)) = queue.pop_first() {
        if degree > MOST_NEIGHBOURS {
            let mut rest: Vec<u32> = queue.iter().map(|(_, column)| *column).chain([column]).collect();
            rest.sort_unstable();
            order.extend(rest);
            break;
        }
        order.push(column);
        let joined = std::mem::take(&mut neighbours[column as usize]);
        for &one in &joined {
            let before = neighbours[one as usize].len();
            neighbours[one as usize].remove(&column);
            neighbours[one as usize].extend(joined.iter().filter(|other| **other != one));
            let now = neighbours[one as usize].len();
            if now != before {
                queue.remove(&(before, one));
                queue.insert((now, one));
            }
        }
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in −1..1 from a seed, by a linear congruential generator.
    fn numbers(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        }
    }

    /// Largest error of a solution of (d·I − J) x = b, and the number of entries of the factors.
    fn residual(n: usize, d: f64, entries: &[(u32, u32)], seed: u64) -> (f64, usize) {
        let mut number = numbers(seed);
        let values: Vec<f64> = entries.iter().map(|_| number()).collect();
        let solution: Vec<f64> = (0..n).map(|_| number()).collect();
        let mut b: Vec<f64> = solution.iter().map(|x| d * x).collect();
        for ((row, column), value) in entries.iter().zip(&values) {
            b[*row as usize] -= value * solution[*column as usize];
        }
        let mut sparse = Sparse::new(n, entries);
        // Twice: nothing of the first matrix remains.
        assert!(sparse.factor(2.0 * d + 1.0, &values));
        assert!(sparse.factor(d, &values), "seed {seed}");
        sparse.solve(&mut b);
        let worst = b.iter().zip(&solution).fold(0.0, |worst: f64, (got, wanted)| worst.max((got - wanted).abs()));
        (worst, sparse.lower.entries.len() + sparse.upper.entries.len())
    }

    fn chain(n: u32) -> Vec<(u32, u32)> {
        let near = |i: u32| [i.checked_sub(1), Some(i), (i + 1 < n).then_some(i + 1)];
        (0..n).flat_map(|i| near(i).into_iter().flatten().map(move |j| (i, j))).collect()
    }

    #[test]
    fn chains_stars_and_random_systems_are_solved() {
        for seed in 0..20 {
            let (worst, filled) = residual(300, 4.0, &chain(300), seed);
            assert!(worst < 1e-12 && filled <= 600, "{worst}, {filled}");
            // The first state is coupled with all others.
            let star: Vec<(u32, u32)> = (0..300)
                .flat_map(|i| if i == 0 { (0..300).map(|j| (0, j)).collect() } else { vec![(i, 0), (i, i)] })
                .collect();
            let (worst, filled) = residual(300, 40.0, &star, seed);
            assert!(worst < 1e-12 && filled <= 600, "{worst}, {filled}");
            let mut number = numbers(seed + 100);
            let mut random: Vec<(u32, u32)> =
                (0..200).map(|_| ((20.0 * number().abs()) as u32, (20.0 * number().abs()) as u32)).collect();
            random.sort_unstable();
            random.dedup();
            assert!(residual(20, 0.7, &random, seed).0 < 1e-8, "seed {seed}");
            // Empty diagonal: rows are exchanged.
            assert!(residual(20, 0.0, &random, seed).0 < 1e-6, "seed {seed}");
        }
    }

    #[test]
    fn a_singular_system_is_reported_and_leaves_no_state() {
        let mut sparse = Sparse::new(2, &[(0, 0), (0, 1), (1, 0), (1, 1)]);
        assert!(!sparse.factor(0.0, &[1.0, 2.0, 2.0, 4.0]));
        assert!(!sparse.factor(0.0, &[f64::NAN, 2.0, 2.0, 4.0]));
        assert!(sparse.factor(0.0, &[-1.0, -2.0, -2.0, -3.0]));
        let mut b = [5.0, 8.0];
        sparse.solve(&mut b);
        assert!((b[0] - 1.0).abs() < 1e-12 && (b[1] - 2.0).abs() < 1e-12, "{b:?}");
        assert!(Sparse::new(0, &[]).factor(1.0, &[]));
    }
}
