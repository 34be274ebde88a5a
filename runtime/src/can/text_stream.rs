//! A stream of text messages with end marks, as adapters and gateways of CAN speak them.
//!
//! In: a non-blocking descriptor, messages to send. Out: received messages, and the loss of bytes or of the other end as
//! events. Knows no protocol.

use super::descriptor::{self, Incoming, Moved, Outgoing};
use super::{Event, Health, Received, Refused, State};
use crate::realtime::clock::{Clock, Monotonic};
use std::os::fd::{AsRawFd, RawFd};

/// What a protocol knows of its messages.
pub(super) struct MessageShape {
    /// Whether a byte ends a message.
    pub is_end: fn(u8) -> bool,
    /// A message of more bytes without its end is discarded.
    pub unfinished: usize,
    /// Capacities for received bytes and for bytes to send.
    pub incoming: usize,
    pub outgoing: usize,
}

/// One end of a stream. No call but `wait` waits, and none allocates.
pub(super) struct TextStream<D> {
    pub descriptor: D,
    pub clock: Monotonic,
    pub incoming: Incoming,
    pub outgoing: Outgoing,
    pub health: Health,
    is_end: fn(u8) -> bool,
    unfinished: usize,
    down_told: bool,
}

impl<D: AsRawFd> TextStream<D> {
    pub fn new(descriptor: D, clock: Monotonic, shape: MessageShape) -> TextStream<D> {
        let MessageShape { is_end, unfinished, incoming, outgoing } = shape;
        let (incoming, outgoing) = (Incoming::new(incoming), Outgoing::new(outgoing));
        let (health, down_told) = (Health::default(), false);
        TextStream { descriptor, clock, incoming, outgoing, health, is_end, unfinished, down_told }
    }

    pub fn fd(&self) -> RawFd {
        self.descriptor.as_raw_fd()
    }

    /// Writes as many waiting bytes as the other end accepts; false if it is gone.
    pub fn flush(&mut self) -> bool {
        self.outgoing.flush(self.descriptor.as_raw_fd())
    }

    /// Reads more bytes; the loss of the other end is returned as an event, once.
    pub fn fill(&mut self) -> Result<bool, Option<Received>> {
        match self.incoming.fill(self.descriptor.as_raw_fd()) {
            Moved::Bytes(_) => Ok(true),
            Moved::Later => Ok(false),
            Moved::Gone => {
                self.health.state = State::Down;
                let told = std::mem::replace(&mut self.down_told, true);
                Err((!told).then(|| Received::Event(Event::Down, self.clock.now_ns())))
            }
        }
    }

    /// Discards bytes that cannot become a message any more. To be called when no whole message is left.
    pub fn tidy(&mut self) -> Option<Received> {
        (self.incoming.unfinished() > self.unfinished).then(|| {
            self.incoming.discard();
            self.health.lost += 1;
            Received::Event(Event::Lost(1), self.clock.now_ns())
        })
    }

    /// Sends a whole message or nothing.
    pub fn send(&mut self, message: &[u8]) -> Result<(), Refused> {
        let there = self.flush();
        let taken = there && self.outgoing.push(message);
        if !there || !self.flush() {
            self.health.state = State::Down;
            self.health.refused += 1;
            return Err(Refused::Down);
        }
        if !taken {
            self.health.refused += 1;
            return Err(Refused::Full);
        }
        Ok(())
    }

    /// Waits until there is a message to read, or bytes of one; returns false at `until_ns`.
    pub fn wait(&mut self, until_ns: u64) -> bool {
        if self.down_told {
            self.clock.sleep_until(until_ns);
            return false;
        }
        self.incoming.has_message(self.is_end)
            || descriptor::wait_stream(self.descriptor.as_raw_fd(), &mut self.outgoing, &self.clock, until_ns)
    }
}
