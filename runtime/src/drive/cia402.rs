//! The axis: one CiA 402 drive from the master's point of view.
//!
//! In: its frames, SYNCs, permitted commands. Out: its signals, the frames that configure and command it, reports of
//! unexpected behaviour. The sequence of the start-up, which concerns all drives of a rig, is in [`super::fieldbus`].

use super::profiles::{self, Life, Path, Profile};
use super::state::{Goal, State, control, status, towards};
use super::units::{Counter, Scale};
use crate::can::Frame;
use crate::canopen::pdo::{Direction, Mapped, Pdo};
use crate::canopen::sdo::Client;
use crate::canopen::service::{self, Service};
use crate::canopen::{NmtState, Object, Send, Type};
use crate::drive::faults::{Reading, RefusalReason, TroubleKind};
use crate::drive::sdo_sequence::{Keep, Progress, Question, Script, SequenceEntry, Watching};
use crate::safety::{Protection, is_present};
use abi::rig::{Cia402, Mode, SignalKind};

const STATUS: Object = Object(0x6041, 0);
const CONTROL: Object = Object(0x6040, 0);
const MODE: Object = Object(0x6060, 0);
const MODE_SHOWN: Object = Object(0x6061, 0);
const ERROR: Object = Object(0x603F, 0);

/// Longest time between two guard requests, ms.
const GUARD_MS_MAX: u32 = 200;

/// Period of a drive's heartbeat.
pub const HEARTBEAT_MS: u64 = 20;
/// Shortest time after which a heartbeat counts as missing: two and a half periods. A longer `watchdog` of the rig
/// takes precedence.
const HEARTBEAT_LATE_NS: u64 = 50_000_000;
/// Longest wait for an answer to an SDO request.
const SDO_NS: u64 = 500_000_000;
/// Ticks without the bit "drive follows the command" after which the drive is reported as not following.
const NOT_FOLLOWING: u32 = 5;

/// Settings of the rig for a drive, beyond the drive's own arguments.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Setting {
    /// Our node id.
    pub master: u8,
    /// Period of SYNC.
    pub period_ns: u64,
    /// Time after which the drive must detect that we are gone.
    pub watchdog_ns: u64,
    /// Slew limit of its command, SI per second.
    pub slew: f64,
    /// Safe value of its command, SI.
    pub safe: f64,
    /// Highest command in either direction, SI; infinite if the rig names none.
    pub most: f64,
}

/// Limits of a drive: those of the rig, or the drive's own where the rig names none. SI.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Limits {
    /// N·m.
    pub torque: f64,
    /// rad/s.
    pub speed: f64,
    /// W.
    pub power: f64,
}

/// Status of a drive.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Status {
    /// State according to its status word.
    pub state: State,
    /// The status word.
    pub word: u16,
    /// NMT state according to its heartbeat.
    pub nmt: NmtState,
    /// The mode of operation it was given.
    pub mode: i8,
    /// The mode of operation it displays (object 6061).
    pub mode_shown: Option<i8>,
    /// Whether it follows commands.
    pub following: bool,
    /// Last error code it reported; 0 for none.
    pub error_code: u16,
    /// Vendor, product, revision, serial number.
    pub identity: [Option<u32>; 4],
    /// Time after which it detects that we are gone, ms, and the mechanism.
    pub timeout: Option<(u32, Life)>,
    /// Time measured by the time-out test, ns.
    pub timeout_measured_ns: Option<u64>,
    /// Time after which it detects missing set-points, ms; none if it has no object 1400:5.
    pub deadline_ms: Option<u32>,
    /// Whether it has proved to be one of our own simulated drives.
    pub simulated: bool,
    /// Number of answers to an earlier SYNC, and of doubled answers.
    pub surplus: u64,
}

/// One PDO of the drive, with its time and age.
#[derive(Clone, Debug)]
struct Answer {
    pdo: Pdo,
    stamp_ns: u64,
    age: u32,
}

/// Position of one signal in an answer.
#[derive(Clone, Copy, Debug)]
struct SignalPosition {
    answer: usize,
    byte: usize,
    kind: Type,
}

impl SignalPosition {
    fn number(&self, data: &[u8]) -> i64 {
        self.kind.number(&data[self.byte..self.byte + self.kind.size().unwrap_or(0)])
    }
}

