//! The adaptive step: one step of the Rosenbrock method Rodas5P as one straight-line function, with its step control.
//!
//! In: a [`Program`]. Out: a function over the segment [`Trial`]. It reads t, the wanted step length, and the states,
//! derivatives and Jacobian at the start. It writes the same quantities at the end, the interpolant, the estimated
//! errors and the switching functions along the step. As one function, f and its derivatives at the end share
//! operations and serve as the start of the next step; zeros and constants of the Jacobian are known, so that rows like
//! dx/dt = v cost no division; and values between the stages stay in registers.
//!
//! The function itself accepts a trial without events, or rejects it for its error, so that a loop around it makes step
//! after step. It does not know what happens at an event.
//!
//! Sources: Steinebach, BIT 63:27, 2023 (method); Hairer, Wanner, *Solving ODEs II*, IV.7 and IV.8 (stages, step
//! control).

use crate::ir::build::{Build, Env};
use crate::ir::expr::{Int, Real, Shared, Truth};
use crate::ir::hash::HashSet;
use crate::ir::program::Program;
use crate::ir::{Func, Op, Unary, Value};
use crate::math::POOL;
use crate::numerics::autodiff::{self, Gradient};
use crate::numerics::sparse_lu::Matrix;
use abi::Slot;
use abi::description::Segment;
use abi::rosenbrock::coefficients::{A, C, D, GAMMA, H, STAGES, W};
use abi::rosenbrock::layout::{LOOK, PIVOT, Point, Trial};
use abi::rosenbrock::step_control::{
    BEFORE_SURFACE, GREATEST_GAIN, HALFWAY, LEAST_ERROR, LEAST_GAIN, LEAST_ROOT, LEAST_STEP, MOST_BEFORE_SURFACE,
    MOST_OVERRUNS, MOST_REFUSED, NEARLY, ROOT_CONSTANT, SAFETY,
};
use std::sync::OnceLock;

/// A pivot is too small below this fraction of its row. The remaining digits are just enough for an error estimate.
const LEAST_PIVOT: f64 = 1e-6;

/// Largest number of operations of the derivatives, before expansion, for which a step is unrolled. A step contains
/// them eight times, and its compilation must pay off.
const MOST_OPERATIONS: usize = 400;

/// The step function. `None` if the layout has no room for it or the model has too many operations.
pub fn rosenbrock(program: &Program) -> Option<Func> {
    if program.derivatives.ops.len() > MOST_OPERATIONS {
        return None;
    }
    let trial = Trial::of(&program.description.layout)?;
    let build = Shared::new(Build::new("rosenbrock").with_pool(program.description.pool.clone()));
    let (singular, look) = RosenbrockStep { program, build: &build, trial }.build();
    let mut build = build.into_inner();
    let (pivot, looked_at, zero) = (build.int(PIVOT as i64), build.int(LOOK as i64), build.int(0));
    let why = build.select(singular, pivot, looked_at);
    let status = build.select(look, why, zero);
    build.status(status);
    // The model's equations are neither reassociated nor contracted: a contact that sticks relies on differences that
    // are exactly zero. The method's own weighted sums are fused: the stages they weigh are zero in that case.
    Some(build.finish())
}

fn slots(segment: Segment) -> impl Iterator<Item = Slot> {
    segment.range().map(|slot| Slot(slot as u32))
}

/// The constants of this function. They follow the constants of the elementary functions in the pool: they are too many
/// for the registers, and memory operands are cheap.
pub fn constants() -> &'static [f64] {
    static CONSTANTS: OnceLock<Vec<f64>> = OnceLock::new();
    CONSTANTS.get_or_init(|| {
        let weights = W.iter().flatten().map(|weight| GAMMA * weight);
        let other = A.iter().flatten().chain(&C).chain(&D).chain(H.iter().flatten()).copied();
        let mut constants: Vec<f64> = weights.chain(other).chain([GAMMA]).collect();
        for function in Unary::ALL {
            let mut build = Build::new("constants");
            let x = build.load(Slot::TIME);
            let y = build.unary(function, x);
            build.store(Slot::TIME, y);
            let ops = crate::math::expand(&build.finish()).ops;
            constants.extend(
                ops.iter().filter_map(|op| if let Op::Real(bits) = op { Some(f64::from_bits(*bits)) } else { None }),
            );
        }
        // Sorted and unique. NaN is not a constant of a formula.
        constants.retain(|x| !x.is_nan());
        constants.sort_by(f64::total_cmp);
        constants.dedup_by_key(|x| x.to_bits());
        constants
    })
}

/// Replaces the constants of the expanded function by reads from the pool.
pub fn pooled(func: &Func) -> Func {
    let constants = constants();
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let known = match op {
            Op::Real(bits) => constants.binary_search_by(|x| x.total_cmp(&f64::from_bits(*bits))).ok(),
            _ => None,
        };
        values.push(match known {
            Some(entry) => {
                let first = build.int(0);
                build.pool((POOL.len() + entry) as u32, 1, first)
            }
            None => build.op(op.map(|operand| values[operand.index()])),
        });
    }
    build.finish_as(func, &values)
}

/// The length of a step.
struct Length<'a> {
    /// The length by error control and the largest permitted step, if no stop were near.
    wanted: Real<'a>,
    h: Real<'a>,
    /// The time at which the last stages are evaluated.
    end: Real<'a>,
    /// Whether the step reaches the stop.
    hits: Truth<'a>,
}

