//! Measures the distance of the elementary functions from the correctly rounded result, and checks their special cases.

use super::two_to;
use super::{POOL, expand};
use crate::codegen::jit::compile;
use crate::functions::Symmetry;
use crate::ir::build::Build;
use crate::ir::random::Random;
use crate::ir::{Binary, Unary};
use abi::{Code, Function, Layout};

type One = fn(f64) -> f64;
type Two = fn(f64, f64) -> f64;

/// Inputs in slots 3 and 4, result in slot 5.
fn code(make: impl FnOnce(&mut Build, crate::ir::Value, crate::ir::Value) -> crate::ir::Value) -> Code {
    let layout = Layout::new([0, 2, 0, 0, 0, 1, 0, 0, 0, 0]);
    let mut build = Build::new("f");
    let (x, y) = (build.load(layout.inputs.slot(0)), build.load(layout.inputs.slot(1)));
    let value = make(&mut build, x, y);
    build.store(layout.outputs.slot(0), value);
    let func = expand(&build.finish());
    Code::Machine(compile(&[(Function::Outputs, func)], &layout, POOL.len()).unwrap().0)
}

fn run(code: &Code, x: f64, y: f64) -> f64 {
    let mut block = [0.0, 0.0, 0.0, x, y, 0.0];
    code.call(Function::Outputs, &mut block, &POOL, 1);
    block[5]
}

fn of_one(function: Unary) -> Code {
    code(|b, x, _| b.unary(function, x))
}

fn of_two(function: Binary) -> Code {
    code(|b, x, y| b.binary(function, x, y))
}

/// Number of doubles between the two; 0 if both are NaN.
fn distance(a: f64, b: f64) -> u64 {
    let place =
        |x: f64| if x.is_sign_negative() { -((x.to_bits() & (i64::MAX as u64)) as i64) } else { x.to_bits() as i64 };
    if a.is_nan() && b.is_nan() {
        0
    } else if a.is_nan() || b.is_nan() {
        u64::MAX
    } else {
        place(a).abs_diff(place(b))
    }
}

/// A distribution of arguments.
enum Range {
    /// Uniform between the two bounds.
    Within(f64, f64),
    /// Random sign; exponent uniform between the two exponents of 2.
    Powers(i32, i32),
    /// Arbitrary bits.
    Any,
}

impl Range {
    fn sample(&self, random: &mut Random) -> f64 {
        match *self {
            Range::Within(lo, hi) => random.within(lo, hi),
            Range::Powers(lo, hi) => {
                let exponent = lo + random.below((hi - lo) as usize) as i32;
                let size = random.within(1.0, 2.0) * two_to(exponent / 2) * two_to(exponent - exponent / 2);
                if random.below(2) == 0 { size } else { -size }
            }
            Range::Any => f64::from_bits(random.bits()),
        }
    }

    fn name(&self) -> String {
        match *self {
            Range::Within(lo, hi) => format!("{lo} .. {hi}"),
            Range::Powers(lo, hi) => format!("±2^{lo} .. ±2^{hi}"),
            Range::Any => "any bits".into(),
        }
    }
}

/// Prints a line of the table and checks the largest distance from the correctly rounded result. The environment
/// variable `FRIC_SAMPLES` sets the number of samples; `FRIC_WORST` prints the arguments of every result that is not
/// correctly rounded.
#[track_caller]
fn check(name: &str, code: &Code, exact: impl Fn(f64, f64) -> f64, ranges: &[(Range, Range)], most: u64) {
    let samples = std::env::var("FRIC_SAMPLES").ok().and_then(|n| n.parse().ok()).unwrap_or(30_000);
    let print = std::env::var("FRIC_WORST").is_ok();
    for (i, (xs, ys)) in ranges.iter().enumerate() {
        let seed = 1000 + i as u64;
        let mut random = Random(seed);
        let (mut worst, mut at, mut misses) = (0, (0.0, 0.0), 0u64);
        for _ in 0..samples {
            let (x, y) = (xs.sample(&mut random), ys.sample(&mut random));
            let (found, expected) = (run(code, x, y), exact(x, y));
            let far = distance(found, expected);
            misses += u64::from(far > 0);
            if far > 0 && print {
                println!("MISS {name} {x:?} {y:?} {found:?}");
            }
            if far > worst {
                (worst, at) = (far, (x, y));
            }
        }
        let share = misses as f64 / samples as f64 * 100.0;
        println!(
            "{name:6} {:28} {:20} {worst:3} away at most, {share:7.4} % not nearest; seed {seed}, {samples} samples",
            xs.name(),
            ys.name()
        );
        assert!(worst <= most, "{name}{at:?} is {worst} away: {} and not {}", run(code, at.0, at.1), exact(at.0, at.1));
    }
}

