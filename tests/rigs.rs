//! Rigs: the two programs compiled from a text, and the plan that connects them.

mod support;

use abi::Slot;
use abi::rig::{Kind, Mode, Overrun, Signal, SignalKind};
use compiler::{CompiledRig, Options};
use std::fs;
use support::{Texts, root};

/// The example with its imports.
fn texts() -> (String, Texts) {
    let folder = root().join("examples/rtfs");
    let read = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
    (read("rtfs.fric"), Texts(vec![("shaft.dbc".into(), read("shaft.dbc"))]))
}

fn ready(text: &str, sources: &Texts, name: &str) -> CompiledRig {
    let mut loaded = compiler::load("rig.fric", text, sources);
    assert!(loaded.diagnostics.is_empty(), "{:?}", loaded.diagnostics);
    let mut warnings = Vec::new();
    let made = compiler::rig(&mut loaded, sources, name, &Options::default(), &mut warnings);
    let made = made.unwrap_or_else(|errors| panic!("{errors:?}"));
    assert!(warnings.is_empty(), "{warnings:?}");
    made
}

fn path(instance: &abi::Instance, slot: Slot) -> String {
    let found = instance.description().quantities.iter().find(|quantity| quantity.slot == slot);
    found.map_or_else(|| format!("slot {}", slot.0), |quantity| quantity.path.clone())
}

#[test]
fn the_example_becomes_two_programs_and_a_plan() {
    let (text, sources) = texts();
    let CompiledRig { rig, control, plant, .. } = ready(&text, &sources, "rtfs");
    assert_eq!((rig.period_ns, rig.steps, rig.watchdog_ns, rig.overrun), (1_000_000, 1, 5_000_000, Overrun::Hold(2)));
    assert_eq!((rig.buses[0].address.as_str(), rig.buses[0].bit_rate), ("socketcan:can0", 1_000_000));
    let names: Vec<&str> = rig.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["load", "servo", "shaft", "panel"]);
    let Kind::Cia402(load) = &rig.nodes[0].kind else { panic!("a drive") };
    assert_eq!((load.node, load.rated_torque, load.mode, load.at_sync), (3, 4.0, Mode::Torque, false));
    assert_eq!(load.count, 2.0 * std::f64::consts::PI / 262_144.0);
    assert_eq!((rig.nodes[0].delay, rig.nodes[0].lag, rig.nodes[0].timeout_ns), (0.8e-3, 0.6e-3, 3_000_000));
    let Kind::Frames(messages) = &rig.nodes[2].kind else { panic!("frames") };
    let torque = &messages[0].fields[0];
    assert_eq!(
        (messages[0].id, messages[0].length, messages[0].period_ns, messages[0].send),
        (400, 4, 10_000_000, false)
    );
    assert_eq!((torque.name.as_str(), torque.scale, torque.start_bit, torque.bits), ("torque", 0.0005, 0, 16));
    let temperature = &messages[0].fields[1];
    assert_eq!((temperature.offset, temperature.unit.text.as_str()), (-40.0 + 273.15, "K"));
    let Kind::Frames(messages) = &rig.nodes[3].kind else { panic!("frames") };
    let ids: Vec<(u32, bool, u8)> = messages.iter().map(|message| (message.id, message.send, message.length)).collect();
    assert_eq!(ids, [(0x1A0, false, 1), (0x220, true, 1)]);

    // Inputs, outputs and limits.
    let read: Vec<(String, bool)> = rig.inputs.iter().map(|input| (path(&control, input.slot), input.needed)).collect();
    let expected = [("load.speed", true), ("servo.position", true), ("shaft.torque", false), ("panel.enable", true)];
    assert_eq!(read, expected.map(|(path, needed)| (path.to_string(), needed)));
    let told: Vec<(String, f64, f64, f64)> =
        rig.outputs.iter().map(|o| (path(&control, o.slot), o.low, o.high, o.slew)).collect();
    let inf = f64::INFINITY;
    let expected = [
        ("servo.torque command", -2.0, 2.0, inf),
        ("load.torque command", -1.0, 1.0, 200.0),
        ("panel.lamp command", -inf, inf, inf),
    ];
    assert_eq!(told, expected.map(|(path, low, high, slew)| (path.to_string(), low, high, slew)));
    let stops: Vec<&str> = rig.stops.iter().map(|stop| stop.why.as_str()).collect();
    assert_eq!(stops, ["overspeed", "enabling switch released"]);
    assert_eq!(
        rig.record.iter().map(|series| series.label.as_str()).collect::<Vec<_>>(),
        ["body.x", "body.v", "fr.F", "pid.u", "shaft.torque", "r"]
    );
    // What is recorded already is not recorded again.
    let plots: Vec<(&[usize], Option<usize>)> =
        rig.plots.iter().map(|plot| (plot.series.as_slice(), plot.against)).collect();
    assert_eq!(plots, [(&[0, 5][..], None), (&[1][..], None), (&[2, 3][..], None), (&[2][..], Some(1))]);

    // The part alone: the torques that drives apply move the shaft that encoders measure.
    let of = |node: usize, what: SignalKind| Signal { node, what };
    let applied: Vec<Signal> = rig.plant.applied.iter().map(|(signal, _)| *signal).collect();
    assert_eq!(applied, [of(1, SignalKind::Torque), of(0, SignalKind::Torque)]);
    let seen: Vec<Signal> = rig.plant.seen.iter().map(|(signal, _)| *signal).collect();
    assert_eq!(
        seen,
        [of(0, SignalKind::Speed), of(1, SignalKind::Position), of(1, SignalKind::Speed), of(0, SignalKind::Position)]
    );
    assert!((rig.plant.inertia.unwrap() - 0.012).abs() < 1e-12, "{:?}", rig.plant.inertia);
    let mut plant = plant;
    assert_eq!(plant.start(20e-6), 0);
    for (_, slot) in &rig.plant.applied {
        plant.set(*slot, 0.03);
    }
    assert_eq!(plant.advance(50), 0);
    let speed = rig.plant.seen[0].1;
    assert!((plant.get(speed) - 0.06 / 0.012 * 1e-3).abs() < 1e-12, "{}", plant.get(speed));
    // The control program has no state of the replaced part.
    let states: Vec<&str> = control
        .description()
        .quantities
        .iter()
        .filter(|quantity| quantity.kind == abi::description::Kind::State)
        .map(|quantity| quantity.path.as_str())
        .collect();
    assert_eq!(states, ["fr.z"]);
}

