//! The text that a fit writes to go on with: its values as constants, and an experiment that compares them with the
//! recording.
//!
//! In: the fit as written, and its answer. Out: a text in canonical layout. Knows nothing of the disk.

use super::answer::Fitted;
use super::search::Runs;
use crate::compile::{self, Asks, FitUnknown, Loaded};
use crate::project;
use crate::quantity::{count, show, significant};
use abi::plan::{Method, Solver};
use grammar::ast::{self, BindValue, ExperimentStatement, FitStatement, ImportSource, Item};
use grammar::span::Span;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Width of a line.
const WIDTH: usize = 120;
/// The experiment allows this multiple of each measure that was found.
const ALLOWED: f64 = 1.05;
/// Lints of fits, which an experiment does not have.
const OF_FITS: [&str; 10] =
    ["unidentified", "at-bound", "rough", "unsettled", "model-error", "drift", "gap", "outliers", "start", "lone"];

/// Where a fit comes from, and where its text goes to.
pub struct Place<'a> {
    /// The folder that the text goes to.
    pub folder: &'a Path,
    /// The file of the fit.
    pub file: &'a Path,
    /// The recordings, each with its SHA-256 in hexadecimal digits.
    pub recordings: &'a [(PathBuf, String)],
}

/// The text.
pub fn text(loaded: &Loaded, fit: &ast::Fit, fitted: &Fitted, runs: &Runs, place: &Place) -> String {
    let slice = |span: Span| loaded.files.slice(span);
    let name = &fit.name.text;
    let file = project::relative(place.file, place.folder);
    let mut out = format!("// `fit {name}` of {file}, fric {}.\n", env!("CARGO_PKG_VERSION"));
    for ((part, (path, hash)), items) in runs.parts.iter().zip(place.recordings).zip(runs.items()) {
        let asks = &part.asks;
        let rms = asks.items.iter().zip(&fitted.answer.rms[items]);
        let rms: Vec<String> =
            rms.map(|(item, rms)| format!("rms({}) {}", item.shown(), show(*rms, &item.unit, 4))).collect();
        let rows = if asks.steady { "steady points" } else { "rows" };
        let data = project::relative(path, place.folder);
        let (all, rms) = (count(asks.rows.len() as u64), rms.join(", "));
        let _ = writeln!(out, "// {all} {rows} of {data}, {rms}, SHA-256 {hash}.");
    }
    let root = loaded.files.get(loaded.root());
    let mut own = false;
    for item in root.ast.items() {
        match item {
            Item::Import(import) => match &import.source {
                ImportSource::Library(_) => {
                    let _ = writeln!(out, "{}", slice(import.span));
                }
                ImportSource::File(other) => {
                    let other = place.file.parent().unwrap_or(Path::new("")).join(&other.text);
                    let _ = writeln!(out, "import \"{}\"", project::relative(&other, place.folder));
                }
            },
            Item::Fit(_) | Item::Experiment(_) => {}
            Item::Const(_)
            | Item::Function(_)
            | Item::Table(_)
            | Item::Interface(_)
            | Item::Model(_)
            | Item::Variant(_)
            | Item::Device(_)
            | Item::Rig(_) => own = true,
        }
    }
    if own {
        let _ = writeln!(out, "import \"{file}\"");
    }
    out += "\n";
    let percent = significant(100.0 * fitted.level, 4);
    for (k, unknown) in runs.unknowns.iter().enumerate() {
        let [value, sd, low, high] = fitted.shown(k, unknown);
        let doc = match low.is_empty() {
            true => "not determined".to_string(),
            false => format!("± {sd}; {low} .. {high} with {percent} %"),
        };
        let _ = writeln!(out, "const {} = {value}  /// {doc}", constant(name, unknown, runs));
    }
    for (k, (path, _)) in place.recordings.iter().enumerate() {
        match lacks_times(&runs.parts[k].asks) {
            Some(why) => {
                let _ = writeln!(out, "\n// {}: {why}", runs.parts[k].asks.label);
            }
            None => {
                let single = compile::single_fit(fit, runs.parts[k].asks.place);
                experiment(&mut out, &slice, &single, (fitted, runs, k), &project::relative(path, place.folder));
            }
        }
    }
    grammar::format::format(&out, WIDTH).unwrap_or(out)
}

