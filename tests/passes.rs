//! The order of the passes is defined by two lists of the compiler. The output of `fric build --emit passes` and the
//! drawing in docs/machine-code.md have the same passes in the same order.

use compiler::codegen::passes::LATE;
use compiler::opt::PASSES;
use std::path::PathBuf;
use std::process::Command;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// All passes of a fixed step, in order.
fn listed() -> Vec<&'static str> {
    let (early, late) = (PASSES.iter().map(|pass| pass.name), LATE.iter().map(|pass| pass.name));
    ["fixed_step"].into_iter().chain(early).chain(["expand"]).chain(late).collect()
}

#[test]
fn the_command_prints_the_lists() {
    for file in ["examples/stick-slip/stick_slip.fric", "stdlib-models/friction/kfm.fric"] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
        command.current_dir(root()).args(["build", file, "--emit", "passes"]);
        if file.ends_with("kfm.fric") {
            command.args(["KFM", "--solver", "rk4"]);
        } else {
            command.args(["Pull", "--solver", "expo"]);
        }
        let output = command.output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let names: Vec<&str> = text.lines().skip(2).filter_map(|line| line.split_whitespace().next()).collect();
        assert_eq!(names, listed(), "{file}: {text}{}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn the_page_draws_them_in_order() {
    let page = std::fs::read_to_string(root().join("docs/machine-code.md")).unwrap();
    let (_, after) = page.split_once("## The pipeline").expect("the page has the section");
    let drawing = after.split("```").nth(1).expect("a drawing");
    let mut names: Vec<&str> = Vec::new();
    for word in drawing.split(|c: char| !(c.is_alphanumeric() || c == '_')) {
        if listed().contains(&word) && !names.contains(&word) {
            names.push(word);
        }
    }
    assert_eq!(names, listed());
}

#[test]
fn each_pass_has_a_module_of_its_name() {
    for (folder, names) in [
        ("opt", PASSES.iter().map(|pass| pass.name).collect::<Vec<_>>()),
        ("codegen", LATE.iter().map(|pass| pass.name).collect()),
    ] {
        for name in names {
            let of = root().join("compiler/src").join(folder);
            assert!(of.join(format!("{name}.rs")).is_file() || of.join(name).is_dir(), "{folder}/{name}");
        }
    }
}
