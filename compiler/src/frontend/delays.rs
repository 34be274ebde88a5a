//! Bounds of the time T in `delay(x, T)`, and the length of history that they require.
//!
//! In: a flat [`System`]. Out: bounds and diagnostics, and ring buffers sized for a step. A T that is never 0 breaks
//! cycles, because the present x is not needed.

use crate::frontend::system::*;
use crate::ir::Func;
use crate::ir::build::Build;
use abi::Slot;
use abi::description::{Layout, Segment};
use abi::format::{duration, three_digits};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// Limit on the samples that all delays of a model keep together: 32 MiB.
pub const MOST_SAMPLES: f64 = 4_194_304.0;

/// The arguments of a delay: (x, T).
pub fn of(system: &System, node: ExprId) -> (ExprId, ExprId) {
    match system.node(node) {
        Node::Call(Builtin::Delay, args) => (args[0], args[1]),
        other => unreachable!("a delay, not {other:?}"),
    }
}

/// Least and greatest T in s, if known; the least is 0 by default.
pub fn range(system: &System, time: ExprId) -> Option<(f64, f64)> {
    if let Some(time) = system.literal(time) {
        return (time >= 0.0 && time.is_finite()).then_some((time, time));
    }
    match system.node(time) {
        Node::Fits { value, .. } => range(system, *value),
        Node::Var(id) if system.var(*id).kind == VarKind::Param => {
            let declared = system.var(*id).range;
            let bound = |bound: Option<(ExprId, bool)>| bound.map(|(bound, _)| system.literal(bound));
            let (low, high) = (bound(declared.low)??, bound(declared.high)??);
            (low >= 0.0 && high.is_finite()).then_some((low, high))
        }
        _ => None,
    }
}

/// Whether the present value is not needed. Holds if the least T is positive, since no step may be longer than it.
pub fn breaks(system: &System, node: &Node) -> bool {
    match node {
        Node::Call(Builtin::Delay, args) => range(system, args[1]).is_some_and(|(least, _)| least > 0.0),
        _ => false,
    }
}

/// E0503: T must be a number or a parameter with constant bounds.
pub fn check(system: &System, diagnostics: &mut Vec<Diagnostic>) {
    for delay in &system.delays {
        let (_, time) = of(system, *delay);
        if range(system, time).is_some() {
            continue;
        }
        let error = Diagnostic::error("E0503", "how long can this delay be?");
        let param = match system.node(time) {
            Node::Var(id) if system.var(*id).kind == VarKind::Param => Some(system.var(*id)),
            _ => None,
        };
        diagnostics.push(match param {
            Some(var) => error
                .label(system.span(time), "as much of the past must be kept")
                .label(var.range_span.unwrap_or(var.span), "no bounds that are numbers, from 0 s on")
                .help(format!("give it bounds: `param {} = … in 0 s .. 50 ms`", var.name)),
            None => error
                .label(system.span(time), "neither a time nor a param")
                .help("write a time, such as `5 ms`, or the name of a param with bounds, `in 0 s .. 50 ms`"),
        });
    }
}

/// E0503: no step may exceed the least T that breaks a cycle, and the history must fit into [`MOST_SAMPLES`].
pub fn fits(system: &System, step: f64, at: Option<Span>, diagnostics: &mut Vec<Diagnostic>) {
    let mut samples = 0.0;
    for delay in &system.delays {
        let (_, time) = of(system, *delay);
        let Some((least, most)) = range(system, time) else { continue };
        let mut error = if least > 0.0 && step > least * (1.0 + 1e-12) {
            let message =
                format!("a step of {} is longer than this delay may be, {}", duration(step, 3), duration(least, 3));
            Diagnostic::error("E0503", message)
                .label(system.span(*delay), "its value is not known within the step")
                .help(format!("take steps of {} or less", duration(least, 3)))
        } else {
            samples += slots(most, step);
            if samples <= MOST_SAMPLES {
                continue;
            }
            samples = f64::NEG_INFINITY;
            Diagnostic::error("E0503", format!("{} steps of the past are too many to keep", three_digits(most / step)))
                .label(system.span(*delay), format!("up to {} back", duration(most, 3)))
                .help("narrow the range of the delay or take longer steps: four million samples are the limit")
        };
        if let Some(at) = at {
            error = error.label(at, "the step");
        }
        diagnostics.push(error);
    }
}

/// E0905: a delay has no finite state matrix.
pub fn linear(system: &System) -> Option<Diagnostic> {
    let delay = system.delays.first()?;
    let error = Diagnostic::error("E0905", "a model with a `delay` cannot be linearised yet")
        .label(system.span(*delay), "depends on the past, not on states alone");
    Some(error.help("a first-order lag comes close for slow motions: `dy/dt = (x - y) / T`"))
}

/// Slots of a ring buffer that reaches `most` s back in steps of `step` s: a power of two.
fn slots(most: f64, step: f64) -> f64 {
    let needed = (most / step).ceil() + 2.0;
    let mut slots = 2.0;
    while slots < needed {
        slots *= 2.0;
    }
    slots
}

impl crate::ir::program::Program {
    /// Sizes the ring buffers for fixed steps of `step` s, and for those of companion runs, which may be four times
    /// shorter, unless that exceeds [`MOST_SAMPLES`].
    pub fn size_rings_for_companions(&mut self, step: f64) {
        let samples: f64 = self.description.delays.iter().map(|delay| slots(delay.range.1, 0.25 * step)).sum();
        self.size_rings(if samples <= MOST_SAMPLES { 0.25 * step } else { step });
    }

    /// Sizes the ring buffers for fixed steps of `step` s and removes those for adaptive runs. Call it before code is
    /// generated.
    pub fn size_rings(&mut self, step: f64) {
        let mut len = 0;
        let mut layout = self.description.layout.clone();
        layout.trial = Segment::default();
        let of_before = layout.rings;
        let layout = layout.with_rings(0);
        let (mut build, mut stores) = (Build::of(&self.start), self.start.stores.clone());
        stores.retain(|(slot, _)| !of_before.contains(*slot));
        let [h, one, zero] = [build.load(Slot::STEP), build.real(1.0), build.real(0.0)];
        for delay in &mut self.description.delays {
            delay.ring =
                Segment { start: layout.rings.start + len, len: slots(delay.range.1, step).min(MOST_SAMPLES) as u32 };
            len += delay.ring.len;
            let stored = |slot: Slot| stores.iter().find(|(stored, _)| *stored == slot).map(|(_, value)| *value);
            let [time, past] = [delay.time, delay.past].map(|slot| stored(slot).expect("the start stores it"));
            let steps = build.div(time, h);
            let [back, weight] = [build.sub(steps, one), build.sub(one, steps)].map(|steps| build.max(zero, steps));
            // The start value is the first sample, and also the value of all time before the start.
            let ends = [0, delay.ring.len as usize - 1].map(|k| (delay.ring.slot(k), past));
            let places = [(delay.back, back)].into_iter().chain(delay.weight.map(|slot| (slot, weight)));
            stores.retain(|(slot, _)| *slot != delay.back && Some(*slot) != delay.weight);
            stores.extend(places.chain(ends));
        }
        self.start = Func { ops: build.into_ops(), stores, ..self.start.clone() };
        self.description.layout = Layout::with_rings(layout, len);
    }
}
