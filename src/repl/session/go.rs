//! Execution: experiments and instances, single steps, curves over an input or a parameter.
//!
//! In: what to run, the duration, and a callback. Out: cases with their results, values after a step, curves. A step
//! continues from the end of the last run.

use super::words::{Value, rewired, unit_as_typed};
use super::{Fault, Session, Setup, Subject, begin, found};
use crate::compile::{self, Case, Changes, Options, QuantityInfo, Varying};
use crate::quantity;
use abi::plan::{Method, Series};
use abi::unit::Unit;
use abi::{Function, Instance, Slot};
use runtime::engine::{self, Cause, Continue, Failure, Outcome};
use runtime::engine::{equilibrium, sweep};

/// The parameter along the horizontal axis of a curve.
const SWEPT: &str = "swept";
/// Points of a curve over a parameter or an input: odd, so that the middle is one.
const POINTS: usize = 241;
/// Most outputs plotted by default for a run of instances.
const MOST_DRAWN: usize = 6;
/// Relative tolerance of the search for equilibrium.
const STEADY_TOL: f64 = 1e-8;

/// A run: the cases of its sweeps and their results.
pub struct Ran {
    /// Its name in headings.
    pub name: String,
    /// Compiled cases.
    pub cases: Vec<Case>,
    /// The result of each.
    pub results: Vec<Result<Outcome, Failure>>,
    /// Warnings.
    pub warnings: Option<Fault>,
    /// What was carried over from an earlier run.
    pub carried: Option<abi::instance::Carried>,
}

/// A curve over an input or a parameter.
pub struct Cut {
    /// The plotted series, with labels and units.
    pub series: Vec<Series>,
    /// The horizontal quantity and its unit.
    pub over: (String, Unit),
    /// For each series its points in SI.
    pub curves: Vec<Vec<(f64, f64)>>,
}

/// A quantity after a step.
pub struct Shown {
    /// Dotted path.
    pub path: String,
    /// `state`, `output`, …
    pub kind: &'static str,
    /// The value before, if it was different.
    pub before: Option<Value>,
    /// Now.
    pub now: Value,
}

