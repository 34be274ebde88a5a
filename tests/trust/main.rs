//! Properties of results over the library, its methods and the space of their parameters.

mod estimate;

#[path = "../support/mod.rs"]
mod support;
