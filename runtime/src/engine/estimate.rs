//! Numerical error of the measures of a run: their distance to the exact solution of the model, estimated by companion
//! runs.
//!
//! In: an instance as it was before its run, the plan, and the outcome. Out: the same outcome with the numerical error
//! in its readings and margins, with verdicts marked undecided where that error could reverse them, and an [`Estimate`]
//! of how the errors were found. The run itself is complete by then, so nothing here changes its bits.
//!
//! An adaptive run has companions at a tenth and a hundredth of its tolerance. A run with fixed steps is compared with
//! two adaptive runs of the same program, which share no points with it, locate events and extremes, and have their own
//! error control. The error of a number is the range that all three results span. There are two companions because two
//! results may agree by accident. A method that is exact for a model is more accurate than the adaptive runs. If they
//! leave a verdict undecided then, additional runs with finer steps determine its accuracy.
//!
//! If a program has no adaptive run, or one that costs too much, the companions use a half and a quarter of the step.
//! Their results are also extrapolated to step 0 (Richardson) with the observed order of the three runs, at least 1 and
//! at most that of the method. All of these runs share points, and their agreement there is no coincidence. So the
//! amount by which an extreme may exceed the points of the finest run is added, and each companion ends within one step
//! of the end of the experiment.

use crate::engine::{self, Cause, Continue, Estimate, Outcome};
use crate::run::verdict::{Reading, Runs, Verdict, judged};
use abi::plan::{Experiment, Method, PARTS, Solver};
use abi::{Description, Instance};
use std::ops::Range;

/// Tolerances of companions, as fractions of that of the run.
const TOLERANCES: [f64; 2] = [0.1, 0.01];

/// Smallest tolerance of a companion: below it, rounding dominates.
const LEAST_TOL: f64 = 1e-13;

/// Tolerances of the adaptive runs that fixed steps are compared with, and the factors by which their longest step is
/// shorter. Where the longest step limits all steps, two runs with the same limit would agree whatever their tolerance.
const REFERENCES: [(f64, f64); 2] = [(1e-7, 1.0), (1e-9, 2.0)];

/// Limit on progress callbacks of such a run: so many for each fixed step, plus a constant. The run makes one every few
/// dozen steps, so this limits its cost.
const LOOKS_PER_STEP: f64 = 2e-3;
const LOOKS: f64 = 400.0;

/// Steps of companions, as fractions of that of the run. Powers of two, so that an interval of a whole number of steps
/// still is one.
const STEPS: [f64; 2] = [0.5, 0.25];

/// Most steps of a run that is tried to see whether it decides, as a multiple of the steps of the run itself.
const MOST_WORK: f64 = 64.0;

/// Estimates the errors of an outcome, as [`errors`] does, and searches for a solver that decides the undecided
/// verdicts. `in_parallel`: with several threads, for a run that is alone; the results are the same.
pub fn judge(
    instance: &Instance,
    experiment: &Experiment,
    outcome: &mut Outcome,
    in_parallel: bool,
    watch: &(dyn Fn(f64) -> Continue + Sync),
) {
    let Some(mut companions) = accompanied(instance, experiment, outcome, in_parallel, watch) else { return };
    let failed = outcome.estimate.as_ref().is_some_and(|estimate| estimate.failed.is_some());
    if !failed && outcome.verdicts.iter().any(|verdict| !verdict.decided) {
        let decides = companions.decides(&outcome.verdicts, outcome.work.steps, watch);
        outcome.estimate.get_or_insert_default().decides = decides;
    }
}

/// Estimates the errors of an outcome; `instance` and `experiment` are those passed to [`engine::run`]. An experiment
/// without expectations needs no companion. `watch` may stop it, which leaves the outcome unchanged.
pub fn errors(
    instance: &Instance,
    experiment: &Experiment,
    outcome: &mut Outcome,
    watch: &(dyn Fn(f64) -> Continue + Sync),
) {
    accompanied(instance, experiment, outcome, false, watch);
}

