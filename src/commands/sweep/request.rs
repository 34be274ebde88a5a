//! What determines the rows of a sweep, and nothing else.
//!
//! In: options, or a plan that was written elsewhere. Out: the experiment compiled with its parameters variable. How many
//! threads or machines compute the rows, and where they are written, is not known here.

use super::SweepTable;
use super::best::{self, Best};
use super::version::Unusable;
use crate::args::{Keep, Sweep};
use crate::compile::{self, Changes, Loaded, Method, Options, Sources, Varying};
use crate::report;
use crate::vary::{self, How, Vary};
use grammar::diagnostic::Diagnostic;

/// A request for a table.
#[derive(Clone, Default, Debug)]
pub struct Request {
    pub experiment: String,
    pub vary: Vec<Vary>,
    /// The table of a design, as the text of its file.
    pub design: Option<String>,
    /// `fr.Fs=2 N`, as text.
    pub set: Vec<String>,
    pub method: Option<Method>,
    /// Step and duration in s, and a tolerance.
    pub step: Option<f64>,
    pub tol: Option<f64>,
    pub duration: Option<f64>,
    /// The words of `--best`: a measure that ranks rows has a column.
    pub best: Vec<String>,
    pub runs: Option<u64>,
    pub seed: Option<u64>,
    pub keep: Keep,
    /// Interprets instead of compiling: the same bits.
    pub interpret: bool,
}

/// Why there is no table.
#[derive(Debug)]
pub enum Fault {
    /// The request contradicts itself.
    Misused(String),
    /// Something fails that is not in the text.
    Failed(String),
    /// A plan of another version.
    Version(Unusable),
    /// Errors in the text: the report, and the diagnostics.
    Text(String, Vec<Diagnostic>),
}

impl Fault {
    /// In words.
    pub fn words(&self) -> String {
        match self {
            Fault::Misused(why) | Fault::Failed(why) | Fault::Text(why, _) => why.clone(),
            Fault::Version(why) => format!("the plan {why}"),
        }
    }
}

impl Request {
    /// The request of the command line for an experiment.
    pub fn of(args: &Sweep, experiment: &str) -> Request {
        let Changes { set, method, step, tol, duration, .. } = args.changed.changes();
        Request {
            experiment: experiment.into(),
            vary: args.vary.clone(),
            design: None,
            set,
            method,
            step,
            tol,
            duration,
            best: args.best.clone(),
            runs: args.runs,
            seed: args.seed,
            keep: args.keep.unwrap_or_default(),
            interpret: args.interpret,
        }
    }

    fn changes(&self) -> Changes {
        let Request { set, method, step, tol, duration, .. } = self;
        Changes { set: set.clone(), method: *method, step: *step, tol: *tol, duration: *duration, ..Changes::default() }
    }
}

/// Compiles a sweep and makes its columns. `colour`: of the report on errors.
///
/// # Errors
/// Why it cannot be run.
pub fn table(request: Request, loaded: &mut Loaded, sources: &dyn Sources, colour: bool) -> Result<SweepTable, Fault> {
    let design = request.design.as_deref().map(vary::design).transpose();
    let design = design.map_err(|why| Fault::Failed(format!("the design: {why}")))?.unwrap_or_default();
    let all: Vec<&Vary> = design.iter().chain(&request.vary).collect();
    for (k, vary) in all.iter().enumerate() {
        let before = || all[..k].iter().flat_map(|vary| vary.paths());
        if let Some(twice) = vary.paths().find(|path| before().any(|other| other == *path)) {
            return Err(Fault::Misused(format!(
                "`{twice}` is varied twice; give it one --vary, or one column of the design"
            )));
        }
        let set = |wanted: &&str| {
            request.set.iter().any(|text| text.split_once('=').is_some_and(|(path, _)| path.trim() == *wanted))
        };
        if let Some(path) = vary.paths().find(set) {
            return Err(Fault::Misused(format!("`{path}` is both set and varied; leave out one of the two")));
        }
    }
    let (models, grids): (Vec<Vary>, Vec<Vary>) =
        request.vary.iter().cloned().partition(|vary| matches!(vary.how, How::Models(_)));
    let numbers = [design, grids].concat();
    let best = best::read(&request.best).map_err(Fault::Misused)?;
    let cases = compiled(&request, &models, &numbers, best.as_ref(), loaded, sources);
    let cases = cases.map_err(|found| Fault::Text(report::full(&loaded.files.0, &found, colour), found))?;
    if request.vary.is_empty() && numbers.is_empty() && cases.len() == 1 {
        return Err(Fault::Misused(format!(
            "nothing varies: add --vary 'PATH = 1 N .. 2 N by 0.1 N', or a `sweep` to `{}`",
            request.experiment
        )));
    }
    SweepTable::new(request, numbers, cases, best).map_err(Fault::Misused)
}

/// The experiment with its parameters variable; a parameter that is computed from others, or has no value, is assigned
/// one first.
fn compiled(
    request: &Request,
    models: &[Vary],
    numbers: &[Vary],
    best: Option<&Best>,
    loaded: &mut Loaded,
    sources: &dyn Sources,
) -> Result<Vec<Varying>, Vec<Diagnostic>> {
    // What rows are ranked by need not occur in the experiment.
    let ranked = best.and_then(|best| best.measure.as_ref()).map(|measure| format!("show {measure}"));
    // Models of a slot are compiled one by one, as those of a `sweep`.
    let swept = models.iter().filter_map(|vary| match &vary.how {
        How::Models(models) => Some(format!("sweep {} = {models}", vary.path)),
        _ => None,
    });
    let also = ranked.into_iter().chain(swept);
    let mut options = Options {
        changes: Changes {
            vary: numbers.iter().flat_map(Vary::paths).map(str::to_string).collect(),
            also: also.collect(),
            ..request.changes()
        },
        interpret: request.interpret,
    };
    let name = &request.experiment;
    let first = compile::varying(loaded, sources, name, &options, &mut Vec::new());
    let open = |(_, path): &(&Vary, &str)| match &first {
        Ok(cases) => cases.iter().any(|case| case.param(path).is_none()),
        Err(_) => true,
    };
    let all = numbers.iter().flat_map(|vary| vary.paths().map(move |path| (vary, path)));
    let missing: Vec<(&Vary, &str)> =
        all.filter(|(vary, _)| !matches!(vary.how, How::Around(..))).filter(open).collect();
    if missing.is_empty()
        && let Ok(cases) = first
    {
        return Ok(cases);
    }
    let shown = |(vary, path): (&Vary, &str)| {
        let unit = Some(vary.unit.to_string()).filter(|unit| unit != "1").unwrap_or_default();
        format!("{path}={} {unit}", vary.unit.from_si(vary.typical()))
    };
    options.changes.set.extend(missing.into_iter().map(shown));
    compile::varying(loaded, sources, name, &options, &mut Vec::new())
}
