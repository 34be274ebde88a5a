//! All nodes of a rig on all its buses: the order in which they are started, commanded, watched and stopped.
//!
//! In: received frames with their stamps; once a tick [`Fieldbus::begin`], the permitted commands,
//! [`Fieldbus::end`]; what the operator asks for. Out: frames, signals, the step of the start-up or why it was refused,
//! troubles. Allocates while it is made and while the drives are configured, never from [`Step::Sync`] on.

use super::Send;
use super::device::Device;
use super::profiles::{self, Transport};
use super::state::{Goal, State};
use crate::can::Frame;
use crate::canopen::service::{self, Service};
use crate::canopen::{Nmt, NmtState};
use crate::drive::cia402::{Drive, Limits, Setting, Status};
use crate::drive::faults::{Reading, Refusal, Trouble, TroubleKind, Why};
use crate::drive::polarity_check::{Bounds, PATIENCE, PATIENCE_BY_HAND, Push, Sample, SignTest, Verdict};
use crate::drive::sdo_sequence::Watching;
use crate::safety::{Protection, is_present};
use abi::rig::{Kind, Mode, Rig, Signal, What};
use std::fmt;

/// How a rig is started.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Options {
    /// How long the buses are listened to for another master.
    pub listen_ns: u64,
    /// How long SYNC must be answered before anything else.
    pub steady_ns: u64,
    /// Share of answers that may miss while it must be steady.
    pub missed: f64,
    /// The first motion.
    pub sign_test: SignTest,
    /// Whether drives must be seen to stop when our life sign does.
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

/// Where the start-up is.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Step {
    /// Is the bus ours alone?
    Listen,
    /// Reset of communication, boot-up of each drive.
    Reset,
    /// Who is there?
    Identity,
    /// PDOs, heartbeats, time-outs: written and read back.
    Configure,
    /// To "operational".
    Start,
    /// SYNC, answered in time.
    Sync,
    /// The mode is given and shown.
    Mode,
    /// Waits for the operator's [`Request::Enable`].
    AwaitEnable,
    /// To "operation enabled", at zero.
    Enable,
    /// Our life sign stops; the drives must stop too.
    TimeoutTest,
    /// Enabled once more.
    Reenable,
    /// The first motion.
    SignTest,
    /// Waits for the operator's [`Request::Arm`].
    AwaitArm,
    /// Commands act.
    Armed,
    /// Stopped, for good: a start makes a new [`Fieldbus`], which identifies and tests the drives anew.
    Stopped,
    /// Refused, for good.
    Refused,
}

impl Step {
    /// All of them, in the order in which a start-up takes them.
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

/// What an operator, or the supervisor, asks for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Request {
    /// From [`Step::AwaitEnable`].
    Enable,
    /// From [`Step::AwaitArm`].
    Arm,
    /// Stop on the drives' ramps; always.
    QuickStop,
    /// Torque off; always.
    Disable,
}

#[derive(Clone, Debug)]
enum Node {
    Drive(Box<Drive>),
    Device(Device),
}

/// Most troubles that wait to be read.
const TROUBLES: usize = 32;

/// Longest times of the steps, ns.
const BOOT_NS: u64 = 5_000_000_000;
const IDENTITY_NS: u64 = 10_000_000_000;
const CONFIGURE_NS: u64 = 20_000_000_000;
const START_NS: u64 = 1_000_000_000;
const MODE_NS: u64 = 1_000_000_000;
const ENABLE_NS: u64 = 5_000_000_000;
/// Angle by which a shaft is turned from outside, rad.
const BY_HAND: f64 = 0.2;
/// Time in which a drive must show that it obeys a stop, ns: then our life sign ends, and it stops by its own time-out.
const OBEYS_NS: u64 = 20_000_000;
/// Interval between network-management commands to such a drive, ns.
const INSISTS_NS: u64 = 10_000_000;
/// Time in which a drive that has turned a shaft for a test brings it back, ns.
const RETURN_NS: u64 = 500_000_000;
/// How long our life sign goes on at rest before it stops.
const CALM_NS: u64 = 50_000_000;

