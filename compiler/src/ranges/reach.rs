//! Interval analysis of expressions: bounds that hold for all parameters, inputs and states within their declared
//! ranges.
//!
//! In: a flat system. Out: an [`Interval`] for each requested expression, rounding included. `require` statements and
//! the conditions of branches serve as facts. Two forms go beyond plain interval arithmetic, because friction models
//! need them: `exp(−x²)` lies in [0, 1], and `a + (b − a)·k` with k in [0, 1] lies between a and b.
//!
//! Assumptions: declared ranges hold, because they are checked at the start or guarded while a model runs; and
//! magnitudes of values from outside are physical, see [`TINY`] and [`HUGE`].

use crate::frontend::causality::rate_of;
use crate::frontend::system::*;
use crate::functions::{self, Binary};
use crate::interval::{Interval, SLACK, planted};
use crate::ir::hash::HashMap;
use abi::description::TINY;
pub use abi::live::{greatest, least};
use grammar::ast::BinaryOp;

/// Upper bound in SI units on the magnitude of parameters, inputs, states and time. Quotients of such numbers do not
/// underflow to 0.
pub const HUGE: f64 = 1e40;

/// A condition, and whether it holds where an expression is evaluated.
type Fact = (ExprId, bool);

/// `large` ≥ `small`, or `large` > `small` if strict.
#[derive(Clone, Copy)]
struct Order {
    large: ExprId,
    small: ExprId,
    strict: bool,
}

/// Computes intervals of expressions, with a memo for each set of facts.
pub struct Reach<'a> {
    system: &'a System,
    requires: Vec<Fact>,
    required: Vec<Order>,
    facts: Vec<Fact>,
    /// The order relations that each of the facts implies.
    orders: Vec<Vec<Order>>,
    /// Whether only declared ranges are used. The other side of a `require` is evaluated in this way, and the other
    /// side of a branch's condition without the facts of branches, so that no fact depends on itself.
    ranges_only: bool,
    /// Memos: by ranges only; with `require`; and one more for each fact.
    known: Vec<HashMap<ExprId, Interval>>,
    open: Vec<VarId>,
    /// Quantities whose declared range is being evaluated. A range that depends on its own quantity yields no bound.
    bounding: Vec<VarId>,
    /// Parameters whose ranges are taken without their ends, to try whether a strict range would suffice.
    strict: Vec<VarId>,
    /// Parameters and inputs that are taken as positive, to try whether such a range would suffice.
    positive: Vec<VarId>,
}

impl<'a> Reach<'a> {
    /// Starts with the `require` statements as facts.
    pub fn new(system: &'a System) -> Reach<'a> {
        let requires: Vec<Fact> = system.requires.iter().map(|require| (require.condition, true)).collect();
        let mut reach = Reach {
            system,
            requires,
            required: Vec::new(),
            facts: Vec::new(),
            orders: Vec::new(),
            ranges_only: false,
            known: vec![HashMap::default(), HashMap::default()],
            open: Vec::new(),
            bounding: Vec::new(),
            strict: Vec::new(),
            positive: Vec::new(),
        };
        let facts = reach.requires.clone();
        reach.required = facts.into_iter().flat_map(|fact| reach.order(fact)).collect();
        reach
    }

    /// The analysed system.
    pub fn system(&self) -> &'a System {
        self.system
    }

    /// The interval of an expression under the present facts.
    pub fn interval(&mut self, id: ExprId) -> Interval {
        let depth = self.depth();
        if let Some(known) = self.known[depth].get(&id) {
            return *known;
        }
        let mut interval = self.find(id);
        if !self.ranges_only {
            for k in 0..self.requires.len() {
                let said = self.by_ranges(|reach| reach.implied_by(reach.requires[k], id));
                let both = interval.and(said);
                // Contradictory requirements are reported by the check of start values.
                interval = if both.is_empty() { interval } else { both };
            }
            for k in 0..self.facts.len() {
                let fact = self.facts[k];
                interval = interval.and(self.elsewhere(|reach| reach.implied_by(fact, id)));
            }
        }
        self.known[depth].insert(id, interval);
        interval
    }

    /// Whether no branch conditions are assumed.
    pub fn is_plain(&self) -> bool {
        self.facts.is_empty()
    }

