//! A simulation that runs anew at every touch of a parameter.
//!
//! In: a text and its experiments. Out: curves of the latest run, and behind them those of the run with the text's own
//! values and of two runs that were kept. The text is compiled once; a change of a parameter goes into the compiled
//! instance. Saving the text compiles it again, and parameters that still exist keep their values.

use super::slots::{self, Slot as ModelSlot};
use super::typed;
use crate::compile::{self, Loaded, Options, Stopwatch, Tuned, Varying};
use crate::{project, report, results};
use abi::Slot;
use abi::format::{count, duration};
use grammar::diagnostic::Diagnostic;
use panel::frame::{Block, Frame, PATH};
use panel::knob::Knob;
use panel::line::View;
use panel::server::Bell;
use panel::sheet::{Sheet, Signal};
use panel::subject::{Page, Subject};
use panel::thin;
use panel::words::clean;
use runtime::engine::sweep::{self, Case};
use runtime::engine::{Cause, Continue, Failure, Outcome};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

/// A run that lasts longer is broken off for a newer value; a shorter one ends first, or a steady drag would show
/// nothing. It is also the limit above which the page waits for the release of a slider.
const SHORT: Duration = Duration::from_millis(100);
/// Runs from which the page learns how long the next one lasts: the shortest of them, since other programs and the
/// first use of code make a run longer, and never shorter.
const TIMES: usize = 4;
/// The limit for the first run alone.
const FIRST: Duration = Duration::from_secs(1);
/// Polling interval for changed files.
const LOOK: Duration = Duration::from_millis(100);
/// Runs that lie over each other: the text's own, the latest, and those kept as A and B.
const LAYERS: usize = 4;
const OWN: usize = 0;
const NOW: usize = 1;
const KEPT: [(&str, usize); 2] = [("A", 2), ("B", 3)];

/// A compiled experiment.
struct Setup {
    name: String,
    cases: Vec<Varying>,
    labels: Vec<String>,
    knobs: Vec<Knob>,
    /// For each case the slot of each knob, if it has that parameter.
    slots: Vec<Vec<Option<Slot>>>,
    sheet: Sheet,
    duration: f64,
    solver: String,
    /// Slots for models.
    models: Vec<ModelSlot>,
    /// For each slot the model in it.
    chosen: Vec<String>,
}

impl Setup {
    fn new(name: &str, cases: Vec<Varying>, models: Vec<ModelSlot>, chosen: Vec<String>) -> Setup {
        let mut knobs: Vec<Knob> = Vec::new();
        let mut swept = Vec::new();
        for case in &cases {
            for (quantity, own) in case.params() {
                match knobs.iter().find(|knob| knob.path == quantity.path) {
                    None => knobs.push(Knob::new(quantity, own)),
                    // The cases differ in it: they lie over each other because of that.
                    Some(other) if other.own != own => swept.push(quantity.path.clone()),
                    Some(_) => {}
                }
            }
        }
        knobs.retain(|knob| !swept.contains(&knob.path));
        // The cases of an experiment have the same `tune`, each for the parameters that it has.
        let mut tuned: Vec<&Tuned> = Vec::new();
        for one in cases.iter().flat_map(|case| &case.tuned) {
            if tuned.iter().all(|other| other.path != one.path) {
                tuned.push(one);
            }
        }
        if !tuned.is_empty() {
            tuned.sort_by_key(|one| one.span.start);
            let knob = |one: &&Tuned| {
                let at = knobs.iter().position(|knob| knob.path == one.path)?;
                Some(knobs[at].clone().tuned(one.range))
            };
            knobs = tuned.iter().filter_map(knob).collect();
        }
        let slot = |case: &Varying, knob: &Knob| case.params().find(|(q, _)| q.path == knob.path).map(|(q, _)| q.slot);
        let slots = cases.iter().map(|case| knobs.iter().map(|knob| slot(case, knob)).collect()).collect();
        let first = cases.first().expect("an experiment has a case");
        let (name, duration, solver) =
            (name.to_string(), first.experiment.duration, results::solver(&first.experiment.solver));
        let sheet = Sheet::of(cases.iter().map(|case| &case.plots[..]));
        Setup {
            name,
            labels: cases.iter().map(|case| case.label.clone()).collect(),
            knobs,
            slots,
            sheet,
            duration,
            solver,
            models,
            chosen,
            cases,
        }
    }

