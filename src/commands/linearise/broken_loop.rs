//! `fric linearise --loop PATH`: the loop broken at a signal, its margins, its Bode diagram.
//!
//! The derivatives come from the compiler's linearisation, the response from runtime::coupling::open_loop.

use crate::args::Linearise;
use crate::compile::Linear;
use crate::matrices::{self, Matrix};
use crate::plot::{self, Axis, Curve, Figure, Panel};
use crate::quantity::{duration, significant};
use crate::results::number;
use crate::terminal::{Style, Terminal};
use crate::{project, quantity};
use abi::Slot;
use runtime::coupling::eigenvalues::Mode;
use runtime::coupling::open_loop::{At, Hybrid, Margins, OpenLoop, Point, StateSpace, Unbroken};
use serde_json::{Value, json};
use std::f64::consts::TAU;

/// Reports the loop of a system at its operating point.
pub fn broken_loop(linear: &mut Linear, path: &str, args: &Linearise, terminal: &mut Terminal) -> Result<(), String> {
    let Some(found) = linear.loop_at() else { return Err(format!("`{path}` cannot be broken")) };
    let smoothed = found.smoothed;
    let hybrid = Hybrid {
        states: found.states,
        memory: found.memory,
        flow: found.flow,
        output: found.output,
        periods: found.periods,
    };
    let told = |why: Unbroken| {
        let help = match why {
            Unbroken::NoLoop => "; if it is at a limit there, take another one with --time or --at",
            Unbroken::Continuous(_) => "; break the loop at an output of the sampled code, such as ctl.u",
            Unbroken::Slower(..) => "; break the loop at an output of the slower block, with the inner loop closed",
            Unbroken::NoMultiple(..) => "; choose periods of which one divides the other",
            Unbroken::TooLong | Unbroken::NotFinite => "; give another point with --at or --time",
        };
        format!("the loop cannot be broken at `{path}`: {why}{help}")
    };
    let delay = args.delay.unwrap_or(0.0);
    let open = hybrid.open(delay, &mut |due| linear.tick_at(due).unwrap_or_default()).map_err(told)?;
    let bode = open.bode().map_err(told)?;
    let margins = open.margins(&bode).map_err(told)?;
    let mut wrote = Vec::new();
    if let Some(file) = &args.bode {
        let bytes = match plot::Kind::of(file) {
            Some(kind) => {
                let figure = args.look.titled(figure(linear, path, &open, &bode, &margins));
                plot::picture(&figure, &args.look.look(), kind)
            }
            None => table(&bode).into_bytes(),
        };
        wrote.push((file, bytes));
    }
    let matrices = open.state_space();
    if let Some(file) = &args.out {
        let period = [open.period.unwrap_or(0.0)];
        let bytes = match file.extension().and_then(|extension| extension.to_str()) {
            Some("npz") => matrices::npz(&named(&matrices, &period)),
            Some("mat") => matrices::mat(&named(&matrices, &period)),
            _ => format!("{}\n", object(linear, path, &open, &bode, &margins, smoothed)).into_bytes(),
        };
        wrote.push((file, bytes));
    }
    for (file, bytes) in &wrote {
        project::write(file, bytes).map_err(|error| format!("cannot write {}: {error}", file.display()))?;
    }
    if args.json {
        terminal.line(&object(linear, path, &open, &bode, &margins, smoothed).to_string());
        return Ok(());
    }
    let mut out = terminal.styled(Style::Bold, &linear.instance.description().name);
    out += &format!(" at t = {}; all in SI\n", duration(linear.instance.get(Slot::TIME), 3));
    out += &format!("  loop broken at {path}, {}\n", how(&open));
    if smoothed {
        out += "  a staircase (floor) counts as the line through it: quantisation is left out\n";
    }
    if !args.margins {
        out += &matrix_words(&named(&matrices, &[])[..]);
        out += &pole_words(&open, &open.poles().map_err(told)?);
    }
    out += &margin_words(&margins);
    terminal.print(&out);
    for (file, _) in &wrote {
        terminal.line(&format!("  wrote {}", file.display()));
    }
    Ok(())
}

