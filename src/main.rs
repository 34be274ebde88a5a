//! The program `fric`: the command with the arguments of this process.

use std::process::ExitCode;

fn main() -> ExitCode {
    fric::main_with(std::env::args_os()).into()
}
