//! Consecutive points of a run, column by column: measures add many points at once, with the bits of one after the other.
//!
//! In: times and columns. Out: views of them. Knows neither measures nor solvers.

use abi::Slot;

/// Points in order of time.
#[derive(Default)]
pub(crate) struct Stretch {
    /// In s.
    times: Vec<f64>,
    slots: Vec<Slot>,
    /// Column by column, SI.
    values: Vec<f64>,
}

impl Stretch {
    /// Replaces the points by those at these times. `column` writes the values of the slot with a given number.
    pub(crate) fn fill(
        &mut self,
        times: impl Iterator<Item = f64>,
        slots: &[Slot],
        column: &dyn Fn(usize, &mut [f64]),
    ) {
        self.times.clear();
        self.times.extend(times);
        self.slots.clear();
        self.slots.extend(slots);
        let len = self.times.len();
        self.values.resize(len * slots.len(), 0.0);
        for k in 0..slots.len() {
            column(k, &mut self.values[k * len..][..len]);
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
        if slot == Slot::TIME {
            return &self.times;
        }
        let at = self.slots.iter().position(|known| *known == slot);
        &self.values[at.expect("a column for each slot that is read") * self.len()..][..self.len()]
    }

    /// Writes the values of one point to a block, but not its time.
    pub(crate) fn write(&self, point: usize, block: &mut [f64]) {
        for (slot, column) in self.slots.iter().zip(self.values.chunks_exact(self.len())) {
            block[slot.index()] = column[point];
        }
    }

    /// Whether all values are finite.
    pub(crate) fn is_finite(&self) -> bool {
        // Zero times a value is zero unless the value is infinite or not a number.
        reduced(&self.values, 0.0, |value| 0.0 * value, |sum, zero| sum + zero) == 0.0
    }
}

/// Copies one column of rows: every `stride`-th number of `rows`, which begin with the first of the column.
pub(crate) fn copy_column(rows: &[f64], stride: usize, column: &mut [f64]) {
    for (to, value) in column.iter_mut().zip(rows.iter().step_by(stride)) {
        *to = *value;
    }
}

/// The greatest `of` some finite values, −∞ of none.
pub(crate) fn greatest(values: &[f64], of: impl Fn(f64) -> f64) -> f64 {
    reduced(values, f64::NEG_INFINITY, of, |most, value| if value > most { value } else { most })
}

/// Combines what is `of` each value, where order and grouping do not matter: in eight partial results, as vectors compute
/// them.
fn reduced(values: &[f64], none: f64, of: impl Fn(f64) -> f64, add: impl Fn(f64, f64) -> f64) -> f64 {
    let mut all = [none; 8];
    let (eights, rest) = values.as_chunks::<8>();
    for eight in eights {
        for (one, value) in all.iter_mut().zip(eight) {
            *one = add(*one, of(*value));
        }
    }
    for (one, value) in all.iter_mut().zip(rest) {
        *one = add(*one, of(*value));
    }
    all.into_iter().fold(none, add)
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
                stretch.fill(points.iter().map(|point| point.0), &[VALUE, OTHER], &column);
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
                stretch.fill((0..len).map(|k| k as f64), &[VALUE], &|_, to| to.fill(f64::MAX));
                assert!(stretch.is_finite());
                stretch.fill((0..len).map(|k| k as f64), &[VALUE], &|_, to| to[bad] = value);
                assert!(!stretch.is_finite(), "{value} at {bad} of {len}");
            }
        }
    }
}
