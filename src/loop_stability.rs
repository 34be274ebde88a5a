//! Stability of the contacts that a rig's drives emulate: for `fric predict`, and before anything moves.
//!
//! In: a compiled rig. Out: each drive whose torque depends on the speed of the shaft, with the control loop around it,
//! analysed by runtime::coupling::loop_stability. Knows neither terminal nor files.

use crate::compile::{self, CompiledRig, StepDerivative};
use crate::quantity::significant;
use abi::Slot;
use abi::rig::{Kind, Mode, Signal, SignalKind};
use runtime::coupling::loop_stability::{CommandDelay, Loop, PredictedLoop, Shaft, Step};
use runtime::coupling::predictor::Wired;

/// The emulated contact of one drive.
pub struct Contact {
    /// The name of the drive.
    pub drive: String,
    /// The delay and lag of its commands.
    pub late: CommandDelay,
    inputs: Vec<Slot>,
    /// For each input whether it is measured by this drive.
    own: Vec<bool>,
    derivative: StepDerivative,
    shaft: Shaft,
    /// The position that this drive measures, as a row over the states of the shaft.
    position: Option<Vec<f64>>,
    /// The inertia configured for the predictor's observer, and the sign of the torque; none where the rig has no
    /// predictor for this drive.
    told: Option<(f64, f64)>,
}

/// Stability of a contact at rest.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Standing {
    /// Spectral radius of one period without the predictor.
    pub plain: f64,
    /// Spectral radius as the rig runs it, if it has a predictor for this drive.
    pub ahead: Option<f64>,
}

impl Standing {
    /// Whether every disturbance decays on the rig.
    pub fn is_stable(&self) -> bool {
        self.ahead.unwrap_or(self.plain) < 1.0
    }
}

/// The drives whose torque depends on the speed of the shaft.
pub fn contacts(ready: &CompiledRig) -> Vec<Contact> {
    let mut all = candidates(ready);
    all.retain(|contact| contact.acts(ready));
    all
}

/// The drives whose torque may depend on the speed of the shaft, with some values of parameters that may change while the
/// rig runs.
pub fn candidates(ready: &CompiledRig) -> Vec<Contact> {
    let rig = &ready.rig;
    let looks = Wired::of(rig, &ready.plant, |_| 0).ok().flatten();
    let told =
        looks.zip(rig.plant.inertia).map(|(wired, inertia)| (inertia, wired.outputs.first().map_or(1.0, |it| it.1)));
    let seen = |signal: Signal| rig.plant.seen.iter().find(|(other, _)| *other == signal).map(|(_, slot)| *slot);
    let signals: Vec<(Slot, Slot, usize)> = rig
        .inputs
        .iter()
        .filter(|input| input.signal.what == SignalKind::Speed)
        .filter_map(|input| Some((input.slot, seen(input.signal)?, input.signal.node)))
        .collect();
    let mut out = Vec::new();
    for output in &rig.outputs {
        let node = &rig.nodes[output.signal.node];
        let Kind::Cia402(drive) = &node.kind else { continue };
        let applied = rig.plant.applied.iter().find(|(signal, _)| *signal == output.signal);
        let Some((_, torque)) = applied.filter(|_| drive.mode == Mode::Torque) else { continue };
        let inputs: Vec<Slot> = signals.iter().map(|(input, ..)| *input).collect();
        let position = seen(Signal { node: output.signal.node, what: SignalKind::Position });
        let outputs: Vec<Slot> = signals.iter().map(|(_, seen, _)| *seen).chain(position).collect();
        let Some((shaft, states)) = compile::linear_of(&ready.plant_program, &[*torque], &outputs) else { continue };
        let derivative = StepDerivative::new(&ready.program, rig.method, &inputs, &[output.slot]);
        let late = CommandDelay {
            dead: node.delay + if drive.at_sync { rig.period_ns as f64 * 1e-9 } else { 0.0 },
            lag: node.lag,
        };
        let mut rows = shaft.c;
        let position = position.map(|_| rows.split_off(inputs.len() * states));
        let shaft = Shaft { states, torques: 1, signals: inputs.len(), a: shaft.a, b: shaft.b, c: rows };
        let own = signals.iter().map(|(.., from)| *from == output.signal.node).collect();
        let told = told.filter(|_| rig.predict == Some(output.signal.node));
        let drive = node.name.clone();
        out.push(Contact { drive, inputs, own, derivative, shaft, position, told, late });
    }
    out
}

