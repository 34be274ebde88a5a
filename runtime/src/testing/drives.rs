//! A rig for tests: two servos on one shaft, and a switch with a lamp; with both sides of its bus in one process.

use crate::can::Frame;
use crate::drive::{Fieldbus, Options, SimulatedBench, Step};
use crate::testing::models::Model;
use crate::testing::nodes;
use abi::rig::{DriveLimits, Field, Format, Kind, Message, Mode, Node, Plant, Rig, Signal, SignalKind};
use abi::unit::Unit;
use abi::{Function, Instance, Slot};

pub const LOAD: usize = 0;
pub const SERVO: usize = 1;
pub const PANEL: usize = 2;

const PERIOD_NS: u64 = 1_000_000;

pub fn drive(name: &str, node: u8, mode: Mode) -> Node {
    nodes::limited(nodes::drive(name, node, mode, PERIOD_NS), 2.0)
}

fn panel() -> Node {
    let field = |name: &str, start| Field {
        name: name.to_string(),
        start_bit: 0,
        bits: 8,
        big_endian: false,
        format: Format::Unsigned,
        scale: 1.0,
        offset: 0.0,
        start,
        unit: Unit::none(),
        multiplexed: None,
    };
    let message = |name: &str, id, send, start| Message {
        name: name.to_string(),
        id,
        extended: false,
        length: 1,
        send,
        period_ns: 0,
        fields: vec![field(name, start)],
    };
    Node {
        name: "panel".to_string(),
        bus: 0,
        kind: Kind::Frames(vec![message("enable", 0x1A0, false, 1.0), message("lamp", 0x220, true, 0.0)]),
        moves: false,
        delay: 0.0,
        lag: 0.0,
        timeout_ns: 100_000_000,
        within: DriveLimits::default(),
    }
}

/// Slots of the shaft's plant: torque of the load, torque of the servo, position, speed.
fn slots(plant: &Instance) -> [Slot; 4] {
    let layout = &plant.description().layout;
    [layout.memory.slot(0), layout.memory.slot(1), layout.outputs.slot(0), layout.outputs.slot(1)]
}

/// Two drives and a panel at 1 kHz, both drives in this mode.
pub fn rig(mode: Mode) -> Rig {
    let what = match mode {
        Mode::Torque => SignalKind::Torque,
        Mode::Speed => SignalKind::Speed,
        Mode::Position => SignalKind::Position,
    };
    let output = |node, what| nodes::output(node, what, Slot(0), [f64::NEG_INFINITY, f64::INFINITY]);
    let [load, servo, position, speed] = slots(&shaft(0.012, 0.001));
    let signal = |node, what| Signal { node, what };
    let all = vec![drive("load", 3, mode), drive("servo", 4, mode), panel()];
    Rig {
        method: abi::plan::Method::Expo,
        outputs: vec![output(LOAD, what), output(SERVO, what), output(PANEL, SignalKind::Field(1, 0))],
        predict: Some(LOAD),
        plant: Plant {
            applied: vec![(signal(LOAD, SignalKind::Torque), load), (signal(SERVO, SignalKind::Torque), servo)],
            seen: vec![
                (signal(LOAD, SignalKind::Position), position),
                (signal(LOAD, SignalKind::Speed), speed),
                (signal(SERVO, SignalKind::Position), position),
                (signal(SERVO, SignalKind::Speed), speed),
            ],
            inertia: Some(0.012),
        },
        ..nodes::rig("rtfs", "sim:bench", PERIOD_NS, all)
    }
}

/// J dv/dt = load + servo − b v; J in kg·m², b in N·m·s/rad.
pub fn shaft(inertia: f64, viscous: f64) -> Instance {
    Model::new("Shaft")
        .memory(2)
        .state("x", "rad")
        .state("v", "rad/s")
        .output("position", "rad")
        .output("speed", "rad/s")
        .body(Function::Derivatives, move |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, (m.memory(0) + m.memory(1) - viscous * m.x(1)) / inertia);
        })
        .body(Function::Outputs, |m| {
            m.set_y(0, m.x(0));
            m.set_y(1, m.x(1));
        })
        .build()
}

/// Both sides of a bus connected directly: each frame arrives at once.
pub struct Table {
    pub fieldbus: Fieldbus,
    pub bench: SimulatedBench,
    pub now_ns: u64,
    pub period_ns: u64,
    /// Commands of the model while armed.
    pub commands: Vec<(Signal, f64)>,
    /// All frames sent: time in ns, whether by the master, frame.
    pub log: Vec<(u64, bool, Frame)>,
}

