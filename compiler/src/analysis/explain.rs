//! Explanation of a model: its quantities, its equations in order of evaluation, how each state is integrated and why,
//! and the cost of a step.
//!
//! In: a flat and typed system. Out: plain data; knows nothing of its presentation.

use crate::analysis::dissipation::{self, Verdict};
use crate::analysis::step_stability::largest_stable;
use crate::codegen::target::{FunctionCompiler, here};
use crate::frontend::causality::{Phase, rate_of, value_of};
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::ir::program::Program;
use crate::ir::{Func, Op, Value};
use crate::numerics::{autodiff, fixed_step};
use crate::opt::reassociate::reassociate;
use abi::description::Slot;
use abi::format::three_digits;
use abi::plan::Method;
use grammar::ast::BinaryOp;
use grammar::span::Span;

/// Explanation of a model.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Explanation {
    /// Name of the model.
    pub model: String,
    /// Its quantities and those of its parts, in the order of the text.
    pub quantities: Vec<QuantityInfo>,
    /// Equations in order of evaluation: left side, right side as written.
    pub equations: Vec<(String, String)>,
    /// For each computed quantity, the paths that its equation mentions.
    pub needs: Vec<(String, Vec<String>)>,
    /// How each continuous state is integrated.
    pub states: Vec<Stepped>,
    /// Cost of a step by each fixed-step method.
    pub steps: Vec<StepCost>,
    /// Size in bytes of the block of one instance.
    pub bytes: usize,
    /// Stored energy as written, for models with a `storage`.
    pub storage: Vec<String>,
    /// Whether the friction is rate-independent (depends on the path only); `None` for other models.
    pub rate_independent: Option<bool>,
    /// Whether the friction dissipates; `None` for other models.
    pub dissipation: Option<Verdict>,
}

/// Cost of one fixed step by a method, including the outputs.
#[derive(Clone, PartialEq, Debug)]
pub struct StepCost {
    /// The method of integration.
    pub method: Method,
    /// Operations before elementary functions are expanded.
    pub plain: usize,
    /// Arithmetic operations after expansion.
    pub operations: usize,
    /// Divisions and square roots among them.
    pub divisions: usize,
    /// Instructions and bytes of the machine code for this processor; `None` if there is none.
    pub code: Option<(usize, usize)>,
    /// The largest stable step in s over the declared ranges, with open ranges up to
    /// [`OPEN`](crate::analysis::step_stability::OPEN): see [`largest_stable`]. `None` without continuous states, or
    /// with too many.
    pub stable: Option<f64>,
}

/// A quantity in an explanation.
#[derive(Clone, PartialEq, Debug)]
pub struct QuantityInfo {
    /// `param`, `input`, …
    pub kind: &'static str,
    /// Dotted path.
    pub path: String,
    /// Unit for display.
    pub unit: String,
    /// Range as written.
    pub range: Option<String>,
    /// The doc comment.
    pub doc: Option<String>,
}

/// How a state is integrated.
#[derive(Clone, PartialEq, Debug)]
pub struct Stepped {
    /// Dotted path.
    pub path: String,
    /// How its rate depends on the state itself.
    pub own: SelfDependence,
    /// The greatest magnitude of its own rate found, in 1/s, and the velocity there in m/s for models with an input
    /// `v`.
    pub fastest: Option<(f64, Option<f64>)>,
}

/// How the rate of a state depends on the state itself.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum SelfDependence {
    /// Not at all: a pure integrator.
    Not,
    /// f = a·x + b with a and b independent of x, in each branch: `expo` is exact.
    Affine,
    /// Nonlinear: `expo` linearises it in each step.
    Nonlinear,
    /// Sampled: it changes at ticks.
    Sampled,
}

/// A step in s for sizing the delay buffers, on which the size of the block depends.
const EXAMPLE_STEP: f64 = 1e-3;

