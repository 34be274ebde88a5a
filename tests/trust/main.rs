//! Properties of results over the library, its methods and the space of their parameters, with printed seeds.
//!
//! A plain run tests a few hundred cases; `FRIC_CASES=10000 cargo test --release --test trust` more, `FRIC_SEED=7`
//! others.

mod chance;
mod crossings;
mod delay;
mod estimate;
mod invariance;
mod methods;
mod rest;

#[path = "../support/mod.rs"]
mod support;
