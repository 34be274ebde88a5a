//! Fits of a text: compiled once, with their residuals at any values, and searched for.
//!
//! In: a text, the name of a fit, recordings in place of those that the text names. Out: residuals; values with
//! intervals, and the files of `fric fit`.

use super::{Problems, Text, without_effect};
use crate::commands::fit::conclusion::{Asked, Choices, Conclusion, recordings, told};
use crate::commands::fit::rank::{self, Tried};
use crate::commands::fit::search::{Found, Part, Runs, search};
use crate::commands::fit::{answer, laws as standard};
use crate::compile::{self, Loaded, Options, Sources};
use crate::disk::Disk;
use crate::named_files::NamedFiles;
use crate::plot::{self, Look};
use crate::terminal::Terminal;
use crate::{project, report};
use abi::unit::Unit;
use grammar::diagnostic::Diagnostic;
use runtime::fit::{Trouble, Way};
use runtime::package;
use runtime::run::verdict::Verdict;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// A fit that is compiled, of one law.
pub struct Fit {
    loaded: Loaded,
    name: String,
    runs: Runs,
    /// Recordings that are in memory: the name by which they are read, and their content as CSV.
    tables: Vec<(String, String)>,
    /// Whether recordings take the place of those in the text.
    given: bool,
}

/// An unknown of a fit. Numbers are in SI.
#[derive(Clone, Debug)]
pub struct Unknown {
    /// Its name beside the others: `Fc`, `initial(z)`, `F0 of a.csv`.
    pub label: String,
    /// The path by which a model or an experiment is given it; none if it belongs to one recording, or to the fit alone.
    pub path: Option<String>,
    /// The SI unit.
    pub si: String,
    /// Where the search starts.
    pub start: f64,
    /// The range.
    pub range: (f64, f64),
}

/// Residuals of one compared quantity of one recording.
pub struct Compared {
    /// `F - data.F`; of several recordings, that of each before it.
    pub label: String,
    /// The SI unit.
    pub si: String,
    /// Times of the rows in s, as in the recording; of steady points their numbers, from 0.
    pub times: Vec<f64>,
}

impl Text {
    /// Names of its fits.
    pub fn fits(&self) -> Vec<String> {
        self.loaded.fits().into_iter().map(str::to_string).collect()
    }

    /// Compiles a fit: one for each of its laws. `options.changes.data`: recordings in place of the text's own, absolute
    /// paths or names of `tables`, which hold recordings in memory as CSV. `stop`: set when nobody waits any more.
    ///
    /// # Errors
    /// The errors of the text and of the fit; recordings that cannot be read; a step or a tolerance without effect.
    pub fn fit(
        &self,
        name: &str,
        options: &Options,
        tables: Vec<(String, String)>,
        threads: Option<usize>,
        stop: &Arc<AtomicBool>,
    ) -> Result<Vec<Fit>, Problems> {
        let mut loaded = self.loaded.clone();
        let mut files = self.sources.all();
        let own = self.source().0;
        files.extend(tables.iter().map(|(name, text)| (own.clone(), name.clone(), name.clone(), text.clone())));
        let sources = if tables.is_empty() { self.sources.clone() } else { NamedFiles::new(files) };
        let found = compile::check_declarations(&loaded, &sources);
        if found.iter().any(Diagnostic::is_error) {
            return Err(Problems::of(&loaded, &found));
        }
        let compiled = compile::fit(&mut loaded, &sources, name, options, &mut Vec::new());
        let compiled = compiled.map_err(|found| Problems::of(&loaded, &found))?;
        let method = compiled[0].parts[0].varying.experiment.solver.method;
        if let Some(why) = without_effect(name, method, &options.changes) {
            return Err(Problems { report: why, ..Problems::of(&loaded, &[]) });
        }
        let given = !options.changes.data.is_empty();
        let one = |fit: compile::Fit| {
            let mut runs = Runs::new(fit, threads);
            runs.stop_by(stop);
            Fit { loaded: loaded.clone(), name: name.into(), runs, tables: tables.clone(), given }
        };
        Ok(compiled.into_iter().map(one).collect())
    }
}

impl Fit {
    /// The law, of a fit of several: `fr = LuGre()`.
    pub fn law(&self) -> &str {
        &self.runs.label
    }

    /// Its unknowns, in the order of all values.
    pub fn unknowns(&self) -> Vec<Unknown> {
        let several = self.runs.parts.len() > 1;
        let one = |unknown: &compile::FitUnknown| {
            let is_shared = !(unknown.own || unknown.initial || several && unknown.of.is_some());
            Unknown {
                label: unknown.label.clone(),
                path: is_shared.then(|| unknown.path.clone()),
                si: Unit::si(unknown.unit.dimension).text,
                start: unknown.start,
                range: unknown.range,
            }
        };
        self.runs.unknowns.iter().map(one).collect()
    }