/// State of a drive.
#[derive(Clone, Debug)]
pub struct Drive {
    config: Cia402,
    profile: &'static Profile,
    setting: Setting,
    client: Client,
    identity: Script,
    configuration: Script,
    mode_script: Script,
    limits: Limits,
    mode: i8,
    watching: Option<Watching>,
    nmt: NmtState,
    heard_ns: Option<u64>,
    booted: bool,
    command_pdo: Pdo,
    answers: Vec<Answer>,
    status_at: SignalPosition,
    torque_at: Option<SignalPosition>,
    speed_at: Option<SignalPosition>,
    position_at: Option<SignalPosition>,
    torque: Scale,
    speed: Scale,
    target: Scale,
    word: Option<u16>,
    torque_now: i64,
    speed_now: i64,
    counter: Counter,
    mode_shown: Option<i8>,
    error_code: u16,
    /// Target of the state machine.
    goal: Goal,
    /// While set, the fault reset bit alternates, because an operator has requested it.
    resets: bool,
    ticks: u32,
    command: f64,
    not_following: u32,
    /// The last position command does not fit into its 32 bits.
    wraps: bool,
    guard_due_ns: u64,
    surplus: u64,
    /// Measured time from the end of our heartbeat to the drive's reaction, for the time-out test.
    pub(super) timeout_measured_ns: Option<u64>,
}

fn signed(bits: u8) -> Type {
    if bits == 32 { Type::I32 } else { Type::I16 }
}

fn mapped((object, bits): (Object, u8)) -> Mapped {
    Mapped { object, bits }
}

impl Drive {
    /// The axis of a drive of a rig.
    pub fn new(config: &Cia402, profile: &'static Profile, setting: Setting) -> Result<Drive, String> {
        let (path, what) = match config.mode {
            Mode::Torque => (profile.torque, "torque"),
            Mode::Speed => (profile.speed, "speed"),
            Mode::Position => (profile.position, "position"),
        };
        let path = path.ok_or_else(|| format!("profile `{}` takes no command for {what}", profile.name))?;
        let torque = Scale::signed(config.rated_torque / profile.full_torque as f64, 16);
        let speed_bits = profile.speed.map_or(32, |path| path.actual.1);
        let speed = Scale::signed(config.speed_unit, speed_bits.into());
        let target = match config.mode {
            Mode::Torque => torque,
            Mode::Speed => Scale::signed(config.speed_unit, path.target.1.into()),
            Mode::Position => Scale { step: config.count, low: i64::MIN, high: i64::MAX },
        };
        let word = |object| Mapped { object, bits: 16 };
        let kind = if config.at_sync { 1 } else { 255 };
        let (receive, transmit) = profile.fixed.unwrap_or((1, 1));
        let command_pdo =
            Pdo::new(Direction::Receive, receive, config.node, kind, &[word(CONTROL), mapped(path.target)]);
        let mut answers = Vec::new();
        let mut answer = |number, map: &[Mapped]| {
            let pdo = Pdo::new(Direction::Transmit, number, config.node, 1, map);
            answers.push(Answer { pdo, stamp_ns: 0, age: Reading::NEVER });
        };
        let actual = |path: Option<Path>| path.map(|path| mapped(path.actual));
        if profile.fixed.is_some() {
            answer(transmit, &[word(STATUS), mapped(path.actual)]);
        } else {
            let first: Vec<Mapped> =
                [Some(word(STATUS)), actual(profile.torque), actual(profile.speed)].into_iter().flatten().collect();
            answer(1, &first);
            if let Some(position) = actual(profile.position) {
                answer(2, &[position]);
            }
        }
        let place = |object: Object, kind: Type| {
            answers
                .iter()
                .enumerate()
                .find_map(|(answer, one)| one.pdo.place(object).map(|byte| SignalPosition { answer, byte, kind }))
        };
        let of = |path: Option<Path>| path.and_then(|path| place(path.actual.0, signed(path.actual.1)));
        let mut drive = Drive {
            config: config.clone(),
            profile,
            setting,
            client: Client::new(config.node, SDO_NS),
            identity: Script::new(Vec::new(), 0),
            configuration: Script::new(Vec::new(), 0),
            mode_script: Script::new(Vec::new(), 0),
            limits: Limits::default(),
            mode: path.modes[0].0,
            watching: None,
            nmt: NmtState::BootUp,
            heard_ns: None,
            booted: false,
            command_pdo,
            status_at: place(STATUS, Type::U16).expect("the first answer holds the status word"),
            torque_at: of(profile.torque),
            speed_at: of(profile.speed),
            position_at: of(profile.position),
            answers,
            torque,
            speed,
            target,
            word: None,
            torque_now: 0,
            speed_now: 0,
            counter: Counter::default(),
            mode_shown: None,
            error_code: 0,
            goal: Goal::Off,
            resets: false,
            ticks: 0,
            command: 0.0,
            not_following: 0,
            wraps: false,
            guard_due_ns: 0,
            surplus: 0,
            timeout_measured_ns: None,
        };
        drive.identity = Script::new(drive.identity_list(), 0);
        drive.configuration = Script::new(drive.configuration_list()?, drive.timeout_wanted_ms());
        Ok(drive)
    }

