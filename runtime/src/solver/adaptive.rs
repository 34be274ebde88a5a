//! The driver of adaptive runs: chooses method and step length, stops at events, ticks and corners, and passes the
//! points on.
//!
//! Error control is per state: the estimated error of state i stays below tol · (|x| + s), with s half the width of its
//! declared range, or 1 in its declared unit where the range is open. Step lengths follow Gustafsson's predictive
//! control (Hairer & Wanner, Solving ODEs II, sec. IV.8). An event ends its step at the far end of a bracket of 1e-12
//! of the run. A surface at which neither states nor regimes change and the derivatives do not jump is no event.
//! Nothing here depends on the platform's elementary functions, so a run has the same bits everywhere.

mod kinks;

use super::explicit::Explicit;
use super::fused::{Fused, Judged, Pace, Settled};
use super::jacobian::Entries;
use super::points::Points;
use super::rosenbrock::Rosenbrock;
use super::step::{Step, System, copy};
use super::surfaces::{Crossing, Surfaces};
use crate::run::observe::{Observer, Probe, check_finite, check_status};
use crate::run::outcome::{Cause, Chatter, Continue, Stop, Work};
use crate::run::stepper::{Rest, Stepper};
use abi::description::{Guard, Kind};
use abi::plan::Experiment;
use abi::rosenbrock::step_control::{
    BEFORE_SURFACE, GREATEST_GAIN, HALFWAY, LEAST_ERROR, LEAST_GAIN, LEAST_ROOT, LEAST_STEP, MOST_BEFORE_SURFACE,
    MOST_REFUSED, NEARLY, SAFETY, inverse_fifth_root,
};
use abi::{Function, Instance, Slot};
use std::collections::VecDeque;
use std::ops::Range;

/// Most step attempts between two stops. A run that needs more would take minutes, and ends with a message.
const MOST_ATTEMPTS: u64 = 5_000_000;

/// More events than this within a millionth of the run are chattering.
const MOST_EVENTS: usize = 100;
const SOON: f64 = 1e-6;

/// So are more surfaces than this, met by accepted or rejected steps, while no state moves by more than three times the
/// square root of the tolerance. An oscillation with growing frequency that loses a fraction a² of its amplitude a at
/// each turn loses less than the allowed error once a is about that root, and would then continue for ever.
const MOST_CROSSINGS: usize = 2000;

/// With more step attempts than this within a millionth of the run, the run makes no progress.
const MOST_IN_PLACE: u64 = 20_000;

/// Smallest scale of a state without a declared range, SI; and the smallest error that may be requested.
const LEAST_SCALE: f64 = 1e-9;
const ROUNDING: f64 = 1e-15;

/// How often a step is repeated to end before a surface if the surface is then not crossed.
const MOST_AIMS: u8 = 4;

/// The stiff method is kept without further checks if h times the mean eigenvalue exceeds this, or h² times the mean
/// squared eigenvalue exceeds its square.
const STIFF: f64 = 0.5;

/// Step attempts between two calls of the progress callback.
const WATCHED: u64 = 64;

/// An adaptive run in progress; it pauses at each call of the model's own step function.
pub(crate) struct Adaptive {
    system: System,
    duration: f64,
    /// The next instant to meet exactly, and the number of attempts at the previous one.
    goal: Option<(f64, u64)>,
    /// Instants to meet exactly, ascending.
    corners: Vec<f64>,
    tol: f64,
    /// Scale of each state, SI: half the width of its declared range, or its largest value so far.
    scales: Vec<f64>,
    /// The reference for a small change of each state, SI.
    units: Vec<f64>,
    t: f64,
    x: Vec<f64>,
    /// Length of the next step in s, and the longest that is allowed.
    h: f64,
    longest: f64,
    step: Step,
    /// Whether `step.f0` and `jacobian` are those at (t, x).
    slope_known: bool,
    /// Slope at the end of the last step, and whether the stiff method computed it.
    end_slope: Vec<f64>,
    was_stiff: bool,
    jacobian_known: bool,
    jacobian: Vec<f64>,
    entries: Entries,
    rosenbrock: Rosenbrock,
    /// The stiff method fused into one function of the model, if the model has it; and whether it made the last step.
    fused: Option<Fused>,
    was_fused: bool,
    /// Whether the step is known to end with all quantities in range, and to meet no surface.
    inside: bool,
    calm: bool,
    explicit: Explicit,
    /// Whether the stiff method is active.
    stiff: bool,
    /// For each guard the least and the greatest allowed value, SI.
    fine: Vec<(f64, f64)>,
    /// How many times in a row the Jacobian favoured the other method, and how many are needed to leave the stiff one.
    doubts: u32,
    patience: u32,
    /// Length of the last accepted step, and the fifth root of its error; none after a restart.
    last: Option<(f64, f64)>,
    /// Attempts rejected since the last accepted one.
    rejected: u64,
    /// Limit on the next step because a surface is just ahead.
    creep: f64,
    /// For each surface, how often recently a step was repeated to end before it, without a crossing.
    aimed: Vec<u8>,
    /// Number of the attempt that is to end so little after a kink that the kink cannot matter.
    bent: Option<u64>,
    /// Length of the step that was repeated: the step length to resume after the condition.
    usual: Option<f64>,
    /// States beside a crossing, and four slopes around it.
    beside: Vec<f64>,
    slopes: Vec<f64>,
    surfaces: Surfaces,
    /// The surfaces at which only observed quantities change, and how far they have been searched in the step, in θ.
    observed: Surfaces,
    followed: Option<f64>,
    /// Up to this instant, in s, a contact may release without a stiff step noticing; infinite if there is no such
    /// instant.
    suspect: f64,
    /// Whether the model's own function reports that the step meets a surface.
    met: bool,
    /// Whether that function leaves each step open for attention.
    attends: bool,
    /// Where it leaves the steps that it accepts by itself, if observers need them.
    series: Option<Settled>,
    /// Whether anything in the block outside the trial may have changed since the last call.
    moved: bool,
    /// Whether no step has been made since the last restart.
    fresh: bool,
    /// Time and a crossed surface of each of the most recent events.
    events: VecDeque<(f64, Option<usize>)>,
    /// For each surface the time of its last event.
    last_events: Vec<f64>,
    /// The number of surfaces met since a given time, and the states then; whether the last attempt was too long only
    /// because of a surface.
    crossings: usize,
    crossings_since: f64,
    crossings_at: Vec<f64>,
    overran: bool,
    /// Number of attempts and time at the last check for progress.
    place: (u64, f64),
    /// For each sampled block its period in s and the number of its next tick.
    ticks: Vec<(f64, u64)>,
    points: Points,
    /// θ of the step up to which the history is stored.
    kept: f64,
    work: Work,
}

