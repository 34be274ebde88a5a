//! Characterises a friction model with the standard battery of experiments.
//!
//! In: a model as a user writes it, `LuGre(vd = 10 mm/s)`. Out: a [`Study`]: the experiments, the measured behaviour,
//! and the phenomena that it shows. The battery is text that is compiled and run like any other, so a user can read it,
//! change it and run it again. Knows no files and no terminal.

pub mod subject;

mod bench;

mod battery;

mod measured;

mod phenomena;

mod study;

pub mod page;

pub mod latex;

#[cfg(test)]
pub use measured::Test;
pub use measured::shown;
pub use phenomena::Seen;
pub use study::{Extent, Study, drawn, family, study};
