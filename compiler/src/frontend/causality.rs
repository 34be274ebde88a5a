//! Causality: the dependency graph of present values, and its cycles (algebraic loops).
//!
//! In: a flat [`System`]. Out: diagnostics only; `lower` follows the same graph on demand. There is one graph over
//! single quantities for each phase. States, held outputs and `next` break cycles. Cycles are strongly connected
//! components (Tarjan, *Depth-first search and linear graph algorithms*, 1972).

use crate::frontend::delays;
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::ir::hash::HashMap;
use crate::ir::scc::components;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::collections::VecDeque;

/// When an expression is evaluated.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Phase {
    /// Once, at t = 0: initial values and the `on` blocks due then.
    Start,
    /// At any instant.
    Now,
    /// At a tick: as `Now`, but held quantities are recomputed.
    Tick,
}

/// The expression that defines a quantity's present value in a phase; `None` where the value is stored.
pub fn value_of(var: &Var, phase: Phase) -> Option<ExprId> {
    match (&var.definition, phase) {
        (Definition::Value(value, _), _) => Some(*value),
        (Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. }, Phase::Start) => Some(*initial),
        (Definition::Held { value, .. }, Phase::Start | Phase::Tick) => Some(*value),
        _ => None,
    }
}

/// The definition of `dz/dt` or `dx/ds`.
pub fn rate_of(system: &System, node: &Node) -> Option<ExprId> {
    let (Node::Rate(var) | Node::PathRate(var)) = node else { return None };
    match (node, &system.var(*var).definition) {
        (Node::PathRate(_), Definition::Continuous { path: Some((value, _)), .. }) => Some(*value),
        (_, Definition::Continuous { rate, .. }) => Some(*rate),
        _ => None,
    }
}

/// Reports every cycle once, by its shortest path.
pub fn check(system: &System, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    for phase in [Phase::Now, Phase::Tick, Phase::Start] {
        let graph = graph(system, phase);
        let circles = circles(&graph);
        for circle in &circles {
            let walk = shortest(&graph, circle);
            diagnostics.push(message(system, files, phase, &walk));
        }
        if !circles.is_empty() {
            return; // Later phases would repeat the report.
        }
    }
}

/// For each quantity, followed by the rate of each quantity: the nodes that it needs, each with the expression that
/// mentions it.
type Graph = Vec<Vec<(VarId, ExprId)>>;

/// The index of a quantity's rate in the graph.
fn rate_number(system: &System, var: VarId) -> VarId {
    VarId(system.vars.len() as u32 + var.0)
}

/// The quantity of a graph index, and whether the index stands for its rate.
fn behind(system: &System, id: VarId) -> (VarId, bool) {
    match id.0.checked_sub(system.vars.len() as u32) {
        Some(var) => (VarId(var), true),
        None => (id, false),
    }
}

fn graph(system: &System, phase: Phase) -> Graph {
    let mut seen = vec![u32::MAX; system.nodes.len()];
    let n = system.vars.len();
    let edges = |k: usize| {
        let mut out = Vec::new();
        let first = match system.vars.get(k) {
            Some(var) => value_of(var, phase),
            None => rate_of(system, &Node::Rate(VarId((k - n) as u32))),
        };
        let mut stack: Vec<ExprId> = first.into_iter().collect();
        while let Some(id) = stack.pop() {
            if std::mem::replace(&mut seen[id.0 as usize], k as u32) == k as u32 {
                continue;
            }
            match system.node(id) {
                Node::Var(needed) => out.push((*needed, id)),
                Node::Rate(needed) => out.push((rate_number(system, *needed), id)),
                node => {
                    let mut operands: Vec<ExprId> = match phase {
                        // A delayed value is known from the past.
                        Phase::Now | Phase::Tick if delays::breaks(system, node) => Vec::new(),
                        _ => node.operands().collect(),
                    };
                    operands.extend(rate_of(system, node));
                    if let Node::Crossing(crossing) = node {
                        operands.push(system.crossings[*crossing as usize].difference);
                    }
                    stack.extend(operands.into_iter().rev());
                }
            }
        }
        out
    };
    (0..2 * n).map(edges).collect()
}

/// Strongly connected components that contain a cycle, each sorted.
fn circles(graph: &Graph) -> Vec<Vec<VarId>> {
    let edge = |v: usize, k: usize| graph[v].get(k).map(|(w, _): &(VarId, ExprId)| w.0 as usize);
    let circle = |component: &Vec<usize>| {
        let first = component[0];
        component.len() > 1 || graph[first].iter().any(|(w, _)| w.0 as usize == first)
    };
    let numbered = |component: Vec<usize>| component.into_iter().map(|v| VarId(v as u32)).collect();
    let mut out: Vec<Vec<VarId>> = components(graph.len(), edge).into_iter().filter(circle).map(numbered).collect();
    out.sort();
    out
}

