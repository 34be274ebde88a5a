//! The simulated line: arbitration, duration of frames, reception, and error counters.
//!
//! In: frames with their times. Out: deliveries, events and error counters of each node. Frame lengths are exact in
//! bits, times in whole nanoseconds; nothing blocks here, and nothing is allocated after a node has joined. Source: ISO
//! 11898-1:2015, 10.8, 12.

use super::super::{Event, Filter, Frame, Health, Received, Refused, State};
use super::fault::{BusFaultKind, Fault, Faults, corrupted};
use crate::can::frame_length;
use crate::rng::Chance;
use std::collections::VecDeque;

/// Capacity of a node's transmit queue, frames.
pub(super) const QUEUE: usize = 64;

/// Capacity of a node's receive queue, frames and events.
pub(super) const BUFFER: usize = 4096;

/// Length of an error delimiter, bits.
const DELIMITER: u32 = 8;

/// Suspend transmission time of an error-passive node, bits.
const SUSPEND: u32 = 8;

/// Number of recessive bits before a node may recover from bus-off.
const RECOVERY: u32 = 128 * 11;

pub(super) struct Wire {
    bit_rate: u32,
    chance: Chance,
    nodes: Vec<Station>,
    /// Time from which on a frame may start.
    free_ns: u64,
    underway: Option<Underway>,
    /// Interval of a short circuit between the wires.
    short: (u64, u64),
    busy_ns: u64,
}

/// A transmission in progress.
struct Underway {
    node: usize,
    frame: Frame,
    /// Index in the queue of the node; none for a babbling node.
    place: Option<usize>,
    ends_ns: u64,
    free_ns: u64,
    end: Ending,
}

#[derive(Clone, Copy, PartialEq)]
enum Ending {
    Received,
    NotAcknowledged,
    Disturbed,
}

struct Station {
    name: String,
    bit_rate: u32,
    listen_only: bool,
    filter: Filter,
    waiting: VecDeque<(Frame, u64)>,
    held: Option<Frame>,
    read: VecDeque<Received>,
    unreported: u32,
    health: Health,
    /// Whether the node has been notified of its frame without acknowledge.
    complained: bool,
    /// Time from which on it may start a frame: later than for others if it is error passive.
    not_before_ns: u64,
    restart_ns: Option<u64>,
    joined: bool,
    unplugged: (u64, u64),
    babble: Option<Babble>,
    faults: Faults,
}

struct Babble {
    frame: Frame,
    period_ns: u64,
    next_ns: u64,
    until_ns: u64,
}

impl Station {
    /// Whether it drives the line and receives from it.
    fn takes_part(&self, now_ns: u64) -> bool {
        let unplugged = (self.unplugged.0..self.unplugged.1).contains(&now_ns);
        self.joined && !unplugged && !matches!(self.health.state, State::BusOff | State::Down)
    }

    /// Earliest time at which it has a frame to start.
    fn wants_ns(&self) -> Option<u64> {
        let waiting = self.waiting.iter().map(|&(_, ready_ns)| ready_ns);
        let babble =
            self.babble.as_ref().filter(|babble| babble.next_ns < babble.until_ns).map(|babble| babble.next_ns);
        waiting.chain(babble).min().map(|ready_ns| ready_ns.max(self.not_before_ns))
    }

    /// The frame that it would start now, and its index in the queue.
    fn offers(&self, now_ns: u64) -> Option<(Frame, Option<usize>)> {
        if now_ns < self.not_before_ns {
            return None;
        }
        let place = self.waiting.iter().position(|&(_, ready_ns)| ready_ns <= now_ns);
        let waiting = place.map(|place| (self.waiting[place].0, Some(place)));
        let babble = self.babble.as_ref().filter(|babble| babble.next_ns <= now_ns && babble.next_ns < babble.until_ns);
        let babble = babble.map(|babble| (babble.frame, None));
        waiting.into_iter().chain(babble).min_by_key(|(frame, _)| frame_length::arbitration(frame))
    }

    fn deliver(&mut self, received: Received) {
        if self.read.len() == BUFFER {
            self.unreported += 1;
            self.health.lost += 1;
        } else {
            self.read.push_back(received);
        }
    }

    /// Updates the state according to the error counters, and reports its change.
    fn judge(&mut self, now_ns: u64, before: Health) {
        let worst = |health: &Health| health.transmit_errors.max(health.receive_errors);
        let (was, is) = (worst(&before), worst(&self.health));
        self.health.state = match (self.health.transmit_errors, is) {
            (256.., _) => State::BusOff,
            (_, 128..) => State::Passive,
            _ => State::Active,
        };
        let event = match self.health.state {
            State::BusOff => Some(Event::BusOff),
            State::Passive if before.state == State::Active => Some(Event::Passive),
            _ => (was <= 96 && is > 96).then_some(Event::Warning),
        };
        if self.health.state == State::BusOff {
            self.waiting.clear();
            self.held = None;
        }
        if let Some(event) = event {
            self.deliver(Received::Event(event, now_ns));
        }
    }

