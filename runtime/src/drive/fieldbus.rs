//! All nodes of a rig on all its buses: the sequence of their start-up, commands, supervision and stop.
//!
//! In: received frames with their timestamps; once per tick [`Fieldbus::begin`], the permitted commands, and
//! [`Fieldbus::end`]; requests of the operator. Out: frames, signals, the step of the start-up or the reason of its
//! refusal, troubles. Allocates at construction and while drives are configured, never from [`Step::Sync`] on.

use super::Send;
use super::device::Device;
use super::profiles::{self, Transport};
use super::state::{Goal, State};
use crate::can::Frame;
use crate::canopen::service::{self, Service};
use crate::canopen::{Nmt, NmtState};
use crate::drive::cia402::{Drive, Limits, Setting, Status};
use crate::drive::faults::{Reading, Refusal, RefusalReason, Trouble, TroubleKind};
use crate::drive::polarity_check::{Bounds, PATIENCE, PATIENCE_BY_HAND, PolarityVerdict, Push, Sample, SignTest};
use crate::drive::sdo_sequence::Watching;
use crate::safety::{Protection, is_present};
use abi::rig::{Kind, Mode, Rig, Signal, SignalKind};
use std::fmt;

/// Options of the start-up.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Options {
    /// Time for which the buses are monitored for another master.
    pub listen_ns: u64,
    /// Time for which SYNC must be answered before the start-up continues.
    pub steady_ns: u64,
    /// Permitted share of missing answers in that time.
    pub missed: f64,
    /// Kind of the polarity check.
    pub sign_test: SignTest,
    /// Whether each drive must prove that it stops when our heartbeat stops.
    pub timeout_test: bool,
    /// The drives are simulated, whatever their transport.
    pub simulated: bool,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            listen_ns: 1_000_000_000,
            steady_ns: 1_000_000_000,
            missed: 0.0,
            sign_test: SignTest::Push,
            timeout_test: true,
            simulated: false,
        }
    }
}

/// Step of the start-up.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Step {
    /// Checks that there is no other master on the bus.
    Listen,
    /// Resets the communication, and waits for the boot-up of each drive.
    Reset,
    /// Identifies the drives.
    Identity,
    /// Writes PDOs, heartbeats and time-outs, and reads them back.
    Configure,
    /// Starts the nodes: "operational".
    Start,
    /// Sends SYNC, and checks that it is answered in time.
    Sync,
    /// Sets the mode of operation and checks its display.
    Mode,
    /// Waits for the operator's [`Request::Enable`].
    AwaitEnable,
    /// Leads the drives to "operation enabled", at zero command.
    Enable,
    /// Time-out test: our heartbeat stops, so the drives must stop too.
    TimeoutTest,
    /// Enables the drives again.
    Reenable,
    /// Polarity check.
    SignTest,
    /// Waits for the operator's [`Request::Arm`].
    AwaitArm,
    /// Commands act.
    Armed,
    /// Stopped for good: a restart creates a new [`Fieldbus`], which identifies and checks the drives anew.
    Stopped,
    /// Refused for good.
    Refused,
}

impl Step {
    /// All steps, in the order of the start-up.
    pub const ALL: [Step; 16] = [
        Step::Listen,
        Step::Reset,
        Step::Identity,
        Step::Configure,
        Step::Start,
        Step::Sync,
        Step::Mode,
        Step::AwaitEnable,
        Step::Enable,
        Step::TimeoutTest,
        Step::Reenable,
        Step::SignTest,
        Step::AwaitArm,
        Step::Armed,
        Step::Stopped,
        Step::Refused,
    ];
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Step::Listen => "listening for another master",
            Step::Reset => "resetting communication",
            Step::Identity => "identifying the drives",
            Step::Configure => "configuring the drives",
            Step::Start => "starting the nodes",
            Step::Sync => "watching the answers to SYNC",
            Step::Mode => "setting the mode",
            Step::AwaitEnable => "waiting to be enabled",
            Step::Enable => "enabling at zero",
            Step::TimeoutTest => "testing the time-outs",
            Step::Reenable => "enabling again",
            Step::SignTest => "testing signs and scales",
            Step::AwaitArm => "waiting to be armed",
            Step::Armed => "armed",
            Step::Stopped => "stopped",
            Step::Refused => "refused",
        })
    }
}

/// Request of an operator or of the supervisor.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Request {
    /// Permitted in [`Step::AwaitEnable`].
    Enable,
    /// Permitted in [`Step::AwaitArm`].
    Arm,
    /// Stop on the drives' ramps; always permitted.
    QuickStop,
    /// Torque off; always permitted.
    Disable,
}

