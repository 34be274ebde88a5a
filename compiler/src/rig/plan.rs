//! The plan of a rig: numbers, nodes, messages and limits, and the slots of both programs.
//!
//! In: the descriptions and expressions of a rig, later its programs. Out: an [`abi::rig::Rig`]. Knows nothing of buses
//! beyond their frames.

use super::margins::{self, Margin};
use super::*;
use crate::analysis::step_stability_report::{self, StepBy};
use crate::ir::program::Program;
use crate::lower::{self, lower};
use abi::live::Tunable;
use frames::{MessageLayout, OnBus};

impl RigReader<'_, '_> {
    /// Everything of the plan except signals and slots.
    pub(super) fn plan(
        &mut self,
        system: &System,
        framed: &RigFrame,
        lists: &ExprIndices,
        number: &dyn Fn(usize) -> f64,
        param: &dyn Fn(usize, &str) -> f64,
    ) -> Option<Rig> {
        let before = self.errors();
        let (period_ns, steps) = self.period(lists, number);
        let method = self.method();
        let period = period_ns as f64 * 1e-9;
        let watchdog_ns = match lists.watchdog {
            None => 5 * period_ns,
            Some(at) => {
                let value = number(at);
                if !(value > period && value <= 10.0) {
                    let span = self.statements.watchdog.map_or(self.rig.name.span, |(expr, _)| expr.span);
                    let error =
                        Diagnostic::error("E0502", "the watchdog waits longer than one period, and at most 10 s")
                            .label(span, format!("{value} s"));
                    self.report(error.help("five periods are usual"));
                }
                nanoseconds(value)
            }
        };
        let overrun = match (self.statements.overrun, lists.overrun) {
            (Some((Some(expr), _)), Some(at)) => {
                let count = number(at);
                if !(count.fract() == 0.0 && (1.0..=1000.0).contains(&count)) {
                    let error = Diagnostic::error("E0502", "`overrun hold` takes a whole number of ticks")
                        .label(expr.span, format!("{count}"));
                    self.report(error.help("from 1 to 1000, such as `overrun hold 2`; or `overrun stop`"));
                }
                Overrun::Hold(count.clamp(1.0, 1000.0) as u32)
            }
            _ => Overrun::Stop,
        };
        let buses = self.buses(lists, number);
        let mut nodes = Vec::new();
        let mut laid_out = Vec::new();
        for (k, description) in self.descriptions.iter().enumerate() {
            let (node, laid) = self.described(k, description, lists, &|name| param(k, name), period_ns)?;
            nodes.push(node);
            laid_out.push(laid);
        }
        let signal =
            |send: &OutputCommand| Signal { node: send.node, what: frames::what(send.read, &laid_out[send.node]) };
        for send in &lists.sends {
            if let SignalKind::Field(m, f) = signal(send).what
                && let rig::Kind::Frames(messages) = &nodes[send.node].kind
            {
                debug_assert!(messages[m].fields.len() > f, "a field that was laid out");
            }
        }
        let mut outputs = Vec::new();
        for send in &lists.sends {
            outputs.push(self.output(send, signal(send), &nodes, number));
        }
        let on_bus: Vec<OnBus> = self
            .descriptions
            .iter()
            .zip(&nodes)
            .map(|(description, node)| OnBus {
                description,
                bus: node.bus,
                node: match &node.kind {
                    rig::Kind::Cia402(drive) => Some(drive.node),
                    rig::Kind::Frames(_) => None,
                },
                messages: match &node.kind {
                    rig::Kind::Cia402(_) => &[],
                    rig::Kind::Frames(messages) => messages,
                },
            })
            .collect();
        frames::identifiers(&on_bus, self.diagnostics);
        let predict = self.predict(lists, &nodes);
        let stops = self.statements.stops.iter().map(|(condition, why, _)| rig::Stop {
            slot: Slot(0),
            condition: one_line(self.files.slice(condition.span)),
            why: (*why).to_string(),
        });
        let _ = (system, framed);
        let plan = Rig {
            name: self.rig.name.text.clone(),
            period_ns,
            method,
            steps,
            buses,
            nodes,
            inputs: Vec::new(),
            outputs,
            watchdog_ns,
            overrun,
            stops: stops.collect(),
            record: Vec::new(),
            plots: Vec::new(),
            predict,
            needs_look: false,
            plant: rig::Plant { applied: Vec::new(), seen: Vec::new(), inertia: None },
        };
        for (k, (bus, statement)) in plan.buses.iter().zip(&self.statements.buses).enumerate() {
            let load = frames::load(&plan, k);
            frames::crowded(&bus.name, statement.span, load, f64::from(bus.bit_rate), self.diagnostics);
        }
        (self.errors() == before).then_some(plan)
    }

