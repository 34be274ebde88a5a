//! The operator's prompt of `fric hil`: threads that read, and one that executes.
//!
//! In: lines, typed or from pages of a panel. Out: commands, and the result of each. The threads that read send `stop`
//! themselves, so a stop never waits for a set of parameters that is being validated. They outlive a run: after its end
//! people may ask for the next one.

use super::beside::Asked;
use crate::compile::{CompiledRig, Loaded};
use crate::loop_stability::{self, Contact};
use crate::terminal::Terminal;
use abi::Slot;
use abi::format::quantity;
use abi::live::{Param, Tunable};
use grammar::diagnostic::Diagnostic;
use runtime::hil::line::{Assignment, Door, Line, RUNS};
use runtime::hil::live::{Judge, Set};
use runtime::hil::operator::{Answer, Command, Operator, Reason, Stopper};
use runtime::hil::origin::Origin;
use std::io::BufRead;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The commands of a running rig.
const HELP: &str = "enable, arm: as the drives ask for it; set PATH = VALUE, …: parameters, judged as at a start; \
                    mark WORDS: a remark in the log; \
                    show: parameters that may change, with their values; stop: ends the run";

/// Validates sets of parameters before the cycle receives them.
///
/// The cycle checks the constraints of the start. The stability of the fixed step and of the contacts needs a compiler:
/// it is analysed anew with the values of the set, for the programs of this run, as a start with these values would.
pub struct Rehearsal {
    judge: Judge,
    /// The rig with the active values.
    ready: CompiledRig,
    /// Its texts, as they were read.
    loaded: Loaded,
    /// The contacts that may be unstable with some values.
    contacts: Vec<Contact>,
    /// Whether contacts may be unstable.
    accept_unstable: bool,
    /// Whether this run stops if its predictor fails.
    needs_look: bool,
}

impl Rehearsal {
    /// For a rig that is about to run. `accept_unstable`: its contacts may be unstable; `needs_look`: this run stops if its
    /// predictor fails.
    pub fn new(ready: CompiledRig, loaded: Loaded, accept_unstable: bool, needs_look: bool) -> Rehearsal {
        let judge = Judge::new(ready.live.clone(), ready.judge.clone(), &ready.control);
        let judge = judge.expect("the compiler made them for each other");
        let contacts = loop_stability::candidates(&ready);
        Rehearsal { judge, ready, loaded, contacts, accept_unstable, needs_look }
    }

    /// What decides which parameters may change.
    pub fn judge(&self) -> &Judge {
        &self.judge
    }

    /// Why a start with the active values, of which these are new, would be refused, or this run could not go on with them.
    fn objection(&mut self, set: &Set) -> Result<(), String> {
        let held = self.judge.judge(self.ready.control.block(), set.values());
        held.map_err(|objection| self.judge.words(&objection))?;
        let errors = self.ready.start_errors(&self.loaded.files);
        if !errors.is_empty() {
            let words = |error: &Diagnostic| format!("{}: {}", error.code, error.message);
            return Err(errors.iter().map(words).collect::<Vec<_>>().join("; "));
        }
        if self.accept_unstable {
            return Ok(());
        }
        let (against, needs_look) = loop_stability::objections_to(&self.contacts, &self.ready);
        if !against.is_empty() {
            return Err(against.join("; "));
        }
        if needs_look && !self.needs_look {
            let why = "its contact would be stable only while commands look ahead, and this run does not stop when they \
                       cannot; start with `--set`";
            return Err(why.into());
        }
        Ok(())
    }

    /// The parameters that may change, with their active values.
    fn shown(&self) -> String {
        let live = self.judge.live().params.iter().filter(|param| matches!(param.place, Tunable::Live(..)));
        let lines = live.map(|param| format!("  {} = {}\n", param.path, self.value(param)));
        lines.collect()
    }

    /// The active value of a parameter, in its unit.
    fn value(&self, param: &Param) -> String {
        match (&param.place, param.boolean) {
            (Tunable::Live(slot, _), true) => (self.ready.control.get(*slot) != 0.0).to_string(),
            (Tunable::Live(slot, _), false) => quantity(self.ready.control.get(*slot), &param.unit, 6),
            (Tunable::Start(_), _) => "read by a start".into(),
        }
    }

