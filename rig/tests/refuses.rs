//! What the small program refuses, as an operator meets it.

use runtime::package::{Package, here};
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn rig(args: &[&str], dir: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric-rig"));
    command.current_dir(dir).args(args).output().unwrap()
}

#[track_caller]
fn refuses(args: &[&str], dir: &Path, why: &str) {
    let output = rig(args, dir);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && told.contains(why), "{args:?}: {:?}\n{told}", output.status);
}

#[test]
fn what_is_no_package_of_this_computer_is_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let package = Package { fric: env!("CARGO_PKG_VERSION").into(), target: here(), rig: "r".into(), sections: vec![] };
    let write = |name: &str, bytes: &[u8]| fs::write(dir.join(name), bytes).unwrap();
    refuses(&["check", "none.fricpkg"], dir, "none.fricpkg: No such file");
    write("text.fricpkg", b"hello");
    refuses(&["check", "text.fricpkg"], dir, "text.fricpkg: it is no package: `fric build RIG.fric -o NAME.fricpkg`");
    let bytes = package.to_bytes();
    write("half.fricpkg", &bytes[..bytes.len() - 1]);
    refuses(&["check", "half.fricpkg"], dir, "the copy is not whole");
    refuses(&["install", "half.fricpkg", "--dir", "store"], dir, "the copy is not whole");
    assert!(!dir.join("store").exists(), "nothing is made for what is refused");
    let mut flipped = bytes.clone();
    let last = flipped.len() - 1;
    flipped[last] ^= 4;
    write("flipped.fricpkg", &flipped);
    refuses(&["check", "flipped.fricpkg"], dir, "its hash differs");
    write("empty.fricpkg", &bytes);
    refuses(&["check", "empty.fricpkg"], dir, "its section `control` is missing");
    write("other.fricpkg", &Package { target: "s390x-linux".into(), ..package.clone() }.to_bytes());
    refuses(&["check", "other.fricpkg"], dir, "it is for s390x-linux, and this is");
    write("old.fricpkg", &Package { fric: "0.0.1".into(), ..package.clone() }.to_bytes());
    refuses(&["check", "old.fricpkg"], dir, "fric 0.0.1 made it");
    let mut damaged = package;
    damaged.add("control", b"FRICCODE and nothing more".to_vec());
    write("damaged.fricpkg", &damaged.to_bytes());
    refuses(&["check", "damaged.fricpkg"], dir, "its program `control`");
    refuses(&["run", "--dir", "store"], dir, "store/current");
    refuses(&["rollback", "--dir", "store"], dir, "there is no package before the current one");
    refuses(&["say", "arm", "--dir", "store"], dir, "no rig runs in store");
}

#[test]
fn wrong_usage_is_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    for args in [
        &["run", "--for", "10"][..],
        &["run", "--bus", "can0"],
        &["say", "dance"],
        &["run", "--fast"],
        &["run", "--sim", "--fast"],
        &[],
    ] {
        assert_eq!(rig(args, folder.path()).status.code(), Some(2), "{args:?}");
    }
}

#[test]
fn the_doctor_names_what_is_missing_with_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let output = rig(&["doctor"], folder.path());
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success());
    assert!(told.lines().count() >= 5, "{told}");
    for line in told.lines().filter(|line| line.starts_with('✗')) {
        assert!(line.contains(": "), "no remedy: {line}");
    }
}
