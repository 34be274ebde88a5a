//! Executable code of a program, compiled at once or function by function when it pays (tiered compilation).
//!
//! In: a [`Program`] and its method. Out: [`Code`]. The bits do not depend on when a function is compiled; only the run
//! time does.
//!
//! Compare Arnold, Fink, Grove, Hind, Sweeney, *A Survey of Adaptive Optimization in Virtual Machines*, Proc. IEEE,
//! 2005.

use crate::codegen::lanes::baseline::{self, Baseline, PAYS_AFTER};
use crate::codegen::lanes::{self, Width};
use crate::codegen::{jit, target};
use crate::ir::Func;
use crate::ir::cfg::Rows;
use crate::ir::interpret::Interpreter;
use crate::ir::program::Program;
use crate::math;
use crate::numerics::{autodiff, fixed_step, rosenbrock};
use crate::opt::guard_reduction::reduce_guards;
use crate::opt::{self, Context};
use abi::follow::Follow;
use abi::lanes::Lanes;
use abi::plan::Method;
use abi::rosenbrock::layout::Trial;
use abi::table::{Code, Interpret, Machine};
use abi::{Description, Function, Layout, Slot};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::Builder;

/// The functions that a method needs, expanded to arithmetic.
pub fn functions(program: &Program, method: Method) -> Vec<(Function, Func)> {
    let expanded = |which| Some((which, expanded(which, &function(program, method, which)?)));
    Function::ALL.into_iter().filter_map(expanded).collect()
}

/// One function, before elementary functions are expanded; none if the method does not need it.
fn function(program: &Program, method: Method, which: Function) -> Option<Func> {
    if !needs(program, method, which) {
        return None;
    }
    match which {
        Function::Start => Some(program.start.clone()),
        Function::Outputs => Some(program.outputs.clone()),
        Function::Transitions => program.transitions.clone(),
        Function::Derivatives => Some(program.derivatives.clone()),
        Function::Jacobian => Some(autodiff::jacobian(program)),
        Function::Roots => program.roots.clone(),
        Function::Tick => program.tick.clone(),
        Function::Step => Some(step(program, method)),
        Function::Rosenbrock => rosenbrock::rosenbrock(program),
    }
}

/// A function with its elementary functions expanded.
fn expanded(which: Function, func: &Func) -> Func {
    match which {
        Function::Rosenbrock => rosenbrock::pooled(&math::expand(func)),
        _ => math::expand(func),
    }
}

/// An optimised fixed step whose elementary functions are not yet expanded, as lanes need it.
///
/// # Panics
/// For the adaptive method, which has no fixed step.
pub fn step(program: &Program, method: Method) -> Func {
    let (step, context) = (fixed_step::step(program, method), Context::of(program));
    if program.left_out.is_empty() {
        return opt::optimise(step, context);
    }
    // Guard reduction is the last pass, and the only one that depends on what is guarded.
    let step = opt::optimise_without(step, context, Some("guard_reduction"));
    reduce_guards(&fixed_step::slice(&step, &program.description.guards, &program.left_out))
}

/// Compiles the steps of a method for many instances, in the widest vectors of this processor. None if there are no
/// such vectors, or no such function for the model; then each instance runs alone, with the same bits.
pub fn lanes(program: &Program, method: Method) -> Option<Lanes> {
    // An adaptive step has so many operations that more vectors would be spilled.
    let vectors = |width: Width| match (method, width) {
        (Method::Adaptive, Width::Pairs | Width::Avx512) => 2,
        (Method::Adaptive, Width::Avx | Width::Avx2) => 3,
        _ => width.vectors(),
    };
    Width::here_all().find_map(|width| lanes_of(program, method, width, vectors(width)))
}

/// As [`lanes`](lanes()) for a fixed step, with code for its loop over rows of these inputs and outputs where these vectors
/// have it.
///
/// # Panics
/// For the adaptive method.
pub fn lanes_on_rows(program: &Program, method: Method, inputs: &[Slot], outputs: &[Slot]) -> Option<Lanes> {
    let Description { layout, pool, .. } = &program.description;
    let rows = Rows { inputs: inputs.to_vec(), outputs: outputs.to_vec() };
    let step = step(program, method);
    Width::here_all().find_map(|width| {
        let vectors = width.vectors();
        let lanes = lanes_of(program, method, width, vectors)?;
        let on_rows = lanes::with_rows(lanes.clone(), &step, layout, pool.len(), (width, vectors), &rows);
        Some(on_rows.unwrap_or(lanes))
    })
}

