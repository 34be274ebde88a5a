//! Formats numbers for messages: three significant digits and a unit.

use abi::unit::Unit;

/// A value in SI, shown in `unit` with three significant digits: `1.63 N`, `-0.0125`, `3.46e-8 m/s`.
pub fn quantity(si: f64, unit: &Unit) -> String {
    let number = digits(unit.from_si(si), 3);
    if unit.text.is_empty() { number } else { format!("{number} {unit}") }
}

/// A time in s with seven significant digits, enough to distinguish neighbouring steps: `12.3401 s`.
pub fn time(seconds: f64) -> String {
    format!("{} s", digits(seconds, 7))
}

/// A number rounded to `significant` digits, without trailing zeros.
fn digits(value: f64, significant: usize) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let rounded: f64 = format!("{value:.*e}", significant - 1).parse().expect("a printed number reads back");
    plain(rounded)
}

/// The shortest decimal that parses to the same number, with an exponent where that is far shorter.
pub fn plain(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude == 0.0 || (1e-4..1e15).contains(&magnitude) || !magnitude.is_finite() {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

/// An instant in seconds since 1970, as a date and time in UTC: `2026-11-24 15:30:12 UTC`.
///
/// Source of the calendar: H. Hinnant, "chrono-compatible low-level date algorithms", `civil_from_days`.
pub fn utc(seconds: u64) -> String {
    let (days, rest) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let (day, month) =
        (day_of_year - (153 * shifted + 2) / 5 + 1, if shifted < 10 { shifted + 3 } else { shifted - 9 });
    let year = year_of_era + 400 * era + u64::from(month <= 2);
    format!("{year}-{month:02}-{day:02} {:02}:{:02}:{:02} UTC", rest / 3600, rest / 60 % 60, rest % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instant_is_a_date_and_a_time() {
        assert_eq!(utc(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(utc(951_782_399), "2000-02-28 23:59:59 UTC");
        assert_eq!(utc(951_782_400), "2000-02-29 00:00:00 UTC");
        assert_eq!(utc(1_795_534_212), "2026-11-24 15:30:12 UTC");
    }

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
