//! What other programs embed of the command: texts with their experiments and models, without arguments and terminal.
//!
//! In: a text and its name. Out: runs with the results of `fric run --json`, programs of models, reports on mistakes as
//! strings. Files that a text names are read once, so that the text can be sent elsewhere together with them.

mod fits;

pub use crate::args::Keep;
use crate::characterise::subject::Written;
use crate::characterise::{Extent, page, study};
use crate::commands::sweep::{self, SweepRequest};
pub use crate::commands::sweep::{Rows as SweepRows, Sent as Sweep, SweepFault};
use crate::commands::{characterise, explain, linearise};
use crate::compile::{self, Built, Case, Changes, Idle, Loaded, Options, Stages};
pub use crate::compile::{Dialect, Ports};
use crate::figure::{self, Kept};
pub use crate::named_files::NamedFile;
use crate::named_files::NamedFiles;
use crate::plot::{self, Look};
use crate::results::{self, Ran};
use crate::terminal::Terminal;
use crate::{equations, project, report};
use abi::plan::Method;
use abi::unit::Unit;
use abi::{Instance, Slot};
use grammar::diagnostic::Diagnostic;
use runtime::engine::{self, Continue, Failure, Outcome, equilibrium, even_grid, sweep as runs};
use runtime::record::Recording;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

pub use crate::commands::fit::conclusion::Choices as FitChoices;
pub use fits::{Compared, Fit, FoundFit, Unknown, check as check_fits, laws, ranked, table};

/// What is wrong with a text or with what was asked of it.
#[derive(Clone, Debug)]
pub struct Problems {
    /// The report as on a terminal without colour.
    pub report: String,
    /// The diagnostics as the JSON of `fric check --json`.
    pub json: String,
    /// The codes of the errors.
    pub codes: Vec<&'static str>,
}

impl Problems {
    fn of(loaded: &Loaded, found: &[Diagnostic]) -> Problems {
        Problems {
            report: report::full(&loaded.files.0, found, false),
            json: report::json(&loaded.files.0, found).to_string(),
            codes: found.iter().filter(|diagnostic| diagnostic.is_error()).map(|diagnostic| diagnostic.code).collect(),
        }
    }
}

/// Why a step or a tolerance would be without effect on an experiment that is run by this method.
fn without_effect(experiment: &str, method: Method, changes: &Changes) -> Option<String> {
    match compile::idle(method, changes.step, changes.tol)? {
        Idle::Step => Some(format!(
            "a step is for fixed steps, and `{experiment}` is run by adaptive ones: name a solver as well, one of {}, or leave \
             the step out",
            Method::list(Method::fixed())
        )),
        Idle::Tolerance => Some(format!(
            "a tolerance is for adaptive steps, and `{experiment}` takes fixed ones of `{}`: name the solver `adaptive`, or leave \
             the tolerance out",
            method.name()
        )),
    }
}

/// One case of an experiment, after its run.
pub struct EndedRun {
    /// The object of `fric run --json`.
    pub json: String,
    /// How the case differs from the others of its experiment.
    pub label: String,
    /// The message and the time in s of a failure.
    pub failure: Option<(String, f64)>,
    case: Case,
    result: Result<Outcome, Failure>,
}

impl EndedRun {
    /// The rows that were recorded for plots: a few thousand, with each minimum and maximum.
    pub fn thin(&self) -> &Recording {
        match &self.result {
            Ok(outcome) => &outcome.recording,
            Err(failure) => &failure.recording,
        }
    }

    /// Whether [`thin`](EndedRun::thin) has every step of the run.
    pub fn is_whole(&self) -> bool {
        self.thin().rows().len() as u64 >= self.thin().seen()
    }

