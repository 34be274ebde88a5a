//! The plan of a rig, as plain data: the hardware that replaces a part of a system, how signals travel, and the limits.
//!
//! Like a plan, it refers to slots: every expression in the text of a rig is a quantity of one of two programs. The
//! *control* program is the system without the part that hardware replaces: signals read from the bus are its inputs,
//! and requested commands are its outputs. The *plant* program is the replaced part alone; it receives what the drives
//! apply and returns what their encoders measure. It simulates the hardware where there is none.

use crate::description::Slot;
use crate::instance::Instance;
use crate::series::{Method, Series};
use crate::unit::{Angle, Dimension, Unit};
use std::fmt;

/// One rig.
#[derive(Clone, PartialEq, Debug)]
pub struct Rig {
    /// Its name.
    pub name: String,
    /// Period of the cycle.
    pub period_ns: u64,
    /// Fixed-step method of the control program.
    pub method: Method,
    /// Steps of the method per period, at least 1.
    pub steps: u32,
    /// The buses, in the order of the text.
    pub buses: Vec<Bus>,
    /// Drives and devices, in the order of the text.
    pub nodes: Vec<Node>,
    /// Signals that the control program reads.
    pub inputs: Vec<Input>,
    /// Commands that the control program computes.
    pub outputs: Vec<Output>,
    /// Time without a cycle after which the watchdog stops the drives.
    pub watchdog_ns: u64,
    /// The reaction to a missed tick.
    pub overrun: Overrun,
    /// Conditions under which the rig stops.
    pub stops: Vec<Stop>,
    /// Quantities to record at every tick, besides inputs, outputs and states.
    pub record: Vec<Series>,
    /// Curves that share a canvas of the panel, in the order of the text.
    pub plots: Vec<Curves>,
    /// The drive (index into `nodes`) whose command is predicted for the instant at which it acts.
    pub predict: Option<usize>,
    /// Its contacts are only stable with prediction, so a rig that loses its shaft position must stop. This is
    /// determined after compilation, when the rig is run or packed.
    pub needs_look: bool,
    /// The part that hardware replaces, as a program.
    pub plant: Plant,
}

/// `plot a, b against c`: recorded quantities that are looked at together.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Curves {
    /// Indices into [`Rig::record`].
    pub series: Vec<usize>,
    /// Index of the quantity on the horizontal axis; `None`: time.
    pub against: Option<usize>,
}

/// `overrun stop` or `overrun hold N`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Overrun {
    /// Safe values at the first missed tick.
    Stop,
    /// The last permitted commands are held for up to this many consecutive missed ticks.
    Hold(u32),
}

/// One bus.
#[derive(Clone, PartialEq, Debug)]
pub struct Bus {
    /// Its name in the rig: `can0`.
    pub name: String,
    /// Its address: `socketcan:can0`, `sim:bench`, `slcan:/dev/ttyACM0@1000000`, `socketcand:host:29536/can0`.
    pub address: String,
    /// In bit/s; 0 if this kind of bus has none.
    pub bit_rate: u32,
}

/// A drive or a device on a bus.
#[derive(Clone, PartialEq, Debug)]
pub struct Node {
    /// Its name in the rig: `load`.
    pub name: String,
    /// Index into [`Rig::buses`].
    pub bus: usize,
    /// Its protocol.
    pub kind: Kind,
    /// Whether it can move: it is then supervised and has a safe value. A `device` only communicates.
    pub moves: bool,
    /// Dead time from a command to its effect, s.
    pub delay: f64,
    /// Time constant of the effect, s.
    pub lag: f64,
    /// Age at which one of its signals counts as lost; 0 if the rig specifies none.
    pub timeout_ns: u64,
    /// Its limits, for a drive described by frames.
    pub within: DriveLimits,
}

/// Limits of a drive described by frames, SI. A drive with a profile has arguments of its own.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct DriveLimits {
    /// Largest speed, rad/s.
    pub max_speed: Option<f64>,
    /// Permitted positions, rad, as the drive reports them.
    pub travel: Option<(f64, f64)>,
    /// Largest power, W; `None`: largest torque times largest speed.
    pub max_power: Option<f64>,
}

