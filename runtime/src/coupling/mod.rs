//! The coupling of a contact model to a shaft through drives: lags, predictors, the energy they give back, and whether the loop is
//! stable; and the same loop without a rig ([`sil`]).
//!
//! In: a rig's description, readings, torques. Out: predictions, energies, eigenvalues, verdicts. Knows neither buses nor clocks.

pub mod lag;
pub mod predictor;
pub(crate) mod sil;
pub mod eigenvalues;
pub mod passivity;
pub mod loop_stability;
