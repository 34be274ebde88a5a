//! Hardware in the loop (HIL): the real-time cycle that couples model, safety supervisor, drives and buses.
//!
//! In: a rig, its compiled programs, buses, a clock. Out: commands to drives, a log, and the reason for the stop. Knows
//! neither the language nor the terminal.

pub mod coupling;
pub mod standard;
pub mod watches;
pub mod followed;
pub mod control;
pub mod line;
pub mod live;
pub mod origin;
pub mod chair;
pub mod trace;
pub mod replay;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod emergency;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod wires;
pub mod counts;
pub mod words;
pub mod stage;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod operator;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod cycle;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod identify;
pub mod simulated;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod session;

#[cfg(test)]
mod tests;

#[cfg(test)]
mod campaign;

#[cfg(test)]
mod live_tests;

#[cfg(test)]
mod faults;

#[cfg(test)]
mod endings;

#[cfg(test)]
mod disks;

#[cfg(test)]
mod contacts;

#[cfg(test)]
mod stalls;

#[cfg(test)]
mod kills;