/// A function for comparison, the ranges in which it is compared, and the largest distance.
fn reference(function: Unary) -> (One, Vec<Range>, u64) {
    use Range::{Any, Powers, Within};
    use core_math as m;
    match function {
        Unary::Exp => {
            (m::exp, vec![Within(-708.0, 709.7), Within(-1.0, 1.0), Powers(-60, 4), Within(-745.2, -708.0), Any], 1)
        }
        Unary::Expm1 => (m::expm1, vec![Within(-40.0, 709.7), Within(-1.0, 1.0), Powers(-60, 2), Any], 1),
        Unary::Log => {
            (m::log, vec![Within(0.0, 10.0), Within(0.9, 1.1), Within(0.999, 1.001), Powers(-1070, 1023), Any], 1)
        }
        Unary::Log1p => {
            (m::log1p, vec![Within(-1.0, 10.0), Within(-0.1, 0.1), Powers(-60, 2), Powers(0, 1023), Any], 1)
        }
        Unary::Sin => (m::sin, vec![Within(-4.0, 4.0), Within(-1e6, 1e6), Powers(-60, 20), Within(-1e12, 1e12)], 1),
        Unary::Cos => (m::cos, vec![Within(-4.0, 4.0), Within(-1e6, 1e6), Powers(-60, 20), Within(-1e12, 1e12)], 1),
        Unary::Tan => (m::tan, vec![Within(-1.6, 1.6), Within(-1e6, 1e6), Powers(-60, 20)], 2),
        Unary::Asin => (m::asin, vec![Within(-1.0, 1.0), Within(0.49, 0.51), Powers(-60, 0), Any], 2),
        Unary::Acos => {
            (m::acos, vec![Within(-1.0, 1.0), Within(0.99, 1.0), Within(-0.51, -0.49), Powers(-60, 0), Any], 2)
        }
        Unary::Atan => (m::atan, vec![Within(-1.0, 1.0), Within(-100.0, 100.0), Powers(-60, 70), Any], 2),
        Unary::Sinh => (m::sinh, vec![Within(-710.4, 710.4), Within(-1.0, 1.0), Powers(-60, 5), Any], 2),
        Unary::Cosh => (m::cosh, vec![Within(-710.4, 710.4), Within(-1.0, 1.0), Powers(-60, 5), Any], 2),
        Unary::Tanh => (m::tanh, vec![Within(-20.0, 20.0), Within(-1.0, 1.0), Powers(-60, 5), Any], 1),
    }
}

#[test]
fn accuracy_of_functions_of_one_argument() {
    for function in Unary::ALL {
        let (exact, ranges, most) = reference(function);
        let ranges: Vec<(Range, Range)> = ranges.into_iter().map(|range| (range, Range::Within(0.0, 1.0))).collect();
        check(function.name(), &of_one(function), |x, _| exact(x), &ranges, most);
    }
}

#[test]
fn accuracy_of_functions_of_two_arguments() {
    use Range::{Any, Powers, Within};
    use core_math as m;
    let ranges = vec![
        (Within(0.0, 10.0), Within(-10.0, 10.0)),
        (Within(0.99, 1.01), Within(-3e4, 3e4)),
        (Powers(-1070, 1023), Within(-1.0, 1.0)),
        (Within(-20.0, 20.0), Powers(-3, 5)),
        (Any, Any),
    ];
    check("pow", &of_two(Binary::Pow), m::pow, &ranges, 1);
    let plane = || {
        vec![
            (Within(-10.0, 10.0), Within(-10.0, 10.0)),
            (Within(-1e-3, 1e-3), Within(-10.0, 10.0)),
            (Powers(-1000, 1000), Powers(-1000, 1000)),
            (Powers(-40, 40), Powers(-40, 40)),
            (Any, Any),
        ]
    };
    check("atan2", &of_two(Binary::Atan2), m::atan2, &plane(), 2);
    check("hypot", &of_two(Binary::Hypot), m::hypot, &plane(), 1);
}

