//! Fits: their residuals at any values, and their answers.

use crate::text::{self, Text};
use crate::watched::{guarded, watched};
use crate::{arrays, raise};
use compiler::{Changes, Options};
use fric::embed::{self, Compared, FitChoices, FoundFit, Problems, Unknown};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Label, path, SI unit, start and range in SI of an unknown.
type Described = (String, Option<String>, String, f64, (f64, f64));

/// What of a text is changed for its fits: settings; recordings in place of its own, and those of them that are in memory;
/// solver, step, tolerance; threads.
#[derive(FromPyObject)]
pub struct Asked {
    set: Vec<String>,
    data: Vec<String>,
    tables: Vec<(String, String)>,
    solver: Option<String>,
    step: Option<f64>,
    tol: Option<f64>,
    threads: Option<usize>,
}

/// What is wished beside the values, as the options of `fric fit`.
#[derive(FromPyObject)]
pub struct Wished {
    starts: Option<usize>,
    seed: u64,
    level: f64,
    robust: bool,
    profile: Vec<String>,
    pieces: usize,
}

impl Asked {
    fn options(&self, py: Python) -> PyResult<Options> {
        let method = self.solver.as_deref().map(|name| text::method(py, name)).transpose()?;
        let (set, data) = (self.set.clone(), self.data.clone());
        let changes = Changes { set, data, method, step: self.step, tol: self.tol, ..Changes::default() };
        Ok(Options { changes, interpret: false })
    }
}

impl Wished {
    fn choices(self) -> FitChoices {
        let Wished { starts, seed, level, robust, profile, pieces } = self;
        let mut choices = FitChoices { profile, pieces, ..FitChoices::default() };
        (choices.settings.starts, choices.settings.seed) = (starts, seed);
        (choices.settings.level, choices.settings.robust) = (level, robust);
        choices
    }
}

/// The answers of some fits of a text, the best law first if there are several; and the reports of those without an
/// answer, unless there is only one, which raises.
#[pyfunction]
pub fn fit(
    py: Python,
    text: &Text,
    names: Vec<String>,
    asked: Asked,
    wished: Wished,
) -> PyResult<(Vec<Found>, Vec<String>)> {
    let text = text.inner();
    let (options, choices) = (asked.options(py)?, wished.choices());
    let work = |progress: &crate::watched::Progress| {
        let one = |name: &String| text.fit(name, &options, asked.tables.clone(), asked.threads, progress.stop());
        let all: Vec<Vec<embed::Fit>> = names.iter().map(one).collect::<Result<_, _>>().map_err(Fault::Problems)?;
        let mut all: Vec<embed::Fit> = all.into_iter().flatten().collect();
        embed::check_fits(&all, &choices).map_err(Fault::Misused)?;
        match (all.len(), all.pop()) {
            (1, Some(one)) => Ok((vec![one.search(&choices).map_err(Fault::Problems)?], Vec::new())),
            (_, last) => Ok(embed::ranked(all.into_iter().chain(last).collect(), &choices)),
        }
    };
    let (answers, problems) = watched(py, None, work)?.map_err(|fault| match fault {
        Fault::Problems(found) => raise::problems(py, &found),
        Fault::Misused(why) => PyValueError::new_err(why),
    })?;
    Ok((
        answers.into_iter().map(|found| Found { found }).collect(),
        problems.into_iter().map(|one| one.report).collect(),
    ))
}

enum Fault {
    Problems(Problems),
    Misused(String),
}

/// A compiled fit of one law, for residuals at any values.
#[pyclass(frozen, module = "fric._fric")]
pub struct Fit {
    fit: embed::Fit,
}

/// The only law of a fit, compiled.
#[pyfunction]
pub fn residuals(py: Python, text: &Text, name: &str, asked: Asked) -> PyResult<Fit> {
    let options = asked.options(py)?;
    let never = Arc::new(AtomicBool::new(false));
    let compiled = || text.inner().fit(name, &options, asked.tables.clone(), asked.threads, &never);
    let mut fits = guarded(py, || py.detach(compiled))?.map_err(|found| raise::problems(py, &found))?;
    if fits.len() > 1 {
        let laws: Vec<&str> = fits.iter().map(embed::Fit::law).collect();
        let laws = laws.join("; ");
        return Err(PyValueError::new_err(format!("fit `{name}` has several laws: {laws}; fix one with set=")));
    }
    Ok(Fit { fit: fits.remove(0) })
}

