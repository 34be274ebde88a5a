//! Automatic differentiation, forward mode, as a program transformation.
//!
//! In: a function, before elementary functions are expanded, and the slots along which to differentiate. Out: its
//! values and their derivatives, as operations. Gradients are sparse: a direction that a value does not depend on has
//! no entry, so the sparsity of a Jacobian results from the transformation, and its zeros cost no operation. The
//! derivative of abs, min, max, clamp and `if` is that of the selected branch. The derivative of sign, floor, integers
//! and table indices is 0.
//!
//! Source: Griewank, Walther, *Evaluating Derivatives*, 2008, ch. 3 and 7.

use crate::functions::Term;
use crate::ir::build::{Build, Env};
use crate::ir::expr::{Real, Shared};
use crate::ir::hash::HashMap;
use crate::ir::program::Program;
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// Sparse gradient: the derivatives of a value along the directions it depends on, ascending by direction.
pub type Gradient = Vec<(u32, Value)>;

/// Inlines `func` on `env` as [`Build::inline`] does, and returns the gradient of each value that it stores. Direction
/// k is the slot `directions[k]`; all other slots are constant.
pub fn inline(build: &Shared, func: &Func, env: &mut Env, directions: &[Slot]) -> HashMap<Slot, Gradient> {
    inline_given(build, func, env, directions, &HashMap::default())
}

/// Like [`inline`], but a staircase counts as the line through it: the derivative of floor and of rounding is 1, so an
/// encoder passes on how its position moves. `met`: set if such a derivative was taken.
pub fn inline_smoothed(
    build: &Shared,
    func: &Func,
    env: &mut Env,
    directions: &[Slot],
    met: &mut bool,
) -> HashMap<Slot, Gradient> {
    differentiate(build, func, env, directions, &HashMap::default(), Some(met))
}

/// Like [`inline`], but the values of `func` in `given` are replaced and count as constant.
pub fn inline_given(
    build: &Shared,
    func: &Func,
    env: &mut Env,
    directions: &[Slot],
    given: &HashMap<Value, Value>,
) -> HashMap<Slot, Gradient> {
    differentiate(build, func, env, directions, given, None)
}

/// `smoothed`: staircases have the derivative 1 if it is given; it tells whether there was one.
fn differentiate(
    build: &Shared,
    func: &Func,
    env: &mut Env,
    directions: &[Slot],
    given: &HashMap<Value, Value>,
    mut smoothed: Option<&mut bool>,
) -> HashMap<Slot, Gradient> {
    let direction: HashMap<Slot, u32> = directions.iter().enumerate().map(|(k, slot)| (*slot, k as u32)).collect();
    let live = func.live();
    let none = Value(u32::MAX);
    let mut values = vec![none; func.ops.len()];
    let mut gradients: Vec<Gradient> = vec![Gradient::new(); func.ops.len()];
    let last = last_uses(func);
    for (i, op) in func.ops.iter().enumerate().filter(|(i, _)| live[*i]) {
        if let Op::Load(slot) = op {
            values[i] = build.borrow_mut().read(*slot, env);
            if let Some(k) = direction.get(slot) {
                gradients[i] = vec![(*k, build.borrow_mut().real(1.0))];
            }
            continue;
        }
        if let Some(value) = given.get(&Value(i as u32)) {
            values[i] = *value;
            continue;
        }
        let op = op.map(|operand| values[operand.index()]);
        values[i] = build.borrow_mut().op(op);
        let of = |k: usize| {
            let mut operands = Vec::new();
            func.ops[i].each_operand(|operand| operands.push(operand));
            &gradients[operands[k].index()]
        };
        gradients[i] = match (&mut smoothed, op) {
            (Some(met), Op::Floor(_) | Op::Nearest(_)) => {
                **met |= !of(0).is_empty();
                of(0).clone()
            }
            _ => gradient(build, op, values[i], &of),
        };
        // Frees gradients that have no further use: on a sum over a thousand parts, they would have half a million
        // entries.
        func.ops[i].each_operand(|operand| {
            if last[operand.index()] == i {
                gradients[operand.index()] = Gradient::new();
            }
        });
    }
    let mut of_slots = HashMap::default();
    for (slot, value) in &func.stores {
        env.insert(*slot, values[value.index()]);
        of_slots.insert(*slot, gradients[value.index()].clone());
    }
    of_slots
}

