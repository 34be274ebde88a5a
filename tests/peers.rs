//! Interoperability with programs of others: the Python packages python-can, canopen and cantools.
//!
//! They are installed in a virtual environment below `target/`, created at the first run with pip. If that fails, the
//! test fails and reports it.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, OnceLock};

const PACKAGES: [&str; 4] = ["python-can==4.6.1", "canopen==2.4.1", "pyserial==3.5", "cantools==45.1.0"];

/// Tests take turns: Python programs have little time to answer, and a virtual machine needs a processor for itself.
static TURN: Mutex<()> = Mutex::new(());

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

fn fric() -> Command {
    Command::new(env!("CARGO_BIN_EXE_fric"))
}

/// A program with open doors, until dropped.
struct Served {
    child: Child,
    told: String,
}

impl Served {
    fn start(command: &mut Command, begin: &str) -> Served {
        let command = command.args(["--for", "900s", "--quiet"]).stderr(Stdio::piped()).stdout(Stdio::null());
        let mut child = command.spawn().expect("fric starts");
        let mut told = String::new();
        // Its first line is printed once its doors are open.
        BufReader::new(child.stderr.take().expect("piped")).read_line(&mut told).expect("a line");
        assert!(told.starts_with(begin), "{told}");
        Served { child, told }
    }

    /// Simulated drives of the example rig.
    fn drives(door: &[&str]) -> Served {
        let example = root().join("examples/rtfs/rtfs.fric");
        Served::start(fric().arg("drives").arg(example).args(door), "simulated: load, servo")
    }

    /// A bus with two doors.
    fn bus(doors: &[&str]) -> Served {
        Served::start(fric().args(["bus", "sim:between"]).args(doors), "joined: sim:between")
    }

    fn port(&self) -> &str {
        self.told.trim().rsplit(' ').next().expect("a port")
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A path for a link to a pseudo-terminal.
fn link(name: &str) -> String {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}-{}", std::process::id()));
    path.to_str().expect("a text").to_string()
}

/// The output of a script.
fn script(name: &str, argument: &str) -> String {
    let output = Command::new(python()).arg(root().join("tests/peers").join(name)).arg(argument).output();
    let output = output.expect("python starts");
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name} {argument}\n{out}{error}");
    out.into_owned()
}

/// The value of a line `name value` in the output of a script.
fn value<'a>(said: &'a str, name: &str) -> &'a str {
    let line = said.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("no {name} in\n{said}"))
}

fn master_saw(said: &str) {
    assert_eq!(value(said, "name"), "fric simulated");
    assert_eq!(value(said, "rated"), "4000");
    assert_eq!(value(said, "abort"), "0x6010002");
    assert_eq!(value(said, "nmt"), "OPERATIONAL");
    assert_eq!(value(said, "answers"), "100 100");
    assert_eq!(value(said, "torque"), "100");
    // 0.4 N·m on 0.012 kg·m² for the 0.2 s that 100 cycles take at least: 0.67 rad.
    let turned: i64 = value(said, "turned").parse().expect("a number");
    assert!(turned > 25_000, "{turned} counts");
}

#[test]
fn a_foreign_master_leads_our_drives_through_a_pseudo_terminal() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let door = link("can0");
    let _drives = Served::drives(&["--pty", &door]);
    master_saw(&script("master.py", &door));
}

#[test]
fn a_foreign_master_leads_our_drives_over_tcp() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let drives = Served::drives(&["--tcp", "0"]);
    master_saw(&script("master.py", &format!("127.0.0.1:{}", drives.port())));
}

