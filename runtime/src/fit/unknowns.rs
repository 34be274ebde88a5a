//! The scale of unknown parameters: what the search varies, and back.
//!
//! In: ranges in SI. Out: coordinates of order 1. Where both bounds have one sign and a ratio of 10 or more, the
//! coordinate is the logarithm of the magnitude, else the position within the range. An unknown that must not lie below
//! another has the logarithm of its distance from that one, as a part of the room between that one and its own upper
//! bound. So the coordinates form a box, all of which can be run as far as ranges are concerned.

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

/// The least distance of an unknown from the one that it must not lie below, as a part of the room above that one.
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
    /// The greatest value of an unknown: its own bound, or one of those that never lie below it.
    fn ceiling(&self, k: usize) -> f64 {
        let above = (0..self.unknowns.len()).filter(|other| self.unknowns[*other].above == Some(k));
        above.fold(self.unknowns[k].high, |high, other| high.min(self.ceiling(other)))
    }

    /// An unknown with the range that it has beside the others.
    fn capped(&self, k: usize) -> Unknown {
        Unknown { high: self.ceiling(k), ..self.unknowns[k] }
    }

    /// The least value of an unknown that never lies below another, where that one has this value.
    fn floor(&self, k: usize, below: f64) -> f64 {
        below.max(self.unknowns[k].low)
    }

    /// The bounds of each coordinate.
    pub fn bounds(&self) -> (Vec<f64>, Vec<f64>) {
        let one = |k: usize| match self.unknowns[k].above {
            Some(_) => ((self.with.log)(LEAST_GAP), 0.0),
            None => self.capped(k).bounds(&self.with),
        };
        (0..self.unknowns.len()).map(one).unzip()
    }

    /// The coordinates of values in SI. Where one value lies below another that it must not, its distance is the least.
    pub fn coordinates(&self, values: &[f64]) -> Vec<f64> {
        let one = |k: usize| match self.unknowns[k].above {
            Some(below) => {
                let (floor, ceiling) = (self.floor(k, values[below]), self.ceiling(k));
                let part = (values[k] - floor) / (ceiling - floor);
                // Where the other leaves no room, any part is as good.
                (self.with.log)(if part.is_nan() { 1.0 } else { part.clamp(LEAST_GAP, 1.0) })
            }
            None => self.capped(k).coordinate(values[k], &self.with),
        };
        (0..values.len()).map(one).collect()
    }

    /// The values in SI of coordinates; never outside of a range, and none below another that it must not lie below.
    pub fn values(&self, x: &[f64]) -> Vec<f64> {
        (0..x.len()).map(|k| self.value(x, k)).collect()
    }

    fn value(&self, x: &[f64], k: usize) -> f64 {
        match self.unknowns[k].above {
            Some(below) => {
                let (floor, ceiling) = (self.floor(k, self.value(x, below)), self.ceiling(k));
                (floor + (ceiling - floor) * (self.with.exp)(x[k])).clamp(floor, ceiling)
            }
            None => self.capped(k).value(x[k], &self.with),
        }
    }

    /// The derivatives of a value with respect to the coordinates on which it depends: their indices and slopes.
    pub fn slopes(&self, values: &[f64], k: usize) -> Vec<(usize, f64)> {
        match self.unknowns[k].above {
            Some(below) => {
                let (floor, ceiling) = (self.floor(k, values[below]), self.ceiling(k));
                let part = (values[k] - floor) / (ceiling - floor);
                // A floor that is the bound of the range does not move.
                let moves = if values[below] > self.unknowns[k].low { 1.0 - part } else { 0.0 };
                let of_other = self.slopes(values, below).into_iter().map(|(at, slope)| (at, moves * slope));
                of_other.chain([(k, values[k] - floor)]).collect()
            }
            None => vec![(k, self.capped(k).slope(values[k]))],
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

    /// Three unknowns with ranges of their own, in a chain or two of them above the third: at every point of the box,
    /// its corners too, values lie in their ranges and in their order; coordinates lead back to the values, and the
    /// slopes are those of differences.
    #[test]
    fn unknowns_above_others_stay_above_them_and_within_their_ranges() {
        for seed in 0..400 {
            let mut chance = Chance(seed);
            let places = [[0, 1, 2], [2, 1, 0], [1, 2, 0], [2, 0, 1]][seed as usize % 4];
            let mut low = chance.between(-1.0, 1.0);
            let mut unknowns = vec![Unknown { low: 0.0, high: 0.0, start: 0.0, known: None, above: None }; 3];
            for place in places {
                // Ranges that overlap in any way; each has room above the lower bounds of those below it.
                let own = if seed % 3 == 0 { low.abs() + 0.01 } else { low + chance.between(-1.0, 0.5) };
                low = low.max(own);
                (unknowns[place].low, unknowns[place].high) = (own, low + chance.between(0.2, 20.0));
            }
            unknowns[places[1]].above = Some(places[0]);
            unknowns[places[2]].above = Some(if seed % 2 == 0 { places[1] } else { places[0] });
            let scale = Scale { unknowns: &unknowns, with: PLATFORM };
            let (low, high) = scale.bounds();
            let corner = chance.below(4);
            let within = |k: usize, chance: &mut Chance| match corner {
                0 => low[k],
                1 => high[k],
                _ => chance.between(low[k], high[k]),
            };
            let x: Vec<f64> = (0..3).map(|k| within(k, &mut chance)).collect();
            let values = scale.values(&x);
            for (k, unknown) in unknowns.iter().enumerate() {
                let value = values[k];
                assert!((unknown.low..=unknown.high).contains(&value), "seed {seed}: {value} of {unknown:?}");
                let is_above = unknown.above.is_none_or(|below| value >= values[below]);
                assert!(is_above, "seed {seed}: {values:?} of {unknowns:?}");
            }
            if corner < 2 {
                continue;
            }
            for (back, x) in scale.coordinates(&values).iter().zip(&x) {
                assert!((back - x).abs() < 1e-6, "seed {seed}: {back}, not {x}");
            }
            for k in 0..3 {
                for j in 0..3 {
                    let moved = |by: f64| {
                        scale.values(&(0..3).map(|i| x[i] + if i == j { by } else { 0.0 }).collect::<Vec<_>>())[k]
                    };
                    let h = 1e-6;
                    let inside = x[j] - h > low[j] && x[j] + h < high[j];
                    let found = scale.slopes(&values, k).iter().find(|(i, _)| *i == j).map_or(0.0, |(_, slope)| *slope);
                    let [above, below] = [moved(h) - values[k], values[k] - moved(-h)].map(|change| change / h);
                    // At the kink where another unknown meets the lower bound there are two slopes.
                    let is_kink = (above - below).abs() > 1e-3 * (above.abs() + below.abs());
                    let expected = 0.5 * (above + below);
                    let size = unknowns[k].high - unknowns[k].low;
                    assert!(
                        !inside || is_kink || (found - expected).abs() < 1e-4 * size,
                        "seed {seed}: {found}, not {expected}"
                    );
                }
            }
        }
    }
}
