//! Lowering: turns a checked system into straight-line functions over one block.
//!
//! In: a [`System`] without algebraic loops, its [`Types`], and the expressions to observe. Out: a [`Program`]. Later
//! stages know no units, and use names for printing only.

mod lookup;
mod emit;
mod evaluate;
mod roots;
mod transitions;

pub use evaluate::{ParamValue, evaluate, formulas, independent, of_params};

use emit::Emit;
use evaluate::evaluate_in;

use crate::frontend::causality::Phase;
use crate::frontend::delays;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::Func;
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::program::Program;
use crate::lower::lookup::Lookup;
use crate::ranges::reach::Reach;
use abi::description::{Automaton, Delay, Description, Guard, Kind, Layout, Quantity, Slot, TINY, Tick};
use abi::unit::Unit;
use std::sync::Arc;

/// Location of a quantity's value at run time.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Location {
    /// Computed on demand.
    Computed,
    /// Stored in this slot.
    Slot(Slot),
}

/// An expression to observe as a quantity.
pub struct Observed {
    /// The expression.
    pub expr: ExprId,
    /// The expression as written.
    pub text: String,
    /// Unit for display; `None` for the expression's own unit.
    pub unit: Option<Unit>,
}

/// A lowered program.
pub struct Lowered {
    /// The program.
    pub program: Program,
    /// Slot of each observed expression, in the order of the request.
    pub observed: Vec<Slot>,
}

/// Lowers a system; `wanted` are the expressions to observe.
pub fn lower(system: &System, types: &Types, wanted: &[Observed]) -> Lowered {
    let mut pool = [&crate::math::POOL, crate::numerics::rosenbrock::constants()].concat();
    let tables = Lookup::place_all(&system.tables, &mut pool);
    let mut plan = Plan::new(system, types, wanted, &believed(system), tables);
    plan.description.pool = Arc::from(pool);
    let emit = |name: &str, phase: Phase| Emit::new(&plan, name, phase);

    let start = plan.start(emit("start", Phase::Start));
    let outputs = plan.outputs(emit("outputs", Phase::Now));
    let derivatives = plan.derivatives(emit("derivatives", Phase::Now));
    let tick = (!system.blocks.is_empty()).then(|| plan.tick(emit("tick", Phase::Tick)));
    let moves = !system.automata.is_empty() || !system.events.is_empty() || !system.crossings.is_empty();
    let mut balanced = false;
    let transitions = moves.then(|| plan.transitions(emit("transitions", Phase::Now), &mut balanced));
    let (roots, surfaces) = plan.roots(emit("roots", Phase::Now));
    let params = evaluate_in(&plan, &plan.param_values);

    let mut description = std::mem::take(&mut plan.description);
    description.layout.roots.len = surfaces.len() as u32;
    let (states, n) = (description.layout.states, description.layout.states.len as usize);
    if (LEAST_COUPLED..=MOST_COUPLED).contains(&n) {
        let slots = |segment: abi::description::Segment| segment.range().map(|slot| Slot(slot as u32)).collect();
        let (rows, columns): (Vec<Slot>, Vec<Slot>) = (slots(description.layout.derivatives), slots(states));
        let coupling = crate::numerics::autodiff::coupling(&derivatives, &rows, &columns, n * MOST_ENTRIES.min(n / 4))
            .unwrap_or_default();
        if !coupling.is_empty() {
            description.layout.jacobian.len = (coupling.len() + n) as u32;
            description.coupling = coupling.into();
        }
    }
    // The segments after the roots move up by the number of roots.
    let lens = {
        let l = &description.layout;
        [l.params, l.inputs, l.states, l.memory, l.regimes, l.outputs, l.derivatives, l.roots, l.jacobian, l.due]
            .map(|segment| segment.len)
    };
    let mut moved = Layout::new(lens);
    // Delayed values are looked up by the caller before each evaluation, so a model with delays has no fused step.
    if (1..=MOST_FUSED).contains(&moved.states.len) && description.delays.is_empty() {
        moved = moved.with_trial(description.guards.len() as u32);
    }
    let shift = |slot: Slot| match description.layout.due.contains(slot) {
        true => Slot(slot.0 - description.layout.due.start + moved.due.start),
        false => slot,
    };
    for tick in &mut description.ticks {
        tick.due = shift(tick.due);
    }
    let tick = tick.map(|func| renamed(func, &shift));
    description.layout = moved;
    description.roots = surfaces;
    let roots = (description.layout.roots.len > 0).then_some(roots);
    let observed = plan.observed.clone();
    let program = Program {
        description,
        params,
        start,
        outputs,
        derivatives,
        tick,
        transitions,
        roots,
        balanced,
        left_out: Vec::new(),
    };
    Lowered { program, observed }
}

