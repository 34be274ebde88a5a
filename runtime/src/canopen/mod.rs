//! CANopen, as far as a rig needs it: what a master says to a node and what a node answers.
//!
//! In: frames, and the time as an argument. Out: frames. Nothing here waits, owns a bus or, once set up, allocates; the
//! same [`ObjectDictionary`] stands behind a simulated drive and behind what the master knows of a real one. Knows
//! nothing of motors. Source: CiA 301, version 4.2.

pub mod abort;
pub mod object;
pub mod service;
pub mod sdo;
pub mod pdo;
pub mod eds;
pub mod node;

pub use abort::Abort;
pub use object::{Access, Object, ObjectDictionary, Type};
pub use service::{Nmt, NmtState, Service};

/// Takes the frames that go out.
pub type Send<'a> = &'a mut dyn FnMut(crate::can::Frame);
