//! From a text to runnable cases: the only module that calls the compiler.

use abi::encode::Encode;
use abi::image::{Feature, Target};
use abi::lanes::Lanes;
pub use abi::plan::Method;
use abi::unit::Unit;
use abi::{Description, Function, Slot};
pub use compiler::analysis::dissipation::Verdict;
pub use compiler::analysis::explain::{Explanation, QuantityInfo, StepCost};
pub use compiler::analysis::linearise::{Linear, Matrices, Ports};
pub use compiler::analysis::step_stability::largest_stable;
pub use compiler::analysis::step_stability_report::stable_up_to;
pub use compiler::analysis::tuning::Tuned;
pub use compiler::codegen::c::Files as CFiles;
pub use compiler::codegen::elementary::ElementaryFunction;
use compiler::codegen::lanes;
pub use compiler::codegen::python::Dialect;
use compiler::codegen::target::{self, FunctionCompiler};
use compiler::codegen::unsupported::Unsupported;
use compiler::codegen::{c, image, jit};
pub use compiler::experiment::of_fit::HELD;
pub use compiler::experiment::spaced;
pub use compiler::experiment::vary::{PreparedRun, Varying};
pub use compiler::fit::{
    Asks, Fit, Item as FitItem, Part as FitPart, Unknown as FitUnknown, find as find_fit, single as single_fit,
};
pub use compiler::frontend::columns::{Columns, Fault, Selector, read as read_columns};
pub use compiler::frontend::names::nearest;
pub use compiler::frontend::resolve::{Lookup, Space};
pub use compiler::frontend::system::LINTS;
pub use compiler::functions::Unary;
use compiler::opt::reassociate;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub use compiler::rig::dbc_messages;
pub use compiler::rig::{StepDerivative, bus_load, linear as linear_of};
pub use compiler::{
    Built, Case, Changes, CompiledRig, Loaded, Options, SourceFile, Sources, adjustable, build, check,
    check_declarations, compile, dissipation, explain, explain_changed, explain_in, explain_rig, explain_run, fit,
    linear, load, python, quantities, rig, stepping, varying,
};
use grammar::diagnostic::Diagnostic;
use runtime::engine::sweep;
use std::time::Instant;

/// What has no effect on a run by some method.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Idle {
    /// A step: adaptive runs choose their own.
    Step,
    /// A tolerance: fixed steps have none.
    Tolerance,
}

/// Which of these that are given has no effect on a run by this method.
pub fn idle(method: Method, step: Option<f64>, tol: Option<f64>) -> Option<Idle> {
    match method {
        Method::Adaptive => step.map(|_| Idle::Step),
        _ => tol.map(|_| Idle::Tolerance),
    }
}

/// The cases as the engine runs them.
pub fn runs_of(cases: &[Case]) -> Vec<sweep::Case> {
    let one = |Case { label, instance, experiment, .. }: &Case| sweep::Case {
        label: label.clone(),
        instance: instance.clone(),
        experiment: experiment.clone(),
    };
    cases.iter().map(one).collect()
}

/// What `fric build` makes of a model.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
pub enum Emit {
    /// Readable C11, with the bits of the simulation
    C,
    /// The straight-line program
    Ir,
    /// The passes from the text to machine code, with their times and what each did
    Passes,
    /// The same as Cranelift has it
    Clif,
    /// Assembly
    Asm,
    /// A position-independent image of machine code, for `fric-rig` and other loaders
    Blob,
    /// A Python function of states, inputs and parameters, for NumPy
    Numpy,
    /// The same for JAX: gradients, many instances, other processors
    Jax,
    /// The same as a `casadi.Function`
    Casadi,
    /// The same as formulas of SymPy
    Sympy,
}

