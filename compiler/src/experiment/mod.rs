//! Reads experiments: what to run and how, what to plot, and what must hold.
//!
//! In: an experiment's syntax tree and changes from outside. Out: one [`Variant`] for each combination of its sweeps: a
//! flat system, its program, and a plan that refers to slots only. Knows nothing of integration.

pub mod of_fit;
pub mod start_values;
pub mod vary;

use crate::analysis::linearise::{OpenPorts, PortSlots, Ports, open};
use crate::analysis::parameter_checks;
use crate::codegen::elementary::Alone;
use crate::frontend::columns::Selector as Column;
use crate::frontend::delays;
use crate::frontend::flatten::{Instance, Override, OverrideValue, Request, flatten};
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use crate::frontend::system::*;
use crate::frontend::tables::columns as columns_of;
use crate::frontend::units::Types;
use crate::ir::Binary;
use crate::lower::{Lowered, MOST_DENSE, Observed, evaluate, lower};
use crate::pipeline::{Depth, analyse};
use crate::rig::{self, LoadedRig};
use abi::plan::{self, Formula, MeasureKind, Method, PARTS, Solver};
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, BinaryOp, ExperimentStatement, Expr, Spacing, SweepOver};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use std::borrow::Cow;
use std::sync::Arc;

/// Changes to an experiment from outside.
#[derive(Clone, Debug, Default)]
pub struct Changes {
    /// `fr.Fs = 2 N`, as text.
    pub set: Vec<String>,
    /// Method that replaces that of the experiment.
    pub method: Option<Method>,
    /// Fixed step in s that replaces that of the experiment.
    pub step: Option<f64>,
    /// Tolerance that replaces that of the experiment.
    pub tol: Option<f64>,
    /// Duration in s that replaces that of the experiment.
    pub duration: Option<f64>,
    /// Paths of parameters, and of states for their start values, that vary from run to run without recompilation.
    pub vary: Vec<String>,
    /// Inputs and outputs of a linearisation.
    pub ports: Option<Ports>,
    /// Additional statements of the experiment, as text: `expect max(x) < 1 mm`.
    pub also: Vec<String>,
    /// Does not check whether the step is stable, for questions that do not run the experiment, and for a run that is
    /// only compared with it.
    pub any_step: bool,
    /// A file that replaces the recording of a fit, as an absolute path.
    pub data: Option<String>,
    /// Omits the experiment's own expectations. A question at the prompt does not judge the run, and a window of an
    /// expectation may lie beyond the compiled duration.
    pub unjudged: bool,
}

/// A number of a plan that an expression determines.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum PlanNumber {
    /// Duration of the run.
    Duration,
    /// Fixed step.
    Step,
    /// Tolerance of an adaptive run.
    Tolerance,
    /// Start of the window of this expectation.
    After(usize),
    /// End of the window of this expectation.
    Before(usize),
    /// Second argument of this measure of this expectation.
    Second(usize, usize),
    /// Start of the window of this measure of this expectation.
    MeasureAfter(usize, usize),
    /// End of the window of this measure of this expectation.
    MeasureBefore(usize, usize),
}

/// One combination of an experiment's sweeps, lowered.
pub struct Variant {
    /// `fr = LuGre()`; empty without a sweep.
    pub label: String,
    /// The flat system.
    pub system: System,
    /// Its types.
    pub types: Types,
    /// The lowered program.
    pub program: crate::ir::program::Program,
    /// For an experiment with fixed steps: its program for adaptive runs, if it has one.
    pub adaptive: Option<crate::ir::program::Program>,
    /// The plan of the run.
    pub experiment: plan::Experiment,
    /// Numbers of the plan that depend on expressions.
    pub places: Vec<(PlanNumber, ExprId)>,
    /// Inputs of a linearisation, each with the slot that perturbs it, and its outputs.
    pub ports: PortSlots,
    /// For software in the loop: the rig.
    pub rig: Option<SimulatedRig>,
    /// Of a fit: the times of the rows of its recording in s, from 0.
    pub rows: Vec<f64>,
    /// Of a fit: the time of the first row in the file, in s.
    pub begins: f64,
    /// Of a fit: its recording has no times; each row is a steady point.
    pub steady: bool,
}

/// A rig that an experiment runs against its own plant.
pub struct SimulatedRig {
    /// The plan of the rig.
    pub rig: abi::rig::Rig,
    /// The program of the part that hardware would replace.
    pub plant: crate::ir::program::Program,
    /// The rig before its programs, for checks of its steps.
    pub cut: rig::PartitionedRig,
}

/// Default tolerance of an adaptive run.
pub const DEFAULT_TOL: f64 = 1e-6;
/// Default step of a fixed-step method, in s.
pub const DEFAULT_STEP: f64 = 1e-5;
/// Limit on the number of fixed steps in a run.
const MOST_STEPS: f64 = 1e12;
/// Limit on the number of combinations of an experiment's sweeps.
pub const MOST_VARIANTS: usize = 100_000;

/// The statements of an experiment, by kind.
#[derive(Clone)]
struct Statements<'a> {
    span: Span,
    run: &'a ast::Run,
    solver: Option<&'a ast::Solver>,
    sweeps: Vec<&'a ast::Sweep>,
    data: Option<&'a ast::Data>,
    plots: Vec<&'a ast::Plot>,
    expects: Vec<&'a ast::Expect>,
    /// `allow discretisation`
    stepped: bool,
    /// Names of all lints that it allows.
    allowed: Vec<&'a str>,
}

/// A change by a sweep or from outside.
#[derive(Clone, Copy)]
struct Change<'a> {
    path: &'a ast::Path,
    value: OverrideValue<'a>,
}

/// Reads and lowers an experiment.
///
/// # Errors All errors; at least one.
pub fn read(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Vec<Variant>, Vec<Diagnostic>> {
    let mut diagnostics = Vec::new();
    let mut given = CommandLine::read(loaded, changes, &mut diagnostics);
    let also = also(loaded, &changes.also, &mut diagnostics);
    let root = loaded.root();
    let prepared = rig_of(loaded, sources, name, &given, &mut diagnostics)?;
    let loaded = &*loaded;
    let file = loaded.files.get(root);
    let mut fit = None;
    let found = file.ast.items().find_map(|item| match item {
        ast::Item::Experiment(experiment) if experiment.name.text == name => Some(Cow::Borrowed(experiment)),
        ast::Item::Fit(one) if one.name.text == name => {
            fit = Some(one);
            Some(Cow::Owned(of_fit::experiment_of(one)))
        }
        _ => None,
    });
    let Some(mut experiment) = found else {
        let error = Diagnostic::error("E0201", format!("there is no experiment `{name}`"));
        return Err(vec![error.label(Span::new(root, 0, 0), "in this file")]);
    };
    let misread = loaded.misread(experiment.span);
    if changes.unjudged {
        experiment.to_mut().body.retain(|statement| !matches!(statement, ExperimentStatement::Expect(_)));
    }
    if !also.is_empty() {
        experiment.to_mut().body.extend(also);
    }
    if let (Some(file), Some(_)) = (&changes.data, fit) {
        for statement in &mut experiment.to_mut().body {
            if let ExperimentStatement::Data(data) = statement {
                data.file.text.clone_from(file);
            }
        }
    }
    let experiment = &*experiment;
    // The missing `run` may be a misspelt word, which has been reported.
    let Some(mut parts) = parts(experiment, misread || loaded.has_errors(), &mut diagnostics) else {
        return Err(diagnostics);
    };
    // Changes from outside take precedence: a value that is set or varied there is not swept.
    let plain = |text: &str| text.split_whitespace().collect::<String>();
    let path = |path: &ast::Path| plain(loaded.files.slice(path.span));
    let said: Vec<String> =
        given.set.iter().map(|set| path(&set.path)).chain(given.vary.iter().map(|p| plain(p))).collect();
    parts.sweeps.retain(|sweep| !said.contains(&path(&sweep.path)));
    let steady = fit.is_some() && parts.data.is_some_and(of_fit::is_steady);
    let data =
        parts.data.map_or(Some(Vec::new()), |data| recording(loaded, sources, root, data, steady, &mut diagnostics));
    let Some(mut data) = data else { return Err(diagnostics) };
    let (mut rows, mut begins) = (Vec::new(), 0.0);
    if let (Some(fit), Some((_, first, _))) = (fit, data.first()) {
        if steady {
            rows = of_fit::hold(&mut data);
        } else {
            begins = first.x.first().copied().unwrap_or(0.0);
            rows = match of_fit::interval(&first.x) {
                // Rounded times are put on their grid.
                Some(interval) => (0..first.x.len()).map(|k| k as f64 * interval).collect(),
                None => first.x.iter().map(|t| t - begins).collect(),
            };
            data.iter_mut().for_each(|(_, table, _)| table.x.clone_from(&rows));
        }
        if parts.solver.is_none() && given.method.is_none() && given.step.is_none() {
            let (method, step, tol) = of_fit::default_solver(fit, &rows, steady);
            (given.method, given.step, given.tol) = (Some(method), step, given.tol.or(tol));
        }
    }
    let grids = grids(loaded, &parts, &mut diagnostics);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return Err(diagnostics);
    }
    let combinations = combinations(&parts, &grids);
    let unmatched = unmatched_cases(loaded, &parts, &combinations, &given);
    if !unmatched.is_empty() {
        return Err(unmatched);
    }
    if combinations.is_empty() || combinations.len() > MOST_VARIANTS {
        let span = parts.sweeps.first().map_or(experiment.span, |sweep| sweep.span);
        let message = match combinations.len() {
            0 => "this sweep is empty".to_string(),
            n => format!("{n} combinations are too many"),
        };
        let error = Diagnostic::error("E0902", message).label(span, "swept here");
        return Err(vec![error.help(format!("between 1 and {MOST_VARIANTS} combinations can be run"))]);
    }
    // Arguments of a rig are changes of the system that it runs.
    let path = |bind: &ast::Bind| ast::Path {
        segments: vec![ast::Segment { name: bind.name.clone(), index: None }],
        span: bind.span,
    };
    let args = prepared.as_ref().map_or(&[][..], |_| &parts.run.instance.args);
    let arg_paths: Vec<ast::Path> = args.iter().map(path).collect();
    let mut variants = Vec::new();
    for combination in combinations {
        let label = label(loaded, &combination);
        let applies = |expect: &&ast::Expect| {
            expect.cases.iter().all(|case| {
                let found = combination.iter().find(|(change, _)| same_path(change.path, &case.path));
                found.is_some_and(|(change, _)| meets(loaded, case, change.value))
                    || given.set.iter().any(|set| {
                        same_path(&set.path, &case.path) && meets(loaded, case, CommandLine::change(set).value)
                    })
            })
        };
        let mut parts = parts.clone();
        parts.expects.retain(applies);
        let parts = &parts;
        let changes = combination.iter().map(|(change, _)| *change).chain(given.set.iter().map(CommandLine::change));
        let written = arg_paths.iter().zip(args).map(|(path, bind)| {
            let value = match &bind.value {
                ast::BindValue::Expr(expr) => OverrideValue::Expr(expr),
                ast::BindValue::Instance(instance) => OverrideValue::Instance(instance),
            };
            Change { path, value }
        });
        let changes = written.chain(changes);
        let overrides = changes.map(|c| Override { path: c.path, value: c.value, file: root }).collect();
        match variant(
            loaded,
            sources,
            name,
            parts,
            prepared.as_ref(),
            &data,
            overrides,
            &given,
            label,
            warnings,
            on_stage,
        ) {
            Ok(variant) => variants.push(Variant { rows: rows.clone(), begins, steady, ..variant }),
            Err(errors) => return Err(errors),
        }
    }
    Ok(variants)
}

