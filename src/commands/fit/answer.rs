//! The answer of a fit in words, as JSON and as a table.

use crate::compile::{Asks, Fit, FitItem, FitUnknown, HELD};
use crate::quantity::{count, duration, show, significant};
use crate::results::{self, number};
use crate::terminal::Terminal;
use abi::plan::Solver;
use abi::unit::Unit;
use grammar::diagnostic::Diagnostic;
use runtime::fit::{Answer, Ended};
use runtime::run::verdict::Verdict;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Correlations above this are shown.
const CORRELATED: f64 = 0.9;
/// Components of a combination that are named, as a fraction of the largest.
const NAMED: f64 = 0.2;

/// Step of the text to go on with, as a part of that of the search.
const FINER: f64 = 0.25;

/// A fit that has an answer.
pub struct Fitted {
    /// Its name.
    name: String,
    /// What was found.
    pub answer: Answer,
    /// Step of the runs in s.
    pub step: f64,
    /// The solver of the text to go on with: with a quarter of the step, so that its numerical error is small against
    /// its noise, unless the step is given.
    pub solver: Solver,
    /// The model with the values found, to paste.
    pub instance: String,
    /// The values found, each as `--set` takes it.
    pub set: Vec<String>,
    /// Probability of the intervals.
    pub level: f64,
    /// Time of the search in s.
    seconds: f64,
    /// Of steady points: at how many the model does not settle.
    pub unsettled: usize,
    /// The compared measures of a run by that solver, in SI.
    pub measures: Vec<f64>,
    /// What the fitted run is expected to fulfil.
    pub verdicts: Vec<Verdict>,
    /// Rank among several laws, and the rms of rows that the law has not seen, in SI.
    pub rank: Option<(usize, f64)>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

impl Fitted {
    pub fn new(name: &str, fit: &Fit, answer: Answer, step: f64, level: f64, seconds: f64) -> Fitted {
        let mut notes = fit.varying.notes.clone();
        let asks = &fit.asks;
        if asks.begins != 0.0 {
            notes.push(format!("time begins at the first row, at {} in the file", abi::format::time(asks.begins)));
        }
        let all = asks.unknowns.iter().enumerate();
        let shown = all.map(|(k, one)| (&one.path, rounded(answer.values[k], answer.sd[k], &one.unit)));
        let shown: Vec<(&String, String)> = shown.collect();
        // An instance has arguments of its own, not of its parts.
        let whole = shown.iter().filter(|(path, _)| !path.contains(['.', '[']));
        let arguments: Vec<String> = whole.map(|(path, value)| format!("{path} = {value}")).collect();
        Fitted {
            name: name.into(),
            instance: format!("{}({})", asks.model, arguments.join(", ")),
            set: shown.iter().map(|(path, value)| format!("{path}={value}")).collect(),
            solver: Solver {
                step: if asks.solver_given || fit.varying.keeps_past() { step } else { FINER * step },
                ..fit.varying.experiment.solver
            },
            answer,
            step,
            level,
            seconds,
            unsettled: 0,
            rank: None,
            measures: Vec::new(),
            verdicts: Vec::new(),
            notes,
        }
    }

    /// Whether the search ended in a minimum.
    pub fn converged(&self) -> bool {
        match self.answer.why {
            Ended::Gradient | Ended::Small => true,
            Ended::Trials | Ended::Stuck | Ended::NoStart => false,
        }
    }

