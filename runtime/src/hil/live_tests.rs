//! Tests of arbitrarily many commands and sets of parameters at once: each is answered exactly once, and after each
//! cycle all conditions of a start hold.

use super::campaign::quick;
use super::control;
use super::coupling::look_ahead;
use super::cycle::{Hil, Options};
use super::line::Mark;
use super::live::{Judge, Objection, Set};
use super::operator::{Answer, Attention, Command, Operator, PLACES, Reason, Stamp, Ticket, Watched};
use super::origin::Origin;
use super::simulated::{Pace, World};
use crate::drive::Step;
use crate::realtime::clock::monotonic_ns;
use crate::rng::Chance;
use crate::safety::Cause;
use crate::testing::rigs;
use abi::Slot;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

const MS: u64 = 1_000_000;

struct Stand {
    hil: Hil,
    operator: Operator,
    judge: Judge,
    world: World,
    slots: [Slot; 3],
}

impl Stand {
    fn new(arms_itself: bool) -> Stand {
        let (rig, model, plant) = rigs::pair();
        let look = look_ahead(&rig, &plant).unwrap();
        let mut options = Options { arms_itself, look, ..quick() };
        // A command may stay at its limit as long as on a real rig.
        options.control.clamped_ns = control::Options::default().clamped_ns;
        let judge = rigs::judge(&model);
        let slots = [0, 1, 2].map(|i| model.description().layout.params.slot(i));
        let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
        let masters = world.masters();
        let (mut hil, operator) = Hil::new(&rig, model, world.clock(), masters, options, None).unwrap();
        hil.judged_by(judge.clone());
        Stand { hil, operator, judge, world, slots }
    }

    fn reach(&mut self, step: Step) {
        while self.hil.step() != step {
            self.hil.cycle();
            assert_eq!(self.hil.ended(), None, "before {step}");
        }
    }

    fn present(&self) -> [f64; 3] {
        let model = self.hil.control().unwrap().model();
        self.slots.map(|slot| model.get(slot))
    }

    fn set(&self, values: &[(usize, f64)]) -> Command {
        let values: Vec<(Slot, f64)> = values.iter().map(|(i, value)| (self.slots[*i], *value)).collect();
        Command::Set(Set::new(&values).unwrap())
    }
}

/// `FRIC_RUNS` sets the number of seeds; `FRIC_SEED` repeats one.
#[test]
fn each_command_is_answered_once_and_accepted_sets_act() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let runs = number("FRIC_RUNS").unwrap_or(30);
    let mut counts: HashMap<&str, u64> = HashMap::new();
    for seed in number("FRIC_SEED").map_or((0..runs).collect::<Vec<u64>>(), |seed| vec![seed]) {
        let mut chance = Chance(seed);
        let mut stand = Stand::new(true);
        if chance.below(4) > 0 {
            stand.reach(Step::Armed);
        }
        let mut open: Vec<(Ticket, Command)> = Vec::new();
        let mut shadow: Option<[f64; 3]> = None;
        for _ in 0..40 {
            // Bursts that overflow the queue.
            let burst = [0, 0, 1, 3, 90][chance.below(5) as usize];
            for _ in 0..burst {
                let command = match 1 + chance.below(12) {
                    1 => Command::Enable,
                    2 => Command::Arm,
                    3 => stand.set(&[(0, f64::NAN)]),
                    12 => Command::Mark(Mark::new("second bearing").unwrap()),
                    4 => Command::Set(Set::new(&[(Slot(2), 1.0)]).unwrap()),
                    k if k < 8 => stand.set(&[(0, chance.between(-0.1, 1.1))]),
                    k if k < 10 => stand.set(&[(1, chance.between(-0.05, 0.3))]),
                    _ => stand.set(&[(0, chance.between(0.0, 1.0)), (1, chance.between(0.0, 0.5))]),
                };
                match stand.operator.say(command) {
                    Ok(ticket) => open.push((ticket, command)),
                    Err(why) => {
                        assert_eq!(why, Reason::Full, "seed {seed}");
                        assert!(open.len() >= PLACES, "seed {seed}: full with {} under way", open.len());
                        *counts.entry("full").or_default() += 1;
                    }
                }
            }
            let before = stand.hil.control().map(|_| stand.present());
            stand.hil.cycle();
            assert_eq!(stand.hil.ended(), None, "seed {seed}");
            let mut taken = 0;
            let present = stand.hil.control().map(|_| stand.present());
            shadow = shadow.or(before).or(present);
            open.retain(|(ticket, command)| {
                let Some(answer) = stand.operator.answer(*ticket) else { return true };
                assert_eq!(stand.operator.answer(*ticket), None, "seed {seed}: an answer is given once");
                match (answer, command) {
                    (Answer::Taken(k), Command::Set(set)) => {
                        // The cycle that it names is the one whose record holds it.
                        assert_eq!(k, Some(stand.hil.last().k), "seed {seed}");
                        assert_eq!(stand.hil.last().set, set.values(), "seed {seed}");
                        taken += 1;
                        for (slot, value) in set.values() {
                            let i = stand.slots.iter().position(|known| known == slot).unwrap();
                            shadow.as_mut().unwrap()[i] = *value;
                        }
                        *counts.entry("taken").or_default() += 1;
                    }
                    (Answer::Refused(Reason::Set(Objection::Broken(..))), Command::Set(_)) => {
                        *counts.entry("broken").or_default() += 1;
                    }
                    (Answer::Refused(Reason::Set(_) | Reason::NotNow(_)), Command::Set(_)) => {
                        *counts.entry("refused").or_default() += 1;
                    }
                    (Answer::Taken(_) | Answer::Refused(Reason::NotNow(_)), _) => {
                        *counts.entry("other").or_default() += 1
                    }
                    (answer, command) => panic!("seed {seed}: {} gave {answer:?}", command.name()),
                }
                false
            });
            assert!(taken <= 1, "seed {seed}: one set a cycle");
            if let (Some(present), Some(shadow)) = (present, shadow) {
                assert_eq!(present.map(f64::to_bits), shadow.map(f64::to_bits), "seed {seed}");
                let block = stand.hil.control().unwrap().model().block().to_vec();
                assert_eq!(stand.judge.holds(&block), Ok(()), "seed {seed}: {present:?}");
                let [swing, damping, _] = present;
                assert!((0.0..=1.0).contains(&swing) && damping > 0.0 && swing >= 2.0 * damping, "seed {seed}");
            }
        }
        // No further commands: every waiting command is answered.
        for _ in 0..=PLACES {
            stand.hil.cycle();
            open.retain(|(ticket, _)| stand.operator.answer(*ticket).is_none());
        }
        assert_eq!(open.len(), 0, "seed {seed}: {} commands without an answer", open.len());
    }
    for answer in ["full", "taken", "broken", "refused", "other"] {
        assert!(counts.get(answer).is_some_and(|n| *n > 10), "{answer}: {counts:?}");
    }
}

