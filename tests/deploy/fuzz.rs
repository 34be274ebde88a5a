//! Packages with correct hashes and corrupted contents: each is refused by the check or runs without a panic or a hang.
//!
//! `FRIC_CHANGES=10000 cargo test --test deploy changed_packages` tests that many; `FRIC_SEED=n FRIC_CHANGES=1` repeats
//! one.

use crate::{FRIC_RIG, fine, folder, said, text};
use abi::image::Image;
use runtime::package::Package;
use runtime::rng::Chance;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A run of 20 ms in simulated time takes a second or two here, with its start-up.
const PATIENCE: Duration = Duration::from_secs(60);

/// The runtime's generator, with whole numbers by remainder.
struct Dice(Chance);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        (self.0.number() % n as u64) as usize
    }
}

/// Overwrites some bytes: bits, limits, counts, numbers that are not finite.
fn spoil(bytes: &mut Vec<u8>, dice: &mut Dice) {
    let words: [[u8; 8]; 7] = [
        f64::NAN.to_le_bytes(),
        f64::INFINITY.to_le_bytes(),
        (-1e300f64).to_le_bytes(),
        5e-324f64.to_le_bytes(),
        [0; 8],
        [0xff; 8],
        1u64.to_le_bytes(),
    ];
    for _ in 0..[1, 1, 2, 4][dice.below(4)] {
        let at = dice.below(bytes.len());
        let mut put = |new: &[u8]| {
            let end = (at + new.len()).min(bytes.len());
            bytes[at..end].copy_from_slice(&new[..end - at]);
        };
        match dice.below(5) {
            0 => bytes[at] ^= 1 << dice.below(8),
            1 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][dice.below(5)],
            2 => put(&[[0xff; 4], [0; 4], [0xff, 0xff, 0xff, 0x7f], [1, 0, 0, 0]][dice.below(4)]),
            3 => put(&words[dice.below(words.len())]),
            _ => drop(bytes.drain(at..(at + 1 + dice.below(8)).min(bytes.len()))),
        }
    }
}

/// A package with one section changed and its hashes corrected.
fn changed(package: &Package, seed: u64) -> (Package, &'static str) {
    let mut dice = Dice(Chance(seed));
    let mut package = package.clone();
    // Mostly the plan. The description of a program is a promise about its code, which only a signature protects: a
    // change there must not break its readers, and is not run.
    let section = ["rig", "rig", "rig", "rig", "rig", "live", "head", "control", "plant", "name"][dice.below(10)];
    let at = |package: &Package| package.sections.iter().position(|it| it.name == section).unwrap();
    match section {
        "name" => {
            let mut name = package.rig.clone().into_bytes();
            spoil(&mut name, &mut dice);
            package.rig = String::from_utf8_lossy(&name).into_owned();
        }
        "control" | "plant" => {
            let at = at(&package);
            let mut image = Image::read(&package.sections[at].bytes).unwrap();
            let mut bytes = abi::encode::Encode::to_bytes(&image.description);
            spoil(&mut bytes, &mut dice);
            // An invalid description is refused by the reader.
            if let Ok(description) = abi::encode::Encode::from_bytes(&bytes) {
                image.description = description;
                package.sections[at].bytes = image.to_bytes();
            }
        }
        _ => {
            let at = at(&package);
            spoil(&mut package.sections[at].bytes, &mut dice);
        }
    }
    (package, section)
}

/// The output of a command; none if it hangs.
fn within(command: &mut Command) -> Option<Output> {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if begun.elapsed() > PATIENCE {
            let _ = child.kill();
            let _ = child.wait();
            return None;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    Some(child.wait_with_output().unwrap())
}

/// Runs one change. Returns the reason if it is a failure, and whether `check` accepted the package.
fn judged(package: &Package, section: &str, folder: &Path, name: &str) -> Result<bool, String> {
    let bytes = package.to_bytes();
    let accepted = Package::read(&bytes).and_then(|package| package.contents()).is_ok();
    fs::write(folder.join(name), &bytes).unwrap();
    let rig = |args: &[&str]| within(Command::new(&*FRIC_RIG).current_dir(folder).args(args));
    let checked = rig(&["check", name, "--allow-unsigned", "--trusted", "nobody"]).ok_or("check hangs")?;
    match (checked.status.code(), accepted) {
        (Some(0), true) | (Some(1), false) => {}
        _ => return Err(format!("check: {:?}, read: {accepted}\n{}", checked.status, said(&checked))),
    }
    if !accepted || matches!(section, "control" | "plant") {
        return Ok(accepted);
    }
    let log = format!("{name}.friclog");
    let store = format!("{name}.store");
    let run = ["run", name, "--sim", "--fast", "--for", "20ms", "--dir", &store, "--log", &log, "--trusted", "nobody"];
    let ran = rig(&run).ok_or("run hangs")?;
    let _ = fs::remove_file(folder.join(log));
    match ran.status.code() {
        Some(0 | 1 | 3) => Ok(true),
        _ => Err(format!("run: {:?}\n{}", ran.status, said(&ran))),
    }
}

#[test]
fn changed_packages_are_refused_or_run_without_a_panic() {
    let number = |name: &str| std::env::var(name).ok().map(|n| n.parse::<u64>().expect("a number"));
    let (first, count) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_CHANGES").unwrap_or(60));
    let folder = folder("changed");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fine(&folder, &["build", "rig.fric", "-o", "drives.fricpkg"]);
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/rtfs/rtfs.fric");
    fine(&folder, &["build", example.to_str().unwrap(), "-o", "devices.fricpkg"]);
    let read = |name: &str| Package::read(&fs::read(folder.join(name)).unwrap()).unwrap();
    let packages = [read("drives.fricpkg"), read("devices.fricpkg")];
    let (mut accepted, mut failures) = (0, Vec::new());
    for seed in first..first + count {
        let (package, section) = changed(&packages[(seed % 2) as usize], seed);
        match judged(&package, section, &folder, "z.fricpkg") {
            Ok(taken) => accepted += u64::from(taken),
            Err(why) => failures.push(format!("FRIC_SEED={seed} FRIC_CHANGES=1, section {section}: {why}")),
        }
    }
    println!("{count} changes from seed {first}: {accepted} accepted, {} failures", failures.len());
    assert!(failures.is_empty(), "{}", failures.join("\n"));
    assert!(accepted * 20 > count || count < 20, "{accepted} of {count} accepted: the changes reach nothing");
}