/// The loop of a fixed step over rows of inputs and outputs. It calls the step for each row where `interpret` is set or
/// there is no machine code for the loop; the bits are the same.
///
/// # Panics
/// For the adaptive method, and as [`Follow::new`].
pub fn follow(program: &Program, method: Method, inputs: &[Slot], outputs: &[Slot], interpret: bool) -> Follow {
    let Description { layout, pool, .. } = &program.description;
    let compiled = || {
        let step = math::expand(&step(program, method));
        jit::follow(&step, layout, pool.len(), inputs, outputs).ok()
    };
    let by_calls = || Follow::new(layout, inputs, outputs);
    if interpret { by_calls() } else { compiled().unwrap_or_else(by_calls) }
}

/// The function that lanes execute for a method, before its elementary functions are expanded.
pub fn of_lanes(program: &Program, method: Method) -> Option<(Function, Func)> {
    match method {
        Method::Adaptive => Some((Function::Rosenbrock, rosenbrock::rosenbrock(program)?)),
        _ => Some((Function::Step, step(program, method))),
    }
}

/// As [`lanes`](lanes()), with a given width and number of interleaved vectors.
pub fn lanes_of(program: &Program, method: Method, width: Width, vectors: usize) -> Option<Lanes> {
    let (_, func) = of_lanes(program, method)?;
    let lanes =
        lanes::compile(&func, &program.description.layout, program.description.pool.len(), width, vectors).ok()?;
    Some(lanes.leaving_out(program.left_out.as_slice().into()))
}

/// Whether a method needs a function and the program can have it.
fn needs(program: &Program, method: Method, which: Function) -> bool {
    let adaptive = method == Method::Adaptive;
    match which {
        Function::Start | Function::Outputs => true,
        Function::Transitions => program.transitions.is_some(),
        Function::Step => !adaptive,
        Function::Derivatives | Function::Rosenbrock => adaptive,
        Function::Jacobian => adaptive && program.description.layout.jacobian.len > 0,
        Function::Tick => adaptive && program.tick.is_some(),
        Function::Roots => adaptive && program.roots.is_some(),
    }
}

/// Compiles functions. Falls back to baseline code where that fails, or else to the interpreter, with a note for the user.
pub fn code(functions: &[(Function, Func)], description: &Description, interpret: bool) -> (Code, Vec<String>) {
    let (layout, pool) = (&description.layout, description.pool.len());
    let interpreted = || Code::Interpreted(Arc::new(Interpreter::new(functions, layout, pool)));
    if interpret {
        return (interpreted(), Vec::new());
    }
    let why = match jit::compile_prepared(functions, layout, pool) {
        Ok((machine, _)) => return (Code::Machine(machine), Vec::new()),
        Err(why) => why,
    };
    match baseline::code(functions, layout, pool) {
        Ok(code) => (code, vec![format!("runs in code that is not optimised, two to three times slower: {why}")]),
        Err(_) => (interpreted(), vec![format!("runs interpreted, some twenty times slower: {why}")]),
    }
}

/// Tiered code, for runs that are not in real time: each function is built at its first call, interpreted until it has run
/// so often that [baseline code](Baseline) pays, and runs in that until it has run so often that optimised code pays.
/// This is compiled by a thread of its own while the run continues. So a model makes its first step before anything is
/// compiled, no run waits long for code, and functions that run once, such as the start, are never compiled. With
/// `interpret` it is the reference, operation by operation.
pub fn late(program: &Program, method: Method, interpret: bool) -> (Code, Vec<String>) {
    if interpret {
        return code(&functions(program, method), &program.description, true);
    }
    let size = program.derivatives.ops.len() + program.outputs.ops.len() + program.start.ops.len();
    if size <= MAX_TIERED_OPS && target::here().is_ok() {
        return (on_demand(program, method, false), Vec::new());
    }
    // A program that may be too large for Cranelift is compiled at once, so that the note about it comes at once.
    code(&functions(program, method), &program.description, false)
}

/// Like [`late`], for a program of any size: for runs that happen only on request. It is interpreted where there can be no
/// machine code.
pub fn on_demand(program: &Program, method: Method, interpret: bool) -> Code {
    let interpret = interpret || target::here().is_err();
    tiered(program, method, if interpret { Policy::NEVER } else { Policy::usual() })
}

/// Tiered code with a policy of its own.
pub fn tiered(program: &Program, method: Method, policy: Policy) -> Code {
    let (forms, recording) = Default::default();
    let functions = Functions { program: program.clone(), method, policy, forms, recording };
    Code::Interpreted(Arc::new(Tiered(Arc::new(functions))))
}

