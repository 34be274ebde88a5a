//! Several laws, fitted to the same recordings and ranked by what they predict.
//!
//! In: fits that have been searched. Out: a table, and the files of the best. The order is that of the error on rows that a
//! law has not seen.

use super::answer::Rank;
use super::conclusion::{Asked, recordings, told};
use super::search::{Found, Runs, Settings, search};
use super::{after, conclude};
use crate::args;
use crate::commands::{End, reported};
use crate::compile::{ElementaryFunction, Loaded};
use crate::quantity::{count, show, significant};
use crate::terminal::Terminal;
use runtime::fit::ranking::{self, Contender, Paired};
use runtime::fit::{Residuals, Trouble};
use std::path::Path;
use std::time::Instant;

/// A law that has been fitted.
pub struct Tried {
    /// The name of its fit.
    pub name: String,
    /// The law, as the table names it.
    pub law: String,
    /// Its runs.
    pub runs: Runs,
    /// Its answer.
    pub found: Result<Found, Trouble>,
    /// What it leaves of rows that it has not seen, for each compared quantity.
    pub held_out: Option<Residuals>,
    /// Time of the search in s.
    pub seconds: f64,
}

impl Tried {
    /// Searches for the values of a law, and for what it leaves of rows that it has not seen.
    pub fn new(name: &str, runs: Runs, settings: Settings) -> Tried {
        let begin = Instant::now();
        let found = search(&runs, settings);
        let held_out = found.as_ref().ok().and_then(|found| after::held_out(&runs, found, settings));
        let law = if runs.label.is_empty() { runs.parts[0].asks.model.clone() } else { runs.label.clone() };
        Tried { name: name.into(), law, runs, found, held_out, seconds: begin.elapsed().as_secs_f64() }
    }
}

/// What stands above the table, and the file of all laws, if one was written.
pub struct Heading<'a> {
    /// The recording or the fit.
    pub title: &'a str,
    /// Where the text with the fits of all laws is.
    pub wrote: Option<&'a Path>,
}

/// Ranks the laws, shows the table and the best one, or all as JSON. `place`: the file of the fits, and recordings in
/// place of those in it.
pub fn rank(
    args: &args::Fit,
    heading: &Heading,
    (file, data): (&Path, &[String]),
    loaded: &Loaded,
    tried: &[Tried],
    terminal: &mut Terminal,
) -> End {
    let ranks = order(tried);
    if !args.json && !args.quiet {
        terminal.print(&table(heading.title, tried, &ranks));
        if let Some(place) = heading.wrote {
            terminal.line(&format!("  wrote {}", place.display()));
        }
    }
    let Some((best, _)) = ranks.first() else { return End::Failed };
    let shown = if args.json { &ranks[..] } else { &ranks[..1] };
    let mut end = End::Fine;
    for (k, rank) in shown {
        let Tried { name, runs, found, seconds, .. } = &tried[*k];
        match found {
            Ok(found) => {
                let recordings = recordings(file, runs, !data.is_empty());
                let question = Asked { loaded, file, name, recordings: &recordings };
                let end_of_one = conclude(args, &question, runs, found.clone(), (Some(rank), *seconds), terminal);
                if end_of_one != End::Fine && k == best {
                    end = End::Failed;
                }
            }
            Err(trouble) => {
                reported(loaded, &[told(trouble, runs)], terminal);
                end = End::Failed;
            }
        }
    }
    end
}

/// The laws, the best first: the index of each in `tried`, and its rank.
pub fn order(tried: &[Tried]) -> Vec<(usize, Rank)> {
    let steady = tried.first().is_some_and(|one| one.runs.parts[0].asks.steady);
    let contenders = contenders(tried);
    let order = ranking::ranks(&contenders, steady);
    let ranked = |(at, (k, rank)): (usize, &(usize, usize))| {
        let than_next = order.get(at + 1).and_then(|(next, _)| {
            let paired = ranking::paired(&contenders[*k], &contenders[*next], steady)?;
            Some((tried[*next].law.clone(), paired))
        });
        let held_out = tried[*k].held_out.as_ref().map_or(f64::NAN, |rows| rms(&rows[0]));
        (*k, Rank { rank: *rank, held_out, than_next })
    };
    order.iter().enumerate().map(ranked).collect()
}

