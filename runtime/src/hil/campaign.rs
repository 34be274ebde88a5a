//! The fault campaign: one named test for each fault on the list, in simulated time, each with a bound on the reaction
//! time. The [fault space](super::faults) generates further combinations.
//!
//! Every test checks in every cycle that no command exceeds its limit and that no drive's torque on the shaft exceeds
//! that of the drive. After every stop no drive is under torque.

use super::control;
use super::coupling::look_ahead;
use super::cycle::{Command, End, Hil, Operator, Options};
use super::live::Set;
use super::simulated::{BENCH, MASTER, Pace, World};
use crate::can::sim::{BusFaultKind as FaultKind, Fault, Port};
use crate::can::{Bus, Frame};
use crate::drive::fault_injection::{self, Effect, Hook, Start};
use crate::drive::polarity_check::SignTest;
use crate::drive::{self, Step};
use crate::record::log::{Sections, Settings, Sink};
use crate::record::parts::Limits;
use crate::safety::{Cause, DriveCommand};
use crate::testing::rigs;
use abi::rig::{Cia402, Kind, Overrun, Rig};
use abi::{Instance, Slot};
use std::os::unix::fs::OpenOptionsExt;

const MS: u64 = 1_000_000;
/// Bound on everything that follows a trip: slew, quick stop, torque off.
const STOP_NS: u64 = 2_100 * MS;

/// A rig to which a fault is applied.
struct Stand {
    hil: Hil,
    operator: Operator,
    world: World,
    rig: Rig,
    /// The supervisor's cause and the time when it was first seen.
    cause: Option<(Cause, u64)>,
    /// The last permitted outputs.
    last: [f64; 2],
    /// Highest power of each drive, W.
    power: f64,
}

/// Options for a quick start, for tests of later phases.
pub(super) fn quick() -> Options {
    let start = drive::Options {
        listen_ns: 5 * MS,
        steady_ns: 20 * MS,
        sign_test: SignTest::Skip,
        timeout_test: false,
        ..drive::Options::default()
    };
    let control = control::Options { ramp_ns: 10 * MS, clamped_ns: 150 * MS, ..control::Options::default() };
    Options { control, start, arms_itself: true, ..Options::default() }
}

fn cia402(rig: &mut Rig, node: usize) -> &mut Cia402 {
    match &mut rig.nodes[node].kind {
        Kind::Cia402(drive) => drive,
        Kind::Frames(_) => panic!("node {node} is a device"),
    }
}

impl Stand {
    fn new(options: Options, seed: u64, change: impl FnOnce(&mut Rig, &mut Instance)) -> Stand {
        let (mut rig, mut model, plant) = rigs::pair();
        change(&mut rig, &mut model);
        Stand::of((rig, model, plant), options, seed, None)
    }

    fn of(made: (Rig, Instance, Instance), options: Options, seed: u64, log: Option<Settings>) -> Stand {
        let (mut rig, model, plant) = made;
        let options = Options { look: look_ahead(&rig, &plant).unwrap(), ..options };
        let mut world = World::new(&rig, Some(plant), Pace::Fast, seed).unwrap();
        let masters = world.masters();
        let log = log.map(|settings| (settings, Sections::default()));
        let judge = rigs::judge(&model);
        let (mut hil, operator) = Hil::new(&rig, model, world.clock(), masters, options, log).unwrap();
        hil.judged_by(judge);
        let power = cia402(&mut rig, 0).max_power.unwrap_or(f64::INFINITY);
        Stand { hil, operator, world, rig, cause: None, last: [0.0; 2], power }
    }

    /// A rig that has been armed and has run for 300 ms.
    fn armed(change: impl FnOnce(&mut Rig, &mut Instance)) -> Stand {
        let mut stand = Stand::new(quick(), 1, change);
        stand.reach(Step::Armed);
        let until = stand.now() + 300 * MS;
        while stand.now() < until {
            stand.cycle();
        }
        assert_eq!(stand.hil.ended(), None);
        assert_eq!(stand.cause, None);
        stand
    }

    fn now(&self) -> u64 {
        self.world.clock().now_ns()
    }

    fn reach(&mut self, step: Step) {
        while self.hil.step() != step {
            self.cycle();
            assert_eq!(self.hil.ended(), None, "before {step}");
        }
    }

