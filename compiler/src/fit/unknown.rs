//! Reads an unknown of a fit: its range, its start, and what is known of it.
//!
//! In: an item of `vary`, and the program with its parameters. Out: an [`Unknown`], or what is wrong.

use crate::experiment::Variant;
use crate::experiment::vary::param_of;
use crate::frontend::literals::{number, quantity};
use crate::frontend::names::nearest;
use crate::frontend::system::*;
use abi::description::{Kind, Quantity};
use abi::unit::Unit;
use abi::{Description, Slot};
use grammar::ast::{self, BinaryOp};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// An unknown parameter.
#[derive(Clone, PartialEq, Debug)]
pub struct Unknown {
    /// As written, without `initial(…)`.
    pub path: String,
    /// What it is called: `Fc`, `initial(z)`, `F0 of bench_1`.
    pub label: String,
    /// It is the initial value of a state.
    pub initial: bool,
    /// It is no parameter of an instance, but one of the fit, which the arguments of `run` name.
    pub own: bool,
    /// The index of the run to which it belongs alone; none if all runs share it.
    pub of: Option<usize>,
    /// The index of the unknown below which it never lies.
    pub above: Option<usize>,
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

/// Whether a run has this unknown.
pub fn exists(description: &Description, vary: &ast::Vary, path: &str) -> bool {
    let is_state = description.quantity(path).is_some_and(|found| is_state(found.kind));
    param_of(description, path).is_some() && is_state == vary.initial
}

fn is_state(kind: Kind) -> bool {
    matches!(kind, Kind::State | Kind::SampledState)
}

/// Pairs of parameters of which the first must not lie below the second, by ranges and `require` conditions.
pub fn orders(variant: &Variant) -> Vec<(Slot, Slot)> {
    let system = &variant.system;
    let mut pairs: Vec<(ExprId, ExprId)> = Vec::new();
    let mut stack: Vec<ExprId> = system.requires.iter().map(|require| require.condition).collect();
    while let Some(condition) = stack.pop() {
        match system.node(condition) {
            Node::Binary(BinaryOp::And, a, b) => stack.extend([*a, *b]),
            Node::Binary(BinaryOp::GreaterEqual | BinaryOp::Greater, a, b) => pairs.push((*a, *b)),
            Node::Binary(BinaryOp::LessEqual | BinaryOp::Less, a, b) => pairs.push((*b, *a)),
            _ => {}
        }
    }
    let slot = |var: VarId| variant.program.description.quantity(&system.var(var).path).map(|found| found.slot);
    let read = |mut expr: ExprId| loop {
        let Node::Var(var) = system.node(expr) else { return None };
        match system.var(*var).definition {
            // A parameter that equals another is that one.
            Definition::Value(value, _) if matches!(system.node(value), Node::Var(_)) => expr = value,
            _ => return slot(*var),
        }
    };
    let mut all: Vec<(Slot, Slot)> = pairs.iter().filter_map(|(a, b)| Some((read(*a)?, read(*b)?))).collect();
    for id in system.var_ids().filter(|id| system.var(*id).kind == VarKind::Param) {
        let range = system.var(id).range;
        let own = match system.var(id).definition {
            Definition::Value(value, _) if matches!(system.node(value), Node::Var(_)) => read(value),
            _ => slot(id),
        };
        let Some(own) = own else { continue };
        all.extend(range.low.and_then(|(low, _)| Some((own, read(low)?))));
        all.extend(range.high.and_then(|(high, _)| Some((read(high)?, own))));
    }
    all.retain(|(a, b)| a != b);
    all
}

/// Reads an unknown; none if it is wrong. Its path is given as written, and as the system of the run has it.
pub fn unknown(
    variant: &Variant,
    vary: &ast::Vary,
    (path, of_system): (&str, &str),
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Unknown> {
    let description = &variant.program.description;
    let span = vary.path.span;
    let state = description.quantity(of_system).filter(|found| is_state(found.kind));
    if let (Some(state), false) = (state, vary.initial) {
        let error = Diagnostic::error("E0204", format!("`{}` is a state: only parameters vary", state.path));
        let help = format!("for its initial value write `initial({})`", state.path);
        diagnostics.push(error.label(span, "not a parameter").help(help));
        return None;
    }
    let found = param_of(description, of_system).filter(|_| state.is_some() == vary.initial);
    let Some(param) = found else {
        let what = if vary.initial { "state" } else { "parameter" };
        let error = Diagnostic::error("E0204", format!("there is no {what} `{path}`")).label(span, "not known");
        let is_one =
            |quantity: &&Quantity| if vary.initial { is_state(quantity.kind) } else { quantity.kind == Kind::Param };
        let own = |quantity: &&Quantity| !quantity.path.ends_with(')');
        let all = description.quantities.iter().filter(is_one).filter(own).map(|quantity| quantity.path.as_str());
        let names: Vec<&str> = all.clone().collect();
        diagnostics.push(match nearest(path, all) {
            Some(near) => error.help(format!("did you mean `{near}`?")),
            None if names.is_empty() => error.help(format!("the instance has no {what}")),
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
            // An initial value may be anything that its state may be.
            _ => state.map_or(param.range, |state| state.range),
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
    let label = if vary.initial { format!("initial({path})") } else { path.to_string() };
    Some(Unknown {
        path: path.to_string(),
        label,
        initial: vary.initial,
        own: path != of_system,
        of: None,
        above: None,
        span,
        unit: param.unit.clone(),
        range,
        start,
        known,
    })
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
