//! Generated tests of logs on disks that stall, fill up, fail and recover while a rig runs.
//!
//! In: a seed. Out: whether cycles continued, whether each message is in the files or counted as missing, whether the
//! files replay to the bit, and whether the end reports losses. The reference is what the test itself noted in each
//! cycle. `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::campaign::quick;
use super::control::Control;
use super::cycle::{Command, End, Hil};
use super::replay::Replay;
use super::simulated::{Pace, World};
use super::trace;
use crate::record::log::{CYCLE, LOST, Message, Reader, STATE, Sections, Settings, Sink};
use crate::record::parts::{Disk, Limits, System};
use crate::rng::Chance;
use crate::testing::generated::{self, hold, seeds};
use crate::testing::rigs;
use std::io::{self, ErrorKind, Write};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// Seeds in `cargo test`.
const RUNS: u64 = 60;
/// Wall-clock time without a cycle after which the test assumes a deadlock: the cycle waits for the disk, which waits
/// for a cycle.
const STUCK: Duration = Duration::from_secs(3);
/// Number of cycles between two state messages in a log.
const STATE_EVERY: u64 = 1000;

/// Fault of a disk, from one of its writes on.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Ill {
    /// It accepts no byte until this many cycles have passed.
    Stalls(u64),
    /// It accepts only a part of each write, or is interrupted; this many times.
    Halting(u64),
    /// This many writes fail, after some of their bytes.
    Fails(u64),
    /// It accepts this many more bytes.
    Full(u64),
    /// Other files have filled it, for this many queries of its free space.
    Filled(u64),
    /// This many new files cannot be opened.
    Sealed(u64),
}

/// Parameters of one run.
#[derive(Clone, PartialEq, Debug)]
struct DiskScript {
    seed: u64,
    /// Faults, each with the write from which it acts, in order.
    ills: Vec<(u64, Ill)>,
    /// Capacity of the queue, in words.
    queue: usize,
    cycles_per_block: u32,
    /// Size of a file, bytes.
    part: u64,
    /// Cycles of the model until the stop; whether the model's output becomes NaN instead.
    cycles: u64,
    fails: bool,
}

impl DiskScript {
    fn of(seed: u64) -> DiskScript {
        let mut chance = Chance(seed);
        let ill = |chance: &mut Chance| match chance.below(8) {
            0..=2 => Ill::Stalls(1 + chance.below(600)),
            3 => Ill::Halting(1 + chance.below(20)),
            4 => Ill::Fails(1 + chance.below(3)),
            5 => Ill::Full(chance.below(20_000)),
            6 => Ill::Filled(1 + chance.below(3)),
            _ => Ill::Sealed(1 + chance.below(2)),
        };
        let ills = (0..[0, 1, 1, 2, 3][chance.below(5) as usize]).map(|_| (chance.below(60), ill(&mut chance)));
        let mut ills: Vec<(u64, Ill)> = ills.collect();
        ills.sort_by_key(|(at, _)| *at);
        DiskScript {
            seed,
            ills,
            queue: [600, 3_000, 20_000][chance.below(3) as usize],
            cycles_per_block: [1, 10, 100][chance.below(3) as usize],
            part: [4_000, 20_000, 1 << 40][chance.below(3) as usize],
            cycles: 100 + chance.below(2400),
            fails: chance.below(6) == 0,
        }
    }
}

/// State shared by the disk and the test.
#[derive(Default)]
struct SharedDisk {
    /// Number of cycles that have passed; the maximum once the run is over.
    cycles: u64,
    /// Number of writes.
    writes: u64,
    ills: Vec<(u64, Ill)>,
    /// The disk has waited in vain for a cycle.
    stuck: bool,
}

#[derive(Clone, Default)]
struct Faulty(Arc<(Mutex<SharedDisk>, Condvar)>);

impl Faulty {
    fn pass(&self, cycles: u64) {
        let (shared, passed) = &*self.0;
        let mut shared = shared.lock().unwrap();
        shared.cycles = cycles;
        drop(shared);
        passed.notify_all();
    }

    /// The fault of this kind that acts now, if any; `change` updates it.
    fn wrong(&self, is: impl Fn(Ill) -> bool, change: impl FnOnce(&mut Ill)) -> Option<Ill> {
        let mut shared = self.0.0.lock().unwrap();
        let writes = shared.writes;
        let at = shared.ills.iter().position(|(from, ill)| *from <= writes && is(*ill))?;
        let ill = shared.ills[at].1;
        change(&mut shared.ills[at].1);
        match shared.ills[at].1 {
            Ill::Halting(0) | Ill::Fails(0) | Ill::Filled(0) | Ill::Sealed(0) => _ = shared.ills.remove(at),
            _ => {}
        }
        Some(ill)
    }

