//! How fast a drive is and what it turns, measured: steps of torque, forth and back.
//!
//! In: once a tick what the drive tells, and when its last command went out. Out: the command wanted, then delay, lag
//! and moment of inertia. A step is A, −A, 0 of equal lengths, so that the shaft ends at rest; the mean over both
//! directions takes friction out of the inertia.

use super::sign::Sample;
use super::trouble::Why;

/// Length of each half of a push, s.
const HALF: f64 = 0.04;
/// Rest between pushes, s.
const REST: f64 = 0.12;
/// Pushes.
const PUSHES: u32 = 12;
/// Answers behind a step that are looked at.
const WINDOW: usize = 24;

/// What a drive and its shaft were measured to be.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Identified {
    /// From a command leaving us to the first effect on the torque, s.
    pub delay: f64,
    /// Time constant of the torque, s; none if it is shorter than the answers can show.
    pub lag: Option<f64>,
    /// Of all that turns, kg·m²; none if nothing turned.
    pub inertia: Option<f64>,
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Part {
    Rest,
    Forth,
    Back,
}

/// One measurement.
#[derive(Clone, Debug)]
pub struct Steps {
    amplitude: f64,
    angle_most: f64,
    speed_most: f64,
    part: Part,
    /// Time in this part, s.
    t: f64,
    done: u32,
    command: f64,
    before: f64,
    /// When the present command went out.
    sent_ns: Option<u64>,
    start: Option<f64>,
    /// Sums of the fit ln(1 − r) = −(t − delay) / lag over all steps, weighted: w, w t, w t², w y, w t y.
    sums: [f64; 5],
    /// Earliest time at which an effect was seen, and the latest at which none was, s.
    seen: f64,
    unseen: f64,
    window: usize,
    /// Sums of the line through the speeds of a half: n, t, t², v, t v; and the slopes of both directions.
    line: [f64; 5],
    slopes: [(f64, u32); 2],
}

/// How far it is.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Progress {
    /// Goes on: the command wanted, N·m.
    Wants(f64),
    /// Done.
    Done(Identified),
    /// It must not go on.
    Wrong(Why),
}

impl Steps {
    /// Steps of this torque (N·m) that stop where the shaft turns further (rad) or faster (rad/s).
    pub fn new(amplitude: f64, angle_most: f64, speed_most: f64) -> Steps {
        Steps {
            amplitude,
            angle_most,
            speed_most,
            part: Part::Rest,
            t: 0.0,
            done: 0,
            command: 0.0,
            before: 0.0,
            sent_ns: None,
            start: None,
            sums: [0.0; 5],
            seen: f64::INFINITY,
            unseen: 0.0,
            window: WINDOW,
            line: [0.0; 5],
            slopes: [(0.0, 0); 2],
        }
    }

    /// One tick of `dt` seconds. `sampled_ns`: when the drive sampled what it tells; `sent_ns`: when the command of the
    /// last tick went out.
    pub fn tick(&mut self, sample: Sample, sampled_ns: u64, sent_ns: u64, dt: f64) -> Progress {
        let start = *self.start.get_or_insert(sample.position);
        let turned = sample.position - start;
        let speed = sample.speed.unwrap_or(0.0);
        if turned.abs() > self.angle_most || speed.abs() > self.speed_most {
            return Progress::Wrong(Why::Ran(turned, speed));
        }
        if self.window == 0 && self.sent_ns.is_none() {
            self.sent_ns = Some(sent_ns);
        }
        if let (Some(sent_ns), Some(torque)) = (self.sent_ns, sample.torque)
            && self.window < WINDOW
            && sampled_ns > sent_ns
        {
            self.window += 1;
            self.take_torque((sampled_ns - sent_ns) as f64 * 1e-9, torque);
        }
        // The first quarter of a half is the torque's rise.
        if self.part != Part::Rest && self.t > HALF / 4.0 {
            for (sum, term) in self.line.iter_mut().zip([1.0, self.t, self.t * self.t, speed, self.t * speed]) {
                *sum += term;
            }
        }
        self.t += dt;
        let length = if self.part == Part::Rest { REST } else { HALF };
        if self.t >= length - dt / 2.0 {
            self.take_line();
            self.t = 0.0;
            self.part = match self.part {
                Part::Rest if self.done == PUSHES => return Progress::Done(self.result()),
                Part::Rest => Part::Forth,
                Part::Forth => Part::Back,
                Part::Back => {
                    self.done += 1;
                    Part::Rest
                }
            };
            // The first way of every other push is the other way.
            let sign = if self.done.is_multiple_of(2) { 1.0 } else { -1.0 };
            let next = match self.part {
                Part::Rest => 0.0,
                Part::Forth => sign * self.amplitude,
                Part::Back => -sign * self.amplitude,
            };
            (self.before, self.command, self.sent_ns, self.window) = (self.command, next, None, 0);
        }
        Progress::Wants(self.command)
    }

    fn take_torque(&mut self, t: f64, torque: f64) {
        let left = (self.command - torque) / (self.command - self.before);
        if left > 0.97 {
            self.unseen = self.unseen.max(t);
        } else {
            self.seen = self.seen.min(t);
        }
        if (0.03..0.97).contains(&left) {
            // What is told is off by at most half a step, whatever is left: ln has that over what is left.
            let (weight, y) = (left * left, ln(left));
            for (sum, term) in self.sums.iter_mut().zip([1.0, t, t * t, y, t * y]) {
                *sum += weight * term;
            }
        }
    }

    fn take_line(&mut self) {
        let [n, t, tt, v, tv] = std::mem::replace(&mut self.line, [0.0; 5]);
        let spread = n * tt - t * t;
        if self.part != Part::Rest && spread > 0.0 {
            let (sum, count) = &mut self.slopes[usize::from(self.command < 0.0)];
            *sum += (n * tv - t * v) / spread;
            *count += 1;
        }
    }

    fn result(&self) -> Identified {
        let [w, t, tt, y, ty] = self.sums;
        let spread = w * tt - t * t;
        // Two different times are needed for a line.
        let slope = (w * ty - t * y) / spread;
        let (delay, lag) = if spread > 1e-6 * w * tt && slope < 0.0 {
            ((t - y / slope) / w, Some(-1.0 / slope))
        } else {
            // Between the last time without effect and the first with it.
            ((self.unseen.min(self.seen) + self.seen) / 2.0, None)
        };
        let mean = |(sum, count): (f64, u32)| sum / f64::from(count);
        let gained = mean(self.slopes[0]) - mean(self.slopes[1]);
        let inertia = 2.0 * self.amplitude / gained;
        Identified { delay, lag, inertia: Some(inertia).filter(|inertia| inertia.is_finite() && *inertia > 0.0) }
    }
}

#[allow(clippy::disallowed_methods, reason = "a measurement is told to people; no model computes with it")]
fn ln(x: f64) -> f64 {
    x.ln()
}
