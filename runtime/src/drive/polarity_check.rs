//! Polarity check: a small motion that shows whether torque, speed and position agree in sign and scale.
//!
//! In: readings, once per tick. Out: the requested command, then a verdict. The torque rises slowly until the shaft has
//! turned a little; then the same torques follow in reverse order and with the opposite sign, which removes the speed
//! again.

use crate::drive::faults::RefusalReason;
use abi::rig::Mode;

/// Kind of the polarity check.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum SignTest {
    /// By a push of the drive under tight limits.
    #[default]
    Push,
    /// Somebody turns the shaft by hand; the torque stays zero.
    ByHand,
    /// No check.
    Skip,
}

/// Limits and scales of the check, SI.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Bounds {
    /// The quantity that the drive controls.
    pub mode: Mode,
    /// Highest torque or speed of the push.
    pub command: f64,
    /// Angle that counts as motion.
    pub angle: f64,
    /// Angle at which the check fails.
    pub angle_most: f64,
    /// Speed at which the check fails.
    pub speed_most: f64,
    /// Quantisation step of the speed.
    pub speed_unit: f64,
    /// Quantisation step of the torque.
    pub torque_unit: f64,
}

/// Readings of the drive.
#[derive(Clone, Copy, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Sample {
    pub position: f64,
    pub speed: Option<f64>,
    pub torque: Option<f64>,
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Phase {
    Calm,
    Push,
    Back,
    Settle,
}

/// Time in which the shaft's own motion is observed, s.
const CALM: f64 = 0.1;
/// Time in which the torque rises to its maximum, s.
const RISE: f64 = 0.5;
/// Time in which the shaft must turn, s.
pub const PATIENCE: f64 = 1.5;
/// Time in which somebody must turn the shaft by hand, s.
pub const PATIENCE_BY_HAND: f64 = 60.0;
/// Time for the remaining motion to end, s.
const SETTLE: f64 = 0.2;
/// Time constant with which it is damped, s.
const DAMPING: f64 = 0.03;

/// State of one check.
#[derive(Clone, Debug)]
pub struct Push {
    bounds: Bounds,
    /// The shaft is turned from outside, within this time, s; none: the drive pushes it.
    turned: Option<f64>,
    phase: Phase,
    /// Time in this phase, s.
    t: f64,
    start: Option<f64>,
    /// Speed of the shaft before the push, rad/s.
    drift: f64,
    last: f64,
    /// Duration of the push, s.
    rise: f64,
    turned_by_speed: f64,
    /// ∫torque dt during the push: commanded, reported, N·m·s.
    told: f64,
    reported: f64,
    command: f64,
}

/// Result of one tick.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum PolarityVerdict {
    /// The check continues with this command, relative to rest.
    Wants(f64),
    /// The check has passed.
    Right,
    /// The check has failed.
    Wrong(RefusalReason),
}

impl Push {
    /// A check before its first tick. `turned`: time in which the shaft is turned by hand or by another drive, s; none:
    /// the drive pushes it.
    pub fn new(bounds: Bounds, turned: Option<f64>) -> Push {
        Push {
            bounds,
            turned,
            phase: if turned.is_some() { Phase::Push } else { Phase::Calm },
            t: 0.0,
            start: None,
            drift: 0.0,
            last: 0.0,
            rise: 0.0,
            turned_by_speed: 0.0,
            told: 0.0,
            reported: 0.0,
            command: 0.0,
        }
    }

