//! A step in two parts: what depends on nothing but time, and the rest.
//!
//! In: a sound, expanded step. Out: its operations, each as it was, in three functions that together give the same bits:
//!
//! ```text
//! once      what no step changes                         from parameters, inputs, the step
//! instants  what depends on these and on time alone      as the lanes of many instants
//! rest      the step, reading what it needs of instants
//! ```

use crate::ir::{Func, Op, Type, Value, verify};
use abi::{Layout, Slot};
use std::collections::HashSet;

/// The parts of a step.
pub struct Distribution {
    /// On blocks of `layout`: parameters → states. None if there is nothing to compute once.
    pub once: Option<Func>,
    /// On blocks of `layout`: time, count, parameters, states → outputs.
    pub instants: Func,
    /// The step on the model's block, behind whose slots it reads the outputs of `instants`.
    pub rest: Func,
    /// What the first two work on.
    pub layout: Layout,
    /// The slots of the model that are their parameters.
    pub loads: Vec<Slot>,
}

/// What an operation depends on.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum On {
    /// Nothing that a step changes.
    Nothing,
    /// Time or the count of steps.
    Time,
    /// A state, or whatever else a step hands on.
    State,
}

/// Effort that going ahead must spare in a step: some for each batch of instants, some for each number handed over, which
/// is stored and loaded.
fn least_effort(handed: usize) -> u32 {
    24 + 4 * handed as u32
}

/// The parts of a step on blocks of `size` slots, if what depends on time alone is worth it.
pub fn split(func: &Func, size: usize) -> Option<Distribution> {
    if !keeps_time(func) {
        return None;
    }
    let types = verify::types(func).expect("the function is sound");
    let on = dependences(func);
    let handed = handed(func, &on, &types);
    let marked = |mut marks: Vec<bool>, through: &dyn Fn(usize) -> bool| {
        for i in (0..func.ops.len()).rev() {
            if marks[i] && through(i) {
                func.ops[i].each_operand(|operand| marks[operand.index()] = true);
            }
        }
        marks
    };
    let marks = |values: &[Value]| {
        let mut marks = vec![false; func.ops.len()];
        values.iter().for_each(|value| marks[value.index()] = true);
        marks
    };
    // A truth is not kept in a number: what depends on it computes it again.
    let kept_once = |i: usize| {
        let leaf = matches!(func.ops[i], Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_));
        on[i] == On::Nothing && types[i] != Type::Bool && !leaf
    };
    let in_instants = marked(marks(&handed), &|i| !kept_once(i));
    let ops = |marks: &[bool]| (0..func.ops.len()).filter(|i| marks[*i]).map(|i| Value(i as u32)).collect::<Vec<_>>();
    let spared: u32 =
        ops(&in_instants).into_iter().filter(|at| on[at.index()] == On::Time).map(|at| func.op(at).effort()).sum();
    if handed.is_empty() || spared < least_effort(handed.len()) {
        return None;
    }
    let once: Vec<Value> = ops(&in_instants).into_iter().filter(|value| kept_once(value.index())).collect();
    let in_once = marked(marks(&once), &|_| true);

    let mut loads: Vec<Slot> = Vec::new();
    for value in ops(&in_instants).into_iter().chain(ops(&in_once)) {
        match func.op(value) {
            Op::Load(slot) if on[value.index()] == On::Nothing && !loads.contains(&slot) => loads.push(slot),
            _ => {}
        }
    }
    let layout = Layout::new([loads.len() as u32, 0, once.len() as u32, 0, 0, handed.len() as u32, 0, 0, 0, 0]);
    let own_slot = |slot: Slot| match loads.iter().position(|known| *known == slot) {
        Some(k) => layout.params.slot(k),
        None => slot,
    };
    let mut first = Part::new("once", func);
    for value in ops(&in_once) {
        first.copy(value, &own_slot);
    }
    once.iter().enumerate().for_each(|(k, value)| first.store(layout.states.slot(k), *value, &types));

    let mut instants = Part::new("instants", func);
    for value in ops(&in_instants) {
        match once.iter().position(|known| *known == value) {
            Some(k) => instants.load(layout.states.slot(k), value, &types),
            None => instants.copy(value, &own_slot),
        }
    }
    handed.iter().enumerate().for_each(|(k, value)| instants.store(layout.outputs.slot(k), *value, &types));

    let mut rest = Part::new(&func.name, func);
    for value in ops(&vec![true; func.ops.len()]) {
        match handed.iter().position(|known| *known == value) {
            Some(k) => rest.load(Slot((size + k) as u32), value, &types),
            None => rest.copy(value, &|slot| slot),
        }
    }
    Some(Distribution {
        once: (!once.is_empty()).then(|| first.finish()),
        instants: instants.finish(),
        rest: rest.finish_as(func),
        layout,
        loads,
    })
}

