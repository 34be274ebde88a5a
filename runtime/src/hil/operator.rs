//! Commands of an operator to a running rig, and their answers.
//!
//! In: commands from all holders of the [`Operator`], in any thread. Out: exactly one [`Answer`] for each command. A
//! stop is a flag and never waits for other commands. Every other command waits in a queue of [`PLACES`] places; it is
//! refused at once if the queue is full, and by the cycle if it is older than [`OLD_NS`]. The cycle's side neither
//! blocks nor allocates, because no more commands can be open than there are places for answers.

use super::line::Mark;
use super::live::{Objection, Set};
use super::origin::Origin;
use super::stage::Stage;
use crate::realtime::clock::monotonic_ns;
use crate::safety::{Protection, is_present};
use crate::spsc::{Receiver, Sender, queue};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Most commands that can be open at once.
pub const PLACES: usize = 64;
/// Age from which a command is refused, ns, because the operator may have changed his mind. At least two periods, so
/// that a slow rig can be commanded at all.
pub const OLD_NS: u64 = 1_000_000_000;

/// Polling interval of a thread that waits for an answer.
const LOOK: Duration = Duration::from_millis(2);

/// Commands of an operator to a running rig.
#[derive(Clone, Copy, PartialEq, Debug)]
#[allow(clippy::large_enum_variant, reason = "a box would be freed in a cycle")]
pub enum Command {
    /// Enable the drives, at zero command.
    Enable,
    /// Connect the outputs to the model.
    Arm,
    /// Controlled stop.
    Stop,
    /// New values of parameters, as one set.
    Set(Set),
    /// Words for the log, at this cycle.
    Mark(Mark),
}

impl Command {
    /// The command's name as an operator types it.
    pub fn name(&self) -> &'static str {
        match self {
            Command::Enable => "enable",
            Command::Arm => "arm",
            Command::Stop => "stop",
            Command::Set(_) => "set",
            Command::Mark(_) => "mark",
        }
    }
}

/// Result of a command.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Answer {
    /// It takes effect in the cycle of this number, as in the log; a stop in the next one, whatever its number.
    Taken(Option<u64>),
    /// It has no effect.
    Refused(Reason),
}

/// Reason to refuse a command.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Reason {
    /// It waited for this time, ns.
    Old(u64),
    /// It is not permitted in this stage.
    NotNow(Stage),
    /// The rig is stopping.
    Stopping,
    /// No judge decides which parameters may change.
    Unjudged,
    /// A set that contains an error, or with which a start would be refused.
    Set(Objection),
    /// The queue is full.
    Full,
    /// Nobody watches yet, and the rig stops when nobody does.
    Unwatched,
    /// The rig has ended.
    Ended,
}

impl Reason {
    /// The reason as text; for a set, its judge has a better one.
    pub fn words(&self) -> String {
        match self {
            Reason::Old(ns) => format!("it is {:.1} s old: say it again", *ns as f64 * 1e-9),
            Reason::NotNow(stage) => format!("it has no effect now: the rig is {stage}"),
            Reason::Stopping => "the rig was told to stop".into(),
            Reason::Unjudged => "no parameter of this rig may change while it runs".into(),
            Reason::Set(objection) => format!("{objection:?}"),
            Reason::Full => format!("{PLACES} commands wait already: say it again"),
            Reason::Unwatched => "nobody watches yet, and with --dead-man somebody must: open the panel".into(),
            Reason::Ended => "the rig has ended".into(),
        }
    }
}

/// Time at which a command was given.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Stamp {
    /// Time of the rig at its last cycle, ns.
    Rig(u64),
    /// Time of the machine's monotonic clock, ns.
    Wall(u64),
}

impl Stamp {
    /// The current time of the machine's monotonic clock.
    pub fn wall() -> Stamp {
        Stamp::Wall(monotonic_ns())
    }
}

/// A command in the queue.
#[derive(Clone, Copy)]
pub(super) struct Said {
    pub number: u64,
    pub stamp: Stamp,
    pub origin: Origin,
    pub command: Command,
}

