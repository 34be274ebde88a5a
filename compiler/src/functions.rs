//! The functions of the language: one row each.
//!
//! Every stage reads its part of a row: names and numbers of arguments the front end, units the unit check, domains and
//! images the proofs by intervals, derivatives automatic differentiation and `slope`, latencies reassociation. What a
//! function computes is in [`math`](crate::math) for elementary functions, and in `lower` for the others.
//!
//! Knows nothing of text or of programs.

#![expect(clippy::disallowed_methods, reason = "bounds of intervals, not values of a run")]

use crate::interval::{Interval, SLACK, planted};
use std::f64::consts::PI;

/// An elementary function of one argument, a pure number; so is its value.
pub struct UnaryRow {
    /// Name in the language.
    pub name: &'static str,
    /// What it is, for people.
    pub doc: &'static str,
    /// Arguments for which it is defined.
    pub domain: Domain,
    /// The platform's function. Only bounds of intervals use it.
    pub value: fn(f64) -> f64,
    /// How the value follows the argument.
    pub shape: Shape,
    /// Least and greatest value.
    pub limits: (f64, f64),
    /// Its derivative.
    pub derivative: &'static Term,
    /// f(−x) = f(x) or f(−x) = −f(x), to the bit.
    pub symmetry: Option<Symmetry>,
    /// Approximate latency of its expansion, in cycles.
    pub latency: i32,
}

/// An elementary function of two arguments.
pub struct BinaryRow {
    /// Name in the language, and `pow` for `^`.
    pub name: &'static str,
    /// What it is, for people.
    pub doc: &'static str,
    /// Names and units of its arguments. `None`: it has an operator in place of a name.
    pub call: Option<(&'static [Argument], Units)>,
    /// Values that it takes for arguments in these intervals.
    pub image: fn(Interval, Interval) -> Interval,
    /// Its derivatives by the first and by the second argument.
    pub derivatives: [&'static Term; 2],
    /// Approximate latency of its expansion, in cycles.
    pub latency: i32,
}

/// Name and unit of an argument.
pub type Argument = (&'static str, Units);

/// How a function is called, and the units of a call.
#[derive(Clone, Copy, Debug)]
pub struct Signature {
    /// Name in the language.
    pub name: &'static str,
    /// Its arguments, in order.
    pub arguments: &'static [Argument],
    /// Unit of its value.
    pub result: Units,
    /// What it is, for people.
    pub doc: &'static str,
}

/// The unit of an argument or of a value.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Units {
    /// A pure number.
    Number,
    /// A time.
    Time,
    /// A frequency: 1 / time.
    Frequency,
    /// Any unit, the same for all arguments and values of this kind.
    Same,
    /// The unit of `Same` per time.
    SamePerTime,
    /// The square root of the unit of `Same`.
    RootOfSame,
    /// Any unit, which does not matter.
    Any,
}

/// The arguments for which a function is defined.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Domain {
    /// Least argument.
    pub low: f64,
    /// Whether `low` itself is excluded.
    pub strict: bool,
    /// Greatest argument.
    pub high: f64,
}

/// How the value of a function follows its argument.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Shape {
    /// It never falls.
    Rising,
    /// It never rises.
    Falling,
    /// It never falls with the magnitude of the argument, whose sign does not matter.
    RisingInSize,
    /// It rises and falls: its limits are all that is known.
    Other,
}

/// How f(−x) follows from f(x).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Symmetry {
    /// f(−x) = f(x)
    Even,
    /// f(−x) = −f(x)
    Odd,
}

