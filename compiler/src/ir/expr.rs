//! Operator overloading on a [`Build`], so that code reads as a formula: `let r = k.fma(-LN2_HIGH, x)`.
//!
//! A [`Real`], [`Int`] or [`Truth`] is a value together with its builder. Operators append operations to the builder. A
//! constant may be used in place of a value.

use super::build::Build;
use super::{Unary, Value};
use std::cell::RefCell;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Shl, Shr, Sub};

/// A builder that several values share.
pub type Shared = RefCell<Build>;

macro_rules! handle {
    ($(#[$doc:meta])* $name:ident, $constant:ty, $make:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub struct $name<'a> {
            build: &'a Shared,
            /// The value in the builder.
            pub value: Value,
        }

        impl<'a> $name<'a> {
            /// Wraps a value of this builder.
            pub fn new(build: &'a Shared, value: Value) -> $name<'a> {
                $name { build, value }
            }

            fn with(self, make: impl FnOnce(&mut Build) -> Value) -> $name<'a> {
                $name { value: make(&mut self.build.borrow_mut()), ..self }
            }
        }

        impl<'a> From<($constant, &'a Shared)> for $name<'a> {
            fn from((constant, build): ($constant, &'a Shared)) -> $name<'a> {
                let value = build.borrow_mut().$make(constant);
                $name { build, value }
            }
        }

        impl<'a> From<($name<'a>, &'a Shared)> for $name<'a> {
            fn from((value, _): ($name<'a>, &'a Shared)) -> $name<'a> {
                value
            }
        }
    };
}

handle! {
    /// A 64-bit float.
    Real, f64, real
}
handle! {
    /// A 64-bit integer that wraps.
    Int, i64, int
}
handle! {
    /// A Boolean.
    Truth, bool, truth
}

macro_rules! operator {
    ($name:ident $constant:ty, $($operator:ident $method:ident $make:ident),*) => {
        $(
            impl<'a, T> $operator<T> for $name<'a>
            where
                $name<'a>: From<(T, &'a Shared)>,
            {
                type Output = $name<'a>;
                fn $method(self, other: T) -> $name<'a> {
                    let other = $name::from((other, self.build));
                    self.with(|b| b.$make(self.value, other.value))
                }
            }

            impl<'a> $operator<$name<'a>> for $constant {
                type Output = $name<'a>;
                fn $method(self, other: $name<'a>) -> $name<'a> {
                    $operator::$method($name::from((self, other.build)), other)
                }
            }
        )*
    };
}

operator!(Real f64, Add add add, Sub sub sub, Mul mul mul, Div div div);
operator!(Int i64, Add add int_add, Sub sub int_sub, BitAnd bitand int_and, BitOr bitor int_or);
operator!(Truth bool, BitAnd bitand and, BitOr bitor or);

impl<'a> Neg for Real<'a> {
    type Output = Real<'a>;
    fn neg(self) -> Real<'a> {
        self.with(|b| b.neg(self.value))
    }
}

impl<'a> std::ops::Not for Truth<'a> {
    type Output = Truth<'a>;
    fn not(self) -> Truth<'a> {
        self.with(|b| b.not(self.value))
    }
}

impl<'a> Shl<u8> for Int<'a> {
    type Output = Int<'a>;
    fn shl(self, n: u8) -> Int<'a> {
        self.with(|b| b.shift_left(self.value, n))
    }
}

/// Arithmetic shift.
impl<'a> Shr<u8> for Int<'a> {
    type Output = Int<'a>;
    fn shr(self, n: u8) -> Int<'a> {
        self.with(|b| b.shift_right_signed(self.value, n))
    }
}

