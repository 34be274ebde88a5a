//! Invariants: properties that hold at every tick of every run, whatever fails.
//!
//! In: a running rig, the frames it has sent, the true state of drives and shaft. Out: the first violated property. The
//! truth comes from the simulated plant and from the bus; the rig itself is trusted only for its claims: the step of
//! its start-up, its drive command, its cause, the permitted outputs.

use super::broken::Broken;
use super::rigs::{FRAME_COMMAND, Made};
use super::space::{Ill, MS, Script, What};
use super::wire::{self, CycleInputs, Traffic};
use crate::can::Frame;
use crate::canopen::Object;
use crate::drive::state::State;
use crate::drive::{Effect, Step};
use crate::hil::cycle::Hil;
use crate::hil::simulated::World;
use crate::realtime::clock::Clock;
use crate::safety::{DriveCommand, Reaction};
use abi::rig::{Kind, Mode, Rig};
use std::collections::VecDeque;

/// Ticks of the ramp in which outputs rise from their safe values.
pub const RAMP: u64 = 10;
/// Longest unbroken time for which an output may be outside its limits.
pub const CLAMPED_NS: u64 = 60 * MS;
/// Longest time from a controlled stop to the quick stop, and from there to disabled.
pub const STANDSTILL_NS: u64 = 200 * MS;
/// Time within which a drive that does not follow its permitted torque must have caused a stop, beyond delay and lag.
const FOLLOW_NS: u64 = 30 * MS;
/// The same for a drive that controls a speed or a position itself.
const SLOW_FOLLOW_NS: u64 = 1_300 * MS;
/// Time within which a speed or angle beyond its limit must have caused a stop: missing or implausible readings are
/// held meanwhile.
const BEYOND_NS: u64 = 10 * MS;
/// Ticks for which a reading may be held, plus some for its transport.
const SEEN: usize = 8;
/// Number of successive cycles with lost frames that must have caused a stop.
const LOSSY: u32 = 3;
/// Time in which a drive's own brake may leave some torque.
const BRAKE_NS: u64 = 5 * MS;
/// A drive that keeps an old set-point applies it once it is enabled, until it has not followed for five ticks: those
/// ticks, the transport in both directions, and its lag.
const KEPT_NS: u64 = 15 * MS;
/// Time after which a drive must notice missing set-points, with a margin for a late cycle.
const DEADLINE_NS: u64 = 25 * MS;
/// Time beyond the time-outs of a controlled stop: the drives' own time-out, their reaction, their lag.
const OFF_NS: u64 = 80 * MS;

/// The violation that a run found.
#[derive(Clone, PartialEq, Debug)]
pub struct Violation {
    pub broken: Broken,
    pub at_ns: u64,
    pub text: String,
}

/// State of the checks of one output.
struct Watched {
    node: usize,
    /// None: described by frames.
    mode: Option<Mode>,
    /// Highest command, and highest torque in any mode.
    most: f64,
    torque: f64,
    slew: f64,
    power: f64,
    /// One quantisation step on the bus, SI.
    step: f64,
    /// Time from a command to its full effect, ns.
    window_ns: u64,
    /// Permitted values with their times, the newest last.
    history: VecDeque<(u64, f64)>,
    last: f64,
    /// Time since which the drive deviates from the permitted values.
    astray_ns: Option<u64>,
    clamped_ns: Option<u64>,
    /// Time at which its drive last braked by itself.
    braked_ns: u64,
    /// Time since which it has torque before arming.
    loose_ns: Option<u64>,
    /// Time at which its last set-point was on the bus.
    heard_ns: u64,
    /// The position that its drive reports, counts.
    counts: i32,
    /// A fault may corrupt its set-points under a valid checksum.
    garbled: bool,
    /// It may keep an old set-point.
    keeps: bool,
    /// A drive that receives nothing, or whose commands have no read-back: nothing on the bus stops it.
    deaf: bool,
}

