//! The operator's prompt of `fric hil`: one thread reads, another executes.
//!
//! In: lines. Out: commands, and the result of each. The reading thread sends `stop` itself, so a stop never waits for
//! a set of parameters that is being validated.

use super::beside::{Asked, Beside};
use crate::compile::{self, Changes, Loaded, Options};
use crate::loop_stability;
use crate::source_snapshot::Kept;
use crate::terminal::Terminal;
use abi::Instance;
use abi::format::quantity;
use abi::live::{Param, Tunable};
use grammar::diagnostic::Diagnostic;
use runtime::hil::live::{Judge, Set};
use runtime::hil::operator::{Answer, Command, Mark, NO_RESET, Operator, Reason};
use runtime::record::log::Sections;
use std::io::BufRead;
use std::sync::mpsc::{Receiver, channel};

/// The commands of a running rig.
const HELP: &str = "enable, arm: as the drives ask for it; set PATH = VALUE, …: parameters, judged as at a start; \
                    mark WORDS: a remark in the log; \
                    show: parameters that may change, with their values; stop: ends the run";

/// Validates sets of parameters before the cycle receives them.
///
/// The cycle checks the constraints of the start. The stability of the fixed step and of the contacts needs a compiler:
/// the rig is compiled once more with the values of the set, from the texts of the run, even if the files have changed
/// since.
pub struct Rehearsal {
    /// The constraints.
    pub judge: Judge,
    /// The control program with the active values.
    pub control: Instance,
    /// The texts as they were read.
    pub loaded: Loaded,
    /// Their imports: the head of the log.
    pub kept: Sections,
    /// The rig.
    pub name: String,
    /// `--set` of the start, then the sets in effect: path and value.
    pub set: Vec<(String, String)>,
    /// Whether contacts may be unstable.
    pub accept_unstable: bool,
    /// Whether this run stops if its predictor fails.
    pub needs_look: bool,
}

impl Rehearsal {
    /// The values of a start, with those of `set PATH = VALUE, …` replaced.
    fn with(&self, set: &str) -> Vec<(String, String)> {
        let mut all = self.set.clone();
        for (path, value) in set.split(',').filter_map(|one| one.split_once('=')) {
            all.retain(|(other, _)| other != path.trim());
            all.push((path.trim().into(), value.trim().into()));
        }
        all
    }

    /// Validates a set; `all`: the values of a start that would lead to it.
    ///
    /// # Errors
    /// What a start would refuse, in words.
    fn judge(&mut self, set: &Set, all: &[(String, String)]) -> Result<(), String> {
        let broken = self.judge.judge(self.control.block(), set.values());
        broken.map_err(|objection| self.judge.words(&objection))?;
        let set = all.iter().map(|(path, value)| format!("{path}={value}")).collect();
        let options = Options { changes: Changes { set, ..Changes::default() }, interpret: true };
        let ready = compile::rig(&mut self.loaded, &Kept(&self.kept), &self.name, &options, &mut Vec::new());
        let ready = ready.map_err(|errors| {
            let words = |error: &Diagnostic| format!("{}: {}", error.code, error.message);
            errors.iter().filter(|error| error.is_error()).map(words).collect::<Vec<_>>().join("; ")
        })?;
        if self.accept_unstable {
            return Ok(());
        }
        let (against, needs_look) = loop_stability::objections(&ready);
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
            (Tunable::Live(slot, _), true) => (self.control.get(*slot) != 0.0).to_string(),
            (Tunable::Live(slot, _), false) => quantity(self.control.get(*slot), &param.unit, 6),
            (Tunable::Start(_), _) => "read by a start".into(),
        }
    }

    /// Sends a set to the cycle if a start would accept it. Returns what has changed, in words.
    fn change(&mut self, operator: &mut Operator, text: &str) -> Result<String, String> {
        let set = self.judge.read(text)?;
        let all = self.with(text);
        self.judge(&set, &all)?;
        match operator.wait(Command::Set(set)) {
            Answer::Taken => {}
            Answer::Refused(Reason::Set(objection)) => return Err(self.judge.words(&objection)),
            Answer::Refused(why) => return Err(why.words()),
        }
        let mut said = Vec::new();
        for (slot, value) in set.values() {
            let live = self.judge.live().params.iter();
            let param = live.clone().find(|param| matches!(param.place, Tunable::Live(at, _) if at == *slot)).cloned();
            let before = param.as_ref().map(|param| self.value(param));
            self.control.set(*slot, *value);
            if let (Some(param), Some(before)) = (param, before) {
                said.push(format!("{} {before} → {}", param.path, self.value(&param)));
            }
        }
        self.set = all;
        Ok(said.join(", "))
    }
}