/// For each operation, the index of the last operation that uses its value; the number of operations if it is stored.
fn last_uses(func: &Func) -> Vec<usize> {
    let mut last = vec![0; func.ops.len()];
    for (i, op) in func.ops.iter().enumerate() {
        op.each_operand(|operand| last[operand.index()] = i);
    }
    for (_, value) in &func.stores {
        last[value.index()] = func.ops.len();
    }
    last
}

/// The sparsity pattern of the Jacobian: pairs (row, direction), where row r is the stored slot `rows[r]`. `None` if
/// there are more than `most` pairs.
pub fn coupling(func: &Func, rows: &[Slot], directions: &[Slot], most: usize) -> Option<Vec<(u32, u32)>> {
    let direction: HashMap<Slot, u32> = directions.iter().enumerate().map(|(k, slot)| (*slot, k as u32)).collect();
    let live = func.live();
    let last = last_uses(func);
    let mut depends: Vec<Vec<u32>> = vec![Vec::new(); func.ops.len()];
    for (i, op) in func.ops.iter().enumerate().filter(|(i, _)| live[*i]) {
        let mut mine: Vec<u32> = Vec::new();
        if let Op::Load(slot) = op {
            mine.extend(direction.get(slot));
        } else {
            let mut operands = Vec::new();
            op.each_operand(|operand| operands.push(operand.index()));
            for operand in operands {
                let taken = match last[operand] == i {
                    true => std::mem::take(&mut depends[operand]),
                    false => depends[operand].clone(),
                };
                mine = if mine.is_empty() { taken } else { union(&mine, &taken) };
            }
        }
        depends[i] = mine;
    }
    let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
    let mut entries = Vec::new();
    for (row, slot) in rows.iter().enumerate() {
        if let Some(value) = stored.get(slot) {
            entries.extend(depends[value.index()].iter().map(|column| (row as u32, *column)));
        }
        if entries.len() > most {
            return None;
        }
    }
    Some(entries)
}

/// Union of two ascending lists, ascending.
fn union(a: &[u32], b: &[u32]) -> Vec<u32> {
    let (mut i, mut j) = (0, 0);
    let mut out = Vec::with_capacity(a.len() + b.len());
    while i < a.len() && j < b.len() {
        let (x, y) = (a[i], b[j]);
        out.push(x.min(y));
        i += usize::from(x <= y);
        j += usize::from(y <= x);
    }
    out.extend_from_slice(&a[i..]);
    out.extend_from_slice(&b[j..]);
    out
}

/// The function that writes ∂f/∂x and ∂f/∂t of dx/dt = f(t, x) to the segment `jacobian`. It writes all entries of
/// ∂f/∂x, or only those of the coupling if the model has one.
pub fn jacobian(program: &Program) -> Func {
    let layout = &program.description.layout;
    let coupling = &program.description.coupling;
    let n = layout.states.len as usize;
    let entries = if coupling.is_empty() { n * n } else { coupling.len() };
    assert_eq!(layout.jacobian.len as usize, entries + n, "room for the Jacobian of {n} states");
    let delays = &program.description.delays;
    let states = (0..n).map(|j| layout.states.slot(j));
    let directions: Vec<Slot> = states.chain([Slot::TIME]).chain(delays.iter().map(|delay| delay.past)).collect();
    let build = Shared::new(Build::new("jacobian"));
    let of_slots = inline(&build, &program.derivatives, &mut Env::default(), &directions);
    let mut build = build.into_inner();
    let mut next = 0;
    for i in 0..n {
        let gradient = of_slots.get(&layout.derivatives.slot(i));
        let written = coupling[next.min(coupling.len())..].iter().take_while(|(row, _)| *row as usize == i);
        let columns: Vec<usize> =
            if coupling.is_empty() { (0..n).collect() } else { written.map(|(_, column)| *column as usize).collect() };
        for j in columns.into_iter().chain([n]) {
            let entry = gradient.and_then(|gradient| entry(gradient, j as u32));
            let mut entry = entry.unwrap_or_else(|| build.real(0.0));
            // A delayed value depends on time too, with the slope of its samples.
            for (k, delay) in delays.iter().enumerate().filter(|_| j == n) {
                if let Some(d) = gradient.and_then(|gradient| self::entry(gradient, (n + 1 + k) as u32)) {
                    let slope = build.load(delay.slope);
                    let part = build.mul(d, slope);
                    entry = build.add(entry, part);
                }
            }
            let at = if j < n { next } else { entries + i };
            next += usize::from(j < n);
            build.store(layout.jacobian.slot(at), entry);
        }
    }
    assert_eq!(next, entries, "every entry is written");
    build.finish()
}

