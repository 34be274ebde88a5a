//! The list of all passes from a program to machine code, in order, with their effects: `fric build --emit passes`.
//!
//! In: a program and a method. Out: one report for each pass. The passes before code generation are listed in
//! [`opt::PASSES`] and run from there. Those of code generation run during emission, because they need control flow;
//! [`LATE`] lists them with their conditions. Their effects on the step are counted by the functions that emission
//! calls.

use crate::codegen::emit::{ExitCondition, Facts};
use crate::codegen::hoist_params::Hoisted;
use crate::codegen::outline::{Lengths, outline};
use crate::codegen::select_to_branch::BranchRegions;
use crate::codegen::sink::sink;
use crate::codegen::specialise_modes::{modes, specialise};
use crate::codegen::unswitch::unswitchable;
use crate::codegen::{loop_distribution, tiering};
use crate::ir::program::Program;
use crate::ir::{Func, Value};
use crate::numerics::fixed_step;
use crate::opt::{self, Context};
use crate::{math, numerics};
use abi::Layout;
use abi::plan::Method;

/// A pass of code generation.
pub struct Late {
    /// The name of its module.
    pub name: &'static str,
    /// What the pass does and when it runs.
    pub does: &'static str,
    effect: fn(&Func, &Layout) -> Option<String>,
}

impl Late {
    /// What it does with a step, in words. The step is expanded.
    pub fn effect(&self, func: &Func, layout: &Layout) -> String {
        (self.effect)(func, layout).unwrap_or_else(|| "nothing to do".into())
    }
}

/// The passes of code generation, in order.
pub static LATE: [Late; 7] = [
    Late {
        name: "hoist_params",
        does: "computes expressions of parameters and the step length once; for single steps in memory",
        effect: |func, layout| {
            let count = Hoisted::of(func, layout).prepare.stores.len();
            (count > 0).then(|| format!("{count} values hoisted"))
        },
    },
    Late {
        name: "unswitch",
        does: "copies the step for each answer to a comparison that three automata or more test",
        effect: |func, _| unswitchable(func).map(|_| "a copy for each answer".into()),
    },
    Late {
        name: "specialise_modes",
        does: "makes a residual step for each mode of an automaton, and a switch between them",
        effect: |func, _| {
            let (exit_condition, cold) = ExitCondition::of(func);
            let automata = specialise(func, &modes(func), &cold, exit_condition.values().0).automata;
            let modes: usize = automata.iter().map(|automaton| automaton.cases.len()).sum();
            (modes > 0).then(|| format!("{modes} modes of {} automata", automata.len()))
        },
    },
    Late {
        name: "sink",
        does: "moves cheap operations on loads down to their first use, for lower register pressure",
        effect: |func, _| {
            let before = operations(func);
            let moved = before.iter().zip(sink(&func.ops, &before)).filter(|(a, b)| *a != b).count();
            (moved > 0).then(|| format!("{moved} places in the order changed"))
        },
    },
    Late {
        name: "select_to_branch",
        does: "turns selections with an expensive arm into branches that compute one arm",
        effect: |func, _| {
            let results: Vec<Value> = func.results().collect();
            let count = BranchRegions::of(&func.ops, &operations(func), &results).arms.len();
            (count > 0).then(|| format!("{count} branches"))
        },
    },
    Late {
        name: "outline",
        does: "cuts functions of more than 2,000 operations into pieces; repeated parts become loops (reroll)",
        effect: |func, _| {
            let lengths = Lengths::USUAL;
            let outlined = if func.ops.len() > lengths.max_function {
                outline(func, &Facts::of(func), lengths)?
            } else {
                return None;
            };
            Some(format!(
                "{} pieces, {} rows of repeated operations",
                outlined.pieces.len(),
                outlined.repeats.rows.len()
            ))
        },
    },
    Late {
        name: "loop_distribution",
        does: "computes what depends on time alone in a leading vectorised loop; for many steps in one call",
        effect: |func, layout| {
            let distribution = loop_distribution::split(func, layout.size())?;
            Some(format!("{} operations in the leading loop", distribution.leading.ops.len()))
        },
    },
];

/// All live operations of a function, in order.
fn operations(func: &Func) -> Vec<Value> {
    let live = func.live();
    (0..func.ops.len()).filter(|i| live[*i]).map(|i| Value(i as u32)).collect()
}

/// The report of one pass over the step of a program.
pub struct Ran {
    /// The name of the pass.
    pub name: &'static str,
    /// A description of the pass.
    pub does: &'static str,
    /// Operations before and after the pass; for passes of code generation, both are those of the step.
    pub ops: [usize; 2],
    /// The effect in words, where the numbers do not show it.
    pub effect: Option<String>,
}

/// Runs the passes on the step of a method and calls `ran` after each.
pub fn each(program: &Program, method: Method, ran: &mut dyn FnMut(Ran)) {
    let plain = |name, does, before, after| Ran { name, does, ops: [before, after], effect: None };
    let func = match method {
        Method::Adaptive => match tiering::of_lanes(program, method) {
            Some((_, step)) => {
                ran(plain("rosenbrock", "composes one adaptive step", program.derivatives.ops.len(), step.ops.len()));
                step
            }
            None => program.derivatives.clone(),
        },
        _ => {
            let composed = fixed_step::step(program, method);
            let does = "composes ticks, transitions, the method, outputs and guards into one function";
            ran(plain("fixed_step", does, program.derivatives.ops.len(), composed.ops.len()));
            let observe =
                &mut |pass: &'static opt::Pass, before, after| ran(plain(pass.name, pass.does, before, after));
            opt::optimise_observed(composed, Context::of(program), observe)
        }
    };
    let expanded = math::expand(&func);
    let does = "expands elementary functions into arithmetic";
    ran(plain("expand", does, func.ops.len(), expanded.ops.len()));
    let expanded = if method == Method::Adaptive { numerics::rosenbrock::pooled(&expanded) } else { expanded };
    for pass in &LATE {
        let effect = Some(pass.effect(&expanded, &program.description.layout));
        ran(Ran { name: pass.name, does: pass.does, ops: [expanded.ops.len(); 2], effect });
    }
}
