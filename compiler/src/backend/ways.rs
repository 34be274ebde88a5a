//! Takes a step apart into ways through it: straight lines, and questions that decide between them.
//!
//! In: a sound, expanded function. Out: [`Ways`]: a tree of questions with a line at each end. What is asked is what chooses
//! what becomes of a state, for most often a processor foresees the answer and goes on, while a choice would wait for it. Where a
//! regime changes is set apart: that is rare. It knows nothing of processors.

use super::sides::Sides;
use crate::ir::build::Build;
use crate::ir::left::{known as truths, left, needed};
use crate::ir::{Func, Op, Value, Write, number_asked};
use crate::opt::watched::{with_fewer, with_less_asked};
use abi::Slot;
use std::collections::{HashMap, HashSet};

/// The ways through a function.
pub struct Ways {
    /// The function; behind its own operations those of single ways.
    pub func: Func,
    /// Where all of them begin.
    pub begin: Way,
}

/// How it goes on.
pub enum Way {
    /// To the end, without a question that matters.
    Ends {
        /// What is stored, but for what is there already.
        stores: Vec<(Slot, Value)>,
        /// What is written to rings.
        writes: Vec<Write>,
        /// A truth with which it has failed; the status is found out elsewhere.
        failed: Option<Value>,
    },
    /// By a comparison of reals: where it holds, and where it does not.
    Asks(Value, Box<[Way; 2]>),
    /// A regime changes, which is rare.
    Changes(Box<Way>),
    /// The same, and another one besides, or on too many ways; or one is none of its own: this is left to others.
    Leaves,
}

impl Way {
    /// The way and all that it goes on to.
    pub fn each(&self, each: &mut impl FnMut(&Way)) {
        each(self);
        match self {
            Way::Asks(_, sides) => sides.iter().for_each(|side| side.each(each)),
            Way::Changes(rest) => rest.each(each),
            Way::Ends { .. } | Way::Leaves => {}
        }
    }

    /// Whether it is seldom gone.
    pub fn is_rare(&self) -> bool {
        matches!(self, Way::Changes(_) | Way::Leaves)
    }

    /// Which of the sides of a question is the usual one: not one that is rare, nor one that asks next for what changes a regime,
    /// or asks more: of several questions that must all hold, each leads to the same side if it does not.
    pub fn usual([yes, no]: &[Way; 2]) -> usize {
        let may_change = matches!(yes, Way::Asks(_, sides) if matches!(sides[0], Way::Changes(_)));
        match (yes.is_rare(), no.is_rare()) {
            (true, _) => 1,
            (false, true) => 0,
            (false, false) => usize::from(may_change || yes.usual_ends() > no.usual_ends()),
        }
    }

    fn usual_ends(&self) -> usize {
        match self {
            Way::Asks(_, sides) => sides.iter().map(Way::usual_ends).sum(),
            Way::Ends { .. } => 1,
            Way::Changes(_) | Way::Leaves => 0,
        }
    }

    /// What it asks, or what it ends with.
    pub fn reads(&self) -> impl Iterator<Item = Value> {
        let (asked, stores, writes, failed) = match self {
            Way::Ends { stores, writes, failed } => (None, &stores[..], &writes[..], *failed),
            Way::Asks(asked, _) => (Some(*asked), &[][..], &[][..], None),
            Way::Changes(_) | Way::Leaves => (None, &[][..], &[][..], None),
        };
        let written = writes.iter().flat_map(|write| [write.index, write.value]);
        asked.into_iter().chain(stores.iter().map(|(_, value)| *value)).chain(written).chain(failed)
    }
}

/// Operations, by their cost, from which on the sides of a choice are long.
const LONG: u32 = 12;
/// Most ends: behind a question, what is the same on both sides stands twice.
const MOST: usize = 12;
/// Most ends where a regime has changed, and of these most from where it does.
const MOST_CHANGED: usize = 16;
const MOST_FROM_CHANGE: usize = 3;

/// All ways; none if they are too many, or if something is asked that is no comparison.
pub fn ways(func: &Func) -> Option<Ways> {
    let mut build = Build::of(func);
    let failed = match (func.status, func.failure()) {
        (None, _) => None,
        (Some(_), Some((when, true, _))) => Some(when),
        (Some(_), Some((fine, false, _))) => Some(build.not(fine)),
        (Some(_), None) => return None,
    };
    let slots: Vec<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let read: HashSet<Slot> = func.loads().into_iter().collect();
    let stored = func.stores.iter().map(|(_, value)| *value);
    let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
    let wanted: Vec<Value> = stored.chain(written).chain(failed).collect();
    let numbers = slots.iter().map(|slot| (*slot, numbers(func, *slot))).collect();
    let rings = &func.writes;
    let mut seeker = Seeker { build, slots, numbers, rings, read, ends: 0, changed: 0, has_changed: false };
    let begin = seeker.way(wanted, &Known::default())?;
    Some(Ways { func: Func { ops: seeker.build.into_ops(), ..func.clone() }, begin })
}

