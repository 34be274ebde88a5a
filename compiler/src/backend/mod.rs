//! Runs the straight-line program: an interpreter that says what is right, and machine code that agrees to the bit.
//!
//! Cranelift is known to `clif`, `pieces`, `target`, `memory`, `jit` and `wide::pairs` only.

pub mod interp;
pub mod unsupported;
mod regimes;
mod copies;
mod sides;
mod postpone;
mod clif;
mod repeats;
mod cut;
mod pieces;
mod prepared;
pub mod target;
mod memory;
pub mod wide;
mod ahead;
pub mod jit;
pub mod blob;
pub mod c;
#[cfg(test)]
mod agree;