    /// One cycle, with the checks that hold in every cycle.
    fn cycle(&mut self) {
        self.hil.cycle();
        let now = self.now();
        if let Some(control) = self.hil.control() {
            let supervisor = control.supervisor();
            if self.cause.is_none() {
                self.cause = supervisor.cause().map(|cause| (cause, now));
            }
            let follows = self.hil.order() == DriveCommand::Follow;
            let speeds = self.hil.seen().iter().map(|seen| seen.speed.unwrap_or(0.0)).collect::<Vec<f64>>();
            for (i, (limits, value)) in supervisor.outputs().iter().zip(supervisor.permitted()).enumerate() {
                assert!(limits.low <= *value && *value <= limits.high, "{value} at {now} ns");
                let most = limits.slew * self.rig.period_ns as f64 * 1e-9 * (1.0 + 1e-9);
                let power = value * speeds[limits.drive.unwrap_or_default()];
                assert!(!follows || (value - self.last[i]).abs() <= most, "from {} to {value}", self.last[i]);
                assert!(!follows || self.cause.is_some() || power.abs() <= self.power * (1.0 + 1e-9), "{power} W");
                self.last[i] = *value;
            }
        }
        for (node, most) in [(0, 1.0), (1, 2.0)] {
            let torque = self.world.bench().shaft(node).torque;
            // Between a command and the shaft lie one quantisation step of the torque, and its lag.
            assert!(torque.abs() <= most * 1.01 + 0.01, "{torque} N·m at {node}, {now} ns, {:?}", self.cause);
        }
    }

    fn hook(&mut self, text: &str) -> u64 {
        let now = self.now();
        let hook = fault_injection::read(&format!("{text} at {} s", now as f64 * 1e-9), &self.rig).unwrap();
        self.world.bench().hook(hook);
        now
    }

    fn effect(&mut self, node: usize, effect: Effect, lasts_ns: Option<u64>) -> u64 {
        let now = self.now();
        self.world.bench().hook(Hook { node, effect, start: Start::At(now), lasts_ns });
        now
    }

    /// Runs until the rig has stopped by itself: the cause, and the time from `since` until it was seen, ns.
    fn stops(&mut self, since: u64) -> (Cause, u64) {
        let limit = since + 2 * STOP_NS;
        while self.hil.ended().is_none() {
            self.cycle();
            assert!(self.now() < limit, "it goes on: {:?}, {:?}", self.cause, self.hil.step());
        }
        let (cause, at) = self.cause.expect("a stop has its cause");
        assert!(matches!(self.hil.ended(), Some(End::Stopped(..))), "{:?}", self.hil.ended());
        self.at_rest();
        assert!(self.now() - at <= STOP_NS, "{} ns from the trip to the end", self.now() - at);
        (cause, at - since)
    }

    /// Runs until the end.
    fn ends(&mut self) -> End {
        let limit = self.now() + 60_000 * MS;
        loop {
            self.cycle();
            if let Some(end) = self.hil.ended() {
                return end.clone();
            }
            assert!(self.now() < limit, "it goes on: {:?}", self.hil.step());
        }
    }

    /// Checks that neither drive's power stage is on.
    fn at_rest(&mut self) {
        for node in 0..2 {
            let mut bench = self.world.bench();
            let state = bench.drive(node).unwrap().state();
            assert!(!state.powered(), "drive {node} is {state}");
        }
    }

    /// Runs for a time in which nothing may stop the rig.
    fn goes_on(&mut self, ns: u64) {
        let until = self.now() + ns;
        while self.now() < until {
            self.cycle();
            assert_eq!((self.cause, self.hil.ended()), (None, None));
        }
    }
}

/// Sets a parameter of the control program: 0 amplitude, 1 damping, 2 time from which its output is NaN.
fn param(model: &mut Instance, i: usize, value: f64) {
    let slot = model.description().layout.params.slot(i);
    model.set(slot, value);
}

fn within(found: (Cause, u64), ns: u64) -> Cause {
    assert!(found.1 <= ns, "{:?} after {} ns", found.0, found.1);
    found.0
}

#[test]
fn row_1_a_model_that_gives_no_number() {
    let mut stand = Stand::armed(|_, model| param(model, 2, 0.4));
    let since = stand.now() + 100 * MS;
    assert_eq!(within(stand.stops(since - 100 * MS), 110 * MS), Cause::NotFinite(0));
}

#[test]
fn row_2_a_tick_that_is_missed() {
    let mut stand = Stand::armed(|rig, _| rig.overrun = Overrun::Stop);
    let now = stand.now();
    stand.world.simulation().run_to(now + 2 * MS);
    assert!(matches!(within(stand.stops(now), 4 * MS), Cause::Overrun(1 | 2)));
    let mut held = Stand::armed(|rig, _| rig.overrun = Overrun::Hold(2));
    let now = held.now();
    held.world.simulation().run_to(now + 2 * MS);
    held.goes_on(100 * MS);
    assert!(held.hil.counts().missed >= 1);
    let now = held.now();
    held.world.simulation().run_to(now + 4 * MS);
    assert!(matches!(within(held.stops(now), 6 * MS), Cause::Overrun(3 | 4)));
}

