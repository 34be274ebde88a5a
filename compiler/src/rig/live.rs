//! Live parameters of a rig: those that may change while it runs, and the conditions on them, which are those of a
//! start.
//!
//! In: the system before its partition, the expressions that determine the plan, and later both programs. Out: [`Live`]
//! and the judge, a program that computes the numbers of all conditions from parameters. A parameter may change if the
//! step reads it, and if nothing that is fixed at the start depends on it. Setting it then yields exactly the program
//! that a start with the same values would yield.

use crate::analysis::parameter_checks::unmet;
use crate::frontend::delays;
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::units::Types;
use crate::ir::program::Program;
use crate::lower::{self, ParamValue};
use abi::Slot;
use abi::description::Kind as QuantityKind;
use abi::live::{Check, Live, Param, Tunable};
use abi::unit::Unit;

/// Result of the analysis before the programs exist.
#[derive(Clone)]
pub struct LiveChecks {
    params: Vec<LiveParam>,
    checks: Vec<Check>,
    program: Program,
    /// Path of the part that hardware replaces.
    part: String,
}

#[derive(Clone)]
struct LiveParam {
    path: String,
    unit: Unit,
    boolean: bool,
    /// Its slot in the judge.
    slot: Option<Slot>,
    /// The reason why it cannot change during a run; `None` if it can.
    start: Option<String>,
}

/// A command that is sent in a field of a frame.
pub struct FieldCommand {
    /// The command as written: `panel.lamp`.
    pub path: String,
    /// Its unit.
    pub unit: Unit,
    /// Its value.
    pub value: ExprId,
    /// Range that the field can represent, SI units.
    pub range: (f64, f64),
}

/// Everything but values that a start fixes.
pub struct Fixed<'a> {
    /// The part that hardware replaces: its path, and for each instance whether it belongs to the part.
    pub part: (&'a str, &'a [bool]),
    /// Drives and devices.
    pub nodes: &'a [InstanceId],
    /// Expressions of the plan's numbers.
    pub plan: &'a [ExprId],
    /// Periods of sampled blocks, each with the step in s that must divide it.
    pub periods: &'a [(ExprId, f64)],
    /// Commands that are sent in fields of frames.
    pub commands: &'a [FieldCommand],
}

/// Analyses a system whose values have been checked.
pub fn judged(system: &System, types: &Types, files: &Files, fixed: &Fixed) -> LiveChecks {
    let mut wanted = JudgeValues { all: Vec::new(), first: Slot::FIXED + lower::independent(system) };
    let checks = conditions(system, types, files, fixed, &mut wanted);
    let (program, slots) = lower::of_params(system, types, &wanted.all);
    let (part, inside) = fixed.part;
    let reasons: [(Vec<bool>, &str); 3] = [
        (reached(system, &system.blocks.iter().map(|block| block.period).collect::<Vec<_>>()), "a period"),
        (
            reached(system, &system.delays.iter().map(|delay| delays::of(system, *delay).1).collect::<Vec<_>>()),
            "a delay",
        ),
        (reached(system, fixed.plan), "a limit or another number of the rig"),
    ];
    let why = |id: VarId| {
        let var = system.var(id);
        let follows = |what: &str| Some(format!("{what} follows from it"));
        if fixed.nodes.contains(&var.instance) {
            return Some("it describes a drive or device".into());
        }
        if inside[var.instance.0 as usize] {
            return Some(format!("it belongs to `{part}`, which the drives replace"));
        }
        if system.structural.contains(&var.path) {
            return follows("the number of parts");
        }
        if let Some((_, what)) = reasons.iter().find(|(reached, _)| reached[id.0 as usize]) {
            return follows(what);
        }
        if var.kind == VarKind::State {
            return Some("it is a state, which is given a value at the start only".into());
        }
        match var.definition {
            Definition::Value(value, _) if !slots.iter().any(|(own, _)| *own == id) => {
                let text = files.slice(system.span(value)).split_whitespace().collect::<Vec<_>>().join(" ");
                Some(format!("it follows from others, by `{text}`: change those"))
            }
            _ => None,
        }
    };
    // States are included, so that an attempt to set one is answered with the reason.
    let named = |id: &VarId| matches!(system.var(*id).kind, VarKind::Param | VarKind::State);
    let params = system.var_ids().filter(named).map(|id| LiveParam {
        path: system.var(id).path.clone(),
        unit: types.units[id.0 as usize].clone(),
        boolean: types.boolean_vars[id.0 as usize],
        slot: slots.iter().find(|(own, _)| *own == id).map(|(_, slot)| *slot),
        start: why(id),
    });
    LiveChecks { params: params.collect(), checks, program, part: part.to_string() }
}

/// The values that the judge computes.
struct JudgeValues {
    all: Vec<ParamValue>,
    /// Output slot of the first value.
    first: u32,
}

