//! Takes a step apart by the regimes of its automata: for each regime, the operations that are left of it.
//!
//! In: a sound, expanded function. Out: the same with more operations, and for each slot that is only compared with
//! constants and chosen what it needs for each of these constants. What depends on several of them, and what depends on none
//! but is needed elsewhere too, stays one list. It knows nothing of processors.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::{HashMap, HashSet};

/// A function whose operations are taken apart.
pub struct Apart {
    /// The function; behind its own operations those of single regimes.
    pub func: Func,
    /// What depends on no regime, in order.
    pub before: Vec<Value>,
    /// What depends on one each.
    pub automata: Vec<Automaton>,
    /// What depends on several.
    pub behind: Vec<Value>,
}

/// What depends on what one slot holds.
pub struct Automaton {
    /// The slot.
    pub slot: Slot,
    /// Its values that something else needs.
    pub outputs: Vec<Value>,
    /// For numbers that the slot may hold, by their bits: what is computed then.
    pub cases: Vec<(u64, Case)>,
    /// And for all others.
    pub general: Case,
}

/// Operations for one regime, each behind its operands, and what the outputs are.
pub struct Case {
    /// What is computed, in order.
    pub list: Vec<Value>,
    /// For each output of the automaton what it is.
    pub outputs: Vec<Value>,
}

/// Most regimes of an automaton that are told apart.
const MOST: usize = 4;
/// Fewest operations that are worth a jump.
const FEWEST: usize = 6;

/// Where an operation stands.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Place {
    Before,
    Within(usize),
    Behind,
    /// It is computed elsewhere, or never.
    Elsewhere,
}

/// Takes a function apart; `late` are operations that are not wanted.
pub fn apart(func: &Func, late: &[bool]) -> Apart {
    let all = || (0..func.ops.len()).map(|i| Value(i as u32));
    let slots = automata(func);
    let mut places = dependent(func, late, &slots);
    for k in 0..slots.len() {
        let members = places.iter().filter(|place| **place == Place::Within(k)).count();
        if members < FEWEST {
            places.iter_mut().filter(|place| **place == Place::Within(k)).for_each(|place| *place = Place::Behind);
        }
    }
    // What depends on no regime but is needed in one alone is computed there.
    let mut users: Vec<Option<Place>> = vec![None; func.ops.len()];
    let used = |value: Value, by: Place, users: &mut Vec<Option<Place>>| {
        let known = &mut users[value.index()];
        *known = Some(known.map_or(by, |known| if known == by { known } else { Place::Before }));
    };
    func.results().for_each(|value| used(value, Place::Before, &mut users));
    for value in all().rev() {
        let i = value.index();
        if let (Place::Before, Some(Place::Within(k))) = (places[i], users[i])
            && !is_constant(func.ops[i])
        {
            places[i] = Place::Within(k);
        }
        let by = places[i];
        func.ops[i].each_operand(|operand| used(operand, by, &mut users));
    }
    let mut needed: Vec<HashSet<Value>> = vec![HashSet::new(); slots.len()];
    let mut note = |value: Value, by: Place| {
        if let Place::Within(k) = places[value.index()]
            && by != Place::Within(k)
        {
            needed[k].insert(value);
        }
    };
    func.results().for_each(|value| note(value, Place::Before));
    for value in all() {
        func.op(value).each_operand(|operand| note(operand, places[value.index()]));
    }
    let listed = |place: Place| -> Vec<Value> { all().filter(|value| places[value.index()] == place).collect() };
    let mut build = Build::of(func);
    let automata = slots.iter().zip(needed).enumerate().filter(|(_, (_, needed))| !needed.is_empty());
    let automata = automata
        .map(|(k, ((load, numbers), needed))| {
            let members = listed(Place::Within(k));
            let mut outputs: Vec<Value> = needed.into_iter().collect();
            outputs.sort_unstable();
            let case = |bits: &u64| (*bits, case(&mut build, func, &places, (*load, *bits), &members, &outputs));
            let Op::Load(slot) = func.op(*load) else { unreachable!("it is a load") };
            let cases = numbers.iter().map(case).collect();
            Automaton { slot, outputs: outputs.clone(), cases, general: Case { list: members, outputs } }
        })
        .collect();
    let ops = build.into_ops();
    Apart { func: Func { ops, ..func.clone() }, before: listed(Place::Before), automata, behind: listed(Place::Behind) }
}

fn is_constant(op: Op) -> bool {
    matches!(op, Op::Real(_) | Op::Int(_) | Op::Bool(_))
}

