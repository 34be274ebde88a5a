//! The exercise of `docs/course.md` works as it is typed: its texts go to the end of one file, its commands run in a
//! folder of their own, and each ends with the exit code that the page states, by default 0.

use std::fs;
use std::path::Path;
use std::process::Command;

/// The code blocks of a page: the word after the fence, and the text.
fn blocks(page: &str) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    let mut inside = false;
    for line in page.lines() {
        match line.strip_prefix("```") {
            Some(word) => {
                inside = !inside;
                if inside {
                    found.push((word.into(), String::new()));
                }
            }
            None if inside => {
                let (_, text) = found.last_mut().unwrap();
                text.push_str(line);
                text.push('\n');
            }
            None => {}
        }
    }
    found
}

/// The words of a command line; single quotes keep blanks.
fn words(line: &str) -> Vec<String> {
    let mut all = Vec::new();
    for (k, part) in line.split('\'').enumerate() {
        match k % 2 {
            0 => all.extend(part.split_whitespace().map(str::to_string)),
            _ => all.push(part.to_string()),
        }
    }
    all
}

#[test]
fn every_command_of_the_course_works() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("course");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    let page = fs::read_to_string(root.join("docs/course.md")).unwrap();
    let (mut text, mut commands, mut wrong) = (String::new(), 0, Vec::new());
    for (word, block) in blocks(&page) {
        match word.as_str() {
            "fric" => {
                text += &block;
                text += "\n";
                fs::write(folder.join("lab.fric"), &text).unwrap();
                let spoilt = text.replacen("output F [N] = k * z", "output F [N] = k * z + v", 1);
                assert_ne!(spoilt, text, "the page's mistake has a place");
                fs::write(folder.join("spoilt.fric"), spoilt).unwrap();
            }
            "sh" => {
                for line in block.lines() {
                    let (line, comment) = line.split_once('#').unwrap_or((line, ""));
                    let expected = comment.trim().strip_prefix("exit ").map_or(0, |code| code.parse().unwrap());
                    let args = words(line);
                    assert_eq!(args[0], "fric", "{line}");
                    let out = Command::new(env!("CARGO_BIN_EXE_fric"))
                        .args(&args[1..])
                        .current_dir(&folder)
                        .output()
                        .unwrap();
                    commands += 1;
                    if out.status.code() != Some(expected) {
                        let shown =
                            String::from_utf8_lossy(&out.stdout).into_owned() + &String::from_utf8_lossy(&out.stderr);
                        wrong.push(format!("{line}: exit {:?}, not {expected}\n{shown}", out.status.code()));
                    }
                }
            }
            other => panic!("a block of `{other}`"),
        }
    }
    assert!(wrong.is_empty(), "{} of {commands} commands:\n{}", wrong.len(), wrong.join("\n"));
    assert!(commands > 10, "{commands} commands");
}
