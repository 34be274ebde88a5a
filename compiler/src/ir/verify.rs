//! Verifier: checks the properties that every pass and back end relies on.
//!
//! In: a function and the block it works on. Out: the first fault, as a message. It checks that operands precede their
//! users, types, slots, stores, rings and tables.

use super::{Func, Op, Type, Value};
use abi::{Layout, Slot};

/// How far a function has been lowered.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Stage {
    /// It may contain elementary functions.
    Lowered,
    /// It contains arithmetic only, as back ends require.
    Expanded,
}

/// Checks a function. `layout`: the block it works on. `pool_len`: the length of its pool of constants.
///
/// # Errors
/// A message that describes the first fault.
pub fn verify(func: &Func, layout: &Layout, pool_len: usize, stage: Stage) -> Result<(), String> {
    let fault = |what: String| Err(format!("{}: {what}", func.name));
    let types = match types(func) {
        Ok(types) => types,
        Err(what) => return fault(what),
    };
    let touched: crate::ir::hash::HashSet<Slot> =
        func.loads().into_iter().chain(func.stores.iter().map(|(slot, _)| *slot)).collect();
    let ring = |base: Slot, len: u32| {
        let (start, end) = (base.0, base.0 as u64 + u64::from(len));
        if len == 0 || start < layout.rings.start || end > u64::from(layout.rings.start + layout.rings.len) {
            return Err(format!("uses {len} slots from {start} on as a ring, which lie outside the rings"));
        }
        match touched.iter().find(|slot| (start..start + len).contains(&slot.0)) {
            Some(slot) => Err(format!("uses a ring of which slot {} is loaded or stored", slot.0)),
            None => Ok(()),
        }
    };
    for (i, op) in func.ops.iter().enumerate() {
        let value = Value(i as u32);
        match *op {
            Op::Load(slot) if slot.index() >= layout.size() => {
                return fault(format!("{value} loads slot {} of a block of {}", slot.0, layout.size()));
            }
            Op::Pool { len: 0, .. } => return fault(format!("{value} reads a table without entries")),
            Op::Pool { base, len, .. } if base as usize + len as usize > pool_len => {
                return fault(format!("{value} reads entries {base}..{base} + {len} of a pool of {pool_len}"));
            }
            Op::Ring { base, len, .. } => {
                if let Err(what) = ring(base, len) {
                    return fault(format!("{value} {what}"));
                }
            }
            Op::ShiftLeft(_, n) | Op::ShiftRight(_, n) | Op::ShiftRightSigned(_, n) if n > 63 => {
                return fault(format!("{value} shifts by {n}"));
            }
            Op::Unary(..) | Op::Binary(..) if stage == Stage::Expanded => {
                return fault(format!("{value} is an elementary function that nothing has expanded"));
            }
            _ => {}
        }
    }
    let mut stored = crate::ir::hash::HashSet::default();
    for &(slot, value) in &func.stores {
        if !storable(slot, layout) {
            return fault(format!("a store to slot {}, which no function may write", slot.0));
        }
        if !stored.insert(slot) {
            return fault(format!("two stores to slot {}", slot.0));
        }
        match types.get(value.index()) {
            Some(Type::Real) => {}
            Some(other) => return fault(format!("slot {} holds reals, {value} is {other:?}", slot.0)),
            None => return fault(format!("slot {} is given {value}, which does not exist", slot.0)),
        }
    }
    for write in &func.writes {
        if let Err(what) = ring(write.base, write.len) {
            return fault(format!("a write {what}"));
        }
        let of = |value: Value| types.get(value.index()).copied();
        if of(write.index) != Some(Type::Int) || of(write.value) != Some(Type::Real) {
            return fault(format!("a write of {} at {}: a real at an integer is needed", write.value, write.index));
        }
    }
    match func.status {
        Some(status) if types.get(status.index()) != Some(&Type::Int) => {
            fault(format!("the status {status} is no integer"))
        }
        _ => Ok(()),
    }
}

/// Whether a function may write the slot. The step length, parameters, inputs and due flags are read-only.
fn storable(slot: Slot, layout: &Layout) -> bool {
    slot.index() < layout.size()
        && slot != Slot::STEP
        && ![layout.params, layout.inputs, layout.due].iter().any(|segment| segment.contains(slot))
}

/// The type of every value.
///
/// # Errors
/// A message, if an operand does not precede its user or has the wrong type.
pub fn types(func: &Func) -> Result<Vec<Type>, String> {
    types_of(&func.ops)
}

/// As [`types`], of operations alone.
///
/// # Errors
/// As `types`.
pub fn types_of(ops: &[Op]) -> Result<Vec<Type>, String> {
    let mut types: Vec<Type> = Vec::with_capacity(ops.len());
    for (i, &op) in ops.iter().enumerate() {
        let value = Value(i as u32);
        let mut undefined = None;
        op.each_operand(|operand| {
            if operand.index() >= i {
                undefined = Some(operand);
            }
        });
        if let Some(operand) = undefined {
            return Err(format!("{value} uses {operand}, which does not stand before it"));
        }
        types.push(result(op, |operand| types[operand.index()]).map_err(|what| format!("{value} {what}"))?);
    }
    Ok(types)
}

