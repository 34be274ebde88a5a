//! Shared by several tests: texts with the library, their diagnostics as short lines, and runs on every back end.

#![allow(dead_code, reason = "each test uses its part")]

use abi::plan::Method;
use compiler::{Case, Changes, Loaded, Options, Sources};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use runtime::engine::{Continue, Failure, Outcome};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// The root folder of the project.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A whole number from the environment, such as `FRIC_SEED`.
pub fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name} is a whole number")))
}

/// Dotted names and texts of the library, in the order of the names.
static LIBRARY: LazyLock<Vec<(String, String)>> = LazyLock::new(|| {
    let folder = root().join("stdlib-models");
    let mut files: Vec<(String, String)> = texts_below(&folder)
        .into_iter()
        .map(|(path, text)| {
            let inside = path.strip_prefix(&folder).unwrap().with_extension("");
            let words: Vec<_> =
                inside.components().map(|part| part.as_os_str().to_string_lossy().into_owned()).collect();
            (format!("std.{}", words.join(".")), text)
        })
        .collect();
    files.sort();
    files
});

/// All `.fric` files below a folder with their texts, in the order of their names.
pub fn texts_below(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut paths: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let mut out = Vec::new();
    for path in paths {
        if path.is_dir() {
            out.extend(texts_below(&path));
        } else if path.extension().is_some_and(|extension| extension == "fric") {
            let text = fs::read_to_string(&path).unwrap();
            out.push((path, text));
        }
    }
    out
}

/// The library, and the files that a text may name.
#[derive(Clone, Default)]
pub struct Texts(pub Vec<(String, String)>);

impl Sources for Texts {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let inside = |file: &str| file == module || file.strip_prefix(module).is_some_and(|rest| rest.starts_with('.'));
        let found: Vec<(String, String)> = LIBRARY
            .iter()
            .filter(|(file, _)| inside(file))
            .map(|(file, text)| (format!("{file}.fric"), text.clone()))
            .collect();
        (!found.is_empty()).then_some(found)
    }

    fn library_is_sound(&self) -> bool {
        true
    }

    fn modules(&self) -> Vec<String> {
        let folder = |file: &str| file.match_indices('.').nth(1).map_or(file, |(at, _)| &file[..at]).to_string();
        let mut folders: Vec<String> = LIBRARY.iter().map(|(file, _)| folder(file)).collect();
        folders.dedup();
        folders
    }

    fn file(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let found = self.0.iter().find(|(name, _)| name == path);
        found.cloned().ok_or_else(|| "there is no such file".into())
    }
}

/// The diagnostics of a text, and the loaded text.
pub fn checked(name: &str, text: &str, sources: &Texts) -> (Loaded, Vec<Diagnostic>) {
    let mut loaded = compiler::load(name, text, sources);
    let found = compiler::check(&mut loaded, sources);
    for diagnostic in &found {
        sound(&loaded, diagnostic);
    }
    (loaded, found)
}

/// Checks that a diagnostic has a code, a message, and labels inside its texts at character boundaries.
#[track_caller]
pub fn sound(loaded: &Loaded, diagnostic: &Diagnostic) {
    let code = diagnostic.code;
    assert!(code.len() == 5 && code.starts_with(['E', 'W']), "{diagnostic:?}");
    assert!(!diagnostic.message.is_empty() && !diagnostic.labels.is_empty(), "{diagnostic:?}");
    for label in &diagnostic.labels {
        let file = loaded.files.0.get(label.span.file.0 as usize);
        let text = &file.unwrap_or_else(|| panic!("a place in no text: {diagnostic:?}")).text;
        assert!(text.get(label.span.range()).is_some(), "a place outside its text: {diagnostic:?}");
    }
}

