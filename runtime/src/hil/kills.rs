//! Generated tests of the drives' own time-outs: processes that are killed while their rig runs.
//!
//! In: a seed, from which follow a rig, its watchdog, which drives have a deadline for set-points, and a moment. Out:
//! whether each drive left "operation enabled" within its time-out after the process was gone, and lost its torque soon
//! after. The rig runs in a process of its own, in wall-clock time; the drives are simulated in the test's process,
//! which sees their true torque. `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::campaign::quick;
use super::cycle::Hil;
use crate::can::bridge::Hub;
use crate::can::sim::Simulation;
use crate::can::socketcand::Server;
use crate::can::{self, socketcand};
use crate::drive::attend;
use crate::drive::simulated_plant::SimulatedBench;
use crate::drive::state::State;
use crate::realtime::clock::Clock;
use crate::rng::Chance;
use crate::testing::generated::{failures, number, on_threads, seeds};
use crate::testing::rigs;
use abi::Instance;
use abi::rig::Rig;
use std::process::{Command, Stdio};

/// Seeds in `cargo test`, and threads that share them.
const RUNS: u64 = 12;
const THREADS: usize = 4;
const MS: u64 = 1_000_000;
/// Longest delay of a frame on a busy computer, in excess of the greatest pause of the test's own loop, ns.
const SLACK_NS: u64 = 15 * MS;
/// Time from the time-out to the end of the drive's own braking, ns.
const BRAKE_NS: u64 = 150 * MS;
/// Longest duration of a start, ns.
const START_NS: u64 = 20_000 * MS;
/// Torque that counts as zero, N·m: one quantisation step.
const NONE: f64 = 4e-3;

/// Moment at which the process is killed.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Moment {
    /// This time after it has connected to its bus, ns.
    Starting(u64),
    /// This time after the first torque on the shaft, ns.
    Moving(u64),
}

/// Parameters of one run.
#[derive(Clone, Copy, PartialEq, Debug)]
struct KillScript {
    seed: u64,
    period_ns: u64,
    watchdog_ns: u64,
    /// Which drives detect missing set-points by themselves.
    deadlines: [bool; 2],
    moment: Moment,
}

impl KillScript {
    fn of(seed: u64) -> KillScript {
        let mut chance = Chance(seed);
        let moment = match chance.below(4) {
            0 => Moment::Starting(chance.below(600) * MS),
            _ => Moment::Moving(chance.below(300) * MS),
        };
        KillScript {
            seed,
            period_ns: [2 * MS, 4 * MS, 5 * MS][chance.below(3) as usize],
            watchdog_ns: (40 + chance.below(120)) * MS,
            deadlines: [chance.below(2) == 0, chance.below(3) == 0],
            moment,
        }
    }

    fn build(&self) -> (Rig, Instance, Instance) {
        let (mut rig, model, plant) = rigs::pair();
        rig.nodes.iter_mut().for_each(|node| node.timeout_ns = 3 * self.period_ns);
        (rig.period_ns, rig.watchdog_ns) = (self.period_ns, self.watchdog_ns);
        (rig, model, plant)
    }
}

/// Body of the child process: runs the rig until it is killed.
fn child(script: &KillScript, port: u16) {
    let (rig, model, _) = script.build();
    let world = Simulation::real_time();
    let clock = world.monotonic().expect("its time is real");
    let options = can::Options { bit_rate: Some(1_000_000), ..can::Options::default() };
    let bus = socketcand::Client::open("127.0.0.1", port, "can0", &options, clock).unwrap();
    let mut options = quick();
    // This computer guarantees no processor time.
    options.control.count_overruns = true;
    options.start.missed = 0.5;
    let (mut hil, _) = Hil::new(&rig, model, Box::new(world), vec![Box::new(bus)], options, None).unwrap();
    let end = hil.run();
    panic!("it ended by itself: {end:?}");
}

/// Outcome of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
enum KillOutcome {
    /// The moment was not reached, because this computer was too busy.
    Nothing,
    /// No drive was enabled when the process was killed.
    Idle,
    /// Time from the end of the process until no drive was enabled, as a share of the time-out.
    Stopped(f64),
}

