//! Reads experiments: what to run and how, what to plot, and what must hold.
//!
//! In: an experiment's syntax tree and changes from outside. Out: one [`Variant`] for each combination of its sweeps: a
//! flat system, its program, and a plan that refers to slots only. Knows nothing of integration.

mod command_line;
mod expectations;
pub mod held;
pub mod of_fit;
mod plots;
mod recording;
pub mod filters;
pub mod derived;
pub mod start_values;
mod sweeps;
pub mod vary;

pub use command_line::{ChangeOf, Overrides, overrides};
pub use expectations::is_number_of_peak;
pub use sweeps::spaced;

use command_line::{CommandLine, also};
use derived::derive;
use expectations::ExpectAt;
use plots::{CurveAt, PlotAt};
use recording::recording;
use sweeps::{combinations, grids, is_part_of, label, meets, same_path, unmatched_cases};

use crate::analysis::linearise::{OpenPorts, PortSlots, Ports, open};
use crate::analysis::parameter_checks;
use crate::analysis::tuning::{self, Tuned};
use crate::frontend::angles;
use crate::frontend::delays;
use crate::frontend::flatten::{Instance, Override, OverrideValue, Request, flatten};
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::lower::{Lowered, MOST_DENSE, Observed, evaluate, lower};
use crate::pipeline::{Depth, analyse};
use crate::rig::{self, LoadedRig};
use abi::format::duration as shown;
use abi::live;
use abi::plan::{self, MeasureKind, Method, PARTS, Solver};
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, BinaryOp, ExperimentStatement, Expr};
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
    /// Files that replace the recordings of a fit, as absolute paths.
    pub data: Vec<String>,
    /// Of a fit: the case and the recording that are run.
    pub part: of_fit::Part,
    /// Of a fit: the run is held to its recording, see [`held`].
    pub held: bool,
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
    pub rows: Arc<[f64]>,
    /// Of a fit: the time of the first row in the file, in s.
    pub begins: f64,
    /// Of a fit whose recording has no times: the row in the file of each steady point.
    pub points: Option<Arc<[usize]>>,
    /// Of a fit: the run can be held to its recording, and is where the changes say so.
    pub held: bool,
    /// Parameters that its panel may turn, in this order; all if there are none.
    pub tuned: Vec<Tuned>,
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
/// Most rows of data that an experiment may ask for.
const MOST_ROWS: f64 = 1e7;
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
    /// Columns that are computed from the others.
    derived: Vec<&'a ast::Derived>,
    plots: Vec<&'a ast::Plot>,
    tunes: Vec<&'a ast::Tuned>,
    expects: Vec<&'a ast::Expect>,
    records: Vec<&'a ast::Record>,
    /// `allow discretisation`
    stepped: bool,
    /// Names of all lints that it allows.
    allowed: Vec<&'a str>,
    /// Unknowns of a fit that are no parameters of its instance.
    unknowns: Vec<&'a ast::Vary>,
}

/// A change by a sweep or from outside.
#[derive(Clone, Copy)]
struct Change<'a> {
    path: &'a ast::Path,
    value: OverrideValue<'a>,
}

impl<'a> Change<'a> {
    /// The change as an override for flattening. Names in its value are resolved in the scope of this file.
    fn in_file(self, file: FileId) -> Override<'a> {
        Override { path: self.path, value: self.value, file }
    }
}