/// Writes the errors into the outcome and returns the companion runs; none where the outcome is unchanged.
fn accompanied<'a>(
    instance: &'a Instance,
    experiment: &Experiment,
    outcome: &mut Outcome,
    in_parallel: bool,
    watch: &(dyn Fn(f64) -> Continue + Sync),
) -> Option<Companions<'a>> {
    if experiment.expects.is_empty() {
        return None;
    }
    let bare = experiment.unrecorded();
    let adaptive = instance.adaptive().filter(|_| experiment.solver.method != Method::Adaptive);
    let mut companions = Companions { instance, in_parallel, adaptive, bare, runs: Vec::new(), stepped: Vec::new() };
    companions.runs.push((experiment.solver, Ok(outcome.verdicts.clone())));
    let mut judged = None;
    if companions.refer(outcome.work.steps, watch)? {
        let verdicts = companions.verdicts(0, 1..companions.runs.len());
        if verdicts.iter().all(|verdict| verdict.decided) {
            judged = Some(verdicts);
        } else {
            let referred = companions.runs.len();
            companions.run_all(finer(&experiment.solver), watch)?;
            companions.stepped = companions.runs.split_off(referred);
        }
    } else {
        companions.adaptive = None;
        companions.run_all(finer(&experiment.solver), watch)?;
    }
    outcome.verdicts = judged.unwrap_or_else(|| companions.verdicts(0, 1..companions.runs.len()));
    let mut estimate = Estimate::default();
    let finer = || companions.runs[1..].iter();
    estimate.failed = finer().find_map(|(solver, run)| Some((*solver, run.as_ref().err()?.clone())));
    let all = finer().chain(&companions.stepped).filter(|(_, run)| run.is_ok());
    estimate.companions = all.map(|(solver, _)| *solver).collect();
    if experiment.stepped && experiment.solver.method != Method::Adaptive {
        outcome.verdicts.iter_mut().for_each(|verdict| verdict.decided = true);
    }
    outcome.estimate = Some(estimate);
    Some(companions)
}

/// The solvers of the companions of a run by the same method, in order of accuracy; coarser ones where no finer one is
/// possible.
fn finer(solver: &Solver) -> Vec<Solver> {
    match solver.method.is_fixed() {
        false => {
            let finer = |part: f64| Solver { tol: part * solver.tol, parts: 2.0 * solver.parts, ..*solver };
            let all: Vec<Solver> =
                TOLERANCES.map(finer).into_iter().filter(|finer| finer.tol >= 0.999 * LEAST_TOL).collect();
            if all.is_empty() { vec![Solver { tol: 10.0 * solver.tol, ..*solver }] } else { all }
        }
        true => STEPS.map(|part| Solver { step: part * solver.step, ..*solver }).to_vec(),
    }
}

/// A run: its solver, and its verdicts or why it did not reach its end.
type Run = (Solver, Result<Vec<Verdict>, String>);

/// The results of `work`, in order; with `in_parallel` each in a thread of its own.
fn side_by_side<T: Send, R: Send>(in_parallel: bool, given: Vec<T>, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    if !in_parallel {
        return given.into_iter().map(work).collect();
    }
    std::thread::scope(|scope| {
        let work = &work;
        let mut given = given.into_iter();
        let first = given.next();
        let others: Vec<_> = given.map(|one| scope.spawn(move || work(one))).collect();
        let first = first.map(work);
        let others = others.into_iter().map(|one| one.join().unwrap_or_else(|why| std::panic::resume_unwind(why)));
        first.into_iter().chain(others).collect()
    })
}

/// The runs of one experiment.
struct Companions<'a> {
    instance: &'a Instance,
    /// Whether companions of the same kind run at the same time. Their results are the same.
    in_parallel: bool,
    /// The same program for adaptive runs, if the experiment has fixed steps and is compared with adaptive runs.
    adaptive: Option<Instance>,
    /// The experiment without plots.
    bare: Experiment,
    /// The run itself, then its companions, in order of accuracy.
    runs: Vec<Run>,
    /// Additional runs with finer fixed steps, if any.
    stepped: Vec<Run>,
}