    /// Number of branch conditions assumed.
    pub fn assumed(&self) -> usize {
        self.facts.len()
    }

    /// Runs `then` under the assumption that a condition holds, or that it does not.
    pub fn assuming<T>(&mut self, condition: ExprId, holds: bool, then: impl FnOnce(&mut Self) -> T) -> T {
        self.facts.push((condition, holds));
        let orders = self.order((condition, holds));
        self.orders.push(orders);
        self.known.push(HashMap::default());
        let out = then(self);
        self.known.pop();
        self.orders.pop();
        self.facts.pop();
        out
    }

    /// The value of a condition if it is the same for all values of its operands.
    pub fn decide(&mut self, condition: ExprId) -> Option<bool> {
        match *self.system.node(condition) {
            Node::Bool(truth) => Some(truth),
            Node::Not(a) => self.decide(a).map(|truth| !truth),
            Node::Fits { value, .. } => self.decide(value),
            Node::Var(var) => self.decide(self.meaning(var)?),
            Node::Binary(BinaryOp::And, a, b) => match (self.decide(a), self.decide(b)) {
                (Some(false), _) | (_, Some(false)) => Some(false),
                (Some(true), Some(true)) => Some(true),
                _ => None,
            },
            Node::Binary(BinaryOp::Or, a, b) => match (self.decide(a), self.decide(b)) {
                (Some(true), _) | (_, Some(true)) => Some(true),
                (Some(false), Some(false)) => Some(false),
                _ => None,
            },
            Node::Binary(op, a, b) => {
                let (x, y) = match op {
                    BinaryOp::Less | BinaryOp::LessEqual => (self.interval(a), self.interval(b)),
                    BinaryOp::Greater | BinaryOp::GreaterEqual => (self.interval(b), self.interval(a)),
                    _ => return None,
                };
                if x.is_empty() || y.is_empty() {
                    return None;
                }
                let strict = matches!(op, BinaryOp::Less | BinaryOp::Greater);
                match strict {
                    true if x.high < y.low => Some(true),
                    true if x.low >= y.high => Some(false),
                    false if x.high <= y.low => Some(true),
                    false if x.low > y.high => Some(false),
                    _ => None,
                }
            }
            _ => None,
        }
    }

    /// The interval of an expression if the range of a parameter were declared without its ends, and without branch
    /// facts.
    pub fn if_strict(&mut self, param: VarId, id: ExprId) -> Interval {
        let mut other = Reach::new(self.system);
        other.strict.push(param);
        other.interval(id)
    }

    /// The interval of an expression if a parameter or input were declared `in > 0`, and without branch facts.
    pub fn if_positive(&mut self, param: VarId, id: ExprId) -> Interval {
        let mut other = Reach::new(self.system);
        other.positive.push(param);
        other.interval(id)
    }

    /// The interval of a quantity's value without regard to its own declared range.
    pub fn unbound(&mut self, id: VarId) -> Interval {
        match self.system.var(id).definition {
            Definition::Value(value, _) | Definition::Held { value, .. } => self.interval(value),
            _ => Interval::ALL,
        }
    }

    /// The interval of a declared range.
    pub fn bounds(&mut self, id: VarId) -> Interval {
        let range = self.system.var(id).range;
        let strict = self.strict.contains(&id);
        if self.bounding.contains(&id) {
            return Interval::ALL;
        }
        self.bounding.push(id);
        let low = range.low.map(|(bound, open)| least(self.plain(bound).low, open || strict));
        let low = if self.positive.contains(&id) { Some(low.unwrap_or(0.0).max(least(0.0, true))) } else { low };
        let high = range.high.map(|(bound, open)| greatest(self.plain(bound).high, open || strict));
        self.bounding.pop();
        Interval::closed(low.unwrap_or(f64::NEG_INFINITY), high.unwrap_or(f64::INFINITY))
    }

    // ---- facts

    /// Index of the memo for the present facts.
    fn depth(&self) -> usize {
        if self.ranges_only { 0 } else { 1 + self.facts.len() }
    }

    fn by_ranges<T>(&mut self, then: impl FnOnce(&mut Self) -> T) -> T {
        let before = std::mem::replace(&mut self.ranges_only, true);
        let out = then(self);
        self.ranges_only = before;
        out
    }

