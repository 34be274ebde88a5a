//! `fric hil`: runs a rig with drives on its buses, real or simulated.

use super::beside::Beside;
use super::company::Company;
use super::prompt::Rehearsal;
use super::{End, chosen_rig, load_from};
use crate::args::Hil as Args;
use crate::compile::{self, CompiledRig, Options, Stopwatch};
use crate::source_snapshot::Keeping;
use crate::terminal::{Style, Terminal};
use crate::{loop_stability, quantity, report};
use abi::rig::Rig;
use runtime::can::Bus;
use runtime::can::sim::Simulation;
use runtime::drive::profiles::Life;
use runtime::hil::control::PATIENT_NS;
use runtime::hil::cycle::{Gauges, Hil, Options as HilOptions};
use runtime::hil::identify::{self, Identification};
use runtime::hil::session::{self, Drives, Finished, Session, Setup};
use runtime::hil::simulated::{Pace, World};
use runtime::hil::{cycle, emergency, watches, words};
use runtime::realtime::clock::Clock;
use runtime::realtime::threads::RefusedWish;
use runtime::record::log::{Sections, Settings, Sink};
use runtime::record::parts::{self, Limits};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Length of the black box.
const BLACK_BOX_NS: u64 = 10_000_000_000;

pub fn hil(args: &Args, terminal: &mut Terminal) -> End {
    let mut company = Company::new(args);
    loop {
        let end = once(args, &mut company, terminal);
        if !company.wish_for_another(terminal) {
            return end;
        }
    }
}

/// One run, from the texts as they are now.
fn once(args: &Args, company: &mut Company, terminal: &mut Terminal) -> End {
    let keeping = Keeping::new(&crate::disk::Disk);
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load_from(&args.file, &keeping, terminal, &mut watch) else { return End::Failed };
    let name = match chosen_rig(&args.file, args.rig.as_deref(), &loaded) {
        Ok(name) => name,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let set = args.set.texts();
    let options = Options { changes: args.set.changes(), interpret: args.interpret };
    let mut found = Vec::new();
    let ready = compile::rig(&mut loaded, &keeping, &name, &options, &mut found);
    found.extend(ready.as_ref().err().into_iter().flatten().cloned());
    if !found.is_empty() && (!args.quiet || ready.is_err()) {
        terminal.report(&report::full(&loaded.files.0, &found, terminal.error_colour()));
    }
    let Ok(mut ready) = ready else { return End::Failed };
    if let Err(why) = session::readdress(&mut ready.rig, &args.bus) {
        terminal.error(&why);
        return End::Misused;
    }
    let drives = Drives::of(&ready.rig, args.sim, args.fast);
    if let Err(why) = usage(args, &ready, drives) {
        terminal.error(&why);
        return End::Misused;
    }
    if args.count_overruns {
        // If overruns are only counted, neither the drives nor the watchdog stop the rig, unless no cycle runs for this
        // long.
        ready.rig.watchdog_ns = ready.rig.watchdog_ns.max(PATIENT_NS);
    }
    let root = loaded.files.get(loaded.root());
    let head = Sections::default()
        .with("fric", env!("CARGO_PKG_VERSION"))
        .with("target", format!("{} {}", std::env::consts::ARCH, std::env::consts::OS))
        .with("rig", name.as_str())
        .with("file", root.name.as_str())
        .with("source", root.text.as_bytes())
        .with("set", set.join("\n"))
        .with("started", session::started(drives));
    let head = keeping.into(head);
    let log = Some((log_settings(args, &name, &ready, (drives, company)), head));
    if args.identify {
        return identified(args, ready, drives, company, terminal);
    }
    let Some(needs_look) = bearable(args, &ready, terminal) else { return End::Failed };
    ready.rig.needs_look = needs_look;
    emergency::guard();
    let rehearsal = Rehearsal::new(ready.clone(), loaded, args.accept_unstable, needs_look);
    let asked = Asked { log, rehearsal: Some(rehearsal), ..Asked::default() };
    with_buses(args, ready, drives, (asked, company), terminal)
}

/// Whether the rig is stable only with the predictor; none if it must not run.
fn bearable(args: &Args, ready: &CompiledRig, terminal: &mut Terminal) -> Option<bool> {
    let (mut against, needs_look) = loop_stability::objections(ready);
    if args.accept_unstable {
        against.clear();
    }
    // Simulated time does not advance during a step, so a slow step does not matter.
    if !args.fast {
        against.extend(watches::too_slow(&ready.rig, &ready.control));
    }
    for why in &against {
        terminal.error(&format!("refused: {why}"));
    }
    if against.is_empty() {
        return Some(needs_look);
    }
    terminal.report(
        "  `fric predict` says what would help; with simulated drives --accept-unstable lets an unstable rig run\n",
    );
    None
}

/// Rejects combinations of options that exclude each other.
fn usage(args: &Args, ready: &CompiledRig, drives: Drives) -> Result<(), String> {
    if drives.is_fast() && args.duration.is_none() && !args.check && !args.identify {
        return Err(session::FAST_WITHOUT_END.into());
    }
    if drives.are_simulated() {
        return Ok(());
    }
    if args.fast {
        return Err("--fast needs --sim: real drives have their own time".into());
    }
    if !args.inject.is_empty() {
        return Err("--inject needs --sim: it makes simulated drives and devices fail".into());
    }
    if let Some(bus) = ready.rig.buses.iter().find(|bus| bus.address.starts_with("sim:")) {
        return Err(format!("bus `{}` is simulated and others are not: a rig is one or the other", bus.name));
    }
    Ok(())
}

/// Options that are allowed with simulated drives only.
fn daring(args: &Args) -> Option<&'static str> {
    let all = [
        (args.arm, "--arm"),
        (args.accept_unstable, "--accept-unstable"),
        (args.accept_jitter, "--accept-jitter"),
        (args.count_overruns, "--count-overruns"),
    ];
    all.into_iter().find(|(given, _)| *given).map(|(_, name)| name)
}

