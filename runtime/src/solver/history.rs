//! The history of delayed quantities in an adaptive run: samples at the ends of steps and on both sides of events,
//! interpolated linearly; constant before the start.
//!
//! In: x at increasing instants. Out: x(t − T) and its slope, in the slots that functions of the model read.

use abi::description::Delay;
use abi::{Instance, Slot};
use std::collections::VecDeque;

/// Most linear pieces along a step.
const MOST_PIECES: f64 = 512.0;

/// The first instant whose delayed time is `t` or later, with a delay of `time` seconds.
fn echo(t: f64, time: f64) -> f64 {
    let mut echo = t + time;
    while echo - time < t {
        echo = echo.next_up();
    }
    echo
}

/// The history of one delay.
struct DelayHistory {
    delay: Delay,
    /// T in s.
    time: f64,
    /// (t in s, x in SI); two at one instant where x jumps.
    samples: VecDeque<(f64, f64)>,
}

/// The history of every delay of a model.
pub(crate) struct History {
    lines: Vec<DelayHistory>,
}

impl History {
    /// The history of an instance at its start, with its outputs computed.
    pub(crate) fn new(instance: &Instance) -> History {
        let line = |delay: &Delay| DelayHistory {
            time: instance.get(delay.time),
            samples: VecDeque::from([(0.0, instance.get(delay.source))]),
            delay: delay.clone(),
        };
        History { lines: instance.description().delays.iter().map(line).collect() }
    }

    /// The instants in s, ascending, at which the start is seen again: the history before it is constant, so the
    /// delayed quantity has a kink there.
    pub(crate) fn echoes_of_start(&self) -> Vec<f64> {
        let seen = self.lines.iter().filter(|line| line.time > 0.0).map(|line| echo(0.0, line.time));
        let mut seen: Vec<f64> = seen.collect();
        seen.sort_by(f64::total_cmp);
        seen
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// The longest step that needs no value that is still unknown.
    pub(crate) fn longest(&self) -> f64 {
        let least = |line: &DelayHistory| if line.delay.weight.is_none() { line.time } else { f64::INFINITY };
        self.lines.iter().map(least).fold(f64::INFINITY, f64::min)
    }

    /// The present values of the quantities that are delayed, from the block.
    pub(crate) fn present(&self, instance: &Instance) -> Vec<f64> {
        self.lines.iter().map(|line| instance.get(line.delay.source)).collect()
    }

    /// The number of linear pieces from the newest sample to the values in the block so that the interpolation error is
    /// at most the fraction `tol` of their size; `middle`: the values halfway.
    pub(crate) fn pieces(&self, middle: &[f64], instance: &Instance, tol: f64) -> u32 {
        let needed = |(line, middle): (&DelayHistory, &f64)| {
            let (start, end) = (line.samples.back().expect("the start is a sample").1, instance.get(line.delay.source));
            let size = start.abs().max(middle.abs()).max(end.abs());
            let bend = (start - 2.0 * middle + end).abs();
            if bend > 0.0 { (0.5 * bend / (tol * size)).sqrt() } else { 1.0 }
        };
        self.lines.iter().zip(middle).map(needed).fold(1.0, f64::max).min(MOST_PIECES).ceil() as u32
    }

    /// Stores the present outputs as samples at `t`; discards samples that are no longer needed. Returns the instants
    /// at which a present jump is seen again.
    pub(crate) fn push(&mut self, t: f64, instance: &Instance) -> Vec<f64> {
        let mut echoes = Vec::new();
        for line in &mut self.lines {
            let sample = (t, instance.get(line.delay.source));
            let last = *line.samples.back().expect("the start is a sample");
            if last != sample && last.0 <= t {
                line.samples.push_back(sample);
                if last.0 == t && line.time > 0.0 {
                    echoes.push(echo(t, line.time));
                }
            }
            while line.samples.get(1).is_some_and(|(second, _)| *second < t - line.time) {
                line.samples.pop_front();
            }
        }
        echoes
    }

    /// Writes the delayed values for time `t` into the block.
    #[inline]
    pub(crate) fn place(&self, t: f64, block: &mut [f64]) {
        for line in &self.lines {
            let asked = t - line.time;
            let after = line.samples.partition_point(|(at, _)| *at <= asked);
            let newest = line.samples.back().expect("the start is a sample");
            let (past, slope, weight) = match (after.checked_sub(1).map(|k| line.samples[k]), line.samples.get(after)) {
                (Some((t0, x0)), Some((t1, x1))) => {
                    let slope = (x1 - x0) / (t1 - t0);
                    (x0 + (asked - t0) * slope, slope, 0.0)
                }
                // Before the start.
                (None, first) => (first.expect("the start is a sample").1, 0.0, 0.0),
                // After the newest sample: interpolate towards x at this instant.
                (Some(_), None) if t > newest.0 => (newest.1, 0.0, (asked - newest.0) / (t - newest.0)),
                (Some(_), None) => (newest.1, 0.0, 0.0),
            };
            let mut put = |slot: Slot, value: f64| block[slot.index()] = value;
            put(line.delay.past, past);
            put(line.delay.slope, slope);
            if let Some(slot) = line.delay.weight {
                put(slot, weight);
            }
        }
    }
}
