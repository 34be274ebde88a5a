//! The text that a fit writes to go on with: its values as constants, and an experiment that compares them with the
//! recording.
//!
//! In: the fit as written, and its answer. Out: a text in canonical layout. Knows nothing of the disk.

use super::answer::Fitted;
use crate::compile::{Asks, Loaded};
use crate::project;
use crate::quantity::{count, show, significant};
use abi::plan::{Method, Solver};
use grammar::ast::{self, BindValue, ExperimentStatement, FitStatement, ImportSource, Item};
use grammar::span::Span;
use std::fmt::Write;
use std::path::Path;

/// Width of a line.
const WIDTH: usize = 120;
/// The experiment allows this multiple of each measure that was found.
const ALLOWED: f64 = 1.05;
/// Lints of fits, which an experiment does not have.
const OF_FITS: [&str; 4] = ["unidentified", "at-bound", "rough", "unsettled"];

/// Where a fit comes from, and where its text goes to.
pub struct Place<'a> {
    /// The folder that the text goes to.
    pub folder: &'a Path,
    /// The file of the fit.
    pub file: &'a Path,
    /// The recording.
    pub data: &'a Path,
    /// Its SHA-256, in hexadecimal digits.
    pub hash: &'a str,
}

/// The text.
pub fn text(loaded: &Loaded, fit: &ast::Fit, fitted: &Fitted, asks: &Asks, place: &Place) -> String {
    let slice = |span: Span| loaded.files.slice(span);
    let name = &fit.name.text;
    let data = project::relative(place.data, place.folder);
    let file = project::relative(place.file, place.folder);
    let rms = asks.items.iter().zip(&fitted.answer.rms);
    let rms: Vec<String> = rms.map(|(item, rms)| format!("rms({}) {}", item.text, show(*rms, &item.unit, 4))).collect();
    let mut out = format!("// `fit {name}` of {file}, fric {}: {}.\n", env!("CARGO_PKG_VERSION"), rms.join(", "));
    let rows = if asks.steady { "steady points" } else { "rows" };
    let _ = writeln!(out, "// {} {rows} of {data}, SHA-256 {}.", count(asks.rows.len() as u64), place.hash);
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
    for (k, unknown) in asks.unknowns.iter().enumerate() {
        let [value, sd, low, high] = fitted.shown(k, unknown);
        let doc = match low.is_empty() {
            true => "not determined".to_string(),
            false => format!("± {sd}; {low} .. {high} with {percent} %"),
        };
        let _ = writeln!(out, "const {} = {value}  /// {doc}", constant(name, &unknown.path));
    }
    match lacks_times(asks) {
        Some(why) => {
            let _ = writeln!(out, "\n// {why}");
        }
        None => experiment(&mut out, &slice, fit, fitted, asks, &data),
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

/// The name of the constant of a parameter.
fn constant(fit: &str, path: &str) -> String {
    let path: String = path.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    format!("{fit}_{}", path.trim_end_matches('_'))
}

fn experiment<'a>(
    out: &mut String,
    slice: &dyn Fn(Span) -> &'a str,
    fit: &ast::Fit,
    fitted: &Fitted,
    asks: &Asks,
    data: &str,
) {
    let name = &fit.name.text;
    let _ = writeln!(out, "\nexperiment {name} {{");
    let mut solver = None;
    let mut window = String::new();
    for statement in &fit.body {
        match statement {
            FitStatement::Vary(..) => {}
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
                    !(is_whole && asks.unknowns.iter().any(|unknown| unknown.path == bind.name.text))
                };
                let mut arguments: Vec<String> =
                    instance.args.iter().filter(given).map(|bind| slice(bind.span).to_string()).collect();
                let whole = asks.unknowns.iter().filter(|unknown| !unknown.path.contains(['.', '[']));
                arguments.extend(whole.map(|one| format!("{} = {}", one.path, constant(name, &one.path))));
                let rotary = if instance.rotary { "rotary " } else { "" };
                let duration = run.duration.as_ref().map_or(String::new(), |it| format!(" for {}", slice(it.span)));
                let _ = writeln!(out, "run {rotary}{}({}){duration}", instance.model.text, arguments.join(", "));
                for one in asks.unknowns.iter().filter(|unknown| unknown.path.contains(['.', '['])) {
                    let _ = writeln!(out, "sweep {} = {}", one.path, constant(name, &one.path));
                }
            }
            FitStatement::Experiment(ExperimentStatement::Data(one)) => {
                let columns = Span { start: one.file.span.end, ..one.span };
                let _ = writeln!(out, "data \"{data}\" {}", slice(columns));
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
            FitStatement::Experiment(ExperimentStatement::Sweep(_) | ExperimentStatement::Record(_)) => {
                unreachable!("a fit has no sweep and no record")
            }
        }
    }
    let _ = writeln!(out, "solver {}", solver.unwrap_or_else(|| as_text(&fitted.solver)));
    for (item, measure) in asks.items.iter().zip(&fitted.measures) {
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
