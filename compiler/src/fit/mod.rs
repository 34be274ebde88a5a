//! Reads fits: which parameters are unknown, in which ranges, and which quantities are compared with recordings.
//!
//! In: a fit's syntax tree. Out: the experiments that it runs, one for each recording of each case, lowered, and their
//! unknowns as slots and numbers. Knows nothing of the search.

mod unknown;

pub use unknown::Unknown;

use crate::experiment::derived::equidistant;
use crate::experiment::filters::Thin;
use crate::experiment::of_fit::{self, Compared, compared, reads_recording, sides};
use crate::experiment::vary::{Varying, param_of};
use crate::experiment::{self, Changes, Variant, held};
use crate::fit::unknown::{typical, unknown};
use crate::frontend::literals::number;
use crate::frontend::resolve::Loaded;
use crate::frontend::source::Sources;
use abi::Slot;
use abi::description::Kind;
use abi::plan::Plot;
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, ExperimentStatement, Expr, FitStatement};
use grammar::diagnostic::{Diagnostic, Label};
use grammar::span::Span;
use std::sync::Arc;

/// A fit, compiled; of several alternatives, one of them.
pub struct Fit {
    /// The alternative: `fr = LuGre()`; empty if there is one only.
    pub label: String,
    /// Recordings that are judged and not fitted, each with the unknowns that the fit shares, and those of its own.
    pub judged: Vec<Fit>,
    /// Its runs: each recording of each case.
    pub parts: Vec<Part>,
    /// The unknown parameters, of all runs together.
    pub unknowns: Vec<Unknown>,
    /// The name of the fit.
    pub name: Span,
    /// Lints that the fit allows.
    pub allowed: Vec<String>,
}

/// A run of a fit, compiled.
pub struct Part {
    /// Runs of its experiment under other values.
    pub varying: Varying,
    /// The same runs, held to the recording by an observer whose pole is in this slot; none if no state is compared.
    pub held: Option<(Varying, Slot)>,
    /// What it asks.
    pub asks: Asks,
}

/// What a run of a fit asks, in slots and numbers.
#[derive(Clone, Debug)]
pub struct Asks {
    /// What it is called beside other runs: the case, the recording, or both.
    pub label: String,
    /// The recording, as written.
    pub recording: String,
    /// Which case and which recording it is.
    pub place: of_fit::Part,
    /// The slot of each unknown of the fit; none if this run does not depend on it.
    pub slots: Vec<Option<Slot>>,
    /// The compared quantities.
    pub items: Vec<Item>,
    /// Times of the rows of the recording in s, from 0.
    pub rows: Arc<[f64]>,
    /// The columns of the recording beside time: name, unit, and a value in SI for each row.
    pub columns: Vec<(String, Unit, Arc<[f64]>)>,
    /// The rows are steady points, without time: each is held for [`of_fit::HELD`], and compared at the end.
    pub steady: bool,
    /// The row in the file of each steady point, which are held in rising order of the first column.
    pub points: Arc<[usize]>,
    /// Times at which the recorded inputs have corners, in s.
    pub corners: Arc<[f64]>,
    /// Time of the first row in the file, in s.
    pub begins: f64,
    /// Rows from this time to that time are compared.
    pub window: (f64, f64),
    /// Whether the recording drives the run.
    pub driven: bool,
    /// Whether the model has regimes.
    pub regimes: bool,
    /// The solver is written in the text or given from outside.
    pub solver_given: bool,
    /// The model that the fit runs, as written.
    pub model: String,
    /// How many residuals it has.
    residuals: usize,
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
    /// The filter of `thin`.
    pub thin: Option<Thin>,
    /// Both sides of the difference, as written, with their slots; none if it is not a difference.
    pub sides: Option<[(String, Slot); 2]>,
}

impl Item {
    /// What is compared, as written.
    pub fn shown(&self) -> String {
        match &self.thin {
            Some(thin) => format!("thin({}, {})", self.text, thin.n),
            None => self.text.clone(),
        }
    }

