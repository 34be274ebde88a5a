//! Figures with curves: one data model, three renderers.
//!
//! In: numbers in the units shown. Out: text for a terminal, an SVG, a PNG. Knows no runs and no files.

mod decimate;
mod scale;
mod svg;
mod braille;
mod png;

pub use braille::terminal;
pub use png::png;
pub use scale::raised;
pub use svg::{inline, svg};

use scale::Scale;
use std::borrow::Cow;

/// Panels one above the other under one title.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    /// Large, at the top.
    pub title: String,
    /// Small, below the title; may be empty.
    pub subtitle: String,
    /// From top to bottom.
    pub panels: Vec<Panel>,
}

/// Curves with common axes.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// In the order of the legend.
    pub curves: Vec<Curve>,
    /// Shaded intervals of x, behind the curves.
    pub bands: Vec<Band>,
}

/// The quantity along an axis.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Axis {
    /// Such as `body.v`; may be empty.
    pub name: String,
    /// Such as `mm/s`; empty for a pure number.
    pub unit: String,
    /// Whether the scale is logarithmic; a value that is not positive leaves a gap.
    pub logarithmic: bool,
}

/// Points connected by straight lines, in the order given; a point that is not finite leaves a gap.
#[derive(Clone, Debug, Default)]
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// (x, y) in the units of the axes.
    pub points: Vec<(f64, f64)>,
    /// Whether the values are only 0 and 1, held between points.
    pub boolean: bool,
    /// Whether each point was measured and is marked.
    pub marks: bool,
    /// Numbers of its colour and of its dash pattern; by default from its position among the curves.
    pub style: Option<(usize, usize)>,
}

/// Intervals in which a condition is true.
#[derive(Clone, Debug)]
pub struct Band {
    /// Name in the legend.
    pub name: String,
    /// Intervals of x, ascending.
    pub stretches: Vec<(f64, f64)>,
}

impl Axis {
    /// The scale for values between `from` and `to`, which are exponents on a logarithmic axis.
    fn scale(&self, from: f64, to: f64, count: usize) -> Scale {
        if self.logarithmic { Scale::decades(from, to, count) } else { Scale::new(from, to, count) }
    }

    /// The coordinate of a value: its exponent on a logarithmic axis.
    #[expect(clippy::disallowed_methods, reason = "a picture, not a result")]
    fn place(&self, value: f64) -> f64 {
        match self.logarithmic {
            true if value > 0.0 => value.log10(),
            true => f64::NAN,
            false => value,
        }
    }

    /// `name [unit]`.
    pub fn title(&self) -> String {
        match (self.name.as_str(), self.unit.as_str()) {
            (name, "") => name.into(),
            ("", unit) => format!("[{unit}]"),
            (name, unit) => format!("{name} [{unit}]"),
        }
    }
}

impl Band {
    /// The intervals in which a curve of zeros and ones is one.
    pub fn of(name: &str, points: &[(f64, f64)]) -> Band {
        let mut stretches: Vec<(f64, f64)> = Vec::new();
        let mut since = None;
        for &(x, y) in points {
            match (since, y > 0.5) {
                (None, true) => since = Some(x),
                (Some(from), false) => {
                    stretches.push((from, x));
                    since = None;
                }
                (None, false) | (Some(_), true) => {}
            }
        }
        if let (Some(from), Some(&(x, _))) = (since, points.last()) {
            stretches.push((from, x));
        }
        Band { name: name.into(), stretches }
    }
}

impl Curve {
    /// The points to connect: for a truth value with the corners between them.
    fn corners(&self) -> Cow<'_, [(f64, f64)]> {
        if !self.boolean {
            return Cow::Borrowed(&self.points);
        }
        let mut corners: Vec<(f64, f64)> = Vec::with_capacity(self.points.len());
        for &(x, y) in &self.points {
            if let Some(&(_, before)) = corners.last()
                && before != y
            {
                corners.push((x, before));
            }
            corners.push((x, y));
        }
        Cow::Owned(corners)
    }
}

impl Panel {
    /// The panel with the points of its curves in axis coordinates.
    fn placed(&self) -> Cow<'_, Panel> {
        if !self.x.logarithmic && !self.y.logarithmic {
            return Cow::Borrowed(self);
        }
        let mut panel = self.clone();
        for point in panel.curves.iter_mut().flat_map(|curve| &mut curve.points) {
            *point = (self.x.place(point.0), self.y.place(point.1));
        }
        Cow::Owned(panel)
    }

    /// Least and greatest finite x and y of all curves, or none if nothing is finite.
    fn bounds(&self) -> Option<((f64, f64), (f64, f64))> {
        let points = self.curves.iter().flat_map(|curve| &curve.points);
        let mut finite = points.filter(|(x, y)| x.is_finite() && y.is_finite());
        let &(x, y) = finite.next()?;
        Some(
            finite.fold(((x, x), (y, y)), |(xs, ys), &(x, y)| ((xs.0.min(x), xs.1.max(x)), (ys.0.min(y), ys.1.max(y)))),
        )
    }
}

/// Colours that people with any colour vision can tell apart on white (Okabe and Ito, without the yellow).
const PALETTE: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#444444"];
/// Shades of the bands.
const SHADES: [&str; 3] = ["#e9eef5", "#f6ecdf", "#e6f2ec"];

#[cfg(test)]
#[expect(clippy::disallowed_methods, clippy::print_stdout, reason = "pictures to look at")]
mod tests;
