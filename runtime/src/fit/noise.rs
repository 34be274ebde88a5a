//! A model of the noise of a measurement: autoregressive, its order by an information criterion.
//!
//! In: the residuals of a fit, row by row, and the gaps between rows. Out: an AR(p) model, p ≤ 8, and the filter that makes
//! residuals and their derivatives white; it begins anew after each gap. Sources: Burg's method (Kay, Modern Spectral Estimation, sec. 7.4); BIC (Schwarz 1978).

use crate::fit::unknowns::Elementary;
use std::ops::Range;

/// Highest order.
pub const MOST_ORDER: usize = 8;

/// An autoregressive model of residuals: r(t) = Σ a(k) r(t − k) + e(t).
#[derive(Clone, PartialEq, Debug)]
pub struct Noise {
    /// The autoregressive coefficients a(1), a(2), …; none for white noise.
    pub coefficients: Vec<f64>,
    /// Variance of the residuals.
    pub variance: f64,
    /// Variance of e as a fraction of that of the residuals.
    pub innovation: f64,
    /// Rows before which there is a gap, ascending: no row after it follows from those before it.
    pub gaps: Vec<usize>,
    /// Whitened residuals beyond this count by their size and not by its square (Huber); infinite in least squares.
    pub bound: f64,
}

impl Noise {
    /// White noise of this variance.
    pub fn white(variance: f64) -> Noise {
        Noise { coefficients: Vec::new(), variance, innovation: 1.0, gaps: Vec::new(), bound: f64::INFINITY }
    }

    /// The model of these residuals, with gaps before these rows, from those whose size is at most `most`.
    pub fn of(residuals: &[f64], gaps: &[usize], most: f64, with: &Elementary) -> Noise {
        let is_sound = |r: &f64| r.abs() <= most;
        let n = residuals.iter().filter(|r| is_sound(r)).count();
        let variance = residuals.iter().filter(|r| is_sound(r)).map(|r| r * r).sum::<f64>() / n.max(1) as f64;
        let mut noise = Noise { gaps: gaps.to_vec(), ..Noise::white(variance) };
        if variance <= 0.0 || variance.is_nan() {
            return noise;
        }
        let most = MOST_ORDER.min(n / 10);
        // An outlier parts its neighbours as a gap does.
        let whole = noise.stretches(residuals.len());
        let sound = |rows: &Range<usize>| {
            let parts = residuals[rows.clone()].split_inclusive(|r| !is_sound(r));
            let mut begin = rows.start;
            let one = |part: &[f64]| {
                let from = begin;
                begin += part.len();
                from..from + part.iter().filter(|r| is_sound(r)).count()
            };
            parts.map(one).collect::<Vec<Range<usize>>>()
        };
        let stretches: Vec<Range<usize>> = whole.iter().flat_map(sound).collect();
        let (mut forward, mut backward) = (residuals.to_vec(), residuals.to_vec());
        let (mut a, mut power): (Vec<f64>, f64) = (Vec::new(), 1.0);
        let criterion = |power: f64, order: usize| n as f64 * (with.log)(power) + order as f64 * (with.log)(n as f64);
        let mut least = criterion(power, 0);
        for order in 1..=most {
            let (mut product, mut square) = (0.0, 0.0);
            let after = |rows: &Range<usize>| rows.start + order..rows.end;
            for t in stretches.iter().flat_map(after) {
                product += forward[t] * backward[t - 1];
                square += forward[t] * forward[t] + backward[t - 1] * backward[t - 1];
            }
            if square == 0.0 {
                break;
            }
            let k = 2.0 * product / square;
            for t in stretches.iter().flat_map(|rows| after(rows).rev()) {
                let (f, b) = (forward[t], backward[t - 1]);
                (forward[t], backward[t]) = (f - k * b, b - k * f);
            }
            a = (0..order - 1).map(|i| a[i] - k * a[order - 2 - i]).chain([k]).collect();
            power *= 1.0 - k * k;
            if power <= 0.0 || power.is_nan() {
                break;
            }
            let now = criterion(power, order);
            if now < least {
                least = now;
                (noise.coefficients, noise.innovation) = (a.clone(), power);
            }
        }
        noise
    }