#[derive(Clone, Debug)]
enum StartingNode {
    Drive(Box<Drive>),
    Device(Device),
}

/// Most troubles that can wait to be read.
const TROUBLES: usize = 32;

/// Longest durations of the steps, ns.
const BOOT_NS: u64 = 5_000_000_000;
const IDENTITY_NS: u64 = 10_000_000_000;
const CONFIGURE_NS: u64 = 20_000_000_000;
const START_NS: u64 = 1_000_000_000;
const MODE_NS: u64 = 1_000_000_000;
const ENABLE_NS: u64 = 5_000_000_000;
/// Angle by which a shaft is turned from outside, rad.
const BY_HAND: f64 = 0.2;
/// Time within which a drive must obey a stop, ns; after that our heartbeat ends, and its own time-out stops it.
const OBEYS_NS: u64 = 20_000_000;
/// Interval between NMT commands to such a drive, ns.
const INSISTS_NS: u64 = 10_000_000;
/// Time for a drive to turn the shaft back after it has turned it for a check, ns.
const RETURN_NS: u64 = 500_000_000;
/// Time at zero command before our heartbeat stops.
const CALM_NS: u64 = 50_000_000;

/// All nodes of a rig.
#[derive(Clone, Debug)]
pub struct Fieldbus {
    names: Vec<String>,
    /// Bus of each node.
    places: Vec<usize>,
    nodes: Vec<StartingNode>,
    /// Whether a bus has CANopen nodes.
    canopen: Vec<bool>,
    stop_frames: Vec<Vec<Frame>>,
    off_frames: Vec<Vec<Frame>>,
    options: Options,
    /// Our node id.
    master: u8,
    period_ns: u64,
    heartbeat_ns: u64,
    heartbeat_due_ns: u64,
    /// Time since which our heartbeat has been stopped on purpose.
    silent_since_ns: Option<u64>,
    /// Whether SYNC is sent.
    running: bool,
    step: Step,
    /// Time at which the step began; none before its first tick.
    since_ns: Option<u64>,
    refusal: Option<Refusal>,
    /// Nodes that have completed the step.
    done: Vec<bool>,
    missed: Vec<u32>,
    answers: u32,
    /// The drive under check, and the drive that turns the shaft if the first one cannot.
    push: Option<(usize, Push, Option<usize>)>,
    /// Time, from the begin of the step, until which the shaft returns from a check.
    returns_ns: u64,
    /// Time at which a drive with torque was told to give it up.
    off_since_ns: Option<u64>,
    wanted: Vec<f64>,
    troubles: [Option<Trouble>; TROUBLES],
    lost_troubles: u64,
}

