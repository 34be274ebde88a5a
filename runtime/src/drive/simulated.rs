//! A simulated CiA 402 drive: a node with the real object dictionary and state machine, a torque loop, an encoder.
//!
//! In: frames, the time, the true angle and speed of its shaft. Out: frames, the torque on the shaft. A command passes
//! dead time → slope limit (mode 4) → saturation → first-order lag; readings pass the encoder, a filter and the drive's
//! units. Its time-outs work. [`Effect`]s make it fail.

use super::profiles::{self, Life, Path, Profile};
use super::state::{Machine, State, Times, status};
use super::units::Scale;
use crate::can::Frame;
use crate::canopen::node::{Happening, Loss, Node};
use crate::canopen::object::Entry;
use crate::canopen::{Access, Nmt, NmtState, Object, ObjectDictionary, Send, Type};
use crate::drive::fault_injection::Effect;
use abi::rig::Cia402;

/// Most commands under way to the motor.
const QUEUE: usize = 256;
/// Most delayed frames.
const HELD: usize = 64;

/// Behaviour of a simulated drive beyond the rig's text.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Behaviour {
    /// Time from power-on or reset to the boot-up message, ns.
    pub boot_ns: u64,
    /// Times of its state machine.
    pub times: Times,
    /// Time from a fault until the torque is off, ns.
    pub reaction_ns: u64,
    /// Time from SYNC to its answers, ns.
    pub answer_ns: u64,
    /// Torque ripple as a share of the rated torque.
    pub ripple: f64,
    /// Periods of the ripple per revolution.
    pub ripples: f64,
    /// Highest torque as a share of the rated torque.
    pub overload: f64,
    /// Highest speed, rad/s.
    pub speed: f64,
    /// Shortest heartbeat time that it can monitor, ms.
    pub least_consumer_ms: u16,
    /// Modes of operation it offers, as object 6502; none: those of its profile.
    pub modes: Option<u32>,
}

impl Default for Behaviour {
    fn default() -> Behaviour {
        Behaviour {
            boot_ns: 50_000_000,
            times: Times {
                switch_on_ns: 5_000_000,
                enable_ns: 20_000_000,
                disable_ns: 10_000_000,
                start_ns: 2_000_000,
            },
            reaction_ns: 5_000_000,
            answer_ns: 0,
            ripple: 0.0,
            ripples: 24.0,
            overload: 3.0,
            speed: 400.0,
            least_consumer_ms: 1,
            modes: None,
        }
    }
}

/// The faults that act at present.
#[derive(Clone, Copy, Debug, Default)]
struct Wrong {
    silent: bool,
    no_heartbeat: bool,
    no_answers: bool,
    late_ns: u64,
    mode_shown: Option<i8>,
    frozen: bool,
    ignores: bool,
    torque_off: bool,
    fault: bool,
    torque: Option<f64>,
    torque_told: Option<f64>,
    speed_told: Option<f64>,
    position_told: Option<f64>,
}

/// Objects that a step needs, in SI.
#[derive(Clone, Copy, Debug, Default)]
struct Parameters {
    /// Torque limits.
    low: f64,
    high: f64,
    /// Feed-forward torque in mode 10.
    offset: f64,
    /// Slope of the torque in mode 4, N·m/s.
    slope: f64,
    /// Ramp of a quick stop, rad/s².
    ramp: f64,
}

