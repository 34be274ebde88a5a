//! Profiles: properties of the supported kinds of drives, as data.
//!
//! The numbers come from the makers' manuals, except where a comment calls one an assumption. The text of a rig takes
//! precedence.

use crate::canopen::Object;

/// Fieldbus of a drive.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Transport {
    /// CANopen, CiA 301.
    CanOpen,
    /// DeviceNet: simulated and predicted only.
    DeviceNet,
}

/// Mechanism by which a drive detects that we are gone.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Life {
    /// It monitors our heartbeat: object 1016.
    Heartbeat,
    /// It waits for guard requests: objects 100C and 100D.
    Guarding,
}

/// Identity of this program's simulated drives: vendor 0, which no maker has, this device name (object 1008), and this
/// serial number (1018:4), "fric" in ASCII. Options for simulated drives only are granted to no other drive.
pub const SIMULATED: (u32, &str, u32) = (0, "fric simulated", 0x6672_6963);

/// One signal of a drive: the objects of its command and of its actual value.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Path {
    /// The object of the command, and its bits.
    pub target: (Object, u8),
    /// The object of the actual value, and its bits.
    pub actual: (Object, u8),
    /// Modes of operation in which the drive follows the command, the best one first; each with its bit in object 6502.
    pub modes: &'static [(i8, u8)],
}

/// A kind of drive.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Profile {
    /// Its name in a rig.
    pub name: &'static str,
    /// Its fieldbus.
    pub transport: Transport,
    /// Lower word of object 1000.
    pub device: u16,
    /// Upper word of object 1000, for simulation: bit 0 frequency converter, bit 1 servo.
    pub sort: u16,
    /// Number that represents the rated torque.
    pub full_torque: i64,
    /// Torque signal.
    pub torque: Option<Path>,
    /// Speed signal.
    pub speed: Option<Path>,
    /// Position signal.
    pub position: Option<Path>,
    /// Mechanisms to detect that we are gone, the best one first.
    pub life: &'static [Life],
    /// Shortest and longest time for that, ms.
    pub timeout_ms: (u32, u32),
    /// Numbers of the RPDO and TPDO with control word, target, status word and actual value, if these cannot be
    /// remapped.
    pub fixed: Option<(u8, u8)>,
    /// Interval at which it accepts commands and refreshes its answers, ns; 0: immediately.
    pub refresh_ns: u64,
    /// Time constant of the filter of its speed, s: an assumption if the maker does not specify it.
    pub speed_lag: f64,
    /// Manufacturer-specific error codes.
    pub errors: &'static [(u16, &'static str)],
}

/// Any servo that conforms to CiA 402.
pub const CIA402: Profile = Profile {
    name: "cia402",
    transport: Transport::CanOpen,
    device: 402,
    sort: 2,
    full_torque: 1000,
    torque: Some(Path { target: (Object(0x6071, 0), 16), actual: (Object(0x6077, 0), 16), modes: &[(10, 9), (4, 3)] }),
    speed: Some(Path { target: (Object(0x60FF, 0), 32), actual: (Object(0x606C, 0), 32), modes: &[(9, 8), (3, 2)] }),
    position: Some(Path { target: (Object(0x607A, 0), 32), actual: (Object(0x6064, 0), 32), modes: &[(8, 7)] }),
    life: &[Life::Heartbeat, Life::Guarding],
    timeout_ms: (1, 65_535),
    fixed: None,
    refresh_ns: 0,
    speed_lag: 0.2e-3,
    errors: &[],
};

/// A frequency converter of the FC 302 kind with its CANopen option: velocity mode in rpm, and a time-out that only
/// node guarding resets. Its torque mode uses the maker's own profile and is not supported.
pub const FC302: Profile = Profile {
    name: "fc302",
    transport: Transport::CanOpen,
    device: 402,
    sort: 1,
    full_torque: 0x4000,
    torque: None,
    speed: Some(Path { target: (Object(0x6042, 0), 16), actual: (Object(0x6044, 0), 16), modes: &[(2, 1)] }),
    position: None,
    life: &[Life::Guarding],
    timeout_ms: (100, 65_535),
    // RPDO2: control word and 6042. TPDO2 with the status word and 6044 is an assumption.
    fixed: Some((2, 2)),
    refresh_ns: 2_000_000,
    speed_lag: 2e-3,
    errors: &[(0xFF10, "control word time-out")],
};

/// A frequency converter of the FC 280 kind. Its control word is object 2690 and its status word 2643, both with the
/// bits of the maker's own profile, so only `predict` and the simulation support it.
pub const FC280: Profile = Profile { name: "fc280", transport: Transport::CanOpen, ..FC302 };

/// A converter of the VLT 5000 FLUX kind on DeviceNet: 0x4000 is 100 %, all values are refreshed every 2 ms, and its
/// own time-out is at least one second, so that a rig also needs a watchdog relay.
pub const VLT5000: Profile = Profile {
    name: "vlt5000",
    transport: Transport::DeviceNet,
    device: 402,
    sort: 1,
    full_torque: 0x4000,
    timeout_ms: (1_000, 99_000),
    refresh_ns: 2_000_000,
    speed_lag: 2e-3,
    ..CIA402
};

/// All profiles.
pub const ALL: &[&Profile] = &[&CIA402, &FC302, &FC280, &VLT5000];

/// The profile of this name.
pub fn find(name: &str) -> Option<&'static Profile> {
    ALL.iter().copied().find(|profile| profile.name == name)
}

impl Profile {
    /// Text of an error code: the maker's own, or the standard's.
    pub fn error(&self, code: u16) -> &'static str {
        let own = self.errors.iter().find(|(own, _)| *own == code).map(|(_, text)| *text);
        own.unwrap_or_else(|| crate::canopen::service::error_meaning(code))
    }
}
