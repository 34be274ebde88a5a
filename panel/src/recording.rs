//! A recording of a rig: its cycles as curves, and what happened beside them.
//!
//! In: the messages of a log, one after the other; more may come while it is shown. Out: curves thinned from their
//! extremes at every scale, in bounded memory; events; a histogram of how late the cycles began.

use crate::frame::{Block, COLUMNS, Frame, PATH};
use crate::history::History;
use crate::line::{View, Window};
use crate::sheet::{Phase, Sheet, Signal};
use crate::steady::Steady;
use crate::subject::{Page, Subject};
use crate::thin;
use crate::twin::{Ahead, COARSE, Difference, Short, State, Twin};
use crate::words::clean;
use abi::format;
use abi::rig::{Rig, SignalKind};
use abi::{Description, Instance, Slot};
use runtime::can::frame_length;
use runtime::hil::control::{Control, Reading, Source};
use runtime::hil::origin::Origin;
use runtime::hil::trace::{self, Cycle, Passed, Shape};
use runtime::hil::words;
use runtime::record::log::{LOST, Message};
use runtime::safety::{Clamps, DriveCommand};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Events that are kept, the newest.
const EVENTS: usize = 2000;
/// Bars of a decade in the histogram of lateness, and of all of it, from 1 µs.
const PARTS: usize = 6;
const BARS: usize = 5 * PARTS;
/// The layer of steady curves, after the recording, the dry run and the short ones.
const STEADY: u32 = 3;
/// Signals and cycles of a picture in the plane: x, y, from, to.
type Path = (u32, u32, u64, u64);
/// Its points, for all who ask for it.
type Picture = Arc<Vec<(f64, f64)>>;
/// Pictures that are kept.
const PATHS: usize = 8;
/// Points of a path.
const PATH_POINTS: u64 = 60_000;

/// Share of its time from which a bus is too busy: frames of the cycle would wait.
const HEAVY: f64 = 0.9;

/// Short runs of the model that are kept, and states from which one waits to be made: the newest.
const AHEAD: usize = 30;

/// Interval at which counts and the histogram are shown anew while more comes.
const TELL: Duration = Duration::from_millis(500);

/// Something that happened at a time.
struct Event {
    cycle: u64,
    kind: &'static str,
    text: String,
}

/// The load of a bus, from the frames in the log.
#[derive(Clone, Copy, Default)]
struct Load {
    /// The second that is counted, and its bits so far.
    second: u64,
    bits: u64,
    /// Bits in the last whole second.
    last: Option<u64>,
}

impl Load {
    fn count(&mut self, second: u64, bits: u32) {
        if second != self.second {
            // A second without any frame is 0, and the first one is not whole.
            self.last = (self.second > 0).then_some(if second == self.second + 1 { self.bits } else { 0 });
            (self.second, self.bits) = (second, 0);
        }
        self.bits += u64::from(bits);
    }
}

/// The steady curve of a contact.
struct Settles {
    phase: Phase,
    /// The greatest speed so far, SI.
    most: f64,
    /// The greatest speed for which the curve was made, the sets before it, and when.
    made: Option<(f64, usize, Instant)>,
    points: Vec<(f64, f64)>,
    /// Where the data ended when it came.
    from: u64,
}

/// Growth of the greatest speed from which a steady curve is made anew, and the least time between two.
const WIDER: f64 = 1.25;
const SETTLES: Duration = Duration::from_secs(1);

