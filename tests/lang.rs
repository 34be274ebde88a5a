//! The language, case by case: `tests/lang/*.fric`.
//!
//! A file contains many cases, each with a name: `--- symptom check ---` is a text that is only checked, `--- symptom
//! run ---` one whose experiments must also pass, with the same bits on every back end. After the text comes the
//! expected result:
//!
//! ```text
//! //~ ok                                           no diagnostics, every `expect` holds
//! //~ 2:18 E0101 cannot add a force and a velocity position, code, message
//! //~ fails NAME: `F` is not a number at 0 s       an experiment that stops, or an expectation that does not hold
//! ```
//!
//! `+++ other.fric` begins a further text of the case, which the first may import. `BLESS=1 cargo test --test lang`
//! replaces the expected results by the actual ones: read that difference as carefully as code.

mod support;

#[path = "lang/helps.rs"]
mod helps;

use std::collections::HashSet;
use std::fmt::Write;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};
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

/// The actual result of a case.
fn found(case: &LangCase) -> Vec<String> {
    let mut sources = Texts(case.others.clone());
    sources.0.push(("case.fric".into(), case.text.clone()));
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

/// Why a run failed; empty if it passed.
fn failures(result: &Result<runtime::engine::Outcome, runtime::engine::Failure>) -> Vec<String> {
    match result {
        Ok(outcome) => outcome.verdicts.iter().filter(|v| !v.holds).map(|v| v.text.clone()).collect(),
        Err(failure) => vec![failure.to_string()],
    }
}

/// Whether the actual result matches the expected one. An expectation without a message, or without a column, matches
/// any; so does `…` at its end.
fn fits(expected: &[String], found: &[String]) -> bool {
    let one = |(expected, found): (&String, &String)| {
        if expected == found {
            return true;
        }
        if let Some(begin) = expected.strip_suffix('…') {
            return found.starts_with(begin);
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
        let open = fits(&case.expected, &found) && case.expected.iter().any(|line| line.ends_with('…'));
        for line in if open { &case.expected } else { &found } {
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
            let known = [$(concat!(stringify!($name), ".fric")),*];
            for (path, _) in support::texts_below(&root().join("tests/lang")) {
                let name = path.file_name().unwrap().to_str().unwrap();
                assert!(known.contains(&name), "{name} is in no list");
            }
        }
    };
}

files! { rigs steps signs turns variants units derivatives delay sampled regimes parts functions experiments syntax names wrong_units definitions causality values proofs identification tuning }

/// Cases whose text contains several errors, each with a message of its own.
const SEVERAL: &[&str] = &[
    "a-division-in-a-range",
    "a-measure-over-time",
    "a-mistake-does-not-hide-the-next-model",
    "a-name-in-foreign-letters",
    "a-name-that-the-instance-does-not-have",
    "a-negative-power-has-a-size",
    "a-range-in-another-unit",
    "a-replaced-argument-is-checked",
    "a-step-too-long-with-a-reason",
    "a-step-too-long-without-an-end",
    "a-straight-system-on-a-shaft",
    "a-torque-too-coarse",
    "an-empty-window",
    "an-encoder-too-coarse",
    "an-expectation-in-another-unit",
    "an-odd-negative-power-has-a-sign",
    "an-unknown-function",
    "axes-of-a-plot",
    "each-unknown-name-is-reported",
    "inf-true-and-false-cannot-be-declared",
    "mistakes-are-found-each-by-itself",
    "models-that-a-sweep-replaces-are-checked",
    "next-in-a-regime",
    "slope-of-what-jumps",
    "start-value-of-an-output",
    "the-arcsine-of-what-can-be-larger-than-one",
    "the-wrong-number-of-arguments",
    "time-and-pi-cannot-be-declared",
    "two-circles-are-two-messages",
    "two-regimes-that-nothing-reaches",
    "what-is-counted-is-a-condition",
    "what-is-never-read",
    "zero-to-a-negative-power",
];

#[test]
fn one_mistake_gets_one_message() {
    let mut talkative: Vec<String> = Vec::new();
    for (path, text) in support::texts_below(&root().join("tests/lang")) {
        for case in cases(&text).1 {
            let messages = case.expected.iter().filter(|line| !line.starts_with("fails "));
            if messages.count() > 1 {
                assert!(!talkative.contains(&case.name), "{}: two cases of this name", path.display());
                talkative.push(case.name);
            }
        }
    }
    talkative.sort_unstable();
    let mut several: Vec<String> = SEVERAL.iter().map(|name| name.to_string()).collect();
    several.sort_unstable();
    assert_eq!(talkative, several);
}

/// A generator; the field is its state, at first the seed, which is printed.
struct Chance(u64);

impl Chance {
    fn below(&mut self, n: usize) -> usize {
        abi::random::below(&mut self.0, n)
    }

    fn of<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        &all[self.below(all.len())]
    }
}

/// Number of cases: the value of the variable, else `usual`.
fn count(variable: &str, usual: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(usual)
}

/// Initial texts: the library, the examples, every case, every golden error.
fn corpus() -> Vec<String> {
    let mut out = Vec::new();
    for folder in ["stdlib-models", "examples", "tests/errors"] {
        out.extend(support::texts_below(&root().join(folder)).into_iter().map(|(_, text)| text));
    }
    for (_, text) in support::texts_below(&root().join("tests/lang")) {
        out.extend(cases(&text).1.into_iter().map(|case| case.text));
    }
    out
}

/// Words that a mutation inserts.
const WORDS: &[&str] = &[
    "model",
    "param",
    "input",
    "output",
    "state",
    "let",
    "require",
    "storage",
    "allow",
    "part",
    "every",
    "when",
    "mode",
    "initial",
    "go",
    "next",
    "reset",
    "if",
    "then",
    "else",
    "and",
    "or",
    "not",
    "in",
    "crosses",
    "rises",
    "falls",
    "import",
    "const",
    "fn",
    "table",
    "interface",
    "experiment",
    "fit",
    "device",
    "rig",
    "run",
    "solver",
    "sweep",
    "data",
    "plot",
    "expect",
    "rotary",
    "linear",
    "sum",
    "t",
    "pi",
    "inf",
    "true",
    "dx/dt",
    "dz/dt",
    "dx/ds",
    "M",
    "x",
    "v",
    "0",
    "1",
    "2",
    "1e9",
    "0x10",
    "m",
    "N",
    "N·m",
    "[m]",
    "[m/s]",
    "%",
    "(",
    ")",
    "[",
    "]",
    "{",
    "}",
    "=",
    "==",
    "..",
    ",",
    ":",
    "+",
    "-",
    "*",
    "/",
    "^",
    "<",
    ">=",
    "~=",
    "+-",
    ".",
    "\"",
    "//",
    "///",
    "\n",
    "\r\n",
    "\t",
    "\u{feff}",
    "é",
    "🙂",
    "?",
    ";",
];

/// A text with one or two mutations: a part deleted, doubled, moved, replaced or inserted.
fn mutated(corpus: &[String], chance: &mut Chance) -> String {
    let mut text = chance.of(corpus).clone();
    for _ in 0..1 + chance.below(2) {
        let mut places: Vec<usize> =
            grammar::tokens::tokens(&text).iter().flat_map(|token| [token.start, token.end]).collect();
        places.dedup();
        if places.len() < 2 {
            places = vec![0, text.len()];
        }
        let i = chance.below(places.len() - 1);
        let j = (i + 1 + chance.below(6)).min(places.len() - 1);
        let (start, end) = (places[i], places[j]);
        match chance.below(8) {
            0 => text.replace_range(start..end, ""),
            1 => {
                let doubled = text[start..end].to_string();
                text.insert_str(end, &doubled);
            }
            2 => text.replace_range(start..end, chance.of::<&str>(WORDS)),
            3 => text.insert_str(start, &format!(" {} ", chance.of(WORDS))),
            4 => text.truncate(start),
            5 => {
                let other = chance.of(corpus);
                let tokens = grammar::tokens::tokens(other);
                if !tokens.is_empty() {
                    let first = chance.below(tokens.len());
                    let last = (first + chance.below(12)).min(tokens.len() - 1);
                    text.insert_str(start, &other[tokens[first].start..tokens[last].end]);
                }
            }
            6 => {
                let moved = text[start..end].to_string();
                text.replace_range(start..end, "");
                let to = *chance.of(&places);
                text.insert_str(if to <= start { to } else { start }, &moved);
            }
            _ => {
                let k = chance.below(places.len() - 1);
                let word = text[places[k]..places[k + 1]].to_string();
                text.replace_range(start..end, &word);
            }
        }
    }
    text
}

/// For any text: no panic, no endless work, every error with its code and its position, and formatting is idempotent
/// where it succeeds.
#[test]
fn mutated_texts_are_read_formatted_and_checked() {
    let total = count("FRIC_MUTATIONS", 4_000);
    let first = count("FRIC_SEED", 0);
    let corpus = Arc::new(corpus());
    let workers = thread::available_parallelism().map_or(1, |n| n.get() as u64).min(total);
    let mut running = Vec::new();
    for worker in 0..workers {
        let at = Arc::new(AtomicU64::new(first + worker));
        let (progress, corpus) = (at.clone(), corpus.clone());
        let seeds = (first + worker..first + total).step_by(workers as usize);
        let thread = thread::Builder::new().stack_size(8 << 20).spawn(move || {
            let (mut clean, mut failures) = (0, Vec::new());
            for seed in seeds {
                progress.store(seed, Ordering::Relaxed);
                match mutation_is_answered(&corpus, seed) {
                    Ok(without_diagnostics) => clean += u64::from(without_diagnostics),
                    Err(failure) => failures.push(failure),
                }
            }
            (clean, failures)
        });
        running.push((at, thread.unwrap()));
    }
    let texts = corpus.clone();
    let mut since: Vec<(u64, Instant)> = vec![(u64::MAX, Instant::now()); running.len()];
    while running.iter().any(|(_, thread)| !thread.is_finished()) {
        thread::sleep(Duration::from_millis(20));
        for ((at, thread), (seed, since)) in running.iter().zip(&mut since) {
            let now = at.load(Ordering::Relaxed);
            if now != *seed || thread.is_finished() {
                (*seed, *since) = (now, Instant::now());
            }
            assert!(
                since.elapsed() < Duration::from_secs(60),
                "seed {seed} never ends (FRIC_SEED={seed} FRIC_MUTATIONS=1):\n{}",
                mutated(&texts, &mut Chance(*seed))
            );
        }
    }
    let ends = running.into_iter().map(|(_, thread)| thread.join().expect("panics are caught"));
    let (clean, failures): (Vec<u64>, Vec<Vec<String>>) = ends.unzip();
    let (clean, failures) = (clean.iter().sum::<u64>(), failures.concat());
    assert!(failures.is_empty(), "{} of {total} texts: {}", failures.len(), failures.join("\n"));
    println!("{total} texts from seed {first} on, {clean} of them without a word to say");
    assert!(total < 100 || clean * 200 > total, "only {clean} of {total} were fine: mutations are too wild");
}

/// Parses, formats and checks the text of a seed; returns whether it has no diagnostics, or the seed and the text at
/// which something panicked.
fn mutation_is_answered(corpus: &[String], seed: u64) -> Result<bool, String> {
    let text = mutated(corpus, &mut Chance(seed));
    let tried = catch_unwind(AssertUnwindSafe(|| {
        let (_, found) = checked("text.fric", &text, &Texts::default());
        if let Ok(formatted) = grammar::format::format(&text, 100) {
            let again = grammar::format::format(&formatted, 100);
            assert_eq!(again.as_deref(), Ok(formatted.as_str()), "formatted twice");
        }
        found.is_empty()
    }));
    tried.map_err(|_| format!("seed {seed} (FRIC_SEED={seed} FRIC_MUTATIONS=1):\n{text}"))
}

/// A dimensionless expression over the names, safe to divide by where it is a divisor.
fn expression(chance: &mut Chance, names: &[String], depth: usize) -> String {
    if depth == 0 || chance.below(6) == 0 {
        return match chance.below(4) {
            0 => format!("{}", (chance.below(400) as f64 - 200.0) / 16.0),
            1 => "t / 1 s".into(),
            _ => chance.of(names).clone(),
        };
    }
    let mut inner = || format!("({})", expression(chance, names, depth - 1));
    let (a, b, c) = (inner(), inner(), inner());
    match chance.below(18) {
        0 => format!("{a} + {b}"),
        1 => format!("{a} - {b}"),
        2 => format!("{a} * {b}"),
        3 => format!("{a} / (1 + {b}^2)"),
        4 => format!("-{a}"),
        5 => format!("abs{a}"),
        6 => format!("sign{a}"),
        7 => format!("sin{a}"),
        8 => format!("cos{a}"),
        9 => format!("tanh{a}"),
        10 => format!("exp(-abs{a})"),
        11 => format!("log(1 + abs{a})"),
        12 => format!("sqrt(abs{a})"),
        13 => format!("min({a}, {b})"),
        14 => format!("clamp({a}, -1, 2)"),
        15 => format!("floor{a}"),
        16 => format!("atan2({a}, 1 + {b}^2)"),
        _ => format!("if {a} < {b} then {c} else {a}"),
    }
}

/// A meaningless model that uses the whole language, with an experiment.
fn program(chance: &mut Chance) -> String {
    let mut names: Vec<String> = Vec::new();
    let mut text = String::from("model M {\n");
    for k in 0..1 + chance.below(3) {
        writeln!(text, "  param p{k} = {}", (chance.below(64) as f64 - 32.0) / 8.0).unwrap();
        names.push(format!("p{k}"));
    }
    let states = 1 + chance.below(4);
    for k in 0..states {
        writeln!(text, "  state x{k} [1] = {}", (chance.below(64) as f64 - 32.0) / 16.0).unwrap();
        names.push(format!("x{k}"));
    }
    writeln!(text, "  state n [1] = 1").unwrap();
    names.push("n".into());
    for k in 0..chance.below(5) {
        let value = expression(chance, &names, 3);
        writeln!(text, "  let a{k} [1] = {value}").unwrap();
        names.push(format!("a{k}"));
    }
    let modes = chance.below(2) == 1;
    for k in 0..states {
        if !(modes && k == 0) {
            writeln!(text, "  dx{k}/dt = (tanh({}) - x{k}) / 1 s", expression(chance, &names, 4)).unwrap();
        }
    }
    writeln!(text, "  every {} ms {{ next(n) = tanh({}) }}", 1 + chance.below(4), expression(chance, &names, 3))
        .unwrap();
    if modes {
        for (name, other, word) in [("one", "two", " initial"), ("two", "one", "")] {
            let (rate, condition) = (expression(chance, &names, 3), expression(chance, &names, 2));
            writeln!(text, "  mode {name}{word} {{").unwrap();
            writeln!(text, "    dx0/dt = tanh({rate}) / 1 s").unwrap();
            writeln!(text, "    go {other} when ({condition}) > x0 {{ reset(x0) = x0 / 2 }}").unwrap();
            writeln!(text, "  }}").unwrap();
        }
    }
    let (crossing, event) = (expression(chance, &names, 2), expression(chance, &names, 2));
    writeln!(text, "  when ({crossing}) crosses 0.5 {{ reset(x{}) = tanh({event}) }}", states - 1).unwrap();
    writeln!(text, "  output y [1] = {}", expression(chance, &names, 4)).unwrap();
    text + "}\n\nexperiment e {\n  run M() for 0.1 s\n  solver rk4 step 1 ms\n  expect final(y) < inf\n}\n"
}

/// Meaningless programs, on both back ends with every fixed method.
#[test]
fn generated_programs_have_the_same_bits_everywhere() {
    let first = count("FRIC_SEED", 0);
    for seed in first..first + count("FRIC_PROGRAMS", 20) {
        let text = program(&mut Chance(seed));
        let tried = catch_unwind(AssertUnwindSafe(|| {
            let sources = Texts::default();
            let (mut loaded, found) = checked("text.fric", &text, &sources);
            let errors: Vec<String> = found.iter().filter(|d| d.is_error()).map(|d| line(&loaded, d)).collect();
            assert!(errors.is_empty(), "{errors:?}");
            support::agree(&mut loaded, &sources, "e").unwrap();
        }));
        assert!(tried.is_ok(), "seed {seed} (FRIC_SEED={seed} FRIC_PROGRAMS=1):\n{text}");
    }
}

/// Typical corruptions of texts by people and machines: each gets a diagnostic, none a panic.
#[test]
fn odd_texts_are_answered() {
    let model = |value: &str| format!("model M {{\n  output y [1] = {value}\n}}\n");
    let repeated =
        |left: &str, middle: &str, right: &str, n: usize| format!("{}{middle}{}", left.repeat(n), right.repeat(n));
    let fine: &[(&str, String)] = &[
        ("a byte order mark", format!("\u{feff}{}", model("1"))),
        ("lines of Windows", model("1").replace('\n', "\r\n")),
        ("tabs", model("1").replace("  ", "\t")),
        ("no line end", model("1").trim_end().into()),
        ("comments in other scripts", model("1 /// Ж 🙂 é")),
        ("200 brackets", model(&repeated("(", "1", ")", 200))),
        ("60 calls", model(&repeated("abs(", "1", ")", 60))),
        ("60 conditions", model(&repeated("if t > 1 s then 1 else ", "1", "", 60))),
        ("500 terms", model(&repeated("1 + ", "1", "", 500))),
        ("a chain of lets", format!("model M {{\n{}  let a2000 = 1\n  output y = a0\n}}\n", (0..2000).map(|k| format!("  let a{k} = a{} + 1\n", k + 1)).collect::<String>())),
        ("lets that double", format!("model M {{\n{}  let a40 = 1\n  output y = a0\n}}\n", (0..40).map(|k| format!("  let a{k} = a{0} + a{0}\n", k + 1)).collect::<String>())),
        ("1,000 parts", "model E { param k = 1  output y [1] = k }\nmodel M {\n  part e[i in 1 .. 1000] = E(k = i)\n  output y [1] = sum(e.y)\n}\n".into()),
        ("200 models", (0..200).map(|k| format!("model M{k} {{ output y [1] = {k} }}\n")).collect()),
    ];
    for (what, text) in fine {
        let (loaded, found) = checked("odd.fric", text, &Texts::default());
        let found: Vec<String> = found.iter().map(|diagnostic| line(&loaded, diagnostic)).collect();
        assert!(found.is_empty(), "{what}: {found:?}");
    }
    let wrong: &[(&str, String, &str)] = &[
        ("nothing", String::new(), "E0001"),
        ("blanks", " \n\t\n".into(), "E0001"),
        ("100,000 brackets", "(".repeat(100_000), "E0001"),
        ("100,000 braces", "{".repeat(100_000), "E0002"),
        ("brackets in a model", format!("model M {{ let a = {}", "[".repeat(10_000)), "E0002"),
        ("brackets too deep", model(&repeated("(", "1", ")", 5000)), "E0001"),
        ("conditions too deep", model(&repeated("if true then ", "1", " else 2", 3000)), "E0001"),
        ("conditions in a chain", model(&repeated("if t > 1 s then 1 else ", "1", "", 3000)), "E0001"),
        ("signs", model(&repeated("-", "1", "", 3000)), "E0001"),
        ("powers", model(&repeated("2^", "1", "", 3000)), "E0001"),
        ("calls", model(&repeated("abs(", "1", ")", 3000)), "E0001"),
        ("a number too large", model(&"1".repeat(10_000)), "E0001"),
        ("an exponent too large", model("1e999"), "E0001"),
        ("a long name", model(&"a".repeat(100_000)), "E0204"),
        ("a long path", model(&format!("{}b", "a.".repeat(10_000))), "E0204"),
        (
            "a circle of 2,000 lets",
            format!(
                "model M {{\n{}  output y = a0\n}}\n",
                (0..2000).map(|k| format!("  let a{k} = a{} + 1\n", (k + 1) % 2000)).collect::<String>()
            ),
            "E0401",
        ),
        ("other scripts", "модель M { }\n".into(), "E0001"),
        ("a control character", model("\u{1b} 1"), "E0001"),
        ("half a model", "model M {\n  output y [1] = ".into(), "E0002"),
    ];
    for (what, text, code) in wrong {
        let (loaded, found) = checked("odd.fric", text, &Texts::default());
        let lines: Vec<String> = found.iter().map(|diagnostic| line(&loaded, diagnostic)).collect();
        let short: Vec<String> = lines.iter().map(|line| line.chars().take(100).collect()).collect();
        assert!(found.iter().any(|diagnostic| diagnostic.code == *code), "{what}: {short:?}");
        assert!(found.len() <= 2, "{what}: {short:?}");
        let emptied = grammar::format::format(text, 100).is_ok_and(|formatted| formatted.is_empty());
        assert!(!emptied || text.trim().is_empty(), "{what}");
    }
}
