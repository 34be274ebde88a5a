//! `fric fit`: the parameters with which a model follows a recording, with intervals.
//!
//! Joins the compiled fit, which knows slots, and the search, which knows numbers. The result is shown as a table, as an
//! instance to paste, and written as JSON, CSV and a picture.

mod answer;
mod text;

use super::{End, load, reported, sound, sweep};
use crate::args;
use crate::commands::fit::answer::Fitted;
use crate::compile::{self, Asks, Changes, ElementaryFunction, HELD, Loaded, Options, Stopwatch};
use crate::figure::{self, Recorded};
use crate::plot::{self, Kind, Look};
use crate::project;
use crate::quantity::{count, duration, show, significant};
use crate::results;
use crate::terminal::{Style, Terminal};
use abi::plan::{Experiment, Method};
use abi::{Instance, Slot};
use grammar::ast::{ExperimentStatement, FitStatement};
use grammar::diagnostic::Diagnostic;
use runtime::engine::{self, Cause, Continue, Failure, lanes};
use runtime::fit::{Answer, Elementary, Item, Question, Trouble, Unknown};
use runtime::package;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Most trial points of a stage of the search.
const TRIALS: u32 = 100;
/// A step is short enough if half of it changes no residual by more than this part of the noise.
const PART_OF_NOISE: f64 = 0.1;
/// How often a step is halved at most.
const MOST_HALVINGS: u32 = 8;

