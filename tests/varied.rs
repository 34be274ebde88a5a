//! A row of `sweep --vary x=v` equals the run of `run --set x=v`, or both are refused: for everything that a parameter
//! may determine, and for parameters of the library. `FRIC_SEED`, `FRIC_RUNS` (default 40 values of library
//! parameters).

mod support;

use abi::description::Kind;
use abi::plan::Experiment;
use compiler::{Changes, Loaded, Options};
use runtime::engine::{Continue, run};
use support::{Texts, number};

/// Outputs at the end, or none if it failed.
type Ends = Option<Vec<(String, u64)>>;

fn ends(instance: abi::Instance, experiment: &Experiment) -> Ends {
    Some(lasts(&run(instance, experiment, &mut |_| Continue::Continue(())).ok()?))
}

fn lasts(outcome: &runtime::engine::Outcome) -> Vec<(String, u64)> {
    outcome.finals.iter().map(|last| (last.path.clone(), last.value.to_bits())).collect()
}

/// With `--vary`; none if it is refused.
fn varied(loaded: &mut Loaded, name: &str, path: &str, value: f64) -> Ends {
    may_vary(loaded, name, path, value).ok()?
}

/// The same; an error if this parameter cannot be varied at all.
fn may_vary(loaded: &mut Loaded, name: &str, path: &str, value: f64) -> Result<Ends, ()> {
    let changes = Changes { vary: vec![path.into()], ..Changes::default() };
    let options = Options { changes, interpret: false };
    let cases = compiler::varying(loaded, &Texts::default(), name, &options, &mut Vec::new()).map_err(|_| ())?;
    let case = &cases[0];
    let param = case.param(path).ok_or(())?;
    let Ok(fitted) = case.at(&[(param.slot, param.unit.to_si(value))]) else { return Ok(None) };
    let description = fitted.instance.description().clone();
    let Ok(outcome) = run(fitted.instance, &fitted.experiment, &mut |_| Continue::Continue(())) else {
        return Ok(None);
    };
    let watched = &outcome.verdicts[case.expects()..];
    let extremes: Vec<(f64, f64)> =
        watched.iter().map(|verdict| (verdict.readings[0].value, verdict.readings[1].value)).collect();
    match case.left(&description, &extremes) {
        Some(_) => Ok(None),
        None => Ok(Some(lasts(&outcome))),
    }
}

/// With `--set`.
fn set(loaded: &mut Loaded, name: &str, path: &str, value: f64, unit: &str) -> Ends {
    let changes = Changes { set: vec![format!("{path}={value} {unit}")], ..Changes::default() };
    let options = Options { changes, interpret: false };
    let cases = compiler::compile(loaded, &Texts::default(), name, &options, &mut Vec::new(), &mut |_| ()).ok()?;
    let case = cases.into_iter().next()?;
    ends(case.instance, &case.experiment)
}

/// Whether both agree; a sweep may refuse a parameter that is compiled in (`built_in`) although a single run accepts
/// it.
fn compare(text: &str, name: &str, path: &str, value: f64, unit: &str, built_in: bool) {
    let load = || compiler::load("a.fric", text, &Texts::default());
    let (by_vary, by_set) = (varied(&mut load(), name, path, value), set(&mut load(), name, path, value, unit));
    match by_vary {
        None if built_in => {}
        by_vary => assert_eq!(by_vary, by_set, "{path} = {value} {unit}: --vary, then --set\n{text}"),
    }
}

