//! Messages of a rig as text.

use super::counts::Counts;
use crate::realtime::histogram::Histogram;
use crate::safety::Cause;
use abi::Description;
use abi::format;
use abi::rig::{Kind, Rig, Signal, SignalKind};
use abi::unit::{Dimension, Unit};
use std::fmt::Write;

/// A signal as the text of a rig names it: `load.speed`.
pub fn signal(rig: &Rig, signal: Signal) -> String {
    let node = &rig.nodes[signal.node];
    let name = match (signal.what, &node.kind) {
        (SignalKind::Torque, _) => "torque",
        (SignalKind::Speed, _) => "speed",
        (SignalKind::Position, _) => "position",
        (SignalKind::Enabled, _) => "enabled",
        (SignalKind::Fault, _) => "fault",
        (SignalKind::Limited, _) => "limited",
        (SignalKind::Field(message, field), Kind::Frames(messages)) => &messages[message].fields[field].name,
        (SignalKind::Field(..), Kind::Cia402(_)) => "?",
    };
    format!("{}.{name}", node.name)
}

/// The SI unit of a signal of a node.
pub fn unit(rig: &Rig, signal: Signal) -> Unit {
    let named = |name: &str| Unit::parse(name).expect("a known unit");
    match (signal.what, &rig.nodes[signal.node].kind) {
        (SignalKind::Torque, _) => named("N·m"),
        (SignalKind::Speed, _) => named("rad/s"),
        (SignalKind::Position, _) => named("rad"),
        (SignalKind::Field(message, field), Kind::Frames(messages)) => {
            let dimension = messages[message].fields[field].unit.dimension;
            if dimension == Dimension::NONE { Unit::none() } else { Unit::si(dimension) }
        }
        (SignalKind::Enabled | SignalKind::Fault | SignalKind::Limited | SignalKind::Field(..), _) => Unit::none(),
    }
}

/// The reason for a stop. `trouble`: the message of a node, if that was the first cause.
pub fn cause(rig: &Rig, model: &Description, signals: &[Signal], cause: Cause, trouble: Option<&str>) -> String {
    let output = |i: usize| signal(rig, rig.outputs[i].signal);
    let drive = |i: usize| {
        let moving = rig.nodes.iter().filter(|node| node.moves).nth(i);
        moving.map_or("a drive".into(), |node| format!("`{}`", node.name))
    };
    let bus = |i: usize| rig.buses.get(i).map_or("a bus".into(), |bus| format!("bus `{}`", bus.name));
    let read = |i: usize| signals.get(i).map_or("a signal".into(), |at| signal(rig, *at));
    match cause {
        Cause::Asked => "asked to stop".into(),
        Cause::NotFinite(i) => format!("the model gave no number for {}", output(i)),
        Cause::Guard(status) => match model.guards.get(usize::try_from(status).unwrap_or(0).wrapping_sub(1)) {
            Some(guard) => {
                let (low, high) = guard.bounds(|bound| format::quantity(bound, &guard.unit, 3));
                format!("{} left its range {low} .. {high}", guard.path)
            }
            None => format!("the model could not go on (status {status})"),
        },
        Cause::Clamped(i) => format!("{} was outside its limits for too long", output(i)),
        Cause::Condition(i) => match rig.stops.get(i) {
            Some(stop) => format!("{} ({})", stop.why, stop.condition),
            None => "a condition of the rig holds".into(),
        },
        Cause::Overrun(missed) => {
            format!("the computer was too late: {missed} tick{} missed", if missed == 1 { "" } else { "s" })
        }
        Cause::Speed(i, speed) => format!("{} is too fast: {speed:.4} rad/s", drive(i)),
        Cause::Travel(i, position) => format!("{} is outside its travel: at {position:.4} rad", drive(i)),
        Cause::RunAway(i) => {
            format!("{} ran away: it got faster against the torque. Is a sign wrong?", drive(i))
        }
        Cause::Lost(i) => format!("{} no longer comes", read(i)),
        Cause::Implausible(i) => format!("{} jumps further than anything on this shaft can", read(i)),
        Cause::NotFollowing(_) | Cause::Drive(_) | Cause::Foreign(..) if trouble.is_some() => {
            trouble.unwrap_or_default().into()
        }
        Cause::NotFollowing(node) => format!("`{}` does not follow commands", rig.nodes[node].name),
        Cause::Drive(node) => format!("`{}` stopped by itself", rig.nodes[node].name),
        Cause::Foreign(i, id) => format!("{}: somebody else sends frame 0x{id:03X}", bus(i)),
        Cause::Bus(i) => format!("{} does not carry: is the cable in, is anybody there?", bus(i)),
        Cause::Overload(_) => "frames were lost: the bus carries more than can be read".into(),
        Cause::Unpredictable => {
            "the shaft does not move as its inertia and torques say: commands cannot look ahead".into()
        }
        Cause::Energy => "more energy came back than the friction can hold: the loop is not stable".into(),
        Cause::Unwatched => "nobody watches any more: no page of the panel was drawn for the time of --dead-man".into(),
        Cause::Watchdog => "no cycle ended in time: the watchdog stopped the drives".into(),
    }
}

/// Counters as text, one line per group.
pub fn counts(counts: &Counts) -> String {
    let mut out = String::new();
    let micro = |ns: u64| ns as f64 * 1e-3;
    let quantiles = |h: &Histogram| {
        let [p50, p99] = [0.5, 0.99].map(|part| micro(h.quantile_ns(part)));
        format!("p50 {p50:.1}  p99 {p99:.1}  max {:.1}", micro(h.max_ns()))
    };
    let Counts { cycles, missed, overruns, stale, lost_frames, refused_frames, bus_errors, clamped, .. } = counts;
    let _ = writeln!(out, "cycles   {cycles}, {missed} missed in {overruns} overruns");
    if counts.late.total() > 0 {
        let _ = writeln!(out, "late µs  {}", quantiles(&counts.late));
        let each = [("receive", &counts.receive), ("compute", &counts.compute), ("send", &counts.send)];
        let phases =
            each.map(|(name, h)| format!("{name} {:.1} / {:.1}", micro(h.quantile_ns(0.5)), micro(h.max_ns())));
        let _ = writeln!(out, "phases µs  {}  (p50 / max)", phases.join("   "));
    }
    let [range, slew, power] = clamped;
    let _ = writeln!(out, "clamped  range {range}, slew {slew}, power {power}");
    let _ = writeln!(
        out,
        "frames   {stale} readings held, {lost_frames} lost, {refused_frames} not taken, {bus_errors} bus errors"
    );
    if let Some(coupling) = counts.coupling {
        let _ = writeln!(
            out,
            "coupling  {} cycles did not look ahead; at most {:.2} of the stored energy came back, {} warnings",
            coupling.unpredicted, coupling.returned_max, coupling.warnings
        );
    }
    let _ = writeln!(out, "log      {} messages dropped", counts.log_dropped);
    out
}
