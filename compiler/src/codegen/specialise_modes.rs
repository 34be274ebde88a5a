//! Specialises a step by the modes of its automata: for each mode, the residual operations.
//!
//! In: a step in one block. Out: a switch on the mode of each automaton, with a block of residual operations for each
//! mode. An automaton is a slot that the step only selects and compares with constants, its modes. Operations that
//! depend on several automata, and operations that depend on none and are needed in more than one place, stay common to
//! all modes. It knows nothing of processors.
//!
//! ```text
//! common operations; switch on mode 1
//!   each mode: its residual operations; stores what only this automaton changes
//! what depends on automaton 1 and no later one; switch on mode 2
//!   …
//! guards, which read stored values back; the status
//! ```
//!
//! Method: polyvariant specialisation, Jones, Gomard, Sestoft, *Partial Evaluation and Automatic Program Generation*,
//! 1993.

use crate::codegen::side_exit::{cold, tested};
use crate::ir::build::Build;
use crate::ir::cfg::{Block, BlockId, Cfg, Inst, Part, Place, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::partial_eval::{known, partial_eval, slice};
use crate::ir::{Func, Op, Type, Value, number_asked};
use abi::Slot;
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// A function with its operations grouped by automaton and mode.
struct Specialised {
    /// The function; the residual operations of single modes follow its own operations.
    func: Func,
    /// Operations that depend on no automaton, in topological order.
    common: Vec<Value>,
    /// The automata, each with the operations that depend on it alone.
    automata: Vec<Automaton>,
    /// Operations that depend on several automata, or on one that is too small to specialise; in topological order.
    joint: Vec<Value>,
}

impl Specialised {
    /// For each value that depends on automata, the index of the last automaton that it needs.
    fn stages(&self) -> HashMap<Value, usize> {
        let mut stages = HashMap::default();
        for (k, automaton) in self.automata.iter().enumerate() {
            stages.extend(automaton.outputs.iter().map(|output| (*output, k)));
        }
        for value in &self.joint {
            let mut last = None;
            self.func.op(*value).each_operand(|operand| last = last.max(stages.get(&operand).copied()));
            stages.extend(last.map(|last| (*value, last)));
        }
        stages
    }

    /// Everything read after automaton `number`: by those `joint` operations for which `by` holds, by writes to rings,
    /// and by later automata.
    fn read_after(&self, number: usize, by: impl Fn(Value) -> bool) -> Read {
        let mut read = Read::default();
        for value in self.joint.iter().filter(|value| by(**value)) {
            read.operation(self.func.op(*value));
        }
        read.values.extend(self.func.writes.iter().flat_map(|write| [write.index, write.value]));
        for automaton in &self.automata[number + 1..] {
            read.slots.insert(automaton.slot);
            let cases = automaton.cases.iter().map(|(_, case)| case).chain([&automaton.general]);
            cases.for_each(|case| {
                case.each(&mut |case| {
                    case.list.iter().for_each(|value| read.operation(self.func.op(*value)));
                    match &case.end {
                        CaseEnd::Outputs(outputs) => read.values.extend(outputs),
                        CaseEnd::Branch(when, _) => _ = read.values.insert(*when),
                    }
                });
            });
        }
        read
    }
}

/// A set of slots and values that are read.
#[derive(Default)]
struct Read {
    /// Slots of the block.
    slots: HashSet<Slot>,
    /// Values read as operands.
    values: HashSet<Value>,
}

impl Read {
    fn operation(&mut self, op: Op) {
        if let Op::Load(slot) = op {
            self.slots.insert(slot);
        }
        op.each_operand(|operand| _ = self.values.insert(operand));
    }
}

/// The operations that depend on the mode in one slot.
struct Automaton {
    /// The slot that holds the mode.
    slot: Slot,
    /// Its values that other operations or results read.
    outputs: Vec<Value>,
    /// For each mode, the bits of its number and its residual operations.
    cases: Vec<(u64, ModeCase)>,
    /// The operations for any other number in the slot, not specialised.
    general: ModeCase,
}

/// Residual operations for one mode and how they end.
struct ModeCase {
    /// Operations in topological order.
    list: Vec<Value>,
    /// How the case ends.
    end: CaseEnd,
}

/// The end of a case.
enum CaseEnd {
    /// The value of each output of the automaton.
    Outputs(Vec<Value>),
    /// A branch on a boolean that many operations depend on: the case where it is true, and the case where it is false.
    Branch(Value, Box<[ModeCase; 2]>),
}

impl ModeCase {
    /// Visits the case and all nested cases.
    fn each(&self, each: &mut impl FnMut(&ModeCase)) {
        each(self);
        if let CaseEnd::Branch(_, sides) = &self.end {
            sides.iter().for_each(|side| side.each(each));
        }
    }
}

/// Maximum number of modes of an automaton that is specialised.
const MAX_MODES: usize = 4;
/// Minimum number of operations that are worth a branch.
const MIN_OPS: usize = 6;
/// Minimum number of operations of a case that is split by its most frequent condition.
const MIN_SPLIT_OPS: usize = 4;
/// Maximum number of operations of a case that is split, since a split duplicates them.
const MAX_SPLIT_OPS: usize = 200;
/// Maximum depth of nested branches in a case.
const MAX_DEPTH: usize = 4;

/// The group of operations with which an operation is computed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Group {
    Common,
    Within(usize),
    Joint,
    /// Rematerialised in each mode that needs it.
    Rematerialised,
    /// In the cold block of the function.
    Cold,
}

