//! A panel beside a whole rig, with exact time: does the rig notice? The rig of the gate in `latency.rs`, with its log in
//! a file, runs alone and then beside a panel that ten viewers read, one of which is deaf; its bounds are the same. A panel
//! that runs with the priority of the cycle fails them.

#[path = "../panel/client.rs"]
mod client;
mod rig;

use client::Client;
use panel::follow;
use panel::recording::{Played, Recording};
use panel::server::{Bell, Panel};
use runtime::can::Options;
use runtime::can::socketcan::{self, SocketCan};
use runtime::hil::counts::Counts;
use runtime::hil::cycle::{End, Hil, Options as HilOptions};
use runtime::realtime::clock::Monotonic;
use runtime::realtime::threads::{self, Wishes};
use runtime::record::claim::is_claimed;
use runtime::record::log::{Reader, Sections, Settings, Sink};
use runtime::record::parts::Limits;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// The priorities of the gate in `latency.rs`.
const LOOP: i32 = 80;
const DRIVE: i32 = 79;
/// Its bound: a twentieth of the period would be 50 µs.
const LATENESS_NS: u64 = 20_000;
const CYCLES: u64 = 4000;
const LOG: &str = "/tmp/gate.friclog";
/// Where the panel says how many pictures its viewers have got.
const FRAMES: &str = "/tmp/gate.frames";
const STARTED: &str = "at the gate";
const VIEWERS: usize = 10;

/// A process that was forked, until dropped.
struct Forked(i32);

impl Drop for Forked {
    fn drop(&mut self) {
        // SAFETY: takes no pointers but one that may be null; the process is ours.
        unsafe {
            libc::kill(self.0, libc::SIGKILL);
            libc::waitpid(self.0, std::ptr::null_mut(), 0);
        }
    }
}

/// Forks a process that does this and nothing else. `priority`: a real-time priority for all of its threads.
fn forked(priority: Option<i32>, does: impl FnOnce()) -> Forked {
    // SAFETY: the C library makes its heap usable in the child, which calls nothing of the other threads.
    match unsafe { libc::fork() } {
        0 => {
            if let Some(priority) = priority {
                let wanted = libc::sched_param { sched_priority: priority };
                // SAFETY: the parameter is valid and outlives the call; 0 is this process.
                let set = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const wanted) };
                assert_eq!(set, 0, "root of the guest may do so");
            }
            does();
            // SAFETY: ends the process without what the harness has registered.
            unsafe { libc::_exit(0) };
        }
        child if child > 0 => Forked(child),
        _ => panic!("no process: {}", std::io::Error::last_os_error()),
    }
}

/// The panel of the gate and its viewers: follows the log, and serves for ever.
fn panel() {
    let asked = rig::pulsed(1_000_000);
    while !follow::is_of(Path::new(LOG), STARTED) {
        std::thread::sleep(Duration::from_millis(20));
    }
    let reader = Reader::open(Path::new(LOG)).expect("it has begun");
    let control = follow::control(&reader.head, &asked.rig, &asked.program, &asked.program).expect("it is of this rig");
    let recording = Recording::new("gate", &asked.rig, (&asked.program, &asked.program), &control, 8 << 20);
    let (played, bell) = (Arc::new(Played::new(recording)), Bell::default());
    let open = Panel::open(0, played.clone(), bell.clone()).expect("a port");
    let link = open.link();
    std::thread::spawn(move || open.serve());
    let (address, key) = link.trim_start_matches("http://").split_once("/#").expect("a key");
    let views: Vec<String> = (0..4).map(|view| format!("view {view} {view} last 20 1200")).collect();
    let frames = Arc::new(AtomicU64::new(0));
    for viewer in 0..VIEWERS {
        let frames = frames.clone();
        let mut client = Client::connect(address, key, &views);
        std::thread::spawn(move || {
            // The first one is deaf.
            while let Some((opcode, bytes)) = (viewer > 0).then(|| client.message()).flatten() {
                if opcode == 2 {
                    let so_far = frames.fetch_add(1, Ordering::Relaxed) + 1;
                    if so_far.is_multiple_of(10) {
                        let _ = std::fs::write(FRAMES, so_far.to_string());
                    }
                    client.say(&format!("ack {}", u32::from_le_bytes(bytes[..4].try_into().expect("a number"))));
                }
            }
            std::thread::park();
        });
    }
    follow::follow(reader, &played, &|| is_claimed(Path::new(LOG)), &bell);
    loop {
        std::thread::park();
    }
}

