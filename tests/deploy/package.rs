//! Contents of packages: equal bytes for equal texts, every bit verified, signed, and equal results on other
//! processors.

use crate::{FRIC_RIG, debian, emulator, fails, fine, folder, fric, said, text};
use abi::encode::Encode;
use abi::image::Image;
use abi::rig::Rig;
use abi::{Function, Slot};
use runtime::package::Package;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

#[test]
fn two_builds_give_equal_bytes_and_no_bit_may_differ() {
    let folder = folder("bits");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    for name in ["a.fricpkg", "b.fricpkg"] {
        fine(&folder, &["build", "rig.fric", "--target", "x86_64-linux", "-o", name]);
    }
    let bytes = fs::read(folder.join("a.fricpkg")).unwrap();
    assert!(bytes == fs::read(folder.join("b.fricpkg")).unwrap(), "two builds differ");
    let shown = fine(&folder, &["inspect", "a.fricpkg"]);
    for word in ["rtfs", "x86_64-linux", "control", "plant", "source/rig.fric", "source/std.friction.lugre.fric"] {
        assert!(shown.contains(word), "{word}\n{shown}");
    }
    assert!(fine(&folder, &["inspect", "--sources", "a.fricpkg"]).contains("overspeed"));
    assert!(Package::read(&bytes).is_ok());
    // Positions throughout the file, each with another bit: the same every time.
    let mut at = 1usize;
    for k in 0..500 {
        at = (at * 48_271 + k) % bytes.len();
        let mut changed = bytes.clone();
        changed[at] ^= 1 << (k % 8);
        assert!(Package::read(&changed).is_err(), "byte {at}, bit {}", k % 8);
    }
    fs::write(folder.join("half.fricpkg"), &bytes[..bytes.len() / 2]).unwrap();
    fails(&folder, &["inspect", "half.fricpkg"], "the copy is not whole");
    let arm = fine(&folder, &["build", "rig.fric", "--target", "aarch64-linux", "-o", "arm.fricpkg"]);
    assert!(arm.contains("for aarch64-linux"), "{arm}");
    assert!(fine(&folder, &["inspect", "arm.fricpkg"]).contains("bytes of code for aarch64"));
}

#[test]
fn a_package_is_signed_and_its_signer_named() {
    let folder = folder("signed");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fine(&folder, &["key", "new", "keys/anna"]);
    fails(&folder, &["key", "new", "keys/anna"], "is there already: a key is not written over");
    fine(&folder, &["build", "rig.fric", "--sign", "keys/anna.key", "-o", "a.fricpkg"]);
    assert!(fine(&folder, &["inspect", "--trusted", "keys", "a.fricpkg"]).contains("signed by anna"));
    fine(&folder, &["build", "rig.fric", "-o", "a.fricpkg"]);
    fails(
        &folder,
        &["inspect", "--trusted", "keys", "a.fricpkg"],
        "it is not signed, and this computer trusts anna only",
    );
}

#[test]
fn unpackable_rigs_are_reported() {
    let folder = folder("told");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fs::write(folder.join("model.fric"), "model M {\n  output F [N] = 1 N\n}\n").unwrap();
    fails(&folder, &["build", "model.fric", "-o", "a.fricpkg"], "model.fric has no rig");
    fails(&folder, &["build", "rig.fric", "rtfz", "-o", "a.fricpkg"], "has no rig `rtfz`; did you mean `rtfs`?");
    fails(&folder, &["build", "rig.fric", "--sign", "none.key", "-o", "a.fricpkg"], "cannot read none.key");
    assert!(!folder.join("a.fricpkg").exists(), "nothing is written where something is wrong");
}

/// The stock tool, and the folder of its library.
fn minisign() -> Command {
    if let Some(installed) = debian::on_path("minisign") {
        return Command::new(installed);
    }
    let wanted = "signatures cannot be tried with the stock tool: there is no minisign";
    let usr = debian::unpacked("minisign-tools", &["minisign", "libsodium23"], &[], wanted).join("usr");
    let mut command = Command::new(usr.join("bin/minisign"));
    let library = fs::read_dir(usr.join("lib")).unwrap().next().expect("a folder of libraries").unwrap().path();
    command.env("LD_LIBRARY_PATH", library);
    command
}

