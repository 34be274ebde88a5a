//! Generated tests of contacts that a drive plays, on shafts that agree with the rig's inertia and torques, or do not.
//!
//! In: a seed, from which follow a contact, a shaft, delays, and a disturbance of the shaft. Out: whether the rig
//! noticed in time that the shaft deviates from its model, and that the contact returns more energy than it can store.
//! The reference is the simulated shaft itself: its equations, which the test defines, and its energy, which is an
//! additional state. `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::campaign::quick;
use super::coupling::look_ahead;
use super::cycle::{End, Hil};
use super::simulated::{Pace, World};
use crate::drive::Step;
use crate::drive::fault_injection::{Effect, Hook, Start};
use crate::drive::simulated_plant::SimulatedBench;
use crate::realtime::clock::Clock;
use crate::rng::Chance;
use crate::safety::Cause;
use crate::testing::generated::{self, changed, hold, seeds};
use crate::testing::models::Model;
use crate::testing::rigs;
use abi::rig::{Kind, Rig, Signal, SignalKind};
use abi::{Function, Instance};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Seeds in `cargo test`.
const RUNS: u64 = 80;
/// Step of the simulated shaft, ns.
const STEP_NS: u64 = 100_000;
const MS: u64 = 1_000_000;
/// Time for which the model drives the outputs, ns.
const RUN_NS: u64 = 700 * MS;
/// Window in which energies are summed, and within which an excess must be noticed, ns.
const WINDOW_NS: u64 = 100 * MS;
/// Possible shift of a measured reversal against the true one, ns: a small torque stays within one quantisation step
/// for as long.
const TOLD_NS: u64 = 30 * MS;
/// Duration of a blow, s.
const BLOW: f64 = 2e-4;
/// Unexplained change of the encoder in one tick above which the rig must notice it, counts.
const MANY: f64 = 20.0;
/// Factor between the energy that must be noticed and the limits of docs/prediction.md, and between these and the
/// energy that must not stop a rig; and the share of the store that quantisation of torque and speed may cause.
const BAND: f64 = 1.6;
const STEPS: f64 = 0.4;

/// Disturbance of a shaft.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Event {
    Nothing,
    /// A blow changes the speed by this much, rad/s.
    Blow(f64),
    /// A brake unknown to the rig seizes the shaft.
    Seized,
    /// The encoder loses this many counts.
    Lost(i64),
}

/// Parameters of one run.
#[derive(Clone, Copy, PartialEq, Debug)]
struct ContactScript {
    seed: u64,
    /// True moment of inertia and that of the rig's text, kg·m².
    inertia: f64,
    told: f64,
    /// Bearing friction, which the rig does not know, N·m·s/rad.
    bearings: f64,
    /// Stiffness of the contact at rest, N·m/rad; its break-away torque, N·m; its damping, N·m·s/rad.
    stiffness: f64,
    most: f64,
    damping: f64,
    /// Amplitude of the servo, N·m, and its frequency, Hz.
    swing: f64,
    hertz: f64,
    /// Dead time and lag of the load, s.
    delay: f64,
    lag: f64,
    predicts: bool,
    needs_look: bool,
    energy_stops: bool,
    event: Event,
    /// Time from arming to the event, ns.
    after: u64,
}

impl ContactScript {
    fn of(seed: u64) -> ContactScript {
        let mut chance = Chance(seed);
        let log = |chance: &mut Chance, low: f64, high: f64| low * (high / low).powf(chance.fraction());
        let inertia = log(&mut chance, 0.004, 0.04);
        let predicts = chance.below(3) > 0;
        let told = inertia * if chance.below(4) == 0 { chance.between(0.6, 1.6) } else { chance.between(0.99, 1.01) };
        let sign = |chance: &mut Chance| if chance.below(2) == 0 { 1.0 } else { -1.0 };
        let event = match chance.below(6) {
            0 | 1 => Event::Blow(sign(&mut chance) * log(&mut chance, 0.2, 6.0)),
            2 => Event::Seized,
            3 => Event::Lost((sign(&mut chance) * log(&mut chance, 5.0, 2_000.0)) as i64),
            _ => Event::Nothing,
        };
        let most = chance.between(0.1, 0.6);
        ContactScript {
            seed,
            inertia,
            told,
            bearings: if chance.below(3) == 0 { chance.between(0.0, 0.02) } else { 0.0 },
            stiffness: log(&mut chance, 5.0, 300.0),
            most,
            damping: [0.0, 0.02, 0.1][chance.below(3) as usize],
            swing: most * chance.between(0.3, 2.5),
            hertz: chance.between(0.5, 3.0),
            delay: if predicts { chance.between(0.8e-3, 4e-3) } else { log(&mut chance, 0.8e-3, 60e-3) },
            lag: chance.between(0.2e-3, 2e-3),
            predicts,
            needs_look: predicts && chance.below(2) == 0,
            energy_stops: chance.below(2) == 0,
            event,
            after: 250 * MS + chance.below(3_000) * STEP_NS,
        }
    }

