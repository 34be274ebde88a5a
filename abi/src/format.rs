//! Numbers for people. All messages, tables and reports print their numbers with this module, so that one number looks
//! alike everywhere.
//!
//! A number has a few significant digits and no trailing zeros. It has an exponent below 1e-4, and where more than
//! three zeros would follow its digits: `0.000123`, `1.23e-5`; with three digits `123000` and `1.23e6`.

use crate::unit::Unit;

/// A number rounded to this many significant digits: `0.00123`, `1.23e-9`. −0 is 0.
pub fn significant(value: f64, digits: usize) -> String {
    let digits = digits.max(1);
    if value == 0.0 || !value.is_finite() {
        return (value + 0.0).to_string();
    }
    let (mantissa, exponent) = decimal(value, digits);
    let (mantissa, zeros) = (mantissa.trim_end_matches('0').trim_end_matches('.'), digits as i32 + 3);
    match (-4..zeros).contains(&exponent) {
        // The shortest decimal of the rounded number has its digits and no more.
        true => format!("{mantissa}e{exponent}").parse::<f64>().unwrap_or(value).to_string(),
        false => format!("{mantissa}e{exponent}"),
    }
}

/// Mantissa with this many digits, and the exponent of 10.
fn decimal(value: f64, digits: usize) -> (String, i32) {
    let text = format!("{value:.*e}", digits - 1);
    let (mantissa, exponent) = text.split_once('e').expect("scientific form has an exponent");
    (mantissa.into(), exponent.parse().expect("an exponent is a whole number"))
}

/// A number with three digits.
pub fn three_digits(value: f64) -> String {
    significant(value, 3)
}

/// A value in SI, shown in a unit with this many digits: `3.30679 m`.
pub fn quantity(si: f64, unit: &Unit, digits: usize) -> String {
    with_unit(significant(unit.from_si(si), digits), unit)
}

fn with_unit(number: String, unit: &Unit) -> String {
    if unit.text.is_empty() { number } else { format!("{number} {unit}") }
}

/// An instant in s with seven digits, enough to distinguish neighbouring steps: `12.3401 s`.
pub fn time(seconds: f64) -> String {
    format!("{} s", significant(seconds, 7))
}