/// `2:18 E0101 cannot add a force and a velocity`; with the file name first, if not in the first text.
pub fn line(loaded: &Loaded, diagnostic: &Diagnostic) -> String {
    let first_line = diagnostic.message.lines().next().unwrap_or_default();
    format!("{} {} {first_line}", place(loaded, diagnostic.span()), diagnostic.code)
}

/// Line and column, counted from 1 in characters.
fn place(loaded: &Loaded, span: Span) -> String {
    let file = loaded.files.get(span.file);
    let before = &file.text[..span.start as usize];
    let start = before.rfind('\n').map_or(0, |newline| newline + 1);
    let (line, column) = (before.matches('\n').count() + 1, before[start..].chars().count() + 1);
    match span.file == loaded.root() {
        true => format!("{line}:{column}"),
        false => format!("{}:{line}:{column}", file.name),
    }
}

/// Runs an experiment in the interpreter and as machine code; both must agree to the bit. One result for each case of
/// its sweeps.
///
/// # Errors
/// Diagnostics of the experiment.
#[track_caller]
pub fn run(
    loaded: &mut Loaded,
    sources: &Texts,
    experiment: &str,
) -> Result<Vec<Result<Outcome, Failure>>, Vec<Diagnostic>> {
    let mut results = Vec::new();
    for (machine, interpreted) in both(loaded, sources, experiment, Changes::default())? {
        let go = |case: &Case| {
            runtime::engine::run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(()))
        };
        let (result, reference) = (go(&machine), go(&interpreted));
        // Numbers are printed so that they parse back: equal texts mean equal bits, and NaN equals NaN.
        assert_eq!(
            format!("{result:?}"),
            format!("{reference:?}"),
            "{experiment} {}: the back ends differ",
            machine.label
        );
        results.push(result);
    }
    agree(loaded, sources, experiment)?;
    Ok(results)
}

/// Compares every slot after a hundred steps of its length, else of 1 ms, with each fixed method on both back ends.
///
/// # Errors
/// Diagnostics of the experiment.
#[track_caller]
pub fn agree(loaded: &mut Loaded, sources: &Texts, experiment: &str) -> Result<(), Vec<Diagnostic>> {
    let own = both(loaded, sources, experiment, Changes::default())?
        .first()
        .map_or(0.0, |(case, _)| case.experiment.solver.step);
    let step = if own > 0.0 { own } else { 1e-3 };
    for method in Method::ALL.into_iter().filter(|method| *method != Method::Adaptive) {
        let changes = Changes { method: Some(method), step: Some(step), any_step: true, ..Changes::default() };
        for (machine, interpreted) in both(loaded, sources, experiment, changes)? {
            let (mut a, mut b) = (machine.instance, interpreted.instance);
            let statuses = [a.start(step), b.start(step)];
            same(&a, &b, statuses, experiment, method);
            for _ in 0..10 {
                let statuses = [a.advance(10), b.advance(10)];
                same(&a, &b, statuses, experiment, method);
            }
        }
    }
    Ok(())
}

#[track_caller]
fn same(a: &abi::Instance, b: &abi::Instance, statuses: [u64; 2], experiment: &str, method: Method) {
    assert_eq!(statuses[0], statuses[1], "{experiment}, {}: status", method.name());
    for (slot, (a, b)) in a.block().iter().zip(b.block()).enumerate() {
        let equal = a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
        assert!(equal, "{experiment}, {}: slot {slot} is {a:?} as machine code, {b:?} interpreted", method.name());
    }
}

/// The cases of an experiment as machine code and for the interpreter.
fn both(
    loaded: &mut Loaded,
    sources: &Texts,
    experiment: &str,
    changes: Changes,
) -> Result<Vec<(Case, Case)>, Vec<Diagnostic>> {
    let mut compiled = |interpret: bool| {
        let options = Options { changes: changes.clone(), interpret };
        compiler::compile(loaded, sources, experiment, &options, &mut Vec::new(), &mut |_| ())
    };
    Ok(compiled(false)?.into_iter().zip(compiled(true)?).collect())
}
