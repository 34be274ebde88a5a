//! The computing part of a cycle: readings → model → safety → permitted outputs.
//!
//! In: readings with their ages, causes reported by other parts, changed parameters. Out: permitted outputs and the
//! drive command. Knows neither clock nor bus nor file, so a replay of the same inputs reproduces every bit. It
//! allocates only in [`Control::new`].

use super::coupling::{Coupling, CouplingVerdict};
use super::followed::Followed;
use super::watches::{self, Bounds, bounds_of};
use crate::coupling::predictor::Wired;
use crate::drive::profiles;
use crate::safety::{Cause, DriveCommand, Measured, Protection, Supervisor, Timeouts, is_present};
use abi::rig::{Kind, Overrun, Rig, Signal, SignalKind};
use abi::{Instance, Slot};

/// A value with its age.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Reading {
    /// In SI units.
    pub value: f64,
    /// Ticks since it arrived: 0 in this tick, [`Reading::NEVER`] if none has arrived.
    pub age: u32,
}

impl Reading {
    /// Age of a value that has never arrived.
    pub const NEVER: u32 = u32::MAX;
}

/// Source of the requests for the outputs.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Source {
    /// No source: the rig is not armed.
    Nobody,
    /// The start-up, for its checks.
    StartUp,
    /// The model.
    Model,
}

/// Inputs of one cycle.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct CycleInputs<'a> {
    /// Ticks since the last cycle: 1, more after missed ticks.
    pub ticks: u32,
    /// Delay of the cycle's start after its tick, ns: less than a period.
    pub late_ns: u32,
    /// One reading for each of [`Control::signals`].
    pub readings: &'a [Reading],
    /// Source of the requests.
    pub source: Source,
    /// Requests of the start-up, one value per output.
    pub wanted: &'a [f64],
    /// Causes reported by other parts.
    pub causes: &'a [Cause],
    /// Parameters that change in this cycle, as one set.
    pub set: &'a [(Slot, f64)],
}

/// State of one signal that is read.
struct Watched {
    signal: Signal,
    /// Age in ticks at which the signal counts as lost; none: it may be missing.
    timeout: Option<u32>,
    /// Greatest plausible change in one tick, SI; infinite: not checked.
    jump: f64,
    last: f64,
    /// Ticks since `last` arrived; none: no value was accepted yet.
    since: Option<u32>,
    /// Ticks since the newest reading arrived, accepted or not; none: no reading arrived yet.
    looked: Option<u32>,
    /// Number of successive implausible readings.
    odd: u32,
    /// Whether the node answers SYNC: an answer after the computation of its tick does not belong to the same instant
    /// as the others. A device sends at its own pace.
    answers: bool,
    /// Number of successive cycles without an answer in time.
    late: u32,
}

/// Number of successive implausible readings that stops the rig; until then the last accepted value is held.
const ODD: u32 = 3;
/// The same as a time, for runs that only count overruns, ns: a simulated drive that waited for a processor answers
/// many SYNCs at once, and its readings are then not one motion at the pace of the rig.
const ODD_NS: u64 = 1_000_000_000;
/// Ticks after which a drive's signal counts as lost if the rig names no time-out.
const TIMEOUT: u32 = 3;
/// Lowest time-out in runs that only count overruns, ns.
pub const PATIENT_NS: u64 = 60_000_000_000;
/// Lowest assumption for the lag of a drive's speed behind its position, s.
const SPEED_LATE: f64 = 2e-3;
/// Longest span, in ticks, over which the change of a position is compared with the speed at its end.
const GAP: u32 = 6;
/// Factor by which the torque on a shaft may exceed the torque of its drives.
const SURPLUS: f64 = 4.0;

/// Position and speed of one drive, which must agree with each other.
struct Paired {
    speed: usize,
    position: usize,
    /// Greatest plausible difference between position and speed in one tick, rad; infinite: not checked.
    most: f64,
    /// Position when both last arrived, and the ticks since then.
    before: Option<(f64, u32)>,
    run: Disagreement,
}

/// Successive cycles in which position and speed disagree implausibly, in one direction.
///
/// The exact time at which a drive reads the shaft is unknown, because SYNC waits for frames that occupy the bus. But
/// an accepted value was read in its own period. The time between two readings, however many periods apart, is
/// therefore off by less than one period, and the errors of several cycles cancel except for that one period.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Disagreement {
    cycles: u32,
    ticks: u32,
    /// Excess of the position's change over the integral of the speed, rad.
    angle: f64,
    /// Greatest speed, rad/s.
    fastest: f64,
}

impl Disagreement {
    /// Adds a cycle. `ticks`: its length; `angle`: excess of the position's change over the integral of the speed, rad;
    /// `most`: plausible difference per tick, rad.
    fn add(&mut self, ticks: u32, angle: f64, speed: f64, most: f64) {
        if angle.abs() <= most * f64::from(ticks) {
            return *self = Disagreement::default();
        }
        if self.cycles > 0 && angle.is_sign_negative() != self.angle.is_sign_negative() {
            *self = Disagreement::default();
        }
        self.cycles = self.cycles.saturating_add(1);
        self.ticks = self.ticks.saturating_add(ticks);
        self.angle += angle;
        self.fastest = self.fastest.max(speed.abs());
    }

    /// Whether the disagreement exceeds the plausible difference plus the timing error of one period.
    fn is_certain(&self, most: f64, period: f64) -> bool {
        self.angle.abs() > most * f64::from(self.ticks) + self.fastest * period
    }
}

