//! Software in the loop (SIL): the control program of a rig, cycle by cycle, with the program of the plant instead of
//! hardware.
//!
//! In: the control program, a [`Bench`], a plan. Out: the results of an ordinary run. The step is the one that runs on
//! the rig. Between two ticks the plant takes steps of its own; commands pass the same limits, slews, quantisation,
//! dead times and lags, and readings have the resolution of the encoders.

use crate::coupling::lag::Lag;
use crate::coupling::predictor::Wired;
use crate::run::observe::{Observer, check_finite, check_status};
use crate::run::outcome::{Cause, Continue, Stop, Work};
use abi::plan::Experiment;
use abi::rig::{Bench, Field, Format, Kind, Rig, Signal, SignalKind};
use abi::{Function, Instance, Slot};

/// Path of a command from the control program to the plant.
struct Path {
    from: Slot,
    low: f64,
    high: f64,
    /// Greatest change in one period.
    change: f64,
    /// One quantisation step of the message, SI; 0 where it has none.
    step: f64,
    /// The last permitted value.
    permitted: f64,
    dead_ns: u64,
    lag: Lag,
    signal: Signal,
    /// Slot of the plant on which it acts, if any.
    to: Option<Slot>,
}

/// A signal that the control program reads.
struct Sensed {
    to: Slot,
    from: From,
}

/// Source of a signal's value.
enum From {
    /// A slot of the plant, quantised: rounded, or rounded down to whole counts for an encoder.
    Part(Slot, f64, bool),
    /// The value that this command applies, quantised.
    Applied(usize, f64),
    /// A constant.
    Constant(f64),
}

/// Runs an experiment whose plan has this bench.
pub(crate) fn run(
    control: &mut Instance,
    bench: &Bench,
    experiment: &Experiment,
    observer: &mut Observer,
    work: &mut Work,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<(), Stop> {
    let rig = &bench.rig;
    let period_ns = rig.period_ns;
    let period = period_ns as f64 * 1e-9;
    let step = period / f64::from(rig.steps);
    let steps = (period / experiment.solver.step).round().max(1.0) as u64;
    let ticks = (experiment.duration / period).round() as u64;
    let mut plant = bench.plant.clone();
    let mut paths = paths(rig);
    let readings = readings(rig, &paths);
    let unable = |why| Stop { cause: Cause::Rig { condition: "predict".into(), why }, time: 0.0 };
    let mut look = SilPredictor::of(rig, &bench.plant).map_err(unable)?;

    let status = plant.start(period / steps as f64);
    check_status(&plant, status)?;
    read(control, &plant, &readings, &paths);
    let status = control.start(step);
    check_status(control, status)?;
    check_finite(control)?;
    observer.see(control)?;
    probe(observer, control, step);
    for tick in 0..ticks {
        let now = tick * period_ns;
        read(control, &plant, &readings, &paths);
        look.read(now, control, &plant);
        for _ in 0..rig.steps {
            let status = control.advance(1);
            observer.see(control)?;
            probe(observer, control, step);
            check_status(control, status)?;
        }
        check_finite(control)?;
        if let Some(stop) = rig.stops.iter().find(|stop| control.get(stop.slot) != 0.0) {
            let cause = Cause::Rig { condition: stop.condition.clone(), why: stop.why.clone() };
            return Err(Stop { cause, time: control.get(Slot::TIME) });
        }
        command(now, &mut paths, control);
        look.sent(&paths);
        let status = move_on(now, period_ns, steps, &mut plant, &mut paths);
        check_status(&plant, status)?;
        check_finite(&plant)?;
        work.steps += u64::from(rig.steps);
        if tick % 256 == 0 && watch(tick as f64 / ticks as f64).is_break() {
            return Err(Stop { cause: Cause::Stopped, time: control.get(Slot::TIME) });
        }
    }
    Ok(())
}

/// Sends what the control program requests, as far as it is permitted.
fn command(now_ns: u64, paths: &mut [Path], control: &Instance) {
    for path in paths {
        let wanted = control.get(path.from).clamp(path.low, path.high);
        path.permitted += (wanted - path.permitted).clamp(-path.change, path.change);
        path.lag.send(now_ns + path.dead_ns, in_steps(path.permitted, path.step));
    }
}

/// Moves the plant on by one period; returns its status.
fn move_on(now_ns: u64, period_ns: u64, steps: u64, plant: &mut Instance, paths: &mut [Path]) -> u64 {
    for k in 0..steps {
        let (from, to) = (now_ns + k * period_ns / steps, now_ns + (k + 1) * period_ns / steps);
        for path in &mut *paths {
            let mean = path.lag.advance(from, to);
            if let Some(slot) = path.to {
                plant.set(slot, mean);
            }
        }
        let status = plant.advance(1);
        if status != 0 {
            return status;
        }
    }
    0
}

/// The moment of a run on a rig from which [`ahead`] goes on.
pub struct Moment<'a> {
    /// The block of the control program after a cycle.
    pub control: &'a [f64],
    /// What the drives measured at the begin of that cycle: values of signals that the plant shows, SI. The others are as
    /// at its start.
    pub measured: &'a [(Signal, f64)],
    /// The outputs that were permitted in that cycle, SI.
    pub permitted: &'a [f64],
}

