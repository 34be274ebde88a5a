//! Whether a system is a function of the present: rates and outputs that follow from time, states, inputs and parameters.
//!
//! In: a flat [`System`] and the form of the function. Out: a diagnostic for each statement that makes it more than that.
//! Regimes are an argument of the function.

use crate::codegen::python::Dialect;
use crate::frontend::system::*;
use grammar::diagnostic::Diagnostic;

/// E0911: whatever is no function of the present, or not in this dialect.
pub fn check(system: &System, dialect: Dialect, diagnostics: &mut Vec<Diagnostic>) {
    let error = |what: &str| Diagnostic::error("E0911", format!("{what} is no function of the present state"));
    let steps = "steps have it: `fric build … --emit c`, or `start` and `step` in Python";
    for delay in &system.delays {
        let error = error("a `delay`").label(system.span(*delay), "depends on the past");
        diagnostics.push(error.help("a first-order lag comes close for slow motions: `dy/dt = (x - y) / T`"));
    }
    for block in &system.blocks {
        let error = error("sampled code").label(block.span, "runs at ticks, and holds its results between them");
        diagnostics.push(error.help(format!("{steps}; or make what it computes an input")));
    }
    for event in &system.events {
        let error = error("an event").label(event.span, "happens at an instant, and sets states");
        diagnostics.push(error.help(steps));
    }
    let transitions = || {
        let regimes = system.automata.iter().flat_map(|automaton| &automaton.regimes);
        regimes.flat_map(|regime| &regime.transitions)
    };
    for transition in transitions().filter(|transition| !transition.resets.is_empty()) {
        let error = error("a jump").label(transition.span, "this transition sets a state");
        let smooth = "models without jumps, such as `LuGre` or `Dahl`, have derivatives everywhere";
        diagnostics.push(error.help(format!("{steps}; {smooth}")));
    }
    for (node, span) in system.nodes.iter().zip(&system.spans) {
        // Statements that are refused anyway have been told.
        let told = || {
            let events = system.events.iter().map(|event| event.span);
            let jumps = transitions().filter(|transition| !transition.resets.is_empty()).map(|one| one.span);
            let within = |all: grammar::span::Span| all.file == span.file && all.to(*span) == all;
            events.chain(jumps).any(within)
        };
        let lacks = |what: &str| format!("{what}, which {} does not have", dialect.name());
        match node {
            Node::Crossing(_) if !told() => {
                let error = error("a crossing").label(*span, "compares with the instant before");
                diagnostics.push(error.help(format!("compare values, with `<` or `>`; {steps}")));
            }
            Node::Table(..) if !dialect.has_tables() => {
                let error = Diagnostic::error("E0911", lacks("a table is an array that is searched"));
                diagnostics.push(
                    error.label(*span, "a table").help("numpy and jax have tables; or fit a formula to its points"),
                );
            }
            Node::Call(Builtin::Random | Builtin::Noise, _) if !dialect.has_random() => {
                let error = Diagnostic::error("E0911", lacks("random numbers come from integers of 64 bits"));
                diagnostics.push(error.label(*span, "random").help("numpy has them; or make it an input"));
            }
            _ => {}
        }
    }
}