/// State of a simulated drive.
#[derive(Clone, Debug)]
pub struct SimulatedDrive {
    config: Cia402,
    profile: &'static Profile,
    behaviour: Behaviour,
    node: Node,
    machine: Machine,
    delay_ns: u64,
    lag: f64,
    torque_scale: Scale,
    /// Gains of the speed controller: N·m per rad/s, N·m per rad.
    gains: (f64, f64),
    /// The state in its status word.
    told: State,
    /// Its mode of operation.
    mode: i8,
    /// Targets with the time at which they act: (ns, number).
    queue: [(u64, i64); QUEUE],
    first: usize,
    waiting: usize,
    /// The target that acts.
    target: i64,
    /// Torque after the slope limit, and torque on the shaft, N·m.
    ramped: f64,
    torque: f64,
    limited: bool,
    /// Speed set-point after its ramp, rad/s; integral part of the speed controller, N·m.
    speed_wanted: f64,
    sum: f64,
    speed_filtered: f64,
    /// Number of the position at angle 0, with all lost counts.
    offset: i64,
    position_at_rest: f64,
    shaft: (f64, f64),
    parameters: Parameters,
    /// Length of a step, s, and the shares by which lag and filter approach their input in it.
    shares: (f64, f64, f64),
    refreshed_ns: u64,
    held: [(u64, Option<Frame>); HELD],
    /// Whether any frame is delayed.
    holding: bool,
    wrong: Wrong,
}

const CONTROL: Object = Object(0x6040, 0);
const STATUS: Object = Object(0x6041, 0);
const MODE: Object = Object(0x6060, 0);
const MODE_SHOWN: Object = Object(0x6061, 0);

/// 1 − e^(−x) for x ≥ 0, the same on every machine.
fn approach(x: f64) -> f64 {
    // e^(−x) = (e^(−x/1024))^1024; for x/1024 < 0.06 the series has an error of 1e-16, and beyond that the result is 1.
    if x > 60.0 {
        return 1.0;
    }
    let y = x / 1024.0;
    let mut power = 1.0 - y * (1.0 - y / 2.0 * (1.0 - y / 3.0 * (1.0 - y / 4.0 * (1.0 - y / 5.0))));
    for _ in 0..10 {
        power *= power;
    }
    1.0 - power
}

/// `x`, or its limit `end` once it is close, so that the difference does not decay through ever smaller numbers.
fn near(x: f64, end: f64) -> f64 {
    if (x - end).abs() < 1e-12 { end } else { x }
}

/// A triangle wave between −1 and 1 with period 1.
fn triangle(x: f64) -> f64 {
    4.0 * (x - (x + 0.5).floor()).abs() - 1.0
}

impl SimulatedDrive {
    /// A drive that boots at time 0. `inertia`: of its shaft, kg·m², for its speed controller; `offset`: number of its
    /// position at angle 0.
    pub fn new(
        config: &Cia402,
        profile: &'static Profile,
        behaviour: Behaviour,
        (delay, lag): (f64, f64),
        inertia: f64,
        offset: i32,
    ) -> SimulatedDrive {
        let full = profile.full_torque as f64;
        let bandwidth = 300.0 / (1.0 + 300.0 * lag);
        let mut drive = SimulatedDrive {
            config: config.clone(),
            profile,
            behaviour,
            node: Node::new(config.node, ObjectDictionary::new(), behaviour.boot_ns, behaviour.least_consumer_ms),
            machine: Machine::new(behaviour.times, 0),
            delay_ns: (delay * 1e9) as u64,
            lag,
            torque_scale: Scale::signed(config.rated_torque / full, 16),
            gains: (inertia * bandwidth, inertia * bandwidth * bandwidth / 8.0),
            told: State::NotReady,
            mode: 0,
            queue: [(0, 0); QUEUE],
            first: 0,
            waiting: 0,
            target: 0,
            ramped: 0.0,
            torque: 0.0,
            limited: false,
            speed_wanted: 0.0,
            sum: 0.0,
            speed_filtered: 0.0,
            offset: offset.into(),
            position_at_rest: 0.0,
            shaft: (0.0, 0.0),
            parameters: Parameters::default(),
            shares: (0.0, 1.0, 1.0),
            refreshed_ns: 0,
            held: [(0, None); HELD],
            holding: false,
            wrong: Wrong::default(),
        };
        let objects = drive.dictionary();
        drive.node = Node::new(config.node, objects, behaviour.boot_ns, behaviour.least_consumer_ms);
        drive.take_parameters();
        drive
    }

