//! `--cross`: repeats an experiment with another solver, and reports the differences.
//!
//! An adaptive run is compared with `expo step 0.1 ms`, a fixed step with `adaptive tol 1e-8`. Both are sampled at the
//! same instants. The advice on a sufficient fixed step has been verified by a run.

use crate::commands::reported;
use crate::compile::{self, Case, Changes, Loaded, Options};
use crate::quantity::{duration, show, significant};
use crate::results;
use crate::terminal::{Style, Terminal};
use abi::description::Kind;
use abi::plan::{Experiment, Method, Solver};
use abi::unit::Unit;
use abi::{Instance, Slot};
use runtime::engine::{self, Continue, Failure, Outcome};
use runtime::run::verdict::Verdict;
use serde_json::{Value, json};

/// Number of intervals between the compared instants.
const INTERVALS: usize = 2000;

/// Accuracy of a recommended step: root mean square of the difference, relative to the range.
const GOAL: f64 = 1e-4;

/// Most steps of a run that only verifies a step.
const MOST_STEPS: f64 = 2e6;

/// One quantity under two solvers.
pub struct Row {
    label: String,
    unit: Unit,
    boolean: bool,
    /// Largest difference and when; for a truth value the fraction of time in which the two disagree.
    largest: f64,
    time: f64,
    /// Root mean square of the difference.
    rms: f64,
    /// Maximum minus minimum of the reference, which is the adaptive run.
    range: f64,
    finals: [f64; 2],
}

/// One case under two solvers.
pub struct Crossed {
    label: String,
    solvers: [Solver; 2],
    rows: Vec<Row>,
    /// The expectations with the other solver, or why it stopped.
    partner: Result<Vec<Verdict>, Failure>,
    advice: Option<String>,
}

impl Crossed {
    /// Whether the run with the other solver reached its end and every expectation held there too.
    pub fn passed(&self) -> bool {
        self.partner.as_ref().is_ok_and(|verdicts| verdicts.iter().all(|verdict| verdict.holds))
    }

    /// The table and its conclusions.
    pub fn words(&self, terminal: &Terminal, indent: &str) -> String {
        let mut out = String::new();
        let case = if self.label.is_empty() { String::new() } else { format!("{}: ", self.label) };
        let [own, other] = self.solvers.map(|solver| results::solver(&solver));
        out += &format!("{indent}{case}{own} against {other}\n");
        let verdicts = match &self.partner {
            Ok(verdicts) => verdicts,
            Err(failure) => {
                let mark = terminal.styled(Style::Bad, "✗");
                return out + &format!("{indent}{mark} {other} does not come to the end: {failure}\n");
            }
        };
        let mut table = vec![["".into(), "largest difference".into(), "of range".into(), "rms".into(), own, other]];
        for row in &self.rows {
            let value = |value: f64| match row.boolean {
                true => (value > 0.5).to_string(),
                false => show(value, &row.unit, 7),
            };
            let part = |value: f64| if row.range > 0.0 { significant(value / row.range, 2) } else { "-".into() };
            let [own, other] = row.finals.map(value);
            table.push(match row.boolean {
                true => {
                    let differs = format!("differs for {} % of the time", significant(100.0 * row.largest, 2));
                    [row.label.clone(), differs, "-".into(), "-".into(), own, other]
                }
                false => {
                    let at = abi::format::time(row.time);
                    let largest = format!("{} at {at}", show(row.largest, &row.unit, 3));
                    [row.label.clone(), largest, part(row.largest), part(row.rms), own, other]
                }
            });
        }
        let widths: Vec<usize> =
            (0..6).map(|k| table.iter().map(|row| row[k].chars().count()).max().unwrap_or(0)).collect();
        for row in &table {
            let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
            out += &format!("{indent}  {}\n", cells.join("  ").trim_end());
        }
        let broken: Vec<Verdict> = verdicts.iter().filter(|verdict| !verdict.holds).cloned().collect();
        out += &results::verdicts(terminal, &broken, None, None, &format!("{indent}  "));
        if let Some(advice) = &self.advice {
            out += &format!("{indent}  {advice}\n");
        }
        out
    }

    /// The object for `--json`.
    pub fn json(&self) -> Value {
        let row = |row: &Row| {
            let shown = |si: f64| if row.boolean { si } else { row.unit.from_si(si) };
            json!({
                "quantity": row.label,
                "unit": if row.boolean { Value::Null } else { json!(row.unit.text) },
                "largest": results::number(shown(row.largest)),
                "time": if row.boolean { Value::Null } else { results::number(row.time) },
                "largest_of_range": results::number(row.largest / row.range),
                "rms_of_range": results::number(row.rms / row.range),
                "finals": row.finals.map(|value| results::number(shown(value))),
            })
        };
        json!({
            "solvers": self.solvers.map(|solver| results::solver(&solver)),
            "passed": self.passed(),
            "error": self.partner.as_ref().err().map(Failure::to_string),
            "quantities": self.rows.iter().map(row).collect::<Vec<_>>(),
            "advice": self.advice,
        })
    }
}

