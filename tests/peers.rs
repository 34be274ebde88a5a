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

/// A rig of one drive, slow enough for a peer in Python.
const SLOW: &str = "
import std.friction
import std.plant

model Braked {
  part fr   = LuGre(v = body.v, sigma0 = 0.05 N/m, sigma1 = 0.02 N·s/m, sigma2 = 0.02 N·s/m, Fc = 0.1 N, Fs = 0.15 N,
                    vs = 1 m/s)
  part body = Axis(m = 0.012 kg, F_motor = 0.3 N * sin(2 * pi * t / 2 s), F_load = fr.F)
}

rig slow {
  run rotary Braked()
  rate     20 ms
  bus      can0  = can(\"can0\", 1 Mbit/s)
  drive    load  = cia402(can0, node = 3, T_rated = 4 N·m, mode = torque, count = 1 rev / 262144,
                          speed_unit = 0.01 rpm, speed_max = 100 rad/s, delay = 12 ms, lag = 0 s, timeout = 400 ms)
  hardware body {
    load.torque = F_motor - F_load     limit -1 N·m .. 1 N·m
    v           = load.speed
  }
  watchdog 400 ms
  overrun  hold 10
  safe     load.torque = 0 N·m
}
";

/// Our master leads a drive that others have written: `ours` and `theirs` are given the two doors of one bus.
fn our_master(name: &str, ours: impl Fn(&str, u16) -> String, theirs: impl Fn(&str, u16) -> String) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("peer-{name}-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("target can be written");
    fs::write(folder.join("slow.fric"), SLOW).expect("target can be written");
    let link = folder.join("can0");
    let link = link.to_str().expect("a text");
    let mut hub = Command::new(env!("CARGO_BIN_EXE_fric"))
        .args(["bus", "sim:bench", "--pty", link, "--tcp", "0", "--quiet", "--for", "120s"])
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .expect("fric starts");
    let mut told = String::new();
    BufReader::new(hub.stderr.take().expect("piped")).read_line(&mut told).expect("a line");
    let port: u16 = told.trim().rsplit(' ').next().and_then(|text| text.parse().ok()).expect("a port");

    let mut node = Command::new(python())
        .arg(root().join("tests/peers/node.py"))
        .args([theirs(link, port).as_str(), "4711", "100"])
        .stdout(Stdio::piped())
        .spawn()
        .expect("python starts");
    let mut said = BufReader::new(node.stdout.take().expect("piped"));
    let mut line = String::new();
    while line.trim() != "ready" {
        line.clear();
        assert!(said.read_line(&mut line).expect("a line") > 0, "the node ended");
    }
    let bus = format!("can0={}", ours(link, port));
    let run = Command::new(env!("CARGO_BIN_EXE_fric"))
        .current_dir(&folder)
        .args(["hil", "--arm", "--accept-jitter", "--for", "3s", "--bus", &bus, "slow.fric"])
        .stdin(Stdio::null())
        .output()
        .expect("fric starts");
    std::thread::sleep(std::time::Duration::from_millis(300));
    let _ = (node.kill(), node.wait(), hub.kill(), hub.wait());
    let (out, error) = (String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr));
    assert_eq!(run.status.code(), Some(0), "{out}{error}");
    let cycles =
        out.lines().find_map(|line| line.trim().strip_prefix("cycles")?.trim().split(',').next()?.parse().ok());
    assert!(cycles.is_some_and(|cycles: u64| cycles >= 140), "{out}");
    let states: Vec<String> = said.lines().map_while(Result::ok).collect();
    let states: Vec<&str> = states.iter().filter_map(|line| line.strip_prefix("state ")).collect();
    // Enabled; our life sign stops and the drive with it; reset and enabled again; stopped at the end.
    let mut wanted = ["0x21", "0x23", "0x27", "0x8", "0x40", "0x21", "0x23", "0x27", "0x40"].iter().peekable();
    for state in &states {
        wanted.next_if(|next| *next == state);
    }
    assert_eq!(wanted.next(), None, "{states:?}");
    assert_ne!(states.last(), Some(&"0x27"));
    let _ = fs::remove_dir_all(&folder);
}

#[test]
fn our_master_leads_a_foreign_node_through_a_pseudo_terminal() {
    our_master("pty", |link, _| format!("slcan:{link}@1000000"), |_, port| format!("127.0.0.1:{port}"));
}

#[test]
fn our_master_leads_a_foreign_node_over_tcp() {
    our_master("tcp", |_, port| format!("socketcand:127.0.0.1:{port}/can0"), |link, _| link.into());
}
