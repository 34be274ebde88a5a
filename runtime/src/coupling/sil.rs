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
use abi::{Instance, Slot};

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
    let mut look = SilPredictor {
        wired: Wired::of(rig, &bench.plant, |_| 0).map_err(unable)?,
        seen: None,
        speed: None,
        position: None,
    };
    if let Some(wired) = &look.wired {
        let slot = |what| rig.plant.seen.iter().find(|(signal, _)| *signal == Signal { node: wired.node, what });
        look.seen = slot(SignalKind::Position).map(|(signal, slot)| (*slot, step_of_signal(rig, *signal)));
        let input = |what| rig.inputs.iter().find(|input| input.signal == Signal { node: wired.node, what });
        look.speed = input(SignalKind::Speed).map(|input| input.slot);
        look.position = input(SignalKind::Position).map(|input| input.slot);
    }

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
        for path in &mut paths {
            let wanted = control.get(path.from).clamp(path.low, path.high);
            path.permitted += (wanted - path.permitted).clamp(-path.change, path.change);
            path.lag.send(now + path.dead_ns, in_steps(path.permitted, path.step));
        }
        look.sent(&paths);
        for k in 0..steps {
            let (from, to) = (now + k * period_ns / steps, now + (k + 1) * period_ns / steps);
            for path in &mut paths {
                let mean = path.lag.advance(from, to);
                if let Some(slot) = path.to {
                    plant.set(slot, mean);
                }
            }
            let status = plant.advance(1);
            check_status(&plant, status)?;
        }
        check_finite(&plant)?;
        work.steps += u64::from(rig.steps);
        if tick % 256 == 0 && watch(tick as f64 / ticks as f64).is_break() {
            return Err(Stop { cause: Cause::Stopped, time: control.get(Slot::TIME) });
        }
    }
    Ok(())
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
