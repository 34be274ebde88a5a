//! The answer of a fit in words, as JSON and as a table.

use super::after::{Judged, NAMED, Piece, Profile, Remarks, scatter};
use super::search::{Coarse, Part, Runs};
use crate::compile::{Asks, ElementaryFunction, FitItem, FitUnknown, HELD};
use crate::quantity::{count, duration, show, significant};
use crate::results::{self, number};
use crate::terminal::Terminal;
use abi::plan::Solver;
use abi::unit::Unit;
use grammar::diagnostic::Diagnostic;
use runtime::fit::loss::deviation;
use runtime::fit::ranking::Paired;
use runtime::fit::statistics::{Dependence, gaps};
use runtime::fit::{Answer, Combination, Ended, Noise};
use runtime::run::verdict::Verdict;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Correlations above this are shown.
const CORRELATED: f64 = 0.9;

/// Step of the text to go on with, as a part of that of the search.
const FINER: f64 = 0.25;

/// The place of a law among several.
#[derive(Clone, Debug)]
pub struct Rank {
    /// From 1; laws that do not differ share one.
    pub rank: usize,
    /// The rms of rows that it has not seen, of the first compared quantity, in SI.
    pub held_out: f64,
    /// The next law, and how much better this one is, if both could be fitted.
    pub than_next: Option<(String, Paired)>,
}

