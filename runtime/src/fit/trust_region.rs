//! Nonlinear least squares within bounds: an interior, reflective trust region.
//!
//! In: a start inside of the bounds, and an objective that gives costs and linearisations. Out: where the search ended
//! and why. All iterates lie strictly between the bounds.
//!
//! Source: Branch, Coleman, Li, "A subspace, interior, and conjugate gradient method for large-scale bound-constrained
//! minimization problems", SIAM J. Sci. Comput. 21 (1999), with the exact subproblem of Moré (1978); the choices of
//! constants are those of SciPy's `least_squares(method="trf")`.

use crate::fit::least_squares::{Singular, Triangle, singular};

/// A search ends if so many trials gain less than this part together.
const VAIN: u32 = 25;
const VAIN_GAIN: f64 = 1e-6;

/// What is minimised.
pub trait Objective {
    /// Half the sum of squares at these coordinates; none if the model cannot be run there.
    fn cost(&mut self, x: &[f64]) -> Option<f64>;

    /// Residuals and their derivatives at these coordinates, reduced; none if the model cannot be run around them.
    fn linearise(&mut self, x: &[f64]) -> Option<Triangle>;
}

/// Why the search ended.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ended {
    /// The gradient, scaled by the distances to the bounds, is 0 to rounding.
    Gradient,
    /// Steps or gains have become negligible.
    Small,
    /// The number of trials is used up.
    Trials,
    /// No shorter step could be run.
    Stuck,
    /// The model could not be run at the start.
    NoStart,
}

/// Where a search ended.
#[derive(Clone, PartialEq, Debug)]
pub struct End {
    /// Coordinates.
    pub x: Vec<f64>,
    /// Half the sum of squares.
    pub cost: f64,
    /// The last linearisation, at `x` or at the point before a negligible step.
    pub triangle: Option<Triangle>,
    /// Why.
    pub why: Ended,
    /// Number of trial points.
    pub trials: u32,
}

/// When a search ends.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Most trial points.
    pub trials: u32,
    /// Relative length of a negligible step, and relative gain.
    pub tolerance: f64,
}