    /// Whether large whitened residuals count by their size.
    pub fn is_robust(&self) -> bool {
        self.bound.is_finite()
    }

    /// The rows between gaps, of so many.
    fn stretches(&self, rows: usize) -> Vec<Range<usize>> {
        let mut begin = 0;
        let ends = self.gaps.iter().copied().take_while(|gap| *gap < rows).chain([rows]);
        ends.map(|end| std::mem::replace(&mut begin, end)..end).collect()
    }

    /// Number of rows that the filter uses up.
    pub fn order(&self) -> usize {
        self.coefficients.len()
    }

    /// The rows that whitening leaves, of so many: without the first p of each stretch, which have no past.
    pub fn kept(&self, rows: usize) -> impl Iterator<Item = usize> + use<> {
        let p = self.order();
        self.stretches(rows).into_iter().flat_map(move |rows| rows.start + p..rows.end)
    }

    /// Filters a series and divides it by the standard deviation of e. Of its rows, those [kept](Noise::kept).
    pub fn whitened(&self, series: &[f64]) -> Vec<f64> {
        self.whitening(series).collect()
    }

    /// The same numbers, one after the other.
    pub fn whitening<'s>(&'s self, series: &'s [f64]) -> impl Iterator<Item = f64> + 's {
        let scale = self.scale();
        self.kept(series.len()).map(move |t| scale * self.innovation_at(series, t))
    }

    /// What a row adds to those before it.
    fn innovation_at(&self, series: &[f64], t: usize) -> f64 {
        let predicted: f64 = self.coefficients.iter().enumerate().map(|(k, a)| a * series[t - 1 - k]).sum();
        series[t] - predicted
    }

    /// The inverse of the standard deviation of e.
    fn scale(&self) -> f64 {
        1.0 / (self.variance * self.innovation).sqrt()
    }
}

/// Filters a series that comes in parts, with the bits of [`Noise::whitened`] for all of it.
pub struct Whitening<'n> {
    noise: &'n Noise,
    /// The last rows, at most as many as the order; then those of the present part.
    rows: Vec<f64>,
    /// Number of all rows so far, and of those since a gap.
    count: usize,
    since: usize,
}