impl Adaptive {
    pub(crate) fn start(
        mut instance: Instance,
        experiment: &Experiment,
        observer: Observer,
        begin: &mut dyn FnMut(&mut Instance),
    ) -> Result<Adaptive, Box<(Rest, Stop)>> {
        let failed = |instance, observer, stop| Err(Box::new((Rest::of(instance, observer), stop)));
        if !instance.has(Function::Derivatives) && instance.description().layout.states.len > 0 {
            return failed(instance, observer, Stop { cause: Cause::NoDerivatives, time: 0.0 });
        }
        let status = instance.start(0.0);
        begin(&mut instance);
        if let Err(stop) = check_status(&instance, status).and_then(|()| check_finite(&instance)) {
            return failed(instance, observer, stop);
        }
        let mut run = Adaptive::new(instance, experiment, observer);
        match run.begin() {
            Ok(()) => Ok(run),
            Err(stop) => Err(Box::new((Box::new(run).rest(), stop))),
        }
    }

    fn new(mut instance: Instance, experiment: &Experiment, observer: Observer) -> Adaptive {
        let description = instance.description().clone();
        let states = &description.layout.states;
        let tol = experiment.solver.tol;
        assert!(tol > 0.0 && tol < 1.0, "a tolerance of {tol}");
        let declared = |i: usize| {
            let quantity = description.quantities.iter().find(|q| q.kind == Kind::State && q.slot == states.slot(i))?;
            let half = 0.5 * (quantity.range.1 - quantity.range.0);
            (half > 0.0 && half.is_finite()).then_some(half)
        };
        let declared: Vec<Option<f64>> = (0..states.len as usize).map(declared).collect();
        let units: Vec<f64> = declared.iter().map(|half| half.unwrap_or(1.0)).collect();
        // The magnitude of a state without a range shows during the run; until then rounding errors must not count.
        let least = LEAST_SCALE.max(ROUNDING / tol);
        let start = &instance.block()[states.range()];
        let scale = |(half, x): (&Option<f64>, &f64)| half.unwrap_or(least).max(x.abs());
        let scales: Vec<f64> = declared.iter().zip(start).map(scale).collect();
        let period = |slot| {
            let period = instance.get(slot);
            assert!(period > 0.0, "a sampled block with a period of {period} s");
            period
        };
        let ticks = description.ticks.iter().map(|tick| (period(tick.period), 1)).collect();
        let points = Points::new(&instance, observer, experiment);
        // Guarded ranges, with the same slack of a millionth as in fixed steps: a deviation within the error control is
        // no violation.
        let fine = |guard: &Guard| {
            let (low, high) = guard.range;
            let (width, share) = (high - low, (10.0 * tol).max(1e-6));
            let slack = |bound: f64| share * if width.is_finite() { width } else { bound.abs() };
            let least = if low == f64::NEG_INFINITY { low } else { low - slack(low) };
            (least, if high == f64::INFINITY { high } else { high + slack(high) })
        };
        let fine: Vec<(f64, f64)> = description.guards.iter().map(fine).collect();
        let fused = Fused::new(&mut instance, tol, &fine);
        let system = System::new(instance);
        let mut corners = experiment.corners.clone();
        corners.extend(system.history.echoes_of_start());
        corners.sort_by(f64::total_cmp);
        corners.dedup();
        let n = system.n;
        let entries = Entries::new(n, &description.coupling);
        Adaptive {
            duration: experiment.duration,
            goal: None,
            corners,
            tol,
            t: 0.0,
            x: system.instance.block()[system.states.clone()].to_vec(),
            h: 0.0,
            longest: (experiment.duration / experiment.solver.parts).min(system.history.longest()),
            kept: 0.0,
            step: Step::new(n),
            slope_known: false,
            end_slope: vec![0.0; n],
            was_stiff: true,
            jacobian_known: false,
            jacobian: vec![0.0; entries.len() + n],
            rosenbrock: Rosenbrock::new(n, entries.coupled()),
            entries,
            series: fused.as_ref().filter(|_| points.are_shown()).map(|fused| Settled::new(fused.trial)),
            fused,
            fine,
            was_fused: false,
            inside: false,
            calm: false,
            explicit: Explicit::new(n),
            stiff: true,
            doubts: 0,
            patience: 3,
            last: None,
            rejected: 0,
            creep: f64::INFINITY,
            aimed: vec![0; system.surfaces()],
            bent: None,
            usual: None,
            beside: vec![0.0; n],
            slopes: vec![0.0; 4 * n],
            surfaces: Surfaces::new(&system, 1e-12 * experiment.duration, false),
            observed: Surfaces::new(&system, 1e-12 * experiment.duration, true),
            followed: None,
            suspect: f64::INFINITY,
            met: false,
            attends: false,
            moved: true,
            fresh: true,
            events: VecDeque::new(),
            last_events: vec![f64::NEG_INFINITY; system.surfaces()],
            crossings: 0,
            crossings_since: 0.0,
            crossings_at: system.instance.block()[system.states.clone()].to_vec(),
            overran: false,
            place: (0, 0.0),
            ticks,
            points,
            work: Work::default(),
            scales,
            units,
            system,
        }
    }