#[test]
fn row_3_a_torque_beyond_its_limit() {
    let mut stand = Stand::new(quick(), 1, |_, model| param(model, 0, 9.0));
    stand.reach(Step::Armed);
    let since = stand.now();
    // The sine exceeds 2 N·m from 36 ms to 464 ms.
    assert_eq!(within(stand.stops(since), 200 * MS), Cause::Clamped(0));
    let counts = stand.hil.counts();
    assert!(counts.clamped[0] >= 150, "{:?}", counts.clamped);
}

#[test]
fn row_3_a_change_beyond_its_slew_and_a_power_beyond_its_limit() {
    let mut slow = Stand::armed(|rig, _| rig.outputs.iter_mut().for_each(|output| output.slew = 1.5));
    slow.goes_on(1_000 * MS);
    assert!(slow.hil.counts().clamped[1] > 100, "{:?}", slow.hil.counts().clamped);
    let mut options = quick();
    options.control.clamped_ns = 10_000 * MS;
    let mut weak = Stand::new(options, 1, |rig, _| (0..2).for_each(|node| cia402(rig, node).max_power = Some(0.4)));
    while weak.hil.ended().is_none() && weak.hil.counts().clamped[2] < 50 {
        weak.cycle();
    }
    assert!(weak.hil.counts().clamped[2] >= 50);
}

#[test]
fn row_3_outputs_come_up_from_their_safe_values() {
    let mut options = quick();
    options.control.ramp_ns = 400 * MS;
    let mut stand = Stand::new(options, 1, |_, model| param(model, 0, 1.9));
    stand.reach(Step::Armed);
    for k in 1..400 {
        stand.cycle();
        let value = stand.last[0].abs();
        assert!(value <= 1.9 * f64::from(k + 1) / 400.0, "{value} N·m in cycle {k}");
    }
}

#[test]
fn row_3_limits_are_never_widened() {
    let mut stand = Stand::armed(|_, _| ());
    let supervisor = stand.hil.supervisor_mut().unwrap();
    assert!(supervisor.narrow(0, -3.0, 3.0, 1e9).is_err());
    assert!(supervisor.narrow(0, -0.1, 0.1, 1e9).is_ok());
    stand.goes_on(100 * MS);
    assert!(stand.last[0].abs() <= 0.1);
}

#[test]
fn row_4_too_fast_too_far() {
    let fast = |rig: &mut Rig, model: &mut Instance| {
        (0..2).for_each(|node| cia402(rig, node).max_speed = Some(8.0));
        param(model, 1, 0.0);
        param(model, 0, 1.0);
    };
    let mut stand = Stand::new(quick(), 1, fast);
    stand.reach(Step::Armed);
    let since = stand.now();
    let (cause, _) = stand.stops(since);
    assert!(matches!(cause, Cause::Speed(_, speed) if speed < 8.5), "{cause:?}");
    let far = |rig: &mut Rig, model: &mut Instance| {
        cia402(rig, 1).travel = Some((-0.5, 0.5));
        param(model, 1, 0.0);
    };
    let mut stand = Stand::new(quick(), 1, far);
    stand.reach(Step::Armed);
    let since = stand.now();
    let (cause, _) = stand.stops(since);
    assert!(matches!(cause, Cause::Travel(1, position) if (0.5..0.52).contains(&position.abs())), "{cause:?}");
}

#[test]
fn row_4_a_drive_whose_torque_goes_the_wrong_way() {
    let mut stand = Stand::armed(|_, _| ());
    let since = stand.effect(0, Effect::TorqueScale(-1.0), None);
    // The former brake accelerates from now on: 0.05 N·m·s/rad makes the speed grow e-fold in 0.24 s, by 20 rad/s in
    // all.
    let cause = within(stand.stops(since), 3_000 * MS);
    assert!(matches!(cause, Cause::RunAway(_) | Cause::Speed(..)), "{cause:?}");
}

#[test]
fn row_5_answers_that_are_lost_late_or_doubled() {
    for kind in [FaultKind::Drop, FaultKind::Duplicate, FaultKind::Delay(700_000), FaultKind::Reorder] {
        let mut stand = Stand::armed(|_, _| ());
        let before = stand.hil.counts().stale;
        let now = stand.now();
        stand.world.bus(0).plant(BENCH, Fault::new(kind).id(0x183).from(now).times(1));
        stand.goes_on(50 * MS);
        let held = stand.hil.counts().stale - before;
        assert!(held <= 6, "{kind:?}: {held} readings held");
        assert!(held > 0 || !matches!(kind, FaultKind::Drop | FaultKind::Delay(_)), "{kind:?}: {held}");
    }
}