/// A command: typed here, or by a viewer of the panel.
enum Line {
    Typed(String),
    Asked(Asked),
}

/// Reads the operator's input line by line, and the commands from the panel beside it. Without a rehearsal, no parameter
/// may change.
pub fn prompt(operator: Operator, rehearsal: Option<Rehearsal>, beside: Option<Beside>) {
    let stopper = operator.stopper();
    let (lines, typed) = channel::<Line>();
    if let Some(beside) = beside {
        let (lines, stopper) = (lines.clone(), stopper.clone());
        std::thread::spawn(move || {
            beside.read(&stopper, &|asked| {
                let _ = lines.send(Line::Asked(asked));
            });
        });
    }
    let carrying = std::thread::spawn(move || carry_out(operator, rehearsal, &typed));
    for line in std::io::stdin().lock().lines() {
        let Ok(line) = line else { break };
        match line.trim() {
            "" => {}
            "stop" | "quit" => stopper.stop(),
            line if lines.send(Line::Typed(line.into())).is_err() => break,
            _ => {}
        }
    }
    drop(lines);
    let _ = carrying.join();
}

/// Executes lines in order, and reports the result of each.
fn carry_out(mut operator: Operator, mut rehearsal: Option<Rehearsal>, typed: &Receiver<Line>) {
    let mut terminal = Terminal::new();
    for line in typed {
        let text = match &line {
            Line::Typed(text) => text,
            Line::Asked(asked) => &asked.text,
        };
        let mut wait = |command| match operator.wait(command) {
            Answer::Taken => Ok(String::new()),
            Answer::Refused(why) => Err(why.words()),
        };
        let done = match (text.as_str(), text.strip_prefix("set "), &mut rehearsal) {
            ("enable", ..) => wait(Command::Enable),
            ("arm", ..) => wait(Command::Arm),
            (text, ..) if text == "mark" || text.starts_with("mark ") => {
                Mark::new(&text[4..]).and_then(|mark| wait(Command::Mark(mark)))
            }
            ("reset", ..) => Err(NO_RESET.into()),
            ("help", ..) => Ok(HELP.into()),
            ("show", _, Some(rehearsal)) => Ok(rehearsal.shown()),
            (_, Some(set), Some(rehearsal)) => rehearsal.change(&mut operator, set),
            (_, Some(_), None) => Err(Reason::Unjudged.words()),
            (_, None, _) => Err("type enable, arm, set PATH = VALUE, mark WORDS, show, help or stop".into()),
        };
        match (&done, &line) {
            (Ok(said), Line::Typed(_)) if said.is_empty() => {}
            (Ok(said), Line::Typed(_)) => terminal.line(&format!("  {}", said.trim())),
            (Ok(said), Line::Asked(asked)) if said.is_empty() => terminal.line(&format!("  panel: {}", asked.text)),
            (Ok(said), Line::Asked(asked)) => terminal.line(&format!("  panel: {} ({})", asked.text, said.trim())),
            (Err(why), _) => terminal.error(&format!("`{text}` is refused: {why}")),
        }
        if let Line::Asked(asked) = line {
            asked.answer(&done.map(|_| ()));
        }
    }
}
