//! Hoists loop invariants: operations that no step changes move from the loop to its preheader.
//!
//! In: a loop in the shape of `form_loop`. Out: the same loop, in which each iteration computes only what may have
//! changed. Cold blocks keep their operations. It knows nothing of processors.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, sec. 9.5.

use crate::ir::cfg::{Area, BlockId, Cfg, Inst, Place};
use crate::ir::hash::HashSet;
use crate::ir::variance::{Slots, Variance, of_ops};
use abi::Slot;

/// Hoists the invariants of the loop, if there is one.
pub fn hoist_invariants(cfg: &mut Cfg) {
    let order = cfg.order(BlockId(0));
    let Some(head) = cfg.head(&order) else { return };
    let Some(preheader) = cfg.preheader(head, &order) else { return };
    let insts = || cfg.blocks.iter().flat_map(|block| &block.insts);
    let stored = insts().filter_map(|inst| match inst {
        Inst::Store(Place { area: Area::Block, index, .. }, _) => Some(Slot(*index)),
        _ => None,
    });
    let slots = Slots::new(stored, None);
    let reloaded: HashSet<usize> =
        insts().filter_map(|inst| if let Inst::Reload(value, _) = inst { Some(value.index()) } else { None }).collect();
    let own = |i: usize| if reloaded.contains(&i) { Variance::Time } else { Variance::Parameters };
    let variance = of_ops(&cfg.ops, &slots, own);
    let is_hoisted = |inst: &Inst| match inst {
        Inst::Compute(value) => variance[value.index()].is_invariant(),
        _ => false,
    };
    let body = std::mem::take(&mut cfg.blocks[head.index()].insts);
    let (hoisted, rest): (Vec<Inst>, Vec<Inst>) = body.into_iter().partition(is_hoisted);
    cfg.blocks[head.index()].insts = rest;
    let prologue = &mut cfg.blocks[preheader.index()].insts;
    prologue.extend(hoisted);
    // In the order of the straight line, in which operands precede their users. The preheader may compute the first
    // value of a carried one from the same operations.
    prologue.sort_by_key(|inst| if let Inst::Compute(value) = inst { *value } else { unreachable!("{inst:?}") });
    prologue.dedup();
}
