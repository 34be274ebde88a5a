//! The reference interpreter, machine code in memory, images for x86-64 and 64-bit Arm, and C give the same bits, on the
//! models of the library and on programs made of chance; so do lanes, where there is no delay. All NaN are one value.
//!
//! A plain run tries 2,000 programs of chance. `FRIC_PROGRAMS=1000000 cargo test --release --test agreement chance` goes on
//! where an earlier run of the same command was interrupted: see docs/machine-code.md.

#[path = "../support/debian.rs"]
mod debian;
mod emulator;
#[path = "../support/mod.rs"]
mod support;

use abi::description::Layout;
use abi::image::Target;
use abi::lanes::Batch;
use abi::plan::Method;
use abi::table::{Code, Interpret};
use abi::{Description, Function};
use compiler::backend::interp::Interpreter;
use compiler::backend::wide::{self, Width};
use compiler::backend::{blob, c, jit};
use compiler::ir::random::{self, POOL_LEN, Random};
use compiler::ir::{Func, Op};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use support::Texts;

/// A model, blocks to begin with, and what is called on each.
struct Case {
    name: String,
    functions: Vec<(Function, Func)>,
    description: Description,
    params: Vec<f64>,
    starts: Vec<Vec<f64>>,
    calls: Vec<(Function, u64)>,
    /// The step as lanes take it: elementary functions not expanded.
    step: Func,
}

/// The last status and the block after the calls.
type Result = (u64, Vec<f64>);

/// What each start of a case led to.
type Results = Vec<Result>;

impl Case {
    fn on(&self, code: &Code) -> Results {
        let pool = &self.description.pool;
        let one = |start: &Vec<f64>| {
            let mut block = start.clone();
            let mut status = 0;
            for (function, count) in &self.calls {
                status = code.call(*function, &mut block, pool, *count);
            }
            (status, block)
        };
        self.starts.iter().map(one).collect()
    }

    /// What each start leads to in the last lane of a batch of the same; none if there are no lanes.
    fn in_lanes(&self, width: Width, vectors: usize) -> Option<Results> {
        let pool = &self.description.pool;
        let lanes = wide::compile(&self.step, self.layout(), pool.len(), width, vectors).ok()?;
        let alone = Interpreter::new(&self.functions, self.layout(), pool.len());
        let one = |start: &Vec<f64>| {
            let mut block = start.clone();
            let (mut status, mut batch) = (0, Batch::new(lanes.clone()));
            for (function, count) in &self.calls {
                if *function != Function::Step {
                    status = alone.call(*function, &mut block, pool, *count);
                    continue;
                }
                let last = batch.width() - 1;
                (0..=last).for_each(|lane| batch.load(lane, &block));
                batch.advance(pool, *count);
                batch.save(last, &mut block);
                status = batch.status(last);
            }
            (status, block)
        };
        Some(self.starts.iter().map(one).collect())
    }

    fn layout(&self) -> &Layout {
        &self.description.layout
    }

    fn interpreted(&self) -> Results {
        let interpreter = Interpreter::new(&self.functions, self.layout(), self.description.pool.len());
        self.on(&Code::Interpreted(Arc::new(interpreter)))
    }

    fn image(&self, target: Target) -> Vec<u8> {
        let image = blob::image(&self.functions, &self.description, &self.params, target, &[]);
        image.unwrap_or_else(|why| panic!("{}: {why}", self.name)).to_bytes()
    }

    fn as_text(&self) -> String {
        self.functions.iter().map(|(_, func)| func.to_string()).collect::<Vec<_>>().join("\n")
    }
}

/// Runs cases on every back end, C at this level of optimisation (long lines take gcc long); panics at the first difference, with the program.
fn compare(cases: &[Case], level: &str) -> Vec<Results> {
    let expected: Vec<Results> = cases.iter().map(Case::interpreted).collect();
    let jit = |case: &Case| {
        let machine = jit::compile(&case.functions, case.layout(), case.description.pool.len());
        case.on(&Code::Machine(machine.unwrap_or_else(|why| panic!("{}: {why}", case.name)).0))
    };
    let here = Target::here().expect("tests run where code is made for");
    let image = |case: &Case| {
        // SAFETY: the compiler has just made it.
        let model = unsafe { runtime::blob::load(&case.image(here)) };
        case.on(&model.unwrap_or_else(|why| panic!("{}: {why}", case.name)).code)
    };
    for width in [Width::Avx2, Width::Avx512].into_iter().filter(|width| width.is_here()) {
        for (case, expected) in cases.iter().zip(&expected) {
            let Some(results) = case.in_lanes(width, width.vectors()) else { continue };
            for (expected, found) in expected.iter().zip(&results) {
                let calls = &case.calls;
                assert!(
                    same(expected, found),
                    "{}: a lane of {} differs\n{}\ncalls {calls:?}\nfound    {found:?}\nexpected {expected:?}",
                    case.name,
                    width.name(),
                    case.step
                );
            }
        }
    }
    let found: [(&str, Vec<Results>); 4] = [
        ("machine code in memory", cases.iter().map(jit).collect()),
        ("an image for this processor", cases.iter().map(image).collect()),
        ("C", compiled_c(cases, level)),
        ("an image for 64-bit Arm", emulated(cases)),
    ];
    for (back_end, results) in &found {
        for ((case, expected), found) in cases.iter().zip(&expected).zip(results) {
            for ((start, expected), found) in case.starts.iter().zip(expected).zip(found) {
                assert!(
                    same(expected, found),
                    "{}: {back_end} differs\n{}\ncalls {:?} on {start:?}\nfound    {found:?}\nexpected {expected:?}",
                    case.name,
                    case.as_text(),
                    case.calls
                );
            }
        }
    }
    expected
}

