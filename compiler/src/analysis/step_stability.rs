//! Numerical stability of a fixed step: searches the declared ranges for a point at which a step of a method amplifies
//! small deviations although the model itself does not.
//!
//! In: a program, a method, a step. Out: where the step is unstable and up to which value it is stable, or a state that
//! chatters. Knows no text.
//!
//! The compiled step is differentiated, including the exponentials of `expo` and the pivots of `implicit`; the
//! criterion is the spectral radius of its derivative (Hairer, Wanner, *Solving ODEs II*, IV.2). A point counts only if
//! a run from there also leaves the solution that much shorter steps find, so that kinks, transients and coincidences
//! cause no false alarms. The work is bounded by operations rather than time, so the result does not depend on the
//! machine.

use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::ir::interpret::run_once;
use crate::ir::program::Program;
use crate::math::expand;
use crate::numerics::autodiff;
use crate::numerics::fixed_step;
use abi::Slot;
use abi::description::{Kind, Quantity};
use abi::plan::Method;

/// Limit on the number of continuous states of an analysed program.
pub const MOST_STATES: usize = 48;
/// Limit on interpreted operations for one result: some tenths of a second.
const WORK: usize = 30_000_000;
/// Growth of a deviation in one step that is tolerated: below it is an error of the method rather than an instability.
const MARGIN: f64 = 1e-3;
/// Number of steps of the run that confirms an instability.
const RUN: usize = 200;
/// Steps of the reference run for each step of the confirming run.
const FINER: usize = 16;
/// Factor by which the confirming run must go farther than the reference run.
const FARTHER: f64 = 10.0;
/// Number of steps of the run that confirms chattering, and the number of reversals required in its second half.
const CHATTER: (usize, usize) = (256, 8);
/// Number of steps, and their length in s, in which fast states relax to their quasi-steady values.
const RELAXING: (usize, f64) = (8, 2e-5);
/// Greatest value in SI units for a quantity with an open range.
pub const OPEN: f64 = 10.0;
/// 10^(k/8) for k from 0 to 7: subdivision of a decade.
const EIGHTHS: [f64; 8] = [1.0, 1.3335, 1.7783, 2.3714, 3.1623, 4.2170, 5.6234, 7.4989];
/// Exponent of ten up to which the search looks for a condition that ends the run.
const FAR: i32 = 4;
/// The longest step in s that is tried.
pub const LONGEST: f64 = 1.0;

/// Result: a step that is numerically unstable.
#[derive(Clone, PartialEq, Debug)]
pub struct Unstable {
    /// Index of the state with the largest share in the unstable mode.
    pub state: usize,
    /// Its own rate there, −∂f/∂x, in 1/s.
    pub rate: f64,
    /// The state or input on whose magnitude the instability depends; `None` if the step is unstable at the start
    /// point.
    pub along: Option<StabilityLimit>,
    /// The largest stable step at the worst point, in s.
    pub stable: f64,
}

/// A quantity along which a step becomes unstable.
#[derive(Clone, PartialEq, Debug)]
pub struct StabilityLimit {
    /// Slot of the quantity.
    pub slot: Slot,
    /// The step is stable up to this magnitude, SI units.
    pub limit: f64,
    /// The farthest point that was examined, SI units.
    pub farthest: f64,
    /// Whether the direction is reversed: stable from `limit` upwards and unstable below it, down to `farthest`, which
    /// is close to 0. This happens where friction is steepest at rest and the run starts in motion.
    pub inward: bool,
    /// Whether the declared ranges, or conditions that end the run, bound the quantity there.
    pub closed: bool,
}

/// Result: a state that chatters.
#[derive(Clone, PartialEq, Debug)]
pub struct Chatter {
    /// Index of the state.
    pub state: usize,
    /// Its change in one step, SI units.
    pub amplitude: f64,
}

/// Result: a point at which the model itself grows so fast that the linear equations of a step by `implicit` are nearly
/// singular.
#[derive(Clone, PartialEq, Debug)]
pub struct Singular {
    /// Slot of the varied quantity, and its value there in SI units.
    pub at: (Slot, f64),
    /// The growth rate of deviations there, in 1/s.
    pub rate: f64,
}

