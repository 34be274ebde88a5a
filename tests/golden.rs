//! Golden messages: `fric check CODE.fric` prints exactly `CODE.txt`.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

/// The output of `fric check` for a text, without the summary line.
fn said(folder: &PathBuf, code: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    let output =
        command.current_dir(folder).args(["check", &format!("{code}.fric")]).env("NO_COLOR", "1").output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let (messages, _) = text.trim_end().rsplit_once('\n').unwrap_or_default();
    format!("{}\n", messages.trim_end())
}

#[test]
fn messages_are_golden_to_the_letter() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/errors");
    let mut codes: Vec<String> = fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "txt"))
        .map(|path| path.file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    codes.sort();
    assert!(codes.len() >= 15, "{codes:?}");
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
