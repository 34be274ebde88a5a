//! Takes a step apart by the regimes of its automata: for each regime, the operations that are left of it.
//!
//! In: a sound, expanded function. Out: the same with more operations, and for each slot that is only compared with
//! constants and chosen what it needs for each of these constants. What depends on several of them, and what depends on none
//! but is needed elsewhere too, stays one list. It knows nothing of processors.

use crate::ir::build::Build;
use crate::ir::partial_eval::{known, partial_eval, slice};
use crate::ir::{Func, Op, Type, Value, number_asked};
use abi::Slot;
use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet};

/// A function whose operations are taken apart.
pub struct Specialised {
    /// The function; behind its own operations those of single regimes.
    pub func: Func,
    /// What depends on no regime, in order.
    pub before: Vec<Value>,
    /// What depends on one each.
    pub automata: Vec<Automaton>,
    /// What depends on several.
    pub behind: Vec<Value>,
}

impl Specialised {
    /// Behind which automaton, by its number, the values are there that depend on automata.
    pub fn stages(&self) -> HashMap<Value, usize> {
        let mut stages = HashMap::new();
        for (k, automaton) in self.automata.iter().enumerate() {
            stages.extend(automaton.outputs.iter().map(|output| (*output, k)));
        }
        for value in &self.behind {
            let mut last = None;
            self.func.op(*value).each_operand(|operand| last = last.max(stages.get(&operand).copied()));
            stages.extend(last.map(|last| (*value, last)));
        }
        stages
    }

    /// What is read behind the automaton of this number: of what depends on several, by these.
    pub fn read_behind(&self, number: usize, by: impl Fn(Value) -> bool) -> Read {
        let mut read = Read::default();
        for value in self.behind.iter().filter(|value| by(**value)) {
            read.operation(self.func.op(*value));
        }
        read.values.extend(self.func.writes.iter().flat_map(|write| [write.index, write.value]));
        for automaton in &self.automata[number + 1..] {
            read.slots.insert(automaton.slot);
            let cases = automaton.cases.iter().map(|(_, case)| case).chain([&automaton.general]);
            cases.for_each(|case| {
                case.each(&mut |case| {
                    case.list.iter().for_each(|value| read.operation(self.func.op(*value)));
                    match &case.then {
                        Then::Outputs(outputs) => read.values.extend(outputs),
                        Then::Ask(when, _) => _ = read.values.insert(*when),
                    }
                });
            });
        }
        read
    }
}

/// What is read somewhere.
#[derive(Default)]
pub struct Read {
    /// Slots of the block.
    pub slots: HashSet<Slot>,
    /// Operands.
    pub values: HashSet<Value>,
}

impl Read {
    fn operation(&mut self, op: Op) {
        if let Op::Load(slot) = op {
            self.slots.insert(slot);
        }
        op.each_operand(|operand| _ = self.values.insert(operand));
    }
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

/// Operations for one regime, each behind its operands, and what comes of them.
pub struct Case {
    /// What is computed, in order.
    pub list: Vec<Value>,
    /// What then is done.
    pub then: Then,
}

/// How a case goes on.
pub enum Then {
    /// It ends: for each output of the automaton what it is.
    Outputs(Vec<Value>),
    /// A truth that much hangs on is asked once; what is left where it is true, and where it is not.
    Ask(Value, Box<[Case; 2]>),
}

impl Case {
    /// The case and all those in it.
    pub fn each(&self, each: &mut impl FnMut(&Case)) {
        each(self);
        if let Then::Ask(_, sides) = &self.then {
            sides.iter().for_each(|side| side.each(each));
        }
    }
}

/// Most regimes of an automaton that are told apart.
const MOST: usize = 4;
/// Fewest operations that are worth a jump.
const FEWEST: usize = 6;
/// Fewest operations of a case that is taken apart by what it asks.
const FEWEST_ASKED: usize = 4;
/// Most operations of a case that is taken apart by what it asks: they stand twice then.
const LONGEST: usize = 200;
/// Questions within questions, at most.
const DEEPEST: usize = 4;

/// Where an operation stands.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Place {
    Before,
    Within(usize),
    Behind,
    /// In each regime that needs it.
    Each,
    /// It is computed elsewhere, or never.
    Elsewhere,
}

