//! Results of a test of the battery: curves and numbers, and their display.

use crate::plot::{Band, raised};
use crate::quantity::{show, significant};
pub use abi::format::prefixed;

/// One test of the battery.
#[derive(Clone, Debug)]
pub struct Test {
    /// Identifier for files: `break_away`.
    pub key: &'static str,
    /// Title in the report.
    pub title: &'static str,
    /// What was done, in a sentence.
    pub how: String,
    /// Graphs, or the reason why there are none.
    pub result: Result<Vec<Graph>, String>,
    /// What was measured.
    pub numbers: Vec<Number>,
}

/// A measured number.
#[derive(Clone, PartialEq, Debug)]
pub struct Number {
    /// Identifier for programs: `break_away_force`.
    pub key: &'static str,
    /// Name in the report.
    pub name: String,
    /// SI.
    pub value: f64,
    /// Coherent SI unit, empty for a pure number.
    pub unit: String,
    /// A smaller magnitude is shown as 0: the error level of rounding and error control.
    pub nothing: f64,
}

impl Number {
    /// With a unit of suitable size.
    pub fn shown(&self) -> String {
        match (self.key, self.value) {
            (_, f64::INFINITY) => "more than was tried".into(),
            ("step_error", part) if part.abs() < 1e-2 && part != 0.0 => power_of_ten(part),
            (key, part) if PARTS.contains(&key) => percent(part),
            (_, value) => shown(if value.abs() < self.nothing { 0.0 } else { value }, &self.unit),
        }
    }
}

/// Numbers that are ratios, shown in percent.
const PARTS: [&str; 5] = ["break_away_change", "loop_area", "loop_gap", "memory_error", "rate_difference_part"];

/// A measured value in SI for people: four digits, and a suitable prefix. A value at the level of rounding errors is
/// shown as 0, in the smallest unit that would have been used.
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
    // Below the smallest prefix, four digits are not significant.
    let digits = if (1e-12..1e-10).contains(&value.abs()) { 2 } else { 4 };
    show(value, &prefixed(base, value.abs()).0, digits)
}

/// A ratio in percent, with the significant digits.
pub fn percent(part: f64) -> String {
    let percent = 100.0 * part;
    match percent.abs() {
        0.0 => "0 %".into(),
        size if size < 0.01 => "< 0.01 %".into(),
        size => format!("{} %", significant(percent, if size < 0.1 { 1 } else { 3 })),
    }
}

/// A small number in mathematical notation: `4.5·10⁻⁶`.
fn power_of_ten(x: f64) -> String {
    let text = format!("{x:.1e}");
    let (digits, exponent) = text.split_once('e').expect("written with an exponent");
    format!("{digits}·10{}", raised(exponent.parse().expect("an exponent")))
}

/// Curves with common axes; values in SI.
#[derive(Clone, Debug)]
pub struct Graph {
    /// Identifier for files: `energy`.
    pub key: &'static str,
    /// Name and coherent unit of the horizontal axis.
    pub x: (String, String),
    /// The same for the vertical axis.
    pub y: (String, String),
    /// Whether the axes are logarithmic.
    pub logarithmic: (bool, bool),
    /// The curves.
    pub lines: Vec<Line>,
    /// The regime of the model over time.
    pub bands: Vec<Band>,
    /// Why it is not shown together with the graphs of other models: it would hide their curves.
    pub alone: Option<String>,
}

/// One curve of a graph.
#[derive(Clone, Debug)]
pub struct Line {
    /// Name in the legend; may be empty.
    pub name: String,
    /// SI.
    pub points: Vec<(f64, f64)>,
    /// Whether these are measured points rather than a continuous curve.
    pub marks: bool,
    /// Whether it is shown when several models share the axes.
    pub main: bool,
}

impl Line {
    /// A continuous curve.
    pub fn course(name: impl Into<String>, points: Vec<(f64, f64)>) -> Line {
        Line { name: name.into(), points, marks: false, main: true }
    }

    /// Measured points.
    pub fn marked(name: impl Into<String>, points: Vec<(f64, f64)>) -> Line {
        Line { name: name.into(), points, marks: true, main: true }
    }

    /// The same curve, omitted when several models share the axes.
    pub fn aside(self) -> Line {
        Line { main: false, ..self }
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