    fn period(&mut self, lists: &ExprIndices, number: &dyn Fn(usize) -> f64) -> (u64, u32) {
        let value = number(lists.rate);
        let span = self.statements.rate.map_or(self.rig.name.span, |(expr, _)| expr.span);
        if !(20e-6..=1.0).contains(&value) {
            let error =
                Diagnostic::error("E0502", "a rig computes every 20 us to 1 s").label(span, format!("{value} s"));
            self.report(error.help("1 ms is usual on a CAN bus of 1 Mbit/s"));
            return (1_000_000, 1);
        }
        let ns = nanoseconds(value);
        if (ns as f64 * 1e-9 - value).abs() > 1e-12 * value {
            let error = Diagnostic::error("E0701", "the period of a rig is a whole number of nanoseconds")
                .label(span, format!("{value} s"));
            self.report(error.help(format!("write `rate {} us`", ns as f64 * 1e-3)));
        }
        let steps = match lists.step {
            None => 1,
            Some(at) => {
                let step = number(at);
                let ratio = value / step;
                let whole = ratio.round();
                if !(step > 0.0 && (ratio - whole).abs() < 1e-9 * ratio && (1.0..=10_000.0).contains(&whole)) {
                    let at = self.statements.solver.map_or(span, |solver| solver.span);
                    let error = Diagnostic::error("E0701", "the step of the solver does not divide the period")
                        .label(at, format!("{step} s"))
                        .label(span, "the period");
                    self.report(error.help("a tick is a whole number of equal steps, such as `step 0.1 ms` of 1 ms"));
                }
                whole.clamp(1.0, 10_000.0) as u32
            }
        };
        (ns, steps)
    }

    fn method(&mut self) -> Method {
        let Some(solver) = self.statements.solver else { return Method::Expo };
        match Method::named(&solver.method.text) {
            Some(Method::Adaptive) => {
                let error = Diagnostic::error("E0905", "a rig takes steps of fixed length")
                    .label(solver.method.span, "takes as many as it needs");
                let methods = Method::list(Method::fixed());
                self.report(error.help(format!("write `solver` and one of {methods}, or leave it out for expo")));
                Method::Expo
            }
            Some(method) => method,
            None => {
                let error = Diagnostic::error("E0201", format!("there is no solver `{}`", solver.method.text))
                    .label(solver.method.span, "not known");
                self.report(error.help(format!("solvers of a rig are {}", Method::list(Method::fixed()))));
                Method::Expo
            }
        }
    }