/// The textbook's bristle at rest, one step of 1 ms: z' = z + h v, F = σ0 z' + (σ1 + σ2) v. By hand.
#[test]
fn the_derivative_of_a_step_at_rest_is_that_of_its_formulas() {
    let folder = support::root().join("examples/rtfs");
    let text = std::fs::read_to_string(folder.join("stick_slip.fric")).unwrap();
    let sources = support::Texts(Vec::new());
    let mut loaded = compiler::load("stick_slip.fric", &text, &sources);
    let made = compiler::rig(&mut loaded, &sources, "plain", &compiler::Options::default(), &mut Vec::new());
    let made = made.unwrap_or_else(|errors| panic!("{errors:?}"));
    let speed = made.rig.inputs.iter().find(|input| input.signal.what == abi::rig::SignalKind::Speed).unwrap();
    let load = made.rig.outputs.iter().find(|output| output.signal.node == 0).unwrap();
    let derivative = compiler::rig::StepDerivative::new(&made.program, made.rig.method, &[speed.slot], &[load.slot]);
    let mut control = made.control.clone();
    control.start(1e-3);
    let step = derivative.at(control.block(), 1);
    let near =
        |found: f64, expected: f64| assert!((found - expected).abs() <= 1e-9 * expected.abs(), "{found} {expected}");
    assert_eq!((step.states, step.inputs, step.outputs), (1, 1, 1));
    near(step.a[0], 1.0);
    near(step.b[0], 1e-3);
    near(step.c[0], -1e5);
    near(step.d[0], -(1e5 * 1e-3 + 316.0 + 0.4));
}