/// Runs a rig's programs on, without hardware, from a moment of a run on the rig. `steps`: of the plant in a period.
/// `each` receives the control program after each of the following `ticks`; it is called fewer times if a program cannot
/// continue, or the plant cannot be set to what was measured.
pub fn ahead(
    rig: &Rig,
    (control, plant): (&Instance, &Instance),
    from: &Moment,
    (steps, ticks): (u64, u64),
    each: &mut dyn FnMut(&Instance),
) {
    let period = rig.period_ns as f64 * 1e-9;
    let (mut control, mut plant) = (control.clone(), plant.clone());
    let Ok(mut look) = SilPredictor::of(rig, &plant) else { return };
    let mut paths = paths(rig);
    let readings = readings(rig, &paths);
    // What is computed at a start, and is in no block, is there afterwards.
    let started = plant.start(period / steps as f64) == 0 && control.start(period / f64::from(rig.steps)) == 0;
    if !started || control.block().len() != from.control.len() || paths.len() != from.permitted.len() {
        return;
    }
    control.block_mut().copy_from_slice(from.control);
    let behind = behind(&plant, rig);
    for (signal, value) in from.measured {
        match behind.iter().find(|(known, _)| known == signal) {
            Some((_, Some(state))) => plant.set(*state, *value),
            Some((_, None)) => return,
            None => {}
        }
    }
    for (path, permitted) in paths.iter_mut().zip(from.permitted) {
        path.permitted = *permitted;
        path.lag.settle(in_steps(*permitted, path.step));
    }
    let mut status = move_on(0, rig.period_ns, steps, &mut plant, &mut paths);
    for tick in 1..=ticks {
        let now_ns = tick * rig.period_ns;
        read(&mut control, &plant, &readings, &paths);
        look.read(now_ns, &mut control, &plant);
        status |= control.advance(u64::from(rig.steps));
        if status != 0 || !control.block()[control.description().layout.states.range()].iter().all(|x| x.is_finite()) {
            return;
        }
        command(now_ns, &mut paths, &control);
        look.sent(&paths);
        each(&control);
        status |= move_on(now_ns, rig.period_ns, steps, &mut plant, &mut paths);
    }
}

/// The state of the plant that each of its signals shows; none if it shows something else.
fn behind(plant: &Instance, rig: &Rig) -> Vec<(Signal, Option<Slot>)> {
    let mut probe = plant.clone();
    let states = probe.description().layout.states;
    for (i, slot) in states.range().enumerate() {
        probe.block_mut()[slot] = 0.37 + 0.011 * i as f64;
    }
    let asked = probe.has(Function::Outputs) && probe.call(Function::Outputs) == 0;
    let one = |slot: Slot| {
        let shows = |state: &usize| asked && probe.block()[*state].to_bits() == probe.get(slot).to_bits();
        match states.contains(slot) {
            true => Some(slot),
            false => states.range().find(shows).map(|state| Slot(state as u32)),
        }
    };
    rig.plant.seen.iter().map(|(signal, slot)| (*signal, one(*slot))).collect()
}

/// The predictor, if the rig has `predict`.
struct SilPredictor {
    wired: Option<Wired>,
    /// Slot of the position in the plant, and the size of one count.
    seen: Option<(Slot, f64)>,
    /// Inputs of the control program that receive predictions.
    speed: Option<Slot>,
    position: Option<Slot>,
}

impl SilPredictor {
    fn of(rig: &Rig, plant: &Instance) -> Result<SilPredictor, String> {
        let mut look = SilPredictor { wired: Wired::of(rig, plant, |_| 0)?, seen: None, speed: None, position: None };
        if let Some(wired) = &look.wired {
            let slot = |what| rig.plant.seen.iter().find(|(signal, _)| *signal == Signal { node: wired.node, what });
            look.seen = slot(SignalKind::Position).map(|(signal, slot)| (*slot, step_of_signal(rig, *signal)));
            let input = |what| rig.inputs.iter().find(|input| input.signal == Signal { node: wired.node, what });
            look.speed = input(SignalKind::Speed).map(|input| input.slot);
            look.position = input(SignalKind::Position).map(|input| input.slot);
        }
        Ok(look)
    }

