//! Warnings before a rig moves: contacts too stiff for the delay of the loop, and resolutions of encoder, speed and
//! torque too coarse for the model.
//!
//! In: both programs and the plan. Out: warnings, and the inertia for the plan. Uses the approximate delay limit of
//! docs/prediction.md; `fric predict` computes the limit from the compiled step.

use super::RigSpans;
use crate::analysis::linearise::{Linear, Matrices, PortSlots};
use crate::frontend::system::{Definition, ExprId, Node, System, Var, VarId, VarKind};
use crate::ir::interpret::Interpreter;
use crate::ir::program::Program;
use abi::description::{Kind as QuantityKind, Quantity};
use abi::format::{quantity, three_digits};
use abi::rig::{Kind, Mode, Rig, Signal, SignalKind};
use abi::series::Method;
use abi::table::Code;
use abi::unit::{Angle, Dimension, Unit};
use abi::{Instance, Slot};
use grammar::diagnostic::Diagnostic;
use std::sync::Arc;

/// Least number of encoder counts within the range of a state.
const COUNTS: f64 = 20.0;
/// Greatest resolution of the speed as a share of the smallest speed.
const SPEED_SHARE: f64 = 0.2;
/// Greatest resolution of the torque as a share of the smallest force.
const TORQUE_SHARE: f64 = 0.02;

const SPEED: Dimension = Dimension::of([0, 0, -1, 0, 0]);
const TORQUE: Dimension = Dimension::of([1, 2, -2, 0, 0]);

/// The linearisation of a program at its start, between slots, and its number of states. `None` if a slot is not an
/// input or output of the expected kind.
pub fn linear(program: &Program, inputs: &[Slot], outputs: &[Slot]) -> Option<(Matrices, usize)> {
    let description = Arc::new(program.description.clone());
    let functions = crate::codegen::tiering::functions(program, Method::Adaptive);
    let interpreter = Interpreter::new(&functions, &description.layout, description.pool.len());
    let mut instance = Instance::new(description.clone(), Code::Interpreted(Arc::new(interpreter)), &program.params);
    instance.start(0.0);
    let named = |slots: &[Slot]| slots.iter().map(|slot| (String::new(), *slot)).collect::<Vec<_>>();
    let ports: PortSlots = (named(inputs), named(outputs));
    let mut linear = Linear::new(program, instance, None, &ports, &[]);
    let fits = linear.inputs.len() == inputs.len() && linear.outputs.len() == outputs.len();
    let states = linear.states.len();
    fits.then(|| (linear.at(), states))
}

/// The moment of inertia that a torque accelerates, in kg·m², from the linearisation of the plant at its start. `None`
/// if no torque is applied, or if it does not directly accelerate the measured speed.
pub fn inertia(rig: &Rig, plant: &Program) -> Option<f64> {
    let (_, torque) = rig.plant.applied.iter().find(|(signal, _)| signal.what == SignalKind::Torque)?;
    let (_, speed) = rig.plant.seen.iter().find(|(signal, _)| signal.what == SignalKind::Speed)?;
    let (m, n) = linear(plant, &[*torque], &[*speed])?;
    let gain: f64 = (0..n).map(|i| m.c[i] * m.b[i]).sum();
    (gain != 0.0 && gain.is_finite()).then(|| 1.0 / gain.abs())
}

/// All warnings of a rig. `system`: that of the control program.
pub fn check(rig: &Rig, system: &System, control: &Program, plant: &Program, places: &RigSpans) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    emulation(rig, control, plant, places, &mut found);
    resolution(rig, system, control, places, &mut found);
    unproven(rig, places, &mut found);
    found
}

/// Warns about drives with frames described by hand or by a DBC file: such descriptions cannot show that the drive
/// stops when the computer fails.
fn unproven(rig: &Rig, places: &RigSpans, found: &mut Vec<Diagnostic>) {
    for (k, node) in rig.nodes.iter().enumerate() {
        if node.moves && matches!(node.kind, Kind::Frames(_)) {
            let warning = Diagnostic::warning(
                "W0807",
                format!("`{}` cannot show that it stops when the computer dies", node.name),
            )
            .label(places.nodes.get(k).copied().unwrap_or(places.name), "no heartbeat to watch, no time-out to test");
            found.push(warning.help("see to it otherwise, by a relay or a time-out of the drive's own, and say so:\n`allow no-drive-timeout \"...\"`"));
        }
    }
}

