//! Filters of recordings: low-passes that shift nothing in time, and derivatives.
//!
//! In: equidistant numbers. Out: filtered numbers. A low-pass runs forward and backward, so its phase is zero and its
//! attenuation counts twice. Each pass starts in its steady state, on a recording that is continued beyond both ends by
//! point reflection (Gustafsson, IEEE Trans. Signal Processing 44 (1996), p. 988, as SciPy's `sosfiltfilt`). A gap
//! divides a recording into pieces that are filtered apart. Knows nothing of units.

use crate::functions::Unary;
use crate::ir::build::Build;
use crate::ir::interpret::run_once;
use abi::Slot;
use std::f64::consts::{FRAC_PI_8, PI};
use std::ops::Range;

/// An interval longer than this multiple of the usual one is a gap.
const GAP: f64 = 1.5;
/// By how much intervals may differ from the usual one, relative to it.
const UNEVEN: f64 = 1e-3;
/// Rows by which a recording is continued beyond its ends, for each state of a filter and one more.
const CONTINUED: usize = 3;

/// A section of order two of a low-pass: both zeros at half the rate, gain 1 at rest.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Section {
    /// Numerator b (1 + 2 z⁻¹ + z⁻²).
    b: f64,
    /// Denominator 1 + a₁ z⁻¹ + a₂ z⁻².
    a: [f64; 2],
}

/// A digital low-pass, by the bilinear transform.
#[derive(Clone, PartialEq, Debug)]
pub struct LowPass(Vec<Section>);

/// Poles of the Chebyshev filter of order 8 with a ripple of 0.05 dB, for a corner of 1 rad/s; one of each pair. With
/// ε² = 10^0.005 − 1 and μ = asinh(1/ε) / 8: −sinh μ sin θ + i cosh μ cos θ, θ = π/16, 3π/16, 5π/16, 7π/16.
const CHEBYSHEV: [(f64, f64); 4] = [
    (-0.072_937_381_856_362_81, 1.047_088_681_793_078),
    (-0.207_708_090_360_470_2, 0.887_678_921_872_614_6),
    (-0.310_857_124_985_723_74, 0.593_128_092_926_518_1),
    (-0.366_680_980_258_756_05, 0.208_278_888_551_906_55),
];
/// Its gain at rest: 1 / √(1 + ε²).
const CHEBYSHEV_AT_REST: f64 = 0.994_260_073_952_956_7;

impl LowPass {
    /// Butterworth, order 4: −3 dB at this part of half the rate, between 0 and 1.
    pub fn butterworth(corner: f64) -> LowPass {
        let pole = |angle: f64| (-elementary(Unary::Cos, angle), elementary(Unary::Sin, angle));
        LowPass::of([FRAC_PI_8, 3.0 * FRAC_PI_8].map(pole).to_vec(), corner, 1.0)
    }

    /// Chebyshev of the first kind, order 8, with a ripple of 0.05 dB below this part of half the rate.
    fn chebyshev(corner: f64) -> LowPass {
        LowPass::of(CHEBYSHEV.to_vec(), corner, CHEBYSHEV_AT_REST)
    }

    /// A low-pass with these poles, one of each pair, scaled to a corner; bilinear transform with prewarping.
    fn of(poles: Vec<(f64, f64)>, corner: f64, gain: f64) -> LowPass {
        assert!(corner > 0.0 && corner < 1.0, "a corner at {corner} of half the rate");
        let warped = elementary(Unary::Tan, 0.5 * PI * corner);
        let section = |(re, im): (f64, f64)| {
            // c / (s² + d s + c) with s = (z − 1) / (z + 1)
            let (c, d) = (warped * warped * (re * re + im * im), -2.0 * warped * re);
            let norm = 1.0 + d + c;
            Section { b: c / norm, a: [2.0 * (c - 1.0) / norm, (1.0 - d + c) / norm] }
        };
        let mut sections: Vec<Section> = poles.into_iter().map(section).collect();
        sections[0].b *= gain;
        LowPass(sections)
    }

    /// Rows by which a recording is continued beyond its ends; it needs more than these.
    fn continued(&self) -> usize {
        CONTINUED * (2 * self.0.len() + 1)
    }

    /// One pass, which starts in the steady state of its first number.
    fn pass(&self, x: &mut [f64]) {
        let Some(first) = x.first().copied() else { return };
        let mut level = first;
        for Section { b, a: [a1, a2] } in &self.0 {
            // Transposed direct form II.
            let gain = 4.0 * b / (1.0 + a1 + a2);
            let (mut s1, mut s2) = (level * (gain - b), level * (b - a2 * gain));
            for x in x.iter_mut() {
                let y = b * *x + s1;
                s1 = 2.0 * b * *x - a1 * y + s2;
                s2 = b * *x - a2 * y;
                *x = y;
            }
            level *= gain;
        }
    }