impl Table {
    pub fn new(rig: &Rig, plant: Option<Instance>, options: Options) -> Table {
        let bench = SimulatedBench::new(rig, plant, 7).expect("a bench");
        Table::with(rig, bench, options)
    }

    pub fn with(rig: &Rig, bench: SimulatedBench, options: Options) -> Table {
        Table {
            fieldbus: Fieldbus::new(rig, options).expect("a right rig"),
            bench,
            now_ns: 0,
            period_ns: rig.period_ns,
            commands: rig.outputs.iter().map(|output| (output.signal, 0.0)).collect(),
            log: Vec::new(),
        }
    }

    /// Exchanges frames between master and simulated plant until neither has any to send.
    fn exchange(&mut self, mut ours: Vec<Frame>) {
        while !ours.is_empty() {
            let (mut answers, mut more) = (Vec::new(), Vec::new());
            for frame in ours.drain(..) {
                self.log.push((self.now_ns, true, frame));
                self.bench.receive(0, &frame, self.now_ns, &mut |_, frame| answers.push(frame));
            }
            for frame in answers {
                self.log.push((self.now_ns, false, frame));
                self.fieldbus.receive(0, &frame, self.now_ns, &mut |_, frame| more.push(frame));
            }
            ours = more;
        }
    }

    /// Advances the simulated plant alone to a time.
    pub fn run_to(&mut self, until_ns: u64) {
        while self.now_ns < until_ns {
            self.now_ns = self.bench.due_ns().clamp(self.now_ns + 1, until_ns);
            let mut sent = Vec::new();
            self.bench.advance(self.now_ns, &mut |_, frame| sent.push(frame));
            let mut ours = Vec::new();
            for frame in sent {
                self.log.push((self.now_ns, false, frame));
                self.fieldbus.receive(0, &frame, self.now_ns, &mut |_, frame| ours.push(frame));
            }
            self.exchange(ours);
        }
    }

    /// One cycle: SYNC, answers, commands half a period later.
    pub fn tick(&mut self) {
        let start = self.now_ns;
        let mut ours = Vec::new();
        self.fieldbus.begin(&mut |_, frame| ours.push(frame));
        self.exchange(ours);
        self.run_to(start + self.period_ns / 2);
        for (signal, value) in &self.commands {
            let value = if self.fieldbus.step() == Step::Armed { *value } else { self.fieldbus.wanted(*signal) };
            self.fieldbus.command(*signal, value);
        }
        let mut ours = Vec::new();
        self.fieldbus.end(self.now_ns, &mut |_, frame| ours.push(frame));
        self.exchange(ours);
        self.run_to(start + self.period_ns);
    }

    pub fn ticks(&mut self, n: usize) {
        (0..n).for_each(|_| self.tick());
    }

    /// Ticks until a step is reached; panics if it never is.
    pub fn until(&mut self, step: Step) {
        for _ in 0..20_000 {
            if self.fieldbus.step() == step {
                return;
            }
            self.tick();
        }
        let refusal = self.fieldbus.refusal().map(|refusal| self.fieldbus.explain(refusal));
        panic!("stays at {:?}, {refusal:?}", self.fieldbus.step());
    }

    /// Performs the whole start-up.
    pub fn arm(&mut self) {
        self.until(Step::AwaitEnable);
        assert!(self.fieldbus.request(crate::drive::Request::Enable));
        self.until(Step::AwaitArm);
        assert!(self.fieldbus.request(crate::drive::Request::Arm));
    }

    /// The message of the refusal that the start-up ends with.
    pub fn refused(&mut self) -> String {
        for _ in 0..20_000 {
            if let Some(refusal) = self.fieldbus.refusal() {
                return self.fieldbus.explain(refusal);
            }
            if self.fieldbus.step() == Step::AwaitEnable {
                self.fieldbus.request(crate::drive::Request::Enable);
            }
            assert_ne!(self.fieldbus.step(), Step::AwaitArm, "it was not refused");
            self.tick();
        }
        panic!("stays at {:?}", self.fieldbus.step());
    }

    pub fn value(&self, node: usize, what: SignalKind) -> f64 {
        self.fieldbus.reading(Signal { node, what }).value
    }
}
