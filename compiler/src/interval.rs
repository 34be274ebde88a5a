//! Interval arithmetic over doubles, with outward rounding (Moore, Kearfott, Cloud, *Introduction to Interval
//! Analysis*, 2009).
//!
//! In: intervals of operands. Out: an interval that contains every possible result. Knows nothing of expressions.
//!
//! An interval is a closed set of doubles between two ends, without those nearer to 0 than `away`. A strict bound `x >
//! a` is the closed bound at the next double, so open ends are not needed. Ends of results are rounded outwards, so
//! that they hold for every order in which code may compute a result: with products fused into sums, and with quotients
//! computed as products with a reciprocal. −0 and 0 are the same number.
//!
//! A result too small for a double is 0, and the interval of such a result contains 0. A result too large ends at
//! infinity; nothing is guaranteed for infinite operands.

/// The smallest positive double.
const LEAST: f64 = f64::from_bits(1);

/// Bound on the relative error of an elementary function; those of `math` are accurate to one unit in the last place.
const ELEMENTARY: f64 = 4.0 * f64::EPSILON;

/// Upper bound on the rounding errors of squares and roots.
pub const SLACK: f64 = 1e-14;

/// All doubles x with `low` ≤ x ≤ `high` and |x| ≥ `away`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Interval {
    /// Least value.
    pub low: f64,
    /// Greatest value; below `low` if the interval is empty.
    pub high: f64,
    /// Least magnitude. If it is positive, it excludes 0 from an interval with both signs.
    pub away: f64,
}

impl Interval {
    /// All doubles.
    pub const ALL: Interval = Interval { low: f64::NEG_INFINITY, high: f64::INFINITY, away: 0.0 };

    /// The empty set: the value of an expression under contradictory conditions.
    pub const EMPTY: Interval = Interval { low: f64::INFINITY, high: f64::NEG_INFINITY, away: f64::INFINITY };

    /// All doubles but 0.
    pub const NOT_ZERO: Interval = Interval { away: LEAST, ..Interval::ALL };

    /// A single number; [`Interval::ALL`] for NaN.
    pub fn point(x: f64) -> Interval {
        if x.is_nan() { Interval::ALL } else { Interval::closed(x, x) }
    }

    /// The interval with both ends included; an end that is NaN is unbounded.
    pub fn closed(low: f64, high: f64) -> Interval {
        Interval { low, high, away: 0.0 }.normal()
    }

    /// All numbers ≥ `low`.
    pub fn from(low: f64) -> Interval {
        Interval::closed(low, f64::INFINITY)
    }

    /// All numbers ≤ `high`.
    pub fn to(high: f64) -> Interval {
        Interval::closed(f64::NEG_INFINITY, high)
    }

    /// All numbers of magnitude ≥ `away`.
    pub fn beyond(away: f64) -> Interval {
        Interval { away: away.max(0.0), ..Interval::ALL }
    }

    /// Whether the interval is empty.
    pub fn is_empty(self) -> bool {
        self.low > self.high
    }

    /// Whether it holds a single number.
    pub fn is_point(self) -> bool {
        self.low == self.high
    }

    /// Whether it contains 0.
    pub fn has_zero(self) -> bool {
        self.low <= 0.0 && self.high >= 0.0 && self.away == 0.0
    }

    /// Whether all its numbers are ≥ 0.
    pub fn is_not_negative(self) -> bool {
        self.low >= 0.0 || self.is_empty()
    }

    /// Whether all its numbers are > 0.
    pub fn is_positive(self) -> bool {
        self.low > 0.0 || self.is_empty()
    }

    /// Greatest magnitude.
    pub fn size(self) -> f64 {
        if self.is_empty() { 0.0 } else { self.high.max(-self.low) }
    }

    /// The same set in normal form: each of the three bounds as tight as the other two allow.
    fn normal(self) -> Interval {
        let mut low = if self.low.is_nan() { f64::NEG_INFINITY } else { self.low + 0.0 };
        let mut high = if self.high.is_nan() { f64::INFINITY } else { self.high + 0.0 };
        let mut away = if self.away.is_nan() { 0.0 } else { self.away };
        if away > 0.0 {
            if low > -away {
                low = low.max(away);
            }
            if high < away {
                high = high.min(-away);
            }
        }
        if low > high {
            return Interval::EMPTY;
        }
        away = away.max(low).max(-high);
        Interval { low, high, away }
    }

    /// Intersection.
    pub fn and(self, other: Interval) -> Interval {
        let (low, high) = (self.low.max(other.low), self.high.min(other.high));
        Interval { low, high, away: self.away.max(other.away) }.normal()
    }

    /// Convex hull: the smallest interval that contains both.
    pub fn hull(self, other: Interval) -> Interval {
        let (low, high) = (self.low.min(other.low), self.high.max(other.high));
        Interval { low, high, away: self.away.min(other.away) }.normal()
    }

