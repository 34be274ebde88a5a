//! Sequences of SDO accesses by which a drive is identified and configured before it may move.

use crate::canopen::sdo::{Client, Failure, Outcome};
use crate::canopen::{Object, Send, Type};
use crate::drive::faults::RefusalReason;

/// One entry of a sequence.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum SequenceEntry {
    /// Reads a number and stores it.
    Read(Object, Type, Keep),
    /// The same, if the drive has the object.
    ReadIf(Object, Type, Keep),
    /// Reads a text, if the drive has the object; stores 1 if it equals this text, otherwise 0.
    TextIf(Object, &'static str, Keep),
    /// Writes a number of this many bytes.
    Write(Object, i64, u8),
    /// The same, if the drive accepts it; otherwise skips this many entries after this one.
    WriteOr(Object, i64, u8, usize),
    /// Reads a number and compares it under a mask: expected value, mask.
    Compare(Object, i64, i64),
    /// Writes node and time of a heartbeat consumer. If the drive refuses, longer times are tried; if it refuses all,
    /// skips this many entries after this one.
    Watch(Object, u8, usize),
    /// Reads that entry back.
    Watched(Object, u8),
    /// Lets the owner judge the values read so far.
    Judge(Question),
    /// Skips this many entries.
    Skip(usize),
}

/// Place of a number that was read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Keep {
    DeviceType,
    Vendor,
    Product,
    Revision,
    Serial,
    Modes,
    RatedTorque,
    MaxTorque,
    MaxSpeed,
    QuickStop,
    ModeShown,
    Error,
    Name,
    Deadline,
}

/// Number of [`Keep`]s.
pub const KEPT: usize = Keep::Deadline as usize + 1;

/// Questions to the owner during a sequence.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Question {
    /// Whether this is the right drive, and what its limits are.
    Identity,
    /// Whether object 605A ends a quick stop without torque.
    QuickStop,
    /// The drive has a heartbeat consumer or node guarding: it must hear us from now on.
    Timeout(Watching),
}

/// Mechanism by which a drive monitors us.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Watching {
    /// Our heartbeat; the sequence holds the time.
    Heartbeat,
    /// Guard requests.
    Guarding,
    /// None.
    Nothing,
}

/// Progress of a sequence.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Progress {
    /// Waits for an answer.
    Busy,
    /// The owner must answer this question, then call again.
    Asks(Question),
    /// The sequence is complete.
    Done,
    /// The drive refused an entry.
    Refused(RefusalReason),
}

/// Attempts if a drive does not answer: it may be busy, or an answer may be lost.
const TRIES: u32 = 3;

/// A sequence and its current entry.
#[derive(Clone, Debug)]
pub struct Script {
    entries: Vec<SequenceEntry>,
    at: usize,
    asked: bool,
    /// Number of attempts without an answer.
    unanswered: u32,
    /// Numbers that were read.
    pub kept: [Option<i64>; KEPT],
    /// The time-out that the drive has accepted, ms.
    pub timeout_ms: u32,
}

impl Script {
    /// A sequence at its first entry.
    pub fn new(entries: Vec<SequenceEntry>, timeout_ms: u32) -> Script {
        Script { entries, at: 0, asked: false, unanswered: 0, kept: [None; KEPT], timeout_ms }
    }

    /// Returns to the first entry.
    pub fn rewind(&mut self) {
        (self.at, self.asked, self.unanswered) = (0, false, 0);
    }

    /// A number that was read.
    pub fn get(&self, keep: Keep) -> Option<i64> {
        self.kept[keep as usize]
    }

    fn next(&mut self, further: usize) {
        (self.at, self.asked, self.unanswered) = (self.at + 1 + further, false, 0);
    }