impl<'a> Real<'a> {
    fn other<T>(self, other: T) -> Value
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        Real::from((other, self.build)).value
    }

    fn truth(self, make: impl FnOnce(&mut Build) -> Value) -> Truth<'a> {
        Truth { value: make(&mut self.build.borrow_mut()), build: self.build }
    }

    /// A constant in the same builder.
    pub fn constant(self, x: f64) -> Real<'a> {
        Real::from((x, self.build))
    }

    /// Wraps another value of the same builder.
    pub fn same(self, value: Value) -> Real<'a> {
        Real { value, build: self.build }
    }

    /// An elementary function of this value.
    pub fn of(self, function: Unary) -> Real<'a> {
        self.with(|b| b.unary(function, self.value))
    }

    /// self · b + c, rounded once.
    pub fn fma<B, C>(self, b: B, c: C) -> Real<'a>
    where
        Real<'a>: From<(B, &'a Shared)> + From<(C, &'a Shared)>,
    {
        let (x, y) = (self.other(b), self.other(c));
        self.with(|b| b.fma(self.value, x, y))
    }

    /// |self|
    pub fn abs(self) -> Real<'a> {
        self.with(|b| b.abs(self.value))
    }

    /// √self
    pub fn sqrt(self) -> Real<'a> {
        self.with(|b| b.sqrt(self.value))
    }

    /// ⌊self⌋: the largest integer that is at most self.
    pub fn floor(self) -> Real<'a> {
        self.with(|b| b.floor(self.value))
    }

    /// The nearest integer, ties to even.
    pub fn nearest(self) -> Real<'a> {
        self.with(|b| b.nearest(self.value))
    }

    /// self < other; false if either is NaN.
    pub fn below<T>(self, other: T) -> Truth<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let other = self.other(other);
        self.truth(|b| b.less(self.value, other))
    }

    /// self > other; false if either is NaN.
    pub fn above<T>(self, other: T) -> Truth<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let other = self.other(other);
        self.truth(|b| b.less(other, self.value))
    }

    /// self ≤ other; false if either is NaN.
    pub fn not_above<T>(self, other: T) -> Truth<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let other = self.other(other);
        self.truth(|b| b.less_equal(self.value, other))
    }

    /// self ≥ other; false if either is NaN.
    pub fn not_below<T>(self, other: T) -> Truth<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let other = self.other(other);
        self.truth(|b| b.less_equal(other, self.value))
    }

    /// Whether the value is neither infinite nor NaN.
    pub fn finite(self) -> Truth<'a> {
        self.truth(|b| b.finite(self.value))
    }

    /// self = other, where −0 = 0; false if either is NaN.
    pub fn is<T>(self, other: T) -> Truth<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let other = self.other(other);
        self.truth(|b| b.equal(self.value, other))
    }

    /// The bits as an integer.
    pub fn bits(self) -> Int<'a> {
        Int { value: self.build.borrow_mut().to_bits(self.value), build: self.build }
    }

    /// max(self, limit); NaN stays NaN.
    pub fn at_least(self, limit: f64) -> Real<'a> {
        let limit = self.constant(limit);
        self.with(|b| b.max(limit.value, self.value))
    }

    /// min(self, limit); NaN stays NaN.
    pub fn at_most<T>(self, limit: T) -> Real<'a>
    where
        Real<'a>: From<(T, &'a Shared)>,
    {
        let limit = self.other(limit);
        self.with(|b| b.min(limit, self.value))
    }

    /// Copies the sign of `of` (also of a zero) to this value, which must not be negative.
    pub fn with_sign(self, of: Real<'a>) -> Real<'a> {
        (self.bits() | (of.bits() & i64::MIN)).real_of_bits()
    }
}

impl<'a> Int<'a> {
    /// The real with these bits.
    pub fn real_of_bits(self) -> Real<'a> {
        Real { value: self.build.borrow_mut().from_bits(self.value), build: self.build }
    }

    /// The nearest real.
    pub fn real(self) -> Real<'a> {
        Real { value: self.build.borrow_mut().to_real(self.value), build: self.build }
    }

    /// This entry of the table of `len` numbers at `base` in the pool.
    pub fn entry(self, base: u32, len: u32) -> Real<'a> {
        Real { value: self.build.borrow_mut().pool(base, len, self.value), build: self.build }
    }

    /// Logical shift right.
    pub fn shift_right(self, n: u8) -> Int<'a> {
        self.with(|b| b.shift_right(self.value, n))
    }

    /// self < other, signed.
    pub fn below(self, other: i64) -> Truth<'a> {
        let other = Int::from((other, self.build));
        Truth { value: self.build.borrow_mut().int_less(self.value, other.value), build: self.build }
    }

    /// self = other
    pub fn is(self, other: i64) -> Truth<'a> {
        let other = Int::from((other, self.build));
        Truth { value: self.build.borrow_mut().int_equal(self.value, other.value), build: self.build }
    }
}

impl<'a> Truth<'a> {
    /// If true then a, else b: reals.
    pub fn choose<A, B>(self, a: A, b: B) -> Real<'a>
    where
        Real<'a>: From<(A, &'a Shared)> + From<(B, &'a Shared)>,
    {
        let (a, b) = (Real::from((a, self.build)), Real::from((b, self.build)));
        Real { value: self.build.borrow_mut().select(self.value, a.value, b.value), build: self.build }
    }

    /// If true then a, else b: integers.
    pub fn choose_int<A, B>(self, a: A, b: B) -> Int<'a>
    where
        Int<'a>: From<(A, &'a Shared)> + From<(B, &'a Shared)>,
    {
        let (a, b) = (Int::from((a, self.build)), Int::from((b, self.build)));
        Int { value: self.build.borrow_mut().select(self.value, a.value, b.value), build: self.build }
    }
}
