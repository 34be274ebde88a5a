//! Fixed steps: composes one step of a method, and everything that belongs to it, into one straight-line function.
//!
//! In: a [`Program`] and a method. Out: a function that does the following, in this order: it advances the states, the
//! step count and time, runs the sampled blocks that are due, the transitions and the outputs, and checks the guards.
//! Inputs, sampled states and modes are frozen while the states advance.
//!
//! Sources: Hairer, Nørsett, Wanner, *Solving ODEs I*, II.1 (`euler`, `rk4`); Hochbruck, Ostermann, *Exponential
//! integrators*, Acta Numerica 2010 (`expo`); Verwer et al. 1999 (`implicit`, see there).

use crate::ir::build::{Build, Env};
use crate::ir::expr::{Int, Real, Shared, Truth};
use crate::ir::program::Program;
use crate::ir::{Func, Op, Value, Write};
use crate::math::phi_functions;
use crate::numerics::autodiff::{self, Gradient};
use crate::numerics::sparse_lu::Matrix;
use crate::numerics::state_partition::{self, Coupling, Shape};
use crate::numerics::switching_conditions::SwitchingConditions;
use abi::Slot;
use abi::description::{Guard, Segment};
use abi::plan::Method;
use std::cell::RefCell;
use std::collections::{BTreeSet, HashMap, HashSet};