    /// One tick of `dt` seconds.
    pub fn tick(&mut self, sample: Sample, dt: f64) -> PolarityVerdict {
        let start = *self.start.get_or_insert(sample.position);
        if self.phase == Phase::Calm {
            self.t += dt;
            if self.t >= CALM {
                self.drift = (sample.position - start) / (self.t - dt);
                (self.phase, self.t, self.start) = (Phase::Push, 0.0, Some(sample.position));
            }
            return PolarityVerdict::Wants(0.0);
        }
        // Relative to the position that the shaft would have without the push, continuing its earlier motion.
        self.start = Some(start + self.drift * dt);
        let turned = sample.position - start - self.drift * dt;
        let speed = sample.speed.map_or((turned - self.last) / dt, |speed| speed - self.drift);
        self.turned_by_speed += speed * dt;
        if self.phase == Phase::Push {
            self.told += self.command * dt;
            self.reported += sample.torque.unwrap_or(0.0) * dt;
        }
        self.t += dt;
        let bounds = self.bounds;
        if self.turned.is_none() && (turned.abs() > bounds.angle_most || speed.abs() > bounds.speed_most) {
            return PolarityVerdict::Wrong(RefusalReason::Ran(turned, speed));
        }
        let patience = self.turned.unwrap_or(PATIENCE);
        let slope = bounds.command / RISE;
        match self.phase {
            Phase::Push if turned.abs() >= bounds.angle => {
                if turned < 0.0 && self.turned.is_none() {
                    return PolarityVerdict::Wrong(RefusalReason::WrongSign);
                }
                (self.phase, self.rise, self.t) = (Phase::Back, self.t, 0.0);
            }
            Phase::Push if self.t > patience => {
                return PolarityVerdict::Wrong(match self.turned {
                    None => RefusalReason::Stuck(bounds.command),
                    Some(_) => RefusalReason::NotTurned(bounds.angle),
                });
            }
            Phase::Push => {}
            // The motion has ended or reversed: friction has contributed.
            Phase::Back if self.t >= self.rise || turned < self.last => {
                if let Some(why) = self.judge(turned, sample) {
                    return PolarityVerdict::Wrong(why);
                }
                (self.phase, self.t) = (Phase::Settle, 0.0);
            }
            Phase::Back => {}
            Phase::Settle if self.t >= SETTLE => return PolarityVerdict::Right,
            Phase::Calm | Phase::Settle => {}
        }
        self.last = turned;
        self.command = match (self.phase, bounds.mode) {
            (Phase::Calm, _) => 0.0,
            _ if self.turned.is_some() => 0.0,
            (Phase::Push, Mode::Torque) => (slope * self.t).min(bounds.command),
            (Phase::Back, Mode::Torque) => -(slope * (self.rise - self.t)).clamp(0.0, bounds.command),
            (Phase::Push, Mode::Speed) => bounds.command,
            // The remaining motion is damped, with the moment of inertia that the push has shown.
            (Phase::Settle, Mode::Torque) => {
                let most = 0.1 * bounds.command;
                (-(speed + self.drift) * self.inertia() / DAMPING).clamp(-most, most)
            }
            (Phase::Back | Phase::Settle, Mode::Speed) => 0.0,
            (Phase::Push, Mode::Position) => bounds.angle * 1.5,
            (Phase::Back | Phase::Settle, Mode::Position) => 0.0,
        };
        PolarityVerdict::Wants(self.command)
    }

    /// Moment of inertia from impulse and angle of the push, whose torque rose linearly: x = ∫T dt · t / (3 J).
    fn inertia(&self) -> f64 {
        self.told * self.rise / (3.0 * self.bounds.angle)
    }

