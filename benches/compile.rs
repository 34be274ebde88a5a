//! Compile time of a text, from its first character to its first step, by stage, in a warm process; the time to check
//! and compile the whole library; and the cost of many elements in one model. Medians of processor time over several
//! rounds; run with `cargo bench --bench compile`. How cost grows with size: `cargo bench --bench size`.

mod clock;

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::plan::Method;
use abi::{Function, Instance};
use clock::processor_time;
use compiler::{Changes, NoSources, Options, Sources, check, load};
use std::hint::black_box;
use std::sync::Arc;

const ROUNDS: usize = 60;

/// The PID servo with LuGre friction from the library.
const SERVO: &str = "import std.interfaces
import std.friction
import std.control
import std.plant

experiment hunting {
  run    Servo(r = 1 m) for 100 s
  solver rk4 step 10 us
  expect peak_to_peak(x) ~= 126.4 mm +- 0.2 mm after 50 s
}
";

fn main() {
    stages();
    library();
    lines();
    elements();
}

/// Milliseconds of each stage, in order of execution.
fn stages() {
    let mut all: Vec<(&'static str, Vec<f64>)> = Vec::new();
    for _ in 0..ROUNDS {
        let mut marks: Vec<(&'static str, f64)> = vec![("parse", processor_time())];
        let mut loaded = load("servo.fric", SERVO, &project::Disk);
        let (mut warnings, options) = (Vec::new(), Options::default());
        let mut mark = |stage| marks.push((stage, processor_time()));
        let cases = compiler::compile(&mut loaded, &project::Disk, "hunting", &options, &mut warnings, &mut mark);
        let Ok(mut cases) = cases else { panic!("the servo compiles") };
        marks.push(("first step", processor_time()));
        let instance = &mut cases[0].instance;
        instance.start(1e-5);
        assert_eq!(instance.advance(1), 0);
        black_box(&instance);
        marks.push(("", processor_time()));
        for pair in marks.windows(2) {
            let ms = 1e3 * (pair[1].1 - pair[0].1);
            match all.iter_mut().find(|(stage, _)| *stage == pair[0].0) {
                Some((_, times)) => times.push(ms),
                None => all.push((pair[0].0, vec![ms])),
            }
        }
    }
    println!("PID servo with LuGre, rk4: from text to first step, the library's texts it imports included");
    let mut sum = 0.0;
    for (stage, times) in &mut all {
        let ms = median(times);
        sum += ms;
        println!("  {stage:<12} {ms:8.3} ms");
    }
    println!("  {:<12} {sum:8.3} ms", "together");
}

/// The whole library as one text, by operation.
fn library() {
    let modules = project::Disk.modules();
    let texts: Vec<(String, String)> =
        modules.iter().filter_map(|module| project::Disk.library(module)).flatten().collect();
    let without_imports = |text: &str| -> String {
        text.lines().filter(|line| !line.starts_with("import ")).map(|line| format!("{line}\n")).collect()
    };
    let whole: String = texts.iter().map(|(_, text)| without_imports(text)).collect();
    let read = || load("library.fric", &whole, &NoSources);
    let names: Vec<String> = read().models().iter().map(|model| model.name.text.clone()).collect();
    println!("the library: {} texts of {} lines, {} models", texts.len(), whole.lines().count(), names.len());
    let timed = |what: &str, rounds: usize, work: &dyn Fn()| {
        let mut times: Vec<f64> = (0..rounds)
            .map(|_| {
                let begin = processor_time();
                work();
                1e3 * (processor_time() - begin)
            })
            .collect();
        println!("  {what:<62} {:6.1} ms", median(&mut times));
    };
    let checked = |loaded: &compiler::Loaded| {
        let found = compiler::check_declarations(loaded, &NoSources);
        assert!(found.iter().all(|found| !found.is_error()), "{found:?}");
    };
    let built = |mut loaded: compiler::Loaded, work: &dyn Fn(&compiler::ir::program::Program)| {
        for model in &names {
            let (changes, mut warnings) = (Changes::default(), Vec::new());
            // A model with an open slot cannot run alone.
            if let Ok(mut built) = compiler::build(&mut loaded, &NoSources, model, &changes, &mut warnings) {
                built.program.size_rings(1e-3);
                work(&built.program);
            }
        }
    };
    timed("read", 15, &|| {
        black_box(read());
    });
    timed("read and checked, from the text to values", 15, &|| checked(&read()));
    let first_step = |program: &compiler::ir::program::Program| {
        let (code, _) = compiler::codegen::tiering::late(program, Method::Expo, false);
        let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
        instance.start(1e-3);
        instance.advance(1);
    };
    timed("read, checked and compiled, to the first step by `expo`", 15, &|| {
        let loaded = read();
        checked(&loaded);
        built(loaded, &first_step);
    });
    timed("the same, to machine code of that step", 5, &|| {
        let loaded = read();
        checked(&loaded);
        built(loaded, &|program| {
            let step = compiler::math::expand(&compiler::codegen::tiering::step(program, Method::Expo));
            black_box(compiler::code(&[(Function::Step, step)], &program.description, false));
        });
    });
    timed("the same, to machine code of all functions", 5, &|| {
        let loaded = read();
        checked(&loaded);
        built(loaded, &|program| {
            let functions = compiler::functions(program, Method::Expo);
            black_box(compiler::code(&functions, &program.description, false));
        });
    });
    timed("checked text by text, each with what it imports read anew", 5, &|| {
        for (name, text) in &texts {
            let loaded = load(name, text, &project::Disk);
            black_box(compiler::check_declarations(&loaded, &project::Disk));
        }
    });
    timed("the same with experiments and the physics of friction", 5, &|| {
        for (name, text) in &texts {
            let mut loaded = load(name, text, &project::Disk);
            black_box(check(&mut loaded, &project::Disk));
        }
    });
}

/// A text of 1,000 equations, from its first character to its last warning.
fn lines() {
    let mut text = String::from("model M {\n  input v [m/s]\n  param a = 1 1/s\n  let x0 [m/s] = v\n");
    for k in 1..1000 {
        text += &format!("  let x{k} [m/s] = a * x{} / 1 1/s + v   // line {k}\n", k - 1);
    }
    text += "  output y [m/s] = x999\n}\n";
    let mut times: Vec<f64> = (0..15)
        .map(|_| {
            let begin = processor_time();
            let mut loaded = load("lines.fric", &text, &project::Disk);
            assert!(check(&mut loaded, &project::Disk).is_empty());
            1e3 * (processor_time() - begin)
        })
        .collect();
    println!("checking a text of 1,000 equations: {:.1} ms", median(&mut times));
}

/// A model of many parallel LuGre elements: time of its machine code and of its steps, per element.
fn elements() {
    println!(
        "so many LuGre elements in one model: machine code of an `expo` step, a step of many in a call, one step a call"
    );
    for n in [1, 10, 100, 1_000] {
        let text = format!(
            "import std.friction\nmodel Surface {{\n  input  v [m/s] = 10 um/s\n  part   el[i in 1 .. {n}] = LuGre(v = v)\n\
             \x20 output F [N] = sum(el.F)\n}}\n"
        );
        let mut loaded = load("surface.fric", &text, &project::Disk);
        let (changes, mut warnings) = (Changes::default(), Vec::new());
        let built = compiler::build(&mut loaded, &project::Disk, "Surface", &changes, &mut warnings);
        let program = built.map_err(|found| format!("{found:?}")).expect("it compiles").program;
        let step =
            [(Function::Step, compiler::math::expand(&compiler::codegen::tiering::step(&program, Method::Expo)))];
        let (mut compiled, mut stepped, mut alone) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..if n < 1_000 { 9 } else { 3 } {
            let begin = processor_time();
            let (code, notes) = compiler::code(&step, &program.description, false);
            compiled.push(1e6 * (processor_time() - begin) / f64::from(n));
            assert!(notes.is_empty(), "{notes:?}");
            let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
            instance.set(abi::Slot::STEP, 1e-3);
            let steps = 200_000 / u64::from(n as u32);
            let begin = processor_time();
            assert_eq!(instance.advance(steps), 0);
            stepped.push(1e9 * (processor_time() - begin) / (steps as f64 * f64::from(n)));
            // As in a rig: a new input for each step, so that nothing is computed once for many.
            let begin = processor_time();
            for _ in 0..steps {
                assert_eq!(instance.advance(1), 0);
            }
            alone.push(1e9 * (processor_time() - begin) / (steps as f64 * f64::from(n)));
        }
        let operations = step[0].1.ops.len() / n as usize;
        println!(
            "  {n:>6}  {operations:6} operations  {:9.1} us  {:9.2} ns  {:9.2} ns, each element",
            median(&mut compiled),
            median(&mut stepped),
            median(&mut alone)
        );
    }
}

fn median(times: &mut [f64]) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