    fn stall(&self) {
        // The cycle itself writes the head, before a drive is enabled.
        if std::thread::current().name() != Some("fric log") {
            return;
        }
        let Some(Ill::Stalls(cycles)) = self.wrong(|ill| matches!(ill, Ill::Stalls(_)), |_| ()) else { return };
        let (shared, passed) = &*self.0;
        let mut shared = shared.lock().unwrap();
        let until = shared.cycles.saturating_add(cycles);
        while shared.cycles < until {
            let before = shared.cycles;
            let (now, waited) = passed.wait_timeout(shared, STUCK).unwrap();
            shared = now;
            if waited.timed_out() && shared.cycles == before {
                shared.stuck = true;
                break;
            }
        }
        let at = shared.ills.iter().position(|(_, ill)| *ill == Ill::Stalls(cycles)).expect("it is still there");
        shared.ills.remove(at);
    }
}

fn less(count: &mut u64) {
    *count -= 1;
}

impl Disk for Faulty {
    fn create(&self, first: &Path, number: u32) -> io::Result<Box<dyn Write + Send>> {
        let sealed = |ill: &mut Ill| {
            if let Ill::Sealed(count) = ill {
                less(count)
            }
        };
        if number > 1 && self.wrong(|ill| matches!(ill, Ill::Sealed(_)), sealed).is_some() {
            return Err(ErrorKind::ReadOnlyFilesystem.into());
        }
        Ok(Box::new(DiskPart { disk: self.clone(), file: System.create(first, number)? }))
    }

    fn free(&self, path: &Path) -> io::Result<u64> {
        let filled = |ill: &mut Ill| {
            if let Ill::Filled(count) = ill {
                less(count)
            }
        };
        let is_filled = self.wrong(|ill| matches!(ill, Ill::Filled(_)), filled).is_some();
        if is_filled { Ok(0) } else { System.free(path).map(|_| u64::MAX) }
    }
}

struct DiskPart {
    disk: Faulty,
    file: Box<dyn Write + Send>,
}

impl Write for DiskPart {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.disk.0.0.lock().unwrap().writes += 1;
        self.disk.stall();
        let mut room = bytes.len();
        let full = |ill: &mut Ill| {
            if let Ill::Full(left) = ill {
                *left = left.saturating_sub(bytes.len() as u64)
            }
        };
        if let Some(Ill::Full(left)) = self.disk.wrong(|ill| matches!(ill, Ill::Full(_)), full) {
            room = room.min(left as usize);
        }
        if room == 0 && !bytes.is_empty() {
            return Err(ErrorKind::StorageFull.into());
        }
        let fails = |ill: &mut Ill| {
            if let Ill::Fails(count) = ill {
                less(count)
            }
        };
        if self.disk.wrong(|ill| matches!(ill, Ill::Fails(_)), fails).is_some() {
            self.file.write_all(&bytes[..room / 2])?;
            return Err(io::Error::other("the disk has failed"));
        }
        let halting = |ill: &mut Ill| {
            if let Ill::Halting(count) = ill {
                less(count)
            }
        };
        if let Some(Ill::Halting(count)) = self.disk.wrong(|ill| matches!(ill, Ill::Halting(_)), halting) {
            if count % 2 == 0 {
                return Err(ErrorKind::Interrupted.into());
            }
            room = room.div_ceil(3);
        }
        self.file.write_all(&bytes[..room])?;
        Ok(room)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Outcome of a run's messages.
#[derive(Clone, Copy, Debug, Default)]
struct Fate {
    written: u64,
    dropped: u64,
    broken: bool,
    parts: u64,
    skipped: u64,
}

/// Runs a script in simulated time.
///
/// # Errors
/// A violated property.
fn run(script: &DiskScript) -> Result<Fate, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.friclog");
    let disk = Faulty::default();
    disk.0.0.lock().unwrap().ills.clone_from(&script.ills);
    let limits = Limits { part: script.part, ..Limits::default() };
    let sink = Sink::On(Box::new(disk.clone()), path.clone(), limits, script.queue);
    let settings = Settings { sink, cycles_per_block: script.cycles_per_block, patient: false };
    let (rig, mut model, plant) = rigs::pair();
    if script.fails {
        let slot = model.description().layout.params.slot(2);
        model.set(slot, script.cycles as f64 * 1e-3);
    }
    let mut world = World::new(&rig, Some(plant), Pace::Fast, script.seed).unwrap();
    let masters = world.masters();
    let log = Some((settings, Sections::default().with("rig", "pair")));
    let (mut hil, mut operator) = Hil::new(&rig, model.clone(), world.clock(), masters, quick(), log).unwrap();
    let mut truth: Vec<Message> = Vec::new();
    let mut words = Vec::new();
    while hil.ended().is_none() {
        hil.cycle();
        disk.pass(hil.counts().all);
        let commands = std::mem::take(&mut hil.commanded);
        let Some(control) = hil.control() else { continue };
        let mut note = |kind, write: &dyn Fn(&mut Vec<u64>)| {
            words.clear();
            write(&mut words);
            truth.push(Message { kind, words: words.clone() });
        };
        // Commands stand before the cycle that has taken them.
        commands.iter().for_each(|command| note(trace::COMMAND, &|words| words.extend_from_slice(command)));
        note(CYCLE, &|words| hil.last().write(words));
        note(trace::FRAMES, &|words| words.extend_from_slice(hil.last_frames()));
        let k = hil.last().k + 1;
        if k.is_multiple_of(STATE_EVERY) {
            note(STATE, &|words| trace::write_state(k, control, words));
        }
        if hil.counts().cycles == script.cycles {
            operator.push(Command::Stop);
        }
    }
    disk.pass(u64::MAX);
    let (counted, missed, end) = (hil.counts().log_dropped, hil.counts().missed, hil.ended().cloned());
    let finished = hil.finish();
    if disk.0.0.lock().unwrap().stuck {
        return Err("a cycle waits for the disk".into());
    }
    if let Some(End::Refused(why)) = &end {
        // Its head was not written: this must be reported before anything moves.
        let said = why.contains("the log cannot be written") && truth.is_empty();
        return if said { Ok(Fate::default()) } else { Err(format!("refused: {why}")) };
    }
    if (end == Some(End::Asked)) == script.fails || missed > 0 {
        return Err(format!("it ended with {end:?}, {missed} ticks missed"));
    }