/// Maximum number of operations, before elementary functions are expanded, for which compilation surely succeeds.
const MAX_TIERED_OPS: usize = 5_000;

/// For each function, in the order of [`Function::ALL`]: the number of runs after which it is compiled; `None`: never.
/// Attempts at adaptive steps count one by one.
pub type Thresholds = [Option<u64>; Function::ALL.len()];

/// When the functions of tiered code are compiled. The bits of a run do not depend on it.
#[derive(Clone, Debug)]
pub struct Policy {
    /// Numbers of interpreted runs after which functions get baseline code.
    pub baseline_after: Thresholds,
    /// Numbers of runs, interpreted or in baseline code, after which Cranelift compiles them.
    pub compiled_after: Thresholds,
    /// Runs, at least 1, after which a call looks again whether compiling pays by now and whether there is code.
    pub runs_between_looks: u64,
    /// Whether a thread of its own compiles, while the run continues; otherwise the next call waits for it.
    pub in_background: bool,
}

impl Policy {
    /// Nothing is compiled.
    pub const NEVER: Policy = {
        let never = [None; Function::ALL.len()];
        Policy { baseline_after: never, compiled_after: never, runs_between_looks: 64, in_background: false }
    };

    /// Compiles when the runs so far have lost about as much as compiling takes. Interpreting an operation takes 2 to 4
    /// ns. Baseline code takes a tenth of that, and its compilation 0.3 µs for an operation; adaptive steps are hardly
    /// ever so few that interpreting them would pay. Cranelift takes 7 µs for an operation and saves 0.2 ns of each run;
    /// in an adaptive step 10 µs, and 0.02 ns. Where there is no baseline code, it saves nearly all that interpreting costs.
    pub fn usual() -> Policy {
        let (others, rosenbrock) = if Baseline::is_here() { (16_000, 250_000) } else { (800, 4_000) };
        let mut compiled_after = [Some(others); Function::ALL.len()];
        compiled_after[Function::Rosenbrock as usize] = Some(rosenbrock);
        let mut baseline_after = [Some(PAYS_AFTER); Function::ALL.len()];
        baseline_after[Function::Rosenbrock as usize] = Some(0);
        Policy { baseline_after, compiled_after, runs_between_looks: 64, in_background: true }
    }
}

/// Code whose functions are compiled one by one.
struct Tiered(Arc<Functions>);

/// The functions of a program, each in the tier it has reached.
struct Functions {
    program: Program,
    method: Method,
    policy: Policy,
    forms: [Forms; Function::ALL.len()],
    recording: Recording,
}

/// The fixed step in a loop that records. A program has one: its runs are those of one plan, and read the same slots.
#[derive(Default)]
struct Recording {
    /// The slots that were first asked for.
    slots: OnceLock<Box<[Slot]>>,
    /// The inner `None` means that there is no machine code for it.
    code: OnceLock<Option<Arc<Follow>>>,
    /// Whether somebody compiles it or has done so.
    is_claimed: AtomicBool,
}

/// The forms of one function, each built when it is first needed.
#[derive(Default)]
struct Forms {
    /// Before elementary functions are expanded, and afterwards.
    func: OnceLock<Option<Func>>,
    expanded: OnceLock<(Function, Func)>,
    interpreter: OnceLock<Interpreter>,
    /// The inner `None` means that this processor has none.
    baseline: OnceLock<Option<Baseline>>,
    /// The inner `None` means that the function is too large.
    machine: OnceLock<Option<Machine>>,
    /// Whether somebody compiles it or has done so.
    is_claimed: AtomicBool,
    /// Number of iterations run so far.
    runs: AtomicU64,
}

impl Functions {
    /// The function, before elementary functions are expanded.
    fn func(&self, which: Function) -> Option<&Func> {
        self.forms[which as usize].func.get_or_init(|| function(&self.program, self.method, which)).as_ref()
    }

    /// The same where it is known to exist.
    fn existing(&self, which: Function) -> &Func {
        self.func(which).unwrap_or_else(|| panic!("the code has no function `{}`", which.name()))
    }

    /// Number of attempts at adaptive steps that the function has settled by itself so far: accepted or rejected.
    fn settled(&self, which: Function, block: &[f64]) -> u64 {
        let trial = Trial::of(&self.program.description.layout).filter(|_| which == Function::Rosenbrock);
        trial.map_or(0, |trial| (block[trial.accepted().index()] + block[trial.refused().index()]) as u64)
    }

