//! Latency test: how late this machine wakes a loop, and whether that suits a rig.
//!
//! In: a period and a number of cycles. Out: histograms and counts, and an assessment. The loop is that of a rig
//! without its model: SYNC, a drive's answer, a set-point, on a simulated bus in real time.

use crate::can::sim::{Actor, Port, Simulation};
use crate::can::{Bus, Frame, Received};
use crate::realtime::clock::Clock;
use crate::realtime::histogram::Histogram;
use crate::realtime::threads::{self, RefusedWish, Wishes};

/// Results of a run.
pub struct Report {
    /// Period of a cycle, ns.
    pub period_ns: u64,
    /// Number of cycles.
    pub cycles: u64,
    /// Delay of the start of each cycle after its tick.
    pub lateness: Histogram,
    /// Time to read received frames.
    pub receive: Histogram,
    /// Time to send SYNC and set-point.
    pub transmit: Histogram,
    /// Time from SYNC to its answer.
    pub answer: Histogram,
    /// Cycles without an answer by 0.45 of their period.
    pub missed: u64,
    /// Cycles that lasted into the next one.
    pub overruns: u64,
    /// Page faults during the run.
    pub page_faults: u64,
    /// Wishes that the system refused.
    pub refused: Vec<RefusedWish>,
}

/// Assessment of a machine.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Fit {
    /// Lateness below a twentieth of the period.
    Fit,
    /// Lateness below a fifth: suits drives whose commands act on the next SYNC, because it does not affect them.
    AtSync,
    /// Neither.
    NotForTorque,
}

impl Report {
    /// The assessment of this run.
    pub fn fit(&self) -> Fit {
        if self.overruns > 0 { Fit::NotForTorque } else { Fit::of(self.lateness.max_ns(), self.period_ns) }
    }
}

impl Fit {
    /// The assessment of a loop without overruns, by its greatest lateness.
    pub fn of(late_ns_max: u64, period_ns: u64) -> Fit {
        match late_ns_max {
            late if late < period_ns / 20 => Fit::Fit,
            late if late < period_ns / 5 => Fit::AtSync,
            _ => Fit::NotForTorque,
        }
    }
}

/// Runs the loop for the given number of cycles, or until `stop` returns true.
pub fn run(period_ns: u64, cycles: u64, wishes: &Wishes, stop: impl Fn() -> bool) -> Report {
    let world = Simulation::real_time();
    let clock = world.monotonic().expect("this world's time is real");
    let bus = world.bus("bench", 1_000_000);
    let mut port = bus.port("master");
    world.attend(Box::new(Echo { port: bus.port("drive") }));
    let mut report = Report {
        period_ns,
        cycles: 0,
        lateness: Histogram::new(),
        receive: Histogram::new(),
        transmit: Histogram::new(),
        answer: Histogram::new(),
        missed: 0,
        overruns: 0,
        page_faults: 0,
        refused: Vec::new(),
    };
    let real_time = threads::enter(wishes);
    let before = threads::interruptions();
    let origin_ns = clock.now_ns() + period_ns;
    let mut k = 0;
    while report.cycles < cycles && !stop() {
        let due_ns = origin_ns + k * period_ns;
        clock.sleep_until(due_ns);
        let begin_ns = clock.now_ns();
        report.lateness.count(begin_ns - due_ns);
        let _ = port.send(Frame::new(0x080, &[]));
        let mut transmit_ns = clock.now_ns() - begin_ns;

        let mut answered = false;
        while !answered && port.wait(due_ns + period_ns * 9 / 20) {
            let read_ns = clock.now_ns();
            while let Some(received) = port.receive() {
                answered |= matches!(received, Received::Frame(..));
            }
            report.receive.count(clock.now_ns() - read_ns);
        }
        let answer_ns = clock.now_ns();
        if answered {
            report.answer.count(answer_ns - begin_ns);
        }
        report.missed += u64::from(!answered);
        let _ = port.send(Frame::new(0x201, &[0x0F, 0, 0, 0]));
        let end_ns = clock.now_ns();
        transmit_ns += end_ns - answer_ns;
        report.transmit.count(transmit_ns);
        report.cycles += 1;
        // The phase is kept: whole periods are skipped.
        let late = end_ns.saturating_sub(due_ns) / period_ns;
        report.overruns += u64::from(late > 0);
        k += 1 + late;
    }
    report.page_faults = threads::interruptions().page_faults - before.page_faults;
    report.refused = real_time.refused().to_vec();
    report
}

/// A drive that answers SYNC at once.
struct Echo {
    port: Port,
}

impl Actor for Echo {
    fn act(&mut self, _now_ns: u64) -> u64 {
        while let Some(received) = self.port.receive() {
            if matches!(received, Received::Frame(frame, _) if frame.id() == 0x080) {
                let _ = self.port.send(Frame::new(0x181, &[0x27, 0x06, 0, 0, 0, 0, 0, 0]));
            }
        }
        u64::MAX
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn late(ns: u64) -> Report {
        let mut report = run(1_000_000, 0, &Wishes { memory: false, awake: false, ..Wishes::default() }, || false);
        report.lateness.count(ns);
        report
    }

    #[test]
    fn the_assessment_depends_on_the_latest_cycle() {
        assert_eq!(late(49_000).fit(), Fit::Fit);
        assert_eq!(late(51_000).fit(), Fit::AtSync);
        assert_eq!(late(201_000).fit(), Fit::NotForTorque);
        assert_eq!(Report { overruns: 1, ..late(10) }.fit(), Fit::NotForTorque);
    }

    #[test]
    fn the_loop_counts_its_cycles() {
        // Times are not checked, because the test machine may be busy.
        let report = run(2_000_000, 20, &Wishes { memory: false, awake: false, ..Wishes::default() }, || false);
        assert_eq!((report.cycles, report.lateness.total(), report.transmit.total()), (20, 20, 20));
        assert_eq!(report.answer.total() + report.missed, 20);
        assert_eq!(run(1_000_000, 20, &Wishes { memory: false, ..Wishes::default() }, || true).cycles, 0);
    }
}
