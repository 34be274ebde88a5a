//! Dimension inference: assigns a dimension to every expression and reports dimensions that do not match.
//!
//! In: a flat [`System`]. Out: [`Types`] and diagnostics. Quantities without a declared unit are inferred by
//! unification: dimensions form a vector space over the rationals, so an equation between them is linear, and one of
//! its unknowns can be eliminated (Kennedy, *Types for units-of-measure*, 2010).

use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::functions::{Unary, Units};
use abi::unit::{Dimension, Ratio, Unit};
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// Dimensions and truth values of a system.
#[derive(Clone, Debug, Default)]
pub struct Types {
    /// Dimension of each node; `None` where unknown.
    pub nodes: Vec<Option<Dimension>>,
    /// Whether each node is a truth value rather than a quantity.
    pub boolean: Vec<bool>,
    /// Unit in which each quantity is displayed.
    pub units: Vec<Unit>,
    /// Whether each variable is a truth value rather than a quantity.
    pub boolean_vars: Vec<bool>,
}

const TIME: Dimension = Dimension::of([0, 0, 1, 0, 0]);
const RATE: Dimension = Dimension::of([0, 0, -1, 0, 0]);
const ENERGY: Dimension = Dimension::of([1, 2, -2, 0, 0]);

/// Checks and infers the units of a system.
pub fn check(system: &System, files: &Files, diagnostics: &mut Vec<Diagnostic>) -> Types {
    let mut found = Vec::new();
    let (types, mut strangers) = walk(system, files, &system.strangers, &mut found);
    if strangers.is_empty() {
        diagnostics.extend(found);
        return types;
    }
    // A straight model in a rotary slot has mismatched units everywhere. The second pass reports only the cause.
    strangers.extend(&system.strangers);
    let mut again = Vec::new();
    let (types, _) = walk(system, files, &strangers, &mut again);
    diagnostics.extend(found.into_iter().filter(|diagnostic| diagnostic.code == "E0108"));
    diagnostics.extend(again);
    types
}

/// One pass, in which the quantities of `strangers` match every dimension. Returns the instances found to be of the
/// other kind of motion.
fn walk(
    system: &System,
    files: &Files,
    strangers: &[InstanceId],
    diagnostics: &mut Vec<Diagnostic>,
) -> (Types, Vec<InstanceId>) {
    let mut checker = Checker {
        system,
        files,
        strangers,
        found: Vec::new(),
        diagnostics,
        unknowns: Vec::new(),
        types: vec![NodeType::Unknown; system.nodes.len()],
        vars: Vec::new(),
    };
    checker.declare();
    let early: Vec<bool> = system.var_ids().map(|id| checker.is_inferred_from_its_definition(id)).collect();
    for typed in order(system, &early) {
        match typed {
            Typed::Node(id) => {
                let found = checker.node(id);
                checker.types[id.0 as usize] = checker.within_reason(id, found);
            }
            Typed::Definition(id) => checker.definition(id),
        }
    }
    checker.statements();
    let found = std::mem::take(&mut checker.found);
    (checker.finish(), found)
}

/// What receives a type in turn.
#[derive(Clone, Copy)]
enum Typed {
    Node(ExprId),
    Definition(VarId),
}

/// All expressions and definitions in the order in which they are typed. Operands precede their expression, and the
/// definition of an `early` quantity precedes its uses, so that a use that does not fit is reported, and not the
/// definition. The others follow after all expressions, as do definitions that depend on each other.
fn order(system: &System, early: &[bool]) -> Vec<Typed> {
    let (nodes, vars) = (system.nodes.len(), system.vars.len());
    let is_early = |id: &VarId| early[id.0 as usize];
    let index = |typed: Typed| match typed {
        Typed::Node(id) => id.0 as usize,
        Typed::Definition(id) => nodes + id.0 as usize,
    };
    let (mut begun, mut done) = (vec![false; nodes + vars], vec![false; nodes + vars]);
    let mut out = Vec::with_capacity(nodes + vars);
    // These definitions first: a definition that is entered through its own expression would be typed before it.
    let all = system.var_ids().filter(is_early).map(Typed::Definition);
    let all = all.chain((0..nodes).map(|node| Typed::Node(ExprId(node as u32))));
    let mut stack: Vec<(Typed, bool)> = Vec::new();
    for first in all {
        stack.push((first, false));
        while let Some((typed, operands_done)) = stack.pop() {
            let needs: Vec<Typed> = match typed {
                Typed::Node(id) => match system.node(id) {
                    Node::Var(var) | Node::Rate(var) | Node::PathRate(var) => {
                        Some(*var).filter(is_early).map(Typed::Definition).into_iter().collect()
                    }
                    node => node.operands().map(Typed::Node).collect(),
                },
                Typed::Definition(id) => expressions(system.var(id)).into_iter().map(Typed::Node).collect(),
            };
            match (typed, operands_done) {
                (_, false) if !std::mem::replace(&mut begun[index(typed)], true) => {
                    stack.push((typed, true));
                    stack.extend(needs.into_iter().rev().map(|need| (need, false)));
                }
                (_, false) => {}
                (Typed::Definition(_), true) if needs.iter().any(|need| !done[index(*need)]) => {}
                (_, true) => {
                    done[index(typed)] = true;
                    out.push(typed);
                }
            }
        }
    }
    out.extend(system.var_ids().map(Typed::Definition).filter(|typed| !done[index(*typed)]));
    out
}

/// The expressions that define a quantity, with the bounds of its range.
fn expressions(var: &Var) -> Vec<ExprId> {
    let bounds = [&var.range.low, &var.range.high].into_iter().flatten().map(|(bound, _)| *bound);
    values(var).into_iter().chain(bounds).collect()
}

/// The same without the bounds.
fn values(var: &Var) -> Vec<ExprId> {
    match var.definition {
        Definition::Missing | Definition::Free => Vec::new(),
        Definition::Value(value, _) | Definition::Held { value, .. } => vec![value],
        Definition::Continuous { initial, rate, path, .. } => {
            [initial, rate].into_iter().chain(path.map(|(slope, _)| slope)).collect()
        }
        Definition::Sampled { initial, next, .. } => vec![initial, next],
    }
}

/// E0105: an exponent too large to be represented.
fn too_large(message: &str, span: Span) -> Diagnostic {
    let error = Diagnostic::error("E0105", message).label(span, "a quantity to this power");
    error.help("make the base a pure number first: divide it by a quantity of its kind")
}

/// A dimension with unknowns: `base · Π unknown^exponent`.
#[derive(Clone, PartialEq, Debug)]
struct Term {
    base: Dimension,
    unknowns: Vec<(u32, Ratio)>,
}

impl Term {
    fn known(base: Dimension) -> Term {
        Term { base, unknowns: Vec::new() }
    }

    fn times(&self, other: &Term, exponent: Ratio) -> Term {
        let mut out = Term { base: self.base.times(other.base.power(exponent)), unknowns: self.unknowns.clone() };
        for (unknown, e) in &other.unknowns {
            let e = *e * exponent;
            match out.unknowns.iter_mut().find(|(known, _)| known == unknown) {
                Some((_, sum)) => *sum = *sum + e,
                None => out.unknowns.push((*unknown, e)),
            }
        }
        out.unknowns.retain(|(_, e)| !e.is_zero());
        out
    }
}