/// Checks what the package's drive observed of a rig that performed the whole start-up and ended as intended.
fn node_saw(said: &str, timeout_tested: bool) {
    let states: Vec<&str> = value(said, "states").split(", ").collect();
    let times = states.iter().filter(|state| **state == "enabled").count();
    assert_eq!(times, if timeout_tested { 2 } else { 1 }, "{states:?}");
    assert!(states.starts_with(&["switch on disabled", "ready", "switched on", "enabled"]), "{states:?}");
    assert!(states.ends_with(&["enabled", "quick stop", "switch on disabled"]), "{states:?}");
    assert_eq!(value(said, "timeouts"), if timeout_tested { "1" } else { "0" });
    assert_eq!(value(said, "nmt"), "OPERATIONAL");
    let number = |name: &str| value(said, name).parse::<u32>().expect("a number");
    assert!(number("syncs") > 100 && number("commands") > 100, "{said}");
    // The model commands up to 0.4 N·m, the push of the polarity check less: 0.2 of 1000 for 2 N·m.
    assert!((150..=300).contains(&number("torque")), "{said}");
}

/// Our master with the package's drive: the whole start-up, 4 s of a model, the stop, and a log that replays.
fn our_master_leads_a_foreign_drive(theirs: &str, ours: &str, name: &str) {
    let script = root().join("tests/peers/node.py");
    let mut node = Command::new(python());
    let node = node.arg(script).arg(theirs).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut node = node.spawn().expect("python starts");
    let mut out = BufReader::new(node.stdout.take().expect("piped"));
    let mut said = String::new();
    out.read_line(&mut said).expect("a line");
    assert_eq!(said, "ready\n");
    let log = link(name);
    let run = |arguments: &[&str]| {
        let output = fric().args(arguments).stdin(Stdio::null()).output().expect("fric starts");
        let told = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
        assert_eq!(output.status.code(), Some(0), "{arguments:?}\n{told}");
        told
    };
    let rig = root().join("tests/peers/node.fric");
    let rig = rig.to_str().expect("a text");
    let bus = format!("can0={ours}");
    run(&["hil", rig, "node", "--bus", &bus, "--arm", "--accept-jitter", "--for", "4s", "--quiet", "--log", &log]);
    let told = run(&["replay", &log]);
    assert!(told.contains("agree to the bit; it ended as asked"), "{told}");
    // The end of its input makes it print what it observed.
    drop(node.stdin.take());
    out.read_to_string(&mut said).expect("text");
    assert!(node.wait().expect("it ends").success(), "{said}");
    node_saw(&said, true);
}

#[test]
fn our_master_leads_a_foreign_drive_through_pseudo_terminals() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let [near, far] = ["near", "far"].map(link);
    let _bus = Served::bus(&["--pty", &near, "--pty", &far]);
    our_master_leads_a_foreign_drive(&far, &format!("slcan:{near}@1000000"), "slcan-log");
}

#[test]
fn our_master_leads_a_foreign_drive_over_tcp() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let bus = Served::bus(&["--tcp", "0"]);
    let port = bus.port();
    our_master_leads_a_foreign_drive(
        &format!("127.0.0.1:{port}"),
        &format!("socketcand:127.0.0.1:{port}/can0"),
        "tcp-log",
    );
}

/// Both roles over a virtual interface of the kernel: here if there is one, else in the virtual machine that has one.
#[test]
fn both_roles_over_an_interface_of_the_kernel() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let here = "ip link add dev probe0 type vcan";
    let probe = Command::new("unshare").args(["-Urn", "sh", "-c", here]).output();
    let mut command = if probe.is_ok_and(|output| output.status.success()) {
        let mut command = Command::new("unshare");
        command.args(["-Urn", "bash"]);
        command
    } else {
        let mut command = Command::new(root().join("tests/can/guest"));
        command.args(["--limit", "550", "bash"]);
        command
    };
    let command = command.arg(root().join("tests/peers/vcan.sh")).arg(env!("CARGO_BIN_EXE_fric")).arg(python());
    let output = command.current_dir(root()).output().expect("it starts");
    let said = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    assert!(output.status.success(), "{said}");
    master_saw(&said);
    let node = said.find("ready\n").unwrap_or_else(|| panic!("no node in\n{said}"));
    node_saw(&said[node..], false);
    assert!(said.contains("agree to the bit; it ended as asked"), "{said}");
}

/// Bytes from hexadecimal digits, padded with zeros.
fn bytes(hexadecimal: &str) -> [u8; 8] {
    let mut out = [0; 8];
    for (k, byte) in out.iter_mut().enumerate().take(hexadecimal.len() / 2) {
        *byte = u8::from_str_radix(&hexadecimal[2 * k..2 * k + 2], 16).expect("hexadecimal digits");
    }
    out
}

