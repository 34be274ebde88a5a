//! Runs of one compiled experiment with varying parameters.
//!
//! In: an experiment that was read with the paths of the varying parameters. Out: for given values an instance and a
//! plan, or the condition that the values violate. Everything in a plan that depends on parameters is recomputed:
//! duration, windows, corners, declared ranges and `require` conditions. Only code is compiled once.

use crate::analysis::tuning::Tuned;
use crate::experiment::start_values;
use crate::experiment::{PlanNumber, Variant, depends, is_number_of_peak};
use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::ir::Func;
use crate::ir::interpret::run_once;
use crate::lower::formulas;
use crate::ranges::reach::{greatest, least};
use abi::description::{Guard, Kind, Quantity};
use abi::lanes::Lanes;
use abi::live::is_multiple;
use abi::plan::{Edge, Expect, Experiment, Formula, Measure, MeasureKind, Method, Plot, Window};
use abi::table::Code;
use abi::unit::Unit;
use abi::{Description, Instance, Slice, Slot};
use grammar::diagnostic::Diagnostic;
use std::sync::Arc;

/// A compiled experiment with parameters that vary from run to run.
pub struct Varying {
    /// Label of this combination of the experiment's own sweeps.
    pub label: String,
    /// The plan for the parameters as written.
    pub experiment: Experiment,
    /// The plots of the experiment.
    pub plots: Vec<Plot>,
    /// Parameters that its panel may turn, in this order; all if there are none.
    pub tuned: Vec<Tuned>,
    /// Notes for the user.
    pub notes: Vec<String>,
    description: Arc<Description>,
    params: Vec<f64>,
    code: Code,
    slice: Option<Slice>,
    lanes: Option<Lanes>,
    adaptive: Option<Arc<Instance>>,
    varied: Vec<String>,
    formulas: Func,
    size: usize,
    /// Uses of the values of the formulas, in order.
    uses: Vec<Use>,
    /// Number of the experiment's expectations; those after them watch ranges.
    expects: usize,
}

/// Use of a computed value.
enum Use {
    Plan(PlanNumber),
    Corner,
    /// A bound of a quantity: its index in the description, and whether it is the upper one.
    Bound(usize, bool),
    /// A parameter, whose bounds are the next values: path, unit, and for each bound whether it is strict.
    Range {
        path: String,
        unit: Unit,
        low: Option<bool>,
        high: Option<bool>,
    },
    /// A bound of the preceding range.
    Limit,
    /// A condition that must not be 0, and the message if it is.
    Require(String),
    /// A period in s.
    Period,
}

