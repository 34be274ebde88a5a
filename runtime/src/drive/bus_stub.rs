//! The simulated nodes on simulated buses: each node has a port of its own, so that its frames compete for the bus as
//! real ones do.

use crate::can::sim::{Actor, Port, SimBus, Simulation};
use crate::can::{Bus, Received};
use crate::drive::simulated_plant::SimulatedBench;
use abi::rig::Rig;
use std::cell::RefCell;
use std::rc::Rc;

/// Connects the nodes of a rig to its simulated buses, under their own names. `buses`: in the order of the rig. Between
/// events the nodes remain accessible for inspection and fault injection.
pub fn attend(
    simulation: &Simulation,
    buses: &[SimBus],
    rig: &Rig,
    bench: SimulatedBench,
) -> Rc<RefCell<SimulatedBench>> {
    let ports = rig.nodes.iter().map(|node| buses[node.bus].port(&node.name)).collect();
    let bench = Rc::new(RefCell::new(bench));
    simulation.attend(Box::new(Nodes { ports, bench: bench.clone() }));
    bench
}

struct Nodes {
    ports: Vec<Port>,
    bench: Rc<RefCell<SimulatedBench>>,
}

impl Actor for Nodes {
    fn act(&mut self, now_ns: u64) -> u64 {
        let mut bench = self.bench.borrow_mut();
        let ports = &mut self.ports;
        for node in 0..ports.len() {
            while let Some(received) = ports[node].receive() {
                if let Received::Frame(frame, _) = received {
                    // A node loses the frames for which its queue has no room.
                    bench.hear(node, &frame, now_ns, &mut |from, frame| _ = ports[from].send(frame));
                }
            }
        }
        bench.go_on(now_ns, &mut |from, frame| _ = ports[from].send(frame));
        bench.due_ns().max(now_ns + 1)
    }
}
