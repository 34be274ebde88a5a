//! Rows on an even grid agree with the run: grids of different intervals agree to the bit at common instants, measures
//! at these instants agree, and rows of fixed steps are its steps. `FRIC_SEED`, `FRIC_RUNS` (default 40).

mod support;

use compiler::ir::random::Random;
use compiler::{Case, Changes, Options};
use runtime::engine::even_grid;
use runtime::engine::{Continue, run};
use support::{Texts, number};

fn compiled(text: &str) -> Case {
    let mut loaded = compiler::load("a.fric", text, &Texts::default());
    let options = Options { changes: Changes::default(), interpret: true };
    let cases = compiler::compile(&mut loaded, &Texts::default(), "e", &options, &mut Vec::new(), &mut |_| ());
    cases.unwrap_or_else(|found| panic!("{found:#?}\n{text}")).remove(0)
}

fn rows(case: &Case, every: f64) -> Vec<Vec<f64>> {
    let grid = even_grid::instants(every, &case.experiment).unwrap_or_else(|why| panic!("{why}"));
    let go_on = &mut |_| Continue::Continue(());
    let (recording, result) = even_grid::record(case.instance.clone(), &case.experiment, &grid, go_on);
    result.unwrap_or_else(|failure| panic!("{failure}"));
    recording.rows().map(<[f64]>::to_vec).collect()
}

/// `record` writes what a plot of the same quantities would, and changes no bit of the run.
///
/// Mutant tried by hand: the window of a plot cuts the data although something is recorded (case 0 of seed 1).
#[test]
fn what_is_recorded_is_what_a_plot_shows() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(40));
    let mut random = Random(seed);
    for number in 0..runs {
        let contact = ["KFM()", "Karnopp()", "LuGre(vd = 10 mm/s)", "Dahl()"][random.below(4)];
        let solver = ["adaptive", "expo step 1 ms", "expo step 0.5 ms"][random.below(3)];
        let every = [1e-3, 2e-3, 5e-3][random.below(3)];
        let text = |statements: &str| {
            format!(
                "import std.friction\nimport std.bench
experiment e {{
  run SpringBench(fr = {contact}) for 1 s
  solver {solver}
  {statements}
  expect final(x) < 1 km
}}
"
            )
        };
        let quantities = ["x", "v", "F", "fr.F", "2 * v"];
        let chosen: Vec<&str> = quantities.iter().filter(|_| random.below(3) > 0).copied().chain(["F + 1 N"]).collect();
        let list = chosen.join(", ");
        let plotted = compiled(&text(&format!("plot {list}")));
        let recorded =
            compiled(&text(&format!("record {list} every {every} s\n  plot {} after 0.5 s before 0.6 s", chosen[0])));
        let place = format!("seed {seed}, case {number}: {list}, {contact}, {solver}");
        assert_eq!(recorded.experiment.every, Some(every), "{place}");
        let (wanted, found) = (rows(&plotted, every), rows(&recorded, every));
        assert_eq!(wanted.len(), found.len(), "{place}");
        let bits = |rows: &[Vec<f64>]| rows.iter().flatten().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&wanted), bits(&found), "{place}");
        // The run itself: its end, and its rows at each step, also outside of the plot.
        let [(ends, all), (same_ends, same)] = [&plotted, &recorded].map(|case| {
            let outcome = run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(()));
            let outcome = outcome.unwrap_or_else(|failure| panic!("{failure}: {place}"));
            let rows: Vec<Vec<f64>> = outcome.recording.rows().map(<[f64]>::to_vec).collect();
            (format!("{:?}", outcome.finals), bits(&rows))
        });
        assert_eq!(ends, same_ends, "{place}");
        assert!(all == same, "the rows of the run differ: {place}");
    }
}

