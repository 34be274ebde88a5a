//! Fixed steps: composes one step of a method, and everything that belongs to it, into one straight-line function.
//!
//! In: a [`Program`] and a method. Out: a function that does the following, in this order: it advances the states, the
//! step count and time, runs the sampled blocks that are due, the transitions and the outputs, and checks the guards.
//! Inputs, sampled states and modes are frozen while the states advance.
//!
//! Sources: Hairer, Nørsett, Wanner, *Solving ODEs I*, II.1 (`euler`, `rk4`); Hochbruck, Ostermann, *Exponential
//! integrators*, Acta Numerica 2010 (`expo`); Verwer et al. 1999 (`implicit`, see there).

mod choices;
mod expo;

use crate::ir::build::{Build, Env};
use crate::ir::expr::{Int, Real, Shared, Truth};
use crate::ir::hash::HashSet;
use crate::ir::program::Program;
use crate::ir::{Func, Value, Write};
use crate::numerics::autodiff::{self, Gradient};
use crate::numerics::sparse_lu::Matrix;
use crate::numerics::state_partition::{self, Coupling};
use abi::Slot;
use abi::description::{Guard, Segment};
use abi::plan::Method;
use std::cell::RefCell;

/// One fixed step by `method`. Its length is in [`Slot::STEP`].
///
/// # Panics
/// For the adaptive method, which has no fixed step.
pub fn step(program: &Program, method: Method) -> Func {
    let layout = &program.description.layout;
    let build = Shared::new(Build::new("step").with_pool(program.description.pool.clone()));
    let model = Model::new(program, &build);
    let next = model.next(method);

    let mut env = Env::default();
    for (k, x) in next.into_iter().enumerate() {
        // States that have decayed are set to 0, because subnormal numbers slow the processor down.
        let flushed = if model.coupling.fades[k] { x.abs().below(1e-30).choose(0.0, x) } else { x };
        env.insert(layout.states.slot(k), flushed.value);
    }
    let count = model.load(Slot::COUNT) + 1.0;
    env.insert(Slot::COUNT, count.value);
    env.insert(Slot::TIME, (count * model.h).value);
    model.delays(1.0, &mut env);
    if let Some(tick) = &program.tick {
        for block in &program.description.ticks {
            // COUNT and n are integers, so COUNT is a multiple of n exactly if the nearest quotient times n equals
            // COUNT.
            let n = (model.load(block.period) / model.h).nearest();
            let due = ((count / n).nearest() * n).is(count).choose(1.0, 0.0);
            env.insert(block.due, due.value);
        }
        build.borrow_mut().inline(tick, &mut env);
    }
    if let Some(transitions) = &program.transitions {
        build.borrow_mut().inline(transitions, &mut env);
    }
    build.borrow_mut().inline(&program.outputs, &mut env);
    let status = watch(&build, &program.description.guards, &env, &[]);

    for delay in &program.description.delays {
        let index = ring_index(delay.ring, count).value;
        let mut build = build.borrow_mut();
        let value = build.read(delay.source, &env);
        build.write(Write { base: Slot(delay.ring.start), len: delay.ring.len, index, value });
    }

    let mut build = build.into_inner();
    let stored = [layout.states, layout.memory, layout.regimes, layout.outputs];
    let timed = program.reads_time();
    let kept = |slot: Slot| match slot {
        Slot::TIME => timed,
        slot => slot == Slot::COUNT || stored.iter().any(|segment| segment.contains(slot)),
    };
    build.store_env(&env, kept);
    if let Some(status) = status {
        build.status(status);
    }
    build.finish()
}

/// One fixed step of the continuous states alone, with everything else frozen: no sampled blocks, transitions or
/// guards.
///
/// # Panics
/// For the adaptive method, which has no fixed step.
pub fn advance(program: &Program, method: Method) -> Func {
    let states = program.description.layout.states;
    let build = Shared::new(Build::new("advance").with_pool(program.description.pool.clone()));
    let next: Vec<Value> = Model::new(program, &build).next(method).into_iter().map(|x| x.value).collect();
    let mut build = build.into_inner();
    next.into_iter().enumerate().for_each(|(k, value)| build.store(states.slot(k), value));
    build.finish()
}

