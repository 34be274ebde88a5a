//! Chance for properties: a seeded generator, and how many cases are tried.

/// SplitMix64. Source: Steele, Lea, Flood, OOPSLA 2014.
pub struct Chance(u64);

impl Chance {
    /// The generator of one case.
    pub fn new(seed: u64) -> Chance {
        let mut of_seed = Chance(seed);
        Chance(of_seed.bits())
    }

    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [low, high).
    pub fn within(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Its logarithm is uniform in [low, high); both positive.
    #[allow(clippy::disallowed_methods, reason = "cases may differ in their last digit between machines")]
    pub fn decades(&mut self, low: f64, high: f64) -> f64 {
        let (low, high) = (low.ln(), high.ln());
        self.within(low, high).exp()
    }

    /// One of these.
    pub fn of<T: Copy>(&mut self, all: &[T]) -> T {
        all[(self.bits() % all.len() as u64) as usize]
    }
}

/// The seeds of a property: `plain` of them, or as many as `FRIC_CASES` says, from `FRIC_SEED` on.
pub fn seeds(plain: u64) -> std::ops::Range<u64> {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let first = number("FRIC_SEED").unwrap_or(1);
    first..first + number("FRIC_CASES").unwrap_or(plain)
}