    /// −a
    pub fn negate(self) -> Interval {
        if self.is_empty() {
            return self;
        }
        Interval { low: -self.high, high: -self.low, away: self.away }.normal()
    }

    /// a + b
    pub fn plus(self, other: Interval) -> Interval {
        if self.is_empty() || other.is_empty() {
            return Interval::EMPTY;
        }
        let apart = |a: Interval, b: Interval| sum(a.away, -b.size()).0;
        let away = apart(self, other).max(apart(other, self)).max(0.0);
        let (low, high) = (sum(self.low, other.low).0, sum(self.high, other.high).1);
        Interval { low, high, away }.normal()
    }

    /// a − b
    pub fn minus(self, other: Interval) -> Interval {
        self.plus(other.negate())
    }

    /// a · b
    pub fn multiply(self, other: Interval) -> Interval {
        if self.is_empty() || other.is_empty() {
            return Interval::EMPTY;
        }
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for a in [self.low, self.high] {
            for b in [other.low, other.high] {
                let (below, above) = product(a, b);
                low = low.min(below);
                high = high.max(above);
            }
        }
        Interval { low, high, away: product(self.away, other.away).0 }.normal()
    }

    /// a / b, where b is not 0.
    pub fn divide(self, other: Interval) -> Interval {
        self.multiply(other.reciprocal())
    }

    /// 1 / a, where a is not 0.
    pub fn reciprocal(self) -> Interval {
        if self.is_empty() {
            return self;
        }
        if self.low >= 0.0 {
            Interval::closed(quotient(1.0, self.high).0.max(0.0), quotient(1.0, self.low).1)
        } else if self.high <= 0.0 {
            self.negate().reciprocal().negate()
        } else {
            let most = quotient(1.0, self.away).1;
            Interval { low: -most, high: most, away: quotient(1.0, self.size()).0.max(0.0) }.normal()
        }
    }

    /// |a|
    pub fn abs(self) -> Interval {
        if self.is_empty() { self } else { Interval { low: self.away, high: self.size(), away: self.away }.normal() }
    }

    /// a · a
    pub fn square(self) -> Interval {
        let size = self.abs();
        size.multiply(size)
    }

    /// a^n by repeated multiplication
    pub fn power(self, n: u32) -> Interval {
        if self.is_empty() {
            return self;
        }
        // It rises with a, or with |a| if n is even.
        let base = if n % 2 == 1 { self } else { self.abs() };
        // By repeated squaring, as `lower` does: another order would round differently.
        let of = |x: f64| {
            let (mut power, mut square, mut rest) = (Interval::point(1.0), Interval::closed(x, x), n);
            while rest > 0 {
                power = if rest % 2 == 1 { power.multiply(square) } else { power };
                rest /= 2;
                square = if rest > 0 { square.multiply(square) } else { square };
            }
            power
        };
        Interval { low: of(base.low).low, high: of(base.high).high, away: of(base.away).low.max(0.0) }.normal()
    }

    /// min(a, b)
    pub fn min(self, other: Interval) -> Interval {
        self.negate().max(other.negate()).negate()
    }

    /// max(a, b)
    pub fn max(self, other: Interval) -> Interval {
        if self.is_empty() || other.is_empty() {
            return Interval::EMPTY;
        }
        let (low, high) = (self.low.max(other.low), self.high.max(other.high));
        Interval { low, high, away: self.away.min(other.away) }.normal()
    }

    /// √a of the non-negative part of a.
    pub fn sqrt(self) -> Interval {
        let inside = self.and(Interval::from(0.0));
        if inside.is_empty() {
            return inside;
        }
        let [low, high] = [inside.low, inside.high].map(f64::sqrt);
        let exact = |root: f64, x: f64| root.is_infinite() || root.mul_add(root, -x) == 0.0;
        let low = if exact(low, inside.low) { low } else { low.next_down() };
        Interval::closed(low, if exact(high, inside.high) { high } else { high.next_up() })
    }

    /// The image under an increasing elementary function with values within `limits`.
    pub fn rising(self, f: impl Fn(f64) -> f64, limits: (f64, f64)) -> Interval {
        if self.is_empty() {
            return self;
        }
        let (low, high) = (f(self.low), f(self.high));
        // The relative error of a subnormal value is larger. f(x) keeps the sign that it has at the ends: a value of 0
        // there is exact or has underflowed.
        let error = |y: f64| match y.abs() {
            0.0 => 0.0,
            size if size < f64::MIN_POSITIVE => 4.0 * LEAST,
            size => ELEMENTARY * size,
        };
        let (least, most) = (low - error(low), high + error(high));
        let least = if low > 0.0 { least.max(0.0) } else { least };
        let most = if high < 0.0 { most.min(0.0) } else { most };
        Interval::closed(least.max(limits.0), most.min(limits.1))
    }

