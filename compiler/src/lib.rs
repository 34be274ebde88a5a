//! Compiler: from syntax trees to machine code.
//!
//! In: texts with their syntax trees ([`Loaded`]), and [`Sources`] for imports. Out: runnable instances, plans,
//! programs, and diagnostics. Opens no file and reads no clock.
//!
//! Order of the stages: resolve, flatten, unit check, causality check, lowering, numerics, optimisation, code generation.
//! Analyses run on the flat system and on the lowered program.

#![cfg_attr(test, allow(clippy::disallowed_methods, reason = "tests compare with the platform's functions"))]

pub mod interval;
pub mod functions;

pub mod ir;
pub mod math;
pub mod opt;
pub mod numerics;
pub mod codegen;

pub mod frontend;
pub mod ranges;
pub mod lower;
pub mod analysis;
pub mod pipeline;
pub mod rig;
pub mod experiment;
pub mod fit;
#[cfg(test)]
mod soundness;

pub use crate::codegen::tiering::{code, functions};
pub use crate::frontend::resolve::{ExperimentInfo, Loaded, load};
pub use crate::frontend::source::{Files, NoSources, SourceFile, Sources};
pub use experiment::Changes;

use abi::live::Check;
use abi::plan::Method;
use abi::table::Code;
use abi::{Description, Function, Instance, Slice, Slot};
use grammar::ast::Item;
use grammar::diagnostic::{Diagnostic, Recurring};
use grammar::span::FileId;
use pipeline::{Depth, analyse};
use std::sync::Arc;

/// Options of a compilation.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Changes to the experiment from outside, such as those of the command line.
    pub changes: Changes,
    /// Run the reference interpreter instead of machine code.
    pub interpret: bool,
}

/// One combination of an experiment's sweeps, ready to run.
pub struct Case {
    /// `fr = LuGre()`; empty without a sweep.
    pub label: String,
    /// The compiled instance.
    pub instance: Instance,
    /// The plan of the run.
    pub experiment: abi::plan::Experiment,
    /// Notes for the user, such as: this processor lacks instructions that machine code needs.
    pub notes: Vec<String>,
}

