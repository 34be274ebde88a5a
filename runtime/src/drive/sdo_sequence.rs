//! What is read from a drive and written into it before it may move, as a list that an SDO client works through.

use crate::canopen::sdo::{Client, Failure, Outcome};
use crate::canopen::{Object, Send, Type};
use crate::drive::faults::Why;

/// One entry of a list.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Entry {
    /// Reads a number and keeps it.
    Read(Object, Type, Keep),
    /// The same, where the drive has it.
    ReadIf(Object, Type, Keep),
    /// Reads a text, where the drive has it; keeps 1 if it is this one, else 0.
    TextIf(Object, &'static str, Keep),
    /// Writes a number of so many bytes.
    Write(Object, i64, u8),
    /// Writes it where the drive takes it; where not, passes over so many entries behind this one.
    WriteOr(Object, i64, u8, usize),
    /// Reads; the bits must be those.
    Compare(Object, i64, i64),
    /// Writes node and time of a watched heartbeat; longer times are tried where the drive refuses; last resort: the
    /// entries behind the next so many.
    Watch(Object, u8, usize),
    /// Reads it back.
    Watched(Object, u8),
    /// Asks the owner to judge what has been read so far.
    Judge(Question),
    /// Goes on so many entries further.
    Skip(usize),
}

/// Where a number that was read is kept.
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

/// What the owner is asked in between.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Question {
    /// Is it the right drive, and what are its limits?
    Identity,
    /// Does object 605A end a quick stop without torque?
    QuickStop,
    /// It has a heartbeat consumer or guarding: from now on we must be heard.
    Timeout(Watching),
}

/// How a drive watches us.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Watching {
    /// Our heartbeat; the time is known from the list.
    Heartbeat,
    /// Guard requests.
    Guarding,
    /// Nothing does.
    Nothing,
}

/// How far a list is.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Progress {
    /// Waits for an answer.
    Busy,
    /// The owner must answer, then call again.
    Asks(Question),
    /// At its end.
    Done,
    /// The drive said no.
    Refused(Why),
}

/// How often a drive is asked that does not answer: one may be busy, or an answer be lost on the way.
const TRIES: u32 = 3;

/// A list and the place in it.
#[derive(Clone, Debug)]
pub struct Script {
    entries: Vec<Entry>,
    at: usize,
    asked: bool,
    /// Times it was asked in vain.
    unanswered: u32,
    /// Numbers that were read.
    pub kept: [Option<i64>; KEPT],
    /// The time-out that a drive has accepted, ms.
    pub timeout_ms: u32,
}

impl Script {
    /// At the start of a list.
    pub fn new(entries: Vec<Entry>, timeout_ms: u32) -> Script {
        Script { entries, at: 0, asked: false, unanswered: 0, kept: [None; KEPT], timeout_ms }
    }

    /// To the start again.
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

    /// Asks the next thing, or takes the answer. Called once a tick.
    pub fn work(&mut self, client: &mut Client, now_ns: u64, send: Send) -> Progress {
        let Some(&entry) = self.entries.get(self.at) else { return Progress::Done };
        match entry {
            Entry::Judge(question) => {
                self.next(0);
                return Progress::Asks(question);
            }
            Entry::Skip(further) => {
                self.next(further);
                return Progress::Busy;
            }
            _ => {}
        }
        if !self.asked {
            self.asked = true;
            match entry {
                Entry::Read(object, ..)
                | Entry::ReadIf(object, ..)
                | Entry::TextIf(object, ..)
                | Entry::Compare(object, ..)
                | Entry::Watched(object, _) => {
                    client.read(object, now_ns, send);
                }
                Entry::Write(object, value, size) | Entry::WriteOr(object, value, size, _) => {
                    client.write(object, &value.to_le_bytes()[..size.into()], now_ns, send);
                }
                Entry::Watch(object, node, _) => {
                    let value = u32::from(node) << 16 | self.timeout_ms;
                    client.write(object, &value.to_le_bytes(), now_ns, send);
                }
                Entry::Judge(_) | Entry::Skip(_) => unreachable!("handled above"),
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
                    Entry::ReadIf(..) | Entry::TextIf(..) if aborted => self.next(0),
                    Entry::WriteOr(.., further) if aborted => self.next(further),
                    Entry::Watch(_, _, further) if aborted => {
                        if self.timeout_ms >= 1000 {
                            self.next(further);
                        } else {
                            // As short as the drive takes it.
                            (self.timeout_ms, self.asked) = (self.timeout_ms * 2, false);
                        }
                    }
                    _ => {
                        let write = matches!(entry, Entry::Write(..) | Entry::WriteOr(..) | Entry::Watch(..));
                        return Progress::Refused(Why::Sdo { object: client.object(), write, failure });
                    }
                }
                Progress::Busy
            }
        }
    }

    fn take(&mut self, entry: Entry, data: &[u8]) -> Progress {
        match entry {
            Entry::Read(_, kind, keep) | Entry::ReadIf(_, kind, keep) => {
                self.kept[keep as usize] = Some(kind.number(data));
            }
            Entry::TextIf(_, text, keep) => {
                // Some devices fill their texts up with zeros.
                let told = data.split(|byte| *byte == 0).next().unwrap_or_default();
                self.kept[keep as usize] = Some((told == text.as_bytes()).into());
            }
            Entry::Compare(object, wanted, bits) => {
                if let Some(why) = differs(object, wanted & bits, Type::U64.number(data) & bits) {
                    return Progress::Refused(why);
                }
            }
            Entry::Watched(object, node) => {
                let wanted = i64::from(node) << 16 | i64::from(self.timeout_ms);
                if let Some(why) = differs(object, wanted, Type::U64.number(data)) {
                    return Progress::Refused(why);
                }
            }
            Entry::Write(..) | Entry::WriteOr(..) | Entry::Watch(..) | Entry::Judge(_) | Entry::Skip(_) => {}
        }
        self.next(0);
        Progress::Busy
    }
}

fn differs(object: Object, wanted: i64, found: i64) -> Option<Why> {
    (found != wanted).then_some(Why::ReadBack { object, wanted, found })
}