/// A duration in s, in a unit of suitable size: `3.1 ms`, `12.5 s`.
pub fn duration(seconds: f64, digits: usize) -> String {
    const UNITS: [(f64, &str); 5] = [(60.0, "min"), (1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")];
    // 999.6 µs with three digits is 1 ms.
    let fits = |(scale, _): &(f64, &str)| seconds.abs() >= 0.9995 * scale * if *scale > 1.0 { 10.0 } else { 1.0 };
    let (scale, unit) = match seconds == 0.0 || !seconds.is_finite() {
        true => UNITS[1],
        false => UNITS.into_iter().find(fits).unwrap_or(UNITS[4]),
    };
    format!("{} {unit}", significant(seconds / scale, digits))
}

/// A unit with a prefix that suits a magnitude in SI, and its scale: mN for 0.05 N. Units that have no prefix stay as
/// they are.
pub fn prefixed(base: &str, size: f64) -> (Unit, f64) {
    const PREFIXES: [(&str, f64); 6] = [("G", 1e9), ("M", 1e6), ("k", 1e3), ("", 1.0), ("m", 1e-3), ("u", 1e-6)];
    let plain = || (Unit::parse(base).unwrap_or_else(|_| Unit::none()), 1.0);
    if base.is_empty() || base == "Hz" || base.starts_with("kg") || size == 0.0 || !size.is_finite() {
        return plain();
    }
    if (0.1..1e4).contains(&size) || base == "s" && size >= 0.1 {
        return plain();
    }
    // Slightly below the next prefix: 0.997 mm rather than 997 µm.
    let fitting = PREFIXES.into_iter().find(|(_, scale)| size >= 0.9 * scale).unwrap_or(("n", 1e-9));
    match Unit::parse(&format!("{}{base}", fitting.0)) {
        Ok(unit) => (unit, fitting.1),
        Err(_) => plain(),
    }
}

/// A count with thousands separators: `4,000,000`.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().map(|group| std::str::from_utf8(group).unwrap_or_default()).collect();
    groups.join(",")
}

/// The shortest decimal that parses to the same number, with an exponent where that is far shorter: for files.
pub fn plain(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude == 0.0 || !magnitude.is_finite() {
        return value.to_string();
    }
    let mut buffer = zmij::Buffer::new();
    let text = buffer.format_finite(value);
    let has_exponent = !(1e-4..1e15).contains(&magnitude);
    // The library begins exponents elsewhere, and writes the sign of positive ones.
    if text.contains('e') == has_exponent && !text.contains('+') {
        text.strip_suffix(".0").unwrap_or(text).into()
    } else if has_exponent {
        format!("{value:e}")
    } else {
        value.to_string()
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_digits_asked_for() {
        assert_eq!([0.00123, 0.000123, 1.23e-5].map(three_digits), ["0.00123", "0.000123", "1.23e-5"]);
        assert_eq!([123_456.0, 999_499.0, 999_500.0, -2e7].map(three_digits), ["123000", "999000", "1e6", "-2e7"]);
        assert_eq!([9.996, 100.0, 0.1 + 0.2, 1e22].map(three_digits), ["10", "100", "0.3", "1e22"]);
        assert_eq!([-0.0, f64::NAN, f64::NEG_INFINITY].map(three_digits), ["0", "NaN", "-inf"]);
        assert_eq!([28e3, 99e3, 1e5].map(|x| significant(x, 2)), ["28000", "99000", "1e5"]);
        assert_eq!(quantity(3.306792, &Unit::parse("m").unwrap(), 6), "3.30679 m");
        assert_eq!(quantity(0.012345, &Unit::parse("mm").unwrap(), 3), "12.3 mm");
        assert_eq!(quantity(f64::NEG_INFINITY, &Unit::parse("N").unwrap(), 3), "-inf N");
        assert_eq!(time(6.362720049), "6.36272 s");
        assert_eq!((count(4_000_000), count(12)), ("4,000,000".into(), "12".into()));
    }

    /// A printed number lies within half a unit of its last digit, has no digit more, and prints to itself.
    #[test]
    fn printed_numbers_are_rounded_once() {
        let mut state = 0x5EED_u64;
        for case in 0..20_000 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let value = f64::from_bits(state.rotate_left(17));
            let digits = 1 + case % 9;
            if !value.is_finite() {
                continue;
            }
            let text = significant(value, digits);
            let read: f64 = text.parse().unwrap();
            if read.is_infinite() {
                continue; // Rounded beyond the largest double.
            }
            let last = format!("1e{}", decimal(value, digits).1 - digits as i32 + 1).parse::<f64>().unwrap();
            assert!((read - value).abs() <= 0.500_001 * last, "case {case}: {value:e} prints as {text}");
            assert_eq!(significant(read, digits), text, "case {case}");
            let mantissa = text.split('e').next().unwrap().trim_start_matches(['-', '0', '.']);
            let shown = mantissa.chars().filter(char::is_ascii_digit).collect::<String>();
            assert!(shown.trim_end_matches('0').len() <= digits, "case {case}: {text} has more than {digits} digits");
        }
    }

    #[test]
    fn durations_have_a_unit_of_suitable_size() {
        let texts = [0.0031, 0.0, 5e-7, 9.996e-4, 12.5, 599.0, 900.0, -2e-3].map(|seconds| duration(seconds, 3));
        assert_eq!(texts, ["3.1 ms", "0 s", "500 ns", "1 ms", "12.5 s", "599 s", "15 min", "-2 ms"]);
        assert_eq!(duration(2.785e-6, 2), "2.8 µs");
    }

    #[test]
    fn plain_numbers_read_back_to_the_bit() {
        for value in [0.1, 1.0 / 3.0, 1e-300, -2.5e17, 123456.789, f64::MIN_POSITIVE, 1e-5, -0.0] {
            assert_eq!(plain(value).parse::<f64>().unwrap().to_bits(), value.to_bits());
        }
        assert_eq!(plain(1e-5), "1e-5");
    }

    /// The digits come from another library. It must change neither their number nor where exponents begin; where two
    /// decimals of that length are equally near, it takes the even one. A mutant with its limits for exponents fails.
    #[test]
    fn plain_numbers_have_the_form_of_the_standard_library() {
        let mut state = 1;
        for case in 0..400_000 {
            let bits = crate::random::next(&mut state);
            // All bits, or numbers of usual size with few digits.
            let value = match case % 2 {
                0 => f64::from_bits(bits),
                _ => format!("{}e{}", (bits >> 44) as i64 - 500_000, (bits % 29) as i32 - 20).parse().unwrap(),
            };
            let is_short = value == 0.0 || !value.is_finite() || (1e-4..1e15).contains(&value.abs());
            let (found, expected) = (plain(value), if is_short { value.to_string() } else { format!("{value:e}") });
            let is_as_long = found.len() == expected.len();
            let reads_back = found.parse::<f64>().is_ok_and(|read| read == value);
            assert!(found == expected || is_as_long && reads_back, "case {case}: {found}, not {expected}");
        }
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
}
