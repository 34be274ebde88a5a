//! The steady curve of a contact: the force that it settles at, over the speed at which its shaft turns.
//!
//! In: the control program of a rig, values of its parameters, quantities for force and speed, a greatest speed. Out:
//! points of the curve, from the computation that runs on the rig, with its step. A speed at which the force does not
//! settle soon has no point: near rest a contact needs longer than anybody waits.

use abi::plan::Series;
use abi::rig::{Rig, SignalKind};
use abi::{Instance, Slot};
use std::time::{Duration, Instant};

/// Speeds in each direction, in equal ratios, and the least as a share of the greatest.
const SPEEDS: u32 = 40;
const LEAST: f64 = 1e-3;
/// Steps of the first look at the force; each further one comes after twice as many.
const FIRST: u64 = 256;
/// Most steps at a speed.
const MOST: u64 = 1 << 17;
/// Steps between two positions of the shaft.
const PIECE: u64 = 16;
/// The force has settled if it changes less than this between two looks, as a share of its greatest amount so far.
const SETTLED: f64 = 1e-3;
/// Time for a whole curve: what is missing then is left out.
const PATIENCE: Duration = Duration::from_secs(3);

/// A curve to be made.
pub struct Steady {
    /// The rig.
    pub rig: Rig,
    /// Its control program at its start.
    pub control: Instance,
    /// Values of its parameters, SI.
    pub set: Vec<(Slot, f64)>,
    /// The force.
    pub force: Series,
    /// The speed.
    pub speed: Series,
    /// The greatest speed, SI.
    pub most: f64,
}

impl Steady {
    /// Makes it: points (speed, force) in the units of both, in the order of speed, with a gap at rest.
    pub fn curve(&self) -> Vec<(f64, f64)> {
        let (begun, mut greatest) = (Instant::now(), 0.0);
        let ratio = |i: u32| LEAST * power(1.0 / LEAST, f64::from(i) / f64::from(SPEEDS - 1));
        let [mut negative, mut positive] = [Vec::new(), Vec::new()];
        // The fast ones first: they settle soonest.
        for i in (0..SPEEDS).rev() {
            for (sign, points) in [(-1.0, &mut negative), (1.0, &mut positive)] {
                if begun.elapsed() < PATIENCE {
                    points.extend(self.settled(sign * ratio(i) * self.most, &mut greatest));
                }
            }
        }
        positive.reverse();
        let gap = (!negative.is_empty() && !positive.is_empty()).then_some((0.0, f64::NAN));
        negative.into_iter().chain(gap).chain(positive).collect()
    }

    fn slots(&self, what: SignalKind) -> Vec<Slot> {
        self.rig.inputs.iter().filter(|input| input.signal.what == what).map(|input| input.slot).collect()
    }

    /// The point at a speed of the shaft; none if the force does not settle.
    fn settled(&self, v: f64, greatest: &mut f64) -> Option<(f64, f64)> {
        let (speeds, positions) = (self.slots(SignalKind::Speed), self.slots(SignalKind::Position));
        let h = self.rig.period_ns as f64 * 1e-9 / f64::from(self.rig.steps.max(1));
        let mut model = self.control.clone();
        self.set.iter().for_each(|(slot, value)| model.set(*slot, *value));
        (model.start(h) == 0).then_some(())?;
        let (mut steps, mut look, mut before) = (0, FIRST, f64::NAN);
        while steps < MOST {
            speeds.iter().for_each(|slot| model.set(*slot, v));
            positions.iter().for_each(|slot| model.set(*slot, v * h * steps as f64));
            (model.advance(PIECE) == 0).then_some(())?;
            steps += PIECE;
            if steps < look {
                continue;
            }
            let force = model.get(self.force.slot);
            *greatest = force.abs().max(*greatest);
            if (force - before).abs() <= SETTLED * *greatest {
                let speed = model.get(self.speed.slot);
                return Some((self.speed.unit.from_si(speed), self.force.unit.from_si(force)));
            }
            (look, before) = (2 * look, force);
        }
        None
    }
}

#[allow(clippy::disallowed_methods, reason = "a picture")]
fn power(base: f64, exponent: f64) -> f64 {
    base.powf(exponent)
}
