//! Measures against their definitions, over drawn experiments with printed seeds: `slope` against the difference of
//! the quantity, `count` and `duration` against a count over the recording. `FRIC_SEED`, `FRIC_RUNS` (default 60).

mod support;

use compiler::ir::random::Random;
use compiler::{Changes, Options};
use runtime::engine::{Continue, Outcome, run};
use support::Texts;

fn ran(text: &str) -> Result<Outcome, String> {
    let mut loaded = compiler::load("a.fric", text, &Texts::default());
    let options = Options { changes: Changes::default(), interpret: true };
    let cases = compiler::compile(&mut loaded, &Texts::default(), "e", &options, &mut Vec::new(), &mut |_| ());
    let case = cases.map_err(|found| format!("{found:#?}"))?.remove(0);
    run(case.instance, &case.experiment, &mut |_| Continue::Continue(())).map_err(|failure| failure.to_string())
}

fn of_environment(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|value| value.parse().ok()).unwrap_or(otherwise)
}

/// A smooth expression of pure numbers over the states x and y, the time and a parameter.
fn expression(random: &mut Random, depth: u32) -> String {
    if depth == 0 {
        let leaves = ["m.x", "m.y", "(t / 1 s)", "m.p", "m.both", "2", "sine(1, 0.7 Hz)"];
        return leaves[random.below(leaves.len())].into();
    }
    let mut sub = || expression(random, depth - 1);
    let (a, b) = (sub(), sub());
    match random.below(20) {
        0..=2 => format!("({a} + {b})"),
        3 | 4 => format!("({a} - {b})"),
        5 | 6 => format!("({a} * {b})"),
        7 => format!("({a} / (2 + ({b})^2))"),
        8 => format!("tanh({a})"),
        9 => format!("sin({a})"),
        10 => format!("exp(-({a})^2)"),
        11 => format!("sqrt(1 + ({a})^2)"),
        12 => format!("log(1 + ({a})^2)"),
        13 => format!("atan2({a}, 3 + cos({b}))"),
        14 => format!("abs({a})"),
        15 => format!("max({a}, {b})"),
        16 => format!("clamp({a}, -0.5, 0.7)"),
        17 => format!("(1 + ({a})^2)^1.5"),
        18 => format!("hypot({a}, 1 + ({b})^2)"),
        _ => format!("atan({a})"),
    }
}

/// ∫ slope(f) dt = f(end) − f(start).
#[test]
fn a_slope_adds_up_to_the_difference() {
    let (seed, runs) = (of_environment("FRIC_SEED", 1), of_environment("FRIC_RUNS", 60));
    let mut random = Random(seed);
    let (mut compared, mut moving) = (0, 0);
    while compared < runs {
        let f = expression(&mut random, 1 + compared as u32 % 3);
        let text = format!(
            "model Inner {{
  param p = 0.7
  state x = 0.2
  state y = 1
  dx/dt = y / 1 s
  dy/dt = (-x - 0.1 * y + p * sin(t / 1 s)) / 1 s
  output both = x * y + p
}}
model Whole {{ part m = Inner() }}
experiment e {{
  run Whole() for 3 s
  solver adaptive tol 1e-9
  expect integral(slope({f})) == 0
  expect final({f}) - at({f}, 0 s) == 0
  expect max(abs({f})) >= 0
}}
"
        );
        let outcome = ran(&text).unwrap_or_else(|why| panic!("seed {seed}, case {compared}: {why}\n{text}"));
        let reading = |k: usize, j: usize| outcome.verdicts[k].readings[j].value;
        let (sum, difference, size) = (reading(0, 0), reading(1, 0) - reading(1, 1), reading(2, 0));
        assert!(
            (sum - difference).abs() <= 2e-6 * (1.0 + size),
            "seed {seed}, case {compared}: {sum} and {difference}\n{text}"
        );
        compared += 1;
        moving += u64::from(difference.abs() > 1e-3);
    }
    println!("seed {seed}: {compared} expressions, {moving} of them end elsewhere");
    assert!(moving * 2 > compared, "{moving} of {compared} change: nothing is tested");
}

/// Phases and time of a condition, as the rows of a recording show them.
#[test]
fn phases_are_those_of_the_recording() {
    let (seed, runs) = (of_environment("FRIC_SEED", 1), of_environment("FRIC_RUNS", 60) / 3);
    let mut random = Random(seed);
    let mut phases = 0;
    for case in 0..runs {
        let contact = ["KFM()", "Sticking()", "Karnopp()", "GMS()", "Dahl()"][random.below(5)];
        let (size, frequency) = (random.within(1.0, 3.0), random.within(0.2, 2.0));
        let condition = ["v > 0", "abs(v) < 10 mm/s", "F > 0.5 N", "v * F > 0.1 W"][random.below(4)];
        let solver = ["adaptive", "adaptive tol 1e-8", "expo step 1 ms", "expo step 0.2 ms"][random.below(4)];
        let text = format!(
            "import std.friction\nimport std.bench
experiment e {{
  run ForceBench(fr = {contact}, u = sine({size} N, {frequency} Hz)) for 3 s
  solver {solver}
  plot {condition}
  expect count({condition}) >= 0
  expect duration({condition}) >= 0 s
  expect duration(not ({condition})) >= 0 s
}}
"
        );
        let outcome = ran(&text).unwrap_or_else(|why| panic!("seed {seed}, case {case}: {why}\n{text}"));
        let reading = |k: usize| outcome.verdicts[k].readings[0].value;
        let rows: Vec<(f64, f64)> = outcome.recording.rows().map(|row| (row[0], row[1])).collect();
        let begun = u64::from(rows[0].1 != 0.0);
        let count = begun + rows.windows(2).filter(|two| two[0].1 == 0.0 && two[1].1 != 0.0).count() as u64;
        let time: f64 = rows.windows(2).filter(|two| two[0].1 != 0.0).map(|two| two[1].0 - two[0].0).sum();
        let place = format!("seed {seed}, case {case}:\n{text}");
        assert_eq!(reading(0), count as f64, "phases, {place}");
        assert!((reading(1) - time).abs() < 1e-9, "{} s and {time} s, {place}", reading(1));
        assert!((reading(1) + reading(2) - 3.0).abs() < 1e-9, "the times of a condition and its reverse, {place}");
        phases += count;
    }
    println!("seed {seed}: {runs} runs, {phases} phases");
    assert!(phases > runs, "{phases} phases in {runs} runs: nothing is tested");
}
