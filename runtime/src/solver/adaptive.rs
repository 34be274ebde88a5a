//! Joins steps to a run: chooses method and length, stops at events, ticks and corners, shows the points.
//!
//! Every state i is controlled by itself: its estimated error stays below tol · (|x| + s), with s half the width of
//! its declared range, or 1 in its declared unit where that is open. Step lengths follow Gustafsson's predictive
//! control (Hairer & Wanner, Solving ODEs II, sec. IV.8). An event ends its step at the far end of a bracket of 1e-12
//! of the run; a surface at which neither states nor regimes change and the derivatives do not jump ends nothing.
//! Nothing here depends on the platform's elementary functions, so a run has the same bits everywhere.

use super::explicit::Explicit;
use super::linear;
use super::rosenbrock::Rosenbrock;
use super::step::{Step, System};
use super::surfaces::{Crossing, Surfaces};
use crate::observe::{Observer, check_finite, check_status};
use crate::outcome::{Cause, Chatter, Continue, Stop, Work};
use abi::description::Kind;
use abi::plan::Experiment;
use abi::{Function, Instance, Slot};
use std::collections::VecDeque;

/// Steps tried at most between two stops. A run that needs more is told so; it would take minutes.
const MOST_ATTEMPTS: u64 = 5_000_000;

/// More events than this within a millionth of the run are chatter.
const MOST_EVENTS: usize = 100;

/// Steps are chosen this part of what the error would allow.
const SAFETY: f64 = 0.9;

/// The fifth root of an error of a hundredth: a smaller one says little about the next step.
const LEAST_ROOT: f64 = 0.4;

/// A run is shown by no fewer points than this, if it is shown at all. A prime, so that it falls in with no period.
const LEAST_POINTS: f64 = 1009.0;

/// An interval between two shown points is halved at most so often.
const DEPTH: usize = 8;

/// Runs the experiment on the instance to its end or to the reason why not.
pub(crate) fn run(
    instance: &mut Instance,
    experiment: &Experiment,
    observer: &mut Observer,
    work: &mut Work,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Result<(), Stop> {
    if !instance.has(Function::Derivatives) && instance.description().layout.states.len > 0 {
        return Err(Stop { cause: Cause::NoDerivatives, time: 0.0 });
    }
    let status = instance.start(0.0);
    check_status(instance, status)?;
    check_finite(instance)?;
    let mut run = Adaptive::new(instance, experiment, observer);
    let result = run.go(watch);
    run.work.evaluations = run.system.evaluations;
    *work = run.work;
    result
}

struct Adaptive<'a> {
    system: System<'a>,
    observer: &'a mut Observer,
    duration: f64,
    corners: &'a [f64],
    tol: f64,
    /// Scale of each state, SI.
    scales: Vec<f64>,
    t: f64,
    x: Vec<f64>,
    /// Length of the next step in s, and of the longest that is allowed.
    h: f64,
    longest: f64,
    step: Step,
    /// Whether `step.f0` and `jacobian` are those at (t, x).
    slope_known: bool,
    /// Whether the method that made the last step knows the slope at its end.
    end_slope_known: bool,
    jacobian_known: bool,
    jacobian: Vec<f64>,
    room: Vec<f64>,
    rosenbrock: Rosenbrock,
    explicit: Explicit,
    /// Which of the two is at work.
    stiff: bool,
    /// How often in a row the Jacobian spoke for the other one, and how often it must before the stiff one goes.
    doubts: u32,
    patience: u32,
    /// Length of the last accepted step, and the fifth root of its error; none after a restart.
    last: Option<(f64, f64)>,
    rejected: bool,
    /// The next step is no longer than this, for a surface is just ahead.
    creep: f64,
    /// Four slopes around a crossing.
    slopes: Vec<f64>,
    surfaces: Surfaces,
    /// Whether no step has been made since the last restart.
    fresh: bool,
    /// Time and a crossed surface of each of the last events.
    events: VecDeque<(f64, Option<usize>)>,
    /// For each sampled block its period in s and the number of its next tick.
    ticks: Vec<(f64, u64)>,
    shown: Shown,
    work: Work,
}