fn log_settings(args: &Args, name: &str, ready: &CompiledRig, (drives, company): (Drives, &Company)) -> Settings {
    let path = args.log.clone().unwrap_or_else(|| PathBuf::from("out").join(format!("{name}.friclog")));
    let path = company.log(path);
    let sink = if args.no_log {
        let path = PathBuf::from("out").join(format!("{name}.blackbox.friclog"));
        Sink::BlackBox(path, session::blocks(BLACK_BOX_NS))
    } else {
        Sink::File(path, Limits { part: args.roll, keep: args.keep, ..Limits::default() })
    };
    session::log_settings(&ready.rig, sink, drives)
}

/// Options of the cycle, or a message about what the rig's predictor lacks.
fn hil_options(args: &Args, ready: &CompiledRig, drives: Drives) -> Result<HilOptions, String> {
    let mut options = session::options(&ready.rig, &ready.plant, drives)?;
    options.control.count_overruns = args.count_overruns;
    options.control.energy_stops = args.stop_on_energy;
    if args.count_overruns {
        options.start.missed = 1.0;
    } else if !drives.are_simulated() && args.accept_jitter {
        // On a host without real-time scheduling, drives that are programs on it answer late.
        options.start.missed = 0.9;
    }
    options.start.timeout_test = !args.count_overruns;
    options.arms_itself |= args.arm;
    options.checks_only = args.check;
    options.duration_ns = args.duration.map(|seconds| (seconds * 1e9).round() as u64);
    if !drives.are_simulated() {
        options.only_simulated = daring(args).map(|option| format!("{option} is for simulated drives only"));
    }
    Ok(options)
}

