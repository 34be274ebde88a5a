//! Numerical methods as program transformations: automatic differentiation, fixed steps and the adaptive step.
//!
//! In: the functions of a model as straight-line programs. Out: further straight-line functions, such as Jacobians,
//! gradients, or one step of a method. Knows neither the language nor any back end.

pub mod autodiff;
pub mod impulse;
pub mod switching_conditions;
pub mod state_partition;
pub mod sparse_lu;
pub mod fixed_step;
pub mod rosenbrock;
