//! Compiles texts to the programs of a fixed and of the adaptive method.

use crate::case::{Case, of_program};
use crate::support::Texts;
use abi::plan::Method;
use compiler::Changes;
use compiler::experiment::Variant;
use compiler::ir::program::Program;
use compiler::ir::random::Random;
use grammar::ast::{ExperimentStatement, Item, Solver};
use grammar::diagnostic::Diagnostic;

/// Programs with more operations in all functions are skipped: gcc takes minutes for them, and they show nothing new.
const MOST_OPERATIONS: usize = 5_000;

/// The step of a fixed method where the text has none, in s.
const STEP: f64 = 1e-4;

/// Why a text has no program: the code of its first error.
pub type Fallen = String;

/// The first error, by its code.
pub fn fallen(found: &[Diagnostic]) -> Fallen {
    let error = found.iter().find(|diagnostic| diagnostic.is_error());
    error.map_or_else(|| "what could not be read".into(), |error| error.code.to_string())
}

/// All combinations of an experiment with a method, and the step in s: the text's own, if it has one.
///
/// # Errors
/// All errors of the text.
pub fn read(name: &str, text: &str, experiment: &str, method: Method) -> Result<(Vec<Variant>, f64), Vec<Diagnostic>> {
    let sources = Texts::default();
    let mut loaded = compiler::load(name, text, &sources);
    let has_step = loaded.files.get(loaded.root()).ast.items().any(|item| match item {
        Item::Experiment(own) if own.name.text == experiment => own
            .body
            .iter()
            .any(|statement| matches!(statement, ExperimentStatement::Solver(Solver { step: Some(_), .. }))),
        _ => false,
    });
    let step = (method != Method::Adaptive && !has_step).then_some(STEP);
    let changes = Changes { method: Some(method), step, any_step: true, ..Changes::default() };
    let read = compiler::experiment::read(&mut loaded, &sources, experiment, &changes, &mut Vec::new(), &mut |_| ());
    let variants = read?;
    let own = variants.first().map_or(0.0, |variant| variant.experiment.solver.step);
    Ok((variants, if own > 0.0 { own } else { STEP }))
}

/// A model alone with its inputs open, for fixed steps of `step` s.
///
/// # Errors
/// All errors of the text.
pub fn model(name: &str, text: &str, model: &str, method: Method, step: f64) -> Result<Program, Vec<Diagnostic>> {
    let sources = Texts::default();
    let mut loaded = compiler::load(name, text, &sources);
    let changes = Changes { method: Some(method), step: Some(step), any_step: true, ..Changes::default() };
    let built = compiler::build(&mut loaded, &sources, model, &changes, &mut Vec::new());
    built.map(|built| built.program)
}

/// A case of a program, if it is not too large.
///
/// # Errors
/// If it is.
pub fn case(
    name: &str,
    text: &str,
    program: &Program,
    method: Method,
    step: f64,
    random: &mut Random,
) -> Result<Case, Fallen> {
    let case = of_program(name.to_string(), text, program, method, step, random);
    if case.size() > MOST_OPERATIONS { Err("too large".into()) } else { Ok(case) }
}
