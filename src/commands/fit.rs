//! `fric fit`: the parameters with which a model follows a recording, with intervals.
//!
//! The result of the search is shown as a table, as an
//! instance to paste, and written as JSON, CSV and a picture.

mod kept;
pub mod search;
#[cfg(test)]
mod differences;
mod after;
mod answer;
mod page;
mod laws;
mod rank;
mod text;
mod of_laws;

use super::{End, load, reported, sound, sweep};
use crate::args;
use crate::commands::fit::answer::Fitted;
use crate::commands::fit::kept::{Keeping, Kept};
use crate::commands::fit::search::{Found, Part, Runs, Settings, search, search_from};
use crate::compile::{self, Asks, Changes, Loaded, Options, Stopwatch};
use crate::figure::{self, Recorded};
use crate::plot::{self, Kind, Look};
use crate::project;
use crate::quantity::{count, show};
use crate::recording_files::Format;
use crate::results;
use crate::terminal::{Style, Terminal};
use abi::plan::Experiment;
use grammar::ast::{ExperimentStatement, FitStatement};
use grammar::diagnostic::Diagnostic;
use runtime::engine::{self, Continue, Failure};
use runtime::fit::{Trouble, Way};
use runtime::package;
use runtime::run::verdict::Verdict;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn fit(args: &args::Fit, terminal: &mut Terminal) -> End {
    if Format::of(&args.file).is_some() {
        return of_laws::of_laws(args, terminal);
    }
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load(&args.file, terminal, &mut watch) else { return End::Failed };
    let names = match chosen(&args.file, &args.fits, &loaded) {
        Ok(names) => names,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    let data: Result<Vec<PathBuf>, std::io::Error> = args.data.iter().map(std::path::absolute).collect();
    let data = match data {
        Ok(data) => data.iter().map(|path| path.display().to_string()).collect::<Vec<String>>(),
        Err(error) => {
            terminal.error(&format!("--data: {error}"));
            return End::Failed;
        }
    };
    let has_cases = |name: &String| {
        let fit = compile::find_fit(&loaded, name);
        fit.is_some_and(|fit| fit.body.iter().any(|statement| matches!(statement, FitStatement::Case(_))))
    };
    if let Some(name) = names.iter().find(|name| !data.is_empty() && has_cases(name)) {
        terminal.error(&format!(
            "--data: fit `{name}` has cases, each with recordings of its own\n  mend: change the recordings in the text"
        ));
        return End::Misused;
    }
    if sound(&loaded, args.json || args.quiet, terminal, &mut watch).is_err() {
        return End::Failed;
    }
    let changes = Changes { data, tol: args.tol, ..args.stepped.changes() };
    let options = Options { changes, interpret: args.interpret };
    let mut end = End::Fine;
    let mut keeping = Keeping::new(args);
    for name in &names {
        match one(args, &mut loaded, name, &options, &mut keeping, terminal) {
            End::Fine => {}
            End::Misused => return End::Misused,
            End::Failed | End::Stopped => end = End::Failed,
        }
    }
    keeping.finish(terminal);
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

/// The fit that is named, or the only one.
///
/// # Errors
/// The fits that exist instead, in words.
pub fn only(file: &Path, named: Option<&str>, loaded: &Loaded) -> Result<String, String> {
    let names: Vec<String> = named.into_iter().map(str::to_string).collect();
    let mut all = chosen(file, &names, loaded)?;
    match all.len() {
        1 => Ok(all.remove(0)),
        _ => Err(format!("{} has several fits: name one of {}", file.display(), all.join(", "))),
    }
}

fn one(
    args: &args::Fit,
    loaded: &mut Loaded,
    name: &str,
    options: &Options,
    keeping: &mut Keeping,
    terminal: &mut Terminal,
) -> End {
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
    let method = compiled[0].parts[0].varying.experiment.solver.method;
    if let Some(why) = args.stepped.without_effect_and(args.tol, name, method) {
        terminal.error(&why);
        return End::Misused;
    }
    let kept = match keeping.begin(loaded, name, &compiled, terminal) {
        Ok(kept) => kept,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    if compiled.len() > 1 {
        return alternatives(args, compiled, (loaded, name), (options, kept), terminal);
    }
    let begin = Instant::now();
    let compiled = compiled.into_iter().next().expect("it has been compiled");
    let mut runs = Runs::new(compiled, args.threads);
    runs.keep(kept);
    if args.check {
        return check(args, &runs, loaded, name, terminal);
    }
    if let Some(unknown) = unknown_profile(args, &runs) {
        terminal.error(&format!("--profile: fit `{name}` does not vary `{unknown}`"));
        return End::Misused;
    }
    let found = match search(&runs, Settings::of(args)) {
        Ok(found) => found,
        Err(trouble) => {
            reported(loaded, &[told(&trouble, &runs)], terminal);
            return End::Failed;
        }
    };
    let seconds = begin.elapsed().as_secs_f64();
    let question = Asked { args, file: &args.file, data: &options.changes.data, loaded, name, rank: None };
    conclude(&question, &runs, found, seconds, terminal)
}

/// Fits each alternative of a fit, ranks them, and shows the best.
fn alternatives(
    args: &args::Fit,
    all: Vec<compile::Fit>,
    (loaded, name): (&Loaded, &str),
    (options, kept): (&Options, Option<Kept>),
    terminal: &mut Terminal,
) -> End {
    let mut tried = Vec::new();
    for fit in all {
        let begin = Instant::now();
        let mut runs = Runs::new(fit, args.threads);
        runs.keep(kept.clone());
        if args.check {
            if !args.quiet {
                terminal.line(&terminal.styled(Style::Bold, &runs.label));
            }
            if check(args, &runs, loaded, name, terminal) != End::Fine {
                return End::Failed;
            }
            continue;
        }
        let found = search(&runs, Settings::of(args));
        let held_out = found.as_ref().ok().and_then(|found| after::held_out(&runs, found, Settings::of(args)));
        let (name, law) = (name.to_string(), runs.label.clone());
        tried.push(rank::Tried { name, law, runs, found, held_out, seconds: begin.elapsed().as_secs_f64() });
    }
    if args.check {
        return End::Fine;
    }
    let heading = rank::Heading { title: name, wrote: None };
    rank::rank(args, &heading, (&args.file, &options.changes.data), loaded, &tried, terminal)
}

/// A fit that has been searched for.
struct Asked<'a> {
    args: &'a args::Fit,
    /// The text with the fit.
    file: &'a Path,
    /// The recordings in place of the text's own.
    data: &'a [String],
    loaded: &'a Loaded,
    name: &'a str,
    /// Its place among several laws.
    rank: Option<&'a answer::Rank>,
}

/// Shows the answer of a fit and writes its files.
fn conclude(question: &Asked, runs: &Runs, found: Found, seconds: f64, terminal: &mut Terminal) -> End {
    let Asked { args, file, data, loaded, name, rank } = *question;
    let begin = Instant::now();
    let settings = Settings::of(args);
    let (found, profiles) = profiled(args, runs, found, settings);
    let pieces = after::pieces(runs, &found, settings, args.pieces);
    let validated = after::judge(runs, &found, settings);
    let (answer, steps, coarse) = found;
    let mut fitted = Fitted::new(name, runs, answer, &steps, args.level, seconds + begin.elapsed().as_secs_f64());
    (fitted.profiles, fitted.pieces) = (profiles, pieces);
    for (one, runs) in validated.into_iter().zip(&runs.judged) {
        match one {
            Ok(one) => fitted.judged.push(one),
            Err(why) => fitted.notes.push(format!("{} cannot be judged: {why}", runs.parts[0].asks.label)),
        }
    }
    fitted.coarse = coarse;
    fitted.rank = rank.cloned();
    let mut outcomes = Vec::new();
    for ((part, step), items) in runs.parts.iter().zip(&steps).zip(runs.items()) {
        let values = &fitted.answer.values;
        let of = if runs.parts.len() > 1 { format!("{}: ", part.asks.label) } else { String::new() };
        match judged(part, values, *step) {
            Ok((outcome, left)) => {
                fitted.notes.extend(left.map(|left| format!("{of}{left}")));
                outcomes.push(outcome);
            }
            Err(failure) => {
                terminal.error(&format!("{name}: {of}the fitted run stops: {failure}"));
                return End::Failed;
            }
        }
        let on = Fitted::step_on(part, *step);
        fitted.runs.push(answer::Run {
            verdicts: own(part, &outcomes[outcomes.len() - 1]).to_vec(),
            measures: part.measures(values, on),
            unsettled: if part.asks.steady { part.unsettled(values, &fitted.answer.rms[items]) } else { 0 },
            solver: part.solver(on),
            step: *step,
            remarks: after::remarks(part, &fitted.answer, runs.items()[fitted.runs.len()].clone()),
        });
    }
    let warnings = fitted.warnings(runs);
    let statement = compile::find_fit(loaded, name).expect("it has been fitted");
    let recordings: Vec<(PathBuf, String)> =
        runs.parts.iter().map(|part| recording(file, &part.asks, !data.is_empty())).collect();
    if args.json {
        terminal.line(&fitted.json(file, runs, &recordings).to_string());
    } else {
        if !args.quiet {
            terminal.line(&terminal.styled(Style::Bold, name));
            terminal.print(&fitted.words(runs, terminal));
        }
        let place = text::Place { folder: &args.out, file, recordings: &recordings };
        // A text on the standard input has no place from which another could import it.
        let text = (!project::is_standard(file)).then(|| text::text(loaded, statement, &fitted, runs, &place));
        match written(question, text, runs, &fitted, (&outcomes, &warnings), &recordings) {
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
    let failed: Vec<Verdict> =
        fitted.runs.iter().flat_map(|run| &run.verdicts).filter(|verdict| !verdict.passed()).cloned().collect();
    if args.quiet && !failed.is_empty() {
        terminal.report(&format!("{name}\n{}", results::verdicts(terminal, &failed, None, None, "  ")));
    }
    let bad = !failed.is_empty() || !fitted.converged() || args.strict && !warnings.is_empty();
    if bad { End::Failed } else { End::Fine }
}

/// A path of `--profile` that the fit does not vary.
fn unknown_profile<'a>(args: &'a args::Fit, runs: &Runs) -> Option<&'a str> {
    let is_known = |path: &str| runs.unknowns.iter().any(|unknown| unknown.path == path || unknown.label == path);
    args.profile.iter().map(String::as_str).find(|path| !matches!(*path, "all" | "none") && !is_known(path))
}

/// The profiles that are asked for, or that the answer needs. Where a profile meets a better answer, the search goes on
/// from there, once.
fn profiled(
    args: &args::Fit,
    runs: &Runs,
    mut found: Found,
    settings: Settings,
) -> (Found, Vec<Option<after::Profile>>) {
    let n = runs.unknowns.len();
    let mut again = true;
    'answer: loop {
        let answer = &found.0;
        let is_asked = |k: usize| {
            let unknown = &runs.unknowns[k];
            match &args.profile[..] {
                [] => answer.at_bound[k].is_some() || after::is_open(answer, k),
                [one] if one == "none" => false,
                named => named.iter().any(|one| *one == "all" || *one == unknown.path || *one == unknown.label),
            }
        };
        let mut profiles = Vec::new();
        for k in 0..n {
            profiles.push(match is_asked(k).then(|| after::profile(runs, &found, settings, k)) {
                None => None,
                Some(Ok(profile)) => Some(profile),
                Some(Err(better)) => {
                    if again && let Ok(next) = search_from(runs, &better, settings) {
                        again = false;
                        let (mut answer, steps, coarse) = next;
                        answer.runs += found.0.runs;
                        (answer.starts, answer.followed, answer.ends) =
                            (found.0.starts, found.0.followed, found.0.ends.clone());
                        found = (answer, steps, coarse);
                        continue 'answer;
                    }
                    None
                }
            });
        }
        return (found, profiles);
    }
}

/// The run with these values, and a range that it left.
fn judged(part: &Part, values: &[f64], step: f64) -> Result<(engine::Outcome, Option<String>), Failure> {
    let (instance, experiment) = part.with(values, step).expect("these values have been run");
    let description = instance.description().clone();
    let plots = part.varying.plots.clone();
    let outcome = engine::run(instance, &Experiment { plots, ..experiment }, &mut |_| Continue::Continue(()))?;
    let watched = &outcome.verdicts[part.varying.expects()..];
    let extremes: Vec<(f64, f64)> = watched.iter().map(sweep::extremes).collect();
    let left = part.varying.left(&description, &extremes);
    Ok((outcome, left))
}

/// The verdicts of a fit's own expectations. After them there are the compared measures, and those that watch ranges.
fn own<'o>(part: &Part, outcome: &'o engine::Outcome) -> &'o [Verdict] {
    &outcome.verdicts[..part.varying.expects() - part.slots.len()]
}

