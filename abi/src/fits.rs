//! Validation of a rig against its two programs: everything that the code running it assumes.
//!
//! In: a [`Rig`] and the descriptions of its programs. Out: nothing, or the first violation, as a message. The compiler
//! asserts validity of its own output; an invalid package is refused even if its hashes are correct. The limits are
//! those that the compiler accepts, so no checked rig is refused here.

use crate::description::{Description, Segment, Slot};
use crate::foreign::{is_name, is_text};
use crate::rig::{
    Cia402, DriveLimits, Field, Format, Input, Kind, Message, Mode, Node, Output, Overrun, Rig, Signal, SignalKind,
};
use crate::series::Method;
use crate::unit::Unit;

/// Permitted periods of a cycle, ns.
const PERIODS_NS: std::ops::RangeInclusive<u64> = 20_000..=1_000_000_000;
/// Permitted numbers of steps in one period.
const STEPS: std::ops::RangeInclusive<u32> = 1..=10_000;
/// Longest watchdog time, ns.
const WATCHDOG_NS: u64 = 10_000_000_000;
/// Permitted numbers of consecutive missed ticks.
const HOLD: std::ops::RangeInclusive<u32> = 1..=1000;
/// Longest dead time in periods; and the longest dead time or lag in s.
const DELAY: (f64, f64) = (200.0, 1.0);
/// Longest interval between two frames of a device, ns.
const RARE_NS: u64 = 1_000_000_000_000_000;
/// Shortest interval between two frames of a device, ns: the duration of the shortest frame at 1 Mbit/s.
const FRAME_NS: u64 = 47_000;
/// Maximum number of buses, and of nodes: a log frame stores its bus in one byte.
const MOST: usize = 128;
/// Maximum number of messages of a node, and of signals of a message.
const MOST_SIGNALS: usize = 4096;
/// Maximum length of a text in bytes.
const LONGEST: usize = 1 << 16;

/// The first violation as a message, if any.
type Fits = Result<(), String>;

fn ensure(holds: bool, why: impl FnOnce() -> String) -> Fits {
    if holds { Ok(()) } else { Err(why()) }
}

impl Rig {
    /// Checks that the plan is consistent and fits its control program and its plant program.
    ///
    /// # Errors
    /// The first violation, as a message.
    pub fn fits(&self, control: &Description, plant: &Description) -> Fits {
        ensure(is_name(&self.name), || format!("its rig is called {:?}, which is no name", short(&self.name)))?;
        self.times()?;
        self.buses_fit()?;
        ensure(self.nodes.len() <= MOST, || format!("it has {} nodes, more than {MOST}", self.nodes.len()))?;
        for (at, node) in self.nodes.iter().enumerate() {
            self.node_fits(node).map_err(|why| format!("node {at}: {why}"))?;
            let twin = self.nodes[..at].iter().any(|other| other.name == node.name || self.share_id(other, node));
            ensure(!twin, || format!("two nodes are `{}` or have its node id", node.name))?;
        }
        for input in &self.inputs {
            self.input_fits(input, control.layout.inputs)?;
        }
        for (at, output) in self.outputs.iter().enumerate() {
            self.output_fits(output, control).map_err(|why| format!("command {at}: {why}"))?;
            let twin = self.outputs[..at].iter().any(|other| other.signal == output.signal);
            ensure(!twin, || format!("two commands go to {:?}", output.signal))?;
        }
        self.watched_fit(control)?;
        self.plant_fits(plant)?;
        program_fits(control).map_err(|why| format!("the control program: {why}"))?;
        program_fits(plant).map_err(|why| format!("the plant program: {why}"))
    }

    fn times(&self) -> Fits {
        let Rig { period_ns, steps, watchdog_ns, overrun, method, .. } = self;
        ensure(PERIODS_NS.contains(period_ns), || format!("a period of {period_ns} ns is not 20 µs to 1 s"))?;
        ensure(STEPS.contains(steps), || format!("{steps} steps in a period are not 1 to 10000"))?;
        ensure(*method != Method::Adaptive, || "its steps are not of fixed length".into())?;
        ensure((period_ns + 1..=WATCHDOG_NS).contains(watchdog_ns), || {
            format!("a watchdog of {watchdog_ns} ns is not longer than a period of {period_ns} ns and at most 10 s")
        })?;
        match overrun {
            Overrun::Stop => Ok(()),
            Overrun::Hold(ticks) => {
                ensure(HOLD.contains(ticks), || format!("`overrun hold {ticks}` is not 1 to 1000 ticks"))
            }
        }
    }

