//! The panel of a rig on another computer, through ssh.
//!
//! In: the lines and the log that `fric-rig feed` sends there. Out: a subject whose commands go back the same way. The
//! other computer opens no port: who may operate the rig is who may log in. Its log is kept in a temporary folder as long
//! as it is shown.

use crate::args::Panel as Args;
use crate::ssh::Remote;
use panel::operated::Operated;
use panel::server::Bell;
use runtime::record::parts;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use tempfile::TempDir;

/// Longest line.
const LONGEST: u64 = 1 << 16;
/// Most bytes of the log at once.
const MOST: u64 = 1 << 20;

/// The other end of ssh.
pub struct Feed {
    child: Child,
    from: BufReader<ChildStdout>,
    /// As in the head of the rig's log.
    pub started: String,
    folder: TempDir,
    /// Whether more of the log may come.
    pub goes_on: Arc<AtomicBool>,
}

const ODD: &str = "it sends no log of fric";

/// The computer that an argument names, if it names no file.
pub fn host(file: &Path) -> Option<String> {
    let text = file.to_str()?;
    (text.contains('@') && !text.starts_with('-') && !file.exists()).then(|| text.to_string())
}

impl Feed {
    /// Logs in there, and waits until the rig answers.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn of(host: &str, args: &Args, bell: &Bell) -> Result<(Feed, Arc<Operated>), String> {
        let remote = Remote::new(host, &args.options);
        let mut child = remote.start(&[&args.rig, "feed", "--dir", &args.dir]).map_err(|why| why.words())?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err("ssh has no standard input and output".into());
        };
        let mut from = BufReader::new(from);
        let first = line(&mut from).unwrap_or_default();
        let Some(started) = first.strip_prefix("started ") else {
            // What it says is on the standard error already.
            let _ = child.wait();
            return Err(format!("{host} feeds no panel"));
        };
        let started = started.to_string();
        let folder = tempfile::Builder::new().prefix("fric-panel").tempdir().map_err(|error| error.to_string())?;
        let operated = Arc::new(Operated::new(host, Box::new(to), bell.clone()));
        let goes_on = Arc::new(AtomicBool::new(true));
        Ok((Feed { child, from, started, folder, goes_on }, operated))
    }

    /// Passes on what comes, until nothing does. `begun` gets the first file of the log, here.
    ///
    /// # Errors
    /// Why it cannot go on, in words.
    pub fn run(&mut self, operated: &Operated, begun: &Sender<PathBuf>) -> Result<(), String> {
        let about = |error: std::io::Error| format!("the log cannot be kept here: {error}");
        let mut open: Option<File> = None;
        while let Some(line) = line(&mut self.from) {
            let (word, rest) = line.split_once(' ').unwrap_or((&line, ""));
            match word {
                "file" => {
                    let number: u32 = rest.parse().map_err(|_| ODD)?;
                    let first = self.folder.path().join("rig.friclog");
                    let path = parts::path(&first, number.max(1));
                    let begins_it = open.is_none();
                    open = Some(File::create(&path).map_err(about)?);
                    if begins_it {
                        let _ = begun.send(path);
                    }
                    // Who reads the file before this one holds it open, and has read the one before that.
                    if number > 2 {
                        let _ = std::fs::remove_file(parts::path(&first, number - 2));
                    }
                }
                "bytes" => {
                    let n = rest.parse().ok().filter(|n| *n <= MOST).ok_or(ODD)?;
                    let file = open.as_mut().ok_or(ODD)?;
                    if std::io::copy(&mut (&mut self.from).take(n), file).map_err(about)? < n {
                        break;
                    }
                }
                _ => operated.told(&line),
            }
        }
        Ok(())
    }
}

/// A line without its end; none at the end, or if it is longer than any.
fn line(from: &mut impl BufRead) -> Option<String> {
    let mut line = Vec::new();
    from.take(LONGEST).read_until(b'\n', &mut line).ok()?;
    let line = line.strip_suffix(b"\n")?;
    Some(String::from_utf8_lossy(line).into_owned())
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.goes_on.store(false, Ordering::Relaxed);
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