impl Node {
    /// The signal with which the node reports its torque, speed or position. For a drive described by frames: the field
    /// with that name, otherwise the only field with a suitable unit.
    pub fn tells(&self, what: SignalKind) -> Option<SignalKind> {
        let Kind::Frames(messages) = &self.kind else { return Some(what) };
        let (name, dimension) = match what {
            SignalKind::Torque => ("torque", Dimension::of([1, 2, -2, 0, 0])),
            SignalKind::Speed => ("speed", Dimension::of([0, 0, -1, 0, 0])),
            SignalKind::Position => ("position", Dimension::NONE),
            SignalKind::Enabled | SignalKind::Fault | SignalKind::Limited | SignalKind::Field(..) => return None,
        };
        let fits = |field: &Field| {
            let unit = &field.unit;
            unit.dimension == dimension && (what == SignalKind::Torque || unit.angle == Angle::Angle)
        };
        let mut all = messages.iter().enumerate().filter(|(_, message)| !message.send).flat_map(|(m, message)| {
            message.fields.iter().enumerate().filter(|(_, field)| fits(field)).map(move |(f, field)| (m, f, field))
        });
        let first = all.next()?;
        let found = std::iter::once(first).chain(all).collect::<Vec<_>>();
        let named = found.iter().find(|(_, _, field)| field.name == name);
        named.or(found.first().filter(|_| found.len() == 1)).map(|(m, f, _)| SignalKind::Field(*m, *f))
    }

    /// The quantity that a command to this signal controls: torque, speed or position of a drive; `None` for anything
    /// else.
    pub fn asks_for(&self, what: SignalKind) -> Option<SignalKind> {
        match (&self.kind, what) {
            (Kind::Cia402(drive), _) => Some(match drive.mode {
                Mode::Torque => SignalKind::Torque,
                Mode::Speed => SignalKind::Speed,
                Mode::Position => SignalKind::Position,
            }),
            (Kind::Frames(messages), SignalKind::Field(message, field)) => {
                let unit = &messages[message].fields[field].unit;
                let angle = unit.angle == Angle::Angle;
                match unit.dimension {
                    torque if torque == Dimension::of([1, 2, -2, 0, 0]) => Some(SignalKind::Torque),
                    speed if angle && speed == Dimension::of([0, 0, -1, 0, 0]) => Some(SignalKind::Speed),
                    none if angle && none.is_none() => Some(SignalKind::Position),
                    _ => None,
                }
            }
            (Kind::Frames(_), _) => None,
        }
    }

    /// Whether a nonzero command to this signal moves the node: torque, speed or position of a drive with a profile;
    /// for a drive described by frames, a field with the dimension of a force, torque, speed, acceleration or current.
    pub fn is_moved_by(&self, what: SignalKind) -> bool {
        self.moves
            && match (&self.kind, what) {
                (Kind::Cia402(_), _) => true,
                (Kind::Frames(messages), SignalKind::Field(message, field)) => {
                    messages[message].fields[field].unit.dimension.moves()
                }
                (Kind::Frames(_), _) => false,
            }
    }
}

/// The protocol of a node.
#[derive(Clone, PartialEq, Debug)]
pub enum Kind {
    /// CANopen with the drive profile CiA 402.
    Cia402(Cia402),
    /// Frames described in the rig or by a DBC file.
    Frames(Vec<Message>),
}

/// The arguments of `cia402(…)`, SI.
#[derive(Clone, PartialEq, Debug)]
pub struct Cia402 {
    /// Node id, 1 to 127.
    pub node: u8,
    /// Rated torque, N·m; object 6076 must agree.
    pub rated_torque: f64,
    /// The commanded signal.
    pub mode: Mode,
    /// Angle of one increment of object 6064, rad.
    pub count: f64,
    /// One increment of object 606C, rad/s.
    pub speed_unit: f64,
    /// Largest torque, N·m; `None`: object 6072.
    pub max_torque: Option<f64>,
    /// Largest speed, rad/s; `None`: object 6080.
    pub max_speed: Option<f64>,
    /// Permitted positions, rad, counted from enabling.
    pub travel: Option<(f64, f64)>,
    /// Largest power, W; `None`: largest torque times largest speed.
    pub max_power: Option<f64>,
    /// Whether a command acts at the next SYNC rather than on arrival.
    pub at_sync: bool,
    /// The profile it is based on: `cia402`, `fc302`, `vlt5000`.
    pub profile: String,
}

/// The quantity that a drive controls.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Mode {
    Torque,
    Speed,
    Position,
}

/// A signal of a node.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Signal {
    /// Index into [`Rig::nodes`].
    pub node: usize,
    /// The signal within the node.
    pub what: SignalKind,
}

