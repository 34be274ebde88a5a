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

struct TestRun {
    code: Code,
    block: Vec<f64>,
    layout: Layout,
}

impl TestRun {
    fn new(program: &Program, method: Method, h: f64, x: &[f64]) -> TestRun {
        let layout = program.description.layout.clone();
        let step = expand(&step(program, method));
        let code = Code::Machine(compile(&[(Function::Step, step)], &layout, POOL.len()).unwrap().0);
        let mut block = vec![0.0; layout.size()];
        block[Slot::STEP.index()] = h;
        block[layout.states.range()].copy_from_slice(x);
        TestRun { code, block, layout }
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
        let mut run = TestRun::new(&program, method, 1.0 / n as f64, &[0.3, -0.2]);
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
        let mut run = TestRun::new(&program, Method::Expo, h, &[1.0]);
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
        let mut run = TestRun::new(&program, method, 2.0 / n as f64, &[0.3, -0.2, 0.1, 0.7]);
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
        let mut run = TestRun::new(&program(20.0), Method::Expo, 10.0 / n as f64, &[0.0]);
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
    let mut run = TestRun::new(&program(1e9), Method::Expo, 0.01, &[0.0]);
    let course: Vec<f64> = (0..628).map(|_| (run.advance(1), run.x(0)).1).collect();
    let most = course.iter().copied().fold(0.0, f64::max);
    assert!(most > 0.3 && most < 0.3 + 1e-8, "{most}");
    assert!((course[627] - (0.3 - 1.0)).abs() < 0.01, "{}", course[627]);
}

/// Coulomb friction on a mass alone: the state stays within the distance of one and a half steps.
#[test]
fn a_state_attracted_to_a_jump_stays_near_it() {
    let program = program(1, |_, x| (vec![x[0].above(0.0).choose(-1.0, 1.0)], x[0]));
    let mut run = TestRun::new(&program, Method::Expo, 0.1, &[0.96]);
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
        let mut run = TestRun::new(&program, method, h, &[0.0]);
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
        for (method, expected) in [Method::Euler, Method::Rk4, Method::Expo, Method::Implicit].into_iter().zip(row) {
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
    let mut run = TestRun::new(&program, Method::Expo, 1e-3, &[0.0, 1.0, 0.0]);
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
        let mut run = TestRun::new(&program, method, h, &[0.0; 3]);
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
        let mut run = TestRun::new(&program, method, h, &[0.0; 5]);
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
    let mut run = TestRun::new(&program, Method::Implicit, 1.0, &[1.0]);
    let mut expo = TestRun::new(&program, Method::Expo, 1.0, &[1.0]);
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
    let mut run = TestRun::new(&program, Method::Euler, 1e-3, &[0.0]);
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
    let mut run = TestRun::new(&program, Method::Euler, 1.0, &[2e-6, 1.0]);
    assert_eq!(run.advance(100), 2);
    assert_eq!(run.block[Slot::COUNT.index()], 4.0);
    let mut run = TestRun::new(&program, Method::Euler, 1.0, &[0.0, 0.0]);
    assert_eq!((run.advance(100), run.block[Slot::COUNT.index()]), (1, 1.0));
    let mut run = TestRun::new(&program, Method::Euler, 1.0, &[0.0, f64::INFINITY]);
    assert_eq!(run.advance(100), 3);
    let mut run = TestRun::new(&program, Method::Euler, 1.0, &[-2.0, 1.0]);
    assert_eq!(run.advance(100), 2);
}

#[test]
fn bounds_on_both_sides_also_catch_nan() {
    let guard = |range| Guard { path: String::new(), slot: Slot(0), range, unit: Unit::none() };
    for (range, far) in [((-2.0, 2.0), -2.1), ((-1.0, 2.0), -1.1), ((-1.0, 2.0), 2.1)] {
        let mut program = program(1, |_, x| (vec![x[0] * 0.0], x[0]));
        program.description.guards = vec![Guard { slot: program.description.layout.states.slot(0), ..guard(range) }];
        let status = |x: f64| TestRun::new(&program, Method::Euler, 1.0, &[x]).advance(1);
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
            let same = found.iter().zip(&expected).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
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
    let mut run = TestRun::new(&program, Method::Euler, 0.5, &[1e-29]);
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
            let same = block.iter().zip(&other).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
            assert!(same, "{} case {case}: {block:?} and {other:?}", method.name());
        }
    }
}
