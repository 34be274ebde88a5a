//! The conclusion of a fit that has been searched for: what its words, its JSON and its files show.
//!
//! In: runs and the values found. Out: profiles, pieces, verdicts and warnings beside the values; and files.

use super::answer::{self, Fitted, Rank};
use super::search::{Found, Part, Runs, Settings, search_from};
use super::{after, page, text};
use crate::args;
use crate::commands::sweep;
use crate::compile::{self, Loaded};
use crate::figure::{self, Recorded};
use crate::plot::{self, Kind, Look};
use crate::project;
use crate::quantity::{count, show};
use abi::plan::Experiment;
use grammar::diagnostic::Diagnostic;
use runtime::engine::{self, Continue, Failure};
use runtime::fit::Trouble;
use runtime::package;
use runtime::run::verdict::Verdict;
use serde_json::Value;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A fit that has been searched for.
#[derive(Clone, Copy)]
pub struct Asked<'a> {
    /// The text with the fit.
    pub loaded: &'a Loaded,
    /// Its file.
    pub file: &'a Path,
    /// The name of the fit.
    pub name: &'a str,
    /// The recording of each run and its SHA-256.
    pub recordings: &'a [(PathBuf, String)],
}

/// What is asked beside the values.
#[derive(Clone)]
pub struct Choices {
    /// How the values were searched for.
    pub settings: Settings,
    /// Parameters whose profile is computed; or all, or none. Else those that need it.
    pub profile: Vec<String>,
    /// Pieces of the recordings that are also fitted each.
    pub pieces: usize,
}

impl Default for Choices {
    fn default() -> Choices {
        Choices { settings: Settings::new(args::LEVEL), profile: Vec::new(), pieces: args::PIECES }
    }
}

impl Choices {
    /// As the command line states them.
    pub fn of(args: &args::Fit) -> Choices {
        Choices { settings: Settings::of(args), profile: args.profile.clone(), pieces: args.pieces }
    }

    /// A parameter whose profile is asked for and that is none of these.
    pub fn unknown_profile<'u>(&self, all: impl Iterator<Item = &'u compile::FitUnknown> + Clone) -> Option<&str> {
        let is_known = |path: &str| all.clone().any(|unknown| unknown.path == path || unknown.label == path);
        self.profile.iter().map(String::as_str).find(|path| !matches!(*path, "all" | "none") && !is_known(path))
    }
}

/// A fit and everything that is shown of it.
pub struct Conclusion {
    /// The values.
    pub fitted: Fitted,
    /// The run of each recording with these values.
    outcomes: Vec<engine::Outcome>,
    /// Warnings that the fit does not allow.
    pub warnings: Vec<Diagnostic>,
}