impl<'n> Whitening<'n> {
    /// Before the first row.
    pub fn new(noise: &'n Noise) -> Whitening<'n> {
        Whitening { noise, rows: Vec::new(), count: 0, since: 0 }
    }

    /// The next part, filtered.
    pub fn of(&mut self, part: &[f64]) -> Vec<f64> {
        let Whitening { noise, rows, count, since } = self;
        let (order, scale) = (noise.order(), noise.scale());
        rows.drain(..rows.len() - rows.len().min(order));
        let first = rows.len();
        rows.extend_from_slice(part);
        let mut gaps = noise.gaps[noise.gaps.partition_point(|gap| gap < count)..].iter().peekable();
        let mut out = Vec::with_capacity(part.len());
        for t in first..rows.len() {
            if gaps.next_if_eq(&&*count).is_some() {
                *since = 0;
            }
            if *since >= order {
                out.push(scale * noise.innovation_at(rows, t));
            }
            (*count, *since) = (*count + 1, *since + 1);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::unknowns::tests::PLATFORM;
    use crate::rng::Chance;

    /// A normal variate: the sum of twelve uniform ones, less 6.
    fn normal(chance: &mut Chance) -> f64 {
        (0..12).map(|_| chance.fraction()).sum::<f64>() - 6.0
    }

    /// Mutants, each fails: the filter forgets the rows before a part; it goes on across a gap at the first row of one.
    #[test]
    fn parts_are_filtered_as_the_whole() {
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let n = 1 + chance.below(300) as usize;
            let series: Vec<f64> = (0..n).map(|_| normal(&mut chance)).collect();
            let mut gaps: Vec<usize> = (0..chance.below(6)).map(|_| 1 + chance.below(n as u64) as usize).collect();
            gaps.sort_unstable();
            gaps.dedup();
            let coefficients = (0..chance.below(9)).map(|_| chance.between(-0.5, 0.5)).collect();
            let noise = Noise { coefficients, innovation: 0.5, gaps, ..Noise::white(2.0) };
            let (mut filter, mut parts, mut begin) = (Whitening::new(&noise), Vec::new(), 0);
            while begin < n {
                let end = n.min(begin + 1 + chance.below(20) as usize);
                parts.extend(filter.of(&series[begin..end]));
                begin = end;
            }
            assert_eq!(parts, noise.whitened(&series), "seed {seed}: {noise:?}");
        }
    }

    #[test]
    fn the_order_and_coefficients_of_a_process_are_found() {
        for (seed, a) in [vec![], vec![0.9], vec![0.5, -0.6], vec![1.2, -0.8, 0.3]].into_iter().enumerate() {
            let mut chance = Chance(seed as u64);
            let mut series: Vec<f64> = Vec::new();
            for t in 0..20_000 {
                let past: f64 = a.iter().enumerate().filter(|(k, _)| t > *k).map(|(k, a)| a * series[t - 1 - k]).sum();
                series.push(past + normal(&mut chance));
            }
            let noise = Noise::of(&series, &[], f64::INFINITY, &PLATFORM);
            assert_eq!(noise.order(), a.len(), "{a:?}: {noise:?}");
            for (found, expected) in noise.coefficients.iter().zip(&a) {
                assert!((found - expected).abs() < 0.03, "{a:?}: {noise:?}");
            }
            let white = noise.whitened(&series);
            let variance = white.iter().map(|e| e * e).sum::<f64>() / white.len() as f64;
            assert!((variance - 1.0).abs() < 1e-3, "{a:?}: variance {variance}");
            assert!((noise.variance * noise.innovation - 1.0).abs() < 0.04, "{a:?}: {noise:?}");
            assert!(Noise::of(&white, &[], f64::INFINITY, &PLATFORM).order() == 0, "{a:?}: white after the filter");
        }
    }

    #[test]
    fn nothing_and_constants_are_white() {
        for series in [vec![], vec![0.0; 50], vec![1.0; 3]] {
            assert_eq!(Noise::of(&series, &[], f64::INFINITY, &PLATFORM).order(), 0, "{series:?}");
        }
    }

    /// Stretches of a process that do not follow each other: its coefficient is found, and no row is predicted across a
    /// gap. With the gaps forgotten, the jumps at them count as noise.
    #[test]
    fn the_filter_begins_anew_after_a_gap() {
        for seed in 0..20 {
            let mut chance = Chance(seed);
            let (mut series, mut gaps) = (Vec::new(), Vec::new());
            while series.len() < 4000 {
                gaps.push(series.len());
                let mut past = normal(&mut chance) / f64::sqrt(1.0 - 0.81);
                for _ in 0..20 + chance.below(40) {
                    past = 0.9 * past + normal(&mut chance);
                    series.push(past);
                }
            }
            let [noise, forgotten] = [&gaps[1..], &[]].map(|gaps| Noise::of(&series, gaps, f64::INFINITY, &PLATFORM));
            let mean = |noise: &Noise| {
                let white = noise.whitened(&series);
                noise.variance * noise.innovation * white.iter().map(|e| e * e).sum::<f64>() / white.len() as f64
            };
            assert!(noise.order() == 1 && (noise.coefficients[0] - 0.9).abs() < 0.03, "seed {seed}: {noise:?}");
            assert!(
                (mean(&noise) - 1.0).abs() < 0.1 && mean(&forgotten) > 1.1 * mean(&noise),
                "seed {seed}: {}",
                mean(&forgotten)
            );
            let kept: Vec<usize> = noise.kept(series.len()).collect();
            assert_eq!(kept.len(), series.len() - gaps.len(), "seed {seed}");
            assert!(gaps.iter().all(|gap| !kept.contains(gap)), "seed {seed}");
        }
    }
}
