//! Verifier of control-flow graphs: the properties that passes and the emitter rely on.
//!
//! In: a graph. Out: the first fault, as a message. On each path to a use, the value has been computed, read back or passed
//! as a parameter; a block computes a value once; arguments fit parameters in number and type; a slot is loaded before it is stored; calls go to pieces.

use super::cfg::{Area, Block, BlockId, Cfg, Inst, Place, Terminator};
use super::value_map::{Bits, ValueSet};
use super::{Op, Type, Value, verify};

/// Checks a graph.
///
/// # Errors
/// A message that describes the first fault.
pub fn verify_cfg(cfg: &Cfg) -> Result<(), String> {
    let fault = |what: String| Err(format!("{}: {what}", cfg.name));
    let types = match verify::types_of(&cfg.ops) {
        Ok(types) => types,
        Err(what) => return fault(what),
    };
    let exists = |value: Value| value.index() < cfg.ops.len();
    let mut computed = ValueSet::new(cfg.ops.len());
    for (id, block) in (0..).map(BlockId).zip(&cfg.blocks) {
        let mut unknown = None;
        let mut check = |value: Value| unknown = unknown.or((!exists(value)).then_some(value));
        block.insts.iter().for_each(|inst| inst.each_value(&mut check));
        block.end.each_value(&mut check);
        block.params.iter().for_each(|param| check(*param));
        if let Some(value) = unknown {
            return fault(format!("{id} names {value}, which does not exist"));
        }
        let mut wrong = None;
        block.end.each_target(&mut |to, args| {
            let Some(target) = cfg.blocks.get(to.index()) else {
                wrong = Some(format!("{id} goes to {to}, which does not exist"));
                return;
            };
            let of = |values: &[Value]| values.iter().map(|value| types[value.index()]).collect::<Vec<_>>();
            if target.params.iter().all(|param| exists(*param)) && of(args) != of(&target.params) {
                wrong = Some(format!("{id} passes {:?} to {to}, which takes {:?}", of(args), of(&target.params)));
            }
        });
        if let Some(what) = wrong {
            return fault(what);
        }
        match &block.end {
            Terminator::Branch { when, .. } if types[when.index()] == Type::Real => {
                return fault(format!("{id} branches on {when}, a real"));
            }
            Terminator::Return(Some(status)) if types[status.index()] != Type::Int => {
                return fault(format!("{id} returns {status}, which is no integer"));
            }
            _ => {}
        }
        computed.clear();
        for inst in &block.insts {
            match inst {
                Inst::Compute(value) if !computed.insert(*value, ()) => {
                    return fault(format!("{id} computes {value} twice"));
                }
                Inst::Call(piece) if *piece >= cfg.pieces.len() => return fault(format!("{id} calls piece {piece}")),
                Inst::Store(Place { area: Area::Block, index, .. }, value) if types[value.index()] != Type::Real => {
                    return fault(format!("slot {index} holds reals, {value} is {:?}", types[value.index()]));
                }
                Inst::Reload(_, Place { area: Area::Scratch, index, .. })
                | Inst::Store(Place { area: Area::Scratch, index, .. }, _)
                    if *index >= cfg.scratch_len =>
                {
                    return fault(format!("{id} uses scratch slot {index} of {}", cfg.scratch_len));
                }
                _ => {}
            }
        }
    }
    cfg.entries().try_for_each(|(entry, _)| paths(cfg, entry)).or_else(fault)
}

