//! Figures with curves: one data model, four renderers.
//!
//! In: numbers in the units shown. Out: text for a terminal, an SVG, a PNG, a PDF. Knows no runs and no files.

mod decimate;
mod scale;
mod svg;
mod braille;
mod png;
mod pdf;

pub use braille::terminal;
pub use scale::raised;
pub use svg::inline;

use scale::Scale;
use std::borrow::Cow;

/// How a figure is drawn.
#[derive(Clone, PartialEq, Debug)]
pub struct Look {
    /// Width and height in px; without them 860 px wide, and as tall as the panels need.
    pub size: Option<(f64, f64)>,
    /// Font size in px.
    pub font: f64,
    /// What tells curves apart.
    pub lines: Lines,
    /// Panels side by side.
    pub columns: usize,
}

impl Default for Look {
    fn default() -> Look {
        Look { size: None, font: 13.0, lines: Lines::Colour, columns: 1 }
    }
}

/// What tells curves apart.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Lines {
    /// Colours
    Colour,
    /// Colours, dashes and markers: also in a print without colours
    Dashes,
    /// Black and grey, dashes and markers
    Grey,
}

/// Kinds of pictures.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Kind {
    Svg,
    Png,
    Pdf,
}

impl Kind {
    /// The kind that the ending of a file's name states.
    pub fn of(path: &std::path::Path) -> Option<Kind> {
        match path.extension().and_then(|ending| ending.to_str())?.to_ascii_lowercase().as_str() {
            "svg" => Some(Kind::Svg),
            "png" => Some(Kind::Png),
            "pdf" => Some(Kind::Pdf),
            _ => None,
        }
    }
}

/// A figure as the bytes of a file.
pub fn picture(figure: &Figure, look: &Look, kind: Kind) -> Vec<u8> {
    match kind {
        Kind::Svg => svg::svg(figure, look).into_bytes(),
        Kind::Png => png::png(figure, look),
        Kind::Pdf => pdf::pdf(figure, look),
    }
}

/// Panels under one title.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    /// Large, at the top.
    pub title: String,
    /// Small, below the title; may be empty.
    pub subtitle: String,
    /// From top to bottom, or row by row.
    pub panels: Vec<Panel>,
}

/// Curves with common axes.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Above the axes; may be empty.
    pub title: String,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// In the order of the legend.
    pub curves: Vec<Curve>,
    /// Shaded intervals of x, behind the curves.
    pub bands: Vec<Band>,
    /// Whether the names of its curves are shown.
    pub legend: bool,
}

impl Default for Panel {
    fn default() -> Panel {
        let (title, x, y) = (String::new(), Axis::default(), Axis::default());
        Panel { title, x, y, curves: Vec::new(), bands: Vec::new(), legend: true }
    }
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
    /// Its ends, if they do not follow from the curves.
    pub range: Option<(f64, f64)>,
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
    /// Whether it is a recording: grey dots below the other curves.
    pub recorded: bool,
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
        if !self.logarithmic {
            return Scale::new(from, to, count);
        }
        // Within a decade there are too few powers of ten: even ticks at their logarithms.
        if to - from < 0.95 && from.abs() < 300.0 {
            let even = Scale::new(self.power(from), self.power(to), count);
            if even.note.is_empty() && even.ticks.iter().all(|tick| tick.at > 0.0) {
                let ticks = even.ticks.into_iter().map(|tick| scale::Tick { at: self.place(tick.at), ..tick });
                return Scale { from, to, ticks: ticks.collect(), note: String::new() };
            }
        }
        Scale::decades(from, to, count)
    }

    /// The value at a coordinate of a logarithmic axis.
    #[expect(clippy::disallowed_methods, reason = "a picture, not a result")]
    fn power(&self, exponent: f64) -> f64 {
        10f64.powf(exponent)
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

    /// The ends of the axis for values between `ends`: those given, or these with some space beside them.
    fn ends(&self, ends: (f64, f64), space: f64) -> (f64, f64) {
        let given = self.range.map(|(from, to)| (self.place(from), self.place(to)));
        given.filter(|(from, to)| from < to).unwrap_or_else(|| scale::padded(ends, space))
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

    /// Least and greatest finite x and y of all curves, or none if nothing is finite. Only points within a given range
    /// of x determine the range of y. The panel is in axis coordinates.
    fn bounds(&self) -> Option<((f64, f64), (f64, f64))> {
        let points = self.curves.iter().flat_map(|curve| &curve.points);
        let range = self.x.range.map(|(from, to)| (self.x.place(from), self.x.place(to)));
        let inside = |x: f64| range.is_none_or(|(from, to)| (from..=to).contains(&x));
        let mut finite = points.filter(|(x, y)| x.is_finite() && y.is_finite() && inside(*x));
        let &(x, y) = finite.next()?;
        Some(
            finite.fold(((x, x), (y, y)), |(xs, ys), &(x, y)| ((xs.0.min(x), xs.1.max(x)), (ys.0.min(y), ys.1.max(y)))),
        )
    }
}

/// Colours of recordings and of prints without colours.
const RECORDED: &str = "#9aa1a9";
const GREYS: [&str; 5] = ["#000000", "#777777", "#3a3a3a", "#a0a0a0", "#5a5a5a"];
/// Colours that people with any colour vision can tell apart on white (Okabe and Ito, without the yellow).
const PALETTE: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#444444"];
/// Shades of the bands.
const SHADES: [&str; 3] = ["#e9eef5", "#f6ecdf", "#e6f2ec"];

#[cfg(test)]
#[expect(clippy::disallowed_methods, clippy::print_stdout, reason = "pictures to look at")]
mod tests;