pub fn fit(args: &args::Fit, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load(&args.file, terminal, &mut watch) else { return End::Failed };
    let names = match chosen(&args.file, &args.fits, &loaded) {
        Ok(names) => names,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    let data = match args.data.as_deref().map(std::path::absolute).transpose() {
        Ok(data) => data.map(|path| path.display().to_string()),
        Err(error) => {
            terminal.error(&format!("--data: {error}"));
            return End::Failed;
        }
    };
    if sound(&loaded, args.json || args.quiet, terminal, &mut watch).is_err() {
        return End::Failed;
    }
    let changes = Changes { data, tol: args.tol, ..args.stepped.changes() };
    let options = Options { changes, interpret: args.interpret };
    let mut end = End::Fine;
    for name in &names {
        if one(args, &mut loaded, name, &options, terminal) != End::Fine {
            end = End::Failed;
        }
    }
    end
}

/// The fits to do: those named, else all.
fn chosen(file: &Path, named: &[String], loaded: &Loaded) -> Result<Vec<String>, String> {
    let all = loaded.fits();
    if all.is_empty() {
        return Err(format!("{} has no fit; write one as `fit NAME {{ … }}`", file.display()));
    }
    for name in named {
        if !all.contains(&name.as_str()) {
            let near = compile::nearest(name, all.iter().copied());
            let help = near.map_or(format!("it has {}", all.join(", ")), |near| format!("did you mean `{near}`?"));
            return Err(format!("{} has no fit `{name}`; {help}", file.display()));
        }
    }
    Ok(if named.is_empty() { all.into_iter().map(str::to_string).collect() } else { named.to_vec() })
}

fn one(args: &args::Fit, loaded: &mut Loaded, name: &str, options: &Options, terminal: &mut Terminal) -> End {
    let mut found = Vec::new();
    let compiled = match compile::fit(loaded, &crate::disk::Disk, name, options, &mut found) {
        Ok(compiled) => compiled,
        Err(errors) => {
            reported(loaded, &errors, terminal);
            return End::Failed;
        }
    };
    if !found.is_empty() && !args.quiet && !args.json {
        reported(loaded, &found, terminal);
    }
    let begin = Instant::now();
    let runs = Runs::new(compiled);
    if args.check {
        return check(args, &runs, loaded, name, terminal);
    }
    let (answer, step, note) = match search(&runs, args.level) {
        Ok(found) => found,
        Err(trouble) => {
            reported(loaded, &[told(&trouble, &runs.fit.asks)], terminal);
            return End::Failed;
        }
    };
    let mut fitted = Fitted::new(name, &runs.fit, answer, step, args.level, begin.elapsed().as_secs_f64());
    fitted.notes.extend(note);
    let (instance, experiment) = runs.with(&fitted.answer.values, step).expect("these values have been run");
    let description = instance.description().clone();
    let outcome =
        engine::run(instance, &Experiment { plots: runs.fit.varying.plots.clone(), ..experiment }, &mut |_| {
            Continue::Continue(())
        });
    let outcome = match outcome {
        Ok(outcome) => outcome,
        Err(failure) => {
            terminal.error(&format!("{name}: the fitted run stops: {failure}"));
            return End::Failed;
        }
    };
    // After the expectations of the fit there are the compared measures, and those that watch ranges.
    let (own, watched) = outcome.verdicts.split_at(runs.fit.varying.expects());
    fitted.verdicts = own[..own.len() - runs.slots.len()].to_vec();
    fitted.measures = runs.measures(&fitted.answer.values, fitted.solver.step);
    let extremes: Vec<(f64, f64)> = watched.iter().map(sweep::extremes).collect();
    fitted.notes.extend(runs.fit.varying.left(&description, &extremes));
    if runs.fit.asks.steady {
        fitted.unsettled = runs.unsettled(&fitted.answer);
    }
    let warnings = fitted.warnings(&runs.fit.asks);
    let statement = compile::find_fit(loaded, name).expect("it has been fitted");
    let recording = recording(args, statement, options.changes.data.as_deref());
    if args.json {
        terminal.line(&fitted.json(&args.file, &runs.fit.asks, &recording).to_string());
    } else {
        if !args.quiet {
            terminal.line(&terminal.styled(Style::Bold, name));
            terminal.print(&fitted.words(&runs.fit.asks, terminal));
        }
        let place = text::Place { folder: &args.out, file: &args.file, data: &recording.0, hash: &recording.1 };
        // A text on the standard input has no place from which another could import it.
        let text =
            (!project::is_standard(&args.file)).then(|| text::text(loaded, statement, &fitted, &runs.fit.asks, &place));
        match written(args, (name, text), &runs, &fitted, &outcome, &recording) {
            Ok(paths) if !args.quiet => {
                let paths: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
                terminal.line(&format!("  wrote {}", paths.join(", ")));
            }
            Ok(_) => {}
            Err((path, error)) => {
                terminal.error(&format!("cannot write {}: {error}", path.display()));
                return End::Failed;
            }
        }
        if !warnings.is_empty() && !args.quiet {
            reported(loaded, &warnings, terminal);
        }
    }
    let failed = fitted.verdicts.iter().filter(|verdict| !verdict.passed());
    if args.quiet {
        let failed: Vec<_> = failed.clone().cloned().collect();
        if !failed.is_empty() {
            terminal.report(&format!("{name}\n{}", results::verdicts(terminal, &failed, None, None, "  ")));
        }
    }
    let bad = failed.count() > 0 || !fitted.converged() || args.strict && !warnings.is_empty();
    if bad { End::Failed } else { End::Fine }
}

/// The recording of a fit and its SHA-256.
fn recording(args: &args::Fit, fit: &grammar::ast::Fit, other: Option<&str>) -> (PathBuf, String) {
    let own = fit.body.iter().find_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Data(data)) => Some(data.file.text.as_str()),
        _ => None,
    });
    let named = other.or(own).unwrap_or_default();
    match project::bytes_named(&args.file.display().to_string(), named) {
        Ok((path, bytes)) => (path, package::hash(&bytes)),
        // It has been read before; now it is gone.
        Err(_) => (PathBuf::from(named), String::new()),
    }
}

/// `--check`: the differences with the values as they are written.
fn check(args: &args::Fit, runs: &Runs, loaded: &Loaded, name: &str, terminal: &mut Terminal) -> End {
    let asks = &runs.fit.asks;
    let starts: Vec<f64> = asks.unknowns.iter().map(|unknown| unknown.start).collect();
    match runs.residuals(&[starts], runs.step()).remove(0) {
        Ok(residuals) => {
            if !args.quiet {
                terminal.line(&terminal.styled(Style::Bold, name));
                terminal.print(&answer::as_written(asks, &residuals));
            }
            End::Fine
        }
        Err(why) => {
            reported(loaded, &[told(&Trouble::NoStart(why), asks)], terminal);
            End::Failed
        }
    }
}