/// The numbers that a slot is asked for, and those that it becomes: bits of all, if any.
fn numbers(func: &Func, slot: Slot) -> HashSet<u64> {
    let asked = func.ops.iter().filter_map(|op| number_asked(*op, |value| func.op(value)));
    let mut numbers: HashSet<u64> = asked.filter(|(_, of, _)| *of == slot).map(|(.., bits)| bits).collect();
    if !numbers.is_empty() {
        let stored = func.stores.iter().filter(|(stored, _)| *stored == slot);
        let mut open: Vec<Value> = stored.map(|(_, value)| *value).collect();
        while let Some(value) = open.pop() {
            match func.op(value) {
                Op::Select(_, yes, no) => open.extend([yes, no]),
                Op::Real(bits) => _ = numbers.insert(bits),
                _ => {}
            }
        }
    }
    numbers
}

/// What is known of regimes on a way: slots, and bits of numbers.
#[derive(Clone, Default)]
struct Known {
    /// What they are.
    held: Vec<(Slot, u64)>,
    /// What they are not.
    excluded: Vec<(Slot, u64)>,
}

struct Seeker<'a> {
    build: Build,
    /// Slots that are stored.
    slots: Vec<Slot>,
    /// The numbers of each that is a regime.
    numbers: HashMap<Slot, HashSet<u64>>,
    /// What is written to rings, without a way.
    rings: &'a [Write],
    /// Slots that are read.
    read: HashSet<Slot>,
    /// Ends so far, and those where a regime has changed.
    ends: usize,
    changed: usize,
    /// Whether one has on the way that is looked for.
    has_changed: bool,
}