impl Fieldbus {
    /// The buses of a rig, before any frame is sent. The error is a message about a requirement that cannot be met.
    pub fn new(rig: &Rig, options: Options) -> Result<Fieldbus, String> {
        let used = |id: u8| rig.nodes.iter().any(|node| matches!(&node.kind, Kind::Cia402(drive) if drive.node == id));
        let master = (1..=127).rev().find(|id| !used(*id)).ok_or("all 127 node ids are taken: none is left for us")?;
        let mut nodes = Vec::with_capacity(rig.nodes.len());
        for (at, node) in rig.nodes.iter().enumerate() {
            let outputs = || rig.outputs.iter().filter(move |output| output.signal.node == at);
            let made = match &node.kind {
                Kind::Cia402(config) => {
                    let profile = profiles::find(&config.profile)
                        .ok_or_else(|| format!("`{}`: no profile `{}`", node.name, config.profile))?;
                    if profile.transport == Transport::DeviceNet && !options.simulated {
                        return Err(format!(
                            "`{}`: {} is reached through DeviceNet, which can only be simulated: run it with `--sim`",
                            node.name, profile.name
                        ));
                    }
                    let setting = Setting {
                        master,
                        period_ns: rig.period_ns,
                        watchdog_ns: rig.watchdog_ns,
                        slew: outputs().map(|output| output.slew).fold(f64::INFINITY, f64::min),
                        safe: outputs().next().map_or(0.0, |output| output.safe),
                        most: outputs().map(|output| output.high.min(-output.low)).fold(f64::INFINITY, f64::min),
                    };
                    Drive::new(config, profile, setting).map(|drive| StartingNode::Drive(Box::new(drive)))
                }
                Kind::Frames(messages) => {
                    let safe: Vec<_> = outputs()
                        .filter_map(|output| match output.signal.what {
                            SignalKind::Field(message, field) => Some((message, field, output.safe)),
                            _ => None,
                        })
                        .collect();
                    Device::new(messages, node.moves, &safe).map(StartingNode::Device)
                }
            };
            nodes.push(made.map_err(|error| format!("`{}`: {error}", node.name))?);
        }
        let places: Vec<usize> = rig.nodes.iter().map(|node| node.bus).collect();
        let mut canopen = vec![false; rig.buses.len()];
        for (node, bus) in nodes.iter().zip(&places) {
            canopen[*bus] |= matches!(node, StartingNode::Drive(_));
        }
        let mut fieldbus = Fieldbus {
            names: rig.nodes.iter().map(|node| node.name.clone()).collect(),
            stop_frames: vec![Vec::new(); rig.buses.len()],
            off_frames: vec![Vec::new(); rig.buses.len()],
            done: vec![false; nodes.len()],
            missed: vec![0; nodes.len()],
            wanted: vec![0.0; nodes.len()],
            places,
            nodes,
            canopen,
            options,
            master,
            period_ns: rig.period_ns,
            heartbeat_ns: (rig.watchdog_ns / 2).max(rig.period_ns),
            heartbeat_due_ns: 0,
            silent_since_ns: None,
            running: false,
            step: Step::Listen,
            since_ns: None,
            refusal: None,
            answers: 0,
            push: None,
            returns_ns: 0,
            off_since_ns: None,
            troubles: [None; TROUBLES],
            lost_troubles: 0,
        };
        // The drive under test first, the emulating drive last.
        let mut order: Vec<usize> = (0..fieldbus.nodes.len()).collect();
        order.sort_by_key(|node| rig.predict == Some(*node));
        for node in order {
            let bus = fieldbus.places[node];
            match &fieldbus.nodes[node] {
                StartingNode::Drive(drive) => {
                    let [stop, off] = drive.stop_frames();
                    fieldbus.stop_frames[bus].push(stop);
                    fieldbus.off_frames[bus].push(off);
                }
                StartingNode::Device(device) => {
                    fieldbus.stop_frames[bus].extend(device.stop_frames());
                    fieldbus.off_frames[bus].extend(device.stop_frames());
                }
            }
        }
        for bus in (0..rig.buses.len()).filter(|bus| fieldbus.canopen[*bus]) {
            // A drive that acts on SYNC would wait for one that a failed cycle never sends.
            fieldbus.stop_frames[bus].push(service::sync(None));
            fieldbus.off_frames[bus].push(service::sync(None));
        }
        Ok(fieldbus)
    }

    /// Current step of the start-up.
    pub fn step(&self) -> Step {
        self.step
    }

    /// Reason of the refusal.
    pub fn refusal(&self) -> Option<&Refusal> {
        self.refusal.as_ref()
    }

    /// A refusal as text, with the name of its node.
    pub fn explain(&self, refusal: &Refusal) -> String {
        self.named(refusal.node, &refusal.why)
    }

    /// A trouble as text, with the name of its node.
    pub fn tell(&self, trouble: &Trouble) -> String {
        self.named(trouble.node, &trouble.kind)
    }

    fn named(&self, node: Option<usize>, what: &dyn fmt::Display) -> String {
        match node {
            None => what.to_string(),
            Some(node) => match &self.nodes[node] {
                StartingNode::Drive(drive) => format!("{} (node {}): {what}", self.names[node], drive.node()),
                StartingNode::Device(_) => format!("{}: {what}", self.names[node]),
            },
        }
    }

    /// Takes the oldest trouble that has not been read.
    pub fn trouble(&mut self) -> Option<Trouble> {
        let first = self.troubles[0].take();
        self.troubles.rotate_left(1);
        first
    }

    /// Number of troubles dropped because they were not read.
    pub fn lost_troubles(&self) -> u64 {
        self.lost_troubles
    }

    /// The frames that stop all drives of a bus on their ramps, prepared in advance.
    pub fn stop_frames(&self, bus: usize) -> &[Frame] {
        &self.stop_frames[bus]
    }

    /// The frames that disable the torque of all drives of a bus, prepared in advance.
    pub fn off_frames(&self, bus: usize) -> &[Frame] {
        &self.off_frames[bus]
    }

    /// A signal of the rig.
    ///
    /// # Panics
    /// If the rig has no such signal: an error of the caller.
    pub fn reading(&self, signal: Signal) -> Reading {
        let reading = match (&self.nodes[signal.node], signal.what) {
            (StartingNode::Drive(drive), what) => drive.reading(what),
            (StartingNode::Device(device), SignalKind::Field(message, field)) => device.reading(message, field),
            (StartingNode::Device(_), _) => None,
        };
        reading.unwrap_or_else(|| panic!("`{}` has no signal {:?}", self.names[signal.node], signal.what))
    }

