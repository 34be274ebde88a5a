//! `fric explain`: the page on an error or a warning, or the compiler's analysis of a model.

use super::End;
use crate::args::Explain;
use crate::compile::{self, Changes, Explanation, Method, Stopwatch};
use crate::quantity::duration;
use crate::report;
use crate::terminal::{Style, Terminal};
use serde_json::json;
use std::path::Path;
use std::time::Instant;

/// Every code has a section: `## E0101 units differ`.
const PAGES: &str = include_str!("../../docs/errors.md");

pub fn explain(args: &Explain, terminal: &mut Terminal) -> End {
    if args.subject.ends_with(".fric") || Path::new(&args.subject).is_file() {
        return models(args, terminal);
    }
    if let Some(page) = page_of(&args.subject) {
        terminal.print(page);
        return End::Fine;
    }
    terminal.error(&no_page(&args.subject));
    End::Failed
}

/// The page of a code or of a lint, `E0101`, `not-dissipative`.
pub(super) fn page_of(subject: &str) -> Option<&'static str> {
    let named = compile::LINTS.iter().find(|(lint, _)| *lint == subject.trim());
    page(&named.map_or_else(|| subject.trim().to_uppercase(), |(_, code)| code.to_string()))
}

/// The message that there is no such page, with a suggestion.
pub(super) fn no_page(subject: &str) -> String {
    let subject = subject.trim();
    let lints = compile::LINTS.iter().map(|(lint, _)| *lint);
    let near = compile::nearest(&subject.to_uppercase(), codes()).or(compile::nearest(subject, lints));
    let help = match near {
        Some(near) => format!("did you mean {near}?"),
        None if crate::repl::library_models().contains(&subject) => {
            format!(
                "a model is explained in a file that imports it, `fric explain FILE.fric {subject}`, or at the prompt"
            )
        }
        None => "codes look like E0101 or W0703, lints like `not-dissipative`".into(),
    };
    format!("there is no page about `{subject}`; {help}")
}

/// Most models listed in a message.
const MOST_NAMED: usize = 8;

/// Explains the models of a file, models that it imports, experiments and rigs.
fn models(args: &Explain, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = super::load(Path::new(&args.subject), terminal, &mut watch) else { return End::Failed };
    let all: Vec<String> = loaded.models().into_iter().map(|model| model.name.text.clone()).collect();
    let experiments: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    let rigs: Vec<String> = loaded.rigs().into_iter().map(|rig| rig.name.text.clone()).collect();
    let wanted = if args.names.is_empty() { &all } else { &args.names };
    if wanted.is_empty() {
        let others: Vec<&str> = experiments.iter().chain(&rigs).map(String::as_str).collect();
        let help = match others.as_slice() {
            [] => String::new(),
            [first, ..] => format!("; `fric explain {} {first}` explains what that runs", args.subject),
        };
        terminal.error(&format!("{} has no model{help}", args.subject));
        return End::Failed;
    }
    let mut end = End::Fine;
    for name in wanted {
        let explained = if all.contains(name) {
            compile::explain(&loaded, &crate::disk::Disk, name)
        } else if experiments.contains(name) {
            compile::explain_run(&mut loaded, &crate::disk::Disk, name, &Changes::default())
        } else if rigs.contains(name) {
            compile::explain_rig(&mut loaded, &crate::disk::Disk, name)
        } else if loaded.model_named(name).is_some() {
            compile::explain_in(&loaded, &crate::disk::Disk, name, loaded.root())
        } else {
            let others = experiments.iter().chain(&rigs).chain(&all).map(String::as_str);
            let help = match compile::nearest(name, others) {
                Some(near) => format!("did you mean `{near}`?"),
                None if all.len() > MOST_NAMED => {
                    format!("it has {} and {} more", all[..MOST_NAMED].join(", "), all.len() - MOST_NAMED)
                }
                None if all.is_empty() => "it has none, and imports none of this name".into(),
                None => format!("it has {}, and imports none of this name", all.join(", ")),
            };
            terminal.error(&format!("{} has no model, experiment or rig `{name}`; {help}", args.subject));
            end = End::Failed;
            continue;
        };
        match explained {
            Ok(explanation) => {
                let bounds = match args.step && all.contains(name) {
                    true => bounds(&loaded, &explanation),
                    false => Vec::new(),
                };
                let explanation = match experiments.contains(name) || rigs.contains(name) {
                    true => Explanation { model: format!("{name}: {}", explanation.model), ..explanation },
                    false => explanation,
                };
                match args.json {
                    true => terminal.line(&as_json(&explanation, &bounds).to_string()),
                    false => tell(&explanation, &bounds, terminal),
                }
                if args.step && !all.contains(name) {
                    terminal.report("`--step` times the models of the file itself only\n");
                }
            }
            Err(diagnostics) => {
                terminal.report(&report::full(&loaded.files.0, &diagnostics, terminal.error_colour()));
                end = End::Failed;
            }
        }
    }
    end
}

