//! sin, cos, tan, and their inverses.
//!
//! Sine and cosine reduce the argument to ±π/4 with π/2 in three parts (Cody, Waite, *Software Manual for the
//! Elementary Functions*, 1980). The arctangent uses a table and the difference formula.

use super::exponential::ROUND;
use super::two_to;
use super::{polynomial, tables, two_sum};
use crate::ir::expr::{Int, Real};

/// (sin r − r)/r³ in r² on |r| ≤ π/4; relative error 2^-58.0 of the sine.
const SIN: [f64; 6] = [
    -0.16666666666666632,
    0.008333333333322318,
    -0.0001984126982972735,
    2.7557313662832506e-06,
    -2.50507533903876e-08,
    1.5896512486086446e-10,
];
/// (cos r − 1 + r²/2)/r⁴ in r² on |r| ≤ π/4; error 2^-64.2 of the cosine.
const COS: [f64; 6] = [
    0.0416666666666666,
    -0.0013888888888874114,
    2.480158728946166e-05,
    -2.7557314343241703e-07,
    2.0875721684238954e-09,
    -1.135954999442831e-11,
];
/// (atan t − t)/t³ in t² on |t| ≤ 0.0789; relative error 2^-58.5 of the arctangent.
const ATAN: [f64; 5] =
    [-0.3333333333333159, 0.19999999996027765, -0.14285711345179714, 0.11110160503426808, -0.08951176179892081];
/// (asin x − x)/x³ in x² on |x| ≤ 1/2; relative error 2^-55.9 of the arcsine.
const ASIN: [f64; 12] = [
    0.16666666666665383,
    0.07500000000343059,
    0.04464285682347297,
    0.030381959331552265,
    0.022371753518239584,
    0.017359771156640797,
    0.013884598174538984,
    0.012173280392799059,
    0.0065108511397473316,
    0.01957390741948599,
    -0.01629407005424309,
    0.03195896028358816,
];
/// π/2 in three parts.
const HALF_PI: [f64; 3] = [std::f64::consts::FRAC_PI_2, 6.123233995736766e-17, -1.4973849048591698e-33];
/// Up to this argument the reduction is exact to 2^-110. Beyond it, sin returns 0 and cos returns 1.
const LIMIT: f64 = 1099511627776.0;

/// Sine and cosine of r in ±π/4, where x = q π/2 + r. `quarters`: q, in the low bits.
struct Reduced<'a> {
    quarters: Int<'a>,
    sin: Real<'a>,
    cos: Real<'a>,
}

impl<'a> Reduced<'a> {
    fn of(x: Real<'a>) -> Reduced<'a> {
        let rounded = x.fma(std::f64::consts::FRAC_2_PI, ROUND);
        let (k, quarters) = (rounded - ROUND, rounded.bits());
        // Exact: k · `HALF_PI[0]` is a multiple of 2^-52 and so is the difference, which is less than 1.
        let first = k.fma(-HALF_PI[0], x);
        let product = k * HALF_PI[1];
        let product_low = k.fma(HALF_PI[1], -product);
        let (r, rest) = two_sum(first, -product);
        let low = k.fma(-HALF_PI[2], rest - product_low);
        let z = r * r;
        let half = 0.5 * z;
        let one_less_half = 1.0 - half;
        let sin = r + (z * r).fma(polynomial(z, &SIN), low * one_less_half);
        let cos = one_less_half + (((1.0 - one_less_half) - half) + (z * z).fma(polynomial(z, &COS), (-r) * low));
        Reduced { quarters, sin, cos }
    }

    /// Whether the number of quarter turns is odd.
    fn odd(&self) -> crate::ir::expr::Truth<'a> {
        (self.quarters & 1).is(1)
    }
}

/// sin x, within 0.8 ulp up to 1e12; 0 beyond.
pub fn sin(x: Real) -> Real {
    let reduced = Reduced::of(x);
    let size = reduced.odd().choose(reduced.cos, reduced.sin);
    let value = (reduced.quarters & 2).is(2).choose(-size, size);
    let near = x.abs().below(two_to(-27)).choose(x, value);
    // 0 · x is NaN for infinite x.
    x.abs().below(LIMIT).choose(near, 0.0 * x)
}

/// cos x, within 0.8 ulp up to 1e12; 1 beyond.
pub fn cos(x: Real) -> Real {
    let reduced = Reduced::of(x);
    let size = reduced.odd().choose(reduced.sin, reduced.cos);
    let value = ((reduced.quarters + 1) & 2).is(2).choose(-size, size);
    x.abs().below(LIMIT).choose(value, 0.0 * x + 1.0)
}

/// tan x = sin/cos, or −cos/sin in odd quarters. Within 2 ulp up to 1e12; 0 beyond.
pub fn tan(x: Real) -> Real {
    let reduced = Reduced::of(x);
    let odd = reduced.odd();
    let value = odd.choose(-reduced.cos, reduced.sin) / odd.choose(reduced.sin, reduced.cos);
    let near = x.abs().below(two_to(-27)).choose(x, value);
    x.abs().below(LIMIT).choose(near, 0.0 * x)
}