/// Loads that are only compared with constants and chosen, and these constants, by their bits.
fn automata(func: &Func) -> Vec<(Value, Vec<u64>)> {
    let mut found: HashMap<Value, Option<Vec<u64>>> = HashMap::new();
    for op in &func.ops {
        let compared = match *op {
            Op::Equal(a, b) => match (func.op(a), func.op(b)) {
                (Op::Load(_), Op::Real(bits)) => Some((a, bits)),
                (Op::Real(bits), Op::Load(_)) => Some((b, bits)),
                _ => None,
            },
            _ => None,
        };
        if let Some((load, bits)) = compared {
            let numbers = found.entry(load).or_insert_with(|| Some(Vec::new()));
            numbers.iter_mut().filter(|numbers| !numbers.contains(&bits)).for_each(|numbers| numbers.push(bits));
        } else if !matches!(op, Op::Select(..)) {
            op.each_operand(|operand| {
                if matches!(func.op(operand), Op::Load(_)) {
                    found.insert(operand, None);
                }
            });
        }
    }
    let told = |(load, numbers): (Value, Option<Vec<u64>>)| Some((load, numbers.filter(|it| it.len() <= MOST)?));
    let mut found: Vec<(Value, Vec<u64>)> = found.into_iter().filter_map(told).collect();
    found.sort_unstable();
    found
}

/// On which automata operations depend: on none, one or several.
fn dependent(func: &Func, late: &[bool], automata: &[(Value, Vec<u64>)]) -> Vec<Place> {
    let number: HashMap<Value, usize> = automata.iter().enumerate().map(|(k, (load, _))| (*load, k)).collect();
    let mut of: Vec<Place> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut place = Place::Before;
        op.each_operand(|operand| {
            let of = number.get(&operand).map_or(of[operand.index()], |k| Place::Within(*k));
            place = match (place, of) {
                (Place::Before, of) => of,
                (place, Place::Before) => place,
                (place, of) if place == of => place,
                _ => Place::Behind,
            };
        });
        of.push(place);
    }
    for (place, _) in of.iter_mut().zip(late).filter(|(_, late)| **late) {
        *place = Place::Elsewhere;
    }
    of
}

/// What is left of the members where the slot holds this number.
fn case(
    build: &mut Build,
    func: &Func,
    places: &[Place],
    (load, bits): (Value, u64),
    members: &[Value],
    outputs: &[Value],
) -> Case {
    let mut left: HashMap<Value, Value> = HashMap::from([(load, build.op(Op::Real(bits)))]);
    for member in members {
        let op = func.op(*member);
        let now = op.map(|operand| left.get(&operand).copied().unwrap_or(operand));
        if now != op {
            left.insert(*member, build.op(now));
        }
    }
    let outputs: Vec<Value> = outputs.iter().map(|output| left.get(output).copied().unwrap_or(*output)).collect();
    // What stands before is there.
    let there = |value: Value| places.get(value.index()).is_some_and(|place| *place == Place::Before);
    let mut list = HashSet::new();
    let mut open = outputs.clone();
    while let Some(value) = open.pop() {
        let op = build.get(value);
        if !there(value) && !is_constant(op) && list.insert(value) {
            op.each_operand(|operand| open.push(operand));
        }
    }
    let mut list: Vec<Value> = list.into_iter().collect();
    list.sort_unstable();
    Case { list, outputs }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A spring in slot 3 that moves while slot 4, its regime, is 0, and is `held` by slot 5 in any other.
    #[test]
    fn each_regime_has_only_what_is_left_of_it() {
        let mut build = Build::new("step");
        let [x, regime, v, w] = [3, 4, 5, 6].map(|slot| build.load(Slot(slot)));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let (sticks, slides) = (build.equal(regime, zero), build.equal(regime, one));
        let squared = build.mul(v, v);
        let moved = build.fma(squared, v, x);
        let slid = build.mul(w, x);
        let other = build.select(slides, slid, x);
        let next = build.select(sticks, moved, other);
        let far = build.less(w, next);
        let changed = build.select(far, one, regime);
        build.store(Slot(3), next);
        build.store(Slot(4), changed);
        let func = build.finish();
        let apart = apart(&func, &vec![false; func.ops.len()]);
        let [automaton] = &apart.automata[..] else { panic!("one automaton") };
        assert_eq!((automaton.slot, &apart.behind[..]), (Slot(4), &[][..]));
        let shown = |case: &Case| -> Vec<String> {
            case.list.iter().map(|value| apart.func.op(*value).to_string()).map(|op| op[..3].to_string()).collect()
        };
        let cases: Vec<(f64, Vec<String>)> =
            automaton.cases.iter().map(|(bits, case)| (f64::from_bits(*bits), shown(case))).collect();
        let words = |text: &str| text.split(' ').map(String::from).collect::<Vec<_>>();
        assert_eq!(cases, [(0.0, words("loa loa loa mul fma les sel")), (1.0, words("loa loa mul"))]);
        assert_eq!(shown(&automaton.general).iter().filter(|op| *op == "sel").count(), 3);
    }
}
