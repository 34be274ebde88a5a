//! Stability of the loop with an emulated contact: shaft, drives and compiled step as one discrete-time state matrix.
//!
//! In: the step of the control program as matrices, the shaft as matrices, dead time and lag of each drive. Out: the
//! spectral radius over one period, and the dead time at which it exceeds 1. The linearisation is the only
//! approximation: the shaft and the lags are integrated exactly between the times at which commands act (sampling of
//! systems with time delay: Åström, Wittenmark, *Computer-Controlled Systems*, 1997).
//!
//! A dead time n T + r is a queue of n + 1 set-points; within one period the oldest one acts for r, the next one for
//! the rest. Eigenvalues at 1 are free rotations and constants of the program; they are ignored.
//!
//! A loop with a predictor ([`PredictedLoop`]) is simulated instead, including the observer, from a small deflection: the rate
//! at which it decays or grows is its radius.

use crate::coupling::predictor::{ShaftObserver, Torque};
use nalgebra::DMatrix;
use std::collections::VecDeque;

/// Eigenvalues this near to 1 are free motion.
const FREE: f64 = 1e-6;
/// Longest dead time that is examined, in periods.
const PERIODS: f64 = 40.0;
/// Time constant assumed for a drive without a lag, s.
const LEAST_LAG: f64 = 1e-6;

/// s' = A s + B y, u = C s + D y over one period: n states, m signals, p commands; SI, row by row.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Step {
    pub states: usize,
    pub signals: usize,
    pub commands: usize,
    pub a: Vec<f64>,
    pub b: Vec<f64>,
    pub c: Vec<f64>,
    pub d: Vec<f64>,
}

/// dx/dt = A x + B q, y = C x: n states, p torques applied by the drives, m signals; SI, row by row.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Shaft {
    pub states: usize,
    pub torques: usize,
    pub signals: usize,
    pub a: Vec<f64>,
    pub b: Vec<f64>,
    pub c: Vec<f64>,
}

impl Shaft {
    /// One inertia in kg·m² on one drive, with its speed as the only signal.
    pub fn rigid(inertia: f64) -> Shaft {
        Shaft { states: 1, torques: 1, signals: 1, a: vec![0.0], b: vec![1.0 / inertia], c: vec![1.0] }
    }
}

/// Delay of a command.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct CommandDelay {
    /// Dead time from the reading to the begin of the effect, s.
    pub dead: f64,
    /// Time constant of the effect, s.
    pub lag: f64,
}

/// A loop of a control program and a shaft.
#[derive(Clone, PartialEq, Debug)]
pub struct Loop {
    /// Period, s.
    pub period: f64,
    /// The program.
    pub step: Step,
    /// The shaft; its torques are the commands of the step, in the same order, and its signals are those of the step.
    pub shaft: Shaft,
    /// Delay of each command.
    pub late: Vec<CommandDelay>,
}

impl Loop {
    /// The loop of a bristle contact that sticks, on one inertia: z' = z + T v with the newest speed, F = σ0 z' + B v,
    /// like the compiled step of LuGre at rest. `sigma0` in N·m/rad, `damping` B in N·m·s/rad: with this small model
    /// the loop of a program can be compared.
    pub fn bristle(inertia: f64, sigma0: f64, damping: f64, period: f64, late: CommandDelay) -> Loop {
        let step = Step {
            states: 1,
            signals: 1,
            commands: 1,
            a: vec![1.0],
            b: vec![period],
            c: vec![-sigma0],
            d: vec![-(sigma0 * period + damping)],
        };
        Loop { period, step, shaft: Shaft::rigid(inertia), late: vec![late] }
    }