/// State shared by both sides.
#[derive(Default)]
struct Shared {
    /// Who has requested a stop first, as a number; 0: nobody.
    stop: AtomicU64,
    now_ns: AtomicU64,
}

impl Shared {
    fn stop(&self, origin: Origin) {
        let _ = self.stop.compare_exchange(0, origin.number(), Ordering::Relaxed, Ordering::Relaxed);
    }
}

/// Stops a rig from any thread, regardless of waiting commands.
#[derive(Clone)]
pub struct Stopper(Arc<Shared>);

impl Stopper {
    /// Requests a controlled stop in the next cycle.
    pub fn stop(&self, origin: Origin) {
        self.0.stop(origin);
    }
}

/// Whether anybody watches a rig: a dead man's switch. Nobody has watched yet until the first [`Attention::seen`].
#[derive(Debug)]
pub struct Attention {
    limit_ns: u64,
    seen_ns: AtomicU64,
}

/// What an [`Attention`] says.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Watched {
    /// Nobody has watched yet.
    NotYet,
    /// Somebody watches.
    Yes,
    /// Somebody did, and nobody has for longer than the limit.
    NoLonger,
}

impl Attention {
    /// With this limit.
    pub fn new(limit: Duration) -> Attention {
        let limit_ns = u64::try_from(limit.as_nanos()).unwrap_or(u64::MAX);
        Attention { limit_ns, seen_ns: AtomicU64::new(0) }
    }

    /// Somebody has just seen the rig: from any thread.
    pub fn seen(&self) {
        self.seen_ns.store(monotonic_ns().max(1), Ordering::Relaxed);
    }

    /// Whether anybody watches, at a time of the machine's monotonic clock.
    pub fn at(&self, now_ns: u64) -> Watched {
        match self.seen_ns.load(Ordering::Relaxed) {
            0 => Watched::NotYet,
            seen_ns if now_ns.saturating_sub(seen_ns) > self.limit_ns => Watched::NoLonger,
            _ => Watched::Yes,
        }
    }

    /// Whether anybody watches now.
    pub fn now(&self) -> Watched {
        self.at(monotonic_ns())
    }
}

/// The operator's side: sends commands and receives answers.
pub struct Operator {
    commands: Sender<Said>,
    answers: Receiver<(u64, Answer)>,
    shared: Arc<Shared>,
    /// Answers that have not been fetched yet, the oldest first.
    known: VecDeque<(u64, Answer)>,
    next: u64,
    /// Number of commands without an answer.
    open: usize,
    wall: bool,
    origin: Origin,
}

/// Identifies a command whose answer is due.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Ticket(u64);

impl Operator {
    /// Measures the age of commands by the machine's clock instead of the rig's.
    pub fn by_the_wall(self) -> Operator {
        Operator { wall: true, ..self }
    }

    /// From now on it passes on the commands of this one.
    pub fn speaks_for(&mut self, origin: Origin) {
        self.origin = origin;
    }

    /// A handle that stops the rig without this operator.
    pub fn stopper(&self) -> Stopper {
        Stopper(self.shared.clone())
    }

    /// Gives a command, now.
    ///
    /// # Errors
    /// If the queue is full or the rig has ended.
    pub fn say(&mut self, command: Command) -> Result<Ticket, Reason> {
        let stamp = match self.wall {
            true => Stamp::wall(),
            false => Stamp::Rig(self.shared.now_ns.load(Ordering::Relaxed)),
        };
        self.say_at(command, stamp)
    }

    /// Gives a command with the time at which it was given.
    ///
    /// # Errors
    /// As [`Operator::say`].
    pub fn say_at(&mut self, command: Command, stamp: Stamp) -> Result<Ticket, Reason> {
        self.listen();
        let number = self.next;
        if command == Command::Stop {
            self.shared.stop(self.origin);
            self.remember(number, Answer::Taken(None));
        } else if self.commands.is_abandoned() {
            return Err(Reason::Ended);
        } else if self.open == PLACES || !self.commands.push(Said { number, stamp, origin: self.origin, command }) {
            return Err(Reason::Full);
        } else {
            self.open += 1;
        }
        self.next += 1;
        Ok(Ticket(number))
    }

