//! Which fixed steps are stable: the Jacobian of the compiled step itself, at points of the declared ranges.
//!
//! In: a program and a method. Out: the step up to which it is stable, or where it is not; and jumps that a fixed step
//! cannot settle on. A step is unstable where its map grows though the equations themselves do not: where d(step)/dx has
//! an eigenvalue outside the unit circle, and exp(h df/dx) has none. Regimes and inputs are those of the start. The work
//! is bounded by a number of operations, not by time, so that the answer is the same on every machine.

use crate::backend::interp::run_once;
use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::math::expand;
use crate::program::Program;
use crate::{derive, discretize};
use abi::Slot;
use abi::description::{Kind, Quantity};
use abi::plan::Method;

/// Operations that may be spent on one model and method.
const WORK: usize = 6_000_000;

/// Samples of one sign: from a millionth of a bound, four a decade, to the bound.
const SAMPLES: usize = 25;

/// What a state whose range is open is looked at up to, in its own unit.
const OPEN_BOUND: f64 = 10.0;

/// Growth a step that counts: less is lost beside what grows slowly by itself.
const GROWTH: f64 = 1.02;

/// A point at which a step is not stable.
#[derive(Clone, PartialEq, Debug)]
pub struct Unstable {
    /// The state that was moved away from the start.
    pub state: Quantity,
    /// It is stable up to this size of it, SI; 0: nowhere.
    pub limit: f64,
    /// Bound of the state that was looked at, SI, and whether it is declared.
    pub bound: f64,
    /// Whether the range of the state is closed.
    pub declared: bool,
    /// The largest step, in s, that is stable up to the bound.
    pub largest: f64,
    /// A method that is stable up to the bound with the same step.
    pub instead: Option<Method>,
}

/// Methods that are looked at. The derivative of `expo` and `implicit` is that of the branch taken, and at rest, where a
/// bristle is bent and |v| has its kink, it tells of growth that a step to either side does not have.
const EXPLICIT: [Method; 2] = [Method::Euler, Method::Rk4];

/// The first state along which steps of `h` seconds are not stable; of the explicit methods.
pub fn unstable(program: &Program, method: Method, h: f64) -> Option<Unstable> {
    if !EXPLICIT.contains(&method) {
        return None;
    }
    let mut map = Map::new(program, method)?;
    let n = program.description.layout.states.len as usize;
    let points = n * 2 * SAMPLES;
    if points * map.cost > WORK {
        return None;
    }
    let mut worst: Option<(usize, Unstable)> = None;
    for i in 0..n {
        let Some(state) = map.state(i).cloned() else { continue };
        let (bound, declared) = bound(&state);
        let Some((limit, value)) = map.first_unstable(i, bound, h) else { continue };
        let known = |(_, worst): &(usize, Unstable)| {
            worst.declared > declared || worst.declared == declared && worst.limit / worst.bound <= limit / bound
        };
        if worst.as_ref().is_some_and(known) {
            continue;
        }
        let largest = map.largest_step(i, bound.copysign(value), h);
        worst = Some((i, Unstable { state, limit, bound, declared, largest, instead: None }));
    }
    let (i, mut worst) = worst?;
    let steady = |method: &Method| {
        Map::new(program, *method).is_some_and(|mut map| map.first_unstable(i, worst.bound, h).is_none())
    };
    worst.instead = [Method::Expo, Method::Implicit].into_iter().find(steady);
    Some(worst)
}

/// The largest step between 1 ns and 1 s, in s to two digits, that is stable at the bounds of all ranges, of an explicit
/// method; none if that would take too long to find out, or none is.
pub fn largest(program: &Program, method: Method) -> Option<f64> {
    if !EXPLICIT.contains(&method) {
        return None;
    }
    let mut map = Map::new(program, method)?;
    let n = program.description.layout.states.len as usize;
    if (4 * n + 1) * 40 * map.cost > WORK {
        return None;
    }
    let mut points: Vec<Option<(usize, f64)>> = vec![None];
    for i in 0..n {
        let Some(state) = map.state(i) else { continue };
        let bound = bound(state).0;
        points.extend([1.0, -1.0, 1e-3, -1e-3].map(|part| Some((i, part * bound))));
    }
    let mut stable = |h: f64| points.iter().all(|moved| !map.grows(*moved, h));
    threshold(1.0, &mut stable)
}