/// The type of an operation's result. `of`: the types of its operands.
///
/// # Errors
/// A message, if an operand has the wrong type.
pub fn result(op: Op, of: impl Fn(Value) -> Type) -> Result<Type, String> {
    use Type::{Bool, Int, Real};
    let (operands, result): (&[Type], Type) = match op {
        Op::Real(_) | Op::Load(_) => (&[], Real),
        Op::Int(_) => (&[], Int),
        Op::Bool(_) => (&[], Bool),
        Op::Pool { .. } | Op::Ring { .. } => (&[Int], Real),
        Op::Add(..) | Op::Sub(..) | Op::Mul(..) | Op::Div(..) | Op::Binary(..) => (&[Real, Real], Real),
        Op::Neg(_) | Op::Abs(_) | Op::Sqrt(_) | Op::Floor(_) | Op::Nearest(_) | Op::Unary(..) => (&[Real], Real),
        Op::Fma(..) => (&[Real, Real, Real], Real),
        Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => (&[Real, Real], Bool),
        Op::And(..) | Op::Or(..) => (&[Bool, Bool], Bool),
        Op::Not(_) => (&[Bool], Bool),
        Op::Select(_, a, _) => match of(a) {
            Real => (&[Bool, Real, Real], Real),
            Int => (&[Bool, Int, Int], Int),
            Bool => (&[Bool, Bool, Bool], Bool),
        },
        Op::IntAdd(..) | Op::IntSub(..) | Op::IntMul(..) | Op::IntAnd(..) | Op::IntOr(..) | Op::IntXor(..) => {
            (&[Int, Int], Int)
        }
        Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => (&[Int], Int),
        Op::IntLess(..) | Op::IntEqual(..) => (&[Int, Int], Bool),
        Op::ToBits(_) | Op::ToInt(_) => (&[Real], Int),
        Op::FromBits(_) | Op::ToReal(_) => (&[Int], Real),
    };
    let mut expected = operands.iter();
    let mut wrong = None;
    op.each_operand(|operand| {
        let expected = *expected.next().expect("as many types as operands");
        if of(operand) != expected {
            wrong = Some(format!("needs {expected:?}, {operand} is {:?}", of(operand)));
        }
    });
    wrong.map_or(Ok(result), Err)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One parameter in slot 3, one state in slot 4, one due flag in slot 5.
    fn layout() -> Layout {
        Layout::new([1, 0, 1, 0, 0, 0, 0, 0, 0, 1])
    }

    #[track_caller]
    fn check(ops: &[Op], stores: &[(u32, u32)], status: Option<u32>, expected: &str) {
        let func = Func {
            name: "f".into(),
            ops: ops.to_vec(),
            stores: stores.iter().map(|&(slot, value)| (Slot(slot), Value(value))).collect(),
            writes: Vec::new(),
            status: status.map(Value),
        };
        let found = verify(&func, &layout(), 8, Stage::Expanded).err().unwrap_or_default();
        assert_eq!(found, expected);
    }

    #[test]
    fn a_sound_function_passes() {
        check(&[Op::Load(Slot(3)), Op::Int(0), Op::Add(Value(0), Value(0))], &[(4, 2), (0, 0)], Some(1), "");
        check(&[Op::Int(9), Op::Pool { base: 3, len: 5, index: Value(0) }], &[], None, "");
    }

    #[test]
    fn operands_precede_their_users() {
        check(&[Op::Neg(Value(0))], &[], None, "f: v0 uses v0, which does not stand before it");
        check(&[Op::Neg(Value(7))], &[], None, "f: v0 uses v7, which does not stand before it");
    }

    #[test]
    fn operand_types_are_checked() {
        check(&[Op::Bool(true), Op::Neg(Value(0))], &[], None, "f: v1 needs Real, v0 is Bool");
        check(
            &[Op::Bool(true), Op::Int(1), Op::Real(0), Op::Select(Value(0), Value(1), Value(2))],
            &[],
            None,
            "f: v3 needs Int, v2 is Real",
        );
        check(&[Op::Int(1)], &[(4, 0)], None, "f: slot 4 holds reals, v0 is Int");
        check(&[Op::Real(0)], &[], Some(0), "f: the status v0 is no integer");
    }

    #[test]
    fn accesses_stay_within_block_and_pool() {
        check(&[Op::Load(Slot(6))], &[], None, "f: v0 loads slot 6 of a block of 6");
        check(
            &[Op::Int(0), Op::Pool { base: 4, len: 5, index: Value(0) }],
            &[],
            None,
            "f: v1 reads entries 4..4 + 5 of a pool of 8",
        );
        check(
            &[Op::Int(0), Op::Pool { base: 4, len: 0, index: Value(0) }],
            &[],
            None,
            "f: v1 reads a table without entries",
        );
        check(&[Op::Int(0), Op::ShiftLeft(Value(0), 64)], &[], None, "f: v1 shifts by 64");
    }

    #[test]
    fn stores_are_unique_and_hit_writable_slots() {
        for slot in [1, 3, 5, 6] {
            check(
                &[Op::Real(0)],
                &[(slot, 0)],
                None,
                &format!("f: a store to slot {slot}, which no function may write"),
            );
        }
        check(&[Op::Real(0)], &[(4, 0), (4, 0)], None, "f: two stores to slot 4");
        check(&[Op::Real(0)], &[(4, 3)], None, "f: slot 4 is given v3, which does not exist");
    }

    #[test]
    fn elementary_functions_must_be_expanded() {
        let exp = [Op::Real(0), Op::Unary(crate::ir::Unary::Exp, Value(0))];
        check(&exp, &[], None, "f: v1 is an elementary function that nothing has expanded");
    }
}
