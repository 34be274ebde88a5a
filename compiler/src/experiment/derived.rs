//! Columns of a recording that are computed from its others: `let data.v = slope(smooth(data.x, 60 Hz))`.
//!
//! In: the columns of the file, and expressions. Out: further columns. An expression is flattened and checked as any
//! other and computed row by row. Before that, each `smooth` and `slope` in it becomes a column, from the inside out.

use crate::experiment::filters::{self, LowPass};
use crate::frontend::flatten::{Instance, Request, flatten};
use crate::frontend::resolve::{Loaded, Lookup, Space};
use crate::frontend::source::Sources;
use crate::frontend::system::*;
use crate::ir::interpret::Interpreter;
use crate::lower::{ParamValue, of_params};
use crate::pipeline::{Depth, analyse};
use abi::format::duration;
use abi::table::Interpret;
use abi::unit::{Dimension, Unit};
use abi::{Function, Slot};
use grammar::ast::{self, Expr, ExprKind};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use std::sync::Arc;

/// Columns of a recording: name, numbers over time in SI, and the unit for display.
type Columns = Vec<(String, Table, Unit)>;

/// Appends computed columns, in any order of their definitions. `steady`: the rows are steady points, without time.
/// Returns `None` after it has reported an error.
pub fn derive(
    (loaded, sources, root): (&Loaded, &dyn Sources, FileId),
    definitions: &[&ast::Derived],
    data: &mut Columns,
    steady: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<()> {
    for (k, one) in definitions.iter().enumerate() {
        let name = &one.name.text;
        let twin = definitions[..k].iter().find(|other| other.name.text == *name);
        if twin.is_some() || data.iter().any(|(other, ..)| other == name) || name == "t" {
            let error = Diagnostic::error("E0903", format!("two columns are called `{name}`"));
            let error = error.label(one.name.span, if twin.is_some() { "again here" } else { "also in the file" });
            let error = twin.iter().fold(error, |error, twin| error.label(twin.name.span, "first here"));
            diagnostics.push(error.help(match name.as_str() {
                "t" => "times come from the file: name its column of times `t`, with its unit",
                _ => "give this one another name",
            }));
            return None;
        }
    }
    let mut waiting: Vec<&ast::Derived> = definitions.to_vec();
    while !waiting.is_empty() {
        let is_ready = |one: &ast::Derived| {
            !one.value
                .paths()
                .iter()
                .filter_map(|path| path.column())
                .any(|name| waiting.iter().any(|other| other.name.text == name.text))
        };
        let Some(at) = waiting.iter().position(|one| is_ready(one)) else {
            let mut error = Diagnostic::error("E0903", "columns are computed from each other");
            for one in &waiting {
                error = error.label(one.name.span, "needs another of them");
            }
            diagnostics.push(error.help("compute one of them from the columns of the file"));
            return None;
        };
        let one = waiting.remove(at);
        let empty = ast::Model { name: one.name.clone(), body: Vec::new(), doc: None, span: one.span };
        let mut deriving = Deriving { loaded, sources, root, empty, data: data.clone(), steady, diagnostics };
        let (y, unit) = deriving.value(&one.value)?;
        if let Some(row) = y.iter().position(|value| !value.is_finite()) {
            let name = &one.name.text;
            let error = Diagnostic::error("E0903", format!("`data.{name}` is not a finite number in row {}", row + 1));
            let error = error.label(one.value.span, format!("{}", y[row]));
            diagnostics.push(error.help("write an expression that is finite for every row, or leave such rows out"));
            return None;
        }
        let x = times(data);
        data.push(column(&one.name.text, x, y, unit));
    }
    Some(())
}

/// The times of the rows, which all columns share.
fn times(data: &Columns) -> Arc<[f64]> {
    data.first().map_or(Arc::from([]), |(_, table, _)| table.x.clone())
}

fn column(name: &str, x: Arc<[f64]>, y: Vec<f64>, unit: Unit) -> (String, Table, Unit) {
    let y = y.into();
    let x_unit = Unit::si(Dimension::of([0, 0, 1, 0, 0]));
    let table = Table { name: format!("data.{name}"), x_unit, y_unit: unit.clone(), smooth: false, held: false, x, y };
    (name.to_string(), table, unit)
}

/// The computation of one column.
struct Deriving<'a> {
    loaded: &'a Loaded,
    sources: &'a dyn Sources,
    root: FileId,
    /// A model without anything, in whose scope expressions are read.
    empty: ast::Model,
    /// The columns known so far, with those of the filters in this expression.
    data: Columns,
    steady: bool,
    diagnostics: &'a mut Vec<Diagnostic>,
}

