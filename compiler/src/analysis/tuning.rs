//! `tune`: which parameters may be turned while something runs, in which order, and how far.
//!
//! In: the items of `tune` and a checked system. Out: a [`Tuned`] for each item, or what is wrong with it.

use crate::frontend::literals::number;
use crate::frontend::names::nearest;
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::lower::evaluate;
use abi::format::quantity;
use abi::live::beyond;
use grammar::ast;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// A parameter that may be turned.
#[derive(Clone, PartialEq, Debug)]
pub struct Tuned {
    /// Dotted path.
    pub path: String,
    /// How far, SI; infinite where the text gives no range.
    pub range: (f64, f64),
    /// Where the text names it.
    pub span: Span,
}

/// The path of an item, as parameters have it.
pub fn path(item: &ast::Tuned, files: &Files) -> String {
    files.slice(item.path.span).split_whitespace().collect()
}

/// Whether a system has this parameter.
pub fn has(system: &System, path: &str) -> bool {
    system.var_ids().any(|id| system.var(id).kind == VarKind::Param && system.var(id).path == path)
}

/// E0204: an item that is no parameter of the system.
pub fn unknown(item: &ast::Tuned, system: &System, files: &Files) -> Diagnostic {
    let path = path(item, files);
    let span = item.path.span;
    if let Some(other) = system.vars.iter().find(|var| var.path == path) {
        let message = format!("`{path}` is no parameter: only parameters can be tuned");
        return Diagnostic::error("E0204", message)
            .label(span, format!("this is a {}", other.kind.word()))
            .help("name a `param`");
    }
    let error = Diagnostic::error("E0204", format!("there is no parameter `{path}` to tune")).label(span, "not known");
    let params = || system.vars.iter().filter(|var| var.kind == VarKind::Param).map(|var| var.path.as_str());
    match nearest(&path, params()) {
        Some(near) => error.help(format!("did you mean `{near}`?")),
        None => error.help(format!("its parameters are {}", params().collect::<Vec<_>>().join(", "))),
    }
}

/// Reads the items that the system has as parameters.
pub fn read(
    items: &[&ast::Tuned],
    system: &System,
    types: &Types,
    files: &Files,
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<Tuned> {
    let mut out: Vec<Tuned> = Vec::new();
    for item in items {
        let path = path(item, files);
        let found = |id: &VarId| system.var(*id).kind == VarKind::Param && system.var(*id).path == path;
        let Some(id) = system.var_ids().find(found) else { continue };
        if let Some(before) = out.iter().find(|other| other.path == path) {
            let error = Diagnostic::error("E0301", format!("`{path}` is tuned twice"))
                .label(item.span, "again here")
                .label(before.span, "first here");
            diagnostics.push(error.help("remove one of them"));
            continue;
        }
        let range = match &item.range {
            None => (f64::NEG_INFINITY, f64::INFINITY),
            Some(ends) => match range(&path, ends, id, system, types, diagnostics) {
                Some(range) => range,
                None => continue,
            },
        };
        out.push(Tuned { path, range, span: item.span });
    }
    out
}

/// The range of an item, SI.
fn range(
    path: &str,
    (low, high): &(ast::Expr, ast::Expr),
    id: VarId,
    system: &System,
    types: &Types,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<(f64, f64)> {
    let unit = &types.units[id.0 as usize];
    if types.boolean_vars[id.0 as usize] {
        let error = Diagnostic::error("E0101", format!("`{path}` is true or false, and has no range"));
        diagnostics.push(error.label(low.span.to(high.span), "a range").help(format!("write `tune {path}`")));
        return None;
    }
    let from = number(low, unit.dimension, diagnostics)?;
    let to = number(high, unit.dimension, diagnostics)?;
    let shown = |si: f64| quantity(si, unit, 3);
    if from >= to {
        let error = Diagnostic::error("E0502", format!("nothing can be tuned in the range of `{path}`"))
            .label(low.span.to(high.span), format!("{} .. {}", shown(from), shown(to)));
        diagnostics.push(error.help("write the lower end first"));
        return None;
    }
    let declared = system.var(id).range;
    let bound = |bound: Option<(ExprId, bool)>| {
        let (expr, strict) = bound?;
        // A bound that is not known before the run is checked while it runs.
        Some((evaluate(system, types, &[expr])[0], strict)).filter(|(value, _)| !value.is_nan())
    };
    let (least, most) = (bound(declared.low), bound(declared.high));
    for (end, expr) in [(from, low), (to, high)] {
        if let Some(wrong) = beyond(end, least, most) {
            let said = format!("`{path}` must be {} {}, not {}", wrong.word, shown(wrong.bound), shown(end));
            let mut error = Diagnostic::error("E0502", format!("`tune` goes beyond the range of `{path}`"));
            error = error.label(expr.span, said);
            if let Some(span) = system.var(id).range_span {
                error = error.label(span, "its own range");
            }
            diagnostics.push(error.help("tune it within its own range"));
            return None;
        }
    }
    Some((from, to))
}