    /// Whether a node has this signal.
    pub fn has(&self, signal: Signal) -> bool {
        match (&self.nodes[signal.node], signal.what) {
            (StartingNode::Drive(drive), what) => drive.reading(what).is_some(),
            (StartingNode::Device(device), SignalKind::Field(message, field)) => {
                device.reading(message, field).is_some()
            }
            (StartingNode::Device(_), _) => false,
        }
    }

    /// Sets a command for the next [`end`](Fieldbus::end), SI. The supervisor must have permitted it.
    pub fn command(&mut self, signal: Signal, value: f64) {
        match (&mut self.nodes[signal.node], signal.what) {
            (StartingNode::Drive(drive), _) => drive.command(value),
            (StartingNode::Device(device), SignalKind::Field(message, field)) => device.command(message, field, value),
            (StartingNode::Device(_), _) => {}
        }
    }

    /// The start-up's own request for this command, SI: it passes the supervisor like every other command. Once armed,
    /// 0 or the safe value.
    pub fn wanted(&self, signal: Signal) -> f64 {
        match (&self.nodes[signal.node], signal.what) {
            (StartingNode::Drive(_), _) => self.wanted[signal.node],
            (StartingNode::Device(device), SignalKind::Field(message, field)) => device.safe(message, field),
            (StartingNode::Device(_), _) => 0.0,
        }
    }

    /// Status of a drive; none for a device.
    pub fn status(&self, node: usize) -> Option<Status> {
        match &self.nodes[node] {
            StartingNode::Drive(drive) => Some(drive.status()),
            StartingNode::Device(_) => None,
        }
    }

    /// Limits of a drive, zero before it is identified; none for a device.
    pub fn limits(&self, node: usize) -> Option<Limits> {
        match &self.nodes[node] {
            StartingNode::Drive(drive) => Some(drive.limits()),
            StartingNode::Device(_) => None,
        }
    }

    fn push_trouble(&mut self, trouble: Trouble) {
        match self.troubles.iter_mut().find(|place| place.is_none()) {
            Some(place) => *place = Some(trouble),
            None => self.lost_troubles += 1,
        }
    }

    /// Receives a frame of a bus.
    pub fn receive(&mut self, bus: usize, frame: &Frame, stamp_ns: u64, send: Send) {
        let mut owned = false;
        for at in 0..self.nodes.len() {
            if self.places[at] != bus {
                continue;
            }
            let mut found = [None; 4];
            let mut tell = |kind| {
                if let Some(place) = found.iter_mut().find(|place| place.is_none()) {
                    *place = Some(kind);
                }
            };
            match &mut self.nodes[at] {
                StartingNode::Drive(drive) => drive.receive(frame, stamp_ns, &mut tell, &mut |frame| send(bus, frame)),
                StartingNode::Device(device) => {
                    owned |= device.owns(frame);
                    device.receive(frame, stamp_ns, &mut tell);
                }
            }
            for kind in found.into_iter().flatten() {
                self.note(Some(at), kind, stamp_ns);
            }
        }
        if self.canopen[bus] && !owned && self.foreign(bus, frame) && is_present(Protection::Foreign) {
            self.note(None, TroubleKind::ForeignMaster(frame.id()), stamp_ns);
        }
    }

    /// Whether only another master can have sent this frame: our own frames are not received back.
    fn foreign(&self, bus: usize, frame: &Frame) -> bool {
        let ours = |id: u8| {
            let on_bus = self.nodes.iter().zip(&self.places).filter(|(_, place)| **place == bus);
            on_bus.filter_map(|(node, _)| drive_of(node)).any(|drive| drive.node() == id)
        };
        match Service::of(frame) {
            Service::Nmt(..) | Service::Sync(_) => true,
            Service::SdoRequest(node) | Service::GuardRequest(node) | Service::Rpdo(node, _) => ours(node),
            Service::Heartbeat(node, ..) => !ours(node),
            Service::SdoAnswer(_) | Service::Tpdo(..) | Service::Emergency(..) | Service::Other => false,
        }
    }

