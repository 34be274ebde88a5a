//! The real-time cycle of a running rig: clock, buses, drives, model and safety supervisor in one loop.
//!
//! In: a rig, its control program, a clock, one bus for each bus of the rig, operator commands. Out: frames, a log,
//! gauges, and finally the reason for the end. Knows neither the language nor the terminal. The same code runs with
//! real and simulated buses, in real and simulated time.
//!
//! A cycle is time-triggered and never reacts to a frame: SYNC, answers until a fixed point of the period, computation
//! in [`Control`], commands, housekeeping. From the moment when drives may move, a cycle neither allocates nor locks
//! nor writes anything but frames; its records pass through queues that never block.

use super::control::{Control, CycleInputs, Reading, Source};
use super::counts::Counts;
use super::line::Mark;
use super::live::{Judge, Objection};
use super::operator::{self, Answer, Commands, Reason};
pub use super::operator::{Attention, Command, Operator, Watched};
use super::origin::Origin;
use super::stage::{Stage, StageGauge};
use super::trace::{self, Shape};
use super::watches::Bounds;
use super::wires::Wires;
use super::{control, emergency, watches};
use crate::can::Bus;
use crate::coupling::predictor::Wired;
use crate::drive::{self, Fieldbus, Request, Step, Trouble, TroubleKind, timing};
use crate::realtime::clock::Clock;
use crate::record::log::{self, Log, Sections};
use crate::safety::{Cause, Clamps, DriveCommand, Measured, Protection, Supervisor, is_present};
use abi::Instance;
use abi::rig::{Rig, Signal};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Number of successive cycles with lost frames after which set-points count as at risk.
const OVERLOAD: u32 = 3;
/// Number of cycles between two state messages in the log.
const STATE_EVERY: u64 = 1000;
/// Longest time that drives may take to lose their torque after the command to do so, ns.
const REST_NS: u64 = 1_000_000_000;

/// Options of a run.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Options {
    /// Settings that are not part of the rig's text.
    pub control: control::Options,
    /// Options of the start-up.
    pub start: drive::Options,
    /// Enable and arm as soon as possible, without an operator: for simulated drives.
    pub arms_itself: bool,
    /// Stop when the start-up has finished; nothing is armed.
    pub checks_only: bool,
    /// Refuse drives that have not proved to be our simulated ones (by vendor, device name and serial number); the text
    /// is the reason. Drives described by frames cannot prove it.
    pub only_simulated: Option<String>,
    /// Time from SYNC to the computation, ns; none: the value for the rig's kinds of drives.
    pub collect_ns: Option<u64>,
    /// Time for which the model runs, ns; none: until an operator stops it.
    pub duration_ns: Option<u64>,
    /// The predictor that the rig's `predict` requires: [`look_ahead`](super::coupling::look_ahead).
    pub look: Option<Wired>,
}

/// How a run ended.
#[derive(Clone, PartialEq, Debug)]
pub enum End {
    /// As requested: its time was over, or an operator stopped it.
    Asked,
    /// The start was refused; the reason.
    Refused(String),
    /// The safety supervisor or a condition of the rig stopped it; the reason.
    Stopped(Cause, String),
}

impl End {
    /// How the run ended, in words.
    pub fn words(&self) -> String {
        match self {
            End::Asked => "ended as asked".to_string(),
            End::Refused(why) => format!("refused: {why}"),
            End::Stopped(_, why) => format!("stopped: {why}"),
        }
    }
}

/// Values for displays while the rig runs: the cycle writes them, any thread may read them.
#[derive(Debug, Default)]
pub struct Gauges {
    /// Time since the start, ns.
    pub now_ns: AtomicU64,
    /// Number of cycles in which the model ran.
    pub cycles: AtomicU64,
    /// What the rig does.
    pub stage: StageGauge,
    /// Lateness of the last cycle's start, ns.
    pub late_ns: AtomicU64,
    /// Greatest lateness of a cycle's start, ns.
    pub late_ns_max: AtomicU64,
    /// Number of missed ticks.
    pub missed: AtomicU64,
    /// Free space on the disk of the log, bytes; 0 without a log.
    pub log_free: AtomicU64,
    /// Greatest energy that a contact has given back, as a share of what it can store: bits of an `f64`.
    pub returned_max: AtomicU64,
    /// Number of cycles whose command was not predicted although the rig looks ahead.
    pub unpredicted: AtomicU64,
    /// Permitted outputs, then recorded quantities: SI, as bits of an `f64`.
    pub values: Vec<AtomicU64>,
}

