//! Hand-written models for tests: the functions that a compiler would generate, as closures over a [`View`].

use abi::description::{Automaton, Guard, Kind, Quantity, Root, Tick};
use abi::plan::{Expect, Experiment, Formula, Measure, MeasureKind, Method, PARTS, Plot, Series, Solver, Window};
use abi::table::{Interpret, keep_time};
use abi::unit::Unit;
use abi::{Code, Description, Function, Instance, Layout, Slot};
use std::sync::Arc;

/// The block of a model during a call of one of its functions.
pub struct View<'a> {
    block: &'a mut [f64],
    layout: &'a Layout,
}

impl View<'_> {
    /// Time in s.
    pub fn t(&self) -> f64 {
        self.block[Slot::TIME.index()]
    }
    pub fn p(&self, i: usize) -> f64 {
        self.block[self.layout.params.slot(i).index()]
    }
    pub fn u(&self, i: usize) -> f64 {
        self.block[self.layout.inputs.slot(i).index()]
    }
    pub fn x(&self, i: usize) -> f64 {
        self.block[self.layout.states.slot(i).index()]
    }
    pub fn set_x(&mut self, i: usize, value: f64) {
        self.block[self.layout.states.slot(i).index()] = value;
    }
    pub fn memory(&self, i: usize) -> f64 {
        self.block[self.layout.memory.slot(i).index()]
    }
    pub fn set_memory(&mut self, i: usize, value: f64) {
        self.block[self.layout.memory.slot(i).index()] = value;
    }
    pub fn regime(&self, i: usize) -> f64 {
        self.block[self.layout.regimes.slot(i).index()]
    }
    pub fn set_regime(&mut self, i: usize, value: f64) {
        self.block[self.layout.regimes.slot(i).index()] = value;
    }
    pub fn set_y(&mut self, i: usize, value: f64) {
        self.block[self.layout.outputs.slot(i).index()] = value;
    }
    pub fn set_dx(&mut self, i: usize, value: f64) {
        self.block[self.layout.derivatives.slot(i).index()] = value;
    }
    pub fn set_root(&mut self, i: usize, value: f64) {
        self.block[self.layout.roots.slot(i).index()] = value;
    }
    /// ∂f/∂x row-major, then ∂f/∂t.
    pub fn set_jacobian(&mut self, values: &[f64]) {
        self.block[self.layout.jacobian.range()].copy_from_slice(values);
    }
    pub fn due(&self, i: usize) -> bool {
        self.block[self.layout.due.slot(i).index()] == 1.0
    }
}

type Body = Box<dyn Fn(&mut View) + Send + Sync>;

