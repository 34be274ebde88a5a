//! `fric fit FILE.csv`: the standard laws, fitted to a recording and ranked by what they predict.

use super::search::{Found, Runs, Settings, held_out, search};
use super::{Asked, chosen, conclude, laws, told};
use crate::args;
use crate::commands::{End, load_text, reported};
use crate::compile::{self, Changes, Options, Sources, Stopwatch};
use crate::project;
use crate::quantity::{count, show};
use crate::terminal::Terminal;
use runtime::fit::Trouble;
use runtime::fit::ranking::{self, Contender};
use std::time::Instant;

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
    if !args.json
        && let Err(error) = project::write(&place, text.as_bytes())
    {
        terminal.error(&format!("cannot write {}: {error}", place.display()));
        return End::Failed;
    }
    let changes = Changes { tol: args.tol, ..args.stepped.changes() };
    let options = Options { changes, interpret: args.interpret };
    let names = match chosen(&place, &args.fits, &loaded) {
        Ok(names) => names,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    let mut tried: Vec<Tried> = Vec::new();
    for name in names {
        let compiled = match compile::fit(&mut loaded, &crate::disk::Disk, &name, &options, &mut Vec::new()) {
            Ok(compiled) => compiled,
            Err(errors) => {
                reported(&loaded, &errors, terminal);
                return End::Failed;
            }
        };
        let begin = Instant::now();
        let runs = Runs::new(compiled, args.threads);
        let found = search(&runs, Settings::of(args));
        let held_out = found.as_ref().ok().and_then(|found| held_out(&runs, found, Settings::of(args)));
        let contender = Contender { parameters: runs.unknowns.len(), held_out };
        tried.push(Tried { name, runs, found, contender, seconds: begin.elapsed().as_secs_f64() });
    }
    let contenders: Vec<Contender> = tried.iter().map(|one| one.contender.clone()).collect();
    let steady = tried.first().is_some_and(|one| one.runs.parts[0].asks.steady);
    let ranks = ranking::ranks(&contenders, steady);
    if !args.json && !args.quiet {
        terminal.print(&ranked(&name, &tried, &ranks));
        terminal.line(&format!("  wrote {}", place.display()));
    }
    let Some((best, _)) = ranks.first() else { return End::Failed };
    let shown = if args.json { &ranks[..] } else { &ranks[..1] };
    let mut end = End::Fine;
    for (k, rank) in shown {
        let Tried { name, runs, found, seconds, contender } = &tried[*k];
        match found {
            Ok(found) => {
                let rank = Some((*rank, contender.held_out.as_deref().map_or(f64::NAN, rms)));
                let question = Asked { args, file: &place, data: &[], loaded: &loaded, name, rank };
                if conclude(&question, runs, found.clone(), *seconds, terminal) != End::Fine && k == best {
                    end = End::Failed;
                }
            }
            Err(trouble) => {
                reported(&loaded, &[told(trouble, runs)], terminal);
                end = End::Failed;
            }
        }
    }
    end
}

/// A standard law that has been fitted.
struct Tried {
    name: String,
    runs: Runs,
    found: Result<Found, Trouble>,
    contender: Contender,
    seconds: f64,
}

/// The table of the laws in their order.
fn ranked(name: &str, tried: &[Tried], ranks: &[(usize, usize)]) -> String {
    let asks = &tried[0].runs.parts[0].asks;
    let rows = if asks.steady { "steady points" } else { "rows" };
    let mut out = format!("{name}: {} {rows}\n", count(asks.rows.len() as u64));
    let mut table = vec![["", "law", "parameters", "rms", "held out"].map(str::to_string)];
    for (k, rank) in ranks {
        let Tried { runs, found, contender, .. } = &tried[*k];
        let unit = &runs.parts[0].asks.items[0].unit;
        let seen = match found {
            Ok((answer, ..)) => show(rms(&answer.residuals[0]), unit, 4),
            Err(trouble) => told(trouble, runs).message,
        };
        let held_out = contender.held_out.as_deref().map_or(String::new(), |rows| show(rms(rows), unit, 4));
        let parameters = contender.parameters.to_string();
        table.push([rank.to_string(), runs.parts[0].asks.model.clone(), parameters, seen, held_out]);
    }
    let width = |column: usize| table.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths = [0, 1, 2, 3, 4].map(width);
    for row in &table {
        let cells: Vec<String> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        out += &format!("  {}\n", cells.join("  ").trim_end());
    }
    let pieces = if asks.steady { "every second point" } else { "every second of ten pieces" };
    out + &format!(
        "  held out: rms of each half when the law is fitted to the other, {pieces}; laws of one rank do not differ\n"
    )
}

fn rms(rows: &[f64]) -> f64 {
    (rows.iter().map(|r| r * r).sum::<f64>() / rows.len() as f64).sqrt()
}
