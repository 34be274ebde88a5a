//! The program of the rig's computer, for tests of the command.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

/// `fric-rig`, beside this command.
pub static FRIC_RIG: LazyLock<PathBuf> = LazyLock::new(|| {
    // What it builds has the features of the tests: nothing is compiled again where all tests run.
    let mut build = Command::new(env!("CARGO"));
    build.current_dir(env!("CARGO_MANIFEST_DIR")).args([
        "test",
        "--offline",
        "--quiet",
        "--no-run",
        "--test",
        "refuses",
    ]);
    assert!(build.status().unwrap().success(), "fric-rig is needed for this test and cannot be built");
    Path::new(env!("CARGO_BIN_EXE_fric")).with_file_name("fric-rig")
});
