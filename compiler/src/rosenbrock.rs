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

/// Operations of the derivatives, before functions are expanded, up to which a step is unrolled: it holds them eight times
/// and must pay for being compiled.
const MOST_OPERATIONS: usize = 400;

/// The step; none of a model whose layout has no room for it, or whose equations are many.
pub fn rosenbrock(program: &Program) -> Option<Func> {
    if program.derivatives.ops.len() > MOST_OPERATIONS {
        return None;
    }
    let trial = Trial::of(&program.description.layout)?;
    let build = Shared::new(Build::new("rosenbrock").with_pool(program.description.pool.clone()));
    let singular = Step { program, build: &build, trial }.build();
    let mut build = build.into_inner();
    let (one, zero) = (build.int(1), build.int(0));
    let status = build.select(singular, one, zero);
    build.status(status);
    // The model's equations stand in the order of the text: a contact that sticks holds by differences that are exactly
    // zero, which neither regrouping nor contraction would keep. What the method adds is contracted: its sums weigh
    // stages that are zero then.
    Some(build.finish())
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
            constants.extend(
                ops.iter().filter_map(|op| if let Op::Real(bits) = op { Some(f64::from_bits(*bits)) } else { None }),
            );
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
    build.finish_as(func, &values)
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
        A[stage].iter().zip(u).fold(x0[i], |sum, (weight, u)| u[i].fma(*weight, sum))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::interp::{Interpreter, run_once};
    use crate::backend::jit::compile;
    use crate::experiment::{Changes, read};
    use crate::ir::random::Random;
    use crate::math::expand;
    use crate::source::NoSources;
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

    /// The model at a point, by its plain functions.
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
            let (derivatives, jacobian) = (expand(&program.derivatives), expand(&derive::jacobian(program)));
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

    /// x of A x = b by elimination with the largest pivot.
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

    /// u of every stage, as the formulas of the method stand in its source.
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
    fn a_step_is_that_of_the_method() {
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
                let end = (t + h).next_down();
                let u = stages(&mut plain, t, h, end, &x0);
                let mut block = plain.block.clone();
                let set = |block: &mut Vec<f64>, slot: Slot, value| block[slot.index()] = value;
                set(&mut block, trial.time(), t);
                set(&mut block, trial.step(), h);
                set(&mut block, trial.end(), end);
                set(&mut block, trial.tol(), 1e-6);
                block[trial.scales().range()].fill(1.0);
                block[trial.from().states.range()].copy_from_slice(&x0);
                block[trial.from().derivatives.range()].copy_from_slice(&plain.f(t, &x0));
                block[trial.from().jacobian.range()].copy_from_slice(&plain.jacobian(t, &x0));
                assert_eq!(run_once(&func, &mut block, &program.description.pool), 0, "{name} {case}");
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
                // What holds at the end is that of the state found, up to rounding.
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

    /// Interpreted and as machine code, over many steps.
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
        for step in 0..500 {
            let t = 1e-4 * f64::from(step);
            for (slot, value) in [(trial.time(), t), (trial.step(), 1e-4), (trial.end(), t + 1e-4)] {
                block[slot.index()] = value;
            }
            let mut other = block.clone();
            assert_eq!(machine.call(Function::Rosenbrock, &mut block, pool, 1), 0);
            assert_eq!(reference.call(Function::Rosenbrock, &mut other, pool, 1), 0);
            for (slot, (a, b)) in block.iter().zip(&other).enumerate() {
                assert_eq!(a.to_bits(), b.to_bits(), "step {step}, slot {slot} of {trial:?}: {a} and {b}");
            }
            block.copy_within(trial.to().whole().range(), trial.from().states.start as usize);
        }
        assert!(block.iter().all(|x| x.is_finite()));
    }
}
