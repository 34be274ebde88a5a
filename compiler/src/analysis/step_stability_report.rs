//! Diagnostics about the stability of fixed steps, in terms of the user's text.
//!
//! In: a system with its program, method and step. Out: E0702 for an instability within declared ranges; W0704 if
//! ranges are open or the model itself grows too fast for `implicit`; W0705 for chattering. The analysis itself is in
//! [`step_stability`](crate::analysis::step_stability).

use crate::analysis::explain::{SelfDependence, states};
use crate::analysis::memo::Memo;
use crate::analysis::step_stability::{Bench, Chatter, LONGEST, Singular, StabilityLimit, Unstable, ten_to};
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::program::Program;
use crate::numerics::fixed_step;
use abi::Slot;
use abi::format::{duration, prefixed, quantity, significant};
use abi::plan::{Method, Steps};
use abi::unit::Unit;
use grammar::ast::BinaryOp;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::cell::LazyCell;

/// A system in fixed steps, and the related spans of the text.
pub struct Fixed<'a> {
    /// The flat system.
    pub system: &'a System,
    /// Its types.
    pub types: &'a Types,
    /// The program, with ring buffers sized for the step.
    pub program: &'a Program,
    /// The method.
    pub method: Method,
    /// Length of a step in s.
    pub step: f64,
    /// Span of the method's name, or else of the step.
    pub place: Span,
    /// Span of the run's instance: `Servo(…)`.
    pub run: Span,
    /// Conditions that end a run, and the outputs that hold their values.
    pub ends: &'a [(ExprId, Slot)],
    /// What determines the step.
    pub by: StepBy,
    /// Name of the experiment or rig.
    pub name: &'a str,
}

/// What determines the length of a step, and so what the user can change.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum StepBy {
    /// `solver` in the text.
    Text,
    /// An option of the command: `--solver`, `--step`.
    Option,
    /// The `rate` of a rig.
    Rate,
}

/// Checks the step; returns at most one diagnostic of each kind.
pub fn check(fixed: &Fixed, files: &Files) -> Vec<Diagnostic> {
    let ends = fixed.ends_at();
    static KNOWN: Memo<Finding> = Memo::new();
    let also: Vec<u64> =
        ends.iter().map(|slot| u64::from(slot.0)).chain([fixed.step.to_bits(), fixed.method as u64]).collect();
    // Its points also serve the remedies.
    let bench = LazyCell::new(|| Bench::new(fixed.program, &ends));
    match KNOWN.answer(fixed.program, &also, || Finding::of(bench.as_ref(), fixed.method, fixed.step)) {
        Finding::Unstable(unstable) => vec![fixed.unstable(&unstable, bench.as_ref(), files)],
        Finding::Singular(singular) => vec![fixed.singular(&singular)],
        Finding::Chatters(chatter) => vec![fixed.chatters(&chatter)],
        Finding::Nothing => Vec::new(),
    }
}

#[derive(Clone)]
enum Finding {
    Unstable(Unstable),
    Singular(Singular),
    Chatters(Chatter),
    Nothing,
}

impl Finding {
    /// The finding for a program that is run in steps of one length.
    fn of(bench: Option<&Bench>, method: Method, step: f64) -> Finding {
        let Some(bench) = bench else { return Finding::Nothing };
        // A chattering state is also unstable; the jump is the cause.
        if let Some(chatter) = bench.chatters(method, step) {
            return Finding::Chatters(chatter);
        }
        let unstable = bench.unstable(method, step);
        // An instability within declared ranges is an error, which the warning must not replace.
        let open = unstable.as_ref().is_none_or(|found| found.along.as_ref().is_some_and(|along| !along.closed));
        let look = open && method == Method::Implicit;
        match (look.then(|| bench.singular(step)).flatten(), unstable) {
            (Some(singular), _) => Finding::Singular(singular),
            (None, Some(unstable)) => Finding::Unstable(unstable),
            (None, None) => Finding::Nothing,
        }
    }
}