    /// Whether curves of another setup are of the same signals and cases.
    fn is_alike(&self, other: &Setup) -> bool {
        self.name == other.name && self.sheet == other.sheet && self.labels == other.labels
    }

    /// Its slots whose model is not that of the text, as `--set` takes them.
    fn changed_models(&self) -> Vec<String> {
        let both = self.models.iter().zip(&self.chosen);
        both.filter(|(slot, model)| slot.own != **model).map(|(slot, model)| slot.set(model)).collect()
    }

    /// All cases with these values.
    ///
    /// # Errors
    /// The condition that they violate.
    fn fitted(&self, values: &[f64]) -> Result<Vec<Case>, String> {
        let one = |(case, slots): (&Varying, &Vec<Option<Slot>>)| {
            let given: Vec<(Slot, f64)> =
                slots.iter().zip(values).filter_map(|(slot, v)| Some(((*slot)?, *v))).collect();
            let fitted = case.at(&given)?;
            let mut experiment = fitted.experiment;
            experiment.plots.clone_from(&case.plots);
            Ok(Case { label: case.label.clone(), instance: fitted.instance, experiment })
        };
        self.cases.iter().zip(&self.slots).map(one).collect()
    }

    fn own(&self) -> Vec<f64> {
        self.knobs.iter().map(|knob| knob.own).collect()
    }
}

/// A run of all cases.
struct FinishedRun {
    values: Vec<f64>,
    /// Which parameters these are, and the models of the slots.
    paths: Vec<String>,
    chosen: Vec<String>,
    /// For each case and signal its points (t in s, value in its unit).
    curves: Vec<Vec<Vec<(f64, f64)>>>,
    /// For the page.
    told: Value,
    /// The longest duration of a case, s.
    duration: f64,
}

impl FinishedRun {
    fn of(
        setup: &Setup,
        values: Vec<f64>,
        cases: &[Case],
        results: &[Result<Outcome, Failure>],
        took: Duration,
    ) -> FinishedRun {
        let mut verdicts: Vec<Value> = Vec::new();
        let mut failures: Vec<String> = Vec::new();
        let (mut steps, mut curves) = (0, Vec::new());
        for ((case, varying), result) in cases.iter().zip(&setup.cases).zip(results) {
            let recording = match result {
                Ok(outcome) => &outcome.recording,
                Err(failure) => &failure.recording,
            };
            let curve = |signal: &Signal| {
                let column = recording.columns().iter().position(|column| {
                    column.label == signal.label && column.unit == signal.unit && column.boolean == signal.boolean
                });
                let Some(column) = column else { return Vec::new() };
                recording.points(column).map(|(t, si)| (t, signal.unit.from_si(si))).collect()
            };
            curves.push(setup.sheet.signals.iter().map(curve).collect());
            let named = |words: String| if case.label.is_empty() { words } else { format!("{}: {words}", case.label) };
            match result {
                Err(failure) => failures.push(named(failure.to_string())),
                Ok(outcome) => {
                    steps += outcome.work.steps;
                    let (own, watched) = outcome.verdicts.split_at(varying.expects());
                    let extremes: Vec<(f64, f64)> = watched
                        .iter()
                        .map(|verdict| match verdict.readings.as_slice() {
                            [least, greatest] => (least.value, greatest.value),
                            _ => (f64::NAN, f64::NAN),
                        })
                        .collect();
                    failures.extend(varying.left(case.instance.description(), &extremes).map(named));
                    verdicts.extend(own.iter().map(|verdict| {
                        json!({
                            "case": clean(&case.label),
                            "text": clean(&verdict.text),
                            "holds": verdict.holds,
                            "shown": verdict.shown.is_some(),
                            "words": clean(&results::words(verdict, None, None)),
                        })
                    }));
                }
            }
        }
        let told = json!({
            "failures": failures.iter().map(|why| clean(why)).collect::<Vec<_>>(),
            "verdicts": verdicts,
            "words": format!("{} steps, {}", count(steps), duration(took.as_secs_f64(), 3)),
        });
        let duration = cases.iter().map(|case| case.experiment.duration).fold(0.0, f64::max);
        let paths = setup.knobs.iter().map(|knob| knob.path.clone()).collect();
        FinishedRun { values, paths, chosen: setup.chosen.clone(), curves, told, duration }
    }
}

