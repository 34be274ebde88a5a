//! The model as a solver sees it, and one step as a polynomial.

use super::history::History;
use abi::{Function, Instance, Slot};
use std::ops::Range;

/// A model whose derivatives, Jacobian and switching surfaces are functions of time and states; everything else in its
/// block is constant.
pub(crate) struct System {
    pub(crate) instance: Instance,
    /// Number of states.
    pub(crate) n: usize,
    pub(crate) states: Range<usize>,
    derivatives: Range<usize>,
    jacobian: Range<usize>,
    roots: Range<usize>,
    /// Evaluations of the derivatives.
    pub(crate) evaluations: u64,
    /// The history of delayed quantities.
    pub(crate) history: History,
}

impl System {
    pub(crate) fn new(instance: Instance) -> System {
        let layout = &instance.description().layout;
        let roots = if instance.has(Function::Roots) { layout.roots.range() } else { 0..0 };
        System {
            n: layout.states.len as usize,
            states: layout.states.range(),
            derivatives: layout.derivatives.range(),
            jacobian: layout.jacobian.range(),
            roots,
            history: History::new(&instance),
            instance,
            evaluations: 0,
        }
    }

    /// Number of switching surfaces.
    pub(crate) fn surfaces(&self) -> usize {
        self.roots.len()
    }

    /// Writes time in s and states in SI into the block.
    #[inline]
    pub(crate) fn place(&mut self, t: f64, x: &[f64]) {
        let states = self.states.clone();
        let block = self.instance.block_mut();
        block[Slot::TIME.index()] = t;
        copy(x, &mut block[states]);
        self.history.place(t, block);
    }

    /// dx/dt at (t, x), in SI per second.
    pub(crate) fn slope(&mut self, t: f64, x: &[f64], f: &mut [f64]) {
        self.sized_slope::<0>(t, x, f);
    }

    /// As `slope`, for `N` states where N is not 0: copies of constant length need no call.
    pub(crate) fn sized_slope<const N: usize>(&mut self, t: f64, x: &[f64], f: &mut [f64]) {
        let n = if N == 0 { self.n } else { N };
        self.evaluations += 1;
        let (states, derivatives) = (self.states.start, self.derivatives.start);
        let block = self.instance.block_mut();
        block[Slot::TIME.index()] = t;
        copy(&x[..n], &mut block[states..states + n]);
        self.history.place(t, block);
        if n > 0 {
            self.instance.call(Function::Derivatives);
        }
        copy(&self.instance.block()[derivatives..derivatives + n], &mut f[..n]);
    }

    /// ∂f/∂x row-major, then ∂f/∂t, at (t, x), where f is `f0`. For a model without `Jacobian`: one-sided differences
    /// over √ε of |x| or of the scale `s` of the state, whichever is larger, to the side where no surface is crossed,
    /// because the derivative is that of the active branch.
    pub(crate) fn jacobian(&mut self, t: f64, x: &[f64], f0: &[f64], s: &[f64], j: &mut [f64]) {
        if self.n == 0 {
            return;
        }
        if self.instance.has(Function::Jacobian) {
            self.place(t, x);
            self.instance.call(Function::Jacobian);
            j.copy_from_slice(&self.instance.block()[self.jacobian.clone()]);
            return;
        }
        const ROOT: f64 = 1.5e-8;
        let n = self.n;
        let (mut moved, mut f) = (x.to_vec(), vec![0.0; n]);
        let (mut here, mut there) = (vec![0.0; self.surfaces()], vec![0.0; self.surfaces()]);
        if !here.is_empty() {
            self.roots(t, x, &mut here);
        }
        for column in 0..=n {
            // The last column is the derivative by time.
            let by = ROOT * if column < n { x[column].abs().max(s[column]) } else { t.max(1.0) };
            let mut width = by;
            for by in [by, -by] {
                let mut later = t;
                if column < n {
                    moved[column] = x[column] + by;
                    width = moved[column] - x[column];
                } else {
                    later = t + by;
                    width = later - t;
                }
                if !here.is_empty() {
                    self.roots(later, &moved, &mut there);
                }
                self.slope(later, &moved, &mut f);
                if here.iter().zip(&there).all(|(a, b)| a * b >= 0.0) {
                    break;
                }
            }
            for row in 0..n {
                let entry = if column < n { row * n + column } else { n * n + row };
                j[entry] = (f[row] - f0[row]) / width;
            }
            if column < n {
                moved[column] = x[column];
            }
        }
    }

    /// Values of the switching surfaces at (t, x).
    pub(crate) fn roots(&mut self, t: f64, x: &[f64], g: &mut [f64]) {
        self.place(t, x);
        self.instance.call(Function::Roots);
        copy(&self.instance.block()[self.roots.clone()], g);
    }
}

