//! Parses and formats numbers with units.

use abi::unit::Unit;

/// Parses `10us`, `2 N`, `1e-3`; returns the value in SI and the unit as written.
///
/// # Errors
/// What is wrong with it, in words.
pub fn parse(text: &str) -> Result<(f64, Unit), String> {
    let (number, unit) = abi::unit::quantity(text).map_err(|why| why.to_string())?;
    Ok((si(number, &unit), unit))
}

/// The value in SI of a number in a unit.
pub fn si(value: f64, unit: &Unit) -> f64 {
    // 1e-6 is not representable, 1e6 is: dividing gives the double nearest to the decimal as written.
    if unit.scale < 1.0 { value / (1.0 / unit.scale) } else { value * unit.scale }
}

/// A value in SI, shown in a unit with this many significant digits: `3.30679 m`.
pub fn show(si: f64, unit: &Unit, digits: usize) -> String {
    let number = significant(unit.from_si(si), digits);
    if unit.text.is_empty() { number } else { format!("{number} {unit}") }
}

/// A value in SI with its error, in a unit: `6.36281(2) s`, where the number in parentheses is the error of the last
/// digit, rounded up; `0.3 ± 0.5 mm` where the error leaves fewer than two digits. At most `digits` significant digits;
/// if that limits them, the last one may be off by one.
pub fn uncertain(si: f64, error: f64, unit: &Unit, digits: usize) -> String {
    let (value, error) = (unit.from_si(si), (error * (unit.from_si(1.0) - unit.from_si(0.0))).abs());
    let unit = if unit.text.is_empty() { String::new() } else { format!(" {unit}") };
    if error == 0.0 || !value.is_finite() {
        return format!("{}{unit}", significant(value, digits));
    }
    if !error.is_finite() {
        return format!("{}{unit} ± unknown", significant(value, 6));
    }
    let exponent = |x: f64, digits: usize| {
        let text = format!("{x:.*e}", digits);
        text.split_once('e').and_then(|(_, exponent)| exponent.parse::<i32>().ok()).unwrap_or(0)
    };
    // The error as one digit times 10^last, rounded up.
    let mut last = exponent(error, 17);
    let mut digit = scaled(error, -last).ceil();
    if digit > 9.0 {
        (digit, last) = (1.0, last + 1);
    }
    let first = if value == 0.0 { last } else { exponent(value, 17) };
    let kept = first - digits.max(1) as i32 + 1;
    if last < kept {
        (digit, last) = (1.0, kept);
    }
    let plain = |x: f64, last: i32| format!("{x:.*}", (-last).max(0) as usize);
    if value == 0.0 || first < last + 1 {
        let rounded = scaled(scaled(value, -last).round(), last);
        return match last {
            -4..=8 => format!("{} ± {}{unit}", plain(rounded + 0.0, last), plain(scaled(digit, last), last)),
            _ => format!("{} ± {}{unit}", significant(rounded + 0.0, 2), significant(scaled(digit, last), 1)),
        };
    }
    match first {
        -3..=8 => {
            let rounded = if last > 0 { scaled(scaled(value, -last).round(), last) } else { value };
            let doubt = if last > 0 { scaled(digit, last) } else { digit };
            format!("{}({doubt}){unit}", plain(rounded, last))
        }
        _ => {
            let text = format!("{value:.*e}", (first - last) as usize);
            let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
            format!("{mantissa}({digit})e{exponent}{unit}")
        }
    }
}

/// x · 10^exponent, using the double nearest to that power or to its inverse.
fn scaled(x: f64, exponent: i32) -> f64 {
    let power: f64 = format!("1e{}", exponent.abs()).parse().unwrap_or(f64::INFINITY);
    if exponent < 0 { x / power } else { x * power }
}

/// A number rounded to this many significant digits, without trailing zeros.
pub fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.abs().to_string().replacen("inf", if value < 0.0 { "-inf" } else { "inf" }, 1);
    }
    let rounded: f64 = format!("{value:.*e}", digits.max(1) - 1).parse().unwrap_or(value);
    if (1e-3..1e9).contains(&rounded.abs()) { rounded.to_string() } else { format!("{rounded:e}") }
}

/// A duration with three digits in a suitable unit: `3.1 ms`, `12.5 s`.
pub fn duration(seconds: f64) -> String {
    let (scale, unit) = match seconds {
        s if s < 1e-3 => (1e6, "µs"),
        s if s < 1.0 => (1e3, "ms"),
        s if s < 600.0 => (1.0, "s"),
        _ => (1.0 / 60.0, "min"),
    };
    format!("{} {unit}", significant(seconds * scale, 3))
}

/// A count with thousands separators: `4,000,000`.
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
    fn an_error_follows_the_digits_it_belongs_to() {
        let shown = |value: f64, error: f64| uncertain(value, error, &Unit::none(), 9);
        assert_eq!(shown(6.362812, 1.2e-5), "6.36281(2)");
        assert_eq!(shown(6.362812, 1e-5), "6.36281(1)");
        assert_eq!(shown(6.362812, 9.7e-6), "6.36281(1)");
        assert_eq!(shown(-0.0012345, 2.1e-7), "-0.0012345(3)");
        assert_eq!(shown(0.4, 3e-12), "0.400000000(1)");
        assert_eq!(shown(1.5, 0.0), "1.5");
        assert_eq!(shown(12345.0, 120.0), "12300(200)");
        assert_eq!(shown(1.23456789e-7, 4e-12), "1.23457(4)e-7");
        assert_eq!(shown(0.0003, 0.0005), "0.0003 ± 0.0005");
        assert_eq!(shown(0.0, 2.5e-9), "0 ± 3e-9");
        assert_eq!(shown(3.0, 1.0), "3 ± 1");
        assert_eq!(shown(-1e-20, 1e-7), "0 ± 1e-7");
        assert_eq!(shown(f64::INFINITY, f64::INFINITY), "inf");
        assert_eq!(shown(2.0, f64::INFINITY), "2 ± unknown");
        let millimetre = Unit::parse("mm").unwrap();
        assert_eq!(uncertain(0.0123456, 1.1e-6, &millimetre, 9), "12.346(2) mm");
        assert_eq!(uncertain(1.0 / 3.0, 1e-13, &Unit::none(), 12), "0.333333333333(1)");
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