#[test]
fn row_6_answers_that_stay_away() {
    for id in [0x183, 0x283, 0x184] {
        let mut stand = Stand::armed(|_, _| ());
        let now = stand.now();
        stand.world.bus(0).plant(BENCH, Fault::new(FaultKind::Drop).id(id).from(now));
        assert!(matches!(within(stand.stops(now), 4 * MS), Cause::Lost(_)));
    }
}

#[test]
fn row_7_nobody_acknowledges_and_a_queue_that_is_full() {
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Full).from(now));
    assert_eq!(within(stand.trips(now), 2 * MS), Cause::Bus(0));
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).unplug(BENCH, now, u64::MAX);
    assert!(matches!(within(stand.trips(now), 4 * MS), Cause::Bus(0) | Cause::Lost(_)));
}

/// Every frame that a running rig sends: SYNC, set-points, its heartbeat.
const SENT: [u32; 4] = [0x080, 0x203, 0x204, 0x77F];

#[test]
fn row_7_a_queue_that_is_full_for_one_frame() {
    for id in SENT {
        let mut stand = Stand::armed(|_, _| ());
        let now = stand.now();
        stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Full).id(id).from(now));
        // The heartbeat is sent every one and a half periods.
        let cause = within(stand.trips(now), if id == 0x77F { 6 * MS } else { 2 * MS });
        assert_eq!(cause, Cause::Bus(0), "{id:03X}");
    }
    // A single refused frame while the rig already stops must not cancel the stop.
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Full).id(0x204).from(now).times(1));
    assert_eq!(within(stand.stops(now), 2 * MS), Cause::Bus(0));
}

#[test]
fn row_14_commands_that_are_lost_on_the_way() {
    for (id, node) in [(0x203, 0), (0x204, 1)] {
        let mut stand = Stand::armed(|_, model| param(model, 0, 1.5));
        let now = stand.now();
        stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Drop).id(id).from(now));
        let (mut apart, limit) = (None, now + 1_000 * MS);
        while stand.cause.is_none() {
            stand.cycle();
            let output = stand.rig.outputs.iter().position(|output| output.signal.node == node).unwrap();
            let torque = stand.world.bench().shaft(node).torque;
            let differs = (torque - stand.last[output]).abs() > 0.2;
            apart = if differs { apart.or(Some(stand.now())) } else { None };
            assert!(apart.is_none_or(|since| stand.now() <= since + 12 * MS), "{id:03X}: apart since {apart:?} ns");
            assert!(stand.now() < limit, "{id:03X}: nobody noticed");
        }
        assert!(
            matches!(stand.cause, Some((Cause::NotFollowing(at) | Cause::Drive(at), _)) if at == node),
            "{:?}",
            stand.cause
        );
        // The drive does not receive the stop either; without our heartbeat it stops by itself.
        stand.stops(stand.now());
    }
}

#[test]
fn row_14_set_points_that_stay_away_from_a_drive_that_stands() {
    // No torque is requested, so only the deadline can reveal the loss.
    for id in [0x203, 0x204] {
        let mut stand = Stand::armed(|_, model| param(model, 0, 0.0));
        let now = stand.now();
        stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Drop).id(id).from(now));
        assert_eq!(within(stand.stops(now), 8 * MS), Cause::Drive(usize::from(id == 0x204)));
        let status = stand.hil.fieldbus().status(0).unwrap();
        assert_eq!(status.deadline_ms, Some(5));
    }
}

#[test]
fn row_14_a_drive_that_hears_neither_set_points_nor_the_stop() {
    for (kind, id) in [FaultKind::Drop, FaultKind::Full].into_iter().flat_map(|kind| [(kind, 0x203), (kind, 0x204)]) {
        // Without a deadline of its own the drive keeps its last torque: the stop uses the path of the set-points.
        let mut stand = Stand::new(quick(), 1, |_, model| param(model, 0, 1.5));
        (0..2).for_each(|node| stand.world.bench().drive(node).unwrap().without_deadlines());
        stand.reach(Step::Armed);
        stand.goes_on(300 * MS);
        assert_eq!(stand.hil.fieldbus().status(1).unwrap().deadline_ms, None);
        let (now, node) = (stand.now(), usize::from(id == 0x204));
        stand.world.bus(0).plant(MASTER, Fault::new(kind).id(id).from(now));
        while stand.hil.ended().is_none() {
            stand.cycle();
            // A millisecond for the slew, the time to obey, the drive's time-out; then it brakes on its own ramp.
            let late = stand.cause.is_some_and(|(_, at)| stand.now() > at + (1 + 20 + 10) * MS);
            let state = stand.world.bench().drive(node).unwrap().state();
            let obeys = state != crate::drive::state::State::Enabled;
            assert!(!late || obeys, "{kind:?} {id:03X}: {state} after {:?}", stand.cause);
            assert!(stand.now() < now + 3_000 * MS, "{kind:?} {id:03X}: {:?}", stand.cause);
        }
        stand.at_rest();
    }
}