    // Compares the file with the noted messages.
    let mut reader = Reader::open(&path)?;
    let (bounds, options) = trace::settings_from_bytes(reader.head.get("settings").unwrap()).unwrap();
    let mut replay = Replay::new(&rig, Control::new(&rig, model, None, &bounds, options)?);
    let (mut at, mut fate) = (0, Fate { broken: finished.is_err(), ..Fate::default() });
    loop {
        let message = match reader.message() {
            Ok(Some(message)) => message,
            Ok(None) => break,
            Err(error) => return Err(format!("message {at}: {error}")),
        };
        replay.message(&message).map_err(|stopped| format!("message {at} does not replay: {stopped:?}"))?;
        if message.kind == LOST {
            at += message.words[0] as usize;
            continue;
        }
        if truth.get(at) != Some(&message) {
            return Err(format!("message {at} is of kind {}, and not what was handed over", message.kind));
        }
        (at, fate.written) = (at + 1, fate.written + 1);
    }
    fate.skipped = replay.found().skipped;
    fate.dropped = truth.len() as u64 - fate.written;
    let (told, dropped) = match &finished {
        Ok(summary) => {
            let summary = summary.as_ref().expect("there is a log");
            fate.parts = summary.parts;
            let tail = reader.tail().and_then(|tail| tail.text("counts")).unwrap_or_default();
            let line = format!("log      {} messages dropped", fate.dropped);
            if at != truth.len() || !tail.contains(&line) {
                return Err(format!("{at} of {} messages, and its end says `{tail}`", truth.len()));
            }
            (counted, summary.dropped)
        }
        Err(error) => {
            let said = error.to_string();
            let number = said.strip_suffix(" messages are not in it").and_then(|said| said.rsplit("; ").next());
            // The last messages may still be under way when the cycle counts.
            let number = number.and_then(|number| number.parse().ok()).ok_or(said)?;
            (counted.max(number), number)
        }
    };
    if (told, dropped) != (fate.dropped, fate.dropped) {
        return Err(format!("{fate:?}, and {told} are counted, {dropped} told at the end"));
    }
    Ok(fate)
}

/// Simplifies a failing script while it still fails.
fn shrunk(script: &DiskScript, why: String) -> (DiskScript, String) {
    let simpler = |best: &DiskScript| {
        let mut smaller: Vec<DiskScript> = (0..best.ills.len())
            .map(|at| {
                let mut other = best.clone();
                other.ills.remove(at);
                other
            })
            .collect();
        smaller.push(DiskScript { part: 1 << 40, ..best.clone() });
        smaller.push(DiskScript { queue: 20_000, ..best.clone() });
        smaller.push(DiskScript { fails: false, ..best.clone() });
        smaller.push(DiskScript { cycles: best.cycles / 2, ..best.clone() });
        smaller.retain(|other| other.cycles > 50);
        smaller
    };
    generated::shrunk(script, why, simpler, run)
}

#[test]
fn each_message_is_logged_or_counted_for_any_disk_fault() {
    let seeds = seeds(RUNS);
    let all = seeds.end - seeds.start;
    let (mut dropped, mut broken, mut rolled, mut skipped) = (0, 0, 0, 0);
    let failed = hold(seeds, DiskScript::of, run, shrunk, |fate| {
        dropped += u64::from(fate.dropped > 0 && !fate.broken);
        broken += u64::from(fate.broken);
        rolled += u64::from(fate.parts > 1);
        skipped += u64::from(fate.skipped > 0);
    });
    println!(
        "{all} runs: {dropped} dropped some, {broken} broke, {rolled} went on in further files, {skipped} with gaps"
    );
    assert!(failed.is_empty(), "{failed:?}");
    assert!(all < RUNS || [dropped, broken, rolled, skipped].iter().all(|count| *count > 0), "each kind comes");
}