/// The derivative along one direction; `None` if it is 0.
pub fn entry(gradient: &Gradient, direction: u32) -> Option<Value> {
    gradient.binary_search_by_key(&direction, |(k, _)| *k).ok().map(|at| gradient[at].1)
}

/// The gradient of the result `y` of `op`. `of(k)`: the gradient of operand k.
fn gradient<'a, 'g>(build: &'a Shared, op: Op, y: Value, of: &dyn Fn(usize) -> &'g Gradient) -> Gradient {
    let at = |value| Real::new(build, value);
    let y = at(y);
    // y = y(a): dy = factor · da
    let chain = |factor: &dyn Fn() -> Real<'a>| scale(build, of(0), factor);
    // y = y(a, b): dy = factors.0 · da + factors.1 · db
    let both = |of_a: &dyn Fn() -> Real<'a>, of_b: &dyn Fn() -> Real<'a>| {
        let (a, b) = (scale(build, of(0), of_a), scale(build, of(1), of_b));
        merge(&a, &b, |a, b| Some(sum(build, a, b)))
    };
    match op {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } => Gradient::new(),
        Op::Add(..) => merge(of(0), of(1), |a, b| Some(sum(build, a, b))),
        Op::Sub(..) => merge(of(0), of(1), |a, b| {
            let a = a.map(at);
            let b = b.map(at);
            Some(match (a, b) {
                (Some(a), Some(b)) => (a - b).value,
                (Some(a), None) => a.value,
                (None, Some(b)) => (-b).value,
                (None, None) => return None,
            })
        }),
        // 0 · x is 0 for every finite x.
        Op::Mul(a, b) if [a, b].iter().any(|v| build.borrow().constant(*v) == Some(0.0)) => Gradient::new(),
        Op::Mul(a, b) => both(&|| at(b), &|| at(a)),
        Op::Div(_, b) => {
            let rest = scale(build, of(1), &|| -y);
            let numerator = merge(of(0), &rest, |a, b| Some(sum(build, a, b)));
            numerator.into_iter().map(|(k, d)| (k, (at(d) / at(b)).value)).collect()
        }
        Op::Neg(_) => of(0).iter().map(|(k, d)| (*k, (-at(*d)).value)).collect(),
        Op::Abs(a) => of(0).iter().map(|(k, d)| (*k, at(a).below(0.0).choose(-at(*d), at(*d)).value)).collect(),
        // At 0 the slope is infinite; 0 is used instead, so that derivatives stay finite.
        Op::Sqrt(_) => chain(&|| y.above(0.0).choose(0.5 / y, 0.0)),
        Op::Fma(a, b, _) => {
            let product = both(&|| at(b), &|| at(a));
            merge(&product, of(2), |a, b| Some(sum(build, a, b)))
        }
        Op::Floor(_) | Op::Nearest(_) => Gradient::new(),
        Op::Unary(function, a) => chain(&|| formula(function.row().derivative, at(a), at(a), y)),
        Op::Binary(function, a, b) => {
            let [of_a, of_b] = function.row().derivatives;
            both(&|| formula(of_a, at(a), at(b), y), &|| formula(of_b, at(a), at(b), y))
        }
        Op::Select(condition, ..) => merge(of(1), of(2), |a, b| {
            let mut build = build.borrow_mut();
            let zero = build.real(0.0);
            Some(build.select(condition, a.unwrap_or(zero), b.unwrap_or(zero)))
        }),
        Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) | Op::And(..) | Op::Or(..) | Op::Not(_) => Gradient::new(),
        Op::IntAdd(..) | Op::IntSub(..) | Op::IntMul(..) | Op::IntAnd(..) | Op::IntOr(..) | Op::IntXor(..) => {
            Gradient::new()
        }
        Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => Gradient::new(),
        Op::IntLess(..) | Op::IntEqual(..) => Gradient::new(),
        Op::ToBits(_) | Op::FromBits(_) | Op::ToInt(_) | Op::ToReal(_) => Gradient::new(),
    }
}

