//! A test case for the back ends: the functions of one program, initial blocks, and the calls made on each.

use abi::description::Layout;
use abi::plan::Method;
use abi::rosenbrock::layout::Trial;
use abi::table::{Code, Interpret};
use abi::{Description, Function, Slot};
use compiler::ir::interpret::Interpreter;
use compiler::ir::program::Program;
use compiler::ir::random::{self, POOL_LEN, Random};
use compiler::ir::{Func, Op};
use std::collections::BTreeSet;
use std::sync::Arc;

/// A sequence of calls on one block.
pub struct Run {
    /// The initial block.
    pub start: Vec<f64>,
    /// The functions, and how often each is called.
    pub calls: Vec<(Function, u64)>,
}

/// The combined statuses, and the block after the calls.
pub type Result = (u64, Vec<f64>);

impl Run {
    /// The result with this implementation of calls. After a single step the count in the block is set, because code
    /// may leave that to the caller.
    pub fn by(&self, mut call: impl FnMut(Function, &mut [f64], u64) -> u64) -> Result {
        let mut block = self.start.clone();
        let mut status = 0;
        for (function, count) in &self.calls {
            let before = block[Slot::COUNT.index()];
            let of_call = call(*function, &mut block, *count);
            status = all_of(status, of_call);
            if (*function, *count) == (Function::Step, 1) {
                block[Slot::COUNT.index()] = before + 1.0;
            }
        }
        (status, block)
    }
}

/// A program and its runs.
pub struct Case {
    /// For messages: how to reproduce it.
    pub name: String,
    /// Its source text, for messages; empty if it was generated as operations.
    pub text: String,
    /// Features that it uses, for the report: `with/regimes`, `elementary/exp`.
    pub marks: BTreeSet<String>,
    /// With elementary functions expanded to arithmetic.
    pub functions: Vec<(Function, Func)>,
    /// The layout of its block.
    pub description: Description,
    /// Defaults of its parameters.
    pub params: Vec<f64>,
    /// The runs to compare.
    pub runs: Vec<Run>,
    /// The step function in the form for lanes, with elementary functions not expanded; none for a model without one.
    pub step: Option<(Function, Func)>,
}

impl Case {
    /// The layout of its block.
    pub fn layout(&self) -> &Layout {
        &self.description.layout
    }

    /// The result of each run.
    pub fn on(&self, code: &Code) -> Vec<Result> {
        let pool = &self.description.pool;
        let one = |run: &Run| {
            // The data after the block, from the first single step on.
            let mut prepared: Option<Vec<f64>> = None;
            run.by(|function, block, count| {
                let single = code.made(Function::Step).filter(|_| (function, count) == (Function::Step, 1));
                let Some((machine, of_step)) = single.and_then(|machine| Some((machine, machine.prepared()?))) else {
                    return code.call(function, block, pool, count);
                };
                let there = prepared.is_some();
                let behind = prepared.get_or_insert_with(|| vec![f64::NAN; of_step.len]);
                let mut numbers = [&*block, behind].concat();
                let status = machine.step_prepared(&mut numbers, pool, there);
                block.copy_from_slice(&numbers[..block.len()]);
                behind.copy_from_slice(&numbers[block.len()..]);
                status.expect("it has such a step")
            })
        };
        self.runs.iter().map(one).collect()
    }

    /// The reference.
    pub fn interpreter(&self) -> Interpreter {
        Interpreter::new(&self.functions, self.layout(), self.description.pool.len())
    }

    /// The result of each run in the reference.
    pub fn interpreted(&self) -> Vec<Result> {
        self.on(&Code::Interpreted(Arc::new(self.interpreter())))
    }

    /// All functions as a listing.
    pub fn listing(&self) -> String {
        self.functions.iter().map(|(_, func)| func.to_string()).collect::<Vec<_>>().join("\n")
    }

    /// Operations of all functions.
    pub fn size(&self) -> usize {
        self.functions.iter().map(|(_, func)| func.ops.len()).sum()
    }
}

/// A random function, stepped a few times from random blocks.
pub fn of_chance(seed: u64) -> Case {
    let mut random = Random(seed);
    let len = 20 + random.below(120);
    let func = random::func(&mut random, len);
    of_func(format!("program of chance, seed {seed}"), func, &mut random)
}

/// A function with the layout of random functions, stepped a few times from random blocks.
pub fn of_func(name: String, func: Func, random: &mut Random) -> Case {
    let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
    let layout = random::layout();
    let starts: Vec<Vec<f64>> = (0..4).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
    let params = vec![0.5; layout.params.len as usize];
    let description = Description { name: "Chance".into(), layout, pool: pool.into(), ..Description::default() };
    let calls = vec![(Function::Step, 1 + random.below(5) as u64)];
    Case {
        name,
        text: String::new(),
        marks: BTreeSet::new(),
        step: Some((Function::Step, func.clone())),
        functions: vec![(Function::Step, func)],
        description,
        params,
        runs: starts.into_iter().map(|start| Run { start, calls: calls.clone() }).collect(),
    }
}

/// The code of a program for a method, with runs from seeded blocks. `step` in s; the ring buffers of a fixed step have
/// been sized.
pub fn of_program(name: String, text: &str, program: &Program, method: Method, step: f64, random: &mut Random) -> Case {
    let functions = compiler::functions(program, method);
    let mut case = Case {
        name: format!("{name}, {}", method.name()),
        text: text.to_string(),
        marks: marks(program, method),
        step: compiler::codegen::tiering::of_lanes(program, method),
        functions,
        description: program.description.clone(),
        params: program.params.clone(),
        runs: Vec::new(),
    };
    case.runs = runs(&case, step, random);
    case
}