/// The step without these outputs (program slicing: Weiser, *Program Slicing*, ICSE 1981): it neither stores them nor
/// tests that they are finite. All other results keep their bits, so it is made of a step that has been reassociated and
/// contracted, in which operations no longer depend on the number of their uses. `step`: before guard reduction, since an
/// output that is left out may be the addend that implies others.
pub fn slice(step: &Func, guards: &[Guard], left_out: &[Slot]) -> Func {
    let build = Shared::new(Build::of(step));
    let env: Env = step.stores.iter().copied().collect();
    let status = watch(&build, guards, &env, left_out);
    let mut build = build.into_inner();
    build.store_env(&env, |slot| !left_out.contains(&slot));
    step.writes.iter().for_each(|write| build.write(*write));
    if let Some(status) = status {
        build.status(status);
    }
    build.finish()
}

/// The index of a sample in a ring whose length is a power of two. `number`: the sample's number, an integer from 0 to
/// 2⁵².
fn ring_index<'a>(ring: Segment, number: Real<'a>) -> Int<'a> {
    // From 2⁵² on, doubles are 1 apart, so the low bits of the sum are the integer.
    (number + 4503599627370496.0).bits() & (i64::from(ring.len) - 1)
}

/// Guards are combined in groups of this size first. This shortens the dependency chain of many guards, and the guards
/// of equal parts are computed by equal operations.
const TOGETHER: usize = 8;

/// γ of a step by `implicit`.
pub const GAMMA: f64 = 1.0 - std::f64::consts::FRAC_1_SQRT_2;

/// The status: 0, or the number of the first guard that fails. A guard fails if its quantity is not finite, or leaves
/// its range by more than a tolerance: 1e-6 of the range's width, or of the bound if the range is open on one side.
/// Guards of the quantities in `left_out` are not tested.
fn watch(build: &Shared, guards: &[Guard], env: &Env, left_out: &[Slot]) -> Option<Value> {
    let mut total: Option<Real> = None;
    let mut outside: Option<Truth> = None;
    // A state that is also an output has two guards, but enters the sum once.
    let mut summed: HashSet<Value> = HashSet::default();
    let number = |n: i64| build.borrow_mut().int(n);
    let mut first = number(0);
    for (group, guards) in guards.chunks(TOGETHER).enumerate().rev() {
        let (mut sum, mut beyond): (Option<Real>, Option<Truth>) = (None, None);
        for (k, guard) in guards.iter().enumerate().rev().filter(|(_, guard)| !left_out.contains(&guard.slot)) {
            let x = Real::new(build, build.borrow_mut().read(guard.slot, env));
            let (low, high) = widened(guard.range);
            // A value between two finite bounds is finite.
            let between = (low.is_finite() && high.is_finite()).then(|| match low == -high {
                true => x.abs().not_above(high),
                false => x.not_below(low) & x.not_above(high),
            });
            let out = between.map(|between| !between).or_else(|| match (low.is_finite(), high.is_finite()) {
                (true, _) => Some(x.below(low)),
                (_, true) => Some(x.above(high)),
                (false, false) => None,
            });
            if between.is_none() && summed.insert(x.value) {
                sum = Some(sum.map_or(x, |sum| sum + x));
            }
            beyond = either(beyond, out);
            let bad = match (between, out) {
                (Some(between), _) => !between,
                (None, Some(out)) => !x.finite() | out,
                (None, None) => !x.finite(),
            };
            let this = number((group * TOGETHER + k) as i64 + 1);
            first = build.borrow_mut().select(bad.value, this, first);
        }
        total = total.zip(sum).map(|(all, sum)| all + sum).or(sum);
        outside = either(outside, beyond);
    }
    // One test decides whether any guard can have failed. Only then does it matter which guard it is, and whether it is
    // one (a sum may overflow), so a back end may move this off the hot path. If a value is infinite or NaN, so is the
    // sum, and sum − sum is NaN; otherwise it is 0. `rest ≤ rest` distinguishes the two with one test.
    #[allow(clippy::eq_op, reason = "of what is not finite it is NaN")]
    let rest = total.map(|sum| sum - sum);
    let any = either(outside, rest.map(|rest| !rest.not_above(rest)))?;
    let none = number(0);
    Some(build.borrow_mut().select(any.value, first, none))
}

/// Disjunction of the tests that exist.
fn either<'a>(a: Option<Truth<'a>>, b: Option<Truth<'a>>) -> Option<Truth<'a>> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a | b),
        (a, b) => a.or(b),
    }
}

