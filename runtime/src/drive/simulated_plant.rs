//! The other side of a rig's buses: simulated drives and devices on one shaft.
//!
//! In: received frames, the time. Out: frames, and the true state of the shaft. The shaft is the part of the system
//! that hardware replaces, compiled from the same text: torques are its inputs, angles and speeds its outputs, at fine
//! steps between the frames.

use super::frames;
use super::profiles;
use super::simulated::{Behaviour, SimulatedDrive};
use super::timing;
use crate::can::Frame;
use crate::drive::fault_injection::{Effect, Hook, Start};
use crate::rng::Chance;
use abi::Instance;
use abi::rig::{Kind, Message, Rig, Signal, SignalKind};

/// Callback for the frames of nodes: the node (an index into the rig's nodes) and the frame.
pub type Speak<'a> = &'a mut dyn FnMut(usize, Frame);

/// Steps of the shaft per period of the rig.
const STEPS: u64 = 50;
/// Longest step, ns.
const STEP_NS: u64 = 20_000;

/// True values of the shaft at a drive.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Shaft {
    /// Position relative to its start, rad.
    pub position: f64,
    /// Speed, rad/s.
    pub speed: f64,
    /// Torque of the drive, N·m.
    pub torque: f64,
}

/// State of a simulated device.
#[derive(Clone)]
struct SimulatedDevice {
    messages: Vec<Message>,
    values: Vec<Vec<f64>>,
    /// Time at which each message is sent next.
    due_ns: Vec<u64>,
    period_ns: Vec<u64>,
    lag: f64,
    /// Message and field of signals with a fixed value, which override the plant.
    stuck: Vec<(usize, usize)>,
}

#[derive(Clone)]
enum Body {
    Drive(Box<SimulatedDrive>),
    Device(SimulatedDevice),
}

/// State of an injected fault.
#[derive(Clone)]
struct Armed {
    hook: Hook,
    /// Time of its begin; time of its end.
    since_ns: Option<u64>,
    until_ns: Option<u64>,
    over: bool,
}

/// A signal of a node and its slot in the plant.
#[derive(Clone)]
struct Link {
    signal: Signal,
    slot: abi::Slot,
}

/// All nodes of a rig on their shaft.
#[derive(Clone)]
pub struct SimulatedBench {
    buses: Vec<usize>,
    bodies: Vec<Body>,
    shafts: Vec<Shaft>,
    plant: Option<Instance>,
    applied: Vec<Link>,
    /// For each node: slots of its position and its speed in the plant.
    seen: Vec<(Option<abi::Slot>, Option<abi::Slot>)>,
    /// Whether the speed or the position of a node is an input of the plant.
    holds: Vec<bool>,
    /// Signals of devices that are outputs of the plant.
    felt: Vec<Link>,
    /// Angular acceleration of a drive without a plant, rad/s² per N·m.
    compliance: Vec<f64>,
    step_ns: u64,
    /// Number of steps done.
    count: u64,
    status: u64,
    hooks: Vec<Armed>,
}

impl SimulatedBench {
    /// The nodes of a rig. `plant`: the program of the part that hardware replaces, before its start; without one each
    /// drive turns a shaft of its own that reaches 1000 rad/s² at rated torque. `seed`: for the initial counts of the
    /// encoders.
    pub fn new(rig: &Rig, plant: Option<Instance>, seed: u64) -> Result<SimulatedBench, String> {
        SimulatedBench::with(rig, plant, seed, |_| Behaviour::default())
    }

