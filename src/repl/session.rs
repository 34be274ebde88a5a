//! What a session knows, and what its lines mean to the compiler.
//!
//! In: lines, files in use. Out: values, runs, curves, or a [`Fault`]. The session is a text under construction:
//! imports and items as typed, instances as parts of one model. Every question is an experiment on that text, or on a
//! file in use, with further statements; so parser, checks and code are those of files.

use crate::compile::{self, Case, Changes, Explanation, Listed, Loaded, Lookup, Options, SourceFile, Space, Varying};
use crate::{project, value};
use abi::plan::{Method, Series};
use abi::unit::{Dimension, Unit};
use abi::{Function, Instance, Slot};
use grammar::ast::{self, DeclarationKind, Item, Statement};
use grammar::diagnostic::{Diagnostic, Label};
use grammar::span::{FileId, Span};
use grammar::tokens::{TokenKind, tokens};
use runtime::engine::{self, Cause, Continue, Failure, Outcome};
use runtime::{steady, sweep};
use std::path::Path;
use std::sync::Arc;

/// Name of the session's text in reports, of its model, and of its experiment.
const TEXT: &str = "session";
const MODEL: &str = "Session";
const EXPERIMENT: &str = "session";
/// The parameter over which a curve is drawn.
const SWEPT: &str = "swept";
/// Points of a curve over a parameter or an input: odd, so that the middle is one.
const POINTS: usize = 241;
/// Most outputs that a run of instances draws by itself.
const MOST_DRAWN: usize = 6;
/// Relative tolerance with which a model is brought to rest.
const STEADY_TOL: f64 = 1e-8;

/// Why a line cannot be done.
pub enum Fault {
    /// Something is wrong with a text.
    Found(Vec<SourceFile>, Vec<Diagnostic>),
    /// In words.
    Words(String),
    /// A run that stopped before its end.
    Stopped(Box<Failure>),
}

impl From<String> for Fault {
    fn from(words: String) -> Fault {
        Fault::Words(words)
    }
}

impl From<&str> for Fault {
    fn from(words: &str) -> Fault {
        Fault::Words(words.into())
    }
}

/// A quantity, or whether something is true.
#[derive(Clone, PartialEq, Debug)]
pub struct Value {
    /// In SI; 1 and 0 for true and false.
    pub si: f64,
    /// The unit it is declared in, or that of SI.
    pub unit: Unit,
    /// Whether it is true or false.
    pub boolean: bool,
}

/// What was run: cases of the sweeps and what became of them.
pub struct Ran {
    /// Its name in headings.
    pub name: String,
    /// Compiled cases.
    pub cases: Vec<Case>,
    /// What became of each.
    pub results: Vec<Result<Outcome, Failure>>,
    /// What deserves a look.
    pub warnings: Option<Fault>,
    /// What was taken over from an earlier run.
    pub carried: Option<abi::instance::Carried>,
}

/// A curve over an input or a parameter.
pub struct Cut {
    /// What was drawn, with labels and units.
    pub series: Vec<Series>,
    /// Over what, and its unit.
    pub over: (String, Unit),
    /// For each series its points in SI.
    pub curves: Vec<Vec<(f64, f64)>>,
}

/// One quantity after a step.
pub struct Shown {
    /// Dotted path.
    pub path: String,
    /// `state`, `output`, …
    pub kind: &'static str,
    /// Before, if it was another.
    pub before: Option<Value>,
    /// Now.
    pub now: Value,
}

/// What is being run, stepped and changed.
#[derive(Clone, PartialEq, Debug)]
enum What {
    /// The instances of the session.
    Session,
    /// An experiment: the file in use it stands in, or none for the session's own items.
    Experiment(Option<usize>, String),
    /// `run Pull(k = 2 N/m) for 40 s`: the instance as typed.
    Typed(String),
}

/// What has been done to it.
#[derive(Clone, Default)]
struct Setup {
    /// `fr.Fs = 2 N`, as typed.
    set: Vec<String>,
    /// `expect …`, as typed.
    also: Vec<String>,
    /// How long it was run, in s.
    duration: Option<f64>,
    /// Where it is now.
    live: Option<Instance>,
    /// Its quantities.
    known: Arc<[Listed]>,
}

/// `f = LuGre(vd = 10 mm/s)`
#[derive(Clone)]
struct Part {
    name: String,
    /// As typed.
    instance: String,
    /// Inputs that nobody gave: they are 0.
    open: Vec<String>,
}

/// A file in use.
#[derive(Clone)]
struct Used {
    path: String,
    loaded: Loaded,
}

/// A session.
#[derive(Clone, Default)]
pub struct Session {
    /// Imports and items, as typed.
    items: Vec<String>,
    parts: Vec<Part>,
    used: Vec<Used>,
    /// The instances.
    bench: Setup,
    /// What was run last besides them, and what has been done to it.
    stage: Option<(What, Setup)>,
    /// Whether the line before spoke of the instances.
    at_bench: bool,
    ans: Option<Value>,
}

/// Texts that stand for what was typed, whatever the compiler calls them.
const TYPED: [&str; 2] = ["--set", "--also"];
/// What is typed is called in reports.
const INPUT: &str = "input";

/// A fault that speaks of the line as typed. `at`: where the line stands in the session's text.
fn found(loaded: &Loaded, diagnostics: &[Diagnostic], typed: &str, at: Option<usize>) -> Fault {
    let mut files = loaded.files.0.clone();
    for file in files.iter_mut().filter(|file| TYPED.contains(&file.name.as_str())) {
        file.name = INPUT.into();
    }
    let input = FileId(files.len() as u32);
    files.push(SourceFile { name: INPUT.into(), text: typed.into(), ast: Arc::default(), library: false });
    let moved = |label: &Label| {
        let span = label.span;
        let here = at.filter(|at| {
            span.file == loaded.root() && span.start as usize >= *at && span.end as usize <= at + typed.len()
        });
        match here {
            Some(at) => {
                let span = Span::new(input, span.start as usize - at, span.end as usize - at);
                Label { span, ..label.clone() }
            }
            None => label.clone(),
        }
    };
    let moved = diagnostics.iter().map(|diagnostic| {
        let labels = diagnostic.labels.iter().map(&moved).collect();
        Diagnostic { labels, ..diagnostic.clone() }
    });
    Fault::Found(files, moved.collect())
}