    fn buses_fit(&self) -> Fits {
        ensure((1..=MOST).contains(&self.buses.len()), || format!("it has {} buses", self.buses.len()))?;
        for (at, bus) in self.buses.iter().enumerate() {
            ensure(is_name(&bus.name), || format!("bus {at} is called {:?}", short(&bus.name)))?;
            text("the address of a bus", &bus.address)?;
            ensure(matches!(bus.bit_rate, 0 | 10_000..=1_000_000), || {
                format!("bus `{}` has {} bit/s, not 10 kbit/s to 1 Mbit/s", bus.name, bus.bit_rate)
            })?;
            let twin = self.buses[..at].iter().any(|other| other.name == bus.name);
            ensure(!twin, || format!("two buses are called `{}`", bus.name))?;
        }
        Ok(())
    }

    fn node_fits(&self, node: &Node) -> Fits {
        ensure(is_name(&node.name), || format!("it is called {:?}", short(&node.name)))?;
        ensure(node.bus < self.buses.len(), || format!("bus {} of {}", node.bus, self.buses.len()))?;
        let longest = (DELAY.0 * self.period_ns as f64 * 1e-9 * (1.0 + 1e-9)).min(DELAY.1);
        ensure((0.0..=longest).contains(&node.delay), || format!("a dead time of {} s", node.delay))?;
        ensure((0.0..=DELAY.1).contains(&node.lag), || format!("a lag of {} s", node.lag))?;
        let DriveLimits { max_speed, travel, max_power } = node.within;
        for (what, value) in [("greatest speed", max_speed), ("greatest power", max_power)] {
            ensure(value.is_none_or(positive), || format!("its {what} is {value:?}"))?;
        }
        let (low, high) = travel.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        ensure(low <= high, || format!("its travel is {low} .. {high}"))?;
        match &node.kind {
            Kind::Cia402(drive) => drive_fits(drive),
            Kind::Frames(messages) => {
                ensure(messages.len() <= MOST_SIGNALS, || format!("{} messages", messages.len()))?;
                messages.iter().try_for_each(message_fits)
            }
        }
    }

    /// Whether two drives on a bus have the same node id.
    fn share_id(&self, a: &Node, b: &Node) -> bool {
        match (&a.kind, &b.kind) {
            (Kind::Cia402(one), Kind::Cia402(other)) => a.bus == b.bus && one.node == other.node,
            (Kind::Cia402(_) | Kind::Frames(_), _) => false,
        }
    }

    /// The field that a signal refers to; `None` for a signal of a CiA 402 drive.
    fn signal_fits(&self, signal: Signal) -> Result<Option<(&Message, &Field)>, String> {
        let Signal { node, what } = signal;
        let Some(found) = self.nodes.get(node) else {
            return Err(format!("a signal of node {node} of {}", self.nodes.len()));
        };
        match (&found.kind, what) {
            (Kind::Cia402(_), SignalKind::Field(..)) => Err(format!("drive `{}` has no fields", found.name)),
            (Kind::Cia402(_), _) => Ok(None),
            (Kind::Frames(messages), SignalKind::Field(message, field)) => {
                let found_field = messages.get(message).and_then(|all| Some((all, all.fields.get(field)?)));
                found_field.map(Some).ok_or_else(|| format!("`{}` has no message {message}, field {field}", found.name))
            }
            (Kind::Frames(_), what) => Err(format!("`{}` has no {what:?}", found.name)),
        }
    }

    fn input_fits(&self, input: &Input, inputs: Segment) -> Fits {
        self.signal_fits(input.signal)?;
        ensure(inputs.contains(input.slot), || format!("slot {} is no input of the control program", input.slot.0))?;
        ensure(input.start.is_finite(), || format!("an input starts at {}", input.start))
    }

