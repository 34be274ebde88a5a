//! One run of a rig: what each program that runs rigs sets up around the [cycle](super::cycle).
//!
//! In: a rig, its programs, a clock and buses. Out: a cycle on a real-time thread with its watchdog, and after its end
//! the closed log. Knows neither arguments nor the terminal: its messages are returned.

use super::coupling::look_ahead;
use super::cycle::{End, Hil, Options};
use super::emergency::{self, Watchdog};
use super::live::Judge;
use super::operator::Operator;
use super::simulated::{MASTER, Pace, holds_and_pushes};
use super::words;
use crate::can::address::Address;
use crate::can::sim::Simulation;
use crate::can::{self, Bus};
use crate::drive::polarity_check::SignTest;
use crate::realtime::clock::Clock;
use crate::realtime::threads::{self, RealTime, RefusedWish, Wishes};
use crate::record::log::{Sections, Settings, Sink, Summary};
use abi::Instance;
use abi::rig::Rig;
use std::io;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Most time of a recording that is lost when its process is killed, ns.
const BLOCK_NS: u64 = 100_000_000;
/// Share of late answers that simulated drives may have, because the delays inside one process prove nothing about
/// drives.
const MISSED_SIMULATED: f64 = 0.05;

/// The drives of a run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Drives {
    /// Drives on the rig's buses.
    Real,
    /// Drives simulated within the process.
    Simulated(Pace),
}

impl Drives {
    /// The drives of a rig: simulated ones if that is asked for, or if all its buses are. `fast`: in simulated time,
    /// which real drives do not have.
    pub fn of(rig: &Rig, simulated: bool, fast: bool) -> Drives {
        match simulated || rig.buses.iter().all(|bus| bus.address.starts_with("sim:")) {
            false => Drives::Real,
            true if fast => Drives::Simulated(Pace::Fast),
            true => Drives::Simulated(Pace::Wall),
        }
    }

    /// Whether no drive is real.
    pub fn are_simulated(self) -> bool {
        self != Drives::Real
    }

    /// Whether time is simulated.
    pub fn is_fast(self) -> bool {
        self == Drives::Simulated(Pace::Fast)
    }
}

/// Gives buses of a rig other addresses: pairs of name and address.
///
/// # Errors
/// A message that names a bus that the rig does not have.
pub fn readdress(rig: &mut Rig, buses: &[(String, String)]) -> Result<(), String> {
    for (bus, address) in buses {
        let Some(known) = rig.buses.iter_mut().find(|known| known.name == *bus) else {
            let names: Vec<&str> = rig.buses.iter().map(|bus| bus.name.as_str()).collect();
            return Err(format!("rig `{}` has no bus `{bus}`; it has {}", rig.name, names.join(", ")));
        };
        known.address.clone_from(address);
    }
    Ok(())
}

/// Opens the buses of a rig on this computer. `time`: for addresses of simulated buses.
///
/// # Errors
/// A message that names the first bus that cannot be opened, with the reason and a remedy.
pub fn buses(rig: &Rig, time: &Simulation) -> Result<Vec<Box<dyn Bus>>, String> {
    let open = |bus: &abi::rig::Bus| {
        let options = can::Options { bit_rate: Some(bus.bit_rate).filter(|rate| *rate > 0), ..can::Options::default() };
        let address = bus.address.parse::<Address>().map_err(|why| why.to_string());
        address
            .and_then(|address| can::open(&address, &options, time, MASTER).map_err(|why| why.to_string()))
            .map_err(|why| format!("bus `{}`: {why}\n  --bus {}=ADDRESS selects another one", bus.name, bus.name))
    };
    rig.buses.iter().map(open).collect()
}

/// Options of a run with these drives, with the predictor that the rig requires. `plant`: the program of the part that
/// hardware replaces.
///
/// # Errors
/// A message about what the predictor lacks.
pub fn options(rig: &Rig, plant: &Instance, drives: Drives) -> Result<Options, String> {
    let simulated = drives.are_simulated();
    let mut options = Options { arms_itself: simulated, look: look_ahead(rig, plant)?, ..Options::default() };
    options.start.simulated = simulated;
    options.start.missed = if simulated { MISSED_SIMULATED } else { 0.0 };
    if simulated && holds_and_pushes(rig) {
        // A drive that holds its speed would prevent another one from turning the shaft.
        options.start.sign_test = SignTest::Skip;
    }
    options.control.needs_look = rig.needs_look;
    Ok(options)
}