/// The shortest cycle within a component, as pairs (quantity, expression in which it mentions the next one). Starts at
/// an output of a part, if there is one.
fn shortest(graph: &Graph, component: &[VarId]) -> Vec<(VarId, ExprId)> {
    let mut best: Option<Vec<(VarId, ExprId)>> = None;
    // Breadth-first search from every quantity of a small component, but only from the first 64 of a large one, which
    // bounds the work.
    for &start in component.iter().take(64) {
        let mut from: HashMap<VarId, (VarId, ExprId)> = HashMap::default();
        let mut queue = VecDeque::from([start]);
        'search: while let Some(v) = queue.pop_front() {
            for &(w, at) in &graph[v.0 as usize] {
                if component.binary_search(&w).is_err() {
                    continue;
                }
                if w == start {
                    let mut walk = vec![(v, at)];
                    let mut v = v;
                    while v != start {
                        let (before, at) = from[&v];
                        walk.push((before, at));
                        v = before;
                    }
                    walk.reverse();
                    if best.as_ref().is_none_or(|best| walk.len() < best.len()) {
                        best = Some(walk);
                    }
                    break 'search;
                }
                from.entry(w).or_insert_with(|| {
                    queue.push_back(w);
                    (v, at)
                });
            }
        }
    }
    best.expect("a component has a circle")
}

fn message(system: &System, files: &Files, phase: Phase, walk: &[(VarId, ExprId)]) -> Diagnostic {
    // Begins with the output of a part, which users see as the quantity that depends on itself.
    let is_output = |id: VarId| {
        let (id, rate) = behind(system, id);
        let var = system.var(id);
        !rate && var.kind == VarKind::Output && var.instance != InstanceId(0)
    };
    let first = walk.iter().position(|(id, _)| is_output(*id)).unwrap_or(0);
    let walk: Vec<(VarId, ExprId)> = walk[first..].iter().chain(&walk[..first]).copied().collect();
    let path = |id: VarId| match behind(system, id) {
        (id, false) => system.var(id).path.clone(),
        (id, true) => format!("d{}/dt", system.var(id).path),
    };
    let called = friction_force(system, walk[0].0).unwrap_or_else(|| format!("`{}`", path(walk[0].0)));
    let (code, message) = match phase {
        Phase::Now => ("E0401", format!("{called} depends on itself in the same instant")),
        Phase::Tick => ("E0402", format!("{called} depends on itself within one tick")),
        Phase::Start => ("E0309", format!("the initial value of {called} depends on itself")),
    };
    // A port bound to a plain name is no step of its own: `fr.F needs F_ext, which is u`.
    let mut steps: Vec<(Span, String)> = Vec::new();
    let mut k = 0;
    while k < walk.len() {
        let (from, at) = walk[k];
        let (next, next_at) = walk[(k + 1) % walk.len()];
        let port = system.var(behind(system, next).0);
        let whole = walk.len() > 1 && k + 1 < walk.len();
        if let (true, VarKind::Input, Definition::Value(value, Origin::Argument { bind, .. })) =
            (whole, port.kind, &port.definition)
        {
            let plain = *value == next_at;
            let source = files.slice(system.span(next_at));
            let text = match plain {
                true => format!("{} needs {}, which is {source}", path(from), port.name),
                false => format!("{} needs {}, and that needs {source}", path(from), port.name),
            };
            steps.push((*bind, text));
            k += 2;
        } else {
            let text = format!("{} needs {}", path(from), files.slice(system.span(at)));
            steps.push((system.span(at), text));
            k += 1;
        }
    }
    let count = steps.len();
    let numbered = |(k, (span, text)): (usize, (Span, String))| {
        let text = match (k, count) {
            (_, 1) => text,
            (0, _) => format!("1. {text}"),
            (k, _) => format!("{}. and {text}", k + 1),
        };
        (span, text)
    };
    let mut labels: Vec<(Span, String)> = steps.into_iter().enumerate().map(numbered).collect();
    // The primary label is where the cycle closes, since that is where the user should change it.
    labels.rotate_right(1);
    let mut error = Diagnostic::error(code, message);
    for (span, text) in &labels {
        error = error.label(*span, text.clone());
    }
    error.help(help(system, files, phase, &walk))
}

/// `the friction force`, if the quantity is the output F of a model with an input v.
fn friction_force(system: &System, id: VarId) -> Option<String> {
    let (id, rate) = behind(system, id);
    if rate {
        return None;
    }
    let var = system.var(id);
    let beside = |name: &str, kind: VarKind| {
        system.vars.iter().any(|other| other.instance == var.instance && other.name == name && other.kind == kind)
    };
    (var.name == "F" && var.kind == VarKind::Output && beside("v", VarKind::Input)).then(|| "the friction force".into())
}

fn help(system: &System, files: &Files, phase: Phase, walk: &[(VarId, ExprId)]) -> String {
    match phase {
        Phase::Start => "give one of them an initial value that does not need the other".into(),
        Phase::Tick => "break the loop with memory: read the older value through a sampled state, `next(x) = …`".into(),
        Phase::Now => {
            let closing = walk.last().expect("a circle is not empty");
            let var = system.var(behind(system, closing.0).0);
            let whole = value_of(var, Phase::Now).map_or("", |value| files.slice(system.span(value)));
            let mention = files.slice(system.span(closing.1));
            let lines = if friction_force(system, walk[0].0).is_some() && whole.contains(mention) && whole.len() < 60 {
                format!(
                    "break the loop with something that has memory:\n  - cancel with an estimate that has its own state: `{}`\n  - or give the actuator its lag: `part act = Lag(u = {whole}, T = 1 ms)`",
                    whole.replace(mention, "obs.F_hat"),
                )
            } else {
                "break the loop with something that has memory: a state, a lag, a mass between".to_string()
            };
            format!("{lines}\nfric does not solve loops numerically: a step must take a bounded time")
        }
    }
}
