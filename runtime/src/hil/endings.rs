//! Generated tests of a process's end: signals and panics at random moments and stack depths, with real descriptors.
//!
//! The fault space cannot test signal handlers, because one process executes all of its runs. Here each seed is a
//! process of its own. In: a seed. Out: whether the stop frames of the running rig were written, and to nothing but its
//! buses. `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::emergency::{guard, prepare};
use crate::can::Prepared;
use crate::rng::Chance;
use crate::testing::generated::{number, seeds};
use std::fs::File;
use std::hint::black_box;
use std::os::fd::AsRawFd;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;

/// Seeds in `cargo test`.
const RUNS: u64 = 40;
/// Stack of the thread that ends, bytes.
const STACK: usize = 256 * 1024;
/// Part of a thread's stack that the system reserves, bytes.
const KEPT: usize = 8 * 1024;
/// Number of files that are opened after a bus was closed: one of them receives its descriptor number.
const OTHERS: usize = 40;

/// Kind of the end.
#[derive(Clone, Copy, PartialEq, Debug)]
enum How {
    /// A fault signal, sent to itself.
    Signal(i32),
    /// A second request to stop.
    Twice(i32, i32),
    Panic,
    /// A write to an unmapped address.
    Write,
    /// An endless recursion.
    Overflow,
}

/// Moment of the end.
#[derive(Clone, Copy, PartialEq, Debug)]
enum When {
    /// A rig is running.
    Running,
    /// The rig was replaced, and its buses are closed.
    Replaced,
    /// The rig was replaced, and the next one has opened its buses but has no stop frames yet.
    Between,
}

/// Parameters of one end.
#[derive(Clone, PartialEq, Debug)]
struct Ending {
    how: How,
    when: When,
    /// Free stack at that moment, bytes.
    left: usize,
    /// The stop frames of each bus.
    frames: Vec<Vec<u8>>,
}

impl Ending {
    fn of(seed: u64) -> Ending {
        let mut chance = Chance(seed);
        let asks = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];
        let faults = [libc::SIGSEGV, libc::SIGBUS, libc::SIGILL, libc::SIGFPE, libc::SIGABRT];
        let how = match chance.below(8) {
            0..=2 => How::Signal(faults[chance.below(5) as usize]),
            3 | 4 => How::Twice(asks[chance.below(3) as usize], asks[chance.below(3) as usize]),
            5 => How::Panic,
            6 => How::Write,
            _ => How::Overflow,
        };
        let when = [When::Running, When::Running, When::Replaced, When::Between][chance.below(4) as usize];
        // Mostly near the end of the stack.
        let left = if chance.below(4) == 0 { STACK } else { chance.below(16 * 1024) as usize };
        let frame = |chance: &mut Chance| (0..1 + chance.below(16)).map(|_| chance.number() as u8).collect();
        let frames = (0..1 + chance.below(4)).map(|_| frame(&mut chance)).collect();
        Ending { how, when, left, frames }
    }
}

/// Ends the process.
fn end(how: How) {
    let raise = |signal| {
        // SAFETY: sends a signal to this thread, for which a handler is installed.
        unsafe { libc::raise(signal) };
    };
    match how {
        How::Signal(signal) => raise(signal),
        How::Twice(first, second) => {
            raise(first);
            raise(second);
        }
        How::Panic => panic!("the cycle has failed"),
        // SAFETY: the write is unsound on purpose: its fault is under test.
        How::Write => unsafe { std::ptr::without_provenance_mut::<u8>(black_box(8)).write_volatile(1) },
        How::Overflow => drop(black_box(deeper(0, 0, How::Overflow))),
    }
}

/// Recurses until the stack has grown down to `floor`, then ends the process.
#[inline(never)]
fn deeper(n: u64, floor: usize, how: How) -> u64 {
    let more = black_box([n; 16]);
    if std::ptr::from_ref(&more).addr() <= floor {
        end(how);
        return n;
    }
    deeper(n + 1, floor, how) + black_box(more)[15]
}