    /// State matrix over one period. The state consists of states of the shaft, applied torques, waiting set-points of
    /// each command, the newest first, and states of the program.
    pub fn matrix(&self) -> DMatrix<f64> {
        let (n, p) = (self.shaft.states, self.shaft.torques);
        let (step, t) = (&self.step, self.period);
        // Dead time of each command: whole periods, and the remainder.
        let dead: Vec<(usize, f64)> = self
            .late
            .iter()
            .map(|late| {
                let whole = (late.dead / t + 1e-9).floor();
                (whole as usize, (late.dead - whole * t).max(0.0))
            })
            .collect();
        let queue_at: Vec<usize> = dead
            .iter()
            .scan(n + p, |next, (whole, _)| {
                let at = *next;
                *next += whole + 1;
                Some(at)
            })
            .collect();
        let waiting: usize = dead.iter().map(|(whole, _)| whole + 1).sum();
        let program_at = n + p + waiting;
        let size = program_at + step.states;
        let mut instants: Vec<f64> = dead.iter().map(|(_, rest)| *rest).chain([0.0, t]).collect();
        instants.sort_by(f64::total_cmp);
        instants.dedup_by(|a, b| (*a - *b).abs() < 1e-12 * t);
        let between: Vec<(f64, DMatrix<f64>)> =
            instants.windows(2).map(|pair| (pair[0], self.transition(pair[1] - pair[0]))).collect();
        let mut matrix = DMatrix::zeros(size, size);
        for column in 0..size {
            let mut state = vec![0.0; size];
            state[column] = 1.0;
            let signals: Vec<f64> =
                (0..step.signals).map(|j| (0..n).map(|i| self.shaft.c[j * n + i] * state[i]).sum()).collect();
            let program = &state[program_at..];
            let row = |of_states: &[f64], of_signals: &[f64], i: usize| -> f64 {
                let from_states: f64 = (0..step.states).map(|k| of_states[i * step.states + k] * program[k]).sum();
                let from_signals: f64 = (0..step.signals).map(|k| of_signals[i * step.signals + k] * signals[k]).sum();
                from_states + from_signals
            };
            let commands: Vec<f64> = (0..step.commands).map(|i| row(&step.c, &step.d, i)).collect();
            let next: Vec<f64> = (0..step.states).map(|i| row(&step.a, &step.b, i)).collect();
            // Waiting set-points, the new one first.
            let set_points: Vec<Vec<f64>> = (0..p)
                .map(|j| {
                    let old = &state[queue_at[j]..queue_at[j] + dead[j].0 + 1];
                    [commands[j]].into_iter().chain(old.iter().copied()).collect()
                })
                .collect();
            let mut moving: Vec<f64> = state[..n + p].to_vec();
            for (from, transition) in &between {
                let acting = (0..p).map(|j| {
                    let (whole, rest) = dead[j];
                    let late = if *from + 1e-12 * t < rest { whole + 1 } else { whole };
                    set_points[j][late]
                });
                let before = DMatrix::from_iterator(n + 2 * p, 1, moving.iter().copied().chain(acting));
                let after = transition * before;
                moving.copy_from_slice(&after.as_slice()[..n + p]);
            }
            let mut column = matrix.column_mut(column);
            for (i, value) in moving.iter().enumerate() {
                column[i] = *value;
            }
            for j in 0..p {
                for k in 0..=dead[j].0 {
                    column[queue_at[j] + k] = set_points[j][k];
                }
            }
            for (i, value) in next.iter().enumerate() {
                column[program_at + i] = *value;
            }
        }
        matrix
    }

    /// State transition over h seconds of the shaft's states, applied torques and acting commands.
    fn transition(&self, h: f64) -> DMatrix<f64> {
        let (n, p) = (self.shaft.states, self.shaft.torques);
        let mut rates = DMatrix::zeros(n + 2 * p, n + 2 * p);
        for i in 0..n {
            for k in 0..n {
                rates[(i, k)] = self.shaft.a[i * n + k] * h;
            }
            for j in 0..p {
                rates[(i, n + j)] = self.shaft.b[i * p + j] * h;
            }
        }
        for (j, late) in self.late.iter().enumerate() {
            let fast = h / late.lag.max(LEAST_LAG);
            rates[(n + j, n + j)] = -fast;
            rates[(n + j, n + p + j)] = fast;
        }
        rates.exp()
    }

    /// The greatest |λ| over one period, without free motion: below 1 every disturbance decays. Infinite if an entry of
    /// the matrix is not finite.
    pub fn radius(&self) -> f64 {
        let matrix = self.matrix();
        if matrix.iter().any(|entry| !entry.is_finite()) {
            return f64::INFINITY;
        }
        let values = matrix.complex_eigenvalues();
        let kept = values.iter().filter(|value| (value.re - 1.0).abs() + value.im.abs() > FREE);
        kept.map(|value| (value.re * value.re + value.im * value.im).sqrt()).fold(0.0, f64::max)
    }

    /// Whether every disturbance decays.
    pub fn is_stable(&self) -> bool {
        self.radius() < 1.0
    }

    /// The smallest dead time of a command, s, from which on the loop is unstable; none if it is stable up to 40
    /// periods; 0 if it is never stable.
    pub fn limit(&self, command: usize) -> Option<f64> {
        let stable = |dead: f64| {
            let mut other = self.clone();
            other.late[command].dead = dead;
            other.is_stable()
        };
        first_unstable(self.period, 0.125, 40, stable)
    }
}