/// Repeats all cases of an experiment with the other solver; none if it cannot be compiled, which is reported.
pub fn cross(
    loaded: &mut Loaded,
    name: &str,
    options: &Options,
    cases: &[Case],
    terminal: &Terminal,
) -> Option<Vec<Crossed>> {
    let own = cases.first()?.experiment.solver;
    let changed = |method, step| Options {
        // The comparison shows what an unstable step does.
        changes: Changes { method: Some(method), step, tol: None, any_step: true, ..options.changes.clone() },
        ..options.clone()
    };
    let partner = match own.method.is_fixed() {
        false => changed(Method::Expo, Some(1e-4)),
        true => {
            let mut partner = changed(Method::Adaptive, None);
            partner.changes.tol = Some(1e-8);
            partner
        }
    };
    let partners = match compile::compile(loaded, &crate::disk::Disk, name, &partner, &mut Vec::new(), &mut |_| ()) {
        Ok(partners) => partners,
        Err(diagnostics) => {
            reported(loaded, &diagnostics, terminal);
            return None;
        }
    };
    // Steps are judged against a run whose own error is negligible.
    let sharp = match own.method.is_fixed() {
        false => {
            let mut sharp = options.clone();
            sharp.changes.tol = Some((0.01 * own.tol).max(1e-11));
            compile::compile(loaded, &crate::disk::Disk, name, &sharp, &mut Vec::new(), &mut |_| ()).ok()
        }
        true => None,
    };
    let mut all = Vec::new();
    for (k, (case, other)) in cases.iter().zip(&partners).enumerate() {
        let mut crossed = compared(case, other);
        if crossed.partner.is_ok() && !crossed.rows.is_empty() {
            let (fixed, reference) = match &sharp {
                Some(sharp) => (other, &sharp[k]),
                None => (case, other),
            };
            let error = match sharp {
                Some(_) => worst(&compared(other, reference).rows),
                None => worst(&crossed.rows),
            };
            let mut tried = |step: f64| {
                let options = changed(fixed.experiment.solver.method, Some(step));
                let cases = compile::compile(loaded, &crate::disk::Disk, name, &options, &mut Vec::new(), &mut |_| ());
                let crossed = compared(cases.ok()?.get(k)?, reference);
                crossed.partner.is_ok().then(|| worst(&crossed.rows))
            };
            let mut words = advice(&fixed.experiment, error, &mut tried);
            if sharp.is_some() {
                let [own, best] = [case, reference].map(|case| results::solver(&case.experiment.solver));
                let part = significant(100.0 * worst(&compared(case, reference).rows), 2);
                words = format!("{own} itself is within {part} % of {best}; {words}");
            }
            crossed.advice = Some(words);
        }
        all.push(crossed);
    }
    Some(all)
}

/// One case with its own solver and with the other.
fn compared(case: &Case, other: &Case) -> Crossed {
    let solvers = [case.experiment.solver, other.experiment.solver];
    let go_on = &mut |_| Continue::Continue(());
    let ended = engine::run(other.instance.clone(), &other.experiment.unrecorded(), go_on);
    let partner = ended.map(|Outcome { verdicts, .. }| verdicts);
    let crossed = |rows, partner| Crossed { label: case.label.clone(), solvers, rows, partner, advice: None };
    if partner.is_err() {
        return crossed(Vec::new(), partner);
    }
    let wanted = wanted(&case.instance, &case.experiment);
    let slots: Vec<Slot> = wanted.iter().map(|(_, slot, ..)| *slot).collect();
    let instants = instants(case.experiment.duration, solvers);
    let sampled = |case: &Case, go_on: &mut dyn FnMut(f64) -> Continue| {
        engine::sample(case.instance.clone(), &case.experiment, &instants, &slots, go_on).0
    };
    let (ours, theirs) = (sampled(case, go_on), sampled(other, go_on));
    let reference = if solvers[0].method == Method::Adaptive { &ours } else { &theirs };
    let rows = wanted.into_iter().enumerate().map(|(k, (label, _, unit, boolean))| {
        let course = |values: &'_ [f64]| values.iter().skip(k).step_by(slots.len()).copied().collect::<Vec<f64>>();
        let (ours, theirs, reference) = (course(&ours), course(&theirs), course(reference));
        let differences: Vec<f64> = ours.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).collect();
        let at = (0..differences.len()).max_by(|a, b| differences[*a].total_cmp(&differences[*b])).unwrap_or(0);
        let mean = |square: bool| {
            let sum: f64 = differences.iter().map(|d| if square { d * d } else { *d }).sum();
            sum / differences.len().max(1) as f64
        };
        let least = reference.iter().copied().fold(f64::INFINITY, f64::min);
        let most = reference.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let last = |values: &[f64]| values.last().copied().unwrap_or(f64::NAN);
        Row {
            label,
            unit,
            boolean,
            largest: if boolean { mean(false) } else { differences.get(at).copied().unwrap_or(f64::NAN) },
            time: instants.get(at).copied().unwrap_or(f64::NAN),
            rms: mean(true).sqrt(),
            range: most - least,
            finals: [last(&ours), last(&theirs)],
        }
    });
    crossed(rows.collect(), partner)
}