impl Gauges {
    /// What displays say of the energy at the contacts: the greatest share given back, and the cycles without
    /// prediction.
    pub fn energy(&self) -> (f64, u64) {
        (f64::from_bits(self.returned_max.load(Ordering::Relaxed)), self.unpredicted.load(Ordering::Relaxed))
    }
}

/// A running rig.
pub struct Hil {
    /// Declared before the buses: the stop frames must be withdrawn before their descriptors close.
    table: Option<emergency::EmergencyTable>,
    rig: Rig,
    options: Options,
    wires: Wires,
    fieldbus: Fieldbus,
    model: Instance,
    /// Present once the limits of the drives have been read.
    control: Option<Control>,
    log_wanted: Option<(log::Settings, Sections)>,
    log: Option<Log>,
    gauges: Arc<Gauges>,
    commands: Commands,
    /// Checks sets of parameters; none: every set is refused.
    judge: Option<Judge>,
    /// Stops the rig when nobody watches it; none: nobody needs to.
    attention: Option<Arc<Attention>>,
    /// Number of the operator command whose set acts in this cycle.
    set: Option<(u64, Origin)>,
    due_ns: u64,
    collect_ns: u64,
    k: u64,
    cycle: trace::Cycle,
    signals: Vec<Signal>,
    words: Vec<u64>,
    /// The commands that were handed to the log, for tests.
    #[cfg(test)]
    pub(super) commanded: Vec<Vec<u64>>,
    order: DriveCommand,
    overload: u32,
    first_trouble: Option<Trouble>,
    /// Remaining cycles of the model; none: unlimited.
    left: Option<u64>,
    /// The run time of the model is over: a controlled stop follows in the next cycle.
    over: bool,
    /// The log has the first stop and who gave it.
    stop_told: bool,
    /// Time at which the drives were told to give up their torque, ns.
    resting_ns: Option<u64>,
    counts: Counts,
    misuse: bool,
    /// The start-up has reached [`Step::AwaitEnable`].
    has_started: bool,
    /// The start-up has finished, and only its checks were requested.
    checked: bool,
    end: Option<End>,
}

impl Hil {
    /// A rig before its start. `buses`: one for each bus of the rig. Also returns the operator's end of the command
    /// queue.
    ///
    /// # Errors
    /// A message about a requirement of the rig that cannot be met.
    pub fn new(
        rig: &Rig,
        model: Instance,
        clock: Box<dyn Clock>,
        buses: Vec<Box<dyn Bus>>,
        options: Options,
        log: Option<(log::Settings, Sections)>,
    ) -> Result<(Hil, Operator), String> {
        assert_eq!(buses.len(), rig.buses.len(), "buses of rig {}", rig.name);
        watches::may_start(rig)?;
        let fieldbus = Fieldbus::new(rig, options.start)?;
        let (operator, commands) = operator::commands(rig.period_ns);
        if rig.predict.is_some() && options.look.is_none() {
            return Err(format!("rig `{}` looks ahead, and nothing does it", rig.name));
        }
        let collect_ns = options.collect_ns.unwrap_or(timing::collect_ns(rig));
        let values = (0..rig.outputs.len() + rig.record.len()).map(|_| AtomicU64::new(0)).collect();
        let due_ns = clock.now_ns() + rig.period_ns;
        let empty = Shape { signals: 0, outputs: 0, drives: 0, recorded: 0 };
        let hil = Hil {
            table: None,
            rig: rig.clone(),
            left: options.duration_ns.map(|ns| ns.div_ceil(rig.period_ns)),
            options,
            wires: Wires::new(rig, clock, buses),
            fieldbus,
            model,
            control: None,
            log_wanted: log,
            log: None,
            gauges: Arc::new(Gauges { values, ..Gauges::default() }),
            commands,
            judge: None,
            attention: None,
            set: None,
            due_ns,
            collect_ns: collect_ns.min(rig.period_ns),
            k: 0,
            cycle: trace::Cycle::new(empty),
            signals: Vec::new(),
            words: Vec::with_capacity(1 << 14),
            #[cfg(test)]
            commanded: Vec::new(),
            order: DriveCommand::Wait,
            overload: 0,
            first_trouble: None,
            over: false,
            stop_told: false,
            resting_ns: None,
            counts: Counts::default(),
            misuse: false,
            has_started: false,
            checked: false,
            end: None,
        };
        Ok((hil, operator))
    }