/// A layer, and the version with which it last changed.
#[derive(Clone, Default)]
struct Layer {
    ran: Option<Arc<FinishedRun>>,
    version: u64,
}

/// An experiment with models for its slots.
struct Wanted {
    name: String,
    /// Those of the text if none.
    chosen: Option<Vec<String>>,
    /// Values of parameters by their paths; those that were changed if none.
    values: Option<Vec<(String, f64)>>,
}

struct Inner {
    setup: Arc<Setup>,
    experiments: Vec<String>,
    /// The values that are wanted.
    values: Vec<f64>,
    /// Grows with each wish for a run.
    wish: u64,
    /// What is wanted, if it must be compiled first.
    wanted: Option<Wanted>,
    layers: [Layer; LAYERS],
    /// How long the latest runs lasted.
    times: VecDeque<Duration>,
    /// Grows with each change of any layer.
    version: u64,
    hello: u64,
    state: u64,
    /// Why the text cannot be used, or why its values cannot run.
    problem: Option<String>,
}

impl Inner {
    fn place(&mut self, layer: usize, ran: Option<Arc<FinishedRun>>) {
        self.version += 1;
        self.layers[layer] = Layer { ran, version: self.version };
    }

    /// The end of the latest run as planned, s.
    fn end(&self) -> f64 {
        self.layers[NOW].ran.as_ref().map_or(self.setup.duration, |ran| ran.duration)
    }

    /// Whether a layer adds something to the picture.
    fn is_drawn(&self, layer: usize) -> bool {
        let Some(ran) = &self.layers[layer].ran else { return false };
        let now = self.layers[NOW].ran.as_ref();
        layer == NOW || now.is_some_and(|now| (&now.values, &now.chosen) != (&ran.values, &ran.chosen))
    }
}

/// A text with its experiments.
pub struct WhatIf {
    file: PathBuf,
    options: Options,
    /// The experiments to offer; all if none is named.
    named: Vec<String>,
    inner: Mutex<Inner>,
    wake: Condvar,
    bell: Bell,
}

/// Reads and compiles.
struct Text {
    loaded: Loaded,
    experiments: Vec<String>,
    stamps: Vec<Stamp>,
}

type Stamp = (String, Option<(SystemTime, u64)>);

/// Modification time and length of each file.
fn stamps(files: impl Iterator<Item = String>) -> Vec<Stamp> {
    let of = |file: String| {
        let metadata = std::fs::metadata(&file).ok();
        let stamp = metadata.and_then(|metadata| Some((metadata.modified().ok()?, metadata.len())));
        (file, stamp)
    };
    files.map(of).collect()
}

