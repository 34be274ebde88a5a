//! The passes over the straight-line function of a fixed step, in their order.
//!
//! In: a step as `numerics::fixed_step` composes it, with elementary functions still as operations. Out: an equivalent
//! step with a shorter critical path and fewer operations. Reassociation and contraction change how results are
//! rounded, so all of these passes run before every back end: the back ends then agree to the bit. Passes that need
//! control flow or depend on the processor are in `codegen`.

mod twins;
pub mod reassociate;
pub mod contract;
pub mod limiter_tests;
pub mod guard_reduction;

use crate::ir::Func;
use crate::ir::program::Program;
use abi::Layout;

/// The facts about a program that the passes need besides the function.
#[derive(Clone, Copy)]
pub struct Context<'p> {
    /// The layout of the block.
    pub layout: &'p Layout,
    /// Whether opposite forces of equal size must cancel to exactly 0: see [`reassociate::reassociate`].
    pub balanced: bool,
}

impl Context<'_> {
    /// The context of a program.
    pub fn of(program: &Program) -> Context<'_> {
        Context { layout: &program.description.layout, balanced: program.balanced }
    }
}

/// A pass from one straight-line function to the next.
pub struct Pass {
    /// The name of its module.
    pub name: &'static str,
    /// What it does, in one sentence.
    pub does: &'static str,
    /// The pass.
    pub run: fn(&Func, Context) -> Func,
}

/// The passes, in the order in which they run.
pub static PASSES: [Pass; 4] = [
    // First, because it decides how sums and products are grouped.
    Pass {
        name: "reassociate",
        does: "regroups sums and products for the shortest critical path from step to step",
        run: |func, context| reassociate::reassociate(func, context.balanced),
    },
    // After the grouping, because it fuses a product with the sum that the grouping has assigned it to.
    Pass {
        name: "contract",
        does: "fuses products and sums into one rounding (FMA) where no cancellation depends on the second",
        run: |func, context| contract::contract(func, context.layout),
    },
    Pass {
        name: "limiter_tests",
        does: "keeps one test of a limited integrator where beginning and middle of a step decide alike",
        run: |func, _| limiter_tests::drop_limiter_tests(func),
    },
    // Last, because it derives the finiteness of values from the final operations.
    Pass {
        name: "guard_reduction",
        does: "drops addends from the finiteness guard that other addends imply",
        run: |func, _| guard_reduction::reduce_guards(func),
    },
];

/// Runs all passes on a step.
pub fn optimise(step: Func, context: Context) -> Func {
    optimise_observed(step, context, &mut |_, _, _| ())
}

/// As [`optimise`], without one pass: for measurements.
pub fn optimise_without(step: Func, context: Context, off: Option<&str>) -> Func {
    let passes = PASSES.iter().filter(|pass| off != Some(pass.name));
    passes.fold(step, |func, pass| (pass.run)(&func, context))
}

/// Like [`optimise`]. `ran` is called after each pass, with the number of operations before and after it.
pub fn optimise_observed(step: Func, context: Context, ran: &mut dyn FnMut(&'static Pass, usize, usize)) -> Func {
    PASSES.iter().fold(step, |func, pass| {
        let after = (pass.run)(&func, context);
        ran(pass, func.ops.len(), after.ops.len());
        after
    })
}