/// Additional statements of an experiment, each from a text of its own.
fn also(loaded: &mut Loaded, texts: &[String], diagnostics: &mut Vec<Diagnostic>) -> Vec<ExperimentStatement> {
    let mut out = Vec::new();
    for text in texts {
        let id = loaded.add_text("--also", text);
        let (statements, errors) = grammar::parse::parse_statements(id, text);
        out.extend(statements);
        diagnostics.extend(errors);
    }
    out
}

/// The changes of the command line, parsed.
struct CommandLine {
    set: Vec<Set>,
    method: Option<Method>,
    step: Option<f64>,
    tol: Option<f64>,
    duration: Option<f64>,
    vary: Vec<String>,
    ports: Option<Ports>,
}

/// `PATH = VALUE`
struct Set {
    path: ast::Path,
    expr: Option<Expr>,
    instance: Option<ast::Instance>,
}

/// Changes of values from outside, parsed.
pub struct Overrides(Vec<Set>);

impl Overrides {
    /// The changes one by one.
    pub fn iter(&self) -> impl Iterator<Item = ChangeOf<'_>> {
        self.0.iter().map(|set| ChangeOf(CommandLine::change(set)))
    }
}

/// One change of [`Overrides`].
pub struct ChangeOf<'a>(Change<'a>);

impl<'a> ChangeOf<'a> {
    /// The change as input of flattening; its value is read in the scope of this file.
    pub fn override_in(&self, file: FileId) -> Override<'a> {
        Override { path: self.0.path, value: self.0.value, file }
    }
}

/// Parses changes of values from outside.
pub fn overrides(loaded: &mut Loaded, changes: &Changes, diagnostics: &mut Vec<Diagnostic>) -> Overrides {
    Overrides(CommandLine::read(loaded, changes, diagnostics).set)
}

impl CommandLine {
    fn read(loaded: &mut Loaded, changes: &Changes, diagnostics: &mut Vec<Diagnostic>) -> CommandLine {
        let mut set = Vec::new();
        for text in &changes.set {
            let id = loaded.add_text("--set", text);
            match text.split_once('=') {
                Some((path, value)) if looks_like_instance(value) => {
                    // Parsed with blanks in place of the path, so that spans remain correct.
                    let (found, errors) = grammar::parse::parse_path(id, path);
                    diagnostics.extend(errors);
                    let blanks = " ".repeat(path.len() + 1);
                    let (instance, errors) = grammar::parse::parse_instance(id, &format!("{blanks}{value}"));
                    diagnostics.extend(errors);
                    if let (Some(path), Some(instance)) = (found, instance) {
                        set.push(Set { path, expr: None, instance: Some(instance) });
                    }
                }
                _ => {
                    let (setting, errors) = grammar::parse::parse_setting(id, text);
                    diagnostics.extend(errors);
                    if let Some((path, expr)) = setting {
                        set.push(Set { path, expr: Some(expr), instance: None });
                    }
                }
            }
        }
        let Changes { method, step, tol, duration, vary, ports, .. } = changes.clone();
        CommandLine { set, method, step, tol, duration, vary, ports }
    }

    fn change(set: &Set) -> Change<'_> {
        let value = match (&set.expr, &set.instance) {
            (_, Some(instance)) => OverrideValue::Instance(instance),
            (Some(expr), None) => OverrideValue::Expr(expr),
            (None, None) => unreachable!("a setting has a value"),
        };
        Change { path: &set.path, value }
    }
}

fn looks_like_instance(value: &str) -> bool {
    let value = value.trim_start().trim_start_matches("rotary ").trim_start();
    let name = value.trim_start_matches(|c: char| c.is_ascii_alphanumeric() || c == '_');
    value.starts_with(|c: char| c.is_ascii_uppercase()) && name.trim_start().starts_with('(')
}

fn parts<'a>(
    experiment: &'a ast::Experiment,
    misread: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Statements<'a>> {
    let mut run: Option<&ast::Run> = None;
    let mut parts = (None, Vec::new(), None, Vec::new(), Vec::new());
    let (mut stepped, mut allowed) = (false, Vec::new());
    let mut unknown = Vec::new();
    let mut twice = |what: &str, span: Span, first: Span| {
        let error = Diagnostic::error("E0301", format!("an experiment has one `{what}`"))
            .label(span, "again here")
            .label(first, "first here");
        diagnostics.push(error.help("remove one, or write another experiment"));
    };
    for statement in &experiment.body {
        match statement {
            ExperimentStatement::Run(one) => match run {
                Some(first) => twice("run", one.span, first.span),
                None => run = Some(one),
            },
            ExperimentStatement::Solver(one) => match parts.0 {
                Some(first) => twice("solver", one.span, std::convert::identity::<&ast::Solver>(first).span),
                None => parts.0 = Some(one),
            },
            ExperimentStatement::Sweep(one) => parts.1.push(one),
            ExperimentStatement::Data(one) => match parts.2 {
                Some(first) => twice("data", one.span, std::convert::identity::<&ast::Data>(first).span),
                None => parts.2 = Some(one),
            },
            ExperimentStatement::Plot(one) => parts.3.push(one),
            ExperimentStatement::Expect(one) => parts.4.push(one),
            ExperimentStatement::Allow(allow) => {
                let own = matches!(allow.lint.text.as_str(), "discretisation" | "recording-ends");
                stepped |= allow.lint.text == "discretisation";
                allowed.push(allow.lint.text.as_str());
                unknown.extend(unknown_lint(&allow.lint).filter(|_| !own));
            }
        }
    }
    diagnostics.extend(unknown);
    let Some(run) = run else {
        if misread {
            return None;
        }
        let error = Diagnostic::error("E0902", format!("experiment `{}` runs nothing", experiment.name.text))
            .label(experiment.name.span, "there is no `run` in it");
        diagnostics.push(error.help("add `run Model(…) for 10 s`"));
        return None;
    };
    let (solver, sweeps, data, plots, expects) = parts;
    Some(Statements { span: experiment.span, run, solver, sweeps, data, plots, expects, stepped, allowed })
}