/// All nodes of a rig.
#[derive(Clone, Debug)]
pub struct Fieldbus {
    names: Vec<String>,
    /// Bus of each node.
    places: Vec<usize>,
    nodes: Vec<Node>,
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
    /// Our life sign is stopped on purpose, since when.
    silent_since_ns: Option<u64>,
    /// SYNC is sent.
    running: bool,
    step: Step,
    /// Since when the step lasts; none before its first tick.
    since_ns: Option<u64>,
    refusal: Option<Refusal>,
    /// Nodes done with the step.
    done: Vec<bool>,
    missed: Vec<u32>,
    answers: u32,
    /// The drive under test; the drive that turns it where it can't turn by itself.
    push: Option<(usize, Push, Option<usize>)>,
    /// Until then, from the begin of the step, the shaft comes back from a test.
    returns_ns: u64,
    /// Since when a drive that has torque has been told to give it up.
    off_since_ns: Option<u64>,
    wanted: Vec<f64>,
    troubles: [Option<Trouble>; TROUBLES],
    lost_troubles: u64,
}

impl Fieldbus {
    /// The buses of a rig, before anything was sent. The error says what the rig asks for that can't be had.
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
                    Drive::new(config, profile, setting).map(|drive| Node::Drive(Box::new(drive)))
                }
                Kind::Frames(messages) => {
                    let safe: Vec<_> = outputs()
                        .filter_map(|output| match output.signal.what {
                            What::Field(message, field) => Some((message, field, output.safe)),
                            _ => None,
                        })
                        .collect();
                    Device::new(messages, node.moves, &safe).map(Node::Device)
                }
            };
            nodes.push(made.map_err(|error| format!("`{}`: {error}", node.name))?);
        }
        let places: Vec<usize> = rig.nodes.iter().map(|node| node.bus).collect();
        let mut canopen = vec![false; rig.buses.len()];
        for (node, bus) in nodes.iter().zip(&places) {
            canopen[*bus] |= matches!(node, Node::Drive(_));
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
        // The drive under test first, the one that emulates last.
        let mut order: Vec<usize> = (0..fieldbus.nodes.len()).collect();
        order.sort_by_key(|node| rig.predict == Some(*node));
        for node in order {
            let bus = fieldbus.places[node];
            match &fieldbus.nodes[node] {
                Node::Drive(drive) => {
                    let [stop, off] = drive.stop_frames();
                    fieldbus.stop_frames[bus].push(stop);
                    fieldbus.off_frames[bus].push(off);
                }
                Node::Device(device) => {
                    fieldbus.stop_frames[bus].extend(device.stop_frames());
                    fieldbus.off_frames[bus].extend(device.stop_frames());
                }
            }
        }
        for bus in (0..rig.buses.len()).filter(|bus| fieldbus.canopen[*bus]) {
            // A drive that acts with SYNC would wait for one that a dead loop never sends.
            fieldbus.stop_frames[bus].push(service::sync(None));
            fieldbus.off_frames[bus].push(service::sync(None));
        }
        Ok(fieldbus)
    }

    /// Where the start-up is.
    pub fn step(&self) -> Step {
        self.step
    }

    /// Why it was refused.
    pub fn refusal(&self) -> Option<&Refusal> {
        self.refusal.as_ref()
    }

    /// A refusal in words, with the name of its node.
    pub fn explain(&self, refusal: &Refusal) -> String {
        self.named(refusal.node, &refusal.why)
    }

    /// A trouble in words, with the name of its node.
    pub fn tell(&self, trouble: &Trouble) -> String {
        self.named(trouble.node, &trouble.kind)
    }

    fn named(&self, node: Option<usize>, what: &dyn fmt::Display) -> String {
        match node {
            None => what.to_string(),
            Some(node) => match &self.nodes[node] {
                Node::Drive(drive) => format!("{} (node {}): {what}", self.names[node], drive.node()),
                Node::Device(_) => format!("{}: {what}", self.names[node]),
            },
        }
    }

    /// The next trouble nobody has read, oldest first.
    pub fn trouble(&mut self) -> Option<Trouble> {
        let first = self.troubles[0].take();
        self.troubles.rotate_left(1);
        first
    }

    /// Troubles dropped because nobody read them.
    pub fn lost_troubles(&self) -> u64 {
        self.lost_troubles
    }

    /// The frames that stop all drives of a bus on their ramps, made beforehand.
    pub fn stop_frames(&self, bus: usize) -> &[Frame] {
        &self.stop_frames[bus]
    }

    /// The frames that take the torque off all drives of a bus, made beforehand.
    pub fn off_frames(&self, bus: usize) -> &[Frame] {
        &self.off_frames[bus]
    }

    /// A signal of the rig.
    ///
    /// # Panics
    /// If the rig has no such signal: a mistake of the caller.
    pub fn reading(&self, signal: Signal) -> Reading {
        let reading = match (&self.nodes[signal.node], signal.what) {
            (Node::Drive(drive), what) => drive.reading(what),
            (Node::Device(device), What::Field(message, field)) => device.reading(message, field),
            (Node::Device(_), _) => None,
        };
        reading.unwrap_or_else(|| panic!("`{}` has no signal {:?}", self.names[signal.node], signal.what))
    }

    /// Whether a node tells this signal.
    pub fn has(&self, signal: Signal) -> bool {
        match (&self.nodes[signal.node], signal.what) {
            (Node::Drive(drive), what) => drive.reading(what).is_some(),
            (Node::Device(device), What::Field(message, field)) => device.reading(message, field).is_some(),
            (Node::Device(_), _) => false,
        }
    }

    /// Gives a command for the next [`end`](Fieldbus::end), SI. It must have passed the supervisor.
    pub fn command(&mut self, signal: Signal, value: f64) {
        match (&mut self.nodes[signal.node], signal.what) {
            (Node::Drive(drive), _) => drive.command(value),
            (Node::Device(device), What::Field(message, field)) => device.command(message, field, value),
            (Node::Device(_), _) => {}
        }
    }

    /// What the start-up itself wants this command to be, SI: it takes the way of all commands. Once armed, 0 or the
    /// safe value.
    pub fn wanted(&self, signal: Signal) -> f64 {
        match (&self.nodes[signal.node], signal.what) {
            (Node::Drive(_), _) => self.wanted[signal.node],
            (Node::Device(device), What::Field(message, field)) => device.safe(message, field),
            (Node::Device(_), _) => 0.0,
        }
    }

    /// What is known of a drive; nothing for a device.
    pub fn status(&self, node: usize) -> Option<Status> {
        match &self.nodes[node] {
            Node::Drive(drive) => Some(drive.status()),
            Node::Device(_) => None,
        }
    }

    /// The limits of a drive, zero before it was identified; nothing for a device.
    pub fn limits(&self, node: usize) -> Option<Limits> {
        match &self.nodes[node] {
            Node::Drive(drive) => Some(drive.limits()),
            Node::Device(_) => None,
        }
    }

    fn push_trouble(&mut self, trouble: Trouble) {
        match self.troubles.iter_mut().find(|place| place.is_none()) {
            Some(place) => *place = Some(trouble),
            None => self.lost_troubles += 1,
        }
    }

    /// Takes a frame of a bus.
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
                Node::Drive(drive) => drive.receive(frame, stamp_ns, &mut tell, &mut |frame| send(bus, frame)),
                Node::Device(device) => {
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

    /// Whether only another master can have sent it: our own frames don't come back.
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

    /// A trouble at this step: it refuses the start, is expected, or is the supervisor's to judge.
    fn note(&mut self, node: Option<usize>, kind: TroubleKind, stamp_ns: u64) {
        let foreign = matches!(kind, TroubleKind::ForeignMaster(_));
        // What a drive says while it is being reset, enabled or tested is its answer, no trouble.
        let answer = matches!(kind, TroubleKind::Emergency(_) | TroubleKind::Fault | TroubleKind::Left(_));
        match self.step {
            Step::Listen => {
                if let TroubleKind::ForeignMaster(id) = kind {
                    self.refuse(None, Why::ForeignMaster(id));
                }
            }
            Step::Reset if !foreign => {}
            Step::TimeoutTest | Step::Reenable if answer || matches!(kind, TroubleKind::Nmt(_)) => {}
            Step::Identity | Step::Configure | Step::Start | Step::Sync | Step::Mode if answer => {}
            Step::AwaitEnable | Step::Enable if answer => {}
            Step::AwaitArm | Step::Armed | Step::Stopped => self.push_trouble(Trouble { node, kind, stamp_ns }),
            Step::Refused => {}
            _ => self.refuse(node, Why::Trouble(kind)),
        }
    }

    fn refuse(&mut self, node: Option<usize>, why: Why) {
        self.refusal = Some(Refusal { node, why });
        self.go(Step::Refused);
        self.aim(Goal::Off, false);
    }

    fn go(&mut self, step: Step) {
        (self.step, self.since_ns, self.silent_since_ns) = (step, None, None);
        self.done.fill(false);
        self.wanted.fill(0.0);
        (self.push, self.returns_ns, self.off_since_ns) = (None, 0, None);
    }

    fn aim(&mut self, goal: Goal, resets: bool) {
        for drive in self.nodes.iter_mut().filter_map(drive_of_mut) {
            drive.aim(goal, resets);
        }
    }

    /// What is asked for, if it can be had at this step.
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
                    if let Node::Device(device) = node {
                        device.rest();
                    }
                }
                self.go(Step::Stopped);
            }
            (Request::Enable | Request::Arm, _) => return false,
        }
        true
    }

    /// Whether all drives are without torque.
    pub fn at_rest(&self) -> bool {
        self.nodes.iter().filter_map(drive_of).all(|drive| !drive.state().powered())
    }

    /// A tick begins: SYNC goes out, and everything known is a tick older.
    pub fn begin(&mut self, send: Send) {
        for node in &mut self.nodes {
            match node {
                Node::Drive(drive) => drive.begin(),
                Node::Device(device) => device.begin(),
            }
        }
        if self.running {
            for bus in (0..self.canopen.len()).filter(|bus| self.canopen[*bus]) {
                send(bus, service::sync(None));
            }
        }
    }

    /// A tick ends: commands go out, then our life sign, then what the start-up has to say.
    pub fn end(&mut self, now_ns: u64, send: Send) {
        for at in 0..self.nodes.len() {
            let mut found = [None; 2];
            if let Node::Drive(drive) = &mut self.nodes[at] {
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
                Node::Drive(drive) if running => drive.send_command(&mut send),
                Node::Drive(_) => {}
                Node::Device(device) => device.send_commands(now_ns, &mut send),
            }
        }
        self.live(now_ns, send);
        self.start(now_ns, send);
    }

    /// Our heartbeat and guard requests, unless a test holds them back.
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
            if let Node::Drive(drive) = node {
                drive.guard(now_ns, &mut |frame| send(*bus, frame));
            }
        }
    }

    /// Does something with each drive that isn't done; true once all are.
    fn each(
        &mut self,
        send: Send,
        mut work: impl FnMut(&mut Drive, crate::canopen::Send) -> Result<bool, Why>,
    ) -> bool {
        for at in 0..self.nodes.len() {
            let Node::Drive(drive) = &mut self.nodes[at] else { continue };
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

    /// Refuses for the first drive that isn't done, if the step has lasted too long.
    fn within(&mut self, limit_ns: u64, lasted_ns: u64, why: impl Fn(&Drive) -> Why) {
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

    /// One move of the start-up.
    fn start(&mut self, now_ns: u64, send: Send) {
        let first = self.since_ns.is_none();
        let lasted_ns = now_ns - *self.since_ns.get_or_insert(now_ns);
        match self.step {
            Step::Listen if lasted_ns >= self.options.listen_ns => self.go(Step::Reset),
            Step::Listen => {}
            Step::Reset => {
                // Once more after a second: a drive may have been booting. Never in the cycle after the first, which may come
                // a little early: who has just booted would boot anew.
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
                self.within(BOOT_NS, lasted_ns, |_| Why::Silent);
            }
            Step::Identity => {
                if self.each(send, |drive, send| drive.identify(now_ns, send)) {
                    return self.go(Step::Configure);
                }
                self.within(IDENTITY_NS, lasted_ns, |_| Why::Silent);
            }
            Step::Configure => {
                if self.each(send, |drive, send| drive.configure(now_ns, send)) {
                    return self.go(Step::Start);
                }
                self.within(CONFIGURE_NS, lasted_ns, |_| Why::Silent);
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
                self.within(START_NS, lasted_ns, |drive| Why::NotOperational(drive.nmt()));
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
        // The first answers may miss: the drives have only just been started.
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
                Some(at) => self.refuse(Some(at), Why::Missed(self.missed[at], self.answers)),
                None => self.go(Step::Mode),
            }
        }
    }

    /// A drive that does not obey a stop may not hear us: nothing reaches it, or only its set-points do not. It is told by
    /// network management, and our life sign ends: its own time-out, which the start-up has tested, stops it.
    fn insist(&mut self, now_ns: u64, lasted_ns: u64, send: Send) {
        if lasted_ns < OBEYS_NS || !is_present(Protection::Silence) {
            return;
        }
        for at in 0..self.nodes.len() {
            let Node::Drive(drive) = &self.nodes[at] else { continue };
            if !drive.disobeys() {
                continue;
            }
            // In "pre-operational" it takes no set-point, so none that takes its torque off either: a quick stop that does not
            // end, since the shaft is fast or its sign is wrong, ends with a reset.
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
            // Time for what the drives say about the test to have come.
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

    /// Stops our life sign at zero command, and waits for each drive to leave "operation enabled".
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
                // It must not be led back by the next command.
                drive.aim(Goal::Off, false);
                return Ok(true);
            }
            let status = drive.status();
            let limit_ms = match drive.watching() {
                Some(Watching::Nothing) | None => 0,
                Some(_) => status.timeout.map_or(0, |(ms, _)| ms),
            };
            if waited > u64::from(limit_ms) * 1_500_000 + heartbeat + slack {
                return Err(Why::TimeoutIgnored(waited / 1_000_000));
            }
            Ok(false)
        });
        if all || self.step == Step::Refused {
            self.silent_since_ns = None;
        }
        if all {
            for at in 0..self.nodes.len() {
                let bus = self.places[at];
                if let Node::Drive(drive) = &self.nodes[at]
                    && drive.nmt() != NmtState::Operational
                {
                    send(bus, Nmt::Start.frame(drive.node()));
                }
            }
            self.go(Step::Reenable);
        }
    }

    /// One drive after the other.
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
            // A drive that holds the shaft brings it back from the test before.
            if lasted_ns < self.returns_ns {
                return;
            }
            let drive = drive_of(&self.nodes[at]).expect("found as one");
            if drive.reading(What::Position).is_none() {
                // Nothing to compare with: the direction of a drive without a position is the operator's to check.
                self.done[at] = true;
                return;
            }
            // A torque can't turn a shaft whose speed or position another drive holds: that one turns it.
            let holds =
                |at: &usize| drive_of(&self.nodes[*at]).is_some_and(|drive| drive.config().mode != Mode::Torque);
            let holder = (0..self.nodes.len()).find(holds).filter(|_| drive.config().mode == Mode::Torque && !by_hand);
            let (mut bounds, turned) = (bounds(drive), by_hand || holder.is_some());
            if turned {
                bounds.angle = BY_HAND.max(bounds.angle);
            }
            let patience = match holder.and_then(|holder| drive_of(&self.nodes[holder])) {
                // Three times as long as the turn takes at the commanded speed.
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
            Verdict::Wants(command) => {
                self.wanted[at] = command;
                if let Some(holder) = holder {
                    self.wanted[holder] = drive_of(&self.nodes[holder]).map_or(0.0, turning);
                }
            }
            Verdict::Right => {
                if let Some(holder) = holder {
                    self.wanted[holder] = 0.0;
                    self.returns_ns = lasted_ns + RETURN_NS;
                }
                (self.done[at], self.wanted[at], self.push) = (true, 0.0, None);
            }
            Verdict::Wrong(why) => self.refuse(Some(at), why),
        }
    }

    /// The motions of the start-up are over: angles count from here.
    fn moved(&mut self) {
        for drive in self.nodes.iter_mut().filter_map(drive_of_mut) {
            drive.rest();
        }
        self.go(Step::AwaitArm);
    }
}

/// What a drive says.
fn sample(drive: &Drive) -> Sample {
    let value = |what| drive.reading(what).map(|reading| reading.value);
    Sample { position: value(What::Position).unwrap_or(0.0), speed: value(What::Speed), torque: value(What::Torque) }
}

/// What the first motion of a drive may use.
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

fn drive_of(node: &Node) -> Option<&Drive> {
    match node {
        Node::Drive(drive) => Some(drive),
        Node::Device(_) => None,
    }
}

fn drive_of_mut(node: &mut Node) -> Option<&mut Drive> {
    match node {
        Node::Drive(drive) => Some(drive),
        Node::Device(_) => None,
    }
}
