//! The loop of lanes, planned: which operations run before it, in each step, and in the last step.
//!
//! In: a step as a straight line of nodes, either operations or machine operations. Out: a [`LoopPlan`]: the nodes of each
//! part in order, and where their results lie in memory after the block. Both emitters of lanes use it; they add only
//! their instructions.
//!
//! ```text
//! prologue   invariants that other parts read; their results lie in memory
//! body       carried slots, rows of outputs and the test for failure; no other outputs
//! last       everything
//!
//! block | first area of carried slots | second area | hoisted values | end
//! ```

use crate::ir::cfg::Rows;
use crate::ir::hash::HashSet;
use crate::ir::variance::{Slots, Variance, propagate};
use abi::Slot;
use std::hash::Hash;

/// A straight line of nodes in topological order.
pub trait StraightLine {
    /// Stands for the result of a node.
    type Node: Copy + Eq + Hash;
    /// Number of nodes.
    fn count(&self) -> usize;
    /// The index of a node, below `count`.
    fn index(node: Self::Node) -> usize;
    /// The nodes that the node with this index reads.
    fn operands(&self, index: usize) -> Vec<Self::Node>;
    /// Whether the value is read from memory at each use, as constants and loads are.
    fn is_leaf(&self, node: Self::Node) -> bool;
    /// The slot, if the node with this index is a load.
    fn load(&self, index: usize) -> Option<Slot>;
    /// The stores.
    fn stores(&self) -> &[(Slot, Self::Node)];
    /// The status.
    fn status(&self) -> Option<Self::Node>;
    /// What is tested after each step: a lane has failed if it is set.
    fn failed(&self) -> Option<Self::Node>;
    /// Orders those of the `wanted` nodes that `roots` need.
    fn schedule(&self, roots: &[Self::Node], wanted: &[bool]) -> Vec<Self::Node>;
}

/// The parts of the loop. Offsets are in bytes from the start of the block.
pub struct LoopPlan<N> {
    /// Slots that one step passes to the next, with the stored node.
    pub carried: Vec<(Slot, N)>,
    /// Columns of the rows of outputs, with the stored node. Those of slots that no step stores are not among them.
    pub recorded: Vec<(usize, N)>,
    /// Invariants that later parts read, in the order of their places in memory.
    pub hoisted: Vec<N>,
    /// The nodes before the loop.
    pub prologue: Vec<N>,
    /// The nodes of each step but the last.
    pub body: Vec<N>,
    /// The nodes of the last step.
    pub last: Vec<N>,
    /// The two areas of carried slots.
    pub areas: [usize; 2],
    /// The hoisted values.
    pub hoisted_at: usize,
    /// The end of the hoisted values.
    pub end: usize,
}

/// Plans the loop over a step. `size`: slots of the block. `vectors`: bytes of all vectors of one value. `rows`: inputs that
/// each step reads from a row, and outputs that it writes to one.
pub fn plan<L: StraightLine>(line: &L, size: usize, vectors: usize, rows: Option<&Rows>) -> LoopPlan<L::Node> {
    let loaded: HashSet<Slot> = (0..line.count()).filter_map(|i| line.load(i)).collect();
    let carried: Vec<(Slot, L::Node)> =
        line.stores().iter().copied().filter(|(slot, _)| loaded.contains(slot)).collect();
    let stored = |slot: Slot| line.stores().iter().find(|(known, _)| *known == slot).map(|(_, node)| *node);
    let columns = rows.map_or(&[][..], |rows| &rows.outputs).iter().enumerate();
    let recorded: Vec<(usize, L::Node)> = columns.filter_map(|(column, slot)| Some((column, stored(*slot)?))).collect();
    // Without carried slots and rows a single iteration is enough, so nothing is hoisted.
    let is_single = carried.is_empty() && rows.is_none();
    let in_rows = rows.map_or(&[][..], |rows| &rows.inputs);
    let slots = Slots::new(line.stores().iter().map(|(slot, _)| *slot), None).reading_rows(in_rows);
    let own = |i: usize| line.load(i).map_or(Variance::Parameters, |slot| slots.of(slot));
    let operands = |i: usize, each: &mut dyn FnMut(usize)| {
        line.operands(i).into_iter().for_each(|operand| each(L::index(operand)));
    };
    let variance = propagate(line.count(), own, operands);
    let variant: Vec<bool> = variance.into_iter().map(|variance| is_single || !variance.is_invariant()).collect();
    let each = carried.iter().map(|(_, node)| *node).chain(recorded.iter().map(|(_, node)| *node));
    let roots: Vec<L::Node> = each.chain(line.failed()).collect();
    let body = line.schedule(&roots, &variant);
    let results: Vec<L::Node> = line.stores().iter().map(|(_, node)| *node).chain(line.status()).collect();
    let last = line.schedule(&results, &variant);
    let read = body.iter().chain(&last).flat_map(|node| line.operands(L::index(*node)));
    let mut seen = HashSet::default();
    let hoisted: Vec<L::Node> = read
        .chain(results.iter().copied())
        .chain(line.failed())
        .filter(|node| !variant[L::index(*node)] && !line.is_leaf(*node) && seen.insert(*node))
        .collect();
    let prologue = line.schedule(&hoisted, &variant.iter().map(|variant| !variant).collect::<Vec<_>>());
    let areas = [0, 1].map(|area| (size + area * carried.len()) * vectors);
    let hoisted_at = areas[1] + carried.len() * vectors;
    let end = hoisted_at + hoisted.len() * vectors;
    LoopPlan { carried, recorded, hoisted, prologue, body, last, areas, hoisted_at, end }
}
