//! Records the traffic at our end of the buses in a cycle, and the readings that drives report in it.
//!
//! In: frames as they are handed over, and the values that the rig accepted. Out: frames sent and received, the
//! readings of each drive, and the property that a reading violates. Frames are decoded here a second time,
//! independently, because the rig's decoding is under test.

use super::broken::Broken;
use super::rigs::{FRAME_ANSWER, INERTIA, Made};
use crate::can::sim::Port;
use crate::can::{Bus, Event, Frame, Health, Received, Refused};
use crate::safety::Measured;
use abi::rig::{Kind, Mode, Node, Rig};
use std::cell::RefCell;
use std::rc::Rc;

/// COB-ID of SYNC.
const SYNC: u32 = 0x080;
/// Number of successive readings that may be implausible.
const ODD: u32 = 3;
/// Factor by which the torque on the shaft may exceed that of its drives.
const SURPLUS: f64 = 4.0;
/// Possible lag of a drive's speed behind its position, s.
const SPEED_LATE: f64 = 2e-3;
/// Number of successive cycles in which an enabled drive may report that it does not follow; the next one must have
/// caused a stop.
const SHOWN: u32 = 5;

/// Traffic at our end of the buses in one cycle.
pub struct Traffic {
    /// Frames handed to a bus: the bus, the frame, and whether the bus accepted it.
    pub sent: Vec<(usize, Frame, bool)>,
    /// Received frames: the bus, the frame, and whether it arrived after the SYNC of this cycle.
    pub came: Vec<(usize, Frame, bool)>,
    /// A bus has reported lost frames.
    pub lost: bool,
}

impl Traffic {
    /// Empty, with enough capacity for a cycle.
    pub fn new() -> Rc<RefCell<Traffic>> {
        let room = || Vec::with_capacity(1 << 10);
        Rc::new(RefCell::new(Traffic { sent: room(), came: room(), lost: false }))
    }

    /// Clears the record at the start of a cycle.
    pub fn clear(&mut self) {
        self.sent.clear();
        self.came.clear();
        self.lost = false;
    }
}

/// Our end of a bus, which records the traffic.
pub struct Tap {
    pub port: Port,
    pub bus: usize,
    pub traffic: Rc<RefCell<Traffic>>,
}

impl Bus for Tap {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        let sent = self.port.send(frame);
        self.traffic.borrow_mut().sent.push((self.bus, frame, sent.is_ok()));
        sent
    }
    fn receive(&mut self) -> Option<Received> {
        let received = self.port.receive();
        let Traffic { sent, came, lost } = &mut *self.traffic.borrow_mut();
        match received {
            Some(Received::Frame(frame, _)) => {
                let answers = sent.iter().any(|(bus, frame, _)| *bus == self.bus && frame.id() == SYNC);
                came.push((self.bus, frame, answers));
            }
            Some(Received::Event(Event::Lost(_), _)) => *lost = true,
            Some(Received::Event(..)) | None => {}
        }
        received
    }
    fn wait(&mut self, until_ns: u64) -> bool {
        self.port.wait(until_ns)
    }
    fn health(&self) -> Health {
        self.port.health()
    }
}

/// Whether a frame received on this bus can only come from another master, or from a node that the rig does not name:
/// our own frames are not received back.
pub fn is_foreign(rig: &Rig, bus: usize, frame: &Frame) -> bool {
    let named = |id: u32| {
        let on_bus = rig.nodes.iter().filter(|node| node.bus == bus);
        on_bus
            .filter_map(|node| if let Kind::Cia402(drive) = &node.kind { Some(drive.node) } else { None })
            .any(|node| u32::from(node) == id)
    };
    let node = frame.id() & 0x7F;
    match frame.id() & 0x780 {
        // NMT, SYNC.
        0x000 | 0x080 if node == 0 => true,
        // Set-points, SDO requests.
        0x200 | 0x300 | 0x400 | 0x500 | 0x600 => named(node),
        // Heartbeat.
        0x700 => !named(node),
        _ => false,
    }
}

/// A periodic reading, and the value that the rig accepts for it.
#[derive(Default)]
struct PeriodicReading {
    /// Last received value, SI.
    told: f64,
    /// It arrived in this cycle, in answer to SYNC.
    fresh: bool,
    /// It arrived in this cycle and was plausible.
    taken: bool,
    /// Greatest plausible change in one tick; infinite: not checked.
    reach: f64,
    /// Tolerance of some quantisation steps in one tick, SI: the rig allows four of them a tick.
    room: f64,
    /// Accepted value, and ticks since it arrived; none before the first check.
    believed: Option<(f64, u32)>,
    /// Number of successive implausible readings.
    odd: u32,
}

