//! Lowering: turns a checked system into straight-line functions over one block.
//!
//! In: a [`System`] without algebraic loops, its [`Types`], and the expressions to observe. Out: a [`Program`]. Later
//! stages know no units, and use names for printing only.

mod lookup;

use crate::frontend::causality::{Phase, rate_of, value_of};
use crate::frontend::delays;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::build::{Build, Env};
use crate::ir::program::Program;
use crate::ir::{Binary, Func, Type, Unary, Value};
use crate::lower::lookup::Lookup;
use crate::numerics::impulse;
use crate::ranges::reach::Reach;
use abi::description::{Automaton, Delay, Description, Guard, Kind, Layout, Quantity, Root, Slot, TINY, Tick};
use abi::unit::Unit;
use grammar::ast::BinaryOp;
use std::collections::{HashMap, HashSet};
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
    let program = Program { description, params, start, outputs, derivatives, tick, transitions, roots, balanced };
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

/// Values of expressions that depend on parameters only, with each parameter at its default. An expression that depends
/// on anything else is NaN.
pub fn evaluate(system: &System, types: &Types, exprs: &[ExprId]) -> Vec<f64> {
    let mut pool = crate::math::POOL.to_vec();
    let tables = Lookup::place_all(&system.tables, &mut pool);
    let mut plan = Plan::new(system, types, &[], &[], tables);
    plan.description.pool = Arc::from(pool);
    evaluate_in(&plan, exprs)
}

/// Compiles expressions of parameters to a function that reads the parameters in a block and runs as at the start. Also
/// returns the size of the block; its last slots receive the values.
pub fn formulas(system: &System, types: &Types, exprs: &[ExprId]) -> (Func, usize) {
    let mut pool = crate::math::POOL.to_vec();
    let tables = Lookup::place_all(&system.tables, &mut pool);
    let mut plan = Plan::new(system, types, &[], &[], tables);
    plan.description.pool = Arc::from(pool);
    let mut emit = Emit::new(&plan, "formulas", Phase::Start);
    let from = plan.description.layout.size();
    for (k, expr) in exprs.iter().enumerate() {
        let value = emit.value(*expr);
        let value = emit.as_number(value);
        emit.build.store(Slot((from + k) as u32), value);
    }
    (crate::math::expand(&emit.build.finish()), from + exprs.len())
}

/// Number of parameters that depend on no other quantity. Only these have slots.
pub fn independent(system: &System) -> u32 {
    independent_params(system).iter().map(|free| u32::from(*free)).sum()
}

/// A value that [`of_params`] computes.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ParamValue {
    /// The value of a quantity. For an independent parameter this is the content of its slot.
    Var(VarId),
    /// An expression.
    Expr(ExprId),
}

/// A program that computes these values from parameters alone, each into the output slot of its index, and the slot of
/// each independent parameter. Values that are not constant during a run are NaN, as in [`evaluate`].
pub fn of_params(system: &System, types: &Types, sought: &[ParamValue]) -> (Program, Vec<(VarId, Slot)>) {
    let mut pool = crate::math::POOL.to_vec();
    let tables = Lookup::place_all(&system.tables, &mut pool);
    let mut plan = Plan::new(system, types, &[], &[], tables);
    plan.description.pool = Arc::from(pool);
    let mut emit = Emit::new(&plan, "of params", Phase::Start);
    emit.inline_params = true;
    emit.loads_params = true;
    let count = |len: usize| u32::try_from(len).expect("there are fewer slots");
    let params = plan.description.layout.params;
    let layout = Layout::new([params.len, 0, 0, 0, 0, count(sought.len()), 0, 0, 0, 0]);
    for (k, one) in sought.iter().enumerate() {
        let value = match one {
            ParamValue::Var(id) => emit.stored(*id),
            ParamValue::Expr(expr) => {
                let value = emit.value(*expr);
                emit.as_number(value)
            }
        };
        emit.build.store(layout.outputs.slot(k), value);
    }
    let description =
        Description { name: "judge".into(), layout, pool: plan.description.pool.clone(), ..Description::default() };
    let own = system.var_ids().filter_map(|id| match plan.places[id.0 as usize] {
        Location::Slot(slot) if params.contains(slot) => Some((id, slot)),
        Location::Slot(_) | Location::Computed => None,
    });
    let slots = own.collect();
    let outputs = emit.build.finish();
    let program =
        Program { description, params: evaluate_in(&plan, &plan.param_values), outputs, ..Program::default() };
    (program, slots)
}

