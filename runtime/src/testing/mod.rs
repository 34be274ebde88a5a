//! Test fixtures: hand-written models, drives and rigs; generated tests.

pub mod nodes;
pub mod models;
pub mod drives;
pub mod rigs;
pub mod generated;
