//! `fric-rig panel`, `fric-rig feed`: the running rig for browsers on this computer, or for a panel on another one.
//!
//! In: the folder of a running rig. Out: a page with its curves and commands, or the same as lines and bytes on the
//! standard streams, through ssh. Both are processes of their own: the rig's process only tells its stage and takes
//! commands, through the socket `control` in its folder, and its log is read from the disk. See [`panel::operated`] for the
//! lines; before them come `log`, `started` and `package`.
//!
//! ```text
//! from the feed     started TEXT          as in the head of its log
//!                   file NUMBER           this file of its log begins
//!                   bytes N               so many bytes of it follow
//! ```

use crate::packed;
use crate::run::{MOST_SAID, socket};
use crate::words;
use panel::follow::{self, LOOK};
use panel::operated::{self, Operated};
use panel::recording::{Played, Recording};
use panel::server::{Bell, Panel};
use runtime::record::claim::is_claimed;
use runtime::record::log::{Reader, newest_part};
use runtime::record::parts;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, SocketAddr};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError, TryRecvError};
use std::time::{Duration, Instant};

/// Time in which a rig that is being started opens its socket.
const STARTS: Duration = Duration::from_secs(60);
/// Bytes of the log that a feed sends at once: between them, lines pass.
const CHUNK: usize = 16 << 10;

/// Arguments of a panel.
pub struct PanelArguments<'a> {
    /// Folder of packages, logs, state.
    pub dir: &'a Path,
    /// Folder of the trusted public keys.
    pub trusted: &'a Path,
    /// Port that is tried first.
    pub port: u16,
    /// Address at which others may look.
    pub share: Option<SocketAddr>,
    /// Bytes of its curves in memory.
    pub keep: u64,
    /// Whether it is the child of `run --panel`, and waits for it.
    pub of_run: bool,
}

/// The connection to a rig that runs.
struct Attached {
    stream: UnixStream,
    lines: BufReader<UnixStream>,
    /// The first file of its log.
    log: PathBuf,
    /// As in the head of its log.
    started: String,
    package: PathBuf,
}

impl Attached {
    /// Connects to the rig that runs in a folder. `of_run`: it may just be starting, and is gone if the standard input
    /// ends.
    fn to(dir: &Path, of_run: bool) -> Result<Attached, String> {
        let gone = Arc::new(AtomicBool::new(false));
        if of_run {
            let gone = gone.clone();
            std::thread::spawn(move || {
                let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
                gone.store(true, Ordering::Relaxed);
            });
        }
        let begun = Instant::now();
        let about = |error: std::io::Error| format!("no rig runs in {}: {error}", dir.display());
        let stream = loop {
            match UnixStream::connect(socket(dir)) {
                Ok(stream) => break stream,
                Err(_) if of_run && begun.elapsed() < STARTS && !gone.load(Ordering::Relaxed) => {
                    std::thread::sleep(LOOK);
                }
                Err(error) => return Err(about(error)),
            }
        };
        (&stream).write_all(b"attend\n").map_err(about)?;
        let mut lines = BufReader::new(stream.try_clone().map_err(about)?);
        let mut told = |word: &str| {
            let mut line = String::new();
            lines.read_line(&mut line).map_err(about)?;
            match line.trim_end().split_once(' ') {
                Some((first, rest)) if first == word => Ok(rest.to_string()),
                Some(("refused", why)) => Err(format!("the rig refuses a panel: {why}")),
                _ => Err(format!("the rig in {} does not know panels: it is of another version", dir.display())),
            }
        };
        let (log, started, package) = (told("log")?.into(), told("started")?, told("package")?.into());
        Ok(Attached { stream, lines, log, started, package })
    }
}

/// Serves a panel until its rig has ended and nobody looks at it any more.
///
/// # Errors
/// Why there is none.
pub fn panel(wanted: &PanelArguments) -> Result<u8, String> {
    let Attached { stream, lines, log, started, package } = Attached::to(wanted.dir, wanted.of_run)?;
    let bell = Bell::default();
    let name = package.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let operated = Arc::new(Operated::new(&name, Box::new(stream), bell.clone()));
    let open = Panel::open(wanted.port, operated.clone(), bell.clone());
    let open = open.and_then(|open| wanted.share.into_iter().try_fold(open, Panel::shared_at));
    let open = open.map_err(|why| format!("no panel: {why}"))?;
    words::print(&format!("panel  {}\n", open.link()));
    open.share_link().iter().for_each(|link| words::print(&format!("share  {link}\n")));
    std::thread::spawn(move || open.serve());
    {
        let (operated, bell) = (operated.clone(), bell.clone());
        let (trusted, keep) = (wanted.trusted.to_path_buf(), wanted.keep);
        std::thread::spawn(move || {
            if let Err(why) = shown(&operated, &bell, (&log, &started), (&package, &trusted), keep) {
                operated.told(&format!("problem its log cannot be shown: {why}"));
            }
        });
    }
    for line in lines.lines().map_while(Result::ok) {
        operated.told(&line);
    }
    operated.ended("the process of the rig was killed");
    operated::remain(&bell);
    Ok(0)
}

