//! What several automata of a step ask alike is asked once, and the step goes on in a copy for each answer.
//!
//! In: a sound, expanded function. Out: [`unswitched`], and what is [`assuming`] the answer. Four springs that slide ask for the
//! direction of one motion, each as often as it has regimes. It knows nothing of processors.

use crate::codegen::specialise_modes::automata_that_ask;
use crate::ir::build::Build;
use crate::ir::partial_eval::{known, partial_eval, slice};
use crate::ir::{Func, Op, Value};
use std::collections::HashSet;

/// Fewest automata for which a copy is worth its room.
const FEWEST: usize = 3;
/// Most operations of a function that is copied.
const LARGEST: usize = 400;

/// The comparison of numbers that the step finds, or that are written down, which most automata ask, if several do.
pub fn unswitched(func: &Func) -> Option<Value> {
    if func.ops.len() > LARGEST {
        return None;
    }
    let stored =
        |value: Value| matches!(func.op(value), Op::Load(slot) if func.stores.iter().any(|(of, _)| *of == slot));
    let is_found = |value: Value| matches!(func.op(value), Op::Load(_) | Op::Real(_)) && !stored(value);
    let asks = automata_that_ask(func, |op| match op {
        Op::Less(a, b) | Op::LessEqual(a, b) => is_found(a) && is_found(b),
        _ => false,
    });
    let mut most: Option<(Value, usize)> = None;
    for (value, count) in asks.into_iter().filter(|(_, count)| *count >= FEWEST) {
        if most.is_none_or(|(_, known)| count > known) {
            most = Some((value, count));
        }
    }
    most.map(|(value, _)| value)
}

/// What is left of a function where this is true, or false.
pub fn assuming(func: &Func, asked: Value, truth: bool) -> Func {
    let mut build = Build::of(func);
    let known = known(&mut build, asked, truth);
    let results: Vec<Value> = func.results().collect();
    let list = slice(&build, &HashSet::new(), &results);
    let all: Vec<Value> = (0..func.ops.len()).map(|i| Value(i as u32)).collect();
    let values = partial_eval(&mut build, &list, &known, &all);
    build.finish_as(func, &values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;

    /// Springs in slots 10, 12 …, each with its regime behind it, that move with slot 3 while that is above 0, else keep.
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
    fn what_three_automata_ask_is_asked_once() {
        let asked = |number: u32| {
            let func = springs(number);
            unswitched(&func).map(|value| func.op(value))
        };
        assert_eq!(asked(2), None);
        assert!(matches!(asked(3), Some(Op::Less(..))));
    }

    #[test]
    fn a_copy_does_not_ask_again() {
        let func = springs(4);
        let asked = unswitched(&func).unwrap();
        let [moves, rests] = [true, false].map(|truth| assuming(&func, asked, truth));
        let count = |func: &Func, what: fn(&Op) -> bool| func.ops.iter().filter(|op| what(op)).count();
        let is_comparison = |op: &Op| matches!(op, Op::Less(..));
        let is_choice = |op: &Op| matches!(op, Op::Select(..));
        assert_eq!((count(&moves, is_comparison), count(&moves, is_choice)), (0, 8), "{moves}");
        assert_eq!((count(&rests, is_comparison), count(&rests, is_choice)), (0, 0), "{rests}");
        assert_eq!(moves.stores.len(), 8);
        assert_eq!(unswitched(&moves), None);
    }
}