/// Evaluates a program at points of its ranges.
pub struct Bench<'a> {
    program: &'a Program,
    start: Func,
    outputs: Func,
    derivatives: Func,
    /// ∂f/∂x, row-major, stored after the block.
    jacobian: Func,
    /// A step of `expo` for the states only.
    relaxing: Func,
    /// Slots that are not 0 where the run would have ended.
    ends: Vec<Slot>,
    n: usize,
    /// The block at the start point.
    base: Vec<f64>,
}

/// The derivative of a method's fixed step with respect to the states.
struct Stepper {
    derivative: Func,
}

/// A quantity to vary: its slot, its values by magnitude, and whether its range is bounded.
struct Scan {
    slot: Slot,
    values: Vec<f64>,
    closed: bool,
}

impl<'a> Bench<'a> {
    /// From a program whose ring buffers are sized; `ends`: outputs that are not 0 where a run ends. `None` for a
    /// program without continuous states or with more than [`MOST_STATES`].
    pub fn new(program: &'a Program, ends: &[Slot]) -> Option<Bench<'a>> {
        let layout = &program.description.layout;
        let n = layout.states.len as usize;
        if n == 0 || n > MOST_STATES {
            return None;
        }
        let start = expand(&program.start);
        let mut base = vec![0.0; layout.size() + n * n];
        base[layout.params.range()].copy_from_slice(&program.params);
        run_once(&start, &mut base, &program.description.pool);
        let rows: Vec<Slot> = (0..n).map(|k| layout.derivatives.slot(k)).collect();
        Some(Bench {
            program,
            start,
            outputs: expand(&program.outputs),
            derivatives: expand(&program.derivatives),
            jacobian: derivative(program, &program.derivatives, &rows),
            relaxing: expand(&fixed_step::advance(program, Method::Expo)),
            ends: ends.to_vec(),
            n,
            base,
        })
    }

    fn quantity(&self, slot: Slot) -> Option<&Quantity> {
        self.program.description.quantities.iter().find(|quantity| quantity.slot == slot)
    }

    fn stepper(&self, method: Method) -> Stepper {
        let layout = &self.program.description.layout;
        let rows: Vec<Slot> = (0..self.n).map(|k| layout.states.slot(k)).collect();
        Stepper { derivative: derivative(self.program, &fixed_step::advance(self.program, method), &rows) }
    }

    /// The quantities to vary: inputs and states, by powers of ten and to the ends of their ranges.
    fn scans(&self) -> Vec<Scan> {
        let kinds = [Kind::State, Kind::Input];
        let moved = self.program.description.quantities.iter().filter(|q| kinds.contains(&q.kind) && !q.boolean);
        let scan = |quantity: &Quantity| {
            let (low, high) = quantity.range;
            let mut values: Vec<f64> = Vec::new();
            for power in -6..=FAR {
                let size = ten_to(power);
                values.extend([size, -size].into_iter().filter(|x| (low..=high).contains(x)));
            }
            // Values above `OPEN` only for quantities for which some value ends the run.
            let ends = values.iter().any(|x| self.ended(&self.at(&self.base, quantity.slot, *x)));
            values.retain(|x| ends || x.abs() <= OPEN);
            values.extend([low, high].into_iter().filter(|x| x.is_finite() && *x != 0.0));
            values.sort_by(|a, b| a.abs().total_cmp(&b.abs()).then(a.total_cmp(b)));
            values.dedup();
            Scan { slot: quantity.slot, values, closed: low.is_finite() && high.is_finite() }
        };
        moved.map(scan).collect()
    }

    /// Start blocks: the start point, and the start point with every bounded state at its upper or at its lower end.
    fn settings(&self) -> Vec<Vec<f64>> {
        let mut out = vec![self.base.clone()];
        for upper in [true, false] {
            let mut block = self.base.clone();
            for quantity in self.program.description.quantities.iter().filter(|q| q.kind == Kind::State) {
                let (low, high) = quantity.range;
                if low.is_finite() && high.is_finite() {
                    block[quantity.slot.index()] = if upper { high } else { low };
                }
            }
            if out.iter().all(|other| *other != block) {
                out.push(block);
            }
        }
        out
    }

    /// Whether a run would have ended at this block.
    fn ended(&self, block: &[f64]) -> bool {
        if self.ends.is_empty() {
            return false;
        }
        let mut block = block.to_vec();
        run_once(&self.outputs, &mut block, &self.program.description.pool);
        self.ends.iter().any(|slot| block[slot.index()] != 0.0)
    }

    /// The matrix that a function writes after the block.
    fn matrix(&self, func: &Func, block: &[f64], h: f64) -> Vec<f64> {
        let mut block = block.to_vec();
        block[Slot::STEP.index()] = h;
        run_once(func, &mut block, &self.program.description.pool);
        block.split_off(self.program.description.layout.size())
    }

    /// The growth of deviations in one step at this point, if it exceeds that of the model, and the state with the
    /// largest share.
    fn grows(&self, stepper: &Stepper, block: &[f64], h: f64) -> Option<(f64, usize)> {
        let n = self.n;
        let step = self.matrix(&stepper.derivative, block, h);
        let (growth, power) = radius(&step, n, 1.0 + 2.0 * MARGIN)?;
        // An unstable model may grow, but the step by no more than twice the model's own rate; otherwise the falling
        // branch of a Stribeck curve would mask the instability of a bristle.
        let model = self.matrix(&self.jacobian, block, h);
        if let Some((own, _)) = radius(&exponential(&model, n, h), n, 1.0 + MARGIN)
            && (own.is_nan() || growth - 1.0 <= 2.0 * (own - 1.0) + 2.0 * MARGIN)
        {
            return None;
        }
        // The diagonal of the rank-one matrix v·wᵀ measures the share of each state independently of units.
        let part = |k: &usize| power[k * n + k].abs();
        let state = (0..n).filter(|k| !part(k).is_nan()).max_by(|a, b| part(a).total_cmp(&part(b))).unwrap_or(0);
        Some((growth, state))
    }

    /// The first point found at which a step of this length is unstable, confirmed by a run.
    pub fn unstable(&self, method: Method, h: f64) -> Option<Unstable> {
        let stepper = self.stepper(method);
        let settings = self.settings();
        let rest: Vec<Vec<f64>> = settings.iter().map(|block| self.relaxed(block.clone())).collect();
        if let Some((_, state)) = rest.iter().find_map(|block| self.grows(&stepper, block, h)) {
            let block = &self.base;
            if rest.iter().any(|block| self.diverges(method, block, h)) {
                let stable = self.largest(&stepper, block, h);
                return Some(Unstable { state, rate: self.rate(block, state), along: None, stable });
            }
        }
        let mut work = WORK / self.cost(&stepper);
        for scan in self.scans() {
            // Unstable points: (index of the start block, value, growth, state).
            let mut found: Vec<(usize, f64, f64, usize)> = Vec::new();
            let (mut closed, mut farthest) = (scan.closed, 0.0_f64);
            for (at, setting) in settings.iter().enumerate() {
                for value in &scan.values {
                    work = work.checked_sub(1)?;
                    let block = self.at(setting, scan.slot, *value);
                    if self.ended(&block) {
                        closed = true;
                        continue;
                    }
                    farthest = farthest.max(value.abs());
                    let block = self.relaxed(block);
                    if let Some((growth, state)) = self.grows(&stepper, &block, h) {
                        found.push((at, *value, growth, state));
                    }
                }
            }
            // The farthest of the worst points, where a run diverges soonest.
            let worst =
                found.iter().max_by(|a, b| a.2.min(1e9).total_cmp(&b.2.min(1e9)).then(a.1.abs().total_cmp(&b.1.abs())));
            let Some(&(at, value, _, state)) = worst else { continue };
            let setting = &settings[at];
            let point = |value: f64| self.relaxed(self.at(setting, scan.slot, value));
            if !self.diverges(method, &point(value), h) {
                continue;
            }
            // Bisects for the limit with the same start block and sign, between the last stable and the first unstable
            // value.
            let same = |x: &f64| x.signum() == value.signum();
            let first = found
                .iter()
                .filter(|f| f.0 == at && same(&f.1))
                .map(|f| f.1)
                .min_by(|a, b| a.abs().total_cmp(&b.abs()));
            let (mut high, start) = (first.unwrap_or(value), self.base[scan.slot.index()]);
            let below = scan.values.iter().filter(|x| same(x) && x.abs() < high.abs());
            let below = below.copied().max_by(|a, b| a.abs().total_cmp(&b.abs()));
            let inward = below.is_none() && start.abs() > high.abs();
            let (least, mut low) = (high, below.unwrap_or(start));
            for _ in 0..40 {
                let middle = 0.5 * (low + high);
                match self.grows(&stepper, &point(middle), h) {
                    Some(_) => high = middle,
                    None => low = middle,
                }
            }
            // The condition that ends the run may change between two powers of ten.
            let edge = match inward {
                true => least,
                false => self.edge(setting, scan.slot, farthest.copysign(value), &scan),
            };
            let block = point(edge);
            let along = StabilityLimit { slot: scan.slot, limit: low.abs(), farthest: edge.abs(), inward, closed };
            let stable = self.largest(&stepper, &block, h);
            return Some(Unstable { state, rate: self.rate(&block, state), along: Some(along), stable });
        }
        None
    }

    /// The point at which the model itself grows fastest, if that is too fast for a step by `implicit`. Its equations
    /// (I − γhJ) k = f are singular where an eigenvalue of J is 1/(γh). From three quarters of that value, a step
    /// amplifies a deviation about three times as much as the model does. The growth happens once, while the point is
    /// passed, so a run from there does not diverge, and [`Bench::unstable`] does not find it.
    ///
    /// Searches each input and state at the subdivision `EIGHTHS`, because such a region is narrow: on a Stribeck
    /// curve, the speeds at which it falls.
    pub fn singular(&self, h: f64) -> Option<Singular> {
        let (limit, n) = (0.75 / (fixed_step::GAMMA * h), self.n);
        let cost =
            RELAXING.0 * self.relaxing.ops.len() + self.jacobian.ops.len() + self.outputs.ops.len() + 20 * n.pow(3);
        let mut work = WORK / cost;
        let mut worst: Option<Singular> = None;
        for scan in self.scans() {
            for value in scan.values.iter().flat_map(|value| EIGHTHS.map(|part| value * part)) {
                let (low, high) = self.quantity(scan.slot).map_or((value, value), |quantity| quantity.range);
                if !(low..=high).contains(&value) {
                    continue;
                }
                let Some(left) = work.checked_sub(1) else { return worst };
                work = left;
                let block = self.at(&self.base, scan.slot, value);
                if self.ended(&block) {
                    continue;
                }
                let model = self.matrix(&self.jacobian, &self.relaxed_around(block, scan.slot), h);
                let Some((growth, _)) = radius(&exponential(&model, n, h), n, exp(limit * h)) else { continue };
                let rate = ln(growth) / h;
                if rate.is_finite() && worst.as_ref().is_none_or(|worst| rate > worst.rate) {
                    worst = Some(Singular { at: (scan.slot, value), rate });
                }
            }
        }
        worst
    }

    /// The farthest value up to which the run has not ended, by bisection.
    fn edge(&self, setting: &[f64], slot: Slot, reached: f64, scan: &Scan) -> f64 {
        let beyond = scan.values.iter().copied().filter(|x| x.signum() == reached.signum() && x.abs() > reached.abs());
        let Some(mut high) = beyond.min_by(|a, b| a.abs().total_cmp(&b.abs())) else { return reached };
        let mut low = reached;
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if self.ended(&self.at(setting, slot, middle)) { high = middle } else { low = middle }
        }
        low
    }