/// The type of a node or quantity.
#[derive(Clone, PartialEq, Debug)]
enum NodeType {
    Boolean,
    Real(Term),
    /// Has been reported; matches every type.
    Unknown,
}

impl NodeType {
    fn is_inferred(&self) -> bool {
        matches!(self, NodeType::Real(term) if !term.unknowns.is_empty())
    }
}

struct Checker<'a> {
    system: &'a System,
    files: &'a Files,
    /// Instances whose quantities match every dimension.
    strangers: &'a [InstanceId],
    /// Instances found to be straight in a rotary slot, or rotary in a straight one.
    found: Vec<InstanceId>,
    diagnostics: &'a mut Vec<Diagnostic>,
    /// The substitution: the term of each unknown solved so far.
    unknowns: Vec<Option<Term>>,
    types: Vec<NodeType>,
    vars: Vec<NodeType>,
}

impl Checker<'_> {
    /// E0105: an exponent of an inferred dimension too large to be represented.
    fn within_reason(&mut self, id: ExprId, found: NodeType) -> NodeType {
        let beyond = |term: &Term| term.base.is_beyond() || term.unknowns.iter().any(|(_, e)| e.is_beyond());
        if !matches!(&found, NodeType::Real(term) if beyond(term)) {
            return found;
        }
        self.diagnostics.push(too_large("the exponents of the unit of this are beyond reason", self.system.span(id)));
        NodeType::Unknown
    }

    fn fresh(&mut self) -> Term {
        self.unknowns.push(None);
        Term { base: Dimension::NONE, unknowns: vec![(self.unknowns.len() as u32 - 1, Ratio::ONE)] }
    }

    fn resolved(&self, term: &Term) -> Term {
        let mut term = term.clone();
        while let Some((unknown, exponent)) =
            term.unknowns.iter().copied().find(|(unknown, _)| self.unknowns[*unknown as usize].is_some())
        {
            term.unknowns.retain(|(other, _)| *other != unknown);
            let found = self.unknowns[unknown as usize].clone().expect("just found");
            term = term.times(&found, exponent);
        }
        term
    }

    /// Unifies two terms; returns false if that is impossible.
    fn unify(&mut self, a: &Term, b: &Term) -> bool {
        if a.unknowns.is_empty() && b.unknowns.is_empty() {
            return a.base == b.base;
        }
        let difference = self.resolved(&a.times(b, Ratio::whole(-1)));
        match difference.unknowns.first().copied() {
            None => difference.base.is_none(),
            Some((unknown, exponent)) => {
                let (num, den) = exponent.parts();
                let mut rest = difference;
                rest.unknowns.remove(0);
                let nothing = Term::known(Dimension::NONE);
                self.unknowns[unknown as usize] = Some(nothing.times(&rest, Ratio::new(-(den as i64), num as i64)));
                true
            }
        }
    }

    fn kind(&self, id: ExprId) -> &NodeType {
        &self.types[id.0 as usize]
    }

    fn real(&mut self, id: ExprId) -> Option<Term> {
        match self.kind(id).clone() {
            NodeType::Real(term) => Some(term),
            NodeType::Unknown => None,
            NodeType::Boolean => {
                let error = Diagnostic::error("E0101", "a condition cannot be used as a quantity")
                    .label(self.system.span(id), "true or false")
                    .help("write `if … then 1 else 0`");
                self.diagnostics.push(error);
                None
            }
        }
    }

    fn shown(&self, term: &Term) -> String {
        Unit::si(self.resolved(term).base).to_string()
    }

    fn described(&self, term: &Term) -> String {
        self.resolved(term).base.describe()
    }

    fn text(&self, id: ExprId) -> &str {
        self.files.slice(self.system.span(id))
    }

    /// For a unit such as `0.006 1/N·m`, which reads as (1/N)·m where 1/(N·m) is needed: how it is read, and the number
    /// with the unit that fits.
    fn left_to_right(&self, value: ExprId, wanted: &Term) -> Option<String> {
        let (number, unit) = self.text(value).trim().split_once(' ')?;
        let (above, below) = unit.trim().split_once('/')?;
        let (first, rest) = below.split_once(['·', '*'])?;
        let meant = format!("{above}/{}", below.replace(['·', '*'], "/"));
        let wanted = self.resolved(wanted);
        let fits = wanted.unknowns.is_empty() && Unit::parse(&meant).ok()?.dimension == wanted.base;
        let unit = unit.trim();
        fits.then(|| {
            format!("a unit is read from left to right: `{unit}` is ({above}/{first})·{rest}; write `{number} {meant}`")
        })
    }

    // ---- quantities

    fn declare(&mut self) {
        let boolean = boolean_vars(self.system);
        for (var, boolean) in self.system.vars.iter().zip(boolean) {
            let kind = match (&var.unit, var.kind) {
                _ if var.unreadable || self.strangers.contains(&var.instance) => NodeType::Unknown,
                (Some((unit, _)), _) => NodeType::Real(Term::known(unit.dimension)),
                _ if boolean => NodeType::Boolean,
                (None, VarKind::Param) if var.shown.is_some() => {
                    NodeType::Real(Term::known(var.shown.as_ref().map_or(Dimension::NONE, |unit| unit.dimension)))
                }
                (None, VarKind::Input) => {
                    let error = Diagnostic::error("E0106", format!("input `{}` does not say its unit", var.name))
                        .label(var.span, "a port states its unit, so that errors stay local");
                    self.diagnostics.push(error.help(format!(
                        "write `input {0} [m/s]`, with the unit that is meant; `input {0} [1]` for a pure number",
                        var.name
                    )));
                    NodeType::Unknown
                }
                (None, _) => NodeType::Real(self.fresh()),
            };
            self.vars.push(kind);
        }
    }

    /// Whether the definition of a quantity gives it its unit. A pure number may lack the unit that its uses imply:
    /// then the number is reported. An argument or a changed value is checked against the model, as a use is.
    fn is_inferred_from_its_definition(&self, id: VarId) -> bool {
        let var = self.system.var(id);
        let origin = match var.definition {
            Definition::Value(_, origin) | Definition::Held { origin, .. } => origin,
            _ => self.system.start_origin(id),
        };
        let is_of_the_model = matches!(origin, Origin::Equation(_) | Origin::Default);
        let has_bare_value = || values(var).into_iter().any(|value| self.is_bare(value));
        self.vars[id.0 as usize].is_inferred() && is_of_the_model && !has_bare_value()
    }

    // ---- nodes

    fn node(&mut self, id: ExprId) -> NodeType {
        let number = NodeType::Real(Term::known(Dimension::NONE));
        match self.system.node(id).clone() {
            Node::Number { dimension: Some(dimension), .. } => NodeType::Real(Term::known(dimension)),
            Node::Number { dimension: None, .. } | Node::Hole => NodeType::Real(self.fresh()),
            Node::Bool(_) | Node::InRegime(..) => NodeType::Boolean,
            Node::Time => NodeType::Real(Term::known(TIME)),
            Node::Var(var) => self.vars[var.0 as usize].clone(),
            Node::Rate(var) => match &self.vars[var.0 as usize] {
                NodeType::Real(term) => NodeType::Real(term.times(&Term::known(RATE), Ratio::ONE)),
                other => other.clone(),
            },
            Node::PathRate(var) => {
                let Definition::Continuous { path: Some((_, path)), .. } = self.system.var(var).definition else {
                    let name = &self.system.var(var).name;
                    let error = Diagnostic::error("E0307", format!("`{name}` has no equation along a path"))
                        .label(self.system.span(id), "no such derivative")
                        .help(format!("write `d{name}/dt`"));
                    self.diagnostics.push(error);
                    return NodeType::Unknown;
                };
                match (&self.vars[var.0 as usize], &self.vars[path.0 as usize]) {
                    (NodeType::Real(x), NodeType::Real(s)) => NodeType::Real(x.times(s, Ratio::whole(-1))),
                    _ => NodeType::Unknown,
                }
            }
            Node::Negate(a) => self.real(a).map_or(NodeType::Unknown, NodeType::Real),
            Node::Not(a) => {
                self.condition(a, "`not`");
                NodeType::Boolean
            }
            Node::Binary(op, a, b) => self.binary(op, a, b),
            Node::If(c, a, b) => {
                self.condition(c, "`if`");
                match (self.kind(a).clone(), self.kind(b).clone()) {
                    (NodeType::Boolean, NodeType::Boolean) => NodeType::Boolean,
                    (NodeType::Real(x), NodeType::Real(y)) => {
                        if !self.unify(&x, &y) {
                            let message =
                                format!("one branch is {}, the other {}", self.described(&x), self.described(&y));
                            self.differ("E0101", message, a, &x, b, &y);
                            return NodeType::Unknown;
                        }
                        NodeType::Real(if x.unknowns.is_empty() { x } else { y })
                    }
                    (NodeType::Boolean, NodeType::Real(_)) | (NodeType::Real(_), NodeType::Boolean) => {
                        let error = Diagnostic::error("E0101", "one branch is a condition, the other a quantity")
                            .label(self.system.span(a), "one")
                            .label(self.system.span(b), "the other");
                        self.diagnostics.push(error);
                        NodeType::Unknown
                    }
                    _ => NodeType::Unknown,
                }
            }
            Node::Call(builtin, args) => self.call(builtin, &args),
            Node::Table(table, x) => {
                let table = &self.system.tables[table as usize];
                let (wanted, result) = (Term::known(table.x_unit.dimension), Term::known(table.y_unit.dimension));
                if let Some(term) = self.real(x)
                    && !self.unify(&term, &wanted)
                {
                    let message = format!(
                        "`{}` is a table over {}, not {}",
                        table.name,
                        self.described(&wanted),
                        self.described(&term)
                    );
                    let error = Diagnostic::error("E0101", message).label(self.system.span(x), self.shown(&term));
                    self.diagnostics.push(error);
                }
                NodeType::Real(result)
            }
            // The difference is an earlier node and has been checked as a subtraction.
            Node::Crossing(_) => NodeType::Boolean,
            Node::Fits { value, unit, role } => self.fits(value, unit.dimension, &role),
            Node::Measure(measure, value, second, window) => {
                for edge in [window.after, window.before].into_iter().flatten() {
                    if let Some(given) = self.real(edge)
                        && !self.unify(&given, &Term::known(TIME))
                    {
                        self.mismatch(edge, &given, &Term::known(TIME));
                    }
                }
                let event = match measure {
                    MeasureName::First | MeasureName::Rises | MeasureName::Turns => Some("`first`"),
                    MeasureName::Count | MeasureName::CountRises | MeasureName::CountTurns => Some("`count`"),
                    MeasureName::Duration => Some("`duration`"),
                    _ => None,
                };
                let Some(term) = (match (event, self.kind(value).clone()) {
                    (_, NodeType::Boolean) | (Some(_), _) => {
                        if let Some(event) = event {
                            self.condition(value, event);
                        }
                        Some(Term::known(Dimension::NONE))
                    }
                    _ => self.real(value),
                }) else {
                    return NodeType::Unknown;
                };
                if let Some(second) = second
                    && let Some(given) = self.real(second)
                {
                    let wanted = match measure {
                        MeasureName::At => Term::known(TIME),
                        MeasureName::Peak => Term::known(Dimension::NONE),
                        _ => term.clone(),
                    };
                    if !self.unify(&given, &wanted) {
                        self.mismatch(second, &given, &wanted);
                    }
                }
                match measure {
                    MeasureName::Integral => NodeType::Real(term.times(&Term::known(TIME), Ratio::ONE)),
                    MeasureName::Crossings
                    | MeasureName::Count
                    | MeasureName::CountRises
                    | MeasureName::CountTurns
                    | MeasureName::Peaks => number,
                    MeasureName::Duration
                    | MeasureName::Period
                    | MeasureName::Settling
                    | MeasureName::First
                    | MeasureName::Rises
                    | MeasureName::Turns
                    | MeasureName::Time => NodeType::Real(Term::known(TIME)),
                    _ => NodeType::Real(term),
                }
            }
            Node::Error => NodeType::Unknown,
        }
    }

    /// Reports two operands whose units differ but must agree.
    fn differ(&mut self, code: &'static str, message: String, a: ExprId, x: &Term, b: ExprId, y: &Term) {
        // A bare number beside a quantity lacks a unit.
        for (number, other, term) in [(a, b, y), (b, a, x)] {
            if self.is_bare(number) {
                let text = self.text(number).to_string();
                let unit = self.shown(term);
                let error = Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                    .label(self.system.span(number), "a pure number")
                    .label(self.system.span(other), unit.clone())
                    .help(format!("write `{text} {unit}`"));
                self.diagnostics.push(error);
                return;
            }
        }
        let mut error = Diagnostic::error(code, message)
            .label(self.system.span(a), self.shown(x))
            .label(self.system.span(b), self.shown(y));
        if let Some(help) = self.help(a, x, b, y) {
            error = error.help(help);
        }
        self.diagnostics.push(error);
    }

    fn is_bare(&self, id: ExprId) -> bool {
        match self.system.node(id) {
            Node::Number { dimension: Some(dimension), .. } => {
                dimension.is_none() && self.text(id).ends_with(|c: char| c.is_ascii_digit())
            }
            Node::Negate(a) => self.is_bare(*a),
            _ => false,
        }
    }

    /// Suggestion for a sum of two different quantities: a coefficient whose unit is the quotient of theirs.
    fn help(&self, a: ExprId, x: &Term, b: ExprId, y: &Term) -> Option<String> {
        let (x, y) = (self.resolved(x), self.resolved(y));
        if !x.unknowns.is_empty() || !y.unknowns.is_empty() {
            return None;
        }
        if x.base.rotary() == y.base || y.base.rotary() == x.base {
            return Some("one is straight, the other rotary: `rotary` maps m to rad and kg to kg·m^2".into());
        }
        let wanted = x.base.over(y.base);
        let unit = Unit::si(wanted);
        let owner = self.owner(a).or_else(|| self.owner(b))?;
        let fitting = self
            .system
            .vars
            .iter()
            .find(|var| var.instance == owner && var.kind == VarKind::Param && self.unit_of(var) == Some(wanted))?;
        // `Fc + vs * sign(v)`: a velocity parameter in the place of its coefficient.
        if let Node::Binary(BinaryOp::Multiply, p, s) = self.system.node(b)
            && let (Node::Var(p), Node::Call(Builtin::Sign, args)) = (self.system.node(*p), self.system.node(*s))
            && self.system.var(*p).kind == VarKind::Param
        {
            let p = self.system.var(*p);
            let doc = p.doc.as_deref().map_or(String::new(), |doc| {
                format!("`{}` is the {} (line {}). ", p.name, doc.trim(), self.files.line(p.span))
            });
            let v = self.text(args[0]);
            return Some(format!(
                "{doc}A coefficient in {unit} is missing;\n`{0}` is one. Did you mean `{1} * sign({v}) + {0} * {v}`?",
                fitting.name,
                self.text(a)
            ));
        }
        Some(format!("a coefficient in {unit} is missing; `{0}` is one: `{0} * {1}`", fitting.name, self.text(b)))
    }

    /// Suggestion for a side of an equation: the unit of a number in it, or a parameter whose unit is the quotient.
    fn factor(&self, value: ExprId, found: &Term, wanted: &Term, owner: InstanceId) -> Option<String> {
        let (found, wanted) = (self.resolved(found), self.resolved(wanted));
        if !found.unknowns.is_empty() || !wanted.unknowns.is_empty() {
            return None;
        }
        let missing = wanted.base.over(found.base);
        let (mut stack, mut sum) = (vec![(value, true)], false);
        while let Some((id, above)) = stack.pop() {
            match self.system.node(id) {
                Node::Binary(BinaryOp::Multiply, a, b) => stack.extend([(*b, above), (*a, above)]),
                Node::Binary(BinaryOp::Divide, a, b) => stack.extend([(*b, !above), (*a, above)]),
                Node::Negate(a) if !self.is_bare(id) => stack.push((*a, above)),
                Node::Binary(BinaryOp::Add | BinaryOp::Subtract, ..) | Node::If(..) => sum = true,
                _ if self.is_bare(id) => {
                    let unit = Unit::si(if above { missing } else { found.base.over(wanted.base) });
                    return Some(format!("a number has a unit too: `{0} {unit}` in place of `{0}`", self.text(id)));
                }
                _ => {}
            }
        }
        let text = if sum { format!("({})", self.text(value)) } else { self.text(value).to_string() };
        if text.len() > 60 || text.contains('\n') {
            return None;
        }
        let param = |dimension: Dimension| {
            let fits = |var: &&Var| var.kind == VarKind::Param && self.unit_of(var) == Some(dimension);
            self.system.vars.iter().filter(|var| var.instance == owner).find(fits)
        };
        if let Some(factor) = param(missing) {
            let (name, unit) = (&factor.name, Unit::si(missing));
            return Some(format!("a factor in {unit} is missing; `{name}` is one: `{name} * {text}`"));
        }
        let Some(divisor) = param(found.base.over(wanted.base)) else {
            return self.other_unit(value, missing);
        };
        let (name, unit) = (&divisor.name, Unit::si(found.base.over(wanted.base)));
        Some(format!("divide by something in {unit}; `{name}` is one: `{text} / {name}`"))
    }

    /// The unit of the only parameter of a product with which the product would fit.
    fn other_unit(&self, value: ExprId, missing: Dimension) -> Option<String> {
        let (mut stack, mut params) = (vec![(value, true)], Vec::new());
        while let Some((id, above)) = stack.pop() {
            match self.system.node(id) {
                Node::Binary(BinaryOp::Multiply, a, b) => stack.extend([(*b, above), (*a, above)]),
                Node::Binary(BinaryOp::Divide, a, b) => stack.extend([(*b, !above), (*a, above)]),
                Node::Negate(a) => stack.push((*a, above)),
                Node::Var(id) if self.system.var(*id).kind == VarKind::Param => params.push((*id, above)),
                _ => {}
            }
        }
        let [(id, above)] = params[..] else { return None };
        let var = self.system.var(id);
        let now = self.unit_of(var)?;
        let fitting = Unit::si(if above { now.times(missing) } else { now.over(missing) });
        Some(format!("with `{}` in {fitting} it would fit; it is in {} now", var.name, Unit::si(now)))
    }

    /// The instance that owns the first quantity of the expression.
    fn owner(&self, id: ExprId) -> Option<InstanceId> {
        match self.system.node(id) {
            Node::Var(var) | Node::Rate(var) => Some(self.system.var(*var).instance),
            node => node.operands().find_map(|operand| self.owner(operand)),
        }
    }

    fn unit_of(&self, var: &Var) -> Option<Dimension> {
        match (&var.unit, &var.definition) {
            (Some((unit, _)), _) => Some(unit.dimension),
            (None, Definition::Value(value, _)) => match self.types.get(value.0 as usize) {
                Some(NodeType::Real(term)) => Some(self.resolved(term).base),
                _ => match self.system.node(*value) {
                    Node::Number { dimension, .. } => *dimension,
                    _ => None,
                },
            },
            _ => None,
        }
    }

    fn mismatch(&mut self, id: ExprId, found: &Term, wanted: &Term) {
        if self.is_bare(id) {
            let (text, unit) = (self.text(id).to_string(), self.shown(wanted));
            let error = Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                .label(self.system.span(id), "a pure number")
                .help(format!("write `{text} {unit}`"));
            self.diagnostics.push(error);
            return;
        }
        let message = format!("this is {}, {} is needed", self.described(found), self.described(wanted));
        let error = Diagnostic::error("E0101", message)
            .label(self.system.span(id), format!("{}, not {}", self.shown(found), self.shown(wanted)));
        self.diagnostics.push(match self.left_to_right(id, wanted) {
            Some(help) => error.help(help),
            None => error,
        });
    }

    fn condition(&mut self, id: ExprId, what: &str) {
        if let NodeType::Real(term) = self.kind(id).clone() {
            let error = Diagnostic::error("E0101", format!("{what} needs a condition, not {}", self.described(&term)))
                .label(self.system.span(id), "neither true nor false")
                .help("compare it with something: `a > b`");
            self.diagnostics.push(error);
        }
    }

    fn binary(&mut self, op: BinaryOp, a: ExprId, b: ExprId) -> NodeType {
        match op {
            BinaryOp::And | BinaryOp::Or => {
                let what = format!("`{}`", op.text());
                self.condition(a, &what);
                self.condition(b, &what);
                return NodeType::Boolean;
            }
            BinaryOp::Equal | BinaryOp::NotEqual
                if *self.kind(a) == NodeType::Boolean && *self.kind(b) == NodeType::Boolean =>
            {
                return NodeType::Boolean;
            }
            _ => {}
        }
        let (x, y) = (self.real(a), self.real(b));
        let comparison =
            !matches!(op, BinaryOp::Add | BinaryOp::Subtract | BinaryOp::Multiply | BinaryOp::Divide | BinaryOp::Power);
        let (Some(x), Some(y)) = (x, y) else { return if comparison { NodeType::Boolean } else { NodeType::Unknown } };
        match op {
            BinaryOp::Multiply => NodeType::Real(x.times(&y, Ratio::ONE)),
            BinaryOp::Divide => NodeType::Real(x.times(&y, Ratio::whole(-1))),
            BinaryOp::Power => self.power(a, &x, b, &y),
            BinaryOp::Add | BinaryOp::Subtract => {
                if self.unify(&x, &y) {
                    return NodeType::Real(if x.unknowns.is_empty() { x } else { y });
                }
                let message = if op == BinaryOp::Add {
                    format!("cannot add {} and {}", self.described(&x), self.described(&y))
                } else {
                    format!("cannot subtract {} from {}", self.described(&y), self.described(&x))
                };
                self.differ("E0101", message, a, &x, b, &y);
                NodeType::Unknown
            }
            _ => {
                if !self.unify(&x, &y) {
                    let message = format!("cannot compare {} with {}", self.described(&x), self.described(&y));
                    self.differ("E0101", message, a, &x, b, &y);
                }
                NodeType::Boolean
            }
        }
    }

    fn power(&mut self, a: ExprId, x: &Term, b: ExprId, y: &Term) -> NodeType {
        let none = Term::known(Dimension::NONE);
        if !self.unify(y, &none) {
            let error = Diagnostic::error("E0104", format!("an exponent is a pure number, not {}", self.described(y)))
                .label(self.system.span(b), self.shown(y))
                .help(format!("divide it by a quantity of its kind: `({} / 1 {})`", self.text(b), self.shown(y)));
            self.diagnostics.push(error);
            return NodeType::Unknown;
        }
        if self.resolved(x) == none {
            return NodeType::Real(none);
        }
        match self.constant(b).and_then(Ratio::approximate) {
            Some(exponent) => NodeType::Real(none.times(x, exponent)),
            None => {
                let resolved = self.resolved(x);
                if !resolved.unknowns.is_empty() {
                    self.unify(x, &none);
                    return NodeType::Real(none);
                }
                let error =
                    Diagnostic::error("E0105", format!("the exponent of {} must be a number", self.described(x)))
                        .label(self.system.span(b), "not a number written here")
                        .label(self.system.span(a), self.shown(x))
                        .help(format!("make the base a pure number: `({} / 1 {}) ^ …`", self.text(a), self.shown(x)));
                self.diagnostics.push(error);
                NodeType::Unknown
            }
        }
    }

    /// The value of a literal exponent.
    fn constant(&self, id: ExprId) -> Option<f64> {
        self.system.literal(id)
    }

    /// Checks the arguments of a call against the units in the function's signature.
    fn call(&mut self, builtin: Builtin, args: &[ExprId]) -> NodeType {
        let terms: Option<Vec<Term>> = {
            let all: Vec<Option<Term>> = args.iter().map(|arg| self.real(*arg)).collect();
            all.into_iter().collect()
        };
        let Some(terms) = terms else { return NodeType::Unknown };
        let signature = builtin.signature();
        let of =
            |units: Units| signature.arguments.iter().zip(args).zip(&terms).filter(move |((a, _), _)| a.1 == units);
        // Arguments of the same unit.
        let mut alike = of(Units::Same).map(|((_, arg), term)| (*arg, term));
        let first = alike.next();
        if let Some((first, x)) = first {
            for (other, y) in alike {
                if !self.unify(x, y) {
                    let message =
                        format!("`{}` compares {} with {}", builtin.name(), self.described(x), self.described(y));
                    self.differ("E0101", message, first, x, other, y);
                    return NodeType::Unknown;
                }
            }
        }
        let none = Term::known(Dimension::NONE);
        let fitting = of(Units::Same).map(|(_, term)| term).find(|term| term.unknowns.is_empty());
        let same = fitting.or(first.map(|(_, term)| term)).unwrap_or(&none);
        for ((argument, arg), term) in signature.arguments.iter().zip(args).zip(&terms) {
            let wanted = match argument.1 {
                Units::Same | Units::RootOfSame | Units::Any => continue,
                Units::Number => {
                    if !self.unify(term, &none) {
                        self.not_a_number(builtin, *arg, term);
                        // Rounding a quantity requires a unit to round to; the SI unit would be a guess.
                        if builtin == Builtin::Floor {
                            return NodeType::Unknown;
                        }
                    }
                    continue;
                }
                Units::Time => Term::known(TIME),
                Units::Frequency => Term::known(RATE),
                Units::SamePerTime => same.times(&Term::known(RATE), Ratio::ONE),
            };
            if !self.unify(term, &wanted) {
                self.mismatch(*arg, term, &wanted);
            }
        }
        NodeType::Real(match signature.result {
            Units::Number | Units::Any => none,
            Units::Same => same.clone(),
            Units::RootOfSame => none.times(same, Ratio::new(1, 2)),
            Units::Time => Term::known(TIME),
            Units::Frequency => Term::known(RATE),
            Units::SamePerTime => same.times(&Term::known(RATE), Ratio::ONE),
        })
    }

    /// E0104: an argument that must be a pure number has a unit.
    fn not_a_number(&mut self, builtin: Builtin, arg: ExprId, term: &Term) {
        let (unit, text) = (self.shown(term), self.text(arg));
        let message = format!("`{}` needs a pure number, not {}", builtin.name(), self.described(term));
        let (label, help) = match builtin {
            Builtin::Floor => (
                format!("whole numbers of {unit}, or of what?"),
                format!("say of what: `(1 {unit}) * floor({text} / (1 {unit}))`"),
            ),
            Builtin::Unary(Unary::Sin | Unary::Cos | Unary::Tan) if self.resolved(term).base == TIME => (
                unit.clone(),
                match text.strip_suffix("* t").map(str::trim).filter(|factor| factor.parse::<f64>().is_ok()) {
                    Some(factor) => format!(
                        "the factor needs its unit: `{factor} rad/s * t`, or by a frequency `2 * pi * 1 Hz * t`; a signal `sine(1 N, 1 Hz)`"
                    ),
                    None => "an angle is a rate times the time: `2 * pi * 1 Hz * t`, or `1 rad/s * t`; a signal `sine(1 N, 1 Hz)`"
                        .into(),
                },
            ),
            _ => (unit.clone(), format!("divide by a quantity of the same kind: `{text} / 1 {unit}`")),
        };
        self.diagnostics.push(Diagnostic::error("E0104", message).label(self.system.span(arg), label).help(help));
    }

    fn fits(&mut self, value: ExprId, dimension: Dimension, role: &Role) -> NodeType {
        let wanted = Term::known(dimension);
        let Some(term) = self.real(value) else { return NodeType::Real(wanted) };
        if !self.unify(&term, &wanted) {
            let (found, needed) = (self.described(&term), dimension.describe());
            match role {
                Role::Argument { function, .. } if dimension.is_none() => {
                    let unit = self.shown(&term);
                    let error = Diagnostic::error("E0104", format!("`{function}` needs a pure number, not {found}"))
                        .label(self.system.span(value), unit.clone())
                        .help(format!("divide by a quantity of the same kind: `{} / 1 {unit}`", self.text(value)));
                    self.diagnostics.push(error);
                }
                Role::Argument { .. } if self.is_bare(value) => self.mismatch(value, &term, &wanted),
                Role::Argument { function, name } => {
                    let message = format!("`{name}` of `{function}` is {needed}, but gets {found}");
                    let error = Diagnostic::error("E0101", message)
                        .label(self.system.span(value), format!("{}, not {}", self.shown(&term), self.shown(&wanted)));
                    self.diagnostics.push(error);
                }
                Role::Result { function } => {
                    let message = format!("`{function}` is declared as {needed}, but gives {found}");
                    let error = Diagnostic::error("E0101", message)
                        .label(self.system.span(value), format!("{}, not {}", self.shown(&term), self.shown(&wanted)));
                    self.diagnostics.push(error);
                }
            }
        }
        NodeType::Real(wanted)
    }

    // ---- definitions

    fn definition(&mut self, id: VarId) {
        let var = self.system.var(id);
        let kind = self.vars[id.0 as usize].clone();
        let reported = self.diagnostics.len();
        match &var.definition {
            Definition::Missing | Definition::Free => {}
            Definition::Value(value, origin) | Definition::Held { value, origin, .. } => {
                self.defines(id, &kind, *value, *origin);
            }
            Definition::Continuous { initial, rate, .. } => {
                let rate = (*rate != *initial).then_some(*rate);
                self.state(id, &kind, *initial, rate);
            }
            Definition::Sampled { initial, next, .. } => {
                self.defines(id, &kind, *initial, self.system.start_origin(id));
                self.defines(id, &kind, *next, Origin::Equation(self.system.span(*next)));
            }
        }
        for bound in [var.range.low, var.range.high].into_iter().flatten().map(|(bound, _)| bound) {
            if let (NodeType::Real(wanted), NodeType::Real(found)) = (&kind, self.kind(bound).clone())
                && !self.unify(&found, wanted)
            {
                self.mismatch(bound, &found, &wanted.clone());
            }
        }
        // Otherwise its uses would be reported as well, for the same mistake.
        if self.diagnostics.len() > reported && kind.is_inferred() {
            self.vars[id.0 as usize] = NodeType::Unknown;
        }
    }

    fn defines(&mut self, id: VarId, kind: &NodeType, value: ExprId, origin: Origin) {
        let var = self.system.var(id);
        let (wanted, found) = match (kind, self.kind(value).clone()) {
            (NodeType::Real(wanted), NodeType::Real(found)) => (wanted.clone(), found),
            (NodeType::Boolean, NodeType::Boolean) | (NodeType::Unknown, _) | (_, NodeType::Unknown) => return,
            (NodeType::Real(_), NodeType::Boolean) => {
                self.real(value);
                return;
            }
            (NodeType::Boolean, NodeType::Real(_)) => {
                self.condition(value, &format!("`{}`", var.name));
                return;
            }
        };
        if self.unify(&found, &wanted) {
            return;
        }
        let unit = var.unit.as_ref();
        match origin {
            _ if self.is_bare(value) => {
                let text = self.text(value).to_string();
                let written = unit.map_or(self.shown(&wanted), |(unit, _)| unit.text.clone());
                let mut error = Diagnostic::error("E0103", format!("`{text}` needs a unit"));
                let name = &var.name;
                match (origin, unit) {
                    (Origin::Default | Origin::Equation(_), Some((unit, span))) => {
                        error = error
                            .label(*span, format!("declared in {}", spelled(unit)))
                            .label(self.system.span(value), "a pure number");
                        error = error.help(match var.kind {
                            VarKind::Param => format!("write `param {name} = {text} {written}`"),
                            _ => format!("write `{text} {written}`"),
                        });
                    }
                    (Origin::Argument { model, .. }, _) => {
                        let expects = format!("expects {name} in {written}");
                        error = error.label(self.system.span(value), "a pure number").label(model, expects);
                        error = error.help(format!("write `{name} = {text} {written}`"));
                    }
                    _ => {
                        error = error.label(self.system.span(value), "a pure number");
                        error = error.help(format!("write `{text} {written}`"));
                    }
                }
                self.diagnostics.push(error);
            }
            Origin::Argument { model, .. } => {
                let (has, needs) = (self.resolved(&found).base, self.resolved(&wanted).base);
                let name = &self.system.instance(var.instance).model;
                let expects = format!("expects {} in {}", var.name, self.shown(&wanted));
                let rotary = self.system.instance(var.instance).rotary;
                let misread = self.left_to_right(value, &wanted);
                if misread.is_none() && ((!rotary && needs.rotary() == has) || (rotary && has.rotary() == needs)) {
                    self.found.push(var.instance);
                }
                let error = if let Some(help) = misread {
                    let message = format!(
                        "`{}` of {name} is in {}, but gets {}",
                        var.name,
                        self.shown(&wanted),
                        self.shown(&found)
                    );
                    Diagnostic::error("E0101", message)
                        .label(self.system.span(value), self.shown(&found))
                        .label(model, expects)
                        .help(help)
                } else if !rotary && needs.rotary() == has {
                    let message =
                        format!("{name} is written for straight motion, but `{}` gets {}", var.name, angular(has));
                    Diagnostic::error("E0108", message)
                        .label(model, expects)
                        .label(self.system.span(value), angular_unit(has))
                        .help(format!(
                            "write `rotary {name}(...)`: the same model with N -> N·m, m -> rad, kg -> kg·m^2"
                        ))
                } else if rotary && has.rotary() == needs {
                    let message = format!("{name} is rotary here, but `{}` gets {}", var.name, has.describe());
                    Diagnostic::error("E0108", message)
                        .label(model, format!("expects {} in {}", var.name, angular_unit(needs)))
                        .label(self.system.span(value), self.shown(&found))
                        .help(format!("write `{name}(...)` without `rotary`, or give {}", angular(needs)))
                } else {
                    let message = format!(
                        "`{}` of {name} is {}, but gets {}",
                        var.name,
                        self.described(&wanted),
                        self.described(&found)
                    );
                    Diagnostic::error("E0101", message)
                        .label(self.system.span(value), self.shown(&found))
                        .label(model, expects)
                };
                self.diagnostics.push(error);
            }
            Origin::Equation(_) | Origin::Default | Origin::Override => {
                let message =
                    format!("`{}` is {}, but this is {}", var.name, self.described(&wanted), self.described(&found));
                let mut error = Diagnostic::error("E0101", message).label(self.system.span(value), self.shown(&found));
                error = match unit {
                    Some((_, span)) => error.label(*span, "declared here"),
                    None => error.label(var.span, format!("{} by its other uses", self.shown(&wanted))),
                };
                let help = self.left_to_right(value, &wanted);
                if let Some(help) = help.or_else(|| self.factor(value, &found, &wanted, var.instance)) {
                    error = error.help(help);
                }
                self.diagnostics.push(error);
            }
        }
    }

    fn state(&mut self, id: VarId, kind: &NodeType, initial: ExprId, rate: Option<ExprId>) {
        self.defines(id, kind, initial, self.system.start_origin(id));
        let Some(rate) = rate else { return };
        let (NodeType::Real(state), Some(found)) = (kind, self.real(rate)) else { return };
        let wanted = state.times(&Term::known(RATE), Ratio::ONE);
        if self.unify(&found, &wanted) {
            return;
        }
        let var = self.system.var(id);
        let Definition::Continuous { path, span, .. } = &var.definition else { return };
        let (value, wanted, found) = match path {
            Some((value, along)) => match (self.kind(*value).clone(), &self.vars[along.0 as usize]) {
                (NodeType::Real(found), NodeType::Real(s)) => (*value, state.times(s, Ratio::whole(-1)), found),
                _ => return,
            },
            None => (rate, wanted, found),
        };
        let left = self.files.slice(*span).to_string();
        if self.is_bare(value) {
            self.mismatch(value, &found, &wanted);
            return;
        }
        let message = format!("`{left}` is {}, but this is {}", self.described(&wanted), self.described(&found));
        let mut error = Diagnostic::error("E0101", message)
            .label(self.system.span(value), self.shown(&found))
            .label(*span, format!("needs {}", self.shown(&wanted)));
        let help = self.left_to_right(value, &wanted);
        if let Some(help) = help.or_else(|| self.factor(value, &found, &wanted, var.instance)) {
            error = error.help(help);
        }
        self.diagnostics.push(error);
    }

    fn statements(&mut self) {
        for block in &self.system.blocks {
            if let Some(term) = self.real(block.period)
                && !self.unify(&term, &Term::known(TIME))
            {
                let rate = self.unify(&term, &Term::known(RATE));
                self.mismatch(block.period, &term, &Term::known(TIME));
                if let Some(error) = self.diagnostics.last_mut().filter(|_| rate) {
                    error.help = Some("a period is a time: `every 1 ms` for 1 kHz".into());
                }
            }
        }
        for (_, energy) in &self.system.storages {
            if let Some(term) = self.real(*energy)
                && !self.unify(&term, &Term::known(ENERGY))
            {
                let message = format!("stored energy is in J, but this is {}", self.described(&term));
                let error = Diagnostic::error("E0101", message).label(self.system.span(*energy), self.shown(&term));
                self.diagnostics.push(error);
            }
        }
        for require in &self.system.requires {
            self.condition(require.condition, "`require`");
        }
        let transitions =
            self.system.automata.iter().flat_map(|automaton| &automaton.regimes).flat_map(|r| &r.transitions);
        type Resets<'r> = &'r [(VarId, ExprId)];
        let conditions: Vec<(ExprId, Resets, &str)> = transitions
            .map(|transition| (transition.condition, transition.resets.as_slice(), "`go`"))
            .chain(self.system.events.iter().map(|event| (event.condition, event.resets.as_slice(), "`when`")))
            .collect();
        for (condition, resets, what) in conditions {
            self.condition(condition, what);
            for (var, value) in resets {
                let kind = self.vars[var.0 as usize].clone();
                self.defines(*var, &kind, *value, Origin::Equation(self.system.span(*value)));
            }
        }
    }

    fn finish(self) -> Types {
        let base = |checker: &Self, kind: &NodeType| match kind {
            NodeType::Real(term) => {
                let term = checker.resolved(term);
                Some((term.base, term.unknowns.is_empty()))
            }
            NodeType::Boolean | NodeType::Unknown => None,
        };
        let mut units = Vec::with_capacity(self.vars.len());
        let mut lost: Vec<VarId> = Vec::new();
        let mut beyond: Option<VarId> = None;
        for (k, (var, kind)) in self.system.vars.iter().zip(&self.vars).enumerate() {
            let unit = match (&var.unit, base(&self, kind)) {
                (Some((unit, _)), _) => unit.clone(),
                (None, Some((dimension, known))) => {
                    let defined = match &var.definition {
                        Definition::Missing | Definition::Free => false,
                        Definition::Value(value, _) | Definition::Held { value, .. } => {
                            *self.kind(*value) != NodeType::Unknown
                        }
                        Definition::Continuous { rate, .. } => *self.kind(*rate) != NodeType::Unknown,
                        Definition::Sampled { next, .. } => *self.kind(*next) != NodeType::Unknown,
                    };
                    if !known && defined && matches!(var.kind, VarKind::Output | VarKind::Let | VarKind::State) {
                        lost.push(VarId(k as u32));
                    }
                    if dimension.is_beyond() {
                        beyond = beyond.or(Some(VarId(k as u32)));
                    }
                    match &var.shown {
                        Some(unit) if unit.dimension == dimension => unit.clone(),
                        _ => Unit::si(dimension),
                    }
                }
                (None, None) => Unit::none(),
            };
            units.push(unit);
        }
        // Only the first is reported; the others may follow from it.
        if let Some(id) = beyond {
            self.diagnostics.push(too_large("the exponents of its unit are beyond reason", self.system.var(id).span));
        }
        let holes: Vec<(Span, Dimension)> = (0..self.system.nodes.len())
            .filter(|&k| self.system.nodes[k] == Node::Hole)
            .filter_map(|k| Some((self.system.spans[k], base(&self, &self.types[k])?.0)))
            .collect();
        let nodes: Vec<Option<Dimension>> =
            self.types.iter().map(|kind| base(&self, kind).map(|(dimension, _)| dimension)).collect();
        let boolean = self.types.iter().map(|kind| *kind == NodeType::Boolean).collect();
        let boolean_vars = self.vars.iter().map(|kind| *kind == NodeType::Boolean).collect();
        let quiet = !self.diagnostics.iter().any(Diagnostic::is_error);
        for (span, dimension) in holes {
            let fitting: Vec<String> = self
                .system
                .vars
                .iter()
                .zip(&units)
                .filter(|(var, unit)| {
                    var.span.file == span.file && unit.dimension == dimension && !var.path.contains('.')
                })
                .map(|(var, _)| format!("`{}`", var.path))
                .collect();
            let unit = Unit::si(dimension);
            let error = Diagnostic::error("E0112", format!("here {} is needed, in {unit}", dimension.describe()))
                .label(span, format!("{unit}"));
            self.diagnostics.push(match fitting.is_empty() {
                true => error.help("no visible name has this unit"),
                false => error.help(format!("visible names with this unit: {}", fitting.join(", "))),
            });
        }
        if quiet {
            // A copy of a quantity without a unit lacks one for the same reason.
            let copy = |id: &VarId| match self.system.var(*id).definition {
                Definition::Value(value, _) => matches!(self.system.node(value), Node::Var(_)),
                _ => false,
            };
            let originals = lost.iter().filter(|id| !copy(id)).count();
            for id in lost.into_iter().filter(|id| originals == 0 || !copy(id)) {
                let var = self.system.var(id);
                let error = Diagnostic::error("E0106", format!("the unit of `{}` cannot be inferred", var.name))
                    .label(var.span, "no equation says it")
                    .help(format!(
                        "write it: `{} {} [1]` for a pure number, or another unit",
                        var.kind.word(),
                        var.name
                    ));
                self.diagnostics.push(error);
            }
        }
        Types { nodes, boolean, units, boolean_vars }
    }
}