/// The smallest unstable dead time, s: searched for in strides of `stride` periods, then by `halvings` bisections.
fn first_unstable(period: f64, stride: f64, halvings: usize, stable: impl Fn(f64) -> bool) -> Option<f64> {
    if !stable(0.0) {
        return Some(0.0);
    }
    let mut low = 0.0;
    let mut high = loop {
        let next = low + stride * period;
        if next > PERIODS * period {
            return None;
        }
        if !stable(next) {
            break next;
        }
        low = next;
    };
    for _ in 0..halvings {
        let middle = 0.5 * (low + high);
        if stable(middle) { low = middle } else { high = middle }
    }
    Some(0.5 * (low + high))
}

/// Periods over which the greatest deflection is taken.
const WINDOW: usize = 64;
/// Most windows that are simulated.
const WINDOWS: usize = 48;
/// Factor of decay or growth that suffices; beyond it rounding would dominate.
const ENOUGH: f64 = 1e9;

/// A loop of one command with a predictor.
#[derive(Clone, PartialEq, Debug)]
pub struct PredictedLoop {
    /// The loop without the predictor: one command.
    pub plain: Loop,
    /// The observed position, as a row over the states of the shaft.
    pub position: Vec<f64>,
    /// For each signal whether the program reads its prediction.
    pub ahead: Vec<bool>,
    /// Moment of inertia that the observer assumes, kg·m².
    pub inertia: f64,
    /// Sign with which the command accelerates the observed position.
    pub sign: f64,
    /// Dead time and lag that the observer assumes.
    pub told: CommandDelay,
}

impl PredictedLoop {
    /// Factor by which a deflection grows in one period, once the fast modes have decayed: below 1 the loop is stable.
    #[allow(clippy::disallowed_methods, reason = "a figure to be shown and compared with 1: decides nothing that runs")]
    pub fn radius(&self) -> f64 {
        let Loop { period, step, shaft, late } = &self.plain;
        let (n, late) = (shaft.states, late[0]);
        let period_ns = (period * 1e9).round() as u64;
        let dead_ns = (self.told.dead * 1e9).round() as u64;
        let mut look = ShaftObserver::new(self.inertia, period_ns, 0.0, vec![Torque::new(dead_ns, self.told.lag)]);
        let whole = (late.dead / period + 1e-9).floor();
        let rest = (late.dead - whole * period).max(0.0);
        let [before, after] = [rest, period - rest].map(|h| self.plain.transition(h));
        let mut waiting: VecDeque<f64> = vec![0.0; whole as usize + 1].into();
        // States of the shaft, then the applied torque.
        let mut moving: Vec<f64> = (0..=n).map(|i| if i < n { 1.0 / (1.0 + i as f64) } else { 0.0 }).collect();
        let mut program = vec![0.0; step.states];
        let mut peaks = Vec::new();
        for k in 0..WINDOW * WINDOWS {
            let seen = |row: &[f64]| row.iter().zip(&moving).map(|(c, x)| c * x).sum::<f64>();
            look.observe(k as u64 * period_ns, seen(&self.position));
            let ahead = look.ahead().speed;
            let signals: Vec<f64> = (0..step.signals)
                .map(|j| if self.ahead[j] { ahead } else { seen(&shaft.c[j * n..(j + 1) * n]) })
                .collect();
            let row = |of_states: &[f64], of_signals: &[f64], i: usize| -> f64 {
                let states = of_states[i * step.states..].iter().zip(&program).map(|(a, s)| a * s).sum::<f64>();
                states + of_signals[i * step.signals..].iter().zip(&signals).map(|(b, u)| b * u).sum::<f64>()
            };
            let command = row(&step.c, &step.d, 0);
            program = (0..step.states).map(|i| row(&step.a, &step.b, i)).collect();
            look.sent(0, self.sign * command);
            waiting.push_front(command);
            // The oldest set-point acts for the remainder of the dead time, then the next one.
            for (transition, acting) in [(&before, waiting[waiting.len() - 1]), (&after, waiting[waiting.len() - 2])] {
                let all = DMatrix::from_iterator(n + 2, 1, moving.iter().copied().chain([acting]));
                moving.copy_from_slice(&(transition * all).as_slice()[..=n]);
            }
            waiting.pop_back();
            let deflection = signals.iter().map(|v| v.abs()).sum::<f64>() * step.d[0].abs().max(1e-3) + command.abs();
            if !deflection.is_finite() {
                return f64::INFINITY;
            }
            match k % WINDOW {
                0 => peaks.push(deflection),
                _ => *peaks.last_mut().expect("one was just begun") = peaks[peaks.len() - 1].max(deflection),
            }
            let whole_windows = (k + 1).is_multiple_of(WINDOW) && peaks.len() > 2;
            if whole_windows && !(peaks[1] / ENOUGH..=peaks[1] * ENOUGH).contains(&peaks[peaks.len() - 1]) {
                break;
            }
        }
        let spans = (WINDOW * (peaks.len() - 2)) as f64;
        (peaks[peaks.len() - 1] / peaks[1]).powf(1.0 / spans)
    }

