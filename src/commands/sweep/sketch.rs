//! Statistics of a stream of numbers in bounded memory, whose bits do not depend on how the stream was cut.
//!
//! In: the values of a measure, in the order of the runs. Out: moments, quantiles, the outermost values. Counts are added
//! in any order. Sums are not associative, so they are formed in a fixed tree: leaves of 256 runs in order, joined
//! pairwise. The histogram is DDSketch without its logarithm: a bin is the first bits of the number, so merging is exact.
//! Sources: Chan, Golub, LeVeque, Updating Formulae and a Pairwise Algorithm, 1979; Masson, Rim, Lee, DDSketch, 2019.

use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Runs of a leaf, which is summed in order.
pub const LEAF: u64 = 256;
/// How many of the lowest, and of the highest values are kept with their runs.
const OUTERMOST: usize = 16;
/// Bits of a number that its bin drops: all but sign, exponent and nine bits of the fraction.
const DROPPED: u32 = 43;

/// Number, mean and sum of squared distances to it.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Moments {
    number: u64,
    mean: f64,
    square: f64,
}

impl Moments {
    /// Welford's algorithm.
    fn see(&mut self, value: f64) {
        self.number += 1;
        let distance = value - self.mean;
        self.mean += distance / self.number as f64;
        self.square += distance * (value - self.mean);
    }

    /// Of both; Chan's formula.
    fn and(self, other: Moments) -> Moments {
        let number = self.number + other.number;
        match (self.number, other.number) {
            (_, 0) => self,
            (0, _) => other,
            (a, b) => {
                let distance = other.mean - self.mean;
                let share = b as f64 / number as f64;
                Moments {
                    number,
                    mean: self.mean + distance * share,
                    square: self.square + other.square + distance * distance * (a as f64 * share),
                }
            }
        }
    }
}

/// Moments of leaves in their order, joined pairwise: a subtree of height h begins at a multiple of 2^h leaves.
#[derive(Clone, Debug, Default)]
struct Tree {
    /// Subtrees that wait for their right neighbour, each with its height, falling.
    open: Vec<(u32, Moments)>,
}

impl Tree {
    /// Appends a subtree.
    fn push(&mut self, height: u32, moments: Moments) {
        let (mut height, mut moments) = (height, moments);
        while let Some((_, left)) = self.open.pop_if(|(open, _)| *open == height) {
            (height, moments) = (height + 1, left.and(moments));
        }
        self.open.push((height, moments));
    }

    fn moments(&self) -> Moments {
        self.open.iter().rev().fold(Moments::default(), |right, (_, left)| left.and(right))
    }
}

/// The bin of a number that is not NaN. Bins are in the order of the numbers; infinities have bins of their own.
fn bin(value: f64) -> i32 {
    let bits = (value.abs().to_bits() >> DROPPED) as i32;
    // Both zeros are in the first bin of the positive numbers.
    if value < 0.0 { -1 - bits } else { bits }
}

/// The numbers at the ends of a bin.
fn ends(bin: i32) -> (f64, f64) {
    let (low, negative) = if bin < 0 { (-1 - bin, true) } else { (bin, false) };
    let first = |bin: i32| f64::from_bits((bin as u64) << DROPPED);
    let (near, far) = match first(low) {
        infinite if infinite.is_infinite() => (infinite, infinite),
        near => (near, first(low + 1).min(f64::MAX)),
    };
    if negative { (-far, -near) } else { (near, far) }
}

/// The lowest, or the highest values, of equal ones those of the first runs.
#[derive(Clone, Debug)]
struct Outermost {
    highest: bool,
    found: Vec<(f64, u64)>,
}

impl Outermost {
    /// Whether this value is one of them, which it then is.
    fn see(&mut self, value: f64, run: u64) -> bool {
        let before = |(other, at): &(f64, u64)| {
            let order = if self.highest { value.total_cmp(other) } else { other.total_cmp(&value) };
            order.then(at.cmp(&run)).is_lt()
        };
        let at = self.found.partition_point(before);
        if at < OUTERMOST {
            self.found.insert(at, (value, run));
            self.found.truncate(OUTERMOST);
        }
        at < OUTERMOST
    }
}