    /// Every step, by repeating the run.
    ///
    /// # Errors
    /// If these are too many, with the remedy in words.
    pub fn every_step(&self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Recording, String> {
        let found = engine::every_step(self.case.instance.clone(), &self.case.experiment, watch).0;
        found.ok_or_else(|| {
            let width = self.thin().columns().len() + 1;
            let most = engine::MOST_NUMBERS / width;
            let seen = self.thin().seen();
            format!("{seen} steps of {width} columns are too many, {most} steps are possible: ask for `every=\"1 ms\"`, or `thin=True` for as many rows as a plot needs")
        })
    }

    /// Rows at equal distances in s, by repeating the run.
    ///
    /// # Errors
    /// If these are too many or the distance is unusable, in words.
    pub fn even(&self, every: f64, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Recording, String> {
        let grid = even_grid::instants(every, &self.case.experiment).map_err(|why| why.to_string())?;
        Ok(even_grid::record(self.case.instance.clone(), &self.case.experiment, &grid, watch).0)
    }

    /// Rows at these instants in s, ascending, by repeating the run.
    pub fn at(&self, instants: &[f64], watch: &mut dyn FnMut(f64) -> Continue) -> Recording {
        even_grid::record(self.case.instance.clone(), &self.case.experiment, instants, watch).0
    }

    /// The distance of rows that the experiment asks for, in s.
    pub fn every(&self) -> Option<f64> {
        self.case.experiment.every
    }

    /// Final values: path, SI, unit, and whether it is a truth value.
    pub fn finals(&self) -> Vec<(String, f64, String, bool)> {
        let Ok(outcome) = &self.result else { return Vec::new() };
        let all = outcome.finals.iter();
        all.map(|end| (end.path.clone(), end.value, end.unit.text.clone(), end.boolean)).collect()
    }

    /// The plots of the experiment as SVG, `wide` px wide; empty if it has none. `id` makes its identifiers unique on a
    /// page.
    pub fn svg(&self, wide: f64, id: &str) -> String {
        if self.case.experiment.plots.is_empty() {
            return String::new();
        }
        let verdicts = self.result.as_ref().map_or(Vec::new(), |outcome| outcome.verdicts.clone());
        let kept: [Kept; 1] = [(self.thin().clone(), verdicts)];
        let subtitle =
            format!("{}, {}", self.case.instance.description().name, results::solver(&self.case.experiment.solver));
        let cases = std::slice::from_ref(&self.case);
        let figure = figure::figure(&self.case.experiment.name, &subtitle, 0, &figure::recorded(cases, &kept));
        plot::inline(&figure, &Look::default(), wide, id)
    }
}

/// A text with the library and the files that it names.
#[derive(Clone)]
pub struct Text {
    loaded: Loaded,
    sources: NamedFiles,
}

impl Text {
    /// Loads a text. `files`: those that it names, as [`files`](Text::files) has returned them elsewhere.
    ///
    /// # Errors
    /// Mistakes of syntax and names.
    pub fn new(name: &str, text: &str, files: Vec<NamedFile>) -> Result<Text, Problems> {
        let sources = NamedFiles::new(files);
        let loaded = compile::load(name, text, &sources);
        if loaded.diagnostics.iter().any(Diagnostic::is_error) {
            return Err(Problems::of(&loaded, &loaded.diagnostics));
        }
        Ok(Text { loaded, sources })
    }

    /// The text of a file.
    ///
    /// # Errors
    /// Why it cannot be read, in words.
    pub fn read(path: &Path) -> Result<String, String> {
        project::read(path)
    }

    /// The name and the text itself.
    pub fn source(&self) -> (String, String) {
        let file = self.loaded.files.get(self.loaded.root());
        (file.name.clone(), file.text.to_string())
    }

    /// The files that it names, as far as they have been read.
    pub fn files(&self) -> Vec<NamedFile> {
        self.sources.all()
    }

    /// Names of its models.
    pub fn models(&self) -> Vec<String> {
        self.loaded.models().iter().map(|model| model.name.text.clone()).collect()
    }

    /// Names of its experiments.
    pub fn experiments(&self) -> Vec<String> {
        self.loaded.experiments().into_iter().map(|experiment| experiment.name).collect()
    }

    /// What `fric check` says: errors and warnings.
    pub fn check(&self) -> Problems {
        let mut loaded = self.loaded.clone();
        let found = compile::check(&mut loaded, &self.sources);
        Problems::of(&loaded, &found)
    }

    /// The nearest of some names, for a message.
    pub fn nearest<'a>(name: &str, all: &'a [String]) -> Option<&'a str> {
        compile::nearest(name, all.iter().map(String::as_str))
    }