/// A signal within a node.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub enum SignalKind {
    /// Torque of a CiA 402 drive, N·m.
    Torque,
    /// Speed of a CiA 402 drive, rad/s.
    Speed,
    /// Position of a CiA 402 drive, rad, counted from enabling.
    Position,
    /// 1 while the drive follows commands.
    Enabled,
    /// 1 while the drive reports a fault.
    Fault,
    /// 1 while the drive reports an internal limit.
    Limited,
    /// A field of a node described by frames: indices of message and field.
    Field(usize, usize),
}

/// A frame of a device.
#[derive(Clone, PartialEq, Debug)]
pub struct Message {
    /// Its name in a DBC file, or the name of its first signal.
    pub name: String,
    /// The identifier.
    pub id: u32,
    /// Whether the identifier has 29 bits rather than 11.
    pub extended: bool,
    /// Number of data bytes.
    pub length: u8,
    /// Whether we send it to the device.
    pub send: bool,
    /// Period in which it is sent or expected, ns; 0: unknown.
    pub period_ns: u64,
    /// Its signals.
    pub fields: Vec<Field>,
}

/// One signal in a frame. SI value = raw · scale + offset.
#[derive(Clone, PartialEq, Debug)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// Start bit as in a DBC file, byte · 8 + bit in the byte: the least significant bit of a little-endian signal, the
    /// most significant bit of a big-endian one.
    pub start_bit: u16,
    /// Number of bits.
    pub bits: u16,
    /// Whether the most significant byte comes first.
    pub big_endian: bool,
    /// Number format.
    pub format: Format,
    /// SI value of one raw unit.
    pub scale: f64,
    /// SI value of raw 0.
    pub offset: f64,
    /// Value before the first frame and in software-in-the-loop runs, SI.
    pub start: f64,
    /// The unit in which it is displayed.
    pub unit: Unit,
    /// Multiplexing as in a DBC file: the field is only present while another field of the message has this raw value.
    pub multiplexed: Option<(usize, u64)>,
}

/// Number format of a field.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Format {
    Unsigned,
    Signed,
    Float32,
    Float64,
}

/// A signal that the control program reads.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Input {
    /// Its source.
    pub signal: Signal,
    /// The input slot of the control program.
    pub slot: Slot,
    /// Value before the first frame arrives, SI.
    pub start: f64,
    /// Whether it must be fresh, because `hardware` or a `stop` depends on it.
    pub needed: bool,
}

/// A command that the control program computes.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Output {
    /// Its destination.
    pub signal: Signal,
    /// The output slot of the control program with the requested value, SI.
    pub slot: Slot,
    /// Smallest permitted value, SI; −inf if the rig specifies none.
    pub low: f64,
    /// Largest permitted value, SI; inf if the rig specifies none.
    pub high: f64,
    /// Largest rate of change, SI per second; inf if the rig specifies none.
    pub slew: f64,
    /// Value to send on any stop, SI.
    pub safe: f64,
}

/// `stop when COND, "why"`.
#[derive(Clone, PartialEq, Debug)]
pub struct Stop {
    /// The output slot of the control program that is not 0 if the rig must stop.
    pub slot: Slot,
    /// The condition as written.
    pub condition: String,
    /// The message to the operator.
    pub why: String,
}

/// The part that hardware replaces, as a program.
#[derive(Clone, PartialEq, Debug)]
pub struct Plant {
    /// Quantities that drives apply (SI) → input slots of the plant program.
    pub applied: Vec<(Signal, Slot)>,
    /// Quantities that encoders measure (SI) ← output slots of the plant program.
    pub seen: Vec<(Signal, Slot)>,
    /// Moment of inertia of the shaft, kg·m², if the compiler could determine it; for prediction and its checks.
    pub inertia: Option<f64>,
}

/// The simulated surroundings of a rig's control program in a software-in-the-loop run.
#[derive(Clone)]
pub struct Bench {
    /// The rig.
    pub rig: Rig,
    /// The part that hardware replaces, at its start.
    pub plant: Instance,
}

impl PartialEq for Bench {
    fn eq(&self, other: &Bench) -> bool {
        self.rig == other.rig && self.plant.block() == other.plant.block()
    }
}

impl fmt::Debug for Bench {
    fn fmt(&self, out: &mut fmt::Formatter) -> fmt::Result {
        write!(out, "Bench of {}", self.rig.name)
    }
}
