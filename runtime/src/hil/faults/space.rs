//! The space of faults: which frame or node, which fault, in which phase, for how long, and in which combination.
//!
//! In: a seed, or two faults of an exhaustive list. Out: a [`Script`], which determines one run completely. Its
//! `Display` text is Rust: it can be pasted into `scripts.rs` as a test.

use super::rigs::{FRAME_ANSWER, FRAME_COMMAND, Made, PLAIN, Sort};
use crate::drive::Effect;
use crate::hil::simulated::{BENCH, MASTER};
use crate::rng::Chance;
use std::fmt;

pub const MS: u64 = 1_000_000;
/// Duration of a permanent fault.
pub const EVER: u64 = u64::MAX;

/// Parameters of one run.
#[derive(Clone, PartialEq, Debug)]
pub struct Script {
    /// Seed of the buses' random faults and of the encoders.
    pub seed: u64,
    pub rig: Made,
    /// The start-up checks time-outs and signs of the drives.
    pub tested: bool,
    /// A second program takes over the rig after the stop.
    pub again: bool,
    /// Number of sets of parameters that are submitted at once.
    pub sets: u32,
    /// Whether it is started with options for simulated drives only.
    pub only: Only,
    pub faults: Vec<Fault>,
}

/// Whether a rig is started with options for simulated drives only, and which identity its first drive claims.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Only {
    /// Without such options.
    Any,
    /// With such options, and its drives are simulated.
    Simulated,
    /// With such options, and its first drive claims another vendor.
    OtherVendor,
    /// With such options, and its first drive claims another name.
    OtherName,
    /// With such options, and another device answers for its first drive when the second program starts.
    OtherLater,
}

/// One fault.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Fault {
    pub what: What,
    pub phase: Phase,
    /// Time from the begin of the phase to the fault, ns.
    pub after: u64,
    /// Duration, ns; [`EVER`] if permanent.
    pub lasts: u64,
}

/// The phase in which a fault begins.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Phase {
    /// Before any request to the drives.
    StartUp,
    /// SYNC has begun, the drives are about to be enabled.
    Enabling,
    /// Armed, at zero command.
    Rest,
    /// Armed, in motion.
    Moving,
    /// A set of parameters has just been submitted.
    Change,
    /// A stop has just been requested.
    Stopping,
    /// Another program has just taken over the buses.
    Again,
}

impl Phase {
    /// All phases, the simplest first.
    pub const ALL: [Phase; 7] =
        [Phase::Moving, Phase::Rest, Phase::Change, Phase::Stopping, Phase::StartUp, Phase::Enabling, Phase::Again];
}

/// Fault of a frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ill {
    /// The queue of its sender refuses it.
    Refused,
    /// It never reaches the bus.
    Lost,
    /// It is delayed by this time, ns.
    Late(u64),
    Doubled,
    /// It arrives after the frame that follows it.
    Swapped,
    /// One bit is wrong, under a valid checksum.
    Corrupted,
    /// Its data are those of the first frame hit by the fault.
    Stale,
    /// It is disturbed on the bus: error frames, and a retransmission.
    Disturbed,
}

impl Ill {
    pub const ALL: [Ill; 8] = [
        Ill::Refused,
        Ill::Lost,
        Ill::Late(1_500_000),
        Ill::Doubled,
        Ill::Swapped,
        Ill::Corrupted,
        Ill::Stale,
        Ill::Disturbed,
    ];
}

/// The part that fails.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum What {
    /// Frames with this identifier, on this bus.
    Frame(usize, u32, Ill),
    /// A node of the rig.
    Node(usize, Effect),
    /// Short circuit of the two wires of a bus.
    Short(usize),
    /// Our connector is unplugged from a bus.
    Unplugged(usize),
    /// The drives' connector is unplugged from a bus.
    Alone(usize),
    /// Our interface goes down and stays down.
    Down(usize),
    /// A node sends the frame of highest priority without a pause ("babbling idiot").
    Babble(usize),
    /// A foreign node sends this frame once.
    Foreign(usize, u32),
    /// Cycles pause for this time, ns, again and again for the duration of the fault.
    Frozen(u64),
    /// Our queue of a bus loses this percentage of the received frames.
    Overrun(usize, u8),
    /// A node described by frames sends a value that is not finite: −1 and 1 for infinities, 0 for NaN.
    NoNumber(usize, i8),
}

