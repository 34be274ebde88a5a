//! Passes that change how something is computed, before all back ends, so that these still agree to the bit.

pub mod reassociate;
pub mod contract;
pub mod limiter_tests;
pub mod guard_reduction;
