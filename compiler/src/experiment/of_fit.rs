//! The experiment that a fit runs, as a syntax tree.
//!
//! In: a fit's syntax tree. Out: its statements as an experiment, with a plot of what is compared, the method that suits
//! its recording, and steady points as a recording over time.

use crate::frontend::system::Table;
use abi::plan::Method;
use abi::unit::Unit;
use grammar::ast::{self, BinaryOp, ExperimentStatement, Expr, ExprKind, FitStatement};

/// `rms(e)` or `rms(e) / s`: e and s.
pub fn compared(item: &Expr) -> Option<(&Expr, Option<&Expr>)> {
    match &item.kind {
        ExprKind::Call { function, args, window: None } if function.text == "rms" && args.len() == 1 => {
            Some((&args[0], None))
        }
        ExprKind::Binary(BinaryOp::Divide, _, left, right) => match compared(left)? {
            (of, None) => Some((of, Some(right))),
            _ => None,
        },
        _ => None,
    }
}

/// The measure of an item, without the deviation by which it is divided.
fn measure(item: &Expr) -> &Expr {
    match &item.kind {
        ExprKind::Binary(BinaryOp::Divide, _, left, _) => left,
        _ => item,
    }
}

/// The experiment that a fit runs. Its last plot holds the compared differences, each followed by its two sides; its
/// last expectations show the compared measures, without their window.
pub fn experiment_of(fit: &ast::Fit) -> ast::Experiment {
    let mut body: Vec<ExperimentStatement> = Vec::new();
    let (mut curves, mut measures) = (Vec::new(), Vec::new());
    let show = |value: &Expr| {
        let show = ast::Show { value: value.clone(), unit: None, span: value.span };
        ast::Curve { show, label: None, range: None, log: false }
    };
    for statement in &fit.body {
        match statement {
            FitStatement::Experiment(one) => body.push(one.clone()),
            FitStatement::Vary(..) => {}
            FitStatement::Minimise(minimise) => {
                for item in &minimise.items {
                    let Some((of, _)) = compared(item) else { continue };
                    curves.push(show(of));
                    curves.extend(sides(of).into_iter().flatten().map(show));
                    measures.push(ExperimentStatement::Expect(ast::Expect {
                        value: measure(item).clone(),
                        near: None,
                        shows: Some(None),
                        after: None,
                        before: None,
                        cases: Vec::new(),
                        span: item.span,
                    }));
                }
            }
        }
    }
    body.extend(measures);
    body.push(ExperimentStatement::Plot(ast::Plot {
        curves,
        against: None,
        after: None,
        before: None,
        title: None,
        span: fit.span,
    }));
    ast::Experiment { name: fit.name.clone(), body, doc: fit.doc.clone(), span: fit.span }
}

/// Both sides of a difference.
pub fn sides(of: &Expr) -> Option<[&Expr; 2]> {
    match &of.kind {
        ExprKind::Binary(BinaryOp::Subtract, _, left, right) => Some([left, right]),
        _ => None,
    }
}

/// Whether an argument of an instance, or of an instance in it, reads the recording.
pub fn reads_recording(instance: &ast::Instance) -> bool {
    instance.args.iter().any(|bind| match &bind.value {
        ast::BindValue::Expr(expr) => reads(expr),
        ast::BindValue::Instance(instance) => reads_recording(instance),
    })
}

fn reads(expr: &Expr) -> bool {
    match &expr.kind {
        ExprKind::Path(path) => path.segments.len() > 1 && path.segments[0].name.text == "data",
        ExprKind::Call { args, .. } => args.iter().any(reads),
        ExprKind::Unary(_, a) => reads(a),
        ExprKind::Binary(_, _, a, b) => reads(a) || reads(b),
        ExprKind::If(a, b, c) => reads(a) || reads(b) || reads(c),
        ExprKind::Number { .. } | ExprKind::Derivative { .. } | ExprKind::Hole | ExprKind::Error => false,
    }
}

/// The interval of rows in s, if all have the same to a thousandth of it.
pub fn interval(rows: &[f64]) -> Option<f64> {
    let (first, last) = (rows.first()?, rows.last()?);
    let interval = (last - first) / (rows.len() - 1) as f64;
    let even = |(k, t): (usize, &f64)| (t - first - k as f64 * interval).abs() <= 1e-3 * interval;
    (rows.len() > 1 && interval > 0.0 && rows.iter().enumerate().all(even)).then_some(interval)
}

/// Whether a recording consists of steady points: no column is time.
pub fn is_steady(data: &ast::Data) -> bool {
    data.columns.iter().all(|column| column.name.text != "t")
}

/// For how many seconds a steady point is held, so that a model settles: presliding over 10 µm at 1 nm/s takes 10,000 s.
pub const HELD: f64 = 1e4;
/// Seconds from one steady point to the next.
const PASSAGE: f64 = 1.0;

/// Makes steady points a recording over time: each is held until a model has settled, then the next, in rising order of
/// the first column. Returns the instants at which they are compared, in s: the ends of the holds.
pub fn hold(data: &mut [(String, Table, Unit)]) -> Vec<f64> {
    let Some((_, first, _)) = data.first() else { return Vec::new() };
    let mut order: Vec<usize> = (0..first.y.len()).collect();
    order.sort_by(|a, b| first.y[*a].total_cmp(&first.y[*b]));
    let begins = |k: usize| k as f64 * (HELD + PASSAGE);
    let n = order.len();
    for (_, table, _) in data {
        table.x = (0..n).flat_map(|k| [begins(k), begins(k) + HELD]).collect();
        table.y = order.iter().flat_map(|k| [table.y[*k]; 2]).collect();
    }
    (0..n).map(|k| begins(k) + HELD).collect()
}

/// The times at which the recorded inputs of a run have corners.
pub fn corners(rows: &[f64], steady: bool) -> Vec<f64> {
    match steady {
        true => rows.iter().flat_map(|t| [*t, t + PASSAGE]).collect(),
        false => rows.to_vec(),
    }
}

/// The method of a fit whose text names none: for a run that the recording drives, `expo` with a step for each row, if
/// the rows are equidistant; else adaptive, and so for steady points.
pub fn default_solver(fit: &ast::Fit, rows: &[f64], steady: bool) -> (Method, Option<f64>, Option<f64>) {
    let driven = fit.body.iter().any(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Run(run)) => reads_recording(&run.instance),
        _ => false,
    });
    match interval(rows).filter(|_| driven && !steady) {
        Some(step) => (Method::Expo, Some(step), None),
        None => (Method::Adaptive, None, Some(1e-8)),
    }
}