#[test]
fn a_stop_acts_at_once_regardless_of_waiting_commands() {
    let mut stand = Stand::new(true);
    stand.reach(Step::Armed);
    let set = stand.set(&[(0, 0.5)]);
    while stand.operator.say(set).is_ok() {}
    stand.operator.stopper().stop(Origin::Prompt);
    stand.hil.cycle();
    let cause = stand.hil.control().unwrap().supervisor().cause();
    assert_eq!(cause, Some(crate::safety::Cause::Asked));
    // As an ordinary command it needs no place either.
    let mut other = Stand::new(true);
    other.reach(Step::Armed);
    let set = other.set(&[(0, 0.5)]);
    while other.operator.say(set).is_ok() {}
    let ticket = other.operator.say(Command::Stop).unwrap();
    assert_eq!(other.operator.answer(ticket), Some(Answer::Taken(None)));
    other.hil.cycle();
    assert_eq!(other.hil.control().unwrap().supervisor().cause(), Some(crate::safety::Cause::Asked));
}

#[test]
fn old_commands_are_refused_except_a_stop() {
    let mut stand = Stand::new(false);
    stand.reach(Step::AwaitEnable);
    let old = Stamp::Rig(0);
    // The rig is not late; the command is too old.
    while stand.world.clock().now_ns() < 1_100 * MS {
        stand.hil.cycle();
    }
    let enable = stand.operator.say_at(Command::Enable, old).unwrap();
    let set = stand.set(&[(0, 0.5)]);
    let set = stand.operator.say_at(set, old).unwrap();
    stand.hil.cycle();
    for ticket in [enable, set] {
        let answer = stand.operator.answer(ticket);
        assert!(matches!(answer, Some(Answer::Refused(Reason::Old(ns))) if ns > 1_000 * MS), "{answer:?}");
    }
    assert_eq!(stand.hil.step(), Step::AwaitEnable);
    let fresh = stand.operator.say(Command::Enable).unwrap();
    stand.hil.cycle();
    assert_eq!(stand.operator.answer(fresh), Some(Answer::Taken(Some(stand.hil.last().k))));
    let stop = stand.operator.say_at(Command::Stop, old).unwrap();
    assert_eq!(stand.operator.answer(stop), Some(Answer::Taken(None)));
    stand.hil.cycle();
    assert_eq!(stand.hil.control().unwrap().supervisor().cause(), Some(crate::safety::Cause::Asked));
}