#[test]
fn row_14_a_drive_that_tells_another_torque_than_it_was_told() {
    for factor in [0.0, 0.5, -1.0] {
        let mut stand = Stand::armed(|_, model| param(model, 0, 1.5));
        let since = stand.effect(1, Effect::TorqueToldScale(factor), None);
        assert_eq!(within(stand.stops(since), 700 * MS), Cause::NotFollowing(1), "times {factor}");
    }
}

#[test]
fn row_13_a_drive_that_is_not_ours_gets_no_permission() {
    type Change = fn(&mut crate::canopen::ObjectDictionary);
    let ours: [Change; 4] = [
        |_| (),
        |objects| objects.set(crate::canopen::Object(0x1018, 1), 0x17F),
        |objects| objects.set(crate::canopen::Object(0x1018, 4), 1),
        |objects| objects.remove(crate::canopen::Object(0x1008, 0)),
    ];
    for (k, change) in ours.into_iter().enumerate() {
        let options = Options { only_simulated: Some("--arm is for simulated drives only".into()), ..quick() };
        let mut stand = Stand::new(options, 1, |_, _| ());
        stand.reach(Step::Identity);
        change(stand.world.bench().drive(1).unwrap().objects());
        while stand.hil.ended().is_none() && stand.hil.step() != Step::Armed {
            stand.cycle();
        }
        match stand.hil.ended() {
            None => assert_eq!(k, 0),
            Some(End::Refused(why)) => assert!(k > 0 && why.contains("`servo` has not proved"), "{k}: {why}"),
            Some(end) => panic!("{k}: {end:?}"),
        }
        assert_eq!(stand.hil.is_misuse(), k > 0);
    }
}

#[test]
fn row_13_a_safe_value_that_would_move_a_drive_before_arming() {
    for safe in [0.5, -1e-9] {
        let (mut rig, model, plant) = rigs::pair();
        rig.outputs[1].safe = safe;
        let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
        let masters = world.masters();
        let refused = Hil::new(&rig, model, world.clock(), masters, quick(), None).err().unwrap();
        assert!(refused.contains("`load`") && refused.contains("before it is armed"), "{refused}");
    }
}

#[test]
fn row_8_a_bus_that_goes_off_does_not_come_back_to_motion() {
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).short(now, now + 50 * MS);
    let cause = within(stand.trips(now), 4 * MS);
    assert!(matches!(cause, Cause::Bus(0) | Cause::Lost(_)), "{cause:?}");
    stand.world.bus(0).restart(MASTER);
    stand.world.bus(0).restart(BENCH);
    while stand.hil.ended().is_none() {
        stand.cycle();
        let order = stand.order();
        assert!(order != DriveCommand::Follow && order != DriveCommand::Wait, "motion came back");
    }
    stand.at_rest();
}

#[test]
fn row_9_an_interface_that_goes_down() {
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).take_down(MASTER);
    assert_eq!(within(stand.trips(now), 2 * MS), Cause::Bus(0));
}

#[test]
fn row_10_a_node_that_babbles_and_frames_that_overrun() {
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).babble(BENCH, Frame::new(0x001, &[]), 0, now, u64::MAX);
    let cause = within(stand.trips(now), 4 * MS);
    assert!(matches!(cause, Cause::Lost(_) | Cause::Overload(_) | Cause::Bus(_)), "{cause:?}");
    let mut stand = Stand::armed(|_, _| ());
    let now = stand.now();
    stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Overrun).from(now).times(1));
    stand.goes_on(50 * MS);
    assert!(stand.hil.counts().lost_frames >= 1);
    let now = stand.now();
    stand.world.bus(0).plant(MASTER, Fault::new(FaultKind::Overrun).from(now));
    let cause = within(stand.trips(now), 4 * MS);
    assert!(matches!(cause, Cause::Overload(_) | Cause::Lost(_)), "{cause:?}");
}

#[test]
fn row_11_a_drive_that_falls_silent_or_starts_anew() {
    for (fault, limit) in [("load no heartbeat", 80 * MS), ("load reset", 100 * MS), ("servo pre-operational", 30 * MS)]
    {
        let mut stand = Stand::armed(|_, _| ());
        let since = stand.hook(fault);
        let cause = within(stand.stops(since), limit);
        assert!(matches!(cause, Cause::Drive(_) | Cause::Lost(_)), "{fault}: {cause:?}");
    }
}

#[test]
fn row_12_a_drive_that_stops_by_itself() {
    for fault in ["load emergency 0x2310", "servo fault 0x3210", "load safe torque off"] {
        let mut stand = Stand::armed(|_, _| ());
        let since = stand.hook(fault);
        let cause = within(stand.stops(since), 3 * MS);
        let node = usize::from(fault.starts_with("servo"));
        assert_eq!(cause, Cause::Drive(node), "{fault}");
    }
}

