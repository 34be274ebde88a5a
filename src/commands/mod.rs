//! The commands, one file each. A command prints its results and returns how it ended.

mod bench;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod bench_rt;
mod shared;
mod build;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod bus;
pub(crate) mod characterise;
mod check;
mod deploy;
mod doc;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod doctor;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod drives;
pub(crate) mod explain;
mod fmt;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod beside;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod prompt;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod company;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod hil;
mod inspect;
mod key;
pub(crate) mod linearise;
mod new;
mod remote_rig;
mod panel;
mod predict;
mod watch;
mod repl;
mod replay;
mod run;
pub mod sweep;
pub mod fit;
mod excite;
mod test;

use crate::args::{self, Args, Command, Key, Repl};
use crate::compile::{self, Case, Loaded, Options, Sources, Stages, Stopwatch};
use crate::figure::Kept;
use crate::terminal::Terminal;
use crate::timings::Timings;
use crate::{project, report};
use grammar::diagnostic::Diagnostic;
use runtime::engine::sweep as runs;
use runtime::engine::{Continue, Failure, Outcome};
use runtime::record::Recording;
use shared::progress;
use std::path::Path;
use std::time::Instant;

/// Why a command is missing.
#[cfg(not(all(feature = "hardware", target_os = "linux")))]
const NEEDS_HARDWARE: &str = "this build has no real buses and clocks, which this command needs\n  \
    mend: run it on Linux, in a build with the feature `hardware`, which is on by default there; check, predict, build, \
    deploy and replay work here too";

/// How a command ended.
#[cfg_attr(not(all(feature = "hardware", target_os = "linux")), allow(dead_code, reason = "only a rig is stopped"))]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum End {
    /// Exit code 0.
    Fine,
    /// The input or an expectation failed: exit code 1.
    Failed,
    /// Wrong usage that is detected only with the input, such as one plot file for two experiments: exit code 2.
    Misused,
    /// A rig was stopped by the safety supervisor or by a `stop` condition: exit code 3.
    Stopped,
}

/// Runs the command of the arguments. `begin`: when the program began.
pub fn run(args: &Args, begin: Instant, terminal: &mut Terminal) -> End {
    let Some(command) = &args.command else { return repl::repl(&Repl::default(), terminal) };
    match command {
        Command::Run(run) => {
            let mut timings = Timings::new(run.timed.timings, begin);
            let end = run::run(run, &mut timings, terminal);
            timings.print(terminal);
            end
        }
        Command::Test(test) => {
            let mut timings = Timings::new(test.timed.timings, begin);
            let end = test::test(test, &mut timings, terminal);
            timings.print(terminal);
            end
        }
        Command::Sweep(sweep) => sweep::sweep(sweep, terminal),
        Command::Fit(args) => fit::fit(args, terminal),
        Command::Excite(args) => excite::excite(args, terminal),
        Command::Linearise(linearise) => linearise::linearise(linearise, terminal),
        Command::Bench(args) => bench::bench(args, terminal),
        Command::Build(build) => build::build(build, terminal),
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        Command::Hil(args) => hil::hil(args, terminal),
        Command::Predict(args) => predict::predict(args, terminal),
        Command::Replay(args) => replay::replay(args, terminal),
        Command::Check(check) => {
            let mut timings = Timings::new(check.timed.timings, begin);
            let end = check::check(check, &mut timings, terminal);
            timings.print(terminal);
            end
        }
        Command::Fmt(fmt) => fmt::fmt(fmt, terminal),
        Command::Explain(explain) => explain::explain(explain, terminal),
        Command::Characterise(args) => characterise::characterise(args, terminal),
        Command::Compare(args) => characterise::compare(args, terminal),
        Command::Doc(args) => doc::doc(args, terminal),
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        Command::Drives(args) => drives::drives(args, terminal),
        Command::Repl(args) => repl::repl(args, terminal),
        Command::Watch(args) => watch::watch(args, terminal),
        Command::Panel(args) => panel::panel(args, terminal),
        Command::Inspect(args) => inspect::inspect(args, terminal),
        Command::Key { command: Key::New(args) } => key::new(args, terminal),
        Command::Deploy(args) => deploy::deploy(args, terminal),
        Command::FetchLog(args) => deploy::fetch_log(args, terminal),
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        Command::Bus(args) => bus::bus(args, terminal),
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        Command::Doctor(args) => doctor::doctor(args, terminal),
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        Command::BenchRt(args) => bench_rt::bench_rt(args, terminal),
        #[cfg(not(all(feature = "hardware", target_os = "linux")))]
        Command::Hil(_) | Command::Drives(_) | Command::Bus(_) | Command::Doctor(_) | Command::BenchRt(_) => {
            terminal.error(NEEDS_HARDWARE);
            End::Misused
        }
        Command::New(new) => new::new(new, terminal),
        Command::Completions { shell } => {
            terminal.print(&args::completions(*shell));
            End::Fine
        }
        Command::Man { dir: Some(dir), .. } => {
            let pages = args::man_pages();
            let written = pages.iter().try_for_each(|(name, page)| {
                let path = dir.join(name);
                project::write(&path, page.as_bytes())
                    .map_err(|error| format!("cannot write {}: {error}", path.display()))
            });
            match &written {
                Ok(()) => terminal.line(&format!("wrote {} pages to {}", pages.len(), dir.display())),
                Err(why) => terminal.error(why),
            }
            if written.is_ok() { End::Fine } else { End::Failed }
        }
        Command::Man { command, .. } => {
            terminal.print(&args::man(command.as_deref()));
            End::Fine
        }
    }
}

