//! Quantiles of Student's t and of χ², and the tail of χ², from the elementary functions that the caller provides.
//!
//! Sources: Press et al., Numerical Recipes, 3rd ed., secs. 6.1, 6.2 and 6.4 (Lanczos' series, continued fractions of
//! the incomplete beta and gamma functions by the modified Lentz method).

use crate::fit::unknowns::Elementary;

/// log Γ(x) for x > 0, to about 1e-15 relative.
fn log_gamma(x: f64, with: &Elementary) -> f64 {
    #[allow(clippy::excessive_precision, reason = "as printed in the source")]
    const COEFFICIENTS: [f64; 14] = [
        57.156_235_665_862_923_5,
        -59.597_960_355_475_491_2,
        14.136_097_974_741_747_1,
        -0.491_913_816_097_620_199,
        0.339_946_499_848_118_887e-4,
        0.465_236_289_270_485_756e-4,
        -0.983_744_753_048_795_646e-4,
        0.158_088_703_224_912_494e-3,
        -0.210_264_441_724_104_883e-3,
        0.217_439_618_115_212_643e-3,
        -0.164_318_106_536_763_890e-3,
        0.844_182_239_838_527_433e-4,
        -0.261_908_384_015_814_087e-4,
        0.368_991_826_595_316_234e-5,
    ];
    let shifted = x + 671.0 / 128.0;
    let scale = (x + 0.5) * (with.log)(shifted) - shifted;
    let mut sum = 0.999_999_999_999_997_1;
    for (k, coefficient) in COEFFICIENTS.iter().enumerate() {
        sum += coefficient / (x + k as f64 + 1.0);
    }
    scale + (with.log)(2.506_628_274_631_000_5 * sum / x)
}

/// Smallest denominator of the Lentz method.
const TINY: f64 = 1e-300;
/// Bound on the terms of series and continued fractions; their number grows with the square root of the degrees of
/// freedom.
const MOST_TERMS: u32 = 1_000_000;

/// The regularised incomplete beta function I_x(a, b).
fn incomplete_beta(a: f64, b: f64, x: f64, with: &Elementary) -> f64 {
    if x <= 0.0 || x >= 1.0 {
        return if x <= 0.0 { 0.0 } else { 1.0 };
    }
    let front = log_gamma(a + b, with) - log_gamma(a, with) - log_gamma(b, with);
    let front = (with.exp)(front + a * (with.log)(x) + b * (with.log)(1.0 - x));
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - front * beta_fraction(b, a, 1.0 - x) / b;
    }
    front * beta_fraction(a, b, x) / a
}

fn beta_fraction(a: f64, b: f64, x: f64) -> f64 {
    let away = |value: f64| if value.abs() < TINY { TINY } else { value };
    let mut c = 1.0;
    let mut d = 1.0 / away(1.0 - (a + b) * x / (a + 1.0));
    let mut h = d;
    for m in 1..MOST_TERMS {
        let m = f64::from(m);
        let even = m * (b - m) * x / ((a - 1.0 + 2.0 * m) * (a + 2.0 * m));
        d = 1.0 / away(1.0 + even * d);
        c = away(1.0 + even / c);
        h *= d * c;
        let odd = -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 1.0 + 2.0 * m));
        d = 1.0 / away(1.0 + odd * d);
        c = away(1.0 + odd / c);
        h *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    h
}

/// The number t for which a variable of Student's distribution lies within −t .. t with this probability.
///
/// `degrees`: degrees of freedom, at least 1. `level`: between 0 and 1.
pub fn student(level: f64, degrees: f64, with: &Elementary) -> f64 {
    assert!(level > 0.0 && level < 1.0 && degrees >= 1.0, "level {level}, {degrees} degrees of freedom");
    // P(|T| > t) = I_x(n/2, 1/2) with x = n/(n + t²); decreasing in t.
    let outside = |t: f64| incomplete_beta(0.5 * degrees, 0.5, degrees / (degrees + t * t), with);
    root(0.0, &|t| (1.0 - level) - outside(t))
}

/// P(χ² > x) with this number of degrees of freedom.
pub fn chi_square_tail(x: f64, degrees: f64, with: &Elementary) -> f64 {
    let (a, x) = (0.5 * degrees, 0.5 * x);
    if x <= 0.0 {
        return 1.0;
    }
    let front = (with.exp)(a * (with.log)(x) - x - log_gamma(a, with));
    if x < a + 1.0 {
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        for _ in 0..MOST_TERMS {
            n += 1.0;
            term *= x / n;
            sum += term;
            if term < 1e-16 * sum {
                break;
            }
        }
        return 1.0 - front * sum;
    }
    let away = |value: f64| if value.abs() < TINY { TINY } else { value };
    let mut b = x + 1.0 - a;
    let mut c = 1.0 / TINY;
    let mut d = 1.0 / b;
    let mut h = d;
    for i in 1..MOST_TERMS {
        let i = f64::from(i);
        let an = -i * (i - a);
        b += 2.0;
        d = 1.0 / away(an * d + b);
        c = away(b + an / c);
        h *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    front * h
}

/// The root of an increasing function above `low`, where it is not positive: by doubling, then bisection to the last
/// bit.
fn root(low: f64, of: &dyn Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (low, 1.0);
    while of(high) < 0.0 && high < 1e300 {
        (low, high) = (high, 2.0 * high);
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if of(middle) < 0.0 { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;

    /// Abramowitz & Stegun, table 26.10; R 4.3 `qt(0.975, n)`.
    #[test]
    fn quantiles_of_student_are_those_of_tables() {
        let table = [
            (0.95, 1.0, 12.706_204_736_174_7),
            (0.95, 2.0, 4.302_652_729_911_28),
            (0.95, 10.0, 2.228_138_851_986_27),
            (0.95, 1000.0, 1.962_339_080_826_41),
            (0.99, 5.0, 4.032_142_983_557_54),
            (0.6827, 1e6, 1.000_02),
        ];
        for (level, degrees, expected) in table {
            let found = student(level, degrees, &PLATFORM);
            let tolerance = if degrees == 1e6 { 1e-4 } else { 1e-9 };
            assert!((found / expected - 1.0).abs() < tolerance, "{level} {degrees}: {found}, not {expected}");
        }
    }

    /// R 4.3 `pchisq(x, n, lower.tail = FALSE)`.
    #[test]
    fn tails_of_chi_square_are_those_of_tables() {
        let table =
            [(3.841_458_820_694_12, 1.0, 0.05), (18.307_038_053_275_1, 10.0, 0.05), (11.344_866_730_144_4, 3.0, 0.01)];
        for (x, degrees, expected) in table {
            let found = chi_square_tail(x, degrees, &PLATFORM);
            assert!((found / expected - 1.0).abs() < 1e-9, "{x} {degrees}: {found}, not {expected}");
        }
        // Two degrees of freedom: exp(−x/2).
        for k in 1..60 {
            let x = 0.7 * f64::from(k);
            let found = chi_square_tail(x, 2.0, &PLATFORM);
            assert!((found / (-0.5 * x).exp() - 1.0).abs() < 1e-12, "{x}: {found}");
        }
    }
}
