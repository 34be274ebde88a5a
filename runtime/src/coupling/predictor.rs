//! Predictor: the speed of the shaft at the time when the torque acts that is computed now (an observer with a
//! disturbance state, and a prediction of the state over the dead time).
//!
//! In: measured positions, the commands sent and their times of action, the inertia. Out: speed and position at the
//! centre of the coming torque, ahead by H = dead time + T/2 + lag. An observer of the shaft knows the commands that
//! have been sent and do not act yet, and models all unknown torques (a cable, another drive) as a constant
//! disturbance. A torque is positive if it accelerates the shaft. Allocates only at construction; one cycle takes 64
//! short steps.
//!
//! All observer poles are at θ per period: x̂, ŵ and d̂ are corrected by 1 − θ³, 1.5 (1 − θ)² (1 + θ)/T and (1 − θ)³
//! J/T² times the error of the position: an α-β-γ filter (Kalata, *The Tracking Index*, IEEE Trans. Aerospace and
//! Electronic Systems, 1984) with equal poles (Brookner, *Tracking and Kalman Filtering Made Easy*, 1998: critically
//! damped g-h-k filter).

use crate::coupling::lag::Lag;
use abi::Instance;
use abi::rig::{Kind, Rig, Signal, SignalKind};

/// Short steps of the observer per period, and of the prediction.
const STEPS: u64 = 32;

/// Observer poles at a period of 1 ms; at other periods the time constant is the same.
const THETA_AT_1_MS: f64 = 0.9;

/// A residual greater than this multiple of its usual size (one count, or its own running mean) indicates a deviation
/// from the model.
const UNUSUAL: f64 = 5.0;
/// Number of successive cycles after which the prediction is invalid.
const CYCLES: u32 = 3;

/// One drive on the shaft.
#[derive(Clone, PartialEq, Debug)]
pub struct Torque {
    /// Dead time from a command to its effect, ns.
    pub dead_ns: u64,
    lag: Lag,
}

impl Torque {
    /// At rest. `dead_ns`: from sending to the effect; `lag`: time constant, s.
    pub fn new(dead_ns: u64, lag: f64) -> Torque {
        Torque { dead_ns, lag: Lag::new(lag) }
    }
}

/// State of the observer.
#[derive(Clone, PartialEq, Debug)]
pub struct ShaftObserver {
    inertia: f64,
    period_ns: u64,
    theta: f64,
    /// Quantisation step of the encoder, rad.
    count: f64,
    /// The emulating drive first; then the others whose commands are known.
    torques: Vec<Torque>,
    /// A copy of `torques` for the prediction.
    ahead: Vec<Torque>,
    horizon_ns: u64,
    now_ns: u64,
    started: bool,
    position: f64,
    speed: f64,
    disturbance: f64,
    residual: f64,
    usual: f64,
    unusual_for: u32,
}

/// Predicted state of the shaft.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Predicted {
    /// rad/s
    pub speed: f64,
    /// rad
    pub position: f64,
}

/// The predictor of a rig, with its signals and outputs.
#[derive(Clone, PartialEq, Debug)]
pub struct Wired {
    /// The observer.
    pub observer: ShaftObserver,
    /// The position signal that it observes.
    pub position: Signal,
    /// For each of its torques: the index of the rig's output, the sign with which the output accelerates the shaft,
    /// and one quantisation step of the command, N·m.
    pub outputs: Vec<(usize, f64, f64)>,
    /// The emulating drive, whose speed and position are predicted.
    pub node: usize,
}