    /// Rig, control program, plant program. `at`: time of the event, s.
    fn build(&self, at: f64) -> (Rig, Instance, Instance) {
        let ContactScript { inertia, bearings, stiffness, most, damping, swing, hertz, event, .. } = *self;
        let (mut rig, _, _) = rigs::bristle();
        let control = Model::new("Bristle")
            .inputs(2)
            .state("z", "rad")
            .output("servo", "N·m")
            .output("load", "N·m")
            .output("v", "rad/s")
            .body(Function::Derivatives, move |view| {
                let v = view.u(0);
                view.set_dx(0, v - stiffness * v.abs() * view.x(0) / most);
            })
            .body(Function::Outputs, move |view| {
                view.set_y(0, swing * (TAU * hertz * view.t()).sin());
                view.set_y(1, -stiffness * view.x(0) - damping * view.u(0));
                view.set_y(2, view.u(0));
            })
            .build();
        let plant = Model::new("Shaft")
            .inputs(2)
            .state("x", "rad")
            .state("v", "rad/s")
            .state("absorbed", "J")
            .output("position", "rad")
            .output("speed", "rad/s")
            .body(Function::Derivatives, move |view| {
                let v = view.x(1);
                let other = match event {
                    Event::Blow(by) if at <= view.t() && view.t() < at + BLOW => by * inertia / BLOW,
                    Event::Seized if at <= view.t() => -v * inertia / 2e-3,
                    _ => 0.0,
                };
                view.set_dx(0, v);
                view.set_dx(1, (view.u(0) + view.u(1) - bearings * v + other) / inertia);
                view.set_dx(2, -view.u(1) * v);
            })
            .body(Function::Outputs, |view| {
                view.set_y(0, view.x(0));
                view.set_y(1, view.x(1));
            })
            .build();
        (rig.nodes[0].delay, rig.nodes[0].lag) = (self.delay, self.lag);
        let (inside, outside) = (&control.description().layout, &plant.description().layout);
        rig.inputs.iter_mut().enumerate().for_each(|(k, input)| input.slot = inside.inputs.slot(k));
        rig.outputs.iter_mut().enumerate().for_each(|(k, output)| output.slot = inside.outputs.slot(k));
        rig.record[0].slot = inside.outputs.slot(2);
        // The servo comes first; each drive reads position and speed.
        rig.plant.applied.iter_mut().enumerate().for_each(|(k, (_, slot))| *slot = outside.inputs.slot(k));
        rig.plant.seen.iter_mut().enumerate().for_each(|(k, (_, slot))| *slot = outside.outputs.slot(k % 2));
        rig.predict = self.predicts.then_some(0);
        rig.plant.inertia = Some(self.told);
        (rig, control, plant)
    }

    /// Greatest energy that the contact can store, J.
    fn store(&self) -> f64 {
        0.5 * self.most * self.most / self.stiffness
    }
}

/// Energies from the true torque and speed, in units of the store, since the model drives the outputs.
#[derive(Default)]
struct Energies {
    /// Time, and energy absorbed in that tick.
    ticks: VecDeque<(u64, f64)>,
    /// Times at which the other torque changed its sign.
    reversals: VecDeque<u64>,
    other: f64,
    begun: Option<f64>,
    absorbed: f64,
    highest: f64,
}

impl Energies {
    fn note(&mut self, now_ns: u64, absorbed: f64, other: f64) {
        let absorbed = absorbed - *self.begun.get_or_insert(absorbed);
        self.ticks.push_back((now_ns, absorbed - self.absorbed));
        self.absorbed = absorbed;
        self.highest = self.highest.max(absorbed);
        // Within one quantisation step the sign of a torque is unknown.
        if other.abs() > 4e-3 {
            if other * self.other < 0.0 {
                self.reversals.push_back(now_ns);
            }
            self.other = other;
        }
        while self.ticks.front().is_some_and(|(at, _)| at + WINDOW_NS <= now_ns) {
            self.ticks.pop_front();
        }
    }

    fn returned(&self) -> f64 {
        self.ticks.iter().map(|(_, work)| (-work).max(0.0)).sum()
    }

    /// Accuracy of the sum in a rig that reads torque and speed once per tick: the greatest energy of one tick.
    fn resolution(&self) -> f64 {
        self.ticks.iter().map(|(_, work)| work.abs()).fold(STEPS, f64::max)
    }

    fn fall(&self) -> f64 {
        self.highest - self.absorbed
    }