    /// The rows of its residuals, of those at these times.
    pub fn kept(&self, times: &[f64]) -> Vec<usize> {
        self.thin.as_ref().map_or_else(|| (0..times.len()).collect(), |thin| thin.kept(times))
    }
}

/// The statements of a run of a fit that are no experiment's.
struct Parts<'a> {
    run: &'a ast::Run,
    vary: Vec<&'a ast::Vary>,
    minimise: &'a ast::Minimise,
    /// The compared expressions.
    items: Vec<Compared<'a>>,
}

/// A run of a fit, lowered.
pub struct Run {
    /// Its experiment.
    pub variant: Variant,
    /// The paths that vary.
    pub paths: Vec<String>,
    /// The same, held to its recording.
    pub held: Option<Variant>,
    /// Number of alternatives.
    alternatives: usize,
    /// What it asks.
    pub asks: Asks,
}

/// A fit, lowered; of several alternatives, one of them.
pub struct Read {
    /// The alternative: `fr = LuGre()`; empty if there is one only.
    pub label: String,
    /// Recordings that are judged and not fitted.
    pub judged: Vec<Read>,
    /// Its runs.
    pub runs: Vec<Run>,
    /// The unknown parameters.
    pub unknowns: Vec<Unknown>,
    /// Its name.
    pub name: Span,
    /// Lints that it allows.
    pub allowed: Vec<String>,
}

/// The slots of the compared quantities in the plan of a run, each once, in their order: what is read after each step.
pub fn compared_slots(plan: &abi::plan::Experiment, asks: &Asks) -> Vec<Slot> {
    let mut slots = Vec::new();
    let mut series = plan.plots.last().map_or(&[][..], |plot| &plot.series).iter();
    for item in &asks.items {
        slots.extend(series.next().map(|series| series.slot).filter(|slot| !slots.contains(slot)));
        // Both sides follow a difference.
        series.by_ref().take(if item.sides.is_some() { 2 } else { 0 }).for_each(drop);
    }
    slots
}

/// The fit of this name in the root file.
pub fn find<'a>(loaded: &'a Loaded, name: &str) -> Option<&'a ast::Fit> {
    loaded.files.get(loaded.root()).ast.items().find_map(|item| match item {
        ast::Item::Fit(fit) if fit.name.text == name => Some(fit),
        _ => None,
    })
}

/// The statements of a run of a fit: of one case, with one recording. Others than those of experiments are as written.
pub fn single(fit: &ast::Fit, part: of_fit::Part) -> ast::Fit {
    of_fit::single(fit, &part, &[])
}

/// Most alternatives of a fit.
const MOST_ALTERNATIVES: usize = 64;

/// Reads a fit: the experiments that it runs with its unknowns variable, and what it asks; once for each combination of
/// its sweeps.
///
/// # Errors
/// All errors of the fit and of the models it runs.
pub fn read(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Vec<Read>, Vec<Diagnostic>> {
    let Some(fit) = find(loaded, name).cloned() else {
        let error = Diagnostic::error("E0201", format!("there is no fit `{name}`"));
        return Err(vec![error.label(Span::new(loaded.root(), 0, 0), "in this file")]);
    };
    let (mut all, mut missing): (Vec<Read>, Vec<Vec<Span>>) = (Vec::new(), Vec::new());
    let mut count = 1;
    while all.len() < count {
        let asked = Asked { fit: &fit, changes, alternative: all.len(), lenient: true };
        let mut found = Vec::new();
        let mut lacks = Vec::new();
        let (read, alternatives) = alternative(loaded, sources, &asked, &mut found, &mut lacks)?;
        warnings.extend(found.into_iter().filter(|one| !warnings.contains(one)).collect::<Vec<_>>());
        count = alternatives;
        if count > MOST_ALTERNATIVES {
            let error = Diagnostic::error("E0902", format!("{count} alternatives are too many"));
            let error = error.label(fit.name.span, "so many combinations of its sweeps");
            return Err(vec![error.help(format!("up to {MOST_ALTERNATIVES} can be ranked"))]);
        }
        all.push(read);
        missing.push(lacks);
    }
    // An unknown that some alternatives lack is not theirs; one that all lack is a mistake.
    let lost = |span: &&Span| missing.iter().all(|lacks| lacks.contains(span));
    if missing[0].iter().any(|span| lost(&span)) {
        let asked = Asked { fit: &fit, changes, alternative: 0, lenient: false };
        return match alternative(loaded, sources, &asked, &mut Vec::new(), &mut Vec::new()) {
            Err(errors) => Err(errors),
            Ok(_) => unreachable!("an unknown is missing"),
        };
    }
    Ok(all)
}

/// One alternative of a fit.
struct Asked<'a> {
    fit: &'a ast::Fit,
    changes: &'a Changes,
    alternative: usize,
    /// An unknown that it lacks is left out.
    lenient: bool,
}

