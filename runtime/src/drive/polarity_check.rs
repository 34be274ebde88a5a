//! The first motion: a small push that shows whether torque, speed and position have the right sign and scale.
//!
//! In: readings, once a tick. Out: the command wanted, then a verdict. A torque rises slowly until the shaft has
//! turned a little, then the same torques follow backwards and mirrored, which takes the speed out again.

use crate::drive::faults::Why;
use abi::rig::Mode;

/// How the test is made.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum SignTest {
    /// By a push under tight limits.
    #[default]
    Push,
    /// Somebody turns the shaft by hand; torque stays zero.
    ByHand,
    /// Not at all.
    Skip,
}

/// What the test may use and what must come of it, SI.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Bounds {
    /// What the drive follows.
    pub mode: Mode,
    /// Greatest torque or speed of the push.
    pub command: f64,
    /// Angle that counts as motion.
    pub angle: f64,
    /// Angle at which the test has gone wrong.
    pub angle_most: f64,
    /// Speed at which it has gone wrong.
    pub speed_most: f64,
    /// One step of the speed.
    pub speed_unit: f64,
    /// One step of the torque.
    pub torque_unit: f64,
}

/// What the drive says.
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

/// Time to see how the shaft moves by itself, s.
const CALM: f64 = 0.1;
/// Time in which the greatest command is reached, s.
const RISE: f64 = 0.5;
/// Time a shaft is given to turn, s.
pub const PATIENCE: f64 = 1.5;
/// Time somebody is given to turn it by hand, s.
pub const PATIENCE_BY_HAND: f64 = 60.0;
/// Time for the last motion to end, s.
const SETTLE: f64 = 0.2;
/// Time constant with which it is damped, s.
const DAMPING: f64 = 0.03;

/// One test.
#[derive(Clone, Debug)]
pub struct Push {
    bounds: Bounds,
    /// Something else turns the shaft, within so many s.
    turned: Option<f64>,
    phase: Phase,
    /// Time in this phase, s.
    t: f64,
    start: Option<f64>,
    /// Speed of the shaft before the push, rad/s.
    drift: f64,
    last: f64,
    /// Time the push took, s.
    rise: f64,
    turned_by_speed: f64,
    /// ∫|torque| dt while pushing: told, reported along it.
    told: f64,
    reported: f64,
    command: f64,
}

/// Where a test is.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Verdict {
    /// Goes on: the command wanted, counted from rest.
    Wants(f64),
    /// All is right.
    Right,
    /// It isn't.
    Wrong(Why),
}

