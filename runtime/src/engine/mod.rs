//! Runs one experiment: steps the model, passes each point to measures and recording, and reports how it ended.
//!
//! In: an [`Instance`] and an [`Experiment`]. Out: an [`Outcome`], or a [`Failure`] that names quantity, value and
//! instant. Fixed steps are the model's own code; adaptive ones are in `solver`. Reads no clock and writes no file. A
//! callback receives the fraction done and may stop the run.

pub mod even_grid;
pub mod estimate;
pub mod equilibrium;
pub mod lanes;
pub mod tiles;
pub mod sweep;

use crate::coupling::sil;
use crate::record::{Recorder, Recording};
use crate::run::fixed::Fixed;
use crate::run::observe::{Observer, check_status};
use crate::run::outcome::Stop;
pub use crate::run::outcome::{Cause, Continue, Estimate, Failure, Final, Outcome, Work};
use crate::run::stepper::{self, Rest, Stepper};
use crate::solver::adaptive::Adaptive;
use abi::description::Kind;
use abi::plan::Experiment;
use abi::{Instance, Slot};
use std::sync::Arc;

/// Runs an experiment on an instance whose parameters and inputs are set.
///
/// A fixed-step run calls the model's `Step` as often as fits the duration. An adaptive run needs `Derivatives`, and
/// uses `Jacobian`, `Roots`, `Transitions` and `Tick` where the model has them; it meets `corners` exactly. `watch`
/// receives the fraction done, from 0 to 1, every few thousand fixed or few dozen adaptive steps, and may stop the run.
///
/// # Errors
/// A guard that fired, a quantity that is not finite, chattering, steps that are too short or too many, or a stop by
/// the caller; each with instant, cause and the recording so far.
///
/// # Panics
/// If a fixed step is not positive, a tolerance is not between 0 and 1, the duration is negative, or a slot of the plan
/// is outside the block: such a plan is a programming error.
pub fn run(
    instance: Instance,
    experiment: &Experiment,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<Outcome, Failure> {
    run_on(instance, experiment, &mut |_| (), watch).1
}

/// Runs an experiment as [`run`] does, and also returns the instance in its final state. `begin` receives the instance
/// at t = 0 after its start, and may change its states.
///
/// # Panics
/// As [`run`].
pub fn run_on(
    instance: Instance,
    experiment: &Experiment,
    begin: &mut dyn FnMut(&mut Instance),
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Instance, Result<Outcome, Failure>) {
    let (rest, result) = go(instance, experiment, Observer::new(experiment), begin, watch);
    (rest.instance.clone(), ended(rest, result))
}

/// Values of `slots` at instants in s, ascending, row-major: the rows up to where the run ended, and how it ended. An
/// adaptive run is interpolated between its steps; with fixed steps the nearest step is used. Nothing is measured or
/// recorded.
///
/// # Panics
/// As [`run`].
pub fn sample(
    instance: Instance,
    experiment: &Experiment,
    instants: &[f64],
    slots: &[Slot],
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Vec<f64>, Result<(), Failure>) {
    let bare = bare(experiment);
    let observer = Observer::probing(&bare, &Arc::from(instants), slots);
    let (rest, result) = go(instance, &bare, observer, &mut |_| (), watch);
    (rest.observer.probe.values(), result.map_err(failed))
}

/// Most numbers that a recording of every step holds: 400 MB.
pub const MOST_NUMBERS: usize = 50_000_000;

/// Repeats the experiment and records its data at every step, up to where it ended, and how it ended. `None` if that is
/// more than [`MOST_NUMBERS`].
///
/// # Panics
/// As [`run`].
pub fn every_step(
    instance: Instance,
    experiment: &Experiment,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Option<Recording>, Result<(), Failure>) {
    let bare = Experiment { expects: Vec::new(), ..experiment.clone() };
    let mut observer = Observer::new(&bare);
    observer.recorder = Recorder::whole(&bare.plots, &bare.records, MOST_NUMBERS);
    let (rest, result) = go(instance, &bare, observer, &mut |_| (), watch);
    (rest.observer.recorder.all(), result.map_err(failed))
}

/// The experiment without measures and recordings.
pub(crate) fn bare(experiment: &Experiment) -> Experiment {
    Experiment { expects: Vec::new(), ..experiment.unrecorded() }
}

/// A failure of a run that records nothing.
pub(crate) fn failed(stop: Stop) -> Failure {
    Failure { cause: stop.cause, time: stop.time, recording: Recording::default() }
}

/// Runs to the end, or to the reason why not.
fn go(
    instance: Instance,
    experiment: &Experiment,
    observer: Observer,
    begin: &mut dyn FnMut(&mut Instance),
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Rest, Result<(), Stop>) {
    let duration = experiment.duration;
    assert!(duration >= 0.0 && duration.is_finite(), "a run of {duration} s");
    if let Some(bench) = &experiment.bench {
        let mut rest = Rest::of(instance, observer);
        let result = sil::run(&mut rest.instance, bench, experiment, &mut rest.observer, &mut rest.work, watch);
        return (rest, result);
    }
    match start(instance, experiment, observer, begin) {
        Ok(mut course) => {
            let result = stepper::alone(&mut *course, watch);
            (course.rest(), result)
        }
        Err(failed) => {
            let (rest, stop) = *failed;
            (rest, Err(stop))
        }
    }
}

/// Starts a run. `begin` receives the instance at t = 0 and may change its states.
///
/// # Errors
/// The parts of a run that did not begin, and why; boxed because it is rare.
pub(crate) fn start(
    instance: Instance,
    experiment: &Experiment,
    observer: Observer,
    begin: &mut dyn FnMut(&mut Instance),
) -> Result<Box<dyn Stepper>, Box<(Rest, Stop)>> {
    match experiment.solver.method.is_fixed() {
        true => Ok(Box::new(Fixed::start(instance, experiment, observer, begin)?)),
        false => Ok(Box::new(Adaptive::start(instance, experiment, observer, begin)?)),
    }
}

/// Why a fixed step, after which the instance is as given, returned a status; none if this is 0.
pub fn failure(instance: &Instance, status: u64) -> Option<Failure> {
    check_status(instance, status).err().map(failed)
}

/// Converts a run that has ended to its outcome.
pub(crate) fn ended(rest: Rest, result: Result<(), Stop>) -> Result<Outcome, Failure> {
    let Rest { instance, observer, work, notes } = rest;
    if let Err(stop) = result {
        return Err(Failure { cause: stop.cause, time: stop.time, recording: observer.recorder.recording() });
    }
    let outputs = instance.description().quantities.iter().filter(|quantity| quantity.kind == Kind::Output);
    let finals = outputs.map(|quantity| Final {
        path: quantity.path.clone(),
        value: instance.get(quantity.slot),
        unit: quantity.unit.clone(),
        boolean: quantity.boolean,
    });
    Ok(Outcome {
        verdicts: observer.expectations.verdicts(),
        recording: observer.recorder.recording(),
        finals: finals.collect(),
        time: instance.get(Slot::TIME),
        work,
        notes,
        estimate: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::models::{self, Model, fixed, plot, reading};
    use abi::Function;
    use abi::plan::MeasureKind;

    fn go(instance: Instance, experiment: &Experiment) -> Result<Outcome, Failure> {
        run(instance, experiment, &mut |_| Continue::Continue(()))
    }

    #[test]
    fn a_decay_is_measured_recorded_and_ends_on_its_step() {
        let instance = models::decay();
        let mut experiment = fixed(2.0, 1e-3);
        experiment.plots.push(plot(&instance, &["x", "y"]));
        experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
        experiment.expects.push(reading(&instance, MeasureKind::Integral, "y"));
        let outcome = go(instance, &experiment).unwrap();
        assert_eq!((outcome.work.steps, outcome.time), (2000, 2.0));
        assert!((outcome.verdicts[0].readings[0].value - (-2f64).exp()).abs() < 1e-13);
        // Trapezoidal rule: the error of one step is h³/12 y''.
        assert!((outcome.verdicts[1].readings[0].value - 2.0 * (1.0 - (-2f64).exp())).abs() < 1e-6);
        assert_eq!(outcome.recording.rows().len(), 2001);
        assert_eq!((outcome.finals[0].path.as_str(), outcome.finals.len()), ("y", 1));
        assert!((outcome.finals[0].value - 2.0 * (-2f64).exp()).abs() < 1e-13);
        assert_eq!(outcome.notes, [""; 0]);
    }

    #[test]
    fn a_duration_of_a_fractional_number_of_steps_is_rounded_with_a_note() {
        let outcome = go(models::decay(), &fixed(1.0, 0.3)).unwrap();
        assert_eq!(outcome.work.steps, 3);
        assert_eq!(outcome.notes, ["The run ends at 0.9 s, after a whole number of steps."]);
    }

    #[test]
    fn batches_give_the_bits_of_single_steps() {
        let instance = models::oscillator();
        let mut experiment = fixed(10.0, 1e-3);
        experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
        experiment.expects[0].before = experiment.duration;
        let batched = go(instance.clone(), &experiment).unwrap();
        experiment.plots.push(plot(&instance, &["x"]));
        let single = go(instance, &experiment).unwrap();
        // The greatest magnitude of a quantity is known only if all points were observed.
        let apart_from_size = |outcome: &Outcome| {
            let mut verdicts = outcome.verdicts.clone();
            verdicts.iter_mut().flat_map(|verdict| &mut verdict.readings).for_each(|reading| reading.scale = 0.0);
            verdicts
        };
        assert_eq!(apart_from_size(&batched), apart_from_size(&single));
        assert_eq!(batched.finals, single.finals);
        assert_eq!(single.recording.seen(), 10_001);
    }

    /// dx/dt = x² from 1: infinite at t = 1 s.
    fn blow_up() -> Model {
        Model::new("BlowUp")
            .state("x", "m")
            .body(Function::Start, |m| m.set_x(0, 1.0))
            .body(Function::Derivatives, |m| m.set_dx(0, m.x(0) * m.x(0)))
    }

    #[test]
    fn a_guard_stops_the_run_with_name_value_and_time() {
        let instance = blow_up().within((0.0, 10.0)).build();
        let mut experiment = fixed(2.0, 1e-3);
        experiment.plots.push(plot(&instance, &["x"]));
        let failure = go(instance, &experiment).unwrap_err();
        assert_eq!(failure.to_string(), "`x` left its range 0 .. 10 m: it is 10.1 m at 0.901 s");
        assert_eq!(failure.recording.rows().len(), 902);
    }

    #[test]
    fn the_first_non_finite_value_is_named_with_its_step() {
        let drawn = {
            let instance = blow_up().build();
            let mut experiment = fixed(20.0, 1e-3);
            experiment.plots.push(plot(&instance, &["x"]));
            go(instance, &experiment).unwrap_err()
        };
        let batched = go(blow_up().build(), &fixed(20.0, 1e-3)).unwrap_err();
        assert_eq!((&drawn.cause, drawn.time), (&batched.cause, batched.time));
        assert!((1.0..1.02).contains(&drawn.time), "{drawn}");
        assert!(drawn.to_string().starts_with("`x` is infinite at 1.0"), "{drawn}");
        assert!(drawn.recording.points(0).all(|(_, x)| x.is_finite()));
    }

    #[test]
    fn the_caller_can_stop_and_keeps_what_was_recorded() {
        let instance = models::decay();
        let mut experiment = fixed(100.0, 1e-3);
        experiment.plots.push(plot(&instance, &["x"]));
        let mut fractions = Vec::new();
        let failure = run(instance, &experiment, &mut |fraction| {
            fractions.push(fraction);
            if fraction > 0.1 { Continue::Break(()) } else { Continue::Continue(()) }
        })
        .unwrap_err();
        assert_eq!(failure.cause, Cause::Stopped);
        assert!(fractions.is_sorted() && fractions.len() == 3);
        assert!(failure.recording.rows().len() >= 1000);
    }

    #[test]
    fn an_instant_is_a_run_of_no_steps() {
        let outcome = go(models::decay(), &fixed(0.0, 1e-3)).unwrap();
        assert_eq!((outcome.work.steps, outcome.finals[0].value), (0, 2.0));
    }
}
