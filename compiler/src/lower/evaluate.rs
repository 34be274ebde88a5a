//! Values that depend on parameters only: computed when a text is checked, or by a program of their own.

use super::emit::Emit;
use super::lookup::Lookup;
use super::{Location, Plan, independent_params};
use crate::frontend::causality::Phase;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::Func;
use crate::ir::program::Program;
use abi::description::{Description, Layout, Slot};
use std::sync::Arc;

/// Values of expressions that depend on parameters only, with each parameter at its default. An expression that depends
/// on anything else is NaN.
pub fn evaluate(system: &System, types: &Types, exprs: &[ExprId]) -> Vec<f64> {
    let mut pool = crate::math::POOL.to_vec();
    let tables = Lookup::place_all_but_recordings(&system.tables, &mut pool);
    let mut plan = Plan::new(system, types, &[], &[], tables);
    plan.description.pool = Arc::from(pool);
    evaluate_in(&plan, exprs)
}

/// Compiles expressions of parameters to a function that reads the parameters in a block and runs as at the start. Also
/// returns the size of the block; its last slots receive the values.
pub fn formulas(system: &System, types: &Types, exprs: &[ExprId]) -> (Func, usize) {
    let mut pool = crate::math::POOL.to_vec();
    let tables = Lookup::place_all_but_recordings(&system.tables, &mut pool);
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
    let tables = Lookup::place_all_but_recordings(&system.tables, &mut pool);
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

pub(super) fn evaluate_in(plan: &Plan, exprs: &[ExprId]) -> Vec<f64> {
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