impl Fixed<'_> {
    /// The continuous state of this index.
    fn state(&self, number: usize) -> VarId {
        let continuous = |id: &VarId| matches!(self.system.var(*id).definition, Definition::Continuous { .. });
        self.system.var_ids().filter(continuous).nth(number).expect("the program has a slot for each state")
    }

    fn unstable(&self, unstable: &Unstable, bench: Option<&Bench>, files: &Files) -> Diagnostic {
        let (system, id) = (self.system, self.state(unstable.state));
        let var = system.var(id);
        let (method, step) = (self.method.name(), duration(self.step, 3));
        let own = states(system, self.program).into_iter().find(|state| state.path == var.path).map(|state| state.own);
        let linear = own == Some(SelfDependence::Affine) && self.method.row().steps == Steps::Explicit;
        let stiff = unstable.rate * self.step > 1.0;
        let place = match system.instance(var.instance).path.is_empty() {
            true => self.run,
            // A part inside a library cannot be changed by the user; the label is on the run.
            false if system.instance(var.instance).span.file != self.place.file => self.run,
            false => whole_instance(files, system.instance(var.instance).span),
        };
        let scanned = unstable.along.as_ref().and_then(|along| Some((along, self.name_of(along, var.instance)?)));
        let open = scanned.as_ref().is_some_and(|(along, _)| !along.closed);
        // Stability need not be monotonic in the step; this one is known to be too long.
        let largest = bench.map_or(0.0, |bench| bench.largest_stable(self.method)).min(0.95 * self.step);
        let needed = stable_up_to(largest);

        let message = match open {
            true => format!("{method} at {step} is a large step for this model"),
            false => format!("{method} at {step} is not stable for this model"),
        };
        let mut out = if open { Diagnostic::warning("W0704", message) } else { Diagnostic::error("E0702", message) };
        let rate = match &scanned {
            Some((along, (_, unit))) if stiff && !along.inward => {
                format!("a rate of {} 1/s per {}", two(unstable.rate / along.farthest * unit.scale), unit.text)
            }
            _ if stiff => format!("a rate of {} 1/s", two(unstable.rate)),
            _ => "it swings faster than such steps can follow".into(),
        };
        let equation = self.slope(id).filter(|_| stiff).map(|slope| format!("{slope}: ")).unwrap_or_default();
        let about = if stiff { String::new() } else { format!("`{}`: ", var.path) };
        out = out.label(place, format!("{about}{equation}{rate}"));
        let limit = match &scanned {
            Some((along, (name, unit))) => {
                let (limit, far) = (amount(along.limit, unit), amount(along.farthest, unit));
                match (along.inward, open) {
                    (true, _) => {
                        format!(
                            "stable at {step} only for |{name}| >= {limit}; at rest it would need a step of {needed}"
                        )
                    }
                    (false, true) => {
                        format!(
                            "stable at {step} only for |{name}| <= {limit}; at {far} it would need a step of {needed}"
                        )
                    }
                    (false, false) if self.end(along).is_some() => {
                        format!("stable at {step} only for |{name}| <= {limit}")
                    }
                    (false, false) => {
                        format!(
                            "stable at {step} only for |{name}| <= {limit}; up to {far} it would need a step of {needed}"
                        )
                    }
                }
            }
            None => format!("stable up to a step of {needed} only"),
        };
        out = out.label(self.place, limit);
        if let Some((along, _)) = scanned.as_ref().filter(|(along, _)| along.closed)
            && let Some(end) = self.end(along)
        {
            out = out.label(end, format!("up to here it would need a step of {needed}"));
        }
        let derivative = format!("d{}/dt", var.name);
        let file = &files.get(self.place.file).name;
        let shorter = self.shorter(largest);
        let solver = if self.by == StepBy::Option { "--solver" } else { "solver" };
        let help = match linear && stiff {
            true => format!(
                "{derivative} is linear in {}, so `{solver} expo` steps it exactly at any speed.\n\
                 `fric explain {file} {}` shows the numbers per state",
                var.name, self.name
            ),
            false if bench.is_some_and(|bench| self.is_stable_by_implicit(bench)) => {
                format!("`{solver} implicit` is stable at this step; or {shorter}")
            }
            false => format!("{shorter}{}", self.adaptive()),
        };
        let keep = if open { "\nTo keep it: `allow large-step \"...\"`" } else { "" };
        out.help(format!("{help}{keep}"))
    }

    /// Whether `implicit`, which is another method, is stable with this step.
    fn is_stable_by_implicit(&self, bench: &Bench) -> bool {
        static KNOWN: Memo<bool> = Memo::new();
        let also: Vec<u64> = self.ends.iter().map(|(_, slot)| u64::from(slot.0)).chain([self.step.to_bits()]).collect();
        let is_stable = || bench.unstable(Method::Implicit, self.step).is_none();
        self.method != Method::Implicit && KNOWN.answer(self.program, &also, is_stable)
    }

    /// What to write for steps of at most this length.
    fn shorter(&self, most: f64) -> String {
        let step = below(most);
        match self.by {
            StepBy::Text => format!("write `step {step}`"),
            StepBy::Option => format!("take `--step {}`", step.replace(' ', "")),
            StepBy::Rate => format!("divide the period: `solver {} step {step}`", self.method.name()),
        }
    }

    /// The other remedy, where steps may have any length.
    fn adaptive(&self) -> &'static str {
        match self.by {
            StepBy::Text => ", or leave `solver` out: adaptive",
            StepBy::Option => ", or take `--solver adaptive`",
            StepBy::Rate => "",
        }
    }

    /// Slots of the outputs that are not 0 where a run ends.
    fn ends_at(&self) -> Vec<Slot> {
        self.ends.iter().map(|(_, slot)| *slot).collect()
    }

    fn singular(&self, singular: &Singular) -> Diagnostic {
        let (slot, value) = singular.at;
        let quantities = &self.program.description.quantities;
        let moved = quantities.iter().find(|quantity| quantity.slot == slot).expect("it was moved");
        let unit = self.system.var_ids().find(|id| self.system.var(*id).path == moved.path);
        let unit = unit.map_or(&moved.unit, |id| &self.types.units[id.0 as usize]);
        let (at, step) = (amount(value, unit), duration(self.step, 3));
        let rate = two(singular.rate);
        // With γhλ ≤ ½ the equations of a step are far from singular.
        let shorter = self.shorter(0.5 / (fixed_step::GAMMA * singular.rate));
        Diagnostic::warning("W0704", format!("implicit at {step} is a large step for this model"))
            .label(self.run, format!("near {} = {at} the model itself grows at {rate} 1/s", moved.path))
            .label(
                self.place,
                format!("from {} 1/s on a step overshoots without limit", two(1.0 / (fixed_step::GAMMA * self.step))),
            )
            .help(format!("{shorter}{}\nTo keep it: `allow large-step \"...\"`", self.adaptive()))
    }

    fn chatters(&self, chatter: &Chatter) -> Diagnostic {
        let id = self.state(chatter.state);
        let (var, unit) = (self.system.var(id), &self.types.units[id.0 as usize]);
        let far = amount(chatter.amplitude, unit);
        Diagnostic::warning("W0705", format!("`{}` never comes to rest with a fixed step", var.path))
            .label(self.place, format!("steps throw it to and fro by {far}"))
            .label(var.span, "its rate jumps where this changes its sign")
            .help(
                "a force that jumps needs a contact that holds: `Sticking(law = ...)` keeps this law and rests exactly at\n\
                 any step, KFM and Karnopp have laws of their own, LuGre a bristle; or take a smooth sign,\n\
                 `tanh(v / v0)`. To keep it: `allow chatter \"...\"`",
            )
    }

    /// The name that the owner of a state has for the varied quantity, and its unit.
    fn name_of(&self, along: &StabilityLimit, owner: InstanceId) -> Option<(String, Unit)> {
        let system = self.system;
        let moved = self.program.description.quantities.iter().find(|quantity| quantity.slot == along.slot)?;
        let moved = system.var_ids().find(|id| system.var(*id).path == moved.path)?;
        // An input that is passed on under other names counts as the same.
        let source = |id: VarId| {
            let mut id = id;
            for _ in 0..system.vars.len() {
                let Definition::Value(value, _) = system.var(id).definition else { break };
                let Some(next) = system.alias(value) else { break };
                id = next;
            }
            id
        };
        let inputs = system.var_ids().filter(|id| system.var(*id).instance == owner);
        let mut inputs = inputs.filter(|id| system.var(*id).kind == VarKind::Input);
        let named = inputs.find(|id| source(*id) == moved);
        let id = named.unwrap_or(moved);
        let var = system.var(id);
        let name = if var.instance == owner { &var.name } else { &var.path };
        Some((name.clone(), self.types.units[id.0 as usize].clone()))
    }

    /// The span of the bound: the number in the condition that ends a run, or a range.
    fn end(&self, along: &StabilityLimit) -> Option<Span> {
        let system = self.system;
        let near = |id: ExprId| {
            let value = crate::lower::evaluate(system, self.types, &[id])[0].abs();
            (value - along.farthest).abs() <= 1e-3 * along.farthest
        };
        let mut stack: Vec<ExprId> = self.ends.iter().map(|(condition, _)| *condition).collect();
        while let Some(id) = stack.pop() {
            match system.node(id) {
                Node::Binary(BinaryOp::Or | BinaryOp::And, a, b) => stack.extend([*a, *b]),
                Node::Binary(_, a, b) => {
                    if let Some(end) = [*a, *b].into_iter().find(|side| near(*side)) {
                        return Some(system.span(end));
                    }
                }
                _ => {}
            }
        }
        let moved = self.program.description.quantities.iter().find(|quantity| quantity.slot == along.slot)?;
        system.vars.iter().find(|var| var.path == moved.path)?.range_span
    }

    /// `dz/dt = ... - sigma0*|v|/g * z`: the term of an equation that contains its own state, if there is one.
    fn slope(&self, id: VarId) -> Option<String> {
        let system = self.system;
        let var = system.var(id);
        let Definition::Continuous { rate, path: None, .. } = var.definition else { return None };
        let mut terms: Vec<(bool, ExprId)> = Vec::new();
        let mut stack = vec![(true, rate)];
        while let Some((plus, term)) = stack.pop() {
            match system.node(term) {
                Node::Binary(BinaryOp::Add, a, b) => stack.extend([(plus, *b), (plus, *a)]),
                Node::Binary(BinaryOp::Subtract, a, b) => stack.extend([(!plus, *b), (plus, *a)]),
                Node::Negate(a) => stack.push((!plus, *a)),
                _ => terms.push((plus, term)),
            }
        }
        let holds = |term: &(bool, ExprId)| match system.node(term.1) {
            Node::Binary(BinaryOp::Multiply, coefficient, z) => {
                matches!(system.node(*z), Node::Var(at) if *at == id).then_some((term.0, *coefficient))
            }
            _ => None,
        };
        let (plus, coefficient) = terms.iter().find_map(holds)?;
        let sign = match (terms.len() > 1, plus) {
            (true, true) => "... + ",
            (true, false) => "... - ",
            (false, true) => "",
            (false, false) => "-",
        };
        let coefficient = self.tight(coefficient, 0)?;
        (coefficient.len() <= 40).then(|| format!("d{0}/dt = {sign}{coefficient} * {0}", var.name))
    }

    /// A product of names and numbers without blanks, with |x| for `abs(x)`; `None` for any other expression.
    fn tight(&self, id: ExprId, depth: u32) -> Option<String> {
        let system = self.system;
        if depth > 8 {
            return None;
        }
        Some(match system.node(id) {
            Node::Var(var) => system.var(*var).name.clone(),
            Node::Fits { value, .. } => self.tight(*value, depth)?,
            Node::Number { value, dimension, .. } if dimension.is_none_or(|d| d.is_none()) => two(*value),
            Node::Call(Builtin::Abs, args) => format!("|{}|", self.tight(args[0], depth + 1)?),
            Node::Binary(BinaryOp::Multiply, a, b) => {
                format!("{}*{}", self.tight(*a, depth + 1)?, self.tight(*b, depth + 1)?)
            }
            Node::Binary(BinaryOp::Divide, a, b) if !matches!(system.node(*b), Node::Binary(..)) => {
                format!("{}/{}", self.tight(*a, depth + 1)?, self.tight(*b, depth + 1)?)
            }
            _ => return None,
        })
    }
}