/// Reads and lowers an experiment.
///
/// # Errors
/// All errors; at least one.
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
            let part = of_fit::single(one, &changes.part, &changes.data);
            let experiment = of_fit::experiment_of(&part);
            fit = Some(part);
            Some(Cow::Owned(experiment))
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
    let fit = fit.as_ref();
    let experiment = &*experiment;
    // The missing `run` may be a misspelt word, which has been reported.
    let Some(mut parts) = parts(experiment, misread || loaded.has_errors(), &mut diagnostics) else {
        return Err(diagnostics);
    };
    if let (None, Some(more)) = (fit, parts.data.and_then(|data| data.more.first())) {
        let error = Diagnostic::error("E0301", "an experiment has one recording").label(more.span, "a second one");
        diagnostics.push(error.help("write an experiment for each; a `fit` takes several"));
    }
    parts.unknowns = fit.map_or(Vec::new(), of_fit::own_unknowns);
    // Changes from outside take precedence: a value that is set or varied there is not swept.
    let plain = |text: &str| text.split_whitespace().collect::<String>();
    let path = |path: &ast::Path| plain(loaded.files.slice(path.span));
    let said: Vec<String> =
        given.set.iter().map(|set| path(&set.path)).chain(given.vary.iter().map(|p| plain(p))).collect();
    parts.sweeps.retain(|sweep| !said.contains(&path(&sweep.path)));
    // So does a sweep from outside, which stands after those of the text.
    let swept: Vec<Vec<String>> =
        parts.sweeps.iter().map(|sweep| std::iter::once(&sweep.path).chain(&sweep.also).map(path).collect()).collect();
    let later = |k: usize| swept[k + 1..].iter().flatten().any(|path| swept[k].contains(path));
    let mut k = 0;
    parts.sweeps.retain(|sweep| {
        k += 1;
        loaded.files.get(sweep.span.file).name.starts_with("--") || !later(k - 1)
    });
    let steady = fit.is_some() && parts.data.is_some_and(of_fit::is_steady);
    let data =
        parts.data.map_or(Some(Vec::new()), |data| recording(loaded, sources, root, data, steady, &mut diagnostics));
    let Some(mut data) = data else { return Err(diagnostics) };
    if let (None, Some(first)) = (parts.data, parts.derived.first()) {
        let error = Diagnostic::error("E0903", "there is no recording").label(first.span, "a column of it");
        diagnostics.push(error.help("add `data \"bench.csv\" (t [s], x [mm])`"));
        return Err(diagnostics);
    }
    let texts = (loaded, sources, root);
    if derive(texts, &parts.derived, &mut data, steady, &mut diagnostics).is_none() {
        return Err(diagnostics);
    }
    let (mut rows, mut begins): (Arc<[f64]>, f64) = (Arc::from([]), 0.0);
    let mut points: Option<Arc<[usize]>> = None;
    if let (Some(fit), Some((_, first, _))) = (fit, data.first()) {
        if steady {
            let (times, order) = of_fit::hold(&mut data);
            (rows, points) = (times.into(), Some(order.into()));
        } else {
            begins = first.x.first().copied().unwrap_or(0.0);
            rows = match of_fit::interval(&first.x) {
                // Rounded times are put on their grid.
                Some(interval) => (0..first.x.len()).map(|k| k as f64 * interval).collect(),
                None => first.x.iter().map(|t| t - begins).collect(),
            };
            data.iter_mut().for_each(|(_, table, _)| table.x = rows.clone());
        }
        if parts.solver.is_none() && given.method.is_none() {
            let (method, step, tol) = of_fit::default_solver(fit, &rows, steady);
            (given.method, given.step, given.tol) = (Some(method), given.step.or(step), given.tol.or(tol));
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
    let args = prepared.as_ref().map_or(&[][..], |_| &parts.run.instance.args);
    let arg_paths: Vec<ast::Path> = args.iter().map(ast::Bind::path).collect();
    let written = || arg_paths.iter().zip(args).map(|(path, bind)| Change { path, value: (&bind.value).into() });
    let replaced = replaced_arguments(&parts, &given);
    if !replaced.is_empty() {
        let overrides = written().map(|change| change.in_file(root)).collect();
        let errors = errors_as_written(texts, &parts, prepared.as_ref(), &data, overrides, &replaced);
        if !errors.is_empty() {
            return Err(errors);
        }
    }
    let mut variants = Vec::new();
    for combination in combinations {
        let label = label(loaded, &parts, &combination);
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
        // Further paths of a sweep take the same value.
        let along = |change: &Change<'_>| {
            let sweep = parts.sweeps.iter().find(|sweep| std::ptr::eq(&sweep.path, change.path));
            sweep.map_or(&[][..], |sweep| &sweep.also[..])
        };
        let swept = combination.iter().flat_map(|(change, _)| {
            let (value, also) = (change.value, along(change));
            [*change].into_iter().chain(also.iter().map(move |path| Change { path, value }))
        });
        let changes = swept.chain(given.set.iter().map(CommandLine::change));
        let overrides = written().chain(changes).map(|change| change.in_file(root)).collect();
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
            Ok(variant) => variants.push(Variant { rows: rows.clone(), begins, points: points.clone(), ..variant }),
            Err(errors) => return Err(errors),
        }
    }
    // The cases of a sweep over models differ in their parameters.
    let nowhere = |item: &&&ast::Tuned| {
        let path = tuning::path(item, &loaded.files);
        !variants.iter().any(|variant| tuning::has(&variant.system, &path))
    };
    let unknown = parts.tunes.iter().filter(nowhere);
    let unknown: Vec<Diagnostic> =
        unknown.map(|item| tuning::unknown(item, &variants[0].system, &loaded.files)).collect();
    if unknown.is_empty() { Ok(variants) } else { Err(unknown) }
}