/// Minimises from `start`; `low` and `high` are finite bounds.
pub fn minimise(start: &[f64], low: &[f64], high: &[f64], objective: &mut dyn Objective, limits: Limits) -> End {
    let n = start.len();
    let mut x = inside(start, low, high, 1e-10);
    let end = |x: Vec<f64>, cost: f64, triangle, why, trials| End { x, cost, triangle, why, trials };
    let Some(mut cost) = objective.cost(&x) else { return end(x, f64::INFINITY, None, Ended::NoStart, 1) };
    let mut trials = 1;
    let Some(mut triangle) = objective.linearise(&x) else { return end(x, cost, None, Ended::NoStart, trials) };
    let mut inverse_scale = lengths(&triangle, None);
    let (mut radius, mut alpha) = (f64::NAN, 0.0);
    let mut before_these = cost;
    loop {
        let g = triangle.gradient();
        let scale: Vec<f64> = inverse_scale.iter().map(|length| 1.0 / length).collect();
        let (mut v, dv) = to_bounds(&x, &g, low, high);
        let optimality = g.iter().zip(&v).map(|(g, v)| (g * v).abs()).fold(0.0, f64::max);
        if optimality <= f64::EPSILON * cost.max(f64::MIN_POSITIVE) {
            return end(x, cost, Some(triangle), Ended::Gradient, trials);
        }
        for k in 0..n {
            if dv[k] != 0.0 {
                v[k] *= inverse_scale[k];
            }
        }
        if radius.is_nan() {
            let square: f64 = (0..n).map(|k| x[k] * inverse_scale[k] * x[k] * inverse_scale[k] / v[k]).sum();
            radius = if square > 0.0 { square.sqrt() } else { 1.0 };
        }
        let d: Vec<f64> = (0..n).map(|k| v[k].sqrt() * scale[k]).collect();
        let diagonal: Vec<f64> = (0..n).map(|k| g[k] * dv[k] * scale[k]).collect();
        let g_hat: Vec<f64> = (0..n).map(|k| d[k] * g[k]).collect();
        let augmented = |k: usize| {
            let upper = (0..n).map(|row| triangle.r[row * n + k] * d[k]);
            upper.chain((0..n).map(|row| if row == k { diagonal[k].sqrt() } else { 0.0 })).collect::<Vec<f64>>()
        };
        let f: Vec<f64> = triangle.qf.iter().copied().chain(vec![0.0; n]).collect();
        let parts = singular((0..n).map(augmented).collect(), &f);
        let theta = (1.0 - optimality).max(0.995);
        let local = Local { triangle: &triangle, d: &d, diagonal: &diagonal, g_hat: &g_hat, low, high };
        let mut next = None;
        while next.is_none() {
            if trials >= limits.trials {
                return end(x, cost, Some(triangle), Ended::Trials, trials);
            }
            let p_hat = subproblem(&parts, triangle.rows, radius, &mut alpha);
            let (step, step_hat, predicted) = local.step(&x, p_hat, radius, theta);
            let sum: Vec<f64> = x.iter().zip(&step).map(|(x, step)| x + step).collect();
            let tried = inside(&sum, low, high, 0.0);
            let found = objective.cost(&tried).filter(|cost| cost.is_finite());
            trials += 1;
            let length = norm(&step_hat);
            let Some(found) = found else {
                radius = 0.25 * length;
                if length <= 1e-12 {
                    return end(x, cost, Some(triangle), Ended::Stuck, trials);
                }
                continue;
            };
            let gain = cost - found;
            let ratio = if predicted > 0.0 { gain / predicted } else { f64::from(u8::from(gain == predicted)) };
            let before = radius;
            if ratio < 0.25 {
                radius = 0.25 * length;
            } else if ratio > 0.75 && length > 0.95 * radius {
                radius *= 2.0;
            }
            let small_gain = gain < limits.tolerance * cost && ratio > 0.25;
            // Where the objective is rough, or a valley is flat, many trials gain next to nothing together.
            if trials.is_multiple_of(VAIN) {
                let is_vain = before_these - cost.min(found) < limits.tolerance.max(VAIN_GAIN) * cost;
                before_these = cost.min(found);
                if is_vain {
                    let (x, cost) = if gain > 0.0 { (tried, found) } else { (x, cost) };
                    return end(x, cost, Some(triangle), Ended::Small, trials);
                }
            }
            let small_step = norm(&step) < limits.tolerance * (limits.tolerance + norm(&x));
            if small_gain || small_step {
                let (x, cost) = if gain > 0.0 { (tried, found) } else { (x, cost) };
                return end(x, cost, Some(triangle), Ended::Small, trials);
            }
            alpha *= before / radius;
            if gain > 0.0 {
                next = Some((tried, found));
            }
        }
        let (found, of) = next.expect("the loop ends with one");
        let Some(linear) = objective.linearise(&found) else {
            return end(found, of, Some(triangle), Ended::Stuck, trials);
        };
        (x, cost, triangle) = (found, of, linear);
        inverse_scale = lengths(&triangle, Some(&inverse_scale));
    }
}

/// Lengths of the columns, at least those before; 1 for a column of zeros.
fn lengths(triangle: &Triangle, before: Option<&[f64]>) -> Vec<f64> {
    let now = triangle.lengths();
    match before {
        None => now.into_iter().map(|length| if length == 0.0 { 1.0 } else { length }).collect(),
        Some(before) => now.iter().zip(before).map(|(now, before)| now.max(*before)).collect(),
    }
}

