//! Loop distribution: one loop over steps becomes two, a vectorised leading loop for everything that depends on time
//! alone, or on inputs from rows, and a remaining loop for the states.
//!
//! In: a step in one block. Out: if it pays, the remaining step, which loads the outputs of the leading loop from slots after
//! the block, and the leading loop, whose lanes are successive instants of time. The leading loop is not made of blocks of
//! the graph, because it works on a block of its own and the code for lanes reads straight lines. Each operation is
//! unchanged, so the bits are the same:
//!
//! ```text
//! invariants   operations that no step changes                     from parameters, inputs, step length
//! instants     operations on these, on time and rows of inputs     lanes are successive instants
//! remaining    the step, which loads the outputs of instants
//! ```
//! Only for many steps per call and code in memory: images run in real time, one step per call.
//!
//! Source: Kennedy, Allen, *Optimizing Compilers for Modern Architectures*, 2001, ch. 5.

use crate::ir::cfg::{BlockId, Cfg, Leading, Rows};
use crate::ir::hash::HashSet;
use crate::ir::variance::{Variance, with_rows};
use crate::ir::{Func, Op, Type, Value, verify};
use abi::{Layout, Slot};

/// Distributes a step that works on blocks of this layout, if that pays.
pub fn loop_distribution(cfg: &mut Cfg, layout: &Layout) {
    let Some(func) = cfg.straight_line(BlockId(0)) else { return };
    if let Some((leading, remaining)) = split(&func, layout.size(), cfg.rows.as_ref()) {
        let rows = cfg.rows.take();
        *cfg = Cfg { leading: Some(Box::new(leading)), rows, ..Cfg::straight(&remaining, cfg.called) };
    }
}

/// Minimum effort per step that distribution must save: a fixed part for each batch of instants, and a part for each of
/// the `passed` values, which is stored and loaded.
fn least_effort(passed: usize) -> u32 {
    24 + 4 * passed as u32
}

/// Divides a step that works on blocks of `size` slots; none if distribution does not pay.
fn split(func: &Func, size: usize, rows: Option<&Rows>) -> Option<(Leading, Func)> {
    if !advances_time(func) {
        return None;
    }
    let types = verify::types(func).expect("the function is sound");
    let in_rows = rows.map_or(&[][..], |rows| &rows.inputs);
    let on = with_rows(func, in_rows);
    let passed = passed(func, &on, &types, rows);
    let closure = |mut marks: Vec<bool>, through: &dyn Fn(usize) -> bool| {
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
    // Booleans are not stored: operations that read them recompute them.
    let is_invariant = |i: usize| {
        let leaf = matches!(func.ops[i], Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_));
        on[i].is_invariant() && types[i] != Type::Bool && !leaf
    };
    let in_leading = closure(marks(&passed), &|i| !is_invariant(i));
    let ops = |marks: &[bool]| (0..func.ops.len()).filter(|i| marks[*i]).map(|i| Value(i as u32)).collect::<Vec<_>>();
    let saved: u32 =
        ops(&in_leading).into_iter().filter(|at| on[at.index()] == Variance::Time).map(|at| func.op(at).effort()).sum();
    if passed.is_empty() || saved < least_effort(passed.len()) {
        return None;
    }
    let invariants: Vec<Value> = ops(&in_leading).into_iter().filter(|value| is_invariant(value.index())).collect();
    let in_invariants = closure(marks(&invariants), &|_| true);

    let mut loads: Vec<Slot> = Vec::new();
    for value in ops(&in_leading).into_iter().chain(ops(&in_invariants)) {
        match func.op(value) {
            Op::Load(slot) if on[value.index()].is_invariant() && !loads.contains(&slot) => loads.push(slot),
            _ => {}
        }
    }
    let is_read = |slot: &Slot| ops(&in_leading).into_iter().any(|value| func.op(value) == Op::Load(*slot));
    let columns: Vec<usize> = (0..in_rows.len()).filter(|column| is_read(&in_rows[*column])).collect();
    let lens = [loads.len(), columns.len(), invariants.len(), 0, 0, passed.len(), 0, 0, 0, 0];
    let layout = Layout::new(lens.map(|len| len as u32));
    let own_slot = |slot: Slot| {
        let column = || columns.iter().position(|column| in_rows[*column] == slot);
        match loads.iter().position(|known| *known == slot) {
            Some(k) => layout.params.slot(k),
            None => column().map_or(slot, |k| layout.inputs.slot(k)),
        }
    };
    let mut first = LoopPart::new("once", func);
    for value in ops(&in_invariants) {
        first.copy(value, &own_slot);
    }
    invariants.iter().enumerate().for_each(|(k, value)| first.store(layout.states.slot(k), *value, &types));

    let mut leading = LoopPart::new("instants", func);
    for value in ops(&in_leading) {
        match invariants.iter().position(|known| *known == value) {
            Some(k) => leading.load(layout.states.slot(k), value, &types),
            None => leading.copy(value, &own_slot),
        }
    }
    passed.iter().enumerate().for_each(|(k, value)| leading.store(layout.outputs.slot(k), *value, &types));

    let mut remaining = LoopPart::new(&func.name, func);
    for value in ops(&vec![true; func.ops.len()]) {
        match passed.iter().position(|known| *known == value) {
            Some(k) => remaining.load(Slot((size + k) as u32), value, &types),
            None => remaining.copy(value, &|slot| slot),
        }
    }
    let invariants = (!invariants.is_empty()).then(|| first.finish());
    let leading = Leading { invariants, instants: leading.finish(), layout, loads, columns, size };
    Some((leading, remaining.finish_as(func)))
}

