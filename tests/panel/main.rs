//! The panel in a real browser: what a user sees and does, and what a hostile page cannot do.
//!
//! Pictures of what was seen are left in `target/panel/`.

mod browser;
mod client;
#[path = "../support/debian.rs"]
mod debian;
#[path = "../support/fric_rig.rs"]
mod fric_rig;
mod hostile;
mod opened;
mod operated;
mod people;
mod recording;
mod remote;
mod soak;
mod what_if;

use opened::{Panel, STICK_SLIP, fric, root};
use std::path::{Path, PathBuf};

/// A folder of its own for a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("panel-{name}"));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("target can be written");
    folder
}