/// An error, with a suggestion, if no experiment of a file has this name.
fn has_experiment(file: &Path, name: &str, all: &[String]) -> Result<(), String> {
    if all.iter().any(|one| one == name) {
        return Ok(());
    }
    let help = match compile::nearest(name, all.iter().map(String::as_str)) {
        Some(near) => format!("did you mean `{near}`?"),
        None if all.is_empty() => "it has none".into(),
        None => format!("it has {}", all.join(", ")),
    };
    Err(format!("{} has no experiment `{name}`; {help}", file.display()))
}

/// Reads and loads a text; reports problems in it. None if it cannot be used.
fn load(path: &Path, terminal: &Terminal, watch: &mut Stopwatch) -> Option<Loaded> {
    load_from(path, &crate::disk::Disk, terminal, watch)
}

/// The same with imports from other sources.
fn load_from(path: &Path, sources: &dyn Sources, terminal: &Terminal, watch: &mut Stopwatch) -> Option<Loaded> {
    let name = path.display().to_string();
    let text = match project::read(path) {
        Ok(text) => text,
        Err(reason) => {
            terminal.error(&format!("cannot read {name}: {reason}"));
            return None;
        }
    };
    load_text(&name, &text, sources, terminal, watch)
}

/// Loads a text that has been read; reports problems in it. None if it cannot be used.
fn load_text(
    name: &str,
    text: &str,
    sources: &dyn Sources,
    terminal: &Terminal,
    watch: &mut Stopwatch,
) -> Option<Loaded> {
    watch.stage("parse");
    let loaded = compile::load(name, text, sources);
    let failed = loaded.diagnostics.iter().any(Diagnostic::is_error);
    if failed {
        terminal.report(&report::full(&loaded.files.0, &loaded.diagnostics, terminal.error_colour()));
        return None;
    }
    Some(loaded)
}

/// The requested rig: the one named, or the only one.
///
/// # Errors
/// The rigs that exist instead, in words.
fn chosen_rig(file: &Path, name: Option<&str>, loaded: &Loaded) -> Result<String, String> {
    let file = file.display();
    let rigs: Vec<&str> = loaded.rigs().iter().map(|rig| rig.name.text.as_str()).collect();
    match (name, rigs.as_slice()) {
        (_, []) => Err(format!("{file} has no rig")),
        (Some(name), all) if all.contains(&name) => Ok(name.into()),
        (Some(name), all) => {
            let near = compile::nearest(name, all.iter().copied());
            let help = near.map_or(format!("it has {}", all.join(", ")), |near| format!("did you mean `{near}`?"));
            Err(format!("{file} has no rig `{name}`; {help}"))
        }
        (None, [one]) => Ok((*one).into()),
        (None, all) => Err(format!("{file} has several rigs: name one of {}", all.join(", "))),
    }
}

