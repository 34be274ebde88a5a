//! The passes over control-flow graphs, in the order in which they run: from a straight-line function to what is emitted.
//!
//! In: a function and the form of code that is wanted. Out: its graph. The compiler runs this list, `fric build --emit
//! passes` prints it, and docs/machine-code.md explains it. The passes before, over straight lines, are
//! [`opt::PASSES`](crate::opt::PASSES).

use crate::codegen::drop_counter::drop_counter;
use crate::codegen::form_loop::form_loop;
use crate::codegen::forms::{Context, Form};
use crate::codegen::hoist_invariants::hoist_invariants;
use crate::codegen::hoist_params::hoist_params;
use crate::codegen::loop_distribution::loop_distribution;
use crate::codegen::outline::outline;
use crate::codegen::predictive_commoning::predictive_commoning;
use crate::codegen::select_to_branch::select_to_branch;
use crate::codegen::side_exit::side_exit;
use crate::codegen::sink::sink;
use crate::codegen::specialise_modes::specialise_modes;
use crate::codegen::unswitch::unswitch;
use crate::ir::Func;
use crate::ir::cfg::{Cfg, Entry, Rows};
use crate::ir::cfg_verify::verify_cfg;
use Form::{Distributed, Long, Loop, Once, Single};

/// A pass over a graph.
pub struct Pass {
    /// The name of its module.
    pub name: &'static str,
    /// What it does, in one sentence.
    pub does: &'static str,
    /// The forms of code for which it runs.
    pub on: &'static [Form],
    run: fn(&mut Cfg, &Context),
}

const fn pass(name: &'static str, on: &'static [Form], run: fn(&mut Cfg, &Context), does: &'static str) -> Pass {
    Pass { name, does, on, run }
}

/// The passes, in order. First those that need the function in one block, then those that give it more, then those on any
/// number of blocks.
#[rustfmt::skip]
pub static LATE: [Pass; 12] = [
    pass("drop_counter", &[Single], |cfg, _| drop_counter(cfg),
        "leaves the step counter to the caller"),
    pass("hoist_params", &[Single], |cfg, context| _ = context.layout.map(|layout| hoist_params(cfg, layout)),
        "computes expressions of parameters and the step length once; in memory"),
    pass("loop_distribution", &[Distributed], |cfg, context| _ = context.layout.map(|layout| loop_distribution(cfg, layout)),
        "computes what depends on time or rows of inputs alone in a leading vectorised loop"),
    pass("unswitch", &[Single], |cfg, _| unswitch(cfg),
        "copies the step for each answer to a comparison that three automata or more test"),
    pass("specialise_modes", &[Single, Once], |cfg, _| specialise_modes(cfg),
        "makes a residual step for each mode of an automaton, and a switch between them"),
    pass("outline", &[Long], |cfg, context| outline(cfg, context.options.lengths),
        "cuts the function into pieces; repeated parts become loops (reroll)"),
    pass("form_loop", &[Loop, Distributed], |cfg, _| form_loop(cfg),
        "wraps the step in a loop that carries its states in registers"),
    pass("predictive_commoning", &[Loop, Distributed], |cfg, _| predictive_commoning(cfg),
        "carries to the next step what the end of a step shares with its begin"),
    // After the loop, so that what only the status needs is not taken for an invariant.
    pass("side_exit", &[Single, Once, Loop, Distributed], |cfg, _| side_exit(cfg),
        "moves what only the status of a failed guard needs to a cold block"),
    pass("hoist_invariants", &[Loop, Distributed], |cfg, _| hoist_invariants(cfg),
        "computes what no step changes before the loop"),
    pass("sink", &[Single, Once], |cfg, _| sink(cfg),
        "moves cheap operations on loads down to their first use, for lower register pressure"),
    // Last, because the passes before find selects easier to read than branches.
    pass("select_to_branch", &[Single, Once, Loop, Long, Distributed], |cfg, _| select_to_branch(cfg),
        "turns selections with an expensive arm into branches that compute one arm"),
];

impl Pass {
    /// Runs the pass on the graph of a function, if it is one for this form and is not switched off. The loop cannot be
    /// switched off: without it the code would make a single iteration.
    pub fn apply(&self, cfg: &mut Cfg, form: Form, context: &Context) -> bool {
        let off = self.name != "form_loop" && context.options.off.iter().any(|name| name == self.name);
        let runs = self.on.contains(&form) && !off;
        if runs {
            (self.run)(cfg, context);
            if cfg!(debug_assertions) {
                verify_cfg(cfg).unwrap_or_else(|fault| panic!("after {}: {fault}\n{cfg}", self.name));
            }
        }
        runs
    }
}

/// Runs all passes on a function.
pub fn run(func: &Func, form: Form, called: Entry, context: &Context) -> Cfg {
    apply_all(Cfg::straight(func, called), form, context)
}

/// Runs all passes on a step in a loop over rows of inputs and outputs, for a form that is a loop.
pub fn run_on_rows(func: &Func, rows: Rows, form: Form, context: &Context) -> Cfg {
    let cfg = Cfg { rows: Some(rows), ..Cfg::straight(func, Entry::Several) };
    apply_all(cfg, form, context)
}

fn apply_all(mut cfg: Cfg, form: Form, context: &Context) -> Cfg {
    for pass in &LATE {
        let runs = pass.apply(&mut cfg, form, context);
        // A step that is not distributed has its code already.
        if runs && pass.name == "loop_distribution" && cfg.leading.is_none() {
            break;
        }
    }
    cfg.compact();
    cfg
}
