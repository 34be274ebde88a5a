//! Buses simulated within the process, with the times, losses and errors of real ones (discrete-event simulation).
//!
//! In: frames, and a time that callers advance. Out: everything that each node of a bus would receive, reproducible for
//! the same seed. Knows no drive: a participant is an [`Actor`].
//!
//! ```text
//! let simulation = Simulation::new();               // or Simulation::real_time(), paced by the machine's clock
//! let bus = simulation.bus("bench", 1_000_000);     // created at the first call, found at the next
//! let mut master = bus.port("master");              // a `Bus`
//! simulation.attend(Box::new(Drive::new(bus.port("load"))));
//! master.send(Frame::new(0x080, &[]))?;
//! master.wait(simulation.now_ns() + 450_000);       // advances the time; the drive answers meanwhile
//! ```

mod fault;
mod line;

use super::{Bus, Filter, Frame, Health, Received, Refused};
use crate::realtime::clock::{Clock, Monotonic, Simulated};
pub use fault::{BusFaultKind, Fault};
use line::Wire;
use std::cell::{Cell, RefCell};
use std::rc::Rc;

/// A descriptor of a real bus to wait for beside the simulation.
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub type Polled = libc::pollfd;

/// A descriptor of a real bus to wait for beside the simulation: this build has none.
#[cfg(not(all(feature = "hardware", target_os = "linux")))]
pub enum Polled {}

/// An independent simulation: one clock, its buses and its actors. Clones are handles of the same simulation.
#[derive(Clone)]
pub struct Simulation(Rc<World>);

struct World {
    time: Time,
    seed: Cell<u64>,
    buses: RefCell<Vec<SimBus>>,
    actors: RefCell<Vec<Box<dyn Actor>>>,
}

enum Time {
    /// Advances only while a caller waits.
    Simulated(Simulated),
    /// Advances by itself.
    Real(Monotonic),
}

/// A participant of a simulation: a drive, a disturbance, a watchdog.
pub trait Actor {
    /// Executes everything that is due: reads its ports, sends, advances its model to `now_ns`. Called when its time
    /// has come, and after every event on any bus. Must not wait.
    ///
    /// Returns the latest time of the next call: after `now_ns`; `u64::MAX` if only events matter.
    fn act(&mut self, now_ns: u64) -> u64;
}

impl Simulation {
    /// A simulation whose time stays at 0 until a caller waits.
    pub fn new() -> Simulation {
        Simulation::with(Time::Simulated(Simulated::new()))
    }

    /// A simulation with the machine's clock, which is 0 now.
    pub fn real_time() -> Simulation {
        Simulation::with(Time::Real(Monotonic::new()))
    }

    fn with(time: Time) -> Simulation {
        let (buses, actors) = (RefCell::default(), RefCell::default());
        Simulation(Rc::new(World { time, seed: Cell::new(1), buses, actors }))
    }

    /// Sets the seed of all random numbers, for buses created later.
    pub fn seeded(self, seed: u64) -> Simulation {
        self.0.seed.set(seed);
        self
    }

    /// The bus of this name; created with this bit rate if it does not exist.
    ///
    /// # Panics
    /// If the bit rate is 0.
    pub fn bus(&self, name: &str, bit_rate: u32) -> SimBus {
        assert!(bit_rate > 0, "bus {name} has no bit rate");
        let mut buses = self.0.buses.borrow_mut();
        if let Some(bus) = buses.iter().find(|bus| *bus.name == *name) {
            return bus.clone();
        }
        let seed = self.0.seed.get().wrapping_add(buses.len() as u64);
        let line = Rc::new(RefCell::new(Wire::new(bit_rate, seed)));
        buses.push(SimBus { name: name.into(), line, time: Rc::downgrade(&self.0) });
        buses[buses.len() - 1].clone()
    }

    /// Adds an actor.
    pub fn attend(&self, actor: Box<dyn Actor>) {
        self.0.actors.borrow_mut().push(actor);
    }

    /// The machine's clock, if the simulation uses it.
    pub fn monotonic(&self) -> Option<Monotonic> {
        match &self.0.time {
            Time::Simulated(_) => None,
            Time::Real(clock) => Some(*clock),
        }
    }

    /// Executes everything that is due, then waits for the next event: on a bus, of an actor, at one of the
    /// descriptors, or the time `until_ns`. Simulated time does not wait for descriptors.
    pub fn step(&self, until_ns: u64, watched: &mut [Polled]) {
        self.0.step(until_ns, watched, || false);
    }

    /// Advances to a time, or waits until then.
    pub fn run_to(&self, until_ns: u64) {
        self.0.run(until_ns, || false);
    }
}

impl Default for Simulation {
    fn default() -> Simulation {
        Simulation::new()
    }
}

impl Clock for Simulation {
    fn now_ns(&self) -> u64 {
        self.0.now_ns()
    }

    fn sleep_until(&self, until_ns: u64) {
        self.run_to(until_ns);
    }
}

impl World {
    fn now_ns(&self) -> u64 {
        match &self.time {
            Time::Simulated(clock) => clock.now_ns(),
            Time::Real(clock) => clock.now_ns(),
        }
    }

    /// Advances from event to event until the time is reached or `enough` returns true; returns the last result of
    /// `enough`.
    fn run(&self, until_ns: u64, enough: impl Fn() -> bool) -> bool {
        while !self.step(until_ns, &mut [], &enough) {}
        enough()
    }

