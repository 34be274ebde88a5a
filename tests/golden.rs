//! Golden messages: `fric check CODE.fric` prints exactly `CODE.txt`; in the folder `fit`, `fric fit CODE.fric` does.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The output of `fric check` for a text, without the summary line.
fn said(folder: &Path, code: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    let output =
        command.current_dir(folder).args(["check", &format!("{code}.fric")]).env("NO_COLOR", "1").output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let (messages, _) = text.trim_end().rsplit_once('\n').unwrap_or_default();
    format!("{}\n", messages.trim_end())
}

/// What `fric fit` reports about a text.
fn said_by_fit(folder: &Path, code: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("golden");
    command.current_dir(folder).args(["fit", &format!("{code}.fric"), "--out"]).arg(out).env("NO_COLOR", "1");
    let text = String::from_utf8(command.output().unwrap().stderr).unwrap();
    format!("{}\n", text.trim_end())
}

/// Compares all texts of a folder with what is said about them.
fn check(folder: &str, least: usize, said: fn(&Path, &str) -> String) {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut codes: Vec<String> = fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "txt"))
        .map(|path| path.file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    codes.sort();
    assert!(codes.len() >= least, "{codes:?}");
    let mut problems = String::new();
    for code in &codes {
        let wanted = fs::read_to_string(folder.join(format!("{code}.txt"))).unwrap();
        let found = said(&folder, code);
        if found != wanted {
            problems += &format!("{code}: wanted\n{wanted}found\n{found}\n");
        }
    }
    assert!(problems.is_empty(), "\n{problems}");
}

#[test]
fn messages_are_golden_to_the_letter() {
    check("tests/errors", 15, said);
}

#[test]
fn messages_of_fits_are_golden_to_the_letter() {
    check("tests/errors/fit", 19, said_by_fit);
}

/// A text with a habit of another tool, and what is said about it.
struct Habit {
    name: String,
    /// The line of the mistake.
    line: usize,
    text: String,
    said: String,
}

/// The cases of `tests/errors/habits/reports.txt`: `=== NAME, line N`, the text, `---`, the report.
fn habits(all: &str) -> Vec<Habit> {
    let cases = all.split("=== ").skip(1);
    let one = |case: &str| {
        let (head, rest) = case.split_once('\n').expect("a heading");
        let (name, line) = head.split_once(", line ").expect("`=== NAME, line N`");
        let (text, said) = rest.split_once("---\n").expect("a text, `---`, a report");
        Habit { name: name.into(), line: line.parse().expect("a line"), text: text.into(), said: said.into() }
    };
    cases.map(one).collect()
}

/// Mistakes of somebody who knows MATLAB, Simulink or Modelica: each report is golden, begins at the line of the
/// mistake, and says what to write. `BLESS=1 cargo test --test golden` writes the reports: read the difference, and judge
/// each without knowledge of the code.
///
/// Mutant tried by hand: the list of foreign statements is not asked (`while-loop`, `persistent`, … lack their remedy).
#[test]
fn habits_of_other_tools_get_position_cause_and_remedy() {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/errors/habits/reports.txt");
    let all = fs::read_to_string(&path).unwrap();
    let (intro, _) = all.split_once("=== ").unwrap();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("habits");
    fs::create_dir_all(&folder).unwrap();
    let (mut problems, mut blessed) = (String::new(), intro.to_string());
    let cases = habits(&all);
    assert!(cases.len() >= 60, "{}", cases.len());
    for Habit { name, line, text, said: wanted } in cases {
        fs::write(folder.join(format!("{name}.fric")), &text).unwrap();
        let found = said(&folder, &name);
        blessed += &format!("=== {name}, line {line}\n{text}---\n{found}\n");
        let place = found.split_once(&format!("[{name}.fric:")).and_then(|(_, rest)| rest.split_once(':'));
        let place = place.and_then(|(first, _)| first.parse::<usize>().ok());
        if place != Some(line) {
            problems += &format!("{name}: the first message is not at line {line}:\n{found}\n");
        }
        let remedies = found.matches("help:").count();
        let reports = found.lines().filter(|line| line.starts_with(['E', 'W']) && line.len() == 5).count();
        if remedies == 0 || reports != 1 {
            problems += &format!("{name}: {reports} messages, {remedies} with a remedy:\n{found}\n");
        }
        if found.trim_end() != wanted.trim_end() {
            problems += &format!("{name}: wanted\n{wanted}found\n{found}\n");
        }
    }
    if std::env::var_os("BLESS").is_some() {
        fs::write(&path, blessed.trim_end().to_string() + "\n").unwrap();
    }
    assert!(problems.is_empty(), "\n{problems}");
}
