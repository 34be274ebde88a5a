//! Supervision of each drive of a rig: its limits, and which checks a drive lacks.
//!
//! In: a rig, limits read from its drives. Out: limits for the supervisor, and messages about missing checks. A drive
//! with a profile has all checks; a drive described by frames has those for which it reports a signal and the rig names
//! a limit.

use crate::realtime::clock::monotonic_ns;
use crate::safety::{DriveLimits, OutputLimits, Protection, Refused, is_present};
use abi::Instance;
use abi::format::three_digits;
use abi::rig::{Kind, Mode, Output, Rig, Signal, SignalKind};

/// Highest torque and speed of a drive, where known.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Bounds {
    /// N·m
    pub torque: Option<f64>,
    /// rad/s
    pub speed: Option<f64>,
}

/// The signal in which a node reports its torque, speed or position.
pub fn measured_signal(rig: &Rig, node: usize, what: SignalKind) -> Option<Signal> {
    rig.nodes[node].tells(what).map(|what| Signal { node, what })
}

/// The signal in which a drive reports the quantity that an output commands; none if it reports none.
pub fn answer(rig: &Rig, output: &Output) -> Option<Signal> {
    let Signal { node, what } = output.signal;
    let asked = rig.nodes[node].asks_for(what).filter(|_| rig.nodes[node].moves)?;
    measured_signal(rig, node, asked)
}

/// Checks that drives lack, and why: one line for each such drive.
pub fn missing_monitors(rig: &Rig) -> Vec<String> {
    let framed = |node: &usize| rig.nodes[*node].moves && matches!(rig.nodes[*node].kind, Kind::Frames(_));
    let line = |node: usize| {
        let within = rig.nodes[node].within;
        let tells = |what| measured_signal(rig, node, what).is_some();
        let commands = || rig.outputs.iter().filter(|output| output.signal.node == node);
        let asks = |output: &Output| rig.nodes[node].asks_for(output.signal.what);
        let torque = commands().any(|output| asks(output) == Some(SignalKind::Torque));
        let mut lacks = Vec::new();
        let mut needs = |watch: &str, has: &[(bool, &str)]| {
            let missing: Vec<&str> = has.iter().filter(|(there, _)| !there).map(|(_, why)| *why).collect();
            if !missing.is_empty() {
                lacks.push(format!("{watch} ({})", missing.join(", ")));
            }
        };
        let speed = (tells(SignalKind::Speed), "it tells no speed");
        let fastest = (within.max_speed.is_some(), "give `speed_max`");
        needs("speed", &[speed, fastest]);
        needs(
            "travel",
            &[(tells(SignalKind::Position), "it tells no position"), (within.travel.is_some(), "give `travel`")],
        );
        if torque {
            let power = within.max_power.is_some() || within.max_speed.is_some();
            needs("power", &[speed, (power, "give `power_max`")]);
            needs("run-away", &[speed, fastest]);
        }
        if !commands().any(|output| answer(rig, output).is_some()) {
            needs("whether it follows", &[(false, "it does not tell what is commanded")]);
        }
        needs("its state", &[(false, "frames have no status word")]);
        if rig.nodes[node].timeout_ns == 0 {
            needs("silence", &[(false, "give `timeout`")]);
        }
        format!("drive `{}` is not watched for {}", rig.nodes[node].name, lacks.join(", "))
    };
    (0..rig.nodes.len()).filter(framed).map(line).collect()
}

/// Checks whether a rig may be started.
///
/// # Errors
/// A safe value that would move a drive: the drive is enabled with it before an operator has armed the rig and before
/// any sign was checked.
pub fn may_start(rig: &Rig) -> Result<(), String> {
    let moves = |output: &&Output| output.safe != 0.0 && rig.nodes[output.signal.node].is_moved_by(output.signal.what);
    match rig.outputs.iter().find(moves).filter(|_| is_present(Protection::Idle)) {
        None => Ok(()),
        Some(output) => Err(format!(
            "the command of `{}`: its safe value is {}, and would move it before it is armed: make it 0",
            rig.nodes[output.signal.node].name, output.safe
        )),
    }
}

/// Number of steps that are timed.
const STEPS: usize = 1000;