    fn dictionary(&self) -> ObjectDictionary {
        use Access::{Constant, ReadOnly, ReadWrite};
        use Type::{I8, I16, I32, U8, U16, U32};
        let (config, behaviour, profile) = (&self.config, &self.behaviour, self.profile);
        let full = profile.full_torque as f64;
        let rpm = 30.0 / std::f64::consts::PI;
        let most = (behaviour.overload * full).min(65535.0) as i64;
        let mut objects = ObjectDictionary::new();
        let mut add = |index, name: &str, kind, access, value: i64| {
            objects.add(Entry::number(Object(index, 0), name, kind, access, value).mapped());
        };
        add(0x6007, "abort connection option", I16, ReadWrite, 1);
        add(0x603F, "error code", U16, ReadOnly, 0);
        add(0x6040, "control word", U16, ReadWrite, 0);
        add(0x6041, "status word", U16, ReadOnly, 0);
        add(0x605A, "quick stop option", I16, ReadWrite, 2);
        add(0x605E, "fault reaction option", I16, ReadWrite, 2);
        add(0x6060, "mode of operation", I8, ReadWrite, 0);
        add(0x6061, "mode of operation display", I8, ReadOnly, 0);
        add(0x6072, "max torque", U16, ReadWrite, most);
        add(0x6074, "torque demand", I16, ReadOnly, 0);
        add(0x6075, "motor rated current", U32, ReadWrite, 5000);
        add(0x6076, "motor rated torque", U32, ReadWrite, (config.rated_torque * 1e3).round() as i64);
        add(0x6080, "max motor speed", U32, ReadWrite, (behaviour.speed * rpm).round() as i64);
        // 1000 rad/s²: with rated torque on the inertia of the shaft that stops it fast enough for any test.
        add(0x6085, "quick stop deceleration", U32, ReadWrite, (1000.0 / config.speed_unit).min(4e9) as i64);
        add(0x6087, "torque slope", U32, ReadWrite, 1000 * profile.full_torque);
        add(0x60B2, "torque offset", I16, ReadWrite, 0);
        add(0x60E0, "positive torque limit", U16, ReadWrite, most);
        add(0x60E1, "negative torque limit", U16, ReadWrite, most);
        add(0x6502, "supported drive modes", U32, Constant, self.modes().into());
        for (path, target, actual) in [
            (profile.torque, "target torque", "torque actual value"),
            (profile.speed, "target velocity", "velocity actual value"),
            (profile.position, "target position", "position actual value"),
        ] {
            let kind = |bits| if bits == 32 { I32 } else { I16 };
            if let Some(path) = path {
                let number = if path.actual.0 == Object(0x6064, 0) { self.offset as i32 } else { 0 };
                add(path.target.0.0, target, kind(path.target.1), ReadWrite, number.into());
                add(path.actual.0.0, actual, kind(path.actual.1), ReadOnly, number.into());
            }
        }
        let device = i64::from(profile.sort) << 16 | i64::from(profile.device);
        objects.add(Entry::number(Object(0x1000, 0), "device type", U32, Constant, device));
        let (_, name, serial) = profiles::SIMULATED;
        objects.add(Entry::text(Object(0x1008, 0), "device name", Constant, name, name.len()));
        objects.add(Entry::number(Object(0x1018, 4), "serial number", U32, Constant, serial.into()));
        objects.add(Entry::number(Object(0x60C2, 0), "interpolation time", U8, Constant, 2));
        objects.add(Entry::number(Object(0x60C2, 1), "value", U8, ReadWrite, 1));
        objects.add(Entry::number(Object(0x60C2, 2), "exponent", I8, ReadWrite, -3));
        if let Some((receive, transmit)) = profile.fixed {
            let node = i64::from(config.node);
            let path = profile.torque.or(profile.speed).expect("a drive follows something");
            for (base, id, number, pdo_status, value) in
                [(0x1400, 0x200, receive, CONTROL, path.target), (0x1800, 0x180, transmit, STATUS, path.actual)]
            {
                let (i, map) = (u16::from(number - 1), |object: Object, bits: u8| {
                    i64::from(object.0) << 16 | i64::from(object.1) << 8 | i64::from(bits)
                });
                let id = id + 0x100 * i64::from(i) + node;
                objects.add(Entry::number(Object(base + i, 1), "COB-ID", U32, Constant, id));
                objects.add(Entry::number(Object(base + 0x200 + i, 0), "count", U8, Constant, 2));
                objects.add(Entry::number(Object(base + 0x200 + i, 1), "mapped", U32, Constant, map(pdo_status, 16)));
                objects.add(Entry::number(Object(base + 0x200 + i, 2), "mapped", U32, Constant, map(value.0, value.1)));
            }
        }
        objects
    }