/// Compiled code of an experiment.
pub struct Runnable {
    /// Code for single runs.
    pub code: Code,
    /// The step for single runs without the outputs that the experiment does not read, if it has such. The lanes leave out
    /// the same.
    pub slice: Option<Slice>,
    /// The program for adaptive runs of an experiment with fixed steps, if available.
    pub adaptive: Option<Arc<Instance>>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Instance and plan for a run.
pub struct PreparedRun {
    /// The instance with its parameters.
    pub instance: Instance,
    /// The plan of the run.
    pub experiment: Experiment,
}

impl Varying {
    /// From an experiment as read, and its code.
    pub fn new(variant: Variant, vary: &[String], files: &Files, runnable: Runnable) -> Varying {
        let Runnable { code, slice, adaptive, notes } = runnable;
        let Variant { label, system, types, program, mut experiment, places, tuned, .. } = variant;
        let varies = |expr: ExprId| depends(&system, expr, &|var| vary.contains(&var.path));
        let (mut exprs, mut uses) = (Vec::new(), Vec::new());
        for (place, expr) in places {
            if varies(expr) {
                exprs.push(expr);
                uses.push(Use::Plan(place));
            }
        }
        if system.corners.iter().any(|corner| varies(*corner)) {
            exprs.extend(&system.corners);
            uses.extend(system.corners.iter().map(|_| Use::Corner));
        }
        for (k, quantity) in program.description.quantities.iter().enumerate() {
            let Some(var) = system.vars.iter().find(|var| var.path == quantity.path) else { continue };
            for (bound, high) in [(var.range.low, false), (var.range.high, true)] {
                if let Some((bound, _)) = bound.filter(|(bound, _)| varies(*bound)) {
                    exprs.push(bound);
                    uses.push(Use::Bound(k, high));
                }
            }
        }
        for (var, unit) in system.vars.iter().zip(&types.units) {
            let value = match (&var.definition, var.kind) {
                (Definition::Value(value, _), VarKind::Param) => *value,
                (Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. }, _) => *initial,
                _ => continue,
            };
            let bounds = [var.range.low, var.range.high];
            let touched = vary.contains(&var.path) || varies(value);
            if bounds.iter().all(Option::is_none) || !(touched || bounds.iter().flatten().any(|(b, _)| varies(*b))) {
                continue;
            }
            exprs.push(value);
            let [low, high] = bounds.map(|bound| bound.map(|(_, strict)| strict));
            uses.push(Use::Range { path: var.path.clone(), unit: unit.clone(), low, high });
            for (bound, _) in bounds.into_iter().flatten() {
                exprs.push(bound);
                uses.push(Use::Limit);
            }
        }
        for require in system.requires.iter().filter(|require| varies(require.condition)) {
            exprs.push(require.condition);
            let owner = &system.instance(require.instance).path;
            let owner = if owner.is_empty() { String::new() } else { format!("{owner}: ") };
            let condition = || format!("requires {}", files.slice(require.span));
            uses.push(Use::Require(format!("{owner}{}", require.message.clone().unwrap_or_else(condition))));
        }
        let fixed = experiment.solver.method != Method::Adaptive;
        let step_varies = uses.iter().any(|one| matches!(one, Use::Plan(PlanNumber::Step)));
        for block in system.blocks.iter().filter(|block| varies(block.period) || fixed && step_varies) {
            exprs.push(block.period);
            uses.push(Use::Period);
        }
        let (formulas, size) = formulas(&system, &types, &exprs);
        let expects = experiment.expects.len();
        let plots = std::mem::take(&mut experiment.plots);
        (experiment.records, experiment.every) = (Vec::new(), None);
        if experiment.solver.method != Method::Adaptive {
            // The code of a fixed step contains constant ranges; `in_code` has removed those that vary.
            let guarded = uses.iter().filter_map(|one| match one {
                Use::Bound(k, _) => Some(&program.description.quantities[*k]),
                _ => None,
            });
            let mut watched: Vec<&Quantity> = guarded.filter(|quantity| quantity.kind != Kind::Param).collect();
            watched.dedup_by_key(|quantity| quantity.slot);
            experiment.expects.extend(watched.into_iter().map(|quantity| extremes(quantity, experiment.duration)));
        }
        Varying {
            label,
            experiment,
            plots,
            tuned,
            notes,
            description: Arc::new(program.description),
            params: program.params,
            code,
            slice,
            lanes: None,
            adaptive,
            varied: vary.to_vec(),
            formulas,
            size,
            uses,
            expects,
        }
    }

    /// The same with code for many runs at once in lanes. They leave out the outputs that the slice leaves out.
    pub fn with_lanes(self, lanes: Option<Lanes>) -> Varying {
        Varying { lanes, ..self }
    }

    /// What the measures of a run with a fixed step read after each step, apart from time, ascending; none if they need only
    /// the last.
    pub fn read_each_step(&self) -> Option<Vec<Slot>> {
        let mut measures = self.experiment.expects.iter().flat_map(|expect| &expect.measures);
        let last = |measure: &Measure| measure.kind == MeasureKind::Final && measure.window == Window::default();
        let needs_last = self.experiment.solver.method == Method::Adaptive || measures.all(last);
        (!needs_last).then(|| self.experiment.reads().into_iter().filter(|slot| *slot != Slot::TIME).collect())
    }

    /// The description of its program.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Whether its code has a length of memory that the step determines.
    pub fn keeps_past(&self) -> bool {
        !self.description.delays.is_empty()
    }

    /// The code that steps many runs at once, if available.
    pub fn lanes(&self) -> Option<&Lanes> {
        self.lanes.as_ref()
    }

    /// The parameter of this path, or the one for the start value of the state of this path, if a run can set it.
    pub fn param(&self, path: &str) -> Option<&Quantity> {
        param_of(&self.description, path)
    }

    /// The parameters that may vary, in the order of the text, each with its value in SI as the text has it.
    pub fn params(&self) -> impl Iterator<Item = (&Quantity, f64)> {
        let params = self.description.layout.params;
        let varied = self
            .description
            .quantities
            .iter()
            .filter(move |quantity| params.contains(quantity.slot) && self.varied.contains(&quantity.path));
        varied.map(move |quantity| (quantity, self.params[quantity.slot.index() - params.start as usize]))
    }

    /// Number of the experiment's expectations. Later verdicts concern ranges; see [`Varying::left`].
    pub fn expects(&self) -> usize {
        self.expects
    }

