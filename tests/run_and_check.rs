//! `run` refuses what `check` refuses, with the same codes, and `check`, `run`, `explain` and `predict` name the same
//! largest stable step: over texts of the library that are changed at random, with printed seeds.

#[path = "support/mod.rs"]
mod support;

use abi::Slot;
use abi::plan::Method;
use compiler::analysis::step_stability::{LONGEST, largest_stable};
use compiler::analysis::step_stability_report::stable_up_to;
use compiler::ir::random::Random;
use compiler::{Changes, Loaded, Options};
use grammar::ast::Item;
use grammar::diagnostic::Diagnostic;
use grammar::tokens::{TokenKind, tokens};
use std::collections::BTreeSet;
use support::{Texts, root, texts_below};

/// Texts changed by default; `FRIC_CASES` and `FRIC_SEED` choose others.
const CASES: u64 = 250;

fn seeds(plain: u64) -> std::ops::Range<u64> {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let first = number("FRIC_SEED").unwrap_or(1);
    first..first + number("FRIC_CASES").unwrap_or(plain)
}

/// Items that are wrong, or right, each on its own.
const ITEMS: [&str; 10] = [
    "fn wrong_sum(v [m/s]) [m/s] = v + 1 N",
    "fn right_sum(v [m/s]) [m/s] = v + 1 m/s",
    "const wrong_unit [N] = 3 m",
    "table wrong_table(v [m/s]) [N] = linear { 0 m/s: 1 N, 0 m/s: 2 N }",
    "interface WrongPorts { input v [m/s] = 1 N  output F [N] }",
    "model WrongLoop { output a [1] = b  output b [1] = a }",
    "model WrongRange { param k = 3 N/m in 0 N/m .. 1 N/m  output y [N/m] = k }",
    "model Alone { input v [m/s]  output F [N] = 1 N / v * 1 m/s }",
    "experiment wrong_step { run Decay() for 1 s  solver euler step 30 ms }\n\
     model Decay { state x [m] = 1 m  in -2 m .. 2 m  dx/dt = -x / 10 ms }",
    "experiment right_step { run Slow() for 1 s  solver euler step 1 ms }\n\
     model Slow { state x [m] = 1 m  in -2 m .. 2 m  dx/dt = -x / 10 ms }",
];

/// A text of the library, changed at one to three places.
fn changed(texts: &[(String, String)], random: &mut Random) -> (String, String) {
    let (name, mut text) = texts[random.below(texts.len())].clone();
    for _ in 0..1 + random.below(3) {
        let all: Vec<_> = tokens(&text).into_iter().filter(|token| !token.is_trivia()).collect();
        let of_kind = |kind: TokenKind| all.iter().filter(|token| token.kind == kind).collect::<Vec<_>>();
        match random.below(8) {
            0 => text += &format!("\n{}\n", ITEMS[random.below(ITEMS.len())]),
            // Another solver, in an experiment that has one or not.
            1..=4 => {
                let method = Method::ALL[random.below(Method::ALL.len())];
                let step = ["", " step 1 us", " step 50 us", " step 1 ms", " step 3 ms", " step 100 ms"];
                let step = if method == Method::Adaptive { "" } else { step[random.below(step.len())] };
                let solver = format!("solver {}{step}", method.name());
                let own = text.lines().position(|line| line.trim_start().starts_with("solver "));
                let run = text.lines().position(|line| line.trim_start().starts_with("run "));
                let Some(at) = own.or(run) else { continue };
                let lines = text.lines().enumerate().map(|(k, line)| match (k == at, own.is_some()) {
                    (true, true) => format!("  {solver}\n"),
                    (true, false) => format!("{line}\n  {solver}\n"),
                    (false, _) => format!("{line}\n"),
                });
                text = lines.collect();
            }
            5 => {
                let numbers = of_kind(TokenKind::Number);
                if numbers.is_empty() {
                    continue;
                }
                let number = numbers[random.below(numbers.len())];
                let value: f64 = text[number.start..number.end].parse().unwrap_or(1.0);
                let other = value * [0.0, 1e-3, 0.1, 10.0, 1e4][random.below(5)];
                text.replace_range(number.start..number.end, &format!("{other}"));
            }
            6 => {
                let words = of_kind(TokenKind::Word);
                let [from, to] = [(); 2].map(|()| words[random.below(words.len())]);
                let word = text[from.start..from.end].to_string();
                text.replace_range(to.start..to.end, &word);
            }
            _ => {
                let lines: Vec<&str> = text.lines().collect();
                let gone = random.below(lines.len());
                text =
                    lines.iter().enumerate().filter(|(k, _)| *k != gone).map(|(_, line)| format!("{line}\n")).collect();
            }
        }
    }
    (name, text)
}