    /// Forward and backward over equidistant numbers.
    pub fn both_ways(&self, x: &[f64]) -> Vec<f64> {
        let n = x.len();
        let more = self.continued().min(n.saturating_sub(1));
        let Some((first, last)) = x.first().zip(x.last()) else { return Vec::new() };
        let before = (1..=more).rev().map(|k| 2.0 * first - x[k]);
        let after = (1..=more).map(|k| 2.0 * last - x[n - 1 - k]);
        let mut all: Vec<f64> = before.chain(x.iter().copied()).chain(after).collect();
        for _ in 0..2 {
            self.pass(&mut all);
            all.reverse();
        }
        all[more..more + n].to_vec()
    }
}

/// Central differences, one-sided at the ends.
pub fn slope(x: &[f64], interval: f64) -> Vec<f64> {
    let last = x.len() - 1;
    let at = |k: usize| match k {
        _ if last == 0 => f64::NAN,
        0 => (x[1] - x[0]) / interval,
        k if k == last => (x[k] - x[k - 1]) / interval,
        k => (x[k + 1] - x[k - 1]) / (2.0 * interval),
    };
    (0..=last).map(at).collect()
}

/// Every n-th of some rows, after a low-pass below 0.8 of the half of the lower rate.
#[derive(Clone, PartialEq, Debug)]
pub struct Thin {
    /// Of so many rows one is kept.
    pub n: usize,
    /// The usual interval of the rows in s.
    interval: f64,
    filter: LowPass,
}

impl Thin {
    /// For rows at this interval in s.
    pub fn new(n: usize, interval: f64) -> Thin {
        Thin { n, interval, filter: LowPass::chebyshev(0.8 / n as f64) }
    }

    /// Rows that a recording needs between gaps.
    pub fn least(&self) -> usize {
        self.filter.continued() + 1
    }

    /// The rows that are kept of those at these times, in s: the first after each gap, and every n-th from there.
    pub fn kept(&self, times: &[f64]) -> Vec<usize> {
        pieces(times, self.interval).into_iter().flat_map(|piece| piece.step_by(self.n)).collect()
    }

    /// Values at these times, filtered and thinned.
    pub fn of(&self, times: &[f64], values: &[f64]) -> Vec<f64> {
        let one = |piece: Range<usize>| self.filter.both_ways(&values[piece]).into_iter().step_by(self.n);
        pieces(times, self.interval).into_iter().flat_map(one).collect()
    }
}

/// The rows between gaps.
pub fn pieces(times: &[f64], interval: f64) -> Vec<Range<usize>> {
    let gaps = (1..times.len()).filter(|k| times[*k] - times[*k - 1] > GAP * interval);
    let edges: Vec<usize> = std::iter::once(0).chain(gaps).chain([times.len()]).collect();
    edges.windows(2).map(|edge| edge[0]..edge[1]).collect()
}

/// Rows that are not equidistant: the shortest and the longest interval in s, and the row at the end of each, from 0.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Uneven {
    /// The shortest.
    pub shortest: (f64, usize),
    /// The longest that is no gap.
    pub longest: (f64, usize),
}

/// The interval in s of rows that are equidistant but for gaps; at least two.
///
/// # Errors
/// Where they are not.
pub fn interval(times: &[f64]) -> Result<f64, Uneven> {
    assert!(times.len() > 1, "{} rows have no interval", times.len());
    let mut all: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    all.sort_by(f64::total_cmp);
    let usual = all[all.len() / 2];
    let pieces = pieces(times, usual);
    let mean = |piece: &Range<usize>| match piece.len() {
        0 | 1 => usual,
        n => (times[piece.end - 1] - times[piece.start]) / (n - 1) as f64,
    };
    // Times are rounded, and the mean of many intervals is not.
    let longest = pieces.iter().max_by_key(|piece| piece.len()).expect("there are rows");
    let interval = mean(longest);
    let is_even = |piece: &Range<usize>| {
        let own = mean(piece);
        let off = |k: usize| (times[k] - times[piece.start] - (k - piece.start) as f64 * own).abs();
        piece.clone().all(|k| off(k) <= UNEVEN * interval)
            && (own - interval).abs() * (piece.len() as f64 - 1.0).min(1.0) <= UNEVEN * interval
    };
    if pieces.iter().all(is_even) {
        return Ok(interval);
    }
    let rows = pieces.iter().flat_map(|piece| piece.clone().skip(1));
    let of: Vec<(f64, usize)> = rows.map(|k| (times[k] - times[k - 1], k)).collect();
    let ends = |pick: fn(&(f64, usize), &(f64, usize)) -> bool| {
        of.iter().copied().reduce(|a, b| if pick(&b, &a) { b } else { a }).expect("uneven rows have intervals")
    };
    Err(Uneven { shortest: ends(|a, b| a.0 < b.0), longest: ends(|a, b| a.0 > b.0) })
}

/// An elementary function of the language, whose bits are the same on every machine.
fn elementary(function: Unary, x: f64) -> f64 {
    let mut build = Build::new("filter");
    let x = build.real(x);
    let value = build.unary(function, x);
    build.store(Slot(0), value);
    let mut block = [0.0];
    run_once(&crate::math::expand(&build.finish()), &mut block, &crate::math::POOL);
    block[0]
}
