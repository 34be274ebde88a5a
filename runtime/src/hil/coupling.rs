//! The coupling of a model, which plays a contact, to its shaft: predictor and passivity observer.
//!
//! In: readings and permitted outputs of a cycle. Out: predicted speed and position of the shaft at the time when the
//! command will act, whether the prediction is valid, and whether a contact returns more energy than it can store.
//! Knows neither clock nor bus, so a replay of the same readings reproduces every bit. Allocates only at construction.

use crate::coupling::passivity::{Energy, Sign};
use crate::coupling::predictor::{Predicted, Wired};
use crate::drive::timing;
use crate::safety::{Protection, is_present};
use abi::rig::{Kind, Mode, Rig, Signal, SignalKind};
use abi::{Instance, Slot};

/// A reading: its value, and whether it arrived in this cycle.
pub type Read = (f64, bool);

/// Counters since the model was connected to the outputs.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Counts {
    /// Cycles in which the shaft deviated from its model, so that the command was not predicted.
    pub unpredicted: u64,
    /// Greatest error of a predicted position, rad.
    pub residual_max: f64,
    /// Greatest energy returned within 0.1 s, as a share of the energy that the contact can store.
    pub returned_max: f64,
    /// Cycles in which a contact returned more energy than friction can.
    pub warnings: u64,
}

/// Result of the checks of one cycle.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum CouplingVerdict {
    /// The run may continue.
    Fine,
    /// The contact drives the shaft: it returns too much energy.
    Drives,
    /// The shaft deviates from its model, and without the predictor the loop is unstable.
    Unpredictable,
}

/// Creates the predictor that the rig's `predict` requires, with the delays of its loop. `plant`: the program of the
/// part of the model that hardware replaces.
///
/// # Errors
/// A message about what the predictor lacks.
pub fn look_ahead(rig: &Rig, plant: &Instance) -> Result<Option<Wired>, String> {
    Wired::of(rig, plant, |node| timing::transit_ns(rig, node))
}

/// A contact that a drive plays, characterised by a slow motion.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Contact {
    /// Its output: an index into the rig's outputs.
    pub output: usize,
    /// Its greatest torque, N·m.
    pub most: f64,
    /// Its stiffness at rest, N·m/rad.
    pub stiffness: f64,
}

/// Finds the contacts that drives of a rig play, by turning the shaft of the model slowly. If a drive has a predictor,
/// only the contact of that drive. `model`: the control program before its start.
pub fn contacts(rig: &Rig, model: &Instance) -> Vec<Contact> {
    let speeds: Vec<Slot> =
        rig.inputs.iter().filter(|input| input.signal.what == SignalKind::Speed).map(|input| input.slot).collect();
    let found = rig.outputs.iter().enumerate().filter_map(|(at, output)| {
        let node = output.signal.node;
        let Kind::Cia402(drive) = &rig.nodes[node].kind else { return None };
        if drive.mode != Mode::Torque || rig.predict.is_some_and(|emulates| emulates != node) {
            return None;
        }
        let (most, stiffness) = turned(rig, model, &speeds, output.slot)?;
        Some(Contact { output: at, most, stiffness })
    });
    found.collect()
}

/// The passivity observer of one contact.
struct Watched {
    energy: Energy,
    /// Indices of its drive's torque and speed among the readings.
    torque: usize,
    speed: usize,
}

/// Predictor and passivity observers between readings and model.
pub struct Coupling {
    period_ns: u64,
    now_ns: u64,
    look: Option<Wired>,
    /// Index of the shaft's position among the readings.
    position: usize,
    contacts: Vec<Watched>,
    /// Indices of all drives' torques among the readings.
    torques: Vec<usize>,
    /// The loop is unstable without the predictor.
    needs_look: bool,
    /// A contact that drives the shaft stops the rig.
    stops: bool,
    counts: Counts,
}

impl Coupling {
    /// The coupling of a rig. `look`: the predictor that `predict` of the rig requires; `watched`: the readings;
    /// `model`: the control program before its start. Contacts are found by turning the shaft of the model slowly.
    pub fn new(rig: &Rig, look: Option<Wired>, watched: &[Signal], model: &Instance) -> Coupling {
        let at = |signal: Signal| watched.iter().position(|other| *other == signal);
        let torques: Vec<usize> =
            (0..rig.nodes.len()).filter_map(|node| at(Signal { node, what: SignalKind::Torque })).collect();
        let watch = |contact: Contact| {
            let node = rig.outputs[contact.output].signal.node;
            // Greatest energy that the contact can store.
            let store = 0.5 * contact.most * contact.most / contact.stiffness;
            Some(Watched {
                energy: Energy::new(store, rig.period_ns as f64 * 1e-9),
                torque: at(Signal { node, what: SignalKind::Torque })?,
                speed: at(Signal { node, what: SignalKind::Speed })?,
            })
        };
        let position = look.as_ref().and_then(|wired| at(wired.position));
        Coupling {
            period_ns: rig.period_ns,
            now_ns: 0,
            look: look.filter(|_| position.is_some()),
            position: position.unwrap_or_default(),
            contacts: contacts(rig, model).into_iter().filter_map(watch).collect(),
            torques,
            needs_look: false,
            stops: false,
            counts: Counts::default(),
        }
    }

