//! A sweep cut into units and joined has the bytes of the sweep on one machine: for generated sweeps of all kinds, and
//! random cuts, orders, repetitions, killed units, and processors with narrower vectors. `FRIC_SEED`, `FRIC_RUNS` (default 10 sweeps).

mod support;

use runtime::rng::Chance;
use serde_json::Value;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use support::number;

/// Some values of c make x leave its range, some of k break what is required, some of m their range.
const TEXT: &str = r#"
model Spring {
  input  push [N] = 0 N
  param  k = 20 N/m in > 0
  param  k2 = 1 N/m
  param  c = 0.5 N·s/m
  param  m = 1 kg in 0.5 kg .. 3 kg
  state  x [m]   = 0.1 m in -1 m .. 1 m
  state  v [m/s] = 0
  require k < 80 N/m
  dx/dt = v
  dv/dt = (push - (k + k2) * x - c * v) / m
}
experiment fixed {
  run    Spring() for 1 s
  solver euler step 1 ms
  expect max(x) < 0.2 m
  expect max(x) - min(x) < 0.19 m
  expect max(v) > 0.1 m/s after 0.2 s
}
experiment adaptive {
  run    Spring() for 1 s
  expect rms(v) < 0.4 m/s
  show   final(x) * 2 [mm]
}
experiment cases {
  run    Spring() for 0.5 s
  solver rk4 step 2 ms
  sweep  k2 = 1 N/m, 30 N/m
  expect min(x) < 0 m
}
experiment recorded {
  run    Spring(push = data.u) for 1 s
  data   "push.csv" (t [s], u [N])
  solver euler step 1 ms
  expect max(abs(x)) < 0.15 m
}
"#;

/// What may vary, at most one of each line at once.
const VARIED: [&[&str]; 4] = [
    &["k = 10 N/m .. 90 N/m by 20 N/m", "k = ±20 % lin 4", "k ~ lognormal(40 N/m, 0.5)", "k = 5 N/m .. 50 N/m log 3"],
    &["c = -9 N·s/m, 0.5 N·s/m", "c ~ uniform(-9 N·s/m, 2 N·s/m)"],
    &["m ~ normal(1 kg, 0.4 kg)", "m = 0.4 kg, 1 kg, 3.5 kg", "m ~ ±60 %"],
    &["v = -1 m/s .. 1 m/s lin 3", "x = 0.1 m, 2 m"],
];

/// One after the other: each uses all that the machine has, and the folder of the test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("units-{name}"));
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn fric(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    command.current_dir(folder).args(args).stdin(Stdio::null()).env_remove("SLURM_ARRAY_TASK_ID");
    command.env_remove("JOB_COMPLETION_INDEX").env_remove("FRIC_LANES");
    command
}

/// Values of `FRIC_LANES`: the interpreter, scalar code, and vectors of two, four and eight numbers.
const LANES: [&str; 5] = ["0", "1", "2", "4", "8"];

#[track_caller]
fn ends(command: &mut Command, code: i32) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (out, err) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert_eq!(status.code(), Some(code), "{command:?}\n{out}\n{err}");
    (out, err)
}

#[track_caller]
fn run(folder: &Path, args: &[&str], code: i32) -> (String, String) {
    ends(&mut fric(folder, args), code)
}

fn texts(folder: &Path) {
    fs::write(folder.join("spring.fric"), TEXT).unwrap();
    fs::write(folder.join("push.csv"), "t [s];u [N]\n0;0\n0.3;2\n0.6;-1\n1;0\n").unwrap();
}

/// The options of a random sweep: an experiment, what varies, how often it is drawn, at most so often, and what is set.
fn random_sweep(chance: &mut Chance, most: u64) -> Vec<String> {
    let experiment = ["fixed", "adaptive", "cases", "recorded"][chance.below(4) as usize];
    let mut options = vec![experiment.to_string()];
    let mut drawn = false;
    let (mut varied, joint) = (0, chance.below(5) == 0 && experiment != "cases");
    for (k, line) in VARIED.iter().enumerate() {
        if (joint && k == 0) || chance.below(2) == 0 {
            continue;
        }
        let vary = line[chance.below(line.len() as u64) as usize];
        options.extend(["--vary".into(), vary.into()]);
        drawn |= vary.contains('~');
        varied += 1;
    }
    if joint || (varied == 0 && experiment != "cases") {
        options.extend(["--vary".into(), "k, k2 = 5 N/m, 20 N/m, 85 N/m".into()]);
    }
    if drawn {
        options.extend(["--runs".into(), (1 + chance.below(most)).to_string(), "--seed".into()]);
        options.push(chance.below(1000).to_string());
    }
    if chance.below(4) == 0 {
        options.extend(["--best".into(), "3 by max(x)".into()]);
    }
    if chance.below(4) == 0 {
        options.extend(["--for".into(), "0.7 s".into()]);
    }
    options
}

fn rows_of(table: &Path) -> u64 {
    fs::read(table).unwrap().iter().filter(|byte| **byte == b'\n').count() as u64 - 1
}