/// Columns of a recording as tables over time. Those of steady points have no times yet.
fn recording(
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
        None => Vec::new(),
    };
    let named = data.columns.iter().zip(values.drain(..)).filter(|(column, _)| column.name.text != "_");
    let table = |(column, (y, unit)): (&ast::Column, (Vec<f64>, Unit))| {
        let name = column.name.text.clone();
        let table = Table {
            name: format!("data.{name}"),
            x_dimension: seconds,
            y_dimension: unit.dimension,
            smooth: false,
            x: t.clone(),
            y,
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
) -> Option<Vec<f64>> {
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
    Some(t.to_vec())
}

/// The values of each sweep over a grid, `first .. last by step`, as literals.
fn grids(loaded: &Loaded, parts: &Statements, diagnostics: &mut Vec<Diagnostic>) -> Vec<Vec<Expr>> {
    let mut out = Vec::new();
    for sweep in &parts.sweeps {
        let mut values = Vec::new();
        if let SweepOver::Grid { first, last, spacing } = &sweep.over {
            match grid(first, last, spacing) {
                Ok((numbers, unit)) => {
                    let literal = |value: f64| Expr {
                        kind: ast::ExprKind::Number { value, unit: unit.clone() },
                        span: first.span,
                    };
                    values.extend(numbers.into_iter().map(literal));
                }
                Err((message, help)) => {
                    let text = loaded.files.slice(sweep.span).lines().next().unwrap_or_default();
                    diagnostics.push(Diagnostic::error("E0902", message).label(sweep.span, text).help(help));
                }
            }
        }
        out.push(values);
    }
    out
}

/// The numbers of a grid in the unit of its first value, and that unit.
///
/// # Errors What is wrong with it, and how to write it.
type Grid = Result<(Vec<f64>, Option<ast::UnitText>), (&'static str, &'static str)>;

fn grid(first: &Expr, last: &Expr, spacing: &Spacing) -> Grid {
    const ENDS: (&str, &str) = (
        "a sweep goes from a number to a number by a positive step",
        "all three in units of one kind: `sweep fr.Fs = 1 N .. 2 N by 0.25 N`",
    );
    let (Some((a, unit, text)), Some((b, other, _))) = (quantity(first), quantity(last)) else { return Err(ENDS) };
    if unit.dimension != other.dimension {
        return Err(ENDS);
    }
    let (number, log) = match spacing {
        Spacing::By(step) => {
            let Some((h, third, _)) = quantity(step) else { return Err(ENDS) };
            if unit.dimension != third.dimension || h <= 0.0 {
                return Err(ENDS);
            }
            let count = ((b - a) / h + 1e-9).floor().clamp(-1.0, MOST_VARIANTS as f64) as i64;
            let value = |k: i64| rounded(unit.from_si(a + k as f64 * h));
            return Ok(((0..=count).map(value).collect(), text));
        }
        Spacing::Lin(number) => (number, false),
        Spacing::Log(number) => (number, true),
    };
    let count = quantity(number)
        .filter(|(n, unit, _)| unit.text.is_empty() && n.fract() == 0.0 && *n >= 2.0 && *n <= MOST_VARIANTS as f64);
    let Some((count, ..)) = count else {
        return Err(("the number of values is a whole number from 2 on", "write for example `1 N/s .. 50 N/s log 10`"));
    };
    if log && !(a * b > 0.0 && (b / a).is_finite()) {
        return Err((
            "a logarithmic grid has ends of one sign, and neither is 0",
            "write `lin` in place of `log`, or begin above 0",
        ));
    }
    let count = count as usize;
    Ok((spaced(count, a, b, log).into_iter().map(|value| rounded(unit.from_si(value))).collect(), text))
}

/// `count` numbers from `a` to `b`, both included: in equal ratios if `log`, else at equal distances.
pub fn spaced(count: usize, a: f64, b: f64, log: bool) -> Vec<f64> {
    let power = log.then(|| Alone::binary(Binary::Pow));
    let value = |k: usize| {
        let part = k as f64 / (count.max(2) - 1) as f64;
        match (k, &power) {
            (0, _) => a,
            (k, _) if k + 1 == count => b,
            (_, Some(power)) => a * power.of_both(b / a, part),
            (_, None) => a + (b - a) * part,
        }
    };
    (0..count).map(value).collect()
}

/// A number rounded to twelve digits, which removes the rounding errors of `a + k·h`.
fn rounded(x: f64) -> f64 {
    format!("{x:.11e}").parse().unwrap_or(x)
}

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

/// All combinations of the sweeps, the last sweep varying fastest, each with the text of its value.
fn combinations<'a>(parts: &Statements<'a>, grids: &'a [Vec<Expr>]) -> Vec<Vec<(Change<'a>, Option<String>)>> {
    let mut out: Vec<Vec<(Change<'a>, Option<String>)>> = vec![Vec::new()];
    for (sweep, grid) in parts.sweeps.iter().zip(grids) {
        let path = &sweep.path;
        let values: Vec<(Change<'a>, Option<String>)> = match &sweep.over {
            SweepOver::Instances(all) => {
                all.iter().map(|one| (Change { path, value: OverrideValue::Instance(one) }, None)).collect()
            }
            SweepOver::Values(all) => {
                all.iter().map(|one| (Change { path, value: OverrideValue::Expr(one) }, None)).collect()
            }
            SweepOver::Grid { .. } => grid
                .iter()
                .map(|one| {
                    let text = match &one.kind {
                        ast::ExprKind::Number { value, unit: Some(unit) } => format!("{value} {}", unit.text),
                        ast::ExprKind::Number { value, unit: None } => format!("{value}"),
                        _ => unreachable!("a grid holds numbers"),
                    };
                    (Change { path, value: OverrideValue::Expr(one) }, Some(text))
                })
                .collect(),
        };
        if out.len().saturating_mul(values.len()) > MOST_VARIANTS {
            return vec![Vec::new(); MOST_VARIANTS + 1];
        }
        out = out
            .iter()
            .flat_map(|before| {
                values
                    .iter()
                    .map(|value| before.iter().cloned().chain([value.clone()]).collect::<Vec<_>>())
                    .collect::<Vec<_>>()
            })
            .collect();
    }
    out
}

fn same_path(a: &ast::Path, b: &ast::Path) -> bool {
    let part = |segment: &ast::Segment| (segment.name.text.clone(), segment.index);
    a.segments.iter().map(part).eq(b.segments.iter().map(part))
}

/// Whether a value of a sweep is the one that a case names: the same number, or else the same text.
fn meets(loaded: &Loaded, case: &ast::Case, value: OverrideValue) -> bool {
    let plain = |span: Span| loaded.files.slice(span).split_whitespace().collect::<String>();
    match (&case.value, value) {
        (ast::BindValue::Expr(wanted), OverrideValue::Expr(value)) => match (quantity(wanted), quantity(value)) {
            (Some((a, unit, _)), Some((b, other, _))) => {
                unit.dimension == other.dimension && (a - b).abs() <= 1e-9 * a.abs().max(b.abs())
            }
            _ => plain(wanted.span) == plain(value.span),
        },
        (ast::BindValue::Instance(wanted), OverrideValue::Instance(value)) => plain(wanted.span) == plain(value.span),
        (ast::BindValue::Expr(_), OverrideValue::Instance(_))
        | (ast::BindValue::Instance(_), OverrideValue::Expr(_)) => false,
    }
}

/// Errors about expectations for a case that no sweep has. A value that is set or varied from outside replaces the sweep,
/// and the expectation then applies to that value or to none.
fn unmatched_cases(
    loaded: &Loaded,
    parts: &Statements,
    combinations: &[Vec<(Change, Option<String>)>],
    given: &CommandLine,
) -> Vec<Diagnostic> {
    let mut errors = Vec::new();
    for case in parts.expects.iter().flat_map(|expect| &expect.cases) {
        let text = loaded.files.slice(case.path.span);
        let outside = given.set.iter().any(|set| same_path(&set.path, &case.path))
            || given.vary.iter().any(|path| *path == text.split_whitespace().collect::<String>());
        if outside {
            continue;
        }
        let swept = || combinations.iter().flatten().filter(|(change, _)| same_path(change.path, &case.path));
        if swept().any(|(change, _)| meets(loaded, case, change.value)) {
            continue;
        }
        let mut values: Vec<String> = Vec::new();
        for (change, shown) in swept() {
            let value = shown.clone().unwrap_or_else(|| match change.value {
                OverrideValue::Expr(expr) => one_line(loaded.files.slice(expr.span)),
                OverrideValue::Instance(instance) => one_line(loaded.files.slice(instance.span)),
            });
            if !values.contains(&value) && values.len() < 12 {
                values.push(value);
            }
        }
        let (message, help) = match values.is_empty() {
            true => (
                format!("this experiment does not sweep `{text}`"),
                format!("`for` names a case of a sweep: add `sweep {text} = …`, or leave it out"),
            ),
            false => (
                format!("no case of the sweep is `{}`", one_line(loaded.files.slice(case.span))),
                format!("the sweep has {text} = {}", values.join(", ")),
            ),
        };
        errors.push(Diagnostic::error("E0902", message).label(case.span, "no such case").help(help));
    }
    errors
}

/// `fr = LuGre(), k = 2 N/m`
fn label(loaded: &Loaded, combination: &[(Change, Option<String>)]) -> String {
    let one = |(change, text): &(Change, Option<String>)| {
        let value = text.clone().unwrap_or_else(|| match change.value {
            OverrideValue::Expr(expr) => loaded.files.slice(expr.span).to_string(),
            OverrideValue::Instance(instance) => one_line(loaded.files.slice(instance.span)),
        });
        format!("{} = {value}", loaded.files.slice(change.path.span))
    };
    combination.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// The text on one line.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Indices of an expectation's expressions among the observed ones.
#[derive(Clone, Copy)]
struct ExpectAt {
    value: usize,
    near: Option<(usize, usize)>,
    after: Option<usize>,
    before: Option<usize>,
}

/// The same of a quantity of a plot.
struct CurveAt {
    value: usize,
    range: Option<(usize, usize)>,
}

#[allow(clippy::too_many_arguments)]
fn variant<'a>(
    loaded: &Loaded,
    sources: &dyn Sources,
    name: &str,
    parts: &Statements<'a>,
    prepared: Option<&LoadedRig>,
    data: &[(String, Table, Unit)],
    overrides: Vec<Override>,
    given: &CommandLine,
    label: String,
    warnings: &mut Vec<Diagnostic>,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Variant, Vec<Diagnostic>> {
    let root = loaded.root();
    // All expressions of the experiment are flattened together with the instance, then picked out by index.
    let mut observed: Vec<&Expr> = Vec::new();
    let mut add = |expr: &'a Expr| {
        observed.push(expr);
        observed.len() - 1
    };
    let duration = parts.run.duration.as_ref().map(&mut add);
    let step = parts.solver.and_then(|s| s.step.as_ref()).map(&mut add);
    let tol = parts.solver.and_then(|solver| solver.tol.as_ref()).map(&mut add);
    let mut curve = |curve: &'a ast::Curve| CurveAt {
        value: add(&curve.show.value),
        range: curve.range.as_ref().map(|(from, to)| (add(from), add(to))),
    };
    let plots: Vec<(Vec<CurveAt>, Option<CurveAt>)> = parts
        .plots
        .iter()
        .map(|plot| (plot.curves.iter().map(&mut curve).collect(), plot.against.as_ref().map(&mut curve)))
        .collect();
    let windows: Vec<(Option<usize>, Option<usize>)> = parts
        .plots
        .iter()
        .map(|plot| (plot.after.as_ref().map(&mut add), plot.before.as_ref().map(&mut add)))
        .collect();
    let expects: Vec<ExpectAt> = parts
        .expects
        .iter()
        .map(|expect| ExpectAt {
            value: add(&expect.value),
            near: expect.near.as_ref().map(|(target, tolerance)| (add(target), add(tolerance))),
            after: expect.after.as_ref().map(&mut add),
            before: expect.before.as_ref().map(&mut add),
        })
        .collect();
    on_stage("flatten");
    let mut diagnostics = Vec::new();
    let (system, types, nodes, ports, cut) = match prepared {
        Some(prepared) => {
            let cut = rig::read(loaded, sources, prepared, overrides, observed, data.to_vec(), &mut diagnostics);
            on_stage("check");
            let Some(mut cut) = cut else { return Err(diagnostics) };
            let system = std::mem::take(&mut cut.control);
            let types = std::mem::take(&mut cut.control_types);
            // Warnings concern the rig, and are not repeated for each of its experiments.
            diagnostics.retain(Diagnostic::is_error);
            (system, types, std::mem::take(&mut cut.observed), OpenPorts::default(), Some(cut))
        }
        None => {
            let instance = Instance::Written(&parts.run.instance, root);
            let request = Request { instance, overrides, observed, data: data.to_vec(), frame: None };
            let flat = flatten(loaded, sources, &request);
            let mut system = flat.system;
            diagnostics = flat.diagnostics;
            start_values::open(&mut system, &given.vary);
            let ports = given.ports.as_ref().map(|ports| open(&mut system, ports, &mut diagnostics));
            on_stage("check");
            let blocks = |d: &Diagnostic| d.is_error() && outside_of(parts.span, d);
            let depth = Depth::Given(parts.run.instance.span);
            let types = analyse(&system, &loaded.files, depth, &blocks, &mut diagnostics);
            (system, types, flat.observed, ports.unwrap_or_default(), None)
        }
    };
    // Errors that follow from an unreadable declaration have been reported with it.
    let lost = loaded.files.0.iter().any(|file| !file.ast.lost.is_empty());
    if lost && (cut.is_some() || nodes.is_empty() || system.nodes.iter().any(|node| matches!(node, Node::Error))) {
        diagnostics.retain(Diagnostic::is_error);
        return Err(diagnostics);
    }
    // Errors of units in the experiment alone do not stop the search for further errors.
    if diagnostics.iter().any(|d| d.is_error() && outside_of(parts.span, d))
        || diagnostics.iter().any(|d| d.is_error() && d.code != "E0101" && d.code != "E0103")
    {
        return Err(diagnostics);
    }
    diagnostics.retain(|d| d.is_error() || !outside_of(parts.span, d));
    let (places, vary) = (Vec::new(), &start_values::params(&system, &given.vary)[..]);
    let recorded = data.iter().map(|(_, table, unit)| (table.name.clone(), unit.clone())).collect();
    let mut reader = Reader {
        loaded,
        recorded,
        system: &system,
        types: &types,
        diagnostics,
        wanted: Vec::new(),
        places,
        vary,
        expect: 0,
    };
    if let Some(cut) = &cut {
        reader.wanted = cut.wanted(&system);
    }
    let own = reader.wanted.len();

    let corners = evaluate(&system, &types, &system.corners);
    let duration = match (given.duration, duration) {
        (Some(duration), _) => duration,
        (None, Some(at)) => {
            reader.places.push((PlanNumber::Duration, nodes[at]));
            reader.time(nodes[at], "the duration")
        }
        (None, None) => match data.first().and_then(|(_, table, _)| table.x.last()) {
            Some(end) => *end,
            None => {
                let error = Diagnostic::error("E0902", "how long does it run?")
                    .label(parts.run.span, "no duration")
                    .help("add `for 10 s`");
                reader.diagnostics.push(error);
                1.0
            }
        },
    };
    let solver = reader.solver(parts, given, step.map(|at| nodes[at]), tol.map(|at| nodes[at]));
    let solver = match &cut {
        Some(cut) => reader.between_ticks(parts, given, cut.period(), solver),
        None => solver,
    };
    if cut.is_none() && solver.method != Method::Adaptive {
        let at = step.map(|at| system.span(nodes[at]));
        parameter_checks::whole_periods(&system, &types, solver.step, at, &mut reader.diagnostics);
        delays::fits(&system, solver.step, at, &mut reader.diagnostics);
        if duration / solver.step > MOST_STEPS {
            let steps = abi::format::three_digits(duration / solver.step);
            let error = Diagnostic::error("E0902", format!("{steps} steps are too many"))
                .label(parts.run.span, "so long a run with such short steps");
            reader
                .diagnostics
                .push(error.help("run a shorter time or take longer steps: a trillion of them is the limit"));
        }
    }
    reader.recording_ends(parts, data, duration, warnings);
    let mut expects_at = Vec::new();
    for (k, (expect, at)) in parts.expects.iter().zip(&expects).enumerate() {
        reader.expect = k;
        expects_at.push(reader.expect(expect, at, &nodes, duration));
    }
    let mut plots_at: Vec<PlotAt> = Vec::new();
    for ((plot, (curves, against)), window) in parts.plots.iter().zip(&plots).zip(windows) {
        let at = reader.plot(plot, (curves, against.as_ref()), window, &nodes, duration, &mut expects_at);
        plots_at.extend(at);
    }
    let ports_at: Vec<usize> = ports.outputs.iter().map(|(_, node)| reader.want(*node, None)).collect();
    let (wanted, diagnostics) = (std::mem::take(&mut reader.wanted), std::mem::take(&mut reader.diagnostics));
    let places = std::mem::take(&mut reader.places);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return Err(diagnostics);
    }
    if loaded.has_errors() {
        return Err(Vec::new()); // Unreadable declarations have been reported.
    }
    warnings.extend(diagnostics);
    on_stage("lower");
    let lowered = lower(&system, &types, &wanted);
    let description = &lowered.program.description;
    let states = description.layout.states.len as usize;
    let is_too_dense = states > MOST_DENSE && description.coupling.is_empty();
    if cut.is_none() && solver.method == Method::Adaptive && is_too_dense {
        let message =
            format!("{states} states, of which each depends on many others, are too many for an adaptive run");
        let error = Diagnostic::error("E0902", message).label(parts.run.span, "with so many states");
        return Err(vec![error.help(format!(
            "fixed steps take any number, for example `solver expo step 0.1 ms`; up to {MOST_DENSE} go adaptively"
        ))]);
    }
    let mut rig = cut.map(|cut| {
        let (rig, plant) = cut.with_plant(&lowered, own);
        SimulatedRig { rig, plant, cut }
    });
    let Lowered { mut program, observed: slots } = lowered;
    program.description.name = one_line(loaded.files.slice(parts.run.instance.span));
    for root in &mut program.description.roots {
        root.text = surface_text(loaded, &root.text);
    }
    let mut adaptive = None;
    match &mut rig {
        Some(SimulatedRig { rig, plant, .. }) => {
            program.size_rings(rig.period_ns as f64 * 1e-9 / f64::from(rig.steps));
            plant.size_rings(solver.step);
        }
        None if solver.method != Method::Adaptive => {
            adaptive = (!is_too_dense).then(|| program.clone());
            program.size_rings(solver.step);
        }
        None => {}
    }
    let series = |at: usize| plan::Series {
        label: wanted[at].text.clone(),
        slot: slots[at],
        unit: wanted[at].unit.clone().unwrap_or_default(),
        boolean: types.boolean[wanted[at].expr.0 as usize],
    };
    let plots = plots_at.into_iter().map(|plot| plan::Plot {
        series: plot.series.iter().map(|at| series(*at)).collect(),
        against: plot.against.map(series),
        view: plot.view,
    });
    let plots = plots.collect();
    let expects = expects_at
        .into_iter()
        .flatten()
        .map(|mut expect| {
            for measure in &mut expect.measures {
                let place = |slot: &mut abi::Slot| *slot = slots[slot.index()];
                place(&mut measure.slot);
                for edge in [&mut measure.window.after, &mut measure.window.before] {
                    if let plan::Edge::First(slot) = edge {
                        place(slot);
                    }
                }
                if let MeasureKind::AtMoment(
                    plan::Moment::First(slot)
                    | plan::Moment::Rises(slot)
                    | plan::Moment::Least(slot)
                    | plan::Moment::Greatest(slot),
                ) = &mut measure.kind
                {
                    place(slot);
                }
            }
            expect
        })
        .collect();
    let mut corners: Vec<f64> = corners.into_iter().filter(|t| *t > 0.0 && *t < duration).collect();
    corners.sort_by(f64::total_cmp);
    corners.dedup();
    let stepped = parts.stepped;
    let experiment =
        plan::Experiment { name: name.to_string(), duration, solver, bench: None, plots, expects, corners, stepped };
    let inputs = ports.inputs.iter().filter_map(|(path, moved)| {
        let quantity = program.description.quantity(moved)?;
        Some((path.clone(), quantity.slot))
    });
    let outputs = ports.outputs.iter().zip(ports_at).map(|((path, _), at)| (path.clone(), slots[at]));
    let ports = (inputs.collect(), outputs.collect());
    let (rows, begins, steady) = (Vec::new(), 0.0, false);
    Ok(Variant { label, system, types, program, adaptive, experiment, places, ports, rig, rows, begins, steady })
}

