//! What a release holds: `.ci/release pack` packs the programs of this build.

#[path = "support/fric_rig.rs"]
mod fric_rig;

use fric_rig::FRIC_RIG;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

/// Packs the programs in `bin` into a new folder.
fn packed(bin: &Path, name: &str) -> PathBuf {
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&out);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/release");
    let mut command = Command::new(script);
    let done = command.arg("pack").arg(bin).arg(&out).env("SOURCE_DATE_EPOCH", "1000000000").output().unwrap();
    assert!(done.status.success(), "{}{}", text(&done), String::from_utf8_lossy(&done.stderr));
    out
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn output(folder: &Path, program: &str, args: &[&str]) -> Output {
    Command::new(program).current_dir(folder).args(args).output().unwrap_or_else(|why| panic!("{program}: {why}"))
}

/// Every file of an archive: its path and the bytes of its entry.
fn listed(folder: &Path, program: &str, args: &[&str]) -> BTreeSet<String> {
    let listing = output(folder, program, args);
    assert!(listing.status.success(), "{program} {args:?}: {}", String::from_utf8_lossy(&listing.stderr));
    text(&listing).lines().map(str::to_string).collect()
}

#[test]
fn a_release_is_complete_runs_and_repeats_to_the_byte() {
    let bin = Path::new(env!("CARGO_BIN_EXE_fric")).parent().unwrap();
    LazyLock::force(&FRIC_RIG);
    let out = packed(bin, "release");
    let (version, machine) = (env!("CARGO_PKG_VERSION"), std::env::consts::ARCH);
    let debian = if machine == "aarch64" { "arm64" } else { "amd64" };
    let name = format!("fric-{version}-{machine}-linux");
    let (tarball, deb, rig) =
        (format!("{name}.tar.gz"), format!("fric_{version}_{debian}.deb"), format!("fric-rig_{version}_{debian}.deb"));

    // A page for each command, completions for three shells, licences, examples.
    let help = text(&output(bin, env!("CARGO_BIN_EXE_fric"), &["--help"]));
    let commands = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let commands: Vec<&str> = commands
        .filter_map(|line| line.strip_prefix("  ").filter(|line| !line.starts_with(' '))?.split(' ').next())
        .filter(|command| *command != "help")
        .collect();
    assert!(commands.contains(&"run") && commands.contains(&"bench-rt"), "{help}");
    let pages = commands.iter().map(|command| format!("share/man/man1/fric-{command}.1.gz"));
    let others = [
        "bin/fric",
        "share/man/man1/fric.1.gz",
        "share/bash-completion/completions/fric",
        "share/zsh/vendor-completions/_fric",
        "share/fish/vendor_completions.d/fric.fish",
        "share/doc/fric/LICENSE-MIT",
        "share/doc/fric/CITATION.cff",
        "share/doc/fric/crates.txt",
        "share/doc/fric/examples/stick-slip/stick_slip.fric",
    ];
    let wanted: Vec<String> = pages.chain(others.map(String::from)).collect();
    let in_tarball = listed(&out, "tar", &["-tzf", &tarball]);
    let in_deb = text(&output(&out, "sh", &["-c", &format!("dpkg-deb --fsys-tarfile {deb} | tar -t")]));
    let in_deb: BTreeSet<&str> = in_deb.lines().collect();
    for path in &wanted {
        assert!(in_tarball.contains(&format!("{name}/{path}")), "no {path} in {tarball}");
        assert!(in_deb.contains(format!("./usr/{path}").as_str()), "no {path} in {deb}");
    }
    assert!(in_tarball.contains(&format!("{name}/bin/fric-rig")));
    assert!(!in_deb.contains("./usr/bin/fric-rig"), "it is a package of its own");
    for (package, file) in [("fric", &deb), ("fric-rig", &rig)] {
        let field = |field: &str| text(&output(&out, "dpkg-deb", &["-f", file, field])).trim().to_string();
        assert_eq!([field("Package"), field("Version"), field("Architecture")], [package, version, debian]);
        assert_eq!(field("Depends"), "");
    }

    // What is unpacked runs, without this source tree.
    let root = out.join("root");
    for file in [&deb, &rig] {
        assert!(output(&out, "dpkg-deb", &["-x", file, "root"]).status.success());
    }
    let ran = output(&root, "usr/bin/fric", &["test", "-q", "usr/share/doc/fric/examples/stick-slip/stick_slip.fric"]);
    assert!(text(&ran).contains("2 passed, 0 failed"), "{}{}", text(&ran), String::from_utf8_lossy(&ran.stderr));
    assert!(text(&output(&root, "usr/bin/fric-rig", &["--version"])).contains(version));

    // The same programs give the same bytes; a changed one is found.
    let again = packed(bin, "release-again");
    for file in [&tarball, &deb, &rig, &"SHA256SUMS".to_string()] {
        assert!(fs::read(out.join(file)).unwrap() == fs::read(again.join(file)).unwrap(), "{file} differs");
    }
    let sums = |folder: &Path| output(folder, "sha256sum", &["--quiet", "-c", "SHA256SUMS"]).status.success();
    assert!(sums(&again));
    let mut bytes = fs::read(again.join(&rig)).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(again.join(&rig), bytes).unwrap();
    assert!(!sums(&again));
}

#[test]
fn a_folder_without_programs_is_refused() {
    let empty = Path::new(env!("CARGO_TARGET_TMPDIR")).join("release-empty");
    fs::create_dir_all(&empty).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/release");
    let done = Command::new(script).arg("pack").arg(&empty).arg(empty.join("out")).output().unwrap();
    let err = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{err}");
    assert!(err.contains("has no program fric"), "{err}");
}