#[test]
fn row_13_what_is_wrong_with_a_drive_is_found_before_arming() {
    let slow = Options { start: drive::Options { sign_test: SignTest::Push, ..quick().start }, ..quick() };
    let effects =
        [Effect::TorqueScale(-1.0), Effect::EncoderScale(-1.0), Effect::EncoderScale(2.0), Effect::SpeedScale(0.1)];
    for effect in effects {
        let mut stand = Stand::new(slow.clone(), 1, |_, _| ());
        stand.effect(0, effect, None);
        let end = stand.ends();
        assert!(matches!(end, End::Refused(_)), "{effect:?}: {end:?}");
        stand.at_rest();
    }
    let mut wrong = Stand::new(slow, 1, |rig, _| cia402(rig, 0).rated_torque = 5.0);
    // The simulated plant was built from the same rig, so the drive's rated torque is changed instead.
    wrong.world.bench().drive(0).unwrap().objects().set(crate::canopen::Object(0x6076, 0), 4000);
    assert!(matches!(wrong.ends(), End::Refused(why) if why.contains("load")));
}

#[test]
fn row_14_a_mode_that_is_not_the_one_asked_for() {
    let mut stand = Stand::armed(|_, _| ());
    let since = stand.hook("load mode 4");
    let cause = within(stand.stops(since), 30 * MS);
    assert!(matches!(cause, Cause::NotFollowing(0)), "{cause:?}");
}

#[test]
fn row_15_encoders() {
    // Enough counts for the position to overflow its 32 bits.
    let mut wraps = Stand::new(quick(), 3, |_, model| param(model, 1, 0.0));
    wraps.reach(Step::Armed);
    wraps.goes_on(300 * MS);
    // A glitch of a quarter turn in one answer is rejected.
    let mut glitch = Stand::armed(|_, _| ());
    glitch.effect(1, Effect::EncoderGlitch(65_536), Some(MS));
    glitch.goes_on(50 * MS);
    // A lasting jump is no glitch.
    let mut jump = Stand::armed(|_, _| ());
    let since = jump.effect(1, Effect::EncoderLost(65_536), None);
    let cause = within(jump.stops(since), 5 * MS);
    assert!(matches!(cause, Cause::Implausible(_)), "{cause:?}");
}

#[test]
fn row_15_an_encoder_that_stands_still() {
    let mut stand = Stand::armed(|_, _| ());
    while stand.world.bench().shaft(0).speed.abs() < 2.0 {
        stand.cycle();
    }
    let since = stand.hook("load encoder frozen");
    let cause = within(stand.stops(since), 5 * MS);
    assert!(matches!(cause, Cause::Implausible(_)), "{cause:?}");
}

#[test]
fn row_16_a_data_word_that_is_wrong() {
    for (seed, id) in (0..6).flat_map(|seed| [0x183, 0x184, 0x283, 0x284].map(|id| (seed, id))) {
        let mut stand = Stand::new(quick(), seed, |_, _| ());
        stand.reach(Step::Armed);
        stand.goes_on(300 * MS);
        let now = stand.now();
        stand.world.bus(0).plant(BENCH, Fault::new(FaultKind::Corrupt).id(id).from(now).times(1));
        // One wrong bit in one answer: the accepted speed is never further off than the change that 3 N·m times four
        // can cause on the shaft in one tick; a wrong status word may say that the drive has stopped.
        for _ in 0..100 {
            if stand.hil.ended().is_some() {
                break;
            }
            stand.cycle();
            let truth = stand.world.bench().shaft(0).speed;
            for seen in stand.hil.seen() {
                let off = (seen.speed.unwrap() - truth).abs();
                assert!(off < 2.2, "frame {id:03X}, seed {seed}: {off} rad/s believed");
            }
        }
        let known = |cause: &Cause| matches!(cause, Cause::Drive(_) | Cause::Implausible(_) | Cause::NotFollowing(_));
        assert!(stand.cause.is_none_or(|(cause, _)| known(&cause)), "{:03X}, seed {seed}: {:?}", id, stand.cause);
        assert!(stand.cause.is_none_or(|(_, at)| at - now <= 10 * MS), "{:?}", stand.cause);
    }
    // A permanently wrong reading: 64 rad/s too many cannot come from an acceleration.
    let mut stand = Stand::armed(|_, _| ());
    let since = stand.effect(0, Effect::SpeedScale(30.0), None);
    let cause = within(stand.stops(since), 5 * MS);
    assert!(matches!(cause, Cause::Implausible(_) | Cause::Speed(..)), "{cause:?}");
}

