//! Reads tables: listed points, or two columns of a file.

use crate::resolve::Loaded;
use crate::source::Sources;
use crate::system::Table;
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, Expr, ExprKind, TablePoints, TableShape, UnaryOp};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};

/// The table of an item; nothing if something is wrong with it, which is reported.
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
                x.push(number(a, x_unit.dimension, diagnostics)?);
                y.push(number(b, y_unit.dimension, diagnostics)?);
                check_order(&x, a.span, diagnostics)?;
            }
        }
        TablePoints::File(path) => {
            let columns = columns(loaded, sources, file, path, &[true, true], diagnostics)?;
            x.extend(columns[0].iter().map(|value| value * x_unit.scale));
            y.extend(columns[1].iter().map(|value| value * y_unit.scale));
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
        x_dimension: x_unit.dimension,
        y_dimension: y_unit.dimension,
        smooth: table.shape == TableShape::Smooth,
        x,
        y,
    })
}

/// The first columns of a file of numbers, as many as `wanted` has entries; those not wanted may hold anything and are
/// read as 0. Columns are separated by commas, semicolons, tabs or blanks. A first line that
/// is no numbers is a heading; lines that begin with `#` are comments.
pub fn columns(
    loaded: &Loaded,
    sources: &dyn Sources,
    file: FileId,
    path: &ast::Text,
    wanted: &[bool],
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Vec<Vec<f64>>> {
    let count = wanted.len();
    let from = &loaded.files.get(file).name;
    let text = match sources.file(from, &path.text) {
        Ok((_, text)) => text,
        Err(reason) => {
            let error = Diagnostic::error("E0903", format!("cannot read \"{}\"", path.text)).label(path.span, reason);
            diagnostics.push(error.help("the path is relative to the file that names it"));
            return None;
        }
    };
    let mut out = vec![Vec::new(); count];
    for (row, line) in text.lines().enumerate() {
        let line = line.trim().trim_start_matches('\u{feff}');
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let fields: Vec<&str> = match line.contains([',', ';', '\t']) {
            true => line.split([',', ';', '\t']).map(str::trim).collect(),
            false => line.split_whitespace().collect(),
        };
        let number = |(k, field): (usize, &&str)| match wanted.get(k) {
            Some(true) => field.trim_matches('"').parse().ok().filter(|x: &f64| x.is_finite()),
            Some(false) | None => Some(0.0),
        };
        let numbers: Option<Vec<f64>> = fields.iter().enumerate().map(number).collect();
        match numbers {
            Some(numbers) if numbers.len() >= count => {
                out.iter_mut().zip(numbers).for_each(|(column, number)| column.push(number));
            }
            None if row == 0 => {}
            found => {
                let what = match found {
                    Some(numbers) => format!("line {} has {} columns, {count} are needed", row + 1, numbers.len()),
                    None => format!("line {} has something that is no finite number", row + 1),
                };
                let error = Diagnostic::error("E0903", format!("\"{}\" does not fit", path.text)).label(path.span, what);
                diagnostics.push(error);
                return None;
            }
        }
    }
    if out[0].is_empty() {
        let error = Diagnostic::error("E0902", format!("\"{}\" has no rows", path.text)).label(path.span, "empty");
        diagnostics.push(error);
        return None;
    }
    Some(out)
}

fn check_order(x: &[f64], span: Span, diagnostics: &mut Vec<Diagnostic>) -> Option<()> {
    match x {
        [.., a, b] if a.partial_cmp(b) != Some(std::cmp::Ordering::Less) => {
            let error = Diagnostic::error("E0902", "the arguments of a table must increase").label(span, "not above the one before");
            diagnostics.push(error.help("sort the points, and keep one for each argument"));
            None
        }
        _ => Some(()),
    }
}

/// A literal of this dimension, SI.
fn number(expr: &Expr, dimension: Dimension, diagnostics: &mut Vec<Diagnostic>) -> Option<f64> {
    match &expr.kind {
        ExprKind::Unary(UnaryOp::Negate, a) => Some(-number(a, dimension, diagnostics)?),
        ExprKind::Number { value, unit } => {
            let unit = match unit {
                None => Unit::none(),
                Some(text) => match Unit::parse(&text.text) {
                    Ok(unit) => unit,
                    Err(part) => {
                        let error = Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(text.span, "not known");
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
            Some(value * unit.scale)
        }
        _ => {
            let error = Diagnostic::error("E0902", "points of a table are numbers").label(expr.span, "not a number");
            diagnostics.push(error.help("write a number with its unit; a formula belongs into a `fn`"));
            None
        }
    }
}
