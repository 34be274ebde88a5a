//! `fric watch`: runs an experiment again whenever its file is saved. States continue, matched by name and unit.

use super::{End, has_experiment};
use crate::args::Watch;
use crate::commands::shared::session::{
    catch_interrupts, interrupted, run_figure, show_run, stop_on_interrupt, tell_fault, time_of,
};
use crate::plot;
use crate::repl::Session;
use crate::terminal::Terminal;
use abi::Instance;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

/// Polling interval for changed files: short compared with a user's reaction, long compared with the cost of a check.
const LOOK: Duration = Duration::from_millis(50);

pub fn watch(args: &Watch, terminal: &mut Terminal) -> End {
    catch_interrupts();
    let file = args.file.display().to_string();
    let name = args.experiment.clone().unwrap_or_default();
    follow(&file, &name, args.restart, &mut Session::default(), terminal)
}

/// Runs an experiment of a file on each save until Ctrl-C; the only one, if none is named. `restart`: from the start
/// each time.
pub(super) fn follow(file: &str, name: &str, restart: bool, session: &mut Session, terminal: &mut Terminal) -> End {
    if let Err(fault) = session.add_file(file) {
        tell_fault(&fault, terminal);
        return End::Failed;
    }
    let name = match chosen(session, file, name) {
        Ok(name) => name,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let mut live: Option<Instance> = None;
    let mut passed = 0.0;
    loop {
        let files = session.files_of(file);
        let stamps = stamps(&files);
        let from = live.as_ref().filter(|_| !restart);
        let begun = Instant::now();
        match session.run_on(&name, from, &stop_on_interrupt) {
            Ok((ran, at)) => {
                let draws = run_figure(&ran, false);
                show_run(&ran, false, terminal);
                if let Some(carried) = &ran.carried {
                    terminal.line(&format!("  goes on from t = {}{}", abi::format::time(passed), told(carried)));
                }
                if let Some(drawn) = draws {
                    terminal.print(&plot::terminal(&drawn, terminal.width(), terminal.colour()));
                }
                if let Some(failure) = ran.results.iter().find_map(|result| result.as_ref().err()) {
                    if interrupted() {
                        return End::Fine;
                    }
                    terminal.error(&failure.to_string());
                } else {
                    passed = if from.is_some() { passed } else { 0.0 } + at.as_ref().map_or(0.0, time_of);
                    live = at;
                }
                let took = crate::quantity::duration(begun.elapsed().as_secs_f64(), 3);
                terminal.line(&format!("  {took} from text to plot; waiting for {file} (Ctrl-C ends)"));
            }
            // The last successful run stays: the next save may be correct.
            Err(fault) => tell_fault(&fault, terminal),
        }
        loop {
            let mut now = stamps.clone();
            while now == stamps {
                if interrupted() {
                    return End::Fine;
                }
                std::thread::sleep(LOOK);
                now = self::stamps(&files);
            }
            match session.reload() {
                Ok(()) => break,
                Err(fault) => tell_fault(&fault, terminal),
            }
            // Wait until the erroneous file changes.
            while self::stamps(&files) == now {
                if interrupted() {
                    return End::Fine;
                }
                std::thread::sleep(LOOK);
            }
            if session.reload().is_ok() {
                break;
            }
        }
    }
}

/// The experiment to run.
fn chosen(session: &Session, file: &str, name: &str) -> Result<String, String> {
    let all = session.experiments_of(file);
    match all.as_slice() {
        [] => Err(format!("{file} has no experiment to run")),
        [only] if name.is_empty() => Ok(only.clone()),
        _ if name.is_empty() => Err(format!("which one? {file} has {}", all.join(", "))),
        _ => has_experiment(Path::new(file), name, &all).map(|()| name.into()),
    }
}

/// `; anew: fr.z; gone: fr.w`
fn told(carried: &abi::instance::Carried) -> String {
    let mut words = String::new();
    for (what, paths) in [("anew", &carried.fresh), ("gone", &carried.lost)] {
        if !paths.is_empty() {
            words += &format!("; {what}: {}", paths.join(", "));
        }
    }
    words
}

/// Modification time and length of each file.
fn stamps(files: &[String]) -> Vec<Option<(SystemTime, u64)>> {
    let of = |file: &String| {
        let metadata = fs::metadata(Path::new(file)).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    };
    files.iter().map(of).collect()
}