    /// Sets the conditions that stop the rig: an invalid prediction in a loop that needs the predictor; a contact that
    /// drives the shaft.
    pub fn stops_for(&mut self, needs_look: bool, energy: bool) {
        (self.needs_look, self.stops) = (needs_look, energy);
    }

    /// Counters since the model was connected.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// The same counters; none if the rig has neither predictor nor contact.
    pub fn told(&self) -> Option<Counts> {
        (self.look.is_some() || !self.contacts.is_empty()).then_some(self.counts)
    }

    /// Greatest energy that each contact can store, J, in the order of the outputs that play them.
    pub fn stores(&self) -> impl Iterator<Item = f64> {
        self.contacts.iter().map(|contact| contact.energy.store())
    }

    /// The drive whose command is predicted.
    pub fn looks_ahead(&self) -> Option<usize> {
        self.look.as_ref().map(|wired| wired.node)
    }

    /// Restarts when the model is connected to the outputs: the history is discarded.
    pub fn restart(&mut self, permitted: &[f64]) {
        (self.now_ns, self.counts) = (0, Counts::default());
        if let Some(wired) = &mut self.look {
            wired.restart(permitted);
        }
        self.contacts.iter_mut().for_each(|contact| contact.energy.restart());
    }

    /// One cycle, `ticks` after the last one and begun `late_ns` after its tick. `read`: reading of each signal.
    pub fn read(
        &mut self,
        ticks: u32,
        late_ns: u32,
        read: impl Fn(usize) -> Read,
    ) -> (Option<Predicted>, CouplingVerdict) {
        self.now_ns += u64::from(ticks) * self.period_ns;
        let ahead = self.look(self.now_ns + u64::from(late_ns), read(self.position));
        let lost = self.look.is_some() && ahead.is_none();
        self.counts.unpredicted += u64::from(lost);
        let mut verdict = if lost && self.needs_look { CouplingVerdict::Unpredictable } else { CouplingVerdict::Fine };
        for contact in &mut self.contacts {
            let torque = read(contact.torque).0;
            let other = self.torques.iter().filter(|at| **at != contact.torque).map(|at| read(*at).0).sum();
            let sign = contact.energy.see(-torque, read(contact.speed).0, other);
            let sign = if is_present(Protection::Energy) { sign } else { Sign::Healthy };
            self.counts.warnings += u64::from(sign > Sign::Healthy);
            self.counts.returned_max = self.counts.returned_max.max(contact.energy.returned());
            if sign == Sign::Trip && self.stops {
                verdict = CouplingVerdict::Drives;
            }
        }
        (ahead, verdict)
    }

    fn look(&mut self, now_ns: u64, (position, fresh): Read) -> Option<Predicted> {
        let look = &mut self.look.as_mut()?.observer;
        match fresh {
            true => look.observe(now_ns, position),
            false => look.coast(now_ns),
        }
        self.counts.residual_max = self.counts.residual_max.max(look.residual().abs());
        (look.is_valid() || !is_present(Protection::Plain)).then(|| look.ahead())
    }

    /// Records the permitted outputs of this cycle, one value per output.
    pub fn sent(&mut self, permitted: &[f64]) {
        if let Some(wired) = &mut self.look {
            wired.sent(permitted);
        }
    }

    /// Appends the complete state as words, from which [`Coupling::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.push(self.now_ns);
        if let Some(wired) = &self.look {
            wired.observer.save(words);
        }
        self.contacts.iter().for_each(|contact| contact.energy.save(words));
    }

    /// Restores the state that [`Coupling::save`] wrote. None if the words do not fit.
    pub fn restore(&mut self, words: &mut impl Iterator<Item = u64>) -> Option<()> {
        self.now_ns = words.next()?;
        if let Some(wired) = &mut self.look {
            wired.observer.restore(words)?;
        }
        self.contacts.iter_mut().try_for_each(|contact| contact.energy.restore(words))
    }
}

/// Steps of one slow motion.
const TURN: u32 = 2000;
/// Number of motions, each twice as long as the last, until the contact breaks away.
const TURNS: u32 = 40;

