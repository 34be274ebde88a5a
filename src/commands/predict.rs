//! `fric predict`: reports, before anything moves, whether an emulated contact is stable, and which resolutions are too
//! coarse for it.
//!
//! The loops come from `loop_stability`, analysed by runtime::coupling::loop_stability. Advice consists of numbers.

use super::{End, chosen_rig, load};
use crate::args::Predict as Args;
use crate::compile::{self, Changes, CompiledRig, Loaded, Options, Stopwatch};
use crate::loop_stability::{Contact, contacts};
use crate::quantity::significant;
use crate::report;
use crate::terminal::Terminal;
use abi::Slot;
use abi::description::{Kind as QuantityKind, Quantity};
use abi::rig::Kind;
use grammar::ast::{ExperimentStatement, Item};
use runtime::coupling::eigenvalues::modes;
use runtime::coupling::loop_stability::Loop;
use runtime::engine::{self, Continue};
use runtime::hil::standard::{self, Figures, Pair};
use runtime::hil::watches;
use serde_json::{Value, json};

pub fn predict(args: &Args, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load(&args.file, terminal, &mut watch) else { return End::Failed };
    let name = match chosen(args, &loaded) {
        Ok(name) => name,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let set = args.set.texts();
    let options = Options { changes: args.set.changes(), interpret: false };
    let mut found = Vec::new();
    let ready = compile::rig(&mut loaded, &crate::disk::Disk, &name, &options, &mut found);
    found.extend(ready.as_ref().err().into_iter().flatten().cloned());
    if !found.is_empty() && (!args.json || ready.is_err()) {
        terminal.report(&report::full(&loaded.files.0, &found, terminal.error_colour()));
    }
    let Ok(ready) = ready else { return End::Failed };
    let contacts = contacts(&ready);
    let (mut words, mut all, mut stable) = (String::new(), Vec::new(), true);
    for contact in &contacts {
        let (text, object, holds) = judged(&ready, contact);
        words += &text;
        all.push(object);
        stable &= holds;
    }
    if ready.rig.predict.is_none() && !contacts.is_empty() {
        let one = |contact: &Contact| {
            let tau = 0.5 * ready.rig.period_ns as f64 * 1e-9 + contact.late.dead + contact.late.lag;
            format!("`predict {}` lets commands look {} ms ahead", contact.drive, significant(1e3 * tau, 3))
        };
        let all: Vec<String> = contacts.iter().map(one).collect();
        let which = if all.len() > 1 { "; a rig has one of them" } else { "" };
        words += &format!("            {}{which}\n", all.join(", or "));
    }
    if contacts.is_empty() {
        words += "stability   no drive emulates a contact: no torque answers the speed of the shaft\n";
    }
    let (text, resolution) = resolution(&ready);
    words += &text;
    let (text, step) = step_time(&ready);
    words += &text;
    let (mut twin, mut figures) = (Value::Null, Value::Null);
    if let Some(experiment) = &args.experiment {
        match twins(&mut loaded, &ready, experiment, &set) {
            Ok((text, object)) => (words, twin) = (words + &text, object),
            Err(errors) => {
                terminal.report(&report::full(&loaded.files.0, &errors, terminal.error_colour()));
                return End::Failed;
            }
        }
    } else {
        let (text, object) = standard(&ready);
        (words, figures) = (words + &text, object);
    }
    match args.json {
        true => {
            let object = json!({"rig": name, "stable": stable, "contacts": all, "resolution": resolution, "step": step, "standard": figures, "twin": twin});
            terminal.line(&object.to_string());
        }
        false => terminal.print(&words),
    }
    if stable { End::Fine } else { End::Failed }
}

/// The requested rig: the one named, the one that the experiment runs, or the only one.
fn chosen(args: &Args, loaded: &Loaded) -> Result<String, String> {
    let run = args.experiment.as_ref().map(|name| run_by(name, args, loaded)).transpose()?;
    chosen_rig(&args.file, args.rig.as_deref().or(run.as_deref()), loaded)
}

/// The rig that an experiment runs.
fn run_by(name: &str, args: &Args, loaded: &Loaded) -> Result<String, String> {
    let file = args.file.display();
    let ast = &loaded.files.get(loaded.root()).ast;
    let experiment = ast.items().find_map(|item| match item {
        Item::Experiment(one) if one.name.text == name => Some(one),
        _ => None,
    });
    let run = experiment.ok_or(format!("{file} has no experiment `{name}`"))?.body.iter().find_map(|one| match one {
        ExperimentStatement::Run(run) => Some(run.instance.model.text.clone()),
        _ => None,
    });
    let of_a_rig = |run: &String| loaded.rigs().iter().any(|rig| rig.name.text == *run);
    run.filter(of_a_rig).ok_or(format!("experiment `{name}` runs no rig of {file}"))
}

/// Stability of one contact at rest, at the Stribeck speed and while sliding, with remedies.
fn judged(ready: &CompiledRig, contact: &Contact) -> (String, Value, bool) {
    let period = ready.rig.period_ns as f64 * 1e-9;
    let tau = 0.5 * period + contact.late.dead + contact.late.lag;
    let ms = |seconds: f64| significant(1e3 * seconds, 3);
    let speeds = params(ready, |unit| unit.ends_with("rad/s"));
    let smallest =
        speeds.iter().map(|(_, value)| *value).filter(|v| *v > 0.0 && v.is_finite()).fold(f64::INFINITY, f64::min);
    let mut points = vec![("presliding", 0.0)];
    if smallest.is_finite() {
        points.push(("stribeck", smallest));
        points.push(("sliding", 100.0 * smallest));
    }
    let standing = contact.standing(ready);
    let (mut words, mut regimes, mut stable) = (String::new(), Vec::new(), true);
    for (regime, speed) in points {
        let near = contact.at(ready, &[], speed);
        let radius = near.radius();
        // A falling characteristic is unstable by itself, on the real shaft as well as on the rig, so the verdict is
        // only on rest.
        let limit = (regime == "presliding").then(|| near.limit(0)).flatten();
        words += &format!("{regime:<11} {}  radius {}", contact.drive, significant(radius, 4));
        if regime == "presliding" {
            stable &= standing.is_stable();
            match limit {
                Some(limit) => {
                    let total = limit - contact.late.dead + tau;
                    words += &format!(
                        "  delay margin {} ms (tau {}, limit {})",
                        ms(limit - contact.late.dead),
                        ms(tau),
                        ms(total)
                    );
                }
                None => words += "  no delay up to 40 periods makes it unstable",
            }
            words += if radius < 1.0 { "  stable" } else { "  UNSTABLE" };
        }
        words += "\n";
        let margin = limit.map(|limit| limit - contact.late.dead);
        regimes.push(json!({"regime": regime, "speed": speed, "radius": radius, "delay_margin": margin}));
    }
    let ahead = contact.looking(contact.at(ready, &[], 0.0)).zip(standing.ahead);
    let ahead = ahead.map(|(ahead, radius)| {
        let limit = ahead.limit();
        words += &format!("look ahead  {}  radius {}", contact.drive, significant(radius, 4));
        let margin = limit.map(|limit| limit - contact.late.dead);
        words += &match margin {
            Some(margin) => format!("  delay margin {} ms (tau {}, limit {})", ms(margin), ms(tau), ms(margin + tau)),
            None => "  no delay up to 40 periods makes it unstable".into(),
        };
        words += if radius < 1.0 { "  stable\n" } else { "  UNSTABLE\n" };
        json!({"radius": radius, "delay_margin": margin})
    });
    let (text, resonances) = resonances(ready, contact);
    words += &text;
    let (text, advice) = advised(ready, contact, tau);
    words += &text;
    let object = json!({
        "drive": contact.drive, "tau": tau, "regimes": regimes, "look_ahead": ahead, "resonances": resonances,
        "advice": advice
    });
    (words, object, stable)
}

/// The lowest resonance in rad/s with which the shaft counts as rigid: 6 times (1 − θ)/T, the poles of the predictor's
/// observer, for θ = 0.9 and a period T of 1 ms.
const RIGID: f64 = 6.0 * (1.0 - 0.9) / 1e-3;

/// The resonances of the shaft alone.
fn resonances(ready: &CompiledRig, contact: &Contact) -> (String, Value) {
    let (states, a) = contact.shaft();
    let (mut words, mut out) = (String::new(), Vec::new());
    for mode in modes(states, a).unwrap_or_default().iter().filter(|mode| mode.imaginary > 0.0) {
        let hertz = mode.frequency() / (2.0 * std::f64::consts::PI);
        words += &format!("resonance   {} Hz", significant(hertz, 3));
        if let Some(damping) = mode.damping() {
            words += &format!("  damping {}", significant(damping, 2));
        }
        if ready.rig.predict.is_some() && mode.frequency() < RIGID {
            let least = RIGID / (2.0 * std::f64::consts::PI);
            words += &format!("  too low to look ahead, which needs {} Hz", significant(least, 3));
        }
        words += "\n";
        out.push(json!({"frequency": hertz, "damping": mode.damping()}));
    }
    (words, Value::Array(out))
}

/// The parameter that sets the contact's stiffness, with its largest stable value; the one that sets its damping, with
/// the value that allows the most delay.
fn advised(ready: &CompiledRig, contact: &Contact, tau: f64) -> (String, Value) {
    let here = contact.at(ready, &[], 0.0);
    let own = contact.stiffness(&here);
    let damping = |near: &Loop| near.step.d.iter().sum::<f64>().abs();
    let moved = |of: &dyn Fn(&Loop) -> f64, slot: Slot, value: f64| {
        let other = contact.at(ready, &[(slot, 1.01 * value)], 0.0);
        (of(&other) - of(&here)) / (0.01 * of(&here)).max(1e-300)
    };
    let stiff = |near: &Loop| contact.stiffness(near);
    let springs = params(ready, |unit| unit.ends_with("/rad") && !unit.contains("s/rad"));
    let dampers = params(ready, |unit| unit.ends_with("s/rad"));
    let strongest = |all: Vec<(Quantity, f64)>, of: &dyn Fn(&Loop) -> f64| {
        let by = all.into_iter().map(|(q, value)| (moved(of, q.slot, value), q, value));
        by.filter(|(share, ..)| *share > 0.3).max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, q, value)| (q, value))
    };
    let (mut words, mut out) = (String::new(), serde_json::Map::new());
    if own > 0.0
        && let Some((spring, value)) = strongest(springs, &stiff)
    {
        let stable = |factor: f64| contact.at(ready, &[(spring.slot, factor * value)], 0.0).is_stable();
        let (mut low, mut high) = (1e-4, 1.0);
        while stable(high) && high < 1e4 {
            (low, high) = (high, 2.0 * high);
        }
        for _ in 0..30 {
            let middle = 0.5 * (low + high);
            if stable(middle) { low = middle } else { high = middle }
        }
        let most = low * value;
        words += &format!(
            "            {} up to {} {} (it is {})\n",
            spring.path,
            significant(spring.unit.from_si(most), 3),
            spring.unit,
            significant(spring.unit.from_si(value), 3)
        );
        out.insert("stiffness".into(), json!({"param": spring.path, "value": value, "largest_stable": most}));
    }
    if let Some((damper, value)) = strongest(dampers, &damping) {
        let limit = |factor: f64| {
            contact.at(ready, &[(damper.slot, factor * value)], 0.0).limit(0).map_or(f64::INFINITY, |limit| limit)
        };
        let (mut best, mut most, mut factor) = (1.0, limit(1.0), 0.1);
        while factor < 10.0 {
            let found = limit(factor);
            if found > most {
                (best, most) = (factor, found);
            }
            factor *= 1.15;
        }
        let total = Some(most - contact.late.dead + tau).filter(|total| total.is_finite());
        words += &format!(
            "advice      {} = {} {} allows {} (it is {})\n",
            damper.path,
            significant(damper.unit.from_si(best * value), 3),
            damper.unit,
            match total {
                Some(total) => format!("the most delay, {} ms", significant(1e3 * total, 3)),
                None => "any delay up to 40 periods".into(),
            },
            significant(damper.unit.from_si(value), 3)
        );
        out.insert(
            "damping".into(),
            json!({"param": damper.path, "value": value, "best": best * value, "limit": total}),
        );
    }
    (words, Value::Object(out))
}

