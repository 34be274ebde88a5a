//! Failures that the generator has found, shrunk, as named regression tests.

use super::holds;
use super::rigs::{Made, PLAIN, Sort::*};
use super::space::{EVER, Fault, Ill::*, MS, Phase::*, Script, What::*};
use crate::drive::Effect;

/// A set-point that the bus refused was forgotten; seed 16.
#[test]
fn a_set_point_that_is_refused() {
    for id in [0x203, 0x204] {
        let fault = Fault { what: Frame(0, id, Refused), phase: Moving, after: 0, lasts: EVER };
        holds(&Script { faults: vec![fault], ..Script::plain(Pair) });
    }
}

/// A set-point that was lost on the bus was never noticed; seed 384.
#[test]
fn a_set_point_that_is_lost() {
    for id in [0x203, 0x204] {
        let fault = Fault { what: Frame(0, id, Lost), phase: Moving, after: 0, lasts: EVER };
        holds(&Script { faults: vec![fault], ..Script::plain(Pair) });
    }
}

/// A stop uses the path of the set-points; seeds 51 and 128.
#[test]
fn stop_frames_that_do_not_arrive() {
    for ill in [Lost, Refused, Stale] {
        let fault = Fault { what: Frame(0, 0x204, ill), phase: Change, after: 0, lasts: EVER };
        holds(&Script { faults: vec![fault], ..Script::plain(Pair) });
    }
}

/// A limit between two quantisation steps was rounded up; seed 256.
#[test]
fn a_limit_between_two_steps_of_the_wire() {
    holds(&Script { rig: Made { swing: 2.5, rated: 3.0, most: 0.2, ..PLAIN }, ..Script::plain(Pair) });
}

/// A request beyond its range rose faster than the ramp; seed 93.
#[test]
fn a_request_beyond_its_range_that_comes_up() {
    holds(&Script { rig: Made { swing: 3.1, eager: true, ..PLAIN }, ..Script::plain(Pair) });
}

/// A drive described by frames received its safe value from the first cycle on; seed 23.
#[test]
fn a_safe_value_that_moves_a_drive_described_by_frames() {
    holds(&Script { rig: Made { sort: FramesServo, safe: 0.36, ..PLAIN }, ..Script::plain(FramesServo) });
}

/// Answers that were late in each tick were never accepted and never counted as missing; seed 1701.
#[test]
fn answers_that_are_late_in_each_tick() {
    for (id, ill) in [(0x183, Late(700_000)), (0x080, Swapped)] {
        let fault = Fault { what: Frame(0, id, ill), phase: Moving, after: 0, lasts: EVER };
        holds(&Script { faults: vec![fault], ..Script::plain(Pair) });
    }
}

/// A drive that braked in the wrong direction kept its torque, because it accepted no set-points any more; seed 834.
#[test]
fn a_quick_stop_that_does_not_end() {
    let wrong = Fault { what: Node(0, Effect::TorqueScale(-1.0)), phase: Moving, after: 0, lasts: EVER };
    let unplugged = Fault { what: Unplugged(0), phase: Change, after: 0, lasts: 40 * MS };
    holds(&Script { faults: vec![wrong, unplugged], ..Script::plain(Pair) });
}

/// Sets beyond the number that a cycle could hold vanished; seed 0.
#[test]
fn many_sets_of_parameters_at_once() {
    holds(&Script { sets: 40, ..Script::plain(Pair) });
}

/// A drive that accepts no set-points keeps an old one, and applies it until the rig notices that it does not follow;
/// seed 21824.
#[test]
fn an_old_set_point_at_the_next_start() {
    for node in [0, 1] {
        let fault = Fault { what: Node(node, Effect::IgnoresCommands), phase: Moving, after: 179_687, lasts: EVER };
        holds(&Script { again: true, faults: vec![fault], ..Script::plain(Pair) });
    }
}

/// A drive kept turning the shaft for a minute, for the sign check of another drive whose encoder stood still; seed
/// 13685.
#[test]
fn an_encoder_that_stands_still_while_another_drive_turns_it() {
    for sort in [SpeedServo, PositionServo] {
        let fault = Fault { what: Node(0, Effect::EncoderFrozen), phase: StartUp, after: 0, lasts: EVER };
        holds(&Script { tested: true, faults: vec![fault], ..Script::plain(sort) });
    }
}

/// Small torques from corrupted frames before arming, below the resolution of the check; seed 10000.
#[test]
fn set_points_that_are_wrong_from_the_start() {
    let fault = Fault { what: Frame(0, 0x203, Corrupted), phase: StartUp, after: 0, lasts: EVER };
    holds(&Script { seed: 10_000, tested: true, faults: vec![fault], ..Script::plain(Pair) });
}

/// Where drives wait for SYNC, and SYNC waits in every other tick for our heartbeat, the shaft is read late and early
/// in turn, so that position and speed seemed to disagree; seed 94031.
#[test]
fn a_shaft_that_is_read_late_and_early_in_turn() {
    holds(&Script { rig: Made { swing: 0.9683128397509957, at_sync: true, ..PLAIN }, ..Script::plain(Pair) });
}

/// A device that sends NaN kept its last value for ever, if the rig named no time-out for it.
#[test]
fn a_speed_that_is_no_number() {
    for which in [-1, 0, 1] {
        let fault = Fault { what: NoNumber(1, which), phase: Moving, after: 0, lasts: EVER };
        holds(&Script {
            rig: Made { sort: FramesServo, float: true, ..PLAIN },
            faults: vec![fault],
            ..Script::plain(FramesServo)
        });
    }
}