    /// Modes of operation it offers, one bit each.
    fn modes(&self) -> u32 {
        let own = [self.profile.torque, self.profile.speed, self.profile.position];
        let own = own.iter().flatten().flat_map(|path| path.modes).fold(0, |modes, (_, bit)| modes | 1 << bit);
        self.behaviour.modes.unwrap_or(own)
    }

    /// Its CANopen node.
    pub fn node(&self) -> &Node {
        &self.node
    }

    /// Its objects, for tests that change them.
    pub fn objects(&mut self) -> &mut ObjectDictionary {
        &mut self.node.objects
    }

    /// Removes its deadlines for set-points (objects 1400:5 and following), which not every drive has. Must be called
    /// before it is configured.
    pub fn without_deadlines(&mut self) {
        self.node.without_deadlines();
    }

    /// Its state.
    pub fn state(&self) -> State {
        self.machine.state()
    }

    /// Torque on the shaft, N·m.
    pub fn torque(&self) -> f64 {
        self.torque
    }

    /// Speed set-point, rad/s, for a plant whose input is the speed.
    pub fn speed(&self) -> f64 {
        self.speed_wanted
    }

    /// Time at which [`poll`](SimulatedDrive::poll) is next due.
    pub fn due_ns(&self) -> u64 {
        let due = self.node.due_ns().min(self.machine.due_ns());
        if !self.holding {
            return due;
        }
        let held = self.held.iter().filter(|(_, frame)| frame.is_some()).map(|(due, _)| *due).min();
        due.min(held.unwrap_or(u64::MAX))
    }

    /// Applies a fault, or ends it.
    pub fn afflict(&mut self, effect: Effect, on: bool, now_ns: u64, send: Send) {
        let factor = |factor: f64| on.then_some(factor);
        match effect {
            Effect::Emergency(code) => {
                let code = if on { code } else { 0 };
                self.with_node(now_ns, send, |node, send| node.emergency(code, u8::from(on), send));
            }
            Effect::Fault(code) => {
                self.wrong.fault = on;
                if on {
                    self.machine.fault(self.behaviour.reaction_ns, now_ns);
                    self.with_node(now_ns, send, |node, send| node.emergency(code, 1, send));
                }
            }
            Effect::PreOperational => {
                let state = if on { NmtState::PreOperational } else { NmtState::Operational };
                // A node that was reset meanwhile is booting.
                if on || self.node.state() == NmtState::PreOperational {
                    self.node.go(state);
                }
                if on {
                    self.abort_connection(now_ns);
                }
            }
            Effect::Reset if on => {
                self.node.reset(Nmt::ResetNode, now_ns);
                self.restart(now_ns);
            }
            Effect::Reset => {}
            Effect::NoHeartbeat => self.wrong.no_heartbeat = on,
            Effect::ModeShown(mode) => self.wrong.mode_shown = on.then_some(mode),
            Effect::EncoderFrozen => self.wrong.frozen = on,
            Effect::EncoderGlitch(counts) => self.offset += if on { counts } else { -counts },
            Effect::EncoderLost(counts) if on => self.offset -= counts,
            Effect::EncoderLost(_) => {}
            Effect::EncoderScale(by) => self.wrong.position_told = factor(by),
            Effect::SpeedScale(by) => self.wrong.speed_told = factor(by),
            Effect::TorqueToldScale(by) => self.wrong.torque_told = factor(by),
            Effect::TorqueScale(by) => self.wrong.torque = factor(by),
            Effect::AnswersLate(late_ns) => self.wrong.late_ns = if on { late_ns } else { 0 },
            Effect::NoAnswers => self.wrong.no_answers = on,
            Effect::IgnoresCommands => self.wrong.ignores = on,
            Effect::SafeTorqueOff => {
                self.wrong.torque_off = on;
                if on {
                    self.machine.fault(0, now_ns);
                    self.with_node(now_ns, send, |node, send| node.emergency(0x5441, 1, send));
                }
            }
            Effect::Silent => self.wrong.silent = on,
            Effect::Value(..) => {}
        }
    }

