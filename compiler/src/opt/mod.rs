//! Passes that change how something is computed, before all back ends, so that these still agree to the bit.

pub mod regroup;
pub mod contract;
pub mod limited;
pub mod watched;