    fn at(&self, setting: &[f64], slot: Slot, value: f64) -> Vec<f64> {
        let mut block = setting.to_vec();
        block[slot.index()] = value;
        block
    }

    /// A nearby point at which the fast states have relaxed. The response of a step to a state that is momentarily far
    /// off does not show where a run goes.
    fn relaxed(&self, mut block: Vec<f64>) -> Vec<f64> {
        let begin = block.clone();
        block[Slot::STEP.index()] = RELAXING.1;
        for _ in 0..RELAXING.0 {
            run_once(&self.relaxing, &mut block, &self.program.description.pool);
        }
        let states = self.program.description.layout.states.range();
        if block[states].iter().all(|x| x.is_finite()) { block } else { begin }
    }

    /// As [`relaxed`](Self::relaxed), with one quantity held: otherwise a mass would slow down and leave the examined
    /// speed.
    fn relaxed_around(&self, mut block: Vec<f64>, held: Slot) -> Vec<f64> {
        let (begin, value) = (block.clone(), block[held.index()]);
        block[Slot::STEP.index()] = RELAXING.1;
        for _ in 0..RELAXING.0 {
            run_once(&self.relaxing, &mut block, &self.program.description.pool);
            block[held.index()] = value;
        }
        let states = self.program.description.layout.states.range();
        if block[states].iter().all(|x| x.is_finite()) { block } else { begin }
    }

