//! Slopes that are selected among a few values which depend on no state: each gets its own exponential.

use super::Model;
use crate::ir::build::Build;
use crate::ir::hash::HashSet;
use crate::ir::{Op, Value};

/// Largest number of slopes among which a rate may select for each slope to have its own exponential.
const MOST_CHOSEN: usize = 4;

impl<'a> Model<'a> {
    /// Whether a value is selected among at most [`MOST_CHOSEN`] values that do not depend on a state.
    pub(super) fn is_chosen(&self, value: Value) -> bool {
        let (mut open, mut seen, mut given) = (vec![value], HashSet::default(), 0);
        while let Some(value) = open.pop() {
            if !seen.insert(value) {
                continue;
            }
            let op = self.build.borrow().get(value);
            match op {
                _ if self.is_given(value) => given += 1,
                Op::Select(_, yes, no) => open.extend([yes, no]),
                _ => return false,
            }
            if given > MOST_CHOSEN || seen.len() > 3 * MOST_CHOSEN {
                return false;
            }
        }
        true
    }

    /// Moves selects outwards, if only their conditions depend on states: (if c then 1 else 0) · x − y → if c then x −
    /// y else −y. 0 · x and 0/x become 0, as in a derivative.
    pub(super) fn chosen(&self, value: Value, deepest: u32) -> Value {
        let op = self.build.borrow().get(value);
        if deepest == 0 || self.is_given(value) {
            return value;
        }
        let (a, b) = match op {
            Op::Select(condition, yes, no) => {
                let [yes, no] = [yes, no].map(|side| self.chosen(side, deepest - 1));
                return self.choice(condition, yes, no);
            }
            Op::Neg(a) => (a, a),
            Op::Add(a, b) | Op::Sub(a, b) | Op::Mul(a, b) | Op::Div(a, b) => (a, b),
            _ => return value,
        };
        // One operand is a select, and the other does not depend on a state.
        let (choice, other) = if self.is_given(a) { (b, a) } else { (a, b) };
        if choice != other && !self.is_given(other) {
            return value;
        }
        let choices = self.chosen(choice, deepest - 1);
        if !self.is_chosen(choices) {
            return value;
        }
        self.for_each_choice(choices, &|side| {
            let of = |operand: Value| if operand == choice { side } else { operand };
            let mut build = self.build.borrow_mut();
            let zero = |value: Value, build: &Build| build.constant(value) == Some(0.0);
            match op.map(of) {
                Op::Mul(a, b) if zero(a, &build) || zero(b, &build) => build.real(0.0),
                Op::Div(a, _) if zero(a, &build) => build.real(0.0),
                op => build.op(op),
            }
        })
    }

    /// Applies `f` to each value that a nest of selects can return.
    pub(super) fn for_each_choice(&self, value: Value, f: &dyn Fn(Value) -> Value) -> Value {
        let op = self.build.borrow().get(value);
        match op {
            Op::Select(condition, yes, no) if !self.is_given(value) => {
                let [yes, no] = [yes, no].map(|side| self.for_each_choice(side, f));
                self.choice(condition, yes, no)
            }
            _ => f(value),
        }
    }

    /// A select, simplified: if c then a else if d then a else b → if c or d then a else b.
    pub(super) fn choice(&self, condition: Value, yes: Value, no: Value) -> Value {
        let mut build = self.build.borrow_mut();
        match build.get(no) {
            Op::Select(other, same, no) if same == yes => {
                let either = build.or(condition, other);
                build.select(either, yes, no)
            }
            _ => build.select(condition, yes, no),
        }
    }

    /// Whether a value depends on no state.
    pub(super) fn is_given(&self, value: Value) -> bool {
        let states = self.program.description.layout.states;
        let build = self.build.borrow();
        let mut given = self.given.borrow_mut();
        while given.len() < build.len() {
            let op = build.get(Value(given.len() as u32));
            let mut all = !matches!(op, Op::Load(slot) if states.contains(slot));
            op.each_operand(|operand| all &= given[operand.index()]);
            given.push(all);
        }
        given[value.index()]
    }
}