/// Response of a command to a signal near rest: stiffness K in N·m/rad and damping B in N·m·s/rad, both resisting.
struct ContactResponse {
    stiffness: f64,
    damping: f64,
}

/// A contact that a program computes from the measured speed and a drive applies with a delay τ.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Emulated {
    /// Natural frequency √(K/J), rad/s.
    pub natural: f64,
    /// Damping ratio B / (2 √(K J)).
    pub damping_ratio: f64,
    /// Period of the program, s.
    pub period: f64,
    /// Time constant of the drive, s.
    pub lag: f64,
}

impl Emulated {
    /// The total delay τ = T/2 + dead time + lag, in s, above which the contact is unstable.
    ///
    /// The program integrates the speed over the coming period before it outputs the force, so its spring leads its
    /// damper by half a period. Source: the crossing of the imaginary axis of J s² (1 + s l) + (B s + K e^{s T/2})
    /// e^{−s (τ − l)} for a lag l; within 4 % of the limit of the sampled loop (`runtime::coupling::loop_stability`).
    #[allow(
        clippy::disallowed_methods,
        reason = "a warning's limit: shown with three digits, decides nothing that runs"
    )]
    pub fn limit(self) -> f64 {
        let (zeta, lead, lag) =
            (self.damping_ratio.max(0.0), 0.5 * self.period * self.natural, self.lag * self.natural);
        // The lead is limited to a quarter turn: beyond it the period does not resolve the spring at all.
        let turn = |w: f64| (w * lead).min(std::f64::consts::FRAC_PI_2);
        // Solves |w² (1 + jwl)| = |2 ζ j w + e^{jw lead}| by bisection, with w in units of the natural frequency.
        let (mut low, mut high) = (0.0, 2.0 + 2.0 * zeta);
        for _ in 0..60 {
            let w = 0.5 * (low + high);
            let size = 1.0 + 4.0 * zeta * zeta * w * w + 4.0 * zeta * w * turn(w).sin();
            if w.powi(4) * (1.0 + w * w * lag * lag) < size { low = w } else { high = w }
        }
        let phase = (2.0 * zeta * low + turn(low).sin()).atan2(turn(low).cos());
        (phase - (low * lag).atan()) / (low * self.natural) + self.lag
    }

    /// The greatest natural frequency that a delay permits, in rad/s, and the damping ratio at which it occurs.
    pub fn stiffest(period: f64, lag: f64, tau: f64) -> (f64, f64) {
        let stable = |natural: f64, damping_ratio: f64| Emulated { natural, damping_ratio, period, lag }.limit() > tau;
        let ratios = (5..=150).map(|k| f64::from(k) * 0.01);
        let most = |ratio: f64| {
            let (mut low, mut high) = (0.1 / tau, 3.0 / tau);
            for _ in 0..40 {
                let middle = 0.5 * (low + high);
                if stable(middle, ratio) { low = middle } else { high = middle }
            }
            low
        };
        ratios.map(|ratio| (most(ratio), ratio)).fold((0.0, 0.0), |best, one| if one.0 > best.0 { one } else { best })
    }
}