impl PeriodicReading {
    fn tell(&mut self, value: f64, fresh: bool) {
        self.told = value;
        self.fresh |= fresh;
    }

    /// Checks one cycle of the model. `quick`: a quick stop is under way.
    fn judge(&mut self, believed: f64, ticks: u32, quick: bool) -> Result<(), (Broken, String)> {
        self.taken = false;
        if !believed.is_finite() {
            return Err((Broken::Infinite, format!("{believed} is believed")));
        }
        let Some((before, since)) = self.believed else { return Ok(()) };
        let since = since.saturating_add(ticks);
        self.believed = Some((before, since));
        if !self.fresh {
            if self.reach.is_finite() && believed != before {
                return Err((Broken::Jump, format!("{believed} is believed without an answer, {before} was")));
            }
            self.believed = Some((believed, since));
            return Ok(());
        }
        let way = (self.told - before).abs();
        self.taken = self.told.is_finite() && way <= (self.reach * (1.0 + 1e-9) + self.room) * f64::from(since);
        if self.taken {
            self.odd = 0;
            // At the edge of the plausible range the rig may hold the previous value.
            self.believed = Some((believed, if believed == before { since } else { 0 }));
        } else {
            self.odd += 1;
            if believed != before {
                let text =
                    format!("{} is reported, {before} was accepted before and {believed} is accepted now", self.told);
                return Err((Broken::Jump, text));
            }
        }
        if self.odd >= ODD && !quick {
            return Err((
                Broken::Odd,
                format!("{} is reported for {} ticks, {before} is accepted", self.told, self.odd),
            ));
        }
        Ok(())
    }
}

/// Successive cycles in which a position disagrees with the drive's speed, in one direction.
#[derive(Default)]
struct Apart {
    before: Option<f64>,
    cycles: u32,
    positive: bool,
    /// Greatest speed since arming, rad/s.
    fastest: f64,
}

/// Readings of one drive.
pub struct CycleInputs {
    node: usize,
    bus: usize,
    /// Its node id; none: described by frames.
    id: Option<u32>,
    /// It is described by frames and reports its speed as a float.
    float: bool,
    mode: i8,
    word: u16,
    /// The reported mode of operation, if the drive has reported a change after arming.
    shown: Option<i8>,
    speed: PeriodicReading,
    position: PeriodicReading,
    /// Last received counts, the accumulated counts, and their origin, rad.
    counts: Option<i32>,
    turned: i64,
    base: f64,
    apart: Apart,
    /// Plausible difference between position and speed, rad/s.
    credible: f64,
    /// Number of successive cycles in which the drive does not follow.
    strays: u32,
}

impl CycleInputs {
    /// The drives of a rig before the first cycle.
    pub fn all(rig: &Rig, made: &Made) -> Vec<CycleInputs> {
        let period = rig.period_ns as f64 * 1e-9;
        let acceleration = made.most * rig.nodes.len() as f64 / INERTIA;
        let told = |(node, at): (usize, &Node)| {
            let mut told = CycleInputs {
                node,
                bus: at.bus,
                id: None,
                float: made.float,
                mode: 0,
                word: 0,
                shown: None,
                speed: PeriodicReading { reach: f64::INFINITY, ..PeriodicReading::default() },
                position: PeriodicReading::default(),
                counts: None,
                turned: 0,
                base: 0.0,
                apart: Apart::default(),
                credible: f64::INFINITY,
                strays: 0,
            };
            if let Kind::Cia402(drive) = &at.kind {
                told.id = Some(drive.node.into());
                told.mode = match drive.mode {
                    Mode::Torque => 10,
                    Mode::Speed => 9,
                    Mode::Position => 8,
                };
                (told.speed.reach, told.speed.room) = (SURPLUS * acceleration * period, 5.0 * drive.speed_unit);
                (told.position.reach, told.position.room) = (2.0 * made.speed * period, 5.0 * drive.count);
                let steps = 4.0 * (drive.speed_unit + drive.count / period);
                told.credible = acceleration * (period + SPEED_LATE) + steps;
            }
            told
        };
        rig.nodes.iter().enumerate().map(told).collect()
    }