/// Where the equations push towards a surface from both sides: a fixed step goes to and fro across it.
#[derive(Clone, PartialEq, Debug)]
pub struct Chatter {
    /// The condition as written.
    pub condition: String,
    /// A state that goes to and fro, and by how much a second of step: its rate on one side, SI.
    pub state: Quantity,
    /// In SI per second.
    pub rate: f64,
}

/// The first jump, at the start or beside it, that a fixed step cannot settle on.
pub fn chatter(program: &Program) -> Option<Chatter> {
    let layout = &program.description.layout;
    let n = layout.states.len as usize;
    let roots = program.roots.as_ref()?;
    let mut map = Map::new(program, Method::Euler)?;
    map.start();
    let (f, gradients) = (expand(&program.derivatives), expand(&slopes_of(roots, program)?));
    let start = map.block.clone();
    // g, dg/dt along the motion, and the motion.
    let at = |block: &mut Vec<f64>, k: usize| {
        run_once(&f, block, &program.description.pool);
        run_once(&gradients, block, &program.description.pool);
        let g = block[layout.roots.slot(k).index()];
        let slope =
            |j: usize| block[layout.jacobian.slot(k * n + j).index()] * block[layout.derivatives.slot(j).index()];
        (g, (0..n).map(slope).sum::<f64>())
    };
    for k in 0..program.description.roots.len().min(layout.jacobian.len as usize / n.max(1)) {
        for j in 0..n {
            let scale = map.state(j).map_or(1.0, |state| state.unit.scale);
            let beside = |size: f64| {
                let side = |by: f64| {
                    let mut block = start.clone();
                    block[layout.states.slot(j).index()] += by;
                    at(&mut block, k)
                };
                (side(size * scale), side(-size * scale))
            };
            let (plus, minus) = beside(1e-6);
            // A surface between the two, towards which both sides go.
            let towards = |a: (f64, f64), b: (f64, f64)| a.0 * b.0 < 0.0 && a.0 * a.1 < 0.0 && b.0 * b.1 < 0.0;
            let (nearer_plus, nearer_minus) = beside(1e-9);
            let jumps = |far: (f64, f64), near: (f64, f64)| near.1.abs() > 0.5 * far.1.abs();
            if towards(plus, minus)
                && towards(nearer_plus, nearer_minus)
                && jumps(plus, nearer_plus)
                && jumps(minus, nearer_minus)
            {
                let mut block = start.clone();
                block[layout.states.slot(j).index()] += 1e-6 * scale;
                at(&mut block, k);
                let rate = block[layout.derivatives.slot(j).index()].abs();
                let state = map.state(j)?.clone();
                return Some(Chatter { condition: program.description.roots[k].text.clone(), state, rate });
            }
        }
    }
    None
}

/// Writes the surfaces, and their derivatives along the states into the segment `jacobian`, as far as they fit there.
fn slopes_of(roots: &Func, program: &Program) -> Option<Func> {
    let layout = &program.description.layout;
    let n = layout.states.len as usize;
    let directions: Vec<Slot> = (0..n).map(|j| layout.states.slot(j)).collect();
    let build = Shared::new(Build::new("surfaces").with_pool(program.description.pool.clone()));
    let mut env = Env::new();
    let gradients = derive::inline(&build, roots, &mut env, &directions);
    let mut build = build.into_inner();
    build.store_env(&env, |slot| layout.roots.contains(slot));
    let fit = (layout.jacobian.len as usize).checked_div(n)?;
    for k in 0..fit.min(layout.roots.len as usize) {
        let gradient = gradients.get(&layout.roots.slot(k));
        for j in 0..n {
            let entry = gradient.and_then(|gradient| derive::entry(gradient, j as u32));
            let entry = entry.unwrap_or_else(|| build.real(0.0));
            build.store(layout.jacobian.slot(k * n + j), entry);
        }
    }
    Some(build.finish())
}