    /// Moves each end outwards by the rounding error relative to that end.
    pub fn loosened(self) -> Interval {
        if self.is_empty() {
            return self;
        }
        let (low, high) = (self.low - ELEMENTARY * self.low.abs(), self.high + ELEMENTARY * self.high.abs());
        let low = if self.low.is_infinite() { self.low } else { low };
        let high = if self.high.is_infinite() { self.high } else { high };
        Interval { low, high, away: if self.away.is_finite() { self.away * (1.0 - ELEMENTARY) } else { 0.0 } }.normal()
    }

    /// Moves both ends outwards by the rounding error relative to the greatest magnitude, for interpolated values.
    pub fn rounded(self) -> Interval {
        let slack = ELEMENTARY * self.size();
        if self.is_empty() { self } else { Interval::closed(self.low - slack, self.high + slack) }
    }
}

/// a + b, rounded down and rounded up. Knuth's two-sum yields the exact error of the rounded sum.
fn sum(a: f64, b: f64) -> (f64, f64) {
    let s = a + b;
    if planted::is("ends do not round") && s.is_finite() {
        return (s, s);
    }
    if !s.is_finite() {
        return match a.is_finite() && b.is_finite() {
            // Overflow: the result may be the greatest double or infinite.
            true if s > 0.0 => (f64::MAX, s),
            true => (s, f64::MIN),
            false if s.is_nan() => (f64::NEG_INFINITY, f64::INFINITY),
            false => (s, s),
        };
    }
    let part = s - a;
    let error = (a - (s - part)) + (b - part);
    (if error < 0.0 { s.next_down() } else { s }, if error > 0.0 { s.next_up() } else { s })
}

/// a · b, rounded down and rounded up. 0 · ∞ is 0, since an infinite end stands for arbitrarily large numbers.
fn product(a: f64, b: f64) -> (f64, f64) {
    if a == 0.0 || b == 0.0 {
        return (0.0, 0.0);
    }
    let p = a * b;
    if !p.is_finite() {
        return match a.is_finite() && b.is_finite() {
            true if p > 0.0 => (f64::MAX, p),
            true => (p, f64::MIN),
            false => (p, p),
        };
    }
    if p.abs() < 1e-280 {
        if planted::is("products are never too small") {
            let p = p.abs().max(LEAST) * a.signum() * b.signum();
            return (p, p);
        }
        // The error of the product may itself underflow. A product keeps the sign given by its factors, or is 0.
        let below = p.next_down();
        let above = p.next_up();
        return if (a > 0.0) == (b > 0.0) { (below.max(0.0), above) } else { (below, above.min(0.0)) };
    }
    let error = if planted::is("ends do not round") { 0.0 } else { a.mul_add(b, -p) };
    (if error < 0.0 { p.next_down() } else { p }, if error > 0.0 { p.next_up() } else { p })
}

/// a / b for a, b ≥ 0, rounded down and rounded up.
fn quotient(a: f64, b: f64) -> (f64, f64) {
    let q = a / b;
    if !q.is_finite() || b.is_infinite() {
        return (if q.is_finite() { q } else { f64::MAX }, q);
    }
    let exact = q.abs() > 1e-280 && q.mul_add(b, -a) == 0.0;
    if exact { (q, q) } else { (q.next_down(), q.next_up()) }
}

/// Fault injection: deliberate mistakes in the rules of proofs, by name. Tests check that each of them is detected.
#[cfg(test)]
pub(crate) mod planted {
    use std::cell::Cell;

    /// Names of all faults.
    pub const ALL: &[&str] = &[
        "products are never too small",
        "exponentials are never zero",
        "tanh never reaches 1",
        "the floor of a positive number is positive",
        "x^-n is 1/x^2",
        "zero has any power",
        "arguments are not walked",
        "beliefs are not watched",
        "or is and",
        "not is forgotten",
        "one branch only",
        "ends do not round",
        "mixtures need no order",
    ];

    thread_local! { static PLANTED: Cell<&'static str> = const { Cell::new("") } }

    /// Activates a fault in this thread; "" deactivates it.
    pub fn plant(name: &'static str) {
        assert!(name.is_empty() || ALL.contains(&name), "{name}");
        PLANTED.set(name);
    }

    /// Whether this fault is active.
    pub fn is(name: &str) -> bool {
        debug_assert!(ALL.contains(&name), "{name}");
        PLANTED.get() == name
    }
}

/// Fault injection is compiled into tests only.
#[cfg(not(test))]
pub(crate) mod planted {
    /// No fault is ever active.
    pub const fn is(_: &str) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSITIVE: Interval = Interval { low: 1e-40, high: 1e40, away: 1e-40 };
    const NOT_NEGATIVE: Interval = Interval { low: 0.0, high: 1e40, away: 0.0 };