/// Statistics of one measure.
#[derive(Clone, Debug)]
pub struct Sketch {
    /// Runs seen, also those without a value.
    runs: u64,
    /// The leaf that is being summed.
    leaf: Moments,
    /// Leaves that are complete. Infinite values are in no sum.
    tree: Tree,
    missing: u64,
    not_a_number: u64,
    bins: BTreeMap<i32, u64>,
    low: Outermost,
    high: Outermost,
}

impl Default for Sketch {
    fn default() -> Sketch {
        let outermost = |highest| Outermost { highest, found: Vec::new() };
        Sketch {
            runs: 0,
            leaf: Moments::default(),
            tree: Tree::default(),
            missing: 0,
            not_a_number: 0,
            bins: BTreeMap::new(),
            low: outermost(false),
            high: outermost(true),
        }
    }
}

impl Sketch {
    /// Adds the value of the next run; none if it has no value. Returns whether it is an outermost one.
    pub fn see(&mut self, run: u64, value: Option<f64>) -> bool {
        let mut is_kept = false;
        match value {
            None => self.missing += 1,
            Some(value) if value.is_nan() => self.not_a_number += 1,
            Some(value) => {
                // One zero: the negative one is a matter of rounding.
                let value = value + 0.0;
                if value.is_finite() {
                    self.leaf.see(value);
                }
                *self.bins.entry(bin(value)).or_default() += 1;
                is_kept = self.low.see(value, run) | self.high.see(value, run);
            }
        }
        self.runs += 1;
        if self.runs.is_multiple_of(LEAF) {
            self.tree.push(0, std::mem::take(&mut self.leaf));
        }
        is_kept
    }

    /// The tree of all leaves; the last may have fewer runs. An empty leaf changes no sum.
    fn closed(&self) -> Tree {
        let mut tree = self.tree.clone();
        if !self.runs.is_multiple_of(LEAF) {
            tree.push(0, self.leaf);
        }
        tree
    }

    /// Appends the statistics of the runs that follow. They begin at a multiple of their number of runs, rounded up to a
    /// power of two of leaves: only then the tree is that of the whole.
    pub fn append(&mut self, next: &Sketch) {
        let Sketch { runs, missing, not_a_number, bins, low, high, .. } = next;
        let aligned = runs.div_ceil(LEAF).next_power_of_two() * LEAF;
        assert!(self.runs.is_multiple_of(aligned), "{runs} runs do not follow {}", self.runs);
        next.closed().open.iter().for_each(|(height, moments)| self.tree.push(*height, *moments));
        self.runs += runs;
        self.missing += missing;
        self.not_a_number += not_a_number;
        bins.iter().for_each(|(bin, count)| *self.bins.entry(*bin).or_default() += count);
        low.found.iter().for_each(|(value, run)| _ = self.low.see(*value, *run));
        high.found.iter().for_each(|(value, run)| _ = self.high.see(*value, *run));
    }

    /// The runs of the outermost values.
    pub fn kept(&self) -> impl Iterator<Item = u64> {
        self.low.found.iter().chain(&self.high.found).map(|(_, run)| *run)
    }

    /// Runs of the lowest values, and of the highest.
    pub fn outermost(&self) -> [Vec<u64>; 2] {
        [&self.low, &self.high].map(|kept| kept.found.iter().map(|(_, run)| *run).collect())
    }

    /// Runs without a value, and with one that is not a number.
    pub fn without(&self) -> [u64; 2] {
        [self.missing, self.not_a_number]
    }

    /// Number of values, infinite ones too.
    pub fn number(&self) -> u64 {
        self.bins.values().sum()
    }

    /// Number of infinite values.
    pub fn infinite(&self) -> u64 {
        let ends = [f64::NEG_INFINITY, f64::INFINITY].map(|value| self.bins.get(&bin(value)));
        ends.into_iter().flatten().sum()
    }