/// What a state is looked at up to, SI, and whether its range says so.
fn bound(state: &Quantity) -> (f64, bool) {
    let (low, high) = state.range;
    let declared = low.is_finite() && high.is_finite();
    (if declared { low.abs().max(high.abs()) } else { OPEN_BOUND * state.unit.scale }, declared)
}

/// The step of a method and the equations, with their derivatives along the states.
struct Map<'p> {
    program: &'p Program,
    start: Func,
    /// Writes d(step)/dx into the segment `jacobian`.
    step: Func,
    /// Writes df/dx there.
    rates: Func,
    block: Vec<f64>,
    /// Operations of one point.
    cost: usize,
}

impl<'p> Map<'p> {
    /// None of a model without states, with too many, or with something delayed: then these are not all its states.
    fn new(program: &'p Program, method: Method) -> Option<Map<'p>> {
        let layout = &program.description.layout;
        let n = layout.states.len as usize;
        if n == 0 || layout.jacobian.len == 0 || n > 20 || !program.description.delays.is_empty() {
            return None;
        }
        let directions: Vec<Slot> = (0..n).map(|j| layout.states.slot(j)).collect();
        let build = Shared::new(Build::new("growth").with_pool(program.description.pool.clone()));
        let gradients = derive::inline(&build, &discretize::step(program, method), &mut Env::new(), &directions);
        let mut build = build.into_inner();
        for i in 0..n {
            let gradient = gradients.get(&layout.states.slot(i));
            for j in 0..n {
                let entry = gradient.and_then(|gradient| derive::entry(gradient, j as u32));
                let entry = entry.unwrap_or_else(|| build.real(0.0));
                build.store(layout.jacobian.slot(i * n + j), entry);
            }
        }
        let step = expand(&build.finish());
        let rates = expand(&derive::jacobian(program));
        let mut block = vec![0.0; layout.size()];
        block[layout.params.range()].copy_from_slice(&program.params);
        // Twenty products of matrices for each of two spectral radii.
        let cost = step.ops.len() + rates.ops.len() + 60 * n * n * n;
        Some(Map { program, start: expand(&program.start), step, rates, block, cost })
    }

    fn state(&self, i: usize) -> Option<&'p Quantity> {
        let slot = self.program.description.layout.states.slot(i);
        self.program.description.quantities.iter().find(|q| q.kind == Kind::State && q.slot == slot)
    }

    fn run(&mut self, func: impl Fn(&Self) -> &Func) {
        let mut block = std::mem::take(&mut self.block);
        run_once(func(self), &mut block, &self.program.description.pool);
        self.block = block;
    }

    fn start(&mut self) {
        self.block[Slot::TIME.index()] = 0.0;
        self.block[Slot::COUNT.index()] = 0.0;
        self.run(|map| &map.start);
    }

    /// Whether a step of `h` grows where the equations do not; at the start, with one state moved there.
    fn grows(&mut self, moved: Option<(usize, f64)>, h: f64) -> bool {
        let layout = &self.program.description.layout;
        let n = layout.states.len as usize;
        self.block[Slot::STEP.index()] = h;
        self.start();
        if let Some((i, value)) = moved {
            self.block[layout.states.slot(i).index()] = value;
        }
        self.run(|map| &map.rates);
        let rates: Vec<f64> = self.block[layout.jacobian.range()][..n * n].iter().map(|entry| h * entry).collect();
        self.run(|map| &map.step);
        let step = self.block[layout.jacobian.range()][..n * n].to_vec();
        // Not a number: no comparison holds.
        radius(n, step) > GROWTH && radius(n, exponential(n, rates)) < 0.5 * (1.0 + GROWTH)
    }