/// Parameters whose unit satisfies a condition, with their values.
fn params(ready: &CompiledRig, unit: impl Fn(&str) -> bool) -> Vec<(Quantity, f64)> {
    let all = ready.control.description().quantities.iter();
    all.filter(|q| q.kind == QuantityKind::Param && unit(&q.unit.text))
        .map(|q| (q.clone(), ready.control.get(q.slot)))
        .collect()
}

/// Resolution in presliding in counts, steps of torque, and bus load.
fn resolution(ready: &CompiledRig) -> (String, Value) {
    let rig = &ready.rig;
    let (mut words, mut out) = (String::new(), Vec::new());
    let quantities = &ready.control.description().quantities;
    for node in &rig.nodes {
        let Kind::Cia402(drive) = &node.kind else { continue };
        let state = quantities
            .iter()
            .filter(|q| q.kind == QuantityKind::State && q.unit.text.ends_with("rad") && q.range.1.is_finite())
            .min_by(|a, b| (a.range.1 - a.range.0).total_cmp(&(b.range.1 - b.range.0)));
        let counts = state.map(|state| 0.5 * (state.range.1 - state.range.0) / drive.count);
        let force = params(ready, |unit| unit.ends_with("N·m"));
        let least = force.iter().map(|(_, value)| *value).filter(|value| *value > 0.0).fold(f64::INFINITY, f64::min);
        let step = 1e-3 * drive.rated_torque;
        let share = (step > 0.0 && least.is_finite()).then(|| least / step);
        words += &format!("resolution  {}", node.name);
        if let (Some(state), Some(counts)) = (state, counts) {
            words += &format!("  {} spans {} counts either way", state.path, significant(counts, 3));
        }
        if let Some(share) = share {
            words +=
                &format!("  torque step {} N·m = the smallest force / {}", significant(step, 3), significant(share, 3));
        }
        words += "\n";
        out.push(
            json!({"drive": node.name, "presliding_counts": counts, "torque_step": step, "smallest_force": least}),
        );
    }
    let mut buses = Vec::new();
    for (k, bus) in rig.buses.iter().enumerate() {
        let load = compile::bus_load(rig, k) / f64::from(bus.bit_rate.max(1));
        words += &format!("bus         {}  {} % in the worst case\n", bus.name, significant(100.0 * load, 3));
        buses.push(json!({"bus": bus.name, "load": load}));
    }
    (words, json!({"drives": out, "buses": buses}))
}

