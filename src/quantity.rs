//! Numbers with units, as typed and as shown.

pub use abi::format::{count, duration, quantity as show, significant, uncertain};
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
}
