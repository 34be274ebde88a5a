//! Tests of the watchdog against cycles that do not end in time.
//!
//! In: a seed, from which follow a period, a watchdog, and a stall of one cycle in wall-clock time. Out: whether the
//! watchdog acted in time, never early, and only while drives were enabled, and whether the cycle sent nothing but
//! stops after that. The rig runs in simulated time; the stall and the watchdog's thread run in wall-clock time. The
//! reference is the clock, which the test reads around each cycle, and how late its own sleeps end meanwhile.
//! `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::campaign::quick;
use super::cycle::{Command, End, Hil};
use super::emergency::Watchdog;
use super::simulated::{Pace, World};
use crate::can::sim::{Port, Simulation};
use crate::can::{Bus, Frame, Health, Received, Refused};
use crate::drive::Step;
use crate::realtime::clock::{Clock, monotonic_ns};
use crate::rng::Chance;
use crate::safety::Cause;
use crate::testing::generated::{failures, on_threads, seeds};
use crate::testing::rigs;
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Seeds in `cargo test`, and threads that share them: each sleeps most of the time.
const RUNS: u64 = 36;
const THREADS: usize = 4;
const MS: u64 = 1_000_000;
/// Longest time that the system takes to wake a thread, in excess of that for the test's own thread, ns.
const WAKES_NS: u64 = 20 * MS;

/// The point of a cycle at which it stalls.
#[derive(Clone, Copy, PartialEq, Debug)]
enum StallPoint {
    /// After the sleep to its tick.
    Tick,
    /// After the wait for the answers.
    Answers,
    /// After sending the frame with this index.
    Sent(u32),
}

/// Parameters of one run.
#[derive(Clone, Copy, PartialEq, Debug)]
struct StallScript {
    seed: u64,
    /// Period of the rig, ns.
    period_ns: u64,
    /// Time-out of the watchdog, ns of wall-clock time.
    watchdog_ns: u64,
    /// The first cycle that may stall, the point in it, and the duration, ns of wall-clock time.
    cycle: u64,
    place: StallPoint,
    stall_ns: u64,
}

impl StallScript {
    fn of(seed: u64) -> StallScript {
        let mut chance = Chance(seed);
        let watchdog_ns = (10 + chance.below(50)) * MS;
        let place = match chance.below(4) {
            0 => StallPoint::Tick,
            1 => StallPoint::Answers,
            _ => StallPoint::Sent(chance.below(4) as u32),
        };
        let short = chance.below(4) == 0;
        let part = chance.between(0.1, 0.6);
        let stall_ns =
            if short { (watchdog_ns as f64 * part) as u64 } else { watchdog_ns + 50 * MS + chance.below(80) * MS };
        StallScript {
            seed,
            period_ns: [MS, 2 * MS, 4 * MS][chance.below(3) as usize],
            watchdog_ns,
            cycle: 20 + chance.below(500),
            place,
            stall_ns,
        }
    }
}

/// State shared by the clock, the bus and the test.
struct Plan {
    script: StallScript,
    cycle: u64,
    sleeps: u32,
    sends: u32,
    /// Time of the last use of clock or bus, ns.
    touched_ns: u64,
    /// The stalled cycle, begin and end of its stall, and the greatest lateness of a sleep meanwhile, ns.
    stalled: Option<(u64, u64, u64, u64)>,
    /// Sent frames, with their times and cycles.
    sent: Vec<(u64, u64, Frame)>,
}

impl Plan {
    fn passes(&mut self, place: StallPoint) {
        self.touched_ns = monotonic_ns();
        if self.cycle < self.script.cycle || place != self.script.place || self.stalled.is_some() {
            return;
        }
        let (begin, mut late) = (monotonic_ns(), 0);
        let mut now = begin;
        while now < begin + self.script.stall_ns {
            std::thread::sleep(Duration::from_millis(1));
            let woken = monotonic_ns();
            late = late.max((woken - now).saturating_sub(MS));
            now = woken;
        }
        self.stalled = Some((self.cycle, begin, now, late));
    }
}

type Shared = Rc<RefCell<Plan>>;

/// A simulated clock whose sleeps may stall.
struct StallingClock(Simulation, Shared);

