//! The record of a cycle as words: written by the cycle, read by replays and exports.
//!
//! In: the numbers of a cycle. Out: messages of a log, and the numbers again. Writing allocates nothing once its buffer
//! has grown.

use super::control::{Control, Options, Reading, Source};
use super::origin::Origin;
use super::watches::Bounds;
use crate::can::Frame;
use crate::safety::{Cause, Clamps, DriveCommand};
use abi::Slot;
use abi::rig::Rig;

pub use crate::record::log::{CYCLE, STATE};
/// Kind of message: frames of a cycle.
pub const FRAMES: u32 = 3;
/// Kind of message: words of an operator.
pub const MARK: u32 = 5;

/// Kind of message: a command that was carried out, and who gave it. It stands before the cycle that took it, and before
/// the words of a mark.
pub const COMMAND: u32 = 6;

/// Commands, by their names, in the order of their numbers in a log.
const COMMANDS: [&str; 5] = ["enable", "arm", "stop", "set", "mark"];

/// Appends a command that was carried out, by its name, and who gave it.
pub fn write_command(due_ns: u64, name: &str, origin: Origin, words: &mut Vec<u64>) {
    let number = COMMANDS.iter().position(|other| *other == name).unwrap_or(COMMANDS.len());
    words.extend([due_ns, number as u64, origin.number()]);
}

/// Time in ns and name of a command, and who gave it; none if it is of another version.
pub fn read_command(words: &[u64]) -> Option<(u64, &'static str, Origin)> {
    let [due_ns, number, origin] = words else { return None };
    Some((*due_ns, COMMANDS.get(usize::try_from(*number).ok()?)?, Origin::of(*origin)?))
}

/// Appends a mark as words: its time in ns, its length in bytes, its bytes.
pub fn write_mark(due_ns: u64, bytes: &[u8], words: &mut Vec<u64>) {
    words.extend([due_ns, bytes.len() as u64]);
    for piece in bytes.chunks(8) {
        let mut word = [0; 8];
        word[..piece.len()].copy_from_slice(piece);
        words.push(u64::from_le_bytes(word));
    }
}

/// Time in ns and words of a mark; none if it is not one.
pub fn read_mark(words: &[u64]) -> Option<(u64, String)> {
    let [due_ns, length, rest @ ..] = words else { return None };
    let mut bytes: Vec<u8> = rest.iter().flat_map(|word| word.to_le_bytes()).collect();
    let length = usize::try_from(*length).ok().filter(|length| *length <= bytes.len())?;
    bytes.truncate(length);
    Some((*due_ns, String::from_utf8(bytes).ok()?))
}

/// The record of one cycle.
#[derive(Clone, PartialEq, Debug)]
pub struct Cycle {
    /// Its number, from 0.
    pub k: u64,
    /// Time of its tick, ns since the start.
    pub due_ns: u64,
    /// Delay of its start, ns.
    pub late_ns: u32,
    /// Durations of receiving, computing and sending, ns.
    pub phases_ns: [u32; 3],
    /// Ticks since the last cycle.
    pub ticks: u32,
    /// Source of the requests.
    pub source: Source,
    /// The drive command.
    pub order: DriveCommand,
    /// The supervisor was armed just before this cycle.
    pub arms: bool,
    /// Step of the start-up.
    pub step: u8,
    /// Status word of each drive that moves.
    pub statuses: Vec<u16>,
    /// Readings.
    pub readings: Vec<Reading>,
    /// Requests of the start-up; empty if it requests nothing.
    pub wanted: Vec<f64>,
    /// Requests.
    pub requests: Vec<f64>,
    /// Permitted outputs.
    pub permitted: Vec<f64>,
    /// Reasons why these differ.
    pub clamps: Vec<Clamps>,
    /// Causes reported by other parts.
    pub causes: Vec<Cause>,
    /// Parameters that changed.
    pub set: Vec<(Slot, f64)>,
    /// Additional quantities that the rig records, SI.
    pub recorded: Vec<f64>,
}

/// Lengths of the lists of a cycle, which its words do not contain.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Shape {
    /// Signals that are read.
    pub signals: usize,
    /// Outputs.
    pub outputs: usize,
    /// Drives that move.
    pub drives: usize,
    /// Quantities that the rig records.
    pub recorded: usize,
}

impl Shape {
    /// The shape of a rig.
    pub fn of(rig: &Rig, control: &Control) -> Shape {
        Shape {
            signals: control.signals().len(),
            outputs: rig.outputs.len(),
            drives: rig.nodes.iter().filter(|node| node.moves).count(),
            recorded: rig.record.len(),
        }
    }
}

fn source_number(source: Source) -> u64 {
    match source {
        Source::Nobody => 0,
        Source::StartUp => 1,
        Source::Model => 2,
    }
}

