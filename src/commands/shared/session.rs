//! Code shared by the interactive session and by `watch`: Ctrl-C, and the display of a run.

use crate::plot::{self, Figure};
use crate::repl::{Fault, Ran, Value, plain};
use crate::terminal::{Style, Terminal};
use crate::{figure, quantity, report, results};
use abi::Slot;
use abi::unit::Unit;
use runtime::engine::Continue;
use std::sync::atomic::{AtomicBool, Ordering};

/// Set by Ctrl-C, reset before each line.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Whether Ctrl-C was pressed since the line began.
pub(in crate::commands) fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Resets the flag.
pub(in crate::commands) fn forget_interrupt() {
    INTERRUPTED.store(false, Ordering::Relaxed);
}

/// Lets Ctrl-C stop the current run instead of the process.
pub(in crate::commands) fn catch_interrupts() {
    forget_interrupt();
    // Set once for the process; a second call has no effect.
    crate::interrupt::on_interrupt(|| INTERRUPTED.store(true, Ordering::Relaxed));
}

/// Stops a run after Ctrl-C.
pub(in crate::commands) fn stop_on_interrupt(_: f64) -> Continue {
    if interrupted() { Continue::Break(()) } else { Continue::Continue(()) }
}

/// Prints a fault.
pub(in crate::commands) fn tell_fault(fault: &Fault, terminal: &Terminal) {
    match fault {
        Fault::Found(files, diagnostics) => {
            terminal.report(&report::full(files, diagnostics, terminal.error_colour()));
        }
        Fault::Words(words) => terminal.error(words),
        Fault::Stopped(failure) => terminal.error(&failure.to_string()),
    }
}

/// Prints the results of a run, draws its plots, judges its expectations; returns whether they hold.
pub(in crate::commands) fn show_run(ran: &Ran, draw: bool, terminal: &mut Terminal) -> bool {
    if let Some(warnings) = &ran.warnings {
        tell_fault(warnings, terminal);
    }
    let Some(first) = ran.cases.first() else { return true };
    let outcomes: Vec<_> = ran.results.iter().filter_map(|result| result.as_ref().ok()).collect();
    let steps: u64 = outcomes.iter().map(|outcome| outcome.work.steps).sum();
    let cases = if ran.cases.len() > 1 { format!(", {} cases", ran.cases.len()) } else { String::new() };
    let second = Unit::parse("s").expect("the second is known");
    terminal.line(&format!(
        "{}: {}{cases}, {} steps for {}",
        terminal.styled(Style::Bold, &ran.name),
        results::solver(&first.experiment.solver),
        quantity::count(steps),
        quantity::show(first.experiment.duration, &second, 6),
    ));
    for note in first.notes.iter().chain(outcomes.iter().flat_map(|outcome| &outcome.notes)) {
        terminal.line(&format!("  note: {note}"));
    }
    if let Some(drawn) = run_figure(ran, false).filter(|_| draw) {
        terminal.print(&plot::terminal(&drawn, terminal.width(), terminal.colour()));
    } else if let ([outcome], true) = (outcomes.as_slice(), draw) {
        let width = outcome.finals.iter().map(|end| end.path.chars().count()).max().unwrap_or(0);
        for end in &outcome.finals {
            let value = Value { si: end.value, unit: end.unit.clone(), boolean: end.boolean };
            terminal.line(&format!("  {:width$}  {} at the end", end.path, plain(&value)));
        }
    }
    let mut held = true;
    for (case, result) in ran.cases.iter().zip(&ran.results) {
        let Ok(outcome) = result else { continue };
        if !case.label.is_empty() && !outcome.verdicts.is_empty() {
            terminal.line(&format!("  {}", case.label));
        }
        held &= outcome.passed();
        let words = results::verdicts(terminal, &outcome.verdicts, outcome.estimate.as_ref(), None, "  ");
        terminal.print(&words);
    }
    held
}

/// The plots of a run in one figure; `last`: only the plot that was added last.
pub(in crate::commands) fn run_figure(ran: &Ran, last: bool) -> Option<Figure> {
    let first = ran.cases.first()?;
    let count = first.experiment.plots.len();
    if count == 0 {
        return None;
    }
    let cases = figure::of_results(&ran.cases, &ran.results);
    let subtitle = results::solver(&first.experiment.solver);
    Some(figure::figure(&ran.name, &subtitle, if last { count - 1 } else { 0 }, &cases))
}

/// The time of an instance, from which a run continues.
pub(in crate::commands) fn time_of(instance: &abi::Instance) -> f64 {
    instance.get(Slot::TIME)
}
