//! Reads an unknown of a fit: its range, its start, and what is known of it.
//!
//! In: an item of `vary`, and the program with its parameters. Out: an [`Unknown`], or what is wrong.

use crate::experiment::Variant;
use crate::experiment::vary::param_of;
use crate::frontend::literals::{number, quantity};
use crate::frontend::names::nearest;
use abi::description::{Kind, Quantity};
use abi::unit::Unit;
use abi::{Description, Slot};
use grammar::ast;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// An unknown parameter.
#[derive(Clone, PartialEq, Debug)]
pub struct Unknown {
    /// As written.
    pub path: String,
    /// Its slot.
    pub slot: Slot,
    /// Where the text varies it.
    pub span: Span,
    /// The unit in which it is shown.
    pub unit: Unit,
    /// Its bounds in SI.
    pub range: (f64, f64),
    /// Where the search starts, in SI.
    pub start: f64,
    /// Value and standard deviation that are known beforehand, in SI.
    pub known: Option<(f64, f64)>,
}

/// Where no range is given, that of a parameter that is known with a standard deviation, in standard deviations.
const KNOWN: f64 = 10.0;

/// Reads an unknown; none if it is wrong.
pub fn unknown(
    variant: &Variant,
    description: &Description,
    vary: &ast::Vary,
    path: &str,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Unknown> {
    let span = vary.path.span;
    if let Some(state) =
        description.quantity(path).filter(|found| matches!(found.kind, Kind::State | Kind::SampledState))
    {
        let error = Diagnostic::error("E0204", format!("`{}` is a state: only parameters vary", state.path));
        diagnostics.push(error.label(span, "not a parameter").help("fitted initial values are not available yet"));
        return None;
    }
    let Some(param) = param_of(description, path) else {
        let error = Diagnostic::error("E0204", format!("there is no parameter `{path}`")).label(span, "not known");
        let is_param = |quantity: &&Quantity| quantity.kind == Kind::Param;
        let all = description.quantities.iter().filter(is_param).map(|quantity| quantity.path.as_str());
        let names: Vec<&str> = all.clone().collect();
        diagnostics.push(match nearest(path, all) {
            Some(near) => error.help(format!("did you mean `{near}`?")),
            None => error.help(format!("the instance has {}", names.join(", "))),
        });
        return None;
    };
    let dimension = param.unit.dimension;
    // The description begins with the parameters, as their values do.
    let written = variant.program.params.get(param.slot.index() - description.layout.params.range().start).copied();
    let written = written.filter(|value| value.is_finite());
    let range = match &vary.range {
        Some(ast::Range::Between(low, high)) => {
            (number(low, dimension, diagnostics)?, number(high, dimension, diagnostics)?)
        }
        Some(ast::Range::Bound(..)) => (f64::NAN, f64::INFINITY),
        None => match (&vary.start, &vary.known) {
            (Some(start), Some(sd)) => {
                let (value, sd) = (number(start, dimension, diagnostics)?, number(sd, dimension, diagnostics)?);
                let (low, high) = param.range;
                ((value - KNOWN * sd).max(low), (value + KNOWN * sd).min(high))
            }
            _ => param.range,
        },
    };
    if !(range.0.is_finite() && range.1.is_finite()) {
        let error =
            Diagnostic::error("E0904", format!("`{path}` has no finite range")).label(span, "from where to where?");
        let shown = |si: f64| format!("{} {}", three_digits(param.unit.from_si(si)), param.unit).trim_end().to_string();
        let help = match written.filter(|value| *value != 0.0) {
            Some(value) => {
                let (a, b) = (0.01 * value, 100.0 * value);
                format!("write `{path} in {} .. {}`", shown(a.min(b)), shown(a.max(b)))
            }
            None => format!("write `{path} in a .. b`, in {}", param.unit),
        };
        diagnostics.push(error.help(help));
        return None;
    }
    if range.0 >= range.1 {
        let error =
            Diagnostic::error("E0904", format!("the range of `{path}` is empty")).label(vary.span, "from low to high");
        diagnostics.push(error.help("write the lower bound first; a parameter that is known is set in `run`"));
        return None;
    }
    let start = match &vary.start {
        Some(start) => {
            let value = number(start, dimension, diagnostics)?;
            if !(range.0..=range.1).contains(&value) {
                let error = Diagnostic::error("E0501", format!("the start of `{path}` is outside of its range"));
                diagnostics.push(error.label(start.span, "outside").help("widen the range, or start within it"));
                return None;
            }
            value
        }
        None => written.filter(|v| (range.0..=range.1).contains(v)).unwrap_or_else(|| middle(range.0, range.1)),
    };
    let known = match &vary.known {
        Some(sd) => {
            let value = number(sd, dimension, diagnostics)?;
            if !(value > 0.0 && value.is_finite()) {
                let error = Diagnostic::error("E0904", "a standard deviation is greater than 0")
                    .label(sd.span, format!("{value}"));
                diagnostics.push(error.help("a parameter that is known exactly is set in `run`"));
                return None;
            }
            Some((start, value))
        }
        None => None,
    };
    Some(Unknown { path: path.to_string(), slot: param.slot, span, unit: param.unit.clone(), range, start, known })
}

fn three_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

/// A value for a parameter that has none, as text: its start, else the middle of its range.
pub fn typical(vary: &ast::Vary) -> Option<String> {
    let (value, unit) = match (&vary.start, &vary.range) {
        (Some(start), _) => quantity(start).map(|(value, unit, _)| (value, unit))?,
        (None, Some(ast::Range::Between(low, high))) => {
            let ((low, _, _), (high, unit, _)) = (quantity(low)?, quantity(high)?);
            (middle(low, high), unit)
        }
        (None, Some(ast::Range::Bound(..)) | None) => return None,
    };
    Some(format!("{} {unit}", unit.from_si(value)).trim_end().to_string())
}

/// The middle of a range, in its scale.
fn middle(low: f64, high: f64) -> f64 {
    let middle = if low * high > 0.0 { (low * high).sqrt().copysign(low) } else { 0.5 * (low + high) };
    // A range that is written backwards is reported elsewhere.
    middle.max(low.min(high)).min(low.max(high))
}
