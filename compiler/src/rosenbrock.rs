//! One adaptive step, tried: the whole of Rodas5P around a model as one straight-line function.
//!
//! In: a [`Program`]. Out: a function over the segment [`Trial`]: from t, h and the states, derivatives and Jacobian at
//! the start, to the states, derivatives and Jacobian at the end, the course between, the estimated errors and the
//! switching surfaces on the way. So f and its derivatives at the end share what they have in common and serve the next
//! step; zeros and constants of the Jacobian are known, so that rows like dx/dt = v cost no division; and nothing goes
//! through memory between the stages. Chooses no step length and knows no event.

use crate::derive::{self, Gradient};
use crate::elimination::Matrix;
use crate::ir::build::{Build, Env};
use crate::ir::expr::{Real, Shared};
use crate::ir::{Func, Op, Unary, Value};
use crate::math::POOL;
use crate::opt::{contract, regroup};
use crate::program::Program;
use abi::Slot;
use abi::description::Segment;
use abi::rodas5p::{A, C, D, GAMMA, H, STAGES, W};
use abi::trial::{Point, Trial};
use std::collections::HashSet;
use std::sync::OnceLock;

/// A pivot smaller than this part of its row is too small: the digits that are left do for an error estimate, not for
/// more.
const LEAST_PIVOT: f64 = 1e-6;

/// The step; none of a model whose layout has no room for it.
pub fn rosenbrock(program: &Program) -> Option<Func> {
    let trial = Trial::of(&program.description.layout)?;
    let build = Shared::new(Build::new("rosenbrock").with_pool(program.description.pool.clone()));
    let singular = Step { program, build: &build, trial }.build();
    let mut build = build.into_inner();
    let (one, zero) = (build.int(1), build.int(0));
    let status = build.select(singular, one, zero);
    build.status(status);
    let func = build.finish();
    let varying: HashSet<Slot> = slots(trial.from().whole()).collect();
    let results = slots(trial.to().whole()).chain([trial.worst(), trial.defect()]).collect();
    Some(contract::contract(&regroup::between(&func, &varying, &results)))
}

fn slots(segment: Segment) -> impl Iterator<Item = Slot> {
    segment.range().map(|slot| Slot(slot as u32))
}

/// Constants of this function, to stand in the pool behind those of the elementary functions: it has too many for the
/// registers, and in memory they are operands.
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
            constants.extend(ops.iter().filter_map(|op| if let Op::Real(bits) = op { Some(f64::from_bits(*bits)) } else { None }));
        }
        // By size, each once; NaN is no constant of a formula.
        constants.retain(|x| !x.is_nan());
        constants.sort_by(f64::total_cmp);
        constants.dedup_by_key(|x| x.to_bits());
        constants
    })
}

/// The expanded function with those constants read from the pool.
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
    for (slot, value) in &func.stores {
        build.store(*slot, values[value.index()]);
    }
    if let Some(status) = func.status {
        build.status(values[status.index()]);
    }
    build.finish()
}

struct Step<'a> {
    program: &'a Program,
    build: &'a Shared,
    trial: Trial,
}

