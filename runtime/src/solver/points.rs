//! Selects the points of an adaptive run to show: the ends of its steps, both sides of events, the edges of windows,
//! and as many points in between as linear interpolation needs; also each turning point of a quantity, so that no
//! extreme is missed. Measures may need more points between them than a plot does, which are not recorded. Integrals
//! between points are taken from the dense output.
//!
//! In: accepted steps in order. Out: points and integrals, passed to an [`Observer`]. Evaluates outputs only if they
//! are observed, and never changes a step.

use super::step::{Step, System};
use crate::run::measure::{Demand, Wants};
use crate::run::observe::{Observer, Probe, check_status};
use crate::run::outcome::Stop;
use crate::stretch::{Stretch, copy_column};
use abi::plan::Experiment;
use abi::{Function, Instance, Slot};

/// Least number of points, if the run is shown at all. A prime, so that it does not alias with a period.
const LEAST_POINTS: f64 = 1009.0;

/// Most bisections of an interval between two shown points.
const DEPTH: usize = 8;

/// Most bisections of an interval over which an integral is taken.
const MOST_HALVED: usize = 8;

/// Allowed error of linear interpolation in plots, as a fraction of the span: no more resolution than their pixels.
const BEND: f64 = 1e-3;

/// Allowed error of an integral, as a fraction of the tolerance.
const OF_TOLERANCE: f64 = 0.01;

/// Nodes of the Lobatto rule with four points and of its Kronrod extension with seven, from −1 to 1; and their weights.
/// Exact up to degree five and nine: the square of a state between the ends of a step has degree eight. Source: Gander
/// & Gautschi, Adaptive Quadrature – Revisited, BIT 40 (2000).
const NODES: [f64; 7] =
    [-1.0, -0.816_496_580_927_726, -0.447_213_595_499_957_9, 0.0, 0.447_213_595_499_957_9, 0.816_496_580_927_726, 1.0];
const FINE: [f64; 7] =
    [77.0 / 1470.0, 432.0 / 1470.0, 625.0 / 1470.0, 672.0 / 1470.0, 625.0 / 1470.0, 432.0 / 1470.0, 77.0 / 1470.0];
const ROUGH: [f64; 7] = [1.0 / 6.0, 0.0, 5.0 / 6.0, 0.0, 5.0 / 6.0, 0.0, 1.0 / 6.0];

/// An integral that a measure needs.
struct Area {
    /// Number of the measure.
    measure: usize,
    /// The column of its quantity in a row, and its number among the states, if it is one.
    column: usize,
    state: Option<usize>,
    square: bool,
    /// Whether the present interval lies in its window.
    inside: bool,
    /// Integral over the present interval, and that of the magnitude.
    part: (f64, f64),
    /// Integral of the magnitude so far in this window, and its duration in s.
    magnitude: (f64, f64),
}

impl Area {
    fn of(&self, value: f64) -> f64 {
        if self.square { value * value } else { value }
    }

    /// Whether the present interval lies in its window, and is to be halved until the integral is accurate.
    fn is_open(&self) -> bool {
        self.inside && self.state.is_none()
    }
}

/// The integral of a state or of its square over a part of a step. The rule is exact for both.
fn integral_of_state(step: &Step, state: usize, square: bool, (from, to): (f64, f64)) -> f64 {
    let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
    let value = |node: f64| step.state_at(state, (middle + half * node).clamp(from, to));
    let of = |value: f64| if square { value * value } else { value };
    half * step.h * NODES.iter().zip(FINE).map(|(node, weight)| weight * of(value(*node))).sum::<f64>()
}

/// What the observers need of a slot between the ends of a step.
struct Column {
    /// Its number among the states, if it is one.
    state: Option<usize>,
    /// Whether it is recorded, or a measure interpolates between its points.
    lines: bool,
    /// Whether its turning points are located exactly, and whether only those that exceed all points so far.
    turning: bool,
    only_extremes: bool,
    /// Allowed error of linear interpolation between two points, as a fraction of the span; at most [`BEND`].
    bend: f64,
}