    /// Runs `then` without the facts of branches.
    fn elsewhere<T>(&mut self, then: impl FnOnce(&mut Self) -> T) -> T {
        let (facts, orders) = (std::mem::take(&mut self.facts), std::mem::take(&mut self.orders));
        let known = self.known.split_off(2);
        let out = then(self);
        self.known.extend(known);
        (self.facts, self.orders) = (facts, orders);
        out
    }

    /// As [`interval`](Self::interval), without the facts of branches: for values at another instant and for bounds of
    /// ranges.
    fn plain(&mut self, id: ExprId) -> Interval {
        self.elsewhere(|reach| reach.interval(id))
    }

    /// The expression that a name stands for at the same instant, unless it is a default, which a run may change.
    fn meaning(&self, id: VarId) -> Option<ExprId> {
        match self.system.var(id).definition {
            Definition::Value(value, origin) if origin != Origin::Default => Some(value),
            _ => None,
        }
    }

    /// The interval of an expression that a fact implies.
    fn implied_by(&mut self, (condition, holds): Fact, id: ExprId) -> Interval {
        match *self.system.node(condition) {
            Node::Not(a) if planted::is("not is forgotten") => self.implied_by((a, holds), id),
            Node::Not(a) => self.implied_by((a, !holds), id),
            Node::Fits { value, .. } => self.implied_by((value, holds), id),
            Node::Var(var) => self.meaning(var).map_or(Interval::ALL, |value| self.implied_by((value, holds), id)),
            Node::Binary(op @ (BinaryOp::And | BinaryOp::Or), a, b) => {
                let (x, y) = (self.implied_by((a, holds), id), self.implied_by((b, holds), id));
                if holds == (op == BinaryOp::And) || planted::is("or is and") { x.and(y) } else { x.hull(y) }
            }
            Node::Binary(op, a, b) => {
                let (low, high, strict) = match (op, holds) {
                    (BinaryOp::Less, true) | (BinaryOp::GreaterEqual, false) => (a, b, true),
                    (BinaryOp::LessEqual, true) | (BinaryOp::Greater, false) => (a, b, false),
                    (BinaryOp::Greater, true) | (BinaryOp::LessEqual, false) => (b, a, true),
                    (BinaryOp::GreaterEqual, true) | (BinaryOp::Less, false) => (b, a, false),
                    (BinaryOp::NotEqual, true) | (BinaryOp::Equal, false) => {
                        let zero = |id: ExprId| self.system.literal(id) == Some(0.0);
                        return match (zero(a), zero(b)) {
                            (_, true) => self.constrain(a, Interval::NOT_ZERO, id, DEEPEST),
                            (true, _) => self.constrain(b, Interval::NOT_ZERO, id, DEEPEST),
                            _ => Interval::ALL,
                        };
                    }
                    (BinaryOp::Equal, true) | (BinaryOp::NotEqual, false) => {
                        let (x, y) = (self.interval(b), self.interval(a));
                        return self.constrain(a, x, id, DEEPEST).and(self.constrain(b, y, id, DEEPEST));
                    }
                    _ => return Interval::ALL,
                };
                let (below, above) = (self.interval(high).high, self.interval(low).low);
                let (below, above) = if strict { (below.next_down(), above.next_up()) } else { (below, above) };
                let upper = self.constrain(low, Interval::to(below), id, DEEPEST);
                upper.and(self.constrain(high, Interval::from(above), id, DEEPEST))
            }
            _ => Interval::ALL,
        }
    }