    /// Mean and standard deviation of the finite values; NaN of none.
    pub fn moments(&self) -> (f64, f64) {
        let Moments { number, mean, square } = self.closed().moments();
        match number {
            0 => (f64::NAN, f64::NAN),
            number => (mean, (square / (number.max(2) - 1) as f64).sqrt()),
        }
    }

    /// The least value and its run, and the greatest, of the first of such runs; none of no values.
    pub fn extremes(&self) -> Option<[(f64, u64); 2]> {
        Some([*self.low.found.first()?, *self.high.found.first()?])
    }

    /// The value below which this part of all values lies, within 0.1 % of it; NaN of none.
    pub fn quantile(&self, part: f64) -> f64 {
        let Some([(least, _), (greatest, _)]) = self.extremes() else { return f64::NAN };
        let rank = (part * (self.number() - 1) as f64).round() as u64;
        let mut before = 0;
        let found = self.bins.iter().find(|(_, count)| {
            before += **count;
            before > rank
        });
        let (low, high) = found.map_or((greatest, greatest), |(bin, _)| ends(*bin));
        // The first bin has zero, and the smallest of the subnormal numbers.
        let middle = if low == 0.0 || high == 0.0 { 0.0 } else { low + 0.5 * (high - low) };
        let middle = if low == high { low } else { middle };
        middle.clamp(least, greatest)
    }

    /// The bins: their ends and counts.
    pub fn histogram(&self) -> impl Iterator<Item = (f64, f64, u64)> {
        self.bins.iter().map(|(bin, count)| (ends(*bin).0, ends(*bin).1, *count))
    }

    /// For another process; see [`Sketch::read`].
    pub fn written(&self) -> Value {
        // JSON in decimal might cost bits.
        let kept = |kept: &Outermost| kept.found.iter().map(|(x, run)| json!([x.to_bits(), run])).collect::<Vec<_>>();
        let tree = self.closed().open;
        let moments = |(height, m): &(u32, Moments)| json!([height, m.number, m.mean.to_bits(), m.square.to_bits()]);
        json!([
            self.runs,
            tree.iter().map(moments).collect::<Vec<_>>(),
            self.missing,
            self.not_a_number,
            self.bins.iter().map(|(bin, count)| json!([bin, count])).collect::<Vec<_>>(),
            kept(&self.low),
            kept(&self.high),
        ])
    }

    /// None if it is not that of so many runs, as it was written.
    pub fn read(value: &Value, number: u64) -> Option<Sketch> {
        let [runs, tree, missing, not_a_number, bins, low, high] = value.as_array()?.as_slice() else { return None };
        let bits = |value: &Value| value.as_u64().map(f64::from_bits);
        let mut sketch = Sketch {
            runs: runs.as_u64().filter(|runs| *runs == number)?,
            missing: missing.as_u64()?,
            not_a_number: not_a_number.as_u64()?,
            ..Sketch::default()
        };
        for one in tree.as_array()? {
            let [height, count, mean, square] = one.as_array()?.as_slice() else { return None };
            let moments = Moments { number: count.as_u64()?, mean: bits(mean)?, square: bits(square)? };
            sketch.tree.open.push((height.as_u64()?.try_into().ok()?, moments));
        }
        for one in bins.as_array()? {
            let [bin, count] = one.as_array()?.as_slice() else { return None };
            sketch.bins.insert(bin.as_i64()?.try_into().ok()?, count.as_u64()?);
        }
        for (kept, all) in [(&mut sketch.low, low), (&mut sketch.high, high)] {
            for one in all.as_array()? {
                let [value, run] = one.as_array()?.as_slice() else { return None };
                kept.found.push((bits(value)?, run.as_u64()?));
            }
        }
        Some(sketch)
    }
}

#[cfg(test)]
#[allow(clippy::print_stdout, reason = "the seed, and what was found")]
mod tests {
    use super::*;
    use runtime::rng::Chance;

    fn seed() -> u64 {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
        println!("FRIC_SEED={seed}");
        seed
    }