    /// Passes one function, expanded, to a back end.
    fn make<T>(&self, which: Function, back_end: impl FnOnce(&[(Function, Func)], &Layout, usize) -> T) -> T {
        let expand = || (which, expanded(which, self.existing(which)));
        let func = self.forms[which as usize].expanded.get_or_init(expand);
        back_end(std::slice::from_ref(func), &self.program.description.layout, self.program.description.pool.len())
    }

    /// Runs a function up to `count` times, interpreted or in baseline code.
    fn run(&self, which: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        let Forms { interpreter, baseline, runs, .. } = &self.forms[which as usize];
        let after = self.policy.baseline_after[which as usize];
        if after.is_some_and(|after| runs.load(Ordering::Relaxed) >= after) {
            let Description { layout, pool: constants, .. } = &self.program.description;
            let make = || Baseline::new(self.existing(which), layout, constants.len()).ok();
            if let Some(code) = baseline.get_or_init(make) {
                return code.call(block, pool, count);
            }
        }
        interpreter.get_or_init(|| self.make(which, Interpreter::new)).call(which, block, pool, count)
    }

    /// The machine code of a function, if it has been compiled and is not too large for that.
    fn machine(&self, which: Function) -> Option<&Machine> {
        self.forms[which as usize].machine.get()?.as_ref()
    }

    fn compile(&self, which: Function) {
        let make = |funcs: &[_], layout: &Layout, pool| {
            jit::compile_prepared(funcs, layout, pool).ok().map(|(machine, _)| machine)
        };
        self.forms[which as usize].machine.get_or_init(|| self.make(which, make));
    }

    fn compile_recording(&self) {
        let slots = self.recording.slots.get().expect("it was asked for");
        let make = || follow(&self.program, self.method, &[], slots, false);
        self.recording.code.get_or_init(|| Some(make()).filter(Follow::is_compiled).map(Arc::new));
    }
}

/// A step that records is compiled first. It pays to compile the step as such too after so many times as many runs.
const BESIDE_RECORDING: u64 = 2;

impl Tiered {
    /// Compiles a function if that pays by now and nobody has begun to.
    fn consider(&self, which: Function) {
        let (runs, policy) = (self.0.forms[which as usize].runs.load(Ordering::Relaxed), &self.0.policy);
        let records = which == Function::Step && self.0.recording.slots.get().is_some();
        let times = if records { BESIDE_RECORDING } else { 1 };
        let pays = policy.compiled_after[which as usize].is_some_and(|after| runs >= times * after);
        if pays && !self.0.forms[which as usize].is_claimed.swap(true, Ordering::Relaxed) {
            self.compile(move |functions| functions.compile(which));
        }
    }

    /// Compiles in a thread of its own if the policy says so. Where no thread can be had, the caller compiles.
    fn compile(&self, make: impl Fn(&Functions) + Clone + Send + 'static) {
        let (functions, own) = (self.0.clone(), make.clone());
        let background = || Builder::new().name("compiler".into()).spawn(move || own(&functions));
        if !self.0.policy.in_background || background().is_err() {
            make(&self.0);
        }
    }
}

impl Interpret for Tiered {
    fn call(&self, which: Function, block: &mut [f64], pool: &[f64], count: u64) -> u64 {
        let forms = &self.0.forms[which as usize];
        let settled = |block: &[f64]| self.0.settled(which, block);
        let mut left = count;
        loop {
            if forms.machine.get().is_none() {
                self.consider(which);
            }
            // Machine code for a single step may leave the count to the caller, who stores it only after a single step.
            let keeps_count = which != Function::Step || left > 1 || count == 1;
            if let Some(machine) = self.0.machine(which).filter(|_| keeps_count) {
                return machine.call(which, block, pool, left);
            }
            let runs = left.min(self.0.policy.runs_between_looks);
            let before = settled(block);
            let status = self.0.run(which, block, pool, runs);
            // A call for adaptive steps ends at the first step that it leaves open, most often long before `count`.
            let done = if which == Function::Rosenbrock { 1 + settled(block).saturating_sub(before) } else { runs };
            forms.runs.fetch_add(done, Ordering::Relaxed);
            left -= runs;
            if status != 0 || left == 0 {
                return status;
            }
        }
    }

    fn made(&self, which: Function) -> Option<&Machine> {
        self.0.machine(which)
    }