    /// Adds a watchdog, which stops the drives from its own thread when cycles stop.
    pub fn watched_by(&mut self, watchdog: emergency::Watchdog) {
        self.wires.watchdog = Some(watchdog);
    }

    /// Permits changes of parameters while the rig runs, as far as this judge accepts them.
    pub fn judged_by(&mut self, judge: Judge) {
        self.judge = Some(judge);
    }

    /// Stops the rig when nobody watches it any more, and arms it only once somebody does.
    pub fn attended_by(&mut self, attention: Arc<Attention>) {
        self.attention = Some(attention);
    }

    /// The gauges, for other threads.
    pub fn gauges(&self) -> Arc<Gauges> {
        self.gauges.clone()
    }

    /// Current step of the start-up.
    pub fn step(&self) -> Step {
        self.fieldbus.step()
    }

    /// The computing part, once the limits of the drives have been read.
    pub fn control(&self) -> Option<&Control> {
        self.control.as_ref()
    }

    /// The safety supervisor, to narrow its limits.
    pub fn supervisor_mut(&mut self) -> Option<&mut Supervisor> {
        self.control.as_mut().map(Control::supervisor_mut)
    }

    /// The nodes of the rig.
    pub fn fieldbus(&self) -> &Fieldbus {
        &self.fieldbus
    }

    /// The drive command of the last cycle.
    pub fn order(&self) -> DriveCommand {
        self.order
    }

    /// Measured values of each drive, without those that were rejected as implausible.
    pub fn seen(&self) -> &[Measured] {
        self.control.as_ref().map_or(&[], Control::seen)
    }

    /// Time from SYNC to the computation, ns.
    pub fn collect_ns(&self) -> u64 {
        self.collect_ns
    }

    /// Counters since the start.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// How the run ended, once it has.
    pub fn ended(&self) -> Option<&End> {
        self.end.as_ref()
    }

    /// Whether all checks of the start-up have passed, in a run of checks only.
    pub fn is_checked(&self) -> bool {
        self.checked
    }

    /// Whether the start-up has passed all checks that need no torque, and has waited for its operator.
    pub fn has_started(&self) -> bool {
        self.has_started
    }

    /// Whether the start was refused because an option is for simulated drives only.
    pub fn is_misuse(&self) -> bool {
        self.misuse
    }

    /// The last cycle, as recorded in its log.
    #[cfg(test)]
    pub(super) fn last(&self) -> &trace::Cycle {
        &self.cycle
    }

    /// The frames of the last cycle, as recorded in its log.
    #[cfg(test)]
    pub(super) fn last_frames(&self) -> &[u64] {
        &self.wires.frames
    }

    /// Registers the stop frames of all buses with [`emergency`], for those buses that permit writes from any thread;
    /// they are withdrawn when this rig is dropped.
    pub fn prepare_emergency(&mut self) {
        let buses = self.wires.buses.iter().enumerate();
        let ready = buses.flat_map(|(i, bus)| {
            let frames = self.fieldbus.stop_frames(i).iter().chain(self.fieldbus.off_frames(i));
            frames.filter_map(|frame| bus.prepare(*frame))
        });
        let ready = ready.collect();
        self.table = Some(emergency::prepare(ready));
    }

    /// Runs cycles until the run ends.
    pub fn run(&mut self) -> End {
        loop {
            self.cycle();
            if let Some(end) = &self.end {
                return end.clone();
            }
        }
    }