impl Companions<'_> {
    /// Makes the adaptive reference runs for `steps` fixed steps; false if that is impossible, none if the caller
    /// stopped it.
    fn refer(&mut self, steps: u64, watch: &(dyn Fn(f64) -> Continue + Sync)) -> Option<bool> {
        let Some(instance) = &self.adaptive else { return Some(false) };
        let most = LOOKS + LOOKS_PER_STEP * steps as f64;
        let reference = |(tol, finer): (f64, f64)| {
            let solver = Solver { method: Method::Adaptive, step: 0.0, tol, parts: finer * PARTS };
            let (mut looks, mut stopped) = (0.0, false);
            let mut within = |fraction: f64| {
                looks += 1.0;
                stopped = watch(fraction).is_break();
                if stopped || looks > most { Continue::Break(()) } else { Continue::Continue(()) }
            };
            let ended = engine::run(instance.clone(), &Experiment { solver, ..self.bare.clone() }, &mut within);
            (solver, ended.map(|outcome| outcome.verdicts), stopped)
        };
        let found = side_by_side(self.in_parallel, REFERENCES.to_vec(), reference);
        if found.iter().any(|(.., stopped)| *stopped) {
            return None;
        }
        let found: Option<Vec<Run>> =
            found.into_iter().map(|(solver, verdicts, _)| Some((solver, Ok(verdicts.ok()?)))).collect();
        let is_possible = found.is_some();
        self.runs.extend(found.into_iter().flatten());
        Some(is_possible)
    }

    /// Makes these runs; none if the caller stopped one.
    fn run_all(&mut self, solvers: Vec<Solver>, watch: &(dyn Fn(f64) -> Continue + Sync)) -> Option<()> {
        let found = side_by_side(self.in_parallel, solvers, |solver| self.ran(solver, watch));
        let going = found.iter().all(|(_, going)| *going);
        self.runs.extend(found.into_iter().map(|(run, _)| run));
        going.then_some(())
    }

    /// Makes one more run; false if the caller stopped it.
    fn run(&mut self, solver: Solver, watch: &(dyn Fn(f64) -> Continue + Sync)) -> bool {
        let (run, going) = self.ran(solver, watch);
        self.runs.push(run);
        going
    }

    /// A run by this solver; false if the caller stopped it.
    fn ran(&self, solver: Solver, watch: &(dyn Fn(f64) -> Continue + Sync)) -> (Run, bool) {
        let plant = self.bare.bench.as_ref().map(|bench| &bench.plant);
        let stepped = plant.unwrap_or(self.instance).description();
        let (mut going, mut result) = (true, Err("its delays reach back over more steps than are kept".into()));
        if solver.method == Method::Adaptive || has_room(stepped, solver.step) {
            let duration = covering(&self.bare, &solver);
            let mut experiment = Experiment { solver, duration, ..self.bare.clone() };
            if duration > self.bare.duration {
                // No window extends past the end of the experiment.
                experiment.expects.iter_mut().for_each(|expect| expect.before = expect.before.min(self.bare.duration));
            }
            let ended = engine::run(self.instance.clone(), &experiment, &mut |done| watch(done));
            going = !ended.as_ref().is_err_and(|failure| failure.cause == Cause::Stopped);
            result = ended.map(|outcome| outcome.verdicts).map_err(|failure| failure.to_string());
        }
        ((solver, result), going)
    }

    /// The verdicts of run `of`, judged by more accurate ones.
    fn verdicts(&self, of: usize, finer: Range<usize>) -> Vec<Verdict> {
        let (solver, Ok(own)) = &self.runs[of] else { return Vec::new() };
        let finer = &self.runs[finer];
        let failed = finer.iter().any(|(_, run)| run.is_err());
        let error = |values: &[f64]| {
            Some(match self.adaptive.is_some() {
                _ if failed => f64::INFINITY,
                true => compared(solver.method, values),
                false => error(solver.method, values),
            })
        };
        let judge = |(k, expect): (usize, &abi::plan::Expect)| {
            let own = &own[k];
            if own.problem.is_some() {
                return own.clone();
            }
            let mut readings: Vec<&[Reading]> = vec![&own.readings];
            let mut doubt = false;
            let stepped = self.stepped.iter().filter(|_| of == 0);
            let stepped = stepped.map(|(_, run)| run.as_ref().ok().map(|verdicts| &verdicts[k]));
            let stepped: Option<Vec<&Verdict>> = stepped.map(|one| one.filter(|one| one.problem.is_none())).collect();
            readings.extend(stepped.iter().flatten().map(|verdict| verdict.readings.as_slice()));
            for (_, run) in finer {
                match run.as_ref().map(|verdicts| &verdicts[k]) {
                    Ok(verdict) if verdict.problem.is_none() => readings.push(&verdict.readings),
                    // A measure that fails in a more accurate run is unknown in this one.
                    Ok(_) | Err(_) => doubt = true,
                }
            }
            let unknown = |_: &[f64]| Some(f64::INFINITY);
            let error: &dyn Fn(&[f64]) -> Option<f64> = if doubt { &unknown } else { &error };
            judged(expect, &Runs { readings: &readings, error })
        };
        self.bare.expects.iter().enumerate().map(judge).collect()
    }

    /// The coarsest solver found that decides everything. `open`: the verdicts of the first run, which took `steps`
    /// steps.
    fn decides(&mut self, open: &[Verdict], steps: u64, watch: &(dyn Fn(f64) -> Continue + Sync)) -> Option<Solver> {
        let decided = |verdicts: &[Verdict]| !verdicts.is_empty() && verdicts.iter().all(|verdict| verdict.decided);
        let (own, references) = (self.runs[0].0, 1..self.runs.len());
        let adaptive = own.method == Method::Adaptive;
        if self.adaptive.is_none() {
            // Each companion is judged by the more accurate ones after it.
            for of in 1..self.runs.len() - 1 {
                if decided(&self.verdicts(of, of + 1..self.runs.len())) {
                    return Some(self.runs[of].0);
                }
            }
        }
        // Then extrapolate by the order of the method. A factor below 4 would only repeat companions that were tried.
        let excess = open.iter().filter(|verdict| !verdict.decided).filter_map(|verdict| {
            let margin = verdict.margin.as_ref()?;
            Some(margin.error? / margin.amount.abs())
        });
        let excess = excess.fold(if self.adaptive.is_some() { 1.0 } else { 4.0 }, f64::max);
        let safeties: &[f64] = if self.adaptive.is_some() { &[1.0, 4.0, 64.0] } else { &[4.0, 64.0] };
        for safety in safeties {
            let solver = match own.method.is_fixed() {
                false => {
                    let tol = power_of_ten_below(own.tol / (safety * excess));
                    Solver { tol, parts: 2.0 * own.parts, ..own }
                }
                true => {
                    let mut part = 0.5;
                    while power(1.0 / part, own.method.row().order.min(2)) < safety * excess {
                        part *= 0.5;
                        if part < 1e-6 {
                            return None;
                        }
                    }
                    Solver { step: part * own.step, ..own }
                }
            };
            let work = if adaptive { power_of_fifth(own.tol / solver.tol) } else { own.step / solver.step };
            if work > MOST_WORK || work * steps as f64 > 2e7 || adaptive && solver.tol < 1e-12 {
                return None;
            }
            let at = self.runs.len();
            if !self.run(solver, watch) {
                return None;
            }
            let judges = if self.adaptive.is_some() {
                references.clone()
            } else {
                if !self.run(Solver { step: 0.5 * solver.step, tol: 0.1 * solver.tol, ..solver }, watch) {
                    return None;
                }
                at + 1..at + 2
            };
            if decided(&self.verdicts(at, judges)) {
                return Some(solver);
            }
        }
        None
    }
}

