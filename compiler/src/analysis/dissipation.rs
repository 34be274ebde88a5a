//! Dissipation analysis of friction models (Willems, *Dissipative dynamical systems*, 1972): does the force jump at
//! rest, does the contact hold a load, does it dissipate energy?
//!
//! In: a model on its own that matches the interface `Friction`. Out: warnings, and a [`Verdict`] on request. The
//! reference interpreter evaluates the model's own functions on a fixed grid. If the grid contains no violation of
//! dissipation, a proof by intervals is tried. The work is bounded, and the result does not depend on the machine.

use crate::analysis::interval_proof::{Claim, prove};
use crate::analysis::memo::Memo;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::interval::Interval;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::ir::program::Program;
use crate::ir::{Func, Op, Value};
use crate::lower::{Lowered, Observed, lower};
use crate::numerics::autodiff;
use abi::description::Slot;
use abi::format::{prefixed, quantity, three_digits};
use abi::unit::{Dimension, Unit};
use grammar::diagnostic::Diagnostic;
use std::rc::Rc;

/// Result of the dissipation analysis of a model.
#[derive(Clone, PartialEq, Debug)]
pub enum Verdict {
    /// Proven for all velocities from 1e-6 m/s to 10 m/s or to the ends of their range, for all states within their
    /// ranges, and for all external forces within their range or up to 1e6 N.
    Proved,
    /// No counterexample at this number of points.
    Holds(usize),
    /// The model supplies power at this point.
    Fails(Counterexample),
    /// Not checked, with the reason: a model with states needs a `storage` function; sampled blocks and delays are not
    /// supported.
    NotChecked(String),
}

impl Verdict {
    /// The verdict in words: what `fric explain` and the table of phenomena say. A verdict without proof says so first.
    pub fn words(&self) -> String {
        match self {
            Verdict::Proved => "proved".into(),
            Verdict::Holds(points) => format!("not proven: no counterexample at {points} points"),
            Verdict::Fails(point) => format!(
                "fails: at v = {} m/s it gives F = {} N and drives the motion",
                three_digits(point.v),
                three_digits(point.force)
            ),
            Verdict::NotChecked(why) => format!("not proven: {why}"),
        }
    }
}

/// A point at which a model supplies power.
#[derive(Clone, PartialEq, Debug)]
pub struct Counterexample {
    /// Velocity, SI units.
    pub v: f64,
    /// Continuous states, SI units, in the order of the layout.
    pub states: Vec<f64>,
    /// Friction force, SI units.
    pub force: f64,
}

const VELOCITY: Dimension = Dimension::of([0, 1, -1, 0, 0]);
const FORCE: Dimension = Dimension::of([1, 1, -2, 0, 0]);
/// Limit on interpreted operations for one verdict: less than a second.
const WORK: usize = 100_000_000;
/// Limit on the steps of a proof, which takes about as long again.
const PROOF: usize = 8_000_000;
/// Velocities in m/s and external forces in N for a model without a narrower declared range.
const SPEEDS: (f64, f64) = (1e-6, 10.0);
const LARGEST_LOAD: f64 = 1e6;
/// A velocity in m/s at which every regularised sign function is still close to 0.
const CRAWL: f64 = 1e-15;

/// The ports of a friction model on its own.
struct ContactPorts {
    v: VarId,
    force: VarId,
    external: Option<VarId>,
}

fn contact(system: &System, types: &Types) -> Option<ContactPorts> {
    let port = |name: &str, kind: VarKind, dimension: Dimension| {
        system.var_ids().find(|id| {
            let var = system.var(*id);
            var.instance == InstanceId(0)
                && var.name == name
                && var.kind == kind
                && types.units[id.0 as usize].dimension == dimension
        })
    };
    let (v, force) = (port("v", VarKind::Input, VELOCITY)?, port("F", VarKind::Output, FORCE)?);
    Some(ContactPorts { v, force, external: port("F_ext", VarKind::Input, FORCE) })
}

