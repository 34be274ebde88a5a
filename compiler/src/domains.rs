//! Proves that nothing divides by zero or leaves the domain of a function, whatever the parameters, inputs and states
//! are within their declared ranges.
//!
//! In: a model on its own, flat and typed. Out: diagnostics. Parameters and inputs are boxes, `require` relations and
//! the conditions of branches are facts. Two forms carry friction: `exp(−x²)` lies in (0, 1], and `a + (b − a)·k` with
//! k in [0, 1] lies between a and b.

use crate::causality::rate_of;
use crate::interval::Interval;
use crate::source::Files;
use crate::system::*;
use crate::units::{Types, literal};
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::collections::HashMap;

/// Reports what cannot be proven safe, and comparisons that practically never hold.
pub fn check(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    equalities(system, types, files, diagnostics);
    let mut prover = Prover::new(system);
    let mut visit = Visit { seen: HashMap::new() };
    for root in roots(system) {
        visit.walk(&mut prover, root, types, files, diagnostics);
    }
}

/// Every expression that is evaluated while a model runs.
fn roots(system: &System) -> Vec<ExprId> {
    let mut out = Vec::new();
    for var in &system.vars {
        match var.definition {
            Definition::Value(value, Origin::Equation(_)) | Definition::Held { value, .. } => out.push(value),
            Definition::Continuous { rate, path, .. } => out.push(path.map_or(rate, |(value, _)| value)),
            Definition::Sampled { next, .. } => out.push(next),
            Definition::Value(..) | Definition::Free | Definition::Missing => {}
        }
    }
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
        let zero = literal(system, other) == Some(0.0);
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

// ---- what quantities can be

/// A condition that holds where an expression is evaluated.
type Fact = (ExprId, bool);

/// Finds what expressions can be.
pub struct Prover<'a> {
    system: &'a System,
    /// a ≥ b, or a > b if strict.
    relations: Vec<(ExprId, ExprId, bool)>,
    facts: Vec<Fact>,
    known: HashMap<ExprId, Interval>,
    open: Vec<VarId>,
    /// Quantities whose declared range is being read: a range that leads back to its own quantity says nothing.
    bounding: Vec<VarId>,
    /// Parameters whose range is taken without its ends: what if it were declared so?
    strict: Vec<VarId>,
}

