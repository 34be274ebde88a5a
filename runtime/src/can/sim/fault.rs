//! Faults of a node on a simulated bus.
//!
//! In: a seed and the planted faults. Out: the fate of each frame. Knows nothing of the line.

use super::super::Frame;
use crate::rng::Chance;

/// Kind of a fault.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum BusFaultKind {
    /// A frame of the node never reaches the line.
    Drop,
    /// One data bit is wrong, under a valid checksum: no node on the bus notices.
    Corrupt,
    /// The frame is disturbed on the line: an error frame, error counters on both sides, and a retransmission.
    Disturb,
    /// The frame is delayed by this time, ns; later frames may overtake it.
    Delay(u64),
    /// The frame is sent twice.
    Duplicate,
    /// The frame is sent after the next frame of the node.
    Reorder,
    /// The frame is sent with the data of the first frame hit by the fault, as by a frozen producer. For a fault of one
    /// identifier.
    Stale,
    /// The queue of the node is full.
    Full,
    /// The node does not receive a frame of another node, and counts it as lost.
    Overrun,
}

/// A fault of one node: its kind, the affected frames, their number, and the time.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Fault {
    kind: BusFaultKind,
    id: Option<u32>,
    chance: f64,
    from_ns: u64,
    until_ns: u64,
    times: u32,
    /// The first frame that a [`BusFaultKind::Stale`] has hit.
    frozen: Option<Frame>,
}

impl Fault {
    /// A fault that affects every frame, at any time.
    pub fn new(kind: BusFaultKind) -> Fault {
        Fault { kind, id: None, chance: 1.0, from_ns: 0, until_ns: u64::MAX, times: u32::MAX, frozen: None }
    }

    /// Restricts it to frames with this identifier.
    pub fn id(self, id: u32) -> Fault {
        Fault { id: Some(id), ..self }
    }

    /// Restricts it to this fraction of the frames, 0 to 1, at random.
    pub fn chance(self, chance: f64) -> Fault {
        Fault { chance, ..self }
    }

    /// Begins it at this time.
    pub fn from(self, from_ns: u64) -> Fault {
        Fault { from_ns, ..self }
    }

    /// Ends it at this time.
    pub fn until(self, until_ns: u64) -> Fault {
        Fault { until_ns, ..self }
    }

    /// Limits the number of affected frames.
    pub fn times(self, times: u32) -> Fault {
        Fault { times, ..self }
    }

    /// Whether it affects this frame now; if so, it is counted.
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

    /// The frame to send instead of this one: the stale one of a frozen producer, or the frame itself.
    pub fn frozen(&mut self, frame: Frame, now_ns: u64, chance: &mut Chance) -> Frame {
        let mut strikes =
            |fault: &mut Fault| fault.kind == BusFaultKind::Stale && fault.strikes(&frame, now_ns, chance);
        match self.0.iter_mut().find_map(|fault| strikes(fault).then_some(fault)) {
            Some(fault) => *fault.frozen.get_or_insert(frame),
            None => frame,
        }
    }

    /// The fault of a matching kind that affects this frame now, if any; it is counted.
    pub fn strike(
        &mut self,
        frame: &Frame,
        now_ns: u64,
        chance: &mut Chance,
        is: impl Fn(BusFaultKind) -> bool,
    ) -> Option<BusFaultKind> {
        self.0.iter_mut().find_map(|fault| {
            let struck = is(fault.kind) && fault.strikes(frame, now_ns, chance);
            struck.then_some(fault.kind)
        })
    }
}

/// The frame with one data bit inverted.
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
