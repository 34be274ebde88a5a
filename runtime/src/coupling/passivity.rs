//! Passivity observer: detects that an emulated contact returns more energy than it can store, the first sign of a
//! delayed loop. Source: Hannaford, Ryu, "Time-domain passivity control of haptic interfaces", IEEE Trans. Robotics and
//! Automation 18 (2002).
//!
//! In: torque and speed of every cycle, and the largest energy that the model stores. Out: [`Sign`]. Friction may
//! return the energy of its bristles and no more; a delayed loop returns more at every reversal. Allocates only at
//! construction.

/// Length of the window, s.
const WINDOW: f64 = 0.1;
/// Energy returned in the window that causes a warning, in units of the store; reversals of the other torque raise it.
const WARN: f64 = 0.5;
/// The same for a trip.
const TRIP: f64 = 3.0;
/// Additional allowance for each reversal of the other torque in the window.
const REVERSAL: f64 = 1.5;
/// Fall of the absorbed energy from its maximum that causes a trip.
const FALL: f64 = 1.0;

/// Result of the observer.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Sign {
    /// Passive, as friction is.
    Healthy,
    /// The contact returned more energy than it should.
    Warning,
    /// The contact drives the shaft.
    Trip,
}

/// State of the observer of one emulated contact.
#[derive(Clone, Debug)]
pub struct Energy {
    /// Largest energy that the model stores, J.
    store: f64,
    period: f64,
    /// Energy returned in each cycle of the window, J, and whether the other torque reversed.
    window: Vec<(f64, bool)>,
    at: usize,
    absorbed: f64,
    highest: f64,
    other: f64,
}

impl Energy {
    /// `store`: largest energy that the model stores, J; `period` in s.
    ///
    /// # Panics
    /// If either is not positive.
    pub fn new(store: f64, period: f64) -> Energy {
        assert!(store > 0.0 && period > 0.0, "a store of {store} J, a period of {period} s");
        let cycles = (WINDOW / period).round().max(1.0) as usize;
        Energy { store, period, window: vec![(0.0, false); cycles], at: 0, absorbed: 0.0, highest: 0.0, other: 0.0 }
    }

    /// One cycle: the torque with which the contact resists, N·m; the speed, rad/s; the other torque on the shaft, N·m.
    pub fn see(&mut self, resisting: f64, speed: f64, other: f64) -> Sign {
        let work = resisting * speed * self.period;
        let reversed = other * self.other < 0.0;
        if other != 0.0 {
            self.other = other;
        }
        self.window[self.at] = ((-work).max(0.0), reversed);
        self.at = (self.at + 1) % self.window.len();
        self.absorbed += work;
        self.highest = self.highest.max(self.absorbed);
        let allowed = REVERSAL * self.window.iter().filter(|(_, reversed)| *reversed).count() as f64;
        let returned = self.returned();
        if returned > TRIP + allowed || self.fall() > FALL + allowed {
            Sign::Trip
        } else if returned > WARN + allowed {
            Sign::Warning
        } else {
            Sign::Healthy
        }
    }

    /// Largest energy that the model stores, J.
    pub fn store(&self) -> f64 {
        self.store
    }

    /// Discards the history.
    pub fn restart(&mut self) {
        self.window.fill((0.0, false));
        (self.at, self.absorbed, self.highest, self.other) = (0, 0.0, 0.0, 0.0);
    }

    /// Appends the complete state as words, from which [`Energy::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.extend([self.at as u64, self.absorbed.to_bits(), self.highest.to_bits(), self.other.to_bits()]);
        words.extend(self.window.iter().flat_map(|(back, reversed)| [back.to_bits(), u64::from(*reversed)]));
    }

    /// Restores the state that [`Energy::save`] wrote. None if the words do not fit.
    pub fn restore(&mut self, words: &mut impl Iterator<Item = u64>) -> Option<()> {
        self.at = usize::try_from(words.next()?).ok().filter(|at| *at < self.window.len())?;
        for number in [&mut self.absorbed, &mut self.highest, &mut self.other] {
            *number = f64::from_bits(words.next()?);
        }
        for place in &mut self.window {
            *place = (f64::from_bits(words.next()?), words.next()? != 0);
        }
        Some(())
    }

    /// Energy returned within the window, in units of the store.
    pub fn returned(&self) -> f64 {
        self.window.iter().map(|(back, _)| back).sum::<f64>() / self.store
    }

    /// Distance of the absorbed energy below its maximum, in units of the store.
    pub fn fall(&self) -> f64 {
        (self.highest - self.absorbed) / self.store
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A spring of 260 N·m/rad with a store of 0.34 mJ on an oscillating shaft of 0.012 kg·m², its torque delayed by
    /// `late` periods: the returned energy grows with the delay.
    fn swing(late: usize, amplitude: f64) -> Sign {
        let (stiffness, inertia, period) = (260.0, 0.012, 1e-3);
        let mut energy = Energy::new(0.34e-3, period);
        let (mut x, mut v) = (amplitude, 0.0);
        let mut waiting = vec![stiffness * x; late + 1];
        let mut worst = Sign::Healthy;
        for _ in 0..500 {
            waiting.push(stiffness * x);
            let torque = waiting.remove(0);
            worst = worst.max(energy.see(torque, v, 0.0));
            for _ in 0..50 {
                v -= torque / inertia * period / 50.0;
                x += v * period / 50.0;
            }
        }
        worst
    }

    #[test]
    fn dissipative_friction_is_healthy() {
        let mut energy = Energy::new(1e-3, 1e-3);
        for k in 0..2000 {
            let v = (0.01 * f64::from(k)).sin();
            assert_eq!(energy.see(0.3 * v.signum(), v, 0.0), Sign::Healthy, "cycle {k}");
        }
        assert_eq!((energy.returned(), energy.fall()), (0.0, 0.0));
    }

    #[test]
    fn a_delayed_spring_is_detected() {
        assert_eq!(swing(4, 0.2e-3), Sign::Trip);
    }

    #[test]
    fn a_reversal_of_the_other_torque_raises_the_allowance() {
        let mut energy = Energy::new(1e-3, 1e-3);
        energy.see(1.0, 1.0, 1.0);
        assert_eq!(energy.see(-1.0, 1.0, -1.0), Sign::Healthy, "one store given back at a reversal");
        assert_eq!(energy.see(-1.1, 1.0, -1.0), Sign::Warning, "more than two stores");
    }
}