#[test]
fn the_stock_tool_checks_our_signatures_and_we_check_its() {
    let folder = folder("minisign");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fine(&folder, &["key", "new", "ours/anna"]);
    fine(&folder, &["build", "rig.fric", "--sign", "ours/anna.key", "-o", "a.fricpkg"]);
    let stock = |args: &[&str]| minisign().current_dir(&folder).args(args).output().unwrap();
    let verify = |key: &str| stock(&["-V", "-p", key, "-m", "a.fricpkg"]);
    let told = verify("ours/anna.pub");
    assert!(
        told.status.success() && said(&told).contains("Signature and comment signature verified"),
        "{}",
        said(&told)
    );
    assert!(said(&told).contains("Trusted comment: rig rtfs, "), "{}", said(&told));

    // A key pair of the stock tool signs and is trusted in the same way; and its signatures are valid.
    fs::create_dir(folder.join("theirs")).unwrap();
    let made = stock(&["-G", "-W", "-p", "theirs/bert.pub", "-s", "theirs/bert.key"]);
    assert!(made.status.success(), "{}", said(&made));
    let foreign = verify("theirs/bert.pub");
    assert!(!foreign.status.success(), "{}", said(&foreign));
    fine(&folder, &["build", "rig.fric", "--sign", "theirs/bert.key", "-o", "a.fricpkg"]);
    let told = verify("theirs/bert.pub");
    assert!(told.status.success(), "{}", said(&told));
    let signed = stock(&["-S", "-W", "-s", "theirs/bert.key", "-m", "a.fricpkg"]);
    assert!(signed.status.success(), "{}", said(&signed));
    let shown = fine(&folder, &["inspect", "--trusted", "theirs", "a.fricpkg"]);
    assert!(shown.contains("signed by bert"), "{shown}");
    let checked =
        Command::new(&*FRIC_RIG).current_dir(&folder).args(["check", "a.fricpkg", "--trusted", "theirs"]).output();
    assert!(said(&checked.unwrap()).contains("signed by bert"));

    let mut bytes = fs::read(folder.join("a.fricpkg")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(folder.join("a.fricpkg"), bytes).unwrap();
    let told = verify("theirs/bert.pub");
    assert!(!told.status.success(), "{}", said(&told));
}

#[test]
fn a_package_says_what_its_code_uses_and_what_was_set() {
    let folder = folder("features");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    let target = ["--target", "x86_64-linux"];
    let build = |more: &[&str], out: &str| -> String {
        let words = [&["build", "rig.fric", "-o", out], &target[..], more].concat();
        fine(&folder, &words)
    };
    build(&[], "plain.fricpkg");
    build(&["--features", "avx2,BMI1", "--set", "fr.Fs=0.5N*m"], "more.fricpkg");
    let image = |file: &str| Image::read(&program(&folder.join(file), "control")).unwrap();
    let (plain, more) = (image("plain.fricpkg"), image("more.fricpkg"));
    let names = |image: &Image| image.features.iter().map(|feature| feature.name()).collect::<Vec<_>>().join(" ");
    assert_eq!(names(&plain), "SSE3 SSSE3 SSE4.1 SSE4.2 AVX FMA");
    assert_eq!(names(&more), "SSE3 SSSE3 SSE4.1 SSE4.2 AVX FMA AVX2 BMI1");
    let at = plain.description.quantity("fr.Fs").unwrap().slot.index() - plain.description.layout.params.start as usize;
    assert_eq!((plain.params[at], more.params[at]), (0.42, 0.5));
    let shown = fine(&folder, &["inspect", "more.fricpkg"]);
    assert!(shown.contains("AVX2, BMI1") && shown.contains("fr.Fs=0.5N*m"), "{shown}");
    let sim = ["run", "more.fricpkg", "--sim", "--fast", "--for", "1s", "--log", "more.friclog", "--dir", "there"];
    let ran = Command::new(&*FRIC_RIG).current_dir(&folder).args(sim).output().unwrap();
    assert!(ran.status.success(), "{}", said(&ran));
    assert!(fine(&folder, &["replay", "more.friclog"]).contains("agree to the bit"), "what was set is in the log");

    let arm = ["build", "rig.fric", "--target", "aarch64-linux", "--features", "avx2", "-o", "arm.fricpkg"];
    fails(&folder, &arm, "code for aarch64 uses its base alone");
    for (words, why) in [
        (&["--features", "avx3"][..], "the features are sse3, "),
        (&["--solver", "rk4"], "a rig has its own step and solver"),
    ] {
        let output = fric(&folder, &[&["build", "rig.fric", "-o", "x.fricpkg"], words].concat());
        assert!(output.status.code() == Some(2) && said(&output).contains(why), "{words:?}: {}", said(&output));
    }
}

/// One of the programs of a package.
fn program(path: &Path, name: &str) -> Vec<u8> {
    let package = Package::read(&fs::read(path).unwrap()).unwrap();
    package.section(name).unwrap().to_vec()
}

/// The number k of a sequence in -1 .. 1.
fn chance(k: u64) -> f64 {
    (abi::random::finalised(k.wrapping_mul(abi::random::GAMMA)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// Blocks after the functions of a program.
type Blocks = Vec<Vec<f64>>;

/// Both programs of a rig's package, stepped from several starts with random inputs, held during a step as readings
/// are.
#[test]
fn a_package_for_arm_runs_to_the_bit_as_one_for_x86() {
    const STARTS: u64 = 8;
    const STEPS: u64 = 400;
    const CALLS: [Function; 4] = [Function::Start, Function::Transitions, Function::Outputs, Function::Step];
    let folder = folder("arm");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    let build = |target: &str| -> PathBuf {
        fine(&folder, &["build", "rig.fric", "--target", target, "-o", &format!("{target}.fricpkg")]);
        folder.join(format!("{target}.fricpkg"))
    };
    let (arm, intel) = (build("aarch64-linux"), build("x86_64-linux"));
    let plan = |path: &Path| program(path, "rig");
    assert!(plan(&arm) == plan(&intel), "the plan of a rig knows no processor");
    let period = Rig::from_bytes(&plan(&arm)).unwrap().period_ns as f64 * 1e-9;
    let names = ["control", "plant"];

    let starts = |image: &Image| -> Blocks {
        let layout = &image.description.layout;
        let one = |start: u64| {
            let mut block = vec![0.0; layout.size()];
            block[Slot::STEP.index()] = period;
            block[layout.params.range()].copy_from_slice(&image.params);
            for (k, slot) in layout.inputs.range().enumerate() {
                block[slot] = chance(1000 * start + k as u64);
            }
            block
        };
        (0..STARTS).map(one).collect()
    };
    // As tests/agreement/harness.c reads it.
    let mut cases: Vec<u8> = Vec::new();
    let number = |cases: &mut Vec<u8>, n: u64| cases.extend(n.to_le_bytes());
    number(&mut cases, names.len() as u64);
    let mut expected: Vec<(&str, u64, Vec<f64>)> = Vec::new();
    for name in names {
        let bytes = program(&arm, name);
        let image = Image::read(&bytes).unwrap();
        let calls: Vec<Function> =
            CALLS.into_iter().filter(|function| image.entries[*function as usize].is_some()).collect();
        let count = |function: Function| if function == Function::Step { STEPS } else { 1 };
        number(&mut cases, bytes.len() as u64);
        cases.extend(&bytes);
        let begin = starts(&image);
        number(&mut cases, begin[0].len() as u64);
        number(&mut cases, begin.len() as u64);
        for block in &begin {
            number(&mut cases, calls.len() as u64);
            for function in &calls {
                number(&mut cases, *function as u64);
                number(&mut cases, count(*function));
            }
            block.iter().for_each(|x| cases.extend(x.to_le_bytes()));
        }

        // The same calls on the package for this processor.
        // SAFETY: the compiler has just made it.
        let model = unsafe { runtime::image::load(&program(&intel, name)) }.unwrap();
        assert_eq!(*model.description, image.description, "both say the same of themselves");
        for mut block in begin {
            let mut status = 0;
            for function in &calls {
                status = model.code.call(*function, &mut block, &image.description.pool, count(*function));
            }
            expected.push((name, status, block));
        }
    }
    if cfg!(not(target_arch = "x86_64")) {
        panic!("this test compares with x86-64 and runs on another processor");
    }
    let (input, output) = (folder.join("cases"), folder.join("results"));
    fs::write(&input, cases).unwrap();
    emulator::run(&input, &output);
    let results = fs::read(&output).unwrap();
    let mut words = results.chunks_exact(8).map(|word| u64::from_le_bytes(word.try_into().unwrap()));
    let (mut moved, mut compared) = (0, 0);
    for (name, status, block) in expected {
        assert_eq!(words.next(), Some(status), "{name}: the status");
        for (slot, x) in block.iter().enumerate() {
            let found = words.next().expect("all slots");
            assert_eq!(found, x.to_bits(), "{name}, slot {slot}: {} and {x}", f64::from_bits(found));
            compared += 1;
        }
        moved += usize::from(status == 0 && block[Slot::COUNT.index()] == STEPS as f64);
    }
    assert_eq!(words.next(), None);
    assert!(compared > 500 && moved >= STARTS as usize, "{compared} numbers, {moved} whole runs");
}
