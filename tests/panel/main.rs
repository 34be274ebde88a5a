//! The panel in a real browser: what a user sees and does, and what a hostile page cannot do.
//!
//! Pictures of what was seen are left in `target/panel/`.

mod browser;
mod client;
#[path = "../support/debian.rs"]
mod debian;
mod hostile;
mod operated;
mod people;
mod recording;
mod remote;
mod soak;
mod strangers;
mod what_if;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn fric() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    command.current_dir(root());
    command
}

/// A panel, until dropped.
struct Panel {
    child: Child,
    link: String,
}

impl Panel {
    fn open(arguments: &[&str]) -> Panel {
        let mut command = fric();
        command.args(["panel", "--no-open", "--port", "0"]).args(arguments);
        let mut child = command.stdout(Stdio::piped()).spawn().expect("fric starts");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let link = line.trim().strip_prefix("panel  ").unwrap_or_else(|| panic!("{line}")).to_string();
        Panel { child, link }
    }

    /// `http://127.0.0.1:PORT`
    fn origin(&self) -> &str {
        self.link.split_once("/#").expect("a link has a key").0
    }

    /// `127.0.0.1:PORT`
    fn address(&self) -> &str {
        self.origin().trim_start_matches("http://")
    }

    fn port(&self) -> u16 {
        self.origin().rsplit_once(':').and_then(|(_, port)| port.parse().ok()).expect("a port")
    }

    fn key(&self) -> &str {
        self.link.split_once("/#").expect("a link has a key").1
    }
}

impl Drop for Panel {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A folder of its own for a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("panel-{name}"));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("target can be written");
    folder
}

const STICK_SLIP: &str = "examples/stick-slip/stick_slip.fric";
