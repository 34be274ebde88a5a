//! Sampled code that runs faster than the sensor it reads.
//!
//! In: a checked system. Out: W0707 for an `every` block that reads a sampled measurement with a longer period. A
//! measurement is a quantity that a block computes from a single moving quantity of the same unit, or whose rate it is:
//! an encoder, a sample and hold. A slow controller above a fast one computes another quantity, or reads several, and a
//! slow profile reads nothing that moves.

use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::hash::HashSet;
use crate::lower::evaluate;
use abi::format::{duration, three_digits};
use abi::unit::Dimension;
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

const RATE: Dimension = Dimension::of([0, 0, -1, 0, 0]);

/// A held quantity that follows one moving quantity.
struct Sensor {
    measurement: VarId,
    block: BlockId,
}

/// The warnings. `place`: where to report what lies in another file, such as the span of a run.
pub fn check(system: &System, types: &Types, place: Span) -> Vec<Diagnostic> {
    if system.blocks.len() < 2 {
        return Vec::new();
    }
    let periods: Vec<ExprId> = system.blocks.iter().map(|block| block.period).collect();
    let periods = evaluate(system, types, &periods);
    let slowest = periods.iter().copied().fold(0.0, f64::max);
    let mut found = Vec::new();
    for (k, &period) in periods.iter().enumerate().filter(|(_, period)| **period < slowest) {
        let mut reported = HashSet::default();
        for sensor in read_by(system, BlockId(k as u32)).into_iter().filter_map(|var| sensor(system, types, var)) {
            let slow = periods[sensor.block.0 as usize];
            if slow > period * (1.0 + 1e-9) && reported.insert(sensor.block) {
                found.push(warning(system, (BlockId(k as u32), period), (&sensor, slow), place));
            }
        }
    }
    found
}

/// Quantities held by other blocks that the code of a block reads, directly or by equations without memory.
fn read_by(system: &System, block: BlockId) -> Vec<VarId> {
    let mut found = Vec::new();
    let mut seen = HashSet::default();
    let mut stack: Vec<ExprId> = Vec::new();
    for var in &system.vars {
        match var.definition {
            Definition::Held { value, block: own, .. } if own == block => stack.push(value),
            Definition::Sampled { next, block: own, .. } if own == block => stack.push(next),
            _ => {}
        }
    }
    while let Some(id) = stack.pop() {
        if !seen.insert(id) {
            continue;
        }
        if let Node::Var(var) = system.node(id) {
            match system.var(*var).definition {
                Definition::Value(value, _) => stack.push(value),
                Definition::Held { block: own, .. } if own != block => found.push(*var),
                _ => {}
            }
        }
        stack.extend(system.node(id).operands());
    }
    found
}

/// What a measurement is taken from.
enum Source {
    /// An input of the instance that samples, or a continuous state.
    Quantity(VarId),
    /// Something that no sensor reads: time, or the output of another block.
    Other,
}

/// The held quantity as a sensor, if it is one.
fn sensor(system: &System, types: &Types, measurement: VarId) -> Option<Sensor> {
    let Definition::Held { value, block, .. } = system.var(measurement).definition else { return None };
    let mut sources = Vec::new();
    let mut seen = HashSet::default();
    let mut stack = vec![value];
    while let Some(id) = stack.pop() {
        if !seen.insert(id) {
            continue;
        }
        match system.node(id) {
            Node::Time | Node::Rate(_) | Node::PathRate(_) => sources.push(Source::Other),
            Node::Var(at) => {
                let var = system.var(*at);
                let own = var.instance == system.blocks[block.0 as usize].instance;
                match (&var.definition, var.kind) {
                    (_, VarKind::Param) => {}
                    (_, VarKind::Input) if own => sources.push(Source::Quantity(*at)),
                    (Definition::Held { value, block: by, .. }, _) if *by == block => stack.push(*value),
                    (Definition::Sampled { next, block: by, .. }, _) if *by == block => stack.push(*next),
                    (Definition::Value(value, _), _) => stack.push(*value),
                    (Definition::Continuous { .. } | Definition::Free, _) => sources.push(Source::Quantity(*at)),
                    (Definition::Held { .. } | Definition::Sampled { .. }, _) => sources.push(Source::Other),
                    (Definition::Missing, _) => return None,
                }
            }
            Node::Call(
                Builtin::Step
                | Builtin::Ramp
                | Builtin::Pulse
                | Builtin::Sine
                | Builtin::Square
                | Builtin::Chirp
                | Builtin::Noise,
                _,
            ) => sources.push(Source::Other),
            node => stack.extend(node.operands()),
        }
    }
    let mut quantities = HashSet::default();
    for source in sources {
        match source {
            Source::Quantity(var) => quantities.insert(var),
            Source::Other => return None,
        };
    }
    let from = quantities.iter().next().filter(|_| quantities.len() == 1)?;
    let (of, to) = (types.units[from.0 as usize].dimension, types.units[measurement.0 as usize].dimension);
    let fits = to == of || to == of.times(RATE);
    (fits && moves(system, *from)).then_some(Sensor { measurement, block })
}

/// Whether a quantity depends on a continuous state, or on what is outside the model.
fn moves(system: &System, from: VarId) -> bool {
    let mut seen = HashSet::default();
    let mut stack = vec![from];
    while let Some(id) = stack.pop() {
        let mut values = match system.var(id).definition {
            Definition::Continuous { .. } => return true,
            Definition::Free if system.var(id).kind == VarKind::Input => return true,
            Definition::Value(value, _) | Definition::Held { value, .. } => vec![value],
            Definition::Sampled { next, .. } => vec![next],
            Definition::Free | Definition::Missing => continue,
        };
        while let Some(value) = values.pop() {
            match system.node(value) {
                Node::Var(var) if seen.insert(*var) => stack.push(*var),
                node => values.extend(node.operands()),
            }
        }
    }
    false
}

fn warning(system: &System, (fast, period): (BlockId, f64), (sensor, slow): (&Sensor, f64), place: Span) -> Diagnostic {
    let owner = |block: BlockId| {
        let block = &system.blocks[block.0 as usize];
        let instance = system.instance(block.instance);
        match instance.path.as_str() {
            "" => (block.span, "this block".to_string()),
            path => (instance.span, format!("`{path}`")),
        }
    };
    let within = |span: Span| if span.file == place.file { span } else { place };
    let ((reader, name), (source, _)) = (owner(fast), owner(sensor.block));
    let path = &system.var(sensor.measurement).path;
    let message = format!(
        "{name} computes every {} from `{path}`, which changes every {}",
        duration(period, 3),
        duration(slow, 3)
    );
    let ratio = slow / period;
    let label = format!("reads each value {} times", three_digits(ratio));
    let mut warning = Diagnostic::warning("W0707", message).label(within(reader), label);
    if within(source) != within(reader) {
        warning = warning.label(within(source), format!("measures every {}", duration(slow, 3)));
    }
    warning.help("give both the same sample time: between two measurements the faster one sees no motion")
}