/// Evaluates a model at points.
struct PointEvaluator {
    program: Program,
    outputs: Rc<Func>,
    start: Rc<Func>,
    v: Slot,
    external: Option<Slot>,
    force: Slot,
    /// Writes dV/dt into the first slot of the Jacobian. `None` without a `storage` or without states.
    flow: Option<Rc<Func>>,
    /// Slot of the stored energy V.
    energy: Option<Slot>,
    /// For each regime the slots of its exit conditions. A slot is 1 if the regime would be left.
    exits: Vec<Vec<Slot>>,
    /// For each continuous state, whether force or storage depend on it.
    matters: Vec<bool>,
    block: Vec<f64>,
}

impl PointEvaluator {
    fn new(system: &System, types: &Types, contact: &ContactPorts) -> Option<PointEvaluator> {
        // All open parameters and all other inputs must have values.
        let open = system.var_ids().any(|id| {
            let var = system.var(id);
            matches!(var.definition, Definition::Free | Definition::Missing)
                && id != contact.v
                && Some(id) != contact.external
        });
        if open {
            return None;
        }
        let energy = system.storages.iter().find(|(owner, _)| *owner == InstanceId(0));
        let energy = energy.map(|(_, expr)| Observed { expr: *expr, text: "storage".into(), unit: None });
        let stored = energy.is_some();
        let mut wanted: Vec<Observed> = energy.into_iter().collect();
        let automaton = system.automata.first();
        for (k, regime) in automaton.iter().flat_map(|automaton| &automaton.regimes).enumerate() {
            let exit = |(i, transition): (usize, &Transition)| {
                let text = format!("exit {i} of regime {k}");
                Observed { expr: transition.condition, text, unit: None }
            };
            wanted.extend(regime.transitions.iter().enumerate().map(exit));
        }
        let Lowered { program, observed } = lower(system, types, &wanted);
        let (energy, mut exit) = observed.split_at(usize::from(stored));
        let flow = energy.first().and_then(|energy| energy_flow(&program, *energy));
        let mut exits = Vec::new();
        for regime in automaton.iter().flat_map(|automaton| &automaton.regimes) {
            let (own, rest) = exit.split_at(regime.transitions.len());
            exits.push(own.to_vec());
            exit = rest;
        }
        let slot = |id: VarId| program.description.quantity(&system.var(id).path).map(|quantity| quantity.slot);
        let (v, force) = (slot(contact.v)?, slot(contact.force)?);
        let external = contact.external.and_then(slot);
        let matters = depends(&program, [force].into_iter().chain(energy.first().copied()));
        let outputs = Rc::new(crate::math::expand(&program.outputs));
        let start = Rc::new(crate::math::expand(&program.start));
        let flow = flow.map(Rc::new);
        let mut block = vec![0.0; program.description.layout.size()];
        block[program.description.layout.params.range()].copy_from_slice(&program.params);
        let energy = energy.first().copied();
        Some(PointEvaluator { program, outputs, start, v, external, force, flow, energy, exits, matters, block })
    }

    fn run(&mut self, func: &Func) {
        crate::ir::interpret::run_once(func, &mut self.block, &self.program.description.pool);
    }

    /// The force at this velocity, with the states at their start values.
    fn force_at(&mut self, v: f64, external: f64) -> f64 {
        self.block[self.v.index()] = v;
        if let Some(slot) = self.external {
            self.block[slot.index()] = external;
        }
        let (start, outputs) = (self.start.clone(), self.outputs.clone());
        self.run(&start);
        self.run(&outputs);
        self.block[self.force.index()]
    }
}

/// Warnings for a friction model; none for other models.
pub fn check(system: &System, types: &Types, found: &mut Vec<Diagnostic>) {
    let Some(contact) = contact(system, types) else { return };
    let Some(mut bench) = PointEvaluator::new(system, types, &contact) else { return };
    let force = system.var(contact.force);
    let memory = !system.automata.is_empty()
        || system.vars.iter().any(|var| !matches!(var.definition, Definition::Value(..) | Definition::Free));
    // A force that is 0 at rest under every external force has no stiction.
    let loads: &[f64] = if contact.external.is_some() { &[1.0, -1.0] } else { &[] };
    let scale = bench.force_at(1.0, 0.0).abs().max(f64::MIN_POSITIVE);
    let answers = loads.iter().any(|load| bench.force_at(0.0, *load).abs() > 1e-3 * scale);
    if !memory && !answers {
        let (plus, minus) = (bench.force_at(CRAWL, 0.0), bench.force_at(-CRAWL, 0.0));
        if (plus - minus).abs() > 1e-3 * scale {
            let text = format!("from {} N to {} N at v = 0", three_digits(minus), three_digits(plus));
            let warning = Diagnostic::warning("W0701", "this friction force jumps at rest")
                .label(force.span, text)
                .help("in a loop that comes to rest it will chatter: use KFM or Karnopp there, or a smooth sign,\n`tanh(v / v0)`. For a static map: `allow jumps \"...\"`");
            found.push(warning);
        } else if plus.abs() <= 1e-3 * scale {
            creep(system, &mut bench, force, found);
        }
    }
    if let Verdict::Fails(point) = dissipation_of(system, &contact, &mut bench) {
        found.push(pushes(system, types, force, &bench, &point));
    }
}

