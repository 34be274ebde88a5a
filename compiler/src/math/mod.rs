//! Elementary functions, expanded to arithmetic of the IR. Every back end and every machine thus computes the same
//! bits, and the functions inline, fold and vectorise like other code.
//!
//! In: a function with elementary operations. Out: the same function with additions, products, fused products, table
//! reads and selects only. Each algorithm is branch-free and correct at 0, −0, ∞, NaN, subnormals and overflow. The
//! payload of a NaN never influences a number or a relevant condition. Polynomials are minimax fits, evaluated by
//! Estrin's scheme, which has a shorter latency than Horner's. Coefficients and tables were computed with 60 digits.
//!
//! Sources: Muller, *Elementary Functions*, 3rd ed. 2016; Tang, *Table-driven implementation of the exponential
//! function*, 1989, and *… of the logarithm function*, 1990.

pub mod tables;
pub mod exponential;
pub mod phi_functions;
mod logarithm;
mod trigonometric;
#[cfg(test)]
mod accuracy;

use crate::ir::build::Build;
use crate::ir::expr::{Real, Shared};
use crate::ir::{Binary, Func, Op, Unary, Value, is_not_negative, is_not_positive};
pub use tables::POOL;

/// The tables of the elementary functions. Every pool begins with them.
pub fn pool() -> &'static [f64] {
    &POOL
}

/// 2^n, exact, for −1022 ≤ n ≤ 1023.
const fn two_to(n: i32) -> f64 {
    assert!(n >= -1022 && n <= 1023);
    f64::from_bits(((n + 1023) as u64) << 52)
}

/// Replaces elementary functions by arithmetic. The result must run with a pool that begins with [`POOL`].
pub fn expand(func: &Func) -> Func {
    expand_by(func, &|function, x, below| {
        Some(match function {
            Unary::Exp if below => exponential::exp_below(x),
            function => unary(function, x),
        })
    })
}

/// Like [`expand`], with the same bits, but with the fewest operations: many lanes run side by side, so throughput
/// matters more than latency. `kept`: functions that the back end computes itself; it must compute the same bits.
pub fn expand_for_lanes(func: &Func, kept: &[Unary]) -> Func {
    expand_by(func, &|function, x, below| match function {
        function if kept.contains(&function) => None,
        Unary::Exp if below => Some(exponential::exp_below_of_lanes(x)),
        function => Some(unary(function, x)),
    })
}

/// Replaces each function of one argument by the result of `by`; `None` keeps the function. The last argument of `by`:
/// whether the argument is known to be at most 0, or NaN.
fn expand_by(func: &Func, by: &dyn for<'a> Fn(Unary, Real<'a>, bool) -> Option<Real<'a>>) -> Func {
    let build = Shared::new(Build::roomy(&func.name, 2 * func.ops.len()).with_pool(POOL.as_slice().into()));
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for (op, live) in func.ops.iter().zip(func.live()) {
        let at = |operand: Value| Real::new(&build, values[operand.index()]);
        let value = match *op {
            _ if !live => Value(u32::MAX),
            Op::Unary(function, x) => match by(function, at(x), is_not_positive(x, |value| func.op(value))) {
                Some(value) => value.value,
                None => build.borrow_mut().op(Op::Unary(function, values[x.index()])),
            },
            Op::Binary(Binary::Pow, x, y) if is_not_negative(x, |value| func.op(value)) => {
                logarithm::pow_of_size(at(x), at(y)).value
            }
            Op::Binary(function, x, y) => binary(function, at(x), at(y)).value,
            op => build.borrow_mut().op(op.map(|operand| values[operand.index()])),
        };
        values.push(value);
    }
    build.into_inner().finish_as(func, &values)
}

fn unary(function: Unary, x: Real) -> Real {
    match function {
        Unary::Exp => exponential::exp(x),
        Unary::Expm1 => exponential::expm1(x),
        Unary::Sinh => exponential::sinh(x),
        Unary::Cosh => exponential::cosh(x),
        Unary::Tanh => exponential::tanh(x),
        Unary::Log => logarithm::log(x),
        Unary::Log1p => logarithm::log1p(x),
        Unary::Sin => trigonometric::sin(x),
        Unary::Cos => trigonometric::cos(x),
        Unary::Tan => trigonometric::tan(x),
        Unary::Asin => trigonometric::asin(x),
        Unary::Acos => trigonometric::acos(x),
        Unary::Atan => trigonometric::atan(x),
    }
}

fn binary<'a>(function: Binary, x: Real<'a>, y: Real<'a>) -> Real<'a> {
    match function {
        Binary::Atan2 => trigonometric::atan2(x, y),
        Binary::Pow => logarithm::pow(x, y),
        Binary::Hypot => hypot(x, y),
    }
}

/// c0 + c1 x + c2 x² + …, by Estrin's scheme.
fn polynomial<'a>(x: Real<'a>, coefficients: &[f64]) -> Real<'a> {
    let pair = |pair: &[f64]| match *pair {
        [c0, c1] => x.fma(c1, c0),
        [c0] => x.constant(c0),
        _ => unreachable!("chunks of two"),
    };
    let mut terms: Vec<Real> = coefficients.chunks(2).map(pair).collect();
    let mut power = x;
    while terms.len() > 1 {
        power = power * power;
        let join = |pair: &[Real<'a>]| match *pair {
            [low, high] => power.fma(high, low),
            [low] => low,
            _ => unreachable!("chunks of two"),
        };
        terms = terms.chunks(2).map(join).collect();
    }
    terms[0]
}

/// √(x² + y²). The operands are scaled against overflow and underflow, the sum of squares has a high and a low part,
/// and one Newton step corrects the root.
fn hypot<'a>(x: Real<'a>, y: Real<'a>) -> Real<'a> {
    let (x, y) = (x.abs(), y.abs());
    let less = y.below(x);
    let (large, small) = (less.choose(x, y), less.choose(y, x));
    let (huge, tiny) = (large.above(two_to(500)), large.below(two_to(-450)));
    let scale = huge.choose(two_to(-600), tiny.choose(two_to(600), 1.0));
    let back = huge.choose(two_to(600), tiny.choose(two_to(-600), 1.0));
    let (large, small) = (large * scale, small * scale);
    let (a, b) = (large * large, small * small);
    let (a_low, b_low) = (large.fma(large, -a), small.fma(small, -b));
    let sum = a + b;
    let low = (a - sum + b) + (a_low + b_low);
    let root = sum.sqrt();
    let rest = (-root).fma(root, sum) + low;
    let root = sum.above(0.0).choose(root + rest / (root + root), root);
    (x.is(f64::INFINITY) | y.is(f64::INFINITY)).choose(f64::INFINITY, root * back)
}

/// Returns sum and rest with a + b = sum + rest exactly, for operands of any size. Source: Knuth, *The Art of Computer
/// Programming 2*, 4.2.2 (2Sum).
fn two_sum<'a>(a: Real<'a>, b: Real<'a>) -> (Real<'a>, Real<'a>) {
    let sum = a + b;
    let of_b = sum - a;
    (sum, (a - (sum - of_b)) + (b - of_b))
}