/// The compiled fit and its rows.
struct Runs {
    fit: compile::Fit,
    /// The compared rows, in s.
    instants: Vec<f64>,
    slots: Vec<Slot>,
}

/// Values of a run at its rows, or why it failed.
type Residuals = Result<Vec<Vec<f64>>, String>;

impl Runs {
    fn new(mut fit: compile::Fit) -> Runs {
        // The last plot holds the compared quantities.
        fit.varying.plots.pop();
        let (after, before) = fit.asks.window;
        let instants = fit.asks.rows.iter().copied().filter(|t| (after..=before).contains(t)).collect();
        let slots = fit.asks.items.iter().map(|item| item.slot).collect();
        Runs { fit, instants, slots }
    }

    /// The step as the text has it, in s; 0 for an adaptive run.
    fn step(&self) -> f64 {
        self.fit.varying.experiment.solver.step
    }

    /// An instance and a plan for these values, with steps of this length.
    fn with(&self, values: &[f64], step: f64) -> Result<(Instance, Experiment), String> {
        let given: Vec<(Slot, f64)> =
            self.fit.asks.unknowns.iter().zip(values).map(|(unknown, value)| (unknown.slot, *value)).collect();
        let made = self.fit.varying.at(&given)?;
        let mut experiment = made.experiment;
        match experiment.solver.method {
            Method::Adaptive if self.fit.asks.driven => {
                let end = experiment.duration;
                experiment.corners.extend(self.fit.asks.corners.iter().filter(|t| **t > 0.0 && **t < end));
                experiment.corners.sort_by(f64::total_cmp);
                experiment.corners.dedup();
            }
            Method::Adaptive => {}
            _ => experiment.solver.step = step,
        }
        Ok((made.instance, experiment))
    }

    /// Values of the slots at these instants for each of these sets of values: in lanes if there are enough to fill them.
    fn sampled(
        &self,
        points: &[Vec<f64>],
        step: f64,
        instants: &[f64],
        slots: &[Slot],
    ) -> Vec<Result<Vec<f64>, String>> {
        let mut out: Vec<Option<Result<Vec<f64>, String>>> = points.iter().map(|_| None).collect();
        let (mut places, mut all) = (Vec::new(), Vec::new());
        for (place, values) in points.iter().enumerate() {
            match self.with(values, step) {
                Ok(made) => {
                    places.push(place);
                    all.push(made);
                }
                Err(why) => out[place] = Some(Err(why)),
            }
        }
        let watch = &mut |_| Continue::Continue(());
        let results = match self.fit.varying.lanes().filter(|lanes| all.len() >= lanes.width() / 2) {
            Some(code) => lanes::sample(code, all, instants, slots, watch),
            None => {
                let mut one = |(instance, experiment): (Instance, Experiment)| {
                    engine::sample(instance, &experiment, instants, slots, watch)
                };
                all.into_iter().map(&mut one).collect()
            }
        };
        for (place, (values, ended)) in places.into_iter().zip(results) {
            out[place] = Some(match ended {
                Err(failure) => Err(cause(&failure)),
                Ok(()) if values.len() < instants.len() * slots.len() => {
                    Err("the run ends before the recording".into())
                }
                Ok(()) => Ok(values),
            });
        }
        out.into_iter().map(|one| one.expect("each was run or refused")).collect()
    }

    fn residuals(&self, points: &[Vec<f64>], step: f64) -> Vec<Residuals> {
        let width = self.slots.len();
        let split = |values: Vec<f64>| -> Residuals {
            if let Some(bad) = values.iter().position(|value| !value.is_finite()) {
                let item = &self.fit.asks.items[bad % width];
                return Err(format!("`{}` is not a finite number", item.text));
            }
            Ok((0..width).map(|k| values.iter().skip(k).step_by(width).copied().collect()).collect())
        };
        self.sampled(points, step, &self.instants, &self.slots).into_iter().map(|one| one.and_then(split)).collect()
    }

