//! Step-size control of adaptive runs: Gustafsson's predictive controller (Hairer, Wanner, *Solving ODEs II*, IV.8).
//! The compiled step and the runtime share these constants.

/// Safety factor: a step has this fraction of the length that the error estimate permits.
pub const SAFETY: f64 = 0.9;

/// Lower bound of the error in the controller, as a fraction of the permitted error.
pub const LEAST_ERROR: f64 = 1e-10;

/// Lower bound of the stored fifth root, that of an error of a hundredth: a smaller error says little about the next
/// step.
pub const LEAST_ROOT: f64 = 0.4;

/// Smallest ratio of a step length to the previous one.
pub const LEAST_GAIN: f64 = 0.2;

/// Largest ratio of a step length to the previous one.
pub const GREATEST_GAIN: f64 = 6.0;

/// Largest ratio of a step length to that of a rejected step.
pub const MOST_REFUSED: f64 = 0.9;

/// A step that would cover more than this fraction of the way to the stop is extended to the stop.
pub const NEARLY: f64 = 0.999;

/// A step that would cover more than this fraction is shortened to it.
pub const HALFWAY: f64 = 0.5;

/// After a step across a switching surface is rejected for its error, the next one covers this fraction of the way to
/// it.
pub const BEFORE_SURFACE: f64 = 0.95;

/// Upper bound for the way to the surface in that case, as a fraction of the rejected step.
pub const MOST_BEFORE_SURFACE: f64 = 0.9;

/// Maximum number of consecutive rejections of this kind without the caller.
pub const MOST_OVERRUNS: f64 = 3.0;

/// Steps shorter than this fraction of the next stop are left to the caller.
pub const LEAST_STEP: f64 = 32.0 * f64::EPSILON;

/// Initial value for the exponent of x^(−1/5), chosen such that the errors of both signs are equal.
pub const ROOT_CONSTANT: i64 = 0x4cb8_a7ef_9db2_2d0e;

/// x^(−1/5) of a positive number to four digits, by Newton's method from its exponent. It has the same bits on every
/// machine, and no division, because the next step waits for the result.
pub fn inverse_fifth_root(x: f64) -> f64 {
    // A fifth of the bits is a fifth of the exponent, with linear interpolation of the logarithm over the mantissa: 1/5
    // = (1/8 + 1/16) (1 + 1/16) (1 + 1/256) (1 + 1/65536) to ten digits.
    let bits = x.to_bits();
    let mut fifth = (bits >> 3) + (bits >> 4);
    for n in [4, 8, 16] {
        fifth += fifth >> n;
    }
    let mut y = f64::from_bits(ROOT_CONSTANT as u64 - fifth);
    for _ in 0..2 {
        let square = y * y;
        y *= 1.2 - (0.2 * x * y) * (square * square);
    }
    y
}

#[test]
fn inverse_fifth_roots() {
    let mut x = 1e-30;
    while x < 1e30 {
        let y = inverse_fifth_root(x);
        let square = y * y;
        assert!((x * y * (square * square) - 1.0).abs() < 1.5e-4, "{x}");
        x *= 1.3;
    }
}
