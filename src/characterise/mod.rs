//! Puts a friction model through the standard battery.
//!
//! In: a model as a user writes it, `LuGre(vd = 10 mm/s)`. Out: a [`Study`]: what was asked of it, what it was seen to
//! do, and which phenomena that shows. The battery is text that is compiled and run like any other, so that a user can
//! read it, change it and run it again. Knows no files and no terminal.

pub mod subject;

mod bench;

mod battery;

mod measured;

mod phenomena;

mod study;

pub mod page;

pub use measured::shown;
pub use phenomena::Seen;
pub use study::{Extent, Study, drawn, study};