    /// Warnings that the fit does not allow.
    pub fn warnings(&self, asks: &Asks) -> Vec<Diagnostic> {
        let answer = &self.answer;
        let mut all = Vec::new();
        for open in &answer.undetermined {
            let largest = open.direction.iter().map(|c| c.abs()).fold(0.0, f64::max);
            let parts: Vec<usize> =
                (0..open.direction.len()).filter(|k| open.direction[*k].abs() >= NAMED * largest).collect();
            let names: Vec<String> = parts.iter().map(|k| format!("`{}`", asks.unknowns[*k].path)).collect();
            let message = match &names[..] {
                [one] => format!("these data do not determine {one}"),
                [head @ .., last] => format!("these data do not tell {} from {last}", head.join(", ")),
                [] => continue,
            };
            let mut warning = Diagnostic::warning("W0910", message);
            for k in parts {
                let unknown = &asks.unknowns[k];
                let sd = match is_open(unknown, answer.sd[k]) {
                    true => "not determined".to_string(),
                    false => format!("± {}", show(answer.sd[k], &unknown.unit, 2)),
                };
                warning = warning.label(unknown.span, sd);
            }
            all.push(("unidentified", warning.help(
                "record a motion in which they act differently, fix one in `run`, or say what is known: `vary Fs = 1.5 N +- 0.1 N`",
            )));
        }
        for (unknown, at) in asks.unknowns.iter().zip(&answer.at_bound) {
            let Some(upper) = at else { continue };
            let bound = if *upper { unknown.range.1 } else { unknown.range.0 };
            let message = format!("`{}` ended at the bound of its range", unknown.path);
            let warning = Diagnostic::warning("W0902", message).label(unknown.span, show(bound, &unknown.unit, 4));
            all.push(("at-bound", warning.help("widen the range, unless the bound has a reason")));
        }
        for k in &answer.rough {
            let unknown = &asks.unknowns[*k];
            let message = format!("how the residuals depend on `{}` is rough", unknown.path);
            let warning =
                Diagnostic::warning("W0906", message).label(unknown.span, "differences of two sizes disagree");
            all.push(("rough", warning.help(
                "its standard deviation may be wrong: take a tighter tolerance or a shorter step, or locate events with `solver adaptive`",
            )));
        }
        if self.unsettled > 0 {
            let [points, all_points] = [self.unsettled, asks.rows.len()].map(|n| count(n as u64));
            let message = format!("the model does not settle at {points} of {all_points} steady points");
            let label = format!("it still moves after {}", duration(HELD, 2));
            let warning = Diagnostic::warning("W0911", message).label(asks.name, label);
            all.push(("unsettled", warning.help(
                "leave out the points at which the measured contact does not settle either, or fit the recording over time",
            )));
        }
        all.into_iter().filter(|(lint, _)| !asks.allowed.iter().any(|it| it == lint)).map(|(_, one)| one).collect()
    }

    /// The table of the values, the noise, the verdicts, and the instance to paste.
    pub fn words(&self, asks: &Asks, terminal: &Terminal) -> String {
        let answer = &self.answer;
        let unknowns = if asks.unknowns.len() == 1 { "unknown" } else { "unknowns" };
        let mut out = format!(
            "  {}: {} {}, {} {unknowns}, {}\n",
            asks.model,
            count(asks.rows.len() as u64),
            if asks.steady { "steady points" } else { "rows" },
            asks.unknowns.len(),
            results::solver(&Solver { step: self.step, ..self.solver })
        );
        let starts = match answer.starts {
            1 => String::new(),
            n => format!("{} starts, {} followed, {} ended here; ", count(n as u64), answer.followed, answer.agreed),
        };
        out += &format!("  {starts}{} runs in {}\n", count(answer.runs), duration(self.seconds, 3));
        if let Some((why, times)) = answer.failures.iter().max_by_key(|(_, times)| **times) {
            let failed: u64 = answer.failures.values().sum();
            let runs = if failed == 1 { "run" } else { "runs" };
            out += &format!("  {} {runs} failed, {} of them: {why}\n", count(failed), count(*times));
        }
        if !self.converged() {
            out += match answer.why {
                Ended::Trials => "  not converged: the number of trials is used up\n",
                _ => "  not converged: no shorter step could be run\n",
            };
        }
        let percent = significant(100.0 * self.level, 4);
        let rows: Vec<[String; 4]> = asks
            .unknowns
            .iter()
            .enumerate()
            .map(|(k, unknown)| {
                let [value, sd, low, high] = self.shown(k, unknown);
                match low.is_empty() {
                    true => [unknown.path.clone(), value, sd, "not determined".into()],
                    false => [unknown.path.clone(), value, format!("± {sd}"), format!("{low} .. {high}")],
                }
            })
            .collect();
        let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths = [0, 1, 2].map(width);
        for (k, row) in rows.iter().enumerate() {
            let [name, value, sd] = [0, 1, 2].map(|column| format!("{:1$}", row[column], widths[column]));
            let level = if k == 0 { format!("   {percent} %") } else { String::new() };
            out += &format!("  {name}  {value}  {sd}  {}{level}\n", row[3]);
        }
        let n = asks.unknowns.len();
        let pairs = (0..n).flat_map(|i| (0..i).map(move |j| (j, i)));
        let pairs: Vec<String> = pairs
            .filter(|(j, i)| answer.correlation[i * n + j].abs() > CORRELATED)
            .map(|(j, i)| {
                let [a, b] = [j, i].map(|k| asks.unknowns[k].path.as_str());
                format!("{a}, {b} {}", significant(answer.correlation[i * n + j], 2))
            })
            .collect();
        if !pairs.is_empty() {
            out += &format!("  correlation above {CORRELATED}: {}\n", pairs.join("; "));
        }
        for (k, item) in asks.items.iter().enumerate() {
            let noise = &answer.noise[k];
            let colour = match noise.order() {
                0 => "white".to_string(),
                order => format!("correlated over {order} row{}", if order == 1 { "" } else { "s" }),
            };
            let of_given = match item.sd {
                Some(sd) => format!(", {} of what is given", significant(answer.rms[k] / sd, 3)),
                None => String::new(),
            };
            out += &format!("  rms({})  {}, {colour}{of_given}\n", item.text, show(answer.rms[k], &item.unit, 4));
        }
        out += &results::verdicts(terminal, &self.verdicts, None, None, "  ");
        for note in &self.notes {
            out += &format!("  note: {note}\n");
        }
        let parts = asks.unknowns.iter().zip(&self.set).filter(|(unknown, _)| unknown.path.contains(['.', '[']));
        let set: String = parts.map(|(_, set)| format!(" --set '{set}'")).collect();
        out + &format!("  {}{set}\n", self.instance)
    }