    /// Shows the start and chooses the first step.
    fn begin(&mut self) -> Result<(), Stop> {
        self.points.here(&mut self.system, self.t, &self.x)?;
        self.restart();
        self.h = self.first_step();
        Ok(())
    }

    /// Computes the outputs at the end, for observers.
    fn finish(&mut self) -> Result<(), Stop> {
        let (t, x) = (self.t, &self.x);
        self.system.place(t, x);
        let status = self.system.instance.call(Function::Outputs);
        check_status(&self.system.instance, status)?;
        check_finite(&self.system.instance)?;
        self.points.end(&self.system)
    }

    /// The next instant that must be met exactly.
    fn next_stop(&self) -> f64 {
        let corner = self.corners.partition_point(|corner| *corner <= self.t);
        let corner = self.corners.get(corner).copied().unwrap_or(self.duration);
        let tick = self.ticks.iter().map(|(period, number)| period * *number as f64).fold(self.duration, f64::min);
        corner.min(tick).min(self.duration)
    }

    /// Calls the progress callback, and checks that the run makes progress.
    fn look_around(&mut self, before: u64, watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
        if self.attempts().is_multiple_of(WATCHED) && watch(self.t / self.duration).is_break() {
            return Err(self.stop(Cause::Stopped));
        }
        if self.attempts() - before >= MOST_ATTEMPTS {
            return Err(self.stop(Cause::TooManySteps { steps: self.attempts(), path: self.worst() }));
        }
        if self.attempts() - self.place.0 > MOST_IN_PLACE {
            if self.t - self.place.1 < 1e-6 * self.duration {
                return Err(self.in_place(before));
            }
            self.place = (self.attempts(), self.t);
        }
        if self.crossings > MOST_CROSSINGS {
            return Err(self.chatter(MOST_CROSSINGS, self.t - self.crossings_since));
        }
        Ok(())
    }

    /// Writes the inputs of the model's own step function into the block. That function accepts or rejects steps by
    /// itself as long as they are ordinary: no special step is in progress, and no surface of observers is to be found.
    fn prepare(&mut self, stop: f64) -> u64 {
        self.know_slope();
        if self.fused.as_ref().is_some_and(|fused| !fused.ready) {
            self.step.t = self.t;
            copy(&self.x, &mut self.step.x0);
            self.know_jacobian();
        }
        let attend = self.fresh
            || self.creep.is_finite()
            || self.usual.is_some()
            || self.suspect.is_finite()
            || self.points.are_shown() && self.observed.any()
            || self.aimed.iter().any(|aimed| *aimed > 0);
        self.attends = attend;
        let fused = self.fused.as_mut().expect("asked before");
        if !fused.ready {
            fused.begin(&mut self.system, &self.x, &self.step.f0, &self.jacobian);
        }
        let pace =
            Pace { t: self.t, next: self.h, last: self.last, rejected: self.rejected, accepted: self.work.steps };
        let (lengths, watched) = ((stop, self.longest), self.points.next_probe());
        fused.prepare(&mut self.system, pace, lengths, watched, attend, &self.scales);
        fused.prepare_surfaces(&mut self.system, self.surfaces.sides(), self.surfaces.here());
        if attend { 1 } else { self.until_watched() }
    }

    /// Number of attempts until the progress callback is called again.
    fn until_watched(&self) -> u64 {
        WATCHED - self.attempts() % WATCHED
    }

    /// Counts attempts of the model's own step function: those that it has accepted and rejected, and one that it has left
    /// open.
    fn count(&mut self, accepted: u64, refused: u64, is_open: bool) {
        self.work.steps += accepted;
        self.work.stiff_steps += accepted;
        self.work.rejected += refused;
        let trials = accepted + refused + u64::from(is_open);
        self.work.jacobians += trials;
        self.system.evaluations += 8 * trials;
    }

    /// Attempts a step with the general routines and evaluates it.
    fn try_step(&mut self, stop: f64) -> Result<(), Stop> {
        let left = stop - self.t;
        let wanted = self.h.min(self.longest);
        let hits = wanted > NEARLY * left;
        self.step.t = self.t;
        self.step.h = if hits { left } else { wanted.min(HALFWAY * left) };
        if self.is_too_short(stop) {
            return Err(self.too_short(self.step.h));
        }
        // A jump at the stop has not happened before it.
        self.step.end = if hits { stop.next_down() } else { self.t + self.step.h };
        copy(&self.x, &mut self.step.x0);
        self.know_slope();
        (self.was_stiff, self.was_fused, self.inside, self.calm, self.met) = (self.stiff, false, false, false, false);
        let error = if self.stiff {
            self.stiff_attempt()
        } else {
            self.explicit.attempt(&mut self.system, &mut self.step);
            self.end_slope.copy_from_slice(self.explicit.last_slope());
            self.error()
        };
        self.conclude(error, stop)
    }

    /// Whether the step ends at the stop.
    fn hits(&self, stop: f64) -> bool {
        self.step.h == stop - self.t
    }

