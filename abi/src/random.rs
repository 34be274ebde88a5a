//! SplitMix64: 64 random bits from a state, the same on every machine.
//!
//! Source: Steele, Lea, Flood, *Fast splittable pseudorandom number generators*, 2014. Imports nothing, so that tests of
//! crates below may include this file.

/// The increment of the state: 2⁶⁴ by the golden ratio, odd.
pub const GAMMA: u64 = 0x9E37_79B9_7F4A_7C15;

/// The next number; advances the state.
pub fn next(state: &mut u64) -> u64 {
    *state = state.wrapping_add(GAMMA);
    finalised(*state)
}

/// The finaliser: neighbouring numbers become independent ones.
pub fn finalised(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A number below `bound`, with a negligible bias; 0 for a bound of 0.
pub fn below(state: &mut u64, bound: usize) -> usize {
    (next(state) % bound.max(1) as u64) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first numbers of seed 1234567, as published with the reference code.
    #[test]
    fn the_numbers_are_those_of_the_source() {
        let mut state = 1_234_567;
        let first: Vec<u64> = (0..3).map(|_| next(&mut state)).collect();
        assert_eq!(first, [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]);
    }
}
