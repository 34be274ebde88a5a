//! Bridge between buses: forwards the frames of each bus to all others.
//!
//! In: buses of any kind. Out: their frames on each other; each frame is reported. A bus that is slower than the others
//! loses frames, and each loss is counted: the hub never waits.

use super::sim::Simulation;
use super::{Bus, Event, Received, Refused, descriptor};

/// Most frames taken from one bus before the next one has its turn.
const TURN: usize = 64;

/// Several buses connected to one.
#[derive(Default)]
pub struct Hub {
    members: Vec<Member>,
    watched: Vec<libc::pollfd>,
}

/// A connected bus.
pub struct Member {
    /// Its name in reports.
    pub name: String,
    /// Frames that it refused.
    pub lost: u64,
    bus: Box<dyn Bus>,
    /// Whether it is removed when its other end closes.
    guest: bool,
    gone: bool,
}

impl Hub {
    /// A hub without buses.
    pub fn new() -> Hub {
        Hub::default()
    }

    /// Adds a bus that stays connected in any case.
    pub fn join(&mut self, name: &str, bus: Box<dyn Bus>) {
        self.members.push(Member { name: name.into(), lost: 0, bus, guest: false, gone: false });
    }

    /// Adds a bus that is removed when it goes down: a client of a door.
    pub fn admit(&mut self, name: &str, bus: Box<dyn Bus>) {
        self.members.push(Member { name: name.into(), lost: 0, bus, guest: true, gone: false });
    }

    /// The connected buses.
    pub fn members(&self) -> &[Member] {
        &self.members
    }

    /// Forwards everything that has arrived, and reports each item with the name of its source. Returns whether there
    /// was any.
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
                            // A frame that the bus cannot carry by its kind does not count as lost.
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

    /// Waits until something arrives at any of them or at `also`, or until a time. Simulated buses among them must
    /// belong to `world`.
    pub fn wait(&mut self, world: &Simulation, also: &[i32], until_ns: u64) {
        self.watched.clear();
        let open = self.members.iter().filter(|member| !member.gone);
        let descriptors = open.filter_map(|member| member.bus.descriptor()).chain(also.iter().copied());
        self.watched.extend(descriptors.map(descriptor::readable));
        world.step(until_ns, &mut self.watched);
    }
}
