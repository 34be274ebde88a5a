//! What is held against itself: the functions of one program, blocks to begin with, and what is called on each.

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

/// Calls of functions, one after the other, on one block.
pub struct Run {
    /// The block to begin with.
    pub start: Vec<f64>,
    /// Which function, and how often.
    pub calls: Vec<(Function, u64)>,
}

/// The statuses, put together, and the block after the calls.
pub type Result = (u64, Vec<f64>);

impl Run {
    /// What it leads to by these calls. Behind one for a single step the block tells the count, which code may leave to
    /// whoever calls it.
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
    /// For messages: what repeats it.
    pub name: String,
    /// What it was made of, for messages; empty for what never was a text.
    pub text: String,
    /// What it holds, for the report: `with/regimes`, `elementary/exp`.
    pub marks: BTreeSet<String>,
    /// Expanded to arithmetic.
    pub functions: Vec<(Function, Func)>,
    /// Where its numbers lie.
    pub description: Description,
    /// Defaults of its parameters.
    pub params: Vec<f64>,
    /// What is compared.
    pub runs: Vec<Run>,
    /// The function that makes steps as lanes take it, elementary functions not expanded; none of a model that has none.
    pub step: Option<(Function, Func)>,
}

impl Case {
    /// Where its numbers lie.
    pub fn layout(&self) -> &Layout {
        &self.description.layout
    }

    /// What each run leads to.
    pub fn on(&self, code: &Code) -> Vec<Result> {
        let pool = &self.description.pool;
        let one = |run: &Run| {
            // Behind the block, from the first single step on.
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

    /// What each run leads to on the reference.
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

/// A function made of chance, stepped a few times from random blocks.
pub fn of_chance(seed: u64) -> Case {
    let mut random = Random(seed);
    let len = 20 + random.below(120);
    let func = random::func(&mut random, len);
    of_func(format!("program of chance, seed {seed}"), func, &mut random)
}

/// A function over the layout of functions made of chance, stepped a few times from random blocks.
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

/// What a method makes of a program, with runs from seeded blocks. `step` in s; the rings of a fixed step have their size.
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

/// A number for the statuses of all calls: those before, and one more.
fn all_of(before: u64, status: u64) -> u64 {
    before.wrapping_mul(31).wrapping_add(status)
}

/// From the defaults; twice from parameters and inputs with edge values; from a block that a run has left, with some of
/// its numbers changed at random, whatever they mean.
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

/// The block with what an adaptive step reads: a step from where the block is.
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
    // So that no surface seems met, wherever it is.
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

/// What a program holds, for the report.
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
