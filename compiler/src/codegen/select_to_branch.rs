//! Turns selects with expensive arms into branches (reverse if-conversion).
//!
//! In: a list of operations in topological order. Out: [`BranchRegions`]: which operations only one arm of a select
//! needs, so that generated code computes only the arm that is taken. It knows nothing of processors.
//!
//! Source: Warter, Mahlke, Hwu, Rau, *Reverse If-Conversion*, PLDI 1993.

use crate::ir::{Op, Value};
use std::collections::{HashMap, HashSet};

/// Regions of a list of operations: each arm of a select that becomes a branch is a region, with the operations that
/// only this arm needs. A select with cheap arms stays one operation, which costs less than a mispredicted branch.
pub struct BranchRegions {
    /// The operations of each region, in order; region 0 holds those that run unconditionally.
    pub members: Vec<Vec<Value>>,
    /// The regions of the true and the false arm of a select that becomes a branch.
    pub arms: HashMap<Value, [usize; 2]>,
    /// Adjacent selects on the same condition share one branch: by the first of them, all of them.
    pub merged: HashMap<Value, Vec<Value>>,
}

/// Minimum cost of an expensive arm, as [`Op::effort`].
const EXPENSIVE_ARM: u32 = 4;
/// Maximum depth of nested branches.
const MAX_DEPTH: usize = 24;

impl BranchRegions {
    /// The regions of a list of operations, of which `outputs` are read elsewhere.
    pub fn of(ops: &[Op], list: &[Value], outputs: &[Value]) -> BranchRegions {
        let op = |value: Value| ops[value.index()];
        // A region belongs to one arm of a select; region 0 to none.
        struct Region {
            select: Value,
            within: usize,
            depth: usize,
            cost: u32,
        }
        let mut regions = vec![Region { select: Value(0), within: 0, depth: 0, cost: 0 }];
        let mut arms: HashMap<Value, [usize; 2]> = HashMap::new();
        // The innermost region that contains all uses of a value seen so far; none: no use yet.
        let mut region_of: HashMap<Value, Option<usize>> = list.iter().map(|value| (*value, None)).collect();
        let common = |regions: &[Region], mut a: usize, mut b: usize| {
            while a != b {
                if regions[a].depth >= regions[b].depth { a = regions[a].within } else { b = regions[b].within }
            }
            a
        };
        // Values that are read elsewhere are computed unconditionally.
        for output in outputs {
            if let Some(region) = region_of.get_mut(output) {
                *region = Some(0);
            }
        }
        let (merged, mut followers) = (merged(ops, list), HashSet::new());
        followers.extend(merged.values().flat_map(|selects| &selects[1..]).copied());
        for value in list.iter().rev() {
            if followers.contains(value) {
                continue;
            }
            let selects = merged.get(value).map_or(std::slice::from_ref(value), |selects| selects);
            let uses = selects.iter().filter_map(|select| region_of[select]);
            let own = uses.reduce(|a, b| common(&regions, a, b)).unwrap_or(0);
            for select in selects {
                region_of.insert(*select, Some(own));
                regions[own].cost += op(*select).effort();
            }
            let mut used = |operand: Value, at: usize, regions: &[Region]| {
                if let Some(known) = region_of.get_mut(&operand) {
                    *known = Some(known.map_or(at, |known| common(regions, known, at)));
                }
            };
            match op(*value) {
                Op::Select(when, yes, no)
                    if regions[own].depth < MAX_DEPTH
                        && (selects.len() > 1 || yes != no && when != yes && when != no) =>
                {
                    let depth = regions[own].depth + 1;
                    let first = regions.len();
                    regions.extend([(); 2].map(|()| Region { select: *value, within: own, depth, cost: 0 }));
                    arms.insert(*value, [first, first + 1]);
                    used(when, own, &regions);
                    for select in selects {
                        let Op::Select(_, yes, no) = op(*select) else { unreachable!("it is a select") };
                        used(yes, first, &regions);
                        used(no, first + 1, &regions);
                    }
                }
                Op::Select(when, ..) if selects.len() > 1 => {
                    used(when, own, &regions);
                    for select in selects {
                        op(*select).each_operand(|operand| used(operand, own, &regions));
                    }
                }
                other => other.each_operand(|operand| used(operand, own, &regions)),
            }
        }
        // Cheap arms are dissolved: their operations move to the enclosing region. Inner regions have higher numbers
        // than outer ones.
        for region in (1..regions.len()).rev() {
            let (within, cost) = (regions[region].within, regions[region].cost);
            regions[within].cost += cost;
        }
        let is_expensive = |region: usize| regions[region].cost >= EXPENSIVE_ARM;
        // A select on a compound condition always becomes a branch: short-circuit branches cost less than combining the
        // tests.
        let is_compound = |select: Value| match op(select) {
            Op::Select(when, ..) => matches!(op(when), Op::And(..) | Op::Or(..)),
            _ => false,
        };
        // So does a select that searches for an index in a table: the index rarely changes between steps, so the branch
        // is predicted and the search is off the critical path.
        let is_search = |select: Value| match op(select) {
            Op::Select(_, yes, no) => match (op(yes), op(no)) {
                (Op::Int(_), Op::Int(_)) => true,
                (Op::IntAdd(from, _), _) => from == no,
                _ => false,
            },
            _ => false,
        };
        arms.retain(|select, pair| {
            is_compound(*select) || is_search(*select) || pair.iter().any(|region| is_expensive(*region))
        });
        let enclosing = |mut region: usize| {
            while region != 0 && !arms.contains_key(&regions[region].select) {
                region = regions[region].within;
            }
            region
        };
        let mut members = vec![Vec::new(); regions.len()];
        for value in list {
            members[enclosing(region_of[value].unwrap_or(0))].push(*value);
        }
        BranchRegions { members, arms, merged }
    }
}

/// Runs of adjacent selects on the same condition, none of which reads another of its run: by the first of the run.
fn merged(ops: &[Op], list: &[Value]) -> HashMap<Value, Vec<Value>> {
    let mut merged: HashMap<Value, Vec<Value>> = HashMap::new();
    let mut run: Vec<Value> = Vec::new();
    let mut condition = None;
    for value in list {
        let now = match ops[value.index()] {
            Op::Select(when, yes, no) if when != yes && when != no => {
                let is_independent = ![yes, no].iter().any(|arm| run.contains(arm));
                (is_independent || run.is_empty()).then_some(when)
            }
            _ => None,
        };
        if now.is_none() || now != condition {
            run.clear();
        }
        condition = now;
        if now.is_some() {
            run.push(*value);
            if run.len() > 1 {
                merged.insert(run[0], run.clone());
            }
        }
    }
    merged
}
