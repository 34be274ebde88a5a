//! The space of faults: which frame, what happens to it, in which phase, for how long, together with which others.
//!
//! In: a seed, or two faults of an exhaustive list. Out: a [`Script`], which says all of one run. Its text is Rust: it can
//! be pasted into `scripts.rs` as a test.

use super::rigs::{FRAME_ANSWER, FRAME_COMMAND, Made, PLAIN, Sort};
use crate::drive::Effect;
use crate::hil::simulated::{BENCH, MASTER};
use crate::rng::Chance;
use std::fmt;

pub const MS: u64 = 1_000_000;
/// A fault that stays.
pub const EVER: u64 = u64::MAX;

/// One run.
#[derive(Clone, PartialEq, Debug)]
pub struct Script {
    /// Of the buses' chance and of the encoders.
    pub seed: u64,
    pub rig: Made,
    /// Time-outs and signs of the drives are tested in the start-up.
    pub tested: bool,
    /// A second program takes the rig over after the stop.
    pub again: bool,
    /// Sets of parameters that are handed over at once.
    pub sets: u32,
    /// It is started as for simulated drives only.
    pub only: Only,
    pub faults: Vec<Fault>,
}

/// Whether a rig is started with what only simulated drives may have.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Only {
    /// No.
    Any,
    /// Yes, and its drives are simulated.
    Simulated,
    /// Yes, and its first drive says another vendor.
    OtherVendor,
    /// Yes, and its first drive says another name.
    OtherName,
    /// Yes, and another device answers for its first drive when the second program starts.
    OtherLater,
}

/// One fault.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Fault {
    pub what: What,
    pub phase: Phase,
    /// From the begin of the phase to the fault, ns.
    pub after: u64,
    /// How long, ns; [`EVER`].
    pub lasts: u64,
}

/// When.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Phase {
    /// Before the drives are asked anything.
    StartUp,
    /// SYNC has begun, the drives are about to be enabled.
    Enabling,
    /// Armed, at zero command.
    Rest,
    /// Armed, under way.
    Moving,
    /// A set of parameters has just been handed over.
    Change,
    /// A stop has just been asked for.
    Stopping,
    /// Another program has just taken over the buses.
    Again,
}

impl Phase {
    /// The simplest first.
    pub const ALL: [Phase; 7] =
        [Phase::Moving, Phase::Rest, Phase::Change, Phase::Stopping, Phase::StartUp, Phase::Enabling, Phase::Again];
}

/// What happens to a frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ill {
    /// The queue of its sender does not take it.
    Refused,
    /// It never reaches the line.
    Lost,
    /// It comes so much later, ns.
    Late(u64),
    Doubled,
    /// It comes after the frame that follows it.
    Swapped,
    /// One bit of it is wrong, and the checksum agrees.
    Corrupted,
    /// Its data are those of the first one that was struck.
    Stale,
    /// Disturbed on the line: error frames, and the frame again.
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

/// Who or what fails.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum What {
    /// Frames with this identifier, on this bus.
    Frame(usize, u32, Ill),
    /// A node of the rig.
    Node(usize, Effect),
    /// The two wires of a bus touch.
    Short(usize),
    /// Our plug is out of a bus.
    Unplugged(usize),
    /// The plug of the drives is out of a bus.
    Alone(usize),
    /// Our interface goes down and stays so.
    Down(usize),
    /// A node sends the most urgent frame without a pause.
    Babble(usize),
    /// Somebody else sends this frame, once.
    Foreign(usize, u32),
    /// No cycle for so long, ns, again and again as long as it lasts.
    Frozen(u64),
    /// Our queue of a bus loses so many percent of what comes.
    Overrun(usize, u8),
    /// A node that is described by frames tells no number: −1, 1 infinite, 0 none at all.
    NoNumber(usize, i8),
}

/// All frames of a rig by bus and identifier, those of each cycle first; the number of these comes second.
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
        // SYNC, our heartbeat; network management.
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

/// Who sends a frame.
pub fn sender(id: u32) -> &'static str {
    match id {
        0x000 | 0x080 | 0x77F | 0x200..=0x27F | 0x600..=0x67F | FRAME_COMMAND => MASTER,
        _ => BENCH,
    }
}

impl Script {
    /// The plain rig without a fault.
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
        // A torque of the wrong sign shows where it may brake: slowly enough for its speed not to be the limit.
        if faults.iter().any(|fault| matches!(fault.what, What::Node(_, Effect::TorqueScale(_))))
            && chance.below(2) == 0
        {
            (rig.speed, rig.damping, rig.eager) = (chance.between(20.0, 60.0), 0.1, true);
        }
        // Ticks that are missed again and again, fewer at a time than the rig bears.
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
        // Drawn last, so that the seeds before these faults came keep most of what they gave.
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

/// Half of them plain, so that what is found does not hide in an odd rig.
fn rig(chance: &mut Chance) -> Made {
    let sort = Sort::ALL[[0, 0, 0, 1, 2, 3, 4, 5][chance.below(8) as usize]];
    let mut made = Made { sort, ..PLAIN };
    made.swing = chance.between(0.3, 0.98);
    made.hertz = chance.between(1.0, 6.0);
    if chance.below(2) == 0 {
        return made;
    }
    made.damping = chance.between(-0.01, 0.1);
    // Most limits lie between two steps of the wire.
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
    // Motion is where most can happen.
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
            // To the drive of this bus: set-points of each number, a request for an object.
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
    /// As a test that can be pasted into `scripts.rs`.
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
    /// Only what differs from the plain rig.
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