/// The span of `rotary LuGre(…)`, from the span of the name in it.
fn whole_instance(files: &Files, name: Span) -> Span {
    let text = &files.get(name.file).text;
    let before = text[..name.start as usize].trim_end();
    let start = match before.strip_suffix("rotary") {
        Some(rest) if !rest.ends_with(|c: char| c.is_ascii_alphanumeric() || c == '_') => rest.len(),
        _ => name.start as usize,
    };
    let mut depth = 0;
    for (at, c) in text[name.end as usize..].char_indices() {
        match c {
            '(' => depth += 1,
            ')' if depth == 1 => return Span::new(name.file, start, name.end as usize + at + 1),
            ')' => depth -= 1,
            c if depth == 0 && !c.is_whitespace() => break,
            '\n' => break, // A label spans one line.
            _ => {}
        }
    }
    Span::new(name.file, start, name.end as usize)
}

/// A value in the unit of a quantity, with a suitable prefix if it has none of its own.
fn amount(value: f64, unit: &Unit) -> String {
    let unit = if unit.scale == 1.0 { &prefixed(&unit.text, value.abs()).0 } else { unit };
    quantity(value, unit, 2)
}

/// A number with two digits.
fn two(x: f64) -> String {
    significant(x, 2)
}

/// The largest stable step as diagnostics, explanations and predictions name it: `any` for all that are examined.
pub fn stable_up_to(largest: f64) -> String {
    match largest {
        0.0 => "less than 10 ns".into(),
        largest if largest >= LONGEST => "any".into(),
        largest => duration(largest, 2),
    }
}

/// The greatest round time (1, 2 or 5 times a power of ten) that is not above t.
fn below(t: f64) -> String {
    let round = (-9..=0).rev().flat_map(|power| [5.0, 2.0, 1.0].map(|digit| digit * ten_to(power)));
    let mut round = round;
    duration(round.find(|x| *x <= t).unwrap_or(1e-9), 2)
}