/// A drive command as a number.
pub(super) fn order_number(order: DriveCommand) -> u64 {
    match order {
        DriveCommand::Wait => 0,
        DriveCommand::Follow => 1,
        DriveCommand::QuickStop => 2,
        DriveCommand::Disable => 3,
    }
}

/// Packs numbers of `bits` bits each, as many into a word as fit.
fn pack(words: &mut Vec<u64>, bits: u32, numbers: impl Iterator<Item = u64>) {
    let each = (64 / bits) as usize;
    for (i, number) in numbers.enumerate() {
        if i % each == 0 {
            words.push(0);
        }
        *words.last_mut().expect("a word was just begun") |= number << (bits * (i % each) as u32);
    }
}

impl Cycle {
    /// An empty record of this shape, to be filled again and again.
    pub fn new(shape: Shape) -> Cycle {
        Cycle {
            k: 0,
            due_ns: 0,
            late_ns: 0,
            phases_ns: [0; 3],
            ticks: 1,
            source: Source::Nobody,
            order: DriveCommand::Wait,
            arms: false,
            step: 0,
            statuses: vec![0; shape.drives],
            readings: vec![Reading { value: 0.0, age: Reading::NEVER }; shape.signals],
            wanted: Vec::with_capacity(shape.outputs),
            requests: vec![0.0; shape.outputs],
            permitted: vec![0.0; shape.outputs],
            clamps: vec![Clamps::default(); shape.outputs],
            causes: Vec::with_capacity(64),
            set: Vec::with_capacity(super::live::SET_MOST),
            recorded: vec![0.0; shape.recorded],
        }
    }

    /// Appends the record as words.
    #[cfg_attr(rtsan, sanitize(realtime = "nonblocking"))]
    pub fn write(&self, words: &mut Vec<u64>) {
        let [receive, compute, send] = self.phases_ns.map(u64::from);
        words.extend([self.k, self.due_ns, u64::from(self.late_ns) | u64::from(self.ticks) << 32]);
        words.push(receive | compute << 32);
        let (source, order) = (source_number(self.source), order_number(self.order));
        words.push(send | source << 32 | order << 40 | u64::from(self.step) << 48 | u64::from(self.arms) << 56);
        words.push(self.causes.len() as u64 | (self.set.len() as u64) << 16 | (self.wanted.len() as u64) << 32);
        words.extend(self.readings.iter().map(|reading| reading.value.to_bits()));
        let ages = self.readings.iter().map(|reading| match reading.age {
            Reading::NEVER => 0xffff,
            age => u64::from(age.min(0xfffe)),
        });
        pack(words, 16, ages);
        pack(words, 16, self.statuses.iter().map(|status| u64::from(*status)));
        let numbers = self.wanted.iter().chain(&self.requests).chain(&self.permitted).chain(&self.recorded);
        words.extend(numbers.map(|value| value.to_bits()));
        pack(words, 8, self.clamps.iter().map(|clamps| u64::from(clamps.0)));
        words.extend(self.causes.iter().flat_map(|cause| cause.to_words()));
        words.extend(self.set.iter().flat_map(|(slot, value)| [u64::from(slot.0), value.to_bits()]));
    }

    /// Decodes words. None if they are not those of a cycle of this shape.
    pub fn read(shape: Shape, words: &[u64]) -> Option<Cycle> {
        let mut words = words.iter().copied();
        let mut next = || words.next();
        let (k, due_ns, third, fourth, fifth, counts) = (next()?, next()?, next()?, next()?, next()?, next()?);
        let low = |word: u64| (word & 0xffff_ffff) as u32;
        let high = |word: u64| (word >> 32) as u32;
        let (n_causes, n_set, n_wanted) = (counts & 0xffff, counts >> 16 & 0xffff, counts >> 32 & 0xffff);
        let values = (0..shape.signals).map(|_| next()).collect::<Option<Vec<u64>>>()?;
        let ages = unpack(&mut next, 16, shape.signals)?;
        let statuses = unpack(&mut next, 16, shape.drives)?;
        let mut floats = |n: usize| (0..n).map(|_| next().map(f64::from_bits)).collect::<Option<Vec<f64>>>();
        let (wanted, requests) = (floats(n_wanted as usize)?, floats(shape.outputs)?);
        let (permitted, recorded) = (floats(shape.outputs)?, floats(shape.recorded)?);
        let clamps = unpack(&mut next, 8, shape.outputs)?;
        let causes = (0..n_causes).map(|_| Cause::from_words([next()?, next()?])).collect::<Option<_>>()?;
        let set = (0..n_set)
            .map(|_| Some((Slot(u32::try_from(next()?).ok()?), f64::from_bits(next()?))))
            .collect::<Option<_>>()?;
        let whole = Cycle {
            k,
            due_ns,
            late_ns: low(third),
            phases_ns: [low(fourth), high(fourth), low(fifth)],
            ticks: high(third),
            source: match fifth >> 32 & 0xff {
                0 => Source::Nobody,
                1 => Source::StartUp,
                2 => Source::Model,
                _ => return None,
            },
            order: match fifth >> 40 & 0xff {
                0 => DriveCommand::Wait,
                1 => DriveCommand::Follow,
                2 => DriveCommand::QuickStop,
                3 => DriveCommand::Disable,
                _ => return None,
            },
            arms: fifth >> 56 & 1 == 1,
            step: (fifth >> 48 & 0xff) as u8,
            statuses: statuses.iter().map(|status| *status as u16).collect(),
            readings: values
                .iter()
                .zip(ages)
                .map(|(value, age)| Reading {
                    value: f64::from_bits(*value),
                    age: if age == 0xffff { Reading::NEVER } else { age as u32 },
                })
                .collect(),
            wanted,
            requests,
            permitted,
            clamps: clamps.iter().map(|bits| Clamps(*bits as u8)).collect(),
            causes,
            set,
            recorded,
        };
        next().is_none().then_some(whole)
    }
}

