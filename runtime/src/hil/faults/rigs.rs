//! The rigs of the fault space: small, with the periods, drives and limits of real rigs.
//!
//! In: a few numbers. Out: a rig with its control program and its plant program, all written by hand.

use crate::hil::live::Judge;
use crate::testing::models::{Model, View};
use crate::testing::rigs;
use abi::live::{Check, Live, Param, Tunable};
use abi::rig::{
    Bus, Cia402, Field, Format, Input, Kind, Message, Mode, Node, Output, Overrun, Plant, Rig, Signal, SignalKind,
};
use abi::unit::Unit;
use abi::{Function, Instance};
use std::f64::consts::TAU;

/// Moment of inertia of the shaft, kg·m².
pub const INERTIA: f64 = 0.012;
/// Friction of the shaft's bearings, N·m·s/rad.
const BEARINGS: f64 = 0.01;
/// An angle of more than 32 bits of counts, rad.
const FAR: f64 = 60_000.0;
/// Time after arming in which the model requests zero, s.
pub const REST: f64 = 0.02;
/// COB-IDs of command and answer of the drive that is described by frames.
pub const FRAME_COMMAND: u32 = 0x321;
pub const FRAME_ANSWER: u32 = 0x322;

/// Drives of a rig. The last drive moves the shaft, the first one brakes it.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Sort {
    /// One torque drive.
    One,
    /// Two torque drives.
    Pair,
    /// Two torque drives, each on a bus of its own.
    TwoBuses,
    /// The servo controls a speed, the load a torque.
    SpeedServo,
    /// The servo controls a position, the load a torque.
    PositionServo,
    /// The servo is described by frames, the load is a CiA 402 drive.
    FramesServo,
}

impl Sort {
    pub const ALL: [Sort; 6] =
        [Sort::Pair, Sort::One, Sort::TwoBuses, Sort::SpeedServo, Sort::PositionServo, Sort::FramesServo];
}

/// Parameters of one rig.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Made {
    pub sort: Sort,
    /// Amplitude of the command that moves the shaft, as a share of its limit; above 1 it is clamped.
    pub swing: f64,
    /// Frequency of that command, Hz.
    pub hertz: f64,
    /// Damping by the load, N·m·s/rad.
    pub damping: f64,
    /// Rated torque of the drives, N·m; a thousandth is one quantisation step on the bus.
    pub rated: f64,
    /// Highest torque of each drive, N·m.
    pub most: f64,
    /// Slew limit of a torque, N·m/s; 0: none.
    pub slew: f64,
    /// Highest speed, rad/s.
    pub speed: f64,
    /// Permitted angle in either direction, rad; 0: any.
    pub travel: f64,
    /// Highest power of each drive, W; 0: highest torque times highest speed.
    pub power: f64,
    /// Number of missed ticks that the rig tolerates.
    pub hold: u32,
    /// Commands act with the next SYNC.
    pub at_sync: bool,
    /// The model requests its full amplitude in the first cycle.
    pub eager: bool,
    /// Safe value of the outputs, as a share of their limit; other than 0 the rig must not start.
    pub safe: f64,
    /// The model requests a position further away than 32 bits of counts can express.
    pub far: bool,
    /// Time of the model from which its output is NaN, s; 0: never.
    pub no_number: f64,
    /// The drive described by frames reports its speed as a float.
    pub float: bool,
}

/// The reference rig: others are simplified towards it.
pub const PLAIN: Made = Made {
    sort: Sort::Pair,
    swing: 0.8,
    hertz: 2.0,
    damping: 0.05,
    rated: 4.0,
    most: 2.0,
    slew: 0.0,
    speed: 200.0,
    travel: 0.0,
    power: 0.0,
    hold: 0,
    at_sync: false,
    eager: false,
    safe: 0.0,
    far: false,
    no_number: 0.0,
    float: false,
};

/// Indices of the control program's parameters that a set changes: the second value must be the first plus 1.
pub const TWINS: [usize; 2] = [5, 6];

impl Made {
    /// Highest command of a node in either direction: torque, speed or position.
    fn limit(&self, mode: Mode) -> f64 {
        match mode {
            Mode::Torque => self.most,
            Mode::Speed => self.speed.min(20.0),
            Mode::Position if self.far => FAR,
            Mode::Position => 2.0,
        }
    }

    /// Amplitude of the command that moves the shaft: for a controlled speed or position a drive needs half of its
    /// torque.
    fn amplitude(&self, mode: Mode) -> f64 {
        if self.far && mode == Mode::Position {
            return 0.9 * FAR;
        }
        let omega = TAU * self.hertz;
        let follows = match mode {
            Mode::Torque => self.most,
            Mode::Speed => 0.5 * self.most / (INERTIA * omega),
            Mode::Position => self.most / (INERTIA * omega * omega),
        };
        self.swing * follows.min(self.limit(mode))
    }