/// Checks what holds on every path from an entry.
fn paths(cfg: &Cfg, entry: BlockId) -> Result<(), String> {
    let order = cfg.order(entry);
    let stores = |block: &Block| block.insts.iter().filter_map(stored_slot).max().map_or(0, |slot| slot + 1);
    let slots = cfg.blocks.iter().map(stores).max().unwrap_or(0);
    // For each block what is available, and which slots may have been stored in this iteration, at its beginning.
    let mut available: Vec<Option<Bits>> = vec![None; cfg.blocks.len()];
    let mut stored = vec![Bits::new(slots); cfg.blocks.len()];
    available[entry.index()] = Some(Bits::new(cfg.ops.len()));
    let mut changed = true;
    let mut result = Ok(());
    while std::mem::take(&mut changed) {
        result = Ok(());
        for id in &order {
            let block = &cfg.blocks[id.index()];
            let Some(mut now) = available[id.index()].clone() else { continue };
            let mut stored_now = stored[id.index()].clone();
            block.params.iter().for_each(|param| now.insert(param.index()));
            let mut check = |lacking: Option<Value>| {
                if let Some(value) = lacking {
                    result = std::mem::replace(&mut result, Ok(()))
                        .and(Err(format!("{id} uses {value}, which is not available on every path")));
                }
            };
            let mut late = None;
            for inst in &block.insts {
                check(cfg.uses(inst).find(|value| !now.contains(value.index())));
                match inst {
                    Inst::Compute(value) => {
                        if let Op::Load(slot) = cfg.op(*value)
                            && stored_now.contains(slot.index())
                        {
                            late = Some(format!("{id} loads slot {} after a store to it", slot.0));
                        }
                        now.insert(value.index());
                    }
                    Inst::Reload(value, _) => now.insert(value.index()),
                    Inst::Store(..) | Inst::Write(_) | Inst::Call(_) => {
                        if let Some(slot) = stored_slot(inst) {
                            stored_now.insert(slot);
                        }
                    }
                }
            }
            check(cfg.end_uses(&block.end).into_iter().find(|value| !now.contains(value.index())));
            if let (Some(late), Ok(())) = (late, &result) {
                result = Err(late);
            }
            let head = if let Terminator::Repeat { again, .. } = &block.end { Some(again.block) } else { None };
            block.end.each_target(&mut |to, _| {
                changed |= match &mut available[to.index()] {
                    Some(before) => before.intersect(&now),
                    before => before.replace(now.clone()).is_none(),
                };
                if Some(to) != head {
                    changed |= stored[to.index()].unite(&stored_now);
                }
            });
        }
    }
    result
}

/// The slot that an instruction writes, if it stores to the model's block of numbers.
fn stored_slot(inst: &Inst) -> Option<usize> {
    match inst {
        Inst::Store(Place { area: Area::Block, index, .. }, _) => Some(*index as usize),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::cfg_text::parse_cfg;

    #[test]
    fn faults_are_found() {
        for (text, expected) in [
            ("f, single:\nb0 body:\n  v0 = load 3\n  v1 = neg v0\n  store 3 = v1\n  return\n", ""),
            (
                "f, single:\n  v0 = load 3\nb0 body:\n  v1 = neg v0\n  return\n",
                "b0 uses v0, which is not available on every path",
            ),
            (
                "f, single:\nb0 body:\n  v0 = load 3\n  v1 = less v0 v0\n  branch v1 b1 b2\nb1 body:\n  v2 = neg v0\n  jump b2\n\
                 b2 body:\n  store 3 = v2\n  return\n",
                "b2 uses v2, which is not available on every path",
            ),
            (
                "f, single:\nb0 body:\n  v0 = load 3\n  store 4 = v0\n  v1 = load 4\n  store 3 = v1\n  return\n",
                "b0 loads slot 4 after a store to it",
            ),
            // A repetition loads what the one before has stored.
            (
                "f, several:\nb0 prologue:\n  jump b1\nb1 body:\n  v0 = load 3\n  v1 = neg v0\n  store 3 = v1\n  repeat b1 b2\n\
                 b2 body:\n  return\n",
                "",
            ),
            ("f, single:\nb0 body:\n  jump b1\n", "b0 goes to b1, which does not exist"),
            (
                "f, single:\n  v0 = int 0\nb0 body:\n  jump b1(v0)\nb1 body:\n  return\n",
                "b0 passes [Int] to b1, which takes []",
            ),
            ("f, single:\nb0 body:\n  v0 = load 3\n  return v0\n", "b0 returns v0, which is no integer"),
            ("f, single:\nb0 body:\n  call 0\n  return\n", "b0 calls piece 0"),
            ("f, single:\n  v0 = 1.0\nb0 body:\n  store scratch 2 = v0\n  return\n", "b0 uses scratch slot 2 of 0"),
        ] {
            let cfg = parse_cfg(text).unwrap_or_else(|error| panic!("{error}\n{text}"));
            let found = verify_cfg(&cfg).err().unwrap_or_default();
            assert_eq!(found.strip_prefix("f: ").unwrap_or_default(), expected, "{text}");
        }
    }
}
