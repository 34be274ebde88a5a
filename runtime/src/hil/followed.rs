//! Checks that a drive follows its commands: compares its reading of the commanded quantity with the commands sent to
//! it.
//!
//! In: permitted commands, readings. Out: whether a drive has not followed for too long. Knows neither bus nor model.
//!
//! The method is a reachable-set bound. The commands of the last ticks bound the output of a first-order lag after any
//! dead time up to that of the drive: the output stays between two envelopes. Each envelope is the extreme command of
//! the window, or the previous envelope after it has decayed towards that command:
//!
//!   high(k) = max(u, high(k−1) + s·(u − high(k−1)))     u = greatest command of the window
//!   s       = T / (T + τ)  ≤  1 − e^(−T/τ)              never faster than the lag itself
//!
//! No command explains a reading that lies outside of the envelopes by more than a tolerance.

use super::watches;
use crate::drive::profiles;
use crate::safety::{OutputLimits, Protection, is_present};
use abi::rig::{Kind, Mode, Rig, SignalKind};

/// Dead time beyond that of the drive for which a command may be under way, s: a late cycle, a busy bus.
const SLACK: f64 = 1e-3;
/// Assumed dead time and lag of a drive while these are being identified, s.
const UNKNOWN: f64 = 20e-3;
/// Factor by which the lag of a drive may exceed that of the rig's text.
const SLOWER: f64 = 1.5;
/// Tolerance of a torque, as a share of the rated torque: offset and noise of a drive's own measurement.
const TORQUE_PART: f64 = 0.03;
/// Unbroken number of ticks outside of the envelopes after which a torque is not followed.
const TORQUE_TICKS: u32 = 5;
/// Time constant allowed for a speed or position controller, s, and the time allowed for a large step, ns: the response
/// of a drive and its load to a set-point is not part of a rig's text.
const LOOP: f64 = 0.1;
const LOOP_NS: u64 = 1_000_000_000;
/// Tolerance of a speed or a position, as a share of half the range of its command.
const LOOP_PART: f64 = 0.1;
/// Longest time for which a command may be under way, s: every cycle scans the whole window.
const MOST_DEAD: f64 = 0.25;
/// Most ticks by which an envelope is advanced at once: after so many it has decayed, whatever the lag.
const MOST_TICKS: u32 = 1000;

/// State of the check of one drive.
pub struct Followed {
    /// Index of the drive's node.
    pub node: usize,
    /// Index of its command among the outputs.
    pub output: usize,
    /// Index of its answer among the signals.
    pub signal: usize,
    /// Whether it is also checked during the start-up.
    early: bool,
    /// Ring buffer of the last commands, and the index for the next one.
    window: Vec<f64>,
    at: usize,
    /// Share by which an envelope decays in one tick.
    share: f64,
    low: f64,
    high: f64,
    tolerance: f64,
    patience: u32,
    /// Unbroken number of ticks outside of the envelopes.
    outside: u32,
}

impl Followed {
    /// The check of an output whose answer has this index among the signals. `measures`: dead time and lag are not
    /// known yet. None if the drive reports no such quantity.
    pub fn new(rig: &Rig, output: usize, signal: usize, limits: &OutputLimits, measures: bool) -> Option<Followed> {
        let (commanded, at) = (rig.outputs[output].signal, watches::answer(rig, &rig.outputs[output])?);
        let node = &rig.nodes[at.node];
        let asked = node.asks_for(commanded.what)?;
        let period = rig.period_ns as f64 * 1e-9;
        let torque = asked == SignalKind::Torque;
        let half = 0.5 * (limits.high - limits.low);
        let (tolerance, late) = match &node.kind {
            Kind::Cia402(drive) => {
                let profile = profiles::find(&drive.profile)?;
                let unit = drive.rated_torque / profile.full_torque as f64;
                let tolerance = match drive.mode {
                    Mode::Torque => TORQUE_PART * drive.rated_torque + 2.0 * unit,
                    Mode::Speed => LOOP_PART * half + 4.0 * drive.speed_unit,
                    Mode::Position => LOOP_PART * half + 4.0 * drive.count,
                };
                // A drive with a time grid of its own accepts a command up to one grid period late, and reports up to
                // one grid period late; a drive that waits for SYNC accepts it with the next one.
                let waits = if drive.at_sync { period } else { 0.0 };
                (tolerance, waits + 2.0 * profile.refresh_ns as f64 * 1e-9)
            }
            Kind::Frames(messages) => {
                let SignalKind::Field(message, field) = at.what else { return None };
                let message = &messages[message];
                // Its reading may be as old as the interval between its frames.
                let apart_ns = if message.period_ns > 0 { message.period_ns } else { node.timeout_ns };
                (LOOP_PART * half + 4.0 * message.fields[field].scale.abs(), apart_ns as f64 * 1e-9)
            }
        };
        let unknown = if measures { UNKNOWN } else { 0.0 };
        let dead = (node.delay + SLACK + late + unknown).min(MOST_DEAD);
        let lag = SLOWER * node.lag + if torque { unknown } else { LOOP };
        let patience = if torque { TORQUE_TICKS } else { ticks(LOOP_NS, rig.period_ns) };
        Some(Followed {
            node: at.node,
            output,
            signal,
            early: torque,
            window: vec![0.0; (dead / period) as usize + 2],
            at: 0,
            share: period / (period + lag),
            low: 0.0,
            high: 0.0,
            tolerance,
            patience,
            outside: 0,
        })
    }