/// The rig that an experiment runs, with its descriptions; `None` if it runs a model.
fn rig_of(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    given: &CommandLine,
    diagnostics: &mut Vec<Diagnostic>,
) -> Result<Option<LoadedRig>, Vec<Diagnostic>> {
    let root = loaded.root();
    let ast = loaded.files.get(root).ast.clone();
    let run = ast.items().find_map(|item| match item {
        ast::Item::Experiment(one) if one.name.text == experiment => {
            one.body.iter().find_map(|statement| match statement {
                ExperimentStatement::Run(run) => Some(run),
                _ => None,
            })
        }
        _ => None,
    });
    let Some(run) = run.filter(|run| !run.instance.model.text.starts_with(|c: char| c.is_ascii_uppercase())) else {
        return Ok(None);
    };
    let item = rig::find(loaded, root, &run.instance.model).map_err(|error| vec![error])?;
    if run.instance.rotary {
        let error =
            Diagnostic::error("E0108", "a rig is what it is: `rotary` stands before the system in its own `run`")
                .label(run.instance.span, "a rig");
        diagnostics.push(error.help(format!("write `run {}()`", run.instance.model.text)));
    }
    if !given.vary.is_empty() || given.ports.is_some() {
        let what = if given.ports.is_some() {
            "a rig cannot be linearised as a whole yet"
        } else {
            "a rig cannot be varied yet"
        };
        let error = Diagnostic::error("E0905", what).label(run.instance.span, "a rig");
        return Err(vec![error.help("for a few values write a `sweep` in the experiment")]);
    }
    Ok(Some(rig::prepare(loaded, sources, item)))
}

