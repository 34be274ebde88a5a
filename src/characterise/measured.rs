//! What a test of the battery leaves: curves and numbers, and how they are shown.

use crate::plot::{Band, raised};
use crate::quantity::{show, significant};
use abi::unit::Unit;

/// One test of the battery.
#[derive(Clone, Debug)]
pub struct Test {
    /// For files: `break_away`.
    pub key: &'static str,
    /// Heading.
    pub title: &'static str,
    /// What was done, in a sentence.
    pub how: String,
    /// Curves, or the reason why there are none.
    pub result: Result<Vec<Graph>, String>,
    /// What was measured.
    pub numbers: Vec<Number>,
}

/// A measured number.
#[derive(Clone, PartialEq, Debug)]
pub struct Number {
    /// For programs: `break_away_force`.
    pub key: &'static str,
    /// For people.
    pub name: String,
    /// SI.
    pub value: f64,
    /// Coherent SI unit, empty for a pure number.
    pub unit: String,
    /// What is smaller than this is shown as 0: what rounding and the control of errors leave of nothing.
    pub nothing: f64,
}

impl Number {
    /// With a unit that suits its size.
    pub fn shown(&self) -> String {
        match (self.key, self.value) {
            (_, f64::INFINITY) => "more than was tried".into(),
            ("step_error", part) if part.abs() < 1e-2 && part != 0.0 => power_of_ten(part),
            (key, part) if PARTS.contains(&key) => percent(part),
            (_, value) => shown(if value.abs() < self.nothing { 0.0 } else { value }, &self.unit),
        }
    }
}

/// Numbers that are parts of something, and so are shown in percent.
const PARTS: [&str; 4] = ["break_away_change", "loop_area", "memory_error", "rate_difference_part"];

/// A measured value in SI for people: four digits, and a prefix that leaves a number one can grasp. What is too short or
/// too slow to be more than rounding is 0, in the least unit that would have been shown.
pub fn shown(value: f64, base: &str) -> String {
    let least = match base {
        "m" | "rad" | "m/s" | "rad/s" => 1e-12,
        _ => 0.0,
    };
    if base.is_empty() {
        return significant(value, 4);
    }
    if value.abs() <= least {
        let small = if least > 0.0 { 1e-9 } else { 0.0 };
        return format!("0 {}", prefixed(base, small).0).trim_end().to_string();
    }
    // Below the least prefix there are no four digits to tell.
    let digits = if (1e-12..1e-10).contains(&value.abs()) { 2 } else { 4 };
    show(value, &prefixed(base, value.abs()).0, digits)
}

/// A part as so many percent, with as many digits as tell something.
pub fn percent(part: f64) -> String {
    let percent = 100.0 * part;
    match percent.abs() {
        0.0 => "0 %".into(),
        size if size < 0.01 => "< 0.01 %".into(),
        size => format!("{} %", significant(percent, if size < 0.1 { 1 } else { 3 })),
    }
}

/// A small number as people write it: `4.5·10⁻⁶`.
fn power_of_ten(x: f64) -> String {
    let text = format!("{x:.1e}");
    let (digits, exponent) = text.split_once('e').expect("written with an exponent");
    format!("{digits}·10{}", raised(exponent.parse().expect("an exponent")))
}

/// Curves over common axes; values in SI.
#[derive(Clone, Debug)]
pub struct Graph {
    /// For files: `energy`.
    pub key: &'static str,
    /// Name and coherent unit of what is drawn to the right.
    pub x: (String, String),
    /// The same upwards.
    pub y: (String, String),
    /// Whether in powers of ten.
    pub logarithmic: (bool, bool),
    /// The curves.
    pub lines: Vec<Line>,
    /// In which regime the model is, over time.
    pub bands: Vec<Band>,
    /// Why it is no use beside the graphs of other models, whose curves it would hide.
    pub alone: Option<String>,
}

/// One curve of a graph.
#[derive(Clone, Debug)]
pub struct Line {
    /// For the legend; may be empty.
    pub name: String,
    /// SI.
    pub points: Vec<(f64, f64)>,
    /// Measured points rather than a course.
    pub marks: bool,
    /// Shown when several models share the axes.
    pub main: bool,
}

impl Line {
    /// A course.
    pub fn course(name: impl Into<String>, points: Vec<(f64, f64)>) -> Line {
        Line { name: name.into(), points, marks: false, main: true }
    }

    /// Measured points.
    pub fn marked(name: impl Into<String>, points: Vec<(f64, f64)>) -> Line {
        Line { name: name.into(), points, marks: true, main: true }
    }

    /// The same, left out where several models share the axes.
    pub fn aside(self) -> Line {
        Line { main: false, ..self }
    }
}

/// A unit with the prefix that suits a size, and what one of it is in SI.
pub fn prefixed(base: &str, size: f64) -> (Unit, f64) {
    const PREFIXES: [(&str, f64); 6] = [("G", 1e9), ("M", 1e6), ("k", 1e3), ("", 1.0), ("m", 1e-3), ("u", 1e-6)];
    let plain = || (Unit::parse(base).unwrap_or_else(|_| Unit::none()), 1.0);
    if base.is_empty() || base == "Hz" || base.starts_with("kg") || size == 0.0 || !size.is_finite() {
        return plain();
    }
    if (0.1..1e4).contains(&size) || base == "s" && size >= 0.1 {
        return plain();
    }
    // A little below one of the next: 0.997 mm rather than 997 µm.
    let fitting = PREFIXES.into_iter().find(|(_, scale)| size >= 0.9 * scale).unwrap_or(("n", 1e-9));
    match Unit::parse(&format!("{}{base}", fitting.0)) {
        Ok(unit) => (unit, fitting.1),
        Err(_) => plain(),
    }
}

/// A plain number for texts.
pub fn plain(x: f64) -> String {
    significant(x, 4)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_shown_as_people_write_them() {
        let cases = [
            (0.0, "m", "0 nm"),
            (4.802e-14, "m", "0 nm"),
            (3e-26, "rad/s", "0 nrad/s"),
            (2.601e-11, "m", "0.026 nm"),
            (9.969e-4, "m/s", "0.9969 mm/s"),
            (3.72e-5, "m", "37.2 µm"),
            (1.5, "N", "1.5 N"),
            (83_330.0, "N/m", "83.33 kN/m"),
            (5e-5, "s", "50 µs"),
            (22.68, "s", "22.68 s"),
            (123_456.0, "s", "123500 s"),
            (14.0, "", "14"),
            (0.0, "", "0"),
        ];
        for (value, base, text) in cases {
            assert_eq!(shown(value, base), text, "{value:e} {base}");
        }
        assert_eq!([0.0, 5e-10, 4e-4, 0.08934, 1.0].map(percent), ["0 %", "< 0.01 %", "0.04 %", "8.93 %", "100 %"]);
        assert_eq!(power_of_ten(4.52e-6), "4.5·10⁻⁶");
    }
}
