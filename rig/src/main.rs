//! The `fric-rig` command: what runs on the computer beside the drives.
//!
//! In: a package that `fric build` made. Out: a running rig, or the reason why not. Has no compiler: what it runs was
//! checked and compiled elsewhere, and is refused if a single bit of it changed on the way.

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "a closed pipe must not panic: see words.rs")]

mod words;

mod packed;

mod store;

mod doctor;

use clap::{Parser, Subcommand, ValueHint};
use std::path::PathBuf;
use std::process::ExitCode;

/// Checks and runs packed rigs
#[derive(Parser, Debug)]
#[command(name = "fric-rig", version, arg_required_else_help = true, after_help = EXIT_CODES)]
struct Args {
    #[command(subcommand)]
    command: Command,
}

const EXIT_CODES: &str =
    "Exit codes: 0 ended as asked, 1 refused or bad input, 2 wrong usage, 3 stopped by safety or a `stop` condition.";

#[derive(Subcommand, Debug)]
enum Command {
    /// Verify a package: whole, for this computer, of this version, signed if keys are trusted
    Check(Check),
    /// Say whether this computer can keep time, and what to change
    Doctor,
    /// Make a package the one that runs next; the one before is kept for `rollback`
    Install(Install),
    /// Make the package before the current one the current one again
    Rollback(Store),
    /// Say what is installed, and what runs
    Status(Store),
    /// Print the target that packages must be built for
    Target,
}

#[derive(clap::Args, Debug)]
struct Check {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: PathBuf,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct Trust {
    /// Folder with the public keys that are trusted; with one in it, packages must be signed
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, default_value = runtime::package::signature::TRUSTED)]
    trusted: PathBuf,
}

#[derive(clap::Args, Debug)]
struct Install {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: PathBuf,
    #[command(flatten)]
    store: Store,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct Store {
    /// Folder of the packages and logs
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, default_value = store::DEFAULT)]
    dir: PathBuf,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let done = match &args.command {
        Command::Check(check) => packed::open(&check.package, &check.trust.trusted).map(|open| open.describe()),
        Command::Doctor => Ok(doctor::doctor()),
        Command::Install(install) => packed::open(&install.package, &install.trust.trusted)
            .and_then(|open| store::Store::at(&install.store.dir).install(&open)),
        Command::Rollback(store) => store::Store::at(&store.dir).rollback(),
        Command::Status(store) => store::Store::at(&store.dir).status(),
        Command::Target => Ok(format!("{}\n", runtime::package::here())),
    };
    match done {
        Ok(text) => {
            words::print(&text);
            ExitCode::SUCCESS
        }
        Err(why) => {
            words::error(&why);
            ExitCode::from(1)
        }
    }
}