    fn buses(&mut self, lists: &ExprIndices, number: &dyn Fn(usize) -> f64) -> Vec<rig::Bus> {
        let mut out = Vec::new();
        for (bus, rate) in self.statements.buses.iter().zip(&lists.bit_rates) {
            let text = bus.args.iter().find_map(|arg| match arg {
                ast::BusArg::Text(text) => Some(text),
                ast::BusArg::Expr(_) => None,
            });
            let rate = rate.map(number);
            if let Some(rate) = rate
                && !(10e3..=1e6).contains(&rate)
            {
                let error = Diagnostic::error("E0502", "a CAN bus has 10 kbit/s to 1 Mbit/s")
                    .label(bus.span, format!("{rate} bit/s"));
                self.report(error.help("1 Mbit/s, 500 kbit/s, 250 kbit/s and 125 kbit/s are usual"));
            }
            let kinds = ["can", "sim", "slcan", "socketcand"];
            if !kinds.contains(&bus.kind.text.as_str()) {
                let error = Diagnostic::error("E0201", format!("there is no bus of kind `{}`", bus.kind.text))
                    .label(bus.kind.span, "not known");
                self.report(match crate::frontend::names::nearest(&bus.kind.text, kinds) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error.help(format!("kinds are {}", kinds.join(", "))),
                });
            } else if text.is_none() || bus.args.len() > 2 || (rate.is_none() && bus.kind.text != "sim") {
                let error =
                    Diagnostic::error("E0207", "a bus has a name and a bit rate").label(bus.span, "not so here");
                self.report(error.help("write `bus can0 = can(\"can0\", 1 Mbit/s)` or `bus b = sim(\"bench\")`"));
            }
            let text = text.map_or("", |text| text.text.as_str());
            let rate = rate.unwrap_or(1e6);
            let address = match bus.kind.text.as_str() {
                "can" => format!("socketcan:{text}"),
                "slcan" => format!("slcan:{text}@{rate}"),
                kind => format!("{kind}:{text}"),
            };
            out.push(rig::Bus { name: bus.name.text.clone(), address, bit_rate: rate as u32 });
        }
        out
    }

    /// One node of the plan.
    fn described(
        &mut self,
        k: usize,
        description: &Description,
        lists: &ExprIndices,
        param: &dyn Fn(&str) -> f64,
        period_ns: u64,
    ) -> Option<(rig::Node, MessageLayout)> {
        let statement = &description.statement;
        let bus = self.statements.buses.iter().position(|bus| bus.name.text == statement.bus.text);
        if bus.is_none() {
            let error = Diagnostic::error("E0204", format!("there is no bus `{}`", statement.bus.text))
                .label(statement.bus.span, "not declared in this rig");
            let names = self.statements.buses.iter().map(|bus| bus.name.text.as_str());
            let near = crate::frontend::names::nearest(&statement.bus.text, names).map(str::to_string);
            self.report(match near {
                Some(near) => error.help(format!("did you mean `{near}`?")),
                None => error.help(format!("add `bus {} = can(\"can0\", 1 Mbit/s)`", statement.bus.text)),
            });
        }
        let finite = |value: f64| value.is_finite().then_some(value);
        let mut timeout_ns = nanoseconds(param("timeout"));
        let (kind, laid) = match &description.protocol {
            Protocol::Cia402 { mode, at_sync, profile } => {
                let node = param("node");
                if node.fract() != 0.0 {
                    let error = Diagnostic::error("E0502", format!("node {node} is no whole number"))
                        .label(statement.kind.span, "a node id goes from 1 to 127");
                    self.report(error);
                }
                if timeout_ns == 0 {
                    timeout_ns = 3 * period_ns;
                }
                let travel = (param("travel_low"), param("travel_high"));
                let drive = rig::Cia402 {
                    node: node.clamp(1.0, 127.0) as u8,
                    rated_torque: param("T_rated"),
                    mode: *mode,
                    count: param("count"),
                    speed_unit: param("speed_unit"),
                    max_torque: finite(param("T_max")),
                    max_speed: finite(param("speed_max")),
                    travel: (travel.0.is_finite() || travel.1.is_finite()).then_some(travel),
                    max_power: finite(param("power_max")),
                    at_sync: *at_sync,
                    profile: profile.clone(),
                };
                (rig::Kind::Cia402(drive), MessageLayout::default())
            }
            Protocol::Frames(_) => {
                let mut laid = frames::by_hand(description, param, self.diagnostics);
                let messages = std::mem::take(&mut laid.messages);
                (rig::Kind::Frames(messages), laid)
            }
            Protocol::Dbc(messages) => {
                let sent = |m: usize| {
                    lists
                        .sends
                        .iter()
                        .any(|send| send.node == k && matches!(send.read, SignalRef::Field(other, _) if other == m))
                };
                let mut laid = frames::by_dbc(messages, &sent, self.diagnostics);
                let messages = std::mem::take(&mut laid.messages);
                (rig::Kind::Frames(messages), laid)
            }
        };
        if param("delay") > 200.0 * period_ns as f64 * 1e-9 {
            let error = Diagnostic::error("E0502", "a dead time of more than 200 periods")
                .label(statement.kind.span, format!("{} s", param("delay")));
            self.report(error.help("a command that acts so late drives nothing: is the unit right?"));
        }
        let framed = statement.moves && !matches!(description.protocol, Protocol::Cia402 { .. });
        let within = match framed {
            false => rig::DriveLimits::default(),
            true => {
                let travel = (param("travel_low"), param("travel_high"));
                rig::DriveLimits {
                    max_speed: finite(param("speed_max")),
                    travel: (travel.0.is_finite() || travel.1.is_finite()).then_some(travel),
                    max_power: finite(param("power_max")),
                }
            }
        };
        let node = rig::Node {
            name: description.name.text.clone(),
            bus: bus.unwrap_or(0),
            kind,
            moves: statement.moves,
            delay: param("delay"),
            lag: param("lag"),
            timeout_ns,
            within,
        };
        Some((node, laid))
    }

    fn output(
        &mut self,
        send: &OutputCommand,
        signal: Signal,
        nodes: &[rig::Node],
        number: &dyn Fn(usize) -> f64,
    ) -> rig::Output {
        let node = &nodes[send.node];
        let (low, high) = send.limit.map_or((f64::NEG_INFINITY, f64::INFINITY), |(a, b)| (number(a), number(b)));
        let slew = send.slew.map_or(f64::INFINITY, number);
        let safe = send.safe.map_or(0.0, number);
        let text = self.files.slice(send.path).to_string();
        let shown = |value: f64| {
            let number = abi::format::three_digits(send.unit.from_si(value));
            if send.unit.text.is_empty() { number } else { format!("{number} {}", send.unit) }
        };
        // The narrowest representation that the command must fit.
        let (carried, because) = match (&node.kind, signal.what) {
            (rig::Kind::Cia402(drive), SignalKind::Torque) => {
                let by_message = 32.767 * drive.rated_torque;
                match drive.max_torque {
                    Some(most) if most < by_message => ((-most, most), format!("`T_max` is {}", shown(most))),
                    _ => ((-by_message, by_message), "16 bits of a thousandth of `T_rated`".into()),
                }
            }
            (rig::Kind::Cia402(drive), SignalKind::Speed) => {
                let by_message = f64::from(i32::MAX) * drive.speed_unit;
                match drive.max_speed {
                    Some(most) if most < by_message => ((-most, most), format!("`speed_max` is {}", shown(most))),
                    _ => ((-by_message, by_message), "32 bits of `speed_unit`".into()),
                }
            }
            (rig::Kind::Cia402(drive), _) => {
                let by_message = f64::from(i32::MAX) * drive.count;
                let travel = drive.travel.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
                ((travel.0.max(-by_message), travel.1.min(by_message)), "`travel`, or 32 bits of `count`".into())
            }
            (rig::Kind::Frames(messages), SignalKind::Field(m, f)) => {
                let field = &messages[m].fields[f];
                (frames::carries(field), format!("{} bits of {}", field.bits, shown(field.scale)))
            }
            (rig::Kind::Frames(_), _) => ((f64::NEG_INFINITY, f64::INFINITY), String::new()),
        };
        let mut refuse = |code, message: String, label: String, help: String| {
            self.diagnostics.push(Diagnostic::error(code, message).label(send.span, label).help(help));
        };
        let range = format!("{} .. {}", shown(carried.0), shown(carried.1));
        if low > high {
            let message = format!("the limit of `{text}` is empty");
            refuse("E0802", message, format!("{} .. {}", shown(low), shown(high)), "the lower end comes first".into());
        } else if send.limit.is_some() && (low < carried.0 || high > carried.1) {
            let message = format!("the limit of `{text}` does not fit what carries it");
            refuse("E0802", message, because, format!("it carries {range}: narrow the limit"));
        } else if safe < low.max(carried.0) || safe > high.min(carried.1) {
            let message = format!("the safe value of `{text}` lies outside of its limit");
            refuse("E0802", message, shown(safe), "give a safe value within the limit".into());
        } else if safe != 0.0 && node.is_moved_by(signal.what) {
            let message = format!("the safe value of `{text}` would move it before it is armed");
            let zero = if send.unit.text.is_empty() { "0".to_string() } else { format!("0 {}", send.unit) };
            refuse("E0808", message, format!("{} is not 0", shown(safe)), format!("write `safe {text} = {zero}`"));
        }
        if slew <= 0.0 {
            let message = format!("a slew of {} never gets anywhere", abi::format::three_digits(slew));
            refuse("E0802", message, "not positive".into(), "give the greatest change per second".into());
        }
        // Without a stated limit, a command is limited to what the drive permits.
        let (low, high) = match (&node.kind, send.limit) {
            (rig::Kind::Cia402(_), None) if carried.1.is_finite() && !because_of_message(node, signal.what) => carried,
            _ => (low, high),
        };
        rig::Output { signal, slot: Slot(0), low, high, slew, safe }
    }

    fn predict(&mut self, lists: &ExprIndices, nodes: &[rig::Node]) -> Option<usize> {
        let (name, _) = self.statements.predict?;
        let Some(at) = self.node(&name.text) else {
            self.no_node(name, "drive");
            return None;
        };
        let torque = matches!(&nodes[at].kind, rig::Kind::Cia402(drive) if drive.mode == Mode::Torque);
        if !torque || !nodes[at].moves || !lists.sends.iter().any(|send| send.node == at) {
            let error = Diagnostic::error("E0205", format!("`{}` gives no torque that could be predicted", name.text))
                .label(name.span, "`predict` names the drive that emulates");
            self.report(error.help("name a `cia402` drive with `mode = torque`"));
            return None;
        }
        Some(at)
    }

    /// The signals that the control program reads, and whether each must be fresh.
    pub(super) fn signals(
        &mut self,
        cut: &mut PartitionedRig,
        system: &System,
        framed: &RigFrame,
        gives: &[PartOutput],
        at: &dyn Fn(usize) -> ExprId,
    ) {
        let mut from: Vec<ExprId> = gives.iter().map(|give| at(give.value)).collect();
        from.extend(&cut.stops);
        for (k, description) in self.descriptions.iter().enumerate() {
            let laid = self.laid_fields(&cut.rig.nodes[k], description);
            for (name, read) in description.reads() {
                let found = cut.control.var_ids().find(|id| {
                    let var = cut.control.var(*id);
                    var.instance == framed.nodes[k] && var.name == name && var.kind == VarKind::Input
                });
                let Some(id) = found.filter(|id| lives(&cut.control, *id)) else { continue };
                let used =
                    (0..cut.control.nodes.len() as u32).map(ExprId).find(|e| *cut.control.node(*e) == Node::Var(id));
                let Some(used) = used else { continue };
                let signal = Signal { node: k, what: frames::what(read, &laid) };
                let needed = from.iter().any(|expr| reaches(&cut.control, *expr, id));
                let node = &cut.rig.nodes[k];
                if needed && node.timeout_ns == 0 {
                    let text = format!("{}.{name}", description.name.text);
                    let error =
                        Diagnostic::error("E0806", format!("`{text}` is needed, and nobody says how old it may be"))
                            .label(description.statement.kind.span, "without `timeout`")
                            .label(cut.control.span(used), "needed here");
                    self.report(error.help("add `timeout = 100 ms`, or what the device keeps to"));
                }
                if node.moves
                    && matches!(signal.what, SignalKind::Speed | SignalKind::Position | SignalKind::Field(..))
                    && !cut.seen.contains(&id)
                    && !cut.applied.contains(&id)
                {
                    let text = format!("{}.{name}", description.name.text);
                    let error = Diagnostic::error("E0801", format!("nothing says what `{text}` measures"))
                        .label(cut.control.span(used), "read here");
                    let help = "wire it in `hardware`: which quantity of the part does it see?";
                    self.report(error.help(help));
                }
                self.unit_of_dbc(description, read, used, &cut.control);
                let start = match (&node.kind, signal.what) {
                    (rig::Kind::Frames(messages), SignalKind::Field(m, f)) => messages[m].fields[f].start,
                    _ => 0.0,
                };
                cut.rig.inputs.push(rig::Input { signal, slot: Slot(0), start, needed });
                cut.inputs.push(id);
            }
        }
        let of = |id: &VarId| -> Signal {
            let var = system.var(*id);
            let node = framed.nodes.iter().position(|node| *node == var.instance).unwrap_or(0);
            let description = &self.descriptions[node];
            let laid = self.laid_fields(&cut.rig.nodes[node], description);
            let read = description.reads().into_iter().find(|(name, _)| *name == var.name).map(|(_, read)| read);
            let command = cut.outputs.iter().position(|other| other == id);
            match (read, command) {
                (Some(read), _) => Signal { node, what: frames::what(read, &laid) },
                (None, Some(k)) => cut.rig.outputs[k].signal,
                (None, None) => Signal { node, what: SignalKind::Torque },
            }
        };
        let applied: Vec<(Signal, Slot)> = cut.applied.iter().map(|id| (of(id), Slot(0))).collect();
        let seen: Vec<(Signal, Slot)> = cut.seen.iter().map(|id| (of(id), Slot(0))).collect();
        cut.rig.plant.applied = applied;
        cut.rig.plant.seen = seen;
    }

    /// The location of the signals of a description by hand.
    fn laid_fields(&self, node: &rig::Node, description: &Description) -> MessageLayout {
        let (rig::Kind::Frames(messages), Protocol::Frames(signals)) = (&node.kind, &description.protocol) else {
            return MessageLayout::default();
        };
        let place = |name: &str| {
            let mut all = messages.iter().enumerate();
            all.find_map(|(m, message)| Some((m, message.fields.iter().position(|field| field.name == name)?)))
        };
        let fields = signals.iter().map(|signal| place(&signal.name.text).unwrap_or((0, 0))).collect();
        MessageLayout { messages: Vec::new(), fields }
    }

    /// W0806: a signal of a DBC file with an unknown unit.
    fn unit_of_dbc(&mut self, description: &Description, read: SignalRef, used: ExprId, control: &System) {
        let (Protocol::Dbc(messages), SignalRef::Field(m, f)) = (&description.protocol, read) else { return };
        let signal = &messages[m].signals[f];
        // A switch or a flag needs no unit.
        if signal.unit.is_some() || signal.unit_text.is_empty() && signal.bits == 1 {
            return;
        }
        let message = match signal.unit_text.as_str() {
            "" => format!("`{}` has no unit in the DBC file", signal.name),
            text => format!("`{}` has the unit `{text}` in the DBC file, which is not known", signal.name),
        };
        let warning = Diagnostic::warning("W0806", message)
            .label(control.span(used), "read as a pure number")
            .label(signal.span, "described here");
        self.diagnostics.push(warning.help("multiply it with its unit, as in `x * 1 bar`, or `allow dbc-unit \"…\"`"));
    }

    /// Recorded quantities, each in its unit.
    pub(super) fn shows(&mut self, cut: &mut PartitionedRig, lists: &ExprIndices) {
        let exprs = std::mem::take(&mut cut.records);
        // A quantity that is plotted is recorded once, whether `record` names it or not.
        let mut places = Vec::new();
        for ((show, _), expr) in lists.records.iter().zip(exprs) {
            let boolean = cut.control_types.boolean[expr.0 as usize];
            let dimension = cut.control_types.nodes[expr.0 as usize].unwrap_or(Dimension::NONE);
            let own = match cut.control.node(expr) {
                Node::Var(id) => cut.control_types.units[id.0 as usize].clone(),
                _ => Unit::si(dimension),
            };
            let shown = match &show.unit {
                None => own,
                Some(text) => match Unit::parse(&text.text) {
                    Ok(unit) if unit.dimension == dimension || boolean => unit,
                    Ok(unit) => {
                        let message = format!("this is {}, it cannot be shown in {unit}", dimension.describe());
                        let error = Diagnostic::error("E0101", message)
                            .label(text.span, unit.dimension.describe())
                            .label(cut.control.span(expr), Unit::si(dimension).to_string());
                        self.report(error.help("give it a unit of its own kind"));
                        own
                    }
                    Err(part) => {
                        let error = Diagnostic::error("E0102", format!("unknown unit `{part}`"));
                        self.report(error.label(text.span, "not known"));
                        own
                    }
                },
            };
            let label = one_line(self.files.slice(show.value.span));
            let series = Series { label, slot: Slot(0), unit: shown, boolean };
            let known = cut.rig.record.iter().position(|other| *other == series);
            let known = known.filter(|_| places.len() >= self.statements.records.len());
            places.push(known.unwrap_or(cut.rig.record.len()));
            if known.is_none() {
                cut.rig.record.push(series);
                cut.records.push(expr);
            }
        }
        let mut plotted = places.into_iter().skip(self.statements.records.len());
        for plot in &self.statements.plots {
            let series = plotted.by_ref().take(plot.shows.len()).collect();
            let against = plot.against.as_ref().and_then(|_| plotted.next());
            cut.rig.plots.push(rig::Curves { series, against });
        }
    }
}

