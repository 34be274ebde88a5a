//! log, log1p, pow.
//!
//! One reduction for all: x = 2^k z with z in [0.689, 1.379), z/c = 1 + r with 1/c from a table of 128 numbers of few
//! bits, so that r is exact near 1, and log x = k ln2 + log c + log(1 + r).

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
/// ln2: a multiple of 2^-42, so that k times it is exact; and the rest.
const LN2: (f64, f64) = (0.6931471805598903, 5.497923018708371e-14);
/// Bits of the lower end of the first cell: 1 lies in the middle of one.
const FIRST: i64 = 0x3fe6_1000_0000_0000;

/// x = 2^k z; log c = high + low.
struct Reduced<'a> {
    k: Int<'a>,
    z: Real<'a>,
    inverse: Real<'a>,
    high: Real<'a>,
    low: Real<'a>,
}

impl<'a> Reduced<'a> {
    /// Of x, normal and positive; of anything else, some numbers.
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

/// A subnormal x times 2^52, and what that adds to k.
fn normal<'a>(x: Real<'a>) -> (Real<'a>, Real<'a>) {
    let subnormal: Truth = x.below(f64::MIN_POSITIVE);
    (subnormal.choose(x * two_to(52), x), subnormal.choose(-52.0, 0.0))
}

/// k ln2 + log c + log(1 + r), from r that lacks `r_low`.
fn sum<'a>(k: Real<'a>, reduced: &Reduced<'a>, r: Real<'a>) -> Real<'a> {
    let whole = k.fma(LN2.0, reduced.high);
    let high = whole + r;
    let low = (whole - high + r) + k.fma(LN2.1, reduced.low);
    high + (r * r).fma(polynomial(r, &LOG), low)
}

/// Within 0.52 ulp.
pub fn log(x: Real) -> Real {
    let (scaled, more) = normal(x);
    let reduced = Reduced::of(scaled);
    let r = reduced.z.fma(reduced.inverse, -1.0);
    let value = sum(reduced.k.real() + more, &reduced, r);
    let edge = x.is(0.0).choose(f64::NEG_INFINITY, x.is(f64::INFINITY).choose(f64::INFINITY, f64::NAN));
    (x.above(0.0) & x.below(f64::INFINITY)).choose(value, edge)
}

/// log(1 + x): what 1 + x loses is added to r. Within 1.2 ulp.
pub fn log1p(x: Real) -> Real {
    let (one, lost) = two_sum(x.constant(1.0), x);
    let reduced = Reduced::of(one);
    // For k > 1022 nothing is lost.
    let unscale = reduced.k.below(1023).choose_int((1023 - reduced.k) << 52, 0).real_of_bits();
    let r = (lost * unscale).fma(reduced.inverse, reduced.z.fma(reduced.inverse, -1.0));
    let value = sum(reduced.k.real(), &reduced, r);
    let edge = x.is(-1.0).choose(f64::NEG_INFINITY, x.is(f64::INFINITY).choose(f64::INFINITY, f64::NAN));
    let inside = (x.above(-1.0) & x.below(f64::INFINITY)).choose(value, edge);
    x.abs().below(two_to(-54)).choose(x, inside)
}

/// e^(y log x), the logarithm with 68 bits: within 0.52 ulp, and as IEEE 754 defines it at the edges.
pub fn pow<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let magnitude = pow_of_size(x.abs(), y);
    // Below zero y must be whole; an odd y keeps the sign. Infinities are even.
    let whole = y.floor().is(y);
    let half = 0.5 * y;
    let odd = whole & !half.floor().is(half);
    let negative = x.bits().below(0) & x.is(x) & y.is(y);
    let signed = (negative & odd).choose(-magnitude, magnitude);
    let any = (x.below(0.0) & x.above(f64::NEG_INFINITY) & !whole).choose(f64::NAN, signed);
    x.above(0.0).choose(magnitude, any)
}

/// The same bits of an x without a sign, or NaN.
pub fn pow_of_size<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let times = y.abs();
    let plain = y.is(1.0);
    let usual = x.above(0.0) & x.below(f64::INFINITY) & times.above(0.0) & times.below(f64::INFINITY) & !plain;
    // x^1 = x, x^0 = 1 and 1^y = 1, of NaN too. Else x is 0 or infinite, or y is.
    let one = x.is(1.0) | y.is(0.0);
    let number = x.is(x) & y.is(y);
    let falls = y.below(0.0);
    let grows = x.above(1.0).choose(falls.choose(0.0, f64::INFINITY), falls.choose(f64::INFINITY, 0.0));
    usual.choose(power(x, y), plain.choose(x, one.choose(1.0, number.choose(grows, f64::NAN))))
}

/// x^y of an x above 0, both finite.
fn power<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let (scaled, more) = normal(x);
    let reduced = Reduced::of(scaled);
    let k = reduced.k.real() + more;
    let r = reduced.z.fma(reduced.inverse, -1.0);
    // Largest first: k ln2 + log c, r, −r²/2 as high and low part, then all that is small.
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
