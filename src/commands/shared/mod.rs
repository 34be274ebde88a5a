//! What several commands do: a session of texts under change, the comparison of two models, packages for rigs.

pub mod cross_check;
pub mod package;
pub mod session;