/// Copies a slice; for the short lengths of most models, without a call.
#[inline]
pub(crate) fn copy(from: &[f64], to: &mut [f64]) {
    fn fixed<const N: usize>(from: &[f64], to: &mut [f64]) {
        if let (Ok(from), Ok(to)) = (<&[f64; N]>::try_from(from), <&mut [f64; N]>::try_from(to)) {
            *to = *from;
        }
    }
    match from.len() {
        1 => fixed::<1>(from, to),
        2 => fixed::<2>(from, to),
        3 => fixed::<3>(from, to),
        4 => fixed::<4>(from, to),
        5 => fixed::<5>(from, to),
        _ => to.copy_from_slice(from),
    }
}

/// One step from `t` to `t + h`, with a polynomial of degree four between:
///
///   x(t + θh) = x0 + θ (x1 − x0) + θ (1 − θ) (k1 + θ (k2 + θ k3))
#[derive(Default)]
pub(crate) struct Step {
    /// Start in s.
    pub(crate) t: f64,
    /// Length in s.
    pub(crate) h: f64,
    /// Where its last stages are evaluated: `t + h`, or just before it if a signal has a corner there.
    pub(crate) end: f64,
    pub(crate) x0: Vec<f64>,
    pub(crate) x1: Vec<f64>,
    /// dx/dt at the start.
    pub(crate) f0: Vec<f64>,
    pub(crate) k1: Vec<f64>,
    pub(crate) k2: Vec<f64>,
    pub(crate) k3: Vec<f64>,
    /// Estimated error of each state, SI.
    pub(crate) error: Vec<f64>,
}

impl Step {
    pub(crate) fn new(n: usize) -> Step {
        let zeros = || vec![0.0; n];
        Step {
            t: 0.0,
            h: 0.0,
            end: 0.0,
            x0: zeros(),
            x1: zeros(),
            f0: zeros(),
            k1: zeros(),
            k2: zeros(),
            k3: zeros(),
            error: zeros(),
        }
    }

    /// Time at θ.
    pub(crate) fn time(&self, theta: f64) -> f64 {
        if theta == 1.0 { self.end } else { self.t + theta * self.h }
    }

    /// Whether a state surely does not turn between two θ: the Bernstein coefficients of its derivative by θ, a polynomial of
    /// degree three between whose least and greatest coefficient it lies, have one sign.
    pub(crate) fn is_monotonic(&self, state: usize, (from, to): (f64, f64)) -> bool {
        let [k1, k2, k3] = [&self.k1, &self.k2, &self.k3].map(|k| k[state]);
        let slope = [self.x1[state] - self.x0[state] + k1, 2.0 * (k2 - k1), 3.0 * (k3 - k2), -4.0 * k3];
        let coefficient = |[a, b, c]: [f64; 3]| {
            slope[0] + slope[1] * (a + b + c) / 3.0 + slope[2] * (a * b + b * c + c * a) / 3.0 + slope[3] * (a * b * c)
        };
        let all = [[from; 3], [from, from, to], [from, to, to], [to; 3]].map(coefficient);
        all.iter().all(|one| *one >= 0.0) || all.iter().all(|one| *one <= 0.0)
    }

    /// Whether a state surely stays within bounds between two θ: the Bernstein coefficients of its polynomial, between whose
    /// least and greatest it lies, are inside by more than their rounding.
    pub(crate) fn is_within(&self, state: usize, (from, to): (f64, f64), (least, greatest): (f64, f64)) -> bool {
        let [x0, x1, k1, k2, k3] = [&self.x0, &self.x1, &self.k1, &self.k2, &self.k3].map(|k| k[state]);
        let terms = [x0, (x1 - x0 + k1) / 4.0, (k2 - k1) / 6.0, (k3 - k2) / 4.0, -k3];
        let slack = 1e-12 * (greatest - least);
        // The polar form of the polynomial at `to` so many times and at `from` otherwise.
        let coefficient = |count: usize| {
            // Elementary symmetric polynomials of these four.
            let mut products = [1.0, 0.0, 0.0, 0.0, 0.0];
            for place in 0..4 {
                let theta = if place < count { to } else { from };
                (1..5).rev().for_each(|k| products[k] += theta * products[k - 1]);
            }
            terms.iter().zip(products).map(|(term, product)| term * product).sum::<f64>()
        };
        (0..5).map(coefficient).all(|one| one >= least + slack && one <= greatest - slack)
    }