    fn is_too_short(&self, stop: f64) -> bool {
        !self.hits(stop) && self.step.h < (16.0 * f64::EPSILON * self.t).max(f64::MIN_POSITIVE)
    }

    /// Computes dx/dt at the present point, if unknown.
    fn know_slope(&mut self) {
        if !self.slope_known {
            self.system.slope(self.t, &self.x, &mut self.step.f0);
            self.slope_known = true;
        }
    }

    /// Accepts or rejects the step. `error`: its error relative to the allowed one.
    fn conclude(&mut self, error: f64, stop: f64) -> Result<(), Stop> {
        let wanted = self.h.min(self.longest);
        if !self.judge(error) {
            return Ok(());
        }
        let reached = if self.hits(stop) { stop } else { self.t + self.step.h };
        if self.step.h < wanted {
            self.h = self.h.max(wanted);
        }
        self.accept(reached)
    }

    /// Whether the step is accurate enough; also chooses the length of the next step.
    fn judge(&mut self, error: f64) -> bool {
        let h = self.step.h;
        // If the step crosses a surface and is as short as the rounding of time, a shorter one would be no better.
        let blurred = h <= 256.0 * f64::EPSILON * self.t && error.is_finite();
        let error = match error > 1.0 && blurred && self.surfaces.guess(&mut self.system, &self.step).is_some() {
            true => 1.0,
            false => error,
        };
        if error.is_nan() || error > 1.0 {
            self.work.rejected += 1;
            let part = if error.is_finite() { (SAFETY * inverse_fifth_root(error)).max(LEAST_GAIN) } else { 0.1 };
            self.h = part.min(MOST_REFUSED) * h;
            // If the step crossed a surface, that may be the only reason for its error.
            let ahead = self.surfaces.guess(&mut self.system, &self.step);
            self.overran = ahead.is_some();
            if let Some(theta) = ahead {
                self.meet(1);
                self.h = self.h.max(BEFORE_SURFACE * theta.min(MOST_BEFORE_SURFACE) * h);
            }
            self.rejected += 1;
            return false;
        }
        let error = error.max(LEAST_ERROR);
        let inverse = inverse_fifth_root(error);
        let mut part = SAFETY * inverse;
        if let Some((last_h, last_root)) = self.last {
            // Predictive control: assume that the error changes by the same factor again.
            part = part.min((SAFETY * (h / last_h) * last_root) * (inverse * inverse));
        }
        if self.rejected > 0 {
            part = part.min(1.0);
        }
        self.h = part.clamp(LEAST_GAIN, GREATEST_GAIN) * h;
        let square = inverse * inverse;
        self.last = Some((h, (error * (square * square)).max(LEAST_ROOT)));
        self.rejected = 0;
        self.work.steps += 1;
        self.work.stiff_steps += u64::from(self.was_stiff);
        self.consider_method();
        true
    }

    /// A stiff step with the general routine. Returns its error relative to the allowed one.
    fn stiff_attempt(&mut self) -> f64 {
        self.know_jacobian();
        if !self.rosenbrock.attempt(&mut self.system, &mut self.step, &self.jacobian) {
            return f64::INFINITY;
        }
        let error = self.error();
        if error > 1.0 {
            return error;
        }
        self.system.slope(self.step.end, &self.step.x1, &mut self.end_slope);
        error.max(self.defect())
    }

    /// The largest estimated error relative to the allowed one.
    fn error(&self) -> f64 {
        let mut worst = 0.0;
        for i in 0..self.system.n {
            let part = self.step.error[i].abs() / self.allowed(i);
            if part.is_nan() || !self.step.x1[i].is_finite() {
                return f64::INFINITY;
            }
            if part > worst {
                worst = part;
            }
        }
        worst
    }

    /// The residual of the equations at the end of the step, integrated over the fastest time constant of the Jacobian,
    /// relative to the allowed error.
    ///
    /// An error that is small for its own state can be large for a stiffer one: 1 µm/s is little for the speed of a
    /// mass, yet moves its bristle by more than the 1 pm that it is controlled to. Without this check such errors keep
    /// the bristle ringing. With it, of 300 random stick-slip runs 11 instead of 49 differ by more than 1e-3 from tol
    /// 1e-8.
    fn defect(&self) -> f64 {
        let n = self.system.n;
        let step = &self.step;
        let fastest = self.entries.fastest(&self.jacobian, 1.0 / (step.h * step.h));
        let time = 1.0 / fastest.sqrt();
        let part = |i: usize| {
            let slope = (step.x1[i] - step.x0[i] - step.k1[i] - step.k2[i] - step.k3[i]) / step.h;
            (self.end_slope[i] - slope).abs() * time / self.allowed(i)
        };
        (0..n).map(part).fold(0.0, |worst, part| if part > worst || part.is_nan() { part } else { worst })
    }

    /// Allowed error of state `i` in this step, SI.
    fn allowed(&self, i: usize) -> f64 {
        let size = self.step.x0[i].abs().max(self.step.x1[i].abs());
        self.tol * (size + self.scales[i])
    }

