//! Variance: which values can change from one step to the next, and on what.
//!
//! In: a function that runs in a loop over steps. Out: the [`Variance`] of each value, the greatest of what its operands
//! depend on. It is the one answer for all passes that move operations out of the loop or order them by when they are
//! ready: `opt::contract`, and in `codegen` the hoisting of parameters and of loop invariants, loop distribution and the
//! loops of lanes.
//!
//! Source: Aho, Lam, Sethi, Ullman, *Compilers*, 2007, sec. 9.5 (loop-invariant expressions), here with more than two
//! levels.

use super::{Func, Op};
use crate::ir::hash::HashSet;
use abi::{Layout, Slot};

/// The most variable quantity that a value depends on. Each level includes those before it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Variance {
    /// Parameters, the step length and constants: the same until somebody changes a parameter.
    Parameters,
    /// Inputs and other slots that no step stores: the same during one call of several steps.
    Inputs,
    /// Time, the step counter, and inputs from rows: known before the states are.
    Time,
    /// Samples that earlier steps have written to a ring.
    Samples,
    /// Results of the previous step.
    State,
}

impl Variance {
    /// Whether no step of a call changes the value.
    pub fn is_invariant(self) -> bool {
        self <= Variance::Inputs
    }
}

/// The variance of the slots of a function.
pub struct Slots<'l> {
    stored: HashSet<Slot>,
    /// Inputs that each step reads from a row of its own.
    in_rows: &'l [Slot],
    layout: Option<&'l Layout>,
}

