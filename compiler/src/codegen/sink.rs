//! Sinking: moves cheap operations down to their first use, to shorten live ranges.
//!
//! In: blocks. Out: the same blocks, with their operations in another topological order. An operation is sunk if it
//! depends on loads only and costs no more than an addition; it then occupies no register until its first use. No
//! operation crosses a store. It knows nothing of processors.
//!
//! Compare LLVM's `Sink` pass; Knoop, Rüthing, Steffen, *Partial Dead Code Elimination*, PLDI 1994.

use crate::ir::cfg::{Cfg, Part, Run};
use crate::ir::value_map::ValueMap;
use crate::ir::{Op, Value};

/// Sinks cheap operations in all blocks that are not cold.
pub fn sink(cfg: &mut Cfg) {
    let mut position = ValueMap::new(cfg.ops.len());
    for block in cfg.blocks.iter_mut().filter(|block| block.part != Part::Cold) {
        for run in Run::all(std::mem::take(&mut block.insts)) {
            let sunk = sunk(|value| run.op(&cfg.ops, value), &run.list, &mut position);
            block.insts.extend(sunk.into_iter().map(|value| run.inst(value)));
            block.insts.extend(run.effect);
        }
    }
}

/// The list, with cheap operations sunk to their first use. `position`: a map for the position of each value.
fn sunk(op: impl Fn(Value) -> Op, list: &[Value], position: &mut ValueMap<usize>) -> Vec<Value> {
    position.clear();
    list.iter().enumerate().for_each(|(at, value)| _ = position.insert(*value, at));
    let mut sinkable = vec![false; list.len()];
    for (at, value) in list.iter().enumerate() {
        let mut can_sink = op(*value).effort() <= 1 && !matches!(op(*value), Op::Select(..));
        // An operand outside the list is a constant, or stays available in any case.
        op(*value).each_operand(|operand| can_sink &= position.get(operand).is_none_or(|at| sinkable[at]));
        sinkable[at] = can_sink;
    }
    // Position of the first use of each operation; the end if there is none in the list.
    let mut first_use = vec![list.len(); list.len()];
    for (at, value) in list.iter().enumerate().rev() {
        let here = if sinkable[at] { first_use[at] } else { run_start(&op, list, at) };
        op(*value).each_operand(|operand| {
            if let Some(of) = position.get(operand) {
                first_use[of] = first_use[of].min(here);
            }
        });
    }
    let mut sunk: Vec<Vec<Value>> = vec![Vec::new(); list.len() + 1];
    for (at, value) in list.iter().enumerate().filter(|(at, _)| sinkable[*at]) {
        sunk[first_use[at]].push(*value);
    }
    let stays_at = |at: usize| list.get(at).filter(|_| !sinkable[at]).copied();
    sunk.into_iter().enumerate().flat_map(|(at, before)| before.into_iter().chain(stays_at(at))).collect()
}

/// The start of the run of adjacent selects on the same condition that contains position `at`, or `at` itself. Nothing
/// may be placed inside such a run, which becomes one branch.
fn run_start(op: &impl Fn(Value) -> Op, list: &[Value], at: usize) -> usize {
    let condition = |at: usize| if let Op::Select(when, ..) = op(list[at]) { Some(when) } else { None };
    let mut start = at;
    while start > 0 && condition(at).is_some() && condition(start - 1) == condition(at) {
        start -= 1;
    }
    start
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use abi::Slot;

    #[test]
    fn cheap_operations_on_loads_move_to_their_first_use() {
        let mut build = Build::new("f");
        let [x, y, z] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let sum = build.add(y, z);
        let less = build.less(x, y);
        let [first_use, second] = [build.select(less, x, z), build.select(less, z, sum)];
        let product = build.mul(first_use, second);
        let result = build.fma(product, product, sum);
        let list: Vec<Value> = (0..build.ops().len() as u32).map(Value).collect();
        let ordered = sunk(|value| build.get(value), &list, &mut ValueMap::new(build.ops().len()));
        assert_eq!(ordered, [x, y, z, sum, less, first_use, second, product, result]);
        let w = build.load(Slot(6));
        let more = build.add(w, w);
        let last = build.mul(result, more);
        let list = [w, more, x, y, z, sum, less, first_use, second, product, result, last];
        let ordered = sunk(|value| build.get(value), &list, &mut ValueMap::new(build.ops().len()));
        assert_eq!(ordered, [x, y, z, sum, less, first_use, second, product, result, w, more, last]);
    }
}
