//! Syntax tree to machine code: resolve, flatten, check, lower, and the back ends.
//!
//! Text in, values out: no files, no clock.

pub mod ir;
pub mod math;
pub mod opt;
pub mod backend;