    /// Rig, control program, plant program.
    pub fn build(&self) -> (Rig, Instance, Instance) {
        let modes: &[Option<Mode>] = match self.sort {
            Sort::One => &[Some(Mode::Torque)],
            Sort::Pair | Sort::TwoBuses => &[Some(Mode::Torque), Some(Mode::Torque)],
            Sort::SpeedServo => &[Some(Mode::Torque), Some(Mode::Speed)],
            Sort::PositionServo => &[Some(Mode::Torque), Some(Mode::Position)],
            Sort::FramesServo => &[Some(Mode::Torque), None],
        };
        let (control, plant) = (self.control(modes), plant(modes.len()));
        let (inside, outside) = (control.description().layout.clone(), plant.description().layout.clone());
        let told = |node: usize| modes[node].map_or(SignalKind::Field(0, 0), commanded);
        let signal = |node, what| Signal { node, what };
        let outputs = (0..modes.len()).map(|node| {
            let mode = modes[node].unwrap_or(Mode::Torque);
            let most = self.limit(mode);
            // A slew is given in N·m/s; other commands reach their limit in the same time as the torque would.
            let slew = if self.slew > 0.0 { self.slew * most / self.most } else { f64::INFINITY };
            let (signal, slot) = (signal(node, told(node)), inside.outputs.slot(node));
            Output { signal, slot, low: -most, high: most, slew, safe: self.safe * most }
        });
        let last = modes.len() - 1;
        let reads = if modes[last].is_none() { SignalKind::Field(1, 0) } else { SignalKind::Position };
        let input =
            |node, what, i| Input { signal: signal(node, what), slot: inside.inputs.slot(i), start: 0.0, needed: true };
        let seen = |node: usize| -> Vec<(Signal, abi::Slot)> {
            let speed = outside.outputs.slot(1);
            match modes[node] {
                Some(_) => {
                    vec![
                        (signal(node, SignalKind::Position), outside.outputs.slot(0)),
                        (signal(node, SignalKind::Speed), speed),
                    ]
                }
                None => vec![(signal(node, SignalKind::Field(1, 0)), speed)],
            }
        };
        let applied = |node: usize| {
            let what = if modes[node].is_none() { SignalKind::Field(0, 0) } else { SignalKind::Torque };
            (signal(node, what), outside.inputs.slot(node))
        };
        let bus = |name: &str| Bus { name: name.into(), address: format!("sim:{name}"), bit_rate: 1_000_000 };
        let buses = if self.sort == Sort::TwoBuses { vec![bus("can0"), bus("can1")] } else { vec![bus("can0")] };
        let rig = Rig {
            name: "space".into(),
            buses,
            nodes: (0..modes.len()).map(|node| self.node(node, modes[node])).collect(),
            inputs: vec![input(0, SignalKind::Speed, 0), input(last, reads, 1)],
            outputs: outputs.collect(),
            overrun: if self.hold == 0 { Overrun::Stop } else { Overrun::Hold(self.hold) },
            plant: Plant {
                applied: (0..modes.len()).map(applied).collect(),
                seen: (0..modes.len()).flat_map(seen).collect(),
                inertia: Some(INERTIA),
            },
            ..rigs::rig().0
        };
        (rig, control, plant)
    }

    fn node(&self, at: usize, mode: Option<Mode>) -> Node {
        let name = ["load", "servo"][at];
        let made = rigs::drive(name, 3 + at as u8);
        let bus = if self.sort == Sort::TwoBuses { at } else { 0 };
        let Some(mode) = mode else { return Node { bus, kind: described(self.float), ..made } };
        let Kind::Cia402(drive) = made.kind else { unreachable!("a drive of the bench follows CiA 402") };
        let some = |value: f64| (value > 0.0).then_some(value);
        let kind = Kind::Cia402(Cia402 {
            rated_torque: self.rated,
            mode,
            max_torque: Some(self.most),
            max_speed: Some(self.speed),
            max_power: some(self.power),
            travel: match mode {
                Mode::Position => Some((-self.limit(mode), self.limit(mode))),
                Mode::Torque | Mode::Speed => some(self.travel).map(|most| (-most, most)),
            },
            at_sync: self.at_sync,
            ..drive
        });
        // A command that acts with the next SYNC is at least one period late.
        Node { bus, kind, delay: if self.at_sync { 1.8e-3 } else { made.delay }, ..made }
    }

