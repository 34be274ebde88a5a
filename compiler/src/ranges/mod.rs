//! Abstract interpretation of a system by intervals: interval arithmetic over doubles, and the intervals of a system's
//! expressions.
//!
//! In: a flat system with declared ranges. Out: an interval for each expression, which holds for all parameters, inputs
//! and states within their ranges. Knows nothing of code.

pub mod interval;
pub mod reach;
