//! How an adaptive run chooses the lengths of its steps: Gustafsson's predictive control (Hairer & Wanner, Solving ODEs
//! II, sec. IV.8). The same numbers in the compiled step and in the run around it.

/// Steps are chosen this part of what the error would allow.
pub const SAFETY: f64 = 0.9;

/// A smaller error, as a part of what is allowed, is taken for this.
pub const LEAST_ERROR: f64 = 1e-10;

/// The fifth root of an error of a hundredth: a smaller one says little about the next step.
pub const LEAST_ROOT: f64 = 0.4;

/// A step follows one that is at most so much longer.
pub const LEAST_GAIN: f64 = 0.2;

/// A step follows one that is at most so much shorter.
pub const GREATEST_GAIN: f64 = 6.0;

/// After one that was refused, a step is at least so much shorter.
pub const MOST_REFUSED: f64 = 0.9;

/// A step that would leave less than a thousandth of the way to the stop goes there.
pub const NEARLY: f64 = 0.999;

/// And one that would leave less than itself goes so far.
pub const HALFWAY: f64 = 0.5;

/// A step that ran over a switching surface and is refused for its error is made again up to this part of the way there,
pub const BEFORE_SURFACE: f64 = 0.95;

/// but is shortened to at most this part of it,
pub const MOST_BEFORE_SURFACE: f64 = 0.9;

/// and so often in a row without anybody looking.
pub const MOST_OVERRUNS: f64 = 3.0;

/// Parts of the next stop below which nobody but the run itself decides on a step.
pub const LEAST_STEP: f64 = 32.0 * f64::EPSILON;

/// What the exponent of x^(−1/5) begins with: the constant makes the errors of both signs equal.
pub const ROOT_CONSTANT: i64 = 0x4cb8_a7ef_9db2_2d0e;

/// x^(−1/5) of a positive number to four digits, by Newton's method from its exponent: the same bits on every machine, and
/// no division, since the next step waits for it.
pub fn inverse_fifth_root(x: f64) -> f64 {
    // A fifth of the exponent, and of the fraction as if the logarithm were straight in between:
    // 1/5 = (1/8 + 1/16) (1 + 1/16) (1 + 1/256) (1 + 1/65536) to ten digits.
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