    /// The same check, but with a patience of at least this many ticks.
    pub fn patient(self, least: u32) -> Followed {
        Followed { patience: self.patience.max(least), ..self }
    }

    /// Whether it is also checked while the start-up requests the outputs.
    pub fn is_early(&self) -> bool {
        self.early
    }

    /// Resets the check while nothing is commanded: `told` is the reading, `idle` the value sent.
    pub fn rest(&mut self, told: f64, idle: f64) {
        self.window.fill(idle);
        (self.low, self.high, self.outside) = (told.min(idle), told.max(idle), 0);
    }

    /// Advances by `ticks` with the command `sent`. Returns true if the reading of this tick, where there is one, has
    /// been outside of the envelopes for too long.
    pub fn judge(&mut self, ticks: u32, sent: f64, told: Option<f64>) -> bool {
        for _ in 0..ticks.min(MOST_TICKS) {
            self.window[self.at] = sent;
            self.at = if self.at + 1 == self.window.len() { 0 } else { self.at + 1 };
            let (mut least, mut greatest) = (sent, sent);
            for command in &self.window {
                least = least.min(*command);
                greatest = greatest.max(*command);
            }
            self.low = least.min(self.low + (least - self.low) * self.share);
            self.high = greatest.max(self.high + (greatest - self.high) * self.share);
        }
        let Some(told) = told else { return false };
        let follows = self.low - self.tolerance <= told && told <= self.high + self.tolerance;
        self.outside = if follows { 0 } else { self.outside.saturating_add(1) };
        let watches = if self.early { Protection::Followed } else { Protection::Loop };
        self.outside >= self.patience && is_present(Protection::Followed) && is_present(watches)
    }

    /// Appends the complete state as words, from which [`Followed::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.extend(self.window.iter().chain([&self.low, &self.high]).map(|x| x.to_bits()));
        words.extend([self.at as u64, self.outside.into()]);
    }

    /// Restores the state that [`Followed::save`] wrote. None if it does not fit.
    pub fn restore(&mut self, words: &mut impl Iterator<Item = u64>) -> Option<()> {
        for x in self.window.iter_mut().chain([&mut self.low, &mut self.high]) {
            *x = f64::from_bits(words.next()?);
        }
        self.at = usize::try_from(words.next()?).ok().filter(|at| *at < self.window.len())?;
        self.outside = u32::try_from(words.next()?).ok()?;
        Some(())
    }
}

