//! The experiment that a fit runs, as a syntax tree.
//!
//! In: a fit's syntax tree. Out: its statements as an experiment, with a plot of what is compared, the method that suits
//! its recording, and steady points as a recording over time.

use crate::frontend::flatten::Declared;
use crate::frontend::literals::quantity;
use crate::frontend::system::Table;
use abi::plan::Method;
use abi::unit::Unit;
use grammar::ast::{self, BinaryOp, ExperimentStatement, Expr, ExprKind, FitStatement};
use grammar::diagnostic::Diagnostic;
use std::sync::Arc;

/// What an item of `minimise` compares.
#[derive(Clone, Copy)]
pub struct Compared<'a> {
    /// The difference.
    pub of: &'a Expr,
    /// The standard deviation of the measurement.
    pub sd: Option<&'a Expr>,
    /// `thin(e, n)`: of so many rows one is kept.
    pub thin: Option<&'a Expr>,
}

/// `rms(e)`, `rms(thin(e, n))`, or either divided by a deviation.
pub fn compared(item: &Expr) -> Option<Compared<'_>> {
    match &item.kind {
        ExprKind::Call { function, args, window: None } if function.text == "rms" && args.len() == 1 => {
            Some(match &args[0].kind {
                ExprKind::Call { function, args, window: None } if function.text == "thin" && args.len() == 2 => {
                    Compared { of: &args[0], sd: None, thin: Some(&args[1]) }
                }
                _ => Compared { of: &args[0], sd: None, thin: None },
            })
        }
        ExprKind::Binary(BinaryOp::Divide, _, left, right) => match compared(left)? {
            whole @ Compared { sd: None, .. } => Some(Compared { sd: Some(right), ..whole }),
            Compared { sd: Some(_), .. } => None,
        },
        _ => None,
    }
}

/// The measure of an item over time: without a filter, and without the deviation by which it is divided.
fn measure(item: &Expr, of: &Expr) -> Expr {
    let name = ast::Name { text: "rms".into(), span: item.span };
    Expr { kind: ExprKind::Call { function: name, args: vec![of.clone()], window: None }, span: item.span }
}

/// A run of a fit: one of its cases, with one of its recordings.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Part {
    /// Index of the case; 0 of a fit without cases.
    pub case: usize,
    /// Index of the recording of the case.
    pub recording: usize,
    /// The recording is one of those that are judged and not fitted.
    pub judged: bool,
    /// Index of the combination of the sweeps of the fit.
    pub alternative: usize,
}

/// The cases of a fit.
pub fn cases(fit: &ast::Fit) -> impl Iterator<Item = &ast::FitCase> {
    fit.body.iter().filter_map(|statement| match statement {
        FitStatement::Case(case) => Some(case),
        FitStatement::Experiment(_)
        | FitStatement::Vary(..)
        | FitStatement::Minimise(_)
        | FitStatement::Validate(..) => None,
    })
}

/// The statements of one case, together with those that all cases share.
fn statements(fit: &ast::Fit, case: usize) -> impl Iterator<Item = &FitStatement> {
    let own = cases(fit).nth(case).map_or(&[][..], |case| &case.body);
    fit.body.iter().filter(|statement| !matches!(statement, FitStatement::Case(_))).chain(own)
}

/// The recordings of a case, as written.
pub fn recordings(fit: &ast::Fit, case: usize) -> Vec<ast::Text> {
    let data = statements(fit, case).find_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Data(data)) => Some(data),
        _ => None,
    });
    data.map_or(Vec::new(), |data| std::iter::once(&data.file).chain(&data.more).cloned().collect())
}

/// The recordings of a case that are judged and not fitted.
pub fn judged(fit: &ast::Fit, case: usize) -> Vec<ast::Text> {
    let files = statements(fit, case).flat_map(|statement| match statement {
        FitStatement::Validate(files, _) => &files[..],
        FitStatement::Experiment(_) | FitStatement::Vary(..) | FitStatement::Minimise(_) | FitStatement::Case(_) => &[],
    });
    files.cloned().collect()
}

/// The runs of a fit against recordings that are not fitted.
pub fn judgements(fit: &ast::Fit) -> Vec<Part> {
    let of = |case| {
        (0..judged(fit, case).len()).map(move |recording| Part { case, recording, judged: true, alternative: 0 })
    };
    (0..cases(fit).count().max(1)).flat_map(of).collect()
}

/// The runs of a fit; at least one for each case. `given`: files that replace its recordings.
pub fn runs(fit: &ast::Fit, given: &[String]) -> Vec<Part> {
    let recordings = |case| if given.is_empty() { recordings(fit, case).len() } else { given.len() };
    let of = |case| (0..recordings(case).max(1)).map(move |recording| Part { case, recording, ..Part::default() });
    (0..cases(fit).count().max(1)).flat_map(of).collect()
}

