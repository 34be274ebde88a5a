//! How an operator is heard by a rig under way, and answered.
//!
//! In: commands of all holders of the [`Operator`], from any thread. Out: for each of them exactly one [`Answer`]. A stop
//! is a flag and never waits behind other commands; everything else waits in a queue of [`PLACES`] places, is refused at
//! once where that is full, and by the cycle where it is older than [`OLD_NS`]. The cycle's side neither waits nor
//! allocates: no more commands are under way than answers have places.

use super::live::{Objection, Set};
use super::words;
use crate::realtime::clock::monotonic_ns;
use crate::safety::{Protection, is_present};
use crate::spsc::{Receiver, Sender, queue};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Commands that may be under way at once.
pub const PLACES: usize = 64;
/// Age from which a command is refused, ns: what somebody asked for so long ago may be no longer what he wants. At least
/// two periods, so that a slow rig can be commanded at all.
pub const OLD_NS: u64 = 1_000_000_000;

/// Why `reset` is refused at any time, in words.
pub const NO_RESET: &str = "a stop is final: the rig ends as soon as its drives are at rest. Start it again, so that drives \
                            are identified and tested anew";

/// How often a thread that waits for an answer looks for it.
const LOOK: Duration = Duration::from_millis(2);

/// What an operator may ask for while the rig is under way.
#[derive(Clone, Copy, PartialEq, Debug)]
#[allow(clippy::large_enum_variant, reason = "a box would be freed in a cycle")]
pub enum Command {
    /// Power on, at zero command.
    Enable,
    /// The outputs to the model.
    Arm,
    /// A controlled stop.
    Stop,
    /// New values of parameters, as one set.
    Set(Set),
}

impl Command {
    /// As an operator says it.
    pub fn name(&self) -> &'static str {
        match self {
            Command::Enable => "enable",
            Command::Arm => "arm",
            Command::Stop => "stop",
            Command::Set(_) => "set",
        }
    }
}

/// What became of a command.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Answer {
    /// It acts from this cycle on.
    Taken,
    /// It has no effect.
    Refused(Why),
}

/// Why a command has no effect.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Why {
    /// It waited so long, ns.
    Old(u64),
    /// It has no place in this stage, as a gauge shows it.
    NotNow(u64),
    /// The rig was told to stop.
    Stopping,
    /// Nothing says which parameters may change.
    Unjudged,
    /// A set that is not whole, or that a start would refuse.
    Set(Objection),
    /// So many commands wait that there is no place for it.
    Full,
    /// The rig has ended.
    Ended,
}

impl Why {
    /// In words; of a set its judge has better ones.
    pub fn words(&self) -> String {
        match self {
            Why::Old(ns) => format!("it is {:.1} s old: say it again", *ns as f64 * 1e-9),
            Why::NotNow(stage) => format!("it has no effect now: the rig is {}", words::stage(*stage)),
            Why::Stopping => "the rig was told to stop".into(),
            Why::Unjudged => "no parameter of this rig may change while it runs".into(),
            Why::Set(objection) => format!("{objection:?}"),
            Why::Full => format!("{PLACES} commands wait already: say it again"),
            Why::Ended => "the rig has ended".into(),
        }
    }
}

/// When a command was given.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Stamp {
    /// By the time of the rig, as its last cycle told it, ns.
    Rig(u64),
    /// By the machine's monotonic clock, ns.
    Wall(u64),
}

impl Stamp {
    /// Now by the machine's monotonic clock.
    pub fn wall() -> Stamp {
        Stamp::Wall(monotonic_ns())
    }
}

/// A command on its way.
#[derive(Clone, Copy)]
pub(super) struct Said {
    pub number: u64,
    pub stamp: Stamp,
    pub command: Command,
}

/// What is known to both sides at once.
#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    now_ns: AtomicU64,
}

/// Stops a rig from any thread, whatever else waits.
#[derive(Clone)]
pub struct Stopper(Arc<Shared>);

impl Stopper {
    /// A controlled stop with the next cycle.
    pub fn stop(&self) {
        self.0.stop.store(true, Ordering::Relaxed);
    }
}

