//! Joins buses: what comes from one goes to all others.
//!
//! In: buses of any kind. Out: their frames on each other, and each one told. Who is slower than the rest loses frames, and
//! each loss is counted: a hub never waits for anybody.

use super::sim::Simulation;
use super::{Bus, Event, Received, Refused, descriptor};

/// Frames taken from one bus before the next one has its turn.
const TURN: usize = 64;

/// Several buses as one.
#[derive(Default)]
pub struct Hub {
    members: Vec<Member>,
    watched: Vec<libc::pollfd>,
}

/// One of them.
pub struct Member {
    /// How it is called in reports.
    pub name: String,
    /// Frames that it did not take.
    pub lost: u64,
    bus: Box<dyn Bus>,
    /// Whether it goes when its other end does.
    guest: bool,
    gone: bool,
}

impl Hub {
    /// Joins nothing yet.
    pub fn new() -> Hub {
        Hub::default()
    }

    /// Adds a bus that stays, whatever becomes of it.
    pub fn join(&mut self, name: &str, bus: Box<dyn Bus>) {
        self.members.push(Member { name: name.into(), lost: 0, bus, guest: false, gone: false });
    }

    /// Adds a bus that leaves when it goes down: a client of a door.
    pub fn admit(&mut self, name: &str, bus: Box<dyn Bus>) {
        self.members.push(Member { name: name.into(), lost: 0, bus, guest: true, gone: false });
    }

    /// Who belongs to it.
    pub fn members(&self) -> &[Member] {
        &self.members
    }

    /// Passes on what has come, and tells it: from whom, and what. True if there was anything.
    pub fn pass_on(&mut self, mut told: impl FnMut(&str, &Received)) -> bool {
        let mut any = false;
        for from in 0..self.members.len() {
            for _ in 0..TURN {
                let Some(received) = self.members[from].bus.receive() else { break };
                any = true;
                told(&self.members[from].name, &received);
                match received {
                    Received::Frame(frame, _) => {
                        for (to, member) in self.members.iter_mut().enumerate() {
                            // What it can't carry by its kind is no loss of traffic that it could.
                            let lost =
                                to != from && matches!(member.bus.send(frame), Err(Refused::Full | Refused::Down));
                            member.lost += u64::from(lost);
                        }
                    }
                    Received::Event(Event::Down, _) => self.members[from].gone = true,
                    Received::Event(..) => self.members[from].gone = false,
                }
            }
        }
        self.members.retain(|member| !(member.guest && member.gone));
        any
    }

    /// Waits until something comes from any of them or `also`, or until a time. Simulated buses among them belong to
    /// `world`.
    pub fn wait(&mut self, world: &Simulation, also: &[i32], until_ns: u64) {
        self.watched.clear();
        let open = self.members.iter().filter(|member| !member.gone);
        let descriptors = open.filter_map(|member| member.bus.descriptor()).chain(also.iter().copied());
        self.watched.extend(descriptors.map(descriptor::readable));
        world.step(until_ns, &mut self.watched);
    }
}
