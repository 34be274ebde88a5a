//! Lints: warnings for models that compile, about unused names, unreachable regimes, and the physics of friction.
//!
//! In: a flat and typed system. Out: warnings. Each lint has a name and can be silenced by `allow NAME "reason"`.

use crate::analysis::dissipation;
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ranges::reach::Reach;
use grammar::diagnostic::Diagnostic;

/// All warnings of a model on its own. `physics` includes the dissipation analysis, which takes longer.
pub fn check(system: &System, types: &Types, files: &Files, physics: bool) -> Vec<Diagnostic> {
    let mut found = Vec::new();
    unused(system, &mut found);
    regimes(system, files, &mut found);
    if physics {
        dissipation::check(system, types, &mut found);
    }
    found
}

/// Removes the warnings that the model allows.
pub fn silence(system: &System, diagnostics: &mut Vec<Diagnostic>) {
    let Some(top) = system.instances.first() else { return };
    // A part that allows a lint of its physics, with a reason, allows it for the whole model.
    let by_parts = |name: &str| system.instances.iter().any(|part| part.allows.iter().any(|allow| allow == name));
    let allowed: Vec<&str> = LINTS
        .iter()
        .filter(|(name, code)| top.allows.iter().any(|a| a == name) || (code.starts_with("W07") && by_parts(name)))
        .map(|(_, code)| *code)
        .collect();
    diagnostics.retain(|diagnostic| diagnostic.is_error() || !allowed.contains(&diagnostic.code));
}

fn unused(system: &System, found: &mut Vec<Diagnostic>) {
    let mut read = vec![false; system.vars.len()];
    for node in &system.nodes {
        match node {
            Node::Var(var) | Node::Rate(var) | Node::PathRate(var) => read[var.0 as usize] = true,
            _ => {}
        }
    }
    for (var, read) in system.vars.iter().zip(read) {
        let private = matches!(var.kind, VarKind::Param | VarKind::Input | VarKind::Let);
        if read || !private || var.instance != InstanceId(0) {
            continue;
        }
        let word = var.kind.word();
        let warning = Diagnostic::warning("W0201", format!("{word} `{}` is never read", var.name))
            .label(var.span, "declared, but nothing uses it")
            .help("use it or remove it; to keep it: `allow unused \"...\"`");
        found.push(warning);
    }
}

fn regimes(system: &System, files: &Files, found: &mut Vec<Diagnostic>) {
    let mut reach = Reach::new(system);
    for automaton in system.automata.iter().filter(|automaton| automaton.instance == InstanceId(0)) {
        let mut reached = vec![false; automaton.regimes.len()];
        let mut stack = vec![automaton.initial as usize];
        while let Some(k) = stack.pop() {
            if !std::mem::replace(&mut reached[k], true) {
                stack.extend(automaton.regimes[k].transitions.iter().map(|transition| transition.target as usize));
            }
        }
        for (regime, reached) in automaton.regimes.iter().zip(reached) {
            if !reached {
                let warning = Diagnostic::warning("W0311", format!("no path leads to regime `{}`", regime.name))
                    .label(regime.span, "never active")
                    .help(format!("add `go {} when …` to another regime, or remove it", regime.name));
                found.push(warning);
                continue;
            }
            for transition in &regime.transitions {
                if reach.decide(transition.condition) == Some(false) {
                    let text = files.slice(system.span(transition.condition)).to_string();
                    let warning = Diagnostic::warning("W0312", format!("`{text}` can never hold"))
                        .label(transition.span, "this transition is never taken")
                        .help("check the sign and the ranges of what is compared");
                    found.push(warning);
                }
            }
        }
    }
}