/// Body of the child process, which ends within.
fn child(ending: &Ending, folder: &Path) {
    let open = |name: String| File::create(folder.join(name)).expect("a file in a folder of the test");
    let ready = |buses: &[File]| {
        let pairs = buses.iter().zip(&ending.frames);
        prepare(pairs.map(|(bus, frame)| Prepared::new(bus.as_raw_fd(), frame)).collect())
    };
    let buses = |name: &str| (0..ending.frames.len()).map(|i| open(format!("{name} {i}"))).collect::<Vec<File>>();
    guard();
    let first = buses("first");
    let mut rig = Some((ready(&first), first));
    let mut others = Vec::new();
    if ending.when != When::Running {
        drop(rig.take());
        let name = if ending.when == When::Between { "next" } else { "other" };
        others.extend((0..OTHERS).map(|i| open(format!("{name} {i}"))));
    }
    let here = 0u8;
    let floor = std::ptr::from_ref(&here).addr() - STACK + KEPT + ending.left.min(STACK - 2 * KEPT);
    black_box(deeper(0, floor, ending.how));
    drop((rig, others));
}

/// Runs a seed in a process of its own.
///
/// # Errors
/// A violated property.
fn run(seed: u64) -> Result<(), String> {
    let ending = Ending::of(seed);
    let folder = tempfile::tempdir().unwrap();
    let mut process = std::process::Command::new(std::env::current_exe().unwrap());
    process.args(["--exact", "hil::endings::however_a_process_ends_its_stop_frames_reach_its_buses_and_nothing_else"]);
    process.env("FRIC_ENDING", seed.to_string()).env("FRIC_FOLDER", folder.path()).env("RUST_BACKTRACE", "0");
    let out = process.output().unwrap();
    let fail =
        |what: String| Err(format!("seed {seed}, {:?}, {:?}: {what}; {:?}", ending.how, ending.when, out.status));
    if out.status.success() || out.status.signal().is_none() && ending.how != How::Panic {
        return fail("it did not end by a signal".into());
    }
    let mut found = 0;
    for entry in std::fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let bytes = std::fs::read(&path).unwrap();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let frame = name.strip_prefix("first ").and_then(|i| ending.frames.get(i.parse::<usize>().ok()?));
        let wanted = if ending.when == When::Running { frame } else { None };
        found += usize::from(frame.is_some());
        match wanted {
            None if !bytes.is_empty() => return fail(format!("{} bytes in `{name}`", bytes.len())),
            // A panic that exhausts the stack ends by a signal: both send the frames.
            Some(frame) if bytes.len() < 3 * frame.len() || bytes.chunks(frame.len()).any(|chunk| chunk != frame) => {
                return fail(format!("{bytes:02x?} in `{name}` in place of three times {frame:02x?}"));
            }
            _ => {}
        }
    }
    if found == ending.frames.len() { Ok(()) } else { fail("it ended before it had begun".into()) }
}

#[test]
fn however_a_process_ends_its_stop_frames_reach_its_buses_and_nothing_else() {
    if let Some(seed) = number("FRIC_ENDING") {
        let folder = std::env::var_os("FRIC_FOLDER").expect("where its files lie");
        let thread = std::thread::Builder::new().stack_size(STACK);
        let ends = thread.spawn(move || child(&Ending::of(seed), Path::new(&folder))).unwrap().join();
        // A panic ends only the thread.
        return assert!(ends.is_ok(), "the cycle has failed");
    }
    let seeds = seeds(RUNS);
    let failed: Vec<String> = seeds.filter_map(|seed| run(seed).err()).collect();
    if let Some(first) = failed.first() {
        println!("mutant caught: {first}");
    }
    assert!(failed.is_empty(), "{} endings are not as promised:\n{}", failed.len(), failed.join("\n"));
}
