//! What each pass gains: all models of the library with one pass left out, over the same with all passes.
//!
//! `cargo bench --bench passes`, on a machine that does nothing else. Each figure is a geometric mean; above 1 the pass
//! pays. `loops`: 2,000 steps in a call of the systems of the library's experiments, which are closed loops and driven
//! contacts. The other columns are the library's models with their inputs open: `single` is one step a call with hoisted
//! parameters, `many` 2,000 steps in a call, all three by `expo`; `adaptive` one attempt at a Rosenbrock step, or the
//! derivatives where that does not fit; `lanes` the widest vectors of this processor. The row `nothing` leaves out
//! nothing: its distance from 1 is what the measurement cannot resolve. The last column is the largest gain of the five
//! beyond that of `nothing`, in percent for each hundred lines of the pass.
//! `FRIC_PASSES=sink,contract` takes only these, and `FRIC_EACH=1` prints each system; the compiler itself reads no such
//! variable.

mod clock;
#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::lanes::Batch;
use abi::plan::Method;
use abi::{Code, Function, Instance, Layout};
use clock::processor_time;
use compiler::codegen::forms::Options;
use compiler::codegen::jit;
use compiler::codegen::lanes::{self, Width};
use compiler::codegen::passes::LATE;
use compiler::ir::Func;
use compiler::ir::program::Program;
use compiler::numerics::fixed_step;
use compiler::opt::{self, PASSES};
use compiler::{Changes, Sources, load, math};
use std::path::Path;
use std::sync::Arc;

/// Step of fixed methods, s.
const STEP: f64 = 1e-3;
/// Rounds, of which the fastest counts.
const ROUNDS: usize = 31;
const COLUMNS: [&str; 5] = ["loops", "single", "many", "adaptive", "lanes"];
/// The name of no pass.
const NOTHING: &str = "nothing";

fn main() {
    let wanted = std::env::var("FRIC_PASSES").ok();
    let is_wanted = |name: &&str| wanted.as_ref().is_none_or(|wanted| wanted.split(',').any(|other| other == *name));
    let all = PASSES.iter().map(|pass| pass.name).chain(LATE.iter().map(|pass| pass.name));
    // The loop is not left out: without it there is one iteration.
    let names: Vec<&str> =
        [NOTHING].into_iter().chain(all.filter(|name| *name != "form_loop").filter(is_wanted)).collect();
    // For each pass and column, the logarithms of the ratios of all models.
    let mut ratios: Vec<[Vec<f64>; 5]> = vec![Default::default(); names.len()];
    let (mut models, mut systems) = (0, 0);
    for module in project::Disk.modules() {
        for (name, text) in project::Disk.library(&module).into_iter().flatten() {
            let loaded = load(&name, &text, &project::Disk);
            for model in loaded.models() {
                let Some([fixed, adaptive]) = programs(&name, &text, &model.name.text) else { continue };
                models += 1;
                measure(&model.name.text, &names, &mut ratios, [false, true, true, true, true], |off| {
                    Variant::new(&fixed, &adaptive, off)
                });
            }
            for experiment in loaded.experiments() {
                let Some(fixed) = program(&name, &text, &experiment.name, Method::Expo) else { continue };
                systems += 1;
                measure(&experiment.name, &names, &mut ratios, [true, false, false, false, false], |off| {
                    Variant::of_loop(&fixed, off)
                });
            }
        }
    }
    println!("{models} models and {systems} experiments; time without a pass over time with all");
    print!("{:<20} {:>5}", "pass", "lines");
    COLUMNS.iter().for_each(|column| print!(" {column:>8}"));
    println!("  % / 100 lines");
    let mean = |logarithms: &Vec<f64>| logarithms.iter().sum::<f64>() / logarithms.len().max(1) as f64;
    let unresolved = ratios[0].each_ref().map(mean);
    for (name, ratios) in names.iter().zip(&ratios) {
        let means = ratios.each_ref().map(mean);
        let lines = lines(name);
        print!("{name:<20} {:>5}", lines.map_or(String::new(), |lines| lines.to_string()));
        #[allow(clippy::disallowed_methods, reason = "for people only")]
        means.iter().for_each(|mean| print!(" {:>8.3}", mean.exp()));
        let gain = means.iter().zip(unresolved).map(|(mean, nothing)| mean - nothing).fold(0.0, f64::max);
        println!("{}", lines.map_or(String::new(), |lines| format!(" {:>10.2}", 1e4 * gain / lines as f64)));
    }
}

/// Adds the ratios of one system to those of each pass. `wanted` are the columns to measure.
fn measure(
    system: &str,
    names: &[&str],
    ratios: &mut [[Vec<f64>; 5]],
    wanted: [bool; 5],
    variant: impl Fn(Option<&str>) -> Variant,
) {
    let offs = [None].into_iter().chain(names.iter().map(|name| (*name != NOTHING).then_some(*name)));
    let mut variants: Vec<Variant> = offs.map(variant).collect();
    let mut fastest = vec![[f64::INFINITY; 5]; variants.len()];
    for _ in 0..ROUNDS {
        for (variant, fastest) in variants.iter_mut().zip(&mut fastest) {
            let times = variant.times(wanted);
            fastest.iter_mut().zip(times).for_each(|(fastest, time)| *fastest = fastest.min(time));
        }
    }
    let (all, without) = fastest.split_first().expect("there is one");
    for ((name, ratios), without) in names.iter().zip(ratios).zip(without) {
        if std::env::var("FRIC_EACH").is_ok() {
            let each: Vec<String> =
                without.iter().zip(all).map(|(without, all)| format!("{:.3}", without / all)).collect();
            println!("{system}: {name} {}", each.join(" "));
        }
        for ((ratios, without), all) in ratios.iter_mut().zip(without).zip(all) {
            if without.is_finite() && *all > 0.0 {
                #[allow(clippy::disallowed_methods, reason = "for people only")]
                ratios.push((without / all).ln());
            }
        }
    }
}