    /// Lets all actors act at the present time. Then advances to the next event, unless `enough` returns true or the
    /// time is reached. Returns true if it did not advance.
    fn step(&self, until_ns: u64, watched: &mut [Polled], enough: impl Fn() -> bool) -> bool {
        let now_ns = self.now_ns();
        let buses = self.buses.borrow();
        buses.iter().for_each(|bus| bus.line.borrow_mut().run_to(now_ns, false));
        let mut actors = self.actors.try_borrow_mut().expect("an actor does not wait");
        let wake_ns = actors.iter_mut().map(|actor| actor.act(now_ns)).min().unwrap_or(u64::MAX);
        assert!(wake_ns > now_ns, "an actor wants to act again at {wake_ns} ns, and it is {now_ns} ns already");
        drop(actors);
        if enough() || now_ns >= until_ns {
            return true;
        }
        // All actors have queued their frames for this time.
        let settle = |bus: &SimBus| {
            let mut line = bus.line.borrow_mut();
            line.run_to(now_ns, true);
            line.next_ns()
        };
        let line_ns = buses.iter().map(settle).min().unwrap_or(u64::MAX);
        let next_ns = until_ns.min(wake_ns).min(line_ns);
        match &self.time {
            Time::Simulated(clock) => clock.advance_to(next_ns),
            Time::Real(clock) if watched.is_empty() => clock.sleep_until(next_ns),
            #[cfg(all(feature = "hardware", target_os = "linux"))]
            Time::Real(clock) => drop(super::descriptor::wait(watched, clock, next_ns)),
            #[cfg(not(all(feature = "hardware", target_os = "linux")))]
            Time::Real(_) => unreachable!("`Polled` has no values"),
        }
        false
    }
}

/// A simulated bus. Clones are handles of the same bus.
#[derive(Clone)]
pub struct SimBus {
    name: Rc<str>,
    line: Rc<RefCell<Wire>>,
    // A simulation owns its buses, and its actors own ports: a strong reference would be a cycle.
    time: std::rc::Weak<World>,
}

/// Options of a node that joins a bus.
#[derive(Clone, Default, Debug)]
pub struct Join {
    /// Its own bit rate, if it differs from that of the bus: errors on both sides.
    pub bit_rate: Option<u32>,
    /// Its acceptance filter.
    pub filter: Filter,
    /// It neither sends nor acknowledges.
    pub listen_only: bool,
}

impl SimBus {
    /// Joins a node; several nodes may have the same name. It leaves when the port is dropped.
    pub fn port(&self, name: &str) -> Port {
        self.join(name, Join::default())
    }

    /// Joins a node with options.
    pub fn join(&self, name: &str, join: Join) -> Port {
        let Join { bit_rate, filter, listen_only } = join;
        let world = self.world();
        let mut line = self.line.borrow_mut();
        line.run_to(world.now_ns(), false);
        let node = line.join(name, bit_rate, filter, listen_only, world.now_ns());
        Port { bus: self.clone(), node }
    }

    /// Its bit rate, bits per second.
    pub fn bit_rate(&self) -> u32 {
        self.line.borrow().bit_rate()
    }

    /// Total time in which the line was busy, ns.
    pub fn busy_ns(&self) -> u64 {
        self.caught_up().busy_ns()
    }

    /// Plants a fault in a node.
    ///
    /// # Panics
    /// Here and below: if no node of that name has joined.
    pub fn plant(&self, node: &str, fault: Fault) {
        self.caught_up().plant(node, fault);
    }

    /// Makes a node send a frame again and again, at least this interval apart; 0: without a pause.
    pub fn babble(&self, node: &str, frame: Frame, period_ns: u64, from_ns: u64, until_ns: u64) {
        self.caught_up().babble(node, frame, period_ns, from_ns, until_ns);
    }

    /// Unplugs a node for an interval: it receives nothing, and its frames reach no node.
    pub fn unplug(&self, node: &str, from_ns: u64, until_ns: u64) {
        self.caught_up().unplug(node, from_ns, until_ns);
    }

    /// Short-circuits the two wires for an interval: no frame is transmitted, and each attempt counts an error.
    pub fn short(&self, from_ns: u64, until_ns: u64) {
        self.caught_up().short(from_ns, until_ns);
    }

    /// Takes the interface of a node down, now.
    pub fn take_down(&self, node: &str) {
        let now_ns = self.world().now_ns();
        self.caught_up().take_down(node, now_ns);
    }

    /// Restarts a node that is bus-off or down: after 128 times 11 recessive bits.
    pub fn restart(&self, node: &str) {
        let now_ns = self.world().now_ns();
        self.caught_up().restart(node, now_ns);
    }

    fn world(&self) -> Rc<World> {
        self.time.upgrade().expect("a simulation outlives the use of its buses")
    }

    fn caught_up(&self) -> std::cell::RefMut<'_, Wire> {
        let mut line = self.line.borrow_mut();
        line.run_to(self.world().now_ns(), false);
        line
    }
}

/// The connection of a node to a simulated bus.
pub struct Port {
    bus: SimBus,
    node: usize,
}

impl Bus for Port {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        let now_ns = self.bus.world().now_ns();
        self.bus.caught_up().send(self.node, frame, now_ns)
    }

    fn receive(&mut self) -> Option<Received> {
        let now_ns = self.bus.world().now_ns();
        self.bus.caught_up().receive(self.node, now_ns)
    }

    fn wait(&mut self, until_ns: u64) -> bool {
        self.bus.world().run(until_ns, || self.bus.line.borrow().has_something(self.node))
    }

    fn health(&self) -> Health {
        self.bus.caught_up().health(self.node)
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        self.bus.line.borrow_mut().leave(self.node);
    }
}

#[cfg(test)]
mod tests;