    /// Compiles and runs an experiment as `fric run` does: a run for each case of its sweeps. `errors`: also estimates the
    /// numerical errors of its measures. `corners`: instants in s at which inputs have corners, beside those that the
    /// experiment knows; adaptive runs meet them. `watch` receives the fraction done from several threads, and may stop the runs.
    ///
    /// # Errors
    /// The errors of the models and of the experiment; a step or a tolerance without effect.
    pub fn run(
        &self,
        experiment: &str,
        options: &Options,
        corners: &[f64],
        errors: bool,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<Vec<EndedRun>, Problems> {
        let mut loaded = self.loaded.clone();
        let found = compile::check_declarations(&loaded, &self.sources);
        if found.iter().any(Diagnostic::is_error) {
            return Err(Problems::of(&loaded, &found));
        }
        let cases = compile::compile(&mut loaded, &self.sources, experiment, options, &mut Vec::new(), &mut |_| ());
        let mut cases = cases.map_err(|found| Problems::of(&loaded, &found))?;
        let method = cases.first().map(|case| case.experiment.solver.method);
        if let Some(why) = method.and_then(|method| without_effect(experiment, method, &options.changes)) {
            return Err(Problems { report: why, ..Problems::of(&loaded, &[]) });
        }
        for Case { experiment, .. } in &mut cases {
            experiment.corners.extend(corners.iter().filter(|t| **t > 0.0 && **t < experiment.duration));
            experiment.corners.sort_by(f64::total_cmp);
            experiment.corners.dedup();
        }
        let all = compile::runs_of(&cases);
        let begin = Instant::now();
        let mut results = runs::run(&all, watch);
        let wall = begin.elapsed().as_secs_f64();
        if errors {
            runs::judge(&all, &mut results, watch);
        }
        let (file, stages) = (self.source().0, Stages::default());
        let run = |(case, result): (Case, Result<Outcome, Failure>)| {
            let ran = Ran {
                file: &file,
                experiment: &case.experiment,
                label: &case.label,
                instance: &case.instance,
                notes: &case.notes,
                result: &result,
                wall,
                stages: &stages,
            };
            let json = ran.json().to_string();
            let failure = result.as_ref().err().map(|failure| (failure.to_string(), failure.time));
            EndedRun { json, label: case.label.clone(), failure, case, result }
        };
        Ok(cases.into_iter().zip(results).map(run).collect())
    }

    /// The plan of a sweep of an experiment, as bytes that [`Sweep`] reads, here and elsewhere. `vary`: as for `--vary`;
    /// `design`: as the file of `--design`; `runs`, `seed` and `keep` likewise.
    ///
    /// # Errors
    /// The errors of the experiment and of what varies.
    pub fn plan(
        &self,
        experiment: &str,
        vary: &[String],
        design: Option<String>,
        changes: &Changes,
        (runs, seed): (Option<u64>, Option<u64>),
        keep: Keep,
    ) -> Result<Vec<u8>, Problems> {
        let mut loaded = self.loaded.clone();
        let wrong = |report: String| Problems { report, ..Problems::of(&self.loaded, &[]) };
        let vary = vary.iter().map(|text| crate::vary::parse(text).map_err(|why| format!("vary {text}: {why}")));
        let Changes { set, method, step, tol, duration, .. } = changes.clone();
        let request = SweepRequest {
            experiment: experiment.into(),
            vary: vary.collect::<Result<_, _>>().map_err(wrong)?,
            design,
            set,
            method,
            step,
            tol,
            duration,
            runs,
            seed,
            keep,
            ..SweepRequest::default()
        };
        let (method, bytes) = sweep::planned(request, &mut loaded, &self.sources).map_err(|fault| match fault {
            SweepFault::Misused(why) | SweepFault::Failed(why) => wrong(why),
            SweepFault::Version(why) => wrong(why.to_string()),
            SweepFault::Text(_, found) => Problems::of(&loaded, &found),
        })?;
        match without_effect(experiment, method, changes) {
            Some(why) => Err(wrong(why)),
            None => Ok(bytes),
        }
    }

    /// A model on its own with its inputs open.
    ///
    /// # Errors
    /// All errors of the model, and of the changes.
    pub fn built(&self, model: &str, changes: &Changes) -> Result<Built, Problems> {
        let mut loaded = self.loaded.clone();
        let built = compile::build(&mut loaded, &self.sources, model, changes, &mut Vec::new());
        built.map_err(|found| Problems::of(&loaded, &found))
    }

    /// A model as Python source: `f(t, x, u, p) -> dx, y` for the library of a dialect.
    ///
    /// # Errors
    /// All errors of the model, and of the changes; statements that are no function of the present.
    pub fn python(&self, model: &str, changes: &Changes, dialect: Dialect) -> Result<String, Problems> {
        let mut loaded = self.loaded.clone();
        let text = compile::python(&mut loaded, &self.sources, model, changes, dialect, &mut Vec::new());
        text.map_err(|found| Problems::of(&loaded, &found))
    }

    /// The quantities of an experiment: path and SI unit.
    ///
    /// # Errors
    /// All errors of the experiment.
    pub fn units(&self, experiment: &str) -> Result<Vec<(String, String)>, Problems> {
        let mut loaded = self.loaded.clone();
        let found = compile::quantities(&mut loaded, &self.sources, experiment, &Changes::default());
        let all = found.map_err(|found| Problems::of(&loaded, &found))?;
        let si = |text: &str| unit(text).map_or(String::new(), |unit| Unit::si(unit.dimension).text);
        Ok(all.into_iter().map(|quantity| (quantity.path, si(&quantity.unit))).collect())
    }

    /// The text with further lines at the end of a model.
    pub fn extended(&self, model: &str, lines: &str) -> Option<String> {
        let all = self.loaded.models();
        let span = all.iter().find(|one| one.name.text == model)?.span.range();
        let text = self.source().1;
        let end = text[..span.end].rfind('}').filter(|end| *end > span.start)?;
        Some(format!("{}\n{lines}\n{}", &text[..end], &text[end..]))
    }

    /// The values at which a quantity of a model comes to rest while inputs are held. `inputs`: each with its values, as
    /// many as there are points. NaN where it does not rest, or the run stops. All in SI.
    ///
    /// # Errors
    /// All errors of the model and of the changes; a path that is none of it.
    pub fn steady(
        &self,
        model: &str,
        changes: &Changes,
        quantity: &str,
        inputs: &[(String, Vec<f64>)],
        watch: &dyn Fn(f64) -> Continue,
    ) -> Result<Vec<f64>, Problems> {
        let program = self.built(model, changes)?.program;
        let all = &program.description.quantities;
        let slot = |path: &str| {
            let found = all.iter().find(|known| known.path == path).map(|known| known.slot);
            let report = || format!("there is no quantity `{path}` in `{model}`");
            found.ok_or_else(|| Problems { report: report(), ..Problems::of(&self.loaded, &[]) })
        };
        let slots = inputs.iter().map(|(path, _)| slot(path)).collect::<Result<Vec<Slot>, Problems>>()?;
        let seen = slot(quantity)?;
        let code = compiler::codegen::tiering::on_demand(&program, Method::Adaptive, false);
        let instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
        let points = inputs.iter().map(|(_, values)| values.len()).max().unwrap_or(0);
        let mut rested = Vec::with_capacity(points);
        for point in 0..points {
            let mut from = instance.clone();
            for (slot, (_, values)) in slots.iter().zip(inputs) {
                from.set(*slot, values[point.min(values.len() - 1)]);
            }
            from.start(0.0);
            let found = equilibrium::settle_of(from, &[seen], REST_TOL, &mut |_| watch(point as f64 / points as f64));
            rested.push(found.map_or(f64::NAN, |at| at.get(seen)));
            if watch(point as f64 / points as f64).is_break() {
                break;
            }
        }
        Ok(rested)
    }

    /// What `fric explain` says of a model with changes: in words, and as JSON.
    ///
    /// # Errors
    /// All errors of the model and of the changes.
    pub fn explain(&self, model: &str, changes: &Changes) -> Result<(String, String), Problems> {
        let mut loaded = self.loaded.clone();
        let found = compile::explain_changed(&mut loaded, &self.sources, model, changes);
        let found = found.map_err(|found| Problems::of(&loaded, &found))?;
        let words = Terminal::text(|terminal| explain::tell(&found, &[], terminal));
        Ok((words, explain::as_json(&found, &[]).to_string()))
    }

    /// The JSON of `fric linearise` of a model, or of an experiment. `at`: values at the point as texts; `time`: the
    /// instant of an experiment in s; `rest`: where it has come to rest.
    ///
    /// # Errors
    /// All errors of the model and of the changes; that there is no such point.
    pub fn linearise(
        &self,
        name: &str,
        changes: Changes,
        ports: Ports,
        at: &[(String, String)],
        time: Option<f64>,
        rest: bool,
    ) -> Result<String, Problems> {
        let mut loaded = self.loaded.clone();
        let options = Options { changes: Changes { ports: Some(ports), ..changes }, ..Options::default() };
        let found = compile::linear(&mut loaded, &self.sources, name, &options, &mut Vec::new());
        let mut linear = found.map_err(|found| Problems::of(&loaded, &found))?;
        let object = linearise::as_json(&mut linear, &linearise::Point { at, time, rest });
        object.map(|object| object.to_string()).map_err(|report| Problems { report, ..Problems::of(&loaded, &[]) })
    }

    /// Runs a friction model through the standard battery, as `fric characterise` does. `set`: its arguments. Returns the
    /// JSON and the page.
    ///
    /// # Errors
    /// Why the model cannot be tested, in words.
    pub fn characterise(&self, model: &str, set: &[(String, String)]) -> Result<(String, String), String> {
        let mut written = Written::read(model)?;
        for (path, value) in set {
            written.set(path, value)?;
        }
        let (name, text) = self.source();
        // The battery imports the text as if both were on the disk.
        let folder = Path::new("out");
        let (battery, path) = (characterise::battery_in(folder), project::relative(Path::new(&name), folder));
        let mut files = self.files();
        files.push((battery.clone(), path, name.clone(), text));
        let sources = NamedFiles::new(files);
        let subject = characterise::fitted(written, Some(Path::new(&name)), folder, &sources)?;
        let study = study(subject, &battery, &sources, Extent::Whole)?;
        Ok((characterise::json(&study).to_string(), page::report(&study)))
    }

    /// The equations of a model in the symbols of print, a line each; empty if the text has no such model.
    pub fn equations(&self, model: &str) -> String {
        let all = self.loaded.models();
        let found = all.iter().find(|one| one.name.text == model);
        found.map_or(String::new(), |model| equations::lines(&equations::equations(model)))
    }
}

/// Relative tolerance of the search for rest.
const REST_TOL: f64 = 1e-6;

/// A curve as SVG, `wide` px wide. `x`, `y`: the names of the axes and their units. `id` makes its identifiers unique on a
/// page.
pub fn curve_svg(title: &str, (x, y): ([&str; 2], [&str; 2]), points: Vec<(f64, f64)>, wide: f64, id: &str) -> String {
    let axis = |[name, unit]: [&str; 2]| plot::Axis { name: name.into(), unit: unit.into(), ..plot::Axis::default() };
    let curve = plot::Curve { name: y[0].into(), points, ..plot::Curve::default() };
    let panel = plot::Panel { x: axis(x), y: axis(y), curves: vec![curve], legend: false, ..plot::Panel::default() };
    let figure = plot::Figure { title: title.into(), subtitle: String::new(), panels: vec![panel] };
    plot::inline(&figure, &Look::default(), wide, id)
}

/// The file of the library that declares a model: its name and its text.
pub fn library_model(name: &str) -> Option<(String, String)> {
    let is_it = |line: &str| {
        let rest = line.strip_prefix("model ").map_or("", str::trim_start);
        rest.strip_prefix(name).is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_'))
    };
    let found = project::library().iter().find(|(_, text)| text.lines().any(is_it));
    found.map(|(file, text)| (format!("{file}.fric"), text.to_string()))
}

/// Names of all models of the library.
pub fn library_models() -> Vec<String> {
    crate::repl::library_models().iter().map(|name| name.to_string()).collect()
}

/// The value in SI of a text such as `2 N`, and the SI unit.
///
/// # Errors
/// What is wrong with it, in words.
pub fn quantity(text: &str) -> Result<(f64, String), String> {
    let (value, unit) = crate::quantity::parse(text)?;
    Ok((value, Unit::si(unit.dimension).text))
}

/// A unit by its text.
///
/// # Errors
/// If there is no such unit, in words.
pub fn unit(text: &str) -> Result<Unit, String> {
    if text.is_empty() { Ok(Unit::none()) } else { Unit::parse(text) }
}
