//! The library, the examples and the library's own tests: every text passes `check`, is in canonical layout, and meets
//! its expectations.

use std::process::Command;

/// Runs `fric` on folders and expects success.
fn check(args: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_fric"))
        .args(args)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("fric runs");
    let (told, complained) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "fric {}\n{told}\n{complained}", args.join(" "));
}

#[test]
fn texts_are_without_errors() {
    check(&["check", "stdlib-models", "examples", "tests/stdlib"]);
}

#[test]
fn texts_are_in_their_canonical_layout() {
    check(&["fmt", "--check", "stdlib-models", "examples", "tests/stdlib"]);
}

#[test]
fn library_experiments_pass() {
    check(&["test", "stdlib-models"]);
}

#[test]
fn examples_pass() {
    check(&["test", "examples"]);
}

#[test]
fn properties_of_the_library_hold() {
    check(&["test", "tests/stdlib"]);
}