    /// Periodically chooses the method from the Jacobian at the start of an accepted step: the explicit method is
    /// stable up to about 3.3 divided by the largest eigenvalue, of which only the order of magnitude is known. Each
    /// return to the stiff method makes the next change away from it slower. If the stiff method is fused into a
    /// function of the model, it is always kept: its step takes no longer than the six evaluations of the explicit one,
    /// and is larger at the same error.
    fn consider_method(&mut self) {
        if self.fused.is_some() || !self.work.steps.is_multiple_of(8) {
            return;
        }
        self.know_jacobian();
        let n = self.system.n;
        // The mean eigenvalue and the mean squared eigenvalue are cheap to compute.
        let trace = self.entries.trace(&self.jacobian);
        if self.stiff && self.step.h * trace.abs() > STIFF * n as f64 {
            self.doubts = 0;
            return;
        }
        let square = self.step.h * self.step.h * self.entries.trace_of_square(&self.jacobian).abs();
        if self.stiff && square > STIFF * STIFF * n as f64 {
            self.doubts = 0;
            return;
        }
        let size = self.step.h * self.entries.spectral_radius(&self.jacobian, &self.units);
        let doubt = if self.stiff { size < 0.5 } else { size > 1.5 };
        self.doubts = if doubt { self.doubts + 1 } else { 0 };
        if self.doubts >= if self.stiff { self.patience } else { 2 } {
            self.stiff = !self.stiff;
            self.doubts = 0;
            self.last = None;
            if self.stiff {
                self.patience = self.patience.saturating_mul(4);
            }
        }
    }

    /// Computes the Jacobian at the start of the step, if unknown.
    fn know_jacobian(&mut self) {
        if let Some(fused) = self.fused.as_ref().filter(|fused| fused.ready) {
            self.jacobian.copy_from_slice(fused.jacobian(&self.system));
        } else if !self.jacobian_known {
            let (f0, units) = (&self.step.f0, &self.units);
            self.system.jacobian(self.step.t, &self.step.x0, f0, units, &mut self.jacobian);
            self.jacobian_known = true;
            self.work.jacobians += 1;
        }
    }

    /// Processes an accepted step up to its end at time `reached`, or to its first event.
    fn accept(&mut self, reached: f64) -> Result<(), Stop> {
        self.points.begin();
        self.followed = None;
        self.kept = 0.0;
        if self.calm && !self.fresh && self.aimed.iter().all(|aimed| *aimed == 0) {
            return self.accept_calm(reached);
        }
        let known = self.fused.as_ref().filter(|_| self.was_fused);
        self.surfaces.begin(&mut self.system, &self.step, self.fresh, known);
        if self.ends_before_condition() {
            return Ok(());
        }
        let (again, met) = self.is_made_again();
        if again {
            return Ok(());
        }
        let mut from = 0.0;
        while met && let Some(crossing) = self.surfaces.first(&mut self.system, &self.step, from) {
            let jump = self.jump(crossing);
            if self.acts(crossing, jump > 0.0 && !self.repeats_without_effect(crossing, jump))? {
                self.creep = f64::INFINITY;
                self.aimed.fill(0);
                return self.guard();
            }
            self.surfaces.pass(true);
            from = crossing.far;
        }
        if !met {
            // Moves the search to the end of the step.
            let crossing = self.surfaces.first(&mut self.system, &self.step, 0.0);
            debug_assert!(crossing.is_none());
        }
        self.fresh = false;
        // The counters of unsuccessful aims are reduced when a whole step meets nothing: at rest the last bits of a
        // speed cross zero at every step.
        if from == 0.0 && self.usual.is_none() {
            self.aimed.iter_mut().for_each(|aimed| *aimed = aimed.saturating_sub(1));
        }
        self.go_to_end(reached)?;
        if self.inside { Ok(()) } else { self.guard() }
    }

    /// Shows the step up to θ, whose point has the time `time`, with both sides of each surface at which observed
    /// quantities change.
    fn show_until(&mut self, theta: f64, time: f64) -> Result<(), Stop> {
        if self.observed.any() && self.points.are_shown() {
            if self.followed.is_none() {
                self.observed.begin(&mut self.system, &self.step, self.fresh, None);
            }
            let mut from = self.followed.unwrap_or(0.0);
            while let Some(crossing) = self.observed.first(&mut self.system, &self.step, from) {
                if crossing.far > theta {
                    // Not reached yet, or searched again from here on.
                    break;
                }
                let far = self.step.time(crossing.far);
                self.points.until(&mut self.system, &self.step, crossing.near, far)?;
                self.points.at(&mut self.system, &self.step, crossing.far, far)?;
                self.observed.pass(true);
                from = crossing.far;
            }
            self.followed = Some(from);
        }
        self.points.until(&mut self.system, &self.step, theta, time)
    }

    /// Shows the steps that the model's own function has accepted, from the present point on.
    fn show_settled(&mut self, settled: &Settled) -> Result<(), Stop> {
        self.step.t = self.t;
        copy(&self.x, &mut self.step.x0);
        let (mut accepted, before) = (0, self.work.steps);
        for call in 0..settled.calls {
            if settled.accepted(call) == before + accepted {
                continue;
            }
            accepted += 1;
            let reached = settled.step(call, &mut self.step);
            self.points.begin();
            if let Err(stop) = self.points.until(&mut self.system, &self.step, 1.0, reached) {
                self.count(accepted, call as u64 + 1 - accepted, false);
                self.t = self.step.t;
                return Err(stop);
            }
            self.step.t = reached;
            std::mem::swap(&mut self.step.x0, &mut self.step.x1);
        }
        Ok(())
    }

    /// Enlarges the scale of a state to its largest magnitude.
    fn reach(&mut self) {
        for (scale, x) in self.scales.iter_mut().zip(&self.x) {
            *scale = if *scale < x.abs() { x.abs() } else { *scale };
        }
    }

    /// Processes an accepted step that meets nothing.
    fn accept_calm(&mut self, reached: f64) -> Result<(), Stop> {
        let fused = self.fused.as_ref().expect("it made the step");
        self.surfaces.go_on(fused.surfaces(&self.system)[1]);
        self.go_to_end(reached)
    }

