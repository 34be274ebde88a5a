//! Order conditions of one-step methods, for tests.
//!
//! A Rosenbrock method x1 = x0 + Σ b_i k_i, k_i = h f(x0 + Σ α_ij k_j) + h J Σ γ_ij k_j has order p if for each rooted
//! tree of up to p vertices Σ b_i Φ_i = 1/γ(tree), where a vertex passes its only child through β = α + γ, and several
//! children through α. Source: Hairer & Wanner, Solving ODEs II, sec. IV.7, theorem 7.4; Runge-Kutta methods are the
//! case γ = 0.

/// A rooted tree: the subtrees at its root.
#[derive(Clone, PartialEq, PartialOrd, Debug)]
pub struct Tree(Vec<Tree>);

impl Tree {
    fn size(&self) -> usize {
        1 + self.0.iter().map(Tree::size).sum::<usize>()
    }

    /// γ(tree).
    fn density(&self) -> f64 {
        self.size() as f64 * self.0.iter().map(Tree::density).product::<f64>()
    }

    /// Φ_i.
    fn weight(&self, i: usize, alpha: &[Vec<f64>], beta: &[Vec<f64>]) -> f64 {
        let matrix = if self.0.len() == 1 { beta } else { alpha };
        let through = |child: &Tree| -> f64 {
            (0..alpha.len())
                .map(|j| if matrix[i][j] == 0.0 { 0.0 } else { matrix[i][j] * child.weight(j, alpha, beta) })
                .sum()
        };
        self.0.iter().map(through).product()
    }
}

/// All rooted trees of this many vertices.
pub fn trees(size: usize) -> Vec<Tree> {
    /// Multisets of trees of this total size, in ascending order, none before `from`.
    fn forests(size: usize, from: &[Tree]) -> Vec<Vec<Tree>> {
        if size == 0 {
            return vec![Vec::new()];
        }
        let mut all = Vec::new();
        for (i, tree) in from.iter().enumerate().filter(|(_, tree)| tree.size() <= size) {
            for mut rest in forests(size - tree.size(), &from[i..]) {
                rest.push(tree.clone());
                all.push(rest);
            }
        }
        all
    }
    let smaller: Vec<Tree> = (1..size).flat_map(trees).collect();
    forests(size - 1, &smaller).into_iter().map(Tree).collect()
}

/// Largest violation of the conditions of order `size` by weights `b`, at the fraction `theta` of the step.
pub fn violation(size: usize, theta: f64, b: &[f64], alpha: &[Vec<f64>], beta: &[Vec<f64>]) -> f64 {
    let worst = |tree: &Tree| {
        let sum: f64 = b.iter().enumerate().map(|(i, b)| b * tree.weight(i, alpha, beta)).sum();
        (sum - theta.powi(size as i32) / tree.density()).abs()
    };
    trees(size).iter().map(worst).fold(0.0, f64::max)
}

#[test]
fn there_are_as_many_trees_as_there_should_be() {
    assert_eq!([1, 2, 3, 4, 5, 6].map(|size| trees(size).len()), [1, 1, 2, 4, 9, 20]);
}
