//! The buses of a running rig, with the record of their frames and events in each cycle.
//!
//! In: frames to send, received frames and events. Out: frames to the fieldbus, words for the log, causes of a stop,
//! counters. Nothing here allocates, locks or waits once a rig has started.

use super::emergency;
use super::trace::Passed;
use crate::can::{Bus, Event, Frame, Received};
use crate::drive::Fieldbus;
use crate::realtime::clock::Clock;
use crate::safety::{Cause, Protection, is_present};
use abi::rig::Rig;

/// Most frames that are taken from one bus at a time.
const MOST_FRAMES: usize = 64;
/// Most causes that can occur in one cycle, besides those of buses and nodes.
const CAUSES: usize = 40;

/// The buses, with the record of their events in this cycle.
pub(super) struct Wires {
    pub clock: Box<dyn Clock>,
    pub buses: Vec<Box<dyn Bus>>,
    pub watchdog: Option<emergency::Watchdog>,
    /// The cycle has noticed that the watchdog stopped the drives, and sends nothing but stops.
    pub acknowledged: bool,
    /// The frames of this cycle, encoded as words.
    pub frames: Vec<u64>,
    /// Causes reported since the last computation; a frame that a bus refuses later counts in the next cycle.
    pub causes: Vec<Cause>,
    pub lossy: bool,
    pub lost: u64,
    pub refused: u64,
    pub errors: u64,
}

impl Wires {
    /// The buses of a rig at its start.
    pub fn new(rig: &Rig, clock: Box<dyn Clock>, buses: Vec<Box<dyn Bus>>) -> Wires {
        Wires {
            clock,
            buses,
            watchdog: None,
            acknowledged: false,
            frames: Vec::with_capacity(1 << 14),
            // Room for each bus, two for each node, as many foreign frames as the fieldbus can report, and a few more.
            causes: Vec::with_capacity(CAUSES + rig.buses.len() + 2 * rig.nodes.len()),
            lossy: false,
            lost: 0,
            refused: 0,
            errors: 0,
        }
    }

    /// Sends a frame. After the watchdog has stopped the drives, nothing is sent until the cycle stops them too.
    pub fn send(&mut self, bus: usize, frame: Frame) {
        let bitten = self.watchdog.as_ref().is_some_and(emergency::Watchdog::has_fired);
        if bitten && !self.acknowledged && is_present(Protection::Hushed) {
            return;
        }
        match self.buses[bus].send(frame) {
            Ok(()) => self.pass(bus, true, frame, self.clock.now_ns()),
            Err(_) => {
                self.refused += 1;
                self.report(Cause::Bus(bus));
            }
        }
    }

    fn pass(&mut self, bus: usize, sent: bool, frame: Frame, stamp_ns: u64) {
        if self.frames.len() + 3 <= self.frames.capacity() {
            Passed { stamp_ns, bus: bus as u8, sent, frame }.write(&mut self.frames);
        }
    }

    pub fn report(&mut self, cause: Cause) {
        if self.causes.len() < self.causes.capacity() && !self.causes.contains(&cause) {
            self.causes.push(cause);
        }
    }

    /// Reads the received frames and events: at most [`MOST_FRAMES`] from each bus.
    pub fn drain(&mut self, fieldbus: &mut Fieldbus) {
        for bus in 0..self.buses.len() {
            for n in 0.. {
                if n == MOST_FRAMES {
                    self.lossy = true;
                    break;
                }
                match self.buses[bus].receive() {
                    None => break,
                    Some(Received::Frame(frame, stamp_ns)) => {
                        self.pass(bus, false, frame, stamp_ns);
                        fieldbus.receive(bus, &frame, stamp_ns, &mut |bus, frame| self.send(bus, frame));
                    }
                    Some(Received::Event(event, _)) => self.event(bus, event),
                }
            }
        }
    }

    fn event(&mut self, bus: usize, event: Event) {
        match event {
            Event::Warning | Event::Passive | Event::Error | Event::Restarted => self.errors += 1,
            Event::BusOff | Event::NotAcknowledged | Event::Down => {
                self.errors += 1;
                self.report(Cause::Bus(bus));
            }
            Event::Lost(frames) => {
                self.lost += u64::from(frames);
                self.lossy = true;
            }
        }
    }
}
