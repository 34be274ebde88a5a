//! A lowered model: straight-line functions over one block, and the description of that block.

use crate::ir::Func;
use crate::ir::hash::HashSet;
use abi::description::Guard;
use abi::{Description, Slot};

/// The functions of a model, before a fixed step is composed from them and before any back end.
#[derive(Clone, Debug, Default)]
pub struct Program {
    /// Quantities and layout. Its pool begins with the constants of the elementary functions.
    pub description: Description,
    /// Default values of the parameters, in SI units, as many as the layout has.
    pub params: Vec<f64>,
    /// Computes the initial values and runs the sampled blocks that are due at time 0.
    pub start: Func,
    /// Computes outputs and observed quantities.
    pub outputs: Func,
    /// Computes dx/dt.
    pub derivatives: Func,
    /// Runs the sampled blocks that are due.
    pub tick: Option<Func>,
    /// At most one transition per automaton, then events, resets, and the memory of crossings.
    pub transitions: Option<Func>,
    /// Computes the switching functions, whose zeros are the switching surfaces.
    pub roots: Option<Func>,
    /// Whether a contact can bring a body to rest. Forces in balance must then add up to exactly 0.
    pub balanced: bool,
    /// Outputs that a fixed step need not compute, because nothing reads them after every step.
    pub left_out: Vec<Slot>,
}

impl Program {
    /// The outputs that no function reads and for which no guard has a range: those that a fixed step computes for readers
    /// of the block alone.
    pub fn outputs_for_readers(&self) -> impl Iterator<Item = Slot> {
        let Description { layout, guards, delays, .. } = &self.description;
        let always = [&self.outputs, &self.derivatives, &self.start].into_iter();
        let funcs = always.chain([&self.tick, &self.transitions, &self.roots].into_iter().flatten());
        let mut kept: HashSet<Slot> = funcs.flat_map(Func::loads).collect();
        let is_open = |guard: &&Guard| guard.range == (f64::NEG_INFINITY, f64::INFINITY);
        kept.extend(guards.iter().filter(|guard| !is_open(guard)).map(|guard| guard.slot));
        kept.extend(delays.iter().map(|delay| delay.source));
        layout.outputs.range().map(|slot| Slot(slot as u32)).filter(move |slot| !kept.contains(slot))
    }

    /// Whether an equation uses time. If none does, a fixed step does not store time in the block.
    pub fn reads_time(&self) -> bool {
        let always = [&self.outputs, &self.derivatives];
        let own = always.into_iter().chain([&self.tick, &self.transitions, &self.roots].into_iter().flatten());
        own.flat_map(Func::loads).any(|slot| slot == Slot::TIME)
    }
}
