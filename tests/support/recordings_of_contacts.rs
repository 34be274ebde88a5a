//! Recordings of known contacts, and fits of them from far starts: what `tests/fits.rs` does for some seeds, and
//! `benches/acceptance.rs` for many.

use crate::moved_contact::Chance;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// An unknown parameter: its path in the model that is run, its unit, its true value.
pub type Known = (&'static str, &'static str, f64);

/// A mass on a contact under a recorded force, and one that a spring pulls. The contact is a slot.
pub const MASSES: &str = "import std.friction
import std.interfaces
model Tap {
  input u [N]
  part fr : Friction = LuGre(v = v)
  state x [m] = 0
  state v [m/s] = 0
  dx/dt = v
  dv/dt = (u - fr.F) / 1 kg
}
model Pull {
  let u = 2 N/m * (0.1 m/s * t - x)
  part fr : Friction = KFM(v = v, F_ext = u)
  state x [m] = 0
  state v [m/s] = 0
  dx/dt = v
  dv/dt = (u - fr.F) / 1 kg
}
";

/// The bristle of the recordings.
pub const KNOWN: &str =
    "LuGre(sigma0 = 1e5 N/m, sigma1 = 316 N·s/m, sigma2 = 0.4 N·s/m, Fc = 1 N, Fs = 1.5 N, vs = 1 mm/s)";

/// A recorded force that keeps a mass in presliding, row by row at 1 kHz: a tap, then a triangle of 90 % of stiction.
pub fn tap(k: u32) -> f64 {
    let phase = f64::from((k + 500) % 1000) / 1000.0;
    let triangle = if phase < 0.25 {
        4.0 * phase
    } else if phase < 0.75 {
        2.0 - 4.0 * phase
    } else {
        4.0 * phase - 4.0
    };
    if (50..60).contains(&k) {
        0.3
    } else if k >= 500 {
        1.35 * triangle
    } else {
        0.0
    }
}

/// Runs the command in a folder.
pub fn fric(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fric")).current_dir(folder).args(args).output().expect("the command runs")
}

/// `fric run` of an experiment; the rows of its data.
pub fn made(folder: &Path, text: &str) -> Vec<Vec<f64>> {
    fs::write(folder.join("make.fric"), text).expect("it can be written");
    let output = fric(folder, &["run", "make.fric", "--data", "made.csv", "-q", "--no-error"]);
    assert!(output.status.success(), "{output:?}");
    let rows = fs::read_to_string(folder.join("made.csv")).expect("it has been written");
    let cells = |line: &str| line.split(',').map(|cell| cell.parse().expect("a number")).collect();
    rows.lines().skip(1).map(cells).collect()
}

/// Unknowns with starts anywhere in ranges of a factor 10^`decades` each way, stiction above Coulomb friction.
pub fn far(chance: &mut Chance, unknowns: &[Known], decades: f64) -> String {
    let factor = 10f64.powf(decades);
    let value = |starts: &[f64], name: &str| {
        let at = unknowns.iter().position(|(path, ..)| path.rsplit('.').next() == Some(name))?;
        Some(starts[at])
    };
    let starts: Vec<f64> = loop {
        let starts: Vec<f64> = unknowns
            .iter()
            .map(|(_, _, value)| value * 10f64.powf(decades * (2.0 * chance.fraction() - 1.0)))
            .collect();
        if value(&starts, "Fs").zip(value(&starts, "Fc")).is_none_or(|(stiction, sliding)| stiction >= sliding) {
            break starts;
        }
    };
    let one = |((path, unit, value), start): (&Known, f64)| {
        format!("{path} = {start:e} {unit} in {:e} {unit} .. {:e} {unit}", value / factor, factor * value)
    };
    unknowns.iter().zip(starts).map(one).collect::<Vec<_>>().join(", ")
}

/// What a fit found: for each parameter of its JSON its value and standard deviation in SI.
pub fn found(answer: &serde_json::Value) -> Vec<(f64, f64)> {
    let scale = |unit: &str| match unit {
        "mm/s" | "mm" | "ms" => 1e-3,
        "um" => 1e-6,
        _ => 1.0,
    };
    let one = |one: &serde_json::Value| {
        let scale = scale(one["unit"].as_str().unwrap_or_default());
        let number = |what: &str| scale * one[what].as_f64().unwrap_or(f64::INFINITY);
        (number("value"), number("sd"))
    };
    answer["parameters"].as_array().map_or(Vec::new(), |all| all.iter().map(one).collect())
}
