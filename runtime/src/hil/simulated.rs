//! A rig without hardware: its buses, drives and devices in the process.
//!
//! In: a rig and the program of what was crossed out. Out: the clock and the buses that a [`Hil`](super::cycle::Hil)
//! runs on, and the bench behind them, to look into and to make fail. In simulated time all of it is deterministic.

use crate::can::sim::{Actor, Port, SimBus, Simulation};
use crate::can::{Bus, Received};
use crate::drive::simulated_plant::Bench;
use crate::realtime::clock::Clock;
use abi::Instance;
use abi::rig::{Kind, Mode, Node, Rig};
use std::cell::{RefCell, RefMut};
use std::rc::Rc;

/// Bit rate of a simulated bus where the rig names none.
const BIT_RATE: u32 = 1_000_000;

/// Time of a simulated rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Pace {
    /// As fast as it computes.
    Fast,
    /// That of the machine.
    Wall,
}

/// What is behind the buses of a simulated rig.
pub struct World {
    simulation: Simulation,
    buses: Vec<SimBus>,
    masters: Vec<Box<dyn Bus>>,
    bench: Rc<RefCell<Bench>>,
}

/// The name of our own node on a simulated bus.
pub const MASTER: &str = "fric";
/// The name of the node that all drives and devices of a bus share.
pub const BENCH: &str = "bench";

impl World {
    /// The buses of a rig with all its nodes on them. `seed`: for all that is random.
    ///
    /// # Errors
    /// A drive of which no simulation is known, in words.
    pub fn new(rig: &Rig, plant: Option<Instance>, pace: Pace, seed: u64) -> Result<World, String> {
        World::around(rig, Bench::new(rig, plant, seed)?, pace, seed)
    }

    /// The same with a bench made elsewhere.
    ///
    /// # Errors
    /// None of its own.
    pub fn around(rig: &Rig, bench: Bench, pace: Pace, seed: u64) -> Result<World, String> {
        let simulation = match pace {
            Pace::Fast => Simulation::new(),
            Pace::Wall => Simulation::real_time(),
        };
        let simulation = simulation.seeded(seed);
        let rate = |rate: u32| if rate == 0 { BIT_RATE } else { rate };
        let buses: Vec<SimBus> = rig.buses.iter().map(|bus| simulation.bus(&bus.name, rate(bus.bit_rate))).collect();
        let masters = buses.iter().map(|bus| Box::new(bus.port(MASTER)) as Box<dyn Bus>).collect();
        let ports = buses.iter().map(|bus| bus.port(BENCH)).collect();
        let bench = Rc::new(RefCell::new(bench));
        simulation.attend(Box::new(Nodes { ports, bench: bench.clone() }));
        Ok(World { simulation, buses, masters, bench })
    }

    /// Its time.
    pub fn clock(&self) -> Box<dyn Clock> {
        Box::new(self.simulation.clone())
    }

    /// Our end of its buses; nothing the second time.
    pub fn masters(&mut self) -> Vec<Box<dyn Bus>> {
        std::mem::take(&mut self.masters)
    }

    /// A bus, to plant faults in it.
    pub fn bus(&self, i: usize) -> &SimBus {
        &self.buses[i]
    }

    /// Drives, devices and shaft.
    pub fn bench(&self) -> RefMut<'_, Bench> {
        self.bench.borrow_mut()
    }

    /// The simulation, to let others act in it.
    pub fn simulation(&self) -> &Simulation {
        &self.simulation
    }
}

/// The bench on its buses.
struct Nodes {
    ports: Vec<Port>,
    bench: Rc<RefCell<Bench>>,
}

impl Actor for Nodes {
    fn act(&mut self, now_ns: u64) -> u64 {
        let mut bench = self.bench.borrow_mut();
        for bus in 0..self.ports.len() {
            while let Some(received) = self.ports[bus].receive() {
                if let Received::Frame(frame, _) = received {
                    // A drive whose queue is full loses what it had to say.
                    bench.receive(bus, &frame, now_ns, &mut |bus, frame| _ = self.ports[bus].send(frame));
                }
            }
        }
        bench.advance(now_ns, &mut |bus, frame| _ = self.ports[bus].send(frame));
        bench.due_ns().max(now_ns + 1)
    }
}

/// Whether one drive holds speed or position while another gives torque: a simulated one would not let the other push the
/// shaft.
pub fn holds_and_pushes(rig: &Rig) -> bool {
    let pushes = |node: &Node| match &node.kind {
        Kind::Cia402(drive) => node.moves.then_some(drive.mode == Mode::Torque),
        Kind::Frames(_) => None,
    };
    let all = || rig.nodes.iter().filter_map(pushes);
    all().any(|pushes| pushes) && all().any(|pushes| !pushes)
}
