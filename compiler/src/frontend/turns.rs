//! What the numbers in a unit count: angles, or revolutions and periods.
//!
//! In: a unit. Out: what it counts, and the warning about a bare number where it is declared. In SI all of them are
//! pure numbers or 1/s, so dimensions do not tell them apart.

use abi::format::three_digits;
use abi::unit::{Angle, Dimension, Unit};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

const RATE: Dimension = Dimension::of([0, 0, -1, 0, 0]);

/// What a quantity counts.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Counts {
    /// Something else, or not certain.
    Unknown,
    /// Revolutions or periods: a rate times a time.
    Turns,
    /// Revolutions or periods per second, in Hz.
    Rate,
    /// An angle.
    Angle,
    /// An angle per second: rad/s, deg/s, rpm.
    Speed,
}

/// What numbers in a unit count.
pub fn counted(unit: &Unit) -> Counts {
    match (unit.angle, unit.dimension) {
        (Angle::Cycles, RATE) => Counts::Rate,
        (Angle::Angle, RATE) => Counts::Speed,
        (Angle::Angle, Dimension::NONE) if !unit.text.contains(['/', '^', '·']) => Counts::Angle,
        _ => Counts::Unknown,
    }
}

/// Whether a unit is one of angle other than the radian, in which a bare number is: deg, rev, mrad.
pub fn scaled(unit: &Unit) -> bool {
    counted(unit) == Counts::Angle && unit.scale != 1.0
}

/// Whether one of two units counts revolutions per second and the other an angle per second: 2π apart, equal in SI.
pub fn apart(a: &Unit, b: &Unit) -> bool {
    matches!((counted(a), counted(b)), (Counts::Rate, Counts::Speed) | (Counts::Speed, Counts::Rate))
}

/// W0107 for a bare number, given by its text, its value and its place, where an angle is declared in another unit than
/// the radian.
pub fn bare_angle((text, value, place): (&str, f64, Span), unit: &Unit, declared: Span) -> Diagnostic {
    let shown = three_digits(unit.from_si(value));
    Diagnostic::warning("W0107", format!("`{text}` is {text} rad here, which is {shown} {unit}"))
        .label(place, "a pure number: an angle in rad")
        .label(declared, format!("in {unit}"))
        .help(format!("write `{text} {unit}`, or `{text} rad` if that is what you mean"))
}
