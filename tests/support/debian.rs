//! Programs that tests need, from Debian's packages if they are not installed: unpacked below `target/`, not installed.
//! If they are not available, the test fails and reports it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};

/// The folder of unpacked packages, from an earlier run or fetched now. `name`: of the folder. `omitted`: patterns of
/// files that no test uses, where a package is large. `wanted`: what cannot be tested without them, for the message.
#[allow(dead_code, reason = "not every test that shares this file")]
pub fn unpacked(name: &str, packages: &[&str], omitted: &[&str], wanted: &str) -> PathBuf {
    fetched(name, packages, omitted, false, wanted)
}

/// The same of a package with those that it needs and this system lacks.
#[allow(dead_code, reason = "not every test that shares this file")]
pub fn unpacked_with_dependencies(name: &str, package: &str, wanted: &str) -> PathBuf {
    fetched(name, &[package], &[], true, wanted)
}

/// What no test reads in any package.
const DOCUMENTATION: [&str; 4] = ["./usr/share/doc", "./usr/share/man", "./usr/share/locale", "./usr/share/info"];

fn fetched(name: &str, packages: &[&str], omitted: &[&str], dependencies: bool, wanted: &str) -> PathBuf {
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
    for folder in ["archives", "lists", "cache/archives"] {
        fs::create_dir_all(begun.join(folder).join("partial")).expect("target/ can be written");
    }
    // The output of apt-get, if it succeeds.
    let apt = |own_lists: bool, what: &[&str], packages: &[&str]| {
        let mut command = Command::new("apt-get");
        command.current_dir(&archives).args(["-q", "-o", "APT::Sandbox::User=root"]);
        if own_lists {
            command.arg("-o").arg(format!("Dir::State::Lists={}", begun.join("lists").display()));
            command.arg("-o").arg(format!("Dir::Cache={}", begun.join("cache").display()));
        }
        let output = command.args(what).args(packages).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let fetch = |own_lists: bool| {
        let needed = match dependencies {
            true => apt(own_lists, &["-s", "--no-install-recommends", "install"], packages)?,
            false => String::new(),
        };
        let needed = needed.lines().filter_map(|line| line.strip_prefix("Inst ")?.split(' ').next());
        let mut all: Vec<&str> = packages.iter().copied().chain(needed).collect();
        all.sort_unstable();
        all.dedup();
        apt(own_lists, &["download"], &all)
    };
    let fetched = fetch(false).or_else(|| apt(true, &["update"], &[]).and_then(|_| fetch(true))).is_some();
    assert!(fetched, "{wanted}, and apt-get cannot download {}", packages.join(" "));
    for archive in fs::read_dir(&archives).expect("it was just made").flatten() {
        if archive.path().extension().is_some_and(|extension| extension == "deb") {
            let mut package = Command::new("dpkg-deb");
            package.arg("--fsys-tarfile").arg(archive.path()).stdout(Stdio::piped());
            let mut package = package.spawn().unwrap_or_else(|error| panic!("dpkg-deb does not start: {error}"));
            let files = package.stdout.take().expect("it is piped");
            let omitted = DOCUMENTATION.iter().chain(omitted).map(|pattern| format!("--exclude={pattern}"));
            done(Command::new("tar").arg("-xC").arg(&begun).args(omitted).stdin(files), "tar");
            assert!(package.wait().is_ok_and(|status| status.success()), "dpkg-deb cannot read {:?}", archive.path());
        }
    }
    for folder in ["archives", "lists", "cache"] {
        fs::remove_dir_all(begun.join(folder)).expect("target/ can be written");
    }
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
