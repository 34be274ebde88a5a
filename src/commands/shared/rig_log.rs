//! Opens a rig's log for a command: reports what is wrong with the texts in it.

use crate::report;
pub(in crate::commands) use crate::rig_log::Opened;
use crate::terminal::Terminal;
use std::path::Path;

/// Opens a log.
///
/// # Errors
/// Why not; what is wrong with the texts in it is reported on the terminal.
pub(in crate::commands) fn open(path: &Path, interpret: bool, terminal: &Terminal) -> Result<Opened, String> {
    crate::rig_log::open(path, interpret).map_err(|refused| {
        if let Some((loaded, found)) = &refused.texts {
            terminal.report(&report::full(&loaded.files.0, found, terminal.error_colour()));
        }
        refused.why
    })
}
