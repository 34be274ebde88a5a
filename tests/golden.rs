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
    check("tests/errors/fit", 5, said_by_fit);
}