impl Wired {
    /// The predictor that `predict` of a rig requires; none if it requires none. `plant`, the program of the part that
    /// hardware replaces, determines the sign with which each torque accelerates the emulating drive. `least_ns`:
    /// shortest time of each node from a reading to the arrival of its command; the node's `delay` counts from the
    /// reading and cannot be shorter.
    ///
    /// # Errors
    /// A message about missing data.
    pub fn of(rig: &Rig, plant: &Instance, least_ns: impl Fn(usize) -> u64) -> Result<Option<Wired>, String> {
        let Some(node) = rig.predict else { return Ok(None) };
        let Some(inertia) = rig.plant.inertia else {
            return Err("`predict` needs the inertia of the shaft, which the hardware part does not show".into());
        };
        let drive = |node: usize| match &rig.nodes[node].kind {
            Kind::Cia402(drive) => Some(drive),
            Kind::Frames(_) => None,
        };
        let Some(emulating) = drive(node) else { return Err("`predict` names a drive that is none".into()) };
        let torque = |k: &usize| {
            let signal = rig.outputs[*k].signal;
            signal.what == SignalKind::Torque && rig.plant.applied.iter().any(|(applied, _)| *applied == signal)
        };
        let mut outputs: Vec<usize> = (0..rig.outputs.len()).filter(torque).collect();
        outputs.sort_by_key(|k| rig.outputs[*k].signal.node != node);
        let torques = outputs.iter().map(|k| {
            let at = rig.outputs[*k].signal.node;
            let node = &rig.nodes[at];
            let delay = (node.delay * 1e9).round() as u64;
            let dead = match drive(at).is_some_and(|drive| drive.at_sync) {
                true => rig.period_ns + delay,
                false => delay.max(least_ns(at)),
            };
            Torque::new(dead, node.lag)
        });
        let observer = ShaftObserver::new(inertia, rig.period_ns, emulating.count, torques.collect());
        let wired = |k: usize| {
            let signal = rig.outputs[k].signal;
            let step = drive(signal.node).map_or(0.0, |drive| 1e-3 * drive.rated_torque);
            (k, sign(rig, plant, signal, node), step)
        };
        let outputs = outputs.into_iter().map(wired).collect();
        Ok(Some(Wired { observer, position: Signal { node, what: SignalKind::Position }, outputs, node }))
    }

    /// Passes the permitted outputs to the observer, one value per output of the rig, rounded as the drives receive
    /// them.
    pub fn sent(&mut self, permitted: &[f64]) {
        for (torque, (output, sign, step)) in self.outputs.iter().enumerate() {
            let value = permitted[*output];
            let heard = if *step > 0.0 { (value / step).round() * step } else { value };
            self.observer.sent(torque, sign * heard);
        }
    }

    /// Resets to a shaft at rest, with these outputs permitted for long.
    pub fn restart(&mut self, permitted: &[f64]) {
        self.observer.restart();
        for (torque, (output, sign, _)) in self.observer.torques.iter_mut().zip(&self.outputs) {
            torque.lag.settle(sign * permitted[*output]);
        }
    }
}

/// Sign with which a torque accelerates the shaft at a drive, determined by one short step of the plant.
pub(crate) fn sign(rig: &Rig, plant: &Instance, torque: Signal, node: usize) -> f64 {
    let speed = rig.plant.seen.iter().find(|(signal, _)| *signal == Signal { node, what: SignalKind::Speed });
    let applied = rig.plant.applied.iter().find(|(signal, _)| *signal == torque);
    let (Some((_, speed)), Some((_, applied))) = (speed, applied) else { return 1.0 };
    let mut turned = [0.0, 0.0];
    for (turned, torque) in turned.iter_mut().zip([0.0, 1.0]) {
        let mut plant = plant.clone();
        plant.start(rig.period_ns as f64 * 1e-9 / 50.0);
        plant.set(*applied, torque);
        plant.advance(1);
        *turned = plant.get(*speed);
    }
    if turned[1] < turned[0] { -1.0 } else { 1.0 }
}