impl Session {
    /// Runs an experiment, an instance, `Model(…)`, or repeats the last run. `duration`: in s.
    pub fn run(
        &mut self,
        name: &str,
        duration: Option<f64>,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<Ran, Fault> {
        let what = match name {
            "" => self.current(),
            name if self.parts.iter().any(|part| part.name == name) => Subject::Session,
            name if name.contains('(') => Subject::Typed(name.to_string()),
            name => self.experiment(name)?,
        };
        let kept = match &self.stage {
            Some((staged, setup)) if *staged == what => setup.clone(),
            _ => Setup::default(),
        };
        let mut setup = if what == Subject::Session { self.bench.clone() } else { kept };
        setup.duration = duration.or(setup.duration);
        setup.live = None;
        if setup.duration.is_none() && !matches!(what, Subject::Experiment(..)) {
            let name = if name.is_empty() { "f" } else { name };
            return Err(Fault::Words(format!("for how long? `run {name} for 2 s`")));
        }
        self.at_bench = what == Subject::Session;
        if setup.known.is_empty() {
            setup.known = self.listed(&what, &setup);
        }
        // Instances have no plots of their own: plot their outputs.
        let outputs: Vec<&str> =
            setup.known.iter().filter(|q| q.kind == "output").map(|q| q.path.as_str()).take(MOST_DRAWN).collect();
        let shows = match &what {
            Subject::Experiment(..) => Vec::new(),
            _ if outputs.is_empty() => Vec::new(),
            _ => vec![format!("plot {}", outputs.join(", "))],
        };
        let ran = self.ran(&what, &setup, &shows, name, None, watch)?;
        match what {
            Subject::Session => self.bench = setup,
            what => self.stage = Some((what, setup)),
        }
        let what = self.current();
        let live = ran.1;
        self.setup_mut(&what).live = live;
        Ok(ran.0)
    }

    /// Repeats the run with further statements, for their plots or expectations; `keep`: they stay.
    pub fn again(
        &mut self,
        statement: &str,
        keep: bool,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<Ran, Fault> {
        let statement = self.with_values(statement)?;
        let what = self.meant(&statement).unwrap_or_else(|| self.current());
        let setup = self.setup(&what).clone();
        if setup.duration.is_none() && !matches!(what, Subject::Experiment(..)) {
            return Err("nothing has been run yet: `run NAME for 10 s` first".into());
        }
        let (ran, _) = self.ran(&what, &setup, std::slice::from_ref(&statement), "", None, watch)?;
        if keep {
            self.setup_mut(&what).also.push(statement);
        }
        Ok(ran)
    }

    /// Continues after files have changed, from the state `from` where an earlier run ended.
    pub fn run_on(
        &mut self,
        name: &str,
        from: Option<&Instance>,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<(Ran, Option<Instance>), Fault> {
        let what = self.experiment(name)?;
        let setup = match &self.stage {
            Some((staged, setup)) if *staged == what => setup.clone(),
            _ => Setup::default(),
        };
        let (ran, live) = self.ran(&what, &setup, &[], name, from, watch)?;
        self.at_bench = false;
        let known = self.listed(&what, &setup);
        self.stage = Some((what, Setup { live: live.clone(), known, ..setup }));
        Ok((ran, live))
    }

    pub(super) fn ran(
        &self,
        what: &Subject,
        setup: &Setup,
        also: &[String],
        name: &str,
        from: Option<&Instance>,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<(Ran, Option<Instance>), Fault> {
        let (mut loaded, experiment) = self.loaded(what, "");
        let typed = also.first().map_or(name, String::as_str);
        let (cases, warnings) =
            self.compiled_in(&mut loaded, &experiment, setup, also, false).map_err(|errors| match what {
                Subject::Typed(instance) if !name.is_empty() => {
                    let at = loaded.files.get(loaded.root()).text.find(&format!("  run {instance}")).map(|at| at + 6);
                    found(&loaded, &errors, instance, at)
                }
                _ => found(&loaded, &errors, typed, None),
            })?;
        let mut carried = None;
        let (results, live) = match cases.as_slice() {
            [case] => {
                let mut begin = |instance: &mut Instance| carried = from.map(|from| instance.carry(from));
                let instance = case.instance.clone();
                let (live, result) = engine::run_on(instance, &case.experiment, &mut begin, &mut |done| watch(done));
                (vec![result], Some(live))
            }
            cases => {
                let all: Vec<sweep::Case> = cases
                    .iter()
                    .map(|case| sweep::Case {
                        label: case.label.clone(),
                        instance: case.instance.clone(),
                        experiment: case.experiment.clone(),
                    })
                    .collect();
                (sweep::run(&all, watch), None)
            }
        };
        let warnings = (!warnings.is_empty()).then(|| found(&loaded, &warnings, typed, None));
        let name = match what {
            Subject::Session => self.parts.iter().map(|part| part.name.as_str()).collect::<Vec<_>>().join(", "),
            Subject::Experiment(_, name) => name.clone(),
            Subject::Typed(instance) => instance.clone(),
        };
        Ok((Ran { name, cases, results, warnings, carried }, live))
    }

    /// One fixed step of `h` seconds; returns the time and every quantity.
    pub fn step(&mut self, h: f64) -> Result<(f64, Vec<Shown>), Fault> {
        let what = self.current();
        if what == Subject::Session && self.parts.is_empty() {
            return Err("there is nothing to step: `f = LuGre()` makes an instance".into());
        }
        let (mut loaded, name) = self.loaded(&what, "");
        let setup = Setup { also: Vec::new(), duration: Some(1e3 * h), ..self.setup(&what).clone() };
        let shown: Vec<&QuantityInfo> = setup.known.iter().filter(|q| q.kind != "param").collect();
        let paths: Vec<&str> = shown.iter().map(|q| q.path.as_str()).collect();
        let changes = Changes {
            set: setup.set.clone(),
            method: Some(Method::Expo),
            step: Some(h),
            duration: setup.duration,
            also: vec![format!("plot {}", paths.join(", "))],
            any_step: true,
            unjudged: true,
            ..Changes::default()
        };
        let options = Options { changes, interpret: true };
        let mut warnings = Vec::new();
        let cases = compile::compile(&mut loaded, &crate::disk::Disk, &name, &options, &mut warnings, &mut |_| ())
            .map_err(|errors| found(&loaded, &errors, "", None))?;
        let case = cases.into_iter().next().expect("there is a case");
        let mut instance = case.instance;
        begin(&mut instance, setup.live.as_ref(), h);
        let before = instance.clone();
        let status = instance.advance(1);
        if status != 0 {
            let guard = &instance.description().guards[status as usize - 1];
            let cause = Cause::Guard { guard: Box::new(guard.clone()), value: instance.get(guard.slot) };
            let time = instance.get(Slot::TIME);
            return Err(Fault::Stopped(Box::new(Failure { cause, time, recording: Default::default() })));
        }
        let series = case.experiment.plots.last().map_or(&[][..], |plot| &plot.series[..]);
        let one = |(listed, series): (&&QuantityInfo, &Series)| {
            let of = |instance: &Instance| Value {
                si: instance.get(series.slot),
                unit: series.unit.clone(),
                boolean: series.boolean,
            };
            let (was, now) = (of(&before), of(&instance));
            let before = (was.si.to_bits() != now.si.to_bits()).then_some(was);
            Shown { path: listed.path.clone(), kind: listed.kind, before, now }
        };
        let all = shown.iter().zip(series).map(one).collect();
        let time = instance.get(Slot::TIME);
        self.setup_mut(&what).live = Some(instance);
        Ok((time, all))
    }

    /// Plots expressions over an input or a parameter: with the present states, or, if `steady`, at equilibrium for
    /// each point.
    pub fn cut(
        &mut self,
        shows: &str,
        path: &str,
        (from, to): (&str, &str),
        steady: bool,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Result<Cut, Fault> {
        let shows = &self.with_values(shows)?;
        let what = self.meant(path).unwrap_or_else(|| self.current());
        let (mut first, mut last) = (self.value(from)?, self.value(to)?);
        // 0 fits every unit.
        if first.si == 0.0 && first.unit.dimension.is_none() {
            first.unit = last.unit.clone();
        } else if last.si == 0.0 && last.unit.dimension.is_none() {
            last.unit = first.unit.clone();
        }
        if first.unit.dimension != last.unit.dimension {
            let (a, b) = (first.unit.dimension.describe(), last.unit.dimension.describe());
            return Err(Fault::Words(format!("from {a} to {b}: both ends are of one kind")));
        }
        let known = self.setup(&what).known.clone();
        let Some(over) = known.iter().find(|q| q.path == path) else {
            let movable = known.iter().filter(|q| matches!(q.kind, "param" | "input"));
            let help = match compile::nearest(path, movable.map(|q| q.path.as_str())) {
                Some(near) => format!("; did you mean `{near}`?"),
                None => String::new(),
            };
            return Err(Fault::Words(format!("there is no `{path}` here{help}")));
        };
        let own = Unit::parse(if over.unit.is_empty() { "1" } else { &over.unit }).unwrap_or_default();
        if own.dimension != first.unit.dimension && (first.si, last.si) != (0.0, 0.0) {
            let (is, given) = (own.dimension.describe(), first.unit.dimension.describe());
            return Err(Fault::Words(format!("`{path}` is {is}, in {own}, and {from} is {given}")));
        }
        let setup = Setup { also: Vec::new(), duration: Some(1.0), ..self.setup(&what).clone() };
        let (mut loaded, name, vary, setup) = match (over.kind, path.split_once('.')) {
            ("param", _) => {
                let (loaded, name) = self.loaded(&what, "");
                (loaded, name, path.to_string(), setup)
            }
            ("input", Some((part, input))) if what == Subject::Session && !input.contains('.') => {
                // The input is connected to a parameter of the session itself.
                let mut wired = self.clone();
                let part = wired.parts.iter_mut().find(|one| one.name == part).expect("it has this quantity");
                part.instance = rewired(&part.instance, input, SWEPT);
                part.open.retain(|open| open != input);
                let (loaded, name) = wired.loaded(&Subject::Session, &format!("  param {SWEPT} = {from}\n"));
                let same = |set: &String| set.split('=').next().unwrap_or_default().trim() == path;
                let set = setup.set.iter().filter(|set| !same(set)).cloned().collect();
                (loaded, name, SWEPT.to_string(), Setup { set, ..setup })
            }
            _ => {
                return Err(Fault::Words(format!(
                    "`{path}` is computed: a curve goes over an input of an instance, or a parameter"
                )));
            }
        };
        let typed = unit_as_typed(from).or(unit_as_typed(to));
        let unit = typed.filter(|unit| unit.dimension == own.dimension);
        let over = (path.to_string(), unit.unwrap_or(own));
        let changes = Changes {
            set: setup.set.clone(),
            method: Some(Method::Adaptive),
            tol: Some(STEADY_TOL),
            duration: setup.duration,
            vary: vec![vary.clone()],
            also: vec![format!("plot {shows}")],
            unjudged: true,
            ..Changes::default()
        };
        let options = Options { changes, interpret: false };
        let mut warnings = Vec::new();
        let varying = compile::varying(&mut loaded, &crate::disk::Disk, &name, &options, &mut warnings)
            .map_err(|errors| found(&loaded, &errors, shows, None))?;
        let varying: Varying = varying.into_iter().next().expect("there is a case");
        let series = varying.plots.last().map_or(Vec::new(), |plot| plot.series.clone());
        let Some(slot) = varying.param(&vary).map(|param| param.slot) else {
            return Err(Fault::Words(format!("`{path}` cannot be changed without compiling anew")));
        };
        let mut curves = vec![Vec::with_capacity(POINTS); series.len()];
        for k in 0..POINTS {
            let part = k as f64 / (POINTS - 1) as f64;
            let x =
                if 2 * k + 1 == POINTS { 0.5 * (first.si + last.si) } else { first.si + (last.si - first.si) * part };
            let fitted = varying.at(&[(slot, x)])?;
            let mut instance = fitted.instance;
            if steady {
                instance.start(0.0);
                let shown: Vec<Slot> = series.iter().map(|series| series.slot).collect();
                instance = equilibrium::settle_of(instance, &shown, STEADY_TOL, watch).map_err(|why| match why {
                    equilibrium::Restless::Failed(failure) => Fault::Stopped(Box::new(failure)),
                    equilibrium::Restless::Moves { .. } => Fault::Words(format!(
                        "at {path} = {} it {why}; leave `steady` out",
                        quantity::show(x, &over.1, 3)
                    )),
                })?;
                instance.call(Function::Outputs);
            } else {
                begin(&mut instance, setup.live.as_ref(), 0.0);
            }
            for (curve, series) in curves.iter_mut().zip(&series) {
                curve.push((x, instance.get(series.slot)));
            }
            if watch(part).is_break() {
                return Err("stopped".into());
            }
        }
        Ok(Cut { series, over, curves })
    }
}