    fn rate(&self, block: &[f64], state: usize) -> f64 {
        -self.matrix(&self.jacobian, block, 0.0)[state * self.n + state]
    }

    /// Operations for one point.
    fn cost(&self, stepper: &Stepper) -> usize {
        RELAXING.0 * self.relaxing.ops.len()
            + stepper.derivative.ops.len()
            + self.jacobian.ops.len()
            + self.outputs.ops.len()
            + 40 * self.n.pow(3)
    }

    /// The largest step below h that is stable at a point, by bisection.
    fn largest(&self, stepper: &Stepper, block: &[f64], h: f64) -> f64 {
        let stable = |h: f64| self.grows(stepper, block, h).is_none();
        let mut low = h;
        for _ in 0..40 {
            low *= 0.5;
            if stable(low) {
                break;
            }
        }
        let mut high = 2.0 * low;
        for _ in 0..20 {
            let middle = 0.5 * (low + high);
            if stable(middle) { low = middle } else { high = middle }
        }
        low
    }

    /// Whether deviations grow slightly at any step, as undamped oscillations do with some methods. Called with a
    /// quarter of the step: whether they still grow although the model does not let them.
    fn always_grows(&self, stepper: &Stepper, points: &[Vec<f64>], h: f64) -> bool {
        // Repeated squaring resolves a radius near 1 to about 1e-4, but its error is the same for both matrices.
        const LEAST: f64 = 4e-5;
        let growth = |matrix: &[f64]| radius(matrix, self.n, 0.0).map_or(0.0, |(growth, _)| growth);
        points.iter().any(|block| {
            let step = growth(&self.matrix(&stepper.derivative, block, h));
            let model = growth(&exponential(&self.matrix(&self.jacobian, block, h), self.n, h));
            model < 1.0 + 0.2 * MARGIN && step > model + LEAST
        })
    }

