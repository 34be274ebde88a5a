//! What fits cost: `cargo bench --bench fits`. A run in lanes and a Jacobian beside loops by numba, with the same rows, on one
//! core. `acceptance` times whole fits.
//!
//! numba runs in `python3`, or in the Python of `FRIC_PYTHON`; without it there are no ratios. Times are of the processor,
//! the least of some repetitions.

#![allow(clippy::disallowed_methods, reason = "recordings are made with the platform's functions")]

#[path = "../tests/support/moved_contact.rs"]
#[allow(dead_code, reason = "the tests use more of it")]
mod moved_contact;
#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::{Instance, Slot};
use compiler::Sources;
use moved_contact::{CONTACT, Chance, moved};
use runtime::engine::tiles::Tiles;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

/// A text with its recording beside it.
struct Beside(String);

impl Sources for Beside {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        project::Disk.library(module)
    }

    fn modules(&self) -> Vec<String> {
        project::Disk.modules()
    }

    fn file(&self, _: &str, path: &str) -> Result<(String, String), String> {
        Ok((path.to_string(), self.0.clone()))
    }
}

/// The only run of a fit.
fn part(text: &str, data: String) -> (compiler::fit::Part, Vec<f64>) {
    let sources = Beside(data);
    let mut loaded = compiler::load("f.fric", text, &sources);
    let fits = compiler::fit(&mut loaded, &sources, "f", &compiler::Options::default(), &mut Vec::new());
    let mut fit = fits.unwrap_or_else(|errors| panic!("{errors:?}")).remove(0);
    let starts = fit.unknowns.iter().map(|one| one.start).collect();
    (fit.parts.remove(0), starts)
}

/// The least time of so many runs in lanes, read at all rows, in s.
fn seconds(part: &compiler::fit::Part, starts: &[f64], runs: usize) -> f64 {
    let slots: Vec<Slot> = part.asks.items.iter().map(|item| item.slot).collect();
    let made = |k: usize| {
        // Runs of a Jacobian differ a little.
        let values = part.asks.slots.iter().zip(starts).enumerate();
        let moved = values.map(|(at, (slot, value))| {
            let by = if k > 0 && (k - 1) / 2 == at { 1e-3 * if k.is_multiple_of(2) { -1.0 } else { 1.0 } } else { 0.0 };
            (slot.expect("it depends on all"), value * (1.0 + by))
        });
        let made = part.varying.at(&moved.collect::<Vec<_>>()).expect("it can be run");
        (made.instance, made.experiment)
    };
    let mut least = f64::INFINITY;
    for _ in 0..15 {
        let all: Vec<(Instance, _)> = (0..runs).map(made).collect();
        let begin = Instant::now();
        let mut tiles = Tiles::new(part.varying.lanes(), all, (&part.asks.rows, &slots), 1);
        let values = tiles.next(part.asks.rows.len());
        least = least.min(begin.elapsed().as_secs_f64());
        assert!(values.iter().all(|one| one.as_ref().is_ok_and(|one| one.len() == part.asks.rows.len())), "it ends");
    }
    least
}

/// What others need, in s: numba for a run of the moved contact; and for a Jacobian of the stick-slip numba, LSODA, and
/// CVODES with two tolerances. NaN where a library is missing.
fn others(folder: &Path) -> Option<[f64; 5]> {
    let python = std::env::var("FRIC_PYTHON").unwrap_or_else(|_| "python3".into());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/python/fit_loops.py");
    let output = Command::new(python).arg(script).arg(folder).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let times: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    times.try_into().ok()
}

fn main() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fits");
    fs::create_dir_all(&folder).expect("the target folder can be written");
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).expect("it can be written");
    let mut chance = Chance(1);
    let line = |(t, v, force): (f64, f64, f64)| format!("{t:.4},{v:e},{force:e}\n");
    let data = moved().into_iter().map(|(t, v, force)| line((t, v, force + 5e-3 * chance.normal())));
    let data = "t [s],v [m/s],F [N]\n".to_string() + &data.collect::<String>();
    write("moved.csv", &data);
    let vary = CONTACT.iter().map(|(name, unit, value)| {
        format!("{name} = {value} {unit} in {} {unit} .. {} {unit}", 0.1 * value, 10.0 * value)
    });
    let text = format!(
        "import std.friction.lugre\nfit f {{\n  run LuGre(v = data.v)\n  data \"r.csv\" (t [s], v [m/s], F [N])\n  vary {}\n  minimise rms(F - data.F)\n}}\n",
        vary.collect::<Vec<_>>().join(", ")
    );
    let (contact, starts) = part(&text, data);
    let lanes = contact.varying.lanes().map_or(1, |lanes| lanes.width());
    let run = seconds(&contact, &starts, lanes) / lanes as f64;

    let data = (0..=1500).map(|k| format!("{:.2},{}\n", 0.02 * f64::from(k), 0.1 * 0.02 * f64::from(k)));
    let data = "t [s],x [m]\n".to_string() + &data.collect::<String>();
    let text = "import std.friction.lugre\nmodel Pull {\n  let u = 2 N/m * (0.1 m/s * t - x)\n  part fr = LuGre(v = v)\n  state x [m] = 0\n  state v [m/s] = 0\n  dx/dt = v\n  dv/dt = (u - fr.F) / 1 kg\n}\nfit f {\n  run Pull()\n  data \"r.csv\" (t [s], x [m])\n  vary fr.Fc = 1 N in 0.1 N .. 10 N, fr.Fs = 1.5 N in 0.1 N .. 15 N, fr.vs = 1 mm/s in 0.1 mm/s .. 10 mm/s, fr.sigma0 = 1e5 N/m in 1e4 N/m .. 1e6 N/m\n  minimise rms(x - data.x) / 2 mm\n}\n";
    let (slip, starts) = part(text, data);
    let jacobian = seconds(&slip, &starts, 9);

    println!("moved contact, 4,001 rows, six unknowns: {:.4} ms a run in {lanes} lanes", 1e3 * run);
    println!("stick-slip, 30 s, 1,501 rows, four unknowns: {:.3} ms a Jacobian of nine runs", 1e3 * jacobian);
    match others(&folder) {
        Some([loops, jacobians @ ..]) => {
            println!("numba: {:.4} ms a run, ratio {:.1}", 1e3 * loops, loops / run);
            let names = ["numba", "LSODA of SciPy", "CVODES of CasADi, tol 1e-6", "CVODES of CasADi, tol 1e-8"];
            for (name, theirs) in names.iter().zip(jacobians) {
                println!("{name}: {:.3} ms a Jacobian, ratio {:.1}", 1e3 * theirs, theirs / jacobian);
            }
        }
        None => println!("numba is not there: no ratios"),
    }
}
