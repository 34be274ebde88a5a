//! Side exits: operations that only the status of a failed guard needs move to a cold block.
//!
//! In: blocks that end with a status of the form `if failed then detail else 0`. Out: they branch on `failed` alone. The
//! cold block computes `detail`; values that have been stored are read back there, so that they occupy no register
//! before. It knows nothing of processors.
//!
//! Compare Dynamo's side exits: Bala, Duesterwald, Banerjia, *Dynamo: A Transparent Dynamic Optimization System*, PLDI
//! 2000; Appel, Reppy 1996 call the rule for what moves partial dead code elimination, as Knoop, Rüthing, Steffen do.

use crate::ir::cfg::{Block, BlockId, Cfg, Inst, Part, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Func, Op, Value};

/// The value that is tested after a step, and the value that matters only if that test fails.
pub fn tested(func: &Func) -> (Option<Value>, Option<Value>) {
    match func.failure() {
        Some((when, _, detail)) => (Some(when), Some(detail)),
        None => (func.status, None),
    }
}

/// For each operation of a straight line, whether only the status of a failed guard needs it.
pub fn cold(func: &Func) -> Vec<bool> {
    let Some((when, ..)) = func.failure() else { return vec![false; func.ops.len()] };
    let mut needed = vec![false; func.ops.len()];
    needed[when.index()] = true;
    for value in func.results().filter(|value| Some(*value) != func.status) {
        needed[value.index()] = true;
    }
    for i in (0..func.ops.len()).rev() {
        needed[i] |= reads_memory(func.ops[i]);
        if needed[i] {
            func.ops[i].each_operand(|operand| needed[operand.index()] = true);
        }
    }
    needed.into_iter().map(|needed| !needed).collect()
}

/// Whether an operation must precede the stores of its step, and so must the index that it reads.
fn reads_memory(op: Op) -> bool {
    matches!(op, Op::Load(_) | Op::Ring { .. })
}

/// Gives each block that ends with such a status a side exit.
pub fn side_exit(cfg: &mut Cfg) {
    if !cfg.blocks.iter().any(|block| status(cfg, &block.end).is_some()) {
        return;
    }
    for (id, live) in cfg.live_out().into_iter().enumerate() {
        let Some(status) = status(cfg, &cfg.blocks[id].end) else { continue };
        // Where the status is a parameter, another block has computed it.
        let is_computed = cfg.blocks[id].insts.contains(&Inst::Compute(status));
        if let Some((when, is, detail)) = Func::failure_of(&cfg.ops, status).filter(|_| is_computed) {
            let mut needed = vec![false; cfg.ops.len()];
            live.iter().filter(|value| **value != status).chain([&when]).for_each(|value| needed[value.index()] = true);
            split(cfg, BlockId(id as u32), needed, (status, when, is, detail));
        }
    }
}

/// The value that decides the end of a block, if it may be a status: a failed guard selects it.
fn status(cfg: &Cfg, end: &Terminator) -> Option<Value> {
    let (Terminator::Return(Some(status)) | Terminator::Branch { when: status, .. }) = end else { return None };
    Func::failure_of(&cfg.ops, *status).map(|_| *status)
}

/// Splits one block. `needed`: for each value, whether it must be computed in any case.
fn split(cfg: &mut Cfg, id: BlockId, mut needed: Vec<bool>, (status, when, is, detail): (Value, Value, bool, Value)) {
    let mut block = cfg.blocks[id.index()].clone();
    if let Terminator::Branch { no, .. } = &block.end {
        no.args.iter().for_each(|arg| needed[arg.index()] = true);
    }
    let (mut kept, mut moved) = (Vec::new(), Vec::new());
    let mut stored: HashMap<Value, Inst> = HashMap::default();
    for inst in std::mem::take(&mut block.insts).into_iter().rev() {
        let is_needed = match &inst {
            Inst::Compute(value) => needed[value.index()] || reads_memory(cfg.op(*value)),
            // The instructions before use the value of before.
            Inst::Reload(value, _) => std::mem::take(&mut needed[value.index()]),
            Inst::Store(place, value) => {
                if !matches!(cfg.op(*value), Op::Load(_)) && place.stride == 0 {
                    stored.insert(*value, Inst::Reload(*value, *place));
                }
                true
            }
            Inst::Write(_) | Inst::Call(_) => true,
        };
        if is_needed {
            // All operands, also a table entry of which only the bits are read: its index is needed here.
            if let Inst::Compute(value) = inst {
                cfg.op(value).each_operand(|operand| needed[operand.index()] = true);
            }
            cfg.uses(&inst).for_each(|value| needed[value.index()] = true);
            kept.push(inst);
        } else if inst != Inst::Compute(status) {
            moved.push(inst);
        }
    }
    kept.reverse();
    moved.reverse();
    // What is stored by now is read back, once each.
    let mut known: HashSet<Value> = HashSet::default();
    let mut insts = Vec::new();
    let detail_uses = [detail].into_iter().filter(|value| !cfg.is_free(*value));
    let read: Vec<Value> = moved.iter().flat_map(|inst| cfg.uses(inst)).chain(detail_uses).collect();
    for inst in &moved {
        if let Inst::Compute(value) | Inst::Reload(value, _) = inst {
            known.insert(*value);
        }
    }
    insts.extend(read.into_iter().filter(|value| known.insert(*value)).filter_map(|value| stored.get(&value).cloned()));
    insts.extend(moved);
    let exit = match &block.end {
        Terminator::Return(_) => Terminator::Return(Some(detail)),
        Terminator::Branch { yes, no, .. } => {
            let with_detail = |target: &Target| Target {
                block: target.block,
                args: target.args.iter().map(|arg| if *arg == status { detail } else { *arg }).collect(),
            };
            Terminator::Branch { when: detail, yes: with_detail(yes), no: with_detail(no) }
        }
        end => unreachable!("{end:?} tests no status"),
    };
    let fine: Target = match &block.end {
        Terminator::Branch { no, .. } => no.clone(),
        _ => cfg.empty(block.part).into(),
    };
    let cold: Target = cfg.block(Block { part: Part::Cold, params: Vec::new(), insts, end: exit }).into();
    let (yes, no) = if is { (cold, fine) } else { (fine, cold) };
    cfg.blocks[id.index()] = Block { insts: kept, end: Terminator::Branch { when, yes, no }, ..block };
}