/// Settings that are not part of a rig's text.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Options {
    /// Duration of the ramp in which outputs rise from their safe values, ns.
    pub ramp_ns: u64,
    /// Longest unbroken time for which an output may be outside its limits, ns.
    pub clamped_ns: u64,
    /// Longest time from a controlled stop to the quick stop, and from there to disabled, ns.
    pub standstill_ns: u64,
    /// Time over which the output step of a parameter change is blended, ns.
    pub blend_ns: u64,
    /// Missed ticks are counted and never stop the rig: for simulated drives.
    pub count_overruns: bool,
    /// The loop is unstable without the predictor: the rig stops when the predictor is not valid.
    pub needs_look: bool,
    /// A contact that returns more energy than it can store stops the rig; otherwise such cycles are only counted.
    pub energy_stops: bool,
    /// The run identifies dead time and lag of the drives, so the values of the rig's text are ignored.
    pub measures: bool,
}

impl Default for Options {
    fn default() -> Options {
        let (ramp_ns, clamped_ns, standstill_ns, blend_ns) = (100_000_000, 5_000_000_000, 1_000_000_000, 100_000_000);
        let (count_overruns, needs_look, energy_stops, measures) = (false, false, false, false);
        Options { ramp_ns, clamped_ns, standstill_ns, blend_ns, count_overruns, needs_look, energy_stops, measures }
    }
}

/// The computing part of a cycle.
pub struct Control {
    model: Instance,
    /// A block like the model's, for trial steps.
    shadow: Instance,
    step: f64,
    steps: u64,
    overrun: Overrun,
    /// Missed ticks that are not compensated yet: each cycle in time compensates one.
    behind: u32,
    supervisor: Supervisor,
    coupling: Coupling,
    watched: Vec<Watched>,
    /// Number of successive implausible readings that stops the rig.
    odd: u32,
    /// For each input: the index of its signal, and its slot.
    inputs: Vec<(usize, Slot)>,
    /// For each output: the slot of the request.
    outputs: Vec<Slot>,
    stops: Vec<Slot>,
    /// For each drive: the indices of its speed and position among the signals.
    seen_at: Vec<(Option<usize>, Option<usize>)>,
    seen: Vec<Measured>,
    paired: Vec<Paired>,
    followed: Vec<Followed>,
    /// The drive command of the last cycle was to follow.
    follows: bool,
    requests: Vec<f64>,
    /// Difference between old and new requests after a change of parameters; the remaining and all ticks of the blend.
    offsets: Vec<f64>,
    blend: (u32, u32),
    regimes: Vec<f64>,
    running: bool,
    /// Status with which the model refused the set of the last cycle; 0 if its values were not finite.
    refused_set: Option<u64>,
}