    /// A value with its unit, then its deviation and the ends of its interval without; these are empty where the data
    /// say nothing.
    pub fn shown(&self, k: usize, unknown: &FitUnknown) -> [String; 4] {
        let (sd, (low, high)) = (self.answer.sd[k], self.answer.intervals[k]);
        let value = rounded(self.answer.values[k], sd, &unknown.unit);
        if is_open(unknown, sd) {
            return [value, String::new(), String::new(), String::new()];
        }
        let end = |value: f64| rounded(value, sd, &plain(&unknown.unit));
        [value, show(sd, &plain(&unknown.unit), 2), end(low), end(high)]
    }

    /// The object of `--json`. Each value is in the unit beside it.
    pub fn json(&self, file: &Path, asks: &Asks, (recording, hash): &(PathBuf, String)) -> Value {
        let answer = &self.answer;
        let n = asks.unknowns.len();
        let width = |unit: &Unit, si: f64| number(unit.from_si(si) - unit.from_si(0.0));
        let parameters: Vec<Value> = asks
            .unknowns
            .iter()
            .enumerate()
            .map(|(k, one)| {
                let (low, high) = answer.intervals[k];
                let of = |si: f64| number(one.unit.from_si(si));
                json!({
                    "path": one.path,
                    "value": of(answer.values[k]),
                    "sd": width(&one.unit, answer.sd[k]),
                    "interval": [of(low), of(high)],
                    "start": of(one.start),
                    "range": [of(one.range.0), of(one.range.1)],
                    "at_bound": answer.at_bound[k].map(|upper| if upper { "upper" } else { "lower" }),
                    "rough": answer.rough.contains(&k),
                    "unit": one.unit.text,
                })
            })
            .collect();
        let compared: Vec<Value> = asks
            .items
            .iter()
            .enumerate()
            .map(|(k, item)| {
                let noise = &answer.noise[k];
                json!({
                    "text": item.text,
                    "rms": width(&item.unit, answer.rms[k]),
                    "given_sd": item.sd.map(|sd| width(&item.unit, sd)),
                    "unit": item.unit.text,
                    "rows": answer.residuals[k].len(),
                    "autoregression": noise.coefficients.iter().map(|a| number(*a)).collect::<Vec<_>>(),
                })
            })
            .collect();
        let open: Vec<Value> = answer
            .undetermined
            .iter()
            .map(|open| {
                let direction: serde_json::Map<String, Value> =
                    asks.unknowns.iter().zip(&open.direction).map(|(one, c)| (one.path.clone(), number(*c))).collect();
                json!({ "sensitivity": number(open.sensitivity), "direction": direction })
            })
            .collect();
        let row = |k: usize| answer.correlation[k * n..(k + 1) * n].iter().map(|c| number(*c)).collect::<Vec<_>>();
        json!({
            "file": file.display().to_string(),
            "fit": self.name,
            "recording": recording.display().to_string(),
            "sha256": hash,
            "model": asks.model,
            "converged": self.converged(),
            "passed": self.verdicts.iter().all(Verdict::passed),
            "level": self.level,
            "parameters": parameters,
            "correlation": (0..n).map(row).collect::<Vec<_>>(),
            "undetermined": open,
            "compared": compared,
            "chi_square": number(answer.chi_square),
            "degrees_of_freedom": number(answer.degrees),
            "rows": asks.rows.len(),
            "steady": asks.steady,
            "begins": number(asks.begins),
            "solver": results::solver(&Solver { step: self.step, ..self.solver }),
            "rank": self.rank.map(|(rank, _)| rank),
            "held_out_rms": self.rank.map(|(_, rms)| width(&asks.items[0].unit, rms)),
            "starts": { "judged": answer.starts, "followed": answer.followed, "ended_here": answer.agreed },
            "runs": answer.runs,
            "failures": answer.failures.iter().map(|(why, n)| (why.clone(), json!(n))).collect::<serde_json::Map<_, _>>(),
            "expects": self.verdicts.iter().map(results::verdict_json).collect::<Vec<_>>(),
            "instance": self.instance,
            "set": self.set,
            "notes": self.notes,
        })
    }
}

/// Whether a standard deviation is as wide as the range: then the data say nothing.
fn is_open(unknown: &FitUnknown, sd: f64) -> bool {
    sd.is_nan() || sd >= unknown.range.1 - unknown.range.0
}

/// The same unit without a name.
fn plain(unit: &Unit) -> Unit {
    Unit { text: String::new(), ..unit.clone() }
}

/// A value in SI with as many digits as two of its standard deviation, in a unit.
fn rounded(si: f64, sd: f64, unit: &Unit) -> String {
    let exponent = |x: f64| {
        let text = format!("{:e}", x.abs());
        text.split_once('e').and_then(|(_, exponent)| exponent.parse::<i32>().ok()).unwrap_or(0)
    };
    let known = sd > 0.0 && sd.is_finite() && si != 0.0;
    let digits = match known {
        // A deviation beyond the value itself leaves no digit: three are shown.
        true if sd >= si.abs() => 3,
        true => (exponent(si) - exponent(sd) + 2).clamp(1, 12),
        false => 6,
    };
    show(si, unit, digits as usize)
}

/// The differences with the values as they are written.
pub fn as_written(asks: &Asks, residuals: &[Vec<f64>]) -> String {
    let one = |(item, rows): (&FitItem, &Vec<f64>)| {
        let rms = (rows.iter().map(|r| r * r).sum::<f64>() / rows.len().max(1) as f64).sqrt();
        format!("  rms({})  {}, {} rows\n", item.text, show(rms, &item.unit, 4), count(rows.len() as u64))
    };
    asks.items.iter().zip(residuals).map(one).collect()
}

/// The compared rows as CSV: time, or the number of the steady point, then each difference with its two sides.
/// `values`: row by row, first all differences, then all sides.
pub fn table(asks: &Asks, instants: &[f64], values: &[f64]) -> String {
    let mut titles = vec![if asks.steady { "point" } else { "t [s]" }.to_string()];
    let mut units: Vec<&Unit> = Vec::new();
    for item in &asks.items {
        titles.push(format!("{} [{}]", item.text, unit_text(&item.unit)));
        units.push(&item.unit);
    }
    for item in &asks.items {
        for (text, _) in item.sides.iter().flatten() {
            titles.push(format!("{text} [{}]", unit_text(&item.unit)));
            units.push(&item.unit);
        }
    }
    let mut out = titles.iter().map(|title| quoted(title)).collect::<Vec<_>>().join(",") + "\n";
    for (row, t) in instants.iter().enumerate() {
        out += &if asks.steady { (row + 1).to_string() } else { abi::format::plain(*t) };
        for (value, unit) in values[row * units.len()..].iter().zip(&units) {
            out += ",";
            out += &abi::format::plain(unit.from_si(*value));
        }
        out += "\n";
    }
    out
}

fn unit_text(unit: &Unit) -> &str {
    if unit.text.is_empty() { "1" } else { &unit.text }
}

fn quoted(cell: &str) -> String {
    match cell.contains([',', '"']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_two_digits_of_their_deviation() {
        let newton = Unit::parse("N").expect("it is known");
        assert_eq!(rounded(1.234567, 0.0123, &newton), "1.235 N");
        assert_eq!(rounded(100_040.3, 61.0, &newton), "100040 N");
        assert_eq!(rounded(0.0012345, 0.5, &newton), "0.00123 N");
        assert_eq!(rounded(1.5, f64::INFINITY, &newton), "1.5 N");
    }
}
