//! Runs the straight-line program: an interpreter that says what is right, and machine code that agrees to the bit.
//!
//! Cranelift is known to `clif`, `pieces`, `target`, `memory`, `jit` and `lanes::pairs` only.

pub mod unsupported;
mod specialise_modes;
mod unswitch;
mod select_to_branch;
mod sink;
mod emit;
mod reroll;
mod outline;
mod emit_outlined;
mod emit_f64x2;
mod hoist_params;
pub mod target;
mod executable_memory;
pub mod lanes;
mod loop_distribution;
pub mod jit;
pub mod image;
pub mod c;
pub mod tiering;
pub mod passes;
pub mod elementary;
#[cfg(test)]
mod agreement;