/// For each quantity, whether it is a truth value: whether a condition defines it.
fn boolean_vars(system: &System) -> Vec<bool> {
    #[derive(Clone, Copy, PartialEq)]
    enum Mark {
        Unseen,
        Open,
        Is(bool),
    }
    let mut marks = vec![Mark::Unseen; system.vars.len()];
    for start in 0..system.vars.len() {
        // Follows a chain of plain copies to the definition that decides.
        let mut chain = Vec::new();
        let mut at = start;
        let answer = loop {
            match marks[at] {
                Mark::Is(answer) => break answer,
                Mark::Open => break false,
                Mark::Unseen => {}
            }
            marks[at] = Mark::Open;
            chain.push(at);
            let mut value = match system.vars[at].definition {
                Definition::Value(value, _) | Definition::Held { value, .. } => value,
                Definition::Sampled { initial, .. } | Definition::Continuous { initial, .. } => initial,
                Definition::Free | Definition::Missing => break false,
            };
            let decided = loop {
                match system.node(value) {
                    Node::Bool(_) | Node::InRegime(..) | Node::Crossing(_) | Node::Not(_) => break Ok(true),
                    Node::Binary(op, ..) => {
                        break Ok(!matches!(
                            op,
                            BinaryOp::Add
                                | BinaryOp::Subtract
                                | BinaryOp::Multiply
                                | BinaryOp::Divide
                                | BinaryOp::Power
                        ));
                    }
                    Node::If(_, a, _) => value = *a,
                    Node::Var(var) => break Err(var.0 as usize),
                    _ => break Ok(false),
                }
            };
            match decided {
                Ok(answer) => break answer,
                Err(next) => at = next,
            }
        };
        for index in chain {
            marks[index] = Mark::Is(answer);
        }
    }
    marks.into_iter().map(|mark| mark == Mark::Is(true)).collect()
}