    fn output_fits(&self, output: &Output, control: &Description) -> Fits {
        let Output { signal, slot, low, high, slew, safe } = *output;
        let carried = self.signal_fits(signal)?;
        let node = &self.nodes[signal.node];
        if let Kind::Cia402(drive) = &node.kind {
            let follows = matches!(
                (drive.mode, signal.what),
                (Mode::Torque, SignalKind::Torque)
                    | (Mode::Speed, SignalKind::Speed)
                    | (Mode::Position, SignalKind::Position)
            );
            ensure(follows && node.moves, || format!("`{}` does not follow {:?}", node.name, signal.what))?;
        }
        ensure(carried.is_none_or(|(message, _)| message.send), || "it is a signal that we do not send".into())?;
        in_block(slot, control)?;
        ensure(low <= high && slew > 0.0, || format!("its limits are {low} .. {high}, its slew {slew}"))?;
        ensure(safe.is_finite() && (low..=high).contains(&safe), || {
            format!("its safe value {safe} is not within {low} .. {high}")
        })
    }

    fn watched_fit(&self, control: &Description) -> Fits {
        for stop in &self.stops {
            in_block(stop.slot, control)?;
            text("a condition", &stop.condition)?;
            text("a reason", &stop.why)?;
        }
        for series in &self.record {
            in_block(series.slot, control)?;
            text("a recorded quantity", &series.label)?;
            unit_fits(&series.unit)?;
        }
        let count = self.record.len();
        for plot in &self.plots {
            let outside = plot.series.iter().chain(&plot.against).find(|at| **at >= count);
            ensure(outside.is_none(), || format!("a plot shows record {outside:?} of {count}"))?;
        }
        let Some(at) = self.predict else { return Ok(()) };
        let gives = self.outputs.iter().any(|output| output.signal == Signal { node: at, what: SignalKind::Torque });
        ensure(gives, || format!("node {at} is to be predicted and gives no torque"))
    }

    fn plant_fits(&self, plant: &Description) -> Fits {
        for (signal, slot) in &self.plant.applied {
            self.signal_fits(*signal)?;
            let inputs = plant.layout.inputs;
            ensure(inputs.contains(*slot), || format!("slot {} is no input of the plant program", slot.0))?;
        }
        for (signal, slot) in &self.plant.seen {
            self.signal_fits(*signal)?;
            in_block(*slot, plant).map_err(|why| format!("the plant program: {why}"))?;
        }
        let inertia = self.plant.inertia;
        ensure(inertia.is_none_or(positive), || format!("an inertia of {inertia:?} kg·m²"))
    }
}

fn positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

fn in_block(slot: Slot, program: &Description) -> Fits {
    let size = program.layout.size();
    ensure(slot.index() < size, || format!("slot {} of a block of {size}", slot.0))
}

fn text(what: &str, text: &str) -> Fits {
    let fits = text.len() <= LONGEST && is_text(text);
    ensure(fits, || format!("{what} cannot be shown: {:?}", short(text)))
}

/// The beginning of a text, for a message.
fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

fn unit_fits(unit: &Unit) -> Fits {
    text("a unit", &unit.text)?;
    ensure(unit.scale.is_normal() && unit.scale > 0.0, || format!("one {} is {} in SI", unit.text, unit.scale))
}

fn drive_fits(drive: &Cia402) -> Fits {
    let Cia402 { node, rated_torque, count, speed_unit, max_torque, max_speed, travel, max_power, .. } = drive;
    ensure((1..=127).contains(node), || format!("its node id is {node}"))?;
    for (what, value) in [("T_rated", rated_torque), ("count", count), ("speed_unit", speed_unit)] {
        ensure(positive(*value) && value.is_normal(), || format!("its {what} is {value}"))?;
    }
    for (what, value) in [("T_max", max_torque), ("speed_max", max_speed), ("power_max", max_power)] {
        ensure(value.is_none_or(positive), || format!("its {what} is {value:?}"))?;
    }
    let (low, high) = travel.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
    ensure(low <= high, || format!("its travel is {low} .. {high}"))?;
    text("a profile", &drive.profile)
}

