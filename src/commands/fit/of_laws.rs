//! `fric fit FILE.csv`: the standard laws, fitted to a recording and ranked by what they predict.

use super::conclusion::Choices;
use super::kept::Keeping;
use super::rank::{self, Heading, Tried};
use super::search::{Runs, Settings};
use super::{chosen, laws};
use crate::args;
use crate::commands::{End, load_text, reported};
use crate::compile::{self, Changes, Options, Sources, Stopwatch};
use crate::project;
use crate::terminal::Terminal;

/// `fric fit FILE.csv`: fits the standard laws, ranks them by what they predict, and shows the best one.
pub fn of_laws(args: &args::Fit, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let name = args.file.display().to_string();
    if args.check || !args.data.is_empty() {
        terminal.error(&format!("{name} is a recording; `--check` and `--data` belong to a text with a fit"));
        return End::Misused;
    }
    let read = crate::disk::Disk.file("", &name);
    let text = read.and_then(|(_, recording)| laws::text(&recording, &project::relative(&args.file, &args.out)));
    let text = match text {
        Ok(text) => text,
        Err(why) => {
            terminal.error(&format!("{name}: {why}"));
            return End::Failed;
        }
    };
    let stem = args.file.file_stem().map_or("recording".into(), |stem| stem.to_string_lossy().into_owned());
    let place = args.out.join(format!("{stem}_laws.fric"));
    let loaded = load_text(&place.display().to_string(), &text, &crate::disk::Disk, terminal, &mut watch);
    let Some(mut loaded) = loaded else { return End::Failed };
    let changes = Changes { tol: args.tol, ..args.stepped.changes() };
    let options = Options { changes, interpret: args.interpret };
    let names = match chosen(&place, &args.fits, &loaded) {
        Ok(names) => names,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    let mut all = Vec::new();
    for name in names {
        match compile::fit(&mut loaded, &crate::disk::Disk, &name, &options, &mut Vec::new()) {
            Ok(compiled) => all.push((name, compiled)),
            Err(errors) => {
                reported(&loaded, &errors, terminal);
                return End::Failed;
            }
        }
    }
    let unknowns = all.iter().flat_map(|(_, compiled)| compiled).flat_map(|fit| &fit.unknowns);
    if let Some(unknown) = Choices::of(args).unknown_profile(unknowns) {
        terminal.error(&format!("--profile: no law has a parameter `{unknown}`"));
        return End::Misused;
    }
    if !args.json
        && let Err(error) = project::write(&place, text.as_bytes())
    {
        terminal.error(&format!("cannot write {}: {error}", place.display()));
        return End::Failed;
    }
    let mut tried: Vec<Tried> = Vec::new();
    let mut keeping = Keeping::new(args);
    for (name, compiled) in all {
        let kept = match keeping.begin(&loaded, &name, &compiled, terminal) {
            Ok(kept) => kept,
            Err(why) => {
                terminal.error(&why);
                return End::Failed;
            }
        };
        // A fit of a law has no alternatives.
        let mut runs = Runs::new(compiled.into_iter().next().expect("it has been compiled"), args.threads);
        runs.keep(kept);
        tried.push(Tried::new(&name, runs, Settings::of(args)));
    }
    let heading = Heading { title: &name, wrote: Some(&place) };
    let end = rank::rank(args, &heading, (&place, &[]), &loaded, &tried, terminal);
    keeping.finish(terminal);
    end
}
