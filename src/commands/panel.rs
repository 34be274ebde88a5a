//! `fric panel`: a simulation that changes under the hand, or a recording, in a browser.

use super::End;
use crate::args::Panel as Args;
use crate::commands::shared::rig_log::{self, Opened};
use crate::compile::Options;
use crate::interrupt::on_interrupt;
use crate::project;
use crate::shown::operated::Operated;
use crate::shown::recording::{Played, Recording};
use crate::shown::what_if::WhatIf;
use crate::terminal::Terminal;
use panel::report::report;
use panel::server::{Bell, Panel};
use panel::subject::Subject;
use runtime::record::blocks::{End as LogEnd, MAGIC};
use runtime::record::claim::is_claimed;
use runtime::record::log::Reader;
use std::fs::File;
use std::io::{BufRead, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc;
use std::time::{Duration, Instant};

/// Polling interval of a log that grows: its writer appends to it ten times a second.
const LOOK: Duration = Duration::from_millis(20);
/// Time for which the panel of a rig that has ended waits for a page.
const REMAINS: Duration = Duration::from_secs(5);
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
        return of_rig(args, started, bell, terminal);
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
        None => serve(args, &shown, bell, terminal),
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
    let mut recording = Recording::new(&name, &ready.rig, ready.control.description(), &control, args.keep);
    let grows = is_claimed(&args.file) && args.save.is_none();
    read_on(&mut reader, &mut recording)?;
    if recording.is_empty() && !grows {
        return Err("it holds no cycle".into());
    }
    if !grows || reader.tail().is_some() {
        recording.end(rig_log::ending(&reader, "it").unwrap_or_else(|damaged| damaged));
        return Ok(Arc::new(Played::new(recording)));
    }
    let (played, bell, file) = (Arc::new(Played::new(recording)), bell.clone(), args.file.clone());
    let followed = played.clone();
    std::thread::Builder::new()
        .name("log".into())
        .spawn(move || follow(reader, &followed, &file, &bell))
        .map_err(|error| error.to_string())?;
    Ok(played)
}

/// Follows a log until its writer has ended it.
fn follow(mut reader: Reader, played: &Played, file: &Path, bell: &Bell) {
    let mut grows = true;
    while grows {
        std::thread::sleep(LOOK);
        // Asked first: what is written until the claim is given up is in the file then.
        grows = is_claimed(file);
        let mut recording = played.recording();
        let read = reader.resume().map_err(|error| error.to_string());
        let read = read.and_then(|()| read_on(&mut reader, &mut recording));
        grows &= read.is_ok() && reader.tail().is_none() && !matches!(reader.end(), Some(LogEnd::Damaged { .. }));
        match read {
            Ok(0) if grows => continue,
            Ok(_) if grows => recording.added(),
            Ok(_) => recording.end(rig_log::ending(&reader, "it").unwrap_or_else(|damaged| damaged)),
            Err(why) => recording.end(why),
        }
        drop(recording);
        bell.ring();
    }
}

/// Beside a rig that runs: see [`super::beside`]. Ends with the last page that shows it, once the rig has ended.
fn of_rig(args: &Args, started: &str, bell: Bell, terminal: &mut Terminal) -> End {
    let name = args.file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let operated = Arc::new(Operated::new(&name, Box::new(std::io::stdout()), bell.clone()));
    let open = match Panel::open(args.port, operated.clone(), bell.clone()) {
        Ok(open) => open,
        Err(why) => {
            terminal.error(&format!("no panel: {why}"));
            return End::Failed;
        }
    };
    let link = open.link();
    terminal.line(&format!("link {link}"));
    let _door = (!args.no_open).then(|| show(&link)).flatten();
    std::thread::spawn(move || open.serve());
    {
        let (operated, file, bell) = (operated.clone(), args.file.clone(), bell.clone());
        let (started, interpret, keep) = (started.to_string(), args.interpret, args.keep);
        std::thread::spawn(move || {
            let is_ours = || Reader::open(&file).is_ok_and(|reader| reader.head.text("started") == Some(&started));
            while !is_ours() {
                if operated.is_over() {
                    return;
                }
                std::thread::sleep(LOOK);
            }
            match rig_log::open(&file, interpret, &Terminal::new()) {
                Ok(Opened { reader, ready, control }) => {
                    let name = file.display().to_string();
                    let recording = Recording::new(&name, &ready.rig, ready.control.description(), &control, keep);
                    let played = Arc::new(Played::new(recording));
                    operated.begins(played.clone(), &ready.live, &ready.control);
                    follow(reader, &played, &file, &bell);
                }
                Err(why) => operated.told(&format!("problem its log cannot be shown: {why}")),
            }
        });
    }
    for line in std::io::stdin().lock().lines() {
        let Ok(line) = line else { break };
        operated.told(&line);
    }
    operated.left();
    // A page that is loaded again has no connection for a moment.
    let mut alone = Instant::now();
    while alone.elapsed() < REMAINS {
        std::thread::sleep(Duration::from_millis(100));
        if bell.viewers() > 0 {
            alone = Instant::now();
        }
    }
    End::Fine
}

/// Adds all messages that can be read now; returns their number.
fn read_on(reader: &mut Reader, recording: &mut Recording) -> Result<u64, String> {
    let mut added = 0;
    while let Some(message) = reader.message().map_err(|error| error.to_string())? {
        if !recording.add(&message) {
            return Err("it holds a cycle that is not of this rig".into());
        }
        added += 1;
    }
    Ok(added)
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

fn serve(args: &Args, shown: &Content, bell: Bell, terminal: &mut Terminal) -> End {
    let open = match Panel::open(args.port, shown.subject(), bell) {
        Ok(open) => open,
        Err(why) => {
            terminal.error(&format!("no panel: {why}"));
            return End::Failed;
        }
    };
    let link = open.link();
    let (send, ended) = mpsc::channel();
    let interrupted = send.clone();
    on_interrupt(move || {
        let _ = interrupted.send(None);
    });
    terminal.line(&format!("panel  {link}"));
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
