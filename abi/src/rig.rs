//! A rig as plain data: what drives the crossed-out part, how signals travel, what must never be exceeded.
//!
//! Like a plan, it holds slots: every expression of a rig's text is a quantity of one of two programs. The *control*
//! program is the system with one part crossed out: the signals read from the bus are its inputs, the commands it
//! requests are its outputs. The *plant* program is the crossed-out part alone, driven by what the drives apply and
//! giving what their encoders see: it stands in where there is no hardware.

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
    /// Fixed method of the control program.
    pub method: Method,
    /// Steps of the method in one period, at least 1.
    pub steps: u32,
    /// The buses, in the order of the text.
    pub buses: Vec<Bus>,
    /// Drives and devices, in the order of the text.
    pub nodes: Vec<Node>,
    /// Signals that the control program reads.
    pub inputs: Vec<Input>,
    /// Commands that the control program gives.
    pub outputs: Vec<Output>,
    /// Time without a cycle after which the watchdog stops the drives.
    pub watchdog_ns: u64,
    /// What a missed tick does.
    pub overrun: Overrun,
    /// Conditions under which the rig stops by itself.
    pub stops: Vec<Stop>,
    /// What is kept for every tick besides inputs, outputs and states.
    pub record: Vec<Series>,
    /// The drive (index into `nodes`) whose command is computed for the moment it acts.
    pub predict: Option<usize>,
    /// Its contacts are stable only while commands are computed ahead: a rig that loses sight of its shaft stops. Judged after
    /// the compiler, when it is run or packed.
    pub needs_look: bool,
    /// The crossed-out part as a program of its own.
    pub plant: Plant,
}

/// `overrun stop` or `overrun hold N`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Overrun {
    /// To the safe values at the first missed tick.
    Stop,
    /// Up to this many consecutive missed ticks the last permitted commands stay.
    Hold(u32),
}

/// One bus.
#[derive(Clone, PartialEq, Debug)]
pub struct Bus {
    /// As the rig calls it: `can0`.
    pub name: String,
    /// Where it is: `socketcan:can0`, `sim:bench`, `slcan:/dev/ttyACM0@1000000`, `socketcand:host:29536/can0`.
    pub address: String,
    /// In bit/s; 0 where the kind has none.
    pub bit_rate: u32,
}

/// A drive or a device on a bus.
#[derive(Clone, PartialEq, Debug)]
pub struct Node {
    /// As the rig calls it: `load`.
    pub name: String,
    /// Index into [`Rig::buses`].
    pub bus: usize,
    /// What it speaks.
    pub kind: Kind,
    /// It can move: it is supervised and has a safe value. A `device` only talks.
    pub moves: bool,
    /// Dead time from a command to its effect, s.
    pub delay: f64,
    /// Time constant of the effect, s.
    pub lag: f64,
    /// Age at which a signal of it is lost; 0 where the rig names none.
    pub timeout_ns: u64,
    /// What it must not exceed, where it is a drive that speaks in frames.
    pub within: Within,
}

/// What a drive that speaks in frames must not exceed, SI; one with a profile has arguments of its own.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Within {
    /// Greatest speed, rad/s.
    pub max_speed: Option<f64>,
    /// Permitted positions, rad, as it tells them.
    pub travel: Option<(f64, f64)>,
    /// Greatest power, W; none: greatest torque times greatest speed.
    pub max_power: Option<f64>,
}

impl Node {
    /// The signal by which it tells its torque, its speed or its position. Of a drive that speaks in frames: the one of that
    /// name, else the only one that it could be by its unit.
    pub fn tells(&self, what: What) -> Option<What> {
        let Kind::Frames(messages) = &self.kind else { return Some(what) };
        let (name, dimension) = match what {
            What::Torque => ("torque", Dimension::of([1, 2, -2, 0, 0])),
            What::Speed => ("speed", Dimension::of([0, 0, -1, 0, 0])),
            What::Position => ("position", Dimension::NONE),
            What::Enabled | What::Fault | What::Limited | What::Field(..) => return None,
        };
        let fits = |field: &Field| {
            let unit = &field.unit;
            unit.dimension == dimension && (what == What::Torque || unit.angle == Angle::Angle)
        };
        let mut all = messages.iter().enumerate().filter(|(_, message)| !message.send).flat_map(|(m, message)| {
            message.fields.iter().enumerate().filter(|(_, field)| fits(field)).map(move |(f, field)| (m, f, field))
        });
        let first = all.next()?;
        let found = std::iter::once(first).chain(all).collect::<Vec<_>>();
        let named = found.iter().find(|(_, _, field)| field.name == name);
        named.or(found.first().filter(|_| found.len() == 1)).map(|(m, f, _)| What::Field(*m, *f))
    }

    /// What a command for this signal asks for: torque, speed or position of a drive; none where it is something else.
    pub fn asks_for(&self, what: What) -> Option<What> {
        match (&self.kind, what) {
            (Kind::Cia402(drive), _) => Some(match drive.mode {
                Mode::Torque => What::Torque,
                Mode::Speed => What::Speed,
                Mode::Position => What::Position,
            }),
            (Kind::Frames(messages), What::Field(message, field)) => {
                let unit = &messages[message].fields[field].unit;
                let angle = unit.angle == Angle::Angle;
                match unit.dimension {
                    torque if torque == Dimension::of([1, 2, -2, 0, 0]) => Some(What::Torque),
                    speed if angle && speed == Dimension::of([0, 0, -1, 0, 0]) => Some(What::Speed),
                    none if angle && none.is_none() => Some(What::Position),
                    _ => None,
                }
            }
            (Kind::Frames(_), _) => None,
        }
    }