    /// Decodes the frames of a cycle.
    pub fn take(&mut self, rig: &Rig, came: &[(usize, Frame, bool)]) {
        (self.speed.fresh, self.position.fresh) = (false, false);
        for (_, frame, fresh) in came.iter().filter(|(bus, ..)| *bus == self.bus) {
            let data = frame.data();
            let four = |at: usize| Some(i32::from_le_bytes(data.get(at..at + 4)?.try_into().ok()?));
            match (&rig.nodes[self.node].kind, self.id.map(|id| frame.id().wrapping_sub(id))) {
                (Kind::Cia402(drive), Some(0x180)) => {
                    let (Some(speed), [low, high, ..]) = (four(4), data) else { continue };
                    self.word = u16::from_le_bytes([*low, *high]);
                    self.speed.tell(f64::from(speed) * drive.speed_unit, *fresh);
                }
                (Kind::Cia402(drive), Some(0x280)) => {
                    let Some(counts) = four(0) else { continue };
                    self.turned += i64::from(counts.wrapping_sub(self.counts.unwrap_or(counts)));
                    self.counts = Some(counts);
                    self.position.tell(self.base + self.turned as f64 * drive.count, *fresh);
                }
                (Kind::Cia402(_), Some(0x380)) if data.len() == 3 => self.shown = Some(data[0] as i8),
                (Kind::Frames(_), _) if frame.id() == FRAME_ANSWER => {
                    let Some(number) = four(0) else { continue };
                    let number = if self.float { f32::from_bits(number as u32).into() } else { f64::from(number) };
                    self.speed.tell(number * 1e-3, *fresh);
                    // A finite value in between: the next NaN counts as the first.
                    self.speed.odd = if number.is_finite() { 0 } else { self.speed.odd };
                }
                _ => {}
            }
        }
    }

    /// Checks one cycle of the model, up to the cycle that stops the rig. `first`: the first cycle; `time`: ticks and
    /// their period, s; `stops`, `quick`: a stop is under way, and it is a quick stop.
    pub fn judge(
        &mut self,
        first: bool,
        seen: Measured,
        time: (u32, f64),
        (stops, quick): (bool, bool),
    ) -> Result<(), (Broken, String)> {
        let node = self.node;
        if first {
            // The start-up has checked the mode.
            self.shown = None;
        }
        if let (true, true, Some(position)) = (first, self.position.fresh, seen.position) {
            // Takes over the rig's origin of the position; the rig accepts any reading in this cycle.
            self.base += position - self.position.told;
            self.position.told = position;
        }
        for (line, believed) in [(&mut self.speed, seen.speed), (&mut self.position, seen.position)] {
            let Some(believed) = believed else { continue };
            if first {
                line.believed = line.fresh.then_some((believed, 0));
                (line.odd, line.taken) = (0, false);
                continue;
            }
            line.judge(believed, time.0, quick).map_err(|(broken, text)| (broken, format!("node {node}: {text}")))?;
        }
        self.judge_pair(time, quick).map_err(|text| (Broken::Agree, format!("node {node}: {text}")))?;
        let enabled = self.word & 0x6F == 0x27;
        let follows = self.word & 1 << 12 != 0 && self.shown.is_none_or(|shown| shown == self.mode);
        self.strays = if self.id.is_some() && enabled && !follows { self.strays + 1 } else { 0 };
        if self.strays > SHOWN && !stops {
            let text = format!("node {node} shows status {:04X} and mode {:?}", self.word, self.shown);
            return Err((Broken::Shown, text));
        }
        Ok(())
    }

    fn judge_pair(&mut self, (ticks, period): (u32, f64), quick: bool) -> Result<(), String> {
        let Apart { before, cycles, positive, fastest } = &mut self.apart;
        let (speed, position) = (&self.speed, &self.position);
        let Some(from) = before.replace(position.told).filter(|_| speed.taken && position.taken) else {
            (*before, *cycles) = (Some(position.told).filter(|_| speed.taken && position.taken), 0);
            return Ok(());
        };
        *fastest = fastest.max(speed.told.abs());
        let span = period * f64::from(ticks);
        let beyond = position.told - from - speed.told * span;
        // The time of a reading within its period is unknown: over three ticks that amounts to a third of the speed.
        let apart = beyond.abs() > 1.05 * (self.credible * span + *fastest * period / 3.0);
        *cycles = match apart {
            true if *cycles > 0 && *positive == (beyond > 0.0) => *cycles + 1,
            apart => u32::from(apart),
        };
        *positive = beyond > 0.0;
        if *cycles >= ODD && !quick {
            let turns = (position.told - from) / span;
            return Err(format!("its position turns by {turns:.3} rad/s and its speed is {:.3} rad/s", speed.told));
        }
        Ok(())
    }
}
