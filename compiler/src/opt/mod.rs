//! The passes over a straight-line step, in their order.
//!
//! In: a step as `numerics::fixed_step` composes it, with elementary functions still as operations. Out: an equivalent step on
//! a shorter critical path. These passes may change rounding, so they run before every back end: all back ends agree to the
//! bit. Passes that need control flow or know the processor are in `codegen`.

pub mod reassociate;
pub mod contract;
pub mod limiter_tests;
pub mod guard_reduction;

use crate::ir::Func;
use crate::ir::program::Program;
use abi::Layout;

/// What the passes know of a program besides the function.
#[derive(Clone, Copy)]
pub struct Context<'p> {
    /// The layout of the block.
    pub layout: &'p Layout,
    /// Whether differences of equal forces must stay exactly 0: see [`reassociate::reassociate`].
    pub balanced: bool,
}

impl Context<'_> {
    /// Of a program.
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
    run: fn(&Func, Context) -> Func,
}

/// The passes, in the order in which they run.
pub static PASSES: [Pass; 4] = [
    // First: it may split sums, and so decides which products and sums there are.
    Pass {
        name: "reassociate",
        does: "regroups sums and products for the shortest critical path from step to step",
        run: |func, context| reassociate::reassociate(func, context.balanced),
    },
    // After the sums are grouped, since a product fuses with the sum that it then enters.
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
    // Last: which values show that others are finite depends on all operations before.
    Pass {
        name: "guard_reduction",
        does: "drops addends from the finiteness guard whose failure shows in another addend",
        run: |func, _| guard_reduction::reduce_guards(func),
    },
];

/// A step after all passes.
pub fn optimise(step: Func, context: Context) -> Func {
    optimise_observed(step, context, &mut |_, _, _| ())
}

/// The same; `ran` is called after each pass with the numbers of operations before and after it.
pub fn optimise_observed(step: Func, context: Context, ran: &mut dyn FnMut(&'static Pass, usize, usize)) -> Func {
    PASSES.iter().fold(step, |func, pass| {
        let after = (pass.run)(&func, context);
        ran(pass, func.ops.len(), after.ops.len());
        after
    })
}