/// A recording.
pub struct Recording {
    name: String,
    rig: Rig,
    description: Description,
    shape: Shape,
    signals: Vec<abi::rig::Signal>,
    sheet: Sheet,
    history: History,
    row: Vec<f64>,
    events: VecDeque<Event>,
    /// For each output since which cycle it has been clamped.
    clamped: Vec<Option<u64>>,
    /// Causes of a stop that were told.
    causes: BTreeSet<String>,
    bars: [u64; BARS],
    late_ns_max: u32,
    cycles: u64,
    missed: u64,
    lost: u64,
    /// How it ended; none while more comes.
    ends: Option<String>,
    /// Its first cycle.
    first: Option<u64>,
    /// Number of what [`Subject::state`] tells, and when it changed last.
    told: (u64, Instant),
    /// Who gave the command that was carried out last, when, and its name.
    said: Option<(u64, &'static str, Origin)>,
    /// Parameters that were set while it ran, SI, and the number of sets.
    set: BTreeMap<Slot, f64>,
    sets: usize,
    /// Both programs of the rig at their start.
    programs: Arc<(Instance, Instance)>,
    /// Whether the dry run from arming on has been begun.
    twins: bool,
    /// When the model took over, in cycles, and what was set before.
    armed: Option<(u64, Vec<(Slot, f64)>)>,
    twin: Vec<Vec<(f64, f64)>>,
    differences: Vec<Difference>,
    /// Where the data ended when the dry run came.
    twin_from: u64,
    /// Permitted commands and status words of the last cycle.
    last: (Vec<f64>, Vec<u16>),
    /// What the drives measured in the last cycle, and whether the model ran.
    measured: (Vec<(abi::rig::Signal, f64)>, bool),
    /// States from which no short run has been made yet, the oldest first.
    states: VecDeque<State>,
    /// Short runs, in the order of time, and where the data ended when the latest came.
    ahead: (VecDeque<Ahead>, u64),
    /// The newest short run that is over, and how much the recording differs from it.
    judged: (Option<u64>, Vec<Option<f64>>),
    /// The steady curves of its contacts.
    curves_of: Vec<Settles>,
    /// Pictures in the plane, the newest.
    paths: RefCell<VecDeque<(Path, Picture)>>,
    /// Whether somebody makes short runs.
    running: bool,
    buses: Vec<Load>,
}

impl Recording {
    /// An empty recording of a rig. `keep`: bytes of its curves in memory.
    /// `programs`: of control and of the part that the drives replace, at their start.
    pub fn new(name: &str, rig: &Rig, programs: (&Instance, &Instance), control: &Control, keep: u64) -> Recording {
        let description = programs.0.description();
        let signals: Vec<abi::rig::Signal> = control.signals().collect();
        let mut sheet = Sheet::default();
        let recorded: Vec<usize> = rig.record.iter().map(|series| sheet.signal(Signal::of(series))).collect();
        let mut all: Vec<Signal> = Vec::new();
        for signal in &signals {
            let boolean = matches!(signal.what, SignalKind::Enabled | SignalKind::Fault | SignalKind::Limited);
            all.push(Signal { label: words::signal(rig, *signal), unit: words::unit(rig, *signal), boolean });
        }
        let readings = all.len();
        for output in &rig.outputs {
            for word in ["requested", "permitted"] {
                let label = format!("{} {word}", words::signal(rig, output.signal));
                all.push(Signal { label, unit: words::unit(rig, output.signal), boolean: false });
            }
        }
        // Readings and commands keep their numbers also where a recorded quantity has the same name.
        let begin = sheet.signals.len();
        sheet.signals.extend(all);
        let mut plotted = BTreeSet::new();
        for plot in &rig.plots {
            let series: Vec<usize> = plot.series.iter().map(|at| recorded[*at]).collect();
            let against = plot.against.map(|at| recorded[at]);
            plotted.extend(series.iter().copied().chain(against));
            sheet.place(&series, against);
        }
        let others: Vec<usize> = recorded.iter().copied().filter(|signal| !plotted.contains(signal)).collect();
        sheet.place(&others, None);
        sheet.place(&(begin..begin + readings).collect::<Vec<_>>(), None);
        sheet.place(&(begin + readings..sheet.signals.len()).collect::<Vec<_>>(), None);
        sheet.place_phases();
        // Readings and commands are no quantities of the model.
        let phases = sheet.phases().into_iter().filter(|phase| phase.force.max(phase.speed) < rig.record.len());
        let settles = |phase| Settles { phase, most: 0.0, made: None, points: Vec::new(), from: 0 };
        let curves_of = phases.map(settles).collect();
        let count = sheet.signals.len();
        Recording {
            name: name.into(),
            rig: rig.clone(),
            description: (**description).clone(),
            shape: Shape::of(rig, control),
            signals,
            sheet,
            history: History::new(count, keep),
            row: vec![0.0; count],
            events: VecDeque::new(),
            clamped: vec![None; rig.outputs.len()],
            causes: BTreeSet::new(),
            bars: [0; BARS],
            late_ns_max: 0,
            cycles: 0,
            missed: 0,
            lost: 0,
            ends: None,
            first: None,
            told: (1, Instant::now()),
            said: None,
            set: BTreeMap::new(),
            sets: 0,
            curves_of,
            programs: Arc::new((programs.0.clone(), programs.1.clone())),
            twins: false,
            armed: None,
            twin: Vec::new(),
            differences: Vec::new(),
            twin_from: 0,
            last: (Vec::new(), Vec::new()),
            measured: (Vec::new(), false),
            states: VecDeque::new(),
            ahead: (VecDeque::new(), 0),
            judged: (None, Vec::new()),
            paths: RefCell::default(),
            running: false,
            buses: rig.buses.iter().map(|_| Load::default()).collect(),
        }
    }

