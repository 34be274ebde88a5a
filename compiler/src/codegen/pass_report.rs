//! The effects of all passes on one step, from a program to what is emitted: `fric build --emit passes`.
//!
//! In: a program and a method. Out: one report for each pass, in the order of the lists [`opt::PASSES`] and
//! [`passes::LATE`](LATE).

use crate::codegen::form_loop::is_idempotent;
use crate::codegen::forms::{Context, Form, Options};
use crate::codegen::passes::LATE;
use crate::codegen::tiering;
use crate::ir::cfg::{Cfg, Entry};
use crate::ir::program::Program;
use crate::numerics::fixed_step;
use crate::opt;
use crate::{math, numerics};
use abi::plan::Method;

/// The report of one pass over the step of a program.
pub struct PassRun {
    /// The name of the pass.
    pub name: &'static str,
    /// A description of the pass.
    pub does: &'static str,
    /// Operations before and after the pass; for passes over graphs, of the first form of code for which it runs.
    pub ops: [usize; 2],
    /// Blocks after the pass, if it is one over graphs and runs for this step.
    pub blocks: Option<usize>,
}

/// Runs the passes on the step of a method and calls `ran` after each.
pub fn each(program: &Program, method: Method, ran: &mut dyn FnMut(PassRun)) {
    let plain = |name, does, before, after| PassRun { name, does, ops: [before, after], blocks: None };
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
            opt::optimise_observed(composed, opt::Context::of(program), observe)
        }
    };
    let expanded = math::expand(&func);
    let does = "expands elementary functions into arithmetic";
    ran(plain("expand", does, func.ops.len(), expanded.ops.len()));
    let expanded = if method == Method::Adaptive { numerics::rosenbrock::pooled(&expanded) } else { expanded };
    let options = Options::default();
    let context = Context { layout: Some(&program.description.layout), options: &options };
    let forms: &[Form] = match &expanded {
        long if long.ops.len() > options.lengths.max_function => &[Form::Long],
        step if is_idempotent(step) => &[Form::Once],
        _ => &[Form::Single, Form::Loop, Form::Distributed],
    };
    let called = |form| if form == Form::Single { Entry::Single } else { Entry::Several };
    let mut graphs: Vec<(Form, Cfg)> =
        forms.iter().map(|form| (*form, Cfg::straight(&expanded, called(*form)))).collect();
    for pass in &LATE {
        let mut first: Option<([usize; 2], usize)> = None;
        for (form, graph) in &mut graphs {
            let before = graph.len();
            if pass.apply(graph, *form, &context) {
                first.get_or_insert(([before, graph.len()], graph.blocks.len()));
            }
        }
        let (ops, blocks) = match first {
            Some((ops, blocks)) => (ops, Some(blocks)),
            None => ([graphs[0].1.len(); 2], None),
        };
        ran(PassRun { name: pass.name, does: pass.does, ops, blocks });
    }
}