/// Reads one alternative of a fit; returns it with the number of all. `missing`: unknowns that it lacks.
fn alternative(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    asked: &Asked,
    warnings: &mut Vec<Diagnostic>,
    missing: &mut Vec<Span>,
) -> Result<(Read, usize), Vec<Diagnostic>> {
    let Asked { fit, changes, .. } = *asked;
    let places = of_fit::runs(fit, &changes.data);
    let (mut read, alternatives) = part(loaded, sources, asked, &places, warnings, missing)?;
    for place in of_fit::judgements(fit) {
        let (one, _) = part(loaded, sources, asked, &[place], warnings, &mut Vec::new())?;
        read.judged.push(one);
    }
    Ok((read, alternatives))
}

/// Reads some runs of a fit, with their unknowns.
fn part(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    asked: &Asked,
    places: &[of_fit::Part],
    warnings: &mut Vec<Diagnostic>,
    missing: &mut Vec<Span>,
) -> Result<(Read, usize), Vec<Diagnostic>> {
    let Asked { fit, changes, alternative, lenient } = *asked;
    let labels = labels(fit, places, &changes.data);
    let mut diagnostics = Vec::new();
    let mut found: Vec<(Run, ast::Fit)> = Vec::new();
    for (place, (label, recording)) in places.iter().zip(labels) {
        let place = of_fit::Part { alternative, ..*place };
        let single = of_fit::single(fit, &place, &changes.data);
        let changes = Changes { part: place, ..changes.clone() };
        let kind = if of_fit::cases(fit).next().is_some() { "case" } else { "fit" };
        match run(loaded, sources, (&fit.name.text, kind), &changes, &single, warnings) {
            Ok(mut run) => {
                (run.asks.label, run.asks.recording, run.asks.place) = (label, recording, place);
                found.push((run, single));
            }
            // The same text gives the same errors for each recording.
            Err(errors) => {
                diagnostics.extend(errors.into_iter().filter(|one| !diagnostics.contains(one)).collect::<Vec<_>>())
            }
        }
    }
    // Errors of an unreadable text have been reported, and are none here.
    if found.len() < places.len() {
        return Err(diagnostics);
    }
    let vary: Vec<&ast::Vary> = fit.body.iter().flat_map(varied).collect();
    let unknowns = unknowns(loaded, &vary, &mut found, lenient.then_some(missing), &mut diagnostics);
    let is_judged = places.iter().any(|place| place.judged);
    if let Some((rows, unknowns)) = few(&found, &unknowns).filter(|_| diagnostics.is_empty() && !is_judged) {
        let minimise = found[0].1.body.iter().find_map(|statement| match statement {
            FitStatement::Minimise(minimise) => Some(minimise.span),
            FitStatement::Experiment(_)
            | FitStatement::Vary(..)
            | FitStatement::Case(_)
            | FitStatement::Validate(..) => None,
        });
        let [rows, unknowns] = [(rows, "row"), (unknowns, "unknown")].map(counted);
        let message = format!("{rows} cannot determine {unknowns}");
        let error = Diagnostic::error("E0910", message).label(minimise.unwrap_or(fit.name.span), "compared here");
        diagnostics.push(error.help("compare more rows, or vary fewer parameters"));
    }
    if !diagnostics.is_empty() {
        return Err(diagnostics);
    }
    let allowed = fit.body.iter().filter_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Allow(allow)) => Some(allow.lint.text.clone()),
        _ => None,
    });
    let allowed = allowed.collect();
    let (label, alternatives) = (found[0].0.variant.label.clone(), found[0].0.alternatives);
    let runs = found.into_iter().map(|(run, _)| run).collect();
    Ok((Read { label, judged: Vec::new(), runs, unknowns, name: fit.name.span, allowed }, alternatives))
}

