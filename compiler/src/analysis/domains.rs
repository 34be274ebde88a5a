//! Domain check: proves that no division by zero occurs and no function is evaluated outside its domain, for all
//! parameters, inputs and states within their declared ranges.
//!
//! In: a model on its own, flat and typed. Out: diagnostics. The bounds of divisors and arguments come from [`Reach`].

use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::functions::{Domain, Unary};
use crate::interval::planted;
use crate::ir::hash::HashSet;
use crate::ranges::reach::{Reach, whole};
use abi::unit::{Dimension, Unit};
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// Reports what cannot be proven safe, and equality comparisons that hardly ever hold.
pub fn check(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    equalities(system, types, files, diagnostics);
    let mut reach = Reach::new(system);
    let mut visit = Visit { seen: vec![HashSet::default()], constants: false };
    for root in roots(system) {
        visit.walk(&mut reach, root, types, files, diagnostics);
    }
}

/// Reports arguments that an experiment passes to its model and that are certainly undefined: `u = chirp(…, 0 s)`.
/// Checks only constants, since a value that depends on time may stay within its domain during the run.
pub fn check_given(system: &System, types: &Types, files: &Files, run: Span, diagnostics: &mut Vec<Diagnostic>) {
    let mut reach = Reach::new(system);
    let mut visit = Visit { seen: vec![HashSet::default()], constants: true };
    let written = |id: ExprId| system.span(id).is_within(run);
    for var in &system.vars {
        match var.definition {
            Definition::Value(value, Origin::Argument { .. }) if written(value) => {
                visit.walk(&mut reach, value, types, files, diagnostics);
            }
            Definition::Value(value, Origin::Override) => visit.walk(&mut reach, value, types, files, diagnostics),
            Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. } if written(initial) => {
                visit.walk(&mut reach, initial, types, files, diagnostics);
            }
            _ => {}
        }
    }
}

/// Every expression that is evaluated before or during a run.
fn roots(system: &System) -> Vec<ExprId> {
    let mut out = Vec::new();
    for var in &system.vars {
        match var.definition {
            Definition::Value(_, Origin::Argument { .. }) if planted::is("arguments are not walked") => {}
            Definition::Value(value, _) | Definition::Held { value, .. } => out.push(value),
            Definition::Continuous { initial, rate, path, .. } => {
                out.extend([initial, path.map_or(rate, |(value, _)| value)]);
            }
            Definition::Sampled { initial, next, .. } => out.extend([initial, next]),
            Definition::Free | Definition::Missing => {}
        }
        out.extend([var.range.low, var.range.high].into_iter().flatten().map(|(bound, _)| bound));
    }
    out.extend(system.blocks.iter().map(|block| block.period));
    for automaton in &system.automata {
        for transition in automaton.regimes.iter().flat_map(|regime| &regime.transitions) {
            out.push(transition.condition);
            out.extend(transition.resets.iter().map(|(_, value)| *value));
        }
    }
    for event in &system.events {
        out.push(event.condition);
        out.extend(event.resets.iter().map(|(_, value)| *value));
    }
    out.extend(system.crossings.iter().map(|crossing| crossing.difference));
    out.extend(system.requires.iter().map(|require| require.condition));
    out
}

// ---- equality of computed quantities

fn equalities(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    for (k, node) in system.nodes.iter().enumerate() {
        let Node::Binary(BinaryOp::Equal | BinaryOp::NotEqual, a, b) = node else { continue };
        if types.boolean[a.0 as usize] || (!computed(system, *a) && !computed(system, *b)) {
            continue;
        }
        let side = if computed(system, *a) { *a } else { *b };
        let dimension = types.nodes[side.0 as usize].unwrap_or(abi::unit::Dimension::NONE);
        let kind = dimension.describe();
        let kind = kind.strip_prefix("a ").or(kind.strip_prefix("an ")).unwrap_or(&kind).to_string();
        let other = if side == *a { *b } else { *a };
        let zero = system.literal(other) == Some(0.0);
        let exactly = if zero { "exactly zero".to_string() } else { "exactly equal to another".into() };
        let name = files.slice(system.span(side));
        let mut error = Diagnostic::error("E0306", format!("a computed {kind} is practically never {exactly}"))
            .label(system.spans[k], "this branch would not be taken");
        error = if kind == "velocity" && zero {
            error.help(format!(
                "say what you mean by rest:\n  - a dead band, as in Karnopp: `if abs({name}) < Dv then ...`\n  - or regimes, as in KFM: `go stick when {name} falls 0`"
            ))
        } else {
            error.help(format!("compare with a tolerance: `abs({name} - …) < …`, or use `crosses` for an instant"))
        };
        diagnostics.push(error);
    }
}

