//! What each pass gains: all models of the library with one pass left out, over the same with all passes.
//!
//! `cargo bench --bench passes`, on a machine that does nothing else. Each figure is a geometric mean over the models; above
//! 1 the pass pays. `single` is one step a call with hoisted parameters, `several` 1,000 steps in a call, both by `expo`;
//! `adaptive` one attempt at a Rosenbrock step, or the derivatives where that does not fit; `lanes` the widest vectors of this
//! processor. The last column is the gain in the mean of the four, in percent for each hundred lines of the pass.
//! `FRIC_PASSES=sink,contract` takes only these; the compiler itself reads no such variable.

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
const ROUNDS: usize = 15;
const COLUMNS: [&str; 4] = ["single", "several", "adaptive", "lanes"];

fn main() {
    let wanted = std::env::var("FRIC_PASSES").ok();
    let is_wanted = |name: &&str| wanted.as_ref().is_none_or(|wanted| wanted.split(',').any(|other| other == *name));
    let all = PASSES.iter().map(|pass| pass.name).chain(LATE.iter().map(|pass| pass.name));
    // The loop is not left out: without it there is one iteration.
    let names: Vec<&str> = all.filter(|name| *name != "form_loop").filter(is_wanted).collect();
    // For each pass and column, the logarithms of the ratios of all models.
    let mut ratios: Vec<[Vec<f64>; 4]> = vec![Default::default(); names.len()];
    let mut models = 0;
    for module in project::Disk.modules() {
        for (name, text) in project::Disk.library(&module).into_iter().flatten() {
            let loaded = load(&name, &text, &project::Disk);
            let found: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
            for model in found {
                let Some([fixed, adaptive]) = programs(&name, &text, &model) else { continue };
                models += 1;
                let with = |off: Option<&str>| Variant::new(&fixed, &adaptive, off);
                let mut variants: Vec<Variant> =
                    [None].into_iter().chain(names.iter().copied().map(Some)).map(with).collect();
                let mut fastest = vec![[f64::INFINITY; 4]; variants.len()];
                for _ in 0..ROUNDS {
                    for (variant, fastest) in variants.iter_mut().zip(&mut fastest) {
                        let times = variant.times();
                        fastest.iter_mut().zip(times).for_each(|(fastest, time)| *fastest = fastest.min(time));
                    }
                }
                let (all, without) = fastest.split_first().expect("there is one");
                for (ratios, without) in ratios.iter_mut().zip(without) {
                    for ((ratios, without), all) in ratios.iter_mut().zip(without).zip(all) {
                        if without.is_finite() && *all > 0.0 {
                            #[allow(clippy::disallowed_methods, reason = "for people only")]
                            ratios.push((without / all).ln());
                        }
                    }
                }
            }
        }
    }
    println!("{models} models; time without a pass over time with all");
    print!("{:<18} {:>5}", "pass", "lines");
    COLUMNS.iter().for_each(|column| print!(" {column:>8}"));
    println!("  % / 100 lines");
    for (name, ratios) in names.iter().zip(ratios) {
        let lines = lines(name);
        print!("{name:<18} {lines:>5}");
        let means = ratios.map(|logarithms| logarithms.iter().sum::<f64>() / logarithms.len().max(1) as f64);
        #[allow(clippy::disallowed_methods, reason = "for people only")]
        means.iter().for_each(|mean| print!(" {:>8.3}", mean.exp()));
        println!(" {:>10.2}", 100.0 * means.iter().sum::<f64>() / 4.0 / (lines as f64 / 100.0));
    }
}

/// A model by `expo` and adaptively; none if it has an open part, which has no program.
fn programs(name: &str, text: &str, model: &str) -> Option<[Program; 2]> {
    let of = |method: Method| {
        let mut loaded = load(name, text, &project::Disk);
        let step = (method != Method::Adaptive).then_some(STEP);
        let changes = Changes { method: Some(method), step, ..Changes::default() };
        let mut program = compiler::build(&mut loaded, &project::Disk, model, &changes, &mut Vec::new()).ok()?.program;
        program.size_rings(STEP);
        Some(program)
    };
    Some([of(Method::Expo)?, of(Method::Adaptive)?])
}

/// The code of a model without one pass, and its data.
struct Variant {
    fixed: Instance,
    adaptive: Option<(Instance, Function)>,
    lanes: Option<(Batch, Arc<[f64]>)>,
}

impl Variant {
    fn new(fixed: &Program, adaptive: &Program, off: Option<&str>) -> Variant {
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

    /// Seconds a step, in the order of the columns; infinite where there is no such code.
    fn times(&mut self) -> [f64; 4] {
        let time = |count: u64, run: &mut dyn FnMut()| {
            let begun = processor_time();
            run();
            (processor_time() - begun) / count as f64
        };
        let fixed = &mut self.fixed;
        let single = time(2_000, &mut || (0..2_000).for_each(|_| _ = fixed.advance(1)));
        let several = time(2_000, &mut || _ = fixed.advance(2_000));
        let adaptive = self.adaptive.as_mut().map_or(f64::INFINITY, |(instance, function)| {
            time(500, &mut || (0..500).for_each(|_| _ = instance.call(*function)))
        });
        let lanes = self.lanes.as_mut().map_or(f64::INFINITY, |(batch, pool)| {
            let width = batch.width() as u64;
            time(500 * width, &mut || _ = batch.advance(pool, 500))
        });
        [single, several, adaptive, lanes]
    }
}

/// An instance of compiled functions; none if they are too large.
fn instance(program: &Program, functions: &[(Function, Func)], options: &Options) -> Option<Instance> {
    let layout: &Layout = &program.description.layout;
    let (machine, _) = jit::compile_with(functions, layout, program.description.pool.len(), options, true).ok()?;
    Some(Instance::new(Arc::new(program.description.clone()), Code::Machine(machine), &program.params))
}

/// Lines of the module of a pass, without its tests.
fn lines(name: &str) -> usize {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("compiler/src");
    let of_pass = ["opt", "codegen"].map(|folder| sources.join(folder).join(format!("{name}.rs")));
    let file = of_pass.into_iter().find(|file| file.is_file()).expect("a pass is a module of its name");
    let text = std::fs::read_to_string(file).expect("it is text");
    text.lines().take_while(|line| *line != "#[cfg(test)]").count()
}