    /// One cycle, including the wait for its tick.
    pub fn cycle(&mut self) {
        self.wires.clock.sleep_until(self.due_ns);
        let begin_ns = self.wires.clock.now_ns();
        let late_ns = begin_ns.saturating_sub(self.due_ns);
        // The phase is kept: whole periods are skipped.
        let missed = late_ns / self.rig.period_ns;
        self.due_ns += missed * self.rig.period_ns;
        let ticks = u32::try_from(missed + 1).unwrap_or(u32::MAX);

        self.wires.frames.clear();
        if !is_present(Protection::Reused) {
            self.wires.frames = Vec::with_capacity(self.wires.frames.capacity());
        }
        if !is_present(Protection::Kept) {
            self.wires.causes.clear();
        }
        self.wires.lossy = false;
        self.operate();
        self.wires.drain(&mut self.fieldbus);
        let Hil { fieldbus, wires, .. } = self;
        fieldbus.begin(&mut |bus, frame| wires.send(bus, frame));
        // A cycle that begins late still waits for its answers, as far as its period leaves room.
        let room_ns = self.due_ns + self.rig.period_ns / 10 * 9;
        let collect_ns = (begin_ns + self.collect_ns).min(room_ns).max(self.due_ns + self.collect_ns);
        wires.clock.sleep_until(collect_ns);
        wires.drain(fieldbus);
        let read_ns = wires.clock.now_ns();

        self.gather();
        self.cycle.late_ns = u32::try_from(late_ns).unwrap_or(u32::MAX);
        let order = self.compute(ticks);
        self.wires.causes.clear();
        let computed_ns = self.wires.clock.now_ns();
        self.tell(order);
        let Hil { fieldbus, wires, .. } = self;
        fieldbus.end(computed_ns, &mut |bus, frame| wires.send(bus, frame));
        let sent_ns = self.wires.clock.now_ns();

        let short = |from: u64, to: u64| u32::try_from(to - from).unwrap_or(u32::MAX);
        self.cycle.due_ns = self.due_ns;
        self.cycle.phases_ns = [short(begin_ns, read_ns), short(read_ns, computed_ns), short(computed_ns, sent_ns)];
        self.count(ticks);
        self.leave_behind();
        self.go_on(sent_ns);
        if let Some(watchdog) = &self.wires.watchdog {
            watchdog.watch(self.fieldbus.step() > Step::AwaitEnable && self.end.is_none());
            watchdog.beat();
        }
        self.due_ns += self.rig.period_ns;
    }

    /// Handles the operator's commands since the last cycle.
    fn operate(&mut self) {
        self.cycle.arms = false;
        self.cycle.set.clear();
        let now_ns = self.wires.clock.now_ns();
        self.commands.begin(now_ns);
        // A stop takes precedence: all commands beside it are refused.
        let by_signal = emergency::requested_stop().map(|_| Origin::Signal);
        let asked = self.commands.takes_stop().or(by_signal).or(self.over.then_some(Origin::Program));
        let stops = asked.is_some();
        if let Some(origin) = asked {
            // Time that is over, and a signal, are there in every cycle until the end.
            if !std::mem::replace(&mut self.stop_told, true) {
                self.leave_word(&Command::Stop, origin);
            }
            self.stop();
        }
        let watched = self.attention.as_ref().map_or(Watched::Yes, |attention| attention.now());
        // Before the drives are enabled nothing but a command counts as a cause.
        if watched == Watched::NoLonger {
            self.wires.report(Cause::Unwatched);
        }
        while let Some(said) = self.commands.next(now_ns, false) {
            let has_effect = match said.command {
                Command::Mark(mark) => {
                    self.leave_word(&said.command, said.origin);
                    self.mark(&mark)
                }
                _ if stops => {
                    self.commands.answer(said.number, Answer::Refused(Reason::Stopping));
                    continue;
                }
                Command::Arm if watched != Watched::Yes => {
                    self.commands.answer(said.number, Answer::Refused(Reason::Unwatched));
                    continue;
                }
                Command::Enable => self.fieldbus.request(Request::Enable),
                Command::Arm => self.fieldbus.request(Request::Arm),
                Command::Stop | Command::Set(_) => unreachable!("neither comes this way"),
            };
            if has_effect && !matches!(said.command, Command::Mark(_)) {
                self.leave_word(&said.command, said.origin);
            }
            let answer =
                if has_effect { Answer::Taken(Some(self.k)) } else { Answer::Refused(Reason::NotNow(self.stage())) };
            self.commands.answer(said.number, answer);
        }
        if self.options.checks_only && self.fieldbus.step() == Step::AwaitArm {
            self.checked = true;
            self.stop();
        }
        let arms_itself = self.options.arms_itself && self.end.is_none() && self.resting_ns.is_none();
        if arms_itself && self.control.is_some() {
            let next = match self.fieldbus.step() {
                Step::AwaitEnable => Some((Request::Enable, Command::Enable)),
                Step::AwaitArm if !self.options.checks_only && watched == Watched::Yes => {
                    Some((Request::Arm, Command::Arm))
                }
                _ => None,
            };
            if let Some((request, command)) = next
                && self.fieldbus.request(request)
            {
                self.leave_word(&command, Origin::Program);
            }
        }
    }