/// Whether the value changes during a run.
fn computed(system: &System, id: ExprId) -> bool {
    match system.node(id) {
        Node::Var(var) => match (&system.var(*var).kind, &system.var(*var).definition) {
            (VarKind::Param, _) => false,
            (_, Definition::Value(value, _)) => computed(system, *value),
            _ => true,
        },
        Node::Time | Node::Rate(_) | Node::PathRate(_) => true,
        node => node.operands().any(|operand| computed(system, operand)),
    }
}

// ---- divisions and domains

struct Visit {
    /// Whether only constant divisors and arguments are checked.
    constants: bool,
    /// Nodes visited without facts, and nodes visited under each of the present facts. Their operands are not visited
    /// again.
    seen: Vec<HashSet<ExprId>>,
}

impl Visit {
    fn walk(&mut self, reach: &mut Reach, id: ExprId, types: &Types, files: &Files, found: &mut Vec<Diagnostic>) {
        if self.seen.iter().any(|seen| seen.contains(&id)) {
            return;
        }
        self.seen.last_mut().expect("there is one without facts").insert(id);
        let system = reach.system();
        match system.node(id) {
            Node::If(c, a, b) => {
                self.walk(reach, *c, types, files, found);
                let decided = reach.decide(*c);
                for (holds, value) in [(true, *a), (false, *b)] {
                    // A branch that is never taken is not checked.
                    if decided != Some(!holds) {
                        self.seen.push(HashSet::default());
                        reach.assuming(*c, holds, |reach| self.walk(reach, value, types, files, found));
                        self.seen.pop();
                    }
                }
            }
            node => {
                for operand in node.operands() {
                    self.walk(reach, operand, types, files, found);
                }
            }
        }
        let judged = match system.node(id) {
            Node::Binary(BinaryOp::Divide, _, x) | Node::Binary(BinaryOp::Power, x, _) => Some(*x),
            Node::Call(builtin, args) => {
                let judged = builtin.domain().map_or(0, |(argument, _)| argument);
                args.get(judged).copied()
            }
            _ => None,
        };
        if self.constants && !judged.is_some_and(|x| reach.interval(x).is_point()) {
            return;
        }
        match system.node(id) {
            Node::Binary(BinaryOp::Divide, _, b) if reach.interval(*b).has_zero() => {
                found.push(division(reach, types, files, *b));
            }
            Node::Binary(BinaryOp::Power, a, b) => self.power(reach, *a, *b, types, files, found),
            Node::Call(builtin, args) => {
                if let Some((k, domain)) = builtin.domain()
                    && !domain.holds(reach.interval(args[k]))
                {
                    found.push(outside(reach, files, args[k], &format!("`{}`", builtin.name()), domain));
                }
            }
            _ => {}
        }
    }

    /// A power with a negative exponent divides; one with a fractional exponent requires a non-negative base.
    fn power(
        &mut self,
        reach: &mut Reach,
        a: ExprId,
        b: ExprId,
        types: &Types,
        files: &Files,
        found: &mut Vec<Diagnostic>,
    ) {
        let system = reach.system();
        let x = reach.interval(a);
        match system.literal(b) {
            Some(n) if n.fract() == 0.0 && n >= 0.0 => {}
            Some(n) if n.fract() == 0.0 => {
                let divisor = if whole(n) { x.power(n.abs() as u32) } else { x };
                if divisor.has_zero() {
                    found.push(division(reach, types, files, a));
                }
            }
            _ if x.is_not_negative() => {
                let n = reach.interval(b);
                if x.has_zero() && n.low < 0.0 && !n.is_empty() && !planted::is("zero has any power") {
                    found.push(match system.literal(b) {
                        Some(_) => division(reach, types, files, a),
                        None => {
                            let (base, power) = (files.slice(system.span(a)), files.slice(system.span(b)));
                            Diagnostic::error("E0601", format!("`{base}` can be zero and `{power}` negative: this can divide by zero"))
                                .label(system.span(b), "not proven to be at least 0")
                                .label(system.span(a), "not proven to stay away from 0")
                                .help(format!("declare the range of one of them, so that `{base}` is `in > 0` or `{power}` is `in >= 0`"))
                        }
                    });
                }
            }
            _ => found.push(outside(reach, files, a, "a power with this exponent", Domain::NOT_NEGATIVE)),
        }
    }
}

