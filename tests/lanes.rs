//! Runs in lanes are bit-identical to single runs: measures, final values, numbers of steps and reasons to stop, for
//! any solver, any frequency of callbacks, and any runs in the other lanes.

mod support;

use abi::description::Kind;
use abi::plan::{Method, Steps};
use compiler::experiment::vary::{PreparedRun, Varying};
use compiler::ir::random::Random;
use compiler::{Case, Changes, Options};
use runtime::engine::lanes::{self, Next};
use runtime::engine::{self, Continue, Failure, Outcome};
use support::{Texts, number};

const TEXT: &str = r#"
import std.interfaces
import std.friction
import std.control
import std.plant

model Pull {
  param  speed = 0.1 m/s
  state  x [m]   = 0
  state  v [m/s] = 0 in -0.6 m/s .. 0.6 m/s
  let    spring = 2 N/m * (speed * t - x)
  part   fr : Friction = LuGre(v = v, F_ext = spring)
  dx/dt = v
  dv/dt = (spring - fr.F) / 1 kg
  output power [W] = fr.F * v
}
model Sampled {
  param  Kp = 20 N/m
  state  x [m]   = 0
  state  v [m/s] = 0
  state  u [N]   = 0
  part   fr : Friction = LuGre(v = v, F_ext = u)
  every 10 ms { next(u) = Kp * (sin(t / 1 s) * 1 m - x) - 5 N·s/m * v }
  dx/dt = v
  dv/dt = (u - fr.F) / 1 kg
}

experiment last    { run Pull() for 10 s  expect final(x) > 0 m }
experiment measured { run Pull() for 10 s  expect max(v) > 0 m/s  expect mean(power) > 0 W after 2 s }
experiment many {
  run Pull() for 10 s
  expect max(v) > 0 m/s after 2 s
  expect min(fr.F) < 1 N
  expect time(max(v)) > 0 s
  expect rms(v) > 0 m/s
  expect rms(fr.F) > 0 N before 7 s
  expect integral(power) > 0 J
  expect period(v) > 0 s
  expect max(x) > 0 m before first(v > 0.1 m/s)
}
experiment counted { run Pull() for 10 s  expect count(v > 0.1 m/s) >= 0  expect max(x) > 0 m }
experiment regimes { run Pull(fr = Karnopp()) for 10 s  expect max(x) > 0 m }
experiment narrow  { run Pull(fr = Karnopp(Dv = 1 um/s, Fv = 0 N·s/m)) for 20 s  expect final(x) > 0 m }
experiment held    { run Pull(fr = KFM()) for 10 s  expect final(x) > 0 m }
experiment sampled { run Sampled() for 2 s  expect final(x) > -10 m }
"#;

/// The experiment with this solver, with one parameter variable.
fn varying(experiment: &str, path: &str, solver: Option<(Method, f64)>) -> Varying {
    let mut loaded = compiler::load("lanes.fric", TEXT, &Texts::default());
    let (method, step) = solver.unzip();
    let changes = Changes { vary: vec![path.into()], method, step, any_step: true, ..Changes::default() };
    let options = Options { changes, interpret: false };
    let cases = compiler::varying(&mut loaded, &Texts::default(), experiment, &options, &mut Vec::new());
    cases.unwrap_or_else(|found| panic!("{experiment}: {found:?}")).remove(0)
}

fn go_on(_: f64) -> Continue {
    Continue::Continue(())
}

/// `runs` runs with values from `low` on; returns how many failed.
fn compare(varying: &Varying, path: &str, runs: usize, low: f64, by: f64) -> usize {
    let values: Vec<f64> = (0..runs).map(|k| low + by * k as f64).collect();
    in_lanes_and_alone(varying, path, &values).iter().filter(|outcome| outcome.is_err()).count()
}

/// A run with each of these values, in SI: together in lanes, and each alone; the results must agree to the bit.
fn in_lanes_and_alone(varying: &Varying, path: &str, values: &[f64]) -> Vec<Result<Outcome, Failure>> {
    let runs = values.len();
    let slot = varying.param(path).expect("it is a parameter").slot;
    let fitted = |k: usize| varying.at(&[(slot, values[k])]).expect("the values fit");
    let lanes = varying.lanes().expect("this processor has lanes, and so has the model");
    let mut found: Vec<Option<Result<Outcome, Failure>>> = vec![None; runs];
    let mut left = 0..runs;
    let mut put_off = false;
    let mut next = |busy: bool| {
        // Sometimes no run is available yet.
        put_off = busy && !put_off;
        if put_off {
            return Next::Later;
        }
        left.next().map_or(Next::Nothing, |k| {
            let PreparedRun { instance, experiment } = fitted(k);
            Next::Run(k, Box::new((instance, experiment)))
        })
    };
    lanes::run(lanes, &mut next, &mut |k: usize, outcome| found[k] = Some(outcome), &mut go_on);
    let mut all = Vec::with_capacity(runs);
    for (k, found) in found.into_iter().enumerate() {
        let found = found.unwrap_or_else(|| panic!("run {k} came to nothing"));
        let PreparedRun { instance, experiment } = fitted(k);
        let alone = engine::run(instance, &experiment, &mut go_on);
        assert_eq!(found, alone, "run {k} of `{}`, {path} = {}", varying.label, values[k]);
        all.push(found);
    }
    all
}

