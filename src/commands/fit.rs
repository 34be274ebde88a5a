//! `fric fit`: the parameters with which a model follows a recording, with intervals.
//!
//! The result of the search is shown as a table, as an
//! instance to paste, and written as JSON, CSV and a picture.

mod kept;
pub mod search;
#[cfg(test)]
mod differences;
mod after;
pub mod answer;
mod page;
mod text;
pub mod conclusion;
pub mod laws;
pub mod rank;
mod of_laws;

use super::{End, load, reported, sound};
use crate::args;
use crate::commands::fit::conclusion::{Asked, Choices, Conclusion, judged, own, told};
use crate::commands::fit::kept::Keeping;
use crate::commands::fit::search::{Found, Runs, Settings, search};
use crate::compile::{self, Changes, Loaded, Options, Stopwatch};
use crate::recording_files::Format;
use crate::results;
use crate::terminal::{Style, Terminal};
use grammar::ast::{ExperimentStatement, FitStatement};
use runtime::fit::{Trouble, Way};
use runtime::run::verdict::Verdict;
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
    if let Some(unknown) = Choices::of(args).unknown_profile(compiled.iter().flat_map(|fit| &fit.unknowns)) {
        terminal.error(&format!("--profile: fit `{name}` does not vary `{unknown}`"));
        return End::Misused;
    }
    let kept = match keeping.begin(loaded, name, &compiled, terminal) {
        Ok(kept) => kept,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let begin = Instant::now();
    let mut all: Vec<Runs> = compiled.into_iter().map(|fit| Runs::new(fit, args.threads)).collect();
    all.iter_mut().for_each(|runs| runs.keep(kept.clone()));
    if all.len() > 1 {
        return alternatives(args, all, (loaded, name), &options.changes.data, terminal);
    }
    let runs = all.remove(0);
    if args.check {
        return check(args, &runs, loaded, name, terminal);
    }
    let found = match search(&runs, Settings::of(args)) {
        Ok(found) => found,
        Err(trouble) => {
            reported(loaded, &[told(&trouble, &runs)], terminal);
            return End::Failed;
        }
    };
    let seconds = begin.elapsed().as_secs_f64();
    let recordings = conclusion::recordings(&args.file, &runs, !options.changes.data.is_empty());
    let question = Asked { loaded, file: &args.file, name, recordings: &recordings };
    conclude(args, &question, &runs, found, (None, seconds), terminal)
}

/// Fits each alternative of a fit, ranks them, and shows the best.
fn alternatives(
    args: &args::Fit,
    all: Vec<Runs>,
    (loaded, name): (&Loaded, &str),
    data: &[String],
    terminal: &mut Terminal,
) -> End {
    if args.check {
        for runs in &all {
            if !args.quiet {
                terminal.line(&terminal.styled(Style::Bold, &runs.label));
            }
            if check(args, runs, loaded, name, terminal) != End::Fine {
                return End::Failed;
            }
        }
        return End::Fine;
    }
    let tried: Vec<rank::Tried> =
        all.into_iter().map(|runs| rank::Tried::new(name, runs, Settings::of(args))).collect();
    let heading = rank::Heading { title: name, wrote: None };
    rank::rank(args, &heading, (&args.file, data), loaded, &tried, terminal)
}

/// Shows the answer of a fit and writes its files.
fn conclude(
    args: &args::Fit,
    question: &Asked,
    runs: &Runs,
    found: Found,
    (rank, seconds): (Option<&answer::Rank>, f64),
    terminal: &mut Terminal,
) -> End {
    let name = question.name;
    let concluded = match Conclusion::new(name, runs, found, &Choices::of(args), rank, seconds) {
        Ok(concluded) => concluded,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    if args.json {
        terminal.line(&concluded.json(question, runs).to_string());
    } else {
        if !args.quiet {
            terminal.line(&terminal.styled(Style::Bold, name));
            terminal.print(&concluded.fitted.words(runs, terminal));
        }
        match concluded.write(question, runs, &args.out, args.report) {
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
        if !concluded.warnings.is_empty() && !args.quiet {
            reported(question.loaded, &concluded.warnings, terminal);
        }
    }
    let failed = concluded.failed();
    if args.quiet && !failed.is_empty() {
        terminal.report(&format!("{name}\n{}", results::verdicts(terminal, &failed, None, None, "  ")));
    }
    let warned = args.strict && !concluded.warnings.is_empty();
    if !failed.is_empty() || !concluded.fitted.converged() || warned { End::Failed } else { End::Fine }
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
