//! Numbers as people read them in messages: three digits and a unit.

use abi::unit::Unit;

/// A value in SI, shown in `unit` with three digits: `1.63 N`, `-0.0125`, `3.46e-8 m/s`.
pub fn quantity(si: f64, unit: &Unit) -> String {
    let number = digits(unit.from_si(si), 3);
    if unit.text.is_empty() { number } else { format!("{number} {unit}") }
}

/// A time in s with seven digits, so that neighbouring steps can be told apart: `12.3401 s`.
pub fn time(seconds: f64) -> String {
    format!("{} s", digits(seconds, 7))
}

/// A number rounded to so many significant digits, without trailing zeros.
fn digits(value: f64, significant: usize) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let rounded: f64 = format!("{value:.*e}", significant - 1).parse().expect("a printed number reads back");
    plain(rounded)
}

/// The shortest decimal that reads back as the same number, with an exponent where that is far shorter.
pub fn plain(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude == 0.0 || (1e-4..1e15).contains(&magnitude) || !magnitude.is_finite() {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_and_a_unit() {
        let mm = Unit::parse("mm").unwrap();
        assert_eq!(quantity(0.012345, &mm), "12.3 mm");
        assert_eq!(quantity(-1.0 / 3.0, &Unit::none()), "-0.333");
        assert_eq!(quantity(3.4567e-8, &Unit::none()), "3.46e-8");
        assert_eq!(quantity(0.0, &mm), "0 mm");
        assert_eq!(quantity(f64::INFINITY, &mm), "inf mm");
        assert_eq!(time(6.362720049), "6.36272 s");
    }

    #[test]
    fn plain_numbers_read_back_to_the_bit() {
        for value in [0.1, 1.0 / 3.0, 1e-300, -2.5e17, 123456.789, f64::MIN_POSITIVE, 1e-5, -0.0] {
            assert_eq!(plain(value).parse::<f64>().unwrap().to_bits(), value.to_bits());
        }
        assert_eq!(plain(1e-5), "1e-5");
    }
}