/// A row at a tick has the values after it, by any solver: what a block counts at its ticks is the number of the last tick
/// up to the row.
///
/// Mutant tried by hand: the rows of an adaptive run at the end of a step come before its tick (case 4 of seed 1).
#[test]
fn a_row_at_a_tick_has_what_the_tick_computed() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(40));
    let mut random = Random(seed);
    for number in 0..runs {
        // In µs, so that neither periods nor rows are whole numbers of doubles.
        let period = [100, 300, 700, 1000, 2500][random.below(5)];
        let every = [period, 3 * period, 100, 250, 900][random.below(5)];
        let duration = every * (5 + random.below(40));
        let solver = ["adaptive", "adaptive tol 1e-9", "expo step 50 us", "rk4 step 50 us"][random.below(4)];
        let text = format!(
            "model Counter {{
  output n [1]
  state  k [1] = 0
  every {period} us {{
    n = k
    next(k) = k + 1
  }}
}}
model M {{
  part   c = Counter()
  state  x [m] = 0
  dx/dt = 1 m/s - x / 0.02 s
  output y [1] = c.n + 1
}}
experiment e {{
  run    M() for {duration} us
  solver {solver}
  record c.n, y, x every {every} us
  expect final(x) < 1 km
}}
"
        );
        for (k, row) in rows(&compiled(&text), every as f64 * 1e-6).iter().enumerate() {
            let ticks = (k * every / period) as f64;
            let place = format!("seed {seed}, case {number}, {solver}: row {k}, every {every} us, ticks {period} us");
            assert_eq!(&row[row.len() - 3..row.len() - 1], &[ticks, ticks + 1.0], "{place}: {row:?}");
        }
    }
}

/// Mutants tried by hand: rows of fixed steps come one step late (fails in case 0 of seed 1); rows of adaptive runs are
/// the end of the step in place of a point of its polynomial (case 2).
#[test]
fn rows_of_a_grid_agree_with_the_run() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(40));
    let mut random = Random(seed);
    let mut compared = 0;
    for number in 0..runs {
        let contact = ["KFM()", "Sticking()", "Karnopp()", "LuGre(vd = 10 mm/s)", "Dahl()", "GMS()"][random.below(6)];
        let bench = match random.below(2) {
            0 => format!("ForceBench(fr = {contact}, u = sine({} N, 0.7 Hz))", random.within(1.0, 3.0)),
            _ => format!("SpringBench(fr = {contact}, k = {} N/m)", random.within(1.0, 20.0)),
        };
        let solver = ["adaptive", "adaptive tol 1e-9", "expo step 1 ms", "expo step 0.5 ms"][random.below(4)];
        let every = [1e-3, 2e-3, 5e-3, 0.01, 0.02][random.below(5)];
        let at: Vec<u64> = (0..3).map(|_| 1 + random.below((1.0 / every) as usize - 1) as u64).collect();
        let expects: Vec<String> = at.iter().map(|k| format!("  expect at(x, {k} * {every} s) < 1 km\n")).collect();
        let text = format!(
            "import std.friction\nimport std.bench
experiment e {{
  run {bench} for 1 s
  solver {solver}
  plot x, v, F
{}}}
",
            expects.concat()
        );
        let place = format!("seed {seed}, case {number}, every {every} s\n{text}");
        let case = compiled(&text);
        let fine = rows(&case, every);
        assert_eq!(fine.len() as f64, (1.0 / every).round() + 1.0, "{place}");
        assert!(fine.iter().enumerate().all(|(k, row)| (row[0] - k as f64 * every).abs() < 1e-12), "{place}");
        for times in [2, 5] {
            for (k, row) in rows(&case, every * times as f64).iter().enumerate() {
                let same = row[1..].iter().zip(&fine[k * times][1..]).all(|(a, b)| a.to_bits() == b.to_bits());
                assert!(same, "row {k} of a grid {times} times as coarse: {row:?} and {:?}, {place}", fine[k * times]);
                compared += 1;
            }
        }
        let outcome = run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(())).unwrap();
        for (k, verdict) in at.iter().zip(&outcome.verdicts) {
            let (read, row) = (verdict.readings[0].value, fine[*k as usize][1]);
            assert!((read - row).abs() <= 1e-12 * row.abs().max(1e-3), "row {k}: {row}, measured {read}, {place}");
        }
        if !solver.starts_with("adaptive") {
            // Each is a row of the recording of all steps.
            let all: Vec<Vec<f64>> = outcome.recording.rows().map(<[f64]>::to_vec).collect();
            for row in &fine {
                let step = all.iter().find(|step| (step[0] - row[0]).abs() < 1e-9);
                assert!(step.is_none_or(|step| step[1..] == row[1..]), "{row:?} and {step:?}, {place}");
            }
        }
    }
    println!("seed {seed}: {runs} runs, {compared} rows met");
}