/// Prints everything about a model, with the measured times of its steps if there are any.
pub(crate) fn tell(explanation: &Explanation, bounds: &[Bound], terminal: &mut Terminal) {
    terminal.line(&terminal.styled(Style::Bold, &explanation.model));
    let width = |of: &mut dyn Iterator<Item = usize>| of.max().unwrap_or(0);
    let names = width(&mut explanation.quantities.iter().map(|q| q.path.chars().count()));
    let units = width(&mut explanation.quantities.iter().map(|q| q.unit.chars().count()));
    for q in &explanation.quantities {
        let range = q.range.as_ref().map_or(String::new(), |range| format!("  in {range}"));
        let doc = q.doc.as_ref().map_or(String::new(), |doc| format!("  {}", doc.lines().next().unwrap_or_default()));
        let line = format!("  {:<6} {:<names$}  {:<units$}{range}{doc}", q.kind, q.path, q.unit);
        terminal.line(line.trim_end());
    }
    terminal.line("\n  in this order:");
    let lefts = width(&mut explanation.equations.iter().map(|(left, _)| left.chars().count()));
    for (left, right) in &explanation.equations {
        terminal.line(&format!("    {left:<lefts$} = {right}"));
    }
    if !explanation.states.is_empty() {
        terminal.line("\n  states:");
    }
    for state in &explanation.states {
        terminal.line(&format!("    {}: {}", state.path, state.words()));
    }
    terminal.line(&format!("\n  an instance takes {} bytes; one fixed step, with its outputs:", explanation.bytes));
    for step in &explanation.steps {
        let code = step.code.map_or("no machine code here".into(), |(instructions, bytes)| {
            format!("{instructions} instructions in {bytes} bytes")
        });
        terminal.line(&format!(
            "    {:<8} {code}; {} operations ({} before functions are expanded), {} divisions and roots",
            step.method.name(),
            step.operations,
            step.plain,
            step.divisions
        ));
    }
    if let Some(stable) = stable_steps(explanation) {
        terminal.line("\n  stable where states and inputs stay in their ranges, or below 10 in SI where those are open, with steps up to:");
        terminal.line(&format!("    {stable}"));
    }
    if !bounds.is_empty() {
        terminal.line(&format!("\n  a step on this machine, each of {CALLS} calls timed, other programs included:"));
        for bound in bounds {
            terminal.line(&format!(
                "    {:<8} {} in the middle, all but 100 below {}, worst {}; with a margin of {MARGIN} {}: cycles of {} or more",
                bound.method.name(),
                duration(1e-9 * bound.median, 4),
                duration(1e-9 * bound.most, 4),
                duration(1e-9 * bound.worst, 4),
                duration(1e-9 * MARGIN * bound.worst, 4),
                duration(1e-9 * 2.0 * MARGIN * bound.worst, 4),
            ));
        }
    }
    for storage in &explanation.storage {
        terminal.line(&format!("\n  stores {storage}"));
    }
    if let Some(independent) = explanation.rate_independent {
        terminal.line(match independent {
            true => "\n  rate independent: the force depends on the path, not on how fast it is travelled",
            false => "\n  not rate independent: the speed enters otherwise than through its sign",
        });
    }
    if let Some(verdict) = &explanation.dissipation {
        terminal.line(&format!("  dissipation: {}", verdict.words()));
    }
    terminal.line("");
}

/// `euler 20 µs, rk4 28 µs, expo any, implicit any`; none for a model without states to integrate.
fn stable_steps(explanation: &Explanation) -> Option<String> {
    let one =
        |step: &compile::StepCost| Some(format!("{} {}", step.method.name(), compile::stable_up_to(step.stable?)));
    let all: Option<Vec<String>> = explanation.steps.iter().map(one).collect();
    all.map(|all| all.join(", "))
}