    /// Adds a message of the log; false if it does not belong to this rig.
    pub fn add(&mut self, message: &Message) -> bool {
        match message.kind {
            LOST => {
                let lost = message.words.first().copied().unwrap_or(1);
                self.lost += lost;
                let at = self.history.cycles().end;
                self.event(at, "bad", format!("{lost} messages were lost when it was written"));
                true
            }
            trace::CYCLE => match Cycle::read(self.shape, &message.words) {
                Some(cycle) => {
                    self.cycle(&cycle);
                    true
                }
                None => false,
            },
            trace::FRAMES => {
                for passed in Passed::read(&message.words).into_iter().flatten() {
                    if let Some(load) = self.buses.get_mut(usize::from(passed.bus)) {
                        load.count(passed.stamp_ns / 1_000_000_000, frame_length::bits(&passed.frame));
                    }
                }
                true
            }
            trace::STATE => {
                self.state_of_cycle(&message.words);
                true
            }
            trace::COMMAND => {
                // A command of a later version is no reason to show nothing.
                self.said = trace::read_command(&message.words);
                if let Some((due_ns, name @ ("enable" | "arm" | "stop"), origin)) = self.said {
                    self.event(due_ns / self.rig.period_ns, "said", format!("{name}, by {origin}"));
                }
                true
            }
            trace::MARK => match trace::read_mark(&message.words) {
                Some((due_ns, words)) => {
                    let by = self.said_by(due_ns, "mark");
                    self.event(due_ns / self.rig.period_ns, "mark", format!("{words}{by}"));
                    true
                }
                None => false,
            },
            _ => true,
        }
    }

    /// Says how the log ends.
    pub fn end(&mut self, ends: String) {
        let end = self.history.cycles().end;
        for output in 0..self.clamped.len() {
            self.clamp(output, end, Clamps::default());
        }
        self.ends = Some(ends);
        self.judge();
        self.tell();
    }

    fn tell(&mut self) {
        self.told = (self.told.0 + 1, Instant::now());
    }

    /// Says that some messages were added.
    pub fn added(&mut self) {
        if self.told.1.elapsed() > TELL {
            self.tell();
        }
    }

    /// The value of a parameter that was set while it ran, SI.
    pub fn set_value(&self, slot: Slot) -> Option<f64> {
        self.set.get(&slot).copied()
    }

    /// The dry run that is to be made, once: when the model has taken over.
    pub fn wants_twin(&mut self) -> Option<Twin> {
        let (at, set) = self.armed.as_ref().filter(|_| !self.twins)?;
        let (control, plant) = (*self.programs).clone();
        self.twins = true;
        Some(Twin { rig: self.rig.clone(), control, plant, set: set.clone(), at: self.seconds(*at) })
    }

    /// A steady curve that is to be made, and its number: for other values of parameters, or greater speeds.
    pub fn wants_steady(&mut self) -> Option<(usize, Steady)> {
        let sets = self.sets;
        let due = |one: &Settles| match one.made {
            None => one.most > 0.0,
            Some((most, before, at)) => {
                (one.most > WIDER * most || before != sets) && (at.elapsed() > SETTLES || self.ends.is_some())
            }
        };
        let at = self.curves_of.iter().position(due)?;
        let one = &mut self.curves_of[at];
        one.made = Some((one.most, sets, Instant::now()));
        let series = |signal: usize| self.rig.record[signal].clone();
        let steady = Steady {
            rig: self.rig.clone(),
            control: self.programs.0.clone(),
            set: self.set.iter().map(|(slot, si)| (*slot, *si)).collect(),
            force: series(one.phase.force),
            speed: series(one.phase.speed),
            most: one.most,
        };
        Some((at, steady))
    }

    /// Shows a steady curve.
    pub fn settles(&mut self, at: usize, points: Vec<(f64, f64)>) {
        let end = self.history.cycles().end;
        (self.curves_of[at].points, self.curves_of[at].from) = (points, end);
        self.tell();
    }