/// A term of a derivative, for f = f(x, y).
fn formula<'a>(term: &Term, x: Real<'a>, y: Real<'a>, f: Real<'a>) -> Real<'a> {
    let part = |term: &Term| formula(term, x, y, f);
    match *term {
        Term::X => x,
        Term::Y => y,
        Term::F => f,
        Term::Number(number) => x.constant(number),
        Term::Negate(a) => -part(a),
        Term::Sum(a, b) => part(a) + part(b),
        Term::Difference(a, b) => part(a) - part(b),
        Term::Product(a, b) => part(a) * part(b),
        Term::Quotient(&Term::Number(a), b) => a / part(b),
        Term::Quotient(a, b) => part(a) / part(b),
        Term::Fused(a, b, c) => part(a).fma(part(b), part(c)),
        Term::Root(a) => part(a).sqrt(),
        Term::Call(function, a) => part(a).of(function),
        Term::IfPositive(a, b, c) => part(a).above(0.0).choose(part(b), part(c)),
        Term::IfEqual(a, number, b, c) => part(a).is(number).choose(part(b), part(c)),
    }
}

/// Multiplies each derivative by a factor, which is only computed if there is a derivative.
fn scale<'a>(build: &'a Shared, gradient: &Gradient, factor: &dyn Fn() -> Real<'a>) -> Gradient {
    if gradient.is_empty() {
        return Gradient::new();
    }
    let factor = factor();
    gradient.iter().map(|(k, d)| (*k, (factor * Real::new(build, *d)).value)).collect()
}

fn sum(build: &Shared, a: Option<Value>, b: Option<Value>) -> Value {
    match (a, b) {
        (Some(a), Some(b)) => build.borrow_mut().add(a, b),
        (Some(one), None) | (None, Some(one)) => one,
        (None, None) => unreachable!("a direction of neither"),
    }
}