    /// The last node swings after its rest, the other one damps the shaft.
    fn control(&self, modes: &[Option<Mode>]) -> Instance {
        let last = modes.len() - 1;
        let position = modes[last] == Some(Mode::Position);
        let amplitude = self.amplitude(modes[last].unwrap_or(Mode::Torque));
        let never = if self.no_number > 0.0 { self.no_number } else { f64::INFINITY };
        let eager = self.eager;
        let swing = move |view: &View| {
            let t = (view.t() - view.p(4)).max(0.0);
            let phase = TAU * view.p(1) * t;
            // A position starts without a step in its speed.
            let wave = match (position, eager) {
                (true, _) => (1.0 - phase.cos()) / 2.0,
                (false, true) => phase.cos(),
                (false, false) => phase.sin(),
            };
            if view.t() < view.p(3) { view.p(0) * wave } else { f64::NAN }
        };
        let model = Model::new("Swing")
            .param(amplitude)
            .param(self.hertz)
            .param(self.damping)
            .param(never)
            .param(if self.eager { 0.0 } else { REST })
            .param(0.0)
            .param(1.0)
            .inputs(2)
            .state("angle", "rad")
            .output("first", "N·m");
        let model = if last > 0 { model.output("second", "N·m") } else { model };
        model
            .body(Function::Derivatives, |view| view.set_dx(0, view.u(0)))
            .body(Function::Outputs, move |view| {
                if last > 0 {
                    view.set_y(0, if view.t() < view.p(4) { 0.0 } else { -view.p(2) * view.u(0) });
                }
                let value = swing(view);
                view.set_y(last, value);
            })
            .build()
    }
}

/// Condition on the parameters that a set changes: the second is the first plus 1.
pub fn judge(control: &Instance) -> Judge {
    let program = Model::new("judge")
        .param(0.0)
        .param(1.0)
        .output("fits", "1")
        .body(Function::Outputs, |view| view.set_y(0, f64::from(view.p(1) == view.p(0) + 1.0)))
        .build();
    let (inside, judged) = (&control.description().layout, &program.description().layout);
    let param = |i: usize, path: &str| Param {
        path: path.into(),
        unit: Unit::parse("1").expect("a unit that is known"),
        boolean: false,
        place: Tunable::Live(inside.params.slot(TWINS[i]), judged.params.slot(i)),
    };
    let live = Live {
        params: vec![param(0, "first"), param(1, "second")],
        checks: vec![Check::Require { message: "they fit".into(), value: judged.outputs.slot(0) }],
        tuned: Vec::new(),
    };
    Judge::new(live, program, control).expect("both have the two parameters")
}

/// The signal that a mode commands.
pub fn commanded(mode: Mode) -> SignalKind {
    match mode {
        Mode::Torque => SignalKind::Torque,
        Mode::Speed => SignalKind::Speed,
        Mode::Position => SignalKind::Position,
    }
}

/// A shaft on which this many torques act.
fn plant(torques: usize) -> Instance {
    Model::new("Shaft")
        .inputs(torques as u32)
        .state("x", "rad")
        .state("v", "rad/s")
        .output("position", "rad")
        .output("speed", "rad/s")
        .body(Function::Derivatives, move |view| {
            view.set_dx(0, view.x(1));
            let torque: f64 = (0..torques).map(|i| view.u(i)).sum();
            view.set_dx(1, (torque - BEARINGS * view.x(1)) / INERTIA);
        })
        .body(Function::Outputs, |view| {
            view.set_y(0, view.x(0));
            view.set_y(1, view.x(1));
        })
        .build()
}

/// A drive that receives a torque and reports a speed, each in a frame.
fn described(float: bool) -> Kind {
    let format = |bits| if float && bits == 32 { Format::Float32 } else { Format::Signed };
    let field = |name: &str, bits, unit: &str| Field {
        name: name.into(),
        start_bit: 0,
        bits,
        big_endian: false,
        format: format(bits),
        scale: 1e-3,
        offset: 0.0,
        start: 0.0,
        unit: Unit::parse(unit).unwrap(),
        multiplexed: None,
    };
    let message = |name: &str, id, length, send, field: Field| Message {
        name: name.into(),
        id,
        extended: false,
        length,
        send,
        period_ns: rigs::PERIOD_NS,
        fields: vec![field],
    };
    Kind::Frames(vec![
        message("command", FRAME_COMMAND, 2, true, field("torque", 16, "N·m")),
        message("answer", FRAME_ANSWER, 4, false, field("speed", 32, "rad/s")),
    ])
}