/// The modes of each slot: the bits of the constants that the slot is compared with.
type Modes = HashMap<Slot, Vec<u64>>;

/// Specialises all blocks that hold a step.
pub fn specialise_modes(cfg: &mut Cfg) {
    // The copies that unswitching makes may no longer compare a slot with all of its modes.
    let mut modes = Modes::default();
    for (_, slot, bits) in cfg.ops.iter().filter_map(|op| number_asked(*op, |value| cfg.op(value))) {
        let of_slot = modes.entry(slot).or_default();
        if !of_slot.contains(&bits) {
            of_slot.push(bits);
        }
    }
    if modes.is_empty() {
        return;
    }
    for id in 0..cfg.blocks.len() as u32 {
        let is_body = cfg.blocks[id as usize].part == Part::Body;
        if let Some(func) = cfg.straight_line(BlockId(id)).filter(|_| is_body) {
            let cold = cold(&func);
            let specialised = specialise(&func, &modes, &cold, tested(&func).0);
            if !specialised.automata.is_empty() {
                let to = cfg.append(&specialised.func.ops);
                let to = &to;
                Writer { cfg, to, specialised: &specialised, at: BlockId(id), stored: HashMap::default() }.step(&cold);
            }
        }
    }
}

/// Writes a specialised step into blocks.
struct Writer<'a> {
    cfg: &'a mut Cfg,
    /// The value of the graph for a value of the specialised function.
    to: &'a dyn Fn(Value) -> Value,
    specialised: &'a Specialised,
    /// The block that is being written.
    at: BlockId,
    /// Values that modes have stored and that are read back at each use.
    stored: HashMap<Value, Slot>,
}

/// Where all cases of an automaton join.
struct Join {
    block: BlockId,
    /// For each output of the automaton, whether the code after the join reads it.
    outputs: Vec<bool>,
    /// Slots that each case stores, with the index of the stored output.
    stores: Vec<(Slot, usize)>,
    /// The slot of the automaton and the bits it holds in this case, where they are known.
    held: Option<(Slot, u64)>,
}

