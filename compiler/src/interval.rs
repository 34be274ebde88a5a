//! Intervals of reals whose ends may be left out: what a quantity can be.

/// All reals between two ends. An end that is left out is not reached; infinite ends never are.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Whether the lower end is left out.
    pub above_low: bool,
    /// Whether the upper end is left out.
    pub below_high: bool,
    /// Whether 0 is known to be left out, wherever it lies.
    pub not_zero: bool,
}

impl Interval {
    /// Everything.
    pub const ALL: Interval =
        Interval { low: f64::NEG_INFINITY, high: f64::INFINITY, above_low: true, below_high: true, not_zero: false };

    /// One number; everything, if it is NaN.
    pub fn point(x: f64) -> Interval {
        if x.is_nan() { Interval::ALL } else { Interval::closed(x, x) }
    }

    /// Both ends included.
    pub fn closed(low: f64, high: f64) -> Interval {
        Interval { low, high, above_low: false, below_high: false, not_zero: false }
    }

    /// Both ends left out.
    pub fn open(low: f64, high: f64) -> Interval {
        Interval { low, high, above_low: true, below_high: true, not_zero: false }
    }

    /// Whether 0 can be reached.
    pub fn has_zero(self) -> bool {
        let under = self.low < 0.0 || (self.low == 0.0 && !self.above_low);
        let over = self.high > 0.0 || (self.high == 0.0 && !self.below_high);
        under && over && !self.not_zero
    }

    /// Whether every number in it is at least 0.
    pub fn is_not_negative(self) -> bool {
        self.low >= 0.0
    }

    /// Whether every number in it is above 0.
    pub fn is_positive(self) -> bool {
        self.low > 0.0 || (self.low == 0.0 && (self.above_low || self.not_zero))
    }

    /// What lies in both.
    pub fn and(self, other: Interval) -> Interval {
        let (low, above_low) = match self.low.total_cmp(&other.low) {
            std::cmp::Ordering::Less => (other.low, other.above_low),
            std::cmp::Ordering::Greater => (self.low, self.above_low),
            std::cmp::Ordering::Equal => (self.low, self.above_low || other.above_low),
        };
        let (high, below_high) = match self.high.total_cmp(&other.high) {
            std::cmp::Ordering::Less => (self.high, self.below_high),
            std::cmp::Ordering::Greater => (other.high, other.below_high),
            std::cmp::Ordering::Equal => (self.high, self.below_high || other.below_high),
        };
        Interval { low, high, above_low, below_high, not_zero: self.not_zero || other.not_zero }
    }

    /// The smallest interval around both.
    pub fn hull(self, other: Interval) -> Interval {
        let (low, above_low) = match self.low.total_cmp(&other.low) {
            std::cmp::Ordering::Less => (self.low, self.above_low),
            std::cmp::Ordering::Greater => (other.low, other.above_low),
            std::cmp::Ordering::Equal => (self.low, self.above_low && other.above_low),
        };
        let (high, below_high) = match self.high.total_cmp(&other.high) {
            std::cmp::Ordering::Less => (other.high, other.below_high),
            std::cmp::Ordering::Greater => (self.high, self.below_high),
            std::cmp::Ordering::Equal => (self.high, self.below_high && other.below_high),
        };
        Interval { low, high, above_low, below_high, not_zero: !self.has_zero() && !other.has_zero() }
    }

    /// −a
    pub fn negate(self) -> Interval {
        Interval {
            low: -self.high,
            high: -self.low,
            above_low: self.below_high,
            below_high: self.above_low,
            not_zero: self.not_zero,
        }
    }

    /// a + b
    pub fn plus(self, other: Interval) -> Interval {
        Interval {
            low: self.low + other.low,
            high: self.high + other.high,
            above_low: self.above_low || other.above_low,
            below_high: self.below_high || other.below_high,
            not_zero: false,
        }
        .sound()
    }

    /// a · b
    pub fn multiply(self, other: Interval) -> Interval {
        let ends = |i: Interval| [(i.low, i.above_low), (i.high, i.below_high)];
        let mut products = Vec::with_capacity(4);
        for (a, a_open) in ends(self) {
            for (b, b_open) in ends(other) {
                // A zero that is reached makes the product 0, however far the other goes.
                let zero = (a == 0.0 && !a_open) || (b == 0.0 && !b_open);
                let product = if a == 0.0 || b == 0.0 { 0.0 } else { a * b };
                products.push((product, !zero && (a_open || b_open)));
            }
        }
        let not_zero = !self.has_zero() && !other.has_zero();
        Interval { not_zero, ..around(&products) }.sound()
    }

    /// a / b, where b is not 0.
    pub fn divide(self, other: Interval) -> Interval {
        self.multiply(other.reciprocal())
    }

