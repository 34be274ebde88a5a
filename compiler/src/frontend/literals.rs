//! Numbers that are written with their unit.
//!
//! In: an expression. Out: its value in SI where it is a number, with or without a unit, or what is wrong with it.

use abi::unit::{Dimension, Unit};
use grammar::ast::{self, Expr};
use grammar::diagnostic::Diagnostic;

/// A literal in SI units, its unit and the unit as written.
pub fn quantity(expr: &Expr) -> Option<(f64, Unit, Option<ast::UnitText>)> {
    match &expr.kind {
        ast::ExprKind::Number { value, unit: None } => Some((*value, Unit::none(), None)),
        ast::ExprKind::Number { value, unit: Some(text) } => {
            let unit = Unit::parse(&text.text).ok()?;
            Some((unit.to_si(*value), unit, Some(text.clone())))
        }
        ast::ExprKind::Unary(ast::UnaryOp::Negate, a) => quantity(a).map(|(value, unit, text)| (-value, unit, text)),
        _ => None,
    }
}

/// A number with a unit of this dimension, in SI.
pub fn number(expr: &Expr, dimension: Dimension, diagnostics: &mut Vec<Diagnostic>) -> Option<f64> {
    let Some((value, unit, text)) = quantity(expr) else {
        let error = Diagnostic::error("E0904", "a number with its unit stands here").label(expr.span, "not a number");
        diagnostics.push(error.help("write it as a number, such as `1.5 N`"));
        return None;
    };
    // 0 fits every unit.
    if unit.dimension != dimension && !(value == 0.0 && text.is_none()) {
        let (wanted, is) = (dimension.describe(), unit.dimension.describe());
        let error = Diagnostic::error("E0101", format!("{wanted} stands here, not {is}")).label(expr.span, is);
        let si = Unit::si(dimension);
        diagnostics.push(error.help(format!("write it in {}", if si.text.is_empty() { "no unit" } else { &si.text })));
        return None;
    }
    Some(value)
}