impl Control {
    /// The computing part of a rig. `look`: the predictor that `predict` of the rig requires; `bounds`: one entry per
    /// node, read from the drives, for limits that the rig does not name.
    ///
    /// # Errors
    /// A message with the reason why the rig must not start.
    ///
    /// # Panics
    /// If the rig requires a predictor and none is given, or the other way round.
    pub fn new(
        rig: &Rig,
        model: Instance,
        look: Option<Wired>,
        bounds: &[Bounds],
        options: Options,
    ) -> Result<Control, String> {
        assert_eq!(rig.predict, look.as_ref().map(|wired| wired.node), "the look ahead of rig {}", rig.name);
        watches::may_start(rig)?;
        let period = rig.period_ns as f64 * 1e-9;
        let ticks = |ns: u64| u32::try_from(ns.div_ceil(rig.period_ns)).unwrap_or(u32::MAX);
        let moving: Vec<usize> = (0..rig.nodes.len()).filter(|i| rig.nodes[*i].moves).collect();
        let mut drives = Vec::new();
        for i in &moving {
            drives.push(watches::drive_limits(rig, *i, bounds)?);
        }
        let mut outputs = Vec::new();
        for output in &rig.outputs {
            outputs.push(watches::output_limits(rig, output, &moving, bounds)?);
        }
        let patience = Timeouts {
            ramp: ticks(options.ramp_ns),
            clamped: ticks(options.clamped_ns),
            standstill: ticks(options.standstill_ns),
        };
        let supervisor = Supervisor::new(&outputs, &drives, patience, rig.period_ns)
            .map_err(|refused| watches::refusal(rig, &moving, refused))?;

        // A drive that controls speed or position may apply any torque for it, up to its maximum.
        let strongest = |node: &usize| match outputs.iter().find(|o| o.torque && moving[o.drive.unwrap_or(0)] == *node)
        {
            Some(output) => output.low.abs().max(output.high.abs()),
            None => bounds_of(rig, *node, bounds).torque.unwrap_or(f64::INFINITY),
        };
        let torque: f64 = moving.iter().map(strongest).sum();
        let own_acceleration = rig.plant.inertia.map_or(f64::INFINITY, |inertia| torque / inertia);
        let acceleration = SURPLUS * own_acceleration;
        let patient = ticks(PATIENT_NS);
        let mut watched: Vec<Watched> = Vec::new();
        let mut watch = |signal: Signal, start: f64, needed: bool| {
            let at = watched.iter().position(|other| other.signal == signal);
            let node = &rig.nodes[signal.node];
            let timeout = match node.timeout_ns {
                0 => node.moves.then_some(TIMEOUT),
                ns => Some(u32::try_from(ns / rig.period_ns).unwrap_or(u32::MAX).max(1)),
            };
            // Delays between this process and itself say nothing about the drives.
            let timeout = timeout.map(|own| if options.count_overruns { own.max(patient) } else { own });
            let timeout = timeout.filter(|_| needed);
            if let Some(at) = at {
                watched[at].timeout = watched[at].timeout.or(timeout);
                return at;
            }
            let jump = match (&node.kind, signal.what) {
                (Kind::Cia402(drive), SignalKind::Speed) => acceleration * period + 4.0 * drive.speed_unit,
                (Kind::Cia402(drive), SignalKind::Position) => {
                    let speed = moving.iter().position(|i| *i == signal.node).map(|i| drives[i].speed);
                    2.0 * speed.unwrap_or(f64::INFINITY) * period + 4.0 * drive.count
                }
                _ => f64::INFINITY,
            };
            let answers = matches!(node.kind, Kind::Cia402(_));
            watched.push(Watched {
                signal,
                timeout,
                jump,
                last: start,
                since: None,
                looked: None,
                odd: 0,
                answers,
                late: 0,
            });
            watched.len() - 1
        };
        let inputs = rig.inputs.iter().map(|input| (watch(input.signal, input.start, input.needed), input.slot));
        let inputs = inputs.collect();
        let seen_at = moving.iter().map(|node| {
            // A drive described by frames may send less often than the rig reads: without `timeout` it never counts as
            // lost.
            let needed = matches!(rig.nodes[*node].kind, Kind::Cia402(_)) || rig.nodes[*node].timeout_ns > 0;
            let mut measured =
                |what| watches::measured_signal(rig, *node, what).map(|signal| watch(signal, 0.0, needed));
            measured(SignalKind::Torque);
            (measured(SignalKind::Speed), measured(SignalKind::Position))
        });
        let seen_at: Vec<_> = seen_at.collect();
        let regimes = model.description().layout.regimes;
        let paired = moving.iter().zip(&seen_at).filter_map(|(node, at)| {
            let ((Some(speed), Some(position)), Kind::Cia402(drive)) = (*at, &rig.nodes[*node].kind) else {
                return None;
            };
            // A drive that refreshes its values on a time grid of its own does not agree from tick to tick.
            let profile = profiles::find(&drive.profile);
            let refreshed = profile.is_some_and(|profile| profile.refresh_ns > 0);
            let late = profile.map_or(0.0, |profile| 2.0 * profile.speed_lag).max(SPEED_LATE);
            let most = own_acceleration * (period + late) + 4.0 * (drive.speed_unit + drive.count / period);
            Some(Paired { speed, position, most: most * period, before: None, run: Disagreement::default() })
                .filter(|_| !refreshed)
        });
        let paired = paired.collect();
        let odd = if options.count_overruns { ODD.max(ticks(ODD_NS)) } else { ODD };
        let followed = outputs.iter().enumerate().filter_map(|(output, limits)| {
            let answer = watches::answer(rig, &rig.outputs[output])?;
            let signal = watched.iter().position(|watched| watched.signal == answer)?;
            Followed::new(rig, output, signal, limits, options.measures).map(|followed| followed.patient(odd))
        });
        let followed = followed.collect();
        let signals: Vec<Signal> = watched.iter().map(|watched| watched.signal).collect();
        let mut coupling = Coupling::new(rig, look, &signals, &model);
        coupling.stops_for(options.needs_look, options.energy_stops);
        Ok(Control {
            shadow: model.clone(),
            step: period / f64::from(rig.steps.max(1)),
            steps: u64::from(rig.steps.max(1)),
            behind: 0,
            overrun: if options.count_overruns { Overrun::Hold(u32::MAX) } else { rig.overrun },
            supervisor,
            coupling,
            watched,
            odd,
            inputs,
            outputs: rig.outputs.iter().map(|output| output.slot).collect(),
            stops: rig.stops.iter().map(|stop| stop.slot).collect(),
            seen: vec![Measured::default(); seen_at.len()],
            seen_at,
            paired,
            followed,
            follows: false,
            requests: rig.outputs.iter().map(|output| output.safe).collect(),
            offsets: vec![0.0; rig.outputs.len()],
            blend: (0, ticks(options.blend_ns).max(1)),
            regimes: vec![0.0; regimes.len as usize],
            running: false,
            refused_set: None,
            model,
        })
    }

    /// The signals that are read, in the order of the readings.
    pub fn signals(&self) -> impl ExactSizeIterator<Item = Signal> {
        self.watched.iter().map(|watched| watched.signal)
    }

    /// Requests, one value per output.
    pub fn requests(&self) -> &[f64] {
        &self.requests
    }

    /// Measured values of each drive, without those that were rejected as implausible.
    pub fn seen(&self) -> &[Measured] {
        &self.seen
    }

    /// The safety supervisor.
    pub fn supervisor(&self) -> &Supervisor {
        &self.supervisor
    }