fn unpack(next: &mut impl FnMut() -> Option<u64>, bits: u32, n: usize) -> Option<Vec<u64>> {
    let each = (64 / bits) as usize;
    let mut out = Vec::with_capacity(n);
    while out.len() < n {
        let word = next()?;
        for i in 0..each.min(n - out.len()) {
            out.push(word >> (bits * i as u32) & ((1 << bits) - 1));
        }
    }
    Some(out)
}

/// A frame on a bus of the rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Passed {
    /// ns since the start.
    pub stamp_ns: u64,
    /// Index of the bus.
    pub bus: u8,
    /// Sent by us, not received.
    pub sent: bool,
    /// The frame.
    pub frame: Frame,
}

impl Passed {
    /// Appends the frame as three words.
    pub fn write(&self, words: &mut Vec<u64>) {
        let frame = self.frame;
        let flags = u64::from(frame.is_extended()) | u64::from(frame.is_remote()) << 1 | u64::from(self.sent) << 2;
        let mut data = [0; 8];
        data[..frame.data().len()].copy_from_slice(frame.data());
        let length = u64::from(frame.length());
        words.extend([
            self.stamp_ns,
            u64::from(frame.id()) | flags << 32 | length << 40 | u64::from(self.bus) << 48,
            u64::from_le_bytes(data),
        ]);
    }

    /// Decodes all frames of a message. None if the words are not frames.
    pub fn read(words: &[u64]) -> Option<Vec<Passed>> {
        let (all, rest) = words.as_chunks::<3>();
        let one = |[stamp_ns, head, data]: &[u64; 3]| {
            let (id, length) = ((head & 0xffff_ffff) as u32, (head >> 40 & 0xff) as usize);
            let [extended, remote, sent] = [0, 1, 2].map(|bit| head >> (32 + bit) & 1 == 1);
            if length > 8 || id >= if extended { 1 << 29 } else { 0x800 } || (extended && remote) {
                return None;
            }
            let bytes = data.to_le_bytes();
            let frame = match (extended, remote) {
                (false, false) => Frame::new(id, &bytes[..length]),
                (true, _) => Frame::extended(id, &bytes[..length]),
                (false, true) => Frame::remote(id, length as u8),
            };
            Some(Passed { stamp_ns: *stamp_ns, bus: (head >> 48) as u8, sent, frame })
        };
        rest.is_empty().then(|| all.iter().map(one).collect())?
    }
}

/// Appends the state before cycle `k`: its number, a hash, the words of [`Control::save`].
pub fn write_state(k: u64, control: &Control, words: &mut Vec<u64>) {
    let start = words.len();
    words.extend([k, 0]);
    control.save(words);
    words[start + 1] = hash(&words[start + 2..]);
}

/// Delay of a cycle's start after its own tick; `late_ns` counts from the first tick that was missed.
pub fn within_tick(late_ns: u32, ticks: u32, period_ns: u64) -> u32 {
    let missed_ns = u64::from(ticks.saturating_sub(1)) * period_ns;
    u64::from(late_ns).saturating_sub(missed_ns).min(period_ns - 1) as u32
}

/// A hash of words that is the same on every machine: FNV-1a, word by word.
pub fn hash(words: &[u64]) -> u64 {
    words.iter().fold(0xcbf2_9ce4_8422_2325, |hash, word| (hash ^ word).wrapping_mul(0x0100_0000_01b3))
}