/// Texts in which a parameter p determines something outside the equations, with its values and unit.
const DECIDES: &[(&str, &str, &[f64], &str, bool)] = &[
    (
        "how many parts",
        "model B { output b [1] = 1 }
model A { param p = 3 in 1 .. 10  part q[i in 1 .. p] = B()  output o [1] = sum(q.b) }
experiment e { run A() for 10 ms  expect final(o) > 0 }",
        &[2.0, 3.0, 5.0],
        "",
        true,
    ),
    (
        "how many parts, through another parameter",
        "model B { output b [1] = 1 }
model A { param p = 3 in 1 .. 10  param n = 2 * p  part q[i in 1 .. n] = B()  output o [1] = sum(q.b) }
experiment e { run A() for 10 ms  expect final(o) > 0 }",
        &[2.0, 3.0],
        "",
        true,
    ),
    (
        "a period in fixed steps",
        "model A { param p = 10 ms in 0.1 ms .. 20 ms  state c = 0  every p { next(c) = c + 1 }  output o [1] = c }
experiment e { run A() for 100 ms  solver euler step 1 ms  expect final(o) > 0 }",
        &[0.4, 1.0, 1.5, 2.0, 7.0],
        "ms",
        false,
    ),
    (
        "a period",
        "model A { param p = 10 ms  state c = 0  every p { next(c) = c + 1 }  output o [1] = c }
experiment e { run A() for 100 ms  expect final(o) > 0 }",
        &[-1.0, 0.0, 0.4, 1.5, 7.0],
        "ms",
        false,
    ),
    (
        "the step",
        "model A { param p = 1 ms  state c = 0  state x = 1  dx/dt = -x / (1 s)  every 3 ms { next(c) = c + 1 }  output o [1] = c + x }
experiment e { run A() for 30 ms  solver rk4 step e_step  expect final(o) > 0 }",
        &[1.0, 1.5, 2.0, 0.7],
        "ms",
        false,
    ),
    (
        "a bound",
        "model A { param p = 2  state x = 0 in 0 .. p  dx/dt = 1 / (1 s)  output o [1] = x }
experiment e { run A() for 1 s  expect final(o) > 0 }",
        &[-1.0, 0.5, 3.0],
        "",
        false,
    ),
    (
        "what is required",
        "model A { param p = 2 in > 0  param q = 1  require p >= q  state x = 0  dx/dt = p / (1 s)  output o [1] = x }
experiment e { run A() for 1 s  expect final(o) > 0 }",
        &[0.0, 1e-60, 0.5, 1.0, 3.0],
        "",
        false,
    ),
    (
        "a delay",
        "model A { param p = 2 ms in 1 ms .. 9 ms  state x = 0  dx/dt = (1 - delay(x, p)) / (5 ms)  output o [1] = x }
experiment e { run A() for 40 ms  solver rk4 step 1 ms  expect final(o) > 0 }",
        &[0.5, 1.0, 2.5, 9.0, 10.0],
        "ms",
        false,
    ),
    (
        "an instant of a signal",
        "model A { param p = 20 ms  state x = 0  dx/dt = step(p, 1) / (1 s)  output o [1] = x }
experiment e { run A() for 100 ms  expect final(o) > 0 }",
        &[0.0, 13.7, 250.0],
        "ms",
        false,
    ),
    (
        "a range of an input of a part",
        "model B { param m = 1  input a [1] in 0 .. m  output b [1] = a }
model A { param p = 1  state x = 0  dx/dt = 1 / (1 s)  part q = B(a = x, m = p)  output o [1] = q.b }
experiment e { run A() for 1 s  solver euler step 1 ms  expect final(o) > 0 }",
        &[0.5, 2.0],
        "",
        false,
    ),
    (
        "where a state starts, and another state with it",
        "model A { state p [m] = 1 m in 0 m .. 2 m  state q [m] = 3 * p  dp/dt = -p / (1 s)  dq/dt = p / (1 s)
  output o [1] = (p + 7 * q) / (1 m) }
experiment e { run A() for 1 s  expect final(o) > 0 }",
        &[-1.0, 0.0, 0.5, 1.0, 3.0],
        "m",
        false,
    ),
    (
        "where a sampled state starts that follows from an input",
        "model A { input v [m]  state p [m] = v  every 1 ms { next(p) = p / 2 + v }  output o [1] = p / (1 m) }
experiment e { run A(v = sine(1 m, 1 Hz)) for 100 ms  solver rk4 step 1 ms  expect final(o) > 0 }",
        &[-1.0, 0.0, 2.0],
        "m",
        false,
    ),
];

#[test]
fn vary_and_set_agree_for_everything_a_parameter_determines() {
    for (_, text, values, unit, built_in) in DECIDES {
        // An experiment knows the parameters of what it runs by their names.
        let text = text.replace("e_step", "p");
        for value in *values {
            compare(&text, "e", "p", *value, unit, *built_in);
        }
    }
}

#[test]
fn parameters_of_the_library() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(5), number("FRIC_RUNS").unwrap_or(40));
    let mut random = compiler::ir::random::Random(seed);
    let texts = support::texts_below(&support::root().join("stdlib-models"));
    let (mut compared, mut refused) = (0, 0);
    while compared < runs {
        let (path, text) = &texts[random.below(texts.len())];
        let mut loaded = compiler::load("a.fric", text, &Texts::default());
        let experiments = loaded.experiments();
        if experiments.is_empty() || loaded.has_errors() {
            continue;
        }
        let name = experiments[random.below(experiments.len())].name.clone();
        let options = Options { changes: Changes::default(), interpret: true };
        let Ok(cases) =
            compiler::compile(&mut loaded, &Texts::default(), &name, &options, &mut Vec::new(), &mut |_| ())
        else {
            continue;
        };
        let short = cases[0].experiment.duration <= 3.0 && cases.len() == 1 && cases[0].experiment.bench.is_none();
        let description = cases[0].instance.description().clone();
        let params: Vec<_> = description.quantities.iter().filter(|q| q.kind == Kind::Param && !q.boolean).collect();
        if params.is_empty() || !short {
            continue;
        }
        let param = params[random.below(params.len())];
        let default = param.unit.from_si(cases[0].instance.get(param.slot));
        let value = default * random.within(0.2, 2.0);
        if !value.is_finite() {
            continue;
        }
        compared += 1;
        let unit = param.unit.to_string();
        let fresh = || compiler::load("a.fric", text, &Texts::default());
        let by_vary = may_vary(&mut fresh(), &name, &param.path, value);
        let by_set = set(&mut fresh(), &name, &param.path, value, if unit == "1" { "" } else { &unit });
        refused += u64::from(by_set.is_none());
        // A parameter computed from others cannot be varied, only set.
        let Ok(by_vary) = by_vary else { continue };
        assert_eq!(by_vary, by_set, "seed {seed}: {} {name}, {} = {value} {unit}", path.display(), param.path);
    }
    println!("seed {seed}: {compared} compared, {refused} refused");
    assert!(refused * 2 < compared, "{refused} of {compared} refused: nothing is tested");
}