/// Explains a model on its own, or the system of an experiment or rig. `judged`: the program on whose steps stability
/// is judged, if it is another one, and its outputs that are not 0 where a run ends.
pub fn explain(
    system: &System,
    types: &Types,
    program: &Program,
    judged: (Option<&Program>, &[Slot]),
    files: &Files,
) -> Explanation {
    let stepped = |program: &Program| {
        let mut program = program.clone();
        if program.description.delays.iter().any(|delay| delay.ring.len == 0) {
            program.size_rings(EXAMPLE_STEP);
        }
        program
    };
    let (given, ends) = (stepped(judged.0.unwrap_or(program)), judged.1);
    let program = stepped(program);
    let steps = Method::fixed().map(|method| {
        let step = fixed_step::step(&program, method);
        let expanded = crate::math::expand(&step);
        let divisions = expanded.ops.iter().filter(|op| matches!(op, Op::Div(..) | Op::Sqrt(_))).count();
        StepCost {
            method,
            plain: step.ops.len(),
            operations: expanded.ops.len(),
            divisions,
            code: code_size(&crate::math::expand(&reassociate(&step, program.balanced))),
            stable: largest_stable(&given, ends, method),
        }
    });
    Explanation {
        model: system.instances.first().map_or(String::new(), |top| top.model.clone()),
        quantities: quantities(system, types, files),
        equations: equations(system, files),
        needs: needs(system),
        states: states(system, &program),
        steps: steps.collect(),
        bytes: 8 * program.description.layout.size(),
        storage: system.storages.iter().map(|(_, energy)| one_line(files, system.span(*energy))).collect(),
        rate_independent: rate_independent(system),
        dissipation: dissipation::dissipation(system, types),
    }
}

/// Every quantity in the order of the text; those of a part follow their owner.
pub fn quantities(system: &System, types: &Types, files: &Files) -> Vec<QuantityInfo> {
    let listed = |id: VarId| {
        let var = system.var(id);
        let unit = &types.units[id.0 as usize];
        QuantityInfo {
            kind: var.kind.word(),
            path: var.path.clone(),
            unit: if types.boolean_vars[id.0 as usize] { "true or false".into() } else { unit.to_string() },
            range: var.range_span.map(|span| files.slice(span).to_string()),
            doc: var.doc.clone(),
        }
    };
    system.var_ids().map(listed).collect()
}

/// Instructions and bytes of the machine code of a function; `None` on a processor without a back end.
fn code_size(func: &Func) -> Option<(usize, usize)> {
    let mut coder = FunctionCompiler::new(here().ok()?);
    // One indented instruction per line; labels are not indented.
    let instructions = coder.assembly(func).ok()?.lines().filter(|line| line.starts_with(' ')).count();
    Some((instructions, coder.function(func).ok()?.code.len()))
}