impl Emit {
    /// The dialect of Python source.
    pub fn dialect(self) -> Option<Dialect> {
        match self {
            Emit::Numpy => Some(Dialect::Numpy),
            Emit::Jax => Some(Dialect::Jax),
            Emit::Casadi => Some(Dialect::Casadi),
            Emit::Sympy => Some(Dialect::Sympy),
            Emit::C | Emit::Ir | Emit::Passes | Emit::Clif | Emit::Asm | Emit::Blob => None,
        }
    }
}

/// Emits a model or an experiment. The step of a model without experiment uses `solver`, by default `expo`; an
/// experiment uses its own. `target`: the processor, by default this one; `features`: instruction set extensions to use
/// there.
///
/// # Errors
/// Why it cannot be emitted, in words.
pub fn emit(
    built: &Built,
    emit: Emit,
    solver: Option<Method>,
    made_for: Option<Target>,
    features: &[Feature],
) -> Result<Vec<u8>, String> {
    let method = method(built, solver);
    let functions = compiler::functions(&built.program, method);
    let description = &built.program.description;
    let told = |error: Unsupported| error.to_string();
    let text = match emit {
        Emit::C if method == Method::Adaptive => return Err(no_step(description)),
        Emit::C => c::source(&functions, description, &built.program.params),
        Emit::Ir => {
            let listings: Vec<String> = functions.iter().map(|(_, func)| func.to_string()).collect();
            format!("{}\n{}", places(description, method, 1), listings.join("\n"))
        }
        Emit::Passes => passes(built, method),
        Emit::Clif | Emit::Asm => {
            let chosen = match (made_for, Target::here()) {
                (Some(made_for), _) => Some(made_for),
                (None, here) => here.filter(|_| !features.is_empty()),
            };
            let own;
            let isa = match chosen {
                Some(made_for) => {
                    own = target::with(made_for, usable(made_for, features)?);
                    &own
                }
                None => target::here().map_err(told)?,
            };
            let mut coder = FunctionCompiler::new(isa);
            let mut listings = vec![places(description, method, size_of::<f64>())];
            if emit == Emit::Asm {
                listings[0] += "; What is Cranelift's as it has that before it joins blocks and places constants.\n";
            }
            for (function, func) in &functions {
                let listing = if emit == Emit::Clif { coder.clif(func) } else { coder.assembly(func) };
                listings.push(format!("; {}\n{}", function.name(), listing.map_err(told)?));
            }
            listings.join("\n")
        }
        Emit::Blob => {
            let Some(made_for) = made_for.or(Target::here()) else {
                return Err(format!("no code is made for {}: choose a --target", std::env::consts::ARCH));
            };
            let more = usable(made_for, features)?;
            let image = image::image(&functions, description, &built.program.params, made_for, more).map_err(told)?;
            return Ok(image.to_bytes());
        }
        Emit::Numpy | Emit::Jax | Emit::Casadi | Emit::Sympy => unreachable!("`python` makes them, from the text"),
    };
    Ok(text.into_bytes())
}

/// Why an adaptive run has no C code.
fn no_step(description: &abi::Description) -> String {
    format!(
        "`{}` would be run by adaptive steps, which C code does not have: give it fixed ones, with `--solver rk4` or `solver rk4 step 1 ms` in its experiment",
        description.name
    )
}

/// C code with a header.
///
/// # Errors
/// Why there is none, in words.
pub fn c_files(built: &Built, solver: Option<Method>) -> Result<CFiles, String> {
    let method = method(built, solver);
    let description = &built.program.description;
    if method == Method::Adaptive {
        return Err(no_step(description));
    }
    Ok(c::files(&compiler::functions(&built.program, method), description, &built.program.params))
}