impl Clock for StallingClock {
    fn now_ns(&self) -> u64 {
        self.0.now_ns()
    }
    fn sleep_until(&self, until_ns: u64) {
        self.0.sleep_until(until_ns);
        let mut plan = self.1.borrow_mut();
        let place = if plan.sleeps == 0 { StallPoint::Tick } else { StallPoint::Answers };
        plan.sleeps += 1;
        plan.passes(place);
    }
}

/// A bus whose sender may stall.
struct Slow(Port, Shared);

impl Bus for Slow {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        let sent = self.0.send(frame);
        let mut plan = self.1.borrow_mut();
        let (cycle, place) = (plan.cycle, StallPoint::Sent(plan.sends));
        plan.sent.push((monotonic_ns(), cycle, frame));
        plan.sends += 1;
        plan.passes(place);
        sent
    }
    fn receive(&mut self) -> Option<Received> {
        self.0.receive()
    }
    fn wait(&mut self, until_ns: u64) -> bool {
        self.0.wait(until_ns)
    }
    fn health(&self) -> Health {
        self.0.health()
    }
}

/// A cycle as the test observed it: time of its last use of clock or bus, its end, and whether drives were enabled
/// then.
#[derive(Clone, Copy)]
struct Measured {
    touched_ns: u64,
    end_ns: u64,
    awake: bool,
}

/// Outcome of a run.
#[derive(Clone, Copy, Debug, Default)]
struct StallOutcome {
    /// Delay of the watchdog after its time-out, ns.
    late_ns: Option<u64>,
    /// The watchdog had to act; the cycle stalled while no drive was enabled; all cycles were in time.
    had_to: bool,
    asleep: bool,
    in_time: bool,
}

/// Runs a script.
///
/// # Errors
/// A violated property.
fn run(script: &StallScript) -> Result<StallOutcome, String> {
    let (mut rig, model, plant) = rigs::pair();
    rig.nodes.iter_mut().for_each(|node| node.timeout_ns = 3 * script.period_ns);
    (rig.period_ns, rig.watchdog_ns) = (script.period_ns, 5 * script.period_ns);
    let world = World::new(&rig, Some(plant), Pace::Fast, script.seed).unwrap();
    let plan = Rc::new(RefCell::new(Plan {
        script: *script,
        cycle: 0,
        sleeps: 0,
        sends: 0,
        touched_ns: 0,
        stalled: None,
        sent: Vec::new(),
    }));
    let clock = Box::new(StallingClock(world.simulation().clone(), plan.clone()));
    let bus = Box::new(Slow(world.bus(0).port(super::simulated::MASTER), plan.clone()));
    let (mut hil, mut operator) = Hil::new(&rig, model, clock, vec![bus], quick(), None).unwrap();
    let bites = Arc::new(Mutex::new(Vec::new()));
    let bitten = bites.clone();
    let bite = move || bitten.lock().unwrap().push(monotonic_ns());
    hil.watched_by(Watchdog::new(Duration::from_nanos(script.watchdog_ns), bite).unwrap());
    let mut cycles: Vec<Measured> = Vec::new();
    let (mut cause, mut asked_ns) = (None, u64::MAX);
    while hil.ended().is_none() {
        let mut now = plan.borrow_mut();
        (now.cycle, now.sleeps, now.sends) = (cycles.len() as u64, 0, 0);
        drop(now);
        hil.cycle();
        let (end_ns, touched_ns) = (monotonic_ns(), plan.borrow().touched_ns);
        let awake = hil.step() > Step::AwaitEnable && hil.ended().is_none();
        cycles.push(Measured { touched_ns, end_ns, awake });
        cause = cause.or(hil.control().and_then(|control| control.supervisor().cause()));
        if cycles.len() as u64 == 600 {
            asked_ns = monotonic_ns();
            operator.push(Command::Stop);
        }
    }
    let end = hil.ended().cloned();
    drop(hil);
    let bites = bites.lock().unwrap().clone();
    let plan = plan.borrow();
    let Some((at, begin_ns, over_ns, late_ns)) = plan.stalled else {
        // The run ended before the stall.
        return if bites.is_empty() { Ok(StallOutcome::default()) } else { judge_early(&bites, &cycles, script) };
    };
    let mut shown = judge_early(&bites, &cycles, script)?;

    let before = cycles[at as usize - 1];
    let allowed_ns = WAKES_NS + 5 * late_ns;
    let first = bites.first().copied();
    let until_ns = before.end_ns + script.watchdog_ns + allowed_ns;
    if before.awake && over_ns >= until_ns {
        shown.had_to = true;
        if first.is_none_or(|first| first > until_ns) {
            let told = first.map(|first| first as i64 - before.end_ns as i64);
            return Err(format!("the watchdog acted {told:?} ns after the last cycle, {allowed_ns} ns are allowed"));
        }
    }
    shown.asleep = !before.awake && over_ns > begin_ns + script.watchdog_ns;
    shown.in_time = bites.is_empty() && before.awake;
    if let Some(first) = first {
        // If the computer itself paused, a frame of that cycle may already have been on its way.
        let during = begin_ns <= first && first <= over_ns;
        let known_ns = cycles.iter().map(|cycle| cycle.end_ns).find(|end_ns| *end_ns > first).unwrap_or(first);
        let from_ns = if during { over_ns } else { known_ns };
        shown.late_ns = during.then(|| first.saturating_sub(before.end_ns + script.watchdog_ns));
        // SYNC continues while drives stop, but not before the cycle has commanded the stop.
        let mut told = false;
        for (at_ns, cycle, frame) in plan.sent.iter().filter(|(at_ns, ..)| *at_ns > first) {
            let set_point = (0x200..0x280).contains(&frame.id());
            let enables = set_point && frame.data()[0] & 0x0F == 0x0F;
            if *at_ns > from_ns && (enables || frame.id() == 0x080 && !told) {
                return Err(format!("{frame} was sent in cycle {cycle}, after the watchdog had stopped the drives"));
            }
            told |= set_point && !enables;
        }
        if !matches!(end, Some(End::Stopped(..))) && first < asked_ns {
            return Err(format!("the watchdog stopped the drives, and it ended with {end:?}"));
        }
    } else if cause == Some(Cause::Watchdog) || end != Some(End::Asked) {
        return Err(format!("no watchdog has acted, and it ended with {end:?}"));
    }
    let mut bench = world.bench();
    for node in 0..2 {
        let state = bench.drive(node).unwrap().state();
        if state.powered() {
            return Err(format!("drive {node} is {state} at the end"));
        }
    }
    Ok(shown)
}