    /// Writes into the log, if there is one yet, who gave a command that was carried out.
    fn leave_word(&mut self, command: &Command, origin: Origin) {
        if let Some(log) = &mut self.log {
            self.words.clear();
            trace::write_command(self.due_ns, command.name(), origin, &mut self.words);
            log.push(trace::COMMAND, &self.words);
            #[cfg(test)]
            self.commanded.push(self.words.clone());
        }
    }

    /// Writes words into the log; false if there is none yet.
    fn mark(&mut self, mark: &Mark) -> bool {
        let Some(log) = &mut self.log else { return false };
        self.words.clear();
        trace::write_mark(self.due_ns, mark.bytes(), &mut self.words);
        log.push(trace::MARK, &self.words);
        true
    }

    /// Takes the next set of parameters: one per cycle, so that each set is accepted or refused as a whole.
    fn take_set(&mut self) {
        self.set = None;
        let Some(said) = self.commands.next(self.wires.clock.now_ns(), true) else { return };
        let Command::Set(set) = said.command else { unreachable!("only a set was asked for") };
        let refused = match (&self.control, &mut self.judge) {
            (None, _) => Some(Reason::NotNow(self.stage())),
            (Some(_), None) => Some(Reason::Unjudged),
            (Some(control), Some(judge)) => judge.judge(control.model().block(), set.values()).err().map(Reason::Set),
        };
        match refused {
            Some(why) => {
                self.counts.refused_sets += 1;
                self.commands.answer(said.number, Answer::Refused(why));
            }
            None => {
                self.cycle.set.extend_from_slice(set.values());
                self.set = Some((said.number, said.origin));
            }
        }
    }

    fn stage(&self) -> Stage {
        Stage::of(self.fieldbus.step(), self.order)
    }

    fn stop(&mut self) {
        match &self.control {
            Some(_) => self.wires.report(Cause::Asked),
            None => self.end = Some(End::Asked),
        }
    }

    /// Collects the causes that nodes, buses and the watchdog report.
    fn gather(&mut self) {
        self.overload = if self.wires.lossy { self.overload + 1 } else { 0 };
        if self.overload >= OVERLOAD && is_present(Protection::Overload) {
            self.wires.report(Cause::Overload(0));
        }
        if self.wires.watchdog.as_ref().is_some_and(emergency::Watchdog::has_fired) && !self.wires.acknowledged {
            self.wires.acknowledged = true;
            self.wires.report(Cause::Watchdog);
        }
        while let Some(trouble) = self.fieldbus.trouble() {
            self.first_trouble = self.first_trouble.or(Some(trouble));
            let node = trouble.node.unwrap_or_default();
            let cause = match trouble.kind {
                TroubleKind::ForeignMaster(id) => Cause::Foreign(0, id),
                TroubleKind::NotFollowing | TroubleKind::Mode(_) | TroubleKind::Wraps => Cause::NotFollowing(node),
                // A frame that is too short counts as missing.
                TroubleKind::Short(_) => continue,
                TroubleKind::Emergency(_)
                | TroubleKind::Fault
                | TroubleKind::Left(_)
                | TroubleKind::HeartbeatLost
                | TroubleKind::BootUp
                | TroubleKind::Nmt(_) => Cause::Drive(node),
            };
            self.wires.report(cause);
        }
    }