/// Builds a model. Every part is optional.
pub struct Model {
    name: &'static str,
    params: Vec<f64>,
    states: Vec<(&'static str, Unit, (f64, f64))>,
    outputs: Vec<(&'static str, Unit)>,
    inputs: u32,
    memory: u32,
    regimes: Vec<Vec<&'static str>>,
    roots: Vec<&'static str>,
    periods: Vec<f64>,
    guards: Vec<(Slot, &'static str, (f64, f64))>,
    bodies: [Option<Body>; Function::ALL.len()],
}

impl Model {
    pub fn new(name: &'static str) -> Model {
        Model {
            name,
            params: Vec::new(),
            states: Vec::new(),
            outputs: Vec::new(),
            inputs: 0,
            memory: 0,
            regimes: Vec::new(),
            roots: Vec::new(),
            periods: Vec::new(),
            guards: Vec::new(),
            bodies: [const { None }; Function::ALL.len()],
        }
    }
    pub fn param(mut self, value: f64) -> Model {
        self.params.push(value);
        self
    }
    pub fn state(mut self, path: &'static str, unit: &str) -> Model {
        self.states.push((path, Unit::parse(unit).unwrap(), (f64::NEG_INFINITY, f64::INFINITY)));
        self
    }
    pub fn output(mut self, path: &'static str, unit: &str) -> Model {
        self.outputs.push((path, Unit::parse(unit).unwrap()));
        self
    }
    pub fn inputs(mut self, slots: u32) -> Model {
        self.inputs = slots;
        self
    }
    pub fn memory(mut self, slots: u32) -> Model {
        self.memory = slots;
        self
    }
    pub fn automaton(mut self, regimes: &[&'static str]) -> Model {
        self.regimes.push(regimes.to_vec());
        self
    }
    pub fn root(mut self, text: &'static str) -> Model {
        self.roots.push(text);
        self
    }
    /// A sampled block of this period in s.
    pub fn every(mut self, period: f64) -> Model {
        self.periods.push(period);
        self
    }
    /// Guards the range of the state declared last.
    pub fn within(mut self, range: (f64, f64)) -> Model {
        self.states.last_mut().unwrap().2 = range;
        self
    }
    pub fn body(mut self, function: Function, body: impl Fn(&mut View) + Send + Sync + 'static) -> Model {
        self.bodies[function as usize] = Some(Box::new(body));
        self
    }

    /// The finished instance. `Step` is a classical Runge-Kutta step of the derivatives, with ticks, transitions and
    /// guards as they apply.
    pub fn build(mut self) -> Instance {
        let n = self.states.len() as u32;
        let layout = Layout::new([
            self.params.len() as u32,
            self.inputs,
            n,
            self.memory + self.periods.len() as u32,
            self.regimes.len() as u32,
            self.outputs.len() as u32,
            n,
            self.roots.len() as u32,
            n * n + n,
            self.periods.len() as u32,
        ]);
        let unbounded = (f64::NEG_INFINITY, f64::INFINITY);
        let mut quantities = Vec::new();
        let quantity = |path: &str, kind, unit: &Unit, slot, range| Quantity {
            path: path.into(),
            kind,
            unit: unit.clone(),
            boolean: false,
            slot,
            range,
            doc: None,
        };
        let mut guards = Vec::new();
        for (i, (path, unit, range)) in self.states.iter().enumerate() {
            let slot = layout.states.slot(i);
            quantities.push(quantity(path, Kind::State, unit, slot, *range));
            if *range != unbounded {
                self.guards.push((slot, path, *range));
                guards.push(Guard { path: (*path).into(), slot, range: *range, unit: unit.clone() });
            }
        }
        for (i, (path, unit)) in self.outputs.iter().enumerate() {
            quantities.push(quantity(path, Kind::Output, unit, layout.outputs.slot(i), unbounded));
        }
        let automata = self.regimes.iter().enumerate().map(|(i, regimes)| Automaton {
            path: String::new(),
            regimes: regimes.iter().map(|name| (*name).to_string()).collect(),
            slot: layout.regimes.slot(i),
        });
        let ticks = (0..self.periods.len())
            .map(|i| Tick { period: layout.memory.slot(self.memory as usize + i), due: layout.due.slot(i) });
        let description = Description {
            name: self.name.into(),
            quantities,
            ticks: ticks.collect(),
            automata: automata.collect(),
            delays: Vec::new(),
            guards,
            roots: self
                .roots
                .iter()
                .map(|text| Root { text: (*text).into(), decides: true, bends: false, observed: false })
                .collect(),
            coupling: Arc::new([]),
            pool: Arc::new([]),
            layout,
        };
        let params = self.params.clone();
        let hand = Hand { layout: description.layout.clone(), model: self };
        Instance::new(Arc::new(description), Code::Interpreted(Arc::new(hand)), &params)
    }
}

/// Largest number of states of a hand-written model with fixed steps.
const MOST_STATES: usize = 16;

struct Hand {
    layout: Layout,
    model: Model,
}

impl Hand {
    fn run(&self, function: Function, block: &mut [f64]) {
        if let Some(body) = &self.model.bodies[function as usize] {
            body(&mut View { block, layout: &self.layout });
        }
    }

    /// The classical Runge-Kutta step of order four. Does not allocate, as no step in a cycle may.
    fn step(&self, block: &mut [f64]) -> u64 {
        let h = block[Slot::STEP.index()];
        let t = block[Slot::COUNT.index()] * h;
        let states = self.layout.states.range();
        let n = states.len();
        assert!(n <= MOST_STATES, "a model by hand has {n} states");
        let [mut x0, mut k, mut sum] = [[0.0; MOST_STATES]; 3];
        x0[..n].copy_from_slice(&block[states.clone()]);
        for (part, weight) in [(0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)] {
            block[Slot::TIME.index()] = t + part * h;
            for ((x, x0), k) in block[states.clone()].iter_mut().zip(&x0).zip(&k) {
                *x = x0 + part * h * k;
            }
            self.run(Function::Derivatives, block);
            k[..n].copy_from_slice(&block[self.layout.derivatives.range()]);
            sum.iter_mut().zip(&k).for_each(|(sum, k)| *sum += weight * k);
        }
        for ((x, x0), sum) in block[states].iter_mut().zip(&x0).zip(&sum) {
            *x = x0 + h / 6.0 * sum;
        }
        block[Slot::COUNT.index()] += 1.0;
        keep_time(block);
        self.run(Function::Transitions, block);
        self.run(Function::Outputs, block);
        let bad = |(slot, _, range): &(Slot, &str, (f64, f64))| {
            let value = block[slot.index()];
            !(range.0 <= value && value <= range.1)
        };
        self.model.guards.iter().position(bad).map_or(0, |k| k as u64 + 1)
    }
}

impl Interpret for Hand {
    fn call(&self, function: Function, block: &mut [f64], _pool: &[f64], count: u64) -> u64 {
        for _ in 0..count {
            if function == Function::Step {
                let status = self.step(block);
                if status != 0 {
                    return status;
                }
            } else {
                self.run(function, block);
                if function == Function::Start {
                    let periods = self.layout.memory.start as usize + self.model.memory as usize;
                    block[periods..periods + self.model.periods.len()].copy_from_slice(&self.model.periods);
                }
            }
        }
        0
    }

    fn has(&self, function: Function) -> bool {
        function == Function::Step || self.model.bodies[function as usize].is_some()
    }
}

/// `x = a exp(−t/tau)` by its equation, with a = 1, tau = 1 s; output `y = 2 x`.
pub fn decay() -> Instance {
    Model::new("Decay")
        .state("x", "m")
        .output("y", "m")
        .body(Function::Start, |m| m.set_x(0, 1.0))
        .body(Function::Derivatives, |m| m.set_dx(0, -m.x(0)))
        .body(Function::Jacobian, |m| m.set_jacobian(&[-1.0, 0.0]))
        .body(Function::Outputs, |m| m.set_y(0, 2.0 * m.x(0)))
        .build()
}

/// x = sin t, v = cos t.
pub fn oscillator() -> Instance {
    Model::new("Oscillator")
        .state("x", "m")
        .state("v", "m/s")
        .output("energy", "J")
        .body(Function::Start, |m| {
            m.set_x(0, 0.0);
            m.set_x(1, 1.0);
        })
        .body(Function::Derivatives, |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, -m.x(0));
        })
        .body(Function::Jacobian, |m| m.set_jacobian(&[0.0, 1.0, -1.0, 0.0, 0.0, 0.0]))
        .body(Function::Outputs, |m| m.set_y(0, 0.5 * (m.x(0) * m.x(0) + m.x(1) * m.x(1))))
        .build()
}

/// The slot of a quantity.
pub fn slot(instance: &Instance, path: &str) -> Slot {
    instance.description().quantity(path).unwrap_or_else(|| panic!("no quantity `{path}`")).slot
}

/// A fixed-step experiment without plots and expectations.
pub fn fixed(duration: f64, step: f64) -> Experiment {
    let solver = Solver { method: Method::Rk4, step, tol: 0.0, parts: PARTS };
    Experiment {
        name: "test".into(),
        duration,
        solver,
        bench: None,
        plots: Vec::new(),
        records: Vec::new(),
        every: None,
        expects: Vec::new(),
        corners: Vec::new(),
        stepped: false,
    }
}

/// An adaptive experiment without plots and expectations.
pub fn adaptive(duration: f64, tol: f64) -> Experiment {
    Experiment { solver: Solver { method: Method::Adaptive, step: 0.0, tol, parts: PARTS }, ..fixed(duration, 1.0) }
}

/// `text` over the whole run, to read one measure: the condition is the measure itself.
pub fn reading(instance: &Instance, kind: MeasureKind, path: &str) -> Expect {
    let quantity = instance.description().quantity(path).unwrap_or_else(|| panic!("no quantity `{path}`"));
    let measure = Measure {
        text: format!("{kind:?}({path})"),
        kind,
        slot: quantity.slot,
        unit: quantity.unit.clone(),
        window: Window::default(),
    };
    Expect {
        text: measure.text.clone(),
        measures: vec![measure],
        condition: Formula::Measure(0),
        after: 0.0,
        before: f64::INFINITY,
    }
}

/// A plot of these quantities over time.
pub fn plot(instance: &Instance, paths: &[&str]) -> Plot {
    let series = |path: &&str| Series {
        label: (*path).into(),
        slot: slot(instance, path),
        unit: instance.description().quantity(path).unwrap().unit.clone(),
        boolean: false,
    };
    Plot { series: paths.iter().map(series).collect(), against: None, view: Default::default() }
}

/// A mass of 1 kg pulled through a spring of k = 2 N/m at 0.1 m/s, held by LuGre friction with the parameters of
/// Canudas de Wit et al. (1995) and this micro-damping in N·s/m. States x, v, z; output: force of the spring.
pub fn stick_slip(sigma1: f64) -> Instance {
    const M: f64 = 1.0;
    const K: f64 = 2.0;
    const PULL: f64 = 0.1;
    const SIGMA0: f64 = 1e5;
    const SIGMA2: f64 = 0.4;
    const FC: f64 = 1.0;
    const FS: f64 = 1.5;
    const VS: f64 = 1e-3;
    let level = |v: f64| FC + (FS - FC) * (-(v / VS) * (v / VS)).exp();
    Model::new("Pull(LuGre)")
        .state("x", "m")
        .state("v", "m/s")
        .state("z", "um")
        .output("pull", "N")
        .root("v < 0")
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, move |m| {
            let (x, v, z) = (m.x(0), m.x(1), m.x(2));
            let dz = v - SIGMA0 * v.abs() / level(v) * z;
            m.set_dx(0, v);
            m.set_dx(1, (K * (PULL * m.t() - x) - SIGMA0 * z - sigma1 * dz - SIGMA2 * v) / M);
            m.set_dx(2, dz);
        })
        .body(Function::Jacobian, move |m| {
            let (v, z) = (m.x(1), m.x(2));
            let g = level(v);
            let slope = -2.0 * v / (VS * VS) * (g - FC);
            let sign = if v < 0.0 { -1.0 } else { 1.0 };
            let dz_dv = 1.0 - SIGMA0 * z * (sign / g - v.abs() * slope / (g * g));
            let dz_dz = -SIGMA0 * v.abs() / g;
            m.set_jacobian(&[
                0.0,
                1.0,
                0.0,
                -K / M,
                (-sigma1 * dz_dv - SIGMA2) / M,
                (-SIGMA0 - sigma1 * dz_dz) / M,
                0.0,
                dz_dv,
                dz_dz,
                0.0,
                K * PULL / M,
                0.0,
            ]);
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(1)))
        .body(Function::Outputs, |m| m.set_y(0, K * (PULL * m.t() - m.x(0))))
        .build()
}

/// The contact model of [`dry_pull`].
#[derive(Clone, Copy)]
pub enum Contact {
    Karnopp,
    Kfm,
}

/// The mass and spring of [`stick_slip`] on a dry contact: 1 N sliding, 1.5 N at rest, 0.4 N·s/m. Karnopp's dead band
/// is one condition; KFM is an automaton of `stick`, `forward` and `backward`. `load`: a constant force in N instead
/// of the spring. States x, v, and of KFM the travel since it came to rest.
pub fn dry_pull(contact: Contact, load: Option<f64>) -> Instance {
    const FC: f64 = 1.0;
    const FS: f64 = 1.5;
    const FV: f64 = 0.4;
    const DV: f64 = 1e-3;
    const B: f64 = 1000.0;
    const V_HOLD: f64 = 10e-3;
    const X_HOLD: f64 = 10e-6;
    let pull = move |m: &View| load.unwrap_or(2.0 * (0.1 * m.t() - m.x(0)));
    let model = match contact {
        Contact::Karnopp => Model::new("Pull(Karnopp)"),
        Contact::Kfm => Model::new("Pull(KFM)").automaton(&["stick", "forward", "backward"]),
    };
    let model = model.state("x", "m").state("v", "m/s").state("slip", "um").output("pull", "N");
    let friction = move |m: &View| {
        let (v, pull) = (m.x(1), pull(m));
        let stuck = |bleed: f64| (pull + bleed * v).clamp(-FS, FS);
        match contact {
            Contact::Karnopp if v.abs() < DV => stuck(FS / DV),
            Contact::Karnopp => FC * v.signum() + FV * v,
            Contact::Kfm => match m.regime(0) {
                0.0 => stuck(B),
                1.0 => FC + FV * v,
                _ => -FC + FV * v,
            },
        }
    };
    let model = match contact {
        Contact::Karnopp => model.root("fr: v < Dv").root("fr: -v < Dv").root("fr: clamp").root("fr: clamp").body(
            Function::Roots,
            move |m| {
                let (v, force) = (m.x(1), pull(m) + FS / DV * m.x(1));
                [v - DV, v + DV, force - FS, force + FS].into_iter().enumerate().for_each(|(i, g)| m.set_root(i, g));
            },
        ),
        Contact::Kfm => (0..8)
            .fold(model, |model, _| model.root("fr: go"))
            .body(Function::Roots, move |m| {
                let (v, slip, pull) = (m.x(1), m.x(2), pull(m));
                let force = pull + B * v;
                let stick = [pull - FS, pull + FS, v - V_HOLD, v + V_HOLD, slip - X_HOLD, slip + X_HOLD];
                let roots = if m.regime(0) == 0.0 {
                    [v, stick[0], stick[1], stick[2], stick[3], stick[4], stick[5], (force - FS) * (force + FS)]
                } else {
                    [v, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
                };
                roots.into_iter().enumerate().for_each(|(i, g)| m.set_root(i, g));
            })
            .body(Function::Transitions, move |m| {
                let (v, slip, pull) = (m.x(1), m.x(2), pull(m));
                match m.regime(0) {
                    0.0 if (pull > FS && v >= 0.0) || v > V_HOLD || slip > X_HOLD => m.set_regime(0, 1.0),
                    0.0 if (pull < -FS && v <= 0.0) || v < -V_HOLD || slip < -X_HOLD => m.set_regime(0, 2.0),
                    1.0 if v < 0.0 => m.set_regime(0, 0.0),
                    2.0 if v > 0.0 => m.set_regime(0, 0.0),
                    _ => return,
                }
                if m.regime(0) == 0.0 {
                    m.set_x(2, 0.0);
                }
            }),
    };
    model
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, move |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, pull(m) - friction(m));
            let sticks = matches!(contact, Contact::Kfm) && m.regime(0) == 0.0;
            m.set_dx(2, if sticks { m.x(1) } else { 0.0 });
        })
        .body(Function::Outputs, move |m| m.set_y(0, pull(m)))
        .build()
}