/// The result of a trial step from t over h: the values at its end.
struct Found<'f, 'a> {
    t: Real<'a>,
    h: Real<'a>,
    end: Real<'a>,
    wanted: Real<'a>,
    x: &'f [Real<'a>],
    f: &'f [Real<'a>],
    jacobian: &'f [Real<'a>],
    surfaces: &'f [Real<'a>],
    scales: &'f [Real<'a>],
}

struct RosenbrockStep<'a> {
    program: &'a Program,
    build: &'a Shared,
    trial: Trial,
}

impl<'a> RosenbrockStep<'a> {
    /// Appends and stores everything. Returns whether a pivot is too small, and whether the caller must look at the
    /// trial.
    fn build(self) -> (Value, Value) {
        let n = self.program.description.layout.states.len as usize;
        let t = self.load(self.trial.time());
        let Length { wanted, h, end, hits } = self.length(t);
        self.keep(self.trial.step(), h);
        self.keep(self.trial.end(), end);
        let from = self.trial.from();
        let (x0, f0) = (self.loads(from.states), self.loads(from.derivatives));
        let (rows, df_dt) = self.jacobian(t, &x0, from);
        let gh = GAMMA * h;
        let factors = Matrix::identity_less(gh, &rows).factorise(LEAST_PIVOT);

        // (I − γhJ) u = γh (f + h d ∂f/∂t) + γ Σ W u
        let mut u: Vec<Vec<Real>> = Vec::new();
        let mut x = x0.clone();
        let mut f = f0;
        let mut turned = Truth::from((false, self.build));
        for stage in 0..STAGES {
            if stage > 0 {
                x = (0..n).map(|i| self.argument(stage, i, &x0, &x, &u)).collect();
                let time = if stage < 5 { t + C[stage] * h } else { end };
                let mut env = self.env(time, &x);
                f = self.rates(&mut env);
                turned = turned | self.crosses_in_stage(&mut env);
            }
            let right: Vec<Real> = (0..n)
                .map(|i| {
                    let mut early: Option<Real> = None;
                    if let Some(df_dt) = df_dt[i].filter(|_| D[stage] != 0.0) {
                        early = Some(D[stage] * h * gh * df_dt);
                    }
                    for (weight, u) in W[stage].iter().zip(&u) {
                        let weight = GAMMA * weight;
                        early = Some(early.map_or(weight * u[i], |sum| u[i].fma(weight, sum)));
                    }
                    early.map_or(gh * f[i], |early| f[i].fma(gh, early))
                })
                .collect();
            u.push(factors.solve(&right));
        }
        let x1: Vec<Real> = x.iter().zip(&u[7]).map(|(x, u)| *x + *u).collect();
        self.store(self.trial.to().states, &x1);
        self.store(self.trial.error(), &u[7]);

        let combine = |weights: &[f64; STAGES], i: usize| {
            let first = u[0][i].constant(weights[0]) * u[0][i];
            (1..STAGES).fold(first, |sum, stage| u[stage][i].fma(weights[stage], sum))
        };
        let course: [Vec<Real>; 3] = H.map(|weights| (0..n).map(|i| combine(&weights, i)).collect());
        for (segment, k) in self.trial.course().into_iter().zip(&course) {
            self.store(segment, k);
        }
        let (f1, jacobian) = self.end(end, &x1, &rows);
        let mut met = Truth::from((false, self.build));
        let mut on_the_way: Vec<Vec<Real>> = Vec::new();
        if let Some(roots) = &self.program.roots {
            let surfaces = self.program.description.layout.roots;
            let between = |theta: f64| -> Vec<Real> {
                let at = |i: usize| {
                    let bend = course[0][i] + theta * (course[1][i] + theta * course[2][i]);
                    x0[i] + theta * (x1[i] - x0[i] + (1.0 - theta) * bend)
                };
                (0..n).map(at).collect()
            };
            let at = [(t + 0.5 * h, between(0.5), self.trial.middle()), (end, x1.clone(), self.trial.last())];
            let mut moving = Vec::new();
            for (time, x, segment) in at {
                let mut env = self.env(time, &x);
                self.build.borrow_mut().inline(roots, &mut env);
                let values: Vec<Real> = slots(surfaces).map(|slot| self.read(slot, &env)).collect();
                if moving.is_empty() {
                    let varies = self.varies(time, &[]);
                    let own = values.iter().zip(&self.program.description.roots);
                    moving = own.map(|(value, root)| varies[value.value.index()] && !root.observed).collect();
                }
                self.store(segment, &values);
                on_the_way.push(values);
            }
            let ends = [&on_the_way[0][..], &on_the_way[1][..]];
            met = turned
                | self.crosses(ends[0], ends[1])
                | self.may_cross_within_halves((t, h), [0.25, 0.75].map(between), &moving, ends);
        }
        self.keep(self.trial.met(), met.choose(1.0, t.constant(0.0)));

        // The permitted error of each state, and the largest ratio of either error measure to it.
        let tol = self.load(self.trial.tol());
        let scales = self.loads(self.trial.scales());
        let rate = 1.0 / h;
        let fastest = self.fastest(rate, &rows);
        let (mut worst, mut defect) = (h.constant(0.0), h.constant(0.0));
        let mut finite: Option<Real> = None;
        for i in 0..n {
            let (first, last) = (x0[i].abs(), x1[i].abs());
            let size = first.below(last).choose(last, first);
            let share = 1.0 / (tol * (size + scales[i]));
            let larger = |a: Real<'a>, b: Real<'a>| a.below(b).choose(b, a);
            worst = larger(worst, u[7][i].abs() * share);
            let slope = (x1[i] - x0[i] - course[0][i] - course[1][i] - course[2][i]) * rate;
            defect = larger(defect, (f1[i] - slope).abs() * share);
            finite = Some(finite.map_or(0.0 * x1[i], |sum| sum + 0.0 * x1[i]));
        }
        let defect = defect * (1.0 / fastest.sqrt());
        // 0 · x is NaN if x is not finite.
        let worst = finite.map_or(worst, |zero| worst + zero);
        self.keep(self.trial.worst(), worst);
        self.keep(self.trial.defect(), defect);
        let singular = factors.singular.unwrap_or_else(|| Truth::from((false, self.build)));
        let surfaces = on_the_way.last().map_or(&[][..], |last| last);
        let reached: Vec<Real> = scales
            .iter()
            .zip(&x1)
            .map(|(scale, x)| {
                let size = x.abs();
                scale.below(size).choose(size, *scale)
            })
            .collect();
        let point = Found { t, h, end, wanted, x: &x1, f: &f1, jacobian: &jacobian, surfaces, scales: &reached };
        let look = self.settle(point, worst, defect, met | hits, singular);
        (singular.value, look.value)
    }