impl PartitionedRig {
    /// The outputs of the control program; they precede those that an experiment requests.
    pub fn wanted(&self, control: &System) -> Vec<Observed> {
        let commands = self.outputs.iter().zip(&self.commands_read);
        let commands = commands.map(|(id, read)| (*read, control.var(*id).path.clone()));
        let stops = self.stops.iter().zip(&self.rig.stops).map(|(expr, stop)| (*expr, stop.condition.clone()));
        let records = self.records.iter().zip(&self.rig.record).map(|(expr, series)| (*expr, series.label.clone()));
        let all = commands.chain(stops).chain(records);
        let all = all.map(|(expr, text)| Observed { expr, text, unit: None });
        all.chain(self.margins.iter().map(Margin::wanted)).collect()
    }

    /// The outputs of the plant program.
    pub fn wanted_of_plant(&self) -> Vec<Observed> {
        let one = |(id, read): (&VarId, &ExprId)| Observed {
            expr: *read,
            text: self.plant.var(*id).path.clone(),
            unit: None,
        };
        self.seen.iter().zip(&self.seen_read).map(one).collect()
    }

    /// Period of the cycle, s.
    pub fn period(&self) -> f64 {
        self.rig.period_ns as f64 * 1e-9
    }

    /// The plan and the plant program, for a control program whose first `own` outputs are those of the rig.
    pub fn with_plant(&self, control: &lower::Lowered, own: usize) -> (Rig, Program) {
        let plant = lower(&self.plant, &self.plant_types, &self.wanted_of_plant());
        let rig = self.finish(&control.program, &control.observed[..own], &plant);
        (rig, plant.program)
    }

