//! Runs in lanes are those that each would be alone: measures, final values, numbers of steps and reasons to stop, to the
//! bit, whatever the solver, however often somebody looks, and with whom they share their lanes.

mod support;

use abi::plan::Method;
use compiler::vary::{Fitted, Varying};
use compiler::{Changes, Options};
use runtime::engine::{self, Continue, Failure, Outcome};
use runtime::lanes::{self, Next};
use support::Texts;

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
experiment regimes { run Pull(fr = Karnopp()) for 10 s  expect max(x) > 0 m }
experiment narrow  { run Pull(fr = Karnopp(Dv = 1 um/s, Fv = 0 N·s/m)) for 20 s  expect final(x) > 0 m }
experiment sampled { run Sampled() for 2 s  expect final(x) > -10 m }
"#;

/// The experiment by this solver, with one parameter open.
fn varying(experiment: &str, path: &str, solver: Option<(Method, f64)>) -> Varying {
    let mut loaded = compiler::load("lanes.fric", TEXT, &Texts::default());
    let (method, step) = solver.unzip();
    let changes = Changes { vary: vec![path.into()], method, step, ..Changes::default() };
    let options = Options { changes, interpret: false };
    let cases = compiler::varying(&mut loaded, &Texts::default(), experiment, &options, &mut Vec::new());
    cases.unwrap_or_else(|found| panic!("{experiment}: {found:?}")).remove(0)
}

fn go_on(_: f64) -> Continue {
    Continue::Continue(())
}

/// `runs` runs with values from `low` on; returns how many failed.
fn compare(varying: &Varying, path: &str, runs: usize, low: f64, by: f64) -> usize {
    let slot = varying.param(path).expect("it is a parameter").slot;
    let fitted = |k: usize| varying.fit(&[(slot, low + by * k as f64)]).expect("the values fit");
    let lanes = varying.lanes().expect("this processor has lanes, and so has the model");
    let mut found: Vec<Option<Result<Outcome, Failure>>> = vec![None; runs];
    let mut left = 0..runs;
    let mut put_off = false;
    let mut next = |busy: bool| {
        // Now and then there is nothing to do yet.
        put_off = busy && !put_off;
        if put_off {
            return Next::Later;
        }
        left.next().map_or(Next::Nothing, |k| {
            let Fitted { instance, experiment } = fitted(k);
            Next::Run(k, Box::new((instance, experiment)))
        })
    };
    lanes::run(lanes, &mut next, &mut |k: usize, outcome| found[k] = Some(outcome), &mut go_on);
    let mut failed = 0;
    for (k, found) in found.into_iter().enumerate() {
        let found = found.unwrap_or_else(|| panic!("run {k} came to nothing"));
        let Fitted { instance, experiment } = fitted(k);
        let alone = engine::run(instance, &experiment, &mut go_on);
        failed += usize::from(alone.is_err());
        assert_eq!(found, alone, "run {k} of `{}`", varying.label);
    }
    failed
}

#[test]
fn adaptive_runs_share_their_lanes() {
    for (experiment, path) in
        [("last", "fr.Fs"), ("measured", "fr.Fs"), ("regimes", "fr.Fs"), ("narrow", "fr.Fs"), ("sampled", "Kp")]
    {
        if !has_lanes() {
            return;
        }
        let varying = varying(experiment, path, None);
        let failed = compare(&varying, path, 30, if path == "Kp" { 15.0 } else { 1.1 }, 0.02);
        assert_eq!(failed, 0, "{experiment}");
    }
}

#[test]
fn fixed_steps_share_their_lanes() {
    for (experiment, path) in [("last", "fr.Fs"), ("measured", "fr.Fs"), ("regimes", "fr.Fs"), ("sampled", "Kp")] {
        for method in [Method::Expo, Method::Implicit, Method::Rk4] {
            if !has_lanes() {
                return;
            }
            let step = if method == Method::Rk4 { 1e-4 } else { 1e-3 };
            let varying = varying(experiment, path, Some((method, step)));
            compare(&varying, path, 40, if path == "Kp" { 15.0 } else { 1.1 }, 0.02);
        }
    }
}

#[test]
fn a_run_that_fails_leaves_the_others_alone() {
    if !has_lanes() {
        return;
    }
    for solver in [None, Some((Method::Expo, 1e-3))] {
        for experiment in ["last", "measured"] {
            let varying = varying(experiment, "speed", solver);
            let failed = compare(&varying, "speed", 30, 0.05, 0.02);
            assert!((5..25).contains(&failed), "{experiment}: {failed} of 30 leave the range of v");
        }
    }
}

fn has_lanes() -> bool {
    let here = compiler::backend::wide::Width::here().is_some();
    if !here {
        println!("SKIPPED: this processor has no lanes: each run is alone");
    }
    here
}
