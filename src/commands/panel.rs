//! `fric panel`: a simulation that changes under the hand, or a recording, in a browser.

use super::End;
use super::remote_rig::{self, Feed};
use crate::args::Panel as Args;
use crate::commands::shared::rig_log::{self, Opened};
use crate::compile::Options;
use crate::interrupt::on_interrupt;
use crate::project;
use crate::shown::what_if::WhatIf;
use crate::terminal::Terminal;
use panel::follow::{self, LOOK};
use panel::operated::{self, Operated};
use panel::recording::{Played, Recording};
use panel::report::report;
use panel::server::{Bell, Panel};
use panel::subject::Subject;
use runtime::record::blocks::MAGIC;
use runtime::record::claim::is_claimed;
use std::fs::File;
use std::io::{BufRead, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc;

/// Columns of a recording's report: four times those of a wide window.
const REPORT_COLUMNS: u32 = 4096;

/// What is shown: the same as both kinds.
enum Content {
    WhatIf(Arc<WhatIf>),
    Recording(Arc<Played>),
}

impl Content {
    fn subject(&self) -> Arc<dyn Subject> {
        match self {
            Content::WhatIf(one) => one.clone(),
            Content::Recording(one) => one.clone(),
        }
    }
}

pub fn panel(args: &Args, terminal: &mut Terminal) -> End {
    let bell = Bell::default();
    if let Some(started) = &args.of_rig {
        return of_rig(args, started, &bell, terminal);
    }
    if let Some(host) = remote_rig::host(&args.file) {
        return of_host(args, &host, &bell, terminal);
    }
    let shown = if is_log(&args.file) {
        if !args.experiments.is_empty() {
            terminal.error(&format!("{} is a recording: it has no experiments", args.file.display()));
            return End::Misused;
        }
        match recording(args, &bell, terminal) {
            Ok(recording) => Content::Recording(recording),
            Err(why) => {
                terminal.error(&format!("{}: {why}", args.file.display()));
                return End::Failed;
            }
        }
    } else {
        let options = Options { changes: args.changed.changes(), interpret: args.interpret };
        let colour = terminal.error_colour();
        match WhatIf::new(&args.file, &args.experiments, options, bell.clone(), colour) {
            Ok(one) => Content::WhatIf(one),
            // A report of diagnostics is whole lines; a sentence is not.
            Err(why) if why.ends_with('\n') => {
                terminal.report(&why);
                return End::Failed;
            }
            Err(why) => {
                terminal.error(&why);
                return End::Failed;
            }
        }
    };
    match &args.save {
        Some(path) => save(path, &shown, terminal),
        None => serve(args, &shown, &bell, terminal),
    }
}

/// Whether a file begins as a log does. What comes through a pipe can be read only once, and is a text.
fn is_log(path: &Path) -> bool {
    let mut begin = [0; MAGIC.len()];
    path.is_file() && File::open(path).and_then(|mut file| file.read_exact(&mut begin)).is_ok() && begin == MAGIC
}

/// A recording. One that is still being written is followed in a thread of its own, unless it is for a report.
fn recording(args: &Args, bell: &Bell, terminal: &Terminal) -> Result<Arc<Played>, String> {
    let Opened { mut reader, ready, control } = rig_log::open(&args.file, args.interpret, terminal)?;
    let name = args.file.display().to_string();
    let mut recording = Recording::new(&name, &ready.rig, (&ready.control, &ready.plant), &control, args.keep);
    let grows = is_claimed(&args.file) && args.save.is_none();
    follow::read_on(&mut reader, &mut recording)?;
    if recording.is_empty() && !grows {
        return Err("it holds no cycle".into());
    }
    if !grows || reader.tail().is_some() {
        recording.end(reader.ending("it").unwrap_or_else(|damaged| damaged));
        let played = Arc::new(Played::new(recording));
        follow::twin(&played, bell);
        return Ok(played);
    }
    let (played, bell, file) = (Arc::new(Played::new(recording)), bell.clone(), args.file.clone());
    let followed = played.clone();
    std::thread::Builder::new()
        .name("log".into())
        .spawn(move || follow::follow(reader, &followed, &|| is_claimed(&file), &bell))
        .map_err(|error| error.to_string())?;
    Ok(played)
}

/// Serves a panel with the commands of a rig's operator in a thread of its own. Prints its link after `words`, and shows
/// it in a browser.
fn operate(
    args: &Args,
    operated: &Arc<Operated>,
    bell: &Bell,
    words: &str,
    terminal: &mut Terminal,
) -> Result<Option<tempfile::NamedTempFile>, End> {
    let open = opened(args, operated.clone(), bell, terminal).ok_or(End::Failed)?;
    let link = open.link();
    terminal.line(&format!("{words}{link}"));
    open.share_link()
        .iter()
        .for_each(|link| terminal.line(&format!("{}{link}", words.replace("panel", "share").replace("link", "share"))));
    let door = (!args.no_open).then(|| show(&link)).flatten();
    std::thread::spawn(move || open.serve());
    Ok(door)
}

/// Shows the log of a rig that runs, once it has begun: for a thread of its own. `more`: whether it may still grow.
fn show_log(operated: &Operated, file: &Path, interpret: bool, keep: u64, bell: &Bell, more: &dyn Fn() -> bool) {
    match rig_log::open(file, interpret, &Terminal::new()) {
        Ok(Opened { reader, ready, control }) => {
            let name = file.display().to_string();
            let recording = Recording::new(&name, &ready.rig, (&ready.control, &ready.plant), &control, keep);
            let played = Arc::new(Played::new(recording));
            operated.begins(played.clone(), &ready.live, &ready.control);
            follow::follow(reader, &played, more, bell);
        }
        Err(why) => operated.told(&format!("problem its log cannot be shown: {why}")),
    }
}

/// Beside a rig that runs: see [`super::beside`]. Ends with the last page that shows it, once the rig has ended.
fn of_rig(args: &Args, started: &str, bell: &Bell, terminal: &mut Terminal) -> End {
    let name = args.file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let operated = Arc::new(Operated::new(&name, Box::new(std::io::stdout()), bell.clone()));
    let _door = match operate(args, &operated, bell, "link ", terminal) {
        Ok(door) => door,
        Err(end) => return end,
    };
    let follow = |file: PathBuf, started: &str| {
        let (operated, bell, started, run) = (operated.clone(), bell.clone(), started.to_string(), operated.run());
        let (interpret, keep) = (args.interpret, args.keep);
        std::thread::spawn(move || {
            while !follow::is_of(&file, &started) {
                if operated.is_over() || operated.run() != run {
                    return;
                }
                std::thread::sleep(LOOK);
            }
            show_log(&operated, &file, interpret, keep, &bell, &|| is_claimed(&file));
        });
    };
    let mut file = args.file.clone();
    follow(file.clone(), started);
    for line in std::io::stdin().lock().lines() {
        let Ok(line) = line else { break };
        // A run after the first one has another log.
        match line.split_once(' ') {
            Some(("log", path)) => file = path.into(),
            Some(("started", started)) => follow(file.clone(), started),
            _ => operated.told(&line),
        }
    }
    operated.ended("the process of the rig was killed");
    operated::remain(bell);
    End::Fine
}

/// The rig that runs on another computer.
fn of_host(args: &Args, host: &str, bell: &Bell, terminal: &mut Terminal) -> End {
    if args.save.is_some() || !args.experiments.is_empty() {
        terminal.error(&format!(
            "{host} is a computer with a rig that runs: it has no experiments, and --save needs its log, which \
             `fric fetch-log {host}` fetches"
        ));
        return End::Misused;
    }
    let (mut feed, operated) = match Feed::of(host, args, bell) {
        Ok(both) => both,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let _door = match operate(args, &operated, bell, "panel  ", terminal) {
        Ok(door) => door,
        Err(end) => return end,
    };
    let (begun, first) = mpsc::channel::<PathBuf>();
    let following = {
        let (operated, bell, goes_on) = (operated.clone(), bell.clone(), feed.goes_on.clone());
        let (started, interpret, keep) = (feed.started.clone(), args.interpret, args.keep);
        std::thread::spawn(move || {
            let Ok(file) = first.recv() else { return };
            let more = || goes_on.load(Ordering::Relaxed);
            // Its head is whole with its first block.
            while !follow::is_of(&file, &started) && more() {
                std::thread::sleep(LOOK);
            }
            show_log(&operated, &file, interpret, keep, &bell, &more);
        })
    };
    let ended = feed.run(&operated, &begun);
    drop(begun);
    feed.goes_on.store(false, Ordering::Relaxed);
    if let Err(why) = &ended {
        operated.told(&format!("problem {why}"));
    }
    operated.ended(&format!(
        "the connection to {host} has ended; the rig may run on, and only the wired stop reaches it from here"
    ));
    let _ = following.join();
    operated::remain(bell);
    if ended.is_ok() { End::Fine } else { End::Failed }
}

fn save(path: &Path, shown: &Content, terminal: &mut Terminal) -> End {
    let subject = shown.subject();
    let (hello, state) = (subject.hello().1, subject.state().1);
    let curves = match shown {
        Content::WhatIf(one) => one.curves(),
        Content::Recording(one) => one.recording().curves(REPORT_COLUMNS),
    };
    let title = hello["title"].as_str().unwrap_or_default().to_string();
    match project::write(path, report(&title, &hello, &state, &curves).as_bytes()) {
        Ok(()) => {
            terminal.line(&format!("wrote {}", path.display()));
            End::Fine
        }
        Err(error) => {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            End::Failed
        }
    }
}

/// A panel at its port, and at the address for others.
fn opened(args: &Args, subject: Arc<dyn Subject>, bell: &Bell, terminal: &mut Terminal) -> Option<Panel> {
    let open = Panel::open(args.port, subject, bell.clone());
    match open.and_then(|open| args.share.into_iter().try_fold(open, Panel::shared_at)) {
        Ok(open) => Some(open),
        Err(why) => {
            terminal.error(&format!("no panel: {why}"));
            None
        }
    }
}

fn serve(args: &Args, shown: &Content, bell: &Bell, terminal: &mut Terminal) -> End {
    let Some(open) = opened(args, shown.subject(), bell, terminal) else { return End::Failed };
    let link = open.link();
    let (send, ended) = mpsc::channel();
    let interrupted = send.clone();
    on_interrupt(move || {
        let _ = interrupted.send(None);
    });
    terminal.line(&format!("panel  {link}"));
    open.share_link().iter().for_each(|link| terminal.line(&format!("share  {link}")));
    let _door = (!args.no_open).then(|| show(&link)).flatten();
    std::thread::spawn(move || {
        let _ = send.send(open.serve().err());
    });
    match ended.recv() {
        Ok(Some(error)) => {
            terminal.error(&format!("the panel ends: {error}"));
            End::Failed
        }
        Ok(None) | Err(_) => End::Fine,
    }
}

/// Opens the link where there is a desktop. The key must not stand in a list of processes, so the browser is sent to a
/// file that only this user can read, and from there to the page. The file lives as long as what is returned.
fn show(link: &str) -> Option<tempfile::NamedTempFile> {
    let desktop =
        ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some_and(|it| !it.is_empty()));
    if !desktop {
        return None;
    }
    let mut door = tempfile::Builder::new().prefix("fric-panel").suffix(".html").tempfile().ok()?;
    write!(door, "<!doctype html><meta http-equiv=\"refresh\" content=\"0;url={link}\">").ok()?;
    let quiet = Stdio::null;
    Command::new("xdg-open").arg(door.path()).stdin(quiet()).stdout(quiet()).stderr(quiet()).spawn().ok()?;
    Some(door)
}
