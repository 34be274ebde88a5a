//! Puts off what can wait.
//!
//! In: a list of operations, each behind its operands. Out: the same in another order: what comes of loads alone, and takes no
//! longer than a sum, stands just before what reads it first, so that it holds no register until then. It knows nothing of
//! processors.

use crate::ir::{Op, Value};
use std::collections::HashMap;

/// The list, with what can wait put off.
pub fn sunk(ops: &[Op], list: &[Value]) -> Vec<Value> {
    let op = |value: Value| ops[value.index()];
    let position: HashMap<Value, usize> = list.iter().enumerate().map(|(at, value)| (*value, at)).collect();
    let mut waits = vec![false; list.len()];
    for (at, value) in list.iter().enumerate() {
        let mut can_wait = op(*value).effort() <= 1 && !matches!(op(*value), Op::Select(..));
        // An operand that is not listed lies elsewhere and is kept, or is a constant.
        op(*value).each_operand(|operand| can_wait &= position.get(&operand).is_none_or(|at| waits[*at]));
        waits[at] = can_wait;
    }
    // Where each is read first, or the end.
    let mut first = vec![list.len(); list.len()];
    for (at, value) in list.iter().enumerate().rev() {
        let here = if waits[at] { first[at] } else { begin(&op, list, at) };
        op(*value).each_operand(|operand| {
            if let Some(of) = position.get(&operand) {
                first[*of] = first[*of].min(here);
            }
        });
    }
    let mut put_off: Vec<Vec<Value>> = vec![Vec::new(); list.len() + 1];
    for (at, value) in list.iter().enumerate().filter(|(at, _)| waits[*at]) {
        put_off[first[at]].push(*value);
    }
    let stays = |at: usize| list.get(at).filter(|_| !waits[at]).copied();
    put_off.into_iter().enumerate().flat_map(|(at, before)| before.into_iter().chain(stays(at))).collect()
}

/// Where the choices begin that stand side by side and ask the same as the one here: nothing comes between these.
fn begin(op: &impl Fn(Value) -> Op, list: &[Value], at: usize) -> usize {
    let asked = |at: usize| if let Op::Select(when, ..) = op(list[at]) { Some(when) } else { None };
    let mut begin = at;
    while begin > 0 && asked(at).is_some() && asked(begin - 1) == asked(at) {
        begin -= 1;
    }
    begin
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use abi::Slot;

    #[test]
    fn what_comes_of_loads_alone_stands_where_it_is_read() {
        let mut build = Build::new("f");
        let [x, y, z] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let sum = build.add(y, z);
        let less = build.less(x, y);
        let [first, second] = [build.select(less, x, z), build.select(less, z, sum)];
        let product = build.mul(first, second);
        let result = build.fma(product, product, sum);
        let list: Vec<Value> = (0..build.ops().len() as u32).map(Value).collect();
        let ordered = sunk(build.ops(), &list);
        assert_eq!(ordered, [x, y, z, sum, less, first, second, product, result]);
        let w = build.load(Slot(6));
        let more = build.add(w, w);
        let last = build.mul(result, more);
        let list = [w, more, x, y, z, sum, less, first, second, product, result, last];
        let ordered = sunk(build.ops(), &list);
        assert_eq!(ordered, [x, y, z, sum, less, first, second, product, result, w, more, last]);
    }
}
