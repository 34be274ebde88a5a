//! A rig that runs, with its operator's commands: what its process tells, and its log as a recording that grows.
//!
//! In: lines of the rig's process, and the recording once its log has begun. Out: a subject whose words become lines to
//! that process. Waits for no answer: an answer becomes part of the state, so a viewer whose set is being checked can
//! still stop the rig.
//!
//! ```text
//! from the rig      stage NEXT WORDS      NEXT: `enable`, `arm`, or `-` where no command is awaited
//!                   now NS                the time of its monotonic clock, several times a second
//!                   energy SHARE CYCLES   the most that a contact gave back of what it can hold, and cycles without
//!                                         prediction
//!                   ok NUMBER             the command of this number has been carried out
//!                   refused NUMBER WORDS  it has not, and why
//!                   over WORDS            how the run ended
//!                   problem WORDS         what the panel cannot show, and why
//! to the rig        NUMBER COMMAND        as at the prompt
//!                   NUMBER @NS COMMAND    where the rig tells its time: the last one that came
//! ```

use crate::frame::Frame;
use crate::knob::Knob;
use crate::line::View;
use crate::recording::{Played, Recording};
use crate::server::Bell;
use crate::subject::Subject;
use crate::words::clean;
use abi::live::{Live, Tunable};
use abi::{Instance, Slot};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Write;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// A command is refused if the picture on which it was given is older than this, in s: a click that waited in a dead
/// connection must not arm a rig.
const OLD: f64 = 1.0;
/// Commands that wait for their answer; the oldest is forgotten.
const OPEN: usize = 64;

/// Time for which the panel of a rig that has ended waits for a page.
const REMAINS: Duration = Duration::from_secs(5);

/// Returns once nobody has looked for a while: a page that is loaded again has no connection for a moment.
pub fn remain(bell: &Bell) {
    let mut alone = Instant::now();
    while alone.elapsed() < REMAINS {
        std::thread::sleep(Duration::from_millis(100));
        if bell.viewers() > 0 {
            alone = Instant::now();
        }
    }
}

/// What the rig's process has told.
struct Inner {
    stage: String,
    next: String,
    over: Option<String>,
    problem: Option<String>,
    /// Commands without an answer, by number.
    open: BTreeMap<u64, String>,
    last: u64,
    /// The last time that the process told, by its monotonic clock in ns: each command names it.
    now: Option<u64>,
    /// Share of energy given back, and cycles without prediction.
    energy: Option<(f64, u64)>,
    /// The last answer, and its number.
    answer: Option<(u64, String, Result<(), String>)>,
    changes: u64,
}

/// A parameter that may change, and its slot.
struct Turned {
    knob: Knob,
    slot: Slot,
}

/// The rig once its log has begun.
struct Begun {
    played: Arc<Played>,
    knobs: Vec<Turned>,
}

/// A rig with its commands.
pub struct Operated {
    name: String,
    inner: Mutex<Inner>,
    begun: OnceLock<Begun>,
    to: Mutex<Box<dyn Write + Send>>,
    bell: Bell,
}

impl Operated {
    /// Before its start-up has asked the drives. `to`: lines to the rig's process.
    pub fn new(name: &str, to: Box<dyn Write + Send>, bell: Bell) -> Operated {
        let inner = Inner {
            stage: "starting".into(),
            next: "-".into(),
            over: None,
            problem: None,
            open: BTreeMap::new(),
            last: 0,
            now: None,
            energy: None,
            answer: None,
            changes: 1,
        };
        Operated { name: name.into(), inner: Mutex::new(inner), begun: OnceLock::new(), to: Mutex::new(to), bell }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn recording(&self) -> Option<MutexGuard<'_, Recording>> {
        self.begun.get().map(|begun| begun.played.recording())
    }

    /// Its log has begun. `control`: the program whose parameters change.
    pub fn begins(&self, played: Arc<Played>, live: &Live, control: &Instance) {
        let quantities = &control.description().quantities;
        let knobs = live.settable().filter_map(|(param, limit)| {
            let Tunable::Live(slot, _) = param.place else { return None };
            let quantity = quantities.iter().find(|quantity| quantity.path == param.path && quantity.slot == slot)?;
            Some(Turned { knob: Knob::new(quantity, control.block()[slot.index()]).tuned(limit), slot })
        });
        let begun = Begun { played, knobs: knobs.collect() };
        let _ = self.begun.set(begun);
        self.inner().changes += 1;
        self.bell.ring();
    }

