//! Analyses of a checked system or its program, and their reports.
//!
//! In: a flat system, its program, a step. Out: diagnostics, verdicts with their reasons, linear models, explanations.
//! Changes none of its inputs.

pub mod parameter_checks;
pub mod tuning;
pub mod domains;
pub mod memo;
pub mod interval_proof;
pub mod dissipation;
pub mod step_stability;
pub mod acting_mass;
pub mod lints;
pub mod explain;
pub mod step_stability_report;
pub mod linearise;
pub mod explicit;
pub mod pushes;
pub mod slow_sensor;
