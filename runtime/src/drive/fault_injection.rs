//! Fault injection: faults of simulated nodes, and the times at which they act.
//!
//! In: `load fault 0x2310 at 3 s`, `panel.enable = 0 at 5 s of run`, `servo encoder frozen when servo.speed > 10 rad/s for 20
//! ms`. Out: a [`Hook`].

use abi::rig::{Kind, Rig, Signal, SignalKind};
use abi::unit::Unit;

/// Fault of a simulated node.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Effect {
    /// It sends an emergency message, and withdraws it at the end of the fault.
    Emergency(u16),
    /// Its state machine enters "fault"; a reset is refused until the end of the fault.
    Fault(u16),
    /// It leaves "operational".
    PreOperational,
    /// Its power goes off and on.
    Reset,
    /// It continues without a heartbeat.
    NoHeartbeat,
    /// It displays another mode of operation than it has.
    ModeShown(i8),
    /// Its position reading freezes.
    EncoderFrozen,
    /// Its position reading jumps by this many counts, and back at the end of the fault.
    EncoderGlitch(i64),
    /// It loses this many counts for good.
    EncoderLost(i64),
    /// Factor on the angle it reports.
    EncoderScale(f64),
    /// Factor on the speed it reports.
    SpeedScale(f64),
    /// Factor on the torque it reports.
    TorqueToldScale(f64),
    /// Factor on the torque it applies: −1 inverts the sign.
    TorqueScale(f64),
    /// Its process data are delayed by this time, ns.
    AnswersLate(u64),
    /// It sends no process data.
    NoAnswers,
    /// It ignores new targets.
    IgnoresCommands,
    /// Safe torque off by wire.
    SafeTorqueOff,
    /// It neither receives nor sends; its torque stays.
    Silent,
    /// A fixed value for a signal of a device: message, field, value, SI.
    Value(usize, usize, f64),
}

/// Begin of a fault.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Start {
    /// At this time since power-on, ns.
    At(u64),
    /// At this time of the model, ns: after [`SimulatedBench::begin_run`](super::SimulatedBench::begin_run).
    OfRun(u64),
    /// As soon as a true signal of the shaft (torque, speed, position of a drive, SI) is above or below a level.
    When {
        /// The signal.
        signal: Signal,
        /// Above, or below.
        above: bool,
        /// The level, SI.
        level: f64,
    },
}

/// A fault with its begin and duration.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Hook {
    /// The node, an index into the rig's nodes.
    pub node: usize,
    /// The fault.
    pub effect: Effect,
    /// Its begin.
    pub start: Start,
    /// Its duration, ns; none: permanent.
    pub lasts_ns: Option<u64>,
}

/// Syntax of all faults, for messages and help.
pub const WORDS: &[&str] = &[
    "emergency CODE",
    "fault CODE",
    "pre-operational",
    "reset",
    "no heartbeat",
    "mode NUMBER",
    "encoder frozen",
    "encoder glitch COUNTS",
    "encoder lost COUNTS",
    "encoder scale FACTOR",
    "speed scale FACTOR",
    "torque told scale FACTOR",
    "torque scale FACTOR",
    "answers late TIME",
    "no answers",
    "ignores commands",
    "safe torque off",
    "silent",
];

/// Parses a fault for a rig. The error names the mistake and the correct form.
pub fn read(text: &str, rig: &Rig) -> Result<Hook, String> {
    let form = "it reads as `load fault 0x2310 at 3 s` or `panel.enable = 0 at 5 s of run`, with `when load.speed > 10 rad/s` \
                instead of the time, and `for 20 ms` at its end";
    let wrong = |what: String| format!("`{text}`: {what}; {form}");
    let (rest, lasts) = match text.rsplit_once(" for ") {
        Some((rest, time)) => (rest, Some(nanoseconds(time).map_err(&wrong)?)),
        None => (text, None),
    };
    let (what, start) = if let Some((what, time)) = rest.rsplit_once(" at ") {
        let start = match time.trim_end().strip_suffix(" of run") {
            Some(time) => Start::OfRun(nanoseconds(time).map_err(&wrong)?),
            None => Start::At(nanoseconds(time).map_err(&wrong)?),
        };
        (what, start)
    } else if let Some((what, condition)) = rest.rsplit_once(" when ") {
        (what, condition_of(condition, rig).map_err(&wrong)?)
    } else {
        return Err(wrong("it doesn't say when".to_string()));
    };
    let (node, effect) = match what.split_once('=') {
        Some((signal, value)) => {
            let signal = signal_of(signal.trim(), rig).map_err(&wrong)?;
            let SignalKind::Field(message, field) = signal.what else {
                return Err(wrong("only signals of devices can be set; a drive measures its own".to_string()));
            };
            let Kind::Frames(messages) = &rig.nodes[signal.node].kind else { unreachable!("a field has frames") };
            let value = quantity(value.trim(), Some(&messages[message].fields[field].unit)).map_err(&wrong)?;
            (signal.node, Effect::Value(message, field, value))
        }
        None => {
            let (name, words) = what.trim().split_once(' ').ok_or_else(|| wrong("it doesn't say what".to_string()))?;
            let node = node_of(name, rig).map_err(&wrong)?;
            if !matches!(rig.nodes[node].kind, Kind::Cia402(_)) {
                return Err(wrong(format!("`{name}` is a device: only its signals can be set")));
            }
            (node, effect_of(words.trim()).map_err(&wrong)?)
        }
    };
    Ok(Hook { node, effect, start, lasts_ns: lasts })
}

