//! Consecutive points of a run, column by column: measures add many points at once, with the bits of one after the other.
//!
//! In: times and columns. Out: views of them. Knows neither measures nor solvers.

use abi::Slot;

/// Compiles a function for vectors of four numbers too, which it takes where the processor has them. The bits are the same:
/// nothing is fused or reordered.
macro_rules! in_vectors {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),*) $(-> $result:ty)? $body:block) => {
        $(#[$doc])*
        $vis fn $name($($arg: $type),*) $(-> $result)? {
            #[inline(always)]
            fn any($($arg: $type),*) $(-> $result)? $body
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($arg: $type),*) $(-> $result)? {
                    any($($arg),*)
                }
                if std::is_x86_feature_detected!("avx2") {
                    // SAFETY: the processor has the vectors.
                    return unsafe { wide($($arg),*) };
                }
            }
            any($($arg),*)
        }
    };
}
pub(crate) use in_vectors;

/// Points in order of time.
#[derive(Default)]
pub(crate) struct Stretch {
    /// In s.
    times: Vec<f64>,
    slots: Vec<Slot>,
    /// Column by column, SI.
    values: Vec<f64>,
    /// Of each column.
    bounds: Vec<Bounds>,
    is_finite: bool,
}

/// The least and the greatest of some values, SI; ∞ and −∞ of none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) least: f64,
    pub(crate) greatest: f64,
}

impl Bounds {
    /// The greatest magnitude.
    pub(crate) fn magnitude(self) -> f64 {
        self.least.abs().max(self.greatest.abs())
    }
}

impl Stretch {
    /// Replaces the points by so many. `times` writes their times, `column` the values of the slot with a given number.
    pub(crate) fn fill(
        &mut self,
        len: usize,
        times: &dyn Fn(&mut [f64]),
        slots: &[Slot],
        column: &dyn Fn(usize, &mut [f64]),
    ) {
        self.times.resize(len, 0.0);
        times(&mut self.times);
        self.slots.clear();
        self.slots.extend(slots);
        self.values.resize(len * slots.len(), 0.0);
        self.bounds.clear();
        self.is_finite = true;
        for k in 0..slots.len() {
            let values = &mut self.values[k * len..][..len];
            column(k, values);
            let (bounds, is_finite) = bounds(values);
            self.bounds.push(bounds);
            self.is_finite &= is_finite;
        }
    }

    /// Number of points.
    pub(crate) fn len(&self) -> usize {
        self.times.len()
    }

    /// Times in s.
    pub(crate) fn times(&self) -> &[f64] {
        &self.times
    }

    /// The values of a slot, SI.
    ///
    /// # Panics
    /// If the stretch does not have it: a bug in the caller.
    pub(crate) fn column(&self, slot: Slot) -> &[f64] {
        if slot == Slot::TIME { &self.times } else { &self.values[self.place(slot) * self.len()..][..self.len()] }
    }

    /// The bounds of that column, if all its values are finite.
    ///
    /// # Panics
    /// As [`column`](Stretch::column).
    pub(crate) fn bounds(&self, slot: Slot) -> Bounds {
        if slot == Slot::TIME { bounds(&self.times).0 } else { self.bounds[self.place(slot)] }
    }

    fn place(&self, slot: Slot) -> usize {
        self.slots.iter().position(|known| *known == slot).expect("a column for each slot that is read")
    }

    /// Writes the values of one point to a block, but not its time.
    pub(crate) fn write(&self, point: usize, block: &mut [f64]) {
        for (slot, column) in self.slots.iter().zip(self.values.chunks_exact(self.len())) {
            block[slot.index()] = column[point];
        }
    }

    /// Whether all values are finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.is_finite
    }
}

/// Copies one column of rows: every `stride`-th number of `rows`, which begin with the first of the column.
pub(crate) fn copy_column(rows: &[f64], stride: usize, column: &mut [f64]) {
    for (to, value) in column.iter_mut().zip(rows.iter().step_by(stride)) {
        *to = *value;
    }
}