/// Equal to the bit, all NaN being one value.
fn same(a: &Result, b: &Result) -> bool {
    let equal = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
    a.0 == b.0 && a.1.len() == b.1.len() && a.1.iter().zip(&b.1).all(equal)
}

/// A file of this test's own.
fn scratch(what: &str) -> PathBuf {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    let next = NEXT.fetch_add(1, Ordering::Relaxed);
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("agreement-{}-{next}-{what}", std::process::id()))
}

/// All cases as one C file, compiled with warnings as errors.
fn compiled_c(cases: &[Case], level: &str) -> Vec<Results> {
    let mut text = String::new();
    for (k, case) in cases.iter().enumerate() {
        let description = Description { name: format!("Case{k}"), ..case.description.clone() };
        let mut source = c::source(&case.functions, &description, &case.params);
        // Each is a file of its own: here they share one.
        for name in ["table_", "bits_of", "real_of", "truncated", "as_real", "shifted", "is_less", "entry", "inside"] {
            source = source.replace(&format!("{name}("), &format!("{name}{k}("));
        }
        text += &source.replace("table_", &format!("table{k}_"));
    }
    let (source, library) = (scratch("cases.c"), scratch("cases.so"));
    fs::write(&source, text).unwrap();
    let flags = ["-std=c11", "-Wall", "-Wextra", "-pedantic", "-Werror", "-shared", "-fPIC", level, "-o"];
    let built = Command::new("gcc").args(flags).arg(&library).arg(&source).arg("-lm").output().expect("gcc runs");
    assert!(built.status.success(), "{}: {}", source.display(), String::from_utf8_lossy(&built.stderr));
    // SAFETY: the library runs no code when it is loaded.
    let loaded = unsafe { libloading::Library::new(&library) }.expect("the library loads");
    let results = cases.iter().enumerate().map(|(k, case)| {
        let one = |start: &Vec<f64>| {
            let mut block = start.clone();
            let mut status = 0;
            for (function, count) in &case.calls {
                let name = format!("case{k}_{}", function.name());
                // SAFETY: the file just written has a function of this name and type, which stays in the block.
                status = unsafe {
                    type Entry = unsafe extern "C" fn(*mut f64, u64) -> u64;
                    let entry = loaded.get::<Entry>(name.as_bytes()).expect("the function is in the file");
                    entry(block.as_mut_ptr(), *count)
                };
            }
            (status, block)
        };
        case.starts.iter().map(one).collect()
    });
    let results = results.collect();
    let _ = (fs::remove_file(source), fs::remove_file(library));
    results
}

/// All cases as images for 64-bit Arm, in one run of the emulator.
fn emulated(cases: &[Case]) -> Vec<Results> {
    let mut bytes = Vec::new();
    let number = |bytes: &mut Vec<u8>, n: usize| bytes.extend((n as u64).to_le_bytes());
    number(&mut bytes, cases.len());
    for case in cases {
        let image = case.image(Target::Aarch64);
        number(&mut bytes, image.len());
        bytes.extend(&image);
        number(&mut bytes, case.calls.len());
        for (function, count) in &case.calls {
            number(&mut bytes, *function as usize);
            number(&mut bytes, *count as usize);
        }
        number(&mut bytes, case.starts.len());
        number(&mut bytes, case.layout().size());
        for start in &case.starts {
            start.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        }
    }
    let (input, output) = (scratch("cases"), scratch("results"));
    fs::write(&input, bytes).unwrap();
    emulator::run(&input, &output);
    let bytes = fs::read(&output).unwrap();
    let _ = (fs::remove_file(input), fs::remove_file(output));
    let mut words = bytes.chunks_exact(8).map(|word| u64::from_le_bytes(word.try_into().unwrap()));
    let mut one = |case: &Case| {
        let status = words.next().expect("a result for each start");
        (status, (0..case.layout().size()).map(|_| f64::from_bits(words.next().expect("all slots"))).collect())
    };
    cases.iter().map(|case| case.starts.iter().map(|_| one(case)).collect()).collect()
}