/// Where an operator's commands go in, and answers come out.
pub struct Operator {
    commands: Sender<Said>,
    answers: Receiver<(u64, Answer)>,
    shared: Arc<Shared>,
    /// Answers that nobody has asked for yet, the oldest first.
    known: VecDeque<(u64, Answer)>,
    next: u64,
    /// Commands without an answer.
    open: usize,
    wall: bool,
}

/// A command that will be answered.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Ticket(u64);

impl Operator {
    /// Commands are as old as the machine's clock says, rather than that of the rig.
    pub fn by_the_wall(self) -> Operator {
        Operator { wall: true, ..self }
    }

    /// Stops the rig without this operator.
    pub fn stopper(&self) -> Stopper {
        Stopper(self.shared.clone())
    }

    /// Gives a command, now.
    ///
    /// # Errors
    /// If it cannot wait: there is no place, or no rig any more.
    pub fn say(&mut self, command: Command) -> Result<Ticket, Why> {
        let stamp = match self.wall {
            true => Stamp::wall(),
            false => Stamp::Rig(self.shared.now_ns.load(Ordering::Relaxed)),
        };
        self.say_at(command, stamp)
    }

    /// Gives a command that somebody gave then.
    ///
    /// # Errors
    /// As [`Operator::say`].
    pub fn say_at(&mut self, command: Command, stamp: Stamp) -> Result<Ticket, Why> {
        self.listen();
        let number = self.next;
        if command == Command::Stop {
            self.shared.stop.store(true, Ordering::Relaxed);
            self.remember(number, Answer::Taken);
        } else if self.commands.is_abandoned() {
            return Err(Why::Ended);
        } else if self.open == PLACES || !self.commands.push(Said { number, stamp, command }) {
            return Err(Why::Full);
        } else {
            self.open += 1;
        }
        self.next += 1;
        Ok(Ticket(number))
    }

    /// Gives a command and forgets it; false if it cannot wait.
    pub fn push(&mut self, command: Command) -> bool {
        self.say(command).is_ok()
    }

    /// What became of a command; none while no cycle has looked at it. Each answer is given once; of more than
    /// [`PLACES`] that nobody asks for the oldest are forgotten.
    pub fn answer(&mut self, ticket: Ticket) -> Option<Answer> {
        let ended = self.commands.is_abandoned();
        self.listen();
        match self.known.iter().position(|(number, _)| *number == ticket.0) {
            Some(at) => self.known.remove(at).map(|(_, answer)| answer),
            None => ended.then_some(Answer::Refused(Why::Ended)),
        }
    }

    /// Gives a command and waits until it is answered: for a thread of its own, never the cycle's.
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

/// Both sides, for a rig of this period.
pub(super) fn commands(period_ns: u64) -> (Operator, Commands) {
    let (commands, said) = queue(PLACES);
    let (answers, answered) = queue(PLACES);
    let shared = Arc::new(Shared::default());
    let known = VecDeque::with_capacity(PLACES);
    let operator =
        Operator { commands, answers: answered, shared: shared.clone(), known, next: 0, open: 0, wall: false };
    (operator, Commands { queue: said, answers, shared, old_ns: OLD_NS.max(2 * period_ns) })
}

impl Commands {
    /// A cycle begins.
    pub fn begin(&mut self, now_ns: u64) {
        self.shared.now_ns.store(now_ns, Ordering::Relaxed);
    }

    /// Whether a stop has been asked for since the last time.
    pub fn takes_stop(&mut self) -> bool {
        self.shared.stop.swap(false, Ordering::Relaxed)
    }

    /// The next command if it is, or is not, a set; what is too old is answered on the way.
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
            self.answer(said.number, Answer::Refused(Why::Old(age_ns)));
        }
        None
    }

    /// Answers a command.
    pub fn answer(&mut self, number: u64, answer: Answer) {
        let told = self.answers.push((number, answer));
        debug_assert!(told, "answers have as many places as commands");
    }
}
