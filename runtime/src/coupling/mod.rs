//! The coupling of a contact model to a shaft through drives: lags, predictor, passivity observer, stability of the
//! loop; and the same loop without hardware (`sil`, software in the loop).
//!
//! In: a rig's description, readings, torques. Out: predictions, energies, eigenvalues, verdicts. Knows neither buses
//! nor clocks.

pub mod lag;
pub mod predictor;
pub mod sil;
pub mod eigenvalues;
pub mod passivity;
pub mod loop_stability;
pub mod open_loop;
