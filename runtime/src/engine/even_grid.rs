//! Records a run on an even time grid.
//!
//! In: an instance, an experiment and a sampling interval T. Out: a [`Recording`] with rows at 0, T, 2 T, …. An
//! adaptive run evaluates its dense output, the polynomial of the step that contains the instant; at an event, the
//! value after it. Fixed steps are not interpolated, so T is a multiple of the step.

use crate::engine::{Continue, Failure, sample};
use crate::record::{Recorder, Recording};
use abi::Instance;
use abi::format;
use abi::live::is_multiple;
use abi::plan::{Experiment, Method};

/// Largest number of rows.
pub const MOST_ROWS: u64 = 10_000_000;

/// The instants of a grid, in s; `every`: its interval in s.
///
/// # Errors
/// Why there is no such grid, in words.
pub fn instants(every: f64, experiment: &Experiment) -> Result<Vec<f64>, String> {
    let (duration, step) = (experiment.duration, experiment.solver.step);
    if !(every > 0.0 && every.is_finite()) {
        return Err("rows lie a time greater than 0 apart".into());
    }
    if experiment.bench.is_some() {
        return Err("the dry run of a rig is recorded at its ticks".into());
    }
    if every > duration {
        return Err(format!("rows {} apart are too few in a run of {}", format::time(every), format::time(duration)));
    }
    let last = (duration / every * (1.0 + 1e-12)).floor();
    if last >= MOST_ROWS as f64 {
        return Err(format!("{} rows are too many: {MOST_ROWS} are possible", last + 1.0));
    }
    if experiment.solver.method != Method::Adaptive && !is_multiple(every, step) {
        let (rows, steps) = (format::time(every), format::time(step));
        return Err(format!(
            "rows {rows} apart do not lie on steps of {steps}: give a whole multiple of the step, or run it with `--solver adaptive`"
        ));
    }
    // Multiples of a decimal such as 0.1 ms are rounded once: 3e-4 and not 3.0000000000000003e-4.
    let decimal = std::iter::successors(Some(1.0), |ten| Some(10.0 * ten)).take(18).find(|ten| {
        let whole = (every * ten).round();
        whole > 0.0 && whole / ten == every && whole * last < 9e15
    });
    let instant = |k: u64| match decimal {
        Some(ten) => k as f64 * (every * ten).round() / ten,
        None => k as f64 * every,
    };
    Ok((0..=last as u64).map(|k| instant(k).min(duration)).collect())
}

/// Repeats the experiment and records its data at these instants, up to where it ended, and how it ended.
///
/// # Panics
/// As [`crate::engine::run`].
pub fn record(
    instance: Instance,
    experiment: &Experiment,
    instants: &[f64],
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Recording, Result<(), Failure>) {
    let recorder = Recorder::new(&experiment.plots, &experiment.records);
    let slots: Vec<_> = recorder.slots().collect();
    let (values, result) = sample(instance, experiment, instants, &slots, watch);
    (recorder.rows(instants, &values), result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::models;

    #[test]
    fn a_grid_is_of_decimals_and_ends_with_the_run() {
        let adaptive = models::adaptive(1.0, 1e-6);
        let grid = instants(1e-4, &adaptive).unwrap();
        assert_eq!((grid.len(), grid[3], grid[7], grid[10_000]), (10_001, 3e-4, 7e-4, 1.0));
        assert_eq!(instants(0.3, &adaptive).unwrap(), [0.0, 0.3, 0.6, 0.9]);
        let third = instants(1.0 / 3.0, &adaptive).unwrap();
        assert_eq!((third.len(), third[3]), (4, 1.0));
    }

    #[test]
    fn invalid_grids_are_refused() {
        let adaptive = models::adaptive(1.0, 1e-6);
        let said = |every: f64| instants(every, &adaptive).unwrap_err();
        assert!(said(0.0).contains("greater than 0") && said(-1.0).contains("greater than 0"));
        assert!(said(f64::NAN).contains("greater than 0") && said(f64::INFINITY).contains("greater than 0"));
        assert_eq!(said(2.0), "rows 2 s apart are too few in a run of 1 s");
        assert_eq!(said(1e-8), "100000001 rows are too many: 10000000 are possible");
        let mut fixed = adaptive.clone();
        (fixed.solver.method, fixed.solver.step) = (Method::Rk4, 1e-3);
        assert!(instants(2e-3, &fixed).is_ok() && instants(1e-3, &fixed).is_ok());
        for every in [1.5e-3, 1e-4] {
            assert!(instants(every, &fixed).unwrap_err().contains("do not lie on steps of 0.001 s"), "{every}");
        }
    }
}
