//! Saves a session as a runnable file: runs, settings, expectations.
//!
//! In: a session. Out: the text of an experiment, checked and formatted.

use super::{Fault, MODEL, Session, Subject, found};
use crate::compile::{self, Loaded};
use grammar::ast::{self, Item};
use grammar::diagnostic::Diagnostic;
use std::path::{Component, Path, PathBuf};

impl Session {
    /// The session as a file in this folder: an experiment of this name.
    pub fn written(&self, name: &str, folder: &Path) -> Result<String, Fault> {
        let what = self.current();
        let setup = self.setup(&what);
        let mut text = String::new();
        let mut lines = Vec::new();
        match &what {
            Subject::Session => {
                if self.parts.is_empty() {
                    return Err("there is nothing to save yet: make an instance, or run an experiment".into());
                }
                text += &self.text("", "").0;
                lines.push(format!("run {MODEL}() for {}", seconds(setup.duration.unwrap_or(1.0))));
            }
            Subject::Typed(instance) => {
                text += &(self.items.join("\n") + "\n");
                lines.push(format!("run {instance} for {}", seconds(setup.duration.unwrap_or(1.0))));
            }
            Subject::Experiment(file, experiment) => {
                match file {
                    Some(file) => text += &imports(&self.used[*file], folder),
                    None => text += &(self.items.join("\n") + "\n"),
                }
                let (loaded, _) = self.loaded(&what, "");
                lines.extend(statements(&loaded, experiment, setup.duration));
            }
        }
        // A setting becomes a sweep over one value.
        lines.extend(setup.set.iter().map(|set| format!("sweep {}", set.trim())));
        lines.extend(setup.also.iter().map(|also| also.trim().to_string()));
        text += &format!("\nexperiment {name} {{\n");
        for line in lines {
            text += &format!("  {line}\n");
        }
        text += "}\n";
        let place = folder.join(name).display().to_string();
        let mut loaded = compile::load(&place, &text, &crate::disk::Disk);
        let diagnostics = compile::check(&mut loaded, &crate::disk::Disk);
        if diagnostics.iter().any(Diagnostic::is_error) {
            return Err(Fault::Found(loaded.files.0, diagnostics));
        }
        grammar::format::format(&text, 120).map_err(|errors| found(&loaded, &errors, "", None))
    }
}

/// Imports of a file in use and of what it imports itself, for a file in `folder`: imports reach one file far.
fn imports(used: &super::Used, folder: &Path) -> String {
    let from = |path: &Path| -> String {
        match (path.is_absolute(), folder.as_os_str().is_empty() || folder == Path::new(".")) {
            (true, _) | (_, true) => path.display().to_string(),
            (false, false) if folder.is_absolute() || folder.components().any(|part| part == Component::ParentDir) => {
                std::path::absolute(path).unwrap_or(path.to_path_buf()).display().to_string()
            }
            (false, false) => {
                let up = folder.components().filter(|part| matches!(part, Component::Normal(_))).map(|_| "..");
                up.collect::<PathBuf>().join(path).display().to_string()
            }
        }
    };
    let path = Path::new(&used.path);
    let beside = path.parent().unwrap_or(Path::new(""));
    let mut lines = vec![format!("import \"{}\"\n", from(path))];
    let file = used.loaded.files.get(used.loaded.root());
    for item in file.ast.items() {
        let Item::Import(import) = item else { continue };
        let text = used.loaded.files.slice(import.span).trim();
        let line = match text.split_once('"') {
            Some((_, rest)) => format!("import \"{}\"\n", from(&beside.join(rest.trim_end_matches('"')))),
            None => format!("{text}\n"),
        };
        if !lines.contains(&line) {
            lines.push(line);
        }
    }
    lines.concat()
}

/// Statements of an experiment as written, with the duration replaced if one is given.
pub(super) fn statements(loaded: &Loaded, name: &str, duration: Option<f64>) -> Vec<String> {
    let file = loaded.files.get(loaded.root());
    let found = file.ast.items().find_map(|item| match item {
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
            S::Derived(one) => one.span,
            S::Plot(one) => one.span,
            S::Tune(_, span) => *span,
            S::Expect(one) => one.span,
            S::Record(one) => one.span,
            S::Allow(one) => one.span,
        };
        out.push(loaded.files.slice(span).trim().to_string());
    }
    out
}

pub(super) fn seconds(t: f64) -> String {
    format!("{t} s")
}
