//! What is known of kinds of drives, as data.
//!
//! The numbers come from the makers' manuals, except where a comment calls one an assumption. What a rig says goes
//! before what stands here.

use crate::canopen::Object;

/// How a drive is reached.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Transport {
    /// CANopen, CiA 301.
    CanOpen,
    /// DeviceNet: simulated and predicted only.
    DeviceNet,
}

/// How a drive learns that we are gone.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Life {
    /// It watches our heartbeat: object 1016.
    Heartbeat,
    /// It waits for guard requests: objects 100C and 100D.
    Guarding,
}

/// How the drives that this program simulates say who they are: vendor 0, which no maker has, this device name (object 1008),
/// and this serial number (1018:4), "fric" in ASCII. What only simulated drives bear is granted to nobody else.
pub const SIMULATED: (u32, &str, u32) = (0, "fric simulated", 0x6672_6963);

/// One signal of a drive: where it is commanded, where it is read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Path {
    /// The object that takes the command, and its bits.
    pub target: (Object, u8),
    /// The object that tells what is, and its bits.
    pub actual: (Object, u8),
    /// Modes in which the drive follows it, the best one first; each with its bit in object 6502.
    pub modes: &'static [(i8, u8)],
}

/// A kind of drive.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Profile {
    /// As a rig names it.
    pub name: &'static str,
    /// How it is reached.
    pub transport: Transport,
    /// Lower word of object 1000.
    pub device: u16,
    /// Upper word of object 1000, for simulation: bit 0 frequency converter, bit 1 servo.
    pub sort: u16,
    /// Number that stands for rated torque.
    pub full_torque: i64,
    /// Torque.
    pub torque: Option<Path>,
    /// Speed.
    pub speed: Option<Path>,
    /// Position.
    pub position: Option<Path>,
    /// How it notices that we are gone, the best way first.
    pub life: &'static [Life],
    /// Least and greatest time after which it can notice, ms.
    pub timeout_ms: (u32, u32),
    /// RPDO and TPDO with its control word, target, status word and actual value where they can't be mapped anew.
    pub fixed: Option<(u8, u8)>,
    /// It takes commands and renews its answers only so often, ns; 0: at once.
    pub refresh_ns: u64,
    /// Time constant of the filter behind its speed, s: an assumption where a maker is silent.
    pub speed_lag: f64,
    /// Its own error codes.
    pub errors: &'static [(u16, &'static str)],
}

/// Any servo that follows CiA 402.
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
/// node guarding feeds. Its torque mode speaks the maker's own profile and is not offered.
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
    // RPDO2: control word and 6042. That TPDO2 holds the status word and 6044 is an assumption.
    fixed: Some((2, 2)),
    refresh_ns: 2_000_000,
    speed_lag: 2e-3,
    errors: &[(0xFF10, "control word time-out")],
};

/// A frequency converter of the FC 280 kind. Its control word lies at 2690 and its status word at 2643, both with the
/// bits of the maker's own profile, so only `predict` and simulation know it.
pub const FC280: Profile = Profile { name: "fc280", transport: Transport::CanOpen, ..FC302 };

/// A converter of the VLT 5000 FLUX kind on DeviceNet: 0x4000 is 100 %, everything is renewed each 2 ms, and its own
/// time-out takes at least a second, so that a rig needs a watchdog relay besides.
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

/// All of them.
pub const ALL: &[&Profile] = &[&CIA402, &FC302, &FC280, &VLT5000];

/// The profile of this name.
pub fn find(name: &str) -> Option<&'static Profile> {
    ALL.iter().copied().find(|profile| profile.name == name)
}

impl Profile {
    /// What an error code means: the maker's own words, or the standard's.
    pub fn error(&self, code: u16) -> &'static str {
        let own = self.errors.iter().find(|(own, _)| *own == code).map(|(_, text)| *text);
        own.unwrap_or_else(|| crate::canopen::service::error_meaning(code))
    }
}