/// A formula of a function's arguments and value.
#[derive(Debug)]
pub enum Term {
    /// The first argument.
    X,
    /// The second argument.
    Y,
    /// The value of the function.
    F,
    /// A constant.
    Number(f64),
    /// −a
    Negate(&'static Term),
    /// a + b
    Sum(&'static Term, &'static Term),
    /// a − b
    Difference(&'static Term, &'static Term),
    /// a · b
    Product(&'static Term, &'static Term),
    /// a / b
    Quotient(&'static Term, &'static Term),
    /// a · b + c, rounded once where the representation has that operation.
    Fused(&'static Term, &'static Term, &'static Term),
    /// √a
    Root(&'static Term),
    /// An elementary function of a term.
    Call(Unary, &'static Term),
    /// If a > 0 then b, else c.
    IfPositive(&'static Term, &'static Term, &'static Term),
    /// If a is this number then b, else c.
    IfEqual(&'static Term, f64, &'static Term, &'static Term),
}

use Term::*;

const ZERO: Term = Number(0.0);
const ONE: Term = Number(1.0);
/// (1 − x)(1 + x)
const ONE_LESS_SQUARE: Term = Product(&Difference(&ONE, &X), &Sum(&ONE, &X));
/// x² + y²
const SQUARES: Term = Fused(&X, &X, &Product(&Y, &Y));

const LINE: (f64, f64) = (f64::NEG_INFINITY, f64::INFINITY);

impl Domain {
    /// All numbers.
    pub const ALL: Domain = Domain { low: f64::NEG_INFINITY, strict: false, high: f64::INFINITY };
    /// Numbers ≥ 0.
    pub const NOT_NEGATIVE: Domain = Domain { low: 0.0, ..Domain::ALL };
    /// Numbers > 0.
    pub const POSITIVE: Domain = Domain::above(0.0);
    /// Numbers within −1 .. 1.
    pub const UNIT: Domain = Domain { low: -1.0, strict: false, high: 1.0 };

    /// Numbers > `low`.
    pub const fn above(low: f64) -> Domain {
        Domain { low, strict: true, high: f64::INFINITY }
    }

    /// The domain as an interval, with its ends.
    pub fn closure(self) -> Interval {
        Interval::closed(self.low, self.high)
    }

    /// Whether the function is defined for all numbers of an interval.
    pub fn holds(self, x: Interval) -> bool {
        let above = if self.strict { x.low > self.low } else { x.low >= self.low };
        x.is_empty() || above && x.high <= self.high
    }
}

/// An enum whose cases are the rows of a table.
macro_rules! table {
    (
        $(#[$attribute:meta])* $name:ident: $row:ident;
        $($(#[$doc:meta])* $case:ident { $($field:ident: $value:expr),* $(,)? })*
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
        pub enum $name { $($(#[$doc])* $case),* }

        impl $name {
            /// All of them, in the order of the table.
            pub const ALL: [$name; [$(stringify!($case)),*].len()] = [$($name::$case),*];

            /// Its row of the table.
            pub fn row(self) -> &'static $row {
                static ROWS: [$row; $name::ALL.len()] = [$($row { $($field: $value),* }),*];
                &ROWS[self as usize]
            }

            /// Its name in listings.
            pub fn name(self) -> &'static str {
                self.row().name
            }
        }
    };
}

table! {
    /// Elementary functions of one argument. `math::expand` turns them into arithmetic before any
    /// back end.
    #[allow(missing_docs)]
    Unary: UnaryRow;
    Exp {
        name: "exp", doc: "e^x", domain: Domain::ALL, value: f64::exp, shape: Shape::Rising,
        limits: (0.0, f64::INFINITY), derivative: &F, symmetry: None, latency: 36,
    }
    Expm1 {
        name: "expm1", doc: "e^x - 1, accurate for small x", domain: Domain::ALL, value: f64::exp_m1,
        shape: Shape::Rising, limits: (-1.0, f64::INFINITY), derivative: &Sum(&F, &ONE), symmetry: None, latency: 45,
    }
    Log {
        name: "log", doc: "natural logarithm", domain: Domain::POSITIVE, value: f64::ln, shape: Shape::Rising,
        limits: LINE, derivative: &Quotient(&ONE, &X), symmetry: None, latency: 45,
    }
    Log1p {
        name: "log1p", doc: "log(1 + x), accurate for small x", domain: Domain::above(-1.0), value: f64::ln_1p,
        shape: Shape::Rising, limits: LINE, derivative: &Quotient(&ONE, &Sum(&ONE, &X)), symmetry: None, latency: 45,
    }
    Sin {
        name: "sin", doc: "sine of an angle in rad", domain: Domain::ALL, value: f64::sin, shape: Shape::Other,
        limits: (-1.0, 1.0), derivative: &Call(Unary::Cos, &X), symmetry: Some(Symmetry::Odd), latency: 45,
    }
    Cos {
        name: "cos", doc: "cosine of an angle in rad", domain: Domain::ALL, value: f64::cos, shape: Shape::Other,
        limits: (-1.0, 1.0), derivative: &Negate(&Call(Unary::Sin, &X)), symmetry: Some(Symmetry::Even), latency: 45,
    }
    Tan {
        name: "tan", doc: "tangent of an angle in rad", domain: Domain::ALL, value: f64::tan, shape: Shape::Other,
        limits: LINE, derivative: &Fused(&F, &F, &ONE), symmetry: Some(Symmetry::Odd), latency: 80,
    }
    Asin {
        name: "asin", doc: "inverse sine, in rad", domain: Domain::UNIT, value: f64::asin, shape: Shape::Rising,
        limits: (-1.571, 1.571), derivative: &Quotient(&ONE, &Root(&ONE_LESS_SQUARE)),
        symmetry: Some(Symmetry::Odd), latency: 80,
    }
    Acos {
        name: "acos", doc: "inverse cosine, in rad", domain: Domain::UNIT, value: f64::acos, shape: Shape::Falling,
        limits: (0.0, 3.15), derivative: &Quotient(&Number(-1.0), &Root(&ONE_LESS_SQUARE)), symmetry: None,
        latency: 80,
    }
    Atan {
        name: "atan", doc: "inverse tangent, in rad", domain: Domain::ALL, value: f64::atan, shape: Shape::Rising,
        limits: (-1.571, 1.571), derivative: &Quotient(&ONE, &Fused(&X, &X, &ONE)), symmetry: Some(Symmetry::Odd),
        latency: 80,
    }
    Sinh {
        name: "sinh", doc: "hyperbolic sine", domain: Domain::ALL, value: f64::sinh, shape: Shape::Rising,
        limits: LINE, derivative: &Call(Unary::Cosh, &X), symmetry: Some(Symmetry::Odd), latency: 80,
    }
    Cosh {
        name: "cosh", doc: "hyperbolic cosine", domain: Domain::ALL, value: f64::cosh, shape: Shape::RisingInSize,
        limits: (1.0, f64::INFINITY), derivative: &Call(Unary::Sinh, &X), symmetry: Some(Symmetry::Even), latency: 80,
    }
    Tanh {
        name: "tanh", doc: "hyperbolic tangent", domain: Domain::ALL, value: f64::tanh, shape: Shape::Rising,
        limits: (-1.0, 1.0), derivative: &Product(&Difference(&ONE, &F), &Sum(&ONE, &F)),
        symmetry: Some(Symmetry::Odd), latency: 80,
    }
}

table! {
    /// Elementary functions of two arguments.
    #[allow(missing_docs)]
    Binary: BinaryRow;
    /// For operands y and x, in this order.
    Atan2 {
        name: "atan2", doc: "angle of the point (x, y), in rad",
        call: Some((&[("y", Units::Same), ("x", Units::Same)], Units::Number)), image: |_, _| half_turns(),
        derivatives: [&Quotient(&Y, &SQUARES), &Negate(&Quotient(&X, &SQUARES))], latency: 100,
    }
    /// d(x^y) = y x^y/x dx + x^y log x dy. The first factor is 1 for y = 1. At x = 0 it is otherwise 0, even where it
    /// would be infinite, and the second is 0, so that derivatives stay finite.
    Pow {
        name: "pow", doc: "x^y", call: None, image: power,
        derivatives: [
            &IfEqual(&Y, 1.0, &ONE, &IfEqual(&X, 0.0, &ZERO, &Product(&Y, &Quotient(&F, &X)))),
            &IfPositive(&X, &Product(&F, &Call(Unary::Log, &X)), &ZERO),
        ],
        latency: 100,
    }
    /// Its gradient is undefined at the origin; 0 is used.
    Hypot {
        name: "hypot", doc: "sqrt(x^2 + y^2) without overflow",
        call: Some((&[("x", Units::Same), ("y", Units::Same)], Units::Same)), image: hypotenuse,
        derivatives: [&IfPositive(&F, &Quotient(&X, &F), &ZERO), &IfPositive(&F, &Quotient(&Y, &F), &ZERO)],
        latency: 100,
    }
}

/// A function of the language, by the name under which texts call it.
macro_rules! builtins {
    ($($case:ident { $name:literal, [$($argument:literal: $units:ident),*] -> $result:ident, $doc:literal })*) => {
        /// Built-in functions and signals.
        #[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
        #[allow(missing_docs)]
        pub enum Builtin {
            /// An elementary function of one argument.
            Unary(Unary),
            /// An elementary function of two arguments.
            Binary(Binary),
            $($case),*
        }

        impl Builtin {
            /// All functions, in the order of the tables.
            pub fn all() -> impl Iterator<Item = Builtin> {
                let of_one = Unary::ALL.into_iter().map(Builtin::Unary);
                let of_two = Binary::ALL.into_iter().filter(|function| function.row().call.is_some());
                [$(Builtin::$case),*].into_iter().chain(of_one).chain(of_two.map(Builtin::Binary))
            }

            /// How it is called.
            pub fn signature(self) -> Signature {
                match self {
                    Builtin::Unary(function) => {
                        let UnaryRow { name, doc, .. } = *function.row();
                        Signature { name, arguments: &[("x", Units::Number)], result: Units::Number, doc }
                    }
                    Builtin::Binary(function) => {
                        let BinaryRow { name, doc, call, .. } = *function.row();
                        let (arguments, result) = call.expect("only functions with a name are called");
                        Signature { name, arguments, result, doc }
                    }
                    $(Builtin::$case => Signature {
                        name: $name,
                        arguments: &[$(($argument, Units::$units)),*],
                        result: Units::$result,
                        doc: $doc,
                    }),*
                }
            }
        }
    };
}

builtins! {
    Abs { "abs", ["x": Same] -> Same, "magnitude" }
    Sign { "sign", ["x": Any] -> Number, "-1, 0 or 1; `sign(0)` is 0" }
    Min { "min", ["a": Same, "b": Same] -> Same, "the smaller one" }
    Max { "max", ["a": Same, "b": Same] -> Same, "the larger one" }
    Clamp { "clamp", ["x": Same, "lo": Same, "hi": Same] -> Same, "x, limited to lo .. hi" }
    Floor { "floor", ["x": Number] -> Number, "the largest whole number that is at most x" }
    Sqrt { "sqrt", ["x": Same] -> RootOfSame, "square root" }
    Random { "random", ["seed": Number, "k": Number] -> Number, "uniform in [0, 1), the same on every machine" }
    Step { "step", ["t0": Time, "h": Same] -> Same, "0 before t0, then h" }
    Ramp { "ramp", ["t0": Time, "y0": Same, "slope": SamePerTime] -> Same, "y0 before t0, then rising by slope" }
    Pulse { "pulse", ["t0": Time, "width": Time, "h": Same] -> Same, "h from t0 for width, else 0" }
    Sine { "sine", ["A": Same, "f": Frequency] -> Same, "A sin(2 pi f t)" }
    Square { "square", ["A": Same, "f": Frequency] -> Same, "A in the first half of each period, then -A" }
    Chirp { "chirp", ["A": Same, "f0": Frequency, "f1": Frequency, "T": Time] -> Same, "a sine from f0 to f1 within T" }
    Noise { "noise", ["A": Same, "T": Time, "seed": Number] -> Same, "uniform in -A .. A, a new value every T" }
    Delay { "delay", ["x": Same, "T": Time] -> Same, "the value of x T ago" }
}

impl Builtin {
    /// The function of this name.
    pub fn named(name: &str) -> Option<Builtin> {
        Builtin::all().find(|builtin| builtin.name() == name)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        self.signature().name
    }

    /// The argument that must lie in a domain, by its index, and the domain.
    pub fn domain(self) -> Option<(usize, Domain)> {
        match self {
            Builtin::Unary(function) => Some((0, function.row().domain)),
            Builtin::Sqrt => Some((0, Domain::NOT_NEGATIVE)),
            // The sweep time of a chirp, and the time for which noise keeps a value.
            Builtin::Chirp => Some((3, Domain::POSITIVE)),
            Builtin::Noise => Some((1, Domain::POSITIVE)),
            Builtin::Binary(_)
            | Builtin::Abs
            | Builtin::Sign
            | Builtin::Min
            | Builtin::Max
            | Builtin::Clamp
            | Builtin::Floor
            | Builtin::Random
            | Builtin::Step
            | Builtin::Ramp
            | Builtin::Pulse
            | Builtin::Sine
            | Builtin::Square
            | Builtin::Delay => None,
        }
    }
}

impl std::fmt::Display for Signature {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let arguments: Vec<&str> = self.arguments.iter().map(|(name, _)| *name).collect();
        write!(f, "{}({})", self.name, arguments.join(", "))
    }
}

impl Unary {
    /// The values that the function takes for arguments in an interval and in its domain.
    pub fn image(self, x: Interval) -> Interval {
        let UnaryRow { domain, value, shape, limits, .. } = *self.row();
        let x = x.and(domain.closure());
        let limits = match self {
            Unary::Exp if planted::is("exponentials are never zero") => (f64::from_bits(1), limits.1),
            Unary::Tanh if planted::is("tanh never reaches 1") => ((-1.0_f64).next_up(), 1.0_f64.next_down()),
            _ => limits,
        };
        match shape {
            _ if x.is_empty() => x,
            Shape::Rising => {
                let image = x.rising(value, limits);
                // The values 0 and 1 at 0 are exact, so no rounding crosses them.
                match value(0.0) {
                    exact if exact != 0.0 && exact != 1.0 => image,
                    exact if x.low >= 0.0 => image.and(Interval::from(exact)),
                    exact if x.high <= 0.0 => image.and(Interval::to(exact)),
                    _ => image,
                }
            }
            Shape::Falling => x.negate().rising(|x| value(-x), limits),
            Shape::RisingInSize => x.abs().rising(value, limits),
            Shape::Other => Interval::closed(limits.0, limits.1),
        }
    }
}

/// −π .. π
fn half_turns() -> Interval {
    let half_turn = PI.next_up();
    Interval::closed(-half_turn, half_turn)
}

fn hypotenuse(x: Interval, y: Interval) -> Interval {
    let least = x.away.max(y.away) * (1.0 - SLACK);
    Interval::from(least).and(Interval::to((x.size() + y.size()) * (1.0 + SLACK)))
}

/// x^n for x ≥ 0 and any n. It is monotonic in each argument, so its values at the corners bound it.
fn power(x: Interval, n: Interval) -> Interval {
    if x.is_empty() || n.is_empty() {
        return Interval::EMPTY;
    }
    if !x.is_not_negative() || n.low.is_infinite() || n.high.is_infinite() {
        return if x.is_not_negative() { Interval::from(0.0) } else { Interval::ALL };
    }
    let mut corners = Vec::new();
    for x in [x.low, x.high] {
        for n in [n.low, n.high] {
            corners.push(x.powf(n));
        }
    }
    let low = corners.iter().copied().fold(f64::INFINITY, f64::min);
    let high = corners.iter().copied().fold(0.0, f64::max);
    // The error of the logarithm grows with the exponent. The smallest results are rounded to 0.
    let low = if low < 1e-300 { 0.0 } else { low * (1.0 - 1e-12) };
    let high = high * (1.0 + 1e-12);
    // 1 is exact: powers of x ≤ 1 with n ≥ 0 do not exceed it.
    let high = if x.high <= 1.0 && n.low >= 0.0 { high.min(1.0) } else { high };
    Interval::closed(low, high)
}

/// x^(1/n) for x ≥ 0, for bounds.
pub fn root(x: f64, n: u32) -> f64 {
    x.powf(1.0 / f64::from(n))
}