/// A function made of chance, stepped a few times from random blocks.
fn of_chance(seed: u64) -> Case {
    let mut random = Random(seed);
    let len = 20 + random.below(120);
    let func = random::func(&mut random, len);
    let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
    let layout = random::layout();
    let starts = (0..4).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
    let params = vec![0.5; layout.params.len as usize];
    let description =
        Description { name: format!("Chance{seed}"), layout, pool: pool.into(), ..Description::default() };
    Case {
        name: format!("program of chance, seed {seed}"),
        step: func.clone(),
        functions: vec![(Function::Step, func)],
        description,
        params,
        starts,
        calls: vec![(Function::Step, 1 + random.below(5) as u64)],
    }
}

/// An experiment, each of its combinations, with a method: started and stepped.
fn of_experiment(name: &str, text: &str, experiment: &str, method: Method, steps: u64) -> Vec<Case> {
    let sources = Texts::default();
    let mut loaded = compiler::load(name, text, &sources);
    let own = {
        let changes = compiler::Changes::default();
        let read =
            compiler::experiment::read(&mut loaded, &sources, experiment, &changes, &mut Vec::new(), &mut |_| ());
        let variants = read.unwrap_or_else(|errors| panic!("{name}, {experiment}: {errors:?}\n{text}"));
        variants[0].experiment.solver.step
    };
    let step = if own > 0.0 { own } else { 1e-4 };
    let changes = compiler::Changes { method: Some(method), step: Some(step), ..compiler::Changes::default() };
    let read = compiler::experiment::read(&mut loaded, &sources, experiment, &changes, &mut Vec::new(), &mut |_| ());
    let variants = read.unwrap_or_else(|errors| panic!("{name}, {experiment}: {errors:?}\n{text}"));
    let case = |variant: compiler::experiment::Variant| {
        let program = variant.program;
        let functions = compiler::functions(&program, method);
        let layout = &program.description.layout;
        let mut start = vec![0.0; layout.size()];
        start[abi::Slot::STEP.index()] = step;
        start[layout.params.range()].copy_from_slice(&program.params);
        let has = |function: Function| functions.iter().any(|(known, _)| *known == function);
        let calls = [(Function::Start, 1), (Function::Transitions, 1), (Function::Outputs, 1), (Function::Step, steps)];
        let calls = calls.into_iter().filter(|(function, _)| has(*function)).collect();
        Case {
            name: format!("{name}, {experiment} {} by {}", variant.label, method.name()),
            description: program.description.clone(),
            params: program.params.clone(),
            starts: vec![start],
            calls,
            step: compiler::code::step(&program, method),
            functions,
        }
    };
    variants.into_iter().map(case).collect()
}

/// What cases are made of and what became of them: a collapse of the generator shows here.
#[derive(Default)]
struct Distribution {
    cases: usize,
    operations: BTreeMap<&'static str, usize>,
    lengths: Vec<usize>,
    results: usize,
    stopped: usize,
    values: usize,
    zero: usize,
    nan: usize,
    infinite: usize,
    subnormal: usize,
    changed: usize,
}

impl Distribution {
    fn see(&mut self, case: &Case, results: &Results) {
        self.cases += 1;
        for (_, func) in &case.functions {
            self.lengths.push(func.ops.len());
            for op in &func.ops {
                *self.operations.entry(kind(*op)).or_default() += 1;
            }
        }
        for ((status, block), start) in results.iter().zip(&case.starts) {
            self.results += 1;
            self.stopped += usize::from(*status != 0);
            self.changed += usize::from(block.iter().zip(start).any(|(a, b)| a.to_bits() != b.to_bits()));
            for x in block {
                self.values += 1;
                self.zero += usize::from(*x == 0.0);
                self.nan += usize::from(x.is_nan());
                self.infinite += usize::from(x.is_infinite());
                self.subnormal += usize::from(x.is_subnormal());
            }
        }
    }