    /// The largest step of a method in s that is stable at all points, up to [`LONGEST`]; 0 if there is none.
    pub fn largest_stable(&self, method: Method) -> f64 {
        let stepper = self.stepper(method);
        let settings = self.settings();
        let mut points = settings.clone();
        // Powers of ten from 1e-3, and the ends of the ranges; the farthest of each quantity first, because only a
        // limited number of points of a large model can be examined.
        let scans = self.scans();
        let far = |scan: &Scan, k: usize| scan.values.iter().rev().copied().filter(|x| x.abs() >= 0.9e-3).nth(k);
        let most = scans.iter().map(|scan| scan.values.len()).max().unwrap_or(0);
        for k in 0..most {
            for scan in &scans {
                let Some(value) = far(scan, k) else { continue };
                points.extend(settings.iter().map(|setting| self.at(setting, scan.slot, value)));
            }
        }
        points.truncate((WORK / 40 / self.cost(&stepper)).max(4 + 6 * scans.len()));
        let points: Vec<Vec<f64>> = points.into_iter().map(|block| self.relaxed(block)).collect();
        let stable = |h: f64| points.iter().all(|block| self.grows(&stepper, block, h).is_none());
        // Searches upwards: a step beyond the first unstable one is of no use.
        let mut low = 1e-8;
        while low < LONGEST && stable(2.0 * low) {
            low *= 2.0;
        }
        if low >= LONGEST {
            return LONGEST;
        }
        let mut high = 2.0 * low;
        for _ in 0..8 {
            let middle = 0.5 * (low + high);
            if stable(middle) { low = middle } else { high = middle }
        }
        if self.always_grows(&stepper, &points, 0.25 * low) { 0.0 } else { low }
    }