    /// Lowers both systems and completes the plan. Adds warnings.
    pub fn lowered(&self, warnings: &mut Vec<Diagnostic>) -> super::Lowered {
        let control = lower(&self.control, &self.control_types, &self.wanted(&self.control));
        let plant = lower(&self.plant, &self.plant_types, &self.wanted_of_plant());
        let rig = self.finish(&control.program, &control.observed, &plant);
        let rooms = &control.observed[control.observed.len() - self.margins.len()..];
        let mut program = control.program;
        margins::watch(&self.margins, rooms, &mut program);
        let (mut control, mut plant) = (program, plant.program);
        let period = rig.period_ns as f64 * 1e-9;
        control.size_rings(period / f64::from(rig.steps));
        plant.size_rings(period / f64::from(super::PLANT_STEPS));
        warnings.extend(self.advice(&rig, &control, &plant));
        let (mut live, judge) = self.judged.clone().finish(&control, &plant);
        for Tuned { path, range, .. } in &self.tuned {
            let param = live.params.iter().position(|param| param.path == *path);
            live.tuned.extend(param.map(|param| words::Tuned { param, range: *range }));
        }
        super::Lowered { rig, control, plant, live, judge }
    }

    /// E0504: parameters that `tune` names although only a start reads them.
    pub fn untunable(&self, live: &Live) -> Vec<Diagnostic> {
        let one = |Tuned { path, span, .. }: &Tuned| {
            let Tunable::Start(why) = &live.param(path)?.place else { return None };
            let error = Diagnostic::error("E0504", format!("`{path}` cannot be tuned while the rig runs"));
            let error = error.label(*span, format!("only a start reads it: {why}"));
            Some(error.help(format!("leave it out, and set it at a start with `--set {path}=…`")))
        };
        self.tuned.iter().filter_map(one).collect()
    }