/// The function with its loads relocated.
fn renamed(mut func: Func, slot: &impl Fn(Slot) -> Slot) -> Func {
    for op in &mut func.ops {
        if let crate::ir::Op::Load(at) = op {
            *at = slot(*at);
        }
    }
    func
}

/// The layout: which quantity is stored where.
struct Plan<'a> {
    system: &'a System,
    types: &'a Types,
    description: Description,
    places: Vec<Location>,
    param_values: Vec<ExprId>,
    states: Vec<VarId>,
    sampled: Vec<VarId>,
    held: Vec<VarId>,
    periods: Vec<Slot>,
    crossings: Vec<Slot>,
    events: Vec<Slot>,
    /// Index of each call of `delay`.
    delayed: HashMap<ExprId, usize>,
    /// The quantity or expression of each output slot.
    outputs: Vec<Output>,
    observed: Vec<Slot>,
    /// Expressions that are observed during the run.
    wanted: Vec<ExprId>,
    tables: Vec<Lookup>,
}

#[derive(Clone, Copy)]
enum Output {
    Var(VarId),
    Expr(ExprId),
}

/// Location of an observed value.
enum ObservedAt {
    /// In the slot of this quantity.
    Var(VarId),
    /// In the output slot of this index.
    Output(usize),
}

/// Appends an output and returns its index.
fn added(outputs: &mut Vec<Output>, output: Output) -> usize {
    outputs.push(output);
    outputs.len() - 1
}

