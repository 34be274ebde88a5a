//! Seeds and counts of generated tests, from the environment.

use std::ops::Range;

/// The number in an environment variable; none if it is not set or no number.
pub fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().and_then(|text| text.parse().ok())
}

/// The seeds of a test: `FRIC_SEED=n` repeats one; else `FRIC_RUNS` seeds (`runs` if not set) from `FRIC_FIRST` on.
pub fn seeds(runs: u64) -> Range<u64> {
    match number("FRIC_SEED") {
        Some(seed) => seed..seed + 1,
        None => {
            let first = number("FRIC_FIRST").unwrap_or(0);
            first..first + number("FRIC_RUNS").unwrap_or(runs)
        }
    }
}