    fn timeout_wanted_ms(&self) -> u32 {
        let wanted = self.setting.watchdog_ns.div_ceil(1_000_000) as u32;
        let wanted = if is_present(Protection::Life) { wanted } else { 20 * wanted };
        wanted.clamp(self.profile.timeout_ms.0, self.profile.timeout_ms.1)
    }

    /// Deadline for set-points, ms: equal to that for our heartbeat.
    fn deadline_ms(&self) -> i64 {
        self.setting.watchdog_ns.div_ceil(1_000_000).clamp(1, 65_535) as i64
    }

    fn identity_list(&self) -> Vec<SequenceEntry> {
        let identity = |sub| Object(0x1018, sub);
        let mut list = vec![
            SequenceEntry::Read(Object(0x1000, 0), Type::U32, Keep::DeviceType),
            SequenceEntry::Read(identity(1), Type::U32, Keep::Vendor),
            SequenceEntry::ReadIf(identity(2), Type::U32, Keep::Product),
            SequenceEntry::ReadIf(identity(3), Type::U32, Keep::Revision),
            SequenceEntry::ReadIf(identity(4), Type::U32, Keep::Serial),
            SequenceEntry::TextIf(Object(0x1008, 0), profiles::SIMULATED.1, Keep::Name),
            SequenceEntry::ReadIf(Object(0x6502, 0), Type::U32, Keep::Modes),
        ];
        if self.profile.torque.is_some() {
            list.push(SequenceEntry::Read(Object(0x6076, 0), Type::U32, Keep::RatedTorque));
        }
        list.extend([
            SequenceEntry::ReadIf(Object(0x6072, 0), Type::U16, Keep::MaxTorque),
            SequenceEntry::ReadIf(Object(0x6080, 0), Type::U32, Keep::MaxSpeed),
            SequenceEntry::ReadIf(ERROR, Type::U16, Keep::Error),
            SequenceEntry::Judge(Question::Identity),
        ]);
        list
    }