    /// Keeps a full state: the next short run starts there.
    fn state_of_cycle(&mut self, words: &[u64]) {
        let size = self.programs.0.block().len();
        let Some(block) = words.get(2..2 + size).filter(|_| self.measured.1) else { return };
        let block = block.iter().map(|word| f64::from_bits(*word)).collect();
        let at = self.history.cycles().end.saturating_sub(1);
        self.judge();
        if self.states.len() == AHEAD {
            self.states.pop_front();
        }
        self.states.push_back(State { at, block, measured: self.measured.0.clone(), permitted: self.last.0.clone() });
    }

    /// What a short run needs, if one is to be made that nobody makes already: the newest first.
    pub fn wants_ahead(&mut self, goes_on: bool) -> Option<Short> {
        if self.running && !goes_on {
            return None;
        }
        let state = self.states.pop_back();
        self.running = state.is_some();
        Some(Short { rig: self.rig.clone(), programs: self.programs.clone(), from: state? })
    }

    /// Shows a short run.
    pub fn runs_ahead(&mut self, made: Ahead) {
        let (all, from) = &mut self.ahead;
        let place = all.partition_point(|other| other.at < made.at);
        all.insert(place, made);
        if all.len() > AHEAD {
            all.pop_front();
        }
        *from = self.history.cycles().end;
        self.judge();
        self.tell();
    }

    /// Computes how much the recording differs from the newest short run that is over, for each recorded quantity: once,
    /// and not for each viewer.
    fn judge(&mut self) {
        let end = self.history.cycles().end;
        let over = |one: &&Ahead| one.curves.first().is_some_and(|curve| one.at + (curve.len() as u64) < end);
        let Some(last) = self.ahead.0.iter().rev().find(over) else { return };
        if self.judged.0 != Some(last.at) {
            let rms = |curve| last.rms(curve, |cycle| self.history.value(curve, cycle));
            self.judged = (Some(last.at), (0..last.curves.len()).map(rms).collect());
        }
    }

    /// Shows a dry run beside the recorded quantities.
    pub fn beside(&mut self, twin: Vec<Vec<(f64, f64)>>) {
        self.differences = vec![Difference::default(); twin.len()];
        let all = self.history.cycles();
        for (signal, (difference, twin)) in self.differences.iter_mut().zip(&twin).enumerate() {
            for cycle in self.armed.as_ref().map_or(all.end, |armed| armed.0.max(all.start))..all.end {
                let t = cycle as f64 * self.rig.period_ns as f64 * 1e-9;
                difference.see(twin, t, self.history.value(signal, cycle));
            }
        }
        (self.twin, self.twin_from) = (twin, all.end);
        self.tell();
    }

    /// How the drives and commands stand, for the page.
    fn standing(&self) -> Value {
        let moving = self.rig.nodes.iter().filter(|node| node.moves);
        let drives = moving.zip(&self.last.1).map(|(node, word)| {
            let (kind, words) = condition(*word);
            json!({ "name": clean(&node.name), "kind": kind, "words": words })
        });
        let commands = self
            .rig
            .outputs
            .iter()
            .zip(&self.last.0)
            .filter(|(output, _)| output.low.is_finite() && output.high.is_finite() && output.low < output.high);
        let commands = commands.map(|(output, value)| {
            let unit = words::unit(&self.rig, output.signal);
            json!({
                "name": clean(&words::signal(&self.rig, output.signal)),
                "value": value, "low": output.low, "high": output.high, "unit": unit.text,
            })
        });
        let buses = self.rig.buses.iter().zip(&self.buses).filter_map(|(bus, load)| {
            // Some adapters set no bit rate: then nothing is known of the load.
            let share = load.last.filter(|_| bus.bit_rate > 0)? as f64 / f64::from(bus.bit_rate);
            let kind = if share < HEAVY { "good" } else { "bad" };
            Some(json!({ "name": clean(&bus.name), "kind": kind, "words": format!("{:.0} % busy", 100.0 * share) }))
        });
        let log = match self.lost {
            0 => json!({ "name": "log", "kind": "good", "words": "whole" }),
            lost => json!({
                "name": "log", "kind": "bad", "words": format!("{} messages lost", format::count(lost)),
            }),
        };
        let drives: Vec<Value> = drives.chain(buses).chain([log]).collect();
        json!({ "drives": drives, "commands": commands.collect::<Vec<_>>() })
    }

    /// The number of [`Recording::state`].
    pub fn told(&self) -> u64 {
        self.told.0
    }

    /// Whether it holds a cycle.
    pub fn is_empty(&self) -> bool {
        self.cycles == 0
    }