    fn tell(&mut self, what: &str) {
        self.lengths.sort_unstable();
        let length = |part: f64| self.lengths[((self.lengths.len() - 1) as f64 * part) as usize];
        let share = |n: usize, of: usize| format!("{:.1} %", 100.0 * n as f64 / of.max(1) as f64);
        println!("{what}: {} programs, {} runs, equal on five back ends", self.cases, self.results);
        println!("  operations a function: median {}, 95 % {}, most {}", length(0.5), length(0.95), length(1.0));
        println!(
            "  runs: {} changed something, {} ended with a status",
            share(self.changed, self.results),
            share(self.stopped, self.results)
        );
        println!(
            "  values: {} zero, {} NaN, {} infinite, {} subnormal",
            share(self.zero, self.values),
            share(self.nan, self.values),
            share(self.infinite, self.values),
            share(self.subnormal, self.values)
        );
        let total: usize = self.operations.values().sum();
        let kinds: Vec<String> =
            self.operations.iter().map(|(kind, n)| format!("{kind} {}", share(*n, total))).collect();
        println!("  operations: {}", kinds.join(", "));
    }
}

fn kind(op: Op) -> &'static str {
    match op {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) => "constant",
        Op::Load(_) => "load",
        Op::Pool { .. } => "table",
        Op::Ring { .. } => "ring",
        Op::Add(..) | Op::Sub(..) => "sum",
        Op::Mul(..) => "product",
        Op::Div(..) => "quotient",
        Op::Neg(_) | Op::Abs(_) => "sign",
        Op::Sqrt(_) => "root",
        Op::Fma(..) => "fma",
        Op::Floor(_) | Op::Nearest(_) => "rounding",
        Op::Unary(..) | Op::Binary(..) => "elementary",
        Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => "comparison",
        Op::And(..) | Op::Or(..) | Op::Not(_) => "logic",
        Op::Select(..) => "select",
        Op::IntAdd(..) | Op::IntSub(..) | Op::IntMul(..) | Op::IntAnd(..) | Op::IntOr(..) | Op::IntXor(..) => "integer",
        Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => "shift",
        Op::IntLess(..) | Op::IntEqual(..) => "integer comparison",
        Op::ToBits(_) | Op::FromBits(_) | Op::ToInt(_) | Op::ToReal(_) => "conversion",
    }
}

/// Every experiment of the library and of its tests, by fixed methods in turn; programs that are equal once.
#[test]
fn models_of_the_library_agree() {
    let mut cases = Vec::new();
    let mut methods = [Method::Euler, Method::Rk4, Method::Expo, Method::Implicit].into_iter().cycle();
    for folder in ["stdlib-models", "tests/stdlib"] {
        for (path, text) in support::texts_below(&support::root().join(folder)) {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let loaded = compiler::load(&name, &text, &Texts::default());
            for experiment in loaded.experiments() {
                let method = methods.next().expect("it goes round");
                cases.extend(of_experiment(&name, &text, &experiment.name, method, 50));
            }
        }
    }
    let mut seen = std::collections::HashSet::new();
    cases.retain(|case| seen.insert(case.as_text()));
    println!(
        "{} programs, {} operations",
        cases.len(),
        cases.iter().flat_map(|c| &c.functions).map(|f| f.1.ops.len()).sum::<usize>()
    );
    let mut distribution = Distribution::default();
    for batch in cases.chunks(100) {
        for (case, results) in batch.iter().zip(&compare(batch, "-O0")) {
            distribution.see(case, results);
        }
    }
    distribution.tell("models of the library");
    assert!(distribution.cases > 200, "{} cases", distribution.cases);
    assert!(distribution.changed == distribution.results, "every run changes its block");
}

/// Programs of chance: seeds from 0 on; a campaign goes on where it was interrupted.
#[test]
fn programs_of_chance_agree() {
    let campaign: Option<u64> =
        std::env::var("FRIC_PROGRAMS").ok().map(|n| n.parse().expect("FRIC_PROGRAMS is a whole number"));
    let progress = Path::new(env!("CARGO_TARGET_TMPDIR")).join("agreement-chance");
    let read = || fs::read_to_string(&progress).ok()?.trim().parse().ok();
    let from: u64 = if campaign.is_some() { read().unwrap_or(0) } else { 0 };
    let end = campaign.unwrap_or(2000);
    let mut distribution = Distribution::default();
    for first in (from..end).step_by(200) {
        let next = (first + 200).min(end);
        let cases: Vec<Case> = (first..next).map(of_chance).collect();
        for (case, results) in cases.iter().zip(&compare(&cases, "-O1")) {
            distribution.see(case, results);
        }
        if campaign.is_some() {
            fs::write(&progress, next.to_string()).expect("target/ can be written");
            println!("seeds up to {next} of {end}");
        }
    }
    if from >= end {
        println!("seeds up to {from} were tried before: remove {} to begin again", progress.display());
        return;
    }
    distribution.tell(&format!("programs of chance, seeds {from} to {end}"));
    assert!(distribution.operations.len() >= 16, "operations of every kind");
    assert!(distribution.stopped * 20 > distribution.results && distribution.nan * 4 < distribution.values);
}