impl Session {
    /// The text so far, with further lines in its model and another experiment; and where the last item and the last
    /// part begin.
    fn text(&self, more: &str, experiment: &str) -> (String, usize, usize) {
        let mut text = String::new();
        let (mut item_at, mut part_at) = (0, 0);
        for item in &self.items {
            item_at = text.len();
            text += item;
            text.push('\n');
        }
        text += &format!("model {MODEL} {{\n");
        for part in &self.parts {
            text += &format!("  part {} = ", part.name);
            part_at = text.len();
            text += &with_inputs(&part.instance, part.open.iter().map(|name| (name.as_str(), "0")));
            text.push('\n');
        }
        text += &format!("{more}}}\n{experiment}\n");
        (text, item_at, part_at)
    }

    /// Brings in the modules of the library that define what a line names and nothing here does; gives their names.
    pub fn bring_in(&mut self, line: &str) -> Vec<String> {
        let mut brought = Vec::new();
        for token in tokens(line).into_iter().filter(|token| token.kind == TokenKind::Word) {
            let name = token.text(line);
            if !name.starts_with(|c: char| c.is_ascii_uppercase()) || self.defines(name) {
                continue;
            }
            if let Some(module) = library_module(name) {
                self.items.push(format!("import {module}"));
                brought.push(module.to_string());
            }
        }
        brought
    }

    /// Whether a model, interface or device of this name is visible.
    fn defines(&self, name: &str) -> bool {
        if self.items.is_empty() {
            return false;
        }
        let loaded = compile::load(TEXT, &self.items.join("\n"), &project::Disk);
        !matches!(loaded.find(loaded.root(), Space::Type, name), Lookup::Missing)
    }

    /// Adds an item as typed; an earlier one of that name gives way. Gives what deserves a look.
    pub fn add_item(&mut self, item: &str) -> Result<Option<Fault>, Fault> {
        let mut next = self.clone();
        let head = |text: &str| -> Vec<String> {
            let words = tokens(text).into_iter().filter(|token| !token.is_trivia());
            words.take(2).map(|token| token.text(text).to_string()).collect()
        };
        let own = head(item);
        if own.first().is_none_or(|word| word != "import") {
            next.items.retain(|other| head(other) != own);
        }
        next.items.push(item.trim_end().to_string());
        let (text, at, _) = next.text("", "");
        let mut loaded = compile::load(TEXT, &text, &project::Disk);
        let diagnostics: Vec<Diagnostic> =
            compile::check(&mut loaded, &project::Disk).into_iter().filter(|found| concerns(&loaded, found)).collect();
        if diagnostics.iter().any(Diagnostic::is_error) {
            return Err(found(&loaded, &diagnostics, item, Some(at)));
        }
        *self = next;
        let typed = |found: &Diagnostic| found.span().start as usize >= at;
        let warnings: Vec<Diagnostic> = diagnostics.into_iter().filter(typed).collect();
        Ok((!warnings.is_empty()).then(|| found(&loaded, &warnings, item, Some(at))))
    }

    /// Uses a file, or a module of the library: what it has, in words.
    pub fn add_file(&mut self, name: &str) -> Result<String, Fault> {
        let name = name.trim();
        let bare = name.trim_matches('"');
        if bare.is_empty() {
            return Err("use what? `use \"servo.fric\"`, or a module of the library: `use std.friction`".into());
        }
        let library = bare.starts_with("std.") || bare == "std";
        let import = if library { format!("import {bare}") } else { format!("import \"{bare}\"") };
        let mut next = self.clone();
        next.items.retain(|item| *item != import);
        next.items.push(import.clone());
        let (text, at, _) = next.text("", "");
        let loaded = compile::load(TEXT, &text, &project::Disk);
        if loaded.has_errors() {
            return Err(found(&loaded, &loaded.diagnostics, &import, Some(at)));
        }
        let alone = compile::load(TEXT, &import, &project::Disk);
        let mut models: Vec<&str> = alone.visible(alone.root(), Space::Type);
        if !library {
            let path = Path::new(bare);
            let text = project::read(path).map_err(|why| Fault::Words(format!("cannot read {bare}: {why}")))?;
            let loaded = compile::load(bare, &text, &project::Disk);
            next.used.retain(|used| used.path != bare);
            next.used.push(Used { path: bare.into(), loaded });
        }
        *self = next;
        models.sort_unstable();
        let mut words = if models.is_empty() { "no models".into() } else { models.join(", ") };
        if let Some(used) = self.used.last().filter(|_| !library) {
            let experiments = used.loaded.experiments().len();
            let warnings = self.lints().iter().map(|(_, found)| found.len()).sum::<usize>();
            words += &format!("; {}", counted(experiments, "experiment"));
            if warnings > 0 {
                words += &format!("   ({}: `lints` shows them)", counted(warnings, "warning"));
            }
        }
        Ok(words)
    }

    /// The warnings of each file in use.
    pub fn lints(&self) -> Vec<(Vec<SourceFile>, Vec<Diagnostic>)> {
        let of = |used: &Used| {
            let mut loaded = used.loaded.clone();
            let found = compile::check(&mut loaded, &project::Disk);
            (loaded.files.0, found)
        };
        let (text, ..) = self.text("", "");
        let own = Used { path: TEXT.into(), loaded: compile::load(TEXT, &text, &project::Disk) };
        self.used.iter().chain([&own]).map(of).filter(|(_, found)| !found.is_empty()).collect()
    }