/// The loop of a whole rig, from its start-up on.
fn whole_rig() -> (Counts, Option<End>) {
    let asked = rig::pulsed(1_000_000);
    let clock = Monotonic::new();
    let bus = SocketCan::open("can0", &Options::default(), clock).expect("it is up");
    let options = HilOptions { arms_itself: true, ..HilOptions::default() };
    let log = Settings { sink: Sink::File(LOG.into(), Limits::default()), cycles_per_block: 100, patient: false };
    let real_time = threads::enter(&Wishes { priority: LOOP, ..Wishes::default() });
    assert_eq!(real_time.refused(), [], "root of the guest may do all of it");
    let log = Some((log, Sections::default().with("started", STARTED)));
    let made = Hil::new(&asked.rig, asked.program.clone(), Box::new(clock), vec![Box::new(bus)], options, log);
    let (mut hil, _operator) = made.expect("it can be started");
    while hil.ended().is_none() && hil.counts().cycles < CYCLES {
        hil.cycle();
    }
    let found = (hil.counts().clone(), hil.ended().cloned());
    drop(real_time);
    found
}

/// Runs the rig, and whatever else is beside it. The gates that fail, with their measurements.
fn gate(name: &str, beside: Option<Option<i32>>) -> Vec<String> {
    let _ = std::fs::remove_file(LOG);
    let _ = std::fs::write(FRAMES, "0");
    // Before anything of this process is set up for real time, as `fric hil --panel` does it.
    let child = beside.map(|priority| forked(priority, panel));
    let over = Arc::new(AtomicBool::new(false));
    let drives = {
        let over = over.clone();
        std::thread::spawn(move || rig::drives(&rig::pulsed(1_000_000).rig, "can1", Some(DRIVE), &over))
    };
    let (counts, ended) = std::thread::spawn(whole_rig).join().expect("the loop ends");
    over.store(true, Ordering::Relaxed);
    drives.join().expect("the drives end");
    drop(child);
    let frames: u64 = std::fs::read_to_string(FRAMES).ok().and_then(|text| text.parse().ok()).unwrap_or(0);
    // SAFETY: takes no pointers.
    unsafe { libc::munlockall() };
    let figures = [("lateness", &counts.late), ("computing", &counts.compute), ("sending", &counts.send)];
    let figures = figures.map(|(name, times)| {
        format!("{name} µs p50 {} max {}", times.quantile_ns(0.5) as f64 / 1000.0, times.max_ns() as f64 / 1000.0)
    });
    println!(
        "{name}: {} cycles of the model and {} before, {}, missed {}, stale {}, messages of the log dropped {}, pictures {frames}",
        counts.cycles,
        counts.all - counts.cycles,
        figures.join(", "),
        counts.missed,
        counts.stale,
        counts.log_dropped,
    );
    let gates = [
        ("missed", counts.missed, 0),
        ("stale", counts.stale, 0),
        ("log dropped", counts.log_dropped, 0),
        ("lateness, ns", counts.late.max_ns(), LATENESS_NS),
        ("cycles not run", CYCLES - counts.cycles, 0),
    ];
    // Pictures ten times a second for nine viewers, from the start-up on.
    let unseen = (beside == Some(None) && frames < 200).then(|| format!("only {frames} pictures"));
    let red = gates.iter().filter(|(_, seen, most)| seen > most);
    red.map(|(name, seen, most)| format!("{name}: {seen} > {most}"))
        .chain(ended.map(|end| end.words()))
        .chain(unseen)
        .collect()
}

/// One test, in this order: there is one processor.
#[test]
fn a_rig_does_not_notice_its_panel_and_ten_viewers() {
    assert!(
        std::env::var("GUEST").is_ok_and(|guest| guest == "rt-exact"),
        "this gate holds in the guest only: start it as `cargo test`, which goes through tests/can/runner"
    );
    for card in ["can0", "can1"] {
        socketcan::take_up(card, Some(1_000_000)).expect("the guest has two cards");
    }
    assert_eq!(gate("without a panel", None), [""; 0]);
    assert_eq!(gate("beside a panel, ten viewers, one deaf", Some(None)), [""; 0]);
    let red = gate("beside a panel with the priority of the cycle", Some(Some(LOOP)));
    assert!(!red.is_empty(), "a panel that takes the processor from the cycle is not seen");
}