impl Deriving<'_> {
    fn report(&mut self, error: Diagnostic) -> Option<(Vec<f64>, Unit)> {
        self.diagnostics.push(error);
        None
    }

    /// The values of an expression in each row, in SI, and its unit.
    fn value(&mut self, expr: &Expr) -> Option<(Vec<f64>, Unit)> {
        let expr = self.without_filters(expr)?;
        if let ExprKind::Path(path) = &expr.kind
            && let [_, name] = &path.segments[..]
            && let Some((_, table, unit)) = self.data.iter().find(|(known, ..)| *known == name.name.text)
        {
            return Some((table.y.to_vec(), unit.clone()));
        }
        self.computed(&expr)
    }

    /// The expression with each filter in it replaced by a column.
    fn without_filters(&mut self, expr: &Expr) -> Option<Expr> {
        let kind = match &expr.kind {
            ExprKind::Call { function, args, window: None } if self.is_filter(function) => {
                let (y, unit) = self.filtered(function, args, expr.span)?;
                let name = format!("#{}", self.data.len());
                let x = times(&self.data);
                self.data.push(column(&name, x, y, unit));
                let segment = |text: &str| {
                    let name = ast::Name { text: text.to_string(), span: expr.span };
                    ast::Segment { name, index: None }
                };
                ExprKind::Path(ast::Path { segments: vec![segment("data"), segment(&name)], span: expr.span })
            }
            ExprKind::Call { function, args, window } => {
                let args: Option<Vec<Expr>> = args.iter().map(|arg| self.without_filters(arg)).collect();
                ExprKind::Call { function: function.clone(), args: args?, window: window.clone() }
            }
            ExprKind::Unary(op, a) => ExprKind::Unary(*op, self.boxed(a)?),
            ExprKind::Binary(op, span, a, b) => ExprKind::Binary(*op, *span, self.boxed(a)?, self.boxed(b)?),
            ExprKind::If(a, b, c) => ExprKind::If(self.boxed(a)?, self.boxed(b)?, self.boxed(c)?),
            ExprKind::Number { .. }
            | ExprKind::Path(_)
            | ExprKind::Derivative { .. }
            | ExprKind::Hole
            | ExprKind::Error => expr.kind.clone(),
        };
        Some(Expr { kind, span: expr.span })
    }

    fn boxed(&mut self, expr: &Expr) -> Option<Box<Expr>> {
        self.without_filters(expr).map(Box::new)
    }

    /// Whether a function is a filter, and none of the text.
    fn is_filter(&self, function: &ast::Name) -> bool {
        let is_own = matches!(self.loaded.find(self.root, Space::Function, &function.text), Lookup::Found(..));
        matches!(function.text.as_str(), "smooth" | "slope") && !is_own
    }

    /// What a filter makes of its argument.
    fn filtered(&mut self, function: &ast::Name, args: &[Expr], span: Span) -> Option<(Vec<f64>, Unit)> {
        let wanted = if function.text == "smooth" { 2 } else { 1 };
        if args.len() != wanted {
            let plural = if wanted == 1 { "" } else { "s" };
            let message = format!("`{}` takes {wanted} argument{plural}, not {}", function.text, args.len());
            let error = Diagnostic::error("E0207", message).label(function.span, format!("{} given", args.len()));
            return self.report(error.help("write `smooth(data.x, 60 Hz)` and `slope(data.x)`"));
        }
        let (x, unit) = self.value(&args[0])?;
        let times = times(&self.data);
        let interval = match equidistant(&times, self.steady, span) {
            Ok(interval) => interval,
            Err(error) => return self.report(error),
        };
        let pieces = filters::pieces(&times, interval);
        if wanted == 1 {
            let seconds = Dimension::of([0, 0, 1, 0, 0]);
            if let Some(piece) = pieces.iter().find(|piece| piece.len() == 1) {
                let message = format!("row {} stands alone between gaps", piece.start + 1);
                let error = Diagnostic::error("E0908", message).label(span, "no difference to another row");
                return self.report(error.help("leave the row out"));
            }
            let y = pieces.into_iter().flat_map(|piece| filters::slope(&x[piece], interval)).collect();
            return Some((y, Unit::si(unit.dimension.over(seconds))));
        }
        let corner = self.corner(&args[1], interval)?;
        let filter = LowPass::butterworth(2.0 * corner * interval);
        Some((pieces.into_iter().flat_map(|piece| filter.both_ways(&x[piece])).collect(), unit))
    }

    /// The corner of a low-pass in Hz, for rows at this interval in s.
    fn corner(&mut self, expr: &Expr, interval: f64) -> Option<f64> {
        let (values, unit) = self.value(expr)?;
        let rate = Dimension::of([0, 0, -1, 0, 0]);
        let what = "the corner of `smooth`";
        if unit.dimension != rate {
            let error = Diagnostic::error("E0101", format!("{what} is a frequency, not {}", unit.dimension.describe()));
            let error = error.label(expr.span, if unit.dimension.is_none() { "1".into() } else { unit.to_string() });
            self.report(error.help("write it in hertz: `smooth(data.x, 60 Hz)`"));
            return None;
        }
        let corner = values[0];
        let half = 0.5 / interval;
        let shown = |f: f64| format!("{} Hz", abi::format::three_digits(f));
        if !(corner > 0.0 && corner < half) || values.iter().any(|other| *other != corner) {
            let label = if values.iter().any(|other| *other != corner) {
                "not the same in each row".to_string()
            } else {
                format!("{}, with rows every {}", shown(corner), duration(interval, 3))
            };
            let message = format!("{what} lies between 0 and half the rate of the rows, {}", shown(half));
            self.report(
                Diagnostic::error("E0909", message)
                    .label(expr.span, label)
                    .help(format!("take a lower corner, such as `{}`", shown(0.2 * half))),
            );
            return None;
        }
        Some(corner)
    }

    /// An expression without filters, row by row.
    fn computed(&mut self, expr: &Expr) -> Option<(Vec<f64>, Unit)> {
        // One point stands for each column: flattening needs its unit only.
        let first =
            |(name, table, _): &(String, Table, Unit)| column(name, Arc::from([0.0]), vec![0.0], table.y_unit.clone());
        let request = Request {
            instance: Instance::Alone(&self.empty, self.root),
            overrides: Vec::new(),
            observed: vec![expr],
            data: self.data.iter().map(first).collect(),
            frame: None,
            unknowns: Vec::new(),
        };
        let flat = flatten(self.loaded, self.sources, &request);
        let (mut system, mut diagnostics) = (flat.system, flat.diagnostics);
        let Some(node) = flat.observed.first().copied().filter(|_| !diagnostics.iter().any(Diagnostic::is_error))
        else {
            self.diagnostics.extend(diagnostics);
            return None;
        };
        let params = self.readable(&mut system, expr.span);
        let types = analyse(&system, &self.loaded.files, Depth::Units, &Diagnostic::is_error, &mut diagnostics);
        let is_wrong = diagnostics.iter().any(Diagnostic::is_error);
        self.diagnostics.extend(diagnostics.into_iter().filter(Diagnostic::is_error));
        let dimension = types.nodes[node.0 as usize].filter(|_| !is_wrong)?;
        let (program, slots) = of_params(&system, &types, &[ParamValue::Expr(node)]);
        let layout = &program.description.layout;
        let pool = &program.description.pool;
        let func = crate::math::expand(&program.outputs);
        let code = Interpreter::new(&[(Function::Outputs, func)], layout, pool.len());
        let mut block = vec![0.0; layout.size()];
        let slot_of = |var: VarId| slots.iter().find(|(other, _)| *other == var).map(|(_, slot)| *slot);
        let reads: Vec<(Slot, &[f64])> =
            params.iter().filter_map(|(var, k)| Some((slot_of(*var)?, &self.data[*k].1.y[..]))).collect();
        let rows = self.data.first().map_or(0, |(_, table, _)| table.y.len());
        let result = layout.outputs.slot(0).index();
        let row = |k: usize| {
            for (slot, values) in &reads {
                block[slot.index()] = values[k];
            }
            code.call(Function::Outputs, &mut block, pool, 1);
            block[result]
        };
        Some(((0..rows).map(row).collect(), Unit::si(dimension)))
    }

    /// Makes the columns in a system parameters, and the time too: each row has values of its own. Returns the
    /// parameters with the numbers of their columns.
    fn readable(&self, system: &mut System, span: Span) -> Vec<(VarId, usize)> {
        let mut params: Vec<(VarId, usize)> = Vec::new();
        for at in 0..system.nodes.len() {
            let k = match &system.nodes[at] {
                Node::Table(table, _) if (*table as usize) < self.data.len() => *table as usize,
                Node::Time => match self.data.iter().position(|(name, ..)| name == "t") {
                    Some(k) => k,
                    None => continue,
                },
                _ => continue,
            };
            let known = params.iter().find(|(_, other)| *other == k).map(|(var, _)| *var);
            let var = known.unwrap_or_else(|| {
                let (name, table, _) = &self.data[k];
                let unit = &table.y_unit;
                let number = Node::Number { value: 0.0, dimension: Some(unit.dimension), angle: unit.angle };
                let value = system.push(number, span);
                let var = VarId(system.vars.len() as u32);
                system.vars.push(Var {
                    path: format!("data.{name}"),
                    name: name.clone(),
                    span,
                    instance: InstanceId(0),
                    kind: VarKind::Param,
                    unit: Some((unit.clone(), span)),
                    unreadable: false,
                    shown: None,
                    range: VarRange::default(),
                    range_span: None,
                    definition: Definition::Value(value, Origin::Default),
                    doc: None,
                });
                params.push((var, k));
                var
            });
            system.nodes[at] = Node::Var(var);
        }
        params
    }
}

/// The interval of rows in s that are equidistant but for gaps, for a filter at this place.
///
/// # Errors
/// E0908.
pub fn equidistant(times: &[f64], steady: bool, span: Span) -> Result<f64, Diagnostic> {
    if steady || times.len() < 2 {
        let message = "a filter needs rows over time";
        let label = if steady { "steady points have no time" } else { "one row" };
        let error = Diagnostic::error("E0908", message).label(span, label);
        return Err(error.help("name the column of times `t`, or leave the filter out"));
    }
    filters::interval(times).map_err(|filters::Uneven { shortest, longest }| {
        let shown = |(interval, row): (f64, usize)| format!("{} before row {}", duration(interval, 3), row + 1);
        Diagnostic::error("E0908", "a filter needs equidistant rows")
            .label(span, format!("{}, {}", shown(shortest), shown(longest)))
            .help("record at a fixed rate, or resample the recording first")
    })
}