/// Checks the run of one program.
pub struct Judge {
    watched: Vec<Watched>,
    travel: f64,
    speed: f64,
    /// Position of the shaft at arming, rad.
    origin: Option<f64>,
    fast_ns: Option<u64>,
    far_ns: Option<u64>,
    /// Lowest speed since torque began to brake the shaft.
    least: f64,
    astray_power_ns: Option<u64>,
    before: Step,
    /// Cycles since arming.
    armed: Option<u64>,
    pushed_ns: u64,
    /// Time at which the first cause was seen.
    tripped_ns: Option<u64>,
    ordered: bool,
    /// Cycles since the bus refused a frame.
    refused: Option<u32>,
    /// Number of successive cycles that missed a tick.
    behind: u32,
    hold: u32,
    far: bool,
    /// True speeds of the shaft, the newest last.
    speeds: VecDeque<f64>,
    blind_ns: Option<u64>,
    /// A fault may falsify a drive's readings.
    lies: bool,
    /// A fault may cut off our end of a bus for good.
    cut: bool,
    told: Vec<CycleInputs>,
    /// Number of successive cycles in which a bus reported lost frames.
    lossy: u32,
}

impl Judge {
    pub fn new(script: &Script, rig: &Rig) -> Judge {
        let Made { rated, power, most, speed, travel, .. } = script.rig;
        let watched = rig.outputs.iter().map(|output| {
            let node = output.signal.node;
            let (mode, step) = match &rig.nodes[node].kind {
                Kind::Cia402(drive) => (Some(drive.mode), rated / 1000.0),
                Kind::Frames(_) => (None, 1e-3),
            };
            let own = rig.nodes[node].delay + 8.0 * rig.nodes[node].lag;
            let silent = |what: What| matches!(what, What::Node(at, Effect::Silent) if at == node);
            let unheard = |what: What| match what {
                What::Frame(_, FRAME_COMMAND, _) | What::Short(_) | What::Unplugged(_) | What::Alone(_) => true,
                What::Down(_) | What::Babble(_) | What::Frozen(_) => true,
                // A node whose frames fail again and again goes bus-off.
                What::Frame(_, _, Ill::Disturbed) => true,
                What::Frame(..) | What::Node(..) | What::Foreign(..) | What::Overrun(..) | What::NoNumber(..) => false,
            };
            let keeps = |what: What| matches!(what, What::Node(at, Effect::IgnoresCommands) if at == node);
            let deaf = script.faults.iter().any(|f| silent(f.what) || mode.is_none() && unheard(f.what));
            Watched {
                node,
                mode,
                most: output.high,
                torque: most,
                slew: output.slew,
                power: if power > 0.0 { power } else { most * speed },
                step,
                window_ns: (own * 1e9) as u64 + 3 * MS,
                history: VecDeque::with_capacity(512),
                last: 0.0,
                astray_ns: None,
                clamped_ns: None,
                braked_ns: 0,
                loose_ns: None,
                heard_ns: 0,
                counts: 0,
                garbled: script.faults.iter().any(|f| matches!(f.what, What::Frame(_, _, Ill::Corrupted))),
                keeps: script.faults.iter().any(|f| keeps(f.what)),
                deaf,
            }
        });
        Judge {
            watched: watched.collect(),
            travel: if travel > 0.0 { travel } else { f64::INFINITY },
            speed,
            origin: None,
            fast_ns: None,
            far_ns: None,
            least: f64::INFINITY,
            astray_power_ns: None,
            before: Step::Listen,
            armed: None,
            pushed_ns: 0,
            tripped_ns: None,
            ordered: false,
            refused: None,
            behind: 0,
            hold: script.rig.hold,
            far: script.rig.far,
            speeds: VecDeque::with_capacity(SEEN + 1),
            blind_ns: None,
            cut: script.faults.iter().any(|fault| cuts(fault.what)),
            lies: script.faults.iter().any(|fault| lies(fault.what)),
            told: CycleInputs::all(rig, &script.rig),
            lossy: 0,
        }
    }

