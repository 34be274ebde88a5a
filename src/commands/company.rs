//! All who command the runs of `fric hil` and watch them: its prompt, and the panel beside it.
//!
//! In: the operator of each run, one run after the other. Out: their commands to the run that is under way, and after its
//! end whether they wish for another one.

use super::beside::{Beside, Hear, Told};
use super::prompt::{Desk, Rehearsal, Wish};
use crate::args::Hil as Args;
use crate::terminal::Terminal;
use runtime::hil::cycle::{Attention, Operator};
use runtime::hil::emergency;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

/// Interval at which a signal to end is looked for while nothing runs.
const LOOK: Duration = Duration::from_millis(50);

/// All who command the runs of this process, one run after the other, and watch them.
pub struct Company {
    desk: Desk,
    wished: Receiver<Wish>,
    told: Option<Told>,
    /// The panel, until the first run can hear it.
    unheard: Option<Beside>,
    listens: bool,
    /// Stops a rig that nobody watches.
    pub attention: Option<Arc<Attention>>,
    /// The number of the run, from 1.
    pub run: u32,
    /// Whether the end of this run has been told.
    over: bool,
}

impl Company {
    /// Before the first run.
    pub fn new(args: &Args) -> Company {
        let (desk, wished) = Desk::new();
        let attention = args.dead_man.map(|limit| Arc::new(Attention::new(Duration::from_secs_f64(limit))));
        Company { desk, wished, told: None, unheard: None, listens: false, attention, run: 1, over: false }
    }

    /// The log of a run: those after the first one have others, `rtfs-2.friclog`.
    pub fn log(&self, first: PathBuf) -> PathBuf {
        if self.run == 1 {
            return first;
        }
        let part = |part: Option<&OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
        let (stem, end) = (part(first.file_stem()), part(first.extension()));
        first.with_file_name(format!("{stem}-{}.{end}", self.run))
    }

    /// Starts the panel, or tells it of the next log. The calling thread must not be set up for real time yet.
    ///
    /// # Errors
    /// Why there is none, in words.
    pub fn shows(&mut self, log: &Path, started: &str, args: &Args) -> Result<(), String> {
        match &self.told {
            Some(told) => {
                told.say(&format!("log {}", log.display()));
                told.say(&format!("started {started}"));
            }
            None => {
                let beside = Beside::start(log, started, args)?;
                self.told = Some(beside.told.clone());
                self.unheard = Some(beside);
            }
        }
        Ok(())
    }

    /// Speaks to the panel, if there is one.
    pub fn told(&self) -> Option<Told> {
        self.told.clone()
    }

    /// A run begins, which people may command. Without a rehearsal, no parameter may change.
    pub fn begins(&mut self, operator: Operator, rehearsal: Option<Rehearsal>) {
        self.desk.begins(operator, rehearsal);
        if !std::mem::replace(&mut self.listens, true) {
            let desk = self.desk.clone();
            std::thread::spawn(move || desk.listen());
        }
        if let Some(beside) = self.unheard.take() {
            let (desk, attention) = (self.desk.clone(), self.attention.clone());
            std::thread::spawn(move || {
                beside.read(&Hear {
                    stop: &|origin| desk.stop(origin),
                    seen: &|| attention.iter().for_each(|attention| attention.seen()),
                    ask: &|asked| desk.ask(asked),
                });
                desk.wish(Wish::Quit);
            });
        }
    }

    /// Tells how the run ended.
    pub fn ends(&mut self, words: &str) {
        self.desk.ends();
        self.over = true;
        self.told.iter().for_each(|told| told.say(&format!("over {words}")));
    }

    /// Whether people wish for another run: waits until they say so, or nobody is there any more.
    pub fn wish_for_another(&mut self, terminal: &mut Terminal) -> bool {
        let (Some(told), true, None) = (self.told(), self.listens, emergency::requested_stop()) else { return false };
        if !std::mem::replace(&mut self.over, false) {
            told.say("over it was not started: its terminal says why");
        }
        // A panel that has ended meanwhile cannot ask for another run.
        if self.wished.try_recv() == Ok(Wish::Quit) {
            return false;
        }
        told.say("again");
        terminal.line("  the panel stays: Start again there, or type again or quit");
        loop {
            match self.wished.recv_timeout(LOOK) {
                Ok(Wish::Again) => {
                    self.run += 1;
                    told.say("anew");
                    return true;
                }
                Err(RecvTimeoutError::Timeout) if emergency::requested_stop().is_none() => {}
                Ok(Wish::Quit) | Err(_) => return false,
            }
        }
    }
}