/// Computing time of the control program for one period on this machine, s: median and maximum of 1,000.
pub fn step_time(rig: &Rig, control: &Instance) -> (f64, f64) {
    let steps = u64::from(rig.steps.max(1));
    let mut control = control.clone();
    control.start(rig.period_ns as f64 * 1e-9 / steps as f64);
    let mut times: Vec<u64> = (0..STEPS)
        .map(|_| {
            let begin_ns = monotonic_ns();
            control.advance(steps);
            monotonic_ns() - begin_ns
        })
        .collect();
    times.sort_unstable();
    let seconds = |ns: u64| ns as f64 * 1e-9;
    (seconds(times[STEPS / 2]), seconds(times[STEPS - 1]))
}

/// A message if this computer is too slow for a rig.
pub fn too_slow(rig: &Rig, control: &Instance) -> Option<String> {
    let (median, period) = (step_time(rig, control).0, rig.period_ns as f64 * 1e-9);
    let ms = |seconds: f64| three_digits(1e3 * seconds);
    (median > 0.5 * period).then(|| {
        let (step, period) = (ms(median), ms(period));
        format!("a step takes {step} ms on this computer, more than half of a period of {period} ms")
    })
}

/// Highest torque and speed of a node: from the rig, otherwise as read from the drive.
pub fn bounds_of(rig: &Rig, node: usize, bounds: &[Bounds]) -> Bounds {
    let read = bounds.get(node).copied().unwrap_or_default();
    match &rig.nodes[node].kind {
        Kind::Cia402(drive) => {
            Bounds { torque: drive.max_torque.or(read.torque), speed: drive.max_speed.or(read.speed) }
        }
        Kind::Frames(_) => read,
    }
}

/// Limits of one drive for the supervisor.
///
/// # Errors
/// A message about a limit that neither the rig nor the drive names.
pub fn drive_limits(rig: &Rig, node: usize, bounds: &[Bounds]) -> Result<DriveLimits, String> {
    let name = &rig.nodes[node].name;
    let Kind::Cia402(drive) = &rig.nodes[node].kind else {
        let within = rig.nodes[node].within;
        let speed = within.max_speed.unwrap_or(f64::INFINITY);
        let torques = rig.outputs.iter().filter(|output| output.signal.node == node);
        let torques = torques.filter(|output| rig.nodes[node].asks_for(output.signal.what) == Some(SignalKind::Torque));
        let most = torques.map(|output| output.high.abs().max(output.low.abs()) * speed).fold(f64::INFINITY, f64::min);
        let travel = within.travel.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        return Ok(DriveLimits { speed, travel, power: within.max_power.unwrap_or(most) });
    };
    let Bounds { torque, speed } = bounds_of(rig, node, bounds);
    let speed = speed.filter(|speed| speed.is_finite() && *speed > 0.0).ok_or_else(|| {
        format!("drive `{name}`: no greatest speed is known: give `speed_max`; the drive does not say (object 6080)")
    })?;
    let torque = torque.filter(|torque| torque.is_finite() && *torque > 0.0).ok_or_else(|| {
        format!("drive `{name}`: no greatest torque is known: give `T_max`; the drive does not say (object 6072)")
    })?;
    let travel = drive.travel.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
    Ok(DriveLimits { speed, travel, power: drive.max_power.unwrap_or(torque * speed) })
}

/// Limits of an output: those of the rig, restricted to those of the drive.
pub fn output_limits(rig: &Rig, output: &Output, moving: &[usize], bounds: &[Bounds]) -> Result<OutputLimits, String> {
    let Output { signal, low, high, slew, safe, .. } = *output;
    let drive = moving.iter().position(|node| *node == signal.node);
    let (mut low, mut high) = (low, high);
    let torque = drive.is_some() && rig.nodes[signal.node].asks_for(signal.what) == Some(SignalKind::Torque);
    if let Kind::Cia402(described) = &rig.nodes[signal.node].kind {
        let most = bounds_of(rig, signal.node, bounds);
        let (least, greatest) = match described.mode {
            Mode::Torque => (most.torque.map(|most| -most), most.torque),
            Mode::Speed => (most.speed.map(|most| -most), most.speed),
            Mode::Position => (described.travel.map(|travel| travel.0), described.travel.map(|travel| travel.1)),
        };
        low = low.max(least.unwrap_or(f64::NEG_INFINITY));
        high = high.min(greatest.unwrap_or(f64::INFINITY));
        if !(low.is_finite() && high.is_finite()) {
            let name = &rig.nodes[signal.node].name;
            return Err(format!(
                "drive `{name}`: its command has no bounds: give a `limit`, or `travel` for a position"
            ));
        }
    }
    Ok(OutputLimits { low, high, slew, safe, drive, torque })
}