    /// Notes a frame that was on the bus.
    pub fn heard(&mut self, rig: &Rig, bus: usize, frame: &Frame, stamp_ns: u64) {
        for watched in &mut self.watched {
            let node = &rig.nodes[watched.node];
            if let Kind::Cia402(drive) = &node.kind
                && node.bus == bus
                && frame.id() == 0x200 + u32::from(drive.node)
            {
                watched.heard_ns = stamp_ns;
            }
        }
    }

    /// Time at which the rig first reported that it stops.
    pub fn tripped_ns(&self) -> Option<u64> {
        self.tripped_ns
    }

    /// Checks one tick, with the frames of its cycle.
    pub fn tick(&mut self, hil: &Hil, world: &World, rig: &Rig, traffic: &Traffic) -> Result<(), Violation> {
        let sent = &traffic.sent;
        let now_ns = world.simulation().now_ns();
        let at = |broken, text: String| Violation { broken, at_ns: now_ns, text };
        let (step, order) = (hil.step(), hil.order());
        let cause = hil.control().and_then(|control| control.supervisor().cause());
        if self.tripped_ns.is_none() && (cause.is_some() || matches!(step, Step::Refused | Step::Stopped)) {
            self.tripped_ns = Some(now_ns);
        }
        let stops = self.tripped_ns.is_some();
        if step == Step::Armed {
            self.armed = Some(self.armed.map_or(0, |cycles| cycles + 1));
        }
        if step == Step::SignTest || self.before == Step::SignTest {
            self.pushed_ns = now_ns;
        }
        self.judge_wire(rig, sent, step).map_err(|(broken, text)| at(broken, text))?;
        self.before = step;
        self.refused = self.refused.map(|cycles| cycles + 1);
        if self.refused.is_some_and(|cycles| cycles >= 1) && !stops && step > Step::AwaitEnable {
            return Err(at(Broken::Refused, "a frame was refused in the cycle before".into()));
        }
        if step > Step::AwaitEnable && sent.iter().any(|(.., taken)| !taken) {
            self.refused = Some(0);
        }
        let missed = hil.last().ticks > 1 && self.armed.is_some() && !stops;
        self.behind = if missed { self.behind + 1 } else { 0 };
        if self.behind > self.hold + 1 {
            return Err(at(Broken::Overrun, format!("{} cycles in a row missed a tick", self.behind)));
        }

        let moves = self.armed.is_some() && order == DriveCommand::Follow;
        if self.ordered && matches!(order, DriveCommand::Follow | DriveCommand::Wait) {
            return Err(at(Broken::Latch, format!("the drives are told {order:?} after a stop")));
        }
        self.ordered |= matches!(order, DriveCommand::QuickStop | DriveCommand::Disable);

        if let Some(control) = hil.control() {
            let (permitted, requests) = (control.supervisor().permitted(), control.requests());
            let reaction = cause.map(|cause| cause.reaction());
            for (i, watched) in self.watched.iter_mut().enumerate() {
                let speed = hil.seen().get(watched.node).and_then(|seen| seen.speed).unwrap_or(0.0);
                let cycles = self.armed.filter(|_| moves);
                watched
                    .judge_permitted(permitted[i], speed, cycles, reaction, rig.period_ns)
                    .and_then(|()| watched.judge_request(requests[i], now_ns, moves && !stops))
                    .map_err(|(broken, text)| at(broken, format!("output {i}: {text}")))?;
                watched.note(now_ns, permitted[i]);
            }
        }
        self.judge_traffic(hil, rig, traffic, now_ns).map_err(|(broken, text)| at(broken, text))?;
        self.judge_drives(world, now_ns, step, moves && !stops).map_err(|(broken, text)| at(broken, text))?;
        self.judge_shaft(world, now_ns, moves && !stops).map_err(|(broken, text)| at(broken, text))?;
        self.judge_sight(hil, world, now_ns, moves && !stops).map_err(|(broken, text)| at(broken, text))?;
        self.judge_rest(world, now_ns)
    }