/// Outputs and plotted quantities; states if there are neither.
fn wanted(instance: &Instance, experiment: &Experiment) -> Vec<(String, Slot, Unit, bool)> {
    let of = |kind: Kind| {
        let quantities = instance.description().quantities.iter().filter(move |quantity| quantity.kind == kind);
        quantities.map(|quantity| (quantity.path.clone(), quantity.slot, quantity.unit.clone(), quantity.boolean))
    };
    let mut wanted: Vec<(String, Slot, Unit, bool)> = of(Kind::Output).collect();
    for series in experiment.plots.iter().flat_map(|plot| plot.series.iter().chain(&plot.against)) {
        if series.slot != Slot::TIME && !wanted.iter().any(|(_, slot, ..)| *slot == series.slot) {
            wanted.push((series.label.clone(), series.slot, series.unit.clone(), series.boolean));
        }
    }
    if wanted.is_empty() {
        wanted.extend(of(Kind::State));
    }
    wanted
}

/// Instants over the run at which fixed steps of both solvers end.
fn instants(duration: f64, solvers: [Solver; 2]) -> Vec<f64> {
    let step = solvers.iter().map(|solver| solver.step).fold(0.0, f64::max);
    let all = (0..=INTERVALS).map(|k| {
        let t = duration * k as f64 / INTERVALS as f64;
        if step > 0.0 { (t / step + 1e-9).floor() * step } else { t }
    });
    let mut instants: Vec<f64> = all.collect();
    instants.dedup();
    instants
}

/// The largest root mean square difference, relative to its range.
fn worst(rows: &[Row]) -> f64 {
    let counted = rows.iter().filter(|row| !row.boolean && row.range > 0.0);
    counted
        .map(|row| row.rms / row.range)
        .fold(0.0, |worst, part| if part > worst || part.is_nan() { part } else { worst })
}

/// A sufficient fixed step: extrapolated by the order of the method, verified, and halved until it is accurate enough.
fn advice(fixed: &Experiment, error: f64, tried: &mut dyn FnMut(f64) -> Option<f64>) -> String {
    let Solver { method, step, .. } = fixed.solver;
    // The root of the order, which is 1, 2 or 4; an order between those gets a shorter step.
    let mut part = GOAL / error.max(1e-12);
    (0..method.row().order.ilog2()).for_each(|_| part = part.sqrt());
    let name = method.name();
    let goal = format!("{} % of the range", significant(100.0 * GOAL, 1));
    let mut next = if part.is_finite() { round_down(step * part.clamp(1e-4, 20.0)) } else { round_down(0.2 * step) };
    next = next.min(round_down(0.01 * fixed.duration));
    for _ in 0..4 {
        if fixed.duration / next > MOST_STEPS {
            break;
        }
        let found = if next == step { Some(error) } else { tried(next) };
        if let Some(found) = found.filter(|found| *found <= GOAL) {
            return format!(
                "{name} step {} would do: within {goal} on average ({} % tried)",
                duration(next, 3),
                significant(100.0 * found, 2)
            );
        }
        next = round_down(0.51 * next);
    }
    format!("no step of {name} was found that stays within {goal}: prefer adaptive, or another method")
}

/// 1, 2 or 5 times a power of ten, not above the value.
fn round_down(value: f64) -> f64 {
    let text = format!("{value:.6e}");
    let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
    let first = match digits.parse::<f64>().unwrap_or(1.0) {
        d if d >= 5.0 => 5,
        d if d >= 2.0 => 2,
        _ => 1,
    };
    format!("{first}e{exponent}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::plan::PARTS;

    #[test]
    fn steps_are_rounded_to_what_people_write() {
        assert_eq!([3.7e-4, 1e-3, 0.51e-3, 9.99e-6, 2e-5].map(round_down), [2e-4, 1e-3, 5e-4, 5e-6, 2e-5]);
    }

    #[test]
    fn instants_are_ends_of_steps() {
        let solver = |step| Solver { method: Method::Expo, step, tol: 1e-6, parts: PARTS };
        let times = instants(1.0, [solver(0.0), solver(3e-3)]);
        assert!(times.is_sorted_by(|a, b| a < b) && times.len() == 334, "{}", times.len());
        assert!(times.iter().all(|t| (t / 3e-3 - (t / 3e-3).round()).abs() < 1e-9));
        assert_eq!(instants(2.0, [solver(0.0), solver(0.0)]).len(), INTERVALS + 1);
    }
}
