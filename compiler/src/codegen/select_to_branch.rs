//! Which operations only one side of a choice needs.
//!
//! In: a list of operations, each behind its operands. Out: [`BranchRegions`], by which code computes of a choice only the side that is
//! chosen. It knows nothing of processors.

use crate::ir::{Op, Value};
use std::collections::{HashMap, HashSet};

/// Which operations of a list only one side of a choice needs: these are written where that side is taken. A choice whose
/// sides are short stays one operation: it costs less than to foresee the side.
pub struct BranchRegions {
    /// The operations of each side, in order; first those of no side.
    pub members: Vec<Vec<Value>>,
    /// The two sides of a choice that is taken apart.
    pub of_choice: HashMap<Value, [usize; 2]>,
    /// Choices that stand behind each other and ask the same are taken apart together: those of the first of them.
    pub together: HashMap<Value, Vec<Value>>,
}

/// Operations, by their cost, from which on a side is long.
const LONG_SIDE: u32 = 4;
/// Choices within choices, at most.
const DEEPEST: usize = 24;

impl BranchRegions {
    /// Of a list of operations, of which `outputs` are read elsewhere.
    pub fn of(ops: &[Op], list: &[Value], outputs: &[Value]) -> BranchRegions {
        let op = |value: Value| ops[value.index()];
        // A side has its choice, and which of its operands it is; 0 is no side.
        struct Side {
            choice: Value,
            within: usize,
            depth: usize,
            cost: u32,
        }
        let mut sides = vec![Side { choice: Value(0), within: 0, depth: 0, cost: 0 }];
        let mut of_choice: HashMap<Value, [usize; 2]> = HashMap::new();
        // The innermost side that holds all uses so far of a value; none: no use yet.
        let mut side_of: HashMap<Value, Option<usize>> = list.iter().map(|value| (*value, None)).collect();
        let common = |sides: &[Side], mut a: usize, mut b: usize| {
            while a != b {
                if sides[a].depth >= sides[b].depth { a = sides[a].within } else { b = sides[b].within }
            }
            a
        };
        // What is read elsewhere belongs to no side.
        for output in outputs {
            if let Some(side) = side_of.get_mut(output) {
                *side = Some(0);
            }
        }
        let (together, mut followers) = (together(ops, list), HashSet::new());
        followers.extend(together.values().flat_map(|choices| &choices[1..]).copied());
        for value in list.iter().rev() {
            if followers.contains(value) {
                continue;
            }
            let choices = together.get(value).map_or(std::slice::from_ref(value), |choices| choices);
            let uses = choices.iter().filter_map(|choice| side_of[choice]);
            let own = uses.reduce(|a, b| common(&sides, a, b)).unwrap_or(0);
            for choice in choices {
                side_of.insert(*choice, Some(own));
                sides[own].cost += op(*choice).effort();
            }
            let mut used = |operand: Value, at: usize, sides: &[Side]| {
                if let Some(known) = side_of.get_mut(&operand) {
                    *known = Some(known.map_or(at, |known| common(sides, known, at)));
                }
            };
            match op(*value) {
                Op::Select(when, yes, no)
                    if sides[own].depth < DEEPEST && (choices.len() > 1 || yes != no && when != yes && when != no) =>
                {
                    let depth = sides[own].depth + 1;
                    let first = sides.len();
                    sides.extend([(); 2].map(|()| Side { choice: *value, within: own, depth, cost: 0 }));
                    of_choice.insert(*value, [first, first + 1]);
                    used(when, own, &sides);
                    for choice in choices {
                        let Op::Select(_, yes, no) = op(*choice) else { unreachable!("it is a choice") };
                        used(yes, first, &sides);
                        used(no, first + 1, &sides);
                    }
                }
                Op::Select(when, ..) if choices.len() > 1 => {
                    used(when, own, &sides);
                    for choice in choices {
                        op(*choice).each_operand(|operand| used(operand, own, &sides));
                    }
                }
                other => other.each_operand(|operand| used(operand, own, &sides)),
            }
        }
        // Short sides are no sides: what they hold belongs to what they lie in. Inner sides stand behind outer ones.
        for side in (1..sides.len()).rev() {
            let (within, cost) = (sides[side].within, sides[side].cost);
            sides[within].cost += cost;
        }
        let long = |side: usize| sides[side].cost >= LONG_SIDE;
        // What asks several questions is taken apart in any case: a jump for each costs less than to put them together.
        let compound = |choice: Value| match op(choice) {
            Op::Select(when, ..) => matches!(op(when), Op::And(..) | Op::Or(..)),
            _ => false,
        };
        // So is each question by which a place in a table is found: most often it is where it was, and nothing waits for it.
        let seeks = |choice: Value| match op(choice) {
            Op::Select(_, yes, no) => match (op(yes), op(no)) {
                (Op::Int(_), Op::Int(_)) => true,
                (Op::IntAdd(from, _), _) => from == no,
                _ => false,
            },
            _ => false,
        };
        of_choice.retain(|choice, pair| compound(*choice) || seeks(*choice) || pair.iter().any(|side| long(*side)));
        let kept = |mut side: usize| {
            while side != 0 && !of_choice.contains_key(&sides[side].choice) {
                side = sides[side].within;
            }
            side
        };
        let mut members = vec![Vec::new(); sides.len()];
        for value in list {
            members[kept(side_of[value].unwrap_or(0))].push(*value);
        }
        BranchRegions { members, of_choice, together }
    }
}

/// Choices of a list that stand behind each other and ask the same, if none chooses another: by the first of them.
fn together(ops: &[Op], list: &[Value]) -> HashMap<Value, Vec<Value>> {
    let mut together: HashMap<Value, Vec<Value>> = HashMap::new();
    let mut run: Vec<Value> = Vec::new();
    let mut asked = None;
    for value in list {
        let now = match ops[value.index()] {
            Op::Select(when, yes, no) if when != yes && when != no => {
                let apart = ![yes, no].iter().any(|side| run.contains(side));
                (apart || run.is_empty()).then_some(when)
            }
            _ => None,
        };
        if now.is_none() || now != asked {
            run.clear();
        }
        asked = now;
        if now.is_some() {
            run.push(*value);
            if run.len() > 1 {
                together.insert(run[0], run.clone());
            }
        }
    }
    together
}