/// The unit's name in full if the unit is a single symbol.
fn spelled(unit: &Unit) -> String {
    let name = match unit.text.as_str() {
        "N" => "newton",
        "m" => "metres",
        "s" => "seconds",
        "kg" => "kilograms",
        "J" => "joules",
        "W" => "watts",
        "A" => "amperes",
        "K" => "kelvins",
        "rad" => "radians",
        other => other,
    };
    name.to_string()
}

/// A description of a dimension that names rotary quantities as such.
fn angular(dimension: Dimension) -> String {
    match angular_unit(dimension).as_str() {
        "rad" => "an angle".into(),
        "rad/s" => "an angular velocity".into(),
        "rad/s^2" => "an angular acceleration".into(),
        "N·m" => "a torque".into(),
        _ => dimension.describe(),
    }
}

fn angular_unit(dimension: Dimension) -> String {
    if dimension.is_none() {
        "rad".into()
    } else if dimension == RATE {
        "rad/s".into()
    } else if dimension == RATE.times(RATE) {
        "rad/s^2".into()
    } else {
        Unit::si(dimension).to_string()
    }
}

#[cfg(test)]
mod tests {
    use crate::NoSources;
    use crate::ir::random::Random;

    /// Lines of a model without inferred units that fit: parameters with units, and quantities without, each made of
    /// earlier ones. Also the names of the latter, and those of outputs.
    fn lines(random: &mut Random) -> (Vec<String>, Vec<String>, Vec<String>) {
        const PARAMS: [&str; 4] = ["2 N", "3 m/s", "0.5 kg", "4 s"];
        let mut lines: Vec<String> =
            PARAMS.iter().enumerate().map(|(k, value)| format!("param p{k} = {value}")).collect();
        let (mut known, mut outputs): (Vec<String>, Vec<String>) = (vec!["p0".into()], Vec::new());
        for k in 0..1 + random.below(8) {
            let a = known[random.below(known.len())].clone();
            let p = format!("p{}", random.below(PARAMS.len()));
            let name = format!("q{k}");
            let value = match random.below(7) {
                0 => format!("{a} * {p}"),
                1 => format!("{p} / {a}"),
                2 => format!("{a} + 2 * {a}"),
                3 => format!("if {a} > {a} / 2 then {a} else 3 * {a}"),
                4 => format!("sqrt(abs({a}) * {a})"),
                5 => format!("max({a}, -{a})"),
                _ => a.clone(),
            };
            match random.below(4) {
                0 => {
                    lines.push(format!("output {name} = {value}"));
                    outputs.push(name.clone());
                }
                1 => lines.push(format!("state {name} = {value}\n  d{name}/dt = ({value} - {name}) / 1 s")),
                _ => lines.push(format!("let {name} = {value}")),
            }
            known.push(name);
        }
        known.remove(0);
        (lines, known, outputs)
    }

