//! Which points of an adaptive run are shown: the ends of its steps, both sides of events, and as many between as make
//! straight lines do; and wherever a quantity turns, so that no extreme is missed.
//!
//! In: accepted steps in order. Out: points, to an [`Observer`]. Evaluates outputs only if somebody looks.

use super::step::{Step, System};
use crate::observe::{Observer, check_status};
use crate::outcome::Stop;
use abi::plan::Experiment;
use abi::{Function, Instance};

/// A run is shown by no fewer points than this, if it is shown at all. A prime, so that it falls in with no period.
const LEAST_POINTS: f64 = 1009.0;

/// An interval between two shown points is halved at most so often.
const DEPTH: usize = 8;

/// The points shown so far.
pub(crate) struct Points {
    observer: Observer,
    duration: f64,
    /// Slots that somebody looks at.
    slots: Vec<usize>,
    /// Whether all that is looked at are states.
    only_states: bool,
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

impl Points {
    pub(crate) fn new(instance: &Instance, observer: Observer, experiment: &Experiment) -> Points {
        let slots: Vec<usize> = match observer.only_last() {
            true => Vec::new(),
            false => observer.slots().iter().map(|slot| slot.index()).collect(),
        };
        let states = instance.description().layout.states;
        Points {
            only_states: observer.slots().iter().chain(observer.probe.slots()).all(|slot| states.contains(*slot)),
            duration: experiment.duration,
            theta: 0.0,
            rows: vec![0.0; slots.len() * (DEPTH + 4)],
            spans: vec![(f64::INFINITY, f64::NEG_INFINITY); slots.len()],
            // A plot needs no more than its pixels. Integrals want more; extremes and periods find their own way.
            bend: if observer.measures() { experiment.solver.tol.max(1e-5) } else { 1e-3 },
            turns: Vec::new(),
            block: instance.block().to_vec(),
            x: vec![0.0; instance.description().layout.states.len as usize],
            slots,
            observer,
        }
    }

    /// Shows the present point as it is: at the start, behind an event.
    pub(crate) fn here(&mut self, system: &mut System, t: f64, x: &[f64]) -> Result<(), Stop> {
        // Those at the start. An event comes behind those before it.
        while self.observer.probe.next().is_some_and(|instant| instant <= t) {
            system.place(t, x);
            self.probe(system)?;
        }
        if self.slots.is_empty() {
            return Ok(());
        }
        system.place(t, x);
        self.sample_block(system, 0)?;
        self.emit(0, t);
        Ok(())
    }

    /// Who has seen the points.
    pub(crate) fn observer(self) -> Observer {
        self.observer
    }

    /// Whether every step is shown.
    pub(crate) fn are_shown(&self) -> bool {
        !self.slots.is_empty()
    }

    /// The next instant at which somebody wants a value, in s; infinite if there is none.
    pub(crate) fn next_probe(&self) -> f64 {
        self.observer.probe.next().unwrap_or(f64::INFINITY)
    }

    /// A new step begins where the last one was shown.
    pub(crate) fn begin(&mut self) {
        self.theta = 0.0;
    }

    /// The outputs of the end are in the block; they are shown if nothing else was.
    pub(crate) fn end(&mut self, system: &System) -> Result<(), Stop> {
        while self.observer.probe.next().is_some_and(|instant| instant <= self.duration) {
            self.observer.probe.take(system.instance.block());
        }
        if self.observer.only_last() { self.observer.see(&system.instance) } else { Ok(()) }
    }

    /// Shows the course of the step from where it was shown last to θ, whose point is said to be at `time`.
    pub(crate) fn until(&mut self, system: &mut System, step: &Step, theta: f64, time: f64) -> Result<(), Stop> {
        while let Some(instant) = self.observer.probe.next().filter(|instant| *instant <= time) {
            step.at(((instant - step.t) / step.h).clamp(0.0, theta), &mut self.x);
            system.place(instant, &self.x);
            self.probe(system)?;
        }
        if self.slots.is_empty() || theta <= self.theta {
            return Ok(());
        }
        let from = self.theta;
        let pieces = (LEAST_POINTS * step.h * (theta - from) / self.duration).ceil().max(2.0);
        for piece in 1..=pieces as u32 {
            let start = self.theta;
            let last = f64::from(piece) == pieces;
            let end = if last { theta } else { from + (theta - from) * f64::from(piece) / pieces };
            self.sample(system, step, 1, end)?;
            self.between(system, step, (start, 0), (end, 1), DEPTH)?;
            self.emit(1, if last { time } else { step.time(end) });
            let width = self.slots.len();
            self.rows.copy_within(width..2 * width, 0);
            self.theta = end;
        }
        Ok(())
    }