/// A model by `expo` and adaptively; none if it has an open part, which has no program.
fn programs(name: &str, text: &str, model: &str) -> Option<[Program; 2]> {
    Some([program(name, text, model, Method::Expo)?, program(name, text, model, Method::Adaptive)?])
}

/// A model or an experiment by one method; none if it has no program by it.
fn program(name: &str, text: &str, of: &str, method: Method) -> Option<Program> {
    let mut loaded = load(name, text, &project::Disk);
    let step = (method != Method::Adaptive).then_some(STEP);
    let changes = Changes { method: Some(method), step, ..Changes::default() };
    let mut program = compiler::build(&mut loaded, &project::Disk, of, &changes, &mut Vec::new()).ok()?.program;
    program.size_rings(STEP);
    Some(program)
}

/// The code of a model without one pass, and its data.
struct Variant {
    fixed: Instance,
    adaptive: Option<(Instance, Function)>,
    lanes: Option<(Batch, Arc<[f64]>)>,
}

impl Variant {
    /// Code of an experiment that is stepped with a fixed step.
    fn of_loop(fixed: &Program, off: Option<&str>) -> Variant {
        let (fixed, _) = Variant::fixed(fixed, off);
        Variant { fixed, adaptive: None, lanes: None }
    }

    fn new(fixed: &Program, adaptive: &Program, off: Option<&str>) -> Variant {
        let options = off.map_or(Options::default(), Options::without);
        let (of_step, step) = Variant::fixed(fixed, off);
        let functions = compiler::functions(adaptive, Method::Adaptive);
        let has = |function: &Function| functions.iter().any(|(known, _)| known == function);
        let measured = [Function::Rosenbrock, Function::Derivatives].into_iter().find(has);
        let of_attempt = instance(adaptive, &functions, &options).zip(measured);
        let description = &fixed.description;
        let (layout, pool) = (&description.layout, description.pool.len());
        let compiled = |width: Width| lanes::compile(&step, layout, pool, width, width.vectors()).ok();
        let batch = Width::here().and_then(compiled).map(|lanes| {
            let mut batch = Batch::new(lanes);
            (0..batch.width()).for_each(|lane| batch.load(lane, &of_step.block()[..layout.size()]));
            (batch, description.pool.clone())
        });
        Variant { fixed: of_step, adaptive: of_attempt, lanes: batch }
    }

    /// A started instance, and its step before elementary functions are expanded.
    fn fixed(fixed: &Program, off: Option<&str>) -> (Instance, Func) {
        let options = off.map_or(Options::default(), Options::without);
        let step = opt::optimise_without(fixed_step::step(fixed, Method::Expo), opt::Context::of(fixed), off);
        let mut functions = compiler::functions(fixed, Method::Expo);
        for (function, func) in &mut functions {
            if *function == Function::Step {
                *func = math::expand(&step);
            }
        }
        let mut of_step = instance(fixed, &functions, &options).expect("a long function is one piece at worst");
        assert_eq!(of_step.start(STEP), 0);
        (of_step, step)
    }

    /// Seconds a step, in the order of the columns; infinite where a column is not wanted or there is no such code.
    fn times(&mut self, wanted: [bool; 5]) -> [f64; 5] {
        let time = |count: u64, run: &mut dyn FnMut()| {
            let begun = processor_time();
            run();
            (processor_time() - begun) / count as f64
        };
        let mut times = [f64::INFINITY; 5];
        let fixed = &mut self.fixed;
        if wanted[0] {
            times[0] = time(2_000, &mut || _ = fixed.advance(2_000));
        }
        if wanted[1] {
            times[1] = time(2_000, &mut || (0..2_000).for_each(|_| _ = fixed.advance(1)));
        }
        if wanted[2] {
            times[2] = time(2_000, &mut || _ = fixed.advance(2_000));
        }
        if let Some((instance, function)) = &mut self.adaptive {
            times[3] = time(500, &mut || (0..500).for_each(|_| _ = instance.call(*function)));
        }
        if let Some((batch, pool)) = &mut self.lanes {
            let width = batch.width() as u64;
            times[4] = time(500 * width, &mut || _ = batch.advance(pool, 500));
        }
        times
    }
}

/// An instance of compiled functions; none if they are too large.
fn instance(program: &Program, functions: &[(Function, Func)], options: &Options) -> Option<Instance> {
    let layout: &Layout = &program.description.layout;
    let (machine, _) = jit::compile_with(functions, layout, program.description.pool.len(), options, true).ok()?;
    Some(Instance::new(Arc::new(program.description.clone()), Code::Machine(machine), &program.params))
}

/// Lines of the module of a pass, without its tests; none of no pass.
fn lines(name: &str) -> Option<usize> {
    if name == NOTHING {
        return None;
    }
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("compiler/src");
    let of_pass = ["opt", "codegen"].map(|folder| sources.join(folder).join(format!("{name}.rs")));
    let file = of_pass.into_iter().find(|file| file.is_file()).expect("a pass is a module of its name");
    let text = std::fs::read_to_string(file).expect("it is text");
    Some(text.lines().take_while(|line| *line != "#[cfg(test)]").count())
}
