//! The scale of unknown parameters: what the search varies, and back.
//!
//! In: ranges in SI. Out: coordinates of order 1. Where both bounds have one sign and a ratio of 10 or more, the
//! coordinate is the logarithm of the magnitude, else the position within the range. An unknown that must not lie below
//! another has the logarithm of its distance from that one.

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
    /// The unknown, by its index, below which this one never lies. No unknown is below itself along these.
    pub above: Option<usize>,
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

/// The least distance of an unknown from the one that it must not lie below, as a part of the range of the latter.
const LEAST_GAP: f64 = 1e-3;

/// The scale of all unknowns together.
#[derive(Clone, Copy)]
pub struct Scale<'a> {
    /// The unknowns.
    pub unknowns: &'a [Unknown],
    /// Elementary functions.
    pub with: Elementary<'a>,
}

impl Scale<'_> {
    /// Least and greatest distance of an unknown from the one below it.
    fn gaps(&self, k: usize, below: usize) -> (f64, f64) {
        let (one, other) = (&self.unknowns[k], &self.unknowns[below]);
        let least = LEAST_GAP * (other.high - other.low);
        (least, (one.high - other.low).max(2.0 * least))
    }

    /// The bounds of each coordinate.
    pub fn bounds(&self) -> (Vec<f64>, Vec<f64>) {
        let one = |(k, unknown): (usize, &Unknown)| match unknown.above {
            Some(below) => {
                let (least, most) = self.gaps(k, below);
                ((self.with.log)(least), (self.with.log)(most))
            }
            None => unknown.bounds(&self.with),
        };
        self.unknowns.iter().enumerate().map(one).unzip()
    }

    /// The coordinates of values in SI. Where one value lies below another that it must not, its distance is the least.
    pub fn coordinates(&self, values: &[f64]) -> Vec<f64> {
        let one = |(k, unknown): (usize, &Unknown)| match unknown.above {
            Some(below) => {
                let (least, most) = self.gaps(k, below);
                (self.with.log)((values[k] - values[below]).clamp(least, most))
            }
            None => unknown.coordinate(values[k], &self.with),
        };
        self.unknowns.iter().enumerate().map(one).collect()
    }

    /// The values in SI of coordinates. Those with another below them may lie outside of their range, see
    /// [`Scale::outside`]; no other does.
    pub fn values(&self, x: &[f64]) -> Vec<f64> {
        (0..x.len()).map(|k| self.value(x, k)).collect()
    }

    fn value(&self, x: &[f64], k: usize) -> f64 {
        match self.unknowns[k].above {
            Some(below) => self.value(x, below) + (self.with.exp)(x[k]),
            None => self.unknowns[k].value(x[k], &self.with),
        }
    }

    /// The first unknown whose value lies outside of its range.
    pub fn outside(&self, values: &[f64]) -> Option<usize> {
        let is_out = |k: &usize| !(self.unknowns[*k].low..=self.unknowns[*k].high).contains(&values[*k]);
        (0..values.len()).find(is_out)
    }

    /// The derivatives of a value with respect to the coordinates on which it depends: their indices and slopes.
    pub fn slopes(&self, values: &[f64], k: usize) -> Vec<(usize, f64)> {
        match self.unknowns[k].above {
            Some(below) => {
                let mut all = self.slopes(values, below);
                all.push((k, values[k] - values[below]));
                all
            }
            None => vec![(k, self.unknowns[k].slope(values[k]))],
        }
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
            let unknown = Unknown { low, high, start: low, known: None, above: None };
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

    /// Three unknowns in a chain, given in any order: values keep their order wherever the coordinates are, coordinates
    /// lead back to the values, and the slopes are those of differences.
    #[test]
    fn unknowns_above_others_stay_above_them() {
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let of = |above| Unknown { low: 0.1, high: 10.0, start: 1.0, known: None, above };
            // Which one is the lowest, the middle and the highest.
            let places = [[0, 1, 2], [2, 1, 0], [1, 2, 0], [2, 0, 1]][seed as usize % 4];
            let mut unknowns = vec![of(None); 3];
            unknowns[places[1]].above = Some(places[0]);
            unknowns[places[2]].above = Some(places[1]);
            let scale = Scale { unknowns: &unknowns, with: PLATFORM };
            let (low, high) = scale.bounds();
            let x: Vec<f64> = (0..3).map(|k| chance.between(low[k], high[k])).collect();
            let values = scale.values(&x);
            let [a, b, c] = places.map(|k| values[k]);
            assert!(a < b && b < c, "seed {seed}: {values:?}");
            let out = values.iter().any(|value| *value > 10.0);
            assert_eq!(scale.outside(&values).is_some(), out, "seed {seed}: {values:?}");
            for (back, x) in scale.coordinates(&values).iter().zip(&x) {
                assert!((back - x).abs() < 1e-9, "seed {seed}: {back}, not {x}");
            }
            for k in 0..3 {
                for j in 0..3 {
                    let moved = |by: f64| {
                        scale.values(&(0..3).map(|i| x[i] + if i == j { by } else { 0.0 }).collect::<Vec<_>>())[k]
                    };
                    let inside = x[j] - 1e-6 > low[j] && x[j] + 1e-6 < high[j];
                    let found = scale.slopes(&values, k).iter().find(|(i, _)| *i == j).map_or(0.0, |(_, slope)| *slope);
                    let expected = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                    assert!(
                        !inside || (found - expected).abs() < 1e-6 * values[k],
                        "seed {seed}: {found}, not {expected}"
                    );
                }
            }
        }
    }
}