    /// A value of one of several kinds: heavy tails over all exponents, a narrow band, zeros, infinities, one constant, few
    /// values, subnormal numbers, one far from 0 with little scatter.
    fn value(chance: &mut Chance, kind: u64) -> Option<f64> {
        let sign = if chance.below(2) == 0 { 1.0 } else { -1.0 };
        let any = f64::from_bits(chance.number());
        match (kind, chance.below(20)) {
            (0, 0) => None,
            (0, 1) => Some(f64::NAN),
            (0, 2) => Some(sign * f64::INFINITY),
            (0, 3) => Some(sign * 0.0),
            (0, _) => Some(any),
            (1, _) => Some(chance.between(0.9, 1.1)),
            (2, 0..15) => Some(sign * 0.0),
            (2, _) => Some(chance.between(-1.0, 1.0)),
            (3, 0..7) => Some(sign * f64::INFINITY),
            (3, _) => {
                let small = chance.fraction();
                Some(sign / (small * small * small))
            }
            (4, _) => Some(-0.1),
            (5, k) => Some(k as f64 - 10.0),
            (6, _) => Some(sign * f64::MIN_POSITIVE * chance.fraction()),
            (7, _) => Some(1e9 + chance.fraction()),
            (8, _) => None,
            _ => {
                let large = chance.fraction().recip();
                Some(sign * large * large.sqrt())
            }
        }
    }

    const KINDS: u64 = 10;

    fn of(values: &[Option<f64>], first: usize) -> Sketch {
        let mut sketch = Sketch::default();
        values.iter().enumerate().for_each(|(k, value)| _ = sketch.see((first + k) as u64, *value));
        sketch
    }

    /// All that a sketch tells, with numbers as bits.
    fn told(sketch: &Sketch) -> String {
        let (mean, deviation) = sketch.moments();
        let quantiles: Vec<u64> = (0..=20).map(|k| sketch.quantile(f64::from(k) / 20.0).to_bits()).collect();
        let ends = sketch.extremes().map(|ends| ends.map(|(value, run)| (value.to_bits(), run)));
        format!(
            "{:x} {:x} {quantiles:?} {ends:?} {:?} {:?} {} {} {:?}",
            mean.to_bits(),
            deviation.to_bits(),
            sketch.outermost(),
            sketch.without(),
            sketch.infinite(),
            sketch.number(),
            sketch.histogram().collect::<Vec<_>>()
        )
    }

    /// However the runs are cut into blocks that begin at multiples of their size, and also through text. Mutants tried:
    /// leaves joined as they come, `append` without the tree's heights, the last leaf forgotten, of equal outermost values
    /// those of later runs, moments in decimal.
    #[test]
    fn a_cut_changes_no_bit() {
        let mut chance = Chance(seed());
        for kind in (0..KINDS).cycle().take(60) {
            let values: Vec<Option<f64>> = (0..chance.below(9000)).map(|_| value(&mut chance, kind)).collect();
            let whole = told(&of(&values, 0));
            let block = (LEAF << chance.below(6)) as usize;
            let mut joined = Sketch::default();
            for (k, part) in values.chunks(block).enumerate() {
                let part = of(part, k * block);
                let text = part.written().to_string();
                let read = Sketch::read(&serde_json::from_str(&text).unwrap(), part.runs).unwrap();
                assert_eq!(told(&read), told(&part), "kind {kind}");
                joined.append(&read);
            }
            assert!(told(&joined) == whole, "kind {kind}, {} values in blocks of {block}", values.len());
        }
    }