/// Whether a fit has expectations.
pub fn expects(loaded: &Loaded, name: &str) -> bool {
    let is_expect = |statement: &FitStatement| matches!(statement, FitStatement::Experiment(ExperimentStatement::Expect(expect)) if expect.shows.is_none());
    let has = |statement: &FitStatement| match statement {
        FitStatement::Case(case) => case.body.iter().any(is_expect),
        other => is_expect(other),
    };
    compile::find_fit(loaded, name).is_some_and(|fit| fit.body.iter().any(has))
}

/// For `fric test`: fits, and returns the verdicts of its expectations. None if there is no answer, which is reported.
pub fn verdicts(loaded: &mut Loaded, name: &str, interpret: bool, terminal: &Terminal) -> Option<Vec<Verdict>> {
    let options = Options { interpret, ..Options::default() };
    let compiled = match compile::fit(loaded, &crate::disk::Disk, name, &options, &mut Vec::new()) {
        Ok(compiled) => compiled,
        Err(errors) => {
            reported(loaded, &errors, terminal);
            return None;
        }
    };
    // Of several alternatives the first one is judged.
    let compiled = compiled.into_iter().next().expect("it has been compiled");
    let runs = Runs::new(compiled, None);
    let settings = Settings::new(args::LEVEL);
    let (answer, steps, _) = match search(&runs, settings) {
        Ok(found) => found,
        Err(trouble) => {
            reported(loaded, &[told(&trouble, &runs)], terminal);
            return None;
        }
    };
    let mut all = Vec::new();
    for (part, step) in runs.parts.iter().zip(&steps) {
        match judged(part, &answer.values, *step) {
            Ok((outcome, _)) => all.extend(own(part, &outcome).to_vec()),
            Err(failure) => {
                terminal.error(&format!("{name}: the fitted run stops: {failure}"));
                return None;
            }
        }
    }
    Some(all)
}