fn codes<'a>(found: impl IntoIterator<Item = &'a Diagnostic>) -> BTreeSet<&'static str> {
    found.into_iter().filter(|found| found.is_error()).map(|found| found.code).collect()
}

/// The codes with which `fric run FILE` refuses a text.
fn refused_by_run(name: &str, text: &str, sources: &Texts) -> BTreeSet<&'static str> {
    let mut loaded = compiler::load(name, text, sources);
    if loaded.has_errors() {
        return codes(&loaded.diagnostics);
    }
    let declarations = codes(&compiler::check_declarations(&loaded, sources));
    if !declarations.is_empty() {
        return declarations;
    }
    let names: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    let mut all = BTreeSet::new();
    for experiment in names {
        let options = Options { interpret: true, ..Options::default() };
        let result = compiler::compile(&mut loaded, sources, &experiment, &options, &mut Vec::new(), &mut |_| ());
        all.extend(result.err().iter().flat_map(codes));
    }
    all
}

/// Texts of the library that have an experiment or a rig, and examples with rigs.
fn originals() -> Vec<(String, String)> {
    let folders = ["stdlib-models", "examples"].map(|folder| texts_below(&root().join(folder)));
    let all = folders.into_iter().flatten().filter(|(_, text)| text.contains("\n  run "));
    all.map(|(path, text)| (path.file_name().unwrap().to_string_lossy().into_owned(), text)).collect()
}

/// The measured points, signal tables and texts that the examples name: from their own folder or from that of another.
fn examples() -> Texts {
    let mut files = Vec::new();
    for folder in std::fs::read_dir(root().join("examples")).unwrap() {
        let folder = folder.unwrap().path();
        for file in std::fs::read_dir(&folder).into_iter().flatten() {
            let path = file.unwrap().path();
            if path.extension().is_some_and(|extension| ["csv", "dbc", "fric"].iter().any(|known| extension == *known))
            {
                let [folder, name] =
                    [&folder, &path].map(|path| path.file_name().unwrap().to_string_lossy().into_owned());
                let text = std::fs::read_to_string(path).unwrap();
                files.push((format!("../{folder}/{name}"), text.clone()));
                files.push((name, text));
            }
        }
    }
    assert!(!files.is_empty());
    Texts(files)
}

#[test]
fn run_refuses_what_check_refuses() {
    let (texts, sources, seeds) = (originals(), examples(), seeds(CASES));
    println!("seeds {seeds:?}, {} texts", texts.len());
    let (mut refused, mut steps) = (0, 0);
    for seed in seeds.clone() {
        let (name, text) = changed(&texts, &mut Random(seed));
        let mut loaded = compiler::load(&name, &text, &sources);
        let check = codes(&compiler::check(&mut loaded, &sources));
        // Rigs and fits are not run by `run`; a text that has them has no errors but theirs.
        let others =
            loaded.files.get(loaded.root()).ast.items().any(|item| matches!(item, Item::Rig(_) | Item::Fit(_)));
        let run = refused_by_run(&name, &text, &sources);
        assert!(run.is_subset(&check), "seed {seed}: run {run:?}, check {check:?}\n{text}");
        if !others {
            assert_eq!(check.is_empty(), run.is_empty(), "seed {seed}: run {run:?}, check {check:?}\n{text}");
        }
        refused += u64::from(!run.is_empty());
        steps += u64::from(run.contains("E0702"));
    }
    println!("{refused} refused, {steps} for an unstable step");
    let count = seeds.end - seeds.start;
    assert!(count < CASES || (refused * 8 > count && refused < count && steps >= 3), "too few of one kind");
}

/// The diagnostics about the step of an experiment with this solver: E0702, W0704.
fn about_step(loaded: &mut Loaded, sources: &Texts, experiment: &str, method: Method, step: f64) -> Vec<Diagnostic> {
    let changes = Changes { method: Some(method), step: Some(step), ..Changes::default() };
    let (options, mut found) = (Options { changes, interpret: true }, Vec::new());
    let result = compiler::compile(loaded, sources, experiment, &options, &mut found, &mut |_| ());
    found.extend(result.err().into_iter().flatten());
    found.retain(|found| matches!(found.code, "E0701" | "E0702" | "W0704"));
    found
}