/// The points shown so far.
struct Shown {
    /// Slots that somebody looks at.
    slots: Vec<usize>,
    /// θ of the last point shown.
    theta: f64,
    /// Rows of values of the slots: the last one shown, then room for those between.
    rows: Vec<f64>,
    /// Least and greatest value of each slot.
    spans: Vec<(f64, f64)>,
    /// A straight line between two points may miss the course by this part of the span.
    bend: f64,
    /// θ at which quantities turn, between two points.
    turns: Vec<f64>,
    /// A block in which only time and the slots count.
    block: Vec<f64>,
    x: Vec<f64>,
}

impl<'a> Adaptive<'a> {
    fn new(instance: &'a mut Instance, experiment: &'a Experiment, observer: &'a mut Observer) -> Adaptive<'a> {
        let description = instance.description().clone();
        let states = &description.layout.states;
        let scale = |i: usize| {
            let slot = states.slot(i);
            let quantity = description.quantities.iter().find(|q| q.kind == Kind::State && q.slot == slot);
            let Some(quantity) = quantity else { return 1.0 };
            let half = 0.5 * (quantity.range.1 - quantity.range.0);
            if half > 0.0 && half.is_finite() { half } else { quantity.unit.scale }
        };
        let scales: Vec<f64> = (0..states.len as usize).map(scale).collect();
        let period = |slot| {
            let period = instance.get(slot);
            assert!(period > 0.0, "a sampled block with a period of {period} s");
            period
        };
        let ticks = description.ticks.iter().map(|tick| (period(tick.period), 1)).collect();
        let tol = experiment.solver.tol;
        assert!(tol > 0.0 && tol < 1.0, "a tolerance of {tol}");
        let slots: Vec<usize> = match observer.only_last() {
            true => Vec::new(),
            false => observer.slots().iter().map(|slot| slot.index()).collect(),
        };
        let shown = Shown {
            theta: 0.0,
            rows: vec![0.0; slots.len() * (DEPTH + 4)],
            spans: vec![(f64::INFINITY, f64::NEG_INFINITY); slots.len()],
            // A plot needs no more than its pixels. Integrals want more; extremes and periods find their own way.
            bend: if observer.measures() { tol.max(1e-5) } else { 1e-3 },
            turns: Vec::new(),
            block: instance.block().to_vec(),
            x: vec![0.0; scales.len()],
            slots,
        };
        let system = System::new(instance);
        let n = system.n;
        Adaptive {
            duration: experiment.duration,
            corners: &experiment.corners,
            tol,
            t: 0.0,
            x: system.instance.block()[system.states.clone()].to_vec(),
            h: 0.0,
            longest: experiment.duration / 50.0,
            step: Step::new(n),
            slope_known: false,
            end_slope_known: false,
            jacobian_known: false,
            jacobian: vec![0.0; n * n + n],
            room: vec![0.0; 2 * n * n],
            rosenbrock: Rosenbrock::new(n),
            explicit: Explicit::new(n),
            stiff: true,
            doubts: 0,
            patience: 3,
            last: None,
            rejected: false,
            creep: f64::INFINITY,
            slopes: vec![0.0; 4 * n],
            surfaces: Surfaces::new(&system, 1e-12 * experiment.duration),
            fresh: true,
            events: VecDeque::new(),
            ticks,
            shown,
            work: Work::default(),
            scales,
            system,
            observer,
        }
    }

    fn go(&mut self, watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
        self.show_here()?;
        while self.observer.probe.next().is_some_and(|instant| instant <= 0.0) {
            self.probe()?;
        }
        self.restart();
        self.h = self.first_step();
        while self.t < self.duration {
            let stop = self.next_stop();
            self.reach(stop, watch)?;
            self.arrive()?;
        }
        let (t, x) = (self.t, &self.x);
        self.system.place(t, x);
        let status = self.system.instance.call(Function::Outputs);
        check_status(self.system.instance, status)?;
        check_finite(self.system.instance)?;
        while self.observer.probe.next().is_some_and(|instant| instant <= self.duration) {
            self.probe()?;
        }
        if self.observer.only_last() {
            self.observer.see(self.system.instance)?;
        }
        Ok(())
    }

    /// The next instant that must be met exactly.
    fn next_stop(&self) -> f64 {
        let corner = self.corners.partition_point(|corner| *corner <= self.t);
        let corner = self.corners.get(corner).copied().unwrap_or(self.duration);
        let tick = self.ticks.iter().map(|(period, number)| period * *number as f64).fold(self.duration, f64::min);
        corner.min(tick).min(self.duration)
    }

    /// Steps up to `stop`.
    fn reach(&mut self, stop: f64, watch: &mut dyn FnMut(f64) -> Continue) -> Result<(), Stop> {
        let before = self.attempts();
        while stop - self.t > 32.0 * f64::EPSILON * stop {
            if self.attempts().is_multiple_of(64) && watch(self.t / self.duration).is_break() {
                return Err(self.stop(Cause::Stopped));
            }
            if self.attempts() - before >= MOST_ATTEMPTS {
                return Err(self.stop(Cause::TooManySteps { steps: self.attempts(), path: self.worst() }));
            }
            let left = stop - self.t;
            let wanted = self.h.min(self.longest);
            let mut h = wanted;
            let hits = h > 0.999 * left;
            if hits {
                h = left;
            } else if h > 0.5 * left {
                h = 0.5 * left;
            }
            if !hits && h < (16.0 * f64::EPSILON * self.t).max(f64::MIN_POSITIVE) {
                return Err(self.too_short(h));
            }
            self.step.t = self.t;
            self.step.h = h;
            // What jumps at the stop has not jumped before it.
            self.step.end = if hits { stop.next_down() } else { self.t + h };
            if self.attempt() {
                let reached = if hits { stop } else { self.t + h };
                if h < wanted {
                    self.h = self.h.max(wanted);
                }
                self.accept(reached)?;
            }
        }
        self.t = stop;
        Ok(())
    }

    /// Tries a step; chooses the length of the next. Returns whether the step is accurate enough.
    fn attempt(&mut self) -> bool {
        let h = self.step.h;
        self.step.x0.copy_from_slice(&self.x);
        if !self.slope_known {
            self.system.slope(self.t, &self.x, &mut self.step.f0);
            self.slope_known = true;
        }
        let stiff = self.stiff;
        let solved = if stiff {
            self.know_jacobian();
            self.rosenbrock.attempt(&mut self.system, &mut self.step, &self.jacobian)
        } else {
            self.explicit.attempt(&mut self.system, &mut self.step);
            true
        };
        let error = if solved { self.error() } else { f64::INFINITY };
        if error > 1.0 {
            self.work.rejected += 1;
            let part = if error.is_finite() { (SAFETY / fifth_root(error)).max(0.2) } else { 0.1 };
            self.h = part.min(0.9) * h;
            // Where the step ran over a surface, that may be all that is wrong with it.
            if let Some(theta) = self.surfaces.guess(&mut self.system, &self.step) {
                self.h = self.h.max(0.95 * theta.min(0.9) * h);
            }
            self.rejected = true;
            return false;
        }
        let root = fifth_root(error.max(1e-10));
        let mut part = SAFETY / root;
        if let Some((last_h, last_root)) = self.last {
            // What the error did from step to step, it will do again.
            part = part.min(SAFETY * (h / last_h) * last_root / (root * root));
        }
        if self.rejected {
            part = part.min(1.0);
        }
        self.h = part.clamp(0.2, 6.0) * h;
        self.last = Some((h, root.max(LEAST_ROOT)));
        self.rejected = false;
        self.work.steps += 1;
        self.work.stiff_steps += u64::from(stiff);
        self.end_slope_known = !stiff;
        self.consider_method();
        true
    }

    /// Largest estimated error as a part of what is allowed.
    fn error(&self) -> f64 {
        let mut worst = 0.0;
        for (i, s) in self.scales.iter().enumerate() {
            let size = self.step.x0[i].abs().max(self.step.x1[i].abs());
            let part = self.step.error[i].abs() / (self.tol * (size + s));
            if part.is_nan() || !self.step.x1[i].is_finite() {
                return f64::INFINITY;
            }
            if part > worst {
                worst = part;
            }
        }
        worst
    }

    /// Now and then, asks the Jacobian at the start of an accepted step which method suits: the explicit one is stable
    /// up to about 3.3 times its largest eigenvalue, of which only the order of magnitude is known. Each return to the
    /// stiff method makes the next change away from it slower.
    fn consider_method(&mut self) {
        if !self.work.steps.is_multiple_of(8) {
            return;
        }
        self.know_jacobian();
        let n = self.system.n;
        // The mean eigenvalue is cheap to know.
        let trace: f64 = (0..n).map(|i| self.jacobian[i * n + i]).sum();
        if self.stiff && self.step.h * trace.abs() > 0.5 * n as f64 {
            self.doubts = 0;
            return;
        }
        let (matrix, room) = self.room.split_at_mut(n * n);
        for row in 0..n {
            for column in 0..n {
                matrix[row * n + column] = self.jacobian[row * n + column] * self.scales[column] / self.scales[row];
            }
        }
        let size = self.step.h * linear::spectral_radius(n, matrix, room);
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

    /// The Jacobian at the start of the step.
    fn know_jacobian(&mut self) {
        if !self.jacobian_known {
            let (f0, scales) = (&self.step.f0, &self.scales);
            self.system.jacobian(self.step.t, &self.step.x0, f0, scales, &mut self.jacobian);
            self.jacobian_known = true;
            self.work.jacobians += 1;
        }
    }

    /// Follows an accepted step up to its end at time `reached`, or to its first event.
    fn accept(&mut self, reached: f64) -> Result<(), Stop> {
        self.shown.theta = 0.0;
        self.surfaces.begin(&mut self.system, &self.step, self.fresh);
        let mut from = 0.0;
        while let Some(crossing) = self.surfaces.first(&mut self.system, &self.step, from) {
            let jump = self.jump(crossing);
            if from == 0.0 && self.shorten(crossing, jump) {
                self.surfaces.again();
                return Ok(());
            }
            if self.acts(crossing, jump > 0.0)? {
                self.creep = f64::INFINITY;
                return self.guard();
            }
            self.surfaces.pass(true);
            from = crossing.far;
        }
        self.fresh = false;
        self.h = self.h.min(self.creep);
        self.creep = f64::INFINITY;
        self.show_until(1.0, reached)?;
        self.t = reached;
        self.x.copy_from_slice(&self.step.x1);
        self.slope_known = self.end_slope_known;
        if self.slope_known {
            self.step.f0.copy_from_slice(self.explicit.last_slope());
        }
        self.jacobian_known = false;
        self.guard()
    }

    /// Stages behind a surface at which derivatives jump spoil a step, though its error seems small. Where that could
    /// matter, the step is made again up to just before the surface, and the next one is so short that it cannot.
    fn shorten(&mut self, crossing: Crossing, jump: f64) -> bool {
        let h = self.step.h;
        if jump * (1.0 - crossing.near) * h <= 0.1 {
            return false;
        }
        // Not within the bracket: nothing is known there.
        let margin = (0.05 / jump).max(4.0 * (crossing.far - crossing.near) * h);
        let before = crossing.near * h - margin;
        let (shorter, creep) =
            if before > margin { (before, 2.0 * margin) } else { (crossing.near * h + margin, f64::INFINITY) };
        if shorter > 0.99 * h || shorter < 64.0 * f64::EPSILON * self.t {
            return false;
        }
        (self.h, self.creep) = (shorter, creep);
        self.last = None;
        self.work.steps -= 1;
        self.work.stiff_steps -= u64::from(!self.end_slope_known);
        self.work.rejected += 1;
        true
    }

    /// Does what a crossing asks for. Returns whether the step ends there: where states or regimes change, and where
    /// derivatives jump.
    fn acts(&mut self, crossing: Crossing, jumps: bool) -> Result<bool, Stop> {
        let time = self.step.time(crossing.far);
        self.show_until(crossing.near, time)?;
        self.step.at(crossing.far, &mut self.x);
        self.system.place(time, &self.x);
        if !self.settle()? && !jumps {
            self.show_point(crossing.far, time)?;
            return Ok(false);
        }
        self.x.copy_from_slice(&self.system.instance.block()[self.system.states.clone()]);
        if !self.x.iter().all(|x| x.is_finite()) {
            check_finite(self.system.instance)?;
        }
        self.t = time;
        self.work.events += 1;
        let surface = self.surfaces.changed().next();
        self.events.push_back((time, surface));
        if self.events.len() > MOST_EVENTS {
            let (first, _) = self.events.pop_front().expect("there are more than a hundred");
            if time - first < 1e-6 * self.duration {
                return Err(self.chatter(time - first));
            }
        }
        self.show_here()?;
        self.restart();
        self.h = self.h.min(self.first_step());
        Ok(true)
    }

    /// Lets transitions happen until none does, at most as often as there are regimes. Returns whether any did.
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
            check_status(self.system.instance, status)?;
            let block = self.system.instance.block();
            if block[states.clone()] == before.0[..] && block[active.clone()] == before.1[..] {
                return Ok(happened);
            }
            happened = true;
        }
        Err(self.chatter(0.0))
    }