/// A table of the passes: what each did to the step, and how long it took.
fn passes(built: &Built, method: Method) -> String {
    let mut out = format!("; {}, by {}\n", built.program.description.name, method.name());
    out += &format!("{:<18} {:>6} {:>6} {:>6} {:>9}\n", "pass", "before", "after", "blocks", "time");
    let mut begin = Instant::now();
    compiler::codegen::pass_report::each(&built.program, method, &mut |ran| {
        let time = crate::quantity::duration(begin.elapsed().as_secs_f64(), 3);
        let [before, after] = ran.ops;
        let blocks = ran.blocks.map_or(String::new(), |blocks| blocks.to_string());
        out += &format!("{:<18} {before:>6} {after:>6} {blocks:>6} {time:>9}  {}\n", ran.name, ran.does);
        begin = Instant::now();
    });
    out
}

/// The integration method of what was built.
fn method(built: &Built, solver: Option<Method>) -> Method {
    built.solver.map(|solver| solver.method).or(solver).unwrap_or(Method::Expo)
}

/// Whether it has a delay without a ring buffer, because no step length is known, although its method has fixed steps.
pub fn unsized_delays(built: &Built, solver: Option<Method>) -> bool {
    let delays = &built.program.description.delays;
    method(built, solver) != Method::Adaptive && delays.iter().any(|delay| delay.ring.len == 0)
}

/// The header of a listing: its method, and the meaning of the addresses in the block, each the slot number times
/// `unit`.
fn places(description: &Description, method: Method, unit: usize) -> String {
    let counted = if unit == 1 { "by number" } else { "by bytes from its beginning" };
    let mut out = format!("; {}, by {}. The block, {counted}:\n", description.name, method.name());
    let fixed = [(Slot::TIME, "t, time in s"), (Slot::STEP, "h, step in s"), (Slot::COUNT, "steps since the start")];
    let fixed = fixed.into_iter().map(|(slot, what)| (slot, what.to_string()));
    let named = description.quantities.iter().map(|quantity| {
        let unit = Unit::si(quantity.unit.dimension).text;
        let unit = if quantity.boolean || unit.is_empty() { String::new() } else { format!(" [{unit}]") };
        (quantity.slot, format!("{}{unit}", quantity.path.replace('\n', " ")))
    });
    let regimes = description.automata.iter().map(|automaton| {
        let owner = if automaton.path.is_empty() { String::new() } else { format!("{}: ", automaton.path) };
        (automaton.slot, format!("{owner}regime, {}", automaton.regimes.join(" ")))
    });
    let mut told: std::collections::BTreeMap<Slot, Vec<String>> = Default::default();
    for (slot, what) in fixed.chain(named).chain(regimes) {
        told.entry(slot).or_default().push(what);
    }
    for (slot, what) in told {
        out += &format!(";   {:<5} {}\n", slot.index() * unit, what.join(", "));
    }
    out
}

/// The features, if code for the target may use them.
fn usable(target: Target, features: &[Feature]) -> Result<&[Feature], String> {
    let names = |features: &[Feature]| features.iter().map(|it| it.name()).collect::<Vec<_>>().join(", ");
    let known = |feature: &&Feature| !target.may_use().contains(feature) && !target.needs().contains(feature);
    match (features.iter().find(known), target.may_use()) {
        (None, _) => Ok(features),
        (Some(_), []) => Err(format!("code for {} uses its base alone: leave --features out", target.name())),
        (Some(other), all) => {
            Err(format!("code for {} uses no {}; it may use {}", target.name(), other.name(), names(all)))
        }
    }
}

/// The cost of a step of an experiment.
pub struct StepCode {
    /// Operations in the straight-line IR.
    pub operations: usize,
    /// Bytes of machine code.
    pub bytes: usize,
    /// Length of the longest dependency chain from one step to the next, in cycles, by latencies of current processors.
    pub critical_path: u32,
    /// The step for several instances in SIMD lanes, or why there is none.
    pub lanes: Result<Lanes, String>,
}