/// Random runs that cover all, some of them several times, in random order.
fn random_units(chance: &mut Chance, total: u64) -> Vec<Range<u64>> {
    let mut ends: Vec<u64> = (0..chance.below(4)).map(|_| chance.below(total + 1)).chain([0, total]).collect();
    ends.sort_unstable();
    let mut units: Vec<Range<u64>> = ends.windows(2).map(|pair| pair[0]..pair[1]).collect();
    for _ in 0..chance.below(3) {
        let ends = [chance.below(total + 1), chance.below(total + 1)];
        units.push(ends[0].min(ends[1])..ends[0].max(ends[1]));
    }
    for k in (1..units.len()).rev() {
        units.swap(k, chance.below(k as u64 + 1) as usize);
    }
    units
}

/// Names and bytes of the files of a folder.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let found = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<(String, Vec<u8>)> =
        found.map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), fs::read(path).unwrap())).collect();
    files.sort();
    files
}

#[test]
fn units_joined_have_the_bytes_of_one_machine() {
    let seed = number("FRIC_SEED").unwrap_or(1);
    let (mut failed, mut killed, mut units_made) = (0, 0, 0);
    let sweeps = number("FRIC_RUNS").unwrap_or(10);
    let mut joined_sets = Vec::new();
    for k in 0..sweeps {
        let mut chance = Chance(seed.wrapping_mul(1000) + k);
        let folder = folder(&format!("generated-{k}"));
        texts(&folder);
        let options = random_sweep(&mut chance, 40);
        println!("seed {seed}, sweep {k}: {options:?}");
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        let sweep = |more: &[&'static str]| [&["sweep", "spring.fric"], &options[..], more].concat();
        run(&folder, &sweep(&["-q", "--threads", "1", "--out", "one.csv"]), 0);
        run(&folder, &sweep(&["-q", "--plan", "plan.fricjob"]), 0);
        let one = fs::read(folder.join("one.csv")).unwrap();
        let total = rows_of(&folder.join("one.csv"));
        failed += String::from_utf8(one.clone()).unwrap().lines().filter(|row| !row.ends_with(",ok")).count() - 1;
        // A plan needs nothing else: another folder, and the text gone.
        let elsewhere = folder.join("elsewhere");
        fs::create_dir(&elsewhere).unwrap();
        fs::rename(folder.join("plan.fricjob"), elsewhere.join("plan.fricjob")).unwrap();
        fs::remove_file(folder.join("spring.fric")).unwrap();
        fs::remove_file(folder.join("push.csv")).unwrap();
        let units = random_units(&mut chance, total);
        // Each on a machine of its own, in any order.
        let first = chance.below(5) as usize;
        let made_on = |unit: usize| LANES[(first + unit) % LANES.len()];
        let names: Vec<String> = (0..units.len()).map(|k| format!("{k}.fricunit")).collect();
        for (at, (unit, name)) in units.iter().zip(&names).enumerate() {
            let on_it = |args: &[&str]| {
                let mut command = fric(&elsewhere, args);
                command.env("FRIC_LANES", made_on(at));
                command
            };
            let runs = format!("{}..{}", unit.start, unit.end);
            let threads = (1 + chance.below(3)).to_string();
            let mut args = vec!["sweep", "--unit", &runs, "plan.fricjob", "-o", name, "-q", "--threads", &threads];
            args.extend((chance.below(3) == 0).then_some("--interpret"));
            if chance.below(2) == 0 {
                let mut child = on_it(&args).spawn().unwrap();
                std::thread::sleep(Duration::from_micros(chance.below(150_000)));
                child.kill().unwrap();
                child.wait().unwrap();
                killed += usize::from(!elsewhere.join(name).exists());
            }
            ends(&mut on_it(&args), 0);
            units_made += 1;
            if chance.below(3) == 0 {
                // Again: it is there already.
                let made = fs::metadata(elsewhere.join(name)).unwrap().modified().unwrap();
                run(&elsewhere, &args, 0);
                assert_eq!(fs::metadata(elsewhere.join(name)).unwrap().modified().unwrap(), made);
            }
        }
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        fn join<'a>(parts: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
            [&["sweep", "--join", "plan.fricjob"], parts, more].concat()
        }
        run(&elsewhere, &join(&names, &["-q", "--out", "joined.csv"]), 0);
        assert!(fs::read(elsewhere.join("joined.csv")).unwrap() == one, "{options:?} {units:?}");
        run(&elsewhere, &join(&names, &["-q", "--out", "set"]), 0);
        joined_sets.push((options.iter().map(|one| one.to_string()).collect::<Vec<_>>(), elsewhere.join("set")));
        // Without one of them: its runs, unless others hold them.
        let left_out = chance.below(names.len() as u64) as usize;
        let others = |k: usize| units.iter().enumerate().any(|(at, unit)| at != left_out && unit.contains(&(k as u64)));
        let rest: Vec<&str> = (0..names.len()).filter(|k| *k != left_out).map(|k| names[k]).collect();
        let (out, _) = run(&elsewhere, &join(&rest, &["--missing"]), 0);
        let mut missing = vec![false; total as usize];
        for line in out.lines() {
            let (start, end) = line.split_once("..").unwrap();
            missing[start.parse().unwrap()..end.parse().unwrap()].fill(true);
        }
        assert!((0..total as usize).all(|k| missing[k] != others(k)), "{units:?} without {left_out}: {out}");
    }
    // A dataset has the same files, whether one machine writes it or a join of units.
    for (options, joined) in joined_sets {
        let folder = folder("set");
        texts(&folder);
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        run(&folder, &[&["sweep", "spring.fric"], &options[..], &["-q", "--out", "set/"]].concat(), 0);
        assert!(files(&folder.join("set")) == files(&joined), "{options:?}");
    }
    println!("{units_made} units, {killed} killed before they were written; {failed} runs failed");
    assert!(sweeps < 10 || (failed > 20 && killed > 0), "{failed} failed runs, {killed} killed units");
}