fn node_of(name: &str, rig: &Rig) -> Result<usize, String> {
    rig.nodes.iter().position(|node| node.name == name).ok_or_else(|| {
        let names: Vec<&str> = rig.nodes.iter().map(|node| node.name.as_str()).collect();
        format!("the rig has no `{name}`, only {}", names.join(", "))
    })
}

fn signal_of(text: &str, rig: &Rig) -> Result<Signal, String> {
    let (name, signal) = text.split_once('.').ok_or_else(|| format!("`{text}` is no signal"))?;
    let node = node_of(name, rig)?;
    let what = match &rig.nodes[node].kind {
        Kind::Cia402(_) => match signal {
            "torque" => SignalKind::Torque,
            "speed" => SignalKind::Speed,
            "position" => SignalKind::Position,
            _ => return Err(format!("a drive has torque, speed and position, no `{signal}`")),
        },
        Kind::Frames(messages) => {
            let place = messages.iter().enumerate().find_map(|(at, message)| {
                let field = message.fields.iter().position(|field| field.name == signal)?;
                Some(SignalKind::Field(at, field))
            });
            place.ok_or_else(|| format!("`{name}` has no signal `{signal}`"))?
        }
    };
    Ok(Signal { node, what })
}

fn condition_of(text: &str, rig: &Rig) -> Result<Start, String> {
    let (at, above) = match (text.find('>'), text.find('<')) {
        (Some(at), _) => (at, true),
        (None, Some(at)) => (at, false),
        (None, None) => return Err(format!("`{text}` is no comparison")),
    };
    let signal = signal_of(text[..at].trim(), rig)?;
    Ok(Start::When { signal, above, level: quantity(text[at + 1..].trim(), None)? })
}

/// A number with its unit, in SI; without a unit, in `unit`.
fn quantity(text: &str, unit: Option<&Unit>) -> Result<f64, String> {
    let (number, given) = text.split_once(' ').unwrap_or((text, ""));
    let number: f64 = number.parse().map_err(|_| format!("`{number}` is no number"))?;
    if !number.is_finite() {
        return Err(format!("{number} is no value"));
    }
    match (given.trim(), unit) {
        ("", Some(unit)) => Ok(unit.to_si(number)),
        ("", None) => Ok(number),
        (given, _) => Ok(Unit::parse(given)?.to_si(number)),
    }
}

fn nanoseconds(text: &str) -> Result<u64, String> {
    let (number, unit) =
        text.trim().split_once(' ').ok_or_else(|| format!("`{text}` is no time: its unit is missing"))?;
    let unit = unit.trim();
    if !matches!(unit, "s" | "ms" | "µs" | "us" | "min") {
        return Err(format!("`{text}` is no time"));
    }
    let seconds = quantity(&format!("{number} {}", if unit == "us" { "µs" } else { unit }), None)?;
    if !(0.0..1e9).contains(&seconds) {
        return Err(format!("`{text}` is no time of a run"));
    }
    Ok((seconds * 1e9).round() as u64)
}

fn effect_of(text: &str) -> Result<Effect, String> {
    let (words, last) = text.rsplit_once(' ').unwrap_or((text, ""));
    let code = || {
        let digits = last.strip_prefix("0x").ok_or_else(|| format!("`{last}` is no code such as 0x2310"))?;
        u16::from_str_radix(digits, 16).map_err(|_| format!("`{last}` is no code such as 0x2310"))
    };
    let counts = || last.parse().map_err(|_| format!("`{last}` is no number of counts"));
    let factor =
        || last.parse().ok().filter(|factor: &f64| factor.is_finite()).ok_or_else(|| format!("`{last}` is no factor"));
    Ok(match (text, words) {
        ("pre-operational", _) => Effect::PreOperational,
        ("reset", _) => Effect::Reset,
        ("no heartbeat", _) => Effect::NoHeartbeat,
        ("encoder frozen", _) => Effect::EncoderFrozen,
        ("no answers", _) => Effect::NoAnswers,
        ("ignores commands", _) => Effect::IgnoresCommands,
        ("safe torque off", _) => Effect::SafeTorqueOff,
        ("silent", _) => Effect::Silent,
        (_, "emergency") => Effect::Emergency(code()?),
        (_, "fault") => Effect::Fault(code()?),
        (_, "mode") => Effect::ModeShown(last.parse().map_err(|_| format!("`{last}` is no mode"))?),
        (_, "encoder glitch") => Effect::EncoderGlitch(counts()?),
        (_, "encoder lost") => Effect::EncoderLost(counts()?),
        (_, "encoder scale") => Effect::EncoderScale(factor()?),
        (_, "speed scale") => Effect::SpeedScale(factor()?),
        (_, "torque told scale") => Effect::TorqueToldScale(factor()?),
        (_, "torque scale") => Effect::TorqueScale(factor()?),
        _ => match text.strip_prefix("answers late ") {
            Some(time) => Effect::AnswersLate(nanoseconds(time)?),
            None => return Err(format!("nothing is known of `{text}`, only: {}", WORDS.join(", "))),
        },
    })
}