    /// An instance and a plan for these values in SI units.
    ///
    /// # Errors
    /// The violated condition, in words.
    pub fn at(&self, values: &[(Slot, f64)]) -> Result<PreparedRun, String> {
        let mut instance = Instance::new(self.description.clone(), self.code.clone(), &self.params);
        if let Some(adaptive) = &self.adaptive {
            instance = instance.with_adaptive(adaptive.clone());
        }
        if let Some(slice) = &self.slice {
            instance = instance.with_slice(slice.clone());
        }
        for (slot, value) in values {
            instance.set(*slot, *value);
        }
        let mut experiment = self.experiment.clone();
        if self.uses.is_empty() {
            return Ok(PreparedRun { instance, experiment });
        }
        let mut block = vec![0.0; self.size];
        let params = self.description.layout.params.range();
        block[params.clone()].copy_from_slice(&instance.block()[params]);
        run_once(&self.formulas, &mut block, &self.description.pool);
        let numbers = &block[self.size - self.uses.len()..];
        let duration = experiment.duration;
        let fixed = experiment.solver.method != Method::Adaptive;
        let mut corners: Option<Vec<f64>> = None;
        let mut description: Option<Description> = None;
        for (k, (one, number)) in self.uses.iter().zip(numbers).enumerate() {
            let number = *number;
            match one {
                Use::Plan(place) => set(&mut experiment, *place, number)?,
                Use::Corner => corners.get_or_insert_default().push(number),
                Use::Bound(k, high) => {
                    let description = description.get_or_insert_with(|| (*self.description).clone());
                    let quantity = &mut description.quantities[*k];
                    if *high {
                        quantity.range.1 = number
                    } else {
                        quantity.range.0 = number
                    }
                    let (slot, range) = (quantity.slot, quantity.range);
                    let guard = description.guards.iter_mut().find(|guard| guard.slot == slot);
                    if let Some(guard) = guard {
                        guard.range = range;
                    }
                }
                Use::Range { path, unit, low, high } => {
                    // The formula of an independent parameter is its number as written, so its value comes from the
                    // slot.
                    let number = self.param(path).map_or(number, |param| instance.get(param.slot));
                    let shown = |x: f64| {
                        let shown = format!("{}", unit.from_si(x));
                        if unit.text.is_empty() { shown } else { format!("{shown} {unit}") }
                    };
                    let below = low.map(|strict| (numbers[k + 1], strict));
                    let above = high.map(|strict| (numbers[k + 1 + usize::from(low.is_some())], strict));
                    if let Some((bound, strict)) = below.filter(|(b, strict)| number < least(*b, *strict)) {
                        let word = if strict { "above" } else { "at least" };
                        return Err(format!("`{path}` must be {word} {}, not {}", shown(bound), shown(number)));
                    }
                    if let Some((bound, strict)) = above.filter(|(b, strict)| number > greatest(*b, *strict)) {
                        let word = if strict { "below" } else { "at most" };
                        return Err(format!("`{path}` must be {word} {}, not {}", shown(bound), shown(number)));
                    }
                }
                Use::Limit => {}
                Use::Require(text) if number == 0.0 => return Err(text.clone()),
                Use::Require(_) => {}
                Use::Period if !(number > 0.0 && number.is_finite()) => {
                    return Err(format!("a period must be positive, not {number} s"));
                }
                Use::Period if fixed && !is_multiple(number, experiment.solver.step) => {
                    let step = experiment.solver.step;
                    return Err(format!("a period of {number} s is no multiple of the step of {step} s"));
                }
                Use::Period => {}
            }
        }
        if experiment.duration != duration {
            // Windows that extended to the end still do; no window exceeds the run.
            for expect in &mut experiment.expects {
                let open = expect.before == duration;
                expect.before = if open { experiment.duration } else { expect.before.min(experiment.duration) };
            }
        }
        if let Some(mut corners) = corners {
            corners.retain(|t| *t > 0.0 && *t < experiment.duration);
            corners.sort_by(f64::total_cmp);
            corners.dedup();
            experiment.corners = corners;
        }
        if let Some(description) = description {
            let block = instance.block()[self.description.layout.params.range()].to_vec();
            // The adaptive program would check other ranges, so it is dropped.
            instance = Instance::new(Arc::new(description), self.code.clone(), &block);
            if let Some(slice) = &self.slice {
                instance = instance.with_slice(slice.clone());
            }
        }
        Ok(PreparedRun { instance, experiment })
    }

    /// For a run with fixed steps: the violated range in words, from the readings of the expectations after those of
    /// the experiment.
    pub fn left(&self, fitted: &Arc<Description>, readings: &[(f64, f64)]) -> Option<String> {
        let watched = &self.experiment.expects[self.expects..];
        watched.iter().zip(readings).find_map(|(expect, (least, most))| {
            let quantity = fitted.quantities.iter().find(|quantity| quantity.path == expect.text)?;
            let (low, high) = quantity.range;
            let slack = 1e-6 * if (high - low).is_finite() { high - low } else { low.abs().min(high.abs()) };
            let shown = |x: f64| format!("{} {}", quantity.unit.from_si(x), quantity.unit);
            let value = if *least < low - slack { *least } else { *most };
            let out = *least < low - slack || *most > high + slack;
            out.then(|| {
                format!("`{}` left its range {} .. {}: {}", quantity.path, shown(low), shown(high), shown(value))
            })
        })
    }
}