    fn event(&mut self, cycle: u64, kind: &'static str, text: String) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back(Event { cycle, kind, text });
        self.tell();
    }

    fn clamp(&mut self, output: usize, at: u64, clamps: Clamps) {
        match (self.clamped[output], clamps != Clamps::default()) {
            (None, true) => self.clamped[output] = Some(at),
            (Some(since), false) => {
                self.clamped[output] = None;
                let name = words::signal(&self.rig, self.rig.outputs[output].signal);
                let lasted = format::duration((at - since) as f64 * self.rig.period_ns as f64 * 1e-9, 3);
                self.event(since, "warning", format!("{name} was clamped for {lasted}"));
            }
            (None, false) | (Some(_), true) => {}
        }
    }

    fn cycle(&mut self, cycle: &Cycle) {
        // A missed tick is a gap: what is drawn is the time at which a cycle was due.
        let at = cycle.due_ns / self.rig.period_ns;
        self.first.get_or_insert(at);
        self.cycles += 1;
        self.missed += u64::from(cycle.ticks.saturating_sub(1));
        self.late_ns_max = self.late_ns_max.max(cycle.late_ns);
        #[allow(clippy::disallowed_methods, reason = "a picture")]
        let bar = (f64::from(cycle.late_ns.max(1000)) / 1000.0).log10() * PARTS as f64;
        self.bars[(bar as usize).min(BARS - 1)] += 1;
        let recorded = self.rig.record.iter().zip(&cycle.recorded).map(|(series, si)| series.unit.from_si(*si));
        // A reading that has never come is no number.
        let readings = cycle.readings.iter().map(|one| if one.age == Reading::NEVER { f64::NAN } else { one.value });
        let commands = cycle.requests.iter().zip(&cycle.permitted).flat_map(|(asked, given)| [*asked, *given]);
        for (place, value) in self.row.iter_mut().zip(recorded.chain(readings).chain(commands)) {
            *place = value;
        }
        for one in &mut self.curves_of {
            let speed = cycle.recorded.get(one.phase.speed).map_or(0.0, |speed| speed.abs());
            if speed > one.most && speed.is_finite() {
                one.most = speed;
            }
        }
        self.history.push(at, &self.row);
        let t = self.seconds(at);
        for ((difference, twin), value) in self.differences.iter_mut().zip(&self.twin).zip(&self.row) {
            difference.see(twin, t, *value);
        }
        self.measured.0.clear();
        let known = cycle.readings.iter().zip(&self.signals).filter(|(reading, _)| reading.age != Reading::NEVER);
        self.measured.0.extend(known.map(|(reading, signal)| (*signal, reading.value)));
        self.measured.1 = cycle.source == Source::Model && cycle.order == DriveCommand::Follow;
        self.last.0.clone_from(&cycle.permitted);
        self.last.1.clone_from(&cycle.statuses);
        if cycle.arms && cycle.source == Source::Model && self.armed.is_none() {
            self.armed = Some((at, self.set.iter().map(|(slot, si)| (*slot, *si)).collect()));
        }
        if cycle.arms {
            let whose = match cycle.source {
                Source::Model => "armed: the model runs",
                Source::StartUp => "armed: the start-up moves the drives",
                Source::Nobody => "armed",
            };
            self.event(at, "good", whose.into());
        }
        for (slot, si) in &cycle.set {
            self.set.insert(*slot, *si);
            self.sets += 1;
            let text = self.words_of_set(*slot, *si) + &self.said_by(cycle.due_ns, "set");
            self.event(at, "set", text);
        }
        for cause in &cycle.causes {
            let why = words::cause(&self.rig, &self.description, &self.signals, *cause, None);
            // A cause stands in every cycle from the first to the end.
            if self.causes.insert(why.clone()) {
                self.event(at, "bad", why);
            }
        }
        for (output, clamps) in cycle.clamps.iter().enumerate() {
            self.clamp(output, at, *clamps);
        }
    }

    /// Who gave this command at this time, as the end of a sentence; empty where the log does not say.
    fn said_by(&self, due_ns: u64, name: &str) -> String {
        match self.said {
            Some((then_ns, said, origin)) if (then_ns, said) == (due_ns, name) => format!(", by {origin}"),
            _ => String::new(),
        }
    }

    fn words_of_set(&self, slot: Slot, si: f64) -> String {
        let quantity = self.description.quantities.iter().find(|quantity| quantity.slot == slot);
        match quantity {
            Some(quantity) => format!("{} = {}", quantity.path, format::quantity(si, &quantity.unit, 6)),
            None => format!("slot {} = {si}", slot.0),
        }
    }

