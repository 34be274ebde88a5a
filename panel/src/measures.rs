//! What `expect` would measure between two instants, and where a curve passes a level.
//!
//! In: the points of a curve. Out: the measures of the language, by the same code as those of a run; the first crossing
//! of a level.

use abi::Slot;
use abi::plan::{Expect, Formula, Measure, MeasureKind, Window};
use abi::unit::Unit;
use runtime::run::measure::Expectations;

/// The measures, in the order in which the page gets them.
pub const MEASURES: [(&str, MeasureKind); 6] = [
    ("min", MeasureKind::Min),
    ("max", MeasureKind::Max),
    ("mean", MeasureKind::Mean),
    ("rms", MeasureKind::Rms),
    ("peak_to_peak", MeasureKind::PeakToPeak),
    ("period", MeasureKind::Period),
];

/// Calls the function with each point of a curve in the order of time, until it returns false.
pub type Points<'a> = &'a mut dyn FnMut(&mut dyn FnMut(f64, f64) -> bool);

/// The measures from one instant to another, s; none for those that these points do not have. Gaps are left out.
pub fn measures(points: Points, from: f64, to: f64) -> [Option<f64>; MEASURES.len()] {
    let expects = MEASURES.map(|(text, kind)| Expect {
        text: text.into(),
        measures: vec![Measure {
            text: text.into(),
            kind,
            slot: Slot(0),
            unit: Unit::none(),
            window: Window::default(),
        }],
        condition: Formula::Number(1.0),
        after: from,
        before: to,
    });
    let mut measured = Expectations::new(&expects);
    let mut seen = 0_u64;
    points(&mut |t, value| {
        if value.is_finite() {
            measured.see(t, &[value]);
            seen += u64::from((from..=to).contains(&t));
        }
        t <= to
    });
    if seen < 2 {
        return [None; MEASURES.len()];
    }
    let verdicts = measured.verdicts();
    std::array::from_fn(|at| {
        let verdict = &verdicts[at];
        verdict.readings.first().map(|reading| reading.value).filter(|value| value.is_finite())
    })
}

/// The time after `after` at which a curve first reaches a level from below (`rises`) or from above; a gap is not
/// crossed.
pub fn crossing(points: Points, rises: bool, level: f64, after: f64) -> Option<f64> {
    let sign = if rises { 1.0 } else { -1.0 };
    let (mut before, mut found) = (f64::NAN, None);
    points(&mut |t, value| {
        let over = sign * (value - level);
        if t > after && before < 0.0 && over >= 0.0 {
            found = Some(t);
        }
        before = over;
        found.is_none()
    });
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(points: &[(f64, f64)]) -> impl FnMut(&mut dyn FnMut(f64, f64) -> bool) + '_ {
        move |each| {
            for (t, y) in points {
                if !each(*t, *y) {
                    return;
                }
            }
        }
    }

    /// A sine of random size, mean, period and window against its closed forms.
    #[test]
    fn measures_of_a_sine_are_those_of_its_formula() {
        let mut state = 1_u64;
        let mut between = |low: f64, high: f64| {
            let number = abi::random::next(&mut state) >> 11;
            low + (high - low) * number as f64 / (1_u64 << 53) as f64
        };
        for case in 1..=200 {
            let (size, mean, period) = (between(0.1, 5.0), between(-3.0, 3.0), between(0.2, 2.0));
            let from = between(0.0, 3.0);
            // Whole periods, so that mean and rms have closed forms.
            let to = from + 5.0 * period;
            let points: Vec<(f64, f64)> = (0..20_000)
                .map(|k| {
                    let t = f64::from(k) * 1e-3;
                    #[allow(clippy::disallowed_methods, reason = "the closed form of a test")]
                    let sine = (2.0 * std::f64::consts::PI * t / period).sin();
                    (t, mean + size * sine)
                })
                .collect();
            let found = measures(&mut of(&points), from, to);
            let rms = (mean * mean + 0.5 * size * size).sqrt();
            let wanted = [mean - size, mean + size, mean, rms, 2.0 * size, period];
            for ((name, _), (found, wanted)) in MEASURES.iter().zip(found.iter().zip(wanted)) {
                let found = found.unwrap_or(f64::NAN);
                assert!(
                    (found - wanted).abs() < 2e-3 * (size + mean.abs()),
                    "case {case}: {name} {found}, not {wanted}"
                );
            }
        }
    }

    #[test]
    fn too_few_points_have_no_measures_and_too_few_periods_no_period() {
        let ramp: Vec<(f64, f64)> = (0..100).map(|k| (f64::from(k), f64::from(k))).collect();
        assert_eq!(measures(&mut of(&ramp), 200.0, 300.0), [None; 6]);
        assert_eq!(measures(&mut of(&ramp), 10.2, 10.8), [None; 6]);
        let found = measures(&mut of(&ramp), 10.0, 20.0);
        assert_eq!((found[0], found[1], found[4], found[5]), (Some(10.0), Some(20.0), Some(10.0), None));
    }

    /// Random steps with gaps, against a search by hand.
    #[test]
    fn the_first_crossing_is_found_to_the_point() {
        let mut state = 7_u64;
        let mut below = |n: u64| abi::random::next(&mut state) % n;
        let mut found_any = 0;
        for case in 1..=2000 {
            let points: Vec<(f64, f64)> =
                (0..40).map(|k| (f64::from(k), if below(9) == 0 { f64::NAN } else { below(7) as f64 - 3.0 })).collect();
            let (rises, level, after) = (below(2) == 0, below(7) as f64 - 3.5, 0.5 * below(80) as f64 - 0.5);
            let wanted = points.windows(2).find(|pair| {
                let (a, b) = (pair[0].1, pair[1].1);
                pair[1].0 > after && if rises { a < level && b >= level } else { a > level && b <= level }
            });
            let found = crossing(&mut of(&points), rises, level, after);
            assert_eq!(found, wanted.map(|pair| pair[1].0), "case {case}: {points:?}");
            found_any += u32::from(found.is_some());
        }
        assert!(found_any > 500, "{found_any}");
    }
}