impl Conclusion {
    /// Concludes a fit. `seconds`: the time of the search.
    ///
    /// # Errors
    /// Why a run with the values found stops, in words.
    pub fn new(
        name: &str,
        runs: &Runs,
        found: Found,
        choices: &Choices,
        rank: Option<&Rank>,
        seconds: f64,
    ) -> Result<Conclusion, String> {
        let begin = Instant::now();
        let settings = choices.settings;
        let (found, profiles) = profiled(choices, runs, found);
        let pieces = after::pieces(runs, &found, settings, choices.pieces);
        let validated = after::judge(runs, &found, settings);
        let (answer, steps, coarse) = found;
        let mut fitted =
            Fitted::new(name, runs, answer, &steps, settings.level, seconds + begin.elapsed().as_secs_f64());
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
            let of = runs.before(part);
            let (outcome, left) = judged(part, values, *step)
                .map_err(|failure| format!("{name}: {of}the fitted run stops: {failure}"))?;
            fitted.notes.extend(left.map(|left| format!("{of}{left}")));
            let on = Fitted::step_on(part, *step);
            let run = answer::Run {
                verdicts: own(part, &outcome).to_vec(),
                measures: part.measures(values, on),
                unsettled: if part.asks.steady { part.unsettled(values, &fitted.answer.rms[items.clone()]) } else { 0 },
                solver: part.solver(on),
                step: *step,
                remarks: after::remarks(part, &fitted.answer, items),
            };
            fitted.runs.push(run);
            outcomes.push(outcome);
        }
        let warnings = fitted.warnings(runs);
        Ok(Conclusion { fitted, outcomes, warnings })
    }

    /// The expectations that do not hold.
    pub fn failed(&self) -> Vec<Verdict> {
        let all = self.fitted.runs.iter().flat_map(|run| &run.verdicts);
        all.filter(|verdict| !verdict.passed()).cloned().collect()
    }

    /// The object of `fric fit --json`.
    pub fn json(&self, question: &Asked, runs: &Runs) -> Value {
        self.fitted.json(question.file, runs, question.recordings)
    }

    /// The run of each recording as a figure, as far as the fit plots something.
    pub fn figures(&self, name: &str, runs: &Runs) -> Vec<plot::Figure> {
        let each = runs.parts.iter().zip(&self.outcomes).zip(runs.items());
        let drawn = each.filter(|((part, _), _)| !part.varying.plots.is_empty()).map(|((part, outcome), items)| {
            let asks = &part.asks;
            let rms = asks.items.iter().zip(&self.fitted.answer.rms[items]);
            let rms: Vec<String> = rms.map(|(item, rms)| show(*rms, &item.unit, 3)).collect();
            let rows = count(asks.rows.len() as u64);
            let subtitle = format!("{} fitted to {rows} rows, rms {}", asks.model, rms.join(", "));
            let plots = &part.varying.plots;
            let drawn = Recorded { label: "", plots, recording: &outcome.recording, verdicts: &[] };
            figure::figure(&stem(name, runs, part), &subtitle, 0, &[drawn])
        });
        drawn.collect()
    }

    /// Writes the files of a fit into a folder; returns their paths, or the one that failed and why. `report`: a page too.
    ///
    /// # Errors
    /// The path, and why it cannot be written.
    pub fn write(
        &self,
        question: &Asked,
        runs: &Runs,
        folder: &Path,
        report: bool,
    ) -> Result<Vec<PathBuf>, (PathBuf, io::Error)> {
        let mut paths = Vec::new();
        let mut write = |path: PathBuf, content: &mut project::Content| {
            project::write_by(&path, content).map_err(|error| (path.clone(), error))?;
            paths.push(path);
            Ok(())
        };
        let bytes = |bytes: Vec<u8>| move |out: &mut dyn Write| out.write_all(&bytes);
        let Asked { loaded, file, name, recordings } = *question;
        let statement = compile::find_fit(loaded, name).expect("it has been fitted");
        let at = |stem: &str, ending: &str| folder.join(format!("{stem}.{ending}"));
        // A text on the standard input has no place from which another could import it.
        if !project::is_standard(file) {
            let place = text::Place { folder, file, recordings };
            let text = text::text(loaded, statement, &self.fitted, runs, &place);
            write(at(name, "fric"), &mut bytes(text.into_bytes()))?;
        }
        let json = format!("{:#}\n", self.json(question, runs));
        write(at(name, "json"), &mut bytes(json.into_bytes()))?;
        let mut figures = self.figures(name, runs).into_iter();
        let mut shown = Vec::new();
        for ((part, run), outcome) in runs.parts.iter().zip(&self.fitted.runs).zip(&self.outcomes) {
            let stem = stem(name, runs, part);
            let mut rows = Vec::new();
            write(at(&stem, "csv"), &mut |out| compared(part, &self.fitted, run.step, out, &mut rows))?;
            shown.push(page::PageRun { recording: &outcome.recording, rows });
            if !part.varying.plots.is_empty() {
                let figure = figures.next().expect("one for each run with plots");
                write(at(&stem, "svg"), &mut bytes(plot::picture(&figure, &Look::default(), Kind::Svg)))?;
            }
        }
        if report {
            let page =
                page::report(&self.fitted, runs, (name, loaded.files.slice(statement.span)), &self.warnings, &shown);
            write(at(name, "html"), &mut bytes(page.into_bytes()))?;
        }
        Ok(paths)
    }
}

/// The stem of the files that are written of one recording.
fn stem(name: &str, runs: &Runs, part: &Part) -> String {
    if runs.parts.len() > 1 { format!("{name}_{}", part.asks.label) } else { name.to_string() }
}

/// Writes the compared rows of a recording as CSV, and keeps every n-th for the page.
fn compared(
    part: &Part,
    fitted: &Fitted,
    step: f64,
    out: &mut dyn Write,
    rows: &mut Vec<(usize, Vec<f64>)>,
) -> io::Result<()> {
    let asks = &part.asks;
    let mut slots = part.slots.clone();
    slots.extend(asks.items.iter().flat_map(|item| item.sides.iter().flatten().map(|(_, slot)| *slot)));
    let every = page::every(part.instants.len());
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
    let ran = part.sampled(&fitted.answer.values, step, (&part.instants, &slots), &mut each);
    match (ran, fault) {
        (Ok(()), _) => Ok(()),
        (Err(_), Some(error)) => Err(error),
        (Err(why), None) => Err(io::Error::other(why)),
    }
}

/// The profiles that are asked for, or that the answer needs. Where a profile meets a better answer, the search goes on
/// from there, once.
fn profiled(choices: &Choices, runs: &Runs, mut found: Found) -> (Found, Vec<Option<after::Profile>>) {
    let settings = choices.settings;
    let n = runs.unknowns.len();
    let mut again = true;
    'answer: loop {
        let answer = &found.0;
        let is_asked = |k: usize| {
            let unknown = &runs.unknowns[k];
            match &choices.profile[..] {
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
pub fn judged(part: &Part, values: &[f64], step: f64) -> Result<(engine::Outcome, Option<String>), Failure> {
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
pub fn own<'o>(part: &Part, outcome: &'o engine::Outcome) -> &'o [Verdict] {
    &outcome.verdicts[..part.varying.expects() - part.slots.len()]
}

/// The recording of each run and its SHA-256. `given`: they come from the command line, with absolute paths.
pub fn recordings(file: &Path, runs: &Runs, given: bool) -> Vec<(PathBuf, String)> {
    let from = if given { String::new() } else { file.display().to_string() };
    let one = |part: &Part| match project::bytes_named(&from, &part.asks.recording) {
        Ok((path, bytes)) => (path, package::hash(&bytes)),
        // It has been read before; now it is gone, or it was in memory.
        Err(_) => (PathBuf::from(&part.asks.recording), String::new()),
    };
    runs.parts.iter().map(one).collect()
}

/// What went wrong, as a diagnostic.
pub fn told(trouble: &Trouble, runs: &Runs) -> Diagnostic {
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