impl<'a> Prover<'a> {
    /// Takes the `require` statements as facts.
    pub fn new(system: &'a System) -> Prover<'a> {
        let mut relations = Vec::new();
        let mut stack: Vec<ExprId> = system.requires.iter().map(|require| require.condition).collect();
        while let Some(id) = stack.pop() {
            match system.node(id) {
                Node::Binary(BinaryOp::And, a, b) => stack.extend([*a, *b]),
                Node::Binary(BinaryOp::GreaterEqual, a, b) => relations.push((*a, *b, false)),
                Node::Binary(BinaryOp::Greater, a, b) => relations.push((*a, *b, true)),
                Node::Binary(BinaryOp::LessEqual, a, b) => relations.push((*b, *a, false)),
                Node::Binary(BinaryOp::Less, a, b) => relations.push((*b, *a, true)),
                _ => {}
            }
        }
        Prover {
            system,
            relations,
            facts: Vec::new(),
            known: HashMap::new(),
            open: Vec::new(),
            bounding: Vec::new(),
            strict: Vec::new(),
        }
    }

    /// What an expression can be.
    pub fn interval(&mut self, id: ExprId) -> Interval {
        if self.facts.is_empty()
            && let Some(known) = self.known.get(&id)
        {
            return *known;
        }
        let mut interval = self.find(id);
        for k in 0..self.facts.len() {
            interval = interval.and(self.told(self.facts[k], id));
        }
        if self.facts.is_empty() {
            self.known.insert(id, interval);
        }
        interval
    }

    /// What a fact says of an expression.
    fn told(&mut self, (condition, holds): Fact, id: ExprId) -> Interval {
        let Node::Binary(op, a, b) = *self.system.node(condition) else { return Interval::ALL };
        let (low, high, strict) = match (op, holds) {
            (BinaryOp::And, true) | (BinaryOp::Or, false) => {
                return self.told((a, holds), id).and(self.told((b, holds), id));
            }
            (BinaryOp::Less, true) | (BinaryOp::GreaterEqual, false) => (a, b, true),
            (BinaryOp::LessEqual, true) | (BinaryOp::Greater, false) => (a, b, false),
            (BinaryOp::Greater, true) | (BinaryOp::LessEqual, false) => (b, a, true),
            (BinaryOp::GreaterEqual, true) | (BinaryOp::Less, false) => (b, a, false),
            (BinaryOp::NotEqual, true) | (BinaryOp::Equal, false) => {
                let zero = |id: ExprId| literal(self.system, id) == Some(0.0);
                let other = (self.same(a, id) && zero(b)) || (self.same(b, id) && zero(a));
                return Interval { not_zero: other, ..Interval::ALL };
            }
            _ => return Interval::ALL,
        };
        if self.same(low, id) {
            let bound = self.plain(high);
            return Interval { high: bound.high, below_high: strict || bound.below_high, ..Interval::ALL };
        }
        if self.same(high, id) {
            let bound = self.plain(low);
            return Interval { low: bound.low, above_low: strict || bound.above_low, ..Interval::ALL };
        }
        // |x| > a with a ≥ 0: x is not 0.
        if let Node::Call(Builtin::Abs, args) = self.system.node(high)
            && self.same(args[0], id)
        {
            let bound = self.plain(low);
            if bound.is_positive() || (strict && bound.is_not_negative()) {
                return Interval { not_zero: true, ..Interval::ALL };
            }
        }
        if let Node::Call(Builtin::Abs, args) = self.system.node(low)
            && self.same(args[0], id)
        {
            let bound = self.plain(high);
            return Interval {
                low: -bound.high,
                high: bound.high,
                above_low: strict || bound.below_high,
                below_high: strict || bound.below_high,
                not_zero: false,
            };
        }
        Interval::ALL
    }

    /// As [`interval`](Self::interval), without the facts of branches.
    fn plain(&mut self, id: ExprId) -> Interval {
        let facts = std::mem::take(&mut self.facts);
        let interval = self.interval(id);
        self.facts = facts;
        interval
    }

    fn same(&self, a: ExprId, b: ExprId) -> bool {
        if a == b {
            return true;
        }
        match (self.system.node(a), self.system.node(b)) {
            (Node::Fits { value, .. }, _) => self.same(*value, b),
            (_, Node::Fits { value, .. }) => self.same(a, *value),
            (Node::Var(x), Node::Var(y)) | (Node::Rate(x), Node::Rate(y)) | (Node::PathRate(x), Node::PathRate(y)) => {
                x == y
            }
            (Node::Number { value: x, .. }, Node::Number { value: y, .. }) => x == y,
            (Node::Negate(x), Node::Negate(y)) => self.same(*x, *y),
            (Node::Binary(op, a, b), Node::Binary(other, c, d)) => {
                op == other && self.same(*a, *c) && self.same(*b, *d)
            }
            (Node::Call(f, xs), Node::Call(g, ys)) => {
                f == g && xs.len() == ys.len() && xs.iter().zip(ys).all(|(x, y)| self.same(*x, *y))
            }
            _ => false,
        }
    }

    fn bounds(&mut self, id: VarId) -> Interval {
        let range = self.system.var(id).range;
        let strict = self.strict.contains(&id);
        let mut out = Interval::ALL;
        if self.bounding.contains(&id) {
            return out;
        }
        self.bounding.push(id);
        if let Some((bound, open)) = range.low {
            let bound = self.plain(bound);
            (out.low, out.above_low) = (bound.low, open || strict || bound.above_low);
        }
        if let Some((bound, open)) = range.high {
            let bound = self.plain(bound);
            (out.high, out.below_high) = (bound.high, open || strict || bound.below_high);
        }
        self.bounding.pop();
        out
    }

    fn var(&mut self, id: VarId) -> Interval {
        let bounds = self.bounds(id);
        if self.open.contains(&id) {
            return bounds;
        }
        let var = self.system.var(id);
        let value = match var.definition {
            // The default of a parameter is only one of its values; an argument is all of them.
            Definition::Value(_, Origin::Default) => return bounds,
            Definition::Value(value, _) | Definition::Held { value, .. } => value,
            _ => return bounds,
        };
        self.open.push(id);
        let found = self.interval(value);
        self.open.pop();
        found.and(bounds)
    }

    fn find(&mut self, id: ExprId) -> Interval {
        let system = self.system;
        match system.node(id) {
            Node::Number { value, .. } => Interval::point(*value),
            Node::Time => Interval { low: 0.0, above_low: false, ..Interval::ALL },
            Node::Rate(var) if !self.open.contains(var) => {
                self.open.push(*var);
                let found = rate_of(system, system.node(id)).map_or(Interval::ALL, |rate| self.interval(rate));
                self.open.pop();
                found
            }
            Node::Var(var) => self.var(*var),
            Node::Negate(a) => self.interval(*a).negate(),
            Node::Fits { value, .. } => self.interval(*value),
            Node::If(c, a, b) => {
                self.facts.push((*c, true));
                let yes = self.interval(*a);
                self.facts.pop();
                self.facts.push((*c, false));
                let no = self.interval(*b);
                self.facts.pop();
                yes.hull(no)
            }
            Node::Binary(op, a, b) => self.binary(*op, *a, *b),
            Node::Call(builtin, args) => self.call(*builtin, args),
            Node::Table(table, _) => {
                let y = &system.tables[*table as usize].y;
                let low = y.iter().copied().fold(f64::INFINITY, f64::min);
                Interval::closed(low, y.iter().copied().fold(f64::NEG_INFINITY, f64::max))
            }
            _ => Interval::ALL,
        }
    }

    fn binary(&mut self, op: BinaryOp, a: ExprId, b: ExprId) -> Interval {
        match op {
            BinaryOp::Add => {
                if let Some(between) = self.mixture(a, b).or_else(|| self.mixture(b, a)) {
                    return between;
                }
                let (x, y) = (self.interval(a), self.interval(b));
                x.plus(y)
            }
            BinaryOp::Subtract => {
                if self.same(a, b) {
                    return Interval::point(0.0);
                }
                let (x, y) = (self.interval(a), self.interval(b));
                let mut out = x.plus(y.negate());
                for k in 0..self.relations.len() {
                    let (large, small, strict) = self.relations[k];
                    let positive = Interval { low: 0.0, above_low: strict, ..Interval::ALL };
                    if self.same(large, a) && self.same(small, b) {
                        out = out.and(positive);
                    } else if self.same(large, b) && self.same(small, a) {
                        out = out.and(positive.negate());
                    }
                }
                out
            }
            BinaryOp::Multiply if self.same(a, b) => self.interval(a).square(),
            BinaryOp::Multiply => {
                let (x, y) = (self.interval(a), self.interval(b));
                x.multiply(y)
            }
            BinaryOp::Divide => {
                let (x, y) = (self.interval(a), self.interval(b));
                x.divide(y)
            }
            BinaryOp::Power => {
                let x = self.interval(a);
                match literal(self.system, b) {
                    Some(n) if n.fract() == 0.0 && (0.0..=16.0).contains(&n) => {
                        let n = n as u32;
                        let mut out = if n % 2 == 1 { x } else { Interval::point(1.0) };
                        for _ in 0..n / 2 {
                            out = out.multiply(x.square());
                        }
                        out
                    }
                    Some(n) if n.fract() == 0.0 && n < 0.0 => Interval::point(1.0).divide(x.square()),
                    _ if x.is_positive() => Interval { low: 0.0, above_low: true, ..Interval::ALL },
                    _ if x.is_not_negative() => Interval { low: 0.0, above_low: false, ..Interval::ALL },
                    _ => Interval::ALL,
                }
            }
            _ => Interval::ALL,
        }
    }

    /// `a + (b − a)·k` with k in [0, 1] lies between a and b.
    fn mixture(&mut self, a: ExprId, rest: ExprId) -> Option<Interval> {
        let Node::Binary(BinaryOp::Multiply, x, y) = *self.system.node(rest) else { return None };
        for (difference, weight) in [(x, y), (y, x)] {
            let Node::Binary(BinaryOp::Subtract, b, other) = *self.system.node(difference) else { continue };
            if !self.same(other, a) {
                continue;
            }
            let k = self.interval(weight);
            if k.low >= 0.0 && k.high <= 1.0 {
                let (from, to) = (self.interval(a), self.interval(b));
                let mut between = from.hull(to);
                // With b ≥ a the smaller end is a's.
                let above = self.relations.iter().any(|(large, small, _)| self.same(*large, b) && self.same(*small, a));
                if above {
                    (between.low, between.above_low) = (from.low, from.above_low);
                }
                return Some(between);
            }
        }
        None
    }

    fn call(&mut self, builtin: Builtin, args: &[ExprId]) -> Interval {
        let values: Vec<Interval> = args.iter().map(|arg| self.interval(*arg)).collect();
        let unit = Interval::closed(-1.0, 1.0);
        let line = (f64::NEG_INFINITY, f64::INFINITY);
        match builtin {
            Builtin::Abs => values[0].abs(),
            Builtin::Sign => unit.and(values[0].rising(f64::signum, (-1.0, 1.0)).hull(Interval::point(0.0))),
            Builtin::Min => values[0].min(values[1]),
            Builtin::Max => values[0].max(values[1]),
            Builtin::Clamp => values[0].max(values[1]).min(values[2]),
            Builtin::Floor => values[0].rising(f64::floor, line),
            Builtin::Sqrt => values[0].max(Interval::point(0.0)).rising(f64::sqrt, line),
            Builtin::Exp => Interval { not_zero: true, ..values[0].rising(bounds::exp, (0.0, f64::INFINITY)) },
            Builtin::Expm1 => values[0].rising(bounds::expm1, (-1.0, f64::INFINITY)),
            Builtin::Sin | Builtin::Cos => unit,
            Builtin::Tanh => values[0].rising(bounds::tanh, (-1.0, 1.0)),
            Builtin::Atan => {
                values[0].rising(bounds::atan, (-std::f64::consts::FRAC_PI_2, std::f64::consts::FRAC_PI_2))
            }
            Builtin::Cosh => Interval { low: 1.0, above_low: false, not_zero: true, ..Interval::ALL },
            Builtin::Hypot => Interval { low: 0.0, above_low: false, ..Interval::ALL },
            Builtin::Delay => values[0],
            Builtin::Random => Interval { low: 0.0, high: 1.0, above_low: false, below_high: true, not_zero: false },
            Builtin::Step => values[1].hull(Interval::point(0.0)),
            Builtin::Pulse => values[2].hull(Interval::point(0.0)),
            Builtin::Sine | Builtin::Square | Builtin::Chirp | Builtin::Noise => unit.multiply(values[0]),
            Builtin::Acos | Builtin::Asin | Builtin::Atan2 => Interval::closed(-4.0, 4.0),
            Builtin::Log | Builtin::Log1p | Builtin::Tan | Builtin::Sinh | Builtin::Ramp => Interval::ALL,
        }
    }
}

/// Elementary functions at the ends of intervals: no value of a run comes from here, so the platform's will do.
mod bounds {
    #![expect(clippy::disallowed_methods, reason = "bounds of intervals, not values of a run")]