/// A range widened by the tolerance of guards.
pub fn widened((low, high): (f64, f64)) -> (f64, f64) {
    let tolerance = match (low.is_finite(), high.is_finite()) {
        (true, true) => 1e-6 * (high - low),
        (true, false) => 1e-6 * low.abs(),
        (false, true) => 1e-6 * high.abs(),
        (false, false) => 0.0,
    };
    (low - tolerance, high + tolerance)
}

/// dx/dt = f(t, x), with everything else frozen.
struct Model<'a> {
    program: &'a Program,
    build: &'a Shared,
    /// Step length, in s.
    h: Real<'a>,
    /// Time at the start of the step, in s.
    t: Real<'a>,
    /// States at the start of the step.
    x: Vec<Real<'a>>,
    /// Dependences between the states.
    coupling: Coupling,
    /// For each value built so far, whether it depends on no state.
    given: RefCell<Vec<bool>>,
}

impl<'a> Model<'a> {
    fn new(program: &'a Program, build: &'a Shared) -> Model<'a> {
        let load = |slot| Real::new(build, build.borrow_mut().load(slot));
        let layout = &program.description.layout;
        let slots =
            |segment: Segment| -> Vec<Slot> { (0..layout.states.len as usize).map(|k| segment.slot(k)).collect() };
        let coupling =
            state_partition::coupling(&program.derivatives, &slots(layout.derivatives), &slots(layout.states));
        let x = layout.states.range().map(|slot| load(Slot(slot as u32))).collect();
        Model { program, build, h: load(Slot::STEP), t: load(Slot::TIME), x, coupling, given: RefCell::default() }
    }

    /// The states after a step.
    fn next(&self, method: Method) -> Vec<Real<'a>> {
        match method {
            Method::Euler => self.euler(),
            Method::Rk4 => self.rk4(),
            Method::Expo => self.expo(),
            Method::Implicit => self.implicit(),
            Method::Adaptive => panic!("the adaptive method is no fixed step"),
        }
    }

    fn load(&self, slot: Slot) -> Real<'a> {
        Real::new(self.build, self.build.borrow_mut().load(slot))
    }

    /// Slot values at the fraction `c` of the step, with the states x.
    fn env(&self, c: f64, x: &[Real<'a>]) -> Env {
        self.env_of(c, x.iter().copied().enumerate())
    }

    /// Slot values at the fraction `c` of the step, with only some states, by index.
    fn env_of(&self, c: f64, x: impl Iterator<Item = (usize, Real<'a>)>) -> Env {
        let states = self.program.description.layout.states;
        let mut env: Env = x.map(|(k, x)| (states.slot(k), x.value)).collect();
        let t = if c == 0.0 { self.t } else { self.t + c * self.h };
        env.insert(Slot::TIME, t.value);
        self.delays(c, &mut env);
        env
    }

    /// Slot values at the fraction `c` of the step, with the states that `func` loads.
    fn env_for(&self, func: &Func, c: f64, x: &[Real<'a>]) -> Env {
        let states = self.program.description.layout.states;
        let read = |slot: &Slot| states.contains(*slot).then(|| slot.index() - states.start as usize);
        let read: Vec<usize> = func.loads().iter().filter_map(read).collect();
        self.env_of(c, read.into_iter().map(|k| (k, x[k])))
    }

    /// Interpolates the delayed values at the fraction `c` of the step. The samples are values at the ends of earlier
    /// steps.
    fn delays(&self, c: f64, env: &mut Env) {
        let count = self.load(Slot::COUNT);
        for delay in &self.program.description.delays {
            let Segment { start, len } = delay.ring;
            assert!(len.is_power_of_two(), "the rings of `{}` have no size", self.program.description.name);
            let sample = |index: Int<'a>| self.h.same(self.build.borrow_mut().ring(Slot(start), len, index.value));
            // All in steps. `back` is the distance from the newest sample at the end of the step, which `Start` has
            // computed.
            let back = self.load(delay.back);
            let ago = if c == 1.0 {
                back
            } else {
                let weight = delay.weight.map(|slot| (slot, self.load(slot)));
                let steps = back + weight.map_or(self.h.constant(1.0), |(_, weight)| 1.0 - weight);
                if let Some((slot, _)) = weight {
                    let part = if c == 0.0 { self.h.constant(0.0) } else { (c - steps).at_least(0.0) / c };
                    env.insert(slot, part.value);
                }
                (steps - c).at_least(0.0)
            };
            // Not further back than the first sample.
            let ago = ago.at_most(count);
            let whole = ago.floor();
            let newer = ring_index(delay.ring, count - whole);
            // No sample precedes the first one; its weight is then 0.
            let older = (newer - 1) & (i64::from(len) - 1);
            let (newer, older) = (sample(newer), sample(older));
            env.insert(delay.past, (newer + (ago - whole) * (older - newer)).value);
        }
    }

    fn rates(&self, env: &Env) -> Vec<Real<'a>> {
        let rates = self.program.description.layout.derivatives;
        (0..self.x.len()).map(|k| Real::new(self.build, self.build.borrow_mut().read(rates.slot(k), env))).collect()
    }

    fn f(&self, c: f64, x: &[Real<'a>]) -> Vec<Real<'a>> {
        let mut env = self.env(c, x);
        self.build.borrow_mut().inline(&self.program.derivatives, &mut env);
        self.rates(&env)
    }

    /// f, and the rows of ∂f/∂x.
    fn f_and_gradient(&self, c: f64, x: &[Real<'a>]) -> (Vec<Real<'a>>, Vec<Gradient>) {
        let layout = &self.program.description.layout;
        let mut env = self.env(c, x);
        let states: Vec<Slot> = (0..x.len()).map(|k| layout.states.slot(k)).collect();
        let mut gradients = autodiff::inline(self.build, &self.program.derivatives, &mut env, &states);
        let rows = (0..x.len()).map(|k| gradients.remove(&layout.derivatives.slot(k)).unwrap_or_default());
        (self.rates(&env), rows.collect())
    }

    /// x + h k
    fn moved(&self, h: Real<'a>, k: &[Real<'a>]) -> Vec<Real<'a>> {
        self.x.iter().zip(k).map(|(x, k)| *x + h * *k).collect()
    }

    fn euler(&self) -> Vec<Real<'a>> {
        self.moved(self.h, &self.f(0.0, &self.x))
    }

    /// The classical Runge–Kutta method of order 4.
    fn rk4(&self) -> Vec<Real<'a>> {
        let (h, half) = (self.h, 0.5 * self.h);
        let k1 = self.f(0.0, &self.x);
        let k2 = self.f(0.5, &self.moved(half, &k1));
        let k3 = self.f(0.5, &self.moved(half, &k2));
        let k4 = self.f(1.0, &self.moved(h, &k3));
        let mean = |k: usize| (k1[k] + 2.0 * (k2[k] + k3[k])) + k4[k];
        let means: Vec<Real> = (0..self.x.len()).map(mean).collect();
        self.moved(h / 6.0, &means)
    }

    /// Rosenbrock method of order 2, L-stable for any J, with one factorisation. γ = 1 − 1/√2 ([`GAMMA`]), J = ∂f/∂x at (t, x).
    ///
    ///   (I − γhJ) k1 = f(t, x),  (I − γhJ) k2 = f(t + h, x + h k1) − 2 k1,  x' = x + h (3 k1 + k2)/2
    ///
    /// If a pivot is below 1e-12 of its row, the step is that of `expo`.
    /// Source: Verwer, Spee, Blom, Hundsdorfer, SIAM J. Sci. Comput. 20 (1999), eq. 3.2.
    fn implicit(&self) -> Vec<Real<'a>> {
        let h = self.h;
        let (f, rows) = self.f_and_gradient(0.0, &self.x);
        let matrix = Matrix::identity_less(GAMMA * h, &rows);
        let factors = matrix.factorise(1e-12);
        let k1 = factors.solve(&f);
        let f = self.f(1.0, &self.moved(h, &k1));
        let right: Vec<Real> = f.iter().zip(&k1).map(|(f, k)| *f - 2.0 * *k).collect();
        let k2 = factors.solve(&right);
        let half = 0.5 * h;
        let next = (0..self.x.len()).map(|k| self.x[k] + half * (3.0 * k1[k] + k2[k]));
        let Some(singular) = factors.singular else { return next.collect() };
        self.expo().into_iter().zip(next).map(|(expo, next)| singular.choose(expo, next)).collect()
    }
}

#[cfg(test)]
mod tests;
