//! Partition of a system: prunes it to what some of its quantities need (a backward slice), and inverts affine wires.
//!
//! In: a flat system, and quantities and expressions to keep. Out: a system with the same indices. Knows nothing of
//! drives.

use crate::frontend::system::*;
use abi::unit::{Angle, Dimension};
use grammar::ast::BinaryOp;
use grammar::span::Span;

/// Liveness of quantities, expressions, automata, blocks and crossings.
struct Live<'a> {
    system: &'a System,
    vars: Vec<bool>,
    nodes: Vec<bool>,
    automata: Vec<bool>,
    blocks: Vec<bool>,
    crossings: Vec<bool>,
    stack: Vec<ExprId>,
}

impl Live<'_> {
    fn var(&mut self, id: VarId) {
        if std::mem::replace(&mut self.vars[id.0 as usize], true) {
            return;
        }
        let var = self.system.var(id);
        match &var.definition {
            Definition::Missing | Definition::Free => {}
            Definition::Value(value, _) => self.stack.push(*value),
            Definition::Continuous { initial, rate, path, .. } => {
                self.stack.extend([*initial, *rate]);
                if let Some((value, along)) = path {
                    self.stack.push(*value);
                    self.var(*along);
                }
            }
            Definition::Sampled { initial, next, block } => {
                self.stack.extend([*initial, *next]);
                self.block(*block);
            }
            Definition::Held { value, block, .. } => {
                self.stack.push(*value);
                self.block(*block);
            }
        }
        self.stack.extend([var.range.low, var.range.high].into_iter().flatten().map(|(bound, _)| bound));
    }

    fn block(&mut self, id: BlockId) {
        if !std::mem::replace(&mut self.blocks[id.0 as usize], true) {
            self.stack.push(self.system.blocks[id.0 as usize].period);
        }
    }

    fn automaton(&mut self, id: usize) {
        if std::mem::replace(&mut self.automata[id], true) {
            return;
        }
        let transitions = self.system.automata[id].regimes.iter().flat_map(|regime| &regime.transitions);
        for transition in transitions {
            self.stack.push(transition.condition);
            self.resets(&transition.resets);
        }
    }

    fn resets(&mut self, resets: &[(VarId, ExprId)]) {
        for (var, value) in resets {
            self.var(*var);
            self.stack.push(*value);
        }
    }

    fn drain(&mut self) {
        while let Some(id) = self.stack.pop() {
            if std::mem::replace(&mut self.nodes[id.0 as usize], true) {
                continue;
            }
            let node = self.system.node(id);
            self.stack.extend(node.operands());
            match node {
                Node::Var(var) | Node::Rate(var) | Node::PathRate(var) => self.var(*var),
                Node::InRegime(automaton, _) => self.automaton(automaton.0 as usize),
                Node::Crossing(crossing) => {
                    self.crossings[*crossing as usize] = true;
                    self.stack.push(self.system.crossings[*crossing as usize].difference);
                }
                _ => {}
            }
        }
    }
}

/// Prunes the system to what these quantities and expressions need. Indices of quantities and expressions stay the
/// same; removed quantities have no definition.
pub fn pruned(system: &System, vars: impl Iterator<Item = VarId>, exprs: &[ExprId]) -> System {
    let mut live = Live {
        system,
        vars: vec![false; system.vars.len()],
        nodes: vec![false; system.nodes.len()],
        automata: vec![false; system.automata.len()],
        blocks: vec![false; system.blocks.len()],
        crossings: vec![false; system.crossings.len()],
        stack: exprs.to_vec(),
    };
    for var in vars {
        live.var(var);
    }
    live.drain();
    // Events and automata that reset a live state are live too, and so is what they need, up to a fixed point.
    let mut events = vec![false; system.events.len()];
    loop {
        let before = (live.vars.clone(), live.automata.clone());
        for (k, event) in system.events.iter().enumerate() {
            if event.resets.iter().any(|(var, _)| live.vars[var.0 as usize]) {
                events[k] = true;
                live.stack.push(event.condition);
                live.resets(&event.resets);
            }
        }
        for (k, automaton) in system.automata.iter().enumerate() {
            let mut resets = automaton.regimes.iter().flat_map(|r| &r.transitions).flat_map(|t| &t.resets);
            if resets.any(|(var, _)| live.vars[var.0 as usize]) {
                live.automaton(k);
            }
        }
        live.drain();
        if before == (live.vars.clone(), live.automata.clone()) {
            break;
        }
    }
    let numbers = |live: &[bool]| -> Vec<u32> {
        let mut next = 0;
        live.iter()
            .map(|live| {
                let at = next;
                next += u32::from(*live);
                at
            })
            .collect()
    };
    let (automata, blocks, crossings) = (numbers(&live.automata), numbers(&live.blocks), numbers(&live.crossings));
    let kept = |live: &[bool], k: usize| live[k];
    let mut out = system.clone();
    for (k, node) in out.nodes.iter_mut().enumerate() {
        match node {
            _ if !live.nodes[k] => *node = Node::Error,
            Node::InRegime(automaton, _) => *automaton = AutomatonId(automata[automaton.0 as usize]),
            Node::Crossing(crossing) => *crossing = crossings[*crossing as usize],
            _ => {}
        }
    }
    for (k, var) in out.vars.iter_mut().enumerate() {
        match &mut var.definition {
            _ if !live.vars[k] => {
                var.definition = Definition::Missing;
                var.range = VarRange::default();
            }
            Definition::Sampled { block, .. } | Definition::Held { block, .. } => {
                *block = BlockId(blocks[block.0 as usize]);
            }
            _ => {}
        }
    }
    let mut k = 0..;
    out.automata.retain(|_| kept(&live.automata, k.next().expect("endless")));
    let mut k = 0..;
    out.blocks.retain(|_| kept(&live.blocks, k.next().expect("endless")));
    let mut k = 0..;
    out.crossings.retain(|_| kept(&live.crossings, k.next().expect("endless")));
    let mut k = 0..;
    out.events.retain(|_| kept(&events, k.next().expect("endless")));
    out.requires.clear();
    let whole = |expr: &ExprId| out.nodes[expr.0 as usize] != Node::Error;
    out.storages.retain(|(_, energy)| whole(energy));
    out.corners.retain(whole);
    out
}