    /// By how much derivatives jump at a crossing, as error tolerances of their states gathered per second; 0 where
    /// they jump by less than their own tolerance, or change about as much beside the crossing in the same time.
    fn jump(&mut self, crossing: Crossing) -> f64 {
        let n = self.system.n;
        let width = crossing.far - crossing.near;
        let beside = [crossing.near - width, crossing.near, crossing.far, crossing.far + width];
        for (theta, f) in beside.into_iter().zip(self.slopes.chunks_exact_mut(n.max(1))) {
            self.step.at(theta, &mut self.shown.x);
            self.system.slope(self.step.time(theta), &self.shown.x, f);
        }
        let mut rate = 0.0f64;
        for (i, s) in self.scales.iter().enumerate() {
            let [before, near, far, after] = [0, 1, 2, 3].map(|row| self.slopes[row * n + i]);
            let jump = (far - near).abs();
            // The polynomial says nothing outside its step.
            let earlier = if beside[0] >= 0.0 { (near - before).abs() } else { 0.0 };
            let later = if beside[3] <= 1.0 { (after - far).abs() } else { 0.0 };
            let drift = earlier.max(later);
            if jump > self.tol * (near.abs() + s) && jump > 4.0 * drift {
                rate = rate.max(jump / (self.tol * (self.step.x0[i].abs() + s)));
            }
        }
        rate
    }

