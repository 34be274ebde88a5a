//! Minimises a function without its derivatives: CMA-ES.
//!
//! In: a start, a step, and a function of many points at once. Out: the best point that was met. The covariance of the
//! steps is learned from those that were successful. Source: Hansen, The CMA Evolution Strategy: A Tutorial,
//! arXiv:1604.00772, with the standard weights; steps are drawn, and the path of the step size is taken, by the Cholesky
//! factor of the covariance in place of its square root.

use crate::fit::Elementary;
use crate::rng::Chance;

/// How to search.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Search {
    /// Standard deviation of the first steps.
    pub step: f64,
    /// Most evaluations.
    pub evaluations: usize,
    /// Seed of the steps.
    pub seed: u64,
}

/// Finds a point at which the function is small; returns it with its value. A value that is no number is never best.
pub fn minimise(
    start: &[f64],
    search: Search,
    with: &Elementary,
    of: &mut dyn FnMut(&[Vec<f64>]) -> Vec<f64>,
) -> (Vec<f64>, f64) {
    let n = start.len();
    let dimension = n as f64;
    let population = 4 + (3.0 * (with.log)(dimension)) as usize;
    let parents = population / 2;
    let weights: Vec<f64> =
        (1..=parents).map(|k| (with.log)(0.5 * (population + 1) as f64) - (with.log)(k as f64)).collect();
    let total: f64 = weights.iter().sum();
    let weights: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
    let mass = 1.0 / weights.iter().map(|weight| weight * weight).sum::<f64>();
    // Rates of learning: of the path and of the size of steps, of the path and of both updates of their covariance.
    let c_size = (mass + 2.0) / (dimension + mass + 5.0);
    let damping = 1.0 + 2.0 * (((mass - 1.0) / (dimension + 1.0)).sqrt() - 1.0).max(0.0) + c_size;
    let c_path = (4.0 + mass / dimension) / (dimension + 4.0 + 2.0 * mass / dimension);
    let c_one = 2.0 / ((dimension + 1.3) * (dimension + 1.3) + mass);
    let c_many = (1.0 - c_one).min(2.0 * (mass - 2.0 + 1.0 / mass) / ((dimension + 2.0) * (dimension + 2.0) + mass));
    let usual = dimension.sqrt() * (1.0 - 0.25 / dimension + 1.0 / (21.0 * dimension * dimension));
    let mut chance = Chance(search.seed);
    let (mut mean, mut size) = (start.to_vec(), search.step);
    let mut covariance: Vec<f64> = (0..n * n).map(|k| f64::from(u8::from(k / n == k % n))).collect();
    let (mut path_of_size, mut path) = (vec![0.0; n], vec![0.0; n]);
    let mut best = (start.to_vec(), f64::INFINITY);
    let mut spent = 0;
    while spent + population <= search.evaluations.max(population) {
        let factor = cholesky(&covariance, n);
        let step = |chance: &mut Chance| -> Vec<f64> {
            let z: Vec<f64> = (0..n).map(|_| normal(chance, with)).collect();
            (0..n).map(|i| (0..=i).map(|k| factor[i * n + k] * z[k]).sum()).collect()
        };
        let steps: Vec<Vec<f64>> = (0..population).map(|_| step(&mut chance)).collect();
        let points: Vec<Vec<f64>> =
            steps.iter().map(|step| mean.iter().zip(step).map(|(m, s)| m + size * s).collect()).collect();
        let values = of(&points);
        assert_eq!(values.len(), population, "a value for each point");
        spent += population;
        let rank = |value: f64| if value.is_nan() { f64::INFINITY } else { value };
        let mut order: Vec<usize> = (0..population).collect();
        order.sort_by(|a, b| rank(values[*a]).total_cmp(&rank(values[*b])));
        if rank(values[order[0]]) < best.1 {
            best = (points[order[0]].clone(), values[order[0]]);
        }
        let chosen = || order.iter().zip(&weights).map(|(k, weight)| (&steps[*k], *weight));
        let mut shift = vec![0.0; n];
        for (step, weight) in chosen() {
            shift.iter_mut().zip(step).for_each(|(all, s)| *all += weight * s);
        }
        mean.iter_mut().zip(&shift).for_each(|(m, s)| *m += size * s);
        // L⁻¹ of the shift is as long as a random step, whatever the covariance is.
        let mut even = vec![0.0; n];
        for i in 0..n {
            let known: f64 = (0..i).map(|k| factor[i * n + k] * even[k]).sum();
            even[i] = (shift[i] - known) / factor[i * n + i];
        }
        let grow = (c_size * (2.0 - c_size) * mass).sqrt();
        path_of_size.iter_mut().zip(&even).for_each(|(path, e)| *path = (1.0 - c_size) * *path + grow * e);
        let length = path_of_size.iter().map(|p| p * p).sum::<f64>().sqrt();
        let stalls = length > (1.4 + 2.0 / (dimension + 1.0)) * usual;
        let grow = if stalls { 0.0 } else { (c_path * (2.0 - c_path) * mass).sqrt() };
        path.iter_mut().zip(&shift).for_each(|(path, s)| *path = (1.0 - c_path) * *path + grow * s);
        let lost = if stalls { c_one * c_path * (2.0 - c_path) } else { 0.0 };
        for i in 0..n {
            for j in 0..n {
                let many: f64 = chosen().map(|(step, weight)| weight * step[i] * step[j]).sum();
                let old = covariance[i * n + j];
                covariance[i * n + j] = (1.0 - c_one - c_many + lost) * old + c_one * path[i] * path[j] + c_many * many;
            }
        }
        size *= (with.exp)((c_size / damping * (length / usual - 1.0)).min(1.0));
    }
    best
}