    /// Energy that the reversals of the last `ns` permit.
    fn allowed(&self, now_ns: u64, ns: u64) -> f64 {
        1.5 * self.reversals.iter().filter(|at| **at + ns > now_ns).count() as f64
    }
}

/// Outcome of a run.
#[derive(Clone, Copy, Debug, Default)]
struct ContactOutcome {
    warned: bool,
    energy_stop: bool,
    unpredicted: bool,
    needed: bool,
    quiet: bool,
}

/// Runs a script.
///
/// # Errors
/// A violated property.
fn run(script: &ContactScript) -> Result<ContactOutcome, String> {
    // The start-up takes the same time in both runs, so a first run measures it.
    let armed_ns = {
        let (mut hil, world, _) = started(&ContactScript { event: Event::Nothing, ..*script }, f64::INFINITY);
        while hil.ended().is_none() && hil.counts().cycles == 0 {
            hil.cycle();
        }
        match hil.ended() {
            Some(end) => return Err(format!("it did not start: {end:?}")),
            None => world.simulation().now_ns() / STEP_NS * STEP_NS,
        }
    };
    let event_ns = armed_ns + script.after;
    let (mut hil, world, rig) = started(script, event_ns as f64 * 1e-9);
    if let Event::Lost(counts) = script.event {
        let (node, effect, start) = (0, Effect::EncoderLost(counts), Start::At(event_ns));
        world.bench().hook(Hook { node, effect, start, lasts_ns: None });
    }
    let speed_slot = rig.inputs.iter().find(|input| input.signal == Signal { node: 0, what: SignalKind::Speed });
    let speed_slot = speed_slot.expect("the contact reads the speed of its drive").slot;
    let Kind::Cia402(load) = &rig.nodes[0].kind else { unreachable!("the load is a drive") };
    let count = load.count;
    let mut shown = ContactOutcome::default();
    let mut energies = Energies::default();
    let (mut unpredicted, mut warnings) = (0, VecDeque::from([(0u64, 0u64)]));
    // Deadlines for the reactions.
    let (mut must_look, mut must_warn, mut must_stop) = (None, None, None);
    let mut speed = 0.0f64;
    let mut before_event = None;
    let period = rig.period_ns;
    while world.simulation().now_ns() < armed_ns + RUN_NS && hil.ended().is_none() {
        hil.cycle();
        let now_ns = world.simulation().now_ns();
        let Some(counts) = hil.counts().coupling.filter(|_| hil.counts().cycles > 0) else { continue };
        let control = hil.control().expect("it counts");
        let tripped = control.supervisor().cause();
        let shaft = world.bench().shaft(0);
        let (absorbed, other) = {
            let bench = world.bench();
            let plant = bench.plant().expect("it has a shaft");
            (plant.get(plant.description().layout.states.slot(2)), bench.shaft(1).torque)
        };

        // Predictor: the shaft.
        let looked = counts.unpredicted > unpredicted;
        if looked {
            let (got, read) = (control.model().get(speed_slot), hil.seen()[0].speed.unwrap_or(f64::NAN));
            if got.to_bits() != read.to_bits() && tripped.is_none() {
                return Err(format!("at {now_ns} ns it does not look ahead, reads {read} and steps with {got} rad/s"));
            }
        }
        unpredicted = counts.unpredicted;
        let as_told = (script.told / script.inertia - 1.0).abs() <= 0.01 && script.bearings == 0.0;
        if script.predicts && now_ns > event_ns && before_event.is_none() {
            before_event = Some(unpredicted - u64::from(looked));
            let by = match script.event {
                Event::Nothing => 0.0,
                Event::Blow(by) => by.abs() * period as f64 * 1e-9 / count,
                // In its first tick the shaft loses more than a third of its speed.
                Event::Seized => 0.35 * speed.abs() * period as f64 * 1e-9 / count,
                Event::Lost(counts) => counts.unsigned_abs() as f64,
            };
            if by > MANY && as_told && tripped.is_none() {
                // The tick of the event, and three more.
                must_look = Some(now_ns + 4 * period);
            }
        }
        speed = shaft.speed;
        let noticed = before_event.is_some_and(|before| unpredicted > before);
        if must_look.is_some_and(|until| now_ns >= until) {
            must_look = None;
            shown.unpredicted = true;
            let stops = tripped.is_some();
            if !(stops || noticed && !script.needs_look) {
                return Err(format!("{:?}, and {unpredicted} cycles did not look ahead: {tripped:?}", script.event));
            }
        }
        let untouched = script.event == Event::Nothing || now_ns < event_ns;
        if untouched && as_told && unpredicted > 0 {
            return Err(format!("at {now_ns} ns it does not look ahead, and the shaft is as told"));
        }

        // Passivity observer: the energy.
        let store = script.store();
        energies.note(now_ns, absorbed / store, other);
        let (returned, fall, coarse) = (energies.returned(), energies.fall(), energies.resolution());
        let least = energies.allowed(now_ns, WINDOW_NS - TOLD_NS);
        let most = energies.allowed(now_ns, WINDOW_NS + TOLD_NS);
        warnings.push_back((now_ns, counts.warnings));
        while warnings.front().is_some_and(|(at, _)| at + 2 * WINDOW_NS < now_ns) {
            warnings.pop_front();
        }
        if tripped == Some(Cause::Energy) && !shown.energy_stop {
            shown.energy_stop = true;
            if !script.energy_stops {
                return Err("energy stops it, and it was not asked to".into());
            }
            if returned + coarse < (3.0 + least) / BAND && fall + coarse < (1.0 + least) / BAND {
                return Err(format!("it stops for energy: {returned:.2} came back, {fall:.2} fell"));
            }
        }
        let drives = returned > BAND * (3.0 + most) + coarse || fall > BAND * (1.0 + most) + coarse;
        if drives || returned > BAND * (0.5 + most) + coarse {
            must_warn = must_warn.or(Some((now_ns + WINDOW_NS, returned, fall)));
        }
        if drives && script.energy_stops {
            must_stop = must_stop.or(Some((now_ns + WINDOW_NS, returned, fall)));
        }
        if let Some((_, returned, fall)) = must_warn.take_if(|(until, ..)| now_ns >= *until) {
            shown.warned = true;
            if warnings.front().is_none_or(|(_, before)| counts.warnings == *before) && tripped.is_none() {
                return Err(format!("{returned:.2} came back, {fall:.2} fell, and it does not warn"));
            }
        }
        if let Some((_, returned, fall)) = must_stop.filter(|(until, ..)| now_ns >= *until && tripped.is_none()) {
            return Err(format!("{returned:.2} came back, {fall:.2} fell, and it goes on"));
        }
        if tripped.is_some() {
            // The pending event has stopped the rig.
            shown.unpredicted |= must_look.is_some();
            shown.needed |= must_look.is_some() && tripped == Some(Cause::Unpredictable);
            shown.warned |= must_warn.is_some();
            break;
        }
    }
    if let Some(End::Refused(why)) = hil.ended() {
        return Err(format!("refused: {why}"));
    }
    shown.quiet = unpredicted == 0 && hil.counts().coupling.is_some_and(|counts| counts.warnings == 0);
    Ok(shown)
}