in_vectors! {
    /// Writes the products of a step and the counts from `first` on.
    pub(crate) fn multiples(first: f64, step: f64, to: &mut [f64]) {
        // Vectors convert 32 bits.
        to.iter_mut().zip(0_u32..).for_each(|(to, count)| *to = (first + f64::from(count)) * step);
    }
}

in_vectors! {
    /// The bounds of some values, and whether all are finite; if not, the bounds mean nothing.
    fn bounds(values: &[f64]) -> (Bounds, bool) {
        // Order and grouping do not matter, so that there may be eight partial results.
        let (mut least, mut greatest, mut zero) = ([f64::INFINITY; 8], [f64::NEG_INFINITY; 8], [0.0; 8]);
        let (eights, rest) = values.as_chunks::<8>();
        let mut see = |k: usize, value: f64| {
            least[k] = if value < least[k] { value } else { least[k] };
            greatest[k] = if value > greatest[k] { value } else { greatest[k] };
            // Zero times a value is zero unless the value is infinite or not a number.
            zero[k] += 0.0 * value;
        };
        for eight in eights {
            (0..8).for_each(|k| see(k, eight[k]));
        }
        rest.iter().enumerate().for_each(|(k, value)| see(k, *value));
        let least = least.into_iter().fold(f64::INFINITY, f64::min);
        let greatest = greatest.into_iter().fold(f64::NEG_INFINITY, f64::max);
        (Bounds { least, greatest }, zero.into_iter().sum::<f64>() == 0.0)
    }
}

