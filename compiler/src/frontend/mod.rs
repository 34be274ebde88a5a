//! From texts to one flat system of equations, checked for units and causality.
//!
//! In: syntax trees and what reads files. Out: a [`System`](system::System) with the dimension of every expression, an order of
//! evaluation, and diagnostics. Knows nothing of programs but constants and delays.

pub mod names;
pub mod source;
pub mod resolve;
pub mod system;
pub mod columns;
pub mod tables;
pub mod flatten;
pub mod units;
pub mod delays;
pub mod causality;