#[test]
fn row_17_and_18_a_process_that_is_frozen_or_gone() {
    for node in 0..2 {
        let stand = Stand::armed(|_, _| ());
        let now = stand.now();
        // No further cycles: the drives must notice by themselves.
        stand.world.simulation().run_to(now + 60 * MS);
        let mut bench = stand.world.bench();
        let state = bench.drive(node).unwrap().state();
        assert!(state != crate::drive::state::State::Enabled, "drive {node} is {state}");
    }
}

#[test]
fn row_19_parameters_while_it_runs() {
    let mut stand = Stand::armed(|_, _| ());
    let slot = |i| stand.hil.control().unwrap().model().description().layout.params.slot(i);
    let [amplitude, damping, end]: [Slot; 3] = [0, 1, 2].map(slot);
    for k in 0..200 {
        let values = [(amplitude, 0.3 + 0.1 * f64::from(k % 2)), (damping, 0.05 + 0.01 * f64::from(k % 3))];
        stand.operator.push(Command::Set(Set::new(&values).unwrap()));
        stand.goes_on(MS);
    }
    stand.operator.push(Command::Set(Set::new(&[(amplitude, f64::NAN)]).unwrap()));
    // The model would become NaN from now on.
    stand.operator.push(Command::Set(Set::new(&[(end, 0.0)]).unwrap()));
    stand.goes_on(20 * MS);
    assert_eq!(stand.hil.counts().refused_sets, 2);
}

#[test]
fn row_20_a_second_master() {
    let foreign = |stand: &Stand| -> Port { stand.world.bus(0).port("foreign") };
    let mut early = Stand::new(quick(), 1, |_, _| ());
    let mut port = foreign(&early);
    early.cycle();
    port.send(Frame::new(0x080, &[])).unwrap();
    let end = early.ends();
    assert!(matches!(&end, End::Refused(why) if why.contains("0x080")), "{end:?}");
    for frame in
        [Frame::new(0x080, &[]), Frame::new(0x000, &[1, 3]), Frame::new(0x603, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0])]
    {
        let mut late = Stand::armed(|_, _| ());
        let mut port = foreign(&late);
        let now = late.now();
        port.send(frame).unwrap();
        let cause = within(late.stops(now), 2 * MS);
        assert_eq!(cause, Cause::Foreign(0, frame.id()));
    }
}

#[test]
fn row_22_an_emergency_stop_in_each_state() {
    let steps = [Step::Configure, Step::Sync, Step::Enable, Step::Armed];
    for step in steps {
        let mut stand = Stand::new(quick(), 1, |_, _| ());
        stand.reach(step);
        let since = stand.effect(0, Effect::SafeTorqueOff, None);
        stand.effect(1, Effect::SafeTorqueOff, None);
        let limit = since + 12_000 * MS;
        while stand.hil.ended().is_none() {
            stand.cycle();
            assert!(stand.now() < limit, "{step}: it goes on: {:?}", stand.hil.step());
        }
        assert!(!matches!(stand.hil.ended(), Some(End::Asked)), "{step}");
        stand.at_rest();
    }
}

#[test]
fn row_21_a_log_whose_disk_hangs_and_then_fails() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log");
    assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
    // A reader that never reads: the first write beyond the pipe's capacity blocks for ever.
    let mut options = std::fs::OpenOptions::new();
    let reader = options.read(true).custom_flags(libc::O_NONBLOCK).open(&path).unwrap();
    let log = Settings { sink: Sink::File(path, Limits::default()), cycles_per_block: 100, patient: false };
    let mut stand = Stand::of(rigs::pair(), quick(), 1, Some(log));
    stand.reach(Step::Armed);
    while stand.hil.counts().log_dropped == 0 {
        stand.goes_on(100 * MS);
        assert!(stand.now() < 60_000 * MS, "nothing was dropped");
    }
    stand.goes_on(100 * MS);
    let dropped = stand.hil.counts().log_dropped;
    assert!(dropped >= 100, "{dropped} messages dropped in 100 cycles");
    assert_eq!(stand.hil.counts().missed, 0);
    // Without a reader the file is broken, and the end must report it.
    drop(reader);
    stand.goes_on(100 * MS);
    assert!(stand.operator.push(Command::Stop));
    while stand.hil.ended().is_none() {
        stand.cycle();
    }
    assert_eq!(stand.hil.ended(), Some(&End::Asked));
    assert!(stand.hil.finish().is_err(), "the log is not whole");
}

/// The bristle model with a delayed load, with or without the predictor.
fn late_bristle(delay: f64, predict: bool, swing: f64) -> (Rig, Instance, Instance) {
    let (mut rig, mut model, plant) = rigs::bristle();
    rig.nodes[0].delay = delay;
    rig.predict = predict.then_some(0);
    param(&mut model, 0, swing);
    (rig, model, plant)
}

