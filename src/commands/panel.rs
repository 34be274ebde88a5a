//! `fric panel`: a simulation that changes under the hand, or a recording, in a browser.

use super::End;
use crate::args::Panel as Args;
use crate::commands::shared::rig_log::{self, Opened};
use crate::compile::Options;
use crate::interrupt::on_interrupt;
use crate::project;
use crate::shown::recording::Recording;
use crate::shown::what_if::WhatIf;
use crate::terminal::Terminal;
use panel::report::report;
use panel::server::{Bell, Panel};
use panel::subject::Subject;
use runtime::record::blocks::MAGIC;
use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc;

/// Columns of a recording's report: four times those of a wide window.
const REPORT_COLUMNS: u32 = 4096;

/// What is shown: the same as both kinds.
enum Content {
    WhatIf(Arc<WhatIf>),
    Recording(Arc<Recording>),
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
    let shown = if is_log(&args.file) {
        if !args.experiments.is_empty() {
            terminal.error(&format!("{} is a recording: it has no experiments", args.file.display()));
            return End::Misused;
        }
        match recording(args, terminal) {
            Ok(recording) => Content::Recording(Arc::new(recording)),
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

fn recording(args: &Args, terminal: &Terminal) -> Result<Recording, String> {
    let Opened { mut reader, ready, control } = rig_log::open(&args.file, args.interpret, terminal)?;
    let name = args.file.display().to_string();
    let mut recording = Recording::new(&name, &ready.rig, ready.control.description(), &control, args.keep);
    loop {
        match reader.message() {
            Ok(Some(message)) if !recording.add(&message) => {
                return Err("it holds a cycle that is not of this rig".into());
            }
            Ok(Some(_)) => {}
            Ok(None) => break,
            Err(error) => return Err(error.to_string()),
        }
    }
    if recording.is_empty() {
        return Err("it holds no cycle".into());
    }
    recording.end(rig_log::ending(&reader, "it").unwrap_or_else(|damaged| damaged));
    Ok(recording)
}

fn save(path: &Path, shown: &Content, terminal: &mut Terminal) -> End {
    let subject = shown.subject();
    let (hello, state) = (subject.hello().1, subject.state().1);
    let curves = match shown {
        Content::WhatIf(one) => one.curves(),
        Content::Recording(one) => one.curves(REPORT_COLUMNS),
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