    /// The interval of `id` if `expr` lies in `inside`, found by inverting the operations between them.
    fn constrain(&mut self, expr: ExprId, inside: Interval, id: ExprId, deep: u32) -> Interval {
        if self.same(expr, id) {
            return inside;
        }
        if deep == 0 || inside == Interval::ALL {
            return Interval::ALL;
        }
        let deep = deep - 1;
        match self.system.node(expr).clone() {
            Node::Fits { value, .. } => self.constrain(value, inside, id, deep),
            Node::Var(var) => match self.meaning(var) {
                Some(value) => self.constrain(value, inside, id, deep),
                None => Interval::ALL,
            },
            Node::Negate(a) => self.constrain(a, inside.negate(), id, deep),
            Node::Binary(BinaryOp::Multiply, a, b) if self.same(a, b) => {
                self.constrain(a, roots_of(inside, 2), id, deep)
            }
            Node::Binary(BinaryOp::Power, a, b) => match self.system.literal(b) {
                Some(n) if [2.0, 4.0, 6.0].contains(&n) => self.constrain(a, roots_of(inside, n as u32), id, deep),
                _ => Interval::ALL,
            },
            Node::Binary(op @ (BinaryOp::Multiply | BinaryOp::Divide), a, b) => {
                let factor = |id: ExprId| self.system.literal(id).filter(|factor| *factor != 0.0);
                let (part, other) = match (factor(b), factor(a)) {
                    (Some(factor), _) if op == BinaryOp::Multiply => (a, inside.divide(Interval::point(factor))),
                    (Some(factor), _) => (a, inside.multiply(Interval::point(factor))),
                    (_, Some(factor)) if op == BinaryOp::Multiply => (b, inside.divide(Interval::point(factor))),
                    _ => return Interval::ALL,
                };
                self.constrain(part, other.loosened(), id, deep)
            }
            Node::Binary(op @ (BinaryOp::Add | BinaryOp::Subtract), a, b) => {
                let (x, y) = (self.interval(a), self.interval(b));
                let (of_a, of_b) = match op {
                    BinaryOp::Add => (inside.minus(y), inside.minus(x)),
                    _ => (inside.plus(y), x.minus(inside)),
                };
                let slack = |of: Interval, other: Interval| {
                    let ends = [inside.low, inside.high, other.size()];
                    let size = ends.into_iter().filter(|end| end.is_finite()).fold(0.0, |a: f64, b| a.max(b.abs()));
                    of.plus(Interval::closed(-4.0 * f64::EPSILON * size, 4.0 * f64::EPSILON * size))
                };
                let (of_a, of_b) = (slack(of_a, y), slack(of_b, x));
                self.constrain(a, of_a, id, deep).and(self.constrain(b, of_b, id, deep))
            }
            Node::Call(Builtin::Abs, args) => {
                let both = Interval::closed(-inside.high, inside.high);
                self.constrain(args[0], both.and(Interval::beyond(inside.low)), id, deep)
            }
            Node::Call(Builtin::Sqrt, args) => {
                let low = if inside.low > 0.0 { inside.low * inside.low * (1.0 - SLACK) } else { f64::NEG_INFINITY };
                let high = if inside.high > 0.0 { inside.high * inside.high * (1.0 + SLACK) } else { inside.high };
                self.constrain(args[0], Interval::closed(low, high), id, deep)
            }
            Node::Call(Builtin::Binary(Binary::Hypot), args) => {
                let most = inside.high * (1.0 + SLACK);
                let both = Interval::closed(-most, most);
                self.constrain(args[0], both, id, deep).and(self.constrain(args[1], both, id, deep))
            }
            Node::Call(Builtin::Min, args) => {
                let both = Interval::from(inside.low);
                self.constrain(args[0], both, id, deep).and(self.constrain(args[1], both, id, deep))
            }
            Node::Call(Builtin::Max, args) => {
                let both = Interval::to(inside.high);
                self.constrain(args[0], both, id, deep).and(self.constrain(args[1], both, id, deep))
            }
            _ => Interval::ALL,
        }
    }

    /// The order relations that a fact implies.
    fn order(&self, (condition, holds): Fact) -> Vec<Order> {
        let one = |large, small, strict| vec![Order { large, small, strict }];
        match *self.system.node(condition) {
            Node::Not(a) => self.order((a, !holds)),
            Node::Fits { value, .. } => self.order((value, holds)),
            Node::Var(var) => self.meaning(var).map_or_else(Vec::new, |value| self.order((value, holds))),
            Node::Binary(BinaryOp::And, a, b) if holds => [self.order((a, true)), self.order((b, true))].concat(),
            Node::Binary(BinaryOp::Or, a, b) if !holds => [self.order((a, false)), self.order((b, false))].concat(),
            Node::Binary(op, a, b) => match (op, holds) {
                (BinaryOp::Less, true) | (BinaryOp::GreaterEqual, false) => one(b, a, true),
                (BinaryOp::LessEqual, true) | (BinaryOp::Greater, false) => one(b, a, false),
                (BinaryOp::Greater, true) | (BinaryOp::LessEqual, false) => one(a, b, true),
                (BinaryOp::GreaterEqual, true) | (BinaryOp::Less, false) => one(a, b, false),
                _ => Vec::new(),
            },
            _ => Vec::new(),
        }
    }

