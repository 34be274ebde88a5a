//! Turns selects with expensive arms into branches (reverse if-conversion).
//!
//! In: blocks. Out: a block that computes a select with an expensive arm becomes a branch, a block for each arm, with the
//! operations that only this arm needs, and a block of which the select is a parameter. The straight pieces of an
//! outlined function compute both arms, because each of their branches would be one of very many. It knows nothing of
//! processors.
//!
//! Source: Warter, Mahlke, Hwu, Rau, *Reverse If-Conversion*, PLDI 1993.

use crate::ir::cfg::{Block, BlockId, Cfg, Part, Run, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::value_map::{ValueMap, ValueSet};
use crate::ir::{Op, Value};

/// Turns selects of all blocks into branches.
pub fn select_to_branch(cfg: &mut Cfg) {
    if !cfg.ops.iter().any(|op| matches!(op, Op::Select(..))) {
        return;
    }
    let mut straight: HashSet<BlockId> = HashSet::default();
    for piece in &cfg.pieces {
        let order = cfg.order(*piece);
        if cfg.head(&order).is_none() {
            straight.extend(order);
        }
    }
    // Made once, because each run is short.
    let (mut read, mut position) = (ValueSet::new(cfg.ops.len()), ValueMap::new(cfg.ops.len()));
    for (id, live_out) in cfg.live_out().into_iter().enumerate() {
        let id = BlockId(id as u32);
        if straight.contains(&id) {
            continue;
        }
        let block = &mut cfg.blocks[id.index()];
        let runs = Run::all(std::mem::take(&mut block.insts));
        let (part, end) = (block.part, std::mem::replace(&mut block.end, Terminator::Return(None)));
        // What is read after each run, from the end of the block.
        read.clear();
        read.add(live_out.into_iter().chain(cfg.end_uses(&end)));
        let mut outputs: Vec<Vec<usize>> = Vec::new();
        for run in runs.iter().rev() {
            read.add(run.effect.iter().flat_map(|inst| cfg.uses(inst)));
            outputs.push((0..run.list.len()).filter(|at| read.contains(run.list[*at])).collect());
            read.add(run.list.iter().flat_map(|value| cfg.uses(&run.inst(*value))));
        }
        let mut at = id;
        for (run, outputs) in runs.into_iter().zip(outputs.into_iter().rev()) {
            position.clear();
            run.list.iter().enumerate().for_each(|(at, value)| _ = position.insert(*value, at));
            let regions = BranchRegions::of(|value| run.op(&cfg.ops, value), &run.list, &position, &outputs);
            at = write(cfg, (&run, &regions, 0), part, at);
            cfg.blocks[at.index()].insts.extend(run.effect);
        }
        cfg.blocks[at.index()].end = end;
    }
}

/// Writes the operations of one region at the end of a block; region 0 holds those that run unconditionally. Returns the
/// block in which they end.
fn write(cfg: &mut Cfg, (run, regions, number): (&Run, &BranchRegions, usize), part: Part, mut at: BlockId) -> BlockId {
    let mut done = 0;
    for value in &regions.members[number] {
        // Selects that were written together with an earlier one.
        if done > 0 {
            done -= 1;
            continue;
        }
        let Some(arms) = regions.arms.get(value) else {
            cfg.blocks[at.index()].insts.push(run.inst(*value));
            continue;
        };
        let choices = regions.merged.get(value).map_or(std::slice::from_ref(value), |choices| choices);
        done = choices.len() - 1;
        let select = |cfg: &Cfg, choice: Value| match cfg.op(choice) {
            Op::Select(when, yes, no) => (when, [yes, no]),
            op => unreachable!("{op} is no select"),
        };
        let params = choices.to_vec();
        let after = cfg.block(Block { part, params, insts: Vec::new(), end: Terminator::Return(None) });
        let when = select(cfg, *value).0;
        let [yes, no] = [0, 1].map(|which| {
            let arm = cfg.empty(part);
            let last = write(cfg, (run, regions, arms[which]), part, arm);
            let args = choices.iter().map(|choice| select(cfg, *choice).1[which]).collect();
            cfg.blocks[last.index()].end = Terminator::Jump(Target { block: after, args });
            arm.into()
        });
        cfg.blocks[at.index()].end = Terminator::Branch { when, yes, no };
        at = after;
    }
    at
}

/// Regions of a list of operations: each arm of a select that becomes a branch is a region, with the operations that
/// only this arm needs. A select with cheap arms stays one operation, which costs less than a mispredicted branch.
struct BranchRegions {
    /// The operations of each region, in order; region 0 holds those that run unconditionally.
    members: Vec<Vec<Value>>,
    /// The regions of the true and the false arm of a select that becomes a branch.
    arms: HashMap<Value, [usize; 2]>,
    /// Adjacent selects on the same condition share one branch: by the first of them, all of them.
    merged: HashMap<Value, Vec<Value>>,
}

/// Minimum cost of an expensive arm, as [`Op::effort`].
const EXPENSIVE_ARM: u32 = 4;
/// Maximum depth of nested branches.
const MAX_DEPTH: usize = 24;

impl BranchRegions {
    /// The regions of a list of operations; `position`: of each value in it. Those at the positions `outputs` are read
    /// elsewhere.
    fn of(op: impl Fn(Value) -> Op, list: &[Value], position: &ValueMap<usize>, outputs: &[usize]) -> BranchRegions {
        // A region belongs to one arm of a select; region 0 to none.
        struct Region {
            select: Value,
            within: usize,
            depth: usize,
            cost: u32,
        }
        let mut regions = vec![Region { select: Value(0), within: 0, depth: 0, cost: 0 }];
        let mut arms: HashMap<Value, [usize; 2]> = HashMap::default();
        // For each position, the innermost region that contains all uses seen so far; none: no use yet.
        let mut region_of: Vec<Option<usize>> = vec![None; list.len()];
        let common = |regions: &[Region], mut a: usize, mut b: usize| {
            while a != b {
                if regions[a].depth >= regions[b].depth { a = regions[a].within } else { b = regions[b].within }
            }
            a
        };
        // Values that are read elsewhere are computed unconditionally.
        outputs.iter().for_each(|at| region_of[*at] = Some(0));
        let (merged, mut followers) = (merged(&op, list), HashSet::default());
        followers.extend(merged.values().flat_map(|selects| &selects[1..]).copied());
        for (at, value) in list.iter().enumerate().rev() {
            if followers.contains(value) {
                continue;
            }
            let selects = merged.get(value).map_or(std::slice::from_ref(value), |selects| selects);
            // Merged selects are adjacent.
            let of_selects = &mut region_of[at..at + selects.len()];
            let own = of_selects.iter().filter_map(|of| *of).reduce(|a, b| common(&regions, a, b)).unwrap_or(0);
            of_selects.fill(Some(own));
            regions[own].cost += selects.iter().map(|select| op(*select).effort()).sum::<u32>();
            let mut used = |operand: Value, by: usize, regions: &[Region]| {
                if let Some(at) = position.get(operand) {
                    region_of[at] = Some(region_of[at].map_or(by, |known| common(regions, known, by)));
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
        for (value, region) in list.iter().zip(region_of) {
            members[enclosing(region.unwrap_or(0))].push(*value);
        }
        BranchRegions { members, arms, merged }
    }
}

/// Runs of adjacent selects on the same condition, none of which reads another of its run: by the first of the run.
fn merged(op: impl Fn(Value) -> Op, list: &[Value]) -> HashMap<Value, Vec<Value>> {
    let mut merged: HashMap<Value, Vec<Value>> = HashMap::default();
    let mut run: Vec<Value> = Vec::new();
    let mut condition = None;
    for value in list {
        let now = match op(*value) {
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