    /// Handles a trouble according to the step: it refuses the start, is expected, or is left to the supervisor.
    fn note(&mut self, node: Option<usize>, kind: TroubleKind, stamp_ns: u64) {
        let foreign = matches!(kind, TroubleKind::ForeignMaster(_));
        // A drive's report while it is reset, enabled or tested is an expected answer.
        let answer = matches!(kind, TroubleKind::Emergency(_) | TroubleKind::Fault | TroubleKind::Left(_));
        match self.step {
            Step::Listen => {
                if let TroubleKind::ForeignMaster(id) = kind {
                    self.refuse(None, RefusalReason::ForeignMaster(id));
                }
            }
            Step::Reset if !foreign => {}
            Step::TimeoutTest | Step::Reenable if answer || matches!(kind, TroubleKind::Nmt(_)) => {}
            Step::Identity | Step::Configure | Step::Start | Step::Sync | Step::Mode if answer => {}
            Step::AwaitEnable | Step::Enable if answer => {}
            Step::AwaitArm | Step::Armed | Step::Stopped => self.push_trouble(Trouble { node, kind, stamp_ns }),
            Step::Refused => {}
            _ => self.refuse(node, RefusalReason::Trouble(kind)),
        }
    }

    fn refuse(&mut self, node: Option<usize>, why: RefusalReason) {
        self.refusal = Some(Refusal { node, why });
        self.go(Step::Refused);
        self.aim(Goal::Off, false);
    }

    fn go(&mut self, step: Step) {
        (self.step, self.since_ns, self.silent_since_ns) = (step, None, None);
        self.done.fill(false);
        self.wanted.fill(0.0);
        (self.push, self.returns_ns, self.off_since_ns) = (None, 0, None);
        // A drive monitors us only from our first life sign after its configuration on (CiA 301). With a long watchdog the
        // next regular one might come when it is enabled already, or after the time-out test.
        self.heartbeat_due_ns = 0;
        self.nodes.iter_mut().filter_map(drive_of_mut).for_each(Drive::guard_now);
    }

    fn aim(&mut self, goal: Goal, resets: bool) {
        for drive in self.nodes.iter_mut().filter_map(drive_of_mut) {
            drive.aim(goal, resets);
        }
    }

    /// Executes a request; false if this step does not permit it.
    pub fn request(&mut self, request: Request) -> bool {
        match (request, self.step) {
            (Request::Enable, Step::AwaitEnable) => {
                self.aim(Goal::Enabled, true);
                self.go(Step::Enable);
            }
            (Request::Arm, Step::AwaitArm) => self.go(Step::Armed),
            (Request::QuickStop, Step::Refused | Step::Stopped) => self.aim(Goal::Stopped, false),
            (Request::Disable, Step::Refused | Step::Stopped) => self.aim(Goal::Off, false),
            (Request::QuickStop | Request::Disable, _) => {
                let goal = if request == Request::QuickStop { Goal::Stopped } else { Goal::Off };
                self.aim(goal, false);
                for node in &mut self.nodes {
                    if let StartingNode::Device(device) = node {
                        device.rest();
                    }
                }
                self.go(Step::Stopped);
            }
            (Request::Enable | Request::Arm, _) => return false,
        }
        true
    }

    /// Whether no drive can have torque.
    pub fn at_rest(&self) -> bool {
        self.nodes.iter().filter_map(drive_of).all(|drive| !drive.state().powered())
    }

    /// Begins a tick: sends SYNC, and ages all readings by one tick.
    pub fn begin(&mut self, send: Send) {
        for node in &mut self.nodes {
            match node {
                StartingNode::Drive(drive) => drive.begin(),
                StartingNode::Device(device) => device.begin(),
            }
        }
        if self.running {
            for bus in (0..self.canopen.len()).filter(|bus| self.canopen[*bus]) {
                send(bus, service::sync(None));
            }
        }
    }

    /// Ends a tick: sends commands, then our heartbeat, then the frames of the start-up.
    pub fn end(&mut self, now_ns: u64, send: Send) {
        for at in 0..self.nodes.len() {
            let mut found = [None; 2];
            if let StartingNode::Drive(drive) = &mut self.nodes[at] {
                drive.watch(now_ns, &mut |kind| {
                    if let Some(place) = found.iter_mut().find(|place| place.is_none()) {
                        *place = Some(kind);
                    }
                });
            }
            for kind in found.into_iter().flatten() {
                self.note(Some(at), kind, now_ns);
            }
        }
        let running = self.running;
        for (node, bus) in self.nodes.iter_mut().zip(&self.places) {
            let mut send = |frame| send(*bus, frame);
            match node {
                StartingNode::Drive(drive) if running => drive.send_command(&mut send),
                StartingNode::Drive(_) => {}
                StartingNode::Device(device) => device.send_commands(now_ns, &mut send),
            }
        }
        self.live(now_ns, send);
        self.start(now_ns, send);
    }