/// Whether a step adds 1 to its count, and time is then the count times the step where it is read: as every fixed step does.
fn keeps_time(func: &Func) -> bool {
    let stored = |slot: Slot| func.stores.iter().find(|(known, _)| *known == slot).map(|(_, value)| *value);
    let loads = |value: Value, slot: Slot| func.op(value) == Op::Load(slot);
    let (Some(count), None) = (stored(Slot::COUNT), stored(Slot::STEP)) else { return false };
    let either = |a: Value, b: Value, holds: &dyn Fn(Value, Value) -> bool| holds(a, b) || holds(b, a);
    let counts = |a: Value, b: Value| loads(a, Slot::COUNT) && func.op(b) == Op::Real(1f64.to_bits());
    let of_count = |a: Value, b: Value| a == count && loads(b, Slot::STEP);
    matches!(func.op(count), Op::Add(a, b) if either(a, b, &counts))
        && match stored(Slot::TIME) {
            Some(time) => matches!(func.op(time), Op::Mul(a, b) if either(a, b, &of_count)),
            None => !func.loads().contains(&Slot::TIME),
        }
}

/// What each operation depends on.
fn dependences(func: &Func) -> Vec<On> {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let mut on: Vec<On> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut most = match op {
            Op::Load(slot) if [Slot::TIME, Slot::COUNT].contains(slot) => On::Time,
            Op::Load(slot) if stored.contains(slot) => On::State,
            Op::Ring { .. } => On::State,
            _ => On::Nothing,
        };
        op.each_operand(|operand| most = most.max(on[operand.index()]));
        on.push(most);
    }
    on
}

/// What depends on time alone and every step needs beside or for its states. What only the last step leaves behind is
/// not worth having at each instant.
fn handed(func: &Func, on: &[On], types: &[Type]) -> Vec<Value> {
    let loaded: HashSet<Slot> = func.loads().into_iter().collect();
    let carried = |slot: &Slot| loaded.contains(slot) && ![Slot::TIME, Slot::COUNT].contains(slot);
    let states = func.stores.iter().filter(|(slot, _)| carried(slot)).map(|(_, value)| *value);
    let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
    let watched = func.status.map(|status| match func.op(status) {
        Op::Select(when, _, zero) if func.op(zero) == Op::Int(0) => when,
        _ => status,
    });
    let mut needed = vec![false; func.ops.len()];
    states.chain(written).chain(watched).for_each(|value| needed[value.index()] = true);
    let mut handed = Vec::new();
    for i in (0..func.ops.len()).rev() {
        let op = func.ops[i];
        if !needed[i] || on[i] == On::Nothing {
            continue;
        }
        // A truth is not kept in a number, and what is as quickly computed as loaded stays where it is.
        let mut quick = op.effort() <= 1;
        op.each_operand(|operand| {
            let far = on[operand.index()] == On::Time && !matches!(func.op(operand), Op::Load(_));
            quick &= !far;
        });
        if on[i] == On::State || types[i] == Type::Bool || quick {
            op.each_operand(|operand| needed[operand.index()] = true);
        } else {
            handed.push(Value(i as u32));
        }
    }
    handed.reverse();
    handed
}

/// A part of a function under way.
struct Part<'a> {
    of: &'a Func,
    func: Func,
    /// For each value of the function what it is here.
    values: Vec<Value>,
}

impl<'a> Part<'a> {
    fn new(name: &str, of: &'a Func) -> Part<'a> {
        let func = Func { name: name.into(), ..Func::default() };
        Part { of, func, values: vec![Value(u32::MAX); of.ops.len()] }
    }

    fn push(&mut self, op: Op) -> Value {
        self.func.ops.push(op);
        Value(self.func.ops.len() as u32 - 1)
    }

    /// The same operation on the same operands.
    fn copy(&mut self, value: Value, slot: &dyn Fn(Slot) -> Slot) {
        let op = match self.of.op(value) {
            Op::Load(from) => Op::Load(slot(from)),
            op => op.map(|operand| self.values[operand.index()]),
        };
        self.values[value.index()] = self.push(op);
    }

    /// A value that another part has stored.
    fn load(&mut self, slot: Slot, value: Value, types: &[Type]) {
        let mut here = self.push(Op::Load(slot));
        if types[value.index()] == Type::Int {
            here = self.push(Op::ToBits(here));
        }
        self.values[value.index()] = here;
    }

    fn store(&mut self, slot: Slot, value: Value, types: &[Type]) {
        let mut here = self.values[value.index()];
        if types[value.index()] == Type::Int {
            here = self.push(Op::FromBits(here));
        }
        self.func.stores.push((slot, here));
    }

    fn finish(self) -> Func {
        crate::ir::build::prune(&self.func)
    }

    /// With the results of the whole function.
    fn finish_as(mut self, func: &Func) -> Func {
        let at = |value: Value| self.values[value.index()];
        self.func.stores = func.stores.iter().map(|(slot, value)| (*slot, at(*value))).collect();
        self.func.writes = func.writes.iter().map(|write| write.map(at)).collect();
        self.func.status = func.status.map(at);
        self.finish()
    }
}