impl Column {
    /// Whether the points at the ends of a part of a step show all of it. `span`: the bounds of the points so far.
    fn needs_only_ends(&self, step: &Step, part: (f64, f64), span: (f64, f64)) -> bool {
        let is_plain =
            |state: usize| step.is_monotonic(state, part) || self.only_extremes && step.is_within(state, part, span);
        !(self.lines || self.turning && !self.state.is_some_and(is_plain))
    }
}

/// Most points that measures see together.
const TOGETHER: usize = 64;

/// Points that measures have not seen yet.
struct Unseen {
    slots: Vec<Slot>,
    times: Vec<f64>,
    /// Row-major, SI.
    values: Vec<f64>,
    stretch: Stretch,
}

impl Unseen {
    /// Shows them.
    fn show(&mut self, observer: &mut Observer) {
        let Unseen { slots, times, values, stretch } = self;
        if times.is_empty() {
            return;
        }
        let column = |k: usize, to: &mut [f64]| copy_column(&values[k..], slots.len(), to);
        stretch.fill(times.len(), &|to| to.copy_from_slice(times), slots, &column);
        observer.expectations.see_stretch(stretch);
        times.clear();
        values.clear();
    }
}

/// The points shown so far.
pub(crate) struct Points {
    observer: Observer,
    duration: f64,
    /// Slots that are observed.
    slots: Vec<usize>,
    /// Whether all observed slots are states.
    only_states: bool,
    tol: f64,
    /// Instants in s at which windows begin or end, ascending, and the index of the next.
    edges: Vec<f64>,
    edge: usize,
    areas: Vec<Area>,
    columns: Vec<Column>,
    /// Values at the seven nodes of an integral, row-major.
    nodes: Vec<f64>,
    /// θ of the last point shown, and of the ends of the part of the step that is being shown.
    theta: f64,
    part: (f64, f64),
    /// Rows of values of the slots: the last one shown, then buffers for those in between.
    rows: Vec<f64>,
    /// Least and greatest value of each slot.
    spans: Vec<(f64, f64)>,
    /// θ and column of each turning point between two points.
    turns: Vec<(f64, usize)>,
    /// A block in which only time and the observed slots are valid.
    block: Vec<f64>,
    x: Vec<f64>,
    /// Time in s at which the values of the first row hold. An integral that begins there takes them for its first node.
    row_time: f64,
    /// θ and time in s of the last node of an integral, whose values are known.
    node: Option<(f64, f64)>,
    /// Points for measures, which see many together unless somebody else sees them too or waits for what they see.
    unseen: Option<Unseen>,
}

impl Points {
    pub(crate) fn new(instance: &Instance, mut observer: Observer, experiment: &Experiment) -> Points {
        let slots: Vec<usize> = match observer.only_last() {
            true => Vec::new(),
            false => observer.slots().iter().map(|slot| slot.index()).collect(),
        };
        let states = instance.description().layout.states;
        let tol = experiment.solver.tol;
        observer.expectations.expect_areas(tol);
        let demands = observer.expectations.demands();
        let state = |slot: usize| states.range().contains(&slot).then(|| slot - states.range().start);
        let column = |demand: &Demand| slots.iter().position(|slot| *slot == demand.slot.index());
        let areas = demands.iter().enumerate().filter_map(|(measure, demand)| {
            let wanted = matches!(demand.what, Wants::Area | Wants::Square);
            column(demand).filter(|_| wanted).map(|column| Area {
                measure,
                column,
                state: state(slots[column]),
                square: demand.what == Wants::Square,
                inside: false,
                part: (0.0, 0.0),
                magnitude: (0.0, 0.0),
            })
        });
        // Whether an integral is to be taken depends on the points so far.
        let waits = observer.expectations.are_opened_by_events();
        let sees_together = observer.recorder.is_empty() && !waits && !slots.contains(&Slot::TIME.index());
        let recorded: Vec<usize> = observer.recorder.slots().map(|slot| slot.index()).collect();
        let columns = slots.iter().map(|slot| {
            let wants = |what| demands.iter().any(|demand| demand.what == what && demand.slot.index() == *slot);
            Column {
                state: state(*slot),
                lines: wants(Wants::Points) || recorded.contains(slot),
                turning: wants(Wants::Turns) || wants(Wants::Extremes),
                only_extremes: !wants(Wants::Turns),
                // Periods and the like use cubics through points, whose error is about the square of that of lines;
                // integrals and extremes have their own error control.
                bend: if wants(Wants::Points) { (1e-2 * tol.sqrt()).min(1e-5) } else { BEND },
            }
        });
        Points {
            areas: areas.collect(),
            columns: columns.collect(),
            nodes: vec![0.0; 7 * slots.len()],
            edges: observer.expectations.instants(),
            edge: 0,
            tol,
            only_states: observer.slots().iter().chain(observer.probe.slots()).all(|slot| states.contains(*slot)),
            duration: experiment.duration,
            theta: 0.0,
            part: (0.0, 0.0),
            rows: vec![0.0; slots.len() * (DEPTH + 4)],
            spans: vec![(f64::INFINITY, f64::NEG_INFINITY); slots.len()],
            turns: Vec::new(),
            block: instance.block().to_vec(),
            x: vec![0.0; instance.description().layout.states.len as usize],
            row_time: f64::NAN,
            node: None,
            unseen: sees_together.then(|| Unseen {
                slots: slots.iter().map(|slot| Slot(*slot as u32)).collect(),
                times: Vec::new(),
                values: Vec::new(),
                stretch: Stretch::default(),
            }),
            slots,
            observer,
        }
    }

