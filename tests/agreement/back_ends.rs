//! Runs cases on every back end: each must produce the bits of the interpreter.

use crate::case::{Case, Result};
use crate::emulator;
use abi::image::Target;
use abi::lanes::Batch;
use abi::table::{Code, Function, Interpret};
use abi::{Description, Slot};
use compiler::codegen::lanes::baseline::{self, Baseline};
use compiler::codegen::lanes::{self, Width};
use compiler::codegen::{c, image, jit};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The common result of all back ends.
pub struct Agreed {
    /// The result of each run of the case.
    pub results: Vec<Result>,
    /// The widths of lanes that took part; empty where the case has no code for lanes.
    pub lanes: Vec<&'static str>,
}

/// Runs cases on every back end, C at this optimisation level (gcc takes long for long functions); panics at the first
/// difference, with the program.
pub fn compare(cases: &[Case], level: &str) -> Vec<Agreed> {
    let expected: Vec<Vec<Result>> = cases.iter().map(Case::interpreted).collect();
    let hold = |back_end: &str, results: Vec<Vec<Result>>| {
        for ((case, expected), found) in cases.iter().zip(&expected).zip(&results) {
            agree(case, expected, found, back_end);
        }
    };
    // gcc and the emulator take as long as all the others together.
    let agreed = std::thread::scope(|scope| {
        let c = scope.spawn(|| compiled_c(cases, level));
        let arm = scope.spawn(|| emulated(cases));
        let agreed = on_this_processor(cases, &expected);
        for (back_end, thread) in [("C", c), ("an image for 64-bit Arm", arm)] {
            hold(back_end, thread.join().unwrap_or_else(|why| std::panic::resume_unwind(why)));
        }
        agreed
    });
    expected.into_iter().zip(agreed).map(|(results, lanes)| Agreed { results, lanes }).collect()
}

/// Back ends in this process: baseline code, lanes, machine code in memory, an image. Returns the widths of lanes that took
/// part in each case.
fn on_this_processor(cases: &[Case], expected: &[Vec<Result>]) -> Vec<Vec<&'static str>> {
    let widths: Vec<Width> = Width::ALL.into_iter().filter(|width| width.is_here()).collect();
    let here = Target::here().expect("tests run where code is made for");
    let one = |(case, expected): (&Case, &Vec<Result>)| {
        if Baseline::is_here() {
            let code = baseline::code(&case.functions, case.layout(), case.description.pool.len());
            let code = code.unwrap_or_else(|why| panic!("{}: {why}", case.name));
            agree(case, expected, &case.on(&code), "baseline code");
        }
        let machine = jit::compile_prepared(&case.functions, case.layout(), case.description.pool.len());
        let code = Code::Machine(machine.unwrap_or_else(|why| panic!("{}: {why}", case.name)).0);
        agree(case, expected, &case.on(&code), "machine code in memory");
        // SAFETY: the compiler has just made it.
        let model = unsafe { runtime::image::load(&image(case, here)) };
        let code = model.unwrap_or_else(|why| panic!("{}: {why}", case.name)).code;
        agree(case, expected, &case.on(&code), "an image for this processor");
        let took_part = |width: &&Width| {
            let results = in_lanes(case, **width);
            results.is_some_and(|results| {
                agree(case, expected, &results, &format!("a lane of {}", width.name()));
                true
            })
        };
        widths.iter().filter(took_part).map(|width| width.name()).collect()
    };
    cases.iter().zip(expected).map(one).collect()
}

/// Compares the results of a case with those of the interpreter.
fn agree(case: &Case, expected: &[Result], found: &[Result], back_end: &str) {
    assert_eq!(expected.len(), found.len(), "{}: {back_end} has lost a run", case.name);
    for (k, (expected, found)) in expected.iter().zip(found).enumerate() {
        if same(expected, found) {
            continue;
        }
        let differing = expected.1.iter().zip(&found.1).enumerate().filter(|(_, (a, b))| !equal(**a, **b));
        let slots: Vec<String> = differing.map(|(at, (a, b))| format!("slot {at}: {b:e} instead of {a:e}")).collect();
        panic!(
            "{}: {back_end} differs in run {k}, calls {:?}\nstatus {} instead of {}\n{}\nfrom {:?}\n{}\n{}",
            case.name,
            case.runs[k].calls,
            found.0,
            expected.0,
            slots.join("\n"),
            case.runs[k].start,
            case.text,
            case.listing()
        );
    }
}