    /// The step length: the wanted one, at most the largest permitted one. It is the distance to the stop if that is
    /// near, and half of it if the stop is less than two steps away.
    fn length(&self, t: Real<'a>) -> Length<'a> {
        let left = self.load(self.trial.stop()) - t;
        let (next, longest) = (self.load(self.trial.next()), self.load(self.trial.longest()));
        let wanted = next.below(longest).choose(next, longest);
        let hits = wanted.above(NEARLY * left);
        let half = HALFWAY * left;
        let h = hits.choose(left, wanted.above(half).choose(half, wanted));
        let end = hits.choose(self.load(self.trial.before_stop()), t + h);
        Length { wanted, h, end, hits }
    }

    /// Whether a stage evaluates the rates on the other side of a switching surface. A stiff step may end on the old
    /// side, although the condition for being there no longer holds.
    fn crosses_in_stage(&self, env: &mut Env) -> Truth<'a> {
        let mut turned = Truth::from((false, self.build));
        let Some(roots) = &self.program.roots else { return turned };
        self.build.borrow_mut().inline(roots, env);
        let layout = &self.program.description.layout;
        let sides = self.loads(self.trial.sides());
        let surfaces = slots(layout.roots).zip(sides).zip(&self.program.description.roots);
        for ((slot, side), _) in surfaces.filter(|(_, root)| !root.observed) {
            turned = turned | (side * self.read(slot, env)).below(0.0);
        }
        turned
    }