/// Reports a contact without stiction: the load that moves it, and the resulting speed.
fn creep(system: &System, bench: &mut PointEvaluator, force: &Var, found: &mut Vec<Diagnostic>) {
    let coulomb = system
        .var_ids()
        .find(|id| system.var(*id).name == "Fc" && system.var(*id).instance == InstanceId(0))
        .and_then(|id| bench.program.description.quantity(&system.var(id).path))
        .map(|quantity| bench.block[quantity.slot.index()])
        .filter(|value| *value > 0.0);
    let largest = (-60..=10).map(|k| bench.force_at(decade(k, 10), 0.0)).fold(0.0, f64::max);
    if largest <= 0.0 {
        return; // No friction, so no load can be held.
    }
    let load = 0.5 * coulomb.unwrap_or(largest);
    // The least speed at which the force reaches the load: bracketed by a grid, then bisected.
    let Some(k) = (-90..=20).find(|k| bench.force_at(decade(*k, 10), 0.0) >= load) else { return };
    let (mut low, mut high) = (decade(k - 1, 10), decade(k, 10));
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if bench.force_at(middle, 0.0) >= load { high = middle } else { low = middle }
    }
    let warning = Diagnostic::warning("W0702", "this friction model cannot hold a load")
        .label(force.span, format!("{} N moves it at {}", three_digits(load), quantity(high, &prefixed("m/s", high).0, 3)))
        .help("at rest it carries nothing: use KFM, Karnopp or a model with a bristle to hold a load.\nTo keep it: `allow creep \"...\"`");
    found.push(warning);
}

/// 10^(k/n), computed without platform functions so that it is the same on every machine.
fn decade(k: i32, n: i32) -> f64 {
    let whole = k.div_euclid(n);
    let part = f64::from(k.rem_euclid(n)) / f64::from(n);
    // exp(part · ln 10) by its series, which is accurate enough for a grid.
    let x = part * std::f64::consts::LN_10;
    let (mut term, mut sum) = (1.0, 1.0);
    for i in 1..40 {
        term *= x / f64::from(i);
        sum += term;
    }
    (0..whole.abs()).fold(sum, |value, _| if whole > 0 { value * 10.0 } else { value / 10.0 })
}

/// Whether a friction model on its own dissipates: F v − dV/dt ≥ 0, and F v ≥ min(0, F_ext v) with an external force.
pub fn dissipation(system: &System, types: &Types) -> Option<Verdict> {
    let contact = contact(system, types)?;
    let mut bench = PointEvaluator::new(system, types, &contact)?;
    Some(dissipation_of(system, &contact, &mut bench))
}

fn dissipation_of(system: &System, contact: &ContactPorts, bench: &mut PointEvaluator) -> Verdict {
    static KNOWN: Memo<Verdict> = Memo::new();
    let energy = system.storages.iter().any(|(owner, _)| *owner == InstanceId(0));
    let also = [contact.v.0, contact.force.0, contact.external.map_or(u32::MAX, |id| id.0), u32::from(energy)];
    let program = bench.program.clone();
    KNOWN.answer(&program, &also.map(u64::from), || match sampled(system, contact, bench) {
        Verdict::Holds(_) if proved(system, contact, bench) => Verdict::Proved,
        verdict => verdict,
    })
}

