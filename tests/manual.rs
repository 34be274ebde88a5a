//! The pages in `docs/` are correct: their `fric` blocks are checked and run, and every code has its page.
//!
//! A block marked `fric` has no diagnostics and its experiments pass; one marked `fric,error=E0101` gets exactly that
//! code. On the page of a code, `fric wrong` gets that code and no other, and `fric right` none.

mod support;

use compiler::functions::Builtin;
use runtime::engine::{Failure, Outcome};
use std::collections::BTreeSet;
use std::fs;
use support::{Texts, checked, line, root, run};

/// A code block: the words after its fence, its first line, its text.
struct Block {
    words: String,
    line: usize,
    text: String,
}

fn blocks(page: &str) -> Vec<Block> {
    let mut blocks: Vec<Block> = Vec::new();
    let mut inside = false;
    for (number, line) in page.lines().enumerate() {
        if let Some(words) = line.strip_prefix("```") {
            inside = !inside;
            if inside {
                blocks.push(Block { words: words.into(), line: number + 2, text: String::new() });
            }
        } else if let Some(block) = blocks.last_mut().filter(|_| inside) {
            block.text.push_str(line);
            block.text.push('\n');
        }
    }
    blocks
}

/// The failures of a block: lines of diagnostics, and experiments that fail.
fn wrong(block: &Block) -> Vec<String> {
    let recording = "t [s],v [mm/s]\n0,0\n1,5\n2,3\n";
    let dbc = include_str!("../examples/rtfs/shaft.dbc");
    let bench = ("bench.csv".into(), "0,1,1\n1,2,2\n2,3,3\n".into());
    let uneven = ("uneven.csv".into(), "t [s],x [mm]\n0,0\n1,1\n2.3,3\n".into());
    let sources = Texts(vec![("shaft.dbc".into(), dbc.into()), ("pull.csv".into(), recording.into()), bench, uneven]);
    let (mut loaded, found) = checked("page.fric", &block.text, &sources);
    let mut out: Vec<String> = found.iter().map(|diagnostic| line(&loaded, diagnostic)).collect();
    if !found.iter().any(|diagnostic| diagnostic.is_error()) {
        for experiment in loaded.experiments() {
            match run(&mut loaded, &sources, &experiment.name) {
                Ok(results) => out.extend(failures(&experiment.name, &results)),
                Err(errors) => out.extend(errors.iter().map(|error| line(&loaded, error))),
            }
        }
    }
    out
}

/// Why experiments failed.
fn failures(name: &str, results: &[Result<Outcome, Failure>]) -> Vec<String> {
    let mut out = Vec::new();
    for result in results {
        match result {
            Ok(outcome) => {
                let failed = outcome.verdicts.iter().filter(|verdict| !verdict.holds);
                out.extend(failed.map(|verdict| format!("fails {name}: {}", verdict.text)));
            }
            Err(failure) => out.push(format!("fails {name}: {failure}")),
        }
    }
    out
}

/// The codes among lines of diagnostics.
fn codes(lines: &[String]) -> BTreeSet<&str> {
    lines.iter().filter_map(|line| line.split(' ').nth(1)).collect()
}

#[track_caller]
fn check_page(name: &str) {
    let page = fs::read_to_string(root().join("docs").join(name)).unwrap();
    let mut problems = String::new();
    let mut count = 0;
    for block in blocks(&page) {
        let found = match block.words.split_once('=') {
            None if block.words == "fric" => wrong(&block),
            Some(("fric,error", code)) => {
                let found = wrong(&block);
                if codes(&found) == BTreeSet::from([code]) {
                    Vec::new()
                } else {
                    [vec![format!("not {code}")], found].concat()
                }
            }
            _ => continue,
        };
        count += 1;
        if !found.is_empty() {
            problems += &format!("docs/{name}:{}\n    {}\n", block.line, found.join("\n    "));
        }
    }
    assert!(count > 0, "docs/{name} has no block to try");
    assert!(problems.is_empty(), "\n{problems}");
}

#[test]
fn the_reference_says_what_is_true() {
    check_page("language.md");
}

#[test]
fn the_tutorial_says_what_is_true() {
    check_page("tutorial.md");
}

/// The pages of the codes: code and text.
fn pages(all: &str) -> Vec<(&str, &str)> {
    let mut pages: Vec<(&str, &str)> = Vec::new();
    for (at, _) in all.match_indices("\n## ") {
        let text = &all[at + 4..];
        let end = text.find("\n## ").unwrap_or(text.len());
        pages.push((&text[..5], &text[..end]));
    }
    pages
}

/// Examples that are not correct yet, with the reason. One that becomes correct must leave this list.
const WAITING: &[(&str, &str, &str)] = &[];

/// Codes with a page that are never reported yet, with the reason. One that is reported must leave this list and get
/// its examples.
const NOT_GIVEN: &[(&str, &str)] = &[];

