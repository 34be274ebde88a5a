//! Randomness for properties: a seeded generator, and the number of cases.

/// The runtime's generator, with draws for cases.
pub struct Chance(runtime::rng::Chance);

impl Chance {
    /// The generator of one case.
    pub fn new(seed: u64) -> Chance {
        Chance(runtime::rng::Chance(runtime::rng::Chance(seed).number()))
    }

    /// The generator whose first number is that of the seed itself.
    pub fn plain(seed: u64) -> Chance {
        Chance(runtime::rng::Chance(seed))
    }

    /// Uniform in [low, high).
    pub fn within(&mut self, low: f64, high: f64) -> f64 {
        self.0.between(low, high)
    }

    /// Log-uniform in [low, high); both positive.
    #[allow(clippy::disallowed_methods, reason = "cases may differ in their last digit between machines")]
    pub fn decades(&mut self, low: f64, high: f64) -> f64 {
        let (low, high) = (low.ln(), high.ln());
        self.within(low, high).exp()
    }

    /// Uniform in 0..n.
    pub fn below(&mut self, n: usize) -> usize {
        (self.0.number() % n as u64) as usize
    }

    /// One of the elements.
    pub fn of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len())]
    }
}

/// The seeds of a property: `plain` of them, or the number in `FRIC_CASES`, from `FRIC_SEED` on.
pub fn seeds(plain: u64) -> std::ops::Range<u64> {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let first = number("FRIC_SEED").unwrap_or(1);
    first..first + number("FRIC_CASES").unwrap_or(plain)
}