impl Writer<'_> {
    fn push(&mut self, inst: Inst) {
        self.cfg.blocks[self.at.index()].insts.push(inst);
    }

    /// Computes operations in order.
    fn compute(&mut self, list: &[Value]) {
        let func = &self.specialised.func;
        for value in list {
            for read in func.reads(func.op(*value)) {
                if let Some(slot) = self.stored.get(&read) {
                    self.push(Inst::Reload((self.to)(read), Place::slot(*slot)));
                }
            }
            let value = (self.to)(*value);
            if !self.cfg.is_free(value) {
                self.push(Inst::Compute(value));
            }
        }
    }

    fn store(&mut self, stores: &[(Slot, Value)]) {
        for (slot, value) in stores {
            self.push(Inst::Store(Place::slot(*slot), (self.to)(*value)));
        }
    }

    /// Writes the whole step. `cold`: the operations that only the status of a failed guard needs.
    fn step(mut self, cold: &[bool]) {
        let Specialised { func, common, automata, joint } = self.specialised;
        let is_common: HashSet<Value> = common.iter().copied().collect();
        self.cfg.blocks[self.at.index()].insts.clear();
        self.compute(common);
        // Values that are already computed are stored here, so that they occupy no register, unless their slot is still
        // to be read.
        let later = func.ops.iter().enumerate().filter(|(i, _)| !is_common.contains(&Value(*i as u32)));
        let loads = later.filter_map(|(_, op)| if let Op::Load(slot) = op { Some(*slot) } else { None });
        let read_later: HashSet<Slot> = loads.chain(automata.iter().map(|automaton| automaton.slot)).collect();
        let (early, mut last): (Vec<_>, Vec<_>) =
            func.stores.iter().partition(|(slot, value)| is_common.contains(value) && !read_later.contains(slot));
        self.store(&early);
        // The same after each automaton. Operations that depend on several automata follow the last of these.
        let stages = self.specialised.stages();
        let stored: HashSet<Value> = func.stores.iter().map(|(_, value)| *value).collect();
        let cold: Vec<Value> = (0..cold.len()).filter(|i| cold[*i]).map(|i| Value(i as u32)).collect();
        let mut cold_operands: Vec<Value> = Vec::new();
        for value in &cold {
            func.op(*value).each_operand(|operand| cold_operands.push(operand));
        }
        let of_stage = |stage: Option<&usize>| -> Vec<Value> {
            joint.iter().copied().filter(|value| stages.get(value) == stage).collect()
        };
        self.compute(&of_stage(None));
        let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
        let not_only_guard = func.live_for(stored.iter().copied().chain(written));
        for (k, automaton) in automata.iter().enumerate() {
            let read = self.specialised.read_after(k, |value| not_only_guard[value.index()]);
            let mut values = read.values;
            // Each mode itself stores the states that only its automaton changes; guards read them back from the block.
            let (own, others): (Vec<_>, Vec<_>) =
                last.iter().partition(|(slot, value)| automaton.outputs.contains(value) && !read.slots.contains(slot));
            let reloaded = own.iter().filter(|(_, value)| !values.contains(value)).map(|(slot, value)| (*value, *slot));
            self.stored.extend(reloaded);
            let guards = joint.iter().filter(|value| !not_only_guard[value.index()]);
            let guard_operands = guards.flat_map(|value| func.reads(func.op(*value)));
            values.extend(guard_operands.filter(|value| !self.stored.contains_key(value)));
            values.extend(others.iter().map(|(_, value)| *value).chain(tested(func).0));
            values.extend(cold_operands.iter().filter(|operand| !stored.contains(operand)));
            self.automaton(automaton, &own, &values);
            self.compute(&of_stage(Some(&k)));
            let is_available = |value: &Value| stages.get(value).is_none_or(|stage| *stage <= k);
            let (now, later): (Vec<_>, Vec<_>) =
                others.iter().partition(|(slot, value)| is_available(value) && !read.slots.contains(slot));
            self.store(&now);
            last = later;
        }
        func.writes.iter().for_each(|write| self.push(Inst::Write(write.map(self.to))));
        self.store(&last);
        // Only the cold operations read these.
        for (slot, value) in func.stores.iter().filter(|(_, value)| cold_operands.contains(value)) {
            if !matches!(func.op(*value), Op::Load(_)) {
                self.push(Inst::Reload((self.to)(*value), Place::slot(*slot)));
                self.stored.remove(value);
            }
        }
        self.compute(&cold);
        self.cfg.blocks[self.at.index()].end = Terminator::Return(func.status.map(self.to));
    }

    /// Writes the switch on the mode of an automaton and its cases; goes on at their join. The automaton's own `stores`
    /// are in each case; outputs among `read` become parameters of the join.
    fn automaton(&mut self, automaton: &Automaton, stores: &[(Slot, Value)], read: &HashSet<Value>) {
        let params = automaton.outputs.iter().filter(|output| read.contains(output));
        let params = params.map(|output| (self.to)(*output)).collect();
        let part = Part::Body;
        let end = Terminator::Return(None);
        let after = self.cfg.block(Block { part, params, insts: Vec::new(), end });
        let number = |value: &Value| automaton.outputs.iter().position(|output| output == value).expect("its own");
        let join = |held: Option<u64>| Join {
            block: after,
            outputs: automaton.outputs.iter().map(|output| read.contains(output)).collect(),
            stores: stores.iter().map(|(slot, value)| (*slot, number(value))).collect(),
            held: held.map(|bits| (automaton.slot, bits)),
        };
        // A mode that is left in the same step is rarely active, so it is tested last.
        let mut cases: Vec<(u64, &ModeCase)> = automaton.cases.iter().map(|(bits, case)| (*bits, case)).collect();
        cases.sort_by_key(|(bits, case)| self.changes(case, &join(Some(*bits))));
        let from = self.at;
        let mut blocks = Vec::new();
        for (bits, case) in cases {
            let join = join(Some(bits));
            blocks.push((bits, self.side(case, &join)));
        }
        let default = self.cfg.empty(Part::Cold);
        self.case(&automaton.general, default, &join(None));
        self.cfg.blocks[from.index()].end = Terminator::Switch { slot: automaton.slot, cases: blocks, default };
        self.at = after;
    }

    /// Whether a case without further branches ends with another mode than the one it began with.
    fn changes(&self, case: &ModeCase, join: &Join) -> bool {
        let CaseEnd::Outputs(outputs) = &case.end else { return false };
        join.stores.iter().any(|(slot, number)| {
            let held = join.held.filter(|(held, _)| held == slot);
            let next = self.specialised.func.op(outputs[*number]);
            matches!((held, next), (Some((_, bits)), Op::Real(next)) if next != bits)
        })
    }

    /// Writes a case into a new block, a cold one if it changes the mode.
    fn side(&mut self, case: &ModeCase, join: &Join) -> BlockId {
        let part = if self.changes(case, join) { Part::Cold } else { Part::Body };
        let block = self.cfg.empty(part);
        self.case(case, block, join);
        block
    }

    /// Writes one case and the jump to the join.
    fn case(&mut self, case: &ModeCase, block: BlockId, join: &Join) {
        self.at = block;
        // A case computes the values of its automaton itself; they are not stored yet.
        let stored = std::mem::take(&mut self.stored);
        let func = &self.specialised.func;
        let end = match &case.end {
            CaseEnd::Outputs(outputs) => {
                let is_available = |(slot, value): &(Slot, Value)| match func.op(*value) {
                    Op::Load(from) => from == *slot,
                    Op::Real(bits) => join.held == Some((*slot, bits)),
                    _ => false,
                };
                let stores = join.stores.iter().map(|(slot, number)| (*slot, outputs[*number]));
                let stores: Vec<(Slot, Value)> = stores.filter(|store| !is_available(store)).collect();
                let read: Vec<Value> =
                    outputs.iter().zip(&join.outputs).filter(|(_, read)| **read).map(|(output, _)| *output).collect();
                let live = func.live_for(stores.iter().map(|(_, value)| *value).chain(read.iter().copied()));
                let list: Vec<Value> = case.list.iter().copied().filter(|value| live[value.index()]).collect();
                self.compute(&list);
                self.store(&stores);
                Terminator::Jump(Target { block: join.block, args: read.into_iter().map(self.to).collect() })
            }
            CaseEnd::Branch(when, sides) => {
                self.compute(&case.list);
                let [yes, no] = sides.each_ref().map(|side| self.side(side, join));
                Terminator::Branch { when: (self.to)(*when), yes: yes.into(), no: no.into() }
            }
        };
        self.cfg.blocks[block.index()].end = end;
        self.stored = stored;
    }
}