    /// Against the sorted values and sums of twice the precision. Mutants tried: eight bits of the fraction for nine, the
    /// lower end of a bin for its middle, ranks from 1, negative bins without their order, infinities in the sums,
    /// Welford's sum with the old mean in both factors.
    #[test]
    fn statistics_are_those_of_the_values() {
        let mut chance = Chance(seed());
        let mut worst: f64 = 0.0;
        for kind in (0..KINDS).cycle().take(80) {
            let values: Vec<Option<f64>> = (0..1 + chance.below(5000)).map(|_| value(&mut chance, kind)).collect();
            let sketch = of(&values, 0);
            let mut sorted: Vec<(f64, u64)> = (0..).zip(&values).filter_map(|(k, x)| Some(((*x)? + 0.0, k))).collect();
            sorted.retain(|(value, _)| !value.is_nan());
            sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let missing = values.iter().filter(|value| value.is_none()).count() as u64;
            let all = values.len() as u64;
            assert_eq!(sketch.without(), [missing, all - missing - sorted.len() as u64]);
            assert_eq!(sketch.number(), sorted.len() as u64);
            assert_eq!(sketch.infinite(), sorted.iter().filter(|(value, _)| value.is_infinite()).count() as u64);
            let [low, mut high] = [sorted.clone(), sorted.clone()];
            high.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let runs = |kept: &[(f64, u64)]| kept.iter().take(OUTERMOST).map(|kept| kept.1).collect::<Vec<_>>();
            assert_eq!(sketch.outermost(), [runs(&low), runs(&high)], "kind {kind}");
            assert_eq!(sketch.extremes(), low.first().map(|least| [*least, high[0]]));
            for part in [0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0] {
                let found = sketch.quantile(part);
                let Some(last) = sorted.len().checked_sub(1) else {
                    assert!(found.is_nan());
                    continue;
                };
                let exact = sorted[(part * last as f64).round() as usize].0;
                // The bins of subnormal numbers have one width.
                let near = exact == found || (found - exact).abs() <= 0.001 * exact.abs() + f64::MIN_POSITIVE / 512.0;
                assert!(near, "kind {kind}, {part}: {found} for {exact}");
                if exact.is_normal() {
                    worst = worst.max((found - exact).abs() / exact.abs());
                }
            }
            // Sums that do not overflow.
            let finite: Vec<f64> = sorted.iter().map(|kept| kept.0).filter(|value| value.is_finite()).collect();
            let greatest = finite.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
            let (mean, deviation) = sketch.moments();
            if finite.is_empty() {
                assert!(mean.is_nan() && deviation.is_nan());
            } else if greatest < 1e150 {
                let exact = double_sum(finite.iter().copied()) / finite.len() as f64;
                assert!((mean - exact).abs() <= 1e-13 * greatest, "kind {kind}: mean {mean}, exact {exact}");
                let squares = double_sum(finite.iter().map(|value| (value - exact) * (value - exact)));
                let exact = (squares / (finite.len().max(2) - 1) as f64).sqrt();
                assert!(
                    (deviation - exact).abs() <= 1e-12 * exact + 1e-15 * greatest,
                    "kind {kind}: {deviation}, {exact}"
                );
            }
        }
        println!("quantiles within {worst:.2e}");
        assert!(worst < 1e-3);
    }

    /// Neumaier's sum.
    fn double_sum(values: impl Iterator<Item = f64>) -> f64 {
        let (sum, rest) = values.fold((0.0_f64, 0.0), |(sum, rest), value| {
            let next = sum + value;
            let lost = if sum.abs() >= value.abs() { (sum - next) + value } else { (value - next) + sum };
            (next, rest + lost)
        });
        sum + rest
    }

    #[test]
    fn bins_cover_the_numbers_in_order_and_are_narrow() {
        let mut chance = Chance(seed());
        for _ in 0..20_000 {
            let value = f64::from_bits(chance.number());
            if value.is_nan() {
                continue;
            }
            let (low, high) = ends(bin(value));
            assert!(low <= value && value <= high, "{value} in {low} .. {high}");
            assert!(!value.is_normal() || high - low <= value.abs() / 512.0, "{value} in {low} .. {high}");
            let other = f64::from_bits(chance.number());
            assert!(other.is_nan() || (bin(value) <= bin(other)) || value > other, "{value} {other}");
        }
        assert_eq!([0.0, -0.0, f64::INFINITY].map(bin), [0, 0, 0x7ff << 9]);
        assert_eq!(ends(bin(f64::NEG_INFINITY)), (f64::NEG_INFINITY, f64::NEG_INFINITY));
        assert_eq!(ends(bin(f64::MAX)).1, f64::MAX);
    }
}