/// All frames of a rig by bus and identifier, those of each cycle first; and the number of frames of each cycle.
pub fn frames(sort: Sort) -> (Vec<(usize, u32)>, usize) {
    let drives: &[(usize, u32)] = match sort {
        Sort::One | Sort::FramesServo => &[(0, 3)],
        Sort::Pair | Sort::SpeedServo | Sort::PositionServo => &[(0, 3), (0, 4)],
        Sort::TwoBuses => &[(0, 3), (1, 4)],
    };
    let buses = if sort == Sort::TwoBuses { 2 } else { 1 };
    let (mut steady, mut seldom) = (Vec::new(), Vec::new());
    for &(bus, node) in drives {
        // Set-point, the two answers, heartbeat; mode and error, emergency, SDO request and answer.
        steady.extend([0x200, 0x180, 0x280, 0x700].map(|base| (bus, base + node)));
        seldom.extend([0x380, 0x080, 0x600, 0x580].map(|base| (bus, base + node)));
    }
    for bus in 0..buses {
        // SYNC, our heartbeat; NMT.
        steady.extend([(bus, 0x080), (bus, 0x77F)]);
        seldom.push((bus, 0x000));
    }
    if sort == Sort::FramesServo {
        steady.extend([(0, FRAME_COMMAND), (0, FRAME_ANSWER)]);
    }
    let often = steady.len();
    steady.append(&mut seldom);
    (steady, often)
}

/// Name of the node that sends a frame.
pub fn sender(id: u32) -> &'static str {
    match id {
        0x000 | 0x080 | 0x77F | 0x200..=0x27F | 0x600..=0x67F | FRAME_COMMAND => MASTER,
        _ => BENCH,
    }
}

impl Script {
    /// The reference rig without a fault.
    pub fn plain(sort: Sort) -> Script {
        let rig = Made { sort, ..PLAIN };
        Script { seed: 1, rig, tested: false, again: false, sets: 1, only: Only::Any, faults: Vec::new() }
    }

    /// The run of a seed.
    pub fn of(seed: u64) -> Script {
        let mut chance = Chance(seed);
        let mut rig = rig(&mut chance);
        let tested = chance.below(8) == 0;
        let count = [1, 1, 1, 2, 2, 3][chance.below(6) as usize];
        let mut faults: Vec<Fault> = (0..count).map(|_| fault(&mut chance, rig.sort)).collect();
        // The wrong sign of a torque shows only where the torque may brake, at a speed below the speed limit.
        if faults.iter().any(|fault| matches!(fault.what, What::Node(_, Effect::TorqueScale(_))))
            && chance.below(2) == 0
        {
            (rig.speed, rig.damping, rig.eager) = (chance.between(20.0, 60.0), 0.1, true);
        }
        // Repeated missed ticks, fewer at a time than the rig tolerates.
        if let Some(fault) = faults.iter_mut().find(|fault| matches!(fault.what, What::Frozen(_)))
            && chance.below(2) == 0
        {
            rig.hold = 1 + chance.below(3) as u32;
            (fault.what, fault.lasts) = (What::Frozen(1_600_000), EVER);
        }
        let again = faults.iter().any(|fault| fault.phase == Phase::Again) || chance.below(16) == 0;
        let sets = [1, 1, 3, 40][chance.below(4) as usize];
        let only = match chance.below(32) {
            0 => Only::OtherVendor,
            1 => Only::OtherName,
            2..=5 => Only::Simulated,
            6 => Only::OtherLater,
            _ => Only::Any,
        };
        let again = again || only == Only::OtherLater;
        // Drawn last, so that older seeds keep most of their parameters.
        rig.float = rig.sort == Sort::FramesServo && chance.below(2) == 0;
        let bus = if rig.sort == Sort::TwoBuses { chance.below(2) as usize } else { 0 };
        match chance.below(16) {
            0 => faults[0].what = What::Overrun(bus, pick(&mut chance, &[30, 50, 70, 100])),
            1..8 if rig.float => faults[0].what = What::NoNumber(1, pick(&mut chance, &[-1, 0, 1])),
            _ => {}
        }
        Script { seed, rig, tested, again, sets, only, faults }
    }
}

