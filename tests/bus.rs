//! `fric bus`, `fric doctor` and `fric bench-rt` from the user's view.

use runtime::can::slcan::Slcan;
use runtime::can::socketcand::Client;
use runtime::can::{Bus, Frame, Options, Received};
use runtime::realtime::clock::{Clock, Monotonic};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

fn fric(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fric")).args(arguments).output().expect("fric starts")
}

/// A path unique to this run.
fn scratch(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("bus-{name}-{}", std::process::id()))
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Waits for a frame; other frames may come first.
fn expect(bus: &mut dyn Bus, clock: &Monotonic, frame: Frame) {
    let until_ns = clock.now_ns() + 20_000_000_000;
    while bus.wait(until_ns) {
        while let Some(received) = bus.receive() {
            if matches!(received, Received::Frame(got, _) if got == frame) {
                return;
            }
        }
    }
    panic!("{frame} did not come");
}

#[test]
fn two_doors_to_one_bus() {
    let link = scratch("door");
    let door = link.to_str().expect("a text");
    let mut child = Command::new(env!("CARGO_BIN_EXE_fric"))
        .args(["bus", "sim:bench", "--pty", door, "--tcp", "0"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fric starts");
    let mut told = BufReader::new(child.stderr.take().expect("piped"));
    let mut first = String::new();
    told.read_line(&mut first).expect("a line");
    assert!(first.starts_with(&format!("joined: sim:bench, {door}, TCP port ")), "{first}");
    let port = first.trim().rsplit(' ').next().expect("a port").parse().expect("a number");

    let clock = Monotonic::new();
    let options = Options { bit_rate: Some(1_000_000), ..Options::default() };
    let mut serial = Slcan::open(&link, &options, clock).expect("the door is open");
    let mut tcp = Client::open("127.0.0.1", port, "can0", &options, clock).expect("the door is open");
    let (sync, answer) = (Frame::new(0x080, &[]), Frame::new(0x181, &[0x27, 6]));
    // After the greetings there is a pause in which a client receives nothing.
    clock.sleep_until(clock.now_ns() + 200_000_000);
    serial.send(sync).expect("sent");
    expect(&mut tcp, &clock, sync);
    tcp.send(answer).expect("sent");
    expect(&mut serial, &clock, answer);

    let ended = Command::new("sh").args(["-c", &format!("kill {}", child.id())]).status();
    assert!(ended.expect("a shell").success());
    assert!(child.wait().expect("it ends").success(), "Ctrl-C ends it well");
    let mut page = String::new();
    child.stdout.take().expect("piped").read_to_string(&mut page).expect("a text");
    let has = |from: &str, rest: &str| page.lines().any(|line| line.contains(from) && line.ends_with(rest));
    assert!(has(door, "080  [0]                           SYNC"), "{page}");
    assert!(has("tcp", "181  [2]  27 06                    TPDO1 of node 1"), "{page}");
    let mut rest = String::new();
    told.read_to_string(&mut rest).expect("a text");
    assert!(rest.starts_with("2 frames"), "{rest}");
    assert!(!link.is_symlink(), "the link goes with the door");
}

#[test]
fn a_log_is_played_and_kept() {
    let path = scratch("log");
    let log = "(1700000000.000000) can0 080#\n(1700000000.001000) can0 181#2706\n(1700000000.002000) can0 701#05\n";
    std::fs::write(&path, log).expect("written");
    let address = format!("replay:{}", path.display());
    let played = fric(&["bus", &address, "--for", "300ms", "--log"]);
    assert_eq!(played.status.code(), Some(0), "{}", text(&played.stderr));
    let frames =
        |log: &str| log.lines().map(|line| line.rsplit(' ').next().unwrap_or("").to_string()).collect::<Vec<_>>();
    assert_eq!(frames(&text(&played.stdout)), frames(log));

    let named = text(&fric(&["bus", &address, "--for", "300ms"]).stdout);
    assert!(named.contains("heartbeat of node 1: operational"), "{named}");
    assert_eq!(text(&fric(&["bus", &address, "--for", "300ms", "--quiet"]).stdout), "");
}

#[test]
fn a_bus_that_cannot_be_opened_is_reported_with_a_remedy() {
    for (arguments, code, said) in [
        (&["bus"][..], 2, "ADDRESS"),
        (&["bus", "vector:0"], 2, "`vector` is no kind of bus; there are sim:bench, can0"),
        (&["bus", "slcan:/dev/ttyACM0@7"], 2, "`7` is no bit rate of slcan"),
        (&["bus", "can77"], 1, "socketcan:can77: there is no interface can77\n  mend: "),
        (&["bus", "slcan:/nowhere"], 1, "an adapter must be told its bit rate"),
        (&["bus", "slcan:/nowhere@500000"], 1, "slcan:/nowhere: No such file"),
        (&["bus", "socketcand:127.0.0.1:1/can0"], 1, "Connection refused"),
        (&["bus", "replay:/nowhere"], 1, "replay:/nowhere: No such file"),
        (&["doctor", "can77"], 1, "there is no interface can77"),
        (&["bench-rt", "--rate", "3mm"], 2, "a frequency is needed"),
        (&["bench-rt", "--rate", "1MHz"], 2, "from 1 Hz to 20 kHz"),
    ] {
        let output = fric(arguments);
        let all = text(&output.stderr) + &text(&output.stdout);
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {all}");
        assert!(all.contains(said), "{arguments:?}: {all}");
    }
}

#[test]
fn the_machine_is_checked_and_measured() {
    let looked = fric(&["doctor"]);
    let page = text(&looked.stdout);
    assert_eq!(looked.status.code(), Some(0), "{page}");
    for topic in ["kernel ", "priority ", "core ", "clock "] {
        assert!(page.lines().any(|line| line.starts_with(topic)), "{topic}: {page}");
    }

    // The results depend on this machine; only the number of cycles is checked.
    let measured = fric(&["bench-rt", "--rate", "100Hz", "--seconds", "1"]);
    let page = text(&measured.stdout);
    assert!(page.contains("100 cycles at 100 Hz: ") && page.contains("verdict: "), "{page}");
    let unfit = page.contains("not for torque");
    assert_eq!(measured.status.code(), Some(i32::from(unfit)), "{page}");
}