    /// Computes the drive command; [`DriveCommand::Wait`] until the limits of the drives have been read.
    fn compute(&mut self, ticks: u32) -> DriveCommand {
        let step = self.fieldbus.step();
        // This takes many periods, because memory is mapped and locked. It is therefore done before a drive waits for
        // SYNC or our heartbeat: the ticks that pass meanwhile affect no drive.
        if self.control.is_none() && step >= Step::Configure && step < Step::Stopped {
            self.begin_control();
        }
        self.take_set();
        let Some(control) = &mut self.control else { return DriveCommand::Wait };
        let cycle = &mut self.cycle;
        // Before the drives are enabled a bus may be silent: the start-up checks that itself.
        if step <= Step::AwaitEnable {
            self.wires.causes.retain(|cause| *cause == Cause::Asked);
        }
        let source = match step {
            Step::SignTest | Step::AwaitArm => Source::StartUp,
            Step::Armed => Source::Model,
            Step::Stopped => cycle.source,
            _ => Source::Nobody,
        };
        if source != Source::Nobody && source != cycle.source {
            cycle.arms = control.supervisor_mut().arm();
        }
        cycle.source = source;
        cycle.ticks = ticks;
        cycle.step = step as u8;
        for (reading, signal) in cycle.readings.iter_mut().zip(&self.signals) {
            let drive::Reading { value, age, .. } = self.fieldbus.reading(*signal);
            *reading = Reading { value, age };
        }
        cycle.wanted.clear();
        if source == Source::StartUp {
            cycle.wanted.extend(self.rig.outputs.iter().map(|output| self.fieldbus.wanted(output.signal)));
        }
        cycle.causes.clear();
        cycle.causes.extend_from_slice(&self.wires.causes);
        let order = control.cycle(&CycleInputs {
            ticks,
            late_ns: trace::within_tick(cycle.late_ns, ticks, self.rig.period_ns),
            readings: &cycle.readings,
            source,
            wanted: &cycle.wanted,
            causes: &cycle.causes,
            set: &cycle.set,
        });
        if let Some((number, origin)) = self.set.take() {
            let refused = control.refused_set().map(|status| Answer::Refused(Reason::Set(Objection::Model(status))));
            self.counts.refused_sets += u64::from(refused.is_some());
            self.commands.answer(number, refused.unwrap_or(Answer::Taken(Some(self.k))));
            if let (None, Some(log)) = (refused, &mut self.log) {
                self.words.clear();
                trace::write_command(self.due_ns, "set", origin, &mut self.words);
                log.push(trace::COMMAND, &self.words);
            }
        }
        if !is_present(Protection::Recorded) {
            cycle.set.clear();
        }
        cycle.order = order;
        cycle.requests.copy_from_slice(control.requests());
        cycle.permitted.copy_from_slice(control.supervisor().permitted());
        cycle.clamps.copy_from_slice(control.supervisor().clamps());
        for (value, series) in cycle.recorded.iter_mut().zip(&self.rig.record) {
            *value = control.model().get(series.slot);
        }
        order
    }

    /// Creates the computing part from the drives' limits, and begins the log. No drive moves yet.
    fn begin_control(&mut self) {
        let bounds = (0..self.rig.nodes.len()).map(|node| {
            let limits = self.fieldbus.limits(node);
            Bounds { torque: limits.map(|limits| limits.torque), speed: limits.map(|limits| limits.speed) }
        });
        let bounds: Vec<Bounds> = bounds.collect();
        // A drive described by frames has no identity and proves nothing; a device does not move.
        let stranger = |node: &usize| match self.fieldbus.status(*node) {
            Some(status) => !status.simulated,
            None => self.rig.nodes[*node].moves,
        };
        if let Some(why) = &self.options.only_simulated
            && let Some(node) = (0..self.rig.nodes.len()).find(stranger)
            && is_present(Protection::Permission)
        {
            self.misuse = true;
            let name = &self.rig.nodes[node].name;
            return self.refuse(format!("{why}, and `{name}` has not proved to be one of ours"));
        }
        let look = self.options.look.clone();
        let control = match Control::new(&self.rig, self.model.clone(), look, &bounds, self.options.control) {
            Ok(control) => control,
            Err(why) => return self.refuse(why),
        };
        let shape = Shape::of(&self.rig, &control);
        self.signals = control.signals().collect();
        if let Some(missing) = self.signals.iter().find(|signal| !self.fieldbus.has(**signal)) {
            let name = &self.rig.nodes[missing.node].name;
            return self.refuse(format!("`{name}` does not tell a signal that is needed ({:?})", missing.what));
        }
        self.cycle = trace::Cycle::new(shape);
        self.cycle.causes.reserve(self.wires.causes.capacity());
        if let Some((settings, head)) = self.log_wanted.take() {
            let head = head.with("settings", trace::settings_to_bytes(&bounds, &self.options.control));
            let head = head.with("drives", self.identities());
            let patient = settings.patient || !is_present(Protection::Unhurried);
            match Log::begin(log::Settings { patient, ..settings }, &head) {
                Ok(log) => self.log = Some(log),
                Err(error) => return self.refuse(format!("the log cannot be written: {error}")),
            }
        }
        self.control = Some(control);
    }