    /// Sends our heartbeat and guard requests, unless a test suppresses them.
    fn live(&mut self, now_ns: u64, send: Send) {
        let alive = self.step > Step::Reset && self.silent_since_ns.is_none();
        if !alive {
            return;
        }
        if now_ns >= self.heartbeat_due_ns {
            self.heartbeat_due_ns = now_ns + self.heartbeat_ns - self.period_ns / 2;
            for bus in (0..self.canopen.len()).filter(|bus| self.canopen[*bus]) {
                send(bus, NmtState::Operational.heartbeat(self.master));
            }
        }
        for (node, bus) in self.nodes.iter_mut().zip(&self.places) {
            if let StartingNode::Drive(drive) = node {
                drive.guard(now_ns, &mut |frame| send(*bus, frame));
            }
        }
    }

    /// Works on each drive that has not completed the step; returns true once all have.
    fn each(
        &mut self,
        send: Send,
        mut work: impl FnMut(&mut Drive, crate::canopen::Send) -> Result<bool, RefusalReason>,
    ) -> bool {
        for at in 0..self.nodes.len() {
            let StartingNode::Drive(drive) = &mut self.nodes[at] else { continue };
            if self.done[at] {
                continue;
            }
            let bus = self.places[at];
            match work(drive, &mut |frame| send(bus, frame)) {
                Ok(done) => self.done[at] = done,
                Err(why) => {
                    self.refuse(Some(at), why);
                    return false;
                }
            }
        }
        self.nodes.iter().zip(&self.done).all(|(node, done)| *done || drive_of(node).is_none())
    }

    /// Refuses the first drive that has not completed the step, if the step has taken too long.
    fn within(&mut self, limit_ns: u64, lasted_ns: u64, why: impl Fn(&Drive) -> RefusalReason) {
        if lasted_ns < limit_ns || self.step == Step::Refused {
            return;
        }
        let late = (0..self.nodes.len()).find_map(|at| {
            let drive = drive_of(&self.nodes[at])?;
            (!self.done[at]).then(|| (at, why(drive)))
        });
        if let Some((at, why)) = late {
            self.refuse(Some(at), why);
        }
    }

    /// Advances the start-up by one tick.
    fn start(&mut self, now_ns: u64, send: Send) {
        let first = self.since_ns.is_none();
        let lasted_ns = now_ns - *self.since_ns.get_or_insert(now_ns);
        match self.step {
            Step::Listen if lasted_ns >= self.options.listen_ns => self.go(Step::Reset),
            Step::Listen => {}
            Step::Reset => {
                // Repeated every second, because a drive may have been booting. Never in the cycle after the first one,
                // which may come slightly early: a drive that has just booted would boot again.
                let again = first || (lasted_ns >= 1_000_000_000 && lasted_ns % 1_000_000_000 < self.period_ns);
                let all = self.each(send, |drive, send| {
                    if first {
                        drive.forget();
                    }
                    if again && !drive.has_booted() {
                        send(Nmt::ResetCommunication.frame(drive.node()));
                    }
                    Ok(drive.has_booted())
                });
                if all {
                    return self.go(Step::Identity);
                }
                self.within(BOOT_NS, lasted_ns, |_| RefusalReason::Silent);
            }
            Step::Identity => {
                if self.each(send, |drive, send| drive.identify(now_ns, send)) {
                    return self.go(Step::Configure);
                }
                self.within(IDENTITY_NS, lasted_ns, |_| RefusalReason::Silent);
            }
            Step::Configure => {
                if self.each(send, |drive, send| drive.configure(now_ns, send)) {
                    return self.go(Step::Start);
                }
                self.within(CONFIGURE_NS, lasted_ns, |_| RefusalReason::Silent);
            }
            Step::Start => {
                let all = self.each(send, |drive, send| {
                    if first {
                        send(Nmt::Start.frame(drive.node()));
                    }
                    Ok(drive.nmt() == NmtState::Operational)
                });
                if all {
                    self.answers = 0;
                    self.missed.fill(0);
                    self.running = true;
                    return self.go(Step::Sync);
                }
                self.within(START_NS, lasted_ns, |drive| RefusalReason::NotOperational(drive.nmt()));
            }
            Step::Sync => self.count_answers(lasted_ns),
            Step::Mode => {
                if self.each(send, |drive, send| drive.give_mode(now_ns, send)) {
                    return self.go(Step::AwaitEnable);
                }
                self.within(MODE_NS, lasted_ns, Drive::wrong_mode);
            }
            Step::AwaitEnable | Step::AwaitArm | Step::Armed => {}
            Step::Stopped | Step::Refused => self.insist(now_ns, lasted_ns, send),
            Step::Enable | Step::Reenable => self.enable(lasted_ns, send),
            Step::TimeoutTest => self.test_timeouts(now_ns, lasted_ns, send),
            Step::SignTest => self.test_signs(lasted_ns),
        }
    }