/// Codes that no check gives, with the tests that get them.
const ELSEWHERE: &[(&str, &str)] = &[
    ("E0906", "a search finds it: tests/fits.rs"),
    ("E0907", "a search finds it: tests/fits.rs"),
    ("E0911", "`fric build --emit numpy` finds it: tests/cli.rs"),
    ("W0910", "a search finds it: tests/fits.rs"),
    ("W0902", "a search finds it: tests/fits.rs"),
    ("W0903", "a search finds it: tests/fits.rs"),
    ("W0904", "a search finds it: tests/fits.rs"),
    ("W0905", "a search finds it: tests/fits.rs"),
    ("W0906", "a search finds it: tests/fits.rs"),
    ("W0907", "a search finds it: tests/fits.rs"),
    ("W0908", "a search finds it: tests/fits.rs"),
    ("W0909", "a search finds it: tests/fits.rs"),
    ("W0911", "a search finds it: tests/fits.rs"),
    ("W0912", "a search finds it: tests/fits.rs"),
];

#[test]
fn the_examples_of_every_code_are_what_they_claim() {
    let all = fs::read_to_string(root().join("docs/errors.md")).unwrap();
    let mut problems = String::new();
    for (code, page) in pages(&all) {
        let examples: Vec<Block> = blocks(page).into_iter().filter(|block| block.words.starts_with("fric")).collect();
        let given = !NOT_GIVEN.iter().chain(ELSEWHERE).any(|(other, _)| *other == code);
        for kind in ["wrong", "right"] {
            let one = examples.iter().any(|block| block.words == format!("fric {kind}"));
            if given && !one {
                problems += &format!("{code} has no example that is {kind}\n");
            }
        }
        for block in examples {
            let (kind, found) = (block.words.trim_start_matches("fric "), wrong(&block));
            let fits = match kind {
                "wrong" => codes(&found) == BTreeSet::from([code]),
                _ => found.is_empty(),
            };
            let waits = WAITING.iter().any(|(other, which, _)| (*other, *which) == (code, kind));
            if fits && waits {
                problems += &format!("the {kind} example of {code} came right: take it off the list\n");
            } else if !fits && !waits {
                problems += &format!("{code}, {kind}:\n    {}\n", found.join("\n    "));
            }
        }
    }
    assert!(problems.is_empty(), "\n{problems}");
}

/// Codes in the sources, without tests; and those among them with which a diagnostic is constructed, rather than only
/// listed.
fn codes_in_sources() -> (BTreeSet<String>, BTreeSet<String>) {
    let (mut named, mut given) = (BTreeSet::new(), BTreeSet::new());
    let mut folders: Vec<_> =
        ["grammar/src", "compiler/src", "runtime/src", "src"].map(|folder| root().join(folder)).into();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let text = fs::read_to_string(&path).unwrap_or_default();
            let is_source = path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs");
            let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
            for (at, _) in text.match_indices('"').filter(|_| is_source) {
                let Some(code) = text.get(at + 1..at + 7).and_then(|code| code.strip_suffix('"')) else { continue };
                let numbered = code.starts_with(['E', 'W']) && code[1..].bytes().all(|byte| byte.is_ascii_digit());
                if numbered {
                    named.insert(code.to_string());
                    if !text[..at].ends_with("\", ") {
                        given.insert(code.to_string());
                    }
                }
            }
        }
    }
    (named, given)
}

#[test]
fn every_code_has_a_page_and_every_page_a_code() {
    let all = fs::read_to_string(root().join("docs/errors.md")).unwrap();
    let pages: BTreeSet<String> = pages(&all).into_iter().map(|(code, _)| code.to_string()).collect();
    let (named, given) = codes_in_sources();
    let without: Vec<_> = named.difference(&pages).collect();
    assert!(without.is_empty(), "codes without a page in docs/errors.md: {without:?}");
    let listed: BTreeSet<String> = NOT_GIVEN.iter().map(|(code, _)| code.to_string()).collect();
    let idle: Vec<_> = pages.iter().filter(|code| !named.contains(*code) && !listed.contains(*code)).collect();
    assert!(idle.is_empty(), "pages of codes that nothing gives: {idle:?}");
    let came: Vec<_> = listed.intersection(&given).collect();
    assert!(came.is_empty(), "given by now, take them off the list and write their examples: {came:?}");
}

/// The tables of functions in the manual and in the compiler list the same functions, with the same arguments.
#[test]
fn the_manual_lists_every_function() {
    let page = fs::read_to_string(root().join("docs/language.md")).unwrap();
    let rows = ["numbers", "near 0", "signals", "past", "random numbers"].map(|kind| {
        let row = page.lines().find(|line| line.starts_with(&format!("| {kind} |")));
        row.unwrap_or_else(|| panic!("no row `{kind}`"))
    });
    // Calls and names in code, split at blanks outside parentheses.
    let mut listed: Vec<String> = Vec::new();
    for code in rows.iter().flat_map(|row| row.split('`').skip(1).step_by(2)) {
        let mut open = 0;
        let parts = code.split(|c: char| {
            open += i32::from(c == '(') - i32::from(c == ')');
            c == ' ' && open == 0
        });
        listed.extend(parts.map(str::to_string));
    }
    let mut known = BTreeSet::new();
    for call in &listed {
        let name = call.split('(').next().unwrap();
        let builtin = Builtin::named(name).unwrap_or_else(|| panic!("`{call}` is no function"));
        known.insert(name);
        let example = call.ends_with("(0)");
        if call.contains('(') && !example {
            assert_eq!(*call, builtin.signature().to_string());
        }
    }
    let missing: Vec<&str> = Builtin::all().map(Builtin::name).filter(|name| !known.contains(name)).collect();
    assert!(missing.is_empty(), "not in the manual: {missing:?}");
}