/// Compiles an experiment of a loaded text. Returns one case for each combination of its sweeps. Calls `on_stage` with
/// the name of each stage when the stage begins.
///
/// # Errors
/// All errors of the experiment and of the models it runs.
pub fn compile(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Vec<Case>, Vec<Diagnostic>> {
    let variants = read(loaded, sources, experiment, &options.changes, warnings, on_stage)?;
    on_stage("code");
    let mut made = None;
    let cases = variants.into_iter().map(|variant| case(variant, options.interpret, &mut made)).collect();
    Ok(cases)
}

/// Compiles an experiment once for many runs that differ in the values of the parameters in `options.changes.vary`.
/// Returns one entry for each combination of the experiment's own sweeps.
///
/// # Errors
/// All errors of the experiment and of the models it runs.
pub fn varying(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Vec<experiment::vary::Varying>, Vec<Diagnostic>> {
    let variants = read(loaded, sources, experiment, &options.changes, warnings, &mut |_| ())?;
    let varied =
        |variant: &experiment::Variant| experiment::start_values::params(&variant.system, &options.changes.vary);
    if let Some(error) = variants.iter().find_map(|variant| experiment::vary::built_in(variant, &varied(variant))) {
        return Err(vec![error]);
    }
    let one = |variant: experiment::Variant| {
        let paths = varied(&variant);
        let slice = sliced(&variant.program, &variant.experiment);
        runs(variant, slice, &paths, None, &loaded.files, options.interpret)
    };
    Ok(variants.into_iter().map(one).collect())
}

/// Compiles a fit: its experiments for many runs that differ in the values of its unknowns; once for each combination of
/// its sweeps.
///
/// # Errors
/// All errors of the fit and of the models it runs.
pub fn fit(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Vec<fit::Fit>, Vec<Diagnostic>> {
    let all = fit::read(loaded, sources, name, &options.changes, warnings)?;
    all.into_iter().map(|read| fitted(loaded, read, options)).collect()
}

/// Compiles an alternative of a fit.
fn fitted(loaded: &Loaded, read: fit::Read, options: &Options) -> Result<fit::Fit, Vec<Diagnostic>> {
    let fit::Read { label, judged, runs: all, unknowns, name, allowed } = read;
    let judged = judged.into_iter().map(|one| fitted(loaded, one, options)).collect::<Result<_, _>>()?;
    let mut parts = Vec::new();
    for fit::Run { variant, paths, held, asks, .. } in all {
        if let Some(error) = experiment::vary::built_in(&variant, &paths) {
            return Err(vec![error]);
        }
        let many = |variant: experiment::Variant, mut paths: Vec<String>, pole: Option<&str>| {
            paths.extend(pole.map(str::to_string));
            let paths = experiment::start_values::params(&variant.system, &paths);
            // It reads other quantities than measures and plots.
            let read = fit::compared_slots(&variant.experiment, &asks);
            runs(variant, None, &paths, Some(&read), &loaded.files, options.interpret)
        };
        let held = held.and_then(|variant| {
            let held = many(variant, paths.clone(), Some(experiment::held::POLE));
            let pole = held.param(experiment::held::POLE)?.slot;
            Some((held, pole))
        });
        parts.push(fit::Part { varying: many(variant, paths, None), held, asks });
    }
    Ok(fit::Fit { label, judged, parts, unknowns, name, allowed })
}

/// Compiles an experiment once for runs that differ in any of its parameters, as [`varying`] does for those that are
/// named. Parameters that determine what is compiled, such as a number of parts, keep their values: they are not among
/// [`experiment::vary::Varying::params`].
///
/// # Errors
/// All errors of the experiment and of the models it runs; an experiment that runs a rig (E0905).
pub fn adjustable(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Vec<experiment::vary::Varying>, Vec<Diagnostic>> {
    let variants = read(loaded, sources, experiment, &options.changes, warnings, &mut |_| ())?;
    if let Some(variant) = variants.iter().find(|variant| variant.rig.is_some()) {
        // The plant of a rig is a program of its own. Parameters that are named are refused with place and remedy.
        let vary =
            variant.program.description.quantities.iter().map(|quantity| quantity.path.clone()).take(1).collect();
        let changes = Changes { vary, ..options.changes.clone() };
        let refused = read(loaded, sources, experiment, &changes, warnings, &mut |_| ());
        return Err(refused.err().unwrap_or_default());
    }
    let one = |variant: experiment::Variant| {
        let description = &variant.program.description;
        let params = description.quantities.iter().filter(|q| description.layout.params.contains(q.slot));
        let mut paths: Vec<String> = params.map(|quantity| quantity.path.clone()).collect();
        paths.retain(|path| experiment::vary::built_in(&variant, std::slice::from_ref(path)).is_none());
        runs(variant, None, &paths, None, &loaded.files, options.interpret)
    };
    Ok(variants.into_iter().map(one).collect())
}

/// An experiment with its code, for runs that differ in the parameters `paths`. `slice`: the program whose step leaves
/// out what nothing in these runs reads, if there is such. `read`: what is read after each step of runs in lanes, if not
/// what the measures need.
fn runs(
    variant: experiment::Variant,
    slice: Option<ir::program::Program>,
    paths: &[String],
    read: Option<&[Slot]>,
    files: &frontend::source::Files,
    interpret: bool,
) -> experiment::vary::Varying {
    // The description keeps its ranges. The code of a fixed step drops the guards of those that the runs change.
    let mut coded = variant.program.clone();
    coded.description.guards = experiment::vary::in_code(&variant, paths);
    let method = variant.experiment.solver.method;
    let functions = functions(&coded, method);
    let (code, notes) = code(&functions, &coded.description, interpret);
    let alone = interpret || variant.experiment.bench.is_some();
    let slice = slice.map(|sliced| {
        let guards = coded.description.guards.clone();
        ir::program::Program { description: Description { guards, ..sliced.description }, ..sliced }
    });
    let many = slice.clone().unwrap_or(coded);
    let slice = slice.map(|sliced| step_of(&sliced, method, interpret));
    let adaptive = variant.adaptive.as_ref().map(|program| {
        let code = codegen::tiering::on_demand(program, Method::Adaptive, interpret);
        Arc::new(Instance::new(Arc::new(program.description.clone()), code, &program.params))
    });
    let runnable = experiment::vary::Runnable { code, slice, adaptive, notes };
    let varying = experiment::vary::Varying::new(variant, paths, files, runnable);
    let read = read.filter(|_| method != Method::Adaptive).map(<[Slot]>::to_vec);
    let lanes = |varying: &experiment::vary::Varying| match read.or(varying.read_each_step()) {
        Some(read) => codegen::tiering::lanes_on_rows(&many, method, &[], &read),
        None => codegen::tiering::lanes(&many, method),
    };
    let lanes = if alone { None } else { lanes(&varying) };
    varying.with_lanes(lanes)
}

/// A model or an experiment as one program, for uses other than a run (C, images, listings).
pub struct Built {
    /// The program.
    pub program: ir::program::Program,
    /// How an experiment is stepped; `None` for a model on its own.
    pub solver: Option<abi::plan::Solver>,
}

/// Compiles a model on its own with its inputs open, or the first combination of an experiment's sweeps. A model with
/// delays can be stepped only with `changes.step`, because the length of the kept history depends on the step.
///
/// # Errors
/// All errors of the model or experiment.
pub fn build(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
) -> Result<Built, Vec<Diagnostic>> {
    let root = loaded.root();
    let Some((model, file)) = model_of(loaded, name) else {
        let variant = first(loaded, sources, name, changes, warnings)?;
        return Ok(Built { program: variant.program, solver: Some(variant.experiment.solver) });
    };
    let given = experiment::overrides(loaded, changes, warnings);
    let overrides = given.iter().map(|change| change.override_in(root)).collect();
    let step = changes.step.filter(|_| changes.method != Some(Method::Adaptive));
    let (system, types, ()) = sound(loaded, sources, (&model, file), overrides, warnings, |system, diagnostics| {
        frontend::delays::check(system, diagnostics);
        if let Some(step) = step {
            frontend::delays::fits(system, step, None, diagnostics);
        }
    })?;
    let mut program = lower::lower(&system, &types, &[]).program;
    if let Some(step) = step.filter(|_| !program.description.delays.is_empty()) {
        program.size_rings(step);
    }
    Ok(Built { program, solver: None })
}

/// A model, or the first combination of an experiment's sweeps, as Python source: see [`codegen::python`].
///
/// # Errors
/// All errors of the model or experiment; E0911 for each statement that is no function of the present.
pub fn python(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    dialect: codegen::python::Dialect,
    warnings: &mut Vec<Diagnostic>,
) -> Result<String, Vec<Diagnostic>> {
    let root = loaded.root();
    let Some((model, file)) = model_of(loaded, name) else {
        let variant = first(loaded, sources, name, changes, warnings)?;
        let mut found = Vec::new();
        if variant.rig.is_some() {
            let place = loaded.experiments().into_iter().find(|experiment| experiment.name == name);
            let error = Diagnostic::error("E0911", "a rig is no function of the present state");
            let span = place.map_or(grammar::span::Span::new(root, 0, 0), |experiment| experiment.span);
            found.push(error.label(span, "runs a rig, which has ticks").help("name a model of it"));
        }
        analysis::explicit::check(&variant.system, dialect, &mut found);
        return if found.is_empty() {
            Ok(codegen::python::source(&variant.program, dialect))
        } else {
            Err(once(found))
        };
    };
    let given = experiment::overrides(loaded, changes, warnings);
    let overrides = given.iter().map(|change| change.override_in(root)).collect();
    let (system, types, ()) = sound(loaded, sources, (&model, file), overrides, warnings, |system, diagnostics| {
        analysis::explicit::check(system, dialect, diagnostics);
    })?;
    Ok(codegen::python::source(&lower::lower(&system, &types, &[]).program, dialect))
}

/// Prepares a model or an experiment for linearisation; `name` is the name of either. Takes the first combination of an
/// experiment's sweeps.
///
/// # Errors
/// All errors of the model or experiment.
pub fn linear(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<analysis::linearise::Linear, Vec<Diagnostic>> {
    let root = loaded.root();
    let Some((model, file)) = model_of(loaded, name) else {
        let variant = first(loaded, sources, name, &options.changes, warnings)?;
        if let Some(error) = frontend::delays::linear(&variant.system) {
            return Err(vec![error]);
        }
        let mut functions = functions(&variant.program, variant.experiment.solver.method);
        if !functions.iter().any(|(function, _)| *function == Function::Derivatives) {
            functions.push((Function::Derivatives, math::expand(&variant.program.derivatives)));
        }
        let (code, _) = code(&functions, &variant.program.description, options.interpret);
        let instance = Instance::new(Arc::new(variant.program.description.clone()), code, &variant.program.params);
        let instance = match &variant.adaptive {
            Some(program) => {
                let code = codegen::tiering::on_demand(program, Method::Adaptive, options.interpret);
                let adaptive = Instance::new(Arc::new(program.description.clone()), code, &program.params);
                instance.with_adaptive(Arc::new(adaptive))
            }
            None => instance,
        };
        let params = options.changes.ports.as_ref().map_or(&[][..], |ports| &ports.params);
        let experiment = Some(variant.experiment);
        let linear = analysis::linearise::Linear::new(&variant.program, instance, experiment, &variant.ports, params);
        let broken = options.changes.ports.as_ref().is_some_and(|ports| ports.broken.is_some());
        return Ok(if broken { linear.breaking(&variant.program) } else { linear });
    };
    let given = experiment::overrides(loaded, &options.changes, warnings);
    let overrides = given.iter().map(|change| change.override_in(root)).collect();
    let ports = options.changes.ports.clone().unwrap_or_default();
    let (system, types, opened) =
        sound(loaded, sources, (&model, file), overrides, warnings, |system, diagnostics| {
            diagnostics.extend(frontend::delays::linear(system));
            analysis::linearise::open(system, &ports, diagnostics)
        })?;
    let wanted: Vec<lower::Observed> = opened
        .outputs
        .iter()
        .map(|(path, expr)| lower::Observed { expr: *expr, text: path.clone(), unit: None })
        .collect();
    let lower::Lowered { program, observed } = lower::lower(&system, &types, &wanted);
    let slot = |path: &str| program.description.quantity(path).map(|quantity| quantity.slot);
    let inputs = opened.inputs.iter().filter_map(|(path, moved)| Some((path.clone(), slot(moved)?)));
    let outputs = opened.outputs.iter().zip(observed).map(|((path, _), slot)| (path.clone(), slot));
    let slots = (inputs.collect(), outputs.collect());
    let (code, _) = code(&functions(&program, Method::Adaptive), &program.description, true);
    let instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    let linear = analysis::linearise::Linear::new(&program, instance, None, &slots, &ports.params);
    Ok(if ports.broken.is_some() { linear.breaking(&program) } else { linear })
}

/// A rig, ready to run.
#[derive(Clone)]
pub struct CompiledRig {
    /// The plan of the rig.
    pub rig: abi::rig::Rig,
    /// The control program, with its parameters set but not started.
    pub control: Instance,
    /// The plant: the part of the model that hardware replaces, with its own `Step` by `expo`.
    pub plant: Instance,
    /// The control program before compilation, from which derivatives of its step are made.
    pub program: ir::program::Program,
    /// The plant program before compilation.
    pub plant_program: ir::program::Program,
    /// Which parameters may change during the run, and the conditions on them.
    pub live: abi::live::Live,
    /// Evaluates the numbers of those conditions from a block of parameters.
    pub judge: Instance,
    /// The program of `judge` before compilation.
    pub judge_program: ir::program::Program,
    /// Notes for the user, such as: this processor lacks instructions that machine code needs.
    pub notes: Vec<String>,
    /// The rig before it was lowered.
    cut: Arc<rig::PartitionedRig>,
}

impl CompiledRig {
    /// Sets parameters that may change while the rig runs ([`abi::live::Tunable::Live`]), SI. Afterwards its control
    /// program is the one that a start with these values would compile.
    pub fn set(&mut self, values: &[(Slot, f64)]) {
        let params = self.program.description.layout.params.range();
        for (slot, value) in values {
            self.control.set(*slot, *value);
            self.program.params[slot.index() - params.start] = *value;
        }
        if self.live.checks.is_empty() {
            return;
        }
        for (control, judge) in self.live.places() {
            self.judge.set(judge, self.control.get(control));
        }
        self.judge.call(Function::Outputs);
        // A range whose ends follow from parameters follows them.
        for check in &self.live.checks {
            let Check::Range { path, .. } = check else { continue };
            let [_, low, high] = check.numbers(self.judge.block());
            let quantities = &mut self.program.description.quantities;
            if let Some(quantity) = quantities.iter_mut().find(|quantity| quantity.path == *path) {
                quantity.range.0 = if low.is_nan() { quantity.range.0 } else { low };
                quantity.range.1 = if high.is_nan() { quantity.range.1 } else { high };
            }
        }
    }

    /// The errors of a start with the present values that the conditions on parameters ([`CompiledRig::live`]) do not
    /// include: `tune` goes beyond a range, or the fixed step is not stable. `files`: those of the text that was compiled.
    pub fn start_errors(&self, files: &Files) -> Vec<Diagnostic> {
        let beyond_range = |tuned: &abi::live::Tuned| {
            let path = &self.live.params[tuned.param].path;
            let range = self.live.checks.iter().find_map(|check| match check {
                Check::Range { path: other, low, high, .. } if other == path => {
                    let [_, least, most] = check.numbers(self.judge.block());
                    let bound = |number: f64, bound: &Option<(Slot, bool)>| {
                        bound.as_ref().map(|(_, strict)| (number, *strict)).filter(|_| !number.is_nan())
                    };
                    Some((bound(least, low), bound(most, high)))
                }
                _ => None,
            });
            let (low, high) = range?;
            let ends = [tuned.range.0, tuned.range.1].into_iter().filter(|end| end.is_finite());
            let wrong = ends.filter_map(|end| abi::live::beyond(end, low, high)).next();
            wrong.map(|_| Diagnostic::error("E0502", format!("`tune` goes beyond the range of `{path}`")))
        };
        let mut found: Vec<Diagnostic> = self.live.tuned.iter().filter_map(beyond_range).collect();
        if found.is_empty() {
            let control = (&self.cut.control, &self.cut.control_types);
            found = self.cut.stability(control, &self.rig, &self.program, files);
            found.retain(Diagnostic::is_error);
        }
        found
    }
}

/// Compiles a rig of a loaded text. Only `set` of the changes in `options` has an effect.
///
/// # Errors
/// All errors of the rig and of the models it runs.
pub fn rig(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<CompiledRig, Vec<Diagnostic>> {
    let (cut, lowered) = lowered_rig(loaded, sources, name, options, warnings)?;
    let rig::Lowered { rig, control, plant, live, judge } = lowered;
    let make = |program: &ir::program::Program, functions: &[(Function, ir::Func)]| {
        let (code, notes) = code(functions, &program.description, options.interpret);
        (Instance::new(Arc::new(program.description.clone()), code, &program.params), notes)
    };
    let (control_made, notes) = make(&control, &functions(&control, rig.method));
    let (plant_made, _) = make(&plant, &functions(&plant, Method::Expo));
    let (judge_made, _) = make(&judge, &judging(&judge));
    Ok(CompiledRig {
        rig,
        control: control_made,
        plant: plant_made,
        program: control,
        plant_program: plant,
        live,
        judge: judge_made,
        judge_program: judge,
        notes,
        cut: Arc::new(cut),
    })
}

/// The only function of a judge: its `Outputs`.
pub fn judging(judge: &ir::program::Program) -> Vec<(Function, ir::Func)> {
    vec![(Function::Outputs, math::expand(&judge.outputs))]
}

/// Compiles a rig as far as its lowered programs, and checks its steps.
fn lowered_rig(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<(rig::PartitionedRig, rig::Lowered), Vec<Diagnostic>> {
    let (cut, lowered) = cut_rig(loaded, sources, name, options, warnings)?;
    let control = (&cut.control, &cut.control_types);
    let steps = cut.steps(control, &lowered.rig, &lowered.control, &loaded.files);
    if steps.iter().any(Diagnostic::is_error) {
        return Err(steps);
    }
    warnings.extend(steps);
    Ok((cut, lowered))
}

/// A rig before and after lowering.
fn cut_rig(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
) -> Result<(rig::PartitionedRig, rig::Lowered), Vec<Diagnostic>> {
    let mut diagnostics = Vec::new();
    let overrides = experiment::overrides(loaded, &options.changes, &mut diagnostics);
    let root = loaded.root();
    let called = grammar::ast::Name { text: name.into(), span: grammar::span::Span::new(root, 0, 0) };
    let item = rig::find(loaded, root, &called).map_err(|error| vec![error])?;
    let prepared = rig::prepare(loaded, sources, item);
    let changes = overrides.iter().map(|change| change.override_in(root)).collect();
    let cut = rig::read(loaded, sources, &prepared, changes, Vec::new(), Vec::new(), &mut diagnostics);
    // Errors that follow from an unreadable declaration have been reported with the declaration.
    let lost = loaded.files.0.iter().any(|file| !file.ast.lost.is_empty());
    let Some(cut) = cut.filter(|_| !lost && !diagnostics.iter().any(Diagnostic::is_error)) else {
        return Err(once(diagnostics));
    };
    warnings.extend(diagnostics);
    let lowered = cut.lowered(warnings);
    let untunable = cut.untunable(&lowered.live);
    if untunable.is_empty() { Ok((cut, lowered)) } else { Err(untunable) }
}

/// Code of the previous case, and the program that it was made from.
struct CachedCode {
    program: ir::program::Program,
    method: Method,
    code: Code,
    /// The step without the outputs that the experiment does not read, if it has such.
    slice: Option<Slice>,
    /// Code for adaptive runs, if it differs from `code`.
    adaptive: Option<Code>,
    notes: Vec<String>,
}

impl CachedCode {
    /// Whether a program has the same code: it may differ only in the values of its parameters.
    fn fits(&self, program: &ir::program::Program, method: Method) -> bool {
        let ir::program::Program {
            description,
            params: _,
            start,
            outputs,
            derivatives,
            tick,
            transitions,
            roots,
            balanced: _,
            left_out: _,
        } = program;
        let made = &self.program;
        self.method == method
            && (&made.description, &made.start, &made.outputs) == (description, start, outputs)
            && (&made.derivatives, &made.tick) == (derivatives, tick)
            && (&made.transitions, &made.roots) == (transitions, roots)
    }

    /// The outputs that its slice leaves out.
    fn left_out(&self) -> &[Slot] {
        self.slice.as_ref().map_or(&[], |slice| &slice.left_out)
    }
}

/// The program whose fixed step leaves out the outputs that nothing in an experiment reads; none if there are no such.
fn sliced(program: &ir::program::Program, experiment: &abi::plan::Experiment) -> Option<ir::program::Program> {
    if experiment.solver.method == Method::Adaptive || experiment.bench.is_some() {
        return None;
    }
    let read = experiment.reads();
    let left_out: Vec<Slot> = program.outputs_for_readers().filter(|slot| !read.contains(slot)).collect();
    (!left_out.is_empty()).then(|| ir::program::Program { left_out, ..program.clone() })
}

/// The step of such a program.
fn step_of(sliced: &ir::program::Program, method: Method, interpret: bool) -> Slice {
    Slice { code: codegen::tiering::on_demand(sliced, method, interpret), left_out: sliced.left_out.as_slice().into() }
}

/// Makes a case runnable. Cases of a sweep over parameters differ only in numbers of the block, so each reuses the code
/// of the previous one.
fn case(variant: experiment::Variant, interpret: bool, made: &mut Option<CachedCode>) -> Case {
    let experiment::Variant { label, mut program, adaptive, mut experiment, mut rig, .. } = variant;
    let stepped = rig.as_mut().map_or(&mut program, |simulated| &mut simulated.plant);
    if experiment.solver.method != Method::Adaptive && !stepped.description.delays.is_empty() {
        stepped.size_rings_for_companions(experiment.solver.step);
    }
    let method = rig.as_ref().map_or(experiment.solver.method, |simulated| simulated.rig.method);
    let (description, params) = (Arc::new(program.description.clone()), program.params.clone());
    let slice = if rig.is_none() { sliced(&program, &experiment) } else { None };
    let left_out = slice.as_ref().map_or(&[][..], |sliced| &sliced.left_out);
    if !made.as_ref().is_some_and(|made| made.fits(&program, method) && made.left_out() == left_out) {
        let (code, notes) = codegen::tiering::late(&program, method, interpret);
        let slice = slice.map(|sliced| step_of(&sliced, method, interpret));
        let adaptive =
            adaptive.as_ref().map(|program| codegen::tiering::on_demand(program, Method::Adaptive, interpret));
        *made = Some(CachedCode { program, method, code, slice, adaptive, notes });
    }
    let CachedCode { code, slice, adaptive: adaptive_code, notes, .. } = made.as_ref().expect("it was just made");
    let mut instance = Instance::new(description, code.clone(), &params);
    if let Some(slice) = slice {
        instance = instance.with_slice(slice.clone());
    }
    if let Some((program, code)) = adaptive.zip(adaptive_code.clone()) {
        instance = instance.with_adaptive(Arc::new(Instance::new(Arc::new(program.description), code, &params)));
    }
    experiment.bench =
        rig.map(|simulated| Box::new(bench(simulated.rig, &simulated.plant, experiment.solver.method, interpret)));
    Case { label, instance, experiment, notes: notes.clone() }
}

/// The simulated surroundings of a rig for software in the loop.
fn bench(rig: abi::rig::Rig, plant: &ir::program::Program, method: Method, interpret: bool) -> abi::rig::Bench {
    let (code, _) = codegen::tiering::late(plant, method, interpret);
    abi::rig::Bench { rig, plant: Instance::new(Arc::new(plant.description.clone()), code, &plant.params) }
}

/// Decides whether a friction model dissipates, with the parameter values of an instance's arguments. Returns `None` if
/// the model does not match the interface `Friction`, or has an open part or input.
pub fn dissipation(
    loaded: &Loaded,
    sources: &dyn Sources,
    instance: &grammar::ast::Instance,
    file: FileId,
) -> Option<analysis::dissipation::Verdict> {
    use grammar::ast;
    let frontend::resolve::Lookup::Found(item, Item::Model(model)) =
        loaded.find(file, frontend::resolve::Space::Type, &instance.model.text)
    else {
        return None;
    };
    let paths: Vec<ast::Path> = instance.args.iter().map(ast::Bind::path).collect();
    let given = paths.iter().zip(&instance.args).map(|(path, bind)| frontend::flatten::Override {
        path,
        value: (&bind.value).into(),
        file,
    });
    let (system, types, diagnostics) = alone(loaded, sources, (model, item.file), given.collect(), Depth::Causality);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return None;
    }
    analysis::dissipation::dissipation(&system, &types)
}

/// Explains a model of the root file on its own.
///
/// # Errors
/// All errors of the model.
pub fn explain(
    loaded: &Loaded,
    sources: &dyn Sources,
    model: &str,
) -> Result<analysis::explain::Explanation, Vec<Diagnostic>> {
    let root = loaded.root();
    match loaded.models().into_iter().any(|candidate| candidate.name.text == model) {
        true => explain_in(loaded, sources, model, root),
        false => Err(vec![Diagnostic::error("E0201", format!("there is no model `{model}` in this file"))]),
    }
}

/// Explains a model of the root file on its own, with changes of its parameters and parts.
///
/// # Errors
/// All errors of the model and of the changes.
pub fn explain_changed(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    model: &str,
    changes: &Changes,
) -> Result<analysis::explain::Explanation, Vec<Diagnostic>> {
    if changes.set.is_empty() {
        return explain(loaded, sources, model);
    }
    let root = loaded.root();
    let Some((model, file)) = model_of(loaded, model) else {
        return Err(vec![Diagnostic::error("E0201", format!("there is no model `{model}` in this file"))]);
    };
    let mut warnings = Vec::new();
    let given = experiment::overrides(loaded, changes, &mut warnings);
    let overrides = given.iter().map(|change| change.override_in(root)).collect();
    let (system, types, ()) = sound(loaded, sources, (&model, file), overrides, &mut warnings, |_, _| ())?;
    let open = lower::lower(&system, &types, &[]).program;
    Ok(analysis::explain::explain(&system, &types, &open, (None, &[]), &loaded.files))
}

/// Explains a model of any loaded file on its own.
///
/// # Errors
/// All errors of the model, or that there is no such model.
pub fn explain_in(
    loaded: &Loaded,
    sources: &dyn Sources,
    model: &str,
    file: FileId,
) -> Result<analysis::explain::Explanation, Vec<Diagnostic>> {
    let frontend::resolve::Lookup::Found(item, Item::Model(model)) =
        loaded.find(file, frontend::resolve::Space::Type, model)
    else {
        return Err(vec![Diagnostic::error("E0201", format!("there is no model `{model}` in this file"))]);
    };
    let (system, types, diagnostics) = alone(loaded, sources, (model, item.file), Vec::new(), Depth::Causality);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return Err(once(diagnostics));
    }
    let open = lower::lower(&system, &types, &[]).program;
    // Steps are judged with the inputs that have a default at that value, as in an experiment that does not set them.
    let (system_given, types_given, found) = defaulted(loaded, sources, model, item.file, Depth::Causality);
    let given = match found.iter().any(Diagnostic::is_error) {
        true => None,
        false => Some(lower::lower(&system_given, &types_given, &[]).program),
    };
    Ok(analysis::explain::explain(&system, &types, &open, (given.as_ref(), &[]), &loaded.files))
}

/// Compiles a model of the text on its own, ready for fixed steps of `step` s, at its start with its inputs at 0.
///
/// # Errors
/// All errors of the model, or the reason why there is no machine code.
pub fn stepping(
    loaded: &Loaded,
    sources: &dyn Sources,
    model: &str,
    method: Method,
    step: f64,
) -> Result<Instance, Vec<Diagnostic>> {
    let found = loaded.models().into_iter().find(|candidate| candidate.name.text == model);
    let Some(model) = found else {
        return Err(vec![Diagnostic::error("E0201", format!("there is no model `{model}` in this file"))]);
    };
    let (system, types, mut diagnostics) = alone(loaded, sources, (model, loaded.root()), Vec::new(), Depth::Causality);
    frontend::delays::check(&system, &mut diagnostics);
    frontend::delays::fits(&system, step, None, &mut diagnostics);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return Err(once(diagnostics));
    }
    let lower::Lowered { mut program, .. } = lower::lower(&system, &types, &[]);
    program.size_rings(step);
    let (code, _) = code(&functions(&program, method), &program.description, false);
    let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    instance.start(step);
    Ok(instance)
}

/// Lists every quantity of an experiment's system, with these changes.
///
/// # Errors
/// All errors of the experiment.
pub fn quantities(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    changes: &Changes,
) -> Result<Vec<analysis::explain::QuantityInfo>, Vec<Diagnostic>> {
    let changes = Changes { any_step: true, ..changes.clone() };
    let variant = first(loaded, sources, experiment, &changes, &mut Vec::new())?;
    Ok(analysis::explain::quantities(&variant.system, &variant.types, &loaded.files))
}

/// Explains an experiment's system, with these changes.
///
/// # Errors
/// All errors of the experiment.
pub fn explain_run(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    changes: &Changes,
) -> Result<analysis::explain::Explanation, Vec<Diagnostic>> {
    let changes = Changes { any_step: true, ..changes.clone() };
    let variant = first(loaded, sources, experiment, &changes, &mut Vec::new())?;
    let ends: Vec<Slot> =
        variant.rig.iter().flat_map(|simulated| simulated.rig.stops.iter().map(|stop| stop.slot)).collect();
    let (system, types) = (&variant.system, &variant.types);
    Ok(analysis::explain::explain(system, types, &variant.program, (None, &ends), &loaded.files))
}

/// Explains the control program of a rig.
///
/// # Errors
/// All errors of the rig, except that its steps are unstable.
pub fn explain_rig(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
) -> Result<analysis::explain::Explanation, Vec<Diagnostic>> {
    let (cut, lowered) = cut_rig(loaded, sources, name, &Options::default(), &mut Vec::new())?;
    let ends: Vec<Slot> = lowered.rig.stops.iter().map(|stop| stop.slot).collect();
    let (system, types) = (&cut.control, &cut.control_types);
    Ok(analysis::explain::explain(system, types, &lowered.control, (None, &ends), &loaded.files))
}

/// Reads an experiment and checks its steps. All that runs, builds or explains an experiment reads it here, so that
/// nothing uses what `check` refuses.
fn read(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    name: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Vec<experiment::Variant>, Vec<Diagnostic>> {
    let variants = experiment::read(loaded, sources, name, changes, warnings, on_stage)?;
    if changes.any_step {
        return Ok(variants);
    }
    let (errors, more): (Vec<_>, Vec<_>) =
        steps(loaded, name, changes, &variants).into_iter().partition(Diagnostic::is_error);
    if !errors.is_empty() {
        return Err(errors);
    }
    warnings.extend(more);
    Ok(variants)
}

/// Reads an experiment and returns the first combination of its sweeps.
fn first(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    changes: &Changes,
    warnings: &mut Vec<Diagnostic>,
) -> Result<experiment::Variant, Vec<Diagnostic>> {
    let variants = read(loaded, sources, experiment, changes, warnings, &mut |_| ())?;
    Ok(variants.into_iter().next().expect("there is at least one combination"))
}

/// The model called `name` in the root file, and its file. Finds an imported model too, unless an experiment has the
/// name.
fn model_of(loaded: &Loaded, name: &str) -> Option<(grammar::ast::Model, FileId)> {
    if loaded.experiments().iter().any(|experiment| experiment.name == name) {
        return loaded.models().into_iter().find(|model| model.name.text == name).map(|m| (m.clone(), loaded.root()));
    }
    loaded.model_named(name)
}

/// A model of the text on its own, changed by `open` before the unit check. Fails if it has errors.
fn sound<T>(
    loaded: &Loaded,
    sources: &dyn Sources,
    (model, file): (&grammar::ast::Model, FileId),
    overrides: Vec<frontend::flatten::Override>,
    warnings: &mut Vec<Diagnostic>,
    open: impl FnOnce(&mut frontend::system::System, &mut Vec<Diagnostic>) -> T,
) -> Result<(frontend::system::System, frontend::units::Types, T), Vec<Diagnostic>> {
    let (system, types, mut diagnostics, opened) =
        opened(loaded, sources, (model, file), overrides, Depth::Values, open);
    diagnostics.extend(std::mem::take(warnings));
    if diagnostics.iter().any(Diagnostic::is_error) {
        return Err(once(diagnostics));
    }
    warnings.extend(diagnostics);
    Ok((system, types, opened))
}

/// A model on its own, flattened and typed, with its algebraic loops reported.
fn alone(
    loaded: &Loaded,
    sources: &dyn Sources,
    (model, file): (&grammar::ast::Model, FileId),
    overrides: Vec<frontend::flatten::Override>,
    depth: Depth,
) -> (frontend::system::System, frontend::units::Types, Vec<Diagnostic>) {
    let (system, types, diagnostics, ()) = opened(loaded, sources, (model, file), overrides, depth, |_, _| ());
    (system, types, diagnostics)
}

/// As [`alone`], but changed by `open` before the unit check.
fn opened<T>(
    loaded: &Loaded,
    sources: &dyn Sources,
    (model, file): (&grammar::ast::Model, FileId),
    overrides: Vec<frontend::flatten::Override>,
    depth: Depth,
    open: impl FnOnce(&mut frontend::system::System, &mut Vec<Diagnostic>) -> T,
) -> (frontend::system::System, frontend::units::Types, Vec<Diagnostic>, T) {
    let request = frontend::flatten::Request {
        instance: frontend::flatten::Instance::Alone(model, file),
        overrides,
        observed: Vec::new(),
        data: Vec::new(),
        frame: None,
        unknowns: Vec::new(),
    };
    let frontend::flatten::Flattened { mut system, mut diagnostics, .. } =
        frontend::flatten::flatten(loaded, sources, &request);
    let opened = open(&mut system, &mut diagnostics);
    let types = analyse(&system, &loaded.files, depth, &Diagnostic::is_error, &mut diagnostics);
    (system, types, diagnostics, opened)
}

/// Checks every item of a loaded text: each model on its own, each experiment, rig, interface, function, constant and
/// table.
pub fn check(loaded: &mut Loaded, sources: &dyn Sources) -> Vec<Diagnostic> {
    let mut all = loaded.diagnostics.clone();
    let root = loaded.root();
    let ast = loaded.files.get(root).ast.clone();
    let gaps = loaded.models().iter().any(|model| loaded.misread(model.span));
    for item in ast.items() {
        match item {
            Item::Experiment(experiment) => {
                let mut warnings = Vec::new();
                match read(loaded, sources, &experiment.name.text, &Changes::default(), &mut warnings, &mut |_| ()) {
                    Ok(_) => all.extend(warnings),
                    Err(errors) => {
                        // Declarations of an unreadable statement are missing in the experiment too; their absence is
                        // not reported again.
                        all.extend(errors.into_iter().filter(|d| !gaps || !MISSING.contains(&d.code)));
                    }
                }
            }
            Item::Fit(fit) => {
                let mut warnings = Vec::new();
                match fit::read(loaded, sources, &fit.name.text, &Changes::default(), &mut warnings) {
                    Ok(_) => all.extend(warnings),
                    Err(errors) => all.extend(errors.into_iter().filter(|d| !gaps || !MISSING.contains(&d.code))),
                }
            }
            Item::Rig(rig) => {
                let mut warnings = Vec::new();
                match lowered_rig(loaded, sources, &rig.name.text, &Options::default(), &mut warnings) {
                    Ok(_) => all.extend(warnings),
                    Err(errors) => all.extend(errors),
                }
            }
            Item::Model(_)
            | Item::Variant(_)
            | Item::Function(_)
            | Item::Const(_)
            | Item::Table(_)
            | Item::Interface(_) => {
                check_declaration(loaded, sources, item, true, &mut all);
            }
            Item::Import(_) | Item::Device(_) => {}
        }
    }
    // Names from an unreadable file are missing here; the report names only the cause.
    if loaded.diagnostics.iter().any(|d| d.is_error() && d.span().file != root) {
        all.retain(|d| d.span().file != root || !matches!(d.code, "E0201" | "E0203" | "E0204" | "E0205" | "E0206"));
    }
    once(all)
}

/// Checks the declarations of a loaded text, as [`check`] does, without the physics of friction, which only warns. Fast
/// enough to precede each run; with the check of an experiment in [`compile()`], a run finds each error that `check` finds
/// in what it uses.
pub fn check_declarations(loaded: &Loaded, sources: &dyn Sources) -> Vec<Diagnostic> {
    let mut all = Vec::new();
    for item in loaded.files.get(loaded.root()).ast.items() {
        check_declaration(loaded, sources, item, false, &mut all);
    }
    once(all)
}

/// Checks a model, function, constant, table or interface; `physics` includes the physics of friction.
fn check_declaration(loaded: &Loaded, sources: &dyn Sources, item: &Item, physics: bool, all: &mut Vec<Diagnostic>) {
    match item {
        Item::Model(model) => all.extend(check_model(loaded, sources, model, physics)),
        // Callers of a function that grows without bound grow without bound too, and would each repeat the error.
        Item::Function(_) if all.iter().any(|d| d.recurring == Some(Recurring::Operations)) => {}
        Item::Function(_) | Item::Const(_) | Item::Table(_) => {
            let flat = frontend::flatten::flatten_item(loaded, sources, loaded.root(), item);
            let mut diagnostics = flat.diagnostics;
            analyse(&flat.system, &loaded.files, Depth::Units, &Diagnostic::is_error, &mut diagnostics);
            all.extend(diagnostics);
        }
        Item::Interface(interface) => all.extend(check_interface(loaded, sources, interface)),
        Item::Variant(variant) => all.extend(check_variant(loaded, sources, variant)),
        Item::Experiment(_) | Item::Fit(_) | Item::Rig(_) | Item::Import(_) | Item::Device(_) => {}
    }
}

/// Errors that may follow from an unreadable declaration.
const MISSING: [&str; 7] = ["E0106", "E0203", "E0204", "E0205", "E0206", "E0303", "E0501"];

/// The errors of a variant on its own: what is wrong with its arguments, and what they make wrong in its model.
fn check_variant(loaded: &Loaded, sources: &dyn Sources, variant: &grammar::ast::Variant) -> Vec<Diagnostic> {
    let request = frontend::flatten::Request {
        instance: frontend::flatten::Instance::Variant(&variant.instance, loaded.root()),
        overrides: Vec::new(),
        observed: Vec::new(),
        data: Vec::new(),
        frame: None,
        unknowns: Vec::new(),
    };
    let frontend::flatten::Flattened { system, mut diagnostics, .. } =
        frontend::flatten::flatten(loaded, sources, &request);
    analyse(&system, &loaded.files, Depth::Values, &Diagnostic::is_error, &mut diagnostics);
    diagnostics.retain(Diagnostic::is_error);
    diagnostics
}

/// Limit on the combinations of one experiment whose steps are checked.
const MOST_STEPPED: usize = 4;

/// Warnings and errors about the steps and ticks of an experiment, each code once for all combinations of its sweeps.
fn steps(loaded: &Loaded, name: &str, changes: &Changes, variants: &[experiment::Variant]) -> Vec<Diagnostic> {
    use analysis::step_stability_report::StepBy;
    use grammar::ast::ExperimentStatement as Statement;
    let experiment = loaded.files.get(loaded.root()).ast.items().find_map(|item| match item {
        Item::Experiment(experiment) if experiment.name.text == name => Some(experiment),
        _ => None,
    });
    let Some(experiment) = experiment.filter(|_| !loaded.has_errors()) else { return Vec::new() };
    let run = experiment.body.iter().find_map(|statement| match statement {
        Statement::Run(run) => Some(run.instance.span),
        _ => None,
    });
    let solver = experiment.body.iter().find_map(|statement| match statement {
        Statement::Solver(solver) => Some(solver.method.span),
        _ => None,
    });
    let Some(run) = run else { return Vec::new() };
    let outside = changes.method.is_some() || changes.step.is_some();
    let said = variants.iter().take(MOST_STEPPED).flat_map(|variant| {
        let abi::plan::Solver { method, step, .. } = variant.experiment.solver;
        let (system, types, program) = (&variant.system, &variant.types, &variant.program);
        if let Some(experiment::SimulatedRig { rig, cut, .. }) = &variant.rig {
            // Warnings concern the rig, and are not repeated for each of its experiments.
            let mut found = cut.steps((system, types), rig, program, &loaded.files);
            found.retain(Diagnostic::is_error);
            return found;
        }
        let mut found = analysis::acting_mass::check(system, types, program, None, run);
        found.extend(analysis::slow_sensor::check(system, types, run));
        if method != Method::Adaptive {
            let fixed = analysis::step_stability_report::Fixed {
                system,
                types,
                program,
                method,
                step,
                place: solver.filter(|_| !outside).unwrap_or(run),
                run,
                ends: &[],
                by: if outside { StepBy::Option } else { StepBy::Text },
                name,
            };
            found.extend(analysis::step_stability_report::check(&fixed, &loaded.files));
        }
        analysis::lints::silence(system, &mut found);
        found
    });
    let mut said: Vec<Diagnostic> = said.collect();
    let allows = experiment.body.iter().filter_map(|statement| match statement {
        Statement::Allow(allow) => Some(allow.lint.text.as_str()),
        _ => None,
    });
    let allowed: Vec<&str> = allows.collect();
    said.retain(|diagnostic| {
        let lint = frontend::system::LINTS.iter().find(|(_, code)| *code == diagnostic.code);
        diagnostic.is_error() || lint.is_none_or(|(name, _)| !allowed.contains(name))
    });
    let mut codes = crate::ir::hash::HashSet::default();
    said.retain(|diagnostic| codes.insert(diagnostic.code));
    said
}

/// Checks a model of the text on its own; `physics` includes the physics of friction.
fn check_model(loaded: &Loaded, sources: &dyn Sources, model: &grammar::ast::Model, physics: bool) -> Vec<Diagnostic> {
    let file = loaded.root();
    // Proofs about a text with missing declarations would not hold.
    let whole = !loaded.has_errors();
    let depth = if whole { Depth::Domains } else { Depth::Values };
    let (system, types, mut diagnostics) = alone(loaded, sources, (model, file), Vec::new(), depth);
    if whole && !diagnostics.iter().any(Diagnostic::is_error) {
        diagnostics.extend(analysis::lints::check(&system, &types, &loaded.files, physics));
        diagnostics.extend(analysis::slow_sensor::check(&system, &types, model.name.span));
        if let Some((opened, contacts)) = analysis::pushes::open(&system, &types).filter(|_| physics) {
            let mut found = Vec::new();
            let types = analyse(&opened, &loaded.files, Depth::Causality, &Diagnostic::is_error, &mut found);
            if !found.iter().any(Diagnostic::is_error) {
                diagnostics.extend(analysis::pushes::check(&opened, &types, &contacts));
            }
        }
    }
    diagnostics.extend(with_defaults(loaded, sources, model));
    if loaded.misread(model.span) {
        // Unreadable declarations are missing elsewhere; the report names only the cause.
        let consequence = |d: &Diagnostic| {
            matches!(d.code, "E0106" | "E0203" | "E0204" | "E0301" | "E0303" | "E0305" | "E0310" | "E0501")
        };
        diagnostics.retain(|d| !consequence(d));
    }
    analysis::lints::silence(&system, &mut diagnostics);
    diagnostics
}

/// Checks the defaults of a model's inputs, which the check of the model on its own leaves open. Returns errors only.
fn with_defaults(loaded: &Loaded, sources: &dyn Sources, model: &grammar::ast::Model) -> Vec<Diagnostic> {
    use grammar::ast::{DeclarationKind, Statement};
    let given = model.body.iter().any(|statement| match statement {
        Statement::Declaration(port) => port.kind == DeclarationKind::Input && port.value.is_some(),
        _ => false,
    });
    if !given {
        return Vec::new();
    }
    let depth = if loaded.has_errors() { Depth::Values } else { Depth::Domains };
    let (_, _, mut diagnostics) = defaulted(loaded, sources, model, loaded.root(), depth);
    diagnostics.retain(Diagnostic::is_error);
    diagnostics
}

/// A model on its own, with the inputs that have a default at that value.
fn defaulted(
    loaded: &Loaded,
    sources: &dyn Sources,
    model: &grammar::ast::Model,
    file: FileId,
    depth: Depth,
) -> (frontend::system::System, frontend::units::Types, Vec<Diagnostic>) {
    let request = frontend::flatten::Request {
        instance: frontend::flatten::Instance::WithDefaults(model, file),
        overrides: Vec::new(),
        observed: Vec::new(),
        data: Vec::new(),
        frame: None,
        unknowns: Vec::new(),
    };
    let frontend::flatten::Flattened { system, mut diagnostics, .. } =
        frontend::flatten::flatten(loaded, sources, &request);
    let types = analyse(&system, &loaded.files, depth, &Diagnostic::is_error, &mut diagnostics);
    (system, types, diagnostics)
}

/// Checks the ports of an interface: their units, defaults and ranges.
fn check_interface(loaded: &Loaded, sources: &dyn Sources, interface: &grammar::ast::Interface) -> Vec<Diagnostic> {
    use grammar::ast::{DeclarationKind, Model, Statement};
    let grammar::ast::Interface { name, ports, doc, span } = interface.clone();
    // An output has no equation here, so it is checked as an input, provided that it states its unit.
    let port = |port: grammar::ast::Declaration| {
        let stated = port.kind == DeclarationKind::Input || port.unit.is_some();
        stated.then_some(Statement::Declaration(grammar::ast::Declaration { kind: DeclarationKind::Input, ..port }))
    };
    let model = Model { name, body: ports.into_iter().filter_map(port).collect(), doc, span };
    let (_, _, mut diagnostics) = alone(loaded, sources, (&model, loaded.root()), Vec::new(), Depth::Values);
    diagnostics.extend(with_defaults(loaded, sources, &model));
    diagnostics.retain(Diagnostic::is_error);
    diagnostics
}

/// Removes repetitions: keeps each code once per position, sorts by position, and drops warnings if there are errors.
pub fn once(mut diagnostics: Vec<Diagnostic>) -> Vec<Diagnostic> {
    let errors = diagnostics.iter().any(Diagnostic::is_error);
    diagnostics.retain(|diagnostic| !errors || diagnostic.is_error());
    let mut seen = crate::ir::hash::HashSet::default();
    let mut circles = crate::ir::hash::HashSet::default();
    diagnostics.retain(|diagnostic| {
        // A cycle is found from each of its members; only the first is reported. The same holds for a program that
        // grows without bound, which is reported at each use.
        let again = diagnostic.recurring.is_some_and(|recurring| !circles.insert(recurring));
        seen.insert((diagnostic.code, diagnostic.span())) && !again
    });
    diagnostics.sort_by_key(|diagnostic| diagnostic.span());
    diagnostics
}