    /// Calls the node, and applies the drive's faults to the frames that it sends.
    fn with_node<T>(&mut self, now_ns: u64, send: Send, work: impl FnOnce(&mut Node, Send) -> T) -> T {
        let (wrong, held, answer_ns) = (self.wrong, &mut self.held, self.behaviour.answer_ns);
        let holding = &mut self.holding;
        work(&mut self.node, &mut |frame| {
            let heartbeat = frame.id() & 0x780 == 0x700;
            let answer = (0x180..0x580).contains(&frame.id());
            if wrong.silent || heartbeat && wrong.no_heartbeat || answer && wrong.no_answers {
                return;
            }
            let late_ns = if answer { wrong.late_ns + answer_ns } else { 0 };
            if late_ns == 0 {
                return send(frame);
            }
            if let Some(place) = held.iter_mut().find(|(_, frame)| frame.is_none()) {
                (*place, *holding) = ((now_ns + late_ns, Some(frame)), true);
            }
        })
    }

    fn restart(&mut self, now_ns: u64) {
        self.machine = Machine::new(self.behaviour.times, now_ns);
        (self.mode, self.waiting, self.target, self.ramped, self.sum) = (0, 0, 0, 0.0, 0.0);
    }

    /// Reaction of object 6007 to a lost connection while the drive is in use.
    fn abort_connection(&mut self, now_ns: u64) {
        if !matches!(self.machine.state(), State::Ready | State::SwitchedOn | State::Enabled) {
            return;
        }
        match self.node.objects.get(Object(0x6007, 0)) {
            Some(1) => self.machine.fault(self.behaviour.reaction_ns, now_ns),
            Some(2) => self.machine.disable(),
            Some(3) => self.machine.quick_stop(),
            _ => {}
        }
    }

    /// Receives a frame of its bus.
    pub fn receive(&mut self, frame: &Frame, now_ns: u64, send: Send) {
        if self.wrong.silent {
            return;
        }
        if frame.id() == 0x600 + u32::from(self.config.node) {
            // An SDO request must read the present values, not those of the last answer.
            self.tell(now_ns);
        }
        let happening = self.with_node(now_ns, send, |node, send| node.receive(frame, now_ns, send));
        if let Some(happening) = happening {
            self.happened(happening, now_ns, send);
        }
    }

    /// Executes everything that is due.
    pub fn poll(&mut self, now_ns: u64, send: Send) {
        if self.holding {
            for (due_ns, frame) in &mut self.held {
                if *due_ns <= now_ns
                    && let Some(frame) = frame.take()
                {
                    send(frame);
                }
            }
            self.holding = self.held.iter().any(|(_, frame)| frame.is_some());
        }
        if self.machine.advance(now_ns) || self.machine.state() != self.told {
            self.tell(now_ns);
        }
        while let Some(happening) = self.with_node(now_ns, send, |node, send| node.poll(now_ns, send)) {
            self.happened(happening, now_ns, send);
        }
    }