/// Refuses and reports errors of `fric check` in the models of a text; prints the number of warnings in one line.
fn sound(loaded: &Loaded, quiet: bool, terminal: &Terminal, watch: &mut Stopwatch) -> Result<(), Vec<Diagnostic>> {
    watch.stage("models");
    let found = compile::check_declarations(loaded, &crate::disk::Disk);
    if found.iter().any(Diagnostic::is_error) {
        reported(loaded, &found, terminal);
        return Err(found);
    }
    if !found.is_empty() && !quiet {
        let (n, s, them) = match found.len() {
            1 => (1, "", "it"),
            n => (n, "s", "them"),
        };
        let name = &loaded.files.get(loaded.root()).name;
        terminal.report(&format!("{n} warning{s}: `fric check {name}` shows {them}\n"));
    }
    Ok(())
}

/// An experiment, compiled and run.
struct Done {
    cases: Vec<Case>,
    results: Vec<Result<Outcome, Failure>>,
    /// Time in s of all cases, and of the estimate of their errors.
    wall: f64,
    judging: f64,
    stages: Stages,
}

/// Compiles an experiment; reports errors in it, and with `warn` also warnings.
fn compiled(
    loaded: &mut Loaded,
    experiment: &str,
    options: &Options,
    before: &Stages,
    warn: bool,
    terminal: &Terminal,
) -> Result<(Vec<Case>, Stages), Vec<Diagnostic>> {
    let mut watch = Stopwatch::start("names");
    let mut found = Vec::new();
    let cases =
        compile::compile(loaded, &crate::disk::Disk, experiment, options, &mut found, &mut |stage| watch.stage(stage));
    if !warn {
        found.clear();
    }
    found.extend(cases.as_ref().err().into_iter().flatten().cloned());
    if !found.is_empty() {
        terminal.report(&report::full(&loaded.files.0, &found, terminal.error_colour()));
    }
    let mut stages = before.clone();
    stages.0.extend(watch.stop().0);
    Ok((cases?, stages))
}

/// Reports the diagnostics of a text.
fn reported(loaded: &Loaded, diagnostics: &[Diagnostic], terminal: &Terminal) {
    terminal.report(&report::full(&loaded.files.0, diagnostics, terminal.error_colour()));
}

/// Runs the cases of an experiment, with a progress bar on a terminal if it takes a while. With `errors`, also
/// estimates their numerical errors.
fn done(cases: Vec<Case>, stages: Stages, quiet: bool, errors: bool) -> Done {
    done_beside(cases, stages, quiet, errors, |_, _| ()).0
}

/// As [`done`], and calls `beside` with the cases, their recordings and verdicts, in a thread of its own while the errors are
/// estimated.
fn done_beside<T: Send>(
    cases: Vec<Case>,
    stages: Stages,
    quiet: bool,
    errors: bool,
    beside: impl FnOnce(&[Case], &[Kept]) -> T + Send,
) -> (Done, T) {
    let bar = progress::bar(1000, "{percent:>3} %  {elapsed} of about {duration}", quiet);
    let begin = Instant::now();
    let watch = |fraction: f64| {
        // A short run needs no bar, and drawing one costs more than a batch of steps.
        if begin.elapsed().as_millis() > 400 {
            bar.at((1000.0 * fraction) as u64);
        }
        Continue::Continue(())
    };
    let all = compile::runs_of(&cases);
    let mut results = runs::run(&all, &watch);
    let wall = begin.elapsed().as_secs_f64();
    // The estimate needs no recording.
    let verdicts = |result: &Result<Outcome, Failure>| result.as_ref().map_or(Vec::new(), |done| done.verdicts.clone());
    let kept: Vec<Kept> =
        results.iter_mut().map(|result| (std::mem::take(recording(result)), verdicts(result))).collect();
    let (told, judging) = std::thread::scope(|scope| {
        let begin = Instant::now();
        let beside = || beside(&cases, &kept);
        if !errors {
            return (beside(), 0.0);
        }
        let beside = scope.spawn(beside);
        bar.at(0);
        runs::judge(&all, &mut results, &watch);
        let judging = begin.elapsed().as_secs_f64();
        (beside.join().unwrap_or_else(|why| std::panic::resume_unwind(why)), judging)
    });
    results.iter_mut().zip(kept).for_each(|(result, (own, _))| *recording(result) = own);
    bar.clear();
    (Done { cases, results, wall, judging, stages }, told)
}

/// What a run recorded, up to its end or its failure.
fn recording(result: &mut Result<Outcome, Failure>) -> &mut Recording {
    match result {
        Ok(outcome) => &mut outcome.recording,
        Err(failure) => &mut failure.recording,
    }
}