fn described(unknowns: Vec<Unknown>) -> Vec<Described> {
    let one = |Unknown { label, path, si, start, range }| (label, path, si, start, range);
    unknowns.into_iter().map(one).collect()
}

/// Label, SI unit and times of each compared quantity.
fn labelled(py: Python, compared: Vec<Compared>) -> PyResult<Vec<(String, String, Bound<PyAny>)>> {
    let one = |Compared { label, si, times }| Ok((label, si, arrays::fixed(py, times)?.into_any()));
    compared.into_iter().map(one).collect()
}

fn columns(py: Python, columns: Vec<Vec<f64>>) -> PyResult<Vec<Bound<PyAny>>> {
    columns.into_iter().map(|column| Ok(arrays::fixed(py, column)?.into_any())).collect()
}

#[pymethods]
impl Fit {
    /// Label, path, SI unit, start and range of each unknown.
    #[getter]
    fn unknowns(&self) -> Vec<Described> {
        described(self.fit.unknowns())
    }

    /// Label, SI unit and times of each compared quantity.
    #[getter]
    fn compared<'py>(&self, py: Python<'py>) -> PyResult<Vec<(String, String, Bound<'py, PyAny>)>> {
        labelled(py, self.fit.compared())
    }

    /// The residuals at these values of all unknowns, in SI.
    fn residuals<'py>(&self, py: Python<'py>, values: Vec<f64>) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let unknowns = self.fit.unknowns().len();
        if values.len() != unknowns {
            return Err(PyValueError::new_err(format!(
                "{} values were given, and {unknowns} are needed",
                values.len()
            )));
        }
        let found = guarded(py, || py.detach(|| self.fit.residuals(&values)))?;
        columns(py, found.map_err(|why| raise::run_error(py, &why, f64::NAN, None))?)
    }
}

/// A fit with its answer.
#[pyclass(frozen, module = "fric._fric")]
pub struct Found {
    found: FoundFit,
}

#[pymethods]
impl Found {
    /// Label, path, SI unit, start and range of each unknown.
    #[getter]
    fn unknowns(&self) -> Vec<Described> {
        described(self.found.fit().unknowns())
    }

    /// Label, SI unit and times of each compared quantity.
    #[getter]
    fn compared<'py>(&self, py: Python<'py>) -> PyResult<Vec<(String, String, Bound<'py, PyAny>)>> {
        labelled(py, self.found.fit().compared())
    }

    /// Values in SI.
    #[getter]
    fn values(&self) -> Vec<f64> {
        self.found.values().to_vec()
    }

    /// Standard deviations and intervals in SI.
    #[getter]
    fn spreads(&self) -> Vec<(f64, (f64, f64))> {
        self.found.spreads()
    }

    /// Correlations, of shape (unknowns, unknowns).
    #[getter]
    fn correlation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let n = self.found.values().len();
        arrays::array(py, self.found.correlation().to_vec(), Some(&[n, n]))
    }

    /// Compared minus recorded, in SI.
    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyAny>>> {
        columns(py, self.found.residuals())
    }

    #[getter]
    fn steps(&self) -> Vec<f64> {
        self.found.steps()
    }

    #[getter]
    fn converged(&self) -> bool {
        self.found.converged()
    }

    #[getter]
    fn passed(&self) -> bool {
        self.found.passed()
    }

    #[getter]
    fn rank(&self) -> Option<usize> {
        self.found.rank
    }

    /// The object of `fric fit --json`.
    #[getter]
    fn json(&self, py: Python) -> PyResult<String> {
        guarded(py, || self.found.json())
    }

    /// The warnings, as the JSON of `fric check`.
    #[getter]
    fn warnings(&self) -> String {
        self.found.warnings()
    }

    /// The table of `fric fit`.
    #[getter]
    fn words(&self) -> String {
        self.found.words()
    }

    /// What the fit plots, a picture for each recording.
    fn svg(&self, py: Python, wide: f64, id: &str) -> PyResult<Vec<String>> {
        guarded(py, || self.found.svg(wide, id))
    }

    /// Writes the files of `fric fit`; returns their paths.
    fn save(&self, py: Python, folder: PathBuf, page: bool) -> PyResult<Vec<PathBuf>> {
        guarded(py, || py.detach(|| self.found.save(&folder, page)))?.map_err(PyOSError::new_err)
    }
}
