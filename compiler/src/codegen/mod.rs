//! Code generation: machine code and C from the straight-line functions of the IR.
//!
//! In: functions that [`opt`](crate::opt) has optimised and [`math`](crate::math) has expanded to arithmetic. Out:
//! machine code in the memory of this process, an image for another processor, or C source. Every back end returns the
//! same bits as [`ir::interpret`](crate::ir::interpret); the tests in `agreement` check that. Only `emit`,
//! `emit_outlined`, `emit_f64x2`, `target`, `jit` and `executable_memory` know Cranelift.
//!
//! The passes in the order in which they run; `passes` lists those of the step with their conditions:
//!
//! ```text
//! tiering             interprets a function first; calls jit once it has run often enough
//! jit, image → target one function after the other:
//!   one iteration       drop the step counter → hoist_params (jit only) → unswitch → specialise_modes
//!                       → sink, select_to_branch → emit → Cranelift
//!   any count           emit: a loop, its invariants hoisted, with select_to_branch → Cranelift
//!   long functions      outline, which calls reroll → emit_outlined → Cranelift; instead of the two above
//! jit                 loop_distribution: the step as a vectorised loop and a remaining one
//! lanes               isel → schedule → regalloc → assembler, or emit_f64x2 → Cranelift
//! c                   C source, directly from the expanded functions
//! ```

pub mod unsupported;
mod specialise_modes;
mod unswitch;
mod select_to_branch;
mod sink;
mod emit;
mod reroll;
mod outline;
mod emit_outlined;
mod loop_plan;
mod emit_f64x2;
pub mod hoist_params;
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