/// Results at edge cases agree, including the sign of zero; for pow, atan2 and hypot at every pair.
#[test]
fn special_cases_are_those_of_ieee_754() {
    use core_math as m;
    let edges = [
        0.0,
        1.0,
        0.5,
        2.0,
        3.0,
        2.5,
        7.0,
        1e-300,
        5e-324,
        2.2e-308,
        1e-20,
        1e20,
        9007199254740993.0,
        709.0,
        709.9,
        744.0,
        746.0,
        1e300,
        f64::MAX,
        f64::INFINITY,
        f64::NAN,
    ];
    let edges: Vec<f64> = edges.iter().flat_map(|x| [*x, -*x]).collect();
    let agree = |name: &str, found: f64, expected: f64, x: f64, y: f64| {
        let fits = distance(found, expected) <= 1 && (expected != 0.0 || found.to_bits() == expected.to_bits());
        assert!(fits, "{name}({x:?}, {y:?}) = {found:?} and not {expected:?}");
    };
    for function in Unary::ALL {
        let (exact, ..) = reference(function);
        let code = of_one(function);
        let periodic = matches!(function, Unary::Sin | Unary::Cos | Unary::Tan);
        for &x in &edges {
            // Beyond 2^40, sin and cos only guarantee results within ±1.
            if periodic && x.is_finite() && x.abs() > 1e12 {
                assert!(run(&code, x, 0.0).abs() <= 1.0);
            } else {
                agree(function.name(), run(&code, x, 0.0), exact(x), x, 0.0);
            }
        }
    }
    let binary: [(Binary, Two); 3] = [(Binary::Pow, m::pow), (Binary::Atan2, m::atan2), (Binary::Hypot, m::hypot)];
    for (function, exact) in binary {
        let code = of_two(function);
        for &x in &edges {
            for &y in &edges {
                agree(function.name(), run(&code, x, y), exact(x, y), x, y);
            }
        }
    }
}

/// The variants for a known sign of the argument (pow with base ≥ 0, exp with argument ≤ 0) have the same bits.
#[test]
fn variants_for_a_known_sign_change_no_bit() {
    let (any, of_size) = (
        of_two(Binary::Pow),
        code(|b, x, y| {
            let size = b.abs(x);
            b.binary(Binary::Pow, size, y)
        }),
    );
    let (exp, below) = (
        of_one(Unary::Exp),
        code(|b, x, _| {
            let size = b.abs(x);
            let below = b.neg(size);
            b.unary(Unary::Exp, below)
        }),
    );
    let same = |a: f64, b: f64| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
    let mut random = Random(78);
    let edges = [0.0, 1.0, 0.5, 2.0, 3.0, 5e-324, 2.2e-308, 707.5, 745.5, 1e300, f64::INFINITY, f64::NAN];
    let mut sizes = edges.to_vec();
    sizes.extend((0..300).map(|_| Range::Powers(-1074, 1024).sample(&mut random).abs()));
    for &x in &sizes {
        assert!(same(run(&exp, -x, 0.0), run(&below, x, 0.0)), "exp(-{x:?})");
        for y in sizes.iter().flat_map(|y| [*y, -*y]) {
            assert!(same(run(&any, x, y), run(&of_size, x, y)), "pow({x:?}, {y:?})");
        }
    }
}

/// Odd functions are odd to the bit, and even ones are even, so that friction has no preferred direction.
#[test]
fn symmetry_is_exact() {
    let mut random = Random(77);
    for function in Unary::ALL {
        let Some(symmetry) = function.row().symmetry else { continue };
        let code = of_one(function);
        let even = symmetry == Symmetry::Even;
        for _ in 0..2000 {
            let x = Range::Powers(-30, 10).sample(&mut random);
            let (plus, minus) = (run(&code, x, 0.0), run(&code, -x, 0.0));
            let expected = if even { plus } else { -plus };
            assert!(
                minus.to_bits() == expected.to_bits() || plus.is_nan() && minus.is_nan(),
                "{} {x}",
                function.name()
            );
        }
    }
}

/// The tables agree with correctly rounded functions where such functions exist.
#[test]
fn tables_hold_the_rounded_values() {
    for (i, entry) in POOL.iter().enumerate().take(64) {
        let scale = f64::from_bits(entry.to_bits().wrapping_add((i as u64) << 46));
        assert_eq!(scale, core_math::exp2(i as f64 / 64.0));
    }
    for i in 0..128 {
        let (inverse, high, low) = (POOL[128 + i], POOL[256 + i], POOL[384 + i]);
        assert_eq!(inverse * 256.0, (inverse * 256.0).floor());
        assert_eq!(high + low, -core_math::log(inverse));
    }
}
