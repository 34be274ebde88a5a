//! The adaptive step as compiled code and the runtime agree on it: Rosenbrock's method of order 5, its step control, and where the
//! numbers of a trial step lie in the block.

pub mod step_control;
pub mod layout;
pub mod coefficients;