impl ShaftObserver {
    /// An observer of a shaft at rest. `inertia` in kg·m²; `count`: quantisation step of the encoder, rad; `torques`:
    /// the emulating drive first, then all others whose commands are known.
    ///
    /// # Panics
    /// Without a torque, or if inertia or period are not positive.
    pub fn new(inertia: f64, period_ns: u64, count: f64, torques: Vec<Torque>) -> ShaftObserver {
        assert!(inertia > 0.0 && period_ns > 0 && !torques.is_empty(), "a shaft of {inertia} kg·m², {period_ns} ns");
        let first = &torques[0];
        let horizon_ns = first.dead_ns + period_ns / 2 + (first.lag.constant() * 1e9).round() as u64;
        // θ = e^(−T/τ) with the time constant that results in 0.9 at 1 ms, by a rational approximation that is the same
        // on every machine.
        let x = period_ns as f64 / 1e6 * ((1.0 - THETA_AT_1_MS) / (0.5 * (1.0 + THETA_AT_1_MS)));
        let theta = ((1.0 - 0.5 * x) / (1.0 + 0.5 * x)).max(0.0);
        ShaftObserver {
            inertia,
            period_ns,
            theta,
            count,
            ahead: torques.clone(),
            torques,
            horizon_ns,
            now_ns: 0,
            started: false,
            position: 0.0,
            speed: 0.0,
            disturbance: 0.0,
            residual: 0.0,
            usual: 0.0,
            unusual_for: 0,
        }
    }

    /// Prediction horizon, ns.
    pub fn horizon_ns(&self) -> u64 {
        self.horizon_ns
    }

    /// Discards the state: the next position is accepted as it is.
    fn restart(&mut self) {
        (self.started, self.now_ns, self.unusual_for) = (false, 0, 0);
        (self.position, self.speed, self.disturbance, self.residual, self.usual) = (0.0, 0.0, 0.0, 0.0, 0.0);
    }

    /// Takes the position at a tick, rad, as its encoder reports it: whole counts, rounded down. The first one is
    /// accepted as it is.
    pub fn observe(&mut self, now_ns: u64, position: f64) {
        let middle = position + 0.5 * self.count;
        if !self.started {
            (self.started, self.now_ns, self.position) = (true, now_ns, middle);
            return;
        }
        self.coast(now_ns);
        let (t, theta) = (self.period_ns as f64 * 1e-9, self.theta);
        let error = middle - self.position;
        let left = 1.0 - theta;
        self.position += (1.0 - theta * theta * theta) * error;
        self.speed += 1.5 * left * left * (1.0 + theta) * error / t;
        self.disturbance += left * left * left * self.inertia * error / (t * t);
        self.judge(error);
    }

    /// Advances to a time for which no position arrived.
    pub fn coast(&mut self, now_ns: u64) {
        if !self.started {
            return;
        }
        let steps = STEPS * ((now_ns - self.now_ns) / self.period_ns).clamp(1, 16);
        let (from, span) = (self.now_ns, now_ns - self.now_ns);
        let s = span as f64 * 1e-9 / steps as f64;
        for k in 0..steps {
            let (a, b) = (from + span * k / steps, from + span * (k + 1) / steps);
            let sum: f64 = self.torques.iter_mut().map(|torque| torque.lag.advance(a, b)).sum();
            let acceleration = (sum + self.disturbance) / self.inertia;
            self.position += s * (self.speed + 0.5 * s * acceleration);
            self.speed += s * acceleration;
        }
        self.now_ns = now_ns;
    }

    fn judge(&mut self, error: f64) {
        let size = error.abs();
        let unusual = size > UNUSUAL * self.usual.max(self.count);
        self.unusual_for = if unusual { self.unusual_for + 1 } else { 0 };
        self.residual = error;
        // A running mean over a hundred cycles that limits the influence of a burst.
        self.usual += 0.01 * (size.min(10.0 * self.usual.max(self.count)) - self.usual);
    }

    /// Error of the last predicted position, rad.
    pub fn residual(&self) -> f64 {
        self.residual
    }

    /// Estimated unknown torque, N·m.
    pub fn disturbance(&self) -> f64 {
        self.disturbance
    }

    /// Estimated speed, rad/s.
    pub fn speed(&self) -> f64 {
        self.speed
    }

    /// Whether the model explains the readings; otherwise the prediction must not be used.
    pub fn is_valid(&self) -> bool {
        self.unusual_for < CYCLES
    }

