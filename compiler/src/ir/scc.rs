//! Graph algorithms: strongly connected components and topological order.
//!
//! In: a graph, given by its edges. Out: components, or vertices in an order of evaluation. It does not know the
//! meaning of the vertices.

/// The strongly connected components of the vertices 0..n. A component comes after all components that its edges lead
/// to. `edge(v, k)`: the target of the `k`-th edge of `v`, `None` after the last edge.
///
/// Source: Tarjan, *Depth-first search and linear graph algorithms*, 1972; here without recursion.
pub fn components(n: usize, edge: impl Fn(usize, usize) -> Option<usize>) -> Vec<Vec<usize>> {
    const NONE: u32 = u32::MAX;
    let (mut number, mut low, mut on_stack) = (vec![NONE; n], vec![0u32; n], vec![false; n]);
    let (mut stack, mut next, mut out) = (Vec::new(), 0u32, Vec::new());
    for root in 0..n {
        if number[root] != NONE {
            continue;
        }
        let mut work = vec![(root, 0usize)];
        while let Some((v, k)) = work.pop() {
            if k == 0 {
                number[v] = next;
                low[v] = next;
                next += 1;
                stack.push(v);
                on_stack[v] = true;
            } else if let Some(done) = edge(v, k - 1).filter(|done| on_stack[*done]) {
                low[v] = low[v].min(low[done]);
            }
            if let Some(w) = edge(v, k) {
                work.push((v, k + 1));
                if number[w] == NONE {
                    work.push((w, 0));
                }
                continue;
            }
            if low[v] == number[v] {
                let mut component = Vec::new();
                loop {
                    let w = stack.pop().expect("the component ends with its root");
                    on_stack[w] = false;
                    component.push(w);
                    if w == v {
                        break;
                    }
                }
                component.sort_unstable();
                out.push(component);
            }
        }
    }
    out
}

/// Depth-first postorder of a directed acyclic graph: every node that the roots need, once and after its operands. The
/// nodes that only one root needs are contiguous. `index`: a number for each node, below `count`. `is_read`: nodes to
/// leave out, with what only they need. `operands`: the operands of a node, in the order of evaluation.
pub fn topological_order<N: Copy, O: IntoIterator<Item = N, IntoIter: DoubleEndedIterator>>(
    roots: &[N],
    count: usize,
    index: impl Fn(N) -> usize,
    is_read: impl Fn(N) -> bool,
    operands: impl Fn(N) -> O,
) -> Vec<N> {
    let mut done = vec![false; count];
    let (mut open, mut out) = (Vec::new(), Vec::new());
    for root in roots {
        open.push((*root, false));
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
            // The stack is last in, first out, so the operands are pushed in reverse.
            open.extend(operands(node).into_iter().rev().map(|operand| (operand, false)));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_are_found_and_dependencies_come_first() {
        // 0 needs 1 and 4; 1, 2 and 3 need each other; 4 needs itself.
        let edges: [&[usize]; 5] = [&[1, 4], &[2], &[3, 2], &[1], &[4]];
        let found = components(5, |v, k| edges[v].get(k).copied());
        assert_eq!(found, [vec![1, 2, 3], vec![4], vec![0]]);
    }
}