fn parts<'a>(
    experiment: &'a ast::Experiment,
    misread: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Statements<'a>> {
    let mut run: Option<&ast::Run> = None;
    let mut parts = (None, Vec::new(), None, Vec::new(), Vec::new());
    let (mut stepped, mut allowed, mut tunes) = (false, Vec::new(), Vec::new());
    let (mut unknown, mut derived) = (Vec::new(), Vec::new());
    let mut records: Vec<&ast::Record> = Vec::new();
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
            ExperimentStatement::Derived(one) => derived.push(one),
            ExperimentStatement::Plot(one) => parts.3.push(one),
            ExperimentStatement::Tune(all, _) => tunes.extend(all),
            ExperimentStatement::Expect(one) => parts.4.push(one),
            ExperimentStatement::Record(one) => records.push(one),
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
    Some(Statements {
        span: experiment.span,
        run,
        solver,
        sweeps,
        data,
        derived,
        plots,
        tunes,
        expects,
        records,
        stepped,
        allowed,
        unknowns: Vec::new(),
    })
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
    let records: Vec<usize> =
        parts.records.iter().flat_map(|record| &record.shows).map(|show| add(&show.value)).collect();
    let every: Option<usize> = parts.records.iter().find_map(|record| record.every.as_ref()).map(&mut add);
    on_stage("flatten");
    let mut diagnostics = Vec::new();
    let mut held = false;
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
            let unknowns = of_fit::declared(&parts.unknowns, &mut diagnostics);
            let request = Request { instance, overrides, observed, data: data.to_vec(), frame: None, unknowns };
            let flat = flatten(loaded, sources, &request);
            let mut system = flat.system;
            diagnostics.extend(flat.diagnostics);
            if !flat.observed.is_empty() {
                let compared = plots.last().map_or(&[][..], |(curves, _)| curves);
                let compared: Vec<ExprId> = compared.iter().map(|curve| flat.observed[curve.value]).collect();
                held = match given.held {
                    true => held::hold(&mut system, &compared),
                    false => held::is_possible(&system, &compared),
                };
            }
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
    let tuned = tuning::read(&parts.tunes, &system, &types, &loaded.files, &mut reader.diagnostics);
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
    let shows = parts.records.iter().flat_map(|record| &record.shows);
    let records_at: Vec<usize> = shows.zip(&records).map(|(show, at)| reader.record(show, nodes[*at])).collect();
    let every = every.and_then(|at| reader.every(parts, nodes[at], duration, &solver, cut.is_some()));
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
    let records = records_at.into_iter().map(series).collect();
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
    let experiment = plan::Experiment {
        name: name.to_string(),
        duration,
        solver,
        bench: None,
        plots,
        records,
        every,
        expects,
        corners,
        stepped,
    };
    let inputs = ports.inputs.iter().filter_map(|(path, moved)| {
        let quantity = program.description.quantity(moved)?;
        Some((path.clone(), quantity.slot))
    });
    let outputs = ports.outputs.iter().zip(ports_at).map(|((path, _), at)| (path.clone(), slots[at]));
    let ports = (inputs.collect(), outputs.collect());
    let (rows, begins, points) = (Arc::from([]), 0.0, None);
    Ok(Variant {
        label,
        system,
        types,
        program,
        adaptive,
        experiment,
        places,
        ports,
        rig,
        rows,
        begins,
        points,
        held,
        tuned,
    })
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

/// Spans of the arguments of a run that a sweep or a change from outside replaces, as a whole or in part.
fn replaced_arguments(parts: &Statements, given: &CommandLine) -> Vec<Span> {
    let swept = parts.sweeps.iter().flat_map(|sweep| std::iter::once(&sweep.path).chain(&sweep.also));
    let changed: Vec<&ast::Path> = swept.chain(given.set.iter().map(|set| &set.path)).collect();
    let is_changed = |bind: &&ast::Bind| changed.iter().any(|path| is_part_of(path, &bind.path()));
    parts.run.instance.args.iter().filter(is_changed).map(|bind| bind.span).collect()
}