    /// Checks the rig's reactions to the received traffic.
    fn judge_traffic(&mut self, hil: &Hil, rig: &Rig, traffic: &Traffic, now_ns: u64) -> Result<(), (Broken, String)> {
        let quick = matches!(hil.order(), DriveCommand::QuickStop | DriveCommand::Disable);
        let stops = self.tripped_ns.is_some();
        let ended = matches!(hil.step(), Step::Refused | Step::Stopped) || hil.ended().is_some();
        let foreign = traffic.came.iter().find(|(bus, frame, _)| wire::is_foreign(rig, *bus, frame));
        if let Some((bus, frame, _)) = foreign
            && !quick
            && !ended
        {
            return Err((Broken::Foreign, format!("frame {:03X} came on bus {bus}", frame.id())));
        }
        self.lossy = if traffic.lost { self.lossy + 1 } else { 0 };
        if self.lossy >= LOSSY && !stops && hil.step() > Step::AwaitEnable {
            return Err((Broken::Overload, format!("frames were lost in {} cycles in a row", self.lossy)));
        }
        let time = (hil.last().ticks, rig.period_ns as f64 * 1e-9);
        let seen = hil.seen();
        for (told, seen) in self.told.iter_mut().zip(seen) {
            told.take(rig, &traffic.came);
            if let Some(cycles) = self.armed.filter(|_| self.tripped_ns.is_none_or(|since| since == now_ns)) {
                told.judge(cycles == 0, *seen, time, (stops, quick))?;
            }
        }
        Ok(())
    }