fn emulation(rig: &Rig, control: &Program, plant: &Program, places: &RigSpans, found: &mut Vec<Diagnostic>) {
    let Some(inertia) = rig.plant.inertia else { return };
    let period = rig.period_ns as f64 * 1e-9;
    for (k, output) in rig.outputs.iter().enumerate() {
        let node = &rig.nodes[output.signal.node];
        let Kind::Cia402(drive) = &node.kind else { continue };
        if drive.mode != Mode::Torque || rig.predict == Some(output.signal.node) {
            continue;
        }
        let tau = 0.5 * period + node.delay + node.lag + if drive.at_sync { period } else { 0.0 };
        let Some(contact) = contact(rig, control, plant, output.signal, output.slot, tau) else { continue };
        if contact.stiffness <= 0.0 {
            continue;
        }
        let natural = (contact.stiffness / inertia).sqrt();
        let zeta = 0.5 * contact.damping / (contact.stiffness * inertia).sqrt();
        let limit = Emulated { natural, damping_ratio: zeta, period, lag: node.lag }.limit();
        if tau < limit {
            continue;
        }
        let ms = |seconds: f64| three_digits(1e3 * seconds);
        let message = format!("`{}` emulates a contact that is too stiff for the delay of its loop", node.name);
        let (fastest, ratio) = Emulated::stiffest(period, node.lag, tau);
        let most = inertia * fastest * fastest;
        let help = format!(
            "the contact has {} N·m/rad with a damping ratio of {} on {} kg·m^2: stable up to {} ms, within 4 % (`fric \
             predict` computes it from the compiled step). At {} ms up to {} N·m/rad can be rendered, but with a damping \
             ratio of {}; or write `predict {}`",
            three_digits(contact.stiffness),
            three_digits(zeta),
            three_digits(inertia),
            ms(limit),
            ms(tau),
            three_digits(most),
            three_digits(ratio),
            node.name
        );
        let warning = Diagnostic::warning("W0801", message)
            .label(places.wires.get(k).copied().unwrap_or(places.name), format!("acts {} ms late", ms(tau)));
        found.push(warning.help(help));
    }
}

/// The response of one command to speed and position at rest, as resistance of the shaft.
fn contact(
    rig: &Rig,
    control: &Program,
    plant: &Program,
    command: Signal,
    slot: Slot,
    tau: f64,
) -> Option<ContactResponse> {
    // A contact responds to the speed; its integral acts as a spring. A response to the position is a controller.
    let speeds: Vec<Slot> =
        rig.inputs.iter().filter(|input| input.signal.what == SignalKind::Speed).map(|input| input.slot).collect();
    let (m, n) = linear(control, &speeds, &[slot])?;
    let width = speeds.len();
    let (mut stiffness, mut damping) = (0.0, 0.0);
    for j in 0..width {
        // A state that decays within the delay does not act as a spring.
        let held = |i: usize| m.a[i * n + i] > -0.1 / tau;
        stiffness -= (0..n).filter(|i| held(*i)).map(|i| m.c[i] * m.b[i * width + j]).sum::<f64>();
        damping -= m.d[j];
    }
    // The sign with which this drive turns the measured shaft.
    let (_, torque) = rig.plant.applied.iter().find(|(signal, _)| *signal == command)?;
    let (_, speed) = rig.plant.seen.iter().find(|(signal, _)| signal.what == SignalKind::Speed)?;
    let (p, states) = linear(plant, &[*torque], &[*speed])?;
    let gain: f64 = (0..states).map(|i| p.c[i] * p.b[i]).sum();
    let sign = if gain < 0.0 { -1.0 } else { 1.0 };
    Some(ContactResponse { stiffness: sign * stiffness, damping: sign * damping })
}