/// Combines the statuses of all calls: the previous ones, and one more.
fn all_of(before: u64, status: u64) -> u64 {
    before.wrapping_mul(31).wrapping_add(status)
}

/// Runs from the defaults; twice from parameters and inputs with edge values; and from a block after a run, with some
/// of its numbers changed at random.
fn runs(case: &Case, step: f64, random: &mut Random) -> Vec<Run> {
    let layout = case.layout();
    let has = |which: Function| case.functions.iter().any(|(function, _)| *function == which);
    let present = |calls: Vec<(Function, u64)>| calls.into_iter().filter(|(which, _)| has(*which)).collect::<Vec<_>>();
    let mut defaults = vec![0.0; layout.size()];
    defaults[Slot::STEP.index()] = step;
    defaults[layout.params.range()].copy_from_slice(&case.params);
    let begin = [(Function::Start, 1), (Function::Transitions, 1), (Function::Outputs, 1)];
    let steps = if has(Function::Step) { 20 + random.below(60) as u64 } else { 0 };
    let evaluated = [
        (Function::Derivatives, 1),
        (Function::Jacobian, 1),
        (Function::Roots, 1),
        (Function::Tick, 1),
        // In C it is called once at a time.
        (Function::Rosenbrock, 1),
        (Function::Rosenbrock, 1),
        (Function::Rosenbrock, 1),
        // A single step has code of its own.
        (Function::Step, 1),
        (Function::Step, 1),
        (Function::Step, 1),
        (Function::Step, steps),
        (Function::Step, 1),
        (Function::Step, 1),
    ];
    let from_start = present(begin.into_iter().chain(evaluated).collect());

    let mut out = vec![Run { start: tried(defaults.clone(), layout, step), calls: from_start.clone() }];
    for _ in 0..2 {
        let mut start = tried(defaults.clone(), layout, step);
        for slot in layout.params.range().chain(layout.inputs.range()) {
            match random.below(4) {
                0 => start[slot] = random.real(),
                1 => start[slot] *= [-1.0, 1e-12, 1e12, 0.999, 1.1][random.below(5)],
                _ => {}
            }
        }
        out.push(Run { start, calls: from_start.clone() });
    }
    let mut left = defaults;
    let interpreter = case.interpreter();
    for (function, count) in &from_start {
        interpreter.call(*function, &mut left, &case.description.pool, *count);
    }
    left = tried(left, layout, step);
    for value in &mut left {
        match random.below(8) {
            0 => *value = random.real(),
            1 => *value *= random.within(-1.0, 3.0),
            _ => {}
        }
    }
    let on = [(Function::Transitions, 1), (Function::Outputs, 1)].into_iter().chain(evaluated);
    out.push(Run { start: left, calls: present(on.collect()) });
    out
}

/// Sets the inputs of an adaptive step: a step from the present point of the block.
fn tried(mut block: Vec<f64>, layout: &Layout, step: f64) -> Vec<f64> {
    let Some(trial) = Trial::of(layout) else { return block };
    let t = block[Slot::TIME.index()];
    block[trial.time().index()] = t;
    block[trial.next().index()] = step;
    block[trial.longest().index()] = 10.0 * step;
    block[trial.stop().index()] = t + 100.0 * step;
    block[trial.before_stop().index()] = (t + 100.0 * step).next_down();
    block[trial.watched().index()] = f64::INFINITY;
    block[trial.tol().index()] = 1e-6;
    block[trial.scales().range()].fill(1.0);
    block[trial.lows().range()].fill(f64::NEG_INFINITY);
    block[trial.highs().range()].fill(f64::INFINITY);
    // So that no surface is met, wherever it is.
    block[trial.sides().range()].fill(1.0);
    block[trial.here().range()].fill(1.0);
    let from = trial.from();
    for (to, of) in
        [(from.states, layout.states), (from.derivatives, layout.derivatives), (from.jacobian, layout.jacobian)]
    {
        if to.len == of.len {
            block.copy_within(of.range(), to.range().start);
        }
    }
    block
}

/// Features of a program, for the report.
fn marks(program: &Program, method: Method) -> BTreeSet<String> {
    let description = &program.description;
    let mut out = BTreeSet::from([format!("method/{}", method.name())]);
    let mut with = |what: &str, there: bool| {
        if there {
            out.insert(format!("with/{what}"));
        }
    };
    let holds = |name: char| description.quantities.iter().any(|quantity| quantity.path.contains(name));
    with("states", description.layout.states.len > 0);
    with("inputs", description.layout.inputs.len > 0);
    with("regimes", !description.automata.is_empty());
    with("transitions or events", program.transitions.is_some());
    with("sampled blocks", !description.ticks.is_empty());
    with("delays", !description.delays.is_empty());
    with("guards", !description.guards.is_empty());
    with("switching surfaces", program.roots.is_some());
    with("parts", holds('.'));
    with("arrays of parts", holds('['));
    let own = [Some(&program.start), Some(&program.outputs), Some(&program.derivatives), program.tick.as_ref()];
    let funcs = own.into_iter().chain([program.transitions.as_ref(), program.roots.as_ref()]).flatten();
    for op in funcs.flat_map(|func| &func.ops) {
        match op {
            Op::Unary(function, _) => drop(out.insert(format!("elementary/{function:?}").to_lowercase())),
            Op::Binary(function, ..) => drop(out.insert(format!("elementary/{function:?}").to_lowercase())),
            Op::Sqrt(_) => drop(out.insert("elementary/sqrt".into())),
            Op::Pool { .. } => drop(out.insert("with/tables".into())),
            Op::IntMul(..) => drop(out.insert("with/noise".into())),
            Op::Select(..) => drop(out.insert("with/choices".into())),
            _ => {}
        }
    }
    out
}