/// Tries to prove by intervals, in every regime and for both directions, what the samples did not refute.
fn proved(system: &System, contact: &ContactPorts, bench: &mut PointEvaluator) -> bool {
    let energy = system.storages.iter().any(|(owner, _)| *owner == InstanceId(0));
    let layout = bench.program.description.layout.clone();
    let description = bench.program.description.clone();
    let range = |slot: Slot| description.quantities.iter().find(|q| q.slot == slot).map(|q| q.range);
    let (low, high) = range(bench.v).unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
    // Everything but velocity, load and the relevant states keeps its start value.
    bench.force_at(SPEEDS.0, 0.0);
    let mut work = PROOF;
    for regime in 0..bench.exits.len().max(1) {
        for sign in [1.0, -1.0] {
            // v| within the range of this sign; the function reads it from the slot of v.
            let (least, most) = if sign > 0.0 { (low, high) } else { (-high, -low) };
            let (least, most) = (least.max(SPEEDS.0), most.min(SPEEDS.1));
            if least >= most {
                continue;
            }
            let mut inputs = vec![(bench.v, Interval::closed(least, most))];
            if let (Some(slot), Some(_)) = (bench.external, contact.external) {
                let (low, high) = range(slot).unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
                inputs.push((slot, Interval::closed(low.max(-LARGEST_LOAD), high.min(LARGEST_LOAD))));
            }
            for k in (0..layout.states.len as usize).filter(|k| bench.matters[*k]) {
                let slot = layout.states.slot(k);
                let Some((low, high)) = range(slot).filter(|(low, high)| low.is_finite() && high.is_finite()) else {
                    return false;
                };
                inputs.push((slot, Interval::closed(low, high)));
            }
            let build = Shared::new(Build::new("dissipation").with_pool(description.pool.clone()));
            let mut env = Env::default();
            {
                let mut build = build.borrow_mut();
                let held = (0..layout.size()).filter(|slot| inputs.iter().all(|(input, _)| input.index() != *slot));
                for slot in held {
                    let mut value = bench.block[slot];
                    if layout.regimes.range().next() == Some(slot) {
                        value = regime as f64;
                    }
                    let value = build.real(value);
                    env.insert(Slot(slot as u32), value);
                }
                if sign < 0.0 {
                    let speed = build.load(bench.v);
                    let v = build.neg(speed);
                    env.insert(bench.v, v);
                }
            }
            let states: Vec<Slot> = (0..layout.states.len as usize).map(|k| layout.states.slot(k)).collect();
            let mut after = env.clone();
            let gradients = autodiff::inline(&build, &bench.program.outputs, &mut after, &states);
            let mut build = build.into_inner();
            let mut rates = env.clone();
            build.inline(&bench.program.derivatives, &mut rates);
            let mut flow = build.real(0.0);
            for k in 0..states.len() {
                let slope = bench
                    .energy
                    .and_then(|energy| gradients.get(&energy))
                    .and_then(|gradient| autodiff::entry(gradient, k as u32));
                if let Some(slope) = slope.filter(|_| energy) {
                    let rate = rates.get(&layout.derivatives.slot(k)).copied();
                    let Some(rate) = rate else { return false };
                    let term = build.mul(slope, rate);
                    flow = build.add(flow, term);
                }
            }
            let v = build.read(bench.v, &env);
            let force = after[&bench.force];
            let lost = |build: &mut Build, force| {
                let power = build.mul(force, v);
                build.sub(power, flow)
            };
            // F v ≥ min(0, F_ext v) holds if one of two inequalities holds.
            let mut any = vec![lost(&mut build, force)];
            if let Some(slot) = bench.external {
                let external = build.read(slot, &env);
                let rest = build.sub(force, external);
                any.push(lost(&mut build, rest));
            }
            let exits = bench.exits.get(regime).cloned().unwrap_or_default();
            let (one, zero, half) = (build.real(1.0), build.real(0.0), build.real(0.5));
            for slot in &exits {
                let value = build.read(*slot, &after);
                let left = build.less(half, value);
                any.push(build.select(left, one, zero));
            }
            // Stored, so that all operations count as live.
            for (k, value) in any.iter().enumerate() {
                build.store(Slot((layout.size() + k) as u32), *value);
            }
            let func = build.finish();
            let stored = |k: usize| {
                let slot = layout.size() + k;
                func.stores.iter().find(|(at, _)| at.index() == slot).expect("it was just stored").1
            };
            let claims = any.len() - exits.len();
            let claimed: Vec<Value> = (0..claims).map(stored).collect();
            let mut unless = Vec::new();
            let mut left = false;
            for value in (claims..any.len()).map(stored) {
                match func.ops[value.index()] {
                    Op::Select(condition, ..) => unless.push(condition),
                    // An exit condition that is constantly true excludes the regime; one that is constantly false
                    // excludes nothing.
                    Op::Real(bits) => left |= f64::from_bits(bits) > 0.5,
                    _ => return false,
                }
            }
            if left {
                continue;
            }
            if !prove(&Claim { func: &func, any: &claimed, unless: &unless }, &inputs, &description.pool, &mut work) {
                return false;
            }
        }
    }
    true
}