    /// Shows a step up to its end at time `reached`, where the next one starts.
    fn go_to_end(&mut self, reached: f64) -> Result<(), Stop> {
        if self.creep.is_infinite() {
            // The condition at which the step was aimed was not crossed.
            self.h = self.h.max(self.usual.take().unwrap_or(0.0));
        }
        self.h = self.h.min(self.creep);
        self.creep = f64::INFINITY;
        // Steps approach that instant by halving, so a release before it is located.
        if self.suspect - reached <= 256.0 * f64::EPSILON * reached {
            self.suspect = f64::INFINITY;
        }
        self.h = self.h.min(0.5 * (self.suspect - reached));
        self.show_until(1.0, reached)?;
        self.keep(1.0, reached)?;
        self.t = reached;
        copy(&self.step.x1, &mut self.x);
        self.reach();
        copy(&self.end_slope, &mut self.step.f0);
        self.slope_known = true;
        self.jacobian_known = false;
        if let Some(fused) = &mut self.fused {
            match self.was_fused {
                true => fused.go_on(&mut self.system),
                false => fused.ready = false,
            }
        }
        Ok(())
    }

    /// Performs the action of a crossing. Returns whether the step ends there: where states or regimes change, and
    /// where derivatives jump.
    fn acts(&mut self, crossing: Crossing, jumps: bool) -> Result<bool, Stop> {
        let time = self.step.time(crossing.far);
        self.show_until(crossing.near, time)?;
        self.keep(crossing.near, time)?;
        self.step.at(crossing.far, &mut self.x);
        self.system.place(time, &self.x);
        if !self.settle()? && !jumps {
            self.points.at(&mut self.system, &self.step, crossing.far, time)?;
            return Ok(false);
        }
        self.x.copy_from_slice(&self.system.instance.block()[self.system.states.clone()]);
        if !self.x.iter().all(|x| x.is_finite()) {
            check_finite(&self.system.instance)?;
        }
        self.t = time;
        self.reach();
        self.suspect = f64::INFINITY;
        self.work.events += 1;
        self.surfaces.changed().for_each(|surface| self.last_events[surface] = time);
        let surface = self.surfaces.changed().next();
        self.events.push_back((time, surface));
        if self.events.len() > MOST_EVENTS {
            let (first, _) = self.events.pop_front().expect("there are more than a hundred");
            if time - first < SOON * self.duration {
                return Err(self.chatter(MOST_EVENTS, time - first));
            }
        }
        self.keep_here()?;
        self.points.here(&mut self.system, self.t, &self.x)?;
        self.restart();
        let usual = self.usual.take().unwrap_or(self.h);
        self.h = usual.min(self.first_step());
        Ok(true)
    }

    /// Stores the history of delayed quantities along the step, from where it was stored last up to θ, whose point has
    /// the time `time`.
    fn keep(&mut self, theta: f64, time: f64) -> Result<(), Stop> {
        if self.system.history.is_empty() || theta <= self.kept {
            return Ok(());
        }
        let from = std::mem::replace(&mut self.kept, theta);
        let at = |run: &mut Self, theta: f64| {
            run.step.at(theta, &mut run.beside);
            // A jump at the end has not happened before it.
            run.system.place(run.step.time(theta).min(run.step.end), &run.beside);
            let status = run.system.instance.call(Function::Outputs);
            check_status(&run.system.instance, status)
        };
        at(self, 0.5 * (from + theta))?;
        let middle = self.system.history.present(&self.system.instance);
        at(self, theta)?;
        let pieces = self.system.history.pieces(&middle, &self.system.instance, self.tol);
        for piece in 1..=pieces {
            let theta = from + (theta - from) * f64::from(piece) / f64::from(pieces);
            at(self, theta)?;
            let t = if piece == pieces { time } else { self.step.time(theta) };
            self.system.history.push(t, &self.system.instance);
        }
        Ok(())
    }

    /// Stores the values of delayed quantities after an event or tick; a jump is met again one delay later.
    fn keep_here(&mut self) -> Result<(), Stop> {
        if self.system.history.is_empty() {
            return Ok(());
        }
        self.system.place(self.t, &self.x);
        let status = self.system.instance.call(Function::Outputs);
        check_status(&self.system.instance, status)?;
        for echo in self.system.history.push(self.t, &self.system.instance) {
            if let Err(at) = self.corners.binary_search_by(|corner| corner.total_cmp(&echo)) {
                self.corners.insert(at, echo);
            }
        }
        Ok(())
    }

    /// Executes transitions until none fires, at most as often as there are regimes. Returns whether any fired.
    fn settle(&mut self) -> Result<bool, Stop> {
        if !self.system.instance.has(Function::Transitions) {
            return Ok(false);
        }
        let description = self.system.instance.description().clone();
        let regimes: usize = description.automata.iter().map(|automaton| automaton.regimes.len()).sum();
        let (states, active) = (description.layout.states.range(), description.layout.regimes.range());
        let mut happened = false;
        for _ in 0..=regimes.max(1) {
            let block = self.system.instance.block();
            let before = (block[states.clone()].to_vec(), block[active.clone()].to_vec());
            let status = self.system.instance.call(Function::Transitions);
            check_status(&self.system.instance, status)?;
            let block = self.system.instance.block();
            if block[states.clone()] == before.0[..] && block[active.clone()] == before.1[..] {
                return Ok(happened);
            }
            happened = true;
        }
        Err(self.chatter(0, 0.0))
    }