/// Compiles a fixed step and reports its cost.
pub fn step_code(built: &Built, method: Method) -> StepCode {
    let description = &built.program.description;
    let (layout, pool) = (&description.layout, description.pool.len());
    let step = compiler::codegen::tiering::step(&built.program, method);
    let func = compiler::math::expand(&step);
    let (operations, critical_path) = (func.ops.len(), reassociate::critical_path(&func));
    let bytes = jit::compile(&[(Function::Step, func)], layout, pool).map_or(0, |(_, stats)| stats.functions[0].2);
    let lanes = lanes::widest(&step, layout, pool).map_err(|why| why.to_string());
    StepCode { operations, bytes, critical_path, lanes }
}

/// The duration of each stage, in order of execution.
#[derive(Clone, Debug, Default)]
pub struct Stages(pub Vec<(&'static str, f64)>);

impl Stages {
    /// Total in s.
    pub fn total(&self) -> f64 {
        self.0.iter().map(|(_, seconds)| seconds).sum()
    }

    /// Adds a duration in s to a stage, which may consist of several parts, as for the cases of a sweep.
    pub fn add(&mut self, stage: &'static str, seconds: f64) {
        match self.0.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.0.push((stage, seconds)),
        }
    }
}

/// Times stages: each lasts until the next begins, or until [`Stopwatch::stop`].
pub struct Stopwatch {
    stages: Stages,
    since: Option<(&'static str, Instant)>,
}

impl Stopwatch {
    /// Starts with a stage.
    pub fn start(stage: &'static str) -> Stopwatch {
        Stopwatch { stages: Stages::default(), since: Some((stage, Instant::now())) }
    }

    /// Ends the current stage and begins another.
    pub fn stage(&mut self, stage: &'static str) {
        self.end();
        self.since = Some((stage, Instant::now()));
    }

    /// Ends the current stage.
    pub fn stop(mut self) -> Stages {
        self.end();
        self.stages
    }

    fn end(&mut self) {
        let Some((stage, since)) = self.since.take() else { return };
        self.stages.add(stage, since.elapsed().as_secs_f64());
    }
}

/// A rig compiled for a processor: its programs, as sections of a package.
pub struct PackedRig {
    /// The same rig in this process, interpreted.
    pub ready: CompiledRig,
    /// The system without the part that hardware replaces: an [`abi::image::Image`].
    pub control: Vec<u8>,
    /// The replaced part alone, also an image.
    pub plant: Vec<u8>,
    /// Which parameters may change during a run, and their constraints: [`abi::live::Live`], encoded.
    pub live: Vec<u8>,
    /// The program that evaluates these constraints: an [`abi::image::Image`].
    pub judge: Vec<u8>,
}

/// Compiles a rig for a target such as `aarch64-linux`. Only `set` of the changes is used.
///
/// # Errors
/// A message, or none if diagnostics explain it.
pub fn packed_rig(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    target: &str,
    features: &[Feature],
    changes: Changes,
    found: &mut Vec<Diagnostic>,
) -> Result<PackedRig, Option<String>> {
    let named = target.strip_suffix("-linux").and_then(Target::named);
    let Some(processor) = named else {
        let all: Vec<String> = Target::ALL.iter().map(|target| format!("{}-linux", target.name())).collect();
        return Err(Some(format!("there is no code for {target}; targets are {}", all.join(", "))));
    };
    let more = usable(processor, features).map_err(Some)?;
    let options = Options { changes, interpret: true };
    let ready = compiler::rig(loaded, sources, name, &options, found).map_err(|errors| {
        found.extend(errors);
        None
    })?;
    let image = |program: &compiler::ir::program::Program, functions: &[_]| {
        image::image(functions, &program.description, &program.params, processor, more)
            .map(|image| image.to_bytes())
            .map_err(|why| Some(why.to_string()))
    };
    let functions = compiler::functions;
    Ok(PackedRig {
        control: image(&ready.program, &functions(&ready.program, ready.rig.method))?,
        plant: image(&ready.plant_program, &functions(&ready.plant_program, Method::Expo))?,
        judge: image(&ready.judge_program, &compiler::judging(&ready.judge_program))?,
        live: ready.live.to_bytes(),
        ready,
    })
}