    /// The same, with a behaviour for each drive (index into the rig's nodes).
    pub fn with(
        rig: &Rig,
        mut plant: Option<Instance>,
        seed: u64,
        behaviour: impl Fn(usize) -> Behaviour,
    ) -> Result<SimulatedBench, String> {
        let step_ns = (rig.period_ns / STEPS).clamp(1, STEP_NS);
        let mut status = 0;
        if let Some(plant) = &mut plant {
            status = plant.start(step_ns as f64 * 1e-9);
        }
        let mut chance = Chance(seed);
        let mut bodies = Vec::new();
        let mut compliance = vec![0.0; rig.nodes.len()];
        for (at, node) in rig.nodes.iter().enumerate() {
            bodies.push(match &node.kind {
                Kind::Cia402(config) => {
                    let profile = profiles::find(&config.profile)
                        .ok_or_else(|| format!("`{}`: no profile `{}`", node.name, config.profile))?;
                    compliance[at] = 1000.0 / config.rated_torque;
                    let inertia = rig.plant.inertia.filter(|_| plant.is_some()).unwrap_or(1.0 / compliance[at]);
                    let offset = chance.number() as i32;
                    // The wait of a command before it reaches the drive is part of the drive's delay.
                    let passed = if config.at_sync { 0 } else { timing::transit_ns(rig, at) };
                    let lags = ((node.delay - passed as f64 * 1e-9).max(0.0), node.lag);
                    let drive = SimulatedDrive::new(config, profile, behaviour(at), lags, inertia, offset);
                    Body::Drive(Box::new(drive))
                }
                Kind::Frames(messages) => {
                    let third = if node.timeout_ns > 0 { node.timeout_ns / 3 } else { 100_000_000 };
                    let period = |message: &Message| if message.period_ns > 0 { message.period_ns } else { third };
                    Body::Device(SimulatedDevice {
                        messages: messages.clone(),
                        values: messages
                            .iter()
                            .map(|message| message.fields.iter().map(|field| field.start).collect())
                            .collect(),
                        due_ns: messages.iter().map(|message| if message.send { u64::MAX } else { 0 }).collect(),
                        period_ns: messages.iter().map(period).collect(),
                        lag: node.lag,
                        stuck: Vec::with_capacity(messages.iter().map(|message| message.fields.len()).sum()),
                    })
                }
            });
        }
        let link = |(signal, slot): &(Signal, abi::Slot)| Link { signal: *signal, slot: *slot };
        let seen = |node, what| {
            let signal = Signal { node, what };
            rig.plant.seen.iter().find(|(seen, _)| *seen == signal).map(|(_, slot)| *slot)
        };
        let holds = |node| {
            let held = |signal: &Signal| {
                signal.node == node && matches!(signal.what, SignalKind::Speed | SignalKind::Position)
            };
            rig.plant.applied.iter().any(|(signal, _)| held(signal))
        };
        let mut bench = SimulatedBench {
            buses: rig.nodes.iter().map(|node| node.bus).collect(),
            shafts: vec![Shaft::default(); bodies.len()],
            bodies,
            applied: rig.plant.applied.iter().map(link).collect(),
            seen: (0..rig.nodes.len())
                .map(|node| (seen(node, SignalKind::Position), seen(node, SignalKind::Speed)))
                .collect(),
            holds: (0..rig.nodes.len()).map(holds).collect(),
            felt: rig
                .plant
                .seen
                .iter()
                .filter(|(signal, _)| matches!(signal.what, SignalKind::Field(..)))
                .map(link)
                .collect(),
            plant,
            compliance,
            step_ns,
            count: 0,
            status,
            hooks: Vec::new(),
        };
        bench.look(0.0);
        Ok(bench)
    }

    /// The same with other steps of the shaft, ns, before any time has passed: coarse steps for very many runs.
    #[cfg(test)]
    pub fn in_steps_of(mut self, step_ns: u64) -> SimulatedBench {
        assert_eq!(self.count, 0, "the shaft has turned already");
        self.step_ns = step_ns;
        if let Some(plant) = &mut self.plant {
            self.status = plant.start(step_ns as f64 * 1e-9);
        }
        self
    }

    /// Adds a fault.
    pub fn hook(&mut self, hook: Hook) {
        self.hooks.push(Armed { hook, since_ns: None, until_ns: None, over: false });
    }

    /// The model begins to run now: from here on the times of faults count that are times of the model.
    pub fn begin_run(&mut self) {
        let now_ns = self.count * self.step_ns;
        for Armed { hook, .. } in &mut self.hooks {
            if let Start::OfRun(at) = hook.start {
                hook.start = Start::At(now_ns + at);
            }
        }
    }

    /// True values at a drive.
    pub fn shaft(&self, node: usize) -> Shaft {
        self.shafts[node]
    }

    /// A simulated drive, for inspection and changes; none for a device.
    pub fn drive(&mut self, node: usize) -> Option<&mut SimulatedDrive> {
        match &mut self.bodies[node] {
            Body::Drive(drive) => Some(drive),
            Body::Device(_) => None,
        }
    }

    /// The value of a device's signal: as it sends it, or as it last received it.
    pub fn value(&self, node: usize, message: usize, field: usize) -> Option<f64> {
        match &self.bodies[node] {
            Body::Drive(_) => None,
            Body::Device(device) => device.values.get(message)?.get(field).copied(),
        }
    }

    /// The program of the plant.
    #[cfg(test)]
    pub fn plant(&self) -> Option<&Instance> {
        self.plant.as_ref()
    }

    /// Status of the plant's last step: 0, or the guard that was violated.
    pub fn status(&self) -> u64 {
        self.status
    }