in_vectors! {
    /// The index of the first value that equals one of them.
    ///
    /// # Panics
    /// If none does.
    pub(crate) fn first(values: &[f64], one: f64) -> usize {
        let lacks = |block: &[f64]| block.iter().fold(true, |lacks, value| lacks & (*value != one));
        let begin = 16 * values.chunks_exact(16).take_while(|block| lacks(block)).count();
        begin + values[begin..].iter().position(|value| *value == one).expect("it is one of them")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;
    use crate::run::measure::Expectations;
    use crate::run::verdict::Verdict;
    use crate::testing::generated::{hold, seeds, shrunk};
    use abi::plan::{Edge, Expect, Formula, Measure, MeasureKind, Moment, Window};
    use abi::unit::Unit;

    const VALUE: Slot = Slot(3);
    const OTHER: Slot = Slot(4);
    const SIZE: usize = 5;

    /// A measure, the points that it sees (time, value, condition), and how many of them it sees at once.
    #[derive(Clone, Debug, PartialEq)]
    struct Case {
        kind: MeasureKind,
        window: Window,
        bounds: (f64, f64),
        points: Vec<(f64, f64, f64)>,
        cuts: Vec<usize>,
    }

    const KINDS: [MeasureKind; 24] = [
        MeasureKind::Min,
        MeasureKind::Max,
        MeasureKind::Mean,
        MeasureKind::Rms,
        MeasureKind::Integral,
        MeasureKind::Final,
        MeasureKind::At(0.25),
        MeasureKind::PeakToPeak,
        MeasureKind::Crossings,
        MeasureKind::Period,
        MeasureKind::Settling(0.3),
        MeasureKind::First,
        MeasureKind::Rises,
        MeasureKind::Turns,
        MeasureKind::AtMoment(Moment::First(OTHER)),
        MeasureKind::AtMoment(Moment::Rises(OTHER)),
        MeasureKind::AtMoment(Moment::Least(OTHER)),
        MeasureKind::AtMoment(Moment::Greatest(OTHER)),
        MeasureKind::TimeOfLeast,
        MeasureKind::TimeOfGreatest,
        MeasureKind::Count,
        MeasureKind::Duration,
        MeasureKind::Peaks,
        MeasureKind::Peak(1.0),
    ];

    fn case(seed: u64) -> Case {
        let mut chance = Chance(seed);
        let mut below = |n: usize| chance.below(n as u64) as usize;
        let steps = 1 + below(120);
        let (h, kind, shape) = (1.0 / 128.0, KINDS[below(KINDS.len())], below(4));
        let mut value = 0.0;
        let points = (0..steps).map(|k| {
            let jitter = below(1000) as f64 / 1000.0 - 0.5;
            value = match shape {
                // Repeated extremes and zeros of both signs.
                0 => [-1.0, -0.0, 0.0, 1.0][below(4)],
                1 => value + jitter,
                2 => (0.3 * k as f64).sin(),
                _ => k as f64 * [1.0, -1.0][steps % 2],
            };
            // Now and then an event, or an uneven step.
            let t = (k as f64 - f64::from(below(20) == 0)) * h;
            (t, value, f64::from(below(5) == 0))
        });
        let mut points: Vec<_> = points.collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let cuts = (0..steps).map(|_| 1 + below([2, 40, 200][shape % 3])).collect();
        let edge = |n: usize, at: f64| match n {
            0 => Edge::First(OTHER),
            1 => Edge::At(at),
            _ => Edge::Open,
        };
        let window = Window { after: edge(below(8), 0.1), before: edge(below(8), 0.6) };
        let bounds = [(0.0, f64::INFINITY), (0.2, 0.7), (0.125, 0.5)][below(3)];
        Case { kind, window, bounds, points, cuts }
    }

    fn verdicts(case: &Case, see: impl FnOnce(&mut Expectations)) -> Vec<Verdict> {
        let unit = Unit::parse("m").expect("it is one");
        let measure = Measure { text: "m".into(), kind: case.kind, slot: VALUE, unit, window: case.window };
        let (after, before) = case.bounds;
        let expect =
            Expect { text: "m".into(), measures: vec![measure], condition: Formula::Measure(0), after, before };
        let mut expectations = Expectations::new(&[expect]);
        see(&mut expectations);
        expectations.verdicts()
    }

    /// Whether points at once give what they give one after the other, to the bit.
    fn agrees(case: &Case) -> Result<(), String> {
        let block = |&(t, v, other): &(f64, f64, f64)| {
            let mut block = [0.0; SIZE];
            (block[Slot::TIME.index()], block[VALUE.index()], block[OTHER.index()]) = (t, v, other);
            block
        };
        let one_by_one = verdicts(case, |all| case.points.iter().for_each(|point| all.see(point.0, &block(point))));
        let at_once = verdicts(case, |all| {
            let (mut rest, mut stretch) = (&case.points[..], Stretch::default());
            for cut in &case.cuts {
                let (points, later) = rest.split_at((*cut).min(rest.len()));
                let column = |slot: usize, to: &mut [f64]| {
                    for (to, point) in to.iter_mut().zip(points) {
                        *to = [point.1, point.2][slot];
                    }
                };
                let times = |to: &mut [f64]| to.iter_mut().zip(points).for_each(|(to, point)| *to = point.0);
                stretch.fill(points.len(), &times, &[VALUE, OTHER], &column);
                all.see_stretch(&stretch);
                rest = later;
            }
            rest.iter().for_each(|point| all.see(point.0, &block(point)));
        });
        // Equal text means equal bits, of zeros too.
        let [one_by_one, at_once] = [one_by_one, at_once].map(|all| format!("{all:?}"));
        if one_by_one == at_once { Ok(()) } else { Err(format!("\n{one_by_one}\n{at_once}")) }
    }

    #[test]
    fn points_at_once_give_the_bits_of_one_after_the_other() {
        let simpler = |case: &Case| {
            let without = |k: usize| {
                let mut points = case.points.clone();
                points.remove(k);
                Case { points, ..case.clone() }
            };
            (0..case.points.len()).map(without).collect()
        };
        let failed = hold(seeds(4000), case, agrees, |case, why| shrunk(case, why, simpler, agrees), |()| ());
        assert!(failed.is_empty(), "{failed:?}");
    }

    #[test]
    fn a_value_that_is_not_finite_shows_wherever_it_stands() {
        for (len, bad) in [(1, 0), (8, 7), (17, 16), (64, 40)] {
            for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut stretch = Stretch::default();
                stretch.fill(len, &|times| multiples(0.0, 1.0, times), &[VALUE], &|_, to| to.fill(f64::MAX));
                assert!(stretch.is_finite());
                stretch.fill(len, &|times| multiples(0.0, 1.0, times), &[VALUE], &|_, to| to[bad] = value);
                assert!(!stretch.is_finite(), "{value} at {bad} of {len}");
            }
        }
    }
}
