//! Code generation: machine code and C from the straight-line functions of the IR.
//!
//! In: functions that [`opt`](crate::opt) has optimised and [`math`](crate::math) has expanded to arithmetic. Out:
//! machine code in the memory of this process, an image for another processor, or C source. Every back end but `python`
//! returns the same bits as [`ir::interpret`](crate::ir::interpret); the tests in `agreement` check that. Only `emit`,
//! `emit_f64x2`, `target`, `jit` and `executable_memory` know Cranelift.
//!
//! ```text
//! tiering             interprets a function first; calls baseline and jit once it has run often enough
//! jit, image → target one function after the other: passes → emit → Cranelift
//!   passes            the list of all passes over control-flow graphs, in order
//! lanes               isel → schedule → regalloc → assembler, or emit_f64x2 → Cranelift
//!   baseline          the same for a single instance, soon made, for runs that end before optimised code exists
//! c                   C source, directly from the expanded functions
//! python              Python source of derivatives and outputs for other libraries, within rounding
//! ```

pub mod unsupported;
mod side_exit;
mod drop_counter;
mod hoist_params;
mod loop_distribution;
mod specialise_modes;
mod unswitch;
mod form_loop;
mod predictive_commoning;
mod reroll;
mod outline;
mod hoist_invariants;
mod sink;
mod select_to_branch;
pub mod forms;
pub mod passes;
mod emit;
mod loop_plan;
mod emit_f64x2;
pub mod target;
mod executable_memory;
pub mod lanes;
pub mod jit;
pub mod image;
pub mod c;
pub mod python;
pub mod tiering;
pub mod pass_report;
pub mod elementary;
#[cfg(test)]
mod agreement;