fn ticks(ns: u64, period_ns: u64) -> u32 {
    u32::try_from(ns.div_ceil(period_ns)).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;
    use crate::testing::rigs;

    fn watch(delay: f64, lag: f64) -> Followed {
        let (mut rig, _) = rigs::rig();
        (rig.nodes[0].delay, rig.nodes[0].lag) = (delay, lag);
        let limits =
            OutputLimits { low: -1.0, high: 1.0, slew: f64::INFINITY, safe: 0.0, drive: Some(0), torque: true };
        Followed::new(&rig, 0, 0, &limits, false).unwrap()
    }

    /// Simulates a drive that receives the commands until tick `lost` and keeps the last one from then on. Each command
    /// acts after the dead time (ms), through a lag (ms); the torque is reported in steps of 4 mN·m in each tick.
    /// Returns the tick in which the check trips, and the first tick of the interval in which the reading differs from
    /// the command by more than 0.3 N·m.
    fn run(
        watch: &mut Followed,
        (dead, lag): (f64, f64),
        mut command: impl FnMut(u32) -> f64,
        lost: u32,
    ) -> (Option<u32>, Option<u32>) {
        let (mut got, mut sent, mut torque, mut apart) = (Vec::new(), 0.0f64, 0.0, None);
        watch.rest(0.0, 0.0);
        for k in 0..400u32 {
            for part in 0..50 {
                let act = f64::from(k) - 1.0 + f64::from(part) / 50.0 - dead;
                let acts: f64 = if act < 0.0 { 0.0 } else { got.get(act as usize).copied().unwrap_or(sent) };
                torque = if lag > 0.0 { torque + (acts - torque) * (0.02 / (lag + 0.02)) } else { acts };
            }
            let told = (torque / 4e-3).round() * 4e-3;
            apart = if (told - sent).abs() > 0.3 { apart.or(Some(k)) } else { None };
            if watch.judge(u32::from(k > 0), sent, Some(told)) {
                return (Some(k), apart);
            }
            sent = command(k);
            got.push(if k < lost { sent } else { got.last().copied().unwrap_or(0.0) });
        }
        (None, apart)
    }

    /// A random sequence of commands, all held for the same random number of ticks.
    fn steps(mut random: Chance) -> impl FnMut(u32) -> f64 {
        let (every, mut held) = (1 + random.below(20) as u32, 0.0);
        move |k| {
            if k.is_multiple_of(every) {
                held = random.between(-1.0, 1.0);
            }
            held
        }
    }

    #[test]
    fn dead_times_and_lags_up_to_the_declared_ones_count_as_following() {
        for seed in 0..300 {
            let mut random = Chance(seed);
            let text = (random.between(0.0, 6.0), random.between(0.0, 5.0));
            let is = (random.between(0.0, text.0 + 0.99), random.between(0.0, 1.5 * text.1));
            let found = run(&mut watch(text.0 * 1e-3, text.1 * 1e-3), is, steps(random), u32::MAX).0;
            assert_eq!(found, None, "seed {seed}: {text:?} ms in the text, {is:?} ms in truth");
        }
    }

    #[test]
    fn a_drive_that_keeps_an_old_torque_is_detected_in_time() {
        let mut found = 0;
        for seed in 0..300 {
            let mut random = Chance(seed);
            let (dead, lag) = (random.between(0.0, 6.0), random.between(0.0, 3.0));
            let lost = 100 + random.below(100) as u32;
            // The drive keeps its value while the command moves to one end of the range.
            let end = if random.below(2) == 0 { -1.0 } else { 1.0 };
            let mut before = steps(random);
            let command = |k: u32| if k < lost { before(k) } else { end };
            let (tripped, apart) = run(&mut watch(dead * 1e-3, lag * 1e-3), (dead, lag), command, lost);
            let Some(apart) = apart else { continue };
            found += 1;
            let within = (dead + 8.0 * lag + 1.0) as u32 + 2 + TORQUE_TICKS;
            let tripped = tripped.unwrap_or_else(|| panic!("seed {seed}: never, apart since {apart}"));
            assert!(tripped <= apart.max(lost) + within, "seed {seed}: {tripped}, apart since {apart}, lost at {lost}");
        }
        assert!(found > 200, "{found} cases");
    }

    #[test]
    fn what_is_saved_goes_on_as_before() {
        let (mut first, mut second) = (watch(0.8e-3, 0.6e-3), watch(0.8e-3, 0.6e-3));
        for k in 0..40 {
            let mut words = Vec::new();
            first.save(&mut words);
            assert_eq!(second.restore(&mut words.iter().copied()), Some(()));
            assert_eq!(watch(0.8e-3, 0.6e-3).restore(&mut words[1..].iter().copied()), None);
            let (sent, told) = (f64::from(k % 7) * 0.1, f64::from(k % 11) * 0.1);
            assert_eq!(first.judge(1, sent, Some(told)), second.judge(1, sent, Some(told)), "tick {k}");
            assert_eq!((first.low, first.high, first.outside), (second.low, second.high, second.outside));
        }
    }
}