    fn reciprocal(self) -> Interval {
        if self.low >= 0.0 {
            let high = if self.low == 0.0 { f64::INFINITY } else { 1.0 / self.low };
            let low = if self.high.is_infinite() { 0.0 } else { 1.0 / self.high };
            Interval {
                low,
                high,
                above_low: self.below_high || self.high.is_infinite(),
                below_high: self.above_low || self.low == 0.0,
                not_zero: true,
            }
        } else if self.high <= 0.0 {
            self.negate().reciprocal().negate()
        } else {
            Interval { not_zero: true, ..Interval::ALL }
        }
    }

    /// |a|
    pub fn abs(self) -> Interval {
        if self.low >= 0.0 {
            self
        } else if self.high <= 0.0 {
            self.negate()
        } else {
            let (high, below_high) = match self.high.total_cmp(&-self.low) {
                std::cmp::Ordering::Less => (-self.low, self.above_low),
                std::cmp::Ordering::Greater => (self.high, self.below_high),
                std::cmp::Ordering::Equal => (self.high, self.below_high && self.above_low),
            };
            Interval { low: 0.0, high, above_low: self.not_zero, below_high, not_zero: self.not_zero }
        }
    }

    /// a multiplied with itself.
    pub fn square(self) -> Interval {
        let size = self.abs();
        size.multiply(size)
    }

    /// The smaller of both.
    pub fn min(self, other: Interval) -> Interval {
        self.negate().max(other.negate()).negate()
    }

    /// The larger of both.
    pub fn max(self, other: Interval) -> Interval {
        let pick = |a: (f64, bool), b: (f64, bool)| match a.0.total_cmp(&b.0) {
            std::cmp::Ordering::Less => b,
            std::cmp::Ordering::Greater => a,
            std::cmp::Ordering::Equal => (a.0, a.1 && b.1),
        };
        let (low, above_low) = match self.low.total_cmp(&other.low) {
            std::cmp::Ordering::Equal => (self.low, self.above_low || other.above_low),
            _ => pick((self.low, self.above_low), (other.low, other.above_low)),
        };
        let (high, below_high) = pick((self.high, self.below_high), (other.high, other.below_high));
        Interval { low, high, above_low, below_high, not_zero: self.not_zero && other.not_zero }
    }

    /// The image under a function that rises everywhere; `ends` are its limits at −inf and inf.
    pub fn rising(self, f: impl Fn(f64) -> f64, ends: (f64, f64)) -> Interval {
        let at = |x: f64| {
            if x == f64::NEG_INFINITY {
                ends.0
            } else if x == f64::INFINITY {
                ends.1
            } else {
                f(x)
            }
        };
        let (low, high) = (at(self.low), at(self.high));
        Interval {
            low,
            high,
            above_low: self.above_low || self.low.is_infinite(),
            below_high: self.below_high || self.high.is_infinite(),
            not_zero: false,
        }
        .sound()
    }

    /// Everything where an end is NaN: inf − inf.
    fn sound(self) -> Interval {
        let low = if self.low.is_nan() { f64::NEG_INFINITY } else { self.low };
        let high = if self.high.is_nan() { f64::INFINITY } else { self.high };
        Interval {
            low,
            high,
            above_low: self.above_low || low.is_infinite(),
            below_high: self.below_high || high.is_infinite(),
            ..self
        }
    }
}

/// The smallest interval around ends, each with whether it is left out.
fn around(ends: &[(f64, bool)]) -> Interval {
    let mut out =
        Interval { low: f64::INFINITY, high: f64::NEG_INFINITY, above_low: true, below_high: true, not_zero: false };
    for &(x, open) in ends {
        if x < out.low || (x == out.low && !open) {
            (out.low, out.above_low) = (x, open);
        }
        if x > out.high || (x == out.high && !open) {
            (out.high, out.below_high) = (x, open);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_out_stays_out() {
        let positive = Interval { low: 0.0, high: f64::INFINITY, above_low: true, below_high: true, not_zero: false };
        let not_negative = Interval { above_low: false, ..positive };
        assert!(!positive.has_zero() && not_negative.has_zero());
        assert!(!positive.multiply(positive).has_zero());
        assert!(!positive.divide(positive).has_zero());
        assert!(!positive.plus(not_negative).has_zero());
        assert!(positive.multiply(not_negative).has_zero());
        let bell = Interval::ALL.square().negate().rising(|x| x, (f64::NEG_INFINITY, f64::INFINITY));
        assert_eq!((bell.high, bell.below_high), (0.0, false));
    }

    #[test]
    fn products_cover_their_corners() {
        let a = Interval::closed(-2.0, 3.0);
        let b = Interval::closed(-5.0, 4.0);
        let product = a.multiply(b);
        assert_eq!((product.low, product.high), (-15.0, 12.0));
        assert_eq!((a.square().low, a.square().high), (0.0, 9.0));
        assert_eq!((a.abs().low, a.abs().high), (0.0, 3.0));
        assert_eq!(a.max(b), Interval::closed(-2.0, 4.0));
        assert_eq!(a.min(b), Interval::closed(-5.0, 3.0));
    }
}
