//! Figures of curves: one model, three renderers.
//!
//! In: numbers in the units they are shown in. Out: text for a terminal, an SVG, a PNG. Knows no runs and no files.

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

/// Curves over common axes.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// In the order of the legend.
    pub curves: Vec<Curve>,
    /// Shaded stretches of x, behind the curves.
    pub bands: Vec<Band>,
}

/// What is drawn along an axis.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Axis {
    /// Such as `body.v`; may be empty.
    pub name: String,
    /// Such as `mm/s`; empty for a pure number.
    pub unit: String,
    /// In powers of ten; what is not positive leaves a gap.
    pub logarithmic: bool,
}

/// Points joined by straight lines, in the order given; a point that is not finite leaves a gap.
#[derive(Clone, Debug, Default)]
pub struct Curve {
    /// For the legend.
    pub name: String,
    /// (x, y) in the units of the axes.
    pub points: Vec<(f64, f64)>,
    /// Only the values 0 and 1, held between points.
    pub boolean: bool,
    /// Each point is a measured one and gets a mark.
    pub marks: bool,
    /// Numbers of its colour and of its dashes; by its place among the curves if there are none.
    pub style: Option<(usize, usize)>,
}

/// Where something is true.
#[derive(Clone, Debug)]
pub struct Band {
    /// For the legend.
    pub name: String,
    /// Stretches of x, ascending.
    pub stretches: Vec<(f64, f64)>,
}

impl Axis {
    /// The scale for values between `from` and `to`, which are exponents on a logarithmic axis.
    fn scale(&self, from: f64, to: f64, count: usize) -> Scale {
        if self.logarithmic { Scale::decades(from, to, count) } else { Scale::new(from, to, count) }
    }

    /// Where a value is drawn: at its exponent on a logarithmic axis.
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
    /// The stretches of a curve of zeros and ones in which it is one.
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
    /// The points to join: those of a truth value with the corners between them.
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
    /// The panel with the points of its curves where they are drawn.
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