    fn happened(&mut self, happening: Happening, now_ns: u64, send: Send) {
        match happening {
            Happening::Sync => {
                // SYNC has just transferred the commands of synchronous PDOs into the dictionary.
                self.take_commands(now_ns, send);
                self.tell(now_ns);
                self.with_node(now_ns, send, |node, send| node.answer_sync(send));
            }
            Happening::Rpdo(_) => {
                self.take_parameters();
                self.take_commands(now_ns, send);
                self.tell(now_ns);
            }
            Happening::Written(object) => {
                self.take_mode();
                self.take_parameters();
                if object == CONTROL || self.target_object().is_some_and(|target| target == object) {
                    self.take_commands(now_ns, send);
                }
                self.machine.quick_stop_option = self.node.objects.get(Object(0x605A, 0)).unwrap_or(2) as i16;
                self.tell(now_ns);
            }
            Happening::State(NmtState::Operational) => {}
            Happening::State(_) => self.abort_connection(now_ns),
            Happening::Reset(Nmt::ResetNode) => self.restart(now_ns),
            Happening::Reset(_) => self.abort_connection(now_ns),
            Happening::Lost(loss) => {
                let code = match loss {
                    Loss::Heartbeat(_) | Loss::Guarding => 0x8130,
                    Loss::Rpdo(_) => 0x8250,
                };
                self.with_node(now_ns, send, |node, send| node.emergency(code, 0x11, send));
                self.abort_connection(now_ns);
                let operational = self.node.state() == NmtState::Operational;
                match self.node.objects.get(Object(0x1029, 1)) {
                    Some(0) if operational => self.node.go(NmtState::PreOperational),
                    Some(2) => self.node.go(NmtState::Stopped),
                    _ => {}
                }
            }
        }
    }

    fn path(&self) -> Option<Path> {
        let mode = self.mode;
        let paths = [self.profile.torque, self.profile.speed, self.profile.position];
        paths.into_iter().flatten().find(|path| path.modes.iter().any(|(own, _)| *own == mode))
    }

    fn target_object(&self) -> Option<Object> {
        self.path().map(|path| path.target.0)
    }

    /// Reads the parameters of a step from the dictionary.
    fn take_parameters(&mut self) {
        let number = |index| self.node.objects.get(Object(index, 0)).unwrap_or(0);
        let torque = |number| self.torque_scale.value(number);
        let most = number(0x6072);
        self.parameters = Parameters {
            low: -torque(most.min(number(0x60E1))),
            high: torque(most.min(number(0x60E0))),
            offset: torque(number(0x60B2)),
            slope: torque(number(0x6087)),
            ramp: number(0x6085) as f64 * self.config.speed_unit,
        };
    }

    /// Reads the mode of operation from the dictionary, if the drive offers it.
    fn take_mode(&mut self) {
        let wanted = self.node.objects.get(MODE).unwrap_or(0);
        let paths = [self.profile.torque, self.profile.speed, self.profile.position];
        let modes = paths.iter().flatten().flat_map(|path| path.modes);
        let bit = modes.filter(|(mode, _)| i64::from(*mode) == wanted).map(|(_, bit)| bit).next();
        if bit.is_some_and(|bit| self.modes() >> bit & 1 == 1) && wanted != i64::from(self.mode) {
            self.mode = wanted as i8;
            (self.waiting, self.target, self.sum) = (0, 0, 0.0);
        }
    }