    /// States at θ.
    pub(crate) fn at(&self, theta: f64, x: &mut [f64]) {
        if theta == 1.0 {
            x.copy_from_slice(&self.x1);
            return;
        }
        let n = x.len();
        // Slices of one length, so that the loop has no checks.
        let [x0, x1, k1, k2, k3] = [&self.x0, &self.x1, &self.k1, &self.k2, &self.k3].map(|part| &part[..n]);
        for i in 0..n {
            x[i] = between([x0[i], x1[i], k1[i], k2[i], k3[i]], theta);
        }
    }

    /// One state at θ.
    pub(crate) fn state_at(&self, state: usize, theta: f64) -> f64 {
        let [x0, x1, k1, k2, k3] = [&self.x0, &self.x1, &self.k1, &self.k2, &self.k3].map(|part| part[state]);
        if theta == 1.0 { x1 } else { between([x0, x1, k1, k2, k3], theta) }
    }
}

#[inline]
fn between([x0, x1, k1, k2, k3]: [f64; 5], theta: f64) -> f64 {
    let bend = k1 + theta * (k2 + theta * k3);
    x0 + theta * (x1 - x0 + (1.0 - theta) * bend)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;
    use crate::testing::generated::{hold, seeds};

    /// Numbers from −1 to 1 for a step of one state: where it ends, three coefficients, and the ends of a part.
    fn case(seed: u64) -> [f64; 6] {
        let mut chance = Chance(seed);
        [(); 6].map(|()| chance.below(2001) as f64 / 1000.0 - 1.0)
    }

    /// The state of a step of one state at 201 equally distant places of a part.
    fn along(step: &Step, (from, to): (f64, f64)) -> Vec<f64> {
        (0..=200).map(|k| step.state_at(0, from + (to - from) * f64::from(k) / 200.0)).collect()
    }

    /// Whether a part that turns is not found monotonic; gives whether it turns, and whether it is found.
    fn holds(&[x1, k1, k2, k3, a, b]: &[f64; 6]) -> Result<(bool, bool), String> {
        let [x1, k1, k2, k3] = [x1, k1, k2, k3].map(|one| vec![one]);
        let step = Step { x1, k1, k2, k3, ..Step::new(1) };
        let part = (0.5 + 0.5 * a.min(b), 0.5 + 0.5 * a.max(b));
        let by: Vec<f64> = along(&step, part).windows(2).map(|pair| pair[1] - pair[0]).collect();
        let turns = by.iter().any(|by| *by < -1e-12) && by.iter().any(|by| *by > 1e-12);
        match (turns, step.is_monotonic(0, part)) {
            (true, true) => Err(format!("it turns: {by:?}")),
            other => Ok(other),
        }
    }

    /// A mutant that looks at the values at the ends alone takes parts that leave their bounds in between for inside.
    #[test]
    fn a_part_that_leaves_its_bounds_is_never_found_within() {
        let (mut inside, mut found) = (0, 0);
        let never_leaves = |[bound, k1, k2, k3, a, b]: &[f64; 6]| {
            let [x1, k1, k2, k3] = [*a, *k1, *k2, *k3].map(|one| vec![one]);
            let step = Step { x1, k1, k2, k3, ..Step::new(1) };
            let (part, bounds) = ((0.5 - 0.5 * b.abs(), 0.5 + 0.5 * b.abs()), (-0.1 - bound.abs(), 0.1 + bound.abs()));
            let leaves = along(&step, part).into_iter().find(|x| !(bounds.0..=bounds.1).contains(x));
            match (leaves, step.is_within(0, part, bounds)) {
                (Some(x), true) => Err(format!("{x} is not within {bounds:?}")),
                (leaves, is_found) => Ok((leaves.is_none(), is_found)),
            }
        };
        let failed = hold(
            seeds(4000),
            case,
            never_leaves,
            |case, why| (*case, why),
            |(is_inside, is_found)| {
                inside += u64::from(is_inside);
                found += u64::from(is_found);
            },
        );
        assert!(failed.is_empty(), "{failed:?}");
        assert!(3 * found > 2 * inside, "{found} of {inside} that stay within are found");
    }

    /// A mutant that looks at the slopes at the ends alone takes parts that turn twice for monotonic.
    #[test]
    fn a_part_that_turns_is_never_found_monotonic() {
        let (mut plain, mut found) = (0, 0);
        let failed = hold(
            seeds(4000),
            case,
            holds,
            |case, why| (*case, why),
            |(turns, is_found)| {
                plain += u64::from(!turns);
                found += u64::from(is_found);
            },
        );
        assert!(failed.is_empty(), "{failed:?}");
        assert!(2 * found > plain, "{found} of {plain} that do not turn are found");
    }
}