    fn count_answers(&mut self, lasted_ns: u64) {
        // The first answers may be missing, because the drives have just been started.
        if lasted_ns < 5 * self.period_ns {
            return;
        }
        self.answers += 1;
        for (node, missed) in self.nodes.iter().zip(&mut self.missed) {
            *missed += u32::from(drive_of(node).is_some_and(|drive| !drive.answered()));
        }
        if lasted_ns >= self.options.steady_ns {
            let most = f64::from(self.answers) * self.options.missed;
            let worst = (0..self.nodes.len()).find(|at| f64::from(self.missed[*at]) > most);
            match worst {
                Some(at) => self.refuse(Some(at), RefusalReason::Missed(self.missed[at], self.answers)),
                None => self.go(Step::Mode),
            }
        }
    }

    /// Handles a drive that does not obey a stop: either no frame reaches it, or its set-points alone do not. The stop
    /// is commanded by NMT, and our heartbeat ends: the drive's own time-out, which the start-up has tested, stops it.
    fn insist(&mut self, now_ns: u64, lasted_ns: u64, send: Send) {
        if lasted_ns < OBEYS_NS || !is_present(Protection::Silence) {
            return;
        }
        for at in 0..self.nodes.len() {
            let StartingNode::Drive(drive) = &self.nodes[at] else { continue };
            if !drive.disobeys() {
                continue;
            }
            // In "pre-operational" it accepts no set-points, and so none that disable the torque. A quick stop that
            // does not finish, because the shaft is too fast or a sign is wrong, is ended by a reset.
            let resets = drive.is_to_be_off();
            if resets && now_ns - *self.off_since_ns.get_or_insert(now_ns) < OBEYS_NS {
                continue;
            }
            let booted = drive.nmt() == NmtState::BootUp;
            self.silent_since_ns.get_or_insert(now_ns);
            if lasted_ns % INSISTS_NS < self.period_ns && !booted {
                let command = if resets { Nmt::ResetNode } else { Nmt::PreOperational };
                send(self.places[at], command.frame(drive.node()));
            }
        }
    }

    fn enable(&mut self, lasted_ns: u64, send: Send) {
        let again = self.step == Step::Reenable;
        if again && lasted_ns < CALM_NS {
            // Time for the drives' reports about the test to arrive.
            return;
        }
        self.aim(Goal::Enabled, true);
        if self.each(send, |drive, _| Ok(drive.following())) {
            self.aim(Goal::Enabled, false);
            for drive in self.nodes.iter_mut().filter_map(drive_of_mut) {
                drive.rest();
            }
            return self.go(match (again, self.options.timeout_test) {
                (false, true) => Step::TimeoutTest,
                _ if self.options.sign_test == SignTest::Skip => Step::AwaitArm,
                _ => Step::SignTest,
            });
        }
        self.within(ENABLE_NS, lasted_ns, Drive::not_enabled);
    }

    /// Stops our heartbeat at zero command, and waits for each drive to leave "operation enabled".
    fn test_timeouts(&mut self, now_ns: u64, lasted_ns: u64, send: Send) {
        if lasted_ns < CALM_NS {
            return;
        }
        let since = *self.silent_since_ns.get_or_insert(now_ns);
        let waited = now_ns - since;
        let (slack, heartbeat) = (20_000_000 + 4 * self.period_ns, self.heartbeat_ns);
        let all = self.each(send, |drive, _| {
            if drive.state() != State::Enabled || drive.nmt() != NmtState::Operational {
                drive.timeout_measured_ns.get_or_insert(waited);
                // The next command must not enable it again.
                drive.aim(Goal::Off, false);
                return Ok(true);
            }
            let status = drive.status();
            let limit_ms = match drive.watching() {
                Some(Watching::Nothing) | None => 0,
                Some(_) => status.timeout.map_or(0, |(ms, _)| ms),
            };
            if waited > u64::from(limit_ms) * 1_500_000 + heartbeat + slack {
                return Err(RefusalReason::TimeoutIgnored(waited / 1_000_000));
            }
            Ok(false)
        });
        if all || self.step == Step::Refused {
            self.silent_since_ns = None;
        }
        if all {
            for at in 0..self.nodes.len() {
                let bus = self.places[at];
                if let StartingNode::Drive(drive) = &self.nodes[at]
                    && drive.nmt() != NmtState::Operational
                {
                    send(bus, Nmt::Start.frame(drive.node()));
                }
            }
            self.go(Step::Reenable);
        }
    }