    fn seconds(&self, cycle: u64) -> f64 {
        cycle as f64 * self.rig.period_ns as f64 * 1e-9
    }

    /// Lateness in µs below which a part of all cycles began: the upper edge of its bar.
    fn late(&self, part: f64) -> f64 {
        let wanted = (part * self.cycles as f64).ceil() as u64;
        let mut sum = 0;
        let bar = self.bars.iter().position(|bar| {
            sum += bar;
            sum >= wanted
        });
        edge(bar.unwrap_or(BARS - 1) + 1)
    }

    /// Curves of the whole recording in this many columns, for a report.
    pub fn curves(&self, columns: u32) -> Vec<(u32, Vec<(f64, f64)>)> {
        let (first, count, width) = self.columns(Window::All, columns, self.history.cycles().end);
        let curve = |signal: usize| {
            let pairs = self.history.columns(signal, first, count, width);
            let points = pairs.iter().enumerate().flat_map(|(i, (a, b))| {
                let begin = (first + i as u64) * width;
                let halves = if width == 1 { [0.0, 0.0] } else { [0.25, 0.75] };
                halves.map(|half| self.seconds(begin) + half * self.seconds(width)).into_iter().zip([*a, *b])
            });
            let mut points: Vec<(f64, f64)> = points.collect();
            points.dedup();
            points
        };
        (0..self.sheet.signals.len()).map(|signal| (signal as u32, curve(signal))).collect()
    }

    /// The begin of what is in memory, and the end up to `end` cycles, s.
    fn extent(&self, end: u64) -> (f64, f64) {
        (self.seconds(self.first.unwrap_or(0).max(self.history.cycles().start)), self.seconds(end))
    }

    fn cycle_at(&self, seconds: f64) -> u64 {
        (seconds / self.seconds(1)).clamp(0.0, 1e15) as u64
    }

    /// The first column of a window, their number, and cycles a column, when the data went to cycle `end`.
    fn columns(&self, window: Window, columns: u32, end: u64) -> (u64, usize, u64) {
        let (begin, newest) = self.extent(end);
        let (from, to) = match window {
            Window::All => (self.cycle_at(begin), end),
            // Its width depends on nothing but the view, so that columns stay the same while more comes.
            Window::Last(seconds) => {
                let width = self.cycle_at(seconds).div_ceil(u64::from(columns)).max(1);
                let first = end.saturating_sub(u64::from(columns) * width) / width;
                return (first, (end.div_ceil(width) - first) as usize, width);
            }
            Window::Span(..) => {
                let (from, to) = window.within(begin, newest);
                (self.cycle_at(from).saturating_sub(1), self.cycle_at(to) + 2)
            }
        };
        let width = (to - from).div_ceil(u64::from(columns)).max(1);
        let first = from / width;
        (first, ((to.div_ceil(width) - first) as usize).min(columns as usize + 2), width)
    }

    /// The columns of a view that are new or others since the data went to cycle `since`.
    fn fresh(&self, view: &View, columns: u32, since: Option<u64>) -> (u64, usize, u64) {
        let (first, count, width) = self.columns(view.window, columns, self.history.cycles().end);
        let Some(since) = since else { return (first, count, width) };
        let (_, _, before) = self.columns(view.window, columns, since);
        if before != width {
            return (first, count, width);
        }
        // The last column was not complete then.
        let begin = (since / width).max(first);
        (begin, (first + count as u64).saturating_sub(begin) as usize, width)
    }
}

/// The state of a drive with this status word, as kind and words (CiA 402, table 30); a drive without status words has 0.
fn condition(word: u16) -> (&'static str, &'static str) {
    match (word & 0x4f, word & 0x6f) {
        (0x0f, _) => ("bad", "reacts to a fault"),
        (0x08, _) => ("bad", "fault"),
        (0x40, _) => ("old", "switch on disabled"),
        (_, 0x21) => ("old", "ready to switch on"),
        (_, 0x23) => ("old", "switched on"),
        (_, 0x27) => ("good", "follows commands"),
        (_, 0x07) => ("bad", "quick stop"),
        _ => ("old", "no status"),
    }
}

/// The lower edge of a bar, µs.
fn edge(bar: usize) -> f64 {
    #[allow(clippy::disallowed_methods, reason = "a picture")]
    10f64.powf(bar as f64 / PARTS as f64)
}

impl Recording {
    /// What does not change: see [`Subject::hello`].
    pub fn hello(&self) -> Value {
        let (signals, canvases) = self.sheet.json();
        let (from, to) = self.extent(self.history.cycles().end);
        json!({
            "kind": "recording",
            "file": clean(&self.name),
            "title": clean(&self.rig.name),
            "experiments": [],
            "cases": [""],
            "signals": signals,
            "canvases": canvases,
            "phases": self.sheet.phases_json(),
            "knobs": [],
            "from": from,
            "to": to,
            "period": self.seconds(1),
            "solver": "",
            "grows": self.ends.is_none(),
        })
    }