    /// Reads control word and target from the dictionary.
    fn take_commands(&mut self, now_ns: u64, send: Send) {
        let word = self.node.objects.get(CONTROL).unwrap_or(0) as u16;
        let before = self.machine.state();
        let cleared = !self.wrong.fault && !self.wrong.torque_off;
        let reset = self.machine.command(word, cleared, now_ns);
        let told = self.node.objects.get(Object(0x1001, 0)) != Some(0);
        // An error whose cause has gone is withdrawn with the fault, or when the drive leaves "switch on disabled".
        if reset || before == State::SwitchOnDisabled && self.machine.state() == State::Ready && told {
            self.with_node(now_ns, send, |node, send| node.emergency(0, 0, send));
        }
        if before != State::Enabled && self.machine.state() == State::Enabled {
            self.enabled();
        }
        if let Some(target) = self.target_object().and_then(|object| self.node.objects.get(object))
            && !self.wrong.ignores
        {
            if self.waiting == QUEUE {
                (self.first, self.waiting) = ((self.first + 1) % QUEUE, QUEUE - 1);
            }
            self.queue[(self.first + self.waiting) % QUEUE] = (now_ns + self.delay_ns, target);
            self.waiting += 1;
        }
    }

    fn enabled(&mut self) {
        (self.sum, self.ramped, self.speed_wanted) = (0.0, 0.0, self.shaft.1);
        self.position_at_rest = self.shaft.0;
    }

    /// Writes the readings into the dictionary.
    fn tell(&mut self, now_ns: u64) {
        let refresh = self.profile.refresh_ns;
        let objects = &mut self.node.objects;
        let state = self.machine.state();
        self.told = state;
        let mut word = state.bits() | status::VOLTAGE | status::REMOTE;
        if objects.get(Object(0x1001, 0)).unwrap_or(0) != 0 {
            word |= status::WARNING;
        }
        if self.limited {
            word |= status::LIMIT;
        }
        if state == State::Enabled && self.mode >= 8 && !self.wrong.ignores {
            word |= status::FOLLOWS;
        }
        objects.set(STATUS, word.into());
        objects.set(MODE_SHOWN, self.wrong.mode_shown.unwrap_or(self.mode).into());
        if refresh > 0 && now_ns / refresh == self.refreshed_ns / refresh && self.refreshed_ns > 0 {
            return;
        }
        self.refreshed_ns = now_ns.max(1);
        if let Some(path) = self.profile.torque {
            let told = self.torque * self.wrong.torque_told.unwrap_or(1.0);
            objects.set(path.actual.0, self.torque_scale.number(told));
            objects.set(Object(0x6074, 0), self.torque_scale.number(self.ramped));
        }
        if let Some(path) = self.profile.speed {
            let told = self.speed_filtered * self.wrong.speed_told.unwrap_or(1.0);
            let speed = Scale::signed(self.config.speed_unit, path.actual.1.into());
            objects.set(path.actual.0, speed.number(told));
        }
        if let Some(path) = self.profile.position
            && !self.wrong.frozen
        {
            let counts = (self.shaft.0 * self.wrong.position_told.unwrap_or(1.0) / self.config.count).floor();
            // Saturates for a drive of absurd resolution.
            objects.set(path.actual.0, (counts as i64).saturating_add(self.offset));
        }
    }

