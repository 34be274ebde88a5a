//! A log of candump as a bus: replays the recorded frames at their recorded times.
//!
//! In: a log. Out: its frames, the first one when the bus is opened. A frame that we send takes the place of the
//! recorded frames with its identifier: these are no longer received, and each sent frame is compared with the next
//! recorded one.

use super::log::{self, LoggedFrame};
use super::sim::Simulation;
use super::{Bus, CannotOpen, Event, Filter, Frame, Health, Options, Received, Refused};
use crate::realtime::clock::Clock;
use std::path::Path;

/// A log as a bus.
pub struct Replay {
    world: Simulation,
    /// Time at which the first frame is due.
    origin_ns: u64,
    entries: Vec<Recorded>,
    /// Index of the next frame: all frames before have been received, or were ours.
    next: usize,
    filter: Filter,
    listen_only: bool,
    /// Number of sent frames that differ from the log and have not been reported yet.
    differences: u32,
    health: Health,
}

struct Recorded {
    after_ns: u64,
    frame: Frame,
    /// We send it: it is not received, and is compared.
    ours: bool,
    compared: bool,
}

impl Replay {
    /// Opens a log; its replay begins now.
    pub fn open(path: &Path, options: &Options, world: Simulation) -> Result<Replay, CannotOpen> {
        let cannot = |reason: String| CannotOpen {
            address: format!("replay:{}", path.display()),
            reason,
            remedy: Some("a log as `candump -L` writes it: (1436509052.249713) can0 181#AABB".into()),
        };
        let text = std::fs::read_to_string(path).map_err(|error| cannot(error.to_string()))?;
        let mut entries: Vec<LoggedFrame> = Vec::new();
        for (number, line) in (1..).zip(text.lines()) {
            let entry = log::entry(line).map_err(|error| cannot(format!("line {number}: {error}")))?;
            let Some(entry) = entry else { continue };
            if entries.last().is_some_and(|last| last.time_ns > entry.time_ns) {
                return Err(cannot(format!("line {number}: its time lies before that of the line above")));
            }
            entries.push(entry);
        }
        let first_ns = entries.first().map(|entry| entry.time_ns).ok_or_else(|| cannot("it has no frame".into()))?;
        let recorded = |entry: LoggedFrame| Recorded {
            after_ns: entry.time_ns - first_ns,
            frame: entry.frame,
            ours: false,
            compared: false,
        };
        Ok(Replay {
            origin_ns: world.now_ns(),
            world,
            entries: entries.into_iter().map(recorded).collect(),
            next: 0,
            filter: options.filter.clone(),
            listen_only: options.listen_only,
            differences: 0,
            health: Health::default(),
        })
    }

    /// Time at which the next frame is due that is not ours.
    fn due_ns(&mut self) -> Option<u64> {
        while self.entries.get(self.next).is_some_and(|entry| entry.ours || !self.filter.accepts(&entry.frame)) {
            self.next += 1;
        }
        self.entries.get(self.next).map(|entry| self.origin_ns + entry.after_ns)
    }
}

impl Bus for Replay {
    /// A frame with an identifier that the log does not contain is accepted and ignored.
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        if self.listen_only {
            return Err(Refused::Unable);
        }
        let same =
            |entry: &Recorded| entry.frame.id() == frame.id() && entry.frame.is_extended() == frame.is_extended();
        if self.entries.iter().any(|entry| same(entry) && !entry.ours) {
            self.entries.iter_mut().filter(|entry| same(entry)).for_each(|entry| entry.ours = true);
        }
        if let Some(entry) = self.entries.iter_mut().find(|entry| same(entry) && !entry.compared) {
            entry.compared = true;
            self.differences += u32::from(entry.frame != frame);
        }
        Ok(())
    }

    fn receive(&mut self) -> Option<Received> {
        let now_ns = self.world.now_ns();
        if self.differences > 0 {
            self.differences -= 1;
            return Some(Received::Event(Event::Error, now_ns));
        }
        let due_ns = self.due_ns().filter(|&due_ns| due_ns <= now_ns)?;
        let frame = self.entries[self.next].frame;
        self.next += 1;
        Some(Received::Frame(frame, due_ns))
    }

    fn wait(&mut self, until_ns: u64) -> bool {
        let due_ns = if self.differences > 0 { Some(0) } else { self.due_ns() };
        self.world.sleep_until(due_ns.unwrap_or(u64::MAX).min(until_ns));
        due_ns.is_some_and(|due_ns| due_ns <= until_ns)
    }

    fn health(&self) -> Health {
        self.health
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOG: &str =
        "(100.000000) can0 080#\n(100.000500) can0 181#01\n(100.001000) can0 080#\n(100.001500) can0 181#02\n";

    fn replay(text: &str, world: &Simulation) -> Result<Replay, CannotOpen> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.log");
        std::fs::write(&path, text).expect("written");
        Replay::open(&path, &Options::default(), world.clone())
    }

    #[test]
    fn frames_are_due_at_their_times() {
        let world = Simulation::new();
        world.run_to(7_000);
        let mut bus = replay(LOG, &world).expect("a log");
        let mut got = Vec::new();
        while bus.wait(1_000_000_000) {
            got.push(bus.receive().expect("something came"));
        }
        let sync = Frame::new(0x080, &[]);
        let at = |ns: u64, frame| Received::Frame(frame, 7_000 + ns);
        let answer = |byte| Frame::new(0x181, &[byte]);
        assert_eq!(got, [at(0, sync), at(500_000, answer(1)), at(1_000_000, sync), at(1_500_000, answer(2))]);
    }

    #[test]
    fn a_sent_frame_is_compared_and_not_received() {
        let world = Simulation::new();
        let mut bus = replay(LOG, &world).expect("a log");
        bus.send(Frame::new(0x181, &[1])).expect("as recorded");
        bus.send(Frame::new(0x181, &[3])).expect("taken");
        bus.send(Frame::new(0x7FF, &[3])).expect("unknown, and forgotten");
        world.run_to(10_000_000);
        let got: Vec<Received> = std::iter::from_fn(|| bus.receive()).collect();
        assert_eq!(got.len(), 3, "one difference, two SYNC: {got:?}");
        assert!(matches!(got[0], Received::Event(Event::Error, _)));
    }

    #[test]
    fn a_wrong_log_is_refused_with_its_line() {
        let world = Simulation::new();
        let said = |text: &str| replay(text, &world).err().expect("refused").to_string();
        assert!(said("").contains("it has no frame"));
        assert!(said("(1.0) can0 080#\n(0.5) can0 080#").contains("line 2: its time lies before"));
        assert!(said("\n\n(1.0) can0 08#").contains("line 3: `08#` is no frame"));
    }
}