/// Checks that the watchdog never acted early, and only while drives were enabled.
fn judge_early(bites: &[u64], cycles: &[Measured], script: &StallScript) -> Result<StallOutcome, String> {
    for bite in bites {
        let last = cycles.iter().rev().find(|cycle| cycle.end_ns <= *bite);
        let awake = last.is_some_and(|cycle| cycle.awake);
        let due_ns = last.map_or(u64::MAX, |cycle| cycle.touched_ns + script.watchdog_ns);
        if !awake || *bite < due_ns {
            return Err(format!("the watchdog acted at {bite} ns, due at {due_ns}, drives enabled: {awake}"));
        }
    }
    Ok(StallOutcome::default())
}

#[test]
fn the_watchdog_stops_a_stalled_cycle_in_time_and_no_other() {
    let seeds = seeds(RUNS);
    let all = seeds.end - seeds.start;
    let found = on_threads(seeds, THREADS, |seed| run(&StallScript::of(seed)));
    let failed = failures(&found, StallScript::of);
    let shown: Vec<StallOutcome> = found.iter().filter_map(|(_, shown)| shown.clone().ok()).collect();
    let count = |is: fn(&StallOutcome) -> bool| shown.iter().filter(|shown| is(shown)).count();
    let kinds = [count(|shown| shown.had_to), count(|shown| shown.asleep), count(|shown| shown.in_time)];
    let mut late: Vec<u64> = shown.iter().filter_map(|shown| shown.late_ns).collect();
    late.sort_unstable();
    let late = |part: usize| late.get(late.len() * part / 100).map(|ns| *ns as f64 * 1e-6);
    println!(
        "{all} runs: {} had to act, {} slept, {} were in time; late by {:?} ms, at most {:?}",
        kinds[0],
        kinds[1],
        kinds[2],
        late(50),
        late(99)
    );
    assert!(failed.is_empty(), "{} of {all} are not as promised:\n{}", failed.len(), failed.join("\n"));
    assert!(all < RUNS || kinds.iter().all(|count| *count > 0), "each kind comes: {kinds:?}");
}
