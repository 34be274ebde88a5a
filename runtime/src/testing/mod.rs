//! Test fixtures: hand-written models, drives and rigs.

pub mod models;
pub mod drives;
pub mod rigs;