fn read(file: &Path, named: &[String], colour: bool) -> Result<Text, String> {
    let name = file.display().to_string();
    // Before it is read: what is saved meanwhile is read again.
    let before = stamps(std::iter::once(name.clone()));
    let text = project::read(file).map_err(|why| format!("cannot read {name}: {why}"))?;
    let loaded = compile::load(&name, &text, &crate::disk::Disk);
    let told = |found: &[Diagnostic]| report::full(&loaded.files.0, found, colour);
    if loaded.has_errors() {
        return Err(told(&loaded.diagnostics));
    }
    let found = compile::check_declarations(&loaded, &crate::disk::Disk);
    if found.iter().any(Diagnostic::is_error) {
        return Err(told(&found));
    }
    let all: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    if all.is_empty() {
        return Err(format!("{name} has no experiment to run"));
    }
    if let Some(one) = named.iter().find(|one| !all.contains(one)) {
        return Err(format!("{name} has no experiment `{one}`; it has {}", all.join(", ")));
    }
    let experiments = if named.is_empty() { all } else { named.to_vec() };
    let imported = loaded.files.0.iter().filter(|one| !one.library && !one.name.starts_with("--") && one.name != name);
    let mut stamps_of_all = before;
    stamps_of_all.extend(stamps(imported.map(|one| one.name.clone())));
    Ok(Text { stamps: stamps_of_all, loaded, experiments })
}

/// `chosen`: for each slot its model, as far as the text has these slots and models; those of the text if none.
fn setup(
    text: &mut Text,
    name: &str,
    options: &Options,
    chosen: Option<&[String]>,
    colour: bool,
) -> Result<Setup, String> {
    let models = slots::slots(&text.loaded, name);
    let own: Vec<String> = models.iter().map(|slot| slot.own.clone()).collect();
    let fits = |chosen: &&[String]| {
        chosen.len() == models.len() && models.iter().zip(*chosen).all(|(slot, model)| slot.fits.contains(model))
    };
    let chosen = chosen.filter(fits).map_or_else(|| own.clone(), <[String]>::to_vec);
    let mut options = options.clone();
    for ((slot, model), own) in models.iter().zip(&chosen).zip(&own) {
        if model != own {
            options.changes.set.push(slot.set(model));
        }
    }
    let cases = compile::adjustable(&mut text.loaded, &crate::disk::Disk, name, &options, &mut Vec::new());
    let cases = cases.map_err(|found| report::full(&text.loaded.files.0, &found, colour))?;
    if cases.iter().all(|case| case.plots.is_empty()) {
        return Err(format!(
            "`{name}` has no `plot`, so there is nothing to show: add what to look at, such as `plot x, v`"
        ));
    }
    Ok(Setup::new(name, cases, models, chosen))
}

