//! Transitions: resets of states, changes of regime, and the impulse of a part whose speed is reset.

use super::Plan;
use super::emit::Emit;
use crate::frontend::causality::Phase;
use crate::frontend::system::*;
use crate::ir::build::{Build, Env};
use crate::ir::hash::HashMap;
use crate::ir::{Func, Value};
use crate::numerics::impulse;
use abi::description::Slot;

impl Plan<'_> {
    /// Sets `balanced` to whether a contact stops the mass on which it acts.
    pub(super) fn transitions(&self, mut emit: Emit, balanced: &mut bool) -> Func {
        // For each state: its resets with their conditions, in the order of the text.
        let mut resets: HashMap<VarId, Vec<(Value, Value)>> = HashMap::default();
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
        let (mut all, mut env) = (Build::new("transitions").with_pool(self.description.pool.clone()), Env::default());
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
    pub(super) fn impulse(&self, input: VarId) -> Option<(Func, VarId)> {
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
}
