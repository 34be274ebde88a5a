//! Formats the results of a run as text and as JSON.

use crate::compile::Stages;
use crate::quantity::{count, duration, show, significant, uncertain};
use crate::terminal::{Style, Terminal};
use abi::plan::{Experiment, Method, Solver};
use abi::unit::Unit;
use abi::{Description, Instance};
use runtime::engine::{Estimate, Failure, Outcome};
use runtime::record::Recording;
use runtime::run::verdict::{Margin, Reading, Verdict};
use serde_json::{Value, json};

/// One run with everything that is reported about it.
pub struct Ran<'a> {
    /// The name of the file.
    pub file: &'a str,
    /// The experiment.
    pub experiment: &'a Experiment,
    /// The label of the case in a sweep; else empty.
    pub label: &'a str,
    /// The instance before the run.
    pub instance: &'a Instance,
    /// Notes of the compiler.
    pub notes: &'a [String],
    /// How it ended.
    pub result: &'a Result<Outcome, Failure>,
    /// Seconds that all cases of the experiment took together.
    pub wall: f64,
    /// Compile time by stage.
    pub stages: &'a Stages,
}

impl Ran<'_> {
    /// Whether it ran to its end and every expectation held.
    pub fn passed(&self) -> bool {
        self.result.as_ref().is_ok_and(Outcome::passed)
    }

    /// The object of `--json`. Each value is in the unit beside it; a value that is not finite is a string.
    pub fn json(&self) -> Value {
        let description = self.instance.description();
        let adaptive = self.experiment.solver.method == Method::Adaptive;
        let mut object = json!({
            "file": self.file,
            "experiment": self.experiment.name,
            "case": Some(self.label).filter(|label| !label.is_empty()),
            "passed": self.passed(),
            "model": description.name,
            "states": states(description),
            "parts": parts(description),
            "solver": {
                "method": self.experiment.solver.method.name(),
                "step": (!adaptive).then(|| number(self.experiment.solver.step)),
                "tol": adaptive.then(|| number(self.experiment.solver.tol)),
            },
            "duration": number(self.experiment.duration),
            "compile_seconds": self.stages.0.iter().map(|(stage, s)| (stage.to_string(), number(*s))).collect::<Value>(),
            "wall_seconds": number(self.wall),
        });
        match self.result {
            Ok(outcome) => {
                object["steps"] = json!(outcome.work.steps);
                object["time"] = number(outcome.time);
                let (shown, expects): (Vec<&Verdict>, Vec<&Verdict>) =
                    outcome.verdicts.iter().partition(|verdict| verdict.shown.is_some());
                object["expects"] = expects.into_iter().map(verdict_json).collect();
                object["shows"] = shown.into_iter().filter_map(|v| Some(reading_json(v.shown.as_ref()?))).collect();
                object["finals"] = finals(outcome);
                object["notes"] = self.notes.iter().chain(&outcome.notes).map(String::as_str).collect();
                object["errors"] = outcome.estimate.as_ref().map_or(Value::Null, estimate_json);
            }
            Err(failure) => {
                object["error"] = json!(failure.to_string());
                object["time"] = number(failure.time);
                object["notes"] = self.notes.iter().map(String::as_str).collect();
            }
        }
        object
    }
}

/// Number of states, sampled ones included.
pub fn states(description: &Description) -> usize {
    use abi::description::Kind;
    description.quantities.iter().filter(|quantity| matches!(quantity.kind, Kind::State | Kind::SampledState)).count()
}

/// Number of parts: distinct paths before the last dot.
pub fn parts(description: &Description) -> usize {
    use abi::description::Kind;
    let own = description.quantities.iter().filter(|quantity| quantity.kind != Kind::Observed);
    let mut paths: Vec<&str> = own.filter_map(|quantity| Some(quantity.path.rsplit_once('.')?.0)).collect();
    paths.sort_unstable();
    paths.dedup();
    paths.len()
}

