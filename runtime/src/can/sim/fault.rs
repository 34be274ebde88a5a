//! What can go wrong with a node of a simulated bus, on purpose.
//!
//! In: a seed and what was planted. Out: what becomes of each frame. Knows nothing of the line.

use super::super::Frame;
use crate::rng::Chance;

/// What goes wrong.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Kind {
    /// A frame that the node hands over never reaches the line.
    Drop,
    /// One bit of the data is wrong, and the checksum agrees with it: nobody on the bus notices.
    Corrupt,
    /// Disturbed on the line: an error frame, both counters, and the frame again.
    Disturb,
    /// On its way for this many nanoseconds longer; frames behind it may pass.
    Delay(u64),
    /// Sent twice.
    Duplicate,
    /// Sent after the next frame of the node.
    Reorder,
    /// Sent with the data of the first frame that was struck: its producer has frozen. For a fault of one identifier.
    Stale,
    /// The node finds its queue full.
    Full,
    /// The node doesn't get a frame of the others, and counts it as lost.
    Overrun,
}

/// A fault of one node: which frames, how often, and when.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Fault {
    kind: Kind,
    id: Option<u32>,
    chance: f64,
    from_ns: u64,
    until_ns: u64,
    times: u32,
    /// The first frame that a [`Kind::Stale`] has struck.
    frozen: Option<Frame>,
}

impl Fault {
    /// It happens to every frame, always.
    pub fn new(kind: Kind) -> Fault {
        Fault { kind, id: None, chance: 1.0, from_ns: 0, until_ns: u64::MAX, times: u32::MAX, frozen: None }
    }

    /// Only to frames with this identifier.
    pub fn id(self, id: u32) -> Fault {
        Fault { id: Some(id), ..self }
    }

    /// Only to this fraction of them, 0 to 1.
    pub fn chance(self, chance: f64) -> Fault {
        Fault { chance, ..self }
    }

    /// Not before this time.
    pub fn from(self, from_ns: u64) -> Fault {
        Fault { from_ns, ..self }
    }

    /// No longer from this time on.
    pub fn until(self, until_ns: u64) -> Fault {
        Fault { until_ns, ..self }
    }

    /// At most so often.
    pub fn times(self, times: u32) -> Fault {
        Fault { times, ..self }
    }

    /// Whether it strikes this frame now; it is then counted.
    fn strikes(&mut self, frame: &Frame, now_ns: u64, chance: &mut Chance) -> bool {
        let due = self.times > 0
            && (self.from_ns..self.until_ns).contains(&now_ns)
            && self.id.is_none_or(|id| id == frame.id())
            && (self.chance >= 1.0 || chance.fraction() < self.chance);
        if due && self.times != u32::MAX {
            self.times -= 1;
        }
        due
    }
}

/// The faults of a node.
#[derive(Default)]
pub(super) struct Faults(Vec<Fault>);

impl Faults {
    pub fn plant(&mut self, fault: Fault) {
        self.0.push(fault);
    }

    /// The frame that leaves in place of this one: that of a producer that has frozen, or itself.
    pub fn frozen(&mut self, frame: Frame, now_ns: u64, chance: &mut Chance) -> Frame {
        let mut strikes = |fault: &mut Fault| fault.kind == Kind::Stale && fault.strikes(&frame, now_ns, chance);
        match self.0.iter_mut().find_map(|fault| strikes(fault).then_some(fault)) {
            Some(fault) => *fault.frozen.get_or_insert(frame),
            None => frame,
        }
    }

    /// Whether one of a kind strikes this frame now; it is then counted.
    pub fn strike(
        &mut self,
        frame: &Frame,
        now_ns: u64,
        chance: &mut Chance,
        is: impl Fn(Kind) -> bool,
    ) -> Option<Kind> {
        self.0.iter_mut().find_map(|fault| {
            let struck = is(fault.kind) && fault.strikes(frame, now_ns, chance);
            struck.then_some(fault.kind)
        })
    }
}

/// The frame with one bit of its data turned over.
pub(super) fn corrupted(chance: &mut Chance, frame: Frame) -> Frame {
    if frame.data().is_empty() {
        return frame;
    }
    let at = chance.below(8 * frame.data().len() as u64);
    let mut data = [0; 8];
    data[..frame.data().len()].copy_from_slice(frame.data());
    data[at as usize / 8] ^= 1 << (at % 8);
    let data = &data[..frame.data().len()];
    if frame.is_extended() { Frame::extended(frame.id(), data) } else { Frame::new(frame.id(), data) }
}