impl<'a> Plan<'a> {
    /// `watched`: computed quantities whose declared ranges are guarded, in addition to outputs.
    fn new(
        system: &'a System,
        types: &'a Types,
        wanted: &[Observed],
        watched: &[VarId],
        tables: Vec<Lookup>,
    ) -> Plan<'a> {
        let independent = independent_params(system);
        let by = |test: &dyn Fn(&Var) -> bool| -> Vec<VarId> {
            system.var_ids().filter(|id| test(system.var(*id))).collect()
        };
        let params: Vec<VarId> = system.var_ids().filter(|id| independent[id.0 as usize]).collect();
        let inputs = by(&|v| matches!(v.definition, Definition::Free) && v.kind == VarKind::Input);
        let states = by(&|v| matches!(v.definition, Definition::Continuous { .. }));
        let sampled = by(&|v| matches!(v.definition, Definition::Sampled { .. }));
        let held = by(&|v| matches!(v.definition, Definition::Held { .. }));
        let ranged = |v: &Var| v.range.low.is_some() || v.range.high.is_some();
        let mut outputs: Vec<Output> = by(&|v| {
            v.kind == VarKind::Output
                && matches!(v.definition, Definition::Value(..))
                && (v.instance == InstanceId(0) || ranged(v))
        })
        .into_iter()
        .map(Output::Var)
        .collect();
        outputs.extend(watched.iter().copied().map(Output::Var));
        // A plain name of a quantity with a slot needs no output slot. A parameter without a value has no slot.
        let stored: HashSet<VarId> =
            [&params, &inputs, &states, &sampled, &held].into_iter().flatten().copied().collect();
        let named = |id: VarId, outputs: &mut Vec<Output>| match stored.contains(&id) {
            true => ObservedAt::Var(id),
            false => {
                let known = outputs.iter().position(|output| matches!(output, Output::Var(other) if *other == id));
                ObservedAt::Output(known.unwrap_or_else(|| added(outputs, Output::Var(id))))
            }
        };
        let mut shared: HashMap<String, usize> = HashMap::default();
        let mut observed_at: Vec<ObservedAt> = Vec::new();
        for one in wanted {
            observed_at.push(match system.node(one.expr) {
                Node::Var(id) => named(*id, &mut outputs),
                _ => {
                    let at = shared.entry(one.text.clone());
                    ObservedAt::Output(*at.or_insert_with(|| added(&mut outputs, Output::Expr(one.expr))))
                }
            });
        }
        let source = |delay: &ExprId| {
            let (value, _) = delays::of(system, *delay);
            match system.node(value) {
                Node::Var(id) => named(*id, &mut outputs),
                _ => ObservedAt::Output(added(&mut outputs, Output::Expr(value))),
            }
        };
        let sources: Vec<ObservedAt> = system.delays.iter().map(source).collect();
        let memory = sampled.len() + held.len() + system.blocks.len() + system.crossings.len() + system.events.len();
        let memory = memory + 5 * system.delays.len();
        let n = states.len();
        let jacobian = if n <= MOST_JACOBIAN { n * n + n } else { 0 };
        let layout = Layout::new(
            [
                params.len(),
                inputs.len(),
                n,
                memory,
                system.automata.len(),
                outputs.len(),
                n,
                0,
                jacobian,
                system.blocks.len(),
            ]
            .map(|len| len as u32),
        );
        let mut places = vec![Location::Computed; system.vars.len()];
        let mut put = |vars: &[VarId], segment: abi::description::Segment, from: usize| {
            for (k, id) in vars.iter().enumerate() {
                places[id.0 as usize] = Location::Slot(segment.slot(from + k));
            }
        };
        put(&params, layout.params, 0);
        put(&inputs, layout.inputs, 0);
        put(&states, layout.states, 0);
        put(&sampled, layout.memory, 0);
        put(&held, layout.memory, sampled.len());
        let mut next = sampled.len() + held.len();
        let mut take = |count: usize| -> Vec<Slot> {
            let slots = (next..next + count).map(|k| layout.memory.slot(k)).collect();
            next += count;
            slots
        };
        let periods = take(system.blocks.len());
        let crossings = take(system.crossings.len());
        let events = take(system.events.len());
        let slot_of = |at: &ObservedAt| match at {
            ObservedAt::Output(at) => layout.outputs.slot(*at),
            ObservedAt::Var(id) => match places[id.0 as usize] {
                Location::Slot(slot) => slot,
                Location::Computed => unreachable!("it is stored"),
            },
        };
        let delays = system.delays.iter().zip(&sources).map(|(delay, source)| {
            let (_, time) = delays::of(system, *delay);
            let [at, back, past, weight, slope] = take(5).try_into().expect("five slots");
            Delay {
                time: at,
                // Has been checked; texts with errors are never run.
                range: delays::range(system, time).unwrap_or((0.0, 0.0)),
                back,
                source: slot_of(source),
                past,
                weight: (!delays::breaks(system, system.node(*delay))).then_some(weight),
                slope,
                ring: abi::description::Segment::default(),
            }
        });
        let delays: Vec<Delay> = delays.collect();
        let param_values = params
            .iter()
            .map(|id| match system.var(*id).definition {
                Definition::Value(value, _) => value,
                _ => unreachable!("an independent parameter has a value"),
            })
            .collect();
        let observed = observed_at.iter().map(slot_of).collect();
        let mut plan = Plan {
            system,
            types,
            description: Description { layout, delays, ..Description::default() },
            places,
            param_values,
            states,
            sampled,
            held,
            periods,
            crossings,
            events,
            delayed: system.delays.iter().enumerate().map(|(k, delay)| (*delay, k)).collect(),
            outputs,
            observed,
            wanted: wanted.iter().map(|one| one.expr).collect(),
            tables,
        };
        plan.describe(wanted, watched);
        plan
    }

    fn slot(&self, id: VarId) -> Option<Slot> {
        match self.places[id.0 as usize] {
            Location::Slot(slot) => Some(slot),
            Location::Computed => {
                let mine = |output: &Output| matches!(output, Output::Var(other) if *other == id);
                self.outputs.iter().position(mine).map(|k| self.description.layout.outputs.slot(k))
            }
        }
    }

    fn describe(&mut self, wanted: &[Observed], watched: &[VarId]) {
        let system = self.system;
        let top = system.instances.first().map_or(String::new(), |top| top.model.clone());
        let mut quantities = Vec::new();
        let output_slots: HashMap<VarId, Slot> = self
            .outputs
            .iter()
            .enumerate()
            .filter_map(|(k, output)| match output {
                Output::Var(id) => Some((*id, self.description.layout.outputs.slot(k))),
                Output::Expr(_) => None,
            })
            .collect();
        for id in system.var_ids() {
            let var = system.var(id);
            let slot = match self.places[id.0 as usize] {
                Location::Slot(slot) => slot,
                Location::Computed => match output_slots.get(&id) {
                    Some(slot) => *slot,
                    None => continue,
                },
            };
            let kind = match (var.kind, &var.definition) {
                (VarKind::Param, _) => Kind::Param,
                // An input bound by an argument cannot be set from outside.
                (VarKind::Input, _) if watched.contains(&id) => Kind::Let,
                (VarKind::Input, _) => Kind::Input,
                (VarKind::State, Definition::Sampled { .. }) => Kind::SampledState,
                (VarKind::State, _) => Kind::State,
                (VarKind::Output, _) => Kind::Output,
                (VarKind::Let, _) => Kind::Let,
                (VarKind::Observed, _) => Kind::Observed,
            };
            quantities.push(Quantity {
                path: var.path.clone(),
                kind,
                unit: self.types.units[id.0 as usize].clone(),
                boolean: self.types.boolean_vars[id.0 as usize],
                slot,
                range: (f64::NEG_INFINITY, f64::INFINITY),
                doc: var.doc.clone(),
            });
        }
        for (one, slot) in wanted.iter().zip(&self.observed) {
            if quantities.iter().any(|quantity| quantity.slot == *slot && quantity.path == one.text) {
                continue;
            }
            let unit = one
                .unit
                .clone()
                .unwrap_or_else(|| self.types.nodes[one.expr.0 as usize].map_or_else(Unit::none, Unit::si));
            quantities.push(Quantity {
                path: one.text.clone(),
                kind: Kind::Observed,
                unit,
                boolean: self.types.boolean[one.expr.0 as usize],
                slot: *slot,
                range: (f64::NEG_INFINITY, f64::INFINITY),
                doc: None,
            });
        }
        self.description.name = top;
        self.description.ticks = self
            .periods
            .iter()
            .enumerate()
            .map(|(k, period)| Tick { period: *period, due: self.description.layout.due.slot(k) })
            .collect();
        self.description.automata = system
            .automata
            .iter()
            .enumerate()
            .map(|(k, automaton)| Automaton {
                path: system.instance(automaton.instance).path.clone(),
                regimes: automaton.regimes.iter().map(|regime| regime.name.clone()).collect(),
                slot: self.description.layout.regimes.slot(k),
            })
            .collect();
        self.ranges(&mut quantities);
        self.description.quantities = quantities;
    }

    /// Evaluates the declared ranges of stored quantities and adds the guards for them.
    fn ranges(&mut self, quantities: &mut [Quantity]) {
        let mut bounds: Vec<ExprId> = Vec::new();
        let mut of: Vec<(usize, bool, bool)> = Vec::new();
        let mut strict_zero = vec![(false, false); quantities.len()];
        let index: HashMap<&str, usize> = quantities.iter().enumerate().map(|(k, q)| (q.path.as_str(), k)).collect();
        for var in &self.system.vars {
            let Some(&k) = index.get(var.path.as_str()) else { continue };
            for (bound, high) in [(var.range.low, false), (var.range.high, true)] {
                if let Some((bound, strict)) = bound {
                    bounds.push(bound);
                    of.push((k, high, strict));
                }
            }
        }
        drop(index);
        let values = evaluate_in(self, &bounds);
        for ((k, high, strict), value) in of.into_iter().zip(values) {
            // A bound that is not constant has no guard; the check of ranges reports it.
            if !value.is_nan() {
                let range = &mut quantities[k].range;
                if high {
                    range.1 = value
                } else {
                    range.0 = value
                }
                let side = &mut strict_zero[k];
                *(if high { &mut side.1 } else { &mut side.0 }) = strict && value == 0.0;
            }
        }
        let guards = quantities.iter().zip(strict_zero).filter(|(q, _)| !q.boolean).filter_map(|(q, strict)| {
            let mut range = q.range;
            match q.kind {
                Kind::State | Kind::SampledState | Kind::Output | Kind::Observed => {}
                // Proofs about other quantities rely on these ranges, and no other check covers them.
                Kind::Input | Kind::Let if range != (f64::NEG_INFINITY, f64::INFINITY) => {
                    range.0 = if strict.0 { TINY } else { range.0 };
                    range.1 = if strict.1 { -TINY } else { range.1 };
                }
                Kind::Input | Kind::Let | Kind::Param | Kind::Regime => return None,
            }
            Some(Guard { path: q.path.clone(), slot: q.slot, range, unit: q.unit.clone() })
        });
        self.description.guards = guards.collect();
    }

    fn start(&self, mut emit: Emit) -> Func {
        for id in self.states.iter().chain(&self.held) {
            let value = emit.stored(*id);
            emit.build.store(self.slot(*id).expect("it is stored"), value);
        }
        for id in &self.sampled {
            // The blocks due at 0 have run, so the state takes its next value.
            let Definition::Sampled { next, .. } = self.system.var(*id).definition else {
                unreachable!("it is sampled")
            };
            let value = emit.value(next);
            let value = emit.as_number(value);
            emit.build.store(self.slot(*id).expect("it is stored"), value);
        }
        for (block, slot) in self.system.blocks.iter().zip(&self.periods) {
            let value = emit.value(block.period);
            emit.build.store(*slot, value);
        }
        for (delay, described) in self.system.delays.iter().zip(&self.description.delays) {
            let (value, time) = delays::of(self.system, *delay);
            let (value, time, zero) = (emit.value(value), emit.value(time), emit.build.real(0.0));
            emit.build.store(described.time, time);
            emit.build.store(described.past, value);
            emit.build.store(described.slope, zero);
            emit.build.store(described.weight.unwrap_or(described.slope), zero);
        }
        for slot in &self.crossings {
            let unknown = emit.build.real(f64::NAN);
            emit.build.store(*slot, unknown);
        }
        for slot in &self.events {
            let held = emit.build.real(1.0);
            emit.build.store(*slot, held);
        }
        for (automaton, described) in self.system.automata.iter().zip(&self.description.automata) {
            let initial = emit.build.real(f64::from(automaton.initial));
            emit.build.store(described.slot, initial);
        }
        emit.build.finish()
    }

    fn outputs(&self, mut emit: Emit) -> Func {
        for (k, output) in self.outputs.iter().enumerate() {
            let value = match output {
                Output::Var(id) => emit.var(*id),
                Output::Expr(expr) => emit.value(*expr),
            };
            let value = emit.as_number(value);
            emit.build.store(self.description.layout.outputs.slot(k), value);
        }
        emit.build.finish()
    }

    fn derivatives(&self, mut emit: Emit) -> Func {
        for (k, id) in self.states.iter().enumerate() {
            let Definition::Continuous { rate, .. } = self.system.var(*id).definition else {
                unreachable!("it is continuous")
            };
            let value = emit.value(rate);
            emit.build.store(self.description.layout.derivatives.slot(k), value);
        }
        emit.build.finish()
    }

    fn tick(&self, mut emit: Emit) -> Func {
        for id in &self.held {
            let value = emit.stored(*id);
            emit.build.store(self.slot(*id).expect("it is stored"), value);
        }
        for id in &self.sampled {
            let Definition::Sampled { next, block, .. } = self.system.var(*id).definition else {
                unreachable!("it is sampled")
            };
            let slot = self.slot(*id).expect("it is stored");
            let value = emit.value(next);
            let value = emit.as_number(value);
            let due = emit.due(block);
            let before = emit.build.load(slot);
            let value = emit.build.select(due, value, before);
            emit.build.store(slot, value);
        }
        emit.build.finish()
    }

    /// Stores the signs of crossings and the truth of event conditions. A crossing is true for a single instant and
    /// false in the memory, so that an event fires at every crossing, even at one in each step.
    fn memory(&self) -> Func {
        let mut emit = Emit::new(self, "memory", Phase::Now);
        emit.between = true;
        for (event, slot) in self.system.events.iter().zip(&self.events) {
            let condition = emit.value(event.condition);
            let held = emit.number(condition);
            emit.build.store(*slot, held);
        }
        for (crossing, slot) in self.system.crossings.iter().zip(&self.crossings) {
            let difference = emit.value(crossing.difference);
            emit.build.store(*slot, difference);
        }
        emit.build.finish()
    }
}