    /// Warnings about the rig, except those that it allows.
    pub fn advice(&self, rig: &Rig, control: &Program, plant: &Program) -> Vec<Diagnostic> {
        let mut found = advice::check(rig, &self.control, control, plant, &self.places);
        found.retain(|warning| !self.allowed(warning));
        found
    }

    /// Errors and warnings about the steps of the control program, except those that the rig allows. `system` and
    /// `types`: of the control program.
    pub fn steps(
        &self,
        (system, types): (&System, &Types),
        rig: &Rig,
        control: &Program,
        files: &Files,
    ) -> Vec<Diagnostic> {
        let mut found = self.stability((system, types), rig, control, files);
        found.extend(crate::analysis::acting_mass::check(system, types, control, rig.plant.inertia, self.places.run));
        found.retain(|said| said.is_error() || !self.allowed(said));
        found
    }

    /// Errors and warnings about the stability of the steps of the control program, whose parameters may have other
    /// values than those of the system.
    pub fn stability(
        &self,
        (system, types): (&System, &Types),
        rig: &Rig,
        control: &Program,
        files: &Files,
    ) -> Vec<Diagnostic> {
        let ends: Vec<(ExprId, Slot)> =
            self.stops.iter().zip(&rig.stops).map(|(condition, stop)| (*condition, stop.slot)).collect();
        let fixed = step_stability_report::Fixed {
            system,
            types,
            program: control,
            method: rig.method,
            step: rig.period_ns as f64 * 1e-9 / f64::from(rig.steps),
            place: self.places.solver,
            run: self.places.run,
            ends: &ends,
            by: StepBy::Rate,
            name: &rig.name,
        };
        step_stability_report::check(&fixed, files)
    }

