//! Trust between a rig's computer and the developer's: keys, ages of packages, names from the other side.

use crate::{FRIC_RIG, fails, fine, folder, fric, said, text};
use runtime::package::Package;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A real bus that no computer has.
const REAL: &str = "can(\"nosuchcan\", 1 Mbit/s)";

fn rig(folder: &Path, args: &[&str]) -> Output {
    Command::new(&*FRIC_RIG).current_dir(folder).args(args).output().unwrap()
}

#[track_caller]
fn refuses(folder: &Path, args: &[&str], why: &str) {
    let output = rig(folder, args);
    assert!(output.status.code() == Some(1) && said(&output).contains(why), "{args:?}: {}", said(&output));
}

#[track_caller]
fn takes(folder: &Path, args: &[&str]) -> String {
    let output = rig(folder, args);
    assert!(output.status.success(), "{args:?}: {}", said(&output));
    said(&output)
}

#[test]
fn an_unsigned_package_moves_no_real_drive() {
    let folder = folder("unsigned");
    fs::write(folder.join("real.fric"), text(REAL)).unwrap();
    fs::write(folder.join("sim.fric"), text("sim(\"bench\")")).unwrap();
    fine(&folder, &["build", "real.fric", "-o", "real.fricpkg"]);
    fine(&folder, &["build", "sim.fric", "-o", "sim.fricpkg"]);
    let (store, nobody) = (["--dir", "store"], ["--trusted", "nobody"]);
    let with = |words: &[&'static str], more: &[&'static str]| [words, more].concat();
    let unsigned = "it is not signed, and bus `can0` is socketcan:nosuchcan";
    refuses(&folder, &with(&["check", "real.fricpkg"], &nobody), unsigned);
    refuses(&folder, &[&["install", "real.fricpkg"], &store[..], &nobody].concat(), unsigned);
    assert!(!folder.join("store").exists(), "nothing is made for what is refused");
    refuses(&folder, &[&["run", "real.fricpkg"], &store[..], &nobody].concat(), unsigned);
    // A replacement of its bus counts, in either direction.
    let other = ["run", "sim.fricpkg", "--bus", "can0=socketcan:nosuchcan"];
    refuses(&folder, &[&other, &store[..], &nobody].concat(), unsigned);
    let fast = ["--sim", "--fast", "--for", "20ms"];
    takes(&folder, &[&["run", "real.fricpkg"], &fast[..], &store, &nobody].concat());
    takes(&folder, &with(&["check", "sim.fricpkg"], &nobody));
    // With permission it continues, up to the missing bus.
    let allowed = [&["run", "real.fricpkg", "--allow-unsigned"], &store[..], &nobody].concat();
    refuses(&folder, &allowed, "bus `can0`: ");
    takes(&folder, &with(&["check", "real.fricpkg", "--allow-unsigned"], &nobody));
    // Once a key is trusted, nothing unsigned runs at all.
    fine(&folder, &["key", "new", "trusted/anna"]);
    for package in ["real.fricpkg", "sim.fricpkg"] {
        let check = ["check", package, "--allow-unsigned", "--trusted", "trusted"];
        refuses(&folder, &check, "this computer trusts anna only");
    }
    // A signature with an untrusted key does not count.
    fine(&folder, &["build", "real.fric", "-o", "signed.fricpkg", "--sign", "trusted/anna.key"]);
    refuses(
        &folder,
        &with(&["check", "signed.fricpkg"], &nobody),
        "this computer trusts no key that could have signed",
    );
    assert!(takes(&folder, &["check", "signed.fricpkg", "--trusted", "trusted"]).contains("signed by anna at 2"));
}