    /// Keeps what is wanted at the instant in the block.
    fn probe(&mut self, system: &mut System) -> Result<(), Stop> {
        self.compute(system)?;
        self.observer.probe.take(system.instance.block());
        Ok(())
    }

    /// Computes what is looked at, of states and time that are in the block.
    fn compute(&self, system: &mut System) -> Result<(), Stop> {
        if self.only_states {
            return Ok(());
        }
        let status = system.instance.call(Function::Outputs);
        check_status(&system.instance, status)
    }

    /// Shows one more point of the step.
    pub(crate) fn at(&mut self, system: &mut System, step: &Step, theta: f64, time: f64) -> Result<(), Stop> {
        if self.slots.is_empty() {
            return Ok(());
        }
        self.sample(system, step, 0, theta)?;
        self.emit(0, time);
        self.theta = theta;
        Ok(())
    }

    /// Shows points between two rows until straight lines between them do; and wherever a quantity turns.
    fn between(
        &mut self,
        system: &mut System,
        step: &Step,
        (from, row_from): (f64, usize),
        (to, row_to): (f64, usize),
        depth: usize,
    ) -> Result<(), Stop> {
        let middle = 0.5 * (from + to);
        let row = DEPTH + 2 - depth;
        self.sample(system, step, row, middle)?;
        let width = self.slots.len();
        let mut straight = true;
        self.turns.clear();
        for i in 0..width {
            let [a, m, b] = [row_from, row, row_to].map(|row| self.rows[row * width + i]);
            let (low, high) = self.spans[i];
            let span = high.max(b) - low.min(b);
            let bend = a - 2.0 * m + b;
            straight &= 0.5 * bend.abs() <= self.bend * span + 1e-15 * m.abs();
            // On the parabola through the three, with −1 at a and 1 at b.
            let turn = 0.5 * (a - b) / bend;
            let beyond = 0.25 * (b - a) * turn;
            if turn.abs() < 1.0 && beyond.abs() > 1e-9 * span {
                self.turns.push(middle + 0.5 * turn * (to - from));
            }
        }
        if !straight && depth > 1 {
            self.between(system, step, (from, row_from), (middle, row), depth - 1)?;
            // The right half needs the rows below this one only.
            self.emit(row, step.time(middle));
            return self.between(system, step, (middle, row), (to, row_to), depth - 1);
        }
        self.turns.sort_by(f64::total_cmp);
        let early = self.turns.partition_point(|turn| *turn < middle);
        for i in 0..self.turns.len() {
            if i == early {
                self.emit(row, step.time(middle));
            }
            let turn = self.turns[i];
            self.sample(system, step, row + 1, turn)?;
            self.emit(row + 1, step.time(turn));
        }
        if early == self.turns.len() {
            self.emit(row, step.time(middle));
        }
        Ok(())
    }

    /// Puts the values at θ into a row.
    fn sample(&mut self, system: &mut System, step: &Step, row: usize, theta: f64) -> Result<(), Stop> {
        step.at(theta, &mut self.x);
        system.place(step.time(theta), &self.x);
        self.sample_block(system, row)
    }

    fn sample_block(&mut self, system: &mut System, row: usize) -> Result<(), Stop> {
        self.compute(system)?;
        let width = self.slots.len();
        let block = system.instance.block();
        let mut doubt = 0.0;
        for (value, slot) in self.rows[row * width..].iter_mut().zip(&self.slots) {
            *value = block[*slot];
            doubt += 0.0 * *value;
        }
        if doubt != 0.0 { self.observer.check(&system.instance) } else { Ok(()) }
    }

    fn emit(&mut self, row: usize, time: f64) {
        let width = self.slots.len();
        let values = &self.rows[row * width..(row + 1) * width];
        for ((value, slot), span) in values.iter().zip(&self.slots).zip(&mut self.spans) {
            self.block[*slot] = *value;
            *span = (span.0.min(*value), span.1.max(*value));
        }
        self.observer.show(time, &self.block);
    }
}
