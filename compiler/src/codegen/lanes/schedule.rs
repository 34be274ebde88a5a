//! In which order operations are computed, so that few results wait at a time.

use crate::codegen::lanes::isel::{Node, Nodes};
use crate::ir::scc::topological_order;

/// What roots need of the nodes that are wanted, loads and constants apart: each root's own in one piece, operands first, of
/// these the one that needs most registers, so that few others wait meanwhile (Sethi and Ullman, 1970).
pub fn schedule(nodes: &Nodes, roots: &[Node], wanted: &[bool]) -> Vec<Node> {
    let is_read = |node: Node| !wanted[node.index()] || nodes.nodes[node.index()].is_leaf();
    // Registers that a node takes while it is computed, if nothing is shared.
    let mut need = vec![0; nodes.nodes.len()];
    for (index, node) in nodes.nodes.iter().enumerate() {
        // What stands behind it is a leaf.
        let mut of: Vec<usize> = node.operands().map(|operand| need[operand.index()]).collect();
        of.sort_unstable_by(|a, b| b.cmp(a));
        let most = of.iter().enumerate().map(|(before, need)| need + before).max();
        need[index] = if is_read(Node(index as u32)) { 0 } else { most.unwrap_or(0).max(1) };
    }
    let operands = |node: Node| {
        let mut operands: Vec<Node> = nodes.nodes[node.index()].operands().collect();
        operands.sort_by_key(|operand| std::cmp::Reverse(need[operand.index()]));
        operands
    };
    topological_order(roots, nodes.nodes.len(), Node::index, is_read, operands)
}