#[test]
fn row_23_more_energy_comes_back_than_a_contact_can_hold() {
    for stops in [false, true] {
        let mut options = quick();
        options.control.energy_stops = stops;
        let mut stand = Stand::of(late_bristle(50e-3, false, 0.4), options, 1, None);
        stand.reach(Step::Armed);
        let since = stand.now();
        if stops {
            assert_eq!(within(stand.stops(since), 1_000 * MS), Cause::Energy);
            continue;
        }
        stand.goes_on(1_000 * MS);
        let coupling = stand.hil.counts().coupling.unwrap();
        assert!(coupling.warnings > 0 && coupling.returned_max > 1.0, "{coupling:?}");
    }
    // Without delay, and without damping, the same contact returns the energy that it stores and no more.
    let mut healthy = Stand::of(late_bristle(0.8e-3, true, 0.4), quick(), 1, None);
    healthy.reach(Step::Armed);
    healthy.goes_on(2_000 * MS);
    let coupling = healthy.hil.counts().coupling.unwrap();
    assert!(coupling.returned_max < 1.0, "{coupling:?}");
    assert_eq!(coupling.unpredicted, 0, "{coupling:?}");
}

#[test]
fn row_23_a_shaft_that_is_not_as_told() {
    for needs_look in [false, true] {
        let mut options = quick();
        options.control.needs_look = needs_look;
        let mut stand = Stand::of(late_bristle(2e-3, true, 0.4), options, 1, None);
        stand.reach(Step::Armed);
        stand.goes_on(300 * MS);
        // 5 mrad in one tick: an encoder can jump so far, the shaft cannot.
        let since = stand.effect(0, Effect::EncoderLost(200), None);
        if needs_look {
            assert_eq!(within(stand.stops(since), 100 * MS), Cause::Unpredictable);
            continue;
        }
        stand.goes_on(100 * MS);
        let coupling = stand.hil.counts().coupling.unwrap();
        assert!((1..50).contains(&coupling.unpredicted), "plain for some cycles, then ahead again: {coupling:?}");
    }
}

#[test]
fn nothing_moves_again_without_the_operator() {
    let mut stand = Stand::armed(|_, _| ());
    let since = stand.hook("load fault 0x2310");
    stand.stops(since);
    for _ in 0..500 {
        stand.hil.cycle();
        stand.at_rest();
    }
}

impl Stand {
    /// Like [`Stand::stops`], for drives that cannot receive commands: waits for the trip only.
    fn trips(&mut self, since: u64) -> (Cause, u64) {
        while self.cause.is_none() {
            self.cycle();
            assert!(self.now() < since + STOP_NS, "it goes on");
        }
        let (cause, at) = self.cause.expect("it was just seen");
        let until = self.now() + 100 * MS;
        while self.now() < until {
            self.cycle();
        }
        // By our frames or by their own time-out.
        self.at_rest();
        (cause, at - since)
    }

    fn order(&self) -> DriveCommand {
        self.hil.order()
    }
}

/// Protections that only the generated tests cover.
#[cfg(feature = "mutants")]
const ELSEWHERE: [&str; 11] =
    ["patient", "recorded", "reused", "unhurried", "loop", "bites", "hushed", "life", "counted", "late", "overload"];

/// Mutation test: without any one protection a test above must fail.
#[cfg(feature = "mutants")]
#[test]
fn mutants_are_caught() {
    use std::io::{BufRead, BufReader};
    use std::process::Stdio;
    // Kills the tests at the first failure: without a latch or a report others would never end.
    let passes = |mutant: Option<&str>| {
        let mut tests = std::process::Command::new(std::env::current_exe().unwrap());
        tests.args(["hil::campaign::row", "hil::campaign::nothing", "hil::control", "hil::followed", "hil::emergency"]);
        tests.args(["drive::units", "drive::frames", "hil::live_tests"]).env_remove("FRIC_MUTANT");
        mutant.map(|name| tests.env("FRIC_MUTANT", name));
        let mut tests = tests.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let lines = BufReader::new(tests.stdout.take().unwrap()).lines().map_while(Result::ok);
        if lines.into_iter().any(|line| line.starts_with("test ") && line.ends_with("FAILED")) {
            tests.kill().unwrap();
        }
        tests.wait().unwrap().success()
    };
    assert!(passes(None), "with every protection in place");
    let all = crate::safety::Protection::ALL.iter().map(|(name, _)| *name);
    let missed: Vec<&str> = all.filter(|name| !ELSEWHERE.contains(name) && passes(Some(name))).collect();
    assert!(missed.is_empty(), "nothing notices that these are missing: {missed:?}");
}
