//! Scheduling: orders the operations of a straight line such that few values are live at a time.
//!
//! In: selected nodes and the roots that are needed. Out: the order. It does not know how many registers there are.
//!
//! Source: Sethi, Ullman, *The Generation of Optimal Code for Arithmetic Expressions*, JACM, 1970.

use crate::codegen::lanes::isel::{MachineOp, NodeId, Nodes};
use crate::codegen::loop_plan::StraightLine;
use crate::ir::scc::topological_order;
use abi::Slot;

/// Orders those of the `wanted` nodes that `roots` need, loads and constants excepted. The nodes of each root are
/// adjacent, operands first. Of several operands the one that needs most registers comes first.
pub fn schedule(nodes: &Nodes, roots: &[NodeId], wanted: &[bool]) -> Vec<NodeId> {
    let is_read = |node: NodeId| !wanted[node.index()] || nodes.nodes[node.index()].is_leaf();
    // Sethi–Ullman number: registers that computing a node takes, if no value is shared.
    let mut need = vec![0; nodes.nodes.len()];
    for (index, node) in nodes.nodes.iter().enumerate() {
        // A node that is not wanted is in memory, as a leaf is, and takes none.
        let most = by_need(*node, &need).enumerate().map(|(before, operand)| need[operand.index()] + before).max();
        need[index] = if is_read(NodeId(index as u32)) { 0 } else { most.unwrap_or(0).max(1) };
    }
    let operands = |node: NodeId| by_need(nodes.nodes[node.index()], &need);
    topological_order(roots, nodes.nodes.len(), NodeId::index, is_read, operands)
}

/// The operands of a node, those that need most registers first.
fn by_need(node: MachineOp, need: &[usize]) -> impl DoubleEndedIterator<Item = NodeId> {
    let (mut operands, mut count) = ([NodeId(0); 3], 0);
    for operand in node.operands() {
        operands[count] = operand;
        count += 1;
    }
    operands[..count].sort_by_key(|operand| std::cmp::Reverse(need[operand.index()]));
    operands.into_iter().take(count)
}

impl StraightLine for Nodes {
    type Node = NodeId;

    fn count(&self) -> usize {
        self.nodes.len()
    }

    fn index(node: NodeId) -> usize {
        node.index()
    }

    fn operands(&self, index: usize) -> Vec<NodeId> {
        self.nodes[index].operands().collect()
    }

    fn is_leaf(&self, node: NodeId) -> bool {
        self.nodes[node.index()].is_leaf()
    }

    fn load(&self, index: usize) -> Option<Slot> {
        if let MachineOp::Load(slot) = self.nodes[index] { Some(slot) } else { None }
    }

    fn stores(&self) -> &[(Slot, NodeId)] {
        &self.stores
    }

    fn status(&self) -> Option<NodeId> {
        self.status
    }

    fn failed(&self) -> Option<NodeId> {
        self.failed
    }

    fn schedule(&self, roots: &[NodeId], wanted: &[bool]) -> Vec<NodeId> {
        schedule(self, roots, wanted)
    }
}