    /// A line of the rig's process.
    pub fn told(&self, line: &str) {
        let (word, rest) = line.split_once(' ').unwrap_or((line, ""));
        let mut inner = self.inner();
        match word {
            "stage" => {
                let (next, stage) = rest.split_once(' ').unwrap_or((rest, ""));
                (inner.next, inner.stage) = (next.into(), stage.into());
            }
            "over" => {
                (inner.over, inner.next) = (Some(rest.into()), "-".into());
            }
            "problem" => inner.problem = Some(rest.into()),
            "energy" => {
                let numbers = rest.split_once(' ');
                let numbers = numbers.and_then(|(share, cycles)| Some((share.parse().ok()?, cycles.parse().ok()?)));
                inner.energy = numbers.or(inner.energy);
            }
            "now" => {
                inner.now = rest.parse().ok();
                return;
            }
            "ok" | "refused" => {
                let (number, why) = rest.split_once(' ').unwrap_or((rest, ""));
                let Ok(number) = number.parse() else { return };
                let Some(said) = inner.open.remove(&number) else { return };
                let result = if word == "ok" { Ok(()) } else { Err(why.to_string()) };
                inner.answer = Some((number, said, result));
            }
            _ => return,
        }
        inner.changes += 1;
        drop(inner);
        self.bell.ring();
    }

    /// Whether the run is over.
    pub fn is_over(&self) -> bool {
        self.inner().over.is_some()
    }

    /// Nothing more can be heard of the rig. `why`: if it has not told how it ended.
    pub fn left(&self, why: &str) {
        if !self.is_over() {
            self.told(&format!("over {why}"));
        }
    }

    /// Says a line to the rig's process.
    fn say_line(&self, line: &str) -> Result<(), String> {
        let mut to = self.to.lock().unwrap_or_else(PoisonError::into_inner);
        let said = to.write_all(format!("{line}\n").as_bytes()).and_then(|()| to.flush());
        said.map_err(|_| "the rig has ended".to_string())
    }
}

impl Subject for Operated {
    fn hello(&self) -> (u64, Value) {
        let (number, mut value) = match self.recording() {
            Some(recording) => (2, recording.hello()),
            None => (
                1,
                json!({
                    "title": clean(&self.name), "experiments": [], "cases": [""], "signals": [], "canvases": [],
                    "from": 0, "to": 0, "period": 0.001, "solver": "", "grows": true,
                }),
            ),
        };
        value["kind"] = json!("rig");
        let knobs = self.begun.get().map_or(&[][..], |begun| &begun.knobs);
        value["knobs"] = knobs.iter().map(|one| one.knob.json()).collect();
        (number, value)
    }

    fn state(&self) -> (u64, Value) {
        let (told, mut value) = match self.recording() {
            Some(recording) => {
                let knobs = &self.begun.get().expect("it has a recording").knobs;
                let si = |one: &Turned| recording.set_value(one.slot).unwrap_or(one.knob.own);
                let mut value = recording.state();
                value["values"] = knobs.iter().map(|one| one.knob.unit.from_si(si(one))).collect();
                value["texts"] = knobs.iter().map(|one| one.knob.text(si(one))).collect();
                (recording.told(), value)
            }
            None => (0, json!({ "values": [], "texts": [], "layers": [true], "kept": [], "set": "", "events": [] })),
        };
        let inner = self.inner();
        value["stage"] = clean(&inner.stage).into();
        value["problem"] = inner.problem.as_deref().map(clean).into();
        value["energy"] = inner.energy.map(|(share, cycles)| json!({ "share": share, "unpredicted": cycles })).into();
        value["next"] = inner.next.clone().into();
        value["over"] = inner.over.as_deref().map(clean).into();
        value["answer"] = match &inner.answer {
            Some((number, said, result)) => json!({
                "number": number,
                "said": clean(said),
                "refused": result.as_ref().err().map(|why| clean(why)),
            }),
            None => Value::Null,
        };
        (told + inner.changes, value)
    }

    fn version(&self) -> u64 {
        self.begun.get().map_or(0, |begun| begun.played.version())
    }