/// The verdict from samples.
fn sampled(system: &System, contact: &ContactPorts, bench: &mut PointEvaluator) -> Verdict {
    let layout = bench.program.description.layout.clone();
    let n = layout.states.len as usize;
    let storage = system.storages.iter().find(|(owner, _)| *owner == InstanceId(0)).map(|(_, energy)| *energy);
    // A state on which the force does not depend stores no energy.
    let memory = bench.matters.contains(&true);
    let not_checked = |why: &str| Verdict::NotChecked(why.into());
    if !system.blocks.is_empty() {
        return not_checked("the analysis knows no sampled code");
    }
    if !system.delays.is_empty() {
        return not_checked("the analysis knows no `delay`");
    }
    if memory && storage.is_none() {
        return not_checked("a model with states needs a `storage`, the energy that they store");
    }
    let flow = bench.flow.clone();
    // Values of each state: the ends of its range, 0 and half-way points. A state without a range keeps its start
    // value.
    let mut choices: Vec<Vec<f64>> = Vec::new();
    for k in 0..n {
        let slot = layout.states.slot(k);
        let state = bench.program.description.quantities.iter().find(|q| q.slot == slot);
        choices.push(match state.map(|q| q.range) {
            Some((low, high)) if low.is_finite() && high.is_finite() => {
                vec![low, high, 0.0_f64.clamp(low, high), 0.5 * low, 0.5 * high]
            }
            _ if !bench.matters[k] => Vec::new(),
            _ => {
                let name = state.map_or("a state".into(), |state| format!("the state `{}`", state.path));
                return Verdict::NotChecked(format!("{name} needs a range with two ends, `in a .. b`"));
            }
        });
    }
    if choices.iter().filter(|choice| !choice.is_empty()).count() > 4 {
        return not_checked("the analysis knows up to four states");
    }
    if system.automata.len() > 1 {
        return not_checked("the analysis knows one automaton");
    }
    let corners: usize = choices.iter().map(|choice| choice.len().max(1)).product();
    let regime = layout.regimes.range().next();
    let externals: &[f64] =
        if contact.external.is_some() { &[0.0, 0.3, -0.3, 1.0, -1.0, 3.0, -3.0, 10.0, -10.0] } else { &[0.0] };
    let (mut points, mut looked) = (0, 0);
    let cost = bench.start.ops.len() + 2 * bench.outputs.ops.len() + flow.as_ref().map_or(0, |flow| flow.ops.len());
    let most = WORK / cost.max(1);
    // Powers of ten first, so that a counterexample has a round velocity; then the grid between them.
    let speeds = (-6..=1).map(|k| decade(k, 1)).chain((-60..=10).map(|k| decade(k, 10)));
    for v in speeds.flat_map(|v| [v, -v]) {
        for &external in externals {
            // A model without regimes counts as having one.
            for at in 0..corners * bench.exits.len().max(1) {
                looked += 1;
                if looked > most {
                    return Verdict::Holds(points);
                }
                bench.force_at(v, external);
                let mut rest = at % corners;
                for (choice, state) in choices.iter().zip(&mut bench.block[layout.states.range()]) {
                    // A state without choices keeps its start value.
                    if !choice.is_empty() {
                        *state = choice[rest % choice.len()];
                        rest /= choice.len();
                    }
                }
                let states = bench.block[layout.states.range()].to_vec();
                if let Some(slot) = regime {
                    bench.block[slot] = (at / corners) as f64;
                }
                let outputs = bench.outputs.clone();
                bench.run(&outputs);
                // The model is never in a regime whose exit condition holds.
                let left = bench.exits.get(at / corners);
                if left.is_some_and(|exits| exits.iter().any(|slot| bench.block[slot.index()] > 0.5)) {
                    continue;
                }
                let force = bench.block[bench.force.index()];
                let rise = match &flow {
                    Some(flow) => {
                        bench.run(flow);
                        bench.block[layout.jacobian.start as usize]
                    }
                    None => 0.0,
                };
                let given = if contact.external.is_some() { (external * v).min(0.0) } else { 0.0 };
                let lost = force * v - rise - given;
                let scale = (force * v).abs() + rise.abs();
                points += 1;
                if lost < -1e-9 * scale {
                    return Verdict::Fails(Counterexample { v, states, force });
                }
            }
        }
    }
    Verdict::Holds(points)
}

