//! What quantities can be: interval arithmetic over doubles, and the intervals of a system's quantities.
//!
//! In: a flat system with declared ranges. Out: for each expression an interval that holds whatever parameters, inputs and states
//! are within their ranges.

pub mod interval;
pub mod reach;
