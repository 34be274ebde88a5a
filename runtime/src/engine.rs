//! Runs one experiment: steps the model, shows each point to measures and recording, and tells how it ended.
//!
//! In: an [`Instance`] and an [`Experiment`]. Out: an [`Outcome`], or a [`Failure`] that names quantity, value and
//! instant. Fixed steps are in the model's own code; adaptive ones in `solver`. Reads no clock and
//! writes no file: whoever calls may look at the fraction done and stop the run.

use crate::observe::{Observer, Probe, check_finite, check_status};
use crate::outcome::Stop;
pub use crate::outcome::{Cause, Continue, Failure, Final, Outcome, Work};
use crate::record::Recording;
use crate::show;
use crate::solver::adaptive;
use abi::description::Kind;
use abi::plan::{Experiment, Method};
use abi::{Instance, Slot};

/// Fixed steps between two looks at the caller and at the whole block.
const BATCH: u64 = 4096;

/// Runs an experiment on an instance whose parameters and inputs are set.
///
/// A fixed step is the model's own `Step`, taken as often as fits the duration. An adaptive run needs `Derivatives`, and
/// uses `Jacobian`, `Roots`, `Transitions` and `Tick` where the model has them; `corners` are met exactly.
/// `watch` sees the fraction done, from 0 to 1, every few thousand fixed or few dozen adaptive steps, and may end the
/// run.
///
/// # Errors
/// A guard that fired, a quantity that is not finite, chattering, steps that are too short or too many, or the caller's
/// wish to stop; each with instant, cause and the recording so far.
///
/// # Panics
/// If a fixed step is not positive, a tolerance does not lie between 0 and 1, the duration is negative, or a slot of the
/// plan lies outside the block: such a plan is the mistake of whoever made it.
pub fn run(
    instance: Instance,
    experiment: &Experiment,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<Outcome, Failure> {
    run_on(instance, experiment, &mut |_| (), watch).1
}

/// Runs an experiment as [`run`] does, and gives the instance as it is at the end besides. `begin` sees the instance
/// once it has started, at t = 0, and may put its states elsewhere.
///
/// # Panics
/// As [`run`].
pub fn run_on(
    instance: Instance,
    experiment: &Experiment,
    begin: &mut dyn FnMut(&mut Instance),
    watch: &mut dyn FnMut(f64) -> Continue,
) -> (Instance, Result<Outcome, Failure>) {
    let mut run = Run::new(instance, experiment);
    let result = run.go(begin, watch);
    let instance = run.instance.clone();
    let result = match result {
        Ok(()) => Ok(run.outcome()),
        Err(stop) => Err(Failure { cause: stop.cause, time: stop.time, recording: run.observer.recorder.recording() }),
    };
    (instance, result)
}

/// Values of `slots` at instants in s, ascending, row by row: the rows up to where the run came, and how it ended. An
/// adaptive run is read between its steps; of fixed steps the one nearest counts. Nothing is measured or recorded.
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
    let bare = Experiment { plots: Vec::new(), expects: Vec::new(), ..experiment.clone() };
    let mut run = Run::new(instance, &bare);
    run.observer.probe = Probe::new(instants, slots);
    let result = run.go(&mut |_| (), watch);
    let failed = |stop: Stop| Failure { cause: stop.cause, time: stop.time, recording: Recording::default() };
    (run.observer.probe.values(), result.map_err(failed))
}

/// A run under way.
struct Run<'a> {
    instance: Instance,
    experiment: &'a Experiment,
    observer: Observer,
    work: Work,
    notes: Vec<String>,
}

