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
//!                   chair HOLDER ASKS REFUSED  who operates it, who asks to, who was refused: `PANEL.PAGE`, or `-`
//!                   you PANEL             the number of this panel, if the rig can have several
//!                   ok NUMBER CYCLE       the command of this number has been carried out, by this cycle of the log;
//!                                         without CYCLE where none did
//!                   refused NUMBER WORDS  it has not, and why
//!                   over WORDS            how the run ended
//!                   again                 it may be started again
//!                   anew                  it is being started again
//!                   problem WORDS         what the panel cannot show, and why
//! to the rig        NUMBER page PAGE COMMAND      as at the prompt; also `take`, `give`, `refuse`
//!                   NUMBER page PAGE @NS COMMAND  where the rig tells its time: the last one that came
//!                   here PAGE, left PAGE  a page is there, has gone
//!                   seen                  a page has drawn a picture; at most ten times a second
//! ```

use crate::frame::Frame;
use crate::knob::Knob;
use crate::line::{self, View};
use crate::recording::Played;
use crate::server::Bell;
use crate::subject::{Page, Subject};
use crate::words::clean;
use abi::live::{Live, Tunable};
use abi::{Instance, Slot};
use runtime::hil::chair::Seats;
use runtime::hil::line::{Door, Line, RUNS};
use runtime::hil::origin::Seat;
use serde_json::{Value, json};
use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// A command is refused if the picture on which it was given is older than this, in s: a click that waited in a dead
/// connection must not arm a rig.
const OLD: f64 = 1.0;
/// Commands that wait for their answer; the oldest is forgotten.
const OPEN: usize = 64;
/// Answers that are shown, the newest: each page picks its own ones.
const ANSWERS: usize = 32;
/// Least interval of the messages to the rig that a page is drawn, which hold its dead man.
const SEEN: Duration = Duration::from_millis(100);

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
    /// Commands without an answer, by number: whose they are.
    open: BTreeMap<u64, (Page, String)>,
    last: u64,
    /// The last time that the process told, by its monotonic clock in ns: each command names it.
    now: Option<u64>,
    /// Share of energy given back, and cycles without prediction.
    energy: Option<(f64, u64)>,
    answers: VecDeque<Answer>,
    /// The number of this panel at its rig.
    panel: u16,
    chair: Seats,
    /// When the rig was told last that it is seen.
    seen: Option<Instant>,
    /// The number of the run, from 0.
    run: u64,
    changes: u64,
}

impl Inner {
    /// Before the start-up of a run.
    fn new(run: u64) -> Inner {
        Inner {
            stage: "starting".into(),
            next: "-".into(),
            over: None,
            problem: None,
            open: BTreeMap::new(),
            last: 0,
            now: None,
            energy: None,
            answers: VecDeque::new(),
            panel: 0,
            chair: Seats::default(),
            seen: None,
            run,
            changes: 1,
        }
    }
}

/// What the rig said to a command.
struct Answer {
    number: u64,
    page: Page,
    said: String,
    /// The cycle that took it, if one did; or why it was refused.
    result: Result<Option<u64>, String>,
}

impl Answer {
    fn json(&self) -> Value {
        json!({
            "number": self.number,
            "page": self.page.number,
            "said": clean(&self.said),
            "cycle": self.result.as_ref().ok(),
            "refused": self.result.as_ref().err().map(|why| clean(why)),
        })
    }
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
    begun: RwLock<Option<Arc<Begun>>>,
    to: Mutex<Box<dyn Write + Send>>,
    bell: Bell,
}