/// Equal to the bit, with all NaN as one value.
fn equal(a: f64, b: f64) -> bool {
    a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan()
}

/// The same status, and every number equal.
fn same(a: &Result, b: &Result) -> bool {
    a.0 == b.0 && a.1.len() == b.1.len() && a.1.iter().zip(&b.1).all(|(a, b)| equal(*a, *b))
}

/// The results of each run in the last lane of a batch of copies; none if there is no code for lanes. Functions other
/// than the fixed step are interpreted in between.
fn in_lanes(case: &Case, width: Width) -> Option<Vec<Result>> {
    let pool = &case.description.pool;
    let (in_lanes, step) = case.step.as_ref()?;
    let lanes = lanes::compile(step, case.layout(), pool.len(), width, width.vectors()).ok()?;
    let alone = case.interpreter();
    let mut batch = Batch::new(lanes);
    let last = batch.width() - 1;
    let mut call = |function: Function, block: &mut [f64], count: u64| {
        if function != *in_lanes {
            return alone.call(function, block, pool, count);
        }
        (0..=last).for_each(|lane| batch.load(lane, block));
        batch.advance(pool, count);
        batch.save(last, block);
        batch.status(last)
    };
    Some(case.runs.iter().map(|run| run.by(&mut call)).collect())
}

fn image(case: &Case, target: Target) -> Vec<u8> {
    let image = image::image(&case.functions, &case.description, &case.params, target, &[]);
    image.unwrap_or_else(|why| panic!("{}: {why}", case.name)).to_bytes()
}

/// A path unique to this test.
pub fn scratch(what: &str) -> PathBuf {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    let next = NEXT.fetch_add(1, Ordering::Relaxed);
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("agreement-{}-{next}-{what}", std::process::id()))
}

/// All cases as one C file, compiled with warnings as errors.
fn compiled_c(cases: &[Case], level: &str) -> Vec<Vec<Result>> {
    let mut text = String::new();
    for (k, case) in cases.iter().enumerate() {
        let description = Description { name: format!("Case{k}"), ..case.description.clone() };
        let mut source = c::source(&case.functions, &description, &case.params);
        // Each case is written as a file of its own: here they share one, so helper names are made unique.
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
        let call = |function: Function, block: &mut [f64], count: u64| {
            let name = format!("case{k}_{}", function.name());
            // SAFETY: the file just written has a function of this name and type, which stays in the block.
            unsafe {
                type Entry = unsafe extern "C" fn(*mut f64, u64) -> u64;
                let entry = loaded.get::<Entry>(name.as_bytes()).expect("the function is in the file");
                entry(block.as_mut_ptr(), count)
            }
        };
        case.runs.iter().map(|run| run.by(call)).collect()
    });
    let results = results.collect();
    let _ = (fs::remove_file(source), fs::remove_file(library));
    results
}

/// All cases as images for 64-bit Arm, in one run of the emulator.
fn emulated(cases: &[Case]) -> Vec<Vec<Result>> {
    assert_eq!((Function::Step as usize, Slot::COUNT.index()), (7, 2), "the numbers in harness.c");
    let mut bytes = Vec::new();
    let number = |bytes: &mut Vec<u8>, n: usize| bytes.extend((n as u64).to_le_bytes());
    number(&mut bytes, cases.len());
    for case in cases {
        let image = image(case, Target::Aarch64);
        number(&mut bytes, image.len());
        bytes.extend(&image);
        number(&mut bytes, case.layout().size());
        number(&mut bytes, case.runs.len());
        for run in &case.runs {
            number(&mut bytes, run.calls.len());
            for (function, count) in &run.calls {
                number(&mut bytes, *function as usize);
                number(&mut bytes, *count as usize);
            }
            run.start.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        }
    }
    let (input, output) = (scratch("cases"), scratch("results"));
    fs::write(&input, bytes).unwrap();
    emulator::run(&input, &output);
    let bytes = fs::read(&output).unwrap();
    let _ = (fs::remove_file(input), fs::remove_file(output));
    let mut words = bytes.chunks_exact(8).map(|word| u64::from_le_bytes(word.try_into().unwrap()));
    let mut one = |case: &Case| {
        let status = words.next().expect("a result for each run");
        (status, (0..case.layout().size()).map(|_| f64::from_bits(words.next().expect("all slots"))).collect())
    };
    cases.iter().map(|case| case.runs.iter().map(|_| one(case)).collect()).collect()
}