    /// The scale error, if any, once the shaft has turned and its speed has been removed again.
    fn judge(&self, turned: f64, sample: Sample) -> Option<RefusalReason> {
        let bounds = self.bounds;
        let seconds = self.rise + self.t;
        // A coarsely quantised speed may be off by one step all the time.
        let slack = 0.3 * turned.abs().max(bounds.angle) + bounds.speed_unit * seconds;
        if sample.speed.is_some() && (self.turned_by_speed - turned).abs() > slack {
            return Some(RefusalReason::Scale(turned, self.turned_by_speed));
        }
        let slack = 0.5 * self.told + bounds.torque_unit * seconds;
        let has_torque = bounds.mode == Mode::Torque && self.turned.is_none() && sample.torque.is_some();
        if has_torque && (self.reported - self.told).abs() > slack {
            return Some(RefusalReason::Torque(self.told, self.reported));
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds {
        mode: Mode::Torque,
        command: 1.0,
        angle: 0.005,
        angle_most: 0.3,
        speed_most: 20.0,
        speed_unit: 1e-3,
        torque_unit: 4e-3,
    };

    /// Simulates a shaft of 0.012 kg·m² with dry friction, with these factors on its readings.
    fn run(bounds: Bounds, friction: f64, [torque, speed, position]: [f64; 3]) -> (PolarityVerdict, f64, f64) {
        let (mut push, mut x, mut w, mut wanted) = (Push::new(bounds, None), 0.0f64, 0.0f64, 0.0);
        for _ in 0..5000 {
            for _ in 0..100 {
                let push = torque.signum() * wanted;
                let drag = if w != 0.0 { friction.copysign(w) } else { push.clamp(-friction, friction) };
                let next = w + (push - drag) * 1e-5 / 0.012;
                w = if w * next < 0.0 { 0.0 } else { next };
                x += w * 1e-5;
            }
            let sample = Sample { position: x * position, speed: Some(w * speed), torque: Some(wanted * torque.abs()) };
            match push.tick(sample, 1e-3) {
                PolarityVerdict::Wants(command) => wanted = command,
                verdict => return (verdict, x, w),
            }
        }
        panic!("no verdict");
    }

    #[test]
    fn a_correct_shaft_passes_and_stops() {
        for friction in [0.0, 0.1, 0.4] {
            let (verdict, x, w) = run(BOUNDS, friction, [1.0; 3]);
            assert_eq!(verdict, PolarityVerdict::Right, "friction {friction}");
            assert!(x.abs() < 0.05 && w.abs() < 0.05, "friction {friction}: {x} rad, {w} rad/s");
        }
    }

    #[test]
    fn wrong_signs_and_scales_are_reported() {
        assert_eq!(run(BOUNDS, 0.1, [-1.0, 1.0, 1.0]).0, PolarityVerdict::Wrong(RefusalReason::WrongSign));
        assert_eq!(run(BOUNDS, 0.1, [1.0, -1.0, -1.0]).0, PolarityVerdict::Wrong(RefusalReason::WrongSign));
        for factor in [-1.0, 0.1, 10.0] {
            let (verdict, ..) = run(BOUNDS, 0.1, [1.0, factor, 1.0]);
            assert!(
                matches!(verdict, PolarityVerdict::Wrong(RefusalReason::Scale(..))),
                "speed by {factor}: {verdict:?}"
            );
        }
        let (verdict, ..) = run(BOUNDS, 0.1, [4.0, 1.0, 1.0]);
        assert!(matches!(verdict, PolarityVerdict::Wrong(RefusalReason::Torque(..))), "{verdict:?}");
        assert_eq!(run(BOUNDS, 2.0, [1.0; 3]).0, PolarityVerdict::Wrong(RefusalReason::Stuck(1.0)));
        // The shaft is to be turned from outside, but the drive does not see a motion.
        let mut turned = Push::new(BOUNDS, Some(0.5));
        let still = Sample { position: 1.0, speed: Some(0.0), torque: Some(0.0) };
        let verdicts: Vec<PolarityVerdict> = (0..502).map(|_| turned.tick(still, 1e-3)).collect();
        assert_eq!(verdicts[..499], [PolarityVerdict::Wants(0.0); 499]);
        assert_eq!(verdicts[501], PolarityVerdict::Wrong(RefusalReason::NotTurned(BOUNDS.angle)));
        let tight = Bounds { speed_most: 0.01, ..BOUNDS };
        assert!(matches!(run(tight, 0.0, [1.0; 3]).0, PolarityVerdict::Wrong(RefusalReason::Ran(..))));
    }
}