impl JudgeValues {
    fn slot(&mut self, expr: ExprId) -> Slot {
        self.one(ParamValue::Expr(expr))
    }

    fn one(&mut self, sought: ParamValue) -> Slot {
        self.all.push(sought);
        Slot(self.first + self.all.len() as u32 - 1)
    }
}

/// The conditions that a start checks, in the order of the start.
fn conditions(system: &System, types: &Types, files: &Files, fixed: &Fixed, wanted: &mut JudgeValues) -> Vec<Check> {
    let mut checks = Vec::new();
    for (id, unit) in system.var_ids().zip(&types.units) {
        let var = system.var(id);
        let value = match (&var.definition, var.kind) {
            (Definition::Value(..), VarKind::Param | VarKind::Input) => ParamValue::Var(id),
            (Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. }, _) => {
                ParamValue::Expr(*initial)
            }
            _ => continue,
        };
        if var.range.low.is_none() && var.range.high.is_none() {
            continue;
        }
        checks.push(Check::Range {
            path: var.path.clone(),
            name: var.name.clone(),
            model: system.instance(var.instance).model.clone(),
            unit: unit.clone(),
            value: wanted.one(value),
            low: var.range.low.map(|(bound, strict)| (wanted.slot(bound), strict)),
            high: var.range.high.map(|(bound, strict)| (wanted.slot(bound), strict)),
        });
    }
    checks.extend(system.blocks.iter().map(|block| Check::Period(wanted.slot(block.period))));
    checks.extend(system.requires.iter().map(|require| {
        let owner = system.instance(require.instance);
        let (condition, unmet) = (files.slice(require.span), unmet(system, files, require));
        let place = if owner.path.is_empty() { String::new() } else { format!(" (`{}`)", owner.path) };
        let message = format!("{unmet}: {} requires {condition}{place}", owner.model);
        Check::Require { message, value: wanted.slot(require.condition) }
    }));
    checks.extend(fixed.commands.iter().map(|FieldCommand { path, unit, value, range }| Check::Carried {
        path: path.clone(),
        unit: unit.clone(),
        value: wanted.slot(*value),
        range: *range,
    }));
    let multiples = fixed.periods.iter();
    checks.extend(multiples.map(|(period, step)| Check::Multiple { period: wanted.slot(*period), step: *step }));
    checks
}

/// For each quantity, whether one of the expressions depends on it, directly or through other quantities.
pub(super) fn reached(system: &System, exprs: &[ExprId]) -> Vec<bool> {
    let mut vars = vec![false; system.vars.len()];
    let mut seen = crate::ir::hash::HashSet::default();
    let mut stack = exprs.to_vec();
    while let Some(id) = stack.pop() {
        if !seen.insert(id) {
            continue;
        }
        if let Node::Var(var) = system.node(id) {
            vars[var.0 as usize] = true;
            match system.var(*var).definition {
                Definition::Value(value, _) | Definition::Held { value, .. } => stack.push(value),
                Definition::Continuous { initial, rate, .. } => stack.extend([initial, rate]),
                Definition::Sampled { initial, next, .. } => stack.extend([initial, next]),
                Definition::Missing | Definition::Free => {}
            }
        }
        stack.extend(system.node(id).operands());
    }
    vars
}

impl LiveChecks {
    /// Adds the slots of the control program. Also excludes parameters that only the start reads, and those that the
    /// plant reads.
    pub fn finish(self, control: &Program, plant: &Program) -> (Live, Program) {
        let steps = [&control.outputs, &control.derivatives].into_iter();
        let others = [&control.tick, &control.transitions, &control.roots].into_iter().flatten();
        let mut read: Vec<Slot> = steps.chain(others).flat_map(|func| func.loads()).collect();
        read.sort_unstable();
        let at_start = control.start.loads();
        let param = |program: &Program, path: &str| {
            let found = program.description.quantity(path).filter(|quantity| quantity.kind == QuantityKind::Param);
            found.map(|quantity| quantity.slot).filter(|slot| program.description.layout.params.contains(*slot))
        };
        let place = |known: &LiveParam| {
            let start = |why: String| Tunable::Start(why);
            if let Some(why) = &known.start {
                return start(why.clone());
            }
            if param(plant, &known.path).is_some() {
                return start(format!("`{}`, which the drives replace, depends on it", self.part));
            }
            match (param(control, &known.path), known.slot) {
                (Some(slot), Some(judge)) if read.binary_search(&slot).is_ok() => Tunable::Live(slot, judge),
                (Some(slot), _) if at_start.contains(&slot) => start("only values at the start follow from it".into()),
                _ => start("nothing on the rig reads it".into()),
            }
        };
        let params = self.params.iter().map(|known| Param {
            path: known.path.clone(),
            unit: known.unit.clone(),
            boolean: known.boolean,
            place: place(known),
        });
        let live = Live { params: params.collect(), checks: self.checks.clone(), tuned: Vec::new() };
        (live, self.program)
    }
}
