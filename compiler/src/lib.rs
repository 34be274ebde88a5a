//! Syntax tree to machine code: resolve, flatten, check, lower, and the back ends.
//!
//! Text in, values out: no files, no clock.

pub mod ir;
pub mod math;
pub mod opt;
pub mod program;
pub mod derive;
pub mod discretize;
pub mod backend;

pub mod names;
pub mod source;
pub mod resolve;
pub mod system;
pub mod tables;
pub mod flatten;
pub mod units;
pub mod causality;
pub mod lower;
pub mod checks;
pub mod interval;
pub mod domains;
pub mod friction;
pub mod lints;
pub mod experiment;

pub use experiment::Changes;
pub use resolve::{ExperimentInfo, Loaded, load};
pub use source::{Files, NoSources, SourceFile, Sources};

use abi::plan::Method;
use abi::table::Code;
use abi::{Function, Instance};
use grammar::ast::Item;
use grammar::diagnostic::Diagnostic;
use grammar::span::FileId;
use std::sync::Arc;

/// How to compile.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Changes to the experiment.
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
    /// What to run.
    pub experiment: abi::plan::Experiment,
    /// What the user should know: a processor without what machine code needs.
    pub notes: Vec<String>,
}

/// Compiles an experiment of a loaded text: one case for each combination of its sweeps. `on_stage` is called with the
/// name of each stage when it begins.
///
/// # Errors
/// Everything that is wrong with the experiment and the models it runs.
pub fn compile(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    experiment: &str,
    options: &Options,
    warnings: &mut Vec<Diagnostic>,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Vec<Case>, Vec<Diagnostic>> {
    let variants = experiment::read(loaded, sources, experiment, &options.changes, warnings, on_stage)?;
    on_stage("code");
    let mut made = None;
    let cases = variants.into_iter().map(|variant| case(variant, options.interpret, &mut made)).collect();
    Ok(cases)
}

/// Code of the last case, and what it was made from.
struct Made {
    functions: Vec<(Function, ir::Func)>,
    layout: abi::description::Layout,
    pool: Arc<[f64]>,
    code: Code,
    notes: Vec<String>,
}

impl Made {
    /// Whether the code of a program with these functions is the same. Numbers are compared by their bits.
    fn fits(&self, functions: &[(Function, ir::Func)], description: &abi::Description) -> bool {
        let bits = |pool: &[f64]| pool.iter().map(|number| number.to_bits()).collect::<Vec<_>>();
        self.layout == description.layout
            && bits(&self.pool) == bits(&description.pool)
            && self.functions.len() == functions.len()
            && self.functions.iter().zip(functions).all(|(a, b)| a == b)
    }
}

/// Cases of a sweep over parameters differ in numbers of the block only: they share the code of the one before.
fn case(variant: experiment::Variant, interpret: bool, made: &mut Option<Made>) -> Case {
    let program = &variant.program;
    let functions = functions(program, variant.experiment.solver.method);
    let (code, notes) = match made {
        Some(made) if made.fits(&functions, &program.description) => (made.code.clone(), made.notes.clone()),
        _ => {
            let (code, notes) = code(&functions, &program.description, interpret);
            let (layout, pool) = (program.description.layout.clone(), program.description.pool.clone());
            *made = Some(Made { functions, layout, pool, code: code.clone(), notes: notes.clone() });
            (code, notes)
        }
    };
    let instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    Case { label: variant.label, instance, experiment: variant.experiment, notes }
}

/// The functions that a method needs, expanded to arithmetic.
pub fn functions(program: &program::Program, method: Method) -> Vec<(Function, ir::Func)> {
    let mut out = vec![(Function::Start, program.start.clone()), (Function::Outputs, program.outputs.clone())];
    if let Some(transitions) = &program.transitions {
        out.push((Function::Transitions, transitions.clone()));
    }
    match method {
        Method::Adaptive => {
            out.push((Function::Derivatives, program.derivatives.clone()));
            if program.description.layout.jacobian.len > 0 {
                out.push((Function::Jacobian, derive::jacobian(program)));
            }
            out.extend(program.tick.clone().map(|tick| (Function::Tick, tick)));
            out.extend(program.roots.clone().map(|roots| (Function::Roots, roots)));
        }
        method => out.push((Function::Step, discretize::step(program, method))),
    }
    out.into_iter().map(|(function, func)| (function, math::expand(&func))).collect()
}

/// Machine code of functions, or the interpreter where there can be none, which is noted.
pub fn code(functions: &[(Function, ir::Func)], description: &abi::Description, interpret: bool) -> (Code, Vec<String>) {
    let (layout, pool) = (&description.layout, description.pool.len());
    let interpreted = || Code::Interpreted(Arc::new(backend::interp::Interpreter::new(functions, layout, pool)));
    if interpret {
        return (interpreted(), Vec::new());
    }
    match backend::jit::compile(functions, layout, pool) {
        Ok((machine, _)) => (Code::Machine(machine), Vec::new()),
        Err(why) => (interpreted(), vec![format!("runs interpreted, some fifty times slower: {why}")]),
    }
}

/// Whether a friction model dissipates, with the parameters that the arguments of an instance give it. None for what
/// does not fit `Friction`, or has a part or input that stays open.
pub fn dissipation(
    loaded: &Loaded,
    sources: &dyn Sources,
    instance: &grammar::ast::Instance,
    file: FileId,
) -> Option<friction::Verdict> {
    use grammar::ast;
    let resolve::Lookup::Found(item, Item::Model(model)) =
        loaded.find(file, resolve::Space::Type, &instance.model.text)
    else {
        return None;
    };
    let path = |bind: &ast::Bind| ast::Path {
        segments: vec![ast::Segment { name: bind.name.clone(), index: None }],
        span: bind.name.span,
    };
    let paths: Vec<ast::Path> = instance.args.iter().map(path).collect();
    let given = paths.iter().zip(&instance.args).map(|(path, bind)| {
        let value = match &bind.value {
            ast::BindValue::Expr(expr) => flatten::OverrideValue::Expr(expr),
            ast::BindValue::Instance(instance) => flatten::OverrideValue::Instance(instance),
        };
        flatten::Override { path, value, file }
    });
    let request = flatten::Request {
        instance: flatten::Instance::Alone(model, item.file),
        overrides: given.collect(),
        observed: Vec::new(),
        data: Vec::new(),
    };
    let flat = flatten::flatten(loaded, sources, &request);
    let mut diagnostics = flat.diagnostics;
    let types = units::check(&flat.system, &loaded.files, &mut diagnostics);
    if diagnostics.iter().any(Diagnostic::is_error) {
        return None;
    }
    friction::dissipation(&flat.system, &types)
}

/// Checks everything in a loaded text: each model on its own, each experiment.
pub fn check(loaded: &mut Loaded, sources: &dyn Sources) -> Vec<Diagnostic> {
    let mut all = loaded.diagnostics.clone();
    let root = loaded.root();
    let ast = loaded.files.get(root).ast.clone();
    for item in &ast.items {
        match item {
            Item::Model(model) => all.extend(check_model(loaded, sources, model, root)),
            Item::Experiment(experiment) => {
                let mut warnings = Vec::new();
                let changes = Changes::default();
                match experiment::read(loaded, sources, &experiment.name.text, &changes, &mut warnings, &mut |_| ()) {
                    Ok(_) => all.extend(warnings),
                    Err(errors) => all.extend(errors),
                }
            }
            _ => {}
        }
    }
    once(all)
}

fn check_model(
    loaded: &Loaded,
    sources: &dyn Sources,
    model: &grammar::ast::Model,
    file: FileId,
) -> Vec<Diagnostic> {
    let request = flatten::Request {
        instance: flatten::Instance::Alone(model, file),
        overrides: Vec::new(),
        observed: Vec::new(),
        data: Vec::new(),
    };
    let flat = flatten::flatten(loaded, sources, &request);
    let mut diagnostics = flat.diagnostics;
    let types = units::check(&flat.system, &loaded.files, &mut diagnostics);
    if !diagnostics.iter().any(Diagnostic::is_error) {
        causality::check(&flat.system, &loaded.files, &mut diagnostics);
    }
    if !diagnostics.iter().any(Diagnostic::is_error) {
        checks::values(&flat.system, &types, &loaded.files, &mut diagnostics);
        domains::check(&flat.system, &types, &loaded.files, &mut diagnostics);
    }
    if !diagnostics.iter().any(Diagnostic::is_error) {
        diagnostics.extend(lints::check(&flat.system, &types, &loaded.files));
    }
    lints::silence(&flat.system, &mut diagnostics);
    diagnostics
}

/// One mistake, one message: in the order of the files, each code at each place once, warnings only without errors.
pub fn once(mut diagnostics: Vec<Diagnostic>) -> Vec<Diagnostic> {
    let errors = diagnostics.iter().any(Diagnostic::is_error);
    diagnostics.retain(|diagnostic| !errors || diagnostic.is_error());
    diagnostics.sort_by_key(|diagnostic| diagnostic.span());
    let mut seen = std::collections::HashSet::new();
    diagnostics.retain(|diagnostic| seen.insert((diagnostic.code, diagnostic.span())));
    diagnostics
}
