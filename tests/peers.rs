//! Programs that others have written, against ours: python-can and the Python package canopen.
//!
//! They live in an environment of their own below `target/`, made at the first run with pip. Where that can't be had the
//! test fails and says so.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;

const PACKAGES: [&str; 3] = ["python-can==4.6.1", "canopen==2.4.1", "pyserial==3.5"];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The Python of the environment.
fn python() -> &'static Path {
    static PYTHON: OnceLock<PathBuf> = OnceLock::new();
    PYTHON.get_or_init(|| {
        let folder = root().join("target/peers");
        let python = folder.join("bin/python");
        let complete = folder.join("complete");
        if fs::read_to_string(&complete).is_ok_and(|text| text == PACKAGES.join(" ")) {
            return python;
        }
        let run = |command: &mut Command| {
            let output = command.output().unwrap_or_else(|error| panic!("{command:?} can't be run: {error}"));
            assert!(output.status.success(), "{command:?}\n{}", String::from_utf8_lossy(&output.stderr));
        };
        run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder));
        run(Command::new(&python).args(["-m", "pip", "install", "-q"]).args(PACKAGES));
        fs::write(&complete, PACKAGES.join(" ")).expect("target can be written");
        python
    })
}

/// Simulated drives of the example rig, until dropped.
struct Drives {
    child: Child,
    told: String,
}

impl Drives {
    fn start(door: &[&str]) -> Drives {
        let mut child = Command::new(env!("CARGO_BIN_EXE_fric"))
            .arg("drives")
            .arg(root().join("examples/rtfs/rtfs.fric"))
            .args(door)
            .args(["--for", "60s", "--quiet"])
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("fric starts");
        let mut told = String::new();
        // Its first line comes once its doors are open.
        BufReader::new(child.stderr.take().expect("piped")).read_line(&mut told).expect("a line");
        assert!(told.starts_with("simulated: load, servo"), "{told}");
        Drives { child, told }
    }
}

impl Drop for Drives {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What a script printed.
fn script(name: &str, argument: &str) -> String {
    let output = Command::new(python()).arg(root().join("tests/peers").join(name)).arg(argument).output();
    let output = output.expect("python starts");
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name} {argument}\n{out}{error}");
    out.into_owned()
}

fn master(where_: &str) {
    let said = script("master.py", where_);
    let value = |name: &str| {
        let line = said.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in\n{said}"))
    };
    assert_eq!(value("name"), "fric simulated");
    assert_eq!(value("rated"), "4000");
    assert_eq!(value("abort"), "0x6010002");
    assert_eq!(value("nmt"), "OPERATIONAL");
    assert_eq!(value("answers"), "100 100");
    assert_eq!(value("torque"), "100");
    // 0.4 N·m on 0.012 kg·m² for the 0.2 s that 100 cycles take at least: 0.67 rad.
    let turned: i64 = value("turned").parse().expect("a number");
    assert!(turned > 25_000, "{turned} counts");
}

#[test]
fn a_foreign_master_leads_our_drives_through_a_pseudo_terminal() {
    let link = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("can0-{}", std::process::id()));
    let link = link.to_str().expect("a text");
    let _drives = Drives::start(&["--pty", link]);
    master(link);
}

#[test]
fn a_foreign_master_leads_our_drives_over_tcp() {
    let drives = Drives::start(&["--tcp", "0"]);
    let port = drives.told.trim().rsplit(' ').next().expect("a port");
    master(&format!("127.0.0.1:{port}"));
}