/// The same as JSON.
pub(crate) fn as_json(explanation: &Explanation, bounds: &[Bound]) -> serde_json::Value {
    json!({
        "model": explanation.model,
        "quantities": explanation.quantities.iter().map(|q| json!({
            "kind": q.kind, "name": q.path, "unit": q.unit, "range": q.range, "doc": q.doc,
        })).collect::<Vec<_>>(),
        "equations": explanation.equations.iter().map(|(left, right)| json!({ "left": left, "right": right })).collect::<Vec<_>>(),
        "states": explanation.states.iter().map(|state| json!({
            "name": state.path, "how": state.words(), "fastest": state.fastest.map(|(rate, _)| rate),
        })).collect::<Vec<_>>(),
        "bytes": explanation.bytes,
        "steps": explanation.steps.iter().map(|step| json!({
            "method": step.method.name(), "operations": step.operations, "before_expansion": step.plain,
            "divisions": step.divisions, "instructions": step.code.map(|(instructions, _)| instructions),
            "code_bytes": step.code.map(|(_, bytes)| bytes), "largest_stable_s": step.stable,
        })).collect::<Vec<_>>(),
        "bounds": bounds.iter().map(|bound| json!({
            "method": bound.method.name(), "calls": CALLS, "median_ns": bound.median, "all_but_100_ns": bound.most,
            "worst_ns": bound.worst,
            "margin": MARGIN,
        })).collect::<Vec<_>>(),
        "storage": explanation.storage,
        "rate_independent": explanation.rate_independent,
        "dissipation": explanation.dissipation.as_ref().map(compile::Verdict::words),
    })
}

/// Number of timed calls.
const CALLS: usize = 1_000_000;
/// Factor for conditions beyond the measurement: other programs, other states, a colder cache.
const MARGIN: f64 = 2.0;
/// Length of the timed step, in s. It changes no instruction.
const STEP: f64 = 1e-3;

/// The measured time of one call, in ns.
pub(crate) struct Bound {
    method: Method,
    median: f64,
    /// An upper bound for all calls but a hundred.
    most: f64,
    worst: f64,
}

/// Times the fixed steps of a model; nothing for methods without machine code.
fn bounds(loaded: &compile::Loaded, explanation: &Explanation) -> Vec<Bound> {
    let timed = explanation.steps.iter().filter(|step| step.code.is_some());
    let bound = |method: Method| {
        let mut instance = compile::stepping(loaded, &crate::disk::Disk, &explanation.model, method, STEP).ok()?;
        let mut calls: Vec<f64> = (0..CALLS)
            .map(|_| {
                let begin = Instant::now();
                instance.advance(1);
                begin.elapsed().as_nanos() as f64
            })
            .collect();
        calls.sort_by(f64::total_cmp);
        Some(Bound { method, median: calls[CALLS / 2], most: calls[CALLS - 101], worst: calls[CALLS - 1] })
    };
    timed.filter_map(|step| bound(step.method)).collect()
}

/// The page of a code: from its heading to the next.
pub(super) fn page(code: &str) -> Option<&'static str> {
    let start = headings().find(|at| PAGES[*at..].strip_prefix("## ").is_some_and(|rest| word(rest) == code))?;
    let end = headings().find(|at| *at > start).unwrap_or(PAGES.len());
    Some(&PAGES[start..end])
}

/// Offsets of second-level headings, outside code blocks.
fn headings() -> impl Iterator<Item = usize> {
    let mut at = 0;
    let mut inside = false;
    PAGES.split_inclusive('\n').filter_map(move |line| {
        let start = at;
        at += line.len();
        inside ^= line.starts_with("```");
        (!inside && line.starts_with("## ")).then_some(start)
    })
}

fn codes() -> impl Iterator<Item = &'static str> {
    headings().map(|at| word(&PAGES[at + 3..]))
}

fn word(text: &str) -> &str {
    text.split_whitespace().next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_one_page() {
        let mut all: Vec<&str> = codes().collect();
        assert!(all.iter().all(|code| code.len() == 5 && code.starts_with(['E', 'W'])), "{all:?}");
        let count = all.len();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), count);
        for code in all {
            assert!(page(code).unwrap().lines().count() > 2, "{code}");
        }
        assert!(page("E9999").is_none());
    }
}