    /// All known order relations.
    fn all_orders(&self) -> Vec<Order> {
        if self.ranges_only {
            Vec::new()
        } else {
            self.orders.iter().flatten().chain(&self.required).copied().collect()
        }
    }

    /// Whether `large ≥ small` is known, and if so whether the order is strict.
    fn ordered(&self, large: ExprId, small: ExprId) -> Option<bool> {
        // A comparison rounds a product, while a difference may fuse it.
        if self.is_rounded(large) || self.is_rounded(small) {
            return None;
        }
        let fits = |order: &Order| self.same(order.large, large) && self.same(order.small, small);
        self.all_orders().iter().filter(|order| fits(order)).map(|order| order.strict).reduce(|a, b| a || b)
    }

    /// Whether an expression is a product that is rounded before it is compared or added.
    fn is_rounded(&self, id: ExprId) -> bool {
        match self.system.node(id) {
            Node::Fits { value, .. } => self.is_rounded(*value),
            Node::Negate(a) => self.is_rounded(*a),
            Node::Var(var) => self.meaning(*var).is_some_and(|value| self.is_rounded(value)),
            Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, a, b) => {
                self.system.literal(*a).is_none() && self.system.literal(*b).is_none()
            }
            Node::Binary(BinaryOp::Power, ..) => true,
            _ => false,
        }
    }

    /// An expression as a constant factor times another expression.
    fn scaled(&self, id: ExprId) -> (f64, ExprId) {
        match *self.system.node(id) {
            Node::Fits { value, .. } => self.scaled(value),
            Node::Negate(a) => {
                let (factor, of) = self.scaled(a);
                (-factor, of)
            }
            Node::Binary(BinaryOp::Multiply, a, b) => match (self.system.literal(a), self.system.literal(b)) {
                (Some(number), _) => {
                    let (factor, of) = self.scaled(b);
                    (number * factor, of)
                }
                (_, Some(number)) => {
                    let (factor, of) = self.scaled(a);
                    (number * factor, of)
                }
                _ => (1.0, id),
            },
            Node::Binary(BinaryOp::Divide, a, b) => match self.system.literal(b) {
                Some(number) => {
                    let (factor, of) = self.scaled(a);
                    (factor / number, of)
                }
                None => (1.0, id),
            },
            _ => (1.0, id),
        }
    }

    /// Whether two expressions are the same computation.
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
            (Node::Time, Node::Time) => true,
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

    // ---- expressions

    /// A source (parameter, input, state): any value of its declared range with a magnitude between [`TINY`] and
    /// [`HUGE`].
    fn outside(&mut self, id: VarId) -> Interval {
        let sizes = Interval::closed(-HUGE, HUGE);
        let bounds = self.bounds(id);
        let both = bounds.and(sizes);
        if both.is_empty() { bounds } else { both }
    }

    fn var(&mut self, id: VarId) -> Interval {
        let var = self.system.var(id);
        // A parameter's default is only one of its possible values; an argument fixes the value.
        let (value, held) = match var.definition {
            Definition::Value(_, Origin::Default) => return self.outside(id),
            Definition::Value(value, _) => (value, false),
            Definition::Held { value, .. } => (value, true),
            _ => return self.outside(id),
        };
        if self.open.contains(&id) {
            return self.bounds(id);
        }
        self.open.push(id);
        // A held value was computed at an earlier instant.
        let found = if held { self.plain(value) } else { self.interval(value) };
        self.open.pop();
        if var.range.low.is_none() && var.range.high.is_none() {
            return found;
        }
        let mut bounds = self.bounds(id);
        // A value that is positive for another reason may be nearer to 0 than [`TINY`].
        if bounds.low == TINY && found.low > 0.0 {
            bounds.low = found.low;
        }
        if bounds.high == -TINY && found.high < 0.0 {
            bounds.high = found.high;
        }
        let both = found.and(bounds);
        // A value outside its range is reported by another check, before or at the start of a run.
        if both.is_empty() { bounds } else { both }
    }

    fn find(&mut self, id: ExprId) -> Interval {
        let system = self.system;
        match system.node(id) {
            Node::Number { value, .. } => Interval::point(*value),
            Node::Time => Interval::closed(0.0, HUGE),
            Node::Rate(var) if !self.open.contains(var) => {
                self.open.push(*var);
                let found = rate_of(system, system.node(id)).map_or(Interval::ALL, |rate| self.interval(rate));
                self.open.pop();
                found
            }
            Node::Var(var) => self.var(*var),
            Node::Negate(a) => self.interval(*a).negate(),
            Node::Fits { value, .. } => self.interval(*value),
            Node::If(c, a, b) => match self.decide(*c) {
                Some(true) => self.interval(*a),
                Some(false) => self.interval(*b),
                None => {
                    let yes = self.branch(*c, true, *a);
                    if planted::is("one branch only") {
                        return yes;
                    }
                    yes.hull(self.branch(*c, false, *b))
                }
            },
            Node::Binary(op, a, b) => self.binary(*op, *a, *b),
            Node::Call(builtin, args) => self.call(*builtin, args),
            Node::Table(table, _) => {
                let y = &system.tables[*table as usize].y;
                let low = y.iter().copied().fold(f64::INFINITY, f64::min);
                let high = y.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                // Exact at the points; interpolation rounds between them.
                if low == high { Interval::point(low) } else { Interval::closed(low, high).rounded() }
            }
            _ => Interval::ALL,
        }
    }

    fn branch(&mut self, condition: ExprId, holds: bool, value: ExprId) -> Interval {
        match self.ranges_only {
            true => self.interval(value),
            false => self.assuming(condition, holds, |reach| reach.interval(value)),
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
            BinaryOp::Subtract => self.difference(a, b),
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
                match self.system.literal(b) {
                    Some(n) if whole(n) => {
                        let n = if n < 0.0 && planted::is("x^-n is 1/x^2") { -2.0 } else { n };
                        let power = x.power(n.abs() as u32);
                        if n < 0.0 { power.reciprocal() } else { power }
                    }
                    Some(0.5) => x.sqrt(),
                    _ => {
                        let n = self.interval(b);
                        (Binary::Pow.row().image)(x, n)
                    }
                }
            }
            _ => Interval::ALL,
        }
    }

    /// a − b. A comparison of a and b agrees with the sign of the unfused difference: gradual underflow keeps a ≠ b
    /// apart.
    fn difference(&mut self, a: ExprId, b: ExprId) -> Interval {
        if self.same(a, b) {
            return Interval::point(0.0);
        }
        let (x, y) = (self.interval(a), self.interval(b));
        let mut out = x.minus(y);
        let above = |strict: bool| if strict { Interval::from(f64::from_bits(1)) } else { Interval::from(0.0) };
        if let Some(strict) = self.ordered(a, b) {
            out = out.and(above(strict));
        }
        if let Some(strict) = self.ordered(b, a) {
            out = out.and(above(strict).negate());
        }
        // p t ≥ q u with a = c t and b = d u implies a − b ≥ (c q/p − d) u.
        let ((c, t), (d, u)) = (self.scaled(a), self.scaled(b));
        for order in self.all_orders() {
            let ((p, large), (q, small)) = (self.scaled(order.large), self.scaled(order.small));
            if self.same(large, t) && self.same(small, u) && p > 0.0 && c > 0.0 {
                let least = self.share(c * q / p, d, u).low;
                out = out.and(Interval::from(least));
            } else if self.same(large, u) && self.same(small, t) && q > 0.0 && c > 0.0 {
                let most = self.share(c * p / q, d, u).high;
                out = out.and(Interval::to(most));
            }
        }
        out
    }

    /// (f − d) u, provided that the factors differ by more than their rounding errors.
    fn share(&mut self, f: f64, d: f64, u: ExprId) -> Interval {
        let rest = f - d;
        match rest.abs() > 1e-9 * f.abs().max(d.abs()) {
            true => {
                let u = self.interval(u);
                u.multiply(Interval::closed(rest - 1e-12 * rest.abs(), rest + 1e-12 * rest.abs()))
            }
            false => Interval::ALL,
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
            if k.is_empty() || k.low < 0.0 || k.high > 1.0 {
                continue;
            }
            let (from, to) = (self.interval(a), self.interval(b));
            let ends = from.hull(to);
            let mut between = if planted::is("mixtures need no order") { ends } else { ends.rounded() };
            // a ≥ 0 and b ≥ 0 imply b − a ≥ −a, rounded or not, so the sum is not negative.
            if ends.is_not_negative() {
                between = between.and(Interval::from(0.0));
            }
            // b ≥ a: the addend of a is not negative.
            if from.high <= to.low || self.ordered(b, a).is_some() {
                between = between.and(Interval::from(from.low));
            } else if to.high <= from.low || self.ordered(a, b).is_some() {
                between = between.and(Interval::to(from.high));
            }
            return Some(between);
        }
        None
    }

    fn call(&mut self, builtin: Builtin, args: &[ExprId]) -> Interval {
        let values: Vec<Interval> = match builtin {
            // A delayed value was computed at an earlier instant.
            Builtin::Delay => args.iter().map(|arg| self.plain(*arg)).collect(),
            _ => args.iter().map(|arg| self.interval(*arg)).collect(),
        };
        if values.iter().any(|value| value.is_empty()) {
            return Interval::EMPTY;
        }
        let unit = Interval::closed(-1.0, 1.0);
        match builtin {
            Builtin::Abs => values[0].abs(),
            Builtin::Sign => {
                let sign = |x: f64| if x > 0.0 { 1.0 } else { f64::from(i8::from(x >= 0.0)) - 1.0 };
                let away = if values[0].away > 0.0 { 1.0 } else { 0.0 };
                Interval::closed(sign(values[0].low), sign(values[0].high)).and(Interval::beyond(away))
            }
            Builtin::Min => values[0].min(values[1]),
            Builtin::Max => values[0].max(values[1]),
            Builtin::Clamp => values[0].max(values[1]).min(values[2]),
            Builtin::Floor if planted::is("the floor of a positive number is positive") => values[0],
            Builtin::Floor => Interval::closed(values[0].low.floor(), values[0].high.floor()),
            Builtin::Sqrt => values[0].sqrt(),
            Builtin::Unary(function) => function.image(values[0]),
            Builtin::Binary(function) => (function.row().image)(values[0], values[1]),
            Builtin::Delay => values[0].rounded(),
            Builtin::Random => Interval::closed(0.0, 1.0_f64.next_down()),
            Builtin::Step => values[1].hull(Interval::point(0.0)),
            Builtin::Pulse => values[2].hull(Interval::point(0.0)),
            Builtin::Square => values[0].hull(values[0].negate()),
            Builtin::Sine | Builtin::Chirp | Builtin::Noise => unit.multiply(values[0]),
            Builtin::Ramp => values[1].plus(values[2].multiply(Interval::closed(0.0, HUGE))),
        }
    }
}