/// The time of a step on this machine, also as a fraction of its period.
fn step_time(ready: &CompiledRig) -> (String, Value) {
    let (median, greatest) = watches::step_time(&ready.rig, &ready.control);
    let period = ready.rig.period_ns as f64 * 1e-9;
    let mut words = format!(
        "step        {} here, at most {}, of {}\n",
        crate::quantity::duration(median, 3),
        crate::quantity::duration(greatest, 3),
        crate::quantity::duration(period, 3)
    );
    let ends: Vec<Slot> = ready.rig.stops.iter().map(|stop| stop.slot).collect();
    let stable = compile::largest_stable(&ready.program, &ends, ready.rig.method);
    if let Some(stable) = stable {
        let step = crate::quantity::duration(period / f64::from(ready.rig.steps), 3);
        let most = compile::stable_up_to(stable);
        words += &format!("            {} takes {step}, largest stable step {most}\n", ready.rig.method.name());
    }
    (words, json!({"median": median, "greatest": greatest, "period": period, "largest_stable": stable}))
}

/// Each contact alone compared with the emulated one, in a standard set of motions.
fn standard(ready: &CompiledRig) -> (String, Value) {
    let (mut words, mut out) = (String::new(), Vec::new());
    for found in standard::standard(&ready.rig, &ready.control, &ready.plant) {
        let Figures { holds, break_away, ripple, loop_area, slips, stick_slip_error, curve_error, node } = found;
        let drive = &ready.rig.nodes[node].name;
        let pair = |pair: Pair, digits: usize| [pair.played, pair.own].map(|value| significant(value, digits));
        let [breaks, own_breaks] = pair(break_away, 3);
        let [ripples, own_ripples] = pair(ripple, 2);
        let [slipped, own_slips] = pair(slips, 2);
        let percent = |share: f64| significant(100.0 * share, 2);
        words += &format!("standard    {drive}  breaks away at {breaks} N·m, the contact itself at {own_breaks}\n");
        words += &format!(
            "            sticks and slips: {slipped} slips for {own_slips}, torque within {} % rms of {} N·m\n",
            percent(stick_slip_error),
            significant(holds, 3)
        );
        words += &format!("            held at half of it: ripple {ripples} rad/s for {own_ripples}\n");
        words += &format!(
            "            F(v) within {} %, hysteresis {} % of its area\n",
            percent(curve_error),
            percent(loop_area.played / loop_area.own)
        );
        let both = |pair: Pair| json!({"played": pair.played, "own": pair.own});
        out.push(json!({
            "drive": drive, "holds": holds, "break_away": both(break_away), "ripple": both(ripple),
            "loop_area": both(loop_area), "slips": both(slips), "stick_slip_error": stick_slip_error,
            "curve_error": curve_error
        }));
    }
    (words, Value::Array(out))
}