    /// The compared measures of a run with steps of this length, in SI: integrals over time, unlike sums over rows.
    fn measures(&self, values: &[f64], step: f64) -> Vec<f64> {
        let Ok((instance, experiment)) = self.with(values, step) else { return Vec::new() };
        let Ok(outcome) = engine::run(instance, &experiment, &mut |_| Continue::Continue(())) else {
            return Vec::new();
        };
        let end = self.fit.varying.expects();
        let shown = outcome.verdicts[end - self.slots.len()..end].iter();
        shown.filter_map(|verdict| verdict.shown.as_ref().map(|shown| shown.value)).collect()
    }

    /// The number of steady points at which a compared quantity still moved by a noticeable part of its residuals in
    /// the second half of the hold.
    fn unsettled(&self, answer: &Answer) -> usize {
        let pairs: Vec<f64> = self.instants.iter().flat_map(|t| [t - 0.5 * HELD, *t]).collect();
        let point = std::slice::from_ref(&answer.values);
        let Ok(values) = self.sampled(point, self.step(), &pairs, &self.slots).remove(0) else { return 0 };
        let width = self.slots.len();
        let moves =
            |pair: &&[f64]| (0..width).any(|k| (pair[k] - pair[width + k]).abs() > PART_OF_NOISE * answer.rms[k]);
        values.chunks(2 * width).filter(moves).count()
    }
}

/// The cause of a failure without its numbers, so that equal causes count together.
fn cause(failure: &Failure) -> String {
    match &failure.cause {
        Cause::Guard { guard, .. } => format!("`{}` leaves its range", guard.path),
        Cause::NotFinite { path, .. } => format!("`{path}` is not a finite number"),
        Cause::Chatter(_) => "the run chatters".into(),
        Cause::StepTooShort { path, .. } => format!("`{path}` needs steps that are too short"),
        Cause::TooManySteps { .. } => "the run needs too many steps".into(),
        Cause::NoDerivatives | Cause::Rig { .. } | Cause::Stopped => failure.to_string(),
    }
}

/// Searches with the step of the text, and again with half of it until that changes nothing that matters. Returns the
/// answer, the step, and what is to be said of it.
fn search(runs: &Runs, level: f64) -> Result<(Answer, f64, Option<String>), Trouble> {
    let (exp, log) = (ElementaryFunction::exp(), ElementaryFunction::log());
    let with = Elementary { exp: &|x| exp.at(x), log: &|x| log.at(x) };
    let asks = &runs.fit.asks;
    let mut unknowns: Vec<Unknown> = asks
        .unknowns
        .iter()
        .map(|one| Unknown { low: one.range.0, high: one.range.1, start: one.start, known: one.known })
        .collect();
    let items: Vec<Item> = asks.items.iter().map(|item| Item { sd: item.sd }).collect();
    let mut step = runs.step();
    let mut spent = 0;
    for halvings in 0.. {
        let mut run = |points: &[Vec<f64>]| runs.residuals(points, step);
        let question = Question {
            unknowns: &unknowns,
            items: &items,
            independent: asks.steady,
            run: &mut run,
            with,
            level,
            trials: TRIALS,
        };
        let mut answer = runtime::fit::fit(question)?;
        answer.runs += spent;
        let solver = runs.fit.varying.experiment.solver.method;
        let fixed = asks.solver_given || solver == Method::Adaptive || runs.fit.varying.keeps_past();
        if fixed {
            return Ok((answer, step, None));
        }
        let finer = runs.residuals(&[answer.values.clone()], 0.5 * step).remove(0);
        let moved = finer.as_ref().map(|finer| {
            let one = |(k, (a, b)): (usize, (&Vec<f64>, &Vec<f64>))| {
                let noise = answer.noise[k].variance.sqrt();
                a.iter().zip(b).map(|(a, b)| (a - b).abs() / noise).fold(0.0, f64::max)
            };
            finer.iter().zip(&answer.residuals).enumerate().map(one).fold(0.0, f64::max)
        });
        match moved {
            Ok(moved) if moved <= PART_OF_NOISE => return Ok((answer, step, None)),
            Ok(_) if halvings < MOST_HALVINGS => {
                step *= 0.5;
                spent = answer.runs + 1;
                for (unknown, value) in unknowns.iter_mut().zip(&answer.values) {
                    unknown.start = *value;
                }
            }
            moved => {
                let by = moved.map_or_else(
                    |why| why.clone(),
                    |moved| format!("half of it moves a residual by {} of the noise", significant(moved, 2)),
                );
                let note = format!("steps of {} may be too long: {by}", duration(step, 3));
                return Ok((answer, step, Some(note)));
            }
        }
    }
    unreachable!("the loop returns")
}