/// Why no experiment can run against the recording.
fn lacks_times(asks: &Asks) -> Option<&'static str> {
    if asks.steady {
        Some("Steady points have no times, so no experiment runs against them.")
    } else if asks.begins != 0.0 {
        Some("The times of the recording do not begin at 0, so no experiment runs against it.")
    } else {
        None
    }
}

/// The name of the constant of an unknown.
fn constant(fit: &str, unknown: &FitUnknown, runs: &Runs) -> String {
    let of = unknown.of.filter(|_| runs.parts.len() > 1);
    let of = of.map_or(String::new(), |of| format!("_{}", runs.parts[of].asks.label));
    let initial = if unknown.initial { "initial_" } else { "" };
    as_name(&format!("{fit}_{initial}{}{of}", unknown.path))
}

fn as_name(text: &str) -> String {
    let name: String = text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    name.trim_end_matches('_').to_string()
}

/// A text in which the names of the fit's own unknowns are those of their constants.
fn named(text: &str, unknowns: &[(&FitUnknown, String)]) -> String {
    let mut out = String::new();
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    let mut rest = text;
    while let Some(at) = rest.find(is_part) {
        let end = rest[at..].find(|c| !is_part(c)).map_or(rest.len(), |length| at + length);
        let word = &rest[at..end];
        out += &rest[..at];
        // The name of an argument stands before its `=`, and that of a part or of a column after a dot or before one.
        let after = rest[end..].trim_start();
        let alone =
            !(out.ends_with('.') || after.starts_with('.') || after.starts_with('=') && !after.starts_with("=="));
        let own = unknowns.iter().find(|(unknown, _)| alone && unknown.own && unknown.path == word);
        out += own.map_or(word, |(_, constant)| constant);
        rest = &rest[end..];
    }
    out + rest
}

