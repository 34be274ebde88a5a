//! A reproducible pseudorandom generator: the same numbers from the same seed on every machine.
//!
//! In: a seed. Out: numbers of SplitMix64 (`abi::random`), in the form in which they are needed.

/// A SplitMix64 generator; the field is its state, at first the seed.
#[derive(Clone, Debug)]
pub struct Chance(pub u64);

impl Chance {
    /// The next 64 bits.
    pub fn number(&mut self) -> u64 {
        abi::random::next(&mut self.0)
    }

    /// Uniform in [0, 1).
    pub fn fraction(&mut self) -> f64 {
        (self.number() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in 0..n; 0 for n = 0.
    pub fn below(&mut self, n: u64) -> u64 {
        ((u128::from(self.number()) * u128::from(n)) >> 64) as u64
    }

    /// Uniform between two numbers.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.fraction()
    }
}
