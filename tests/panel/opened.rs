//! `fric panel` in a process of its own. Also for the clients of others (`tests/strangers.rs`).

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

pub fn fric() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    command.current_dir(root());
    command
}

/// A panel, until dropped.
pub struct Panel {
    pub child: Child,
    pub link: String,
}

impl Panel {
    pub fn open(arguments: &[&str]) -> Panel {
        let mut command = fric();
        command.args(["panel", "--no-open", "--port", "0"]).args(arguments);
        let mut child = command.stdout(Stdio::piped()).spawn().expect("fric starts");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let link = line.trim().strip_prefix("panel  ").unwrap_or_else(|| panic!("{line}")).to_string();
        Panel { child, link }
    }

    /// `http://127.0.0.1:PORT`
    pub fn origin(&self) -> &str {
        self.link.split_once("/#").expect("a link has a key").0
    }

    /// `127.0.0.1:PORT`
    #[allow(dead_code, reason = "not every test that shares this file")]
    pub fn address(&self) -> &str {
        self.origin().trim_start_matches("http://")
    }

    pub fn port(&self) -> u16 {
        self.origin().rsplit_once(':').and_then(|(_, port)| port.parse().ok()).expect("a port")
    }

    pub fn key(&self) -> &str {
        self.link.split_once("/#").expect("a link has a key").1
    }
}

impl Drop for Panel {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub const STICK_SLIP: &str = "examples/stick-slip/stick_slip.fric";
