//! CANopen services that a rig needs, on both the master's and the node's side.
//!
//! In: frames, and the time as an argument. Out: frames. Nothing here blocks, owns a bus or, once set up, allocates;
//! the same [`ObjectDictionary`] is used for a simulated drive and for the master's knowledge of a real one. Knows
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

/// Callback that sends a frame.
pub type Send<'a> = &'a mut dyn FnMut(crate::can::Frame);
