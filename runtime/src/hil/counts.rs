//! What a rig counts while it runs.

use super::coupling;
use crate::realtime::histogram::Histogram;

/// What was counted.
#[derive(Clone, Default)]
pub struct Counts {
    /// Cycles in which the model ran.
    pub cycles: u64,
    /// Cycles of all kinds.
    pub all: u64,
    /// Times a cycle began a period late or more.
    pub overruns: u64,
    /// Ticks missed by them.
    pub missed: u64,
    /// Readings of drives that a model's cycle had to hold.
    pub stale: u64,
    /// Frames lost before they were read.
    pub lost_frames: u64,
    /// Frames that a bus did not take.
    pub refused_frames: u64,
    /// Error frames, and warnings of buses.
    pub bus_errors: u64,
    /// Outputs clamped by range, slew, power.
    pub clamped: [u64; 3],
    /// Cycles the log dropped.
    pub log_dropped: u64,
    /// Sets of parameters that were refused.
    pub refused_sets: u64,
    /// Looking ahead, and energy of the contacts; none: the rig has neither.
    pub coupling: Option<coupling::Counts>,
    /// How late cycles began.
    pub late: Histogram,
    /// From the begin of a cycle to the last answer read.
    pub receive: Histogram,
    /// Model and safety.
    pub compute: Histogram,
    /// Commands out.
    pub send: Histogram,
}