/// Specialises a function.
///
/// `modes`: the modes of the function before unswitching, since a copy may no longer compare a slot with all of them.
/// `cold`: operations to leave out. `guard`: the boolean that ends the step.
fn specialise(func: &Func, modes: &Modes, cold: &[bool], guard: Option<Value>) -> Specialised {
    let all = || (0..func.ops.len()).map(|i| Value(i as u32));
    let slots = automata(func, modes);
    let mut places = dependences(func, cold, &slots);
    move_guards_after(func, guard, &mut places);
    for k in 0..slots.len() {
        let members = places.iter().filter(|place| **place == Group::Within(k)).count();
        if members < MIN_OPS {
            places.iter_mut().filter(|place| **place == Group::Within(k)).for_each(|place| *place = Group::Joint);
        }
    }
    // An operation that depends on no mode but is needed by one automaton only is computed there.
    let mut users: Vec<Option<Group>> = vec![None; func.ops.len()];
    let used = |value: Value, by: Group, users: &mut Vec<Option<Group>>| {
        let known = &mut users[value.index()];
        *known = Some(known.map_or(by, |known| if known == by { known } else { Group::Common }));
    };
    func.results().for_each(|value| used(value, Group::Common, &mut users));
    for value in all().rev() {
        let i = value.index();
        if let (Group::Common, Some(Group::Within(k))) = (places[i], users[i])
            && !func.ops[i].is_constant()
        {
            places[i] = Group::Within(k);
        }
        let by = places[i];
        func.ops[i].each_operand(|operand| used(operand, by, &mut users));
    }
    rematerialise_cheap(func, &mut places);
    let mut wanted: Vec<HashSet<Value>> = vec![HashSet::default(); slots.len()];
    let mut note = |value: Value, by: Group| {
        if let Group::Within(k) = places[value.index()]
            && by != Group::Within(k)
        {
            wanted[k].insert(value);
        }
    };
    func.results().for_each(|value| note(value, Group::Common));
    for value in all() {
        func.op(value).each_operand(|operand| note(operand, places[value.index()]));
    }
    let listed = |place: Group| -> Vec<Value> { all().filter(|value| places[value.index()] == place).collect() };
    let mut build = Build::of(func);
    let mut available: HashSet<Value> = listed(Group::Common).into_iter().collect();
    let automata = slots.iter().zip(wanted).enumerate().filter(|(_, (_, wanted))| !wanted.is_empty());
    let automata = automata
        .map(|(k, ((load, modes), wanted))| {
            let members = listed(Group::Within(k));
            let mut outputs: Vec<Value> = wanted.into_iter().collect();
            outputs.sort_unstable();
            let Op::Load(slot) = func.op(*load) else { unreachable!("it is a load") };
            let next = func.stores.iter().find(|(stored, _)| *stored == slot).map(|(_, value)| *value);
            let next = outputs.iter().position(|output| Some(*output) == next);
            let case =
                |bits: &u64| (*bits, case(&mut build, &mut available, (*load, *bits), &members, (&outputs, next)));
            let cases = modes.iter().map(case).collect();
            let general =
                ModeCase { list: slice(&build, &available, &outputs), end: CaseEnd::Outputs(outputs.clone()) };
            Automaton { slot, outputs, cases, general }
        })
        .collect();
    let ops = build.into_ops();
    Specialised {
        func: Func { ops, ..func.clone() },
        common: listed(Group::Common),
        automata,
        joint: listed(Group::Joint),
    }
}