/// E0602: an argument that can leave the domain of `what`.
fn outside(reach: &Reach, files: &Files, id: ExprId, what: &str, domain: Domain) -> Diagnostic {
    let text = files.slice(reach.system().span(id));
    let Domain { low, strict, high } = domain;
    let (can_be, range, guard) = match (low, strict) {
        _ if high.is_finite() => {
            (format!("beyond {low} .. {high}"), format!("{low} .. {high}"), format!("clamp({text}, {low}, {high})"))
        }
        (0.0, false) => ("negative".into(), ">= 0".into(), format!("abs({text})")),
        (0.0, true) => ("zero or negative".into(), "> 0".into(), format!("max({text}, …)")),
        (_, true) => (format!("{low} or less"), format!("> {low}"), format!("max({text}, …)")),
        (_, false) => (format!("less than {low}"), format!(">= {low}"), format!("max({text}, {low})")),
    };
    let proven = if high.is_finite() { format!("within {range}") } else { range.clone() };
    Diagnostic::error("E0602", format!("`{text}` can be {can_be}, where {what} is not defined"))
        .label(reach.system().span(id), format!("not proven to be {proven}"))
        .help(format!("declare a range of what it is made of, so that it is `in {range}`, or guard it: `{guard}`"))
}

/// `param Fc [N] = 1 N`: a declaration as written, without the text after its value.
fn declaration(system: &System, files: &Files, var: &Var) -> String {
    let behind = &files.get(var.span.file).text[var.span.end as usize..];
    let unit = behind.trim_start_matches(' ').strip_prefix('[').and_then(|rest| rest.split_once(']'));
    let unit = unit.map_or(String::new(), |(unit, _)| format!(" [{unit}]"));
    let value = match var.definition {
        Definition::Value(value, Origin::Default) => format!(" = {}", files.slice(system.span(value))),
        _ => String::new(),
    };
    format!("{} {}{unit}{value}", var.kind.word(), var.name)
}

/// E0601: names the parameter whose range would resolve the error, if there is one.
fn division(reach: &mut Reach, types: &Types, files: &Files, divisor: ExprId) -> Diagnostic {
    let system = reach.system();
    let text = files.slice(system.span(divisor));
    let here = with_slash(files, system.span(divisor));
    let message = format!("`{text}` can be zero, so this can divide by zero");
    let (params, path) = sources(system, divisor);
    for &param in &params {
        let var = system.var(param);
        let Some(range_span) = var.range_span else { continue };
        if reach.if_strict(param, divisor).has_zero() {
            continue;
        }
        let mut error = Diagnostic::error("E0601", message).label(range_span, format!("{} may be 0", var.name));
        if let Some(&middle) = path.first() {
            let middle_var = system.var(middle);
            let unit = types.units[middle.0 as usize].to_string();
            let unit = if unit == "1" { String::new() } else { format!(" {unit}") };
            let far = vanishing(system, middle).map_or(String::new(), |input| format!(" for large {input}"));
            error = error.label(middle_var.span, format!("then {} reaches 0{unit}{far}", middle_var.name));
        }
        let default = match var.definition {
            Definition::Value(value, _) => format!(" = {}", files.slice(system.span(value))),
            _ => String::new(),
        };
        return error.label(here, "here").help(format!("declare `{} {}{default} in > 0`", var.kind.word(), var.name));
    }
    let error = Diagnostic::error("E0601", message).label(here, "not proven to stay away from 0");
    // A range that would help, for a quantity that is positive by its nature: a velocity has both signs.
    let free = params.iter().copied().find(|&id| {
        let var = system.var(id);
        let dimension = types.units[id.0 as usize].dimension;
        let signed = var.kind == VarKind::Input && [VELOCITY, ANGULAR_VELOCITY].contains(&dimension);
        var.range_span.is_none() && !signed && !reach.if_positive(id, divisor).has_zero()
    });
    if let Some(id) = free {
        let var = system.var(id);
        let label = match system.node(divisor) {
            Node::Var(own) if *own == id => "declared without a range".to_string(),
            _ => format!("{} has no range", var.name),
        };
        let help = format!("declare its range: `{} in > 0`", declaration(system, files, var));
        return error.label(var.span, label).help(help);
    }
    let factor = vanishing_factor(reach, divisor);
    let (text, whole) = (files.slice(system.span(factor)), factor == divisor);
    let error = if whole { error } else { error.label(system.span(factor), "this can be zero") };
    let unit = types.nodes[factor.0 as usize].map_or(String::new(), |dimension| Unit::si(dimension).text);
    let unit = if unit.is_empty() { unit } else { format!(" {unit}") };
    let signed = reach.interval(factor);
    // With a bound on the side where the values are.
    let bounded = match (signed.low >= 0.0, signed.high <= 0.0) {
        (_, true) if signed.low < 0.0 => format!("min({text}, -0.001{unit})"),
        _ => format!("max({text}, 0.001{unit})"),
    };
    if let Some((upper, lower)) = interpolated(system, factor) {
        let lower_var = system.var(lower);
        let range = match lower_var.range_span {
            Some(_) => String::new(),
            None => format!(" and declare `{} in > 0`", declaration(system, files, lower_var)),
        };
        return error.help(format!(
            "if `{upper}` is never below `{lower}`, write `require {upper} >= {lower}`{range}; or keep it away from 0, for \
             example `{bounded}`",
            upper = system.var(upper).name,
            lower = lower_var.name
        ));
    }
    let named = matches!(system.node(factor), Node::Var(_));
    error.help(match named && !(signed.low >= 0.0 || signed.high <= 0.0) {
        // A quantity of both signs has no bound on one side.
        true => format!("keep it away from 0, for example `if abs({text}) > 0.001{unit} then … / {text} else …`"),
        false => format!("keep it away from 0, for example `{bounded}`"),
    })
}

