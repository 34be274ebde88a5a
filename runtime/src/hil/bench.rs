//! A rig written by hand, for tests: a drive that acts as a spring on whatever turns its shaft.

use crate::models::Model;
use abi::plan::Method;
use abi::rig::{Bus, Cia402, Input, Kind, Mode, Node, Output, Overrun, Plant, Rig, Signal, What};
use abi::{Function, Instance};

/// Period of the rig, ns.
pub const PERIOD_NS: u64 = 1_000_000;

/// A CiA 402 drive in torque mode.
pub fn drive(name: &str, node: u8) -> Node {
    Node {
        name: name.into(),
        bus: 0,
        kind: Kind::Cia402(Cia402 {
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
        }),
        moves: true,
        delay: 0.8e-3,
        lag: 0.6e-3,
        timeout_ns: 3 * PERIOD_NS,
    }
}

/// The rig and its control program: dx/dt = speed of the drive, torque = −k x, with k = 10 N·m/rad as parameter.
pub fn rig() -> (Rig, Instance) {
    let model = Model::new("Spring")
        .param(10.0)
        .inputs(1)
        .state("x", "rad")
        .output("torque", "N·m")
        .body(Function::Derivatives, |view| view.set_dx(0, view.u(0)))
        .body(Function::Outputs, |view| view.set_y(0, -view.p(0) * view.x(0)))
        .build();
    let layout = &model.description().layout;
    let signal = |what| Signal { node: 0, what };
    let output = Output {
        signal: signal(What::Torque),
        slot: layout.outputs.slot(0),
        low: -1.0,
        high: 1.0,
        slew: f64::INFINITY,
        safe: 0.0,
    };
    let rig = Rig {
        name: "spring".into(),
        period_ns: PERIOD_NS,
        method: Method::Rk4,
        steps: 1,
        buses: vec![Bus { name: "can0".into(), address: "sim:bench".into(), bit_rate: 1_000_000 }],
        nodes: vec![drive("load", 3)],
        inputs: vec![Input { signal: signal(What::Speed), slot: layout.inputs.slot(0), start: 0.0, needed: true }],
        outputs: vec![output],
        watchdog_ns: 5 * PERIOD_NS,
        overrun: Overrun::Stop,
        stops: Vec::new(),
        record: Vec::new(),
        predict: None,
        plant: Plant { applied: Vec::new(), seen: Vec::new(), inertia: Some(0.012) },
    };
    (rig, model)
}
