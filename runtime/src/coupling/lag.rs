//! Response of a drive to its commands: a dead time, then a first-order lag, integrated exactly.
//!
//! In: commands with the times at which they act. Out: the applied torque, and its mean over an interval, so that the
//! impulse on the shaft is exact for any step of the shaft. Allocates only at construction.

/// Most commands under way at once; the compiler permits dead times of at most 200 periods.
const QUEUE: usize = 256;

/// e^−x for x ≥ 0, by argument halving and repeated squaring: the same bits on every machine, with an error within
/// 1e-15.
pub fn remaining(x: f64) -> f64 {
    let mut halvings = 0;
    let mut small = x;
    while small > 0.125 && halvings < 64 {
        small *= 0.5;
        halvings += 1;
    }
    // Computes 1 − e^−x without cancellation for small x; then (1 − d)² = 1 − (2 d − d²).
    let mut term = small;
    let mut gone = small;
    for k in 2..14 {
        term *= -small / f64::from(k);
        gone += term;
    }
    for _ in 0..halvings {
        gone *= 2.0 - gone;
    }
    1.0 - gone
}

/// State of a drive's response.
#[derive(Clone, PartialEq, Debug)]
pub struct Lag {
    /// Time constant, s; 0 for none.
    constant: f64,
    /// Ring buffer of the commands under way: time at which each acts, ns, and its value.
    queue: [(u64, f64); QUEUE],
    first: usize,
    waiting: usize,
    /// The command that acts.
    acting: f64,
    /// The applied value.
    applied: f64,
}

impl Lag {
    /// At rest; `constant`: time constant, s.
    pub fn new(constant: f64) -> Lag {
        Lag { constant, queue: [(0, 0.0); QUEUE], first: 0, waiting: 0, acting: 0.0, applied: 0.0 }
    }

    /// Its time constant, s.
    pub fn constant(&self) -> f64 {
        self.constant
    }

    /// The applied value at present.
    pub fn applied(&self) -> f64 {
        self.applied
    }

    /// Resets to a steady state: nothing is under way, and this command has acted for long.
    pub fn settle(&mut self, value: f64) {
        (self.first, self.waiting, self.acting, self.applied) = (0, 0, value, value);
    }

    /// Appends the complete state as words, from which [`Lag::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        words.extend([self.acting.to_bits(), self.applied.to_bits(), self.waiting as u64]);
        for k in 0..self.waiting {
            let (acts_ns, value) = self.queue[(self.first + k) % QUEUE];
            words.extend([acts_ns, value.to_bits()]);
        }
    }

    /// Restores the state that [`Lag::save`] wrote. None if there are too few words.
    pub fn restore(&mut self, words: &mut impl Iterator<Item = u64>) -> Option<()> {
        self.acting = f64::from_bits(words.next()?);
        self.applied = f64::from_bits(words.next()?);
        (self.first, self.waiting) = (0, usize::try_from(words.next()?).ok().filter(|n| *n <= QUEUE)?);
        for place in &mut self.queue[..self.waiting] {
            *place = (words.next()?, f64::from_bits(words.next()?));
        }
        Some(())
    }

    /// Adds a command that acts from this time on; later ones must not act before it. If too many are under way, the
    /// oldest acts at once.
    pub fn send(&mut self, acts_ns: u64, value: f64) {
        if self.waiting == QUEUE {
            self.take();
        }
        self.queue[(self.first + self.waiting) % QUEUE] = (acts_ns, value);
        self.waiting += 1;
    }

    fn take(&mut self) {
        self.acting = self.queue[self.first].1;
        (self.first, self.waiting) = ((self.first + 1) % QUEUE, self.waiting - 1);
    }

    /// Advances from one time to a later one; returns the mean of the applied value between them.
    pub fn advance(&mut self, from_ns: u64, to_ns: u64) -> f64 {
        let mut now = from_ns;
        let mut integral = 0.0;
        loop {
            while self.waiting > 0 && self.queue[self.first].0 <= now {
                self.take();
            }
            let next = match self.waiting {
                0 => to_ns,
                _ => self.queue[self.first].0.min(to_ns),
            };
            let h = (next - now) as f64 * 1e-9;
            let error = self.applied - self.acting;
            if self.constant > 0.0 {
                let left = remaining(h / self.constant);
                integral += self.acting * h + error * self.constant * (1.0 - left);
                self.applied = self.acting + error * left;
            } else {
                self.applied = self.acting;
                integral += self.acting * h;
            }
            now = next;
            if now >= to_ns {
                break;
            }
        }
        match to_ns > from_ns {
            true => integral / ((to_ns - from_ns) as f64 * 1e-9),
            false => self.applied,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_decay_agrees_with_the_exponential_of_the_platform() {
        for k in 0..400 {
            let x = 0.05 * f64::from(k);
            assert!((remaining(x) - (-x).exp()).abs() < 4e-15, "{x}: {} {}", remaining(x), (-x).exp());
        }
        assert_eq!((remaining(0.0), remaining(1e6)), (1.0, 0.0));
    }

    #[test]
    fn the_mean_is_exact_for_any_steps() {
        let course = |steps: u64| {
            let mut lag = Lag::new(0.6e-3);
            lag.send(800_000, 2.0);
            lag.send(1_800_000, -1.0);
            let step = 3_000_000 / steps;
            let sum: f64 = (0..steps).map(|k| lag.advance(k * step, (k + 1) * step)).sum();
            (sum / steps as f64, lag.applied())
        };
        // 2 from 0.8 ms on, −1 from 1.8 ms on, with a lag of 0.6 ms, calculated by hand.
        let e = |x: f64| (-x / 0.6).exp();
        let at = 2.0 * (1.0 - e(1.0));
        let end = -1.0 + (at + 1.0) * e(1.2);
        let integral = 2.0 - 2.0 * 0.6 * (1.0 - e(1.0)) - 1.2 + (at + 1.0) * 0.6 * (1.0 - e(1.2));
        for steps in [1, 3, 60, 150] {
            let (mean, applied) = course(steps);
            assert!(
                (mean - integral / 3.0).abs() < 1e-12 && (applied - end).abs() < 1e-12,
                "{steps}: {mean} {applied}"
            );
        }
    }
}
