//! Emission: the expressions of a system become the operations of one function.

use super::{Location, Plan};
use crate::frontend::causality::{Phase, rate_of, value_of};
use crate::frontend::delays;
use crate::frontend::system::*;
use crate::ir::build::Build;
use crate::ir::hash::HashMap;
use crate::ir::{Binary, Type, Unary, Value};
use crate::numerics::impulse;
use abi::description::Slot;
use grammar::ast::BinaryOp;

/// Emits one function; each node and quantity at most once.
pub(super) struct Emit<'a> {
    plan: &'a Plan<'a>,
    phase: Phase,
    pub(super) build: Build,
    nodes: Vec<Option<Value>>,
    /// Parameters are replaced by their values, and quantities unknown before a run by NaN.
    pub(super) inline_params: bool,
    /// With `inline_params`: independent parameters are read from their slots nevertheless.
    pub(super) loads_params: bool,
    /// Whether the function is evaluated between two instants, where every crossing is false.
    pub(super) between: bool,
    /// A quantity that is read from [`impulse::FORCE`] instead of being computed.
    pub(super) replaced: Option<VarId>,
}

impl<'a> Emit<'a> {
    pub(super) fn new(plan: &'a Plan<'a>, name: &str, phase: Phase) -> Emit<'a> {
        let build = Build::new(name).with_pool(plan.description.pool.clone());
        let nodes = vec![None; plan.system.nodes.len()];
        let [inline_params, loads_params, between] = [false; 3];
        Emit { plan, phase, build, nodes, inline_params, loads_params, between, replaced: None }
    }

    /// The expression that a node forwards to, if it does not compute its value from its operands.
    fn forwarded(&self, node: &Node) -> Option<ExprId> {
        let system = self.plan.system;
        match node {
            Node::Var(id) if self.replaced == Some(*id) => None,
            Node::Var(id) => {
                let stored = matches!(self.plan.places[id.0 as usize], Location::Slot(_));
                let var = system.var(*id);
                let param = matches!(var.definition, Definition::Value(..));
                if stored && param && (!self.inline_params || self.loads_params) {
                    return None; // A parameter with a slot.
                }
                if self.inline_params && !param {
                    return None; // Not known before a run.
                }
                value_of(var, self.phase)
            }
            Node::Rate(_) | Node::PathRate(_) if !self.inline_params => rate_of(system, node),
            _ => None,
        }
    }

    /// The value of an expression, shared with all its other uses.
    pub(super) fn value(&mut self, id: ExprId) -> Value {
        let system = self.plan.system;
        let mut stack = vec![id];
        while let Some(&top) = stack.last() {
            if self.nodes[top.0 as usize].is_some() {
                stack.pop();
                continue;
            }
            let node = system.node(top);
            let forwarded = self.forwarded(node);
            let crossing = match node {
                Node::Crossing(k) => Some(system.crossings[*k as usize].difference),
                _ => None,
            };
            let waiting: Vec<ExprId> = forwarded
                .into_iter()
                .chain(crossing)
                .chain(self.operands(node))
                .filter(|operand| self.nodes[operand.0 as usize].is_none())
                .collect();
            if waiting.is_empty() {
                let value = match forwarded {
                    Some(forwarded) => self.held_value(node, forwarded),
                    None => self.node(top),
                };
                self.nodes[top.0 as usize] = Some(value);
                stack.pop();
            } else {
                stack.extend(waiting.into_iter().rev());
            }
        }
        self.nodes[id.0 as usize].expect("just computed")
    }

    /// The operands that must be computed. A delay that breaks cycles needs only its time, except at the start.
    pub(super) fn operands<'n>(&self, node: &'n Node) -> impl Iterator<Item = ExprId> + use<'n> {
        let known = self.phase != Phase::Start && delays::breaks(self.plan.system, node);
        node.operands().skip(usize::from(known))
    }

    fn got(&self, id: ExprId) -> Value {
        self.nodes[id.0 as usize].expect("operands are computed first")
    }

    fn types_of(&self, a: ExprId, b: ExprId) -> (Type, Type) {
        (self.build.type_of(self.got(a)), self.build.type_of(self.got(b)))
    }

    /// An operand as a condition. Constants are evaluated even in texts with errors, where an operand may have the
    /// wrong type.
    fn condition(&mut self, id: ExprId) -> Value {
        let value = self.got(id);
        if self.build.type_of(value) == Type::Bool { value } else { self.truth(value) }
    }

    /// An operand as a quantity; see [`condition`](Self::condition).
    fn quantity(&mut self, id: ExprId) -> Value {
        let value = self.got(id);
        self.as_number(value)
    }

    /// The value of a computed quantity. At a tick, a held quantity is updated only if its block is due.
    fn held_value(&mut self, node: &Node, forwarded: ExprId) -> Value {
        let value = self.got(forwarded);
        let (Node::Var(id), Phase::Tick) = (node, self.phase) else { return value };
        let Definition::Held { block, .. } = self.plan.system.var(*id).definition else { return value };
        let Location::Slot(slot) = self.plan.places[id.0 as usize] else { return value };
        let due = self.due(block);
        let before = self.build.load(slot);
        if self.plan.types.boolean_vars[id.0 as usize] {
            let before = self.truth(before);
            return self.build.select(due, value, before);
        }
        self.build.select(due, value, before)
    }

    pub(super) fn due(&mut self, block: BlockId) -> Value {
        let flag = self.build.load(self.plan.description.layout.due.slot(block.0 as usize));
        self.truth(flag)
    }

    /// The present value of a quantity.
    pub(super) fn var(&mut self, id: VarId) -> Value {
        let node = Node::Var(id);
        match self.forwarded(&node) {
            Some(forwarded) => {
                self.value(forwarded);
                self.held_value(&node, forwarded)
            }
            None => self.leaf(id),
        }
    }

    /// As [`var`](Self::var), in its stored form: a number.
    pub(super) fn stored(&mut self, id: VarId) -> Value {
        let value = self.var(id);
        self.as_number(value)
    }

    fn leaf(&mut self, id: VarId) -> Value {
        if self.replaced == Some(id) {
            return self.build.load(impulse::FORCE);
        }
        match self.plan.places[id.0 as usize] {
            Location::Slot(slot) if !self.inline_params || self.loads_params && self.is_param(slot) => {
                let value = self.build.load(slot);
                if self.plan.types.boolean_vars[id.0 as usize] { self.truth(value) } else { value }
            }
            // Unknown: an input, or a quantity without a definition.
            _ => {
                let unknown = self.build.real(f64::NAN);
                if self.plan.types.boolean_vars[id.0 as usize] { self.truth(unknown) } else { unknown }
            }
        }
    }

    fn is_param(&self, slot: Slot) -> bool {
        self.plan.description.layout.params.contains(slot)
    }

    /// A stored truth value as a condition: true if it is not 0.
    fn truth(&mut self, value: Value) -> Value {
        let half = self.build.real(0.5);
        self.build.less(half, value)
    }

    /// A condition as 1 or 0.
    pub(super) fn number(&mut self, condition: Value) -> Value {
        let (one, zero) = (self.build.real(1.0), self.build.real(0.0));
        self.build.select(condition, one, zero)
    }

    /// A value as it is stored. Its own type decides, because in a text with errors the checker may call it otherwise.
    pub(super) fn as_number(&mut self, value: Value) -> Value {
        if self.build.type_of(value) == Type::Bool { self.number(value) } else { value }
    }

    /// Whether a value varies during a run.
    pub(super) fn moves(&self, value: Value, known: &mut HashMap<Value, bool>) -> bool {
        let params = self.plan.description.layout.params;
        let mut stack = vec![value];
        while let Some(&top) = stack.last() {
            if known.contains_key(&top) {
                stack.pop();
                continue;
            }
            let op = self.build.get(top);
            if let crate::ir::Op::Load(slot) = op {
                known.insert(top, !params.contains(slot));
                continue;
            }
            let mut operands = Vec::new();
            op.each_operand(|operand| operands.push(operand));
            let open: Vec<Value> = operands.iter().copied().filter(|v| !known.contains_key(v)).collect();
            if open.is_empty() {
                known.insert(top, operands.iter().any(|v| known[v]));
            } else {
                stack.extend(open);
            }
        }
        known[&value]
    }

    fn node(&mut self, id: ExprId) -> Value {
        let node = self.plan.system.node(id).clone();
        match node {
            Node::Number { value, .. } => self.build.real(value),
            Node::Bool(truth) => self.build.truth(truth),
            Node::Time if self.inline_params => self.build.real(f64::NAN),
            Node::Time if self.phase == Phase::Start => self.build.real(0.0),
            Node::Time => self.build.load(Slot::TIME),
            Node::Var(var) => self.leaf(var),
            Node::Rate(_) | Node::PathRate(_) | Node::Hole | Node::Error | Node::Measure(..) => {
                self.build.real(f64::NAN)
            }
            Node::Negate(a) => {
                let a = self.quantity(a);
                self.build.neg(a)
            }
            Node::Not(a) => {
                let a = self.condition(a);
                self.build.not(a)
            }
            Node::Fits { value, .. } => self.got(value),
            Node::If(c, a, b) => {
                let c = self.condition(c);
                match self.types_of(a, b) {
                    (Type::Bool, Type::Bool) => {
                        let (a, b) = (self.got(a), self.got(b));
                        self.build.select(c, a, b)
                    }
                    _ => {
                        let (a, b) = (self.quantity(a), self.quantity(b));
                        self.build.select(c, a, b)
                    }
                }
            }
            Node::InRegime(automaton, regime) => {
                let number = self.build.real(f64::from(regime));
                let k = automaton.0 as usize;
                let active = match self.phase {
                    Phase::Start => self.build.real(f64::from(self.plan.system.automata[k].initial)),
                    Phase::Now | Phase::Tick => self.build.load(self.plan.description.layout.regimes.slot(k)),
                };
                self.build.equal(active, number)
            }
            Node::Crossing(k) => self.crossing(k as usize),
            Node::Table(k, x) => {
                let x = self.quantity(x);
                self.plan.tables[k as usize].at(x, &mut self.build)
            }
            Node::Binary(op, a, b) => {
                let boolean = self.plan.types.boolean[a.0 as usize];
                let exponent = match self.plan.system.node(b) {
                    _ if op == BinaryOp::Power => self.plan.system.literal(b),
                    _ => None,
                };
                let (a, b) = match op {
                    BinaryOp::And | BinaryOp::Or => (self.condition(a), self.condition(b)),
                    BinaryOp::Equal | BinaryOp::NotEqual if boolean => (self.condition(a), self.condition(b)),
                    _ => (self.quantity(a), self.quantity(b)),
                };
                self.binary(op, a, b, boolean, exponent)
            }
            Node::Call(Builtin::Delay, _) => self.delay(id),
            Node::Call(builtin, args) => {
                let args: Vec<Value> = args.iter().map(|arg| self.quantity(*arg)).collect();
                self.call(builtin, &args)
            }
        }
    }

    /// The delayed value, or an interpolation between it and the present one. At the start it is the present value.
    fn delay(&mut self, id: ExprId) -> Value {
        let (value, _) = delays::of(self.plan.system, id);
        if self.inline_params {
            return self.build.real(f64::NAN); // Not known before a run.
        }
        if self.phase == Phase::Start {
            return self.quantity(value);
        }
        let delay = &self.plan.description.delays[self.plan.delayed[&id]];
        let past = self.build.load(delay.past);
        let Some(weight) = delay.weight else { return past };
        let (weight, now) = (self.build.load(weight), self.quantity(value));
        let way = self.build.sub(now, past);
        let part = self.build.mul(weight, way);
        self.build.add(past, part)
    }

    fn crossing(&mut self, k: usize) -> Value {
        if self.phase == Phase::Start || self.between {
            return self.build.truth(false);
        }
        let crossing = &self.plan.system.crossings[k];
        let now = self.got(crossing.difference);
        let before = self.build.load(self.plan.crossings[k]);
        let zero = self.build.real(0.0);
        let was_below = self.build.less(before, zero);
        let is_not_below = self.build.less_equal(zero, now);
        let rises = self.build.and(was_below, is_not_below);
        let was_above = self.build.less(zero, before);
        let is_not_above = self.build.less_equal(now, zero);
        let falls = self.build.and(was_above, is_not_above);
        match crossing.kind {
            BinaryOp::Rises => rises,
            BinaryOp::Falls => falls,
            _ => self.build.or(rises, falls),
        }
    }

    fn binary(&mut self, op: BinaryOp, a: Value, b: Value, boolean: bool, exponent: Option<f64>) -> Value {
        let build = &mut self.build;
        match op {
            BinaryOp::Add => build.add(a, b),
            BinaryOp::Subtract => build.sub(a, b),
            BinaryOp::Multiply => build.mul(a, b),
            BinaryOp::Divide => build.div(a, b),
            BinaryOp::Power => self.power(a, b, exponent),
            BinaryOp::Less => build.less(a, b),
            BinaryOp::LessEqual => build.less_equal(a, b),
            BinaryOp::Greater => build.less(b, a),
            BinaryOp::GreaterEqual => build.less_equal(b, a),
            BinaryOp::Equal | BinaryOp::NotEqual => {
                let same = if boolean {
                    let not = build.not(b);
                    build.select(a, b, not)
                } else {
                    build.equal(a, b)
                };
                if op == BinaryOp::Equal { same } else { build.not(same) }
            }
            BinaryOp::And => build.and(a, b),
            BinaryOp::Or => build.or(a, b),
            BinaryOp::Crosses | BinaryOp::Rises | BinaryOp::Falls => unreachable!("crossings are nodes of their own"),
        }
    }

    /// A constant whole exponent becomes repeated squaring, ½ the square root, and any other exponent `pow`.
    fn power(&mut self, a: Value, b: Value, exponent: Option<f64>) -> Value {
        match exponent {
            Some(n) if n.fract() == 0.0 && n.abs() <= 64.0 => {
                let mut rest = n.abs() as u32;
                let (mut square, mut product) = (a, None);
                while rest > 0 {
                    if rest & 1 == 1 {
                        product = Some(match product {
                            None => square,
                            Some(product) => self.build.mul(product, square),
                        });
                    }
                    rest >>= 1;
                    if rest > 0 {
                        square = self.build.mul(square, square);
                    }
                }
                let one = self.build.real(1.0);
                let product = product.unwrap_or(one);
                if n < 0.0 { self.build.div(one, product) } else { product }
            }
            Some(0.5) => self.build.sqrt(a),
            _ => self.build.binary(Binary::Pow, a, b),
        }
    }

    fn call(&mut self, builtin: Builtin, args: &[Value]) -> Value {
        match builtin {
            Builtin::Abs => self.build.abs(args[0]),
            Builtin::Sign => self.build.sign(args[0]),
            Builtin::Min => self.build.min(args[0], args[1]),
            Builtin::Max => self.build.max(args[0], args[1]),
            Builtin::Clamp => self.build.clamp(args[0], args[1], args[2]),
            Builtin::Floor => self.build.floor(args[0]),
            Builtin::Sqrt => self.build.sqrt(args[0]),
            Builtin::Unary(function) => self.build.unary(function, args[0]),
            Builtin::Binary(function) => self.build.binary(function, args[0], args[1]),
            Builtin::Random => self.random(args[0], args[1]),
            Builtin::Step => {
                let time = self.time();
                let on = self.build.less_equal(args[0], time);
                let zero = self.build.real(0.0);
                self.build.select(on, args[1], zero)
            }
            Builtin::Ramp => {
                let time = self.time();
                let (since, zero) = (self.build.sub(time, args[0]), self.build.real(0.0));
                let since = self.build.max(zero, since);
                let risen = self.build.mul(args[2], since);
                self.build.add(args[1], risen)
            }
            Builtin::Pulse => {
                let time = self.time();
                let end = self.build.add(args[0], args[1]);
                let begun = self.build.less_equal(args[0], time);
                let open = self.build.less(time, end);
                let on = self.build.and(begun, open);
                let zero = self.build.real(0.0);
                self.build.select(on, args[2], zero)
            }
            Builtin::Sine => {
                let phase = self.turns(args[1]);
                let angle = self.angle(phase);
                let sine = self.build.unary(Unary::Sin, angle);
                self.build.mul(args[0], sine)
            }
            Builtin::Square => {
                let phase = self.turns(args[1]);
                let whole = self.build.floor(phase);
                let (part, half) = (self.build.sub(phase, whole), self.build.real(0.5));
                let first = self.build.less(part, half);
                let negative = self.build.neg(args[0]);
                self.build.select(first, args[0], negative)
            }
            Builtin::Chirp => {
                // Phase in turns: f0 t + (f1 − f0) t² / (2 T), held at f1 after T.
                let time = self.time();
                let ramp = self.build.min(args[3], time);
                let (difference, two) = (self.build.sub(args[2], args[1]), self.build.real(2.0));
                let span = self.build.mul(two, args[3]);
                let slope = self.build.div(difference, span);
                let square = self.build.mul(ramp, ramp);
                let bent = self.build.mul(slope, square);
                let plain = self.build.mul(args[1], ramp);
                let after = self.build.sub(time, ramp);
                let tail = self.build.mul(args[2], after);
                let phase = self.build.add(plain, bent);
                let phase = self.build.add(phase, tail);
                let angle = self.angle(phase);
                let sine = self.build.unary(Unary::Sin, angle);
                self.build.mul(args[0], sine)
            }
            Builtin::Delay => unreachable!("it is no function of its arguments"),
            Builtin::Noise => {
                let time = self.time();
                let number = self.build.div(time, args[1]);
                let number = self.build.floor(number);
                let random = self.random(args[2], number);
                let (two, one) = (self.build.real(2.0), self.build.real(1.0));
                let wide = self.build.mul(two, random);
                let centred = self.build.sub(wide, one);
                self.build.mul(args[0], centred)
            }
        }
    }

    fn time(&mut self) -> Value {
        if self.inline_params {
            return self.build.real(f64::NAN); // Not known before a run.
        }
        match self.phase {
            Phase::Start => self.build.real(0.0),
            Phase::Now | Phase::Tick => self.build.load(Slot::TIME),
        }
    }

    /// f · t, a phase in turns.
    fn turns(&mut self, frequency: Value) -> Value {
        let time = self.time();
        self.build.mul(frequency, time)
    }

    /// A phase in turns as an angle in radians, after whole turns are removed.
    fn angle(&mut self, turns: Value) -> Value {
        let whole = self.build.nearest(turns);
        let part = self.build.sub(turns, whole);
        let turn = self.build.real(2.0 * std::f64::consts::PI);
        self.build.mul(turn, part)
    }

    /// Uniform in [0, 1): the top 53 bits of SplitMix64's finaliser of seed · 0x9E37… + k.
    /// Source: Steele, Lea, Flood, OOPSLA 2014.
    fn random(&mut self, seed: Value, k: Value) -> Value {
        let build = &mut self.build;
        let (seed, k) = (build.to_int(seed), build.to_int(k));
        let golden = build.int(abi::random::GAMMA as i64);
        let spread = build.int_mul(seed, golden);
        let mut z = build.int_add(spread, k);
        for (shift, factor) in [(30, 0xBF58_476D_1CE4_E5B9_u64), (27, 0x94D0_49BB_1331_11EB_u64)] {
            let shifted = build.shift_right(z, shift);
            let mixed = build.int_xor(z, shifted);
            let factor = build.int(factor as i64);
            z = build.int_mul(mixed, factor);
        }
        let shifted = build.shift_right(z, 31);
        z = build.int_xor(z, shifted);
        let top = build.shift_right(z, 11);
        let top = build.to_real(top);
        let unit = build.real(1.0 / 9_007_199_254_740_992.0);
        build.mul(top, unit)
    }
}