#[test]
fn a_set_is_accepted_while_the_rig_is_stopped_or_waits() {
    let mut stand = Stand::new(false);
    stand.reach(Step::AwaitEnable);
    let waits = stand.set(&[(0, 0.7)]);
    let waits = stand.operator.say(waits).unwrap();
    stand.hil.cycle();
    assert!(matches!(stand.operator.answer(waits), Some(Answer::Taken(Some(_)))));
    assert_eq!(stand.present()[0], 0.7);
    let mut stand = Stand::new(true);
    stand.reach(Step::Armed);
    stand.operator.stopper().stop(Origin::Prompt);
    stand.hil.cycle();
    let stopped = stand.set(&[(0, 0.9)]);
    let stopped = stand.operator.say(stopped).unwrap();
    stand.hil.cycle();
    assert!(matches!(stand.operator.answer(stopped), Some(Answer::Taken(Some(_)))));
    assert_eq!(stand.present()[0], 0.9);
}

/// Mutants tried: armed by a command without anybody, and by itself; a limit in the wrong direction.
#[test]
fn a_rig_that_must_be_watched_is_armed_and_runs_only_while_it_is() {
    let attention = Attention::new(Duration::from_secs(2));
    assert_eq!((attention.at(0), attention.at(u64::MAX)), (Watched::NotYet, Watched::NotYet));
    attention.seen();
    let now = monotonic_ns();
    for (after, wanted) in
        [(0, Watched::Yes), (1_900, Watched::Yes), (2_100, Watched::NoLonger), (9_000, Watched::NoLonger)]
    {
        assert_eq!(attention.at(now + after * MS), wanted, "after {after} ms");
    }

    let mut stand = Stand::new(false);
    let long = Arc::new(Attention::new(Duration::from_secs(3600)));
    stand.hil.attended_by(long.clone());
    stand.reach(Step::AwaitEnable);
    stand.operator.say(Command::Enable).unwrap();
    stand.reach(Step::AwaitArm);
    let early = stand.operator.say(Command::Arm).unwrap();
    stand.hil.cycle();
    assert_eq!(stand.operator.answer(early), Some(Answer::Refused(Reason::Unwatched)));
    long.seen();
    stand.operator.say(Command::Arm).unwrap();
    stand.reach(Step::Armed);
    (0..50).for_each(|_| stand.hil.cycle());
    assert_eq!(stand.hil.control().unwrap().supervisor().cause(), None);
    // Seen, but longer ago than this one allows.
    let short = Arc::new(Attention::new(Duration::ZERO));
    short.seen();
    stand.hil.attended_by(short.clone());
    stand.hil.cycle();
    assert_eq!(stand.hil.control().unwrap().supervisor().cause(), Some(Cause::Unwatched));
    while stand.hil.ended().is_none() {
        stand.hil.cycle();
    }
    assert!(stand.hil.ended().unwrap().words().contains("nobody watches"));

    // One that arms itself waits until it is seen, and drives without torque need nobody.
    let mut stand = Stand::new(true);
    let long = Arc::new(Attention::new(Duration::from_secs(3600)));
    stand.hil.attended_by(long.clone());
    stand.reach(Step::AwaitArm);
    (0..200).for_each(|_| stand.hil.cycle());
    assert_eq!(stand.hil.step(), Step::AwaitArm);
    long.seen();
    stand.reach(Step::Armed);
    let mut stand = Stand::new(false);
    stand.hil.attended_by(short);
    stand.reach(Step::AwaitEnable);
    (0..50).for_each(|_| stand.hil.cycle());
    assert_eq!(stand.hil.ended(), None);
}

#[test]
fn without_a_judge_every_set_is_refused_and_after_the_end_every_command() {
    let (rig, model, plant) = rigs::pair();
    let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
    let slot = model.description().layout.params.slot(0);
    let (mut hil, mut operator) =
        Hil::new(&rig, model, world.clock(), world.masters(), Options::default(), None).unwrap();
    while hil.step() != Step::AwaitEnable {
        hil.cycle();
    }
    let ticket = operator.say(Command::Set(Set::new(&[(slot, 0.5)]).unwrap())).unwrap();
    let open = operator.say(Command::Enable).unwrap();
    hil.cycle();
    assert_eq!(operator.answer(ticket), Some(Answer::Refused(Reason::Unjudged)));
    drop(hil);
    assert_eq!(operator.answer(open), Some(Answer::Refused(Reason::Ended)));
    assert_eq!(operator.say(Command::Arm), Err(Reason::Ended));
}
