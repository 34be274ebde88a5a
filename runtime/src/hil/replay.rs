//! Replay of a log: passes the same readings through the same code and compares every output to the bit.
//!
//! In: the messages of a log, and the rig's programs, compiled again. Out: the number of cycles that agree, or the
//! first cycle and number that differ. Knows neither bus nor clock.

use super::control::{Control, CycleInputs};
use super::trace::{self, Cycle, Shape};
use crate::record::log::{LOST, Message};
use abi::rig::Rig;
use abi::{Instance, Slot};

/// Result of a replay.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Replayed {
    /// Cycles computed and compared.
    pub cycles: u64,
    /// States compared.
    pub states: u64,
    /// Cycles that could not be computed, because the log lacks the cycles before them.
    pub skipped: u64,
    /// Messages that were lost when the log was written.
    pub lost: u64,
}

/// The first number that differs.
#[derive(Clone, PartialEq, Debug)]
pub struct Difference {
    /// Number of the cycle.
    pub k: u64,
    /// The number that differs.
    pub what: What,
    /// Recorded value.
    pub recorded: f64,
    /// Computed value.
    pub computed: f64,
}

/// A number of a cycle.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum What {
    /// The request for this output.
    Request(usize),
    /// The permitted value of this output.
    Permitted(usize),
    /// The clamps of this output, as bits.
    Clamps(usize),
    /// The drive command, as a number.
    Order,
    /// This recorded quantity.
    Recorded(usize),
    /// The state of model and safety, compared by its hash.
    State,
}

/// Reason for an early end of a replay.
#[derive(Clone, PartialEq, Debug)]
pub enum Stopped {
    /// A number differs.
    Differs(Difference),
    /// A message does not belong to this rig.
    Unreadable {
        /// The cycle that was due.
        k: u64,
    },
}

/// A running replay.
pub struct Replay<'a> {
    rig: &'a Rig,
    control: Control,
    shape: Shape,
    /// The next cycle; none while an earlier one is missing.
    next: Option<u64>,
    found: Replayed,
    words: Vec<u64>,
}

impl<'a> Replay<'a> {
    /// Begins at cycle 0, in the state of `control`.
    pub fn new(rig: &'a Rig, control: Control) -> Replay<'a> {
        let shape = Shape::of(rig, &control);
        Replay { rig, control, shape, next: Some(0), found: Replayed::default(), words: Vec::new() }
    }

    /// Processes a message.
    ///
    /// # Errors
    /// The first number that differs, or a message that does not belong to this rig.
    pub fn message(&mut self, message: &Message) -> Result<(), Stopped> {
        match message.kind {
            LOST => {
                self.found.lost += message.words.first().copied().unwrap_or(1);
                self.next = None;
                Ok(())
            }
            trace::STATE => self.state(&message.words),
            trace::CYCLE => self.cycle(&message.words),
            _ => Ok(()),
        }
    }

    /// Time of the model after the last cycle, in s; none before it runs, and where it is not known.
    pub fn model_time(&self) -> Option<f64> {
        self.next?;
        let model = self.control.model();
        let steps = model.get(Slot::COUNT);
        (steps > 0.0).then(|| steps * model.get(Slot::STEP))
    }

    /// The program whose parameters change.
    pub fn model(&self) -> &Instance {
        self.control.model()
    }

    /// The result so far.
    pub fn found(&self) -> &Replayed {
        &self.found
    }

    fn state(&mut self, words: &[u64]) -> Result<(), Stopped> {
        let unreadable = Stopped::Unreadable { k: words.first().copied().unwrap_or(0) };
        let [k, hash, state @ ..] = words else { return Err(unreadable) };
        if trace::hash(state) != *hash {
            return Err(unreadable);
        }
        if self.next == Some(*k) {
            self.words.clear();
            self.control.save(&mut self.words);
            let at = self.words.iter().zip(state).position(|(a, b)| a != b);
            if let Some(at) = at.or_else(|| (self.words.len() != state.len()).then_some(0)) {
                let (recorded, computed) = (f64::from_bits(state[at]), f64::from_bits(self.words[at]));
                return Err(Stopped::Differs(Difference { k: *k, what: What::State, recorded, computed }));
            }
            self.found.states += 1;
        } else {
            self.control.restore(state).ok_or(unreadable)?;
            self.next = Some(*k);
        }
        Ok(())
    }

    fn cycle(&mut self, words: &[u64]) -> Result<(), Stopped> {
        let unreadable = Stopped::Unreadable { k: words.first().copied().unwrap_or(0) };
        let recorded = Cycle::read(self.shape, words).ok_or(unreadable)?;
        if self.next != Some(recorded.k) {
            self.next = None;
            self.found.skipped += 1;
            return Ok(());
        }
        if recorded.arms {
            self.control.supervisor_mut().arm();
        }
        let order = self.control.cycle(&CycleInputs {
            ticks: recorded.ticks,
            late_ns: trace::within_tick(recorded.late_ns, recorded.ticks, self.rig.period_ns),
            readings: &recorded.readings,
            source: recorded.source,
            wanted: &recorded.wanted,
            causes: &recorded.causes,
            set: &recorded.set,
        });
        self.next = Some(recorded.k + 1);
        self.found.cycles += 1;
        let difference = self.first_difference(&recorded, order);
        difference.map_or(Ok(()), |difference| Err(Stopped::Differs(difference)))
    }

    fn first_difference(&self, recorded: &Cycle, order: crate::safety::DriveCommand) -> Option<Difference> {
        let k = recorded.k;
        let supervisor = self.control.supervisor();
        let differ = |what: fn(usize) -> What, old: &[f64], new: &[f64]| {
            let at = old.iter().zip(new).position(|(old, new)| old.to_bits() != new.to_bits())?;
            Some(Difference { k, what: what(at), recorded: old[at], computed: new[at] })
        };
        let clamps = || {
            let at = recorded.clamps.iter().zip(supervisor.clamps()).position(|(old, new)| old != new)?;
            let (old, new) = (recorded.clamps[at], supervisor.clamps()[at]);
            Some(Difference { k, what: What::Clamps(at), recorded: f64::from(old.0), computed: f64::from(new.0) })
        };
        let orders = || {
            let [old, new] = [recorded.order, order].map(|order| trace::order_number(order) as f64);
            (old != new).then_some(Difference { k, what: What::Order, recorded: old, computed: new })
        };
        let series = || {
            let model = self.control.model();
            let at = (self.rig.record.iter().zip(&recorded.recorded))
                .position(|(series, old)| model.get(series.slot).to_bits() != old.to_bits())?;
            let computed = model.get(self.rig.record[at].slot);
            Some(Difference { k, what: What::Recorded(at), recorded: recorded.recorded[at], computed })
        };
        differ(What::Request, &recorded.requests, self.control.requests())
            .or_else(|| differ(What::Permitted, &recorded.permitted, supervisor.permitted()))
            .or_else(clamps)
            .or_else(orders)
            .or_else(series)
    }
}