/// An initial value that varies from lane to lane equals one given with `--set`, to the bit: states of all kinds, all
/// methods.
///
/// Mutants tried by hand, each fails with seed 1: every run of a sweep starts where the first one does (`fit`); the
/// initial value stays as written although it is varied; sampled states cannot be varied (`starts::open`).
#[test]
#[cfg_attr(not(target_arch = "x86_64"), ignore = "lanes are for x86-64")]
fn start_values_share_their_lanes() {
    let (seed, draws) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(16));
    let mut random = Random(seed);
    let mut apart = 0;
    for draw in 0..draws {
        let experiment = ["last", "measured", "regimes", "held", "sampled"][random.below(5)];
        let method = Method::ALL[random.below(Method::ALL.len())];
        let solver = match method.row().steps {
            Steps::Adaptive => None,
            Steps::Explicit => Some((method, 1e-4)),
            Steps::Relaxing => Some((method, [1e-3, 5e-4][random.below(2)])),
        };
        let (method, step) = solver.unzip();
        let plain = Changes { method, step, any_step: true, ..Changes::default() };
        let case = compiled(experiment, plain.clone());
        let description = case.instance.description().clone();
        let is_state = |kind| matches!(kind, Kind::State | Kind::SampledState);
        let states: Vec<_> = description.quantities.iter().filter(|q| is_state(q.kind) && !q.boolean).collect();
        let state = states[random.below(states.len())];
        let (low, high) = state.range;
        let size = if (high - low).is_finite() { 0.4 * (high - low) } else { 0.3 };
        let unit = if state.unit.text == "1" { "" } else { &state.unit.text };
        let numbers: Vec<f64> = (0..20).map(|_| state.unit.from_si(size * random.within(-1.0, 1.0))).collect();
        let values: Vec<f64> = numbers.iter().map(|number| state.unit.to_si(*number)).collect();
        let place = format!("seed {seed}, draw {draw}: {experiment}, {} by {solver:?}", state.path);
        println!("{place}");
        let outcomes = in_lanes_and_alone(&varying(experiment, &state.path, solver), &state.path, &values);
        let last = |outcome: &Result<Outcome, Failure>| match outcome {
            Ok(outcome) => Ok(outcome.finals.iter().map(|last| last.value.to_bits()).collect::<Vec<u64>>()),
            Err(failure) => Err(failure.to_string()),
        };
        for (k, found) in outcomes.iter().enumerate().step_by(7) {
            let set = vec![format!("{}={:e} {unit}", state.path, numbers[k])];
            let case = compiled(experiment, Changes { set, ..plain.clone() });
            let by_set = engine::run(case.instance, &case.experiment, &mut go_on);
            assert_eq!(last(found), last(&by_set), "{place}, start {} {unit}", numbers[k]);
        }
        apart += u64::from(last(&outcomes[0]) != last(&outcomes[7]));
    }
    println!("seed {seed}: {draws} drawn, {apart} with other ends");
    assert!(apart * 2 > draws, "{apart} of {draws} start values matter: nothing is tested");
}

/// The only case of an experiment.
fn compiled(experiment: &str, changes: Changes) -> Case {
    let mut loaded = compiler::load("lanes.fric", TEXT, &Texts::default());
    let options = Options { changes, interpret: false };
    let cases = compiler::compile(&mut loaded, &Texts::default(), experiment, &options, &mut Vec::new(), &mut |_| ());
    cases.unwrap_or_else(|found| panic!("{experiment}: {found:?}")).remove(0)
}

#[test]
#[cfg_attr(not(target_arch = "x86_64"), ignore = "lanes are for x86-64")]
fn adaptive_runs_share_their_lanes() {
    for (experiment, path) in [
        ("last", "fr.Fs"),
        ("measured", "fr.Fs"),
        ("many", "fr.Fs"),
        ("counted", "fr.Fs"),
        ("regimes", "fr.Fs"),
        ("narrow", "fr.Fs"),
        ("sampled", "Kp"),
    ] {
        let varying = varying(experiment, path, None);
        let failed = compare(&varying, path, 30, if path == "Kp" { 15.0 } else { 1.1 }, 0.02);
        assert_eq!(failed, 0, "{experiment}");
    }
}

#[test]
#[cfg_attr(not(target_arch = "x86_64"), ignore = "lanes are for x86-64")]
fn fixed_steps_share_their_lanes() {
    for (experiment, path) in [("last", "fr.Fs"), ("measured", "fr.Fs"), ("regimes", "fr.Fs"), ("sampled", "Kp")] {
        for method in [Method::Expo, Method::Implicit, Method::Rk4] {
            let step = if method == Method::Rk4 { 1e-4 } else { 1e-3 };
            let varying = varying(experiment, path, Some((method, step)));
            compare(&varying, path, 40, if path == "Kp" { 15.0 } else { 1.1 }, 0.02);
        }
    }
}

#[test]
#[cfg_attr(not(target_arch = "x86_64"), ignore = "lanes are for x86-64")]
fn a_run_that_fails_leaves_the_others_alone() {
    for solver in [None, Some((Method::Expo, 1e-3))] {
        for experiment in ["last", "measured"] {
            let varying = varying(experiment, "speed", solver);
            let failed = compare(&varying, "speed", 30, 0.05, 0.02);
            assert!((5..25).contains(&failed), "{experiment}: {failed} of 30 leave the range of v");
        }
    }
}
