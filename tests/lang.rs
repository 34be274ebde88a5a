//! The language, case by case: `tests/lang/*.fric`.
//!
//! A file holds many cases, each under its name: `--- symptom check ---` is a text that is only looked at,
//! `--- symptom run ---` one whose experiments must also hold, on every back end with the same bits. Behind the text
//! stands what is expected:
//!
//! ```text
//! //~ ok                                           nothing is wrong, every `expect` holds
//! //~ 2:18 E0101 cannot add a force and a velocity place, code, message
//! //~ fails NAME: `F` is not a number at 0 s       an experiment that stops, or what it expects and does not get
//! ```
//!
//! `+++ other.fric` begins a further text of the case, which the first may import. `BLESS=1 cargo test --test lang`
//! writes what is found over what is expected: read that difference as carefully as code. `pending.fric` holds what is
//! known to be wrong, with what it should be; a case there that comes right must move to its place.

mod support;

use std::collections::HashSet;
use std::fmt::Write;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use support::{Texts, checked, line, root, run};

/// One case of a file.
struct LangCase {
    name: String,
    runs: bool,
    /// The text itself.
    text: String,
    /// Further texts by name.
    others: Vec<(String, String)>,
    expected: Vec<String>,
}

/// Everything before the first case, and the cases.
fn cases(text: &str) -> (String, Vec<LangCase>) {
    let mut intro = String::new();
    let mut cases: Vec<LangCase> = Vec::new();
    for line in text.split_inclusive('\n') {
        if let Some(head) = line.trim_end().strip_prefix("--- ") {
            let words: Vec<&str> = head.split(' ').collect();
            let [name, kind @ ("check" | "run"), "---"] = words[..] else { panic!("not a heading: {line}") };
            let case = LangCase {
                name: name.into(),
                runs: kind == "run",
                text: String::new(),
                others: Vec::new(),
                expected: Vec::new(),
            };
            cases.push(case);
            continue;
        }
        let Some(case) = cases.last_mut() else {
            intro.push_str(line);
            continue;
        };
        if let Some(name) = line.strip_prefix("+++ ") {
            case.others.push((name.trim().into(), String::new()));
        } else if let Some(expected) = line.strip_prefix("//~ ") {
            case.expected.push(expected.trim_end().into());
        } else if let Some((_, other)) = case.others.last_mut() {
            other.push_str(line);
        } else {
            assert!(case.expected.is_empty() || line.trim().is_empty(), "{}: text behind what is expected", case.name);
            case.text.push_str(line);
        }
    }
    for case in &mut cases {
        let text = case.others.last_mut().map_or(&mut case.text, |(_, text)| text);
        text.truncate(text.trim_end().len());
        text.push('\n');
    }
    (intro, cases)
}

/// What there is to say about a case.
fn found(case: &LangCase) -> Vec<String> {
    let sources = Texts(case.others.clone());
    let (mut loaded, diagnostics) = checked("case.fric", &case.text, &sources);
    let mut out: Vec<String> = diagnostics.iter().map(|diagnostic| line(&loaded, diagnostic)).collect();
    if case.runs && !diagnostics.iter().any(|diagnostic| diagnostic.is_error()) {
        let experiments = loaded.experiments();
        assert!(!experiments.is_empty(), "no experiment to run");
        for experiment in experiments {
            let name = experiment.name;
            assert!(experiment.has_expect, "{name} expects nothing");
            match run(&mut loaded, &sources, &name) {
                Err(errors) => out.extend(errors.iter().map(|error| format!("fails {name}: {}", line(&loaded, error)))),
                Ok(results) => {
                    for result in results {
                        out.extend(failures(&result).into_iter().map(|failure| format!("fails {name}: {failure}")));
                    }
                }
            }
        }
    }
    if out.is_empty() {
        out.push("ok".into());
    }
    out
}

/// Why a run did not hold; nothing if it did.
fn failures(result: &Result<runtime::engine::Outcome, runtime::engine::Failure>) -> Vec<String> {
    match result {
        Ok(outcome) => outcome.verdicts.iter().filter(|v| !v.holds).map(|v| v.text.clone()).collect(),
        Err(failure) => vec![failure.to_string()],
    }
}

/// Whether what was found is what is expected. An expectation without a message, or without a column, leaves that open.
fn fits(expected: &[String], found: &[String]) -> bool {
    let one = |(expected, found): (&String, &String)| {
        if expected == found {
            return true;
        }
        let (Some((place, code)), Some((at, rest))) = (expected.split_once(' '), found.split_once(' ')) else {
            return false;
        };
        let placed = place == at || at.strip_prefix(place).is_some_and(|rest| rest.starts_with(':'));
        placed && code.len() == 5 && rest.starts_with(code)
    };
    expected.len() == found.len() && expected.iter().zip(found).all(one)
}

fn path(file: &str) -> PathBuf {
    root().join("tests/lang").join(file)
}

fn check_file(file: &str) {
    let text = fs::read_to_string(path(file)).unwrap();
    let (intro, cases) = cases(&text);
    let (mut wrong, mut names, mut blessed) = (String::new(), HashSet::new(), intro);
    for case in &cases {
        assert!(names.insert(case.name.clone()), "{file}: two cases are called {}", case.name);
        let found = catch_unwind(AssertUnwindSafe(|| found(case))).unwrap_or_else(|panic| {
            let words = panic.downcast_ref::<String>().cloned();
            vec![format!(
                "panics: {}",
                words.or(panic.downcast_ref::<&str>().map(|text| text.to_string())).unwrap_or_default()
            )]
        });
        if !fits(&case.expected, &found) {
            let (expected, found) = (case.expected.join("\n    "), found.join("\n    "));
            writeln!(wrong, "{file}: {}\n  expected\n    {expected}\n  found\n    {found}", case.name).unwrap();
        }
        let kind = if case.runs { "run" } else { "check" };
        write!(blessed, "--- {} {kind} ---\n{}", case.name, case.text).unwrap();
        for (name, text) in &case.others {
            write!(blessed, "+++ {name}\n{text}").unwrap();
        }
        let kept = if fits(&case.expected, &found) { &case.expected } else { &found };
        for line in kept {
            writeln!(blessed, "//~ {line}").unwrap();
        }
        blessed.push('\n');
    }
    if std::env::var_os("BLESS").is_some() {
        fs::write(path(file), format!("{}\n", blessed.trim_end())).unwrap();
    }
    assert!(wrong.is_empty(), "\n{wrong}");
}

macro_rules! files {
    ($($name:ident)*) => {
        $(#[test] fn $name() { check_file(concat!(stringify!($name), ".fric")) })*

        #[test]
        fn every_file_of_cases_is_run() {
            let known = [$(concat!(stringify!($name), ".fric"),)* "pending.fric"];
            for (path, _) in support::texts_below(&root().join("tests/lang")) {
                let name = path.file_name().unwrap().to_str().unwrap();
                assert!(known.contains(&name), "{name} is in no list");
            }
        }
    };
}

files! { units derivatives sampled regimes parts functions experiments syntax names wrong_units definitions causality values }

/// What is known to be wrong, and says so when it comes right.
#[test]
fn pending_cases_still_wait() {
    let Ok(text) = fs::read_to_string(path("pending.fric")) else { return };
    let (_, cases) = cases(&text);
    let right: Vec<&str> = cases
        .iter()
        .filter(|case| catch_unwind(AssertUnwindSafe(|| found(case))).is_ok_and(|found| fits(&case.expected, &found)))
        .map(|case| case.name.as_str())
        .collect();
    assert!(right.is_empty(), "came right, move them to their files: {}", right.join(", "));
}
