//! A drive and an empty rig, of which the fixtures of all tests are made.
//!
//! Uses `abi` alone, because the tests on a kernel with CAN (`tests/can/rig.rs`) include this file.

use abi::Slot;
use abi::plan::Method;
use abi::rig::{Bus, Cia402, DriveLimits, Kind, Mode, Node, Output, Overrun, Plant, Rig, Signal, SignalKind};

/// A CiA 402 drive of a rig with this period: torque up to its rated 4 N·m, speed up to 200 rad/s.
pub fn drive(name: &str, node: u8, mode: Mode, period_ns: u64) -> Node {
    let config = Cia402 {
        node,
        rated_torque: 4.0,
        mode,
        count: std::f64::consts::TAU / 262_144.0,
        speed_unit: 0.01 * std::f64::consts::PI / 30.0,
        max_torque: Some(4.0),
        max_speed: Some(200.0),
        travel: None,
        max_power: None,
        at_sync: false,
        profile: "cia402".into(),
    };
    Node {
        name: name.into(),
        bus: 0,
        kind: Kind::Cia402(config),
        moves: true,
        delay: 0.8e-9 * period_ns as f64,
        lag: 0.6e-3,
        timeout_ns: 3 * period_ns,
        within: DriveLimits::default(),
    }
}

/// The same with another torque limit, N·m.
#[allow(dead_code, reason = "not every test limits torque")]
pub fn limited(node: Node, torque: f64) -> Node {
    let Kind::Cia402(drive) = node.kind else { unreachable!("it is a drive") };
    Node { kind: Kind::Cia402(Cia402 { max_torque: Some(torque), ..drive }), ..node }
}

/// An output with this signal, between two bounds.
pub fn output(node: usize, what: SignalKind, slot: Slot, [low, high]: [f64; 2]) -> Output {
    Output { signal: Signal { node, what }, slot, low, high, slew: f64::INFINITY, safe: 0.0 }
}

/// A rig with one bus and these nodes, without inputs and outputs.
pub fn rig(name: &str, address: &str, period_ns: u64, nodes: Vec<Node>) -> Rig {
    Rig {
        name: name.into(),
        period_ns,
        method: Method::Rk4,
        steps: 1,
        buses: vec![Bus { name: "can0".into(), address: address.into(), bit_rate: 1_000_000 }],
        nodes,
        inputs: Vec::new(),
        outputs: Vec::new(),
        watchdog_ns: 5 * period_ns,
        overrun: Overrun::Stop,
        stops: Vec::new(),
        record: Vec::new(),
        plots: Vec::new(),
        predict: None,
        needs_look: false,
        plant: Plant { applied: Vec::new(), seen: Vec::new(), inertia: None },
    }
}