impl Seeker<'_> {
    /// To what is stored, what is written to rings, index and value, and what then fails.
    fn way(&mut self, wanted: Vec<Value>, known: &Known) -> Option<Way> {
        let changes = |(slot, value): (&Slot, &Value)| match self.build.get(*value) {
            Op::Real(bits) => known.held.iter().any(|(held, before)| held == slot && *before != bits),
            _ => false,
        };
        if self.slots.iter().zip(&wanted).any(changes) {
            return Some(self.changed(wanted));
        }
        self.on(wanted, known)
    }

    /// The same from where a regime changes. What regimes were counts no more: all that they become is stored.
    fn changed(&mut self, wanted: Vec<Value>) -> Way {
        if self.has_changed || self.changed == MOST_CHANGED {
            return Way::Leaves;
        }
        self.has_changed = true;
        let ends = std::mem::take(&mut self.ends);
        let rest = self.on(wanted, &Known::default());
        let own = std::mem::replace(&mut self.ends, ends);
        self.has_changed = false;
        match rest {
            Some(rest) if own <= MOST_FROM_CHANGE && self.changed + own <= MOST_CHANGED => {
                self.changed += own;
                Way::Changes(Box::new(rest))
            }
            _ => Way::Leaves,
        }
    }

    /// How it goes on while no regime is seen to change.
    fn on(&mut self, wanted: Vec<Value>, known: &Known) -> Option<Way> {
        let list = needed(&self.build, &HashSet::new(), &wanted);
        let Some(question) = self.question(&list, &wanted, &known.held) else {
            self.ends += 1;
            return (self.ends <= MOST).then(|| self.end(wanted, &known.held));
        };
        let asked = question?;
        let mut side = |truth: bool| {
            let (mut truths, mut known) = (truths(&mut self.build, asked, truth), known.clone());
            if let Some((load, slot, bits)) = self.regime(asked) {
                if truth {
                    for value in &list {
                        if let Some((_, _, other)) = self.regime(*value).filter(|(of, ..)| *of == load) {
                            let is_other = f64::from_bits(bits) == f64::from_bits(other);
                            truths.push((*value, self.build.truth(is_other)));
                        }
                    }
                    known.held.push((slot, bits));
                } else {
                    known.excluded.push((slot, bits));
                    // It is none of its numbers: nobody but who looks for mistakes puts another one there.
                    if self.numbers[&slot].iter().all(|bits| known.excluded.contains(&(slot, *bits))) {
                        return Some(Way::Leaves);
                    }
                }
            }
            let wanted = left(&mut self.build, &list, &truths, &wanted);
            self.way(wanted, &known)
        };
        let sides = [side(true)?, side(false)?];
        Some(if matches!(sides, [Way::Leaves, Way::Leaves]) { Way::Leaves } else { Way::Asks(asked, Box::new(sides)) })
    }

    /// A line to what is wanted.
    fn end(&mut self, mut wanted: Vec<Value>, held: &[(Slot, u64)]) -> Way {
        let at = self.slots.len() + 2 * self.rings.len();
        if let Some(failed) = wanted.get(at) {
            let fewer = with_fewer(&mut self.build, *failed, &wanted[..self.slots.len()]);
            wanted[at] = with_less_asked(&mut self.build, fewer);
        }
        let is_there = |(slot, value): &(Slot, Value)| match self.build.get(*value) {
            Op::Load(from) => from == *slot,
            // What is found to be 0 may be −0.
            Op::Real(bits) => f64::from_bits(bits) != 0.0 && held.contains(&(*slot, bits)),
            _ => false,
        };
        let stored = self.slots.iter().copied().zip(wanted.iter().copied());
        let (written, failed) = wanted[self.slots.len()..].split_at(2 * self.rings.len());
        let of_ring = |(ring, written): (&Write, &[Value])| Write { index: written[0], value: written[1], ..*ring };
        let writes = self.rings.iter().zip(written.chunks(2)).map(of_ring).collect();
        Way::Ends { stores: stored.filter(|store| !is_there(store)).collect(), writes, failed: failed.first().copied() }
    }

    /// The load, its slot and the bits of the number, if it is asked whether a slot that is stored holds a number.
    fn regime(&self, asked: Value) -> Option<(Value, Slot, u64)> {
        let found = number_asked(self.build.get(asked), |value| self.build.get(value));
        found.filter(|(_, slot, _)| self.slots.contains(slot))
    }

    /// What to ask first, regimes before all else; none if there is nothing, and a none within if it is no comparison.
    fn question(&self, list: &[Value], wanted: &[Value], held: &[(Slot, u64)]) -> Option<Option<Value>> {
        // Whether a regime changes is asked, whatever that depends on.
        let regimes = self.slots.iter().zip(wanted).filter(|(slot, _)| held.iter().any(|(held, _)| held == *slot));
        let changes: Vec<Value> = regimes.map(|(_, value)| *value).collect();
        let next = self.slots.iter().zip(wanted).filter(|(slot, _)| self.read.contains(slot)).map(|(_, value)| *value);
        let next: HashSet<Value> =
            needed(&self.build, &HashSet::new(), &next.collect::<Vec<_>>()).into_iter().collect();
        let (long, waits) = (self.long(list, wanted), self.waiting(list));
        let mut first = None;
        for value in list {
            let Op::Select(when, yes, no) = self.build.get(*value) else { continue };
            let parts = self.parts(when);
            if long.contains(value) {
                first = first.or(Some(parts[0]));
            }
            // The less or the greater of two is one instruction.
            let of_two = matches!(self.build.get(when), Op::Less(a, b) if [(a, b), (b, a)].contains(&(yes, no)));
            let of_state = waits.contains(value) || changes.contains(value);
            if !of_state || of_two || !next.contains(value) {
                continue;
            }
            if let Some(regime) = parts.iter().flatten().find(|part| self.regime(**part).is_some()) {
                return Some(Some(*regime));
            }
            first = first.or(Some(parts[0]));
        }
        first
    }

    /// What waits for the step before.
    fn waiting(&self, list: &[Value]) -> HashSet<Value> {
        let state = |slot: Slot| self.slots.contains(&slot) && ![Slot::COUNT, Slot::TIME].contains(&slot);
        let mut waits = HashSet::new();
        for value in list {
            let op = self.build.get(*value);
            let mut wait = matches!(op, Op::Load(slot) if state(slot));
            op.each_operand(|operand| wait |= waits.contains(&operand));
            if wait {
                waits.insert(*value);
            }
        }
        waits
    }

    /// Choices whose sides take long: it is worth a jump. None that only a side of another one needs.
    fn long(&self, list: &[Value], wanted: &[Value]) -> HashSet<Value> {
        let sides = Sides::of(self.build.ops(), list, wanted);
        let is_long = |pair: &[usize; 2]| pair.iter().map(|side| sides.costs[*side]).sum::<u32>() >= LONG;
        let of_all = sides.members[0].iter().filter_map(|value| Some((*value, sides.of_choice.get(value)?)));
        of_all.filter(|(_, pair)| is_long(pair)).map(|(choice, _)| choice).collect()
    }

    /// The comparisons that a truth is put together from, in their order; a none for what is none. Those with 0 come last: a
    /// bound is seldom reached, and then from one side, while what has a direction has either.
    fn parts(&self, truth: Value) -> Vec<Option<Value>> {
        let mut parts = self.comparisons(truth);
        let is_zero = |value: Value| matches!(self.build.get(value), Op::Real(bits) if f64::from_bits(bits) == 0.0);
        parts.sort_by_key(|part| match part.map(|part| self.build.get(part)) {
            Some(Op::Less(a, b) | Op::LessEqual(a, b)) => is_zero(a) || is_zero(b),
            _ => false,
        });
        parts
    }

    fn comparisons(&self, truth: Value) -> Vec<Option<Value>> {
        match self.build.get(truth) {
            Op::And(a, b) | Op::Or(a, b) => [self.comparisons(a), self.comparisons(b)].concat(),
            Op::Not(a) => self.comparisons(a),
            Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => vec![Some(truth)],
            _ => vec![None],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A spring in slot 3 that moves with slot 5 while slot 4, its regime, is 0, up to 1, where it is held from then on.
    #[test]
    fn a_regime_that_stays_is_a_line_and_one_that_changes_another() {
        let mut build = Build::new("step");
        let [x, regime, v] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let moves = build.equal(regime, zero);
        let moved = build.add(x, v);
        let next = build.select(moves, moved, x);
        let far = build.less(one, next);
        let leaves = build.and(moves, far);
        let changed = build.select(leaves, one, regime);
        build.store(Slot(3), next);
        build.store(Slot(4), changed);
        let ways = ways(&build.finish()).expect("there are few");
        let Way::Asks(regime, sides) = &ways.begin else { panic!("it asks") };
        assert!(matches!(ways.func.op(*regime), Op::Equal(..)));
        let [Way::Asks(far, of_moving), Way::Ends { stores, failed: None, .. }] = &**sides else {
            panic!("two regimes")
        };
        assert_eq!(stores[..], []);
        assert!(matches!(ways.func.op(*far), Op::Less(..)));
        let [Way::Changes(changed), Way::Ends { stores, failed: None, .. }] = &**of_moving else {
            panic!("it changes or stays")
        };
        let Way::Ends { stores: of_changed, .. } = &**changed else { panic!("it is one line") };
        let [(Slot(3), moved), (Slot(4), Value(_))] = of_changed[..] else { panic!("spring and regime are stored") };
        assert!(matches!(ways.func.op(moved), Op::Add(..)));
        let [(Slot(3), next)] = stores[..] else { panic!("the spring moves") };
        assert!(matches!(ways.func.op(next), Op::Add(..)));
    }

    /// A spring in slot 3 that yields where it is beyond 1 and slot 5 is above 0, and then is in regime 1 for good.
    #[test]
    fn a_bound_is_asked_before_a_direction_and_other_numbers_leave() {
        let mut build = Build::new("step");
        let [x, regime, v] = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let (holds, yields) = (build.equal(regime, zero), build.equal(regime, one));
        let moved = build.add(x, v);
        let moved = build.select(holds, moved, x);
        let next = build.select(yields, one, moved);
        let (forth, far) = (build.less(zero, v), build.less(one, moved));
        let both = build.and(forth, far);
        let leaves = build.and(holds, both);
        let changed = build.select(leaves, one, regime);
        build.store(Slot(3), next);
        build.store(Slot(4), changed);
        let ways = ways(&build.finish()).expect("there are few");
        let Way::Asks(_, of_regime) = &ways.begin else { panic!("it asks for the regime") };
        let Way::Asks(bound, of_bound) = &of_regime[0] else { panic!("it asks for the bound") };
        let Op::Less(limit, _) = ways.func.op(*bound) else { panic!("it is a comparison") };
        assert_eq!(ways.func.op(limit), Op::Real(1f64.to_bits()));
        let Way::Asks(direction, of_direction) = &of_bound[0] else { panic!("it asks for the direction") };
        let Op::Less(rest, _) = ways.func.op(*direction) else { panic!("it is a comparison") };
        assert_eq!(ways.func.op(rest), Op::Real(0));
        assert!(matches!(of_direction[..], [Way::Changes(_), Way::Ends { .. }]));
        assert_eq!([Way::usual(of_bound), Way::usual(of_direction)], [1, 1]);
        let Way::Asks(_, of_other) = &of_regime[1] else { panic!("it asks for the other regime") };
        assert!(matches!(of_other[..], [Way::Ends { .. }, Way::Leaves]));
    }
}
