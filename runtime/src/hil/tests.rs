//! Tests of a whole rig in simulated time: start, run, stop, log and replay.

use super::control::Control;
use super::coupling::look_ahead;
use super::cycle::{End, Hil, Options};
use super::replay::{Replay, Stopped};
use super::simulated::{Pace, World};
use super::trace;
use crate::drive::Step;
use crate::record::log::{Reader, Sections, Settings, Sink};
use crate::record::parts::Limits;
use crate::testing::rigs;
use abi::Instance;
use abi::rig::Rig;
use std::path::Path;

const SECOND_NS: u64 = 1_000_000_000;

fn options(seconds: f64) -> Options {
    Options { arms_itself: true, duration_ns: Some((seconds * 1e9) as u64), ..Options::default() }
}

type Made = (Rig, Instance, Instance);

/// The pair of drives, with a predictor for the load.
fn looking_ahead() -> Made {
    let (rig, control, plant) = rigs::pair();
    (Rig { predict: Some(0), ..rig }, control, plant)
}

/// Runs the pair of drives for a time, with an optional log.
fn run(seconds: f64, log: Option<&Path>) -> (End, Hil, World) {
    run_of(rigs::pair(), seconds, log)
}

fn run_of((rig, model, plant): Made, seconds: f64, log: Option<&Path>) -> (End, Hil, World) {
    let options = Options { look: look_ahead(&rig, &plant).unwrap(), ..options(seconds) };
    let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
    let masters = world.masters();
    let settings = log.map(|path| {
        let settings =
            Settings { sink: Sink::File(path.into(), Limits::default()), cycles_per_block: 100, patient: true };
        (settings, Sections::default().with("rig", "pair"))
    });
    let (mut hil, _) = Hil::new(&rig, model, world.clock(), masters, options, settings).unwrap();
    let end = hil.run();
    (end, hil, world)
}

fn replay(path: &Path, change: impl Fn(&mut crate::record::log::Message)) -> Result<u64, Stopped> {
    replay_of(rigs::pair(), path, change)
}

fn replay_of(
    (rig, model, plant): Made,
    path: &Path,
    change: impl Fn(&mut crate::record::log::Message),
) -> Result<u64, Stopped> {
    let mut reader = Reader::open(path).unwrap();
    let (bounds, options) = trace::settings_from_bytes(reader.head.get("settings").unwrap()).unwrap();
    let control = Control::new(&rig, model, look_ahead(&rig, &plant).unwrap(), &bounds, options).unwrap();
    let mut replay = Replay::new(&rig, control);
    while let Some(mut message) = reader.message().unwrap() {
        change(&mut message);
        replay.message(&message)?;
    }
    assert_eq!((replay.found().skipped, replay.found().lost), (0, 0));
    Ok(replay.found().cycles)
}

#[test]
fn a_rig_starts_runs_and_ends_as_asked() {
    let (end, hil, world) = run(2.0, None);
    assert_eq!(end, End::Asked, "{:?}", hil.step());
    let counts = hil.counts();
    assert_eq!((counts.cycles, counts.missed, counts.refused_frames, counts.lost_frames), (2000, 0, 0, 0));
    let shaft = world.bench().shaft(0);
    assert!(shaft.position.abs() > 0.1, "it turned: {shaft:?}");
}

#[test]
fn a_log_replays_to_the_bit_and_names_what_differs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pair.friclog");
    let (end, hil, _) = run(3.0, Some(&path));
    assert_eq!(end, End::Asked);
    let all = hil.counts().all;
    let summary = hil.finish().unwrap().unwrap();
    assert_eq!(summary.dropped, 0);
    let cycles = replay(&path, |_| ()).unwrap();
    assert!(cycles > 3000 && cycles <= all, "{cycles} of {all}");
    // Flips one bit of one reading in one cycle.
    let flipped = replay(&path, |message| {
        if message.kind == trace::CYCLE && message.words[0] == 2500 {
            message.words[6] ^= 1 << 40;
        }
    });
    let Err(Stopped::Differs(difference)) = flipped else { panic!("{flipped:?}") };
    assert!(difference.k == 2500, "{difference:?}");
}