/// Combines two gradients direction by direction.
fn merge(a: &Gradient, b: &Gradient, mut join: impl FnMut(Option<Value>, Option<Value>) -> Option<Value>) -> Gradient {
    let (mut i, mut j) = (0, 0);
    let mut merged = Gradient::with_capacity(a.len().max(b.len()));
    while i < a.len() || j < b.len() {
        let direction = a.get(i).map_or(u32::MAX, |(k, _)| *k).min(b.get(j).map_or(u32::MAX, |(k, _)| *k));
        let take = |list: &Gradient, at: &mut usize| {
            let (k, value) = list.get(*at)?;
            (*k == direction).then(|| {
                *at += 1;
                *value
            })
        };
        let (of_a, of_b) = (take(a, &mut i), take(b, &mut j));
        merged.extend(join(of_a, of_b).map(|value| (direction, value)));
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::functions::{Binary, Domain, Unary};
    use crate::ir::interpret::run_once;
    use crate::ir::random::Random;
    use crate::math::{POOL, expand};
    use abi::{Description, Layout};

    /// The program dx/dt = f(t, x) with n states, and room for its Jacobian.
    fn program(n: u32, f: impl FnOnce(&mut Build, &Layout)) -> Program {
        let layout = Layout::new([0, 0, n, 0, 0, 0, n, 0, n * n + n, 0]);
        let mut build = Build::new("derivatives");
        f(&mut build, &layout);
        let description = Description { layout, ..Description::default() };
        Program { description, derivatives: build.finish(), ..Program::default() }
    }

    /// Compares every entry of the Jacobian with central differences, at random points between the bounds.
    #[track_caller]
    fn check(program: &Program, bounds: (f64, f64), tolerance: f64) {
        let layout = &program.description.layout;
        let n = layout.states.len as usize;
        let (f, df) = (expand(&program.derivatives), expand(&jacobian(program)));
        let mut random = Random(11);
        for _ in 0..200 {
            let mut block = vec![0.0; layout.size()];
            block[0] = random.within(bounds.0, bounds.1);
            for slot in layout.states.range() {
                block[slot] = random.within(bounds.0, bounds.1);
            }
            let mut at = block.clone();
            run_once(&df, &mut at, &POOL);
            for (j, slot) in layout.states.range().chain([0]).enumerate() {
                let h = 1e-5;
                let [plus, minus] = [h, -h].map(|h| {
                    let mut moved = block.clone();
                    moved[slot] += h;
                    run_once(&f, &mut moved, &POOL);
                    moved[layout.derivatives.range()].to_vec()
                });
                for i in 0..n {
                    let expected = (plus[i] - minus[i]) / (2.0 * h);
                    let entry = if j < n { i * n + j } else { n * n + i };
                    let found = at[layout.jacobian.slot(entry).index()];
                    let close = (found - expected).abs() <= tolerance * (1.0 + expected.abs());
                    assert!(close, "∂f{i}/∂{j} = {found}, by differences {expected}, at {block:?}");
                }
            }
        }
    }

    #[test]
    fn elementary_functions_against_central_differences() {
        for function in Unary::ALL {
            let Domain { low, high, .. } = function.row().domain;
            let (lo, hi) = ((low + 0.1).max(-1.2), (high - 0.1).min(1.2));
            let program = program(1, |b, layout| {
                let x = b.load(layout.states.slot(0));
                let y = b.unary(function, x);
                b.store(layout.derivatives.slot(0), y);
            });
            check(&program, (lo, hi), 1e-6);
        }
        for function in Binary::ALL {
            let program = program(2, |b, layout| {
                let (x, y) = (b.load(layout.states.slot(0)), b.load(layout.states.slot(1)));
                let one = b.binary(function, x, y);
                let square = b.mul(x, y);
                let other = b.binary(function, square, x);
                b.store(layout.derivatives.slot(0), one);
                b.store(layout.derivatives.slot(1), other);
            });
            check(&program, (0.3, 3.0), 1e-6);
        }
    }

    #[test]
    fn arithmetic_against_central_differences() {
        let program = program(3, |b, layout| {
            let [x, y, z] = [0, 1, 2].map(|k| b.load(layout.states.slot(k)));
            let t = b.load(Slot::TIME);
            let quotient = b.div(x, y);
            let fused = b.fma(quotient, z, x);
            let root = b.sqrt(y);
            let root = b.mul(root, t);
            let first = b.sub(fused, root);
            b.store(layout.derivatives.slot(0), first);
            let minus = b.neg(x);
            let size = b.abs(minus);
            let low = b.min(x, y);
            let high = b.max(size, z);
            let second = b.mul(low, high);
            b.store(layout.derivatives.slot(1), second);
            let (floor, sign) = (b.floor(x), b.sign(x));
            let third = b.add(floor, sign);
            let third = b.mul(third, t);
            b.store(layout.derivatives.slot(2), third);
        });
        check(&program, (0.31, 0.99), 1e-6);
    }

    #[test]
    fn zero_derivatives_cost_no_operation() {
        let program = program(2, |b, layout| {
            let (x, v) = (b.load(layout.states.slot(0)), b.load(layout.states.slot(1)));
            let sign = b.sign(x);
            b.store(layout.derivatives.slot(0), v);
            b.store(layout.derivatives.slot(1), sign);
        });
        let func = jacobian(&program);
        let expected = "jacobian:\n  v0 = 1.0\n  v1 = 0.0\n";
        assert!(func.to_string().starts_with(expected), "{func}");
        assert_eq!(func.ops.len(), 2);
        assert_eq!(func.stores.len(), 6);
    }
}
