//! Counters of a running rig.

use super::coupling;
use crate::realtime::histogram::Histogram;

/// Counters since the start.
#[derive(Clone, Default)]
pub struct Counts {
    /// Cycles in which the model ran.
    pub cycles: u64,
    /// All cycles.
    pub all: u64,
    /// Cycles that began at least one period late.
    pub overruns: u64,
    /// Ticks missed by them.
    pub missed: u64,
    /// Readings of drives that were held from an earlier tick in a cycle of the model.
    pub stale: u64,
    /// Frames lost before they were read.
    pub lost_frames: u64,
    /// Frames that a bus refused to send.
    pub refused_frames: u64,
    /// Error frames, and warnings of buses.
    pub bus_errors: u64,
    /// Outputs clamped by range, slew, power.
    pub clamped: [u64; 3],
    /// Messages that the log dropped.
    pub log_dropped: u64,
    /// Refused sets of parameters.
    pub refused_sets: u64,
    /// Predictor and passivity observers; none: the rig has neither.
    pub coupling: Option<coupling::Counts>,
    /// Lateness of the starts of cycles.
    pub late: Histogram,
    /// Time from the start of a cycle to its last answer.
    pub receive: Histogram,
    /// Time of model and safety.
    pub compute: Histogram,
    /// Time of sending commands.
    pub send: Histogram,
}