    fn success(&mut self, transmitted: bool, now_ns: u64) {
        let before = self.health;
        let Health { transmit_errors, receive_errors, .. } = &mut self.health;
        let counter = if transmitted { transmit_errors } else { receive_errors };
        // The receive counter of an error-passive node returns at once to just below the bound.
        *counter = if !transmitted && *counter > 127 { 127 } else { counter.saturating_sub(1) };
        self.judge(now_ns, before);
    }

    fn error(&mut self, by: u16, transmitting: bool, now_ns: u64) {
        let before = self.health;
        let Health { transmit_errors, receive_errors, .. } = &mut self.health;
        let counter = if transmitting { transmit_errors } else { receive_errors };
        *counter = (*counter + by).min(256);
        self.judge(now_ns, before);
    }
}

impl Wire {
    pub fn new(bit_rate: u32, seed: u64) -> Wire {
        Wire {
            bit_rate,
            chance: Chance(seed),
            nodes: Vec::new(),
            free_ns: 0,
            underway: None,
            short: (u64::MAX, u64::MAX),
            busy_ns: 0,
        }
    }

    pub fn join(&mut self, name: &str, bit_rate: Option<u32>, filter: Filter, listen_only: bool, now_ns: u64) -> usize {
        self.nodes.push(Station {
            name: name.to_string(),
            bit_rate: bit_rate.unwrap_or(self.bit_rate),
            listen_only,
            filter,
            waiting: VecDeque::with_capacity(QUEUE + 2),
            held: None,
            read: VecDeque::with_capacity(BUFFER),
            unreported: 0,
            health: Health::default(),
            complained: false,
            not_before_ns: now_ns,
            restart_ns: None,
            joined: true,
            unplugged: (u64::MAX, u64::MAX),
            babble: None,
            faults: Faults::default(),
        });
        self.nodes.len() - 1
    }

    pub fn leave(&mut self, node: usize) {
        self.nodes[node].joined = false;
        self.nodes[node].waiting.clear();
    }

    pub fn bit_rate(&self) -> u32 {
        self.bit_rate
    }

    pub fn busy_ns(&self) -> u64 {
        self.busy_ns
    }

    /// The nodes with this name.
    fn named(&mut self, name: &str) -> impl Iterator<Item = &mut Station> {
        let known = self.nodes.iter().any(|node| node.name == name);
        assert!(known, "no node {name} has joined this bus");
        self.nodes.iter_mut().filter(move |node| node.name == name)
    }

    pub fn plant(&mut self, name: &str, fault: Fault) {
        self.named(name).for_each(|node| node.faults.plant(fault));
    }

    pub fn babble(&mut self, name: &str, frame: Frame, period_ns: u64, from_ns: u64, until_ns: u64) {
        self.named(name).for_each(|node| node.babble = Some(Babble { frame, period_ns, next_ns: from_ns, until_ns }));
    }

    pub fn unplug(&mut self, name: &str, from_ns: u64, until_ns: u64) {
        self.named(name).for_each(|node| node.unplugged = (from_ns, until_ns));
    }

    pub fn short(&mut self, from_ns: u64, until_ns: u64) {
        self.short = (from_ns, until_ns);
    }

    pub fn take_down(&mut self, name: &str, now_ns: u64) {
        self.named(name).for_each(|node| {
            node.health.state = State::Down;
            node.waiting.clear();
            node.deliver(Received::Event(Event::Down, now_ns));
        });
    }

    pub fn restart(&mut self, name: &str, now_ns: u64) {
        let bits_ns = ns(RECOVERY, self.bit_rate);
        self.named(name).for_each(|node| node.restart_ns = Some(now_ns + bits_ns));
    }

