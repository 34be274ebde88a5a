//! Checks of values known before a run: ranges, `require` statements, periods and delays.
//!
//! In: a flat and typed system. Out: diagnostics at the argument that violates a condition. Knows nothing of states
//! beyond their start values.

use crate::frontend::delays;
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::lower::evaluate;
use abi::format::{quantity, three_digits};
use abi::live;
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// Checks parameters against their ranges, and every `require`.
pub fn values(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    constants(system, diagnostics);
    ranges(system, types, files, diagnostics);
    periods(system, types, diagnostics);
    delays::check(system, diagnostics);
    resets(system, diagnostics);
    requires(system, types, files, diagnostics);
}

/// Parameters and `require` statements may depend only on parameters and constants.
fn constants(system: &System, diagnostics: &mut Vec<Diagnostic>) {
    for var in system.vars.iter().filter(|var| var.kind == VarKind::Param) {
        let Definition::Value(value, origin) = &var.definition else { continue };
        let Some(moving) = moving(system, *value) else { continue };
        let error =
            Diagnostic::error("E0502", format!("`{}` is a param: it is constant while the model runs", var.name));
        if let Some(fixed) = constant_let(system, moving) {
            let error = error
                .label(system.span(moving), "a `let` counts as changing")
                .label(fixed.span, "depends on params only");
            diagnostics.push(error.help(format!("write `param {0}` in place of `let {0}`", fixed.name)));
            continue;
        }
        let error = error.label(system.span(moving), "changes").label(var.span, "declared here");
        diagnostics.push(match origin {
            Origin::Argument { .. } => error.help(format!("declare `{}` as an input of that model", var.name)),
            _ => error.help(format!("declare `{}` with `let`", var.name)),
        });
    }
    for require in &system.requires {
        if let Some(moving) = moving(system, require.condition) {
            let error = Diagnostic::error("E0502", "`require` is over params and constants")
                .label(system.span(moving), "changes while the model runs");
            diagnostics.push(
                error.help("give a quantity that changes a range, `in 0 .. 1 m`: it is watched while the model runs"),
            );
        }
    }
}

/// The quantity that an expression names, if it is a `let` whose value depends on params and on such `let` alone.
fn constant_let(system: &System, id: ExprId) -> Option<&Var> {
    fn is_constant(system: &System, id: ExprId, depth: u32) -> bool {
        match system.node(id) {
            Node::Var(var) => {
                let var = system.var(*var);
                match (var.kind, &var.definition) {
                    (VarKind::Param, _) => true,
                    (VarKind::Let, Definition::Value(value, _)) => depth < 64 && is_constant(system, *value, depth + 1),
                    _ => false,
                }
            }
            Node::Time | Node::Rate(_) | Node::PathRate(_) | Node::InRegime(..) => false,
            node => node.operands().all(|operand| is_constant(system, operand, depth)),
        }
    }
    let Node::Var(var) = system.node(id) else { return None };
    let var = system.var(*var);
    (var.kind == VarKind::Let && is_constant(system, id, 0)).then_some(var)
}

/// The part of an expression that changes during a run, if there is one.
pub fn moving(system: &System, id: ExprId) -> Option<ExprId> {
    match system.node(id) {
        Node::Var(var) => (system.var(*var).kind != VarKind::Param).then_some(id),
        Node::Time | Node::Rate(_) | Node::PathRate(_) | Node::InRegime(..) => Some(id),
        node => node.operands().find_map(|operand| moving(system, operand)),
    }
}

