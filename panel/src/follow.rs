//! Reads a log into a recording, also while it grows.
//!
//! In: a log, and whether more may come. Out: a recording, and a ring of the bell for each change.

use crate::recording::{Played, Recording};
use crate::server::Bell;
use crate::twin::Ahead;
use abi::Instance;
use abi::rig::Rig;
use runtime::hil::control::Control;
use runtime::hil::coupling::look_ahead;
use runtime::hil::trace;
use runtime::record::blocks::End;
use runtime::record::log::{Reader, Sections};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// Polling interval of a log that grows: its writer appends to it ten times a second.
pub const LOOK: Duration = Duration::from_millis(20);

/// All that a cycle computes, as it was before the first cycle of a log with this head.
///
/// # Errors
/// Why not, in words.
pub fn control(head: &Sections, rig: &Rig, control: &Instance, plant: &Instance) -> Result<Control, String> {
    let Some((bounds, settings)) = head.get("settings").and_then(trace::settings_from_bytes) else {
        return Err("its head lacks what the drives said of themselves".into());
    };
    Control::new(rig, control.clone(), look_ahead(rig, plant)?, &bounds, settings)
}

/// Whether a file is a log whose head says that it was started then.
pub fn is_of(file: &Path, started: &str) -> bool {
    Reader::open(file).is_ok_and(|reader| reader.head.text("started") == Some(started))
}

/// Adds all messages that can be read now; returns their number.
///
/// # Errors
/// What is wrong with the log, in words.
pub fn read_on(reader: &mut Reader, recording: &mut Recording) -> Result<u64, String> {
    let mut added = 0;
    while let Some(message) = reader.message().map_err(|error| error.to_string())? {
        if !recording.add(&message) {
            return Err("it holds a cycle that is not of this rig".into());
        }
        added += 1;
    }
    Ok(added)
}

/// Longest dry run beside a recording, s.
const TWIN: f64 = 60.0;

/// Cycles of a short run of the model: until the next full state.
const AHEAD: u64 = 1000;

/// Makes the dry runs of a recording, in threads of their own: one from arming on, and one from each full state.
pub fn twin(played: &Arc<Played>, bell: &Bell) {
    if let Some(mut next) = played.recording().wants_ahead(false) {
        let (played, bell) = (played.clone(), bell.clone());
        std::thread::spawn(move || {
            loop {
                let made = Ahead::run(&next, AHEAD);
                let mut recording = played.recording();
                recording.runs_ahead(made);
                let more = recording.wants_ahead(true);
                drop(recording);
                bell.ring();
                let Some(more) = more else { break };
                next = more;
            }
        });
    }
    if let Some((at, steady)) = played.recording().wants_steady() {
        let (played, bell) = (played.clone(), bell.clone());
        std::thread::spawn(move || {
            let points = steady.curve();
            played.recording().settles(at, points);
            bell.ring();
        });
    }
    let Some(twin) = played.recording().wants_twin() else { return };
    let (played, bell) = (played.clone(), bell.clone());
    std::thread::spawn(move || {
        let made = twin.run(TWIN);
        played.recording().beside(made);
        bell.ring();
    });
}

/// Follows a log until it has ended. `more`: whether its writer may still append to it.
pub fn follow(mut reader: Reader, played: &Arc<Played>, more: &dyn Fn() -> bool, bell: &Bell) {
    let mut grows = true;
    while grows {
        std::thread::sleep(LOOK);
        // Asked first: what is written until the writer gives up is in the file then.
        grows = more();
        let mut recording = played.recording();
        let read = reader.resume().map_err(|error| error.to_string());
        let read = read.and_then(|()| read_on(&mut reader, &mut recording));
        grows &= read.is_ok() && reader.tail().is_none() && !matches!(reader.end(), Some(End::Damaged { .. }));
        match read {
            Ok(0) if grows => continue,
            Ok(_) if grows => recording.added(),
            Ok(_) => recording.end(reader.ending("it").unwrap_or_else(|damaged| damaged)),
            Err(why) => recording.end(why),
        }
        drop(recording);
        twin(played, bell);
        bell.ring();
    }
}