/// For each continuous state, whether one of these outputs depends on it.
fn depends(program: &Program, outputs: impl Iterator<Item = Slot>) -> Vec<bool> {
    let states: Vec<Slot> = program.description.layout.states.range().map(|slot| Slot(slot as u32)).collect();
    let build = Shared::new(Build::new("dependence"));
    let gradients = autodiff::inline(&build, &program.outputs, &mut Env::default(), &states);
    let mut found = vec![false; states.len()];
    for (k, _) in outputs.filter_map(|slot| gradients.get(&slot)).flatten() {
        found[*k as usize] = true;
    }
    found
}

/// dV/dt = Σ ∂V/∂x · dx/dt, where V is the output in slot `energy`; `None` without states.
fn energy_flow(program: &Program, energy: Slot) -> Option<Func> {
    let layout = &program.description.layout;
    let n = layout.states.len as usize;
    if n == 0 || layout.jacobian.len == 0 {
        return None;
    }
    let states: Vec<Slot> = (0..n).map(|k| layout.states.slot(k)).collect();
    let build = Shared::new(Build::new("energy flow"));
    let gradients = autodiff::inline(&build, &program.outputs, &mut Env::default(), &states);
    let mut build = build.into_inner();
    let mut env = Env::default();
    build.inline(&program.derivatives, &mut env);
    let mut flow = build.real(0.0);
    for k in 0..n {
        let Some(slope) = gradients.get(&energy).and_then(|gradient| autodiff::entry(gradient, k as u32)) else {
            continue;
        };
        let term = build.mul(slope, env[&layout.derivatives.slot(k)]);
        flow = build.add(flow, term);
    }
    build.store(layout.jacobian.slot(0), flow);
    Some(crate::math::expand(&build.finish()))
}

fn pushes(system: &System, types: &Types, force: &Var, bench: &PointEvaluator, point: &Counterexample) -> Diagnostic {
    let states = system.var_ids().filter(|id| matches!(system.var(*id).definition, Definition::Continuous { .. }));
    let mut at = vec![format!("v = {} m/s", three_digits(point.v))];
    for (id, value) in states.zip(&point.states) {
        let unit = &types.units[id.0 as usize];
        at.push(format!("{} = {} {}", system.var(id).name, three_digits(unit.from_si(*value)), plain(unit)));
    }
    let force_text = format!("F = {} N", three_digits(point.force));
    let mut warning = Diagnostic::warning("W0703", "this friction model can push: it is not dissipative")
        .label(force.span, format!("at {}: {force_text}, so it drives the motion", at.join(", ")));
    if let Some((_, energy)) = system.storages.first() {
        warning = warning.label(system.span(*energy), "and gives out more than it has stored");
    }
    let value = |name: &str| {
        let quantity = bench.program.description.quantity(name)?;
        Some(bench.block[quantity.slot.index()])
    };
    let keep = "To keep it: `allow not-dissipative \"...\"`";
    match (value("sigma1"), value("sigma2"), value("Fs"), value("Fc")) {
        (Some(sigma1), Some(_), Some(fs), Some(fc)) if fc > 0.0 => {
            let needed = three_digits(sigma1 * (fs - fc) / fc);
            warning.help(format!(
                "holds when sigma2 >= sigma1*(Fs - Fc)/Fc ({needed} N·s/m for these values), or let sigma1 fade\nwith speed, as LuGre does for vd = 10 mm/s. {keep}"
            ))
        }
        _ => warning.help(keep),
    }
}

/// The unit in characters allowed in a model's text.
fn plain(unit: &Unit) -> String {
    unit.to_string().replace('µ', "u")
}