/// The experiment of one run.
fn experiment<'a>(
    out: &mut String,
    slice: &dyn Fn(Span) -> &'a str,
    fit: &ast::Fit,
    (fitted, runs, k): (&Fitted, &Runs, usize),
    data: &str,
) {
    let (asks, run) = (&runs.parts[k].asks, &fitted.runs[k]);
    // That of the fit: a run of it has the name of its case.
    let name = fitted.name();
    let is_here = |(at, _): &(usize, &FitUnknown)| asks.slots[*at].is_some();
    let unknowns: Vec<(&FitUnknown, String)> = (runs.unknowns.iter().enumerate().filter(is_here))
        .map(|(_, unknown)| (unknown, constant(name, unknown, runs)))
        .collect();
    let several = runs.parts.len() > 1;
    let called = if several { as_name(&format!("{name}_{}", asks.label)) } else { name.to_string() };
    let _ = writeln!(out, "\nexperiment {called} {{");
    let mut solver = None;
    let mut window = String::new();
    for statement in &fit.body {
        match statement {
            FitStatement::Vary(..) | FitStatement::Case(_) | FitStatement::Validate(..) => {}
            FitStatement::Minimise(minimise) => {
                let edges = [("after", &minimise.after), ("before", &minimise.before)];
                for (word, edge) in edges.iter().filter_map(|(word, edge)| Some((word, edge.as_ref()?))) {
                    let _ = write!(window, " {word} {}", slice(edge.span));
                }
            }
            FitStatement::Experiment(ExperimentStatement::Run(run)) => {
                let instance = &run.instance;
                let given = |bind: &&ast::Bind| {
                    let is_whole = matches!(bind.value, BindValue::Expr(_));
                    !(is_whole && unknowns.iter().any(|(unknown, _)| !unknown.own && unknown.path == bind.name.text))
                };
                let bound = instance.args.iter().filter(given).map(|bind| named(slice(bind.span), &unknowns));
                let mut arguments: Vec<String> = bound.collect();
                let in_part = |unknown: &FitUnknown| unknown.path.contains(['.', '[']);
                let whole = unknowns.iter().filter(|(unknown, _)| !unknown.own && !in_part(unknown));
                arguments.extend(whole.map(|(unknown, constant)| format!("{} = {constant}", unknown.path)));
                let rotary = if instance.rotary { "rotary " } else { "" };
                let duration = run.duration.as_ref().map_or(String::new(), |it| format!(" for {}", slice(it.span)));
                let _ = writeln!(out, "run {rotary}{}({}){duration}", instance.model.text, arguments.join(", "));
                for (unknown, constant) in unknowns.iter().filter(|(unknown, _)| in_part(unknown)) {
                    let _ = writeln!(out, "sweep {} = {constant}", unknown.path);
                }
            }
            FitStatement::Experiment(ExperimentStatement::Data(one)) => {
                let columns = Span { start: one.columns[0].name.span.start, ..one.span };
                let _ = writeln!(out, "data \"{data}\" ({}", slice(columns));
            }
            FitStatement::Experiment(ExperimentStatement::Derived(one)) => {
                let _ = writeln!(out, "{}", slice(one.span));
            }
            FitStatement::Experiment(ExperimentStatement::Solver(one)) => solver = Some(slice(one.span).to_string()),
            FitStatement::Experiment(ExperimentStatement::Plot(one)) => {
                let _ = writeln!(out, "{}", slice(one.span));
            }
            FitStatement::Experiment(ExperimentStatement::Tune(_, span)) => {
                let _ = writeln!(out, "{}", slice(*span));
            }
            FitStatement::Experiment(ExperimentStatement::Expect(one)) => {
                let _ = writeln!(out, "{}", slice(one.span));
            }
            FitStatement::Experiment(ExperimentStatement::Allow(one)) => {
                if !OF_FITS.contains(&one.lint.text.as_str()) {
                    let _ = writeln!(out, "{}", slice(one.span));
                }
            }
            FitStatement::Experiment(ExperimentStatement::Sweep(one)) => {
                // Of the alternatives, the one that was fitted.
                let paths = fit.body.iter().filter_map(|statement| match statement {
                    FitStatement::Experiment(ExperimentStatement::Sweep(other)) => Some(slice(other.path.span)),
                    _ => None,
                });
                let starts: Vec<usize> = paths
                    .filter_map(|path| runs.label.find(&format!("{path} = ")))
                    .chain([runs.label.len() + 2])
                    .collect();
                if let Some(at) = runs.label.find(&format!("{} = ", slice(one.path.span))) {
                    let end = starts.iter().copied().filter(|start| *start > at).min().unwrap_or(runs.label.len() + 2);
                    let _ = writeln!(out, "sweep {}", &runs.label[at..end - 2]);
                }
            }
            FitStatement::Experiment(ExperimentStatement::Record(_)) => unreachable!("a fit has no record"),
        }
    }
    let _ = writeln!(out, "solver {}", solver.unwrap_or_else(|| as_text(&run.solver)));
    for (item, measure) in asks.items.iter().zip(&run.measures) {
        let _ = writeln!(out, "expect rms({}) < {}{window}", item.text, show(ALLOWED * measure, &item.unit, 4));
    }
    *out += "}\n";
}

/// A solver as a text states it, with every digit of its step.
fn as_text(solver: &Solver) -> String {
    let plain = abi::format::plain;
    match solver.method {
        Method::Adaptive => format!("adaptive tol {}", plain(solver.tol)),
        method => format!("{} step {} s", method.name(), plain(solver.step)),
    }
}
