//! Drops the step counter from a single step: its caller keeps count and time, see [`abi::table::Entry`].
//!
//! In: a step in one block. Out: the step without the store of the counter; unchanged if an equation reads the counter,
//! as delayed and sampled values do. It is dead store elimination with a fact about the caller.

use crate::ir::build::prune;
use crate::ir::cfg::{BlockId, Cfg};
use abi::Slot;

/// Drops the counter.
pub fn drop_counter(cfg: &mut Cfg) {
    let Some(mut func) = cfg.straight_line(BlockId(0)) else { return };
    func.stores.retain(|(slot, _)| *slot != Slot::COUNT);
    let func = prune(&func);
    if !func.loads().contains(&Slot::COUNT) {
        *cfg = Cfg::straight(&func, cfg.called);
    }
}
