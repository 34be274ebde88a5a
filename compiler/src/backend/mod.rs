//! Runs the straight-line program: an interpreter that says what is right, and machine code that agrees to the bit.
//!
//! Cranelift is known to `clif` and `jit` only.

pub mod interp;
mod clif;
pub mod jit;
#[cfg(test)]
mod agree;
