//! Asks once a step, not twice, whether what is at its limit is driven further.
//!
//! In: a step behind `contract`. Out: the same, to the bit, where the step is above 0. An integrator with a limit,
//! `dx/dt = if abs(x) > m and x * r > 0 then 0 else r`, is asked at the beginning of a step and again in its middle, at
//! x + c s with c a share of the step and s the rate that the first answer chose. But if the first answer is yes, the
//! second is yes at x + c r too: that lies no nearer to 0 on the same side, for rounding keeps order, and the product of
//! what lies further out is no smaller. If it is no, s is r. So the second question is asked at x + c r at once, and
//! nothing needs the first any more.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// Asks for the limits of a step once.
pub fn drop_limiter_tests(func: &Func) -> Func {
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let plain = build.op(op.map(|operand| values[operand.index()]));
        values.push(second(&mut build, plain).unwrap_or(plain));
    }
    build.finish_as(func, &values)
}

/// Whether a number is beyond its limit and driven further: `limit < |x|` or `limit ≤ |x|`, and `0 < x r`.
#[derive(PartialEq)]
struct Beyond {
    limit: Value,
    or_at: bool,
    x: Value,
    rate: Value,
}

impl Beyond {
    fn of(build: &Build, truth: Value) -> Option<Beyond> {
        let Op::And(a, b) = build.get(truth) else { return None };
        [(a, b), (b, a)].into_iter().find_map(|(size, side)| {
            let (limit, size, or_at) = match build.get(size) {
                Op::Less(limit, size) => (limit, size, false),
                Op::LessEqual(limit, size) => (limit, size, true),
                _ => return None,
            };
            let (Op::Abs(x), Op::Less(zero, product)) = (build.get(size), build.get(side)) else { return None };
            let Op::Mul(p, q) = build.get(product) else { return None };
            let rate = if p == x { q } else { p };
            (build.constant(zero) == Some(0.0) && [p, q].contains(&x)).then_some(Beyond { limit, or_at, x, rate })
        })
    }

    fn asked(&self, build: &mut Build) -> Value {
        let (size, zero) = (build.abs(self.x), build.real(0.0));
        let beyond = if self.or_at { build.less_equal(self.limit, size) } else { build.less(self.limit, size) };
        let product = build.mul(self.x, self.rate);
        let further = build.less(zero, product);
        build.and(beyond, further)
    }
}

/// The second question without the first, if a truth is one.
fn second(build: &mut Build, truth: Value) -> Option<Value> {
    let middle = Beyond::of(build, truth)?;
    let Op::Fma(a, b, x) = build.get(middle.x) else { return None };
    let (share, chosen) = if is_share_of_step(build, a) { (a, b) } else { (b, a) };
    let Op::Select(when, stopped, rate) = build.get(chosen) else { return None };
    let first = Beyond { x, ..middle };
    let fits = is_share_of_step(build, share)
        && rate == middle.rate
        && build.get(stopped) == Op::Real(0)
        && Beyond::of(build, when)? == first;
    if !fits {
        return None;
    }
    let x = build.fma(share, rate, x);
    Some(Beyond { x, ..middle }.asked(build))
}

/// Whether a value is the length of the step, or that times a number above 0.
fn is_share_of_step(build: &Build, value: Value) -> bool {
    let is_step = |value: Value| build.get(value) == Op::Load(Slot::STEP);
    let is_above = |value: Value| build.constant(value).is_some_and(|x| x > 0.0 && x.is_finite());
    match build.get(value) {
        Op::Mul(a, b) => is_step(a) && is_above(b) || is_step(b) && is_above(a),
        _ => is_step(value),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::Interpreter;
    use crate::ir::random::Random;
    use abi::table::Interpret;
    use abi::{Function, Layout};

    /// An integrator in slot 4 of the rate in slot 3, with a limit of 1, over half a step and then a whole one.
    fn integrator(twice: bool) -> Func {
        let mut build = Build::new("step");
        let (rate, x, h) = (build.load(Slot(3)), build.load(Slot(4)), build.load(Slot::STEP));
        let [zero, half, limit] = [0.0, 0.5, 1.0].map(|number| build.real(number));
        let share = build.mul(h, half);
        let ask = |build: &mut Build, x| Beyond { limit, or_at: true, x, rate }.asked(build);
        let mut chosen = rate;
        if twice {
            let first = ask(&mut build, x);
            chosen = build.select(first, zero, rate);
        }
        let middle = build.fma(share, chosen, x);
        let second = ask(&mut build, middle);
        let moved = build.fma(h, rate, x);
        let next = build.select(second, x, moved);
        build.store(Slot(4), next);
        build.finish()
    }

    #[test]
    fn a_limit_is_asked_for_once() {
        assert_eq!(drop_limiter_tests(&integrator(true)), integrator(false));
        assert_eq!(drop_limiter_tests(&integrator(false)), integrator(false), "nothing else changes");
    }

    #[test]
    fn a_question_of_another_rate_stays() {
        let mut func = integrator(true);
        // The choice is between 0 and something else.
        let other = func.ops.iter().position(|op| matches!(op, Op::Load(Slot::STEP))).expect("it has a step");
        let chosen = func.ops.iter_mut().find(|op| matches!(op, Op::Select(..))).expect("it chooses");
        let Op::Select(when, zero, _) = *chosen else { unreachable!() };
        *chosen = Op::Select(when, zero, Value(other as u32));
        assert_eq!(drop_limiter_tests(&func).ops.len(), func.ops.len());
    }

    #[test]
    fn every_bit_stays() {
        let layout = Layout::new([0, 1, 1, 0, 0, 0, 0, 0, 0, 0]);
        let [twice, once] = [integrator(true), drop_limiter_tests(&integrator(true))]
            .map(|func| Interpreter::new(&[(Function::Step, func)], &layout, 0));
        let mut random = Random(1);
        let mut stopped = 0;
        for k in 0..200_000 {
            // Around the limit, or anything.
            let [rate, x] = match k % 2 {
                0 => [random.within(-4.0, 4.0), random.within(-1.0, 1.0).signum() * random.within(0.999, 1.001)],
                _ => [random.real(), random.real()],
            };
            let step = [1e-3, 0.5, 1e-300][k % 3];
            let [a, b] = [&twice, &once].map(|code| {
                let mut block = vec![0.0, step, 0.0, rate, x];
                code.call(Function::Step, &mut block, &[], 1);
                block[4]
            });
            assert!(a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(), "{rate:e} {x:e}: {b:e} instead of {a:e}");
            stopped += usize::from(a.to_bits() == x.to_bits());
        }
        assert!(stopped > 10_000, "{stopped} were stopped");
    }
}
