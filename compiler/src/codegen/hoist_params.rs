//! Hoists expressions of parameters and step length out of the step (loop-invariant code motion across calls).
//!
//! In: a step in one block. Out: the step, and an entry of its own that computes these expressions and stores them after
//! the instance's block, from where the step loads them. Used for callers that make one step per call: they recompute the
//! expressions when a parameter changes. The operations are the same, hence the bits too.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, sec. 9.5.

use crate::ir::build::{Build, prune};
use crate::ir::cfg::{BlockId, Cfg, Part};
use crate::ir::hash::HashMap;
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
    let slots: HashMap<usize, Slot> =
        hoisted.iter().enumerate().map(|(k, at)| (*at, Slot(first.0 + k as u32))).collect();
    let (mut prepare, mut stores, mut step) = (Build::of(func), Vec::new(), Build::new(&func.name));
    for at in hoisted {
        let value = Value(at as u32);
        // An integer is stored as the real with the same bits.
        let number = if types[at] == Type::Int { prepare.from_bits(value) } else { value };
        stores.push((slots[&at], number));
    }
    let mut moved: Vec<Value> = Vec::with_capacity(func.ops.len());
    for (at, op) in func.ops.iter().enumerate() {
        let found = slots.get(&at).map(|slot| step.load(*slot));
        moved.push(match found {
            Some(number) if types[at] == Type::Int => step.to_bits(number),
            Some(number) => number,
            None => step.op(op.map(|operand| moved[operand.index()])),
        });
    }
    let name = format!("{}, prepared", func.name);
    let prepare = Func { name, ops: prepare.into_ops(), stores, writes: Vec::new(), status: None };
    (prune(&prepare), step.finish_as(func, &moved))
}
