//! Numbers with units: as typed on a command line, and as shown.

use abi::unit::Unit;

/// Reads `10us`, `2 N`, `1e-3`; gives the value in SI and the unit as written.
///
/// # Errors
/// What is wrong with it, in words.
pub fn parse(text: &str) -> Result<(f64, Unit), String> {
    let (number, unit) = abi::unit::quantity(text).map_err(|why| why.to_string())?;
    Ok((si(number, &unit), unit))
}

/// The value in SI of a number in a unit.
pub fn si(value: f64, unit: &Unit) -> f64 {
    // 1e-6 is no double, 1e6 is: dividing gives the double nearest to what was written.
    if unit.scale < 1.0 { value / (1.0 / unit.scale) } else { value * unit.scale }
}

/// A value in SI, shown in a unit with so many significant digits: `3.30679 m`.
pub fn show(si: f64, unit: &Unit, digits: usize) -> String {
    let number = significant(unit.from_si(si), digits);
    if unit.text.is_empty() { number } else { format!("{number} {unit}") }
}

/// A number rounded to so many significant digits, without trailing zeros.
pub fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.abs().to_string().replacen("inf", if value < 0.0 { "-inf" } else { "inf" }, 1);
    }
    let rounded: f64 = format!("{value:.*e}", digits.max(1) - 1).parse().unwrap_or(value);
    if (1e-3..1e9).contains(&rounded.abs()) { rounded.to_string() } else { format!("{rounded:e}") }
}

/// A duration with three digits in the unit that suits: `3.1 ms`, `12.5 s`.
pub fn duration(seconds: f64) -> String {
    let (scale, unit) = match seconds {
        s if s < 1e-3 => (1e6, "µs"),
        s if s < 1.0 => (1e3, "ms"),
        s if s < 600.0 => (1.0, "s"),
        _ => (1.0 / 60.0, "min"),
    };
    format!("{} {unit}", significant(seconds * scale, 3))
}

/// A count with its thousands set apart: `4,000,000`.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().map(|group| std::str::from_utf8(group).unwrap_or_default()).collect();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_with_units_are_read() {
        let read = |text: &str| parse(text).map(|(value, unit)| (value, unit.text));
        assert_eq!(read("10us"), Ok((1e-5, "µs".into())));
        assert_eq!(read("20us"), Ok((2e-5, "µs".into())));
        assert_eq!(read("2 N"), Ok((2.0, "N".into())));
        assert_eq!(read("-1e-3"), Ok((-1e-3, String::new())));
        assert_eq!(read("5."), Ok((5.0, String::new())));
        assert_eq!(read("1.5mm/s").map(|(_, unit)| unit), Ok("mm/s".into()));
        assert_eq!(read("2furlong").unwrap_err(), "`furlong` is not a known unit");
        assert_eq!(read("N").unwrap_err(), "`N` does not begin with a number");
        assert!(read("").is_err() && read("inf").is_err() && read("é").is_err());
    }

    #[test]
    fn numbers_are_shown_with_the_digits_asked_for() {
        assert_eq!(show(3.306792, &Unit::parse("m").unwrap(), 6), "3.30679 m");
        assert_eq!(show(-0.0, &Unit::none(), 3), "0");
        assert_eq!(show(f64::NEG_INFINITY, &Unit::parse("N").unwrap(), 3), "-inf N");
        assert_eq!(show(f64::NAN, &Unit::none(), 3), "NaN");
        assert_eq!(significant(1.234e-9, 3), "1.23e-9");
        assert_eq!(duration(0.0031), "3.1 ms");
        assert_eq!(duration(0.0), "0 µs");
        assert_eq!(count(4_000_000), "4,000,000");
        assert_eq!(count(12), "12");
    }
}
