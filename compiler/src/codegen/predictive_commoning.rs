//! Predictive commoning: a value that one iteration computes from its results, and that the next iteration would compute
//! again from its arguments, is computed once and carried from one iteration to the next.
//!
//! In: a loop in the shape of `form_loop`. Out: the same loop with further carried values. A step ends with the outputs
//! and guards of the new states and begins with the derivatives of the old ones; in a loop these are the same states, so
//! an output such as a friction force, with its exponential, costs once a step what both need.
//!
//! Source: O'Brien, *Predictive commoning: a method of optimizing loops containing references to consecutive array
//! elements*, IBM Interdivisional Technical Liaison, 1990; states take the place of array elements.

use crate::codegen::form_loop::MAX_IN_REGISTERS;
use crate::ir::cfg::{BlockId, Cfg, Inst, Terminator};
use crate::ir::hash::HashMap;
use crate::ir::value_map::ValueSet;
use crate::ir::{Func, Op, Type, Value};
use std::collections::BTreeSet;

/// Minimum effort per iteration that carrying `count` values must save: each takes a register.
fn least_effort(count: usize) -> u32 {
    4 + 2 * count as u32
}

/// Carries values from one iteration of the loop to the next, where that pays.
pub fn predictive_commoning(cfg: &mut Cfg) {
    let order = cfg.order(BlockId(0));
    let Some(head) = cfg.head(&order) else { return };
    let repeats = |block: &&BlockId| matches!(cfg.blocks[block.index()].end, Terminator::Repeat { .. });
    let (Some(preheader), Some(latch)) = (cfg.preheader(head, &order), order.iter().find(repeats).copied()) else {
        return;
    };
    let Terminator::Repeat { again, .. } = &cfg.blocks[latch.index()].end else { unreachable!("it repeats") };
    let handed: HashMap<Value, Value> =
        cfg.blocks[head.index()].params.iter().copied().zip(again.args.clone()).collect();
    let next = next_values(cfg, head, &handed);
    if next.is_empty() {
        return;
    }
    let candidates = ValueSet::of(cfg.ops.len(), next.keys().copied());

    let mut roots: Vec<Value> = Vec::new();
    for block in order.iter().filter(|block| **block != preheader) {
        let block = &cfg.blocks[block.index()];
        block.end.each_value(&mut |value| roots.push(value));
        let effects = block.insts.iter().filter(|inst| !matches!(inst, Inst::Compute(_) | Inst::Reload(..)));
        effects.for_each(|inst| inst.each_value(&mut |value| roots.push(value)));
    }
    let (computed, none) = (computed(cfg, head), ValueSet::new(cfg.ops.len()));
    let plain = needed(cfg, roots.clone(), &none);
    // What is carried needs its next value, which may in turn read a candidate.
    let mut carried: BTreeSet<Value> = BTreeSet::new();
    let live = loop {
        let next = carried.iter().map(|value| next[value]);
        let live = needed(cfg, roots.iter().copied().chain(next).collect(), &candidates);
        let found: BTreeSet<Value> = candidates.keys().iter().copied().filter(|value| live.contains(*value)).collect();
        if found.len() == carried.len() {
            break live;
        }
        carried = found;
    };
    let effort = |values: &ValueSet, carried: &BTreeSet<Value>| -> u32 {
        let values = values.keys().iter().filter(|value| computed.contains(**value) && !carried.contains(value));
        values.map(|value| cfg.op(*value).effort()).sum()
    };
    let saved = effort(&plain, &BTreeSet::new()).saturating_sub(effort(&live, &carried));
    let fits = handed.len() + carried.len() <= MAX_IN_REGISTERS;
    if carried.is_empty() || !fits || saved < least_effort(carried.len()) {
        return;
    }

    // The preheader computes the first ones.
    let first = needed(cfg, carried.iter().copied().collect(), &none);
    let there = self::computed(cfg, preheader);
    let new = first.keys().iter().copied().filter(|value| !cfg.is_free(*value) && !there.contains(*value));
    let mut new: Vec<Value> = new.collect();
    new.sort_unstable();
    let block = &mut cfg.blocks[preheader.index()];
    block.insts.extend(new.into_iter().map(Inst::Compute));
    let Terminator::Jump(target) = &mut block.end else { unreachable!("it goes to the loop") };
    target.args.extend(&carried);
    let block = &mut cfg.blocks[head.index()];
    block.params.extend(&carried);
    block.insts.retain(|inst| match inst {
        Inst::Compute(value) => live.contains(*value) && !carried.contains(value),
        _ => true,
    });
    let Terminator::Repeat { again, .. } = &mut cfg.blocks[latch.index()].end else { unreachable!("it repeats") };
    again.args.extend(carried.iter().map(|value| next[value]));
}