/// Follows the log of a rig from its newest file on.
fn shown(
    operated: &Operated,
    bell: &Bell,
    (first, started): (&Path, &str),
    (package, trusted): (&Path, &Path),
    keep: u64,
) -> Result<(), String> {
    let file = loop {
        match newest_part(first, started) {
            Some(file) => break file,
            None if operated.is_over() => return Ok(()),
            None => std::thread::sleep(LOOK),
        }
    };
    let open = packed::open(package, trusted)?;
    let (control, plant) = (open.program("control")?, open.program("plant")?);
    let reader = Reader::open(&file)?;
    let computed = follow::control(&reader.head, &open.contents.rig, &control, &plant)?;
    let name = file.display().to_string();
    let recording = Recording::new(&name, &open.contents.rig, (&control, &plant), &computed, keep);
    let played = Arc::new(Played::new(recording));
    operated.begins(played.clone(), &open.contents.live, &control);
    follow::follow(reader, &played, &|| is_claimed(first), bell);
    Ok(())
}

/// A log that is sent while it grows.
struct Tail {
    first: PathBuf,
    started: String,
    /// The file that is being sent, its number and path.
    open: Option<(File, PathBuf)>,
    number: u32,
    /// The next file was there when this one was last read to its end.
    complete: bool,
}

impl Tail {
    /// Sends some bytes, and what must be said before them; false if there is nothing new. Returns none if nobody
    /// listens any more.
    fn send(&mut self) -> Option<bool> {
        if self.open.is_none() {
            let Some(path) = newest_part(&self.first, &self.started) else { return Some(false) };
            self.number = (1..).find(|number| parts::path(&self.first, *number) == path).unwrap_or(1);
            let Ok(file) = File::open(&path) else { return Some(false) };
            if !words::is_written(format!("file {}\n", self.number).as_bytes()) {
                return None;
            }
            self.open = Some((file, path));
        }
        let Some((file, path)) = &mut self.open else { return Some(false) };
        let mut bytes = vec![0; CHUNK];
        let n = file.read(&mut bytes).unwrap_or(0);
        if n > 0 {
            bytes.truncate(n);
            let mut whole = format!("bytes {n}\n").into_bytes();
            whole.append(&mut bytes);
            return words::is_written(&whole).then_some(true);
        }
        // This file is complete only if the next one was there before its end was read.
        let next = parts::following(path, self.number);
        if self.complete
            && let Ok(file) = File::open(&next)
        {
            (self.open, self.number, self.complete) = (Some((file, next)), self.number + 1, false);
            return words::is_written(format!("file {}\n", self.number).as_bytes()).then_some(true);
        }
        self.complete = follow::is_of(&next, &self.started);
        Some(self.complete)
    }
}

/// Sends all about the running rig to the standard output, and commands from the standard input to the rig, until either
/// ends.
///
/// # Errors
/// If no rig runs.
pub fn feed(dir: &Path) -> Result<u8, String> {
    let Attached { stream, lines, log, started, .. } = Attached::to(dir, false)?;
    if !words::is_written(format!("started {started}\n").as_bytes()) {
        return Ok(0);
    }
    let (send, told) = mpsc::sync_channel(1024);
    std::thread::spawn(move || {
        for line in lines.lines().map_while(Result::ok) {
            if send.send(line).is_err() {
                break;
            }
        }
    });
    let commands = stream.try_clone().map_err(|error| error.to_string())?;
    std::thread::spawn(move || {
        let mut from = BufReader::new(std::io::stdin());
        let mut line = String::new();
        while (&mut from).take(MOST_SAID).read_line(&mut line).is_ok_and(|n| n > 0) {
            if !line.ends_with('\n') || (&commands).write_all(line.as_bytes()).is_err() {
                break;
            }
            line.clear();
        }
        // The operator's computer is gone.
        let _ = commands.shutdown(Shutdown::Both);
    });
    let mut tail = Tail { first: log.clone(), started, open: None, number: 1, complete: false };
    let mut over = false;
    loop {
        loop {
            match told.try_recv() {
                Ok(line) if !words::is_written(format!("{line}\n").as_bytes()) => return Ok(0),
                Ok(_) => {}
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    over = true;
                    break;
                }
            }
        }
        // The log gets its last bytes after the rig has told its end.
        let writes = !over || is_claimed(&log);
        match tail.send() {
            None => return Ok(0),
            Some(true) => {}
            Some(false) if !writes => return Ok(0),
            Some(false) if over => std::thread::sleep(LOOK),
            Some(false) => match told.recv_timeout(LOOK) {
                Ok(line) if !words::is_written(format!("{line}\n").as_bytes()) => return Ok(0),
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => over = true,
            },
        }
    }
}