    /// Makes an instance, or puts another in its place: states go on by name and unit. Gives a line about it.
    pub fn add_part(&mut self, name: &str, instance: &str) -> Result<String, Fault> {
        let instance =
            if instance.contains('(') { instance.trim().to_string() } else { format!("{}()", instance.trim()) };
        let mut next = self.clone();
        let (model, given) = {
            let (read, errors) = grammar::parse::parse_instance(FileId(0), &instance);
            match read {
                Some(read) if errors.is_empty() => {
                    (read.model.text, read.args.into_iter().map(|arg| arg.name.text).collect::<Vec<_>>())
                }
                _ => {
                    let mut loaded = compile::load(TEXT, "", &project::Disk);
                    loaded.files.0[0].text = instance.as_str().into();
                    return Err(found(&loaded, &errors, &instance, Some(0)));
                }
            }
        };
        let loaded = compile::load(TEXT, &self.text("", "").0, &project::Disk);
        let open = match loaded.find(loaded.root(), Space::Type, &model) {
            Lookup::Found(_, Item::Model(model)) => open_inputs(model)
                .into_iter()
                .filter(|input| !given.iter().any(|name| name == input))
                .map(str::to_string)
                .collect(),
            _ => Vec::new(),
        };
        let prefix = format!("{name}.");
        next.bench.set.retain(|set| !set.starts_with(&prefix));
        next.bench.also.retain(|_| false);
        next.parts.retain(|part| part.name != name);
        next.parts.push(Part { name: name.into(), instance: instance.clone(), open: open.clone() });
        let (text, _, at) = next.text("", &run(MODEL, 1.0));
        let typed = with_inputs(&instance, open.iter().map(|name| (name.as_str(), "0")));
        let mut loaded = compile::load(TEXT, &text, &project::Disk);
        let case = next.compiled_in(&mut loaded, EXPERIMENT, &next.bench, &[], true);
        let (case, _) = case.map_err(|mut errors| {
            // The library is as near as what is in use.
            for error in errors.iter_mut().filter(|error| error.code == "E0201") {
                if let Some(near) = compile::nearest(&model, library_models()) {
                    error.help = Some(format!("did you mean `{near}`?"));
                }
            }
            found(&loaded, &errors, &typed, Some(at))
        })?;
        drop(case);
        next.at_bench = true;
        next.bench.known = next.listed(&What::Session, &next.bench);
        *self = next;
        let known = self.bench.known.clone();
        let count = |kind: &str| known.iter().filter(|q| q.kind == kind && q.path.starts_with(&prefix)).count();
        let mut words =
            format!("{name}: {model}, {}, {}", counted(count("state"), "state"), counted(count("param"), "parameter"));
        if let Some(first) = open.first() {
            let all: Vec<String> = open.iter().map(|input| format!("{name}.{input}")).collect();
            let input = format!("{name}.{first}");
            let unit = known.iter().find(|q| q.path == input).map_or("", |q| &q.unit);
            words += &format!("; {} = 0 until you set it, as in `{} = 1 {unit}`", all.join(" = "), all[0]);
        }
        Ok(words)
    }

    /// Sets a parameter, an input or a slot of an instance or of what was run last.
    pub fn set(&mut self, path: &str, setting: &str) -> Result<(), Fault> {
        let what = self.meant(path);
        let Some(what) = what else {
            let head = path.split('.').next().unwrap_or(path);
            let names = self.parts.iter().map(|part| part.name.as_str());
            let help = match compile::nearest(head, names) {
                Some(near) => format!("did you mean `{near}`?"),
                None => {
                    format!("`{head} = Model()` makes an instance, `use \"FILE.fric\"` and `run NAME` bring a system")
                }
            };
            return Err(Fault::Words(format!("there is no `{head}` here to set; {help}")));
        };
        let mut setup = self.setup(&what).clone();
        let same = |other: &String| {
            let left: String = other.split('=').next().unwrap_or_default().split_whitespace().collect();
            left == path
        };
        setup.set.retain(|other| !same(other));
        setup.set.push(setting.to_string());
        let (mut loaded, name) = self.loaded(&what, "");
        let cases = self.compiled_in(&mut loaded, &name, &setup, &[], true);
        cases.map_err(|errors| found(&loaded, &errors, setting, None))?;
        self.at_bench = what == What::Session;
        *self.setup_mut(&what) = setup;
        if grammar::parse::parse_setting(FileId(0), setting).0.is_none() {
            // Another model in a slot has other quantities.
            self.setup_mut(&what).known = self.listed(&what, self.setup(&what));
        }
        Ok(())
    }

    /// What a line speaks of: instances if it names one, else what was run last.
    fn meant(&self, text: &str) -> Option<What> {
        let mut after_dot = false;
        let mut words = false;
        for token in tokens(text).into_iter().filter(|token| !token.is_trivia()) {
            let word = token.text(text);
            if token.kind == TokenKind::Word && !after_dot {
                words = true;
                if self.parts.iter().any(|part| part.name == word) || self.own_constant(word) {
                    return Some(What::Session);
                }
            }
            after_dot = word == ".";
        }
        match &self.stage {
            Some((what, _)) if words => Some(what.clone()),
            _ => None,
        }
    }

    /// Whether a constant of this name was typed.
    fn own_constant(&self, name: &str) -> bool {
        self.items.iter().any(|item| {
            let mut words = item.split_whitespace();
            words.next() == Some("const") && words.next() == Some(name)
        })
    }

    /// What a command without names speaks of.
    fn current(&self) -> What {
        match &self.stage {
            Some((what, _)) if !self.at_bench => what.clone(),
            _ => What::Session,
        }
    }

    fn setup(&self, what: &What) -> &Setup {
        match &self.stage {
            Some((staged, setup)) if staged == what => setup,
            _ => &self.bench,
        }
    }

    fn setup_mut(&mut self, what: &What) -> &mut Setup {
        match &mut self.stage {
            Some((staged, setup)) if staged == what => setup,
            _ => &mut self.bench,
        }
    }

    /// The text in which something stands, and the name of its experiment.
    fn loaded(&self, what: &What, more: &str) -> (Loaded, String) {
        match what {
            What::Experiment(Some(file), name) => (self.used[*file].loaded.clone(), name.clone()),
            What::Experiment(None, name) => (compile::load(TEXT, &self.text(more, "").0, &project::Disk), name.clone()),
            What::Session => {
                let text = self.text(more, &run(MODEL, 1.0)).0;
                (compile::load(TEXT, &text, &project::Disk), EXPERIMENT.into())
            }
            What::Typed(instance) => {
                let text = self.text(more, &format!("experiment {EXPERIMENT} {{\n  run {instance} for 1 s\n}}")).0;
                (compile::load(TEXT, &text, &project::Disk), EXPERIMENT.into())
            }
        }
    }