#[test]
fn a_package_that_was_signed_earlier_is_not_installed_over_a_later_one() {
    let folder = folder("older");
    fine(&folder, &["key", "new", "trusted/anna"]);
    let build = |name: &str, begin: &str| {
        fs::write(folder.join("rig.fric"), format!("// {begin}\n{}", text("sim(\"bench\")"))).unwrap();
        fine(&folder, &["build", "rig.fric", "-o", name, "--sign", "trusted/anna.key"]);
    };
    build("old.fricpkg", "old");
    std::thread::sleep(std::time::Duration::from_millis(1100));
    build("new.fricpkg", "new");
    let words = |package: &'static str| ["install", package, "--dir", "store", "--trusted", "trusted"];
    takes(&folder, &words("old.fricpkg"));
    takes(&folder, &words("new.fricpkg"));
    refuses(&folder, &words("old.fricpkg"), "it is older than the package that is installed: it was signed at 2");
    takes(&folder, &words("new.fricpkg"));
    takes(&folder, &[&words("old.fricpkg")[..], &["--allow-older"]].concat());
    takes(&folder, &words("new.fricpkg"));
    // Going back has a command of its own.
    takes(&folder, &["rollback", "--dir", "store"]);
    // The time is not part of the package: the same text still gives the same bytes.
    let bytes = fs::read(folder.join("new.fricpkg")).unwrap();
    build("new.fricpkg", "new");
    assert!(fs::read(folder.join("new.fricpkg")).unwrap() == bytes);
}

/// Fake `ssh` and `scp` for this test: they answer from files, and record what they were asked.
struct Fake {
    folder: PathBuf,
}

impl Fake {
    fn new(name: &str) -> Fake {
        let folder = folder(name);
        let bin = folder.join("bin");
        fs::create_dir(&bin).unwrap();
        // The last argument of ssh is the command; that of scp the target, the one before it the source.
        let ssh = format!(
            "#!/bin/sh\nfor last; do :; done\necho \"$last\" >> {0}/asked\n\
             case \"$last\" in *' target') echo {1};; *'ls -1t'*) cat {0}/listing;; *mktemp*) mkdir -p there; echo there;;\n\
             *' trust'*) ;; *) printf 'said \\033]0;title\\007\\n';; esac\n",
            folder.display(),
            runtime::package::here()
        );
        let scp = format!(
            "#!/bin/sh\nfor last; do from=$to; to=$last; done\n\
             case \"$to\" in *:*) for word; do case \"$word\" in */fric-deploy-*) stat -c '%a %n' \"$(dirname $word)\" >> {0}/modes;; \
             esac; done; [ ! -e {0}/broken ];; *) echo log > \"$to\";; esac\n",
            folder.display()
        );
        for (name, script) in [("ssh", ssh), ("scp", scp)] {
            fs::write(bin.join(name), script).unwrap();
            fs::set_permissions(bin.join(name), fs::Permissions::from_mode(0o755)).unwrap();
        }
        fs::write(folder.join("listing"), "").unwrap();
        fs::create_dir(folder.join("tmp")).unwrap();
        Fake { folder }
    }

    fn fric(&self, args: &[&str]) -> Output {
        let path = format!("{}:{}", self.folder.join("bin").display(), std::env::var("PATH").unwrap());
        Command::new(env!("CARGO_BIN_EXE_fric"))
            .current_dir(&self.folder)
            .args(args)
            .env("PATH", path)
            .env("TMPDIR", self.folder.join("tmp"))
            .env("XDG_CONFIG_HOME", self.folder.join("config"))
            .output()
            .unwrap()
    }

    fn files(&self, below: &str) -> Vec<String> {
        let entries = fs::read_dir(self.folder.join(below)).into_iter().flatten().flatten();
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
    }
}

#[test]
fn a_log_is_fetched_under_one_name_in_one_folder() {
    let fake = Fake::new("names");
    let outside = fake.folder.join("outside.friclog");
    let names = [
        outside.display().to_string(),
        "../above.friclog".into(),
        "a/b.friclog".into(),
        "x\u{1b}]0;title\u{7}.friclog".into(),
        "-o.friclog".into(),
        ".friclog".into(),
        "good.friclog".into(),
    ];
    fs::write(fake.folder.join("listing"), names.join("\n")).unwrap();
    let output = fake.fric(&["fetch-log", "a@b", "--all"]);
    let told = said(&output);
    assert!(output.status.success(), "{told}");
    assert_eq!(fake.files("out"), ["good.friclog"], "{told}");
    assert!(!outside.exists() && !fake.folder.join("above.friclog").exists());
    assert!(!told.contains('\u{1b}') && !told.contains('\u{7}'), "{told:?}");
    assert!(told.contains("`x\\u{1b}]0;title\\u{7}.friclog`: that is no name of one"), "{told}");
    for name in &names[..names.len() - 1] {
        assert!(!fake.fric(&["fetch-log", "a@b", "--", name]).status.success(), "{name:?}");
    }
    // One by one, each alone.
    for name in &names[..names.len() - 1] {
        fs::write(fake.folder.join("listing"), name).unwrap();
        let output = fake.fric(&["fetch-log", "a@b"]);
        assert!(!output.status.success() && !said(&output).contains('\u{1b}'), "{name:?}: {}", said(&output));
    }
    assert_eq!(fake.files("out"), ["good.friclog"]);
}