/// Of the values for which `wanted` holds, those that automata read, each with the number of automata that read it.
pub fn shared_operands(func: &Func, wanted: impl Fn(Op) -> bool) -> Vec<(Value, usize)> {
    let places = dependences(func, &vec![false; func.ops.len()], &automata(func, &Modes::default()));
    let mut readers: BTreeMap<Value, HashSet<usize>> = BTreeMap::new();
    for (op, place) in func.ops.iter().zip(places) {
        let Group::Within(k) = place else { continue };
        op.each_operand(|operand| {
            if wanted(func.op(operand)) {
                readers.entry(operand).or_default().insert(k);
            }
        });
    }
    readers.into_iter().map(|(value, readers)| (value, readers.len())).collect()
}

/// The automata of a function: loads that are only selected and compared with constants; and their modes: these
/// constants and those in `known`, as bits.
fn automata(func: &Func, known: &Modes) -> Vec<(Value, Vec<u64>)> {
    let mut found: HashMap<Value, Option<Vec<u64>>> = HashMap::default();
    for op in &func.ops {
        if let Some((load, _, bits)) = number_asked(*op, |value| func.op(value)) {
            let modes = found.entry(load).or_insert_with(|| Some(Vec::new()));
            modes.iter_mut().filter(|modes| !modes.contains(&bits)).for_each(|modes| modes.push(bits));
        } else if !matches!(op, Op::Select(..)) {
            op.each_operand(|operand| {
                if matches!(func.op(operand), Op::Load(_)) {
                    found.insert(operand, None);
                }
            });
        }
    }
    for (load, modes) in &mut found {
        let (Some(modes), Op::Load(slot)) = (modes, func.op(*load)) else { continue };
        let more = known.get(&slot).into_iter().flatten().filter(|bits| !modes.contains(bits));
        let more: Vec<u64> = more.copied().collect();
        modes.extend(more);
    }
    let within_limit =
        |(load, modes): (Value, Option<Vec<u64>>)| Some((load, modes.filter(|it| it.len() <= MAX_MODES)?));
    let mut found: Vec<(Value, Vec<u64>)> = found.into_iter().filter_map(within_limit).collect();
    found.sort_unstable();
    found
}