    /// Sends the next request, or processes its answer. Called once per tick.
    pub fn work(&mut self, client: &mut Client, now_ns: u64, send: Send) -> Progress {
        let Some(&entry) = self.entries.get(self.at) else { return Progress::Done };
        match entry {
            SequenceEntry::Judge(question) => {
                self.next(0);
                return Progress::Asks(question);
            }
            SequenceEntry::Skip(further) => {
                self.next(further);
                return Progress::Busy;
            }
            _ => {}
        }
        if !self.asked {
            self.asked = true;
            match entry {
                SequenceEntry::Read(object, ..)
                | SequenceEntry::ReadIf(object, ..)
                | SequenceEntry::TextIf(object, ..)
                | SequenceEntry::Compare(object, ..)
                | SequenceEntry::Watched(object, _) => {
                    client.read(object, now_ns, send);
                }
                SequenceEntry::Write(object, value, size) | SequenceEntry::WriteOr(object, value, size, _) => {
                    client.write(object, &value.to_le_bytes()[..size.into()], now_ns, send);
                }
                SequenceEntry::Watch(object, node, _) => {
                    let value = u32::from(node) << 16 | self.timeout_ms;
                    client.write(object, &value.to_le_bytes(), now_ns, send);
                }
                SequenceEntry::Judge(_) | SequenceEntry::Skip(_) => unreachable!("handled above"),
            }
            return Progress::Busy;
        }
        match client.outcome() {
            Outcome::Idle | Outcome::Busy => Progress::Busy,
            Outcome::Done => self.take(entry, client.data()),
            Outcome::Failed(failure) => {
                let aborted = matches!(failure, Failure::Aborted(_));
                if failure == Failure::Silence && self.unanswered + 1 < TRIES {
                    (self.asked, self.unanswered) = (false, self.unanswered + 1);
                    return Progress::Busy;
                }
                match entry {
                    SequenceEntry::ReadIf(..) | SequenceEntry::TextIf(..) if aborted => self.next(0),
                    SequenceEntry::WriteOr(.., further) if aborted => self.next(further),
                    SequenceEntry::Watch(_, _, further) if aborted => {
                        if self.timeout_ms >= 1000 {
                            self.next(further);
                        } else {
                            // The shortest time that the drive accepts.
                            (self.timeout_ms, self.asked) = (self.timeout_ms * 2, false);
                        }
                    }
                    _ => {
                        let write = matches!(
                            entry,
                            SequenceEntry::Write(..) | SequenceEntry::WriteOr(..) | SequenceEntry::Watch(..)
                        );
                        return Progress::Refused(RefusalReason::Sdo { object: client.object(), write, failure });
                    }
                }
                Progress::Busy
            }
        }
    }

    fn take(&mut self, entry: SequenceEntry, data: &[u8]) -> Progress {
        match entry {
            SequenceEntry::Read(_, kind, keep) | SequenceEntry::ReadIf(_, kind, keep) => {
                self.kept[keep as usize] = Some(kind.number(data));
            }
            SequenceEntry::TextIf(_, text, keep) => {
                // Some devices pad their texts with zeros.
                let told = data.split(|byte| *byte == 0).next().unwrap_or_default();
                self.kept[keep as usize] = Some((told == text.as_bytes()).into());
            }
            SequenceEntry::Compare(object, wanted, bits) => {
                if let Some(why) = differs(object, wanted & bits, Type::U64.number(data) & bits) {
                    return Progress::Refused(why);
                }
            }
            SequenceEntry::Watched(object, node) => {
                let wanted = i64::from(node) << 16 | i64::from(self.timeout_ms);
                if let Some(why) = differs(object, wanted, Type::U64.number(data)) {
                    return Progress::Refused(why);
                }
            }
            SequenceEntry::Write(..)
            | SequenceEntry::WriteOr(..)
            | SequenceEntry::Watch(..)
            | SequenceEntry::Judge(_)
            | SequenceEntry::Skip(_) => {}
        }
        self.next(0);
        Progress::Busy
    }
}

fn differs(object: Object, wanted: i64, found: i64) -> Option<RefusalReason> {
    (found != wanted).then_some(RefusalReason::ReadBack { object, wanted, found })
}
