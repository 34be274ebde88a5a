//! Completion at the cursor.
//!
//! In: a session, a line, the cursor. Out: candidates, those with a matching unit first. Knows no terminal.

use super::command::{COMMANDS, LineKind, read};
use super::session::{Session, library_models};
use crate::compile::nearest;
use abi::unit::{Dimension, Unit};
use grammar::ast::{DeclarationKind, Statement};

/// Most candidates shown.
const MOST: usize = 100;

/// A candidate for the word at the cursor.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Candidate {
    /// The replacement of the word.
    pub text: String,
    /// The replacement with a description: `f.F [N]`.
    pub shown: String,
}

impl Candidate {
    fn plain(text: impl Into<String>) -> Candidate {
        let text = text.into();
        Candidate { shown: text.clone(), text }
    }

    fn with(text: impl Into<String>, note: &str) -> Candidate {
        let text = text.into();
        let shown = if note.is_empty() { text.clone() } else { format!("{text}  {note}") };
        Candidate { text, shown }
    }
}

/// The start of the word at the cursor.
fn word_start(line: &str, cursor: usize) -> usize {
    let before = &line[..cursor];
    let of_word = |c: char| c.is_alphanumeric() || matches!(c, '_' | '.' | '[' | ']');
    let start = before.trim_end_matches(of_word).len();
    // A digit begins a number, not a name.
    if before[start..].starts_with(|c: char| c.is_ascii_digit()) { cursor } else { start }
}

/// Whether a file name is expected at the cursor: after `use`, `save`, `watch`, `to`.
pub fn wants_file(line: &str, cursor: usize) -> bool {
    let before = line[..cursor].trim_start();
    let file = |word: &str| before.strip_prefix(word).is_some_and(|rest| rest.starts_with([' ', '"']));
    ["use", "save", "watch"].into_iter().any(file) && !before.contains("std") || before.contains(" to ")
}

/// Candidates for the word at the cursor, and the start of that word.
pub fn candidates(session: &Session, line: &str, cursor: usize) -> (usize, Vec<Candidate>) {
    let start = word_start(line, cursor);
    if line[..cursor].ends_with(|c: char| c.is_ascii_digit()) && start == cursor {
        return (cursor, Vec::new()); // in a number
    }
    let (before, word) = (&line[..start], &line[start..cursor]);
    let trimmed = before.trim();
    let mut found = match trimmed {
        "" => at_begin(session, word),
        "run" | "watch" => runnable(session),
        "explain" | "doc" | "diagram" | "characterise" => models(session).chain(paths(session, None, word)).collect(),
        "unit" | "deps" => paths(session, None, word).collect(),
        "help" => commands().collect(),
        _ => match argument_of(before) {
            Some(model) => arguments(session, &model),
            None if model_follows(trimmed) => models(session).collect(),
            None => {
                let wanted = wanted(session, line, start, cursor);
                paths(session, wanted, word)
                    .chain(models(session).filter(|_| word.starts_with(char::is_uppercase)))
                    .collect()
            }
        },
    };
    found.retain(|candidate| candidate.text.starts_with(word) && candidate.text != word);
    let mut seen = std::collections::HashSet::new();
    found.retain(|candidate| seen.insert(candidate.text.clone()));
    found.truncate(MOST);
    (start, found)
}

fn commands() -> impl Iterator<Item = Candidate> {
    COMMANDS.iter().filter(|(name, ..)| !name.is_empty()).map(|(name, ..)| Candidate::plain(*name))
}

fn at_begin(session: &Session, word: &str) -> Vec<Candidate> {
    let names = session.instances().into_iter().map(|(name, what)| Candidate::with(name, &what));
    let paths: Vec<Candidate> = if word.contains('.') { paths(session, None, word).collect() } else { Vec::new() };
    names.chain(paths).chain(commands()).collect()
}

fn runnable(session: &Session) -> Vec<Candidate> {
    let experiments = session.experiments().into_iter().map(|name| Candidate::with(name, "experiment"));
    let instances = session.instances().into_iter().map(|(name, what)| Candidate::with(name, &what));
    experiments.chain(instances).collect()
}

fn models(session: &Session) -> impl Iterator<Item = Candidate> + use<> {
    let mut names = session.models();
    names.extend(library_models().into_iter().map(str::to_string));
    names.sort_unstable();
    names.dedup();
    names.into_iter().map(Candidate::plain)
}

/// Whether a model is expected: `f =`, `f = rotary`.
fn model_follows(before: &str) -> bool {
    let before = before.strip_suffix("rotary").unwrap_or(before).trim_end();
    let Some(name) = before.strip_suffix('=') else { return false };
    matches!(read(&format!("{name}= M()")), LineKind::Instance(..)) && !name.contains('.')
}

/// The model whose argument name is expected: `LuGre(` or `LuGre(Fs = 2 N, `.
fn argument_of(before: &str) -> Option<String> {
    let mut depth = 0;
    for (at, c) in before.char_indices().rev() {
        match c {
            ')' => depth += 1,
            '(' if depth > 0 => depth -= 1,
            '(' => {
                let name = before[..at].rsplit(|c: char| !c.is_alphanumeric() && c != '_').next()?;
                let due = before.trim_end().ends_with(['(', ',']);
                return (due && name.starts_with(|c: char| c.is_ascii_uppercase())).then(|| name.to_string());
            }
            _ => {}
        }
    }
    None
}