    /// What is compared, in the order of all residuals.
    pub fn compared(&self) -> Vec<Compared> {
        let of = |part: &Part| {
            let before = self.runs.before(part);
            let one = |item: &compile::FitItem| {
                let rows = item.kept(&part.instants).into_iter();
                let times =
                    rows.map(|row| if part.asks.steady { row as f64 } else { part.instants[row] + part.asks.begins });
                let si = Unit::si(item.unit.dimension).text;
                Compared { label: format!("{before}{}", item.shown()), si, times: times.collect() }
            };
            part.asks.items.iter().map(one).collect::<Vec<_>>()
        };
        self.runs.parts.iter().flat_map(of).collect()
    }

    /// The residuals at these values of all unknowns, in SI, with the step of the text.
    ///
    /// # Errors
    /// Why the model cannot be run with them, in words.
    pub fn residuals(&self, values: &[f64]) -> Result<Vec<Vec<f64>>, String> {
        self.runs.residuals(Way::Whole, values, &self.runs.steps()).map(|found| self.as_recorded(found))
    }

    /// Residuals in the order of the rows in the file: steady points are run in another one.
    fn as_recorded(&self, mut residuals: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        for (part, items) in self.runs.parts.iter().zip(self.runs.items()) {
            for column in residuals[items].iter_mut().filter(|_| part.asks.steady) {
                let held = column.clone();
                part.asks.points.iter().zip(held).for_each(|(row, value)| column[*row] = value);
            }
        }
        residuals
    }

    /// Searches for the values, and answers what is wished beside them.
    ///
    /// # Errors
    /// That there is no answer, and why.
    pub fn search(self, choices: &Choices) -> Result<FoundFit, Problems> {
        let begin = Instant::now();
        match search(&self.runs, choices.settings) {
            Ok(found) => FoundFit::new(self, found, choices, None, begin.elapsed().as_secs_f64()),
            Err(trouble) => Err(self.problem(&trouble)),
        }
    }

    fn problem(&self, trouble: &Trouble) -> Problems {
        Problems::of(&self.loaded, &[told(trouble, &self.runs)])
    }

    /// The name of the text's file.
    fn file(&self) -> PathBuf {
        PathBuf::from(&self.loaded.files.get(self.loaded.root()).name)
    }
}

/// A path of `profile` that none of these fits varies.
///
/// # Errors
/// That path, in words.
pub fn check(fits: &[Fit], choices: &Choices) -> Result<(), String> {
    match (choices.unknown_profile(fits.iter().flat_map(|fit| &fit.runs.unknowns)), fits) {
        (None, _) => Ok(()),
        (Some(unknown), [one]) => Err(format!("profile: fit `{}` does not vary `{unknown}`", one.name)),
        (Some(unknown), _) => Err(format!("profile: no fit varies `{unknown}`")),
    }
}

/// Searches for the values of several laws, and ranks them by what they predict: the best first. Laws without an answer
/// come as problems.
pub fn ranked(fits: Vec<Fit>, choices: &Choices) -> (Vec<FoundFit>, Vec<Problems>) {
    let one = |fit: Fit| {
        let Fit { loaded, name, runs, tables, given } = fit;
        (Tried::new(&name, runs, choices.settings), (loaded, tables, given))
    };
    let (tried, mut others): (Vec<Tried>, Vec<_>) = fits.into_iter().map(one).map(|(a, b)| (a, Some(b))).unzip();
    let order = rank::order(&tried);
    let mut tried: Vec<Option<Tried>> = tried.into_iter().map(Some).collect();
    let (mut all, mut problems) = (Vec::new(), Vec::new());
    for (k, place) in order {
        let (tried, other) = (tried[k].take(), others[k].take());
        let Tried { name, runs, found, seconds, .. } = tried.expect("each law has one place");
        let (loaded, tables, given) = other.expect("each law has one place");
        let fit = Fit { loaded, name, runs, tables, given };
        let ended = match found {
            Ok(found) => FoundFit::new(fit, found, choices, Some(&place), seconds),
            Err(trouble) => Err(fit.problem(&trouble)),
        };
        match ended {
            Ok(found) => all.push(found),
            Err(problem) => problems.push(problem),
        }
    }
    (all, problems)
}

/// A fit with its answer.
pub struct FoundFit {
    fit: Fit,
    conclusion: Conclusion,
    recordings: Vec<(PathBuf, String)>,
    /// The place among several laws, from 1.
    pub rank: Option<usize>,
}