/// Units that are made by the interpreter, by scalar code and in vectors of each width, in one sweep: the bytes of one
/// machine. What each was made in is what was asked for, as far as this processor has it.
#[test]
fn processors_of_all_kinds_make_one_sweep() {
    let folder = folder("kinds");
    texts(&folder);
    let on = |lanes: &str, args: &[&str], code| {
        let mut command = fric(&folder, args);
        ends(command.env("FRIC_LANES", lanes), code)
    };
    let names = LANES.map(|lanes| {
        let (out, _) = on(lanes, &["bench", "spring.fric", "fixed", "--json"], 0);
        let found: Value = serde_json::from_str(&out).unwrap();
        found["lanes"]["code"].as_str().map(str::to_string)
    });
    println!("{names:?}");
    assert_eq!((&names[0], &names[1]), (&None, &None));
    #[cfg(target_arch = "x86_64")]
    for (has, name, lanes) in [
        (std::arch::is_x86_feature_detected!("avx"), "AVX ×", 2),
        (std::arch::is_x86_feature_detected!("avx2"), "AVX2 ×", 3),
        (std::arch::is_x86_feature_detected!("avx512dq"), "AVX-512 ×", 4),
    ] {
        assert!(!has || names[lanes].as_ref().is_some_and(|found| found.starts_with(name)), "{name}: {names:?}");
    }
    for (experiment, keep, out) in
        [("fixed", "rows", "t.csv"), ("adaptive", "rows", "t.parquet"), ("cases", "summary", "t.json")]
    {
        let sweep =
            ["sweep", "spring.fric", experiment, "--vary", VARIED[0][2], "--vary", VARIED[1][1], "--runs", "200", "-q"];
        let sweep = |more: &[&'static str]| [&sweep[..], &["--seed", "3", "--keep", keep], more].concat();
        run(&folder, &sweep(&["--threads", "1", "--out", out]), 0);
        let whole = fs::read(folder.join(out)).unwrap();
        run(&folder, &sweep(&["--plan", "p.fricjob"]), 0);
        let mut units = Vec::new();
        for (k, lanes) in LANES.iter().enumerate() {
            units.push(format!("{k}.fricunit"));
            on(lanes, &["sweep", "--unit", &format!("{k}/5"), "p.fricjob", "-q", "--out", &units[k]], 0);
        }
        let units: Vec<&str> = units.iter().map(String::as_str).collect();
        run(&folder, &[&["sweep", "--join", "p.fricjob"], &units[..], &["-q", "--out", out]].concat(), 0);
        assert!(fs::read(folder.join(out)).unwrap() == whole, "{experiment}");
        units.iter().for_each(|unit| fs::remove_file(folder.join(unit)).unwrap());
    }
    let (_, err) = on("3", &["sweep", "spring.fric", "fixed", "--vary", "k = 1 N/m", "-q"], 2);
    assert!(err.contains("FRIC_LANES=3: the most numbers of a vector are 0 (interpreter)"), "{err}");
}

/// A design gives the runs of a sweep over the same values. A mistake in one is refused with its place, and so is `--on`
/// without Python.
#[test]
fn a_design_gives_the_runs_of_its_rows() {
    let folder = folder("design");
    texts(&folder);
    let mut chance = Chance(number("FRIC_SEED").unwrap_or(1));
    let values: Vec<String> = (0..60).map(|_| format!("{:?}", chance.between(5.0, 79.0))).collect();
    let list = format!("k = {}", values.iter().map(|k| format!("{k} N/m")).collect::<Vec<_>>().join(", "));
    let text: String = values.iter().map(|k| format!("{k}\n")).collect();
    fs::write(folder.join("k.csv"), format!("k [N/m]\n{text}")).unwrap();
    let sweep = |more: &[&str], code| {
        run(&folder, &[&["sweep", "spring.fric", "fixed", "-q", "--threads", "2"], more].concat(), code)
    };
    sweep(&["--vary", &list, "--out", "list.csv"], 0);
    sweep(&["--design", "k.csv", "--out", "design.csv"], 0);
    assert!(fs::read(folder.join("list.csv")).unwrap() == fs::read(folder.join("design.csv")).unwrap());
    // Two columns change together, grids within each row, and a plan holds them.
    fs::write(folder.join("km.csv"), "m [g],k [N/m]\n900,10\n1100,20\n").unwrap();
    let both = ["--design", "km.csv", "--vary", "c = 0 N·s/m, 1 N·s/m"];
    sweep(&[&both[..], &["--out", "km-t.csv"]].concat(), 0);
    let (head, rows) = cells(&folder.join("km-t.csv"));
    assert_eq!(head[..4], ["run", "m [g]", "k [N/m]", "c [N·s/m]"]);
    let varied: Vec<String> = rows.iter().map(|row| row[1..4].join(" ")).collect();
    assert_eq!(varied, ["900 10 0", "900 10 1", "1100 20 0", "1100 20 1"]);
    run(&folder, &[&["sweep", "spring.fric", "fixed", "-q", "--plan", "p"], &both[..]].concat(), 0);
    fs::remove_file(folder.join("km.csv")).unwrap();
    run(&folder, &["sweep", "--unit", "0..4", "p", "-q", "--out", "u"], 0);
    run(&folder, &["sweep", "--join", "p", "u", "-q", "--out", "joined.csv"], 0);
    assert!(fs::read(folder.join("km-t.csv")).unwrap() == fs::read(folder.join("joined.csv")).unwrap());
    for (text, words, code) in [
        ("k [N/m]\n1\nx\n", "the design: line 3: `x` in the column `k [N/m]` is no number", 1),
        ("k [kg]\n1\n", "cannot be a mass", 2),
        ("nix [N]\n1\n", "`nix`", 1),
        ("k [N/m]\n", "it has no rows", 1),
    ] {
        fs::write(folder.join("wrong.csv"), text).unwrap();
        let (out, err) = sweep(&["--design", "wrong.csv"], code);
        assert!((out + &err).contains(words), "{text:?}: {err}");
    }
    let (_, err) = sweep(&["--design", "k.csv", "--vary", "k = 1 N/m, 2 N/m"], 2);
    assert!(err.contains("`k` is varied twice"), "{err}");
    let (_, err) = sweep(&["--design", "k.csv", "--on", "dask://here:8786"], 2);
    assert!(err.contains("pip install 'fric[dask]'"), "{err}");
}

/// Joined to Parquet, with plot and summary; and everything that is refused says why, and leaves a table as it was.
#[test]
fn what_is_no_unit_of_the_plan_is_refused() {
    let folder = folder("refused");
    texts(&folder);
    let sweep = ["sweep", "spring.fric", "fixed", "--vary", "k = 10 N/m .. 60 N/m lin 30"];
    let with = |more: &[&'static str]| [&sweep[..], more].concat();
    run(&folder, &with(&["-q", "--out", "one.parquet", "--plot", "one.svg"]), 0);
    let (whole, _) = run(&folder, &with(&["--out", "one.csv"]), 0);
    let (out, _) = run(&folder, &with(&["--plan", "p.fricjob"]), 0);
    assert!(out.contains("wrote p.fricjob: 30 runs of fixed"), "{out}");
    let (again, _) = run(&folder, &with(&["--plan", "p2.fricjob", "--set", "c=0.6 N·s/m"]), 0);
    assert!(again.contains("30 runs"));
    let unit = |which: &'static str, plan: &'static str, out: &'static str, code| {
        run(&folder, &["sweep", "--unit", which, plan, "--out", out], code)
    };
    let (out, _) = unit("0/2", "p.fricjob", "a", 0);
    assert!(out.contains("wrote a: runs 0..15 in"), "{out}");
    unit("1/2", "p.fricjob", "b", 0);
    unit("1/2", "p2.fricjob", "foreign", 0);
    let join = |parts: &[&'static str], code| {
        run(&folder, &[&["sweep", "--join", "p.fricjob"], parts, &["--out", "t.csv"]].concat(), code)
    };
    fs::write(folder.join("t.csv"), "kept").unwrap();
    let bytes = fs::read(folder.join("b")).unwrap();
    fs::write(folder.join("cut"), &bytes[..bytes.len() / 2]).unwrap();
    let changed = String::from_utf8(bytes.clone()).unwrap().replacen(",ok", ",OK", 1);
    fs::write(folder.join("changed"), changed).unwrap();
    for (parts, words) in [
        (&["a"][..], "15 of 30 runs are in no unit, the first of them 15..30: fric sweep --unit 15..30 p.fricjob"),
        (&["a", "foreign"], "foreign is a unit of another plan"),
        (&["a", "cut"], "rows; remove it and make it again: fric sweep --unit 15..30 p.fricjob --out cut"),
        (&["a", "changed"], "changed is not as it was written"),
        (&["a", "b", "spring.fric"], "spring.fric is no unit of a sweep"),
        (&["a", "b", "nowhere"], "cannot read nowhere"),
        (&["a", "p.fricjob"], "p.fricjob is no unit of a sweep"),
    ] {
        let (_, err) = join(parts, 1);
        assert!(err.contains(words), "{parts:?}: {err}");
    }
    assert_eq!(fs::read(folder.join("t.csv")).unwrap(), b"kept");
    // What is not this unit is not overwritten; a unit that was cut off is made again.
    for name in ["a", "foreign", "spring.fric"] {
        let (_, err) = unit("1/2", "p.fricjob", name, 1);
        assert!(err.contains("it is not the unit of runs 15..30"), "{name}: {err}");
    }
    for name in ["cut", "changed"] {
        unit("1/2", "p.fricjob", name, 0);
        assert!(fs::read(folder.join(name)).unwrap() == bytes, "{name}");
    }
    let (out, _) = unit("1/2", "p.fricjob", "b", 0);
    assert!(out.contains("has its 15 runs already"), "{out}");
    // The same words as after the sweep itself, but for its speed and its name.
    let (joined, _) = join(&["b", "a", "cut"], 0);
    let rest = |text: &str| text.lines().skip(1).map(|line| line.replace("one.csv", "t.csv")).collect::<Vec<_>>();
    assert_eq!(rest(&joined), rest(&whole));
    assert!(joined.starts_with("fixed, euler step 1 ms: 30 runs from 2 units"), "{joined}");
    let to = ["sweep", "--join", "p.fricjob", "a", "b", "-q", "-o", "t.parquet", "--plot", "t.svg"];
    run(&folder, &to, 0);
    for (one, other) in [("one.parquet", "t.parquet"), ("one.svg", "t.svg")] {
        assert!(fs::read(folder.join(one)).unwrap() == fs::read(folder.join(other)).unwrap(), "{one}");
    }
    // Options that the plan holds, and those that mean nothing here.
    for (args, code, words) in [
        ("sweep --unit 0/2 p.fricjob --seed 3", 2, "cannot be used with"),
        ("sweep --unit 2/2 p.fricjob", 2, "numbered from 0/2 to 1/2"),
        ("sweep --unit 0..31 p.fricjob", 2, "the plan has 30 runs"),
        ("sweep --unit %j/2 p.fricjob", 2, "neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX"),
        ("sweep --unit 0/2 spring.fric", 1, "spring.fric is no whole plan of a sweep"),
        ("sweep --unit 0/2 nowhere", 1, "cannot read nowhere"),
        ("sweep --missing p.fricjob", 2, "--join"),
        ("sweep --join p.fricjob a --set k=2N/m", 2, "cannot be used with"),
        ("sweep --join p.fricjob a b --out t.txt", 2, "ends in .csv or .parquet"),
        ("sweep spring.fric", 2, "has fixed, adaptive, cases, recorded"),
        ("sweep spring.fric fixed --plan q --plot q.svg", 2, "cannot be used with"),
    ] {
        let (out, err) = run(&folder, &args.split(' ').collect::<Vec<_>>(), code);
        assert!((out + &err).contains(words), "{args}: {err}");
    }
}

/// The files of a dataset are cut by its runs, are whole or not there, and hold the rows of the table.
#[test]
fn a_dataset_is_resumed_at_its_first_missing_file() {
    let folder = folder("dataset");
    texts(&folder);
    let sweep = ["sweep", "spring.fric", "fixed", "--vary", "m ~ normal(1 kg, 0.2 kg)", "--runs", "700"];
    let with = |more: &[&'static str]| [&sweep[..], &["--for", "0.3 s", "-q"], more].concat();
    let said = |out| run(&folder, &[&sweep[..], &["--for", "0.3 s", "--no-error", "--out", out]].concat(), 0).0;
    let (summary, other) = (said("one.csv"), said("set"));
    let rest = |text: &str| text.lines().skip(1).map(|line| line.replace("one.csv", "set")).collect::<Vec<_>>();
    assert_eq!(rest(&summary), rest(&other), "the summary is that of the table");
    let whole = files(&folder.join("set"));
    let names: Vec<&str> = whole.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["_fric.json", "part-00000000.parquet", "part-00000256.parquet", "part-00000512.parquet"]);
    // As a process leaves it that was killed.
    let asked: serde_json::Value = serde_json::from_slice(&whole[0].1).unwrap();
    let asked: Vec<&str> = asked["asked"].as_array().unwrap().iter().map(|line| line.as_str().unwrap()).collect();
    let begun = folder.join("set/._fric.json.unfinished");
    fs::remove_file(folder.join("set/_fric.json")).unwrap();
    fs::remove_file(folder.join("set/part-00000512.parquet")).unwrap();
    fs::write(&begun, format!("{}\n\n", asked.join("\n"))).unwrap();
    let (_, err) = run(&folder, &with(&["--out", "set"]), 1);
    assert!(err.contains("set holds a sweep that is not finished"), "{err}");
    let first = fs::metadata(folder.join("set/part-00000256.parquet")).unwrap().modified().unwrap();
    run(&folder, &with(&["--out", "set", "--resume"]), 0);
    assert_eq!(fs::metadata(folder.join("set/part-00000256.parquet")).unwrap().modified().unwrap(), first);
    assert!(files(&folder.join("set")) == whole);
    let (_, err) = run(&folder, &with(&["--out", "set", "--resume"]), 1);
    assert!(err.contains("nothing to resume"), "{err}");
    // A smaller one in its place leaves no file of the larger one.
    run(&folder, &["sweep", "spring.fric", "fixed", "--vary", "k = 1 N/m, 2 N/m", "-q", "--out", "set/"], 0);
    assert_eq!(files(&folder.join("set")).len(), 2);
    let (_, err) = run(&folder, &with(&["--out", "set", "--shard", "1/2"]), 2);
    assert!(err.contains("--plan and --unit"), "{err}");
    fs::write(folder.join("file"), "").unwrap();
    let (_, err) = run(&folder, &with(&["--out", "file"]), 1);
    assert!(err.contains("file is a file, and a name without ending is that of a folder"), "{err}");
}

/// A table that was interrupted on one machine is finished by units, and one that was being joined by `--resume`.
#[test]
fn a_table_changes_between_machines_half_way() {
    let folder = folder("half-way");
    texts(&folder);
    let sweep = ["sweep", "spring.fric", "fixed", "--vary", "m ~ normal(1 kg, 0.2 kg)", "--runs", "400", "-q"];
    let with = |more: &[&'static str]| [&sweep[..], more].concat();
    run(&folder, &with(&["--out", "one.csv"]), 0);
    run(&folder, &with(&["--plan", "p"]), 0);
    let one = fs::read(folder.join("one.csv")).unwrap();
    // As a process leaves it that was killed: half of the rows, and what it was asked.
    let mut child = fric(&folder, &with(&["--out", "t.csv", "--threads", "1"])).spawn().unwrap();
    let half = || fs::metadata(folder.join("t.csv")).is_ok_and(|file| file.len() > 0);
    while !half() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    run(&folder, &["sweep", "--unit", "0..400", "p", "--out", "u", "-q"], 0);
    run(&folder, &["sweep", "--join", "p", "u", "--out", "t.csv", "-q"], 0);
    assert!(fs::read(folder.join("t.csv")).unwrap() == one);
    assert!(!folder.join(".t.csv.unfinished").exists());
    // The rows of another sweep that is not finished are kept.
    let other = ["sweep", "spring.fric", "fixed", "--vary", "k = 10 N/m, 20 N/m", "-q", "--plan", "q"];
    run(&folder, &other, 0);
    run(&folder, &["sweep", "--unit", "0..2", "q", "--out", "v", "-q"], 0);
    fs::write(folder.join(".t.csv.unfinished"), "asked for something else\n\n").unwrap();
    let (_, err) = run(&folder, &["sweep", "--join", "q", "v", "--out", "t.csv", "-q"], 1);
    assert!(err.contains("holds a sweep that is not finished"), "{err}");
    assert!(fs::read(folder.join("t.csv")).unwrap() == one);
}

/// The cells of a table, without its head, and the head.
fn cells(table: &Path) -> (Vec<String>, Vec<Vec<String>>) {
    let mut reader = csv::Reader::from_path(table).unwrap();
    let head = reader.headers().unwrap().iter().map(str::to_string).collect();
    let rows = reader.records().map(|row| row.unwrap().iter().map(str::to_string).collect()).collect();
    (head, rows)
}

/// Whether a number was written as this one. The reader may be wrong in the last bit.
fn near(value: &Value, number: f64) -> bool {
    value.as_f64().is_some_and(|value| (value - number).abs() <= 2.0 * f64::EPSILON * number.abs())
}

/// Statistics against the rows that they are of, computed anew. Returns how many quantiles were compared.
fn are_those_of_the_rows(statistics: &[u8], table: &Path) -> usize {
    let (head, rows) = cells(table);
    let found: Value = serde_json::from_slice(statistics).unwrap();
    let titles: Vec<&str> = found["columns"].as_array().unwrap().iter().map(|title| title.as_str().unwrap()).collect();
    assert_eq!(titles, head.iter().map(String::as_str).collect::<Vec<_>>());
    let (mut first, mut compared) = (0, 0);
    let status = head.len() - 1;
    for group in found["groups"].as_array().unwrap() {
        let size = group["runs"].as_u64().unwrap() as usize;
        let own = &rows[first..first + size];
        first += size;
        for (title, value) in group["point"].as_object().unwrap() {
            let k = head.iter().position(|other| other == title).unwrap();
            let same = |row: &Vec<String>| match value {
                Value::String(label) => row[k] == *label,
                value => near(value, row[k].parse().unwrap()),
            };
            assert!(own.iter().all(same), "{title} {value}");
        }
        let ended = group["ended"].as_array().unwrap();
        let all: u64 = ended.iter().map(|one| one["runs"].as_u64().unwrap()).sum();
        assert_eq!(all as usize, size);
        for one in ended {
            let run = one["first"].as_u64().unwrap() as usize;
            assert_eq!(rows[run][status], one["status"].as_str().unwrap());
        }
        let well = own.iter().filter(|row| row[status] == "ok").count() as u64;
        assert_eq!(ended.iter().find(|one| one["status"] == "ok").map_or(0, |one| one["runs"].as_u64().unwrap()), well);
        for (title, verdict) in group["verdicts"].as_object().unwrap() {
            let k = head.iter().position(|other| other == title).unwrap();
            let of = |wanted: &str| own.iter().filter(|row| row[k] == wanted).count() as u64;
            assert_eq!(verdict["held"], of("true"), "{title}");
            assert_eq!(verdict["judged"], of("true") + of("false"), "{title}");
        }
        for (title, measure) in group["measures"].as_object().unwrap() {
            let k = head.iter().position(|other| other == title).unwrap();
            let mut values: Vec<(f64, u64)> =
                own.iter().filter_map(|row| Some((row[k].parse().ok()?, row[0].parse().unwrap()))).collect();
            assert_eq!(measure["number"], values.len(), "{title}");
            assert_eq!(measure["missing"], size - values.len(), "{title}");
            values.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let Some(least) = values.first() else {
                assert!(
                    measure["mean"].is_null() && measure["least"].is_null() && measure["quantiles"]["50 %"].is_null()
                );
                continue;
            };
            assert!(near(&measure["least"]["value"], least.0), "{title}");
            assert_eq!(measure["least"]["run"], least.1, "{title}");
            let lowest: Vec<u64> = values.iter().take(16).map(|value| value.1).collect();
            let kept: Vec<u64> =
                measure["lowest"].as_array().unwrap().iter().map(|row| row[0].as_u64().unwrap()).collect();
            assert_eq!(kept, lowest, "{title}");
            for row in measure["highest"].as_array().unwrap() {
                let run = row[0].as_u64().unwrap() as usize;
                let same = |(cell, text): (&Value, &String)| match cell {
                    Value::Null => text.is_empty(),
                    Value::String(cell) => cell == text,
                    Value::Bool(cell) => cell.to_string() == *text,
                    cell => near(cell, text.parse().unwrap()),
                };
                assert!(row.as_array().unwrap().iter().zip(&rows[run]).all(same), "{row} {:?}", rows[run]);
            }
            let number = values.len() as f64;
            let mean = values.iter().map(|value| value.0).sum::<f64>() / number;
            let square: f64 = values.iter().map(|value| (value.0 - mean) * (value.0 - mean)).sum();
            let deviation = (square / (number.max(2.0) - 1.0)).sqrt();
            let scale = values.iter().fold(0.0, |most: f64, value| most.max(value.0.abs()));
            assert!((measure["mean"].as_f64().unwrap() - mean).abs() <= 1e-12 * scale, "{title}");
            assert!((measure["deviation"].as_f64().unwrap() - deviation).abs() <= 1e-9 * scale, "{title}");
            let bins = measure["histogram"].as_array().unwrap();
            let within = |bin: &Value| {
                let inside = |x: f64| {
                    let [low, high] = [0, 1].map(|k| bin[k].as_f64().unwrap());
                    (low <= x || near(&bin[0], x)) && (x <= high || near(&bin[1], x))
                };
                values.iter().filter(|value| inside(value.0)).count() as u64 >= bin[2].as_u64().unwrap()
            };
            assert!(bins.iter().all(within), "{title}");
            for (percent, quantile) in measure["quantiles"].as_object().unwrap() {
                let part: f64 = percent.strip_suffix(" %").unwrap().parse().unwrap();
                let exact = values[(part / 100.0 * (number - 1.0)).round() as usize].0;
                let found = quantile.as_f64().unwrap();
                assert!((found - exact).abs() <= 1e-3 * exact.abs(), "{title} {percent}: {found} for {exact}");
                compared += 1;
            }
        }
    }
    assert_eq!(first, rows.len());
    compared
}

/// Statistics alone, beside a table of each kind, from units in any order, and after a kill: one file, and what the rows
/// say.
#[test]
fn statistics_have_the_same_bytes_however_they_are_made() {
    let seed = number("FRIC_SEED").unwrap_or(1);
    let (mut compared, mut resumed, mut blocks_made) = (0, 0, 0);
    for k in 0..number("FRIC_RUNS").unwrap_or(10) {
        let mut chance = Chance(seed.wrapping_mul(3000) + k);
        let folder = folder(&format!("statistics-{k}"));
        texts(&folder);
        let mut options = random_sweep(&mut chance, 700);
        if let Some(at) = options.iter().position(|option| option == "--best") {
            options.drain(at..at + 2);
        }
        println!("seed {seed}, sweep {k}: {options:?}");
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        let sweep = |more: &[&'static str]| [&["sweep", "spring.fric", "-q"], &options[..], more].concat();
        run(&folder, &sweep(&["--keep", "both", "--threads", "1", "--out", "rows.csv"]), 0);
        run(&folder, &sweep(&["--out", "plain.csv"]), 0);
        assert!(fs::read(folder.join("plain.csv")).unwrap() == fs::read(folder.join("rows.csv")).unwrap());
        let one = fs::read(folder.join("rows.json")).unwrap();
        compared += are_those_of_the_rows(&one, &folder.join("rows.csv"));
        run(&folder, &sweep(&["--keep", "summary", "--threads", "3"]), 0);
        assert!(fs::read(folder.join("sweep.json")).unwrap() == one, "alone: {options:?}");
        assert!(!folder.join(".sweep.json.blocks").exists() && !folder.join(".sweep.json.unfinished").exists());
        let also = if k % 2 == 0 { "also.parquet" } else { "also" };
        run(&folder, &sweep(&["--keep", "both", "--out", also]), 0);
        assert!(fs::read(folder.join("also.json")).unwrap() == one, "beside {also}: {options:?}");
        let mut child =
            fric(&folder, &sweep(&["--keep", "summary", "--threads", "1", "--out", "killed.json"])).spawn().unwrap();
        std::thread::sleep(Duration::from_micros(chance.below(150_000)));
        child.kill().unwrap();
        child.wait().unwrap();
        let begun = folder.join(".killed.json.unfinished").exists();
        resumed += usize::from(begun);
        let how: &[&'static str] = if begun { &["--resume"] } else { &[] };
        run(&folder, &sweep(&[&["--keep", "summary", "--out", "killed.json"], how].concat()), 0);
        assert!(fs::read(folder.join("killed.json")).unwrap() == one, "resumed: {options:?}");
        // Units count blocks.
        run(&folder, &sweep(&["--keep", "summary", "--plan", "p.fricjob"]), 0);
        let (all, _) = run(&folder, &["sweep", "--join", "p.fricjob", "--missing"], 0);
        let blocks = all.trim().strip_prefix("0..").unwrap().parse().unwrap();
        blocks_made += blocks;
        let units = random_units(&mut chance, blocks);
        let names: Vec<String> = (0..units.len()).map(|k| format!("{k}.fricunit")).collect();
        for (unit, name) in units.iter().zip(&names) {
            let threads = (1 + chance.below(3)).to_string();
            let mut args = vec!["sweep", "--unit"];
            let of = format!("{}..{}", unit.start, unit.end);
            args.extend([of.as_str(), "p.fricjob", "-o", name, "-q", "--threads", &threads]);
            args.extend((chance.below(3) == 0).then_some("--interpret"));
            run(&folder, &args, 0);
        }
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        run(&folder, &[&["sweep", "--join", "p.fricjob", "-q", "-o", "joined.json"], &names[..]].concat(), 0);
        assert!(fs::read(folder.join("joined.json")).unwrap() == one, "{options:?} {units:?}");
    }
    println!("{compared} quantiles, {blocks_made} blocks, {resumed} sweeps resumed");
    assert!(compared > 100 && blocks_made > 20);
}

#[test]
fn what_statistics_cannot_do_is_refused() {
    let folder = folder("statistics-refused");
    texts(&folder);
    let sweep = |options: &str, code| {
        let drawn = ["--vary", "m ~ normal(1 kg, 0.2 kg)", "--runs", "300", "--for", "0.3 s"];
        let args = [&["sweep", "spring.fric", "fixed"], &drawn[..], &options.split(' ').collect::<Vec<_>>()].concat();
        run(&folder, &args, code)
    };
    for (options, words) in [
        ("--keep summary --out t.csv", "the name of statistics ends in .json"),
        ("--out t.json", "statistics without rows are written with --keep summary"),
        ("--keep summary --plot t.svg", "--keep both"),
        ("--keep summary --best 5_by_max(x)", "--best"),
        ("--keep both --shard 1/2", "--plan and --unit"),
        ("--keep sums", "rows, summary, both"),
    ] {
        let (out, err) = sweep(&options.replace("5_by_max(x)", "5 by max(x)"), 2);
        assert!((out + &err).contains(words), "{options}: {err}");
    }
    let many = ["--vary", "k = 1 N/m .. 50 N/m lin 40000", "--vary", "m ~ normal(1 kg, 0.2 kg)", "--keep", "summary"];
    let (_, err) = run(&folder, &[&["sweep", "spring.fric", "fixed"], &many[..]].concat(), 2);
    assert!(err.contains("at 40,000 points of the grids are too many"), "{err}");
    let (out, _) = sweep("--keep summary --no-error", 0);
    assert!(out.contains("measure") && out.contains("median") && out.contains("wrote sweep.json"), "{out}");
    assert!(out.contains("max(x) < 0.2 m held in 297 of 297 runs (100 %)"), "{out}");
    let (out, _) = sweep("--keep both --out t.csv --no-error", 0);
    assert!(out.contains("wrote t.csv, t.json"), "{out}");
    // Blocks that were changed are made again; those of another sweep are refused.
    let whole = fs::read(folder.join("sweep.json")).unwrap();
    let asked: serde_json::Value = serde_json::from_slice(&whole).unwrap();
    let mut asked: Vec<&str> = asked["asked"].as_array().unwrap().iter().map(|line| line.as_str().unwrap()).collect();
    asked.insert(asked.len() - 1, "--keep summary");
    fs::write(folder.join(".sweep.json.unfinished"), format!("{}\n\n", asked.join("\n"))).unwrap();
    fs::write(folder.join(".sweep.json.blocks"), "0,[256,[],[],[],[]]\n").unwrap();
    let (_, err) = sweep("--keep summary --no-error --resume", 0);
    assert!(err.contains("row 0 of .sweep.json.blocks is missing or not as it was written"), "{err}");
    assert!(fs::read(folder.join("sweep.json")).unwrap() == whole);
    fs::write(folder.join(".sweep.json.unfinished"), "asked for something else\n\n").unwrap();
    let (_, err) = sweep("--keep summary --resume", 1);
    assert!(err.contains("was begun with other settings"), "{err}");
}

/// The script for Slurm, as the scheduler would start it: each task with its number, some of them twice.
#[test]
fn the_tasks_of_a_slurm_array_are_the_units_of_a_sweep() {
    let folder = folder("slurm");
    texts(&folder);
    let sweep = ["sweep", "spring.fric", "fixed", "--vary", "m ~ normal(1 kg, 0.2 kg)", "--runs", "50", "-q"];
    run(&folder, &[&sweep[..], &["--out", "one.csv"]].concat(), 0);
    run(&folder, &[&sweep[..], &["--plan", "sweep.fricjob"]].concat(), 0);
    let script = support::root().join("examples/cluster/slurm.sh");
    let checked = Command::new("bash").arg("-n").arg(&script).status().expect("bash starts");
    assert!(checked.success());
    let binaries = Path::new(env!("CARGO_BIN_EXE_fric")).parent().unwrap();
    let path = format!("{}:{}", binaries.display(), std::env::var("PATH").unwrap());
    for task in [3, 0, 4, 2, 1, 3] {
        let mut command = Command::new("bash");
        command.arg(&script).args(["sweep.fricjob", "units"]).current_dir(&folder).stdin(Stdio::null());
        command.env("PATH", &path).env("FRIC_UNITS", "5").env("SLURM_ARRAY_TASK_ID", task.to_string());
        let output = command.env("SLURM_CPUS_PER_TASK", "1").output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    let units: Vec<String> = (0..5).map(|task| format!("units/{task}.fricunit")).collect();
    let units: Vec<&str> = units.iter().map(String::as_str).collect();
    run(&folder, &[&["sweep", "--join", "sweep.fricjob"], &units[..], &["-q", "--out", "t.csv"]].concat(), 0);
    assert!(fs::read(folder.join("t.csv")).unwrap() == fs::read(folder.join("one.csv")).unwrap());
    let output = Command::new("bash").arg(&script).output().unwrap();
    assert!(!output.status.success() && String::from_utf8_lossy(&output.stderr).contains("slurm.sh PLAN"));
}
