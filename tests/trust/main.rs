//! Properties of results over the library, its methods and the space of their parameters, with printed seeds.

mod estimate;
mod invariance;

#[path = "../support/mod.rs"]
mod support;
