//! Runs 64-bit Arm code on another processor: a cross-compiled static C harness under user-mode emulation.
//!
//! Compiler and emulator are those of the system, else from Debian's packages, unpacked below `target/` and not
//! installed. If neither is available, the test fails and reports what to install.

use crate::debian::{done, on_path, unpacked};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Packages to unpack if not installed. The compiler's own libraries are those of the system's compiler.
const PACKAGES: [&str; 9] = [
    "qemu-user-static",
    "binutils-aarch64-linux-gnu",
    "gcc-12-aarch64-linux-gnu",
    "cpp-12-aarch64-linux-gnu",
    "libc6-arm64-cross",
    "libc6-dev-arm64-cross",
    "linux-libc-dev-arm64-cross",
    "libgcc-12-dev-arm64-cross",
    "libgcc-s1-arm64-cross",
];

/// Emulators of other processors and a tool of the compiler: 280 of the 460 MB of these packages.
const OTHERS: [&str; 3] = ["./usr/bin/qemu-[!a]*", "./usr/bin/qemu-a[!a]*", "./usr/bin/*lto-dump*"];

/// Runs the harness on a file of cases, which writes the file of results.
pub fn run(cases: &Path, results: &Path) {
    static HARNESS: OnceLock<(Option<PathBuf>, PathBuf)> = OnceLock::new();
    let (emulator, harness) = HARNESS.get_or_init(harness);
    let mut command = match emulator {
        Some(emulator) => {
            let mut command = Command::new(emulator);
            command.arg(harness);
            command
        }
        None => Command::new(harness),
    };
    done(command.arg(cases).arg(results), "the harness");
}

/// The emulator, where one is needed, and the harness, renamed once complete because other runs may be using it.
fn harness() -> (Option<PathBuf>, PathBuf) {
    let harness = Path::new(env!("CARGO_TARGET_TMPDIR")).join("harness-aarch64");
    let begun = harness.with_extension(format!("begun-{}", std::process::id()));
    let emulator = compiled(&begun);
    std::fs::rename(&begun, &harness).expect("target/ can be written");
    (emulator, harness)
}

/// Compiles the harness, and returns the emulator that it needs, if any.
fn compiled(harness: &Path) -> Option<PathBuf> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/agreement/harness.c");
    let flags = ["-std=gnu11", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O1", "-static", "-o"];
    if cfg!(target_arch = "aarch64") {
        done(Command::new("gcc").args(flags).arg(harness).arg(&source), "gcc");
        return None;
    }
    let emulator = ["qemu-aarch64-static", "qemu-aarch64"].into_iter().find_map(on_path);
    let compiler = on_path("aarch64-linux-gnu-gcc");
    if let (Some(emulator), Some(compiler)) = (emulator, compiler) {
        done(Command::new(compiler).args(flags).arg(harness).arg(&source), "aarch64-linux-gnu-gcc");
        return Some(emulator);
    }
    let wanted = "code for 64-bit Arm cannot be tried: there is no qemu-aarch64 with aarch64-linux-gnu-gcc";
    let usr = unpacked("aarch64-tools", &PACKAGES, &OTHERS, wanted).join("usr");
    let (bin, target) = (usr.join("bin"), usr.join("aarch64-linux-gnu"));
    let mut across = Command::new(bin.join("aarch64-linux-gnu-gcc-12"));
    across.env("LD_LIBRARY_PATH", usr.join("lib/x86_64-linux-gnu"));
    across.args(flags).arg(harness).arg(&source);
    across.arg(format!("-B{}/aarch64-linux-gnu-", bin.display()));
    across.arg(format!("-B{}/lib", target.display())).arg(format!("-L{}/lib", target.display()));
    across.arg("-isystem").arg(target.join("include"));
    done(&mut across, "the cross compiler");
    Some(bin.join("qemu-aarch64-static"))
}
