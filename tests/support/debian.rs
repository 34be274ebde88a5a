//! Programs that tests need, from Debian's packages if they are not installed: unpacked below `target/`, not installed.
//! If they are not available, the test fails and reports it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};

/// The folder of unpacked packages, from an earlier run or fetched now. `name`: of the folder. `wanted`: what cannot be
/// tested without them, for the message.
pub fn unpacked(name: &str, packages: &[&str], wanted: &str) -> PathBuf {
    // Tests of one binary run in parallel.
    static ONE: Mutex<()> = Mutex::new(());
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    if folder.is_dir() {
        return folder;
    }
    // Under a temporary name until it is complete.
    let begun = folder.with_extension(format!("begun-{}", std::process::id()));
    let archives = begun.join("archives");
    fs::create_dir_all(archives.join("partial")).expect("target/ can be written");
    let fetch = |own_lists: bool, what: &[&str]| {
        let mut command = Command::new("apt-get");
        command.current_dir(&archives).args(["-q", "-o", "APT::Sandbox::User=root"]);
        if own_lists {
            command.arg("-o").arg(format!("Dir::State::Lists={}", begun.join("lists").display()));
            command.arg("-o").arg(format!("Dir::Cache={}", begun.join("cache").display()));
        }
        command.args(what).output().is_ok_and(|output| output.status.success())
    };
    let download: Vec<&str> = ["download"].into_iter().chain(packages.iter().copied()).collect();
    let fetched = fetch(false, &download) || fetch(true, &["update"]) && fetch(true, &download);
    assert!(fetched, "{wanted}, and apt-get cannot download {}", packages.join(" "));
    for archive in fs::read_dir(&archives).expect("it was just made").flatten() {
        if archive.path().extension().is_some_and(|extension| extension == "deb") {
            done(Command::new("dpkg-deb").arg("-x").arg(archive.path()).arg(&begun), "dpkg-deb");
        }
    }
    fs::remove_dir_all(&archives).expect("target/ can be written");
    // Another test may have been faster: its result is the same.
    if fs::rename(&begun, &folder).is_err() {
        fs::remove_dir_all(&begun).expect("target/ can be written");
    }
    folder
}

/// The path of a program in PATH.
pub fn on_path(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|folder| folder.join(name)).find(|file| file.is_file())
}

/// Runs a command that must succeed.
pub fn done(command: &mut Command, what: &str) {
    let output = command.output().unwrap_or_else(|error| panic!("{what} does not start: {error}"));
    assert!(output.status.success(), "{what}: {}", String::from_utf8_lossy(&output.stderr));
}