/// The errors in replaced arguments. No run uses such a value, but an engineer reads it as one of the experiment, so its
/// names and units are checked. `overrides`: the arguments of a rig.
fn errors_as_written<'a>(
    (loaded, sources, root): (&'a Loaded, &'a dyn Sources, FileId),
    parts: &Statements<'a>,
    prepared: Option<&'a LoadedRig>,
    data: &[(String, Table, Unit)],
    overrides: Vec<Override<'a>>,
    replaced: &[Span],
) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    let (observed, data) = (Vec::new(), data.to_vec());
    match prepared {
        Some(prepared) => drop(rig::read(loaded, sources, prepared, overrides, observed, data, &mut found)),
        None => {
            let instance = Instance::Written(&parts.run.instance, root);
            let unknowns = of_fit::declared(&parts.unknowns, &mut found);
            let flat =
                flatten(loaded, sources, &Request { instance, overrides, observed, data, frame: None, unknowns });
            found.extend(flat.diagnostics);
            analyse(&flat.system, &loaded.files, Depth::Units, &Diagnostic::is_error, &mut found);
        }
    }
    // E0203 reports a missing argument, which the sweep may supply.
    let is_theirs = |error: &Diagnostic| {
        error.code != "E0203"
            && error.labels.iter().any(|label| replaced.iter().any(|span| label.span.is_within(*span)))
    };
    found.retain(|error| error.is_error() && is_theirs(error));
    found
}

/// Whether a diagnostic lies outside a span.
fn outside_of(place: Span, diagnostic: &Diagnostic) -> bool {
    !diagnostic.span().is_within(place)
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
                let all = Method::list(Method::ALL);
                self.diagnostics.push(error.help(match solver.method.text.starts_with("ode") {
                    true => format!("`solver adaptive` chooses its steps, also for stiff models, and is the default; solvers are {all}"),
                    false => format!("solvers are {all}"),
                }));
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

    /// A quantity of the data.
    fn record(&mut self, show: &ast::Show, node: ExprId) -> usize {
        if self.measured(node) {
            let error = Diagnostic::error("E0901", "a measure has one value for the whole run, and the data have rows")
                .label(show.span, "record the quantity itself");
            self.diagnostics.push(error.help("write `show` in place of `record` to see it after the run"));
        }
        let unit = show.unit.as_ref().and_then(|text| self.unit_for(node, text));
        self.want(node, unit)
    }

    /// The distance of the rows of the data.
    fn every(&mut self, parts: &Statements, node: ExprId, duration: f64, solver: &Solver, is_rig: bool) -> Option<f64> {
        let given: Vec<&Expr> = parts.records.iter().filter_map(|record| record.every.as_ref()).collect();
        if let [first, again, ..] = given[..] {
            let error = Diagnostic::error("E0301", "the rows of the data have one distance")
                .label(again.span, "again here")
                .label(first.span, "first here");
            self.diagnostics.push(error.help("write `every` once, or another experiment"));
        }
        let (span, reported) = (self.system.span(node), self.diagnostics.len());
        let every = self.time(node, "the distance of rows");
        if self.diagnostics.len() > reported {
            return None;
        }
        if is_rig {
            let error = Diagnostic::error("E0905", "the data of a rig's dry run have a row for each tick");
            self.diagnostics.push(error.label(span, "no other distance is possible").help("leave `every` out"));
            return None;
        }
        if every > duration * (1.0 + 1e-9) {
            let error = Diagnostic::error(
                "E0902",
                format!("rows every {} in a run of {}", shown(every, 3), shown(duration, 3)),
            );
            let error = error.label(span, "longer than the run");
            self.diagnostics.push(error.help("take a shorter time, or `show final(x)` for the last value"));
            return None;
        }
        if duration / every > MOST_ROWS {
            let rows = abi::format::three_digits(duration / every);
            let error =
                Diagnostic::error("E0902", format!("{rows} rows are too many")).label(span, "so short a distance");
            self.diagnostics.push(error.help("ten million are possible: take a longer time"));
            return None;
        }
        if solver.method != Method::Adaptive && !live::is_multiple(every, solver.step) {
            let error = Diagnostic::error("E0701", live::no_multiple(every, solver.step))
                .label(span, "rows fall on whole steps");
            self.diagnostics.push(error.help("take a whole multiple of the step"));
            return None;
        }
        Some(every)
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
                recorded.map_or_else(|| Unit::si(table.y_unit.dimension), |(_, unit)| unit.clone())
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
            Ok(unit) if unit.dimension == self.dimension(expr) => {
                let files = &self.loaded.files;
                self.diagnostics.extend(angles::shown_in(self.system, self.types, files, (expr, &unit), text.span));
                Some(unit)
            }
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
}

/// Whether an expression depends on a quantity that satisfies `of`.
pub fn depends(system: &System, expr: ExprId, of: &dyn Fn(&Var) -> bool) -> bool {
    let mut seen = crate::ir::hash::HashSet::default();
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

/// The text on one line.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