    /// Checks that the accepted speed is one that the shaft had a moment ago.
    fn judge_sight(&mut self, hil: &Hil, world: &World, now_ns: u64, moves: bool) -> Result<(), (Broken, String)> {
        self.speeds.push_back(world.bench().shaft(0).speed);
        if self.speeds.len() > SEEN {
            self.speeds.pop_front();
        }
        let Some(speed) = hil.seen().first().and_then(|seen| seen.speed) else { return Ok(()) };
        let (low, high) = self
            .speeds
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), speed| (low.min(*speed), high.max(*speed)));
        let room = 0.3 + 0.02 * speed.abs();
        let blind = moves && !self.lies && !(low - room <= speed && speed <= high + room);
        self.blind_ns = if blind { self.blind_ns.or(Some(now_ns)) } else { None };
        if self.blind_ns.is_some_and(|since| now_ns - since > BEYOND_NS) {
            return Err((Broken::Blind, format!("{speed:.3} rad/s is believed, {low:.3} .. {high:.3} was")));
        }
        Ok(())
    }

    /// Checks the frames that were handed to the buses.
    fn judge_wire(&self, rig: &Rig, sent: &[(usize, Frame, bool)], step: Step) -> Result<(), (Broken, String)> {
        for (bus, frame, _) in sent {
            for watched in &self.watched {
                self.judge_way(watched, rig, *bus, frame)?;
                let number = match (&rig.nodes[watched.node].kind, watched.mode) {
                    (Kind::Cia402(drive), Some(Mode::Torque))
                        if rig.nodes[watched.node].bus == *bus && frame.id() == 0x200 + u32::from(drive.node) =>
                    {
                        i16::from_le_bytes([frame.data()[2], frame.data()[3]])
                    }
                    (Kind::Frames(_), _) if frame.id() == FRAME_COMMAND => {
                        i16::from_le_bytes([frame.data()[0], frame.data()[1]])
                    }
                    _ => continue,
                };
                let torque = f64::from(number) * watched.step;
                if torque.abs() > watched.most * (1.0 + 1e-9) {
                    return Err((
                        Broken::WireLimit,
                        format!("{torque} N·m to node {} of {}", watched.node, watched.most),
                    ));
                }
                let tested = step == Step::SignTest || self.before == Step::SignTest;
                if number != 0 && self.armed.is_none() && !tested {
                    return Err((Broken::BeforeArm, format!("{torque} N·m to node {} while {step}", watched.node)));
                }
            }
        }
        Ok(())
    }

    /// Checks that a position on the bus, relative to the shaft, lies on the permitted side.
    fn judge_way(&self, watched: &Watched, rig: &Rig, bus: usize, frame: &Frame) -> Result<(), (Broken, String)> {
        let node = &rig.nodes[watched.node];
        let (Kind::Cia402(drive), Some(Mode::Position), true) = (&node.kind, watched.mode, self.far) else {
            return Ok(());
        };
        if node.bus != bus || frame.id() != 0x200 + u32::from(drive.node) {
            return Ok(());
        }
        if frame.data()[0] & 0x0F != 0x0F {
            // A stop: its target is not followed.
            return Ok(());
        }
        let bytes: [u8; 4] = frame.data()[2..6].try_into().expect("a position has four bytes");
        let target = i32::from_le_bytes(bytes);
        // Interpreted as by a drive whose counts do not wrap.
        let way = (f64::from(target) - f64::from(watched.counts)) * drive.count;
        // The shaft turns by less than this while the command is under way.
        if way.abs() > 100.0 && way.signum() != watched.last.signum() && watched.last != 0.0 {
            return Err((Broken::Wrapped, format!("{way:.0} rad where {:.0} rad are permitted", watched.last)));
        }
        Ok(())
    }

    /// Checks the drives' torques and states.
    fn judge_drives(&mut self, world: &World, now_ns: u64, step: Step, moves: bool) -> Result<(), (Broken, String)> {
        let mut bench = world.bench();
        for watched in &mut self.watched {
            let node = watched.node;
            let Some(drive) = bench.drive(node) else { continue };
            let (torque, state) = (drive.torque(), drive.state());
            let brakes = matches!(state, State::QuickStop | State::FaultReaction);
            let alone = now_ns.saturating_sub(watched.heard_ns) > DEADLINE_NS;
            if alone && !watched.deaf && state == State::Enabled {
                return Err((Broken::Deadline, format!("node {node} is {state} without set-points")));
            }
            if step >= Step::Start && torque.abs() > watched.torque + watched.step {
                return Err((Broken::ShaftLimit, format!("{torque} N·m of node {node}, which is {state}")));
            }
            if brakes {
                watched.braked_ns = now_ns;
            }
            // After a sign check or the drive's own ramp, its lag leaves some torque for a while.
            let quiet = self.armed.is_none() && now_ns > self.pushed_ns.max(watched.braked_ns) + 20 * MS;
            // A wrong value under a valid checksum acts until the drive's reading reveals it, within the resolution of
            // the check.
            let room = if watched.garbled { watched.room() } else { watched.step };
            let loose = quiet && watched.mode == Some(Mode::Torque) && torque.abs() > room;
            watched.loose_ns = if loose { watched.loose_ns.or(Some(now_ns)) } else { None };
            // A drive's own brake may end between two checks.
            let patience_ns = match (watched.garbled, watched.keeps) {
                (true, _) => FOLLOW_NS,
                (false, true) => KEPT_NS,
                (false, false) => BRAKE_NS,
            };
            let refused = self.tripped_ns.is_some();
            if watched.loose_ns.is_some_and(|since| now_ns - since >= patience_ns) && !(refused && watched.garbled) {
                return Err((Broken::BeforeArm, format!("{torque} N·m of node {node} while {step}")));
            }
            if watched.mode == Some(Mode::Position) {
                watched.counts = drive.objects().get(Object(0x6064, 0)).unwrap_or(0) as i32;
            }
            let shaft = bench.shaft(node);
            let origin = *self.origin.get_or_insert(shaft.position);
            let (is, room, patience_ns) = match watched.mode {
                None => continue,
                Some(Mode::Torque) => (torque, watched.room(), FOLLOW_NS),
                Some(Mode::Speed) => (shaft.speed, 0.2 * watched.most + 0.5, SLOW_FOLLOW_NS),
                Some(Mode::Position) => (shaft.position - origin, 0.2 * watched.most + 0.05, SLOW_FOLLOW_NS),
            };
            let (low, high) = watched.lately(now_ns);
            let astray = moves && !(low - room <= is && is <= high + room);
            watched.astray_ns = if astray { watched.astray_ns.or(Some(now_ns)) } else { None };
            if watched.astray_ns.is_some_and(|since| now_ns - since > patience_ns) && !watched.deaf {
                let text =
                    format!("node {node}, which is {state}, gives {is:.4} where {low:.4} .. {high:.4} was permitted");
                return Err((Broken::Follow, text));
            }
        }
        if self.armed.is_none() {
            self.origin = None;
        }
        Ok(())
    }

    /// Checks speed, angle and run-away of the true shaft.
    fn judge_shaft(&mut self, world: &World, now_ns: u64, moves: bool) -> Result<(), (Broken, String)> {
        let bench = world.bench();
        // The first node is a drive that reports its speed; both drives share one shaft.
        let shaft = bench.shaft(0);
        let since = |is: bool, since: Option<u64>| if is && moves { since.or(Some(now_ns)) } else { None };
        self.fast_ns = since(shaft.speed.abs() > 1.05 * self.speed + 0.2, self.fast_ns);
        let angle = shaft.position - self.origin.unwrap_or(shaft.position);
        self.far_ns = since(angle.abs() > 1.05 * self.travel + 0.02, self.far_ns);
        let power: f64 = (self.watched.iter())
            .filter(|watched| matches!(watched.mode, Some(Mode::Torque) | None))
            .map(|watched| watched.last * shaft.speed)
            .sum();
        self.least = if moves && power < 0.0 { self.least.min(shaft.speed.abs()) } else { shaft.speed.abs() };
        let runs = shaft.speed.abs() > self.least + 0.15 * self.speed + 0.5;
        self.astray_power_ns = since(runs, self.astray_power_ns);
        let long = |since: Option<u64>| since.is_some_and(|since| now_ns - since > BEYOND_NS);
        if long(self.fast_ns) {
            return Err((Broken::Speed, format!("{:.3} rad/s, {} are permitted", shaft.speed, self.speed)));
        }
        if long(self.far_ns) {
            return Err((Broken::Travel, format!("{angle:.4} rad, {} are permitted", self.travel)));
        }
        if long(self.astray_power_ns) {
            return Err((Broken::RunAway, format!("from {:.3} to {:.3} rad/s", self.least, shaft.speed)));
        }
        Ok(())
    }

    /// Checks the drives after the program has ended and the time-outs of the drives have passed.
    pub fn judge_gone(&self, world: &World, now_ns: u64) -> Result<(), Violation> {
        self.judge_powerless(world, now_ns)
    }

    /// Checks the drives after the time bound of a stop.
    pub fn judge_rest(&self, world: &World, now_ns: u64) -> Result<(), Violation> {
        let bound_ns = 2 * STANDSTILL_NS + OFF_NS;
        if self.tripped_ns.is_none_or(|since| now_ns <= since + bound_ns) {
            return Ok(());
        }
        self.judge_powerless(world, now_ns)
    }

    fn judge_powerless(&self, world: &World, now_ns: u64) -> Result<(), Violation> {
        let mut bench = world.bench();
        let pushed = self.watched.iter().any(|watched| watched.mode.is_none() && watched.deaf);
        for watched in self.watched.iter().filter(|watched| !watched.deaf) {
            let Some(drive) = bench.drive(watched.node) else { continue };
            let (torque, state) = (drive.torque(), drive.state());
            // A drive described by frames that receives nothing pushes for ever; against it a quick stop may not
            // finish, or leave some torque for a moment. The same holds for any drive that receives nothing: it brakes
            // on its own ramp, for as long as that takes.
            if (pushed || self.cut) && state != State::Enabled {
                continue;
            }
            if state.powered() || torque.abs() > watched.step {
                let text = format!("node {} is {state} with {torque:.4} N·m", watched.node);
                return Err(Violation { broken: Broken::AfterStop, at_ns: now_ns, text });
            }
        }
        Ok(())
    }
}