/// Rows and unknowns, where there are too few rows: of all runs together, or of one for its own unknowns.
fn few(found: &[(Run, ast::Fit)], unknowns: &[Unknown]) -> Option<(usize, usize)> {
    let count = |k: usize| {
        let asks = &found[k].0.asks;
        let own = unknowns.iter().filter(|unknown| unknown.of == Some(k)).count();
        (asks.residuals, own)
    };
    let counts: Vec<(usize, usize)> = (0..found.len()).map(count).collect();
    let rows: usize = counts.iter().map(|(rows, _)| rows).sum();
    let few = counts.iter().copied().find(|(rows, own)| rows <= own && *own > 0);
    few.or((rows <= unknowns.len()).then_some((rows, unknowns.len())))
}

/// What each run is called, and its recording as written. Names that occur twice are numbered.
fn labels(fit: &ast::Fit, places: &[of_fit::Part], given: &[String]) -> Vec<(String, String)> {
    let case = |place: &of_fit::Part| of_fit::cases(fit).nth(place.case).map(|case| case.name.text.clone());
    let recording = |place: &of_fit::Part| match given.get(place.recording).filter(|_| !place.judged) {
        None if place.judged => of_fit::judged(fit, place.case)[place.recording].text.clone(),
        Some(file) => file.clone(),
        None => {
            of_fit::recordings(fit, place.case).get(place.recording).map_or(String::new(), |file| file.text.clone())
        }
    };
    let stem = |file: &str| {
        let name = file.rsplit(['/', '\\']).next().unwrap_or(file);
        name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_string()
    };
    let mut out: Vec<(String, String)> = Vec::new();
    for place in places {
        let recording = recording(place);
        let of_case = places.iter().filter(|other| other.case == place.case).count();
        let label = match case(place) {
            Some(case) if of_case == 1 => case,
            Some(case) => format!("{case}_{}", stem(&recording)),
            None => stem(&recording),
        };
        let twins =
            out.iter().filter(|(other, _)| other.rsplit_once('~').map_or(&other[..], |(name, _)| name) == label);
        let label = match twins.count() {
            0 => label,
            n => format!("{label}~{}", n + 1),
        };
        out.push((label, recording));
    }
    out.into_iter().map(|(label, recording)| (label.replace('~', "_"), recording)).collect()
}

fn varied(statement: &FitStatement) -> &[ast::Vary] {
    match statement {
        FitStatement::Vary(all, _) => all,
        FitStatement::Experiment(_)
        | FitStatement::Minimise(_)
        | FitStatement::Case(_)
        | FitStatement::Validate(..) => &[],
    }
}

