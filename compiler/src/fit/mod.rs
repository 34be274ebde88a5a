//! Reads fits: which parameters are unknown, in which ranges, and which quantities are compared with a recording.
//!
//! In: a fit's syntax tree. Out: the experiment that it runs, lowered, and a [`Fit`] of slots and numbers. Knows nothing
//! of the search.

mod unknown;

pub use unknown::Unknown;

use crate::experiment::of_fit::{self, compared, reads_recording, sides};
use crate::experiment::vary::{Varying, param_of};
use crate::experiment::{self, Changes, Variant};
use crate::fit::unknown::{typical, unknown};
use crate::frontend::literals::number;
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use abi::Slot;
use abi::description::Kind;
use abi::plan::Plot;
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, ExperimentStatement, Expr, FitStatement};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// A fit, compiled.
pub struct Fit {
    /// Runs of its experiment under other values.
    pub varying: Varying,
    /// What it asks.
    pub asks: Asks,
}

/// What a fit asks, in slots and numbers.
#[derive(Clone, Debug)]
pub struct Asks {
    /// The unknown parameters.
    pub unknowns: Vec<Unknown>,
    /// The compared quantities.
    pub items: Vec<Item>,
    /// Times of the rows of the recording in s, from 0.
    pub rows: Vec<f64>,
    /// The rows are steady points, without time: each is held for [`of_fit::HELD`], and compared at the end.
    pub steady: bool,
    /// Times at which the recorded inputs have corners, in s.
    pub corners: Vec<f64>,
    /// Time of the first row in the file, in s.
    pub begins: f64,
    /// Rows from this time to that time are compared.
    pub window: (f64, f64),
    /// Whether the recording drives the run.
    pub driven: bool,
    /// The solver is written in the text or given from outside.
    pub solver_given: bool,
    /// The model that the fit runs, as written.
    pub model: String,
    /// The name of the fit.
    pub name: Span,
    /// Lints that the fit allows.
    pub allowed: Vec<String>,
}

/// A compared quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Item {
    /// The difference as written: `F - data.F`.
    pub text: String,
    /// Slot of the difference.
    pub slot: Slot,
    /// Its unit.
    pub unit: Unit,
    /// Standard deviation of the measurement in SI, if it is given.
    pub sd: Option<f64>,
    /// Both sides of the difference, as written, with their slots; none if it is not a difference.
    pub sides: Option<[(String, Slot); 2]>,
}

/// The statements of a fit that are no experiment's.
struct Parts<'a> {
    fit: &'a ast::Fit,
    run: &'a ast::Run,
    vary: Vec<&'a ast::Vary>,
    minimise: &'a ast::Minimise,
    /// The compared expressions and their standard deviations.
    items: Vec<(&'a Expr, Option<&'a Expr>)>,
}

/// The fit of this name in the root file.
pub fn find<'a>(loaded: &'a Loaded, name: &str) -> Option<&'a ast::Fit> {
    loaded.files.get(loaded.root()).ast.items().find_map(|item| match item {
        ast::Item::Fit(fit) if fit.name.text == name => Some(fit),
        _ => None,
    })
}

/// Reads a fit: the experiment that it runs with its unknowns variable, and what it asks.
///
/// # Errors All errors of the fit and of the models it runs.
pub fn read(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
) -> Result<(Variant, Asks, Vec<String>), Vec<Diagnostic>> {
    let Some(fit) = find(loaded, name).cloned() else {
        let error = Diagnostic::error("E0201", format!("there is no fit `{name}`"));
        return Err(vec![error.label(Span::new(loaded.root(), 0, 0), "in this file")]);
    };
    let parts = parts(&fit)?;
    let paths: Vec<String> = parts.vary.iter().map(|vary| plain(loaded, vary.path.span)).collect();
    let mut changes = Changes { vary: paths.clone(), ..changes.clone() };
    let solver_given = changes.method.is_some() || changes.step.is_some() || has_solver(&fit);
    let mut first_warnings = Vec::new();
    let first = experiment::read(loaded, sources, name, &changes, &mut first_warnings, &mut |_| ());
    // A parameter that is computed from others, or has no value, is assigned one, as in a sweep.
    let missing: Vec<usize> = match &first {
        Ok(variants) => {
            let description = &variants[0].program.description;
            let is_open = |path: &String| {
                param_of(description, path).is_none()
                    && description.quantity(path).is_some_and(|found| found.kind != Kind::State)
            };
            (0..paths.len()).filter(|k| is_open(&paths[*k])).collect()
        }
        Err(_) => (0..paths.len()).collect(),
    };
    let set: Vec<String> =
        missing.iter().filter_map(|k| Some(format!("{}={}", paths[*k], typical(parts.vary[*k])?))).collect();
    let variants = match first {
        Ok(variants) if set.is_empty() => {
            warnings.append(&mut first_warnings);
            variants
        }
        first => {
            changes.set.extend(set);
            match (experiment::read(loaded, sources, name, &changes, warnings, &mut |_| ()), first) {
                (Ok(variants), _) => variants,
                // The errors of the text as it is written, rather than of the values above.
                (Err(_), Err(errors)) | (Err(errors), Ok(_)) => return Err(errors),
            }
        }
    };
    let mut variant = variants.into_iter().next().expect("there is one combination");
    let mut diagnostics = Vec::new();
    let asks = asks(loaded, &parts, &variant, &paths, solver_given, &mut diagnostics);
    match asks.filter(|_| diagnostics.is_empty()) {
        Some(asks) => {
            let plan = &mut variant.experiment;
            let shown = plan.expects.len() - asks.items.len();
            for measure in &mut plan.expects[shown..] {
                (measure.after, measure.before) = (asks.window.0, asks.window.1.min(plan.duration));
            }
            Ok((variant, asks, paths))
        }
        None => Err(diagnostics),
    }
}