/// Whether a diagnostic lies outside a span.
fn outside_of(place: Span, diagnostic: &Diagnostic) -> bool {
    let span = diagnostic.span();
    span.file != place.file || span.start < place.start || span.end > place.end
}

/// The text of a switching surface, from its encoded span.
fn surface_text(loaded: &Loaded, place: &str) -> String {
    let parse = || {
        let (file, range) = place.split_once(':')?;
        let (start, end) = range.split_once("..")?;
        let file = FileId(file.parse().ok()?);
        let span = Span::new(file, start.parse().ok()?, end.parse().ok()?);
        Some(one_line(loaded.files.slice(span)))
    };
    parse().unwrap_or_else(|| place.to_string())
}

/// A plot whose quantities are indices of observed expressions.
struct PlotAt {
    series: Vec<usize>,
    against: Option<usize>,
    view: plan::View,
}

struct Reader<'a> {
    loaded: &'a Loaded,
    /// Units of the columns of the recording, by table.
    recorded: Vec<(String, Unit)>,
    system: &'a System,
    types: &'a Types,
    diagnostics: Vec<Diagnostic>,
    wanted: Vec<Observed>,
    places: Vec<(PlanNumber, ExprId)>,
    /// Paths of parameters that vary from run to run.
    vary: &'a [String],
    /// Index of the present expectation.
    expect: usize,
}

