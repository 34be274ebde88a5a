//! Readings of nodes and their faults, as values without text.

use super::state::State;
use crate::canopen::sdo::Failure;
use crate::canopen::service::Emergency;
use crate::canopen::{NmtState, Object};
use std::fmt;

/// A signal as it was last received.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Reading {
    /// In SI units.
    pub value: f64,
    /// Time at which its frame arrived.
    pub stamp_ns: u64,
    /// Ticks since then; [`Reading::NEVER`] if it has never arrived.
    pub age: u32,
}

impl Reading {
    /// Age of a signal that has never arrived.
    pub const NEVER: u32 = u32::MAX;

    /// A signal that has not arrived yet.
    pub fn none(value: f64) -> Reading {
        Reading { value, stamp_ns: 0, age: Reading::NEVER }
    }
}

/// An event of a node that the supervisor must know.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Trouble {
    /// The node (index into the rig's nodes); none: a foreign participant.
    pub node: Option<usize>,
    /// Kind of the event.
    pub kind: TroubleKind,
    /// Time at which it was noticed.
    pub stamp_ns: u64,
}

/// Kind of an event.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum TroubleKind {
    /// The node sent an emergency message.
    Emergency(Emergency),
    /// Its status word shows a fault.
    Fault,
    /// It left "operation enabled" without a command.
    Left(State),
    /// Its heartbeat is missing.
    HeartbeatLost,
    /// It booted: it was reset or lost its power.
    BootUp,
    /// Its heartbeat shows another state than "operational".
    Nmt(NmtState),
    /// It displays another mode of operation than the one it was given.
    Mode(i8),
    /// It is enabled but does not follow commands.
    NotFollowing,
    /// A position command does not fit into its 32 bits.
    Wraps,
    /// A frame is shorter than configured.
    Short(u32),
    /// A frame arrived that only a master sends, and that we did not send: its identifier.
    ForeignMaster(u32),
}

impl fmt::Display for TroubleKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            TroubleKind::Emergency(emergency) => {
                write!(f, "emergency 0x{:04X}: {}", emergency.code, emergency.meaning())
            }
            TroubleKind::Fault => f.write_str("it reports a fault"),
            TroubleKind::Left(state) => write!(f, "it went to \"{state}\" by itself"),
            TroubleKind::HeartbeatLost => f.write_str("its heartbeat has stopped"),
            TroubleKind::BootUp => f.write_str("it has booted anew"),
            TroubleKind::Nmt(state) => write!(f, "it is {state}"),
            TroubleKind::Mode(mode) => write!(f, "it shows mode {mode}"),
            TroubleKind::NotFollowing => f.write_str("it is enabled but does not follow commands"),
            TroubleKind::Wraps => {
                f.write_str("a position command lies beyond its 32 bits of counts: it would turn the other way")
            }
            TroubleKind::Short(id) => write!(f, "frame 0x{id:03X} is shorter than agreed"),
            TroubleKind::ForeignMaster(id) if id & 0x780 == 0x700 => stranger(f, *id),
            TroubleKind::ForeignMaster(id) => write!(f, "somebody else sends frame 0x{id:03X}: a second master"),
        }
    }
}

fn stranger(f: &mut fmt::Formatter, id: u32) -> fmt::Result {
    let node = id & 0x7F;
    write!(
        f,
        "node {node}, which the rig does not name, is on the bus (frame 0x{id:03X}): a second master, or a forgotten \
         drive"
    )
}

/// Refusal to start a rig.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Refusal {
    /// The node (index into the rig's nodes) that causes it, if any.
    pub node: Option<usize>,
    /// The reason.
    pub why: RefusalReason,
}

/// Reason of a refusal.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum RefusalReason {
    /// Another participant acts as a master: identifier of its frame.
    ForeignMaster(u32),
    /// No boot-up message or heartbeat after a reset.
    Silent,
    /// An object could not be read or written.
    Sdo {
        /// The object.
        object: Object,
        /// Whether it was being written.
        write: bool,
        /// The failure of the transfer.
        failure: Failure,
    },
    /// An object holds another value than was written.
    ReadBack {
        /// The object.
        object: Object,
        /// Written value.
        wanted: i64,
        /// Value read back.
        found: i64,
    },
    /// Object 1000 does not match the profile.
    DeviceType(u32),
    /// Rated torque, N·m: of the drive, of the rig.
    RatedTorque(f64, f64),
    /// Neither the rig nor the drive names this limit.
    NoLimit(&'static str),
    /// The drive does not support a mode for this signal: object 6502.
    NoMode(u32),
    /// The period cannot be expressed in object 60C2.
    Period(u64),
    /// The drive has no mechanism to detect that we are gone.
    NoTimeout,
    /// It did not become operational.
    NotOperational(NmtState),
    /// Missing TPDOs, and number of TPDOs expected.
    Missed(u32, u32),
    /// It displays another mode of operation than the one it was given.
    Mode {
        /// Given mode.
        wanted: i8,
        /// Displayed mode.
        shown: i8,
    },
    /// It stays in this state instead of entering "operation enabled"; its error code.
    NotEnabled(State, u16),
    /// It did not stop when our heartbeat stopped; time waited, ms.
    TimeoutIgnored(u64),
    /// It did not move at this torque, N·m, or at this command.
    Stuck(f64),
    /// Its position did not change by this angle, rad, while it was to be turned from outside.
    NotTurned(f64),
    /// It moved in the wrong direction.
    WrongSign,
    /// It turned further or faster than the check permits: rad, rad/s.
    Ran(f64, f64),
    /// Its position turned by the first angle, the integral of its speed is the second, rad.
    Scale(f64, f64),
    /// Integrals of the commanded and of the reported torque, N·m·s.
    Torque(f64, f64),
    /// A fault during the start-up.
    Trouble(TroubleKind),
}