    /// The smallest dead time, s, known to the observer, from which on the loop is unstable; none if it is stable up to
    /// 40 periods; 0 if it is never stable.
    pub fn limit(&self) -> Option<f64> {
        let period = self.plain.period;
        let stable = |dead: f64| {
            let mut other = self.clone();
            (other.plain.late[0].dead, other.told.dead) = (dead, dead);
            other.radius() < 1.0
        };
        first_unstable(period, 2.0, 8, stable)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    fn lag_of(hertz: f64) -> f64 {
        1.0 / (2.0 * std::f64::consts::PI * hertz)
    }

    /// Total delay in ms at which the contact becomes unstable: T/2 + lag + dead time.
    fn limit_ms(period: f64, hertz: f64, zeta: f64) -> f64 {
        let lag = lag_of(hertz);
        let sigma0 = 1e5;
        let damping = 2.0 * zeta * f64::sqrt(sigma0);
        let contact = Loop::bristle(1.0, sigma0, damping, period, CommandDelay { dead: 0.0, lag });
        1e3 * (0.5 * period + lag + contact.limit(0).unwrap())
    }

    /// Published figures of the exact discrete loop (docs/prediction.md), for σ0/J = 1e5 1/s².
    #[test]
    fn the_limits_agree_with_the_published_table() {
        let table = [
            (1e-3, 500.0, 0.5, 2.37),
            (0.5e-3, 500.0, 0.5, 2.32),
            (0.25e-3, 500.0, 0.5, 2.29),
            (1e-3, 200.0, 0.5, 2.44),
            (1e-3, 500.0, 0.1, 1.10),
            (0.5e-3, 1000.0, 0.1, 0.87),
            (1e-3, 500.0, 1.0, 2.06),
        ];
        for (period, hertz, zeta, expected) in table {
            let found = limit_ms(period, hertz, zeta);
            assert!((found - expected).abs() < 0.01 * expected, "{period} {hertz} {zeta}: {found} for {expected}");
        }
    }

    /// The nonlinear loop: a bristle with any amplitude, the drive with dead time and lag, the shaft in fine steps.
    /// Returns whether a small deflection decays.
    fn dies_out(inertia: f64, sigma0: f64, damping: f64, period: f64, late: CommandDelay) -> bool {
        let period_ns = (period * 1e9).round() as u64;
        let fc = 1.0;
        let g = |v: f64| fc * (1.0 + 0.5 * (-(v / 1e-3) * (v / 1e-3)).exp());
        let mut drive = crate::coupling::lag::Lag::new(late.lag);
        let dead_ns = (late.dead * 1e9).round() as u64;
        let (mut x, mut v, mut z) = (0.0f64, 1e-7f64, 0.0f64);
        let mut early = 0.0f64;
        let cycles = 6000;
        let mut last = 0.0f64;
        for cycle in 0..cycles {
            let rate = sigma0 * v.abs() / g(v);
            let before = z;
            z = if rate * period > 1e-9 {
                let end = v / rate;
                end + (before - end) * (-rate * period).exp()
            } else {
                before + period * (v - rate * before)
            };
            let force = -(sigma0 * z + damping * (v - sigma0 * v.abs() / g(v) * z));
            drive.send(cycle * period_ns + dead_ns, force);
            for k in 0..20 {
                let (a, b) = (cycle * period_ns + period_ns * k / 20, cycle * period_ns + period_ns * (k + 1) / 20);
                let acceleration = drive.advance(a, b) / inertia;
                let h = period / 20.0;
                x += h * (v + 0.5 * h * acceleration);
                v += h * acceleration;
            }
            if cycle < 600 {
                early = early.max(v.abs());
            }
            if cycle >= cycles - 600 {
                last = last.max(v.abs());
            }
        }
        let _ = x;
        last < 0.5 * early
    }

    fn ahead(plain: Loop, inertia: f64) -> PredictedLoop {
        let late = plain.late[0];
        // The shaft with its angle: x' = v.
        let mut plain = plain;
        plain.shaft = Shaft {
            states: 2,
            torques: 1,
            signals: 1,
            a: vec![0.0, 0.0, 1.0, 0.0],
            b: vec![1.0 / inertia, 0.0],
            c: vec![1.0, 0.0],
        };
        PredictedLoop { plain, position: vec![0.0, 1.0], ahead: vec![false], inertia, sign: 1.0, told: late }
    }

    /// Without prediction the simulation must agree with the eigenvalues.
    #[test]
    fn the_simulated_radius_agrees_with_the_eigenvalues() {
        for (dead, zeta) in [(0.2e-3, 0.5), (0.8e-3, 0.5), (1.6e-3, 0.5), (2.4e-3, 0.5), (0.3e-3, 0.1)] {
            let late = CommandDelay { dead, lag: lag_of(500.0) };
            let plain = Loop::bristle(1.0, 1e5, 2.0 * zeta * f64::sqrt(1e5), 1e-3, late);
            let (exact, run) = (plain.radius(), ahead(plain, 1.0).radius());
            assert!((run - exact).abs() < 2e-3, "{dead} {zeta}: {run} for {exact}");
        }
    }

    /// The contact of the textbook: without the predictor it is unstable from 2.4 ms on, with it not before three times
    /// that.
    #[test]
    fn prediction_stabilises_a_delayed_contact() {
        let late = CommandDelay { dead: 4.5e-3, lag: lag_of(500.0) };
        let plain = Loop::bristle(1.0, 1e5, f64::sqrt(1e5), 1e-3, late);
        assert!(plain.radius() > 1.0);
        let mut looking = ahead(plain, 1.0);
        looking.ahead = vec![true];
        let radius = looking.radius();
        assert!(radius < 1.0, "{radius}");
        let limit = looking.limit();
        assert!(limit.is_none_or(|limit| limit > 6e-3), "{limit:?}");
    }

    /// The predicted limit is the onset of chatter in the nonlinear loop, within 5 % of the total delay, over a grid of
    /// J, σ0, ζ, lag and period: below it a deflection decays, above it does not.
    #[test]
    fn the_predicted_limit_is_the_observed_onset() {
        let mut grid = Vec::new();
        for inertia in [0.002, 0.02, 0.2] {
            for natural in [100.0, 200.0, 400.0] {
                for zeta in [0.15, 0.3, 0.6, 1.0] {
                    for hertz in [150.0, 400.0, 1000.0] {
                        for period in [0.25e-3, 0.5e-3, 1e-3] {
                            grid.push((inertia, natural, zeta, lag_of(hertz), period));
                        }
                    }
                }
            }
        }
        let judged = grid.par_iter().map(|&(inertia, natural, zeta, lag, period): &(f64, f64, f64, f64, f64)| {
            let (sigma0, damping) = (inertia * natural * natural, 2.0 * zeta * inertia * natural);
            let late = |dead: f64| CommandDelay { dead, lag };
            let predicted = Loop::bristle(inertia, sigma0, damping, period, late(0.0)).limit(0).unwrap();
            let total = 0.5 * period + lag + predicted;
            // None if lag and period alone are too long, or so long that 5 % less would require a negative dead time.
            let below = predicted - 0.05 * total;
            let stable = (below >= 0.0).then(|| dies_out(inertia, sigma0, damping, period, late(below)));
            let unstable = !dies_out(inertia, sigma0, damping, period, late(predicted + 0.05 * total));
            let told = format!("J {inertia}, σ0 {sigma0}, ζ {zeta}, T {period}, lag {lag}: predicted {total} s");
            assert!(unstable, "5 % above it dies out: {told}");
            assert!(stable.unwrap_or(true), "5 % below it does not die out: {told}");
            (stable.is_some(), predicted)
        });
        let judged: Vec<(bool, f64)> = judged.collect();
        let (both, limits) = (judged.iter().filter(|(both, _)| *both).count(), judged.iter().map(|(_, limit)| *limit));
        println!(
            "{} cases, {both} from both sides, dead times up to {} ms",
            judged.len(),
            1e3 * limits.fold(0.0, f64::max)
        );
        assert!(both > 250, "{both} of {}", judged.len());
    }
}
