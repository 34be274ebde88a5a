//! `fric excite` designs motions that keep their limits, and whose recordings are as exact as was promised.

use compiler::ir::random::Random;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("excite").join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fric")).current_dir(folder).args(args).output().unwrap()
}

fn answer(folder: &Path, args: &[&str]) -> Value {
    let output = fric(folder, args);
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}{}", String::from_utf8_lossy(&output.stderr)))
}

/// Friction of a slide: viscous, and a step as wide as 2 mm/s.
const SLIDE: &str = "model Slide {\n  input v [m/s]\n  param k = 20 N·s/m in 2 N·s/m .. 200 N·s/m\n  param c = 1 N in 0.1 N .. 10 N\n  param F0 = 0 N in -2 N .. 2 N\n  output F [N] = k * v + c * v / sqrt(v * v + 4 mm^2/s^2) + F0\n}\nfit slide {\n  run Slide(v = data.v)\n  data \"r.csv\" (t [s], v [m/s], F [N])\n  vary k, c, F0\n  minimise rms(F - data.F) / 20 mN\n}\n";
const TRUE: [f64; 3] = [25.0, 0.7, 0.3];
const LIMITS: [&str; 4] = ["--limit", "x = -2 mm .. 2 mm", "--limit", "v = -40 mm/s .. 60 mm/s"];

/// Rows of a table: without its heading.
fn rows(path: &Path) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(path).unwrap();
    text.lines().skip(1).map(|line| line.split(',').map(|cell| cell.parse().unwrap()).collect()).collect()
}