impl WhatIf {
    /// Reads a text, compiles its first experiment and runs it once.
    ///
    /// # Errors
    /// Why it cannot be shown: a report, or a sentence.
    pub fn new(
        file: &Path,
        named: &[String],
        options: Options,
        bell: Bell,
        colour: bool,
    ) -> Result<Arc<WhatIf>, String> {
        let mut watch = Stopwatch::start("read");
        let mut text = read(file, named, colour)?;
        watch.stage("compile");
        let name = text.experiments[0].clone();
        let setup = Arc::new(setup(&mut text, &name, &options, None, colour)?);
        let values = setup.own();
        let cases = setup.fitted(&values)?;
        let begun = Instant::now();
        let results = sweep::run(&cases, &|_| Continue::Continue(()));
        let ran = Arc::new(FinishedRun::of(&setup, values.clone(), &cases, &results, begun.elapsed()));
        let mut inner = Inner {
            setup,
            experiments: text.experiments.clone(),
            values,
            wish: 0,
            wanted: None,
            layers: Default::default(),
            times: VecDeque::from([begun.elapsed()]),
            version: 0,
            hello: 1,
            state: 1,
            problem: None,
        };
        inner.place(OWN, Some(ran.clone()));
        inner.place(NOW, Some(ran));
        let (named, options) = (named.to_vec(), options);
        let whole = Arc::new(WhatIf {
            file: file.to_path_buf(),
            options,
            named,
            inner: Mutex::new(inner),
            wake: Condvar::new(),
            bell,
        });
        let own = whole.clone();
        std::thread::Builder::new()
            .name("what if".into())
            .spawn(move || own.work(text))
            .map_err(|why| why.to_string())?;
        Ok(whole)
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Curves of all layers that are drawn, for a report.
    pub fn curves(&self) -> Vec<(u32, Vec<(f64, f64)>)> {
        let inner = self.inner();
        let mut all = Vec::new();
        for (layer, one) in inner.layers.iter().enumerate().filter(|(layer, _)| inner.is_drawn(*layer)) {
            let curves = one.ran.iter().flat_map(|ran| &ran.curves).flatten().enumerate();
            let before = layer * inner.setup.cases.len() * inner.setup.sheet.signals.len();
            all.extend(curves.map(|(at, points)| ((before + at) as u32, points.clone())));
        }
        all
    }

    /// Runs what is wanted, and reads the text again when it is saved; never returns.
    fn work(&self, mut text: Text) {
        let mut done = 0;
        loop {
            let (wish, wanted) = {
                let mut inner = self.inner();
                if inner.wish == done && inner.wanted.is_none() {
                    inner = self.wake.wait_timeout(inner, LOOK).unwrap_or_else(PoisonError::into_inner).0;
                }
                (inner.wish, inner.wanted.take())
            };
            let now = stamps(text.stamps.iter().map(|(file, _)| file.clone()));
            if now != text.stamps {
                // Also where it fails: it is read again when it has changed again.
                text.stamps = now;
                match read(&self.file, &self.named, false) {
                    Ok(again) => {
                        text = again;
                        let before = self.inner().setup.clone();
                        let same = text.experiments.contains(&before.name);
                        let name = if same { before.name.clone() } else { text.experiments[0].clone() };
                        let chosen = (same && !before.changed_models().is_empty()).then(|| before.chosen.clone());
                        self.begin(&mut text, &Wanted { name, chosen, values: None }, true);
                    }
                    Err(why) => self.fail(why),
                }
                continue;
            }
            if let Some(wanted) = wanted {
                self.begin(&mut text, &wanted, false);
            } else if wish != done {
                done = wish;
                self.run(wish);
            }
        }
    }

    fn fail(&self, why: String) {
        let mut inner = self.inner();
        inner.problem = Some(clean(&why));
        inner.state += 1;
        drop(inner);
        self.bell.ring();
    }

    /// Another experiment, or the same one after its text has changed: parameters that it still has keep their values
    /// if someone has changed them.
    /// `anew`: runs that were kept may be of another text. With other models than those of the text, these run too, as
    /// what lies behind.
    fn begin(&self, text: &mut Text, wanted: &Wanted, anew: bool) {
        let name = wanted.name.as_str();
        let setup = match setup(text, name, &self.options, wanted.chosen.as_deref(), false) {
            Ok(setup) => Arc::new(setup),
            Err(why) => return self.fail(why),
        };
        let of_text = match setup.changed_models().is_empty() {
            true => setup.clone(),
            false => match self::setup(text, name, &self.options, None, false) {
                Ok(own) => Arc::new(own),
                Err(why) => return self.fail(why),
            },
        };
        let before = if let Some(values) = &wanted.values {
            values.clone()
        } else {
            let inner = self.inner();
            let same = inner.setup.name == name;
            let changed =
                inner.setup.knobs.iter().zip(&inner.values).filter(|(knob, value)| same && knob.own != **value);
            changed.map(|(knob, value)| (knob.path.clone(), *value)).collect::<Vec<_>>()
        };
        let own = setup.own();
        let kept = |(knob, own): (&Knob, &f64)| {
            before.iter().find(|(path, _)| *path == knob.path).map_or(*own, |(_, value)| *value)
        };
        let values: Vec<f64> = setup.knobs.iter().zip(&own).map(kept).collect();
        let (values, cases) = match setup.fitted(&values) {
            Ok(cases) => (values, cases),
            Err(_) => match setup.fitted(&own) {
                Ok(cases) => (own.clone(), cases),
                Err(why) => return self.fail(why),
            },
        };
        let run = |setup: &Setup, values: Vec<f64>, cases: &[Case]| {
            let begun = Instant::now();
            let results = sweep::run(cases, &|_| Continue::Continue(()));
            Arc::new(FinishedRun::of(setup, values, cases, &results, begun.elapsed()))
        };
        let now = run(&setup, values.clone(), &cases);
        // Curves of other signals would stand for these.
        let own = of_text.own();
        let base = match of_text.is_alike(&setup) && (values != own || !Arc::ptr_eq(&of_text, &setup)) {
            true => of_text.fitted(&own).map_or(now.clone(), |cases| run(&of_text, own, &cases)),
            false => now.clone(),
        };
        let mut inner = self.inner();
        let kept = !anew && inner.setup.is_alike(&setup);
        inner.experiments.clone_from(&text.experiments);
        inner.setup = setup;
        inner.values = values;
        inner.problem = None;
        inner.times.clear();
        inner.hello += 1;
        inner.state += 1;
        for layer in (0..LAYERS).filter(|layer| !kept || *layer == OWN || *layer == NOW) {
            inner.place(layer, None);
        }
        if kept {
            // A page forgets all curves with the numbers of their signals.
            for (_, layer) in KEPT {
                let ran = inner.layers[layer].ran.clone();
                inner.place(layer, ran);
            }
        }
        inner.place(OWN, Some(base));
        inner.place(NOW, Some(now));
        drop(inner);
        self.bell.ring();
    }

    fn run(&self, wish: u64) {
        let (setup, values) = {
            let inner = self.inner();
            // The latest run may be one that was kept.
            if inner.layers[NOW].ran.as_ref().is_some_and(|now| now.values == inner.values) && inner.problem.is_none() {
                return;
            }
            (inner.setup.clone(), inner.values.clone())
        };
        let cases = match setup.fitted(&values) {
            Ok(cases) => cases,
            Err(why) => return self.fail(why),
        };
        let begun = Instant::now();
        let watch = |_: f64| {
            let overtaken = begun.elapsed() > SHORT && {
                let inner = self.inner();
                inner.wish != wish || inner.wanted.is_some()
            };
            if overtaken { Continue::Break(()) } else { Continue::Continue(()) }
        };
        let results = sweep::run(&cases, &watch);
        let stopped = |result: &Result<Outcome, Failure>| result.as_ref().is_err_and(|it| it.cause == Cause::Stopped);
        if results.iter().any(stopped) {
            return;
        }
        let ran = Arc::new(FinishedRun::of(&setup, values, &cases, &results, begun.elapsed()));
        let mut inner = self.inner();
        if !Arc::ptr_eq(&inner.setup, &setup) {
            return;
        }
        inner.problem = None;
        if inner.times.len() == TIMES {
            inner.times.pop_front();
        }
        inner.times.push_back(begun.elapsed());
        inner.place(NOW, Some(ran));
        inner.state += 1;
        drop(inner);
        self.bell.ring();
    }
}

impl Subject for WhatIf {
    fn hello(&self) -> (u64, Value) {
        let inner = self.inner();
        let setup = &inner.setup;
        let (signals, canvases) = setup.sheet.json();
        let value = json!({
            "kind": "what if",
            "file": clean(&self.file.display().to_string()),
            "title": clean(&setup.name),
            "experiments": inner.experiments,
            "cases": setup.labels.iter().map(|label| clean(label)).collect::<Vec<_>>(),
            "signals": signals,
            "canvases": canvases,
            "phases": setup.sheet.phases_json(),
            "slots": setup.models.iter().map(ModelSlot::json).collect::<Vec<_>>(),
            "knobs": setup.knobs.iter().map(Knob::json).collect::<Vec<_>>(),
            "from": 0,
            "to": setup.duration,
            "solver": setup.solver,
        });
        (inner.hello, value)
    }