/// Break-away torque of a contact and its stiffness at rest. None if this output is no contact. A contact has no torque
/// at rest, answers a small rotation in either direction like a spring, and a long one by a torque that no longer
/// grows.
fn turned(rig: &Rig, model: &Instance, speeds: &[Slot], output: Slot) -> Option<(f64, f64)> {
    let (period, steps) = (rig.period_ns as f64 * 1e-9, u64::from(rig.steps.max(1)));
    // Greatest torque of a motion, the torque after its first step and that after its last step.
    let turn = |speed: f64, n: u32| {
        let mut model = model.clone();
        speeds.iter().for_each(|slot| model.set(*slot, speed));
        let begun = model.start(period / steps as f64);
        let (mut most, mut first, mut last) = (0.0f64, 0.0, 0.0);
        for k in 0..n {
            if begun != 0 || model.advance(steps) != 0 {
                return None;
            }
            last = model.get(output);
            most = most.max(last.abs());
            first = if k == 0 { last } else { first };
        }
        (most.is_finite() && !last.is_nan()).then_some((most, first, last))
    };
    let small = 1e-9;
    let (_, first, last) = turn(small, 11)?;
    let stiffness = ((last - first) / (10.0 * period * small)).abs();
    let (at_rest, ..) = turn(0.0, 2)?;
    let springs = stiffness > 0.0 && stiffness.is_finite() && at_rest <= 1e-3 * stiffness * 1e-6;
    let (_, back, _) = turn(-small, 11)?;
    if !springs || back * first >= 0.0 {
        return None;
    }
    let mut angle = 1e-6;
    for _ in 0..TURNS {
        let (most, ..) = turn(angle / (f64::from(TURN) * period), TURN)?;
        if most < 0.3 * stiffness * angle {
            return (most > 0.0).then_some((most, stiffness));
        }
        angle *= 2.0;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::models::Model;
    use crate::testing::rigs;
    use abi::Function;

    /// The rig with one drive, its model a bristle: dz/dt = v − σ0 |v| z / g with g = 0.34 N·m.
    fn bristle() -> (Rig, Instance) {
        let (mut rig, _) = rigs::rig();
        let (sigma0, g) = (260.0, 0.34);
        let model = Model::new("Bristle")
            .inputs(1)
            .state("z", "rad")
            .output("torque", "N·m")
            .body(Function::Derivatives, move |view| {
                let v = view.u(0);
                view.set_dx(0, v - sigma0 * v.abs() * view.x(0) / g);
            })
            .body(Function::Outputs, move |view| view.set_y(0, -sigma0 * view.x(0)))
            .build();
        rig.inputs[0].slot = model.description().layout.inputs.slot(0);
        rig.outputs[0].slot = model.description().layout.outputs.slot(0);
        (rig, model)
    }

    const WATCHED: [Signal; 3] = [
        Signal { node: 0, what: SignalKind::Speed },
        Signal { node: 0, what: SignalKind::Torque },
        Signal { node: 0, what: SignalKind::Position },
    ];

    #[test]
    fn a_slow_motion_finds_the_store_of_a_bristle() {
        let (rig, model) = bristle();
        let coupling = Coupling::new(&rig, None, &WATCHED, &model);
        let stores: Vec<f64> = coupling.stores().collect();
        let own = 0.34f64 * 0.34 / (2.0 * 260.0);
        assert!(stores.len() == 1 && (stores[0] / own - 1.0).abs() < 0.02, "{stores:?} for {own}");
    }

    #[test]
    fn an_unlimited_spring_is_no_contact() {
        let (rig, model) = rigs::rig();
        assert_eq!(Coupling::new(&rig, None, &WATCHED, &model).stores().count(), 0);
    }

    #[test]
    fn a_contact_that_drives_the_shaft_is_detected_and_stops_if_configured() {
        let (rig, model) = bristle();
        for stops in [false, true] {
            let mut coupling = Coupling::new(&rig, None, &WATCHED, &model);
            coupling.stops_for(false, stops);
            let mut worst = CouplingVerdict::Fine;
            // 0.3 N·m in the direction of motion for 20 ms at 1 rad/s: 6 mJ, while the contact can store 0.22 mJ.
            for _ in 0..20 {
                let (_, verdict) = coupling.read(1, 0, |at| ([1.0, 0.3, 0.0][at], true));
                if verdict != CouplingVerdict::Fine {
                    worst = verdict;
                }
            }
            assert_eq!(worst, if stops { CouplingVerdict::Drives } else { CouplingVerdict::Fine });
            assert!(coupling.counts().warnings > 10 && coupling.counts().returned_max > 20.0);
        }
    }

    #[test]
    fn what_is_saved_goes_on_as_before() {
        let (rig, model) = bristle();
        let mut first = Coupling::new(&rig, None, &WATCHED, &model);
        let reading = |k: u32| move |at: usize| ([f64::from(k % 7) - 3.0, 0.1 * f64::from(k % 3), 0.0][at], true);
        (0..150).for_each(|k| _ = first.read(1, 0, reading(k)));
        let mut words = Vec::new();
        first.save(&mut words);
        let mut second = Coupling::new(&rig, None, &WATCHED, &model);
        assert_eq!(second.restore(&mut words.iter().copied()), Some(()));
        assert_eq!(second.restore(&mut words[1..].iter().copied()), None);
        second.restore(&mut words.iter().copied());
        for k in 150..300 {
            assert_eq!(first.read(1, 0, reading(k)), second.read(1, 0, reading(k)), "cycle {k}");
        }
    }
}
