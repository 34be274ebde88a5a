//! The adaptive step, as shared by compiled code and runtime: the Rosenbrock method of order 5, its step control, and
//! the slots of a trial step.

pub mod step_control;
pub mod layout;
pub mod coefficients;