    pub fn send(&mut self, at: usize, frame: Frame, now_ns: u64) -> Result<(), Refused> {
        let (node, chance) = (&mut self.nodes[at], &mut self.chance);
        if node.listen_only {
            return Err(Refused::Unable);
        }
        if matches!(node.health.state, State::BusOff | State::Down) {
            node.health.refused += 1;
            return Err(Refused::Down);
        }
        let mut struck = |is: fn(BusFaultKind) -> bool| node.faults.strike(&frame, now_ns, chance, is);
        if struck(|kind| kind == BusFaultKind::Full).is_some() || node.waiting.len() >= QUEUE {
            node.health.refused += 1;
            return Err(Refused::Full);
        }
        if struck(|kind| kind == BusFaultKind::Drop).is_some() {
            return Ok(());
        }
        let delayed = match struck(|kind| matches!(kind, BusFaultKind::Delay(_))) {
            Some(BusFaultKind::Delay(by_ns)) => by_ns,
            _ => 0,
        };
        let twice = struck(|kind| kind == BusFaultKind::Duplicate).is_some();
        let held_back = struck(|kind| kind == BusFaultKind::Reorder).is_some();
        let corrupt = struck(|kind| kind == BusFaultKind::Corrupt).is_some();
        let frame = node.faults.frozen(frame, now_ns, chance);
        let frame = if corrupt { corrupted(chance, frame) } else { frame };
        if held_back && node.held.is_none() {
            node.held = Some(frame);
            return Ok(());
        }
        let ready_ns = now_ns + delayed;
        node.waiting.push_back((frame, ready_ns));
        if twice {
            node.waiting.push_back((frame, ready_ns));
        }
        if let Some(late) = node.held.take() {
            node.waiting.push_back((late, now_ns));
        }
        Ok(())
    }

    pub fn receive(&mut self, at: usize, now_ns: u64) -> Option<Received> {
        let node = &mut self.nodes[at];
        if node.unreported > 0 {
            return Some(Received::Event(Event::Lost(std::mem::take(&mut node.unreported)), now_ns));
        }
        node.read.pop_front()
    }

    pub fn has_something(&self, at: usize) -> bool {
        self.nodes[at].unreported > 0 || !self.nodes[at].read.is_empty()
    }

    pub fn health(&self, at: usize) -> Health {
        self.nodes[at].health
    }

    /// Time of the next change: a frame or an error ends, a frame can start, a node restarts.
    pub fn next_ns(&self) -> u64 {
        let restart = self.nodes.iter().filter_map(|node| node.restart_ns).min().unwrap_or(u64::MAX);
        restart.min(match &self.underway {
            Some(underway) => underway.ends_ns,
            None => self.next_start_ns().unwrap_or(u64::MAX),
        })
    }

    fn next_start_ns(&self) -> Option<u64> {
        let able = |node: &&Station| node.joined && !matches!(node.health.state, State::BusOff | State::Down);
        let wants = self.nodes.iter().filter(able).filter_map(Station::wants_ns).min()?;
        (wants < u64::MAX).then(|| wants.max(self.free_ns))
    }

    /// Advances the line to a time. A frame that starts exactly at that time is started only if `settled`: until then
    /// another node may still request to start at the same time.
    pub fn run_to(&mut self, now_ns: u64, settled: bool) {
        loop {
            self.come_back(now_ns);
            if self.underway.as_ref().is_some_and(|underway| underway.ends_ns > now_ns) {
                return;
            }
            if let Some(underway) = self.underway.take() {
                self.end(underway);
                continue;
            }
            match self.next_start_ns() {
                Some(start_ns) if start_ns < now_ns || start_ns == now_ns && settled => self.start(start_ns),
                _ => return,
            }
        }
    }

    fn come_back(&mut self, now_ns: u64) {
        for node in &mut self.nodes {
            if let Some(restart_ns) = node.restart_ns.take_if(|restart_ns| *restart_ns <= now_ns) {
                let Health { lost, refused, .. } = node.health;
                node.health = Health { lost, refused, ..Health::default() };
                node.not_before_ns = restart_ns;
                node.deliver(Received::Event(Event::Restarted, restart_ns));
            }
        }
    }