/// Returns s and asin s − s = s z R(z) with z = s². s = |x| for |x| < 1/2, otherwise s = √((1 − |x|)/2).
fn asin_parts<'a>(x: Real<'a>) -> (Real<'a>, Real<'a>) {
    let a = x.abs();
    let near = a.below(0.5);
    let z = near.choose(a * a, 0.5 * (1.0 - a));
    let s = near.choose(a, z.sqrt());
    (s, s * z * polynomial(z, &ASIN))
}

/// asin x, within 2 ulp; NaN for |x| > 1.
pub fn asin(x: Real) -> Real {
    let a = x.abs();
    let (s, more) = asin_parts(x);
    // π/2 − 2 s is exact or nearly exact, so it is computed first and the small terms are added last.
    let far = (HALF_PI[0] - 2.0 * s) - (2.0 * more - HALF_PI[1]);
    a.below(0.5).choose(s + more, far).with_sign(x)
}

/// acos x, within 1.2 ulp; NaN for |x| > 1.
pub fn acos(x: Real) -> Real {
    let (s, more) = asin_parts(x);
    let (signed, signed_more) = (s.with_sign(x), x.below(0.0).choose(-more, more));
    let near = HALF_PI[0] - (signed - (HALF_PI[1] - signed_more));
    let double = 2.0 * (s + more);
    let far = x.below(0.0).choose(2.0 * HALF_PI[0] - (double - 2.0 * HALF_PI[1]), double);
    x.abs().below(0.5).choose(near, far)
}

/// The index of the table range that contains a number in [1/16, 16), from its bits.
fn atan_range(bits: Int) -> Int {
    bits.shift_right(50) & i64::from(tables::ATAN_LEN - 1)
}

/// atan(y/x) for y, x ≥ 0, not both 0, not both infinite, y below 2^1020. `range`: index of the range that contains
/// y/x, or of a neighbour that is at most a twelfth of an octave away. With c = b/a from that range, the difference
/// formula is atan(y/x) = atan c + atan t, where t = (a y − b x)/(b y + a x) and |t| ≤ 0.0789.
fn atan_quotient<'a>(y: Real<'a>, x: Real<'a>, range: Int<'a>) -> Real<'a> {
    let entry = |base| range.entry(base, tables::ATAN_LEN);
    let (a, b) = (entry(tables::ATAN_A), entry(tables::ATAN_B));
    let t = a.fma(y, -(b * x)) / b.fma(y, a * x);
    let z = t * t;
    entry(tables::ATAN_HIGH) + (t + (t * z).fma(polynomial(z, &ATAN), entry(tables::ATAN_LOW)))
}

/// atan x, within 0.9 ulp; ±π/2 at ±∞.
pub fn atan(x: Real) -> Real {
    // From 2^66 on the result is π/2.
    let a = x.abs().at_most(two_to(66));
    let inside = a.at_least(1.0 / 16.0).at_most(16f64.next_down());
    atan_quotient(a, a.constant(1.0), atan_range(inside.bits())).with_sign(x)
}

/// The angle of the point (x, y), within 1.5 ulp, with the special cases of IEEE 754.
pub fn atan2<'a>(y: Real<'a>, x: Real<'a>) -> Real<'a> {
    let (ay, ax) = (y.abs(), x.abs());
    // An infinite coordinate becomes 1; a finite one next to it becomes 0.
    let (iy, ix) = (ay.is(f64::INFINITY), ax.is(f64::INFINITY));
    let (fy, fx) = (ix.choose(0.0, ay), iy.choose(0.0, ax));
    let (fy, fx) = (iy.choose(1.0, fy), ix.choose(1.0, fx));
    // If one is large, the sum in `atan_quotient` would overflow. If both are tiny, its products would lose bits.
    let large = fy.above(two_to(1000)) | fx.above(two_to(1000));
    let tiny = fy.below(two_to(-900)) & fx.below(two_to(-900));
    let scale = large.choose(two_to(-6), tiny.choose(two_to(120), 1.0));
    let (fy, fx) = (fy * scale, fx * scale);
    // The bits of a positive number are nearly proportional to its logarithm; an octave is 2^52.
    let doublings = fy.bits() - fx.bits();
    let low = doublings.below(-4 << 52).choose_int(-4 << 52, doublings);
    let inside = low.below(4 << 52).choose_int(low, (4 << 52) - 1) + 1f64.to_bits() as i64;
    let quotient = fy.is(0.0).choose(0.0, atan_quotient(fy, fx, atan_range(inside)));
    let negative = x.bits().below(0);
    let angle = negative.choose(2.0 * HALF_PI[0] - (quotient - 2.0 * HALF_PI[1]), quotient);
    (x.is(x) & y.is(y)).choose(angle.with_sign(y), f64::NAN)
}