/// Runs torque pulses in place of the model.
fn identified(
    args: &Args,
    mut ready: CompiledRig,
    drives: Drives,
    company: &mut Company,
    terminal: &mut Terminal,
) -> End {
    let asked = match Identification::new(&ready.rig) {
        Ok(asked) => asked,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    emergency::guard();
    ready.rig = asked.rig.clone();
    ready.control = asked.program.clone();
    let asked = Asked { pulses: Some(&asked), ..Asked::default() };
    with_buses(args, ready, drives, (asked, company), terminal)
}

/// Prints the measured parameters as text to paste.
fn measured(asked: &Identification, rows: &[identify::Row], terminal: &mut Terminal) {
    let milli = |seconds: f64| quantity::significant(seconds * 1e3, 3);
    for found in asked.evaluate(rows) {
        let name = &asked.rig.nodes[found.node].name;
        let inertia = found
            .inertia
            .map_or("it hardly moved".into(), |inertia| format!("inertia {} kg·m²", quantity::significant(inertia, 3)));
        terminal.line(&format!(
            "  drive {name}: delay = {} ms, lag = {} ms    ({inertia}; {} N·m rms unexplained)",
            milli(found.delay),
            milli(found.lag),
            quantity::significant(found.residual, 2)
        ));
    }
}

/// Tasks of a run in addition to the control cycle.
#[derive(Default)]
struct Asked<'a> {
    log: Option<(Settings, Sections)>,
    /// Torque pulses in place of the model.
    pulses: Option<&'a Identification>,
    /// Validates new sets of parameters.
    rehearsal: Option<Rehearsal>,
}

/// What is asked of a run, and by whom.
type AskedBy<'a, 'b> = (Asked<'a>, &'b mut Company);

/// Runs with the buses of these drives.
fn with_buses(args: &Args, ready: CompiledRig, drives: Drives, asked: AskedBy, terminal: &mut Terminal) -> End {
    match drives {
        Drives::Simulated(pace) => in_process(args, ready, pace, asked, terminal),
        Drives::Real => on_buses(args, ready, asked, terminal),
    }
}