    /// Whether a switching surface is crossed in the middle or at the end, or possibly in between, where a parabola
    /// through the three values estimates how close to zero it comes.
    fn crosses(&self, middle: &[Real<'a>], last: &[Real<'a>]) -> Truth<'a> {
        let (sides, here) = (self.loads(self.trial.sides()), self.loads(self.trial.here()));
        let mut met = Truth::from((false, self.build));
        // Surfaces of observed quantities decide on no step; the observer checks each step itself.
        let surfaces = sides.into_iter().zip(here).zip(middle).zip(last).zip(&self.program.description.roots);
        for ((((side, a), b), c), _) in surfaces.filter(|(_, root)| !root.observed) {
            met = met | self.may_cross(side, [a, *b, *c]);
        }
        met
    }

    /// Whether a switching function with these equidistant values changes its sign, or may do so in between because the
    /// parabola through them comes close to zero. `side`: its sign at the start.
    fn may_cross(&self, side: Real<'a>, [a, b, c]: [Real<'a>; 3]) -> Truth<'a> {
        let stays = (side * b).above(0.0) & (side * c).above(0.0);
        // The parabola has its extremum at θ = rise / bend, with the value a − rise² / bend; the test avoids the
        // division.
        let (rise, bend) = (1.5 * a - 2.0 * b + 0.5 * c, 2.0 * (a - 2.0 * b + c));
        let steep = bend.abs();
        let inside = (rise * bend).above(0.0) & rise.abs().below(steep);
        let least = side * (a * steep - rise * rise.abs());
        let (size_a, size_b, size_c) = (a.abs(), b.abs(), c.abs());
        let smaller = size_a.below(size_b).choose(size_a, size_b);
        let near = 0.2 * smaller.below(size_c).choose(smaller, size_c);
        let turns = inside & least.below(near * steep);
        !stays | turns
    }

    /// The same test over both halves of the step, with the states at one quarter and three quarters, for surfaces that
    /// depend on time. A model at rest makes long steps, within which a short pulse can begin and end. `moving`: the
    /// surfaces that depend on time.
    fn may_cross_within_halves(
        &self,
        (t, h): (Real<'a>, Real<'a>),
        quarters: [Vec<Real<'a>>; 2],
        moving: &[bool],
        [middle, last]: [&[Real<'a>]; 2],
    ) -> Truth<'a> {
        let mut met = Truth::from((false, self.build));
        let Some(roots) = self.program.roots.as_ref().filter(|_| moving.contains(&true)) else { return met };
        let (sides, here) = (self.loads(self.trial.sides()), self.loads(self.trial.here()));
        let surfaces = self.program.description.layout.roots;
        let [early, late] = [0, 1].map(|k| {
            let mut env = self.env(t + [0.25, 0.75][k] * h, &quarters[k]);
            self.build.borrow_mut().inline(roots, &mut env);
            slots(surfaces).map(|slot| self.read(slot, &env)).collect::<Vec<Real>>()
        });
        for k in (0..moving.len()).filter(|k| moving[*k]) {
            let halves = [[here[k], early[k], middle[k]], [middle[k], late[k], last[k]]];
            met = halves.into_iter().fold(met, |met, half| met | self.may_cross(sides[k], half));
        }
        met
    }

    /// Accepts or rejects the trial, unless the caller must look at it, and returns whether it must. `met`: an accurate
    /// trial has an event. `singular`: the trial is invalid.
    fn settle(
        &self,
        found: Found<'_, 'a>,
        worst: Real<'a>,
        defect: Real<'a>,
        met: Truth<'a>,
        singular: Truth<'a>,
    ) -> Truth<'a> {
        let trial = self.trial;
        let Found { t, h, end, wanted, .. } = found;
        let below_one = !worst.above(1.0);
        let error = (below_one & worst.below(defect)).choose(defect, worst);
        let fine = !error.above(1.0);
        let accepted = self.load(trial.accepted()) + 1.0;

        // The next step length, by Gustafsson's predictive control.
        let error = error.below(LEAST_ERROR).choose(LEAST_ERROR, error);
        let inverse = self.inverse_fifth_root(error);
        let plain = SAFETY * inverse;
        let square = inverse * inverse;
        let (last_step, last_root) = (self.load(trial.last_step()), self.load(trial.last_root()));
        // The prediction extrapolates the trend of the error from step to step.
        let predicted = (SAFETY * (h / last_step) * last_root) * square;
        let part = (last_step.above(0.0) & predicted.below(plain)).choose(predicted, plain);
        let rejected = self.load(trial.rejected());
        let part = (rejected.above(0.0) & part.above(1.0)).choose(1.0, part);
        let part = part.below(LEAST_GAIN).choose(LEAST_GAIN, part);
        let part = part.above(GREATEST_GAIN).choose(GREATEST_GAIN, part);
        let longer = part * h;
        let longer = (h.below(wanted) & longer.below(wanted)).choose(wanted, longer);
        let root = error * (square * square);
        let root = root.below(LEAST_ROOT).choose(LEAST_ROOT, root);
        let less = plain.below(LEAST_GAIN).choose(LEAST_GAIN, plain);
        let shorter = less.above(MOST_REFUSED).choose(MOST_REFUSED, less) * h;
        let (behind, to_surface) = self.overrun(h, found.surfaces);
        let shorter = (behind & shorter.below(to_surface)).choose(to_surface, shorter);
        let next = fine.choose(longer, shorter);

        let outside = self.outside(end, found.x);
        self.keep(trial.outside(), outside.choose(1.0, t.constant(0.0)));
        let stop = self.load(trial.stop());
        let now = t + h;
        let least = LEAST_STEP * stop.abs();
        let again = behind & !rejected.below(MOST_OVERRUNS);
        let seen = singular
            | self.load(trial.attend()).above(0.0)
            | !error.finite()
            | next.below(least)
            | (fine & (met | outside | !now.below(self.load(trial.watched()))))
            | (fine & (stop - now).below(4.0 * least))
            | (!fine & again);
        let goes = fine & !seen;

        let (from, accepted_before, refused) = (trial.from(), self.load(trial.accepted()), self.load(trial.refused()));
        let varies = self.varies(end, found.x);
        let settled = |slot: Slot, new: Real<'a>| {
            let new = if varies[new.value.index()] { goes.choose(new, self.load(slot)) } else { new };
            self.keep(slot, new);
        };
        self.keep(trial.time(), goes.choose(now, t));
        self.keep(trial.last_step(), goes.choose(h, last_step));
        self.keep(trial.last_root(), goes.choose(root, last_root));
        self.keep(trial.accepted(), goes.choose(accepted, accepted_before));
        self.keep(trial.next(), seen.choose(self.load(trial.next()), next));
        self.keep(trial.rejected(), seen.choose(rejected, fine.choose(0.0, rejected + 1.0)));
        self.keep(trial.refused(), (fine | seen).choose(refused, refused + 1.0));
        let overruns = self.load(trial.overruns());
        self.keep(trial.overruns(), (fine | seen | !behind).choose(overruns, overruns + 1.0));
        let point = [(from.states, found.x), (from.derivatives, found.f), (from.jacobian, found.jacobian)];
        let others = [(trial.here(), found.surfaces), (trial.scales(), found.scales)];
        for (segment, new) in point.into_iter().chain(others) {
            slots(segment).zip(new).for_each(|(slot, new)| settled(slot, *new));
        }
        seen
    }

    /// Whether the step ends beyond a switching surface, and if so, the length of a step that ends before the first
    /// such surface: the crossing may be the reason why the error is too large.
    fn overrun(&self, h: Real<'a>, last: &[Real<'a>]) -> (Truth<'a>, Real<'a>) {
        let mut first = (Truth::from((false, self.build)), h.constant(MOST_BEFORE_SURFACE));
        let (sides, here) = (self.loads(self.trial.sides()), self.loads(self.trial.here()));
        let surfaces = sides.into_iter().zip(here).zip(last).zip(&self.program.description.roots);
        for (((side, a), b), _) in surfaces.filter(|(_, root)| !root.observed) {
            let behind = (side * *b).below(0.0);
            let part = a / (a - *b);
            first = (first.0 | behind, (behind & part.below(first.1)).choose(part, first.1));
        }
        (first.0, BEFORE_SURFACE * first.1 * h)
    }

    /// Whether a guard fails at the end of the step.
    fn outside(&self, end: Real<'a>, x: &[Real<'a>]) -> Truth<'a> {
        let guards = &self.program.description.guards;
        let mut env = self.env(end, x);
        let mut fine = Truth::from((true, self.build));
        if guards.iter().any(|guard| !self.program.description.layout.states.contains(guard.slot)) {
            let status = self.build.borrow_mut().inline(&self.program.outputs, &mut env);
            fine = status.map_or(fine, |status| Int::new(self.build, status).is(0));
        }
        let mut zero = end.constant(0.0);
        for ((guard, low), high) in guards.iter().zip(self.loads(self.trial.lows())).zip(self.loads(self.trial.highs()))
        {
            let value = self.read(guard.slot, &env);
            // 0 · value is NaN if the value is not finite, and so is the sum.
            zero = value.fma(0.0, zero);
            fine = fine & !value.below(low) & !value.above(high);
        }
        !(fine & zero.is(0.0))
    }

    /// x^(−1/5) of a positive number to four digits, by Newton's method from its exponent. There is no division,
    /// because the next step waits for the result. Equal to [`abi::rosenbrock::step_control::inverse_fifth_root`] to
    /// the bit.
    fn inverse_fifth_root(&self, x: Real<'a>) -> Real<'a> {
        let bits = x.bits();
        let mut fifth = bits.shift_right(3) + bits.shift_right(4);
        for n in [4, 8, 16] {
            fifth = fifth + fifth.shift_right(n);
        }
        let mut y = (Int::from((ROOT_CONSTANT, self.build)) - fifth).real_of_bits();
        for _ in 0..2 {
            let square = y * y;
            y = y * (1.2 - (0.2 * x * y) * (square * square));
        }
        y
    }

    /// State i at which a stage evaluates f. `last`: the states of the previous stage.
    fn argument(&self, stage: usize, i: usize, x0: &[Real<'a>], last: &[Real<'a>], u: &[Vec<Real<'a>>]) -> Real<'a> {
        if stage > 5 {
            return last[i] + u[stage - 1][i];
        }
        A[stage].iter().zip(u).fold(x0[i], |sum, (weight, u)| u[i].fma(*weight, sum))
    }

    /// The rows of ∂f/∂x at the start, and ∂f/∂t. Entries that depend on neither time nor states are computed; the
    /// others are loaded, because they were computed at the end of the previous step.
    fn jacobian(&self, t: Real<'a>, x: &[Real<'a>], from: Point) -> (Vec<Gradient>, Vec<Option<Real<'a>>>) {
        let n = x.len();
        let (_, gradients) = self.gradients(t, x);
        let varies = self.varies(t, x);
        let mut rows = Vec::new();
        let mut df_dt = Vec::new();
        for (i, gradient) in gradients.iter().enumerate() {
            let mut row = Gradient::new();
            let mut of_time = None;
            for (j, value) in gradient {
                let entry = if (*j as usize) < n { i * n + *j as usize } else { n * n + i };
                let loaded = || self.load(from.jacobian.slot(entry)).value;
                let value = if varies[value.index()] { loaded() } else { *value };
                match (*j as usize) < n {
                    true => row.push((*j, value)),
                    false => of_time = Some(Real::new(self.build, value)),
                }
            }
            rows.push(row);
            df_dt.push(of_time);
        }
        (rows, df_dt)
    }

    /// Stores f and the Jacobian at the end, and returns both.
    fn end(&self, t: Real<'a>, x: &[Real<'a>], at_start: &[Gradient]) -> (Vec<Real<'a>>, Vec<Real<'a>>) {
        let (n, to) = (x.len(), self.trial.to());
        let (f, gradients) = self.gradients(t, x);
        debug_assert_eq!(gradients.len(), at_start.len());
        self.store(to.derivatives, &f);
        let mut jacobian = vec![t.constant(0.0); n * n + n];
        for (i, gradient) in gradients.iter().enumerate() {
            for j in 0..=n {
                let entry = if j < n { i * n + j } else { n * n + i };
                jacobian[entry] = autodiff::entry(gradient, j as u32).map_or(jacobian[entry], |value| t.same(value));
            }
        }
        self.store(to.jacobian, &jacobian);
        (f, jacobian)
    }

    /// f, and for each state its derivatives along the states and, as the last direction, time.
    fn gradients(&self, t: Real<'a>, x: &[Real<'a>]) -> (Vec<Real<'a>>, Vec<Gradient>) {
        let layout = &self.program.description.layout;
        let mut env = self.env(t, x);
        let directions: Vec<Slot> = slots(layout.states).chain([Slot::TIME]).collect();
        let mut gradients = autodiff::inline(self.build, &self.program.derivatives, &mut env, &directions);
        let f = slots(layout.derivatives).map(|slot| self.read(slot, &env)).collect();
        (f, slots(layout.derivatives).map(|slot| gradients.remove(&slot).unwrap_or_default()).collect())
    }

    /// Variance: for each operation so far, whether it depends on time or states.
    fn varies(&self, t: Real<'a>, x: &[Real<'a>]) -> Vec<bool> {
        let build = self.build.borrow();
        let sources: HashSet<Value> = x.iter().map(|x| x.value).chain([t.value]).collect();
        let mut varies = vec![false; build.len()];
        for i in 0..build.len() {
            let value = Value(i as u32);
            let mut any = sources.contains(&value);
            build.get(value).each_operand(|operand| any |= varies[operand.index()]);
            varies[i] = any;
        }
        varies
    }

    /// The square of the highest frequency in the Jacobian: exact for a mass on a spring and for a decaying state.
    /// `rate`: 1/h, the least frequency to return.
    fn fastest(&self, rate: Real<'a>, rows: &[Gradient]) -> Real<'a> {
        let mut fastest = rate * rate;
        for (i, row) in rows.iter().enumerate() {
            for (j, entry) in row.iter().filter(|(j, _)| *j as usize <= i) {
                let Some(other) = autodiff::entry(&rows[*j as usize], i as u32) else { continue };
                let square = (rate.same(*entry) * rate.same(other)).abs();
                fastest = fastest.below(square).choose(square, fastest);
            }
        }
        fastest
    }

    fn env(&self, t: Real<'a>, x: &[Real<'a>]) -> Env {
        let states = slots(self.program.description.layout.states).zip(x).map(|(slot, x)| (slot, x.value));
        states.chain([(Slot::TIME, t.value)]).collect()
    }

    fn rates(&self, env: &mut Env) -> Vec<Real<'a>> {
        self.build.borrow_mut().inline(&self.program.derivatives, env);
        slots(self.program.description.layout.derivatives).map(|slot| self.read(slot, env)).collect()
    }

    fn read(&self, slot: Slot, env: &Env) -> Real<'a> {
        Real::new(self.build, self.build.borrow_mut().read(slot, env))
    }

    fn load(&self, slot: Slot) -> Real<'a> {
        Real::new(self.build, self.build.borrow_mut().load(slot))
    }

    fn loads(&self, segment: Segment) -> Vec<Real<'a>> {
        slots(segment).map(|slot| self.load(slot)).collect()
    }

    fn store(&self, segment: Segment, values: &[Real<'a>]) {
        slots(segment).zip(values).for_each(|(slot, value)| self.keep(slot, *value));
    }

    fn keep(&self, slot: Slot, value: Real<'a>) {
        self.build.borrow_mut().store(slot, value.value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codegen::jit::compile;
    use crate::experiment::{Changes, read};
    use crate::frontend::source::NoSources;
    use crate::ir::interpret::{Interpreter, run_once};
    use crate::ir::random::Random;
    use crate::math::expand;
    use abi::{Code, Function};
    use std::sync::Arc;

    const TEXT: &str = "
model Bristle {
  input  v [m/s]
  state  z [um] = 0
  let    g = 1 N + 0.5 N * exp(-(v / 1 mm/s)^2)
  dz/dt = v - 1e5 N/m * abs(v) / g * z
  output F [N] = 1e5 N/m * z + 316 N*s/m * dz/dt + 0.4 N*s/m * v
}
model Pull {
  param  m = 1 kg
  state  x [m]   = 0
  state  v [m/s] = 0
  part   fr = Bristle(v = v)
  dx/dt = v
  dv/dt = (2 N/m * (0.1 m/s * t - x) - fr.F) / m
}
model Pid {
  state  x [m]   = 0
  state  v [m/s] = 0
  state  i [N]   = 0
  let    u = 3 N/m * (1 m - x) + i - 6 N*s/m * v
  part   fr = Bristle(v = v)
  di/dt = 4 N/m/s * (1 m - x)
  dx/dt = v
  dv/dt = (clamp(u, -20 N, 20 N) - fr.F) / 1 kg
}
model Waves {
  param  w = 3 rad/s
  state  a = 1
  state  b = 0.5
  state  c = 0.25
  da/dt = (b * sin(w * t) - a * c) * 1 1/s
  db/dt = (if a > 0.7 then sqrt(1 + c^2) else tanh(b) - c / (2 + a^2)) * 1 1/s
  dc/dt = (exp(-a) - 40 * c + max(a, b)) * 1 1/s
}
experiment pull { run Pull() for 1 s }
experiment hunting { run Pid() for 1 s }
experiment waves { run Waves() for 1 s }
";

    fn program(name: &str) -> Program {
        let mut loaded = crate::load("test", TEXT, &NoSources);
        let read = read(&mut loaded, &NoSources, name, &Changes::default(), &mut Vec::new(), &mut |_| ());
        read.unwrap_or_else(|found| panic!("{found:?}")).remove(0).program
    }

    /// Evaluates a model at a point with its plain functions.
    struct Plain<'p> {
        program: &'p Program,
        derivatives: Func,
        jacobian: Func,
        block: Vec<f64>,
    }

    impl<'p> Plain<'p> {
        fn new(program: &'p Program) -> Plain<'p> {
            let layout = &program.description.layout;
            let mut block = vec![0.0; layout.size()];
            block[layout.params.range()].copy_from_slice(&program.params);
            let (derivatives, jacobian) = (expand(&program.derivatives), expand(&autodiff::jacobian(program)));
            Plain { program, derivatives, jacobian, block }
        }

        fn at(&mut self, func: fn(&Plain<'p>) -> Func, result: Segment, t: f64, x: &[f64]) -> Vec<f64> {
            self.block[Slot::TIME.index()] = t;
            self.block[self.program.description.layout.states.range()].copy_from_slice(x);
            let func = func(self);
            run_once(&func, &mut self.block, &self.program.description.pool);
            self.block[result.range()].to_vec()
        }

        fn f(&mut self, t: f64, x: &[f64]) -> Vec<f64> {
            self.at(|plain| plain.derivatives.clone(), self.program.description.layout.derivatives, t, x)
        }

        fn jacobian(&mut self, t: f64, x: &[f64]) -> Vec<f64> {
            self.at(|plain| plain.jacobian.clone(), self.program.description.layout.jacobian, t, x)
        }

        fn roots(&mut self, t: f64, x: &[f64]) -> Vec<f64> {
            let Some(roots) = self.program.roots.as_ref().map(expand) else { return Vec::new() };
            self.block[Slot::TIME.index()] = t;
            self.block[self.program.description.layout.states.range()].copy_from_slice(x);
            run_once(&roots, &mut self.block, &self.program.description.pool);
            self.block[self.program.description.layout.roots.range()].to_vec()
        }
    }

    /// The solution x of A x = b, by elimination with partial pivoting.
    fn solve(a: &[f64], b: &[f64]) -> Vec<f64> {
        let n = b.len();
        let mut rows: Vec<Vec<f64>> = (0..n).map(|i| [&a[i * n..(i + 1) * n], &[b[i]]].concat()).collect();
        for k in 0..n {
            let largest = (k..n).max_by(|i, j| rows[*i][k].abs().total_cmp(&rows[*j][k].abs())).unwrap();
            rows.swap(k, largest);
            for i in 0..n {
                if i != k {
                    let part = rows[i][k] / rows[k][k];
                    let pivot = rows[k].clone();
                    rows[i].iter_mut().zip(&pivot).for_each(|(entry, above)| *entry -= part * above);
                }
            }
        }
        (0..n).map(|k| rows[k][n] / rows[k][k]).collect()
    }

    /// u of every stage, by the formulas of the source.
    fn stages(plain: &mut Plain, t: f64, h: f64, end: f64, x0: &[f64]) -> Vec<Vec<f64>> {
        let n = x0.len();
        let jacobian = plain.jacobian(t, x0);
        let mut matrix: Vec<f64> = jacobian[..n * n].iter().map(|entry| -entry).collect();
        (0..n).for_each(|i| matrix[i * n + i] += 1.0 / (GAMMA * h));
        let mut u: Vec<Vec<f64>> = Vec::new();
        for stage in 0..STAGES {
            let weights = [&A[stage.min(5)][..], &[1.0, 1.0]].concat();
            let argument = |i: usize| weights.iter().zip(&u).map(|(weight, u)| weight * u[i]).sum::<f64>();
            let x: Vec<f64> = (0..n).map(|i| x0[i] + argument(i)).collect();
            let time = if stage < 5 { t + C[stage] * h } else { end };
            let f = plain.f(time, &x);
            let right = |i: usize| {
                let earlier: f64 = W[stage].iter().zip(&u).map(|(w, u)| w * u[i]).sum();
                f[i] + earlier / h + h * D[stage] * jacobian[n * n + i]
            };
            u.push(solve(&matrix, &(0..n).map(right).collect::<Vec<f64>>()));
        }
        u
    }

    #[test]
    fn a_step_agrees_with_the_formulas_of_the_method() {
        for name in ["pull", "hunting", "waves"] {
            let program = program(name);
            let layout = &program.description.layout;
            let n = layout.states.len as usize;
            let trial = Trial::of(layout).expect("few states");
            let func = pooled(&expand(&rosenbrock(&program).expect("few states")));
            let mut plain = Plain::new(&program);
            let mut random = Random(7);
            for case in 0..200 {
                let size = if name == "waves" { 1.0 } else { [1e-2, 1e-3, 1e-5][case % 3] };
                let x0: Vec<f64> = (0..n).map(|_| random.within(-size, size)).collect();
                let (t, h) = (random.within(0.0, 2.0), [1e-2, 1e-4, 1e-6][case % 3]);
                let (h, end) = ((t + h) - t, (t + h).next_down());
                let u = stages(&mut plain, t, h, end, &x0);
                let mut block = plain.block.clone();
                let set = |block: &mut Vec<f64>, slot: Slot, value| block[slot.index()] = value;
                set(&mut block, trial.time(), t);
                set(&mut block, trial.next(), h);
                set(&mut block, trial.longest(), 1.0);
                set(&mut block, trial.stop(), t + h);
                set(&mut block, trial.before_stop(), end);
                set(&mut block, trial.watched(), f64::INFINITY);
                set(&mut block, trial.tol(), 1e-6);
                set(&mut block, trial.attend(), 1.0);
                block[trial.scales().range()].fill(1.0);
                block[trial.from().states.range()].copy_from_slice(&x0);
                block[trial.from().derivatives.range()].copy_from_slice(&plain.f(t, &x0));
                block[trial.from().jacobian.range()].copy_from_slice(&plain.jacobian(t, &x0));
                let from = block[trial.from().whole().range()].to_vec();
                assert_eq!(run_once(&func, &mut block, &program.description.pool), LOOK, "{name} {case}");
                assert_eq!(block[trial.from().whole().range()], from[..], "{name} {case}: nothing is settled");
                assert_eq!((block[trial.step().index()], block[trial.end().index()]), (h, end), "{name} {case}");
                let found = |segment: Segment| &block[segment.range()];
                let x1 = found(trial.to().states).to_vec();
                let most = |i: usize| u.iter().map(|u| u[i].abs()).fold(1e-9 * x0[i].abs() + 1e-15, f64::max);
                let check = |what: &str, i: usize, found: f64, expected: f64| {
                    assert!(
                        (found - expected).abs() < 1e-8 * most(i),
                        "{name} {case}: {what} {i}: {found} and not {expected}"
                    );
                };
                for i in 0..n {
                    let argument: f64 = (0..5).map(|j| A[5][j] * u[j][i]).sum();
                    check("x1", i, x1[i], x0[i] + argument + u[5][i] + u[6][i] + u[7][i]);
                    check("error", i, found(trial.error())[i], u[7][i]);
                    for (k, segment) in trial.course().into_iter().enumerate() {
                        check("course", i, found(segment)[i], (0..STAGES).map(|j| H[k][j] * u[j][i]).sum());
                    }
                }
                // The values at the end are those of the final state, up to rounding.
                let near = |what: &str, found: &[f64], expected: &[f64]| {
                    for (a, b) in found.iter().zip(expected) {
                        assert!(
                            (a - b).abs() <= 1e-11 * (1.0 + a.abs().max(b.abs())),
                            "{name} {case}: {what} {found:?} and not {expected:?}"
                        );
                    }
                };
                let f1 = plain.f(end, &x1);
                near("slope", found(trial.to().derivatives), &f1);
                near("jacobian", found(trial.to().jacobian), &plain.jacobian(end, &x1));
                near("surfaces", found(trial.last()), &plain.roots(end, &x1));
                let [k1, k2, k3] = trial.course().map(|segment| found(segment).to_vec());
                let half = |i: usize| x0[i] + 0.5 * (x1[i] - x0[i] + 0.5 * (k1[i] + 0.5 * (k2[i] + 0.5 * k3[i])));
                let middle: Vec<f64> = (0..n).map(half).collect();
                near("surfaces in the middle", found(trial.middle()), &plain.roots(t + 0.5 * h, &middle));
                let allowed = |i: usize| 1e-6 * (x0[i].abs().max(x1[i].abs()) + 1.0);
                let worst = (0..n).map(|i| u[7][i].abs() / allowed(i)).fold(0.0, f64::max);
                let told = block[trial.worst().index()];
                assert!((told - worst).abs() <= 1e-6 * worst + 1e-9, "{name} {case}: {told} and not {worst}");
            }
        }
    }

    /// Interpreted and compiled code agree over many steps.
    #[test]
    fn steps_agree_to_the_bit() {
        let program = program("hunting");
        let layout = &program.description.layout;
        let trial = Trial::of(layout).expect("few states");
        let funcs = [(Function::Rosenbrock, pooled(&expand(&rosenbrock(&program).expect("few states"))))];
        let pool = &program.description.pool;
        let machine = Code::Machine(compile(&funcs, layout, pool.len()).expect("this processor can").0);
        let reference = Code::Interpreted(Arc::new(Interpreter::new(&funcs, layout, pool.len())));
        let mut plain = Plain::new(&program);
        let x0 = [1e-3, 2e-3, 0.1, 1e-6];
        let (f, jacobian) = (plain.f(0.0, &x0), plain.jacobian(0.0, &x0));
        let mut block = plain.block.clone();
        block[trial.tol().index()] = 1e-6;
        block[trial.scales().range()].fill(1.0);
        block[trial.from().states.range()].copy_from_slice(&x0);
        block[trial.from().derivatives.range()].copy_from_slice(&f);
        block[trial.from().jacobian.range()].copy_from_slice(&jacobian);
        let numbers = [
            (trial.next(), 1e-4),
            (trial.longest(), 0.1),
            (trial.stop(), 20.0),
            (trial.before_stop(), 20f64.next_down()),
        ];
        numbers.into_iter().for_each(|(slot, value)| block[slot.index()] = value);
        block[trial.watched().index()] = f64::INFINITY;
        block[trial.lows().range()].fill(f64::NEG_INFINITY);
        block[trial.highs().range()].fill(f64::INFINITY);
        let (mut settled, mut left) = (0.0, 0);
        for _ in 0..200 {
            let mut other = block.clone();
            let status = machine.call(Function::Rosenbrock, &mut block, pool, 7);
            assert_eq!(reference.call(Function::Rosenbrock, &mut other, pool, 7), status);
            for (slot, (a, b)) in block.iter().zip(&other).enumerate() {
                assert_eq!(a.to_bits(), b.to_bits(), "slot {slot} of {trial:?}: {a} and {b}");
            }
            // Trials that the function leaves to the caller are accepted or rejected here.
            settled = block[trial.accepted().index()];
            if status == 0 {
                continue;
            }
            left += 1;
            block[trial.accepted().index()] += 1.0;
            if block[trial.worst().index()].max(block[trial.defect().index()]) > 1.0 {
                block[trial.next().index()] = 0.3 * block[trial.step().index()];
            } else {
                block.copy_within(trial.to().whole().range(), trial.from().states.start as usize);
                block[trial.time().index()] = block[trial.end().index()];
                for ((last, here), side) in trial.last().range().zip(trial.here().range()).zip(trial.sides().range()) {
                    (block[here], block[side]) = (block[last], block[last].signum());
                }
            }
        }
        assert!(settled > 300.0 && left > 3, "{settled} settled, {left} left");
        assert!(block[trial.from().whole().range()].iter().all(|x| x.is_finite()));
    }
}
