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

/// Applies `FRIC_LANES`, with which tests stand in for other processors: docs/machine-code.md. To be called before any code
/// is compiled.
///
/// # Errors
/// If it is none of the numbers that there are.
pub fn limit_lanes() -> Result<(), String> {
    const NAME: &str = "FRIC_LANES";
    let Some(given) = std::env::var_os(NAME).filter(|given| !given.is_empty()) else { return Ok(()) };
    match given.to_str() {
        Some(known @ ("0" | "1" | "2" | "4" | "8")) => {
            compiler::codegen::target::limit_lanes(known.parse().expect("a digit"));
            Ok(())
        }
        _ => Err(format!(
            "{NAME}={}: the most numbers of a vector are 0 (interpreter), 1, 2, 4 (AVX2) or 8 (AVX-512); unset it to use \
             what the processor has",
            given.display()
        )),
    }
}

/// Runs the command with these arguments, the name of the program first; returns the exit code. Ends the process if the
/// arguments are wrong or ask for help.
pub fn main_with(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let begin = Instant::now();
    let args = args::parse(arguments);
    let mut terminal = terminal::Terminal::new();
    if let Err(why) = limit_lanes() {
        terminal.error(&why);
        return 2;
    }
    match commands::run(&args, begin, &mut terminal) {
        End::Fine => 0,
        End::Failed => 1,
        End::Misused => 2,
        End::Stopped => 3,
    }
}
