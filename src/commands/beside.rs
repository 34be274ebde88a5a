//! The panel beside a running rig: a process of its own, so that nothing that speaks to browsers shares the memory, the
//! priority or the processors of the cycle.
//!
//! In: the stage of the rig, answers to commands, and how the run ended, as lines to the panel's standard input. Out:
//! commands of its viewers, as lines from its standard output. Its curves it reads from the log by itself. If it dies,
//! the rig does not notice.
//!
//! The lines are those of [`panel::operated`]; its first one is `link URL`.

use crate::terminal::Terminal;
use runtime::hil::cycle::Gauges;
use runtime::hil::operator::Stopper;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Interval at which the stage is looked at.
const LOOK: Duration = Duration::from_millis(50);
/// Commands that wait to be carried out; more are refused. A stop never waits.
const WAITING: usize = 16;

/// Speaks to the panel. All that is said to one that has died is dropped.
#[derive(Clone)]
pub struct Told(Arc<Mutex<ChildStdin>>);

impl Told {
    fn say(&self, line: &str) {
        let clean: String = line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let mut to = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let _ = to.write_all(format!("{clean}\n").as_bytes());
    }

    /// Tells how the run ended.
    pub fn over(&self, words: &str) {
        self.say(&format!("over {words}"));
    }
}

/// A command of a viewer.
pub struct Asked {
    /// The command as it is typed at the prompt.
    pub text: String,
    number: u64,
    told: Told,
    waiting: Arc<AtomicUsize>,
}

impl Asked {
    /// Answers it.
    pub fn answer(self, result: &Result<(), String>) {
        match result {
            Ok(()) => self.told.say(&format!("ok {}", self.number)),
            Err(why) => self.told.say(&format!("refused {} {why}", self.number)),
        }
    }
}

impl Drop for Asked {
    fn drop(&mut self) {
        self.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The panel's process.
pub struct Beside {
    told: Told,
    from: ChildStdout,
}

impl Beside {
    /// Starts it. The calling thread must not be set up for real time yet: a child inherits priority and processors.
    /// `started`: that section of the head of the log that it waits for.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn start(log: &Path, started: &str, port: u16, no_open: bool) -> Result<Beside, String> {
        let about = |error: std::io::Error| format!("no panel: {error}");
        let mut command = Command::new(std::env::current_exe().map_err(about)?);
        command.args(["panel", "--of-rig", started, "--port", &port.to_string()]).arg(log);
        if no_open {
            command.arg("--no-open");
        }
        // In a process group of its own: Ctrl-C stops the rig, and the panel shows how it ended.
        let mut child = command.process_group(0).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(about)?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err("no panel: it has no standard input and output".into());
        };
        Ok(Beside { told: Told(Arc::new(Mutex::new(to))), from })
    }

    /// Speaks to it.
    pub fn told(&self) -> Told {
        self.told.clone()
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

    /// Reads what viewers say, until the panel ends: for a thread of its own. `ask` passes a command on.
    pub fn read(self, stopper: &Stopper, ask: &dyn Fn(Asked)) {
        let waiting = Arc::new(AtomicUsize::new(0));
        let mut terminal = Terminal::new();
        for line in BufReader::new(self.from).lines() {
            let Ok(line) = line else { break };
            let Some((first, rest)) = line.split_once(' ') else { continue };
            if first == "link" {
                terminal.line(&format!("panel  {rest}"));
                continue;
            }
            let Ok(number) = first.parse() else { continue };
            if rest == "stop" {
                stopper.stop();
                self.told.say(&format!("ok {number}"));
            } else if waiting.fetch_add(1, Ordering::Relaxed) >= WAITING {
                waiting.fetch_sub(1, Ordering::Relaxed);
                self.told.say(&format!("refused {number} {WAITING} commands wait already: say it again"));
            } else {
                let (text, told, waiting) = (rest.to_string(), self.told.clone(), waiting.clone());
                ask(Asked { text, number, told, waiting });
            }
        }
        terminal.error("the panel has ended; the rig runs on, and this prompt commands it");
    }
}