fn pick<T: Copy>(chance: &mut Chance, from: &[T]) -> T {
    from[chance.below(from.len() as u64) as usize]
}

/// Half of the rigs are the reference rig, so that a failure does not depend on an unusual rig.
fn rig(chance: &mut Chance) -> Made {
    let sort = Sort::ALL[[0, 0, 0, 1, 2, 3, 4, 5][chance.below(8) as usize]];
    let mut made = Made { sort, ..PLAIN };
    made.swing = chance.between(0.3, 0.98);
    made.hertz = chance.between(1.0, 6.0);
    if chance.below(2) == 0 {
        return made;
    }
    made.damping = chance.between(-0.01, 0.1);
    // Most limits lie between two quantisation steps.
    (made.rated, made.most) = pick(chance, &[(4.0, 2.0), (3.0, 1.0), (3.0, 0.2), (0.7, 0.5), (10.0, 7.77)]);
    made.slew = pick(chance, &[0.0, 0.0, 20.0, 100.0, 1000.0]);
    made.hold = pick(chance, &[0, 1, 2, 3]);
    made.at_sync = chance.below(3) == 0;
    made.eager = chance.below(3) == 0;
    made.far = sort == Sort::PositionServo && chance.below(4) == 0;
    match chance.below(10) {
        5 => made.safe = chance.between(0.1, 0.5),
        0 => made.swing = chance.between(1.5, 4.0),
        1 => made.speed = chance.between(2.0, 12.0),
        2 => made.travel = chance.between(0.02, 0.4),
        3 => made.power = chance.between(0.2, 2.0),
        4 => made.no_number = chance.between(0.001, 0.2),
        _ => {}
    }
    made
}

fn fault(chance: &mut Chance, sort: Sort) -> Fault {
    // Motion has a higher weight, because most can happen in it.
    let phase = if chance.below(4) == 0 { Phase::Moving } else { pick(chance, &Phase::ALL) };
    let what = match chance.below(16) {
        0..=10 => frame_fault(chance, sort, phase),
        11..=13 => node_fault(chance, sort),
        _ => bus_fault(chance, sort),
    };
    let after = match phase {
        Phase::StartUp => chance.below(120) * MS,
        Phase::Enabling | Phase::Again => chance.below(80) * MS,
        Phase::Rest => chance.below(15) * MS,
        Phase::Moving => chance.below(30) * MS,
        Phase::Change | Phase::Stopping => chance.below(4) * MS,
    } + chance.below(4) * MS / 4;
    let lasts = pick(chance, &[1, 2, 3, 5, 10, 40, 0, 0]) * MS;
    Fault { what, phase, after, lasts: if lasts == 0 { EVER } else { lasts } }
}

fn frame_fault(chance: &mut Chance, sort: Sort, phase: Phase) -> What {
    let (all, often) = frames(sort);
    let whole = matches!(phase, Phase::StartUp | Phase::Enabling | Phase::Again) || chance.below(6) == 0;
    let commands = |(_, id): &&(usize, u32)| (0x200..0x280).contains(id) || *id == FRAME_COMMAND;
    let commands: Vec<(usize, u32)> = all.iter().filter(commands).copied().collect();
    let (bus, id) = match chance.below(4) {
        0 => pick(chance, &commands),
        _ => pick(chance, if whole { &all } else { &all[..often] }),
    };
    let ill = match pick(chance, &Ill::ALL) {
        Ill::Late(_) => {
            let most = pick(chance, &[800, 3_000, 20_000]);
            Ill::Late((1 + chance.below(most)) * 1_000)
        }
        ill => ill,
    };
    What::Frame(bus, id, ill)
}