impl<'a> Run<'a> {
    fn new(instance: Instance, experiment: &'a Experiment) -> Run<'a> {
        let observer = Observer::new(experiment);
        Run { instance, experiment, observer, work: Work::default(), notes: Vec::new() }
    }

    fn go(&mut self, begin: &mut dyn FnMut(&mut Instance), watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
        let duration = self.experiment.duration;
        assert!(duration >= 0.0 && duration.is_finite(), "a run of {duration} s");
        match self.experiment.solver.method {
            Method::Euler | Method::Rk4 | Method::Expo | Method::Implicit => self.fixed(begin, watch),
            Method::Adaptive => {
                adaptive::run(&mut self.instance, self.experiment, &mut self.observer, &mut self.work, begin, watch)
            }
        }
    }

    /// A whole number of fixed steps.
    fn fixed(
        &mut self,
        begin: &mut dyn FnMut(&mut Instance),
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Result<(), Stop> {
        let step = self.experiment.solver.step;
        assert!(step > 0.0 && step.is_finite(), "a step of {step} s");
        let total = (self.experiment.duration / step).round() as u64;
        let end = total as f64 * step;
        if (end - self.experiment.duration).abs() > 1e-9 * self.experiment.duration {
            self.notes.push(format!("The run ends at {}, after a whole number of steps.", show::time(end)));
        }
        let each = !self.observer.only_last() || self.observer.probe.next().is_some();
        let status = self.instance.start(step);
        begin(&mut self.instance);
        check_status(&self.instance, status)?;
        check_finite(&self.instance)?;
        self.observer.see(&self.instance)?;
        self.probe(step);
        let mut saved = self.instance.block().to_vec();
        while self.work.steps < total {
            let count = BATCH.min(total - self.work.steps);
            saved.copy_from_slice(self.instance.block());
            let status = if each { self.seen_steps(step, count)? } else { self.instance.advance(count) };
            // In a batch, what was not finite may have become so many steps ago, and may be why a guard fired.
            if check_finite(&self.instance).is_err() {
                self.instance.block_mut().copy_from_slice(&saved);
                return Err(self.first_not_finite(count));
            }
            if status != 0 {
                // The step that went too far is worth seeing.
                if !each {
                    self.observer.see(&self.instance)?;
                }
                check_status(&self.instance, status)?;
            }
            self.work.steps += count;
            if watch(self.work.steps as f64 / total as f64).is_break() {
                return Err(Stop { cause: Cause::Stopped, time: self.instance.get(Slot::TIME) });
            }
        }
        if !each {
            self.observer.see(&self.instance)?;
        }
        Ok(())
    }

    /// Steps one by one, each shown; returns the first status that is not 0.
    fn seen_steps(&mut self, step: f64, count: u64) -> Result<u64, Stop> {
        for _ in 0..count {
            let status = self.instance.advance(1);
            self.observer.see(&self.instance)?;
            self.probe(step);
            if status != 0 {
                return Ok(status);
            }
        }
        Ok(0)
    }

    /// Keeps what is wanted at an instant that this step is nearest to.
    fn probe(&mut self, step: f64) {
        let time = self.instance.get(Slot::TIME);
        while self.observer.probe.next().is_some_and(|instant| instant < time + 0.5 * step) {
            self.observer.probe.take(self.instance.block());
        }
    }

    /// Repeats the last batch step by step up to where a state or output is not finite.
    fn first_not_finite(&mut self, count: u64) -> Stop {
        for _ in 0..count {
            self.instance.advance(1);
            if let Err(stop) = check_finite(&self.instance) {
                return stop;
            }
        }
        unreachable!("the same {count} steps gave a value that is not finite before")
    }

    fn outcome(self) -> Outcome {
        let outputs = self.instance.description().quantities.iter().filter(|quantity| quantity.kind == Kind::Output);
        let finals = outputs.map(|quantity| Final {
            path: quantity.path.clone(),
            value: self.instance.get(quantity.slot),
            unit: quantity.unit.clone(),
            boolean: quantity.boolean,
        });
        Outcome {
            verdicts: self.observer.expectations.verdicts(),
            recording: self.observer.recorder.recording(),
            finals: finals.collect(),
            time: self.instance.get(Slot::TIME),
            work: self.work,
            notes: self.notes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::{self, Model, fixed, plot, reading};
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
        // Trapezoidal: the error of one step is h³/12 y''.
        assert!((outcome.verdicts[1].readings[0].value - 2.0 * (1.0 - (-2f64).exp())).abs() < 1e-6);
        assert_eq!(outcome.recording.rows().len(), 2001);
        assert_eq!((outcome.finals[0].path.as_str(), outcome.finals.len()), ("y", 1));
        assert!((outcome.finals[0].value - 2.0 * (-2f64).exp()).abs() < 1e-13);
        assert_eq!(outcome.notes, [""; 0]);
    }

    #[test]
    fn a_duration_that_is_no_whole_number_of_steps_is_rounded_and_said() {
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
        assert_eq!(batched.verdicts, single.verdicts);
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
    fn what_is_not_finite_is_named_at_its_first_step() {
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

    /// The cost of looking: `cargo test --release -p runtime -- --ignored --nocapture steps_cost`.
    #[test]
    #[ignore = "prints times, judges nothing"]
    fn steps_cost_little_beyond_the_model() {
        let instance = models::cheap();
        let mut experiment = fixed(100.0, 1e-5);
        let timed = |what: &str, experiment: &Experiment| {
            let start = std::time::Instant::now();
            let outcome = go(instance.clone(), experiment).unwrap();
            let each = start.elapsed().as_secs_f64() / outcome.work.steps as f64;
            println!("{what}: {:.1} ns a step, {} steps", 1e9 * each, outcome.work.steps);
        };
        timed("nothing", &experiment);
        experiment.expects.push(reading(&instance, MeasureKind::Max, "x"));
        timed("max", &experiment);
        experiment.expects.push(reading(&instance, MeasureKind::Rms, "x"));
        timed("max, rms", &experiment);
        experiment.plots.push(plot(&instance, &["x", "x"]));
        timed("max, rms, one series", &experiment);
        experiment.plots.push(plot(&instance, &["y"]));
        timed("max, rms, two series", &experiment);
    }

    #[test]
    fn an_instant_is_a_run_of_no_steps() {
        let outcome = go(models::decay(), &fixed(0.0, 1e-3)).unwrap();
        assert_eq!((outcome.work.steps, outcome.finals[0].value), (0, 2.0));
    }
}
