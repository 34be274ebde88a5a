//! Code shared by several commands: sessions with files under change, the comparison of two solvers, packages of rigs,
//! progress bars, `--open`.

pub mod cross_check;
pub mod package;
pub mod progress;
pub mod rig_log;
pub mod session;
pub mod open;