fn resolution(rig: &Rig, system: &System, control: &Program, places: &RigSpans, found: &mut Vec<Diagnostic>) {
    let quantities = &control.description.quantities;
    let shown = |value: f64, unit: &Unit| quantity(value, unit, 3);
    let used = |what: SignalKind, node: usize| rig.inputs.iter().any(|input| input.signal == Signal { node, what });
    let params = |dimension: Dimension, angular: bool, compared: &dyn Fn(&str) -> bool| {
        let all = quantities.iter().filter(|q| compared(&q.path)).filter(move |q| {
            let plain = !q.unit.text.contains("/rad");
            let fits = if angular { q.unit.angle == Angle::Angle } else { plain };
            q.kind == QuantityKind::Param && q.unit.dimension == dimension && fits
        });
        let value = |q: &&Quantity| {
            let layout = &control.description.layout;
            control.params.get(q.slot.index().wrapping_sub(layout.params.start as usize)).copied()
        };
        let positive = all.filter_map(|q| Some((q, value(&q)?))).filter(|(_, value)| *value > 0.0 && value.is_finite());
        positive.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(q, value)| (q.clone(), value))
    };
    for (k, node) in rig.nodes.iter().enumerate() {
        let Kind::Cia402(drive) = &node.kind else { continue };
        let place = places.nodes.get(k).copied().unwrap_or(places.name);
        let sees = used(SignalKind::Position, k) || used(SignalKind::Speed, k);
        let narrow = quantities
            .iter()
            .filter(|q| q.kind == QuantityKind::State && q.unit.dimension.is_none() && q.unit.angle == Angle::Angle)
            .map(|q| (q, (q.range.1 - q.range.0) / drive.count))
            .filter(|(_, counts)| *counts < COUNTS)
            .min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((state, counts)) = narrow.filter(|_| sees) {
            let message = format!("the encoder of `{}` is too coarse for `{}`", node.name, state.path);
            let warning = Diagnostic::warning("W0802", message)
                .label(place, format!("the range of the state spans {} counts", three_digits(counts)));
            let most = (state.range.1 - state.range.0) / COUNTS;
            let help =
                format!("a count of at most {} shows it; or observe the shaft with a `part`", shown(most, &state.unit));
            found.push(warning.help(help));
        }
        // A parameter of a law that is fed with a planned speed is not compared with the measured one.
        let speeds: Vec<&str> = rig
            .inputs
            .iter()
            .filter(|input| input.signal == Signal { node: k, what: SignalKind::Speed })
            .filter_map(|input| quantities.iter().find(|q| q.slot == input.slot))
            .map(|quantity| quantity.path.as_str())
            .collect();
        let compared = |path: &str| is_fed(system, path, &speeds);
        if let Some((param, value)) = params(SPEED, true, &compared).filter(|_| used(SignalKind::Speed, k))
            && drive.speed_unit > SPEED_SHARE * value
        {
            let message = format!("the speed of `{}` is too coarse for `{}`", node.name, param.path);
            let step = three_digits(drive.speed_unit / value * 100.0);
            let warning = Diagnostic::warning("W0803", message).label(place, format!("one step is {step} % of it"));
            let help = format!(
                "a `speed_unit` of at most {} would do; or take the speed from `position`, by a `part` that observes it",
                shown(SPEED_SHARE * value, &param.unit)
            );
            found.push(warning.help(help));
        }
        let commanded = rig.outputs.iter().any(|output| output.signal == Signal { node: k, what: SignalKind::Torque });
        if let Some((param, value)) = params(TORQUE, false, &|_| true).filter(|_| commanded)
            && 1e-3 * drive.rated_torque > TORQUE_SHARE * value
        {
            let message = format!("the torque of `{}` is too coarse for `{}`", node.name, param.path);
            let step = three_digits(0.1 * drive.rated_torque / value);
            let warning = Diagnostic::warning("W0804", message)
                .label(place, format!("one step, a thousandth of `T_rated`, is {step} % of it"));
            let most = 1e3 * TORQUE_SHARE * value;
            let help = format!("a drive of at most {} has steps fine enough", shown(most, &param.unit));
            found.push(warning.help(help));
        }
    }
}

/// Whether one of the sources reaches an input of the model to which a parameter belongs; true for the root, whose
/// equations may compare anything.
fn is_fed(system: &System, param: &str, sources: &[&str]) -> bool {
    let Some((owner, _)) = param.rsplit_once('.') else { return true };
    let inside = |var: &Var| var.kind == VarKind::Input && var.path.rsplit_once('.').is_some_and(|(of, _)| of == owner);
    let mut stack: Vec<VarId> = system.var_ids().filter(|id| inside(system.var(*id))).collect();
    let mut seen = vec![false; system.vars.len()];
    while let Some(id) = stack.pop() {
        if std::mem::replace(&mut seen[id.0 as usize], true) {
            continue;
        }
        let var = system.var(id);
        if sources.contains(&var.path.as_str()) {
            return true;
        }
        let mut nodes: Vec<ExprId> = match &var.definition {
            Definition::Missing | Definition::Free => Vec::new(),
            Definition::Value(value, _) | Definition::Held { value, .. } => vec![*value],
            Definition::Sampled { initial, next, .. } => vec![*initial, *next],
            Definition::Continuous { initial, rate, .. } => vec![*initial, *rate],
        };
        while let Some(node) = nodes.pop() {
            match system.node(node) {
                Node::Var(of) | Node::Rate(of) | Node::PathRate(of) => stack.push(*of),
                other => nodes.extend(other.operands()),
            }
        }
    }
    false
}