    /// At a stop: the blocks that are due, what follows from them, and from corners of signals.
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
            check_status(self.system.instance, status)?;
            self.work.ticks += 1;
        } else if self.corners.binary_search_by(|corner| corner.total_cmp(&self.t)).is_err() {
            return Ok(());
        }
        self.settle()?;
        self.x.copy_from_slice(&self.system.instance.block()[self.system.states.clone()]);
        self.show_here()?;
        self.restart();
        Ok(())
    }

    /// Forgets what belongs to the course before an event.
    fn restart(&mut self) {
        self.surfaces.restart(&mut self.system, self.t, &self.x);
        self.slope_known = false;
        self.jacobian_known = false;
        self.last = None;
        self.fresh = true;
    }

    /// A length over which no state changes by more than a hundredth of |x| + s.
    fn first_step(&mut self) -> f64 {
        self.system.slope(self.t, &self.x, &mut self.step.f0);
        self.slope_known = true;
        let rate = |i: usize| self.step.f0[i].abs() / (self.x[i].abs() + self.scales[i]);
        let fastest = (0..self.system.n).map(rate).fold(0.0, f64::max);
        if fastest > 0.0 { self.longest.min(0.01 / fastest) } else { self.longest }
    }

    /// Ranges that are watched, with the slack of a millionth that fixed steps have.
    fn guard(&mut self) -> Result<(), Stop> {
        let description = self.system.instance.description().clone();
        if description.guards.is_empty() {
            return Ok(());
        }
        self.system.place(self.t, &self.x);
        if description.guards.iter().any(|guard| !description.layout.states.contains(guard.slot)) {
            let status = self.system.instance.call(Function::Outputs);
            check_status(self.system.instance, status)?;
        }
        let left = description.guards.iter().position(|guard| {
            let (low, high) = guard.range;
            let width = high - low;
            let slack = |bound: f64| 1e-6 * if width.is_finite() { width } else { bound.abs() };
            let value = self.system.instance.get(guard.slot);
            let above = low == f64::NEG_INFINITY || value >= low - slack(low);
            let below = high == f64::INFINITY || value <= high + slack(high);
            !(above && below && value.is_finite())
        });
        check_status(self.system.instance, left.map_or(0, |guard| guard as u64 + 1))
    }

    /// Shows the present point as it is: at the start, behind an event.
    fn show_here(&mut self) -> Result<(), Stop> {
        if self.shown.slots.is_empty() {
            return Ok(());
        }
        self.system.place(self.t, &self.x);
        self.sample_block(0)?;
        self.emit(0, self.t);
        Ok(())
    }

    /// Shows the course of the step from where it was shown last to θ, whose point is said to be at `time`.
    fn show_until(&mut self, theta: f64, time: f64) -> Result<(), Stop> {
        while let Some(instant) = self.observer.probe.next().filter(|instant| *instant <= time) {
            let at = ((instant - self.step.t) / self.step.h).clamp(0.0, theta);
            self.step.at(at, &mut self.shown.x);
            self.system.place(instant, &self.shown.x);
            self.probe()?;
        }
        if self.shown.slots.is_empty() || theta <= self.shown.theta {
            return Ok(());
        }
        let from = self.shown.theta;
        let pieces = (LEAST_POINTS * self.step.h * (theta - from) / self.duration).ceil().max(4.0);
        for piece in 1..=pieces as u32 {
            let start = self.shown.theta;
            let last = f64::from(piece) == pieces;
            let end = if last { theta } else { from + (theta - from) * f64::from(piece) / pieces };
            self.sample(1, end)?;
            self.between(start, 0, end, 1, DEPTH)?;
            self.emit(1, if last { time } else { self.step.time(end) });
            let width = self.shown.slots.len();
            self.shown.rows.copy_within(width..2 * width, 0);
            self.shown.theta = end;
        }
        Ok(())
    }

    /// Keeps what is wanted at the instant in the block.
    fn probe(&mut self) -> Result<(), Stop> {
        let status = self.system.instance.call(Function::Outputs);
        check_status(self.system.instance, status)?;
        self.observer.probe.take(self.system.instance.block());
        Ok(())
    }

    /// Shows one more point of the step.
    fn show_point(&mut self, theta: f64, time: f64) -> Result<(), Stop> {
        if self.shown.slots.is_empty() {
            return Ok(());
        }
        self.sample(0, theta)?;
        self.emit(0, time);
        self.shown.theta = theta;
        Ok(())
    }

    /// Shows points between two rows until straight lines between them do; and wherever a quantity turns.
    fn between(&mut self, from: f64, row_from: usize, to: f64, row_to: usize, depth: usize) -> Result<(), Stop> {
        let middle = 0.5 * (from + to);
        let row = DEPTH + 2 - depth;
        self.sample(row, middle)?;
        let width = self.shown.slots.len();
        let mut straight = true;
        self.shown.turns.clear();
        for i in 0..width {
            let [a, m, b] = [row_from, row, row_to].map(|row| self.shown.rows[row * width + i]);
            let (low, high) = self.shown.spans[i];
            let span = high.max(b) - low.min(b);
            let bend = a - 2.0 * m + b;
            straight &= 0.5 * bend.abs() <= self.shown.bend * span + 1e-15 * m.abs();
            // On the parabola through the three, with −1 at a and 1 at b.
            let turn = 0.5 * (a - b) / bend;
            let beyond = 0.25 * (b - a) * turn;
            if turn.abs() < 1.0 && beyond.abs() > 1e-9 * span {
                self.shown.turns.push(middle + 0.5 * turn * (to - from));
            }
        }
        if !straight && depth > 1 {
            self.between(from, row_from, middle, row, depth - 1)?;
            // The right half needs the rows below this one only.
            self.emit(row, self.step.time(middle));
            return self.between(middle, row, to, row_to, depth - 1);
        }
        self.shown.turns.sort_by(f64::total_cmp);
        let early = self.shown.turns.partition_point(|turn| *turn < middle);
        for i in 0..self.shown.turns.len() {
            if i == early {
                self.emit(row, self.step.time(middle));
            }
            let turn = self.shown.turns[i];
            self.sample(row + 1, turn)?;
            self.emit(row + 1, self.step.time(turn));
        }
        if early == self.shown.turns.len() {
            self.emit(row, self.step.time(middle));
        }
        Ok(())
    }

    /// Puts the values at θ into a row.
    fn sample(&mut self, row: usize, theta: f64) -> Result<(), Stop> {
        self.step.at(theta, &mut self.shown.x);
        self.system.place(self.step.time(theta), &self.shown.x);
        self.sample_block(row)
    }

    fn sample_block(&mut self, row: usize) -> Result<(), Stop> {
        let status = self.system.instance.call(Function::Outputs);
        check_status(self.system.instance, status)?;
        let width = self.shown.slots.len();
        let block = self.system.instance.block();
        let mut doubt = 0.0;
        for (value, slot) in self.shown.rows[row * width..].iter_mut().zip(&self.shown.slots) {
            *value = block[*slot];
            doubt += 0.0 * *value;
        }
        if doubt != 0.0 { self.observer.check(self.system.instance) } else { Ok(()) }
    }

    fn emit(&mut self, row: usize, time: f64) {
        let width = self.shown.slots.len();
        let values = &self.shown.rows[row * width..(row + 1) * width];
        for ((value, slot), span) in values.iter().zip(&self.shown.slots).zip(&mut self.shown.spans) {
            self.shown.block[*slot] = *value;
            *span = (span.0.min(*value), span.1.max(*value));
        }
        self.observer.show(time, &self.shown.block);
    }

    /// Steps tried so far.
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

    /// Why steps became too short: something is not finite, or something jumps where no surface says so.
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
            None => self.stop(Cause::StepTooShort { step: h, path: self.worst() }),
        }
    }

    fn chatter(&self, within: f64) -> Stop {
        let description = self.system.instance.description();
        let regime = |automaton: &abi::description::Automaton| {
            let name = &automaton.regimes[self.system.instance.get(automaton.slot) as usize];
            if automaton.path.is_empty() { name.clone() } else { format!("{}.{name}", automaton.path) }
        };
        let mut crossed: Vec<usize> = self.events.iter().filter_map(|(_, surface)| *surface).collect();
        crossed.extend(self.surfaces.changed());
        crossed.sort();
        crossed.dedup();
        let chatter = Chatter {
            regimes: description.automata.iter().map(regime).collect(),
            conditions: crossed.into_iter().map(|i| description.roots[i].text.clone()).collect(),
            within,
        };
        Stop { cause: Cause::Chatter(Box::new(chatter)), time: self.system.instance.get(Slot::TIME) }
    }
}

/// The fifth root of a positive number to six digits, by Newton's method from its exponent: the same bits on every
/// machine.
fn fifth_root(x: f64) -> f64 {
    // A fifth of the exponent, and of the fraction as if the logarithm were straight in between.
    let bias = 1023u64 << 52;
    let mut y = f64::from_bits(x.to_bits() / 5 + bias / 5 * 4);
    for _ in 0..3 {
        let square = y * y;
        y += 0.2 * (x / (square * square) - y);
    }
    y
}

#[test]
fn fifth_roots() {
    for n in -300..300 {
        let x = 10f64.powf(0.1 * f64::from(n));
        assert!((fifth_root(x) / x.powf(0.2) - 1.0).abs() < 1e-6, "{x}");
    }
}