/// The unknowns of all runs; enters their slots into the runs. `missing`: collects those that no run has, which otherwise
/// are errors.
fn unknowns(
    loaded: &Loaded,
    vary: &[&ast::Vary],
    runs: &mut [(Run, ast::Fit)],
    mut missing: Option<&mut Vec<Span>>,
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<Unknown> {
    let mut all: Vec<Unknown> = Vec::new();
    for one in vary {
        let path = plain(loaded, one.path.span);
        let systems: Vec<String> = runs.iter().map(|(_, single)| system_path(one, &path, single)).collect();
        let has = |k: usize| unknown::exists(&runs[k].0.variant.program.description, one, &systems[k]);
        let mut with: Vec<usize> = (0..runs.len()).filter(|k| has(*k)).collect();
        if let (true, Some(missing)) = (with.is_empty(), &mut missing) {
            missing.push(one.span);
            continue;
        }
        if with.is_empty() {
            // The first run says what is wrong.
            with.push(0);
        }
        let groups: Vec<Vec<usize>> = if one.each { with.into_iter().map(|k| vec![k]).collect() } else { vec![with] };
        for group in groups {
            let (run, _) = &runs[group[0]];
            let Some(mut read) = unknown(&run.variant, one, (&path, &systems[group[0]]), diagnostics) else { break };
            if one.each {
                read.of = Some(group[0]);
                if runs.len() > 1 {
                    read.label = format!("{} of {}", read.label, run.asks.label);
                }
            }
            let at = all.len();
            for (k, (run, _)) in runs.iter_mut().enumerate() {
                let slot =
                    group.contains(&k).then(|| param_of(&run.variant.program.description, &systems[k])).flatten();
                run.asks.slots.resize(at, None);
                run.asks.slots.push(slot.map(|param| param.slot));
            }
            all.push(read);
        }
    }
    for (run, _) in runs.iter() {
        order(run, &mut all);
    }
    all
}

/// Enters which unknowns must not lie below which others, as the ranges and `require` conditions of a run say.
fn order(run: &Run, unknowns: &mut [Unknown]) {
    let Run { variant, asks, .. } = run;
    let at = |slot: Slot| asks.slots.iter().position(|other| *other == Some(slot));
    for (upper, lower) in unknown::orders(variant) {
        let (Some(upper), Some(lower)) = (at(upper), at(lower)) else { continue };
        let shared = unknowns[lower].of.is_none() || unknowns[lower].of == unknowns[upper].of;
        let room = unknowns[upper].range.1 - unknowns[lower].range.0;
        let least = 1e-2 * (unknowns[lower].range.1 - unknowns[lower].range.0);
        let mut below = Some(lower);
        while below.is_some_and(|k| k != upper) {
            below = below.and_then(|k| unknowns[k].above);
        }
        if unknowns[upper].above.is_none() && below.is_none() && shared && room > least {
            unknowns[upper].above = Some(lower);
        }
    }
}

/// The path of an unknown in the system of a run.
fn system_path(vary: &ast::Vary, path: &str, single: &ast::Fit) -> String {
    match of_fit::own_unknowns(single).iter().any(|own| own.span == vary.span) {
        true => of_fit::own_path(path),
        false => path.to_string(),
    }
}

/// Reads one run of a fit: the experiment with its unknowns variable, and what it asks. `kind`: what its statements
/// stand in.
fn run(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    (name, kind): (&str, &str),
    changes: &Changes,
    fit: &ast::Fit,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Run, Vec<Diagnostic>> {
    let parts = parts(fit, kind)?;
    let paths: Vec<String> =
        parts.vary.iter().map(|vary| system_path(vary, &plain(loaded, vary.path.span), fit)).collect();
    let mut changes = Changes { vary: paths.clone(), ..changes.clone() };
    let solver_given = changes.method.is_some() || changes.step.is_some() || has_solver(fit);
    let mut first_warnings = Vec::new();
    let first = experiment::read(loaded, sources, name, &changes, &mut first_warnings, &mut |_| ());
    // A parameter that is computed from others, or has no value, is assigned one, as in a sweep.
    let at = changes.part.alternative;
    let is_written = |path: &String| {
        let given = changes.set.iter().filter_map(|set| set.split('=').next()).any(|set| set.trim() == path);
        given || parts.run.instance.args.iter().any(|arg| arg.name.text == *path)
    };
    let missing: Vec<usize> = match &first {
        Ok(variants) => {
            let description = &variants[at].program.description;
            let is_open = |path: &String| {
                param_of(description, path).is_none()
                    && description.quantity(path).is_some_and(|found| found.kind != Kind::State)
            };
            (0..paths.len()).filter(|k| is_open(&paths[*k])).collect()
        }
        // Values that are written stay, and so do their mistakes.
        Err(errors) if errors.iter().all(|error| error.code == "E0203") => {
            (0..paths.len()).filter(|k| !is_written(&paths[*k])).collect()
        }
        Err(_) => Vec::new(),
    };
    let set: Vec<String> = missing
        .iter()
        .filter(|k| !parts.vary[**k].initial && !paths[**k].ends_with(')'))
        .filter_map(|k| Some(format!("{}={}", paths[*k], typical(parts.vary[*k])?)))
        .collect();
    let variants = match first {
        Ok(variants) if set.is_empty() => {
            warnings.append(&mut first_warnings);
            variants
        }
        Err(errors) if set.is_empty() => return Err(errors),
        first => {
            changes.set.extend(set.clone());
            // A long recording is in memory once.
            let as_written = first.err();
            match experiment::read(loaded, sources, name, &changes, warnings, &mut |_| ()) {
                Ok(variants) => variants,
                // The errors of the text as it is written, rather than of the values above.
                Err(errors) => {
                    let is_ours = |label: &Label| {
                        let file = loaded.files.get(label.span.file);
                        file.name.starts_with("--") && set.iter().any(|set| *set == *file.text)
                    };
                    let of_text = |error: &&Diagnostic| !error.labels.iter().any(is_ours);
                    let own: Vec<Diagnostic> = errors.iter().filter(of_text).cloned().collect();
                    return Err(if own.is_empty() { as_written.unwrap_or(errors) } else { own });
                }
            }
        }
    };
    let alternatives = variants.len();
    let mut variant = variants.into_iter().nth(at).expect("there are as many combinations as at first");
    let mut diagnostics = Vec::new();
    let asks = asks(loaded, &parts, &variant, solver_given, &mut diagnostics);
    let Some(asks) = asks.filter(|_| diagnostics.is_empty()) else { return Err(diagnostics) };
    let window = |plan: &mut abi::plan::Experiment| {
        let shown = plan.expects.len() - asks.items.len();
        for measure in &mut plan.expects[shown..] {
            (measure.after, measure.before) = (asks.window.0, asks.window.1.min(plan.duration));
        }
    };
    window(&mut variant.experiment);
    let held = match asks.regimes || asks.steady || !variant.held {
        true => None,
        false => {
            let vary = paths.iter().cloned().chain([held::POLE.to_string()]).collect();
            let changes = Changes { held: true, vary, any_step: true, ..changes };
            let read = experiment::read(loaded, sources, name, &changes, &mut Vec::new(), &mut |_| ());
            let held = read.ok().and_then(|variants| variants.into_iter().nth(at)).filter(|held| held.held);
            held.map(|mut held| {
                window(&mut held.experiment);
                held
            })
        }
    };
    Ok(Run { variant, paths, held, alternatives, asks })
}

fn has_solver(fit: &ast::Fit) -> bool {
    fit.body.iter().any(|one| matches!(one, FitStatement::Experiment(ExperimentStatement::Solver(_))))
}

/// A path as written, without blanks.
fn plain(loaded: &Loaded, span: Span) -> String {
    loaded.files.slice(span).split_whitespace().collect()
}

/// The statements of a fit, by kind.
fn parts<'a>(fit: &'a ast::Fit, kind: &str) -> Result<Parts<'a>, Vec<Diagnostic>> {
    let mut diagnostics = Vec::new();
    let (mut runs, mut data, mut minimise, mut vary) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for statement in &fit.body {
        match statement {
            FitStatement::Vary(all, _) => vary.extend(all),
            FitStatement::Minimise(one) => minimise.push(one),
            FitStatement::Case(_) | FitStatement::Validate(..) => {}
            FitStatement::Experiment(ExperimentStatement::Run(one)) => runs.push(one),
            FitStatement::Experiment(ExperimentStatement::Data(one)) => data.push(one.span),
            FitStatement::Experiment(ExperimentStatement::Record(one)) => {
                let error =
                    Diagnostic::error("E0905", "a fit writes what it compares").label(one.span, "not for a fit");
                diagnostics.push(error.help("write an experiment with the fitted model, and `record` in it"));
            }
            FitStatement::Experiment(
                ExperimentStatement::Solver(_)
                | ExperimentStatement::Derived(_)
                | ExperimentStatement::Sweep(_)
                | ExperimentStatement::Plot(_)
                | ExperimentStatement::Tune(..)
                | ExperimentStatement::Expect(_)
                | ExperimentStatement::Allow(_),
            ) => {}
        }
    }
    let mut lacks = |what: &str, is_there: bool, help: &str| {
        if !is_there {
            let error = Diagnostic::error("E0902", format!("{kind} `{}` has no `{what}`", fit.name.text));
            diagnostics.push(error.label(fit.name.span, format!("there is no `{what}` in it")).help(help));
        }
    };
    lacks("run", !runs.is_empty(), "add the model that the recording is of, such as `run Tustin(v = data.v)`");
    lacks("data", !data.is_empty(), "add the recording: `data \"bench.csv\" (t [s], v [m/s], F [N])`");
    lacks("vary", !vary.is_empty(), "add what is unknown: `vary Fc in 0.1 N .. 10 N`");
    lacks("minimise", !minimise.is_empty(), "add what is compared: `minimise rms(F - data.F)`");
    if let [first, again, ..] = &minimise[..] {
        let error = Diagnostic::error("E0301", format!("a {kind} has one `minimise`"))
            .label(again.span, "again here")
            .label(first.span, "first here");
        diagnostics.push(error.help("list what is compared: `minimise rms(F - data.F), rms(x - data.x)`"));
    }
    let name_of = |vary: &ast::Vary| {
        let path = vary.path.segments.iter().map(|one| (one.name.text.clone(), one.index)).collect::<Vec<_>>();
        (vary.initial, path)
    };
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
        (true, Some(run), Some(minimise)) => Ok(Parts { run, vary, minimise, items }),
        _ => Err(diagnostics),
    }
}

