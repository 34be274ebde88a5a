//! Syntax tree to machine code: resolve, flatten, check, lower, and the back ends.
//!
//! Text in, values out: no files, no clock.

pub mod ir;
pub mod math;
pub mod opt;
pub mod program;
pub mod backend;

pub mod names;
pub mod source;
pub mod resolve;
pub mod system;
pub mod tables;
pub mod flatten;
pub mod units;
pub mod causality;
pub mod lower;
pub mod checks;
pub mod experiment;
