//! Runs the straight-line program: an interpreter that says what is right, and machine code that agrees to the bit.
//!
//! Cranelift is known to `clif`, `target` and `jit` only.

pub mod interp;
mod clif;
pub mod target;
pub mod jit;
pub mod blob;
pub mod c;
pub mod wide;
#[cfg(test)]
mod agree;