    /// Gives a command and discards its answer; false if the queue is full or the rig has ended.
    pub fn push(&mut self, command: Command) -> bool {
        self.say(command).is_ok()
    }

    /// The answer to a command; none while no cycle has handled it. Each answer is returned once; if more than
    /// [`PLACES`] are not fetched, the oldest are discarded.
    pub fn answer(&mut self, ticket: Ticket) -> Option<Answer> {
        let ended = self.commands.is_abandoned();
        self.listen();
        match self.known.iter().position(|(number, _)| *number == ticket.0) {
            Some(at) => self.known.remove(at).map(|(_, answer)| answer),
            None => ended.then_some(Answer::Refused(Reason::Ended)),
        }
    }

    /// Gives a command and waits for its answer: for a thread of its own, never for that of the cycle.
    pub fn wait(&mut self, command: Command) -> Answer {
        let ticket = match self.say(command) {
            Ok(ticket) => ticket,
            Err(why) => return Answer::Refused(why),
        };
        loop {
            match self.answer(ticket) {
                Some(answer) => return answer,
                None => std::thread::sleep(LOOK),
            }
        }
    }

    fn listen(&mut self) {
        while let Some((number, answer)) = self.answers.pop() {
            self.open -= 1;
            self.remember(number, answer);
        }
    }

    fn remember(&mut self, number: u64, answer: Answer) {
        if self.known.len() == PLACES {
            self.known.pop_front();
        }
        self.known.push_back((number, answer));
    }
}

/// The cycle's side.
pub(super) struct Commands {
    queue: Receiver<Said>,
    answers: Sender<(u64, Answer)>,
    shared: Arc<Shared>,
    old_ns: u64,
}

/// Creates both sides, for a rig of this period.
pub(super) fn commands(period_ns: u64) -> (Operator, Commands) {
    let (commands, said) = queue(PLACES);
    let (answers, answered) = queue(PLACES);
    let shared = Arc::new(Shared::default());
    let known = VecDeque::with_capacity(PLACES);
    let operator = Operator {
        commands,
        answers: answered,
        shared: shared.clone(),
        known,
        next: 0,
        open: 0,
        wall: false,
        origin: Origin::Program,
    };
    (operator, Commands { queue: said, answers, shared, old_ns: OLD_NS.max(2 * period_ns) })
}

impl Commands {
    /// Notes the time of a cycle.
    pub fn begin(&mut self, now_ns: u64) {
        self.shared.now_ns.store(now_ns, Ordering::Relaxed);
    }

    /// Who has requested a stop since the last call, if anybody has.
    pub fn takes_stop(&mut self) -> Option<Origin> {
        Origin::of(self.shared.stop.swap(0, Ordering::Relaxed))
    }

    /// The next command, if it is a set (`set`) or another command (`!set`); commands that are too old are refused on
    /// the way.
    pub fn next(&mut self, now_ns: u64, set: bool) -> Option<Said> {
        while let Some(said) = self.queue.first() {
            if matches!(said.command, Command::Set(_)) != set {
                return None;
            }
            self.queue.pop();
            let age_ns = match said.stamp {
                Stamp::Rig(then_ns) => now_ns.saturating_sub(then_ns),
                Stamp::Wall(then_ns) => monotonic_ns().saturating_sub(then_ns),
            };
            if age_ns <= self.old_ns || !is_present(Protection::Old) {
                return Some(said);
            }
            self.answer(said.number, Answer::Refused(Reason::Old(age_ns)));
        }
        None
    }

    /// Answers a command.
    pub fn answer(&mut self, number: u64, answer: Answer) {
        let told = self.answers.push((number, answer));
        debug_assert!(told, "answers have as many places as commands");
    }
}