    /// Shows the present point as it is: at the start, or after an event.
    pub(crate) fn here(&mut self, system: &mut System, t: f64, x: &[f64]) -> Result<(), Stop> {
        // Requested instants at the start. At an event, the values after it come after those before it.
        while self.observer.probe.next().is_some_and(|instant| instant <= t) {
            system.place(t, x);
            self.probe(system)?;
        }
        if self.slots.is_empty() {
            return Ok(());
        }
        system.place(t, x);
        self.sample_block(system, 0)?;
        self.row_time = t;
        self.emit(0, t, true);
        Ok(())
    }

    /// Returns the observer.
    pub(crate) fn observer(mut self) -> Observer {
        if let Some(unseen) = &mut self.unseen {
            unseen.show(&mut self.observer);
        }
        self.observer
    }

    /// Whether every step is shown.
    pub(crate) fn are_shown(&self) -> bool {
        !self.slots.is_empty()
    }

    /// What is recorded at given instants.
    pub(crate) fn probe_mut(&mut self) -> &mut Probe {
        &mut self.observer.probe
    }

    /// The next instant at which a value is requested, in s; infinite if there is none.
    pub(crate) fn next_probe(&self) -> f64 {
        self.observer.probe.next().unwrap_or(f64::INFINITY)
    }

    /// Begins a new step where the last one ended.
    pub(crate) fn begin(&mut self) {
        self.theta = 0.0;
        self.node = None;
    }

    /// Ends the run, with the final outputs in the block; shows them if nothing else was shown.
    pub(crate) fn end(&mut self, system: &System) -> Result<(), Stop> {
        while self.observer.probe.next().is_some_and(|instant| instant <= self.duration) {
            self.observer.probe.take(system.instance.block());
        }
        if self.observer.only_last() { self.observer.see(&system.instance) } else { Ok(()) }
    }

    /// Shows the step from where it was shown last up to θ, whose point has the time `time`.
    pub(crate) fn until(&mut self, system: &mut System, step: &Step, theta: f64, time: f64) -> Result<(), Stop> {
        // An instant at the end of the step has the values after a tick or an event there: it is shown by `here`, by the
        // next step, or at the end of the run. Ticks are multiples of a period and instants those of a decimal: they may
        // differ in the last bit.
        let before = time * (1.0 - 4.0 * f64::EPSILON);
        while let Some(instant) = self.observer.probe.next().filter(|instant| *instant < before) {
            step.at(((instant - step.t) / step.h).clamp(0.0, theta), &mut self.x);
            system.place(instant, &self.x);
            self.probe(system)?;
        }
        if self.slots.is_empty() || theta <= self.theta {
            return Ok(());
        }
        while let Some(&instant) = self.edges.get(self.edge).filter(|edge| **edge < time) {
            let edge = (instant - step.t) / step.h;
            if edge > self.theta && edge < theta {
                self.span(system, step, edge, instant)?;
            }
            self.edge += 1;
        }
        self.span(system, step, theta, time)
    }