/// A fit that has an answer.
pub struct Fitted {
    /// Its name.
    name: String,
    /// What was found.
    pub answer: Answer,
    /// Its runs, in the order of the recordings.
    pub runs: Vec<Run>,
    /// Values in pieces of the recordings.
    pub pieces: Vec<Piece>,
    /// The profile of each unknown, where it was computed.
    pub profiles: Vec<Option<Profile>>,
    /// Recordings that were judged and not fitted.
    pub judged: Vec<Judged>,
    /// Each model with the values found, to paste.
    pub instances: Vec<String>,
    /// The values found, each as `--set` takes it.
    pub set: Vec<String>,
    /// Probability of the intervals.
    pub level: f64,
    /// Time of the search in s.
    seconds: f64,
    /// Its place among several laws.
    pub rank: Option<Rank>,
    /// Steps that are too long.
    pub coarse: Option<Coarse>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// A run against one recording, with the values found.
pub struct Run {
    /// Step of the search in s, or its tolerance.
    pub step: f64,
    /// The solver of the text to go on with: with a quarter of the step, so that its numerical error is small against
    /// its noise, unless the step is given.
    pub solver: Solver,
    /// Of steady points: at how many the model does not settle.
    pub unsettled: usize,
    /// The compared measures of a run by that solver, in SI.
    pub measures: Vec<f64>,
    /// What stands out in the residuals of each compared quantity.
    pub remarks: Vec<Remarks>,
    /// What the fitted run is expected to fulfil.
    pub verdicts: Vec<Verdict>,
}

impl Fitted {
    pub fn new(name: &str, runs: &Runs, answer: Answer, steps: &[f64], level: f64, seconds: f64) -> Fitted {
        let mut notes: Vec<String> = Vec::new();
        for part in &runs.parts {
            notes.extend(part.varying.notes.iter().filter(|note| !notes.contains(note)).cloned().collect::<Vec<_>>());
            if part.asks.begins != 0.0 {
                let of = runs.before(part);
                let begins = abi::format::time(part.asks.begins);
                notes.push(format!("{of}time begins at the first row, at {begins} in the file"));
            }
        }
        assert_eq!(steps.len(), runs.parts.len(), "a step for each run");
        let several = runs.parts.len() > 1;
        let shown = |k: usize| rounded(answer.values[k], answer.sd[k], &runs.unknowns[k].unit);
        // An instance has arguments of its own, not of its parts, and of all recordings alike.
        let shared = |k: &usize| !runs.unknowns[*k].own && (!several || runs.unknowns[*k].of.is_none());
        let all: Vec<usize> = (0..runs.unknowns.len()).filter(shared).collect();
        let mut instances: Vec<String> = Vec::new();
        for part in &runs.parts {
            let is_whole = |k: &&usize| part.asks.slots[**k].is_some() && !runs.unknowns[**k].path.contains(['.', '[']);
            let arguments = all.iter().filter(is_whole).map(|k| format!("{} = {}", runs.unknowns[*k].path, shown(*k)));
            let instance = format!("{}({})", part.asks.model, arguments.collect::<Vec<_>>().join(", "));
            if !instances.contains(&instance) {
                instances.push(instance);
            }
        }
        Fitted {
            name: name.into(),
            instances,
            set: all.iter().map(|k| format!("{}={}", runs.unknowns[*k].path, shown(*k))).collect(),
            answer,
            runs: Vec::new(),
            pieces: Vec::new(),
            profiles: Vec::new(),
            judged: Vec::new(),
            level,
            seconds,
            rank: None,
            coarse: None,
            notes,
        }
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// The step of the text to go on with, of a run whose search had steps of this length.
    pub fn step_on(part: &Part, step: f64) -> f64 {
        let given = part.asks.solver_given || part.is_adaptive() || part.varying.keeps_past();
        if given { step } else { FINER * step }
    }

    /// The solver of the search, where all runs have the same.
    fn solver_of_all(&self, runs: &Runs) -> Option<String> {
        let each = runs.parts.iter().zip(&self.runs);
        let mut all = each.map(|(part, run)| results::solver(&part.solver(run.step)));
        let first = all.next()?;
        all.all(|other| other == first).then_some(first)
    }

    /// Whether the search ended in a minimum.
    pub fn converged(&self) -> bool {
        match self.answer.why {
            Ended::Gradient | Ended::Small => true,
            Ended::Trials | Ended::Stuck | Ended::NoStart => false,
        }
    }

    /// Warnings that the fit does not allow.
    pub fn warnings(&self, runs: &Runs) -> Vec<Diagnostic> {
        let answer = &self.answer;
        let mut all = Vec::new();
        for open in &answer.undetermined {
            let largest = open.direction.iter().map(|c| c.abs()).fold(0.0, f64::max);
            let parts: Vec<usize> =
                (0..open.direction.len()).filter(|k| open.direction[*k].abs() >= NAMED * largest).collect();
            let names: Vec<String> = parts.iter().map(|k| format!("`{}`", runs.unknowns[*k].label)).collect();
            let message = match &names[..] {
                [one] => format!("these data do not determine {one}"),
                [head @ .., last] => format!("these data do not tell {} from {last}", head.join(", ")),
                [] => continue,
            };
            let moved: Vec<String> = parts.iter().filter_map(|k| change(open, *k, &runs.unknowns[*k])).collect();
            let message = match moved.is_empty() {
                true => message,
                false => format!("{message}: {} moves what is compared by less than its noise", moved.join(" with ")),
            };
            let mut warning = Diagnostic::warning("W0910", message);
            for k in parts {
                let unknown = &runs.unknowns[k];
                let sd = match is_unknown(unknown, answer.sd[k]) {
                    true => "not determined".to_string(),
                    false => format!("± {}", show(answer.sd[k], &unknown.unit, 2)),
                };
                warning = warning.label(unknown.span, sd);
            }
            all.push(("unidentified", warning.help(
                "record a motion in which they act differently, fix one in `run`, or say what is known: `vary Fs = 1.5 N +- 0.1 N`",
            )));
        }
        for (unknown, at) in runs.unknowns.iter().zip(&answer.at_bound) {
            let Some(upper) = at else { continue };
            let bound = if *upper { unknown.range.1 } else { unknown.range.0 };
            let below = unknown.above.filter(|_| !upper).map(|below| &runs.unknowns[below].label);
            if let Some(below) = below {
                let message = format!("`{}` ended at the least that it may be, `{below}`", unknown.label);
                let warning = Diagnostic::warning("W0902", message).label(unknown.span, format!("not below `{below}`"));
                all.push((
                    "at-bound",
                    warning.help("where both are the same number, fit a law without their difference"),
                ));
                continue;
            }
            let message = format!("`{}` ended at the bound of its range", unknown.label);
            let warning = Diagnostic::warning("W0902", message).label(unknown.span, show(bound, &unknown.unit, 4));
            all.push(("at-bound", warning.help("widen the range, unless the bound has a reason")));
        }
        for k in &answer.rough {
            let unknown = &runs.unknowns[*k];
            let message = format!("how the residuals depend on `{}` is rough", unknown.label);
            let warning =
                Diagnostic::warning("W0906", message).label(unknown.span, "differences of two sizes disagree");
            all.push(("rough", warning.help(
                "its standard deviation may be wrong: take a tighter tolerance or a shorter step, or locate events with `solver adaptive`",
            )));
        }
        if let Some(Coarse { part, by }) = &self.coarse {
            let of = if runs.parts.len() > 1 { format!(" of {}", runs.parts[*part].asks.label) } else { String::new() };
            let solver = results::solver(&runs.parts[*part].solver(self.runs[*part].step));
            let (message, span, label) = match by {
                Ok((k, by)) => {
                    let unknown = &runs.unknowns[*k];
                    let by = format!("{} of its standard deviation", significant(*by, 2));
                    (
                        format!("the steps{of} are too long for the interval of `{}`", unknown.label),
                        unknown.span,
                        format!("shorter ones move it by {by}"),
                    )
                }
                Err(why) => {
                    (format!("the steps{of} may be too long"), runs.name, format!("shorter ones cannot be run: {why}"))
                }
            };
            let warning = Diagnostic::warning("W0912", message).label(span, label);
            all.push(("coarse", warning.help(format!("they are those of `{solver}`: give shorter ones, by `--step` or `--tol`, or in the text by `solver`"))));
        }
        for (k, unknown) in runs.unknowns.iter().enumerate() {
            let Some(found) = scatter(&self.pieces, k).filter(|found| found.drifts) else { continue };
            let message =
                format!("`{}` drifts: the pieces of the recordings differ by more than chance", unknown.label);
            let label = format!("{} in {} pieces", ends_of(found.ends, unknown), found.pieces);
            let warning = Diagnostic::warning("W0904", message).label(unknown.span, label);
            all.push(("drift", warning.help(
                "its interval is widened by the scatter; fit a shorter recording, or let what drifts differ: `vary … each` over several recordings",
            )));
        }
        for (part, run) in runs.parts.iter().zip(&self.runs) {
            let of = if runs.parts.len() > 1 { format!(" of {}", part.asks.label) } else { String::new() };
            let gaps = if part.asks.steady { 0 } else { gaps(&part.asks.rows).len() };
            if gaps > 0 {
                let what = if gaps == 1 { "a gap".to_string() } else { format!("{} gaps", count(gaps as u64)) };
                let warning = Diagnostic::warning("W0905", format!("the recording{of} has {what}"))
                    .label(runs.name, "an interval between rows is longer than usual");
                all.push((
                    "gap",
                    warning.help(
                        "inputs go straight across it; fit the parts before and after it as recordings of their own",
                    ),
                ));
            }
            for (item, remarks) in part.asks.items.iter().zip(&run.remarks) {
                if let Some((name, unit, found)) = &remarks.depends {
                    let message = format!("what the model leaves of `{}`{of} depends on `{name}`", item.shown());
                    let share = significant(100.0 * found.share, 2);
                    let label = format!("{share} % of its variance, most {}", class(found, unit));
                    let warning = Diagnostic::warning("W0903", message).label(runs.name, label);
                    let help = match name.starts_with("slope(") {
                        true => {
                            "the sensor may be late: in a model around the law, `output F [N] = delay(law.F, T)` and `vary T`; or a mass is accelerated"
                        }
                        false => {
                            "the law lacks something that the recording shows; compare others, or look at the residuals with `--report`"
                        }
                    };
                    all.push(("model-error", warning.help(help)));
                }
                if let Some((name, unit, found)) = &remarks.lies {
                    let message = format!(
                        "most of the error of `{}`{of} lies where `{name}` is {}",
                        item.text,
                        class(found, unit)
                    );
                    let label = format!("{} % of its square", significant(100.0 * found.share, 2));
                    let warning = Diagnostic::warning("W0903", message).label(runs.name, label);
                    all.push(("model-error", warning.help(
                        "the law says something else there; at rest a contact bears any force up to its stiction: compare a law with states, or leave these rows out",
                    )));
                }
                if remarks.outliers.is_some() {
                    let message = format!("few rows hold most of the error of `{}`{of}", item.shown());
                    let alone = Remarks { outliers: remarks.outliers.clone(), ..Remarks::default() };
                    let warning = Diagnostic::warning("W0907", message).label(runs.name, said(&alone, part));
                    all.push((
                        "outliers",
                        warning.help(
                            "look at them; leave them out with `after` and `before`, remove the rows, or let them count less with `--robust`",
                        ),
                    ));
                }
                if remarks.begins_badly {
                    let message = format!("the beginning of `{}`{of} fits far worse than the rest", item.shown());
                    let warning =
                        Diagnostic::warning("W0908", message).label(runs.name, "a state may have begun elsewhere");
                    all.push((
                        "start",
                        warning.help(
                            "vary an initial value, as in `vary initial(z) in -10 um .. 10 um`, or compare `after` it",
                        ),
                    ));
                }
            }
        }
        if answer.followed > 2 && answer.agreed < 2 {
            let message = "only one search ended here, others in poorer minima";
            let label = format!("{} searches followed", answer.followed);
            let warning = Diagnostic::warning("W0909", message).label(runs.name, label);
            all.push((
                "lone",
                warning.help("a better minimum may exist: try `--starts 500`, another `--seed`, or a start nearby"),
            ));
        }
        for (part, run) in runs.parts.iter().zip(&self.runs).filter(|(_, run)| run.unsettled > 0) {
            let [points, all_points] = [run.unsettled, part.asks.rows.len()].map(|n| count(n as u64));
            let message = format!("the model does not settle at {points} of {all_points} steady points");
            let label = format!("it still moves after {}", duration(HELD, 2));
            let warning = Diagnostic::warning("W0911", message).label(runs.name, label);
            all.push(("unsettled", warning.help(
                "leave out the points at which the measured contact does not settle either, or fit the recording over time",
            )));
        }
        all.into_iter().filter(|(lint, _)| !runs.allowed.iter().any(|it| it == lint)).map(|(_, one)| one).collect()
    }

    /// The table of the values, the noise, the verdicts, and the instances to paste.
    pub fn words(&self, runs: &Runs, terminal: &Terminal) -> String {
        let answer = &self.answer;
        let several = runs.parts.len() > 1;
        let (n, steady) = (runs.unknowns.len(), runs.parts.iter().all(|part| part.asks.steady));
        let mut heading =
            vec![format!("{} {}", count(runs.rows() as u64), if steady { "steady points" } else { "rows" })];
        if several {
            heading.insert(0, format!("{} recordings", runs.parts.len()));
        }
        heading.push(format!("{n} {}", if n == 1 { "unknown" } else { "unknowns" }));
        heading.extend(self.solver_of_all(runs));
        let law = if runs.label.is_empty() { String::new() } else { format!(", {}", runs.label) };
        let mut out = format!("  {}{law}: {}\n", models(runs), heading.join(", "));
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
        let rows: Vec<[String; 4]> = runs
            .unknowns
            .iter()
            .enumerate()
            .map(|(k, unknown)| {
                let [value, sd, low, high] = self.shown(k, unknown);
                match low.is_empty() {
                    true => [unknown.label.clone(), value, sd, "not determined".into()],
                    false => [unknown.label.clone(), value, format!("± {sd}"), format!("{low} .. {high}")],
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
        let pairs = (0..n).flat_map(|i| (0..i).map(move |j| (j, i)));
        let pairs: Vec<String> = pairs
            .filter(|(j, i)| answer.correlation[i * n + j].abs() > CORRELATED)
            .map(|(j, i)| {
                let [a, b] = [j, i].map(|k| runs.unknowns[k].label.as_str());
                format!("{a}, {b} {}", significant(answer.correlation[i * n + j], 2))
            })
            .collect();
        if !pairs.is_empty() {
            out += &format!("  correlation above {CORRELATED}: {}\n", pairs.join("; "));
        }
        for (k, unknown) in runs.unknowns.iter().enumerate() {
            if let Some(words) = self.profile_words(k, unknown) {
                out += &format!("  profile of {}: {words}\n", unknown.label);
            }
        }
        for (k, unknown) in runs.unknowns.iter().enumerate() {
            if scatter(&self.pieces, k).is_some_and(|found| found.drifts)
                && let Some(words) = self.piece_words(k, unknown)
            {
                out += &format!("  {} drifts: {words}\n", unknown.label);
            }
        }
        for ((part, run), items) in runs.parts.iter().zip(&self.runs).zip(runs.items()) {
            let indent = if several { "    " } else { "  " };
            if several {
                let solver = match self.solver_of_all(runs) {
                    Some(_) => String::new(),
                    None => format!(", {}", results::solver(&part.solver(run.step))),
                };
                let rows = count(part.asks.rows.len() as u64);
                let what = if part.asks.steady { "steady points" } else { "rows" };
                out += &format!("  {}: {rows} {what}{solver}\n", part.asks.label);
            }
            for (item, k) in part.asks.items.iter().zip(items) {
                let noise = &answer.noise[k];
                let colour = match noise.order() {
                    0 => "white".to_string(),
                    order => format!("correlated over {order} row{}", if order == 1 { "" } else { "s" }),
                };
                let of_given = match item.sd {
                    Some(sd) => format!(", {} of what is given", significant(answer.rms[k] / sd, 3)),
                    None => String::new(),
                };
                let rms = show(answer.rms[k], &item.unit, 4);
                let no_noise = if answer.misfits && noise.order() > 0 { ", no noise" } else { "" };
                let robust = robust_deviation(answer, k)
                    .map_or(String::new(), |sd| format!(", robust {}", show(sd, &item.unit, 4)));
                out += &format!("{indent}rms({})  {rms}{robust}, {colour}{no_noise}{of_given}\n", item.shown());
            }
            out += &results::verdicts(terminal, &run.verdicts, None, None, indent);
        }
        for (one, judged) in self.judged.iter().zip(&runs.judged) {
            let items = judged.parts[0].asks.items.iter().zip(&one.residuals);
            let each = items.map(|(item, rows)| format!("rms({})  {}", item.shown(), show(rms(rows), &item.unit, 4)));
            let own = one.own.iter().map(|(label, value, unit)| format!("{label} {}", show(*value, unit, 4)));
            let all: Vec<String> = each.chain(own).collect();
            out += &format!("  validate {}: {}\n", one.label, all.join(", "));
        }
        for note in &self.notes {
            out += &format!("  note: {note}\n");
        }
        let parts = self.set.iter().filter(|set| set.split('=').next().is_some_and(|path| path.contains(['.', '['])));
        let set: String = parts.map(|set| format!(" --set '{set}'")).collect();
        // Without arguments, it has unknowns of the fit itself alone.
        for instance in self.instances.iter().filter(|instance| !instance.ends_with("()") || !set.is_empty()) {
            out += &format!("  {instance}{set}\n");
        }
        out
    }

    /// The standard deviation and the interval of an unknown, widened where it drifts.
    pub fn spread(&self, k: usize, unknown: &FitUnknown) -> (f64, (f64, f64)) {
        let (sd, (low, high)) = (self.answer.sd[k], self.answer.intervals[k]);
        let Some(found) = scatter(&self.pieces, k).filter(|found| found.drifts) else { return (sd, (low, high)) };
        let wide = (found.sd / (found.pieces as f64).sqrt()).max(sd);
        let value = self.answer.values[k];
        let (from, to) = (value - (value - low) * wide / sd, value + (high - value) * wide / sd);
        // A positive parameter keeps a positive bound.
        let from = if unknown.range.0 >= 0.0 { from.max(low * sd / wide) } else { from };
        (wide, (from, to))
    }

    /// The values of an unknown in the pieces, in words.
    pub fn piece_words(&self, k: usize, unknown: &FitUnknown) -> Option<String> {
        let found = scatter(&self.pieces, k)?;
        Some(format!("{} over {} pieces", ends_of(found.ends, unknown), found.pieces))
    }

    /// The profile of an unknown, in words.
    pub fn profile_words(&self, k: usize, unknown: &FitUnknown) -> Option<String> {
        let profile = self.profiles.get(k)?.as_ref()?;
        let value = |si: f64| show(si, &unknown.unit, 3);
        Some(match profile.ends {
            (Some(_), Some(_)) => ends_of((profile.ends.0?, profile.ends.1?), unknown),
            (None, Some(high)) => format!("below {}, not bounded from below", value(high)),
            (Some(low), None) => format!("above {}, not bounded from above", value(low)),
            (None, None) => "anywhere in its range".into(),
        })
    }

    /// A value with its unit, then its deviation and the ends of its interval without; these are empty where the data
    /// say nothing.
    pub fn shown(&self, k: usize, unknown: &FitUnknown) -> [String; 4] {
        let (sd, (low, high)) = self.spread(k, unknown);
        let value = rounded(self.answer.values[k], sd, &unknown.unit);
        if is_unknown(unknown, sd) {
            return [value, String::new(), String::new(), String::new()];
        }
        let end = |value: f64| rounded(value, sd, &plain(&unknown.unit));
        [value, show(sd, &plain(&unknown.unit), 2), end(low), end(high)]
    }

    /// The object of `--json`. Each value is in the unit beside it.
    pub fn json(&self, file: &Path, runs: &Runs, recordings: &[(PathBuf, String)]) -> Value {
        let answer = &self.answer;
        let n = runs.unknowns.len();
        let width = |unit: &Unit, si: f64| number(unit.from_si(si) - unit.from_si(0.0));
        let parameters: Vec<Value> = runs
            .unknowns
            .iter()
            .enumerate()
            .map(|(k, one)| {
                let (sd, (low, high)) = self.spread(k, one);
                let of = |si: f64| number(one.unit.from_si(si));
                json!({
                    "path": one.path,
                    "initial": one.initial,
                    "recording": one.of.map(|of| runs.parts[of].asks.label.clone()),
                    "value": of(answer.values[k]),
                    "sd": width(&one.unit, sd),
                    "interval": [of(low), of(high)],
                    "start": of(one.start),
                    "range": [of(one.range.0), of(one.range.1)],
                    "at_bound": answer.at_bound[k].map(|upper| if upper { "upper" } else { "lower" }),
                    "rough": answer.rough.contains(&k),
                    "step_shift": (!answer.shifts.is_empty()).then(|| number(answer.shifts.iter().flatten().map(|shift| shift[k]).sum())),
                    "pieces": self.pieces.iter().map(|piece| piece[k].map(|(value, sd)| json!({
                        "value": of(value),
                        "sd": width(&one.unit, sd),
                    }))).collect::<Vec<_>>(),
                    "drifts": scatter(&self.pieces, k).is_some_and(|found| found.drifts),
                    "profile": self.profiles.get(k).and_then(Option::as_ref).map(|profile| json!({
                        "points": profile.points.iter().map(|(x, rise)| json!([of(*x), number(*rise)])).collect::<Vec<_>>(),
                        "interval": [profile.ends.0.map(of), profile.ends.1.map(of)],
                    })),
                    "unit": one.unit.text,
                })
            })
            .collect();
        let compared = |(item, k): (&FitItem, usize)| {
            json!({
                "text": item.shown(),
                "rms": width(&item.unit, answer.rms[k]),
                "robust_sd": robust_deviation(answer, k).map(|sd| width(&item.unit, sd)),
                "given_sd": item.sd.map(|sd| width(&item.unit, sd)),
                "unit": item.unit.text,
                "rows": answer.residuals[k].len(),
                "autoregression": answer.noise[k].coefficients.iter().map(|a| number(*a)).collect::<Vec<_>>(),
            })
        };
        let each = runs.parts.iter().zip(&self.runs).zip(recordings).zip(runs.items());
        let recordings: Vec<Value> = each
            .map(|(((part, run), (recording, hash)), items)| {
                json!({
                    "label": part.asks.label,
                    "file": recording.display().to_string(),
                    "sha256": hash,
                    "model": part.asks.model,
                    "rows": part.asks.rows.len(),
                    "steady": part.asks.steady,
                    "begins": number(part.asks.begins),
                    "solver": results::solver(&part.solver(run.step)),
                    "compared": part.asks.items.iter().zip(items).map(compared).collect::<Vec<_>>(),
                    "expects": run.verdicts.iter().map(results::verdict_json).collect::<Vec<_>>(),
                })
            })
            .collect();
        let open: Vec<Value> = answer
            .undetermined
            .iter()
            .map(|open| {
                let each = runs.unknowns.iter().zip(&open.direction);
                let direction: serde_json::Map<String, Value> =
                    each.map(|(one, c)| (one.label.clone(), number(*c))).collect();
                json!({ "sensitivity": number(open.sensitivity), "direction": direction })
            })
            .collect();
        let row = |k: usize| answer.correlation[k * n..(k + 1) * n].iter().map(|c| number(*c)).collect::<Vec<_>>();
        json!({
            "file": file.display().to_string(),
            "fit": self.name,
            "model": models(runs),
            "alternative": (!runs.label.is_empty()).then_some(&runs.label),
            "recordings": recordings,
            "validated": self.judged.iter().zip(&runs.judged).map(|(one, judged)| json!({
                "label": one.label,
                "own": one.own.iter().map(|(label, value, unit)| json!({
                    "label": label,
                    "value": number(unit.from_si(*value)),
                    "unit": unit.text,
                })).collect::<Vec<_>>(),
                "compared": judged.parts[0].asks.items.iter().zip(&one.residuals).map(|(item, rows)| json!({
                    "text": item.shown(),
                    "rms": width(&item.unit, rms(rows)),
                    "unit": item.unit.text,
                    "rows": rows.len(),
                })).collect::<Vec<_>>(),
            })).collect::<Vec<_>>(),
            "converged": self.converged(),
            "passed": self.runs.iter().flat_map(|run| &run.verdicts).all(Verdict::passed),
            "level": self.level,
            "parameters": parameters,
            "correlation": (0..n).map(row).collect::<Vec<_>>(),
            "undetermined": open,
            "no_noise": answer.misfits,
            "robust": answer.noise.iter().any(Noise::is_robust),
            "chi_square": number(answer.chi_square),
            "degrees_of_freedom": number(answer.degrees),
            "rank": self.rank.as_ref().map(|rank| rank.rank),
            "held_out_rms": self.rank.as_ref().map(|rank| width(&runs.parts[0].asks.items[0].unit, rank.held_out)),
            "than_next": self.rank.as_ref().and_then(|rank| rank.than_next.as_ref()).map(|(law, paired)| json!({
                "law": law,
                "better": paired.better.0,
                "pieces": paired.better.1,
                "gain": number(paired.gain.0),
                "gain_sd": number(paired.gain.1),
            })),
            "starts": { "judged": answer.starts, "followed": answer.followed, "ended_here": answer.agreed },
            "runs": answer.runs,
            "failures": answer.failures.iter().map(|(why, n)| (why.clone(), json!(n))).collect::<serde_json::Map<_, _>>(),
            "instances": self.instances,
            "set": self.set,
            "notes": self.notes,
        })
    }
}

/// The ends of an interval of an unknown, with one unit.
fn ends_of((low, high): (f64, f64), unknown: &FitUnknown) -> String {
    format!("{} .. {}", show(low, &plain(&unknown.unit), 4), show(high, &unknown.unit, 4))
}

/// How an unknown changes along a combination that moves the outputs by one standard deviation of their noise, at most
/// over a tenth of its range: `vs × 2`, `Fs − 1 %`. None if it hardly changes.
fn change(open: &Combination, k: usize, unknown: &FitUnknown) -> Option<String> {
    let (low, high) = unknown.range;
    let logarithmic = low * high > 0.0 && (high / low).abs().max((low / high).abs()) >= 10.0;
    let step = open.direction[k] * (1.0 / open.sensitivity).min(1.0);
    let name = &unknown.label;
    let (sign, size) = (if step < 0.0 { "−" } else { "+" }, step.abs());
    if size < 1e-4 {
        return None;
    }
    Some(match logarithmic {
        true if size < 0.3 => format!("{name} {sign} {} %", significant(100.0 * size, 2)),
        true if step > 0.0 => format!("{name} × {}", significant(ElementaryFunction::exp().at(size), 2)),
        true => format!("{name} / {}", significant(ElementaryFunction::exp().at(size), 2)),
        false => format!("{name} {sign} {}", show(size * (high - low), &unknown.unit, 2)),
    })
}

/// The standard deviation of the residuals of a compared quantity by their median, where large ones count by their size.
fn robust_deviation(answer: &Answer, k: usize) -> Option<f64> {
    answer.noise[k].is_robust().then(|| deviation(&answer.residuals[k]))
}

fn rms(rows: &[f64]) -> f64 {
    (rows.iter().map(|r| r * r).sum::<f64>() / rows.len().max(1) as f64).sqrt()
}

/// The models that are run, each once.
pub fn models(runs: &Runs) -> String {
    let mut models: Vec<&str> = runs.parts.iter().map(|part| &part.asks.model[..]).collect();
    models.dedup();
    models.join(", ")
}

/// Whether a standard deviation is as wide as the range: then the data say nothing.
fn is_unknown(unknown: &FitUnknown, sd: f64) -> bool {
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
pub fn as_written(runs: &Runs, residuals: &[Vec<f64>]) -> String {
    let mut out = String::new();
    for (part, items) in runs.parts.iter().zip(runs.items()) {
        let of = runs.before(part);
        for (item, rows) in part.asks.items.iter().zip(&residuals[items]) {
            let rms = (rows.iter().map(|r| r * r).sum::<f64>() / rows.len().max(1) as f64).sqrt();
            let rows = count(rows.len() as u64);
            out += &format!("  {of}rms({})  {}, {rows} rows\n", item.shown(), show(rms, &item.unit, 4));
        }
    }
    out
}

/// The columns of the compared rows beside time: first all differences, then both sides of each.
fn shown(asks: &Asks) -> Vec<(&str, &Unit)> {
    let differences = asks.items.iter().map(|item| (&item.text[..], &item.unit));
    let sides = asks.items.iter().flat_map(|item| item.sides.iter().flatten().map(|(text, _)| (&text[..], &item.unit)));
    differences.chain(sides).collect()
}

/// The heading of the compared rows as CSV.
pub fn heading(asks: &Asks) -> String {
    let time = if asks.steady { "point" } else { "t [s]" }.to_string();
    let titles = shown(asks).into_iter().map(|(text, unit)| format!("{text} [{}]", unit_text(unit)));
    std::iter::once(time).chain(titles).map(|title| quoted(&title)).collect::<Vec<_>>().join(",") + "\n"
}

/// Some of these rows: time, or the number of the steady point, then the columns. `values`: row by row; `first`: the
/// number of the first one.
pub fn lines(asks: &Asks, (first, instants): (usize, &[f64]), values: &[f64]) -> String {
    let units: Vec<&Unit> = shown(asks).into_iter().map(|(_, unit)| unit).collect();
    let mut out = String::new();
    for (row, t) in instants.iter().enumerate() {
        out += &if asks.steady { (asks.points[first + row] + 1).to_string() } else { abi::format::plain(*t) };
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

/// Remarks in a few words.
pub fn said(remarks: &Remarks, part: &Part) -> String {
    let mut all = Vec::new();
    if let Some((name, unit, found)) = &remarks.depends {
        all.push(format!(
            "depends on {name}: {} % of its variance, most {}",
            significant(100.0 * found.share, 2),
            class(found, unit)
        ));
    }
    if let Some((name, unit, found)) = &remarks.lies {
        let share = significant(100.0 * found.share, 2);
        all.push(format!("{share} % of its square where {name} is {}", class(found, unit)));
    }
    if let Some(found) = &remarks.outliers {
        if let [first, .., last] | [first @ last] = &found.rows[..] {
            let rows = count(found.rows.len() as u64);
            let what = if found.rows.len() == 1 { "row" } else { "rows" };
            all.push(format!("{rows} {what} beyond six standard deviations{}", at(part, *first, *last)));
        }
        if let Some(rows) = &found.tenth {
            all.push(format!(
                "more than half of the squared error lies in a tenth of the rows{}",
                at(part, rows.start, rows.end - 1)
            ));
        }
    }
    if remarks.begins_badly {
        all.push("the beginning fits badly".into());
    }
    all.join("; ")
}

fn at(part: &Part, first: usize, last: usize) -> String {
    if part.asks.steady {
        return String::new();
    }
    let time = |row: usize| abi::format::time(part.instants[row] + part.asks.begins);
    if first == last {
        format!(", at {}", time(first))
    } else {
        format!(", between {} and {}", time(first), time(last))
    }
}

/// Where a dependence is greatest.
pub fn class(found: &Dependence, unit: &Unit) -> String {
    let value = |si: f64| show(si, unit, 3);
    match found.edge {
        _ if found.class.0 == found.class.1 => value(found.class.0),
        (true, _) => format!("below {}", value(found.class.1)),
        (_, true) => format!("above {}", value(found.class.0)),
        _ => format!("between {} and {}", value(found.class.0), value(found.class.1)),
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