    /// Sends a set to the cycle if a start would accept it. Returns what has changed, in words, and the cycle.
    fn change(&mut self, operator: &mut Operator, wanted: &[Assignment]) -> Result<Done, String> {
        let set = self.judge.read(wanted)?;
        let before: Vec<(Slot, f64)> =
            set.values().iter().map(|(slot, _)| (*slot, self.ready.control.get(*slot))).collect();
        let shown = |rehearsal: &Rehearsal| -> Vec<String> {
            let params = &rehearsal.judge.live().params;
            let param =
                |slot: Slot| params.iter().find(|param| matches!(param.place, Tunable::Live(at, _) if at == slot));
            set.values().iter().filter_map(|(slot, _)| param(*slot)).map(|param| rehearsal.value(param)).collect()
        };
        let old = shown(self);
        self.ready.set(set.values());
        let taken = self.objection(&set).and_then(|()| match operator.wait(Command::Set(set)) {
            Answer::Taken(cycle) => Ok(cycle),
            Answer::Refused(Reason::Set(objection)) => Err(self.judge.words(&objection)),
            Answer::Refused(why) => Err(why.words()),
        });
        if taken.is_err() {
            self.ready.set(&before);
        }
        let cycle = taken?;
        let changed = wanted.iter().zip(old.iter().zip(shown(self)));
        let words: Vec<String> =
            changed.map(|(Assignment { path, .. }, (old, new))| format!("{path} {old} → {new}")).collect();
        Ok(Done { words: words.join(", "), cycle })
    }
}

/// A command that was carried out.
#[derive(Default)]
struct Done {
    /// What has changed; empty if the command says it all.
    words: String,
    /// The cycle of the log that took it.
    cycle: Option<u64>,
}

/// A command: typed here, with what it says, or by a viewer of the panel.
enum Said {
    Typed(String, Result<Line, String>),
    Asked(Asked),
}

/// What people want after the end of a run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Wish {
    /// The next run.
    Again,
    /// The end of the program.
    Quit,
}

/// The run that is under way.
struct Run {
    stopper: Stopper,
    lines: Sender<Said>,
}

/// The run that is under way, if any, and a stop that was said before the next one could hear it.
#[derive(Default)]
struct Under {
    run: Option<Run>,
    stopped: Option<Origin>,
}

/// Passes the lines of all who speak to the run that is under way.
#[derive(Clone)]
pub struct Desk {
    under: Arc<Mutex<Under>>,
    wishes: Sender<Wish>,
}

impl Desk {
    /// Without a run, and what is wished for when there is none.
    pub fn new() -> (Desk, Receiver<Wish>) {
        let (wishes, wished) = channel();
        (Desk { under: Arc::default(), wishes }, wished)
    }

    fn under(&self) -> MutexGuard<'_, Under> {
        self.under.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A run begins. Without a rehearsal, no parameter may change.
    pub fn begins(&self, operator: Operator, rehearsal: Option<Rehearsal>) {
        let (lines, typed) = channel();
        let stopper = operator.stopper();
        std::thread::spawn(move || carry_out(operator, rehearsal, &typed));
        let mut under = self.under();
        if let Some(origin) = under.stopped.take() {
            stopper.stop(origin);
        }
        under.run = Some(Run { stopper, lines });
    }

    /// It has ended.
    pub fn ends(&self) {
        *self.under() = Under::default();
    }

    /// Says what is wished for, for which the program waits after the end of a run.
    pub fn wish(&self, wish: Wish) {
        let _ = self.wishes.send(wish);
    }

    /// Stops the run; the next one, if it is about to begin.
    pub fn stop(&self, origin: Origin) {
        let mut under = self.under();
        match &under.run {
            Some(run) => run.stopper.stop(origin),
            None => under.stopped = under.stopped.or(Some(origin)),
        }
    }

