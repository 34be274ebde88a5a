//! Impulses: the momentum transfer that gives the input of a part a new value at once.
//!
//! In: the input and the rates, as functions of the states and of the force that the part exerts. Out: a function that
//! changes the states as an impulse of that force does. A contact that comes to rest within a fixed step stops the mass
//! it acts on in this way, for any inertia. Two free masses receive opposite impulses, so that their total momentum is
//! conserved. Does not know the source text.

use crate::ir::build::{Build, Env};
use crate::ir::expr::{Real, Shared};
use crate::ir::{Func, Op, Value};
use crate::numerics::autodiff::{self, entry};
use abi::Slot;
use std::sync::Arc;

/// The force of the part. This and the following slots are outside of every block: they exchange values with the
/// caller.
pub const FORCE: Slot = Slot(u32::MAX - 1);
/// The value of the input, stored by `speed`.
pub const SPEED: Slot = Slot(u32::MAX - 2);
/// The value that the input shall have after the impulse.
pub const TARGET: Slot = Slot(u32::MAX - 3);
/// Whether the impulse acts: 1 or 0.
pub const ACTS: Slot = Slot(u32::MAX - 4);

/// The present force.
pub const PRESENT: Slot = Slot(u32::MAX - 5);

/// Relative rounding error of the force. A contact at rest also removes the speed that this error causes.
const ROUNDING: f64 = 1.0 / 1_048_576.0;

/// The function that changes the states so that the input v, which `speed` stores to [`SPEED`], becomes [`TARGET`].
///
///   x' = x + G (target − v)/a,   a = ∂v/∂x · G,   G = ∂(dx/dt)/∂F     F in the slot [`FORCE`] of `rates`
///
/// x: the states on which v depends. `None` if F moves none of them, or if the rates are not affine in F. A speed that
/// the rounding error of the present force causes in one step, |v| ≤ 2^-20 |h a F|, becomes 0 in any case: forces in
/// balance leave it behind, and a contact at rest would carry it from step to step.
pub fn impulse(speed: &Func, rates: &Func, states: &[Slot], derivatives: &[Slot], pool: &Arc<[f64]>) -> Option<Func> {
    let build = Shared::new(Build::new("impulse").with_pool(pool.clone()));
    let real = |value| Real::new(&build, value);
    let mut env = Env::default();
    let slopes = autodiff::inline(&build, speed, &mut env, states).remove(&SPEED)?;
    let v = real(build.borrow_mut().read(SPEED, &env));
    let mut after = Env::default();
    let moved = autodiff::inline(&build, rates, &mut after, &[FORCE]);
    let zero = |value| build.borrow().constant(value) == Some(0.0);
    let mut shares = Vec::new();
    for (k, state) in states.iter().enumerate() {
        let slope = entry(&slopes, k as u32).filter(|slope| !zero(*slope));
        let push = moved.get(&derivatives[k]).and_then(|row| entry(row, 0)).filter(|push| !zero(*push));
        if let (Some(slope), Some(push)) = (slope, push) {
            shares.push((*state, real(slope), real(push)));
        }
    }
    let all = shares.iter().map(|(_, slope, push)| *slope * *push).reduce(|a, b| a + b)?;
    let load = |slot| real(build.borrow_mut().load(slot));
    let moves = !all.is(0.0);
    let least = ROUNDING * (load(Slot::STEP) * all * load(PRESENT)).abs();
    let (acts, rests) = (load(ACTS).above(0.5) & moves, v.abs().not_above(least) & moves);
    let target = acts.choose(load(TARGET), 0.0);
    // A single state takes the whole impulse, whatever effect the force has on it.
    let alone = shares.len() == 1;
    let scaled = speed.stores.iter().any(|(slot, value)| *slot == SPEED && is_scaled(speed, *value, states));
    let mut stores = Vec::new();
    for (state, slope, push) in &shares {
        let x = load(*state);
        let set = match (alone, scaled) {
            // If v = a x, x is set rather than changed, so that no rounding error remains: 0 is exactly 0.
            (true, true) => target / *slope,
            (true, false) => x + (target - v) / *slope,
            (false, _) => x + *push * ((target - v) / all),
        };
        stores.push((*state, (acts | rests).choose(set, x).value));
    }
    let mut build = build.into_inner();
    stores.into_iter().for_each(|(slot, value)| build.store(slot, value));
    // Rates that are not affine in F have no impulse: G would depend on F.
    Some(build.finish()).filter(|func| !func.loads().contains(&FORCE))
}

/// Whether a value is a multiple of a single state.
fn is_scaled(func: &Func, value: Value, states: &[Slot]) -> bool {
    match func.op(value) {
        Op::Load(slot) => states.contains(&slot),
        Op::Neg(a) | Op::Div(a, _) => is_scaled(func, a, states),
        Op::Mul(a, b) => is_scaled(func, a, states) || is_scaled(func, b, states),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::run_once;
    use crate::math::{POOL, expand};

    /// A function that stores values computed from the slots 3 and 4 and the force.
    fn of(f: impl for<'a> Fn([Real<'a>; 3]) -> Vec<(Slot, Real<'a>)>) -> Func {
        let build = Shared::new(Build::new("f"));
        let x = [Slot(3), Slot(4), FORCE].map(|slot| Real::new(&build, build.borrow_mut().load(slot)));
        let stores: Vec<_> = f(x).into_iter().map(|(slot, value)| (slot, value.value)).collect();
        let mut build = build.into_inner();
        stores.into_iter().for_each(|(slot, value)| build.store(slot, value));
        build.finish()
    }

    /// Two masses, with speeds in slots 3 and 4, rub on each other: they continue together with their total momentum.
    #[test]
    fn two_free_masses_keep_their_momentum() {
        let states = [Slot(3), Slot(4)];
        let speed = of(|[a, b, _]| vec![(SPEED, a - b)]);
        let rates = of(|[_, _, force]| vec![(Slot(5), (1.0 - force) / 2.0), (Slot(6), force / 3.0)]);
        let pool: Arc<[f64]> = POOL.as_slice().into();
        let func = impulse(&speed, &rates, &states, &[Slot(5), Slot(6)], &pool).expect("the force moves both");
        let build = Shared::new(Build::new("both"));
        let number = |x: f64| build.borrow_mut().real(x);
        let mut env = Env::from_iter([(TARGET, number(0.0)), (ACTS, number(1.0)), (PRESENT, number(0.0))]);
        build.borrow_mut().inline(&func, &mut env);
        let mut build = build.into_inner();
        build.store_env(&env, |slot| slot.0 < 10);
        let mut block = [0.0, 0.0, 0.0, 4.0, -1.0, 0.0, 0.0];
        run_once(&expand(&build.finish()), &mut block, &POOL);
        // 2 · 4 − 3 · 1 = 5 · 1: equal up to rounding.
        assert!(block[3..5].iter().all(|speed| (speed - 1.0).abs() < 1e-15), "{:?}", &block[3..5]);
    }
}