    /// At a stop: executes the sampled blocks that are due, and restarts after them and after corners of signals.
    fn arrive(&mut self) -> Result<(), Stop> {
        let description = self.system.instance.description().clone();
        let mut due = false;
        self.system.place(self.t, &self.x);
        for (tick, (period, number)) in description.ticks.iter().zip(&mut self.ticks) {
            if *period * *number as f64 - self.t <= 1e-9 * *period {
                self.system.instance.set(tick.due, 1.0);
                *number += 1;
                due = true;
            }
        }
        if due {
            let status = self.system.instance.call(Function::Tick);
            for tick in &description.ticks {
                self.system.instance.set(tick.due, 0.0);
            }
            check_status(&self.system.instance, status)?;
            self.work.ticks += 1;
        } else if self.corners.binary_search_by(|corner| corner.total_cmp(&self.t)).is_err() {
            return Ok(());
        }
        self.settle()?;
        self.x.copy_from_slice(&self.system.instance.block()[self.system.states.clone()]);
        self.reach();
        self.keep_here()?;
        self.points.here(&mut self.system, self.t, &self.x)?;
        self.restart();
        Ok(())
    }

    /// Discards everything that refers to the solution before an event.
    fn restart(&mut self) {
        self.moved = true;
        self.surfaces.restart(&mut self.system, self.t, &self.x);
        self.observed.restart(&mut self.system, self.t, &self.x);
        self.slope_known = false;
        self.jacobian_known = false;
        self.fused.iter_mut().for_each(|fused| fused.ready = false);
        self.last = None;
        self.fresh = true;
    }

    /// A length over which no state changes by more than a hundredth of |x| + s plus the change that its rate makes in
    /// a hundred-thousandth of the run: a state that begins at 0 has no scale yet.
    fn first_step(&mut self) -> f64 {
        self.system.slope(self.t, &self.x, &mut self.step.f0);
        self.slope_known = true;
        let soon = 1e-5 * self.duration;
        let rate = |i: usize| {
            let f = self.step.f0[i].abs();
            f / (self.x[i].abs() + self.scales[i] + soon * f)
        };
        let fastest = (0..self.system.n).map(rate).fold(0.0, f64::max);
        if fastest > 0.0 { self.longest.min(0.01 / fastest) } else { self.longest }
    }

    /// Checks that no quantity has left its range.
    fn guard(&mut self) -> Result<(), Stop> {
        if self.system.instance.description().guards.is_empty() {
            return Ok(());
        }
        let description = self.system.instance.description().clone();
        self.system.place(self.t, &self.x);
        if description.guards.iter().any(|guard| !description.layout.states.contains(guard.slot)) {
            let status = self.system.instance.call(Function::Outputs);
            check_status(&self.system.instance, status)?;
        }
        let left = description.guards.iter().zip(&self.fine).position(|(guard, (least, greatest))| {
            let value = self.system.instance.get(guard.slot);
            !(value >= *least && value <= *greatest && value.is_finite())
        });
        check_status(&self.system.instance, left.map_or(0, |guard| guard as u64 + 1))
    }

    /// Number of step attempts so far.
    fn attempts(&self) -> u64 {
        self.work.steps + self.work.rejected
    }

    fn stop(&self, cause: Cause) -> Stop {
        Stop { cause, time: self.t }
    }

    /// Path of the state with the largest error in the last attempt.
    fn worst(&self) -> String {
        let part = |i: usize| {
            let part = self.step.error[i].abs() / (self.x[i].abs() + self.scales[i]);
            if part.is_nan() { f64::INFINITY } else { part }
        };
        let worst = (0..self.system.n).max_by(|a, b| part(*a).total_cmp(&part(*b)));
        let description = self.system.instance.description();
        let slot = worst.map(|i| description.layout.states.slot(i));
        let named = description.quantities.iter().find(|quantity| Some(quantity.slot) == slot);
        named.map_or_else(|| "t".into(), |quantity| quantity.path.clone())
    }

    /// Why steps became too short: a value is not finite, or something jumps without a switching surface.
    fn too_short(&self, h: f64) -> Stop {
        let bad = self.step.f0.iter().chain(&self.step.x1).position(|value| !value.is_finite());
        match bad {
            Some(i) => {
                let i = i % self.system.n;
                let slot = self.system.instance.description().layout.states.slot(i);
                let named = self.system.instance.description().quantities.iter().find(|q| q.slot == slot);
                let path = named.map_or_else(|| format!("state {i}"), |quantity| quantity.path.clone());
                let value = if self.step.f0[i].is_finite() { self.step.x1[i] } else { self.step.f0[i] };
                self.stop(Cause::NotFinite { path, value })
            }
            // At a surface that is met again within the shortest step, the model switches faster than time can resolve.
            None if self.overran => self.chatter(1, h),
            None => {
                let size = |(x, unit): (&f64, &f64)| x.abs() / unit;
                let grown = self.x.iter().zip(&self.units).map(size).fold(0.0, f64::max);
                self.stop(Cause::StepTooShort { step: h, path: self.worst(), grown })
            }
        }
    }

    /// Counts surfaces met; restarts the count if the model has moved since.
    fn meet(&mut self, times: usize) {
        self.crossings += times;
        let far = 3.0 * self.tol.min(1e-6).sqrt();
        let moved = |i: usize| (self.x[i] - self.crossings_at[i]).abs() > far * (self.x[i].abs() + self.scales[i]);
        if (0..self.system.n).any(moved) {
            (self.crossings, self.crossings_since) = (0, self.t);
            copy(&self.x, &mut self.crossings_at);
            self.surfaces.forget();
        }
    }

    /// Why the run makes no progress: a surface met recently rejects all longer steps.
    fn in_place(&mut self, before: u64) -> Stop {
        let recent = self.t - 1e-3 * self.duration;
        self.events.retain(|(time, _)| *time >= recent);
        if self.events.is_empty() && self.surfaces.often().next().is_none() {
            let steps = self.attempts() - before;
            return self.stop(Cause::TooManySteps { steps, path: self.worst() });
        }
        self.chatter(1, self.h)
    }