    /// Time at which a node next sends by itself.
    pub fn due_ns(&self) -> u64 {
        let bodies = self.bodies.iter().map(|body| match body {
            Body::Drive(drive) => drive.due_ns(),
            Body::Device(device) => device.due_ns.iter().copied().min().unwrap_or(u64::MAX),
        });
        let hooks =
            self.hooks.iter().filter(|armed| !armed.over).map(|armed| match (armed.since_ns, armed.hook.start) {
                (Some(_), _) => armed.until_ns.unwrap_or(u64::MAX),
                (None, Start::At(at)) => at,
                (None, Start::OfRun(_)) => u64::MAX,
                // A condition is checked after each step.
                (None, Start::When { .. }) => (self.count + 1) * self.step_ns,
            });
        bodies.chain(hooks).min().unwrap_or(u64::MAX)
    }

    /// The bus of a node.
    pub fn bus(&self, node: usize) -> usize {
        self.buses[node]
    }

    /// Passes a frame of a bus to all nodes on it. `send` receives the bus and the frame of each answer.
    pub fn receive(&mut self, bus: usize, frame: &Frame, now_ns: u64, send: super::Send) {
        let buses = std::mem::take(&mut self.buses);
        for node in (0..buses.len()).filter(|node| buses[*node] == bus) {
            self.hear(node, frame, now_ns, &mut |node, frame| send(buses[node], frame));
        }
        self.buses = buses;
    }

    /// Advances to a time. `send` receives the bus and the frame of each message that is due.
    pub fn advance(&mut self, now_ns: u64, send: super::Send) {
        let buses = std::mem::take(&mut self.buses);
        self.go_on(now_ns, &mut |node, frame| send(buses[node], frame));
        self.buses = buses;
    }

    /// Passes a frame to one node. `send` receives the node and the frame of each answer.
    pub fn hear(&mut self, node: usize, frame: &Frame, now_ns: u64, send: Speak) {
        self.go_on(now_ns, send);
        match &mut self.bodies[node] {
            Body::Drive(drive) => drive.receive(frame, now_ns, &mut |frame| send(node, frame)),
            Body::Device(device) => device.receive(frame),
        }
    }

    /// Advances to a time: steps the shaft, and sends what is due. `send` receives the node and the frame.
    pub fn go_on(&mut self, now_ns: u64, send: Speak) {
        while (self.count + 1) * self.step_ns <= now_ns {
            self.turn();
        }
        self.pull(now_ns, send);
        for (node, body) in self.bodies.iter_mut().enumerate() {
            match body {
                Body::Drive(drive) => drive.poll(now_ns, &mut |frame| send(node, frame)),
                Body::Device(device) => device.poll(now_ns, &mut |frame| send(node, frame)),
            }
        }
    }

    /// Begins and ends faults that are due.
    fn pull(&mut self, now_ns: u64, send: Speak) {
        for at in 0..self.hooks.len() {
            let Armed { hook, since_ns, until_ns, over } = &self.hooks[at];
            let (hook, begun) = (*hook, since_ns.is_some());
            if *over {
                continue;
            }
            let begins = !begun
                && match hook.start {
                    Start::At(start_ns) => start_ns <= now_ns,
                    Start::OfRun(_) => false,
                    Start::When { signal, above, level } => {
                        let shaft = self.shafts[signal.node];
                        let value = match signal.what {
                            SignalKind::Torque => shaft.torque,
                            SignalKind::Speed => shaft.speed,
                            SignalKind::Position => shaft.position,
                            SignalKind::Enabled | SignalKind::Fault | SignalKind::Limited => 0.0,
                            SignalKind::Field(message, field) => self.value(signal.node, message, field).unwrap_or(0.0),
                        };
                        if above { value > level } else { value < level }
                    }
                };
            let ends = begun && until_ns.is_some_and(|until| until <= now_ns);
            if begins {
                let until_ns = hook.lasts_ns.map(|lasts| now_ns + lasts);
                self.hooks[at] = Armed { hook, since_ns: Some(now_ns), until_ns, over: until_ns.is_none() };
            } else if ends {
                self.hooks[at].over = true;
            } else {
                continue;
            }
            let node = hook.node;
            match &mut self.bodies[hook.node] {
                Body::Drive(drive) => drive.afflict(hook.effect, begins, now_ns, &mut |frame| send(node, frame)),
                Body::Device(device) => device.afflict(hook.effect, begins, now_ns),
            }
        }
    }