/// A fit with one run: without cases, and with one recording. It has the name of its case.
pub fn single(fit: &ast::Fit, part: &Part, given: &[String]) -> ast::Fit {
    let file = |data: &ast::Data| {
        let all = std::iter::once(&data.file).chain(&data.more).collect::<Vec<_>>();
        if part.judged {
            return judged(fit, part.case)[part.recording].clone();
        }
        match given.get(part.recording) {
            Some(other) => ast::Text { text: other.clone(), ..data.file.clone() },
            None => (*all.get(part.recording).unwrap_or(&all[0])).clone(),
        }
    };
    let one = |statement: &FitStatement| match statement {
        FitStatement::Experiment(ExperimentStatement::Data(data)) => {
            let data = ast::Data { file: file(data), more: Vec::new(), ..data.clone() };
            FitStatement::Experiment(ExperimentStatement::Data(data))
        }
        other => other.clone(),
    };
    let name = cases(fit).nth(part.case).map_or(&fit.name, |case| &case.name).clone();
    ast::Fit { name, body: statements(fit, part.case).map(one).collect(), ..fit.clone() }
}

/// Unknowns that the arguments of `run` name: they are no parameters of the instance, but of the fit.
pub fn own_unknowns(fit: &ast::Fit) -> Vec<&ast::Vary> {
    let run = fit.body.iter().find_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Run(run)) => Some(&run.instance),
        _ => None,
    });
    let Some(run) = run else { return Vec::new() };
    let all = fit.body.iter().flat_map(|statement| match statement {
        FitStatement::Vary(all, _) => &all[..],
        FitStatement::Experiment(_)
        | FitStatement::Minimise(_)
        | FitStatement::Case(_)
        | FitStatement::Validate(..) => &[],
    });
    let is_own = |vary: &&ast::Vary| {
        let name = vary.path.single().filter(|_| !vary.initial);
        name.is_some_and(|name| {
            run.paths().iter().any(|path| path.single().is_some_and(|other| other.text == name.text))
        })
    };
    all.filter(is_own).collect()
}

/// The path of an unknown of the fit itself. No declared parameter can have such a name.
pub fn own_path(name: &str) -> String {
    format!("{name}(fit)")
}

/// Unknowns of the fit itself as flattening declares them: name, path, unit and value in SI.
pub fn declared(unknowns: &[&ast::Vary], diagnostics: &mut Vec<Diagnostic>) -> Vec<Declared> {
    let one = |vary: &&ast::Vary| {
        let low = match &vary.range {
            Some(ast::Range::Between(low, _)) => Some(low),
            Some(ast::Range::Bound(..)) | None => None,
        };
        let unit = low.into_iter().chain(&vary.start).find_map(quantity).map(|(_, unit, _)| unit);
        let value = vary.start.iter().chain(low).find_map(quantity).map(|(value, _, _)| value);
        if unit.is_none() {
            let error = Diagnostic::error("E0904", format!("`{}` has no range", vary.path.segments[0].name.text));
            let error = error.label(vary.path.span, "from where to where?");
            diagnostics.push(error.help("an unknown of the fit itself needs its own: `vary F0 in -1 N .. 1 N`"));
        }
        let name = vary.path.segments[0].name.clone();
        // Without a unit it fits everything, so that one mistake yields one message.
        Declared { path: own_path(&name.text), name, unit, value: value.unwrap_or(0.0) }
    };
    unknowns.iter().map(one).collect()
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
            FitStatement::Vary(..) | FitStatement::Case(_) | FitStatement::Validate(..) => {}
            FitStatement::Minimise(minimise) => {
                for item in &minimise.items {
                    let Some(Compared { of, .. }) = compared(item) else { continue };
                    curves.push(show(of));
                    curves.extend(sides(of).into_iter().flatten().map(show));
                    measures.push(ExperimentStatement::Expect(ast::Expect {
                        value: measure(item, of),
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
    instance.paths().iter().any(|path| path.column().is_some())
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
/// the first column. Returns the instants at which they are compared, in s: the ends of the holds; and the row of each point.
pub fn hold(data: &mut [(String, Table, Unit)]) -> (Vec<f64>, Vec<usize>) {
    let Some((_, first, _)) = data.first() else { return (Vec::new(), Vec::new()) };
    let mut order: Vec<usize> = (0..first.y.len()).collect();
    order.sort_by(|a, b| first.y[*a].total_cmp(&first.y[*b]));
    let begins = |k: usize| k as f64 * (HELD + PASSAGE);
    let n = order.len();
    let x: Arc<[f64]> = (0..n).flat_map(|k| [begins(k), begins(k) + HELD]).collect();
    for (_, table, _) in data {
        table.x = x.clone();
        table.y = order.iter().flat_map(|k| [table.y[*k]; 2]).collect();
    }
    ((0..n).map(|k| begins(k) + HELD).collect(), order)
}

/// The times at which the recorded inputs of a run have corners.
pub fn corners(rows: &Arc<[f64]>, steady: bool) -> Arc<[f64]> {
    match steady {
        true => rows.iter().flat_map(|t| [*t, t + PASSAGE]).collect(),
        false => rows.clone(),
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
