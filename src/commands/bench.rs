//! `fric bench`: the cost of a step of an experiment, alone, in lanes and on all cores, and the compile time.

use super::{End, compiled, has_experiment, load, reported};
use crate::args::Bench;
use crate::compile::{self, Method, Options, Stages, Stopwatch};
use crate::quantity::{count, duration, significant};
use crate::terminal::Terminal;
use abi::lanes::{Batch, Lanes};
use abi::{Instance, Slot};
use serde_json::json;
use std::time::{Duration, Instant};

/// Most steps between two readings of the clock.
const STEPS: u64 = 20_000;
/// Duration of each measurement.
const MEASURED: Duration = Duration::from_millis(400);

pub fn bench(args: &Bench, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load(&args.file, terminal, &mut watch) else { return End::Failed };
    let before = watch.stop();
    let all: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    if let Err(message) = has_experiment(&args.file, &args.experiment, &all) {
        terminal.error(&message);
        return End::Failed;
    }
    let changes = args.stepped.changes();
    let options = Options { changes: changes.clone(), interpret: false };
    let Ok((mut cases, stages)) = compiled(&mut loaded, &args.experiment, &options, &before, false, terminal) else {
        return End::Failed;
    };
    let case = cases.remove(0);
    let solver = case.experiment.solver;
    if let Some(why) = args.stepped.without_effect(&args.experiment, solver.method) {
        terminal.error(&why);
        return End::Misused;
    }
    if solver.method == Method::Adaptive {
        terminal.error("an adaptive run has no fixed step to time; choose one with --solver, such as --solver expo");
        return End::Misused;
    }
    let built = match compile::build(&mut loaded, &crate::disk::Disk, &args.experiment, &changes, &mut Vec::new()) {
        Ok(built) => built,
        Err(diagnostics) => {
            reported(&loaded, &diagnostics, terminal);
            return End::Failed;
        }
    };
    let step = compile::step_code(&built, solver.method);
    let mut start = case.instance;
    let status = start.start(solver.step);
    let steps = ((case.experiment.duration / solver.step).round() as u64).clamp(1, STEPS);
    if status != 0 || start.clone().advance(steps) != 0 {
        terminal.error("the experiment leaves a range within its first steps; `fric run` says which");
        return End::Failed;
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let alone = measured(|| alone(&start, steps));
    let lanes = step.lanes.as_ref().ok().map(|lanes| (lanes, measured(|| in_lanes(lanes, &start, steps))));
    let everywhere = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores)
            .map(|_| {
                scope.spawn(|| match &step.lanes {
                    Ok(lanes) => measured(|| in_lanes(lanes, &start, steps)),
                    Err(_) => measured(|| self::alone(&start, steps)),
                })
            })
            .collect();
        threads.into_iter().map(|thread| 1.0 / thread.join().expect("a measurement does not panic")).sum::<f64>()
    });
    if args.json {
        let stages: serde_json::Map<String, serde_json::Value> =
            stages.0.iter().map(|(name, seconds)| ((*name).to_string(), json!(seconds))).collect();
        terminal.line(
            &json!({
                "experiment": args.experiment,
                "solver": solver.method.name(),
                "step": solver.step,
                "operations": step.operations,
                "bytes": step.bytes,
                "critical_path_cycles": step.critical_path,
                "ns_per_step": 1e9 * alone,
                "steps_per_second": 1.0 / alone,
                "lanes": lanes.as_ref().map(|(lanes, seconds)| json!({
                    "code": lanes.name(), "instances": lanes.width(),
                    "ns_per_step": 1e9 * seconds, "steps_per_second": 1.0 / seconds,
                })),
                "no_lanes": step.lanes.as_ref().err(),
                "cores": cores,
                "steps_per_second_all_cores": everywhere,
                "compile_seconds": stages,
            })
            .to_string(),
        );
        return End::Fine;
    }
    tell(args, &solver, &step, alone, lanes, cores, everywhere, &stages, terminal);
    End::Fine
}

#[allow(clippy::too_many_arguments)]
fn tell(
    args: &Bench,
    solver: &abi::plan::Solver,
    step: &compile::StepCode,
    alone: f64,
    lanes: Option<(&Lanes, f64)>,
    cores: usize,
    everywhere: f64,
    stages: &Stages,
    terminal: &mut Terminal,
) {
    let rate = |per_second: f64| format!("{} million steps a second", significant(1e-6 * per_second, 3));
    terminal.line(&format!("{}, {} of {}", args.experiment, solver.method.name(), duration(solver.step, 3)));
    terminal.line(&format!(
        "  a step: {} operations, {} bytes, longest chain about {} cycles",
        count(step.operations as u64),
        count(step.bytes as u64),
        step.critical_path
    ));
    terminal.line(&format!("  one instance: {} ns a step, {}", significant(1e9 * alone, 3), rate(1.0 / alone)));
    match (lanes, &step.lanes) {
        (Some((lanes, seconds)), _) => terminal.line(&format!(
            "  {} instances in lanes ({}), one core: {} ns a step of each, {}",
            lanes.width(),
            lanes.name(),
            significant(1e9 * seconds, 3),
            rate(1.0 / seconds)
        )),
        (None, Err(why)) => terminal.line(&format!("  no lanes: {why}")),
        (None, Ok(_)) => {}
    }
    terminal.line(&format!("  all {cores} cores: {}", rate(everywhere)));
    let parts: Vec<String> =
        stages.0.iter().map(|(name, seconds)| format!("{name} {}", duration(*seconds, 3))).collect();
    terminal.line(&format!("  compiled in {}: {}", duration(stages.total(), 3), parts.join(", ")));
}

/// The median over rounds of the result of `round`, in seconds per step of one instance.
fn measured(mut round: impl FnMut() -> f64) -> f64 {
    let begin = Instant::now();
    let mut times = vec![round()];
    while begin.elapsed() < MEASURED {
        times.push(round());
    }
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn alone(start: &Instance, steps: u64) -> f64 {
    let mut instance = start.clone();
    let begin = Instant::now();
    instance.advance(steps);
    begin.elapsed().as_secs_f64() / steps as f64
}

fn in_lanes(lanes: &Lanes, start: &Instance, steps: u64) -> f64 {
    let mut batch = Batch::new(lanes.clone());
    for lane in 0..batch.width() {
        batch.load(lane, start.block());
    }
    let begin = Instant::now();
    let done = batch.advance(&start.description().pool, steps);
    let seconds = begin.elapsed().as_secs_f64();
    assert_eq!(batch.get(Slot::COUNT, 0) as u64, start.get(Slot::COUNT) as u64 + done, "every step counts");
    seconds / (done.max(1) * batch.width() as u64) as f64
}