impl FoundFit {
    fn new(
        fit: Fit,
        found: Found,
        choices: &Choices,
        rank: Option<&answer::Rank>,
        seconds: f64,
    ) -> Result<FoundFit, Problems> {
        let concluded = Conclusion::new(&fit.name, &fit.runs, found, choices, rank, seconds);
        let wrong = |report: String| Problems { report, ..Problems::of(&fit.loaded, &[]) };
        let conclusion = concluded.map_err(wrong)?;
        let mut recordings = recordings(&fit.file(), &fit.runs, fit.given);
        for (path, hash) in &mut recordings {
            if let Some((_, table)) = fit.tables.iter().find(|(name, _)| Path::new(name) == path) {
                *hash = package::hash(table.as_bytes());
            }
        }
        Ok(FoundFit { fit, conclusion, recordings, rank: rank.map(|rank| rank.rank) })
    }

    fn asked<'a>(&'a self, file: &'a Path, recordings: &'a [(PathBuf, String)]) -> Asked<'a> {
        Asked { loaded: &self.fit.loaded, file, name: &self.fit.name, recordings }
    }

    /// The compiled fit.
    pub fn fit(&self) -> &Fit {
        &self.fit
    }

    /// Values in SI.
    pub fn values(&self) -> &[f64] {
        &self.conclusion.fitted.answer.values
    }

    /// Standard deviations and intervals in SI, widened where a value drifts.
    pub fn spreads(&self) -> Vec<(f64, (f64, f64))> {
        let unknowns = self.fit.runs.unknowns.iter().enumerate();
        unknowns.map(|(k, unknown)| self.conclusion.fitted.spread(k, unknown)).collect()
    }

    /// Correlations of the values, row by row.
    pub fn correlation(&self) -> &[f64] {
        &self.conclusion.fitted.answer.correlation
    }

    /// Compared minus recorded, in SI, in the order of [`Fit::compared`].
    pub fn residuals(&self) -> Vec<Vec<f64>> {
        self.fit.as_recorded(self.conclusion.fitted.answer.residuals.clone())
    }

    /// The length of the steps of each recording, of adaptive runs their tolerance.
    pub fn steps(&self) -> Vec<f64> {
        self.conclusion.fitted.runs.iter().map(|run| run.step).collect()
    }

    /// Whether the search ended in a minimum.
    pub fn converged(&self) -> bool {
        self.conclusion.fitted.converged()
    }

    /// Whether all expectations hold.
    pub fn passed(&self) -> bool {
        self.conclusion.fitted.runs.iter().flat_map(|run| &run.verdicts).all(Verdict::passed)
    }

    /// The object of `fric fit --json`.
    pub fn json(&self) -> String {
        self.conclusion.json(&self.asked(&self.fit.file(), &self.recordings), &self.fit.runs).to_string()
    }

    /// The warnings, as the JSON of `fric check`.
    pub fn warnings(&self) -> String {
        report::json(&self.fit.loaded.files.0, &self.conclusion.warnings).to_string()
    }

    /// The table of `fric fit`.
    pub fn words(&self) -> String {
        Terminal::text(|terminal| terminal.print(&self.conclusion.fitted.words(&self.fit.runs, terminal)))
    }

    /// What the fit plots, as SVG `wide` px wide, a picture for each recording. `id` makes their identifiers unique on a
    /// page.
    pub fn svg(&self, wide: f64, id: &str) -> Vec<String> {
        let figures = self.conclusion.figures(&self.fit.name, &self.fit.runs);
        let drawn = figures
            .iter()
            .enumerate()
            .map(|(k, figure)| plot::inline(figure, &Look::default(), wide, &format!("{id}{k}")));
        drawn.collect()
    }

    /// Writes the files of `fric fit` into a folder; also recordings that were in memory, so that the text to go on with
    /// finds them. `page`: also the report. Returns the paths.
    ///
    /// # Errors
    /// Which file cannot be written, and why.
    pub fn save(&self, folder: &Path, page: bool) -> Result<Vec<PathBuf>, String> {
        let told = |(path, error): (PathBuf, std::io::Error)| format!("cannot write {}: {error}", path.display());
        let mut written = Vec::new();
        let mut recordings = self.recordings.clone();
        for (path, _) in &mut recordings {
            if let Some((name, table)) = self.fit.tables.iter().find(|(name, _)| Path::new(name) == path) {
                *path = folder.join(name);
                if !written.contains(path) {
                    project::write(path, table.as_bytes()).map_err(|error| told((path.clone(), error)))?;
                    written.push(path.clone());
                }
            }
        }
        let file = self.fit.file();
        let paths =
            self.conclusion.write(&self.asked(&file, &recordings), &self.fit.runs, folder, page).map_err(told)?;
        Ok(written.into_iter().chain(paths).collect())
    }
}

/// A text with a fit of each standard law to a recording, which it names `file`. `recording`: its content as CSV.
///
/// # Errors
/// What the recording lacks, in words.
pub fn laws(recording: &str, file: &str) -> Result<String, String> {
    standard::text(recording, file)
}

/// A recording on disk as CSV, whatever the kind of its file.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn table(path: &str) -> Result<String, String> {
    Disk.file("", path).map(|(_, text)| text)
}