fn norm(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// The nearest point strictly inside of the bounds, at this fraction of the magnitude of the bound.
fn inside(x: &[f64], low: &[f64], high: &[f64], part: f64) -> Vec<f64> {
    let one = |k: usize| {
        let (low, high) = (low[k], high[k]);
        let (from, to) = match part > 0.0 {
            true => (low + part * low.abs().max(1.0), high - part * high.abs().max(1.0)),
            false => (low.next_up(), high.next_down()),
        };
        let value = if x[k] <= low {
            from
        } else if x[k] >= high {
            to
        } else {
            x[k]
        };
        if value > low && value < high { value } else { 0.5 * (low + high) }
    };
    (0..x.len()).map(one).collect()
}

/// The Coleman–Li scaling: for each coordinate the distance to the bound that the gradient points at, and its
/// derivative.
fn to_bounds(x: &[f64], g: &[f64], low: &[f64], high: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let one = |k: usize| match g[k] {
        g if g < 0.0 => (high[k] - x[k], -1.0),
        g if g > 0.0 => (x[k] - low[k], 1.0),
        _ => (1.0, 0.0),
    };
    (0..x.len()).map(one).unzip()
}

/// The step of least squares within a radius, in the scaled space. `alpha`: the parameter of Levenberg and Marquardt,
/// from the previous subproblem.
fn subproblem(parts: &Singular, rows: usize, radius: f64, alpha: &mut f64) -> Vec<f64> {
    let Singular { values: s, vectors, uf } = parts;
    let n = s.len();
    let suf: Vec<f64> = s.iter().zip(uf).map(|(s, uf)| s * uf).collect();
    let combined = |weights: &[f64]| -> Vec<f64> {
        (0..n).map(|j| -(0..n).map(|k| vectors[k][j] * weights[k]).sum::<f64>()).collect()
    };
    let is_full = s[n - 1] > f64::EPSILON * rows as f64 * s[0];
    if is_full {
        let weights: Vec<f64> = (0..n).map(|k| uf[k] / s[k]).collect();
        let p = combined(&weights);
        if norm(&p) <= radius {
            *alpha = 0.0;
            return p;
        }
    }
    let phi = |alpha: f64| {
        let weights: Vec<f64> = (0..n).map(|k| suf[k] / (s[k] * s[k] + alpha)).collect();
        let length = norm(&weights);
        let slope: f64 = (0..n).map(|k| weights[k] * weights[k] / (s[k] * s[k] + alpha)).sum();
        (length - radius, -slope / length)
    };
    let mut upper = norm(&suf) / radius;
    let mut lower = if is_full {
        let (value, slope) = phi(0.0);
        -value / slope
    } else {
        0.0
    };
    let middle = |lower: f64, upper: f64| (0.001 * upper).max((lower * upper).sqrt());
    if !is_full && *alpha == 0.0 {
        *alpha = middle(lower, upper);
    }
    for _ in 0..10 {
        if *alpha < lower || *alpha > upper {
            *alpha = middle(lower, upper);
        }
        let (value, slope) = phi(*alpha);
        if value < 0.0 {
            upper = *alpha;
        }
        let ratio = value / slope;
        lower = lower.max(*alpha - ratio);
        *alpha -= (value + radius) * ratio / radius;
        if value.abs() < 0.01 * radius {
            break;
        }
    }
    let weights: Vec<f64> = (0..n).map(|k| suf[k] / (s[k] * s[k] + *alpha)).collect();
    let p = combined(&weights);
    let length = norm(&p);
    if length > 0.0 { p.iter().map(|p| p * radius / length).collect() } else { p }
}

/// The quadratic model around an iterate, in the scaled space.
struct Local<'a> {
    triangle: &'a Triangle,
    d: &'a [f64],
    diagonal: &'a [f64],
    g_hat: &'a [f64],
    low: &'a [f64],
    high: &'a [f64],
}

