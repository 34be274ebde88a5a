//! Huber's loss: residuals beyond a bound count by their size and not by its square, so that outliers decide little.
//!
//! In: whitened residuals and a bound. Out: their loss, weights, and the moments that the covariance of the values needs.
//! An infinite bound is least squares, to the bit.
//!
//! Sources: Huber, Annals of Mathematical Statistics 35 (1964); Huber, Robust Statistics (1981), sec. 7.6 (covariance),
//! 7.8 (modified weights, which never raise the loss); Holland, Welsch, Communications in Statistics A6 (1977).

use std::ops::Range;

/// The bound in standard deviations of the noise: with normal noise the values scatter 2.6 % more than those of least squares.
pub const BOUND: f64 = 1.345;
/// Residuals beyond so many standard deviations are left out of a model of the noise.
pub const SOUND: f64 = 3.0;
/// Median of the size of a normal variable.
const NORMAL_MEDIAN: f64 = 0.674_489_750_196_081_7;

/// The standard deviation of residuals by the median of their size, of which half may be outliers; 0 if most are 0.
pub fn deviation(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    let middle = sizes.len() / 2;
    if sizes.is_empty() {
        return 0.0;
    }
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    *median / NORMAL_MEDIAN
}

/// The loss of a residual: its square within the bound, and the tangent of that beyond.
pub fn loss(r: f64, bound: f64) -> f64 {
    if r.abs() <= bound { r * r } else { bound * (2.0 * r.abs() - bound) }
}

/// The root of the weight of a residual: with it on rows of residuals and derivatives, least squares has the gradient of
/// the loss, and a curvature that is never less.
pub fn root_weight(r: f64, bound: f64) -> f64 {
    if r.abs() <= bound { 1.0 } else { (bound / r.abs()).sqrt() }
}

/// What the covariance needs of the residuals of one quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Moments {
    /// Their rows among all.
    pub rows: Range<usize>,
    /// The part of them within the bound: the mean derivative of half the loss's slope.
    pub within: f64,
    /// The mean square of half the loss's slope, with Huber's correction for so few rows.
    pub square: f64,
}

/// The moments of some rows of the residuals for so many unknowns.
pub fn moments(residuals: &[f64], rows: Range<usize>, bound: f64, unknowns: usize) -> Moments {
    let some = &residuals[rows.clone()];
    let count = some.len().max(1) as f64;
    let within = (some.iter().filter(|r| r.abs() <= bound).count() as f64 / count).max(0.5 / count);
    let square = some.iter().map(|r| r.clamp(-bound, bound) * r.clamp(-bound, bound)).sum::<f64>() / count;
    // Robust Statistics, eq. 6.5 and 6.6.
    let few = 1.0 + unknowns as f64 / count * (1.0 - within) / within;
    Moments { rows, within, square: square * few * few }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    /// The weighted square has the slope of the loss and lies nowhere below it, and least squares is an infinite bound.
    ///
    /// Mutant: the weight itself in place of its root.
    #[test]
    fn weighted_squares_touch_the_loss_from_above() {
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let (bound, r, other) = (chance.between(0.1, 3.0), chance.between(-9.0, 9.0), chance.between(-9.0, 9.0));
            let h = 1e-6;
            let slope = (loss(r + h, bound) - loss(r - h, bound)) / (2.0 * h);
            let weight = root_weight(r, bound) * root_weight(r, bound);
            assert!((slope - 2.0 * weight * r).abs() < 1e-5, "seed {seed}");
            let above = loss(r, bound) + weight * (other * other - r * r);
            assert!(above >= loss(other, bound) - 1e-12, "seed {seed}");
            assert_eq!((loss(r, f64::INFINITY), root_weight(r, f64::INFINITY)), (r * r, 1.0), "seed {seed}");
        }
    }

    /// A tenth of outliers changes the deviation by less than a seventh, whatever their size.
    #[test]
    fn outliers_hardly_change_the_deviation() {
        for seed in 0..50 {
            let mut chance = Chance(seed);
            let mut normal = || (0..12).map(|_| chance.fraction()).sum::<f64>() - 6.0;
            let mut all: Vec<f64> = (0..2000).map(|_| 3.0 * normal()).collect();
            let clean = deviation(&all);
            assert!((clean / 3.0 - 1.0).abs() < 0.1, "seed {seed}: {clean}");
            all.iter_mut().step_by(10).for_each(|r| *r += 1e6);
            let found = deviation(&all);
            assert!((1.0..1.25).contains(&(found / clean)), "seed {seed}: {found}, {clean}");
        }
        assert_eq!((deviation(&[]), deviation(&[0.0, 0.0, 5.0])), (0.0, 0.0));
    }

    /// Of normal residuals the moments are those of the normal distribution, which give an efficiency of 95 %.
    #[test]
    fn moments_of_normal_residuals_are_known() {
        let mut chance = Chance(5);
        let normal = |_| 0.5 * ((0..48).map(|_| chance.fraction()).sum::<f64>() - 24.0);
        let all: Vec<f64> = (0..100_000).map(normal).collect();
        let found = moments(&all, 0..all.len(), BOUND, 3);
        let variance = found.square / (found.within * found.within);
        assert!((found.within - 0.8214).abs() < 0.01 && (1.0 / variance - 0.95).abs() < 0.01, "{found:?}");
    }
}