    /// Whether a run from near a point leaves the region in which a run with much shorter steps stays.
    fn diverges(&self, method: Method, block: &[f64], h: f64) -> bool {
        let states = self.program.description.layout.states.range();
        let mut block = block.to_vec();
        let mut widths = Vec::new();
        for slot in states.clone() {
            let (low, high) = self.quantity(Slot(slot as u32)).map_or((0.0, f64::INFINITY), |q| q.range);
            let width = if (high - low).is_finite() { high - low } else { f64::INFINITY };
            // A small perturbation, so that an unstable equilibrium is left; towards the inside of the range.
            let off = if width.is_finite() { 1e-3 * width } else { 1e-6 };
            block[slot] += if block[slot] + off > high { -off } else { off };
            widths.push(width);
        }
        let test = self.excursions(method, &block, h, RUN);
        // The reference method, which is stable for stiff models.
        let other = Method::Implicit;
        let reference = self.excursions(other, &block, h / FINER as f64, RUN * FINER);
        test.iter().zip(&reference).zip(&widths).any(|((test, reference), width)| {
            let beyond = if width.is_finite() { *width } else { 1e-6 };
            reference.is_finite() && (!test.is_finite() || *test > FARTHER * (reference + beyond))
        })
    }

    /// The greatest distance of each state from its initial value within `steps` steps; infinite if it ceases to be
    /// finite.
    fn excursions(&self, method: Method, block: &[f64], h: f64, steps: usize) -> Vec<f64> {
        let mut farthest = vec![0.0_f64; self.n];
        self.run(method, block, h, steps, |first, now| {
            for (farthest, (x, first)) in farthest.iter_mut().zip(now.iter().zip(first)) {
                let far = (x - first).abs();
                *farthest = if far.is_finite() { farthest.max(far) } else { f64::INFINITY };
            }
        });
        farthest
    }

    /// Runs with all ticks and transitions. Calls `look` with the initial and the present states after each step, until
    /// they cease to be finite.
    fn run(&self, method: Method, block: &[f64], h: f64, steps: usize, mut look: impl FnMut(&[f64], &[f64])) {
        let mut program = self.program.clone();
        program.size_rings(h);
        let layout = &program.description.layout;
        let mut at = vec![0.0; layout.size()];
        at[layout.params.range()].copy_from_slice(&program.params);
        for input in layout.inputs.range() {
            at[input] = block[input];
        }
        at[Slot::STEP.index()] = h;
        run_once(&self.start, &mut at, &program.description.pool);
        at[layout.states.range()].copy_from_slice(&block[self.program.description.layout.states.range()]);
        let first = at[layout.states.range()].to_vec();
        let step = expand(&fixed_step::step(&program, method));
        // Limit on the cost of a run.
        let most = WORK / (2 * step.ops.len());
        for _ in 0..steps.min(most.max(RUN)) {
            run_once(&step, &mut at, &program.description.pool);
            let now = &at[layout.states.range()];
            look(&first, now);
            if now.iter().any(|x| !x.is_finite()) {
                break;
            }
        }
    }

    /// A state whose rate jumps at a change of its sign and opposes it on both sides, so that fixed steps of this
    /// length make it chatter around 0.
    pub fn chatters(&self, method: Method, h: f64) -> Option<Chatter> {
        let layout = &self.program.description.layout;
        (0..self.n).find_map(|k| {
            let (state, rate) = (layout.states.slot(k), layout.derivatives.slot(k));
            let rate_at = |x: f64| {
                let mut block = self.at(&self.base, state, x);
                run_once(&self.derivatives, &mut block, &self.program.description.pool);
                block[rate.index()]
            };
            let (plus, minus) = (rate_at(1e-12), rate_at(-1e-12));
            let jump = plus < 0.0 && minus > 0.0 && (rate_at(1e-15) - plus).abs() < 1e-3 * plus.abs();
            if !jump {
                return None;
            }
            let amplitude = 0.5 * h * (minus - plus);
            let block = self.at(&self.base, state, 0.3 * amplitude);
            let (mut before, mut moved, mut changes, mut farthest, mut count) =
                (block[state.index()], 0.0, 0, 0.0_f64, 0);
            self.run(method, &block, h, CHATTER.0, |_, now| {
                let by = now[k] - before;
                count += 1;
                if count > CHATTER.0 / 2 {
                    changes += usize::from(by * moved < 0.0);
                    farthest = farthest.max(by.abs());
                }
                (before, moved) = (now[k], by);
            });
            (changes >= CHATTER.1 && farthest > 1e-2 * amplitude).then_some(Chatter { state: k, amplitude: farthest })
        })
    }
}