fn asks(
    loaded: &Loaded,
    parts: &Parts,
    variant: &Variant,
    solver_given: bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Asks> {
    let plots = &variant.experiment.plots;
    let second = Dimension::of([0, 0, 1, 0, 0]);
    let mut time = |edge: Option<&Expr>, open: f64| edge.map_or(Some(open), |edge| number(edge, second, diagnostics));
    let after = time(parts.minimise.after.as_ref(), 0.0)?;
    let before = time(parts.minimise.before.as_ref(), f64::INFINITY)?;
    let rows = variant.rows.clone();
    let timed = [&parts.minimise.after, &parts.minimise.before, &parts.run.duration].into_iter().flatten().next();
    if let Some(time) = timed.filter(|_| variant.points.is_some()) {
        let error = Diagnostic::error("E0902", "steady points have no time").label(time.span, "a time");
        diagnostics.push(error.help("leave it out, or name the column of times `t`"));
    }
    let compared: Vec<f64> = rows.iter().copied().filter(|t| (after..=before).contains(t)).collect();
    let items = match compared.is_empty() {
        true => Vec::new(),
        false => items(loaded, parts, plots.last()?, (&compared, variant.points.is_some()), diagnostics),
    };
    if compared.is_empty() {
        let end = rows.last().copied().unwrap_or(0.0);
        let error = Diagnostic::error("E0902", "no row of the recording is compared")
            .label(parts.minimise.span, format!("the recording goes from 0 s to {end} s"));
        diagnostics.push(error.help("write a window that holds rows; time begins at the first row"));
    }
    let residuals = |item: &Item| compared.len().div_ceil(item.thin.as_ref().map_or(1, |thin| thin.n));
    let residuals = items.iter().map(residuals).sum();
    Some(Asks {
        label: String::new(),
        recording: String::new(),
        place: of_fit::Part::default(),
        slots: Vec::new(),
        items,
        columns: columns(variant),
        corners: of_fit::corners(&rows, variant.points.is_some()),
        rows,
        steady: variant.points.is_some(),
        points: variant.points.clone().unwrap_or_default(),
        begins: variant.begins,
        window: (after, before),
        driven: reads_recording(&parts.run.instance),
        solver_given,
        regimes: !variant.system.automata.is_empty(),
        model: parts.run.instance.model.text.clone(),
        residuals,
    })
}

/// The filter of `thin(e, n)` for rows at these times in s.
fn thinned(n: &Expr, rows: &[f64], steady: bool, diagnostics: &mut Vec<Diagnostic>) -> Option<Thin> {
    let interval = match equidistant(rows, steady, n.span) {
        Ok(interval) => interval,
        Err(error) => {
            diagnostics.push(error);
            return None;
        }
    };
    let number = number(n, Dimension::NONE, diagnostics)?;
    let most = rows.len() as f64;
    if !(number >= 2.0 && number.fract() == 0.0 && number <= most) {
        let error = Diagnostic::error("E0909", "`thin` keeps one of a whole number of rows, at least of 2");
        diagnostics.push(error.label(n.span, format!("{number}")).help("write `thin(F - data.F, 10)`"));
        return None;
    }
    let thin = Thin::new(number as usize, interval);
    if rows.len() < thin.least().max(2 * thin.n) {
        let least = thin.least().max(2 * thin.n);
        let message = format!("`thin` needs {least} rows, and {} are compared", rows.len());
        let error = Diagnostic::error("E0909", message).label(n.span, "too many for so few rows");
        diagnostics.push(error.help("leave `thin` out"));
        return None;
    }
    Some(thin)
}

fn items(
    loaded: &Loaded,
    parts: &Parts,
    plot: &Plot,
    (rows, steady): (&[f64], bool),
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<Item> {
    let mut series = plot.series.iter();
    let mut all = Vec::new();
    for Compared { of, sd, thin } in &parts.items {
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
        let thin = match thin {
            None => None,
            Some(n) => match thinned(n, rows, steady, diagnostics) {
                Some(thin) => Some(thin),
                None => continue,
            },
        };
        let (slot, unit) = (difference.slot, difference.unit.clone());
        all.push(Item { text: one_line(loaded, of.span), slot, unit, sd, thin, sides });
    }
    all
}

/// The columns of the recording beside time, with a value for each row.
fn columns(variant: &Variant) -> Vec<(String, Unit, Arc<[f64]>)> {
    // A steady point is held from one time to another.
    let every = if variant.points.is_some() { 2 } else { 1 };
    let tables = variant.system.tables.iter().filter(|table| table.y.len() == every * variant.rows.len());
    let column = |table: &crate::frontend::system::Table| {
        let name = table.name.strip_prefix("data.").filter(|name| *name != "t")?;
        let y = if every == 1 { table.y.clone() } else { table.y.iter().step_by(every).copied().collect() };
        Some((format!("data.{name}"), table.y_unit.clone(), y))
    };
    tables.filter_map(column).collect()
}

/// `1 row`, `2 rows`
fn counted((n, one): (usize, &str)) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

fn one_line(loaded: &Loaded, span: Span) -> String {
    loaded.files.slice(span).split_whitespace().collect::<Vec<_>>().join(" ")
}
