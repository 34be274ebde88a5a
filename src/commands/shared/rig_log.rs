//! Opens a rig's log, and compiles the rig from the texts in it.

use crate::commands::load_text;
use crate::compile::{self, Changes, CompiledRig, Options, Stopwatch};
use crate::report;
use crate::source_snapshot::Kept;
use crate::terminal::Terminal;
use panel::follow;
use runtime::hil::control::Control;
use runtime::record::log::Reader;
use std::path::Path;

/// A log, and the rig that wrote it.
pub(in crate::commands) struct Opened {
    pub reader: Reader,
    pub ready: CompiledRig,
    /// All that a cycle computes, as it was before the first one.
    pub control: Control,
}

/// Opens a log.
///
/// # Errors
/// Why not; what is wrong with the texts in it is reported on the terminal.
pub(in crate::commands) fn open(path: &Path, interpret: bool, terminal: &Terminal) -> Result<Opened, String> {
    let reader = Reader::open(path)?;
    let head = reader.head.clone();
    let needed = ["rig", "file", "source", "set"].map(|section| head.text(section));
    let [Some(rig), Some(file), Some(source), Some(set)] = needed else {
        return Err("its head lacks the text of the rig".into());
    };
    let kept = Kept(&head);
    let mut watch = Stopwatch::start("read");
    let broken = || String::from("the rig in it does not compile");
    let mut loaded = load_text(file, source, &kept, terminal, &mut watch).ok_or_else(broken)?;
    let changes = Changes { set: set.lines().map(str::to_string).collect(), ..Changes::default() };
    let options = Options { changes, interpret };
    let ready = compile::rig(&mut loaded, &kept, rig, &options, &mut Vec::new()).map_err(|found| {
        terminal.report(&report::full(&loaded.files.0, &found, terminal.error_colour()));
        broken()
    })?;
    let control = follow::control(&head, &ready.rig, &ready.control, &ready.plant)?;
    Ok(Opened { reader, ready, control })
}
