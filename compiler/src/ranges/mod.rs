//! Abstract interpretation of a system by intervals.
//!
//! In: a flat system with declared ranges. Out: an interval for each expression, which holds for all parameters, inputs
//! and states within their ranges. Knows nothing of code.

pub mod reach;