impl Reader<'_> {
    /// Whether the value depends on a parameter that varies from run to run.
    fn varies(&self, expr: ExprId) -> bool {
        !self.vary.is_empty() && depends(self.system, expr, &|var| self.vary.contains(&var.path))
    }

    fn constant(&self, expr: ExprId) -> f64 {
        self.system.literal(expr).unwrap_or_else(|| evaluate(self.system, self.types, &[expr])[0])
    }

    fn dimension(&self, expr: ExprId) -> Dimension {
        self.types.nodes[expr.0 as usize].unwrap_or(Dimension::NONE)
    }

    /// A positive time that is known before the run, in s.
    fn time(&mut self, expr: ExprId, what: &str) -> f64 {
        let value = self.constant(expr);
        let seconds = Dimension::of([0, 0, 1, 0, 0]);
        let span = self.system.span(expr);
        if self.dimension(expr) != seconds && value != 0.0 {
            let text = self.loaded.files.slice(span);
            let error = match self.dimension(expr).is_none() {
                true => Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                    .label(span, "a pure number")
                    .help(format!("write `{text} s`")),
                false => {
                    Diagnostic::error("E0101", format!("{what} is a time, not {}", self.dimension(expr).describe()))
                        .label(span, Unit::si(self.dimension(expr)).to_string())
                }
            };
            self.diagnostics.push(error);
            return 1.0;
        }
        if !(value.is_finite() && value > 0.0) {
            let error = Diagnostic::error("E0902", format!("{what} must be positive and known before the run"))
                .label(span, if value.is_nan() { "not constant".to_string() } else { format!("{value} s") });
            self.diagnostics.push(error.help("write a time, such as `10 s`"));
            return 1.0;
        }
        value
    }

    fn solver(&mut self, parts: &Statements, given: &CommandLine, step: Option<ExprId>, tol: Option<ExprId>) -> Solver {
        let written = parts.solver.and_then(|solver| {
            let method = Method::named(&solver.method.text);
            if method.is_none() {
                let error = Diagnostic::error("E0201", format!("there is no solver `{}`", solver.method.text))
                    .label(solver.method.span, "not known");
                self.diagnostics.push(error.help(format!("solvers are {}", Method::list(Method::ALL))));
            }
            method
        });
        let method = given.method.or(written).unwrap_or(Method::Adaptive);
        if let (None, Some(step)) = (given.step, step) {
            self.places.push((PlanNumber::Step, step));
        }
        let step = given.step.or_else(|| step.map(|step| self.time(step, "the step")));
        if let (None, Some(tol)) = (given.tol, tol) {
            self.places.push((PlanNumber::Tolerance, tol));
        }
        let tol = given.tol.or_else(|| tol.map(|tol| self.constant(tol))).unwrap_or(DEFAULT_TOL);
        if !(tol > 0.0 && tol < 1.0) {
            let span = parts.solver.map_or(parts.run.span, |solver| solver.span);
            let error =
                Diagnostic::error("E0502", format!("a tolerance of {tol} is out of range")).label(span, "tolerance");
            self.diagnostics.push(error.help("it lies between 0 and 1, such as `tol 1e-8`"));
        }
        match method {
            Method::Adaptive => Solver { method, step: 0.0, tol, parts: PARTS },
            _ => Solver { method, step: step.unwrap_or(DEFAULT_STEP), tol, parts: PARTS },
        }
    }

    /// Method and step of the plant between ticks. The step must divide the period.
    fn between_ticks(&mut self, parts: &Statements, given: &CommandLine, period: f64, solver: Solver) -> Solver {
        let usual = Solver { method: Method::Expo, step: period / f64::from(rig::PLANT_STEPS), ..solver };
        if given.method.is_none() && parts.solver.is_none() {
            return match given.step {
                Some(step) => self.divides(parts, period, Solver { step, ..usual }),
                None => usual,
            };
        }
        let span = parts.solver.map_or(parts.run.span, |solver| solver.span);
        match solver.method {
            Method::Adaptive => {
                let error = Diagnostic::error("E0905", "between the ticks of a rig, steps have a fixed length")
                    .label(span, "takes as many as it needs");
                self.diagnostics
                    .push(error.help("write `solver rk4 step 10 us`, or leave it out for 50 steps of `expo`"));
                usual
            }
            _ => self.divides(parts, period, solver),
        }
    }

    fn divides(&mut self, parts: &Statements, period: f64, solver: Solver) -> Solver {
        let ratio = period / solver.step;
        if (ratio - ratio.round()).abs() > 1e-9 * ratio || !(1.0..=1e5).contains(&ratio.round()) {
            let span = parts.solver.map_or(parts.run.span, |solver| solver.span);
            let error = Diagnostic::error("E0701", "the step between ticks does not divide the period of the rig")
                .label(span, format!("{} steps in {} s", abi::format::three_digits(ratio), period));
            self.diagnostics.push(error.help("take a step that divides it, such as `step 20 us` of 1 ms"));
        }
        solver
    }

    /// Requests an expression as an observed quantity; returns its index.
    fn want(&mut self, expr: ExprId, unit: Option<Unit>) -> usize {
        let text = one_line(self.loaded.files.slice(self.system.span(expr)));
        let unit = unit.or_else(|| Some(self.own_unit(expr)));
        self.wanted.push(Observed { expr, text, unit });
        self.wanted.len() - 1
    }

    /// Default display unit of an expression: that of a plain quantity, otherwise SI.
    fn own_unit(&self, expr: ExprId) -> Unit {
        match self.system.node(expr) {
            Node::Var(id) => self.types.units[id.0 as usize].clone(),
            Node::Time => Unit::parse("s").expect("the second is known"),
            Node::Call(Builtin::Abs, args) => self.own_unit(args[0]),
            Node::Negate(a) => self.own_unit(*a),
            Node::Table(table, _) => {
                let table = &self.system.tables[*table as usize];
                let recorded = self.recorded.iter().find(|(name, _)| *name == table.name);
                recorded.map_or_else(|| Unit::si(table.y_dimension), |(_, unit)| unit.clone())
            }
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract, a, b) => {
                let (a, b) = (self.own_unit(*a), self.own_unit(*b));
                if a == b { a } else { Unit::si(self.dimension(expr)) }
            }
            _ if self.types.boolean[expr.0 as usize] => Unit::none(),
            _ => Unit::si(self.dimension(expr)),
        }
    }

    /// The display unit stated for an expression, if its dimension matches.
    fn unit_for(&mut self, expr: ExprId, text: &ast::UnitText) -> Option<Unit> {
        match Unit::parse(&text.text) {
            // A condition is true or false, whatever unit stands beside it.
            Ok(_) if self.types.boolean[expr.0 as usize] => Some(Unit::none()),
            Ok(unit) if unit.dimension == self.dimension(expr) => Some(unit),
            Ok(unit) => {
                let message = format!("this is {}, it cannot be shown in {unit}", self.dimension(expr).describe());
                let error = Diagnostic::error("E0101", message)
                    .label(text.span, unit.dimension.describe())
                    .label(self.system.span(expr), Unit::si(self.dimension(expr)).to_string());
                self.diagnostics.push(error.help("give it a unit of its own kind"));
                None
            }
            Err(part) => {
                let error = Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(text.span, "not known");
                self.diagnostics.push(error);
                None
            }
        }
    }

    /// Display unit of a side of a comparison: that of its measure, otherwise SI.
    fn side_unit(&self, id: ExprId) -> Unit {
        let boolean = self.types.boolean[id.0 as usize];
        let otherwise = || if boolean { Unit::none() } else { Unit::si(self.dimension(id)) };
        self.unit_of_measures(id).unwrap_or_else(otherwise)
    }

    /// The unit of a measure, of its multiples, and of sums of measures with the same unit.
    fn unit_of_measures(&self, id: ExprId) -> Option<Unit> {
        let number =
            |id: &ExprId| matches!(self.system.node(*id), Node::Number { .. }) && self.dimension(*id).is_none();
        match self.system.node(id) {
            Node::Measure(name, value, ..) => Some(self.measure_unit(*name, id, *value)),
            Node::Negate(a) => self.unit_of_measures(*a),
            Node::Call(Builtin::Abs, args) => self.unit_of_measures(args[0]),
            Node::Binary(BinaryOp::Multiply, a, b) if number(a) => self.unit_of_measures(*b),
            Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, a, b) if number(b) => self.unit_of_measures(*a),
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract, a, b) => {
                self.unit_of_measures(*a).filter(|unit| self.unit_of_measures(*b).as_ref() == Some(unit))
            }
            _ => None,
        }
    }

    /// Tells that a run reads a recording outside of its times, where it is held.
    fn recording_ends(
        &mut self,
        parts: &Statements,
        data: &[(String, Table, Unit)],
        duration: f64,
        told: &[Diagnostic],
    ) {
        let (Some(statement), Some((_, table, _))) = (parts.data, data.first()) else { return };
        let (Some(&from), Some(&to)) = (table.x.first(), table.x.last()) else { return };
        // A grid of decimals may end a rounding error before the duration.
        let ends = to < duration * (1.0 - 1e-9);
        if parts.allowed.contains(&"recording-ends") || !(ends || from > 0.0) {
            return;
        }
        let time = |t: f64| format!("{} s", abi::format::three_digits(t));
        let (message, label) = match (from > 0.0, ends) {
            (false, _) => ("the recording ends before the run".to_string(), format!("ends at {}", time(to))),
            (true, false) => ("the recording begins after the run".to_string(), format!("begins at {}", time(from))),
            (true, true) => {
                ("the recording covers only a part of the run".to_string(), format!("{} to {}", time(from), time(to)))
            }
        };
        let label = format!("{label}; outside, its first and last rows are held");
        let warning = Diagnostic::warning("W0901", message)
            .label(statement.file.span, label)
            .label(parts.run.span, format!("from 0 s to {}", time(duration)));
        let help = match from > 0.0 {
            true => "subtract the first time from `t` in the file, or `allow recording-ends \"…\"`".to_string(),
            false => format!("run `for {}`, or leave `for` out: then the run ends with the recording", time(to)),
        };
        // The cases of a sweep read the same recording.
        if !told.iter().any(|one| one.code == warning.code && one.span() == warning.span()) {
            self.diagnostics.push(warning.help(help));
        }
    }

    /// Reads a plot; `across` a parameter, its measures become shown expectations.
    fn plot(
        &mut self,
        plot: &ast::Plot,
        (curves, against): (&[CurveAt], Option<&CurveAt>),
        window: (Option<usize>, Option<usize>),
        nodes: &[ExprId],
        duration: f64,
        expects: &mut Vec<Option<plan::Expect>>,
    ) -> Option<PlotAt> {
        let mut time = |at: Option<usize>| match at {
            Some(at) if self.constant(nodes[at]) == 0.0 => Some(0.0),
            at => at.map(|at| self.time(nodes[at], "a window")),
        };
        let (after, before) = (time(window.0), time(window.1));
        let (from, to) = (after.unwrap_or(0.0), before.unwrap_or(duration).min(duration));
        if from >= to && (after.is_some() || before.is_some()) {
            let error = Diagnostic::error("E0902", "the window of this plot is empty")
                .label(plot.span, format!("from {from} s to {to} s"));
            self.diagnostics.push(error.help(format!("the run takes {duration} s")));
            return None;
        }
        let looks = plot.curves.iter().zip(curves).map(|(curve, at)| self.look(curve, at, nodes)).collect();
        let x = plot.against.as_ref().zip(against).map(|(curve, at)| self.look(curve, at, nodes)).unwrap_or_default();
        let title = plot.title.as_ref().map(|title| title.text.clone());
        let mut view = plan::View { title, after, before, looks, x, across: None };
        let measures = curves.iter().filter(|at| self.measured(nodes[at.value])).count();
        if measures == 0 {
            let series = plot.curves.iter().zip(curves);
            let series = series.map(|(curve, at)| self.show(&curve.show, nodes[at.value])).collect();
            let against = plot.against.as_ref().zip(against);
            let against = against.map(|(curve, at)| self.show(&curve.show, nodes[at.value]));
            return Some(PlotAt { series, against, view });
        }
        let measured = curves.iter().find(|at| self.measured(nodes[at.value]));
        let span = self.system.span(nodes[measured.expect("there is one").value]);
        let Some((parameter, at)) = plot.against.as_ref().zip(against) else {
            let error = Diagnostic::error("E0901", "a measure is one number for the whole run")
                .label(span, "plotted over time");
            let help = "test it with `expect`, or plot it against what a `sweep` varies: `plot max(F) against vp`";
            self.diagnostics.push(error.help(help));
            return None;
        };
        if measures < curves.len() {
            let other = curves.iter().find(|at| !self.measured(nodes[at.value])).expect("there is one");
            let error = Diagnostic::error("E0901", "a plot shows measures or quantities, not both")
                .label(span, "one number for the whole run")
                .label(self.system.span(nodes[other.value]), "a number at each time");
            self.diagnostics.push(error.help("write two `plot`s"));
            return None;
        }
        let value = self.constant(nodes[at.value]);
        if !value.is_finite() || self.measured(nodes[at.value]) {
            let error = Diagnostic::error("E0901", "a measure is plotted against a parameter")
                .label(self.system.span(nodes[at.value]), "not one number that is known before the run");
            self.diagnostics.push(error.help("`sweep` a parameter, and write its path here"));
            return None;
        }
        let unit = parameter.show.unit.as_ref().and_then(|text| self.unit_for(nodes[at.value], text));
        let unit = unit.unwrap_or_else(|| self.own_unit(nodes[at.value]));
        let label = one_line(self.loaded.files.slice(parameter.show.value.span));
        let mut across = plan::Across { measures: Vec::new(), label, value, unit };
        for (curve, at) in plot.curves.iter().zip(curves) {
            let shown = ast::Expect {
                value: curve.show.value.clone(),
                near: None,
                shows: Some(curve.show.unit.clone()),
                after: plot.after.clone(),
                before: plot.before.clone(),
                cases: Vec::new(),
                span: curve.show.span,
            };
            let at = ExpectAt { value: at.value, near: None, after: window.0, before: window.1 };
            self.expect = expects.len();
            let expect = self.expect(&shown, &at, nodes, duration);
            across.measures.push(expects.len());
            expects.push(expect);
        }
        view.across = Some(across);
        Some(PlotAt { series: Vec::new(), against: None, view })
    }

    /// How a quantity of a plot looks.
    fn look(&mut self, curve: &ast::Curve, at: &CurveAt, nodes: &[ExprId]) -> plan::Look {
        let node = nodes[at.value];
        let range = at.range.and_then(|(from, to)| self.axis_range(node, curve.log, nodes[from], nodes[to]));
        plan::Look {
            label: curve.label.as_ref().map(|label| label.text.clone()),
            range,
            logarithmic: curve.log,
            recorded: self.is_recorded(node) == Some(true),
        }
    }

    /// The ends of an axis, in SI; 0 fits every unit.
    fn axis_range(&mut self, of: ExprId, log: bool, from: ExprId, to: ExprId) -> Option<(f64, f64)> {
        let wanted = self.dimension(of);
        for end in [from, to] {
            let (found, value, span) = (self.dimension(end), self.constant(end), self.system.span(end));
            let text = self.loaded.files.slice(span);
            let error = if !value.is_finite() {
                Diagnostic::error("E0902", "the ends of an axis are known before the run").label(span, "not constant")
            } else if found == wanted || value == 0.0 {
                continue;
            } else if found.is_none() {
                Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                    .label(span, "a pure number")
                    .help(format!("write `{text} {}`", Unit::si(wanted)))
            } else {
                let message = format!("an axis of {} does not end at {}", wanted.describe(), found.describe());
                Diagnostic::error("E0101", message)
                    .label(span, Unit::si(found).to_string())
                    .label(self.system.span(of), Unit::si(wanted).to_string())
            };
            self.diagnostics.push(error);
            return None;
        }
        let (low, high) = (self.constant(from), self.constant(to));
        let problem = match (low < high, log && low <= 0.0) {
            (false, _) => "an axis goes from its lower to its upper end",
            (true, true) => "a logarithmic axis begins above 0",
            (true, false) => return Some((low, high)),
        };
        let label = format!("from {low} to {high} in SI");
        self.diagnostics.push(Diagnostic::error("E0902", problem).label(self.system.span(from), label));
        None
    }

    /// Whether an expression reads a recording; `None` if it reads a quantity of the model.
    fn is_recorded(&self, id: ExprId) -> Option<bool> {
        match self.system.node(id) {
            Node::Var(_) | Node::Rate(_) | Node::InRegime(..) => None,
            Node::Table(table, at) if matches!(self.system.node(*at), Node::Time) => {
                Some(self.system.tables[*table as usize].name.starts_with("data."))
            }
            node => node.operands().try_fold(false, |any, operand| Some(any | self.is_recorded(operand)?)),
        }
    }

    fn show(&mut self, show: &ast::Show, expr: ExprId) -> usize {
        let unit = show.unit.as_ref().and_then(|text| self.unit_for(expr, text));
        self.want(expr, unit)
    }

    fn expect(&mut self, expect: &ast::Expect, at: &ExpectAt, nodes: &[ExprId], duration: f64) -> Option<plan::Expect> {
        let text = self.loaded.files.slice(expect.span);
        let text = one_line(text.strip_prefix("expect").or(text.strip_prefix("show")).unwrap_or(text));
        let mut measures = Vec::new();
        let value = self.formula(nodes[at.value], &mut measures)?;
        let condition = match at.near {
            None if expect.shows.is_some() => {
                let unit = expect.shows.as_ref().and_then(Option::as_ref);
                let unit = match unit {
                    Some(text) => self.unit_for(nodes[at.value], text)?,
                    None => self.side_unit(nodes[at.value]),
                };
                Formula::Shown(unit, Box::new(value))
            }
            None => {
                if !self.types.boolean[nodes[at.value].0 as usize] {
                    let error = Diagnostic::error("E0901", "an expectation is a condition")
                        .label(self.system.span(nodes[at.value]), "neither true nor false");
                    let window = self.window_first(expect);
                    self.diagnostics.push(match window {
                        Some(help) => error.help(help),
                        None => error.help("compare it: `expect max(F) < 2 N`, `expect final(x) ~= 1 m +- 1 %`"),
                    });
                    return None;
                }
                value
            }
            Some((target, tolerance)) => {
                let (value_node, target_node, tolerance_node) = (nodes[at.value], nodes[target], nodes[tolerance]);
                let relative = self.loaded.files.slice(self.system.span(tolerance_node)).trim_end().ends_with('%');
                let any = |node: ExprId| matches!(self.system.node(node), Node::Number { dimension: None, .. });
                for (node, skip) in [(target_node, false), (tolerance_node, relative)] {
                    if !skip && !any(node) && self.dimension(node) != self.dimension(value_node) {
                        let (found, wanted) = (self.dimension(node), self.dimension(value_node));
                        let text = self.loaded.files.slice(self.system.span(node));
                        let error = match found.is_none() {
                            true => Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                                .label(self.system.span(node), "a pure number")
                                .help(format!("write `{text} {}`", Unit::si(wanted))),
                            false => {
                                let message = format!("cannot compare {} with {}", wanted.describe(), found.describe());
                                Diagnostic::error("E0101", message)
                                    .label(self.system.span(node), Unit::si(found).to_string())
                                    .label(self.system.span(value_node), Unit::si(wanted).to_string())
                            }
                        };
                        self.diagnostics.push(error);
                        return None;
                    }
                }
                let target = self.formula(target_node, &mut measures)?;
                let tolerance = self.formula(tolerance_node, &mut measures)?;
                let (value, target, tolerance) = (Box::new(value), Box::new(target), Box::new(tolerance));
                self.shown_in(value_node, target_node, Formula::Near { value, target, tolerance, relative })
            }
        };
        let mut at = *at;
        // A window that begins or ends with an event belongs to each measure.
        for before in [false, true] {
            let end = if before { &mut at.before } else { &mut at.after };
            let Some(node) = end.map(|end| nodes[end]).filter(|node| self.measured(*node)) else { continue };
            *end = None;
            let place = if before { PlanNumber::Before(self.expect) } else { PlanNumber::After(self.expect) };
            let edge = self.edge(node, place)?;
            let event = one_line(self.loaded.files.slice(self.system.span(node)));
            for measure in &mut measures {
                let own = if before { &mut measure.window.before } else { &mut measure.window.after };
                if matches!(own, plan::Edge::Open) {
                    *own = edge;
                    // The same measure over the whole run is another number.
                    measure.text += &format!(" {} {event}", if before { "before" } else { "after" });
                }
            }
        }
        for (at, place) in [(at.after, PlanNumber::After(self.expect)), (at.before, PlanNumber::Before(self.expect))] {
            self.places.extend(at.map(|at| (place, nodes[at])));
        }
        let mut edge = |at: Option<usize>, default: f64| match at {
            Some(at) if self.constant(nodes[at]) == 0.0 => 0.0,
            Some(at) => self.time(nodes[at], "a window"),
            None => default,
        };
        let (after, before) = (edge(at.after, 0.0), edge(at.before, duration).min(duration));
        if after > before || (after == before && after > 0.0 && at.after.is_some() && after > duration) {
            let error = Diagnostic::error("E0902", "the window of this expectation is empty")
                .label(expect.span, format!("from {after} s to {before} s"))
                .help(format!("the run takes {duration} s"));
            self.diagnostics.push(error);
            return None;
        }
        Some(plan::Expect { text, measures, condition, after, before })
    }

    /// Suggestion for `expect max(x) after 5 s < 1 m`, where the window precedes the comparison: the corrected
    /// expectation.
    fn window_first(&mut self, expect: &ast::Expect) -> Option<String> {
        let compares =
            |op| matches!(op, BinaryOp::Less | BinaryOp::LessEqual | BinaryOp::Greater | BinaryOp::GreaterEqual);
        let compared = |edge: &&Expr| matches!(&edge.kind, ast::ExprKind::Binary(op, ..) if compares(*op));
        let (word, edge) = match (expect.after.as_ref().filter(compared), expect.before.as_ref().filter(compared)) {
            (Some(edge), _) => ("after", edge),
            (None, Some(edge)) => ("before", edge),
            (None, None) => return None,
        };
        let ast::ExprKind::Binary(op, _, time, limit) = &edge.kind else { return None };
        // The error about the comparison of a time is a consequence of the same mistake.
        let edge = edge.span;
        self.diagnostics.retain(|d| d.span().start < edge.start || d.span().end > edge.end);
        let [value, time, limit] = [expect.value.span, time.span, limit.span].map(|span| self.loaded.files.slice(span));
        Some(format!("the window comes after the comparison: `expect {value} {} {limit} {word} {time}`", op.text()))
    }

    /// Translates arithmetic over measures. The slot of a measure is the index of the measured expression among those
    /// requested.
    fn formula(&mut self, id: ExprId, measures: &mut Vec<plan::Measure>) -> Option<Formula> {
        let node = self.system.node(id).clone();
        if !self.measured(id) {
            if self.types.boolean[id.0 as usize] {
                if let Node::Binary(op, a, b) = node
                    && !matches!(op, BinaryOp::And | BinaryOp::Or)
                {
                    let (a, b) = (self.formula(a, measures)?, self.formula(b, measures)?);
                    return Some(compare(op, a, b));
                }
                // A condition without a measure means its value at the end.
                return Some(self.measure(id, id, MeasureKind::Final, plan::Window::default(), measures));
            }
            if let Some(value) = self.system.literal(id) {
                return Some(Formula::Number(value));
            }
            if self.varies(id) {
                // Constant within a run, but not the same in all runs.
                return Some(self.measure(id, id, MeasureKind::Final, plan::Window::default(), measures));
            }
            let value = self.constant(id);
            if !value.is_nan() {
                return Some(Formula::Number(value));
            }
            let text = one_line(self.loaded.files.slice(self.system.span(id)));
            let error = Diagnostic::error("E0901", format!("`{text}` changes during the run: which value is meant?"))
                .label(self.system.span(id), "not a measure")
                .help(format!("write `final({text})`, `max({text})`, `at({text}, 1 s)` or another measure"));
            self.diagnostics.push(error);
            return None;
        }
        let pair = |reader: &mut Self, a, b, measures: &mut Vec<plan::Measure>| {
            Some((Box::new(reader.formula(a, measures)?), Box::new(reader.formula(b, measures)?)))
        };
        match node {
            Node::Measure(name, value, second, window) => {
                let moment = match second {
                    Some(second) if self.measured(second) => Some(self.moment(second)?),
                    _ => None,
                };
                if let Some(second) = second.filter(|_| moment.is_none()) {
                    self.places.push((PlanNumber::Second(self.expect, measures.len()), second));
                }
                let second = second.map(|second| if moment.is_some() { f64::NAN } else { self.constant(second) });
                if second.is_some_and(f64::is_nan) && moment.is_none() {
                    return self.unknown_before(id);
                }
                let after =
                    window.after.map(|edge| self.edge(edge, PlanNumber::MeasureAfter(self.expect, measures.len())));
                let before =
                    window.before.map(|e| self.edge(e, PlanNumber::MeasureBefore(self.expect, measures.len())));
                let open = || Some(plan::Edge::Open);
                let window = plan::Window { after: after.unwrap_or_else(open)?, before: before.unwrap_or_else(open)? };
                if name == MeasureName::Time {
                    return match *self.system.node(value) {
                        Node::Measure(MeasureName::Peak, of, Some(number), inner) if inner == Window::default() => {
                            self.places.push((PlanNumber::Second(self.expect, measures.len()), number));
                            let kind = MeasureKind::TimeOfPeak(self.number_of_peak(number)?);
                            Some(self.measure(id, of, kind, window, measures))
                        }
                        Node::Measure(MeasureName::Max, of, None, inner) if inner == Window::default() => {
                            Some(self.measure(id, of, MeasureKind::TimeOfGreatest, window, measures))
                        }
                        Node::Measure(MeasureName::Min, of, None, inner) if inner == Window::default() => {
                            Some(self.measure(id, of, MeasureKind::TimeOfLeast, window, measures))
                        }
                        _ => {
                            let error = Diagnostic::error(
                                "E0901",
                                "`time` is of an extremum: `time(max(x))`, `time(min(x))`, `time(peak(x, 2))`",
                            )
                            .label(self.system.span(value), "happens at no one instant");
                            let help = "a window stands in `time` itself: `time(max(x) after 1 s)`; when a condition first holds is `first(x > 0)`";
                            self.diagnostics.push(error.help(help));
                            None
                        }
                    };
                }
                let kind = match name {
                    MeasureName::Min => MeasureKind::Min,
                    MeasureName::Max => MeasureKind::Max,
                    MeasureName::Mean => MeasureKind::Mean,
                    MeasureName::Rms => MeasureKind::Rms,
                    MeasureName::Integral => MeasureKind::Integral,
                    MeasureName::Final => MeasureKind::Final,
                    MeasureName::PeakToPeak => MeasureKind::PeakToPeak,
                    MeasureName::Crossings => MeasureKind::Crossings,
                    MeasureName::Period => MeasureKind::Period,
                    MeasureName::First => MeasureKind::First,
                    MeasureName::Rises => MeasureKind::Rises,
                    MeasureName::Turns => MeasureKind::Turns,
                    MeasureName::Time => unreachable!("it is of a measure"),
                    MeasureName::Count => MeasureKind::Count,
                    MeasureName::CountRises => MeasureKind::CountRises,
                    MeasureName::CountTurns => MeasureKind::CountTurns,
                    MeasureName::Duration => MeasureKind::Duration,
                    MeasureName::Peaks => MeasureKind::Peaks,
                    MeasureName::Peak if moment.is_some() => return self.unknown_before(id),
                    MeasureName::Peak => {
                        let Node::Measure(_, _, Some(number), _) = *self.system.node(id) else { unreachable!() };
                        MeasureKind::Peak(self.number_of_peak(number)?)
                    }
                    MeasureName::At if moment.is_some() => MeasureKind::AtMoment(moment?),
                    MeasureName::At => MeasureKind::At(second.expect("`at` has two arguments")),
                    MeasureName::Settling => MeasureKind::Settling(second.expect("`settling` has two arguments")),
                };
                if self.measured(value) {
                    let error = Diagnostic::error("E0901", "a measure of a measure")
                        .label(self.system.span(id), "the inner one is a single number already");
                    self.diagnostics.push(error);
                    return None;
                }
                Some(self.measure(id, value, kind, window, measures))
            }
            Node::Negate(a) => Some(Formula::Negate(Box::new(self.formula(a, measures)?))),
            Node::Not(a) => Some(Formula::Not(Box::new(self.formula(a, measures)?))),
            Node::Binary(op, left, right) => {
                let (a, b) = pair(self, left, right, measures)?;
                Some(match op {
                    BinaryOp::Add => Formula::Add(a, b),
                    BinaryOp::Subtract => Formula::Subtract(a, b),
                    BinaryOp::Multiply => Formula::Multiply(a, b),
                    BinaryOp::Divide => Formula::Divide(a, b),
                    BinaryOp::And => Formula::And(a, b),
                    BinaryOp::Or => Formula::Or(a, b),
                    BinaryOp::Power => {
                        let alone = Alone::binary(Binary::Pow);
                        let at = Arc::new(move |x: f64, y: f64| alone.of_both(x, y));
                        Formula::Function(plan::Elementary { name: "^", at }, vec![*a, *b])
                    }
                    op => self.shown_in(left, right, compare(op, *a, *b)),
                })
            }
            Node::Call(Builtin::Abs, args) => Some(Formula::Abs(Box::new(self.formula(args[0], measures)?))),
            Node::Call(Builtin::Sqrt, args) => Some(Formula::Sqrt(Box::new(self.formula(args[0], measures)?))),
            Node::Call(Builtin::Unary(function), args) => {
                let alone = Alone::unary(function);
                let function = plan::Elementary { name: function.name(), at: Arc::new(move |x, _| alone.at(x)) };
                Some(Formula::Function(function, vec![self.formula(args[0], measures)?]))
            }
            Node::Call(Builtin::Min, args) => pair(self, args[0], args[1], measures).map(|(a, b)| Formula::Min(a, b)),
            Node::Call(Builtin::Max, args) => pair(self, args[0], args[1], measures).map(|(a, b)| Formula::Max(a, b)),
            _ => {
                let error = Diagnostic::error("E0901", "this cannot be computed from measures")
                    .label(self.system.span(id), "not arithmetic")
                    .help("use + - * / ^ abs sqrt min max exp log sin cos tan and the like, and comparisons, around measures");
                self.diagnostics.push(error);
                None
            }
        }
    }

    fn measure(
        &mut self,
        whole: ExprId,
        value: ExprId,
        kind: MeasureKind,
        window: plan::Window,
        measures: &mut Vec<plan::Measure>,
    ) -> Formula {
        let text = one_line(self.loaded.files.slice(self.system.span(whole)));
        let unit = match self.system.node(whole) {
            Node::Measure(name, ..) => self.measure_unit(*name, whole, value),
            // A condition, measured at the end.
            _ => self.own_unit(value),
        };
        let at = self.want(value, None);
        measures.push(plan::Measure { text, kind, slot: abi::Slot(at as u32), unit, window });
        Formula::Measure(measures.len() - 1)
    }

    /// An instant that is known only during the run, for `at(x, …)`.
    fn moment(&mut self, id: ExprId) -> Option<plan::Moment> {
        let node = self.system.node(id).clone();
        let inner = match node {
            Node::Measure(MeasureName::Time, of, None, Window { after: None, before: None }) => {
                self.system.node(of).clone()
            }
            ref other => other.clone(),
        };
        let is_time = matches!(node, Node::Measure(MeasureName::Time, ..));
        match inner {
            Node::Measure(name, of, None, Window { after: None, before: None }) if !self.measured(of) => {
                let make = match (name, is_time) {
                    (MeasureName::First, false) => plan::Moment::First,
                    (MeasureName::Rises, false) => plan::Moment::Rises,
                    (MeasureName::Max, true) => plan::Moment::Greatest,
                    (MeasureName::Min, true) => plan::Moment::Least,
                    _ => return self.unknown_before(id),
                };
                Some(make(abi::Slot(self.want(of, None) as u32)))
            }
            _ => self.unknown_before(id),
        }
    }

    /// An end of a measure's window: a time, or the first instant of a condition.
    fn edge(&mut self, id: ExprId, place: PlanNumber) -> Option<plan::Edge> {
        match *self.system.node(id) {
            Node::Measure(MeasureName::First, of, None, Window { after: None, before: None }) if !self.measured(of) => {
                Some(plan::Edge::First(abi::Slot(self.want(of, None) as u32)))
            }
            _ if self.measured(id) => self.unknown_before(id),
            _ => {
                self.places.push((place, id));
                let time = if self.constant(id) == 0.0 { 0.0 } else { self.time(id, "a window") };
                Some(plan::Edge::At(time))
            }
        }
    }

    /// The index of a peak.
    fn number_of_peak(&mut self, id: ExprId) -> Option<f64> {
        let number = self.constant(id);
        if is_number_of_peak(number) {
            return Some(number);
        }
        let error = Diagnostic::error("E0901", "peaks have the numbers 1, 2, 3 and so on")
            .label(self.system.span(id), if number.is_nan() { "not constant".to_string() } else { format!("{number}") })
            .help("write `peak(x, 1)` for the first one; `peaks(x)` is how many there are");
        self.diagnostics.push(error);
        None
    }

    fn unknown_before<T>(&mut self, id: ExprId) -> Option<T> {
        let error = Diagnostic::error("E0901", "this instant or window is not known before the run")
            .label(self.system.span(id), "follows from the run");
        let help =
            "a time such as `1 s`, `first(v > 0)` or, in `at`, `time(max(x))` can stand here, each without a window";
        self.diagnostics.push(error.help(help));
        None
    }

    /// A comparison with its display unit: that of a quantity written on one side, else that of a measure that forms a
    /// whole side, else SI.
    fn shown_in(&self, left: ExprId, right: ExprId, comparison: Formula) -> Formula {
        let dimension = self.dimension(left);
        let written = |id: ExprId| {
            let text = self.loaded.files.slice(self.system.span(id));
            let unit = text.trim_start_matches(|c: char| c.is_ascii_digit() || "+-. ".contains(c));
            // `5e-4 m`: the rest of the exponent is not a unit; the unit follows the last blank.
            let unit = if unit.starts_with(['e', 'E']) { unit.rsplit(' ').next().unwrap_or(unit) } else { unit };
            let number = matches!(self.system.node(id), Node::Number { .. } | Node::Negate(_));
            Unit::parse(unit.trim()).ok().filter(|unit| number && !unit.text.is_empty() && unit.dimension == dimension)
        };
        let measure = |id: ExprId| self.unit_of_measures(id);
        let unit = written(right).or(written(left)).or(measure(left)).or(measure(right));
        let boolean = self.types.boolean[left.0 as usize];
        let unit = unit.unwrap_or_else(|| if boolean { Unit::none() } else { Unit::si(dimension) });
        Formula::In(unit, Box::new(comparison))
    }

    /// The display unit of a measure.
    fn measure_unit(&self, name: MeasureName, whole: ExprId, value: ExprId) -> Unit {
        match name {
            // An integral of power is an energy; a torque has the same dimension.
            MeasureName::Integral if Unit::si(self.dimension(value)).text == "W" => {
                Unit::parse("J").expect("the joule is known")
            }
            MeasureName::Integral => Unit::si(self.dimension(whole)),
            MeasureName::Crossings
            | MeasureName::Count
            | MeasureName::CountRises
            | MeasureName::CountTurns
            | MeasureName::Peaks => Unit::none(),
            MeasureName::Duration
            | MeasureName::Period
            | MeasureName::Settling
            | MeasureName::First
            | MeasureName::Rises
            | MeasureName::Turns
            | MeasureName::Time => Unit::parse("s").expect("the second is known"),
            MeasureName::Min
            | MeasureName::Max
            | MeasureName::Mean
            | MeasureName::Rms
            | MeasureName::Final
            | MeasureName::At
            | MeasureName::Peak
            | MeasureName::PeakToPeak => self.own_unit(value),
        }
    }

    fn measured(&self, id: ExprId) -> bool {
        let node = self.system.node(id);
        matches!(node, Node::Measure(..)) || node.operands().any(|operand| self.measured(operand))
    }
}