fn has_solver(fit: &ast::Fit) -> bool {
    fit.body.iter().any(|one| matches!(one, FitStatement::Experiment(ExperimentStatement::Solver(_))))
}

/// A path as written, without blanks.
fn plain(loaded: &Loaded, span: Span) -> String {
    loaded.files.slice(span).split_whitespace().collect()
}

/// The statements of a fit, by kind.
fn parts(fit: &ast::Fit) -> Result<Parts<'_>, Vec<Diagnostic>> {
    let mut diagnostics = Vec::new();
    let (mut runs, mut data, mut minimise, mut vary) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for statement in &fit.body {
        match statement {
            FitStatement::Vary(all, _) => vary.extend(all),
            FitStatement::Minimise(one) => minimise.push(one),
            FitStatement::Experiment(ExperimentStatement::Run(one)) => runs.push(one),
            FitStatement::Experiment(ExperimentStatement::Data(one)) => data.push(one.span),
            FitStatement::Experiment(ExperimentStatement::Sweep(one)) => {
                let error =
                    Diagnostic::error("E0905", "a fit cannot sweep yet").label(one.span, "several laws at once");
                diagnostics.push(error.help("write a fit for each law"));
            }
            FitStatement::Experiment(ExperimentStatement::Record(one)) => {
                let error =
                    Diagnostic::error("E0905", "a fit writes what it compares").label(one.span, "not for a fit");
                diagnostics.push(error.help("write an experiment with the fitted model, and `record` in it"));
            }
            FitStatement::Experiment(
                ExperimentStatement::Solver(_)
                | ExperimentStatement::Plot(_)
                | ExperimentStatement::Tune(..)
                | ExperimentStatement::Expect(_)
                | ExperimentStatement::Allow(_),
            ) => {}
        }
    }
    let mut lacks = |what: &str, is_there: bool, help: &str| {
        if !is_there {
            let error = Diagnostic::error("E0902", format!("fit `{}` has no `{what}`", fit.name.text));
            diagnostics.push(error.label(fit.name.span, format!("there is no `{what}` in it")).help(help));
        }
    };
    lacks("run", !runs.is_empty(), "add the model that the recording is of, such as `run Tustin(v = data.v)`");
    lacks("data", !data.is_empty(), "add the recording: `data \"bench.csv\" (t [s], v [m/s], F [N])`");
    lacks("vary", !vary.is_empty(), "add what is unknown: `vary Fc in 0.1 N .. 10 N`");
    lacks("minimise", !minimise.is_empty(), "add what is compared: `minimise rms(F - data.F)`");
    if let [first, again, ..] = &minimise[..] {
        let error = Diagnostic::error("E0301", "a fit has one `minimise`")
            .label(again.span, "again here")
            .label(first.span, "first here");
        diagnostics.push(error.help("list what is compared: `minimise rms(F - data.F), rms(x - data.x)`"));
    }
    let name_of =
        |vary: &ast::Vary| vary.path.segments.iter().map(|one| (one.name.text.clone(), one.index)).collect::<Vec<_>>();
    for (k, one) in vary.iter().enumerate() {
        if let Some(first) = vary[..k].iter().find(|other| name_of(other) == name_of(one)) {
            let error = Diagnostic::error("E0301", "this parameter is varied twice")
                .label(one.path.span, "again here")
                .label(first.path.span, "first here");
            diagnostics.push(error.help("remove one"));
        }
    }
    if let Some(run) = runs.first()
        && run.instance.model.text.starts_with(|c: char| c.is_ascii_lowercase())
    {
        let error = Diagnostic::error("E0905", "a fit runs a model, not yet a rig").label(run.instance.span, "a rig");
        diagnostics.push(error.help("run the model of the rig with the recorded inputs"));
    }
    let mut items = Vec::new();
    for item in minimise.iter().take(1).flat_map(|minimise| &minimise.items) {
        match compared(item) {
            Some(item) => items.push(item),
            None => {
                let error = Diagnostic::error("E0901", "a fit compares by `rms`").label(item.span, "not an `rms`");
                diagnostics.push(error.help(
                    "write `rms(F - data.F)`, or `rms(F - data.F) / 5 mN` with the standard deviation of the measurement",
                ));
            }
        }
    }
    match (diagnostics.is_empty(), runs.first(), minimise.first()) {
        (true, Some(run), Some(minimise)) => Ok(Parts { fit, run, vary, minimise, items }),
        _ => Err(diagnostics),
    }
}