/// Whether a step adds 1 to its counter, and time, if it is read, is counter × step length, as in every fixed step.
fn advances_time(func: &Func) -> bool {
    let stored = |slot: Slot| func.stores.iter().find(|(known, _)| *known == slot).map(|(_, value)| *value);
    let loads = |value: Value, slot: Slot| func.op(value) == Op::Load(slot);
    let (Some(count), None) = (stored(Slot::COUNT), stored(Slot::STEP)) else { return false };
    let either = |a: Value, b: Value, holds: &dyn Fn(Value, Value) -> bool| holds(a, b) || holds(b, a);
    let is_count_plus_one = |a: Value, b: Value| loads(a, Slot::COUNT) && func.op(b) == Op::Real(1f64.to_bits());
    let is_count_times_step = |a: Value, b: Value| a == count && loads(b, Slot::STEP);
    matches!(func.op(count), Op::Add(a, b) if either(a, b, &is_count_plus_one))
        && match stored(Slot::TIME) {
            Some(time) => matches!(func.op(time), Op::Mul(a, b) if either(a, b, &is_count_times_step)),
            None => !func.loads().contains(&Slot::TIME),
        }
}

/// The values to pass from the leading to the remaining loop: values that depend on time and rows of inputs alone and that
/// each step needs, for states, rings, guards or rows of outputs. Other outputs only matter after the last step, so they
/// are not computed ahead.
fn passed(func: &Func, on: &[Variance], types: &[Type], rows: Option<&Rows>) -> Vec<Value> {
    let loaded: HashSet<Slot> = func.loads().into_iter().collect();
    let carried = |slot: &Slot| loaded.contains(slot) && ![Slot::TIME, Slot::COUNT].contains(slot);
    let states: Vec<Value> = func.stores.iter().filter(|(slot, _)| carried(slot)).map(|(_, value)| *value).collect();
    // Steps that hand nothing to the next one already overlap in the processor, and a step of one instant computes only
    // one arm of a select.
    if states.is_empty() && func.writes.is_empty() && rows.is_none() {
        return Vec::new();
    }
    let in_row = |slot: &Slot| rows.is_some_and(|rows| rows.outputs.contains(slot));
    let recorded = func.stores.iter().filter(|(slot, _)| in_row(slot)).map(|(_, value)| *value);
    let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
    let guard = func.status.map(|status| match func.op(status) {
        Op::Select(when, _, zero) if func.op(zero) == Op::Int(0) => when,
        _ => status,
    });
    let mut needed = vec![false; func.ops.len()];
    states.into_iter().chain(written).chain(guard).chain(recorded).for_each(|value| needed[value.index()] = true);
    let mut passed = Vec::new();
    for i in (0..func.ops.len()).rev() {
        let op = func.ops[i];
        if !needed[i] || on[i].is_invariant() {
            continue;
        }
        // Booleans are not stored, and an operation as cheap as a load is not worth passing.
        let mut is_cheap = op.effort() <= 1;
        op.each_operand(|operand| {
            let is_costly = on[operand.index()] == Variance::Time && !matches!(func.op(operand), Op::Load(_));
            is_cheap &= !is_costly;
        });
        if on[i] > Variance::Time || types[i] == Type::Bool || is_cheap {
            op.each_operand(|operand| needed[operand.index()] = true);
        } else {
            passed.push(Value(i as u32));
        }
    }
    passed.reverse();
    passed
}

/// A part of a function that is being built.
struct LoopPart<'a> {
    of: &'a Func,
    func: Func,
    /// For each value of the function, its value in this part.
    values: Vec<Value>,
}

impl<'a> LoopPart<'a> {
    fn new(name: &str, of: &'a Func) -> LoopPart<'a> {
        let func = Func { name: name.into(), ..Func::default() };
        LoopPart { of, func, values: vec![Value(u32::MAX); of.ops.len()] }
    }

    fn push(&mut self, op: Op) -> Value {
        self.func.ops.push(op);
        Value(self.func.ops.len() as u32 - 1)
    }

    /// Appends the same operation on the same operands.
    fn copy(&mut self, value: Value, slot: &dyn Fn(Slot) -> Slot) {
        let op = match self.of.op(value) {
            Op::Load(from) => Op::Load(slot(from)),
            op => op.map(|operand| self.values[operand.index()]),
        };
        self.values[value.index()] = self.push(op);
    }

    /// Loads a value that another part has stored.
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

    /// Finishes with the results of the whole function.
    fn finish_as(mut self, func: &Func) -> Func {
        let at = |value: Value| self.values[value.index()];
        self.func.stores = func.stores.iter().map(|(slot, value)| (*slot, at(*value))).collect();
        self.func.writes = func.writes.iter().map(|write| write.map(at)).collect();
        self.func.status = func.status.map(at);
        self.finish()
    }
}