    /// A command of a viewer of the panel.
    pub fn ask(&self, asked: Asked) {
        let under = self.under();
        match &under.run {
            Some(run) => {
                let _ = run.lines.send(Said::Asked(asked));
            }
            None => {
                drop(under);
                if asked.line == Line::Again {
                    self.wish(Wish::Again);
                    asked.answer(&Ok(None));
                } else {
                    asked.answer(&Err(Reason::Ended.words()));
                }
            }
        }
    }

    /// Reads what is typed, until that ends: for a thread of its own.
    pub fn listen(&self) {
        for line in std::io::stdin().lock().lines() {
            let Ok(text) = line else { break };
            let text = text.trim();
            if text.is_empty() {
                continue;
            }
            let line = Line::read(text).and_then(|line| line.at(Door::Prompt));
            let under = self.under();
            match (&under.run, line) {
                (Some(run), Ok(Line::Stop | Line::Quit)) => run.stopper.stop(Origin::Prompt),
                (Some(run), line) => {
                    let _ = run.lines.send(Said::Typed(text.into(), line));
                }
                (None, Ok(Line::Again)) => self.wish(Wish::Again),
                (None, Ok(Line::Stop | Line::Quit)) => self.wish(Wish::Quit),
                (None, line) => {
                    let why = line.err().unwrap_or_else(|| "no rig runs. Type again or quit".into());
                    Terminal::new().error(&format!("`{text}` is refused: {why}"));
                }
            }
        }
    }
}

/// Executes lines in order, and reports the result of each.
fn carry_out(mut operator: Operator, mut rehearsal: Option<Rehearsal>, said: &Receiver<Said>) {
    let mut terminal = Terminal::new();
    for said in said {
        let (text, line, origin) = match &said {
            Said::Typed(text, line) => (text.clone(), line.clone(), Origin::Prompt),
            Said::Asked(asked) => (asked.line.to_string(), Ok(asked.line.clone()), Origin::Page(asked.seat)),
        };
        operator.speaks_for(origin);
        let done = line.and_then(|line| obeyed(&line, &mut operator, &mut rehearsal));
        match (&done, &said) {
            (Ok(done), Said::Typed(..)) if done.words.is_empty() => {}
            (Ok(done), Said::Typed(..)) => terminal.line(&format!("  {}", done.words.trim())),
            (Ok(done), Said::Asked(asked)) if done.words.is_empty() => {
                terminal.line(&format!("  panel, {}: {text}", asked.seat))
            }
            (Ok(done), Said::Asked(asked)) => {
                terminal.line(&format!("  panel, {}: {text} ({})", asked.seat, done.words.trim()))
            }
            (Err(why), _) => terminal.error(&format!("`{text}` is refused: {why}")),
        }
        if let Said::Asked(asked) = said {
            asked.answer(&done.map(|done| done.cycle));
        }
    }
}

/// Obeys a line.
fn obeyed(line: &Line, operator: &mut Operator, rehearsal: &mut Option<Rehearsal>) -> Result<Done, String> {
    let mut wait = |command| match operator.wait(command) {
        Answer::Taken(cycle) => Ok(Done { words: String::new(), cycle }),
        Answer::Refused(why) => Err(why.words()),
    };
    let only = |words: String| Ok(Done { words, cycle: None });
    match (line, rehearsal) {
        (Line::Enable, _) => wait(Command::Enable),
        (Line::Arm, _) => wait(Command::Arm),
        (Line::Mark(mark), _) => wait(Command::Mark(*mark)),
        (Line::Set(wanted), Some(rehearsal)) => rehearsal.change(operator, wanted),
        (Line::Show, Some(rehearsal)) => only(rehearsal.shown()),
        (Line::Set(_) | Line::Show, None) => Err(Reason::Unjudged.words()),
        (Line::Help, _) => only(HELP.into()),
        (Line::Again, _) => Err(RUNS.into()),
        (Line::Stop | Line::Quit, _) => wait(Command::Stop),
        // Refused where they are read, and of the chair alone.
        (Line::Reset | Line::Take | Line::Give | Line::Refuse, _) => {
            line.clone().at(Door::Prompt).and(only(String::new()))
        }
    }
}