/// A JSON number, or `"inf"`, `"-inf"`, `"nan"`.
pub fn number(value: f64) -> Value {
    match serde_json::Number::from_f64(value) {
        Some(number) => Value::Number(number),
        None if value.is_nan() => json!("nan"),
        None => json!(if value > 0.0 { "inf" } else { "-inf" }),
    }
}

fn shown(si: f64, unit: &Unit, boolean: bool) -> (Value, Value) {
    if boolean { (json!(si > 0.5), Value::Null) } else { (number(unit.from_si(si)), json!(unit.text)) }
}

/// Final values of all outputs, and of other plotted quantities, by path.
fn finals(outcome: &Outcome) -> Value {
    let mut finals = serde_json::Map::new();
    for end in &outcome.finals {
        let (value, unit) = shown(end.value, &end.unit, end.boolean);
        finals.insert(end.path.clone(), json!({ "value": value, "unit": unit }));
    }
    for (label, value, unit, boolean) in plotted(&outcome.recording) {
        let (value, unit) = shown(value, unit, boolean);
        finals.entry(label).or_insert(json!({ "value": value, "unit": unit }));
    }
    Value::Object(finals)
}

/// Last value of each recorded column in SI.
fn plotted(recording: &Recording) -> Vec<(&str, f64, &Unit, bool)> {
    let Some(last) = recording.rows().last() else { return Vec::new() };
    let columns = recording.columns().iter().zip(&last[1..]);
    columns.map(|(column, value)| (column.label.as_str(), *value, &column.unit, column.boolean)).collect()
}

/// How errors were estimated: the kind of error, the companions, and a solver that would decide.
fn estimate_json(estimate: &Estimate) -> Value {
    json!({
        "companions": estimate.companions.iter().map(solver).collect::<Vec<_>>(),
        "failed": estimate.failed.as_ref().map(|(finer, why)| json!({ "solver": solver(finer), "why": why })),
        "decides": estimate.decides.as_ref().map(solver),
    })
}

/// A difference of two values in a unit (without the offset of the unit).
fn width(unit: &Unit, si: f64) -> Value {
    number(unit.from_si(si) - unit.from_si(0.0))
}

fn reading_json(reading: &Reading) -> Value {
    json!({
        "text": reading.text,
        "value": number(reading.unit.from_si(reading.value)),
        "error": reading.error.map(|error| width(&reading.unit, error)),
        "unit": reading.unit.text,
        "time": reading.time.map(number),
    })
}

/// A verdict as a JSON object.
pub fn verdict_json(verdict: &Verdict) -> Value {
    let margin = verdict.margin.as_ref();
    let part = |of: fn(&Margin) -> f64| margin.map(|margin| number(margin.unit.from_si(of(margin))));
    json!({
        "text": verdict.text,
        "holds": verdict.holds,
        "decided": verdict.decided,
        "value": part(|margin| margin.value),
        "error": margin.and_then(|margin| Some(width(&margin.unit, margin.error?))),
        "limit": part(|margin| margin.limit),
        "margin": part(|margin| margin.amount),
        "unit": margin.map(|margin| margin.unit.text.as_str()),
        "time": margin.and_then(|margin| margin.time).map(number),
        "readings": verdict.readings.iter().map(reading_json).collect::<Vec<_>>(),
        "problem": verdict.problem,
    })
}

/// One line for each verdict: mark, text, value with its error, margin. `estimate`: how the errors were estimated;
/// `digits`: the most that are shown.
pub fn verdicts(
    terminal: &Terminal,
    verdicts: &[Verdict],
    estimate: Option<&Estimate>,
    digits: Option<u8>,
    indent: &str,
) -> String {
    let width = verdicts.iter().map(|verdict| verdict.text.chars().count()).max().unwrap_or(0).min(60);
    let mut out = String::new();
    for verdict in verdicts {
        let mark = match (verdict.holds, verdict.decided) {
            (true, true) => terminal.styled(Style::Good, "✓"),
            (false, true) => terminal.styled(Style::Bad, "✗"),
            (_, false) => terminal.styled(Style::Bad, "?"),
        };
        let mark = match verdict.shown {
            Some(_) => "·".into(),
            None => mark,
        };
        out += &format!("{indent}{mark} {:width$}  {}\n", verdict.text, words(verdict, estimate, digits));
    }
    out
}