    /// Identities of the drives, one per line.
    fn identities(&self) -> String {
        let line = |node: usize| {
            let status = self.fieldbus.status(node)?;
            let number = |word: Option<u32>| word.map_or("-".into(), |word| format!("0x{word:08X}"));
            let [vendor, product, revision, serial] = status.identity.map(number);
            let name = &self.rig.nodes[node].name;
            Some(format!("{name}: vendor {vendor}, product {product}, revision {revision}, serial {serial}\n"))
        };
        (0..self.rig.nodes.len()).filter_map(line).collect()
    }

    fn refuse(&mut self, why: String) {
        self.end = Some(End::Refused(why));
        self.fieldbus.request(Request::Disable);
    }

    /// Passes permitted outputs and the drive command to the nodes.
    fn tell(&mut self, order: DriveCommand) {
        let Hil { fieldbus, wires, control, rig, .. } = self;
        let Some(control) = control else { return };
        for (output, value) in rig.outputs.iter().zip(control.supervisor().permitted()) {
            fieldbus.command(output.signal, *value);
        }
        if order != self.order {
            match order {
                DriveCommand::QuickStop => {
                    for bus in 0..rig.buses.len() {
                        fieldbus.stop_frames(bus).iter().for_each(|frame| wires.send(bus, *frame));
                    }
                    fieldbus.request(Request::QuickStop);
                }
                DriveCommand::Disable => {
                    fieldbus.request(Request::Disable);
                }
                DriveCommand::Wait | DriveCommand::Follow => {}
            }
        }
        self.order = order;
    }

    #[cfg_attr(rtsan, sanitize(realtime = "nonblocking"))]
    fn count(&mut self, ticks: u32) {
        let stage = self.stage();
        self.has_started |= self.fieldbus.step() == Step::AwaitEnable;
        let counts = &mut self.counts;
        counts.all += 1;
        let armed = self.control.as_ref().is_some_and(|control| control.supervisor().is_armed());
        let runs = armed && self.cycle.source == Source::Model;
        if self.fieldbus.step() > Step::AwaitEnable && ticks > 1 {
            counts.overruns += 1;
            counts.missed += u64::from(ticks) - 1;
        }
        counts.lost_frames = self.wires.lost;
        counts.refused_frames = self.wires.refused;
        counts.bus_errors = self.wires.errors;
        if runs {
            counts.cycles += 1;
            counts.late.count(u64::from(self.cycle.late_ns));
            let [receive, compute, send] = self.cycle.phases_ns.map(u64::from);
            counts.receive.count(receive);
            counts.compute.count(compute);
            counts.send.count(send);
            let held = self.cycle.readings.iter().zip(&self.signals);
            let held = held.filter(|(reading, signal)| reading.age > 0 && self.rig.nodes[signal.node].moves);
            counts.stale += held.count() as u64;
            for clamps in &self.cycle.clamps {
                for (count, kind) in counts.clamped.iter_mut().zip([Clamps::RANGE, Clamps::SLEW, Clamps::POWER]) {
                    *count += u64::from(clamps.has(kind));
                }
            }
        }
        counts.coupling = self.control.as_ref().and_then(|control| control.coupling().told());
        let gauges = &self.gauges;
        let coupling = counts.coupling.unwrap_or_default();
        gauges.returned_max.store(coupling.returned_max.to_bits(), Ordering::Relaxed);
        gauges.unpredicted.store(coupling.unpredicted, Ordering::Relaxed);
        gauges.now_ns.store(self.due_ns, Ordering::Relaxed);
        gauges.cycles.store(counts.cycles, Ordering::Relaxed);
        gauges.late_ns.store(self.cycle.late_ns.into(), Ordering::Relaxed);
        gauges.late_ns_max.fetch_max(if runs { self.cycle.late_ns.into() } else { 0 }, Ordering::Relaxed);
        gauges.missed.store(counts.missed, Ordering::Relaxed);
        gauges.log_free.store(self.log.as_ref().map_or(0, Log::free), Ordering::Relaxed);
        gauges.stage.set(stage);
        for (gauge, value) in gauges.values.iter().zip(self.cycle.permitted.iter().chain(&self.cycle.recorded)) {
            gauge.store(value.to_bits(), Ordering::Relaxed);
        }
    }

