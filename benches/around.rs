//! Time around the steps of a model: reading texts, observing a run, and an adaptive run with and without observers.
//! `cargo bench --bench around`.
//!
//! The model of the observed runs is so small that what remains is the cost of the engine.

mod clock;

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use clock::processor_time;
use compiler::{Case, Options, Sources};
use grammar::span::FileId;
use runtime::engine::{Continue, run};
use std::hint::black_box;

const ROUNDS: usize = 11;

/// A model of one state, and what is observed of it, one more in each experiment.
const OBSERVED: &str = "model Decay {
  state x [m] = 1 m
  dx/dt = -x / (1 s)
  output y [m] = 2 * x
}
";

/// What an experiment observes: the name of the row, and its statements.
const OBSERVERS: [(&str, &str); 5] = [
    ("nothing", ""),
    ("max", "expect max(x) > 0 m"),
    ("max, rms", "expect max(x) > 0 m\n  expect rms(x) > 0 m"),
    ("max, rms, one series", "plot x [m]\n  expect max(x) > 0 m\n  expect rms(x) > 0 m"),
    ("max, rms, two series", "plot x [m]\n  plot y [m]\n  expect max(x) > 0 m\n  expect rms(x) > 0 m"),
];

fn main() {
    reading();
    observing();
    adaptive();
}

/// Tokens and tree of the library, and of a megabyte of it.
fn reading() {
    let modules = project::Disk.modules();
    let texts = modules.iter().filter_map(|module| project::Disk.library(module)).flatten();
    let library: String = texts.map(|(_, text)| text + "\n").collect();
    let long = library.repeat((1 << 20) / library.len() + 1);
    println!("reading: ms, medians of {ROUNDS}");
    for (name, text) in [("the library", &library), ("a megabyte of it", &long)] {
        let tokens = median(|| _ = black_box(grammar::tokens::tokens(text)));
        let tree = median(|| _ = black_box(grammar::parse::parse(FileId(0), text)));
        let lines = text.lines().count();
        println!("  {name:<22} {lines:6} lines  {:8.2} tokens  {:8.2} tree", 1e3 * tokens, 1e3 * tree);
    }
}

fn case(text: &str) -> Case {
    let mut loaded = compiler::load("around.fric", text, &project::Disk);
    let mut warnings = Vec::new();
    let made = compiler::compile(&mut loaded, &project::Disk, "e", &Options::default(), &mut warnings, &mut |_| ());
    made.unwrap_or_else(|found| panic!("{found:?}\n{text}")).remove(0)
}

/// Seconds of a run, and its steps.
fn timed(case: &Case) -> (f64, u64) {
    let mut steps = 0;
    let seconds = median(|| {
        let outcome = run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(()));
        steps = outcome.expect("it runs").work.steps;
    });
    (seconds, steps)
}

fn observing() {
    println!("a step of a fixed method with observers: ns, medians of {ROUNDS}");
    for (name, statements) in OBSERVERS {
        let text = format!(
            "{OBSERVED}\nexperiment e {{\n  run    Decay() for 10 s\n  solver euler step 10 us\n  {statements}\n}}\n"
        );
        let (seconds, steps) = timed(&case(&text));
        println!("  {name:<22} {:8.1}", 1e9 * seconds / steps as f64);
    }
}

fn adaptive() {
    println!("20 s of stick-slip (Pull), adaptive: ms, medians of {ROUNDS}");
    let observers = [
        ("nothing", ""),
        ("plot of two", "plot x [m], body.v [m/s]"),
        ("and max", "plot x [m], body.v [m/s]\n  expect max(body.v) > 0 m/s"),
    ];
    for tol in ["1e-6", "1e-8"] {
        for (name, statements) in observers {
            let text = format!(
                "import std.plant\n\nexperiment e {{\n  run    Pull() for 20 s\n  solver adaptive tol {tol}\n  {statements}\n}}\n"
            );
            let (seconds, steps) = timed(&case(&text));
            println!("  tol {tol}, {name:<12} {:8.3}, {steps} steps", 1e3 * seconds);
        }
    }
}

/// Median of the processor time of a call in s.
fn median(mut call: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            let begin = processor_time();
            call();
            processor_time() - begin
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[ROUNDS / 2]
}