fn one_line(files: &Files, span: Span) -> String {
    files.slice(span).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Equations in order of evaluation.
fn equations(system: &System, files: &Files) -> Vec<(String, String)> {
    let one_line = |id: ExprId| one_line(files, system.span(id));
    let mut done = vec![false; system.vars.len()];
    let mut order: Vec<VarId> = Vec::new();
    for start in system.var_ids() {
        let mut stack = vec![(start, false)];
        while let Some((id, ready)) = stack.pop() {
            if ready {
                order.push(id);
                continue;
            }
            if std::mem::replace(&mut done[id.0 as usize], true) {
                continue;
            }
            stack.push((id, true));
            if let Some(value) = value_of(system.var(id), Phase::Now) {
                let mut needs = mentioned(system, value);
                needs.reverse();
                stack.extend(needs.into_iter().map(|id| (id, false)));
            }
        }
    }
    let mut out = Vec::new();
    for id in order {
        let var = system.var(id);
        match &var.definition {
            Definition::Value(value, Origin::Default) if var.kind == VarKind::Param => {
                out.push((var.path.clone(), one_line(*value)));
            }
            Definition::Value(value, _) => out.push((var.path.clone(), one_line(*value))),
            Definition::Held { value, .. } => out.push((format!("{} (at ticks)", var.path), one_line(*value))),
            _ => {}
        }
    }
    for id in system.var_ids() {
        let var = system.var(id);
        match &var.definition {
            Definition::Continuous { rate, path, span, .. } => {
                let left = files.slice(*span).trim().to_string();
                let owner = var.path.rsplit_once('.').map_or(String::new(), |(owner, _)| format!("{owner}."));
                let value = path.map_or(*rate, |(value, _)| value);
                out.push((format!("{owner}{left}"), right_side(system, files, *span, value)));
            }
            Definition::Sampled { next, .. } => out.push((format!("next({})", var.path), one_line(*next))),
            _ => {}
        }
    }
    out
}

/// The quantities that each equation mentions.
fn needs(system: &System) -> Vec<(String, Vec<String>)> {
    let of = |id: VarId| {
        let var = system.var(id);
        let values = match var.definition {
            Definition::Missing | Definition::Free => return None,
            Definition::Value(value, _) | Definition::Held { value, .. } => [Some(value), None],
            Definition::Continuous { initial, rate, .. } => [Some(rate), Some(initial)],
            Definition::Sampled { initial, next, .. } => [Some(next), Some(initial)],
        };
        let mut paths: Vec<String> = Vec::new();
        for needed in values.into_iter().flatten().flat_map(|value| mentioned(system, value)) {
            let path = &system.var(needed).path;
            if *path != var.path && !paths.contains(path) {
                paths.push(path.clone());
            }
        }
        Some((var.path.clone(), paths))
    };
    system.var_ids().filter_map(of).collect()
}

/// The right side of an equation as written. One combined from regimes has no text of its own.
fn right_side(system: &System, files: &Files, left: grammar::span::Span, value: ExprId) -> String {
    let span = system.span(value);
    match system.node(value) {
        Node::If(condition, ..) if span == left => match system.node(*condition) {
            Node::InRegime(..) => "by regime".into(),
            _ => files.slice(span).to_string(),
        },
        _ => files.slice(span).split_whitespace().collect::<Vec<_>>().join(" "),
    }
}

fn mentioned(system: &System, id: ExprId) -> Vec<VarId> {
    let mut out = Vec::new();
    let mut seen = crate::ir::hash::HashSet::default();
    let mut stack = vec![id];
    while let Some(id) = stack.pop() {
        if !seen.insert(id) {
            continue;
        }
        let node = system.node(id);
        if let Node::Var(var) = node {
            out.push(*var);
        }
        stack.extend(node.operands());
        stack.extend(rate_of(system, node));
    }
    out
}

/// How each state is integrated.
pub fn states(system: &System, program: &Program) -> Vec<Stepped> {
    let layout = &program.description.layout;
    let n = layout.states.len as usize;
    let slots: Vec<Slot> = (0..n).map(|k| layout.states.slot(k)).collect();
    let build = Shared::new(Build::new("own rates"));
    let gradients = autodiff::inline(&build, &program.derivatives, &mut Env::default(), &slots);
    let mut build = build.into_inner();
    let mut own = Vec::new();
    for (k, slot) in slots.iter().enumerate() {
        let gradient = gradients.get(&layout.derivatives.slot(k)).and_then(|g| autodiff::entry(g, k as u32));
        own.push(match gradient {
            None => SelfDependence::Not,
            Some(rate) if depends(&build, rate, *slot) => SelfDependence::Nonlinear,
            Some(_) => SelfDependence::Affine,
        });
        let rate = gradient.unwrap_or_else(|| build.real(0.0));
        build.store(layout.derivatives.slot(k), rate);
    }
    let rates = crate::math::expand(&build.finish());
    let start = crate::math::expand(&program.start);
    // The greatest own rate over velocities within the range of the input, with the states at their start values.
    let v = program.description.quantities.iter().find(|q| q.path == "v" && q.kind == abi::description::Kind::Input);
    let points: Vec<Option<f64>> = match v {
        Some(v) => {
            [1e-3, 1e-2, 0.1, 1.0, 10.0].into_iter().filter(|x| (v.range.0..=v.range.1).contains(x)).map(Some).collect()
        }
        None => vec![None],
    };
    let mut fastest: Vec<Option<(f64, Option<f64>)>> = vec![None; n];
    let mut block = vec![0.0; layout.size()];
    block[layout.params.range()].copy_from_slice(&program.params);
    for point in points {
        if let (Some(v), Some(x)) = (v, point) {
            block[v.slot.index()] = x;
        }
        crate::ir::interpret::run_once(&start, &mut block, &program.description.pool);
        crate::ir::interpret::run_once(&rates, &mut block, &program.description.pool);
        for k in 0..n {
            let rate = -block[layout.derivatives.slot(k).index()];
            let slower = fastest[k].is_none_or(|(known, _)| rate > known);
            if rate > 0.0 && rate.is_finite() && slower {
                fastest[k] = Some((rate, point));
            }
        }
    }
    let mut out = Vec::new();
    let mut k = 0;
    for var in &system.vars {
        match var.definition {
            Definition::Continuous { .. } => {
                out.push(Stepped { path: var.path.clone(), own: own[k], fastest: fastest[k] });
                k += 1;
            }
            Definition::Sampled { .. } => {
                out.push(Stepped { path: var.path.clone(), own: SelfDependence::Sampled, fastest: None })
            }
            _ => {}
        }
    }
    out
}

/// Whether a value depends on the content of a slot other than through the condition of a branch.
fn depends(build: &Build, value: Value, slot: Slot) -> bool {
    let mut seen = crate::ir::hash::HashSet::default();
    let mut stack = vec![value];
    while let Some(value) = stack.pop() {
        if !seen.insert(value) {
            continue;
        }
        match build.get(value) {
            Op::Load(at) if at == slot => return true,
            // The condition may depend on the state; within each branch the rate is affine.
            Op::Select(_, a, b) => stack.extend([a, b]),
            op => op.each_operand(|operand| stack.push(operand)),
        }
    }
    false
}

/// Whether every derivative is along a path with speed |v|, and v occurs otherwise only in sign(v).
fn rate_independent(system: &System) -> Option<bool> {
    let own = |name: &str, kind: VarKind| {
        system.var_ids().find(|id| {
            let var = system.var(*id);
            var.path == name && var.kind == kind
        })
    };
    let (v, force) = (own("v", VarKind::Input)?, own("F", VarKind::Output)?);
    let speed = |id: ExprId| matches!(system.node(id), Node::Call(Builtin::Abs, args) if matches!(system.node(args[0]), Node::Var(var) if *var == v));
    let mut roots: Vec<ExprId> = value_of(system.var(force), Phase::Now).into_iter().collect();
    let mut states = 0;
    for var in &system.vars {
        if let Definition::Continuous { rate, path, .. } = var.definition {
            states += 1;
            match path {
                Some((value, along)) => match system.var(along).definition {
                    Definition::Continuous { rate, .. } if speed(rate) => roots.push(value),
                    _ => return Some(false),
                },
                None if speed(rate) => {}
                None => return Some(false),
            }
        }
    }
    if states == 0 {
        return Some(false);
    }
    let mut seen = crate::ir::hash::HashSet::default();
    while let Some(id) = roots.pop() {
        if !seen.insert(id) {
            continue;
        }
        match system.node(id) {
            Node::Call(Builtin::Sign, _) => {}
            Node::Binary(BinaryOp::Less | BinaryOp::Greater | BinaryOp::LessEqual | BinaryOp::GreaterEqual, a, b)
                if is_zero(system, *a) || is_zero(system, *b) => {}
            Node::Var(var) if *var == v => return Some(false),
            Node::Rate(_) => return Some(false),
            node => {
                roots.extend(node.operands());
                if let Node::Var(var) = node {
                    roots.extend(value_of(system.var(*var), Phase::Now));
                }
            }
        }
    }
    Some(true)
}

fn is_zero(system: &System, id: ExprId) -> bool {
    system.literal(id) == Some(0.0)
}

impl Stepped {
    /// Describes in words how the state is integrated, and why.
    pub fn words(&self) -> String {
        let name = self.path.rsplit('.').next().unwrap_or(&self.path);
        let mut text = match self.own {
            SelfDependence::Not => format!("integrated: its rate is free of {name}"),
            SelfDependence::Affine => format!("linear in {name}: expo steps it exactly, at any step"),
            SelfDependence::Nonlinear => format!("not linear in {name}: expo linearises it in each step"),
            SelfDependence::Sampled => "sampled: it changes at ticks".to_string(),
        };
        if let Some((rate, at)) = self.fastest {
            let at = at.map_or(String::new(), |v| format!(" at v = {} m/s", three_digits(v)));
            text += &format!("; own rate {} 1/s{at}", three_digits(rate));
        }
        text
    }
}
