//! The `fric` command: connects the crates with the user.
//!
//! In: arguments, files, a terminal. Out: messages, plots, files, an exit code. The compiler interprets texts and the
//! runtime executes runs; this crate combines them. `main.rs` is the program; other programs call [`main_with`], and use
//! texts and runs through [`embed`].

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "a closed pipe must not panic: see terminal.rs")]

mod quantity;
mod compile;
mod vary;
mod plot;
mod args;
mod equations;
mod report;
mod characterise;
mod diagram;
mod figure;
mod interrupt;
mod loop_stability;
mod matrices;
mod parquet;
mod recording_files;
mod project;
mod source_snapshot;
mod rig_log;
mod disk;
mod named_files;
mod repl;
mod terminal;
mod timings;
mod results;
mod signing;
mod ssh;
mod unfinished;
mod shown;
mod commands;
pub mod embed;

use commands::End;
use std::ffi::OsString;
use std::time::Instant;

/// Runs the command with these arguments, the name of the program first; returns the exit code. Ends the process if the
/// arguments are wrong or ask for help.
pub fn main_with(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let begin = Instant::now();
    let args = args::parse(arguments);
    match commands::run(&args, begin, &mut terminal::Terminal::new()) {
        End::Fine => 0,
        End::Failed => 1,
        End::Misused => 2,
        End::Stopped => 3,
    }
}