    fn read(&mut self, now_ns: u64, control: &mut Instance, plant: &Instance) {
        let (Some(wired), Some((slot, count))) = (&mut self.wired, self.seen) else { return };
        wired.observer.observe(now_ns, (plant.get(slot) / count).floor() * count);
        if !wired.observer.is_valid() {
            return;
        }
        let ahead = wired.observer.ahead();
        for (slot, value) in [(self.speed, ahead.speed), (self.position, ahead.position)] {
            if let Some(slot) = slot {
                control.set(slot, value);
            }
        }
    }

    fn sent(&mut self, paths: &[Path]) {
        let Some(wired) = &mut self.wired else { return };
        for (torque, (output, sign, step)) in wired.outputs.iter().enumerate() {
            wired.observer.sent(torque, sign * in_steps(paths[*output].permitted, *step));
        }
    }
}

fn probe(observer: &mut Observer, control: &Instance, step: f64) {
    let time = control.get(Slot::TIME);
    while observer.probe.next().is_some_and(|instant| instant < time + 0.5 * step) {
        observer.probe.take(control.block());
    }
}

/// Rounds to the nearest multiple of a step.
fn in_steps(value: f64, step: f64) -> f64 {
    if step > 0.0 { (value / step).round() * step } else { value }
}

/// Passes every signal to the control program.
fn read(control: &mut Instance, plant: &Instance, readings: &[Sensed], paths: &[Path]) {
    for reading in readings {
        let value = match &reading.from {
            From::Part(slot, step, true) => (plant.get(*slot) / step).floor() * step,
            From::Part(slot, step, false) => in_steps(plant.get(*slot), *step),
            From::Applied(path, step) => in_steps(paths[*path].lag.applied(), *step),
            From::Constant(value) => *value,
        };
        control.set(reading.to, value);
    }
}

/// Quantisation step of a field; 0 for a floating-point number.
fn step_of(field: &Field) -> f64 {
    match field.format {
        Format::Unsigned | Format::Signed => field.scale.abs(),
        Format::Float32 | Format::Float64 => 0.0,
    }
}

/// Quantisation step of a signal on the bus, SI.
fn step_of_signal(rig: &Rig, signal: Signal) -> f64 {
    match (&rig.nodes[signal.node].kind, signal.what) {
        (Kind::Cia402(drive), SignalKind::Torque) => 1e-3 * drive.rated_torque,
        (Kind::Cia402(drive), SignalKind::Speed) => drive.speed_unit,
        (Kind::Cia402(drive), SignalKind::Position) => drive.count,
        (Kind::Frames(messages), SignalKind::Field(m, f)) => step_of(&messages[m].fields[f]),
        _ => 0.0,
    }
}

fn paths(rig: &Rig) -> Vec<Path> {
    let one = |output: &abi::rig::Output| {
        let node = &rig.nodes[output.signal.node];
        let at_sync = matches!(&node.kind, Kind::Cia402(drive) if drive.at_sync);
        let slot = rig.plant.applied.iter().find(|(signal, _)| *signal == output.signal).map(|(_, slot)| *slot);
        Path {
            from: output.slot,
            low: output.low,
            high: output.high,
            change: output.slew * rig.period_ns as f64 * 1e-9,
            step: step_of_signal(rig, output.signal),
            permitted: 0.0,
            dead_ns: (node.delay * 1e9).round() as u64 + if at_sync { rig.period_ns } else { 0 },
            lag: Lag::new(node.lag),
            signal: output.signal,
            to: slot,
        }
    };
    rig.outputs.iter().map(one).collect()
}

fn readings(rig: &Rig, paths: &[Path]) -> Vec<Sensed> {
    let one = |input: &abi::rig::Input| {
        let seen = rig.plant.seen.iter().find(|(signal, _)| *signal == input.signal);
        let applied = paths.iter().position(|path| path.signal == input.signal);
        let step = step_of_signal(rig, input.signal);
        let from = match (seen, applied, input.signal.what) {
            (Some((_, slot)), _, what) => From::Part(*slot, step, what == SignalKind::Position && step > 0.0),
            (None, Some(path), _) => From::Applied(path, step),
            (None, None, SignalKind::Enabled) => From::Constant(1.0),
            (None, None, _) => From::Constant(input.start),
        };
        Sensed { to: input.slot, from }
    };
    rig.inputs.iter().map(one).collect()
}