/// The values that a block computes.
fn computed(cfg: &Cfg, block: BlockId) -> ValueSet {
    let of = |inst: &Inst| if let Inst::Compute(value) = inst { Some(*value) } else { None };
    ValueSet::of(cfg.ops.len(), cfg.blocks[block.index()].insts.iter().filter_map(of))
}

/// All values that some values need, themselves included; what `given` values need is left out.
fn needed(cfg: &Cfg, values: Vec<Value>, given: &ValueSet) -> ValueSet {
    let mut all = ValueSet::new(cfg.ops.len());
    let mut open = values;
    while let Some(value) = open.pop() {
        if all.insert(value, ()) && !given.contains(value) {
            cfg.op(value).each_operand(|operand| open.push(operand));
        }
    }
    all
}

/// For values that the head of the loop computes, the value in this iteration that equals them in the next one, if every
/// iteration computes it. `handed`: for each parameter of the head, the value that becomes it.
fn next_values(cfg: &Cfg, head: BlockId, handed: &HashMap<Value, Value>) -> HashMap<Value, Value> {
    let block = &cfg.blocks[head.index()];
    let computed = computed(cfg, head);
    // The test that ends the loop and the values that are handed on are computed in every iteration.
    let tested = match &block.end {
        Terminator::Branch { when, .. } => Some(Func::failure_of(&cfg.ops, *when).map_or(*when, |(when, ..)| when)),
        _ => None,
    };
    let written = block.insts.iter().filter_map(|inst| if let Inst::Write(write) = inst { Some(write) } else { None });
    let written = written.flat_map(|write| [write.index, write.value]);
    let always = handed.values().copied().chain(tested).chain(written).collect();
    let always = needed(cfg, always, &ValueSet::new(cfg.ops.len()));
    let mut known: HashMap<Op, Value> = HashMap::default();
    for value in (0..cfg.ops.len() as u32).map(Value).filter(|value| computed.contains(*value)) {
        known.entry(cfg.op(value).ordered()).or_insert(value);
    }
    let types = cfg.types();
    let mut is_variant = vec![false; cfg.ops.len()];
    let mut next: Vec<Option<Value>> = vec![None; cfg.ops.len()];
    let reloaded =
        block.insts.iter().filter_map(|inst| if let Inst::Reload(value, _) = inst { Some(*value) } else { None });
    let reloaded = ValueSet::of(cfg.ops.len(), reloaded);
    let mut found = HashMap::default();
    for (at, op) in cfg.ops.iter().enumerate() {
        let value = Value(at as u32);
        if let Some(becomes) = handed.get(&value) {
            (is_variant[at], next[at]) = (true, Some(*becomes));
            continue;
        }
        is_variant[at] = matches!(op, Op::Ring { .. }) || reloaded.contains(value);
        let mut whole = !is_variant[at];
        op.each_operand(|operand| is_variant[at] |= is_variant[operand.index()]);
        let moved = op.map(|operand| match (is_variant[operand.index()], next[operand.index()]) {
            (true, Some(next)) => next,
            (true, None) => {
                whole = false;
                operand
            }
            (false, _) => operand,
        });
        if is_variant[at] && whole {
            next[at] = known.get(&moved.ordered()).copied().filter(|next| always.contains(*next));
            let is_cheap = op.effort() == 0 || matches!(op, Op::Neg(_) | Op::Abs(_) | Op::ToBits(_));
            // A comparison costs less than a register.
            if let Some(next) = next[at]
                && !is_cheap
                && types[at] != Type::Bool
                && computed.contains(value)
            {
                found.insert(value, next);
            }
        }
    }
    found
}
