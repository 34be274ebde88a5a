//! A lowered model: straight-line functions over one block, and what it says of itself.

use crate::ir::Func;
use abi::{Description, Slot};

/// The functions of a model before a fixed step is fused and before any back end sees them.
#[derive(Clone, Debug, Default)]
pub struct Program {
    /// Quantities and layout. Its pool begins with the constants of the elementary functions.
    pub description: Description,
    /// Defaults of the parameters, SI, as many as the layout has.
    pub params: Vec<f64>,
    /// Initial values, and the blocks due at 0.
    pub start: Func,
    /// Outputs and observed quantities.
    pub outputs: Func,
    /// dx/dt.
    pub derivatives: Func,
    /// Sampled blocks, each if it is due.
    pub tick: Option<Func>,
    /// One transition per automaton, events, resets, and the memory of crossings.
    pub transitions: Option<Func>,
    /// Switching surfaces.
    pub roots: Option<Func>,
    /// Whether a contact stops what it acts on: then forces that balance must leave exactly 0.
    pub balanced: bool,
}

impl Program {
    /// Whether time stands in an equation: only then do fixed steps keep it.
    pub fn reads_time(&self) -> bool {
        let always = [&self.outputs, &self.derivatives];
        let own = always.into_iter().chain([&self.tick, &self.transitions, &self.roots].into_iter().flatten());
        own.flat_map(Func::loads).any(|slot| slot == Slot::TIME)
    }
}