    /// The codes of errors about units, each with the line in which its first label begins.
    fn blamed(text: &str) -> Vec<String> {
        let mut loaded = crate::load("a.fric", text, &NoSources);
        let found = crate::check(&mut loaded, &NoSources);
        let errors = found.iter().filter(|found| found.code.starts_with("E010"));
        let line = |at: usize| text[text[..at].rfind('\n').map_or(0, |at| at + 1)..].lines().next().unwrap_or_default();
        errors.map(|found| format!("{} {}", found.code, line(found.labels[0].span.start as usize))).collect()
    }

    /// Wherever it stands, a use of a quantity without a unit that does not fit its definition is reported, and not the
    /// definition.
    #[test]
    fn a_use_with_a_wrong_unit_is_blamed_at_the_use() {
        let mut kinds = [0; 7];
        for seed in 1..=600 {
            let mut random = Random(seed);
            let (mut inner, names, outputs) = lines(&mut random);
            inner.extend(["param bare = 3".into(), "let its_use = 1 + bare * 2".into()]);
            let kind = random.below(kinds.len());
            let name = if kind == 5 { &outputs } else { &names };
            if name.is_empty() {
                continue;
            }
            let name = &name[random.below(name.len())];
            let (mut expect, mut run, mut own) = (String::new(), "() for 1 s", None);
            match kind {
                0 => own = Some(format!("let wrong = {name} + 1 kg^5·m^7")),
                1 => own = Some(format!("output wrong [kg^5·m^7] = {name}")),
                2 => own = Some(format!("require max({name}, 1 kg^5·m^7) > 0 * {name}  // wrong")),
                3 => own = Some(format!("part wrong = Taker(v = {name})")),
                4 => own = Some(format!("let wrong = if {name} > 1 kg^5·m^7 then 1 else 2")),
                5 => expect = format!("  expect max({name}) > 1 kg^5·m^7  // wrong\n"),
                _ => run = "(bare = 1 kg^5·m^7) for 1 s  // wrong",
            }
            let text = |own: Option<&String>, (run, expect): (&str, &str), random: &mut Random| {
                let mut lines: Vec<&String> = inner.iter().collect();
                lines.extend(own);
                for last in (1..lines.len()).rev() {
                    lines.swap(last, random.below(last + 1));
                }
                let lines: String = lines.iter().map(|line| format!("  {line}\n")).collect();
                format!(
                    "model Taker {{\n  input v [kg^5·m^7]\n  output w [1] = v / 1 kg^5·m^7\n}}\nmodel Inner {{\n{lines}}}\n\
                     experiment it {{\n  run Inner{run}\n{expect}}}\n"
                )
            };
            let order = random.clone();
            let right = text(None, ("() for 1 s", ""), &mut order.clone());
            assert_eq!(blamed(&right), [""; 0], "seed {seed}\n{right}");
            let wrong = text(own.as_ref(), (run, &expect), &mut order.clone());
            let found = blamed(&wrong);
            assert!(
                !found.is_empty() && found.iter().all(|found| found.contains("wrong")),
                "seed {seed}: {found:?}\n{wrong}"
            );
            kinds[kind] += 1;
        }
        assert!(kinds.iter().all(|count| *count > 30), "{kinds:?}");
    }
}