/// Numbers that slots are asked for, and that are known to be those of regimes: their bits.
pub type Numbers = HashMap<Slot, Vec<u64>>;

/// Those of a function.
pub fn numbers(func: &Func) -> Numbers {
    let of_load = |(load, numbers)| match func.op(load) {
        Op::Load(slot) => (slot, numbers),
        _ => unreachable!("it is a load"),
    };
    automata(func, &Numbers::new()).into_iter().map(of_load).collect()
}

/// Takes a function apart, which may be a copy in which not all `numbers` are asked for; `late` are operations that are not
/// wanted, `watched` is the truth that ends the step.
pub fn specialise(func: &Func, numbers: &Numbers, late: &[bool], watched: Option<Value>) -> Specialised {
    let all = || (0..func.ops.len()).map(|i| Value(i as u32));
    let slots = automata(func, numbers);
    let mut places = dependent(func, late, &slots);
    watch_behind(func, watched, &mut places);
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
            && !func.ops[i].is_constant()
        {
            places[i] = Place::Within(k);
        }
        let by = places[i];
        func.ops[i].each_operand(|operand| used(operand, by, &mut users));
    }
    leave_to_each(func, &mut places);
    let mut wanted: Vec<HashSet<Value>> = vec![HashSet::new(); slots.len()];
    let mut note = |value: Value, by: Place| {
        if let Place::Within(k) = places[value.index()]
            && by != Place::Within(k)
        {
            wanted[k].insert(value);
        }
    };
    func.results().for_each(|value| note(value, Place::Before));
    for value in all() {
        func.op(value).each_operand(|operand| note(operand, places[value.index()]));
    }
    let listed = |place: Place| -> Vec<Value> { all().filter(|value| places[value.index()] == place).collect() };
    let mut build = Build::of(func);
    let mut there: HashSet<Value> = listed(Place::Before).into_iter().collect();
    let automata = slots.iter().zip(wanted).enumerate().filter(|(_, (_, wanted))| !wanted.is_empty());
    let automata = automata
        .map(|(k, ((load, numbers), wanted))| {
            let members = listed(Place::Within(k));
            let mut outputs: Vec<Value> = wanted.into_iter().collect();
            outputs.sort_unstable();
            let Op::Load(slot) = func.op(*load) else { unreachable!("it is a load") };
            let next = func.stores.iter().find(|(stored, _)| *stored == slot).map(|(_, value)| *value);
            let next = outputs.iter().position(|output| Some(*output) == next);
            let case = |bits: &u64| (*bits, case(&mut build, &mut there, (*load, *bits), &members, (&outputs, next)));
            let cases = numbers.iter().map(case).collect();
            let general = Case { list: slice(&build, &there, &outputs), then: Then::Outputs(outputs.clone()) };
            Automaton { slot, outputs, cases, general }
        })
        .collect();
    let ops = build.into_ops();
    Specialised {
        func: Func { ops, ..func.clone() },
        before: listed(Place::Before),
        automata,
        behind: listed(Place::Behind),
    }
}

/// Operations that automata read, and how many do, of those that are `wanted`.
pub fn automata_that_ask(func: &Func, wanted: impl Fn(Op) -> bool) -> Vec<(Value, usize)> {
    let places = dependent(func, &vec![false; func.ops.len()], &automata(func, &Numbers::new()));
    let mut readers: BTreeMap<Value, HashSet<usize>> = BTreeMap::new();
    for (op, place) in func.ops.iter().zip(places) {
        let Place::Within(k) = place else { continue };
        op.each_operand(|operand| {
            if wanted(func.op(operand)) {
                readers.entry(operand).or_default().insert(k);
            }
        });
    }
    readers.into_iter().map(|(value, readers)| (value, readers.len())).collect()
}