    /// Records the cycle in the log.
    fn leave_behind(&mut self) {
        let Some(control) = &self.control else { return };
        let moving = (0..self.rig.nodes.len()).filter(|node| self.rig.nodes[*node].moves);
        for (word, node) in self.cycle.statuses.iter_mut().zip(moving) {
            *word = self.fieldbus.status(node).map_or(0, |status| status.word);
        }
        self.cycle.k = self.k;
        self.k += 1;
        let Some(log) = &mut self.log else { return };
        self.words.clear();
        self.cycle.write(&mut self.words);
        log.push(log::CYCLE, &self.words);
        log.push(trace::FRAMES, &self.wires.frames);
        if self.k.is_multiple_of(STATE_EVERY) {
            self.words.clear();
            trace::write_state(self.k, control, &mut self.words);
            log.push(trace::STATE, &self.words);
        }
        self.counts.log_dropped = if is_present(Protection::Counted) { log.dropped() } else { 0 };
    }

    /// Ends the run when its start was refused or its stop is complete; notes when the time of the model is over.
    fn go_on(&mut self, now_ns: u64) {
        if let Some(left) = &mut self.left
            && self.cycle.source == Source::Model
            && self.order == DriveCommand::Follow
        {
            *left = left.saturating_sub(u64::from(self.cycle.ticks));
            self.over = *left == 0;
        }
        if self.end.is_some() {
            return;
        }
        if let Some(refusal) = self.fieldbus.refusal() {
            let since = *self.resting_ns.get_or_insert(now_ns);
            if self.fieldbus.at_rest() || now_ns - since > REST_NS {
                self.end = Some(End::Refused(self.fieldbus.explain(refusal)));
            }
            return;
        }
        let Some(control) = &self.control else { return };
        if control.supervisor().is_disabled() {
            let since = *self.resting_ns.get_or_insert(now_ns);
            if self.fieldbus.at_rest() || now_ns - since > REST_NS {
                self.end = Some(match control.supervisor().cause() {
                    None | Some(Cause::Asked) => End::Asked,
                    Some(cause) => End::Stopped(cause, self.explain(cause)),
                });
            }
        }
    }

    /// The reason of a stop as text.
    pub fn explain(&self, cause: Cause) -> String {
        let trouble = self.first_trouble.map(|trouble| self.fieldbus.tell(&trouble));
        super::words::cause(&self.rig, self.model.description(), &self.signals, cause, trouble.as_deref())
    }

    /// Closes the log; its last section holds the counters.
    ///
    /// # Errors
    /// An error of writing the log.
    pub fn finish(mut self) -> io::Result<Option<log::Summary>> {
        let Some(log) = self.log.take() else { return Ok(None) };
        let end = self.end.clone().unwrap_or(End::Asked);
        let (end, stopped) = match end {
            End::Asked => ("as asked".to_string(), false),
            End::Refused(why) => (format!("refused: {why}"), true),
            End::Stopped(_, why) => (format!("stopped: {why}"), true),
        };
        let tail = Sections::default().with("end", end).with("counts", super::words::counts(&self.counts));
        log.end(&tail, stopped).map(Some)
    }
}