    /// Up to which size of state i a step of `h` is stable, and a value at which it is not; none if it is up to `bound`.
    fn first_unstable(&mut self, i: usize, bound: f64, h: f64) -> Option<(f64, f64)> {
        let quarter = 1.778_279_410_038_922_8;
        for sign in [1.0, -1.0] {
            let mut size = 1e-6 * bound;
            let mut stable = 0.0;
            while size <= 1.001 * bound {
                if self.grows(Some((i, sign * size)), h) {
                    let found = size;
                    for _ in 0..12 {
                        let middle = 0.5 * (stable + size);
                        match self.grows(Some((i, sign * middle)), h) {
                            true => size = middle,
                            false => stable = middle,
                        }
                    }
                    return Some((stable, sign * found));
                }
                stable = size;
                size *= quarter;
            }
        }
        None
    }

    fn largest_step(&mut self, i: usize, value: f64, h: f64) -> f64 {
        threshold(h, &mut |h| !self.grows(Some((i, value)), h)).unwrap_or(0.0)
    }
}

/// The largest step up to `h`, in s, that is stable, to two digits; none if none is down to a nanosecond.
fn threshold(h: f64, stable: &mut dyn FnMut(f64) -> bool) -> Option<f64> {
    let mut low = h;
    while !stable(low) {
        low *= 0.5;
        if low < 1e-9 {
            return None;
        }
    }
    if low == h {
        return Some(h);
    }
    let mut high = 2.0 * low;
    for _ in 0..6 {
        let middle = 0.5 * (low + high);
        match stable(middle) {
            true => low = middle,
            false => high = middle,
        }
    }
    Some(low)
}

/// Largest magnitude of an eigenvalue, by squaring sixteen times: |A^(2^16)|^(2^−16).
fn radius(n: usize, mut a: Vec<f64>) -> f64 {
    let root = |x: f64, times: u32| (0..times).fold(x, |x, _| x.sqrt());
    let mut radius = 1.0;
    for k in 0..16 {
        let largest = a.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs()));
        if largest == 0.0 || a.iter().any(|entry| !entry.is_finite()) {
            return if largest == 0.0 { 0.0 } else { f64::NAN };
        }
        radius *= root(largest, k);
        a.iter_mut().for_each(|entry| *entry /= largest);
        a = product(n, &a, &a);
    }
    radius * root(a.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs())), 16)
}

/// e^A, by scaling and squaring.
fn exponential(n: usize, mut a: Vec<f64>) -> Vec<f64> {
    let norm = (0..n).map(|i| a[i * n..(i + 1) * n].iter().map(|entry| entry.abs()).sum::<f64>()).fold(0.0, f64::max);
    let mut squarings = 0;
    let mut scale = 1.0;
    while norm * scale > 0.5 && squarings < 60 {
        scale *= 0.5;
        squarings += 1;
    }
    a.iter_mut().for_each(|entry| *entry *= scale);
    let identity = |i: usize| f64::from(i / n == i % n);
    let mut sum: Vec<f64> = (0..n * n).map(identity).collect();
    for k in (1..=12).rev() {
        // I + A/k (…)
        sum =
            product(n, &a, &sum).into_iter().enumerate().map(|(i, entry)| identity(i) + entry / f64::from(k)).collect();
    }
    for _ in 0..squarings {
        sum = product(n, &sum, &sum);
    }
    sum
}

