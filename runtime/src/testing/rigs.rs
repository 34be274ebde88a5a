//! A hand-written rig for tests: a drive that emulates a spring on its shaft.

use crate::hil::live::Judge;
use crate::testing::models::Model;
use crate::testing::nodes;
use abi::live::{Check, Live, Param, Tunable};
use abi::plan::Series;
use abi::rig::{Input, Mode, Node, Plant, Rig, Signal, SignalKind};
use abi::unit::Unit;
use abi::{Function, Instance};

/// Period of the rig, ns.
pub const PERIOD_NS: u64 = 1_000_000;

/// A CiA 402 drive in torque mode.
pub fn drive(name: &str, node: u8) -> Node {
    nodes::drive(name, node, Mode::Torque, PERIOD_NS)
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
    let rig = Rig {
        inputs: vec![Input {
            signal: signal(SignalKind::Speed),
            slot: layout.inputs.slot(0),
            start: 0.0,
            needed: true,
        }],
        outputs: vec![nodes::output(0, SignalKind::Torque, layout.outputs.slot(0), [-1.0, 1.0])],
        plant: Plant { applied: Vec::new(), seen: Vec::new(), inertia: Some(0.012) },
        ..nodes::rig("spring", "sim:bench", PERIOD_NS, vec![drive("load", 3)])
    };
    (rig, model)
}

/// The pair with a load that is a bristle of 20 N·m/rad, which breaks away at 0.34 N·m: it stores 2.9 mJ. The servo
/// oscillates as there.
pub fn bristle() -> (Rig, Instance, Instance) {
    let (rig, _, plant) = pair();
    let control = Model::new("Bristle")
        .param(0.4)
        .param(20.0)
        .param(0.34)
        .inputs(2)
        .state("z", "rad")
        .output("servo", "N·m")
        .output("load", "N·m")
        .output("v", "rad/s")
        .body(Function::Derivatives, |view| {
            let v = view.u(0);
            view.set_dx(0, v - view.p(1) * v.abs() * view.x(0) / view.p(2));
        })
        .body(Function::Outputs, |view| {
            view.set_y(0, view.p(0) * (2.0 * std::f64::consts::PI * view.t()).sin());
            view.set_y(1, -view.p(1) * view.x(0) - 0.02 * view.u(0));
            view.set_y(2, view.u(0));
        })
        .build();
    let layout = control.description().layout.clone();
    let mut rig = rig;
    for (k, input) in rig.inputs.iter_mut().enumerate() {
        input.slot = layout.inputs.slot(k);
    }
    rig.outputs[0].slot = layout.outputs.slot(0);
    rig.outputs[1].slot = layout.outputs.slot(1);
    rig.record[0].slot = layout.outputs.slot(2);
    (rig, control, plant)
}

/// Constraints on the parameters of [`pair`]: the amplitude `T` is in 0 .. 1 N·m, the damping `d` is above 0, and T ≥ 2
/// d numerically. `end`, the time from which the model returns NaN, is free.
pub fn judge(control: &Instance) -> Judge {
    let program = Model::new("judge")
        .param(0.4)
        .param(0.05)
        .param(f64::INFINITY)
        .output("zero", "N·m")
        .output("most", "N·m")
        .output("large enough", "1")
        .body(Function::Outputs, |view| {
            view.set_y(0, 0.0);
            view.set_y(1, 1.0);
            view.set_y(2, f64::from(view.p(0) >= 2.0 * view.p(1)));
        })
        .build();
    let (inside, judged) = (&control.description().layout, &program.description().layout);
    let unit = |text: &str| Unit::parse(text).expect("a unit that is known");
    let param = |i, path: &str, text: &str| Param {
        path: path.into(),
        unit: unit(text),
        boolean: false,
        place: Tunable::Live(inside.params.slot(i), judged.params.slot(i)),
    };
    let range = |i: usize, path: &str, text: &str, strict, high: Option<usize>| Check::Range {
        path: path.into(),
        name: path.into(),
        model: "Swing".into(),
        unit: unit(text),
        value: judged.params.slot(i),
        low: Some((judged.outputs.slot(0), strict)),
        high: high.map(|k| (judged.outputs.slot(k), false)),
    };
    let message = "`T` is smaller than `2 d`".into();
    let live = Live {
        params: vec![param(0, "T", "N·m"), param(1, "d", "N·m·s/rad"), param(2, "end", "s")],
        checks: vec![
            range(0, "T", "N·m", false, Some(1)),
            range(1, "d", "N·m·s/rad", true, None),
            Check::Require { message, value: judged.outputs.slot(2) },
        ],
        tuned: Vec::new(),
    };
    Judge::new(live, program, control).expect("both have three parameters")
}