/// The SIL run compared with one whose drives act without delay: the differences of the plotted quantities.
fn twins(
    loaded: &mut Loaded,
    ready: &CompiledRig,
    experiment: &str,
    set: &[String],
) -> Result<(String, Value), Vec<grammar::diagnostic::Diagnostic>> {
    let mut at_once = set.to_vec();
    for node in ready.rig.nodes.iter().filter(|node| node.moves) {
        at_once.extend([format!("{}.delay=0 s", node.name), format!("{}.lag=0 s", node.name)]);
    }
    let mut case = |set: Vec<String>| {
        let options = Options { changes: Changes { set, ..Changes::default() }, interpret: false };
        compile::compile(loaded, &crate::disk::Disk, experiment, &options, &mut Vec::new(), &mut |_| ())
    };
    let (late, ideal) = (case(set.to_vec())?.swap_remove(0), case(at_once)?.swap_remove(0));
    let mut series: Vec<(String, Slot, abi::unit::Unit)> = Vec::new();
    for one in late.experiment.plots.iter().flat_map(|plot| plot.series.iter().chain(&plot.against)) {
        if one.slot != Slot::TIME && !one.boolean && !series.iter().any(|(_, slot, _)| *slot == one.slot) {
            series.push((one.label.clone(), one.slot, one.unit.clone()));
        }
    }
    let slots: Vec<Slot> = series.iter().map(|(_, slot, _)| *slot).collect();
    let duration = late.experiment.duration;
    let instants: Vec<f64> = (0..=4000).map(|k| duration * f64::from(k) / 4000.0).collect();
    let course = |case: &compile::Case| {
        engine::sample(case.instance.clone(), &case.experiment, &instants, &slots, &mut |_| Continue::Continue(()))
    };
    let ((ours, ended), (theirs, _)) = (course(&late), course(&ideal));
    let (mut words, mut out) = (String::new(), Vec::new());
    for (k, (label, _, unit)) in series.iter().enumerate() {
        let of = |values: &[f64]| values.iter().skip(k).step_by(slots.len()).copied().collect::<Vec<f64>>();
        let (ours, theirs) = (of(&ours), of(&theirs));
        let spread = |values: &[f64]| {
            let ends = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
            ends.1 - ends.0
        };
        let squares: f64 = ours.iter().zip(&theirs).map(|(a, b)| (a - b) * (a - b)).sum();
        let rms = (squares / ours.len().max(1) as f64).sqrt();
        let share = 100.0 * rms / spread(&theirs).max(f64::MIN_POSITIVE);
        words += &format!(
            "twin        {label}  differs by {} % of its range (rms {} {unit})\n",
            significant(share, 2),
            significant(unit.from_si(rms), 3)
        );
        out.push(json!({"series": label, "rms": rms, "range": spread(&theirs), "share": 0.01 * share}));
    }
    if let Err(failure) = ended {
        words += &format!("twin        {failure}\n");
    }
    Ok((words, json!({"experiment": experiment, "series": out})))
}
