//! Reads tables: listed points, or two columns of a file.
//!
//! In: a table's syntax tree and [`Sources`]. Out: points in SI units, or diagnostics. Knows nothing of interpolation.

use crate::frontend::columns::{self, Selector};
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use crate::frontend::system::Table;
use crate::frontend::turns;
use abi::unit::Unit;
use grammar::ast::{self, Expr, ExprKind, TablePoints, TableShape, UnaryOp};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};

/// Reads the table of an item. Returns `None` after it has reported an error.
pub fn read(
    loaded: &Loaded,
    sources: &dyn Sources,
    file: FileId,
    table: &ast::Table,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Table> {
    let mut unit = |unit: &Option<ast::UnitText>| match unit {
        None => Some(Unit::none()),
        Some(text) => match Unit::parse(&text.text) {
            Ok(unit) => Some(unit),
            Err(part) => {
                let error = Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(text.span, "not known");
                diagnostics.push(error);
                None
            }
        },
    };
    let (x_unit, y_unit) = (unit(&table.arg.unit)?, unit(&table.unit)?);
    let mut x = Vec::new();
    let mut y = Vec::new();
    match &table.points {
        TablePoints::Listed(points) => {
            for (a, b) in points {
                x.push(number(a, (&x_unit, &table.arg.unit), diagnostics)?);
                y.push(number(b, (&y_unit, &table.unit), diagnostics)?);
                check_order(&x, a.span, diagnostics)?;
            }
        }
        TablePoints::File(path) => {
            let wanted = [(Selector::Place, Some(x_unit.clone())), (Selector::Place, Some(y_unit.clone()))];
            let columns = columns(loaded, sources, file, path, &wanted, diagnostics)?;
            x.extend(&columns[0].0);
            y.extend(&columns[1].0);
            for k in 0..x.len() {
                check_order(&x[..=k], path.span, diagnostics)?;
            }
        }
    }
    if x.is_empty() {
        let error = Diagnostic::error("E0902", format!("table `{}` has no points", table.name.text));
        diagnostics.push(error.label(table.name.span, "at least one is needed"));
        return None;
    }
    Some(Table {
        name: table.name.text.clone(),
        x_unit,
        y_unit,
        smooth: table.shape == TableShape::Smooth,
        held: false,
        x: x.into(),
        y: y.into(),
    })
}

/// Columns of a file of numbers, converted to SI, each with the unit it is shown in. The unit in the heading is that of
/// the numbers and must have the dimension of the unit wanted; without either, the numbers have no unit.
pub fn columns(
    loaded: &Loaded,
    sources: &dyn Sources,
    file: FileId,
    path: &ast::Text,
    wanted: &[(Selector, Option<Unit>)],
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Vec<(Vec<f64>, Unit)>> {
    let from = &loaded.files.get(file).name;
    let text = match sources.file(from, &path.text) {
        Ok((_, text)) => text,
        Err(reason) => {
            let error = Diagnostic::error("E0903", format!("cannot read \"{}\"", path.text)).label(path.span, reason);
            diagnostics.push(error.help("the path is relative to the file that names it"));
            return None;
        }
    };
    let names: Vec<Selector> = wanted.iter().map(|(one, _)| *one).collect();
    let read = columns::read(&text, &names);
    // A long recording is as large as its columns.
    drop(text);
    let read = match read {
        Ok(read) => read,
        Err(columns::Fault { what, help }) => {
            let error = Diagnostic::error("E0903", format!("\"{}\" does not fit", path.text)).label(path.span, what);
            diagnostics.push(error.help(help));
            return None;
        }
    };
    let first = names.iter().position(|one| *one != Selector::Unused).unwrap_or(0);
    if read.numbers[first].is_empty() {
        let error = Diagnostic::error("E0902", format!("\"{}\" has no rows", path.text)).label(path.span, "empty");
        diagnostics.push(error);
        return None;
    }
    let mut out = Vec::new();
    let columns::Columns { numbers, units, places } = read;
    for (k, ((mut numbers, stated), (_, unit))) in numbers.into_iter().zip(&units).zip(wanted).enumerate() {
        let unit = unit.as_ref().or(stated.as_ref()).cloned().unwrap_or_default();
        let differs = |stated: &&Unit| stated.dimension != unit.dimension || turns::apart(stated, &unit);
        if let Some(stated) = stated.as_ref().filter(differs) {
            let shown = |unit: &Unit| match unit.dimension.is_none() {
                true => "a pure number".to_string(),
                false => format!("in {unit}"),
            };
            let column = format!("column {} of \"{}\"", places[k], path.text);
            let message = format!("{column} is {}, not {}", shown(stated), shown(&unit));
            let error = Diagnostic::error("E0903", message).label(path.span, "its heading says so");
            diagnostics.push(error.help("change the unit here, the order of the columns, or the heading of the file"));
            return None;
        }
        let written = stated.as_ref().unwrap_or(&unit);
        numbers.iter_mut().for_each(|number| *number = written.to_si(*number));
        out.push((numbers, unit));
    }
    Some(out)
}

fn check_order(x: &[f64], span: Span, diagnostics: &mut Vec<Diagnostic>) -> Option<()> {
    match x {
        [.., a, b] if a.partial_cmp(b) != Some(std::cmp::Ordering::Less) => {
            let error = Diagnostic::error("E0902", "the arguments of a table must increase")
                .label(span, "not above the one before");
            diagnostics.push(error.help("sort the points, and keep one for each argument"));
            None
        }
        _ => Some(()),
    }
}

/// A literal in SI, and of the dimension of a unit.
fn number(
    expr: &Expr,
    (wanted, declared): (&Unit, &Option<ast::UnitText>),
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<f64> {
    let dimension = wanted.dimension;
    match &expr.kind {
        ExprKind::Unary(UnaryOp::Negate, a) => Some(-number(a, (wanted, declared), diagnostics)?),
        ExprKind::Number { value, unit } => {
            let bare = unit.is_none();
            let unit = match unit {
                None => Unit::none(),
                Some(text) => match Unit::parse(&text.text) {
                    Ok(unit) => unit,
                    Err(part) => {
                        let error =
                            Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(text.span, "not known");
                        diagnostics.push(error);
                        return None;
                    }
                },
            };
            if unit.dimension != dimension && *value != 0.0 {
                let error = if unit.dimension.is_none() {
                    let wanted = Unit::si(dimension);
                    Diagnostic::error("E0103", "a point of a table needs its unit")
                        .label(expr.span, "a pure number")
                        .help(format!("write `{value} {wanted}`"))
                } else {
                    let message = format!("this is {}, {} is needed", unit.dimension.describe(), dimension.describe());
                    Diagnostic::error("E0101", message).label(expr.span, unit.to_string())
                };
                diagnostics.push(error);
                return None;
            }
            if let Some(declared) = declared.as_ref().filter(|_| bare && *value != 0.0 && turns::scaled(wanted)) {
                let text = value.to_string();
                diagnostics.push(turns::bare_angle((&text, *value, expr.span), wanted, declared.span));
            } else if let Some(declared) = declared.as_ref().filter(|_| turns::apart(&unit, wanted)) {
                let message = format!("{unit} and {wanted} are a factor 2π apart");
                let warning =
                    Diagnostic::warning("W0107", message).label(expr.span, "both are 1/s: no factor is applied");
                diagnostics
                    .push(warning.label(declared.span, "declared here").help("write all numbers in the same unit"));
            }
            Some(unit.to_si(*value))
        }
        _ => {
            let error = Diagnostic::error("E0902", "points of a table are numbers").label(expr.span, "not a number");
            diagnostics.push(error.help("write a number with its unit; a formula belongs into a `fn`"));
            None
        }
    }
}