    /// What changes now and then: see [`Subject::state`].
    pub fn state(&self) -> Value {
        let events = self
            .events
            .iter()
            .rev()
            .map(|event| json!({ "t": self.seconds(event.cycle), "kind": event.kind, "text": clean(&event.text) }));
        let (from, to) = self.extent(self.history.cycles().end);
        let cut = self.first.is_some_and(|first| self.history.cycles().start > first);
        let ends = self.ends.as_deref().unwrap_or("more comes");
        let mut words = format!("{} cycles; {ends}", format::count(self.cycles));
        if cut {
            words += "; its beginning does not fit into --keep";
        }
        if self.lost > 0 {
            words += &format!("; {} messages were lost when it was written", format::count(self.lost));
        }
        json!({
            "values": [],
            "texts": [],
            "layers": [
                true,
                !self.twin.is_empty(),
                !self.ahead.0.is_empty(),
                self.curves_of.iter().any(|one| !one.points.is_empty()),
            ],
            "kept": [],
            "rms": self.differences.iter().map(Difference::rms).collect::<Vec<_>>(),
            "ahead": self.judged.1,
            "standing": self.standing(),
            "words": clean(&words),
            "set": "",
            "from": from,
            "to": to,
            "grows": self.ends.is_none(),
            "events": events.collect::<Vec<_>>(),
            "late": {
                "edges": (0..=BARS).map(edge).collect::<Vec<_>>(),
                "counts": self.bars,
                "p50": self.late(0.5),
                "p99": self.late(0.99),
                "max": f64::from(self.late_ns_max) * 1e-3,
                "missed": self.missed,
            },
        })
    }

    /// The curves of the short runs, with gaps between them: again when there is another one.
    fn ahead_blocks(&self, view: &View, columns: usize, since: Option<u64>, frame: &mut Frame) {
        let (all, made) = &self.ahead;
        if since.is_some_and(|since| since > *made) || all.is_empty() {
            return;
        }
        let (begin, end) = self.extent(self.history.cycles().end);
        let (from, to) = view.window.within(begin, end);
        for signal in view.signals.iter().filter(|signal| (**signal as usize) < self.rig.record.len()) {
            let mut out: Vec<(f64, f64)> = Vec::new();
            for one in all {
                let curve = &one.curves[*signal as usize];
                let (first, last) = (self.seconds(one.at + 1), self.seconds(one.at + curve.len() as u64));
                if curve.is_empty() || last < from || first > to + self.seconds(curve.len() as u64) {
                    continue;
                }
                let part = ((last - first) / (to - from) * columns as f64).ceil().clamp(2.0, 1e4) as usize;
                if part <= 4 * COARSE {
                    out.extend_from_slice(&one.coarse[*signal as usize]);
                } else {
                    out.extend(one.points(*signal as usize, self.seconds(1), part));
                }
                out.push((last, f64::NAN));
            }
            let first = out.first().map_or(0.0, |point| point.0);
            let curve = 2 * self.sheet.signals.len() as u32 + signal;
            frame.path(Block { kind: PATH, view: view.id, curve, cycles: 0, first }, &out);
        }
    }

    /// The curves of the dry run: once, and again for another window.
    fn twin_blocks(&self, view: &View, columns: usize, since: Option<u64>, frame: &mut Frame) {
        if since.is_some_and(|since| since > self.twin_from) {
            return;
        }
        for signal in &view.signals {
            let Some(points) = self.twin.get(*signal as usize).filter(|points| !points.is_empty()) else { continue };
            let (begin, end) = (points[0].0, points[points.len() - 1].0);
            let (from, to, columns) = match view.window {
                Window::All => (begin, end, columns),
                Window::Span(from, to) => (from, to, columns),
                // All of it, as fine as this window shows it: it comes into the window with time.
                Window::Last(seconds) => {
                    (begin, end, ((end - begin) / seconds * columns as f64).ceil().clamp(1.0, 1e4) as usize)
                }
            };
            let points = thin::window(points, from, to, columns);
            let first = points.first().map_or(0.0, |point| point.0);
            let curve = self.sheet.signals.len() as u32 + signal;
            frame.path(Block { kind: PATH, view: view.id, curve, cycles: 0, first }, &points);
        }
    }

