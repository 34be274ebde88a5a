//! A whole rig: two drives in torque mode with alternating pulses, and the drives themselves.

use abi::rig::{Bus as BusOf, Cia402, Kind, Mode, Node, Output, Overrun, Plant, Rig, Signal, What, Within};
use abi::series::Method;
use runtime::can::socketcan::SocketCan;
use runtime::can::{Bus, Options, Received};
use runtime::drive::Bench;
use runtime::hil::identify::Identification;
use runtime::realtime::clock::{Clock, Monotonic};
use runtime::realtime::threads::{self, Wishes};
use std::sync::atomic::{AtomicBool, Ordering};

fn drive(name: &str, node: u8, period_ns: u64) -> Node {
    let cia402 = Cia402 {
        node,
        rated_torque: 4.0,
        mode: Mode::Torque,
        count: 2.0 * std::f64::consts::PI / 262_144.0,
        speed_unit: 0.01 * std::f64::consts::PI / 30.0,
        max_torque: Some(4.0),
        max_speed: Some(200.0),
        travel: None,
        max_power: None,
        at_sync: false,
        profile: "cia402".into(),
    };
    let (delay, lag, timeout_ns) = (0.8e-9 * period_ns as f64, 0.6e-3, 3 * period_ns);
    Node {
        name: name.into(),
        bus: 0,
        kind: Kind::Cia402(cia402),
        moves: true,
        delay,
        lag,
        timeout_ns,
        within: Within::default(),
    }
}

/// The rig and its program, with this period.
pub fn pulsed(period_ns: u64) -> Identification {
    let output = |node| Output {
        signal: Signal { node, what: What::Torque },
        slot: abi::Slot::TIME,
        low: -1.0,
        high: 1.0,
        slew: f64::INFINITY,
        safe: 0.0,
    };
    let rig = Rig {
        name: "gate".into(),
        period_ns,
        method: Method::Rk4,
        steps: 1,
        buses: vec![BusOf { name: "can0".into(), address: "socketcan:can0".into(), bit_rate: 1_000_000 }],
        nodes: vec![drive("load", 3, period_ns), drive("servo", 4, period_ns)],
        inputs: Vec::new(),
        outputs: vec![output(0), output(1)],
        watchdog_ns: 5 * period_ns,
        overrun: Overrun::Stop,
        stops: Vec::new(),
        record: Vec::new(),
        predict: None,
        needs_look: false,
        plant: Plant { applied: Vec::new(), seen: Vec::new(), inertia: None },
    };
    Identification::new(&rig).expect("its drives take torques")
}

/// Runs the drives of a rig on an interface, until it ends; returns whether any of them still has torque then.
/// `priority`: real-time priority of the thread; none for an ordinary one.
pub fn drives(rig: &Rig, interface: &str, priority: Option<i32>, over: &AtomicBool) -> bool {
    let clock = Monotonic::new();
    let mut bus = SocketCan::open(interface, &Options::default(), clock).expect("it is up");
    let mut bench = Bench::new(rig, None, 1).expect("servos are simulated");
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