/// The laws as they are ranked: residuals of several quantities count in units of those of the first law.
fn contenders(tried: &[Tried]) -> Vec<Contender> {
    let scales: Option<Vec<f64>> =
        tried.iter().find_map(|one| Some(one.held_out.as_ref()?.iter().map(|rows| rms(rows)).collect()));
    let scales = scales.unwrap_or_default();
    let several = scales.len() > 1;
    let one = |tried: &Tried| {
        let scaled = |(rows, scale): (&Vec<f64>, &f64)| -> Vec<f64> {
            rows.iter().map(|r| if several && *scale > 0.0 { r / scale } else { *r }).collect()
        };
        let rows = tried.held_out.as_ref().map(|all| all.iter().zip(&scales).flat_map(scaled).collect());
        Contender { parameters: tried.runs.unknowns.len(), held_out: rows }
    };
    tried.iter().map(one).collect()
}

/// The table of the laws in their order.
fn table(title: &str, tried: &[Tried], ranks: &[(usize, Rank)]) -> String {
    let first = &tried[0].runs;
    let steady = first.parts[0].asks.steady;
    let rows = if steady { "steady points" } else { "rows" };
    let mut out = format!("{title}: {} {rows}\n", count(first.rows() as u64));
    let log = ElementaryFunction::log();
    let criterion = |one: &Tried| {
        let (answer, ..) = one.found.as_ref().ok()?;
        let rows: usize = answer.residuals.iter().map(Vec::len).sum();
        let parameters = one.runs.unknowns.len() as f64;
        let misfit = after::misfit(&one.runs, (&answer.noise, &answer.residuals), &answer.values);
        Some(misfit + parameters * log.at(rows as f64))
    };
    let least = tried.iter().filter_map(&criterion).fold(f64::INFINITY, f64::min);
    let mut table = vec![["", "law", "parameters", "rms", "held out", "ΔBIC", "than the next"].map(str::to_string)];
    for (k, Rank { rank, than_next, .. }) in ranks {
        let one = &tried[*k];
        let items = || one.runs.parts.iter().flat_map(|part| &part.asks.items);
        let each = |residuals: &[Vec<f64>]| -> String {
            let shown = items().cycle().zip(residuals).map(|(item, rows)| show(rms(rows), &item.unit, 4));
            shown.collect::<Vec<_>>().join(", ")
        };
        let seen = match &one.found {
            Ok((answer, ..)) => each(&answer.residuals),
            Err(trouble) => told(trouble, &one.runs).message,
        };
        let held_out = one.held_out.as_deref().map_or(String::new(), each);
        let bic = criterion(one).map_or(String::new(), |bic| significant(bic - least, 4));
        let next = than_next.as_ref().map_or(String::new(), |(_, paired)| {
            let Paired { better: (better, all), gain: (gain, error) } = paired;
            let [gain, error] = [gain, error].map(|part| significant(100.0 * part, 2));
            format!("better in {better} of {all}, by {gain} ± {error} %")
        });
        table.push([rank.to_string(), one.law.clone(), one.runs.unknowns.len().to_string(), seen, held_out, bic, next]);
    }
    let width = |column: usize| table.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths = [0, 1, 2, 3, 4, 5, 6].map(width);
    for row in &table {
        let cells: Vec<String> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        out += &format!("  {}\n", cells.join("  ").trim_end());
    }
    let pieces = if steady { "every second point" } else { "every second of ten pieces" };
    out + &match first.judged.is_empty() {
        true => format!(
            "  held out: rms of each half when the law is fitted to the other, {pieces}; laws of one rank do not differ\n"
        ),
        false => "  held out: rms of the recordings of `validate`; laws of one rank do not differ\n".to_string(),
    }
}

fn rms(rows: &[f64]) -> f64 {
    (rows.iter().map(|r| r * r).sum::<f64>() / rows.len() as f64).sqrt()
}
