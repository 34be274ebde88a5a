//! The `fric` command: connects the crates with the user.
//!
//! In: arguments, files, a terminal. Out: messages, plots, files, an exit code. The compiler interprets texts and the
//! runtime executes runs; this crate combines them.

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
mod repl;
mod terminal;
mod timings;
mod results;
mod signing;
mod ssh;
mod unfinished;
mod shown;
mod commands;

use commands::End;
use std::process::ExitCode;
use std::time::Instant;

fn main() -> ExitCode {
    let begin = Instant::now();
    let args = args::parse();
    match commands::run(&args, begin, &mut terminal::Terminal::new()) {
        End::Fine => ExitCode::SUCCESS,
        End::Failed => ExitCode::from(1),
        End::Misused => ExitCode::from(2),
        End::Stopped => ExitCode::from(3),
    }
}