    /// Points of a curve: see [`Subject::points`].
    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        let (all, signal) = (self.history.cycles(), curve as usize);
        if signal >= self.sheet.signals.len() {
            return;
        }
        for cycle in self.cycle_at(from).saturating_sub(1).max(all.start)..all.end {
            if !each(self.seconds(cycle), self.history.value(signal, cycle)) {
                return;
            }
        }
    }

    /// The picture of one signal over another in some cycles. All viewers that follow the newest ask for the same one.
    fn path(&self, asked: Path) -> Picture {
        let mut paths = self.paths.borrow_mut();
        if let Some((_, points)) = paths.iter().find(|(other, _)| *other == asked) {
            return points.clone();
        }
        let (x, y, from, to) = asked;
        let value = |signal: u32, cycle| self.history.value(signal as usize, cycle);
        let points: Vec<(f64, f64)> = (from..to).map(|cycle| (value(x, cycle), value(y, cycle))).collect();
        let points = Arc::new(thin::path(&points));
        if paths.len() == PATHS {
            paths.pop_front();
        }
        paths.push_back((asked, points.clone()));
        points
    }

    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame) {
        let count = self.sheet.signals.len();
        if view.signals.iter().any(|signal| *signal as usize >= count) {
            return;
        }
        let all = self.history.cycles();
        if let Some(columns) = view.columns {
            let (first, count, width) = self.fresh(view, columns, since);
            if count == 0 {
                return;
            }
            for signal in &view.signals {
                let pairs = self.history.columns(*signal as usize, first, count, width);
                let cycles = u32::try_from(width).unwrap_or(u32::MAX);
                let block = Block { kind: COLUMNS, view: view.id, curve: *signal, cycles, first: first as f64 };
                frame.columns(block, &pairs);
            }
            self.twin_blocks(view, columns as usize, since, frame);
            self.ahead_blocks(view, columns as usize, since, frame);
        } else if let [x, y] = view.signals[..] {
            let (begin, end) = self.extent(all.end);
            let (from, to) = view.window.within(begin, end);
            let (from, to) = (self.cycle_at(from).max(all.start), (self.cycle_at(to) + 1).min(all.end));
            let to = to.min(from.saturating_add(PATH_POINTS));
            let points = self.path((x, y, from, to));
            let first = points.first().map_or(0.0, |point| point.0);
            frame.path(Block { kind: PATH, view: view.id, curve: y, cycles: 0, first }, &points);
            let shown = |one: &&Settles| (one.phase.speed, one.phase.force) == (x as usize, y as usize);
            if let Some(one) = self.curves_of.iter().find(shown)
                && since.is_none_or(|since| since <= one.from)
            {
                let first = one.points.first().map_or(0.0, |point| point.0);
                let curve = STEADY * count as u32 + y;
                frame.path(Block { kind: PATH, view: view.id, curve, cycles: 0, first }, &one.points);
            }
        }
    }
}

/// A recording that is shown, and may grow meanwhile.
pub struct Played(Mutex<Recording>);

impl Played {
    /// Of a recording.
    pub fn new(recording: Recording) -> Played {
        Played(Mutex::new(recording))
    }

    /// The recording.
    pub fn recording(&self) -> MutexGuard<'_, Recording> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Subject for Played {
    fn hello(&self) -> (u64, Value) {
        (1, self.recording().hello())
    }

    fn state(&self) -> (u64, Value) {
        let recording = self.recording();
        (recording.told.0, recording.state())
    }

    fn numbers(&self) -> (u64, u64) {
        (1, self.recording().told.0)
    }

    fn version(&self) -> u64 {
        self.recording().history.cycles().end
    }

    fn newest(&self) -> f64 {
        let recording = self.recording();
        recording.seconds(recording.history.cycles().end)
    }

    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame) {
        self.recording().blocks(view, since, frame);
    }

    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        self.recording().points(curve, from, each);
    }

    fn say(&self, _: Page, _: &str) -> Result<String, String> {
        Err("a recording obeys nobody".into())
    }
}