/// `every 1 ms and held, 0.5 ms after its tick`
fn how(open: &OpenLoop) -> String {
    let late = match open.delay {
        0.0 => String::new(),
        delay => format!(", {} late", duration(delay, 3)),
    };
    match open.period {
        Some(period) => format!("computed every {} and held{late}", duration(period, 3)),
        None => format!("in continuous time{late}"),
    }
}

/// The matrices with their names, and the period as `T`.
fn named<'a>(found: &'a StateSpace, period: &'a [f64]) -> Vec<Matrix<'a>> {
    let n = found.states;
    let matrix = |name, rows, columns, values| Matrix { name, rows, columns, values };
    let mut all = vec![
        matrix("A", n, n, &found.a[..]),
        matrix("B", n, 1, &found.b),
        matrix("C", 1, n, &found.c),
        matrix("D", 1, 1, &found.d),
    ];
    if !period.is_empty() {
        all.push(matrix("T", 1, 1, period));
    }
    all
}

fn matrix_words(all: &[Matrix]) -> String {
    let mut out = String::new();
    for matrix in all {
        out += &format!("\n  {}\n", matrix.name);
        for row in matrix.values.chunks(matrix.columns.max(1)) {
            let cells: Vec<String> = row.iter().map(|entry| format!("{:>13}", significant(*entry, 6))).collect();
            out += &format!("  {}\n", cells.join("  "));
        }
    }
    out
}

fn pole_words(open: &OpenLoop, poles: &[Mode]) -> String {
    let title = if open.period.is_some() { "pole of z" } else { "pole of s" };
    let mut out = format!("\n  {title:>13}  {:>13}\n", "± i");
    for pole in poles {
        let imaginary = if pole.imaginary > 0.0 { significant(pole.imaginary, 5) } else { String::new() };
        out += &format!("  {:>13}  {imaginary:>13}\n", significant(pole.real, 5));
    }
    out
}

fn hertz(frequency: f64) -> String {
    format!("{} Hz", significant(frequency / TAU, 4))
}

fn decibels(factor: f64) -> f64 {
    #[allow(clippy::disallowed_methods, reason = "shown with three digits")]
    let log = factor.log10();
    20.0 * log
}

fn margin_words(margins: &Margins) -> String {
    let mut out = String::new();
    let mut line = |name: &str, text: String| out += &format!("  {name:<16}  {text}\n");
    let crossings: Vec<String> = margins.crossings.iter().map(|frequency| hertz(*frequency)).collect();
    line(
        "gain 1",
        if crossings.is_empty() { "at no frequency".into() } else { format!("at {}", crossings.join(", ")) },
    );
    let at = |at: &At| format!("at {}", hertz(at.frequency));
    let none = |what: &str| format!("none: {what}");
    let phase = margins.phase.as_ref().map(|phase| format!("{}° {}", significant(phase.value, 3), at(phase)));
    line("phase margin", phase.unwrap_or_else(|| none("the gain is 1 at no frequency")));
    let factor = |one: &At| {
        format!("{} dB {} (gain × {})", significant(decibels(one.value), 3), at(one), significant(one.value, 3))
    };
    let gain = margins.gain.as_ref().map(factor);
    line("gain margin", gain.unwrap_or_else(|| none("no larger gain makes the phase −180° at gain 1")));
    if let Some(reduction) = &margins.reduction {
        line("gain reduction", factor(reduction));
    }
    let delay = margins.delay.as_ref().map(|delay| format!("{} {}", duration(delay.value, 3), at(delay)));
    line("delay margin", delay.unwrap_or_else(|| none("the gain is 1 at no frequency")));
    let most = &margins.sensitivity;
    line("sensitivity", format!("at most {} {}", significant(most.value, 3), at(most)));
    out + match (margins.stable, margins.neutral) {
        (true, _) => "  the closed loop is stable\n",
        (false, true) => {
            "  the closed loop is neutral: some deviations neither decay nor grow, as of a contact at rest\n"
        }
        (false, false) => "  the closed loop is unstable\n",
    }
}

