//! Unswitching: a condition that several automata of a step test is tested once, and the step is duplicated for each
//! answer.
//!
//! In: a step in one block. Out: a block that tests the condition, and the residual step for each answer. Example: four
//! sliding springs test the direction of the same motion, each once per mode. It knows nothing of processors.
//!
//! Source: Allen, Cocke, *A Catalogue of Optimizing Transformations*, 1972, there for loops.

use crate::codegen::specialise_modes::shared_operands;
use crate::ir::build::Build;
use crate::ir::cfg::{Block, BlockId, Cfg, Inst, Part, Terminator};
use crate::ir::hash::HashSet;
use crate::ir::partial_eval::{known, partial_eval, slice};
use crate::ir::{Func, Op, Value};

/// Minimum number of automata that must share a condition for a copy to be worth its size.
const MIN_AUTOMATA: usize = 3;
/// Maximum number of operations of a function that is duplicated.
const MAX_OPS: usize = 400;

/// Maximum depth of nested unswitching; each level doubles the code.
const MAX_DEPTH: usize = 2;

/// Unswitches the conditions of the step.
pub fn unswitch(cfg: &mut Cfg) {
    of_block(cfg, BlockId(0), 0);
}

fn of_block(cfg: &mut Cfg, block: BlockId, depth: usize) {
    let Some(func) = cfg.straight_line(block).filter(|_| depth < MAX_DEPTH) else { return };
    let Some(condition) = unswitchable(&func) else { return };
    let to = cfg.append(&func.ops);
    let live = func.live_for([condition].into_iter());
    let test = (0..func.ops.len()).filter(|i| live[*i]).map(|i| to(Value(i as u32)));
    let insts = test.filter(|value| !cfg.is_free(*value)).map(Inst::Compute).collect();
    let [yes, no] = [true, false].map(|truth| cfg.import(&assuming(&func, condition, truth), Part::Body));
    let end = Terminator::Branch { when: to(condition), yes: yes.into(), no: no.into() };
    cfg.blocks[block.index()] = Block { part: Part::Body, params: Vec::new(), insts, end };
    [yes, no].into_iter().for_each(|side| of_block(cfg, side, depth + 1));
}

/// The condition to unswitch: the comparison that most automata share, if at least three do. Only comparisons of
/// constants and of slots that the step does not store come into question: they are available before all other
/// operations.
pub(super) fn unswitchable(func: &Func) -> Option<Value> {
    if func.ops.len() > MAX_OPS {
        return None;
    }
    let stored =
        |value: Value| matches!(func.op(value), Op::Load(slot) if func.stores.iter().any(|(of, _)| *of == slot));
    let is_available = |value: Value| matches!(func.op(value), Op::Load(_) | Op::Real(_)) && !stored(value);
    let shared = shared_operands(func, |op| match op {
        Op::Less(a, b) | Op::LessEqual(a, b) => is_available(a) && is_available(b),
        _ => false,
    });
    let mut most: Option<(Value, usize)> = None;
    for (value, count) in shared.into_iter().filter(|(_, count)| *count >= MIN_AUTOMATA) {
        if most.is_none_or(|(_, known)| count > known) {
            most = Some((value, count));
        }
    }
    most.map(|(value, _)| value)
}

/// The residual function when the boolean `condition` has the value `truth`.
fn assuming(func: &Func, condition: Value, truth: bool) -> Func {
    let mut build = Build::of(func);
    let known = known(&mut build, condition, truth);
    let results: Vec<Value> = func.results().collect();
    let list = slice(&build, &HashSet::default(), &results);
    let all: Vec<Value> = (0..func.ops.len()).map(|i| Value(i as u32)).collect();
    let values = partial_eval(&mut build, &list, &known, &all);
    build.finish_as(func, &values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;

    /// Springs in slots 10, 12 …, the mode of each in the slot after it: they move with slot 3 while that is above 0,
    /// and keep their value otherwise.
    fn springs(number: u32) -> Func {
        let mut build = Build::new("step");
        let v = build.load(Slot(3));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let moves = build.less(zero, v);
        for k in 0..number {
            let [f, regime] = [10 + 2 * k, 11 + 2 * k].map(|slot| build.load(Slot(slot)));
            let (sticks, moved) = (build.equal(regime, zero), build.add(f, v));
            let pulled = build.and(sticks, moves);
            let next = build.select(pulled, moved, f);
            let regime = build.select(pulled, one, regime);
            build.store(Slot(10 + 2 * k), next);
            build.store(Slot(11 + 2 * k), regime);
        }
        build.finish()
    }

    #[test]
    fn a_condition_of_three_automata_is_unswitched() {
        let found = |number: u32| {
            let func = springs(number);
            unswitchable(&func).map(|value| func.op(value))
        };
        assert_eq!(found(2), None);
        assert!(matches!(found(3), Some(Op::Less(..))));
    }

    #[test]
    fn a_copy_does_not_test_again() {
        let func = springs(4);
        let condition = unswitchable(&func).unwrap();
        let [moves, rests] = [true, false].map(|truth| assuming(&func, condition, truth));
        let count = |func: &Func, what: fn(&Op) -> bool| func.ops.iter().filter(|op| what(op)).count();
        let is_comparison = |op: &Op| matches!(op, Op::Less(..));
        let is_choice = |op: &Op| matches!(op, Op::Select(..));
        assert_eq!((count(&moves, is_comparison), count(&moves, is_choice)), (0, 8), "{moves}");
        assert_eq!((count(&rests, is_comparison), count(&rests, is_choice)), (0, 0), "{rests}");
        assert_eq!(moves.stores.len(), 8);
        assert_eq!(unswitchable(&moves), None);
    }
}