    fn recording(&self, outputs: &[Slot]) -> Option<Arc<Follow>> {
        let Recording { slots, code, is_claimed } = &self.0.recording;
        if **slots.get_or_init(|| outputs.into()) != *outputs {
            return None;
        }
        let runs = self.0.forms[Function::Step as usize].runs.load(Ordering::Relaxed);
        let pays = self.0.policy.compiled_after[Function::Step as usize].is_some_and(|after| runs >= after);
        if code.get().is_none() && pays && !is_claimed.swap(true, Ordering::Relaxed) {
            self.compile(Functions::compile_recording);
        }
        code.get()?.clone()
    }

    fn has(&self, which: Function) -> bool {
        needs(&self.0.program, self.0.method, which) && (which != Function::Rosenbrock || self.0.func(which).is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Value;
    use crate::ir::build::Build;
    use abi::Instance;

    const TEXT: &str = "model Contact {
  param m = 1 kg
  state x [m] = 0
  state v [m/s] = 0
  let F = tanh(v / 1 mm/s) * 1 N
  dx/dt = v
  dv/dt = (2 N * sin(t / 1 s) - F) / m
  output power [W] = F * v
}";

    fn program() -> Program {
        let mut loaded = crate::load("contact.fric", TEXT, &crate::NoSources);
        let (changes, mut warnings) = (crate::Changes::default(), Vec::new());
        let built = crate::build(&mut loaded, &crate::NoSources, "Contact", &changes, &mut warnings);
        built.map_err(|found| format!("{found:?}")).expect("it compiles").program
    }

    const CALLS: u64 = 900;

    /// The block after each of a number of calls.
    fn blocks_after_calls(code: Code, program: &Program) -> Vec<Vec<u64>> {
        let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
        assert_eq!(instance.start(1e-3), 0);
        let counts = (0..2 * CALLS).map(|_| 1).chain([CALLS + 1, 3]);
        let bits = |instance: &Instance| instance.block().iter().map(|x| x.to_bits()).collect();
        counts
            .enumerate()
            .map(|(k, count)| {
                // Parameters change now and then, before the code is compiled and afterwards.
                if k % 7 == 3 {
                    instance.set(program.description.layout.params.slot(0), 1.0 + 0.1 * k as f64);
                }
                assert_eq!(instance.advance(count), 0);
                instance.call(Function::Outputs);
                bits(&instance)
            })
            .collect()
    }

    #[test]
    fn the_bits_do_not_depend_on_when_a_function_is_compiled() {
        let program = program();
        let (interpreted, _) = late(&program, Method::Expo, true);
        let expected = blocks_after_calls(interpreted, &program);
        assert_eq!(blocks_after_calls(late(&program, Method::Expo, false).0, &program), expected);
        assert_eq!(
            blocks_after_calls(code(&functions(&program, Method::Expo), &program.description, false).0, &program),
            expected
        );
    }

    #[test]
    fn tiered_code_has_the_same_functions() {
        let program = program();
        for method in [Method::Adaptive, Method::Expo] {
            let at_once = code(&functions(&program, method), &program.description, false).0;
            let tiered = late(&program, method, false).0;
            for function in Function::ALL {
                assert_eq!(tiered.has(function), at_once.has(function), "{}", function.name());
            }
        }
    }

    /// A function of 60,000 values that are all live at once, more than pieces can hand to each other. A mutant that
    /// interprets instead has another note.
    #[test]
    fn what_is_too_large_for_cranelift_runs_in_baseline_code_with_a_note() {
        let layout = Layout::new([0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
        let (a, b) = (layout.states.slot(0), layout.states.slot(1));
        let mut build = Build::new("wide");
        let x = build.load(a);
        let factor = |k: u64| 1.0 + 1e-6 * k as f64;
        let all: Vec<Value> = (0..60_000)
            .map(|k| {
                let factor = build.real(factor(k));
                build.mul(x, factor)
            })
            .collect();
        let forth = all.iter().fold(x, |sum, value| build.add(sum, *value));
        let back = all.iter().rev().fold(forth, |sum, value| build.sub(sum, *value));
        build.store(a, back);
        build.store(b, forth);
        let functions = [(Function::Step, build.finish())];
        let description = Description { layout: layout.clone(), ..Description::default() };
        let (found, notes) = code(&functions, &description, false);
        let word = if Baseline::is_here() { "in code that is not optimised" } else { "interpreted" };
        assert!(notes.len() == 1 && notes[0].contains(word) && notes[0].contains("too large"), "{notes:?}");
        let ends = |code: Code| {
            let mut block = vec![0.5; layout.size()];
            assert_eq!(code.call(Function::Step, &mut block, &[], 3), 0);
            block.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
        };
        assert_eq!(ends(found), ends(code(&functions, &description, true).0));
    }
}