/// Frequency, gain and phase as CSV.
fn table(bode: &[Point]) -> String {
    let mut out = String::from("f [Hz],gain [dB],phase [deg]\n");
    for point in bode {
        out += &format!("{},{},{}\n", point.frequency / TAU, decibels(point.gain), point.phase);
    }
    out
}

/// Gain and phase over the frequency, with the lines that decide about stability.
fn figure(linear: &Linear, path: &str, open: &OpenLoop, bode: &[Point], margins: &Margins) -> Figure {
    let ends = [bode.first(), bode.last()].map(|point| point.map_or(1.0, |point| point.frequency / TAU));
    let panel = |name: &str, unit: &str, line: f64, of: &dyn Fn(&Point) -> f64, least: f64| {
        let points = bode.iter().map(|point| (point.frequency / TAU, of(point)));
        let points: Vec<(f64, f64)> = points.filter(|(_, y)| *y >= least).collect();
        let from = points.first().map_or(ends[0], |point| point.0);
        let curve = Curve { name: name.into(), points, ..Curve::default() };
        let limit = Curve {
            name: format!("{} {unit}", quantity::significant(line, 3)),
            points: vec![(from, line), (ends[1], line)],
            style: Some((7, 1)),
            ..Curve::default()
        };
        Panel {
            x: Axis { name: "frequency".into(), unit: "Hz".into(), logarithmic: true, range: None },
            y: Axis { name: name.into(), unit: unit.into(), ..Axis::default() },
            curves: vec![curve, limit],
            legend: false,
            ..Panel::default()
        }
    };
    let gain = |point: &Point| decibels(point.gain);
    let mut subtitle = vec![how(open)];
    if let Some(phase) = &margins.phase {
        subtitle.push(format!("{}° at {}", significant(phase.value, 3), hertz(phase.frequency)));
    }
    if let Some(limit) = &margins.gain {
        subtitle.push(format!("{} dB at {}", significant(decibels(limit.value), 3), hertz(limit.frequency)));
    }
    if margins.neutral {
        subtitle.push("neutral when closed".into());
    } else if !margins.stable {
        subtitle.push("unstable when closed".into());
    }
    Figure {
        title: format!("{}: loop at {path}", linear.instance.description().name),
        subtitle: subtitle.join(" · "),
        panels: vec![
            panel("gain", "dB", 0.0, &gain, -200.0),
            panel("phase", "°", -180.0, &|point| point.phase, f64::MIN),
        ],
    }
}

fn object(linear: &Linear, path: &str, open: &OpenLoop, bode: &[Point], margins: &Margins, smoothed: bool) -> Value {
    let space = open.state_space();
    let at = |at: &Option<At>| match at {
        Some(at) => json!({ "value": number(at.value), "frequency": number(at.frequency / TAU) }),
        None => Value::Null,
    };
    let numbers = |all: &[f64]| all.iter().map(|value| number(*value)).collect::<Value>();
    let rows = |all: &[f64], columns: usize| all.chunks(columns.max(1)).map(numbers).collect::<Value>();
    let column = |of: &dyn Fn(&Point) -> f64| bode.iter().map(|point| number(of(point))).collect::<Value>();
    json!({
        "model": linear.instance.description().name,
        "time": number(linear.instance.get(Slot::TIME)),
        "loop": path,
        "period": open.period.map(number),
        "delay": number(open.delay),
        "smoothed": smoothed,
        "stable": margins.stable,
        "neutral": margins.neutral,
        "crossings": margins.crossings.iter().map(|frequency| number(frequency / TAU)).collect::<Value>(),
        "phase_margin": at(&margins.phase),
        "gain_margin": at(&margins.gain),
        "gain_reduction": at(&margins.reduction),
        "delay_margin": at(&margins.delay),
        "sensitivity": at(&Some(margins.sensitivity)),
        "frequency": column(&|point| point.frequency / TAU),
        "gain": column(&|point| point.gain),
        "phase": column(&|point| point.phase),
        "A": rows(&space.a, space.states),
        "B": rows(&space.b, 1),
        "C": rows(&space.c, space.states),
        "D": rows(&space.d, 1),
    })
}
