//! Buses in the process, with the times, losses and errors of a real one.
//!
//! In: frames and a time that somebody moves. Out: what each node of a bus would have seen, always the same for the same
//! seed. Knows no drive: whoever answers on a bus is an [`Actor`].
//!
//! ```text
//! let simulation = Simulation::new();               // or Simulation::real_time(): the same, paced by the machine's clock
//! let bus = simulation.bus("bench", 1_000_000);     // made at the first call, found at the next
//! let mut master = bus.port("master");              // a `Bus`
//! simulation.attend(Box::new(Drive::new(bus.port("load"))));
//! master.send(Frame::new(0x080, &[]))?;
//! master.wait(simulation.now_ns() + 450_000);       // moves the time on; the drive answers meanwhile
//! ```

mod fault;
mod line;

use super::{Bus, Filter, Frame, Health, Received, Refused, descriptor};
use crate::realtime::clock::{Clock, Monotonic, Simulated};
pub use fault::{Fault, Kind};
use line::Line;
use std::cell::{Cell, RefCell};
use std::rc::Rc;

/// A world of its own: one time, its buses, and whoever acts in it. Copies are handles of the same one.
#[derive(Clone)]
pub struct Simulation(Rc<World>);

struct World {
    time: Time,
    seed: Cell<u64>,
    buses: RefCell<Vec<SimBus>>,
    actors: RefCell<Vec<Box<dyn Actor>>>,
}

enum Time {
    /// Stands until somebody waits.
    Simulated(Simulated),
    /// Goes by itself.
    Real(Monotonic),
}

/// Somebody in a simulation: a drive, a disturbance, a watchdog.
pub trait Actor {
    /// Does what is due: reads its ports, sends, moves its model to `now_ns`. Called when its time has come, and after
    /// anything has happened on any bus. It must not wait.
    ///
    /// Returns when it wants to be called again at the latest: after `now_ns`, `u64::MAX` for only when something happens.
    fn act(&mut self, now_ns: u64) -> u64;
}

impl Simulation {
    /// A simulation whose time stands at 0 until somebody waits.
    pub fn new() -> Simulation {
        Simulation::with(Time::Simulated(Simulated::new()))
    }

    /// A simulation whose time is the machine's, from 0 now.
    pub fn real_time() -> Simulation {
        Simulation::with(Time::Real(Monotonic::new()))
    }

    fn with(time: Time) -> Simulation {
        let (buses, actors) = (RefCell::default(), RefCell::default());
        Simulation(Rc::new(World { time, seed: Cell::new(1), buses, actors }))
    }

    /// From which all that is random follows, for buses made later.
    pub fn seeded(self, seed: u64) -> Simulation {
        self.0.seed.set(seed);
        self
    }

    /// The bus of this name; made with this bit rate if there is none.
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
        let line = Rc::new(RefCell::new(Line::new(bit_rate, seed)));
        buses.push(SimBus { name: name.into(), line, time: Rc::downgrade(&self.0) });
        buses[buses.len() - 1].clone()
    }

    /// Lets somebody act in it from now on.
    pub fn attend(&self, actor: Box<dyn Actor>) {
        self.0.actors.borrow_mut().push(actor);
    }

    /// The machine's clock, where that is its time.
    pub fn monotonic(&self) -> Option<Monotonic> {
        match &self.0.time {
            Time::Simulated(_) => None,
            Time::Real(clock) => Some(*clock),
        }
    }

    /// Does what is due, then waits for what comes next: on a bus, by an actor, at one of the descriptors, or the time
    /// `until_ns`. Simulated time does not wait for descriptors.
    pub fn step(&self, until_ns: u64, watched: &mut [libc::pollfd]) {
        self.0.step(until_ns, watched, || false);
    }

    /// Moves on to a time, or goes until then.
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

    /// From event to event until the time has come or `enough` says so; gives what that said last.
    fn run(&self, until_ns: u64, enough: impl Fn() -> bool) -> bool {
        while !self.step(until_ns, &mut [], &enough) {}
        enough()
    }

    /// Lets everybody act at this instant. Then, unless that is `enough` or the time has come, goes on to the next one.
    /// Says whether it stayed.
    fn step(&self, until_ns: u64, watched: &mut [libc::pollfd], enough: impl Fn() -> bool) -> bool {
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
        // Whoever wanted to send at this instant has done so.
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
            Time::Real(clock) => drop(descriptor::wait(watched, clock, next_ns)),
        }
        false
    }
}

/// A simulated bus. Copies are handles of the same one.
#[derive(Clone)]
pub struct SimBus {
    name: Rc<str>,
    line: Rc<RefCell<Line>>,
    // A simulation owns its buses and its actors own ports: only a weak way back lets them go.
    time: std::rc::Weak<World>,
}

/// How a node joins a bus.
#[derive(Clone, Default, Debug)]
pub struct Join {
    /// Its own bit rate, where it is not that of the bus: errors on both sides.
    pub bit_rate: Option<u32>,
    /// What it reads.
    pub filter: Filter,
    /// It neither sends nor acknowledges.
    pub listen_only: bool,
}

impl SimBus {
    /// Joins a node; several may bear one name. It leaves when the port is dropped.
    pub fn port(&self, name: &str) -> Port {
        self.join(name, Join::default())
    }

    /// Joins a node that is special.
    pub fn join(&self, name: &str, join: Join) -> Port {
        let Join { bit_rate, filter, listen_only } = join;
        let world = self.world();
        let mut line = self.line.borrow_mut();
        line.run_to(world.now_ns(), false);
        let node = line.join(name, bit_rate, filter, listen_only, world.now_ns());
        Port { bus: self.clone(), node }
    }

    /// Its bit rate.
    pub fn bit_rate(&self) -> u32 {
        self.line.borrow().bit_rate()
    }

    /// How long the line was busy until now.
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

    /// Lets a node send a frame again and again, at least this far apart: 0 is without a pause.
    pub fn babble(&self, node: &str, frame: Frame, period_ns: u64, from_ns: u64, until_ns: u64) {
        self.caught_up().babble(node, frame, period_ns, from_ns, until_ns);
    }

    /// Pulls the plug of a node for a time: it hears nobody, nobody hears it.
    pub fn unplug(&self, node: &str, from_ns: u64, until_ns: u64) {
        self.caught_up().unplug(node, from_ns, until_ns);
    }

    /// Lets the two wires touch for a time: no frame gets through, and whoever tries counts an error.
    pub fn short(&self, from_ns: u64, until_ns: u64) {
        self.caught_up().short(from_ns, until_ns);
    }

    /// Takes the interface of a node down, now.
    pub fn take_down(&self, node: &str) {
        let now_ns = self.world().now_ns();
        self.caught_up().take_down(node, now_ns);
    }

    /// Asks a node that is bus-off or down to come back: after 128 times 11 quiet bits.
    pub fn restart(&self, node: &str) {
        let now_ns = self.world().now_ns();
        self.caught_up().restart(node, now_ns);
    }

    fn world(&self) -> Rc<World> {
        self.time.upgrade().expect("a simulation outlives the use of its buses")
    }

    fn caught_up(&self) -> std::cell::RefMut<'_, Line> {
        let mut line = self.line.borrow_mut();
        line.run_to(self.world().now_ns(), false);
        line
    }
}

/// A node's place on a simulated bus.
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