    fn chatter(&self, times: usize, within: f64) -> Stop {
        let description = self.system.instance.description();
        let regime = |automaton: &abi::description::Automaton| {
            let name = &automaton.regimes[self.system.instance.get(automaton.slot) as usize];
            if automaton.path.is_empty() { name.clone() } else { format!("{}.{name}", automaton.path) }
        };
        let mut crossed: Vec<usize> = self.events.iter().filter_map(|(_, surface)| *surface).collect();
        // If there are many, report the ones that switch all the time; the others were crossed once.
        let often = self.surfaces.often();
        if times == MOST_EVENTS || times == 0 {
            crossed.extend(self.surfaces.changed())
        } else {
            crossed.extend(often)
        }
        crossed.sort();
        crossed.dedup();
        let chatter = Chatter {
            regimes: description.automata.iter().map(regime).collect(),
            conditions: crossed.into_iter().map(|i| description.roots[i].text.clone()).collect(),
            times,
            within,
        };
        Stop { cause: Cause::Chatter(Box::new(chatter)), time: self.system.instance.get(Slot::TIME) }
    }
}

impl Stepper for Adaptive {
    fn function(&self) -> Function {
        Function::Rosenbrock
    }

    fn next(&mut self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<Option<u64>, Stop> {
        // The end is a goal like any other: actions due there are executed.
        while self.goal.is_some() || self.t < self.duration {
            let (stop, before) = self.goal.unwrap_or_else(|| (self.next_stop(), self.attempts()));
            self.goal = Some((stop, before));
            if stop - self.t <= LEAST_STEP * stop {
                self.t = stop;
                self.goal = None;
                self.arrive()?;
                continue;
            }
            self.look_around(before, watch)?;
            if self.stiff && self.fused.is_some() {
                return Ok(Some(self.prepare(stop)));
            }
            self.try_step(stop)?;
        }
        self.finish()?;
        Ok(None)
    }

    fn series(&self) -> Option<(&[Slot], u64)> {
        let series = self.series.as_ref().filter(|_| !self.attends && self.stiff)?;
        Some((&series.slots, self.until_watched()))
    }

    /// Shows the steps that the function has accepted.
    fn show(&mut self, calls: u64, column: &dyn Fn(usize, &mut [f64])) -> Result<(), Stop> {
        let mut series = self.series.take().expect("its slots were asked for");
        series.read(calls as usize, column);
        let shown = self.show_settled(&series);
        self.series = Some(series);
        shown
    }

    /// Accepts the steps that the function has completed, and evaluates the one that it left open, if any.
    fn take(&mut self, _: u64, status: u64) -> Result<(), Stop> {
        self.moved = false;
        let (stop, _) = self.goal.expect("there was one when it was prepared");
        let fused = self.fused.as_ref().expect("it made trials");
        let (pace, refused, overruns) = fused.settled(&self.system);
        let accepted = pace.accepted - self.work.steps;
        if accepted > 0 {
            (self.t, self.last) = (pace.t, pace.last);
            let (x, f) = fused.start(&self.system);
            copy(x, &mut self.x);
            copy(f, &mut self.step.f0);
            self.surfaces.go_on(fused.here(&self.system));
            copy(fused.scales(&self.system), &mut self.scales);
            self.jacobian_known = false;
        }
        if accepted + refused > 0 {
            (self.h, self.rejected) = (pace.next, pace.rejected);
            self.overran = if refused > 0 { overruns > 0 } else { self.overran };
        }
        if overruns > 0 {
            self.meet(overruns as usize);
        }
        self.count(accepted, refused, status != 0);
        if status == 0 {
            return Ok(());
        }
        let fused = self.fused.as_ref().expect("it made trials");
        self.step.t = self.t;
        copy(&self.x, &mut self.step.x0);
        let judged = fused.left(&self.system, &mut self.step, &mut self.end_slope, status);
        if self.is_too_short(stop) {
            return Err(self.too_short(self.step.h));
        }
        self.was_stiff = true;
        self.was_fused = judged.is_some();
        self.inside = judged.as_ref().is_some_and(|judged| !judged.outside);
        self.met = judged.as_ref().is_some_and(|judged| judged.met);
        self.calm = self.inside && !self.met;
        let error = match judged {
            Some(Judged { error, .. }) if error.is_nan() => f64::INFINITY,
            Some(Judged { error, defect, .. }) if error <= 1.0 => error.max(defect),
            Some(Judged { error, .. }) => error,
            None => self.stiff_attempt(),
        };
        self.conclude(error, stop)
    }

    fn instance(&mut self) -> &mut Instance {
        &mut self.system.instance
    }

    fn probe(&mut self) -> &mut Probe {
        self.points.probe_mut()
    }

    fn fetch(&mut self, _: u64, status: u64, from: &dyn Fn(Range<usize>, &mut [f64])) {
        let fused = self.fused.as_ref().expect("it made trials");
        fused.fetch(status, self.system.instance.block_mut(), from);
    }

    fn bring(&self, to: &mut dyn FnMut(Range<usize>, &[f64])) {
        let (fused, block) = (self.fused.as_ref().expect("it is to make trials"), self.system.instance.block());
        match self.moved {
            true => to(0..block.len(), block),
            false => fused.given().iter().for_each(|range| to(range.clone(), block)),
        }
    }

    fn rest(self: Box<Self>) -> Rest {
        let work = Work { evaluations: self.system.evaluations, ..self.work };
        Rest { instance: self.system.instance, observer: self.points.observer(), work, notes: Vec::new() }
    }
}