/// A double from C's hexadecimal notation, as Python prints it.
#[expect(clippy::disallowed_methods, reason = "powers of two are exact everywhere")]
fn exactly(text: &str) -> f64 {
    let (sign, text) = text.strip_prefix('-').map_or((1.0, text), |rest| (-1.0, rest));
    let (mantissa, exponent) = text.strip_prefix("0x").and_then(|rest| rest.split_once('p')).expect("0x…p…");
    let (whole, part) = mantissa.split_once('.').expect("a point");
    let part = u64::from_str_radix(part, 16).expect("hexadecimal digits") as f64 / 16f64.powi(part.len() as i32);
    let whole: f64 = whole.parse().expect("0 or 1");
    sign * (whole + part) * 2f64.powi(exponent.parse().expect("an exponent"))
}

/// Big-endian and little-endian signals at odd positions, floats, multiplexed pages and nested ones: the same values as
/// cantools decodes, and the same bytes as it encodes.
#[test]
fn a_foreign_reader_of_dbc_files_finds_the_same_in_frames() {
    use runtime::drive::frames;
    let path = root().join("tests/peers/signals.dbc");
    let messages = compiler::rig::dbc_messages(&fs::read_to_string(&path).expect("it is there")).expect("it is right");
    // SI values of one unit of the file and of its zero.
    let units = |signal: &str| match signal {
        "Plain.wide" => (std::f64::consts::PI / 30.0, 0.0),
        "Motorola.across" => (1.0, 273.15),
        _ => (1.0, 0.0),
    };
    let (mut described, mut compared, mut absent, mut written) = (0, 0, 0, 0);
    for line in script("dbc.py", path.to_str().expect("a text")).lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let message = messages.iter().find(|message| message.name == words[1]).expect("a message that we know too");
        if words[0] == "message" {
            let ours = (message.id, message.extended, message.length, message.period_ns);
            let number = |k: usize| words[k].parse::<u64>().expect("a number");
            assert_eq!(ours, (number(2) as u32, number(3) == 1, number(4) as u8, number(5) * 1_000_000), "{line}");
            described += 1;
            continue;
        }
        let data = bytes(words[2]);
        let data = &data[..message.length.into()];
        if words[3] == "-" {
            // A page that the file does not describe: every signal that depends on the multiplexer is absent.
            let switched = |field: &usize| message.fields[*field].multiplexed.is_some();
            let found = (0..message.fields.len()).filter(switched);
            assert!(found.clone().any(|field| frames::read(message, field, data).is_none()), "{line}");
            continue;
        }
        let mut values = vec![0.0; message.fields.len()];
        let mut precise = true;
        for (k, field) in message.fields.iter().enumerate() {
            let theirs = words[4..].iter().find_map(|word| word.strip_prefix(&field.name)?.strip_prefix('='));
            let (scale, zero) = units(&format!("{}.{}", message.name, field.name));
            let theirs = theirs.map(|text| exactly(text) * scale + zero);
            let ours = frames::read(message, k, data);
            let near = match (ours, theirs) {
                (Some(ours), Some(theirs)) => (ours - theirs).abs() <= 4.0 * f64::EPSILON * theirs.abs(),
                (ours, theirs) => ours == theirs,
            };
            assert!(near, "{} in {line}: {ours:?}, not {theirs:?}", field.name);
            absent += usize::from(ours.is_none());
            compared += usize::from(ours.is_some());
            values[k] = ours.unwrap_or_default();
            // More bits than a double has cannot survive the round trip.
            precise &= field.bits <= 53;
        }
        if precise {
            let mut again = [0; 8];
            frames::fill(message, |field| values[field], &mut again);
            assert_eq!(again, bytes(words[3]), "{line}");
            written += 1;
        }
    }
    println!("{described} messages, {compared} values, {absent} absent, {written} frames written");
    assert!(described == 8 && compared > 1000 && absent > 200 && written > 300);
}
