//! `fric bench-rt`: measures the wake-up latency of a periodic loop like a rig's, and interprets it.

use super::{End, chosen_rig, load, reported};
use crate::args::BenchRt as Args;
use crate::compile::{self, Stopwatch};
use crate::quantity;
use crate::terminal::{Style, Terminal};
use runtime::drive::polarity_check::SignTest;
use runtime::hil::coupling::look_ahead;
use runtime::hil::cycle::{Hil, Options};
use runtime::hil::simulated::{Pace, World};
use runtime::hil::{emergency, words};
use runtime::latency_test::{self, Fit, Report};
use runtime::realtime::histogram::Histogram;
use runtime::realtime::host_check::Host;
use runtime::realtime::threads::{self, Wishes};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Ctrl-C: ends the run and prints the results so far.
static STOP: AtomicBool = AtomicBool::new(false);

/// Width of the longest bar of the histogram.
const BAR: f64 = 40.0;

pub fn bench_rt(args: &Args, terminal: &mut Terminal) -> End {
    if let Some(file) = &args.file {
        return of_rig(file, args, terminal);
    }
    crate::interrupt::on_interrupt(|| STOP.store(true, Ordering::Relaxed));
    let period_ns = (1e9 / args.rate).round() as u64;
    let cycles = (args.seconds as f64 * args.rate).round() as u64;
    let core = args.core.or_else(threads::isolated_core);
    let wishes = Wishes { priority: args.priority, core, ..Wishes::default() };
    let report = latency_test::run(period_ns, cycles, &wishes, || STOP.load(Ordering::Relaxed));
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

/// The cycle of a rig with its model; its drives are simulated in this process in real time.
fn of_rig(file: &Path, args: &Args, terminal: &mut Terminal) -> End {
    let Some(mut loaded) = load(file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let name = match chosen_rig(file, args.rig.as_deref(), &loaded) {
        Ok(name) => name,
        Err(why) => return refused(terminal, &why),
    };
    let ready = compile::rig(&mut loaded, &crate::disk::Disk, &name, &compile::Options::default(), &mut Vec::new());
    let mut ready = match ready {
        Ok(ready) => ready,
        Err(found) => {
            reported(&loaded, &found, terminal);
            return End::Failed;
        }
    };
    // Lateness is only counted here: neither the drives nor the watchdog stop the run because of it.
    ready.rig.watchdog_ns = ready.rig.watchdog_ns.max(60_000_000_000);
    let mut options = Options { arms_itself: true, ..Options::default() };
    (options.control.count_overruns, options.start.simulated, options.start.missed) = (true, true, 1.0);
    (options.start.timeout_test, options.start.sign_test) = (false, SignTest::Skip);
    options.duration_ns = Some(args.seconds * 1_000_000_000);
    let rig = &ready.rig;
    let made = look_ahead(rig, &ready.plant).and_then(|look| {
        options.look = look;
        let mut world = World::new(rig, Some(ready.plant.clone()), Pace::Wall, 1)?;
        let masters = world.masters();
        Ok((Hil::new(rig, ready.control.clone(), world.clock(), masters, options, None)?, world))
    });
    let ((mut hil, _operator), _world) = match made {
        Ok(made) => made,
        Err(why) => return refused(terminal, &why),
    };
    let core = args.core.or_else(threads::isolated_core);
    let real_time = threads::enter(&Wishes { priority: args.priority, core, ..Wishes::default() });
    for refusal in real_time.refused() {
        terminal.report(&format!("refused: {:?}: {}\n  mend: {}\n", refusal.what, refusal.reason, refusal.remedy));
    }
    emergency::guard();
    let end = hil.run();
    drop(real_time);
    let counts = hil.counts();
    if counts.cycles == 0 {
        return refused(terminal, &format!("the model did not run: {end:?}"));
    }
    terminal.print(&histogram(&counts.late));
    words::counts(counts).lines().for_each(|line| terminal.line(line));
    let (period_ns, late_ns) = (ready.rig.period_ns, counts.late.max_ns());
    let fit = if counts.missed > 0 { Fit::NotForTorque } else { Fit::of(late_ns, period_ns) };
    let (verdict, style, end) = judged(fit, &rate(1e9 / period_ns as f64));
    terminal.line(&format!("verdict: {}", terminal.styled(style, &verdict)));
    end
}

fn refused(terminal: &Terminal, why: &str) -> End {
    terminal.error(why);
    End::Failed
}

fn rate(hertz: f64) -> String {
    if hertz >= 1000.0 { format!("{} kHz", hertz / 1000.0) } else { format!("{hertz} Hz") }
}

fn judged(fit: Fit, rate: &str) -> (String, Style, End) {
    match fit {
        Fit::Fit => (format!("fit for {rate} (max < T/20)"), Style::Good, End::Fine),
        Fit::AtSync => (format!("fit for {rate} with at_sync (max < T/5)"), Style::Good, End::Fine),
        Fit::NotForTorque => ("not for torque".to_string(), Style::Bad, End::Failed),
    }
}

/// A bar for each octave; the bins in between serve the quantiles.
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
        // A single cycle in a million is still visible.
        let bar = "━".repeat((BAR * *count as f64 / most).ceil() as usize);
        let upper = format!("≤ {}", quantity::duration(*upper_ns as f64 * 1e-9, 3));
        format!("{upper:>10}  {bar:<40}  {}\n", quantity::count(*count))
    };
    octaves.iter().map(line).collect()
}

fn tell(report: &Report, args: &Args, terminal: &mut Terminal) -> End {
    let us = |ns: u64| quantity::significant(ns as f64 / 1000.0, 3);
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
    let rate = rate(args.rate);
    let (verdict, style, end) = judged(report.fit(), &rate);
    terminal.line(&format!(
        "{} cycles at {rate}: {} missed, {} overruns, {} page faults      verdict: {}",
        quantity::count(report.cycles),
        quantity::count(report.missed),
        quantity::count(report.overruns),
        quantity::count(report.page_faults),
        terminal.styled(style, &verdict)
    ));
    let virtual_machine = Host::default().findings().into_iter().find(|finding| finding.topic == "machine");
    if let Some(finding) = virtual_machine {
        terminal.line(&format!("this is {}", finding.says));
    }
    end
}