    /// One step of `h` seconds from `t_ns` on, with the shaft at this angle (rad) and speed (rad/s). Afterwards
    /// [`torque`](SimulatedDrive::torque) is the torque on the shaft.
    pub fn step(&mut self, t_ns: u64, h: f64, shaft: (f64, f64)) {
        let before = self.machine.state();
        self.machine.advance(t_ns);
        self.shaft = shaft;
        if before != State::Enabled && self.machine.state() == State::Enabled {
            self.enabled();
        }
        if h != self.shares.0 {
            let lag = if self.lag > 0.0 { approach(h / self.lag) } else { 1.0 };
            self.shares = (h, lag, approach(h / self.profile.speed_lag));
        }
        let (_, lag, filter) = self.shares;
        self.speed_filtered = near(self.speed_filtered + (shaft.1 - self.speed_filtered) * filter, shaft.1);
        let refresh = self.profile.refresh_ns;
        if refresh == 0 || t_ns % refresh < (h * 1e9) as u64 {
            while self.waiting > 0 && self.queue[self.first].0 <= t_ns {
                self.target = self.queue[self.first].1;
                (self.first, self.waiting) = ((self.first + 1) % QUEUE, self.waiting - 1);
            }
        }
        let wanted = match self.machine.state() {
            State::Enabled => self.follow(h),
            State::QuickStop | State::FaultReaction => self.brake(h),
            State::NotReady | State::SwitchOnDisabled | State::Ready | State::SwitchedOn | State::Fault => {
                (self.ramped, self.sum, self.speed_wanted) = (0.0, 0.0, shaft.1);
                0.0
            }
        };
        let permitted = wanted.clamp(self.parameters.low, self.parameters.high);
        self.limited = permitted != wanted;
        self.torque = near(self.torque + (permitted - self.torque) * lag, permitted);
        if self.wrong.torque_off {
            self.torque = 0.0;
        }
    }

    /// Torque on the shaft with ripple and faults, N·m.
    pub fn applied(&self) -> f64 {
        let ripple = match self.machine.state().powered() && self.behaviour.ripple > 0.0 {
            true => {
                let turns = self.shaft.0 / std::f64::consts::TAU;
                self.behaviour.ripple * self.config.rated_torque * triangle(turns * self.behaviour.ripples)
            }
            false => 0.0,
        };
        self.torque * self.wrong.torque.unwrap_or(1.0) + ripple
    }

    /// The torque that the mode of operation requests, N·m.
    fn follow(&mut self, h: f64) -> f64 {
        match self.mode {
            4 => {
                let most = self.parameters.slope * h;
                self.ramped += (self.torque_scale.value(self.target) - self.ramped).clamp(-most, most);
            }
            10 => self.ramped = self.torque_scale.value(self.target) + self.parameters.offset,
            8 => {
                let here = ((self.shaft.0 / self.config.count).floor() as i64).saturating_add(self.offset);
                let error = (self.target as i32).wrapping_sub(here as i32);
                let speed = f64::from(error) * self.config.count * 60.0;
                self.speed_wanted = speed.clamp(-self.behaviour.speed, self.behaviour.speed);
                self.ramped = self.speed_loop(h);
            }
            2 | 3 | 9 => {
                let wanted = self.target as f64 * self.config.speed_unit;
                self.speed_wanted = wanted.clamp(-self.behaviour.speed, self.behaviour.speed);
                self.ramped = self.speed_loop(h);
            }
            _ => self.ramped = 0.0,
        }
        self.ramped
    }

    fn speed_loop(&mut self, h: f64) -> f64 {
        let error = self.speed_wanted - self.shaft.1;
        // Anti-windup: no integration while the torque is limited.
        if !self.limited {
            self.sum += self.gains.1 * error * h;
        }
        self.gains.0 * error + self.sum
    }

    /// The torque that brakes on the ramp of object 6085; at standstill the quick stop ends.
    fn brake(&mut self, h: f64) -> f64 {
        if self.machine.state() == State::QuickStop && self.mode != 0 {
            let less = self.parameters.ramp * h;
            self.speed_wanted = self.speed_wanted.signum() * (self.speed_wanted.abs() - less).max(0.0);
        } else {
            self.speed_wanted = 0.0;
        }
        if self.speed_wanted == 0.0 && self.shaft.1.abs() < 0.05 {
            self.machine.stopped();
        }
        self.ramped = self.speed_loop(h);
        self.ramped
    }

    /// Whether its profile has this mechanism to detect that we are gone.
    pub fn lives_by(&self, life: Life) -> bool {
        self.profile.life.contains(&life)
    }
}