impl Local<'_> {
    fn scaled(&self, p_hat: &[f64]) -> Vec<f64> {
        p_hat.iter().zip(self.d).map(|(p, d)| p * d).collect()
    }

    /// ½ sᵀ H t of the scaled space, times 2.
    fn curvature(&self, s: &[f64], t: &[f64]) -> f64 {
        let diagonal: f64 = (0..s.len()).map(|k| self.diagonal[k] * s[k] * t[k]).sum();
        self.triangle.product(&self.scaled(s), &self.scaled(t)) + diagonal
    }

    fn slope(&self, s: &[f64]) -> f64 {
        self.g_hat.iter().zip(s).map(|(g, s)| g * s).sum()
    }

    fn value(&self, s: &[f64]) -> f64 {
        0.5 * self.curvature(s, s) + self.slope(s)
    }

    /// Least of the model at s0 + t s for t in `from .. to`, and its value.
    fn least_along(&self, s0: &[f64], s: &[f64], from: f64, to: f64) -> (f64, f64) {
        let a = 0.5 * self.curvature(s, s);
        let b = self.slope(s) + self.curvature(s0, s);
        let c = self.value(s0);
        let at = |t: f64| t * (a * t + b) + c;
        let extremum = -0.5 * b / a;
        let all = [from, to, if a != 0.0 && extremum > from && extremum < to { extremum } else { from }];
        let least = all.into_iter().min_by(|x, y| at(*x).total_cmp(&at(*y))).expect("there are three");
        (least, at(least))
    }

    /// Largest multiple of `step` from `x` within the bounds, and the coordinates whose bounds it meets.
    fn to_bound(&self, x: &[f64], step: &[f64]) -> (f64, Vec<bool>) {
        let one = |k: usize| match step[k] {
            s if s > 0.0 => (self.high[k] - x[k]) / s,
            s if s < 0.0 => (self.low[k] - x[k]) / s,
            _ => f64::INFINITY,
        };
        let all: Vec<f64> = (0..x.len()).map(one).collect();
        let least = all.iter().copied().fold(f64::INFINITY, f64::min);
        (least, all.iter().map(|one| *one == least).collect())
    }

    /// The best of the step of the subproblem, its reflection at the bound, and the gradient: the step, the step in the
    /// scaled space, and the predicted reduction.
    fn step(&self, x: &[f64], mut p_hat: Vec<f64>, radius: f64, theta: f64) -> (Vec<f64>, Vec<f64>, f64) {
        let n = x.len();
        let p = self.scaled(&p_hat);
        let (stride, hits) = self.to_bound(x, &p);
        if stride > 1.0 {
            let value = self.value(&p_hat);
            return (p, p_hat, -value);
        }
        let mut r_hat: Vec<f64> = (0..n).map(|k| if hits[k] { -p_hat[k] } else { p_hat[k] }).collect();
        let r = self.scaled(&r_hat);
        p_hat.iter_mut().for_each(|p| *p *= stride);
        let on_bound: Vec<f64> = (0..n).map(|k| x[k] + stride * p[k]).collect();
        let to_radius = leave(&p_hat, &r_hat, radius);
        let (to_bound, _) = self.to_bound(&on_bound, &r);
        let r_stride = to_bound.min(to_radius);
        let mut reflected = f64::INFINITY;
        if r_stride > 0.0 {
            let from = (1.0 - theta) * stride / r_stride;
            let to = if r_stride == to_bound { theta * to_bound } else { to_radius };
            if from <= to {
                let (t, value) = self.least_along(&p_hat, &r_hat, from, to);
                reflected = value;
                r_hat = (0..n).map(|k| p_hat[k] + t * r_hat[k]).collect();
            }
        }
        p_hat.iter_mut().for_each(|p| *p *= theta);
        let direct = self.value(&p_hat);
        let ag_hat: Vec<f64> = self.g_hat.iter().map(|g| -g).collect();
        let ag = self.scaled(&ag_hat);
        let to_radius = radius / norm(&ag_hat);
        let (to_bound, _) = self.to_bound(x, &ag);
        let most = if to_bound < to_radius { theta * to_bound } else { to_radius };
        let (t, gradient) = self.least_along(&vec![0.0; n], &ag_hat, 0.0, most);
        let (chosen, value) = if direct < reflected && direct < gradient {
            (p_hat, direct)
        } else if reflected < direct && reflected < gradient {
            (r_hat, reflected)
        } else {
            (ag_hat.iter().map(|g| t * g).collect(), gradient)
        };
        (self.scaled(&chosen), chosen, -value)
    }
}