#[test]
fn a_rig_with_a_predictor_replays_to_the_bit_from_any_state_of_its_log() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ahead.friclog");
    let (end, hil, _) = run_of(looking_ahead(), 3.0, Some(&path));
    assert_eq!(end, End::Asked);
    let coupling = hil.counts().coupling.unwrap();
    assert_eq!(coupling.unpredicted, 0, "{coupling:?}");
    // The prediction error is a few counts of the encoder.
    assert!(coupling.residual_max < 20.0 * 2.4e-5, "{coupling:?}");
    hil.finish().unwrap();
    let cycles = replay_of(looking_ahead(), &path, |_| ()).unwrap();
    assert!(cycles > 3000, "{cycles}");
    // The beginning is lost: the replay continues from the next state, which includes the observer.
    let (rig, model, plant) = looking_ahead();
    let mut reader = Reader::open(&path).unwrap();
    let (bounds, options) = trace::settings_from_bytes(reader.head.get("settings").unwrap()).unwrap();
    let control = Control::new(&rig, model, look_ahead(&rig, &plant).unwrap(), &bounds, options).unwrap();
    let mut late = Replay::new(&rig, control);
    while let Some(message) = reader.message().unwrap() {
        if message.kind != trace::CYCLE || message.words[0] > 1500 {
            late.message(&message).unwrap();
        }
    }
    assert!(late.found().cycles > 1000, "{:?}", late.found());
    // Without the predictor it is another rig.
    let plain = replay(&path, |_| ());
    assert!(plain.is_err(), "{plain:?}");
}

#[test]
fn two_equal_runs_leave_equal_logs() {
    let folder = tempfile::tempdir().unwrap();
    let log = |name: &str| {
        let path = folder.path().join(name);
        let (_, hil, _) = run(1.0, Some(&path));
        hil.finish().unwrap();
        std::fs::read(path).unwrap()
    };
    assert!(log("a") == log("b"), "the logs differ");
}

#[test]
fn a_rig_with_missing_drives_is_refused() {
    let (rig, model, plant) = rigs::pair();
    let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
    world.bus(0).unplug(super::simulated::BENCH, 0, u64::MAX);
    let masters = world.masters();
    let (mut hil, _) = Hil::new(&rig, model, world.clock(), masters, options(1.0), None).unwrap();
    let End::Refused(why) = hil.run() else { panic!("it started") };
    assert!(why.contains("servo") || why.contains("load"), "{why}");
    assert!(world.clock().now_ns() < 20 * SECOND_NS);
}

/// A rig that has not started gives way to the package before it; one that has waited for its operator does not.
/// Mutant tried: a refused start-up counts as started.
#[test]
fn a_rig_has_started_once_it_waits_for_its_operator() {
    let mut refused = [0; 2];
    for tenths in 0..30 {
        let (rig, model, plant) = rigs::pair();
        let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
        world.bus(0).unplug(super::simulated::BENCH, tenths * SECOND_NS / 10, u64::MAX);
        let masters = world.masters();
        let (mut hil, _) = Hil::new(&rig, model, world.clock(), masters, Options::default(), None).unwrap();
        let mut waited = false;
        while hil.ended().is_none() && world.clock().now_ns() < 20 * SECOND_NS {
            hil.cycle();
            waited |= hil.step() == Step::AwaitEnable;
        }
        assert_eq!(hil.has_started(), waited, "unplugged after {tenths} tenths of a second");
        assert!(matches!(hil.ended(), Some(End::Refused(_))), "{:?}", hil.ended());
        refused[usize::from(waited)] += 1;
    }
    assert!(refused.iter().all(|count| *count > 2), "before and after it waits: {refused:?}");
}
