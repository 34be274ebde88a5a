//! Drives: what is known of their kinds, how a rig talks to them, and how they are simulated.
//!
//! In: a [`abi::rig::Rig`], frames, the time, permitted commands in SI. Out: frames, signals in SI with their age, and
//! what went wrong. A [`Fieldbus`] is the rig's side of all buses, a [`Bench`] the other side: simulated drives and
//! devices on one shaft. Neither waits, and neither decides what to do about a fault: that is the supervisor's.

pub mod profiles;
pub mod state;
pub mod units;
pub mod frames;
pub mod timing;
pub mod trouble;
pub mod script;
pub mod sign;
pub mod master;
pub mod device;
pub mod fieldbus;
pub mod hooks;
pub mod simulated;
pub mod bench;
pub mod attend;
pub mod serve;

pub use attend::attend;
pub use bench::{Bench, Shaft};
pub use fieldbus::{Fieldbus, Options, Request, Step};
pub use hooks::{Effect, Hook, Start};
pub use master::{Limits, Status};
pub use trouble::{Reading, Refusal, Trouble, TroubleKind, Why};

/// Takes the frames that go out: the bus (an index into [`abi::rig::Rig::buses`]) and the frame.
pub type Send<'a> = &'a mut dyn FnMut(usize, crate::can::Frame);

#[cfg(test)]
mod samples;
#[cfg(test)]
mod tests;