    /// One fine step of all drives and the shaft.
    fn turn(&mut self) {
        let (t_ns, h) = (self.count * self.step_ns, self.step_ns as f64 * 1e-9);
        for (node, body) in self.bodies.iter_mut().enumerate() {
            let shaft = self.shafts[node];
            if let Body::Drive(drive) = body {
                drive.step(t_ns, h, (shaft.position, shaft.speed));
                self.shafts[node].torque = drive.applied();
            }
        }
        self.count += 1;
        match &mut self.plant {
            Some(plant) => {
                for link in &self.applied {
                    let value = match (&self.bodies[link.signal.node], link.signal.what) {
                        (Body::Drive(drive), SignalKind::Torque) => drive.applied(),
                        (Body::Drive(drive), SignalKind::Speed) => drive.speed(),
                        (Body::Drive(drive), SignalKind::Position) => {
                            self.shafts[link.signal.node].position + drive.speed() * h
                        }
                        (Body::Device(device), SignalKind::Field(message, field)) => {
                            let held = plant.get(link.slot);
                            held + (device.values[message][field] - held) * device.share(h)
                        }
                        _ => self.shafts[link.signal.node].position,
                    };
                    plant.set(link.slot, value);
                }
                if self.status == 0 {
                    self.status = plant.advance(1);
                }
            }
            None => {
                for (node, shaft) in self.shafts.iter_mut().enumerate() {
                    let acceleration = shaft.torque * self.compliance[node];
                    shaft.position += (shaft.speed + acceleration * h / 2.0) * h;
                    shaft.speed += acceleration * h;
                }
            }
        }
        self.look(h);
    }

    /// Reads the plant's outputs at the nodes. `h`: time since the last call, s.
    fn look(&mut self, h: f64) {
        let Some(plant) = &self.plant else { return };
        for (node, (shaft, (position, speed))) in self.shafts.iter_mut().zip(&self.seen).enumerate() {
            let last = *shaft;
            match (position.map(|slot| plant.get(slot)), speed.map(|slot| plant.get(slot))) {
                (Some(position), Some(speed)) => (shaft.position, shaft.speed) = (position, speed),
                (Some(position), None) => {
                    shaft.position = position;
                    shaft.speed = if h > 0.0 { (position - last.position) / h } else { 0.0 };
                }
                (None, Some(speed)) => {
                    shaft.speed = speed;
                    shaft.position += (last.speed + speed) / 2.0 * h;
                }
                // The plant has no output for a drive that controls the shaft: the shaft turns with the drive's
                // set-point.
                (None, None) => {
                    if let (Body::Drive(drive), true) = (&self.bodies[node], self.holds[node]) {
                        shaft.speed = drive.speed();
                        shaft.position += (last.speed + shaft.speed) / 2.0 * h;
                    }
                }
            }
        }
        for link in &self.felt {
            if let (Body::Device(device), SignalKind::Field(message, field)) =
                (&mut self.bodies[link.signal.node], link.signal.what)
                && !device.stuck.contains(&(message, field))
            {
                device.values[message][field] = plant.get(link.slot);
            }
        }
    }
}

impl SimulatedDevice {
    /// Share by which the device approaches its command in `h` seconds.
    fn share(&self, h: f64) -> f64 {
        if self.lag > 0.0 { (h / self.lag).min(1.0) } else { 1.0 }
    }

    fn receive(&mut self, frame: &Frame) {
        for (message, values) in self.messages.iter().zip(&mut self.values) {
            if message.send && message.id == frame.id() && message.extended == frame.is_extended() {
                for (field, value) in values.iter_mut().enumerate() {
                    let told = frames::read(message, field, frame.data());
                    *value = told.filter(|told| told.is_finite()).unwrap_or(*value);
                }
            }
        }
    }

    fn poll(&mut self, now_ns: u64, send: crate::canopen::Send) {
        for (at, message) in self.messages.iter().enumerate() {
            if now_ns < self.due_ns[at] {
                continue;
            }
            self.due_ns[at] = now_ns + self.period_ns[at];
            let mut data = [0; 8];
            frames::fill(message, |field| self.values[at][field], &mut data);
            let data = &data[..message.length.into()];
            send(if message.extended { Frame::extended(message.id, data) } else { Frame::new(message.id, data) });
        }
    }

    fn afflict(&mut self, effect: Effect, on: bool, now_ns: u64) {
        if let Effect::Value(message, field, value) = effect {
            self.values[message][field] = if on { value } else { self.messages[message].fields[field].start };
            self.stuck.retain(|stuck| *stuck != (message, field));
            if on {
                self.stuck.push((message, field));
            }
            // A change is sent at once.
            self.due_ns[message] = self.due_ns[message].min(now_ns);
        }
    }
}