    fn state(&self) -> (u64, Value) {
        let inner = self.inner();
        let setup = &inner.setup;
        let now = inner.layers[NOW].ran.as_ref();
        let fastest = inner.times.iter().min().copied().unwrap_or_default();
        let shown = setup.knobs.iter().zip(&inner.values);
        let changed = shown.clone().filter(|(knob, value)| knob.own != **value);
        let models = setup.changed_models().into_iter().map(|set| format!("--set '{set}'"));
        let set: Vec<String> =
            models.chain(changed.map(|(knob, si)| format!("--set '{} = {}'", knob.path, knob.text(*si)))).collect();
        let value = json!({
            "values": shown.clone().map(|(knob, si)| knob.unit.from_si(*si)).collect::<Vec<_>>(),
            "texts": shown.map(|(knob, si)| knob.text(*si)).collect::<Vec<_>>(),
            "problem": inner.problem,
            "run": now.map(|ran| &ran.told),
            "short": fastest <= if inner.times.len() > 1 { SHORT } else { FIRST },
            "layers": (0..LAYERS).map(|layer| inner.is_drawn(layer)).collect::<Vec<_>>(),
            "kept": KEPT.map(|(_, layer)| inner.layers[layer].ran.is_some()),
            "to": inner.end(),
            "models": setup.chosen,
            "set": set.join(" "),
        });
        (inner.state, value)
    }