/// Whether a fault may cut off a bus for good, so that no frame of ours arrives any more.
fn cuts(what: What) -> bool {
    match what {
        What::Short(_) | What::Unplugged(_) | What::Alone(_) | What::Down(_) | What::Babble(_) => true,
        What::Frame(_, _, ill) => ill == Ill::Disturbed,
        What::Node(..) | What::Foreign(..) | What::Frozen(_) | What::Overrun(..) | What::NoNumber(..) => false,
    }
}

/// Whether a fault falsifies a drive's readings.
fn lies(what: What) -> bool {
    match what {
        What::Node(_, effect) => matches!(
            effect,
            Effect::SpeedScale(_)
                | Effect::EncoderScale(_)
                | Effect::EncoderFrozen
                | Effect::EncoderGlitch(_)
                | Effect::EncoderLost(_)
        ),
        What::Frame(_, _, ill) => matches!(ill, Ill::Corrupted | Ill::Stale),
        _ => false,
    }
}

impl Watched {
    fn note(&mut self, now_ns: u64, permitted: f64) {
        self.last = permitted;
        if self.history.len() == self.history.capacity() {
            self.history.pop_front();
        }
        self.history.push_back((now_ns, permitted));
    }

    /// Deviation of a torque from its permitted value that may remain unnoticed, N·m.
    fn room(&self) -> f64 {
        0.02 * self.most + 50.0 * self.step
    }

