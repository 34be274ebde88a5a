//! The past of what is delayed, in an adaptive run: samples at the ends of steps and on both sides of events, with straight
//! lines between them; before the start, the first.
//!
//! In: x at increasing instants. Out: x(t − T), and its slope, in the slots that functions of the model read.

use abi::description::Delay;
use abi::{Instance, Slot};
use std::collections::VecDeque;

/// Straight lines along a step at most.
const MOST_PIECES: f64 = 512.0;

/// The first instant that looks back at `t` or behind it, `time` seconds later.
fn echo(t: f64, time: f64) -> f64 {
    let mut echo = t + time;
    while echo - time < t {
        echo = echo.next_up();
    }
    echo
}

/// The past of one delay.
struct Line {
    delay: Delay,
    /// T in s.
    time: f64,
    /// (t in s, x in SI); two at one instant where x jumps.
    samples: VecDeque<(f64, f64)>,
}

/// The past of every delay of a model.
pub(crate) struct History {
    lines: Vec<Line>,
}

impl History {
    /// Of an instance that stands at its start, with its outputs in place.
    pub(crate) fn new(instance: &Instance) -> History {
        let line = |delay: &Delay| Line {
            time: instance.get(delay.time),
            samples: VecDeque::from([(0.0, instance.get(delay.source))]),
            delay: delay.clone(),
        };
        History { lines: instance.description().delays.iter().map(line).collect() }
    }

    /// The instants at which the start is seen again, s, ascending: the past before it is constant, so what is delayed bends there.
    pub(crate) fn echoes_of_start(&self) -> Vec<f64> {
        let seen = self.lines.iter().filter(|line| line.time > 0.0).map(|line| echo(0.0, line.time));
        let mut seen: Vec<f64> = seen.collect();
        seen.sort_by(f64::total_cmp);
        seen
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// The longest step that looks at nothing that is not known yet.
    pub(crate) fn longest(&self) -> f64 {
        let least = |line: &Line| if line.delay.weight.is_none() { line.time } else { f64::INFINITY };
        self.lines.iter().map(least).fold(f64::INFINITY, f64::min)
    }

    /// What is delayed, as it is in the block.
    pub(crate) fn present(&self, instance: &Instance) -> Vec<f64> {
        self.lines.iter().map(|line| instance.get(line.delay.source)).collect()
    }

    /// How many straight lines from the newest sample to what is in the block miss the course, which was at `middle`
    /// halfway, by no more than the part `tol` of its size.
    pub(crate) fn pieces(&self, middle: &[f64], instance: &Instance, tol: f64) -> u32 {
        let needed = |(line, middle): (&Line, &f64)| {
            let (start, end) = (line.samples.back().expect("the start is a sample").1, instance.get(line.delay.source));
            let size = start.abs().max(middle.abs()).max(end.abs());
            let bend = (start - 2.0 * middle + end).abs();
            if bend > 0.0 { (0.5 * bend / (tol * size)).sqrt() } else { 1.0 }
        };
        self.lines.iter().zip(middle).map(needed).fold(1.0, f64::max).min(MOST_PIECES).ceil() as u32
    }

    /// Takes the present outputs as samples at `t`; forgets what nobody will ask for. Returns the instants at which what
    /// jumps now is seen again.
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

    /// Puts what was before in place at `t`.
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
                // Behind the newest: on the way to x at this instant.
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