/// The recording of a run and its SHA-256. `given`: it comes from the command line, with an absolute path.
fn recording(file: &Path, asks: &Asks, given: bool) -> (PathBuf, String) {
    let from = if given { String::new() } else { file.display().to_string() };
    match project::bytes_named(&from, &asks.recording) {
        Ok((path, bytes)) => (path, package::hash(&bytes)),
        // It has been read before; now it is gone.
        Err(_) => (PathBuf::from(&asks.recording), String::new()),
    }
}

/// `--check`: the differences with the values as they are written.
fn check(args: &args::Fit, runs: &Runs, loaded: &Loaded, name: &str, terminal: &mut Terminal) -> End {
    let starts: Vec<f64> = runs.unknowns.iter().map(|unknown| unknown.start).collect();
    match runs.residuals(Way::Whole, &starts, &runs.steps()) {
        Ok(residuals) => {
            if !args.quiet {
                terminal.line(&terminal.styled(Style::Bold, name));
                terminal.print(&answer::as_written(runs, &residuals));
            }
            End::Fine
        }
        Err(why) => {
            reported(loaded, &[told(&Trouble::NoStart(why), runs)], terminal);
            End::Failed
        }
    }
}

/// What went wrong, as a diagnostic.
fn told(trouble: &Trouble, runs: &Runs) -> Diagnostic {
    let unknowns = &runs.unknowns;
    match trouble {
        Trouble::NoStart(why) => {
            let starts: Vec<String> =
                unknowns.iter().map(|one| format!("{} = {}", one.label, show(one.start, &one.unit, 4))).collect();
            Diagnostic::error("E0907", format!("the fit cannot be run from any start: {why}"))
                .label(runs.name, format!("not with {}", starts.join(", ")))
                .help("give a start that can be run, as in `vary Fs = 1.5 N in 1 N .. 2 N`, or a smaller range")
        }
        Trouble::NoInfluence(idle) => {
            let unknown = &unknowns[idle[0]];
            let mut error = Diagnostic::error("E0906", format!("`{}` changes nothing that is compared", unknown.label));
            for k in idle {
                error = error.label(unknowns[*k].span, "no residual depends on it");
            }
            error.help("leave it out, compare something that it changes, or record a motion in which it acts")
        }
        Trouble::TooFewRows(rows, unknowns) => {
            let error = Diagnostic::error("E0910", format!("{rows} rows cannot determine {unknowns} unknowns"));
            error.label(runs.name, "too few rows").help("compare more rows, or vary fewer parameters")
        }
    }
}