    fn newest(&self) -> f64 {
        self.begun.get().map_or(0.0, |begun| begun.played.newest())
    }

    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame) {
        if let Some(begun) = self.begun.get() {
            begun.played.blocks(view, since, frame);
        }
    }

    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        if let Some(begun) = self.begun.get() {
            begun.played.points(curve, from, each);
        }
    }

    fn say(&self, words: &str) -> Result<String, String> {
        let (seen, words) = match words.strip_prefix('@').and_then(|rest| rest.split_once(' ')) {
            Some((seen, rest)) => (seen.parse::<f64>().ok(), rest.trim()),
            None => (None, words.trim()),
        };
        if words.chars().any(char::is_control) {
            return Err("a command is one line".into());
        }
        // A stop is obeyed with any age, and before anything else is asked.
        let stops = words == "stop";
        if !stops {
            let begins = |word: &str| words.strip_prefix(word).is_some_and(|rest| rest.starts_with(' '));
            if words != "enable" && words != "arm" && !begins("set") && !begins("mark") {
                return Err("say enable, arm, set PATH = VALUE, mark WORDS or stop".into());
            }
            if let Some(over) = &self.inner().over {
                return Err(format!("the rig has ended: {over}"));
            }
            let age =
                self.newest() - seen.ok_or("say first which picture you have seen: @SECONDS, the end of its data")?;
            // What is not a number is not young either.
            if !(-OLD..=OLD).contains(&age) {
                return Err(format!("it was given before a picture that is {age:.1} s old: look, and give it again"));
            }
        }
        let (number, now) = {
            let mut inner = self.inner();
            inner.last += 1;
            let number = inner.last;
            inner.open.insert(number, words.into());
            if inner.open.len() > OPEN {
                inner.open.pop_first();
            }
            (number, inner.now.filter(|_| !stops))
        };
        let stamp = now.map_or(String::new(), |ns| format!("@{ns} "));
        self.say_line(&format!("{number} {stamp}{words}"))?;
        Ok(number.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn open() -> (Operated, Lines) {
        let lines = Lines::default();
        (Operated::new("r", Box::new(lines.clone()), Bell::default()), lines)
    }

    /// Random words with random pictures: whatever is passed on is one line, known, and young, or `stop`.
    #[test]
    fn only_known_and_young_commands_are_passed_on_and_stop_always_is() {
        const SEEN: &[&str] =
            &["", "@0 ", "@0.9 ", "@-0.9 ", "@1.1 ", "@-1.1 ", "@nan ", "@inf ", "@x ", "@ ", "@0", "@-1e308 "];
        const WORDS: &[&str] = &[
            "stop",
            "enable",
            "arm",
            "set fr.Fs = 1 N",
            "set ",
            "set",
            "reset",
            "stop\nenable",
            "set a = 1\n7 arm",
            "STOP",
            "",
            "enable stop",
            "\u{7}stop",
        ];
        let mut passed = 0;
        for seed in 0..(SEEN.len() * WORDS.len()) {
            let (seen, words) = (SEEN[seed % SEEN.len()], WORDS[seed / SEEN.len()]);
            let (operated, lines) = open();
            let said = format!("{seen}{words}");
            let result = operated.say(&said);
            let written = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
            let known = matches!(words, "enable" | "arm" | "set fr.Fs = 1 N");
            let young = matches!(seen, "@0 " | "@0.9 " | "@-0.9 ");
            // After the picture that was seen, if any: a stop is obeyed whatever that is.
            let told = if said.starts_with('@') { said.split_once(' ').map(|(_, told)| told) } else { Some(&*said) };
            let stops = told == Some("stop");
            match stops || known && young {
                true => {
                    passed += 1;
                    assert_eq!(
                        (result.as_deref(), written),
                        (Ok("1"), format!("1 {}\n", if stops { "stop" } else { words })),
                        "{said:?}"
                    );
                }
                false => assert_eq!(written, "", "{said:?}"),
            }
        }
        assert!(passed > 15, "{passed}");
    }

    #[test]
    fn answers_and_the_end_are_part_of_the_state() {
        let (operated, lines) = open();
        operated.told("stage enable waiting to be enabled");
        assert_eq!(operated.state().1["next"], "enable");
        operated.say("@0 enable").unwrap();
        let before = operated.state().0;
        operated.told("refused 1 it has no effect now");
        let (after, state) = operated.state();
        assert!(after > before);
        assert_eq!(state["answer"], json!({ "number": 1, "said": "enable", "refused": "it has no effect now" }));
        // Answers to nothing, and lines that are none, change nothing.
        for line in ["ok 1", "ok", "refused x y", "", "hello", "\u{202e}"] {
            operated.told(line);
            assert_eq!(operated.state().0, after, "{line}");
        }
        // A command names the time that the process told last, a stop none.
        operated.told("now 123");
        operated.say("@0 enable").unwrap();
        operated.say("stop").unwrap();
        assert!(String::from_utf8(lines.0.lock().unwrap().clone()).unwrap().ends_with("2 @123 enable\n3 stop\n"));
        operated.told("over stopped: enabling switch released");
        assert!(operated.say("@0 arm").is_err_and(|why| why.contains("enabling switch released")));
        assert!(operated.say("stop").is_ok());
        operated.left("lost");
        assert_eq!(operated.state().1["over"], "stopped: enabling switch released");
    }
}