    /// The same for an interval without an edge inside.
    fn span(&mut self, system: &mut System, step: &Step, theta: f64, time: f64) -> Result<(), Stop> {
        let from = self.theta;
        self.part = (from, theta);
        if !self.areas.is_empty() {
            self.area(system, step, (from, theta), MOST_HALVED)?;
        }
        let mut columns = self.columns.iter().zip(&self.spans);
        if columns.all(|(column, span)| column.needs_only_ends(step, (from, theta), *span)) {
            self.sample(system, step, 0, theta)?;
            self.emit(0, time, true);
            self.theta = theta;
            return Ok(());
        }
        let pieces = (LEAST_POINTS * step.h * (theta - from) / self.duration).ceil().max(2.0);
        for piece in 1..=pieces as u32 {
            let start = self.theta;
            let last = f64::from(piece) == pieces;
            let end = if last { theta } else { from + (theta - from) * f64::from(piece) / pieces };
            self.sample(system, step, 1, end)?;
            self.between(system, step, (start, 0), (end, 1), (DEPTH, true))?;
            self.emit(1, if last { time } else { step.time(end) }, true);
            let width = self.slots.len();
            self.rows.copy_within(width..2 * width, 0);
            self.row_time = step.time(end);
            self.theta = end;
        }
        Ok(())
    }

    /// Takes the integrals over an interval of the step without an edge inside, with bisection where needed.
    fn area(&mut self, system: &mut System, step: &Step, (from, to): (f64, f64), halves: usize) -> Result<(), Stop> {
        let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
        let (now, length) = (step.t + middle * step.h, (to - from) * step.h);
        let mut is_open = false;
        for area in &mut self.areas {
            let (after, before) = self.observer.expectations.window(area.measure);
            area.inside = after < now && now < before;
            is_open |= area.is_open();
            if let Some(state) = area.state.filter(|_| area.inside && halves == MOST_HALVED) {
                let all = integral_of_state(step, state, area.square, (from, to));
                self.observer.expectations.give_area(area.measure, all);
            }
        }
        if !is_open {
            return Ok(());
        }
        let width = self.slots.len();
        for (k, node) in NODES.into_iter().enumerate() {
            let theta = (middle + half * node).clamp(from, to);
            // A jump at the end has not happened before it.
            let time = step.time(middle + half * node).min(step.end);
            if (theta, time) == (self.theta, self.row_time) {
                self.nodes[k * width..][..width].copy_from_slice(&self.rows[..width]);
                continue;
            }
            step.at(theta, &mut self.x);
            system.place(time, &self.x);
            self.compute(system)?;
            let (row, block) = (&mut self.nodes[k * width..(k + 1) * width], system.instance.block());
            row.iter_mut().zip(&self.slots).for_each(|(value, slot)| *value = block[*slot]);
            self.node = Some((theta, time));
        }
        let mut is_accurate = true;
        for area in self.areas.iter_mut().filter(|area| area.is_open()) {
            let values: [f64; 7] = std::array::from_fn(|k| area.of(self.nodes[k * width + area.column]));
            let rule = |weights: &[f64; 7], values: &[f64; 7]| {
                0.5 * length * weights.iter().zip(values).map(|(weight, value)| weight * value).sum::<f64>()
            };
            let (total, magnitude) = (rule(&FINE, &values), rule(&FINE, &values.map(f64::abs)));
            area.part = (total, magnitude);
            let usual = area.magnitude.0 * (length / area.magnitude.1.max(length));
            let off = (total - rule(&ROUGH, &values)).abs();
            let allowed = OF_TOLERANCE * self.tol * magnitude.max(usual);
            // The low-order rule has order six, the high-order one order ten: the error scales with the power 5/3. The
            // next larger exponent that square roots can compute is 7/4.
            let part = off / magnitude.max(usual);
            let foreseen = if part < 1e-3 { 10.0 * off * (part * part.sqrt()).sqrt().min(1.0) } else { off };
            is_accurate &= foreseen <= allowed || off <= 1e-15 * magnitude.max(usual) || !off.is_finite();
        }
        if halves > 0 && !is_accurate {
            self.area(system, step, (from, middle), halves - 1)?;
            return self.area(system, step, (middle, to), halves - 1);
        }
        for area in self.areas.iter_mut().filter(|area| area.is_open()) {
            let (total, magnitude) = area.part;
            area.magnitude = (area.magnitude.0 + magnitude, area.magnitude.1 + length);
            self.observer.expectations.give_area(area.measure, total);
        }
        Ok(())
    }