/// The measures of all cases of a sweep as a table; empty for a single case, and if nothing is measured.
pub fn cases(terminal: &Terminal, labels: &[&str], results: &[Result<Outcome, Failure>], indent: &str) -> String {
    let mut titles: Vec<String> = Vec::new();
    let read = |result: &Result<Outcome, Failure>| -> Vec<(String, String)> {
        let verdicts = result.as_ref().map_or(&[][..], |outcome| &outcome.verdicts[..]);
        let mut found: Vec<(String, String)> = Vec::new();
        for verdict in verdicts {
            let window = window(&verdict.text);
            let shown = verdict.shown.as_ref().filter(|_| verdict.readings.len() != 1);
            for reading in verdict.readings.iter().chain(shown) {
                let title = if reading.text.ends_with(window) {
                    reading.text.clone()
                } else {
                    format!("{}{window}", reading.text)
                };
                if found.iter().all(|(text, _)| *text != title) {
                    found.push((title, show(reading.value, &reading.unit, 6)));
                }
            }
        }
        found
    };
    let rows: Vec<Vec<(String, String)>> = results.iter().map(read).collect();
    for (title, _) in rows.iter().flatten() {
        if !titles.contains(title) {
            titles.push(title.clone());
        }
    }
    if labels.len() < 2 || titles.is_empty() {
        return String::new();
    }
    let judged = results.iter().flatten().flat_map(|outcome| &outcome.verdicts).any(|verdict| verdict.shown.is_none());
    let mut table: Vec<Vec<String>> = vec![std::iter::once(String::new()).chain(titles.iter().cloned()).collect()];
    for ((label, row), result) in labels.iter().zip(&rows).zip(results) {
        let mut cells = vec![(*label).to_string()];
        for title in &titles {
            let cell = row.iter().find(|(text, _)| text == title);
            cells.push(cell.map_or("-".into(), |(_, value)| value.clone()));
        }
        let own = result.as_ref().map_or(&[][..], |outcome| &outcome.verdicts[..]);
        let own: Vec<&Verdict> = own.iter().filter(|verdict| verdict.shown.is_none()).collect();
        if judged {
            cells.push(match (result, own.iter().all(|verdict| verdict.passed())) {
                (Err(_), _) => terminal.styled(Style::Bad, "stopped"),
                (Ok(_), true) if own.is_empty() => "-".into(),
                (Ok(_), true) => terminal.styled(Style::Good, "✓"),
                (Ok(_), false) => terminal.styled(Style::Bad, "✗"),
            });
        }
        table.push(cells);
    }
    let widths: Vec<usize> = (0..=titles.len())
        .map(|k| table.iter().filter_map(|row| row.get(k)).map(|cell| cell.chars().count()).max().unwrap_or(0))
        .collect();
    let mut out = String::from("\n");
    for row in &table {
        let cells: Vec<String> = row
            .iter()
            .enumerate()
            .map(|(k, cell)| widths.get(k).map_or(cell.clone(), |width| format!("{cell:width$}")))
            .collect();
        out += &format!("{indent}{}\n", cells.join("  ").trim_end());
    }
    out
}

/// The window of an expectation as written, ` after 1 s`: it stands outside of brackets, before the cases.
fn window(text: &str) -> &str {
    let mut depth = 0;
    let mut begin = text.len();
    for (at, c) in text.char_indices() {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            ' ' if depth == 0 => {
                let rest = &text[at..];
                if begin == text.len() && (rest.starts_with(" after ") || rest.starts_with(" before ")) {
                    begin = at;
                }
                if rest.starts_with(" for ") {
                    return if begin < at { &text[begin..at] } else { "" };
                }
            }
            _ => {}
        }
    }
    &text[begin..]
}