/// Number of blocks of a log that cover this time.
pub fn blocks(ns: u64) -> usize {
    usize::try_from(ns / BLOCK_NS).unwrap_or(usize::MAX)
}

/// Settings of the log of a rig. In simulated time it may block the cycle, and so drops nothing.
pub fn log_settings(rig: &Rig, sink: Sink, drives: Drives) -> Settings {
    let cycles_per_block = u32::try_from((BLOCK_NS / rig.period_ns).max(1)).unwrap_or(u32::MAX);
    Settings { sink, cycles_per_block, patient: drives.is_fast() }
}

/// The start time for the head of a log; empty in simulated time, so that equal runs have equal logs.
pub fn started(drives: Drives) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    match drives.is_fast() {
        true => String::new(),
        false => format!("{}.{:09} s since 1970", now.as_secs(), now.subsec_nanos()),
    }
}

/// A run before its start.
pub struct Setup<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// Its control program.
    pub control: Instance,
    /// Its drives.
    pub drives: Drives,
    /// Options of the cycle, begun with [`options`].
    pub options: Options,
    /// Destination and head of the log.
    pub log: Option<(Settings, Sections)>,
    /// Decides which parameters may change during the run; none: none may.
    pub judge: Option<Judge>,
    /// The reason for which real drives are refused if the computer does not grant a real-time thread.
    pub needs_real_time: &'a str,
}

/// A rig that is ready to run. Its thread has been set up for real time, unless time is simulated.
pub struct Session {
    /// The cycle.
    pub hil: Hil,
    operator: Option<Operator>,
    real_time: Option<RealTime>,
}

impl Session {
    /// Sets up the calling thread, which must run the cycles, and the watchdog.
    ///
    /// # Errors
    /// A message about a requirement of the rig that cannot be met.
    pub fn start(setup: Setup, clock: Box<dyn Clock>, buses: Vec<Box<dyn Bus>>) -> Result<Session, String> {
        let Setup { rig, control, drives, mut options, log, judge, needs_real_time } = setup;
        let real_time = (!drives.is_fast()).then(|| threads::enter(&Wishes::of_cycle()));
        let refused = real_time.as_ref().is_some_and(|real_time| !real_time.refused().is_empty());
        if !drives.are_simulated() && refused && options.only_simulated.is_none() {
            options.only_simulated = Some(needs_real_time.into());
        }
        let (mut hil, operator) = Hil::new(rig, control, clock, buses, options, log)?;
        if let Some(judge) = judge {
            hil.judged_by(judge);
        }
        if !drives.is_fast() {
            let watchdog = Watchdog::new(Duration::from_nanos(rig.watchdog_ns), emergency::send);
            hil.watched_by(watchdog.map_err(|error| format!("no watchdog: {error}"))?);
            hil.prepare_emergency();
        }
        Ok(Session { hil, operator: Some(operator), real_time })
    }

    /// What the computer did not grant the thread.
    pub fn refused(&self) -> &[RefusedWish] {
        self.real_time.as_ref().map_or(&[], RealTime::refused)
    }

    /// The sender of operator commands, which may go to another thread; `None` at the second call.
    pub fn operator(&mut self) -> Option<Operator> {
        self.operator.take()
    }

    /// Runs cycles until the model has run for the first time, or the run has ended.
    pub fn run_to_model(&mut self) {
        while self.hil.ended().is_none() && self.hil.counts().cycles == 0 {
            self.hil.cycle();
        }
    }

    /// Runs cycles until the run has ended, then leaves real time.
    pub fn run(&mut self) -> End {
        let end = self.hil.ended().cloned().unwrap_or_else(|| self.hil.run());
        self.real_time = None;
        end
    }

    /// Closes the log.
    pub fn finish(self) -> Finished {
        Finished {
            counts: words::counts(self.hil.counts()),
            missed: self.hil.counts().missed,
            misuse: self.hil.is_misuse(),
            has_started: self.hil.has_started(),
            log: self.hil.finish(),
        }
    }
}

/// What remains of a run.
pub struct Finished {
    /// Its counters as text, one line per group.
    pub counts: String,
    /// Number of missed ticks.
    pub missed: u64,
    /// The start was refused because an option is for simulated drives only.
    pub misuse: bool,
    /// The rig has passed the checks of its start-up and waited for its operator.
    pub has_started: bool,
    /// Its log; none if there was nothing to record.
    pub log: io::Result<Option<Summary>>,
}

/// Why `--fast` needs an end: the message of both programs.
pub const FAST_WITHOUT_END: &str = "--fast needs --for TIME: simulated time has no operator who would end the run";