impl Operated {
    /// Before its start-up has asked the drives. `to`: lines to the rig's process.
    pub fn new(name: &str, to: Box<dyn Write + Send>, bell: Bell) -> Operated {
        let (inner, begun) = (Mutex::new(Inner::new(0)), RwLock::default());
        Operated { name: name.into(), inner, begun, to: Mutex::new(to), bell }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn begun(&self) -> Option<Arc<Begun>> {
        self.begun.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The number of the run, from 0.
    pub fn run(&self) -> u64 {
        self.inner().run
    }

    /// Its log has begun. `control`: the program whose parameters change.
    pub fn begins(&self, played: Arc<Played>, live: &Live, control: &Instance) {
        let quantities = &control.description().quantities;
        let knobs = live.settable().filter_map(|(param, limit)| {
            let Tunable::Live(slot, _) = param.place else { return None };
            let quantity = quantities.iter().find(|quantity| quantity.path == param.path && quantity.slot == slot)?;
            Some(Turned { knob: Knob::new(quantity, control.block()[slot.index()]).tuned(limit), slot })
        });
        let begun = Arc::new(Begun { played, knobs: knobs.collect() });
        *self.begun.write().unwrap_or_else(PoisonError::into_inner) = Some(begun);
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
            "again" if inner.over.is_some() => inner.next = "again".into(),
            "anew" => {
                *self.begun.write().unwrap_or_else(PoisonError::into_inner) = None;
                // Who operates it, and the numbers of commands, go on.
                let (run, changes) = (inner.run + 1, inner.changes);
                let (chair, panel, last) = (inner.chair, inner.panel, inner.last);
                let answers = std::mem::take(&mut inner.answers);
                *inner = Inner { chair, panel, last, answers, changes, ..Inner::new(run) };
            }
            "chair" => match Seats::of(rest) {
                Some(seats) => inner.chair = seats,
                None => return,
            },
            "you" => match rest.parse() {
                Ok(panel) => inner.panel = panel,
                Err(_) => return,
            },
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
                let (number, more) = rest.split_once(' ').unwrap_or((rest, ""));
                let Ok(number) = number.parse() else { return };
                let Some((page, said)) = inner.open.remove(&number) else { return };
                let result = if word == "ok" { Ok(more.parse().ok()) } else { Err(more.to_string()) };
                inner.answers.push_back(Answer { number, page, said, result });
                if inner.answers.len() > ANSWERS {
                    inner.answers.pop_front();
                }
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
    pub fn ended(&self, why: &str) {
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
        let (run, begun) = (self.run(), self.begun());
        let (number, mut value) = match &begun {
            Some(begun) => (2 * run + 2, begun.played.recording().hello()),
            None => (
                2 * run + 1,
                json!({
                    "title": clean(&self.name), "experiments": [], "cases": [""], "signals": [], "canvases": [], "phases": [],
                    "from": 0, "to": 0, "period": 0.001, "solver": "", "grows": true,
                }),
            ),
        };
        value["kind"] = json!("rig");
        let knobs = begun.as_ref().map_or(&[][..], |begun| &begun.knobs);
        value["knobs"] = knobs.iter().map(|one| one.knob.json()).collect();
        (number, value)
    }

    fn state(&self) -> (u64, Value) {
        let begun = self.begun();
        let (told, mut value) = match &begun {
            Some(begun) => {
                let (recording, knobs) = (begun.played.recording(), &begun.knobs);
                let si = |one: &Turned| recording.set_value(one.slot).unwrap_or(one.knob.own);
                let mut value = recording.state();
                value["values"] = knobs.iter().map(|one| one.knob.unit.from_si(si(one))).collect();
                value["texts"] = knobs.iter().map(|one| one.knob.text(si(one))).collect();
                let changed = knobs.iter().filter(|one| si(one) != one.knob.own);
                let set = changed.map(|one| format!("--set '{} = {}'", one.knob.path, one.knob.text(si(one))));
                value["set"] = set.collect::<Vec<_>>().join(" ").into();
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
        value["answers"] = inner.answers.iter().map(Answer::json).collect();
        // A page knows those of its own panel by their numbers.
        let named = |seat: Option<Seat>| match seat {
            Some(seat) if seat.panel == inner.panel => seat.page.into(),
            Some(seat) => seat.to_string().into(),
            None => Value::Null,
        };
        let Seats { holder, asks, refused } = inner.chair;
        value["chair"] = json!({ "holder": named(holder), "asks": named(asks), "refused": named(refused) });
        (told + inner.changes, value)
    }

    fn numbers(&self) -> (u64, u64) {
        let begun = self.begun();
        let told = begun.as_ref().map_or(0, |begun| begun.played.recording().told());
        let inner = self.inner();
        (2 * inner.run + 1 + u64::from(begun.is_some()), told + inner.changes)
    }

    fn version(&self) -> u64 {
        self.begun().map_or(0, |begun| begun.played.version())
    }

    fn newest(&self) -> f64 {
        self.begun().map_or(0.0, |begun| begun.played.newest())
    }

    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame) {
        if let Some(begun) = self.begun() {
            begun.played.blocks(view, since, frame);
        }
    }

    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        if let Some(begun) = self.begun() {
            begun.played.points(curve, from, each);
        }
    }

    fn here(&self, page: Page) {
        // One that only looks has no part in who operates.
        if !page.guest {
            let _ = self.say_line(&format!("here {}", page.number));
        }
    }

    fn drew(&self, page: Page) {
        let mut inner = self.inner();
        if page.guest || inner.seen.is_some_and(|seen| seen.elapsed() < SEEN) {
            return;
        }
        inner.seen = Some(Instant::now());
        drop(inner);
        let _ = self.say_line("seen");
    }

    fn left(&self, page: Page) {
        if !page.guest {
            let _ = self.say_line(&format!("left {}", page.number));
        }
    }

    fn say(&self, page: Page, words: &str) -> Result<String, String> {
        let (seen, words) = line::seen(words);
        let line = Line::read(words)?.at(Door::Page)?;
        if line == Line::Again {
            let inner = self.inner();
            match (&inner.over, inner.next.as_str()) {
                (_, "again") => {}
                (None, _) => return Err(RUNS.into()),
                (Some(_), _) => return Err("the rig cannot be started again now".into()),
            }
        }
        // A stop is obeyed with any age.
        if line.waits() {
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
            inner.changes += 1;
            inner.open.insert(number, (page, line.to_string()));
            if inner.open.len() > OPEN {
                inner.open.pop_first();
            }
            (number, inner.now.filter(|_| line.waits()))
        };
        let stamp = now.map_or(String::new(), |ns| format!("@{ns} "));
        self.say_line(&format!("{number} page {} {stamp}{line}", page.number))?;
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

    const ONE: Page = Page { number: 1, guest: false };

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
            let result = operated.say(ONE, &said);
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
                        (Ok("1"), format!("1 page 1 {}\n", if stops { "stop" } else { words })),
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
        operated.say(ONE, "@0 enable").unwrap();
        let before = operated.state().0;
        operated.told("refused 1 it has no effect now");
        let (after, state) = operated.state();
        assert!(after > before);
        let refused = json!({
            "number": 1, "page": 1, "said": "enable", "cycle": null, "refused": "it has no effect now",
        });
        assert_eq!(state["answers"], json!([refused]));
        // Answers to nothing, and lines that are none, change nothing.
        for line in ["ok 1", "ok", "refused x y", "", "hello", "\u{202e}"] {
            operated.told(line);
            assert_eq!(operated.state().0, after, "{line}");
        }
        // A command names the time that the process told last, a stop none.
        operated.told("now 123");
        operated.say(ONE, "@0 enable").unwrap();
        operated.say(ONE, "stop").unwrap();
        assert!(
            String::from_utf8(lines.0.lock().unwrap().clone())
                .unwrap()
                .ends_with("2 page 1 @123 enable\n3 page 1 stop\n")
        );
        operated.told("over stopped: enabling switch released");
        assert!(operated.say(ONE, "@0 arm").is_err_and(|why| why.contains("enabling switch released")));
        assert!(operated.say(ONE, "stop").is_ok());
        operated.ended("lost");
        assert_eq!(operated.state().1["over"], "stopped: enabling switch released");
        // It is started again only where that is offered; then nothing of the run before is left but who operates.
        assert!(operated.say(ONE, "again").is_err());
        operated.told("again");
        assert_eq!(operated.state().1["next"], "again");
        let hello = operated.hello().0;
        operated.say(ONE, "again").unwrap();
        operated.told("chair 0.1 - -");
        operated.told("anew");
        let (number, state) = operated.state();
        assert!(number > after && operated.hello().0 > hello && operated.run() == 1);
        assert_eq!((&state["over"], &state["next"], &state["chair"]["holder"]), (&Value::Null, &json!("-"), &json!(1)));
        operated.say(ONE, "@0 enable").unwrap();
        operated.told("ok 6 1234");
        assert_eq!(operated.state().1["answers"].as_array().unwrap().last().unwrap()["cycle"], 1234);
    }

    /// Random commands of three pages and a rig that answers them in any order: each answer goes to the page that asked,
    /// with the cycle that took it, and each line to the rig names its page. Who operates is what the rig says, in the
    /// words of each panel.
    #[test]
    fn each_page_gets_its_own_answers_and_sees_who_operates() {
        for seed in 1..=300_u64 {
            let mut state = seed;
            let mut below = |n: u64| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) % n
            };
            let (operated, lines) = open();
            let own = below(3);
            operated.told(&format!("you {own}"));
            let (mut waiting, mut last) = (Vec::new(), 0);
            for cycle in 0..80 {
                let page = Page { number: 1 + below(3), guest: false };
                let before = lines.0.lock().unwrap().len();
                match below(6) {
                    0 => operated.left(page),
                    1 | 2 if below(2) == 0 || waiting.is_empty() => {
                        let words = ["@-99 stop", "stop", "take", "give", "refuse"][below(5) as usize];
                        operated.say(page, words).unwrap();
                        last += 1;
                        let line = format!("{last} page {} {}\n", page.number, words.trim_start_matches("@-99 "));
                        assert_eq!(&lines.0.lock().unwrap()[before..], line.as_bytes(), "seed {seed}");
                    }
                    1 | 2 => {
                        let (number, page): (u64, u64) = waiting.remove(below(waiting.len() as u64) as usize);
                        operated.told(&format!("ok {number} {cycle}"));
                        let told = operated.state().1["answers"].as_array().unwrap().last().unwrap().clone();
                        let found = (told["number"].as_u64(), told["page"].as_u64(), told["cycle"].as_u64());
                        assert_eq!(found, (Some(number), Some(page), Some(cycle)), "seed {seed}");
                    }
                    3 => {
                        let (panel, holder) = (below(3), 1 + below(3));
                        operated.told(&format!("chair {panel}.{holder} - -"));
                        let told = operated.state().1["chair"]["holder"].clone();
                        let same = panel == own;
                        assert_eq!(told.as_u64(), same.then_some(holder), "seed {seed}: {told}");
                        assert!(same || told.as_str().is_some_and(|it| it.starts_with(&format!("page {holder}"))));
                    }
                    _ => {
                        operated.say(page, "@0 set a = 1").unwrap();
                        last += 1;
                        waiting.push((last, page.number));
                        let line = format!("{last} page {} set a = 1\n", page.number);
                        assert_eq!(&lines.0.lock().unwrap()[before..], line.as_bytes(), "seed {seed}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_rig_is_told_that_it_is_seen_but_not_by_guests() {
        let (operated, lines) = open();
        operated.drew(Page { number: 2, guest: true });
        assert_eq!(lines.0.lock().unwrap().len(), 0);
        (0..50).for_each(|_| operated.drew(ONE));
        let told = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        assert!(told.starts_with("seen\n") && told.len() < 30, "{told}");
    }
}