/// Parameters, inputs, states (their initial values) and slots of a model, with ` = `.
fn arguments(session: &Session, model: &str) -> Vec<Candidate> {
    let mut with_library = session.clone();
    with_library.bring_in(model);
    let Some(model) = with_library.model(model) else { return Vec::new() };
    let argument = |statement: &Statement| match statement {
        Statement::Declaration(d)
            if matches!(d.kind, DeclarationKind::Param | DeclarationKind::Input | DeclarationKind::State) =>
        {
            let unit = d.unit.as_ref().map_or(String::new(), |unit| format!("[{}]", unit.text));
            let doc = d.doc.as_deref().unwrap_or_default().lines().next().unwrap_or_default();
            let note = format!("{unit} {doc}");
            Some(Candidate { text: format!("{} = ", d.name.text), shown: format!("{} = {}", d.name.text, note.trim()) })
        }
        Statement::Part(part) if part.slot.is_some() => Some(Candidate::plain(format!("{} = ", part.name.text))),
        _ => None,
    };
    model.body.iter().filter_map(argument).collect()
}

/// The dimension of a unit as shown; none for truth values.
fn dimension(unit: &str) -> Option<Dimension> {
    Unit::parse(if unit.is_empty() { "1" } else { unit }).ok().map(|unit| unit.dimension)
}

fn unit_of(unit: &str) -> String {
    if unit.is_empty() { String::new() } else { format!("[{unit}]") }
}

/// Quantities whose path begins with a word; those of a dimension first.
fn paths(session: &Session, wanted: Option<Dimension>, word: &str) -> impl Iterator<Item = Candidate> + use<> {
    let mut all: Vec<(bool, Candidate)> = session
        .quantities()
        .filter(|q| q.path.starts_with(word))
        .map(|q| {
            let doc = q.doc.as_deref().unwrap_or_default().lines().next().unwrap_or_default();
            let fits = wanted.is_none_or(|wanted| dimension(&q.unit) == Some(wanted));
            (fits, Candidate::with(q.path.clone(), format!("{} {doc}", unit_of(&q.unit)).trim()))
        })
        .collect();
    all.sort_by_key(|(fits, _)| !fits);
    all.into_iter().map(|(_, candidate)| candidate)
}

/// The dimension expected for the word at the cursor.
fn wanted(session: &Session, line: &str, start: usize, cursor: usize) -> Option<Dimension> {
    if let LineKind::Setting(path, begin) = read(&line[..start]) {
        let set = session.quantities().find(|q| q.path == path).and_then(|q| dimension(&q.unit));
        if line[begin.min(start)..start].trim().is_empty() {
            return set;
        }
    }
    let line = match read(line) {
        LineKind::Command(_, rest) => {
            let at = line.len() - line.trim_start().len() + line.trim().len() - rest.len();
            format!("{}?", &line[at.min(start)..start])
        }
        _ => format!("{}?", &line[..start]),
    };
    let _ = cursor;
    session.wanted(&line)
}

/// The hint shown in grey after the cursor: the usage of a command, or a description of a quantity.
pub fn hint(session: &Session, line: &str) -> Option<String> {
    let word = line.trim();
    if word.is_empty() {
        return None;
    }
    if let Some((_, usage, _)) = COMMANDS.iter().find(|(name, ..)| *name == word) {
        let rest = usage.strip_prefix(word)?;
        let rest = if line.ends_with(' ') { rest.trim_start() } else { rest };
        return (!rest.is_empty()).then(|| rest.to_string());
    }
    if !word.contains('.') {
        return None;
    }
    let q = session.quantities().find(|q| q.path == word)?;
    let doc = q.doc.as_deref().unwrap_or_default().lines().next().unwrap_or_default();
    let (unit, doc) = (unit_of(&q.unit), if doc.is_empty() { String::new() } else { format!(" {doc}") });
    Some(format!(" {unit}{doc}")).filter(|hint| !hint.trim().is_empty())
}

/// The closest command name.
pub fn meant(word: &str) -> Option<&'static str> {
    nearest(word, COMMANDS.iter().map(|(name, ..)| *name).filter(|name| !name.is_empty()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(session: &Session, line: &str) -> Vec<String> {
        candidates(session, line, line.len()).1.into_iter().map(|candidate| candidate.text).collect()
    }

    fn lugre() -> Session {
        let mut session = Session::default();
        session.bring_in("LuGre");
        assert!(session.add_part("f", "LuGre()").is_ok());
        session
    }

    #[test]
    fn names_whose_unit_fits_come_first() {
        let session = lugre();
        let forces = texts(&session, "f.F + f.");
        let first: Vec<&str> = forces.iter().take(4).map(String::as_str).collect();
        for name in ["f.Fc", "f.Fs", "f.F"] {
            assert!(first.contains(&name), "{forces:?}");
        }
        let velocities = texts(&session, "f.v + f.");
        assert!(velocities[0] == "f.v" || velocities[0] == "f.vs" || velocities[0] == "f.vd", "{velocities:?}");
    }

    #[test]
    fn models_arguments_commands_and_experiments_are_proposed_where_they_can_stand() {
        let session = lugre();
        assert!(texts(&session, "g = Kar").contains(&"Karnopp".to_string()));
        assert!(texts(&session, "g = LuGre(sig").contains(&"sigma0 = ".to_string()));
        assert!(texts(&session, "g = LuGre(Fs = 2 N, v").contains(&"vs = ".to_string()));
        assert_eq!(texts(&session, "expl"), ["explain"]);
        assert_eq!(texts(&session, "run "), ["f"]);
        assert!(texts(&session, "f = LuGre(Fs = 2").is_empty());
    }

    #[test]
    fn hints_say_how_a_command_goes_on() {
        let session = lugre();
        assert_eq!(hint(&session, "step").as_deref(), Some(" 1 ms"));
        assert!(hint(&session, "f.Fs").is_some_and(|hint| hint.contains("[N]")));
        assert_eq!(hint(&session, "f.nothing"), None);
    }
}