    #[test]
    fn zero_stays_excluded_unless_a_result_underflows() {
        assert!(!POSITIVE.has_zero() && NOT_NEGATIVE.has_zero());
        assert!(!POSITIVE.multiply(POSITIVE).has_zero());
        assert!(!POSITIVE.divide(POSITIVE).has_zero());
        assert!(!POSITIVE.plus(NOT_NEGATIVE).has_zero());
        assert!(POSITIVE.multiply(NOT_NEGATIVE).has_zero());
        assert!(POSITIVE.power(9).has_zero(), "too small for a double");
        assert!(!Interval::NOT_ZERO.reciprocal().negate().abs().is_empty());
        assert!(Interval::NOT_ZERO.square().has_zero(), "too small for a double");
    }

    #[test]
    fn negative_zero_equals_zero() {
        let negative = Interval::to(-LEAST);
        assert!(negative.negate().hull(NOT_NEGATIVE).has_zero());
        assert!(negative.negate().min(NOT_NEGATIVE).has_zero());
        assert!(Interval::closed(-0.0, -0.0).hull(Interval::from(1.0)).has_zero());
    }

    #[test]
    fn operations_on_the_empty_interval_are_empty() {
        let nothing = Interval::to(-1.7).and(Interval::point(2.0));
        assert!(nothing.is_empty() && !nothing.has_zero());
        assert!(Interval::point(1.0).divide(Interval::point(1.0).plus(nothing.square())).is_empty());
        assert_eq!(nothing.hull(POSITIVE), POSITIVE);
    }

    #[test]
    fn results_span_the_values_at_the_ends() {
        let a = Interval::closed(-2.0, 3.0);
        let b = Interval::closed(-5.0, 4.0);
        let product = a.multiply(b);
        assert_eq!((product.low, product.high), (-15.0, 12.0));
        assert_eq!((a.square().low, a.square().high), (0.0, 9.0));
        assert_eq!((a.abs().low, a.abs().high), (0.0, 3.0));
        assert_eq!(a.max(b), Interval::closed(-2.0, 4.0));
        assert_eq!(a.min(b), Interval::closed(-5.0, 3.0));
    }

    /// Results of operations on numbers of two intervals lie in the interval of the result, for numbers of all
    /// magnitudes.
    #[test]
    fn results_lie_in_the_interval_of_the_result() {
        inside();
    }

    #[test]
    fn unrounded_ends_are_detected() {
        planted::plant("ends do not round");
        let found = std::panic::catch_unwind(inside);
        planted::plant("");
        assert!(found.is_err());
    }

    fn inside() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(0x1A7E);
        let mut random = crate::ir::random::Random(seed);
        let ends = [0.0, -0.0, LEAST, 1e-300, 1e-160, 1e-40, 0.1, 1.0 / 3.0, 1.0, 3.0, 7.3, 1e40, 1e160];
        let mut number = || {
            let x = ends[random.below(ends.len())] * (1.0 + random.below(5) as f64 * f64::EPSILON);
            if random.below(2) == 0 { x } else { -x }
        };
        for case in 0..200_000 {
            let mut interval = || {
                let (a, b) = (number(), number());
                let inside = if number() < 0.0 { a } else { b };
                let whole = Interval::closed(a.min(b), a.max(b));
                // Sometimes with a gap around 0.
                let whole = if number() > 1.0 { whole.and(Interval::beyond(a.abs().min(b.abs()))) } else { whole };
                (whole, inside)
            };
            let ((x, a), (y, b)) = (interval(), interval());
            let fits = |what: &str, interval: Interval, value: f64| {
                let inside = value >= interval.low && value <= interval.high && value.abs() >= interval.away;
                assert!(
                    inside || !value.is_finite(),
                    "seed {seed}, case {case}: {what} of {a:e}, {b:e} in {x:?}, {y:?}: {value:e} in {interval:?}"
                );
            };
            fits("sum", x.plus(y), a + b);
            fits("difference", x.minus(y), a - b);
            fits("product", x.multiply(y), a * b);
            fits("hull", x.hull(y), b);
            fits("least", x.min(y), a.min(b));
            fits("greatest", x.max(y), a.max(b));
            fits("size", x.abs(), a.abs());
            fits("square", x.square(), a * a);
            fits("fused", x.multiply(y).plus(x), a.mul_add(b, a));
            fits("cube", x.power(3), a * a * a);
            if b != 0.0 {
                fits("quotient", x.divide(y), a / b);
                fits("with a reciprocal", x.divide(y), a * (1.0 / b));
            }
            if a >= 0.0 {
                fits("root", x.sqrt(), a.sqrt());
            }
        }
    }
}