/// Loads that are only compared with constants and chosen, and these constants, by their bits, with those that are known
/// besides.
fn automata(func: &Func, known: &Numbers) -> Vec<(Value, Vec<u64>)> {
    let mut found: HashMap<Value, Option<Vec<u64>>> = HashMap::new();
    for op in &func.ops {
        if let Some((load, _, bits)) = number_asked(*op, |value| func.op(value)) {
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
    for (load, numbers) in &mut found {
        let (Some(numbers), Op::Load(slot)) = (numbers, func.op(*load)) else { continue };
        let more = known.get(&slot).into_iter().flatten().filter(|bits| !numbers.contains(bits));
        let more: Vec<u64> = more.copied().collect();
        numbers.extend(more);
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

/// Leaves to each regime what several need and nothing else does, if it is next to nothing: what it reads of the block, a sign.
fn leave_to_each(func: &Func, places: &mut [Place]) {
    let mut beyond = vec![false; func.ops.len()];
    func.results().for_each(|value| beyond[value.index()] = true);
    for (i, op) in func.ops.iter().enumerate().rev() {
        let little = match op {
            Op::Load(slot) => func.stores.iter().all(|(stored, _)| stored != slot),
            op => matches!(op, Op::Neg(_) | Op::Abs(_)),
        };
        if places[i] == Place::Before && !beyond[i] && little {
            places[i] = Place::Each;
        }
        if !matches!(places[i], Place::Within(_) | Place::Each) {
            op.each_operand(|operand| beyond[operand.index()] = true);
        }
    }
}

/// Puts what only watches, on what is stored anyway, behind all regimes: it is the same in each.
fn watch_behind(func: &Func, watched: Option<Value>, places: &mut [Place]) {
    let mut stored = vec![false; func.ops.len()];
    func.stores.iter().for_each(|(_, value)| stored[value.index()] = true);
    let mut needed = stored.clone();
    for write in &func.writes {
        [write.index, write.value].iter().for_each(|value| needed[value.index()] = true);
    }
    if let Some(status) = func.status.filter(|_| watched.is_none()) {
        needed[status.index()] = true;
    }
    for i in (0..func.ops.len()).rev().filter(|i| places[*i] != Place::Elsewhere) {
        if needed[i] {
            func.ops[i].each_operand(|operand| needed[operand.index()] = true);
        }
    }
    for (i, op) in func.ops.iter().enumerate().filter(|(i, _)| !needed[*i]) {
        let (mut same, mut behind) = (true, false);
        op.each_operand(|operand| {
            let operand = operand.index();
            same &= stored[operand] || !matches!(places[operand], Place::Within(_));
            behind |= places[operand] == Place::Behind;
        });
        if matches!(places[i], Place::Within(_)) && (same || behind) {
            places[i] = Place::Behind;
        }
    }
}

/// What is left of the members where the slot holds this number; `there` is what stands before. Of the outputs this one, if
/// any, is what the slot holds next.
fn case(
    build: &mut Build,
    there: &mut HashSet<Value>,
    (load, bits): (Value, u64),
    members: &[Value],
    (outputs, next): (&[Value], Option<usize>),
) -> Case {
    let held = build.op(Op::Real(bits));
    let outputs = partial_eval(build, members, &[(load, held)], outputs);
    divided(build, there, outputs, next.map(|next| (next, held)), 0)
}

/// What computes the outputs, taken apart by the truth that is asked most often, if that leaves less to do, and by the one at
/// which the slot no longer holds what it holds: as a rule it does.
fn divided(
    build: &mut Build,
    there: &mut HashSet<Value>,
    outputs: Vec<Value>,
    next: Option<(usize, Value)>,
    depth: usize,
) -> Case {
    let list = slice(build, there, &outputs);
    if depth == DEEPEST || list.len() > LONGEST {
        return Case { list, then: Then::Outputs(outputs) };
    }
    let often = asked_most(build, &list).filter(|_| list.len() >= FEWEST_ASKED);
    let turns = next.and_then(|(next, held)| match build.get(outputs[next]) {
        Op::Select(when, yes, no) if [yes, no].contains(&held) => Some(when),
        _ => None,
    });
    for asked in often.into_iter().chain(turns) {
        let first = slice(build, there, &[asked]);
        let sides = [true, false].map(|truth| {
            let known = known(build, asked, truth);
            partial_eval(build, &list, &known, &outputs)
        });
        there.extend(&first);
        let shorter = |build: &Build, there: &HashSet<Value>| {
            let lengths = sides.each_ref().map(|outputs| slice(build, there, outputs).len());
            // What is put together from several questions is asked by jumps in any case.
            let jump = if matches!(build.get(asked), Op::And(..) | Op::Or(..)) { 0 } else { 2 };
            first.len() + lengths.iter().sum::<usize>().div_ceil(2) + jump < list.len()
        };
        let case = (turns == Some(asked) || shorter(build, there)).then(|| {
            let sides = sides.map(|outputs| divided(build, there, outputs, next, depth + 1));
            Case { list: first.clone(), then: Then::Ask(asked, Box::new(sides)) }
        });
        first.iter().for_each(|value| _ = there.remove(value));
        if let Some(case) = case {
            return case;
        }
    }
    Case { list, then: Then::Outputs(outputs) }
}

/// The truth that most operations of a list take, if more than one does; of several the first.
fn asked_most(build: &Build, list: &[Value]) -> Option<Value> {
    let mut asked: HashMap<Value, usize> = HashMap::new();
    for value in list {
        let op = build.get(*value);
        if matches!(op, Op::Not(_)) {
            continue;
        }
        op.each_operand(|operand| {
            let operand = if let Op::Not(of) = build.get(operand) { of } else { operand };
            if build.type_of(operand) == Type::Bool {
                *asked.entry(operand).or_default() += 1;
            }
        });
    }
    let most = asked.into_iter().filter(|(_, times)| *times > 1);
    most.max_by_key(|(value, times)| (*times, Reverse(*value))).map(|(value, _)| value)
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
        let apart = specialise(&func, &Numbers::new(), &vec![false; func.ops.len()], None);
        let [automaton] = &apart.automata[..] else { panic!("one automaton") };
        assert_eq!((automaton.slot, &apart.behind[..]), (Slot(4), &[][..]));
        let shown = |case: &Case| -> Vec<String> {
            case.list.iter().map(|value| apart.func.op(*value).to_string()).map(|op| op[..3].to_string()).collect()
        };
        let cases: Vec<(f64, Vec<String>)> =
            automaton.cases.iter().map(|(bits, case)| (f64::from_bits(*bits), shown(case))).collect();
        let words = |text: &str| text.split(' ').map(String::from).collect::<Vec<_>>();
        assert_eq!(cases, [(0.0, words("loa loa loa mul fma les")), (1.0, words("loa loa mul"))]);
        assert_eq!(shown(&automaton.general).iter().filter(|op| *op == "sel").count(), 3);
        // What the slot holds next is asked, not chosen; on either side nothing is left to do.
        let Then::Ask(_, sides) = &automaton.cases[0].1.then else { panic!("it asks") };
        let next = sides.each_ref().map(|side| match (&side.list[..], &side.then) {
            ([], Then::Outputs(outputs)) => outputs.last().map(|output| apart.func.op(*output)),
            _ => panic!("it ends"),
        });
        assert_eq!(next, [1f64, 0.0].map(|number| Some(Op::Real(number.to_bits()))));
    }

    /// Slot 4 is a regime; at rest, 0, it asks four times whether a force in slot 5 is above one in slot 6.
    #[test]
    fn what_is_asked_often_is_asked_once() {
        let mut build = Build::new("step");
        let [x, regime, v, w] = [3, 4, 5, 6].map(|slot| build.load(Slot(slot)));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let (rests, above) = (build.equal(regime, zero), build.less(w, v));
        let below = build.not(above);
        let (leaves, stays) = (build.and(rests, above), build.and(rests, below));
        let mut next = x;
        for (asked, other) in [(leaves, v), (stays, w), (leaves, w), (stays, v)] {
            let moved = build.mul(next, other);
            next = build.select(asked, moved, next);
        }
        let changed = build.select(leaves, one, regime);
        build.store(Slot(3), next);
        build.store(Slot(4), changed);
        let func = build.finish();
        let apart = specialise(&func, &Numbers::new(), &vec![false; func.ops.len()], None);
        let Then::Ask(asked, sides) = &apart.automata[0].cases[0].1.then else { panic!("it asks") };
        assert!(matches!(apart.func.op(*asked), Op::Less(..)));
        for side in sides.iter() {
            let products = side.list.iter().filter(|value| matches!(apart.func.op(**value), Op::Mul(..))).count();
            let choices = side.list.iter().filter(|value| matches!(apart.func.op(**value), Op::Select(..))).count();
            assert_eq!((products, choices), (2, 0));
        }
    }
}
