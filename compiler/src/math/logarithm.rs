//! log, log1p and pow.
//!
//! All use one argument reduction: x = 2^k z with z in [0.689, 1.379), and z/c = 1 + r, where 1/c comes from a table of
//! 128 numbers with few bits. So r is exact near 1, and log x = k ln2 + log c + log(1 + r).
//!
//! Source: Tang, *Table-driven implementation of the logarithm function in IEEE floating-point arithmetic*, 1990.

use super::exponential::Parts;
use super::two_to;
use super::{polynomial, tables, two_sum};
use crate::ir::expr::{Int, Real, Truth};

/// (log(1 + r) − r)/r² on |r| ≤ 0.00564; relative error 2^-61.3 of the logarithm.
const LOG: [f64; 6] = [
    -0.5000000000000004,
    0.3333333333333344,
    -0.2499999998901714,
    0.19999999983075703,
    -0.166673599512725,
    0.14286489316742468,
];
/// (log(1 + r) − r + r²/2)/r³ on |r| ≤ 0.00564; relative error 2^-77.9 of the logarithm.
const LOG_LONG: [f64; 7] = [
    0.3333333333333333,
    -0.2500000000000008,
    0.2000000000000022,
    -0.16666666653838877,
    0.14285714265087318,
    -0.12500643829837513,
    0.11111850754499299,
];
/// ln2 in two parts. The first is a multiple of 2^-42, so that its product with k is exact.
const LN2: (f64, f64) = (0.6931471805598903, 5.497923018708371e-14);
/// The bits of the lower end of the first table interval. 1 is in the middle of an interval.
const FIRST: i64 = 0x3fe6_1000_0000_0000;

/// x = 2^k z, `inverse` = 1/c, and log c = high + low.
struct Reduced<'a> {
    k: Int<'a>,
    z: Real<'a>,
    inverse: Real<'a>,
    high: Real<'a>,
    low: Real<'a>,
}

impl<'a> Reduced<'a> {
    /// Reduces a normal, positive x. For other arguments the fields are arbitrary.
    fn of(x: Real<'a>) -> Reduced<'a> {
        let bits = x.bits();
        let place = bits - FIRST;
        let index = place.shift_right(45) & i64::from(tables::LOG_LEN - 1);
        let entry = |base| index.entry(base, tables::LOG_LEN);
        Reduced {
            k: place >> 52,
            z: (bits - (place & (0xfff << 52))).real_of_bits(),
            inverse: entry(tables::LOG_INVERSE),
            high: entry(tables::LOG_HIGH),
            low: entry(tables::LOG_LOW),
        }
    }
}

/// Multiplies a subnormal x by 2^52; also returns the resulting correction of k, −52 or 0.
fn normal<'a>(x: Real<'a>) -> (Real<'a>, Real<'a>) {
    let subnormal: Truth = x.below(f64::MIN_POSITIVE);
    (subnormal.choose(x * two_to(52), x), subnormal.choose(-52.0, 0.0))
}

/// k ln2 + log c + log(1 + r).
fn sum<'a>(k: Real<'a>, reduced: &Reduced<'a>, r: Real<'a>) -> Real<'a> {
    let whole = k.fma(LN2.0, reduced.high);
    let high = whole + r;
    let low = (whole - high + r) + k.fma(LN2.1, reduced.low);
    high + (r * r).fma(polynomial(r, &LOG), low)
}

/// log x, within 0.52 ulp.
pub fn log(x: Real) -> Real {
    let (scaled, more) = normal(x);
    let reduced = Reduced::of(scaled);
    let r = reduced.z.fma(reduced.inverse, -1.0);
    let value = sum(reduced.k.real() + more, &reduced, r);
    let edge = x.is(0.0).choose(f64::NEG_INFINITY, x.is(f64::INFINITY).choose(f64::INFINITY, f64::NAN));
    (x.above(0.0) & x.below(f64::INFINITY)).choose(value, edge)
}

/// log(1 + x), within 1.2 ulp. The rounding error of 1 + x is added to r.
pub fn log1p(x: Real) -> Real {
    let (one, lost) = two_sum(x.constant(1.0), x);
    let reduced = Reduced::of(one);
    // If k > 1022, the rounding error of 1 + x is 0.
    let unscale = reduced.k.below(1023).choose_int((1023 - reduced.k) << 52, 0).real_of_bits();
    let r = (lost * unscale).fma(reduced.inverse, reduced.z.fma(reduced.inverse, -1.0));
    let value = sum(reduced.k.real(), &reduced, r);
    let edge = x.is(-1.0).choose(f64::NEG_INFINITY, x.is(f64::INFINITY).choose(f64::INFINITY, f64::NAN));
    let inside = (x.above(-1.0) & x.below(f64::INFINITY)).choose(value, edge);
    x.abs().below(two_to(-54)).choose(x, inside)
}

/// x^y = e^(y log x), within 0.52 ulp, with the special cases of IEEE 754. The logarithm has 68 bits.
pub fn pow<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let magnitude = pow_of_size(x.abs(), y);
    // A negative base needs an integer y, and an odd y keeps the sign. Infinite y count as even.
    let whole = y.floor().is(y);
    let half = 0.5 * y;
    let odd = whole & !half.floor().is(half);
    let negative = x.bits().below(0) & x.is(x) & y.is(y);
    let signed = (negative & odd).choose(-magnitude, magnitude);
    let any = (x.below(0.0) & x.above(f64::NEG_INFINITY) & !whole).choose(f64::NAN, signed);
    x.above(0.0).choose(magnitude, any)
}

/// The same bits as [`pow`], for an x that has no negative sign or is NaN.
pub fn pow_of_size<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let exponent = y.abs();
    let plain = y.is(1.0);
    let usual = x.above(0.0) & x.below(f64::INFINITY) & exponent.above(0.0) & exponent.below(f64::INFINITY) & !plain;
    // x^1 = x; x^0 = 1 and 1^y = 1, also for NaN. In the remaining cases x is 0 or infinite, or y is infinite.
    let one = x.is(1.0) | y.is(0.0);
    let number = x.is(x) & y.is(y);
    let falls = y.below(0.0);
    let limit = x.above(1.0).choose(falls.choose(0.0, f64::INFINITY), falls.choose(f64::INFINITY, 0.0));
    usual.choose(power(x, y), plain.choose(x, one.choose(1.0, number.choose(limit, f64::NAN))))
}

/// x^y for x > 0, both finite.
fn power<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let (scaled, more) = normal(x);
    let reduced = Reduced::of(scaled);
    let k = reduced.k.real() + more;
    let r = reduced.z.fma(reduced.inverse, -1.0);
    // The terms in order of size: k ln2 + log c, r, −r²/2 as high and low part, then all small terms.
    let whole = k.fma(LN2.0, reduced.high);
    let first = whole + r;
    let first_low = whole - first + r;
    let half = -0.5 * r;
    let square = half * r;
    let square_low = half.fma(r, -square);
    let second = first + square;
    let second_low = first - second + square;
    let cube = r * r * r;
    let small = cube.fma(polynomial(r, &LOG_LONG), k.fma(LN2.1, reduced.low) + square_low);
    let low = (first_low + second_low) + small;
    let log = second + low;
    let log_low = second - log + low;

    let product = y * log;
    let product_low = y.fma(log_low, y.fma(log, -product));
    Parts::exact(product, Some(product_low)).scaled(product, 0)
}
