//! A rig without hardware: buses, drives and devices simulated within the process.
//!
//! In: a rig and the program of the part that hardware replaces. Out: the clock and the buses for a
//! [`Hil`](super::cycle::Hil), and the simulated nodes, for inspection and fault injection. In simulated time
//! everything is deterministic.

use crate::can::sim::{Actor, Port, SimBus, Simulation};
use crate::can::{Bus, Received};
use crate::drive::simulated_plant::SimulatedBench;
use crate::realtime::clock::Clock;
use abi::Instance;
use abi::rig::{Kind, Mode, Node, Rig};
use std::cell::{RefCell, RefMut};
use std::rc::Rc;

/// Bit rate of a simulated bus if the rig names none.
const BIT_RATE: u32 = 1_000_000;

/// Clock of a simulated rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Pace {
    /// Simulated time, as fast as the computation.
    Fast,
    /// Wall-clock time.
    Wall,
}

/// The simulated side of a rig's buses.
pub struct World {
    simulation: Simulation,
    buses: Vec<SimBus>,
    masters: Vec<Box<dyn Bus>>,
    bench: Rc<RefCell<SimulatedBench>>,
}

/// The name of our own node on a simulated bus.
pub const MASTER: &str = "fric";
/// The name of the node that stands for all drives and devices of a bus.
pub const BENCH: &str = "bench";

impl World {
    /// The buses of a rig with all its nodes. `seed`: for all random numbers.
    ///
    /// # Errors
    /// A message about a drive for which there is no simulation.
    pub fn new(rig: &Rig, plant: Option<Instance>, pace: Pace, seed: u64) -> Result<World, String> {
        World::around(rig, SimulatedBench::new(rig, plant, seed)?, pace, seed)
    }

    /// The same with an existing [`SimulatedBench`].
    ///
    /// # Errors
    /// Does not fail at present.
    pub fn around(rig: &Rig, bench: SimulatedBench, pace: Pace, seed: u64) -> Result<World, String> {
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

    /// The clock of the simulation.
    pub fn clock(&self) -> Box<dyn Clock> {
        Box::new(self.simulation.clone())
    }

    /// Our ends of the buses; empty at the second call.
    pub fn masters(&mut self) -> Vec<Box<dyn Bus>> {
        std::mem::take(&mut self.masters)
    }

    /// A bus, for fault injection.
    pub fn bus(&self, i: usize) -> &SimBus {
        &self.buses[i]
    }

    /// Drives, devices and shaft.
    pub fn bench(&self) -> RefMut<'_, SimulatedBench> {
        self.bench.borrow_mut()
    }

    /// The simulation, to add further actors.
    pub fn simulation(&self) -> &Simulation {
        &self.simulation
    }
}

/// The simulated nodes with their ports.
struct Nodes {
    ports: Vec<Port>,
    bench: Rc<RefCell<SimulatedBench>>,
}

impl Actor for Nodes {
    fn act(&mut self, now_ns: u64) -> u64 {
        let mut bench = self.bench.borrow_mut();
        for bus in 0..self.ports.len() {
            while let Some(received) = self.ports[bus].receive() {
                if let Received::Frame(frame, _) = received {
                    // A drive loses the frames for which its queue has no room.
                    bench.receive(bus, &frame, now_ns, &mut |bus, frame| _ = self.ports[bus].send(frame));
                }
            }
        }
        bench.advance(now_ns, &mut |bus, frame| _ = self.ports[bus].send(frame));
        bench.due_ns().max(now_ns + 1)
    }
}

/// Whether one drive controls speed or position while another controls torque: a simulated drive of the first kind
/// would not let the other one move the shaft.
pub fn holds_and_pushes(rig: &Rig) -> bool {
    let pushes = |node: &Node| match &node.kind {
        Kind::Cia402(drive) => node.moves.then_some(drive.mode == Mode::Torque),
        Kind::Frames(_) => None,
    };
    let all = || rig.nodes.iter().filter_map(pushes);
    all().any(|pushes| pushes) && all().any(|pushes| !pushes)
}