impl<'a> Step<'a> {
    /// Appends and stores everything; gives whether a pivot is too small.
    fn build(self) -> Value {
        let n = self.program.description.layout.states.len as usize;
        let (t, h, end) = (self.load(self.trial.time()), self.load(self.trial.step()), self.load(self.trial.end()));
        let from = self.trial.from();
        let (x0, f0) = (self.loads(from.states), self.loads(from.derivatives));
        let (rows, df_dt) = self.jacobian(t, &x0, from);
        let gh = GAMMA * h;
        let factors = Matrix::identity_less(gh, &rows).factorise(LEAST_PIVOT);

        // (I − γhJ) u = γh (f + h d ∂f/∂t) + γ Σ W u
        let mut u: Vec<Vec<Real>> = Vec::new();
        let mut x = x0.clone();
        let mut f = f0;
        for stage in 0..STAGES {
            if stage > 0 {
                x = (0..n).map(|i| self.argument(stage, i, &x0, &x, &u)).collect();
                let time = if stage < 5 { t + C[stage] * h } else { end };
                let mut env = self.env(time, &x);
                f = self.rates(&mut env);
            }
            let right: Vec<Real> = (0..n)
                .map(|i| {
                    let mut early: Option<Real> = None;
                    if let Some(df_dt) = df_dt[i].filter(|_| D[stage] != 0.0) {
                        early = Some(D[stage] * h * gh * df_dt);
                    }
                    for (weight, u) in W[stage].iter().zip(&u) {
                        let weight = u[i].constant(GAMMA * weight);
                        early = Some(early.map_or(weight * u[i], |sum| sum + weight * u[i]));
                    }
                    let late = gh * f[i];
                    early.map_or(late, |early| early + late)
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
        let f1 = self.end(end, &x1, &rows);
        if let Some(roots) = &self.program.roots {
            let surfaces = self.program.description.layout.roots;
            let half = |i: usize| {
                let bend = course[0][i] + 0.5 * (course[1][i] + 0.5 * course[2][i]);
                x0[i] + 0.5 * (x1[i] - x0[i] + 0.5 * bend)
            };
            let middle: Vec<Real> = (0..n).map(half).collect();
            let at = [(t + 0.5 * h, middle, self.trial.middle()), (end, x1.clone(), self.trial.last())];
            for (time, x, segment) in at {
                let mut env = self.env(time, &x);
                self.build.borrow_mut().inline(roots, &mut env);
                let values: Vec<Real> = surfaces.range().map(|slot| self.read(Slot(slot as u32), &env)).collect();
                self.store(segment, &values);
            }
        }

        // What is allowed to each state, and how much of it the two measures of the error take.
        let tol = self.load(self.trial.tol());
        let scales = self.loads(self.trial.scales());
        let fastest = self.fastest(h, &rows);
        let (mut worst, mut defect) = (h.constant(0.0), h.constant(0.0));
        let mut finite: Option<Real> = None;
        for i in 0..n {
            let (first, last) = (x0[i].abs(), x1[i].abs());
            let size = first.below(last).choose(last, first);
            let share = 1.0 / (tol * (size + scales[i]));
            let larger = |a: Real<'a>, b: Real<'a>| a.below(b).choose(b, a);
            worst = larger(worst, u[7][i].abs() * share);
            let slope = (x1[i] - x0[i] - course[0][i] - course[1][i] - course[2][i]) / h;
            defect = larger(defect, (f1[i] - slope).abs() * share);
            finite = Some(finite.map_or(0.0 * x1[i], |sum| sum + 0.0 * x1[i]));
        }
        let defect = defect * (1.0 / fastest.sqrt());
        // Zero times what is not finite is NaN.
        let worst = finite.map_or(worst, |zero| worst + zero);
        let mut build = self.build.borrow_mut();
        build.store(self.trial.worst(), worst.value);
        build.store(self.trial.defect(), defect.value);
        factors.singular.map_or_else(|| build.truth(false), |singular| singular.value)
    }

    /// State i at which a stage evaluates f; `last` is that of the stage before.
    fn argument(&self, stage: usize, i: usize, x0: &[Real<'a>], last: &[Real<'a>], u: &[Vec<Real<'a>>]) -> Real<'a> {
        if stage > 5 {
            return last[i] + u[stage - 1][i];
        }
        A[stage].iter().zip(u).fold(x0[i], |sum, (weight, u)| sum + *weight * u[i])
    }

    /// Rows of ∂f/∂x at the start, and ∂f/∂t. What depends on neither time nor states is computed, what does is loaded:
    /// it was computed as the end of the step before.
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

    /// Stores f and the Jacobian at the end; gives f.
    fn end(&self, t: Real<'a>, x: &[Real<'a>], at_start: &[Gradient]) -> Vec<Real<'a>> {
        let (n, to) = (x.len(), self.trial.to());
        let (f, gradients) = self.gradients(t, x);
        debug_assert_eq!(gradients.len(), at_start.len());
        self.store(to.derivatives, &f);
        for (i, gradient) in gradients.iter().enumerate() {
            for j in 0..=n {
                let value = derive::entry(gradient, j as u32).unwrap_or_else(|| self.build.borrow_mut().real(0.0));
                let entry = if j < n { i * n + j } else { n * n + i };
                self.build.borrow_mut().store(to.jacobian.slot(entry), value);
            }
        }
        f
    }

    /// f, and for each state its derivatives along the states and, as the last direction, time.
    fn gradients(&self, t: Real<'a>, x: &[Real<'a>]) -> (Vec<Real<'a>>, Vec<Gradient>) {
        let layout = &self.program.description.layout;
        let mut env = self.env(t, x);
        let directions: Vec<Slot> = slots(layout.states).chain([Slot::TIME]).collect();
        let mut gradients = derive::inline(self.build, &self.program.derivatives, &mut env, &directions);
        let f = slots(layout.derivatives).map(|slot| self.read(slot, &env)).collect();
        (f, slots(layout.derivatives).map(|slot| gradients.remove(&slot).unwrap_or_default()).collect())
    }

    /// For each operation so far, whether it depends on time or states.
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

    /// The square of the fastest frequency that the Jacobian knows: exact for a mass on a spring, and for what decays.
    fn fastest(&self, h: Real<'a>, rows: &[Gradient]) -> Real<'a> {
        let mut fastest = 1.0 / (h * h);
        for (i, row) in rows.iter().enumerate() {
            for (j, entry) in row.iter().filter(|(j, _)| *j as usize <= i) {
                let Some(other) = derive::entry(&rows[*j as usize], i as u32) else { continue };
                let square = (h.same(*entry) * h.same(other)).abs();
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
        for (slot, value) in slots(segment).zip(values) {
            self.build.borrow_mut().store(slot, value.value);
        }
    }
}