    fn allowed(&self, warning: &Diagnostic) -> bool {
        LINTS.iter().any(|(name, code)| *code == warning.code && self.places.allows.iter().any(|allow| allow == name))
    }

    /// The plan with the slots of both programs.
    pub fn finish(&self, control: &Program, observed: &[Slot], plant: &lower::Lowered) -> Rig {
        let mut rig = self.rig.clone();
        // Both systems have the same quantities.
        let input = |program: &Program, id: VarId| {
            let path = &self.plant.var(id).path;
            let mut all = program.description.quantities.iter();
            let found = all.find(|quantity| quantity.kind == QuantityKind::Input && quantity.path == *path);
            found.map_or(Slot(0), |quantity| quantity.slot)
        };
        for (one, id) in rig.inputs.iter_mut().zip(&self.inputs) {
            one.slot = input(control, *id);
        }
        let mut slots = observed.iter().copied();
        rig.outputs.iter_mut().for_each(|output| output.slot = slots.next().expect("a slot for each command"));
        rig.stops.iter_mut().for_each(|stop| stop.slot = slots.next().expect("a slot for each stop"));
        rig.record.iter_mut().for_each(|series| series.slot = slots.next().expect("a slot for each record"));
        for (one, id) in rig.plant.applied.iter_mut().zip(&self.applied) {
            one.1 = input(&plant.program, *id);
        }
        for (one, slot) in rig.plant.seen.iter_mut().zip(&plant.observed) {
            one.1 = *slot;
        }
        rig.plant.inertia = advice::inertia(&rig, &plant.program);
        rig
    }
}