/// The value with its error, the distance to the limit, and the time.
pub fn words(verdict: &Verdict, estimate: Option<&Estimate>, digits: Option<u8>) -> String {
    if let Some(problem) = &verdict.problem {
        return problem.clone();
    }
    let shown = |value: f64, error: Option<f64>, unit: &Unit| match error {
        Some(error) => uncertain(value, error, unit, digits.unwrap_or(9).into()),
        None => show(value, unit, digits.unwrap_or(6).into()),
    };
    if let Some(reading) = &verdict.shown {
        let value = shown(reading.value, reading.error, &reading.unit);
        return match verdict.readings.as_slice() {
            [only] if only.value == reading.value => value,
            _ => format!("{value} ({})", readings_in(verdict, &shown)),
        };
    }
    let readings = || readings_in(verdict, &shown);
    let open = |error: String| {
        let why = match estimate.and_then(|estimate| estimate.failed.as_ref()) {
            Some((finer, why)) => format!("the error is not known, for with {} {why}", solver(finer)),
            None => error,
        };
        let decides = estimate.and_then(|estimate| estimate.decides.as_ref());
        let remedy = decides.map_or(String::new(), |finer| format!("; {} decides", solver(finer)));
        format!("undecided: {why}{remedy}")
    };
    let Some(margin) = &verdict.margin else {
        return match verdict.decided {
            true => readings(),
            false => format!("{}, {}", readings(), open("finer runs disagree".into())),
        };
    };
    // A single measure against a limit needs no details; for arithmetic over several, the measures are shown.
    let value = match verdict.readings.as_slice() {
        [reading] if reading.value == margin.value => shown(margin.value, margin.error, &margin.unit),
        _ => format!("{} ({})", shown(margin.value, margin.error, &margin.unit), readings()),
    };
    let amount = show(margin.amount.abs(), &margin.unit, 3);
    if !verdict.decided {
        let error = show(margin.error.unwrap_or(f64::NAN), &margin.unit, 2);
        return format!("{value}, {}", open(format!("the error {error} exceeds the margin {amount}")));
    }
    let distance = if verdict.holds { format!("margin {amount}") } else { format!("misses by {amount}") };
    let time = match margin.time {
        Some(time) if !verdict.holds => format!(", at {}", abi::format::time(time)),
        Some(_) | None => String::new(),
    };
    format!("{value}, {distance}{time}")
}