/// The message for limits that the supervisor refuses.
pub fn refusal(rig: &Rig, moving: &[usize], refused: Refused) -> String {
    let output = |i: usize| {
        let node: &str = &rig.nodes[rig.outputs[i].signal.node].name;
        format!("the command of `{node}`")
    };
    match refused {
        Refused::Range(i) => {
            let Output { low, high, safe, .. } = rig.outputs[i];
            format!("{}: its safe value {safe} is not within its limits {low} .. {high}", output(i))
        }
        Refused::Slew(i) => format!("{}: its slew is not above 0, so it could never be stopped", output(i)),
        Refused::Unbounded(i) => format!("{}: it has no bounds: give a `limit`", output(i)),
        Refused::NoDrive(i) => format!("{}: there is no such drive", output(i)),
        Refused::Wider(i) => format!("{}: limits can only be narrowed", output(i)),
        Refused::Drive(i) => {
            format!("drive `{}`: a limit is negative or no number", rig.nodes[moving[i]].name)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hil::control::{Control, CycleInputs, Options, Reading, Source};
    use crate::safety::Cause;
    use crate::testing::rigs;
    use abi::Instance;
    use abi::rig::{DriveLimits, Field, Format, Message};
    use abi::unit::Unit;

    /// The periods scale with the measured step time, so the load of this computer does not matter.
    #[test]
    fn a_computer_that_is_too_slow_is_refused() {
        let (rig, control) = rigs::rig();
        let steps = 100;
        let of = |period_ns: u64| Rig { period_ns, steps, ..rig.clone() };
        let measured_ns = (step_time(&of(1_000_000), &control).0 * 1e9) as u64;
        for seed in 0..20 {
            let mut chance = crate::rng::Chance(seed);
            let short = measured_ns / (4 + chance.below(40)) + 1;
            let why = too_slow(&of(short), &control);
            assert!(why.is_some_and(|why| why.contains("more than half of a period")), "{short} of {measured_ns} ns");
            let long = measured_ns * (40 + chance.below(1000)) + 1_000_000;
            assert_eq!(too_slow(&of(long), &control), None, "{long} of {measured_ns} ns");
        }
    }

    fn message(name: &str, unit: &str, id: u32, send: bool) -> Message {
        let unit = Unit::parse(unit).unwrap();
        let field = Field {
            name: name.into(),
            start_bit: 0,
            bits: 32,
            big_endian: false,
            format: Format::Signed,
            scale: 1e-3,
            offset: 0.0,
            start: 0.0,
            unit,
            multiplexed: None,
        };
        Message { name: name.into(), id, extended: false, length: 4, send, period_ns: 0, fields: vec![field] }
    }

    /// The spring model with a drive described by frames: a torque command, and the given signals as answers.
    fn framed(tells: &[(&str, &str)], within: DriveLimits) -> (Rig, Instance) {
        let (mut rig, model) = rigs::rig();
        let mut messages = vec![message("command", "N·m", 0x205, true)];
        messages.extend((0x185..).zip(tells).map(|(id, (name, unit))| message(name, unit, id, false)));
        (rig.nodes[0].kind, rig.nodes[0].within) = (Kind::Frames(messages), within);
        rig.outputs[0].signal.what = SignalKind::Field(0, 0);
        rig.inputs[0].signal.what = SignalKind::Field(1, 0);
        (rig, model)
    }

    const ALL: [(&str, &str); 3] = [("omega", "rpm"), ("angle", "deg"), ("torque", "N·m")];
    const WITHIN: DriveLimits = DriveLimits { max_speed: Some(10.0), travel: Some((-1.0, 1.0)), max_power: Some(2.0) };

    /// The cause of the stop and its tick; `now` returns speed, position and torque of each tick from the output
    /// permitted in the tick before.
    fn stopped(mut now: impl FnMut(u32, f64) -> [f64; 3]) -> Option<(Cause, u32)> {
        let (rig, model) = framed(&ALL, WITHIN);
        let options = Options { ramp_ns: 0, ..Options::default() };
        let mut control = Control::new(&rig, model, None, &[], options).unwrap();
        assert!(control.supervisor_mut().arm());
        let places: Vec<usize> = control
            .signals()
            .map(|signal| if let SignalKind::Field(message, _) = signal.what { message - 1 } else { unreachable!() })
            .collect();
        for k in 0..400 {
            let values = now(k, control.supervisor().permitted()[0]);
            let readings: Vec<Reading> = places.iter().map(|at| Reading { value: values[*at], age: 0 }).collect();
            let (source, wanted, causes) = (Source::Model, &[][..], &[][..]);
            control.cycle(&CycleInputs { ticks: 1, late_ns: 0, readings: &readings, source, wanted, causes, set: &[] });
            if let Some(cause) = control.supervisor().cause() {
                return Some((cause, k));
            }
            assert!(control.supervisor().permitted()[0].abs() * values[0].abs() <= 2.0 + 1e-9, "more than its power");
        }
        None
    }

    #[test]
    fn a_drive_described_by_frames_is_supervised_by_its_signals() {
        // The spring: −10 N·m/rad times the integrated speed.
        assert_eq!(stopped(|_, sent| [0.1, 0.0, sent]), None);
        assert_eq!(stopped(|k, sent| [if k < 5 { 0.0 } else { -10.1 }, 0.0, sent]), Some((Cause::Speed(0, -10.1), 5)));
        assert_eq!(stopped(|k, sent| [0.0, if k < 5 { 0.0 } else { 1.1 }, sent]), Some((Cause::Travel(0, 1.1), 5)));
        let away = stopped(|k, sent| [f64::from(k) * 0.1, 0.0, sent]);
        assert!(matches!(away, Some((Cause::RunAway(0), k)) if k < 15), "{away:?}");
        // The drive reports no torque although one is commanded: 0.4 N·m is a tenth of its range, plus four units.
        let idle = stopped(|_, _| [0.5, 0.0, 0.0]);
        assert!(matches!(idle, Some((Cause::NotFollowing(0), k)) if k < 60), "{idle:?}");
    }

    #[test]
    fn missing_checks_are_reported() {
        let said = |tells: &[(&str, &str)], within| missing_monitors(&framed(tells, within).0).join("; ");
        assert_eq!(said(&ALL, WITHIN), "drive `load` is not watched for its state (frames have no status word)");
        let power = DriveLimits { max_power: None, ..WITHIN };
        assert_eq!(said(&ALL, power), said(&ALL, WITHIN), "greatest torque times greatest speed");
        let mute = said(&[("enable", "1")], WITHIN);
        for lack in [
            "speed (it tells no speed)",
            "travel (it tells no position)",
            "power (it tells no speed)",
            "run-away (it tells no speed)",
            "whether it follows (it does not tell what is commanded)",
        ] {
            assert!(mute.contains(lack), "{mute}");
        }
        let free = said(&ALL, DriveLimits::default());
        assert!(free.contains("speed (give `speed_max`)") && free.contains("travel (give `travel`)"), "{free}");
        // Of two speeds, the one named `speed` is the drive's own.
        assert!(said(&[("a", "rpm"), ("b", "rpm")], WITHIN).contains("speed (it tells no speed)"));
        assert!(!said(&[("a", "rpm"), ("speed", "rpm")], WITHIN).contains("speed (it tells no speed)"));
        assert_eq!(missing_monitors(&rigs::pair().0), Vec::<String>::new());
    }

    #[test]
    fn a_safe_value_that_moves_a_drive_is_refused_before_anything_is_sent() {
        let (mut rig, _) = framed(&ALL, WITHIN);
        assert_eq!(may_start(&rig), Ok(()));
        rig.outputs[0].safe = 0.5;
        assert!(may_start(&rig).is_err());
        let Kind::Frames(messages) = &mut rig.nodes[0].kind else { unreachable!() };
        messages[0].fields[0].unit = Unit::none();
        assert_eq!(may_start(&rig), Ok(()), "a lamp");
    }
}