    fn configuration_list(&self) -> Result<Vec<SequenceEntry>, String> {
        let mut list = Vec::new();
        let number = |object, value: u32, size| SequenceEntry::Write(object, value.into(), size);
        for pdo in self.answers.iter().map(|answer| &answer.pdo).chain([&self.command_pdo]) {
            if self.profile.fixed.is_some() {
                list.push(number(Object(pdo.communication(), 2), pdo.kind.into(), 1));
            } else {
                list.extend(pdo.configuration().into_iter().map(|(object, value, size)| number(object, value, size)));
            }
            let compare =
                |(object, value, bits): (Object, u32, u32)| SequenceEntry::Compare(object, value.into(), bits.into());
            list.extend(pdo.read_back().into_iter().map(compare));
        }
        // The drive detects missing set-points even while our heartbeat arrives.
        let (deadline, ms) = (Object(self.command_pdo.communication(), 5), self.deadline_ms());
        if is_present(Protection::Deadline) {
            list.push(SequenceEntry::WriteOr(deadline, ms, 2, 2));
            list.push(SequenceEntry::Compare(deadline, ms, 0xFFFF));
            list.push(SequenceEntry::Read(deadline, Type::U16, Keep::Deadline));
        }
        if self.profile.fixed.is_none() {
            // Mode display and error code, sent on change, for drives with a third PDO.
            let map = [Mapped { object: MODE_SHOWN, bits: 8 }, Mapped { object: ERROR, bits: 16 }];
            let writes = Pdo::new(Direction::Transmit, 3, self.config.node, 255, &map).configuration();
            let count = writes.len();
            for (i, (object, value, size)) in writes.into_iter().enumerate() {
                list.push(SequenceEntry::WriteOr(object, value.into(), size, count - 1 - i));
            }
        }
        // A drive that misses our heartbeat keeps its communication state, so that it can still be read. If the drive
        // offers no such choice, it falls back to pre-operational.
        list.push(SequenceEntry::WriteOr(Object(0x1029, 1), 1, 1, 0));
        if self.profile.life.contains(&Life::Heartbeat) {
            let consumer = Object(0x1016, 1);
            list.extend([
                number(Object(0x1017, 0), HEARTBEAT_MS as u32, 2),
                SequenceEntry::Compare(Object(0x1017, 0), HEARTBEAT_MS as i64, 0xFFFF),
                SequenceEntry::Watch(consumer, self.setting.master, 3),
                SequenceEntry::Watched(consumer, self.setting.master),
                SequenceEntry::Judge(Question::Timeout(Watching::Heartbeat)),
                SequenceEntry::Skip(7),
            ]);
        }
        let guard = i64::from(self.timeout_wanted_ms().div_ceil(3).max(1));
        list.extend([
            SequenceEntry::WriteOr(Object(0x100C, 0), guard, 2, 5),
            SequenceEntry::Write(Object(0x100D, 0), 3, 1),
            SequenceEntry::Compare(Object(0x100C, 0), guard, 0xFFFF),
            SequenceEntry::Compare(Object(0x100D, 0), 3, 0xFF),
            SequenceEntry::Judge(Question::Timeout(Watching::Guarding)),
            SequenceEntry::Skip(1),
            SequenceEntry::Judge(Question::Timeout(Watching::Nothing)),
            // Reaction to our loss: quick stop.
            number(Object(0x6007, 0), 3, 2),
            SequenceEntry::Compare(Object(0x6007, 0), 3, 0xFFFF),
            // After a quick stop the drive must be without torque: options 5 to 8 would permit a late command to enable
            // it again.
            SequenceEntry::WriteOr(Object(0x605A, 0), 2, 2, 0),
            SequenceEntry::Read(Object(0x605A, 0), Type::I16, Keep::QuickStop),
            SequenceEntry::Judge(Question::QuickStop),
            SequenceEntry::WriteOr(Object(0x1006, 0), (self.setting.period_ns / 1000) as i64, 4, 0),
        ]);
        if let Some(most) = self.config.max_torque {
            let most = self.torque.command(most);
            list.push(SequenceEntry::WriteOr(Object(0x6072, 0), most, 2, 1));
            list.push(SequenceEntry::Compare(Object(0x6072, 0), most, 0xFFFF));
        }
        Ok(list)
    }

    /// Entries that depend on the mode of operation, once it has been chosen.
    fn mode_list(&self) -> Result<Vec<SequenceEntry>, RefusalReason> {
        let mut list = Vec::with_capacity(8);
        if self.mode == 4 {
            // The drive's own rate limiter: set to the slew limit of the rig, or disabled.
            let slope = (self.setting.slew / self.torque.step).min(f64::from(u32::MAX)) as i64;
            list.push(SequenceEntry::Write(Object(0x6087, 0), slope, 4));
            list.push(SequenceEntry::Compare(Object(0x6087, 0), slope, 0xFFFF_FFFF));
        }
        if self.mode >= 8 {
            let (value, exponent) =
                interpolation(self.setting.period_ns).ok_or(RefusalReason::Period(self.setting.period_ns))?;
            list.push(SequenceEntry::WriteOr(Object(0x60C2, 1), value, 1, 3));
            list.push(SequenceEntry::Write(Object(0x60C2, 2), exponent, 1));
            list.push(SequenceEntry::Compare(Object(0x60C2, 1), value, 0xFF));
            list.push(SequenceEntry::Compare(Object(0x60C2, 2), exponent, 0xFF));
        }
        list.push(SequenceEntry::Write(MODE, self.mode.into(), 1));
        list.push(SequenceEntry::Read(MODE_SHOWN, Type::I8, Keep::ModeShown));
        Ok(list)
    }

    /// Its node id.
    pub fn node(&self) -> u8 {
        self.config.node
    }

