//! In which order operations are computed, so that few results wait at a time.

use super::select::{Node, Nodes};

/// What roots need of the nodes that are wanted, loads and constants apart: each root's own in one piece, operands first, of
/// these the one that needs most registers, so that few others wait meanwhile (Sethi and Ullman, 1970).
pub fn order(nodes: &Nodes, roots: &[Node], wanted: &[bool]) -> Vec<Node> {
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
    behind_operands(roots, nodes.nodes.len(), Node::index, is_read, operands)
}

/// What roots need, each behind its operands and once, each root's own in one piece; `index` tells nodes apart, of which there
/// are `count`, what `is_read` stands nowhere, and `operands` come in the order in which they are wanted.
pub fn behind_operands<N: Copy>(
    roots: &[N],
    count: usize,
    index: impl Fn(N) -> usize,
    is_read: impl Fn(N) -> bool,
    operands: impl Fn(N) -> Vec<N>,
) -> Vec<N> {
    let mut done = vec![false; count];
    let mut out = Vec::new();
    for root in roots {
        let mut open = vec![(*root, false)];
        while let Some((node, ready)) = open.pop() {
            if done[index(node)] || is_read(node) {
                continue;
            }
            if ready {
                done[index(node)] = true;
                out.push(node);
                continue;
            }
            open.push((node, true));
            // The last pushed is done first.
            open.extend(operands(node).into_iter().rev().map(|operand| (operand, false)));
        }
    }
    out
}