fn message_fits(message: &Message) -> Fits {
    let Message { name, id, extended, length, send, period_ns, fields } = message;
    text("the name of a message", name)?;
    let most = if *extended { 0x1FFF_FFFF } else { 0x7FF };
    ensure(*id <= most, || format!("message `{name}` has the identifier {id:#x}"))?;
    ensure(*length <= 8, || format!("message `{name}` has {length} bytes"))?;
    ensure(*send || *period_ns == 0 || (FRAME_NS..=RARE_NS).contains(period_ns), || {
        format!("message `{name}` comes every {period_ns} ns")
    })?;
    ensure(fields.len() <= MOST_SIGNALS, || format!("message `{name}` has {} signals", fields.len()))?;
    fields.iter().try_for_each(|field| field_fits(field, message))
}

fn field_fits(field: &Field, message: &Message) -> Fits {
    let Field { name, start_bit, bits, big_endian, format, scale, offset, start, unit, multiplexed } = field;
    text("the name of a signal", name)?;
    let wide = match format {
        Format::Unsigned | Format::Signed => (1..=64).contains(bits),
        Format::Float32 => *bits == 32,
        Format::Float64 => *bits == 64,
    };
    ensure(wide, || format!("signal `{name}` has {bits} bits as {format:?}"))?;
    // A big-endian signal starts at its most significant bit, which is the order on the wire.
    let first = if *big_endian { start_bit / 8 * 8 + (7 - start_bit % 8) } else { *start_bit };
    let within = u32::from(first) + u32::from(*bits) <= 8 * u32::from(message.length);
    ensure(within, || format!("signal `{name}` does not fit into {} bytes", message.length))?;
    ensure(scale.is_normal() && offset.is_finite() && start.is_finite(), || {
        format!("signal `{name}` has a step of {scale}, an offset of {offset} and a start of {start}")
    })?;
    let switch = multiplexed.is_none_or(|(switch, _)| switch < message.fields.len());
    ensure(switch, || format!("signal `{name}` is switched by signal {multiplexed:?}"))?;
    unit_fits(unit)
}