fn ranges(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    let mut exprs = Vec::new();
    let mut checked = Vec::new();
    // A quantity without a value still needs a non-empty range.
    let open = ExprId(u32::MAX);
    for id in system.var_ids() {
        let var = system.var(id);
        let value = match (&var.definition, var.kind) {
            (Definition::Value(value, _), VarKind::Param | VarKind::Input) => *value,
            (Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. }, _) => *initial,
            _ => open,
        };
        let bounds = [var.range.low, var.range.high];
        if bounds.iter().all(Option::is_none) {
            continue;
        }
        checked.push((id, value, exprs.len()));
        let bounds = bounds.into_iter().flatten().map(|(bound, _)| bound);
        let mut bounds = bounds.collect::<Vec<_>>();
        let first = if value == open { bounds[0] } else { value };
        bounds.insert(0, first);
        exprs.extend(bounds);
    }
    let values = evaluate(system, types, &exprs);
    for (id, node, at) in checked {
        let var = system.var(id);
        let value = values[at];
        let mut next = at + 1;
        let mut take = |bound: Option<(ExprId, bool)>| {
            bound.map(|(_, strict)| {
                next += 1;
                (values[next - 1], strict)
            })
        };
        let (low, high) = (take(var.range.low), take(var.range.high));
        if live::is_empty(low, high)
            && let Some(range) = var.range_span
        {
            let error = Diagnostic::error("E0502", live::nothing_in_range(&var.name))
                .label(range, "its lower bound is above its upper one");
            let turned = files.slice(range).split_once("..");
            diagnostics.push(match turned {
                Some((low, high)) => error.help(format!("write `{} .. {}`", high.trim(), low.trim())),
                None => error,
            });
            continue;
        }
        if node == open {
            continue;
        }
        let Some(beyond) = live::beyond(value, low, high) else { continue };
        let unit = &types.units[id.0 as usize];
        let show = |x: f64| quantity(x, unit, 3);
        let (word, bound) = (beyond.word, show(beyond.bound));
        let model = &system.instance(var.instance).model;
        let message = live::beyond_words(&var.name, model, unit, value, beyond);
        let place = match &var.definition {
            Definition::Value(_, Origin::Argument { bind, .. }) => *bind,
            Definition::Continuous { .. } | Definition::Sampled { .. } => match system.start_origin(id) {
                Origin::Argument { bind, .. } => bind,
                _ => system.span(node),
            },
            _ => system.span(node),
        };
        let mut error = Diagnostic::error("E0502", message).label(place, show(value));
        if let Some(range) = var.range_span {
            error = error.label(range, format!("allowed: {}", files.slice(range)));
        }
        let percent = unit.dimension.is_none()
            && unit.scale == 1.0
            && high.is_some_and(|(high, _)| high == 1.0)
            && value > 1.0
            && value <= 100.0;
        diagnostics.push(error.help(match percent {
            true => format!("give a value that is {word} {bound}, such as `{} %`", three_digits(value)),
            false => format!("give a value that is {word} {bound}"),
        }));
    }
}

/// Periods must be positive and known before a run.
fn periods(system: &System, types: &Types, diagnostics: &mut Vec<Diagnostic>) {
    let exprs: Vec<ExprId> = system.blocks.iter().map(|block| block.period).collect();
    for (expr, value) in exprs.iter().zip(evaluate(system, types, &exprs)) {
        let open = mentioned(system, *expr)
            .iter()
            .any(|id| system.var(*id).kind == VarKind::Param && matches!(system.var(*id).definition, Definition::Free));
        if live::is_period(value) || open {
            continue;
        }
        let what = if value.is_nan() { "not constant".to_string() } else { format!("{} s", three_digits(value)) };
        let error = Diagnostic::error("E0502", live::NO_PERIOD)
            .label(system.span(*expr), what)
            .help("write a time or a param, such as `every 1 ms`");
        diagnostics.push(error);
    }
}

/// E0701: every period must be a whole multiple of the fixed step.
pub fn whole_periods(system: &System, types: &Types, step: f64, at: Option<Span>, diagnostics: &mut Vec<Diagnostic>) {
    let exprs: Vec<ExprId> = system.blocks.iter().map(|block| block.period).collect();
    for (expr, value) in exprs.iter().zip(evaluate(system, types, &exprs)) {
        if live::is_multiple(value, step) {
            continue;
        }
        let error = Diagnostic::error("E0701", live::no_multiple(value, step));
        let ticks = (system.span(*expr), format!("{} steps", three_digits(value / step)));
        // The primary label is where the user should make the change, which is not in a library.
        let labels = match at.map(|at| (at, "the step".to_string())) {
            Some(step) if step.0.file != ticks.0.file => vec![step, ticks],
            step => std::iter::once(ticks).chain(step).collect(),
        };
        let error = labels.into_iter().fold(error, |error, (span, text)| error.label(span, text));
        diagnostics.push(error.help("ticks fall on whole steps: change one of them so that it divides the other"));
    }
}

/// A `reset` must set a continuous state, and no state twice.
fn resets(system: &System, diagnostics: &mut Vec<Diagnostic>) {
    let transitions = system.automata.iter().flat_map(|automaton| &automaton.regimes).flat_map(|r| &r.transitions);
    let all: Vec<&Vec<(VarId, ExprId)>> =
        transitions.map(|t| &t.resets).chain(system.events.iter().map(|event| &event.resets)).collect();
    for resets in &all {
        for (k, (var, value)) in resets.iter().enumerate() {
            let Some((_, first)) = resets[..k].iter().find(|(other, _)| other == var) else { continue };
            let name = &system.var(*var).name;
            let error = Diagnostic::error("E0301", format!("`{name}` is reset twice at the same instant"))
                .label(system.reset_place(*value), "again here")
                .label(system.reset_place(*first), "first here");
            diagnostics.push(error.help("keep the one that is meant, or choose between both values with `if`"));
        }
    }
    for (var, value) in all.into_iter().flatten() {
        let var = system.var(*var);
        if matches!(var.definition, Definition::Sampled { .. }) {
            let error = Diagnostic::error("E0307", format!("`{}` is a sampled state: it cannot be reset", var.name))
                .label(system.reset_place(*value), "`reset` sets a continuous state")
                .label(var.span, "changes at ticks only");
            diagnostics.push(error.help(format!("let `next({})` say so, with a condition", var.name)));
        }
    }
}