/// Two drives on one shaft of 0.012 kg·m²: the servo drives it with 0.4 N·m at 1 Hz, the load brakes it like a damper
/// of 0.05 N·m·s/rad; from the time in its third parameter on it returns NaN. Returns rig, control program, plant
/// program.
pub fn pair() -> (Rig, Instance, Instance) {
    let control = Model::new("Swing")
        .param(0.4)
        .param(0.05)
        .param(f64::INFINITY)
        .inputs(2)
        .state("angle", "rad")
        .output("servo", "N·m")
        .output("load", "N·m")
        .output("v", "rad/s")
        .body(Function::Derivatives, |view| view.set_dx(0, view.u(0)))
        .body(Function::Outputs, |view| {
            let swing = view.p(0) * (2.0 * std::f64::consts::PI * view.t()).sin();
            view.set_y(0, if view.t() < view.p(2) { swing } else { f64::NAN });
            view.set_y(1, -view.p(1) * view.u(0));
            view.set_y(2, view.u(0));
        })
        .build();
    let plant = Model::new("Shaft")
        .inputs(2)
        .state("x", "rad")
        .state("v", "rad/s")
        .output("position", "rad")
        .output("speed", "rad/s")
        .body(Function::Derivatives, |view| {
            view.set_dx(0, view.x(1));
            view.set_dx(1, (view.u(0) + view.u(1)) / 0.012);
        })
        .body(Function::Outputs, |view| {
            view.set_y(0, view.x(0));
            view.set_y(1, view.x(1));
        })
        .build();
    let (inside, outside) = (control.description().layout.clone(), plant.description().layout.clone());
    let signal = |node, what| Signal { node, what };
    let output = |node, i, most: f64| nodes::output(node, SignalKind::Torque, inside.outputs.slot(i), [-most, most]);
    let input =
        |node, what, i| Input { signal: signal(node, what), slot: inside.inputs.slot(i), start: 0.0, needed: true };
    let rig = Rig {
        name: "pair".into(),
        // The drives limit torque themselves, too (object 6072): a wrong value that passes the checksum stays within
        // the limit.
        nodes: vec![nodes::limited(drive("load", 3), 1.0), nodes::limited(drive("servo", 4), 2.0)],
        inputs: vec![input(0, SignalKind::Speed, 0), input(1, SignalKind::Position, 1)],
        outputs: vec![output(1, 0, 2.0), output(0, 1, 1.0)],
        record: vec![Series {
            label: "v".into(),
            slot: inside.outputs.slot(2),
            unit: Unit::parse("rad/s").unwrap(),
            boolean: false,
        }],
        plant: Plant {
            applied: vec![
                (signal(1, SignalKind::Torque), outside.inputs.slot(0)),
                (signal(0, SignalKind::Torque), outside.inputs.slot(1)),
            ],
            seen: vec![
                (signal(0, SignalKind::Position), outside.outputs.slot(0)),
                (signal(0, SignalKind::Speed), outside.outputs.slot(1)),
                (signal(1, SignalKind::Position), outside.outputs.slot(0)),
                (signal(1, SignalKind::Speed), outside.outputs.slot(1)),
            ],
            inertia: Some(0.012),
        },
        ..rig().0
    };
    (rig, control, plant)
}