    pub fn exp(x: f64) -> f64 {
        x.exp()
    }

    pub fn expm1(x: f64) -> f64 {
        x.exp_m1()
    }

    pub fn tanh(x: f64) -> f64 {
        x.tanh()
    }

    pub fn atan(x: f64) -> f64 {
        x.atan()
    }
}

// ---- divisions and domains

struct Visit {
    /// Nodes visited without facts: their operands need no second look.
    seen: HashMap<ExprId, ()>,
}

impl Visit {
    fn walk(
        &mut self,
        prover: &mut Prover,
        id: ExprId,
        types: &Types,
        files: &Files,
        diagnostics: &mut Vec<Diagnostic>,
    ) {
        if prover.facts.is_empty() && self.seen.insert(id, ()).is_some() {
            return;
        }
        let system = prover.system;
        let mut walk = |prover: &mut Prover, id| self.walk(prover, id, types, files, diagnostics);
        match system.node(id) {
            Node::If(c, a, b) => {
                walk(prover, *c);
                prover.facts.push((*c, true));
                walk(prover, *a);
                prover.facts.pop();
                prover.facts.push((*c, false));
                walk(prover, *b);
                prover.facts.pop();
            }
            node => {
                for operand in node.operands() {
                    walk(prover, operand);
                }
            }
        }
        match system.node(id) {
            Node::Binary(BinaryOp::Divide, _, b) if prover.interval(*b).has_zero() => {
                diagnostics.push(division(prover, types, files, *b));
            }
            Node::Binary(BinaryOp::Power, a, b) => {
                let x = prover.interval(*a);
                match literal(system, *b) {
                    Some(n) if n.fract() == 0.0 && n >= 0.0 => {}
                    Some(n) if n.fract() == 0.0 => {
                        if x.has_zero() {
                            diagnostics.push(division(prover, types, files, *a));
                        }
                    }
                    _ if x.is_not_negative() => {}
                    _ => diagnostics.push(domain(prover, files, *a, "a power", "negative", "0", "abs")),
                }
            }
            Node::Call(Builtin::Sqrt, args) if !prover.interval(args[0]).is_not_negative() => {
                diagnostics.push(domain(prover, files, args[0], "`sqrt`", "negative", ">= 0", "abs"));
            }
            // The time in which a chirp sweeps, and for which noise keeps a value.
            Node::Call(Builtin::Chirp, args) if !prover.interval(args[3]).is_positive() => {
                diagnostics.push(domain(prover, files, args[3], "`chirp`", "zero or negative", "> 0", "max"));
            }
            Node::Call(Builtin::Noise, args) if !prover.interval(args[1]).is_positive() => {
                diagnostics.push(domain(prover, files, args[1], "`noise`", "zero or negative", "> 0", "max"));
            }
            Node::Call(Builtin::Log, args) if !prover.interval(args[0]).is_positive() => {
                diagnostics.push(domain(prover, files, args[0], "`log`", "zero or negative", "> 0", "max"));
            }
            Node::Call(arc @ (Builtin::Asin | Builtin::Acos), args) => {
                let x = prover.interval(args[0]);
                if x.low < -1.0 || x.high > 1.0 {
                    let arc = format!("`{}`", arc.name());
                    diagnostics.push(domain(prover, files, args[0], &arc, "beyond -1 .. 1", "-1 .. 1", "clamp"));
                }
            }
            _ => {}
        }
    }
}

fn domain(
    prover: &Prover,
    files: &Files,
    id: ExprId,
    what: &str,
    can_be: &str,
    range: &str,
    guard: &str,
) -> Diagnostic {
    let text = files.slice(prover.system.span(id));
    let shown = match guard {
        "clamp" => format!("clamp({text}, -1, 1)"),
        "max" => format!("max({text}, …)"),
        other => format!("{other}({text})"),
    };
    // A power of a negative number is one only if its exponent is whole.
    let (what, range) = if range == "0" { ("a power with this exponent", ">= 0") } else { (what, range) };
    Diagnostic::error("E0602", format!("`{text}` can be {can_be}, where {what} is not defined"))
        .label(prover.system.span(id), format!("not proven to be {}", range.replace("-1 .. 1", "within -1 .. 1")))
        .help(format!("declare a range of what it is made of, so that it is `in {range}`, or guard it: `{shown}`"))
}

/// `param Fc [N] = 1 N`: the declaration of a quantity as written, without what stands behind its value.
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

/// E0601: names the parameter whose range would mend it, if one does.
fn division(prover: &mut Prover, types: &Types, files: &Files, divisor: ExprId) -> Diagnostic {
    let system = prover.system;
    let text = files.slice(system.span(divisor));
    let here = with_slash(files, system.span(divisor));
    let message = format!("`{text}` can be zero, so this can divide by zero");
    let (params, path) = sources(system, divisor);
    for &param in &params {
        let var = system.var(param);
        let Some(range_span) = var.range_span else { continue };
        let facts = std::mem::take(&mut prover.facts);
        let known = std::mem::take(&mut prover.known);
        prover.strict.push(param);
        let safe = !prover.interval(divisor).has_zero();
        prover.strict.pop();
        (prover.facts, prover.known) = (facts, known);
        if !safe {
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
    let free = params.iter().map(|id| system.var(*id)).find(|var| var.range_span.is_none());
    match (system.node(divisor), free) {
        (Node::Var(id), _) if matches!(system.var(*id).kind, VarKind::Param | VarKind::Input) => {
            let var = system.var(*id);
            error
                .label(var.span, "declared without a range")
                .help(format!("declare its range: `{} in > 0`", declaration(system, files, var)))
        }
        (_, Some(var)) => error
            .label(var.span, format!("{} has no range", var.name))
            .help(format!("declare its range: `{} in > 0`", declaration(system, files, var))),
        _ => error
            .help(format!("guard it: `if abs({text}) > … then … / {text} else …`, or keep it away from 0 with `max`")),
    }
}

/// The span with the `/` before it.
fn with_slash(files: &Files, span: Span) -> Span {
    let before = &files.get(span.file).text[..span.start as usize];
    let trimmed = before.trim_end_matches(|c: char| c.is_whitespace() || c == '(');
    match trimmed.strip_suffix('/') {
        Some(rest) => Span::new(span.file, rest.len(), span.end as usize),
        None => span,
    }
}

/// Parameters an expression depends on, and the named quantities on the way.
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

/// The input that makes an exponential in a quantity vanish.
fn vanishing(system: &System, id: VarId) -> Option<String> {
    let Definition::Value(value, _) = system.var(id).definition else { return None };
    let mut stack = vec![(value, false)];
    while let Some((id, inside)) = stack.pop() {
        match system.node(id) {
            Node::Var(var) if inside && system.var(*var).kind == VarKind::Input => {
                return Some(system.var(*var).name.clone());
            }
            Node::Call(Builtin::Exp, args) => stack.push((args[0], true)),
            node => stack.extend(node.operands().map(|operand| (operand, inside))),
        }
    }
    None
}
