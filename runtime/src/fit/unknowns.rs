//! The scale of unknown parameters: what the search varies, and back.
//!
//! In: ranges in SI. Out: coordinates of order 1. Where both bounds have one sign and a ratio of 10 or more, the
//! coordinate is the logarithm of the magnitude, else the position within the range.

/// Elementary functions of the caller, so that every machine computes the same bits.
#[derive(Clone, Copy)]
pub struct Elementary<'a> {
    /// e^x
    pub exp: &'a (dyn Fn(f64) -> f64 + Sync),
    /// The natural logarithm.
    pub log: &'a (dyn Fn(f64) -> f64 + Sync),
}

/// Ratio of the bounds from which an unknown is scaled by its logarithm.
const WIDE: f64 = 10.0;

/// An unknown parameter.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Unknown {
    /// Lower bound in SI, finite.
    pub low: f64,
    /// Upper bound in SI, finite, above the lower one.
    pub high: f64,
    /// Where the search starts, in SI.
    pub start: f64,
    /// What is known beforehand: value and standard deviation in SI.
    pub known: Option<(f64, f64)>,
}

impl Unknown {
    /// Whether the coordinate is the logarithm of the magnitude.
    pub fn is_logarithmic(&self) -> bool {
        let (low, high) = self.magnitudes();
        self.low * self.high > 0.0 && high / low >= WIDE
    }

    fn magnitudes(&self) -> (f64, f64) {
        let (low, high) = (self.low.abs(), self.high.abs());
        (low.min(high), low.max(high))
    }

    /// The bounds of the coordinate.
    pub fn bounds(&self, with: &Elementary) -> (f64, f64) {
        match self.is_logarithmic() {
            true => {
                let (low, high) = self.magnitudes();
                ((with.log)(low), (with.log)(high))
            }
            false => (0.0, 1.0),
        }
    }

    /// The coordinate of a value in SI.
    pub fn coordinate(&self, value: f64, with: &Elementary) -> f64 {
        match self.is_logarithmic() {
            true => (with.log)(value.abs()),
            false => (value - self.low) / (self.high - self.low),
        }
    }

    /// The value in SI of a coordinate; never outside of the range.
    pub fn value(&self, coordinate: f64, with: &Elementary) -> f64 {
        let value = match self.is_logarithmic() {
            true => (with.exp)(coordinate) * if self.low < 0.0 { -1.0 } else { 1.0 },
            false => self.low + coordinate * (self.high - self.low),
        };
        value.clamp(self.low, self.high)
    }

    /// The derivative of the value with respect to its coordinate, at this value.
    pub fn slope(&self, value: f64) -> f64 {
        if self.is_logarithmic() { value } else { self.high - self.low }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::rng::Chance;

    /// The functions of the platform, for tests.
    pub(crate) const PLATFORM: Elementary = Elementary { exp: &f64::exp, log: &f64::ln };

    #[test]
    fn coordinates_lead_back_to_the_value() {
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let (a, b) = (chance.between(-3.0, 3.0), chance.between(-3.0, 3.0));
            let wide = seed % 2 == 0;
            let sign = if seed % 4 < 2 { 1.0 } else { -1.0 };
            let (a, b) = if wide { (sign * 10f64.powf(a), sign * 10f64.powf(a + 1.0 + b.abs())) } else { (a, b) };
            let (low, high) = (a.min(b), a.max(b));
            let unknown = Unknown { low, high, start: low, known: None };
            let (least, most) = (low.abs().min(high.abs()), low.abs().max(high.abs()));
            assert_eq!(unknown.is_logarithmic(), low * high > 0.0 && most >= 10.0 * least, "seed {seed}: {low} {high}");
            let value = chance.between(low, high);
            let u = unknown.coordinate(value, &PLATFORM);
            let (from, to) = unknown.bounds(&PLATFORM);
            assert!(u >= from - 1e-12 && u <= to + 1e-12, "seed {seed}: {u} in {from} .. {to}");
            let back = unknown.value(u, &PLATFORM);
            assert!((back - value).abs() <= 1e-12 * (high - low), "seed {seed}: {back}, not {value}");
            let h = 1e-6;
            let slope = (unknown.value(u + h, &PLATFORM) - unknown.value(u - h, &PLATFORM)) / (2.0 * h);
            let inside = u - h > from && u + h < to;
            assert!(!inside || (slope / unknown.slope(value) - 1.0).abs() < 1e-6, "seed {seed}: {slope}");
        }
    }
}
