//! A whole rig: two drives in torque mode with alternating pulses, and the drives themselves.

#[path = "../../runtime/src/testing/nodes.rs"]
mod nodes;

use abi::rig::{Mode, Rig, SignalKind};
use runtime::can::socketcan::SocketCan;
use runtime::can::{Bus, Options, Received};
use runtime::drive::SimulatedBench;
use runtime::hil::identify::Identification;
use runtime::realtime::clock::{Clock, Monotonic};
use runtime::realtime::threads::{self, Wishes};
use std::sync::atomic::{AtomicBool, Ordering};

/// The rig and its program, with this period.
pub fn pulsed(period_ns: u64) -> Identification {
    let drive = |name: &str, node| nodes::drive(name, node, Mode::Torque, period_ns);
    let output = |node| nodes::output(node, SignalKind::Torque, abi::Slot::TIME, [-1.0, 1.0]);
    let rig = Rig {
        outputs: vec![output(0), output(1)],
        ..nodes::rig("gate", "socketcan:can0", period_ns, vec![drive("load", 3), drive("servo", 4)])
    };
    Identification::new(&rig).expect("its drives take torques")
}

/// Runs the drives of a rig on an interface, until it ends; returns whether any of them still has torque then.
/// `priority`: real-time priority of the thread; none for an ordinary one.
pub fn drives(rig: &Rig, interface: &str, priority: Option<i32>, over: &AtomicBool) -> bool {
    let clock = Monotonic::new();
    let mut bus = SocketCan::open(interface, &Options::default(), clock).expect("it is up");
    let mut bench = SimulatedBench::new(rig, None, 1).expect("servos are simulated");
    let real_time = priority.map(|priority| threads::enter(&Wishes { priority, ..Wishes::default() }));
    assert!(real_time.as_ref().is_none_or(|granted| granted.refused().is_empty()), "{real_time:?}");
    while !over.load(Ordering::Relaxed) {
        bus.wait(bench.due_ns().max(clock.now_ns() + 50_000));
        let mut send = Vec::new();
        while let Some(received) = bus.receive() {
            if let Received::Frame(frame, _) = received {
                bench.receive(0, &frame, clock.now_ns(), &mut |_, frame| send.push(frame));
            }
        }
        bench.advance(clock.now_ns(), &mut |_, frame| send.push(frame));
        send.into_iter().for_each(|frame| _ = bus.send(frame));
    }
    (0..rig.nodes.len()).any(|node| bench.drive(node).is_some_and(|drive| drive.state().powered()))
}