    /// Compiles an experiment with what has been done to it and further statements.
    fn compiled_in(
        &self,
        loaded: &mut Loaded,
        name: &str,
        setup: &Setup,
        also: &[String],
        interpret: bool,
    ) -> Result<(Vec<Case>, Vec<Diagnostic>), Vec<Diagnostic>> {
        let changes = Changes {
            set: setup.set.clone(),
            also: setup.also.iter().chain(also).cloned().collect(),
            duration: setup.duration,
            ..Changes::default()
        };
        let mut warnings = Vec::new();
        let options = Options { changes, interpret };
        let cases = compile::compile(loaded, &project::Disk, name, &options, &mut warnings, &mut |_| ())
            .map_err(|errors| if errors.is_empty() { loaded.diagnostics.clone() } else { errors })?;
        Ok((cases, warnings))
    }

    /// The first case of what is meant, where it is now.
    fn now(&self, what: &What, also: &[String], typed: &str) -> Result<Case, Fault> {
        let (mut loaded, name) = self.loaded(what, "");
        // One question needs no expectations, and no long run.
        let setup = Setup { also: Vec::new(), duration: Some(1.0), ..self.setup(what).clone() };
        let (cases, _) = self
            .compiled_in(&mut loaded, &name, &setup, also, true)
            .map_err(|errors| found(&loaded, &errors, typed, None))?;
        let mut case = cases.into_iter().next().expect("there is a case");
        begin(&mut case.instance, setup.live.as_ref(), 0.0);
        Ok(case)
    }

    /// The value of an expression, now.
    pub fn value(&mut self, text: &str) -> Result<Value, Fault> {
        let text = self.with_answer(text)?;
        let what = self.meant(&text).unwrap_or(What::Session);
        let case = match self.now(&what, &[format!("plot {text}")], &text) {
            Err(Fault::Found(files, errors)) if errors.iter().any(|error| error.code == "E0901") => {
                return self.measured(&what, &text).unwrap_or(Err(Fault::Found(files, unplotted(errors))));
            }
            Err(Fault::Found(files, errors)) => return Err(Fault::Found(unplot(files, &text), unplotted(errors))),
            other => other?,
        };
        let series = case.experiment.plots.last().and_then(|plot| plot.series.first());
        let series = series.ok_or_else(|| Fault::Words("that is no expression".into()))?;
        let si = case.instance.get(series.slot);
        Ok(Value { si, unit: series.unit.clone(), boolean: series.boolean })
    }

    /// A measure over the last run, such as `max(fr.F)`.
    fn measured(&mut self, what: &What, text: &str) -> Option<Result<Value, Fault>> {
        self.setup(what).duration.or_else(|| matches!(what, What::Experiment(..)).then_some(1.0))?;
        let setup = Setup { also: vec![format!("expect {text} ~= 0 +- inf")], ..self.setup(what).clone() };
        let (mut loaded, name) = self.loaded(what, "");
        let cases = self.compiled_in(&mut loaded, &name, &setup, &[], false);
        let (cases, _) = match cases {
            Ok(cases) => cases,
            Err(_) => return None,
        };
        let case = cases.into_iter().next()?;
        let outcome = engine::run(case.instance, &case.experiment, &mut |_| Continue::Continue(()));
        let outcome = match outcome {
            Ok(outcome) => outcome,
            Err(failure) => return Some(Err(Fault::Stopped(Box::new(failure)))),
        };
        let verdict = outcome.verdicts.last()?;
        if let Some(problem) = &verdict.problem {
            return Some(Err(Fault::Words(problem.clone())));
        }
        let value = match (&verdict.margin, verdict.readings.first()) {
            (Some(margin), _) => (margin.value, margin.unit.clone()),
            (None, Some(reading)) => (reading.value, reading.unit.clone()),
            (None, None) => return None,
        };
        Some(Ok(Value { si: value.0, unit: value.1, boolean: false }))
    }

    /// Keeps a value for `ans`.
    pub fn answer(&mut self, value: &Value) {
        self.ans = Some(value.clone());
    }

    /// The text with the last value in place of `ans`.
    fn with_answer(&self, text: &str) -> Result<String, Fault> {
        let mut out = String::new();
        let mut after_dot = false;
        for token in tokens(text) {
            let word = token.text(text);
            if token.kind == TokenKind::Word && word == "ans" && !after_dot {
                let value = self.ans.as_ref().ok_or("there is no `ans` yet: it is the last value shown")?;
                out += &literal(value);
            } else {
                out += word;
            }
            after_dot = word == ".";
        }
        Ok(out)
    }

    /// Every quantity of what is meant; none if it cannot be compiled as it stands.
    fn listed(&self, what: &What, setup: &Setup) -> Arc<[Listed]> {
        let (mut loaded, name) = self.loaded(what, "");
        let changes = Changes { set: setup.set.clone(), duration: Some(1.0), ..Changes::default() };
        compile::quantities(&mut loaded, &project::Disk, &name, &changes).unwrap_or_default().into()
    }