/// Runs a script.
///
/// # Errors
/// A violated property.
fn run(script: &KillScript) -> Result<KillOutcome, String> {
    let (rig, _, plant) = script.build();
    let world = Simulation::real_time();
    let clock = world.monotonic().expect("its time is real");
    let bus = world.bus("can0", 1_000_000);
    let mut bench = SimulatedBench::new(&rig, Some(plant), script.seed)?.in_steps_of(200_000);
    for (node, has) in script.deadlines.into_iter().enumerate() {
        if !has {
            bench.drive(node).unwrap().without_deadlines();
        }
    }
    let mut hub = Hub::new();
    hub.join("can0", Box::new(bus.port("outside")));
    let bench = attend(&world, &[bus], &rig, bench);
    let mut server = Server::listen(0, false, clock).map_err(|why| why.to_string())?;
    let also = [server.descriptor()];
    let mut process = Command::new(std::env::current_exe().unwrap());
    process.args(["--exact", "hil::kills::the_drives_of_a_killed_process_lose_their_torque_within_their_time_out"]);
    process.env("FRIC_KILLED", script.seed.to_string()).env("FRIC_PORT", server.port().to_string());
    let mut process = process.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();

    let (mut begun_ns, mut kill_ns, mut killed_ns) = (None, None, None);
    let (mut longest_ns, mut last_ns) = (0, world.now_ns());
    let (mut enabled, mut stopped_ns) = (false, 0);
    let timeout_ns = script.watchdog_ns.div_ceil(MS) * MS;
    let shown = loop {
        while let Some(connection) = server.accept() {
            hub.admit("rig", Box::new(connection));
        }
        hub.pass_on(|_, _| {});
        hub.wait(&world, &also, world.now_ns() + MS);
        let now_ns = world.now_ns();
        let states = [0, 1].map(|node| {
            let mut bench = bench.borrow_mut();
            let drive = bench.drive(node).unwrap();
            (drive.state(), drive.torque())
        });
        let Some(gone_ns) = killed_ns else {
            if process.try_wait().unwrap().is_some() || now_ns > START_NS {
                break Ok(KillOutcome::Nothing);
            }
            let begins = match script.moment {
                Moment::Starting(_) => hub.members().len() > 1,
                Moment::Moving(_) => states.iter().any(|(_, torque)| torque.abs() > NONE),
            };
            if begins {
                begun_ns = begun_ns.or(Some(now_ns));
            }
            let (Moment::Starting(after) | Moment::Moving(after)) = script.moment;
            kill_ns = kill_ns.or(begun_ns.map(|begun| begun + after));
            if kill_ns.is_some_and(|kill| now_ns >= kill) {
                process.kill().unwrap();
                process.wait().unwrap();
                killed_ns = Some(world.now_ns());
                enabled = states.iter().any(|(state, _)| *state == State::Enabled);
                (longest_ns, last_ns) = (0, world.now_ns());
            }
            continue;
        };
        // A pause of this loop also pauses the drives.
        longest_ns = longest_ns.max(now_ns - last_ns);
        last_ns = now_ns;
        let bound_ns = gone_ns + timeout_ns + SLACK_NS + 2 * longest_ns;
        for (node, (state, torque)) in states.into_iter().enumerate() {
            let after = (now_ns - gone_ns) as f64 * 1e-6;
            if state == State::Enabled {
                stopped_ns = now_ns - gone_ns;
            }
            if state == State::Enabled && now_ns > bound_ns {
                return Err(format!("drive {node} is {state} {after:.1} ms after the process was killed"));
            }
            if now_ns > bound_ns + BRAKE_NS && (state.powered() || torque.abs() > NONE) {
                return Err(format!("drive {node} is {state} with {torque:.3} N·m after {after:.1} ms"));
            }
        }
        if now_ns > bound_ns + BRAKE_NS + 20 * MS {
            break Ok(if enabled {
                KillOutcome::Stopped(stopped_ns as f64 / timeout_ns as f64)
            } else {
                KillOutcome::Idle
            });
        }
    };
    let _ = process.kill();
    let _ = process.wait();
    shown
}

#[test]
fn the_drives_of_a_killed_process_lose_their_torque_within_their_time_out() {
    if let Some(seed) = number("FRIC_KILLED") {
        return child(&KillScript::of(seed), number("FRIC_PORT").expect("where its drives are") as u16);
    }
    let seeds = seeds(RUNS);
    let all = (seeds.end - seeds.start) as usize;
    let found = on_threads(seeds, THREADS, |seed| run(&KillScript::of(seed)));
    let failed = failures(&found, KillScript::of);
    let (mut stopped, mut latest, mut nothing) = (0, 0.0f64, 0);
    for shown in found.iter().filter_map(|(_, shown)| shown.as_ref().ok()) {
        match shown {
            KillOutcome::Nothing => nothing += 1,
            KillOutcome::Idle => {}
            KillOutcome::Stopped(part) => (stopped, latest) = (stopped + 1, latest.max(*part)),
        }
    }
    println!(
        "{all} kills: {stopped} with a drive enabled, stopped after {latest:.2} of its time-out at most; {nothing} not begun"
    );
    assert!(failed.is_empty(), "{} of {all} are not as promised:\n{}", failed.len(), failed.join("\n"));
    assert!(
        all < RUNS as usize || stopped >= all / 3,
        "{stopped} of {all} had a drive enabled, {nothing} did not begin"
    );
}
