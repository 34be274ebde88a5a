//! The panel beside a running rig: a process of its own, so that nothing that speaks to browsers shares the memory, the
//! priority or the processors of the cycle.
//!
//! In: the stage of the rig, answers to commands, and how the run ended, as lines to the panel's standard input. Out:
//! commands of its viewers, as lines from its standard output. Its curves it reads from the log by itself. If it dies,
//! the rig does not notice.
//!
//! The lines are those of [`panel::operated`]; its first one is `link URL`, then `share URL` if others may look. After
//! the end of a run its viewers may ask for the next one.

use crate::args::Hil as Args;
use crate::terminal::Terminal;
use runtime::hil::chair::{Chair, PageLine};
use runtime::hil::cycle::Gauges;
use runtime::hil::line::{Door, Line};
use runtime::hil::origin::{Origin, Seat};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Interval at which the stage is looked at.
const LOOK: Duration = Duration::from_millis(50);
/// Commands that wait to be carried out; more are refused. A stop never waits.
const WAITING: usize = 16;

/// Speaks to the panel. All that is said to one that has died is dropped.
#[derive(Clone)]
pub struct Told(Arc<Mutex<ChildStdin>>);

impl Told {
    /// Says a line.
    pub fn say(&self, line: &str) {
        let clean: String = line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let mut to = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let _ = to.write_all(format!("{clean}\n").as_bytes());
    }
}

/// A command of a viewer.
pub struct Asked {
    /// The command.
    pub line: Line,
    /// Whose it is.
    pub seat: Seat,
    number: u64,
    told: Told,
    waiting: Arc<AtomicUsize>,
}

impl Asked {
    /// Answers it, with the cycle that took it.
    pub fn answer(self, result: &Result<Option<u64>, String>) {
        match result {
            Ok(Some(cycle)) => self.told.say(&format!("ok {} {cycle}", self.number)),
            Ok(None) => self.told.say(&format!("ok {}", self.number)),
            Err(why) => self.told.say(&format!("refused {} {why}", self.number)),
        }
    }
}

impl Drop for Asked {
    fn drop(&mut self) {
        self.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What is done with the lines of the panel.
pub struct Hear<'a> {
    /// Stops the rig.
    pub stop: &'a dyn Fn(Origin),
    /// Somebody has seen the rig.
    pub seen: &'a dyn Fn(),
    /// Carries out another command.
    pub ask: &'a dyn Fn(Asked),
}

/// The panel's process.
pub struct Beside {
    /// Speaks to it.
    pub told: Told,
    from: ChildStdout,
}

impl Beside {
    /// Starts it. The calling thread must not be set up for real time yet: a child inherits priority and processors.
    /// `started`: that section of the head of the log that it waits for.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn start(log: &Path, started: &str, args: &Args) -> Result<Beside, String> {
        let about = |error: std::io::Error| format!("no panel: {error}");
        let mut command = Command::new(std::env::current_exe().map_err(about)?);
        command.args(["panel", "--of-rig", started, "--port", &args.port.to_string()]).arg(log);
        if args.no_open {
            command.arg("--no-open");
        }
        if let Some(share) = args.share {
            command.args(["--share", &share.to_string()]);
        }
        // In a process group of its own: Ctrl-C stops the rig, and the panel shows how it ended.
        let mut child = command.process_group(0).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(about)?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err("no panel: it has no standard input and output".into());
        };
        Ok(Beside { told: Told(Arc::new(Mutex::new(to))), from })
    }

    /// Tells the stage of the rig until the run is over: for a thread of its own.
    pub fn tell(told: &Told, gauges: &Gauges, over: &AtomicBool) {
        let (mut last, mut energy) = (String::new(), (0.0, 0));
        while !over.load(Ordering::Relaxed) {
            let stage = gauges.stage.get();
            let line = format!("stage {} {stage}", stage.awaits());
            if line != last {
                told.say(&line);
                last = line;
            }
            if gauges.energy() != energy {
                energy = gauges.energy();
                told.say(&format!("energy {} {}", energy.0, energy.1));
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Reads what viewers say, until the panel ends: for a thread of its own.
    pub fn read(self, hear: &Hear) {
        let waiting = Arc::new(AtomicUsize::new(0));
        let (mut terminal, mut chair) = (Terminal::new(), Chair::default());
        let Beside { told, from } = self;
        for line in BufReader::new(from).lines() {
            let Ok(line) = line else { break };
            if let Some(("link" | "share", rest)) = line.split_once(' ') {
                let what = if line.starts_with("link") { "panel" } else { "share" };
                terminal.line(&format!("{what}  {rest}"));
                continue;
            }
            let before = chair.seats();
            Beside::hear(&told, &line, &mut chair, &waiting, hear);
            if chair.seats() != before {
                told.say(&format!("chair {}", chair.seats()));
            }
        }
        terminal.error("the panel has ended; a rig that runs does so on, and this prompt commands it");
    }

    /// A line about a page.
    fn hear(told: &Told, line: &str, chair: &mut Chair, waiting: &Arc<AtomicUsize>, hear: &Hear) {
        let (seat, now) = (|page| Seat { panel: 0, page }, Instant::now());
        let (number, page, words) = match PageLine::read(line) {
            None => return,
            Some(PageLine::Seen) => return (hear.seen)(),
            Some(PageLine::Here(page)) => {
                chair.heard(seat(page), now);
                return;
            }
            Some(PageLine::Left(page)) => return chair.left(seat(page), now),
            Some(PageLine::Command { number, page, words, .. }) => (number, seat(page), words),
        };
        let line = match Line::read(words).and_then(|line| line.at(Door::Page)) {
            Ok(Line::Stop) => {
                (hear.stop)(Origin::Page(page));
                return told.say(&format!("ok {number}"));
            }
            Ok(line) => line,
            Err(why) => return told.say(&format!("refused {number} {why}")),
        };
        let seats = chair.says(page, &line, now);
        let only = seats.is_some();
        match seats.unwrap_or_else(|| chair.command(page, now)) {
            Err(why) => told.say(&format!("refused {number} {why}")),
            Ok(()) if only => told.say(&format!("ok {number}")),
            Ok(()) if waiting.fetch_add(1, Ordering::Relaxed) >= WAITING => {
                waiting.fetch_sub(1, Ordering::Relaxed);
                told.say(&format!("refused {number} {WAITING} commands wait already: say it again"));
            }
            Ok(()) => {
                let (told, waiting) = (told.clone(), waiting.clone());
                (hear.ask)(Asked { line, seat: page, number, told, waiting });
            }
        }
    }
}