    /// Polarity check, one drive after the other.
    fn test_signs(&mut self, lasted_ns: u64) {
        let by_hand = self.options.sign_test == SignTest::ByHand;
        let turning = |drive: &Drive| match drive.config().mode {
            Mode::Position => 1.5 * BY_HAND,
            Mode::Torque | Mode::Speed => bounds(drive).command,
        };
        if self.push.is_none() {
            let next = (0..self.nodes.len()).find(|at| drive_of(&self.nodes[*at]).is_some() && !self.done[*at]);
            let Some(at) = next else {
                return self.moved();
            };
            // A drive that controls speed or position returns the shaft from the previous check.
            if lasted_ns < self.returns_ns {
                return;
            }
            let drive = drive_of(&self.nodes[at]).expect("found as one");
            if drive.reading(SignalKind::Position).is_none() {
                // Without a position there is nothing to compare: the operator must check the direction of this drive.
                self.done[at] = true;
                return;
            }
            // A torque cannot turn a shaft whose speed or position another drive controls, so that drive turns it.
            let holds =
                |at: &usize| drive_of(&self.nodes[*at]).is_some_and(|drive| drive.config().mode != Mode::Torque);
            let holder = (0..self.nodes.len()).find(holds).filter(|_| drive.config().mode == Mode::Torque && !by_hand);
            let (mut bounds, turned) = (bounds(drive), by_hand || holder.is_some());
            if turned {
                bounds.angle = BY_HAND.max(bounds.angle);
            }
            let patience = match holder.and_then(|holder| drive_of(&self.nodes[holder])) {
                // Three times as long as the rotation takes at the commanded speed.
                Some(holder) if holder.config().mode == Mode::Speed => PATIENCE + 3.0 * bounds.angle / turning(holder),
                Some(_) => 2.0 * PATIENCE,
                None => PATIENCE_BY_HAND,
            };
            self.push = Some((at, Push::new(bounds, turned.then_some(patience)), holder));
        }
        let Some((at, push, holder)) = &mut self.push else { return };
        let (at, holder) = (*at, *holder);
        let drive = drive_of(&self.nodes[at]).expect("found as one");
        match push.tick(sample(drive), self.period_ns as f64 * 1e-9) {
            PolarityVerdict::Wants(command) => {
                self.wanted[at] = command;
                if let Some(holder) = holder {
                    self.wanted[holder] = drive_of(&self.nodes[holder]).map_or(0.0, turning);
                }
            }
            PolarityVerdict::Right => {
                if let Some(holder) = holder {
                    self.wanted[holder] = 0.0;
                    self.returns_ns = lasted_ns + RETURN_NS;
                }
                (self.done[at], self.wanted[at], self.push) = (true, 0.0, None);
            }
            PolarityVerdict::Wrong(why) => self.refuse(Some(at), why),
        }
    }

    /// Ends the motions of the start-up: angles count from here.
    fn moved(&mut self) {
        for drive in self.nodes.iter_mut().filter_map(drive_of_mut) {
            drive.rest();
        }
        self.go(Step::AwaitArm);
    }
}

/// The readings of a drive for the polarity check.
fn sample(drive: &Drive) -> Sample {
    let value = |what| drive.reading(what).map(|reading| reading.value);
    Sample {
        position: value(SignalKind::Position).unwrap_or(0.0),
        speed: value(SignalKind::Speed),
        torque: value(SignalKind::Torque),
    }
}

/// Limits of a drive's polarity check.
fn bounds(drive: &Drive) -> Bounds {
    let (config, limits) = (drive.config(), drive.limits());
    let command = match config.mode {
        Mode::Torque => 0.3 * drive.most(),
        Mode::Speed => (0.01 * drive.most()).max(4.0 * config.speed_unit),
        Mode::Position => 0.0,
    };
    Bounds {
        mode: config.mode,
        command,
        angle: (50.0 * config.count).max(5e-3),
        angle_most: (5000.0 * config.count).max(0.5),
        speed_most: 0.1 * limits.speed,
        speed_unit: config.speed_unit,
        torque_unit: config.rated_torque / drive.profile().full_torque as f64,
    }
}

fn drive_of(node: &StartingNode) -> Option<&Drive> {
    match node {
        StartingNode::Drive(drive) => Some(drive),
        StartingNode::Device(_) => None,
    }
}

fn drive_of_mut(node: &mut StartingNode) -> Option<&mut Drive> {
    match node {
        StartingNode::Drive(drive) => Some(drive),
        StartingNode::Device(_) => None,
    }
}