fn evaluate_in(plan: &Plan, exprs: &[ExprId]) -> Vec<f64> {
    if exprs.is_empty() {
        return Vec::new();
    }
    let mut emit = Emit::new(plan, "constants", Phase::Start);
    emit.inline_params = true;
    for (k, expr) in exprs.iter().enumerate() {
        let value = emit.value(*expr);
        let value = emit.as_number(value);
        emit.build.store(Slot(Slot::FIXED + k as u32), value);
    }
    let func = emit.build.finish();
    let mut block = vec![0.0; Slot::FIXED as usize + exprs.len()];
    crate::ir::interpret::run_once(&crate::math::expand(&func), &mut block, &plan.description.pool);
    block.split_off(Slot::FIXED as usize)
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
        let mut shared: HashMap<String, usize> = HashMap::new();
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

    /// Sets `balanced` to whether a contact stops the mass on which it acts.
    fn transitions(&self, mut emit: Emit, balanced: &mut bool) -> Func {
        // For each state: its resets with their conditions, in the order of the text.
        let mut resets: HashMap<VarId, Vec<(Value, Value)>> = HashMap::new();
        let mut order: Vec<VarId> = Vec::new();
        let mut note = |emit: &mut Emit, fires: Value, list: &[(VarId, ExprId)]| {
            for (var, value) in list {
                let value = emit.value(*value);
                let value = emit.as_number(value);
                let all = resets.entry(*var).or_insert_with(|| {
                    order.push(*var);
                    Vec::new()
                });
                all.push((fires, value));
            }
        };
        for (automaton, described) in self.system.automata.iter().zip(&self.description.automata) {
            let now = emit.build.load(described.slot);
            let mut next = now;
            for (k, regime) in automaton.regimes.iter().enumerate() {
                let number = emit.build.real(k as f64);
                let active = emit.build.equal(now, number);
                let mut open = active;
                for transition in &regime.transitions {
                    let condition = emit.value(transition.condition);
                    let fires = emit.build.and(open, condition);
                    let target = emit.build.real(f64::from(transition.target));
                    next = emit.build.select(fires, target, next);
                    let not = emit.build.not(condition);
                    open = emit.build.and(open, not);
                    note(&mut emit, fires, &transition.resets);
                }
            }
            emit.build.store(described.slot, next);
        }
        for (event, slot) in self.system.events.iter().zip(&self.events) {
            let condition = emit.value(event.condition);
            let before = emit.build.load(*slot);
            let zero = emit.build.real(0.0);
            let was_false = emit.build.equal(before, zero);
            let fires = emit.build.and(condition, was_false);
            note(&mut emit, fires, &event.resets);
        }
        let (inputs, states): (Vec<VarId>, Vec<VarId>) =
            order.into_iter().partition(|var| self.system.var(*var).kind == VarKind::Input);
        // Each impulse needs three slots, allocated downwards: whether it acts, the target value, the force.
        let mut impulses: Vec<(Func, [Slot; 3])> = Vec::new();
        for var in inputs {
            let Some((func, force)) = self.impulse(var) else { continue };
            let (mut acts, mut target) = (emit.build.truth(false), emit.build.real(0.0));
            for (fires, value) in resets[&var].iter().rev() {
                acts = emit.build.or(acts, *fires);
                target = emit.build.select(*fires, *value, target);
            }
            // A contact that bounces has no holding force.
            let holds = resets[&var].iter().all(|(_, value)| emit.build.constant(*value) == Some(0.0));
            let force = if holds { emit.var(force) } else { emit.build.real(0.0) };
            let values = [emit.number(acts), target, force];
            let slots = [0, 1, 2].map(|k| Slot(impulse::PRESENT.0 - 1 - (3 * impulses.len() + k) as u32));
            slots.into_iter().zip(values).for_each(|(slot, value)| emit.build.store(slot, value));
            impulses.push((func, slots));
        }
        for var in states {
            let slot = self.slot(var).expect("a state is stored");
            let mut value = emit.build.load(slot);
            // The first reset of the text takes precedence, so it is applied last.
            for (fires, reset) in resets[&var].iter().rev() {
                value = emit.build.select(*fires, *reset, value);
            }
            emit.build.store(slot, value);
        }
        let changes = emit.build.finish();
        let memory = self.memory();
        let (mut all, mut env) = (Build::new("transitions").with_pool(self.description.pool.clone()), Env::new());
        all.inline(&changes, &mut env);
        for (func, slots) in &impulses {
            for (slot, of) in [impulse::ACTS, impulse::TARGET, impulse::PRESENT].into_iter().zip(slots) {
                let value = all.read(*of, &env);
                env.insert(slot, value);
            }
            all.inline(func, &mut env);
        }
        *balanced = !impulses.is_empty();
        // The memory holds values after the resets, with which the next instant is compared.
        all.inline(&memory, &mut env);
        let size = self.description.layout.size() as u32;
        all.store_env(&env, |slot| slot.0 < size);
        all.finish()
    }

    /// The function that sets an input by an impulse of a force, and that force: the first output of the input's part
    /// that moves a state on which the input depends. `None` for an input that no output moves, such as a measured
    /// speed.
    fn impulse(&self, input: VarId) -> Option<(Func, VarId)> {
        let mut emit = Emit::new(self, "speed", Phase::Now);
        let value = emit.var(input);
        emit.build.store(impulse::SPEED, value);
        let speed = emit.build.finish();
        let part = self.system.var(input).instance;
        let force = |id: &VarId| {
            let var = self.system.var(*id);
            var.instance == part && var.kind == VarKind::Output && !self.types.boolean_vars[id.0 as usize]
        };
        let slots = |segment: abi::description::Segment| -> Vec<Slot> {
            (0..segment.len as usize).map(|k| segment.slot(k)).collect()
        };
        let layout = &self.description.layout;
        let (states, derivatives) = (slots(layout.states), slots(layout.derivatives));
        self.system.var_ids().filter(force).find_map(|output| {
            let mut emit = Emit::new(self, "rates", Phase::Now);
            emit.replaced = Some(output);
            let rates = self.derivatives(emit);
            let func = impulse::impulse(&speed, &rates, &states, &derivatives, &self.description.pool)?;
            Some((func, output))
        })
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

    /// Switching surfaces: functions of the state that change their sign where a branch in the rates or in the observed
    /// expressions changes, or where a transition or event occurs.
    fn roots(&self, mut emit: Emit) -> (Func, Vec<Root>) {
        // Conditions first: a surface that a branch shares with a condition counts as the condition's.
        let mut from: Vec<ExprId> = Vec::new();
        for automaton in &self.system.automata {
            from.extend(automaton.regimes.iter().flat_map(|regime| &regime.transitions).map(|t| t.condition));
        }
        from.extend(self.system.events.iter().map(|event| event.condition));
        let deciding = self.comparisons(&from);
        for id in &self.states {
            if let Definition::Continuous { rate, .. } = self.system.var(*id).definition {
                from.push(rate);
            }
        }
        let mut seen = vec![false; self.system.nodes.len()];
        let mut stack = from;
        stack.reverse();
        // The flag says that derivatives are continuous there and only have a kink.
        let mut surfaces: Vec<(Value, ExprId, bool)> = Vec::new();
        let mut known: HashMap<Value, usize> = HashMap::new();
        let mut moving: HashMap<Value, bool> = HashMap::new();
        // Observed quantities come last, because their surfaces must not affect the course of a run.
        let mut own = None;
        loop {
            let Some(id) = stack.pop() else {
                if own.is_some() {
                    break;
                }
                own = Some(surfaces.len());
                stack.extend(self.wanted.iter().rev());
                continue;
            };
            if std::mem::replace(&mut seen[id.0 as usize], true) {
                continue;
            }
            let node = self.system.node(id);
            let mut operands: Vec<ExprId> = node.operands().collect();
            operands.extend(rate_of(self.system, node));
            match node {
                Node::Var(var) => operands.extend(value_of(self.system.var(*var), Phase::Now)),
                Node::Crossing(crossing) => operands.push(self.system.crossings[*crossing as usize].difference),
                _ => {}
            }
            stack.extend(operands.into_iter().rev());
            let bends = matches!(node, Node::Call(Builtin::Abs | Builtin::Min | Builtin::Max | Builtin::Clamp, _));
            let mut add = |emit: &mut Emit, value: Value| {
                if !emit.moves(value, &mut moving) {
                    return;
                }
                let place = *known.entry(value).or_insert(surfaces.len());
                match surfaces.get_mut(place) {
                    // A branch in an observed quantity does not affect the derivatives.
                    Some(surface) => surface.2 &= bends || own.is_some_and(|own| place < own),
                    None => surfaces.push((value, id, bends)),
                }
            };
            match node {
                Node::Binary(
                    BinaryOp::Less | BinaryOp::LessEqual | BinaryOp::Greater | BinaryOp::GreaterEqual,
                    a,
                    b,
                ) => {
                    let (a, b) = (emit.value(*a), emit.value(*b));
                    let surface = emit.build.sub(a, b);
                    add(&mut emit, surface);
                }
                Node::Crossing(crossing) => {
                    let surface = emit.value(self.system.crossings[*crossing as usize].difference);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Abs | Builtin::Sign, args) => {
                    let surface = emit.value(args[0]);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Min | Builtin::Max, args) => {
                    let (a, b) = (emit.value(args[0]), emit.value(args[1]));
                    let surface = emit.build.sub(a, b);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Clamp, args) => {
                    let x = emit.value(args[0]);
                    for bound in &args[1..] {
                        let bound = emit.value(*bound);
                        let surface = emit.build.sub(x, bound);
                        add(&mut emit, surface);
                    }
                }
                Node::Call(Builtin::Square, args) => {
                    // The sign changes with that of the sine of its phase.
                    let frequency = emit.value(args[1]);
                    let (time, turn) = (emit.build.load(Slot::TIME), emit.build.real(2.0 * std::f64::consts::PI));
                    let phase = emit.build.mul(turn, frequency);
                    let phase = emit.build.mul(phase, time);
                    let surface = emit.build.unary(Unary::Sin, phase);
                    add(&mut emit, surface);
                }
                Node::Call(Builtin::Noise, args) => {
                    let period = emit.value(args[1]);
                    let (time, half) = (emit.build.load(Slot::TIME), emit.build.real(std::f64::consts::PI));
                    let phase = emit.build.mul(half, time);
                    let phase = emit.build.div(phase, period);
                    let surface = emit.build.unary(Unary::Sin, phase);
                    add(&mut emit, surface);
                }
                _ => {}
            }
        }
        let segment =
            abi::description::Segment { start: self.description.layout.roots.start, len: surfaces.len() as u32 };
        let mut roots = Vec::new();
        for (k, (value, id, bends)) in surfaces.iter().enumerate() {
            emit.build.store(segment.slot(k), *value);
            let observed = own.is_some_and(|own| k >= own);
            let (text, decides) = (self.root_text(*id), deciding.contains(id));
            roots.push(Root { text, decides, bends: *bends, observed });
        }
        (emit.build.finish(), roots)
    }

    /// The comparisons and crossings of which conditions consist.
    fn comparisons(&self, conditions: &[ExprId]) -> HashSet<ExprId> {
        let mut out = HashSet::new();
        let mut stack = conditions.to_vec();
        while let Some(id) = stack.pop() {
            match self.system.node(id) {
                Node::Binary(BinaryOp::And | BinaryOp::Or, a, b) => stack.extend([*a, *b]),
                Node::Not(a) => stack.push(*a),
                _ => {
                    out.insert(id);
                }
            }
        }
        out
    }

    /// A short name of a surface, from which the caller can find the text.
    fn root_text(&self, id: ExprId) -> String {
        let span = self.system.span(id);
        format!("{}:{}..{}", span.file.0, span.start, span.end)
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

/// Emits one function; each node and quantity at most once.
struct Emit<'a> {
    plan: &'a Plan<'a>,
    phase: Phase,
    build: Build,
    nodes: Vec<Option<Value>>,
    /// Parameters are replaced by their values, and quantities unknown before a run by NaN.
    inline_params: bool,
    /// With `inline_params`: independent parameters are read from their slots nevertheless.
    loads_params: bool,
    /// Whether the function is evaluated between two instants, where every crossing is false.
    between: bool,
    /// A quantity that is read from [`impulse::FORCE`] instead of being computed.
    replaced: Option<VarId>,
}

impl<'a> Emit<'a> {
    fn new(plan: &'a Plan<'a>, name: &str, phase: Phase) -> Emit<'a> {
        let build = Build::new(name).with_pool(plan.description.pool.clone());
        let nodes = vec![None; plan.system.nodes.len()];
        let [inline_params, loads_params, between] = [false; 3];
        Emit { plan, phase, build, nodes, inline_params, loads_params, between, replaced: None }
    }

    /// The expression that a node forwards to, if it does not compute its value from its operands.
    fn behind(&self, node: &Node) -> Option<ExprId> {
        let system = self.plan.system;
        match node {
            Node::Var(id) if self.replaced == Some(*id) => None,
            Node::Var(id) => {
                let stored = matches!(self.plan.places[id.0 as usize], Location::Slot(_));
                let var = system.var(*id);
                let param = matches!(var.definition, Definition::Value(..));
                if stored && param && (!self.inline_params || self.loads_params) {
                    return None; // A parameter with a slot.
                }
                if self.inline_params && !param {
                    return None; // Not known before a run.
                }
                value_of(var, self.phase)
            }
            Node::Rate(_) | Node::PathRate(_) if !self.inline_params => rate_of(system, node),
            _ => None,
        }
    }

    /// The value of an expression, shared with all its other uses.
    fn value(&mut self, id: ExprId) -> Value {
        let system = self.plan.system;
        let mut stack = vec![id];
        while let Some(&top) = stack.last() {
            if self.nodes[top.0 as usize].is_some() {
                stack.pop();
                continue;
            }
            let node = system.node(top);
            let behind = self.behind(node);
            let crossing = match node {
                Node::Crossing(k) => Some(system.crossings[*k as usize].difference),
                _ => None,
            };
            let waiting: Vec<ExprId> = behind
                .into_iter()
                .chain(crossing)
                .chain(self.operands(node))
                .filter(|operand| self.nodes[operand.0 as usize].is_none())
                .collect();
            if waiting.is_empty() {
                let value = match behind {
                    Some(behind) => self.handed_on(node, behind),
                    None => self.node(top),
                };
                self.nodes[top.0 as usize] = Some(value);
                stack.pop();
            } else {
                stack.extend(waiting.into_iter().rev());
            }
        }
        self.nodes[id.0 as usize].expect("just computed")
    }

    /// The operands that must be computed. A delay that breaks cycles needs only its time, except at the start.
    fn operands<'n>(&self, node: &'n Node) -> impl Iterator<Item = ExprId> + use<'n> {
        let known = self.phase != Phase::Start && delays::breaks(self.plan.system, node);
        node.operands().skip(usize::from(known))
    }

    fn got(&self, id: ExprId) -> Value {
        self.nodes[id.0 as usize].expect("operands are computed first")
    }

    fn types_of(&self, a: ExprId, b: ExprId) -> (Type, Type) {
        (self.build.type_of(self.got(a)), self.build.type_of(self.got(b)))
    }

    /// An operand as a condition. Constants are evaluated even in texts with errors, where an operand may have the
    /// wrong type.
    fn condition(&mut self, id: ExprId) -> Value {
        let value = self.got(id);
        if self.build.type_of(value) == Type::Bool { value } else { self.truth(value) }
    }

    /// An operand as a quantity; see [`condition`](Self::condition).
    fn quantity(&mut self, id: ExprId) -> Value {
        let value = self.got(id);
        self.as_number(value)
    }

    /// The value of a computed quantity. At a tick, a held quantity is updated only if its block is due.
    fn handed_on(&mut self, node: &Node, behind: ExprId) -> Value {
        let value = self.got(behind);
        let (Node::Var(id), Phase::Tick) = (node, self.phase) else { return value };
        let Definition::Held { block, .. } = self.plan.system.var(*id).definition else { return value };
        let Location::Slot(slot) = self.plan.places[id.0 as usize] else { return value };
        let due = self.due(block);
        let before = self.build.load(slot);
        if self.plan.types.boolean_vars[id.0 as usize] {
            let before = self.truth(before);
            return self.build.select(due, value, before);
        }
        self.build.select(due, value, before)
    }

    fn due(&mut self, block: BlockId) -> Value {
        let flag = self.build.load(self.plan.description.layout.due.slot(block.0 as usize));
        self.truth(flag)
    }

    /// The present value of a quantity.
    fn var(&mut self, id: VarId) -> Value {
        let node = Node::Var(id);
        match self.behind(&node) {
            Some(behind) => {
                self.value(behind);
                self.handed_on(&node, behind)
            }
            None => self.leaf(id),
        }
    }

    /// As [`var`](Self::var), in its stored form: a number.
    fn stored(&mut self, id: VarId) -> Value {
        let value = self.var(id);
        self.as_number(value)
    }

    fn leaf(&mut self, id: VarId) -> Value {
        if self.replaced == Some(id) {
            return self.build.load(impulse::FORCE);
        }
        match self.plan.places[id.0 as usize] {
            Location::Slot(slot) if !self.inline_params || self.loads_params && self.is_param(slot) => {
                let value = self.build.load(slot);
                if self.plan.types.boolean_vars[id.0 as usize] { self.truth(value) } else { value }
            }
            // Unknown: an input, or a quantity without a definition.
            _ => {
                let unknown = self.build.real(f64::NAN);
                if self.plan.types.boolean_vars[id.0 as usize] { self.truth(unknown) } else { unknown }
            }
        }
    }

    fn is_param(&self, slot: Slot) -> bool {
        self.plan.description.layout.params.contains(slot)
    }

    /// A stored truth value as a condition: true if it is not 0.
    fn truth(&mut self, value: Value) -> Value {
        let half = self.build.real(0.5);
        self.build.less(half, value)
    }

    /// A condition as 1 or 0.
    fn number(&mut self, condition: Value) -> Value {
        let (one, zero) = (self.build.real(1.0), self.build.real(0.0));
        self.build.select(condition, one, zero)
    }

    /// A value as it is stored. Its own type decides, because in a text with errors the checker may call it otherwise.
    fn as_number(&mut self, value: Value) -> Value {
        if self.build.type_of(value) == Type::Bool { self.number(value) } else { value }
    }

    /// Whether a value varies during a run.
    fn moves(&self, value: Value, known: &mut HashMap<Value, bool>) -> bool {
        let params = self.plan.description.layout.params;
        let mut stack = vec![value];
        while let Some(&top) = stack.last() {
            if known.contains_key(&top) {
                stack.pop();
                continue;
            }
            let op = self.build.get(top);
            if let crate::ir::Op::Load(slot) = op {
                known.insert(top, !params.contains(slot));
                continue;
            }
            let mut operands = Vec::new();
            op.each_operand(|operand| operands.push(operand));
            let open: Vec<Value> = operands.iter().copied().filter(|v| !known.contains_key(v)).collect();
            if open.is_empty() {
                known.insert(top, operands.iter().any(|v| known[v]));
            } else {
                stack.extend(open);
            }
        }
        known[&value]
    }

    fn node(&mut self, id: ExprId) -> Value {
        let node = self.plan.system.node(id).clone();
        match node {
            Node::Number { value, .. } => self.build.real(value),
            Node::Bool(truth) => self.build.truth(truth),
            Node::Time if self.inline_params => self.build.real(f64::NAN),
            Node::Time if self.phase == Phase::Start => self.build.real(0.0),
            Node::Time => self.build.load(Slot::TIME),
            Node::Var(var) => self.leaf(var),
            Node::Rate(_) | Node::PathRate(_) | Node::Hole | Node::Error | Node::Measure(..) => {
                self.build.real(f64::NAN)
            }
            Node::Negate(a) => {
                let a = self.quantity(a);
                self.build.neg(a)
            }
            Node::Not(a) => {
                let a = self.condition(a);
                self.build.not(a)
            }
            Node::Fits { value, .. } => self.got(value),
            Node::If(c, a, b) => {
                let c = self.condition(c);
                match self.types_of(a, b) {
                    (Type::Bool, Type::Bool) => {
                        let (a, b) = (self.got(a), self.got(b));
                        self.build.select(c, a, b)
                    }
                    _ => {
                        let (a, b) = (self.quantity(a), self.quantity(b));
                        self.build.select(c, a, b)
                    }
                }
            }
            Node::InRegime(automaton, regime) => {
                let number = self.build.real(f64::from(regime));
                let k = automaton.0 as usize;
                let active = match self.phase {
                    Phase::Start => self.build.real(f64::from(self.plan.system.automata[k].initial)),
                    Phase::Now | Phase::Tick => self.build.load(self.plan.description.layout.regimes.slot(k)),
                };
                self.build.equal(active, number)
            }
            Node::Crossing(k) => self.crossing(k as usize),
            Node::Table(k, x) => {
                let x = self.quantity(x);
                self.plan.tables[k as usize].at(x, &mut self.build)
            }
            Node::Binary(op, a, b) => {
                let boolean = self.plan.types.boolean[a.0 as usize];
                let exponent = match self.plan.system.node(b) {
                    _ if op == BinaryOp::Power => self.plan.system.literal(b),
                    _ => None,
                };
                let (a, b) = match op {
                    BinaryOp::And | BinaryOp::Or => (self.condition(a), self.condition(b)),
                    BinaryOp::Equal | BinaryOp::NotEqual if boolean => (self.condition(a), self.condition(b)),
                    _ => (self.quantity(a), self.quantity(b)),
                };
                self.binary(op, a, b, boolean, exponent)
            }
            Node::Call(Builtin::Delay, _) => self.delay(id),
            Node::Call(builtin, args) => {
                let args: Vec<Value> = args.iter().map(|arg| self.quantity(*arg)).collect();
                self.call(builtin, &args)
            }
        }
    }

    /// The delayed value, or an interpolation between it and the present one. At the start it is the present value.
    fn delay(&mut self, id: ExprId) -> Value {
        let (value, _) = delays::of(self.plan.system, id);
        if self.inline_params {
            return self.build.real(f64::NAN); // Not known before a run.
        }
        if self.phase == Phase::Start {
            return self.quantity(value);
        }
        let delay = &self.plan.description.delays[self.plan.delayed[&id]];
        let past = self.build.load(delay.past);
        let Some(weight) = delay.weight else { return past };
        let (weight, now) = (self.build.load(weight), self.quantity(value));
        let way = self.build.sub(now, past);
        let part = self.build.mul(weight, way);
        self.build.add(past, part)
    }

    fn crossing(&mut self, k: usize) -> Value {
        if self.phase == Phase::Start || self.between {
            return self.build.truth(false);
        }
        let crossing = &self.plan.system.crossings[k];
        let now = self.got(crossing.difference);
        let before = self.build.load(self.plan.crossings[k]);
        let zero = self.build.real(0.0);
        let was_below = self.build.less(before, zero);
        let is_not_below = self.build.less_equal(zero, now);
        let rises = self.build.and(was_below, is_not_below);
        let was_above = self.build.less(zero, before);
        let is_not_above = self.build.less_equal(now, zero);
        let falls = self.build.and(was_above, is_not_above);
        match crossing.kind {
            BinaryOp::Rises => rises,
            BinaryOp::Falls => falls,
            _ => self.build.or(rises, falls),
        }
    }

    fn binary(&mut self, op: BinaryOp, a: Value, b: Value, boolean: bool, exponent: Option<f64>) -> Value {
        let build = &mut self.build;
        match op {
            BinaryOp::Add => build.add(a, b),
            BinaryOp::Subtract => build.sub(a, b),
            BinaryOp::Multiply => build.mul(a, b),
            BinaryOp::Divide => build.div(a, b),
            BinaryOp::Power => self.power(a, b, exponent),
            BinaryOp::Less => build.less(a, b),
            BinaryOp::LessEqual => build.less_equal(a, b),
            BinaryOp::Greater => build.less(b, a),
            BinaryOp::GreaterEqual => build.less_equal(b, a),
            BinaryOp::Equal | BinaryOp::NotEqual => {
                let same = if boolean {
                    let not = build.not(b);
                    build.select(a, b, not)
                } else {
                    build.equal(a, b)
                };
                if op == BinaryOp::Equal { same } else { build.not(same) }
            }
            BinaryOp::And => build.and(a, b),
            BinaryOp::Or => build.or(a, b),
            BinaryOp::Crosses | BinaryOp::Rises | BinaryOp::Falls => unreachable!("crossings are nodes of their own"),
        }
    }

    /// A constant whole exponent becomes repeated squaring, ½ the square root, and any other exponent `pow`.
    fn power(&mut self, a: Value, b: Value, exponent: Option<f64>) -> Value {
        match exponent {
            Some(n) if n.fract() == 0.0 && n.abs() <= 64.0 => {
                let mut rest = n.abs() as u32;
                let (mut square, mut product) = (a, None);
                while rest > 0 {
                    if rest & 1 == 1 {
                        product = Some(match product {
                            None => square,
                            Some(product) => self.build.mul(product, square),
                        });
                    }
                    rest >>= 1;
                    if rest > 0 {
                        square = self.build.mul(square, square);
                    }
                }
                let one = self.build.real(1.0);
                let product = product.unwrap_or(one);
                if n < 0.0 { self.build.div(one, product) } else { product }
            }
            Some(0.5) => self.build.sqrt(a),
            _ => self.build.binary(Binary::Pow, a, b),
        }
    }

    fn call(&mut self, builtin: Builtin, args: &[Value]) -> Value {
        match builtin {
            Builtin::Abs => self.build.abs(args[0]),
            Builtin::Sign => self.build.sign(args[0]),
            Builtin::Min => self.build.min(args[0], args[1]),
            Builtin::Max => self.build.max(args[0], args[1]),
            Builtin::Clamp => self.build.clamp(args[0], args[1], args[2]),
            Builtin::Floor => self.build.floor(args[0]),
            Builtin::Sqrt => self.build.sqrt(args[0]),
            Builtin::Unary(function) => self.build.unary(function, args[0]),
            Builtin::Binary(function) => self.build.binary(function, args[0], args[1]),
            Builtin::Random => self.random(args[0], args[1]),
            Builtin::Step => {
                let time = self.time();
                let on = self.build.less_equal(args[0], time);
                let zero = self.build.real(0.0);
                self.build.select(on, args[1], zero)
            }
            Builtin::Ramp => {
                let time = self.time();
                let (since, zero) = (self.build.sub(time, args[0]), self.build.real(0.0));
                let since = self.build.max(zero, since);
                let risen = self.build.mul(args[2], since);
                self.build.add(args[1], risen)
            }
            Builtin::Pulse => {
                let time = self.time();
                let end = self.build.add(args[0], args[1]);
                let begun = self.build.less_equal(args[0], time);
                let open = self.build.less(time, end);
                let on = self.build.and(begun, open);
                let zero = self.build.real(0.0);
                self.build.select(on, args[2], zero)
            }
            Builtin::Sine => {
                let phase = self.turns(args[1]);
                let angle = self.angle(phase);
                let sine = self.build.unary(Unary::Sin, angle);
                self.build.mul(args[0], sine)
            }
            Builtin::Square => {
                let phase = self.turns(args[1]);
                let whole = self.build.floor(phase);
                let (part, half) = (self.build.sub(phase, whole), self.build.real(0.5));
                let first = self.build.less(part, half);
                let negative = self.build.neg(args[0]);
                self.build.select(first, args[0], negative)
            }
            Builtin::Chirp => {
                // Phase in turns: f0 t + (f1 − f0) t² / (2 T), held at f1 after T.
                let time = self.time();
                let ramp = self.build.min(args[3], time);
                let (difference, two) = (self.build.sub(args[2], args[1]), self.build.real(2.0));
                let span = self.build.mul(two, args[3]);
                let slope = self.build.div(difference, span);
                let square = self.build.mul(ramp, ramp);
                let bent = self.build.mul(slope, square);
                let plain = self.build.mul(args[1], ramp);
                let after = self.build.sub(time, ramp);
                let tail = self.build.mul(args[2], after);
                let phase = self.build.add(plain, bent);
                let phase = self.build.add(phase, tail);
                let angle = self.angle(phase);
                let sine = self.build.unary(Unary::Sin, angle);
                self.build.mul(args[0], sine)
            }
            Builtin::Delay => unreachable!("it is no function of its arguments"),
            Builtin::Noise => {
                let time = self.time();
                let number = self.build.div(time, args[1]);
                let number = self.build.floor(number);
                let random = self.random(args[2], number);
                let (two, one) = (self.build.real(2.0), self.build.real(1.0));
                let wide = self.build.mul(two, random);
                let centred = self.build.sub(wide, one);
                self.build.mul(args[0], centred)
            }
        }
    }

    fn time(&mut self) -> Value {
        if self.inline_params {
            return self.build.real(f64::NAN); // Not known before a run.
        }
        match self.phase {
            Phase::Start => self.build.real(0.0),
            Phase::Now | Phase::Tick => self.build.load(Slot::TIME),
        }
    }

    /// f · t, a phase in turns.
    fn turns(&mut self, frequency: Value) -> Value {
        let time = self.time();
        self.build.mul(frequency, time)
    }

    /// A phase in turns as an angle in radians, after whole turns are removed.
    fn angle(&mut self, turns: Value) -> Value {
        let whole = self.build.nearest(turns);
        let part = self.build.sub(turns, whole);
        let turn = self.build.real(2.0 * std::f64::consts::PI);
        self.build.mul(turn, part)
    }

    /// Uniform in [0, 1): the top 53 bits of SplitMix64's finaliser of seed · 0x9E37… + k.
    /// Source: Steele, Lea, Flood, OOPSLA 2014.
    fn random(&mut self, seed: Value, k: Value) -> Value {
        let build = &mut self.build;
        let (seed, k) = (build.to_int(seed), build.to_int(k));
        let golden = build.int(abi::random::GAMMA as i64);
        let spread = build.int_mul(seed, golden);
        let mut z = build.int_add(spread, k);
        for (shift, factor) in [(30, 0xBF58_476D_1CE4_E5B9_u64), (27, 0x94D0_49BB_1331_11EB_u64)] {
            let shifted = build.shift_right(z, shift);
            let mixed = build.int_xor(z, shifted);
            let factor = build.int(factor as i64);
            z = build.int_mul(mixed, factor);
        }
        let shifted = build.shift_right(z, 31);
        z = build.int_xor(z, shifted);
        let top = build.shift_right(z, 11);
        let top = build.to_real(top);
        let unit = build.real(1.0 / 9_007_199_254_740_992.0);
        build.mul(top, unit)
    }
}
