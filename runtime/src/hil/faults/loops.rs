//! Generated tests of drives that control a speed or a position themselves, over longer times than the runs of the
//! fault space.
//!
//! In: a seed, from which follow a drive, a command, and a fault that keeps the shaft from following. Out: whether a
//! stop began within a second after no recent command explained the shaft any more, and not before. The reference is
//! the true shaft and the permitted commands. `FRIC_SEED=n` repeats one seed; `FRIC_RUNS=n` sets their number.

use super::rigs::{Made, PLAIN, Sort};
use super::run::behaviour;
use super::space::MS;
use crate::can::sim::{BusFaultKind as Planting, Fault};
use crate::drive::fault_injection::{Effect, Hook, Start};
use crate::drive::simulated_plant::SimulatedBench;
use crate::hil::campaign::quick;
use crate::hil::cycle::{End, Hil};
use crate::hil::simulated::{MASTER, Pace, World};
use crate::realtime::clock::Clock;
use crate::rng::Chance;
use crate::safety::Cause;
use crate::testing::generated::{self, changed, hold, seeds};
use abi::rig::Rig;
use std::collections::VecDeque;

/// Seeds in `cargo test`.
const RUNS: u64 = 40;
const STEP_NS: u64 = 200_000;
/// Time from the fault to the end of a run, ns.
const RUN_NS: u64 = 3_500 * MS;
/// Settling time of a loop with a time constant of 0.1 s to within a fiftieth of a step, s.
const SETTLES: f64 = 0.4;
/// Longest time for which no command may explain the shaft, ns; and some ticks for the transport of its reading.
const PATIENCE_NS: u64 = 1_000 * MS;
const WAY_NS: u64 = 20 * MS;
/// Permitted deviation of a shaft as a share of half the range of a command, and an additional share for quantisation
/// and settling.
const PART: f64 = 0.1;
const MARGIN: f64 = 0.05;
/// The node that controls speed or position.
const SERVO: usize = 1;

/// The fault.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Ill {
    Nothing,
    /// Set-points arrive, but always the same one.
    Stale,
    /// Set-points do not arrive, and the drive has no deadline for them.
    Lost,
    /// The drive applies only this share of its torque.
    Weak(f64),
    /// The drive reports its speed or angle scaled by this factor.
    Tells(f64),
}

/// Parameters of one run.
#[derive(Clone, Copy, PartialEq, Debug)]
struct LoopScript {
    seed: u64,
    rig: Made,
    /// Dead time and lag of the servo, s.
    delay: f64,
    lag: f64,
    ill: Ill,
    /// Time from arming to the fault, ns.
    after: u64,
}

impl LoopScript {
    fn of(seed: u64) -> LoopScript {
        let mut chance = Chance(seed);
        let sort = if chance.below(2) == 0 { Sort::SpeedServo } else { Sort::PositionServo };
        let ill = match chance.below(8) {
            0..=2 => Ill::Stale,
            3 | 4 => Ill::Lost,
            5 => Ill::Weak(chance.between(0.0, 0.1)),
            6 => Ill::Tells(chance.between(-1.5, 2.5)),
            _ => Ill::Nothing,
        };
        let rig = Made {
            sort,
            swing: chance.between(0.3, 0.95),
            hertz: 0.05 * 20f64.powf(chance.fraction()),
            damping: 0.02,
            eager: sort == Sort::SpeedServo && chance.below(4) == 0,
            ..PLAIN
        };
        let (delay, lag) = (chance.between(0.8e-3, 10e-3), chance.between(0.3e-3, 2e-3));
        LoopScript { seed, rig, delay, lag, ill, after: (30 + chance.below(700)) * MS }
    }

    fn build(&self) -> (Rig, abi::Instance, abi::Instance) {
        let (mut rig, control, plant) = self.rig.build();
        (rig.nodes[SERVO].delay, rig.nodes[SERVO].lag) = (self.delay, self.lag);
        (rig, control, plant)
    }
}

/// Recent commands, the newest last.
struct Stepper {
    commands: VecDeque<f64>,
    /// Number of ticks for which a command may be under way, and for which a slow loop may still follow it.
    way: usize,
    slow: usize,
}

impl Stepper {
    /// Distance of a value from the range of the commands of the last ticks.
    fn outside(&self, ticks: usize, value: f64) -> f64 {
        let last = self.commands.iter().rev().take(ticks);
        let (low, high) = last.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), u| (low.min(*u), high.max(*u)));
        (low - value).max(value - high).max(0.0)
    }
}