const VELOCITY: Dimension = Dimension::of([0, 1, -1, 0, 0]);
const ANGULAR_VELOCITY: Dimension = Dimension::of([0, 0, -1, 0, 0]);

/// The parameters of `Fc + (Fs - Fc) * w`, upper and lower: such a value lies between them, if it is known which is larger.
fn interpolated(system: &System, sum: ExprId) -> Option<(VarId, VarId)> {
    let var = |id: ExprId| match *system.node(id) {
        Node::Var(id) if system.var(id).kind == VarKind::Param => Some(id),
        _ => None,
    };
    let Node::Binary(BinaryOp::Add, a, b) = *system.node(sum) else { return None };
    let (lower, mut rest) = match (var(a), var(b)) {
        (Some(lower), _) => (lower, b),
        (None, Some(lower)) => (lower, a),
        (None, None) => return None,
    };
    let difference = |id: ExprId| match *system.node(id) {
        Node::Binary(BinaryOp::Subtract, upper, own) if var(own) == Some(lower) => var(upper),
        _ => None,
    };
    for _ in 0..16 {
        if let Some(upper) = difference(rest) {
            return Some((upper, lower));
        }
        let Node::Binary(BinaryOp::Multiply, x, y) = *system.node(rest) else { return None };
        if let Some(upper) = difference(y) {
            return Some((upper, lower));
        }
        rest = x;
    }
    None
}

/// The factor of a divisor that can be zero: the divisor itself unless it is a product, a power or a name for one.
fn vanishing_factor(reach: &mut Reach, divisor: ExprId) -> ExprId {
    let system = reach.system();
    let mut at = divisor;
    for _ in 0..64 {
        at = match *system.node(at) {
            Node::Binary(BinaryOp::Multiply, a, b) => {
                if reach.interval(a).has_zero() {
                    a
                } else {
                    b
                }
            }
            Node::Binary(BinaryOp::Divide | BinaryOp::Power, a, _) => a,
            Node::Negate(a) => a,
            Node::Fits { value, .. } => value,
            Node::Var(id) => match system.var(id).definition {
                Definition::Value(value, _) if matches!(system.var(id).kind, VarKind::Let | VarKind::Output) => value,
                _ => return at,
            },
            _ => return at,
        };
    }
    at
}

/// The span extended to the `/` before it.
fn with_slash(files: &Files, span: Span) -> Span {
    let before = &files.get(span.file).text[..span.start as usize];
    let trimmed = before.trim_end_matches(|c: char| c.is_whitespace() || c == '(');
    match trimmed.strip_suffix('/') {
        Some(rest) => Span::new(span.file, rest.len(), span.end as usize),
        None => span,
    }
}

/// The parameters and inputs on which an expression depends, and the named quantities on the path to them.
fn sources(system: &System, id: ExprId) -> (Vec<VarId>, Vec<VarId>) {
    let (mut params, mut path) = (Vec::new(), Vec::new());
    let mut stack = vec![id];
    while let Some(id) = stack.pop() {
        if let Node::Var(var) = system.node(id) {
            match (system.var(*var).kind, &system.var(*var).definition) {
                (VarKind::Param | VarKind::Input, _) if !params.contains(var) => params.push(*var),
                (VarKind::Let | VarKind::Output, Definition::Value(value, _)) if !path.contains(var) => {
                    path.push(*var);
                    stack.push(*value);
                }
                _ => {}
            }
        }
        let operands: Vec<ExprId> = system.node(id).operands().collect();
        stack.extend(operands.into_iter().rev());
    }
    (params, path)
}

/// The input in the argument of an exponential, which may make the quantity vanish.
fn vanishing(system: &System, id: VarId) -> Option<String> {
    let Definition::Value(value, _) = system.var(id).definition else { return None };
    let mut stack = vec![(value, false)];
    while let Some((id, inside)) = stack.pop() {
        match system.node(id) {
            Node::Var(var) if inside && system.var(*var).kind == VarKind::Input => {
                return Some(system.var(*var).name.clone());
            }
            Node::Call(Builtin::Unary(Unary::Exp), args) => stack.push((args[0], true)),
            node => stack.extend(node.operands().map(|operand| (operand, inside))),
        }
    }
    None
}
