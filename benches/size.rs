//! Cost against size: chains of 10 to 10,000 parts, from the text to the step. Processor time of each stage for each
//! part, and the greatest memory of the whole for each part; the last column says how the cost of the last thousand
//! parts grows with their number (1: in proportion). Run with `cargo bench --bench size`.

mod clock;

use abi::plan::Method;
use abi::{Function, Instance};
use clock::processor_time;
use compiler::{Changes, NoSources, Options, check, load};
use std::alloc::{GlobalAlloc, Layout, System};
use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

const SIZES: [usize; 4] = [10, 100, 1_000, 10_000];

/// Growth up to which time is in proportion: ten times the parts take ten to this power as long. What is done grows by
/// 1.01; the rest is the distance of the data, which no longer fit into the caches at 17 kB a part.
const NEARLY_LINEAR: f64 = 1.35;

/// The allocator of the system, which counts the bytes in use and their greatest number.
struct Counting;

static IN_USE: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: all is passed on to the allocator of the system.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = IN_USE.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        MOST.fetch_max(now, Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A chain of parts, each with a state, that feed each other.
fn chain(parts: usize) -> String {
    let mut text = String::from(
        "model P {\n  input  u [1]\n  param  k = 0.5  in > 0\n  state  x [1] = 0\n  dx/dt  = (u - k * x) / 1 s\n\
         \x20 output y [1] = x\n}\nmodel Chain {\n  part p1 = P(u = 1)\n",
    );
    for k in 2..=parts {
        text += &format!("  part p{k} = P(u = p{}.y)\n", k - 1);
    }
    text + &format!(
        "  output y [1] = p{parts}.y\n}}\nexperiment e {{\n  run Chain() for 1 s\n  solver expo step 10 ms\n  expect final(y) >= 0\n}}\n"
    )
}

/// The same as an array of parts, which share one line of text.
fn array(parts: usize) -> String {
    format!(
        "model P {{\n  input  u [1]\n  param  k = 0.5  in > 0\n  state  x [1] = 0\n  dx/dt  = (u - k * x) / 1 s\n\
         \x20 output y [1] = x\n}}\nmodel Chain {{\n  part p[i in 1 .. {parts}] = P(u = i)\n  output y [1] = sum(p.y)\n}}\n\
         experiment e {{\n  run Chain() for 1 s\n  solver expo step 10 ms\n  expect final(y) >= 0\n}}\n"
    )
}

/// The stages of one size in order, each with its time in s; the greatest number of bytes in use; and notes, such as:
/// too large for machine code.
fn measured(text: &str) -> (Vec<(&'static str, f64)>, usize, Vec<String>) {
    let before = IN_USE.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    let mut stages: Vec<(&'static str, f64)> = Vec::new();
    let mut begin = processor_time();
    let mut lap = |stages: &mut Vec<_>, stage| {
        let now = processor_time();
        stages.push((stage, now - begin));
        begin = now;
    };
    let mut loaded = load("chain.fric", text, &NoSources);
    lap(&mut stages, "parse");
    assert!(check(&mut loaded, &NoSources).is_empty());
    lap(&mut stages, "check");
    let (changes, mut warnings, options) = (Changes::default(), Vec::new(), Options::default());
    let built = compiler::build(&mut loaded, &NoSources, "e", &changes, &mut warnings);
    let program = built.map_err(|found| found.len()).expect("the chain compiles").program;
    lap(&mut stages, "lower");
    let cases = compiler::compile(
        &mut loaded,
        &NoSources,
        "e",
        &Options { interpret: true, ..options },
        &mut warnings,
        &mut |_| (),
    );
    black_box(cases.map_err(|found| found.len()).expect("the chain compiles"));
    lap(&mut stages, "compile");
    let functions = compiler::functions(&program, Method::Expo);
    lap(&mut stages, "step");
    let step: Vec<_> = functions.iter().filter(|(which, _)| *which == Function::Step).cloned().collect();
    let (machine, notes) = compiler::code(&step, &program.description, false);
    lap(&mut stages, "machine");
    let (interpreted, _) = compiler::code(&functions, &program.description, true);
    let mut instance = Instance::new(Arc::new(program.description.clone()), interpreted, &program.params);
    instance.start(1e-2);
    lap(&mut stages, "start");
    let mut fast = Instance::new(Arc::new(program.description.clone()), machine, &program.params);
    fast.block_mut().copy_from_slice(instance.block());
    const STEPS: u64 = 200;
    lap(&mut stages, "");
    assert_eq!(fast.advance(STEPS), 0);
    lap(&mut stages, "run");
    let run = stages.last_mut().expect("it was just added");
    run.1 /= STEPS as f64;
    stages.retain(|(stage, _)| !stage.is_empty());
    (stages, MOST.load(Ordering::Relaxed) - before, notes)
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

#[allow(clippy::disallowed_methods, reason = "a figure for people")]
fn table(title: &str, text: &dyn Fn(usize) -> String) {
    println!("{title}: microseconds of each stage for each part, at so many parts");
    let mut columns: Vec<Vec<(&str, f64)>> = Vec::new();
    for size in SIZES {
        let text = text(size);
        let rounds: Vec<_> = (0..if size < 1_000 { 9 } else { 3 }).map(|_| measured(&text)).collect();
        let of_stage = |k: usize| median(rounds.iter().map(|(stages, ..)| 1e6 * stages[k].1 / size as f64).collect());
        let mut column: Vec<(&str, f64)> =
            rounds[0].0.iter().enumerate().map(|(k, (stage, _))| (*stage, of_stage(k))).collect();
        column.push(("kB", median(rounds.iter().map(|(_, most, _)| *most as f64 / 1e3 / size as f64).collect())));
        columns.push(column);
        rounds[0].2.iter().for_each(|note| println!("  {size} parts: {note}"));
    }
    println!("  {:<10}{}  growth", "", SIZES.map(|size| format!("{size:>10}")).concat());
    for k in 0..columns[0].len() {
        let values: Vec<f64> = columns.iter().map(|column| column[k].1).collect();
        let growth = 1.0 + (values[3] / values[2]).log10();
        let verdict = if growth > NEARLY_LINEAR { "  more than in proportion" } else { "" };
        let numbers: String = values.iter().map(|value| format!("{value:>10.3}")).collect();
        println!("  {:<10}{numbers}  {growth:6.2}{verdict}", columns[0][k].0);
    }
}

fn main() {
    table("a chain of parts", &chain);
    table("an array of parts", &array);
}