fn node_fault(chance: &mut Chance, sort: Sort) -> What {
    let nodes = if matches!(sort, Sort::One | Sort::FramesServo) { 1 } else { 2 };
    let effect = match chance.below(18) {
        0 => Effect::Emergency(0x2310),
        1 => Effect::Fault(0x3210),
        2 => Effect::PreOperational,
        3 => Effect::Reset,
        4 => Effect::NoHeartbeat,
        5 => Effect::ModeShown(4),
        6 => Effect::EncoderFrozen,
        7 => Effect::EncoderGlitch(chance.below(1 << 20) as i64),
        8 => Effect::EncoderLost(chance.below(1 << 18) as i64),
        9 => Effect::EncoderScale(chance.between(-2.0, 3.0)),
        10 => Effect::SpeedScale(chance.between(-2.0, 3.0)),
        11 => Effect::TorqueToldScale(chance.between(-2.0, 3.0)),
        12 => Effect::TorqueScale(-1.0),
        13 => Effect::AnswersLate(chance.below(5_000_000)),
        14 => Effect::NoAnswers,
        15 => Effect::IgnoresCommands,
        16 => Effect::SafeTorqueOff,
        _ => Effect::Silent,
    };
    What::Node(chance.below(nodes) as usize, effect)
}

fn bus_fault(chance: &mut Chance, sort: Sort) -> What {
    let bus = if sort == Sort::TwoBuses { chance.below(2) as usize } else { 0 };
    match chance.below(8) {
        0 => What::Short(bus),
        1 => What::Unplugged(bus),
        2 => What::Alone(bus),
        3 => What::Down(bus),
        4 => What::Babble(bus),
        5 => {
            // To the drive of this bus: set-points of each PDO number, an SDO request.
            let node = 3 + bus as u32;
            let to_drive = [0x200, 0x300, 0x400, 0x500, 0x600].map(|base| base + node);
            What::Foreign(bus, pick(chance, &[&[0x080, 0x000, 0x77E][..], &to_drive].concat()))
        }
        _ => {
            let most = pick(chance, &[2, 3, 12]);
            What::Frozen(chance.below(most) * MS + chance.below(1000) * 1000)
        }
    }
}

impl fmt::Display for Script {
    /// The script as a test that can be pasted into `scripts.rs`.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "#[test]\nfn found_with_seed_{}() {{", self.seed)?;
        let faults: Vec<String> = self.faults.iter().map(ToString::to_string).collect();
        let rig = self.rig.to_string();
        writeln!(f, "    holds(&Script {{")?;
        writeln!(f, "        seed: {},\n        rig: {rig},", self.seed)?;
        writeln!(f, "        tested: {},\n        again: {},\n        sets: {},", self.tested, self.again, self.sets)?;
        writeln!(f, "        only: Only::{:?},", self.only)?;
        writeln!(f, "        faults: vec![{}],", faults.join(", "))?;
        write!(f, "    }});\n}}")
    }
}

impl fmt::Display for Made {
    /// Only the fields that differ from the reference rig.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let mut parts = Vec::new();
        if self.sort != PLAIN.sort {
            parts.push(format!("sort: {:?}", self.sort));
        }
        let numbers = |made: &Made| {
            let Made { swing, hertz, damping, rated, most, slew, speed, travel, power, no_number, .. } = *made;
            [swing, hertz, damping, rated, most, slew, speed, travel, power, no_number]
        };
        let names = ["swing", "hertz", "damping", "rated", "most", "slew", "speed", "travel", "power", "no_number"];
        for ((name, value), plain) in names.iter().zip(numbers(self)).zip(numbers(&PLAIN)) {
            if value != plain {
                parts.push(format!("{name}: {value:?}"));
            }
        }
        if self.hold != PLAIN.hold {
            parts.push(format!("hold: {}", self.hold));
        }
        if self.safe != PLAIN.safe {
            parts.push(format!("safe: {:?}", self.safe));
        }
        if self.far {
            parts.push("far: true".into());
        }
        if self.eager {
            parts.push("eager: true".into());
        }
        if self.at_sync {
            parts.push("at_sync: true".into());
        }
        if self.float {
            parts.push("float: true".into());
        }
        if parts.is_empty() {
            return f.write_str("PLAIN");
        }
        write!(f, "Made {{ {}, ..PLAIN }}", parts.join(", "))
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let what = match self.what {
            What::Frame(bus, id, ill) => format!("Frame({bus}, 0x{id:03X}, {ill:?})"),
            What::Foreign(bus, id) => format!("Foreign({bus}, 0x{id:03X})"),
            what => format!("{what:?}"),
        };
        let lasts = if self.lasts == EVER { "EVER".to_string() } else { self.lasts.to_string() };
        write!(f, "Fault {{ what: {what}, phase: {:?}, after: {}, lasts: {lasts} }}", self.phase, self.after)
    }
}