    /// Records the requested values at the instant in the block.
    fn probe(&mut self, system: &mut System) -> Result<(), Stop> {
        self.compute(system)?;
        self.observer.probe.take(system.instance.block());
        Ok(())
    }

    /// Computes the observed slots from the states and the time in the block.
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
        self.emit(0, time, true);
        self.theta = theta;
        Ok(())
    }

    /// Shows points between two rows until linear interpolation is accurate enough; and each turning point. `for_all`:
    /// whether the point in the middle is shown not only to measures.
    fn between(
        &mut self,
        system: &mut System,
        step: &Step,
        (from, row_from): (f64, usize),
        (to, row_to): (f64, usize),
        (depth, for_all): (usize, bool),
    ) -> Result<(), Stop> {
        let middle = 0.5 * (from + to);
        let row = DEPTH + 2 - depth;
        self.sample(system, step, row, middle)?;
        let width = self.slots.len();
        let (mut straight, mut looks_straight) = (true, true);
        self.turns.clear();
        for i in 0..width {
            if !(self.columns[i].lines || self.columns[i].turning) {
                continue;
            }
            let [a, m, b] = [row_from, row, row_to].map(|row| self.rows[row * width + i]);
            let (low, high) = self.spans[i];
            let span = high.max(b) - low.min(b);
            let bend = a - 2.0 * m + b;
            let is_within = |part: f64| 0.5 * bend.abs() <= part * span + 1e-15 * m.abs();
            straight &= is_within(self.columns[i].bend);
            looks_straight &= is_within(BEND);
            // On the parabola through the three points, with −1 at a and 1 at b.
            if 0.5 * (a - b).abs() < bend.abs() {
                let turn = 0.5 * (a - b) / bend;
                let beyond = 0.25 * (b - a) * turn;
                if turn.abs() < 1.0 && beyond.abs() > 1e-9 * span {
                    self.turns.push((middle + 0.5 * turn * (to - from), i));
                }
            }
        }
        if !straight && depth > 1 {
            let halves = (depth - 1, for_all && !looks_straight);
            self.between(system, step, (from, row_from), (middle, row), halves)?;
            // The right half needs only the rows below this one.
            self.emit(row, step.time(middle), for_all);
            return self.between(system, step, (middle, row), (to, row_to), halves);
        }
        for k in 0..self.turns.len() {
            let (turn, column) = self.turns[k];
            if self.columns[column].turning {
                self.turns[k].0 = self.refine(system, step, (from, to), (turn, column))?;
            }
        }
        self.turns.sort_by(|a, b| a.0.total_cmp(&b.0));
        let early = self.turns.partition_point(|(turn, _)| *turn < middle);
        for i in 0..self.turns.len() {
            if i == early {
                self.emit(row, step.time(middle), for_all);
            }
            let (turn, _) = self.turns[i];
            self.sample(system, step, row + 1, turn)?;
            self.emit(row + 1, step.time(turn), true);
        }
        if early == self.turns.len() {
            self.emit(row, step.time(middle), for_all);
        }
        Ok(())
    }

    /// Locates a turning point by Newton's method on the derivative from five points, exact where the quantity is a
    /// state. `turn`: its approximate position, and the column.
    fn refine(
        &mut self,
        system: &mut System,
        step: &Step,
        (from, to): (f64, f64),
        (turn, column): (f64, usize),
    ) -> Result<f64, Stop> {
        // The polynomial is valid up to the ends of the part that is shown.
        let (first, last) = self.part;
        let d = (0.02 * (to - from)).min(0.4 * (turn - first).min(last - turn));
        if d < 1e-3 * (to - from) {
            return Ok(turn);
        }
        let mut theta = turn;
        for _ in 0..6 {
            let mut y = [0.0; 5];
            for (y, k) in y.iter_mut().zip([-2.0, -1.0, 0.0, 1.0, 2.0]) {
                step.at(theta + k * d, &mut self.x);
                system.place(step.time(theta + k * d), &self.x);
                self.compute(system)?;
                *y = system.instance.block()[self.slots[column]];
            }
            let slope = (8.0 * (y[3] - y[1]) - (y[4] - y[0])) / (12.0 * d);
            let bend = (16.0 * (y[3] + y[1]) - (y[4] + y[0]) - 30.0 * y[2]) / (12.0 * d * d);
            let next = theta - slope / bend;
            if !(next - 2.0 * d >= first && next + 2.0 * d <= last && next >= from && next <= to) {
                return Ok(turn);
            }
            let by = (next - theta).abs();
            theta = next;
            if by <= 1e-9 * (to - from) {
                break;
            }
        }
        Ok(theta)
    }

    /// Writes the values at θ into a row.
    fn sample(&mut self, system: &mut System, step: &Step, row: usize, theta: f64) -> Result<(), Stop> {
        let time = step.time(theta);
        if row == 0 {
            self.row_time = time;
        }
        let width = self.slots.len();
        let is_known = self.node == Some((theta, time));
        let (last, values) = (&self.nodes[6 * width..], &mut self.rows[row * width..][..width]);
        if is_known && last.iter().all(|value| value.is_finite()) {
            values.copy_from_slice(last);
            return Ok(());
        }
        if self.only_states {
            let states = self.columns.iter().filter_map(|column| column.state);
            values.iter_mut().zip(states).for_each(|(value, state)| *value = step.state_at(state, theta));
            if values.iter().all(|value| value.is_finite()) {
                return Ok(());
            }
        }
        step.at(theta, &mut self.x);
        system.place(time, &self.x);
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

    fn emit(&mut self, row: usize, time: f64, for_all: bool) {
        let width = self.slots.len();
        let values = &self.rows[row * width..(row + 1) * width];
        for (value, span) in values.iter().zip(&mut self.spans) {
            *span = (span.0.min(*value), span.1.max(*value));
        }
        match &mut self.unseen {
            Some(unseen) => {
                unseen.times.push(time);
                unseen.values.extend_from_slice(values);
                if unseen.times.len() == TOGETHER {
                    unseen.show(&mut self.observer);
                }
            }
            None => {
                self.slots.iter().zip(values).for_each(|(slot, value)| self.block[*slot] = *value);
                self.observer.show(time, &self.block, for_all);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    /// The rule agrees with the integrals of the polynomial's terms. A mutant with the weights of the rule with four nodes
    /// fails with seed 1.
    #[test]
    fn integrals_of_a_state_and_of_its_square_are_exact() {
        for seed in 1..=500 {
            let mut chance = Chance(seed);
            let [x0, x1, k1, k2, k3, a, b] = [(); 7].map(|()| chance.below(2001) as f64 / 1000.0 - 1.0);
            let [x, y, k, l, m] = [x0, x1, k1, k2, k3].map(|one| vec![one]);
            let step = Step { h: 0.25, x0: x, x1: y, k1: k, k2: l, k3: m, ..Step::new(1) };
            let (from, to) = (0.5 + 0.5 * a.min(b), 0.5 + 0.5 * a.max(b));
            let terms = [x0, x1 - x0 + k1, k2 - k1, k3 - k2, -k3];
            let mut squares = [0.0; 9];
            (0..25).for_each(|k| squares[k / 5 + k % 5] += terms[k / 5] * terms[k % 5]);
            // x^(k + 1) at both ends of the part.
            let integral = |terms: &[f64]| {
                let (mut sum, mut powers) = (0.0, [to, from]);
                for (k, term) in terms.iter().enumerate() {
                    sum += term * (powers[0] - powers[1]) / (k + 1) as f64;
                    powers = [powers[0] * to, powers[1] * from];
                }
                step.h * sum
            };
            for (square, exact) in [(false, integral(&terms)), (true, integral(&squares))] {
                let found = integral_of_state(&step, 0, square, (from, to));
                assert!((found - exact).abs() < 1e-14, "seed {seed}, square {square}: {found} and not {exact}");
            }
        }
    }
}