/// The rig of a script before its start.
fn started(script: &ContactScript, at: f64) -> (Hil, World, Rig) {
    let (rig, control, plant) = script.build(at);
    let mut options = quick();
    options.control.needs_look = script.needs_look;
    options.control.energy_stops = script.energy_stops;
    options.look = look_ahead(&rig, &plant).unwrap();
    let bench = SimulatedBench::new(&rig, Some(plant), script.seed).unwrap().in_steps_of(STEP_NS);
    let mut world = World::around(&rig, bench, Pace::Fast, script.seed).unwrap();
    let masters = world.masters();
    let (hil, _) = Hil::new(&rig, control, world.clock(), masters, options, None).unwrap();
    assert!(hil.step() < Step::Armed);
    (hil, world, rig)
}

/// Simplifies a failing script while it still fails.
fn shrunk(script: &ContactScript, why: String) -> (ContactScript, String) {
    let changes: [fn(&mut ContactScript); 8] = [
        |script| script.event = Event::Nothing,
        |script| script.told = script.inertia,
        |script| script.bearings = 0.0,
        |script| script.damping = 0.0,
        |script| script.needs_look = false,
        |script| script.energy_stops = false,
        |script| script.predicts = false,
        |script| (script.delay, script.lag) = (2e-3, 0.6e-3),
    ];
    generated::shrunk(script, why, |script| changed(script, &changes), run)
}

#[test]
fn model_deviations_and_active_contacts_are_detected_in_time() {
    let seeds = seeds(RUNS);
    let all = seeds.end - seeds.start;
    let mut kinds = [0; 5];
    let failed = hold(
        seeds,
        ContactScript::of,
        run,
        shrunk,
        |ContactOutcome { warned, energy_stop, unpredicted, needed, quiet }| {
            let shown = [warned, energy_stop, unpredicted, needed, quiet];
            kinds.iter_mut().zip(shown).for_each(|(count, shown)| *count += u64::from(shown));
        },
    );
    let [warned, stopped, unpredicted, needed, quiet] = kinds;
    println!(
        "{all} runs: {warned} had to warn, {stopped} stopped for energy, {unpredicted} were not as told, {needed} of them \
         could not go on, {quiet} were quiet; {} failed: {failed:?}",
        failed.len()
    );
    assert!(failed.is_empty());
    assert!(all < RUNS || kinds.iter().all(|count| *count > 3), "each kind comes: {kinds:?}");
}