    /// The safety supervisor, to arm it or narrow its limits between cycles.
    pub fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.supervisor
    }

    /// Predictor and passivity observers between readings and model.
    pub fn coupling(&self) -> &Coupling {
        &self.coupling
    }

    /// The model in its current state.
    pub fn model(&self) -> &Instance {
        &self.model
    }

    /// Status with which the model refused the set of the last cycle, if it did; 0 if its values were not finite.
    pub fn refused_set(&self) -> Option<u64> {
        self.refused_set
    }

    /// One cycle. Any source but [`Source::Nobody`] requires an armed supervisor.
    #[cfg_attr(rtsan, sanitize(realtime = "nonblocking"))]
    pub fn cycle(&mut self, told: &CycleInputs) -> DriveCommand {
        assert_eq!(told.readings.len(), self.watched.len(), "readings");
        let armed = told.source != Source::Nobody;
        self.refused_set = None;
        told.causes.iter().for_each(|cause| self.supervisor.trip(*cause));
        self.read(told.readings, told.ticks, told.source);
        self.compare(told);
        self.compare_commands(told);
        let missed = told.ticks.saturating_sub(1);
        let most = match self.overrun {
            Overrun::Stop => 0,
            Overrun::Hold(most) => most,
        };
        self.behind = match missed {
            _ if !armed => 0,
            0 => self.behind.saturating_sub(1),
            _ => self.behind.saturating_add(missed),
        };
        let behind = if is_present(Protection::Behind) { self.behind } else { missed };
        if armed && behind > most {
            self.supervisor.trip(Cause::Overrun(behind));
        }
        let computes = told.source == Source::Model && self.supervisor.is_armed();
        if !(computes && self.running) {
            // The model is not running, so no output can jump.
            told.set.iter().for_each(|(slot, value)| self.model.set(*slot, *value));
        }
        match told.source {
            Source::Model if computes => self.advance(told),
            Source::StartUp => self.requests.copy_from_slice(told.wanted),
            Source::Model | Source::Nobody => {}
        }
        self.running = told.source == Source::Model;
        for (seen, (speed, position)) in self.seen.iter_mut().zip(&self.seen_at) {
            let last = |at: &Option<usize>| {
                let watched = &self.watched[(*at)?];
                watched.since.map(|_| watched.last)
            };
            *seen = Measured { speed: last(speed), position: last(position) };
        }
        let order = self.supervisor.judge(&self.requests, &self.seen);
        if computes {
            self.coupling.sent(self.supervisor.permitted());
        }
        self.follows = armed && order == DriveCommand::Follow;
        order
    }

    /// Accepts plausible readings; trips on signals that have been missing or implausible for too long.
    fn read(&mut self, readings: &[Reading], ticks: u32, source: Source) {
        // The start-up may redefine the origin of positions: plausibility is required only of readings for the model.
        let judged = source == Source::Model && self.running;
        for (i, (watched, reading)) in self.watched.iter_mut().zip(readings).enumerate() {
            watched.since = watched.since.map(|since| since.saturating_add(ticks));
            watched.looked = watched.looked.map(|looked| looked.saturating_add(ticks));
            watched.late = if reading.age == 0 { 0 } else { watched.late.saturating_add(1) };
            let newer = watched.looked.is_none_or(|looked| reading.age < looked) && reading.age != Reading::NEVER;
            if reading.age == 0 || !watched.answers && newer {
                watched.looked = Some(reading.age);
                let change = (reading.value - watched.last).abs();
                let credible = match watched.since {
                    Some(since) if judged => change <= watched.jump * f64::from(since),
                    _ => true,
                };
                let number = reading.value.is_finite() || !is_present(Protection::Infinite);
                if (credible || !is_present(Protection::Jump)) && number {
                    (watched.last, watched.since, watched.odd) = (reading.value, Some(reading.age), 0);
                } else {
                    watched.odd += 1;
                }
            }
            if source == Source::Nobody {
                (watched.odd, watched.late) = (0, 0);
                continue;
            }
            // An answer that is late in every tick is never accepted, and a device may send NaN: both count as missing.
            let missing = match watched.answers {
                true if is_present(Protection::Late) => watched.late,
                true => 0,
                false => watched.since.unwrap_or(0),
            };
            let patience = |timeout| if is_present(Protection::Patient) { timeout } else { 1 };
            if watched.timeout.is_some_and(|timeout| reading.age.max(missing) >= patience(timeout)) {
                self.supervisor.trip(Cause::Lost(i));
            }
            if watched.odd >= self.odd && is_present(Protection::Odd) {
                self.supervisor.trip(Cause::Implausible(i));
            }
        }
    }

    /// Trips where position and speed of a drive have disagreed for too long: an encoder that stands still or loses
    /// counts.
    fn compare(&mut self, told: &CycleInputs) {
        for pair in &mut self.paired {
            let [speed, position] = [pair.speed, pair.position].map(|at| &self.watched[at]);
            if told.source != Source::Model {
                (pair.before, pair.run) = (None, Disagreement::default());
                continue;
            }
            let since = |(from, ticks): (f64, u32)| (from, ticks.saturating_add(told.ticks));
            let before = pair.before.map(since).filter(|(_, ticks)| *ticks <= GAP);
            if (speed.since, position.since) != (Some(0), Some(0)) {
                pair.before = before;
                continue;
            }
            pair.before = Some((position.last, 0));
            let Some((from, ticks)) = before else {
                pair.run = Disagreement::default();
                continue;
            };
            let period = self.step * self.steps as f64;
            let turned = position.last - from - speed.last * period * f64::from(ticks);
            pair.run.add(ticks, turned, speed.last, pair.most);
            if pair.run.cycles >= self.odd && pair.run.is_certain(pair.most, period) && is_present(Protection::Agree) {
                self.supervisor.trip(Cause::Implausible(pair.position));
            }
        }
    }

    /// Trips where a drive has not followed its commands for too long. The permitted outputs are still those of the
    /// last cycle.
    fn compare_commands(&mut self, told: &CycleInputs) {
        for followed in &mut self.followed {
            let answer = &self.watched[followed.signal];
            let sent = self.supervisor.permitted()[followed.output];
            let judged = followed.is_early() || self.running;
            if !self.follows || !judged {
                followed.rest(if followed.is_early() { sent } else { answer.last }, sent);
                continue;
            }
            let fresh = (answer.since == Some(0)).then_some(answer.last);
            if followed.judge(told.ticks, sent, fresh) {
                self.supervisor.trip(Cause::NotFollowing(followed.node));
            }
        }
    }

    /// Advances the model to the end of this tick.
    fn advance(&mut self, told: &CycleInputs) {
        for (at, slot) in &self.inputs {
            self.model.set(*slot, self.watched[*at].last);
        }
        if !self.running {
            self.coupling.restart(self.supervisor.permitted());
        }
        let watched = &self.watched;
        let read = |at: usize| (watched[at].last, watched[at].since == Some(0));
        let (ahead, verdict) = self.coupling.read(told.ticks, told.late_ns, read);
        match verdict {
            CouplingVerdict::Fine => {}
            CouplingVerdict::Drives => self.supervisor.trip(Cause::Energy),
            CouplingVerdict::Unpredictable => self.supervisor.trip(Cause::Unpredictable),
        }
        if let (Some(ahead), Some(node)) = (ahead, self.coupling.looks_ahead()) {
            for (at, slot) in &self.inputs {
                match self.watched[*at].signal {
                    Signal { node: from, what: SignalKind::Speed } if from == node => {
                        self.model.set(*slot, ahead.speed)
                    }
                    Signal { node: from, what: SignalKind::Position } if from == node => {
                        self.model.set(*slot, ahead.position)
                    }
                    _ => {}
                }
            }
        }
        let begin = if self.running { 0 } else { self.model.start_in(self.step, &mut self.regimes) };
        let steps = self.steps * u64::from(told.ticks.max(1));
        let mut status = begin;
        if begin == 0 {
            let changes = self.running && !told.set.is_empty();
            status = if changes { self.change(told.set, steps) } else { self.model.advance(steps) };
        }
        if status != 0 {
            self.supervisor.trip(Cause::Guard(status));
        }
        let left = f64::from(self.blend.0) / f64::from(self.blend.1);
        for ((request, slot), offset) in self.requests.iter_mut().zip(&self.outputs).zip(&self.offsets) {
            *request = self.model.get(*slot);
            if self.blend.0 > 0 {
                *request += offset * left;
            }
        }
        self.blend.0 = self.blend.0.saturating_sub(told.ticks);
        if let Some(i) = self.stops.iter().position(|slot| self.model.get(*slot) != 0.0) {
            self.supervisor.trip(Cause::Condition(i));
        }
    }

    /// Changes a set of parameters without a step in the outputs: the difference is blended out. A set with which the
    /// model cannot continue is refused, and the model continues without it.
    fn change(&mut self, set: &[(Slot, f64)], steps: u64) -> u64 {
        self.shadow.block_mut().copy_from_slice(self.model.block());
        let old = self.shadow.advance(steps);
        for (slot, value) in set {
            self.model.set(*slot, *value);
        }
        let new = self.model.advance(steps);
        let finite = self.model.block()[self.model.description().layout.states.range()].iter().all(|x| x.is_finite())
            && self.outputs.iter().all(|slot| self.model.get(*slot).is_finite());
        if old == 0 && (new != 0 || !finite) {
            self.refused_set = Some(new);
            self.model.block_mut().copy_from_slice(self.shadow.block());
            return old;
        }
        let left = f64::from(self.blend.0) / f64::from(self.blend.1);
        for (offset, slot) in self.offsets.iter_mut().zip(&self.outputs) {
            *offset = *offset * left + self.shadow.get(*slot) - self.model.get(*slot);
        }
        self.blend.0 = self.blend.1;
        new
    }

    /// Appends the complete state as words, from which [`Control::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.extend(self.model.block().iter().map(|x| x.to_bits()));
        words.extend(self.requests.iter().chain(&self.offsets).map(|x| x.to_bits()));
        words.extend([u64::from(self.blend.0), u64::from(self.running)]);
        for watched in &self.watched {
            let [since, looked] = [watched.since, watched.looked].map(|age| age.map_or(u64::MAX, u64::from));
            words.extend([watched.last.to_bits(), since, looked, watched.odd.into(), watched.late.into()]);
        }
        for pair in &self.paired {
            let ((from, ticks), run) = (pair.before.unwrap_or_default(), pair.run);
            words.extend([u64::from(pair.before.is_some()), from.to_bits(), ticks.into()]);
            words.extend([run.cycles.into(), run.ticks.into(), run.angle.to_bits(), run.fastest.to_bits()]);
        }
        self.followed.iter().for_each(|followed| followed.save(words));
        words.extend([u64::from(self.follows), self.behind.into()]);
        self.supervisor.save(words);
        self.coupling.save(words);
    }

    /// Restores the state that [`Control::save`] wrote. None if it does not fit this rig.
    pub fn restore(&mut self, words: &[u64]) -> Option<()> {
        let mut words = words.iter().copied();
        for x in self.model.block_mut().iter_mut().chain(&mut self.requests).chain(&mut self.offsets) {
            *x = f64::from_bits(words.next()?);
        }
        self.blend.0 = u32::try_from(words.next()?).ok()?;
        self.running = words.next()? != 0;
        for watched in &mut self.watched {
            watched.last = f64::from_bits(words.next()?);
            for age in [&mut watched.since, &mut watched.looked] {
                let word = words.next()?;
                *age = if word == u64::MAX { None } else { Some(u32::try_from(word).ok()?) };
            }
            watched.odd = u32::try_from(words.next()?).ok()?;
            watched.late = u32::try_from(words.next()?).ok()?;
        }
        for pair in &mut self.paired {
            let known = words.next()? != 0;
            let before = (f64::from_bits(words.next()?), u32::try_from(words.next()?).ok()?);
            pair.before = known.then_some(before);
            pair.run.cycles = u32::try_from(words.next()?).ok()?;
            pair.run.ticks = u32::try_from(words.next()?).ok()?;
            pair.run.angle = f64::from_bits(words.next()?);
            pair.run.fastest = f64::from_bits(words.next()?);
        }
        self.followed.iter_mut().try_for_each(|followed| followed.restore(&mut words))?;
        self.follows = words.next()? != 0;
        self.behind = u32::try_from(words.next()?).ok()?;
        self.supervisor.restore(&mut words)?;
        self.coupling.restore(&mut words)?;
        words.next().is_none().then_some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rigs;
    use abi::rig::{Field, Format, Input, Message, Node};

    const FRESH: u32 = 0;

    /// A running rig with one drive: readings of its position, speed and torque.
    struct TestRig {
        control: Control,
        readings: Vec<Reading>,
    }

    impl TestRig {
        fn new(change: impl FnOnce(&mut Rig)) -> TestRig {
            TestRig::of(change, Options::default())
        }

        fn of(change: impl FnOnce(&mut Rig), options: Options) -> TestRig {
            let (mut rig, model) = rigs::rig();
            change(&mut rig);
            let options = Options { ramp_ns: 0, blend_ns: 10_000_000, ..options };
            let mut control = Control::new(&rig, model, None, &[], options).unwrap();
            assert!(control.supervisor_mut().arm());
            let readings = control.signals().map(|_| Reading { value: 0.0, age: FRESH }).collect();
            TestRig { control, readings }
        }

        fn set(&mut self, what: SignalKind, value: f64) {
            let at = self.control.signals().position(|signal| signal.what == what).unwrap();
            self.readings[at].value = value;
        }

        /// One cycle; the position follows the speed while the speed is plausible. Returns the permitted output.
        fn cycle(&mut self, ticks: u32, set: &[(Slot, f64)]) -> f64 {
            let at = |what| self.control.signals().position(|signal| signal.what == what).unwrap();
            let (speed, position) = (self.readings[at(SignalKind::Speed)], at(SignalKind::Position));
            if speed.value.abs() < 100.0 {
                self.readings[position].value += speed.value * 1e-3 * f64::from(ticks);
            }
            // The drive applies its commanded torque.
            let torque = at(SignalKind::Torque);
            self.readings[torque].value = self.control.supervisor().permitted()[0];
            let (source, wanted, causes) = (Source::Model, &[][..], &[][..]);
            let told = CycleInputs { ticks, late_ns: 0, readings: &self.readings, source, wanted, causes, set };
            self.control.cycle(&told);
            self.control.supervisor().permitted()[0]
        }
    }

    #[test]
    fn the_model_steps_over_the_coming_period_with_the_newest_readings() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 2.0);
        // A spring of 10 N·m/rad on the angle, which is the integral of 2 rad/s after k periods.
        for k in 1..=5 {
            let torque = way.cycle(1, &[]);
            assert!((torque + 10.0 * 2.0 * 1e-3 * f64::from(k)).abs() < 1e-12, "cycle {k}: {torque}");
        }
    }

    #[test]
    fn missed_ticks_are_compensated_and_too_many_stop_the_rig() {
        let mut way = TestRig::new(|rig| rig.overrun = Overrun::Hold(2));
        way.set(SignalKind::Speed, 2.0);
        way.cycle(1, &[]);
        let torque = way.cycle(3, &[]);
        assert!((torque + 10.0 * 2.0 * 4e-3).abs() < 1e-12, "{torque}");
        way.cycle(4, &[]);
        assert_eq!(way.control.supervisor().cause(), Some(Cause::Overrun(5)));
        let mut strict = TestRig::new(|_| ());
        strict.cycle(2, &[]);
        assert_eq!(strict.control.supervisor().cause(), Some(Cause::Overrun(1)));
    }

    #[test]
    fn repeated_missed_ticks_stop_the_rig_unless_cycles_in_time_compensate() {
        for most in 1..6 {
            let cause = |ticks: &mut dyn FnMut(u32) -> u32| {
                let mut way = TestRig::new(|rig| rig.overrun = Overrun::Hold(most));
                (0..200).find(|k| {
                    way.cycle(ticks(*k), &[]);
                    way.control.supervisor().cause().is_some()
                })
            };
            assert_eq!(cause(&mut |_| 2), Some(most), "one missed in each cycle, {most} borne");
            assert_eq!(cause(&mut |k| 1 + k % 2), None, "one missed in each other cycle");
            assert_eq!(cause(&mut |k| if k % (most + 1) == 0 { 1 + most } else { 1 }), None, "made good for");
            assert_eq!(cause(&mut |k| if k % most == 0 { 2 + most } else { 1 }), Some(0));
        }
    }

    #[test]
    fn an_infinite_reading_is_rejected() {
        for bad in [f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
            let mut way = TestRig::new(|_| ());
            way.set(SignalKind::Speed, 1.0);
            way.cycle(1, &[]);
            let at = way.control.signals().position(|signal| signal.what == SignalKind::Torque).unwrap();
            for cycle in 1..=3 {
                assert_eq!(way.control.supervisor().cause(), None, "cycle {cycle}");
                way.readings[at].value = bad;
                let (source, wanted, causes) = (Source::Model, &[][..], &[][..]);
                let told =
                    CycleInputs { ticks: 1, late_ns: 0, readings: &way.readings, source, wanted, causes, set: &[] };
                way.control.cycle(&told);
                assert!(way.control.watched[at].last.is_finite());
            }
            assert_eq!(way.control.supervisor().cause(), Some(Cause::Implausible(at)));
        }
    }

    /// A rig with a device that sends a float at its own pace, with or without a `timeout`; and the index of its
    /// reading.
    fn with_device(timeout_ns: u64) -> (Control, usize) {
        let (mut rig, model) = rigs::rig();
        let field = Field {
            name: "force".into(),
            start_bit: 0,
            bits: 32,
            big_endian: false,
            format: Format::Float32,
            scale: 1.0,
            offset: 0.0,
            start: 0.0,
            unit: abi::unit::Unit::parse("N").unwrap(),
            multiplexed: None,
        };
        let (name, fields) = ("force".to_string(), vec![field]);
        let message = Message { name, id: 0x1A0, extended: false, length: 4, send: false, period_ns: 0, fields };
        let (kind, signal) = (Kind::Frames(vec![message]), Signal { node: 1, what: SignalKind::Field(0, 0) });
        rig.nodes.push(Node { kind, moves: false, timeout_ns, ..rigs::drive("sensor", 9) });
        let input = rig.inputs[0];
        rig.inputs.push(Input { signal, ..input });
        let mut control = Control::new(&rig, model, None, &[], Options::default()).unwrap();
        assert!(control.supervisor_mut().arm());
        let at = control.signals().position(|other| other == signal).unwrap();
        (control, at)
    }

    #[test]
    fn values_that_are_not_finite_are_ignored_and_three_in_a_row_stop_the_rig() {
        let mut stopped = [0; 2];
        for seed in 0..500 {
            let mut chance = crate::rng::Chance(seed);
            let timeout = [0, 15, 40][chance.below(3) as usize];
            let (mut control, at) = with_device(timeout * rigs::PERIOD_NS);
            let (every, wrong) = (1 + chance.below(12), chance.fraction());
            // Ticks since it arrived, and since the last finite value; number of values that were not finite since
            // then.
            let (mut newest, mut age, mut number, mut since, mut none) = (0.0, Reading::NEVER, 0.0, 0, 0);
            for k in 0..200 {
                (age, since) = (age.saturating_add(1), since + 1);
                if k == 0 || chance.below(every) == 0 {
                    let odd = k > 0 && chance.fraction() < wrong;
                    newest =
                        if odd { 1.0 / [0.0, -0.0, f64::NAN][chance.below(3) as usize] } else { chance.fraction() };
                    // Some arrive after the computation of the tick before.
                    age = if age > 1 { chance.below(2) as u32 } else { 0 };
                    none = if odd { none + 1 } else { 0 };
                    (number, since) = if odd { (number, since) } else { (newest, age) };
                }
                // The drive applies its commanded torque.
                let torque = control.supervisor().permitted()[0];
                let value = |signal: Signal| if signal.what == SignalKind::Torque { torque } else { 0.0 };
                let reading = |signal| Reading { value: value(signal), age: 0 };
                let mut readings: Vec<Reading> = control.signals().map(reading).collect();
                readings[at] = Reading { value: newest, age };
                let (source, wanted, causes) = (Source::Model, &[][..], &[][..]);
                control.cycle(&CycleInputs {
                    ticks: 1,
                    late_ns: 0,
                    readings: &readings,
                    source,
                    wanted,
                    causes,
                    set: &[],
                });
                assert_eq!(control.watched[at].last, number, "seed {seed}, cycle {k}");
                let lost = timeout > 0 && u64::from(since) >= timeout;
                let cause = match (lost, none >= ODD) {
                    (true, _) => Some(Cause::Lost(at)),
                    (false, true) => Some(Cause::Implausible(at)),
                    (false, false) => None,
                };
                assert_eq!(control.supervisor().cause(), cause, "seed {seed}, cycle {k}: {none} are none");
                stopped[usize::from(lost)] += u32::from(cause.is_some());
                if cause.is_some() {
                    break;
                }
            }
        }
        assert!(stopped.iter().all(|count| *count > 50), "{stopped:?}");
    }

    #[test]
    fn a_missing_reading_is_held_and_then_counts_as_lost() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 1.0);
        way.cycle(1, &[]);
        for age in 1..3 {
            way.readings.iter_mut().for_each(|reading| *reading = Reading { value: 1.0, age });
            way.cycle(1, &[]);
            assert_eq!(way.control.supervisor().cause(), None, "age {age}");
        }
        way.readings.iter_mut().for_each(|reading| reading.age = 3);
        way.cycle(1, &[]);
        assert!(matches!(way.control.supervisor().cause(), Some(Cause::Lost(_))));
    }

    #[test]
    fn a_glitch_is_rejected_and_three_in_a_row_stop_the_rig() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 1.0);
        let held = way.cycle(1, &[]);
        for (cycle, cause) in [(1, None), (2, None), (3, Some(()))] {
            way.set(SignalKind::Speed, 900.0);
            let torque = way.cycle(1, &[]);
            assert!((torque - held * f64::from(cycle + 1)).abs() < 1e-12 || cause.is_some(), "the old speed counts");
            assert_eq!(way.control.supervisor().cause().map(|_| ()), cause, "cycle {cycle}");
        }
        assert!(matches!(way.control.supervisor().cause(), Some(Cause::Implausible(_))));
    }

    /// Greatest acceleration of a shaft, rad/s², its period, s, and the plausible difference per tick, rad.
    const SHAFT: (f64, f64, f64) = (333.0, 1e-3, 333.0 * (1e-3 + SPEED_LATE) * 1e-3);

    /// A shaft with random acceleration, read at random times within each period; some ticks are missed. Its encoder
    /// stands still from cycle `stands` on. Returns the cycle of the detection, and the speeds read.
    fn read_at_any_time(seed: u64, stands: usize) -> (Option<usize>, Vec<f64>) {
        let (acceleration, period, most) = SHAFT;
        let mut chance = crate::rng::Chance(seed);
        let jitter = chance.fraction();
        let (mut run, mut speeds) = (Disagreement::default(), Vec::new());
        let (mut now, mut due, mut angle, mut speed) = (0.0, 0.0, 0.0, chance.between(-200.0, 200.0));
        let mut told = angle;
        for k in 0..400 {
            let ticks = if chance.below(20) == 0 { 1 + chance.below(3) as u32 } else { 1 };
            due += f64::from(ticks) * period;
            let next = due + jitter * chance.fraction() * period;
            let (span, change) = (next - now, acceleration * chance.between(-1.0, 1.0));
            angle += (speed + 0.5 * change * span) * span;
            speed += change * span;
            now = next;
            let before = told;
            told = if k < stands { angle } else { told };
            run.add(ticks, told - before - speed * period * f64::from(ticks), speed, most);
            speeds.push(speed);
            if k > 0 && run.cycles >= ODD && run.is_certain(most, period) {
                return (Some(k), speeds);
            }
        }
        (None, speeds)
    }

    #[test]
    fn position_and_speed_agree_for_any_reading_time_in_a_period() {
        for seed in 0..2000 {
            assert_eq!(read_at_any_time(seed, usize::MAX).0, None, "seed {seed}");
        }
    }

    #[test]
    fn a_frozen_encoder_is_detected_for_any_reading_time() {
        let (mut found, (.., most)) = (0, SHAFT);
        for seed in 0..2000 {
            let stands = 20 + seed as usize % 100;
            let (cycle, speeds) = read_at_any_time(seed, stands);
            // Two thirds of the speed are certain after three readings; the first may have been taken before the
            // encoder stood still.
            let fast = speeds.iter().skip(stands).all(|speed| speed.abs() * SHAFT.1 > 2.0 * most);
            let late = cycle.map(|cycle| cycle - stands);
            assert!(!fast || late.is_some_and(|late| late <= 3), "seed {seed}: found after {late:?}");
            found += u32::from(fast && cycle.is_some());
        }
        assert!(found > 1500, "{found}");
    }

    #[test]
    fn a_second_of_implausible_readings_is_tolerated_if_overruns_are_only_counted() {
        let mut way = TestRig::of(|_| (), Options { count_overruns: true, ..Options::default() });
        way.set(SignalKind::Speed, 1.0);
        way.cycle(1, &[]);
        way.set(SignalKind::Speed, f64::NAN);
        for cycle in 1..1000 {
            way.cycle(1, &[]);
            assert_eq!(way.control.supervisor().cause(), None, "cycle {cycle}");
        }
        way.cycle(1, &[]);
        assert!(matches!(way.control.supervisor().cause(), Some(Cause::Implausible(_))));
    }

    #[test]
    fn a_set_of_parameters_causes_no_step_in_the_output() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 1.0);
        for _ in 0..10 {
            way.cycle(1, &[]);
        }
        let stiffness = way.control.model().description().layout.params.slot(0);
        let mut last = way.cycle(1, &[]);
        let mut greatest: f64 = 0.0;
        for k in 0..12 {
            let set = [(stiffness, 20.0)];
            let now = way.cycle(1, if k == 0 { &set } else { &[] });
            greatest = greatest.max((now - last).abs());
            last = now;
        }
        // 0.12 N·m of difference, blended over ten cycles, in addition to the change of the spring itself.
        assert!(greatest < 0.05, "a step of {greatest} N·m");
        assert!((last + 20.0 * 23e-3).abs() < 1e-12, "{last}");
    }

    #[test]
    fn a_set_with_which_the_model_cannot_continue_is_refused() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 1.0);
        let first = way.cycle(1, &[]);
        let stiffness = way.control.model().description().layout.params.slot(0);
        let second = way.cycle(1, &[(stiffness, f64::NAN)]);
        assert!((second - 2.0 * first).abs() < 1e-12, "the old one holds: {second}");
        assert_eq!((way.control.refused_set(), way.control.supervisor().cause()), (Some(0), None));
    }

    #[test]
    fn a_failure_of_the_model_stops_the_rig() {
        let mut way = TestRig::new(|_| ());
        way.set(SignalKind::Speed, 1.0);
        way.cycle(1, &[]);
        let state = way.control.model.description().layout.states.slot(0);
        way.control.model.set(state, f64::NAN);
        way.cycle(1, &[]);
        assert_eq!(way.control.supervisor().cause(), Some(Cause::NotFinite(0)));
    }

    #[test]
    fn a_rig_without_bounds_is_refused_with_a_message() {
        let (mut rig, model) = rigs::rig();
        let Kind::Cia402(drive) = &mut rig.nodes[0].kind else { unreachable!() };
        drive.max_speed = None;
        let why = |bounds: &[Bounds]| Control::new(&rig, model.clone(), None, bounds, Options::default()).err();
        let missing =
            "drive `load`: no greatest speed is known: give `speed_max`; the drive does not say (object 6080)";
        assert_eq!(why(&[]).as_deref(), Some(missing));
        assert_eq!(why(&[Bounds { torque: None, speed: Some(100.0) }]), None, "the drive says");
    }

    #[test]
    fn what_is_saved_goes_on_as_before() {
        let mut first = TestRig::new(|_| ());
        for k in 0..50 {
            first.set(SignalKind::Speed, f64::from(k % 5) * 0.1);
            let mut words = Vec::new();
            first.control.save(&mut words);
            let mut second = TestRig::new(|_| ());
            second.readings.clone_from(&first.readings);
            assert_eq!(second.control.restore(&words), Some(()));
            assert_eq!(first.cycle(1, &[]).to_bits(), second.cycle(1, &[]).to_bits(), "cycle {k}");
        }
    }
}