/// Runs with buses, drives and devices in this process.
fn in_process(args: &Args, ready: CompiledRig, pace: Pace, asked: AskedBy, terminal: &mut Terminal) -> End {
    let world = World::new(&ready.rig, Some(ready.plant.clone()), pace, args.seed);
    let mut world = match world {
        Ok(world) => world,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    for text in &args.inject {
        match runtime::drive::fault_injection::read(text, &ready.rig) {
            Ok(hook) => world.bench().hook(hook),
            Err(why) => {
                terminal.error(&format!("--inject '{text}': {why}"));
                return End::Misused;
            }
        }
    }
    let (clock, masters) = (world.clock(), world.masters());
    run(args, ready, clock, masters, (Drives::Simulated(pace), Some(&world)), asked, terminal)
}

/// Runs on the buses of this machine.
fn on_buses(args: &Args, ready: CompiledRig, asked: AskedBy, terminal: &mut Terminal) -> End {
    let world = Simulation::real_time();
    match session::buses(&ready.rig, &world) {
        Ok(buses) => run(args, ready, Box::new(world), buses, (Drives::Real, None), asked, terminal),
        Err(why) => {
            terminal.error(&why);
            terminal.report("  `fric hil --sim` runs the rig with simulated drives\n");
            End::Failed
        }
    }
}

fn run(
    args: &Args,
    ready: CompiledRig,
    clock: Box<dyn Clock>,
    buses: Vec<Box<dyn Bus>>,
    (drives, simulated): (Drives, Option<&World>),
    (asked, company): AskedBy,
    terminal: &mut Terminal,
) -> End {
    let Asked { log, pulses: asked, rehearsal } = asked;
    let log_path = log.as_ref().map(|(settings, _)| match &settings.sink {
        Sink::File(path, _) | Sink::BlackBox(path, _) => path.clone(),
    });
    // Before the calling thread is set up for real time.
    if let (true, Some((_, head)), Some(path)) = (args.panel, &log, &log_path)
        && let Err(why) = company.shows(path, head.text("started").unwrap_or_default(), args)
    {
        terminal.error(&why);
        return End::Failed;
    }
    let started = hil_options(args, &ready, drives).and_then(|mut options| {
        if let Some(asked) = asked {
            options.duration_ns = Some(asked.duration_ns);
            options.control.ramp_ns = 0;
            options.control.measures = true;
        }
        let setup = Setup {
            rig: &ready.rig,
            control: ready.control.clone(),
            drives,
            options,
            log,
            judge: rehearsal.as_ref().map(|rehearsal| rehearsal.judge().clone()),
            needs_real_time: "this host gives no real time, see above",
        };
        Session::start(setup, clock, buses)
    });
    let mut session = match started {
        Ok(session) => session,
        Err(why) => {
            company.ends(&why);
            terminal.error(&why);
            return End::Failed;
        }
    };
    if let Some(attention) = &company.attention {
        session.hil.attended_by(attention.clone());
    }
    let rig = &ready.rig;
    if !args.quiet {
        begin(rig, drives, session.refused(), &ready.notes, terminal);
        log_path.iter().filter(|_| !args.no_log).for_each(|path| terminal.line(&room(path)));
    }
    let over = Arc::new(AtomicBool::new(false));
    let view = (!args.quiet && !drives.is_fast() && std::io::stdout().is_terminal()).then(|| {
        let (gauges, rig, over) = (session.hil.gauges(), rig.clone(), over.clone());
        std::thread::spawn(move || view(&gauges, &rig, &over))
    });
    let telling = company.told().map(|told| {
        let (gauges, over) = (session.hil.gauges(), over.clone());
        std::thread::spawn(move || Beside::tell(&told, &gauges, &over))
    });
    if let Some(operator) = session.operator().filter(|_| !drives.is_fast()) {
        company.begins(operator.by_the_wall(), rehearsal);
    }
    if let Some(asked) = asked {
        let rows = identify::rows(&mut session.hil, asked);
        if session.hil.ended() == Some(&cycle::End::Asked) && rows.len() >= asked.drives().len() * 10 {
            measured(asked, &rows, terminal);
        }
    }
    if let Some(world) = simulated {
        session.run_to_model();
        world.bench().begin_run();
    }
    let end = session.run();
    over.store(true, Ordering::Relaxed);
    if let Some(view) = view {
        let _ = view.join();
    }
    if let Some(telling) = telling {
        let _ = telling.join();
    }
    if session.hil.is_checked() {
        checked(rig, &session.hil, terminal);
    }
    let finished = session.finish();
    company.ends(&end.words());
    finish(args, finished, end, log_path, terminal)
}

/// Prints what `--check` found for each drive, and that there were no problems.
fn checked(rig: &Rig, hil: &Hil, terminal: &mut Terminal) {
    for (at, node) in rig.nodes.iter().enumerate() {
        let Some(status) = hil.fieldbus().status(at) else { continue };
        let [vendor, product, ..] = status.identity.map(|word| word.map_or("-".into(), |word| format!("0x{word:08X}")));
        let mut line = format!("  {}: vendor {vendor}, product {product}, mode {}", node.name, status.mode);
        if let Some((ms, life)) = status.timeout {
            let by = match life {
                Life::Heartbeat => "our heartbeat",
                Life::Guarding => "guarding",
            };
            line += &format!("; misses {by} after {ms} ms");
            if let Some(ns) = status.timeout_measured_ns {
                line += &format!(", stopped after {} ms", quantity::significant(ns as f64 * 1e-6, 3));
            }
        }
        line += &match status.deadline_ms {
            Some(ms) => format!("; misses set-points after {ms} ms"),
            None => {
                "; has no deadline for set-points (object 1400:5): while it stands, lost ones are not noticed".into()
            }
        };
        terminal.line(&line);
    }
    terminal.line("  checks passed: nothing was armed");
}

fn begin(rig: &Rig, drives: Drives, refused: &[RefusedWish], notes: &[String], terminal: &mut Terminal) {
    let rate = 1e9 / rig.period_ns as f64;
    let kind = match drives {
        Drives::Real => "drives on their buses",
        Drives::Simulated(Pace::Wall) => "simulated drives, wall-clock time",
        Drives::Simulated(Pace::Fast) => "simulated drives, simulated time",
    };
    terminal.line(&format!(
        "{}  {} Hz, {kind}",
        terminal.styled(Style::Bold, &rig.name),
        quantity::significant(rate, 4)
    ));
    for note in notes {
        terminal.line(&format!("  note: {note}"));
    }
    for lack in watches::missing_monitors(rig) {
        terminal.line(&format!("  note: {lack}"));
    }
    if !refused.is_empty() {
        terminal.line("  not real time on this host:");
        refused.iter().for_each(|refusal| terminal.line(&format!("    {refusal}")));
    }
}

/// The destination of the log, and the free space there.
fn room(log: &Path) -> String {
    // The folder is created when the log begins.
    let there = log.ancestors().skip(1).find(|folder| folder.is_dir()).unwrap_or(Path::new("."));
    let free = parts::free(there).map_or(String::new(), |free| format!(", {} free on its disk", parts::size(free)));
    format!("  log {}{free}", log.display())
}

/// Reports how the run ended, after the log was closed.
fn finish(args: &Args, finished: Finished, end: cycle::End, log: Option<PathBuf>, terminal: &mut Terminal) -> End {
    let Finished { counts, missed, misuse, log: written, .. } = finished;
    if !args.quiet {
        for line in counts.lines() {
            terminal.line(&format!("  {line}"));
        }
    }
    let mut code = match end {
        cycle::End::Asked => End::Fine,
        cycle::End::Refused(why) => {
            terminal.error(&format!("refused: {why}"));
            if misuse { End::Misused } else { End::Failed }
        }
        cycle::End::Stopped(_, why) => {
            terminal.error(&format!("stopped: {why}"));
            if missed > 0 && !args.count_overruns {
                terminal.report(&format!(
                    "  {missed} ticks were missed: this host was too late, and a drive that hears nothing stops.\n  \
                     With simulated drives: --fast, or --count-overruns; `fric doctor` says what would help\n"
                ));
            }
            End::Stopped
        }
    };
    match (written, log) {
        (Ok(Some(summary)), Some(path)) if summary.bytes > 0 && !args.quiet => {
            terminal.line(&format!("  wrote {}", summary.words(&path)));
        }
        (Err(error), path) => {
            let path = path.map_or(String::new(), |path| path.display().to_string());
            terminal.error(&format!("the log {path} is not whole: {error}"));
            if code == End::Fine {
                code = End::Failed;
            }
        }
        (Ok(None), _) if !args.quiet => terminal.line("  no log: it ended before there was anything to keep"),
        (Ok(Some(_)), _) if !args.quiet => {
            terminal.line("  no log: --no-log keeps the last ten seconds, and only where safety stops the rig");
        }
        (Ok(_), _) => {}
    }
    code
}

/// Displays the gauges, several times a second, until the run ends.
fn view(gauges: &Gauges, rig: &Rig, over: &AtomicBool) {
    let mut terminal = Terminal::new();
    let names: Vec<String> = (rig.outputs.iter())
        .map(|output| words::signal(rig, output.signal))
        .chain(rig.record.iter().map(|series| series.label.clone()))
        .collect();
    let width = names.iter().map(String::len).max().unwrap_or(0);
    let mut lines = 0;
    loop {
        let last = over.load(Ordering::Relaxed);
        let number = |gauge: &std::sync::atomic::AtomicU64| gauge.load(Ordering::Relaxed);
        let micro = |ns: u64| quantity::significant(ns as f64 * 1e-3, 3);
        let mut text = format!(
            "\x1b[2K  {:<32} {:>9.3} s   late {} µs, at most {} µs   {} missed{}\n",
            gauges.stage.get().to_string(),
            number(&gauges.cycles) as f64 * rig.period_ns as f64 * 1e-9,
            micro(number(&gauges.late_ns)),
            micro(number(&gauges.late_ns_max)),
            number(&gauges.missed),
            parts::warning(number(&gauges.log_free)).map_or(String::new(), |warning| format!("   {warning}")),
        );
        for (i, (name, gauge)) in names.iter().zip(&gauges.values).enumerate() {
            let si = f64::from_bits(number(gauge));
            let shown = match i.checked_sub(rig.outputs.len()) {
                Some(k) => quantity::show(si, &rig.record[k].unit, 4),
                None => quantity::significant(si, 4),
            };
            text += &format!("\x1b[2K    {name:<width$}  {shown}\n");
        }
        let up = if lines > 0 { format!("\x1b[{lines}A") } else { String::new() };
        lines = names.len() + 1;
        terminal.print(&(up + &text));
        if last {
            return;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}