/// Encodes the settings that a replay needs, limits of the drives and options, for the head of a log.
pub fn settings_to_bytes(bounds: &[Bounds], options: &Options) -> Vec<u8> {
    let number = |value: Option<f64>| value.unwrap_or(f64::NAN).to_bits();
    let Options { ramp_ns, clamped_ns, standstill_ns, blend_ns, count_overruns, needs_look, energy_stops, measures } =
        *options;
    let flags = u64::from(count_overruns)
        | u64::from(needs_look) << 1
        | u64::from(energy_stops) << 2
        | u64::from(measures) << 3;
    let mut words = vec![ramp_ns, clamped_ns, standstill_ns, blend_ns, flags];
    words.extend(bounds.iter().flat_map(|bounds| [number(bounds.torque), number(bounds.speed)]));
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// Decodes the bytes of [`settings_to_bytes`].
pub fn settings_from_bytes(bytes: &[u8]) -> Option<(Vec<Bounds>, Options)> {
    let (words, rest) = bytes.as_chunks::<8>();
    let words: Vec<u64> = words.iter().map(|word| u64::from_le_bytes(*word)).collect();
    let ([ramp_ns, clamped_ns, standstill_ns, blend_ns, flags], bounds) = words.split_first_chunk::<5>()?;
    let (bounds, odd) = bounds.as_chunks::<2>();
    let number = |word: u64| Some(f64::from_bits(word)).filter(|value| !value.is_nan());
    let bounds = bounds.iter().map(|[torque, speed]| Bounds { torque: number(*torque), speed: number(*speed) });
    let options = Options {
        ramp_ns: *ramp_ns,
        clamped_ns: *clamped_ns,
        standstill_ns: *standstill_ns,
        blend_ns: *blend_ns,
        count_overruns: flags & 1 != 0,
        needs_look: flags & 2 != 0,
        energy_stops: flags & 4 != 0,
        measures: flags & 8 != 0,
    };
    (rest.is_empty() && odd.is_empty()).then(|| (bounds.collect(), options))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cycle_survives_encoding_and_decoding() {
        let shape = Shape { signals: 5, outputs: 2, drives: 2, recorded: 3 };
        let cycle = Cycle {
            k: 7,
            due_ns: 7_000_000,
            late_ns: 3700,
            phases_ns: [1, 2, u32::MAX],
            ticks: 3,
            source: Source::StartUp,
            order: DriveCommand::QuickStop,
            arms: true,
            step: 11,
            statuses: vec![0x1637, 0x0218],
            readings: [0, 1, 5, 0xfffe, Reading::NEVER].map(|age| Reading { value: -0.1, age }).to_vec(),
            wanted: vec![0.1, 0.2],
            requests: vec![f64::INFINITY, -0.0],
            permitted: vec![1.0, 2.0],
            clamps: vec![Clamps::SLEW, Clamps(7)],
            causes: vec![Cause::Speed(1, 9.5), Cause::Asked],
            set: vec![(Slot(17), 0.3)],
            recorded: vec![1e-300, 2.0, 3.0],
        };
        // A cycle finds its buffer allocated.
        let mut words = Vec::with_capacity(1 << 14);
        cycle.write(&mut words);
        assert_eq!(Cycle::read(shape, &words), Some(cycle));
        for cut in 0..words.len() {
            assert_eq!(Cycle::read(shape, &words[..cut]), None, "cut at {cut}");
        }
        words.push(0);
        assert_eq!(Cycle::read(shape, &words), None);
    }

    #[test]
    fn frames_survive_encoding_and_decoding() {
        let frames = [
            Frame::new(0x80, &[]),
            Frame::new(0x7ff, &[1, 2, 3, 4, 5, 6, 7, 8]),
            Frame::extended(0x1234_5678, &[9]),
            Frame::remote(0x701, 1),
        ];
        let all: Vec<Passed> = (frames.iter().enumerate())
            .map(|(i, frame)| Passed { stamp_ns: u64::MAX - i as u64, bus: i as u8, sent: i % 2 == 0, frame: *frame })
            .collect();
        let mut words = Vec::new();
        all.iter().for_each(|passed| passed.write(&mut words));
        assert_eq!(Passed::read(&words), Some(all));
        assert_eq!(Passed::read(&words[1..]), None);
        assert_eq!(Passed::read(&[0, 0x800, 0]), None, "an identifier of 12 bits");
    }

    #[test]
    fn settings_survive_encoding_and_decoding() {
        let bounds = [Bounds { torque: Some(4.0), speed: None }, Bounds::default()];
        let options = Options { count_overruns: true, energy_stops: true, ramp_ns: 5, ..Options::default() };
        let bytes = settings_to_bytes(&bounds, &options);
        assert_eq!(settings_from_bytes(&bytes), Some((bounds.to_vec(), options)));
        assert_eq!(settings_from_bytes(&bytes[1..]), None);
    }
}
