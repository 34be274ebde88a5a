//! The checks between a flat system and its program, in their order: this is the only caller of each.
//!
//! In: a flat system, and how far to check it. Out: the types of its expressions, and diagnostics. A check does not run
//! where an earlier one has reported an error, since it would report consequences of that error.

use crate::analysis::{domains, parameter_checks};
use crate::frontend::angles;
use crate::frontend::causality;
use crate::frontend::source::Files;
use crate::frontend::system::System;
use crate::frontend::units::{self, Types};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// How far a system is checked. Each depth includes those above it.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Depth {
    /// Units and types of all expressions.
    Units,
    /// Algebraic loops.
    Causality,
    /// Values of parameters: ranges, `require`, constants.
    Values,
    /// Divisions and domains of functions that cannot be proved safe.
    Domains,
    /// As `Domains`, but only of the constants that an experiment passes to the model it runs. The span is that of the
    /// `run` statement's instance.
    Given(Span),
}

/// Checks a system down to a depth. `blocks`: the errors among `diagnostics` after which algebraic loops are not looked for;
/// as a rule all of them ([`Diagnostic::is_error`]).
pub fn analyse(
    system: &System,
    files: &Files,
    depth: Depth,
    blocks: &dyn Fn(&Diagnostic) -> bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> Types {
    let types = units::check(system, files, diagnostics);
    if !diagnostics.iter().any(Diagnostic::is_error) {
        angles::check(system, &types, files, diagnostics);
    }
    if depth == Depth::Units {
        return types;
    }
    if !diagnostics.iter().any(blocks) {
        causality::check(system, files, diagnostics);
    }
    if depth == Depth::Causality || diagnostics.iter().any(Diagnostic::is_error) {
        return types;
    }
    parameter_checks::values(system, &types, files, diagnostics);
    match depth {
        Depth::Units | Depth::Causality | Depth::Values => {}
        Depth::Domains => domains::check(system, &types, files, diagnostics),
        Depth::Given(run) => domains::check_given(system, &types, files, run, diagnostics),
    }
    types
}