/// Limit on the number of operations inverted in sequence.
const DEEPEST: u32 = 8;

/// The largest whole exponent whose power is computed by multiplication.
const MOST_MULTIPLIED: f64 = 64.0;

/// Whether a power with this exponent is computed by multiplication.
pub fn whole(n: f64) -> bool {
    n.fract() == 0.0 && n.abs() <= MOST_MULTIPLIED
}

/// The interval of x, given an interval of x^n with n even.
fn roots_of(inside: Interval, n: u32) -> Interval {
    if inside.high < 0.0 {
        return Interval::EMPTY;
    }
    let root = |x: f64| if n == 2 { x.sqrt() } else { functions::root(x, n) };
    // A subnormal product has a relative error of up to a half, or underflows to 0.
    let away = match inside.low {
        low if low >= f64::MIN_POSITIVE => root(low) * (1.0 - SLACK),
        low if low > 0.0 && n == 2 => 0.5 * root(low),
        _ => 0.0,
    };
    let most = if inside.high < f64::MIN_POSITIVE { 1e-150 } else { root(inside.high) * (1.0 + SLACK) };
    let most = if n == 2 || inside.high >= f64::MIN_POSITIVE { most } else { 1.0 };
    Interval::closed(-most, most).and(Interval::beyond(away))
}