fn product(n: usize, a: &[f64], b: &[f64]) -> Vec<f64> {
    let entry = |at: usize| (0..n).map(|k| a[at / n * n + k] * b[k * n + at % n]).sum();
    (0..n * n).map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{Changes, read};
    use crate::source::NoSources;

    fn program(text: &str) -> Program {
        let mut loaded = crate::load("test", text, &NoSources);
        let read = read(&mut loaded, &NoSources, "e", &Changes::default(), &mut Vec::new(), &mut |_| ());
        read.unwrap_or_else(|found| panic!("{found:?}")).remove(0).program
    }

    /// A bristle with g = 1.5 N at rest and σ0 = 1e5 N/m: dz/dt = v − a z with a up to 1e5 |v| / 1 N.
    fn bristle(more: &str) -> Program {
        program(&format!(
            "model Coast {{\n  state v [m/s] = 0 {more}\n  state z [um] = 0\n  let g = 1 N + 0.5 N * exp(-(v / 1 mm/s)^2)\n  \
             dz/dt = v - 1e5 N/m * abs(v) / g * z\n  dv/dt = -(1e5 N/m * z + 316 N*s/m * dz/dt) / 1 kg\n}}\n\
             experiment e {{ run Coast() for 1 s }}\n"
        ))
    }

    #[test]
    fn spectral_radii_and_exponentials() {
        assert!((radius(2, vec![0.0, 2.0, -2.0, 0.0]) - 2.0).abs() < 1e-4);
        assert!(radius(2, vec![1.0, 1.0, 0.0, 1.0]) < 1.0005, "an integrator of an integrator");
        assert_eq!(radius(2, vec![0.0, 1.0, 0.0, 0.0]), 0.0);
        let turned = exponential(2, vec![0.0, -3.0, 3.0, 0.0]);
        assert!((turned[0] - 3f64.cos()).abs() < 1e-12 && (turned[2] - 3f64.sin()).abs() < 1e-12, "{turned:?}");
        assert!((exponential(1, vec![-1e4])[0]).abs() < 1e-9);
    }

    /// The manual's section 8.2: at 1 ms the bristle is stable for |v| < 2 g/(σ0 h) = 20 mm/s with euler.
    #[test]
    fn the_limits_of_a_bristle_are_those_of_the_manual() {
        let program = bristle("in -1 m/s .. 1 m/s");
        for (method, expected) in [(Method::Euler, 0.020), (Method::Rk4, 0.0278)] {
            let found = unstable(&program, method, 1e-3).unwrap();
            assert_eq!((found.state.path.as_str(), found.declared), ("v", true));
            // A mass is coupled to it, which moves the limit a little.
            assert!((found.limit / expected - 1.0).abs() < 0.25, "{}: {found:?}", method.name());
            assert!((found.largest / (1e-3 * expected) - 1.0).abs() < 0.25, "{}: {found:?}", method.name());
            assert!(unstable(&program, method, 0.9 * found.largest).is_none(), "{found:?}");
        }
        assert_eq!(unstable(&program, Method::Rk4, 1e-3).unwrap().instead, Some(Method::Expo));
        assert!(!unstable(&bristle(""), Method::Rk4, 1e-3).unwrap().declared);
    }

    #[test]
    fn what_grows_by_itself_is_no_fault_of_the_step() {
        let program =
            program("model Grow {\n  state x = 1\n  dx/dt = 3 1/s * x\n}\nexperiment e { run Grow() for 1 s }\n");
        assert_eq!(unstable(&program, Method::Euler, 1e-2), None);
        assert_eq!(largest(&program, Method::Euler), Some(1.0));
    }

    /// dx/dt = −50 x: euler up to 2/50, rk4 up to 2.785/50.
    #[test]
    fn the_largest_step_of_a_decay_is_known() {
        let program =
            program("model Decay {\n  state x = 1\n  dx/dt = -50 1/s * x\n}\nexperiment e { run Decay() for 1 s }\n");
        for (method, expected) in [(Method::Euler, 0.04), (Method::Rk4, 2.785 / 50.0)] {
            let found = largest(&program, method).unwrap();
            assert!((found / expected - 1.0).abs() < 0.03, "{}: {found}", method.name());
        }
    }

    #[test]
    fn a_sign_in_a_loop_chatters_and_a_bristle_does_not() {
        let program = program(
            "model Block {\n  state v [m/s] = 0\n  dv/dt = (0.5 N - 1 N * sign(v)) / 2 kg\n}\nexperiment e { run Block() for 1 s }\n",
        );
        let found = chatter(&program).unwrap();
        assert_eq!((found.condition.as_str(), found.state.path.as_str()), ("sign(v)", "v"));
        assert!((found.rate - 0.25).abs() < 1e-9, "{found:?}");
        assert_eq!(chatter(&bristle("")), None);
    }
}