/// Whether a quantity of a drive is bounded only by the message format.
fn because_of_message(node: &rig::Node, what: SignalKind) -> bool {
    match (&node.kind, what) {
        (rig::Kind::Cia402(drive), SignalKind::Torque) => drive.max_torque.is_none(),
        (rig::Kind::Cia402(drive), SignalKind::Speed) => drive.max_speed.is_none(),
        (rig::Kind::Cia402(drive), _) => drive.travel.is_none(),
        (rig::Kind::Frames(_), _) => false,
    }
}

/// Whether an expression depends on the present value of a quantity.
fn reaches(system: &System, expr: ExprId, id: VarId) -> bool {
    let mut seen = vec![false; system.nodes.len()];
    let mut stack = vec![expr];
    while let Some(expr) = stack.pop() {
        if std::mem::replace(&mut seen[expr.0 as usize], true) {
            continue;
        }
        if let Node::Var(var) = system.node(expr) {
            if *var == id {
                return true;
            }
            if let Definition::Value(value, _) = system.var(*var).definition {
                stack.push(value);
            }
        }
        if let Node::Crossing(crossing) = system.node(expr) {
            stack.push(system.crossings[*crossing as usize].difference);
        }
        stack.extend(system.node(expr).operands());
    }
    false
}

fn nanoseconds(seconds: f64) -> u64 {
    if seconds > 0.0 { (seconds * 1e9).round() as u64 } else { 0 }
}

/// The text on one line.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