/// The duration of a companion in s. If the steps do not divide the duration of the experiment, all companions would
/// end at the same wrong instant, and agree. So a companion runs to the end of the step that contains the end of the
/// experiment, and its windows are clipped there.
fn covering(experiment: &Experiment, solver: &Solver) -> f64 {
    let duration = experiment.duration;
    if solver.method == Method::Adaptive || experiment.bench.is_some() {
        return duration;
    }
    let steps = duration / solver.step;
    if (steps.round() * solver.step - duration).abs() <= 1e-9 * duration {
        duration
    } else {
        steps.ceil() * solver.step
    }
}

/// Whether the ring buffers of the delays are long enough for this step in s.
fn has_room(description: &Description, step: f64) -> bool {
    description.delays.iter().all(|delay| (delay.range.1 / step).ceil() + 2.0 <= f64::from(delay.ring.len))
}

/// The error of the first of the results of runs of increasing accuracy.
fn error(method: Method, values: &[f64]) -> f64 {
    if values.iter().all(|value| *value == values[0]) {
        return 0.0;
    }
    if values.iter().any(|value| !value.is_finite()) {
        return f64::INFINITY;
    }
    let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let span = most - values.iter().copied().fold(f64::INFINITY, f64::min);
    match (method, values) {
        (Method::Adaptive, _) => span,
        // Two steps do not show the order: assume 1, the least.
        (_, [coarse, fine]) => 2.0 * (coarse - fine).abs(),
        (_, [coarse, fine, finest, ..]) => {
            let (first, second) = (coarse - fine, fine - finest);
            // 2^p, if the steps are short enough to show the order p.
            let ratio = (first / second).clamp(2.0, power(2.0, method.row().order));
            let ratio = if ratio.is_nan() { 2.0 } else { ratio };
            let limit = finest - second / (ratio - 1.0);
            span.max((coarse - limit).abs())
        }
        (_, _) => 0.0,
    }
}