/// The derivative of the values that a function stores in `rows` with respect to the continuous states, row-major after
/// the block.
fn derivative(program: &Program, func: &Func, rows: &[Slot]) -> Func {
    let layout = &program.description.layout;
    let states: Vec<Slot> = layout.states.range().map(|slot| Slot(slot as u32)).collect();
    let build = Shared::new(Build::new("derivative").with_pool(program.description.pool.clone()));
    let gradients = autodiff::inline(&build, func, &mut Env::new(), &states);
    let mut build = build.into_inner();
    let mut next = layout.size();
    for row in rows {
        for k in 0..states.len() {
            let entry = gradients.get(row).and_then(|gradient| autodiff::entry(gradient, k as u32));
            let entry = entry.unwrap_or_else(|| build.real(0.0));
            build.store(Slot(next as u32), entry);
            next += 1;
        }
    }
    expand(&build.finish())
}

/// The spectral radius of an n × n matrix by repeated squaring, and the last power, scaled to a largest entry of 1. NaN
/// for a matrix that is not finite. `None` as soon as the radius is known to be at most `bound`.
fn radius(matrix: &[f64], n: usize, bound: f64) -> Option<(f64, Vec<f64>)> {
    let mut power = matrix.to_vec();
    if power.iter().any(|x| !x.is_finite()) {
        return Some((f64::NAN, power));
    }
    // The matrix to the power 2^k is `power` · e^(log).
    let mut log = 0.0;
    let mut growth = 0.0;
    for k in 0..=SQUARINGS {
        let largest = power.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
        if largest == 0.0 {
            return None;
        }
        power.iter_mut().for_each(|x| *x /= largest);
        log += ln(largest);
        // Bound: ρ ≤ ‖A^m‖^(1/m) ≤ (n · largest entry)^(1/m).
        let m = f64::from(1_u32 << k);
        growth = exp((log + ln(n as f64)) / m);
        if growth <= bound {
            return None;
        }
        if k < SQUARINGS {
            power = product(&power, &power, n);
            log *= 2.0;
        }
    }
    Some((growth, power))
}

/// Computes A^(2^16), for which the non-normality of A affects the result by less than MARGIN.
const SQUARINGS: u32 = 16;

/// 10^power, exactly rounded.
pub fn ten_to(power: i32) -> f64 {
    format!("1e{power}").parse().expect("a number")
}

/// 2^−k
fn half_to(k: i32) -> f64 {
    (0..k).fold(1.0, |value, _| 0.5 * value)
}

/// e^(hA) by scaling and squaring.
fn exponential(a: &[f64], n: usize, h: f64) -> Vec<f64> {
    let norm = (0..n).map(|i| (0..n).map(|j| (h * a[i * n + j]).abs()).sum::<f64>()).fold(0.0, f64::max);
    if !norm.is_finite() {
        return vec![f64::NAN; n * n];
    }
    let squarings = (0..).find(|s| norm * half_to(*s) < 0.25).unwrap_or(0);
    let scaled: Vec<f64> = a.iter().map(|x| h * x * half_to(squarings)).collect();
    let identity = |i: usize| f64::from(i / n == i % n);
    let mut sum: Vec<f64> = (0..n * n).map(identity).collect();
    // Taylor series by Horner's scheme: the remainder after twelve terms is less than 1e-17.
    for k in (1..=12).rev() {
        sum = product(&scaled, &sum, n).into_iter().map(|x| x / f64::from(k)).collect();
        (0..n).for_each(|i| sum[i * n + i] += 1.0);
    }
    for _ in 0..squarings {
        sum = product(&sum, &sum, n);
    }
    sum
}

fn product(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
    let mut out = vec![0.0; n * n];
    for i in 0..n {
        for k in 0..n {
            let x = a[i * n + k];
            if x != 0.0 {
                (0..n).for_each(|j| out[i * n + j] += x * b[k * n + j]);
            }
        }
    }
    out
}

#[allow(clippy::disallowed_methods, reason = "a warning's limit: shown with two digits, decides nothing that runs")]
fn ln(x: f64) -> f64 {
    x.ln()
}

#[allow(clippy::disallowed_methods, reason = "a warning's limit: shown with two digits, decides nothing that runs")]
fn exp(x: f64) -> f64 {
    x.exp()
}