impl Contact {
    /// Whether its torque depends on the speed with the present values.
    fn acts(&self, ready: &CompiledRig) -> bool {
        let at_rest = self.at(ready, &[], 0.0);
        at_rest.step.b.iter().any(|b| *b != 0.0) && self.stiffness(&at_rest) != 0.0
            || at_rest.step.d.iter().any(|d| *d != 0.0)
    }

    /// The loop with these parameters, linearised at a constant speed after transients have decayed.
    pub fn at(&self, ready: &CompiledRig, params: &[(Slot, f64)], speed: f64) -> Loop {
        let rig = &ready.rig;
        let period = rig.period_ns as f64 * 1e-9;
        let mut control = ready.control.clone();
        for (slot, value) in params {
            control.set(*slot, *value);
        }
        for input in &self.inputs {
            control.set(*input, speed);
        }
        control.start(period / f64::from(rig.steps));
        if speed != 0.0 {
            // The contact's memory decays in this many steps at constant speed.
            for _ in 0..2000 * rig.steps {
                control.advance(1);
            }
        }
        let discrete = self.derivative.at(control.block(), rig.steps);
        let step = Step {
            states: discrete.states,
            signals: discrete.inputs,
            commands: discrete.outputs,
            a: discrete.a,
            b: discrete.b,
            c: discrete.c,
            d: discrete.d,
        };
        Loop { period, step, shaft: self.shaft.clone(), late: vec![self.late] }
    }

    /// The loop with the predictor, as the rig runs it; none if there is no predictor for this drive.
    pub fn looking(&self, plain: Loop) -> Option<PredictedLoop> {
        let ((inertia, sign), position) = (self.told?, self.position.clone()?);
        Some(PredictedLoop { plain, position, ahead: self.own.clone(), inertia, sign, told: self.late })
    }

    /// Its stability at rest.
    pub fn standing(&self, ready: &CompiledRig) -> Standing {
        let near = self.at(ready, &[], 0.0);
        Standing { plain: near.radius(), ahead: self.looking(near).map(|ahead| ahead.radius()) }
    }

    /// The matrix of the shaft alone, dx/dt = A x, row-major, with the number of states: for its resonances.
    pub fn shaft(&self) -> (usize, &[f64]) {
        (self.shaft.states, &self.shaft.a)
    }

    /// The stiffness that the contact adds, N·m/rad: the rate of its torque at constant speed, per speed.
    pub fn stiffness(&self, near: &Loop) -> f64 {
        let (step, signals) = (&near.step, near.step.signals);
        let kept = |j: usize| (0..step.states).map(|i| step.c[i] * step.b[i * signals + j]).sum::<f64>();
        (0..signals).map(kept).sum::<f64>().abs() / near.period
    }
}

/// The reasons why a rig must not move, in words; and whether it is stable only with the predictor.
pub fn objections(ready: &CompiledRig) -> (Vec<String>, bool) {
    objections_to(&candidates(ready), ready)
}

/// The same with the present values of parameters; the contacts are those that may act.
pub fn objections_to(contacts: &[Contact], ready: &CompiledRig) -> (Vec<String>, bool) {
    let period = ready.rig.period_ns as f64 * 1e-9;
    let (mut found, mut needs_look) = (Vec::new(), false);
    for contact in contacts.iter().filter(|contact| contact.acts(ready)) {
        let standing = contact.standing(ready);
        needs_look |= standing.plain >= 1.0 && standing.ahead.is_some();
        if !standing.is_stable() {
            let late = 0.5 * period + contact.late.dead + contact.late.lag;
            found.push(format!(
                "the contact that `{}` plays is not stable: it acts {} ms late, and every disturbance grows by {} in a period",
                contact.drive,
                significant(1e3 * late, 3),
                significant(standing.ahead.unwrap_or(standing.plain), 4),
            ));
        }
    }
    (found, needs_look)
}