    /// Runs an experiment, an instance, `Model(…)`, or the last once more. `duration`: in s.
    pub fn run(
        &mut self,
        name: &str,
        duration: Option<f64>,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<Ran, Fault> {
        let what = match name {
            "" => self.current(),
            name if self.parts.iter().any(|part| part.name == name) => What::Session,
            name if name.contains('(') => What::Typed(name.to_string()),
            name => self.experiment(name)?,
        };
        let kept = match &self.stage {
            Some((staged, setup)) if *staged == what => setup.clone(),
            _ => Setup::default(),
        };
        let mut setup = if what == What::Session { self.bench.clone() } else { kept };
        setup.duration = duration.or(setup.duration);
        setup.live = None;
        if setup.duration.is_none() && !matches!(what, What::Experiment(..)) {
            let name = if name.is_empty() { "f" } else { name };
            return Err(Fault::Words(format!("for how long? `run {name} for 2 s`")));
        }
        self.at_bench = what == What::Session;
        if setup.known.is_empty() {
            setup.known = self.listed(&what, &setup);
        }
        // Instances have no plots of their own: their outputs are shown.
        let outputs: Vec<&str> =
            setup.known.iter().filter(|q| q.kind == "output").map(|q| q.path.as_str()).take(MOST_DRAWN).collect();
        let shows = match &what {
            What::Experiment(..) => Vec::new(),
            _ if outputs.is_empty() => Vec::new(),
            _ => vec![format!("plot {}", outputs.join(", "))],
        };
        let ran = self.ran(&what, &setup, &shows, name, None, watch)?;
        match what {
            What::Session => self.bench = setup,
            what => self.stage = Some((what, setup)),
        }
        let what = self.current();
        let live = ran.1;
        self.setup_mut(&what).live = live;
        Ok(ran.0)
    }

    /// Runs with further statements, for their plots or expectations; they are kept if `keep` says so.
    pub fn again(
        &mut self,
        statement: &str,
        keep: bool,
        watch: &(dyn Fn(f64) -> Continue + Sync),
    ) -> Result<Ran, Fault> {
        let statement = self.with_answer(statement)?;
        let what = self.meant(&statement).unwrap_or_else(|| self.current());
        let setup = self.setup(&what).clone();
        if setup.duration.is_none() && !matches!(what, What::Experiment(..)) {
            return Err("nothing has been run yet: `run NAME for 10 s` first".into());
        }
        let (ran, _) = self.ran(&what, &setup, std::slice::from_ref(&statement), "", None, watch)?;
        if keep {
            self.setup_mut(&what).also.push(statement);
        }
        Ok(ran)
    }

    /// Runs on from where an earlier run ended, after files have changed: `from` is where it was.
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

    fn ran(
        &self,
        what: &What,
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
                What::Typed(instance) if !name.is_empty() => {
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
            What::Session => self.parts.iter().map(|part| part.name.as_str()).collect::<Vec<_>>().join(", "),
            What::Experiment(_, name) => name.clone(),
            What::Typed(instance) => instance.clone(),
        };
        Ok((Ran { name, cases, results, warnings, carried }, live))
    }

    /// Where an experiment of this name stands: among the session's own, or in the file used last that has it.
    fn experiment(&self, name: &str) -> Result<What, Fault> {
        let own = compile::load(TEXT, &self.items.join("\n"), &project::Disk);
        if own.experiments().iter().any(|experiment| experiment.name == name) {
            return Ok(What::Experiment(None, name.into()));
        }
        let has = |used: &Used| used.loaded.experiments().iter().any(|experiment| experiment.name == name);
        if let Some(file) = self.used.iter().rposition(has) {
            return Ok(What::Experiment(Some(file), name.into()));
        }
        let experiments = self.experiments();
        let known = experiments.iter().map(String::as_str).chain(self.parts.iter().map(|part| part.name.as_str()));
        let help = match compile::nearest(name, known.clone()) {
            Some(near) => format!("did you mean `{near}`?"),
            None if known.clone().next().is_none() => "`use \"FILE.fric\"` brings experiments".into(),
            None => format!("there are {}", known.collect::<Vec<_>>().join(", ")),
        };
        Err(Fault::Words(format!("there is no experiment or instance `{name}`; {help}")))
    }

    /// Names of all experiments.
    pub fn experiments(&self) -> Vec<String> {
        let own = compile::load(TEXT, &self.items.join("\n"), &project::Disk);
        let of = |loaded: &Loaded| loaded.experiments().into_iter().map(|experiment| experiment.name);
        of(&own).chain(self.used.iter().flatten_experiments()).collect()
    }

    /// Names of the experiments of a file in use.
    pub fn experiments_of(&self, path: &str) -> Vec<String> {
        self.used.iter().filter(|used| used.path == path).flatten_experiments()
    }

    /// Names of instances, each with what it is.
    pub fn instances(&self) -> Vec<(String, String)> {
        self.parts.iter().map(|part| (part.name.clone(), part.instance.clone())).collect()
    }

    /// Models and interfaces that are visible.
    pub fn models(&self) -> Vec<String> {
        let own = compile::load(TEXT, &self.items.join("\n"), &project::Disk);
        own.visible(own.root(), Space::Type).into_iter().map(str::to_string).collect()
    }

    /// One fixed step of `h` seconds by hand; gives the time and every quantity.
    pub fn step(&mut self, h: f64) -> Result<(f64, Vec<Shown>), Fault> {
        let what = self.current();
        if what == What::Session && self.parts.is_empty() {
            return Err("there is nothing to step: `f = LuGre()` makes an instance".into());
        }
        let (mut loaded, name) = self.loaded(&what, "");
        let setup = Setup { also: Vec::new(), duration: Some(1e3 * h), ..self.setup(&what).clone() };
        let shown: Vec<&Listed> = setup.known.iter().filter(|q| q.kind != "param").collect();
        let paths: Vec<&str> = shown.iter().map(|q| q.path.as_str()).collect();
        let changes = Changes {
            set: setup.set.clone(),
            method: Some(Method::Expo),
            step: Some(h),
            duration: setup.duration,
            also: vec![format!("plot {}", paths.join(", "))],
            ..Changes::default()
        };
        let options = Options { changes, interpret: true };
        let mut warnings = Vec::new();
        let cases = compile::compile(&mut loaded, &project::Disk, &name, &options, &mut warnings, &mut |_| ())
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
        let one = |(listed, series): (&&Listed, &Series)| {
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

    /// Draws expressions over an input or a parameter: with the states as they are, or `steady`, each point at rest.
    pub fn cut(
        &mut self,
        shows: &str,
        path: &str,
        (from, to): (&str, &str),
        steady: bool,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Result<Cut, Fault> {
        let what = self.meant(path).unwrap_or_else(|| self.current());
        let (first, last) = (self.value(from)?, self.value(to)?);
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
            ("input", Some((part, input))) if what == What::Session && !input.contains('.') => {
                // The input is wired to a parameter of the session's own.
                let mut wired = self.clone();
                let part = wired.parts.iter_mut().find(|one| one.name == part).expect("it has this quantity");
                part.instance = rewired(&part.instance, input, SWEPT);
                part.open.retain(|open| open != input);
                let (loaded, name) = wired.loaded(&What::Session, &format!("  param {SWEPT} = {from}\n"));
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
        let unit = unit_as_typed(from).filter(|unit| unit.dimension == own.dimension);
        let over = (path.to_string(), unit.unwrap_or(own));
        let changes = Changes {
            set: setup.set.clone(),
            method: Some(Method::Adaptive),
            tol: Some(STEADY_TOL),
            duration: setup.duration,
            vary: vec![vary.clone()],
            also: vec![format!("plot {shows}")],
            ..Changes::default()
        };
        let options = Options { changes, interpret: false };
        let mut warnings = Vec::new();
        let varying = compile::varying(&mut loaded, &project::Disk, &name, &options, &mut warnings)
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
            let fitted = varying.fit(&[(slot, x)])?;
            let mut instance = fitted.instance;
            if steady {
                instance.start(0.0);
                instance = steady::settle(instance, STEADY_TOL, watch).map_err(|why| match why {
                    steady::Restless::Failed(failure) => Fault::Stopped(Box::new(failure)),
                    steady::Restless::Moves { .. } => {
                        Fault::Words(format!("at {path} = {} it {why}; leave `steady` out", value::show(x, &over.1, 3)))
                    }
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

    /// What is known of the model behind a name or a path: its explanation, and the path within it; none for the whole.
    pub fn explained(&mut self, name: &str) -> Result<(Explanation, Option<String>), Fault> {
        let head = name.split(['.', '[']).next().unwrap_or(name);
        if head.starts_with(|c: char| c.is_ascii_uppercase()) {
            let own = compile::load(TEXT, &self.text("", "").0, &project::Disk);
            let texts = [&own].into_iter().chain(self.used.iter().rev().map(|used| &used.loaded));
            for loaded in texts.clone() {
                if let Lookup::Found(item, Item::Model(_)) = loaded.find(loaded.root(), Space::Type, head) {
                    let explanation = compile::explain_in(loaded, &project::Disk, head, item.file);
                    return explanation
                        .map(|explanation| (explanation, None))
                        .map_err(|errors| found(loaded, &errors, name, None));
                }
            }
            let visible = texts.flat_map(|loaded| loaded.visible(loaded.root(), Space::Type));
            let help = match compile::nearest(head, visible) {
                Some(near) => format!("did you mean `{near}`?"),
                None => "`names` shows what there is".into(),
            };
            return Err(Fault::Words(format!("there is no model `{head}`; {help}")));
        }
        let what = self.meant(name).unwrap_or_else(|| self.current());
        let known = self.setup(&what).known.clone();
        let whole = self.parts.iter().any(|part| part.name == name);
        if !whole && !known.iter().any(|q| q.path == name) {
            let help = match compile::nearest(name, known.iter().map(|q| q.path.as_str())) {
                Some(near) => format!("did you mean `{near}`?"),
                None => "`names` shows what there is".into(),
            };
            return Err(Fault::Words(format!("there is no `{name}` here; {help}")));
        }
        let (mut loaded, experiment) = self.loaded(&what, "");
        let changes = Changes { set: self.setup(&what).set.clone(), duration: Some(1.0), ..Changes::default() };
        let mut explanation = compile::explain_run(&mut loaded, &project::Disk, &experiment, &changes)
            .map_err(|errors| found(&loaded, &errors, name, None))?;
        if whole {
            let prefix = format!("{name}.");
            explanation.model = name.to_string();
            explanation.quantities.retain(|q| q.path.starts_with(&prefix));
            explanation.equations.retain(|(left, _)| left.contains(&prefix));
            explanation.states.retain(|state| state.path.starts_with(&prefix));
            return Ok((explanation, Some(String::new())));
        }
        Ok((explanation, Some(name.to_string())))
    }

    /// The tree of a model that is visible, in the session or in a file in use.
    pub fn model(&self, name: &str) -> Option<ast::Model> {
        let name = self.parts.iter().find(|part| part.name == name).map_or(name, |part| &part.instance);
        let name = &model_of(name);
        let own = compile::load(TEXT, &self.items.join("\n"), &project::Disk);
        let texts = [&own].into_iter().chain(self.used.iter().rev().map(|used| &used.loaded));
        texts.into_iter().find_map(|loaded| match loaded.find(loaded.root(), Space::Type, name) {
            Lookup::Found(_, Item::Model(model)) => Some(model.clone()),
            _ => None,
        })
    }

    /// Imports of the session as lines, and an instance as typed: for the battery.
    pub fn origin(&self, model: &str) -> Option<String> {
        let has = |used: &&Used| used.loaded.models().iter().any(|one| one.name.text == model);
        self.used.iter().rev().find(has).map(|used| used.path.clone())
    }

    /// The session as a file: an experiment of this name that one can run and paste.
    pub fn written(&self, name: &str) -> Result<String, Fault> {
        let what = self.current();
        let setup = self.setup(&what);
        let mut text = String::new();
        let mut lines = Vec::new();
        match &what {
            What::Session => {
                if self.parts.is_empty() {
                    return Err("there is nothing to save yet: make an instance, or run an experiment".into());
                }
                text += &self.text("", "").0;
                lines.push(format!("run {MODEL}() for {}", seconds(setup.duration.unwrap_or(1.0))));
            }
            What::Typed(instance) => {
                text += &(self.items.join("\n") + "\n");
                lines.push(format!("run {instance} for {}", seconds(setup.duration.unwrap_or(1.0))));
            }
            What::Experiment(file, experiment) => {
                match file {
                    Some(file) => text += &format!("import \"{}\"\n", self.used[*file].path),
                    None => text += &(self.items.join("\n") + "\n"),
                }
                let (loaded, _) = self.loaded(&what, "");
                lines.extend(statements(&loaded, experiment, setup.duration));
            }
        }
        // One value is a sweep of one.
        lines.extend(setup.set.iter().map(|set| format!("sweep {}", set.trim())));
        lines.extend(setup.also.iter().map(|also| also.trim().to_string()));
        text += &format!("\nexperiment {name} {{\n");
        for line in lines {
            text += &format!("  {line}\n");
        }
        text += "}\n";
        let mut loaded = compile::load(name, &text, &project::Disk);
        let diagnostics = compile::check(&mut loaded, &project::Disk);
        if diagnostics.iter().any(Diagnostic::is_error) {
            return Err(Fault::Found(loaded.files.0, diagnostics));
        }
        grammar::format::format(&text, 120).map_err(|errors| found(&loaded, &errors, "", None))
    }

    /// What can stand where: quantities of the instances, then those of what was run last.
    pub fn quantities(&self) -> impl Iterator<Item = &Listed> {
        let staged = self.stage.as_ref().map_or(&[][..], |(_, setup)| &setup.known);
        self.bench.known.iter().chain(staged)
    }

    /// What kind of quantity fits in place of `?` in a line.
    pub fn wanted(&self, line: &str) -> Option<Dimension> {
        let what = self.meant(line).unwrap_or(What::Session);
        let (mut loaded, name) = self.loaded(&what, "");
        let setup = Setup { also: Vec::new(), duration: Some(1.0), ..self.setup(&what).clone() };
        let errors = self.compiled_in(&mut loaded, &name, &setup, &[format!("plot {line}")], true).err()?;
        let hole = errors.iter().find(|error| error.code == "E0112")?;
        Unit::parse(&hole.labels.first()?.text).ok().map(|unit| unit.dimension)
    }

    /// Reads the files in use again.
    pub fn reload(&mut self) -> Result<(), Fault> {
        let mut next = self.clone();
        for used in &mut next.used {
            let text = project::read(Path::new(&used.path))
                .map_err(|why| Fault::Words(format!("cannot read {}: {why}", used.path)))?;
            used.loaded = compile::load(&used.path, &text, &project::Disk);
            if used.loaded.has_errors() {
                let found = used.loaded.diagnostics.clone();
                return Err(Fault::Found(used.loaded.files.0.clone(), found));
            }
        }
        *self = next;
        Ok(())
    }

    /// The files that a file in use consists of, on disk.
    pub fn files_of(&self, path: &str) -> Vec<String> {
        let used = self.used.iter().find(|used| used.path == path);
        let files = used.map_or(Vec::new(), |used| used.loaded.files.0.clone());
        files.into_iter().filter(|file| !file.library && !file.name.starts_with("--")).map(|file| file.name).collect()
    }
}

/// For [`Session::experiments`].
trait Experiments {
    fn flatten_experiments(self) -> Vec<String>;
}

impl<'a, I: Iterator<Item = &'a Used>> Experiments for I {
    fn flatten_experiments(self) -> Vec<String> {
        self.flat_map(|used| used.loaded.experiments().into_iter().map(|experiment| experiment.name)).collect()
    }
}

/// Puts an instance where another is, or at its start, for steps of `h` seconds.
fn begin(instance: &mut Instance, live: Option<&Instance>, h: f64) {
    instance.start(h);
    if let Some(live) = live {
        instance.carry(live);
        let time = live.get(Slot::TIME);
        instance.set(Slot::TIME, time);
        instance.set(Slot::COUNT, if h > 0.0 { (time / h).round() } else { 0.0 });
        instance.call(Function::Outputs);
    }
}

/// Whether something that was found is about the session's text, not about its model that is put together here.
fn concerns(loaded: &Loaded, found: &Diagnostic) -> bool {
    let text = &loaded.files.get(loaded.root()).text;
    let own = text.find(&format!("model {MODEL} {{")).unwrap_or(text.len());
    found.is_error() || (found.span().file == loaded.root() && (found.span().start as usize) < own)
}

/// An expression was handed over as `plot EXPR`: the report shows the expression alone.
fn unplot(mut files: Vec<SourceFile>, text: &str) -> Vec<SourceFile> {
    for file in files.iter_mut().filter(|file| file.text.strip_prefix("plot ") == Some(text)) {
        file.text = text.into();
    }
    files
}

/// Places in `plot EXPR` as places in the expression.
fn unplotted(errors: Vec<Diagnostic>) -> Vec<Diagnostic> {
    let moved = |mut error: Diagnostic| {
        for label in &mut error.labels {
            label.span.start = label.span.start.saturating_sub(5);
            label.span.end = label.span.end.saturating_sub(5);
        }
        error
    };
    errors.into_iter().map(moved).collect()
}

/// `LuGre(v = 0, vd = 10 mm/s)`: an instance with further arguments.
fn with_inputs<'a>(instance: &str, more: impl Iterator<Item = (&'a str, &'a str)>) -> String {
    let more: Vec<String> = more.map(|(name, value)| format!("{name} = {value}")).collect();
    let (Some(close), false) = (instance.rfind(')'), more.is_empty()) else { return instance.to_string() };
    let before = instance[..close].trim_end();
    let comma = if before.ends_with('(') { "" } else { ", " };
    format!("{before}{comma}{}{}", more.join(", "), &instance[close..])
}

/// An instance with another value for one argument.
fn rewired(instance: &str, name: &str, value: &str) -> String {
    let (read, _) = grammar::parse::parse_instance(FileId(0), instance);
    let bound = read.and_then(|read| read.args.into_iter().find(|arg| arg.name.text == name));
    match bound {
        Some(arg) => {
            format!("{}{name} = {value}{}", &instance[..arg.span.range().start], &instance[arg.span.range().end..])
        }
        None => with_inputs(instance, std::iter::once((name, value))),
    }
}

/// An experiment that runs a model.
fn run(model: &str, duration: f64) -> String {
    format!("experiment {EXPERIMENT} {{\n  run {model}() for {duration} s\n}}")
}

/// Statements of an experiment as written, with another duration if there is one.
fn statements(loaded: &Loaded, name: &str, duration: Option<f64>) -> Vec<String> {
    let file = loaded.files.get(loaded.root());
    let found = file.ast.items.iter().find_map(|item| match item {
        Item::Experiment(experiment) if experiment.name.text == name => Some(experiment),
        _ => None,
    });
    let mut out = Vec::new();
    for statement in found.map_or(&[][..], |experiment| &experiment.body) {
        use ast::ExperimentStatement as S;
        let span = match statement {
            S::Run(run) => {
                let instance = loaded.files.slice(run.instance.span);
                let length = duration.map(seconds);
                let written = || run.duration.as_ref().map(|expr| loaded.files.slice(expr.span).to_string());
                out.push(match length.or_else(written) {
                    Some(length) => format!("run {instance} for {length}"),
                    None => format!("run {instance}"),
                });
                continue;
            }
            S::Solver(one) => one.span,
            S::Sweep(one) => one.span,
            S::Data(one) => one.span,
            S::Plot(one) => one.span,
            S::Expect(one) => one.span,
            S::Allow(one) => one.span,
        };
        out.push(loaded.files.slice(span).trim().to_string());
    }
    out
}

fn seconds(t: f64) -> String {
    format!("{t} s")
}

/// The model of an instance as written.
fn model_of(instance: &str) -> String {
    let written = instance.trim();
    let written = written.strip_prefix("rotary ").unwrap_or(written);
    written.split('(').next().unwrap_or(written).split(" for ").next().unwrap_or_default().trim().to_string()
}

/// Inputs of a model that must be given.
fn open_inputs(model: &ast::Model) -> Vec<&str> {
    let inputs = model.body.iter().filter_map(|statement| match statement {
        Statement::Declaration(d) if d.kind == DeclarationKind::Input && d.value.is_none() => {
            Some(d.name.text.as_str())
        }
        _ => None,
    });
    inputs.collect()
}

/// The module of the library that defines a model or interface: `std.friction.lugre`.
fn library_module(name: &str) -> Option<&'static str> {
    let defines = |text: &str| {
        ["model", "interface"].iter().any(|word| {
            let head = format!("{word} {name}");
            text.match_indices(&head).any(|(at, _)| {
                let begins = at == 0 || text[..at].ends_with('\n');
                begins && !text[at + head.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '_')
            })
        })
    };
    project::library().iter().find(|(_, text)| defines(text)).map(|(module, _)| *module)
}

/// Names of the models of the library.
pub fn library_models() -> Vec<&'static str> {
    let of = |text: &'static str| {
        text.lines().filter_map(|line| {
            let name = line.strip_prefix("model ")?;
            Some(&name[..name.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(name.len())])
        })
    };
    project::library().iter().flat_map(|(_, text)| of(text)).collect()
}

/// The unit behind the number that a text begins with.
fn unit_as_typed(text: &str) -> Option<Unit> {
    let text = text.trim().trim_start_matches('-').trim_start();
    value::parse(text).ok().map(|(_, unit)| unit).filter(|unit| !unit.text.is_empty())
}

/// A value as a text that reads as exactly that value.
fn literal(value: &Value) -> String {
    if value.boolean {
        return if value.si > 0.5 { "true".into() } else { "false".into() };
    }
    let unit = Unit::si(value.unit.dimension).text;
    let number = format!("{:?}", value.si.abs());
    let number = if value.si.is_infinite() { "inf".into() } else { number };
    let space = if unit.is_empty() || value.si.is_infinite() { String::new() } else { format!(" {unit}") };
    if value.si < 0.0 { format!("(-{number}{space})") } else { format!("({number}{space})") }
}

fn counted(n: usize, one: &str) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

/// A value in the unit that suits: `20 mN`, `1.5 µm`, `true`.
pub fn plain(value: &Value) -> String {
    if value.boolean {
        return if value.si > 0.5 { "true".into() } else { "false".into() };
    }
    let unit = &value.unit;
    // A unit that somebody chose stays; one of SI gets a prefix that makes the number handy.
    if unit.scale == 1.0 && !unit.text.is_empty() && value.si != 0.0 && value.si.is_finite() {
        let size = value.si.abs();
        let prefixes = [("", 1.0), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9), ("k", 1e3), ("M", 1e6), ("G", 1e9)];
        let fits = |scale: f64| (0.999_999_5 * scale..999.999_5 * scale).contains(&size);
        let chosen = prefixes.iter().filter(|(_, scale)| fits(*scale)).find_map(|(prefix, _)| {
            let prefixed = Unit::parse(&format!("{prefix}{}", unit.text)).ok()?;
            (prefixed.dimension == unit.dimension).then_some(prefixed)
        });
        if let Some(chosen) = chosen {
            return value::show(value.si, &chosen, 6);
        }
    }
    value::show(value.si, unit, 6)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quantity(si: f64, unit: &str) -> Value {
        Value { si, unit: Unit::parse(unit).unwrap(), boolean: false }
    }

    #[test]
    fn values_are_shown_in_handy_units() {
        assert_eq!(plain(&quantity(0.02, "N")), "20 mN");
        assert_eq!(plain(&quantity(1e5, "N/m")), "100 kN/m");
        assert_eq!(plain(&quantity(1.5, "N")), "1.5 N");
        assert_eq!(plain(&quantity(0.0, "N")), "0 N");
        assert_eq!(plain(&quantity(1.5e-5, "um")), "15 µm");
        assert_eq!(plain(&quantity(3.0, "1")), "3");
        assert_eq!(plain(&quantity(2.0, "kg")), "2 kg");
        assert_eq!(plain(&Value { boolean: true, ..quantity(1.0, "1") }), "true");
    }

    #[test]
    fn arguments_are_added_and_replaced() {
        assert_eq!(with_inputs("LuGre()", [("v", "0")].into_iter()), "LuGre(v = 0)");
        assert_eq!(with_inputs("LuGre(Fs = 2 N)", [("v", "0")].into_iter()), "LuGre(Fs = 2 N, v = 0)");
        assert_eq!(rewired("LuGre(v = 1 m/s, Fs = 2 N)", "v", "swept"), "LuGre(v = swept, Fs = 2 N)");
        assert_eq!(rewired("LuGre(Fs = 2 N)", "v", "swept"), "LuGre(Fs = 2 N, v = swept)");
    }

    #[test]
    fn an_answer_is_the_same_number_again() {
        for si in [0.1 + 0.2, -1e-300, 5e17, 0.0] {
            let text = literal(&quantity(si, "N"));
            let mut session = Session::default();
            let Ok(value) = session.value(&text) else { panic!("{text}") };
            assert_eq!(value.si.to_bits(), si.to_bits(), "{text}");
        }
    }

    #[test]
    fn models_of_the_library_are_found_by_name() {
        assert_eq!(library_module("LuGre"), Some("std.friction.lugre"));
        assert_eq!(library_module("Nonsense"), None);
        assert!(library_models().contains(&"Karnopp"));
    }
}