impl Push {
    /// A test that has not begun. `turned`: the time in which somebody, or another drive, turns the shaft, s; without one the
    /// drive pushes it.
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
    pub fn tick(&mut self, sample: Sample, dt: f64) -> Verdict {
        let start = *self.start.get_or_insert(sample.position);
        if self.phase == Phase::Calm {
            self.t += dt;
            if self.t >= CALM {
                self.drift = (sample.position - start) / (self.t - dt);
                (self.phase, self.t, self.start) = (Phase::Push, 0.0, Some(sample.position));
            }
            return Verdict::Wants(0.0);
        }
        // Counted from where a shaft without the push would be: that one goes on as it did before.
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
            return Verdict::Wrong(Why::Ran(turned, speed));
        }
        let patience = self.turned.unwrap_or(PATIENCE);
        let slope = bounds.command / RISE;
        match self.phase {
            Phase::Push if turned.abs() >= bounds.angle => {
                if turned < 0.0 && self.turned.is_none() {
                    return Verdict::Wrong(Why::WrongSign);
                }
                (self.phase, self.rise, self.t) = (Phase::Back, self.t, 0.0);
            }
            Phase::Push if self.t > patience => {
                return Verdict::Wrong(match self.turned {
                    None => Why::Stuck(bounds.command),
                    Some(_) => Why::NotTurned(bounds.angle),
                });
            }
            Phase::Push => {}
            // The motion has ended or turned round: friction has done part of it.
            Phase::Back if self.t >= self.rise || turned < self.last => {
                if let Some(why) = self.judge(turned, sample) {
                    return Verdict::Wrong(why);
                }
                (self.phase, self.t) = (Phase::Settle, 0.0);
            }
            Phase::Back => {}
            Phase::Settle if self.t >= SETTLE => return Verdict::Right,
            Phase::Calm | Phase::Settle => {}
        }
        self.last = turned;
        self.command = match (self.phase, bounds.mode) {
            (Phase::Calm, _) => 0.0,
            _ if self.turned.is_some() => 0.0,
            (Phase::Push, Mode::Torque) => (slope * self.t).min(bounds.command),
            (Phase::Back, Mode::Torque) => -(slope * (self.rise - self.t)).clamp(0.0, bounds.command),
            (Phase::Push, Mode::Speed) => bounds.command,
            // What motion is left is damped, with the inertia that the push has shown.
            (Phase::Settle, Mode::Torque) => {
                let most = 0.1 * bounds.command;
                (-(speed + self.drift) * self.inertia() / DAMPING).clamp(-most, most)
            }
            (Phase::Back | Phase::Settle, Mode::Speed) => 0.0,
            (Phase::Push, Mode::Position) => bounds.angle * 1.5,
            (Phase::Back | Phase::Settle, Mode::Position) => 0.0,
        };
        Verdict::Wants(self.command)
    }

    /// Moment of inertia by the impulse and the angle of the push, whose torque rose evenly: x = ∫T dt · t / (3 J).
    fn inertia(&self) -> f64 {
        self.told * self.rise / (3.0 * self.bounds.angle)
    }

    /// What is wrong with the scales, once the shaft has turned and its speed has been taken out again.
    fn judge(&self, turned: f64, sample: Sample) -> Option<Why> {
        let bounds = self.bounds;
        let seconds = self.rise + self.t;
        // A speed in coarse steps may be off by one the whole time.
        let slack = 0.3 * turned.abs().max(bounds.angle) + bounds.speed_unit * seconds;
        if sample.speed.is_some() && (self.turned_by_speed - turned).abs() > slack {
            return Some(Why::Scale(turned, self.turned_by_speed));
        }
        let slack = 0.5 * self.told + bounds.torque_unit * seconds;
        let has_torque = bounds.mode == Mode::Torque && self.turned.is_none() && sample.torque.is_some();
        if has_torque && (self.reported - self.told).abs() > slack {
            return Some(Why::Torque(self.told, self.reported));
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

    /// A shaft of 0.012 kg·m² under dry friction, with these factors on what it reports.
    fn run(bounds: Bounds, friction: f64, [torque, speed, position]: [f64; 3]) -> (Verdict, f64, f64) {
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
                Verdict::Wants(command) => wanted = command,
                verdict => return (verdict, x, w),
            }
        }
        panic!("no verdict");
    }

    #[test]
    fn a_right_shaft_passes_and_rests() {
        for friction in [0.0, 0.1, 0.4] {
            let (verdict, x, w) = run(BOUNDS, friction, [1.0; 3]);
            assert_eq!(verdict, Verdict::Right, "friction {friction}");
            assert!(x.abs() < 0.05 && w.abs() < 0.05, "friction {friction}: {x} rad, {w} rad/s");
        }
    }

    #[test]
    fn wrong_signs_and_scales_are_told() {
        assert_eq!(run(BOUNDS, 0.1, [-1.0, 1.0, 1.0]).0, Verdict::Wrong(Why::WrongSign));
        assert_eq!(run(BOUNDS, 0.1, [1.0, -1.0, -1.0]).0, Verdict::Wrong(Why::WrongSign));
        for factor in [-1.0, 0.1, 10.0] {
            let (verdict, ..) = run(BOUNDS, 0.1, [1.0, factor, 1.0]);
            assert!(matches!(verdict, Verdict::Wrong(Why::Scale(..))), "speed by {factor}: {verdict:?}");
        }
        let (verdict, ..) = run(BOUNDS, 0.1, [4.0, 1.0, 1.0]);
        assert!(matches!(verdict, Verdict::Wrong(Why::Torque(..))), "{verdict:?}");
        assert_eq!(run(BOUNDS, 2.0, [1.0; 3]).0, Verdict::Wrong(Why::Stuck(1.0)));
        // Somebody else is to turn it, and it does not see that.
        let mut turned = Push::new(BOUNDS, Some(0.5));
        let still = Sample { position: 1.0, speed: Some(0.0), torque: Some(0.0) };
        let verdicts: Vec<Verdict> = (0..502).map(|_| turned.tick(still, 1e-3)).collect();
        assert_eq!(verdicts[..499], [Verdict::Wants(0.0); 499]);
        assert_eq!(verdicts[501], Verdict::Wrong(Why::NotTurned(BOUNDS.angle)));
        let tight = Bounds { speed_most: 0.01, ..BOUNDS };
        assert!(matches!(run(tight, 0.0, [1.0; 3]).0, Verdict::Wrong(Why::Ran(..))));
    }
}