fn asks(
    loaded: &Loaded,
    parts: &Parts,
    variant: &Variant,
    paths: &[String],
    solver_given: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Asks> {
    let description = &variant.program.description;
    let plots = &variant.experiment.plots;
    let unknowns: Vec<Unknown> = parts
        .vary
        .iter()
        .zip(paths)
        .filter_map(|(vary, path)| unknown(variant, description, vary, path, diagnostics))
        .collect();
    let items = items(loaded, parts, plots.last()?, diagnostics);
    let second = Dimension::of([0, 0, 1, 0, 0]);
    let mut time = |edge: Option<&Expr>, open: f64| edge.map_or(Some(open), |edge| number(edge, second, diagnostics));
    let after = time(parts.minimise.after.as_ref(), 0.0)?;
    let before = time(parts.minimise.before.as_ref(), f64::INFINITY)?;
    let rows = variant.rows.clone();
    let timed = [&parts.minimise.after, &parts.minimise.before, &parts.run.duration].into_iter().flatten().next();
    if let Some(time) = timed.filter(|_| variant.steady) {
        let error = Diagnostic::error("E0902", "steady points have no time").label(time.span, "a time");
        diagnostics.push(error.help("leave it out, or name the column of times `t`"));
    }
    let compared = rows.iter().filter(|t| (after..=before).contains(*t)).count();
    if compared == 0 {
        let end = rows.last().copied().unwrap_or(0.0);
        let error = Diagnostic::error("E0902", "no row of the recording is compared")
            .label(parts.minimise.span, format!("the recording goes from 0 s to {end} s"));
        diagnostics.push(error.help("write a window that holds rows; time begins at the first row"));
    } else if compared * parts.items.len() <= parts.vary.len() {
        let [rows, unknowns] = [(compared, "row"), (parts.vary.len(), "unknown")].map(counted);
        let message = format!("{rows} cannot determine {unknowns}");
        let error = Diagnostic::error("E0910", message).label(parts.minimise.span, "compared here");
        diagnostics.push(error.help("compare more rows, or vary fewer parameters"));
    }
    let allowed = parts.fit.body.iter().filter_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Allow(allow)) => Some(allow.lint.text.clone()),
        _ => None,
    });
    Some(Asks {
        name: parts.fit.name.span,
        allowed: allowed.collect(),
        unknowns,
        items,
        corners: of_fit::corners(&rows, variant.steady),
        rows,
        steady: variant.steady,
        begins: variant.begins,
        window: (after, before),
        driven: reads_recording(&parts.run.instance),
        solver_given,
        model: parts.run.instance.model.text.clone(),
    })
}

fn items(loaded: &Loaded, parts: &Parts, plot: &Plot, diagnostics: &mut Vec<Diagnostic>) -> Vec<Item> {
    let mut series = plot.series.iter();
    let mut all = Vec::new();
    for (of, sd) in &parts.items {
        let difference = series.next().expect("each item is plotted");
        let sides = sides(of).map(|sides| {
            sides.map(|side| {
                let series = series.next().expect("both sides are plotted");
                (one_line(loaded, side.span), series.slot)
            })
        });
        let sd = match sd {
            None => None,
            Some(sd) => match number(sd, difference.unit.dimension, diagnostics) {
                Some(value) if value > 0.0 && value.is_finite() => Some(value),
                Some(value) => {
                    let error = Diagnostic::error("E0904", "a standard deviation is greater than 0")
                        .label(sd.span, format!("{value}"));
                    diagnostics.push(error.help("leave it out, and it is estimated"));
                    continue;
                }
                None => continue,
            },
        };
        let (slot, unit) = (difference.slot, difference.unit.clone());
        all.push(Item { text: one_line(loaded, of.span), slot, unit, sd, sides });
    }
    all
}

/// `1 row`, `2 rows`
fn counted((n, one): (usize, &str)) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

fn one_line(loaded: &Loaded, span: Span) -> String {
    loaded.files.slice(span).split_whitespace().collect::<Vec<_>>().join(" ")
}