/// Whether the quantity still has a definition.
pub fn lives(system: &System, id: VarId) -> bool {
    !matches!(system.var(id).definition, Definition::Missing)
}

/// Quantities that an expression mentions, in order, without repetition.
pub fn mentioned(system: &System, id: ExprId) -> Vec<VarId> {
    let mut out = Vec::new();
    let mut stack = vec![id];
    while let Some(id) = stack.pop() {
        if let Node::Var(var) | Node::Rate(var) | Node::PathRate(var) = system.node(id)
            && !out.contains(var)
        {
            out.push(*var);
        }
        let operands: Vec<ExprId> = system.node(id).operands().collect();
        stack.extend(operands.into_iter().rev());
    }
    out
}

/// An affine form: Σ coefficient · quantity + rest.
pub struct Affine {
    /// Quantities without repetition, each with its coefficient.
    pub terms: Vec<(VarId, ExprId)>,
    /// The constant term.
    pub rest: ExprId,
}

/// Writes an expression as an affine form in the quantities for which `unknown` is true; `None` if it is not affine.
pub fn affine(system: &mut System, id: ExprId, unknown: &dyn Fn(VarId) -> bool) -> Option<Affine> {
    let span = system.span(id);
    if !mentioned(system, id).into_iter().any(unknown) {
        return Some(Affine { terms: Vec::new(), rest: id });
    }
    match system.node(id).clone() {
        Node::Var(var) => {
            let rest = system.push(nothing(), span);
            let one = system.push(one(), span);
            Some(Affine { terms: vec![(var, one)], rest })
        }
        Node::Fits { value, .. } => affine(system, value, unknown),
        Node::Negate(a) => {
            let form = affine(system, a, unknown)?;
            Some(scaled(system, form, &|system, part| system.push(Node::Negate(part), span)))
        }
        Node::Binary(op @ (BinaryOp::Add | BinaryOp::Subtract), a, b) => {
            let (a, b) = (affine(system, a, unknown)?, affine(system, b, unknown)?);
            let rest = system.push(Node::Binary(op, a.rest, b.rest), span);
            let mut terms = a.terms;
            for (var, coefficient) in b.terms {
                match terms.iter_mut().find(|(known, _)| *known == var) {
                    Some((_, sum)) => *sum = system.push(Node::Binary(op, *sum, coefficient), span),
                    None if op == BinaryOp::Add => terms.push((var, coefficient)),
                    None => terms.push((var, system.push(Node::Negate(coefficient), span))),
                }
            }
            Some(Affine { terms, rest })
        }
        Node::Binary(BinaryOp::Multiply, a, b) => {
            let (fa, fb) = (affine(system, a, unknown)?, affine(system, b, unknown)?);
            let (form, factor) = match (fa.terms.is_empty(), fb.terms.is_empty()) {
                (true, _) => (fb, a),
                (_, true) => (fa, b),
                _ => return None,
            };
            let times = |system: &mut System, part| system.push(Node::Binary(BinaryOp::Multiply, part, factor), span);
            Some(scaled(system, form, &times))
        }
        Node::Binary(BinaryOp::Divide, a, b) => {
            let (form, divisor) = (affine(system, a, unknown)?, affine(system, b, unknown)?);
            if !divisor.terms.is_empty() {
                return None;
            }
            let over = |system: &mut System, part| system.push(Node::Binary(BinaryOp::Divide, part, b), span);
            Some(scaled(system, form, &over))
        }
        _ => None,
    }
}

fn scaled(system: &mut System, form: Affine, by: &dyn Fn(&mut System, ExprId) -> ExprId) -> Affine {
    let rest = by(system, form.rest);
    let terms = form.terms.into_iter().map(|(var, coefficient)| (var, by(system, coefficient))).collect();
    Affine { terms, rest }
}

/// (value − rest) / Σ coefficients: the common value of the form's quantities, for which the form equals `value`.
pub fn solved(system: &mut System, form: &Affine, value: ExprId, span: Span) -> Option<ExprId> {
    let mut coefficients = form.terms.iter().map(|(_, coefficient)| *coefficient);
    let first = coefficients.next()?;
    let sum = coefficients.fold(first, |sum, c| system.push(Node::Binary(BinaryOp::Add, sum, c), span));
    let difference = system.push(Node::Binary(BinaryOp::Subtract, value, form.rest), span);
    Some(system.push(Node::Binary(BinaryOp::Divide, difference, sum), span))
}

/// 0, which matches every unit.
pub fn nothing() -> Node {
    Node::Number { value: 0.0, dimension: None, angle: Angle::Silent }
}

/// The dimensionless number 1.
pub fn one() -> Node {
    Node::Number { value: 1.0, dimension: Some(Dimension::NONE), angle: Angle::Silent }
}
