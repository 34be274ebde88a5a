//! Fixtures of tests: models, drives and rigs written by hand.

pub mod models;
pub mod drives;
pub mod rigs;