/// The motion begins at rest, its speed and acceleration are derivatives of its position, it keeps its limits and reaches
/// one of them; and the text has the numbers of the table.
#[test]
fn a_motion_keeps_its_limits() {
    for (seed, more) in [(0, vec!["--harmonics", "3"]), (1, vec!["--base", "2.5Hz"])] {
        let folder = folder(&format!("limits-{seed}"));
        fs::write(folder.join("f.fric"), SLIDE).unwrap();
        let seed_text = seed.to_string();
        let common = ["excite", "f.fric", "--for", "1s", "--evaluations", "60", "--json", "--seed", &seed_text];
        let design = answer(&folder, &[&common[..], &LIMITS, &more].concat());
        assert!(design["log_det"].as_f64() >= design["sine_log_det"].as_f64(), "seed {seed}: {design}");
        let rows = rows(&folder.join("excite.csv"));
        assert!(rows[0][1..].iter().all(|value| value.abs() < 1e-12), "seed {seed}: {:?}", rows[0]);
        let share = |column: usize, low: f64, high: f64| {
            rows.iter().map(|row| (row[column] / high).max(row[column] / low)).fold(0.0, f64::max)
        };
        let most = share(1, -2e-3, 2e-3).max(share(2, -0.04, 0.06));
        assert!((0.98..=1.005).contains(&most), "seed {seed}: {most} of the limits");
        let h = rows[1][0] - rows[0][0];
        for (column, name) in [(1, "v"), (2, "a")] {
            let largest = rows.iter().map(|row| row[column + 1].abs()).fold(0.0, f64::max);
            for three in rows.windows(3) {
                let slope = (three[2][column] - three[0][column]) / (2.0 * h);
                let off = (slope - three[1][column + 1]).abs();
                assert!(off < 5e-3 * largest, "seed {seed}: {name} at {} s is off by {off}", three[1][0]);
            }
        }
        let output = fric(&folder, &["run", "excite.fric", "--data", "again.csv", "--every", "100ms"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
        let again = fs::read_to_string(folder.join("again.csv")).unwrap();
        let heading: Vec<String> = again.lines().next().unwrap().split(',').map(str::to_string).collect();
        let x = heading.iter().position(|cell| cell.starts_with("x ")).unwrap();
        for line in again.lines().skip(1) {
            let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
            let row = rows.iter().find(|row| (row[0] - cells[0]).abs() < 1e-9).unwrap();
            let scale = if heading[x].contains("mm") { 1e-3 } else { 1.0 };
            assert!((scale * cells[x] - row[1]).abs() < 1e-9, "seed {seed}: {line}, {row:?}");
        }
    }
}

/// Fits of simulated recordings of a designed motion have the predicted standard deviations within 15 %, and the true values
/// lie within four standard deviations. A sine predicts larger ones.
#[test]
fn a_fit_is_as_exact_as_was_promised() {
    let folder = folder("promise");
    fs::write(folder.join("f.fric"), SLIDE).unwrap();
    let known = |(name, value): (&str, f64)| {
        let unit = if name == "k" { "N·s/m" } else { "N" };
        format!("{{\"path\": \"{name}\", \"value\": {value}, \"unit\": \"{unit}\"}}")
    };
    let all: Vec<String> = ["k", "c", "F0"].into_iter().zip(TRUE).map(known).collect();
    fs::write(folder.join("known.json"), format!("{{\"parameters\": [{}]}}", all.join(", "))).unwrap();
    let common = [
        "excite",
        "f.fric",
        "--for",
        "2s",
        "--rate",
        "500Hz",
        "--evaluations",
        "100",
        "--known",
        "known.json",
        "--json",
    ];
    let design = answer(&folder, &[&common[..], &LIMITS].concat());
    let rows = rows(&folder.join("excite.csv"));
    for seed in 0..3 {
        let mut random = Random(seed);
        let [k, c, offset] = TRUE;
        let line = |row: &Vec<f64>| {
            let v = row[2];
            let noise: f64 = (0..12).map(|_| random.within(-0.5, 0.5)).sum();
            let force = k * v + c * v / (v * v + 4e-6).sqrt() + offset + 0.02 * noise;
            format!("{:?},{v:?},{force:?}\n", row[0])
        };
        // Rows of the fading do not count.
        let data: String = rows.iter().filter(|row| row[0] >= 1.0).map(line).collect();
        fs::write(folder.join("r.csv"), data).unwrap();
        let fit = answer(&folder, &["fit", "f.fric", "--json"]);
        for ((one, promised), value) in
            fit["parameters"].as_array().unwrap().iter().zip(design["unknowns"].as_array().unwrap()).zip(TRUE)
        {
            let (at, sd) = (one["value"].as_f64().unwrap(), one["sd"].as_f64().unwrap());
            assert!((at - value).abs() < 4.0 * sd, "seed {seed}: {one}, not {value}");
            let scale = if promised["relative"] == true { at } else { 4.0 };
            let ratio = sd / (scale * promised["sd"].as_f64().unwrap());
            assert!((ratio - 1.0).abs() < 0.15, "seed {seed}: {ratio} of what was promised: {one}, {promised}");
        }
    }
    assert!(design["log_det"].as_f64().unwrap() > design["sine_log_det"].as_f64().unwrap() + 0.1, "{design}");
}

fn limit_of_speed() -> &'static [&'static str] {
    &["--limit", "v = -40 mm/s .. 40 mm/s"]
}

/// A force that only a run tells keeps its limit for every set of values, and reaches it, or says that it does not: checked
/// with the model's equation on the written motion, at the ends of the ranges that were drawn. A wider limit is not met.
#[test]
fn limits_of_forces_are_kept() {
    let folder = folder("force-limits");
    fs::write(folder.join("f.fric"), SLIDE).unwrap();
    let known = "{\"parameters\": [{\"path\": \"k\", \"value\": 25, \"unit\": \"N·s/m\"}, {\"path\": \"c\", \"value\": 0.7, \"unit\": \"N\"}, {\"path\": \"F0\", \"value\": 0.3, \"unit\": \"N\"}]}";
    fs::write(folder.join("known.json"), known).unwrap();
    let force = |v: f64| 25.0 * v + 0.7 * v / (v * v + 4e-6).sqrt() + 0.3;
    for (limit, binds) in
        [("F = -1.2 N .. 1.4 N", true), ("F = -9 N .. 9 N", false), ("F * v = -1000 mW .. 20 mW", true)]
    {
        let common =
            ["excite", "f.fric", "--for", "1s", "--evaluations", "40", "--known", "known.json", "--limit", limit];
        let design = answer(&folder, &[&common[..], &LIMITS, &["--json"]].concat());
        let watched = &design["watched"][0];
        let is_power = limit.contains('*');
        let (low, high) = rows(&folder.join("excite.csv")).iter().fold((0.0_f64, 0.0_f64), |(low, high), row| {
            let value = if is_power { 1e3 * force(row[2]) * row[2] } else { force(row[2]) };
            (low.min(value), high.max(value))
        });
        let [a, b] = ["low", "high"].map(|end| watched[end].as_f64().unwrap());
        assert!(
            (a.min(0.0) - low).abs() < 0.01 * high && (b - high).abs() < 0.01 * high,
            "{limit}: {watched}, {low}, {high}"
        );
        let share = if is_power {
            high / 20.0
        } else if binds {
            (high / 1.4).max(low / -1.2)
        } else {
            high / 9.0
        };
        assert!(if binds { (0.985..=1.001).contains(&share) } else { share < 0.5 }, "{limit}: {share}");
        let words = fric(&folder, &[&common[..], &LIMITS].concat());
        let words = String::from_utf8_lossy(&words.stdout).into_owned();
        assert_eq!(words.contains("not the limit; that of another quantity is met first"), !binds, "{limit}: {words}");
    }
    // For sets of values all over the ranges the force is within its limit too.
    let design = answer(
        &folder,
        &[
            &["excite", "f.fric", "--for", "1s", "--evaluations", "40", "--json", "--limit", "F = -8 N .. 8 N"],
            &LIMITS[..],
        ]
        .concat(),
    );
    let [low, high] = ["low", "high"].map(|end| design["watched"][0][end].as_f64().unwrap());
    assert!(low >= -8.0 && high <= 8.0 && high.max(-low) > 7.9, "{design}");
}

/// A LuGre contact within 2 mm, 50 mm/s and 5 m/s², for 5 s at 1 kHz with 5 mN of noise: five harmonics tell at least as much
/// as those of the design of this command, a log-determinant of 88, and a sine of 1 Hz ten less. A fit of simulated
/// recordings of that motion has the promised standard deviations within 15 %.
#[test]
fn the_motion_of_a_bristle_tells_as_much_as_it_can() {
    let folder = folder("bristle");
    let contact = [
        ("sigma0", "N/m", 1e5),
        ("sigma1", "N·s/m", 316.0),
        ("sigma2", "N·s/m", 0.4),
        ("Fc", "N", 1.0),
        ("Fs", "N", 1.5),
        ("vs", "mm/s", 1.0),
    ];
    let vary = contact.map(|(name, unit, x)| format!("{name} in {} {unit} .. {} {unit}", 0.1 * x, 10.0 * x)).join(", ");
    let fit = format!(
        "import std.friction\nfit bristle {{\n  run LuGre(v = data.v)\n  data \"r.csv\" (t [s], v [m/s], F [N])\n  vary {vary}\n  minimise rms(F - data.F) / 5 mN\n}}\n"
    );
    fs::write(folder.join("f.fric"), fit).unwrap();
    let known =
        contact.map(|(name, unit, x)| format!("{{\"path\": \"{name}\", \"value\": {x}, \"unit\": \"{unit}\"}}"));
    fs::write(folder.join("known.json"), format!("{{\"parameters\": [{}]}}", known.join(", "))).unwrap();
    let limits = ["x = -2 mm .. 2 mm", "v = -50 mm/s .. 50 mm/s", "a = -5 m/s^2 .. 5 m/s^2"];
    let limits: Vec<&str> = limits.iter().flat_map(|limit| ["--limit", limit]).collect();
    let design = answer(
        &folder,
        &[&["excite", "f.fric", "--for", "5s", "--known", "known.json", "--json"], &limits[..]].concat(),
    );
    let [best, sine] = ["log_det", "sine_log_det"].map(|name| design[name].as_f64().unwrap());
    assert!(best >= 88.0 && sine < best - 8.0, "{best}, of a sine {sine}");
    let run = "import std.friction\nexperiment e { run LuGre(v = data.v) data \"excite.csv\" (t [s], _, v [m/s], _) solver adaptive tol 1e-10 record F [N] every 1 ms }\n";
    fs::write(folder.join("make.fric"), run).unwrap();
    let made = fric(&folder, &["run", "make.fric", "--data", "made.csv", "-q", "--no-error"]);
    assert!(made.status.success(), "{made:?}");
    let motion = rows(&folder.join("excite.csv"));
    let forces = rows(&folder.join("made.csv"));
    let mut ratios = [0.0; 6];
    for seed in 0..3 {
        let mut random = Random(seed);
        let line = |(row, force): (&Vec<f64>, &Vec<f64>)| {
            let noise: f64 = (0..12).map(|_| random.within(-0.5, 0.5)).sum();
            format!("{:?},{:?},{:?}\n", row[0], row[2], force[1] + 5e-3 * noise)
        };
        let data: String = motion.iter().zip(&forces).map(line).collect();
        // Rows of the fading are run, and do not count.
        fs::write(folder.join("r.csv"), data).unwrap();
        let counted = fs::read_to_string(folder.join("f.fric")).unwrap().replace("/ 5 mN\n", "/ 5 mN after 1 s\n");
        fs::write(folder.join("counted.fric"), counted).unwrap();
        let fit = answer(&folder, &["fit", "counted.fric", "--json", "--starts", "1", "--pieces", "1"]);
        let promised = design["unknowns"].as_array().unwrap();
        for (k, (one, promised)) in fit["parameters"].as_array().unwrap().iter().zip(promised).enumerate() {
            let (at, sd) = (one["value"].as_f64().unwrap(), one["sd"].as_f64().unwrap());
            let truth = contact[k].2;
            assert!((at - truth).abs() < 4.0 * sd, "seed {seed}: {one}, not {truth}");
            ratios[k] += sd / at / promised["sd"].as_f64().unwrap() / 3.0;
        }
    }
    assert!(ratios.iter().all(|ratio| (ratio - 1.0).abs() < 0.15), "{ratios:?} of what was promised");
}

/// What cannot be designed is refused with the reason.
#[test]
fn what_cannot_be_excited_is_refused() {
    let refused = |name: &str, text: &str, more: &[&str], code: i32| {
        let folder = folder(name);
        fs::write(folder.join("f.fric"), text).unwrap();
        let output = fric(&folder, &[&["excite", "f.fric", "--for", "1s"], more].concat());
        assert_eq!(output.status.code(), Some(code), "{name}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let limit = ["--limit", "v = -40 mm/s .. 40 mm/s"];
    let without = SLIDE.replace(" / 20 mN", "");
    assert!(refused("noise", &without, &limit, 1).contains("does not say how exact its measurement is"));
    let alone = SLIDE.replace("v = data.v", "v = sine(1 mm/s, 1 Hz)");
    assert!(refused("alone", &alone, &limit, 1).contains("reads no column"));
    let others = SLIDE.replace("v = data.v", "v = data.v + data.w");
    assert!(refused("others", &others, &limit, 1).contains("reads v, w"));
    assert!(refused("unit", SLIDE, &["--limit", "v = -1 mm .. 1 mm"], 1).contains("`v` is a velocity, not mm"));
    assert!(refused("name", SLIDE, &["--limit", "F = -1 N .. 1 N"], 1).contains("what moves needs a limit of its own"));
    let other = |limit: &'static str| [limit_of_speed(), &["--limit", limit]].concat();
    assert!(refused("unknown", SLIDE, &other("Fq = -1 N .. 1 N"), 1).contains("E0204"));
    assert!(refused("kind", SLIDE, &other("F = -1 m .. 1 m"), 1).contains("E0101"));
    let at_rest = refused("at-rest", SLIDE, &other("F + 3 N = -1 N .. 1 N"), 1);
    assert!(at_rest.contains("leaves -1 N .. 1 N without any motion"), "{at_rest}");
    assert!(refused("around", SLIDE, &["--limit", "v = 1 mm/s .. 2 mm/s"], 2).contains("must lie around 0"));
    let case = SLIDE.replace("  run Slide(v = data.v)\n  data", "  case slow {\n  run Slide(v = data.v)\n  data");
    let cases = case.replace("  vary k, c, F0\n", "").replace(" / 20 mN\n}", " / 20 mN\n  }\n  vary k, c, F0\n}");
    assert!(refused("cases", &cases, &limit, 1).contains("fit `slide` has cases; write a fit for each"));
    let slot = "import std.interfaces\nimport std.friction\nmodel Bench {\n  input v [m/s]\n  part fr : Friction = CoulombViscous(v = v)\n  output F [N] = fr.F\n}\nfit law {\n  run Bench(v = data.v)\n  sweep fr = Coulomb(), CoulombViscous()\n  data \"r.csv\" (t [s], v [m/s], F [N])\n  vary fr.Fc in 0.1 N .. 10 N\n  minimise rms(F - data.F) / 20 mN\n}\n";
    assert!(
        refused("sweep", slot, &limit, 1).contains("fit `law` has several laws; write a fit for the one to be excited")
    );
    assert!(refused("words", SLIDE, &["--limit", "v < 1 mm/s"], 2).contains("write it as"));
}
