//! Redundant test elimination for limited integrators: a limit is tested once per step instead of twice.
//!
//! In: a step function after `contract`. Out: the same function, equal to the bit for every step length above 0.
//!
//! An integrator with a limit is `dx/dt = if abs(x) > m and x * r > 0 then 0 else r`: at its limit, it stops if the rate
//! r drives it further out. A step has two such tests. The first is at x, and selects s = 0 or s = r. The second is at the
//! midpoint x + c s, where c is a positive fraction of the step length. The pass moves the second test to x + c r:
//!
//! - If the first test is false, s is r and nothing changes.
//! - If the first test is true, s is 0, so the second test is at x again and also true. It is true at x + c r as well: r
//!   has the sign of x, so this point has that sign too and is at least as far from 0 (rounding is monotonic), and its
//!   product with r is no smaller.
//!
//! Nothing uses the first test after that, and it is removed as dead code.
//!
//! The general pass is redundant test elimination by dominating conditions (Mueller, Whalley, *Avoiding Conditional
//! Branches by Code Replication*, 1995); the argument above is ours.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// Replaces the second limit test of each limited integrator by a test that does not depend on the first.
pub fn drop_limiter_tests(func: &Func) -> Func {
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let plain = build.op(op.map(|operand| values[operand.index()]));
        values.push(independent_second_test(&mut build, plain).unwrap_or(plain));
    }
    build.finish_as(func, &values)
}

/// The test whether x is beyond its limit and driven further out: `limit < |x|` or `limit ≤ |x|`, and `0 < x · rate`.
#[derive(PartialEq)]
struct LimitTest {
    limit: Value,
    or_at: bool,
    x: Value,
    rate: Value,
}

impl LimitTest {
    fn of(build: &Build, truth: Value) -> Option<LimitTest> {
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
            (build.constant(zero) == Some(0.0) && [p, q].contains(&x)).then_some(LimitTest { limit, or_at, x, rate })
        })
    }

    fn build(&self, build: &mut Build) -> Value {
        let (size, zero) = (build.abs(self.x), build.real(0.0));
        let beyond = if self.or_at { build.less_equal(self.limit, size) } else { build.less(self.limit, size) };
        let product = build.mul(self.x, self.rate);
        let further = build.less(zero, product);
        build.and(beyond, further)
    }
}

/// If `truth` is the second test of a limited integrator, returns an equal test that does not depend on the first.
fn independent_second_test(build: &mut Build, truth: Value) -> Option<Value> {
    let middle = LimitTest::of(build, truth)?;
    let Op::Fma(a, b, x) = build.get(middle.x) else { return None };
    let (share, chosen) = if is_share_of_step(build, a) { (a, b) } else { (b, a) };
    let Op::Select(when, stopped, rate) = build.get(chosen) else { return None };
    let first = LimitTest { x, ..middle };
    let matches = is_share_of_step(build, share)
        && rate == middle.rate
        && build.get(stopped) == Op::Real(0)
        && LimitTest::of(build, when)? == first;
    if !matches {
        return None;
    }
    let x = build.fma(share, rate, x);
    Some(LimitTest { x, ..middle }.build(build))
}

/// Whether a value is the step length, or the step length times a positive constant.
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
    use crate::ir::parse::parse;
    use crate::ir::random::Random;
    use abi::table::Interpret;
    use abi::{Function, Layout};

    #[test]
    fn results_agree_to_the_bit() {
        let layout = Layout::new([0, 1, 1, 0, 0, 0, 0, 0, 0, 0]);
        let file = include_str!("../../../tests/ir/limiter_tests_middle.ir");
        let func = parse(file.split("\n---\n").next().expect("the input")).expect("a listing");
        let [twice, once] = [func.clone(), drop_limiter_tests(&func)]
            .map(|func| Interpreter::new(&[(Function::Step, func)], &layout, 0));
        let mut random = Random(1);
        let mut stopped = 0;
        for k in 0..200_000 {
            // Half of the cases are close to the limit, the others have arbitrary values.
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