/// Whether the number is a valid index of a peak: 1, 2, 3, …
pub fn is_number_of_peak(number: f64) -> bool {
    number >= 1.0 && number.fract() == 0.0 && number < 1e9
}

/// Whether an expression depends on a quantity that satisfies `of`.
pub fn depends(system: &System, expr: ExprId, of: &dyn Fn(&Var) -> bool) -> bool {
    let mut seen = std::collections::HashSet::new();
    let mut stack = vec![expr];
    while let Some(id) = stack.pop() {
        if !seen.insert(id) {
            continue;
        }
        if let Node::Var(var) = system.node(id) {
            let var = system.var(*var);
            if of(var) {
                return true;
            }
            match var.definition {
                Definition::Value(value, _) | Definition::Held { value, .. } => stack.push(value),
                Definition::Continuous { initial, rate, .. } => stack.extend([initial, rate]),
                Definition::Sampled { initial, next, .. } => stack.extend([initial, next]),
                Definition::Missing | Definition::Free => {}
            }
        }
        stack.extend(system.node(id).operands());
    }
    false
}

fn compare(op: BinaryOp, a: Formula, b: Formula) -> Formula {
    let (a, b) = (Box::new(a), Box::new(b));
    match op {
        BinaryOp::Less => Formula::Less(a, b),
        BinaryOp::LessEqual => Formula::LessEqual(a, b),
        BinaryOp::Greater => Formula::Greater(a, b),
        BinaryOp::GreaterEqual => Formula::GreaterEqual(a, b),
        BinaryOp::NotEqual => Formula::Not(Box::new(equal(a, b))),
        _ => equal(a, b),
    }
}

fn equal(a: Box<Formula>, b: Box<Formula>) -> Formula {
    Formula::Near { value: a, target: b, tolerance: Box::new(Formula::Number(0.0)), relative: false }
}