/// For each operation, whether it depends on no automaton, on one or on several.
fn dependences(func: &Func, cold: &[bool], automata: &[(Value, Vec<u64>)]) -> Vec<Group> {
    let number: HashMap<Value, usize> = automata.iter().enumerate().map(|(k, (load, _))| (*load, k)).collect();
    let mut of: Vec<Group> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut place = Group::Common;
        op.each_operand(|operand| {
            let of = number.get(&operand).map_or(of[operand.index()], |k| Group::Within(*k));
            place = match (place, of) {
                (Group::Common, of) => of,
                (place, Group::Common) => place,
                (place, of) if place == of => place,
                _ => Group::Joint,
            };
        });
        of.push(place);
    }
    for (place, _) in of.iter_mut().zip(cold).filter(|(_, cold)| **cold) {
        *place = Group::Cold;
    }
    of
}

/// Rematerialises cheap operations whose results only modes read, in each of these modes: loads of slots that are not
/// stored, and changes of sign.
fn rematerialise_cheap(func: &Func, places: &mut [Group]) {
    let mut needed_elsewhere = vec![false; func.ops.len()];
    func.results().for_each(|value| needed_elsewhere[value.index()] = true);
    for (i, op) in func.ops.iter().enumerate().rev() {
        let is_cheap = match op {
            Op::Load(slot) => func.stores.iter().all(|(stored, _)| stored != slot),
            op => matches!(op, Op::Neg(_) | Op::Abs(_)),
        };
        if places[i] == Group::Common && !needed_elsewhere[i] && is_cheap {
            places[i] = Group::Rematerialised;
        }
        if !matches!(places[i], Group::Within(_) | Group::Rematerialised) {
            op.each_operand(|operand| needed_elsewhere[operand.index()] = true);
        }
    }
}

