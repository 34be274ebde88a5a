//! The `fric` command: joins the crates and talks to people.
//!
//! In: arguments, files, a terminal. Out: words, plots, files, an exit code. What a text means is the compiler's
//! business, what a run does the runtime's; here they meet.

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "a closed pipe must not panic: see terminal.rs")]

mod args;
mod characterise;
mod commands;
mod compile;
mod diagram;
mod equations;
mod figure;
mod kept;
mod matrices;
mod parquet;
mod plot;
mod project;
mod remote;
mod repl;
mod report;
mod results;
mod sign;
mod stability;
mod terminal;
mod unfinished;
mod value;
mod vary;

use clap::Parser;
use commands::End;
use std::process::ExitCode;

fn main() -> ExitCode {
    let args = args::Args::parse();
    match commands::run(&args, &mut terminal::Terminal::new()) {
        End::Fine => ExitCode::SUCCESS,
        End::Failed => ExitCode::from(1),
        End::Misused => ExitCode::from(2),
        End::Stopped => ExitCode::from(3),
    }
}