#[test]
fn files_are_sent_through_a_private_temporary_folder() {
    let fake = Fake::new("staging");
    fs::write(fake.folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    for broken in [false, true] {
        if broken {
            fs::write(fake.folder.join("broken"), "").unwrap();
        }
        let output = fake.fric(&["deploy", "a@b", "rig.fric"]);
        assert_eq!(output.status.success(), !broken, "{}", said(&output));
        assert!(!said(&output).contains('\u{1b}'), "{:?}", said(&output));
        assert_eq!(fake.files("tmp"), [""; 0], "nothing is left behind");
    }
    let modes = fs::read_to_string(fake.folder.join("modes")).unwrap();
    assert!(!modes.is_empty() && modes.lines().all(|line| line.starts_with("700 ")), "{modes}");
    let asked = fs::read_to_string(fake.folder.join("asked")).unwrap();
    assert_eq!(asked.matches("rm -rf -- there").count(), 2, "the folder there goes too, whatever happens:\n{asked}");

    // The new key is readable by its owner only.
    let key = fs::metadata(fake.folder.join("config/fric/deploy.key")).unwrap();
    assert_eq!(key.mode() & 0o777, 0o600);

    // A package whose rig has a name that leads to another folder.
    let package = Package { rig: "../../x".into(), target: runtime::package::here(), ..Package::default() };
    fs::write(fake.folder.join("bad.fricpkg"), package.to_bytes()).unwrap();
    let output = fake.fric(&["deploy", "a@b", "bad.fricpkg"]);
    assert!(output.status.code() == Some(1) && said(&output).contains("which is no name"), "{}", said(&output));
    assert_eq!(fake.files("tmp"), [""; 0]);
    fails(&fake.folder, &["inspect", "bad.fricpkg"], "which is no name");
}

#[test]
fn a_log_in_parts_is_fetched_whole() {
    let fake = Fake::new("parts");
    fs::write(fake.folder.join("listing"), "r-2.3.friclog\nr-2.2.friclog\nr-2.friclog\nr-1.2.friclog\nr-1.friclog\n")
        .unwrap();
    let fetched = |args: &[&str]| -> Vec<String> {
        let _ = fs::remove_dir_all(fake.folder.join("out"));
        let output = fake.fric(&[&["fetch-log", "a@b"], args].concat());
        assert!(output.status.success(), "{}", said(&output));
        let mut files = fake.files("out");
        files.sort();
        files
    };
    assert_eq!(fetched(&[]), ["r-2.2.friclog", "r-2.3.friclog", "r-2.friclog"]);
    assert_eq!(fetched(&["r-1.2.friclog"]), ["r-1.2.friclog", "r-1.friclog"]);
    assert_eq!(fetched(&["--all"]).len(), 5);
}

/// A key is created with its final mode.
#[test]
fn a_secret_key_is_never_readable_by_others() {
    let folder = folder("secret");
    fs::create_dir(folder.join("keys")).unwrap();
    let keys = folder.join("keys");
    let over = std::sync::atomic::AtomicBool::new(false);
    let open = std::thread::scope(|scope| {
        let watch = scope.spawn(|| {
            let mut open = Vec::new();
            while !over.load(std::sync::atomic::Ordering::Relaxed) {
                for entry in fs::read_dir(&keys).into_iter().flatten().flatten() {
                    let name = entry.file_name().to_string_lossy().into_owned();
                    let Ok(found) = entry.metadata() else { continue };
                    if name.contains("key") && found.mode() & 0o077 != 0 {
                        open.push((name, found.mode() & 0o777));
                    }
                }
            }
            open
        });
        for k in 0..8 {
            assert!(fric(&folder, &["key", "new", &format!("keys/a{k}")]).status.success());
        }
        over.store(true, std::sync::atomic::Ordering::Relaxed);
        watch.join().unwrap()
    });
    assert!(open.is_empty(), "{open:?}");
}
