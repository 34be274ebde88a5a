//! Front end: from texts to one flat system of equations, checked for units and causality.
//!
//! In: syntax trees and [`Sources`](source::Sources). Out: a [`System`](system::System) with the dimension of every
//! expression, and diagnostics. Knows nothing of programs, except for constants and the buffers of delays.

pub mod names;
pub mod literals;
pub mod source;
pub mod resolve;
pub mod system;
pub mod columns;
pub mod turns;
pub mod tables;
pub mod flatten;
pub mod units;
pub mod angles;
pub mod delays;
pub mod causality;