    /// Its profile.
    pub fn profile(&self) -> &'static Profile {
        self.profile
    }

    /// Its limits, once it has been identified.
    pub fn limits(&self) -> Limits {
        self.limits
    }

    /// Discards all knowledge of the configuration, before a reset of communication.
    pub(super) fn forget(&mut self) {
        self.identity.rewind();
        self.configuration.rewind();
        self.mode_script = Script::new(Vec::new(), 0);
        self.identity.kept.fill(None);
        self.configuration.kept.fill(None);
        (self.booted, self.heard_ns, self.nmt, self.word) = (false, None, NmtState::BootUp, None);
        (self.goal, self.resets, self.mode_shown, self.error_code) = (Goal::Off, false, None, 0);
        (self.command, self.not_following, self.watching) = (0.0, 0, None);
        for answer in &mut self.answers {
            answer.age = Reading::NEVER;
        }
    }

    /// Whether it has booted since the last reset command.
    pub(super) fn has_booted(&self) -> bool {
        self.booted
    }

    /// Receives a frame of its bus. Unexpected behaviour is reported to `tell`.
    pub(super) fn receive(&mut self, frame: &Frame, stamp_ns: u64, tell: &mut dyn FnMut(TroubleKind), send: Send) {
        if frame.is_extended() {
            return;
        }
        if let Some(at) = self.answers.iter().position(|answer| answer.pdo.cob_id == frame.id()) {
            return self.take_answer(at, frame, stamp_ns, tell);
        }
        match Service::of(frame) {
            Service::SdoAnswer(node) if node == self.config.node => self.client.receive(frame, stamp_ns, send),
            Service::Heartbeat(node, Some(state), _) if node == self.config.node => {
                let before = std::mem::replace(&mut self.nmt, state);
                let known = self.heard_ns.replace(stamp_ns).is_some();
                match state {
                    NmtState::BootUp if self.booted => tell(TroubleKind::BootUp),
                    NmtState::BootUp => self.booted = true,
                    _ if known && before == NmtState::Operational && state != before => tell(TroubleKind::Nmt(state)),
                    _ => {}
                }
            }
            Service::Emergency(node, emergency) if node == self.config.node => {
                self.error_code = emergency.code;
                if emergency.code != 0 {
                    tell(TroubleKind::Emergency(emergency));
                }
            }
            Service::Tpdo(node, 3) if node == self.config.node && self.profile.fixed.is_none() => {
                if let [mode, low, high] = *frame.data() {
                    self.mode_shown = Some(mode as i8);
                    if [low, high] != [0, 0] {
                        self.error_code = u16::from_le_bytes([low, high]);
                    }
                }
            }
            _ => {}
        }
    }

    fn take_answer(&mut self, at: usize, frame: &Frame, stamp_ns: u64, tell: &mut dyn FnMut(TroubleKind)) {
        let data = frame.data();
        if data.len() < self.answers[at].pdo.length() {
            return tell(TroubleKind::Short(frame.id()));
        }
        let answer = &mut self.answers[at];
        if answer.age == 0 {
            self.surplus += 1;
        }
        (answer.age, answer.stamp_ns) = (0, stamp_ns);
        let within = |place: Option<SignalPosition>| place.filter(|place| place.answer == at);
        if let Some(place) = within(self.torque_at) {
            self.torque_now = place.number(data);
        }
        if let Some(place) = within(self.speed_at) {
            self.speed_now = place.number(data);
        }
        if let Some(place) = within(self.position_at) {
            self.counter.read(place.number(data) as i32);
        }
        if self.status_at.answer == at {
            let word = self.status_at.number(data) as u16;
            let before = self.word.replace(word).and_then(State::of);
            let state = self.state();
            if state == State::Fault && before.is_some_and(|before| before != State::Fault) {
                tell(TroubleKind::Fault);
            } else if before == Some(State::Enabled) && state != State::Enabled && self.goal == Goal::Enabled {
                tell(TroubleKind::Left(state));
            }
        }
    }

    /// State according to its status word; "not ready" before the first one and for invalid ones.
    pub fn state(&self) -> State {
        self.word.and_then(State::of).unwrap_or(State::NotReady)
    }

    fn mode_is_right(&self) -> bool {
        self.mode_shown == Some(self.mode)
    }

    /// Whether commands act: it is enabled, in the mode it was given, and in a cyclic mode with bit 12 set.
    pub fn following(&self) -> bool {
        let cyclic = self.mode >= 8;
        let follows = self.word.unwrap_or(0) & status::FOLLOWS != 0;
        self.state() == State::Enabled && self.mode_is_right() && (follows || !cyclic)
    }

    fn is_simulated(&self) -> bool {
        let (vendor, _, serial) = profiles::SIMULATED;
        let is = |keep, number: i64| self.identity.get(keep) == Some(number);
        is(Keep::Vendor, vendor.into()) && is(Keep::Serial, serial.into()) && is(Keep::Name, 1)
    }

    /// Its complete status.
    pub fn status(&self) -> Status {
        let identity = [Keep::Vendor, Keep::Product, Keep::Revision, Keep::Serial];
        let timeout = match self.watching {
            Some(Watching::Heartbeat) => Some((self.configuration.timeout_ms, Life::Heartbeat)),
            Some(Watching::Guarding) => Some((self.timeout_wanted_ms().div_ceil(3).max(1) * 3, Life::Guarding)),
            Some(Watching::Nothing) | None => None,
        };
        Status {
            state: self.state(),
            word: self.word.unwrap_or(0),
            nmt: self.nmt,
            mode: self.mode,
            mode_shown: self.mode_shown,
            following: self.following(),
            error_code: self.error_code,
            identity: identity.map(|keep| self.identity.get(keep).map(|number| number as u32)),
            timeout,
            timeout_measured_ns: self.timeout_measured_ns,
            deadline_ms: self.configuration.get(Keep::Deadline).map(|ms| ms as u32),
            simulated: self.is_simulated(),
            surplus: self.surplus,
        }
    }

    /// A signal of the drive; none if it has no such signal.
    pub fn reading(&self, what: SignalKind) -> Option<Reading> {
        let at = |place: Option<SignalPosition>, value: f64| {
            place.map(|place| {
                let answer = &self.answers[place.answer];
                Reading { value, stamp_ns: answer.stamp_ns, age: answer.age }
            })
        };
        let bit = |on: bool| at(Some(self.status_at), f64::from(u8::from(on)));
        match what {
            SignalKind::Torque => at(self.torque_at, self.torque.value(self.torque_now)),
            SignalKind::Speed => at(self.speed_at, self.speed.value(self.speed_now)),
            SignalKind::Position => at(self.position_at, self.counter.total() as f64 * self.config.count),
            SignalKind::Enabled => bit(self.following()),
            SignalKind::Fault => bit(matches!(self.state(), State::Fault | State::FaultReaction)),
            SignalKind::Limited => bit(self.word.unwrap_or(0) & status::LIMIT != 0),
            SignalKind::Field(..) => None,
        }
    }

    /// Whether each answer has arrived since the last SYNC but one.
    pub(super) fn answered(&self) -> bool {
        self.answers.iter().all(|answer| answer.age <= 1)
    }

    /// Age of its oldest answer, ticks.
    pub fn age(&self) -> u32 {
        self.answers.iter().map(|answer| answer.age).max().unwrap_or(Reading::NEVER)
    }

    /// Begins a tick with a new SYNC: all answers age by one tick.
    pub(super) fn begin(&mut self) {
        for answer in &mut self.answers {
            answer.age = answer.age.saturating_add(1);
        }
        self.ticks = self.ticks.wrapping_add(1);
    }

    /// Whether it still has torque although it was told to stop, and has not begun to.
    pub(super) fn disobeys(&self) -> bool {
        match self.goal {
            Goal::Enabled => false,
            Goal::Stopped => self.state() == State::Enabled,
            Goal::Off => matches!(self.state(), State::Enabled | State::QuickStop),
        }
    }

    /// Whether its goal is to be without torque.
    pub(super) fn is_to_be_off(&self) -> bool {
        self.goal == Goal::Off
    }

    /// Sets the command for the next `end`, SI.
    pub fn command(&mut self, value: f64) {
        self.command = value;
    }

    /// Sets the goal of the state machine. `resets`: an operator has requested a fault reset.
    pub(super) fn aim(&mut self, goal: Goal, resets: bool) {
        (self.goal, self.resets) = (goal, resets);
    }

    /// Makes its present position the origin.
    pub(super) fn rest(&mut self) {
        self.counter.rest();
        self.command = 0.0;
    }

    /// Reports conditions that only time reveals: missing heartbeats, and a drive that does not follow.
    pub(super) fn watch(&mut self, now_ns: u64, tell: &mut dyn FnMut(TroubleKind)) {
        let late_ns = self.setting.watchdog_ns.max(HEARTBEAT_LATE_NS);
        if self.watching == Some(Watching::Heartbeat)
            && self.heard_ns.is_some_and(|heard| now_ns.saturating_sub(heard) > late_ns)
        {
            self.heard_ns = None;
            tell(TroubleKind::HeartbeatLost);
        }
        if self.config.mode == Mode::Position && self.goal == Goal::Enabled && self.state() == State::Enabled {
            let (_, whole) = self.counter.number(self.target.command(self.command));
            if !whole && !self.wraps {
                tell(TroubleKind::Wraps);
            }
            self.wraps = !whole;
        }
        let follows = self.following() || !is_present(Protection::Shown);
        if self.goal == Goal::Enabled && self.state() == State::Enabled && !follows {
            self.not_following = self.not_following.saturating_add(1);
            match self.mode_shown {
                Some(shown) if shown != self.mode && self.not_following == 1 => tell(TroubleKind::Mode(shown)),
                _ if self.not_following == NOT_FOLLOWING => tell(TroubleKind::NotFollowing),
                _ => {}
            }
        } else {
            self.not_following = 0;
        }
    }

    /// The PDO with a control word and a command.
    fn process_data(&self, word: u16, command: f64) -> Frame {
        let mut data = [0; 8];
        data[..2].copy_from_slice(&word.to_le_bytes());
        let number = match self.config.mode {
            Mode::Torque | Mode::Speed => self.target.command(command),
            Mode::Position => self.counter.number(self.target.command(command)).0.into(),
        };
        let length = self.command_pdo.length();
        data[2..length].copy_from_slice(&number.to_le_bytes()[..length - 2]);
        Frame::new(self.command_pdo.cob_id, &data[..length])
    }

    /// Sends the control word towards the goal, with the command; with the idle value if the drive is not enabled.
    pub(super) fn send_command(&mut self, send: Send) {
        let word = towards(self.goal, self.state(), self.resets && self.ticks % 16 < 8);
        let idle = match self.config.mode {
            Mode::Torque | Mode::Speed => 0.0,
            Mode::Position => self.counter.total() as f64 * self.config.count,
        };
        let command = match (self.state(), self.goal) {
            (State::Enabled, Goal::Enabled) => self.command,
            (State::Enabled | State::QuickStop, Goal::Stopped) if self.config.mode != Mode::Position => {
                self.setting.safe
            }
            _ => idle,
        };
        send(self.process_data(word, command));
    }

    /// The frames for a quick stop and for disabling the voltage.
    pub(super) fn stop_frames(&self) -> [Frame; 2] {
        [control::QUICK_STOP, control::DISABLE_VOLTAGE].map(|word| self.process_data(word, self.setting.safe))
    }

    /// Sends a guard request, if the drive is monitored by node guarding.
    pub(super) fn guard(&mut self, now_ns: u64, send: Send) {
        if self.watching == Some(Watching::Guarding) && now_ns >= self.guard_due_ns {
            // Its answers are also all that tells its NMT state: soon enough for the start-up.
            let apart_ms = self.timeout_wanted_ms().div_ceil(3).clamp(1, GUARD_MS_MAX);
            self.guard_due_ns = now_ns + u64::from(apart_ms) * 1_000_000;
            send(service::guard_request(self.config.node));
        }
    }

    /// Makes the next guard request due.
    pub(super) fn guard_now(&mut self) {
        self.guard_due_ns = 0;
    }

    /// One step of the identification. Also polls the SDO client for time-outs.
    pub(super) fn identify(&mut self, now_ns: u64, send: Send) -> Result<bool, RefusalReason> {
        self.client.poll(now_ns, send);
        match self.identity.work(&mut self.client, now_ns, send) {
            Progress::Busy => Ok(false),
            Progress::Done => Ok(true),
            Progress::Refused(why) => Err(why),
            Progress::Asks(_) => self.judge_identity().map(|()| false),
        }
    }

    fn judge_identity(&mut self) -> Result<(), RefusalReason> {
        let get = |keep| self.identity.get(keep);
        let kind = get(Keep::DeviceType).unwrap_or(0) as u32;
        if kind & 0xFFFF != self.profile.device.into() {
            return Err(RefusalReason::DeviceType(kind));
        }
        let path = match self.config.mode {
            Mode::Torque => self.profile.torque,
            Mode::Speed => self.profile.speed,
            Mode::Position => self.profile.position,
        };
        let path = path.expect("it was there when the drive was made");
        self.mode = match get(Keep::Modes) {
            None => path.modes[0].0,
            Some(offered) => {
                let mode = path.modes.iter().find(|(_, bit)| offered >> bit & 1 == 1);
                mode.ok_or(RefusalReason::NoMode(offered as u32))?.0
            }
        };
        if let Some(rated) = get(Keep::RatedTorque) {
            let rated = rated as f64 * 1e-3;
            if (rated - self.config.rated_torque).abs() > 0.01 * self.config.rated_torque {
                return Err(RefusalReason::RatedTorque(rated, self.config.rated_torque));
            }
        }
        let own_torque = get(Keep::MaxTorque).map(|number| self.torque.value(number));
        let rpm = std::f64::consts::PI / 30.0;
        let own_speed = get(Keep::MaxSpeed).map(|number| number as f64 * rpm);
        let torque = self.config.max_torque.or(own_torque).ok_or(RefusalReason::NoLimit("torque"))?;
        let speed = self.config.max_speed.or(own_speed).ok_or(RefusalReason::NoLimit("speed"))?;
        self.limits = Limits { torque, speed, power: self.config.max_power.unwrap_or(torque * speed) };
        self.error_code = get(Keep::Error).unwrap_or(0) as u16;
        Ok(())
    }

    /// One step of the configuration.
    pub(super) fn configure(&mut self, now_ns: u64, send: Send) -> Result<bool, RefusalReason> {
        self.client.poll(now_ns, send);
        match self.configuration.work(&mut self.client, now_ns, send) {
            Progress::Busy => Ok(false),
            Progress::Done => {
                self.mode_script = Script::new(self.mode_list()?, 0);
                Ok(true)
            }
            Progress::Refused(why) => Err(why),
            Progress::Asks(Question::Timeout(Watching::Nothing)) => Err(RefusalReason::NoTimeout),
            Progress::Asks(Question::Timeout(watching)) => {
                // From now on the drive monitors us, and we monitor the drive.
                (self.watching, self.heard_ns) = (Some(watching), Some(now_ns));
                Ok(false)
            }
            Progress::Asks(Question::QuickStop | Question::Identity) => match self.configuration.get(Keep::QuickStop) {
                Some(1..=3) => Ok(false),
                found => {
                    let found = found.unwrap_or(0);
                    Err(RefusalReason::ReadBack { object: Object(0x605A, 0), wanted: 2, found })
                }
            },
        }
    }

    /// One step of setting the mode of operation; the mode display is read repeatedly until it agrees.
    pub(super) fn give_mode(&mut self, now_ns: u64, send: Send) -> Result<bool, RefusalReason> {
        self.client.poll(now_ns, send);
        match self.mode_script.work(&mut self.client, now_ns, send) {
            Progress::Busy | Progress::Asks(_) => Ok(false),
            Progress::Refused(why) => Err(why),
            Progress::Done => {
                self.mode_shown = self.mode_script.get(Keep::ModeShown).map(|mode| mode as i8);
                let right = self.mode_is_right();
                if !right {
                    self.mode_script.rewind();
                }
                Ok(right)
            }
        }
    }

    /// The refusal if its mode display never agreed.
    pub(super) fn wrong_mode(&self) -> RefusalReason {
        RefusalReason::Mode { wanted: self.mode, shown: self.mode_shown.unwrap_or(0) }
    }

    /// The refusal if it was never enabled.
    pub(super) fn not_enabled(&self) -> RefusalReason {
        match self.state() {
            State::Enabled => self.wrong_mode(),
            state => RefusalReason::NotEnabled(state, self.error_code),
        }
    }

    /// Its NMT state according to its heartbeat.
    pub fn nmt(&self) -> NmtState {
        self.nmt
    }

    /// The mechanism by which it monitors us, once configured.
    pub(super) fn watching(&self) -> Option<Watching> {
        self.watching
    }

    /// Highest command that the rig permits, SI.
    pub(super) fn most(&self) -> f64 {
        let own = match self.config.mode {
            Mode::Torque => self.limits.torque,
            Mode::Speed => self.limits.speed,
            Mode::Position => f64::INFINITY,
        };
        own.min(self.setting.most)
    }

    /// Its arguments in the rig.
    pub fn config(&self) -> &Cia402 {
        &self.config
    }
}

/// A period as an integer from 1 to 255 times a power of ten, in seconds (object 60C2).
fn interpolation(period_ns: u64) -> Option<(i64, i64)> {
    let (mut value, mut exponent) = (period_ns, -9);
    while value > 255 {
        if !value.is_multiple_of(10) {
            return None;
        }
        (value, exponent) = (value / 10, exponent + 1);
    }
    // In milliseconds where that is exact, as most drives write it.
    while value.is_multiple_of(10) && exponent < -3 {
        (value, exponent) = (value / 10, exponent + 1);
    }
    Some((value as i64, exponent))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_period_is_encoded_as_a_number_times_a_power_of_ten() {
        assert_eq!(interpolation(1_000_000), Some((1, -3)));
        assert_eq!(interpolation(20_000_000), Some((20, -3)));
        assert_eq!(interpolation(250_000), Some((25, -5)));
        assert_eq!(interpolation(125_000), Some((125, -6)));
        assert_eq!(interpolation(312_500), None);
    }
}
