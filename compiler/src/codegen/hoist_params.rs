//! Hoists expressions of parameters and step length out of the step (loop-invariant code motion across calls).
//!
//! In: a step in one block. Out: the step, and an entry of its own that computes these expressions and stores them after
//! the instance's block, from where the step loads them. Used for callers that make one step per call: they recompute the
//! expressions when a parameter changes. The operations are the same, hence the bits too.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, sec. 9.5.

use crate::ir::build::prune;
use crate::ir::cfg::{BlockId, Cfg, Part};
use crate::ir::variance::{Variance, variance};
use crate::ir::verify::types;
use crate::ir::{Func, Op, Type, Value};
use abi::{Layout, Slot};

/// Hoists what depends on parameters alone; the step works on blocks of this layout.
pub fn hoist_params(cfg: &mut Cfg, layout: &Layout) {
    let Some(func) = cfg.straight_line(BlockId(0)) else { return };
    let (prepare, step) = divide(&func, layout);
    if !prepare.stores.is_empty() {
        *cfg = Cfg::straight(&step, cfg.called);
        cfg.prepare = Some(cfg.import(&prepare, Part::Prologue));
    }
}

/// Divides a step into a function that stores its hoisted values after the block, and the remaining step.
fn divide(func: &Func, layout: &Layout) -> (Func, Func) {
    let types = types(func).expect("the function is sound");
    let variance = variance(func, Some(layout));
    // Neg and Abs cost less than a load; ToBits costs as much as loading the bits.
    let is_free = |op: &Op| op.effort() == 0 || matches!(op, Op::Neg(_) | Op::Abs(_) | Op::ToBits(_));
    let is_hoisted =
        |at: usize| variance[at] == Variance::Parameters && types[at] != Type::Bool && !is_free(&func.ops[at]);
    let all: Vec<usize> = (0..func.ops.len()).filter(|at| is_hoisted(*at)).collect();
    let first = Slot(layout.size() as u32);
    let mut remaining = func.clone();
    all.iter().for_each(|at| remaining.ops[*at] = Op::Load(first));
    // Values that only other hoisted values need are not stored.
    let live = remaining.live();
    let hoisted: Vec<usize> = all.into_iter().filter(|at| live[*at]).collect();
    let name = format!("{}, prepared", func.name);
    let mut prepare = Func { name, ops: func.ops.clone(), ..Func::default() };
    let push = |ops: &mut Vec<Op>, op: Op| {
        ops.push(op);
        Value(ops.len() as u32 - 1)
    };
    let mut ops: Vec<Op> = Vec::with_capacity(func.ops.len() + hoisted.len());
    let mut moved: Vec<Value> = Vec::with_capacity(func.ops.len());
    let mut hoisted = hoisted.into_iter().peekable();
    for (at, op) in func.ops.iter().enumerate() {
        if hoisted.next_if_eq(&at).is_none() {
            let op = op.map(|operand| moved[operand.index()]);
            moved.push(push(&mut ops, op));
            continue;
        }
        let (slot, is_int) = (Slot(first.0 + prepare.stores.len() as u32), types[at] == Type::Int);
        let value = Value(at as u32);
        // An integer is stored as the real with the same bits.
        let number = if is_int { push(&mut prepare.ops, Op::FromBits(value)) } else { value };
        prepare.stores.push((slot, number));
        let number = push(&mut ops, Op::Load(slot));
        moved.push(if is_int { push(&mut ops, Op::ToBits(number)) } else { number });
    }
    let to = |value: Value| moved[value.index()];
    let step = Func {
        name: func.name.clone(),
        ops,
        stores: func.stores.iter().map(|(slot, value)| (*slot, to(*value))).collect(),
        writes: func.writes.iter().map(|write| write.map(to)).collect(),
        status: func.status.map(to),
    };
    (prune(&prepare), prune(&step))
}
