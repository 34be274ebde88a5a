//! The status of a step that has been made, from what it has left.
//!
//! In: a sound, expanded step. Out: a function that gives its status behind it: what the step has stored it reads from where that
//! is. So a step need neither wait until it is known whether it fails, nor find out how.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::{HashMap, HashSet};

/// The function; none if there is no status, or it hangs on something that the step does not leave.
pub fn told(func: &Func) -> Option<Func> {
    let status = func.status?;
    let stored: HashMap<Value, Slot> = func.stores.iter().map(|(slot, value)| (*value, *slot)).collect();
    let written: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let mut build = Build::new(&format!("{}, told", func.name));
    let mut left: Vec<Option<Value>> = Vec::with_capacity(func.ops.len());
    for (at, op) in func.ops.iter().enumerate() {
        let mut is_left = match *op {
            Op::Load(slot) => !written.contains(&slot),
            Op::Ring { .. } => false,
            _ => true,
        };
        op.each_operand(|operand| is_left &= left[operand.index()].is_some());
        left.push(match stored.get(&Value(at as u32)) {
            Some(slot) => Some(build.load(*slot)),
            None if is_left => Some(build.op(op.map(|operand| left[operand.index()].expect("all are left")))),
            None => None,
        });
    }
    build.status(left[status.index()]?);
    Some(build.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A state in slot 3 that moves with slot 4, watched together with `also`, the state before or slot 4.
    fn watching(also: Slot) -> Func {
        let mut build = Build::new("step");
        let [x, v, also] = [Slot(3), Slot(4), also].map(|slot| build.load(slot));
        let next = build.add(x, v);
        build.store(Slot(3), next);
        let both = build.add(next, also);
        let finite = build.less_equal(both, both);
        let [fine, bad] = [0, 1].map(|status| build.int(status));
        let status = build.select(finite, fine, bad);
        build.status(status);
        build.finish()
    }

    #[test]
    fn what_the_step_leaves_tells_its_status_and_what_it_overwrites_does_not() {
        let func = told(&watching(Slot(4))).expect("the next state and what moves it are there");
        assert_eq!((func.loads(), func.stores.len()), (vec![Slot(3), Slot(4)], 0), "{func}");
        assert_eq!(func.ops.iter().filter(|op| matches!(op, Op::Add(..))).count(), 1, "{func}");
        assert!(told(&watching(Slot(3))).is_none());
    }
}
