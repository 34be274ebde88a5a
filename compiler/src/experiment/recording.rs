//! The recording of an experiment or a fit: its columns as tables over time.

use crate::frontend::columns::Selector as Column;
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use crate::frontend::system::Table;
use crate::frontend::tables::columns as columns_of;
use abi::unit::{Dimension, Unit};
use grammar::ast;
use grammar::diagnostic::Diagnostic;
use grammar::span::FileId;
use std::sync::Arc;

/// Columns of a recording as tables over time. Those of steady points have no times yet.
pub(super) fn recording(
    loaded: &Loaded,
    sources: &dyn Sources,
    root: FileId,
    data: &ast::Data,
    steady: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Vec<(String, Table, Unit)>> {
    let time = data.columns.iter().position(|column| column.name.text == "t");
    if time.is_none() && !steady {
        let error = Diagnostic::error("E0903", "a recording needs a column `t`").label(data.span, "no column is time");
        let help =
            "name the columns in the order of the file or by their headings, as in `(t [s], x [mm] = \"Position\")`";
        diagnostics.push(error.help(help));
        return None;
    }
    let mut wanted = Vec::new();
    for (k, column) in data.columns.iter().enumerate() {
        let name = column.name.text.as_str();
        let twin = data.columns[..k].iter().find(|other| other.name.text == name && name != "_");
        if let Some(twin) = twin {
            let error = Diagnostic::error("E0903", format!("two columns are called `{name}`"))
                .label(column.name.span, "again here")
                .label(twin.name.span, "first here");
            diagnostics.push(error.help("name a column that is not used `_`"));
            return None;
        }
        let unit = match column.unit.as_ref().map(|text| (text, Unit::parse(&text.text))) {
            None => None,
            Some((_, Ok(unit))) => Some(unit),
            Some((text, Err(part))) => {
                let error = Diagnostic::error("E0102", format!("unknown unit `{part}`"));
                diagnostics.push(error.label(text.span, "not known"));
                return None;
            }
        };
        let one = match &column.heading {
            Some(heading) => Column::Headed(&heading.text),
            None if name == "_" => Column::Unused,
            None => Column::Named(name),
        };
        wanted.push((one, unit));
    }
    let mut values = columns_of(loaded, sources, root, &data.file, &wanted, diagnostics)?;
    let seconds = Dimension::of([0, 0, 1, 0, 0]);
    let t = match time {
        Some(time) => times(data, (time, &values[time].0, &values[time].1), diagnostics)?,
        None => Arc::from([]),
    };
    let named = data.columns.iter().zip(values.drain(..)).filter(|(column, _)| column.name.text != "_");
    let table = |(column, (y, unit)): (&ast::Column, (Vec<f64>, Unit))| {
        let name = column.name.text.clone();
        let table = Table {
            name: format!("data.{name}"),
            x_unit: Unit::si(seconds),
            y_unit: unit.clone(),
            smooth: false,
            held: column.hold,
            x: t.clone(),
            y: y.into(),
        };
        (name, table, unit)
    };
    Some(named.map(table).collect())
}

/// The times of a recording in s, from the column with this number; they increase.
fn times(
    data: &ast::Data,
    (at, t, unit): (usize, &[f64], &Unit),
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Arc<[f64]>> {
    if unit.dimension != Dimension::of([0, 0, 1, 0, 0]) {
        let column = &data.columns[at];
        let is = if unit.dimension.is_none() { "no unit".to_string() } else { format!("{unit}") };
        let error = Diagnostic::error("E0903", "the column `t` of a recording is a time").label(column.name.span, is);
        diagnostics.push(error.help("write its unit, as in `t [s]` or `t [ms]`"));
        return None;
    }
    if let Some(row) = (1..t.len()).find(|&row| t[row].partial_cmp(&t[row - 1]) != Some(std::cmp::Ordering::Greater)) {
        let shown = |t: f64| format!("{} {unit}", unit.from_si(t));
        let label = format!("row {}: {} after {}", row + 1, shown(t[row]), shown(t[row - 1]));
        let error = Diagnostic::error("E0903", "the times of a recording must increase").label(data.file.span, label);
        diagnostics.push(error.help("is `t` the column that was meant? Sort the rows, and keep one for each time"));
        return None;
    }
    Some(t.into())
}