/// The Cholesky factor of a covariance, whose rounding errors are kept from making it singular.
fn cholesky(of: &[f64], n: usize) -> Vec<f64> {
    let mut factor = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| factor[i * n + k] * factor[j * n + k]).sum();
            let left = of[i * n + j] - known;
            factor[i * n + j] = if i == j { left.max(1e-14 * of[i * n + i]).sqrt() } else { left / factor[j * n + j] };
        }
    }
    factor
}

/// A standard normal number, by the polar method (Marsaglia, Bray, 1964).
fn normal(chance: &mut Chance, with: &Elementary) -> f64 {
    loop {
        let (u, v) = (chance.between(-1.0, 1.0), chance.between(-1.0, 1.0));
        let s = u * u + v * v;
        if s > 0.0 && s < 1.0 {
            return u * (-2.0 * (with.log)(s) / s).sqrt();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;

    /// Random ill-conditioned bowls, and the valley of Rosenbrock.
    ///
    /// Mutants, each fails: the size of steps stays; the covariance is not learned; the worst are chosen.
    #[test]
    fn a_minimum_is_found_without_derivatives() {
        let with = &PLATFORM;
        for seed in 0..20 {
            let mut chance = Chance(seed);
            let n = 2 + chance.below(6) as usize;
            let middle: Vec<f64> = (0..n).map(|_| chance.between(-2.0, 2.0)).collect();
            let scales: Vec<f64> = (0..n).map(|k| (with.exp)(3.0 * k as f64 / n as f64)).collect();
            let turn = chance.between(-1.0, 1.0);
            let bowl = |x: &Vec<f64>| {
                let moved: Vec<f64> = x.iter().zip(&middle).map(|(x, m)| x - m).collect();
                let one = |k: usize| scales[k] * (moved[k] + turn * moved[(k + 1) % n]);
                (0..n).map(|k| one(k) * one(k)).sum::<f64>()
            };
            let search = Search { step: 0.5, evaluations: 700 * n, seed };
            let (x, value) = minimise(&vec![0.0; n], search, with, &mut |all| all.iter().map(bowl).collect());
            assert!(value < 1e-8, "seed {seed}, {n} dimensions: {value} at {x:?}, not at {middle:?}");
            assert_eq!(value, bowl(&x), "seed {seed}: the value is that of the point");
        }
        let valley = |x: &Vec<f64>| 100.0 * (x[1] - x[0] * x[0]) * (x[1] - x[0] * x[0]) + (1.0 - x[0]) * (1.0 - x[0]);
        let search = Search { step: 0.3, evaluations: 3000, seed: 1 };
        let (x, value) = minimise(&[-1.0, 1.0], search, with, &mut |all| all.iter().map(valley).collect());
        assert!(value < 1e-8, "{value} at {x:?}");
        let never = minimise(&[1.0, 1.0], search, with, &mut |all| vec![f64::NAN; all.len()]);
        assert_eq!(never, (vec![1.0, 1.0], f64::INFINITY), "a start where nothing can be run");
    }
}