/// The positive t at which x + t s has the length `radius`; x is inside.
fn leave(x: &[f64], s: &[f64], radius: f64) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let (a, b, c) = (dot(s, s), dot(x, s), dot(x, x) - radius * radius);
    if a == 0.0 {
        return 0.0;
    }
    let root = (b * b - a * c).max(0.0).sqrt();
    // The form without cancellation.
    let q = -(b + f64::copysign(root, b));
    let (first, second) = (q / a, if q != 0.0 { c / q } else { 0.0 });
    first.max(second)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    /// Residuals of a function of the coordinates, with differences of their own.
    struct Of<'a>(&'a dyn Fn(&[f64]) -> Vec<f64>);

    impl Objective for Of<'_> {
        fn cost(&mut self, x: &[f64]) -> Option<f64> {
            let cost = 0.5 * (self.0)(x).iter().map(|r| r * r).sum::<f64>();
            cost.is_finite().then_some(cost)
        }

        fn linearise(&mut self, x: &[f64]) -> Option<Triangle> {
            let n = x.len();
            let at = |k: usize, h: f64| {
                let mut x = x.to_vec();
                x[k] += h;
                (self.0)(&x)
            };
            let f = (self.0)(x);
            let columns: Vec<Vec<f64>> =
                (0..n).map(|k| at(k, 1e-6).iter().zip(at(k, -1e-6)).map(|(a, b)| (a - b) / 2e-6).collect()).collect();
            let mut triangle = Triangle::new(n);
            for row in 0..f.len() {
                triangle.add(&mut columns.iter().map(|column| column[row]).collect::<Vec<_>>(), f[row]);
            }
            Some(triangle)
        }
    }

    const LIMITS: Limits = Limits { trials: 200, tolerance: 1e-10 };

    #[test]
    fn the_valley_of_rosenbrock_is_followed_and_bounds_hold() {
        let valley = |x: &[f64]| vec![10.0 * (x[1] - x[0] * x[0]), 1.0 - x[0]];
        let free = minimise(&[-1.9, 2.0], &[-5.0; 2], &[5.0; 2], &mut Of(&valley), LIMITS);
        assert!((free.x[0] - 1.0).abs() < 1e-6 && (free.x[1] - 1.0).abs() < 1e-6, "{free:?}");
        // With x0 <= 0.5 the minimum is at the bound: (0.5, 0.25).
        let bound = minimise(&[-1.9, 2.0], &[-5.0; 2], &[0.5, 5.0], &mut Of(&valley), LIMITS);
        assert!((bound.x[0] - 0.5).abs() < 1e-5 && (bound.x[1] - 0.25).abs() < 1e-4, "{bound:?}");
    }

    /// Linear problems within boxes have one minimum, where the projected gradient vanishes (Karush, Kuhn, Tucker).
    /// With the scaling by distances to upper bounds left out, some seeds end elsewhere.
    #[test]
    fn linear_problems_end_where_the_projected_gradient_vanishes() {
        for seed in 0..300 {
            let mut chance = Chance(seed);
            let n = 1 + chance.below(5) as usize;
            let rows = n + 3;
            let a: Vec<f64> = (0..rows * n).map(|_| chance.between(-1.0, 1.0)).collect();
            let b: Vec<f64> = (0..rows).map(|_| chance.between(-2.0, 2.0)).collect();
            let low: Vec<f64> = (0..n).map(|_| chance.between(-1.5, 0.0)).collect();
            let high: Vec<f64> = low.iter().map(|low| low + chance.between(0.1, 2.0)).collect();
            let start: Vec<f64> = low.iter().zip(&high).map(|(a, b)| chance.between(*a, *b)).collect();
            let of = |x: &[f64]| -> Vec<f64> {
                (0..rows).map(|i| (0..n).map(|k| a[i * n + k] * x[k]).sum::<f64>() - b[i]).collect()
            };
            let end = minimise(&start, &low, &high, &mut Of(&of), LIMITS);
            let r = of(&end.x);
            for k in 0..n {
                let (x, g) = (end.x[k], (0..rows).map(|i| a[i * n + k] * r[i]).sum::<f64>());
                assert!(x > low[k] && x < high[k], "seed {seed}: {x} in {} .. {}", low[k], high[k]);
                let distance = if g > 0.0 { x - low[k] } else { high[k] - x };
                assert!((g * distance).abs() < 1e-5, "seed {seed}: gradient {g}, {distance} from the bound, {end:?}");
            }
        }
    }

    /// A model that cannot be run beyond x = 2 is followed up to there.
    #[test]
    fn points_that_cannot_be_run_shorten_the_step() {
        let of = |x: &[f64]| if x[0] > 2.0 { vec![f64::NAN] } else { vec![x[0] - 1.9, 0.1] };
        let end = minimise(&[-40.0], &[-50.0], &[50.0], &mut Of(&of), LIMITS);
        assert!((end.x[0] - 1.9).abs() < 1e-6, "{end:?}");
        assert_eq!(minimise(&[3.0], &[-50.0], &[50.0], &mut Of(&of), LIMITS).why, Ended::NoStart);
    }
}