impl<'l> Slots<'l> {
    /// The slots of a function that stores these. Without a layout no slot is known to be a parameter.
    pub fn new(stored: impl Iterator<Item = Slot>, layout: Option<&'l Layout>) -> Slots<'l> {
        Slots { stored: stored.collect(), in_rows: &[], layout }
    }

    /// The same, where steps read these inputs from rows.
    pub fn reading_rows(self, in_rows: &'l [Slot]) -> Slots<'l> {
        Slots { in_rows, ..self }
    }

    /// The variance of a load.
    pub fn of(&self, slot: Slot) -> Variance {
        match slot {
            Slot::TIME | Slot::COUNT if self.stored.contains(&slot) => Variance::Time,
            slot if self.stored.contains(&slot) => Variance::State,
            slot if self.in_rows.contains(&slot) => Variance::Time,
            Slot::STEP => Variance::Parameters,
            slot if self.layout.is_some_and(|layout| layout.params.contains(slot)) => Variance::Parameters,
            _ => Variance::Inputs,
        }
    }

    fn of_func(func: &Func, layout: Option<&'l Layout>) -> Slots<'l> {
        Slots::new(func.stores.iter().map(|(slot, _)| *slot), layout)
    }
}

/// The variance of each value of a function. A layout distinguishes parameters from inputs.
pub fn variance(func: &Func, layout: Option<&Layout>) -> Vec<Variance> {
    of_ops(&func.ops, &Slots::of_func(func, layout), |_| Variance::Parameters)
}

/// The variance of each value of a step that reads these inputs from rows.
pub fn with_rows(func: &Func, in_rows: &[Slot]) -> Vec<Variance> {
    of_ops(&func.ops, &Slots::of_func(func, None).reading_rows(in_rows), |_| Variance::Parameters)
}

/// The variance of each of some operations. `at_least`: the least variance of the operation with this index.
pub fn of_ops(ops: &[Op], slots: &Slots, at_least: impl Fn(usize) -> Variance) -> Vec<Variance> {
    let own = |i: usize| own(ops[i], slots).max(at_least(i));
    propagate(ops.len(), own, |i, each| ops[i].each_operand(|operand| each(operand.index())))
}

/// As [`variance`], where the condition of a select does not count: for latencies, because a branch predictor hides
/// that of a condition.
pub fn of_data(func: &Func, layout: &Layout) -> Vec<Variance> {
    let slots = Slots::of_func(func, Some(layout));
    let own = |i: usize| own(func.ops[i], &slots);
    propagate(func.ops.len(), own, |i, each| func.ops[i].each_data_operand(|operand| each(operand.index())))
}

/// What an operation adds to the variance of its operands.
fn own(op: Op, slots: &Slots) -> Variance {
    match op {
        Op::Load(slot) => slots.of(slot),
        Op::Ring { .. } => Variance::Samples,
        _ => Variance::Parameters,
    }
}

/// The variance of each of `count` operations in topological order: the greatest of its `own` and those of its
/// operands. `operands` calls its second argument with each operand of an operation.
pub fn propagate(
    count: usize,
    own: impl Fn(usize) -> Variance,
    operands: impl Fn(usize, &mut dyn FnMut(usize)),
) -> Vec<Variance> {
    let mut all: Vec<Variance> = Vec::with_capacity(count);
    for i in 0..count {
        let mut most = own(i);
        operands(i, &mut |operand| most = most.max(all[operand]));
        all.push(most);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::interpret::run_once;
    use crate::ir::random::{self, Random};

    #[test]
    fn each_kind_of_slot_has_its_level() {
        let text = "step:\n  v0 = load 1\n  v1 = load 3\n  v2 = load 4\n  v3 = load 5\n  v4 = load 2\n  v5 = 1.0
  v6 = add v4 v5\n  v7 = mul v0 v1\n  v8 = mul v7 v2\n  v9 = add v8 v3\n  v10 = mul v6 v0\n  store 2 = v6\n  store 5 = v9\n";
        let func = crate::ir::parse::parse(text).unwrap();
        let layout = Layout::new([1, 1, 1, 0, 0, 0, 0, 0, 0, 0]);
        use Variance::{Inputs, Parameters, State, Time};
        assert_eq!(
            variance(&func, Some(&layout)),
            [Parameters, Parameters, Inputs, State, Time, Parameters, Time, Parameters, Inputs, State, Time]
        );
        assert_eq!(variance(&func, None)[..4], [Parameters, Inputs, Inputs, State]);
    }

    #[test]
    fn conditions_do_not_delay_data() {
        let text = "step:\n  v0 = load 3\n  v1 = load 4\n  v2 = less v0 v1\n  v3 = select v2 v1 v1\n  store 3 = v3\n";
        let func = crate::ir::parse::parse(text).unwrap();
        let layout = Layout::new([0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!((variance(&func, None)[3], of_data(&func, &layout)[3]), (Variance::State, Variance::Inputs));
    }

    /// An invariant value is the same in every step: the interpreter repeats each function and compares.
    #[test]
    fn invariants_of_random_functions_do_not_change() {
        let (mut invariant, mut changed) = (0, 0);
        for seed in 0..400 {
            let mut random = Random(seed);
            let len = 20 + random.below(80);
            let mut func = random::func(&mut random, len);
            let variance = variance(&func, None);
            // Each real that is not a result is observed through a slot after the block.
            let layout = random::layout();
            let types = crate::ir::verify::types(&func).unwrap();
            let seen: Vec<usize> = (0..func.ops.len()).filter(|i| types[*i] == crate::ir::Type::Real).collect();
            for (k, i) in seen.iter().enumerate() {
                func.stores.push((Slot((layout.size() + k) as u32), crate::ir::Value(*i as u32)));
            }
            let pool: Vec<f64> = (0..random::POOL_LEN).map(|_| random.real()).collect();
            let mut block: Vec<f64> = (0..layout.size()).map(|_| random.real()).collect();
            block.resize(layout.size() + seen.len(), 0.0);
            let mut values = || {
                run_once(&func, &mut block, &pool);
                block[layout.size()..].iter().map(|x| x.to_bits()).collect::<Vec<_>>()
            };
            let (first, second) = (values(), values());
            for (k, i) in seen.into_iter().enumerate() {
                let (same, is_invariant) = (first[k] == second[k], variance[i].is_invariant());
                assert!(same || !is_invariant, "seed {seed}: v{i} is {:?} and changes\n{func}", variance[i]);
                invariant += usize::from(is_invariant);
                changed += usize::from(!same);
            }
        }
        assert!(invariant > 2000 && changed > 500, "{invariant} invariants, {changed} changes");
    }
}