fn requires(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    let conditions: Vec<ExprId> = system.requires.iter().map(|require| require.condition).collect();
    let values = evaluate(system, types, &conditions);
    for (require, value) in system.requires.iter().zip(values) {
        if value != 0.0 || moving(system, require.condition).is_some() {
            continue;
        }
        let info = system.instance(require.instance);
        let condition = files.slice(require.span);
        let model = &info.model;
        let vars = mentioned(system, require.condition);
        let message = unmet(system, files, require);
        let mut labels: Vec<(Span, String)> = Vec::new();
        let mut changed: Vec<&Var> = Vec::new();
        for &id in &vars {
            let var = system.var(id);
            match &var.definition {
                Definition::Value(_, Origin::Argument { bind, .. }) => {
                    labels.push((*bind, "set here".into()));
                    changed.push(var);
                }
                Definition::Value(node, Origin::Override) => {
                    labels.push((system.span(*node), "set here".into()));
                    changed.push(var);
                }
                Definition::Value(node, _) if info.path.is_empty() && info.span.file == system.span(*node).file => {
                    labels.push((system.span(*node), format!("the default of {}", var.name)));
                }
                Definition::Value(node, _) => {
                    let value = quantity(evaluate(system, types, &[*node])[0], &types.units[id.0 as usize], 3);
                    labels.push((info.span, format!("{} keeps its default, {value}", var.name)));
                }
                _ => {}
            }
        }
        labels.sort_by_key(|(span, _)| *span);
        labels.dedup_by_key(|(span, _)| *span);
        let mut error = Diagnostic::error("E0501", message);
        for (span, text) in labels {
            error = error.label(span, text);
        }
        if error.labels.is_empty() {
            error = error.label(require.span, "required here");
        }
        let kept = vars.iter().map(|id| system.var(*id)).find(|var| !changed.iter().any(|c| c.path == var.path));
        let mut help = format!("{model} requires {condition}.");
        if let (Some(kept), [set]) = (kept, changed.as_slice())
            && let Definition::Value(node, Origin::Argument { .. }) = &set.definition
        {
            let given = files.slice(system.span(*node));
            let written = instance_text(files, info.span);
            let unit = given.trim_start_matches(|c: char| c.is_ascii_digit() || ".e-+ ".contains(c));
            let number: f64 = given.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or(1.0);
            let suggestion = match written.as_deref().and_then(|text| text.strip_suffix(')')) {
                Some(open) => format!("{open}, {} = {} {unit})", kept.name, three_digits(number * 1.5)),
                None => format!("{model}({} = {given}, {} = …)", set.name, kept.name),
            };
            help = format!("{help} Set {} as well, for example\n`{suggestion}`", kept.name);
        }
        diagnostics.push(error.help(help));
    }
}

/// The message of a `require` that does not hold.
pub fn unmet(system: &System, files: &Files, require: &Require) -> String {
    match (&require.message, system.node(require.condition)) {
        (Some(message), _) => message.clone(),
        (None, Node::Binary(op, a, b)) if mentioned(system, require.condition).len() == 2 => {
            format!("`{}` {} `{}`", files.slice(system.span(*a)), broken(*op), files.slice(system.span(*b)))
        }
        (None, _) => format!("`{}` does not hold", files.slice(require.span)),
    }
}

/// The negation of a comparison, in words.
fn broken(op: BinaryOp) -> &'static str {
    match op {
        BinaryOp::GreaterEqual => "is smaller than",
        BinaryOp::Greater => "is not larger than",
        BinaryOp::LessEqual => "is larger than",
        BinaryOp::Less => "is not smaller than",
        _ => "does not fit",
    }
}

/// The text of an instance from the model's name to the closing parenthesis.
fn instance_text(files: &Files, name: Span) -> Option<String> {
    let text = &files.get(name.file).text[name.start as usize..];
    let mut depth = 0;
    for (k, c) in text.char_indices() {
        match c {
            '(' => depth += 1,
            ')' => {
                depth -= 1;
                if depth == 0 {
                    return Some(text[..=k].split_whitespace().collect::<Vec<_>>().join(" "));
                }
            }
            _ => {}
        }
        if depth == 0 && c == '\n' {
            return None;
        }
    }
    None
}

/// Quantities that an expression mentions, in order.
fn mentioned(system: &System, id: ExprId) -> Vec<VarId> {
    let mut out = Vec::new();
    let mut stack = vec![id];
    while let Some(id) = stack.pop() {
        if let Node::Var(var) = system.node(id)
            && !out.contains(var)
        {
            out.push(*var);
        }
        let operands: Vec<ExprId> = system.node(id).operands().collect();
        stack.extend(operands.into_iter().rev());
    }
    out
}
