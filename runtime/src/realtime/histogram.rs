//! Histogram of times in fixed logarithmic bins, cheap enough for every cycle of a loop.
//!
//! In: nanoseconds. Out: counts, extremes, quantiles. Never allocates.

/// Upper edge of the first bin.
const FIRST_NS: u64 = 100;

/// Bins per octave: adjacent edges differ by 9 %.
const PER_OCTAVE: usize = 8;

/// From 100 ns to 107 s.
const OCTAVES: usize = 30;

/// One bin below 100 ns, those of the octaves, one above.
const BINS: usize = 1 + OCTAVES * PER_OCTAVE + 1;

/// 2^(1/8) … 2^(7/8) in units of 2⁻¹⁶: edges of the bins in an octave.
const EDGES: [u64; PER_OCTAVE - 1] = [71_468, 77_936, 84_990, 92_682, 101_070, 110_218, 120_194];

/// Number of times in each bin, and exact extremes.
#[derive(Clone, PartialEq, Eq)]
pub struct Histogram {
    bins: [u64; BINS],
    count: u64,
    sum_ns: u128,
    min_ns: u64,
    max_ns: u64,
}

impl Default for Histogram {
    fn default() -> Histogram {
        Histogram::new()
    }
}

impl Histogram {
    /// An empty histogram.
    pub const fn new() -> Histogram {
        Histogram { bins: [0; BINS], count: 0, sum_ns: 0, min_ns: u64::MAX, max_ns: 0 }
    }

    /// Counts a time: some ten instructions.
    pub fn count(&mut self, ns: u64) {
        self.bins[bin(ns)] += 1;
        self.count += 1;
        self.sum_ns += u128::from(ns);
        self.min_ns = self.min_ns.min(ns);
        self.max_ns = self.max_ns.max(ns);
    }

    /// Number of counted times.
    pub fn total(&self) -> u64 {
        self.count
    }

    /// The longest time, exact; 0 if empty.
    pub fn max_ns(&self) -> u64 {
        self.max_ns
    }

    /// The shortest time, exact; 0 if empty.
    pub fn min_ns(&self) -> u64 {
        if self.count == 0 { 0 } else { self.min_ns }
    }

    /// The mean; 0 if empty.
    pub fn mean_ns(&self) -> u64 {
        (self.sum_ns / u128::from(self.count.max(1))) as u64
    }

    /// The quantile of a fraction, 0 to 1: the upper edge of its bin, so never too low, and at most 9 % too high. 0 if
    /// empty.
    pub fn quantile_ns(&self, fraction: f64) -> u64 {
        let rank = (fraction * self.count as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        let reached = self.bins.iter().position(|&count| {
            seen += count;
            seen >= rank
        });
        reached.map_or(self.max_ns, |bin| upper_ns(bin).min(self.max_ns))
    }

    /// Lower edge, upper edge and count of each bin that is not empty.
    pub fn bins(&self) -> impl Iterator<Item = (u64, u64, u64)> {
        let lower = |bin: usize| if bin == 0 { 0 } else { upper_ns(bin - 1) };
        let counted = self.bins.iter().enumerate().filter(|(_, count)| **count > 0);
        counted.map(move |(bin, &count)| (lower(bin), upper_ns(bin), count))
    }

    /// Adds the counts of another histogram.
    pub fn add(&mut self, other: &Histogram) {
        self.bins.iter_mut().zip(other.bins).for_each(|(mine, theirs)| *mine += theirs);
        self.count += other.count;
        self.sum_ns += other.sum_ns;
        self.min_ns = self.min_ns.min(other.min_ns);
        self.max_ns = self.max_ns.max(other.max_ns);
    }
}

/// Index of the bin of a time.
fn bin(ns: u64) -> usize {
    if ns < FIRST_NS {
        return 0;
    }
    let octave = (ns / FIRST_NS).ilog2() as usize;
    if octave >= OCTAVES {
        return BINS - 1;
    }
    let ratio = (ns << 16) / (FIRST_NS << octave);
    1 + octave * PER_OCTAVE + EDGES.iter().filter(|&&edge| edge <= ratio).count()
}

/// Upper edge of a bin; the last one has none.
fn upper_ns(bin: usize) -> u64 {
    let (octave, part) = (bin / PER_OCTAVE, bin % PER_OCTAVE);
    match part {
        _ if bin == BINS - 1 => u64::MAX,
        0 => FIRST_NS << octave,
        // The first whole nanosecond of the next bin.
        part => (EDGES[part - 1] * (FIRST_NS << octave)).div_ceil(1 << 16),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eight_bins_to_an_octave() {
        for (part, edge) in (1..).zip(EDGES) {
            assert_eq!(edge, (65536.0 * 2f64.powf(part as f64 / 8.0)).round() as u64);
        }
        for at in 0..BINS - 1 {
            let end = upper_ns(at);
            assert_eq!((bin(end - 1), bin(end)), (at, at + 1), "the bin that ends at {end} ns");
        }
        assert_eq!((bin(0), bin(u64::MAX)), (0, BINS - 1));
    }

    #[test]
    fn quantiles_are_never_too_good() {
        let mut histogram = Histogram::new();
        (1..=1000).for_each(|k| histogram.count(k * 100));
        for fraction in [0.001, 0.1, 0.5, 0.9, 0.999, 1.0] {
            let (true_ns, said_ns) = ((fraction * 1000.0_f64).ceil() * 100.0, histogram.quantile_ns(fraction) as f64);
            assert!((true_ns..=1.0906 * true_ns + 1.0).contains(&said_ns), "{fraction}: {true_ns} told as {said_ns}");
        }
        assert_eq!((histogram.min_ns(), histogram.mean_ns(), histogram.max_ns()), (100, 50_050, 100_000));
        assert_eq!(histogram.bins().map(|(_, _, count)| count).sum::<u64>(), 1000);
    }

    #[test]
    fn all_values_of_an_empty_histogram_are_zero() {
        let none = Histogram::new();
        assert_eq!((none.quantile_ns(0.5), none.min_ns(), none.mean_ns(), none.max_ns()), (0, 0, 0, 0));
    }

    #[test]
    fn two_add_up() {
        let (mut both, mut a, mut b) = (Histogram::new(), Histogram::new(), Histogram::new());
        for (k, ns) in [5, 700, 12_345, 99, 1_000_000_000].into_iter().enumerate() {
            both.count(ns);
            if k % 2 == 0 { a.count(ns) } else { b.count(ns) }
        }
        a.add(&b);
        assert!(a == both);
    }
}
