//! The stage of a rig: what displays and answers to an operator say about it.
//!
//! In: the step of the start-up and the drive command. Out: the stage, and a gauge that any thread may read.

use crate::drive::Step;
use crate::safety::DriveCommand;
use std::fmt;
use std::sync::atomic::{AtomicU8, Ordering};

/// Stage of a rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Stage {
    /// A step of the start-up, whose last ones are the armed rig and its ends.
    StartUp(Step),
    /// Quick stop.
    QuickStop,
    /// The drives have no torque after a stop.
    TorqueOff,
}

impl Stage {
    /// The stage of a rig at this step, with this drive command.
    pub fn of(step: Step, command: DriveCommand) -> Stage {
        match command {
            DriveCommand::Wait | DriveCommand::Follow => Stage::StartUp(step),
            DriveCommand::QuickStop => Stage::QuickStop,
            DriveCommand::Disable => Stage::TorqueOff,
        }
    }

    /// The command that the rig waits for, as it is typed; `-` if none.
    pub fn awaits(self) -> &'static str {
        match self {
            Stage::StartUp(Step::AwaitEnable) => "enable",
            Stage::StartUp(Step::AwaitArm) => "arm",
            Stage::StartUp(_) | Stage::QuickStop | Stage::TorqueOff => "-",
        }
    }

    /// Whether no drive can have torque: none has been enabled yet, or all have been disabled.
    pub fn is_idle(self) -> bool {
        match self {
            Stage::StartUp(step) => step < Step::Enable,
            Stage::QuickStop => false,
            Stage::TorqueOff => true,
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Stage::StartUp(step) => step.fmt(f),
            Stage::QuickStop => f.write_str("quick stop"),
            Stage::TorqueOff => f.write_str("torque off"),
        }
    }
}

/// A stage that one thread writes and any thread may read. It begins with the first step of the start-up.
#[derive(Debug, Default)]
pub struct StageGauge(AtomicU8);

/// Numbers inside the gauge of the stages after those of the start-up.
const QUICK_STOP: u8 = Step::ALL.len() as u8;
const TORQUE_OFF: u8 = QUICK_STOP + 1;

impl StageGauge {
    /// The stage.
    pub fn get(&self) -> Stage {
        match self.0.load(Ordering::Relaxed) {
            QUICK_STOP => Stage::QuickStop,
            TORQUE_OFF => Stage::TorqueOff,
            step => Stage::StartUp(Step::ALL[usize::from(step)]),
        }
    }

    /// Sets the stage.
    pub fn set(&self, stage: Stage) {
        let number = match stage {
            Stage::StartUp(step) => step as u8,
            Stage::QuickStop => QUICK_STOP,
            Stage::TorqueOff => TORQUE_OFF,
        };
        self.0.store(number, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mutants tried: `QUICK_STOP` one less; `is_idle` with `<=`, or true in a quick stop.
    #[test]
    fn a_gauge_returns_every_stage_and_idle_ones_have_no_torque() {
        let gauge = StageGauge::default();
        assert_eq!(gauge.get(), Stage::StartUp(Step::Listen));
        let steps = Step::ALL.map(Stage::StartUp);
        let mut words = Vec::new();
        for stage in steps.into_iter().chain([Stage::QuickStop, Stage::TorqueOff]) {
            gauge.set(stage);
            assert_eq!(gauge.get(), stage);
            assert!(!words.contains(&stage.to_string()), "{stage} twice");
            words.push(stage.to_string());
        }
        let idle = steps.iter().filter(|stage| stage.is_idle()).count();
        assert_eq!(idle, Step::AwaitEnable as usize + 1, "until the operator enables the drives");
        assert!(Stage::TorqueOff.is_idle() && !Stage::QuickStop.is_idle());
        for step in Step::ALL {
            assert_eq!(Stage::of(step, DriveCommand::Follow), Stage::StartUp(step));
            assert_eq!(Stage::of(step, DriveCommand::Disable), Stage::TorqueOff);
        }
    }
}
