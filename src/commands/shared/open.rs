//! `--open`: shows a written file with the program that the desktop has for it.

use crate::terminal::Terminal;
use std::path::Path;
use std::process::{Command, Stdio};

/// The program that opens files, unless `FRIC_OPENER` names another.
const OPENER: &str = match () {
    () if cfg!(target_os = "macos") => "open",
    () if cfg!(windows) => "explorer",
    () => "xdg-open",
};

/// Opens a file, without waiting for the program that shows it. A failure is reported: the file is written anyway.
pub(in crate::commands) fn open(path: &Path, terminal: &Terminal) {
    let opener = std::env::var_os("FRIC_OPENER").filter(|name| !name.is_empty()).unwrap_or_else(|| OPENER.into());
    let begun =
        Command::new(&opener).arg(path).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    if let Err(error) = begun {
        terminal.report(&format!(
            "cannot open {}: {} does not start ({error}); FRIC_OPENER names another program\n",
            path.display(),
            opener.to_string_lossy()
        ));
    }
}
