//! The compiled Jacobian of every experiment of the library against central differences of its own derivatives, at
//! random points around its start. A kink within the width of a difference is detected, because halving the width
//! changes the result much: such an entry is not compared.

mod support;

use abi::plan::Method;
use abi::table::Interpret;
use abi::{Function, Slot};
use compiler::ir::interpret::Interpreter;
use compiler::ir::program::Program;
use compiler::ir::random::Random;
use support::Texts;

const POINTS: usize = 6;

/// What was compared.
#[derive(Default, Debug)]
struct Tally {
    experiments: usize,
    entries: usize,
    varying: usize,
    kinks: usize,
}

#[test]
fn jacobians_are_the_limits_of_differences() {
    let mut tally = Tally::default();
    let mut random = Random(11);
    for folder in ["stdlib-models", "tests/stdlib"] {
        for (path, text) in support::texts_below(&support::root().join(folder)) {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let mut loaded = compiler::load(&name, &text, &Texts::default());
            for experiment in loaded.experiments().into_iter().map(|experiment| experiment.name) {
                let changes = compiler::Changes { method: Some(Method::Adaptive), ..compiler::Changes::default() };
                let built = compiler::build(&mut loaded, &Texts::default(), &experiment, &changes, &mut Vec::new());
                let program = built.unwrap_or_else(|found| panic!("{name}, {experiment}: {found:?}")).program;
                if !program.description.delays.is_empty() || program.description.layout.states.len == 0 {
                    continue;
                }
                tally.experiments += 1;
                compare(&format!("{name}, {experiment}"), &program, &mut random, &mut tally);
            }
        }
    }
    println!("{tally:?}");
    assert!(tally.experiments > 150 && tally.varying > 1000, "{tally:?}");
    assert!(tally.kinks * 5 < tally.entries, "{tally:?}");
}

fn compare(name: &str, program: &Program, random: &mut Random, tally: &mut Tally) {
    let layout = &program.description.layout;
    let functions: Vec<_> = compiler::functions(program, Method::Adaptive)
        .into_iter()
        .filter(|(function, _)| [Function::Start, Function::Derivatives, Function::Jacobian].contains(function))
        .collect();
    let code = Interpreter::new(&functions, layout, program.description.pool.len());
    let pool = &program.description.pool;
    let mut start = vec![0.0; layout.size()];
    start[layout.params.range()].copy_from_slice(&program.params);
    code.call(Function::Start, &mut start, pool, 1);
    let (n, states) = (layout.states.len as usize, layout.states.range());
    let scale = |i: usize| {
        let slot = layout.states.slot(i);
        program.description.quantities.iter().find(|q| q.slot == slot).map_or(1.0, |q| q.unit.scale)
    };
    for _ in 0..POINTS {
        let mut block = start.clone();
        block[Slot::TIME.index()] = random.within(0.01, 2.0);
        for i in 0..n {
            block[states.start + i] += random.within(-0.5, 0.5) * scale(i);
        }
        code.call(Function::Jacobian, &mut block, pool, 1);
        let jacobian = block[layout.jacobian.range()].to_vec();
        let entry = |row: usize, column: usize| {
            if program.description.coupling.is_empty() {
                return jacobian[row * n + column];
            }
            let known = program.description.coupling.iter().position(|at| *at == (row as u32, column as u32));
            known.map_or(0.0, |known| jacobian[known])
        };
        for column in 0..n {
            let at = states.start + column;
            let slopes = |by: f64| {
                let mut moved = block.clone();
                moved[at] = block[at] + by;
                code.call(Function::Derivatives, &mut moved, pool, 1);
                (moved[at], moved[layout.derivatives.range()].to_vec())
            };
            let difference = |by: f64| {
                let ((ahead, f_ahead), (behind, f_behind)) = (slopes(by), slopes(-by));
                let quotient = |(a, b): (&f64, &f64)| (a - b) / (ahead - behind);
                (f_ahead.iter().zip(&f_behind).map(quotient).collect::<Vec<f64>>(), f_ahead)
            };
            let by = 1e-4 * scale(column).max(1e-3 * block[at].abs());
            let ((wide, f), (narrow, _)) = (difference(by), difference(0.5 * by));
            for row in 0..n {
                let known = entry(row, column);
                // Richardson extrapolation: two differences of order two give one of order four.
                let limit = (4.0 * narrow[row] - wide[row]) / 3.0;
                let rounding = 1e-13 * f[row].abs() / by;
                let size = limit.abs().max(known.abs());
                tally.entries += 1;
                if !limit.is_finite() || (wide[row] - narrow[row]).abs() > 1e-3 * size + rounding {
                    tally.kinks += 1;
                    continue;
                }
                tally.varying += usize::from(known != 0.0);
                assert!(
                    (known - limit).abs() <= 1e-4 * size + 10.0 * rounding,
                    "{name}: ∂f{row}/∂x{column} is {known}, its differences tend to {limit}"
                );
            }
        }
    }
}