/// Writes the files of a fit; returns their paths, or the one that failed and why.
fn written(
    question: &Asked,
    text: Option<String>,
    runs: &Runs,
    fitted: &Fitted,
    (outcomes, warnings): (&[engine::Outcome], &[Diagnostic]),
    recordings: &[(PathBuf, String)],
) -> Result<Vec<PathBuf>, (PathBuf, std::io::Error)> {
    let mut paths = Vec::new();
    let mut write = |path: PathBuf, content: &mut project::Content| {
        project::write_by(&path, content).map_err(|error| (path.clone(), error))?;
        paths.push(path);
        Ok(())
    };
    let bytes = |bytes: Vec<u8>| move |out: &mut dyn Write| out.write_all(&bytes);
    let (args, name) = (question.args, question.name);
    let at = |stem: &str, ending: &str| args.out.join(format!("{stem}.{ending}"));
    let mut shown = Vec::new();
    if let Some(text) = text {
        write(at(name, "fric"), &mut bytes(text.into_bytes()))?;
    }
    let json = format!("{:#}\n", fitted.json(question.file, runs, recordings));
    write(at(name, "json"), &mut bytes(json.into_bytes()))?;
    for (((part, run), outcome), items) in runs.parts.iter().zip(&fitted.runs).zip(outcomes).zip(runs.items()) {
        let asks = &part.asks;
        let stem = if runs.parts.len() > 1 { format!("{name}_{}", asks.label) } else { name.to_string() };
        let mut slots = part.slots.clone();
        slots.extend(asks.items.iter().flat_map(|item| item.sides.iter().flatten().map(|(_, slot)| *slot)));
        let every = page::every(part.instants.len());
        let mut rows = Vec::new();
        let mut content = |out: &mut dyn Write| {
            out.write_all(answer::heading(asks).as_bytes())?;
            let mut row = 0;
            let mut fault = None;
            let mut each = |times: &[f64], values: &[f64]| {
                let lines = answer::lines(asks, (row, times), values);
                for (k, values) in values.chunks(slots.len()).enumerate().filter(|(k, _)| (row + k) % every == 0) {
                    rows.push((row + k, values.to_vec()));
                }
                row += times.len();
                out.write_all(lines.as_bytes()).map_err(|error| fault.insert(error).to_string())
            };
            let ran = part.sampled(&fitted.answer.values, run.step, (&part.instants, &slots), &mut each);
            match (ran, fault) {
                (Ok(()), _) => Ok(()),
                (Err(_), Some(error)) => Err(error),
                (Err(why), None) => Err(std::io::Error::other(why)),
            }
        };
        write(at(&stem, "csv"), &mut content)?;
        shown.push(page::PageRun { recording: &outcome.recording, rows });
        let plots = &part.varying.plots;
        if !plots.is_empty() {
            let rms = asks.items.iter().zip(&fitted.answer.rms[items]);
            let rms: Vec<String> = rms.map(|(item, rms)| show(*rms, &item.unit, 3)).collect();
            let rows = count(asks.rows.len() as u64);
            let subtitle = format!("{} fitted to {rows} rows, rms {}", asks.model, rms.join(", "));
            let drawn = Recorded { label: "", plots, recording: &outcome.recording, verdicts: &[] };
            let drawn = figure::figure(&stem, &subtitle, 0, &[drawn]);
            write(at(&stem, "svg"), &mut bytes(plot::picture(&drawn, &Look::default(), Kind::Svg)))?;
        }
    }
    if args.report {
        let statement = compile::find_fit(question.loaded, name).expect("it has been fitted");
        let text = question.loaded.files.slice(statement.span);
        let page = page::report(fitted, runs, (name, text), warnings, &shown);
        write(at(name, "html"), &mut bytes(page.into_bytes()))?;
    }
    Ok(paths)
}