/// Moves operations of guards after all automata where the only mode-dependent values that they read are stored ones. The
/// operations are then the same in each mode.
fn move_guards_after(func: &Func, guard: Option<Value>, places: &mut [Group]) {
    let mut stored = vec![false; func.ops.len()];
    func.stores.iter().for_each(|(_, value)| stored[value.index()] = true);
    let mut needed = stored.clone();
    for write in &func.writes {
        [write.index, write.value].iter().for_each(|value| needed[value.index()] = true);
    }
    if let Some(status) = func.status.filter(|_| guard.is_none()) {
        needed[status.index()] = true;
    }
    for i in (0..func.ops.len()).rev().filter(|i| places[*i] != Group::Cold) {
        if needed[i] {
            func.ops[i].each_operand(|operand| needed[operand.index()] = true);
        }
    }
    for (i, op) in func.ops.iter().enumerate().filter(|(i, _)| !needed[*i]) {
        let (mut same, mut reads_joint) = (true, false);
        op.each_operand(|operand| {
            let operand = operand.index();
            same &= stored[operand] || !matches!(places[operand], Group::Within(_));
            reads_joint |= places[operand] == Group::Joint;
        });
        if matches!(places[i], Group::Within(_)) && (same || reads_joint) {
            places[i] = Group::Joint;
        }
    }
}

/// The residual operations for the mode `bits` of the slot that `load` reads. `available`: values computed before.
/// `next`: which of the outputs is the next mode, if any is.
fn case(
    build: &mut Build,
    available: &mut HashSet<Value>,
    (load, bits): (Value, u64),
    members: &[Value],
    (outputs, next): (&[Value], Option<usize>),
) -> ModeCase {
    let held = build.op(Op::Real(bits));
    let outputs = partial_eval(build, members, &[(load, held)], outputs);
    split_case(build, available, outputs, next.map(|next| (next, held)), 0)
}

/// Splits a case by the condition that most operations test, if both sides together then have less to do; or else by the
/// condition under which the mode changes, which happens rarely.
fn split_case(
    build: &mut Build,
    available: &mut HashSet<Value>,
    outputs: Vec<Value>,
    next: Option<(usize, Value)>,
    depth: usize,
) -> ModeCase {
    let list = slice(build, available, &outputs);
    if depth == MAX_DEPTH || list.len() > MAX_SPLIT_OPS {
        return ModeCase { list, end: CaseEnd::Outputs(outputs) };
    }
    let frequent = most_tested(build, &list).filter(|_| list.len() >= MIN_SPLIT_OPS);
    let changes_mode = next.and_then(|(next, held)| match build.get(outputs[next]) {
        Op::Select(when, yes, no) if [yes, no].contains(&held) => Some(when),
        _ => None,
    });
    for condition in frequent.into_iter().chain(changes_mode) {
        let first = slice(build, available, &[condition]);
        let sides = [true, false].map(|truth| {
            let known = known(build, condition, truth);
            partial_eval(build, &list, &known, &outputs)
        });
        available.extend(&first);
        let shorter = |build: &Build, available: &HashSet<Value>| {
            let lengths = sides.each_ref().map(|outputs| slice(build, available, outputs).len());
            // A compound condition becomes short-circuit branches in any case, so the split adds no branch.
            let jump = if matches!(build.get(condition), Op::And(..) | Op::Or(..)) { 0 } else { 2 };
            first.len() + lengths.iter().sum::<usize>().div_ceil(2) + jump < list.len()
        };
        let case = (changes_mode == Some(condition) || shorter(build, available)).then(|| {
            let sides = sides.map(|outputs| split_case(build, available, outputs, next, depth + 1));
            ModeCase { list: first.clone(), end: CaseEnd::Branch(condition, Box::new(sides)) }
        });
        first.iter().for_each(|value| _ = available.remove(value));
        if let Some(case) = case {
            return case;
        }
    }
    ModeCase { list, end: CaseEnd::Outputs(outputs) }
}