/// The parameter of this path, or the one for the start value of the state of this path, if a run can set it.
pub fn param_of<'d>(description: &'d Description, path: &str) -> Option<&'d Quantity> {
    let start = description.quantity(&start_values::path(path));
    let found = start.or_else(|| description.quantity(path))?;
    (found.kind == Kind::Param && description.layout.params.contains(found.slot)).then_some(found)
}

/// An error if a parameter cannot vary between runs of one program, because it determines what is compiled.
pub fn built_in(variant: &Variant, vary: &[String]) -> Option<Diagnostic> {
    let system = &variant.system;
    let varied = |expr: ExprId| vary.iter().find(|path| depends(system, expr, &|var| var.path == **path));
    let repeats = system.counts.iter().find_map(|expr| Some((*expr, varied(*expr)?)));
    if let Some((expr, path)) = repeats {
        let error = Diagnostic::error("E0905", format!("`{path}` cannot be varied in one program"))
            .label(system.span(expr), "decides how many parts there are");
        return Some(error.help(format!(
            "let the experiment sweep it, `sweep {path} = …`, which compiles each, or run it with `--set {path}=…`"
        )));
    }
    if system.delays.is_empty() {
        return None;
    }
    let steps = variant.places.iter().filter(|(place, _)| *place == PlanNumber::Step);
    let (expr, path) = steps.into_iter().find_map(|(_, expr)| Some((*expr, varied(*expr)?)))?;
    let error = Diagnostic::error("E0905", format!("`{path}` cannot be varied in one program"))
        .label(system.span(expr), "decides how much of the past `delay` keeps");
    Some(error.help(format!(
        "let the experiment sweep it, `sweep {path} = …`, which compiles each, or run it with `--set {path}=…`"
    )))
}

/// The guards in the code of a fixed step. Those with varying ranges only check that values are finite.
pub fn in_code(variant: &Variant, vary: &[String]) -> Vec<Guard> {
    let system = &variant.system;
    let varies = |bound: Option<(ExprId, bool)>| {
        bound.is_some_and(|(bound, _)| depends(system, bound, &|var| vary.contains(&var.path)))
    };
    let known = |guard: &Guard| {
        let var = system.vars.iter().find(|var| var.path == guard.path);
        let changes = var.is_some_and(|var| varies(var.range.low) || varies(var.range.high));
        let range = if changes { (f64::NEG_INFINITY, f64::INFINITY) } else { guard.range };
        Guard { range, ..guard.clone() }
    };
    variant.program.description.guards.iter().map(known).collect()
}

/// An expectation without a condition, which only reads the least and the greatest value.
fn extremes(quantity: &Quantity, duration: f64) -> Expect {
    let measure = |kind| Measure {
        text: quantity.path.clone(),
        kind,
        slot: quantity.slot,
        unit: quantity.unit.clone(),
        window: Window::default(),
    };
    Expect {
        text: quantity.path.clone(),
        measures: vec![measure(MeasureKind::Min), measure(MeasureKind::Max)],
        condition: Formula::Number(1.0),
        after: 0.0,
        before: duration,
    }
}

fn set(experiment: &mut Experiment, place: PlanNumber, number: f64) -> Result<(), String> {
    let positive = |what: &str| match number > 0.0 && number.is_finite() {
        true => Ok(number),
        false => Err(format!("{what} must be positive, not {number} s")),
    };
    match place {
        PlanNumber::Duration => experiment.duration = positive("the duration")?,
        PlanNumber::Step => experiment.solver.step = positive("the step")?,
        PlanNumber::Tolerance if number > 0.0 && number < 1.0 => experiment.solver.tol = number,
        PlanNumber::Tolerance => return Err(format!("a tolerance lies between 0 and 1: {number} does not")),
        PlanNumber::After(k) => experiment.expects[k].after = number,
        PlanNumber::Before(k) => experiment.expects[k].before = number.min(experiment.duration),
        PlanNumber::MeasureAfter(k, j) => experiment.expects[k].measures[j].window.after = Edge::At(number),
        PlanNumber::MeasureBefore(k, j) => experiment.expects[k].measures[j].window.before = Edge::At(number),
        PlanNumber::Second(k, j) => match &mut experiment.expects[k].measures[j].kind {
            MeasureKind::At(second) | MeasureKind::Settling(second) => *second = number,
            MeasureKind::Peak(_) | MeasureKind::TimeOfPeak(_) if !is_number_of_peak(number) => {
                return Err(format!("peaks have the numbers 1, 2, 3 and so on, not {number}"));
            }
            MeasureKind::Peak(second) | MeasureKind::TimeOfPeak(second) => *second = number,
            kind => unreachable!("{kind:?} has no second argument"),
        },
    }
    Ok(())
}