/// One fixed step by `method`. Its length is in [`Slot::STEP`].
///
/// # Panics
/// For the adaptive method, which has no fixed step.
pub fn step(program: &Program, method: Method) -> Func {
    let layout = &program.description.layout;
    let build = Shared::new(Build::new("step").with_pool(program.description.pool.clone()));
    let model = Model::new(program, &build);
    let next = model.next(method);

    let mut env = Env::new();
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
    let status = watch(&build, &program.description.guards, &env);

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
fn watch(build: &Shared, guards: &[Guard], env: &Env) -> Option<Value> {
    let mut total: Option<Real> = None;
    let mut outside: Option<Truth> = None;
    // A state that is also an output has two guards, but enters the sum once.
    let mut summed: HashSet<Value> = HashSet::new();
    let number = |n: i64| build.borrow_mut().int(n);
    let mut first = number(0);
    for (group, guards) in guards.chunks(TOGETHER).enumerate().rev() {
        let (mut sum, mut beyond): (Option<Real>, Option<Truth>) = (None, None);
        for (k, guard) in guards.iter().enumerate().rev() {
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

/// A range widened by its tolerance.
fn widened((low, high): (f64, f64)) -> (f64, f64) {
    let tolerance = match (low.is_finite(), high.is_finite()) {
        (true, true) => 1e-6 * (high - low),
        (true, false) => 1e-6 * low.abs(),
        (false, true) => 1e-6 * high.abs(),
        (false, false) => 0.0,
    };
    (low - tolerance, high + tolerance)
}

/// Largest number of slopes among which a rate may select for each slope to have its own exponential.
const MOST_CHOSEN: usize = 4;

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

    /// Exponential integrator: exact for a state that relaxes, dx/dt = b − a x. Every other state is linearised in
    /// itself. X is the mean over the step; the rates of other states see this value.
    ///
    ///   x' = x + h φ(h a) f,  X = x + h φ2(h a) f              f, a = min(∂f/∂x, 0) at (t, x)
    ///   three times: r = f + a (x − X), and r in place of f    f, a at (t + h/2, X)
    ///
    /// States are stepped after those that they depend on. The iteration depends on the shape of the rate:
    ///
    /// - Affine in its own state: r is the same for every X, so one evaluation at (t + h/2, x) is enough.
    /// - Piecewise affine: the switching conditions are evaluated near the state's value in the middle of the step, which
    ///   is x + h f/(2 − h a). The rest is as in the affine case.
    /// - States that depend on each other and are jointly affine use the matrix exponential.
    fn expo(&self) -> Vec<Real<'a>> {
        let layout = &self.program.description.layout;
        let stored: HashMap<Slot, Value> = self.program.derivatives.stores.iter().copied().collect();
        let (mut next, mut middle) = (self.x.clone(), self.x.clone());
        for group in &self.coupling.groups {
            let states = &group.states;
            let rates = self.rates_of(states, &stored);
            match group.shape {
                Shape::Affine => self.affine(&rates, &HashMap::new(), states, &mut next, &mut middle),
                Shape::PiecewiseAffine => {
                    let own: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
                    let asking = SwitchingConditions::of(&rates, &own);
                    let answers = self.answers(&asking, states, &middle);
                    self.affine(&asking.rates, &answers, states, &mut next, &mut middle);
                }
                Shape::Nonlinear => self.iterated(&rates, states, &mut next, &mut middle),
                Shape::Linear => self.linear(&rates, states, &stored, &mut next, &mut middle),
            }
        }
        next
    }

    /// Steps states whose rates are affine for fixed `answers` (the results of their switching conditions).
    fn affine(
        &self,
        rates: &Func,
        answers: &HashMap<Value, Value>,
        states: &[usize],
        next: &mut [Real<'a>],
        middle: &mut [Real<'a>],
    ) {
        for (k, (f, a)) in states.iter().zip(self.relaxation(rates, answers, 0.5, middle, states)) {
            [next[*k], middle[*k]] = self.relaxed(self.x[*k], f, a);
        }
    }

    /// The results of the switching conditions near the middle of the step.
    fn answers(&self, asking: &SwitchingConditions, states: &[usize], middle: &[Real<'a>]) -> HashMap<Value, Value> {
        let mut mid_step = middle.to_vec();
        for (k, (f, a)) in states.iter().zip(self.relaxation(&asking.rates, &HashMap::new(), 0.5, middle, states)) {
            mid_step[*k] = self.x[*k] + self.to_middle(a) * f;
        }
        let env = self.env_for(&asking.rates, 0.5, &mid_step);
        asking.answers(&mut self.build.borrow_mut(), &env)
    }

    /// h/(2 − min(h a, 0)): h/2 for the slope 0, and at most the distance to the rest point for a steep slope.
    fn to_middle(&self, a: Option<Real<'a>>) -> Real<'a> {
        match (self.nonzero(a), self.split_slope(a)) {
            (None, _) => 0.5 * self.h,
            (_, Some((condition, [yes, no]))) => condition.choose(self.to_middle(Some(yes)), self.to_middle(Some(no))),
            (Some(a), None) => self.h / (2.0 - self.falling(self.h * a)),
        }
    }

    /// The state at the end of the step and its mean, for a rate that is affine with the slope `a` and has the value f
    /// at x.
    fn relaxed(&self, x: Real<'a>, f: Real<'a>, a: Option<Real<'a>>) -> [Real<'a>; 2] {
        match (self.nonzero(a), self.split_slope(a)) {
            (None, _) => [1.0, 0.5].map(|part| self.added(x, part * self.h, f)),
            (_, Some((condition, sides))) => {
                let [yes, no] = [true, false].map(|truth| {
                    let a = sides[usize::from(!truth)];
                    self.relaxed(x, self.simplified(f, condition, truth), Some(a))
                });
                [0, 1].map(|k| condition.choose(yes[k], no[k]))
            }
            (Some(a), None) => {
                let r = self.once(f, a);
                self.phis(Some(a)).map(|phi| x + self.h * phi * r)
            }
        }
    }

    /// x + h f, without the operations if f is 0, or a select with a branch that is 0.
    fn added(&self, x: Real<'a>, h: Real<'a>, f: Real<'a>) -> Real<'a> {
        let op = self.build.borrow().get(f.value);
        let zero = |value: Value| self.build.borrow().constant(value) == Some(0.0);
        match op {
            _ if zero(f.value) => x,
            Op::Select(condition, yes, no) if zero(yes) || zero(no) => {
                let [yes, no] = [yes, no].map(|side| self.added(x, h, f.same(side)));
                Truth::new(self.build, condition).choose(yes, no)
            }
            _ => x + h * f,
        }
    }

    /// The slope, unless it is the constant 0.
    fn nonzero(&self, a: Option<Real<'a>>) -> Option<Real<'a>> {
        a.filter(|a| self.build.borrow().constant(a.value) != Some(0.0))
    }

    /// Splits a slope that is a select, if one side is 0, or if it selects among a few slopes that do not depend on a
    /// state. The φ-functions of each side are then hoisted out of the step loop, or are only computed if the side is
    /// selected.
    fn split_slope(&self, a: Option<Real<'a>>) -> Option<(Truth<'a>, [Real<'a>; 2])> {
        let a = a?;
        let op = self.build.borrow().get(a.value);
        let Op::Select(condition, yes, no) = op else { return None };
        let sides = [yes, no].map(|side| a.same(side));
        let level = sides.iter().any(|side| self.nonzero(Some(*side)).is_none());
        let chosen = !self.is_given(a.value) && self.is_chosen(a.value);
        (level || chosen).then(|| (Truth::new(self.build, condition), sides))
    }

    /// Simplifies a value for a condition that is known to be `truth`.
    fn simplified(&self, value: Real<'a>, condition: Truth<'a>, truth: bool) -> Real<'a> {
        match self.build.borrow().get(value.value) {
            Op::Select(selector, yes, no) if selector == condition.value => value.same(if truth { yes } else { no }),
            _ => value,
        }
    }

    /// Steps states by fixed-point iteration: rates and slopes are evaluated again at each new X.
    fn iterated(&self, rates: &Func, states: &[usize], next: &mut [Real<'a>], middle: &mut [Real<'a>]) {
        for round in 0..4 {
            let (c, at) = if round == 0 { (0.0, &self.x[..]) } else { (0.5, &*middle) };
            let mut moved = Vec::with_capacity(states.len());
            for (k, (f, a)) in states.iter().zip(self.relaxation(rates, &HashMap::new(), c, at, states)) {
                let x = self.x[*k];
                let r = match a {
                    Some(a) if round > 0 => f + self.falling(a) * (x - middle[*k]),
                    _ => f,
                };
                moved.push((*k, self.phis(a).map(|phi| x + self.h * phi * r)));
            }
            // States that depend on these use the X at which the last rates were evaluated.
            let last = round == 3;
            for (k, [end, mean]) in moved {
                next[k] = end;
                middle[k] = if last { middle[k] } else { mean };
            }
        }
    }

    /// Matrix exponential for dx/dt = A x + b(t), where b is the straight line through its values at the two Gauss
    /// points: the Taylor series of the exact solution and of its mean, each term computed from the previous one.
    ///
    ///   c1 = h (f̄ − Δ/2),  c2 = h (A c1 + Δ)/2,  ck+1 = h A ck/(k + 1),  x' = x + Σ ck,  X = x + Σ ck/(k + 1)
    ///   f̄ = (f⁺ + f⁻)/2,  Δ = √3 (f⁺ − f⁻)       f⁺, f⁻ at (t + (1/2 ± √3/6) h, x)
    ///
    /// If the last term exceeds 1e-6 of the sum of their sizes, h A is too large for the series, and the states are
    /// iterated.
    fn linear(
        &self,
        rates: &Func,
        states: &[usize],
        stored: &HashMap<Slot, Value>,
        next: &mut [Real<'a>],
        middle: &mut [Real<'a>],
    ) {
        const TERMS: u32 = 16;
        let (h, layout, root) = (self.h, &self.program.description.layout, 3f64.sqrt());
        let own: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
        let mut mean = middle.to_vec();
        for slot in rates.loads().into_iter().filter(|slot| layout.states.contains(*slot) && !own.contains(slot)) {
            let k = slot.index() - layout.states.start as usize;
            if !self.coupling.fades[k] {
                // For a state that integrates others, the mean of a parabola: from its rate at the start and both end
                // values.
                let f = self.relaxation(&self.rates_of(&[k], stored), &HashMap::new(), 0.0, &self.x, &[k])[0].0;
                mean[k] = self.x[k] + (0.5 * h * f + (next[k] - self.x[k] - h * f) / 3.0);
            }
        }
        let values = |side: f64| {
            let at: Vec<Real> = (0..self.x.len())
                .map(|k| match states.contains(&k) {
                    true => self.x[k],
                    false => mean[k] + side * root / 6.0 * (next[k] - self.x[k]),
                })
                .collect();
            let mut env = self.env_for(rates, 0.5 + side * root / 6.0, &at);
            let gradients = autodiff::inline(self.build, rates, &mut env, &own);
            let rate = |k: &usize| {
                let slot = layout.derivatives.slot(*k);
                Real::new(self.build, self.build.borrow_mut().read(slot, &env))
            };
            (states.iter().map(rate).collect::<Vec<_>>(), gradients)
        };
        let ((before, gradients), (after, _)) = (values(-1.0), values(1.0));
        let matrix: Vec<Vec<(usize, Real)>> = states
            .iter()
            .map(|k| {
                let row = gradients.get(&layout.derivatives.slot(*k)).cloned().unwrap_or_default();
                row.into_iter().map(|(j, a)| (j as usize, h * Real::new(self.build, a))).collect()
            })
            .collect();
        let slope: Vec<Option<Real>> = before
            .iter()
            .zip(&after)
            .map(|(before, after)| (before.value != after.value).then(|| h * (root * (*after - *before))))
            .collect();
        let mut term: Vec<Option<Real>> = (0..states.len())
            .map(|i| {
                Some(match slope[i] {
                    Some(slope) => h * (0.5 * (before[i] + after[i])) - 0.5 * slope,
                    None => h * before[i],
                })
            })
            .collect();
        let added = |a: Option<Real<'a>>, b: Option<Real<'a>>| match (a, b) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        };
        let mut end = term.clone();
        let mut inside: Vec<Option<Real>> = term.iter().map(|term| term.map(|term| 0.5 * term)).collect();
        let mut size: Vec<Option<Real>> = term.iter().map(|term| term.map(Real::abs)).collect();
        for k in 2..=TERMS {
            let of_row = |row: &Vec<(usize, Real<'a>)>| {
                row.iter().filter_map(|(j, a)| term[*j].map(|term| *a * term)).reduce(|a, b| a + b)
            };
            let mut following: Vec<Option<Real>> = matrix.iter().map(of_row).collect();
            if k == 2 {
                following = following.into_iter().zip(&slope).map(|(term, slope)| added(term, *slope)).collect();
            }
            term = following.into_iter().map(|term| term.map(|term| 1.0 / f64::from(k) * term)).collect();
            for i in 0..states.len() {
                end[i] = added(end[i], term[i]);
                inside[i] = added(inside[i], term[i].map(|term| 1.0 / f64::from(k + 1) * term));
                size[i] = added(size[i], term[i].map(Real::abs));
            }
        }
        let small = |(term, size): (&Option<Real<'a>>, &Option<Real<'a>>)| {
            term.zip(*size).map(|(term, size)| term.abs().not_above(1e-6 * size))
        };
        let converges = term.iter().zip(&size).filter_map(small).reduce(|a, b| a & b);
        let (mut other_next, mut other_middle) = (next.to_vec(), middle.to_vec());
        if converges.is_some() {
            self.iterated(rates, states, &mut other_next, &mut other_middle);
        }
        for (i, k) in states.iter().enumerate() {
            let moved = |way: Option<Real<'a>>| way.map_or(self.x[*k], |way| self.x[*k] + way);
            let (at_end, at_mean) = (moved(end[i]), moved(inside[i]));
            (next[*k], middle[*k]) = match converges {
                Some(truth) => (truth.choose(at_end, other_next[*k]), truth.choose(at_mean, other_middle[*k])),
                None => (at_end, at_mean),
            };
        }
    }

    /// The result of the fixed-point iteration for an affine rate with the value `f` at x and the slope `a`. This is f
    /// itself, unless the state grows (a > 0): then X = x + h r/2 with r = f + a (X − x), iterated.
    fn once(&self, f: Real<'a>, a: Real<'a>) -> Real<'a> {
        let half = 0.5 * self.h;
        let mut r = f;
        for _ in 0..3 {
            r = f + a * (half * r);
        }
        a.above(0.0).choose(r, f)
    }

    /// The function of the rates of these states alone: only the operations that they need.
    fn rates_of(&self, states: &[usize], stored: &HashMap<Slot, Value>) -> Func {
        let func = &self.program.derivatives;
        let slots = states.iter().map(|k| self.program.description.layout.derivatives.slot(*k));
        let stores: Vec<(Slot, Value)> = slots.filter_map(|slot| Some((slot, *stored.get(&slot)?))).collect();
        let mut needed = BTreeSet::new();
        let mut open: Vec<Value> = stores.iter().map(|(_, value)| *value).collect();
        while let Some(value) = open.pop() {
            if needed.insert(value) {
                func.op(value).each_operand(|operand| open.push(operand));
            }
        }
        let number: HashMap<Value, Value> =
            needed.iter().enumerate().map(|(number, value)| (*value, Value(number as u32))).collect();
        let ops = needed.iter().map(|value| func.op(*value).map(|operand| number[&operand])).collect();
        let stores = stores.into_iter().map(|(slot, value)| (slot, number[&value])).collect();
        Func { name: func.name.clone(), ops, stores, ..Func::default() }
    }

    /// For each of these states f, and ∂f/∂x with respect to itself; `None` if f does not depend on it.
    fn relaxation(
        &self,
        rates: &Func,
        answers: &HashMap<Value, Value>,
        c: f64,
        x: &[Real<'a>],
        states: &[usize],
    ) -> Vec<(Real<'a>, Option<Real<'a>>)> {
        let layout = &self.program.description.layout;
        let mut env = self.env_for(rates, c, x);
        let slots: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
        let gradients = autodiff::inline_given(self.build, rates, &mut env, &slots, answers);
        let of = |(direction, k): (usize, &usize)| {
            let slot = layout.derivatives.slot(*k);
            let f = Real::new(self.build, self.build.borrow_mut().read(slot, &env));
            let own = gradients.get(&slot).and_then(|gradient| autodiff::entry(gradient, direction as u32));
            (f, own.map(|a| Real::new(self.build, self.chosen(a, 8))))
        };
        states.iter().enumerate().map(of).collect()
    }

    /// min(a, 0)
    fn falling(&self, a: Real<'a>) -> Real<'a> {
        a.below(0.0).choose(a, 0.0)
    }

    /// φ(q) = (e^q − 1)/q and φ2(q) = (e^q − 1 − q)/q² for q = min(h a, 0); φ(0) = 1, φ2(0) = 1/2.
    fn phis(&self, a: Option<Real<'a>>) -> [Real<'a>; 2] {
        match (self.nonzero(a), self.split_slope(a)) {
            (Some(a), None) if self.build.borrow().constant(a.value).is_none_or(|a| a < 0.0) => {
                phi_functions::phis(self.falling(self.h * a))
            }
            (Some(_), Some((condition, [yes, no]))) => {
                let [yes, no] = [yes, no].map(|side| self.phis(Some(side)));
                [0, 1].map(|k| condition.choose(yes[k], no[k]))
            }
            _ => [1.0, 0.5].map(|phi| self.h.constant(phi)),
        }
    }

    /// Whether a value is selected among at most [`MOST_CHOSEN`] values that do not depend on a state.
    fn is_chosen(&self, value: Value) -> bool {
        let (mut open, mut seen, mut given) = (vec![value], HashSet::new(), 0);
        while let Some(value) = open.pop() {
            if !seen.insert(value) {
                continue;
            }
            let op = self.build.borrow().get(value);
            match op {
                _ if self.is_given(value) => given += 1,
                Op::Select(_, yes, no) => open.extend([yes, no]),
                _ => return false,
            }
            if given > MOST_CHOSEN || seen.len() > 3 * MOST_CHOSEN {
                return false;
            }
        }
        true
    }

    /// Moves selects outwards, if only their conditions depend on states: (if c then 1 else 0) · x − y → if c then x −
    /// y else −y. 0 · x and 0/x become 0, as in a derivative.
    fn chosen(&self, value: Value, deepest: u32) -> Value {
        let op = self.build.borrow().get(value);
        if deepest == 0 || self.is_given(value) {
            return value;
        }
        let (a, b) = match op {
            Op::Select(condition, yes, no) => {
                let [yes, no] = [yes, no].map(|side| self.chosen(side, deepest - 1));
                return self.choice(condition, yes, no);
            }
            Op::Neg(a) => (a, a),
            Op::Add(a, b) | Op::Sub(a, b) | Op::Mul(a, b) | Op::Div(a, b) => (a, b),
            _ => return value,
        };
        // One operand is a select, and the other does not depend on a state.
        let (choice, other) = if self.is_given(a) { (b, a) } else { (a, b) };
        if choice != other && !self.is_given(other) {
            return value;
        }
        let choices = self.chosen(choice, deepest - 1);
        if !self.is_chosen(choices) {
            return value;
        }
        self.for_each_choice(choices, &|side| {
            let of = |operand: Value| if operand == choice { side } else { operand };
            let mut build = self.build.borrow_mut();
            let zero = |value: Value, build: &Build| build.constant(value) == Some(0.0);
            match op.map(of) {
                Op::Mul(a, b) if zero(a, &build) || zero(b, &build) => build.real(0.0),
                Op::Div(a, _) if zero(a, &build) => build.real(0.0),
                op => build.op(op),
            }
        })
    }

    /// Applies `f` to each value that a nest of selects can return.
    fn for_each_choice(&self, value: Value, f: &dyn Fn(Value) -> Value) -> Value {
        let op = self.build.borrow().get(value);
        match op {
            Op::Select(condition, yes, no) if !self.is_given(value) => {
                let [yes, no] = [yes, no].map(|side| self.for_each_choice(side, f));
                self.choice(condition, yes, no)
            }
            _ => f(value),
        }
    }

    /// A select, simplified: if c then a else if d then a else b → if c or d then a else b.
    fn choice(&self, condition: Value, yes: Value, no: Value) -> Value {
        let mut build = self.build.borrow_mut();
        match build.get(no) {
            Op::Select(other, same, no) if same == yes => {
                let either = build.or(condition, other);
                build.select(either, yes, no)
            }
            _ => build.select(condition, yes, no),
        }
    }

    /// Whether a value depends on no state.
    fn is_given(&self, value: Value) -> bool {
        let states = self.program.description.layout.states;
        let build = self.build.borrow();
        let mut given = self.given.borrow_mut();
        while given.len() < build.len() {
            let op = build.get(Value(given.len() as u32));
            let mut all = !matches!(op, Op::Load(slot) if states.contains(slot));
            op.each_operand(|operand| all &= given[operand.index()]);
            given.push(all);
        }
        given[value.index()]
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
mod tests {
    use super::*;
    use crate::codegen::jit::{compile, compile_prepared};
    use crate::ir::Unary;
    use crate::ir::interpret::Interpreter;
    use crate::ir::random::REALS;
    use crate::math::{POOL, expand};
    use abi::description::{Automaton, Tick};
    use abi::unit::Unit;
    use abi::{Code, Description, Function, Layout};
    use std::sync::Arc;

    /// The layout of a model with n states, one period, one held value and one output.
    fn layout(n: u32) -> Layout {
        Layout::new([0, 0, n, 2, 1, 1, n, 0, 0, 1])
    }

    /// The program of dx/dt = f(t, x) with one output.
    fn program(n: u32, f: impl for<'a> Fn(Real<'a>, &[Real<'a>]) -> (Vec<Real<'a>>, Real<'a>)) -> Program {
        let layout = layout(n);
        let func = |name: &str, outputs: bool| {
            let build = Shared::new(Build::new(name));
            let load = |slot| Real::new(&build, build.borrow_mut().load(slot));
            let x: Vec<Real> = (0..n as usize).map(|k| load(layout.states.slot(k))).collect();
            let (rates, output) = f(load(Slot::TIME), &x);
            let rates: Vec<Value> = rates.iter().map(|rate| rate.value).collect();
            let output = output.value;
            let mut build = build.into_inner();
            if outputs {
                build.store(layout.outputs.slot(0), output);
            } else {
                rates.iter().enumerate().for_each(|(k, rate)| build.store(layout.derivatives.slot(k), *rate));
            }
            build.finish()
        };
        let (outputs, derivatives) = (func("outputs", true), func("derivatives", false));
        let description = Description { layout, pool: POOL.as_slice().into(), ..Description::default() };
        Program { description, outputs, derivatives, ..Program::default() }
    }

    /// dz/dt and F of the LuGre model with the textbook's values, in N, m, s; `sigma1` is 316 or √1e5 there.
    fn lugre<'a>(v: Real<'a>, z: Real<'a>, sigma1: f64) -> (Real<'a>, Real<'a>) {
        let ratio = v / 1e-3;
        let g = 1.0 + 0.5 * (-(ratio * ratio)).of(Unary::Exp);
        let rate = v - 1e5 * v.abs() / g * z;
        (rate, 1e5 * z + sigma1 * rate + 0.4 * v)
    }

    struct Run {
        code: Code,
        block: Vec<f64>,
        layout: Layout,
    }

    impl Run {
        fn new(program: &Program, method: Method, h: f64, x: &[f64]) -> Run {
            let layout = program.description.layout.clone();
            let step = expand(&step(program, method));
            let code = Code::Machine(compile(&[(Function::Step, step)], &layout, POOL.len()).unwrap().0);
            let mut block = vec![0.0; layout.size()];
            block[Slot::STEP.index()] = h;
            block[layout.states.range()].copy_from_slice(x);
            Run { code, block, layout }
        }

        fn advance(&mut self, n: u64) -> u64 {
            self.code.call(Function::Step, &mut self.block, &POOL, n)
        }

        fn x(&self, k: usize) -> f64 {
            self.block[self.layout.states.slot(k).index()]
        }
    }

    /// x' = cos t + x sin t, v' = −x: smooth; the error against a fine solution has the order of the method.
    #[test]
    fn methods_have_their_orders() {
        let program = program(2, |t, x| {
            let (s, c) = (t.of(Unary::Sin), t.of(Unary::Cos));
            (vec![c + x[0] * s * 0.5 - x[1], x[0] - 0.7 * x[1]], x[0])
        });
        let end = |method, n: u64| {
            let mut run = Run::new(&program, method, 1.0 / n as f64, &[0.3, -0.2]);
            run.advance(n);
            [run.x(0), run.x(1)]
        };
        let exact = end(Method::Rk4, 1 << 10);
        let error = |found: [f64; 2]| (found[0] - exact[0]).abs() + (found[1] - exact[1]).abs();
        for method in Method::fixed() {
            let order = f64::from(method.row().order);
            let [coarse, fine] = [16, 32].map(|n| error(end(method, n)));
            let found = (coarse / fine).log2();
            assert!((found - order).abs() < 0.25, "{}: order {found}, errors {coarse} and {fine}", method.name());
        }
    }

    /// dx/dt = 2 − 50 x: expo is exact for any step length, and stays between x and its rest point.
    #[test]
    fn expo_is_exact_for_a_state_that_relaxes() {
        let program = program(1, |_, x| (vec![2.0 - 50.0 * x[0]], x[0]));
        for h in [1e-6, 1e-3, 0.1, 10.0] {
            let mut run = Run::new(&program, Method::Expo, h, &[1.0]);
            run.advance(1);
            let exact = 0.04 + 0.96 * core_math::exp(-50.0 * h);
            assert!((run.x(0) - exact).abs() < 1e-14, "h = {h}: {} and not {exact}", run.x(0));
        }
    }

    /// An oscillator, driven by a ramp and a parabola of time: exact for any step length.
    #[test]
    fn expo_is_exact_for_coupled_linear_states() {
        let program = program(4, |t, x| {
            let force = 4.0 * (x[2] - x[0]) + 0.5 * (x[3] - x[1]);
            (vec![x[1], force, x[3], t * 0.0 + 3.0], x[0])
        });
        let end = |method, n: u64| {
            let mut run = Run::new(&program, method, 2.0 / n as f64, &[0.3, -0.2, 0.1, 0.7]);
            run.advance(n);
            [run.x(0), run.x(1)]
        };
        let exact = end(Method::Rk4, 1 << 12);
        for n in [2, 4, 20, 200] {
            let found = end(Method::Expo, n);
            let error = (found[0] - exact[0]).abs() + (found[1] - exact[1]).abs();
            // The parabola is approximated by a straight line through the Gauss points.
            assert!(error < 6e-2 * (2.0 / n as f64).powi(4) + 1e-11, "{n} steps: {found:?} and not {exact:?}");
        }
    }

    /// A stop that pushes back beyond 0.3 with k (x − 0.3): order 2, wherever the edge lies within a step.
    #[test]
    fn expo_evaluates_switching_conditions_mid_step() {
        let program = |k: f64| {
            program(1, move |t, x| {
                let beyond = x[0] - 0.3;
                (vec![t.of(Unary::Cos) - beyond.above(0.0).choose(k * beyond, 0.0)], x[0])
            })
        };
        let mean = |n: u64, of: &dyn Fn(u64, f64) -> f64| {
            let mut run = Run::new(&program(20.0), Method::Expo, 10.0 / n as f64, &[0.0]);
            let errors = (0..32).map(|k| {
                run.advance(n / 32);
                of(k, run.x(0))
            });
            errors.sum::<f64>() / 32.0
        };
        let exact = RefCell::new(Vec::new());
        mean(1 << 18, &|_, x| {
            exact.borrow_mut().push(x);
            0.0
        });
        let error = |n| mean(n, &|k, x| (x - exact.borrow()[k as usize]).abs());
        let (coarse, fine) = (error(1 << 8), error(1 << 12));
        let order = (coarse / fine).log2() / 4.0;
        assert!((1.8..2.3).contains(&order), "order {order}, errors {coarse} and {fine}");
        // For any stiffness, the state does not pass the stop, and it leaves as soon as it is pulled back.
        let mut run = Run::new(&program(1e9), Method::Expo, 0.01, &[0.0]);
        let course: Vec<f64> = (0..628).map(|_| (run.advance(1), run.x(0)).1).collect();
        let most = course.iter().copied().fold(0.0, f64::max);
        assert!(most > 0.3 && most < 0.3 + 1e-8, "{most}");
        assert!((course[627] - (0.3 - 1.0)).abs() < 0.01, "{}", course[627]);
    }

    /// Coulomb friction on a mass alone: the state stays within the distance of one and a half steps.
    #[test]
    fn a_state_attracted_to_a_jump_stays_near_it() {
        let program = program(1, |_, x| (vec![x[0].above(0.0).choose(-1.0, 1.0)], x[0]));
        let mut run = Run::new(&program, Method::Expo, 0.1, &[0.96]);
        run.advance(9);
        assert!((run.x(0) - 0.06).abs() < 1e-12, "{}", run.x(0));
        for _ in 0..100 {
            run.advance(1);
            assert!(run.x(0).abs() < 0.15, "{}", run.x(0));
        }
    }

    /// Largest |z| in µm at 50 mm/s, 1 Hz, for 2 s: the table in section 8.2 of the language manual.
    #[test]
    fn driven_bristle_agrees_with_the_published_table() {
        let program = program(1, |t, x| {
            let v = 0.05 * (t * (2.0 * std::f64::consts::PI)).of(Unary::Sin);
            let (rate, force) = lugre(v, x[0], 316.0);
            (vec![rate], force)
        });
        let largest = |method, h: f64| {
            let mut run = Run::new(&program, method, h, &[0.0]);
            let steps = (2.0 / h).round() as u64;
            (0..steps).fold(0f64, |largest, _| {
                run.advance(1);
                if run.x(0).is_nan() { f64::INFINITY } else { largest.max(run.x(0).abs() * 1e6) }
            })
        };
        let table = [
            (1e-3, [None, None, Some(10.57), Some(10.56)]),
            (5e-4, [None, Some(10.56), Some(10.57), Some(10.56)]),
            (1e-4, [Some(10.57), Some(10.56), Some(10.56), Some(10.56)]),
        ];
        for (h, row) in table {
            for (method, expected) in [Method::Euler, Method::Rk4, Method::Expo, Method::Implicit].into_iter().zip(row)
            {
                let found = largest(method, h);
                match expected {
                    Some(expected) => assert!((found - expected).abs() <= 0.0051, "{} at {h}: {found}", method.name()),
                    None => assert!(found > 15.1, "{} at {h} stays in bounds: {found}", method.name()),
                }
            }
        }
    }

    /// A mass of 1 kg thrown at 1 m/s travels 0.394792 m; at 1 ms expo returns 0.394793.
    #[test]
    fn coasting_down_conserves_momentum() {
        let program = program(3, |_, x| {
            let (rate, force) = lugre(x[1], x[2], 1e5f64.sqrt());
            (vec![x[1], -force, rate], force)
        });
        let mut run = Run::new(&program, Method::Expo, 1e-3, &[0.0, 1.0, 0.0]);
        run.advance(3000);
        assert!((run.x(0) - 0.394793).abs() < 1e-6, "{}", run.x(0));
    }

    /// A mass pulled through a spring of 2 N/m at 0.1 m/s for 40 s: end position in m. The values of `implicit` and
    /// `rk4` are from section 8.2; those of `expo` are from an independent program with the same formulas.
    #[test]
    fn pulling_agrees_with_an_independent_program() {
        let program = program(3, |t, x| {
            let (rate, force) = lugre(x[1], x[2], 316.0);
            (vec![x[1], 2.0 * (0.1 * t - x[0]) - force, rate], force)
        });
        let end = |method, h: f64| {
            let mut run = Run::new(&program, method, h, &[0.0; 3]);
            run.advance((40.0 / h).round() as u64);
            run.x(0)
        };
        for (method, h, expected) in [
            (Method::Expo, 1e-4, 3.306793),
            (Method::Expo, 5e-4, 3.306826),
            (Method::Expo, 1e-3, 3.306926),
            (Method::Expo, 2e-3, 3.307287),
            (Method::Implicit, 1e-4, 3.306792),
            (Method::Implicit, 5e-4, 3.306806),
            (Method::Implicit, 1e-3, 3.306846),
            (Method::Implicit, 2e-3, 3.306972),
            (Method::Rk4, 2e-5, 3.306792),
        ] {
            let found = end(method, h);
            println!("pull, {} at {h}: {found:.7}, elsewhere {expected}", method.name());
            assert!((found - expected).abs() < 1.1e-6, "{} at {h}: {found}", method.name());
        }
    }

    /// Limit cycle of the PID servo (hunting): peak to peak after 50 s, in mm.
    #[test]
    fn hunting_agrees_with_an_independent_program() {
        let program = program(5, |_, x| {
            let [position, v, z, i, filtered] = x.try_into().expect("five states");
            let e = 1.0 - position;
            let raw = 3.0 * e + i - 600.0 * (position - filtered);
            let u = (-(-raw).at_most(20.0)).at_most(20.0);
            let (rate, force) = lugre(v, z, 316.0);
            let integral = 4.0 * e + (u - raw) / 0.5;
            (vec![v, u - force, rate, integral, 100.0 * (position - filtered)], force)
        });
        for (method, h, expected) in [
            (Method::Expo, 1e-4, 126.408),
            (Method::Expo, 5e-4, 126.407),
            (Method::Expo, 1e-3, 126.402),
            (Method::Expo, 2e-3, 126.385),
            (Method::Implicit, 1e-3, 126.406),
            (Method::Implicit, 2e-3, 126.401),
        ] {
            let mut run = Run::new(&program, method, h, &[0.0; 5]);
            let steps = (50.0 / h).round() as u64;
            run.advance(steps);
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            for _ in 0..steps {
                run.advance(1);
                (low, high) = (low.min(run.x(0)), high.max(run.x(0)));
            }
            let found = (high - low) * 1e3;
            println!("hunting, {} at {h}: {found:.5}, elsewhere {expected}", method.name());
            assert!((found - expected).abs() < 1e-3, "{} at {h}: {found}", method.name());
        }
    }

    /// If a pivot is exactly 0, 1 − γ h a = 0, the step is that of expo.
    #[test]
    fn a_singular_step_falls_back_to_expo() {
        let gamma = 1.0 - std::f64::consts::FRAC_1_SQRT_2;
        let program = program(1, move |_, x| (vec![x[0] * (1.0 / gamma)], x[0]));
        let mut run = Run::new(&program, Method::Implicit, 1.0, &[1.0]);
        let mut expo = Run::new(&program, Method::Expo, 1.0, &[1.0]);
        run.advance(1);
        expo.advance(1);
        assert_eq!(run.x(0), expo.x(0));
        assert!(run.x(0).is_finite());
    }

    #[test]
    fn time_is_count_times_step_and_sampled_blocks_run_on_time() {
        let mut program = program(1, |t, x| (vec![t * 0.0], x[0]));
        let layout = program.description.layout.clone();
        // The sampled block adds 1 to the held value; the transition copies it to the mode.
        let (period, held, due) = (layout.memory.slot(0), layout.memory.slot(1), layout.due.slot(0));
        let mut tick = Build::new("tick");
        let (flag, before) = (tick.load(due), tick.load(held));
        let next = tick.add(before, flag);
        tick.store(held, next);
        program.tick = Some(tick.finish());
        let mut transitions = Build::new("transitions");
        let held_now = transitions.load(held);
        transitions.store(layout.regimes.slot(0), held_now);
        program.transitions = Some(transitions.finish());
        program.description.ticks = vec![Tick { period, due }];
        program.description.automata =
            vec![Automaton { path: String::new(), regimes: Vec::new(), slot: layout.regimes.slot(0) }];
        let mut run = Run::new(&program, Method::Euler, 1e-3, &[0.0]);
        run.block[period.index()] = 7e-3;
        run.advance(10_000);
        assert_eq!(run.block[Slot::COUNT.index()], 10_000.0);
        assert_eq!(run.block[Slot::TIME.index()], 10_000.0 * 1e-3);
        assert_eq!(run.block[held.index()], f64::from(10_000 / 7));
        assert_eq!(run.block[layout.regimes.slot(0).index()], f64::from(10_000 / 7));
        assert_eq!(run.block[due.index()], 0.0, "what is due is not stored");
    }

    #[test]
    fn the_status_names_the_first_failed_guard() {
        let mut program = program(2, |_, x| (vec![x[0] * 0.0 + 1.0, 0.0 * x[0]], x[0] / x[1]));
        let layout = program.description.layout.clone();
        let guard = |slot, range| Guard { path: String::new(), slot, range, unit: Unit::none() };
        program.description.guards = vec![
            guard(layout.outputs.slot(0), (f64::NEG_INFINITY, f64::INFINITY)),
            guard(layout.states.slot(0), (0.0, 3.0)),
            guard(layout.states.slot(1), (f64::NEG_INFINITY, f64::INFINITY)),
        ];
        // Starts within the tolerance of 3e-6 below the range, and ends at 4.
        let mut run = Run::new(&program, Method::Euler, 1.0, &[2e-6, 1.0]);
        assert_eq!(run.advance(100), 2);
        assert_eq!(run.block[Slot::COUNT.index()], 4.0);
        let mut run = Run::new(&program, Method::Euler, 1.0, &[0.0, 0.0]);
        assert_eq!((run.advance(100), run.block[Slot::COUNT.index()]), (1, 1.0));
        let mut run = Run::new(&program, Method::Euler, 1.0, &[0.0, f64::INFINITY]);
        assert_eq!(run.advance(100), 3);
        let mut run = Run::new(&program, Method::Euler, 1.0, &[-2.0, 1.0]);
        assert_eq!(run.advance(100), 2);
    }

    #[test]
    fn bounds_on_both_sides_also_catch_nan() {
        let guard = |range| Guard { path: String::new(), slot: Slot(0), range, unit: Unit::none() };
        for (range, far) in [((-2.0, 2.0), -2.1), ((-1.0, 2.0), -1.1), ((-1.0, 2.0), 2.1)] {
            let mut program = program(1, |_, x| (vec![x[0] * 0.0], x[0]));
            program.description.guards =
                vec![Guard { slot: program.description.layout.states.slot(0), ..guard(range) }];
            let status = |x: f64| Run::new(&program, Method::Euler, 1.0, &[x]).advance(1);
            for x in [0.0, -0.9, 2.0, 2.000001] {
                assert_eq!(status(x), 0, "{x} in {range:?}");
            }
            for x in [far, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                assert_eq!(status(x), 1, "{x} in {range:?}");
            }
        }
    }

    /// For various ranges of a state and an output, from edge-case numbers.
    #[test]
    fn a_prepared_step_returns_the_status_of_the_reference() {
        const ALL: f64 = f64::INFINITY;
        let mut program = program(1, |_, x| (vec![0.5 * x[0] * x[0]], 0.75 - x[0]));
        let layout = program.description.layout.clone();
        let [x, y] = [layout.states.slot(0), layout.outputs.slot(0)];
        let guard = |slot, range| Guard { path: String::new(), slot, range, unit: Unit::none() };
        let ranges = [(-ALL, ALL), (-2.0, 2.0), (-1.0, 2.0), (0.0, ALL), (-ALL, 1.0)];
        let (mut failed, mut fine) = (0, 0);
        for (of_state, of_output) in ranges.iter().flat_map(|a| ranges.map(|b| (*a, b))) {
            program.description.guards = vec![guard(x, of_state), guard(y, of_output)];
            let funcs = [(Function::Step, expand(&step(&program, Method::Euler)))];
            let code = compile_prepared(&funcs, &layout, POOL.len()).unwrap().0;
            let prepared = code.prepared().expect("a single step has code of its own");
            let reference = Code::Interpreted(Arc::new(Interpreter::new(&funcs, &layout, POOL.len())));
            for number in REALS.iter().copied().chain([0.7, -0.7, 1.7, -1.7, 1e200]) {
                let mut block = vec![0.0; layout.size()];
                (block[Slot::STEP.index()], block[x.index()]) = (1.0, number);
                let (mut found, mut expected) = (block.clone(), block);
                found.resize(expected.len() + prepared.len, f64::NAN);
                let status = code.step_prepared(&mut found, &POOL, false).expect("it has such a step");
                let of_reference = reference.call(Function::Step, &mut expected, &POOL, 1);
                // The caller updates the count.
                found[Slot::COUNT.index()] = expected[Slot::COUNT.index()];
                let same =
                    found.iter().zip(&expected).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
                assert!(
                    status == of_reference && same,
                    "{of_state:?} {of_output:?} from {number}: {status} and not {of_reference}, {found:?}, {expected:?}"
                );
                *(if status == 0 { &mut fine } else { &mut failed }) += 1;
            }
        }
        assert!(failed > 100 && fine > 100, "{failed} have failed, {fine} not");
    }

    #[test]
    fn only_a_model_that_uses_time_stores_it() {
        let keeps = |program: &Program| step(program, Method::Rk4).stores.iter().any(|(slot, _)| *slot == Slot::TIME);
        assert!(!keeps(&program(1, |_, x| (vec![-1.0 * x[0]], x[0]))));
        assert!(keeps(&program(1, |t, x| (vec![-1.0 * x[0] * t], x[0]))));
        assert!(keeps(&program(1, |t, x| (vec![-1.0 * x[0]], x[0] + t))), "outputs alone may be asked for, too");
    }

    #[test]
    fn a_decayed_state_becomes_zero() {
        let program = program(1, |_, x| (vec![-1.0 * x[0]], x[0]));
        let mut run = Run::new(&program, Method::Euler, 0.5, &[1e-29]);
        run.advance(3);
        assert!(run.x(0) > 0.0);
        run.advance(1);
        assert_eq!(run.x(0).to_bits(), 0);
    }

    /// Steps of every method, interpreted and compiled, from states of every size.
    #[test]
    fn steps_agree_to_the_bit() {
        let program = program(3, |t, x| {
            let (rate, force) = lugre(x[1], x[2], 316.0);
            (vec![x[1], 2.0 * (0.1 * t - x[0]) - force, rate], force)
        });
        let layout = program.description.layout.clone();
        let mut random = crate::ir::random::Random(3);
        for method in Method::fixed() {
            let funcs = [(Function::Step, expand(&step(&program, method)))];
            let machine = Code::Machine(compile(&funcs, &layout, POOL.len()).unwrap().0);
            let reference = Code::Interpreted(Arc::new(Interpreter::new(&funcs, &layout, POOL.len())));
            for case in 0..300 {
                let mut block = vec![0.0; layout.size()];
                block[Slot::STEP.index()] = 1e-4;
                for slot in layout.states.range() {
                    block[slot] = if case % 3 == 0 { random.real() } else { random.within(-1e-2, 1e-2) };
                }
                let mut other = block.clone();
                machine.call(Function::Step, &mut block, &POOL, 5);
                reference.call(Function::Step, &mut other, &POOL, 5);
                let same =
                    block.iter().zip(&other).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
                assert!(same, "{} case {case}: {block:?} and {other:?}", method.name());
            }
        }
    }
}