/// The boolean that most operations of a list read, if more than one does; the first of several.
fn most_tested(build: &Build, list: &[Value]) -> Option<Value> {
    let mut counts: HashMap<Value, usize> = HashMap::default();
    for value in list {
        let op = build.get(*value);
        if matches!(op, Op::Not(_)) {
            continue;
        }
        op.each_operand(|operand| {
            let operand = if let Op::Not(of) = build.get(operand) { of } else { operand };
            if build.type_of(operand) == Type::Bool {
                *counts.entry(operand).or_default() += 1;
            }
        });
    }
    let most = counts.into_iter().filter(|(_, times)| *times > 1);
    most.max_by_key(|(value, times)| (*times, Reverse(*value))).map(|(value, _)| value)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A spring in slot 3 that moves while slot 4, its mode, is 0; in mode 1 it takes a product, in any other it keeps
    /// its value.
    #[test]
    fn each_mode_has_only_its_residual_operations() {
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
        let specialised = specialise(&func, &Modes::default(), &vec![false; func.ops.len()], None);
        let [automaton] = &specialised.automata[..] else { panic!("one automaton") };
        assert_eq!((automaton.slot, &specialised.joint[..]), (Slot(4), &[][..]));
        let shown = |case: &ModeCase| -> Vec<String> {
            case.list
                .iter()
                .map(|value| specialised.func.op(*value).to_string())
                .map(|op| op[..3].to_string())
                .collect()
        };
        let cases: Vec<(f64, Vec<String>)> =
            automaton.cases.iter().map(|(bits, case)| (f64::from_bits(*bits), shown(case))).collect();
        let names = |text: &str| text.split(' ').map(String::from).collect::<Vec<_>>();
        assert_eq!(cases, [(0.0, names("loa loa loa mul fma les")), (1.0, names("loa loa mul"))]);
        assert_eq!(shown(&automaton.general).iter().filter(|op| *op == "sel").count(), 3);
        // The next mode is branched on, not selected; neither side has any operations left.
        let CaseEnd::Branch(_, sides) = &automaton.cases[0].1.end else { panic!("it branches") };
        let next = sides.each_ref().map(|side| match (&side.list[..], &side.end) {
            ([], CaseEnd::Outputs(outputs)) => outputs.last().map(|output| specialised.func.op(*output)),
            _ => panic!("it ends"),
        });
        assert_eq!(next, [1f64, 0.0].map(|number| Some(Op::Real(number.to_bits()))));
    }

    /// Slot 4 is a mode; in mode 0 the step tests four times whether the force in slot 5 is above the one in slot 6.
    #[test]
    fn a_condition_tested_often_is_tested_once() {
        let mut build = Build::new("step");
        let [x, regime, v, w] = [3, 4, 5, 6].map(|slot| build.load(Slot(slot)));
        let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
        let (rests, above) = (build.equal(regime, zero), build.less(w, v));
        let below = build.not(above);
        let (leaves, stays) = (build.and(rests, above), build.and(rests, below));
        let mut next = x;
        for (condition, other) in [(leaves, v), (stays, w), (leaves, w), (stays, v)] {
            let moved = build.mul(next, other);
            next = build.select(condition, moved, next);
        }
        let changed = build.select(leaves, one, regime);
        build.store(Slot(3), next);
        build.store(Slot(4), changed);
        let func = build.finish();
        let specialised = specialise(&func, &Modes::default(), &vec![false; func.ops.len()], None);
        let CaseEnd::Branch(condition, sides) = &specialised.automata[0].cases[0].1.end else { panic!("it branches") };
        assert!(matches!(specialised.func.op(*condition), Op::Less(..)));
        for side in sides.iter() {
            let products = side.list.iter().filter(|value| matches!(specialised.func.op(**value), Op::Mul(..))).count();
            let choices =
                side.list.iter().filter(|value| matches!(specialised.func.op(**value), Op::Select(..))).count();
            assert_eq!((products, choices), (2, 0));
        }
    }
}
