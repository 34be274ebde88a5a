//! exp, expm1, sinh, cosh and tanh.
//!
//! All use one argument reduction: x = k ln2/64 + r with |r| ≤ ln2/128. Then e^x = 2^(k/64) e^r, where 2^(k/64) comes
//! from a table of 64 numbers and e^r − 1 is a polynomial of degree 5.
//!
//! Source: Tang, *Table-driven implementation of the exponential function in IEEE floating-point arithmetic*, 1989.

use super::two_to;
use super::{polynomial, tables, two_sum};
use crate::ir::expr::{Int, Real};

/// (e^r − 1 − r)/r² on |r| ≤ ln2/128; error 2^-59.4 of e^r.
pub const EXP: [f64; 4] = [0.49999999999948563, 0.16666666666654179, 0.04166672336772232, 0.008333343410773145];
/// The same polynomial with relative error 2^-62.2 of e^r − 1.
const EXP_LONG: [f64; 5] = [0.5, 0.16666666666659316, 0.04166666666664381, 0.00833334143428054, 0.0013888902912655746];
/// 64/ln2
pub const STEPS: f64 = 92.33248261689366;
/// ln2/64 in two parts. The first has 38 bits, so that x minus k times it is exact.
pub const STEP: (f64, f64) = (0.010830424696223417, 2.572804622327669e-14);
/// Adding this to a number below 2^51 rounds it to an integer, which is then in the low bits of the sum.
pub const ROUND: f64 = 6755399441055744.0;

/// e^x = scale · (1 + r + tail + r² q)
#[derive(Clone, Copy)]
pub struct Parts<'a> {
    /// The bits of 2^(k/64). They wrap if the number is out of the normal range.
    scale: Int<'a>,
    r: Real<'a>,
    tail: Real<'a>,
    q: Real<'a>,
}

impl<'a> Parts<'a> {
    /// The parts for a finite x with |x| < 1e6. For NaN, `r` and `q` are NaN.
    fn of(x: Real<'a>) -> Parts<'a> {
        let (parts, ..) = Parts::reduced(x);
        Parts { q: polynomial(parts.r, &EXP), ..parts }
    }

    /// The parts for x + `more`, where `more` is small. The tail contains the rounding error of r.
    pub fn exact(x: Real<'a>, more: Option<Real<'a>>) -> Parts<'a> {
        let (mut parts, k, high) = Parts::reduced(x);
        let first = parts.r;
        parts.tail = parts.tail + k.fma(-STEP.1, high - first);
        if let Some(more) = more {
            parts.r = first + more;
            parts.tail = parts.tail + ((first - parts.r) + more);
        }
        Parts { q: polynomial(parts.r, &EXP_LONG), ..parts }
    }

    /// The parts without q; k; and x minus k times the first part of ln2/64.
    fn reduced(x: Real<'a>) -> (Parts<'a>, Real<'a>, Real<'a>) {
        let rounded = x.fma(STEPS, ROUND);
        let (k, bits) = (rounded - ROUND, rounded.bits());
        let high = k.fma(-STEP.0, x);
        let r = k.fma(-STEP.1, high);
        let index = bits & i64::from(tables::EXP_LEN - 1);
        let scale = index.entry(tables::EXP_SCALE, tables::EXP_LEN).bits() + (bits << 46);
        let tail = index.entry(tables::EXP_TAIL, tables::EXP_LEN);
        (Parts { scale, r, tail, q: r }, k, high)
    }

