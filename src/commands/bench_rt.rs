//! `fric bench-rt`: a loop as a rig has it, how late it woke, and what that means.

use super::End;
use crate::args::BenchRt as Args;
use crate::terminal::{Style, Terminal};
use crate::value;
use runtime::bench_rt::{self, Fit, Report};
use runtime::histogram::Histogram;
use runtime::host::Host;
use runtime::realtime::{self, Wishes};
use std::sync::atomic::{AtomicBool, Ordering};

/// Ctrl-C: ends the run, and what it has shown so far is told.
static STOP: AtomicBool = AtomicBool::new(false);

/// Widest bar of the histogram.
const BAR: f64 = 40.0;

pub fn bench_rt(args: &Args, terminal: &mut Terminal) -> End {
    let _ = ctrlc::set_handler(|| STOP.store(true, Ordering::Relaxed));
    let period_ns = (1e9 / args.rate).round() as u64;
    let cycles = (args.seconds as f64 * args.rate).round() as u64;
    let core = args.core.or_else(realtime::isolated_core);
    let wishes = Wishes { priority: args.priority, core, ..Wishes::default() };
    let report = bench_rt::run(period_ns, cycles, &wishes, || STOP.load(Ordering::Relaxed));
    if report.cycles == 0 {
        terminal.error("stopped before the first cycle");
        return End::Failed;
    }
    for refusal in &report.refused {
        terminal.report(&format!("refused: {:?}: {}\n  mend: {}\n", refusal.what, refusal.reason, refusal.remedy));
    }
    terminal.print(&histogram(&report.lateness));
    tell(&report, args, terminal)
}

/// A bar an octave: the bins in between are for quantiles.
fn histogram(lateness: &Histogram) -> String {
    let mut octaves: Vec<(u64, u64)> = Vec::new();
    for (_, upper_ns, count) in lateness.bins() {
        let octave_ns = (upper_ns.div_ceil(100)).next_power_of_two().saturating_mul(100);
        match octaves.last_mut() {
            Some((last_ns, sum)) if *last_ns == octave_ns => *sum += count,
            _ => octaves.push((octave_ns, count)),
        }
    }
    let most = octaves.iter().map(|(_, count)| *count).max().unwrap_or(1) as f64;
    let line = |(upper_ns, count): &(u64, u64)| {
        // One cycle in a million is still one to see.
        let bar = "━".repeat((BAR * *count as f64 / most).ceil() as usize);
        let upper = format!("≤ {}", value::duration(*upper_ns as f64 * 1e-9));
        format!("{upper:>10}  {bar:<40}  {}\n", value::count(*count))
    };
    octaves.iter().map(line).collect()
}

fn tell(report: &Report, args: &Args, terminal: &mut Terminal) -> End {
    let us = |ns: u64| value::significant(ns as f64 / 1000.0, 3);
    let lateness = &report.lateness;
    terminal.line(&format!(
        "lateness µs   p50 {}  p99 {}  p99.9 {}  max {}      receive {} / {}   transmit {} / {}   answer {} / {}",
        us(lateness.quantile_ns(0.5)),
        us(lateness.quantile_ns(0.99)),
        us(lateness.quantile_ns(0.999)),
        us(lateness.max_ns()),
        us(report.receive.quantile_ns(0.5)),
        us(report.receive.max_ns()),
        us(report.transmit.quantile_ns(0.5)),
        us(report.transmit.max_ns()),
        us(report.answer.quantile_ns(0.5)),
        us(report.answer.max_ns()),
    ));
    let rate = if args.rate >= 1000.0 { format!("{} kHz", args.rate / 1000.0) } else { format!("{} Hz", args.rate) };
    let (verdict, style, end) = match report.fit() {
        Fit::Fit => (format!("fit for {rate} (max < T/20)"), Style::Good, End::Fine),
        Fit::AtSync => (format!("fit for {rate} with at_sync (max < T/5)"), Style::Good, End::Fine),
        Fit::NotForTorque => ("not for torque".to_string(), Style::Bad, End::Failed),
    };
    terminal.line(&format!(
        "{} cycles at {rate}: {} missed, {} overruns, {} page faults      verdict: {}",
        value::count(report.cycles),
        value::count(report.missed),
        value::count(report.overruns),
        value::count(report.page_faults),
        terminal.styled(style, &verdict)
    ));
    let virtual_machine = Host::default().findings().into_iter().find(|finding| finding.topic == "machine");
    if let Some(finding) = virtual_machine {
        terminal.line(&format!("this is {}", finding.says));
    }
    end
}