    /// Whether a command for this signal moves the node, unless it is 0: torque, speed or position of a drive with a profile; of
    /// one described by frames what has the dimension of a force, a torque, a speed, an acceleration or a current.
    pub fn is_moved_by(&self, what: What) -> bool {
        self.moves
            && match (&self.kind, what) {
                (Kind::Cia402(_), _) => true,
                (Kind::Frames(messages), What::Field(message, field)) => {
                    messages[message].fields[field].unit.dimension.moves()
                }
                (Kind::Frames(_), _) => false,
            }
    }
}

/// How a node speaks.
#[derive(Clone, PartialEq, Debug)]
pub enum Kind {
    /// CANopen with the drive profile CiA 402.
    Cia402(Cia402),
    /// Frames described by hand or by a DBC file.
    Frames(Vec<Message>),
}

/// The arguments of `cia402(…)`, SI.
#[derive(Clone, PartialEq, Debug)]
pub struct Cia402 {
    /// Node id, 1 to 127.
    pub node: u8,
    /// Rated torque, N·m: object 6076 must agree.
    pub rated_torque: f64,
    /// The commanded signal.
    pub mode: Mode,
    /// Angle of one step of object 6064, rad.
    pub count: f64,
    /// One step of object 606C, rad/s.
    pub speed_unit: f64,
    /// Greatest torque, N·m; none: object 6072.
    pub max_torque: Option<f64>,
    /// Greatest speed, rad/s; none: object 6080.
    pub max_speed: Option<f64>,
    /// Permitted positions, rad, counted from enabling.
    pub travel: Option<(f64, f64)>,
    /// Greatest power, W; none: greatest torque times greatest speed.
    pub max_power: Option<f64>,
    /// A command acts with the next SYNC rather than when it arrives.
    pub at_sync: bool,
    /// The profile it is based on: `cia402`, `fc302`, `vlt5000`.
    pub profile: String,
}

/// What a drive is told to follow.
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
    /// Which one.
    pub what: What,
}

/// Which signal of a node.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub enum What {
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
    /// A field of a node that speaks in frames: message and field, as indices.
    Field(usize, usize),
}

/// One frame of a device.
#[derive(Clone, PartialEq, Debug)]
pub struct Message {
    /// Its name in a DBC file, or the name of its first signal.
    pub name: String,
    /// The identifier.
    pub id: u32,
    /// 29-bit rather than 11-bit.
    pub extended: bool,
    /// Number of data bytes.
    pub length: u8,
    /// From us to the device.
    pub send: bool,
    /// How often it is sent or expected, ns; 0: unknown.
    pub period_ns: u64,
    /// What it carries.
    pub fields: Vec<Field>,
}

/// One signal in a frame. SI value = raw · scale + offset.
#[derive(Clone, PartialEq, Debug)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// Bit of the frame at which it starts, as a DBC file counts: byte · 8 + bit in the byte, least significant bit of a
    /// little-endian, most significant bit of a big-endian signal.
    pub start_bit: u16,
    /// Number of bits.
    pub bits: u16,
    /// Most significant byte first.
    pub big_endian: bool,
    /// How the bits are read.
    pub format: Format,
    /// SI value of one step.
    pub scale: f64,
    /// SI value of raw 0.
    pub offset: f64,
    /// Value before the first frame and in dry runs, SI.
    pub start: f64,
    /// The unit it is shown in.
    pub unit: Unit,
    /// Sent only while another field of the message has this raw value: DBC multiplexing.
    pub multiplexed: Option<(usize, u64)>,
}

/// How the bits of a field are read.
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
    /// Where it comes from.
    pub signal: Signal,
    /// The input slot of the control program it goes to.
    pub slot: Slot,
    /// Value before anything has arrived, SI.
    pub start: f64,
    /// `hardware` or a `stop` needs it: it must be fresh.
    pub needed: bool,
}

/// A command that the control program gives.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Output {
    /// Where it goes.
    pub signal: Signal,
    /// The output slot of the control program that holds the request, SI.
    pub slot: Slot,
    /// Least permitted value, SI; −inf where the rig names none.
    pub low: f64,
    /// Greatest permitted value, SI.
    pub high: f64,
    /// Greatest change per second, SI; inf where the rig names none.
    pub slew: f64,
    /// Sent on any stop, SI.
    pub safe: f64,
}

/// `stop when COND, "why"`.
#[derive(Clone, PartialEq, Debug)]
pub struct Stop {
    /// The output slot of the control program that is not 0 when the rig must stop.
    pub slot: Slot,
    /// As written.
    pub condition: String,
    /// What the operator is told.
    pub why: String,
}

/// The crossed-out part as a program.
#[derive(Clone, PartialEq, Debug)]
pub struct Plant {
    /// What drives apply (SI) → input slots of the plant program.
    pub applied: Vec<(Signal, Slot)>,
    /// What encoders see (SI) ← output slots of the plant program.
    pub seen: Vec<(Signal, Slot)>,
    /// Moment of inertia of the shaft, kg·m², where the compiler could find it; for prediction and its checks.
    pub inertia: Option<f64>,
}

/// What stands around the control program of a rig in a dry run: all but the hardware.
#[derive(Clone)]
pub struct Bench {
    /// The rig.
    pub rig: Rig,
    /// The crossed-out part, at its start.
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
