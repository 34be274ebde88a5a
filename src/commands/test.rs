//! `fric test`: runs every experiment and does every fit that has expectations.

use super::{End, compiled, done, load};
use crate::args::Test;
use crate::commands::shared::cross_check::{Crossed, cross};
use crate::compile::{Loaded, Options, Stages, Stopwatch};
use crate::project;
use crate::quantity::duration;
use crate::results;
use crate::terminal::{Style, Terminal};
use crate::timings::Timings;
use std::path::PathBuf;
use std::time::Instant;

pub fn test(args: &Test, timings: &mut Timings, terminal: &mut Terminal) -> End {
    let mut tally = Tally::default();
    let mut files: Vec<PathBuf> = Vec::new();
    for path in &args.paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        match project::texts_in(path) {
            Ok(found) => files.extend(found),
            Err(error) => {
                terminal.error(&format!("cannot read {}: {error}", path.display()));
                tally.failed += 1;
            }
        }
    }
    for file in &files {
        let mut watch = Stopwatch::start("read");
        let Some(mut loaded) = load(file, terminal, &mut watch) else {
            tally.failed += 1;
            continue;
        };
        if super::sound(&loaded, args.quiet, terminal, &mut watch).is_err() {
            tally.failed += 1;
            continue;
        }
        let stages = watch.stop();
        timings.add_all(&stages);
        let names: Vec<String> =
            loaded.experiments().into_iter().filter(|info| info.has_expect).map(|info| info.name).collect();
        let fits: Vec<String> = loaded.fits().into_iter().map(str::to_string).collect();
        let fits: Vec<String> = fits.into_iter().filter(|name| super::fit::expects(&loaded, name)).collect();
        let is_tested = !names.is_empty() || !fits.is_empty();
        if !args.quiet && is_tested {
            terminal.line(&file.display().to_string());
        }
        for name in names {
            tally.add(experiment(args, &mut loaded, &name, timings, terminal));
        }
        for name in fits {
            tally.add(fit(args, &mut loaded, &name, timings, terminal));
        }
    }
    if tally.passed + tally.failed == 0 {
        terminal.error("nothing to test: no experiment and no fit has an `expect`");
    }
    terminal.line(&format!("{} passed, {} failed", tally.passed, tally.failed));
    if tally.failed == 0 && tally.passed > 0 { End::Fine } else { End::Failed }
}

#[derive(Default)]
struct Tally {
    passed: u32,
    failed: u32,
}

impl Tally {
    fn add(&mut self, passed: bool) {
        if passed { self.passed += 1 } else { self.failed += 1 }
    }
}

/// Runs one experiment; returns whether its expectations hold in every case.
fn experiment(args: &Test, loaded: &mut Loaded, name: &str, timings: &mut Timings, terminal: &mut Terminal) -> bool {
    let options = Options { interpret: args.interpret, ..Options::default() };
    let Ok((cases, stages)) = compiled(loaded, name, &options, &Stages::default(), false, terminal) else {
        terminal.line(&line(terminal, false, name, ""));
        return false;
    };
    timings.add_all(&stages);
    let done = done(cases, stages, args.quiet, !args.trust.no_error);
    timings.add("run", done.wall);
    timings.add("errors", done.judging);
    let held = done.results.iter().all(|result| result.as_ref().is_ok_and(runtime::engine::Outcome::passed));
    let crossed = match args.cross && held {
        true => cross(loaded, name, &options, &done.cases, terminal),
        false => Some(Vec::new()),
    };
    let passed = held && crossed.as_ref().is_some_and(|all| all.iter().all(Crossed::passed));
    if !(passed && args.quiet) {
        terminal.line(&line(terminal, passed, name, &duration(done.wall, 3)));
    }
    for (case, result) in done.cases.iter().zip(&done.results) {
        let label = if case.label.is_empty() { String::new() } else { format!("{}: ", case.label) };
        match result {
            Ok(outcome) if outcome.passed() => {}
            Ok(outcome) => {
                let failed: Vec<_> = outcome.verdicts.iter().filter(|verdict| !verdict.passed()).cloned().collect();
                let (estimate, indent) = (outcome.estimate.as_ref(), format!("          {label}"));
                terminal.print(&results::verdicts(terminal, &failed, estimate, args.trust.digits, &indent));
            }
            Err(failure) => terminal.line(&format!("          {label}{failure}")),
        }
    }
    for crossed in crossed.iter().flatten().filter(|crossed| !args.quiet || !crossed.passed()) {
        terminal.print(&crossed.words(terminal, "          "));
    }
    passed
}

/// Fits; returns whether the expectations hold of the fitted run.
fn fit(args: &Test, loaded: &mut Loaded, name: &str, timings: &mut Timings, terminal: &mut Terminal) -> bool {
    let begin = Instant::now();
    let verdicts = super::fit::verdicts(loaded, name, args.interpret, terminal);
    let wall = begin.elapsed().as_secs_f64();
    timings.add("run", wall);
    let failed: Option<Vec<_>> = verdicts.map(|all| all.into_iter().filter(|verdict| !verdict.passed()).collect());
    let passed = failed.as_ref().is_some_and(Vec::is_empty);
    if !(passed && args.quiet) {
        terminal.line(&line(terminal, passed, name, &duration(wall, 3)));
    }
    terminal.print(&results::verdicts(terminal, &failed.unwrap_or_default(), None, args.trust.digits, "          "));
    passed
}

fn line(terminal: &Terminal, passed: bool, name: &str, time: &str) -> String {
    let word = if passed { terminal.styled(Style::Good, "ok    ") } else { terminal.styled(Style::Bad, "FAILED") };
    format!("  {word}  {name:28} {time:>8}").trim_end().into()
}