    fn numbers(&self) -> (u64, u64) {
        let inner = self.inner();
        (inner.hello, inner.state)
    }

    fn version(&self) -> u64 {
        self.inner().version
    }

    fn newest(&self) -> f64 {
        self.inner().end()
    }

    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame) {
        // The runs are shared, so that thinning needs no lock.
        let (layers, signals, cases, duration): (Vec<(usize, Arc<FinishedRun>)>, _, _, _) = {
            let inner = self.inner();
            // Also those that are not drawn now: the page keeps them until the latest run moves away from them.
            let fresh = |layer: &usize| since.is_none_or(|since| inner.layers[*layer].version > since);
            let layers = (0..LAYERS).filter(fresh).filter_map(|layer| Some((layer, inner.layers[layer].ran.clone()?)));
            let setup = &inner.setup;
            (layers.collect(), setup.sheet.signals.len(), setup.cases.len(), inner.end())
        };
        let (from, to) = view.window.within(0.0, duration);
        if view.signals.iter().any(|signal| *signal as usize >= signals) {
            return;
        }
        for (layer, ran) in layers {
            for (case, curves) in ran.curves.iter().enumerate() {
                let number = |signal: u32| ((layer * cases + case) * signals) as u32 + signal;
                let block = |curve: u32, first: f64| Block { kind: PATH, view: view.id, curve, cycles: 0, first };
                if let Some(columns) = view.columns {
                    for signal in &view.signals {
                        let points = thin::window(&curves[*signal as usize], from, to, columns as usize);
                        let first = points.first().map_or(0.0, |point| point.0);
                        frame.path(block(number(*signal), first), &points);
                    }
                } else if let [x, y] = view.signals[..] {
                    let (xs, ys) = (&curves[x as usize], &curves[y as usize]);
                    let inside = xs.iter().zip(ys).filter(|(x, _)| (from..=to).contains(&x.0));
                    let points: Vec<(f64, f64)> = inside.map(|(x, y)| (x.1, y.1)).collect();
                    let points = thin::path(&points);
                    let first = points.first().map_or(0.0, |point| point.0);
                    frame.path(block(number(y), first), &points);
                }
            }
        }
    }

    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        let (ran, case, signal) = {
            let inner = self.inner();
            let (signals, cases) = (inner.setup.sheet.signals.len(), inner.setup.cases.len());
            let (number, signal) = (curve as usize / signals.max(1), curve as usize % signals.max(1));
            let layer = inner.layers.get(number / cases);
            let Some(ran) = layer.and_then(|layer| layer.ran.clone()) else { return };
            (ran, number % cases, signal)
        };
        let Some(points) = ran.curves.get(case).and_then(|curves| curves.get(signal)) else { return };
        let begin = points.partition_point(|point| point.0 < from).saturating_sub(1);
        for (t, value) in &points[begin..] {
            if !each(*t, *value) {
                return;
            }
        }
    }

    fn say(&self, _: Page, words: &str) -> Result<String, String> {
        let (word, rest) = words.split_once(' ').map_or((words, ""), |(word, rest)| (word, rest.trim()));
        let mut inner = self.inner();
        let letter = |letter: &str| KEPT.iter().find(|(name, _)| *name == letter).map(|(_, layer)| *layer);
        match word {
            "set" => {
                let given = typed::set(rest, &inner.setup.knobs)?;
                loop {
                    let (setup, before) = (inner.setup.clone(), inner.values.clone());
                    let mut values = before.clone();
                    given.iter().for_each(|(at, value)| values[*at] = *value);
                    // Without the lock: it evaluates the conditions of the text.
                    drop(inner);
                    setup.fitted(&values)?;
                    inner = self.inner();
                    if !Arc::ptr_eq(&inner.setup, &setup) {
                        return Err("the text has changed meanwhile".into());
                    }
                    // Another viewer may have set another parameter meanwhile.
                    if inner.values.iter().zip(&before).all(|(now, then)| now.to_bits() == then.to_bits()) {
                        inner.values = values;
                        break;
                    }
                }
                inner.wish += 1;
            }
            "keep" => {
                let layer = letter(rest).ok_or("keep it as A or B")?;
                let now = inner.layers[NOW].ran.clone();
                inner.place(layer, now);
                inner.state += 1;
            }
            "go" => {
                let layer = if rest == "text" { Some(OWN) } else { letter(rest) }.ok_or("go to A, B or text")?;
                let ran = inner.layers[layer].ran.clone().ok_or_else(|| format!("nothing is kept as {rest}"))?;
                if ran.chosen != inner.setup.chosen {
                    let values = ran.paths.iter().cloned().zip(ran.values.iter().copied()).collect();
                    let name = inner.setup.name.clone();
                    inner.wanted = Some(Wanted { name, chosen: Some(ran.chosen.clone()), values: Some(values) });
                    drop(inner);
                    self.wake.notify_one();
                    return Ok(String::new());
                }
                inner.values.clone_from(&ran.values);
                inner.problem = None;
                // A run that is under way is for other values.
                inner.wish += 1;
                inner.place(NOW, Some(ran));
                inner.state += 1;
            }
            "experiment" => {
                if !inner.experiments.iter().any(|name| name == rest) {
                    return Err(format!("there is no experiment `{}`", clean(rest)));
                }
                inner.wanted = Some(Wanted { name: rest.into(), chosen: None, values: None });
            }
            "slot" => {
                let found = rest.split_once('=').and_then(|(path, model)| {
                    let at = inner.setup.models.iter().position(|slot| slot.path == path.trim())?;
                    inner.setup.models[at].fits.iter().find(|fits| *fits == model.trim()).map(|fits| (at, fits.clone()))
                });
                let (at, model) = found.ok_or_else(|| format!("no slot takes this model: `{}`", clean(rest)))?;
                let (name, mut chosen) = (inner.setup.name.clone(), inner.setup.chosen.clone());
                chosen[at] = model;
                inner.wanted = Some(Wanted { name, chosen: Some(chosen), values: None });
            }
            _ => return Err(format!("`{}` is not known here: set, keep, go, slot or experiment", clean(word))),
        }
        drop(inner);
        self.wake.notify_one();
        self.bell.ring();
        Ok(String::new())
    }
}