/// What went wrong, as a diagnostic.
fn told(trouble: &Trouble, asks: &Asks) -> Diagnostic {
    match trouble {
        Trouble::NoStart(why) => {
            let starts: Vec<String> =
                asks.unknowns.iter().map(|one| format!("{} = {}", one.path, show(one.start, &one.unit, 4))).collect();
            Diagnostic::error("E0907", format!("the fit cannot be run from its start: {why}"))
                .label(asks.name, format!("with {}", starts.join(", ")))
                .help("give a start that can be run, as in `vary Fs = 1.5 N in 1 N .. 2 N`, or a smaller range")
        }
        Trouble::NoInfluence(idle) => {
            let unknown = &asks.unknowns[idle[0]];
            let mut error = Diagnostic::error("E0906", format!("`{}` changes nothing that is compared", unknown.path));
            for k in idle {
                error = error.label(asks.unknowns[*k].span, "no residual depends on it");
            }
            error.help("leave it out, compare something that it changes, or record a motion in which it acts")
        }
        Trouble::TooFewRows(rows, unknowns) => {
            let error = Diagnostic::error("E0910", format!("{rows} rows cannot determine {unknowns} unknowns"));
            error.label(asks.name, "too few rows").help("compare more rows, or vary fewer parameters")
        }
    }
}

/// Writes the files of a fit; returns their paths, or the one that failed and why.
fn written(
    args: &args::Fit,
    (name, text): (&str, Option<String>),
    runs: &Runs,
    fitted: &Fitted,
    outcome: &engine::Outcome,
    recording: &(PathBuf, String),
) -> Result<Vec<PathBuf>, (PathBuf, std::io::Error)> {
    let asks = &runs.fit.asks;
    let mut files: Vec<(PathBuf, Vec<u8>)> = Vec::new();
    let at = |ending: &str| args.out.join(format!("{name}.{ending}"));
    if let Some(text) = text {
        files.push((at("fric"), text.into_bytes()));
    }
    files.push((at("json"), format!("{:#}\n", fitted.json(&args.file, asks, recording)).into_bytes()));
    let mut slots = runs.slots.clone();
    slots.extend(asks.items.iter().flat_map(|item| item.sides.iter().flatten().map(|(_, slot)| *slot)));
    let point = std::slice::from_ref(&fitted.answer.values);
    if let Ok(values) = runs.sampled(point, fitted.step, &runs.instants, &slots).remove(0) {
        files.push((at("csv"), answer::table(asks, &runs.instants, &values).into_bytes()));
    }
    let plots = &runs.fit.varying.plots;
    if !plots.is_empty() {
        let rms: Vec<String> =
            asks.items.iter().zip(&fitted.answer.rms).map(|(item, rms)| show(*rms, &item.unit, 3)).collect();
        let rows = count(asks.rows.len() as u64);
        let subtitle = format!("{} fitted to {rows} rows, rms {}", asks.model, rms.join(", "));
        let drawn = Recorded { label: "", plots, recording: &outcome.recording, verdicts: &[] };
        let drawn = figure::figure(name, &subtitle, 0, &[drawn]);
        files.push((at("svg"), plot::picture(&drawn, &Look::default(), Kind::Svg)));
    }
    let mut paths = Vec::new();
    for (path, bytes) in files {
        project::write(&path, &bytes).map_err(|error| (path.clone(), error))?;
        paths.push(path);
    }
    Ok(paths)
}