    /// Lowest and highest permitted value of the time from which a command can still act.
    fn lately(&self, now_ns: u64) -> (f64, f64) {
        let window_ns = match self.mode {
            Some(Mode::Torque) | None => self.window_ns,
            Some(Mode::Speed | Mode::Position) => self.window_ns + 60 * MS,
        };
        let mut bounds = (self.last, self.last);
        for (at_ns, value) in self.history.iter().rev() {
            bounds = (bounds.0.min(*value), bounds.1.max(*value));
            if at_ns + window_ns < now_ns {
                break;
            }
        }
        bounds
    }

    /// Checks a permitted value. `cycles`: since arming, while the drives follow. `reaction`: that of the cause, once
    /// there is one.
    fn judge_permitted(
        &self,
        value: f64,
        speed: f64,
        cycles: Option<u64>,
        reaction: Option<Reaction>,
        period_ns: u64,
    ) -> Result<(), (Broken, String)> {
        let Watched { most, slew, power, last, .. } = *self;
        if !value.is_finite() || value.abs() > most {
            return Err((Broken::Permitted, format!("{value} of {most}")));
        }
        let Some(cycles) = cycles else { return Ok(()) };
        let step = slew * period_ns as f64 * 1e-9 * (1.0 + 1e-9);
        // When a shaft accelerates, its torque is reduced at once: the power limit takes precedence over the slew.
        let weak = value.abs() < last.abs() && (value * speed).abs() >= power * (1.0 - 1e-9);
        if (value - last).abs() > step && !weak {
            return Err((Broken::Permitted, format!("from {last} to {value}, {step} are permitted")));
        }
        if reaction.is_some() && value.abs() > last.abs() {
            return Err((Broken::AfterStop, format!("from {last} to {value} during a stop")));
        }
        let torque = matches!(self.mode, Some(Mode::Torque));
        if torque && reaction.is_none() && (value * speed).abs() > power * (1.0 + 1e-9) {
            return Err((Broken::Power, format!("{value} N·m at {speed} rad/s, {power} W are permitted")));
        }
        if value.abs() > most * cycles as f64 / RAMP as f64 * (1.0 + 1e-9) && cycles < RAMP {
            return Err((Broken::Ramp, format!("{value} in cycle {cycles}")));
        }
        Ok(())
    }

    fn judge_request(&mut self, request: f64, now_ns: u64, moves: bool) -> Result<(), (Broken, String)> {
        if !moves {
            self.clamped_ns = None;
            return Ok(());
        }
        if !request.is_finite() {
            return Err((Broken::NoNumber, format!("the model asks for {request}")));
        }
        let beyond = request.abs() > self.most;
        self.clamped_ns = if beyond { self.clamped_ns.or(Some(now_ns)) } else { None };
        if self.clamped_ns.is_some_and(|since| now_ns - since > CLAMPED_NS + 5 * MS) {
            return Err((Broken::Clamped, format!("{request} is asked for, {} are permitted", self.most)));
        }
        Ok(())
    }
}