/// Limit on the number of states for a dense Jacobian in the block.
pub const MOST_JACOBIAN: usize = 200;

/// Sparsity is computed for systems with at least `LEAST_COUPLED` and at most `MOST_COUPLED` states, and used if a
/// state depends on at most `MOST_ENTRIES` others on average; otherwise it does not pay.
const LEAST_COUPLED: usize = 40;
const MOST_COUPLED: usize = 20_000;
const MOST_ENTRIES: usize = 40;

/// Limit on the number of states of an adaptive run with a dense or unknown sparsity. Its matrices take some hundred
/// megabytes.
pub const MOST_DENSE: usize = 2000;

/// Limit on the number of states for an adaptive step that is a single function.
const MOST_FUSED: u32 = 8;

/// Computed inputs and `let`s whose declared range cannot be proven and is therefore assumed.
fn believed(system: &System) -> Vec<VarId> {
    let mut reach: Option<Reach> = None;
    let ids = system.var_ids().filter(|id| {
        let var = system.var(*id);
        let ranged = var.range.low.is_some() || var.range.high.is_some();
        let computed = matches!(var.definition, Definition::Value(..));
        if crate::interval::planted::is("beliefs are not watched") {
            return false;
        }
        if !ranged || !computed || !matches!(var.kind, VarKind::Input | VarKind::Let) {
            return false;
        }
        let reach = reach.get_or_insert_with(|| Reach::new(system));
        let (value, bounds) = (reach.unbound(*id), reach.bounds(*id));
        // A value proven to be positive satisfies `> 0`, even below [`TINY`].
        let low = value.low >= bounds.low || bounds.low == TINY && value.low > 0.0;
        let high = value.high <= bounds.high || bounds.high == -TINY && value.high < 0.0;
        !(low && high)
    });
    ids.collect()
}

/// Whether each quantity is a parameter whose value depends on no other quantity.
fn independent_params(system: &System) -> Vec<bool> {
    let mut out = vec![false; system.vars.len()];
    for (k, var) in system.vars.iter().enumerate() {
        if let (VarKind::Param, Definition::Value(value, _)) = (var.kind, &var.definition) {
            let mut stack = vec![*value];
            let mut free = true;
            while let Some(id) = stack.pop() {
                let node = system.node(id);
                free &= !matches!(
                    node,
                    Node::Var(_)
                        | Node::Time
                        | Node::Rate(_)
                        | Node::PathRate(_)
                        | Node::InRegime(..)
                        | Node::Crossing(_)
                );
                stack.extend(node.operands());
            }
            out[k] = free;
        }
    }
    out
}