/// Runs a script: the time from the moment when no command explained the shaft to the stop, ns; none if no stop was
/// due.
///
/// # Errors
/// A violated property.
fn run(script: &LoopScript) -> Result<Option<u64>, String> {
    let (rig, control, plant) = script.build();
    let mut bench = SimulatedBench::with(&rig, Some(plant), script.seed, |_| behaviour())?.in_steps_of(STEP_NS);
    if script.ill == Ill::Lost {
        bench.drive(SERVO).unwrap().without_deadlines();
    }
    let mut world = World::around(&rig, bench, Pace::Fast, script.seed)?;
    let masters = world.masters();
    let (mut hil, _) = Hil::new(&rig, control, world.clock(), masters, quick(), None)?;
    let mut origin = 0.0;
    while hil.counts().cycles == 0 {
        origin = world.bench().shaft(SERVO).position;
        hil.cycle();
        if let Some(end) = hil.ended() {
            return Err(format!("it did not start: {end:?}"));
        }
    }
    let ticks = |seconds: f64| (seconds * 1e9) as usize / rig.period_ns as usize + 4;
    let (way, slow) = (ticks(script.delay), ticks(script.delay + SETTLES));
    let mut course = Stepper { commands: VecDeque::from(vec![0.0; slow]), way, slow };
    let half = 0.5 * (rig.outputs[SERVO].high - rig.outputs[SERVO].low);
    let begun_ns = world.simulation().now_ns();
    let fault_ns = begun_ns + script.after;
    let (mut planted, mut astray_ns, mut near_ns) = (false, None, Some(begun_ns));
    loop {
        let now_ns = world.simulation().now_ns();
        if now_ns >= fault_ns && !planted {
            planted = true;
            plant_fault(script, &world, now_ns);
        }
        hil.cycle();
        let now_ns = world.simulation().now_ns();
        let supervisor = hil.control().expect("it is armed").supervisor();
        course.commands.pop_front();
        course.commands.push_back(supervisor.permitted()[SERVO]);
        let shaft = world.bench().shaft(SERVO);
        let told = match script.ill {
            Ill::Tells(factor) if planted => factor,
            _ => 1.0,
        };
        let is = match script.rig.sort {
            Sort::PositionServo => told * shaft.position - origin,
            _ => told * shaft.speed,
        };
        if course.outside(course.way, is) > 0.9 * PART * half {
            near_ns = None;
        } else {
            near_ns = near_ns.or(Some(now_ns));
        }
        match supervisor.cause() {
            Some(cause) => {
                if script.ill == Ill::Nothing || !planted {
                    return Err(format!("it stops by {cause:?} without a fault"));
                }
                let near = near_ns.is_some_and(|since| now_ns - since > PATIENCE_NS);
                if matches!(cause, Cause::NotFollowing(_)) && near {
                    return Err(format!("it stops by {cause:?}, and the shaft is where it was told to be"));
                }
                return Ok(astray_ns.map(|since| now_ns - since));
            }
            None if matches!(hil.ended(), Some(End::Stopped(..) | End::Refused(_))) => {
                return Err(format!("it ended with {:?}", hil.ended()));
            }
            None => {}
        }
        let away = course.outside(course.slow, is);
        astray_ns = if away > (PART + MARGIN) * half { astray_ns.or(Some(now_ns)) } else { None };
        if let Some(since) = astray_ns.filter(|since| now_ns - since > PATIENCE_NS + WAY_NS) {
            let long = (now_ns - since) as f64 * 1e-6;
            return Err(format!("for {long:.0} ms it is {is:.3}, {away:.3} from every command, and goes on"));
        }
        if now_ns > fault_ns + RUN_NS {
            return Ok(None);
        }
    }
}

fn plant_fault(script: &LoopScript, world: &World, now_ns: u64) {
    let frame = |kind| world.bus(0).plant(MASTER, Fault::new(kind).id(0x204).from(now_ns));
    let effect = |effect| world.bench().hook(Hook { node: SERVO, effect, start: Start::At(now_ns), lasts_ns: None });
    match (script.ill, script.rig.sort) {
        (Ill::Nothing, _) => {}
        (Ill::Stale, _) => frame(Planting::Stale),
        (Ill::Lost, _) => frame(Planting::Drop),
        (Ill::Weak(part), _) => effect(Effect::TorqueScale(part)),
        (Ill::Tells(factor), Sort::PositionServo) => effect(Effect::EncoderScale(factor)),
        (Ill::Tells(factor), _) => effect(Effect::SpeedScale(factor)),
    }
}

/// Simplifies a failing script while it still fails.
fn shrunk(script: &LoopScript, why: String) -> (LoopScript, String) {
    let changes: [fn(&mut LoopScript); 6] = [
        |script| script.ill = Ill::Nothing,
        |script| script.rig.eager = false,
        |script| script.rig.swing = 0.8,
        |script| script.rig.hertz = 0.2,
        |script| (script.delay, script.lag) = (0.8e-3, 0.6e-3),
        |script| script.after = 100 * MS,
    ];
    generated::shrunk(script, why, |script| changed(script, &changes), run)
}

#[test]
fn an_unexplained_speed_or_position_stops_the_rig_within_a_second() {
    let seeds = seeds(RUNS);
    let runs = seeds.end - seeds.start;
    let (mut stopped, mut longest_ns) = (0, 0);
    let failed = hold(seeds, LoopScript::of, run, shrunk, |after| {
        stopped += u64::from(after.is_some_and(|after| after > PATIENCE_NS / 2));
        longest_ns = longest_ns.max(after.unwrap_or(0));
    });
    let longest = longest_ns as f64 * 1e-6;
    println!(
        "{runs} runs: {stopped} were found by this watch, after {longest:.0} ms at most; {} failed: {failed:?}",
        failed.len()
    );
    assert!(failed.is_empty());
    assert!(runs < RUNS || stopped > 5, "{stopped} of {runs} were found by this watch");
}