/// Checks the parts of a program's description that a rig uses.
fn program_fits(program: &Description) -> Fits {
    text("its name", &program.name)?;
    let size = program.layout.size();
    ensure(program.slots().all(|slot| slot.index() < size), || format!("a slot outside of its block of {size}"))?;
    for quantity in &program.quantities {
        text("the path of a quantity", &quantity.path)?;
        unit_fits(&quantity.unit)?;
        let (low, high) = quantity.range;
        ensure(low <= high, || format!("`{}` lies in {low} .. {high}", quantity.path))?;
    }
    for guard in &program.guards {
        text("the path of a guard", &guard.path)?;
        unit_fits(&guard.unit)?;
    }
    program.automata.iter().try_for_each(|automaton| {
        text("the path of an automaton", &automaton.path)?;
        automaton.regimes.iter().try_for_each(|regime| text("a regime", regime))
    })?;
    for delay in &program.delays {
        // Samples are addressed by a mask, so a ring has a power of two slots, or 0 if there is none.
        ensure(delay.ring.len == 0 || delay.ring.len.is_power_of_two(), || format!("a ring of {}", delay.ring.len))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::{Kind as QuantityKind, Layout, Quantity};
    use crate::rig::{Bus, Curves, Plant, Stop};
    use crate::series::Series;

    /// A drive and a device on two buses. Control and plant program have inputs 3 and 4 and outputs 5 and 6.
    fn whole() -> (Rig, Description, Description) {
        let layout = Layout::new([0, 2, 0, 0, 0, 2, 0, 0, 0, 0]);
        let quantity = Quantity {
            path: "body.v".into(),
            kind: QuantityKind::Output,
            unit: Unit::none(),
            boolean: false,
            slot: Slot(5),
            range: (0.0, f64::INFINITY),
            doc: None,
        };
        let program = Description {
            name: "Servo(\n  m = 1 kg)".into(),
            layout,
            quantities: vec![quantity],
            ..Description::default()
        };
        let drive = Cia402 {
            node: 3,
            rated_torque: 4.0,
            mode: Mode::Torque,
            count: 1e-4,
            speed_unit: 0.1,
            max_torque: Some(3.0),
            max_speed: None,
            travel: Some((-1.0, f64::INFINITY)),
            max_power: None,
            at_sync: false,
            profile: "cia402".into(),
        };
        let field = |name: &str, start_bit, big_endian| Field {
            name: name.into(),
            start_bit,
            bits: 16,
            big_endian,
            format: Format::Signed,
            scale: 0.01,
            offset: 0.0,
            start: 0.0,
            unit: Unit::parse("N·m").unwrap(),
            multiplexed: None,
        };
        let message = |id, send, fields| Message {
            name: "m".into(),
            id,
            extended: false,
            length: 4,
            send,
            period_ns: 1_000_000,
            fields,
        };
        let messages = vec![
            message(0x7FF, false, vec![field("a", 0, false), field("b", 23, true)]),
            message(0x100, true, vec![field("c", 16, false)]),
        ];
        let node = |name: &str, bus, kind| Node {
            name: name.into(),
            bus,
            kind,
            moves: true,
            delay: 1e-3,
            lag: 0.0,
            timeout_ns: u64::MAX,
            within: DriveLimits::default(),
        };
        let signal = |node, what| Signal { node, what };
        let bus = |name: &str| Bus { name: name.into(), address: "sim:bench".into(), bit_rate: 1_000_000 };
        let output = |signal, slot| Output { signal, slot, low: -1.0, high: 1.0, slew: f64::INFINITY, safe: 0.0 };
        let rig = Rig {
            name: "rtfs".into(),
            period_ns: 1_000_000,
            method: Method::Expo,
            steps: 1,
            buses: vec![bus("can0"), bus("can1")],
            nodes: vec![node("load", 0, Kind::Cia402(drive)), node("panel", 1, Kind::Frames(messages))],
            inputs: vec![Input { signal: signal(1, SignalKind::Field(0, 1)), slot: Slot(4), start: 0.0, needed: true }],
            outputs: vec![
                output(signal(0, SignalKind::Torque), Slot(5)),
                output(signal(1, SignalKind::Field(1, 0)), Slot(6)),
            ],
            watchdog_ns: 5_000_000,
            overrun: Overrun::Hold(2),
            stops: vec![Stop { slot: Slot(6), condition: "v > 1".into(), why: "too fast".into() }],
            record: vec![Series { label: "v".into(), slot: Slot(5), unit: Unit::none(), boolean: false }],
            plots: vec![Curves { series: vec![0], against: None }],
            predict: Some(0),
            needs_look: false,
            plant: Plant {
                applied: vec![(signal(0, SignalKind::Torque), Slot(3))],
                seen: vec![(signal(0, SignalKind::Speed), Slot(5))],
                inertia: Some(0.012),
            },
        };
        (rig, program.clone(), program)
    }

    fn drive(rig: &mut Rig) -> &mut Cia402 {
        let Kind::Cia402(drive) = &mut rig.nodes[0].kind else { unreachable!() };
        drive
    }

    fn message(rig: &mut Rig) -> &mut Message {
        let Kind::Frames(messages) = &mut rig.nodes[1].kind else { unreachable!() };
        &mut messages[0]
    }

    type Change = (&'static str, fn(&mut Rig));

    #[test]
    fn each_violation_has_its_message() {
        let (rig, control, plant) = whole();
        assert_eq!(rig.fits(&control, &plant), Ok(()));
        let changes: [Change; 46] = [
            ("is no name", |rig| rig.name = "../x".into()),
            ("is not 20 µs to 1 s", |rig| rig.period_ns = 0),
            ("steps in a period", |rig| rig.steps = 0),
            ("steps in a period", |rig| rig.steps = u32::MAX),
            ("fixed length", |rig| rig.method = Method::Adaptive),
            ("watchdog", |rig| rig.watchdog_ns = rig.period_ns),
            ("watchdog", |rig| rig.watchdog_ns = u64::MAX),
            ("overrun hold", |rig| rig.overrun = Overrun::Hold(0)),
            ("0 buses", |rig| rig.buses.clear()),
            ("is called", |rig| rig.buses[0].name = "a b".into()),
            ("two buses", |rig| rig.buses[1].name = "can0".into()),
            ("bit/s", |rig| rig.buses[1].bit_rate = 1),
            ("cannot be shown", |rig| rig.buses[0].address = "\u{1b}[2J".into()),
            ("two nodes", |rig| rig.nodes[1].name = "load".into()),
            ("bus 2 of 2", |rig| rig.nodes[1].bus = 2),
            ("dead time", |rig| rig.nodes[0].delay = f64::NAN),
            ("dead time", |rig| rig.nodes[0].delay = 0.3),
            ("a lag", |rig| rig.nodes[0].lag = -1.0),
            ("greatest speed", |rig| rig.nodes[1].within.max_speed = Some(f64::NAN)),
            ("its travel", |rig| rig.nodes[1].within.travel = Some((1.0, -1.0))),
            ("node id", |rig| drive(rig).node = 0),
            ("T_rated", |rig| drive(rig).rated_torque = 0.0),
            ("count", |rig| drive(rig).count = 5e-324),
            ("speed_unit", |rig| drive(rig).speed_unit = f64::INFINITY),
            ("T_max", |rig| drive(rig).max_torque = Some(f64::NAN)),
            ("travel", |rig| drive(rig).travel = Some((1.0, -1.0))),
            ("identifier", |rig| message(rig).id = 0x800),
            ("bytes", |rig| message(rig).length = 9),
            ("comes every", |rig| message(rig).period_ns = 1),
            ("does not fit into", |rig| message(rig).fields[0].start_bit = 17),
            ("does not fit into", |rig| message(rig).fields[1].start_bit = 22),
            ("does not fit into", |rig| message(rig).fields[1].start_bit = u16::MAX),
            ("bits as", |rig| message(rig).fields[0].bits = 0),
            ("bits as", |rig| message(rig).fields[0].format = Format::Float32),
            ("a step of 0", |rig| message(rig).fields[0].scale = 0.0),
            ("is switched by", |rig| message(rig).fields[0].multiplexed = Some((2, 0))),
            ("in SI", |rig| message(rig).fields[0].unit.scale = f64::NAN),
            ("is no input", |rig| rig.inputs[0].slot = Slot(5)),
            ("has no message", |rig| rig.inputs[0].signal.what = SignalKind::Field(0, 2)),
            ("signal of node 7", |rig| rig.inputs[0].signal.node = 7),
            ("does not follow", |rig| rig.outputs[0].signal.what = SignalKind::Speed),
            ("do not send", |rig| rig.outputs[1].signal.what = SignalKind::Field(0, 0)),
            ("slot 7 of a block of 7", |rig| rig.outputs[0].slot = Slot(7)),
            ("safe value", |rig| rig.outputs[0].safe = 2.0),
            ("its limits are", |rig| rig.outputs[0].slew = f64::NAN),
            ("to be predicted", |rig| rig.predict = Some(1)),
        ];
        let more: [Change; 8] = [
            ("two commands", |rig| rig.outputs.push(rig.outputs[0])),
            ("slot 9 of a block of 7", |rig| rig.stops[0].slot = Slot(9)),
            ("slot 9 of a block of 7", |rig| rig.record[0].slot = Slot(9)),
            ("a plot shows record", |rig| rig.plots[0].series.push(1)),
            ("a plot shows record", |rig| rig.plots[0].against = Some(1)),
            ("no input of the plant", |rig| rig.plant.applied[0].1 = Slot(5)),
            ("the plant program: slot 9", |rig| rig.plant.seen[0].1 = Slot(9)),
            ("an inertia", |rig| rig.plant.inertia = Some(0.0)),
        ];
        for (expected, change) in changes.into_iter().chain(more) {
            let mut other = rig.clone();
            change(&mut other);
            let why = other.fits(&control, &plant).expect_err(expected);
            assert!(why.contains(expected) && is_text(&why), "{expected}: {why}");
        }
        let mut odd = control.clone();
        odd.quantities[0].path = "v\u{7}".into();
        assert!(rig.fits(&odd, &plant).unwrap_err().starts_with("the control program: the path of a quantity"));
        odd.quantities[0] = Quantity { slot: Slot(99), path: "v".into(), ..odd.quantities[0].clone() };
        assert!(rig.fits(&control, &odd).unwrap_err().starts_with("the plant program: a slot outside"));
    }
}
