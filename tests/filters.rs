//! Filters of recordings: the numbers of SciPy, no shift in time, gaps; and fits of filtered recordings.

#![allow(clippy::disallowed_methods, reason = "recordings are made with the platform's functions")]

use compiler::experiment::filters::{LowPass, Thin, Uneven, interval, slope};
use compiler::ir::random::Random;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Recordings, and what SciPy 1.17 makes of them; written by `tests/peers/filters.py`.
const SCIPY: &str = include_str!("peers/filters.txt");

/// Mutants, each fails: no continuation beyond the ends, one row less of it, a start at rest, one pass, no
/// prewarping, the ripple of 0.05 dB left out, a central difference at an end.
#[test]
fn filters_agree_with_scipy() {
    let lines: Vec<&str> = SCIPY.lines().collect();
    assert_eq!(lines.len(), 30, "ten cases");
    for case in lines.chunks(3) {
        let (name, parameter) = case[0].split_once(' ').unwrap();
        let parameter: f64 = parameter.parse().unwrap();
        let numbers = |line: &str| line.split(' ').map(|number| number.parse().unwrap()).collect::<Vec<f64>>();
        let (x, expected) = (numbers(case[1]), numbers(case[2]));
        let times: Vec<f64> = (0..x.len()).map(|k| k as f64).collect();
        let y = match name {
            "smooth" => LowPass::butterworth(parameter).both_ways(&x),
            "thin" => Thin::new(parameter as usize, 1.0).of(&times, &x),
            _ => slope(&x, parameter),
        };
        assert_eq!(y.len(), expected.len(), "{}", case[0]);
        let largest = expected.iter().fold(0.0, |largest: f64, y| largest.max(y.abs()));
        for (k, (y, expected)) in y.iter().zip(&expected).enumerate() {
            assert!((y - expected).abs() <= 1e-10 * largest, "{}, row {k}: {y}, not {expected}", case[0]);
        }
    }
}

/// What is constant stays so, and a straight line but for its ends: no
/// filter shifts anything in time. Rows on both sides of a gap do not influence each other.
///
/// Mutants, each fails: a gap is none; what comes out is shifted by a row; `thin` names every row as kept.
#[test]
fn filters_shift_nothing_and_respect_gaps() {
    for seed in 0..50 {
        let mut random = Random(seed);
        let rows = 70 + random.below(100);
        let corner = 0.02 + 0.9 * random.within(0.0, 1.0);
        let filter = LowPass::butterworth(corner);
        let line: Vec<f64> = (0..rows).map(|k| 3.0 - 0.25 * k as f64).collect();
        let close = |a: &[f64], b: &[f64], least: f64, what: &str| {
            let off = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < least, "seed {seed}, corner {corner}: {what} is off by {off}");
        };
        if corner > 0.3 {
            // A pass starts in the steady state of a constant, so a line is bent a little at its ends; a shift by a row
            // would be a quarter.
            close(&filter.both_ways(&line), &line, 0.01, "a straight line");
        }
        close(&filter.both_ways(&vec![7.0; rows]), &vec![7.0; rows], 1e-9, "a constant");
        let x: Vec<f64> = (0..rows).map(|_| random.within(0.0, 1.0) - 0.5).collect();
        let gap = 30 + random.below(rows - 60);
        let mut times: Vec<f64> = (0..rows).map(|k| 0.5 * k as f64).collect();
        times[gap..].iter_mut().for_each(|t| *t += 1.0);
        let n = 2 + random.below(4);
        let thin = Thin::new(n, 0.5);
        let apart = [thin.of(&times[..gap], &x[..gap]), thin.of(&times[gap..], &x[gap..])].concat();
        assert_eq!(thin.of(&times, &x), apart, "seed {seed}, gap before row {gap}");
        let kept = thin.kept(&times);
        assert_eq!(kept.len(), apart.len(), "seed {seed}");
        assert!(kept.contains(&0) && kept.contains(&gap), "seed {seed}: {kept:?}");
        assert_eq!(interval(&times), Ok(0.5), "seed {seed}");
    }
}

/// Mutants, each fails: any rows are equidistant; the ends of the intervals exchanged.
#[test]
fn rows_that_are_not_equidistant_are_found() {
    let times = |gap: f64| -> Vec<f64> { (0..50).map(|k| 0.01 * k as f64 + if k >= 20 { gap } else { 0.0 }).collect() };
    assert!((interval(&times(0.0)).unwrap() - 0.01).abs() < 1e-15);
    // A gap that is no whole number of intervals.
    assert!((interval(&times(0.0173)).unwrap() - 0.01).abs() < 1e-12);
    let Uneven { shortest, longest } = interval(&times(0.002)).unwrap_err();
    assert!((longest.0 - 0.012).abs() < 1e-12 && longest.1 == 20, "{longest:?}");
    assert!((shortest.0 - 0.01).abs() < 1e-12, "{shortest:?}");
    // Times that are rounded to a thousandth of the interval.
    let rounded: Vec<f64> = (0..3000).map(|k| (k as f64 / 3.0 * 1e4).round() / 1e4).collect();
    assert!((interval(&rounded).unwrap() - 1.0 / 3.0).abs() < 1e-6);
}

fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("filters").join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fitted(folder: &Path, args: &[&str]) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_fric"))
        .current_dir(folder)
        .args(["fit", "f.fric", "--json"])
        .args(args)
        .output();
    let output = output.unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}{}", String::from_utf8_lossy(&output.stderr)))
}

/// Mass, friction and offset of an axis.
const AXIS: [(&str, &str, f64); 4] = [("m", "kg", 2.5), ("F0", "N", 0.7), ("Fc", "N", 6.0), ("Fv", "N·s/m", 25.0)];

/// The inverse model of an axis, whose speed and acceleration are computed from its position.
fn axis(minimise: &str) -> String {
    format!(
        "model Inverse {{\n  input v [m/s]  input a [m/s^2]\n  param m = 1 kg in > 0\n  param F0 = 0 N\n  param Fc = 1 N in >= 0\n  param Fv = 1 N·s/m in >= 0\n  output u [N] = m * a + Fc * tanh(v / 1 mm/s) + Fv * v + F0\n}}\nfit axis {{\n  run Inverse(v = data.v, a = data.a)\n  data \"r.csv\" (t [s], x [mm], u [N])\n  let data.a = slope(data.v)\n  let data.v = slope(data.q)\n  let data.q = smooth(data.x, 40 Hz)\n  vary m in 0.1 kg .. 10 kg, F0 in -5 N .. 5 N, Fc in 0.1 N .. 50 N, Fv in 1 N·s/m .. 500 N·s/m\n  minimise {minimise} after 0.1 s\n}}\n"
    )
}

/// Four seconds of an axis at 1 kHz: readings of its position in steps of 1 µm and of its force, with noise of 0.5 N
/// whose power lies above 100 Hz.
fn recording(seed: u64) -> String {
    let mut random = Random(seed);
    let tau = 2.0 * std::f64::consts::PI;
    let parts: Vec<(f64, f64, f64)> = (1..=4)
        .map(|k| (random.within(2e-3, 8e-3) / f64::from(k), 0.7 * f64::from(k), random.within(0.0, tau)))
        .collect();
    let motion = |t: f64| {
        parts.iter().fold([0.0; 3], |[x, v, a], (size, f, phase)| {
            let (w, angle) = (tau * f, tau * f * t + phase);
            [x + size * angle.sin(), v + size * w * angle.cos(), a - size * w * w * angle.sin()]
        })
    };
    let [m, offset, coulomb, viscous] = AXIS.map(|(_, _, value)| value);
    let mut before = 0.0;
    let row = |k: u32| {
        let t = 1e-3 * f64::from(k);
        let [x, v, a] = motion(t);
        let white = random.within(-1.0, 1.0);
        let noise = 0.6 * (white - before);
        before = white;
        let u = m * a + coulomb * (v / 1e-3).tanh() + viscous * v + offset + noise;
        format!("{t:.3},{:.3},{u:.4}\n", 1e3 * x)
    };
    "t [s],x [mm],u [N]\n".to_string() + &(0..4000).map(row).collect::<String>()
}

/// Inverse dynamics with parallel filtering find the parameters of an axis. Thinned residuals are a tenth of the rows, and
/// the values lie within 2 % and six of their standard deviations, since the filters of the motion are not those of the force.
#[test]
fn an_inverse_model_of_a_filtered_recording() {
    for seed in 0..3 {
        let folder = folder(&format!("axis-{seed}"));
        fs::write(folder.join("r.csv"), recording(seed)).unwrap();
        fs::write(folder.join("f.fric"), axis("rms(thin(u - data.u, 10))")).unwrap();
        let answer = fitted(&folder, &[]);
        let compared = &answer["recordings"][0]["compared"][0];
        assert_eq!(
            (&compared["text"], &compared["rows"]),
            (&"thin(u - data.u, 10)".into(), &390.into()),
            "seed {seed}"
        );
        for ((name, _, value), found) in AXIS.iter().zip(answer["parameters"].as_array().unwrap()) {
            let (at, sd) = (found["value"].as_f64().unwrap(), found["sd"].as_f64().unwrap());
            assert!((at / value - 1.0).abs() < 0.02, "seed {seed}: {name} is {at}, not {value}");
            assert!((at - value).abs() < 6.0 * sd, "seed {seed}: {name} is {at} ± {sd}, not {value}");
        }
        // The text that is left for later runs.
        let run =
            |args: &[&str]| Command::new(env!("CARGO_BIN_EXE_fric")).current_dir(&folder).args(args).output().unwrap();
        let output = run(&["fit", "f.fric", "--report"]);
        assert!(output.status.success(), "seed {seed}: {}", String::from_utf8_lossy(&output.stderr));
        let written = fs::read_to_string(folder.join("out/axis.fric")).unwrap();
        assert!(written.contains("data.q = smooth(data.x, 40 Hz)"), "{written}");
        let output = run(&["test", "out/axis.fric"]);
        assert!(output.status.success(), "seed {seed}: {}{written}", String::from_utf8_lossy(&output.stdout));
    }
}