    /// Predicted state of the shaft at the time when the present computation acts.
    pub fn ahead(&mut self) -> Predicted {
        self.ahead.clone_from_slice(&self.torques);
        let (mut speed, mut position) = (self.speed, self.position);
        let s = self.horizon_ns as f64 * 1e-9 / STEPS as f64;
        for k in 0..STEPS {
            let a = self.now_ns + self.horizon_ns * k / STEPS;
            let b = self.now_ns + self.horizon_ns * (k + 1) / STEPS;
            let sum: f64 = self.ahead.iter_mut().map(|torque| torque.lag.advance(a, b)).sum();
            let acceleration = (sum + self.disturbance) / self.inertia;
            position += s * (speed + 0.5 * s * acceleration);
            speed += s * acceleration;
        }
        Predicted { speed, position }
    }

    /// Appends the complete state as words, from which [`ShaftObserver::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.extend([self.now_ns, u64::from(self.started), u64::from(self.unusual_for)]);
        let numbers = [self.position, self.speed, self.disturbance, self.residual, self.usual];
        words.extend(numbers.map(f64::to_bits));
        self.torques.iter().for_each(|torque| torque.lag.save(words));
    }

    /// Restores the state that [`ShaftObserver::save`] wrote. None if the words do not fit.
    pub fn restore(&mut self, words: &mut impl Iterator<Item = u64>) -> Option<()> {
        self.now_ns = words.next()?;
        self.started = words.next()? != 0;
        self.unusual_for = u32::try_from(words.next()?).ok()?;
        let numbers = [&mut self.position, &mut self.speed, &mut self.disturbance, &mut self.residual, &mut self.usual];
        for number in numbers {
            *number = f64::from_bits(words.next()?);
        }
        self.torques.iter_mut().try_for_each(|torque| torque.lag.restore(words))
    }

    /// Passes the command sent at this tick to the torque with this index: the value after all limits.
    pub fn sent(&mut self, torque: usize, value: f64) {
        let one = &mut self.torques[torque];
        one.lag.send(self.now_ns + one.dead_ns, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// LuGre model of the textbook on 1 kg, pulled through a spring of 2 N/m at 0.1 m/s, in steps of the rig.
    struct Bristle {
        z: f64,
    }

    const SIGMA: [f64; 3] = [1e5, 316.0, 0.4];

    fn limit(v: f64) -> f64 {
        1.0 + 0.5 * (-(v / 1e-3) * (v / 1e-3)).exp()
    }

    impl Bristle {
        /// One exact step of the bristle at a constant speed, and the force at its end.
        fn step(&mut self, v: f64, h: f64) -> f64 {
            let rate = SIGMA[0] * v.abs() / limit(v);
            let end = if rate > 0.0 { v / rate } else { 0.0 };
            let before = self.z;
            self.z = if rate * h > 1e-12 {
                end + (before - end) * (-rate * h).exp()
            } else {
                before + h * (v - rate * before)
            };
            SIGMA[0] * self.z + SIGMA[1] * (self.z - before) / h + SIGMA[2] * v
        }
    }

    const T_NS: u64 = 1_000_000;
    const LAG: f64 = 1.0 / (2.0 * std::f64::consts::PI * 500.0);

    /// Kind of the coupling.
    #[derive(Clone, Copy, PartialEq)]
    enum Coupling {
        /// The ideal contact.
        Ideal,
        /// Measured speed as input, force as output.
        Plain,
        /// With the predictor of this module.
        Predicted {
            /// Encoder counts in the presliding range.
            counts: f64,
            /// Whether the predictor knows the pulling force.
            told: bool,
        },
    }

    /// Friction on the mass by time, sampled every period, and the number of slips.
    fn pulled(coupling: Coupling, dead_ns: u64) -> (Vec<f64>, u32) {
        let (mass, k, speed) = (1.0, 2.0, 0.1);
        let (mut x, mut v) = (0.0, 0.0);
        let mut bristle = Bristle { z: 0.0 };
        let count = match coupling {
            Coupling::Predicted { counts, .. } if counts > 0.0 => 1.5 / SIGMA[0] / counts,
            _ => 1e-12,
        };
        let torques = vec![Torque::new(dead_ns, LAG), Torque::new(0, 0.0)];
        let mut look = ShaftObserver::new(mass, T_NS, count, torques);
        let mut drive = Lag::new(LAG);
        let (mut courses, mut slips, mut sticking) = (Vec::new(), 0, true);
        for tick in 0..20_000u64 {
            let now = tick * T_NS;
            let t = tick as f64 * 1e-3;
            if coupling != Coupling::Ideal {
                let seen = match coupling {
                    Coupling::Predicted { told, .. } => {
                        look.observe(now, (x / count).floor() * count);
                        if told {
                            look.sent(1, k * (speed * t - x));
                        }
                        look.ahead().speed
                    }
                    _ => v,
                };
                let force = -bristle.step(seen, 1e-3);
                drive.send(now + dead_ns, force);
                look.sent(0, force);
            }
            let substeps = 50;
            let mut sum = 0.0;
            for s in 0..substeps {
                let h = 1e-3 / substeps as f64;
                let a = now + T_NS * s / substeps;
                let friction = match coupling {
                    Coupling::Ideal => -bristle.step(v, h),
                    _ => drive.advance(a, now + T_NS * (s + 1) / substeps),
                };
                let pull = k * (speed * (t + s as f64 * h) - x);
                let acceleration = (pull + friction) / mass;
                x += h * (v + 0.5 * h * acceleration);
                v += h * acceleration;
                sum += friction / substeps as f64;
            }
            courses.push(-sum);
            let sliding = v.abs() > 0.05;
            slips += u32::from(sliding && sticking);
            sticking = v.abs() < if sliding { 0.0 } else { 0.01 } || (sticking && !sliding);
        }
        (courses, slips)
    }

    fn error(course: &[f64], ideal: &[f64]) -> f64 {
        let sum: f64 = course.iter().zip(ideal).map(|(a, b)| (a - b) * (a - b)).sum();
        100.0 * (sum / course.len() as f64).sqrt()
    }

    /// Rms error of the friction in the stick-slip test, in % of F_C, over dead times. Figures of docs/prediction.md.
    #[test]
    fn stick_slip_with_2_ms_of_dead_time_is_right_with_the_predictor() {
        let (ideal, slips) = pulled(Coupling::Ideal, 0);
        assert_eq!(slips, 2, "the contact itself slips twice in 20 s");
        let mut table = String::from("dead time  plain  exact speed  15 counts, unknown pull\n");
        for dead_us in [200, 1000, 2000, 3000, 4500] {
            let one = |coupling| {
                let (course, slips) = pulled(coupling, dead_us * 1000);
                (error(&course, &ideal), slips)
            };
            let plain = one(Coupling::Plain);
            let exact = one(Coupling::Predicted { counts: 0.0, told: true });
            let full = one(Coupling::Predicted { counts: 15.0, told: false });
            table += &format!("{dead_us} us: {plain:.1?} {exact:.1?} {full:.1?}\n");
            if dead_us == 2000 {
                assert!((20.0..30.0).contains(&plain.0), "{table}");
                assert!(full.0 <= 1.0 && full.1 == slips, "{table}");
            }
            assert!(exact.0 <= 0.5 && exact.1 == slips, "{table}");
            assert!(full.0 <= 2.0 && full.1 == slips, "{table}");
        }
        println!("{table}");
    }

    #[test]
    fn an_unknown_torque_is_estimated() {
        let (inertia, count) = (0.012, 2.4e-5);
        let mut look = ShaftObserver::new(inertia, T_NS, count, vec![Torque::new(800_000, 0.6e-3)]);
        let (mut x, mut v) = (0.0f64, 0.0);
        for tick in 0..400u64 {
            look.observe(tick * T_NS, (x / count).floor() * count);
            let acceleration = 0.05 / inertia;
            x += 1e-3 * v + 0.5e-6 * acceleration;
            v += 1e-3 * acceleration;
        }
        assert!((look.disturbance() - 0.05).abs() < 5e-3, "{}", look.disturbance());
        assert!((look.speed() - (v - 1e-3 * 0.05 / inertia)).abs() < 5e-3, "{} {v}", look.speed());
        assert!(look.is_valid());
        // No model explains a shaft that jumps.
        for k in 0..3 {
            look.observe((400 + k) * T_NS, x + 0.3 * (k + 1) as f64);
        }
        assert!(!look.is_valid());
    }
}
