//! The state of a session, and the compilation of its lines.
//!
//! In: lines, files in use. Out: values, runs, curves, or a [`Fault`]. The session is a text under construction:
//! imports and items as typed, and instances as parts of one model. Every query is an experiment on that text, or on a
//! file in use, with further statements; so parser, checks and code are the same as for files.

mod words;

mod edit;

mod ask;

mod go;

mod save;

pub use edit::library_models;
pub use go::{Cut, Ran};
pub use words::{Value, plain};

use crate::compile::{self, Case, Changes, Loaded, Options, QuantityInfo, SourceFile};
use abi::{Instance, Slot};
use grammar::diagnostic::{Diagnostic, Label};
use grammar::span::{FileId, Span};
use grammar::tokens::{TokenKind, tokens};
use runtime::engine::Failure;
use std::sync::Arc;
use words::with_inputs;

/// Name of the session's text in reports, of its model, and of its experiment.
const TEXT: &str = "session";
const MODEL: &str = "Session";
const EXPERIMENT: &str = "session";

/// Why a line failed.
pub enum Fault {
    /// Diagnostics of a text.
    Found(Vec<SourceFile>, Vec<Diagnostic>),
    /// In words.
    Words(String),
    /// A run stopped before its end.
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

/// The subject of runs, steps and changes.
#[derive(Clone, PartialEq, Debug)]
enum Subject {
    /// The instances of the session.
    Session,
    /// An experiment: the file in use that contains it, or none for the session's own items.
    Experiment(Option<usize>, String),
    /// `run Pull(k = 2 N/m) for 40 s`: the instance as typed.
    Typed(String),
}

/// Changes made to it.
#[derive(Clone, Default)]
struct Setup {
    /// `fr.Fs = 2 N`, as typed.
    set: Vec<String>,
    /// `expect …`, as typed.
    also: Vec<String>,
    /// Duration of its last run, in s.
    duration: Option<f64>,
    /// Its present state.
    live: Option<Instance>,
    /// Its quantities.
    known: Arc<[QuantityInfo]>,
}

/// `f = LuGre(vd = 10 mm/s)`
#[derive(Clone)]
struct PromptPart {
    name: String,
    /// As typed.
    instance: String,
    /// Inputs without a value: they are 0.
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
    parts: Vec<PromptPart>,
    used: Vec<Used>,
    /// The instances.
    bench: Setup,
    /// The last run other than of the instances, and its changes.
    stage: Option<(Subject, Setup)>,
    /// Whether the previous line was about the instances.
    at_bench: bool,
    ans: Option<Value>,
    /// `x = 3 mm`: the name, the value as typed, and the value.
    variables: Vec<(String, String, Value)>,
}

/// Names that the compiler uses for typed texts.
const TYPED: [&str; 2] = ["--set", "--also"];
/// Name of typed text in reports.
const INPUT: &str = "input";

/// A fault with positions in the line as typed. `at`: the offset of the line in the session's text.
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
        // The model that holds the instances is internal: hide its name.
        let message = diagnostic.message.replace(&format!(" in {MODEL}"), " here");
        Diagnostic { labels, message, ..diagnostic.clone() }
    });
    Fault::Found(files, moved.collect())
}

impl Session {
    /// The text so far, with further lines in its model and another experiment; and the offsets of the last item and
    /// the last part.
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

    /// The subject of a line: the instances if it names one, else the last run.
    fn meant(&self, text: &str) -> Option<Subject> {
        let mut after_dot = false;
        let mut words = false;
        for token in tokens(text).into_iter().filter(|token| !token.is_trivia()) {
            let word = token.text(text);
            if token.kind == TokenKind::Word && !after_dot {
                words = true;
                if self.parts.iter().any(|part| part.name == word) || self.own_constant(word) {
                    return Some(Subject::Session);
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

    /// The subject of a command without names.
    fn current(&self) -> Subject {
        match &self.stage {
            Some((what, _)) if !self.at_bench => what.clone(),
            _ => Subject::Session,
        }
    }

    fn setup(&self, what: &Subject) -> &Setup {
        match &self.stage {
            Some((staged, setup)) if staged == what => setup,
            _ => &self.bench,
        }
    }

    fn setup_mut(&mut self, what: &Subject) -> &mut Setup {
        match &mut self.stage {
            Some((staged, setup)) if staged == what => setup,
            _ => &mut self.bench,
        }
    }

    /// The text that contains the subject, and the name of its experiment.
    fn loaded(&self, what: &Subject, more: &str) -> (Loaded, String) {
        match what {
            Subject::Experiment(Some(file), name) => (self.used[*file].loaded.clone(), name.clone()),
            Subject::Experiment(None, name) => {
                (compile::load(TEXT, &self.text(more, "").0, &crate::disk::Disk), name.clone())
            }
            Subject::Session => {
                let text = self.text(more, &run(MODEL, 1.0)).0;
                (compile::load(TEXT, &text, &crate::disk::Disk), EXPERIMENT.into())
            }
            Subject::Typed(instance) => {
                let text = self.text(more, &format!("experiment {EXPERIMENT} {{\n  run {instance} for 1 s\n}}")).0;
                (compile::load(TEXT, &text, &crate::disk::Disk), EXPERIMENT.into())
            }
        }
    }

    /// Compiles an experiment with its changes and further statements. A query is interpreted, and the experiment's own
    /// expectations are omitted.
    fn compiled_in(
        &self,
        loaded: &mut Loaded,
        name: &str,
        setup: &Setup,
        also: &[String],
        question: bool,
    ) -> Result<(Vec<Case>, Vec<Diagnostic>), Vec<Diagnostic>> {
        let changes = Changes {
            set: setup.set.clone(),
            also: setup.also.iter().chain(also).cloned().collect(),
            duration: setup.duration,
            any_step: question,
            unjudged: question,
            ..Changes::default()
        };
        let mut warnings = Vec::new();
        let options = Options { changes, interpret: question };
        let cases = compile::compile(loaded, &crate::disk::Disk, name, &options, &mut warnings, &mut |_| ())
            .map_err(|errors| if errors.is_empty() { loaded.diagnostics.clone() } else { errors })?;
        Ok((cases, warnings))
    }
}

/// An experiment that runs a model.
fn run(model: &str, duration: f64) -> String {
    format!("experiment {EXPERIMENT} {{\n  run {model}() for {duration} s\n}}")
}

/// Moves an instance to the state of another, or to its start, for steps of `h` seconds.
fn begin(instance: &mut Instance, live: Option<&Instance>, h: f64) {
    instance.start(h);
    if let Some(live) = live {
        let time = live.get(Slot::TIME);
        instance.set(Slot::TIME, time);
        instance.set(Slot::COUNT, if h > 0.0 { (time / h).round() } else { 0.0 });
        instance.carry(live);
    }
}