impl fmt::Display for RefusalReason {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match *self {
            RefusalReason::ForeignMaster(id) if id & 0x780 == 0x700 => stranger(f, id),
            RefusalReason::ForeignMaster(id) => write!(
                f,
                "somebody else sends frame 0x{id:03X}, which only a master sends; two masters on a bus fight: take \
                 the other one off"
            ),
            RefusalReason::Silent => write!(
                f,
                "it does not answer a reset of communication: is it powered, has it this node id, is the bit rate right?"
            ),
            RefusalReason::Sdo { object, write, failure } => {
                write!(f, "object {object} could not be {}: {failure}", if write { "written" } else { "read" })
            }
            RefusalReason::ReadBack { object, wanted, found } => {
                write!(f, "object {object} was set to {wanted} (0x{wanted:X}) and holds {found} (0x{found:X})")
            }
            RefusalReason::DeviceType(found) => {
                write!(f, "object 1000 is 0x{found:08X}: no drive with profile 402 (0x....0192)")
            }
            RefusalReason::RatedTorque(drive, rig) => write!(
                f,
                "its rated torque is {drive} N·m (object 6076), the rig says {rig} N·m: correct `T_rated`, or the \
                 node id"
            ),
            RefusalReason::NoLimit(which) => {
                write!(f, "neither the rig nor the drive says its greatest {which}: give `{which}_max`")
            }
            RefusalReason::NoMode(modes) => {
                write!(f, "it offers no mode for this command (object 6502 is 0x{modes:08X})")
            }
            RefusalReason::Period(period_ns) => write!(
                f,
                "a period of {} µs can't be told to it (object 60C2 takes 1 to 255 times a power of ten)",
                period_ns as f64 / 1e3
            ),
            RefusalReason::NoTimeout => write!(
                f,
                "it has no means to notice that we are gone: neither heartbeat consumer (1016) nor node guarding (100C)"
            ),
            RefusalReason::NotOperational(state) => write!(f, "it was started and is {state}"),
            RefusalReason::Missed(missed, of) => write!(f, "{missed} of {of} answers to SYNC were late or missing"),
            RefusalReason::Mode { wanted, shown } => write!(f, "it was given mode {wanted} and shows mode {shown}"),
            RefusalReason::NotEnabled(state, 0) => write!(f, "it stays in \"{state}\""),
            RefusalReason::NotEnabled(state, code) => {
                let text = crate::canopen::service::error_meaning(code);
                write!(f, "it stays in \"{state}\", error 0x{code:04X}: {text}")
            }
            RefusalReason::TimeoutIgnored(ms) => {
                write!(f, "our life sign had stopped for {ms} ms and it was still enabled: its time-out does not work")
            }
            RefusalReason::Stuck(command) => {
                write!(f, "it did not move at {command:.3}: is it blocked, or its brake closed?")
            }
            RefusalReason::NotTurned(angle) => write!(
                f,
                "its position did not change by {angle:.2} rad although the shaft was to be turned: is its encoder connected, \
                 and the shaft coupled?"
            ),
            RefusalReason::WrongSign => {
                write!(f, "it turned against the command: sign of torque or of position is swapped")
            }
            RefusalReason::Ran(angle, speed) => {
                write!(f, "the first motion went too far: {angle:.3} rad at {speed:.2} rad/s")
            }
            RefusalReason::Scale(position, speed) => write!(
                f,
                "by its position it turned by {position:.4} rad, by its speed by {speed:.4} rad: `count` or \
                 `speed_unit` is wrong"
            ),
            RefusalReason::Torque(told, applied) => write!(
                f,
                "it was told {told:.4} N·m s and reports {applied:.4} N·m s: scale or sign of its torque is wrong"
            ),
            RefusalReason::Trouble(kind) => kind.fmt(f),
        }
    }
}