fn words(found: &[Diagnostic]) -> String {
    let one = |found: &Diagnostic| {
        let labels: Vec<&str> = found.labels.iter().map(|label| label.text.as_str()).collect();
        format!("{}: {}; {}", found.code, found.message, labels.join("; "))
    };
    found.iter().map(one).collect()
}

/// The step that `explain` names is the one that a refusal names; below it a step passes, above it none does.
#[test]
fn all_commands_name_one_largest_stable_step() {
    let (texts, sources) = (originals(), examples());
    let (mut named, mut random) = (0, Random(7));
    for (name, text) in &texts {
        let mut loaded = compiler::load(name, text, &sources);
        let experiments = loaded.experiments();
        let Some(experiment) = experiments.first().map(|experiment| experiment.name.clone()) else { continue };
        let explained = compiler::explain_run(&mut loaded, &sources, &experiment, &Changes::default());
        let explained = explained.unwrap_or_else(|found| panic!("{name}: {}", words(&found)));
        let method = [Method::Euler, Method::Rk4, Method::Expo, Method::Implicit][random.below(4)];
        let cost = explained.steps.iter().find(|step| step.method == method).unwrap();
        // Among steps as long as the motion itself, stability is not monotonic.
        let Some(stable) = cost.stable.filter(|stable| *stable > 0.0 && *stable < 0.05 * LONGEST) else { continue };
        let runs: Vec<&str> = text.lines().filter_map(|line| line.trim_start().strip_prefix("run ")).collect();
        let of_rig = |name: &str| runs.iter().any(|run| run.trim_start().starts_with(&format!("{name}(")));
        if loaded.rigs().iter().any(|rig| of_rig(&rig.name.text)) {
            continue; // The steps of a rig divide its period.
        }
        let below = about_step(&mut loaded, &sources, &experiment, method, 0.9 * stable);
        assert!(!words(&below).contains("stable"), "{name}, {} at 0.9 of {stable}: {}", method.name(), words(&below));
        for factor in [1.1, 1.9] {
            let above = words(&about_step(&mut loaded, &sources, &experiment, method, factor * stable));
            let needed = stable_up_to(stable);
            if above.contains("no multiple of the step") {
                continue; // The steps of a sampled program divide its periods.
            }
            assert!(
                above.contains(&format!("a step of {needed}")),
                "{name}, {} at {factor} of {stable}, {needed}: {above}",
                method.name()
            );
        }
        named += 1;
    }
    println!("{named} experiments");
    assert!(named > 10, "{named}");
}

/// Of a rig, `predict` names the step of the refusal and of `explain`.
#[test]
fn a_rig_has_the_same_largest_stable_step() {
    let text = std::fs::read_to_string(root().join("tests/errors/E0702.fric")).unwrap();
    let sources = Texts::default();
    let mut loaded = compiler::load("rig.fric", &text, &sources);
    let explained = compiler::explain_rig(&mut loaded, &sources, "bench").unwrap();
    let stable = |method| explained.steps.iter().find(|step| step.method == method).and_then(|step| step.stable);
    let refusal = compiler::rig(&mut loaded, &sources, "bench", &Options::default(), &mut Vec::new()).err().unwrap();
    let needed = stable_up_to(stable(Method::Rk4).unwrap());
    assert!(words(&refusal).contains(&format!("a step of {needed}")), "{needed}: {}", words(&refusal));
    // A condition that holds at rest does not end what is examined.
    let switched = text.replace("  bus ", "  stop   when body.x < 1 rad, \"not in its place\"\n  bus ");
    assert_ne!(switched, text);
    let mut loaded = compiler::load("rig.fric", &switched, &sources);
    let found = compiler::rig(&mut loaded, &sources, "bench", &Options::default(), &mut Vec::new()).err().unwrap();
    assert_eq!(words(&found), words(&refusal));
    let text = text.replace("solver rk4", "solver expo");
    let mut loaded = compiler::load("rig.fric", &text, &sources);
    let ready = compiler::rig(&mut loaded, &sources, "bench", &Options::default(), &mut Vec::new()).unwrap();
    let ends: Vec<Slot> = ready.rig.stops.iter().map(|stop| stop.slot).collect();
    assert_eq!(largest_stable(&ready.program, &ends, ready.rig.method), stable(Method::Expo));
}