    /// e^x, if 2^(k/64) is normal.
    fn normal(self) -> Real<'a> {
        let scale = self.scale.real_of_bits();
        scale.fma((self.r * self.r).fma(self.q, self.r + self.tail), scale)
    }

    /// e^x · 2^`doublings` for any x. `doublings`: −1 or 0.
    pub fn scaled(self, x: Real<'a>, doublings: i64) -> Real<'a> {
        let scale = self.scale + (doublings << 52);
        let normal = Parts { scale, ..self }.normal();
        // Near overflow and underflow, the scale is moved towards 1 and the missing factor is multiplied afterwards.
        let large = x.above(0.0);
        let nearer = scale + large.choose_int(-1009 << 52, 1022 << 52);
        let rest = large.choose(two_to(1009), two_to(-1022));
        // Far below, the result is set to 0 before the product. A product that underflows would take ten times as long.
        let edge = x.below(-746.0).choose(0.0, Parts { scale: nearer, ..self }.normal()) * rest;
        let beyond = x.above(745.0).choose(f64::INFINITY, edge);
        x.abs().below(707.0).choose(normal, beyond)
    }

    /// e^x for x ≤ 0 or NaN.
    fn scaled_below(self, x: Real<'a>) -> Real<'a> {
        let nearer = self.scale + (1022 << 52);
        let edge = x.below(-746.0).choose(0.0, Parts { scale: nearer, ..self }.normal()) * two_to(-1022);
        x.above(-707.0).choose(self.normal(), edge)
    }

    /// e^x − 1 as high and low part, for −50 < x < 700.
    fn less_one(self) -> (Real<'a>, Real<'a>) {
        let scale = self.scale.real_of_bits();
        let whole = scale - 1.0;
        let lost = scale - (whole + 1.0);
        let low = (self.r * self.r).fma(self.q, self.tail);
        let p = self.r + low;
        let p_low = (self.r - p) + low;
        let part = scale * p;
        let part_low = scale.fma(p, -part);
        let high = whole + part;
        (high, ((whole - high) + part) + (part_low + scale.fma(p_low, lost)))
    }
}

/// e^x, within 0.52 ulp if the result is normal.
pub fn exp(x: Real) -> Real {
    Parts::of(x).scaled(x, 0)
}

/// The same bits as [`exp`] for x ≤ 0 or NaN, as in a Stribeck curve, without the operations for large results.
pub fn exp_below(x: Real) -> Real {
    Parts::of(x).scaled_below(x)
}

/// The same bits as [`exp_below`] in the fewest operations, for lanes, where throughput matters and latency does not.
/// The scale is always 2^1022 times too large, and the inverse factor is multiplied last. As in [`exp_below`], this
/// adds a rounding only if the result is subnormal.
pub fn exp_below_of_lanes(x: Real) -> Real {
    // 1022 doublings are an integer number of table steps, so they can be part of the rounding constant.
    let round = ROUND + 1022.0 * f64::from(tables::EXP_LEN);
    let rounded = x.fma(STEPS, round);
    let (k, bits) = (rounded - round, rounded.bits());
    let r = k.fma(-STEP.1, k.fma(-STEP.0, x));
    let index = bits & i64::from(tables::EXP_LEN - 1);
    let scale = index.entry(tables::EXP_SCALE, tables::EXP_LEN).bits() + (bits << 46);
    let tail = index.entry(tables::EXP_TAIL, tables::EXP_LEN);
    let large = Parts { scale, r, tail, q: polynomial(r, &EXP) }.normal();
    // Far below, the result is set to 0 before the product, as in `scaled`. NaN stays NaN.
    x.below(-746.0).choose(0.0, large) * two_to(-1022)
}

/// e^x − 1, within 1 ulp.
pub fn expm1(x: Real) -> Real {
    let (high, low) = Parts::exact(x, None).less_one();
    let large = x.above(700.0).choose(exp(x), x.below(-50.0).choose(-1.0, high + low));
    x.abs().below(two_to(-54)).choose(x, large)
}

/// sinh x = ±(e^a − e^−a)/2 with a = |x|, computed as (t + t/(t + 1))/2 with t = e^a − 1, which does not cancel near 0.
/// Within 2 ulp.
pub fn sinh(x: Real) -> Real {
    let a = x.abs();
    let (t, low) = Parts::exact(a, None).less_one();
    let t = t + low;
    let near = 0.5 * (t + t / (t + 1.0));
    let size = a.above(40.0).choose(Parts::of(a).scaled(a, -1), near);
    let odd = x.below(0.0).choose(-size, size);
    a.below(two_to(-28)).choose(x, odd)
}

/// cosh x = e^a/2 + 1/(4 · e^a/2) with a = |x|. Within 1 ulp.
pub fn cosh(x: Real) -> Real {
    let a = x.abs();
    let half = Parts::of(a).scaled(a, -1);
    half + 0.25 / half
}

/// tanh x = ±t/(t + 2) with t = e^(2a) − 1 and a = |x|. t has a high and a low part, and the quotient is corrected
/// once. Within 0.6 ulp.
pub fn tanh(x: Real) -> Real {
    let a = x.abs();
    let (t, t_low) = Parts::exact(a + a, None).less_one();
    let (sum, sum_low) = two_sum(t, t.constant(2.0));
    let inverse = 1.0 / sum;
    let q = t * inverse;
    let rest = (-q).fma(sum, t) + (-q).fma(sum_low + t_low, t_low);
    // From 20 on the result is 1.
    let size = a.above(20.0).choose(1.0, inverse.fma(rest, q));
    let odd = x.below(0.0).choose(-size, size);
    a.below(two_to(-28)).choose(x, odd)
}
