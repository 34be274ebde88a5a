//! Drives: profiles of their kinds, the communication of a rig with them, and their simulation.
//!
//! In: a [`abi::rig::Rig`], frames, the time, permitted commands in SI. Out: frames, signals in SI with their ages, and
//! reports of faults. A [`Fieldbus`] is the rig's side of all buses, a [`SimulatedBench`] the other side: simulated drives and
//! devices on one shaft. Neither blocks, and neither decides how to react to a fault: the supervisor does.

pub mod profiles;
pub mod state;
pub mod units;
pub mod frames;
pub mod timing;
pub mod faults;
pub mod sdo_sequence;
pub mod polarity_check;
pub mod cia402;
pub mod device;
pub mod fieldbus;
pub mod fault_injection;
pub mod simulated;
pub mod simulated_plant;
pub mod bus_stub;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod serve;

pub use crate::drive::bus_stub::attend;
pub use crate::drive::cia402::{Limits, Status};
pub use crate::drive::fault_injection::{Effect, Hook, Start};
pub use crate::drive::faults::{Reading, Refusal, RefusalReason, Trouble, TroubleKind};
pub use crate::drive::simulated_plant::{Shaft, SimulatedBench};
pub use fieldbus::{Fieldbus, Options, Request, Step};

/// Callback that sends a frame: the bus (an index into [`abi::rig::Rig::buses`]) and the frame.
pub type Send<'a> = &'a mut dyn FnMut(usize, crate::can::Frame);

#[cfg(test)]
mod tests;