/// `max(x) = 1.5(1) m, min(x) = 0 m`
fn readings_in(verdict: &Verdict, shown: &dyn Fn(f64, Option<f64>, &Unit) -> String) -> String {
    let one = |reading: &Reading| format!("{} = {}", reading.text, shown(reading.value, reading.error, &reading.unit));
    verdict.readings.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// `rk4 step 10 µs`, `adaptive tol 1e-6`.
pub fn solver(solver: &Solver) -> String {
    match solver.method {
        Method::Adaptive => format!("adaptive tol {}", significant(solver.tol, 3)),
        method => format!("{} step {}", method.name(), duration(solver.step, 3)),
    }
}

/// The size of the compiled model and the compile time, on two lines.
pub fn compiled(description: &Description, experiment: &Experiment, stages: &Stages, cases: usize) -> String {
    let counted = |n: usize, one: &str| format!("{n} {one}{}", if n == 1 { "" } else { "s" });
    let mut facts = vec![counted(states(description), "state")];
    match parts(description) {
        0 => {}
        parts => facts.push(counted(parts, "part")),
    }
    let of_cases = if cases > 1 { format!(", {cases} cases") } else { String::new() };
    let second = Unit::parse("s").expect("the second is known");
    let solver = solver(&experiment.solver);
    let slowest: Vec<String> =
        stages.0.iter().map(|(stage, seconds)| format!("{stage} {}", duration(*seconds, 3))).collect();
    format!(
        "  {}: {}{of_cases}; {solver} for {}\n  compiled in {}: {}\n",
        description.name,
        facts.join(", "),
        show(experiment.duration, &second, 6),
        duration(stages.total(), 3),
        slowest.join(", ")
    )
}

/// The number of steps of the runs of an experiment, and the companions of the error estimate with their time in s.
pub fn work(experiment: &Experiment, outcomes: &[&Outcome], wall: f64, judging: f64) -> String {
    let steps: u64 = outcomes.iter().map(|outcome| outcome.work.steps).sum();
    let simulated: f64 = outcomes.iter().map(|outcome| outcome.time).sum();
    let speed = match simulated / wall {
        speed if speed.is_finite() && speed >= 2.0 => format!(", {} times real time", count(speed as u64)),
        _ => String::new(),
    };
    let estimate = outcomes.iter().find_map(|outcome| outcome.estimate.as_ref());
    let errors = match estimate.map(|estimate| estimate.companions.as_slice()) {
        None | Some([]) => String::new(),
        Some(all) => {
            let kind = if experiment.solver.method == Method::Adaptive { "errors" } else { "discretisation" };
            format!("; {kind} by {} in {}", finer(experiment, all), duration(judging, 3))
        }
    };
    format!("  ran {} steps in {}{speed}{errors}\n", count(steps), duration(wall, 3))
}

/// The companions of a run in words: `tol 1e-7 and 1e-8`.
pub fn finer(experiment: &Experiment, companions: &[Solver]) -> String {
    let adaptive = |finer: &&Solver| finer.method == Method::Adaptive;
    let joined = |all: Vec<String>| all.join(" and ");
    let tols = joined(companions.iter().filter(adaptive).map(|finer| significant(finer.tol, 3)).collect());
    let steps = companions.iter().filter(|finer| !adaptive(finer)).map(|finer| duration(finer.step, 3));
    let steps = joined(steps.collect());
    let kind = if experiment.solver.method == Method::Adaptive { "tol" } else { "adaptive runs, tol" };
    match (tols.is_empty(), steps.is_empty()) {
        (false, true) => format!("{kind} {tols}"),
        (true, _) => format!("steps of {steps}"),
        (false, false) => format!("{kind} {tols}, and steps of {steps}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_of_an_expectation_is_found() {
        assert_eq!(window("max(x) < 1 m after 5 s before 9 s for vp = 1 m/s"), " after 5 s before 9 s");
        assert_eq!(window("max(x after 1 s) < 1 m"), "");
        assert_eq!(window("max(F) before first(x > 50 mm)"), " before first(x > 50 mm)");
        assert_eq!(window("max(F) < 1 N for fr = LuGre()"), "");
    }

    #[test]
    fn non_finite_numbers_are_json_strings() {
        let numbers = [1.5, f64::INFINITY, f64::NEG_INFINITY, f64::NAN].map(number);
        assert_eq!(Value::from(numbers.to_vec()).to_string(), r#"[1.5,"inf","-inf","nan"]"#);
    }

    #[test]
    fn a_verdict_says_value_and_margin() {
        let unit = Unit::parse("N").expect("the newton is known");
        let mut verdict = Verdict {
            text: "max(F) < 1.6 N".into(),
            holds: true,
            decided: true,
            readings: vec![Reading {
                text: "max(F)".into(),
                value: 1.5035,
                unit: unit.clone(),
                time: Some(3.0),
                resolution: 0.0,
                unseen: 0.0,
                scale: 1.5,
                error: None,
            }],
            margin: Some(Margin { amount: 0.0965, value: 1.5035, limit: 1.6, unit, time: Some(3.0), error: None }),
            problem: None,
            shown: None,
        };
        assert_eq!(words(&verdict, None, None), "1.5035 N, margin 0.0965 N");
        verdict.holds = false;
        assert_eq!(words(&verdict, None, None), "1.5035 N, misses by 0.0965 N, at 3 s");
        verdict.readings[0].value = 0.75;
        verdict.margin.as_mut().expect("it has one").time = None;
        assert_eq!(words(&verdict, None, None), "1.5035 N (max(F) = 0.75 N), misses by 0.0965 N");
        verdict.problem = Some("max(F): the window is empty".into());
        assert_eq!(words(&verdict, None, None), "max(F): the window is empty");
    }
}