/// The error of the first of these results: of a run with fixed steps, of finer steps if there are any, and of two
/// adaptive runs. If the run is as close to the second adaptive run as the first one is, the adaptive runs are not more
/// accurate, and the finer steps give the better estimate.
fn compared(method: Method, values: &[f64]) -> f64 {
    let [own, stepped @ .., first, second] = values else { return f64::INFINITY };
    let span = error(Method::Adaptive, &[*own, *first, *second]);
    if stepped.is_empty() || (own - second).abs() > (first - second).abs() {
        return span;
    }
    error(method, &values[..values.len() - 2]).min(span)
}

fn power(base: f64, exponent: u32) -> f64 {
    (0..exponent).fold(1.0, |product, _| product * base)
}

/// The fifth root of a number ≥ 1, to a factor of 10^0.2: by how much the number of steps grows with a smaller
/// tolerance.
fn power_of_fifth(ratio: f64) -> f64 {
    let (mut rest, mut root) = (ratio, 1.0);
    while rest > 1.0 {
        rest *= 0.1;
        root *= 1.5848931924611136;
    }
    root
}

/// The greatest power of ten that is not above `value`.
fn power_of_ten_below(value: f64) -> f64 {
    let text = format!("{value:e}");
    let exponent = text.split_once('e').map_or("0", |(_, exponent)| exponent);
    format!("1e{exponent}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::models::{self, adaptive, fixed, reading};
    use abi::plan::{Formula, MeasureKind};

    fn judged(instance: &Instance, experiment: &Experiment) -> Outcome {
        let go_on = |_| Continue::Continue(());
        let mut outcome = engine::run(instance.clone(), experiment, &mut { go_on }).unwrap();
        let before = outcome.clone();
        judge(instance, experiment, &mut outcome, false, &go_on);
        let mut again = before.clone();
        judge(instance, experiment, &mut again, true, &go_on);
        assert_eq!(format!("{again:?}"), format!("{outcome:?}"), "companions run in parallel");
        assert_eq!((&before.finals, before.work), (&outcome.finals, outcome.work));
        for (a, b) in before.verdicts.iter().zip(&outcome.verdicts) {
            assert!(a.readings.iter().zip(&b.readings).all(|(a, b)| a.value.to_bits() == b.value.to_bits()));
        }
        outcome
    }

    /// The error of x = e^−t at 1 s, and its estimate.
    fn decay(mut experiment: Experiment) -> (f64, f64) {
        let instance = models::decay();
        experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
        let reading = judged(&instance, &experiment).verdicts[0].readings[0].clone();
        ((reading.value - (-1f64).exp()).abs(), reading.error.unwrap())
    }

    #[test]
    fn the_error_estimate_of_a_decay_is_close() {
        for experiment in [adaptive(1.0, 1e-3), adaptive(1.0, 1e-5), fixed(1.0, 0.1), fixed(1.0, 0.01)] {
            let (error, estimate) = decay(experiment.clone());
            let fits = error > 0.0 && error <= 3.0 * estimate && estimate <= 10.0 * error + 1e-15;
            assert!(fits, "{:?}: {error:e}, {estimate:e}", experiment.solver);
        }
    }

    #[test]
    fn the_estimate_covers_a_run_that_ends_beside_its_duration() {
        // Exact except for where it ends: at 1 s and at 1.1 s, with half and a quarter of the step too.
        let instance = models::decay();
        for (duration, kind) in [(1.004, MeasureKind::Final), (1.096, MeasureKind::Final), (1.004, MeasureKind::Min)] {
            let mut experiment = fixed(duration, 0.1);
            experiment.solver.method = Method::Rk4;
            experiment.expects.push(reading(&instance, kind, "x"));
            let reading = judged(&instance, &experiment).verdicts[0].readings[0].clone();
            let (error, estimate) = ((reading.value - (-duration).exp()).abs(), reading.error.unwrap());
            assert!(error > 1e-3 && error <= 1.5 * estimate && estimate <= 3.0 * error, "{error:e}, {estimate:e}");
        }
    }

    /// sin t has its maximum of 1 at π/2. For many steps the nearest point is one that all three runs share.
    #[test]
    fn the_estimate_covers_an_extreme_between_points_that_all_runs_share() {
        let instance = models::oscillator();
        let mut shared = 0;
        for k in 0..200 {
            let step = 0.01 + 0.0007 * f64::from(k);
            let mut experiment = fixed((2.0 / step).ceil() * step, step);
            experiment.expects.push(reading(&instance, MeasureKind::Max, "x"));
            let found = judged(&instance, &experiment).verdicts[0].readings[0].clone();
            let (error, estimate) = (1.0 - found.value, found.error.unwrap());
            assert!(error.abs() <= 1.5 * estimate + 1e-9, "step {step}: off by {error:e}, estimated {estimate:e}");
            // The nearest point is a shared one if it is nearest by less than half of the finest step.
            let from_peak = std::f64::consts::FRAC_PI_2 / step - (std::f64::consts::FRAC_PI_2 / step).round();
            shared += u32::from(from_peak.abs() < 0.125);
        }
        assert!(shared > 30, "{shared} steps of 200 have it at a shared point");
    }

    #[test]
    fn the_tightest_tolerance_is_judged_by_a_looser_one() {
        let (error, estimate) = decay(adaptive(1.0, 1e-13));
        assert!(error <= 3.0 * estimate + 1e-15, "{error:e}, {estimate:e}");
    }

    #[test]
    fn an_undecided_verdict_names_a_solver_that_decides() {
        let instance = models::decay();
        // Ten seconds: with the fifty steps of one second the error of this decay would be rounding at any tolerance.
        for mut experiment in [fixed(1.0, 0.1), adaptive(10.0, 1e-3)] {
            let solver = experiment.solver;
            let mut expect = reading(&instance, MeasureKind::Final, "x");
            // A limit between the exact value and the result, closer to the exact value: a solver that decides lies on
            // its other side.
            let truth = (-experiment.duration).exp();
            experiment.expects.push(expect.clone());
            let found = judged(&instance, &experiment).verdicts[0].readings[0].value;
            experiment.expects.clear();
            let (measure, limit) =
                (Box::new(Formula::Measure(0)), Box::new(Formula::Number(truth + 0.2 * (found - truth))));
            expect.condition =
                if found > truth { Formula::Less(measure, limit) } else { Formula::Greater(measure, limit) };
            experiment.expects.push(expect);
            let outcome = judged(&instance, &experiment);
            assert!(!outcome.verdicts[0].decided && !outcome.passed(), "{solver:?}");
            let decides = outcome.estimate.unwrap().decides.unwrap_or_else(|| panic!("{solver:?} has no remedy"));
            let better = judged(&instance, &Experiment { solver: decides, ..experiment.clone() });
            assert!(better.passed(), "{decides:?}");
            experiment.stepped = true;
            let on_purpose = judged(&instance, &experiment);
            assert_eq!(on_purpose.verdicts[0].decided, solver.method != Method::Adaptive);
        }
    }

    #[test]
    fn three_results_show_their_order_and_two_do_not() {
        let at = |order: u32| [1.0, 0.5, 0.25].map(|h| 7.0 + power(h, order));
        assert!((error(Method::Euler, &at(1)) - 1.0).abs() < 1e-12);
        assert!((error(Method::Expo, &at(2)) - 1.0).abs() < 1e-12);
        assert!((error(Method::Rk4, &at(4)) - 1.0).abs() < 1e-12);
        assert!((error(Method::Rk4, &at(4)[..2]) - 1.875).abs() < 1e-12);
        // Two values that agree by accident do not make the error small.
        assert!(error(Method::Expo, &[1.0, 1.0, 1.5]) >= 0.5);
        assert!(error(Method::Adaptive, &[1.0, 1.0, 1.5]) >= 0.5);
        assert_eq!(error(Method::Adaptive, &[f64::INFINITY; 3]), 0.0);
        assert_eq!(error(Method::Adaptive, &[f64::INFINITY, 1.0, 1.0]), f64::INFINITY);
        assert_eq!(error(Method::Rk4, &[2.0; 3]), 0.0);
    }
}