    /// Performs the arbitration between the nodes that want to start, and starts the winner's frame.
    fn start(&mut self, start_ns: u64) {
        let offers = |(at, node): (usize, &Station)| node.offers(start_ns).map(|(frame, place)| (at, frame, place));
        let plugged = |&(at, ..): &(usize, Frame, Option<usize>)| self.nodes[at].takes_part(start_ns);
        let able =
            |&(_, node): &(usize, &Station)| node.joined && !matches!(node.health.state, State::BusOff | State::Down);
        let all = || self.nodes.iter().enumerate().filter(able).filter_map(offers);
        let Some((at, frame, place)) =
            all().filter(plugged).min_by_key(|(_, frame, _)| frame_length::arbitration(frame))
        else {
            return self.send_into_nothing(start_ns);
        };
        let key = frame_length::arbitration(&frame);
        let collides = all()
            .filter(plugged)
            .any(|(other, theirs, _)| other != at && frame_length::arbitration(&theirs) == key && theirs != frame);
        let rate = self.nodes[at].bit_rate;
        let others = || self.nodes.iter().enumerate().filter(|&(other, node)| other != at && node.takes_part(start_ns));
        // A node with another bit rate misreads the frame and destroys it, as long as its error flags are dominant.
        let misread =
            others().any(|(_, node)| node.bit_rate != rate && node.health.state == State::Active && !node.listen_only);
        let acknowledged = others().any(|(_, node)| node.bit_rate == rate && !node.listen_only);
        let whole = frame_length::bits(&frame);
        let shorted = (self.short.0..self.short.1).contains(&start_ns);
        let struck = |kind| kind == BusFaultKind::Disturb;
        let disturbed = self.nodes[at].faults.strike(&frame, start_ns, &mut self.chance, struck).is_some();
        let (end, error_at) = if shorted || misread {
            (Ending::Disturbed, Some(6))
        } else if collides || disturbed {
            // At a random position after the arbitration and before the end.
            (Ending::Disturbed, Some(20 + self.chance.below(u64::from(whole) - 33) as u32))
        } else if !acknowledged {
            // The acknowledge slot follows the CRC delimiter.
            (Ending::NotAcknowledged, Some(whole - 11))
        } else {
            (Ending::Received, None)
        };
        let echoes = if end == Ending::Disturbed { self.chance.below(7) as u32 } else { 0 };
        // Error flag, echoed error flags of the nodes that detect it, delimiter.
        let ends = error_at.map_or(whole - frame_length::SPACE, |at| at + 6 + echoes + DELIMITER);
        let (ends_ns, free_ns) = (start_ns + ns(ends, rate), start_ns + ns(ends + frame_length::SPACE, rate));
        self.busy_ns += free_ns - start_ns;
        self.underway = Some(Underway { node: at, frame, place, ends_ns, free_ns, end });
    }

    /// An unplugged node receives no acknowledge: it becomes error passive and keeps trying, alone on its piece of
    /// cable.
    fn send_into_nothing(&mut self, start_ns: u64) {
        for node in self.nodes.iter_mut().filter(|node| node.joined) {
            if let Some((frame, _)) = node.offers(start_ns) {
                node.not_before_ns = start_ns + ns(frame_length::bits(&frame) + 6 + SUSPEND, node.bit_rate);
                if !std::mem::replace(&mut node.complained, true) {
                    node.deliver(Received::Event(Event::NotAcknowledged, start_ns));
                }
                if node.health.state == State::Active {
                    node.error(8, true, start_ns);
                }
            }
        }
    }

    fn end(&mut self, underway: Underway) {
        let Underway { node: at, frame, place, ends_ns, free_ns, end } = underway;
        self.free_ns = free_ns;
        let rate = self.nodes[at].bit_rate;
        let sender = &mut self.nodes[at];
        match end {
            Ending::Received => {
                match place {
                    Some(place) => drop(sender.waiting.remove(place)),
                    None => {
                        if let Some(babble) = &mut sender.babble {
                            babble.next_ns = free_ns.max(babble.next_ns + babble.period_ns);
                        }
                    }
                }
                sender.complained = false;
                sender.success(true, ends_ns);
            }
            Ending::NotAcknowledged => {
                if !std::mem::replace(&mut sender.complained, true) {
                    sender.deliver(Received::Event(Event::NotAcknowledged, ends_ns));
                }
                // Once error passive, a missing acknowledge no longer counts: a node alone never becomes bus-off.
                if sender.health.state == State::Active {
                    sender.error(8, true, ends_ns);
                }
            }
            Ending::Disturbed => sender.error(8, true, ends_ns),
        }
        if sender.health.state == State::Passive {
            sender.not_before_ns = free_ns + ns(SUSPEND, rate);
        }
        let (nodes, chance) = (&mut self.nodes, &mut self.chance);
        for (other, node) in nodes.iter_mut().enumerate() {
            if other == at || !node.takes_part(ends_ns) {
                continue;
            }
            match end {
                Ending::Received if node.bit_rate == rate => {
                    if !node.listen_only {
                        node.success(false, ends_ns);
                    }
                    if !node.filter.accepts(&frame) {
                        continue;
                    }
                    match node.faults.strike(&frame, ends_ns, chance, |kind| kind == BusFaultKind::Overrun) {
                        Some(_) => {
                            node.unreported += 1;
                            node.health.lost += 1;
                        }
                        None => node.deliver(Received::Frame(frame, ends_ns)),
                    }
                }
                Ending::Received | Ending::Disturbed if !node.listen_only => node.error(1, false, ends_ns),
                Ending::Received | Ending::Disturbed | Ending::NotAcknowledged => {}
            }
        }
    }
}

/// Duration of bits, in whole nanoseconds.
fn ns(bits: u32, bit_rate: u32) -> u64 {
    u64::from(bits) * 1_000_000_000 / u64::from(bit_rate)
}
